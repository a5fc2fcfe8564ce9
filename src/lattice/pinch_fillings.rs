//! What the neighbourhoods of pinched vertices, and of the corners of breaches of a wall, are to be filled with.
//!
//! # Method
//! 1. Each connected group of pinched vertices gets one label for all its inner parts: one that has elements at as many of
//!    them as any other, of these one on whose side of the image they lie, then the label whose pieces the pinch keeps apart, or
//!    that lies between two others that touch; not one that would join two components of the image. The vertices that do not
//!    have the label are left for another round, with other labels, while rounds are left; where these are most of them, as in a chain
//!    along which labels change, the group is parted by the labels that its vertices would get alone. Where Euler numbers are to be kept,
//!    first of all one that leaves them within reach ([`super::euler_ranges`]). Where none does, or some vertices lie far on the
//!    other side of it, the vertices are filled one by one, as far as that keeps them. Sides do not count where Euler numbers are
//!    checked afterwards: these are what matters then.
//! 2. Before all that, no component of the image is to lose its last voxel ([`super::kept_components`]), and no label is to touch
//!    elements that a wall keeps apart from it ([`super::image_contacts`]). Vertices that no label fills without opening a wall stay
//!    pinched, as a hole in it is worse; in the last round those between parts do so too. Where Euler numbers are checked afterwards these
//!    come first, and nothing stays pinched.
//! 3. The corners of a breach of a wall count as pinched; the label that opens none is the wall's.
//!
//! # Source
//! Our own.
//!
//! # Invariants
//! Vertices side by side have the same label, or one of them none: [`carve`](crate::lattice::interface_carving::carve) cuts between them.
//!
//! # Limits
//! A vertex on the outside of the lattice whose elements do not form a half ball can only be filled with background.
//! Where middles of edges are no lattice points (at the finest level) a pinched vertex stays, and is reported.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use glam::IVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::index::Label;
use crate::lattice::euler_ranges::{EulerNumbers, EulerRanges, changes_by_filling};
use crate::lattice::image_contacts::ImageContacts;
use crate::lattice::interface_topology::{InterfaceTopology, labels_of};
use crate::lattice::kept_components::{KeptComponents, Taken};
use crate::lattice::red_green::{Elements, RedGreenLattice};

/// Groups of pinched vertices between two looks at whether the run is cancelled.
const GROUPS_PER_CHECK: usize = 64;

/// How far beyond the boundary of a label a vertex may lie that is filled with it, in voxels: smoothing does not bring the surface out
/// of slits that are cut farther away. Of 88 trees of vessels the meshes of 8 change; one had a slit of 0.70 voxel in a wall, where the
/// largest distance is 0.37 now, the others are at most 0.39 off with and without.
const BEYOND: f64 = 0.3;

/// What is known of the pieces of labels, to choose what may be joined.
pub struct Regions {
    /// Region of each element: elements of one label connected through faces, or of one component of the image.
    pub of_element: Vec<u32>,
    /// How many more regions each label has than the image has components; these may be joined.
    pub surplus: Vec<i64>,
}

/// How much of a group of pinched vertices its label fills.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Extent {
    /// The vertices that have the label, where the lattice has room for another label at the others later.
    NearLabel,
    /// All.
    Whole,
}

/// What fillings have to keep to.
pub struct FillingRules<'a> {
    /// The pieces of labels, some of which may be joined.
    pub regions: &'a Regions,
    /// The Euler numbers, where they are to be kept; they follow what is chosen.
    pub euler: Option<&'a mut EulerRanges>,
    /// Whether they are checked afterwards. Then what is filled also brings one nearer that is off, which hides a tunnel in one
    /// place by another elsewhere, and it does not count on which side of a boundary vertices lie.
    pub are_checked: bool,
    /// How much of a group is filled.
    pub extent: Extent,
    /// What components of the image have of the mesh; that follows what is chosen too.
    pub kept: KeptComponents<'a>,
}

/// Vertices whose neighbourhood gets one label: where surfaces are pinched, and the corners of breaches; in order.
pub struct Pinches {
    /// All of them.
    pub vertices: Vec<u32>,
}

