//! The segment of the tubes that each voxel near a boundary is deepest in, also while their nodes move.
//!
//! # Method
//! Voxels are compared block by block ([`VoxelIndex`]) with the segments that reach into their block. Those in which a voxel is
//! deepest, or may be after nodes have moved a little, are kept. A block is looked at again once a segment near it has moved by
//! more: most tubes are soon where they belong, while single ones still slide.
//!
//! # Invariants
//! Segments of which the nodes have moved and become wider together by at most [`LARGEST_MOVE`] since the last look are all found.
//! The order of what is found, and the values, do not depend on the number of threads.
//!
//! # Cost
//! The first look compares each voxel with the segments around its block, later ones do so near what has moved. Parallel over
//! segments and over blocks.

use glam::DVec3;
use rayon::prelude::*;

use crate::image::voxel_index::{BLOCK, VoxelIndex};
use crate::lattice::centerlines::{Tube, TubeNode};

/// Depth that each voxel ought to have on its side, in mean spacings. With more there are more voxels outside of a thin tube than
/// within that push. Of 16 vessel trees the tubes are off by more than 0.3 voxel at 35 places with 0.5, 23 with this, 30 with 0.3.
pub const MARGIN: f64 = 0.4;

/// How far nodes may have moved and become wider together, in mean spacings, until the blocks around are looked at again.
pub const LARGEST_MOVE: f64 = 0.5;

/// Largest change of the place, and of the radius, of a node between two updates, in mean spacings.
pub const LARGEST_STEP: f64 = 0.7;

/// How far outside of a segment voxels that may lack depth are compared with it, in mean spacings.
const REACH: f64 = 3.0;

/// How far outside all voxels are, in mean spacings: those two steps from a boundary lie up to 3.5 voxels from it.
const LONG_REACH: f64 = 5.0;

/// Blocks per task, where one costs little.
const BLOCKS_PER_TASK: usize = 64;

/// No tube.
const NONE: u32 = u32::MAX;

/// Voxels near the boundary of a solid, in order.
#[derive(Debug, Clone)]
pub struct BoundaryVoxels {
    /// Places in the image.
    pub voxels: Vec<[i32; 3]>,
    /// Numbers of the voxels.
    pub index: VoxelIndex,
    /// Whether each is inside of the solid.
    pub is_inside: Vec<bool>,
    /// Millimetres between voxels.
    pub spacing: DVec3,
}

/// Where a voxel is deepest in the tubes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deepest {
    /// Depth, mm; negative outside, minus infinity where no tube is near.
    pub depth: f64,
    /// Number of the tube.
    pub tube: u32,
    /// Number of the segment in its tube.
    pub segment: u32,
    /// Place along the segment, 0 to 1.
    pub part: f64,
}

/// A segment of a tube, and its number there.
#[derive(Debug, Clone, Copy)]
pub struct Segment {
    ends: [TubeNode; 2],
    tube: u32,
    segment: u32,
}

/// The segments of all tubes, in order.
pub fn segments_of(tubes: &[Tube]) -> Vec<Segment> {
    let of_tube = |(tube, of): (usize, &Tube)| {
        let segment = |n: usize, ends: [TubeNode; 2]| Segment { ends, tube: tube as u32, segment: n as u32 };
        (0..of.segment_count()).map(|n| segment(n, of.segment(n))).collect::<Vec<_>>()
    };
    tubes.iter().enumerate().flat_map(of_tube).collect()
}

/// Depth of a point in a segment, mm, and the place along it that it belongs to.
pub fn depth_in_segment(point: DVec3, [a, b]: &[TubeNode; 2]) -> (f64, f64) {
    let way = b.center - a.center;
    let square = way.length_squared();
    let part = if square > 0.0 { ((point - a.center).dot(way) / square).clamp(0.0, 1.0) } else { 0.0 };
    (a.radius + part * (b.radius - a.radius) - (point - a.center - way * part).length(), part)
}

