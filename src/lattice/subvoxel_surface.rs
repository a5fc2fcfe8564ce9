//! Where the surface between labels runs inside of the voxels: a smooth signed distance per pair of labels.
//!
//! # Method
//! 1. Near a boundary each label has a smooth distance ([`smooth_distance`](crate::lattice::smooth_distance)), positive
//!    inside. Between two labels it is the mean of theirs, weighted for the one that is no edge or crease there: at a line
//!    where three labels meet, the one that goes straight on decides. In the half of a thin wall that is nearer to its other
//!    surface the distances of both labels lead apart; there the one that is farther away is meant. Where one of them is a vessel
//!    and the other is not, the vessel's counts alone.
//! 2. Farther away the indicator of each label is smoothed by a Gaussian of `SIGMA` voxels: the sum over the 6 x 6 x 6 voxels
//!    around the point. The ratio `(f_a - f_b) / (f_a + f_b)` of a flat interface is an error function of the distance; its
//!    inverse leads a vertex near enough for step 1.
//! 3. The image is continued past its border by its outermost voxels; there the border planes bound the labels.
//! 4. An offset per label moves its surfaces outward: it makes up for the volume that smoothing takes from convex bodies.
//!
//! # Differences
//! The thesis moves vertices to voxel centres, which keeps the staircase. The smooth distance keeps every voxel centre on its
//! side and bends least.
//!
//! # Cost
//! About 150 multiplications per label near a boundary, 1500 elsewhere.

use glam::{DMat3, DVec3};

use crate::context::RunContext;
use crate::error::Result;
use crate::image::label_image::LabelImage;
use crate::index::Label;
use crate::lattice::distance_spline::{Sample, Stencil};
use crate::lattice::smooth_distance::SmoothDistances;

/// Width of the smoothing in voxels: below 0.7 the staircase shows, above 1.2 walls of 1.5 voxels lose volume.
const SIGMA: f64 = 0.95;

/// Gradient of a distance below which it leads nowhere: the middle of a thin part, or a place that is far.
const LEAST_GRADIENT: f64 = 0.2;

/// Weight of a label's distance: this power of the squared length of its gradient, which is 1 by a plane and a half or less
/// where surfaces meet at right angles.
const GRADIENT_POWER: i32 = 4;

/// Longest distance that is told, mm.
const LONGEST_DISTANCE: f64 = 3.0;

/// Ratios are cut here: past it the inverse error function is steep and a surface is not near.
const LARGEST_RATIO: f64 = 0.999;

/// Damping of the junction solve, relative to unit normals.
const JUNCTION_DAMPING: f64 = 0.02;

/// Newton steps of a projection.
const PROJECTION_STEPS: usize = 4;

/// A step this short, in voxels of the smallest spacing, is the last: what is left is of second order, a hundredth of a voxel.
const LAST_STEP: f64 = 0.06;

/// What lies on one side of a surface: a label, or a border plane of the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Side {
    /// A label, the background included.
    Label(Label),
    /// Beyond a border plane: 0 to 5 for low i, high i, low j, high j, low k, high k.
    Border(u8),
}

/// Signed distances between the labels of an image; local frame, mm.
#[derive(Debug, Clone)]
pub struct SubvoxelSurface<'a> {
    voxels: &'a [Label],
    size: [usize; 3],
    spacing: DVec3,
    /// Distances near the boundaries of labels.
    smooth: SmoothDistances,
    /// Outward offset per label, mm.
    offsets: Vec<f64>,
    has_mostly_vessels: bool,
    /// The Gaussian at whole voxels -2 to 3.
    tails: [f64; 6],
}

/// What the smooth distance of one label says of the surface between two.
#[derive(Debug, Clone, Copy)]
struct LabelTerm {
    near: NearSurface,
    weight: f64,
}

/// A surface between two labels near a point.
#[derive(Debug, Clone, Copy, Default)]
struct NearSurface {
    /// Way to it along the normal, mm, positive in the first label.
    distance: f64,
    /// Distance to it, mm: less than the way by a crease between two tubes.
    depth: f64,
    /// Unit normal towards the first label.
    normal: DVec3,
}

