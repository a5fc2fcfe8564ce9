//! Second differences of values on a band of voxels, and the slopes of energies that are sums of their squares.
//!
//! # Method
//! A band is gone through plane after plane, with what belongs to the last three planes only: differences of a plane are taken when the
//! values of the next one are there, what they vary by one plane later, and the slopes of the voxels again one plane later. Nothing of
//! all this is written to memory and read back, which is what such passes over a large band wait for.
//! ```text
//!    plane            p-1  p  p+1  p+2  p+3
//!    values            x   x   x    x    x
//!    differences           x   x    x
//!    their variation   x   x   x
//!    slopes                x
//! ```
//! Planes can be gone through in several parts at once: each takes the differences of a few planes beside it too.
//!
//! # Source
//! Finite differences; [RiveraTseng2000] for sweeps that keep a few planes of a grid in the cache.
//!
//! # Invariants
//! A voxel that is not in the band has no differences; one that needs such a voxel is left out. The same bits for any parts.
//!
//! # Cost
//! 28 bytes per voxel of a brick, 288 or 576 per brick of the largest plane for each part.

use std::ops::Range;

use glam::{DVec3, Vec4, Vec4Swizzles};
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::voxel_bricks::{BEFORE_PLANE, Bricks, WIDTH, lanes, lanes_of};

/// Second differences of a voxel: xx, yy, zz, xy, xz, yz.
pub const TERMS: usize = 6;

/// A value for each second difference of the voxels of a brick: what is used together lies together.
pub type Brick = [Vec4; TERMS];

/// Bricks of a plane per task.
pub const BRICKS_PER_TASK: usize = 2048;

/// What is lessened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Energy {
    /// The squares of the second differences.
    Bending,
    /// The squares of their differences between neighbours.
    Variation,
}

/// Which differences there are, and what they weigh.
pub struct SecondDifferences<'a> {
    bricks: &'a Bricks,
    /// Which of the six second differences have all their voxels (bits 0 to 5), by slot.
    terms: Vec<u32>,
    /// Weights of the second differences.
    weights: [f32; TERMS],
    /// Weights of differences between neighbours along each axis, divided by their steepest curvature.
    rates: [f32; 3],
    /// Sum of these weights over the neighbours that have a second difference too; 0 where the voxel itself has not.
    totals: Vec<Brick>,
}

/// A value for each second difference of the bricks of three planes in a row.
#[derive(Default)]
struct Rolling {
    /// Plane p is in the row p modulo 3, behind [`BEFORE_PLANE`] bricks of zeros, before one.
    rows: [Vec<Brick>; 3],
}

impl Rolling {
    fn new(bricks: &Bricks) -> Self {
        let largest = (0..bricks.plane_count()).map(|p| bricks.of_planes(p..p + 1).len()).max().unwrap_or(0);
        Self { rows: std::array::from_fn(|_| vec![[Vec4::ZERO; TERMS]; BEFORE_PLANE + largest + 1]) }
    }

    /// The bricks of a plane.
    fn of_plane(&mut self, bricks: &Bricks, plane: usize) -> &mut [Brick] {
        let count = bricks.of_planes(plane..plane + 1).len();
        &mut self.rows[plane % 3][BEFORE_PLANE..][..count]
    }

    /// The planes around one. Where a plane is not there, no brick has a place in it but that in front.
    fn around(&self, plane: usize) -> Around<'_> {
        let [near, own, far] = [plane + 2, plane, plane + 1].map(|plane| self.rows[plane % 3].as_slice());
        Around { near, own, far }
    }
}

/// What there is for each second difference of the bricks of a plane, and of the planes before and after it, by their places.
#[derive(Clone, Copy)]
pub struct Around<'a> {
    near: &'a [Brick],
    own: &'a [Brick],
    far: &'a [Brick],
}

/// A brick, and those before and after it.
#[inline]
fn three(rows: &[Brick], place: usize) -> &[Brick; 3] {
    // One check of the bounds for all.
    rows[place - 1..].first_chunk().expect("a brick is last")
}

