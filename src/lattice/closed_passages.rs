//! Passages that the mesh closes: where two voxels of a label touch, or two of others beside it, and their elements do not, these get
//! the labels by their centroids again.
//!
//! # Method
//! For each label with another Euler number than in the image:
//! 1. A passage is two voxels with a common face that are both of the label, or both of others. It is closed where no element with its
//!    centroid in the one and none in the other, on the same side, have a common face: a bridge or a wall is broken there, a tunnel or
//!    a mouth of a pocket shut. Relabelling for smooth surfaces takes the few faces of such a contact first.
//! 2. The elements with centroids in the two voxels, or in those around too, get the labels that they have by their centroids, and what
//!    pinches then is repaired ([`InterfaceTopology::repair_from`]). All other elements stand by now, so that the Euler numbers tell
//!    which repairs keep the passage open. What brings these no nearer to those of the image, or leaves more pinches, is undone.
//! 3. All that is closed then is looked at again, as long as anything is opened.
//!
//! ```text
//!     image                mesh
//!     1 1 1 1 1 1          1 1 1 1 1 1
//!     2 2 2|. . 1          2 2 1 1 . 1          label 1 goes around a pocket that is open in the image
//!     1 1 1 1 1 1          1 1 1 1 1 1
//! ```
//!
//! # Source
//! Our own; [KongRosenfeld1989] for tunnels and cavities.
//!
//! # Invariants
//! Elements and vertices stay. With each passage that is opened a label comes nearer to its Euler number and none gets farther, and no
//! more vertices pinch. No label loses the centre of a voxel by a repair. The order of work is fixed.
//!
//! # Limits
//! Where elements are larger than voxels there is no passage to be seen.
//!
//! # Cost
//! Two looks at all elements for each such label, in parallel, and 2 bytes an element; then by the passages that are closed. There are
//! few such labels when refinement is over.

use glam::IVec3;
use rustc_hash::{FxHashMap, FxHashSet};

use crate::context::RunContext;
use crate::error::Result;
use crate::image::grid::places_around;
use crate::index::{Label, each_once};
use crate::lattice::euler_ranges::EulerRanges;
use crate::lattice::image_contacts::ImageContacts;
use crate::lattice::interface_topology::InterfaceTopology;
use crate::lattice::red_green::RedGreenLattice;
use crate::lattice::region_gaps::STEPS;
use crate::lattice::topology_differences::over_elements;

/// Times that all passages are looked at: one can be opened only once another one is.
const PASSES: usize = 4;

/// Voxels, or passages between them, from one look at whether the run is cancelled to the next.
const VOXELS_PER_CHECK: usize = 4096;

/// What passages are looked for in.
pub struct Passages<'a> {
    /// The lattice and the image.
    pub lattice: &'a RedGreenLattice<'a>,
    /// The elements.
    pub topology: &'a InterfaceTopology<'a>,
    /// The leaf of each element.
    pub leaves: &'a [u32],
}

/// The elements with their centroids in each voxel.
type ElementsOfVoxels = FxHashMap<IVec3, Vec<u32>>;

