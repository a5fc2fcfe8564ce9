#include <SofaMeshwright/BiomechanicalRegistration.h>

#include <meshwright.h>

#include <sofa/core/ObjectFactory.h>

#include <stdexcept>

namespace sofameshwright
{

void registerBiomechanicalRegistration(sofa::core::ObjectFactory* factory)
{
    factory->registerObjects(sofa::core::ObjectRegistrationData(
        "Registers a preoperative scan to an intraoperative one with a biomechanical model; gives the deformed mesh and its displacements.")
        .add<BiomechanicalRegistration>());
}

BiomechanicalRegistration::BiomechanicalRegistration()
    : d_movingImage(initData(&d_movingImage, "movingImage", "Preoperative scan"))
    , d_fixedImage(initData(&d_fixedImage, "fixedImage", "Intraoperative scan"))
    , d_segmentedImage(initData(&d_segmentedImage, "segmentedImage", "Segmentation of the preoperative scan: 1 brain, 2 tumour"))
    , d_outputField(initData(&d_outputField, "outputDeformationField", "File for the displacement field (.nrrd, .nii.gz, .mha); empty for none"))
    , d_outputImage(initData(&d_outputImage, "outputImage", "File for the warped scan; empty for none"))
    , d_tumorResection(initData(&d_tumorResection, false, "tumorResection", "True when tissue was removed between the scans"))
    , d_outputDisplacements(initData(&d_outputDisplacements, "outputDisplacements", "How far each of outputPoints came from the moving to the fixed scan, mm"))
    , d_sourcePoints(initData(&d_sourcePoints, "sourcePoints", "Centres of the matched blocks in the moving scan"))
    , d_targetPoints(initData(&d_targetPoints, "targetPoints", "Where the blocks were found in the fixed scan"))
{
}

void BiomechanicalRegistration::init()
{
    for (sofa::core::objectmodel::BaseData* input : std::initializer_list<sofa::core::objectmodel::BaseData*>{
             &d_movingImage, &d_fixedImage, &d_segmentedImage, &d_outputField, &d_outputImage, &d_tumorResection})
    {
        addInput(input);
    }
    for (auto* output : {&d_outputDisplacements, &d_sourcePoints, &d_targetPoints})
    {
        addOutput(output);
    }
    MeshwrightEngine::init();
}

int BiomechanicalRegistration::jobKind() const { return MW_JOB_REGISTRATION; }

namespace
{
struct ImageCloser { void operator()(mw_image* image) const { mw_image_destroy(image); } };
typedef std::unique_ptr<mw_image, ImageCloser> ImageHandle;
}

void BiomechanicalRegistration::setInputs(mw_context* context, mw_job* job)
{
    const std::pair<const char*, const sofa::core::objectmodel::DataFileName*> slots[] = {
        {"moving", &d_movingImage}, {"fixed", &d_fixedImage}, {"segmentation", &d_segmentedImage}};
    for (const auto& [slot, file] : slots)
    {
        if (file->getValue().empty())
        {
            throw std::runtime_error("'" + file->getName() + "' names no file");
        }
        mw_image* rawImage = nullptr;
        check(mw_image_read(context, file->getFullPath().c_str(), &rawImage));
        const ImageHandle image(rawImage);
        check(mw_job_set_image(job, slot, image.get()));
    }
    check(mw_job_set_i64(job, "tumor-resection", d_tumorResection.getValue() ? 1 : 0));
}

void BiomechanicalRegistration::clearOwnOutputs()
{
    for (auto* output : {&d_outputDisplacements, &d_sourcePoints, &d_targetPoints})
    {
        sofa::helper::getWriteOnlyAccessor(*output).clear();
    }
}

namespace
{

void copyPoints(sofa::Data<MeshwrightEngine::VecCoord>& output, const double* xyz, int64_t count)
{
    auto target = sofa::helper::getWriteOnlyAccessor(output);
    target.clear();
    for (int64_t i = 0; i < count; ++i)
    {
        target.push_back(MeshwrightEngine::Coord(xyz[3 * i], xyz[3 * i + 1], xyz[3 * i + 2]));
    }
}

} // namespace

void BiomechanicalRegistration::readOwnOutputs(mw_context*, mw_job* job)
{
    mw_mesh* mesh = nullptr;
    check(mw_job_take_mesh(job, &mesh));
    mw_type type = 0;
    int32_t components = 0;
    const void* data = nullptr;
    if (mw_mesh_array(mesh, 0, "displacement", &type, &components, &data) == MW_OK && type == MW_TYPE_F64 && components == 3)
    {
        copyPoints(d_outputDisplacements, static_cast<const double*>(data), mw_mesh_point_count(mesh));
    }
    mw_mesh_destroy(mesh);

    for (const auto& [slot, output] : {std::pair{"source_points", &d_sourcePoints}, std::pair{"target_points", &d_targetPoints}})
    {
        mw_type type = 0;
        int32_t components = 0;
        int64_t rows = 0;
        const void* data = nullptr;
        if (mw_job_array(job, slot, &type, &components, &rows, &data) == MW_OK && type == MW_TYPE_F64 && components == 3)
        {
            copyPoints(*output, static_cast<const double*>(data), rows);
        }
    }
    for (const auto& [slot, file] : {std::pair{"displacement", &d_outputField}, std::pair{"warped", &d_outputImage}})
    {
        if (!file->getValue().empty())
        {
            mw_image* rawImage = nullptr;
            check(mw_job_take_image(job, slot, &rawImage));
            const ImageHandle image(rawImage);
            check(mw_image_write(image.get(), file->getFullPath().c_str()));
        }
    }
}

} // namespace sofameshwright
