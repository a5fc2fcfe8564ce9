//! Euler numbers of labels in the mesh beside those of the image, while surfaces still pinch.
//!
//! # Method
//! 1. Where a surface pinches a label has two Euler numbers: as a closed body it has the vertices and edges at which it touches
//!    itself, as an open one it has not. What makes the surface manifold chooses, pinch by pinch.
//! 2. Both are sums over the vertices on surfaces: half of each edge there, a third of each face, a quarter of each element, in
//!    twelfths. A vertex inside of a label adds nothing. So a change of labels is counted at its own vertices only.
//! 3. A choice is good as long as one between the image's own stays between the two. Where voxels of a label touch only along an edge
//!    or at a corner the image has two numbers itself, most often.
//! 4. Where a neighbourhood of vertices and of what they span takes a label ([`super::interface_carving`]), that label is joined with a
//!    body that shrinks to what they span, and the others lose it: Euler numbers of unions and of what they share give the changes.
//! 5. All labels together are a body too, whose surface is that of the background: it is counted as that.
//! 6. Where the elements are cut at the border of the image afterwards, the numbers are those of what is left. A plane that meets no
//!    vertex leaves of a closed body what shrinks to the simplices with all corners inside; of an open one, those with any. What
//!    has corners beyond is shared by those inside.
//!
//! # Source
//! [KongRosenfeld1989] for the two readings, of voxels there.
//!
//! # Cost
//! Around a vertex where a surface is one disc, which are nearly all, both numbers follow from the number of its faces there.
//!
//! # Limits
//! The sum over the mesh counts: a tunnel too many in one place and one too few in another hide each other, also from
//! [`super::topology_differences`], which looks at labels whose sums differ.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::index::Label;
use crate::lattice::face_adjacency::OUTSIDE;
use crate::lattice::interface_topology::{
    AtBorder, InterfaceTopology, Links, MOST_COUNTED, all_marks, group_count, marks_of, opposite_to,
};
use crate::mesh::numbering::TET_FACES;

/// Parts of one that a vertex can add.
const TWELFTHS: i64 = 12;

/// Vertices per parallel work item.
const CHUNK: usize = 4096;

/// Euler numbers of the elements of a label as a closed body, which has the vertices and edges where it touches itself, and as
/// an open one, which has not, in twelfths. A surface that is made manifold ends up with a number between them.
pub type EulerNumbers = [i64; 2];

/// Euler numbers of the labels of a mesh, and those of the image; those of the background are of all labels together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EulerRanges {
    now: Vec<EulerNumbers>,
    /// The least and the largest of the image.
    wanted: Vec<[i64; 2]>,
}

impl EulerRanges {
    /// How far a label would be from what is wanted, in twelfths.
    fn distance(&self, label: Label, change: EulerNumbers) -> i64 {
        let [least, largest] = self.wanted[label.index()];
        let [closed, open] = [0, 1].map(|reading| self.now[label.index()][reading] + change[reading]);
        (closed.min(open) - largest).max(least - closed.max(open)).max(0)
    }

    /// How much farther from what is wanted some labels would be after changes. Labels of which the image has two numbers do not
    /// count: where one touches itself contacts are resolved one by one, and no sum says how.
    pub fn distance_after(&self, changes: &[(Label, EulerNumbers)]) -> i64 {
        let has_one = |label: Label| self.wanted[label.index()][0] == self.wanted[label.index()][1];
        let farther =
            |(label, change): &(Label, EulerNumbers)| self.distance(*label, *change) - self.distance(*label, [0; 2]);
        changes.iter().filter(|(label, _)| has_one(*label)).map(farther).sum()
    }

    /// The labels that have another Euler number than is wanted, whatever becomes of their pinches.
    pub fn all_out_of_reach(&self) -> Vec<Label> {
        let mut differing = self.differing();
        differing.retain(|label| self.out_of_reach(*label).is_some());
        differing
    }

