//! Voxel-exact comparison of mesh and image: which voxel centres lie in an element of another label.
//!
//! # Method
//! 1. An element whose surroundings have one label in the distance transform, its own, has nothing to count.
//! 2. In every other element the voxel rows of its bounding box are cut by its four planes, and the voxels of the cut
//!    are compared with its label.
//! 3. With `n` voxels of a label in the image, `missed` of them in other elements and `wrong` voxels of other labels
//!    in its own elements: `F1 = (n - missed) / (n - missed + wrong)`, `F2 = (n - missed) / n`.
//!
//! # Source
//! [Drakopoulos2017] 2.3.3 for F1 and F2.
//!
//! # Invariants
//! Centres are displaced by a millionth of a voxel, so each lies in exactly one element.
//!
//! # Cost
//! Proportional to the elements near boundaries; parallel, whole numbers, the same for any number of threads.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::connected_components::Components;
use crate::index::Label;
use crate::lattice::bcc_lattice::floor_of;
use crate::lattice::red_green::{CHANGED, Elements, RedGreenLattice};
use crate::mesh::numbering::TET_FACES;

/// Elements per parallel work item.
const CHUNK: usize = 2048;

/// Voxels of one label and component that lie in an element of another label.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mismatch {
    /// The element.
    pub element: u32,
    /// The element's label.
    pub element_label: Label,
    /// The label of the voxels.
    pub voxel_label: Label,
    /// The component of the voxels; `u32::MAX` where components are not counted.
    pub component: u32,
    /// How many voxels.
    pub voxels: u32,
}

/// All mismatches of a set of elements, in the order of the elements.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn mismatches(
    lattice: &RedGreenLattice,
    elements: &Elements,
    components: &Components,
    context: &RunContext,
) -> Result<Vec<Mismatch>> {
    mismatches_of(lattice, elements, 0..elements.tets.len() as u32, components, context)
}

/// The mismatches after labels have changed, from those before: `found`, with the labels `before`.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn recounted(
    found: &[Mismatch],
    before: &[Label],
    lattice: &RedGreenLattice,
    elements: &Elements,
    components: &Components,
    context: &RunContext,
) -> Result<Vec<Mismatch>> {
    let has_changed = |e: u32| before[e as usize] != elements.labels[e as usize];
    let all = (0..before.len() as u32).into_par_iter().with_min_len(CHUNK);
    let changed: Vec<u32> = context.until_cancelled(all).filter(|e| has_changed(*e)).collect();
    context.check()?;
    counted_anew(found, changed, lattice, elements, components, context)
}

/// The mismatches after some elements, increasing, have changed in their places or have come at the end, when there were those `found`.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn counted_anew(
    found: &[Mismatch],
    changed: Vec<u32>,
    lattice: &RedGreenLattice,
    elements: &Elements,
    components: &Components,
    context: &RunContext,
) -> Result<Vec<Mismatch>> {
    let stays = |m: &&Mismatch| changed.binary_search(&m.element).is_err();
    let mut all: Vec<Mismatch> = found.iter().filter(stays).copied().collect();
    all.extend(mismatches_of(lattice, elements, changed, components, context)?);
    // Stable: those of one element keep their order.
    all.sort_by_key(|m| m.element);
    Ok(all)
}

/// The mismatches of elements, from those before a refinement: `found`, with the number then of each element, or
/// [`CHANGED`].
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn mismatches_after(
    found: &[Mismatch],
    numbers: &[u32],
    lattice: &RedGreenLattice,
    elements: &Elements,
    components: &Components,
    context: &RunContext,
) -> Result<Vec<Mismatch>> {
    let is_new = |e: &u32| numbers[*e as usize] == CHANGED;
    let all = (0..numbers.len() as u32).into_par_iter().with_min_len(CHUNK);
    let new: Vec<u32> = context.until_cancelled(all).filter(is_new).collect();
    context.check()?;
    let mut all = mismatches_of(lattice, elements, new, components, context)?;
    // Elements keep their order, and so do those that were there before.
    let mut kept = (0u32..).zip(numbers).filter(|(_, number)| **number != CHANGED).peekable();
    for mismatch in found {
        while kept.next_if(|(_, number)| **number < mismatch.element).is_some() {}
        if let Some((element, _)) = kept.peek().filter(|(_, number)| **number == mismatch.element) {
            all.push(Mismatch { element: *element, ..*mismatch });
        }
    }
    // Stable: those of one element keep their order.
    all.sort_by_key(|m| m.element);
    Ok(all)
}

fn mismatches_of(
    lattice: &RedGreenLattice,
    elements: &Elements,
    among: impl IntoParallelIterator<Item = u32, Iter: IndexedParallelIterator>,
    components: &Components,
    context: &RunContext,
) -> Result<Vec<Mismatch>> {
    let of_chunk = |chunk: Vec<u32>| {
        context.check()?;
        let mut found = Vec::new();
        for e in chunk {
            let first = found.len();
            let label = elements.labels[e as usize];
            for_each_foreign_voxel(lattice, &elements.tets[e as usize], label, |index, voxel_label| {
                let component = components.component_at(index.x as usize, index.y as usize, index.z as usize);
                let component = component.unwrap_or(u32::MAX);
                let same = |m: &&mut Mismatch| m.voxel_label == voxel_label && m.component == component;
                match found[first..].iter_mut().find(same) {
                    Some(mismatch) => mismatch.voxels += 1,
                    None => {
                        found.push(Mismatch { element: e, element_label: label, voxel_label, component, voxels: 1 });
                    }
                }
            });
        }
        Ok(found)
    };
    let chunks: Vec<Vec<Mismatch>> = among.into_par_iter().chunks(CHUNK).map(of_chunk).collect::<Result<_>>()?;
    Ok(chunks.concat())
}

