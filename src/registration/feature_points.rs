//! Feature points: blocks whose values vary most, kept apart by a prohibited neighbourhood.
//!
//! # Method
//! 1. Variance of the masked values of the block around every voxel of the mask, from box means of `v` and `v^2`.
//! 2. All blocks in order of falling variance, ties by position.
//! 3. Greedy selection in that order: a block is taken when no block of its prohibited neighbourhood is taken, until
//!    `floor(0.5 + N F_s)` of the N blocks are found. A quota per cell keeps the choice from crowding in one place.
//!
//! # Source
//! [Drakopoulos2017] section 3.7.1 (feature selection), 3.7.2 (parallel feature selection); [Clatz2005].
//!
//! # Differences
//! Variances and their order are computed in parallel, the greedy pass is one pass over the ordered list: the thesis splits the list
//! among threads, so that its selection depends on their number. Values outside of the mask do not enter the variance: the edge
//! of the skull-stripped brain would win everywhere. The quota per cell is ours: without it the bright rim of a tumour takes
//! most of the blocks.
//!
//! # Invariants
//! Same blocks in the same order for any number of threads.
//!
//! # Cost
//! Six separable passes and one parallel sort of the mask's voxels.

use rayon::prelude::*;

use super::options::{FeatureOptions, NonConnectivity};
use crate::image::gaussian::box_mean;

/// Edge of the cells that share the selection, in voxels of the working grid.
const CELL: usize = 8;

/// A cell takes at most this many times its even share: enough to follow structure, not enough to crowd.
const CROWDING: f64 = 1.6;

/// Least share of a block inside the mask: below it the block is mostly background.
const MIN_INSIDE: f32 = 0.5;

/// Selects feature points: offsets of block centres, in the order of selection.
pub fn select_features(values: &[f32], size: [usize; 3], mask: &[bool], options: &FeatureOptions) -> Vec<usize> {
    let ordered = ordered_blocks(values, size, mask, options.half_block);
    let wanted = (0.5 + ordered.len() as f64 * options.selection_fraction) as usize;
    let quota = cell_quota(&ordered, size, wanted);
    let mut taken = vec![false; values.len()];
    let mut in_cell = vec![0u32; quota.len()];
    let neighbors = neighborhood(options.non_connectivity);
    let mut selected = Vec::with_capacity(wanted);
    for at in ordered {
        if selected.len() == wanted {
            break;
        }
        let voxel = voxel_of(at, size);
        let cell = cell_of(voxel, size);
        if in_cell[cell] < quota[cell] && !has_taken_neighbor(voxel, size, &taken, &neighbors) {
            taken[at] = true;
            in_cell[cell] += 1;
            selected.push(at);
        }
    }
    selected
}

/// Voxels of the mask whose block lies in the image, by falling variance.
fn ordered_blocks(values: &[f32], size: [usize; 3], mask: &[bool], half: [usize; 3]) -> Vec<usize> {
    let inside: Vec<f32> = mask.par_iter().map(|&m| f32::from(u8::from(m))).collect();
    let masked: Vec<f32> = values.par_iter().zip(&inside).map(|(v, m)| v * m).collect();
    let squares: Vec<f32> = masked.par_iter().map(|v| v * v).collect();
    let (share, mean, square) =
        (box_mean(&inside, size, half), box_mean(&masked, size, half), box_mean(&squares, size, half));
    let mut blocks: Vec<(f32, u32)> = (0..values.len())
        .into_par_iter()
        .filter(|&at| mask[at] && share[at] >= MIN_INSIDE && fits(voxel_of(at, size), size, half))
        .map(|at| {
            let mean = mean[at] / share[at];
            ((square[at] / share[at] - mean * mean).max(0.0), at as u32)
        })
        .collect();
    blocks.par_sort_unstable_by(|l, r| r.0.total_cmp(&l.0).then(l.1.cmp(&r.1)));
    blocks.into_iter().map(|(_, at)| at as usize).collect()
}

/// Whether the block around a voxel lies in the image.
pub(crate) fn fits(voxel: [usize; 3], size: [usize; 3], half: [usize; 3]) -> bool {
    (0..3).all(|axis| voxel[axis] >= half[axis] && voxel[axis] + half[axis] < size[axis])
}

