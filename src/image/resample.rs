//! Images on other grids, through any map of points.
//!
//! # Method
//! For every voxel of the wanted grid: its world point, mapped to the source's world, interpolated there.
//!
//! # Cost
//! Parallel over slices; each voxel is computed alone, so the result does not depend on the number of threads.

use glam::DVec3;
use rayon::prelude::*;

use crate::error::Result;
use crate::image::grid::Grid;
use crate::image::interpolation::{linear, nearest_offset};
use crate::image::label_image::LabelImage;
use crate::image::scalar_image::ScalarImage;
use crate::index::Label;

/// Calls `value(world point of the voxel, its offset)` for every voxel of a grid, in parallel over slices.
pub fn map_voxels<T: Send + Default + Clone>(grid: &Grid, value: impl Fn(DVec3, usize) -> T + Sync) -> Vec<T> {
    let [ni, nj, _] = grid.size();
    let mut voxels = vec![T::default(); grid.voxel_count()];
    let step = grid.direction() * DVec3::new(grid.spacing().x, 0.0, 0.0);
    voxels.par_chunks_mut(ni).enumerate().for_each(|(row, values)| {
        let start = grid.index_to_world(DVec3::new(0.0, (row % nj) as f64, (row / nj) as f64));
        for (i, slot) in values.iter_mut().enumerate() {
            *slot = value(start + step * i as f64, row * ni + i);
        }
    });
    voxels
}

/// A scan on `grid`, linearly interpolated at `map(world point)`; its background outside.
///
/// # Errors
/// None for a valid grid.
pub fn resample_linear(image: &ScalarImage, grid: &Grid, map: impl Fn(DVec3) -> DVec3 + Sync) -> Result<ScalarImage> {
    let voxels = map_voxels(grid, |point, _| linear(image, image.grid().world_to_index(map(point))));
    ScalarImage::new(*grid, voxels, image.background())
}

/// Labels on `grid`, taken from the nearest voxel at `map(world point)`; background outside.
///
/// # Errors
/// None for a valid grid.
pub fn resample_labels(image: &LabelImage, grid: &Grid, map: impl Fn(DVec3) -> DVec3 + Sync) -> Result<LabelImage> {
    let size = image.grid().size();
    let voxels = map_voxels(grid, |point, _| {
        nearest_offset(size, image.grid().world_to_index(map(point))).map_or(Label::BACKGROUND, |at| image.voxels()[at])
    });
    LabelImage::new(*grid, voxels, image.values().to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat3;

    #[test]
    fn a_shifted_image_is_found_at_the_shift() {
        let grid = Grid::new([8, 8, 8], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let voxels = map_voxels(&grid, |p, _| (p.x * 2.0 + p.y - p.z) as f32);
        let image = ScalarImage::new(grid, voxels, -7.0).unwrap();
        let shift = DVec3::new(1.5, 0.0, 2.0);
        let moved = resample_linear(&image, &grid, |p| p + shift).unwrap();
        assert!((moved.voxels()[grid.offset(2, 3, 4)] - (7.0 + 3.0 - 6.0)).abs() < 1e-5);
        assert_eq!(moved.voxels()[grid.offset(7, 3, 4)], -7.0);
    }
}