/// Written out: maps over arrays are not inlined into all loops over bricks.
#[inline]
fn wide([a, b, c, d, e, f]: [u32; 6]) -> [usize; 6] {
    [a as usize, b as usize, c as usize, d as usize, e as usize, f as usize]
}

impl Around<'_> {
    /// Slopes of an energy at the voxels of the n-th brick of the plane, from its slopes by second differences: these transposed.
    /// `beside` are the places of the bricks beside it.
    #[inline]
    pub fn slopes(&self, n: usize, beside: &[u32; 6]) -> Vec4 {
        let [up, down, far, near, _, down_near] = wide(*beside);
        let [before, own, after] = three(self.own, BEFORE_PLANE + n);
        let [down_before, down, _] = three(self.own, down);
        let [near_before, near, _] = three(self.near, near);
        let [xx, yy, zz, xy, xz, yz] = *own;
        let (next_x, before_x) = (shifted_back(xx, after[0]), shifted_on(xx, before[0]));
        let (next_y, before_y) = (self.own[up][1], down[1]);
        let (next_z, before_z) = (self.far[far][2], near[2]);
        let (xy_x, xy_y) = (shifted_on(xy, before[3]), down[3]);
        let (xz_x, xz_z) = (shifted_on(xz, before[4]), near[4]);
        let (xy_both, xz_both) = (shifted_on(xy_y, down_before[3]), shifted_on(xz_z, near_before[4]));
        let (yz_y, yz_z, yz_both) = (down[5], near[5], self.near[down_near][5]);
        let straight = (next_x + before_x - 2.0 * xx) + (next_y + before_y - 2.0 * yy);
        let mixed = (xy - xy_x) - (xy_y - xy_both) + ((xz - xz_x) - (xz_z - xz_both));
        let rest = (next_z + before_z - 2.0 * zz) + ((yz - yz_y) - (yz_z - yz_both));
        (straight + mixed) + rest
    }

    /// The n-th brick of the plane, and those after and before it in x, y and z.
    #[inline]
    fn star(&self, n: usize, beside: &[u32; 6]) -> (&Brick, [&Brick; 6]) {
        let [up, down, far, near, ..] = wide(*beside);
        let [before, own, after] = three(self.own, BEFORE_PLANE + n);
        (own, [after, before, &self.own[up], &self.own[down], &self.far[far], &self.near[near]])
    }
}

/// What a sweep over planes has in work.
pub struct Sweep {
    bending: Rolling,
    variation: Rolling,
}

impl Sweep {
    /// Room for a sweep with an energy.
    pub fn new(bricks: &Bricks, energy: Energy) -> Self {
        let variation = if energy == Energy::Variation { Rolling::new(bricks) } else { Rolling::default() };
        Self { bending: Rolling::new(bricks), variation }
    }
}

