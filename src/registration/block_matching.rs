//! Block matching: for every feature point the offset at which the other scan is most similar.
//!
//! # Method
//! 1. Similarity of the block at every offset of the search window ([`super::similarity`]).
//! 2. The highest value; its place to a fraction of a voxel by the quadratic that fits the 27 values around it, and for
//!    cross-correlation by least squares on the values from there ([`super::block_refinement`]).
//! 3. Confidence: the structure tensor of the block times `r^2 / (1 - r^2)`, the inverse covariance of the place of a peak of
//!    correlation r.
//! 4. Blocks without variation, with a peak below the limit or on the border of the window have no correspondence.
//!
//! # Source
//! [Bierling1988]; [Clatz2005] section III-B; [Drakopoulos2017] sections 3.7.1 and 3.7.2 (block matching).
//!
//! # Differences
//! The thesis takes whole voxels and lets a block without a match have the displacement zero; here such a block says so.
//! Scans of different spacing and orientation are compared on one isotropic grid along the fixed scan's axes.
//!
//! # Invariants
//! One match per feature point, in their order, whatever the number of threads.
//!
//! # Cost
//! Blocks in parallel; block voxels times offsets multiplications per block.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::block_refinement::refine;
use super::feature_points::voxel_of;
use super::options::SimilarityMetric;
use super::similarity::{BlockSpread, PADDING, Scratch, Search, cross_correlation, mutual_information, quantize};
use super::structure_tensor::structure_tensor;
use crate::context::RunContext;
use crate::error::{Error, Result};

/// Blocks between two looks at the cancellation flag.
const CHUNK: usize = 64;

/// A peak of correlation 1 would be trusted without limit; noise keeps real ones below this.
const MAX_CORRELATION: f64 = 0.98;

/// Whether a block has a counterpart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MatchOutcome {
    /// A peak inside the window.
    Found,
    /// The highest similarity lies on the border of the window: the counterpart may lie outside.
    AtWindowBorder,
    /// No offset is similar enough.
    TooDifferent,
    /// The block is constant.
    Constant,
}

/// The best counterpart of a block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlockMatch {
    /// Offset of the block's centre in the grid.
    pub at: usize,
    /// From the block to its counterpart, mm along the axes of the grid; zero where none was found.
    pub shift: DVec3,
    /// Similarity of the counterpart, at most 1.
    pub similarity: f32,
    /// Confidence, 1/mm^2, along the axes of the grid.
    pub confidence: DMat3,
    /// Whether there is a counterpart.
    pub outcome: MatchOutcome,
}

/// A scan on the working grid, ready for matching.
#[derive(Debug, Clone)]
pub struct MatchImage {
    /// Values, i fastest, with [`PADDING`] values more at the end.
    padded: Vec<f32>,
    levels: Vec<u8>,
    spread: BlockSpread,
}

impl MatchImage {
    /// Prepares the values of a scan on a grid of `size` voxels for a metric and blocks of `half_block`.
    pub fn new(mut values: Vec<f32>, size: [usize; 3], half_block: [usize; 3], metric: SimilarityMetric) -> Self {
        let (levels, spread) = match metric {
            SimilarityMetric::CrossCorrelation => (Vec::new(), BlockSpread::new(&values, size, half_block)),
            SimilarityMetric::MutualInformation => (quantize(&values), BlockSpread::default()),
        };
        values.extend([0.0; PADDING]);
        Self { padded: values, levels, spread }
    }

    /// Values, i fastest.
    pub fn values(&self) -> &[f32] {
        &self.padded[..self.padded.len() - PADDING]
    }
}

/// What all blocks of a call share.
#[derive(Debug, Clone, Copy)]
pub struct MatchSettings {
    /// Voxels of the grid.
    pub size: [usize; 3],
    /// Spacing of the isotropic grid, mm.
    pub spacing: f64,
    /// Half size of a block, voxels.
    pub half_block: [usize; 3],
    /// Half size of the window, voxels.
    pub half_window: [usize; 3],
    /// Similarity.
    pub metric: SimilarityMetric,
    /// Least similarity.
    pub min_similarity: f64,
}

