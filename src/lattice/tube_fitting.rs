//! Tubes that separate the voxel centres inside of a solid from those outside, with as few bends as these allow.
//!
//! # Method
//! The depth of a point is the largest of `r(t) - |x - c(t)|` over the segments of all tubes, `t` the place along the segment's
//! axis nearest to it. Gauss-Newton steps lessen, in voxels:
//! 1. for each voxel near the boundary the square of what its depth lacks to a margin
//!    ([`MARGIN`](crate::lattice::deepest_segments::MARGIN)) on its side: where a surface passes in the middle between the centres of
//!    both sides, neither pulls more. What lacks much counts linearly.
//! 2. for each tube the squares of the second differences of its axis and of its radius, and the first ones of its radius. All are
//!    weighed down where they are large ([GemanMcClure1987]): a kink is one place, not a bend of all.
//! 3. the squared differences of the lengths of its segments from their mean, so that nodes keep their distance;
//! 4. where the tubes have partners, those of the wall around them, the squared distances of their nodes from those of these, and the
//!    squared differences of the walls between them from the median of all, both weighed down where they are large: vessels and their
//!    walls are concentric as a rule, the tip of a thick tube is known better, and a thin lumen that few voxels tell of has the wall
//!    of the others;
//! 5. for the ends of tubes that meet ([`tube_joints`](crate::lattice::tube_joints)) the squared distances from their mean;
//! 6. for another end that lies within a tube the squared distance from the axis of that, and what its radius is larger:
//!    inside of the other tube no voxel tells where it is, and it would bulge out to serve single voxels.
//!
//! From an end within another tube to where the tube has come out of that, no bend is weighed down: nothing there tells of a kink.
//!
//! A voxel belongs to the segment that it is deepest in ([`deepest_segments`](crate::lattice::deepest_segments)); each tube has its
//! own banded system, solved by [`BandedSystem`].
//! ```text
//!      o  o   o  o  o              o  o   o  o  o
//!     ___________________          ______________
//!      x  x \_x__x__x     ->        x  x  x  x  x \       tubes keep a sharp crotch, which a smooth surface fills
//!     ___x___x\ x  x  x            ___x__/x\ x   x \
//!      o  o    \ x  x               o  o  o \  x
//! ```
//!
//! # Source
//! [WoerzRohr2007] for tubes fitted to what an image has at their boundary; [GemanMcClure1987] for the weights.
//!
//! # Differences
//! Labels in place of intensities: a margin in place of an edge profile. All tubes at once, their union in place of joints.
//!
//! # Invariants
//! Radii are at least [`LEAST_RADIUS`]. The same bits for any number of threads: each tube takes its voxels in their order.
//!
//! # Cost
//! Each step compares the voxels that may lack depth with the few segments that they may be deepest in, and each end with the
//! tubes of which the box is around it. Parallel over blocks of voxels and over tubes.

use glam::DVec3;
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::banded_system::{BANDWIDTH, BandedSystem};
use crate::lattice::centerlines::{Tube, TubeNode};
use crate::lattice::deepest_segments::{
    BoundaryVoxels, Deepest, LARGEST_STEP, NearSegments, depth_in_segment, segments_of,
};
use crate::lattice::tube_joints::{Joint, place_of};

/// Lack of depth from which on it counts linearly, in mean spacings: voxels that no tube explains do not pull all tubes.
const LINEAR: f64 = 1.5;

/// Weights of the second differences of axis and radius, of the first ones of the radius, and of unequal segments. On vessels of
/// 1.5 to 3 voxels radius half or twice of each change the mean error by less than a twentieth. Of 23 vessel trees the tubes are off
/// by more than 0.3 voxel at 33 places with 60, 100, 5, at 27 and 35 with 100 and 20 in place of the first and the last.
const AXIS_BENDING: f64 = 100.0;
const RADIUS_BENDING: f64 = 100.0;
const RADIUS_SLOPE: f64 = 20.0;
const EVENNESS: f64 = 1.0;

