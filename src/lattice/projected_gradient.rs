//! Smooth values on a band of voxels: accelerated projected gradient steps to less bending, or less variation of it.
//!
//! # Method
//! The sum of the squared weighted second differences, or of the squared differences of these between neighbours, is lessened
//! within bounds per voxel. Differences with a voxel outside of the band are left out.
//!
//! The voxels lie in bricks of `WIDTH` along x, so that one instruction works on several. What is one voxel before or after a
//! brick is stored before or after it; the bricks beside it in y and z are listed:
//! ```text
//!    y  |  . o o o | o o o . |           o band; each brick that holds a voxel of the band or is next to one is stored
//!       |  . . o o | o o o o | o . . .
//!       x ->
//! ```
//!
//! # Source
//! [BeckTeboulle2009] and [ODonoghueCandes2015] for the steps and their restarts.
//!
//! # Invariants
//! A voxel that is not in the band has the value 0 and no differences. The same bits for any number of threads.
//!
//! # Cost
//! 92 bytes per voxel of a brick; of bands four voxels thick three quarters of these are in the band. Two or three passes a
//! step, bound by memory where many voxels are in work.

use glam::{DVec3, DVec4, Vec4, Vec4Swizzles};
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;

/// Voxels of a brick: as many as a vector register of the plainest processors holds.
const WIDTH: usize = 4;

/// Voxels per task.
const CHUNK: usize = 8192;

/// Bricks before the first, the second of which stands for all that are not stored; one more follows the last.
const EMPTY_BRICKS: usize = 2;

/// First slot of a brick that is not stored.
const EMPTY: u32 = WIDTH as u32;

/// A step that moves no voxel by more than this part of the smallest spacing is the last. Long waves across thick slices still move
/// at five times of it.
const LAST_STEP: f32 = 1e-4;

/// Second differences of a voxel: xx, yy, zz, xy, xz, yz.
const TERMS: usize = 6;

/// A value for each second difference of the voxels of a brick: what is used together lies together.
type Brick = [Vec4; TERMS];

/// Where the voxels of a band are stored.
#[derive(Debug, Clone, Default)]
pub struct Bricks {
    /// First slots of the bricks beside each: +y, -y, +z, -z, +y +z, -y -z.
    beside: Vec<[u32; 6]>,
    /// Slot of each voxel of the band, in order.
    slots: Vec<u32>,
}

impl Bricks {
    /// Bricks for the voxels of a box that are in the band, x fastest.
    pub fn new(is_in_band: &[bool], size: [usize; 3]) -> Self {
        // A voxel before and one after each row: the first and last of a brick's row are never in the band.
        let along = (size[0] + 2).div_ceil(WIDTH);
        let mut first_slots = vec![EMPTY; along * size[1] * size[2]];
        let mut places = Vec::new();
        for (row, voxels) in is_in_band.chunks(size[0].max(1)).enumerate() {
            for (i, _) in voxels.iter().enumerate().filter(|(_, is_in)| **is_in) {
                let at = along * row;
                first_slots[at + i / WIDTH..=at + (i + 2) / WIDTH].fill(0);
                places.push((at + (i + 1) / WIDTH, (i + 1) % WIDTH));
            }
        }
        let mut bricks = Self::default();
        let mut stored = Vec::new();
        for (at, slot) in first_slots.iter_mut().enumerate().filter(|(_, slot)| **slot != EMPTY) {
            *slot = ((stored.len() + EMPTY_BRICKS) * WIDTH) as u32;
            stored.push(at);
        }
        let steps = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]];
        bricks.beside.extend(stored.into_iter().map(|at| {
            let [x, y, z] = [at % along, at / along % size[1], at / along / size[1]];
            steps.map(|[up, far]| match (y.checked_add_signed(up), z.checked_add_signed(far)) {
                (Some(y), Some(z)) if y < size[1] && z < size[2] => first_slots[x + along * (y + size[1] * z)],
                _ => EMPTY,
            })
        }));
        bricks.slots.extend(places.into_iter().map(|(brick, lane)| first_slots[brick] + lane as u32));
        bricks
    }

    /// Slot of each voxel of the band, in order.
    pub fn slots(&self) -> &[u32] {
        &self.slots
    }

    /// Number of slots.
    pub fn slot_count(&self) -> usize {
        (self.beside.len() + EMPTY_BRICKS + 1) * WIDTH
    }

    /// Slots of the voxels after and before one of the band along each axis.
    pub fn neighbors(&self, slot: u32) -> [[usize; 2]; 3] {
        let at = slot as usize;
        let beside = &self.beside[at / WIDTH - EMPTY_BRICKS];
        let lane = at % WIDTH;
        let of = |brick: usize| beside[brick] as usize + lane;
        [[at + 1, at - 1], [of(0), of(1)], [of(2), of(3)]]
    }

    /// First slots of the bricks of a chunk and of what is beside each.
    fn chunk(&self, chunk: usize) -> impl Iterator<Item = (usize, [usize; 6])> {
        let first = chunk * (CHUNK / WIDTH);
        let end = (first + CHUNK / WIDTH).min(self.beside.len());
        // Written out: maps over arrays are not inlined into all loops over chunks.
        let wide =
            |[a, b, c, d, e, f]: [u32; 6]| [a as usize, b as usize, c as usize, d as usize, e as usize, f as usize];
        (first..end).map(move |brick| ((brick + EMPTY_BRICKS) * WIDTH, wide(self.beside[brick])))
    }

    /// What an array has for the stored bricks.
    fn stored<'a, T>(&self, by_brick: &'a mut [T]) -> &'a mut [T] {
        &mut by_brick[EMPTY_BRICKS..][..self.beside.len()]
    }

    /// The slots of the bricks.
    fn range(&self) -> std::ops::Range<usize> {
        EMPTY_BRICKS * WIDTH..(EMPTY_BRICKS + self.beside.len()) * WIDTH
    }
}

