//! Structure tensor of a block: how far its values constrain each direction.
//!
//! # Method
//! `T = sum g g^T / sum a'^2` over the counted voxels of a block: g the gradient of the values, a' the centred values. An edge
//! constrains its normal only, a corner all directions; division by the spread makes T independent of contrast.
//!
//! # Source
//! [Clatz2005] section III-B; [Drakopoulos2017] section 3.7.2 (block tensors).
//!
//! # Invariants
//! Symmetric, positive semi-definite; 1/mm^2; along the axes of the grid.

use glam::{DMat3, DVec3};

/// The tensor of the block around `center`; zero for a constant block. `spacing` in mm, the block lies inside the image.
pub fn structure_tensor(
    values: &[f32],
    mask: Option<&[bool]>,
    size: [usize; 3],
    center: [usize; 3],
    half: [usize; 3],
    spacing: f64,
) -> DMat3 {
    let strides = [1, size[0], size[0] * size[1]];
    let slope = |at: usize, axis: usize, x: usize| -> f64 {
        let low = if x > 0 { at - strides[axis] } else { at };
        let high = if x + 1 < size[axis] { at + strides[axis] } else { at };
        f64::from(values[high] - values[low]) / ((high - low) / strides[axis]).max(1) as f64
    };
    let mut tensor = [0.0f64; 6];
    let (mut sum, mut squares, mut count) = (0.0, 0.0, 0.0);
    for k in center[2] - half[2]..=center[2] + half[2] {
        for j in center[1] - half[1]..=center[1] + half[1] {
            for i in center[0] - half[0]..=center[0] + half[0] {
                let at = (k * size[1] + j) * size[0] + i;
                if mask.is_some_and(|m| !m[at]) {
                    continue;
                }
                let g = DVec3::new(slope(at, 0, i), slope(at, 1, j), slope(at, 2, k));
                for (slot, (a, b)) in tensor.iter_mut().zip([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]) {
                    *slot += g[a] * g[b];
                }
                let value = f64::from(values[at]);
                sum += value;
                squares += value * value;
                count += 1.0;
            }
        }
    }
    let spread = squares - sum * sum / f64::max(count, 1.0);
    if spread <= 1e-9 * squares || spread <= 0.0 {
        return DMat3::ZERO;
    }
    let scale = 1.0 / (spread * spacing * spacing);
    let [xx, xy, xz, yy, yz, zz] = tensor.map(|v| v * scale);
    DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_edge_constrains_its_normal_only() {
        let size = [9, 9, 9];
        let values: Vec<f32> = (0..729).map(|at| if at % 9 > 4 { 1.0 } else { 0.0 }).collect();
        let tensor = structure_tensor(&values, None, size, [4, 4, 4], [2, 2, 2], 1.0);
        assert!(tensor.x_axis.x > 0.1);
        assert!(tensor.y_axis.length() < 1e-12 && tensor.z_axis.length() < 1e-12);
        assert_eq!(structure_tensor(&[1.0; 729], None, size, [4, 4, 4], [2, 2, 2], 1.0), DMat3::ZERO);
    }
}
