//! Manifold sub-meshes: finding where the surface of a label pinches, and relabelling elements until it does not.
//!
//! # Method
//! 1. Around a vertex inside the lattice the surface of a label is one disc exactly where the elements of the label
//!    are connected through faces at the vertex, and the others are too. The excess of a vertex is the number of
//!    further groups, summed over the labels around it. A non-manifold edge shows at both of its ends.
//! 2. At a vertex with excess each group of a label is tried with each other label around the vertex, and each single
//!    element too. The change that lowers the excess of all vertices concerned most is made.
//!    Where the Euler numbers of the image are to be kept, the one that leaves them within reach ([`super::euler_ranges`]).
//! 3. What remains is refined by the caller.
//!
//! # Source
//! [Drakopoulos2017] 2.3.3, mesh topological checks.
//!
//! # Differences
//! The thesis only refines. A pinch of the lattice's own making can survive refinement, a relabelling removes it; the sum
//! of excesses falls with every change, so the descent ends.
//!
//! # Invariants
//! Elements and vertices stay, only labels of elements change, to labels beside them.

use std::collections::VecDeque;

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::connected_components::unite;
use crate::index::Label;
use crate::lattice::euler_ranges::{EulerNumbers, EulerRanges};
use crate::lattice::vertex_balls::VertexBalls;
use crate::mesh::numbering::TET_FACES;

/// Elements with labels, and what lies around their vertices.
pub struct InterfaceTopology<'a> {
    pub(super) tets: &'a [[u32; 4]],
    pub(super) neighbors: &'a [[u32; 4]],
    balls: VertexBalls,
    /// Where each vertex lies, if the elements are to be cut where the image ends; else none.
    border: Vec<AtBorder>,
}

/// Where a vertex lies against the border of the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum AtBorder {
    /// Inside, with all around it.
    Within,
    /// Inside, next to a vertex that is not.
    Next,
    /// Outside.
    Beyond,
}

/// Most elements of a ball whose groups are counted in one word of marks.
pub(super) const MOST_COUNTED: usize = u128::BITS as usize;

/// Vertices per parallel work item.
const CHUNK: usize = 1024;

/// Pinched vertices between two looks at whether the run is cancelled: each tries all labels around it.
const VERTICES_PER_CHECK: usize = 64;

/// For each element of a ball the three behind its faces at the vertex, by their places in the ball.
pub(super) type Links = [[u8; 3]; MOST_COUNTED];

/// The vertices around one whose labels change, with what does not change with every trial.
struct Vicinity {
    /// Vertices, increasing.
    vertices: Vec<u32>,
    /// Links of each that has them.
    links: Vec<Option<Links>>,
    /// Excess of each before a trial.
    excess: Vec<i64>,
    /// Where the vertex itself is among these.
    center: usize,
}

/// What a repair did.
pub struct Repaired {
    /// The elements that changed with their labels before, in the order of the changes.
    pub changed: Vec<(u32, Label)>,
    /// All vertices that still pinch among those from which it started and those around changes, and some that do no more.
    pub left: Vec<u32>,
}

/// A change of labels that was found to help.
struct Change {
    /// How far Euler numbers are out of their ranges afterwards, change of the excess, voxels lost, elements: what counts, in
    /// this order.
    cost: (i64, i64, usize, usize),
    elements: Vec<u32>,
    label: Label,
    /// Changes of the Euler numbers by label.
    euler: Vec<(Label, EulerNumbers)>,
}

