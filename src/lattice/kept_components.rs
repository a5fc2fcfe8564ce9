//! What components of the image still have of the mesh while surfaces are carved: the last voxel of one is not to be taken.
//!
//! # Method
//! 1. Count the voxels of each component whose centres lie in elements of their label: all, but the mismatches.
//! 2. Filling a group of vertices takes the parts of elements nearest to these, where the barycentric coordinates of the group's
//!    vertices make up half or more ([`super::pinch_fillings`]); count the voxels there.
//! 3. A component of which all go is lost, unless its own label fills.
//!
//! # Source
//! Our own.
//!
//! # Limits
//! Voxels that a label wins are not counted: they have another part of it beside them anyway.

use crate::geometry::tetrahedron::barycentric;
use crate::image::connected_components::Components;
use crate::index::Label;
use crate::lattice::red_green::RedGreenLattice;
use crate::lattice::subdivision_criteria::is_wanted;
use crate::lattice::voxel_fidelity::{Mismatch, for_each_voxel};

/// How many voxels of each component of the image lie in elements of their label.
pub struct KeptComponents<'a> {
    components: &'a Components,
    left: Vec<u64>,
}

/// Voxels of a component that a filling takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Taken {
    component: u32,
    voxels: u64,
}

impl<'a> KeptComponents<'a> {
    /// Counts those of elements with these mismatches.
    pub fn new(components: &'a Components, mismatches: &[Mismatch]) -> Self {
        let mut left: Vec<u64> = components.components().iter().map(|component| component.voxels).collect();
        for m in mismatches.iter().filter(|m| m.component != u32::MAX) {
            left[m.component as usize] -= u64::from(m.voxels);
        }
        Self { components, left }
    }

    /// What filling the vertices of a group, sorted, takes of some elements around them.
    pub fn taken_of<'e>(
        &self,
        elements: impl Iterator<Item = (&'e [u32; 4], Label)>,
        group: &[u32],
        lattice: &RedGreenLattice,
    ) -> Vec<Taken> {
        let mut taken: Vec<Taken> = Vec::new();
        for (tet, own) in elements {
            let is_filled = tet.map(|v| group.binary_search(&v).is_ok());
            let corners = lattice.corners(tet).map(|p| lattice.field.counting_index(p));
            for_each_voxel(lattice, tet, |at, label| {
                let [i, j, k] = at.to_array().map(|x| x as usize);
                let Some(component) = self.components.component_at(i, j, k).filter(|_| label == own) else { return };
                let weights = barycentric(corners, at.as_dvec3()).into_iter().zip(is_filled);
                let share: f64 = weights.filter(|(_, filled)| *filled).map(|(weight, _)| weight).sum();
                if share < 0.5 {
                    return;
                }
                match taken.iter_mut().find(|t| t.component == component) {
                    Some(known) => known.voxels += 1,
                    None => taken.push(Taken { component, voxels: 1 }),
                }
            });
        }
        taken
    }

    /// How many components lose their last voxels to a filling with a label.
    pub fn lost_to(&self, label: Label, taken: &[Taken]) -> usize {
        let is_lost = |t: &&Taken| {
            let component = &self.components.components()[t.component as usize];
            let left = self.left[t.component as usize];
            component.label != label && is_wanted(component) && left > 0 && t.voxels >= left
        };
        taken.iter().filter(is_lost).count()
    }

    /// Gives what is taken to a label.
    pub fn take(&mut self, label: Label, taken: &[Taken]) {
        for t in taken {
            if self.components.components()[t.component as usize].label != label {
                let left = &mut self.left[t.component as usize];
                *left = left.saturating_sub(t.voxels);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
    use crate::lattice::test_images::{components_of, voxel_image, with_lattice};
    use crate::lattice::voxel_fidelity::mismatches;
    use glam::DVec3;

    #[test]
    fn the_last_voxel_goes_with_the_half_of_its_tet_that_holds_it_unless_its_own_label_fills() {
        // A voxel of label 1, far from two others that have no element.
        let alone = DVec3::new(9.0, 8.0, 7.0);
        let image = voxel_image(16, |p| if p == alone || p.x < 2.0 && p.y + p.z == 0.0 { 1 } else { 2 });
        with_lattice(&image, 1.0, |lattice, context: &RunContext| {
            let mut elements = lattice.elements(context).unwrap();
            let holds = |tet: &[u32; 4]| {
                let mut holds = false;
                for_each_voxel(&lattice, tet, |at, _| holds |= at.as_dvec3() == alone);
                holds
            };
            elements.labels.fill(Label(2));
            let here = elements.tets.iter().position(holds).unwrap();
            elements.labels[here] = Label(1);
            let components = components_of(&image, context);
            let found = mismatches(&lattice, &elements, &components, context).unwrap();
            let mut kept = KeptComponents::new(&components, &found);
            let mut group = elements.tets[here];
            group.sort_unstable();
            let all = || elements.tets.iter().zip(elements.labels.iter().copied());
            let lost = |kept: &KeptComponents, taken: &[Taken]| [1, 2].map(|label| kept.lost_to(Label(label), taken));
            let taken = kept.taken_of(all(), &group, &lattice);
            assert_eq!(lost(&kept, &taken), [0, 1], "label 2 has other voxels");
            // Of the two halves of the tet between two pairs of its vertices one holds the voxel.
            let halves = [&group[..2], &group[2..]].map(|half| kept.taken_of(all(), half, &lattice));
            assert_eq!(halves.map(|half| lost(&kept, &half)[1]).iter().sum::<usize>(), 1);
            kept.take(Label(1), &taken);
            assert_eq!(lost(&kept, &taken), [0, 1]);
            kept.take(Label(2), &taken);
            assert_eq!(lost(&kept, &taken), [0, 0], "what is gone is not lost again");
        });
    }
}
