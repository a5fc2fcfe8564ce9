//! Lines in the middle of a solid of voxels: from its tips along the middle of its branches, each until it meets another.
//!
//! # Method
//! For each component of the solid (26 neighbours):
//! 1. The voxel farthest from the boundary is its root. From the tip of a branch the way to that of the next one would go right across
//!    the crotch where the voxels of both touch.
//! 2. Shortest ways from the root to all voxels, where a step costs the more the nearer the boundary is: they keep to the
//!    middle.
//! 3. The voxel farthest from the root that no line has covered is a tip: the way from it is followed towards the root until
//!    it enters the balls around a line, as wide as the solid there: in a wide vessel two ways may run side by side. What is near that
//!    line is covered. This is repeated until nothing is left.
//! 4. Each line becomes a tube: nodes at equal steps, each with the mean place and radius around it. At a tip it begins as far
//!    inside as the tube is wide: there its end is round.
//! ```text
//!        tip                                 tip
//!          \      /  tip                       o      o
//!           \    /                              \    /
//!            \  /              ->                o  o            three tips, the root in the widest branch: two tubes
//!             |/                                 |/              end where they meet the third or the root
//!          root                                  o
//!             |                                  |
//!            tip                                 o
//! ```
//!
//! # Source
//! [Sato2000].
//!
//! # Invariants
//! Every component of [`LEAST_VOXELS`] voxels has a tube, and every tube a node. The order of work is fixed.
//!
//! # Cost
//! Three searches of shortest ways over the voxels of the solid. Sequential within a solid.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use glam::DVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::voxel_index::VoxelIndex;

/// Components of fewer voxels have no tube.
pub const LEAST_VOXELS: usize = 8;

/// Power of the inverse radius that a step costs: with 1 lines cut corners, with 3 they are as with 2.
const COST_POWER: i32 = 2;

/// What a line covers: this many radii and this many voxels around it.
const COVERED_RADII: f64 = 1.2;
const COVERED_VOXELS: f64 = 1.0;

/// How much farther the balls around a line reach than its voxels are from the boundary, in voxels: lines go beside the axis. In
/// vessels of 1.5 voxels radius two may run side by side for as long as a whole vessel without. Of 37 trees of vessels the fitted
/// tubes are off by more than 0.3 voxel at 30 places with 0, 15 with 0.3, 16 with 0.5.
const WITHIN_VOXELS: f64 = 0.3;

/// How far from its tip a tube begins, in its median radii.
const TIP_RADII: f64 = 0.8;

/// Distance of nodes, in voxels and in median radii: nodes of a thick tube that are nearer have nothing to tell apart.
const STEP_VOXELS: f64 = 1.5;
const STEP_RADII: f64 = 0.6;

/// Voxels between two looks at the cancellation.
const CHUNK: usize = 1 << 16;

/// No voxel, no line.
const NONE: u32 = u32::MAX;

/// Voxels that make a solid; they may continue it past the border of the image.
#[derive(Debug, Clone, Default)]
pub struct Solid {
    /// The voxels, in order.
    pub voxels: Vec<[i32; 3]>,
    /// Numbers of the voxels.
    pub index: VoxelIndex,
    /// Distance of each voxel's centre to the boundary, mm, at least half a voxel.
    pub radii: Vec<f32>,
    /// Millimetres between voxels.
    pub spacing: DVec3,
}

/// A place on the axis of a tube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TubeNode {
    /// Place, mm from voxel 0 0 0.
    pub center: DVec3,
    /// Distance to the surface, mm.
    pub radius: f64,
}

impl TubeNode {
    /// The node a part of the way, 0 to 1, to another one.
    pub fn lerp(&self, to: &Self, part: f64) -> Self {
        Self { center: self.center.lerp(to.center, part), radius: self.radius + part * (to.radius - self.radius) }
    }
}

/// What balls sweep over that go from node to node, their radii changing linearly.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tube {
    /// The nodes, at least one.
    pub nodes: Vec<TubeNode>,
}

impl Tube {
    /// Number of segments; a single node is one.
    pub fn segment_count(&self) -> usize {
        (self.nodes.len() - 1).max(1)
    }

    /// The nodes at both ends of a segment.
    pub fn segment(&self, number: usize) -> [TubeNode; 2] {
        [self.nodes[number], self.nodes[(number + 1).min(self.nodes.len() - 1)]]
    }

    /// Length of the axis, mm.
    pub fn length(&self) -> f64 {
        self.nodes.windows(2).map(|pair| pair[0].center.distance(pair[1].center)).sum()
    }
}

impl Solid {
    /// Mean of the spacings, mm.
    pub fn mean_spacing(&self) -> f64 {
        self.spacing.element_sum() / 3.0
    }