impl Pinches {
    /// Those among the vertices that are marked as possible corners of breaches, and as such that may pinch; among all where there are no
    /// marks.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn among(
        lattice: &RedGreenLattice,
        labels: &[Label],
        topology: &InterfaceTopology,
        candidates: [Option<&[bool]>; 2],
        context: &RunContext,
    ) -> Result<Self> {
        let [is_at_breach, may_pinch] =
            candidates.map(|marks| move |v: u32| marks.is_none_or(|marks| marks[v as usize]));
        let contacts = ImageContacts::new(lattice, topology.tets, topology.neighbors);
        let mut vertices = contacts.breached(labels, topology, is_at_breach, context)?;
        vertices.extend(topology.pinched_among(labels, may_pinch, context)?);
        vertices.sort_unstable();
        vertices.dedup();
        Ok(Self { vertices })
    }

    /// For each vertex whether it may have to be carved after a carving of these: what had to be before, and the vertices of the
    /// elements `changed` by [`carve`](crate::lattice::interface_carving::carve).
    pub fn to_see_after(&self, lattice: &RedGreenLattice, elements: &Elements, changed: &[u32]) -> Vec<bool> {
        let mut is_seen = vec![false; lattice.vertices.positions.len()];
        let vertices = changed.iter().flat_map(|e| &elements.tets[*e as usize]).chain(&self.vertices);
        vertices.for_each(|v| is_seen[*v as usize] = true);
        is_seen
    }
}

/// What the surroundings of pinched vertices are filled with.
pub struct Fillings {
    /// The label that fills the neighbourhood of each vertex, the same at those connected through edges; none where it stays.
    pub(super) label_of: Vec<Option<Label>>,
}

impl Fillings {
    pub(super) fn has(&self, vertex: u32) -> bool {
        self.label_of[vertex as usize].is_some()
    }

    /// The vertices that are filled, increasing.
    pub fn vertices(&self) -> Vec<u32> {
        (0u32..).zip(&self.label_of).filter(|(_, label)| label.is_some()).map(|(v, _)| v).collect()
    }
}

/// What the surroundings of pinched vertices are to be filled with.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn choose_fillings(
    lattice: &RedGreenLattice,
    labels: &[Label],
    topology: &InterfaceTopology,
    pinches: &Pinches,
    rules: FillingRules,
    context: &RunContext,
) -> Result<Fillings> {
    let contacts = ImageContacts::new(lattice, topology.tets, topology.neighbors);
    let mut choice = Choice { lattice, labels, topology, contacts, rules };
    let mut fillings = Fillings { label_of: vec![None; topology.vertex_count()] };
    for (at, group) in groups_of(topology, &pinches.vertices).into_iter().enumerate() {
        context.check_every(GROUPS_PER_CHECK, at)?;
        let may_leave_some = choice.may_leave_some(&topology.elements_around(&group));
        let whole = choice.filled(&group);
        let fits = whole.as_ref().is_some_and(Filled::fits);
        let may_be_parted = may_leave_some || !(fits || choice.rules.are_checked);
        let filled = match whole {
            Some(filled) if may_be_parted && choice.is_strange(filled.label, &group) => None,
            whole => whole,
        };
        let Some(filled) = filled else {
            choice.fill_parts(&group, &mut fillings);
            continue;
        };
        if fits || !(may_leave_some || filled.opens) {
            choice.take(filled, &mut fillings);
            continue;
        }
        // What a chain of vertices spans may join what lies apart, open a wall, or lie on both sides of a boundary: one by one, those
        // beside a filled one in another round.
        choice.fill_one_by_one(&group, may_leave_some, &mut fillings);
    }
    Ok(fillings)
}

/// Vertices and the label that their neighbourhood is to take.
struct Filled {
    group: Vec<u32>,
    label: Label,
    /// Whether a wall keeps elements around apart from the label, where that counts.
    opens: bool,
    /// The voxels in what is filled, and how many components of the image have none left then.
    taken: Vec<Taken>,
    lost: usize,
    /// What the Euler numbers change by, and by how much farther from their ranges they are then.
    changes: Vec<(Label, EulerNumbers)>,
    off: i64,
    /// How many of the vertices lie beyond the label's boundary, where that counts.
    misplaced: usize,
}

impl Filled {
    /// Whether Euler numbers stay within reach and every component keeps a voxel.
    fn keeps_topology(&self) -> bool {
        self.off <= 0 && self.lost == 0
    }

