//! Orders of points that keep neighbours in space near in memory and in time: Hilbert curve and BRIO.
//!
//! # Method
//! 1. [`hilbert_order`] scales the points to a cube of 2^20 cells a side and sorts them by their position on the
//!    Hilbert curve, ties by index. A position is found by a table of 24 curve orientations, two levels a look-up.
//! 2. [`brio_order`] deals positions to rounds at random, seven eighths to the last round, seven eighths of the rest
//!    to the one before, and so on; within a round the positions keep their order.
//! # Source
//! Curve orientations as (entry corner, direction) [Hamilton2006] section 2; rounds [AmentaChoiRote2003], with the
//! share of the last round as in common practice.
//! # Differences
//! One curve order for all rounds: the storage order is the curve order of all points, so that the tets of late
//! rounds find the points of early ones nearby in memory.
//! # Cost
//! O(n log n); 16 B a point while sorting. The order depends only on points and seed, not on the thread count.

use glam::DVec3;
use rayon::prelude::*;

use crate::error::{Error, Result};

/// Levels of the curve: cells of 2^-20 of the longest side tell points apart that a mesh tells apart.
const LEVELS: u32 = 20;

/// One point in `BRIO_SHARE` goes to an earlier round. Chosen on benches/delaunay.rs, flat between 4 and 16.
const BRIO_SHARE: u64 = 8;

/// A first round of fewer positions is not split further.
const SMALLEST_ROUND: usize = 256;

/// Below this many points threads cost more than they save.
const PARALLEL_POINTS: usize = 100_000;

/// For each orientation `3 * entry + direction` and each octant: place on the curve and orientation within it.
const STEPS: [[(u8, u8); 8]; 24] = single_steps();

/// The same for two levels at once; the index holds two bits of x, then y, then z. Entry: `orientation << 6 | place`.
static DOUBLE_STEPS: [[u16; 64]; 24] = double_steps();

const fn rotate_left(bits: usize, by: usize) -> usize {
    let by = by % 3;
    ((bits << by) | (bits >> (3 - by))) & 7
}

const fn gray(place: usize) -> usize {
    place ^ (place >> 1)
}

const fn single_steps() -> [[(u8, u8); 8]; 24] {
    let mut steps = [[(0, 0); 8]; 24];
    let mut orientation = 0;
    while orientation < 24 {
        let (entry, direction) = (orientation / 3, orientation % 3);
        let mut octant = 0;
        while octant < 8 {
            // [Hamilton2006] algorithm 2: rotR(octant ^ entry, direction + 1), then the inverse Gray code.
            let turned = rotate_left(octant ^ entry, 3 - (direction + 1) % 3);
            let place = turned ^ (turned >> 1) ^ (turned >> 2);
            let (local_entry, local_direction) = if place == 0 {
                (0, 0)
            } else {
                let ones = if place.is_multiple_of(2) { place - 1 } else { place };
                (gray(2 * ((place - 1) / 2)), (ones.trailing_ones() % 3) as usize)
            };
            let next_entry = entry ^ rotate_left(local_entry, direction + 1);
            let next_direction = (direction + local_direction + 1) % 3;
            steps[orientation][octant] = (place as u8, (3 * next_entry + next_direction) as u8);
            octant += 1;
        }
        orientation += 1;
    }
    steps
}

const fn double_steps() -> [[u16; 64]; 24] {
    let mut steps = [[0; 64]; 24];
    let mut orientation = 0;
    while orientation < 24 {
        let mut cell = 0;
        while cell < 64 {
            let high = (cell >> 5 & 1) | (cell >> 3 & 1) << 1 | (cell >> 1 & 1) << 2;
            let low = (cell >> 4 & 1) | (cell >> 2 & 1) << 1 | (cell & 1) << 2;
            let (first, middle) = STEPS[orientation][high];
            let (second, last) = STEPS[middle as usize][low];
            steps[orientation][cell] = (last as u16) << 6 | (first as u16) << 3 | second as u16;
            cell += 1;
        }
        orientation += 1;
    }
    steps
}

/// The place on the Hilbert curve of a cell with coordinates below 2^20.
fn hilbert_place(cell: [u32; 3]) -> u64 {
    let mut orientation = 0;
    let mut place = 0;
    let mut shift = LEVELS;
    while shift > 0 {
        shift -= 2;
        let bits = (cell[0] >> shift & 3) << 4 | (cell[1] >> shift & 3) << 2 | (cell[2] >> shift & 3);
        let step = DOUBLE_STEPS[orientation][bits as usize];
        orientation = usize::from(step >> 6);
        place = place << 6 | u64::from(step & 63);
    }
    place
}

