//! Values between voxels: nearest and trilinear.
//!
//! # Method
//! A [`Stencil`] holds the eight neighbours of a continuous index with their weights, so that any array on the same grid is
//! blended with it. Indices up to half a voxel outside of the outermost centres take the value of the nearest centre.
//!
//! # Cost
//! No allocation; 8 loads per value.

use std::ops::{Add, Mul, Sub};

use glam::DVec3;

use crate::image::scalar_image::ScalarImage;

/// Eight voxels around a point with their weights.
#[derive(Debug, Clone, Copy)]
pub struct Stencil {
    /// Offset of the lowest neighbour.
    base: usize,
    /// Steps to the upper neighbour per axis; 0 at the border.
    steps: [usize; 3],
    /// Weights of the upper neighbours.
    fractions: [f32; 3],
}

impl Stencil {
    /// The stencil at a continuous index of a grid of `size` voxels; `None` more than half a voxel outside.
    #[inline]
    pub fn at(size: [usize; 3], index: DVec3) -> Option<Self> {
        let strides = [1, size[0], size[0] * size[1]];
        let (mut base, mut steps, mut fractions) = (0, [0; 3], [0.0; 3]);
        for axis in 0..3 {
            let (x, last) = (index[axis], (size[axis] - 1) as f64);
            // Written so that NaN is outside.
            if !(x >= -0.5 && x <= last + 0.5) {
                return None;
            }
            let clamped = x.clamp(0.0, last);
            let low = clamped as usize;
            base += low * strides[axis];
            if low + 1 < size[axis] {
                steps[axis] = strides[axis];
                fractions[axis] = (clamped - low as f64) as f32;
            }
        }
        Some(Self { base, steps, fractions })
    }

    /// The weighted mean of the eight neighbours.
    #[inline]
    pub fn blend<T: Copy + Add<Output = T> + Mul<f32, Output = T>>(&self, values: &[T]) -> T {
        let [x, y, z] = self.fractions;
        let [dx, dy, dz] = self.steps;
        let row = |at: usize| values[at] * (1.0 - x) + values[at + dx] * x;
        let plane = |at: usize| row(at) * (1.0 - y) + row(at + dy) * y;
        plane(self.base) * (1.0 - z) + plane(self.base + dz) * z
    }
}

impl Stencil {
    /// The derivative of [`Stencil::blend`] by the index along each axis.
    #[inline]
    pub fn derivative<T>(&self, values: &[T]) -> [T; 3]
    where
        T: Copy + Add<Output = T> + Sub<Output = T> + Mul<f32, Output = T>,
    {
        let [x, y, z] = self.fractions;
        let [dx, dy, dz] = self.steps;
        let row = |at: usize| values[at] * (1.0 - x) + values[at + dx] * x;
        let slope = |at: usize| values[at + dx] - values[at];
        let rows = [self.base, self.base + dy, self.base + dz, self.base + dy + dz];
        let [a, b, c, d] = rows.map(row);
        let [sa, sb, sc, sd] = rows.map(slope);
        let along_x = (sa * (1.0 - y) + sb * y) * (1.0 - z) + (sc * (1.0 - y) + sd * y) * z;
        let along_y = (b - a) * (1.0 - z) + (d - c) * z;
        let along_z = (c - a) * (1.0 - y) + (d - b) * y;
        [along_x, along_y, along_z]
    }
}

/// Offset of the voxel nearest to a continuous index; `None` more than half a voxel outside.
#[inline]
pub fn nearest_offset(size: [usize; 3], index: DVec3) -> Option<usize> {
    let mut offset = 0;
    let mut stride = 1;
    for axis in 0..3 {
        let last = (size[axis] - 1) as f64;
        if !(index[axis] >= -0.5 && index[axis] <= last + 0.5) {
            return None;
        }
        offset += stride * index[axis].round().clamp(0.0, last) as usize;
        stride *= size[axis];
    }
    Some(offset)
}

/// The value of a scan at a continuous index, linearly interpolated; the background outside.
#[inline]
pub fn linear(image: &ScalarImage, index: DVec3) -> f32 {
    Stencil::at(image.grid().size(), index).map_or(image.background(), |stencil| stencil.blend(image.voxels()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn linear_functions_are_reproduced() {
        let size = [4, 3, 5];
        let f = |p: DVec3| (2.0 + 3.0 * p.x - p.y + 0.5 * p.z) as f32;
        let values: Vec<f32> =
            (0..60).map(|at| f(DVec3::new((at % 4) as f64, (at / 4 % 3) as f64, (at / 12) as f64))).collect();
        for p in [DVec3::new(0.0, 0.0, 0.0), DVec3::new(2.7, 1.4, 3.9), DVec3::new(3.0, 2.0, 4.0)] {
            assert!((Stencil::at(size, p).unwrap().blend(&values) - f(p)).abs() < 1e-5);
        }
        assert!(Stencil::at(size, DVec3::new(3.6, 0.0, 0.0)).is_none());
        assert!(Stencil::at(size, DVec3::new(f64::NAN, 0.0, 0.0)).is_none());
        assert_eq!(nearest_offset(size, DVec3::new(2.6, 1.4, 3.9)), Some(3 + 4 * (1 + 3 * 4)));
    }
}
