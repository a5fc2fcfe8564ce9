//! Tets of low score are raised one after another: their vertices are optimised, then a local transformation is made.
//!
//! # Method
//! The tets are gone through by classes from the worst, within a class along the mesh in strides
//! ([`spread_over_batches`]): neighbours are not worked on at once, but what is near is in the cache still. At each:
//! 1. Its vertices go where the lowest score around them is higher ([`better_place`]); those on a surface only if asked.
//! 2. If it is low still, the first local transformation that gains is made ([`Transformation`]).
//!
//! One step at a time is planned for many tets at once ([`change_in_order`]); a tet of which a vertex moved has its turn again, for the
//! vertices that are left. Where low tets crowd they share vertices and edges: what was tried there in vain is known, if asked, until a tet
//! of theirs changes.
//!
//! # Source
//! [KlingnerShewchuk2007] for the schedule.
//!
//! # Invariants
//! The order of the changes is fixed: the same bits for any number of threads. The mesh conforms. It is what it would be if all that was
//! in vain were tried again.
//!
//! # Cost
//! Where it is remembered, 8 to 20 bytes for each vertex of a low tet that finds no better place, 16 to 40 for each edge of one that stays.

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashSet;

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::element_score::{Ball, Threshold};
use crate::lattice::improvement_mesh::{ImprovementMesh, numbers_where};
use crate::lattice::local_transformations::{Transformation, TransformationCounts, append_vertices_around_tet};
use crate::lattice::planned_batches::{PlannedChange, Touched, change_in_order, spread_over_batches};
use crate::lattice::vertex_optimization::better_place;
use crate::mesh::numbering::{TET_EDGES, sorted_edge};

/// Width of a class of tets that are worked on in the order of their numbers, degrees.
const SCORE_CLASS: f64 = 4.0;

/// Whether optimisation may move surface vertices off their surface by the slack.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Surfaces {
    /// They stay where they are.
    Stay,
    /// They may move.
    MayYield,
}

/// What the work on low tets aims at and may spend.
#[derive(Debug, Clone, Copy)]
pub struct Effort {
    /// Score that is wanted, degrees.
    pub wanted: f64,
    /// Whether surface vertices may move.
    pub surfaces: Surfaces,
    /// How far a surface vertex may stay off its surface, mm.
    pub slack: f64,
}

/// Tets below the wanted score, worst first.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn low_tets(mesh: &ImprovementMesh, wanted: f64, context: &RunContext) -> Result<Vec<(f64, u32)>> {
    let threshold = Threshold::of(wanted);
    let fails = |t: u32| mesh.is_live(t) && mesh.fails(t, &threshold);
    low_among(mesh, numbers_where(mesh.tets.len(), &fails, context)?, wanted, context)
}

/// Those of some tets below the wanted score, worst first.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn low_among(
    mesh: &ImprovementMesh,
    mut candidates: Vec<u32>,
    wanted: f64,
    context: &RunContext,
) -> Result<Vec<(f64, u32)>> {
    let threshold = Threshold::of(wanted);
    candidates.retain(|t| mesh.is_live(*t));
    let scored = |t: u32| if mesh.fails(t, &threshold) { Some((mesh.score(t), t)) } else { None };
    let tets = candidates.into_par_iter().with_min_len(1024);
    let mut low: Vec<(f64, u32)> = context.until_cancelled(tets).filter_map(scored).collect();
    context.check()?;
    low.sort_unstable_by(|l, r| l.0.total_cmp(&r.0).then(l.1.cmp(&r.1)));
    Ok(low)
}

/// Whether what was tried in vain is remembered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InVain {
    /// All is tried: over a whole mesh forgetting what has changed costs more than is saved, half a per cent of all instructions.
    Forgotten,
    /// It is not tried again before it changes: for crowds.
    Remembered,
}

/// Work on low tets, in one sweep after another.
pub struct Raising<'a> {
    effort: Effort,
    in_vain: InVain,
    /// Transformations made; without it elements stay the same.
    counts: Option<&'a mut TransformationCounts>,
    /// Vertices that were searched for a better place in vain since any of their tets last changed.
    unmoved: FxHashSet<u32>,
    /// Edges, lower vertex first, whose split gained nothing since any of their tets last changed.
    unsplit: FxHashSet<[u32; 2]>,
}

