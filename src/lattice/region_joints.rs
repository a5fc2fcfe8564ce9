//! Where the mesh joins what the image keeps apart: the places to refine until the components of a label part.
//!
//! # Method
//! 1. Regions of labels with several components in the image are gone through for the components of their voxels: the largest
//!    region of a label only where a component is in none of the others.
//! 2. In a region with more than one, each element goes by the first component that it has voxels of, those without by a neighbour
//!    through a face, layer by layer.
//! 3. Two neighbours with different components are a joint, and so is an element with voxels of two. These and their neighbours
//!    through faces are refined. What lies past the image border joins nothing where the lattice is cut there.
//!
//! # Source
//! Our own: what [`region_gaps`](crate::lattice::region_gaps) is for a label that is broken.
//!
//! # Limits
//! A part of a component that joins the largest region of its label is not seen while another part is a region of its own.
//!
//! # Cost
//! A look at the elements of the smaller regions, most often few, in the order of all; 4 bytes an element for it, and 5 where something
//! is joined.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::connected_components::Components;
use crate::index::{Label, each_once};
use crate::lattice::face_adjacency::{OUTSIDE, with_neighbors};
use crate::lattice::mesh_regions::is_any_inside;
use crate::lattice::red_green::{Elements, RedGreenLattice};
use crate::lattice::voxel_fidelity::for_each_component;
use crate::mesh::numbering::TET_FACES;

/// Elements per parallel work item.
const CHUNK: usize = 1024;

/// No component.
const NONE: u32 = u32::MAX;

/// The elements at joints of components that the image keeps apart, in increasing order; `regions` are the elements of all labels
/// that are connected through faces, `inside` tells of each vertex whether it is inside of the image, where elements are cut at its border.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn elements_at_joints(
    lattice: &RedGreenLattice,
    elements: &Elements,
    neighbors: &[[u32; 4]],
    regions: &[(Label, Vec<u32>)],
    inside: Option<&[bool]>,
    components: &Components,
    context: &RunContext,
) -> Result<Vec<u32>> {
    let joined = joined_regions(lattice, elements, regions, components, context)?;
    if joined.is_empty() {
        return Ok(Vec::new());
    }
    let labels = &elements.labels;
    let all: Vec<u32> = joined.iter().flat_map(|(_, region)| region).copied().collect();
    let tet_of = |e: u32| &elements.tets[e as usize];
    // Uncut, the background around the lattice hangs together past the border.
    let has_middle_within = |e: u32| lattice.field.contains(lattice.centroid(tet_of(e)));
    let takes_part_at_all = |e: &&u32| match inside {
        Some(inside) => is_any_inside(tet_of(**e), &[0, 1, 2, 3], inside),
        None => has_middle_within(**e),
    };
    let among: Vec<u32> = over(&all, context).filter(takes_part_at_all).copied().collect();
    context.check()?;
    let mut takes_part = vec![false; labels.len()];
    among.iter().for_each(|e| takes_part[*e as usize] = true);
    let is_beside =
        |own: u32, n: &u32| *n != OUTSIDE && takes_part[*n as usize] && labels[*n as usize] == labels[own as usize];
    let beside = |e: u32| {
        let faces = neighbors[e as usize].into_iter().zip(TET_FACES);
        let is_face_left = move |face: &[usize; 3]| inside.is_none_or(|inside| is_any_inside(tet_of(e), face, inside));
        faces.filter(move |(n, face)| is_beside(e, n) && is_face_left(face)).map(|(n, _)| n)
    };
    let (mut of_element, mut joints) = (vec![NONE; labels.len()], Vec::new());
    let found_in = |e: &u32| components_in(lattice, elements, *e, components).map(|found| (*e, found));
    let found: Vec<(u32, [u32; 2])> = over(&among, context).filter_map(found_in).collect();
    context.check()?;
    for (e, [first, last]) in &found {
        of_element[*e as usize] = *first;
        joints.extend((first != last).then_some(*e));
    }
    let mut layer: Vec<u32> = found.into_iter().map(|(e, _)| e).collect();
    while !layer.is_empty() {
        let of_element_then = &of_element;
        let unknown = |e: &u32| beside(*e).filter(move |n| of_element_then[*n as usize] == NONE);
        layer = over(&layer, context).flat_map_iter(unknown).collect();
        context.check()?;
        layer.par_sort_unstable();
        layer.dedup();
        // All elements of a layer look at the layers before, whatever their order.
        let nearest = |e: &u32| beside(*e).map(|n| of_element[n as usize]).min().unwrap_or(NONE);
        let found: Vec<u32> = over(&layer, context).map(nearest).collect();
        context.check()?;
        layer.iter().zip(found).for_each(|(e, component)| of_element[*e as usize] = component);
    }
    let meets_other = |e: &&u32| beside(**e).any(|n| of_element[n as usize] != of_element[**e as usize]);
    joints.par_extend(over(&among, context).filter(meets_other));
    context.check()?;
    Ok(with_neighbors(&joints, neighbors))
}

