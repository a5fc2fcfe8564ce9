//! Smooth values on a band of voxels: accelerated projected gradient steps to less bending, or less variation of it.
//!
//! # Method
//! The sum of the squared weighted second differences, or of the squared differences of these between neighbours
//! ([`second_differences`](crate::lattice::second_differences)), is lessened within bounds per voxel. Differences with a voxel outside
//! of the band are left out. Each step is one sweep over the planes of the band.
//!
//! # Source
//! [BeckTeboulle2009] and [ODonoghueCandes2015] for the steps and their restarts.
//!
//! # Invariants
//! A voxel that is not in the band has the value 0 and no differences. The same bits for any number of threads.
//!
//! # Cost
//! 60 bytes per voxel of a brick; of bands four voxels thick three quarters of these are in the band. A step reads and writes 40 of
//! them, or 64 with the variation.

use std::ops::Range;

use glam::{DVec3, DVec4, Vec4};
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::second_differences::{Around, BRICKS_PER_TASK, Energy, SecondDifferences, Sweep};
use crate::lattice::voxel_bricks::{Bricks, WIDTH, lanes_of};
use crate::parallel::pieces::pieces;

/// Voxels per task.
const CHUNK: usize = 8192;

/// Fewest planes, and fewest bricks, of a part of a band that is worked on beside others: each takes the differences of four more planes
/// and the variation of two.
const PLANES_PER_PART: usize = 8;
const BRICKS_PER_PART: usize = 4096;

/// A step that moves no voxel by more than this part of the smallest spacing is the last. Long waves across thick slices still move
/// at five times of it.
const LAST_STEP: f32 = 1e-4;

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
    differences: SecondDifferences<'a>,
    values: Vec<f32>,
    low: Vec<f32>,
    high: Vec<f32>,
    /// Values that the momentum leads to, and room for the next ones.
    ahead: Vec<f32>,
    next_ahead: Vec<f32>,
    /// A step that moves no voxel by more is the last, mm.
    last: f32,
    /// What makes the energy of the variation the square of third derivatives, for a length of the mean spacing.
    scale: f32,
}

/// The values of some planes, and what they lead to next, by lanes of bricks.
struct Values<'a> {
    values: &'a mut [[f32; WIDTH]],
    next_ahead: &'a mut [[f32; WIDTH]],
}

/// What a step did.
#[derive(Debug, Clone, Copy, Default)]
struct Moved {
    /// How far it went against the momentum.
    uphill: f64,
    /// The largest change, mm.
    largest: f32,
}