impl<'a> InterfaceTopology<'a> {
    /// Prepares the balls of all vertices.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn new(
        tets: &'a [[u32; 4]],
        neighbors: &'a [[u32; 4]],
        vertex_count: usize,
        context: &RunContext,
    ) -> Result<Self> {
        Ok(Self::with_balls(tets, neighbors, VertexBalls::new(tets, neighbors, vertex_count, context)?))
    }

    /// With the balls of all vertices as they are known.
    pub fn with_balls(tets: &'a [[u32; 4]], neighbors: &'a [[u32; 4]], balls: VertexBalls) -> Self {
        Self { tets, neighbors, balls, border: Vec::new() }
    }

    /// The balls, for whoever asks about the same elements with other labels.
    pub fn into_balls(self) -> VertexBalls {
        self.balls
    }

    /// The elements are to be cut where the image ends: Euler numbers are those of what is left inside. `is_inside` tells for each
    /// vertex whether it is.
    pub fn cut_at_border(&mut self, is_inside: &[bool]) {
        let at = |is_inside: &bool| if *is_inside { AtBorder::Within } else { AtBorder::Beyond };
        let mut border: Vec<AtBorder> = is_inside.iter().map(at).collect();
        for tet in self.tets {
            if tet.iter().any(|v| border[*v as usize] == AtBorder::Beyond) {
                for v in *tet {
                    let at = &mut border[v as usize];
                    *at = if *at == AtBorder::Within { AtBorder::Next } else { *at };
                }
            }
        }
        self.border = border;
    }

    /// Where a vertex lies against the border that the elements are cut at.
    #[inline]
    pub(super) fn at_border(&self, vertex: u32) -> AtBorder {
        self.border.get(vertex as usize).copied().unwrap_or(AtBorder::Within)
    }

    /// Number of vertices.
    pub(super) fn vertex_count(&self) -> usize {
        self.balls.vertex_count()
    }

    /// Elements around a vertex, increasing.
    pub(super) fn ball(&self, vertex: u32) -> &[u32] {
        self.balls.of(vertex)
    }

    /// Vertices whose surfaces pinch, increasing.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn pinched(&self, labels: &[Label], context: &RunContext) -> Result<Vec<u32>> {
        self.pinched_among(labels, |_| true, context)
    }

    /// Those of some vertices whose surfaces pinch, increasing.
    ///
    /// # Errors
    /// As [`pinched`](Self::pinched).
    pub fn pinched_among(
        &self,
        labels: &[Label],
        is_candidate: impl Fn(u32) -> bool + Sync + Send,
        context: &RunContext,
    ) -> Result<Vec<u32>> {
        let vertices = (0..self.vertex_count() as u32).into_par_iter().with_min_len(CHUNK);
        let vertices = context.until_cancelled(vertices);
        let pinched = vertices.filter(|v| is_candidate(*v) && self.excess(*v, labels) > 0).collect();
        context.check()?;
        Ok(pinched)
    }

    /// The elements around the given vertices.
    pub fn elements_around(&self, vertices: &[u32]) -> Vec<u32> {
        let mut elements: Vec<u32> = vertices.iter().flat_map(|v| self.ball(*v)).copied().collect();
        elements.sort_unstable();
        elements.dedup();
        elements
    }

    /// Labels in a ball, increasing; background where the ball is open.
    pub(super) fn labels_around(&self, vertex: u32, labels: &[Label]) -> Vec<Label> {
        let mut around = labels_of(self.ball(vertex), labels);
        if self.is_open(vertex) && around.first() != Some(&Label::BACKGROUND) {
            around.insert(0, Label::BACKGROUND);
        }
        around
    }

    /// Whether elements of two labels meet at a vertex; where its ball is open, the background is one.
    pub(super) fn is_mixed(&self, vertex: u32, labels: &[Label]) -> bool {
        let mut around = self.ball(vertex).iter().map(|e| labels[*e as usize]);
        let first = if self.is_open(vertex) { Some(Label::BACKGROUND) } else { around.next() };
        around.any(|label| Some(label) != first)
    }

    /// Whether an element at the vertex has the label.
    pub(super) fn has_label(&self, vertex: u32, label: Label, labels: &[Label]) -> bool {
        self.ball(vertex).iter().any(|e| labels[*e as usize] == label)
    }

    /// Whether the elements around a vertex, whatever their labels, form a ball or a half ball: they hang together through
    /// faces, and what they show on a small sphere is the whole sphere or a disc (Euler number 1).
    pub fn is_lattice_ball(&self, vertex: u32, labels: &[Label]) -> bool {
        if !self.is_open(vertex) {
            return true;
        }
        self.shape_on_sphere(vertex, self.ball(vertex)) == (1, 1) && self.groups(vertex, |_| true, labels).len() == 1
    }

    /// Whether a face at the vertex has nothing behind it.
    pub fn is_open(&self, vertex: u32) -> bool {
        self.balls.is_open(vertex)
    }

    /// Faces of an element that hold the vertex, with the element behind each.
    fn faces_at(&self, element: u32, vertex: u32) -> impl Iterator<Item = (usize, u32)> + '_ {
        let tet = &self.tets[element as usize];
        (0..4)
            .filter(move |f| TET_FACES[*f].iter().any(|v| tet[*v] == vertex))
            .map(move |f| (f, self.neighbors[element as usize][f]))
    }

    /// The elements with vertices on both sides of the border that have a vertex where one of some labels meets another, increasing.
    pub fn elements_across_border(&self, of_labels: &[Label], labels: &[Label]) -> Vec<u32> {
        let is_met =
            |v: &u32| self.is_mixed(*v, labels) && of_labels.iter().any(|own| self.has_label(*v, *own, labels));
        let is_across = |e: &u32| {
            let tet = &self.tets[*e as usize];
            let has = |at: AtBorder| tet.iter().any(|v| self.at_border(*v) == at);
            has(AtBorder::Next) && has(AtBorder::Beyond) && tet.iter().any(is_met)
        };
        (0..self.tets.len() as u32).into_par_iter().with_min_len(CHUNK).filter(is_across).collect()
    }

    /// How many further groups of elements the labels around a vertex have; above zero their surfaces pinch there.
    pub fn excess(&self, vertex: u32, labels: &[Label]) -> i64 {
        self.excess_with(vertex, labels, None)
    }

    /// The excess of a vertex, whose links may be known.
    fn excess_with(&self, vertex: u32, labels: &[Label], known: Option<&Links>) -> i64 {
        if self.at_border(vertex) == AtBorder::Beyond {
            return 0;
        }
        let ball = self.ball(vertex);
        let first = ball.first().map(|e| labels[*e as usize]);
        if !self.is_open(vertex) && ball.iter().all(|e| Some(labels[*e as usize]) == first) {
            return 0;
        }
        if ball.len() > MOST_COUNTED {
            return self.excess_of_all(vertex, labels);
        }
        if self.is_open(vertex) {
            return self.excess_of_open(vertex, labels);
        }
        match known {
            Some(links) => self.excess_by_marks(vertex, labels, links),
            None => self.excess_by_marks(vertex, labels, &self.links(vertex)),
        }
    }

    /// Whether a vertex is closed and has few enough elements for sets of them to be words.
    pub(super) fn has_links(&self, vertex: u32) -> bool {
        !self.is_open(vertex) && self.ball(vertex).len() <= MOST_COUNTED
    }

    fn excess_of_all(&self, vertex: u32, labels: &[Label]) -> i64 {
        let around = self.labels_around(vertex, labels);
        if around.len() < 2 {
            return 0;
        }
        around.into_iter().filter(|l| !l.is_background()).map(|l| self.excess_of(vertex, l, labels)).sum()
    }

    /// The excess of a closed vertex of two labels or more and at most [`MOST_COUNTED`] elements: sets of elements are words.
    fn excess_by_marks(&self, vertex: u32, labels: &[Label], links: &Links) -> i64 {
        let ball = self.ball(vertex);
        let mut around = [Label::BACKGROUND; MOST_COUNTED];
        around.iter_mut().zip(ball).for_each(|(label, element)| *label = labels[*element as usize]);
        let all = all_marks(ball.len());
        let (mut rest, mut excess) = (all, 0);
        // What is left beside the label before, with the excess of that: the same for both where there are but two.
        let mut other = (0, 0);
        while rest != 0 {
            let label = around[rest.trailing_zeros() as usize];
            let own = marks_of(around[..ball.len()].iter().map(|of| *of == label));
            rest &= !own;
            if !label.is_background() {
                if own != other.0 {
                    let groups = group_count(own, links) + group_count(all & !own, links);
                    other = (all & !own, groups as i64 - 2);
                }
                excess += other.1;
            }
        }
        excess
    }

    /// The excess of an open vertex of at most [`MOST_COUNTED`] elements: most labels show a disc.
    fn excess_of_open(&self, vertex: u32, labels: &[Label]) -> i64 {
        let (ball, links) = (self.ball(vertex), self.links(vertex));
        let (mut rest, mut excess) = (all_marks(ball.len()), 0);
        while rest != 0 {
            let label = labels[ball[rest.trailing_zeros() as usize] as usize];
            let own = marks_of(ball.iter().map(|e| labels[*e as usize] == label));
            rest &= !own;
            if !label.is_background() && !self.is_disc(vertex, own, &links) {
                excess += self.excess_of(vertex, label, labels);
            }
        }
        excess
    }

    /// Whether marked elements of a ball show a disc on a small sphere: they hang together through faces, and its Euler number is 1.
    fn is_disc(&self, vertex: u32, own: u128, links: &Links) -> bool {
        let places = || (0..u128::BITS as usize).filter(|at| own >> at & 1 != 0);
        // Behind a face at which the ball is open is the element itself.
        let is_side = |at: usize, link: u8| usize::from(link) == at || own >> link & 1 == 0;
        let sides: usize = places().map(|at| links[at].iter().filter(|link| is_side(at, **link)).count()).sum();
        let triangles = own.count_ones() as usize;
        let mut corners = [0; 3 * MOST_COUNTED];
        let tets = places().map(|at| self.tets[self.ball(vertex)[at] as usize]);
        let of_triangles = tets.flat_map(|tet| opposite_to(vertex, tet));
        corners.iter_mut().zip(of_triangles).for_each(|(corner, v)| *corner = v);
        let corners = &mut corners[..3 * triangles];
        corners.sort_unstable();
        let count = corners.chunk_by(|a, b| a == b).count();
        count + triangles == 1 + (3 * triangles + sides) / 2 && group_count(own, links) == 1
    }

    /// For each element of a ball the three behind its faces at the vertex, by their places in the ball; the element itself where
    /// nothing is behind.
    pub(super) fn links(&self, vertex: u32) -> Links {
        let ball = self.ball(vertex);
        let mut links = [[0; 3]; MOST_COUNTED];
        for (at, (row, element)) in links.iter_mut().zip(ball).enumerate() {
            // Face f is opposite to corner f.
            let corners = self.tets[*element as usize].iter();
            let at_vertex = corners.zip(self.neighbors[*element as usize]).filter(|(corner, _)| **corner != vertex);
            for (link, (_, near)) in row.iter_mut().zip(at_vertex) {
                // Balls are listed by increasing element.
                let place = ball.binary_search(&near);
                debug_assert!(
                    place.is_ok() || self.is_open(vertex),
                    "a closed ball holds what is behind its inner faces"
                );
                *link = place.unwrap_or(at) as u8;
            }
        }
        links
    }

    /// Groups of a label around a vertex, and of all that is not the label, beyond one of each.
    pub fn excess_of(&self, vertex: u32, label: Label, labels: &[Label]) -> i64 {
        let own = self.groups(vertex, |l| l == label, labels).len() as i64;
        own.max(1) + self.other_groups(vertex, label, labels).max(1) - 2
    }

    /// Groups of what is not of `label` around a vertex, the outside with it.
    fn other_groups(&self, vertex: u32, label: Label, labels: &[Label]) -> i64 {
        if !self.is_open(vertex) {
            return self.groups(vertex, |e| e != label, labels).len() as i64;
        }
        // Behind a thin wall the outside itself has parts. Of a closed set on a sphere, Alexander's duality gives the parts
        // of the rest: one more than its loops, which are its parts minus its Euler number.
        let own: Vec<u32> = self.ball(vertex).iter().copied().filter(|e| labels[*e as usize] == label).collect();
        let (parts, euler) = self.shape_on_sphere(vertex, &own);
        1 + parts - euler
    }

    /// What elements show on a small sphere around a vertex of theirs: parts, connected also through corners, and Euler number.
    fn shape_on_sphere(&self, vertex: u32, elements: &[u32]) -> (i64, i64) {
        shape_of(elements.iter().map(|e| opposite_to(vertex, self.tets[*e as usize])), |_| true)
    }

    /// Whether an element can take another label and what has its label, and what has the other, stays as it is but for its shape:
    /// with each it shares one to three faces and nothing else, which are a disc.
    pub fn is_simple(&self, element: u32, label: Label, labels: &[Label]) -> bool {
        let tet = self.tets[element as usize];
        [labels[element as usize], label].into_iter().all(|side| {
            // The corners that each other element of the side shares with it.
            let is_other = |e: &&u32| **e != element && labels[**e as usize] == side;
            let corners_shared = |e: &u32| {
                let shared = (0..4).filter(|at| self.tets[*e as usize].contains(&tet[*at]));
                shared.fold(0u8, |shared, at| shared | 1 << at)
            };
            let shared: Vec<u8> =
                tet.into_iter().flat_map(|v| self.ball(v)).filter(is_other).map(corners_shared).collect();
            // A face is all corners but one.
            let faces: Vec<u8> = (0..4).map(|at| 15 & !(1 << at)).filter(|face| shared.contains(face)).collect();
            (1..4).contains(&faces.len()) && shared.iter().all(|shared| faces.iter().any(|face| shared & !face == 0))
        })
    }

    /// Groups of the elements around a vertex whose label passes, connected through faces at the vertex.
    fn groups(&self, vertex: u32, passes: impl Fn(Label) -> bool, labels: &[Label]) -> Vec<Vec<u32>> {
        let ball = self.ball(vertex);
        let mut seen = vec![false; ball.len()];
        let mut groups = Vec::new();
        for start in 0..ball.len() {
            if seen[start] || !passes(labels[ball[start] as usize]) {
                continue;
            }
            seen[start] = true;
            let mut group = vec![ball[start]];
            let mut next = 0;
            while next < group.len() {
                for (_, near) in self.faces_at(group[next], vertex) {
                    // Balls are listed by increasing element.
                    let Ok(position) = ball.binary_search(&near) else { continue };
                    if !seen[position] && passes(labels[near as usize]) {
                        seen[position] = true;
                        group.push(near);
                    }
                }
                next += 1;
            }
            groups.push(group);
        }
        groups
    }

    /// Relabels elements until no change lowers the excess; returns how many elements changed. `voxels_lost` tells how
    /// many voxels of their own elements lose that take a label, given those of all, or that they may not take it; `euler` are the
    /// Euler numbers now and those that are to be kept, if any are; they follow the changes.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn repair(
        &self,
        labels: &mut [Label],
        euler: Option<&mut EulerRanges>,
        context: &RunContext,
        voxels_lost: impl Fn(&[Label], &[u32], Label) -> Option<usize>,
    ) -> Result<usize> {
        let pinched = self.pinched(labels, context)?;
        Ok(self.repair_from(pinched, labels, euler, context, voxels_lost)?.changed.len())
    }

    /// As [`repair`](Self::repair), from some vertices on.
    ///
    /// # Errors
    /// As [`repair`](Self::repair).
    pub fn repair_from(
        &self,
        vertices: Vec<u32>,
        labels: &mut [Label],
        mut euler: Option<&mut EulerRanges>,
        context: &RunContext,
        voxels_lost: impl Fn(&[Label], &[u32], Label) -> Option<usize>,
    ) -> Result<Repaired> {
        let mut queue: VecDeque<u32> = vertices.into();
        let (mut changed, mut left, mut seen) = (Vec::new(), Vec::new(), 0);
        while let Some(vertex) = queue.pop_front() {
            context.check_every(VERTICES_PER_CHECK, seen)?;
            seen += 1;
            if self.excess(vertex, labels) == 0 {
                continue;
            }
            let Some(change) = self.best_change(vertex, labels, euler.as_deref(), &voxels_lost) else {
                left.push(vertex);
                continue;
            };
            let concerned = self.vertices_of(&change.elements);
            for e in change.elements {
                changed.push((e, labels[e as usize]));
                labels[e as usize] = change.label;
            }
            if let Some(euler) = &mut euler {
                euler.add(&change.euler);
            }
            queue.extend(concerned);
        }
        Ok(Repaired { changed, left })
    }

    /// The vertices of some elements, increasing.
    pub(super) fn vertices_of(&self, elements: &[u32]) -> Vec<u32> {
        let mut vertices: Vec<u32> = elements.iter().flat_map(|e| self.tets[*e as usize]).collect();
        vertices.sort_unstable();
        vertices.dedup();
        vertices
    }

    fn best_change(
        &self,
        vertex: u32,
        labels: &mut [Label],
        euler: Option<&EulerRanges>,
        voxels_lost: &impl Fn(&[Label], &[u32], Label) -> Option<usize>,
    ) -> Option<Change> {
        let around = self.labels_around(vertex, labels);
        let mut candidates: Vec<Vec<u32>> = Vec::new();
        for label in &around {
            let groups = self.groups(vertex, |l| l == *label, labels);
            if groups.len() > 1 {
                candidates.extend(groups);
            }
        }
        candidates.extend(self.ball(vertex).iter().map(|e| vec![*e]));
        let vicinity = self.vicinity(vertex, labels);
        let mut best: Option<Change> = None;
        for elements in candidates {
            for label in &around {
                if elements.iter().any(|e| labels[*e as usize] == *label) {
                    continue;
                }
                // Where Euler numbers count, a change that gains less may be better.
                let most = best.as_ref().filter(|_| euler.is_none()).map_or(-1, |b| b.cost.1);
                let Some(gain) = self.gain_within(&vicinity, &elements, *label, labels, most) else { continue };
                let changes = euler.map(|_| self.euler_changes(&elements, *label, labels)).unwrap_or_default();
                let off = euler.map_or(0, |e| e.distance_after(&changes));
                if best.as_ref().is_some_and(|b| (off, gain) > (b.cost.0, b.cost.1)) {
                    continue;
                }
                let Some(lost) = voxels_lost(labels, &elements, *label) else { continue };
                let cost = (off, gain, lost, elements.len());
                if best.as_ref().is_none_or(|b| cost < b.cost) {
                    best = Some(Change { cost, elements: elements.clone(), label: *label, euler: changes });
                }
            }
        }
        best
    }

    fn vicinity(&self, vertex: u32, labels: &[Label]) -> Vicinity {
        let vertices = self.vertices_of(self.ball(vertex));
        let links: Vec<Option<Links>> = vertices.iter().map(|v| self.has_links(*v).then(|| self.links(*v))).collect();
        let excess =
            vertices.iter().zip(&links).map(|(v, known)| self.excess_with(*v, labels, known.as_ref())).collect();
        let center = vertices.partition_point(|other| *other < vertex);
        Vicinity { vertices, links, excess, center }
    }

    /// As [`gain`](Self::gain), for elements around the vertex of a vicinity; `None` above `most`.
    fn gain_within(
        &self,
        vicinity: &Vicinity,
        elements: &[u32],
        label: Label,
        labels: &mut [Label],
        most: i64,
    ) -> Option<i64> {
        let place = |v: u32| vicinity.vertices.partition_point(|other| *other < v);
        let mut places: Vec<usize> = self.vertices_of(elements).into_iter().map(place).collect();
        let mut gain: i64 = -places.iter().map(|at| vicinity.excess[*at]).sum::<i64>();
        // Most changes that do not help leave the pinch in the middle: no excess is below zero, so that tells.
        if let Some(at) = places.iter().position(|at| *at == vicinity.center) {
            places.swap(0, at);
        }
        let old: Vec<Label> = elements.iter().map(|e| labels[*e as usize]).collect();
        elements.iter().for_each(|e| labels[*e as usize] = label);
        for at in places {
            gain += self.excess_with(vicinity.vertices[at], labels, vicinity.links[at].as_ref());
            if gain > most {
                break;
            }
        }
        elements.iter().zip(old).for_each(|(e, l)| labels[*e as usize] = l);
        (gain <= most).then_some(gain)
    }

    /// Change of the sum of excesses when `elements` take `label`.
    pub(super) fn gain(&self, elements: &[u32], label: Label, labels: &mut [Label]) -> i64 {
        let vertices = self.vertices_of(elements);
        let sum = |labels: &[Label]| vertices.iter().map(|v| self.excess(*v, labels)).sum::<i64>();
        let before = sum(labels);
        let old: Vec<Label> = elements.iter().map(|e| labels[*e as usize]).collect();
        elements.iter().for_each(|e| labels[*e as usize] = label);
        let after = sum(labels);
        elements.iter().zip(old).for_each(|(e, l)| labels[*e as usize] = l);
        after - before
    }
}

