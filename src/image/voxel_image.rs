//! An image as files and hosts hold it: any voxel type, any number of components.
//!
//! # Invariants
//! `data` holds `grid.voxel_count() * components` values, components fastest, then i, j, k.

use crate::image::grid::Grid;

/// Voxel values of one of ten types.
#[derive(Debug, Clone, PartialEq)]
#[allow(missing_docs)]
pub enum VoxelData {
    U8(Vec<u8>),
    I8(Vec<i8>),
    U16(Vec<u16>),
    I16(Vec<i16>),
    U32(Vec<u32>),
    I32(Vec<i32>),
    U64(Vec<u64>),
    I64(Vec<i64>),
    F32(Vec<f32>),
    F64(Vec<f64>),
}

/// A voxel image of any type.
#[derive(Debug, Clone, PartialEq)]
pub struct VoxelImage {
    /// Where the voxels are.
    pub grid: Grid,
    /// Values per voxel: 1 for scans and labels, 3 for displacement fields.
    pub components: usize,
    /// The values.
    pub data: VoxelData,
}
