//! Pieces of a label in the mesh: elements connected through faces, and what becomes of small loose ones.
//!
//! # Method
//! Elements are united with those of their label behind their faces, in parallel within chunks, then across these.
//!
//! # Source
//! [Drakopoulos2017] 2.3.3, mesh topological checks.
//!
//! # Invariants
//! Regions are in the order of their first element, the elements of a region in theirs.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::connected_components::{Components, unite};
use crate::index::Label;
use crate::lattice::face_adjacency::OUTSIDE;
use crate::lattice::interface_topology::InterfaceTopology;
use crate::lattice::pinch_fillings::Regions;
use crate::lattice::red_green::{Elements, RedGreenLattice};
use crate::lattice::voxel_fidelity::{for_each_component, for_each_voxel};
use crate::mesh::numbering::TET_FACES;

/// Elements between two looks at whether the run is cancelled: a few milliseconds.
const ELEMENTS_PER_CHECK: usize = 1 << 16;

/// Elements per parallel work item.
const CHUNK: usize = 4096;

/// What may be joined: the region of each element, and how many regions more than the image each label has.
pub fn joinable_regions(elements: &Elements, regions: &[(Label, Vec<u32>)], surplus: Vec<i64>) -> Regions {
    Regions { of_element: numbers_in(regions, elements.tets.len()), surplus }
}

/// The region of each of some elements, by its number; `u32::MAX` for those of none.
pub fn numbers_in(regions: &[(Label, Vec<u32>)], elements: usize) -> Vec<u32> {
    let mut numbers = vec![u32::MAX; elements];
    for ((_, region), number) in regions.iter().zip(0..) {
        region.iter().for_each(|e| numbers[*e as usize] = number);
    }
    numbers
}

/// Whether any of some corners of an element is inside of the image: `is_inside` tells of each vertex.
#[inline]
pub fn is_any_inside(tet: &[u32; 4], corners: &[usize], is_inside: &[bool]) -> bool {
    corners.iter().any(|corner| is_inside[tet[*corner] as usize])
}

/// Numbers elements by the image's components (`components`, through faces, edges and vertices) instead of by regions of the
/// mesh: whether pieces that touch at an edge or a vertex only are one is left open by the image, so they may be joined.
///
/// A region goes by the first of its elements that holds the centre of a voxel of its own; one without keeps a number of its
/// own.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn number_by_image(
    regions: &mut Regions,
    members: &[(Label, Vec<u32>)],
    lattice: &RedGreenLattice,
    elements: &Elements,
    components: &Components,
    context: &RunContext,
) -> Result<()> {
    let component_of = |element: u32, own: Label| {
        let mut component = None;
        for_each_component(lattice, &elements.tets[element as usize], own, components, |found| {
            component = component.or(Some(found));
        });
        component
    };
    let count = components.components().len() as u32;
    let number_of = |(r, (own, region)): (usize, &(Label, Vec<u32>))| {
        region.iter().find_map(|e| component_of(*e, *own)).unwrap_or(count + r as u32)
    };
    let numbers: Vec<u32> = context.until_cancelled(members.par_iter().enumerate()).map(number_of).collect();
    context.check()?;
    regions.of_element.par_iter_mut().filter(|r| **r != u32::MAX).for_each(|r| *r = numbers[*r as usize]);
    Ok(())
}

/// Regions of each label in the mesh minus its components in the image (`component_counts`).
pub fn surplus_of(regions: &[(Label, Vec<u32>)], in_image: &[i64]) -> Vec<i64> {
    let mut surplus: Vec<i64> = in_image.iter().map(|count| -count).collect();
    regions.iter().for_each(|(label, _)| surplus[label.index()] += 1);
    surplus[Label::BACKGROUND.index()] = 0;
    surplus
}

/// Elements connected through faces within one label; background is left out.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn regions_of(labels: &[Label], neighbors: &[[u32; 4]], context: &RunContext) -> Result<Vec<(Label, Vec<u32>)>> {
    regions_where(labels, neighbors, context, |label| !label.is_background())
}

