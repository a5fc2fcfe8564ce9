//! A displacement field in memory: one vector per voxel, world millimetres.
//!
//! # Method
//! The vector of a voxel is added to the voxel's world point; between voxels the vectors are interpolated linearly, outside of
//! the grid by more than half a voxel the displacement is not defined.
//!
//! # Invariants
//! One finite vector per voxel of the grid, i fastest. Vectors are in the frame of the world (LPS), not of the grid.

use glam::{DVec3, Vec3};

use crate::error::{Error, Result};
use crate::image::grid::Grid;
use crate::image::interpolation::Stencil;
use crate::image::voxel_image::{VoxelData, VoxelImage};

/// A field, 12 bytes per voxel.
#[derive(Debug, Clone, PartialEq)]
pub struct VectorImage {
    grid: Grid,
    vectors: Vec<Vec3>,
}

impl VectorImage {
    /// A field from its vectors.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] for a wrong number of vectors or one that is not finite.
    pub fn new(grid: Grid, vectors: Vec<Vec3>) -> Result<Self> {
        if vectors.len() != grid.voxel_count() {
            return Err(Error::argument("vectors", format!("{} for {} voxels", vectors.len(), grid.voxel_count())));
        }
        if let Some(at) = vectors.iter().position(|v| !v.is_finite()) {
            return Err(Error::argument("vectors", format!("vector {at} is not finite")));
        }
        Ok(Self { grid, vectors })
    }

    /// A field without displacement.
    pub fn zero(grid: Grid) -> Self {
        Self { grid, vectors: vec![Vec3::ZERO; grid.voxel_count()] }
    }

    /// A field from an image with three components.
    ///
    /// # Errors
    /// [`Error::InvalidInput`] for another number of components; as [`VectorImage::new`].
    pub fn from_voxel_image(image: &VoxelImage) -> Result<Self> {
        if image.components != 3 {
            return Err(Error::input(format!(
                "a displacement field has 3 components, this image {}",
                image.components
            )));
        }
        let values = image.to_f32();
        Self::new(image.grid, values.as_chunks::<3>().0.iter().map(|v| Vec3::from_array(*v)).collect())
    }

    /// The field as an image with three components for a writer.
    pub fn to_voxel_image(&self) -> VoxelImage {
        let values = self.vectors.iter().flat_map(|v| v.to_array()).collect();
        VoxelImage { grid: self.grid, components: 3, data: VoxelData::F32(values) }
    }

    /// Where the voxels are.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Vectors, i fastest, world mm.
    pub fn vectors(&self) -> &[Vec3] {
        &self.vectors
    }

    /// Vectors for changing; the caller keeps them finite.
    pub fn vectors_mut(&mut self) -> &mut [Vec3] {
        &mut self.vectors
    }

    /// The displacement at a continuous index; `None` outside.
    #[inline]
    pub fn at_index(&self, index: DVec3) -> Option<Vec3> {
        Stencil::at(self.grid.size(), index).map(|stencil| stencil.blend(&self.vectors))
    }

    /// The displacement at a world point; `None` outside.
    #[inline]
    pub fn at(&self, world: DVec3) -> Option<DVec3> {
        self.at_index(self.grid.world_to_index(world)).map(Vec3::as_dvec3)
    }

    /// The displacement at the nearest point of the grid's box, so that it is defined everywhere.
    #[inline]
    pub fn at_clamped(&self, world: DVec3) -> DVec3 {
        let size = self.grid.size();
        let last = DVec3::new(size[0] as f64 - 1.0, size[1] as f64 - 1.0, size[2] as f64 - 1.0);
        let index = self.grid.world_to_index(world).clamp(DVec3::ZERO, last);
        Stencil::at(size, index).map_or(DVec3::ZERO, |stencil| stencil.blend(&self.vectors).as_dvec3())
    }
}
