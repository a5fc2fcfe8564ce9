//! What repairs of pinches take over from the round of refinement before: all but what lies around the leaves that were refined.
//!
//! # Method
//! 1. A repair leaves the labels of all elements before and after it, and the vertices that still pinch.
//! 2. After a refinement an element that was there before, whose label before the repair is the same again and that shares no
//!    vertex with a new one, begins with its label after that repair.
//! 3. Around all vertices but those of new elements, and of those with another label than after the repair, all is as that repair left
//!    it. The next one begins with these, and with what was left where one is near.
//!
//! # Source
//! Our own. A round for the sake of topology marks a few dozen leaves of millions.
//!
//! # Limits
//! Not where Euler numbers are to be kept: of several changes at a vertex the best for these is made, which is another once they are
//! others. Of 160 thin shapes one label is off by 1 with repairs taken over, none without.
//!
//! Where the lattice loses background elements, vertices lose elements that have nothing but background around them: none pinches.
//!
//! # Cost
//! 4 bytes an element for each repair that is kept.

use rayon::prelude::*;

use crate::index::{Label, each_once};
use crate::lattice::interface_topology::InterfaceTopology;
use crate::lattice::red_green::CHANGED;

/// Elements per parallel work item.
const CHUNK: usize = 1 << 14;

/// The label of an element that is new since the repair.
const NEW: Label = Label(u16::MAX);

/// The repair of a round.
pub struct LastRepair {
    /// The label of each element before and after, both [`NEW`] where there was no such element.
    labels: Vec<[Label; 2]>,
    /// Vertices that may pinch still, in any order.
    left: Vec<u32>,
}

impl LastRepair {
    /// A repair of elements with the labels `before`, which have those `after` now and may pinch at some vertices still.
    pub fn new(before: &[Label], after: &[Label], left: Vec<u32>) -> Self {
        let labels =
            before.par_iter().zip(after).with_min_len(CHUNK).map(|(before, after)| [*before, *after]).collect();
        Self { labels, left }
    }

    /// The same for the elements after a refinement, with the number that each had before, or [`CHANGED`].
    pub fn renumbered(self, numbers: &[u32]) -> Self {
        let then = |number: &u32| if *number == CHANGED { [NEW; 2] } else { self.labels[*number as usize] };
        let labels = numbers.par_iter().with_min_len(CHUNK).map(then).collect();
        Self { labels, left: self.left }
    }

    /// Gives elements their labels after this repair where nothing has changed; returns the vertices at which a repair can do
    /// something then, and those where it has found nothing to do, both increasing.
    pub fn take_over(self, topology: &InterfaceTopology, labels: &mut [Label]) -> (Vec<u32>, Vec<u32>) {
        let (tets, vertex_count) = (topology.tets, topology.vertex_count());
        let mut is_beside_new = vec![false; vertex_count];
        let new = tets.iter().zip(&self.labels).filter(|(_, then)| then[0] == NEW);
        new.flat_map(|(tet, _)| tet).for_each(|v| is_beside_new[*v as usize] = true);
        let mut has_changed = is_beside_new.clone();
        for ((tet, then), label) in tets.iter().zip(&self.labels).zip(labels) {
            if *label == then[0] && !tet.iter().any(|v| is_beside_new[*v as usize]) {
                *label = then[1];
            }
            if *label != then[1] {
                tet.iter().for_each(|v| has_changed[*v as usize] = true);
            }
        }
        // What a change at a vertex costs depends on what is around the vertices beside it.
        let is_near =
            |v: &u32| topology.ball(*v).iter().any(|e| tets[*e as usize].iter().any(|w| has_changed[*w as usize]));
        let (near, done): (Vec<u32>, Vec<u32>) = self.left.iter().partition(|v| is_near(v));
        near.into_iter().for_each(|v| has_changed[v as usize] = true);
        ((0..vertex_count as u32).filter(|v| has_changed[*v as usize]).collect(), each_once(done.into_iter()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::face_adjacency::neighbors_of;
    use crate::lattice::test_images::{voxel_image, with_lattice};

    #[test]
    fn a_repair_that_takes_over_leaves_nothing_that_one_of_all_would_do() {
        let image = voxel_image(14, |p| 1 + ((p.x * 5.0 + p.y * 3.0 + p.z * p.x).sin() > 0.3) as u16);
        with_lattice(&image, 1.0, |lattice, context| {
            let elements = lattice.elements(context).unwrap();
            let (tets, vertices) = (&elements.tets, lattice.vertices.positions.len());
            let neighbors = neighbors_of(tets, vertices, context).unwrap();
            let topology = InterfaceTopology::new(tets, &neighbors, vertices, context).unwrap();
            // Some elements may not change, so that something is left.
            let cost = |_: &[Label], changed: &[u32], _: Label| changed.iter().all(|e| e % 3 > 0).then_some(0);
            let before = elements.labels.clone();
            let mut after = before.clone();
            let pinched = topology.pinched(&before, context).unwrap();
            let repaired = topology.repair_from(pinched.clone(), &mut after, None, context, cost).unwrap();
            let is_pinched = |v: &u32, labels: &[Label]| topology.excess(*v, labels) > 0;
            let left = repaired.left.iter().filter(|v| is_pinched(v, &after)).count();
            assert!(left > 20 && repaired.changed.len() > 100, "{left} {}", repaired.changed.len());
            let same: Vec<u32> = (0..tets.len() as u32).collect();
            let last = || LastRepair::new(&before, &after, repaired.left.clone());

            // Where nothing is new, nothing is to be done.
            let mut labels = before.clone();
            let (from, done) = last().renumbered(&same).take_over(&topology, &mut labels);
            assert!(labels == after && from.is_empty());
            assert!(repaired.left.iter().all(|v| done.binary_search(v).is_ok()));

            // Some elements are new, and one that is not has another label than before.
            let is_new = |e: u32| lattice.centroid(&tets[e as usize]).distance(glam::DVec3::splat(6.0)) < 1.5;
            let numbers: Vec<u32> = same.iter().map(|e| if is_new(*e) { CHANGED } else { *e }).collect();
            let mut labels = before.clone();
            let of_new = same.iter().filter(|e| is_new(**e));
            of_new.for_each(|e| labels[*e as usize] = Label(1 + (*e % 2) as u16));
            labels[0] = Label(3 - labels[0].0);
            let (from, done) = last().renumbered(&numbers).take_over(&topology, &mut labels);
            assert!(from.len() < pinched.len() && !done.is_empty(), "{} {}", from.len(), done.len());
            let known = [from.clone(), done].concat();
            let pinched = topology.pinched(&labels, context).unwrap();
            assert!(pinched.iter().all(|v| known.contains(v)));
            let repaired = topology.repair_from(from, &mut labels, None, context, cost).unwrap();
            assert!(!repaired.changed.is_empty());
            assert_eq!(topology.repair(&mut labels, None, context, cost).unwrap(), 0);
        });
    }
}
