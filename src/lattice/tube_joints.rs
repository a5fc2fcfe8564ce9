//! Where tubes meet: a tube that another one begins in is cut there, and the ends that meet share a place.
//!
//! # Method
//! 1. Two lines may run side by side in a vessel, or one go on where another one ends: a tube that lies within others after the
//!    first steps of the fit is dropped, also one that only needs the end of another one to be a little farther on, which is set
//!    there. Both would be tied together at both ends, and the fit would draw the vessel's end back for that.
//! 2. Lines of two branches may both begin where their trunk does: what they share is left to one of them, the other one begins in it
//!    where they part.
//! 3. An end of a tube that lies within another tube, or just before it, meets that at its nearest node. That tube is cut there, unless
//!    it has an end or is cut already about as near.
//! 4. The ends that meet at a node are a joint. The fit draws each to the mean of all of them, wherever that goes: a fork is found
//!    together by all three vessels, each of which has its own direction and radius there. Of a tube both of whose ends would
//!    meet there only the nearer one does.
//! ```text
//!      \      /                \      /
//!       \    o                  \    o
//!        o  /         ->         o  /
//!         \o-o                    \/
//!          |                      o       one end of each of three tubes
//!          o                      |
//! ```
//!
//! # Source
//! None.
//!
//! # Invariants
//! What is dropped adds no more than `CONTAINED` to what is left then. Every segment of what is cut stays one; every piece has a segment;
//! no piece is in a joint twice.
//!
//! # Cost
//! Each end, and each node, is compared with all segments.

use std::collections::BTreeMap;

use glam::DVec3;
use rayon::prelude::*;

use crate::lattice::centerlines::{Tube, TubeNode};
use crate::lattice::deepest_segments::depth_in_segment;
use crate::lattice::tube_fitting::Hosts;

/// How near cuts are the same, in radii of the tube. Of 28 vessel trees the tubes are off by more than 0.45 voxel at 20 places with
/// this, 30 with 1.
const SAME: f64 = 2.5;

/// How thick what a tube adds to others may be for it to lie within them, in mean spacings. Of 54 vessel trees the tubes are off by
/// more than 0.35 voxel at 14 places where none is dropped, 20 where those that go on stay as stubs, 6 with this.
const CONTAINED: f64 = 0.25;

/// By how much a tube may be lengthened for another one, in its radii.
const LENGTHENED: f64 = 2.0;

/// How long an end has to lie within another tube for it to be the trunk of both, in its radius: an end on the axis of the tube that
/// it leaves lies there for less. Of 45 vessel trees the tubes are off by more than 0.35 voxel at 12 places where nothing is shared,
/// 9 with 2; 1.2 and 3 do the same on 11 of them.
const SHARED: f64 = 2.0;

/// How far before another tube an end may lie and meet it, in its radius: the balls of both overlap, nothing is between them. Of 45
/// vessel trees the tubes are off by more than 0.35 voxel at 9 places with 0, 7 with this; 0.7 and 1 do the same on 11 of them.
const BEFORE: f64 = 0.5;

/// An end of a tube.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TubeEnd {
    /// Number of the tube.
    pub tube: usize,
    /// Whether it is the last node, not the first.
    pub is_last: bool,
}

/// The ends that meet at a place.
pub type Joint = Vec<TubeEnd>;

/// Tubes and which of their ends meet.
#[derive(Debug, Clone, Default)]
pub struct JoinedTubes {
    /// The tubes.
    pub tubes: Vec<Tube>,
    /// Their ends that meet.
    pub joints: Vec<Joint>,
}

impl JoinedTubes {
    /// Adds other tubes after these.
    pub fn append(&mut self, other: &Self) {
        let first = self.tubes.len();
        let moved = |end: &TubeEnd| TubeEnd { tube: first + end.tube, ..*end };
        self.joints.extend(other.joints.iter().map(|joint| joint.iter().map(moved).collect::<Joint>()));
        self.tubes.extend(other.tubes.iter().cloned());
    }
}

impl TubeEnd {
    /// The node there.
    fn node(self, tubes: &[Tube]) -> TubeNode {
        let nodes = &tubes[self.tube].nodes;
        nodes[if self.is_last { nodes.len() - 1 } else { 0 }]
    }
}

/// Mean place of the ends of a joint.
pub fn place_of(joint: &Joint, tubes: &[Tube]) -> DVec3 {
    joint.iter().map(|end| end.node(tubes).center).sum::<DVec3>() / joint.len() as f64
}

/// A node of a tube: the numbers of both.
type Node = (usize, usize);