/// Elements connected through faces within one label, the background too.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn regions_with_background(
    labels: &[Label],
    neighbors: &[[u32; 4]],
    context: &RunContext,
) -> Result<Vec<(Label, Vec<u32>)>> {
    regions_where(labels, neighbors, context, |_| true)
}

/// As [`regions_of`], of what is left of the elements inside of the image; `is_inside` tells of each vertex whether it is there.
///
/// # Errors
/// As [`regions_of`].
pub fn regions_inside(
    tets: &[[u32; 4]],
    labels: &[Label],
    neighbors: &[[u32; 4]],
    is_inside: &[bool],
    context: &RunContext,
) -> Result<Vec<(Label, Vec<u32>)>> {
    let any_inside = |tet: &[u32; 4], corners: &[usize]| is_any_inside(tet, corners, is_inside);
    // What lies beyond has no part in it, nor do faces there.
    let of_element =
        |tet: &[u32; 4], label: &Label| if any_inside(tet, &[0, 1, 2, 3]) { *label } else { Label::BACKGROUND };
    let across = |tet: &[u32; 4], row: &[u32; 4]| {
        std::array::from_fn(|face| if any_inside(tet, &TET_FACES[face]) { row[face] } else { OUTSIDE })
    };
    let labels: Vec<Label> = tets.par_iter().with_min_len(CHUNK).zip(labels).map(|(t, l)| of_element(t, l)).collect();
    let neighbors: Vec<[u32; 4]> =
        tets.par_iter().with_min_len(CHUNK).zip(neighbors).map(|(t, row)| across(t, row)).collect();
    context.check()?;
    regions_of(&labels, &neighbors, context)
}

/// Elements connected through faces within one label that passes.
fn regions_where(
    labels: &[Label],
    neighbors: &[[u32; 4]],
    context: &RunContext,
    passes: impl Fn(Label) -> bool + Sync,
) -> Result<Vec<(Label, Vec<u32>)>> {
    let mut parents = vec![0u32; labels.len()];
    // Those of a chunk are united by one thread, which knows them by their places in it; what faces an earlier chunk is left over.
    let unite_chunk = |(chunk, parents): (usize, &mut [u32])| {
        let first = chunk * ELEMENTS_PER_CHECK;
        parents.iter_mut().zip(0..).for_each(|(parent, place)| *parent = place);
        let mut across: Vec<[u32; 2]> = Vec::new();
        for place in 0..parents.len() {
            let e = first + place;
            if !passes(labels[e]) {
                continue;
            }
            let is_earlier = |near: &u32| (*near as usize) < e && labels[*near as usize] == labels[e];
            for near in neighbors[e].into_iter().filter(is_earlier) {
                match (near as usize).checked_sub(first) {
                    Some(other) => _ = unite(parents, other as u32, place as u32),
                    None => across.push([near, e as u32]),
                }
            }
        }
        parents.iter_mut().for_each(|parent| *parent += first as u32);
        across
    };
    let chunks = context.until_cancelled(parents.par_chunks_mut(ELEMENTS_PER_CHECK).enumerate());
    let across: Vec<Vec<[u32; 2]>> = chunks.map(unite_chunk).collect();
    context.check()?;
    across.into_iter().flatten().for_each(|[a, b]| _ = unite(&mut parents, a, b));
    // Each leads to an earlier one of its region, which has the number of that by then, or is the first.
    let mut regions: Vec<(Label, Vec<u32>)> = Vec::new();
    for e in 0..labels.len() {
        context.check_every(ELEMENTS_PER_CHECK, e)?;
        if passes(labels[e]) {
            let parent = parents[e] as usize;
            if parent == e {
                parents[e] = regions.len() as u32;
                regions.push((labels[e], Vec::new()));
            } else {
                parents[e] = parents[parent];
            }
            regions[parents[e] as usize].1.push(e as u32);
        }
    }
    Ok(regions)
}