/// Marks of all elements of a ball of one to [`MOST_COUNTED`].
pub(super) fn all_marks(count: usize) -> u128 {
    u128::MAX >> (MOST_COUNTED - count)
}

/// Marks of the elements of a ball for which it is true.
pub(super) fn marks_of(is_in: impl Iterator<Item = bool>) -> u128 {
    is_in.enumerate().fold(0u128, |marks, (at, is_in)| marks | u128::from(is_in) << at)
}

/// Number of connected groups among the marked elements.
pub(super) fn group_count(marks: u128, links: &[[u8; 3]; MOST_COUNTED]) -> usize {
    let (mut rest, mut count) = (marks, 0);
    while rest != 0 {
        count += 1;
        let mut waiting = rest & rest.wrapping_neg();
        rest &= !waiting;
        while waiting != 0 {
            let at = waiting.trailing_zeros() as usize;
            waiting &= waiting - 1;
            let near = links[at].iter().fold(0u128, |near, link| near | 1 << link);
            waiting |= near & rest;
            rest &= !near;
        }
    }
    count
}

/// The corners of a tet beside one of them.
#[inline]
pub(super) fn opposite_to(vertex: u32, tet: [u32; 4]) -> [u32; 3] {
    let at = tet.iter().position(|v| *v == vertex).unwrap_or(0);
    TET_FACES[at].map(|v| tet[v])
}

