//! Where the mesh has other tunnels, cavities or pieces than the image: the places to refine until it has the same.
//!
//! # Method
//! For each label whose surface has another Euler number in the mesh than in the image:
//! 1. The body is the voxels of the label; its goal is the voxels that lie in elements of the label.
//! 2. Voxels in which they differ join or leave the body as long as they are simple
//!    ([`simple_voxels`](crate::image::simple_voxels)): the body becomes more like its goal, its topology stays.
//! 3. What still differs then is where the topologies do. Where nothing does the difference lies between voxel centres: the
//!    voxels that are not simple in the image are the places then: bridges, walls, tunnels and gaps one voxel wide; and those of
//!    small components in or beside the body: the mesh closes it above a pocket that another label fills.
//!
//! ```text
//!     image        goal: voxels in elements     what is left
//!     1 1 . 1 1        1 1 . 1 1                 . . . . .
//!     1 1 1 1 1        1 . . . 1                 . . x . .      the bridge; the corner was simple and went
//!     1 1 . 1 1        1 1 . 1 1                 . . . . .
//! ```
//! # Source
//! Our own, from homotopic thinning [KongRosenfeld1989], [BertrandMalandain1994].
//!
//! # Limits
//! Voxels of a goal that touch along edges or at corners are places, too, whatever the elements do there. Of a wall one voxel thick
//! no voxel is simple: where the difference lies between voxel centres all of it is refined, to up to three times the elements.
//!
//! # Cost
//! By the voxels at boundaries that lie in elements of other labels.

use std::collections::VecDeque;

use glam::IVec3;
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use crate::context::RunContext;
use crate::error::Result;
use crate::image::connected_components::Components;
use crate::image::grid::places_around;
use crate::image::label_image::LabelImage;
use crate::image::simple_voxels::{Block, SimpleVoxels, WHOLE_BLOCK};
use crate::index::Label;
use crate::lattice::euler_ranges::EulerRanges;
use crate::lattice::face_adjacency::with_neighbors;
use crate::lattice::red_green::{Elements, RedGreenLattice};
use crate::lattice::region_gaps::STEPS;
use crate::lattice::voxel_fidelity::{for_each_foreign_voxel, for_each_voxel};

/// Voxels of a component at most that counts as small: a block of two along each axis. On a cortex of 48 regions in slices of 4 mm one
/// label instead of four has another Euler number than the image with these, with 1.03 times the elements.
const FEW_VOXELS: u64 = 8;

/// Elements per parallel work item.
const CHUNK: usize = 1024;

/// Voxels that may follow between two looks at whether the run is cancelled.
const VOXELS_PER_CHECK: usize = 4096;

/// The elements with voxels by which the topologies of labels differ, and their neighbours through faces, increasing.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn elements_at_differences(
    lattice: &RedGreenLattice,
    elements: &Elements,
    neighbors: &[[u32; 4]],
    euler: &EulerRanges,
    components: &Components,
    context: &RunContext,
) -> Result<Vec<u32>> {
    let labels = euler.differing();
    if labels.is_empty() {
        return Ok(Vec::new());
    }
    let image = lattice.field.image;
    let of_element = |e: usize| {
        let mut found = Vec::new();
        let own = elements.labels[e];
        for_each_foreign_voxel(lattice, &elements.tets[e], own, |at, label| found.push((at, [label, own])));
        found
    };
    let foreign: Vec<(IVec3, [Label; 2])> = over_elements(elements.tets.len(), of_element, context)?;
    let of_label = |label: &Label| -> Result<Vec<IVec3>> {
        let concerned = foreign.iter().filter(|(_, labels)| labels.contains(label));
        let body = Body { image, label: *label };
        let differing = body.what_stays(concerned.map(|(at, _)| *at).collect(), context)?;
        let is_unseen = differing.is_empty() && euler.out_of_reach(*label).is_some();
        if is_unseen { body.fragile_voxels(components, context) } else { Ok(differing) }
    };
    let of_labels: Vec<Vec<IVec3>> = labels.par_iter().map(of_label).collect::<Result<_>>()?;
    let sought: FxHashSet<IVec3> = of_labels.into_iter().flatten().collect();
    let holds = |e: usize| {
        let mut any = false;
        for_each_voxel(lattice, &elements.tets[e], |at, _| any |= sought.contains(&at));
        any.then_some(e as u32)
    };
    let met = over_elements(elements.tets.len(), holds, context)?;
    Ok(with_neighbors(&met, neighbors))
}