impl Passages<'_> {
    /// Opens the passages at labels with other Euler numbers than in the image; `euler` are the numbers now, and follow. Returns how
    /// many were opened.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn open(&self, labels: &mut [Label], euler: &mut EulerRanges, context: &RunContext) -> Result<usize> {
        let mut opened = 0;
        for _ in 0..PASSES {
            let before = opened;
            for label in euler.all_out_of_reach() {
                let voxels = self.disagreeing(labels, label, context)?;
                let of_voxels = self.elements_around(&voxels, context)?;
                for (n, passage) in self.passages(&voxels, label, context)?.into_iter().enumerate() {
                    context.check_every(VOXELS_PER_CHECK, n)?;
                    if euler.out_of_reach(label).is_none() {
                        break;
                    }
                    if self.is_open(passage, labels, label, &of_voxels) {
                        continue;
                    }
                    let around = each_once_in_order(passage.into_iter().flat_map(places_around));
                    for voxels in [passage.to_vec(), around] {
                        let near = voxels.iter().filter_map(|at| of_voxels.get(at)).flatten();
                        if self.open_at(&near.copied().collect::<Vec<u32>>(), labels, euler, context)? {
                            opened += 1;
                            break;
                        }
                    }
                }
            }
            if opened == before {
                break;
            }
        }
        Ok(opened)
    }

    fn voxel_of(&self, element: usize) -> IVec3 {
        self.lattice.field.nearest_voxel(self.lattice.centroid(&self.topology.tets[element]))
    }

    fn is_of(&self, at: IVec3, label: Label) -> bool {
        self.lattice.field.image.at_or_background(at) == label
    }

    /// The voxels of a label that hold centroids of elements of others, and those of others that hold some of its own.
    fn disagreeing(&self, labels: &[Label], label: Label, context: &RunContext) -> Result<Vec<IVec3>> {
        let disagrees = |e: usize| {
            let at = self.voxel_of(e);
            Some(at).filter(|at| (labels[e] == label) != self.is_of(*at, label))
        };
        let found = over_elements(self.topology.tets.len(), disagrees, context)?;
        Ok(each_once_in_order(found.into_iter()))
    }

    /// The pairs of voxels with a common face, one of which is among some, that are both of a label or both not, each once.
    fn passages(&self, voxels: &[IVec3], label: Label, context: &RunContext) -> Result<Vec<[IVec3; 2]>> {
        let known: FxHashSet<IVec3> = voxels.iter().copied().collect();
        let is_same = |[at, next]: &[IVec3; 2]| self.is_of(*at, label) == self.is_of(*next, label);
        // The other one lists the pair too where it is among them.
        let is_first = |[at, next]: &[IVec3; 2]| !known.contains(next) || at.to_array() < next.to_array();
        let mut found = Vec::new();
        for (n, at) in voxels.iter().enumerate() {
            context.check_every(VOXELS_PER_CHECK, n)?;
            let pairs = STEPS.into_iter().map(|step| [*at, *at + step]);
            found.extend(pairs.filter(is_same).filter(is_first));
        }
        Ok(found)
    }

    /// Whether elements on the same side of a label as two voxels, each with its centroid in one of these, have a common face; true
    /// where a voxel has no element.
    fn is_open(&self, [at, next]: [IVec3; 2], labels: &[Label], label: Label, of_voxels: &ElementsOfVoxels) -> bool {
        let (Some(here), Some(there)) = (of_voxels.get(&at), of_voxels.get(&next)) else { return true };
        let side = self.is_of(at, label);
        let is_on_side = |e: &u32| (labels[*e as usize] == label) == side;
        // Elements of a voxel are listed by increasing number.
        let is_there = |e: &u32| there.binary_search(e).is_ok() && is_on_side(e);
        here.iter().filter(|e| is_on_side(e)).any(|e| self.topology.neighbors[*e as usize].iter().any(is_there))
    }

    /// The elements with their centroids in some voxels and two steps around these.
    fn elements_around(&self, voxels: &[IVec3], context: &RunContext) -> Result<ElementsOfVoxels> {
        let next = grown(voxels, context)?;
        let near = grown(&next, context)?;
        let mut of_voxels = ElementsOfVoxels::default();
        if near.is_empty() {
            return Ok(of_voxels);
        }
        let voxel_of = |e: usize| Some((self.voxel_of(e), e as u32)).filter(|(at, _)| near.contains(at));
        let found = over_elements(self.topology.tets.len(), voxel_of, context)?;
        for (n, (at, e)) in found.into_iter().enumerate() {
            context.check_every(VOXELS_PER_CHECK, n)?;
            of_voxels.entry(at).or_default().push(e);
        }
        Ok(of_voxels)
    }

    /// Gives elements the labels by their centroids, and repairs what pinches then, where that brings the Euler numbers nearer to those
    /// of the image without further pinches; else all stays.
    fn open_at(
        &self,
        elements: &[u32],
        labels: &mut [Label],
        euler: &mut EulerRanges,
        context: &RunContext,
    ) -> Result<bool> {
        let Self { lattice, topology, leaves } = self;
        let before = euler.clone();
        // Elements that changed, with their labels then, in this order.
        let mut changes = Vec::new();
        for &e in elements {
            let edge = lattice.leaf_edge(leaves[e as usize]);
            let label = lattice.label_at_centroid(&topology.tets[e as usize], edge);
            if label != labels[e as usize] {
                euler.add(&topology.euler_changes(&[e], label, labels));
                changes.push((e, std::mem::replace(&mut labels[e as usize], label)));
            }
        }
        if changes.is_empty() {
            return Ok(false);
        }
        let contacts = ImageContacts::new(lattice, topology.tets, topology.neighbors);
        let may_take = |labels: &[Label], changed: &[u32], label: Label| {
            contacts.voxels_lost(labels, changed, label).filter(|lost| *lost == 0)
        };
        let from = topology.vertices_of(elements);
        changes.append(&mut topology.repair_from(from, labels, Some(euler), context, may_take)?.changed);
        let changed = each_once(changes.iter().map(|(e, _)| *e));
        let concerned = topology.vertices_of(&changed);
        let pinches = |labels: &[Label]| concerned.iter().filter(|v| topology.excess(**v, labels) > 0).count();
        let pinched = pinches(labels);
        let opened: Vec<Label> = changed.iter().map(|e| labels[*e as usize]).collect();
        changes.into_iter().rev().for_each(|(e, label)| labels[e as usize] = label);
        let is_better = euler.is_nearer_than(&before) && pinched <= pinches(labels);
        if is_better {
            changed.iter().zip(opened).for_each(|(e, label)| labels[*e as usize] = label);
        } else {
            *euler = before;
        }
        Ok(is_better)
    }
}

/// Some voxels and those around them.
fn grown<'a>(voxels: impl IntoIterator<Item = &'a IVec3>, context: &RunContext) -> Result<FxHashSet<IVec3>> {
    let mut all = FxHashSet::default();
    for (n, at) in voxels.into_iter().enumerate() {
        context.check_every(VOXELS_PER_CHECK, n)?;
        all.extend(places_around(*at));
    }
    Ok(all)
}