/// Angle of a kink, rad, and change of radius, in mean spacings, from which on more costs less.
const KINK: f64 = 0.07;
const RADIUS_KINK: f64 = 0.1;

/// Weight of the distance of nodes from those of their partners, and the distance from which on more costs less, in mean
/// spacings; that of walls too.
const PARTNERSHIP: f64 = 3.0;
const PARTED: f64 = 0.3;

/// Weight of the difference of the wall between a node and its partner from the median. Of 23 vessel trees the tubes are off by more
/// than 0.3 voxel at 56 places without, 36 with 3, 33 with this, 37 with 30.
const WALL: f64 = 10.0;

/// Weight of the distance of an end from the axis of the tube that it begins in, and of what its radius is larger than there. On 16
/// vessel trees, with the creases of tubes told exactly, 25 places of the mesh are off by more than half a voxel without, 17 with
/// this, 21 with 20.
const JOINT: f64 = 3.0;

/// Weight of the distance of an end from the mean of those that it meets. Of 28 vessel trees the tubes are off by more than
/// 0.45 voxel at 29 places with 3, 27 with this and with 1, 51 with 5, which lets joints slide too slowly.
const MEETING: f64 = 2.0;

/// How far from the tube that it begins in a tube may be and still not kink, in mean spacings: 29 such places with 0 to 2, more
/// with less.
const HIDDEN: f64 = 2.0;

/// Damping of a step: where tubes overlap, others than these are as good.
const DAMPING: f64 = 1.0;

/// Change of a node after which there is none, in mean spacings.
const LAST_STEP: f64 = 0.02;

/// Least radius, in mean spacings.
pub const LEAST_RADIUS: f64 = 0.3;

/// Least mean length of segments in the weights, in mean spacings: those of a tube of two nodes may vanish.
const LEAST_SEGMENT: f64 = 0.3;

/// Largest lack that is told, in mean spacings: voxels far from all tubes.
const LARGEST_LACK: f64 = 3.0;

/// Unknowns of a node: its centre and its radius.
const UNKNOWNS: usize = 4;

impl BoundaryVoxels {
    /// What all voxels lack, mean spacings squared.
    pub fn loss(&self, tubes: &[Tube]) -> f64 {
        let of_voxel = |(voxel, found): (usize, &Deepest)| {
            let lack = self.lack(voxel, found.depth.max(-LARGEST_LACK * self.mean_spacing()));
            if lack < LINEAR { lack * lack } else { LINEAR * (2.0 * lack - LINEAR) }
        };
        self.deepest(tubes).iter().enumerate().map(of_voxel).sum()
    }
}

/// Fits tubes to the voxels by at most `steps` steps; `joints` tell which ends meet; `partners`, if there are any, have as many
/// tubes and nodes.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn fit_tubes(
    tubes: &mut [Tube],
    joints: &[Joint],
    partners: Option<&[Tube]>,
    voxels: &BoundaryVoxels,
    steps: usize,
    context: &RunContext,
) -> Result<()> {
    let mut near = NearSegments::default();
    for _ in 0..steps {
        context.check()?;
        near.update(voxels, segments_of(tubes));
        let mut of_tube = vec![Vec::new(); tubes.len()];
        for (voxel, found) in near.lacking(voxels) {
            of_tube[found.tube as usize].push((voxel, found));
        }
        let ends = ends_of(tubes, joints, voxels.mean_spacing());
        let beside = partners.map(|tubes_beside| (tubes_beside, median_wall(tubes, tubes_beside)));
        let step = |(number, (tube, own)): (usize, (&mut Tube, &Vec<(usize, Deepest)>))| {
            let mut system = BandedSystem::new(UNKNOWNS * tube.nodes.len());
            own.iter().for_each(|(voxel, found)| add_voxel(&mut system, tube, voxels, *voxel, found));
            add_shape(&mut system, tube, ends[number].map(|end| end.hidden), voxels.mean_spacing());
            add_ends(&mut system, tube, &ends[number], voxels.mean_spacing());
            if let Some((partners, wall)) = beside {
                add_partner(&mut system, tube, &partners[number], wall, voxels.mean_spacing());
            }
            take_step(tube, system, voxels.mean_spacing())
        };
        let change = tubes.par_iter_mut().zip(&of_tube).enumerate().map(step).reduce(|| 0.0, f64::max);
        if change < LAST_STEP {
            break;
        }
    }
    Ok(())
}

