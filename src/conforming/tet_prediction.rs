//! How many tets a refinement will make, before it starts.
//!
//! # Method
//! 1. The sizes at the corners of the present tets are interpolated; the field bounds them at the centre of each tet.
//! 2. Where sizes differ within a tet, its longest edge is halved again and again. At the middle the size is the average
//!    of the two ends, but grows from the smaller end at most by the rate of the advancing front.
//! 3. Volume over the volume of the regular tet of that size, summed. Where there are many tets, only one half of a part
//!    is followed after some halvings, by chance and with the weight that leaves the expected sum the same.
//!
//! # Source
//! Our own; the growth rate is [Drakopoulos2017] B.3 `cdfr`.
//!
//! # Cost
//! Linear in the present tets; where sizes differ, at most `FULL_PARTS` times `PREDICTION_DEPTH` parts besides. Parallel
//! over fixed ranges with random numbers by tet, so that the sum does not depend on the number of threads.

use glam::DVec3;
use rayon::prelude::*;

use super::front::corner_sizes;
use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::spatial_sort::mix;
use crate::geometry::tetrahedron::volume;
use crate::index::{Label, TetId};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::size_field::SizeField;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;

/// Volume of the regular tet over the cube of its edge.
const REGULAR_VOLUME: f64 = 0.117_851_130_197_757_9;
/// Average edge over size taken for a finished mesh, to predict the number of tets: an estimate, since points may stand
/// closer or further apart than the size.
const MEAN_STRETCH: f64 = 1.05;
/// Tets per parallel part of the prediction.
const PREDICTION_CHUNK: usize = 512;
/// Most halvings of a tet in the prediction: parts are then about a tenth of it along every axis.
const PREDICTION_DEPTH: usize = 10;
/// Parts, over all tets, up to which both halves are followed. The sum of so many independent estimates is good to a few
/// percent.
const FULL_PARTS: usize = 1 << 16;
/// Sizes within this factor count as one.
const EVEN_SIZES: f64 = 1.6;
/// Height of the regular tet over its edge.
const EQUILATERAL_HEIGHT: f64 = 0.816_496_580_927_726;

/// How many tets the refinement will make, from the sizes at the corners of the present tets, the field inside and the
/// growth rate (`cdfr`).
///
/// # Errors
/// As [`SizeField::bounded`].
pub fn predicted_tets(
    complex: &TetComplex,
    sizes: &[f64],
    field: &SizeField,
    growth: f64,
    context: &RunContext,
) -> Result<f64> {
    let slope = (growth - 1.0) / EQUILATERAL_HEIGHT;
    let full_depth = (FULL_PARTS / complex.live_count().max(1)).max(1).ilog2() as usize;
    let share = |tets: std::ops::Range<usize>| -> Result<f64> {
        let mut total = 0.0;
        for tet in tets.map(TetId::from_index) {
            if complex.is_live(tet) && !complex.is_ghost_tet(tet) && !complex.label(tet).is_background() {
                let (corners, sizes) = (complex.points_of(tet), corner_sizes(complex, sizes, tet));
                let part = Part { corners, sizes, depth: 0, weight: 1.0 };
                let split = Split { slope, full_depth, random: mix(u64::from(tet.0)) };
                total += part.count(field, complex.label(tet), split)?;
            }
        }
        Ok(total)
    };
    // Sums over fixed ranges, added in order: the same for any number of threads.
    let slots = complex.slot_count();
    let shares: Vec<f64> = context.install(|| {
        let starts: Vec<usize> = (0..slots).step_by(PREDICTION_CHUNK).collect();
        let ranges = starts.into_par_iter().map(|first| first..(first + PREDICTION_CHUNK).min(slots));
        ranges.map(share).collect::<Result<_>>()
    })?;
    Ok(shares.iter().sum())
}

/// Part of a tet, for the prediction.
#[derive(Clone, Copy)]
struct Part {
    corners: [DVec3; 4],
    sizes: [f64; 4],
    depth: usize,
    /// Parts that it stands for.
    weight: f64,
}

