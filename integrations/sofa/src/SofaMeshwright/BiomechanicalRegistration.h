// Two scans of a patient become a deformed mesh, with the displacement of every node and the matched blocks.
#pragma once

#include <SofaMeshwright/MeshwrightEngine.h>

#include <sofa/core/objectmodel/DataFileName.h>

namespace sofameshwright
{

/// Physics-based non-rigid registration of a preoperative scan to an intraoperative one.
class SOFA_SOFAMESHWRIGHT_API BiomechanicalRegistration : public MeshwrightEngine
{
public:
    SOFA_CLASS(BiomechanicalRegistration, MeshwrightEngine);

    void init() override;

    sofa::core::objectmodel::DataFileName d_movingImage;    ///< preoperative scan
    sofa::core::objectmodel::DataFileName d_fixedImage;     ///< intraoperative scan
    sofa::core::objectmodel::DataFileName d_segmentedImage; ///< segmentation of the moving scan
    sofa::core::objectmodel::DataFileName d_outputField;    ///< where to write the displacement field; empty: nowhere
    sofa::core::objectmodel::DataFileName d_outputImage;    ///< where to write the warped scan; empty: nowhere
    sofa::Data<bool> d_tumorResection;                      ///< tissue was removed between the scans

    sofa::Data<VecCoord> d_outputDisplacements;             ///< from the moving to the fixed scan, one per outputPoints, mm
    sofa::Data<VecCoord> d_sourcePoints;                    ///< centres of the matched blocks
    sofa::Data<VecCoord> d_targetPoints;                    ///< where they were found

protected:
    BiomechanicalRegistration();
    int jobKind() const override;
    void setInputs(mw_context* context, mw_job* job) override;
    void clearOwnOutputs() override;
    void readOwnOutputs(mw_context* context, mw_job* job) override;
};

} // namespace sofameshwright