/// What is found in each of so many elements, in order.
pub(super) fn over_elements<T: Send, I: IntoIterator<Item = T>>(
    count: usize,
    find: impl Fn(usize) -> I + Sync + Send,
    context: &RunContext,
) -> Result<Vec<T>> {
    let all = (0..count).into_par_iter().with_min_len(CHUNK);
    let found = context.until_cancelled(all).flat_map_iter(find).collect();
    context.check()?;
    Ok(found)
}

/// The voxels of a label.
struct Body<'a> {
    image: &'a LabelImage,
    label: Label,
}

impl Body<'_> {
    fn has(&self, at: IVec3) -> bool {
        self.image.at_or_background(at) == self.label
    }

    /// Of the voxels in which the body and its goal differ, those that cannot follow.
    fn what_stays(&self, mut differing: Vec<IVec3>, context: &RunContext) -> Result<Vec<IVec3>> {
        let simple = SimpleVoxels::default();
        // Whether each has followed.
        let mut followed: FxHashMap<IVec3, bool> = differing.iter().map(|at| (*at, false)).collect();
        differing.sort_unstable_by_key(|at| (at.z, at.y, at.x));
        let mut queue: VecDeque<IVec3> = differing.iter().copied().collect();
        let mut seen = 0;
        while let Some(at) = queue.pop_front() {
            context.check_every(VOXELS_PER_CHECK, seen)?;
            seen += 1;
            if followed[&at] {
                continue;
            }
            let is_set = |at: IVec3| self.has(at) != followed.get(&at).is_some_and(|f| *f);
            if simple.is_simple(block_around(at, is_set)) {
                followed.insert(at, true);
                queue.extend(places_around(at).filter(|near| followed.get(near) == Some(&false)));
            }
        }
        differing.retain(|at| !followed[at]);
        Ok(differing)
    }

    /// Voxels in and beside the body that are not simple, or of a small component.
    fn fragile_voxels(&self, components: &Components, context: &RunContext) -> Result<Vec<IVec3>> {
        let simple = SimpleVoxels::default();
        let [ni, nj, nk] = self.image.grid().size().map(|s| s as i32);
        // Beside the body means through a face: a voxel that touches it at a corner only is never simple, and of no bridge.
        let is_part = |at: IVec3| self.has(at) || STEPS.iter().any(|step| self.has(at + step));
        let is_of_few = |at: &IVec3| {
            let [i, j, k] = at.to_array().map(|x| x as usize);
            components.component_at(i, j, k).is_some_and(|c| components.components()[c as usize].voxels <= FEW_VOXELS)
        };
        let is_fragile = |at: &IVec3| {
            let block = block_around(*at, |near| self.has(near));
            block != 0 && block != WHOLE_BLOCK && is_part(*at) && (!simple.is_simple(block) || is_of_few(at))
        };
        let row = |row: i32| (0..ni).map(move |i| IVec3::new(i, row % nj, row / nj)).filter(is_fragile);
        let fragile = context.until_cancelled(0..nj * nk).flat_map_iter(row).collect();
        context.check()?;
        Ok(fragile)
    }
}

