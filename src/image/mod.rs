//! Images: where voxels are in the world, and what they hold.

pub mod connected_components;
pub mod contact_costs;
pub mod contact_removal;
pub mod distance_transform;
pub mod euler_numbers;
pub mod gaussian;
pub mod gradient;
pub mod grid;
pub mod interpolation;
pub mod label_contacts;
pub mod label_image;
pub mod morphology;
pub mod resample;
pub mod scalar_image;
pub mod simple_voxels;
pub mod vector_image;
pub mod voxel_blocks;
pub mod voxel_contacts;
pub mod voxel_image;
pub mod voxel_index;
pub mod warp;