/// Moves a tube to where its system is solved, or towards it; returns the largest change of a centre or a radius that the system
/// asks for, in mean spacings.
fn take_step(tube: &mut Tube, system: BandedSystem, unit: f64) -> f64 {
    let mut largest = 0.0f64;
    let changes = system.solve();
    for (node, change) in tube.nodes.iter_mut().zip(changes.chunks_exact(UNKNOWNS)) {
        let (way, wider) = (DVec3::from_slice(change), change[UNKNOWNS - 1]);
        let wanted = way.length().max(wider.abs());
        let part = (LARGEST_STEP / wanted).min(1.0);
        node.center += part * unit * way;
        node.radius = (node.radius + part * unit * wider).max(LEAST_RADIUS * unit);
        largest = largest.max(wanted);
    }
    largest
}

/// The lack of depth of a voxel.
fn add_voxel(system: &mut BandedSystem, tube: &Tube, voxels: &BoundaryVoxels, voxel: usize, found: &Deepest) {
    let lack = voxels.lack(voxel, found.depth);
    let weight = (LINEAR / lack).min(1.0);
    let [a, b] = tube.segment(found.segment as usize);
    let outward = (voxels.place(voxel) - a.center.lerp(b.center, found.part)).normalize_or_zero();
    // The depth grows when the axis comes nearer and when the radius grows; moving along the axis changes nothing.
    let slope = [outward.x, outward.y, outward.z, 1.0].map(|s| voxels.side(voxel) * s);
    let first = UNKNOWNS * found.segment as usize;
    let mut row = [(0, 0.0); 2 * UNKNOWNS];
    for d in 0..UNKNOWNS {
        row[d] = (first + d, (1.0 - found.part) * slope[d]);
        row[UNKNOWNS + d] = (first + UNKNOWNS + d, found.part * slope[d]);
    }
    let used = if tube.nodes.len() > 1 { 2 * UNKNOWNS } else { UNKNOWNS };
    system.add(&row[..used], weight, lack);
}

/// The bending of axis and radius, the slope of the radius, the lengths of segments, and the damping; at each end so many nodes
/// are `hidden`.
fn add_shape(system: &mut BandedSystem, tube: &Tube, hidden: [usize; 2], unit: f64) {
    let nodes = &tube.nodes;
    let mean = (tube.length() / unit / nodes.len().max(2).saturating_sub(1) as f64).max(LEAST_SEGMENT);
    let robust = |ratio: f64| 1.0 / (1.0 + ratio * ratio);
    for (n, three) in nodes.windows(3).enumerate() {
        let row = |d: usize| [(0, 1.0), (1, -2.0), (2, 1.0)].map(|(node, x)| (UNKNOWNS * (n + node) + d, x));
        let bend = (three[0].center - 2.0 * three[1].center + three[2].center) / unit;
        let may_kink = n + 1 > hidden[0] && nodes.len() > hidden[1] + n + 2;
        let share = if may_kink { robust(bend.length() / mean / KINK) } else { 1.0 };
        let weight = AXIS_BENDING / mean.powi(3) * share;
        (0..3).for_each(|d| system.add(&row(d), weight, -bend[d]));
        let bend = (three[0].radius - 2.0 * three[1].radius + three[2].radius) / unit;
        system.add(&row(3), RADIUS_BENDING / mean.powi(3) * robust(bend / RADIUS_KINK), -bend);
    }
    for (n, two) in nodes.windows(2).enumerate() {
        let [first, second] = [UNKNOWNS * n, UNKNOWNS * (n + 1)];
        let slope = (two[1].radius - two[0].radius) / unit;
        let row = [(first + 3, -1.0), (second + 3, 1.0)];
        system.add(&row, RADIUS_SLOPE / mean * robust(slope / RADIUS_KINK), -slope);
        let way = (two[1].center - two[0].center) / unit;
        let along = way.normalize_or_zero();
        let row: [(usize, f64); 6] =
            std::array::from_fn(|d| if d < 3 { (first + d, -along[d]) } else { (second + d - 3, along[d - 3]) });
        system.add(&row, EVENNESS, mean - way.length());
    }
    (0..UNKNOWNS * nodes.len()).for_each(|unknown| system.add(&[(unknown, 1.0)], DAMPING, 0.0));
}