/// How parts are halved.
#[derive(Clone, Copy)]
struct Split {
    slope: f64,
    /// Both halves are followed up to this depth.
    full_depth: usize,
    random: u64,
}

impl Part {
    fn count(self, field: &SizeField, label: Label, mut split: Split) -> Result<f64> {
        let mut stack = vec![self];
        let mut total = 0.0;
        while let Some(part) = stack.pop() {
            let volume = volume(part.corners) / REGULAR_VOLUME;
            let smallest = part.sizes.iter().copied().fold(f64::INFINITY, f64::min);
            let largest = part.sizes.iter().copied().fold(0.0, f64::max);
            let is_even = largest <= EVEN_SIZES * smallest || volume < smallest.powi(3);
            if is_even || part.depth == PREDICTION_DEPTH {
                let center = part.corners.iter().sum::<DVec3>() / 4.0;
                let average = part.sizes.iter().sum::<f64>() / 4.0;
                let size = MEAN_STRETCH * field.bounded_in(label, center, average)?;
                total += part.weight * volume / size.powi(3);
            } else if part.depth < split.full_depth {
                stack.extend(part.halves(split.slope));
            } else {
                // By chance, in proportion to what either is likely to count.
                split.random = mix(split.random);
                let chance = (split.random >> 11) as f64 / (1u64 << 53) as f64;
                let halves = part.halves(split.slope);
                let density = halves.map(|half| half.sizes.iter().sum::<f64>().powi(-3));
                let first = density[0] / (density[0] + density[1]);
                let (half, share) = if chance < first { (halves[0], first) } else { (halves[1], 1.0 - first) };
                stack.push(Self { weight: part.weight / share, ..half });
            }
        }
        Ok(total)
    }

    fn halves(self, slope: f64) -> [Self; 2] {
        let length = |e: &[usize; 2]| self.corners[e[0]].distance_squared(self.corners[e[1]]);
        let [i, j] = TET_EDGES.into_iter().max_by(|e, f| length(e).total_cmp(&length(f))).unwrap_or([0, 1]);
        let middle = 0.5 * (self.corners[i] + self.corners[j]);
        let reach = slope * middle.distance(self.corners[i]);
        let size = (0.5 * (self.sizes[i] + self.sizes[j])).min(self.sizes[i].min(self.sizes[j]) + reach);
        [i, j].map(|end| {
            let mut half = Self { depth: self.depth + 1, ..self };
            (half.corners[end], half.sizes[end]) = (middle, size);
            half
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::VertexId;
    use crate::mesh::sizing::Sizing;

    #[test]
    fn a_graded_tet_counts_like_its_integral() {
        let points = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        let mut complex = TetComplex::with_points(points).unwrap();
        complex.create_tet([0, 1, 2, 3].map(VertexId), Label(1)).unwrap();
        let context = RunContext::with_threads(1).unwrap();
        let count = |sizes: [f64; 4], growth: f64| {
            predicted_tets(
                &complex,
                &sizes,
                &SizeField::new(&Sizing::default(), &[], f64::INFINITY).unwrap(),
                growth,
                &context,
            )
            .unwrap()
        };
        let even = count([0.1; 4], 1.1);
        assert!((even - (1.0 / 6.0) / (REGULAR_VOLUME * 0.105f64.powi(3))).abs() < 1e-9 * even);
        // Size 0.02 + 0.2 (x + y + z): the integral of the inverse cube over layers x + y + z = t, of area t^2 / 2 dt.
        let steps = 20_000;
        let layer = |i: usize| {
            let t = (i as f64 + 0.5) / steps as f64;
            0.5 * t * t / (REGULAR_VOLUME * (MEAN_STRETCH * (0.02 + 0.2 * t)).powi(3)) / steps as f64
        };
        let integral: f64 = (0..steps).map(layer).sum();
        let graded = count([0.02, 0.22, 0.22, 0.22], 3.0);
        assert!((graded / integral - 1.0).abs() < 0.15, "{graded} against {integral}");
        assert!(count([0.02, 0.22, 0.22, 0.22], 1.05) > graded);
    }
}