    /// Whether nothing speaks against it.
    fn fits(&self) -> bool {
        self.keeps_topology() && self.misplaced == 0 && !self.opens
    }
}

/// What speaks against a label for a group of vertices.
struct Objections {
    /// How many components of the image would lose their last voxels.
    lost: usize,
    /// How many elements a wall keeps apart from it, and how far Euler numbers would be out of their ranges; the other way round
    /// where these are checked.
    weightiest: [i64; 2],
    /// How many vertices lie beyond its boundary, where that counts.
    misplaced: usize,
}

/// What fillings are chosen by.
struct Choice<'a> {
    lattice: &'a RedGreenLattice<'a>,
    labels: &'a [Label],
    topology: &'a InterfaceTopology<'a>,
    contacts: ImageContacts<'a>,
    rules: FillingRules<'a>,
}

impl Choice<'_> {
    /// What a group of pinched vertices is to be filled with, all of it or those that have the label; `None` where it stays.
    fn filled(&self, group: &[u32]) -> Option<Filled> {
        let Self { labels, topology, contacts, rules, .. } = self;
        let around = topology.elements_around(group);
        if !self.can_halve(&around, 1) {
            return None;
        }
        let misplaced = |group: &[u32], label: Label| match rules.are_checked {
            true => 0,
            false => group.iter().filter(|v| self.lies_beyond(**v, label)).count(),
        };
        let fillings_of =
            |group: &[u32]| rules.euler.as_ref().map(|_| topology.fillings_of(group, labels)).unwrap_or_default();
        let of_group = fillings_of(group);
        let elements_around = || around.iter().map(|e| (&topology.tets[*e as usize], labels[*e as usize]));
        let taken = rules.kept.taken_of(elements_around(), group, self.lattice);
        let least = if rules.are_checked { i64::MIN } else { 0 };
        let off = |changes: &[_]| rules.euler.as_ref().map_or(0, |euler| euler.distance_after(changes).max(least));
        let objections = |label: Label| {
            let opened = contacts.walled_off(&around, labels, label) as i64;
            let off = off(&changes_by_filling(&of_group, label));
            let weightiest = if rules.are_checked { [off, opened] } else { [opened, off] };
            Objections { lost: rules.kept.lost_to(label, &taken), weightiest, misplaced: misplaced(group, label) }
        };
        let label = label_for(topology, group, &around, labels, rules.regions, objections)?;
        let with_label: Vec<u32> = group.iter().copied().filter(|v| topology.has_label(*v, label, labels)).collect();
        let has_some = !with_label.is_empty() && with_label.len() < group.len();
        let (group, changes, taken) = match has_some && self.may_leave_some(&around) {
            true => {
                let changes = changes_by_filling(&fillings_of(&with_label), label);
                let taken = rules.kept.taken_of(elements_around(), &with_label, self.lattice);
                (with_label, changes, taken)
            }
            false => (group.to_vec(), changes_by_filling(&of_group, label), taken),
        };
        let lost = rules.kept.lost_to(label, &taken);
        let opens = !rules.are_checked && contacts.walled_off(&topology.elements_around(&group), labels, label) > 0;
        let misplaced = misplaced(&group, label);
        Some(Filled { opens, off: off(&changes), misplaced, lost, group, label, changes, taken })
    }

    /// Whether most vertices of a group, which may be a chain many voxels long, do not have the label: it would reach far from its voxels.
    fn is_strange(&self, label: Label, group: &[u32]) -> bool {
        2 * strangers(self.topology, group, label, self.labels) > group.len()
    }

    /// Fills the vertices of a group by parts that would have the same label alone, the largest first, without those beside a filled one.
    fn fill_parts(&mut self, group: &[u32], fillings: &mut Fillings) {
        let mut with_label: BTreeMap<Label, Vec<u32>> = BTreeMap::new();
        for v in group {
            if let Some(filled) = self.filled(&[*v]) {
                with_label.entry(filled.label).or_default().push(*v);
            }
        }
        let mut parts: Vec<(Label, Vec<u32>)> = Vec::new();
        for (label, vertices) in with_label {
            parts.extend(groups_of(self.topology, &vertices).into_iter().map(|part| (label, part)));
        }
        parts.sort_by_key(|(_, part)| Reverse(part.len()));
        for (label, mut part) in parts {
            part.retain(|v| !self.is_beside_filled(*v, fillings));
            let fits = |filled: &Filled| filled.label == label && filled.keeps_topology() && !filled.opens;
            match self.filled(&part).filter(fits) {
                Some(filled) => self.take(filled, fillings),
                None => self.fill_one_by_one(&part, true, fillings),
            }
        }
    }

    /// Fills vertices of a group alone, without those beside a filled one; where some may be left, also without those that put Euler
    /// numbers out of reach or take the last voxels of a component.
    fn fill_one_by_one(&mut self, group: &[u32], may_leave_some: bool, fillings: &mut Fillings) {
        for v in group {
            if self.is_beside_filled(*v, fillings) {
                continue;
            }
            let fits = |filled: &Filled| (filled.keeps_topology() || !may_leave_some) && !filled.opens;
            if let Some(filled) = self.filled(&[*v]).filter(fits) {
                self.take(filled, fillings);
            }
        }
    }

    fn is_beside_filled(&self, vertex: u32, fillings: &Fillings) -> bool {
        self.topology.vertices_of(self.topology.ball(vertex)).iter().any(|near| fillings.has(*near))
    }

    /// Whether a vertex lies beyond the boundary of a label in the image.
    fn lies_beyond(&self, vertex: u32, label: Label) -> bool {
        let field = &self.lattice.field;
        let place = self.lattice.frame.local(self.lattice.vertices.positions[vertex as usize]);
        field.signed_distance(place, label) < -BEYOND * field.voxel_size()
    }

    /// Whether some vertices of a group with elements `around` can be left for another round.
    fn may_leave_some(&self, around: &[u32]) -> bool {
        self.rules.extent == Extent::NearLabel && self.can_halve(around, 2)
    }

    fn can_halve(&self, elements: &[u32], times: u32) -> bool {
        elements.iter().all(|e| has_middles(self.lattice, &self.topology.tets[*e as usize], times))
    }

    fn take(&mut self, filled: Filled, fillings: &mut Fillings) {
        if let Some(euler) = &mut self.rules.euler {
            euler.add(&filled.changes);
        }
        self.rules.kept.take(filled.label, &filled.taken);
        filled.group.iter().for_each(|v| fillings.label_of[*v as usize] = Some(filled.label));
    }
}