    fn place(&self, voxel: usize) -> DVec3 {
        DVec3::from_array(self.voxels[voxel].map(f64::from)) * self.spacing
    }

    fn radius(&self, voxel: usize) -> f64 {
        f64::from(self.radii[voxel])
    }
}

/// Tubes along the middle of a solid.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn centerlines(solid: &Solid, context: &RunContext) -> Result<Vec<Tube>> {
    let mut ways = Ways::new(solid);
    let mut lines = Lines { is_within: vec![false; solid.voxels.len()], is_covered: vec![false; solid.voxels.len()] };
    let mut is_seen = vec![false; solid.voxels.len()];
    let mut tubes = Vec::new();
    let unit = solid.mean_spacing();
    for first in 0..solid.voxels.len() {
        if is_seen[first] {
            continue;
        }
        let members = ways.search(first, |_| 1.0, context)?;
        members.iter().for_each(|v| is_seen[*v as usize] = true);
        ways.forget(&members);
        if members.len() < LEAST_VOXELS {
            continue;
        }
        let is_wider = |l: &u32, r: &u32| solid.radii[*l as usize].total_cmp(&solid.radii[*r as usize]).then(r.cmp(l));
        let root = members.iter().copied().max_by(is_wider).unwrap_or(members[0]) as usize;
        let near_first = ways.search(root, |_| 1.0, context)?;
        ways.forget(&near_first);
        let cost = |v: usize| (unit / solid.radius(v)).powi(COST_POWER);
        let reached = ways.search(root, cost, context)?;
        for tip in near_first.iter().rev() {
            if !lines.is_covered[*tip as usize] {
                let line = lines.follow(*tip, &ways.before);
                lines.cover(solid, &line);
                tubes.push(tube_along(solid, &line));
            }
        }
        ways.forget(&reached);
    }
    Ok(tubes)
}

/// Which voxels are in the balls around lines, and which are near one.
struct Lines {
    is_within: Vec<bool>,
    is_covered: Vec<bool>,
}

impl Lines {
    /// The voxels from a tip towards the root, up to the first within another line.
    fn follow(&self, tip: u32, before: &[u32]) -> Vec<u32> {
        let mut line = vec![tip];
        loop {
            let next = before[line[line.len() - 1] as usize];
            if next == NONE {
                return line;
            }
            line.push(next);
            if self.is_within[next as usize] {
                return line;
            }
        }
    }

    fn cover(&mut self, solid: &Solid, line: &[u32]) {
        for voxel in line {
            let center = solid.place(*voxel as usize);
            let radius = solid.radius(*voxel as usize);
            let reach = COVERED_RADII * radius + COVERED_VOXELS * solid.mean_spacing();
            let at = solid.voxels[*voxel as usize];
            let steps = (DVec3::splat(reach) / solid.spacing).ceil().as_ivec3().to_array();
            for k in at[2] - steps[2]..=at[2] + steps[2] {
                for j in at[1] - steps[1]..=at[1] + steps[1] {
                    for i in at[0] - steps[0]..=at[0] + steps[0] {
                        let Some(near) = solid.index.get([i, j, k]) else { continue };
                        let distance = solid.place(near).distance(center);
                        self.is_covered[near] |= distance <= reach;
                        self.is_within[near] |= distance <= radius + WITHIN_VOXELS * solid.mean_spacing();
                    }
                }
            }
        }
    }
}

/// Shortest ways within a solid.
struct Ways<'a> {
    solid: &'a Solid,
    steps: Vec<([i32; 3], f64)>,
    /// Cost of the way to each voxel; infinite where there is none yet.
    far: Vec<f32>,
    /// The voxel before each on its way.
    before: Vec<u32>,
}

impl<'a> Ways<'a> {
    fn new(solid: &'a Solid) -> Self {
        let steps = (0..27).filter(|n| *n != 13).map(|n| {
            let step = [n % 3 - 1, n / 3 % 3 - 1, n / 9 - 1];
            (step, (DVec3::from_array(step.map(f64::from)) * solid.spacing).length())
        });
        let count = solid.voxels.len();
        Self { solid, steps: steps.collect(), far: vec![f32::INFINITY; count], before: vec![NONE; count] }
    }