impl MatchSettings {
    /// Checks that blocks and windows fit into the grid.
    ///
    /// # Errors
    /// [`Error::InvalidInput`] naming the axis.
    pub fn check(&self) -> Result<()> {
        for (axis, name) in ["X", "Y", "Z"].into_iter().enumerate() {
            let (block, window) = (2 * self.half_block[axis] + 1, 2 * self.half_window[axis] + 1);
            if block > self.size[axis] || window > self.size[axis] {
                return Err(Error::input(format!(
                    "axis {name}: a block of {block} voxels or a window of {window} is larger than the image of {} voxels at {} mm",
                    self.size[axis], self.spacing
                )));
            }
        }
        Ok(())
    }
}

/// The best counterpart in `target` of the blocks of `source` around `centers`; only voxels of `mask` count.
///
/// # Errors
/// [`Error::Cancelled`], [`Error::LimitReached`]; as [`MatchSettings::check`].
pub fn match_blocks(
    source: &MatchImage,
    mask: &[bool],
    target: &MatchImage,
    centers: &[usize],
    settings: &MatchSettings,
    context: &RunContext,
) -> Result<Vec<BlockMatch>> {
    settings.check()?;
    let parts: Vec<Vec<BlockMatch>> = centers
        .par_chunks(CHUNK)
        .map_init(Scratch::default, |scratch, chunk| {
            context.check()?;
            Ok(chunk.iter().map(|&at| match_block(source, mask, target, at, settings, scratch)).collect())
        })
        .collect::<Result<_>>()?;
    Ok(parts.into_iter().flatten().collect())
}

fn match_block(
    source: &MatchImage,
    mask: &[bool],
    target: &MatchImage,
    at: usize,
    settings: &MatchSettings,
    scratch: &mut Scratch,
) -> BlockMatch {
    let center = voxel_of(at, settings.size);
    let search = Search::new(center, settings.half_block, settings.half_window, settings.size);
    let size = settings.size;
    let varies = match settings.metric {
        SimilarityMetric::CrossCorrelation => {
            cross_correlation(&source.padded, Some(mask), (&target.padded, &target.spread), size, &search, scratch)
        }
        SimilarityMetric::MutualInformation => {
            mutual_information(&source.levels, Some(mask), &target.levels, size, &search, scratch)
        }
    };
    let none = BlockMatch {
        at,
        shift: DVec3::ZERO,
        similarity: 0.0,
        confidence: DMat3::ZERO,
        outcome: MatchOutcome::Constant,
    };
    if !varies {
        return none;
    }
    let (place, similarity) = highest(&scratch.scores, &search);
    let extent = search.extent();
    let on_border = (0..3).any(|axis| extent[axis] > 1 && (place[axis] == 0 || place[axis] + 1 == extent[axis]));
    let outcome = if f64::from(similarity) < settings.min_similarity {
        MatchOutcome::TooDifferent
    } else if on_border {
        MatchOutcome::AtWindowBorder
    } else {
        MatchOutcome::Found
    };
    if outcome != MatchOutcome::Found {
        return BlockMatch { similarity, outcome, ..none };
    }
    let whole = DVec3::from_array([0, 1, 2].map(|axis| (place[axis] as isize + search.low[axis]) as f64));
    let mut shift = whole + sub_voxel(&scratch.scores, extent, place);
    if settings.metric == SimilarityMetric::CrossCorrelation {
        shift = refine(&source.padded, mask, &target.padded, size, &search, shift).unwrap_or(shift);
    }
    let squared = f64::from(similarity).clamp(0.0, MAX_CORRELATION).powi(2);
    let tensor = structure_tensor(source.values(), Some(mask), size, center, settings.half_block, settings.spacing);
    BlockMatch {
        at,
        shift: shift * settings.spacing,
        similarity,
        confidence: tensor * (squared / (1.0 - squared)),
        outcome,
    }
}

/// Place and value of the highest score; of equal ones the nearest to offset zero, then the first.
fn highest(scores: &[f32], search: &Search) -> ([usize; 3], f32) {
    let extent = search.extent();
    let most = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let place = |at: usize| [at % extent[0], at / extent[0] % extent[1], at / (extent[0] * extent[1])];
    let far = |at: usize| -> isize {
        let p = place(at);
        (0..3).map(|axis| (p[axis] as isize + search.low[axis]).pow(2)).sum()
    };
    let best = (0..scores.len()).filter(|&at| scores[at] == most).min_by_key(|&at| far(at)).unwrap_or(0);
    (place(best), most)
}