    /// Whether a label is nearer to what is wanted than with other numbers, and none is farther.
    pub fn is_nearer_than(&self, other: &Self) -> bool {
        let distances = |of: &Self| (1..of.now.len() as u16).map(|l| of.distance(Label(l), [0; 2])).collect::<Vec<_>>();
        let (here, there) = (distances(self), distances(other));
        here != there && here.iter().zip(&there).all(|(here, there)| here <= there)
    }

    /// Takes changes into account.
    pub fn add(&mut self, changes: &[(Label, EulerNumbers)]) {
        for (label, change) in changes {
            let now = &mut self.now[label.index()];
            *now = [now[0] + change[0], now[1] + change[1]];
        }
    }

    /// The labels that have, or may have once nothing pinches, another Euler number than is wanted.
    pub fn differing(&self) -> Vec<Label> {
        let differs = |label: &Label| {
            let [least, largest] = self.wanted[label.index()];
            self.now[label.index()].iter().any(|n| *n < least || *n > largest)
        };
        (1..self.now.len() as u16).map(Label).filter(differs).collect()
    }

    /// Euler numbers in the mesh and in the image, the nearest there, of a label that has another one than is wanted, whatever
    /// becomes of its pinches.
    pub fn out_of_reach(&self, label: Label) -> Option<[i64; 2]> {
        let [least, largest] = self.wanted[label.index()];
        let now = self.now[label.index()][0];
        (self.distance(label, [0; 2]) > 0).then(|| [now, now.clamp(least, largest)].map(|n| n / TWELFTHS))
    }
}

/// What the Euler numbers of a label change by when a neighbourhood of some vertices becomes part of it, or of something else.
#[derive(Debug, Clone, Copy)]
pub struct Filling {
    label: Label,
    joined: EulerNumbers,
    taken: EulerNumbers,
}

/// The changes when the neighbourhood takes a label.
pub fn changes_by_filling(fillings: &[Filling], label: Label) -> Vec<(Label, EulerNumbers)> {
    let change = |of: &Filling| (of.label, if label.is_in_solid_of(of.label) { of.joined } else { of.taken });
    fillings.iter().map(change).collect()
}

