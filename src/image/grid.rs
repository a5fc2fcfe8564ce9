//! Size, spacing, origin and direction of an image; voxel <-> world, in the one place.
//!
//! # Method
//! ITK's convention: `world = origin + direction * (spacing .* index)`, world = LPS millimetres, the index of a voxel
//! is its centre. `direction` may reflect (negative determinant) and need not be orthogonal, only invertible.
//!
//! # Invariants
//! A [`Grid`] has at least one voxel, finite positive spacing, finite origin and an invertible direction.

use glam::{DMat3, DVec3};

use crate::error::{Error, Result};

/// Columns of a direction matrix spanning less than this volume are singular: unit columns of a usable scan span 1,
/// and rounding of headers in float32 perturbs it by 1e-6 at most.
const SINGULAR_DETERMINANT: f64 = 1e-4;

/// Geometry of an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    size: [usize; 3],
    spacing: DVec3,
    origin: DVec3,
    direction: DMat3,
    inverse_direction: DMat3,
}

impl Grid {
    /// A grid of `size` voxels (i fastest), `spacing` in mm, `origin` the centre of voxel 0 in LPS mm, `direction`
    /// with the axes of i, j, k as columns.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] for an empty or overflowing size, non-positive or non-finite spacing, non-finite
    /// origin, singular direction.
    pub fn new(size: [usize; 3], spacing: DVec3, origin: DVec3, direction: DMat3) -> Result<Self> {
        let voxels = size.iter().try_fold(1usize, |n, &s| n.checked_mul(s));
        if size.contains(&0) || voxels.is_none_or(|n| n > isize::MAX as usize) {
            return Err(Error::argument("size", format!("{size:?} is not a valid image size")));
        }
        if !(spacing.is_finite() && spacing.min_element() > 0.0) {
            return Err(Error::argument("spacing", format!("{:?} is not finite and positive", spacing.to_array())));
        }
        if !origin.is_finite() {
            return Err(Error::argument("origin", format!("{:?} is not finite", origin.to_array())));
        }
        let determinant = direction.determinant();
        if !direction.is_finite() || !determinant.is_finite() || determinant.abs() < SINGULAR_DETERMINANT {
            return Err(Error::argument("direction", format!("singular matrix, determinant {determinant}")));
        }
        Ok(Self { size, spacing, origin, direction, inverse_direction: direction.inverse() })
    }

    /// Voxels along i, j, k.
    pub fn size(&self) -> [usize; 3] {
        self.size
    }

    /// Millimetres between voxel centres along i, j, k.
    pub fn spacing(&self) -> DVec3 {
        self.spacing
    }

    /// Centre of voxel 0, LPS mm.
    pub fn origin(&self) -> DVec3 {
        self.origin
    }

    /// Axes of i, j, k as columns.
    pub fn direction(&self) -> DMat3 {
        self.direction
    }

    /// Number of voxels.
    pub fn voxel_count(&self) -> usize {
        self.size.iter().product()
    }

    /// Position in a packed array, i fastest.
    #[inline]
    pub fn offset(&self, i: usize, j: usize, k: usize) -> usize {
        debug_assert!(i < self.size[0] && j < self.size[1] && k < self.size[2]);
        i + self.size[0] * (j + self.size[1] * k)
    }

    /// World point (LPS mm) of a continuous index in voxels.
    #[inline]
    pub fn index_to_world(&self, index: DVec3) -> DVec3 {
        self.origin + self.direction * (self.spacing * index)
    }

    /// Continuous index in voxels of a world point (LPS mm).
    #[inline]
    pub fn world_to_index(&self, world: DVec3) -> DVec3 {
        self.inverse_direction * (world - self.origin) / self.spacing
    }

    /// World point (LPS mm) of a point of the local frame: millimetres along the axes i, j, k from voxel 0's centre.
    /// Engines work in this frame, where the grid is axis-aligned.
    #[inline]
    pub fn local_to_world(&self, local: DVec3) -> DVec3 {
        self.origin + self.direction * local
    }

    /// Whether local and world frame have the same handedness; where not, elements built in the local frame must be
    /// mirrored.
    pub fn is_right_handed(&self) -> bool {
        self.direction.determinant() > 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn oblique() -> Grid {
        let direction = DMat3::from_rotation_y(0.3) * DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0));
        Grid::new([4, 5, 6], DVec3::new(0.5, 1.0, 2.5), DVec3::new(10.0, -4.0, 7.0), direction).unwrap()
    }

    #[test]
    fn world_and_index_are_inverse() {
        let grid = oblique();
        let index = DVec3::new(1.25, 3.5, 2.0);
        assert!((grid.world_to_index(grid.index_to_world(index)) - index).length() < 1e-12);
        assert!(!grid.is_right_handed());
    }

    #[test]
    fn unusable_geometry_is_refused() {
        let grid = |spacing, direction| Grid::new([2, 2, 2], spacing, DVec3::ZERO, direction);
        assert!(grid(DVec3::new(1.0, 0.0, 1.0), DMat3::IDENTITY).is_err());
        assert!(grid(DVec3::new(1.0, f64::NAN, 1.0), DMat3::IDENTITY).is_err());
        assert!(grid(DVec3::ONE, DMat3::from_cols(DVec3::X, DVec3::X, DVec3::Z)).is_err());
        assert!(Grid::new([0, 2, 2], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).is_err());
        assert!(Grid::new([usize::MAX, 2, 2], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).is_err());
    }
}
