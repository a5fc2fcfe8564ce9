//! Gaussian smoothing and box sums, separable.
//!
//! # Method
//! One pass per axis; each pass adds whole rows of voxels, so that the inner loop runs along memory in all three. The Gaussian is
//! truncated at three standard deviations and normalised; at the border the outermost value is repeated.
//!
//! # Cost
//! Parallel over rows; every voxel is a sum in fixed order, the same for any number of threads.

use rayon::prelude::*;

/// Standard deviations after which the kernel is cut: 0.3 % of the weight lies beyond.
const CUT: f64 = 3.0;

/// Sum of `values` weighted by `kernel` (odd length, centred) along one axis, the outermost value repeated.
pub fn convolve_axis(values: &[f32], size: [usize; 3], axis: usize, kernel: &[f32]) -> Vec<f32> {
    debug_assert!(kernel.len() % 2 == 1 && values.len() == size[0] * size[1] * size[2]);
    let [ni, nj, nk] = size;
    let half = kernel.len() as isize / 2;
    let mut result = vec![0.0f32; values.len()];
    result.par_chunks_mut(ni).enumerate().for_each(|(row, out)| {
        let (j, k) = (row % nj, row / nj);
        if axis == 0 {
            return convolve_row(&values[row * ni..(row + 1) * ni], kernel, out);
        }
        for (tap, &weight) in kernel.iter().enumerate() {
            let shift = tap as isize - half;
            let source = match axis {
                1 => k * nj + (j as isize + shift).clamp(0, nj as isize - 1) as usize,
                _ => (k as isize + shift).clamp(0, nk as isize - 1) as usize * nj + j,
            };
            for (o, v) in out.iter_mut().zip(&values[source * ni..(source + 1) * ni]) {
                *o += weight * v;
            }
        }
    });
    result
}

fn convolve_row(row: &[f32], kernel: &[f32], out: &mut [f32]) {
    let (n, half) = (row.len(), kernel.len() / 2);
    let padded: Vec<f32> = std::iter::repeat_n(row[0], half)
        .chain(row.iter().copied())
        .chain(std::iter::repeat_n(row[n - 1], half))
        .collect();
    for (tap, &weight) in kernel.iter().enumerate() {
        for (o, v) in out.iter_mut().zip(&padded[tap..tap + n]) {
            *o += weight * v;
        }
    }
}

/// `values` smoothed with a Gaussian of `sigma` voxels per axis; axes with a sigma below a tenth of a voxel are left.
pub fn smooth(values: &[f32], size: [usize; 3], sigma: [f64; 3]) -> Vec<f32> {
    let mut result = values.to_vec();
    for axis in 0..3 {
        if sigma[axis] >= 0.1 && size[axis] > 1 {
            result = convolve_axis(&result, size, axis, &gaussian_kernel(sigma[axis]));
        }
    }
    result
}

/// The normalised weights of a Gaussian of `sigma` voxels.
pub fn gaussian_kernel(sigma: f64) -> Vec<f32> {
    let half = (CUT * sigma).ceil().max(1.0) as i32;
    let weights: Vec<f64> = (-half..=half).map(|x| (-0.5 * (f64::from(x) / sigma).powi(2)).exp()).collect();
    let sum: f64 = weights.iter().sum();
    weights.iter().map(|w| (w / sum) as f32).collect()
}

/// Mean over boxes of `2 half + 1` voxels around every voxel, the outermost value repeated.
pub fn box_mean(values: &[f32], size: [usize; 3], half: [usize; 3]) -> Vec<f32> {
    let mut result = values.to_vec();
    for axis in 0..3 {
        if half[axis] > 0 {
            let width = 2 * half[axis] + 1;
            result = convolve_axis(&result, size, axis, &vec![1.0 / width as f32; width]);
        }
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn constants_stay_and_boxes_average() {
        let size = [5, 4, 3];
        let flat = smooth(&[2.0; 60], size, [1.0, 2.0, 0.7]);
        assert!(flat.iter().all(|v| (v - 2.0).abs() < 1e-5));
        let values: Vec<f32> = (0..60).map(|v| (v % 5) as f32).collect();
        let mean = box_mean(&values, size, [1, 1, 1]);
        assert!((mean[2 + 5 * (1 + 4)] - 2.0).abs() < 1e-5);
    }
}