/// Calls `visit` for every voxel whose centre lies in the tet.
pub fn for_each_voxel(lattice: &RedGreenLattice, tet: &[u32; 4], visit: impl FnMut(IVec3, Label)) {
    for_each_voxel_within(lattice, &lattice.corners(tet), visit);
}

fn for_each_voxel_within(lattice: &RedGreenLattice, points: &[DVec3; 4], mut visit: impl FnMut(IVec3, Label)) {
    let field = &lattice.field;
    let corners = points.map(|p| field.counting_index(p));
    let image = field.image;
    for_each_row(&corners, field.size(), |first, last, j, k| {
        let begin = image.grid().offset(first as usize, j as usize, k as usize);
        let row = &image.voxels()[begin..=begin + (last - first) as usize];
        row.iter().enumerate().for_each(|(step, label)| visit(IVec3::new(first + step as i32, j, k), *label));
    });
}

/// Voxels of a label in the tet.
pub fn voxels_of(lattice: &RedGreenLattice, tet: &[u32; 4], own: Label) -> usize {
    let mut count = 0;
    for_each_voxel(lattice, tet, |_, label| count += usize::from(label == own));
    count
}

/// Calls `visit` for every voxel whose centre lies in the tet and whose label is not `label`.
pub fn for_each_foreign_voxel(
    lattice: &RedGreenLattice,
    tet: &[u32; 4],
    label: Label,
    mut visit: impl FnMut(IVec3, Label),
) {
    let points = lattice.corners(tet);
    if uniform_label_of(lattice, &points) == Some(label) {
        return;
    }
    for_each_voxel_within(lattice, &points, |at, voxel_label| {
        if voxel_label != label {
            visit(at, voxel_label);
        }
    });
}

/// Calls `visit` with the components, one or more times each, of the voxels of a label in the tet; with the nearest voxel's where
/// all around the tet are of the label.
pub fn for_each_component(
    lattice: &RedGreenLattice,
    tet: &[u32; 4],
    own: Label,
    components: &Components,
    mut visit: impl FnMut(u32),
) {
    let mut visit_at = |at: IVec3| {
        components.component_at(at.x as usize, at.y as usize, at.z as usize).into_iter().for_each(&mut visit);
    };
    let points = lattice.corners(tet);
    if uniform_label_of(lattice, &points) == Some(own) {
        visit_at(lattice.field.nearest_voxel(points.iter().sum::<DVec3>() / 4.0));
    } else {
        for_each_voxel_within(lattice, &points, |at, label| {
            if label == own {
                visit_at(at);
            }
        });
    }
}

/// The label that all voxels around a tet of these corners have, where that shows at once.
fn uniform_label_of(lattice: &RedGreenLattice, points: &[DVec3; 4]) -> Option<Label> {
    let centroid = 0.25 * (points[0] + points[1] + points[2] + points[3]);
    let squared_radius = points.iter().map(|p| p.distance_squared(centroid)).fold(0.0, f64::max);
    lattice.field.uniform_label(centroid, squared_radius.sqrt())
}

/// Calls `visit(first, last, j, k)` for every row of whole indices inside a positive tet, within `0..size`.
pub fn for_each_row(corners: &[DVec3; 4], size: IVec3, mut visit: impl FnMut(i32, i32, i32, i32)) {
    let low = corners.iter().fold(DVec3::INFINITY, |a, b| a.min(*b));
    let high = corners.iter().fold(DVec3::NEG_INFINITY, |a, b| a.max(*b));
    let low = (-floor_of(-low)).max(IVec3::ZERO);
    let high = floor_of(high).min(size - 1);
    if low.cmpgt(high).any() {
        return;
    }
    let planes = TET_FACES.map(|[a, b, c]| {
        let normal = (corners[b] - corners[a]).cross(corners[c] - corners[a]);
        (normal, -normal.dot(corners[a]))
    });
    for k in low.z..=high.z {
        for j in low.y..=high.y {
            let (mut first, mut last) = (f64::from(low.x), f64::from(high.x));
            for (normal, offset) in &planes {
                // Inside: normal . (i, j, k) + offset <= 0, a bound on i.
                let rest = normal.y * f64::from(j) + normal.z * f64::from(k) + offset;
                if normal.x > 0.0 {
                    last = last.min(-rest / normal.x);
                } else if normal.x < 0.0 {
                    first = first.max(-rest / normal.x);
                } else if rest > 0.0 {
                    last = f64::NEG_INFINITY;
                }
            }
            let (first, last) = (first.ceil(), last.floor());
            if first <= last {
                visit(first as i32, last as i32, j, k);
            }
        }
    }
}

/// Counts per label: voxels in the image, missed by the mesh, wrongly covered by it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LabelCount {
    /// Voxels of the label in the image.
    pub image: u64,
    /// Of these, in elements of other labels.
    pub missed: u64,
    /// Voxels of other labels in its elements.
    pub wrong: u64,
}

impl LabelCount {
    /// The smaller of F1 and F2.
    pub fn fidelity(&self) -> f64 {
        if self.image == 0 {
            return 1.0;
        }
        let common = (self.image - self.missed) as f64;
        let covered = common + self.wrong as f64;
        if covered == 0.0 { 0.0 } else { (common / covered).min(common / self.image as f64) }
    }
}
