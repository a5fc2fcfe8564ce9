// Loads the plugin, makes a mesh from raw voxels, runs a tetrahedral FEM on it, and checks both; then feeds the
// component bad input and checks that the scene lives on. Prints what failed; exit code 0 when nothing did.
#include <sofa/core/ObjectFactory.h>
#include <sofa/core/behavior/BaseMechanicalState.h>
#include <sofa/core/objectmodel/BaseData.h>
#include <sofa/core/topology/BaseMeshTopology.h>
#include <sofa/helper/system/FileRepository.h>
#include <sofa/helper/system/PluginManager.h>
#include <sofa/simpleapi/SimpleApi.h>
#include <sofa/simulation/Node.h>
#include <sofa/simulation/Simulation.h>
#include <sofa/simulation/common/init.h>
#include <sofa/simulation/graph/DAGSimulation.h>

#include <cmath>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <sstream>
#include <string>

namespace api = sofa::simpleapi;

static int failures = 0;
static const auto simulation = api::createSimulation("DAG");

static void expect(bool condition, const std::string& what)
{
    std::cout << (condition ? "passed: " : "FAILED: ") << what << std::endl;
    failures += condition ? 0 : 1;
}

static std::string ballImage(int size, double radius)
{
    std::ostringstream text;
    for (int k = 0; k < size; ++k)
        for (int j = 0; j < size; ++j)
            for (int i = 0; i < size; ++i)
            {
                const double center = 0.5 * (size - 1);
                const double distance = std::sqrt(std::pow(i - center, 2) + std::pow(j - center, 2) + std::pow(k - center, 2));
                text << (distance < radius ? "1 " : "0 ");
            }
    return text.str();
}

static std::string valueOf(const sofa::simulation::Node::SPtr& root, const std::string& object, const std::string& data)
{
    auto* component = root->getObject(object);
    auto* field = component ? component->findData(data) : nullptr;
    return field ? field->getValueString() : std::string();
}

static void meshesAnImageAndRunsAFiniteElementBody()
{
    auto root = api::createRootNode(simulation, "root", {{"gravity", "0 0 -9.81"}});
    api::createObject(root, "DefaultAnimationLoop");
    api::createObject(root, "CBC3DMeshFromImage", {{"name", "mesher"}, {"image", ballImage(20, 7.0)}, {"dimensions", "20 20 20"},
        {"spacing", "1 1 1"}, {"cellSize", "4"}, {"threads", "1"}});
    auto body = api::createChild(root, "body");
    api::createObject(body, "EulerImplicitSolver");
    api::createObject(body, "CGLinearSolver", {{"iterations", "50"}, {"tolerance", "1e-9"}, {"threshold", "1e-9"}});
    api::createObject(body, "TetrahedronSetTopologyContainer", {{"name", "topology"}, {"position", "@../mesher.outputPoints"},
        {"tetrahedra", "@../mesher.outputTetras"}});
    api::createObject(body, "MechanicalObject", {{"name", "nodes"}, {"template", "Vec3"}});
    api::createObject(body, "UniformMass", {{"totalMass", "1"}});
    api::createObject(body, "TetrahedronFEMForceField", {{"name", "fem"}, {"youngModulus", "3000"}, {"poissonRatio", "0.45"}});
    sofa::simulation::node::initRoot(root.get());

    auto* topology = body->getMeshTopology();
    expect(topology && topology->getNbTetrahedra() > 100, "the topology holds the tetrahedra of the image");
    expect(valueOf(root, "mesher", "componentState") == "Valid", "the mesher is valid");
    expect(std::stod("0" + valueOf(root, "mesher", "minDihedral")) > 5.0, "the smallest dihedral angle is known and sound");

    const auto* nodes = body->getMechanicalState();
    const double before = nodes->getPZ(0);
    for (int step = 0; step < 5; ++step)
    {
        sofa::simulation::node::animate(root.get(), 0.01);
    }
    const double fall = before - nodes->getPZ(0);
    // 5 implicit Euler steps of 0.01 s fall g dt^2 (1 + 2 + 3 + 4 + 5) = 14.7 mm in SI; free fall leaves the body unstrained.
    expect(std::isfinite(fall) && std::abs(fall - 9.81e-4 * 15) < 1e-3, "the body falls as a free body does");
    sofa::simulation::node::unload(root);
}

