//! Which voxels of a scan belong to the patient.
//!
//! # Method
//! In a skull-stripped scan everything but the background value, more than a small share of the range away from it. A mask
//! from the caller replaces this.
//!
//! # Limits
//! A scan that is not skull-stripped has the whole head as foreground; it needs a mask.

use crate::error::{Error, Result};
use crate::image::interpolation::nearest_offset;
use crate::image::label_image::LabelImage;
use crate::image::resample::map_voxels;
use crate::image::scalar_image::ScalarImage;
use crate::index::Label;

/// Values this near to the background, as a share of the range, are background: rounding and interpolation.
const NEAR_BACKGROUND: f32 = 0.02;

/// Share of the brightest voxels that does not count for the range.
const BRIGHTEST: f64 = 0.005;

/// The foreground of a scan, or the voxels of `mask`, which may have another grid.
///
/// # Errors
/// [`Error::InvalidInput`] for a constant scan, or a mask that misses the scan.
pub fn foreground(scan: &ScalarImage, mask: Option<&LabelImage>, name: &str) -> Result<Vec<bool>> {
    let (low, high) = scan.range();
    if low >= high {
        return Err(Error::input(format!("the {name} scan is constant: every voxel is {low}")));
    }
    let inside: Vec<bool> = match mask {
        Some(mask) => map_voxels(scan.grid(), |point, _| {
            let at = nearest_offset(mask.grid().size(), mask.grid().world_to_index(point));
            at.is_some_and(|at| mask.voxels()[at] != Label::BACKGROUND)
        }),
        None => {
            let limit = NEAR_BACKGROUND * (bright_value(scan) - scan.background()).abs().max(f32::MIN_POSITIVE);
            scan.voxels().iter().map(|v| (v - scan.background()).abs() > limit).collect()
        }
    };
    if !inside.contains(&true) {
        return Err(Error::input(format!("the mask of the {name} scan covers none of its voxels")));
    }
    Ok(inside)
}

/// A value that nearly all voxels of the foreground stay below.
pub fn bright_value(scan: &ScalarImage) -> f32 {
    let mut values: Vec<f32> = scan.voxels().iter().copied().filter(|v| *v != scan.background()).collect();
    if values.is_empty() {
        return scan.background();
    }
    let at = ((values.len() - 1) as f64 * (1.0 - BRIGHTEST)) as usize;
    *values.select_nth_unstable_by(at, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use glam::{DMat3, DVec3};

    #[test]
    fn constant_scans_are_refused() {
        let grid = Grid::new([3, 3, 3], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let flat = ScalarImage::new(grid, vec![4.0; 27], 0.0).unwrap();
        assert!(foreground(&flat, None, "fixed").unwrap_err().to_string().contains("constant"));
        let mut values = vec![0.0; 27];
        values[13] = 5.0;
        let scan = ScalarImage::new(grid, values, 0.0).unwrap();
        assert_eq!(foreground(&scan, None, "fixed").unwrap().iter().filter(|f| **f).count(), 1);
    }
}
