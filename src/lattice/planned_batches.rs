//! Changes of a mesh one after another, planned in parallel: the same mesh as if each were planned at its turn.
//!
//! # Method
//! 1. A batch of items is planned in parallel on the mesh as it is: what is to be done at each, if anything.
//! 2. The items are gone through in order. A plan holds as long as nothing that it was made from has changed: each change marks
//!    the vertices of the tets that it touches, and an item near a mark is planned anew at its turn.
//! 3. An item where more may be done is looked at again: it is one of the first of the next batch.
//!
//! # Source
//! [BlellochFinemanGibbonsShun2012]: a loop of steps that run in prefixes, with the result of the loop.
//!
//! # Differences
//! There what lost its reservation goes into the next prefix; here the few that do are planned again at once.
//!
//! # Invariants
//! What a plan reads are the tets of the vertices that it lists with their labels, the places and sides of the corners of these, and what
//! never changes. Whoever changes one of them marks the corners of the tets that change or have a corner that moves ([`Touched`]): the
//! changes are those that one thread would make, in the same order.
//!
//! # Cost
//! 4 bytes per vertex. On fewer than [`LEAST_THREADS`] threads, or for few items, nothing is planned before its turn.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::element_score::Ball;
use crate::lattice::improvement_mesh::ImprovementMesh;

/// Items that are planned at once: enough for many threads, few enough that most lie far from what the others change.
const BATCH: usize = 1024;

/// Batches that items which follow each other along the mesh are spread over. On an atlas with 195 thousand low tets 80 % of the plans do
/// not hold where such items are in the same batch; with 4, 8 and 16 batches 43, 25 and 14 %, with all of them 6 %, but then one
/// thread takes a fifth longer, since nothing near is in the cache: a tenth with 16.
const SPREAD: usize = 16;

/// Items per parallel work item.
const CHUNK: usize = 16;

/// Threads from which on work is planned before its turn: listing and testing what plans read costs as much as a second thread saves.
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

    /// Whether a plan still holds that was made from the tets of some vertices. One that was made from none, at a place that was
    /// empty, does not: something may be there now.
    #[inline]
    fn holds(&self, vertices: &[u32]) -> bool {
        !vertices.is_empty() && vertices.iter().all(|v| self.last[*v as usize] != self.batch)
    }
}

/// A kind of change that is planned before it is made.
pub trait PlannedChange: Sync {
    /// Where it is made.
    type Item: Copy + Send + Sync;
    /// What is to be done there.
    type Plan: Send;

    /// Appends the vertices whose tets a plan reads.
    fn append_vertices(&self, mesh: &ImprovementMesh, item: &Self::Item, vertices: &mut Vec<u32>);

    /// What is to be done at an item; `ball` is a scratch buffer.
    fn plan(&self, mesh: &ImprovementMesh, item: &Self::Item, ball: &mut Ball) -> Self::Plan;

    /// Does what is planned on the mesh as it is. Returns what is looked at again in the next batch.
    fn change(
        &mut self,
        mesh: &mut ImprovementMesh,
        item: &Self::Item,
        plan: Self::Plan,
        touched: &mut Touched,
    ) -> Option<Self::Item>;
}

/// Items that follow each other along the mesh in an order in which they come into different batches.
pub fn spread_over_batches<T: Copy>(items: &[T]) -> impl Iterator<Item = T> {
    items.chunks(SPREAD * BATCH).flat_map(|items| {
        let batches = items.len().div_ceil(BATCH);
        (0..batches).flat_map(move |first| items[first..].iter().step_by(batches).copied())
    })
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
    let (mut rest, mut batch, mut again) = (items, Vec::new(), Vec::new());
    while !(rest.is_empty() && again.is_empty()) {
        context.check()?;
        touched.batch += 1;
        batch.clear();
        batch.append(&mut again);
        let (next, later) = rest.split_at(rest.len().min(BATCH - batch.len()));
        batch.extend_from_slice(next);
        rest = later;
        let mut plans: Vec<(C::Plan, Vec<u32>)> = Vec::new();
        if is_needed {
            touched.last.resize(mesh.points.len(), 0);
            let plan = |ball: &mut Ball, item: &C::Item| {
                let mut vertices = Vec::new();
                change.append_vertices(mesh, item, &mut vertices);
                (change.plan(mesh, item, ball), vertices)
            };
            let part = context.until_cancelled(batch.par_iter().with_min_len(CHUNK));
            plans = part.map_init(Ball::default, plan).collect();
            context.check()?;
        }
        let plans = plans.into_iter().map(Some).chain(std::iter::repeat_with(|| None));
        for (at, (item, planned)) in batch.iter().zip(plans).enumerate() {
            context.check_every(ITEMS_PER_CHECK, at)?;
            let plan = match planned {
                Some((plan, vertices)) if touched.holds(&vertices) => plan,
                _ => mesh.with_scratch(|mesh, ball| change.plan(mesh, item, ball)),
            };
            again.extend(change.change(mesh, item, plan, &mut touched));
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
    use std::sync::Mutex;

    /// Moves vertices to the mean of the corners around them: each place depends on those before.
    #[derive(Default)]
    struct ToMeans {
        plans: Mutex<usize>,
        moves: usize,
    }

    impl PlannedChange for ToMeans {
        type Item = u32;
        type Plan = DVec3;

        fn append_vertices(&self, _: &ImprovementMesh, v: &u32, vertices: &mut Vec<u32>) {
            vertices.push(*v);
        }

        fn plan(&self, mesh: &ImprovementMesh, v: &u32, _: &mut Ball) -> DVec3 {
            *self.plans.lock().unwrap() += 1;
            let corners = mesh.ball(*v).iter().flat_map(|t| mesh.corners(*t));
            corners.sum::<DVec3>() / (4 * mesh.ball(*v).len()) as f64
        }

        fn change(&mut self, mesh: &mut ImprovementMesh, v: &u32, place: DVec3, touched: &mut Touched) -> Option<u32> {
            self.moves += 1;
            touched.mark(mesh, *v);
            mesh.move_vertex(*v, place);
            // Some go on to the vertices after them.
            Some(*v + 1).filter(|next| next % 5 > 1 && (*next as usize) < mesh.points.len())
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
        let (alone, change) = moved(1);
        assert_eq!(change.plans.into_inner().unwrap(), change.moves);
        assert!(change.moves > 3 * items.len() / 2, "{}", change.moves);
        let (together, change) = moved(3);
        let replanned = change.plans.into_inner().unwrap() - change.moves;
        assert!(replanned > 1000 && replanned + 500 < change.moves, "{replanned} {}", change.moves);
        assert_eq!(alone, together);
    }

    #[test]
    fn items_next_to_each_other_are_spread_over_batches() {
        let items: Vec<usize> = (0..3 * SPREAD * BATCH / 2).collect();
        let spread: Vec<usize> = spread_over_batches(&items).collect();
        let apart = |batch: &[usize]| batch.windows(2).all(|pair| pair[1] - pair[0] == SPREAD);
        assert!(spread[..SPREAD * BATCH].chunks(BATCH).all(apart));
        let mut sorted = spread;
        sorted.sort_unstable();
        assert_eq!(sorted, items);
        assert!(spread_over_batches(&items[..BATCH]).eq(0..BATCH));
    }
}