/// Fills the regions and closed cavities that no voxel of the image stands for, where that makes no surface pinch; returns how
/// many elements changed.
///
/// # Errors
/// As [`regions_of`].
pub fn fill_unseen_regions(
    lattice: &RedGreenLattice,
    elements: &mut Elements,
    neighbors: &[[u32; 4]],
    context: &RunContext,
) -> Result<usize> {
    let is_seen = |e: &u32| {
        let (own, mut any) = (elements.labels[*e as usize], false);
        for_each_voxel(lattice, &elements.tets[*e as usize], |_, label| any |= label == own);
        any
    };
    // The background around the lattice has all its voxels beyond it.
    let is_outside =
        |e: &u32| elements.labels[*e as usize].is_background() && neighbors[*e as usize].contains(&OUTSIDE);
    let regions = regions_with_background(&elements.labels, neighbors, context)?;
    let unseen = context.until_cancelled(regions);
    let unseen = unseen.filter(|(_, region)| !region.iter().any(|e| is_seen(e) || is_outside(e)));
    let unseen: Vec<(Label, Vec<u32>)> = unseen.collect();
    context.check()?;
    if unseen.is_empty() {
        return Ok(0);
    }
    let topology = InterfaceTopology::new(&elements.tets, neighbors, lattice.vertices.positions.len(), context)?;
    let mut changed = 0;
    for (own, region) in unseen {
        context.check()?;
        let mut around: Vec<Label> =
            region.iter().flat_map(|e| neighbors[*e as usize]).map(|n| label_of(&elements.labels, n)).collect();
        around.retain(|label| *label != own);
        around.sort_unstable();
        let mut runs: Vec<(usize, Label)> = around.chunk_by(|a, b| a == b).map(|run| (run.len(), run[0])).collect();
        runs.sort_unstable_by_key(|(faces, label)| (std::cmp::Reverse(*faces), *label));
        let filling =
            runs.into_iter().map(|(_, label)| label).find(|l| topology.gain(&region, *l, &mut elements.labels) <= 0);
        if let Some(label) = filling {
            region.iter().for_each(|e| elements.labels[*e as usize] = label);
            changed += region.len();
        }
    }
    Ok(changed)
}

fn label_of(labels: &[Label], element: u32) -> Label {
    if element == OUTSIDE { Label::BACKGROUND } else { labels[element as usize] }
}

