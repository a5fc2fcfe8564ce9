//! Rigid start: the rotation and translation that maximise the mutual information of both scans.
//!
//! # Method
//! 1. Samples: a fixed-stride subset of the foreground voxels of the fixed scan, so that every run takes the same ones.
//! 2. Mattes's joint histogram: a box window for the fixed value, a cubic B-spline window for the moving value; samples that leave
//!    the moving scan count with its background value, so that a loss of overlap is a loss of information.
//! 3. Analytic gradient with respect to a rotation vector about the centre of the fixed foreground and a translation.
//! 4. Steepest ascent with steps in mm that are halved whenever the gradient turns back, from coarse to fine smoothing.
//!
//! # Source
//! [Mattes2003] for the metric and its gradient; [Drakopoulos2017] section 3.6 and table 7 for its place and parameters.
//!
//! # Invariants
//! The result is a rotation and a translation. Sums run over chunks of fixed length in fixed order, so the result has the same
//! bits for any number of threads.
//!
//! # Cost
//! Two passes over the samples per step, both parallel; a smoothed copy of the moving scan per resolution.
//!
//! # Limits
//! A local search: starts more than some 30 degrees off are not found.

use glam::{DMat3, DMat4, DVec3};
use rayon::prelude::*;

use super::options::{RigidOptions, RigidStart, apply};
use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::image::gaussian::smooth;
use crate::image::grid::Grid;
use crate::image::scalar_image::ScalarImage;

/// Samples of one chunk; sums are formed per chunk, then over chunks in order.
const CHUNK: usize = 2048;

/// Fewest samples that make a usable histogram of 50 x 50 bins.
const MIN_SAMPLES: usize = 2000;

/// Most samples: past this the metric's noise is far below the smallest step.
const MAX_SAMPLES: usize = 40_000;

/// Arm that turns an angle into a length: radius of a head's content, mm.
const ARM: f64 = 60.0;

/// First step on the coarsest resolution, mm.
const FIRST_STEP: f64 = 4.0;

/// Gaussian on the coarsest resolution for three resolutions, mm; halved with each.
const FINEST_SIGMA: f64 = 1.0;

/// What the search found.
#[derive(Debug, Clone, PartialEq)]
pub struct RigidResult {
    /// Fixed to moving points.
    pub matrix: DMat4,
    /// Mutual information at the end, nats.
    pub mutual_information: f64,
    /// Mutual information of the start on the finest resolution, nats.
    pub start_information: f64,
    /// Steps on all resolutions.
    pub iterations: usize,
}

/// Finds the rigid transform from fixed to moving points; `start` replaces the choice of a start.
///
/// # Errors
/// [`Error::InvalidInput`] for scans without overlap or without foreground; [`Error::Cancelled`].
pub fn find_rigid(
    fixed: &ScalarImage,
    foreground: &[bool],
    moving: &ScalarImage,
    options: &RigidOptions,
    context: &RunContext,
) -> Result<RigidResult> {
    let center = center_of(fixed.grid(), foreground)?;
    let starts = starts(center, moving, options)?;
    let mut best: Option<(f64, Pose)> = None;
    let mut iterations = 0;
    let (mut start, mut start_information) = (starts[0], 0.0);
    for level in (0..options.levels).rev() {
        let metric = Metric::new(fixed, foreground, moving, level, options, center);
        if best.is_none() {
            for pose in &starts {
                let value = metric.value(pose);
                if best.as_ref().is_none_or(|(most, _)| value > *most) {
                    best = Some((value, *pose));
                }
            }
            start = best.as_ref().map_or(starts[0], |(_, pose)| *pose);
        }
        let pose = best.as_ref().map_or(starts[0], |(_, pose)| *pose);
        let coarsest = level + 1 == options.levels;
        let step = if coarsest { FIRST_STEP } else { FIRST_STEP / f64::powi(3.0, (options.levels - 1 - level) as i32) };
        if level == 0 {
            start_information = metric.value(&start);
        }
        let (value, pose, steps) = climb(&metric, pose, step, options, context)?;
        iterations += steps;
        best = Some((value, pose));
    }
    let (mutual_information, pose) = best.ok_or_else(|| Error::Internal { reason: "no rigid resolution".into() })?;
    Ok(RigidResult { matrix: pose.matrix(center), mutual_information, start_information, iterations })
}

