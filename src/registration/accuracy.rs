//! How good a registration is: landmarks, and the distance of edges.
//!
//! # Method
//! Landmarks: the distance of each mapped fixed point to its moving counterpart. Edges: the symmetric Hausdorff distance of the Canny
//! edges of two scans on one grid, its 95th percentile and the mean distance, from an exact distance transform.
//!
//! # Source
//! [Drakopoulos2017] sections 3.8.2 and 3.8.3; [Felzenszwalb2012] for the distance transform.
//!
//! # Limits
//! The largest edge distance measures single noisy voxels; the percentile and the landmarks say more.

use glam::DVec3;
use rayon::prelude::*;

use super::canny::canny_edges;
use crate::image::scalar_image::ScalarImage;

/// Mean and largest distance of landmarks, mm.
pub fn landmark_errors(fixed: &[DVec3], moving: &[DVec3], map: impl Fn(DVec3) -> DVec3) -> [f64; 2] {
    let errors = fixed.iter().zip(moving).map(|(f, m)| (map(*f) - *m).length());
    let (sum, most, count) = errors.fold((0.0, 0.0f64, 0), |(s, m, c), e| (s + e, m.max(e), c + 1));
    [sum / f64::from(count.max(1)), most]
}

/// Hausdorff distance, 95th percentile and mean of the distances of the edges of two scans on one grid, mm; NaN without edges.
pub fn edge_distances(warped: &ScalarImage, fixed: &ScalarImage) -> [f64; 3] {
    let (a, b) = (canny_edges(warped), canny_edges(fixed));
    if !a.contains(&true) || !b.contains(&true) {
        return [f64::NAN; 3];
    }
    let size = fixed.grid().size();
    let spacing = fixed.grid().spacing().to_array();
    let to = |from: &[bool], edges: &[bool]| -> Vec<f64> {
        let squared = squared_distances(edges, size, spacing);
        let mut distances: Vec<f64> =
            from.iter().zip(squared).filter(|(e, _)| **e).map(|(_, d)| f64::from(d).sqrt()).collect();
        distances.sort_unstable_by(f64::total_cmp);
        distances
    };
    let (forth, back) = (to(&a, &b), to(&b, &a));
    let percentile = |d: &[f64]| d[((d.len() - 1) as f64 * 0.95) as usize];
    let mean = |d: &[f64]| d.iter().sum::<f64>() / d.len() as f64;
    [
        forth[forth.len() - 1].max(back[back.len() - 1]),
        percentile(&forth).max(percentile(&back)),
        0.5 * (mean(&forth) + mean(&back)),
    ]
}

/// Squared distance of every voxel to the nearest set voxel, mm^2.
pub(super) fn squared_distances(set: &[bool], size: [usize; 3], spacing: [f64; 3]) -> Vec<f32> {
    let far = (0..3).map(|axis| (size[axis] as f64 * spacing[axis]).powi(2)).sum::<f64>() as f32 * 4.0;
    let mut values: Vec<f32> = set.iter().map(|s| if *s { 0.0 } else { far }).collect();
    for axis in 0..3 {
        values = transform_axis(&values, size, axis, spacing[axis]);
    }
    values
}

/// Lower envelope of parabolas along one axis.
fn transform_axis(values: &[f32], size: [usize; 3], axis: usize, spacing: f64) -> Vec<f32> {
    let stride = [1, size[0], size[0] * size[1]][axis];
    let n = size[axis];
    let lines = values.len() / n;
    let start = |line: usize| match axis {
        0 => line * n,
        1 => line % size[0] + line / size[0] * size[0] * size[1],
        _ => line,
    };
    let transformed: Vec<Vec<f32>> = (0..lines)
        .into_par_iter()
        .map(|line| {
            let row: Vec<f64> = (0..n).map(|x| f64::from(values[start(line) + x * stride])).collect();
            envelope(&row, spacing)
        })
        .collect();
    let mut result = vec![0.0; values.len()];
    for (line, row) in transformed.iter().enumerate() {
        for (x, value) in row.iter().enumerate() {
            result[start(line) + x * stride] = *value;
        }
    }
    result
}

fn envelope(row: &[f64], spacing: f64) -> Vec<f32> {
    let (mut vertices, mut bounds) = (vec![0usize], vec![f64::NEG_INFINITY]);
    let place = |x: usize| x as f64 * spacing;
    for x in 1..row.len() {
        loop {
            let last = vertices[vertices.len() - 1];
            let crossing =
                (row[x] + place(x).powi(2) - row[last] - place(last).powi(2)) / (2.0 * (place(x) - place(last)));
            if crossing <= bounds[bounds.len() - 1] && vertices.len() > 1 {
                vertices.pop();
                bounds.pop();
                continue;
            }
            vertices.push(x);
            bounds.push(crossing);
            break;
        }
    }
    let mut at = 0;
    (0..row.len())
        .map(|x| {
            while at + 1 < vertices.len() && bounds[at + 1] < place(x) {
                at += 1;
            }
            (row[vertices[at]] + (place(x) - place(vertices[at])).powi(2)) as f32
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registration::feature_points::voxel_of;

    #[test]
    fn distances_agree_with_a_search() {
        let (size, spacing) = ([9, 7, 8], [1.0, 2.0, 0.5]);
        let set: Vec<bool> = (0..504).map(|at| at % 97 == 3).collect();
        let found = squared_distances(&set, size, spacing);
        let place = |at: usize| DVec3::from_array(voxel_of(at, size).map(|x| x as f64)) * DVec3::from_array(spacing);
        for at in 0..504 {
            let nearest = (0..504)
                .filter(|s| set[*s])
                .map(|s| (place(s) - place(at)).length_squared())
                .fold(f64::INFINITY, f64::min);
            assert!((f64::from(found[at]) - nearest).abs() < 1e-3);
        }
    }

    #[test]
    fn landmark_errors_are_mean_and_largest() {
        let fixed = [DVec3::ZERO, DVec3::X];
        let errors = landmark_errors(&fixed, &[DVec3::Y, DVec3::X * 4.0], |p| p);
        assert_eq!(errors, [2.0, 3.0]);
    }
}