/// Gives regions below a share of their label's volume the commonest label around them.
///
/// # Errors
/// As [`regions_of`].
pub fn relabel_loose_regions(
    lattice: &RedGreenLattice,
    elements: &mut Elements,
    neighbors: &[[u32; 4]],
    labels: usize,
    threshold: f64,
    context: &RunContext,
) -> Result<()> {
    let volume = |e: &u32| {
        let [a, b, c, d] = elements.tets[*e as usize].map(|v| lattice.vertices.positions[v as usize].as_dvec3());
        (b - a).cross(c - a).dot(d - a)
    };
    let regions = regions_of(&elements.labels, neighbors, context)?;
    let mut volumes: Vec<f64> = Vec::with_capacity(regions.len());
    for (_, region) in &regions {
        let mut sum = 0.0;
        for part in region.chunks(ELEMENTS_PER_CHECK) {
            context.check()?;
            part.iter().for_each(|e| sum += volume(e));
        }
        volumes.push(sum);
    }
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
            let other = label_of(&elements.labels, near);
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
    Ok(())
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
            let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
            relabel_loose_regions(&lattice, &mut elements, &neighbors, 2, threshold, context).unwrap();
            regions_of(&elements.labels, &neighbors, context).unwrap().len()
        })
    }

    #[test]
    fn a_bubble_without_a_voxel_is_filled_and_a_cavity_stays() {
        // A cavity of eight voxels in a ball, and elements of background elsewhere in it that hold no voxel centre.
        let image =
            voxel_image(20, |p| u16::from(p.distance(DVec3::splat(9.2)) < 7.5 && (p - 8.5).abs().max_element() > 1.0));
        with_lattice(&image, 1.0, |lattice, context| {
            let mut elements = lattice.elements(context).unwrap();
            let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
            let before = elements.labels.clone();
            let is_deep =
                |e: &usize| (4.0..5.0).contains(&lattice.centroid(&elements.tets[*e]).distance(DVec3::splat(9.2)));
            let holds_none = |e: &usize| {
                let mut any = false;
                for_each_voxel(&lattice, &elements.tets[*e], |_, _| any = true);
                !any
            };
            let bubble = (0..before.len()).filter(is_deep).find(holds_none).unwrap();
            elements.labels[bubble] = Label::BACKGROUND;
            assert_eq!(fill_unseen_regions(&lattice, &mut elements, &neighbors, context).unwrap(), 1);
            assert_eq!(elements.labels, before);
            assert!(
                elements
                    .tets
                    .iter()
                    .zip(&before)
                    .any(|(tet, l)| l.is_background() && lattice.centroid(tet).distance(DVec3::splat(8.5)) < 1.0)
            );
        });
    }

    #[test]
    fn what_hangs_together_beyond_the_border_only_is_in_pieces_inside() {
        // Tets in a row: the third and the fourth share a face beyond, of the fourth nothing is inside.
        let tets: Vec<[u32; 4]> = (0..6).map(|v| [v, v + 1, v + 2, v + 3]).collect();
        let context = RunContext::with_threads(1).unwrap();
        let neighbors = neighbors_of(&tets, 9, &context).unwrap();
        let labels = [Label(1); 6];
        let inside = |beyond: [u32; 4]| {
            let is_inside: Vec<bool> = (0..9).map(|v| !beyond.contains(&v)).collect();
            let found = regions_inside(&tets, &labels, &neighbors, &is_inside, &context).unwrap();
            found.into_iter().map(|(_, region)| region).collect::<Vec<_>>()
        };
        assert_eq!(inside([9; 4]), [vec![0, 1, 2, 3, 4, 5]]);
        assert_eq!(inside([3, 4, 5, 9]), [vec![0, 1, 2], vec![3, 4, 5]]);
        assert_eq!(inside([3, 4, 5, 6]), [vec![0, 1, 2], vec![4, 5]]);
    }

    #[test]
    fn regions_across_chunks_are_whole_and_in_order() {
        let context = RunContext::with_threads(2).unwrap();
        let count = 3 * ELEMENTS_PER_CHECK + 5;
        // A chain of all elements, each far from the next one; of every ten thousand one thousand on end has another label.
        let at = |place: usize| place * 7919 % count;
        let mut neighbors = vec![[OUTSIDE; 4]; count];
        let mut labels = vec![Label(1); count];
        for place in 0..count {
            if place > 0 {
                (neighbors[at(place)][2], neighbors[at(place - 1)][1]) = (at(place - 1) as u32, at(place) as u32);
            }
            labels[at(place)] = Label(1 + u16::from(place / 1000 % 10 == 3));
        }
        let mut expected: Vec<(Label, Vec<u32>)> = Vec::new();
        for place in 0..count {
            let (label, e) = (labels[at(place)], at(place) as u32);
            match expected.last_mut().filter(|last| last.0 == label) {
                Some((_, region)) => region.push(e),
                None => expected.push((label, vec![e])),
            }
        }
        expected.iter_mut().for_each(|(_, region)| region.sort_unstable());
        expected.sort_by_key(|(_, region)| region[0]);
        assert!(expected.len() > 30);
        assert!(context.install(|| regions_of(&labels, &neighbors, &context)).unwrap() == expected);
    }

    #[test]
    fn a_cancelled_run_finds_no_regions() {
        let context = RunContext::with_threads(1).unwrap();
        let found = || regions_of(&[Label(1); 2], &[[1, OUTSIDE, OUTSIDE, OUTSIDE], [0; 4]], &context);
        assert_eq!(found().unwrap(), [(Label(1), vec![0, 1])]);
        context.cancel_token().cancel();
        assert!(matches!(found(), Err(crate::Error::Cancelled)));
    }

    #[test]
    fn a_loose_region_below_the_threshold_goes_and_others_stay() {
        assert_eq!(regions_left(0.001), 2);
        assert_eq!(regions_left(0.1), 1);
    }
}