/// Pinched vertices connected through edges.
pub(super) fn groups_of(topology: &InterfaceTopology, pinched: &[u32]) -> Vec<Vec<u32>> {
    let mut seen = vec![false; pinched.len()];
    let mut groups = Vec::new();
    for start in 0..pinched.len() {
        if seen[start] {
            continue;
        }
        seen[start] = true;
        let mut group = vec![pinched[start]];
        let mut next = 0;
        while next < group.len() {
            for v in topology.vertices_of(topology.ball(group[next])) {
                if let Ok(at) = pinched.binary_search(&v)
                    && !seen[at]
                {
                    seen[at] = true;
                    group.push(v);
                }
            }
            next += 1;
        }
        group.sort_unstable();
        groups.push(group);
    }
    groups
}

/// Whether the middles of all edges are lattice points, also after further halvings.
fn has_middles(lattice: &RedGreenLattice, tet: &[u32; 4], times: u32) -> bool {
    let positions = tet.map(|v| lattice.vertices.positions[v as usize]);
    let rest = IVec3::splat((1 << times) - 1);
    positions.iter().all(|p| ((*p - positions[0]) & rest) == IVec3::ZERO)
}

/// The label that fills a group with elements `around`; `None` where each would join components of the image.
///
/// Where the lattice itself does not end in a disc around a vertex, only the background is manifold as a filling.
fn label_for(
    topology: &InterfaceTopology,
    group: &[u32],
    around: &[u32],
    labels: &[Label],
    regions: &Regions,
    objections: impl Fn(Label) -> Objections,
) -> Option<Label> {
    let mut candidates = labels_of(around, labels);
    if group.iter().any(|v| topology.is_open(*v)) && candidates.first() != Some(&Label::BACKGROUND) {
        candidates.insert(0, Label::BACKGROUND);
    }
    if !group.iter().all(|v| topology.is_lattice_ball(*v, labels)) {
        candidates = vec![Label::BACKGROUND];
    }
    let joins_too_much = |label: Label| {
        let mut pieces: Vec<u32> =
            around.iter().filter(|e| labels[**e as usize] == label).map(|e| regions.of_element[*e as usize]).collect();
        pieces.sort_unstable();
        pieces.dedup();
        pieces.len() as i64 - 1 > regions.surplus[label.index()].max(0)
    };
    let score = |label: Label| group.iter().map(|v| topology.excess_of(*v, label, labels)).sum::<i64>();
    // The background last: a leak is closed rather than opened.
    let allowed = candidates.into_iter().filter(|l| !joins_too_much(*l));
    allowed.max_by_key(|l| {
        let is_tissue = !l.is_background();
        let Objections { lost, weightiest, misplaced } = objections(*l);
        let against =
            (Reverse(lost), Reverse(weightiest), Reverse(strangers(topology, group, *l, labels)), Reverse(misplaced));
        (against, is_tissue, score(*l), Reverse(*l))
    })
}

