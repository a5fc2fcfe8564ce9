//! Euler numbers of labels in the mesh beside those of the image, while surfaces still pinch.
//!
//! # Method
//! 1. Where a surface pinches a label has two Euler numbers: as a closed body it has the vertices and edges at which it touches
//!    itself, as an open one it has not. What makes the surface manifold chooses, pinch by pinch.
//! 2. Both are sums over the vertices on surfaces: half of each edge there, a third of each face, a quarter of each element, in
//!    twelfths. A vertex inside of a label adds nothing. So a change of labels is counted at its own vertices only.
//! 3. A choice is good as long as the image's number stays between the two.
//!
//! # Source
//! [KongRosenfeld1989] for the two readings, of voxels there.
//!
//! # Limits
//! The sum over the mesh counts: a tunnel too many in one place and one too few in another hide each other, also from
//! [`super::topology_differences`], which looks at labels whose sums differ.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::index::Label;
use crate::lattice::interface_topology::InterfaceTopology;
use crate::mesh::numbering::TET_FACES;

/// Parts of one that a vertex can add.
const TWELFTHS: i64 = 12;

/// Vertices per parallel work item.
const CHUNK: usize = 4096;

/// Euler numbers of the elements of a label as a closed body, which has the vertices and edges where it touches itself, and as
/// an open one, which has not, in twelfths. A surface that is made manifold ends up with a number between them.
pub type EulerNumbers = [i64; 2];

/// Euler numbers of the labels of a mesh, and those of the image.
#[derive(Debug, Clone)]
pub struct EulerRanges {
    now: Vec<EulerNumbers>,
    wanted: Vec<i64>,
}

impl EulerRanges {
    /// How far a label would be from what is wanted, in twelfths.
    fn distance(&self, label: Label, change: EulerNumbers) -> i64 {
        let [closed, open] = [0, 1].map(|reading| self.now[label.index()][reading] + change[reading]);
        let wanted = self.wanted[label.index()];
        (closed.min(open) - wanted).max(wanted - closed.max(open)).max(0)
    }

    /// How much farther from what is wanted some labels would be after changes.
    pub fn distance_after(&self, changes: &[(Label, EulerNumbers)]) -> i64 {
        changes.iter().map(|(label, change)| self.distance(*label, *change) - self.distance(*label, [0; 2])).sum()
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
        let differs = |label: &Label| self.now[label.index()].iter().any(|n| *n != self.wanted[label.index()]);
        (1..self.now.len() as u16).map(Label).filter(differs).collect()
    }

    /// Euler numbers in the mesh and in the image of a label that has another one than is wanted, whatever becomes of its pinches.
    pub fn out_of_reach(&self, label: Label) -> Option<[i64; 2]> {
        let numbers = [self.now[label.index()][0], self.wanted[label.index()]].map(|n| n / TWELFTHS);
        (self.distance(label, [0; 2]) > 0).then_some(numbers)
    }
}

