//! Voxels that no element of their label is near: threads and sheets one voxel wide between larger elements.
//!
//! # Method
//! 1. A voxel is missed when its centre lies in an element of another label. Most missed voxels touch one that is not: the
//!    boundary runs between them, and smoothing moves it.
//! 2. A missed voxel is stray where it touches no voxel of its label that is not missed. No vertex of its label is near then,
//!    and none that smoothing could bring.
//! ```text
//!    label 1    # # # # . . . .      #  in an element of the label
//!               # # # # m s s s      m  missed, but beside one that is not: m's boundary is near
//!               # # # # . . . .      s  stray: the thread has no element
//! ```
//! 3. The leaves that hold stray voxels are refined, and those of the missed voxels that they touch, so that the thread is joined
//!    to the rest: down to the finest level, half a voxel, where each voxel's centre is in an element of its label.
//!
//! # Source
//! The two-sided distance of [Drakopoulos2017] 2.3.3 counts the farthest voxel, the fidelities their share only.
//!
//! # Cost
//! One pass over the elements that hold missed voxels.

use glam::IVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::grid::places_around;
use crate::index::Label;
use crate::lattice::red_green::{Elements, RedGreenLattice};
use crate::lattice::subdivision_criteria::Targets;
use crate::lattice::voxel_fidelity::{Mismatch, for_each_foreign_voxel};

/// A tolerance of boundaries past this, in voxels, lets voxels be stray: they are more than a diagonal off.
const LARGEST_TOLERANCE: f64 = 1.732;

/// Marks the leaves to be refined for stray voxels, those above the level `finest`; `found` are the mismatches of the elements.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn mark_stray_voxels(
    lattice: &RedGreenLattice,
    elements: &Elements,
    found: &[Mismatch],
    targets: &Targets,
    finest: u32,
    context: &RunContext,
) -> Result<Vec<bool>> {
    let mut marked = vec![false; lattice.tets.len()];
    if targets.surface_tolerance > LARGEST_TOLERANCE {
        return Ok(marked);
    }
    let missed = missed_voxels(lattice, elements, found, context)?;
    let image = lattice.field.image;
    let size = lattice.field.size();
    let label_at = |at: IVec3| image.at(at.x as usize, at.y as usize, at.z as usize);
    let is_inside = |at: IVec3| at.cmpge(IVec3::ZERO).all() && at.cmplt(size).all();
    // The voxels of the same label that touch one.
    let beside = |at: IVec3| {
        places_around(at).filter(move |near| *near != at && is_inside(*near) && label_at(*near) == label_at(at))
    };
    let mut mark = |at: IVec3| {
        let Some(leaf) = missed.get(&at) else { return };
        let may_shrink = lattice.leaf_edge(*leaf) > 2.0 * targets.min_size[label_at(at).index()];
        marked[*leaf as usize] |= may_shrink && u32::from(lattice.levels[*leaf as usize]) < finest;
    };
    for at in missed.keys().filter(|at| beside(**at).all(|near| missed.contains_key(&near))) {
        mark(*at);
        beside(*at).for_each(&mut mark);
    }
    Ok(marked)
}

/// The labelled voxels that lie in elements of other labels, with the leaf of each. What is made of it does not depend on the
/// order of a map.
fn missed_voxels(
    lattice: &RedGreenLattice,
    elements: &Elements,
    found: &[Mismatch],
    context: &RunContext,
) -> Result<FxHashMap<IVec3, u32>> {
    let holds = |m: &&Mismatch| !m.voxel_label.is_background();
    let mut holders: Vec<u32> = found.iter().filter(holds).map(|m| m.element).collect();
    holders.dedup();
    let of_element = |e: &u32| {
        let mut voxels = Vec::new();
        let (tet, label) = (&elements.tets[*e as usize], elements.labels[*e as usize]);
        for_each_foreign_voxel(lattice, tet, label, |at, of: Label| {
            if !of.is_background() {
                voxels.push((at, elements.leaves[*e as usize]));
            }
        });
        voxels
    };
    let holders = context.until_cancelled(holders.par_iter().with_min_len(256));
    let voxels: Vec<(IVec3, u32)> = holders.flat_map_iter(of_element).collect();
    context.check()?;
    Ok(voxels.into_iter().collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::connected_components::{Components, Connectivity, Members};
    use crate::image::label_image::LabelImage;
    use crate::lattice::options::{Options, PARAMETERS};
    use crate::lattice::subdivision_criteria::finest_level;
    use crate::lattice::test_images::{voxel_image, with_lattice};
    use crate::lattice::voxel_fidelity::mismatches;
    use crate::parameters::ParameterSet;
    use glam::DVec3;

    const CENTER: DVec3 = DVec3::new(9.3, 9.2, 9.4);

    /// Numbers of leaves that are marked in each round of a lattice with edges of four voxels, until none is; places of the first.
    fn rounds(image: &LabelImage, option: &str, value: &str) -> (Vec<usize>, Vec<DVec3>) {
        let mut set = ParameterSet::new(PARAMETERS);
        set.set_text(option, value).unwrap();
        let targets = Targets::new(image.values(), &Options::from_parameters(&set).unwrap()).unwrap();
        with_lattice(image, 4.0, |mut lattice, context| {
            let components = Components::new(image, Connectivity::Vertex, Members::All, context).unwrap();
            lattice.close_locally();
            let finest = finest_level(&lattice, image);
            let (mut counts, mut places) = (Vec::new(), Vec::new());
            loop {
                let elements = lattice.elements(context).unwrap();
                let found = mismatches(&lattice, &elements, &components, context).unwrap();
                let marked = mark_stray_voxels(&lattice, &elements, &found, &targets, finest, context).unwrap();
                let of_marked = lattice.tets.iter().zip(&marked).filter(|(_, marked)| **marked);
                let centers: Vec<DVec3> = of_marked.map(|(tet, _)| lattice.centroid(tet)).collect();
                if centers.is_empty() {
                    return (counts, places);
                }
                counts.push(centers.len());
                if places.is_empty() {
                    places = centers;
                }
                lattice.refine(&marked, context).unwrap();
            }
        })
    }

    #[test]
    fn a_thread_is_stray_until_its_leaves_are_small_and_a_ball_has_no_stray_voxel() {
        let ball = |p: DVec3| p.distance(CENTER) < 7.0;
        let thread = |p: DVec3| p.x == 9.0 && p.y == 9.0 && p.z > 9.0 && p.z < 21.0;
        let (counts, _) = rounds(&voxel_image(24, |p| u16::from(ball(p))), "surface-tolerance", "0.8");
        assert!(counts.is_empty(), "{counts:?}");
        let threaded = voxel_image(24, |p| u16::from(ball(p) || thread(p)));
        let (counts, places) = rounds(&threaded, "surface-tolerance", "0.8");
        assert!((1..=3).contains(&counts.len()), "{counts:?}");
        assert!(places.iter().all(|p| p.x.max(p.y) < 13.0 && p.x.min(p.y) > 5.0 && p.z > 12.0), "{places:?}");
        assert!(rounds(&threaded, "surface-tolerance", "9").0.is_empty());
        assert!(rounds(&threaded, "min-element-size", "2.1").0.is_empty());
    }
}