/// How many vertices of a group do not have a label.
fn strangers(topology: &InterfaceTopology, group: &[u32], label: Label, labels: &[Label]) -> usize {
    group.iter().filter(|v| !topology.has_label(**v, label, labels)).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::face_adjacency::neighbors_of;
    use crate::lattice::test_images::{components_of, topology_of, voxel_image, with_lattice};

    #[test]
    fn a_chain_gets_a_label_that_is_near_all_of_it() {
        // A bar of 6 x 2 x 2 cubes of six tets each; the chain runs through its middle. Label 1 is at one end only.
        let number = |i: usize, j: usize, k: usize| (i + 7 * (j + 3 * k)) as u32;
        let (mut tets, mut labels) = (Vec::new(), Vec::new());
        for (i, j, k) in (0..24).map(|n| (n % 6, n / 6 % 2, n / 12)) {
            for [a, b, c] in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
                let mut at = [i, j, k];
                let mut tet = vec![number(i, j, k)];
                for axis in [a, b, c] {
                    at[axis] += 1;
                    tet.push(number(at[0], at[1], at[2]));
                }
                tets.push([tet[0], tet[1], tet[2], tet[3]]);
                labels.push(Label(if (i, j, k) == (0, 0, 0) { 1 } else { 2 + k as u16 }));
            }
        }
        let context = RunContext::with_threads(1).unwrap();
        let neighbors = neighbors_of(&tets, 63, &context).unwrap();
        let topology = InterfaceTopology::new(&tets, &neighbors, 63, &context).unwrap();
        let regions = Regions { of_element: labels.iter().map(|l| u32::from(l.0)).collect(), surplus: vec![0; 4] };
        let chosen = |group: &[u32]| {
            let none = |_| Objections { lost: 0, weightiest: [0; 2], misplaced: 0 };
            label_for(&topology, group, &topology.elements_around(group), &labels, &regions, none)
        };
        let chain: Vec<u32> = (1..6).map(|i| number(i, 1, 1)).collect();
        assert_eq!(chosen(&chain), Some(Label(2)));
        assert_eq!(chosen(&chain[..1]), Some(Label(1)), "where all labels are near, the first");
        // A component's last voxel counts before all else.
        let objections = |label: Label| Objections {
            lost: usize::from(label == Label(2)),
            weightiest: [i64::from(label != Label(2)); 2],
            misplaced: 0,
        };
        let around = topology.elements_around(&chain);
        assert_eq!(label_for(&topology, &chain, &around, &labels, &regions, objections), Some(Label(3)));
    }

    #[test]
    fn a_chain_along_which_labels_change_is_filled_by_parts() {
        // Two labels in each third of the image, and a line of vertices between them through all thirds.
        let image = voxel_image(24, |p| 1 + 2 * (p.x / 8.0) as u16 + u16::from(p.y < 12.0));
        let filled = |are_checked: bool| {
            with_lattice(&image, 2.0, |lattice, context| {
                let elements = lattice.elements(context).unwrap();
                let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
                let topology = topology_of(&lattice, &elements, &neighbors, context);
                let place = |v: &u32| lattice.frame.local(lattice.vertices.positions[*v as usize]);
                let inner: Vec<u32> = (0..topology.vertex_count() as u32).filter(|v| !topology.is_open(*v)).collect();
                let off_axis = |v: &u32| (place(v) - 11.5).y.hypot((place(v) - 11.5).z);
                // Places on one line are equal but for rounding.
                let least = inner.iter().map(off_axis).fold(f64::INFINITY, f64::min);
                let line: Vec<u32> = inner.into_iter().filter(|v| off_axis(v) < least + 1e-9).collect();
                assert_eq!(groups_of(&topology, &line).len(), 1);
                let regions = Regions { of_element: vec![0; elements.tets.len()], surplus: vec![0; 7] };
                let components = components_of(&image, context);
                let (kept, extent) = (KeptComponents::new(&components, &[]), Extent::Whole);
                let rules = FillingRules { regions: &regions, euler: None, are_checked, extent, kept };
                let pinches = Pinches { vertices: line.clone() };
                let fillings =
                    choose_fillings(&lattice, &elements.labels, &topology, &pinches, rules, context).unwrap();
                let mut thirds = [false; 3];
                let (mut left, mut strange) = (0, 0);
                for v in &line {
                    let Some(label) = fillings.label_of[*v as usize] else {
                        left += 1;
                        continue;
                    };
                    strange += usize::from(!topology.has_label(*v, label, &elements.labels));
                    thirds[(label.index() - 1) / 2] = true;
                    let around = topology.vertices_of(topology.ball(*v));
                    let beside = around.iter().filter_map(|near| fillings.label_of[*near as usize]);
                    assert!(beside.into_iter().all(|other| other == label), "vertices side by side have one label");
                }
                (thirds.iter().filter(|third| **third).count(), left, strange, line.len())
            })
        };
        let (thirds, left, strange, all) = filled(false);
        assert_eq!((thirds, strange), (3, 0));
        assert!(0 < left && left < all / 3, "{left} of {all}");
        // Where Euler numbers are checked afterwards nothing is left.
        let (thirds, left, strange, _) = filled(true);
        assert!((thirds, left) == (1, 0) && strange > all / 2, "{thirds} {left} {strange} of {all}");
    }

    #[test]
    fn vertices_on_both_sides_of_a_boundary_do_not_get_one_label() {
        let image = voxel_image(16, |p| if p.x < 8.0 { 1 } else { 2 });
        with_lattice(&image, 2.0, |lattice, context| {
            let mut elements = lattice.elements(context).unwrap();
            // A rod of label 1 in label 2, and one of label 2 in label 1: a line of vertices that all have both.
            let rod = |tet: &[u32; 4]| {
                let at = lattice.centroid(tet) - 7.5;
                (at.y.hypot(at.z) < 1.5 && at.x.abs() < 4.5).then_some(Label(1 + u16::from(at.x < 0.5)))
            };
            let tets = elements.labels.iter_mut().zip(&elements.tets);
            tets.for_each(|(label, tet)| *label = rod(tet).unwrap_or(*label));
            let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
            let topology = topology_of(&lattice, &elements, &neighbors, context);
            let place = |v: &u32| lattice.frame.local(lattice.vertices.positions[*v as usize]);
            let is_at_rod = |v: &u32| {
                let at = place(v) - 7.5;
                at.y.hypot(at.z) < 2.0 && at.x.abs() < 4.0
            };
            let has_both = |v: &u32| [1, 2].iter().all(|l| topology.has_label(*v, Label(*l), &elements.labels));
            let line: Vec<u32> = (0..topology.vertex_count() as u32).filter(|v| is_at_rod(v) && has_both(v)).collect();
            assert_eq!(groups_of(&topology, &line).len(), 1);
            let regions = Regions { of_element: vec![0; elements.tets.len()], surplus: vec![0; 3] };
            let components = components_of(&image, context);
            let (kept, extent) = (KeptComponents::new(&components, &[]), Extent::NearLabel);
            let rules = FillingRules { regions: &regions, euler: None, are_checked: false, extent, kept };
            let pinches = Pinches { vertices: line.clone() };
            let fillings = choose_fillings(&lattice, &elements.labels, &topology, &pinches, rules, context).unwrap();
            let mut filled = [0; 3];
            for (v, label) in line.iter().filter_map(|v| Some((v, fillings.label_of[*v as usize]?))) {
                let depth = lattice.field.signed_distance(place(v), label);
                assert!(depth > -BEYOND, "{} {label:?} {depth}", place(v));
                filled[label.index()] += 1;
            }
            assert!(filled[1] > 0 && filled[2] > 0, "{filled:?} of {}", line.len());
        });
    }
}