/// Indices of an offset.
#[inline]
pub(crate) fn voxel_of(at: usize, size: [usize; 3]) -> [usize; 3] {
    [at % size[0], at / size[0] % size[1], at / (size[0] * size[1])]
}

fn cell_of(voxel: [usize; 3], size: [usize; 3]) -> usize {
    let cells = size.map(|n| n.div_ceil(CELL));
    voxel[0] / CELL + cells[0] * (voxel[1] / CELL + cells[1] * (voxel[2] / CELL))
}

/// Most blocks per cell: its share of all blocks, times [`CROWDING`].
fn cell_quota(blocks: &[usize], size: [usize; 3], wanted: usize) -> Vec<u32> {
    let cells: usize = size.iter().map(|n| n.div_ceil(CELL)).product();
    let mut quota = vec![0u32; cells];
    for &at in blocks {
        quota[cell_of(voxel_of(at, size), size)] += 1;
    }
    let share = CROWDING * wanted as f64 / blocks.len().max(1) as f64;
    quota.iter_mut().for_each(|n| *n = (f64::from(*n) * share).ceil() as u32);
    quota
}

/// Offsets of the prohibited neighbourhood: one to three coordinates differ.
fn neighborhood(pattern: NonConnectivity) -> Vec<[isize; 3]> {
    let most = match pattern {
        NonConnectivity::Face => 1,
        NonConnectivity::Edge => 2,
        NonConnectivity::Vertex => 3,
    };
    (0..27)
        .map(|n: isize| [n % 3 - 1, n / 3 % 3 - 1, n / 9 - 1])
        .filter(|step| (1..=most).contains(&step.iter().filter(|s| **s != 0).count()))
        .collect()
}

fn has_taken_neighbor(voxel: [usize; 3], size: [usize; 3], taken: &[bool], neighbors: &[[isize; 3]]) -> bool {
    neighbors.iter().any(|step| {
        let mut at = 0;
        for axis in (0..3).rev() {
            let x = voxel[axis] as isize + step[axis];
            if x < 0 || x >= size[axis] as isize {
                return false;
            }
            at = at * size[axis] + x as usize;
        }
        taken[at]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;

    const SIZE: [usize; 3] = [24, 20, 16];

    fn scan() -> (Vec<f32>, Vec<bool>) {
        let n = SIZE.iter().product();
        let values = (0..n).map(|at| ((at * 2_654_435_761) % 1013) as f32).collect();
        (values, (0..n).map(|at| voxel_of(at, SIZE)[0] > 3).collect())
    }

    fn options(pattern: NonConnectivity) -> FeatureOptions {
        FeatureOptions { half_block: [1, 1, 1], selection_fraction: 0.05, non_connectivity: pattern }
    }

    #[test]
    fn the_selection_is_the_same_for_any_number_of_threads() {
        let (values, mask) = scan();
        let run = |threads| {
            let context = RunContext::with_threads(threads).unwrap();
            context.install(|| select_features(&values, SIZE, &mask, &options(NonConnectivity::Face)))
        };
        assert_eq!(run(1), run(3));
    }

    #[test]
    fn patterns_keep_blocks_apart() {
        let (values, mask) = scan();
        for (pattern, most) in [(NonConnectivity::Vertex, 3), (NonConnectivity::Edge, 2), (NonConnectivity::Face, 1)] {
            let selected = select_features(&values, SIZE, &mask, &options(pattern));
            assert!(selected.len() > 50, "{}", selected.len());
            for (n, &a) in selected.iter().enumerate() {
                assert!(mask[a]);
                for &b in &selected[..n] {
                    let (a, b) = (voxel_of(a, SIZE), voxel_of(b, SIZE));
                    let steps: Vec<usize> = (0..3).map(|x| a[x].abs_diff(b[x])).collect();
                    let differing = steps.iter().filter(|s| **s > 0).count();
                    assert!(steps.iter().any(|s| *s > 1) || differing > most, "{pattern:?} {a:?} {b:?}");
                }
            }
        }
    }
}