/// Vertex of the quadratic through the scores around an inner place, at most one voxel away per axis.
fn sub_voxel(scores: &[f32], extent: [usize; 3], place: [usize; 3]) -> DVec3 {
    let at = |step: [isize; 3]| -> f64 {
        let p = [0, 1, 2].map(|axis| (place[axis] as isize + if extent[axis] > 1 { step[axis] } else { 0 }) as usize);
        f64::from(scores[p[0] + extent[0] * (p[1] + extent[1] * p[2])])
    };
    let unit = |axis: usize, sign: isize| {
        let mut step = [0; 3];
        step[axis] = sign;
        step
    };
    let top = at([0; 3]);
    let mut gradient = DVec3::ZERO;
    let mut hessian = DMat3::ZERO;
    for axis in 0..3 {
        let (low, high) = (at(unit(axis, -1)), at(unit(axis, 1)));
        gradient[axis] = 0.5 * (high - low);
        hessian.col_mut(axis)[axis] = (high + low - 2.0 * top).min(-1e-9);
    }
    for (a, b) in [(0, 1), (0, 2), (1, 2)] {
        let corner = |sa: isize, sb: isize| {
            let mut step = [0; 3];
            (step[a], step[b]) = (sa, sb);
            at(step)
        };
        let mixed = 0.25 * (corner(1, 1) + corner(-1, -1) - corner(1, -1) - corner(-1, 1));
        hessian.col_mut(a)[b] = mixed;
        hessian.col_mut(b)[a] = mixed;
    }
    let separate = DVec3::from_array([0, 1, 2].map(|axis| -gradient[axis] / hessian.col(axis)[axis]));
    let peak = if hessian.determinant() < -1e-18 { -(hessian.inverse() * gradient) } else { separate };
    // Past a voxel the neighbour would have been the highest: the fit is not a peak.
    let peak = if peak.is_finite() && peak.abs().max_element() <= 1.0 { peak } else { separate };
    peak.clamp(DVec3::splat(-1.0), DVec3::splat(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 3] = [40, 36, 32];

    fn texture(shift: DVec3) -> Vec<f32> {
        (0..SIZE.iter().product())
            .map(|at| {
                let [i, j, k] = voxel_of(at, SIZE);
                let p = DVec3::new(i as f64, j as f64, k as f64) - shift;
                ((p.x * 0.75).sin() + (p.y * 0.8).cos() + (p.z * 0.7).sin()) as f32
            })
            .collect()
    }

    fn settings(metric: SimilarityMetric) -> MatchSettings {
        MatchSettings {
            size: SIZE,
            spacing: 1.5,
            half_block: [2, 2, 2],
            half_window: [3, 3, 3],
            metric,
            min_similarity: 0.1,
        }
    }

    #[test]
    fn a_fractional_shift_is_found_with_any_threads() {
        let shift = DVec3::new(1.4, -0.7, 1.8);
        let prepare = |values| MatchImage::new(values, SIZE, [2, 2, 2], SimilarityMetric::CrossCorrelation);
        let (source, target) = (prepare(texture(DVec3::ZERO)), prepare(texture(shift)));
        let centers: Vec<usize> = (0..40).map(|n| 10 + n % 20 + SIZE[0] * (12 + n / 4 + SIZE[1] * 14)).collect();
        let mask = vec![true; SIZE.iter().product()];
        let run = |threads| {
            let context = RunContext::with_threads(threads).unwrap();
            let settings = settings(SimilarityMetric::CrossCorrelation);
            context.install(|| match_blocks(&source, &mask, &target, &centers, &settings, &context)).unwrap()
        };
        let matches = run(1);
        assert_eq!(matches, run(2));
        for found in matches {
            assert_eq!(found.outcome, MatchOutcome::Found);
            // The parabolas through the peak end 0.45 away.
            assert!((found.shift / 1.5 - shift).length() < 0.1, "{}", found.shift / 1.5);
        }
    }

    #[test]
    fn windows_larger_than_the_image_are_refused() {
        let mut large = settings(SimilarityMetric::CrossCorrelation);
        large.half_window = [4, 20, 4];
        assert!(large.check().unwrap_err().to_string().contains("axis Y"));
    }
}