/// Rotation vector (rad) about the centre, then translation (mm).
#[derive(Debug, Clone, Copy)]
struct Pose {
    rotation: DMat3,
    translation: DVec3,
}

impl Pose {
    fn matrix(&self, center: DVec3) -> DMat4 {
        // p -> R (p - c) + c + t
        let offset = center + self.translation - self.rotation * center;
        DMat4::from_mat3_translation(self.rotation, offset)
    }

    /// The pose after a step of `rotation` (mm on the arm) and `translation` (mm).
    fn moved(&self, rotation: DVec3, translation: DVec3) -> Self {
        let angle = rotation.length() / ARM;
        let turn = if angle > 0.0 { DMat3::from_axis_angle(rotation.normalize(), angle) } else { DMat3::IDENTITY };
        Self { rotation: turn * self.rotation, translation: self.translation + translation }
    }
}

fn center_of(grid: &Grid, foreground: &[bool]) -> Result<DVec3> {
    let (mut sum, mut count) = (DVec3::ZERO, 0.0);
    for (at, _) in foreground.iter().enumerate().filter(|(_, inside)| **inside) {
        sum += DVec3::from_array(grid.voxel_at(at).map(|i| i as f64));
        count += 1.0;
    }
    if count == 0.0 {
        return Err(Error::input("the fixed scan has no foreground"));
    }
    Ok(grid.index_to_world(sum / count))
}

fn starts(center: DVec3, moving: &ScalarImage, options: &RigidOptions) -> Result<Vec<Pose>> {
    if let Some(matrix) = options.initial {
        let rotation = DMat3::from_mat4(matrix);
        return Ok(vec![Pose { rotation, translation: apply(&matrix, center) - center }]);
    }
    let foreground: Vec<bool> = moving.voxels().iter().map(|&v| v != moving.background()).collect();
    let scanner = Pose { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };
    let centers = Pose { translation: center_of(moving.grid(), &foreground)? - center, ..scanner };
    Ok(match options.start {
        RigidStart::Scanner => vec![scanner],
        RigidStart::MassCenters => vec![centers],
        RigidStart::Best => vec![scanner, centers],
    })
}

/// Regular-step ascent: the step is halved when the direction turns by more than a right angle or the value falls.
fn climb(
    metric: &Metric,
    start: Pose,
    first_step: f64,
    options: &RigidOptions,
    context: &RunContext,
) -> Result<(f64, Pose, usize)> {
    let (mut pose, mut step) = (start, first_step);
    let (mut value, mut gradient) = metric.gradient(&pose);
    let mut steps = 0;
    // Below a hundredth of the resolution's first step a finer resolution does better.
    let last_step = if metric.level == 0 { options.min_step.max(1e-4) } else { first_step * 0.01 };
    while step > last_step && steps < options.max_iterations {
        context.check()?;
        steps += 1;
        let length = (gradient.0.length_squared() + gradient.1.length_squared()).sqrt();
        if length < 1e-12 {
            break;
        }
        let next = pose.moved(gradient.0 * (step / length), gradient.1 * (step / length));
        let (next_value, next_gradient) = metric.gradient(&next);
        if next_value <= value {
            step *= 0.5;
            continue;
        }
        let turned = next_gradient.0.dot(gradient.0) + next_gradient.1.dot(gradient.1) < 0.0;
        (pose, value, gradient) = (next, next_value, next_gradient);
        step *= if turned { 0.5 } else { 1.2 };
        step = step.min(first_step);
    }
    Ok((value, pose, steps))
}

/// The mutual information on one resolution.
struct Metric {
    level: usize,
    bins: usize,
    center: DVec3,
    /// World point and fixed bin of each sample.
    samples: Vec<(DVec3, u32)>,
    moving: Vec<f32>,
    grid: Grid,
    background: f32,
    /// World gradient from index gradient.
    to_world: DMat3,
    low: f64,
    width: f64,
}

/// Moving value, its bin coordinate and the world gradient at a sample.
#[derive(Clone, Copy)]
struct Probe {
    coordinate: f64,
    gradient: DVec3,
}