/// A tet that is to be raised.
#[derive(Debug, Clone, Copy)]
pub struct LowTet {
    tet: u32,
    /// Those of its corners before this one had their chance to move.
    first_corner: usize,
}

/// A step that raises a tet.
enum Step {
    /// A corner of the tet goes to another place.
    Move(usize, DVec3),
    /// The tet is transformed.
    Transform(Transformation),
}

/// What was found for a low tet.
#[derive(Default)]
pub struct Found {
    step: Option<Step>,
    /// Its corners that were searched for a better place in vain.
    unmoved: [bool; 4],
    /// Whether no transformation gained.
    is_stuck: bool,
}

impl<'a> Raising<'a> {
    /// Without `counts` elements stay the same.
    pub fn new(effort: Effort, in_vain: InVain, counts: Option<&'a mut TransformationCounts>) -> Self {
        Self { effort, in_vain, counts, unmoved: FxHashSet::default(), unsplit: FxHashSet::default() }
    }

    /// Raises tets of low score. Between sweeps nobody else may change the mesh.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn sweep(&mut self, mesh: &mut ImprovementMesh, mut low: Vec<(f64, u32)>, context: &RunContext) -> Result<()> {
        let class_of = |(score, _): &(f64, u32)| (score.max(0.0) / SCORE_CLASS) as u32;
        low.sort_unstable_by_key(|scored| (class_of(scored), scored.1));
        let classes = low.chunk_by(|one, next| class_of(one) == class_of(next));
        let tets: Vec<LowTet> =
            classes.flat_map(spread_over_batches).map(|(_, tet)| LowTet { tet, first_corner: 0 }).collect();
        change_in_order(mesh, &tets, self, context)
    }

    /// Some tets are about to change.
    fn forget(&mut self, mesh: &ImprovementMesh, tets: &[u32]) {
        let rows = || tets.iter().map(|t| mesh.tets[*t as usize]);
        if !self.unmoved.is_empty() {
            rows().flatten().for_each(|v| {
                self.unmoved.remove(&v);
            });
        }
        if !self.unsplit.is_empty() {
            rows().flat_map(sorted_edges).for_each(|edge| {
                self.unsplit.remove(&edge);
            });
        }
    }
}

impl PlannedChange for Raising<'_> {
    type Item = LowTet;
    type Plan = Found;

    fn append_vertices(&self, mesh: &ImprovementMesh, low: &LowTet, vertices: &mut Vec<u32>) {
        if mesh.is_live(low.tet) {
            append_vertices_around_tet(mesh, low.tet, vertices);
        }
    }

    fn plan(&self, mesh: &ImprovementMesh, low: &LowTet, ball: &mut Ball) -> Found {
        let Effort { wanted, surfaces, slack } = self.effort;
        let mut found = Found::default();
        if !(mesh.is_live(low.tet) && mesh.score(low.tet) < wanted) {
            return found;
        }
        let tet = mesh.tets[low.tet as usize];
        let may_move = |v: u32| !mesh.fixed[v as usize] && (surfaces == Surfaces::MayYield || !mesh.is_on_surface(v));
        for (corner, v) in tet.into_iter().enumerate().skip(low.first_corner).filter(|(_, v)| may_move(*v)) {
            if self.unmoved.contains(&v) {
                continue;
            }
            let place = mesh.points[v as usize];
            mesh.gather(v, ball);
            let (better, _) = better_place(mesh, place, mesh.sides(v), [wanted, slack], ball);
            if better != place {
                found.step = Some(Step::Move(corner, better));
                return found;
            }
            found.unmoved[corner] = true;
        }
        if self.counts.is_some() {
            let transformation = Transformation::plan(mesh, low.tet, slack, |edge| self.unsplit.contains(&edge), ball);
            found.is_stuck = transformation.is_none();
            found.step = transformation.map(Step::Transform);
        }
        found
    }

    fn change(
        &mut self,
        mesh: &mut ImprovementMesh,
        low: &LowTet,
        found: Found,
        touched: &mut Touched,
    ) -> Option<LowTet> {
        let tet = mesh.tets[low.tet as usize];
        if self.in_vain == InVain::Remembered {
            self.unmoved.extend(tet.into_iter().zip(found.unmoved).filter(|(_, unmoved)| *unmoved).map(|(v, _)| v));
            if found.is_stuck {
                self.unsplit.extend(sorted_edges(tet));
            }
        }
        match found.step? {
            Step::Move(corner, place) => {
                let v = tet[corner];
                touched.mark(mesh, v);
                self.forget(mesh, mesh.ball(v));
                mesh.move_vertex(v, place);
                Some(LowTet { first_corner: corner + 1, ..*low })
            }
            Step::Transform(transformation) => {
                let tets = transformation.tets(mesh);
                touched.mark_tets(mesh, tets);
                self.forget(mesh, tets);
                transformation.make(mesh, self.counts.as_deref_mut()?);
                None
            }
        }
    }
}

