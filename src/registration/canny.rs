//! Canny edges of a scan.
//!
//! # Method
//! 1. Values are scaled to the range between the 2nd and 98th percentile of the foreground, smoothed with a Gaussian.
//! 2. Gradient by central differences; a voxel is a candidate where its magnitude is not below that of either neighbour along the
//!    dominant axes of the gradient (linear interpolation one voxel ahead and behind).
//! 3. Hysteresis: candidates above the upper threshold, and those above the lower one that are connected to them.
//!
//! # Source
//! [Canny1986]; [Drakopoulos2017] section 3.8.2 for its use.

use glam::DVec3;
use rayon::prelude::*;

use super::feature_points::voxel_of;
use crate::image::gaussian::smooth;
use crate::image::gradient::gradient_at;
use crate::image::interpolation::linear;
use crate::image::scalar_image::ScalarImage;

/// Variance of the Gaussian, mm^2.
const VARIANCE: f64 = 1.5;

/// Lower and upper threshold of the gradient of values scaled to 0..1, 1/mm.
const THRESHOLDS: [f32; 2] = [0.04, 0.08];

/// Which voxels of a scan are edges.
pub fn canny_edges(scan: &ScalarImage) -> Vec<bool> {
    let grid = scan.grid();
    let size = grid.size();
    let (low, high) = percentiles(scan);
    let scale = 1.0 / (high - low).max(f32::MIN_POSITIVE);
    let scaled: Vec<f32> = scan.voxels().iter().map(|v| ((v - low) * scale).clamp(0.0, 1.2)).collect();
    let smoothed = smooth(&scaled, size, (VARIANCE.sqrt() / grid.spacing()).to_array());
    let Ok(image) = ScalarImage::new(*grid, smoothed, 0.0) else { return vec![false; scaled.len()] };
    let magnitudes: Vec<f32> =
        (0..scaled.len()).into_par_iter().map(|at| gradient_at(&image, voxel_of(at, size)).length()).collect();
    let Ok(magnitude) = ScalarImage::new(*grid, magnitudes, 0.0) else { return vec![false; scaled.len()] };
    let candidates: Vec<bool> = (0..scaled.len())
        .into_par_iter()
        .map(|at| magnitude.voxels()[at] >= THRESHOLDS[0] && is_ridge(&image, &magnitude, at))
        .collect();
    hysteresis(&candidates, magnitude.voxels(), size)
}

fn is_ridge(image: &ScalarImage, magnitude: &ScalarImage, at: usize) -> bool {
    let voxel = voxel_of(at, image.grid().size());
    let gradient = gradient_at(image, voxel).as_dvec3() / image.grid().spacing();
    let longest = gradient.abs().max_element();
    if longest <= 0.0 {
        return false;
    }
    let step = gradient / longest;
    let center = DVec3::from_array(voxel.map(|x| x as f64));
    let own = magnitude.voxels()[at];
    own >= linear(magnitude, center + step) && own > linear(magnitude, center - step)
}

/// Candidates connected (26 neighbours) to one above the upper threshold.
fn hysteresis(candidates: &[bool], magnitudes: &[f32], size: [usize; 3]) -> Vec<bool> {
    let mut edges: Vec<bool> = candidates.iter().zip(magnitudes).map(|(c, m)| *c && *m >= THRESHOLDS[1]).collect();
    let mut open: Vec<usize> = (0..edges.len()).filter(|at| edges[*at]).collect();
    while let Some(at) = open.pop() {
        let [i, j, k] = voxel_of(at, size);
        for z in k.saturating_sub(1)..(k + 2).min(size[2]) {
            for y in j.saturating_sub(1)..(j + 2).min(size[1]) {
                for x in i.saturating_sub(1)..(i + 2).min(size[0]) {
                    let to = x + size[0] * (y + size[1] * z);
                    if candidates[to] && !edges[to] {
                        edges[to] = true;
                        open.push(to);
                    }
                }
            }
        }
    }
    edges
}

fn percentiles(scan: &ScalarImage) -> (f32, f32) {
    let mut values: Vec<f32> = scan.voxels().iter().copied().filter(|v| *v != scan.background()).collect();
    if values.is_empty() {
        return (0.0, 1.0);
    }
    values.sort_unstable_by(f32::total_cmp);
    let at = |share: f64| values[((values.len() - 1) as f64 * share) as usize];
    (at(0.02), at(0.98))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use crate::image::resample::map_voxels;
    use glam::DMat3;

    #[test]
    fn the_edge_of_a_ball_is_a_thin_sphere() {
        let grid = Grid::new([40, 40, 40], DVec3::ONE, DVec3::splat(-20.0), DMat3::IDENTITY).unwrap();
        let scan = ScalarImage::new(
            grid,
            map_voxels(&grid, |p, _| {
                if p.length() < 12.0 {
                    100.0
                } else if p.length() < 17.0 {
                    40.0
                } else {
                    0.0
                }
            }),
            0.0,
        )
        .unwrap();
        let edges = canny_edges(&scan);
        let radii: Vec<f64> = (0..edges.len())
            .filter(|at| edges[*at])
            .map(|at| grid.index_to_world(DVec3::from_array(voxel_of(at, [40; 3]).map(|x| x as f64))).length())
            .collect();
        assert!(radii.len() > 1500);
        assert!(radii.iter().all(|r| (r - 12.0).abs() < 1.6 || (r - 17.0).abs() < 1.6));
    }
}