impl<'a> SecondDifferences<'a> {
    /// The differences of a band.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn new(bricks: &'a Bricks, spacing: DVec3, context: &RunContext) -> Result<Self> {
        let inverse = (spacing * spacing).recip();
        context.check()?;
        let terms = terms_of(bricks);
        context.check()?;
        let rates = (inverse / (4.0 * inverse.element_sum())).to_array().map(|rate| rate as f32);
        let totals = totals_of(bricks, &terms, rates);
        context.check()?;
        Ok(Self { bricks, terms, weights: bending_weights(spacing), rates, totals })
    }

    /// Goes through some planes: `visit` gets each of them, with the slopes of an energy by second differences, or for
    /// [`Energy::Bending`] the weighted differences, which are these.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn sweep(
        &self,
        (energy, values): (Energy, &[f32]),
        planes: Range<usize>,
        Sweep { bending, variation }: &mut Sweep,
        context: &RunContext,
        mut visit: impl FnMut(usize, Around),
    ) -> Result<()> {
        let (bricks, count) = (self.bricks, self.bricks.plane_count());
        let lag = if energy == Energy::Variation { 2 } else { 1 };
        let first = planes.start.saturating_sub(lag);
        for plane in first..planes.end + lag {
            context.check()?;
            if plane < count {
                self.take_bending(values, plane, bending.of_plane(bricks, plane));
            }
            let varies = energy == Energy::Variation && plane > first && plane <= count;
            if varies {
                self.take_variation(plane - 1, bending.around(plane - 1), variation);
            }
            if let Some(visited) = plane.checked_sub(lag).filter(|plane| planes.contains(plane)) {
                let slopes = if energy == Energy::Variation { &*variation } else { &*bending };
                visit(visited, slopes.around(visited));
            }
        }
        Ok(())
    }

    /// The weighted second differences in a plane.
    fn take_bending(&self, values: &[f32], plane: usize, rows: &mut [Brick]) {
        let all = self.bricks.of_planes(plane..plane + 1);
        let of = |slot: usize| Vec4::from_array(*lanes(values, slot));
        in_tasks(rows, |first, rows| {
            let bricks = all.start + first..all.start + first + rows.len();
            let terms = lanes_of(&self.terms, bricks.clone());
            let places = bricks.clone().zip(self.bricks.beside(bricks));
            for (row, (terms, (brick, beside))) in rows.iter_mut().zip(terms.iter().zip(places)) {
                let (slot, [up, down, far, near, up_far, _]) = (brick * WIDTH, wide(*beside));
                let (own, x, before_x) = (of(slot), of(slot + 1), of(slot - 1));
                let (y, before_y) = (of(up), of(down));
                let (z, before_z) = (of(far), of(near));
                let (xy, xz, yz) = (of(up + 1), of(far + 1), of(up_far));
                let mut differences = [
                    x - 2.0 * own + before_x,
                    y - 2.0 * own + before_y,
                    z - 2.0 * own + before_z,
                    own - x - y + xy,
                    own - x - z + xz,
                    own - y - z + yz,
                ];
                for term in 0..TERMS {
                    differences[term] *= where_has(terms, term, self.weights[term]);
                }
                *row = differences;
            }
        });
    }

    /// Slope of the variation by each second difference of a plane: what it differs by from those of the six neighbours.
    fn take_variation(&self, plane: usize, bending: Around, variation: &mut Rolling) {
        let all = self.bricks.of_planes(plane..plane + 1);
        let rates = self.rates;
        in_tasks(variation.of_plane(self.bricks, plane), |first, rows| {
            let bricks = all.start + first..all.start + first + rows.len();
            let totals = self.totals[bricks.clone()].iter().zip(self.bricks.places(bricks));
            for (n, (row, (totals, places))) in rows.iter_mut().zip(totals).enumerate() {
                let (own, [after, before, up, down, far, near]) = bending.star(first + n, places);
                for term in 0..TERMS {
                    let (own, total) = (own[term], totals[term]);
                    let (x, before_x) = (shifted_back(own, after[term]), shifted_on(own, before[term]));
                    let along = rates[0] * (x + before_x) + rates[1] * (up[term] + down[term]);
                    let others = along + rates[2] * (far[term] + near[term]);
                    // What does not exist is 0 beside what does, and takes nothing from it.
                    row[term] = Vec4::select(total.cmpne(Vec4::ZERO), own * total - others, Vec4::ZERO);
                }
            }
        });
    }

    /// For the voxels of the n-th brick of a plane the squares of the differences of their second differences from those of the six
    /// neighbours, over the weights of these, with the rates along the axes, and the sum of the rates of all that there are.
    pub fn squares(&self, plane: usize, n: usize, bending: Around) -> [Vec4; 2] {
        let brick = self.bricks.of_planes(plane..plane + 1).start + n;
        let (beside, places) = (self.bricks.beside(brick..brick + 1)[0], self.bricks.places(brick..brick + 1)[0]);
        let (slot, [up, down, far, near, ..]) = (brick * WIDTH, wide(beside));
        let own_terms = lanes(&self.terms, slot);
        let mut sums = [Vec4::ZERO; 2];
        let slots = [slot + 1, slot - 1, up, down, far, near];
        let (own, others) = bending.star(n, &places);
        for (direction, other) in others.into_iter().enumerate() {
            let (rate, other_terms) = (self.rates[direction / 2], lanes(&self.terms, slots[direction]));
            let common: [u32; WIDTH] = std::array::from_fn(|l| own_terms[l] & other_terms[l]);
            for (term, weight) in self.weights.iter().enumerate() {
                let own = own[term];
                let other = match direction {
                    0 => shifted_back(own, other[term]),
                    1 => shifted_on(own, other[term]),
                    _ => other[term],
                };
                let (of_common, difference) = (where_has(&common, term, rate), own - other);
                sums[0] += of_common * (difference * difference) / *weight;
                sums[1] += of_common;
            }
        }
        sums
    }
}