/// What an end of a tube is drawn to.
#[derive(Debug, Clone, Copy, Default)]
struct EndTarget {
    /// Where the ends that meet there are in the mean.
    meeting: Option<DVec3>,
    /// The nearest place on the axis of the tube that it lies in, and the radius there.
    within: Option<TubeNode>,
    /// How many nodes from the end on are within that tube or near it.
    hidden: usize,
}

/// For each tube what its ends are drawn to.
fn ends_of(tubes: &[Tube], joints: &[Joint], unit: f64) -> Vec<[EndTarget; 2]> {
    let hosts = Hosts::new(tubes);
    let of_tube = |number: usize| [false, true].map(|is_last| end_within(&hosts, number, is_last, unit));
    let mut ends: Vec<[EndTarget; 2]> = (0..tubes.len()).into_par_iter().map(of_tube).collect();
    for joint in joints {
        let place = place_of(joint, tubes);
        for end in joint {
            let target = &mut ends[end.tube][usize::from(end.is_last)];
            *target = EndTarget { meeting: Some(place), within: None, ..*target };
        }
    }
    ends
}

/// The tube that an end lies deepest in, if it lies in one.
fn end_within(hosts: &Hosts, number: usize, is_last: bool, unit: f64) -> EndTarget {
    let nodes = &hosts.tubes[number].nodes;
    if nodes.len() < 2 {
        return EndTarget::default();
    }
    let from_end = |n: usize| nodes[if is_last { nodes.len() - 1 - n } else { n }].center;
    let Some(found) = hosts.host_of(number, from_end(0), 0.0) else { return EndTarget::default() };
    let host = &hosts.tubes[found.tube];
    let is_hidden = |n: &usize| {
        let depth = |segment: usize| depth_in_segment(from_end(*n), &host.segment(segment)).0;
        (0..host.segment_count()).any(|segment| depth(segment) > -HIDDEN * unit)
    };
    let [a, b] = host.segment(found.segment);
    let hidden = (0..nodes.len()).take_while(is_hidden).count();
    EndTarget { meeting: None, within: Some(a.lerp(&b, found.part)), hidden }
}

/// A place on the axis of a tube.
#[derive(Debug, Clone, Copy)]
pub struct Place {
    /// Number of the tube.
    pub tube: usize,
    /// Its segment.
    pub segment: usize,
    /// Place along that, 0 to 1.
    pub part: f64,
}

/// Tubes that points may lie in, each with the box around its axis: most are far from a point.
pub struct Hosts<'a> {
    tubes: &'a [Tube],
    boxes: Vec<AxisBox>,
}

/// The box around the axis of a tube, mm, and the largest radius.
struct AxisBox {
    low: DVec3,
    high: DVec3,
    radius: f64,
}

impl AxisBox {
    fn of(tube: &Tube) -> Self {
        let first = tube.nodes[0];
        let start = Self { low: first.center, high: first.center, radius: first.radius };
        let add = |all: Self, node: &TubeNode| Self {
            low: all.low.min(node.center),
            high: all.high.max(node.center),
            radius: all.radius.max(node.radius),
        };
        tube.nodes.iter().fold(start, add)
    }

