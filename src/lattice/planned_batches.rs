//! Changes of a mesh one after another, planned in parallel: the same mesh as if each were planned at its turn.
//!
//! # Method
//! 1. A batch of items is planned in parallel on the mesh as it is: what is to be done at each, if anything.
//! 2. The items are gone through in order. A plan holds as long as nothing that it was made from has changed: each change marks
//!    the vertices of the tets that it touches, and an item near a mark is planned anew at its turn.
//!
//! # Source
//! [BlellochFinemanGibbonsShun2012]: a loop of steps that run in prefixes, with the result of the loop.
//!
//! # Differences
//! There what lost its reservation goes into the next prefix; here the few that do are planned again at once.
//!
//! # Invariants
//! What a plan reads are the tets of its item's vertices with their labels, the places and sides of the corners of these, and what
//! never changes. Whoever changes one of them marks the corners of the tets that change or have a corner that moves ([`Touched`]): the
//! changes are those that one thread would make, in the same order.
//!
//! # Cost
//! 4 bytes per vertex. On fewer than [`LEAST_THREADS`] threads, or for few items, nothing is planned before its turn.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::improvement_mesh::ImprovementMesh;

/// Items that are planned at once: enough for many threads, few enough that most lie far from what the others change.
const BATCH: usize = 1024;

/// Items per parallel work item.
const CHUNK: usize = 16;

/// Threads from which on work is planned before its turn: making plans and testing them costs as much as a second thread saves.
pub const LEAST_THREADS: usize = 3;

/// Items from which on it is worth the marks of all vertices.
const LEAST_ITEMS: usize = 512;

/// Items between two looks at whether the run is cancelled.
const ITEMS_PER_CHECK: usize = 256;

/// The vertices whose tets have changed since the batch was planned.
pub struct Touched {
    /// The last batch in which the tets of each vertex changed. 4 B / vertex.
    last: Vec<u32>,
    batch: u32,
    /// Whether anything is planned before its turn.
    is_needed: bool,
}

impl Touched {
    /// The tets of `v` are about to change, or `v` moves.
    pub fn mark(&mut self, mesh: &ImprovementMesh, v: u32) {
        self.mark_tets(mesh, mesh.ball(v));
    }

    /// Some tets are about to change.
    pub fn mark_tets(&mut self, mesh: &ImprovementMesh, tets: &[u32]) {
        if self.is_needed {
            for v in tets.iter().flat_map(|t| mesh.tets[*t as usize]) {
                // Vertices that are newer than the batch are in no plan.
                if let Some(last) = self.last.get_mut(v as usize) {
                    *last = self.batch;
                }
            }
        }
    }

    /// Whether a plan still holds as far as it was made from the tets of a vertex.
    #[inline]
    fn is_as_planned(&self, v: u32) -> bool {
        self.is_needed && self.last.get(v as usize).is_some_and(|last| *last != self.batch)
    }
}

/// A kind of change that is planned before it is made.
pub trait PlannedChange: Sync {
    /// Where it is made.
    type Item: Sync;
    /// What is to be done there.
    type Plan: Send;

    /// The vertices whose tets a plan reads.
    fn vertices_of(&self, mesh: &ImprovementMesh, item: &Self::Item) -> impl Iterator<Item = u32>;

    /// What is to be done at an item.
    fn plan(&self, mesh: &ImprovementMesh, item: &Self::Item) -> Self::Plan;

    /// Does what is to be done at an item; what that is has to be found out where no plan holds.
    fn change(
        &mut self,
        mesh: &mut ImprovementMesh,
        item: &Self::Item,
        plan: Option<Self::Plan>,
        touched: &mut Touched,
    );
}

/// Makes a change at each item in order.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn change_in_order<C: PlannedChange>(
    mesh: &mut ImprovementMesh,
    items: &[C::Item],
    change: &mut C,
    context: &RunContext,
) -> Result<()> {
    let is_needed = context.threads() >= LEAST_THREADS && items.len() >= LEAST_ITEMS;
    let mut touched = Touched { last: Vec::new(), batch: 0, is_needed };
    for batch in items.chunks(BATCH) {
        context.check()?;
        touched.batch += 1;
        let mut plans: Vec<C::Plan> = Vec::new();
        if is_needed {
            touched.last.resize(mesh.points.len(), 0);
            let part = context.until_cancelled(batch.par_iter().with_min_len(CHUNK));
            plans = part.map(|item| change.plan(mesh, item)).collect();
            context.check()?;
        }
        let plans = plans.into_iter().map(Some).chain(std::iter::repeat_with(|| None));
        for (at, (item, plan)) in batch.iter().zip(plans).enumerate() {
            context.check_every(ITEMS_PER_CHECK, at)?;
            let plan = plan.filter(|_| change.vertices_of(mesh, item).all(|v| touched.is_as_planned(v)));
            change.change(mesh, item, plan, &mut touched);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::test_images::voxel_image;
    use crate::lattice::test_meshes::{helix, with_tets};
    use glam::DVec3;

    /// Moves vertices to the mean of the corners around them: each place depends on those before.
    #[derive(Default)]
    struct ToMeans {
        planned: usize,
        replanned: usize,
    }

    impl PlannedChange for ToMeans {
        type Item = u32;
        type Plan = DVec3;

        fn vertices_of(&self, _: &ImprovementMesh, v: &u32) -> impl Iterator<Item = u32> {
            std::iter::once(*v)
        }

        fn plan(&self, mesh: &ImprovementMesh, v: &u32) -> DVec3 {
            let corners = mesh.ball(*v).iter().flat_map(|t| mesh.corners(*t));
            corners.sum::<DVec3>() / (4 * mesh.ball(*v).len()) as f64
        }

        fn change(&mut self, mesh: &mut ImprovementMesh, v: &u32, plan: Option<DVec3>, touched: &mut Touched) {
            let count = if plan.is_some() { &mut self.planned } else { &mut self.replanned };
            *count += 1;
            let place = plan.unwrap_or_else(|| self.plan(mesh, v));
            touched.mark(mesh, *v);
            mesh.move_vertex(*v, place);
        }
    }

    #[test]
    fn changes_are_those_of_one_thread_where_each_depends_on_those_before() {
        let image = voxel_image(4, |_| 1);
        let (points, tets) = helix(3000);
        // Far ones follow each other, near ones do in places.
        let items: Vec<u32> = (0..6000u32).map(|i| if i % 50 < 10 { i % 3003 } else { i * 1009 % 3003 }).collect();
        let moved = |threads: usize| {
            with_tets(points.clone(), &tets, &image, |mut mesh| {
                let context = RunContext::with_threads(threads).unwrap();
                let mut change = ToMeans::default();
                change_in_order(&mut mesh, &items, &mut change, &context).unwrap();
                context.cancel_token().cancel();
                let cancelled = change_in_order(&mut mesh, &items, &mut change, &context);
                assert!(matches!(cancelled, Err(crate::Error::Cancelled)));
                (std::mem::take(&mut mesh.points), change)
            })
        };
        let (alone, none) = moved(1);
        assert_eq!((none.planned, none.replanned), (0, items.len()));
        let (together, some) = moved(3);
        assert!(some.planned > 500 && some.replanned > 1000, "{} {}", some.planned, some.replanned);
        assert_eq!(alone, together);
    }
}