impl Deepest {
    /// Near no tube.
    const NOWHERE: Self = Self { depth: f64::NEG_INFINITY, tube: NONE, segment: 0, part: 0.0 };

    /// Number of the segment where those of each tube begin at `first`; 0 where no tube is near.
    pub fn segment_of_all(&self, first: &[u32]) -> u32 {
        first.get(self.tube as usize).map_or(0, |first| first + self.segment)
    }

    /// Puts the depth of a point in a segment in its place where it is deeper in that.
    fn compare(&mut self, point: DVec3, segment: &Segment) {
        let (depth, part) = depth_in_segment(point, &segment.ends);
        if depth > self.depth {
            *self = Self { depth, tube: segment.tube, segment: segment.segment, part };
        }
    }
}

impl BoundaryVoxels {
    /// Mean of the spacings, mm.
    pub fn mean_spacing(&self) -> f64 {
        self.spacing.element_sum() / 3.0
    }

    /// Place of a voxel's centre, mm from voxel 0 0 0.
    pub fn place(&self, voxel: usize) -> DVec3 {
        DVec3::from_array(self.voxels[voxel].map(f64::from)) * self.spacing
    }

    /// 1 inside of the solid, -1 outside.
    pub fn side(&self, voxel: usize) -> f64 {
        if self.is_inside[voxel] { 1.0 } else { -1.0 }
    }

    /// What each voxel lacks to the margin on its side, mean spacings, 0 at least.
    pub fn lack(&self, voxel: usize, depth: f64) -> f64 {
        (MARGIN - self.side(voxel) * depth / self.mean_spacing()).max(0.0)
    }

    /// Where each voxel is deepest in some tubes.
    pub fn deepest(&self, tubes: &[Tube]) -> Vec<Deepest> {
        let segments = segments_of(tubes);
        let near = self.segments_near_blocks(&segments, LONG_REACH, |_| true);
        let of_block = |pairs: &[BlockSegment]| {
            let compare = |voxel: usize| {
                let (place, mut deepest) = (self.place(voxel), Deepest::NOWHERE);
                pairs.iter().for_each(|pair| deepest.compare(place, &segments[pair.segment as usize]));
                (voxel, deepest)
            };
            self.index.voxels_of(pairs[0].block as usize).map(compare).collect::<Vec<_>>()
        };
        let blocks: Vec<&[BlockSegment]> = of_blocks(&near).collect();
        let all: Vec<(usize, Deepest)> = blocks.into_par_iter().flat_map_iter(of_block).collect();
        let mut found = vec![Deepest::NOWHERE; self.voxels.len()];
        all.into_iter().for_each(|(voxel, deepest)| found[voxel] = deepest);
        found
    }

    /// The blocks that segments reach into by `reach` mean spacings, of those that are wanted, with the numbers of these, in order.
    fn segments_near_blocks(
        &self,
        segments: &[Segment],
        reach: f64,
        is_wanted: impl Fn(usize) -> bool + Sync,
    ) -> Vec<BlockSegment> {
        let of_segment = |(number, segment): (usize, &Segment)| {
            let blocks = self.blocks_near(segment, reach).filter(|block| is_wanted(*block));
            blocks.map(|block| BlockSegment { block: block as u32, segment: number as u32 }).collect::<Vec<_>>()
        };
        let mut near: Vec<BlockSegment> = segments.par_iter().enumerate().flat_map_iter(of_segment).collect();
        near.par_sort_unstable();
        near
    }

    /// The blocks that a segment, wider by `reach` mean spacings, may have voxels in.
    fn blocks_near(&self, Segment { ends: [a, b], .. }: &Segment, reach: f64) -> impl Iterator<Item = usize> {
        let reach = a.radius.max(b.radius) + reach * self.mean_spacing();
        let low = ((a.center.min(b.center) - reach) / self.spacing).ceil().as_ivec3();
        let high = ((a.center.max(b.center) + reach) / self.spacing).floor().as_ivec3();
        let half = 0.5 * f64::from(BLOCK - 1);
        let axis = [*a, *b].map(|node| TubeNode { radius: 0.0, ..node });
        let is_near = move |(_, corner): &(usize, [i32; 3])| {
            let center = (DVec3::from_array(corner.map(f64::from)) + half) * self.spacing;
            -depth_in_segment(center, &axis).0 <= reach + half * self.spacing.length()
        };
        self.index.blocks_between(low.to_array(), high.to_array()).filter(is_near).map(|(block, _)| block)
    }
}

