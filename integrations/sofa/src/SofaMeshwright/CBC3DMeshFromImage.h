// A segmented image (file or raw data) becomes a tetrahedral mesh.
#pragma once

#include <SofaMeshwright/MeshwrightEngine.h>

#include <sofa/core/objectmodel/DataFileName.h>
#include <sofa/type/Mat.h>

namespace sofameshwright
{

/// Body-centred cubic lattice refinement of a segmented image, with smooth label surfaces.
class SOFA_SOFAMESHWRIGHT_API CBC3DMeshFromImage : public MeshwrightEngine
{
public:
    SOFA_CLASS(CBC3DMeshFromImage, MeshwrightEngine);

    void init() override;

    sofa::core::objectmodel::DataFileName d_filename;       ///< .nii .nii.gz .nrrd .nhdr .mha .mhd
    sofa::Data<sofa::type::vector<int>> d_labels;           ///< raw voxels, x fastest
    sofa::Data<sofa::type::Vec<3, int>> d_dimensions;       ///< voxels of `labels`
    sofa::Data<sofa::type::Vec3> d_spacing;                 ///< mm between voxel centres
    sofa::Data<sofa::type::Mat4x4> d_imageToWorld;          ///< replaces spacing: voxel index to world mm
    sofa::Data<VecCoord> d_features;                        ///< points that become vertices

    sofa::Data<double> d_cellSize;                          ///< spacing of the coarse lattice, mm; 0: from the image
    sofa::Data<double> d_fidelity;                          ///< 0 to 1
    sofa::Data<int> d_smoothingIterations;                  ///< -1: the library's default
    sofa::Data<sofa::type::vector<double>> d_labelCellSize; ///< largest edge per entry of `label`, mm
    sofa::Data<sofa::type::vector<double>> d_labelFidelity; ///< fidelity per entry of `label`

protected:
    CBC3DMeshFromImage();
    int jobKind() const override;
    void setInputs(mw_context* context, mw_job* job) override;
};

} // namespace sofameshwright
