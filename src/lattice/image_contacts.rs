//! Which labels touch in the image, so that a relabelling does not pierce a wall that is one element thick.
//!
//! # Method
//! 1. Elements may take a label only if each label that they then have a face with lies face to face with it in the image, near
//!    that face.
//! 2. A face between labels that the image keeps apart is a breach where a label beside it touches both: the lattice has opened
//!    a wall. Not where two such labels are kept apart themselves: four labels meet there along a line, of which two have to touch.
//! ```text
//!    1 1 2 0 0        a wall (2) one voxel thick: labels 1 and 0 meet at corners of voxels only. Where the wall pinches at a
//!    1 1 1 2 0        vertex, giving elements of the wall to label 1 or 0 would mend the pinch, and open the wall;
//!    1 1 1 2 0        giving elements of 1 or 0 to the wall mends it too
//! ```
//! # Source
//! Our own; two voxels touch that share a face, the 6-adjacency of [KongRosenfeld1989].
//!
//! # Invariants
//! A relabelling makes no contact between labels that the image keeps apart there.

use glam::DVec3;
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::label_contacts;
use crate::index::Label;
use crate::lattice::bcc_lattice::{Field, floor_of};
use crate::lattice::face_adjacency::OUTSIDE;
use crate::lattice::interface_topology::{InterfaceTopology, labels_of};
use crate::lattice::red_green::RedGreenLattice;
use crate::lattice::voxel_fidelity::voxels_of;
use crate::mesh::numbering::TET_FACES;

/// A contact of the image counts up to this far from the face, in voxels along each axis: elements at boundaries are up to two
/// voxels long.
const REACH: i32 = 2;

/// Elements per parallel work item.
const CHUNK: usize = 4096;

/// Faces between labels that the image keeps apart, between two looks at whether the run is cancelled.
const FACES_PER_CHECK: usize = 1024;

/// Elements whose contacts are compared with those of the image.
pub struct ImageContacts<'a> {
    lattice: &'a RedGreenLattice<'a>,
    tets: &'a [[u32; 4]],
    neighbors: &'a [[u32; 4]],
}

impl<'a> ImageContacts<'a> {
    /// The contacts of elements with their neighbours through faces.
    pub fn new(lattice: &'a RedGreenLattice<'a>, tets: &'a [[u32; 4]], neighbors: &'a [[u32; 4]]) -> Self {
        Self { lattice, tets, neighbors }
    }

    /// Whether elements may take a label: the image has each contact that they have then.
    pub fn allow(&self, labels: &[Label], elements: &[u32], label: Label) -> bool {
        elements.iter().all(|e| {
            let own = labels[*e as usize];
            let row = &self.neighbors[*e as usize];
            let label_behind = |near: u32| (near != OUTSIDE).then(|| labels[near as usize]);
            // What it was and what it becomes touch here already.
            let is_known = row.iter().any(|near| label_behind(*near) == Some(label));
            (0..4).all(|face| {
                let Some(other) = label_behind(row[face]) else { return true };
                other == label
                    || (other == own && is_known)
                    || elements.contains(&row[face])
                    || touch_near(&self.lattice.field, self.center(*e, face), [label, other])
            })
        })
    }

    /// The voxels of their own labels that lie in elements and are lost to these when the elements take a label; `None` where these may
    /// not ([`allow`](Self::allow)).
    pub fn voxels_lost(&self, labels: &[Label], elements: &[u32], label: Label) -> Option<usize> {
        let of_element = |e: &u32| voxels_of(self.lattice, &self.tets[*e as usize], labels[*e as usize]);
        self.allow(labels, elements, label).then(|| elements.iter().map(of_element).sum())
    }