/// A block of voxels and the number of a segment that reaches into it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct BlockSegment {
    block: u32,
    segment: u32,
}

/// Those of each block.
fn of_blocks(near: &[BlockSegment]) -> impl Iterator<Item = &[BlockSegment]> {
    near.chunk_by(|l, r| l.block == r.block)
}

/// A voxel and the number of a segment near it.
#[derive(Debug, Clone, Copy)]
struct NearSegment {
    voxel: u32,
    number: u32,
}

/// For the voxels that may lack depth on their side the segments that they may be deepest in.
#[derive(Debug, Clone, Default)]
pub struct NearSegments {
    /// Those of each block, the voxels in order.
    of_block: Vec<Vec<NearSegment>>,
    /// The segments at the last update.
    segments: Vec<Segment>,
    /// How far each has moved since the blocks around were looked at, mean spacings.
    moved: Vec<f64>,
}

impl NearSegments {
    /// Follows the segments, which are the same ones at each call; none has moved by more than [`LARGEST_STEP`] since the last one.
    pub fn update(&mut self, voxels: &BoundaryVoxels, segments: Vec<Segment>) {
        let unit = voxels.mean_spacing();
        let is_first = self.segments.is_empty();
        let mut is_stale = vec![is_first; voxels.index.block_count()];
        if is_first {
            self.of_block = vec![Vec::new(); is_stale.len()];
            self.moved = vec![0.0; segments.len()];
        }
        for (n, (before, now)) in self.segments.iter().zip(&segments).enumerate() {
            self.moved[n] += before.change_to(now) / unit;
            if self.moved[n] > LARGEST_MOVE {
                // Also where it was at the last look.
                let reach = REACH + LARGEST_MOVE + 2.0 * LARGEST_STEP;
                voxels.blocks_near(now, reach).for_each(|block| is_stale[block] = true);
                self.moved[n] = 0.0;
            }
        }
        let near = voxels.segments_near_blocks(&segments, REACH, |block| is_stale[block]);
        let stale = self.of_block.iter_mut().zip(is_stale).filter(|(_, is_stale)| *is_stale);
        stale.for_each(|(of_block, _)| of_block.clear());
        let blocks: Vec<&[BlockSegment]> = of_blocks(&near).collect();
        let of_block = |pairs: &&[BlockSegment]| near_voxels(voxels, &segments, pairs);
        let found: Vec<Vec<NearSegment>> = blocks.par_iter().map(of_block).collect();
        for (pairs, found) in blocks.into_iter().zip(found) {
            self.of_block[pairs[0].block as usize] = found;
        }
        self.segments = segments;
    }

    /// The voxels that lack depth on their side, and where they are deepest, in a fixed order.
    pub fn lacking(&self, voxels: &BoundaryVoxels) -> Vec<(usize, Deepest)> {
        let of_voxel = |near: &[NearSegment]| {
            let voxel = near[0].voxel as usize;
            let (place, mut deepest) = (voxels.place(voxel), Deepest::NOWHERE);
            near.iter().for_each(|near| deepest.compare(place, &self.segments[near.number as usize]));
            (voxels.lack(voxel, deepest.depth) > 0.0).then_some((voxel, deepest))
        };
        let of_block =
            |near: &Vec<NearSegment>| near.chunk_by(|l, r| l.voxel == r.voxel).filter_map(of_voxel).collect::<Vec<_>>();
        self.of_block.par_iter().with_min_len(BLOCKS_PER_TASK).flat_map_iter(of_block).collect()
    }
}