    /// A bound of the depth of a point in the tube, mm.
    fn largest_depth(&self, point: DVec3) -> f64 {
        self.radius - point.distance(point.clamp(self.low, self.high))
    }
}

impl<'a> Hosts<'a> {
    /// These tubes.
    pub fn new(tubes: &'a [Tube]) -> Self {
        Self { tubes, boxes: tubes.iter().map(AxisBox::of).collect() }
    }

    /// Where on the axes of the tubes but `number` a point belongs that is deeper than `least` (mm) in one, by the one it is deepest
    /// in.
    pub fn host_of(&self, number: usize, point: DVec3, least: f64) -> Option<Place> {
        let mut deepest = (least, None);
        for (tube, other) in self.tubes.iter().enumerate().filter(|(tube, _)| *tube != number) {
            if self.boxes[tube].largest_depth(point) <= deepest.0 {
                continue;
            }
            for segment in 0..other.segment_count() {
                let (depth, part) = depth_in_segment(point, &other.segment(segment));
                if depth > deepest.0 {
                    deepest = (depth, Some(Place { tube, segment, part }));
                }
            }
        }
        deepest.1
    }
}

/// The distances of the ends from what they are drawn to, and the radii that are larger than there.
fn add_ends(system: &mut BandedSystem, tube: &Tube, ends: &[EndTarget; 2], unit: f64) {
    let mut draw = |n: usize, place: DVec3, weight: f64| {
        let gap = (place - tube.nodes[n].center) / unit;
        (0..3).for_each(|d| system.add(&[(UNKNOWNS * n + d, 1.0)], weight, gap[d]));
    };
    let numbers = [0, tube.nodes.len() - 1];
    for (n, end) in numbers.into_iter().zip(ends) {
        if let Some(place) = end.meeting {
            draw(n, place, MEETING);
        }
        if let Some(node) = end.within {
            draw(n, node.center, JOINT);
        }
    }
    for (n, end) in numbers.into_iter().zip(ends) {
        let wider = end.within.map_or(0.0, |node| (tube.nodes[n].radius - node.radius) / unit);
        if wider > 0.0 {
            system.add(&[(UNKNOWNS * n + 3, 1.0)], JOINT, -wider);
        }
    }
}

/// Median of what the nodes of partners are wider than those of tubes, mm; negative where the tubes are around these.
fn median_wall(tubes: &[Tube], partners: &[Tube]) -> f64 {
    let pairs = tubes.iter().zip(partners).flat_map(|(tube, partner)| tube.nodes.iter().zip(&partner.nodes));
    let mut walls: Vec<f64> = pairs.map(|(node, other)| other.radius - node.radius).collect();
    let middle = walls.len() / 2;
    if walls.is_empty() { 0.0 } else { *walls.select_nth_unstable_by(middle, f64::total_cmp).1 }
}

/// The distances of the nodes from those of a partner, and the differences of the walls between them from the median.
fn add_partner(system: &mut BandedSystem, tube: &Tube, partner: &Tube, wall: f64, unit: f64) {
    let robust = |square: f64| 1.0 / (1.0 + square / (PARTED * PARTED));
    for (n, (node, other)) in tube.nodes.iter().zip(&partner.nodes).enumerate() {
        let gap = (other.center - node.center) / unit;
        let weight = PARTNERSHIP * robust(gap.length_squared());
        (0..3).for_each(|d| system.add(&[(UNKNOWNS * n + d, 1.0)], weight, gap[d]));
        let gap = (other.radius - node.radius - wall) / unit;
        system.add(&[(UNKNOWNS * n + 3, 1.0)], WALL * robust(gap * gap), gap);
    }
}