/// What triangles of a sphere span of those of their corners that count: parts, connected also through corners, and Euler number.
pub(super) fn shape_of(triangles: impl Iterator<Item = [u32; 3]>, counts: impl Fn(u32) -> bool) -> (i64, i64) {
    let (mut corners, mut sides, mut faces) = (Vec::new(), Vec::new(), 0);
    for triangle in triangles {
        let is_in = triangle.map(&counts);
        let pairs = [[0, 1], [1, 2], [0, 2]].into_iter().filter(|[a, b]| is_in[*a] && is_in[*b]);
        sides.extend(pairs.map(|[a, b]| [triangle[a].min(triangle[b]), triangle[a].max(triangle[b])]));
        corners.extend(triangle.into_iter().zip(is_in).filter(|(_, is_in)| *is_in).map(|(v, _)| v));
        faces += i64::from(is_in == [true; 3]);
    }
    corners.sort_unstable();
    corners.dedup();
    sides.sort_unstable();
    sides.dedup();
    let mut parents: Vec<u32> = (0..corners.len() as u32).collect();
    let place = |v: u32| corners.partition_point(|corner| *corner < v) as u32;
    let joined = sides.iter().filter(|[a, b]| unite(&mut parents, place(*a), place(*b))).count();
    let parts = (corners.len() - joined) as i64;
    (parts, corners.len() as i64 - sides.len() as i64 + faces)
}