impl Segment {
    /// By how much a node has moved and become wider together, mm.
    fn change_to(&self, other: &Self) -> f64 {
        let of_end = |n: usize| {
            let [before, now] = [self.ends[n], other.ends[n]];
            before.center.distance(now.center) + (now.radius - before.radius).abs()
        };
        of_end(0).max(of_end(1))
    }
}

/// For the voxels of a block that may lack depth the segments that they may be deepest in, also after the nodes have moved by
/// [`LARGEST_MOVE`].
fn near_voxels(voxels: &BoundaryVoxels, segments: &[Segment], pairs: &[BlockSegment]) -> Vec<NearSegment> {
    let unit = voxels.mean_spacing();
    let movable = LARGEST_MOVE * unit;
    let of_block: Vec<usize> = voxels.index.voxels_of(pairs[0].block as usize).collect();
    let places: Vec<DVec3> = of_block.iter().map(|voxel| voxels.place(*voxel)).collect();
    let axes: [Vec<f64>; 3] = std::array::from_fn(|d| places.iter().map(|place| place[d]).collect());
    let mut depths = Vec::with_capacity(pairs.len() * of_block.len());
    pairs.iter().for_each(|pair| append_depths(&axes, &segments[pair.segment as usize].ends, &mut depths));
    let mut near = Vec::new();
    for (at, &voxel) in of_block.iter().enumerate() {
        let of_voxel = || depths[at..].iter().step_by(of_block.len());
        let deepest = of_voxel().copied().fold(f64::NEG_INFINITY, f64::max);
        // By as much a depth may fall until the next look, and another one rise.
        if deepest < -REACH * unit || voxels.lack(voxel, deepest - voxels.side(voxel) * movable) == 0.0 {
            continue;
        }
        let kept = of_voxel().zip(pairs).filter(|(depth, _)| **depth >= deepest - 2.0 * movable);
        near.extend(kept.map(|(_, pair)| NearSegment { voxel: voxel as u32, number: pair.segment }));
    }
    near
}