/// Calls `work` for rows in tasks, with the number of the first of each.
fn in_tasks<T: Send>(rows: &mut [T], work: impl Fn(usize, &mut [T]) + Sync) {
    if rows.len() <= BRICKS_PER_TASK {
        // Most planes: no time for a look at who else could work.
        work(0, rows);
    } else {
        let tasks = rows.par_chunks_mut(BRICKS_PER_TASK).enumerate();
        tasks.for_each(|(task, rows)| work(task * BRICKS_PER_TASK, rows));
    }
}

/// The value for the voxels that have a second difference, 0 for the others, without a branch.
#[inline]
fn where_has(terms: &[u32; WIDTH], term: usize, value: f32) -> Vec4 {
    let mut masked = [0.0; WIDTH];
    for l in 0..WIDTH {
        masked[l] = f32::from_bits(value.to_bits() & 0u32.wrapping_sub(terms[l] >> term & 1));
    }
    Vec4::from_array(masked)
}

/// The values one voxel before those of a brick, from its own and those of the brick before.
#[inline]
fn shifted_on(own: Vec4, before: Vec4) -> Vec4 {
    own.xxyz().with_x(before.w)
}

/// The values one voxel after those of a brick, from its own and those of the brick after.
#[inline]
fn shifted_back(own: Vec4, after: Vec4) -> Vec4 {
    own.yzww().with_w(after.x)
}

/// Which second differences have all their voxels, by slot.
fn terms_of(bricks: &Bricks) -> Vec<u32> {
    let mut has = vec![false; bricks.slot_count()];
    bricks.slots().iter().for_each(|slot| has[*slot as usize] = true);
    let mut terms = vec![0; has.len()];
    for slot in bricks.slots().iter().map(|slot| *slot as usize) {
        let beside = bricks.beside(slot / WIDTH..slot / WIDTH + 1)[0].map(|first| first as usize + slot % WIDTH);
        let [up, down, far, near, up_far, _] = beside;
        let [x, y, z] = [slot + 1, up, far].map(|slot| has[slot]);
        let pairs = [x && has[slot - 1], y && has[down], z && has[near]];
        let squares = [x && y && has[up + 1], x && z && has[far + 1], y && z && has[up_far]];
        terms[slot] = pairs.into_iter().chain(squares).enumerate().map(|(bit, term)| u32::from(term) << bit).sum();
    }
    terms
}

/// Sums of the rates over the neighbours that have a second difference too, by brick.
fn totals_of(bricks: &Bricks, terms: &[u32], rates: [f32; 3]) -> Vec<Brick> {
    let mut totals = vec![[Vec4::ZERO; TERMS]; terms.len() / WIDTH];
    for slot in bricks.slots() {
        let at = *slot as usize;
        let axes = bricks.neighbors(*slot).into_iter().zip(rates);
        for (term, of_brick) in totals[at / WIDTH].iter_mut().enumerate() {
            let of_axis = |(neighbors, rate): ([usize; 2], f32)| {
                neighbors.into_iter().filter(|other| terms[at] & terms[*other] & 1 << term != 0).count() as f32 * rate
            };
            of_brick[at % WIDTH] = axes.clone().map(of_axis).sum();
        }
    }
    totals
}

