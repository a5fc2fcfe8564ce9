//! Voxels that the surface misses however its vertices move: one voxel thin spikes, ridges and clefts between two larger
//! elements.
//!
//! # Method
//! 1. A voxel is missed when its centre lies in an element of another label.
//! 2. Smoothing moves the vertices to the boundary, so a missed voxel counts only where the boundary drawn straight between
//!    the vertices leaves it on the wrong side: the signed distances at the corners of the element, interpolated at the
//!    voxel's centre, are clearly negative for its label.
//! ```text
//!    label 0   o     o     o           o  vertices, all outside of label 1: straight between them there is no spike
//!           ___     _     ___          the chord of a curved boundary has vertices on both sides and is no miss
//!    label 1   |___| |___|
//! ```
//! 3. An element that runs past the image border, where another label has the outermost voxel, reaches through a layer that is thin
//!    against it, or lies beyond: cut at the border such layers get holes.
//! 4. The leaves of such elements are refined, down to edges of `SINGLE_VOXEL_EDGE` voxels.
//!
//! # Source
//! After the two fidelities of [Drakopoulos2017] 2.3.3, which count voxels whatever their depth.
//!
//! # Cost
//! One pass over the elements near boundaries, in parallel.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::tetrahedron::barycentric;
use crate::index::Label;
use crate::lattice::red_green::{Elements, RedGreenLattice};
use crate::lattice::subdivision_criteria::Targets;
use crate::lattice::voxel_fidelity::for_each_foreign_voxel;

/// Elements with edges up to this, in voxels, are not refined: one level finer than boundaries are, with room for lattices
/// whose spacing the caller chose.
const SINGLE_VOXEL_EDGE: f64 = 1.25;

/// A voxel counts where it lies deeper on the wrong side than this, in voxels: on smooth bodies the interpolated distances err by
/// as much. In two rounds, 0, 0.05, 0.1 make 8.7, 7.2, 6.4 thousand tets of a ball of radius 20 voxels (6.3 without), and leave
/// 0.56, 0.57, 0.60 voxel from the staircase of a brain atlas at 95 % of it (0.70 without).
const LEAST_DEPTH: f64 = 0.05;

/// A tolerance of boundaries past this, in voxels, asks for voxels that lie deeper by the difference only, and for no layers at the
/// image border: a large one leaves the fidelity alone to decide.
const LEAST_TOLERANCE: f64 = 0.8;

/// Elements per parallel work item.
const CHUNK: usize = 1024;

/// Marks the leaves to be refined for missed voxels.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn mark_missed_voxels(
    lattice: &RedGreenLattice,
    elements: &Elements,
    targets: &Targets,
    context: &RunContext,
) -> Result<Vec<bool>> {
    let voxel = lattice.field.voxel_size();
    let depth = (LEAST_DEPTH + (targets.surface_tolerance - LEAST_TOLERANCE).max(0.0)) * voxel;
    let misses = |e: &usize| {
        let edge = lattice.leaf_edge(elements.leaves[*e]);
        let mut any = false;
        if depth.is_finite() && edge > SINGLE_VOXEL_EDGE * voxel {
            let is_refined = |label: Label| edge > 2.0 * targets.min_size[label.index()];
            for_each_foreign_voxel(lattice, &elements.tets[*e], elements.labels[*e], |at, label| {
                any = any || (is_refined(label) && straight_distance(lattice, &elements.tets[*e], at, label) < -depth);
            });
        }
        any || targets.surface_tolerance <= LEAST_TOLERANCE
            && edge > SINGLE_VOXEL_EDGE * voxel
            && edge > 2.0 * targets.min_size[elements.labels[*e].index()]
            && reaches_through_layer(lattice, &elements.tets[*e], elements.labels[*e])
    };
    let all = (0..elements.tets.len()).into_par_iter().with_min_len(CHUNK);
    let missing: Vec<usize> = context.until_cancelled(all).filter(misses).collect();
    context.check()?;
    let mut marked = vec![false; lattice.tets.len()];
    missing.into_iter().for_each(|e| marked[elements.leaves[e] as usize] = true);
    Ok(marked)
}

/// Whether an element runs past the image border where the outermost voxel has another label: a layer of that one ends there, thin
/// against the element. The background past a labelled border counts too: what crosses the border beside it becomes finer with it.
/// Of eight images that cut many labels two have a label in one piece too many or too few without that, none with it, for up to 40 %
/// more time.
fn reaches_through_layer(lattice: &RedGreenLattice, tet: &[u32; 4], label: Label) -> bool {
    let field = &lattice.field;
    let (corners, voxel, last) = (lattice.corners(tet), field.image.grid().spacing(), field.size() - 1);
    let nearest = field.nearest_voxel(corners.iter().sum::<DVec3>() / 4.0);
    (0..3).any(|axis| {
        let of_side = |outermost: i32, is_past: &dyn Fn(f64) -> bool| {
            let mut at = nearest;
            at[axis] = outermost;
            corners.iter().any(|p| is_past(p[axis] / voxel[axis])) && field.image.at_or_background(at) != label
        };
        of_side(0, &|p| p < -0.5) || of_side(last[axis], &|p| p > f64::from(last[axis]) + 0.5)
    })
}

