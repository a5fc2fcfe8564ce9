//! Blocks without correspondence: paired with the nearest point of the brain surface of the fixed scan.
//!
//! # Method
//! 1. Such a block of the moving scan counts only where the fixed scan has no tissue: tissue that has moved away from there lies
//!    behind the surface.
//! 2. The nearest surface voxel: voxels around the block in order of their distance, until one is on the surface.
//! 3. Its displacement is cut to the longest one that the window allows.
//!
//! 4. The boundary of tumour that is gone, where it still lies outside of the cavity, is paired with the nearest wall of the cavity.
//!
//! # Source
//! [Drakopoulos2017] section 3.7.2 (PCBM), eq. 3 and 4.
//!
//! # Differences
//! The thesis pairs every block of displacement zero; blocks inside of the tissue, where the nearest surface says nothing, are left
//! to the mechanics here. The pairing of tumour and cavity is ours: beside a cavity in white matter no block has structure, and the
//! wall would follow the mechanics alone.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::block_matching::{BlockMatch, MatchOutcome, MatchSettings};
use super::displacement_field::neighbors;
use super::feature_points::voxel_of;
use crate::image::gaussian::smooth;

/// Confidence of a paired block against that of a matched one: the surface is found, the place on it is not.
const CONFIDENCE: f64 = 0.2;

/// Replaces the matches of blocks that lie outside of `tissue` and have no correspondence; returns how many got one, and how
/// many have none after all.
pub fn pair_with_surface(matches: &mut [BlockMatch], tissue: &[bool], settings: &MatchSettings) -> (usize, usize) {
    let size = settings.size;
    // Eq. 3: the longest displacement of the window.
    let longest = (0..3).map(|axis| (settings.spacing * settings.half_window[axis] as f64).powi(2)).sum::<f64>().sqrt();
    let steps = steps_by_distance((longest / settings.spacing).ceil() as isize);
    let mut typical: Vec<f64> = matches
        .iter()
        .filter(|m| m.outcome == MatchOutcome::Found)
        .map(|m| (m.confidence.x_axis.x + m.confidence.y_axis.y + m.confidence.z_axis.z) / 3.0)
        .collect();
    typical.sort_unstable_by(f64::total_cmp);
    let confidence = typical.get(typical.len() / 2).copied().unwrap_or(1.0) * CONFIDENCE;
    let (mut paired, mut missing) = (0, 0);
    for block in matches.iter_mut().filter(|m| m.outcome != MatchOutcome::Found) {
        let nearest = if tissue[block.at] { None } else { nearest_surface(block.at, tissue, size, &steps) };
        let Some(step) = nearest else {
            missing += 1;
            continue;
        };
        paired += 1;
        let shift = step * settings.spacing;
        // Eq. 4, its upper bound.
        block.shift = shift * (longest / shift.length()).min(1.0);
        let normal = shift.normalize();
        // The surface constrains its normal only.
        block.confidence = DMat3::from_cols(normal * normal.x, normal * normal.y, normal * normal.z) * confidence;
        block.outcome = MatchOutcome::Found;
    }
    (paired, missing)
}

fn steps_by_distance(reach: isize) -> Vec<[isize; 3]> {
    let mut steps: Vec<[isize; 3]> = (-reach..=reach)
        .flat_map(|k| (-reach..=reach).flat_map(move |j| (-reach..=reach).map(move |i| [i, j, k])))
        .collect();
    let squared = |s: &[isize; 3]| s.iter().map(|x| x * x).sum::<isize>();
    steps.sort_by_key(squared);
    steps.retain(|s| squared(s) > 0 && squared(s) <= reach * reach);
    steps
}

/// Step to the nearest voxel of the tissue that has a neighbour outside of it.
fn nearest_surface(at: usize, tissue: &[bool], size: [usize; 3], steps: &[[isize; 3]]) -> Option<DVec3> {
    let voxel = voxel_of(at, size);
    steps.iter().find_map(|step| {
        let mut to = 0;
        for axis in (0..3).rev() {
            let x = voxel[axis] as isize + step[axis];
            if x < 0 || x >= size[axis] as isize {
                return None;
            }
            to = to * size[axis] + x as usize;
        }
        let on_surface = tissue[to] && neighbors(to, size).any(|n| !tissue[n]);
        on_surface.then(|| DVec3::from_array(step.map(|x| x as f64)))
    })
}

/// A tumour block of the moving scan whose best match is less similar than this shows tissue that is gone.
const GONE_BELOW: f32 = 0.72;

/// How far a block speaks for the boundary of the tumour, mm.
const SPEAKS_FOR: f64 = 9.0;

/// A point of the tumour's boundary drawn to the wall of the cavity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WallPair {
    /// Voxel of the wall of the cavity, fixed space.
    pub wall: DVec3,
    /// From the wall to the boundary of the resected tumour in the warped scan, voxels.
    pub step: DVec3,
    /// Normal of the wall.
    pub normal: DVec3,
}