/// What an array has from a slot on.
#[inline]
fn lanes<T>(values: &[T], slot: usize) -> &[T; WIDTH] {
    // One check of the bounds for all lanes.
    values[slot..].first_chunk().expect("an empty brick is last")
}

/// The values from a slot on.
#[inline]
fn values_at(values: &[f32], slot: usize) -> Vec4 {
    Vec4::from_array(*lanes(values, slot))
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

/// What is lessened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Energy {
    /// The squares of the second differences.
    Bending,
    /// The squares of their differences between neighbours.
    Variation,
}

/// Value and bounds of a voxel of the band, mm.
#[derive(Debug, Clone, Copy, Default)]
pub struct Unknown {
    /// The value.
    pub value: f32,
    /// Least value.
    pub low: f32,
    /// Largest value.
    pub high: f32,
}

/// The values of a band on their way to less energy; all arrays are by slot.
pub struct Descent<'a> {
    bricks: &'a Bricks,
    values: Vec<f32>,
    low: Vec<f32>,
    high: Vec<f32>,
    /// Values that the momentum leads to.
    ahead: Vec<f32>,
    /// Which of the six second differences have all their voxels (bits 0 to 5).
    terms: Vec<u32>,
    bending: Vec<Brick>,
    variation: Vec<Brick>,
    /// Weights of the second differences.
    weights: [f32; TERMS],
    /// Weights of differences between neighbours along each axis, divided by their steepest curvature.
    rates: [f32; 3],
    /// Sum of these weights over the neighbours that have a second difference too; 0 where the voxel itself has not.
    totals: Vec<Brick>,
    /// A step that moves no voxel by more is the last, mm.
    last: f32,
    /// What makes the energy of the variation the square of third derivatives, for a length of the mean spacing.
    scale: f32,
}