/// Weights of the Gaussian and its derivative along one axis, and the voxels they belong to.
struct AxisWeights {
    voxel: [usize; 6],
    value: [f64; 6],
    slope: [f64; 6],
}

impl<'a> SubvoxelSurface<'a> {
    /// The surfaces of an image.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn new(image: &'a LabelImage, context: &RunContext) -> Result<Self> {
        let smooth = SmoothDistances::new(image, context)?;
        let labels = image.label_count();
        let vessels = (0..labels).filter(|label| smooth.is_tubular(Label(*label as u16))).count();
        Ok(Self {
            smooth,
            has_mostly_vessels: 2 * vessels >= labels,
            voxels: image.voxels(),
            size: image.grid().size(),
            spacing: image.grid().spacing(),
            offsets: vec![0.0; labels],
            tails: std::array::from_fn(|slot| {
                let i = slot as f64 - 2.0;
                (-i * i / (2.0 * SIGMA * SIGMA)).exp()
            }),
        })
    }

    /// Whether at least half of the labels are vessels, the background around them included.
    pub fn has_mostly_vessels(&self) -> bool {
        self.has_mostly_vessels
    }

    /// Whether several labels meet, most of them no vessels: their surfaces follow the staircase of the voxels in many places whatever is
    /// done, so that the last bit of work on them shows least.
    pub fn follows_staircase(&self) -> bool {
        self.offsets.len() > 2 && !self.has_mostly_vessels
    }

    /// Millimetres between voxels.
    pub fn spacing(&self) -> DVec3 {
        self.spacing
    }

    /// Half of a voxel's diagonal, mm: how far a smooth surface may run from the voxels' boundary.
    pub fn half_diagonal(&self) -> f64 {
        self.spacing.length() / 2.0
    }

    /// Outward offset of each label, mm.
    pub fn offsets_mut(&mut self) -> &mut [f64] {
        &mut self.offsets
    }

    /// The label of the voxel around a point; outside of the image, that of the nearest voxel.
    pub fn nearest_label(&self, point: DVec3) -> Label {
        let index = (point / self.spacing).round().to_array();
        let [i, j, k]: [usize; 3] = std::array::from_fn(|d| (index[d].max(0.0) as usize).min(self.size[d] - 1));
        self.voxels[i + self.size[0] * (j + self.size[1] * k)]
    }

    /// Position of a border plane along its axis, mm.
    pub fn border(&self, plane: u8) -> (usize, f64) {
        let axis = usize::from(plane / 2);
        let voxel = if plane.is_multiple_of(2) { -0.5 } else { self.size[axis] as f64 - 0.5 };
        (axis, voxel * self.spacing[axis])
    }

    /// The point of the image nearest to `point`: beyond the border planes there is nothing to mesh, although the surfaces go
    /// on there. Vertices of surfaces that only run towards a plane have no side that holds them back.
    pub fn within_borders(&self, point: DVec3) -> DVec3 {
        let [low, high] = [0, 1].map(|end| DVec3::from_array([0, 2, 4].map(|plane| self.border(plane + end).1)));
        point.clamp(low, high)
    }

    /// The border plane nearest to a point.
    pub fn nearest_border(&self, point: DVec3) -> u8 {
        let beyond = |plane: u8| {
            let (axis, at) = self.border(plane);
            if plane.is_multiple_of(2) { at - point[axis] } else { point[axis] - at }
        };
        (0..6).max_by(|l, r| beyond(*l).total_cmp(&beyond(*r))).unwrap_or(0)
    }

    fn axis_weights(&self, axis: usize, coordinate: f64) -> AxisWeights {
        let at = coordinate / self.spacing[axis];
        let base = at.floor();
        let fraction = at - base;
        let inverse = 1.0 / (SIGMA * SIGMA);
        let mut weights = AxisWeights { voxel: [0; 6], value: [0.0; 6], slope: [0.0; 6] };
        // exp(-(t - i)^2 / 2 s^2) for i = -2..3 by two exponentials and products.
        let center = (-fraction * fraction * inverse / 2.0).exp();
        let step = (fraction * inverse).exp();
        let powers = [1.0 / (step * step), 1.0 / step, 1.0, step, step * step, step * step * step];
        for (slot, power) in powers.into_iter().enumerate() {
            let i = slot as f64 - 2.0;
            let value = center * power * self.tails[slot];
            weights.value[slot] = value;
            weights.slope[slot] = -(fraction - i) * inverse * value / self.spacing[axis];
            weights.voxel[slot] = ((base + i).max(0.0) as usize).min(self.size[axis] - 1);
        }
        weights
    }

    /// Sums over the voxels around a point: `f_a - f_b` and `f_a + f_b`, each with its gradient.
    fn smoothed(&self, point: DVec3, a: Label, b: Label) -> [(f64, DVec3); 2] {
        let x = self.axis_weights(0, point.x);
        let y = self.axis_weights(1, point.y);
        let z = self.axis_weights(2, point.z);
        let is_inside = x.voxel[5] - x.voxel[0] == 5;
        let whole: (f64, f64) = (x.value.iter().sum(), x.slope.iter().sum());
        let mut sums = [(0.0, DVec3::ZERO); 2];
        for k in 0..6 {
            for j in 0..6 {
                let row = self.size[0] * (y.voxel[j] + self.size[1] * z.voxel[k]);
                let mut labels = [Label::BACKGROUND; 6];
                if is_inside {
                    labels.copy_from_slice(&self.voxels[row + x.voxel[0]..row + x.voxel[0] + 6]);
                } else {
                    labels.iter_mut().zip(&x.voxel).for_each(|(label, i)| *label = self.voxels[row + i]);
                }
                let Some(of_row) = row_sums(&labels, &x, whole, a, b) else { continue };
                let plane = DVec3::new(y.value[j] * z.value[k], y.slope[j] * z.value[k], y.value[j] * z.slope[k]);
                for ((value, gradient), (sum, slope)) in sums.iter_mut().zip(of_row) {
                    *value += plane.x * sum;
                    *gradient += plane * DVec3::new(slope, sum, sum);
                }
            }
        }
        sums
    }

    /// What the smooth distances are sampled with at a point, mm.
    fn stencil(&self, point: DVec3) -> Stencil {
        Stencil::around(point / self.spacing, self.size, self.spacing)
    }

    /// Signed distance to the surface between labels a and b, mm, positive in a, and the unit normal towards a; `None` where
    /// no such surface is near.
    pub fn signed_distance(&self, point: DVec3, a: Label, b: Label) -> Option<(f64, DVec3)> {
        let near = self.near_surface(point, a, b).map(|near| (near.distance, near.normal));
        near.or_else(|| self.blurred_distance(point, a, b))
    }

    /// How far a point is from the surface between labels a and b, mm, positive in a: the distance of
    /// [`signed_distance`](Self::signed_distance), but for a crease between two tubes, where the normal leads into the crease and the
    /// surface is nearer. Also in the middle of a thin part, where no direction leads to the surface: half the difference of both
    /// labels' distances there.
    pub fn depth(&self, point: DVec3, a: Label, b: Label) -> Option<f64> {
        if let Some(near) = self.near_surface(point, a, b) {
            return Some(near.depth);
        }
        let has = |label| self.smooth.has(label) && !self.is_beside_tubes(label, [a, b]);
        let stencil = self.stencil(point);
        let sample = |label| self.smooth.sample(label, &stencil);
        let value = |label| has(label).then(|| sample(label))?.map(|found| found.value);
        match (value(a), value(b)) {
            (Some(of_a), Some(of_b)) => Some((of_a - of_b) / 2.0 + self.offset(a, b)),
            (Some(of_a), None) if !has(b) => Some(of_a + self.offset(a, b)),
            (None, Some(of_b)) if !has(a) => Some(self.offset(a, b) - of_b),
            _ => self.blurred_distance(point, a, b).map(|(distance, _)| distance),
        }
    }

    /// The place on the surface between two labels that is nearest by the tube that a point is deepest in: on one side of a crease
    /// that [`project`](Self::project) leads into. `None` where no tubes tell.
    pub fn nearest_on_tube(&self, point: DVec3, a: Label, b: Label) -> Option<DVec3> {
        let (label, other) = if self.smooth.is_tubular(a) { (a, b) } else { (b, a) };
        let outward = self.smooth.sample(label, &self.stencil(point))?.outward?;
        let depth = self.depth(point, label, other)?;
        Some(self.within_borders(point + depth * outward))
    }

    /// The surface near a boundary, moved by the offsets.
    fn near_surface(&self, point: DVec3, a: Label, b: Label) -> Option<NearSurface> {
        let NearSurface { distance, depth, normal } = self.smooth_difference(point, a, b)?;
        let moved = |d: f64| d.clamp(-LONGEST_DISTANCE, LONGEST_DISTANCE) + self.offset(a, b);
        Some(NearSurface { distance: moved(distance), depth: moved(depth), normal })
    }

    /// Whether the other label of a pair is a vessel and this one is not: the vessel's distance is that of the surface between
    /// them, also in the half of a thin wall that is nearer to its other surface.
    fn is_beside_tubes(&self, label: Label, pair: [Label; 2]) -> bool {
        !self.smooth.is_tubular(label) && pair.into_iter().any(|other| self.smooth.is_tubular(other))
    }

    /// The surface from the smooth distances of both labels. A label that is thin or has an edge here (another label meets the two)
    /// has a distance that is rounded off, of a short gradient: it weighs little.
    fn smooth_difference(&self, point: DVec3, a: Label, b: Label) -> Option<NearSurface> {
        let stencil = self.stencil(point);
        let mut found: [Option<LabelTerm>; 2] = [None; 2];
        for (slot, (label, sign)) in [(a, 1.0), (b, -1.0)].into_iter().enumerate() {
            if (!self.smooth.has(label) && label.is_background()) || self.is_beside_tubes(label, [a, b]) {
                continue;
            }
            let Sample { value, gradient, outward } = self.smooth.sample(label, &stencil)?;
            let square = gradient.length_squared();
            if square > LEAST_GRADIENT * LEAST_GRADIENT {
                let length = square.sqrt();
                let weight = square.min(1.0).powi(GRADIENT_POWER);
                let distance = sign * value / length;
                let depth = if outward.is_some() { sign * value } else { distance };
                let near = NearSurface { distance, depth, normal: sign * gradient / length };
                found[slot] = Some(LabelTerm { near, weight });
            }
        }
        if let [Some(LabelTerm { near: of_a, .. }), Some(LabelTerm { near: of_b, .. })] = found
            && (of_a.distance > 0.0) == (of_b.distance > 0.0)
            && of_a.normal.dot(of_b.normal) < 0.0
        {
            // Within a thin label whose other surface is nearer. The surface between a and b is no nearer than either label's.
            found[usize::from(of_a.distance.abs() > of_b.distance.abs())] = None;
        }
        let (mut sum, mut total) = (NearSurface::default(), 0.0);
        for LabelTerm { near, weight } in found.into_iter().flatten() {
            sum.distance += weight * near.distance;
            sum.depth += weight * near.depth;
            sum.normal += weight * near.normal;
            total += weight;
        }
        let length = sum.normal.length();
        (length > LEAST_GRADIENT * total).then(|| NearSurface {
            distance: sum.distance / total,
            depth: sum.depth / total,
            normal: sum.normal / length,
        })
    }

    /// As [`signed_distance`](Self::signed_distance), by the smoothed indicators.
    fn blurred_distance(&self, point: DVec3, a: Label, b: Label) -> Option<(f64, DVec3)> {
        let [(value, value_gradient), (presence, presence_gradient)] = self.smoothed(point, a, b);
        if !(presence > 0.02) {
            return None;
        }
        // Where a third label is near, both sums fall towards it; their ratio does not.
        let gradient = (value_gradient - presence_gradient * (value / presence)) / presence;
        let length = gradient.length();
        if !(length > 1e-6) {
            return None;
        }
        let ratio = (value / presence).clamp(-LARGEST_RATIO, LARGEST_RATIO);
        // A flat interface: ratio = erf(t / sqrt 2) at t sigmas, slope of the ratio 2 pdf(t) per sigma.
        let sigmas = std::f64::consts::SQRT_2 * inverse_error_function(ratio);
        let density = (-sigmas * sigmas / 2.0).exp() * 2.0 / (2.0 * std::f64::consts::PI).sqrt();
        let per_sigma = length / density;
        let distance = (sigmas / per_sigma).clamp(-LONGEST_DISTANCE, LONGEST_DISTANCE) + self.offset(a, b);
        (distance.is_finite()).then(|| (distance, gradient / length))
    }

    fn offset(&self, a: Label, b: Label) -> f64 {
        self.offsets[a.index()] - self.offsets[b.index()]
    }

    /// Step from a point to the place where all `sides` meet, mm, and the residual distance before it; `None` where they
    /// are not near.
    pub fn step_to_junction(&self, point: DVec3, sides: &[Side]) -> Option<(DVec3, f64)> {
        let mut normal_matrix = DMat3::ZERO;
        let mut pull = DVec3::ZERO;
        let mut residual: f64 = 0.0;
        let mut count = 0;
        let mut add = |distance: f64, normal: DVec3| {
            normal_matrix += DMat3::from_cols(normal * normal.x, normal * normal.y, normal * normal.z);
            pull -= normal * distance;
            residual = residual.max(distance.abs());
            count += 1;
        };
        let mut single = None;
        let mut planes = [None; 3];
        for side in sides {
            if let Side::Border(plane) = side {
                let (axis, at) = self.border(*plane);
                planes[axis] = Some(at);
            }
        }
        let labels = || sides.iter().filter_map(|s| if let Side::Label(l) = s { Some(*l) } else { None });
        let mut first = None;
        for label in labels() {
            if let Some(before) = first
                && let Some((distance, normal)) = self.signed_distance(point, before, label)
            {
                add(distance, normal);
                single = Some(-normal * distance);
            }
            first = Some(label);
        }
        let border_count = planes.iter().flatten().count();
        if count == 0 && border_count == 0 {
            return None;
        }
        let mut step = match (count, border_count, single) {
            (1, 0, Some(step)) => step,
            (0, ..) => DVec3::ZERO,
            _ => {
                // Components along border normals are decided by the planes.
                for (axis, plane) in planes.iter().enumerate() {
                    if plane.is_some() {
                        let mut keep = DVec3::ONE;
                        keep[axis] = 0.0;
                        let mask = DMat3::from_diagonal(keep);
                        normal_matrix = mask * normal_matrix * mask;
                        pull *= keep;
                    }
                }
                (normal_matrix + DMat3::from_diagonal(DVec3::splat(JUNCTION_DAMPING))).inverse() * pull
            }
        };
        for (axis, plane) in planes.iter().enumerate() {
            if let Some(at) = plane {
                step[axis] = at - point[axis];
                residual = residual.max(step[axis].abs());
            }
        }
        step.is_finite().then_some((step, residual))
    }

    /// The point of the junction of `sides` near `point`, within the image and at most `reach` (mm) away; `None` where there is
    /// none.
    pub fn project(&self, point: DVec3, sides: &[Side], reach: f64) -> Option<DVec3> {
        let mut at = point;
        let tolerance = LAST_STEP * self.spacing.min_element();
        let longest = 0.75 * self.spacing.max_element();
        for _ in 0..PROJECTION_STEPS {
            let (step, _) = self.step_to_junction(at, sides)?;
            at = self.within_borders(at + step.clamp_length_max(longest));
            if at.distance_squared(point) > reach * reach {
                return None;
            }
            if step.length_squared() < tolerance * tolerance {
                break;
            }
        }
        // The planes are met exactly, whatever the last step was.
        for side in sides {
            if let Side::Border(plane) = side {
                let (axis, position) = self.border(*plane);
                at[axis] = position;
            }
        }
        Some(at)
    }
}