    /// Shortest ways from a voxel; `cost` is that of a millimetre. Returns what was reached, the nearest first.
    fn search(&mut self, root: usize, cost: impl Fn(usize) -> f64, context: &RunContext) -> Result<Vec<u32>> {
        let mut reached = Vec::new();
        let mut queue = BinaryHeap::new();
        self.far[root] = 0.0;
        // The bits of positive numbers are ordered as they are.
        queue.push(Reverse((0u32, root as u32)));
        while let Some(Reverse((bits, voxel))) = queue.pop() {
            let v = voxel as usize;
            if f32::from_bits(bits) > self.far[v] {
                continue;
            }
            context.check_every(CHUNK, reached.len())?;
            reached.push(voxel);
            let (at, own) = (self.solid.voxels[v], cost(v));
            for (step, length) in &self.steps {
                let Some(next) = self.solid.index.get(std::array::from_fn(|d| at[d] + step[d])) else { continue };
                let way = self.far[v] + (length * 0.5 * (own + cost(next))) as f32;
                if way < self.far[next] {
                    self.far[next] = way;
                    self.before[next] = voxel;
                    queue.push(Reverse((way.to_bits(), next as u32)));
                }
            }
        }
        Ok(reached)
    }

    fn forget(&mut self, reached: &[u32]) {
        for voxel in reached {
            self.far[*voxel as usize] = f32::INFINITY;
            self.before[*voxel as usize] = NONE;
        }
    }
}

/// The tube along a line of voxels from a tip.
fn tube_along(solid: &Solid, line: &[u32]) -> Tube {
    let mut radii: Vec<f64> = line.iter().map(|v| solid.radius(*v as usize)).collect();
    radii.sort_unstable_by(f64::total_cmp);
    let (median, unit) = (radii[radii.len() / 2], solid.mean_spacing());
    let nodes: Vec<TubeNode> =
        line.iter().map(|v| TubeNode { center: solid.place(*v as usize), radius: solid.radius(*v as usize) }).collect();
    let is_tip = |n: &&TubeNode| nodes[0].center.distance(n.center) < TIP_RADII * median;
    let mut first = nodes.iter().take_while(is_tip).count();
    let mut last = nodes.len();
    if first >= last {
        // As long as it is wide: one ball in its middle.
        first = nodes.len() / 2;
        last = first + 1;
    }
    let nodes = &nodes[first..last];
    let mut along = vec![0.0];
    for pair in nodes.windows(2) {
        along.push(along[along.len() - 1] + pair[0].center.distance(pair[1].center));
    }
    let total = along[along.len() - 1];
    let step = (STEP_VOXELS * unit).max(STEP_RADII * median);
    let count = (total / step).round();
    let node_at = |n: usize| {
        let at = if count > 0.0 { total * n as f64 / count } else { total / 2.0 };
        mean_node(nodes, &along, at, step.min(at.min(total - at) + unit))
    };
    Tube { nodes: (0..=count as usize).map(node_at).collect() }
}

