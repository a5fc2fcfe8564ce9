//! Segmented image to mesh by adaptive body-centred cubic lattice refinement (CBC3D).
//!
//! # Method
//! 1. Clean-up of the voxels (`image::morphology`, [`voxel_cleanup`]): up-sampling, isolated voxels, regions, contacts.
//! 2. Exact distance transform of all labels in one pass (`image::distance_transform`).
//! 3. Body-centred cubic tets over the labelled region ([`bcc_lattice`]).
//! 4. Red-green refinement ([`red_green`]) where the distance changes sign ([`subdivision_criteria`]) until the
//!    voxel count of every label reaches its fidelity ([`voxel_fidelity`]).
//! 5. Labels by centroid, relabelled so that surfaces can move ([`element_labels`]).
//! 6. Topology of the sub-meshes ([`interface_topology`]).
//! 7. Merging into hexahedra and pyramids ([`mixed_elements`]).
//! 8. Physics-based smoothing of the [`CandidateMesh`].
//! 9. World coordinates, surfaces, mid-edge nodes, duplicated interfaces ([`finishing`]), evaluation.
//!
//! # Source
//! [Drakopoulos2017] chapter 2; [Molino2003] for the lattice and its refinement.

pub mod candidate_mesh;
pub mod options;

pub use candidate_mesh::CandidateMesh;
pub use options::{Options, PARAMETERS};