/// Tubes without those that lie within others, or would where the end of another one were theirs: that gets it then. What they add
/// is no more than `CONTAINED` `unit`s thick. The shortest are looked at first, so that of two that run side by side the longer
/// one is kept.
pub fn without_contained(tubes: &[Tube], unit: f64) -> Vec<Tube> {
    let mut kept: Vec<Option<Tube>> = tubes.iter().cloned().map(Some).collect();
    for number in by_length(tubes) {
        let Some(tube) = kept[number].take() else { continue };
        let others = || kept.iter().flatten();
        let is_within = |node: &TubeNode| others().any(|other| contains(other, node, unit));
        if tube.nodes.iter().all(is_within) {
            continue;
        }
        let longer = |(n, other): (usize, &Option<Tube>)| Some((n, lengthened(other.as_ref()?, &tube, unit)?));
        match kept.iter().enumerate().find_map(longer) {
            Some((n, other)) => kept[n] = Some(other),
            None => kept[number] = Some(tube),
        }
    }
    kept.into_iter().flatten().collect()
}

/// A tube with an end of a short one in place of its own, where it holds all of both then.
fn lengthened(tube: &Tube, short: &Tube, unit: f64) -> Option<Tube> {
    let last = tube.nodes.len() - 1;
    let ends = [0, short.nodes.len() - 1].map(|n| short.nodes[n]);
    let ways = [0, last].into_iter().flat_map(|n| ends.map(|end| (n, end)));
    let mut longer = ways.filter_map(|(n, end)| {
        let own = tube.nodes[n];
        let mut longer = tube.clone();
        longer.nodes[n] = end;
        let is_near = own.center.distance(end.center) <= LENGTHENED * own.radius;
        (is_near && short.nodes.iter().chain([&own]).all(|node| contains(&longer, node, unit))).then_some(longer)
    });
    longer.next()
}

/// Whether a tube holds the ball around a node.
fn contains(tube: &Tube, node: &TubeNode, unit: f64) -> bool {
    let depth = |n| depth_in_segment(node.center, &tube.segment(n)).0;
    (0..tube.segment_count()).any(|n| depth(n) >= node.radius - CONTAINED * unit)
}

/// Tubes without the ends that they share with others: one of them keeps what is shared, the others begin in it. The shortest are
/// looked at first, as in [`without_contained`].
pub fn without_shared_ends(tubes: &[Tube], unit: f64) -> Vec<Tube> {
    let mut tubes = tubes.to_vec();
    for number in by_length(&tubes) {
        for _ in 0..2 {
            let of_other = |(n, other): (usize, &Tube)| {
                if n == number { 0 } else { shared_nodes(&tubes[number], other, unit) }
            };
            let shared = tubes.iter().enumerate().map(of_other).max().unwrap_or(0);
            let nodes = &mut tubes[number].nodes;
            // The last one of these stays: it lies within the other tube, and meets it.
            if shared < nodes.len() {
                nodes.drain(..shared.saturating_sub(1));
            }
            // The other end is next, and the first one comes first again.
            nodes.reverse();
        }
    }
    tubes
}

/// How many nodes from the first one on a tube shares with another one; 0 where it only leaves that.
fn shared_nodes(tube: &Tube, other: &Tube, unit: f64) -> usize {
    let shared = tube.nodes.iter().take_while(|node| contains(other, node, unit)).count();
    let length: f64 = tube.nodes[..shared].windows(2).map(|two| two[0].center.distance(two[1].center)).sum();
    if length > SHARED * tube.nodes[0].radius { shared } else { 0 }
}

/// Numbers of tubes, the shortest first; of equal ones the last.
fn by_length(tubes: &[Tube]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..tubes.len()).collect();
    order.sort_by(|l, r| tubes[*l].length().total_cmp(&tubes[*r].length()).then(r.cmp(l)));
    order
}