impl Metric {
    fn new(
        fixed: &ScalarImage,
        foreground: &[bool],
        moving: &ScalarImage,
        level: usize,
        options: &RigidOptions,
        center: DVec3,
    ) -> Self {
        let sigma = if level == 0 { 0.5 * FINEST_SIGMA } else { FINEST_SIGMA * f64::powi(2.0, level as i32 - 1) };
        let blur = |image: &ScalarImage| {
            let spacing = image.grid().spacing();
            smooth(image.voxels(), image.grid().size(), (sigma / spacing).to_array())
        };
        let (fixed_values, moving_values) = (blur(fixed), blur(moving));
        let bins = options.histogram_bins;
        let samples = samples(fixed, &fixed_values, foreground, options);
        let (low, high) = robust_range(&moving_values);
        // Two bins of padding on each side for the cubic window.
        let width = f64::from(high - low).max(1e-9) / (bins as f64 - 5.0);
        let grid = *moving.grid();
        let to_world = grid.direction().inverse().transpose() * DMat3::from_diagonal(grid.spacing().recip());
        Self {
            level,
            bins,
            center,
            samples,
            moving: moving_values,
            grid,
            background: moving.background(),
            to_world,
            low: f64::from(low),
            width,
        }
    }

    fn probe(&self, pose: &Pose, point: DVec3) -> Probe {
        let moved = pose.rotation * (point - self.center) + self.center + pose.translation;
        let index = self.grid.world_to_index(moved);
        let (value, gradient) =
            value_and_gradient(&self.moving, self.grid.size(), index).unwrap_or((self.background, DVec3::ZERO));
        let coordinate = (f64::from(value) - self.low) / self.width + 2.0;
        let inside = coordinate > 2.0 && coordinate < self.bins as f64 - 3.0;
        Probe {
            coordinate: coordinate.clamp(2.0, self.bins as f64 - 3.0),
            gradient: if inside { self.to_world * gradient } else { DVec3::ZERO },
        }
    }

    /// Joint histogram, normalised, row = fixed bin.
    fn histogram(&self, probes: &[Probe]) -> Vec<f64> {
        let bins = self.bins;
        let parts: Vec<Vec<f64>> = probes
            .par_chunks(CHUNK)
            .zip(self.samples.par_chunks(CHUNK))
            .map(|(probes, samples)| {
                let mut part = vec![0.0; bins * bins];
                for (probe, (_, fixed_bin)) in probes.iter().zip(samples) {
                    let first = probe.coordinate.floor() as usize - 1;
                    for bin in first..first + 4 {
                        part[*fixed_bin as usize * bins + bin] += cubic(bin as f64 - probe.coordinate);
                    }
                }
                part
            })
            .collect();
        let mut joint = vec![0.0; bins * bins];
        for part in parts {
            for (sum, value) in joint.iter_mut().zip(part) {
                *sum += value;
            }
        }
        let scale = 1.0 / probes.len() as f64;
        joint.iter_mut().for_each(|v| *v *= scale);
        joint
    }

    fn probes(&self, pose: &Pose) -> Vec<Probe> {
        self.samples.par_iter().with_min_len(CHUNK).map(|(point, _)| self.probe(pose, *point)).collect()
    }

    fn value(&self, pose: &Pose) -> f64 {
        information(&self.histogram(&self.probes(pose)), self.bins).0
    }

    /// The information and its derivative by rotation (per mm on the arm) and translation (per mm).
    fn gradient(&self, pose: &Pose) -> (f64, (DVec3, DVec3)) {
        let probes = self.probes(pose);
        let (value, ratio) = information(&self.histogram(&probes), self.bins);
        let scale = -1.0 / (probes.len() as f64 * self.width);
        let parts: Vec<(DVec3, DVec3)> = probes
            .par_chunks(CHUNK)
            .zip(self.samples.par_chunks(CHUNK))
            .map(|(probes, samples)| {
                let (mut turn, mut shift) = (DVec3::ZERO, DVec3::ZERO);
                for (probe, (point, fixed_bin)) in probes.iter().zip(samples) {
                    let first = probe.coordinate.floor() as usize - 1;
                    let mut weight = 0.0;
                    for bin in first..first + 4 {
                        weight += cubic_derivative(bin as f64 - probe.coordinate)
                            * ratio[*fixed_bin as usize * self.bins + bin];
                    }
                    let force = probe.gradient * weight;
                    shift += force;
                    turn += (pose.rotation * (*point - self.center)).cross(force);
                }
                (turn, shift)
            })
            .collect();
        let (mut turn, mut shift) = (DVec3::ZERO, DVec3::ZERO);
        for part in parts {
            turn += part.0;
            shift += part.1;
        }
        (value, (turn * (scale / ARM), shift * scale))
    }
}