fn over<'a>(elements: &'a [u32], context: &'a RunContext) -> impl ParallelIterator<Item = &'a u32> {
    context.until_cancelled(elements.par_iter().with_min_len(CHUNK))
}

/// The first and the last of the components of an element's own label that it has voxels of; `None` where it has no voxel of it.
fn components_in(lattice: &RedGreenLattice, elements: &Elements, e: u32, components: &Components) -> Option<[u32; 2]> {
    let mut found = None;
    let (tet, own) = (&elements.tets[e as usize], elements.labels[e as usize]);
    for_each_component(lattice, tet, own, components, |component| {
        let [first, last] = found.unwrap_or([component; 2]);
        found = Some([first.min(component), last.max(component)]);
    });
    found
}

/// The regions with voxels of more than one component.
fn joined_regions<'a>(
    lattice: &RedGreenLattice,
    elements: &Elements,
    regions: &'a [(Label, Vec<u32>)],
    components: &Components,
    context: &RunContext,
) -> Result<Vec<&'a (Label, Vec<u32>)>> {
    // The components of each label, and its largest region.
    let labels = lattice.field.image.label_count();
    let (mut of_label, mut largest) = (vec![Vec::new(); labels], vec![None; labels]);
    (0u32..).zip(components.components()).for_each(|(c, component)| of_label[component.label.index()].push(c));
    for (r, (label, region)) in regions.iter().enumerate() {
        let largest: &mut Option<(usize, usize)> = &mut largest[label.index()];
        *largest = (*largest).max(Some((region.len(), r)));
    }
    let found_in = |asked: Vec<usize>| components_of(lattice, elements, regions, &asked, components, context);
    let is_smaller = |(r, (label, _)): &(usize, &(Label, Vec<u32>))| {
        largest[label.index()].is_none_or(|(_, largest)| largest != *r) && of_label[label.index()].len() > 1
    };
    let smaller = found_in(regions.iter().enumerate().filter(is_smaller).map(|(r, _)| r).collect())?;
    let mut seen = vec![false; components.components().len()];
    smaller.iter().for_each(|[_, component]| seen[*component as usize] = true);
    let may_join = |of_label: &[u32]| of_label.iter().filter(|component| !seen[**component as usize]).count() > 1;
    let of_largest = of_label.iter().zip(&largest).filter(|(of_label, _)| may_join(of_label));
    let largest = found_in(of_largest.filter_map(|(_, largest)| largest.map(|(_, r)| r)).collect())?;
    let found = [smaller, largest].concat();
    let joined = found.chunk_by(|a, b| a[0] == b[0]).filter(|of_region| of_region.len() > 1);
    Ok(joined.map(|of_region| &regions[of_region[0][0] as usize]).collect())
}

