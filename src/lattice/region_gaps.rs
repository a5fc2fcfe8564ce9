//! Where the mesh breaks a label that is whole in the image: the places to refine until its pieces meet.
//!
//! # Method
//! 1. Each voxel of a label with more regions in the mesh than components in the image gets the region of the element
//!    that its centre lies in, if that has the voxel's label.
//! 2. Voxels that lie in elements of other labels get the region of a neighbour through a face, layer by layer.
//! 3. Two neighbours through a face with different regions are a gap: the mesh has no way from one to the other although
//!    the image has. A gap's elements and their neighbours through faces are refined, and whole regions without a voxel.
//!
//! # Source
//! [Drakopoulos2017] 2.3.3, mesh topological checks.
//!
//! # Differences
//! The thesis refines all elements of a label that is in pieces. On six touching blobs of 30 thousand voxels each that made
//! 20 million tets to mend gaps of a few voxels.
//!
//! # Invariants
//! A label with more regions than components has a gap or a region without a voxel: otherwise each component had one
//! region, and each region a component.

use std::collections::BTreeSet;

use glam::IVec3;
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::index::Label;
use crate::lattice::face_adjacency::with_neighbors;
use crate::lattice::pinch_fillings::Regions;
use crate::lattice::red_green::{Elements, RedGreenLattice};
use crate::lattice::voxel_fidelity::{Mismatch, for_each_voxel};

/// Elements per parallel work item.
const CHUNK: usize = 1024;

/// No region.
const NONE: u32 = u32::MAX;

/// Steps along the axes.
pub const STEPS: [IVec3; 6] = [IVec3::X, IVec3::NEG_X, IVec3::Y, IVec3::NEG_Y, IVec3::Z, IVec3::NEG_Z];

/// The elements at gaps of labels that are in too many pieces, in increasing order; `found` are the mismatches of all elements.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn elements_at_gaps(
    lattice: &RedGreenLattice,
    elements: &Elements,
    neighbors: &[[u32; 4]],
    found: &[Mismatch],
    regions: &Regions,
    context: &RunContext,
) -> Result<Vec<u32>> {
    let is_broken = |label: Label| regions.surplus[label.index()] > 0;
    if !regions.surplus.iter().any(|s| *s > 0) {
        return Ok(Vec::new());
    }
    let mut of_voxel = vec![NONE; lattice.field.image.voxels().len()];
    let mut has_voxel =
        vec![false; regions.of_element.iter().filter(|r| **r != NONE).max().map_or(0, |r| *r as usize + 1)];
    let own = own_voxels(lattice, elements, regions, context)?;
    for (voxel, e) in &own {
        let region = regions.of_element[*e as usize];
        of_voxel[*voxel] = region;
        has_voxel[region as usize] = true;
    }
    let gaps = gap_voxels(lattice, &mut of_voxel, is_broken, context)?;
    // A voxel lies in an element of its label or is a mismatch.
    let mut met: Vec<u32> = own.iter().filter(|(voxel, _)| gaps.contains(voxel)).map(|(_, e)| *e).collect();
    let holds_gap = |e: &u32| {
        let mut any = false;
        for_each_voxel(lattice, &elements.tets[*e as usize], |at, _| any |= gaps.contains(&offset_of(lattice, at)));
        any
    };
    // Those of one element follow each other.
    let mut foreign: Vec<u32> = found.iter().filter(|m| is_broken(m.voxel_label)).map(|m| m.element).collect();
    foreign.dedup();
    met.par_extend(context.until_cancelled(foreign.into_par_iter().with_min_len(CHUNK)).filter(holds_gap));
    context.check()?;
    let is_without = |e: &u32| {
        let region = regions.of_element[*e as usize];
        region != NONE && is_broken(elements.labels[*e as usize]) && !has_voxel[region as usize]
    };
    let all = (0..elements.tets.len() as u32).into_par_iter().with_min_len(CHUNK);
    met.par_extend(context.until_cancelled(all).filter(is_without));
    context.check()?;
    Ok(with_neighbors(&met, neighbors))
}

/// Offset of a voxel in the image.
fn offset_of(lattice: &RedGreenLattice, at: IVec3) -> usize {
    lattice.field.image.grid().offset(at.x as usize, at.y as usize, at.z as usize)
}

/// Voxels of broken labels that lie in an element of their label, with that.
fn own_voxels(
    lattice: &RedGreenLattice,
    elements: &Elements,
    regions: &Regions,
    context: &RunContext,
) -> Result<Vec<(usize, u32)>> {
    let own = |e: u32| {
        let mut found = Vec::new();
        let label = elements.labels[e as usize];
        if regions.surplus[label.index()] > 0 {
            for_each_voxel(lattice, &elements.tets[e as usize], |at, of_voxel| {
                if of_voxel == label {
                    found.push((offset_of(lattice, at), e));
                }
            });
        }
        found
    };
    let all = (0..elements.tets.len() as u32).into_par_iter().with_min_len(CHUNK);
    let voxels = context.until_cancelled(all).flat_map_iter(own).collect();
    context.check()?;
    Ok(voxels)
}

