//! Meshes: the editable tet complex, the finished mixed mesh, surfaces, quality and validation.

pub mod boundary;
pub mod claimed_tets;
pub mod fidelity;
pub mod mixed_mesh;
pub mod numbering;
pub mod quality;
pub mod renumbering;
pub mod size_field;
pub mod sizing;
pub mod surface_mesh;
pub mod tet_complex;
pub mod tet_flags;
pub mod tet_store;
pub mod topology;
pub mod validation;