/// Mean of the nodes within `reach` (mm) of a place along a line, the nearer the more.
fn mean_node(nodes: &[TubeNode], along: &[f64], at: f64, reach: f64) -> TubeNode {
    let (mut center, mut radius, mut total) = (DVec3::ZERO, 0.0, 0.0);
    for (node, place) in nodes.iter().zip(along) {
        let weight = (1.0 - (place - at).abs() / reach).max(0.0);
        center += weight * node.center;
        radius += weight * node.radius;
        total += weight;
    }
    if total > 0.0 {
        return TubeNode { center: center / total, radius: radius / total };
    }
    // Between two voxels of a long diagonal.
    let nearest = (0..nodes.len()).min_by(|l, r| (along[*l] - at).abs().total_cmp(&(along[*r] - at).abs()));
    nodes[nearest.unwrap_or(0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The voxels of a box where `depth` (mm) is positive, which is their radius too.
    fn solid(size: i32, spacing: DVec3, depth: impl Fn(DVec3) -> f64) -> Solid {
        let place = |at: &[i32; 3]| DVec3::from_array(at.map(f64::from)) * spacing;
        let all = (0..size * size * size).map(|n| [n % size, n / size % size, n / size / size]);
        let voxels: Vec<[i32; 3]> = all.filter(|at| depth(place(at)) > 0.0).collect();
        let radii = voxels.iter().map(|at| depth(place(at)).max(0.5) as f32).collect();
        Solid { index: VoxelIndex::new(&voxels), radii, voxels, spacing }
    }

    /// How far within a ball that goes from `a` to `b`.
    fn within(point: DVec3, a: DVec3, b: DVec3, radius: f64) -> f64 {
        let part = ((point - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0);
        radius - point.distance(a.lerp(b, part))
    }

    #[test]
    fn a_fork_has_two_tubes_that_meet_in_its_middle() {
        let [foot, fork] = [DVec3::new(12.0, 12.0, 4.0), DVec3::new(12.2, 11.7, 14.0)];
        let ends = [DVec3::new(5.0, 11.0, 24.0), DVec3::new(19.0, 13.0, 25.0)];
        let depth =
            |p: DVec3| ends.iter().map(|end| within(p, fork, *end, 2.0)).fold(within(p, foot, fork, 2.6), f64::max);
        let solid = solid(30, DVec3::ONE, depth);
        let context = RunContext::with_threads(1).unwrap();
        let tubes = centerlines(&solid, &context).unwrap();
        assert_eq!(tubes.len(), 2);
        let joint = tubes[1].nodes[tubes[1].nodes.len() - 1].center;
        assert!(joint.distance(fork) < 4.0, "{joint}");
        for node in tubes.iter().flat_map(|t| &t.nodes) {
            // In the middle: as deep as the radius of the vessel, nearly.
            assert!(depth(node.center) > 1.0, "{node:?} {}", depth(node.center));
        }
        // The long one goes from an end to the other or to the foot.
        let length = tubes[0].length();
        assert!(length > 15.0 && length < 26.0, "{length}");
        assert_eq!(tubes, centerlines(&solid, &context).unwrap());
    }

    #[test]
    fn a_line_ends_where_it_enters_another_one() {
        // The root is in the foot: the ways from both branches run through half of that.
        let [foot, fork] = [DVec3::new(13.0, 13.0, 6.0), DVec3::new(13.2, 12.6, 20.0)];
        let ends = [DVec3::new(5.0, 12.0, 44.0), DVec3::new(22.0, 14.0, 36.0)];
        let depth =
            |p: DVec3| ends.iter().map(|end| within(p, fork, *end, 4.2)).fold(within(p, foot, fork, 5.2), f64::max);
        let tubes = centerlines(&solid(50, DVec3::ONE, depth), &RunContext::with_threads(1).unwrap()).unwrap();
        assert_eq!(tubes.len(), 2);
        let is_within = |node: &&TubeNode| {
            let nearest = tubes[0].nodes.iter().map(|other| other.center.distance(node.center));
            nearest.fold(f64::MAX, f64::min) < 0.7 * node.radius
        };
        let within = tubes[1].nodes.iter().filter(is_within).count();
        // 2 where lines end at the first voxel that both have.
        assert!(within <= 1, "{within} {tubes:?}");
    }

    #[test]
    fn in_thin_vessels_lines_do_not_run_side_by_side() {
        let mut beside = 0;
        for turn in 0..24 {
            let angle = 0.26 * f64::from(turn);
            let fork = DVec3::new(12.0 + 0.3 * angle.sin(), 12.0 + 0.3 * angle.cos(), 15.0 + 0.1 * angle);
            let end = |angle: f64| fork + DVec3::new(7.0 * angle.cos(), 7.0 * angle.sin(), 8.0);
            let foot = DVec3::new(fork.x + angle.cos(), fork.y + 1.0, 3.0);
            let ends = [end(angle), end(angle + 2.6)];
            let depth =
                |p: DVec3| ends.iter().map(|end| within(p, fork, *end, 1.3)).fold(within(p, foot, fork, 1.5), f64::max);
            let tubes = centerlines(&solid(30, DVec3::ONE, depth), &RunContext::with_threads(1).unwrap()).unwrap();
            for (at, tube) in tubes.iter().enumerate() {
                let segments = || tubes[..at].iter().flat_map(|t| t.nodes.windows(2));
                let depth =
                    |p: DVec3| segments().map(|s| within(p, s[0].center, s[1].center, 1.0)).fold(f64::MIN, f64::max);
                beside += tube.nodes.iter().filter(|node| depth(node.center) > 0.0).count();
            }
        }
        // Nodes within 1 mm of another line, in all forks: 17; 29 without `WITHIN_VOXELS`.
        assert!(beside <= 20, "{beside}");
    }

    #[test]
    fn each_component_has_a_tube_and_specks_have_none() {
        let spacing = DVec3::new(0.8, 0.8, 1.5);
        let bars = [6.0, 14.0].map(|x| [DVec3::new(x, 8.0, 6.0), DVec3::new(x, 9.0, 27.0)]);
        let ball = DVec3::new(20.0, 20.0, 30.0);
        let speck = DVec3::new(3.2, 20.0, 30.0);
        let depth = |p: DVec3| {
            let bars = bars.iter().map(|[a, b]| within(p, *a, *b, 2.0)).fold(f64::NEG_INFINITY, f64::max);
            bars.max(3.0 - p.distance(ball)).max(0.5 - p.distance(speck))
        };
        let tubes = centerlines(&solid(30, spacing, depth), &RunContext::with_threads(1).unwrap()).unwrap();
        assert_eq!(tubes.len(), 3, "{tubes:?}");
        let of_ball = tubes.iter().find(|t| t.nodes[0].center.distance(ball) < 4.0).unwrap();
        // Half of its diameter: its ends are round.
        assert!(of_ball.length() < 6.0, "{of_ball:?}");
    }
}