/// Appends the depths of points in a segment, as [`depth_in_segment`] up to rounding: without a branch or a division, for several
/// points at a time.
fn append_depths([x, y, z]: &[Vec<f64>; 3], [a, b]: &[TubeNode; 2], depths: &mut Vec<f64>) {
    let way = b.center - a.center;
    let square = way.length_squared();
    let along = if square > 0.0 { way / square } else { DVec3::ZERO };
    let wider = b.radius - a.radius;
    depths.extend(x.iter().zip(y).zip(z).map(|((x, y), z)| {
        let [x, y, z] = [x - a.center.x, y - a.center.y, z - a.center.z];
        let part = (x * along.x + y * along.y + z * along.z).clamp(0.0, 1.0);
        let [x, y, z] = [x - part * way.x, y - part * way.y, z - part * way.z];
        a.radius + part * wider - (x * x + y * y + z * z).sqrt()
    }));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::test_images::{boundary_voxels, tube, tubes_depth};

    fn all_segments(tubes: &[Tube], voxels: &BoundaryVoxels) -> Vec<Deepest> {
        let segments = segments_of(tubes);
        let of_voxel = |voxel: usize| {
            let mut deepest = Deepest::NOWHERE;
            segments.iter().for_each(|segment| deepest.compare(voxels.place(voxel), segment));
            deepest
        };
        (0..voxels.voxels.len()).map(of_voxel).collect()
    }

    fn two_tubes() -> [Tube; 2] {
        [
            tube(&[([4.0, 8.0, 4.0], 1.8), ([8.2, 8.4, 8.0], 1.6), ([8.0, 8.0, 14.0], 1.5)]),
            tube(&[([14.0, 6.0, 9.0], 1.2), ([8.4, 8.2, 8.6], 1.4)]),
        ]
    }

    /// The voxels that lack depth where they are deepest are the same as by comparison with all segments.
    fn check_lacking(near: &NearSegments, tubes: &[Tube], voxels: &BoundaryVoxels) -> usize {
        let mut found = near.lacking(voxels);
        found.sort_by_key(|(voxel, _)| *voxel);
        // A voxel that is looked for from afar may have come within reach.
        let is_lacking = |(voxel, found): &(usize, Deepest)| {
            found.depth > LARGEST_MOVE - REACH && voxels.lack(*voxel, found.depth) > 0.0
        };
        found.retain(is_lacking);
        let expected: Vec<_> = all_segments(tubes, voxels).into_iter().enumerate().filter(is_lacking).collect();
        assert_eq!(found, expected);
        found.len()
    }

    #[test]
    fn voxels_are_deepest_in_the_same_segments_as_by_comparison_with_all() {
        let tubes = two_tubes();
        let voxels = boundary_voxels(18, DVec3::new(1.0, 0.9, 1.1), |p| tubes_depth(&tubes, p) > 0.0);
        let [found, expected] = [voxels.deepest(&tubes), all_segments(&tubes, &voxels)];
        let is_near = |found: &Deepest| found.depth > -LONG_REACH;
        assert!(found.iter().zip(&expected).all(|(l, r)| l == r || !is_near(r)));
        assert!(found.contains(&Deepest::NOWHERE));
    }

    #[test]
    fn depths_of_many_points_are_those_one_by_one() {
        let points: Vec<DVec3> =
            (0..50).map(|n| DVec3::new(f64::from(n % 5), f64::from(n / 5 % 5), 0.3 * f64::from(n))).collect();
        let axes = std::array::from_fn(|d| points.iter().map(|p| p[d]).collect());
        // The last one is a ball.
        for ends in [([1.0, 2.0, 3.0], 1.5), ([0.0, 0.0, 0.0], 0.5), ([3.0, 1.0, 9.0], 2.0)]
            .windows(2)
            .chain([&[([1.0; 3], 1.0); 2][..]])
        {
            let Tube { nodes } = tube(ends);
            let mut depths = Vec::new();
            append_depths(&axes, &[nodes[0], nodes[1]], &mut depths);
            for (point, depth) in points.iter().zip(depths) {
                assert!((depth_in_segment(*point, &[nodes[0], nodes[1]]).0 - depth).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn voxels_that_lack_depth_are_found_while_nodes_move() {
        let mut tubes = two_tubes();
        let voxels = boundary_voxels(18, DVec3::new(1.0, 0.9, 1.1), |p| tubes_depth(&tubes, p) > 0.0);
        let mut near = NearSegments::default();
        near.update(&voxels, segments_of(&tubes));
        // Voxels that do not lack depth, also after all moves until the next look, are left out.
        let is_near = |found: &&Deepest| found.depth > -REACH;
        let near_tubes = all_segments(&tubes, &voxels).iter().filter(is_near).count();
        let listed = near.of_block.iter().flat_map(|near| near.chunk_by(|l, r| l.voxel == r.voxel)).count();
        assert!(listed + 100 < near_tubes, "{listed} {near_tubes}");
        let (mut lacking, mut looks) = (Vec::new(), 0);
        for step in 0..40 {
            for (n, node) in tubes.iter_mut().flat_map(|tube| &mut tube.nodes).enumerate() {
                // One node slides far, some go to and fro, others stay.
                let way = DVec3::new((n as f64 + 0.3 * f64::from(step)).sin(), 0.4, -0.2).normalize();
                node.center += [0.0, 0.1, 0.0, 0.3, 0.05][n] * way;
                node.radius -= [0.0, 0.01, 0.0, -0.02, 0.0][n];
            }
            near.update(&voxels, segments_of(&tubes));
            looks += near.moved.iter().filter(|moved| **moved == 0.0).count();
            lacking.push(check_lacking(&near, &tubes, &voxels));
        }
        // Segments of which no node has moved are never looked at again, others are.
        assert!(looks > 20 && lacking.iter().all(|count| *count > 100), "{looks} {lacking:?}");
    }
}