/// The indices of `points` along the Hilbert curve. On a rayon pool of several threads it uses them all.
///
/// # Errors
/// `CapacityExceeded` for more points than 32-bit indices.
pub fn hilbert_order(points: &[DVec3]) -> Result<Vec<u32>> {
    if points.len() >= u32::MAX as usize {
        return Err(Error::CapacityExceeded {
            what: "points",
            needed: points.len() as u64,
            limit: u64::from(u32::MAX) - 1,
        });
    }
    let low = points.iter().copied().fold(DVec3::INFINITY, DVec3::min);
    let high = points.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
    let side = (high - low).max_element();
    // Halves first: the difference of finite coordinates may overflow.
    let scale = if side > 0.0 && side.is_finite() { f64::from((1u32 << LEVELS) - 1) / side } else { 0.0 };
    let place = |(index, point): (usize, &DVec3)| {
        let cell = (*point - low) * scale;
        (hilbert_place([cell.x as u32, cell.y as u32, cell.z as u32]), index as u32)
    };
    let mut places: Vec<(u64, u32)>;
    if points.len() < PARALLEL_POINTS || rayon::current_num_threads() == 1 {
        places = points.iter().enumerate().map(place).collect();
        places.sort_unstable();
    } else {
        places = points.par_iter().enumerate().map(place).collect();
        places.par_sort_unstable();
    }
    Ok(places.into_iter().map(|(_, index)| index).collect())
}

/// Positions `0..count` in rounds: the order, and the end of each round in it.
pub fn brio_order(count: usize, seed: u64) -> (Vec<u32>, Vec<usize>) {
    let mut rounds = 1;
    let mut first = count;
    while first > SMALLEST_ROUND {
        first /= BRIO_SHARE as usize;
        rounds += 1;
    }
    let round_of = |position: usize| {
        let mut random = mix(seed ^ (position as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let mut round = rounds - 1;
        while round > 0 && random.is_multiple_of(BRIO_SHARE) {
            random /= BRIO_SHARE;
            round -= 1;
        }
        round
    };
    let mut starts = vec![0usize; rounds + 1];
    for position in 0..count {
        starts[round_of(position) + 1] += 1;
    }
    for round in 0..rounds {
        starts[round + 1] += starts[round];
    }
    let ends = starts[1..].to_vec();
    let mut order = vec![0; count];
    for position in 0..count {
        let next = &mut starts[round_of(position)];
        order[*next] = position as u32;
        *next += 1;
    }
    (order, ends)
}

/// A well mixed word of a word (the finaliser of SplitMix64).
pub fn mix(mut word: u64) -> u64 {
    word = (word ^ word >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    word = (word ^ word >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    word ^ word >> 31
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn consecutive_cells_of_the_curve_touch() {
        // The 512 cells of a cube of 8 cells a side, at the coarse end of the curve.
        let shift = LEVELS - 3;
        let mut cells = Vec::new();
        for i in 0..512u32 {
            let cell = [i & 7, i >> 3 & 7, i >> 6];
            cells.push((hilbert_place(cell.map(|c| c << shift)), cell));
        }
        cells.sort_unstable();
        for pair in cells.windows(2) {
            let distance: u32 = (0..3).map(|i| pair[0].1[i].abs_diff(pair[1].1[i])).sum();
            assert_eq!(distance, 1, "{pair:?}");
        }
    }

    #[test]
    fn order_is_a_permutation_even_for_equal_points() {
        let mut points: Vec<DVec3> = (0..500).map(|i| DVec3::splat(f64::from(i % 7))).collect();
        points.push(DVec3::new(1e300, -1e300, 0.0));
        let mut order = hilbert_order(&points).unwrap();
        order.sort_unstable();
        assert!(order.iter().enumerate().all(|(i, &o)| i == o as usize));
        assert!(hilbert_order(&[]).unwrap().is_empty());
    }

    #[test]
    fn brio_rounds_grow_and_keep_every_position_once() {
        let (order, ends) = brio_order(100_000, 7);
        assert_eq!(*ends.last().unwrap(), order.len());
        assert!(ends.len() == 4 && ends[0] > 50 && ends[0] < 1000, "{ends:?}");
        assert!(order[ends[2]..].is_sorted());
        let mut sorted = order;
        sorted.sort_unstable();
        assert!(sorted.iter().enumerate().all(|(i, &o)| i == o as usize));
    }
}