/// Signed distance of a label, mm, interpolated between the corners of an element at the centre of a voxel in it.
fn straight_distance(lattice: &RedGreenLattice, tet: &[u32; 4], voxel: IVec3, label: Label) -> f64 {
    let corners = lattice.corners(tet);
    let center = voxel.as_dvec3() * lattice.field.image.grid().spacing();
    let weights = barycentric(corners, center);
    (0..4).map(|i| weights[i] * lattice.field.signed_distance(corners[i], label)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::label_image::LabelImage;
    use crate::lattice::options::{Options, PARAMETERS};
    use crate::lattice::test_images::{voxel_image, with_lattice};
    use crate::parameters::ParameterSet;
    use glam::DVec3;

    /// Places of the marked leaves of a lattice with edges of two voxels.
    fn marked_places(image: &LabelImage, option: &str, value: &str) -> Vec<DVec3> {
        let mut set = ParameterSet::new(PARAMETERS);
        set.set_text(option, value).unwrap();
        let targets = Targets::new(image.values(), &Options::from_parameters(&set).unwrap()).unwrap();
        with_lattice(image, 2.0, |lattice, context| {
            let elements = lattice.elements(context).unwrap();
            let marked = mark_missed_voxels(&lattice, &elements, &targets, context).unwrap();
            let places = lattice.tets.iter().zip(marked).filter(|(_, marked)| *marked);
            places.map(|(tet, _)| lattice.centroid(tet)).collect()
        })
    }

    const CENTER: DVec3 = DVec3::new(9.3, 9.2, 9.4);

    #[test]
    fn a_spike_is_missed_and_the_chords_of_a_ball_are_not() {
        let spike = |p: DVec3| p.x == 9.0 && p.y == 9.0 && p.z > 9.0 && p.z < 19.0;
        let plain = voxel_image(24, |p| u16::from(p.distance(CENTER) < 6.0));
        let spiked = voxel_image(24, |p| u16::from(p.distance(CENTER) < 6.0 || spike(p)));
        let chords = marked_places(&plain, "surface-tolerance", "0.8");
        let found = marked_places(&spiked, "surface-tolerance", "0.8");
        let near_spike = |p: &&DVec3| p.x.max(p.y) < 12.0 && p.x.min(p.y) > 6.0 && p.z > 14.0;
        assert!(found.iter().filter(near_spike).count() > 1, "{}", found.len());
        assert!(chords.len() <= found.len() / 2, "{} of the ball's leaves", chords.len());
    }

    #[test]
    fn a_large_tolerance_and_a_least_size_leave_the_spike_alone() {
        let image = voxel_image(20, |p| u16::from(p.distance(CENTER) < 5.0 || (p.x == 9.0 && p.y == 9.0 && p.z > 9.0)));
        assert!(!marked_places(&image, "surface-tolerance", "0.8").is_empty());
        assert!(marked_places(&image, "surface-tolerance", "9").is_empty());
        assert!(marked_places(&image, "min-element-size", "1.1").is_empty());
    }

    #[test]
    fn elements_that_reach_through_a_layer_at_the_border_are_found() {
        let reaching = |image: &LabelImage| {
            with_lattice(image, 3.2, |lattice, context| {
                let elements = lattice.elements(context).unwrap();
                let tets = elements.tets.iter().zip(&elements.labels);
                let reaching = tets.filter(|(tet, label)| reaches_through_layer(&lattice, tet, **label));
                reaching.map(|(tet, label)| (lattice.centroid(tet), *label)).collect::<Vec<_>>()
            })
        };
        // Cubes of the lattice reach 0.4 mm past the border, their middles are past the layer.
        let layer = reaching(&voxel_image(12, |p| if p.x < 0.9 { 2 } else { 1 }));
        let within = |p: &DVec3| p.x > -0.5 && p.x < 1.5;
        assert!(layer.iter().any(|(p, label)| *label == Label(1) && within(p) && (p.y - 5.0).abs() < 3.0), "{layer:?}");
        // A plane that goes straight out has no layer; the background past it counts.
        let straight = reaching(&voxel_image(12, |p| if p.y + 0.001 * p.x < 5.3 { 2 } else { 1 }));
        let is_past = |p: &DVec3| p.min_element() < -0.5 || p.max_element() > 11.5;
        assert!(straight.iter().all(|(p, label)| label.is_background() && is_past(p)), "{straight:?}");
    }
}