/// The edges of a tet, lower vertex first.
fn sorted_edges(tet: [u32; 4]) -> [[u32; 2]; 6] {
    TET_EDGES.map(|[a, b]| sorted_edge(tet[a], tet[b]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::local_transformations::edge_split;
    use crate::lattice::test_images::voxel_image;
    use crate::lattice::test_meshes::{shaken_block, with_tets};

    const WANTED: f64 = 25.0;

    /// Raises the tets of a shaken block; what it is after, and how many transformations were made.
    fn raised(threads: usize, may_transform: bool) -> (Vec<DVec3>, Vec<[u32; 4]>, [usize; 4]) {
        let (points, labelled) = shaken_block(0.4, |_| 1);
        with_tets(points, &labelled, &voxel_image(12, |_| 1), |mut mesh| {
            let context = RunContext::with_threads(threads).unwrap();
            let before = low_tets(&mesh, WANTED, &context).unwrap();
            assert!(before.len() > 1024, "{}", before.len());
            let (count, lowest) = (before.len(), before[0].0);
            let effort = Effort { wanted: WANTED, surfaces: Surfaces::Stay, slack: 0.1 };
            let mut counts = TransformationCounts::default();
            let of_run = may_transform.then_some(&mut counts);
            let mut raising = Raising::new(effort, InVain::Remembered, of_run);
            raising.sweep(&mut mesh, before, &context).unwrap();
            let after = low_tets(&mesh, WANTED, &context).unwrap();
            assert!(after.len() < count && after[0].0 >= lowest, "{} {count}", after.len());
            // What was in vain still is.
            let known = (raising.unmoved.len(), raising.unsplit.len());
            assert!((known.1 > 0) == may_transform && (known.0 > 0 || may_transform), "{known:?}");
            for v in &raising.unmoved {
                let place = mesh.points[*v as usize];
                let search = |mesh: &mut ImprovementMesh, ball: &mut Ball| {
                    better_place(mesh, place, mesh.sides(*v), [WANTED, effort.slack], ball).0
                };
                assert_eq!(mesh.with_ball(*v, search), place);
            }
            for [a, b] in &raising.unsplit {
                let shell = mesh.shell(*a, *b);
                assert!(!shell.is_empty());
                let split = |mesh: &mut ImprovementMesh, ball: &mut Ball| {
                    edge_split(mesh, [*a, *b], &shell, effort.slack, ball).is_some()
                };
                assert!(!mesh.with_scratch(split));
            }
            context.cancel_token().cancel();
            let cancelled = raising.sweep(&mut mesh, after, &context);
            assert!(matches!(cancelled, Err(crate::Error::Cancelled)));
            let counts = [counts.edge_removals, counts.face_exchanges, counts.contractions, counts.splits];
            (std::mem::take(&mut mesh.points), std::mem::take(&mut mesh.tets), counts)
        })
    }

    #[test]
    fn many_threads_raise_tets_as_one_does() {
        let alone = raised(1, true);
        assert!(
            alone.2.iter().sum::<usize>() > 100 && alone.2.iter().filter(|count| **count > 0).count() > 2,
            "{:?}",
            alone.2
        );
        assert!(raised(3, true) == alone);
    }

    #[test]
    fn tets_stay_the_same_where_only_vertices_may_move() {
        let (points, tets, counts) = raised(3, false);
        let (before, labelled) = shaken_block(0.4, |_| 1);
        assert_eq!((points.len(), counts), (before.len(), [0; 4]));
        let sorted = |mut tet: [u32; 4]| {
            tet.sort_unstable();
            tet
        };
        assert!(tets.len() == labelled.len());
        assert!(tets.iter().zip(labelled).all(|(tet, (old, _))| sorted(*tet) == sorted(old)));
    }
}
