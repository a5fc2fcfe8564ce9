//! Surface triangulation to tetrahedra that keep the surface exactly (CDT3D).
//!
//! # Method
//! 1. `input_check`: everything that is wrong with the surface; an invalid one ends here.
//! 2. `delaunay_kernel`: Delaunay tetrahedralization of the surface's points.
//! 3. `boundary_recovery`: every edge and facet of the surface becomes an edge and a face of the mesh.
//! 4. `domain_labels`: outside is removed, regions get their labels.
//! 5. Refinement and quality improvement, where asked for.
//!
//! # Source
//! [Drakopoulos2017] chapter 4, [Drakopoulos2019].
//!
//! # Invariants
//! The surface's points are the first points of the mesh, bit for bit, in their order (equal points merged, unused
//! ones left out); every facet is a face of the mesh; no other point lies on the surface.

pub mod boundary_recovery;
mod cavity;
pub mod delaunay_kernel;
mod delaunay_parallel;
pub mod domain_labels;
pub mod enclosure;
pub mod fault_picture;
pub mod flip_criteria;
pub mod flips;
pub mod front;
pub mod input_check;
mod kernel_mesh;
pub mod local_reconnection;
pub mod options;
pub mod parallel_reconnection;
pub mod point_filter;
mod point_location;
pub mod point_placement;
pub mod quality_improvement;
pub mod refinement;
pub mod report;
pub mod sliver_removal;
pub mod smoothing;
pub mod vertex_insertion;

#[cfg(test)]
pub(crate) mod test_surfaces;
