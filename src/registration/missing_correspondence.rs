//! Blocks without correspondence: paired with the nearest point of the brain surface of the fixed scan.
//!
//! # Method
//! 1. Such a block of the moving scan counts only where the fixed scan has no tissue: tissue that has moved away from there lies
//!    behind the surface.
//! 2. The nearest surface voxel: voxels around the block in order of their distance, until one is on the surface.
//! 3. Its displacement is cut to the longest one that the window allows.
//!
//! # Source
//! [Drakopoulos2017] section 3.7.2 (PCBM), eq. 3 and 4.
//!
//! # Differences
//! The thesis pairs every block of displacement zero; blocks inside of the tissue, where the nearest surface says nothing, are left
//! to the mechanics here.

use glam::{DMat3, DVec3};

use super::block_matching::{BlockMatch, MatchOutcome, MatchSettings};
use super::displacement_field::neighbors;
use super::feature_points::voxel_of;

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registration::options::SimilarityMetric;

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