/// Weights of the six second differences, divided by the steepest curvature of the energy.
fn bending_weights(spacing: DVec3) -> [f32; TERMS] {
    let inverse = (spacing * spacing).recip();
    let steepest = (4.0 * inverse.element_sum()).powi(2);
    let [x, y, z] = inverse.to_array();
    [x * x, y * y, z * z, 2.0 * x * y, 2.0 * x * z, 2.0 * y * z].map(|w| (w / steepest) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 3] = [11, 5, 6];
    const SPACING: DVec3 = DVec3::new(0.8, 1.0, 1.3);

    /// The places of a voxel's second difference of each term, with their factors.
    const STENCILS: [[([isize; 3], f32); 4]; TERMS] = {
        const fn straight(step: [isize; 3]) -> [([isize; 3], f32); 4] {
            [(step, 1.0), ([0; 3], -2.0), ([-step[0], -step[1], -step[2]], 1.0), ([0; 3], 0.0)]
        }
        const fn mixed(a: [isize; 3], b: [isize; 3]) -> [([isize; 3], f32); 4] {
            [([0; 3], 1.0), (a, -1.0), (b, -1.0), ([a[0] + b[0], a[1] + b[1], a[2] + b[2]], 1.0)]
        }
        const X: [isize; 3] = [1, 0, 0];
        const Y: [isize; 3] = [0, 1, 0];
        const Z: [isize; 3] = [0, 0, 1];
        [straight(X), straight(Y), straight(Z), mixed(X, Y), mixed(X, Z), mixed(Y, Z)]
    };

    /// A number between -1 and 1 for each n.
    fn noise(n: usize) -> f32 {
        (n as f32 * 12.9898).sin()
    }

    /// The voxel a step away.
    fn step_from(voxel: usize, step: [isize; 3]) -> Option<usize> {
        let at = [voxel % SIZE[0], voxel / SIZE[0] % SIZE[1], voxel / SIZE[0] / SIZE[1]];
        let mut place = [0; 3];
        for d in 0..3 {
            place[d] = at[d].checked_add_signed(step[d]).filter(|p| *p < SIZE[d])?;
        }
        Some(place[0] + SIZE[0] * (place[1] + SIZE[1] * place[2]))
    }

    /// Weighted second differences of the band's values by voxel, term after term; none where a voxel is missing.
    fn differences(values: &[Option<f32>], weights: &[f32; TERMS]) -> Vec<Vec<Option<f32>>> {
        let of = |voxel: usize, term: usize| {
            let part = |(step, factor): &([isize; 3], f32)| Some(factor * values[step_from(voxel, *step)?]?);
            let sum: Option<f32> = STENCILS[term].iter().map(part).sum();
            sum.map(|sum| weights[term] * sum)
        };
        (0..TERMS).map(|term| (0..values.len()).map(|voxel| of(voxel, term)).collect()).collect()
    }

    /// A band, its voxels, and the value of each voxel.
    fn band() -> (Bricks, Vec<usize>, Vec<Option<f32>>) {
        let count = SIZE.iter().product::<usize>();
        let is_in_band: Vec<bool> = (0..count).map(|n| noise(7 * n + 3) < 0.6).collect();
        let values = (0..count).map(|n| is_in_band[n].then(|| noise(n))).collect();
        (Bricks::new(&is_in_band, SIZE), (0..count).filter(|n| is_in_band[*n]).collect(), values)
    }

    /// Slopes of an energy by slot, from a sweep over planes in parts.
    fn slopes_of(bricks: &Bricks, values: &[f32], energy: Energy, parts: &[Range<usize>]) -> Vec<f32> {
        let context = RunContext::with_threads(1).unwrap();
        let differences = SecondDifferences::new(bricks, SPACING, &context).unwrap();
        let mut found = vec![f32::NAN; bricks.slot_count()];
        for planes in parts {
            let of_plane = |plane: usize, slopes: Around| {
                let of_plane = bricks.of_planes(plane..plane + 1);
                for (n, places) in bricks.places(of_plane.clone()).iter().enumerate() {
                    let of_brick = slopes.slopes(n, places).to_array();
                    found[(of_plane.start + n) * WIDTH..][..WIDTH].copy_from_slice(&of_brick);
                }
            };
            let mut work = Sweep::new(bricks, energy);
            differences.sweep((energy, values), planes.clone(), &mut work, &context, of_plane).unwrap();
        }
        found
    }

    #[test]
    fn slopes_are_those_of_the_energies_summed_voxel_by_voxel_whatever_the_parts() {
        let (bricks, voxels, values) = band();
        let (weights, count) = (bending_weights(SPACING), values.len());
        let mut by_slot = vec![0.0; bricks.slot_count()];
        voxels.iter().zip(bricks.slots()).for_each(|(n, slot)| by_slot[*slot as usize] = noise(*n));
        let bending = differences(&values, &weights);
        assert!(bending.iter().flatten().flatten().count() > 200);
        let steps: [[isize; 3]; 3] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
        let inverse = (SPACING * SPACING).recip();
        let rates = (inverse / (4.0 * inverse.element_sum())).to_array().map(|rate| rate as f32);
        let variation: Vec<Vec<Option<f32>>> = bending
            .iter()
            .map(|of_term| {
                let to_neighbors = |voxel: usize| {
                    let own = of_term[voxel]?;
                    let sides = steps.iter().zip(rates).flat_map(|(s, rate)| [(*s, rate), (s.map(|x| -x), rate)]);
                    let part = |(s, rate): ([isize; 3], f32)| Some(rate * (own - of_term[step_from(voxel, s)?]?));
                    Some(sides.filter_map(part).sum())
                };
                (0..count).map(to_neighbors).collect()
            })
            .collect();
        for (energy, expected) in [(Energy::Bending, bending), (Energy::Variation, variation)] {
            let mut slope = vec![0.0f32; count];
            for (term, of_term) in expected.iter().enumerate() {
                for (voxel, value) in of_term.iter().enumerate() {
                    for (step, factor) in STENCILS[term].iter().filter(|_| value.is_some()) {
                        slope[step_from(voxel, *step).unwrap()] += factor * value.unwrap();
                    }
                }
            }
            let found = slopes_of(&bricks, &by_slot, energy, std::slice::from_ref(&(0..SIZE[2])));
            for (voxel, slot) in voxels.iter().zip(bricks.slots()) {
                let found = found[*slot as usize];
                assert!((found - slope[*voxel]).abs() < 1e-5, "{voxel} {found} {}", slope[*voxel]);
            }
            let in_parts = slopes_of(&bricks, &by_slot, energy, &[0..1, 1..4, 4..5, 5..5, 5..SIZE[2]]);
            assert!(bricks.slots().iter().all(|slot| found[*slot as usize] == in_parts[*slot as usize]));
        }
    }

    #[test]
    fn a_sweep_ends_when_the_run_is_cancelled() {
        let (bricks, ..) = band();
        let context = RunContext::with_threads(1).unwrap();
        let differences = SecondDifferences::new(&bricks, SPACING, &context).unwrap();
        let values = vec![0.0; bricks.slot_count()];
        let mut work = Sweep::new(&bricks, Energy::Bending);
        let stop = |plane: usize, _: Around| {
            if plane == 2 {
                context.cancel_token().cancel();
            }
        };
        let swept = differences.sweep((Energy::Bending, &values), 0..SIZE[2], &mut work, &context, stop);
        assert!(matches!(swept, Err(crate::Error::Cancelled)));
    }
}
