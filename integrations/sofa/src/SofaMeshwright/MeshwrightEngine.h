// What the three components share: outputs, parameters by name, running a job, errors as component state.
#pragma once

#include <SofaMeshwright/config.h>

#include <sofa/core/DataEngine.h>
#include <sofa/core/topology/BaseMeshTopology.h>
#include <sofa/defaulttype/VecTypes.h>

#include <memory>
#include <string>

struct mw_job;
struct mw_mesh;
struct mw_context;

namespace sofameshwright
{

/// Base of the components. A run that fails leaves every output empty, writes one message and sets the component
/// invalid; it never throws into the scene.
class SOFA_SOFAMESHWRIGHT_API MeshwrightEngine : public sofa::core::DataEngine
{
public:
    SOFA_ABSTRACT_CLASS(MeshwrightEngine, sofa::core::DataEngine);

    typedef sofa::defaulttype::Vec3Types::Coord Coord;
    typedef sofa::defaulttype::Vec3Types::Real Real;
    typedef sofa::defaulttype::Vec3Types::VecCoord VecCoord;
    typedef sofa::core::topology::BaseMeshTopology Topology;

    void init() override;
    void reinit() override;
    void doUpdate() override;
    void draw(const sofa::core::visual::VisualParams* vparams) override;

    // Outputs, under the names that scenes for CGALPlugin use.
    sofa::Data<VecCoord> d_outputPoints;                        ///< points, world mm
    sofa::Data<Topology::SeqTetrahedra> d_outputTetrahedra;     ///< tetrahedra
    sofa::Data<Topology::SeqHexahedra> d_outputHexahedra;       ///< hexahedra of mixed meshes
    sofa::Data<sofa::type::vector<sofa::type::fixed_array<unsigned int, 6>>> d_outputPrisms;   ///< wedges
    sofa::Data<sofa::type::vector<sofa::type::fixed_array<unsigned int, 5>>> d_outputPyramids; ///< pyramids
    sofa::Data<sofa::type::vector<int>> d_outputTetrasDomains;  ///< label of each tetrahedron
    sofa::Data<sofa::type::vector<double>> d_outputCellData;    ///< value of each tetrahedron, from labelCellData
    sofa::Data<Topology::SeqTriangles> d_outputTriangles;       ///< triangles around and between labels
    sofa::Data<sofa::type::vector<int>> d_outputTriangleLabels; ///< inner label of each triangle

    // Control.
    sofa::Data<bool> d_frozen;                                  ///< true: keep the mesh, do not compute again
    sofa::Data<int> d_threads;                                  ///< 0: one per core
    sofa::Data<double> d_timeLimit;                             ///< seconds, 0: none
    sofa::Data<bool> d_splitToTetrahedra;                       ///< true: mixed elements are turned off
    sofa::Data<sofa::type::vector<std::string>> d_parameters;   ///< "name=value", every parameter of the job
    sofa::Data<sofa::type::vector<int>> d_label;                ///< labels that the per-label lists speak of
    sofa::Data<sofa::type::vector<double>> d_labelCellData;     ///< value per label for outputCellData
    sofa::Data<bool> d_drawTetras;                              ///< draw the tetrahedra
    sofa::Data<bool> d_drawSurface;                             ///< draw the surface

    // Figures of the last run, read only.
    sofa::Data<double> d_minDihedral;                           ///< degrees
    sofa::Data<double> d_maxDihedral;                           ///< degrees
    sofa::Data<double> d_seconds;                               ///< wall time of the run
    sofa::Data<sofa::type::vector<std::string>> d_findings;     ///< what the library found about the data

protected:
    MeshwrightEngine();
    ~MeshwrightEngine() override;

    /// Number of the library's kind of job.
    virtual int jobKind() const = 0;
    /// Hands the inputs to the job; throws std::runtime_error with a message for the user.
    virtual void setInputs(mw_context* context, mw_job* job) = 0;
    /// Empties the outputs of the derived component.
    virtual void clearOwnOutputs() {}
    /// Reads what only the derived component has.
    virtual void readOwnOutputs(mw_context*, mw_job*) {}

    /// Throws std::runtime_error with the library's message where `status` is an error.
    static void check(int status);
    /// Sets a parameter of the job from text; throws as check().
    static void setParameter(mw_job* job, const std::string& name, const std::string& value);
    static void setParameter(mw_job* job, const std::string& name, double value);

private:
    void runJob();
    void clearOutputs();
    void readMesh(const mw_mesh* mesh);
    void readFindings(const mw_job* job);
    void showProgress(const char* stage, double done);

    static int onProgress(void* user, const char* stage, double done);

    int m_tenthShown = -1;
    std::string m_stageShown;
};

} // namespace sofameshwright