/// Every n-th foreground voxel with its fixed bin.
fn samples(fixed: &ScalarImage, values: &[f32], foreground: &[bool], options: &RigidOptions) -> Vec<(DVec3, u32)> {
    let inside: Vec<usize> = foreground.iter().enumerate().filter(|(_, f)| **f).map(|(at, _)| at).collect();
    let wanted = (inside.len() as f64 * options.sampling_fraction) as usize;
    let wanted = wanted.clamp(MIN_SAMPLES.min(inside.len()), MAX_SAMPLES).max(1);
    let (low, high) = robust_range(values);
    let scale = options.histogram_bins as f32 / (high - low).max(1e-12);
    (0..wanted)
        .map(|n| {
            // A jitter from a multiplicative hash keeps the samples off the rows of the grid.
            let slot = n * inside.len() / wanted;
            let room = ((n + 1) * inside.len() / wanted - slot).max(1);
            let hash = (n as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 33;
            let at = inside[slot + hash as usize % room];
            let index = DVec3::from_array(fixed.grid().voxel_at(at).map(|i| i as f64));
            let bin = ((values[at] - low) * scale).clamp(0.0, options.histogram_bins as f32 - 1.0) as u32;
            (fixed.grid().index_to_world(index), bin)
        })
        .collect()
}

/// Range of a scan without the brightest 0.1 %: single bright voxels would leave the tissue in few bins.
fn robust_range(values: &[f32]) -> (f32, f32) {
    const BINS: usize = 4096;
    let (low, high) =
        values.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), &v| (low.min(v), high.max(v)));
    if high <= low {
        return (low, low);
    }
    let scale = (BINS as f32 - 1.0) / (high - low);
    let mut counts = vec![0usize; BINS];
    values.iter().for_each(|v| counts[((v - low) * scale) as usize] += 1);
    let mut above = 0;
    for bin in (1..BINS).rev() {
        above += counts[bin];
        if above * 1000 > values.len() {
            return (low, low + (bin + 1) as f32 / scale);
        }
    }
    (low, high)
}

/// Mutual information of a joint histogram, and `ln(p(f, m) / p(m))` per bin.
fn information(joint: &[f64], bins: usize) -> (f64, Vec<f64>) {
    // Below this share a bin is empty; the logarithm of its ratio would be noise.
    const EMPTY: f64 = 1e-14;
    let fixed: Vec<f64> = joint.chunks(bins).map(|row| row.iter().sum()).collect();
    let mut moving = vec![0.0; bins];
    for row in joint.chunks(bins) {
        for (sum, value) in moving.iter_mut().zip(row) {
            *sum += value;
        }
    }
    let (mut value, mut ratio) = (0.0, vec![0.0; bins * bins]);
    for f in 0..bins {
        for m in 0..bins {
            let p = joint[f * bins + m];
            if p > EMPTY && moving[m] > EMPTY && fixed[f] > EMPTY {
                ratio[f * bins + m] = (p / moving[m]).ln();
                value += p * (p / (moving[m] * fixed[f])).ln();
            }
        }
    }
    (value, ratio)
}

/// Cubic B-spline.
fn cubic(x: f64) -> f64 {
    let x = x.abs();
    if x < 1.0 {
        (4.0 - 6.0 * x * x + 3.0 * x * x * x) / 6.0
    } else if x < 2.0 {
        (2.0 - x).powi(3) / 6.0
    } else {
        0.0
    }
}

/// Derivative of [`cubic`].
fn cubic_derivative(x: f64) -> f64 {
    let (a, sign) = (x.abs(), x.signum());
    if a < 1.0 {
        sign * (1.5 * a * a - 2.0 * a)
    } else if a < 2.0 {
        -sign * 0.5 * (2.0 - a).powi(2)
    } else {
        0.0
    }
}

