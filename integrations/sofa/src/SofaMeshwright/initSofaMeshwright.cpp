// Entry points of the plugin, and the explicit registration of its components (SOFA v24.12 and later).
#include <SofaMeshwright/config.h>

#include <sofa/core/ObjectFactory.h>
#include <sofa/helper/system/PluginManager.h>

namespace sofameshwright
{

extern void registerCBC3DMeshFromImage(sofa::core::ObjectFactory* factory);
extern void registerCDT3DMeshFromSurface(sofa::core::ObjectFactory* factory);
extern void registerBiomechanicalRegistration(sofa::core::ObjectFactory* factory);

extern "C" {
SOFA_EXPORT_DYNAMIC_LIBRARY void initExternalModule();
SOFA_EXPORT_DYNAMIC_LIBRARY const char* getModuleName();
SOFA_EXPORT_DYNAMIC_LIBRARY const char* getModuleVersion();
SOFA_EXPORT_DYNAMIC_LIBRARY const char* getModuleLicense();
SOFA_EXPORT_DYNAMIC_LIBRARY const char* getModuleDescription();
SOFA_EXPORT_DYNAMIC_LIBRARY const char* getModuleComponentList();
SOFA_EXPORT_DYNAMIC_LIBRARY void registerObjects(sofa::core::ObjectFactory* factory);
}

void initExternalModule()
{
    static bool isFirstCall = true;
    if (isFirstCall)
    {
        isFirstCall = false;
        sofa::helper::system::PluginManager::getInstance().registerPlugin(MODULE_NAME);
    }
}

const char* getModuleName() { return MODULE_NAME; }

const char* getModuleVersion() { return MODULE_VERSION; }

const char* getModuleLicense() { return "MIT OR Apache-2.0"; }

const char* getModuleDescription()
{
    return "Tetrahedral meshes from segmented images and surfaces, and physics-based registration, with Meshwright.";
}

const char* getModuleComponentList()
{
    return "CBC3DMeshFromImage, CDT3DMeshFromSurface, BiomechanicalRegistration";
}

void registerObjects(sofa::core::ObjectFactory* factory)
{
    registerCBC3DMeshFromImage(factory);
    registerCDT3DMeshFromSurface(factory);
    registerBiomechanicalRegistration(factory);
}

} // namespace sofameshwright