/// The components of some regions, by their numbers: pairs of region and component, each once, in order.
fn components_of(
    lattice: &RedGreenLattice,
    elements: &Elements,
    regions: &[(Label, Vec<u32>)],
    asked: &[usize],
    components: &Components,
    context: &RunContext,
) -> Result<Vec<[u32; 2]>> {
    if asked.is_empty() {
        return Ok(Vec::new());
    }
    let mut of_element = vec![NONE; elements.tets.len()];
    for r in asked {
        regions[*r].1.iter().for_each(|e| of_element[*e as usize] = *r as u32);
    }
    // In the order of the elements, neighbours of which lie near each other.
    let chunks = context.until_cancelled(of_element.par_chunks(CHUNK).enumerate()).map(|(chunk, of_element)| {
        let asked = ((chunk * CHUNK) as u32..).zip(of_element).filter(|(_, r)| **r != NONE);
        each_once(asked.flat_map(|(e, r)| {
            let found = components_in(lattice, elements, e, components);
            found.into_iter().flatten().map(|component| [*r, component])
        }))
    });
    let found: Vec<Vec<[u32; 2]>> = chunks.collect();
    context.check()?;
    Ok(each_once(found.into_iter().flatten()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::connected_components::{Connectivity, Members};
    use crate::lattice::bcc_lattice::PastBorder;
    use crate::lattice::face_adjacency::neighbors_of;
    use crate::lattice::mesh_regions::{regions_of, regions_with_background};
    use crate::lattice::test_images::{voxel_image, with_lattice, with_lattice_past};
    use glam::{DVec3, Vec3Swizzles};

    /// The middles of what is marked where the elements of two balls, and those on the way between them, have one label.
    fn marked(gap: f64, half_width: f64) -> (Vec<DVec3>, usize) {
        let centers = [-1.0, 1.0].map(|side| DVec3::new(15.2 + side * (6.0 + gap / 2.0), 15.3, 15.1));
        let distance = |p: DVec3| p.distance(centers[0]).min(p.distance(centers[1]));
        let image = voxel_image(32, |p| if distance(p) < 6.0 { 1 } else { 2 });
        with_lattice(&image, 2.0, |lattice, context| {
            let mut elements = lattice.elements(context).unwrap();
            let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
            let middles: Vec<DVec3> = elements.tets.iter().map(|tet| lattice.centroid(tet)).collect();
            for (label, middle) in elements.labels.iter_mut().zip(&middles) {
                let is_between = (middle.x - 15.2).abs() < 6.0 && (*middle - centers[0]).yz().length() < half_width;
                *label = Label(if is_between || distance(*middle) < 6.0 { 1 } else { 2 });
            }
            let components = Components::new(&image, Connectivity::Vertex, Members::All, context).unwrap();
            let regions = regions_of(&elements.labels, &neighbors, context).unwrap();
            let marked =
                elements_at_joints(&lattice, &elements, &neighbors, &regions, None, &components, context).unwrap();
            assert!(marked.is_sorted());
            (marked.into_iter().map(|e| middles[e as usize]).collect(), elements.tets.len())
        })
    }

    #[test]
    fn what_joins_two_balls_is_found_and_nothing_else_is_marked() {
        for gap in [2.5, 5.0] {
            let (found, all) = marked(gap, 3.0);
            assert!(!found.is_empty() && found.len() < all / 20, "{gap}: {} of {all}", found.len());
            // Layers from both sides meet in the middle.
            assert!(found.iter().all(|p| (p.x - 15.2).abs() < 3.5), "{gap}: {found:?}");
            assert!(marked(gap, 0.0).0.is_empty(), "{gap}");
        }
    }

    #[test]
    fn what_meets_only_past_the_image_border_is_not_joined() {
        let image = voxel_image(24, |p| u16::from((p.x - 11.6).abs() < 4.0));
        with_lattice(&image, 2.0, |lattice, context| {
            let elements = lattice.elements(context).unwrap();
            let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
            let components = Components::new(&image, Connectivity::Vertex, Members::All, context).unwrap();
            let mut regions = regions_with_background(&elements.labels, &neighbors, context).unwrap();
            let joined = joined_regions(&lattice, &elements, &regions, &components, context).unwrap();
            // The background on both sides of the plate, around its edges.
            assert!(joined.len() == 1 && joined[0].0.is_background());
            let marked = elements_at_joints(&lattice, &elements, &neighbors, &regions, None, &components, context);
            assert!(marked.unwrap().is_empty());
            // A hole in the plate joins them.
            let mut elements = elements;
            for (label, tet) in elements.labels.iter_mut().zip(&elements.tets) {
                let middle = lattice.centroid(tet);
                if middle.yz().distance(DVec3::splat(12.1).yz()) < 3.0 {
                    *label = Label::BACKGROUND;
                }
            }
            regions = regions_with_background(&elements.labels, &neighbors, context).unwrap();
            let marked = elements_at_joints(&lattice, &elements, &neighbors, &regions, None, &components, context);
            let middles: Vec<DVec3> =
                marked.unwrap().iter().map(|e| lattice.centroid(&elements.tets[*e as usize])).collect();
            assert!(!middles.is_empty() && middles.iter().all(|p| (p.yz() - 12.1).abs().max_element() < 6.0));
        });
    }

    #[test]
    fn what_the_cut_leaves_of_elements_with_their_middle_past_the_border_joins() {
        // The plate goes on past the border, where it has a hole: all elements with their middle there, or those without a vertex inside.
        let image = voxel_image(25, |p| u16::from((p.x - 11.6).abs() < 4.0));
        with_lattice_past(PastBorder::Continued, &image, 3.0, |lattice, context| {
            let mut elements = lattice.elements(context).unwrap();
            let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
            let components = Components::new(&image, Connectivity::Vertex, Members::All, context).unwrap();
            let positions = lattice.vertices.positions.iter();
            let inside: Vec<bool> = positions.map(|p| lattice.field.contains(lattice.frame.local(*p))).collect();
            for leaves in [true, false] {
                for (label, tet) in elements.labels.iter_mut().zip(&elements.tets) {
                    let middle = lattice.centroid(tet);
                    let is_left = tet.iter().any(|v| inside[*v as usize]);
                    let is_hole = middle.z > 24.5 && (leaves || !is_left);
                    *label = Label(u16::from((middle.x - 11.6).abs() < 4.0 && !is_hole));
                }
                let regions = regions_with_background(&elements.labels, &neighbors, context).unwrap();
                let joined = joined_regions(&lattice, &elements, &regions, &components, context).unwrap();
                assert_eq!(joined.len(), 1, "{leaves}");
                let marked = |inside: Option<&[bool]>| {
                    elements_at_joints(&lattice, &elements, &neighbors, &regions, inside, &components, context).unwrap()
                };
                assert_eq!((marked(Some(&inside)).is_empty(), marked(None).is_empty()), (!leaves, true));
            }
        });
    }
}