/// The labels of some elements, each once, in order.
pub(super) fn labels_of(elements: &[u32], labels: &[Label]) -> Vec<Label> {
    let mut found: Vec<Label> = elements.iter().map(|e| labels[*e as usize]).collect();
    found.sort_unstable();
    found.dedup();
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::face_adjacency::neighbors_of;

    fn one_thread() -> RunContext {
        RunContext::with_threads(1).unwrap()
    }

    /// The eight tets of an octahedron around vertex 0, with their neighbours; vertices 1 to 3 and 4 to 6 are opposite to each
    /// other.
    fn octahedron() -> (Vec<[u32; 4]>, Vec<[u32; 4]>) {
        let corner = |octant: u32, axis: u32| 1 + axis + 3 * (octant >> axis & 1);
        let tets: Vec<[u32; 4]> = (0..8).map(|o| [0, corner(o, 0), corner(o, 1), corner(o, 2)]).collect();
        let neighbors = neighbors_of(&tets, 7, &one_thread()).unwrap();
        (tets, neighbors)
    }

    #[test]
    fn labels_around_a_closed_vertex_are_counted_by_marks_as_by_lists() {
        let (tets, neighbors) = octahedron();
        let topology = InterfaceTopology::new(&tets, &neighbors, 7, &one_thread()).unwrap();
        assert!(!topology.is_open(0) && (1..7).all(|v| topology.is_open(v)));
        let mut pinched = 0;
        for pattern in 0u32..3u32.pow(8) {
            for names in [[0, 1, 2], [1, 2, 3]] {
                let labels: Vec<Label> = (0..8).map(|o| Label(names[(pattern / 3u32.pow(o) % 3) as usize])).collect();
                assert_eq!(topology.excess(0, &labels), topology.excess_of_all(0, &labels), "{labels:?}");
                pinched += usize::from(topology.excess(0, &labels) > 0);
                let is_mixed =
                    |v: &u32| topology.is_mixed(*v, &labels) == (topology.labels_around(*v, &labels).len() > 1);
                assert!((0..7).all(|v| is_mixed(&v)), "{labels:?}");
            }
        }
        // Two opposite corners apart, for one.
        assert!(pinched > 0 && topology.excess(0, &[1, 0, 0, 0, 0, 0, 0, 1].map(Label)) == 1);
    }

    #[test]
    fn labels_around_an_open_vertex_are_counted_by_discs_as_by_lists() {
        let (tets, _) = octahedron();
        let mut found = [0; 2];
        // Every set of elements but all, with two labels and the background.
        for pattern in 1u32..3u32.pow(8) {
            let digits = (0..8).map(|o| pattern / 3u32.pow(o) % 3);
            let left: Vec<([u32; 4], Label)> =
                tets.iter().zip(digits).filter(|(_, d)| *d > 0).map(|(tet, d)| (*tet, Label(d as u16))).collect();
            let (tets, mut labels): (Vec<[u32; 4]>, Vec<Label>) = left.into_iter().unzip();
            let neighbors = neighbors_of(&tets, 7, &one_thread()).unwrap();
            let topology = InterfaceTopology::new(&tets, &neighbors, 7, &one_thread()).unwrap();
            for _ in 0..2 {
                for v in (0..7).filter(|v| topology.is_open(*v)) {
                    let excess = topology.excess_of_all(v, &labels);
                    assert_eq!(topology.excess(v, &labels), excess, "{tets:?} {labels:?} {v}");
                    found[usize::from(excess > 0)] += 1;
                }
                labels[0] = Label::BACKGROUND;
            }
        }
        assert!(found.iter().all(|count| *count > 1000), "{found:?}");
    }

    #[test]
    fn an_element_is_simple_where_both_labels_keep_their_shape() {
        let (tets, neighbors) = octahedron();
        let topology = InterfaceTopology::new(&tets, &neighbors, 7, &one_thread()).unwrap();
        let mut found = [0; 2];
        for pattern in 0u32..256 {
            let mut labels: Vec<Label> = (0..8).map(|o| Label(1 + (pattern >> o & 1) as u16)).collect();
            for e in 0..8 {
                let other = Label(3 - labels[e as usize].0);
                let is_simple = topology.is_simple(e, other, &labels);
                found[usize::from(is_simple)] += 1;
                if is_simple {
                    let excess = topology.excess(0, &labels);
                    let changes = topology.euler_changes(&[e], other, &mut labels);
                    assert!(changes.iter().all(|(_, change)| *change == [0; 2]), "{labels:?} {e} {changes:?}");
                    let before = std::mem::replace(&mut labels[e as usize], other);
                    assert!(topology.excess(0, &labels) <= excess, "{labels:?} {e}");
                    labels[e as usize] = before;
                }
            }
        }
        assert!(found[0] > 500 && found[1] > 500, "{found:?}");
    }

    #[test]
    fn a_cancelled_run_looks_for_no_pinches() {
        let tets = [[0, 1, 2, 3], [0, 4, 5, 6]];
        let context = one_thread();
        let neighbors = neighbors_of(&tets, 7, &context).unwrap();
        let topology = InterfaceTopology::new(&tets, &neighbors, 7, &context).unwrap();
        let mut labels = [Label(1); 2];
        assert_eq!(topology.pinched(&labels, &context).unwrap(), [0]);
        context.cancel_token().cancel();
        let cancelled = |result: Result<()>| matches!(result, Err(crate::Error::Cancelled));
        assert!(cancelled(InterfaceTopology::new(&tets, &neighbors, 7, &context).map(|_| ())));
        assert!(cancelled(topology.pinched(&labels, &context).map(|_| ())));
        assert!(cancelled(topology.euler_ranges(&labels, &[[0; 2], [1; 2]], &context).map(|_| ())));
        assert!(cancelled(topology.repair(&mut labels, None, &context, |_, _, _| Some(0)).map(|_| ())));
    }

    #[test]
    fn trials_around_a_vertex_gain_what_they_gain_anywhere() {
        // Three layers of 4 x 4 cubes of six tets each.
        let number = |at: [usize; 3]| (at[0] + 5 * (at[1] + 5 * at[2])) as u32;
        let mut tets: Vec<[u32; 4]> = Vec::new();
        for n in 0..48 {
            for order in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
                let mut at = [n % 4, n / 4 % 4, n / 16];
                let mut tet = [number(at); 4];
                for (corner, axis) in order.into_iter().enumerate() {
                    at[axis] += 1;
                    tet[corner + 1] = number(at);
                }
                tets.push(tet);
            }
        }
        let context = RunContext::with_threads(1).unwrap();
        let neighbors = neighbors_of(&tets, 100, &context).unwrap();
        let topology = InterfaceTopology::new(&tets, &neighbors, 100, &context).unwrap();
        let mut labels: Vec<Label> = (0..tets.len()).map(|e| Label((e * e % 7 % 3) as u16)).collect();
        let mut gains = [0; 2];
        for vertex in [number([2, 2, 1]), number([1, 2, 2]), number([0, 0, 0])] {
            let vicinity = topology.vicinity(vertex, &labels);
            for pair in topology.ball(vertex).windows(2) {
                for label in [0, 1, 2].map(Label) {
                    let gain = topology.gain(pair, label, &mut labels);
                    for most in [i64::MAX, gain, gain - 1] {
                        let within = topology.gain_within(&vicinity, pair, label, &mut labels, most);
                        assert_eq!(within, (gain <= most).then_some(gain));
                    }
                    gains[usize::from(gain > 0)] += i64::from(gain != 0);
                }
            }
        }
        assert!(gains.iter().all(|count| *count > 3), "{gains:?}");
    }
}
