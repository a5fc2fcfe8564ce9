#include <SofaMeshwright/CBC3DMeshFromImage.h>

#include <meshwright.h>

#include <sofa/core/ObjectFactory.h>

#include <cmath>
#include <stdexcept>

namespace sofameshwright
{

void registerCBC3DMeshFromImage(sofa::core::ObjectFactory* factory)
{
    factory->registerObjects(sofa::core::ObjectRegistrationData(
        "Tetrahedral mesh of a segmented image by adaptive lattice refinement: every label keeps its own elements and a smooth surface.")
        .add<CBC3DMeshFromImage>());
}

CBC3DMeshFromImage::CBC3DMeshFromImage()
    : d_filename(initData(&d_filename, "filename", "Segmented image: .nii, .nii.gz, .nrrd, .nhdr, .mha, .mhd"))
    , d_labels(initData(&d_labels, "image", "Raw labels, x fastest; used when no file is named"))
    , d_dimensions(initData(&d_dimensions, "dimensions", "Number of voxels of 'image' along x, y, z"))
    , d_spacing(initData(&d_spacing, sofa::type::Vec3(1, 1, 1), "spacing", "Distance of voxel centres of 'image', mm"))
    , d_imageToWorld(initData(&d_imageToWorld, sofa::type::Mat4x4::Identity(), "imageToWorld", "Voxel index to world mm; where it is not the identity it replaces 'spacing'"))
    , d_features(initData(&d_features, "features", "Points that become vertices of the mesh"))
    , d_cellSize(initData(&d_cellSize, 0.0, "cellSize", "Spacing of the coarse lattice, mm; 0 for the library's default"))
    , d_fidelity(initData(&d_fidelity, 0.0, "fidelity", "Share of each label that the mesh must cover, 0 to 1; 0 for the default"))
    , d_smoothingIterations(initData(&d_smoothingIterations, -1, "smoothingIterations", "Iterations of surface smoothing; -1 for the default"))
    , d_labelCellSize(initData(&d_labelCellSize, "labelCellSize", "Largest edge for each entry of 'label', mm"))
    , d_labelFidelity(initData(&d_labelFidelity, "labelFidelity", "Fidelity for each entry of 'label'"))
{
}

void CBC3DMeshFromImage::init()
{
    for (sofa::core::objectmodel::BaseData* input : std::initializer_list<sofa::core::objectmodel::BaseData*>{
             &d_filename, &d_labels, &d_dimensions, &d_spacing, &d_imageToWorld, &d_features, &d_cellSize, &d_fidelity,
             &d_smoothingIterations, &d_labelCellSize, &d_labelFidelity})
    {
        addInput(input);
    }
    MeshwrightEngine::init();
}

int CBC3DMeshFromImage::jobKind() const { return MW_JOB_IMAGE_TO_MESH; }

namespace
{

struct ImageCloser { void operator()(mw_image* image) const { mw_image_destroy(image); } };

void describeGeometry(mw_image_desc& description, const sofa::type::Mat4x4& imageToWorld, const sofa::type::Vec3& spacing)
{
    const bool isGiven = imageToWorld != sofa::type::Mat4x4::Identity();
    for (int axis = 0; axis < 3; ++axis)
    {
        double length = 0.0;
        for (int row = 0; row < 3; ++row) { length += imageToWorld[row][axis] * imageToWorld[row][axis]; }
        length = std::sqrt(length);
        description.spacing[axis] = isGiven ? length : spacing[axis];
        description.origin[axis] = isGiven ? double(imageToWorld[axis][3]) : 0.0;
        for (int row = 0; row < 3; ++row)
        {
            description.direction[3 * row + axis] = isGiven ? imageToWorld[row][axis] / length : double(row == axis);
        }
    }
}

} // namespace

void CBC3DMeshFromImage::setInputs(mw_context* context, mw_job* job)
{
    mw_image* rawImage = nullptr;
    if (!d_filename.getValue().empty())
    {
        check(mw_image_read(context, d_filename.getFullPath().c_str(), &rawImage));
    }
    else
    {
        const auto voxels = sofa::helper::getReadAccessor(d_labels);
        const auto& dimensions = d_dimensions.getValue();
        mw_image_desc description = {};
        description.struct_size = sizeof(description);
        std::size_t expected = 1;
        for (int axis = 0; axis < 3; ++axis)
        {
            if (dimensions[axis] <= 0) { throw std::runtime_error("'dimensions' needs three positive numbers, or 'filename' a file"); }
            description.dims[axis] = dimensions[axis];
            expected *= std::size_t(dimensions[axis]);
        }
        if (voxels.size() != expected)
        {
            throw std::runtime_error("'image' has " + std::to_string(voxels.size()) + " voxels, 'dimensions' say " + std::to_string(expected));
        }
        describeGeometry(description, d_imageToWorld.getValue(), d_spacing.getValue());
        description.data = voxels.ref().data();
        description.type = MW_TYPE_I32;
        check(mw_image_create(context, &description, &rawImage));
    }
    std::unique_ptr<mw_image, ImageCloser> image(rawImage);
    check(mw_job_set_image(job, "labels", image.get()));

    if (d_cellSize.getValue() > 0.0) { setParameter(job, "lattice-spacing", d_cellSize.getValue()); }
    if (d_fidelity.getValue() > 0.0) { setParameter(job, "fidelity", d_fidelity.getValue()); }
    if (d_smoothingIterations.getValue() >= 0) { check(mw_job_set_i64(job, "smoothing-iterations", d_smoothingIterations.getValue())); }
    if (d_splitToTetrahedra.getValue()) { check(mw_job_set_i64(job, "mixed-elements", 0)); }
    const auto labels = sofa::helper::getReadAccessor(d_label);
    const auto sizes = sofa::helper::getReadAccessor(d_labelCellSize);
    const auto fidelities = sofa::helper::getReadAccessor(d_labelFidelity);
    for (std::size_t k = 0; k < labels.size(); ++k)
    {
        if (k < sizes.size() && sizes[k] > 0.0) { check(mw_job_set_f64_for(job, "max-element-size", labels[k], sizes[k])); }
        if (k < fidelities.size() && fidelities[k] > 0.0) { check(mw_job_set_f64_for(job, "fidelity", labels[k], fidelities[k])); }
    }
    const auto features = sofa::helper::getReadAccessor(d_features);
    if (!features.empty())
    {
        std::vector<double> xyz;
        for (const auto& point : features) { xyz.insert(xyz.end(), {double(point[0]), double(point[1]), double(point[2])}); }
        check(mw_job_set_points(job, "fixed_points", int64_t(features.size()), xyz.data()));
    }
}

} // namespace sofameshwright
