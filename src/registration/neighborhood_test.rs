//! Matches that contradict their neighbours.
//!
//! # Method
//! For every match the component-wise median of the shifts of its nearest neighbours, and the median distance of these shifts
//! from it. A match that is farther from the median than a multiple of that distance plus the uncertainty of a match is dropped.
//! Distances are weighted by the confidence of the tested match: what an edge says about the direction along it does not count.
//!
//! # Source
//! [WesterweelScarano2005], the normalised median test.
//!
//! # Differences
//! Neighbours are the nearest of scattered points; the weighting is ours.
//!
//! # Invariants
//! Same result for any number of threads.
//!
//! # Cost
//! About a hundred distances per match.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

/// Neighbours that a match is compared with.
const NEIGHBORS: usize = 16;

/// With fewer neighbours nothing is concluded.
const FEWEST: usize = 6;

/// A match may deviate by this many times the spread of its neighbours.
const FACTOR: f64 = 3.0;

/// Which matches agree with their neighbours; `reach` is the largest distance of a neighbour and `uncertainty` that of a single
/// shift, both mm.
pub fn agreeing(points: &[DVec3], shifts: &[DVec3], weights: &[DMat3], reach: f64, uncertainty: f64) -> Vec<bool> {
    let buckets = Buckets::new(points, reach);
    (0..points.len())
        .into_par_iter()
        .map_init(Vec::new, |near, at| {
            buckets.nearest(points, at, reach, near);
            if near.len() < FEWEST {
                return true;
            }
            let median = DVec3::from_array([0, 1, 2].map(|axis| {
                let mut values: Vec<f64> = near.iter().map(|(_, n)| shifts[*n as usize][axis]).collect();
                middle(&mut values)
            }));
            let metric = weights[at];
            let trace = (metric.x_axis.x + metric.y_axis.y + metric.z_axis.z) / 3.0;
            let distance = |shift: DVec3| {
                let step = shift - median;
                if trace > 0.0 { (step.dot(metric * step) / trace).max(0.0).sqrt() } else { step.length() }
            };
            let mut spread: Vec<f64> = near.iter().map(|(_, n)| distance(shifts[*n as usize])).collect();
            distance(shifts[at]) <= FACTOR * (middle(&mut spread) + uncertainty)
        })
        .collect()
}

fn middle(values: &mut [f64]) -> f64 {
    let at = values.len() / 2;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}

/// Points sorted into cubes.
struct Buckets {
    low: DVec3,
    edge: f64,
    size: [usize; 3],
    offsets: Vec<u32>,
    entries: Vec<u32>,
}

impl Buckets {
    fn new(points: &[DVec3], edge: f64) -> Self {
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        points.iter().for_each(|p| (low, high) = (low.min(*p), high.max(*p)));
        // More cubes than this are no faster; far apart points get larger ones.
        const MOST: f64 = 256.0;
        let edge = if points.is_empty() { edge } else { edge.max((high - low).max_element() / MOST) };
        let size = if points.is_empty() { [1; 3] } else { ((high - low) / edge).to_array().map(|x| x as usize + 1) };
        let mut buckets = Self {
            low,
            edge,
            size,
            offsets: vec![0; size.iter().product::<usize>() + 1],
            entries: vec![0; points.len()],
        };
        let cells: Vec<usize> = points.iter().map(|p| buckets.offset(buckets.cell(*p))).collect();
        cells.iter().for_each(|cell| buckets.offsets[cell + 1] += 1);
        for cell in 1..buckets.offsets.len() {
            buckets.offsets[cell] += buckets.offsets[cell - 1];
        }
        let mut fill = buckets.offsets.clone();
        for (at, cell) in cells.into_iter().enumerate() {
            buckets.entries[fill[cell] as usize] = at as u32;
            fill[cell] += 1;
        }
        buckets
    }

    fn cell(&self, point: DVec3) -> [usize; 3] {
        let place = (point - self.low) / self.edge;
        [0, 1, 2].map(|axis| (place[axis].max(0.0) as usize).min(self.size[axis] - 1))
    }

    fn offset(&self, cell: [usize; 3]) -> usize {
        cell[0] + self.size[0] * (cell[1] + self.size[1] * cell[2])
    }

    /// The nearest [`NEIGHBORS`] other points within `reach`, with their squared distances.
    fn nearest(&self, points: &[DVec3], at: usize, reach: f64, near: &mut Vec<(f64, u32)>) {
        near.clear();
        let cell = self.cell(points[at]);
        let range = |axis: usize| cell[axis].saturating_sub(1)..=(cell[axis] + 1).min(self.size[axis] - 1);
        for k in range(2) {
            for j in range(1) {
                for i in range(0) {
                    let bucket = self.offset([i, j, k]);
                    for &n in &self.entries[self.offsets[bucket] as usize..self.offsets[bucket + 1] as usize] {
                        let squared = points[at].distance_squared(points[n as usize]);
                        if n as usize != at && squared <= reach * reach {
                            near.push((squared, n));
                        }
                    }
                }
            }
        }
        if near.len() > NEIGHBORS {
            near.select_nth_unstable_by(NEIGHBORS - 1, |l, r| l.0.total_cmp(&r.0).then(l.1.cmp(&r.1)));
            near.truncate(NEIGHBORS);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matches_that_contradict_their_neighbours_are_found_in_a_field_with_a_gradient() {
        let points: Vec<DVec3> =
            (0..1000).map(|n| DVec3::new((n % 10) as f64, (n / 10 % 10) as f64, (n / 100) as f64) * 3.0).collect();
        let wrong = |n: usize| n.is_multiple_of(37);
        let shifts: Vec<DVec3> = points
            .iter()
            .enumerate()
            .map(|(n, p)| {
                DVec3::new(0.1 * p.x, 0.05 * p.z, 0.0) + if wrong(n) { DVec3::new(0.0, 5.0, 0.0) } else { DVec3::ZERO }
            })
            .collect();
        let weights = vec![DMat3::IDENTITY; 1000];
        let kept = agreeing(&points, &shifts, &weights, 8.0, 0.3);
        assert!((0..1000).all(|n| kept[n] != wrong(n)));
        // An edge that says nothing about y does not contradict.
        let blind = vec![DMat3::from_diagonal(DVec3::new(1.0, 0.0, 1.0)); 1000];
        assert!(agreeing(&points, &shifts, &blind, 8.0, 0.3).iter().all(|k| *k));
        assert!(agreeing(&[], &[], &[], 8.0, 0.3).is_empty());
    }
}
