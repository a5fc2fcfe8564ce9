// A closed surface triangulation becomes a tetrahedral mesh that keeps every one of its triangles.
#pragma once

#include <SofaMeshwright/MeshwrightEngine.h>

#include <sofa/core/objectmodel/DataFileName.h>

namespace sofameshwright
{

/// Boundary-conforming tetrahedralization with advancing-front points; the surface stays as it is.
class SOFA_SOFAMESHWRIGHT_API CDT3DMeshFromSurface : public MeshwrightEngine
{
public:
    SOFA_CLASS(CDT3DMeshFromSurface, MeshwrightEngine);

    void init() override;

    sofa::core::objectmodel::DataFileName d_filename;  ///< .stl .off .obj .ply .vtk .vtp .mesh .surf .poly
    sofa::Data<VecCoord> d_inputPoints;                ///< surface points, used when no file is named
    sofa::Data<Topology::SeqTriangles> d_inputTriangles; ///< surface triangles
    sofa::Data<Topology::SeqQuads> d_inputQuads;       ///< surface quads, split into triangles
    sofa::Data<VecCoord> d_holes;                      ///< points in cavities that stay empty
    sofa::Data<bool> d_refine;                         ///< false: no points in the volume but what the surface needs
    sofa::Data<double> d_cellSize;                     ///< largest element size, 0: from the surface
    sofa::Data<double> d_cellRatio;                    ///< growth from small to large elements, 0: the default

protected:
    CDT3DMeshFromSurface();
    int jobKind() const override;
    void setInputs(mw_context* context, mw_job* job) override;
};

} // namespace sofameshwright
