//! Points, predicates and searches; knows nothing of meshes and images.
//!
//! # Invariants
//! Exact predicates decide topology; floating point only measures. Sign convention: [`predicates::orient3d`] is
//! positive for a tet in VTK's order.

pub mod predicates;
pub mod tetrahedron;