/// Gives the voxels without a region that of a neighbour, and returns those where different regions meet.
fn gap_voxels(
    lattice: &RedGreenLattice,
    of_voxel: &mut [u32],
    is_broken: impl Fn(Label) -> bool,
    context: &RunContext,
) -> Result<BTreeSet<usize>> {
    let image = lattice.field.image;
    let (grid, voxels) = (image.grid(), image.voxels());
    let size = IVec3::from_array(grid.size().map(|s| s as i32));
    let neighbors = |voxel: usize| {
        let at = IVec3::from_array(grid.voxel_at(voxel).map(|i| i as i32));
        let inside = move |p: &IVec3| p.cmpge(IVec3::ZERO).all() && p.cmplt(size).all();
        let offsets = STEPS.into_iter().map(move |step| at + step).filter(inside);
        let offsets = offsets.map(|p| grid.offset(p.x as usize, p.y as usize, p.z as usize));
        offsets.filter(move |other| voxels[*other] == voxels[voxel])
    };
    let broken: Vec<usize> = (0..voxels.len()).filter(|v| is_broken(voxels[*v])).collect();
    let mut missed: Vec<usize> = broken.iter().copied().filter(|v| of_voxel[*v] == NONE).collect();
    loop {
        // All voxels of a layer look at the layers before, whatever their order.
        let found = |v: &usize| {
            neighbors(*v).map(|other| of_voxel[other]).filter(|region| *region != NONE).min().map(|region| (*v, region))
        };
        let layer: Vec<(usize, u32)> = context.until_cancelled(&missed).filter_map(found).collect();
        context.check()?;
        if layer.is_empty() {
            break;
        }
        layer.into_iter().for_each(|(v, region)| of_voxel[v] = region);
        missed.retain(|v| of_voxel[*v] == NONE);
    }
    let meets_other = |v: &usize| {
        let own = of_voxel[*v];
        own != NONE && neighbors(*v).any(|other| of_voxel[other] != NONE && of_voxel[other] != own)
    };
    let gaps = context.until_cancelled(broken).filter(meets_other).collect();
    context.check()?;
    Ok(gaps)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
    use crate::image::connected_components::{Components, Connectivity, Members, component_counts};
    use crate::image::label_image::LabelImage;
    use crate::lattice::face_adjacency::neighbors_of;
    use crate::lattice::mesh_regions::{joinable_regions, regions_of, surplus_of};
    use crate::lattice::test_images::{voxel_image, with_lattice};
    use crate::lattice::voxel_fidelity::mismatches;
    use glam::DVec3;

    const LEFT: DVec3 = DVec3::new(10.0, 15.2, 15.1);
    const RIGHT: DVec3 = DVec3::new(30.0, 15.2, 15.1);

    #[test]
    fn a_bridge_that_the_mesh_has_lost_is_found_and_nothing_else_is_marked() {
        // Two balls and a bridge of one voxel between them, around which the elements are too large.
        let image = voxel_image(40, |p| {
            let on_bridge = p.y == 15.0 && p.z == 15.0 && (10.0..30.0).contains(&p.x);
            u16::from(on_bridge || p.distance(LEFT).min(p.distance(RIGHT)) < 6.5)
        });
        with_lattice(&image, 4.0, |lattice, context| mark_the_bridge(&image, lattice, context));
    }

    fn mark_the_bridge(image: &LabelImage, lattice: RedGreenLattice, context: &RunContext) {
        let mut elements = lattice.elements(context).unwrap();
        let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
        // Elements around the middle of the bridge lose their label.
        let center = |tet: &[u32; 4]| {
            tet.iter().map(|v| lattice.frame.local(lattice.vertices.positions[*v as usize])).sum::<DVec3>() / 4.0
        };
        for (tet, label) in elements.tets.iter().zip(&mut elements.labels) {
            let center = center(tet);
            let is_in_ball = center.distance(LEFT).min(center.distance(RIGHT)) < 6.5;
            *label = Label(u16::from(is_in_ball));
        }
        let found = regions_of(&elements.labels, &neighbors, context).unwrap();
        let surplus = surplus_of(&found, &component_counts(image, Connectivity::Face, context).unwrap());
        assert_eq!(surplus[1], 1);
        let regions = joinable_regions(&elements, &found, surplus);
        let components = Components::new(image, Connectivity::Vertex, Members::All, context).unwrap();
        let mismatches = mismatches(&lattice, &elements, &components, context).unwrap();
        let marked = elements_at_gaps(&lattice, &elements, &neighbors, &mismatches, &regions, context).unwrap();
        assert!(!marked.is_empty() && marked.len() < elements.tets.len() / 20, "{}", marked.len());
        // They lie where the fronts from both balls meet.
        assert!(
            marked.iter().all(|e| center(&elements.tets[*e as usize]).distance(DVec3::new(20.0, 15.0, 15.0)) < 6.0)
        );

        // A label whose regions are those of the image has no gap.
        let whole = Regions { of_element: regions.of_element, surplus: vec![0, 0] };
        assert!(elements_at_gaps(&lattice, &elements, &neighbors, &mismatches, &whole, context).unwrap().is_empty());
    }
}