/// Trilinear value and its derivative by the index; `None` outside of the outermost centres.
fn value_and_gradient(values: &[f32], size: [usize; 3], index: DVec3) -> Option<(f32, DVec3)> {
    let mut low = [0usize; 3];
    let mut fraction = [0.0f64; 3];
    for axis in 0..3 {
        let x = index[axis];
        if !(x >= 0.0 && x < (size[axis] - 1) as f64) {
            return None;
        }
        low[axis] = x as usize;
        fraction[axis] = x - low[axis] as f64;
    }
    let base = low[0] + size[0] * (low[1] + size[1] * low[2]);
    let at = |x: usize, y: usize, z: usize| f64::from(values[base + x + size[0] * (y + size[1] * z)]);
    let [x, y, z] = fraction;
    let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let rows = [[0, 0], [1, 0], [0, 1], [1, 1]].map(|[j, k]| (at(0, j, k), at(1, j, k)));
    let along_x = rows.map(|(a, b)| mix(a, b, x));
    let slope_x = rows.map(|(a, b)| b - a);
    let (low_z, high_z) = (mix(along_x[0], along_x[1], y), mix(along_x[2], along_x[3], y));
    let gradient = DVec3::new(
        mix(mix(slope_x[0], slope_x[1], y), mix(slope_x[2], slope_x[3], y), z),
        mix(along_x[1] - along_x[0], along_x[3] - along_x[2], z),
        high_z - low_z,
    );
    Some((mix(low_z, high_z, z) as f32, gradient))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::resample::{map_voxels, resample_linear};
    use crate::registration::options::Options;

    fn head() -> ScalarImage {
        let grid = Grid::new([48, 56, 40], DVec3::new(3.0, 3.0, 3.5), DVec3::new(-70.0, -80.0, -65.0), DMat3::IDENTITY)
            .unwrap();
        let voxels = map_voxels(&grid, |p, _| {
            let r = (p / DVec3::new(58.0, 70.0, 52.0)).length();
            if r > 1.0 {
                return 0.0;
            }
            let texture = (p.x * 0.17).sin() + (p.y * 0.13 + 1.0).sin() + (p.z * 0.19 + p.x * 0.05).cos();
            (200.0 + 40.0 * texture - 90.0 * (p / 18.0 - DVec3::new(0.5, 0.2, 0.0)).length().min(1.0)) as f32
        });
        ScalarImage::new(grid, voxels, 0.0).unwrap()
    }

    #[test]
    fn the_analytic_gradient_matches_differences() {
        let moving = head();
        let foreground: Vec<bool> = moving.voxels().iter().map(|v| *v > 0.0).collect();
        let options = Options::default().rigid;
        let metric = Metric::new(&moving, &foreground, &moving, 1, &options, DVec3::ZERO);
        let pose = Pose { rotation: DMat3::from_rotation_z(0.03), translation: DVec3::new(2.0, -1.0, 1.0) };
        let (_, (turn, shift)) = metric.gradient(&pose);
        let step = 0.02;
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            let slope = |a: Pose, b: Pose| (metric.value(&a) - metric.value(&b)) / (2.0 * step);
            let by_turn = slope(pose.moved(axis * step, DVec3::ZERO), pose.moved(-axis * step, DVec3::ZERO));
            let by_shift = slope(pose.moved(DVec3::ZERO, axis * step), pose.moved(DVec3::ZERO, -axis * step));
            assert!((by_shift - shift.dot(axis)).abs() < 0.05 * shift.length(), "{by_shift} {shift}");
            assert!((by_turn - turn.dot(axis)).abs() < 0.05 * turn.length(), "{by_turn} {turn}");
        }
    }

    #[test]
    fn a_rigid_motion_and_a_changed_contrast_are_recovered_with_any_threads() {
        let moving = head();
        let truth = DMat4::from_rotation_translation(
            glam::DQuat::from_euler(glam::EulerRot::XYZ, 0.05, -0.08, 0.1),
            DVec3::new(6.0, -4.0, 5.0),
        );
        let mut fixed = resample_linear(&moving, moving.grid(), |p| truth.transform_point3(p)).unwrap();
        fixed.voxels_mut().iter_mut().filter(|v| **v > 0.0).for_each(|v| *v = 400.0 - 0.9 * *v);
        let foreground: Vec<bool> = fixed.voxels().iter().map(|v| *v > 0.0).collect();
        let options = Options::default().rigid;
        let run = |threads| {
            let context = RunContext::with_threads(threads).unwrap();
            context.install(|| find_rigid(&fixed, &foreground, &moving, &options, &context)).unwrap()
        };
        let (one, two) = (run(1), run(2));
        assert_eq!(one, two);
        for p in [DVec3::ZERO, DVec3::new(40.0, 0.0, 0.0), DVec3::new(0.0, -50.0, 30.0)] {
            let error = (one.matrix.transform_point3(p) - truth.transform_point3(p)).length();
            assert!(error < 0.3, "{error} at {p}");
        }
    }
}
