//! The place of a match to a fraction of a voxel, by least squares on the values of the block.
//!
//! # Method
//! The block's values S and those of its counterpart T(x + s) differ by contrast, brightness and a rest of the shift:
//! `T(x + s) = a S(x) + b + a g(x) . d`, g the gradient of S. The five unknowns `a d, a, b` are found by least squares over the counted
//! voxels; `s - d` is the next s, until d is small. The matrix holds values of S only, so that it is factorised once.
//!
//! # Source
//! [LucasKanade1981], in the form whose matrix stays the same of [BakerMatthews2004] section 3.2, with gain and offset as unknowns.
//!
//! # Differences
//! Directions that the block does not constrain are damped: along an edge the place stays where the search of whole voxels put it.
//!
//! # Cost
//! One sample per voxel and step, three steps as a rule. No allocation.
//!
//! # Limits
//! For scans of the same contrast up to gain and offset; the start has to be within about a voxel.

use glam::DVec3;

use super::similarity::Search;

/// Steps at most: from half a voxel away, two are enough.
const MAX_STEPS: usize = 6;

/// A step shorter than this ends the search, voxels.
const SMALL_STEP: f64 = 0.01;

/// The place may move this far from its start, voxels: beyond it another whole voxel would have been more similar.
const MAX_SHIFT: f64 = 1.2;

/// Damping of weakly constrained directions, as a share of the mean squared gradient.
const DAMPING: f64 = 0.02;

/// Unknowns: three of the shift, gain, offset.
const UNKNOWNS: usize = 5;

/// Moves `start` (voxels) to where the block fits best; `None` where the search leaves the image or its start.
pub fn refine(
    source: &[f32],
    mask: &[bool],
    target: &[f32],
    size: [usize; 3],
    search: &Search,
    start: DVec3,
) -> Option<DVec3> {
    let factor = cholesky(&normal_matrix(source, mask, size, search))?;
    let mut shift = start;
    for _ in 0..MAX_STEPS {
        let right = right_side(source, mask, target, size, search, shift)?;
        let solution = solve(&factor, right);
        if solution[3] <= 0.0 {
            return None;
        }
        let step = DVec3::new(solution[0], solution[1], solution[2]) / solution[3];
        shift -= step.clamp_length_max(0.5);
        if !shift.is_finite() || (shift - start).abs().max_element() > MAX_SHIFT {
            return None;
        }
        if step.length() < SMALL_STEP {
            break;
        }
    }
    Some(shift)
}

/// Calls `visit` with offset, voxel and row of coefficients of every counted voxel.
fn for_each_voxel(
    source: &[f32],
    mask: &[bool],
    size: [usize; 3],
    search: &Search,
    mut visit: impl FnMut([usize; 3], [f64; UNKNOWNS]),
) {
    let strides = [1, size[0], size[0] * size[1]];
    let (center, half) = (search.center, search.half_block);
    let base = f64::from(source[center[0] + strides[1] * center[1] + strides[2] * center[2]]);
    for k in center[2] - half[2]..=center[2] + half[2] {
        for j in center[1] - half[1]..=center[1] + half[1] {
            for i in center[0] - half[0]..=center[0] + half[0] {
                let at = i + strides[1] * j + strides[2] * k;
                if !mask[at] {
                    continue;
                }
                let voxel = [i, j, k];
                let slope = |axis: usize| {
                    let low = if voxel[axis] > 0 { at - strides[axis] } else { at };
                    let high = if voxel[axis] + 1 < size[axis] { at + strides[axis] } else { at };
                    f64::from(source[high] - source[low]) / ((high - low) / strides[axis]).max(1) as f64
                };
                // Relative to the centre: sums of squares of small numbers lose no digits.
                visit(voxel, [slope(0), slope(1), slope(2), f64::from(source[at]) - base, 1.0]);
            }
        }
    }
}

fn normal_matrix(source: &[f32], mask: &[bool], size: [usize; 3], search: &Search) -> [[f64; UNKNOWNS]; UNKNOWNS] {
    let mut matrix = [[0.0; UNKNOWNS]; UNKNOWNS];
    for_each_voxel(source, mask, size, search, |_, row| {
        for a in 0..UNKNOWNS {
            for b in 0..=a {
                matrix[a][b] += row[a] * row[b];
            }
        }
    });
    let damping = DAMPING * (matrix[0][0] + matrix[1][1] + matrix[2][2]) / 3.0;
    (0..3).for_each(|axis| matrix[axis][axis] += damping);
    matrix
}

