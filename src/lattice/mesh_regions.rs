//! Pieces of a label in the mesh: elements connected through faces, and what becomes of small loose ones.
//!
//! # Source
//! [Drakopoulos2017] 2.3.3, mesh topological checks.
//!
//! # Invariants
//! Regions are in the order of their first element.

use crate::image::connected_components::Components;
use crate::index::Label;
use crate::lattice::face_adjacency::OUTSIDE;
use crate::lattice::interface_carving::Regions;
use crate::lattice::red_green::{Elements, RedGreenLattice};

/// What may be joined: the region of each element, and how many regions more than the image each label has.
pub fn joinable_regions(elements: &Elements, regions: &[(Label, Vec<u32>)], surplus: Vec<i64>) -> Regions {
    let mut of_element = vec![u32::MAX; elements.tets.len()];
    for (r, (_, region)) in regions.iter().enumerate() {
        region.iter().for_each(|e| of_element[*e as usize] = r as u32);
    }
    Regions { of_element, surplus }
}

/// Regions of each label in the mesh minus its components in the image.
pub fn surplus_of(regions: &[(Label, Vec<u32>)], image: &Components, labels: usize) -> Vec<i64> {
    let mut surplus = vec![0i64; labels];
    image.components().iter().for_each(|c| surplus[c.label.index()] -= 1);
    regions.iter().for_each(|(label, _)| surplus[label.index()] += 1);
    surplus[Label::BACKGROUND.index()] = 0;
    surplus
}

/// Elements connected through faces within one label; background is left out.
pub fn regions_of(labels: &[Label], neighbors: &[[u32; 4]]) -> Vec<(Label, Vec<u32>)> {
    let mut seen = vec![false; labels.len()];
    let mut regions = Vec::new();
    for start in 0..labels.len() {
        let label = labels[start];
        if seen[start] || label.is_background() {
            continue;
        }
        seen[start] = true;
        let mut region = vec![start as u32];
        let mut next = 0;
        while next < region.len() {
            for near in neighbors[region[next] as usize] {
                if near != OUTSIDE && !seen[near as usize] && labels[near as usize] == label {
                    seen[near as usize] = true;
                    region.push(near);
                }
            }
            next += 1;
        }
        regions.push((label, region));
    }
    regions
}

/// Gives regions below a share of their label's volume the commonest label around them.
pub fn relabel_loose_regions(
    lattice: &RedGreenLattice,
    elements: &mut Elements,
    neighbors: &[[u32; 4]],
    labels: usize,
    threshold: f64,
) {
    let volume = |e: &u32| {
        let [a, b, c, d] = elements.tets[*e as usize].map(|v| lattice.vertices.positions[v as usize].as_dvec3());
        (b - a).cross(c - a).dot(d - a)
    };
    let regions = regions_of(&elements.labels, neighbors);
    let volumes: Vec<f64> = regions.iter().map(|(_, region)| region.iter().map(volume).sum()).collect();
    let (mut totals, mut largest) = (vec![0.0; labels], vec![(0.0, 0); labels]);
    for (r, ((label, _), volume)) in regions.iter().zip(&volumes).enumerate() {
        totals[label.index()] += volume;
        if *volume > largest[label.index()].0 {
            largest[label.index()] = (*volume, r);
        }
    }
    for (r, (label, region)) in regions.iter().enumerate() {
        if largest[label.index()].1 == r || volumes[r] >= threshold * totals[label.index()] {
            continue;
        }
        let mut around: Vec<Label> = Vec::new();
        for near in region.iter().flat_map(|e| neighbors[*e as usize]) {
            let other = if near == OUTSIDE { Label::BACKGROUND } else { elements.labels[near as usize] };
            if other != *label {
                around.push(other);
            }
        }
        around.sort_unstable();
        let commonest = around.chunk_by(|a, b| a == b).max_by_key(|run| (run.len(), std::cmp::Reverse(run[0])));
        if let Some(run) = commonest {
            region.iter().for_each(|e| elements.labels[*e as usize] = run[0]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::label_image::LabelImage;
    use crate::lattice::face_adjacency::neighbors_of;
    use crate::lattice::test_images::{voxel_image, with_lattice};
    use glam::DVec3;

    /// A ball and, apart from it, a small cube of the same label.
    fn ball_and_speck() -> LabelImage {
        let in_speck = |p: DVec3| (p - DVec3::splat(16.5)).abs().max_element() < 1.6;
        voxel_image(20, |p| u16::from(in_speck(p) || p.distance(DVec3::splat(7.2)) < 5.5))
    }

    /// Regions left when those below a share of the label become what is around them.
    fn regions_left(threshold: f64) -> usize {
        with_lattice(&ball_and_speck(), 1.5, |lattice, context| {
            let mut elements = lattice.elements(context).unwrap();
            let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len()).unwrap();
            relabel_loose_regions(&lattice, &mut elements, &neighbors, 2, threshold);
            regions_of(&elements.labels, &neighbors).len()
        })
    }

    #[test]
    fn a_loose_region_below_the_threshold_goes_and_others_stay() {
        assert_eq!(regions_left(0.001), 2);
        assert_eq!(regions_left(0.1), 1);
    }
}