/// Pairs the boundary of resected tumour that still lies outside of the cavity with the nearest wall of the cavity: tissue that
/// is gone cannot be where the fixed scan shows tissue. `tumor` and `cavity` are on one grid of `size` voxels and `spacing` mm;
/// `blocks` are the places (voxels of that grid) and best similarities of blocks of the moving scan inside the tumour.
pub fn pair_tumor_with_cavity(
    tumor: &[bool],
    cavity: &[bool],
    size: [usize; 3],
    spacing: f64,
    blocks: &[(DVec3, f32)],
    longest: f64,
) -> Vec<WallPair> {
    if !cavity.contains(&true) {
        return Vec::new();
    }
    let filled: Vec<f32> = cavity.iter().map(|c| f32::from(u8::from(*c))).collect();
    let smooth = smooth(&filled, size, [1.2; 3]);
    let steps = steps_by_distance((longest / spacing).ceil() as isize);
    let is_boundary = |at: usize| tumor[at] && !cavity[at] && neighbors(at, size).any(|n| !tumor[n] && !cavity[n]);
    let boundary: Vec<usize> = (0..tumor.len()).filter(|at| is_boundary(*at)).collect();
    boundary
        .par_iter()
        .filter_map(|&at| {
            let place = DVec3::from_array(voxel_of(at, size).map(|x| x as f64));
            if !is_gone(place, blocks, spacing) {
                return None;
            }
            let step = nearest_surface(at, cavity, size, &steps)?;
            let wall = place + step;
            let normal = slope(&smooth, size, wall);
            (normal.length() > 0.0).then(|| WallPair { wall, step: -step, normal: normal.normalize() })
        })
        .collect()
}

/// Whether the blocks around a place say that its tissue is gone: the median of their similarities is low.
fn is_gone(place: DVec3, blocks: &[(DVec3, f32)], spacing: f64) -> bool {
    let mut near: Vec<f32> =
        blocks.iter().filter(|(at, _)| (*at - place).length() * spacing < SPEAKS_FOR).map(|(_, s)| *s).collect();
    near.sort_unstable_by(f32::total_cmp);
    near.get(near.len() / 2).is_some_and(|median| *median < GONE_BELOW)
}

/// Central differences at a voxel.
fn slope(values: &[f32], size: [usize; 3], place: DVec3) -> DVec3 {
    let strides = [1, size[0], size[0] * size[1]];
    let voxel = place.to_array().map(|x| x as usize);
    let at = voxel[0] + size[0] * (voxel[1] + size[1] * voxel[2]);
    DVec3::from_array([0, 1, 2].map(|axis| {
        let low = if voxel[axis] > 0 { at - strides[axis] } else { at };
        let high = if voxel[axis] + 1 < size[axis] { at + strides[axis] } else { at };
        f64::from(values[high] - values[low])
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registration::options::SimilarityMetric;

    #[test]
    fn tumour_that_is_gone_is_drawn_into_the_cavity() {
        let size = [24, 24, 24];
        let ball = |at: usize, radius: f64| {
            (DVec3::from_array(voxel_of(at, size).map(|x| x as f64)) - 12.0).length() <= radius
        };
        let of = |radius: f64| (0..13824).map(|at| ball(at, radius)).collect::<Vec<bool>>();
        let (tumor, cavity) = (of(8.0), of(5.0));
        let around = |similarity: f32| vec![(DVec3::splat(12.0), similarity)];
        let gone = pair_tumor_with_cavity(&tumor, &cavity, size, 1.0, &around(0.4), 10.0);
        assert!(gone.len() > 300);
        for pair in &gone {
            assert!(pair.normal.dot(DVec3::splat(12.0) - pair.wall) > 0.0);
            assert!((pair.step.length() - 3.0).abs() < 1.6);
        }
        assert!(pair_tumor_with_cavity(&tumor, &cavity, size, 1.0, &around(0.9), 10.0).is_empty());
    }

    #[test]
    fn a_block_outside_of_the_tissue_is_drawn_to_its_surface_and_no_farther_than_the_window() {
        let size = [20, 20, 20];
        let tissue: Vec<bool> = (0..8000).map(|at| at % 20 < 8).collect();
        let settings = MatchSettings {
            size,
            spacing: 2.0,
            half_block: [1; 3],
            half_window: [2; 3],
            metric: SimilarityMetric::CrossCorrelation,
            min_similarity: 0.3,
        };
        let block = |i: usize| BlockMatch {
            at: i + 20 * (10 + 20 * 10),
            shift: DVec3::ZERO,
            similarity: 0.0,
            confidence: DMat3::ZERO,
            outcome: MatchOutcome::TooDifferent,
        };
        let mut matches = [block(9), block(10), block(4), block(19)];
        assert_eq!(pair_with_surface(&mut matches, &tissue, &settings), (2, 2));
        assert_eq!(matches[0].shift, DVec3::new(-4.0, 0.0, 0.0));
        assert_eq!(matches[1].shift, DVec3::new(-6.0, 0.0, 0.0));
        assert_eq!(matches[2].outcome, MatchOutcome::TooDifferent);
        assert_eq!(matches[3].outcome, MatchOutcome::TooDifferent);
    }
}
