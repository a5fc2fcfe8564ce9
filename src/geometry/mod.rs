//! Points, predicates and searches; knows nothing of meshes and images.
//!
//! # Invariants
//! Exact predicates decide topology; floating point only measures. Sign convention: [`predicates::orient3d`] is
//! positive for a tet in VTK's order.

pub mod aabb_tree;
pub mod bounding_box;
pub mod double_double;
pub mod fixed_point;
pub mod granularity;
pub mod intersection;
pub mod perturbation;
pub mod point_grid;
pub mod predicates;
pub mod segment;
pub mod spatial_sort;
pub mod star_kernel;
pub mod tetrahedron;
pub mod triangle;
