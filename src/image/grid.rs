//! Size, spacing, origin and direction of an image; voxel <-> world, in the one place.
//!
//! # Method
//! ITK's convention: `world = origin + direction * (spacing .* index)`, world = LPS millimetres, the index of a voxel
//! is its centre. `direction` may reflect (negative determinant) and need not be orthogonal, only invertible.
//!
//! # Invariants
//! A [`Grid`] has at least one voxel, spacings within [`SPACING_RANGE`], an origin that is not so far that voxels would be
//! lost in its rounding, and an invertible direction.

use glam::{DMat3, DVec3, IVec3};

use crate::error::{Error, Result};

/// Columns of a direction matrix spanning less than this volume are singular: unit columns of a usable scan span 1,
/// and rounding of headers in float32 perturbs it by 1e-6 at most.
const SINGULAR_DETERMINANT: f64 = 1e-4;

/// Smallest and largest spacing, mm: a nanometre and a kilometre. Squares of squares of spacings, their inverses, and squared
/// distances across images of 10^8 voxels a side stay within the range of single precision, 1e-38 to 1e38; what is beyond comes
/// from damaged headers and wrong units.
pub const SPACING_RANGE: [f64; 2] = [1e-6, 1e6];

/// Farthest origin along an axis, in smallest spacings: beyond it the rounding of world coordinates is 1e-6 voxels and more.
const FARTHEST_ORIGIN: f64 = 1e10;

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
    /// [`Error::InvalidArgument`] for an empty or overflowing size, a spacing outside of [`SPACING_RANGE`], a non-finite
    /// or far origin, singular direction.
    pub fn new(size: [usize; 3], spacing: DVec3, origin: DVec3, direction: DMat3) -> Result<Self> {
        let voxels = size.iter().try_fold(1usize, |n, &s| n.checked_mul(s));
        if size.contains(&0) || voxels.is_none_or(|n| n > isize::MAX as usize) {
            return Err(Error::argument("size", format!("{size:?} is not a valid image size")));
        }
        let [least, most] = SPACING_RANGE;
        if !spacing.to_array().iter().all(|s| (least..=most).contains(s)) {
            let reason = format!("{:?} is not within {least:e} and {most:e} mm", spacing.to_array());
            return Err(Error::argument("spacing", reason));
        }
        if !(origin.abs().max_element() <= FARTHEST_ORIGIN * spacing.min_element() && origin.is_finite()) {
            let reason = format!("{:?} is not within {FARTHEST_ORIGIN:e} voxels", origin.to_array());
            return Err(Error::argument("origin", reason));
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

    /// The voxel at a position in a packed array.
    #[inline]
    pub fn voxel_at(&self, offset: usize) -> [usize; 3] {
        let [ni, nj, _] = self.size;
        [offset % ni, offset / ni % nj, offset / ni / nj]
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

/// The 27 places within one voxel of a place along each axis, itself among them.
pub fn places_around(place: IVec3) -> impl Iterator<Item = IVec3> {
    (0..27).map(move |n| place + IVec3::new(n % 3 - 1, n / 3 % 3 - 1, n / 9 - 1))
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
        assert!(grid(DVec3::new(1e-6, 1.0, 1e6), DMat3::IDENTITY).is_ok());
        for spacing in [1e-300, 9e-7, 1.1e6, 1e300, f64::INFINITY, -1.0] {
            assert!(grid(DVec3::splat(spacing), DMat3::IDENTITY).is_err(), "{spacing}");
            assert!(grid(DVec3::new(1.0, 1.0, spacing), DMat3::IDENTITY).is_err(), "{spacing}");
        }
        assert!(grid(DVec3::ONE, DMat3::from_cols(DVec3::X, DVec3::X, DVec3::Z)).is_err());
        for far in [2e10, 1e300, f64::NAN] {
            assert!(Grid::new([2, 2, 2], DVec3::ONE, DVec3::new(0.0, far, 0.0), DMat3::IDENTITY).is_err(), "{far}");
        }
        assert!(Grid::new([0, 2, 2], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).is_err());
        assert!(Grid::new([usize::MAX, 2, 2], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).is_err());
    }
}
