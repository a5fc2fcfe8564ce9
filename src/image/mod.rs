//! Images: where voxels are in the world, and what they hold.

pub mod grid;
pub mod label_image;
pub mod voxel_image;