impl InterfaceTopology<'_> {
    /// The Euler numbers of the labels, whose image has those `wanted`.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn euler_ranges(&self, labels: &[Label], wanted: &[i64], context: &RunContext) -> Result<EulerRanges> {
        let none = || vec![[0i64; 2]; wanted.len()];
        let add = |mut sums: Vec<EulerNumbers>, other: Vec<EulerNumbers>| {
            sums.iter_mut().zip(other).for_each(|(s, o)| *s = [s[0] + o[0], s[1] + o[1]]);
            sums
        };
        let of_vertex = |mut sums: Vec<EulerNumbers>, v: u32| {
            for label in self.labels_around(v, labels).into_iter().filter(|l| !l.is_background()) {
                let [closed, open] = self.euler_at(v, label, labels);
                let sum = &mut sums[label.index()];
                *sum = [sum[0] + closed, sum[1] + open];
            }
            sums
        };
        let vertices = (0..self.vertex_count() as u32).into_par_iter().with_min_len(CHUNK);
        let mixed = context.until_cancelled(vertices).filter(|v| self.is_mixed(*v, labels));
        // Whole numbers: the sums do not depend on the order.
        let now = mixed.fold(none, of_vertex).reduce(none, add);
        context.check()?;
        Ok(EulerRanges { now, wanted: wanted.iter().map(|w| TWELFTHS * w).collect() })
    }

    /// What a vertex adds to the Euler numbers of a label: half of each edge there, a third of each face, a quarter of each
    /// element, in twelfths. Nothing where the label is all around.
    fn euler_at(&self, vertex: u32, label: Label, labels: &[Label]) -> EulerNumbers {
        let own = self.ball(vertex).iter().filter(|e| labels[**e as usize] == label);
        let (mut edges, mut faces) = (Vec::new(), Vec::new());
        let mut elements = 0;
        for element in own {
            let tet = self.tets[*element as usize];
            let at = tet.iter().position(|v| *v == vertex).unwrap_or(0);
            let rest = TET_FACES[at].map(|v| tet[v]);
            edges.extend(rest);
            faces.extend([[0, 1], [1, 2], [0, 2]].map(|[a, b]| [rest[a].min(rest[b]), rest[a].max(rest[b])]));
            elements += 1;
        }
        if elements == 0 {
            return [0; 2];
        }
        edges.sort_unstable();
        faces.sort_unstable();
        let inner_faces = faces.chunk_by(|l, r| l == r).filter(|run| run.len() == 2).count() as i64;
        faces.dedup();
        let mut faces_of_edges: Vec<u32> = faces.as_flattened().to_vec();
        faces_of_edges.sort_unstable();
        // As many faces as elements go around an edge inside.
        let runs = || edges.chunk_by(|l, r| l == r).zip(faces_of_edges.chunk_by(|l, r| l == r));
        let inner_edges = runs().filter(|(elements, faces)| elements.len() == faces.len()).count() as i64;
        let (edges, faces) = (runs().count() as i64, faces.len() as i64);
        [TWELFTHS - 6 * edges + 4 * faces - 3 * elements, 6 * inner_edges - 4 * inner_faces + 3 * elements]
    }

    /// What the Euler numbers of the labels concerned change by when `elements` take `label`.
    pub fn euler_changes(&self, elements: &[u32], label: Label, labels: &mut [Label]) -> Vec<(Label, EulerNumbers)> {
        let mut concerned: Vec<Label> = elements.iter().map(|e| labels[*e as usize]).chain([label]).collect();
        concerned.sort_unstable();
        concerned.dedup();
        concerned.retain(|l| !l.is_background());
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

    /// What the Euler numbers change by when a neighbourhood of some vertices takes a label: it is a closed body there, and the
    /// others are open ones. Edges between the vertices are left out of account.
    pub fn euler_changes_by_filling(
        &self,
        group: &[u32],
        label: Label,
        labels: &[Label],
    ) -> Vec<(Label, EulerNumbers)> {
        let mut around: Vec<Label> = group.iter().flat_map(|v| self.labels_around(*v, labels)).collect();
        around.sort_unstable();
        around.dedup();
        around.retain(|l| !l.is_background());
        let change = |of: Label| {
            let gap: i64 = group.iter().map(|v| self.euler_at_if_mixed(*v, of, labels)).map(|[c, o]| c - o).sum();
            (of, if of == label { [0, gap] } else { [-gap, 0] })
        };
        around.into_iter().map(change).collect()
    }

    fn euler_at_if_mixed(&self, vertex: u32, label: Label, labels: &[Label]) -> EulerNumbers {
        let is_all = !self.is_open(vertex) && self.ball(vertex).iter().all(|e| labels[*e as usize] == label);
        if is_all { [0; 2] } else { self.euler_at(vertex, label, labels) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::face_adjacency::neighbors_of;
    use crate::lattice::test_images::{voxel_image, with_lattice};
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
            let mut ranges = topology.euler_ranges(&elements.labels, &[0, 0, 1], context).unwrap();
            assert!([1, 2].iter().all(|l| ranges.out_of_reach(Label(*l)).is_none()), "{ranges:?}");
            let off = topology.euler_ranges(&elements.labels, &[0, 0, 2], context).unwrap();
            assert!(off.out_of_reach(Label(2)).is_some());
            // Changes of any elements, one after another.
            for step in 0..60 {
                let e = (step * 7919) % elements.tets.len();
                let label = Label((step % 3) as u16);
                let changes = topology.euler_changes(&[e as u32], label, &mut elements.labels);
                elements.labels[e] = label;
                ranges.add(&changes);
            }
            assert_eq!(ranges.now, topology.euler_ranges(&elements.labels, &[0, 0, 1], context).unwrap().now);
        });
    }

    #[test]
    fn two_tets_that_touch_at_a_vertex_are_one_body_closed_and_two_open() {
        let tets = [[0, 1, 2, 3], [0, 4, 5, 6]];
        let context = RunContext::with_threads(1).unwrap();
        let neighbors = neighbors_of(&tets, 7, &context).unwrap();
        let topology = InterfaceTopology::new(&tets, &neighbors, 7, &context).unwrap();
        let labels = [Label(1); 2];
        let ranges = topology.euler_ranges(&labels, &[0, 1], &context).unwrap();
        assert_eq!(ranges.now[1], [TWELFTHS, 2 * TWELFTHS]);
        assert_eq!(ranges.distance_after(&topology.euler_changes_by_filling(&[0], Label(1), &labels)), 0);
        assert_eq!(ranges.distance_after(&topology.euler_changes_by_filling(&[0], Label(0), &labels)), TWELFTHS);
    }
}