    /// The vertices of the breaches at some vertices, each once, in order.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn breached(
        &self,
        labels: &[Label],
        topology: &InterfaceTopology,
        is_candidate: impl Fn(u32) -> bool + Sync + Send,
        context: &RunContext,
    ) -> Result<Vec<u32>> {
        let sides = |e: u32, face: usize| {
            let near = self.neighbors[e as usize][face];
            (near != OUTSIDE).then(|| [labels[e as usize], labels[near as usize]])
        };
        let touch = |e: u32, face: usize, pair: [Label; 2]| touch_near(&self.lattice.field, self.center(e, face), pair);
        let is_apart = |e: u32, face: usize| sides(e, face).is_some_and(|s| s[0] < s[1] && !touch(e, face, s));
        let is_near = |e: &u32| self.tets[*e as usize].iter().any(|v| is_candidate(*v));
        let elements = (0..self.tets.len() as u32).into_par_iter().with_min_len(CHUNK);
        let elements = context.until_cancelled(elements).filter(is_near);
        let apart: Vec<(u32, usize)> =
            elements.flat_map_iter(|e| (0..4).filter(move |f| is_apart(e, *f)).map(move |f| (e, f))).collect();
        context.check()?;
        let mut vertices = Vec::new();
        for (at, (e, face)) in apart.into_iter().enumerate() {
            context.check_every(FACES_PER_CHECK, at)?;
            let corners = TET_FACES[face].map(|v| self.tets[e as usize][v]);
            let Some(pair) = sides(e, face) else { continue };
            let around = labels_of(&topology.elements_around(&corners), labels);
            if self.has_wall_between(self.center(e, face), pair, around) {
                vertices.extend(corners);
            }
        }
        vertices.sort_unstable();
        vertices.dedup();
        Ok(vertices)
    }

    /// How many of some elements a wall of a label beside them keeps apart from another label, near their centroids.
    pub fn walled_off(&self, elements: &[u32], labels: &[Label], label: Label) -> usize {
        let around = labels_of(elements, labels);
        let is_walled_off = |e: &&u32| {
            let own = labels[**e as usize];
            let place = self.lattice.centroid(&self.tets[**e as usize]);
            own != label
                && !touch_near(&self.lattice.field, place, [label, own])
                && self.has_wall_between(place, [label, own], around.clone())
        };
        // A wall is a third label.
        if around.len() < 3 { 0 } else { elements.iter().filter(is_walled_off).count() }
    }

    /// Whether one of some labels lies between two that do not touch near a place.
    fn has_wall_between(&self, place: DVec3, pair: [Label; 2], mut around: Vec<Label>) -> bool {
        let touch = |pair: [Label; 2]| touch_near(&self.lattice.field, place, pair);
        around.retain(|label| !pair.contains(label) && pair.iter().all(|side| touch([*label, *side])));
        let walls = around.as_slice();
        let is_joined = |(at, wall): (usize, &Label)| walls[..at].iter().all(|other| touch([*other, *wall]));
        !walls.is_empty() && walls.iter().enumerate().all(is_joined)
    }

    /// Centroid of a face, local frame, mm.
    fn center(&self, element: u32, face: usize) -> DVec3 {
        let tet = &self.tets[element as usize];
        let corner = |v: usize| self.lattice.frame.local(self.lattice.vertices.positions[tet[v] as usize]);
        TET_FACES[face].map(corner).iter().sum::<DVec3>() / 3.0
    }
}