fn block_around(at: IVec3, is_set: impl Fn(IVec3) -> bool) -> Block {
    places_around(at).enumerate().filter(|(_, near)| is_set(*near)).fold(0, |block, (b, _)| block | 1 << b)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::test_images::{components_of, voxel_image};

    #[test]
    fn what_stays_is_the_bridge_that_the_goal_has_lost() {
        // Two blocks and a bridge of one voxel; in the goal the bridge and a layer of the left block are gone.
        let is_bridge = |p: glam::DVec3| p.y == 5.0 && p.z == 5.0 && (4.0..8.0).contains(&p.x);
        let is_block = |p: glam::DVec3| p.y > 2.0 && p.y < 9.0 && p.z > 2.0 && p.z < 9.0;
        let image = voxel_image(12, |p| u16::from(is_bridge(p) || is_block(p) && !(4.0..8.0).contains(&p.x)));
        let body = Body { image: &image, label: Label(1) };
        let all = || (0..12).flat_map(|k| (0..12).flat_map(move |j| (0..12).map(move |i| IVec3::new(i, j, k))));
        let lost: Vec<IVec3> = all().filter(|at| body.has(*at) && (3..8).contains(&at.x)).collect();
        let context = RunContext::with_threads(1).unwrap();
        let stays = body.what_stays(lost.clone(), &context).unwrap();
        assert!(!stays.is_empty() && stays.iter().all(|at| is_bridge(at.as_dvec3()) || at.x == 3), "{stays:?}");
        assert!(stays.len() <= 5, "{stays:?}");
        // Only the layer: all of it can go.
        let layer = all().filter(|at| body.has(*at) && at.x == 0).collect();
        assert!(body.what_stays(layer, &context).unwrap().is_empty());
        // The bridge is what is fragile, with the voxels that it ends at.
        let components = components_of(&image, &context);
        let fragile = body.fragile_voxels(&components, &context).unwrap();
        let is_of_bridge = |at: &&IVec3| is_bridge(at.with_x(at.x.clamp(4, 7)).as_dvec3()) && (3..9).contains(&at.x);
        assert!(fragile.iter().filter(|at| body.has(**at)).all(|at| is_of_bridge(&at)), "{fragile:?}");
        assert!((4..8).all(|x| fragile.contains(&IVec3::new(x, 5, 5))), "{fragile:?}");
        context.cancel_token().cancel();
        assert!(matches!(body.what_stays(lost, &context), Err(crate::Error::Cancelled)));
        assert!(matches!(body.fragile_voxels(&components, &context), Err(crate::Error::Cancelled)));
    }

    #[test]
    fn of_a_wall_one_voxel_thick_all_but_the_rim_is_fragile() {
        let is_inner = |p: glam::DVec3| (3.0..9.0).contains(&p.x) && (3.0..9.0).contains(&p.y);
        let is_wall = |p: glam::DVec3| p.z == 5.0 && (2.0..10.0).contains(&p.x) && (2.0..10.0).contains(&p.y);
        let image = voxel_image(12, |p| u16::from(is_wall(p)));
        let body = Body { image: &image, label: Label(1) };
        let context = RunContext::with_threads(1).unwrap();
        let fragile = body.fragile_voxels(&components_of(&image, &context), &context).unwrap();
        let inner: Vec<bool> = fragile.iter().filter(|at| body.has(**at)).map(|at| is_inner(at.as_dvec3())).collect();
        assert_eq!(inner, [true; 36]);
    }

    #[test]
    fn a_pocket_that_few_voxels_fill_is_fragile() {
        // Label 1 below; label 2 fills a pocket in its flat top.
        let fragile = |pocket: f64| {
            let in_pocket = |p: glam::DVec3| p.z == 5.0 && p.y == 5.0 && (2.0..2.0 + pocket).contains(&p.x);
            let image = voxel_image(14, |p| if p.z > 5.0 { 0 } else { 1 + u16::from(in_pocket(p)) });
            let context = RunContext::with_threads(1).unwrap();
            let body = Body { image: &image, label: Label(1) };
            body.fragile_voxels(&components_of(&image, &context), &context).unwrap()
        };
        assert_eq!(fragile(1.0), [IVec3::new(2, 5, 5)]);
        assert!((2..10).all(|x| fragile(8.0).contains(&IVec3::new(x, 5, 5))));
        assert!(!fragile(9.0).contains(&IVec3::new(2, 5, 5)), "its end is simple");
    }
}