static void badInputIsAComponentStateAndTheSceneLivesOn()
{
    auto root = api::createRootNode(simulation, "root");
    api::createObject(root, "DefaultAnimationLoop");
    api::createObject(root, "CBC3DMeshFromImage", {{"name", "noFile"}, {"filename", "/nowhere/image.nii"}});
    api::createObject(root, "CBC3DMeshFromImage", {{"name", "noInput"}});
    api::createObject(root, "CBC3DMeshFromImage", {{"name", "wrongSize"}, {"image", "1 1 1"}, {"dimensions", "2 2 2"}});
    api::createObject(root, "CDT3DMeshFromSurface", {{"name", "open"}, {"inputPoints", "0 0 0 1 0 0 0 1 0"}, {"inputTriangles", "0 1 2"}});
    api::createObject(root, "BiomechanicalRegistration", {{"name", "noScans"}});
    const std::string ball = ballImage(12, 4.0);
    // Values of the wrong type or out of range.
    api::createObject(root, "CBC3DMeshFromImage", {{"name", "negativeSize"}, {"image", ball}, {"dimensions", "12 -12 12"}});
    api::createObject(root, "CBC3DMeshFromImage", {{"name", "zeroSpacing"}, {"image", ball}, {"dimensions", "12 12 12"}, {"spacing", "1 0 1"}});
    api::createObject(root, "CBC3DMeshFromImage", {{"name", "singular"}, {"image", ball}, {"dimensions", "12 12 12"},
        {"imageToWorld", "1 0 0 0 1 0 0 0 0 0 1 0 0 0 0 1"}});
    api::createObject(root, "CBC3DMeshFromImage", {{"name", "noLabels"}, {"image", "0 0 0 0 0 0 0 0"}, {"dimensions", "2 2 2"}});
    api::createObject(root, "CBC3DMeshFromImage", {{"name", "negativeThreads"}, {"image", ball}, {"dimensions", "12 12 12"}, {"threads", "-3"}});
    api::createObject(root, "CBC3DMeshFromImage", {{"name", "unknownParameter"}, {"image", ball}, {"dimensions", "12 12 12"}, {"parameters", "latice-spacing=3"}});
    api::createObject(root, "CBC3DMeshFromImage", {{"name", "noAssignment"}, {"image", ball}, {"dimensions", "12 12 12"}, {"parameters", "fidelity"}});
    api::createObject(root, "CDT3DMeshFromSurface", {{"name", "wildIndex"}, {"inputPoints", "0 0 0 1 0 0 0 1 0"}, {"inputTriangles", "0 1 99"}});
    // A half-built scene: links to what is not there.
    api::createObject(root, "CDT3DMeshFromSurface", {{"name", "deadLink"}, {"inputPoints", "@missing.position"}, {"inputTriangles", "@missing.triangles"}});
    // A body on a mesher that made nothing.
    auto body = api::createChild(root, "body");
    api::createObject(body, "TetrahedronSetTopologyContainer", {{"name", "topology"}, {"position", "@../noInput.outputPoints"},
        {"tetrahedra", "@../noInput.outputTetras"}});
    api::createObject(body, "MechanicalObject", {{"name", "nodes"}, {"template", "Vec3"}});
    // Text where a number belongs: SOFA says so and keeps the default, and the mesher runs.
    api::createObject(root, "CBC3DMeshFromImage", {{"name", "wrongType"}, {"image", ball}, {"dimensions", "12 12 12"}, {"cellSize", "large"}});
    sofa::simulation::node::initRoot(root.get());
    expect(valueOf(root, "wrongType", "componentState") == "Valid", "text for a number leaves the default");
    expect(body->getMeshTopology()->getNbTetrahedra() == 0, "a body on no mesh has no tetrahedra");
    for (const char* name : {"noFile", "noInput", "wrongSize", "open", "noScans", "negativeSize", "zeroSpacing", "singular", "noLabels",
                             "negativeThreads", "unknownParameter", "noAssignment", "wildIndex", "deadLink"})
    {
        expect(valueOf(root, name, "componentState") == "Invalid", std::string(name) + " is invalid");
        expect(valueOf(root, name, "outputPoints").empty(), std::string(name) + " has no points");
    }
    sofa::simulation::node::animate(root.get(), 0.01);
    expect(true, "the scene is animated after the errors");
    sofa::simulation::node::unload(root);
}

static void meshesASurface()
{
    auto root = api::createRootNode(simulation, "root");
    api::createObject(root, "CDT3DMeshFromSurface", {{"name", "mesher"}, {"refine", "false"},
        {"inputPoints", "0 0 0 1 0 0 0 1 0 1 1 0 0 0 1 1 0 1 0 1 1 1 1 1"},
        {"inputTriangles", "0 2 3 0 3 1 4 5 7 4 7 6 0 1 5 0 5 4 2 6 7 2 7 3 0 4 6 0 6 2 1 3 7 1 7 5"}});
    sofa::simulation::node::initRoot(root.get());
    expect(valueOf(root, "mesher", "componentState") == "Valid", "the surface mesher is valid");
    std::istringstream points(valueOf(root, "mesher", "outputPoints"));
    int count = 0;
    for (double value; points >> value;) { ++count; }
    expect(count == 24, "the cube keeps its eight points and gets no other");
    sofa::simulation::node::unload(root);
}