impl InterfaceTopology<'_> {
    /// The Euler numbers of the labels; `wanted` are both readings of the image.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn euler_ranges(&self, labels: &[Label], wanted: &[[i64; 2]], context: &RunContext) -> Result<EulerRanges> {
        let none = || vec![[0i64; 2]; wanted.len()];
        let add = |mut sums: Vec<EulerNumbers>, other: Vec<EulerNumbers>| {
            sums.iter_mut().zip(other).for_each(|(s, o)| *s = [s[0] + o[0], s[1] + o[1]]);
            sums
        };
        let of_vertex = |mut sums: Vec<EulerNumbers>, v: u32| {
            let links = self.is_counted_by_faces(v).then(|| self.links(v));
            let mut around = self.labels_around(v, labels);
            if self.at_border(v) == AtBorder::Next && around.first() != Some(&Label::BACKGROUND) {
                // All labels together are cut too.
                around.push(Label::BACKGROUND);
            }
            for label in around {
                let [closed, open] = self.euler_at(v, label, labels, links.as_ref());
                let sum = &mut sums[label.index()];
                *sum = [sum[0] + closed, sum[1] + open];
            }
            sums
        };
        let vertices = (0..self.vertex_count() as u32).into_par_iter().with_min_len(CHUNK);
        let adds = |v: &u32| match self.at_border(*v) {
            AtBorder::Within => self.is_mixed(*v, labels),
            AtBorder::Next => true,
            AtBorder::Beyond => false,
        };
        let adding = context.until_cancelled(vertices).filter(adds);
        // Whole numbers: the sums do not depend on the order.
        let now = adding.fold(none, of_vertex).reduce(none, add);
        context.check()?;
        let of_label = |[one, other]: &[i64; 2]| [one.min(other), one.max(other)].map(|n| TWELFTHS * n);
        Ok(EulerRanges { now, wanted: wanted.iter().map(of_label).collect() })
    }

    /// Whether what a vertex adds follows from its faces where a surface is one disc there.
    fn is_counted_by_faces(&self, vertex: u32) -> bool {
        self.has_links(vertex) && self.at_border(vertex) == AtBorder::Within
    }

    /// What a vertex on the surface of a label adds to its Euler numbers; the links of the vertex, if it has them.
    fn euler_at(&self, vertex: u32, label: Label, labels: &[Label], links: Option<&Links>) -> EulerNumbers {
        let is_in = |e: &u32| labels[*e as usize].is_in_solid_of(label);
        match links.and_then(|links| faces_of_disc(self.ball(vertex).iter().map(is_in), links)) {
            // One disc on the sphere around: of corners, sides and triangles, counted as below, its rim is left.
            Some(faces) => [TWELFTHS / 2 - faces; 2],
            None => self.euler_by_lists(vertex, label, labels),
        }
    }

    /// As [`euler_at`](Self::euler_at), whatever the surface is there: half of each edge, a third of each face, a quarter of each
    /// element, in twelfths; where corners lie beyond the border, more of what is inside there.
    fn euler_by_lists(&self, vertex: u32, label: Label, labels: &[Label]) -> EulerNumbers {
        if self.at_border(vertex) == AtBorder::Beyond {
            return [0; 2];
        }
        let own = self.ball(vertex).iter().filter(|e| labels[**e as usize].is_in_solid_of(label));
        let (mut edges, mut faces) = (Vec::new(), Vec::new());
        let beyond =
            |corners: &[u32]| corners.iter().filter(|v| self.at_border(**v) == AtBorder::Beyond).count() as i64;
        // What a simplex of the vertex and others adds to a closed body and to an open one.
        let shares = |others: &[u32]| {
            let count = others.len() as i64 + 1;
            match beyond(others) {
                0 => [TWELFTHS / count; 2],
                outside => [0, TWELFTHS / (count - outside)],
            }
        };
        let mut of_elements = [0; 2];
        let mut elements = 0;
        for element in own {
            let rest = opposite_to(vertex, self.tets[*element as usize]);
            edges.extend(rest);
            faces.extend([[0, 1], [1, 2], [0, 2]].map(|[a, b]| [rest[a].min(rest[b]), rest[a].max(rest[b])]));
            let share = shares(&rest);
            of_elements = [of_elements[0] + share[0], of_elements[1] + share[1]];
            elements += 1;
        }
        if elements == 0 {
            return [0; 2];
        }
        edges.sort_unstable();
        faces.sort_unstable();
        // Inside of the body are faces with two elements, and edges that as many faces as elements go around.
        let of_faces = faces.chunk_by(|l, r| l == r).fold([0; 2], |sum, run| {
            let share = shares(&run[0]);
            [sum[0] + share[0], sum[1] + if run.len() == 2 { share[1] } else { 0 }]
        });
        faces.dedup();
        let mut faces_of_edges: Vec<u32> = faces.as_flattened().to_vec();
        faces_of_edges.sort_unstable();
        let runs = edges.chunk_by(|l, r| l == r).zip(faces_of_edges.chunk_by(|l, r| l == r));
        let of_edges = runs.fold([0; 2], |sum, (elements, faces)| {
            let share = shares(&elements[..1]);
            let is_inner = elements.len() == faces.len();
            [sum[0] + share[0], sum[1] + if is_inner { share[1] } else { 0 }]
        });
        if of_edges[0] == 0 {
            // Nothing else of the body is inside around a tip: it goes with the cut, or as a piece without a voxel.
            return [0; 2];
        }
        // The vertex itself is inside where all around it is: its faces and edges and nothing else.
        let is_inner = !self.is_open(vertex) && elements == self.ball(vertex).len();
        let own = if is_inner { TWELFTHS } else { 0 };
        [TWELFTHS - of_edges[0] + of_faces[0] - of_elements[0], of_edges[1] - of_faces[1] + of_elements[1] - own]
    }

    /// What the Euler numbers of the labels concerned change by when `elements` take `label`.
    pub fn euler_changes(&self, elements: &[u32], label: Label, labels: &mut [Label]) -> Vec<(Label, EulerNumbers)> {
        let mut concerned: Vec<Label> = elements.iter().map(|e| labels[*e as usize]).chain([label]).collect();
        concerned.sort_unstable();
        concerned.dedup();
        let vertices = self.vertices_of(elements);
        let sum = |of: Label, labels: &[Label]| {
            let add = |sum: EulerNumbers, at: EulerNumbers| [sum[0] + at[0], sum[1] + at[1]];
            vertices.iter().map(|v| self.euler_at_if_mixed(*v, of, labels)).fold([0; 2], add)
        };
        let before: Vec<EulerNumbers> = concerned.iter().map(|l| sum(*l, labels)).collect();
        let old: Vec<Label> = elements.iter().map(|e| labels[*e as usize]).collect();
        elements.iter().for_each(|e| labels[*e as usize] = label);
        let after: Vec<EulerNumbers> = concerned.iter().map(|l| sum(*l, labels)).collect();
        elements.iter().zip(old).for_each(|(e, l)| labels[*e as usize] = l);
        let difference = |(b, a): (EulerNumbers, EulerNumbers)| [a[0] - b[0], a[1] - b[1]];
        concerned.into_iter().zip(before.into_iter().zip(after).map(difference)).collect()
    }

    /// What the Euler numbers of each label around change by when a neighbourhood of some vertices, in order, takes a label.
    pub fn fillings_of(&self, group: &[u32], labels: &[Label]) -> Vec<Filling> {
        let mut around: Vec<Label> = group.iter().flat_map(|v| self.labels_around(*v, labels)).collect();
        around.sort_unstable();
        around.dedup();
        let mut fillings: Vec<Filling> =
            around.into_iter().map(|label| Filling { label, joined: [0; 2], taken: [0; 2] }).collect();
        for v in group {
            for simplex in self.simplices_from(*v, group, labels).chunk_by(|l, r| l.0 == r.0) {
                let corners = simplex[0].0.iter().filter(|v| **v != u32::MAX);
                let is_beyond = |v: &&u32| self.at_border(**v) == AtBorder::Beyond;
                let is_in_group = |v: &&u32| group.binary_search(v).is_ok();
                // Around vertices beyond the border nothing that is left changes.
                if corners.clone().filter(|v| !is_beyond(v)).all(|v| !is_in_group(&v)) {
                    continue;
                }
                let is_cut = corners.clone().any(|v| is_beyond(&v));
                let is_within = corners.clone().all(|v| is_in_group(&v));
                let sign = if corners.count() % 2 == 1 { TWELFTHS } else { -TWELFTHS };
                let is_outside = simplex[0].1.is_none();
                for filling in &mut fillings {
                    for (side, is_body) in [true, false].into_iter().enumerate() {
                        // At the outside of the lattice the rest goes on, whatever is filled.
                        if is_outside && !is_body {
                            continue;
                        }
                        let is_on_side = simplex
                            .iter()
                            .any(|(_, own)| own.is_some_and(|own| own.is_in_solid_of(filling.label) == is_body));
                        // What the neighbourhood joins gets what its vertices span and did not have; what it is taken from loses that,
                        // but for the rim, where what is cut has one dimension less.
                        let joins = if is_within && !is_on_side && !(is_cut && is_body) { sign } else { 0 };
                        let leaves = if is_on_side { -sign } else { 0 };
                        let (joined, taken) = if is_body { (joins, leaves) } else { (leaves, joins) };
                        filling.joined[side] += joined;
                        filling.taken[side] += taken;
                    }
                }
            }
        }
        fillings
    }

    /// The simplices whose first vertex of a group is a given one, in order, each with the labels of the elements that have it, after
    /// `None` where it is at the outside of the lattice; unused corners are last.
    fn simplices_from(&self, vertex: u32, group: &[u32], labels: &[Label]) -> Vec<([u32; 4], Option<Label>)> {
        let mut simplices = Vec::new();
        for element in self.ball(vertex) {
            let tet = self.tets[*element as usize];
            let outside = (0..4).filter(|face| self.neighbors[*element as usize][*face] == OUTSIDE);
            let open_faces: Vec<u32> = outside.map(|face| TET_FACES[face].iter().map(|v| 1 << v).sum()).collect();
            for set in 1..16 {
                let mut corners: [u32; 4] = std::array::from_fn(|i| if set >> i & 1 == 1 { tet[i] } else { u32::MAX });
                corners.sort_unstable();
                if corners.iter().find(|v| group.binary_search(v).is_ok()) == Some(&vertex) {
                    simplices.push((corners, Some(labels[*element as usize])));
                    if open_faces.iter().any(|face| set & !face == 0) {
                        simplices.push((corners, None));
                    }
                }
            }
        }
        simplices.sort_unstable();
        simplices.dedup();
        simplices
    }

    fn euler_at_if_mixed(&self, vertex: u32, label: Label, labels: &[Label]) -> EulerNumbers {
        let is_in = |e: &u32| labels[*e as usize].is_in_solid_of(label);
        let is_within = self.at_border(vertex) == AtBorder::Within;
        if is_within && !self.is_open(vertex) && self.ball(vertex).iter().all(is_in) {
            return [0; 2];
        }
        let links = self.is_counted_by_faces(vertex).then(|| self.links(vertex));
        self.euler_at(vertex, label, labels, links.as_ref())
    }
}

