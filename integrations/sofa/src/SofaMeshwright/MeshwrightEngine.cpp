#include <SofaMeshwright/MeshwrightEngine.h>

#include <meshwright.h>

#include <sofa/core/visual/VisualParams.h>
#include <sofa/helper/ScopedAdvancedTimer.h>
#include <sofa/type/RGBAColor.h>

#include <chrono>
#include <stdexcept>

namespace sofameshwright
{

using sofa::helper::getReadAccessor;
using sofa::helper::getWriteOnlyAccessor;

namespace
{

constexpr int VTK_TETRA = 10;
constexpr int VTK_HEXAHEDRON = 12;
constexpr int VTK_WEDGE = 13;
constexpr int VTK_PYRAMID = 14;

double secondsNow()
{
    using namespace std::chrono;
    return duration<double>(steady_clock::now().time_since_epoch()).count();
}

struct JobCloser { void operator()(mw_job* job) const { mw_job_destroy(job); } };
struct ContextCloser { void operator()(mw_context* context) const { mw_context_destroy(context); } };
struct MeshCloser { void operator()(mw_mesh* mesh) const { mw_mesh_destroy(mesh); } };

} // namespace

MeshwrightEngine::MeshwrightEngine()
    : d_outputPoints(initData(&d_outputPoints, "outputPoints", "Points of the mesh, millimetres"))
    , d_outputTetrahedra(initData(&d_outputTetrahedra, "outputTetras", "Tetrahedra of the mesh"))
    , d_outputHexahedra(initData(&d_outputHexahedra, "outputHexahedra", "Hexahedra of a mixed mesh"))
    , d_outputPrisms(initData(&d_outputPrisms, "outputPrisms", "Prisms (wedges) of a mixed mesh"))
    , d_outputPyramids(initData(&d_outputPyramids, "outputPyramids", "Pyramids of a mixed mesh"))
    , d_outputTetrasDomains(initData(&d_outputTetrasDomains, "outputTetrasDomains", "Label of each tetrahedron"))
    , d_outputCellData(initData(&d_outputCellData, "outputCellData", "Value of each tetrahedron, from labelCellData"))
    , d_outputTriangles(initData(&d_outputTriangles, "outputTriangles", "Triangles around and between the labels"))
    , d_outputTriangleLabels(initData(&d_outputTriangleLabels, "outputTriangleLabels", "Inner label of each triangle"))
    , d_frozen(initData(&d_frozen, false, "frozen", "If true, the mesh is kept and not computed again"))
    , d_threads(initData(&d_threads, 0, "threads", "Number of threads, 0 for one per core"))
    , d_timeLimit(initData(&d_timeLimit, 0.0, "timeLimit", "Longest run in seconds, 0 for no limit"))
    , d_splitToTetrahedra(initData(&d_splitToTetrahedra, true, "splitToTetrahedra", "If true, the mesh has tetrahedra only"))
    , d_parameters(initData(&d_parameters, "parameters", "Any parameter of the job, as name=value"))
    , d_label(initData(&d_label, "label", "Labels that labelCellSize, labelFidelity and labelCellData speak of"))
    , d_labelCellData(initData(&d_labelCellData, "labelCellData", "Value per label, copied to outputCellData"))
    , d_drawTetras(initData(&d_drawTetras, false, "drawTetras", "Draw the tetrahedra"))
    , d_drawSurface(initData(&d_drawSurface, false, "drawSurface", "Draw the surface triangles"))
    , d_minDihedral(initData(&d_minDihedral, 0.0, "minDihedral", "Smallest dihedral angle of the mesh, degrees"))
    , d_maxDihedral(initData(&d_maxDihedral, 0.0, "maxDihedral", "Largest dihedral angle of the mesh, degrees"))
    , d_seconds(initData(&d_seconds, 0.0, "seconds", "Wall time of the last run"))
    , d_findings(initData(&d_findings, "findings", "What the library found about the input and the result"))
{
    addAlias(&d_outputTetrahedra, "outputTetrahedra");
    for (auto* figure : {&d_minDihedral, &d_maxDihedral, &d_seconds})
    {
        figure->setReadOnly(true);
    }
    d_findings.setReadOnly(true);
}

MeshwrightEngine::~MeshwrightEngine() = default;

void MeshwrightEngine::init()
{
    for (sofa::core::objectmodel::BaseData* input : std::initializer_list<sofa::core::objectmodel::BaseData*>{
             &d_frozen, &d_threads, &d_timeLimit, &d_splitToTetrahedra, &d_parameters, &d_label, &d_labelCellData})
    {
        addInput(input);
    }
    for (sofa::core::objectmodel::BaseData* output : std::initializer_list<sofa::core::objectmodel::BaseData*>{
             &d_outputPoints, &d_outputTetrahedra, &d_outputHexahedra, &d_outputPrisms, &d_outputPyramids,
             &d_outputTetrasDomains, &d_outputCellData, &d_outputTriangles, &d_outputTriangleLabels})
    {
        addOutput(output);
    }
    setDirtyValue();
    // Topology containers read the outputs in their own init(), so that the mesh is made now.
    update();
}

void MeshwrightEngine::reinit() { update(); }

void MeshwrightEngine::doUpdate()
{
    if (d_frozen.getValue() && !d_outputPoints.getValue().empty())
    {
        return;
    }
    SCOPED_TIMER("SofaMeshwright");
    try
    {
        runJob();
        d_componentState.setValue(sofa::core::objectmodel::ComponentState::Valid);
    }
    catch (const std::exception& error)
    {
        clearOutputs();
        d_componentState.setValue(sofa::core::objectmodel::ComponentState::Invalid);
        msg_error() << error.what();
    }
}

void MeshwrightEngine::check(int status)
{
    if (status < 0)
    {
        const char* text = mw_last_error();
        throw std::runtime_error(text && *text ? text : mw_status_string(status));
    }
}

void MeshwrightEngine::setParameter(mw_job* job, const std::string& name, const std::string& value)
{
    check(mw_job_set_str(job, name.c_str(), value.c_str()));
}

void MeshwrightEngine::setParameter(mw_job* job, const std::string& name, double value)
{
    check(mw_job_set_f64(job, name.c_str(), value));
}

void MeshwrightEngine::runJob()
{
    mw_context* rawContext = nullptr;
    check(mw_context_create(d_threads.getValue(), &rawContext));
    std::unique_ptr<mw_context, ContextCloser> context(rawContext);
    mw_job* rawJob = nullptr;
    check(mw_job_create(context.get(), jobKind(), &rawJob));
    std::unique_ptr<mw_job, JobCloser> job(rawJob);

    setInputs(context.get(), job.get());
    for (const std::string& assignment : d_parameters.getValue())
    {
        const auto split = assignment.find('=');
        if (split == std::string::npos)
        {
            throw std::runtime_error("parameters: '" + assignment + "' is not of the form name=value");
        }
        setParameter(job.get(), assignment.substr(0, split), assignment.substr(split + 1));
    }

    const double start = secondsNow();
    const double limit = d_timeLimit.getValue();
    if (limit > 0.0)
    {
        check(mw_job_set_time_limit(job.get(), limit));
    }
    m_tenthShown = -1;
    m_stageShown.clear();
    check(mw_job_set_progress(job.get(), &MeshwrightEngine::onProgress, this));
    std::string failure;
    try
    {
        check(mw_job_run(job.get()));
    }
    catch (const std::runtime_error& error)
    {
        // The text of the last error is the run's only until the next call.
        failure = error.what();
    }
    readFindings(job.get());
    if (!failure.empty())
    {
        throw std::runtime_error(failure);
    }

    mw_mesh* rawMesh = nullptr;
    check(mw_job_take_mesh(job.get(), &rawMesh));
    std::unique_ptr<mw_mesh, MeshCloser> mesh(rawMesh);
    readMesh(mesh.get());
    readOwnOutputs(context.get(), job.get());
    for (auto& [figure, name] : {std::pair{&d_minDihedral, "quality.min_dihedral"}, std::pair{&d_maxDihedral, "quality.max_dihedral"}})
    {
        double value = 0.0;
        figure->setValue(mw_job_stat(job.get(), name, &value) == MW_OK ? value : 0.0);
    }
    d_seconds.setValue(secondsNow() - start);
    msg_info() << d_outputPoints.getValue().size() << " points, " << d_outputTetrahedra.getValue().size()
               << " tetrahedra in " << d_seconds.getValue() << " s, dihedral angles " << d_minDihedral.getValue() << " to "
               << d_maxDihedral.getValue() << " degrees";
}

int MeshwrightEngine::onProgress(void* user, const char* stage, double done)
{
    static_cast<MeshwrightEngine*>(user)->showProgress(stage, done);
    // Zero goes on: SOFA has no way to interrupt the loading of a scene; timeLimit stands in for it.
    return 0;
}

void MeshwrightEngine::showProgress(const char* stage, double done)
{
    const int tenth = static_cast<int>(10.0 * done);
    if (tenth != m_tenthShown || m_stageShown != stage)
    {
        m_tenthShown = tenth;
        m_stageShown = stage;
        msg_info() << stage << ": " << static_cast<int>(100.0 * done) << " %";
    }
}

void MeshwrightEngine::clearOutputs()
{
    getWriteOnlyAccessor(d_outputPoints).clear();
    getWriteOnlyAccessor(d_outputTetrahedra).clear();
    getWriteOnlyAccessor(d_outputHexahedra).clear();
    getWriteOnlyAccessor(d_outputPrisms).clear();
    getWriteOnlyAccessor(d_outputPyramids).clear();
    getWriteOnlyAccessor(d_outputTetrasDomains).clear();
    getWriteOnlyAccessor(d_outputCellData).clear();
    getWriteOnlyAccessor(d_outputTriangles).clear();
    getWriteOnlyAccessor(d_outputTriangleLabels).clear();
    clearOwnOutputs();
}

void MeshwrightEngine::readMesh(const mw_mesh* mesh)
{
    clearOutputs();
    const int64_t pointCount = mw_mesh_point_count(mesh);
    const double* xyz = mw_mesh_points(mesh);
    auto points = getWriteOnlyAccessor(d_outputPoints);
    points.resize(static_cast<std::size_t>(pointCount));
    for (int64_t i = 0; i < pointCount; ++i)
    {
        points[i] = Coord(Real(xyz[3 * i]), Real(xyz[3 * i + 1]), Real(xyz[3 * i + 2]));
    }

    auto tetrahedra = getWriteOnlyAccessor(d_outputTetrahedra);
    auto hexahedra = getWriteOnlyAccessor(d_outputHexahedra);
    auto prisms = getWriteOnlyAccessor(d_outputPrisms);
    auto pyramids = getWriteOnlyAccessor(d_outputPyramids);
    auto domains = getWriteOnlyAccessor(d_outputTetrasDomains);
    auto cellData = getWriteOnlyAccessor(d_outputCellData);
    const auto labels = getReadAccessor(d_label);
    const auto values = getReadAccessor(d_labelCellData);
    const int64_t cellCount = mw_mesh_cell_count(mesh);
    const uint8_t* types = mw_mesh_cell_types(mesh);
    const int64_t* offsets = mw_mesh_offsets(mesh);
    const int32_t* connectivity = mw_mesh_connectivity(mesh);
    const int32_t* cellLabels = mw_mesh_labels(mesh);
    for (int64_t cell = 0; cell < cellCount; ++cell)
    {
        const int32_t* v = connectivity + offsets[cell];
        switch (types[cell])
        {
        case VTK_TETRA:
        {
            tetrahedra.push_back(Topology::Tetra(v[0], v[1], v[2], v[3]));
            domains.push_back(cellLabels[cell]);
            double value = 0.0;
            for (std::size_t k = 0; k < labels.size() && k < values.size(); ++k)
            {
                if (labels[k] == cellLabels[cell]) { value = values[k]; }
            }
            cellData.push_back(value);
            break;
        }
        case VTK_HEXAHEDRON:
            hexahedra.push_back(Topology::Hexa(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7]));
            break;
        case VTK_WEDGE:
            prisms.push_back({{unsigned(v[0]), unsigned(v[1]), unsigned(v[2]), unsigned(v[3]), unsigned(v[4]), unsigned(v[5])}});
            break;
        case VTK_PYRAMID:
            pyramids.push_back({{unsigned(v[0]), unsigned(v[1]), unsigned(v[2]), unsigned(v[3]), unsigned(v[4])}});
            break;
        default:
            throw std::runtime_error("an element of VTK type " + std::to_string(types[cell]) + " has no place in SOFA");
        }
    }