/// `None` where the target's block leaves the image.
fn right_side(
    source: &[f32],
    mask: &[bool],
    target: &[f32],
    size: [usize; 3],
    search: &Search,
    shift: DVec3,
) -> Option<[f64; UNKNOWNS]> {
    let whole = shift.floor();
    let part = (shift - whole).as_vec3();
    let whole = [whole.x as isize, whole.y as isize, whole.z as isize];
    for axis in 0..3 {
        let low = search.center[axis] as isize - search.half_block[axis] as isize + whole[axis];
        let high = search.center[axis] as isize + search.half_block[axis] as isize + whole[axis] + 1;
        if low < 0 || high >= size[axis] as isize {
            return None;
        }
    }
    let (row_step, slice_step) = (size[0], size[0] * size[1]);
    let mut right = [0.0; UNKNOWNS];
    for_each_voxel(source, mask, size, search, |voxel, row| {
        let [i, j, k] = [0, 1, 2].map(|axis| (voxel[axis] as isize + whole[axis]) as usize);
        let at = i + row_step * j + slice_step * k;
        let line = |at: usize| target[at] + part.x * (target[at + 1] - target[at]);
        let plane = |at: usize| line(at) + part.y * (line(at + row_step) - line(at));
        let value = f64::from(plane(at) + part.z * (plane(at + slice_step) - plane(at)));
        for (sum, coefficient) in right.iter_mut().zip(row) {
            *sum += coefficient * value;
        }
    });
    Some(right)
}

/// Lower factor of the matrix whose lower half is given; `None` where it is singular.
fn cholesky(matrix: &[[f64; UNKNOWNS]; UNKNOWNS]) -> Option<[[f64; UNKNOWNS]; UNKNOWNS]> {
    // A pivot this small against its diagonal entry is rounding.
    const RELATIVE_PIVOT: f64 = 1e-9;
    let mut factor = [[0.0; UNKNOWNS]; UNKNOWNS];
    for row in 0..UNKNOWNS {
        for column in 0..=row {
            let sum: f64 = (0..column).map(|n| factor[row][n] * factor[column][n]).sum();
            let rest = matrix[row][column] - sum;
            if row > column {
                factor[row][column] = rest / factor[column][column];
            } else if rest > RELATIVE_PIVOT * matrix[row][row] && rest > 0.0 {
                factor[row][row] = rest.sqrt();
            } else {
                return None;
            }
        }
    }
    Some(factor)
}

fn solve(factor: &[[f64; UNKNOWNS]; UNKNOWNS], mut right: [f64; UNKNOWNS]) -> [f64; UNKNOWNS] {
    for row in 0..UNKNOWNS {
        let sum: f64 = (0..row).map(|n| factor[row][n] * right[n]).sum();
        right[row] = (right[row] - sum) / factor[row][row];
    }
    for row in (0..UNKNOWNS).rev() {
        let sum: f64 = (row + 1..UNKNOWNS).map(|n| factor[n][row] * right[n]).sum();
        right[row] = (right[row] - sum) / factor[row][row];
    }
    right
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registration::feature_points::voxel_of;

    const SIZE: [usize; 3] = [24, 22, 20];

    fn texture(shift: DVec3, gain: f32, offset: f32) -> Vec<f32> {
        (0..SIZE.iter().product())
            .map(|at| {
                let p = DVec3::from_array(voxel_of(at, SIZE).map(|x| x as f64)) - shift;
                gain * ((p.x * 0.5).sin() + (p.y * 0.45 + 0.2 * p.x).cos() + (p.z * 0.6).sin()) as f32 + offset
            })
            .collect()
    }

    #[test]
    fn a_fraction_of_a_voxel_is_found_through_gain_and_offset() {
        let shift = DVec3::new(1.3, -0.6, 0.45);
        let (source, target) = (texture(DVec3::ZERO, 1.0, 0.0), texture(shift, 3.0, 7.0));
        let mut mask = vec![true; source.len()];
        mask.iter_mut().step_by(7).for_each(|m| *m = false);
        let search = Search::new([11, 10, 9], [2; 3], [3; 3], SIZE);
        let found = refine(&source, &mask, &target, SIZE, &search, DVec3::new(1.0, -1.0, 0.0)).unwrap();
        assert!((found - shift).length() < 0.06, "{found}");
        let flat = vec![1.0; source.len()];
        assert_eq!(refine(&flat, &mask, &target, SIZE, &search, DVec3::ZERO), None);
    }

    #[test]
    fn a_block_at_the_border_is_left_alone() {
        let values = texture(DVec3::ZERO, 1.0, 0.0);
        let mask = vec![true; values.len()];
        let search = Search::new([21, 10, 9], [2; 3], [3; 3], SIZE);
        assert_eq!(refine(&values, &mask, &values, SIZE, &search, DVec3::ZERO), None);
    }
}