/// Cuts tubes where others begin in them.
pub fn split_at_joints(tubes: &[Tube]) -> JoinedTubes {
    let last = |tube: usize| tubes[tube].nodes.len().saturating_sub(1);
    let ends: Vec<TubeEnd> =
        (0..tubes.len()).flat_map(|tube| [false, true].map(|is_last| TubeEnd { tube, is_last })).collect();
    let places = Hosts::new(tubes);
    let host = |end: &TubeEnd| {
        let TubeNode { center, radius } = end.node(tubes);
        places.host_of(end.tube, center, -BEFORE * radius)
    };
    let hosts: Vec<_> = ends.par_iter().map(host).collect();
    let mut cuts: Vec<Vec<usize>> = vec![Vec::new(); tubes.len()];
    let mut meetings = Meetings::default();
    for (end, host) in ends.iter().zip(hosts) {
        let Some(host) = host else { continue };
        let (nodes, at) = (&tubes[host.tube].nodes, host.segment + host.part.round() as usize);
        let at = at.min(last(host.tube));
        let is_near =
            |n: &usize| n.abs_diff(at) <= 1 || nodes[*n].center.distance(nodes[at].center) < SAME * nodes[at].radius;
        let known = [0, last(host.tube)].into_iter().chain(cuts[host.tube].iter().copied()).find(is_near);
        let node = known.unwrap_or_else(|| {
            cuts[host.tube].push(at);
            at
        });
        let own = if end.is_last { last(end.tube) } else { 0 };
        meetings.join((end.tube, own), (host.tube, node));
    }
    let mut pieces = Vec::new();
    let mut joints: BTreeMap<Node, Joint> = BTreeMap::new();
    for (number, tube) in tubes.iter().enumerate() {
        cuts[number].sort_unstable();
        let mut from = 0;
        for to in cuts[number].iter().copied().chain([last(number)]) {
            for (node, is_last) in [(from, false), (to, true)] {
                joints.entry(meetings.least((number, node))).or_default().push(TubeEnd { tube: pieces.len(), is_last });
            }
            pieces.push(Tube { nodes: tube.nodes[from..=to].to_vec() });
            from = to;
        }
    }
    let mut joints: Vec<Joint> = joints.into_values().collect();
    joints.iter_mut().for_each(|joint| leave_far_ends(joint, &pieces));
    joints.retain(|joint| joint.len() > 1);
    JoinedTubes { tubes: pieces, joints }
}

/// Where both ends of a tube meet the same others, only the end nearer to these does: the tube would shrink to a point.
fn leave_far_ends(joint: &mut Joint, tubes: &[Tube]) {
    let is_twice = |end: &TubeEnd| joint.iter().filter(|other| other.tube == end.tube).count() > 1;
    let once: Joint = joint.iter().copied().filter(|end| !is_twice(end)).collect();
    let place = if once.is_empty() { place_of(joint, tubes) } else { place_of(&once, tubes) };
    let far = |end: &TubeEnd| end.node(tubes).center.distance(place);
    let nearer = |end: &TubeEnd| {
        let other = TubeEnd { is_last: !end.is_last, ..*end };
        far(end) < far(&other) || (far(end) == far(&other) && !end.is_last)
    };
    let kept: Joint = joint.iter().copied().filter(|end| !is_twice(end) || nearer(end)).collect();
    *joint = kept;
}

/// Which nodes meet: each leads to a smaller one of its set.
#[derive(Default)]
struct Meetings(BTreeMap<Node, Node>);

impl Meetings {
    /// The smallest node of a set.
    fn least(&self, mut node: Node) -> Node {
        while let Some(next) = self.0.get(&node) {
            node = *next;
        }
        node
    }

