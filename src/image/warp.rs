//! Images, points and back, through a displacement field.
//!
//! # Method
//! A field on the fixed grid maps fixed points to moving points, so the moving image is pulled onto any grid of the fixed
//! scan by interpolation: linearly for scans, nearest voxel for labels. Outside of the field its border value holds.
//!
//! # Cost
//! One pass, parallel over rows, same result for any number of threads.

use glam::DVec3;

use crate::error::Result;
use crate::image::grid::Grid;
use crate::image::label_image::LabelImage;
use crate::image::resample::{resample_labels, resample_linear};
use crate::image::scalar_image::ScalarImage;
use crate::image::vector_image::VectorImage;

/// A scan of the moving space on `grid` of the fixed space.
///
/// # Errors
/// None for a valid grid.
pub fn warp_scan(image: &ScalarImage, field: &VectorImage, grid: &Grid) -> Result<ScalarImage> {
    resample_linear(image, grid, |point| point + field.at_clamped(point))
}

/// Labels of the moving space on `grid` of the fixed space.
///
/// # Errors
/// None for a valid grid.
pub fn warp_labels(image: &LabelImage, field: &VectorImage, grid: &Grid) -> Result<LabelImage> {
    resample_labels(image, grid, |point| point + field.at_clamped(point))
}

/// The point that the field maps `point` to; its border value holds outside.
#[inline]
pub fn warp_point(field: &VectorImage, point: DVec3) -> DVec3 {
    point + field.at_clamped(point)
}