/// Sums of one row of voxels, of the difference of two labels and of both together, each with its slope; `None` where neither
/// label is met. `whole` is the sums of the weights.
#[inline]
fn row_sums(labels: &[Label; 6], x: &AxisWeights, whole: (f64, f64), a: Label, b: Label) -> Option<[(f64, f64); 2]> {
    // Most rows hold one label only.
    let [first, l1, l2, l3, l4, l5] = *labels;
    if (l1 == first) & (l2 == first) & (l3 == first) & (l4 == first) & (l5 == first) {
        return if first == a { Some([whole, whole]) } else { (first == b).then_some([(-whole.0, -whole.1), whole]) };
    }
    let mut sums = [(0.0, 0.0); 2];
    for i in 0..6 {
        let (in_a, in_b) = (f64::from(u8::from(labels[i] == a)), f64::from(u8::from(labels[i] == b)));
        for (sum, sign) in sums.iter_mut().zip([in_a - in_b, in_a + in_b]) {
            sum.0 += sign * x.value[i];
            sum.1 += sign * x.slope[i];
        }
    }
    Some(sums)
}

/// Inverse of the error function within 2e-3: a start for Newton steps, exact at zero.
fn inverse_error_function(value: f64) -> f64 {
    let log = (1.0 - value * value).ln();
    let a = 0.147;
    let first = 2.0 / (std::f64::consts::PI * a) + log / 2.0;
    value.signum() * ((first * first - log / a).sqrt() - first).max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use crate::lattice::test_images::{fork_distance, voxel_image};

    /// Label 1 in a ball, label 2 in the half of it beyond x = 10.3.
    fn split_ball(radius: f64) -> LabelImage {
        let grid = Grid::new([24; 3], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let mut voxels = Vec::new();
        for k in 0..24 {
            for j in 0..24 {
                for i in 0..24 {
                    let p = DVec3::new(f64::from(i), f64::from(j), f64::from(k));
                    let inside = p.distance(DVec3::new(11.2, 11.6, 11.9)) < radius;
                    voxels.push(Label(if !inside { 0 } else { 1 + u16::from(p.x > 10.3) }));
                }
            }
        }
        LabelImage::new(grid, voxels, vec![0, 1, 2]).unwrap()
    }

    #[test]
    fn the_inverse_error_function_inverts_a_known_value() {
        // erf(0.5) = 0.5204998778.
        assert!((inverse_error_function(0.520_499_877_8) - 0.5).abs() < 2e-3);
        assert_eq!(inverse_error_function(0.0), 0.0);
    }

    #[test]
    fn points_near_a_ball_are_projected_to_it_within_a_fifth_of_a_voxel() {
        let image = split_ball(8.0);
        let surface = SubvoxelSurface::new(&image, &RunContext::with_threads(1).unwrap()).unwrap();
        let center = DVec3::new(11.2, 11.6, 11.9);
        for n in 0..40 {
            let t = f64::from(n);
            // Only the side of label 2, away from the junction.
            let direction = DVec3::new(1.2 + (t * 0.7).sin(), (t * 1.3).cos(), (t * 2.1).sin()).normalize();
            let start = center + direction * (8.0 + 0.8 * (t * 0.9).sin());
            let sides = [Side::Label(Label(0)), Side::Label(Label(2))];
            let found = surface.project(start, &sides, 2.0).expect("a surface is near");
            assert!((found.distance(center) - 8.0).abs() < 0.3, "{}", found.distance(center));
        }
    }

    #[test]
    fn a_junction_of_three_labels_is_found() {
        let image = split_ball(8.0);
        let surface = SubvoxelSurface::new(&image, &RunContext::with_threads(1).unwrap()).unwrap();
        let sides = [Side::Label(Label(0)), Side::Label(Label(1)), Side::Label(Label(2))];
        // The junction is the circle x = 10.5 (between voxels 10 and 11) on the ball.
        let found = surface.project(DVec3::new(11.0, 11.6 + 7.5, 11.9), &sides, 3.0).expect("a junction is near");
        assert!((found.x - 10.5).abs() < 0.25, "{found}");
        assert!((found.distance(DVec3::new(11.2, 11.6, 11.9)) - 8.0).abs() < 0.5, "{found}");
    }

    #[test]
    fn border_planes_are_met_exactly() {
        let image = split_ball(14.0);
        let surface = SubvoxelSurface::new(&image, &RunContext::with_threads(1).unwrap()).unwrap();
        let sides = [Side::Label(Label(2)), Side::Border(1)];
        let found = surface.project(DVec3::new(23.9, 11.0, 12.0), &sides, 2.0).expect("the border is near");
        assert_eq!(found, DVec3::new(23.5, 11.0, 12.0));
    }

    #[test]
    fn in_a_crease_between_tubes_depths_are_distances_and_the_nearest_place_is_on_one_of_them() {
        let ends = [[19.0, 15.9, 5.5], [27.8, 16.7, 31.7], [9.2, 20.7, 31.7]];
        let off = |p: DVec3| fork_distance(p, ends, 1.9);
        let image = voxel_image(38, |p| u16::from(off(p) < 0.0));
        let surface = SubvoxelSurface::new(&image, &RunContext::with_threads(1).unwrap()).unwrap();
        let fork = DVec3::new(18.9, 17.4, 18.7);
        let upward: DVec3 = ends[1..].iter().map(|end| (DVec3::from(*end) - fork).normalize()).sum();
        let mut seen = 0;
        for n in 0..60 {
            let at = fork + upward.normalize() * (2.0 + 0.05 * f64::from(n));
            let exact = off(at);
            if !(0.2..1.0).contains(&exact) {
                continue;
            }
            seen += 1;
            let depth = surface.depth(at, Label(1), Label(0)).unwrap();
            // Measured 0.03; the way into the crease is longer by 0.4.
            assert!((depth + exact).abs() < 0.1, "{depth} {exact}");
            let nearest = surface.nearest_on_tube(at, Label(1), Label(0)).unwrap();
            assert!(off(nearest).abs() < 0.1 && nearest.distance(at) < exact + 0.1, "{nearest}");
        }
        assert!(seen > 5, "{seen}");
    }

    #[test]
    fn surfaces_end_at_the_border_also_for_points_that_no_plane_holds() {
        let image = split_ball(14.0);
        let surface = SubvoxelSurface::new(&image, &RunContext::with_threads(1).unwrap()).unwrap();
        // Between both labels beyond the plane k = -0.5, where the image is continued.
        let sides = [Side::Label(Label(1)), Side::Label(Label(2))];
        let found = surface.project(DVec3::new(10.7, 12.0, -1.4), &sides, 2.0).expect("a surface is near");
        assert!(found.z == -0.5 && (found.x - 10.5).abs() < 0.1, "{found}");
    }

    #[test]
    fn beyond_the_middle_of_a_thin_wall_the_farther_label_tells_the_distance() {
        // A wall of one voxel, x = 7.5 to 8.5, between label 1 and the background.
        let grid = Grid::new([16; 3], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let label = |x: usize| Label(if x < 8 { 1 } else { 2 * u16::from(x == 8) });
        let voxels: Vec<Label> = (0..4096).map(|v| label(v % 16)).collect();
        let image = LabelImage::new(grid, voxels, vec![0, 1, 2]).unwrap();
        let surface = SubvoxelSurface::new(&image, &RunContext::with_threads(1).unwrap()).unwrap();
        let (distance, normal) = surface.signed_distance(DVec3::new(8.4, 8.0, 8.0), Label(1), Label(2)).unwrap();
        assert!((distance + 0.9).abs() < 0.03 && normal.distance(DVec3::NEG_X) < 0.01, "{distance} {normal}");
        let (distance, normal) = surface.signed_distance(DVec3::new(7.6, 8.0, 8.0), Label(2), Label(0)).unwrap();
        assert!((distance - 0.9).abs() < 0.03 && normal.distance(DVec3::NEG_X) < 0.01, "{distance} {normal}");
        // Past the wall label 1 has no distance, and the blurred indicators of both labels fall towards the background.
        let beyond = DVec3::new(8.6, 8.0, 8.0);
        assert!(surface.smooth_difference(beyond, Label(1), Label(2)).is_none());
        let (distance, normal) = surface.signed_distance(beyond, Label(1), Label(2)).unwrap();
        assert!((distance + 1.0).abs() < 0.4 && normal.distance(DVec3::NEG_X) < 0.01, "{distance} {normal}");
    }
}