impl<'a> Descent<'a> {
    /// A descent from the given values of the voxels of the band, in order.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn new(bricks: &'a Bricks, unknowns: &[Unknown], spacing: DVec3, context: &RunContext) -> Result<Self> {
        let inverse = (spacing * spacing).recip();
        let slots = bricks.slot_count();
        let by_slot = |of: fn(&Unknown) -> f32| {
            let mut values = vec![0.0f32; slots];
            bricks.slots.iter().zip(unknowns).for_each(|(slot, unknown)| values[*slot as usize] = of(unknown));
            values
        };
        context.check()?;
        let terms = terms_of(bricks);
        context.check()?;
        let rates = (inverse / (4.0 * inverse.element_sum())).to_array().map(|rate| rate as f32);
        let totals = totals_of(bricks, &terms, rates);
        context.check()?;
        Ok(Self {
            values: by_slot(|u| u.value),
            low: by_slot(|u| u.low),
            high: by_slot(|u| u.high),
            ahead: vec![0.0; slots],
            bending: vec![[Vec4::ZERO; TERMS]; slots / WIDTH],
            variation: vec![[Vec4::ZERO; TERMS]; slots / WIDTH],
            weights: bending_weights(spacing),
            totals,
            terms,
            rates,
            last: LAST_STEP * spacing.min_element() as f32,
            scale: ((4.0 * inverse.element_sum()).powi(3) * (spacing.element_sum() / 3.0).powi(4)) as f32,
            bricks,
        })
    }

    /// Least and largest values by slot; a step brings the values within them.
    pub fn bounds_mut(&mut self) -> [&mut [f32]; 2] {
        [&mut self.low, &mut self.high]
    }

    /// How fast the curvature changes around each voxel of the band, in order: the root of the mean square of the third derivatives
    /// there and at the six neighbours, for a length of the mean spacing. 0.02 on a ball of 20 voxels, 0.2 on a rod of 2.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn roughness(&mut self, context: &RunContext) -> Result<Vec<f32>> {
        self.ahead.copy_from_slice(&self.values);
        self.take_bending();
        context.check()?;
        let Self { bricks, bending, terms, weights, rates, scale, .. } = &*self;
        let slots = bricks.slots();
        // Sums of the weighted squares, and of their weights, for the voxels of a brick.
        let of_brick = |(slot, beside): (usize, [usize; 6])| {
            let [at, up, down, far, near, ..] = brick_numbers(slot, beside);
            let own_terms = lanes(terms, slot);
            let mut sums = [Vec4::ZERO; 2];
            let directions = [slot + 1, slot - 1, beside[0], beside[1], beside[2], beside[3]];
            for (direction, other) in directions.into_iter().enumerate() {
                let (rate, other_terms) = (rates[direction / 2], lanes(terms, other));
                let common: [u32; WIDTH] = std::array::from_fn(|l| own_terms[l] & other_terms[l]);
                for (term, weight) in weights.iter().enumerate() {
                    let own = bending[at][term];
                    let other = match direction {
                        0 => shifted_back(own, bending[at + 1][term]),
                        1 => shifted_on(own, bending[at - 1][term]),
                        _ => bending[[up, down, far, near][direction - 2]][term],
                    };
                    let (of_common, difference) = (where_has(&common, term, rate), own - other);
                    sums[0] += of_common * (difference * difference) / *weight;
                    sums[1] += of_common;
                }
            }
            sums
        };
        let mut by_brick = vec![[Vec4::ZERO; 2]; self.values.len() / WIDTH];
        let chunks = bricks.stored(&mut by_brick).par_chunks_mut(CHUNK / WIDTH).enumerate();
        context.until_cancelled(chunks).for_each(|(chunk, rows)| {
            rows.iter_mut().zip(bricks.chunk(chunk)).for_each(|(row, brick)| *row = of_brick(brick));
        });
        context.check()?;
        let sums_of = |slot: usize| by_brick[slot / WIDTH].map(|sums| sums[slot % WIDTH]);
        let with_neighbors = |slot: &u32| {
            let beside = bricks.neighbors(*slot).into_iter().flatten().map(sums_of);
            let [square, rates] = beside.fold(sums_of(*slot as usize), |l, r| [l[0] + r[0], l[1] + r[1]]);
            // The rates of the three axes sum to a quarter: six terms of it are the square of all third derivatives.
            if rates > 0.0 { (1.5 * scale * square / rates).sqrt() } else { 0.0 }
        };
        Ok(slots.par_iter().with_min_len(CHUNK).map(with_neighbors).collect())
    }

    /// The values by slot.
    pub fn into_values(self) -> Vec<f32> {
        self.values
    }

    /// Accelerated projected gradient steps, from rest.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn run(&mut self, energy: Energy, steps: usize, context: &RunContext) -> Result<()> {
        self.ahead.copy_from_slice(&self.values);
        let mut momentum = 1.0f64;
        for _ in 0..steps {
            context.check()?;
            self.take_bending();
            context.check()?;
            if energy == Energy::Variation {
                self.take_variation();
            }
            let next = (1.0 + (1.0 + 4.0 * momentum * momentum).sqrt()) / 2.0;
            let (uphill, largest) = self.step(energy, ((momentum - 1.0) / next) as f32);
            momentum = if uphill > 0.0 { 1.0 } else { next };
            if largest < self.last {
                break;
            }
        }
        Ok(())
    }

    /// The weighted second differences.
    fn take_bending(&mut self) {
        let Self { bricks, terms, ahead, bending, weights, .. } = self;
        let (bricks, terms, ahead) = (*bricks, terms.as_slice(), ahead.as_slice());
        bricks.stored(bending).par_chunks_mut(CHUNK / WIDTH).enumerate().for_each(|(chunk, rows)| {
            for (row, (slot, [up, down, far, near, up_far, _])) in rows.iter_mut().zip(bricks.chunk(chunk)) {
                let own = values_at(ahead, slot);
                let (x, before_x) = (values_at(ahead, slot + 1), values_at(ahead, slot - 1));
                let (y, before_y) = (values_at(ahead, up), values_at(ahead, down));
                let (z, before_z) = (values_at(ahead, far), values_at(ahead, near));
                let (xy, xz, yz) = (values_at(ahead, up + 1), values_at(ahead, far + 1), values_at(ahead, up_far));
                let terms = lanes(terms, slot);
                let mut differences = [
                    x - 2.0 * own + before_x,
                    y - 2.0 * own + before_y,
                    z - 2.0 * own + before_z,
                    own - x - y + xy,
                    own - x - z + xz,
                    own - y - z + yz,
                ];
                for term in 0..TERMS {
                    differences[term] *= where_has(terms, term, weights[term]);
                }
                *row = differences;
            }
        });
    }

    /// Slope of the variation by each second difference: what it differs by from those of the six neighbours.
    fn take_variation(&mut self) {
        let Self { bricks, bending, variation, totals, rates, .. } = self;
        let (bricks, bending, totals) = (*bricks, &*bending, &*totals);
        bricks.stored(variation).par_chunks_mut(CHUNK / WIDTH).enumerate().for_each(|(chunk, rows)| {
            for (row, (slot, beside)) in rows.iter_mut().zip(bricks.chunk(chunk)) {
                let [at, up, down, far, near, ..] = brick_numbers(slot, beside);
                // Each brick is looked up once for all terms.
                let (brick, totals) = (&bending[at], &totals[at]);
                let (brick_after, brick_before) = (&bending[at + 1], &bending[at - 1]);
                let (brick_up, brick_down) = (&bending[up], &bending[down]);
                let (brick_far, brick_near) = (&bending[far], &bending[near]);
                for term in 0..TERMS {
                    let (own, total) = (brick[term], totals[term]);
                    let (x, before_x) = (shifted_back(own, brick_after[term]), shifted_on(own, brick_before[term]));
                    let (y, before_y) = (brick_up[term], brick_down[term]);
                    let (z, before_z) = (brick_far[term], brick_near[term]);
                    let along = rates[0] * (x + before_x) + rates[1] * (y + before_y);
                    let others = along + rates[2] * (z + before_z);
                    // What does not exist is 0 beside what does, and takes nothing from it.
                    row[term] = Vec4::select(total.cmpne(Vec4::ZERO), own * total - others, Vec4::ZERO);
                }
            }
        });
    }

    /// One step; returns how far it goes against the momentum and the largest change, mm.
    fn step(&mut self, energy: Energy, carry: f32) -> (f64, f32) {
        let (bricks, low, high) = (self.bricks, &self.low, &self.high);
        let terms = if energy == Energy::Bending { &self.bending } else { &self.variation };
        let of_chunk = |(chunk, (values, ahead)): (usize, (&mut [f32], &mut [f32]))| {
            let (mut uphill, mut largest) = (DVec4::ZERO, Vec4::ZERO);
            let places = values.as_chunks_mut::<WIDTH>().0.iter_mut().zip(ahead.as_chunks_mut::<WIDTH>().0);
            for ((slot, beside), (values, ahead)) in bricks.chunk(chunk).zip(places) {
                let (own, lead) = (Vec4::from_array(*values), Vec4::from_array(*ahead));
                let moved = (lead - slopes(slot, beside, terms)).max(values_at(low, slot)).min(values_at(high, slot));
                let changes = moved - own;
                (*values, *ahead) = (moved.to_array(), (moved + carry * changes).to_array());
                uphill += ((lead - moved) * changes).as_dvec4();
                largest = largest.max(changes.abs());
            }
            (uphill.element_sum(), largest.max_element())
        };
        let values = self.values[bricks.range()].par_chunks_mut(CHUNK);
        let moves: Vec<(f64, f32)> =
            values.zip(self.ahead[bricks.range()].par_chunks_mut(CHUNK)).enumerate().map(of_chunk).collect();
        (moves.iter().map(|m| m.0).sum(), moves.iter().map(|m| m.1).fold(0.0, f32::max))
    }
}

