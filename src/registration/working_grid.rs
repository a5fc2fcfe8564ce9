//! The isotropic grid that both scans are compared on.
//!
//! # Method
//! Axes along those of the fixed scan, orthonormal and right-handed; origin and size such that the fixed foreground lies
//! inside with a margin. The default spacing keeps about as many voxels as the coarser scan.
//!
//! # Differences
//! The thesis compares voxels of different spacing directly; on one isotropic grid blocks and windows are cubes in mm, and scans of any
//! orientation can be compared.

use glam::{DMat3, DVec3};

use crate::error::{Error, Result};
use crate::image::grid::Grid;

/// Room around the foreground for windows and for tissue that moved, mm.
const MARGIN: f64 = 14.0;

/// Most voxels of a working grid: 4 bytes times a dozen arrays stay below a gigabyte.
const MAX_VOXELS: f64 = 12e6;

/// Finest default spacing: below it noise grows and nothing is gained for a field as smooth as tissue's.
const FINEST: f64 = 1.2;

/// The grid around `foreground` of the fixed scan; `spacing` replaces the default.
///
/// # Errors
/// [`Error::InvalidInput`] for an empty foreground; [`Error::CapacityExceeded`] for a spacing that gives too many voxels.
pub fn working_grid(fixed: &Grid, foreground: &[bool], moving: &Grid, spacing: Option<f64>) -> Result<Grid> {
    let direction = orthonormal(fixed.direction());
    let (low, high) = bounds(fixed, foreground, &direction)?;
    let (low, high) = (low - MARGIN, high + MARGIN);
    let voxel = |grid: &Grid| grid.spacing().element_product().cbrt();
    let default = voxel(fixed).max(voxel(moving)).max(FINEST);
    let fitting = ((high - low).element_product() / MAX_VOXELS).cbrt();
    let step = spacing.unwrap_or(default.max(fitting));
    let size = ((high - low) / step).ceil().as_usizevec3().to_array().map(|n| n + 1);
    let needed = size.iter().map(|n| *n as f64).product::<f64>();
    if needed > 8.0 * MAX_VOXELS {
        let limit = (8.0 * MAX_VOXELS) as u64;
        return Err(Error::CapacityExceeded { what: "voxels of the working grid", needed: needed as u64, limit });
    }
    Grid::new(size, DVec3::splat(step), direction * low, direction)
}

/// The same region with voxels `factor` times as large.
///
/// # Errors
/// None for a valid grid.
pub fn coarser(grid: &Grid, factor: f64) -> Result<Grid> {
    let size = grid.size().map(|n| ((n - 1) as f64 / factor).ceil() as usize + 1);
    Grid::new(size, grid.spacing() * factor, grid.origin(), grid.direction())
}

/// The nearest right-handed orthonormal frame along the first two axes.
fn orthonormal(direction: DMat3) -> DMat3 {
    let x = direction.x_axis.normalize();
    let y = (direction.y_axis - x * x.dot(direction.y_axis)).normalize();
    DMat3::from_cols(x, y, x.cross(y))
}

/// Box of the foreground along the axes of `direction`, mm.
fn bounds(grid: &Grid, foreground: &[bool], direction: &DMat3) -> Result<(DVec3, DVec3)> {
    let to_frame = direction.transpose();
    let [ni, nj, _] = grid.size();
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for row in 0..foreground.len() / ni {
        let line = &foreground[row * ni..(row + 1) * ni];
        let Some(first) = line.iter().position(|f| *f) else { continue };
        let last = line.iter().rposition(|f| *f).unwrap_or(first);
        for i in [first, last] {
            let point = to_frame * grid.index_to_world(DVec3::new(i as f64, (row % nj) as f64, (row / nj) as f64));
            (low, high) = (low.min(point), high.max(point));
        }
    }
    if low.x > high.x {
        return Err(Error::input("the fixed scan has no foreground"));
    }
    Ok((low, high))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_grid_is_right_handed_and_holds_the_foreground() {
        let direction = DMat3::from_rotation_z(0.4) * DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
        let fixed = Grid::new([20, 30, 12], DVec3::new(1.0, 1.0, 2.5), DVec3::new(5.0, -9.0, 40.0), direction).unwrap();
        let foreground: Vec<bool> = (0..fixed.voxel_count()).map(|at| at % 20 > 4 && at % 20 < 15).collect();
        let grid = working_grid(&fixed, &foreground, &fixed, None).unwrap();
        assert!(grid.is_right_handed());
        for index in [DVec3::new(5.0, 0.0, 0.0), DVec3::new(14.0, 29.0, 11.0)] {
            let inside = grid.world_to_index(fixed.index_to_world(index)) * grid.spacing();
            assert!(inside.min_element() > MARGIN - 2.0, "{inside}");
        }
        assert!(working_grid(&fixed, &vec![false; 7200], &fixed, None).is_err());
    }
}
