//! A scan in memory: one real value per voxel.
//!
//! # Method
//! Values are kept in single precision, whatever the file held. What is not finite lies outside of the patient, so it becomes
//! the background value: the most frequent value on the faces of the image where most of the border shares it, else the smallest.
//!
//! # Invariants
//! One finite value per voxel of the grid, i fastest; at least one voxel.

use crate::error::{Error, Result};
use crate::image::grid::Grid;
use crate::image::voxel_image::{VoxelData, VoxelImage};

/// A scan, 4 bytes per voxel.
#[derive(Debug, Clone, PartialEq)]
pub struct ScalarImage {
    grid: Grid,
    voxels: Vec<f32>,
    background: f32,
}

impl ScalarImage {
    /// An image from finite values; `background` is what lies outside.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] for a wrong number of values.
    pub fn new(grid: Grid, voxels: Vec<f32>, background: f32) -> Result<Self> {
        if voxels.len() != grid.voxel_count() {
            return Err(Error::argument("voxels", format!("{} for {} voxels", voxels.len(), grid.voxel_count())));
        }
        Ok(Self { grid, voxels, background })
    }

    /// A scan from an image as read; also says how many voxels were not finite.
    ///
    /// # Errors
    /// [`Error::InvalidInput`] for more than one component, or no finite value at all.
    pub fn from_voxel_image(image: &VoxelImage) -> Result<(Self, usize)> {
        if image.components != 1 {
            return Err(Error::input(format!("a scan has one value per voxel, this image has {}", image.components)));
        }
        let mut voxels = image.to_f32();
        let background = background_value(&image.grid, &voxels)
            .ok_or_else(|| Error::input("the scan has no finite value: every voxel is NaN or infinite"))?;
        let mut replaced = 0;
        for value in voxels.iter_mut().filter(|v| !v.is_finite()) {
            *value = background;
            replaced += 1;
        }
        Ok((Self { grid: image.grid, voxels, background }, replaced))
    }

    /// The image as 32-bit reals for a writer.
    pub fn into_voxel_image(self) -> VoxelImage {
        VoxelImage { grid: self.grid, components: 1, data: VoxelData::F32(self.voxels) }
    }

    /// Where the voxels are.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Values, i fastest.
    pub fn voxels(&self) -> &[f32] {
        &self.voxels
    }

    /// Values for changing; the caller keeps them finite.
    pub fn voxels_mut(&mut self) -> &mut [f32] {
        &mut self.voxels
    }

    /// The values alone.
    pub fn into_voxels(self) -> Vec<f32> {
        self.voxels
    }

    /// What lies outside of the image.
    pub fn background(&self) -> f32 {
        self.background
    }

    /// Smallest and largest value.
    pub fn range(&self) -> (f32, f32) {
        self.voxels.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), &v| (low.min(v), high.max(v)))
    }
}

/// The value outside of the patient; `None` where no value is finite.
fn background_value(grid: &Grid, voxels: &[f32]) -> Option<f32> {
    let [ni, nj, nk] = grid.size();
    let mut border = Vec::new();
    for k in 0..nk {
        for j in 0..nj {
            let step = if k == 0 || j == 0 || k + 1 == nk || j + 1 == nj || ni == 1 { 1 } else { ni - 1 };
            border.extend((0..ni).step_by(step).map(|i| voxels[grid.offset(i, j, k)]).filter(|v| v.is_finite()));
        }
    }
    let smallest = voxels.iter().copied().filter(|v| v.is_finite()).min_by(f32::total_cmp)?;
    border.sort_unstable_by(f32::total_cmp);
    let most = border.chunk_by(|a, b| a == b).max_by_key(|run| run.len());
    Some(most.filter(|run| 2 * run.len() > border.len()).map_or(smallest, |run| run[0]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3};

    fn image(values: Vec<f32>) -> VoxelImage {
        let grid = Grid::new([values.len(), 1, 1], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        VoxelImage::new(grid, 1, VoxelData::F32(values)).unwrap()
    }

    #[test]
    fn voxels_that_are_not_finite_become_background() {
        let (scan, replaced) =
            ScalarImage::from_voxel_image(&image(vec![0.0, 0.0, f32::NAN, 5.0, f32::INFINITY, 0.0, 0.0])).unwrap();
        assert_eq!((replaced, scan.background()), (2, 0.0));
        assert_eq!(scan.voxels(), [0.0, 0.0, 0.0, 5.0, 0.0, 0.0, 0.0]);
        assert!(ScalarImage::from_voxel_image(&image(vec![f32::NAN])).is_err());
    }
}