/// Voxels along the rows of the image, each once.
fn each_once_in_order(voxels: impl Iterator<Item = IVec3>) -> Vec<IVec3> {
    let places = each_once(voxels.map(|at| [at.z, at.y, at.x]));
    places.into_iter().map(|[k, j, i]| IVec3::new(i, j, k)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::euler_numbers::euler_numbers;
    use crate::lattice::face_adjacency::neighbors_of;
    use crate::lattice::test_images::{topology_of, voxel_image, with_lattice};

    /// Label 1 around a pocket of label 2, or of label 3 behind a mouth of label 2, that is open to the outside or not.
    fn pocket(is_open: bool, behind: u16) -> impl Fn(glam::DVec3) -> u16 {
        move |p| {
            let is_in =
                |low: f64, high: f64| p.cmpge(glam::DVec3::splat(low)).all() && p.cmple(glam::DVec3::splat(high)).all();
            let is_neck = p.y == 6.0 && p.z == 6.0 && p.x > 7.0;
            match (is_in(5.0, 7.0), is_neck && (is_open || p.x < 9.0)) {
                (true, _) => behind,
                (_, true) => 2,
                _ => u16::from(is_in(2.0, 10.0)),
            }
        }
    }

    /// Meshes an image at half a voxel, gives elements with centroids at some places another label, and opens what is closed then: the
    /// number of passages, what the labels are off then, and the elements that have changed.
    fn opened(
        label: impl Fn(glam::DVec3) -> u16,
        label_there: impl Fn(glam::DVec3) -> Option<u16>,
    ) -> (usize, [i64; 2], usize) {
        let image = voxel_image(13, label);
        with_lattice(&image, 1.0, |mut lattice, context| {
            lattice.refine(&vec![true; lattice.tets.len()], context).unwrap();
            let elements = lattice.elements(context).unwrap();
            let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
            let topology = topology_of(&lattice, &elements, &neighbors, context);
            let mut labels = elements.labels.clone();
            let there = |tet: &[u32; 4]| label_there(lattice.centroid(tet)).map(Label);
            labels.iter_mut().zip(&elements.tets).for_each(|(label, tet)| *label = there(tet).unwrap_or(*label));
            let wanted = euler_numbers(&image, context).unwrap();
            topology.repair(&mut labels, None, context, |_, _, _| Some(0)).unwrap();
            let repaired = labels.clone();
            let mut euler = topology.euler_ranges(&labels, &wanted, context).unwrap();
            let off = |euler: &EulerRanges| -> i64 {
                let labels = euler.all_out_of_reach();
                labels.iter().filter_map(|l| euler.out_of_reach(*l)).map(|[mesh, image]| (mesh - image).abs()).sum()
            };
            let before = off(&euler);
            let passages = Passages { lattice: &lattice, topology: &topology, leaves: &elements.leaves };
            let stopped = RunContext::with_threads(1).unwrap();
            stopped.cancel_token().cancel();
            let result = passages.open(&mut labels, &mut euler, &stopped);
            assert!(before == 0 || matches!(result, Err(crate::Error::Cancelled)));
            let opened = passages.open(&mut labels, &mut euler, context).unwrap();
            assert_eq!(euler, topology.euler_ranges(&labels, &wanted, context).unwrap(), "the numbers follow");
            assert!(topology.pinched(&labels, context).unwrap().is_empty());
            let differing = labels.iter().zip(&repaired).filter(|(now, then)| now != then).count();
            (opened, [before, off(&euler)], differing)
        })
    }

    fn is_around(p: glam::DVec3, x: f64) -> bool {
        (p.x - x).abs() < 0.6 && (p.y - 6.0).abs() < 0.8 && (p.z - 6.0).abs() < 0.8
    }

    #[test]
    fn a_mouth_that_a_label_has_shut_is_opened_whatever_is_behind() {
        for behind in [2, 3] {
            let (opened, off, changed) = opened(pocket(true, behind), |p| is_around(p, 8.0).then_some(1));
            assert!(opened > 0 && off[0] > 0 && off[1] == 0, "{behind}: {opened} {off:?} {changed}");
        }
    }

    #[test]
    fn a_bridge_that_is_broken_is_made_again() {
        let is_block =
            |p: glam::DVec3| p.cmpge(glam::DVec3::splat(3.0)).all() && p.cmple(glam::DVec3::splat(9.0)).all();
        let is_bridge = |p: glam::DVec3| p.y == 6.0 && p.z == 6.0;
        let label = |p: glam::DVec3| u16::from(is_block(p) && ((p.x - 6.0).abs() > 1.0 || is_bridge(p)));
        let (opened, off, changed) = opened(label, |p| is_around(p, 6.0).then_some(0));
        assert!(opened > 0 && off == [1, 0], "{opened} {off:?} {changed}");
    }

    #[test]
    fn a_cavity_of_the_image_stays_closed() {
        assert_eq!(opened(pocket(false, 2), |_| None), (0, [0; 2], 0));
    }
}