    fn join(&mut self, a: Node, b: Node) {
        let [a, b] = [self.least(a), self.least(b)];
        if a != b {
            self.0.insert(a.max(b), a.min(b));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tube(nodes: &[[f64; 3]], radius: f64) -> Tube {
        Tube { nodes: nodes.iter().map(|at| TubeNode { center: DVec3::from(*at), radius }).collect() }
    }

    #[test]
    fn a_tube_is_cut_where_two_others_begin_in_it_and_four_ends_meet() {
        let trunk: Vec<[f64; 3]> = (0..=16).map(|n| [0.0, 0.0, f64::from(n)]).collect();
        let tubes = [
            tube(&trunk, 1.0),
            tube(&[[6.0, 0.0, 8.0], [3.0, 0.0, 8.0], [0.2, 0.0, 8.0]], 0.8),
            tube(&[[0.0, 0.3, 9.2], [0.0, 5.0, 9.2]], 0.8),
            // Far from all others.
            tube(&[[20.0, 0.0, 0.0], [20.0, 0.0, 4.0]], 1.0),
        ];
        let JoinedTubes { tubes: pieces, joints } = split_at_joints(&tubes);
        assert_eq!(pieces.iter().map(|t| t.nodes.len()).collect::<Vec<_>>(), [9, 9, 3, 2, 2]);
        let end = |tube, is_last| TubeEnd { tube, is_last };
        assert_eq!(joints, [vec![end(0, true), end(1, false), end(2, true), end(3, false)]]);
        let expected = DVec3::new(0.05, 0.075, 8.3);
        assert!(place_of(&joints[0], &pieces).distance(expected) < 1e-12);
    }

    #[test]
    fn of_two_tubes_side_by_side_the_longer_one_is_kept() {
        let branch = tube(&[[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 4.0, 0.0]], 1.0);
        let beside = tube(&[[0.1, 0.3, 0.0], [0.0, 3.0, 0.1]], 1.05);
        let ball = tube(&[[0.0, 1.0, 0.3]], 0.7);
        // This one comes out at the side.
        let fork = tube(&[[0.0, 2.0, 0.0], [0.0, 2.0, 1.5]], 0.9);
        let tubes = [beside.clone(), branch.clone(), ball.clone(), fork.clone()];
        assert_eq!(without_contained(&tubes, 1.0), [branch.clone(), fork.clone()]);
        // In finer voxels the one beside adds something.
        let tubes = [beside.clone(), branch.clone(), ball];
        assert_eq!(without_contained(&tubes, 0.2), [beside, branch]);
    }

    #[test]
    fn a_tube_takes_the_end_of_one_that_goes_on_where_it_ends() {
        let trunk = tube(&[[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 4.0]], 2.0);
        let stub = tube(&[[0.1, 0.0, 3.0], [0.1, 0.0, 5.0]], 2.1);
        let longer = without_contained(&[trunk.clone(), stub.clone()], 1.0);
        let [first, middle, last] = longer[0].nodes[..] else { panic!("{longer:?}") };
        assert_eq!((longer.len(), first, middle, last), (1, trunk.nodes[0], trunk.nodes[1], stub.nodes[1]));
        // One that turns away stays.
        let tubes = [trunk, tube(&[[0.0, 0.0, 3.0], [2.0, 0.0, 5.0]], 2.0)];
        assert_eq!(without_contained(&tubes, 1.0), tubes);
    }

    #[test]
    fn two_branches_that_both_hold_their_trunk_part_at_the_fork() {
        let line = |x: f64, shift: f64| {
            let at = |n: i32| [x * f64::from((n - 4).max(0)) + shift, 0.0, f64::from(n)];
            tube(&(0..=8).map(at).collect::<Vec<_>>(), 1.0)
        };
        let tubes = [line(0.8, 0.1), line(-0.7, 0.0)];
        let found = without_shared_ends(&tubes, 0.5);
        assert_eq!(found[0], tubes[0]);
        // The other one has lost what is within a quarter of a voxel, but for its last node there.
        assert_eq!(found[1].nodes, tubes[1].nodes[4..]);
        assert_eq!(split_at_joints(&found).joints.iter().map(Vec::len).collect::<Vec<_>>(), [3]);
        // From the other end it is the same.
        let mut turned = tubes.clone();
        turned[1].nodes.reverse();
        assert_eq!(without_shared_ends(&turned, 0.5)[1].nodes, turned[1].nodes[..5]);
        // A branch on the axis of another tube only leaves that.
        let trunk = tube(&(0..=8).map(|n| [0.0, 0.0, f64::from(n)]).collect::<Vec<_>>(), 2.0);
        let branch = tube(&(0..=4).map(|n| [f64::from(n), 0.0, 4.0]).collect::<Vec<_>>(), 1.0);
        assert_eq!(without_shared_ends(&[trunk.clone(), branch.clone()], 0.5), [trunk, branch]);
    }

    #[test]
    fn an_end_just_before_a_tube_meets_it() {
        let trunk = tube(&(0..=8).map(|n| [0.0, 0.0, f64::from(n)]).collect::<Vec<_>>(), 1.0);
        let before = |gap: f64| tube(&[[1.0 + gap, 0.0, 4.0], [6.0, 0.0, 4.0]], 1.0);
        let joints = |gap: f64| split_at_joints(&[trunk.clone(), before(gap)]).joints.len();
        assert_eq!([joints(0.4), joints(0.6)], [1, 0]);
    }

    #[test]
    fn a_tube_meets_others_once_at_a_place() {
        // Both ends of the short one are near the end of the long one; the one ball has its only end once.
        let tubes = [
            tube(&[[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 4.0], [0.0, 0.0, 6.0]], 1.0),
            tube(&[[0.0, 0.0, 5.4], [0.0, 0.3, 6.6]], 1.0),
            tube(&[[0.2, 0.0, 5.9]], 0.5),
        ];
        let JoinedTubes { tubes: pieces, joints } = split_at_joints(&tubes);
        assert_eq!(pieces, tubes);
        let end = |tube, is_last| TubeEnd { tube, is_last };
        assert_eq!(joints, [vec![end(0, true), end(1, false), end(2, false)]]);
    }

    #[test]
    fn an_end_near_the_end_of_its_host_meets_that() {
        let tubes = [
            tube(&[[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 4.0], [0.0, 0.0, 6.0]], 1.0),
            tube(&[[0.0, 0.1, 5.5], [0.0, 3.0, 8.0]], 1.0),
        ];
        let JoinedTubes { tubes: pieces, joints } = split_at_joints(&tubes);
        assert_eq!(pieces, tubes);
        assert_eq!(joints.len(), 1);
        let mut both = JoinedTubes { tubes: pieces, joints };
        let other = both.clone();
        both.append(&other);
        assert_eq!(both.joints[1].iter().map(|end| end.tube).collect::<Vec<_>>(), [2, 3]);
    }
}