/// Whether voxels of two labels lie face to face near a place.
fn touch_near(field: &Field, place: DVec3, labels: [Label; 2]) -> bool {
    let nearest = floor_of(place / field.image.grid().spacing() + 0.5);
    // Nearly every contact is close by.
    [1, REACH].into_iter().any(|reach| label_contacts::touch_near(field.image, nearest, labels, reach))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::face_adjacency::neighbors_of;
    use crate::lattice::test_images::{voxel_image, with_lattice};

    #[test]
    fn no_element_of_a_wall_may_open_it() {
        // Labels 1 and 0 on both sides of a wall of one voxel.
        let image = voxel_image(9, |p| if p.x < 4.0 { 1 } else { 2 * u16::from(p.x < 5.0) });
        with_lattice(&image, 1.0, |lattice, context| {
            let elements = lattice.elements(context).unwrap();
            let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
            let contacts = ImageContacts::new(&lattice, &elements.tets, &neighbors);
            let (mut allowed, mut refused) = (0, 0);
            for e in 0..elements.tets.len() {
                let place = lattice.centroid(&elements.tets[e]);
                // Away from the border of the image, where label 1 does meet the background.
                if place.min_element() < 2.6 || place.max_element() > 5.4 {
                    continue;
                }
                let around = neighbors[e].iter().filter(|n| **n != OUTSIDE).map(|n| elements.labels[*n as usize]);
                for label in [0, 1, 2].map(Label).into_iter().filter(|l| *l != elements.labels[e]) {
                    let meets = |other: u16| around.clone().any(|l| l == Label(other));
                    let opens = (label == Label(0) && meets(1)) || (label == Label(1) && meets(0));
                    assert_eq!(contacts.allow(&elements.labels, &[e as u32], label), !opens, "{place} {label:?}");
                    if opens { refused += 1 } else { allowed += 1 }
                }
            }
            assert!(allowed > 50 && refused > 10, "{allowed} {refused}");
        });
    }

    #[test]
    fn a_face_between_labels_that_a_wall_keeps_apart_is_a_breach() {
        let image = voxel_image(9, |p| if p.x < 4.0 { 1 } else { 2 + u16::from(p.x >= 5.0) });
        with_lattice(&image, 1.0, |lattice, context| {
            let elements = lattice.elements(context).unwrap();
            let vertices = lattice.vertices.positions.len();
            let neighbors = neighbors_of(&elements.tets, vertices, context).unwrap();
            let contacts = ImageContacts::new(&lattice, &elements.tets, &neighbors);
            let topology = InterfaceTopology::new(&elements.tets, &neighbors, vertices, context).unwrap();
            assert!(contacts.breached(&elements.labels, &topology, |_| true, context).unwrap().is_empty());
            // The elements of the wall on one side of a vertex of it go to label 3.
            let place = |v: u32| lattice.frame.local(lattice.vertices.positions[v as usize]);
            let off = |v: &u32| place(*v).distance(DVec3::new(4.0, 4.5, 4.5));
            let middle = (0..vertices as u32).min_by(|l, r| off(l).total_cmp(&off(r))).unwrap();
            let mut labels = elements.labels.clone();
            for e in topology.elements_around(&[middle]) {
                if labels[e as usize] == Label(2) && lattice.centroid(&elements.tets[e as usize]).y < 4.4 {
                    labels[e as usize] = Label(3);
                }
            }
            let breached = contacts.breached(&labels, &topology, |_| true, context).unwrap();
            assert!(
                !breached.is_empty() && breached.iter().all(|v| place(*v).distance(place(middle)) < 1.8),
                "{breached:?}"
            );
            context.cancel_token().cancel();
            let cancelled = contacts.breached(&labels, &topology, |_| true, context);
            assert!(matches!(cancelled, Err(crate::Error::Cancelled)));
            // The wall is what may stand between.
            let around = topology.elements_around(&breached);
            let apart = |label: u16| contacts.walled_off(&around, &labels, Label(label));
            assert!(apart(1) > 0 && apart(3) > 0 && apart(2) == 0, "{} {} {}", apart(1), apart(2), apart(3));
        });
    }

    #[test]
    fn a_line_where_four_labels_meet_is_no_breach() {
        let image = voxel_image(9, |p| 1 + u16::from(p.x >= 4.0) + 2 * u16::from(p.y >= 4.0));
        with_lattice(&image, 1.0, |lattice, context| {
            let elements = lattice.elements(context).unwrap();
            let vertices = lattice.vertices.positions.len();
            let neighbors = neighbors_of(&elements.tets, vertices, context).unwrap();
            let contacts = ImageContacts::new(&lattice, &elements.tets, &neighbors);
            // Labels 1 and 4, or 2 and 3, touch: one of these pairs has to.
            let label = |e: usize| elements.labels[e].0;
            let is_diagonal = |e: usize, n: &u32| *n != OUTSIDE && label(e) + label(*n as usize) == 5;
            assert!((0..neighbors.len()).any(|e| neighbors[e].iter().any(|n| is_diagonal(e, n))));
            let topology = InterfaceTopology::new(&elements.tets, &neighbors, vertices, context).unwrap();
            assert!(contacts.breached(&elements.labels, &topology, |_| true, context).unwrap().is_empty());
        });
    }

    #[test]
    fn voxels_that_share_a_corner_do_not_touch_and_those_at_the_border_touch_the_background() {
        let image = voxel_image(6, |p| {
            if p.max_element() < 3.0 {
                1
            } else {
                2 * u16::from(p.min_element() > 2.0) + 3 * u16::from(p.min_element() <= 2.0)
            }
        });
        with_lattice(&image, 2.0, |lattice, _| {
            let touch = |at: DVec3, labels: [u16; 2]| touch_near(&lattice.field, at, labels.map(Label));
            let middle = DVec3::splat(2.5);
            assert!(!touch(middle, [1, 2]) && touch(middle, [1, 3]) && touch(middle, [2, 3]));
            assert!(touch(DVec3::new(-0.5, 1.0, 1.0), [0, 1]) && !touch(middle, [0, 1]));
        });
    }
}
