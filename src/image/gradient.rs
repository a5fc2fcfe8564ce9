//! Derivatives of scans by central differences.
//!
//! # Method
//! `(f(i + 1) - f(i - 1)) / 2h` per axis, one-sided at the border.
//!
//! # Limits
//! Derivatives are along the axes of the grid, per mm; a caller that needs world vectors multiplies by the direction.

use glam::Vec3;

use crate::image::scalar_image::ScalarImage;

/// The gradient at voxel (i, j, k) along the grid's axes, 1/mm.
#[inline]
pub fn gradient_at(image: &ScalarImage, voxel: [usize; 3]) -> Vec3 {
    let (size, spacing) = (image.grid().size(), image.grid().spacing());
    let at = image.grid().offset(voxel[0], voxel[1], voxel[2]);
    let strides = [1, size[0], size[0] * size[1]];
    let mut gradient = Vec3::ZERO;
    for axis in 0..3 {
        let low = if voxel[axis] > 0 { at - strides[axis] } else { at };
        let high = if voxel[axis] + 1 < size[axis] { at + strides[axis] } else { at };
        if high > low {
            let steps = ((high - low) / strides[axis]) as f32;
            gradient[axis] = (image.voxels()[high] - image.voxels()[low]) / (steps * spacing[axis] as f32);
        }
    }
    gradient
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use crate::image::resample::map_voxels;
    use glam::{DMat3, DVec3};

    #[test]
    fn the_gradient_of_a_linear_function_is_exact() {
        let grid = Grid::new([4, 5, 1], DVec3::new(0.5, 2.0, 1.0), DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let image = ScalarImage::new(grid, map_voxels(&grid, |p, _| (3.0 * p.x - p.y) as f32), 0.0).unwrap();
        for voxel in [[0, 0, 0], [2, 3, 0], [3, 4, 0]] {
            assert!((gradient_at(&image, voxel) - Vec3::new(3.0, -1.0, 0.0)).length() < 1e-5);
        }
    }
}
