#include <SofaMeshwright/CDT3DMeshFromSurface.h>

#include <meshwright.h>

#include <sofa/core/ObjectFactory.h>

#include <sstream>
#include <stdexcept>

namespace sofameshwright
{

void registerCDT3DMeshFromSurface(sofa::core::ObjectFactory* factory)
{
    factory->registerObjects(sofa::core::ObjectRegistrationData(
        "Tetrahedral mesh of a closed surface triangulation that keeps every input triangle exactly.")
        .add<CDT3DMeshFromSurface>());
}

CDT3DMeshFromSurface::CDT3DMeshFromSurface()
    : d_filename(initData(&d_filename, "filename", "Surface: .stl, .off, .obj, .ply, .vtk, .vtp, .mesh, .surf, .poly"))
    , d_inputPoints(initData(&d_inputPoints, "inputPoints", "Points of the surface; used when no file is named"))
    , d_inputTriangles(initData(&d_inputTriangles, "inputTriangles", "Triangles of the surface"))
    , d_inputQuads(initData(&d_inputQuads, "inputQuads", "Quads of the surface, each split into two triangles"))
    , d_holes(initData(&d_holes, "holes", "A point in each cavity that stays empty"))
    , d_refine(initData(&d_refine, true, "refine", "If false, the volume gets only the points that the surface needs"))
    , d_cellSize(initData(&d_cellSize, 0.0, "cellSize", "Largest element size; 0 to follow the surface alone"))
    , d_cellRatio(initData(&d_cellRatio, 0.0, "cellRatio", "Largest growth rate of neighbouring sizes, 1 to 3; 0 for the default"))
{
}

void CDT3DMeshFromSurface::init()
{
    for (sofa::core::objectmodel::BaseData* input : std::initializer_list<sofa::core::objectmodel::BaseData*>{
             &d_filename, &d_inputPoints, &d_inputTriangles, &d_inputQuads, &d_holes, &d_refine, &d_cellSize, &d_cellRatio})
    {
        addInput(input);
    }
    MeshwrightEngine::init();
}

int CDT3DMeshFromSurface::jobKind() const { return MW_JOB_SURFACE_TO_MESH; }

namespace
{
struct SurfaceCloser { void operator()(mw_surface* surface) const { mw_surface_destroy(surface); } };
}

void CDT3DMeshFromSurface::setInputs(mw_context* context, mw_job* job)
{
    mw_surface* rawSurface = nullptr;
    if (!d_filename.getValue().empty())
    {
        check(mw_surface_read(context, d_filename.getFullPath().c_str(), &rawSurface));
    }
    else
    {
        const auto points = sofa::helper::getReadAccessor(d_inputPoints);
        std::vector<double> xyz;
        xyz.reserve(3 * points.size());
        for (const auto& point : points) { xyz.insert(xyz.end(), {double(point[0]), double(point[1]), double(point[2])}); }
        std::vector<int32_t> triangles;
        for (const auto& triangle : sofa::helper::getReadAccessor(d_inputTriangles))
        {
            for (const auto vertex : triangle) { triangles.push_back(int32_t(vertex)); }
        }
        for (const auto& quad : sofa::helper::getReadAccessor(d_inputQuads))
        {
            for (const int corner : {0, 1, 2, 0, 2, 3}) { triangles.push_back(int32_t(quad[corner])); }
        }
        if (triangles.empty())
        {
            throw std::runtime_error("no surface: name a file, or link inputPoints and inputTriangles to a loader");
        }
        check(mw_surface_create(context, int64_t(points.size()), xyz.data(), int64_t(triangles.size() / 3), triangles.data(), nullptr, &rawSurface));
    }
    std::unique_ptr<mw_surface, SurfaceCloser> surface(rawSurface);
    check(mw_job_set_surface(job, "surface", surface.get()));

    check(mw_job_set_i64(job, "ref", d_refine.getValue() ? 1 : 0));
    if (d_cellSize.getValue() > 0.0) { setParameter(job, "dfmax", d_cellSize.getValue()); }
    if (d_cellRatio.getValue() > 0.0) { setParameter(job, "cdfr", d_cellRatio.getValue()); }
    for (const auto& hole : d_holes.getValue())
    {
        std::ostringstream text;
        text.precision(17);
        text << hole[0] << ',' << hole[1] << ',' << hole[2];
        setParameter(job, "hole", text.str());
    }
}

} // namespace sofameshwright