const _: () = assert!(BANDWIDTH >= 3 * UNKNOWNS - 1, "second differences couple three nodes");

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::voxel_index::VoxelIndex;
    use crate::lattice::deepest_segments::MARGIN;
    use crate::lattice::test_images::{boundary_voxels, tube, tubes_depth};

    #[test]
    fn a_tube_that_starts_beside_a_vessel_finds_its_axis_radius_and_ends() {
        let [from, to, radius] = [DVec3::new(7.3, 8.1, 6.2), DVec3::new(11.9, 9.4, 20.7), DVec3::splat(1.9)];
        let exact = [tube(&[(from.to_array(), radius.x), (to.to_array(), radius.x)])];
        let voxels = boundary_voxels(27, DVec3::ONE, |p| tubes_depth(&exact, p) > 0.0);
        let start = |n: usize| {
            let at = from.lerp(to, 0.1 + 0.08 * n as f64) + DVec3::new(0.9, -0.6, 0.2);
            (at.to_array(), 1.1)
        };
        let fit = |threads: usize| {
            let context = RunContext::with_threads(threads).unwrap();
            let mut tubes = [tube(&(0..11).map(start).collect::<Vec<_>>())];
            context.install(|| fit_tubes(&mut tubes, &[], None, &voxels, 40, &context)).unwrap();
            tubes
        };
        let tubes = fit(1);
        for node in &tubes[0].nodes {
            let off = tubes_depth(&exact, node.center) - radius.x;
            // Measured 0.09 and 0.08 voxel.
            assert!(off.abs() < 0.15 && (node.radius - radius.x).abs() < 0.15, "{node:?} {off}");
        }
        let ends = [tubes[0].nodes[0].center, tubes[0].nodes[10].center];
        assert!(ends[0].distance(from) < 0.4 && ends[1].distance(to) < 0.4, "{ends:?}");
        assert_eq!(tubes, fit(3));
    }

    #[test]
    fn partners_hold_what_the_voxels_do_not_tell() {
        let outer = tube(&[([8.0, 8.0, 5.0], 4.0), ([8.0, 8.0, 10.0], 4.0), ([8.0, 8.0, 15.0], 4.0)]);
        let mut tubes = [tube(&[([8.2, 8.0, 5.3], 1.5), ([8.2, 8.0, 10.3], 1.5), ([8.2, 8.0, 15.3], 1.5)])];
        // No voxel has another side near.
        let voxels = boundary_voxels(20, DVec3::ONE, |p| p.distance(DVec3::new(8.0, 8.0, p.z)) < 1.5 && p.z > 100.0);
        let far = BoundaryVoxels { is_inside: vec![true; voxels.is_inside.len()], ..voxels };
        let inside: Vec<usize> = (0..far.voxels.len()).filter(|v| tubes_depth(&tubes, far.place(*v)) > 1.0).collect();
        let some: Vec<[i32; 3]> = inside.iter().map(|v| far.voxels[*v]).collect();
        let few = BoundaryVoxels {
            index: VoxelIndex::new(&some),
            is_inside: vec![true; some.len()],
            voxels: some,
            spacing: DVec3::ONE,
        };
        let context = RunContext::with_threads(1).unwrap();
        fit_tubes(&mut tubes, &[], Some(std::slice::from_ref(&outer)), &few, 40, &context).unwrap();
        for (node, other) in tubes[0].nodes.iter().zip(&outer.nodes) {
            assert!(node.center.distance(other.center) < 0.1, "{node:?}");
            assert!((node.radius - 1.5).abs() < 0.1, "{node:?}");
        }
    }

    #[test]
    fn a_lumen_that_nothing_tells_of_has_the_wall_of_the_others() {
        let rod = |x: f64, radii: [f64; 4]| {
            tube(&[5.0, 9.0, 13.0, 17.0].map(|z| ([x + 0.3, 8.4, z], radii[(z as usize - 5) / 4])))
        };
        let outer = [rod(8.0, [3.5; 4]), rod(22.0, [4.2; 4]), rod(36.0, [3.0; 4])];
        // The last one gets thinner and thinner, and voxels tell of the others only.
        let mut tubes = [rod(8.0, [2.0; 4]), rod(22.0, [2.7; 4]), rod(36.0, [1.45, 1.35, 1.25, 1.15])];
        let voxels = boundary_voxels(30, DVec3::ONE, |p| tubes_depth(&tubes[..2], p) > 0.0);
        let context = RunContext::with_threads(1).unwrap();
        fit_tubes(&mut tubes, &[], Some(&outer), &voxels, 40, &context).unwrap();
        for node in &tubes[2].nodes {
            // It begins up to 0.35 off.
            assert!((node.radius - 1.5).abs() < 0.1, "{node:?}");
        }
    }

    #[test]
    fn an_end_within_another_tube_comes_to_its_axis_and_is_no_wider() {
        let trunk = tube(&[([8.0, 8.0, 2.0], 2.0), ([8.0, 8.0, 9.0], 2.0), ([8.0, 8.0, 16.0], 2.0)]);
        let branch = tube(&[([16.0, 8.0, 9.0], 1.5), ([12.0, 8.0, 9.0], 1.5), ([7.0, 8.6, 9.0], 2.6)]);
        // One voxel, deep enough within the trunk to pull nothing.
        let deep = vec![[8, 8, 4]];
        let voxels =
            BoundaryVoxels { index: VoxelIndex::new(&deep), is_inside: vec![true], voxels: deep, spacing: DVec3::ONE };
        let mut tubes = [trunk.clone(), branch];
        fit_tubes(&mut tubes, &[], None, &voxels, 40, &RunContext::with_threads(1).unwrap()).unwrap();
        let [.., tip, end] = &tubes[1].nodes[..] else { panic!("three nodes") };
        let off_axis = (end.center - DVec3::new(8.0, 8.0, end.center.z)).length();
        assert!(off_axis < 0.3 && end.radius < 2.3, "{end:?}");
        assert!(tip.center.x > 10.0 && tubes[0].nodes[0].center.distance(trunk.nodes[0].center) < 0.5);
    }

    #[test]
    fn the_host_of_a_point_is_the_tube_that_it_is_deepest_in() {
        let rod = |n: i32| {
            let at = |x: i32| [f64::from(x), f64::from((n * 7 + x) % 5), f64::from(n)];
            tube(&[(at(0), 1.5), (at(3), 1.1), (at(7), 0.6 + 0.1 * f64::from(n))])
        };
        let tubes: Vec<Tube> = (0..9).map(rod).collect();
        let hosts = Hosts::new(&tubes);
        let (mut within, mut outside) = (0, 0);
        for n in 0..1000 {
            let point = DVec3::new(f64::from(n % 10), f64::from(n / 10 % 10), f64::from(n / 100)) - 0.7;
            let number = n as usize % 9;
            let others: Vec<Tube> = (0..9).filter(|t| *t != number).map(|t| tubes[t].clone()).collect();
            let deepest = tubes_depth(&others, point);
            match hosts.host_of(number, point, -0.4) {
                Some(Place { tube, segment, part }) => {
                    assert!(tube != number && (0.0..=1.0).contains(&part));
                    assert_eq!(depth_in_segment(point, &tubes[tube].segment(segment)), (deepest, part));
                    within += 1;
                }
                None => {
                    assert!(deepest <= -0.4);
                    outside += 1;
                }
            }
        }
        assert!(within > 100 && outside > 100, "{within} {outside}");
    }

    #[test]
    fn voxels_far_from_all_tubes_lack_no_more_than_a_bound() {
        let tubes = [tube(&[([3.0, 3.0, 3.0], 1.5)])];
        let voxels = boundary_voxels(40, DVec3::ONE, |p| p.distance(DVec3::splat(30.0)) < 1.2);
        let loss = voxels.loss(&tubes);
        let lack = MARGIN + LARGEST_LACK;
        assert!(loss.is_finite() && loss >= 7.0 * LINEAR * (2.0 * lack - LINEAR), "{loss}");
    }
}