    mw_boundary boundary = {};
    boundary.struct_size = sizeof(boundary);
    check(mw_mesh_boundary(mesh, &boundary));
    auto triangles = getWriteOnlyAccessor(d_outputTriangles);
    auto sides = getWriteOnlyAccessor(d_outputTriangleLabels);
    for (int64_t i = 0; i < boundary.triangle_count; ++i)
    {
        const int32_t* v = boundary.triangles + 3 * i;
        triangles.push_back(Topology::Triangle(v[0], v[1], v[2]));
        sides.push_back(boundary.labels[2 * i]);
    }
}

void MeshwrightEngine::readFindings(const mw_job* job)
{
    auto findings = getWriteOnlyAccessor(d_findings);
    findings.clear();
    const int64_t count = mw_job_diag_count(job);
    for (int64_t i = 0; i < count; ++i)
    {
        mw_diag finding = {};
        finding.struct_size = sizeof(finding);
        if (mw_job_diag_get(job, i, &finding) == MW_OK && finding.text)
        {
            findings.push_back(finding.text);
            if (finding.severity > 0)
            {
                msg_warning() << finding.text;
            }
        }
    }
}

void MeshwrightEngine::draw(const sofa::core::visual::VisualParams* vparams)
{
    if (d_componentState.getValue() != sofa::core::objectmodel::ComponentState::Valid)
    {
        return;
    }
    const auto points = getReadAccessor(d_outputPoints);
    auto* tool = vparams->drawTool();
    if (d_drawTetras.getValue())
    {
        std::vector<sofa::type::Vec3> corners;
        for (const auto& tetra : getReadAccessor(d_outputTetrahedra))
        {
            for (const auto vertex : tetra) { corners.push_back(points[vertex]); }
        }
        tool->drawScaledTetrahedra(corners, sofa::type::RGBAColor(0.3f, 0.6f, 0.9f, 1.0f), 0.8f);
    }
    if (d_drawSurface.getValue())
    {
        std::vector<sofa::type::Vec3> corners;
        for (const auto& triangle : getReadAccessor(d_outputTriangles))
        {
            for (const auto vertex : triangle) { corners.push_back(points[vertex]); }
        }
        tool->drawTriangles(corners, sofa::type::RGBAColor(0.9f, 0.8f, 0.6f, 1.0f));
    }
}

} // namespace sofameshwright