/// The number of faces around a vertex between what is in a body and the rest, where they are one disc; `is_in` tells for each
/// element of the ball.
fn faces_of_disc(is_in: impl ExactSizeIterator<Item = bool>, links: &Links) -> Option<i64> {
    let all = all_marks(is_in.len());
    let own = marks_of(is_in);
    (group_count(own, links) == 1 && group_count(all & !own, links) == 1).then(|| {
        let of_element = |at: usize| links[at].iter().filter(|link| own >> **link & 1 == 0).count() as i64;
        (0..MOST_COUNTED).filter(|at| own >> at & 1 == 1).map(of_element).sum()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::bcc_lattice::PastBorder;
    use crate::lattice::face_adjacency::neighbors_of;
    use crate::lattice::test_images::{euler_numbers_where, foam, voxel_image, with_lattice, with_lattice_past};
    use glam::DVec3;

    #[test]
    fn euler_numbers_are_those_of_known_bodies_and_changes_add_up() {
        // A ring around the z axis, whose Euler number is 0, and a ball apart from it.
        let image = voxel_image(24, |p| {
            let [x, y, z] = (p - DVec3::new(11.2, 11.4, 7.3)).to_array();
            let ring = (x.hypot(y) - 7.0).hypot(z) < 3.2;
            if ring { 1 } else { 2 * u16::from(p.distance(DVec3::new(11.2, 11.4, 17.6)) < 4.3) }
        });
        with_lattice(&image, 1.0, |lattice, context| {
            let mut elements = lattice.elements(context).unwrap();
            let vertices = lattice.vertices.positions.len();
            let neighbors = neighbors_of(&elements.tets, vertices, context).unwrap();
            let topology = InterfaceTopology::new(&elements.tets, &neighbors, vertices, context).unwrap();
            let mut ranges = topology.euler_ranges(&elements.labels, &[[0; 2], [0; 2], [1; 2]], context).unwrap();
            assert!([1, 2].iter().all(|l| ranges.out_of_reach(Label(*l)).is_none()), "{ranges:?}");
            let off = topology.euler_ranges(&elements.labels, &[[0; 2], [0; 2], [2; 2]], context).unwrap();
            assert!(off.out_of_reach(Label(2)).is_some());
            // Changes of any elements, one after another.
            for step in 0..60 {
                let e = (step * 7919) % elements.tets.len();
                let label = Label((step % 3) as u16);
                let changes = topology.euler_changes(&[e as u32], label, &mut elements.labels);
                elements.labels[e] = label;
                ranges.add(&changes);
            }
            assert_eq!(
                ranges.now,
                topology.euler_ranges(&elements.labels, &[[0; 2], [0; 2], [1; 2]], context).unwrap().now
            );
        });
    }

    #[test]
    fn numbers_of_elements_cut_at_the_border_are_those_of_what_is_left() {
        with_lattice_past(PastBorder::Continued, &foam(13), 2.3, |lattice, context| {
            let mut elements = lattice.elements(context).unwrap();
            let positions = &lattice.vertices.positions;
            let inside: Vec<bool> = positions.iter().map(|p| lattice.field.contains(lattice.frame.local(*p))).collect();
            let neighbors = neighbors_of(&elements.tets, positions.len(), context).unwrap();
            let mut topology = InterfaceTopology::new(&elements.tets, &neighbors, positions.len(), context).unwrap();
            let numbers = |topology: &InterfaceTopology, labels: &[Label]| {
                topology.euler_ranges(labels, &[[0; 2]; 4], context).unwrap().now
            };
            let whole = numbers(&topology, &elements.labels);
            topology.cut_at_border(&inside);
            let mut ranges = topology.euler_ranges(&elements.labels, &[[0; 2]; 4], context).unwrap();
            let closed: Vec<i64> = ranges.now[1..].iter().map(|now| now[0] / TWELFTHS).collect();
            assert_eq!(closed, euler_numbers_where(&elements.tets, &elements.labels, |v| inside[v as usize]));
            assert!(
                ranges.now != whole && ranges.now.as_flattened().iter().all(|now| now % TWELFTHS == 0),
                "{ranges:?}"
            );
            for step in 0..40 {
                let (e, label) = ((step * 7919) % elements.tets.len(), Label(1 + (step % 3) as u16));
                let changes = topology.euler_changes(&[e as u32], label, &mut elements.labels);
                elements.labels[e] = label;
                ranges.add(&changes);
            }
            assert_eq!(ranges.now[1..], numbers(&topology, &elements.labels)[1..]);
        });
    }

    #[test]
    fn two_tets_that_touch_at_a_vertex_are_one_body_closed_and_two_open() {
        let tets = [[0, 1, 2, 3], [0, 4, 5, 6]];
        let context = RunContext::with_threads(1).unwrap();
        let neighbors = neighbors_of(&tets, 7, &context).unwrap();
        let topology = InterfaceTopology::new(&tets, &neighbors, 7, &context).unwrap();
        let labels = [Label(1); 2];
        let ranges = topology.euler_ranges(&labels, &[[0; 2], [1; 2]], &context).unwrap();
        assert_eq!(ranges.now[1], [TWELFTHS, 2 * TWELFTHS]);
        let fillings = topology.fillings_of(&[0], &labels);
        assert_eq!(ranges.distance_after(&changes_by_filling(&fillings, Label(1))), 0);
        // All labels together are that one.
        assert_eq!(ranges.distance_after(&changes_by_filling(&fillings[1..], Label(0))), TWELFTHS);
    }

    #[test]
    fn any_number_between_the_readings_of_the_image_will_do() {
        let tets = [[0, 1, 2, 3], [4, 5, 6, 7]];
        let context = RunContext::with_threads(1).unwrap();
        let neighbors = neighbors_of(&tets, 8, &context).unwrap();
        let topology = InterfaceTopology::new(&tets, &neighbors, 8, &context).unwrap();
        let ranges = |wanted: [i64; 2]| topology.euler_ranges(&[Label(1); 2], &[[2; 2], wanted], &context).unwrap();
        for within in [[2, 2], [1, 3], [3, 1], [2, 5]] {
            let ranges = ranges(within);
            assert_eq!((ranges.differing(), ranges.out_of_reach(Label(1))), (vec![], None), "{within:?}");
        }
        for (beyond, nearest) in [([1, 1], 1), ([3, 5], 3), ([1, -4], 1)] {
            let ranges = ranges(beyond);
            assert_eq!((ranges.differing(), ranges.out_of_reach(Label(1))), (vec![Label(1)], Some([2, nearest])));
            // A choice keeps only what the image has one reading of.
            let is_kept = ranges.distance_after(&[(Label(1), [5 * TWELFTHS; 2])]) != 0;
            assert_eq!(is_kept, beyond[0] == beyond[1], "{beyond:?}");
        }
    }
}