/// A scan of a textured ball of tissue, as a text NRRD file; `shift` is how far its points came along z since the moving scan.
static void writeScan(const std::string& path, int size, double shift, bool isSegmentation)
{
    std::ofstream file(path);
    file << "NRRD0004\ntype: float\ndimension: 3\nsizes: " << size << ' ' << size << ' ' << size << "\nspacings: 1 1 1\nencoding: ascii\n\n";
    const double center = 0.5 * (size - 1), radius = center - 3.0;
    for (int k = 0; k < size; ++k)
        for (int j = 0; j < size; ++j)
            for (int i = 0; i < size; ++i)
            {
                const double x = i - center, y = j - center, z = k - center;
                const double w = z + shift * (z + center) / (2.0 * center);
                const double texture = 100.0 + 30.0 * std::sin(0.55 * x + 0.2 * y) * std::cos(0.45 * y - 0.3 * w) + 25.0 * std::sin(0.6 * w + 0.3 * x);
                file << (x * x + y * y + w * w < radius * radius ? (isSegmentation ? 1.0 : texture) : 0.0) << ' ';
            }
}

static void registersTwoScans()
{
    const std::string moving = "registration_moving.nrrd", fixed = "registration_fixed.nrrd", labels = "registration_labels.nrrd";
    writeScan(moving, 32, 0.0, false);
    writeScan(fixed, 32, 2.5, false);
    writeScan(labels, 32, 0.0, true);
    auto root = api::createRootNode(simulation, "root");
    api::createObject(root, "BiomechanicalRegistration", {{"name", "registration"}, {"movingImage", moving}, {"fixedImage", fixed},
        {"segmentedImage", labels}, {"threads", "1"}});
    sofa::simulation::node::initRoot(root.get());
    expect(valueOf(root, "registration", "componentState") == "Valid", "the registration is valid");
    std::istringstream text(valueOf(root, "registration", "outputDisplacements"));
    double x = 0.0, y = 0.0, z = 0.0, sum = 0.0;
    int count = 0;
    for (; text >> x >> y >> z; ++count) { sum += z; }
    // A point at w of the moving scan is at z < w in the fixed scan: the tissue moved down by 0 to 2.5 mm.
    std::cout << "mean displacement along z " << sum / count << " mm at " << count << " points" << std::endl;
    expect(count > 50 && sum / count < -0.5 && sum / count > -2.0, "its displacements are those of the tissue");
    sofa::simulation::node::unload(root);
    for (const std::string& path : {moving, fixed, labels}) { std::remove(path.c_str()); }
}

/// The example scenes load as they are: every component is made, every attribute is known. The files that two of them name are the
/// user's, so that their mesher says it has no file; the third meshes the liver that SOFA brings, where that is installed.
static void theExampleScenesLoad()
{
    sofa::simulation::common::init();
    for (const std::string scene : {"MeshFromImage", "MeshFromSurface", "Registration"})
    {
        auto root = sofa::simulation::node::load(SCENES_FOLDER "/" + scene + ".scn");
        expect(bool(root), scene + " loads");
        if (!root) { continue; }
        const std::string name = scene == "Registration" ? "registration" : "mesher";
        auto* mesher = root->getObject(name);
        expect(mesher != nullptr, scene + " has its mesher");
        if (!mesher) { continue; }
        for (auto* child : root->getChildren())
        {
            auto* node = dynamic_cast<sofa::simulation::Node*>(child);
            expect(node && node->getMeshTopology() && node->getMechanicalState(), scene + " has a body");
        }
        sofa::simulation::node::initRoot(root.get());
        const std::string state = valueOf(root, name, "componentState");
        std::string file = "mesh/liver.obj";
        const bool hasFile = scene == "MeshFromSurface" && sofa::helper::system::DataRepository.findFile(file, "", nullptr);
        expect(state == (hasFile ? "Valid" : "Invalid"), scene + " is " + state + (hasFile ? " with" : " without") + " its file");
        sofa::simulation::node::animate(root.get(), 0.01);
        sofa::simulation::node::unload(root);
    }
}

int main()
{
    auto& plugins = sofa::helper::system::PluginManager::getInstance();
    expect(plugins.loadPluginByPath(PLUGIN_PATH) == sofa::helper::system::PluginManager::PluginLoadStatus::SUCCESS, "the plugin loads");
    for (const char* module : {"SofaMeshwright", "Sofa.Simulation.Core"})
    {
        sofa::core::ObjectFactory::getInstance()->registerObjectsFromPlugin(module);
    }
    for (const char* name : {"Sofa.Component.ODESolver.Backward", "Sofa.Component.LinearSolver.Iterative", "Sofa.Component.Mass",
                             "Sofa.Component.StateContainer", "Sofa.Component.Topology.Container.Dynamic", "Sofa.Component.SolidMechanics.FEM.Elastic"})
    {
        api::importPlugin(name);
    }
    meshesAnImageAndRunsAFiniteElementBody();
    meshesASurface();
    registersTwoScans();
    badInputIsAComponentStateAndTheSceneLivesOn();
    theExampleScenesLoad();
    std::cout << failures << " failures" << std::endl;
    return failures == 0 ? 0 : 1;
}