/// Numbers of a brick and of those beside it.
#[inline]
fn brick_numbers(slot: usize, [up, down, far, near, up_far, down_near]: [usize; 6]) -> [usize; 7] {
    // Written out, as in `chunk`.
    [slot / WIDTH, up / WIDTH, down / WIDTH, far / WIDTH, near / WIDTH, up_far / WIDTH, down_near / WIDTH]
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
    bricks.slots.iter().for_each(|slot| has[*slot as usize] = true);
    let mut terms = vec![0; has.len()];
    for slot in bricks.slots.iter().map(|slot| *slot as usize) {
        let beside = bricks.beside[slot / WIDTH - EMPTY_BRICKS].map(|first| first as usize + slot % WIDTH);
        let [up, down, far, near, up_far, _] = beside;
        let [x, y, z] = [slot + 1, up, far].map(|slot| has[slot]);
        let pairs = [x && has[slot - 1], y && has[down], z && has[near]];
        let squares = [x && y && has[up + 1], x && z && has[far + 1], y && z && has[up_far]];
        terms[slot] = pairs.into_iter().chain(squares).enumerate().map(|(bit, term)| u32::from(term) << bit).sum();
    }
    terms
}

/// Sums of the rates over the neighbours that have a second difference too, by slot.
fn totals_of(bricks: &Bricks, terms: &[u32], rates: [f32; 3]) -> Vec<Brick> {
    let mut totals = vec![[Vec4::ZERO; TERMS]; terms.len() / WIDTH];
    for slot in &bricks.slots {
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

/// Slopes of an energy at the voxels of a brick, from its slopes by second differences: these transposed.
#[inline]
fn slopes(slot: usize, beside: [usize; 6], terms: &[Brick]) -> Vec4 {
    let [at, up, down, far, near, _, down_near] = brick_numbers(slot, beside);
    let [xx, yy, zz, xy, xz, yz] = terms[at];
    let (before, xx_after) = (&terms[at - 1], terms[at + 1][0]);
    let (next_x, before_x) = (shifted_back(xx, xx_after), shifted_on(xx, before[0]));
    let (next_y, before_y) = (terms[up][1], terms[down][1]);
    let (next_z, before_z) = (terms[far][2], terms[near][2]);
    let (xy_x, xy_y) = (shifted_on(xy, before[3]), terms[down][3]);
    let (xz_x, xz_z) = (shifted_on(xz, before[4]), terms[near][4]);
    let (xy_both, xz_both) = (shifted_on(xy_y, terms[down - 1][3]), shifted_on(xz_z, terms[near - 1][4]));
    let (yz_y, yz_z, yz_both) = (terms[down][5], terms[near][5], terms[down_near][5]);
    let straight = (next_x + before_x - 2.0 * xx) + (next_y + before_y - 2.0 * yy);
    let mixed = (xy - xy_x) - (xy_y - xy_both) + ((xz - xz_x) - (xz_z - xz_both));
    let rest = (next_z + before_z - 2.0 * zz) + ((yz - yz_y) - (yz_z - yz_both));
    (straight + mixed) + rest
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

    #[test]
    fn slopes_are_those_of_the_energies_summed_voxel_by_voxel() {
        let count = SIZE.iter().product::<usize>();
        let is_in_band: Vec<bool> = (0..count).map(|n| noise(7 * n + 3) < 0.6).collect();
        let bricks = Bricks::new(&is_in_band, SIZE);
        let voxels: Vec<usize> = (0..count).filter(|n| is_in_band[*n]).collect();
        let unknowns: Vec<Unknown> =
            voxels.iter().map(|n| Unknown { value: noise(*n), low: -9.0, high: 9.0 }).collect();
        let mut descent = Descent::new(&bricks, &unknowns, SPACING, &RunContext::with_threads(1).unwrap()).unwrap();
        descent.ahead.copy_from_slice(&descent.values);
        descent.take_bending();
        descent.take_variation();
        let values: Vec<Option<f32>> = (0..count).map(|n| is_in_band[n].then(|| noise(n))).collect();
        let bending = differences(&values, &descent.weights);
        assert!(bending.iter().flatten().flatten().count() > 200);
        let steps: [[isize; 3]; 3] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
        let variation: Vec<Vec<Option<f32>>> = bending
            .iter()
            .map(|of_term| {
                let to_neighbors = |voxel: usize| {
                    let own = of_term[voxel]?;
                    let sides =
                        steps.iter().zip(descent.rates).flat_map(|(s, rate)| [(*s, rate), (s.map(|x| -x), rate)]);
                    let part = |(s, rate): ([isize; 3], f32)| Some(rate * (own - of_term[step_from(voxel, s)?]?));
                    Some(sides.filter_map(part).sum())
                };
                (0..count).map(to_neighbors).collect()
            })
            .collect();
        for (arrays, expected) in [(&descent.bending, bending), (&descent.variation, variation)] {
            let mut slope = vec![0.0f32; count];
            for (term, of_term) in expected.iter().enumerate() {
                for (voxel, value) in of_term.iter().enumerate() {
                    for (step, factor) in STENCILS[term].iter().filter(|_| value.is_some()) {
                        slope[step_from(voxel, *step).unwrap()] += factor * value.unwrap();
                    }
                }
            }
            for (voxel, slot) in voxels.iter().zip(bricks.slots()) {
                let brick = *slot as usize / WIDTH;
                let beside = bricks.beside[brick - EMPTY_BRICKS].map(|slot| slot as usize);
                let found = slopes(brick * WIDTH, beside, arrays)[*slot as usize % WIDTH];
                assert!((found - slope[*voxel]).abs() < 1e-5, "{voxel} {found} {}", slope[*voxel]);
            }
        }
    }

    #[test]
    fn the_roughness_of_a_cubic_is_its_third_derivative_for_any_spacing() {
        let size = [9; 3];
        let bricks = Bricks::new(&[true; 729], size);
        let context = RunContext::with_threads(1).unwrap();
        for spacing in [DVec3::ONE, DVec3::splat(0.6), SPACING] {
            for axis in 0..3 {
                let at = |n: usize| [n % 9, n / 9 % 9, n / 81][axis] as f64 * spacing[axis];
                let value = |n: usize| Unknown { value: (0.1 * at(n).powi(3)) as f32, low: -1e3, high: 1e3 };
                let unknowns: Vec<Unknown> = (0..729).map(value).collect();
                let roughness =
                    Descent::new(&bricks, &unknowns, spacing, &context).unwrap().roughness(&context).unwrap();
                let mean = spacing.element_sum() / 3.0;
                let (found, expected) = (f64::from(roughness[4 + 9 * (4 + 9 * 4)]), 0.6 * mean * mean);
                assert!((found / expected - 1.0).abs() < 1e-3, "{found} {expected}");
            }
        }
        let unknowns = [Unknown { value: 0.0, low: -1.0, high: 1.0 }; 729];
        let mut descent = Descent::new(&bricks, &unknowns, SPACING, &context).unwrap();
        context.cancel_token().cancel();
        assert!(matches!(descent.roughness(&context), Err(crate::Error::Cancelled)));
        let again = Descent::new(&bricks, &unknowns, SPACING, &context);
        assert!(matches!(again, Err(crate::Error::Cancelled)));
    }

    #[test]
    fn voxels_outside_of_the_band_stay_0_and_bounds_are_kept() {
        let count = SIZE.iter().product::<usize>();
        let is_in_band: Vec<bool> = (0..count).map(|n| noise(5 * n) < 0.3).collect();
        let bricks = Bricks::new(&is_in_band, SIZE);
        let bounds = |n: usize| Unknown { value: noise(n), low: noise(n) - 0.1, high: noise(n) + 0.2 };
        let unknowns: Vec<Unknown> = (0..count).filter(|n| is_in_band[*n]).map(bounds).collect();
        let context = RunContext::with_threads(1).unwrap();
        let mut descent = Descent::new(&bricks, &unknowns, SPACING, &context).unwrap();
        descent.run(Energy::Bending, 20, &context).unwrap();
        descent.run(Energy::Variation, 20, &context).unwrap();
        let mut values = descent.into_values();
        let mut moved = 0;
        for (slot, unknown) in bricks.slots().iter().zip(&unknowns) {
            let value = std::mem::take(&mut values[*slot as usize]);
            assert!(value >= unknown.low && value <= unknown.high, "{value} {unknown:?}");
            moved += usize::from(value != unknown.value);
        }
        assert!(moved > unknowns.len() / 4, "{moved} of {}", unknowns.len());
        assert!(values.iter().all(|value| *value == 0.0));
    }
}