impl Moved {
    fn with(self, other: Self) -> Self {
        Self { uphill: self.uphill + other.uphill, largest: self.largest.max(other.largest) }
    }
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
            bricks.slots().iter().zip(unknowns).for_each(|(slot, unknown)| values[*slot as usize] = of(unknown));
            values
        };
        Ok(Self {
            differences: SecondDifferences::new(bricks, spacing, context)?,
            values: by_slot(|u| u.value),
            low: by_slot(|u| u.low),
            high: by_slot(|u| u.high),
            ahead: vec![0.0; slots],
            next_ahead: vec![0.0; slots],
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
    pub fn roughness(&self, context: &RunContext) -> Result<Vec<f32>> {
        let (bricks, scale) = (self.bricks, self.scale);
        // Sums of the weighted squares, and of their weights, for the voxels of each brick.
        let mut by_brick = vec![[Vec4::ZERO; 2]; self.values.len() / WIDTH];
        let parts = self.parts();
        let rows = split_by_parts(bricks, &parts, &mut by_brick);
        let of_part = |(planes, rows): (&Range<usize>, &mut [[Vec4; 2]])| {
            let mut work = Sweep::new(bricks, Energy::Bending);
            let start = bricks.of_planes(planes.clone()).start;
            let of_plane = |plane: usize, bending: Around| {
                let bricks = bricks.of_planes(plane..plane + 1);
                let rows = rows[bricks.start - start..][..bricks.len()].par_iter_mut().with_min_len(BRICKS_PER_TASK);
                rows.enumerate().for_each(|(n, row)| *row = self.differences.squares(plane, n, bending));
            };
            self.differences.sweep((Energy::Bending, &self.values), planes.clone(), &mut work, context, of_plane)
        };
        parts.par_iter().zip(rows).map(of_part).collect::<Result<()>>()?;
        let sums_of = |slot: usize| by_brick[slot / WIDTH].map(|sums| sums[slot % WIDTH]);
        let with_neighbors = |slot: &u32| {
            let beside = bricks.neighbors(*slot).into_iter().flatten().map(sums_of);
            let [square, rates] = beside.fold(sums_of(*slot as usize), |l, r| [l[0] + r[0], l[1] + r[1]]);
            // The rates of the three axes sum to a quarter: six terms of it are the square of all third derivatives.
            if rates > 0.0 { (1.5 * scale * square / rates).sqrt() } else { 0.0 }
        };
        Ok(bricks.slots().par_iter().with_min_len(CHUNK).map(with_neighbors).collect())
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
        let parts = self.parts();
        let mut works: Vec<Sweep> = parts.iter().map(|_| Sweep::new(self.bricks, energy)).collect();
        let mut momentum = 1.0f64;
        for _ in 0..steps {
            context.check()?;
            let next = (1.0 + (1.0 + 4.0 * momentum * momentum).sqrt()) / 2.0;
            let moved = self.step(energy, ((momentum - 1.0) / next) as f32, &parts, &mut works, context)?;
            momentum = if moved.uphill > 0.0 { 1.0 } else { next };
            if moved.largest < self.last {
                break;
            }
        }
        Ok(())
    }

    /// Planes that are worked on beside others, as many parts as there are threads for.
    fn parts(&self) -> Vec<Range<usize>> {
        let (planes, bricks) = (self.bricks.plane_count(), self.bricks.len());
        let most = (planes / PLANES_PER_PART).min(bricks / BRICKS_PER_PART).max(1);
        let count = rayon::current_num_threads().min(most);
        let first = |part: usize| part * planes / count;
        (0..count).map(|part| first(part)..first(part + 1)).collect()
    }

    /// One step.
    fn step(
        &mut self,
        energy: Energy,
        carry: f32,
        parts: &[Range<usize>],
        works: &mut [Sweep],
        context: &RunContext,
    ) -> Result<Moved> {
        let Self { bricks, differences, values, low, high, ahead, next_ahead, .. } = self;
        let (bricks, ahead, low, high) = (*bricks, ahead.as_slice(), low.as_slice(), high.as_slice());
        let of_bricks = |[start, first]: [usize; 2], slopes: Around, rows: Values| {
            let (mut uphill, mut largest) = (DVec4::ZERO, Vec4::ZERO);
            let all = start + first..start + first + rows.values.len();
            let [ahead, low, high] = [ahead, low, high].map(|values| lanes_of(values, all.clone()).iter());
            let bounds = ahead.zip(low.zip(high)).zip(bricks.places(all));
            let rows = rows.values.iter_mut().zip(rows.next_ahead).zip(bounds);
            for (n, ((own, next), ((lead, (low, high)), places))) in rows.enumerate() {
                let [before, lead, low, high] = [*own, *lead, *low, *high].map(Vec4::from_array);
                let moved = (lead - slopes.slopes(first + n, places)).max(low).min(high);
                let changes = moved - before;
                (*own, *next) = (moved.to_array(), (moved + carry * changes).to_array());
                uphill += ((lead - moved) * changes).as_dvec4();
                largest = largest.max(changes.abs());
            }
            Moved { uphill: uphill.element_sum(), largest: largest.max_element() }
        };
        let of_part = |((planes, rows), work): ((&Range<usize>, Values), &mut Sweep)| {
            let Values { values, next_ahead } = rows;
            let start = bricks.of_planes(planes.clone()).start;
            let mut moved = Vec::with_capacity(planes.len());
            let of_plane = |plane: usize, slopes: Around| {
                let range = bricks.of_planes(plane..plane + 1);
                let within = range.start - start..range.end - start;
                let (values, next_ahead) = (&mut values[within.clone()], &mut next_ahead[within]);
                if range.len() <= BRICKS_PER_TASK {
                    moved.push(of_bricks([range.start, 0], slopes, Values { values, next_ahead }));
                    return;
                }
                let rows = values.par_chunks_mut(BRICKS_PER_TASK).zip(next_ahead.par_chunks_mut(BRICKS_PER_TASK));
                let of_task = |(task, (values, next_ahead)): (usize, (&mut [_], &mut [_]))| {
                    of_bricks([range.start, task * BRICKS_PER_TASK], slopes, Values { values, next_ahead })
                };
                moved.extend(rows.enumerate().map(of_task).collect::<Vec<Moved>>());
            };
            differences.sweep((energy, ahead), planes.clone(), work, context, of_plane).map(|()| moved)
        };
        let values = split_by_parts(bricks, parts, values.as_chunks_mut().0);
        let rows = values.into_iter().zip(split_by_parts(bricks, parts, next_ahead.as_chunks_mut().0));
        let rows: Vec<Values> = rows.map(|(values, next_ahead)| Values { values, next_ahead }).collect();
        // Summed plane by plane, whoever worked on them.
        let moved: Vec<Vec<Moved>> = parts.par_iter().zip(rows).zip(works).map(of_part).collect::<Result<_>>()?;
        std::mem::swap(&mut self.ahead, &mut self.next_ahead);
        Ok(moved.into_iter().flatten().fold(Moved::default(), Moved::with))
    }
}

/// What an array has for the bricks of parts one after another.
fn split_by_parts<'a, T>(bricks: &Bricks, parts: &[Range<usize>], by_brick: &'a mut [T]) -> Vec<&'a mut [T]> {
    let ranges = || parts.iter().map(|planes| bricks.of_planes(planes.clone()));
    let first = ranges().next().map_or(0, |range| range.start);
    pieces(&mut by_brick[first..], ranges().map(|range| range.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 3] = [11, 5, 6];
    const SPACING: DVec3 = DVec3::new(0.8, 1.0, 1.3);

    /// A number between -1 and 1 for each n.
    fn noise(n: usize) -> f32 {
        (n as f32 * 12.9898).sin()
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
        let descent = Descent::new(&bricks, &unknowns, SPACING, &context).unwrap();
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

    #[test]
    fn a_large_band_is_the_same_for_any_number_of_threads() {
        let size = [101, 101, 34];
        let count = size.iter().product::<usize>();
        let bricks = Bricks::new(&vec![true; count], size);
        let unknowns: Vec<Unknown> =
            (0..count).map(|n| Unknown { value: noise(n), low: noise(n) - 0.1, high: noise(n) + 0.2 }).collect();
        let with_threads = |threads: usize| {
            let context = RunContext::with_threads(threads).unwrap();
            context.install(|| {
                let mut descent = Descent::new(&bricks, &unknowns, SPACING, &context).unwrap();
                assert_eq!(descent.parts().len(), threads);
                descent.run(Energy::Bending, 8, &context).unwrap();
                let roughness = descent.roughness(&context).unwrap();
                descent.run(Energy::Variation, 4, &context).unwrap();
                (descent.into_values(), roughness)
            })
        };
        assert!(bricks.of_planes(0..1).len() > BRICKS_PER_TASK);
        assert!(with_threads(1) == with_threads(3));
    }
}
