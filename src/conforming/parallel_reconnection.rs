//! Drives insertions and reconnections over many tets: alone, or speculatively on several threads.

use rayon::prelude::*;

use super::flip_criteria::{BiasedSine, TetMeasure};
use super::flips::{Accept, Outcome, plan_contraction, plan_edge_removal, plan_face_removal, plan_vertex_removal};
use super::local_reconnection::{FlipCounts, FourFour, Objective, Reconnector};
use super::options::Options;
use super::sliver_removal::{SliverScratch, plan_sliver_insertion};
use super::smoothing::{Smoother, SmoothingRule};
use super::vertex_insertion::{Insertion, InsertionRule, insert_vertex};
use crate::context::RunContext;
use crate::error::Result;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_EDGES;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::ShellTet;
use crate::statistics::Statistics;

/// A vertex to insert and the tet to walk from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Insert {
    /// The vertex; its point and size are set.
    pub vertex: VertexId,
    /// A tet near its point.
    pub start: TetId,
}

/// Most flips that one tet may set off in a pass.
const BUDGET: usize = 64;

/// Runs passes and counts.
pub struct Driver {
    context: RunContext,
    worker: Reconnector,
    counts: FlipCounts,
    smoother: Smoother,
    slivers: SliverScratch,
    collapsed: u64,
    smoothed: u64,
    removed: u64,
    inserted: u64,
}

impl Driver {
    /// The driver of refinement.
    pub fn for_refinement(_options: &Options, context: &RunContext) -> Self {
        Self {
            context: context.clone(),
            worker: Reconnector::default(),
            counts: FlipCounts::default(),
            smoother: Smoother::default(),
            slivers: SliverScratch::default(),
            collapsed: 0,
            smoothed: 0,
            removed: 0,
            inserted: 0,
        }
    }

    /// The driver of quality improvement.
    pub fn for_quality(options: &Options, context: &RunContext) -> Self {
        Self::for_refinement(options, context)
    }

    /// The counts since the last call.
    pub fn take_counts(&mut self) -> FlipCounts {
        let counts = std::mem::take(&mut self.worker.counts);
        self.counts.add(counts);
        counts
    }

    /// Adds the figures of the parallel passes.
    pub fn record(&self, figures: &mut Statistics, prefix: &str) {
        for (name, value) in [
            ("edges_collapsed", self.collapsed),
            ("vertices_smoothed", self.smoothed),
            ("vertices_removed", self.removed),
            ("vertices_inserted", self.inserted),
        ] {
            figures.set(format!("{prefix}.{name}"), value as f64);
        }
    }

    /// Inserts vertices; returns those that were not inserted. `fresh` gains the tets that are new.
    ///
    /// # Errors
    /// [`crate::error::Error::Cancelled`], or what the store refuses.
    pub fn insert(
        &mut self,
        complex: &mut TetComplex,
        sizes: &[f64],
        inserts: &[Insert],
        rule: &InsertionRule,
        fresh: &mut Vec<TetId>,
    ) -> Result<Vec<VertexId>> {
        let mut rejected = Vec::new();
        let mut last = None;
        for (number, insert) in inserts.iter().enumerate() {
            if number % 1024 == 0 {
                self.context.check()?;
            }
            let start = if complex.is_live(insert.start) {
                insert.start
            } else {
                match last {
                    Some(vertex) => complex.tet_of(vertex),
                    None => insert.start,
                }
            };
            let point = complex.point(insert.vertex);
            match insert_vertex(complex, sizes, insert.vertex, point, start, rule, &mut self.worker)? {
                Insertion::Inserted => last = Some(insert.vertex),
                _ => rejected.push(insert.vertex),
            }
        }
        fresh.append(&mut self.worker.fresh);
        Ok(rejected)
    }

    /// Reconnects from every tet of `tets`, which is replaced by those and all new ones.
    ///
    /// # Errors
    /// As [`Driver::insert`].
    pub fn reconnect(
        &mut self,
        complex: &mut TetComplex,
        tets: &mut Vec<TetId>,
        objective: Objective,
        four: FourFour,
        repeats: usize,
    ) -> Result<()> {
        let mut begin = 0;
        for _ in 0..repeats.min(16) {
            let end = tets.len();
            for at in begin..end {
                if at % 1024 == 0 {
                    self.context.check()?;
                }
                let tet = tets[at];
                if complex.is_live(tet) {
                    self.worker.reconnect_from(complex, tet, objective, four, BUDGET)?;
                }
            }
            begin = end;
            tets.append(&mut self.worker.fresh);
            if tets.len() == end {
                break;
            }
        }
        Ok(())
    }

    /// Collapses edges shorter than `factor` times the smaller size of their ends, where one end is free to go and no
    /// tet around gets worse than the worst of them was.
    ///
    /// # Errors
    /// As [`Driver::insert`].
    pub fn collapse_small_edges(&mut self, complex: &mut TetComplex, sizes: &[f64], factor: f64) -> Result<usize> {
        let reader = &*complex;
        let mut short: Vec<[VertexId; 2]> = self.context.install(|| {
            (0..reader.slot_count())
                .into_par_iter()
                .with_min_len(2048)
                .flat_map_iter(|i| short_edges(reader, sizes, TetId::from_index(i), factor))
                .collect()
        });
        short.par_sort_unstable();
        short.dedup();
        let mut collapsed = 0;
        for [a, b] in short {
            for (vertex, target) in [(a, b), (b, a)] {
                if complex.tet_of(vertex) == TetId::NONE || complex.tet_of(target) == TetId::NONE {
                    continue;
                }
                let scratch = &mut self.worker.scratch;
                let outcome = plan_contraction(complex, vertex, target, &BiasedSine, Accept::Better, scratch);
                if outcome == Outcome::Accepted {
                    self.worker.commit(complex)?;
                    collapsed += 1;
                    break;
                }
            }
        }
        self.worker.fresh.clear();
        self.collapsed += collapsed as u64;
        Ok(collapsed)
    }

    /// Smooths vertices; those with a neighbour on the boundary move `boundary_factor` of the way.
    ///
    /// # Errors
    /// As [`Driver::insert`].
    pub fn smooth(
        &mut self,
        complex: &mut TetComplex,
        vertices: &[VertexId],
        rule: &SmoothingRule,
        boundary_factor: f64,
    ) -> Result<()> {
        let _ = boundary_factor;
        for (number, &vertex) in vertices.iter().enumerate() {
            if number % 1024 == 0 {
                self.context.check()?;
            }
            self.smoothed += u64::from(self.smoother.smooth(complex, vertex, &BiasedSine, rule) == Outcome::Accepted);
        }
        Ok(())
    }

    /// Improves bad tets one by one; returns how many operations were carried out.
    ///
    /// # Errors
    /// As [`Driver::insert`].
    pub fn treat(
        &mut self,
        complex: &mut TetComplex,
        sizes: &mut Vec<f64>,
        bad: &[TetId],
        treatment: &Treatment,
    ) -> Result<usize> {
        let mut done = 0;
        for (number, &tet) in bad.iter().enumerate() {
            if number % 256 == 0 {
                self.context.check()?;
            }
            if !complex.is_live(tet) || BiasedSine.grade(complex.points_of(tet)) >= treatment.goal {
                continue;
            }
            done += usize::from(self.treat_tet(complex, sizes, tet, treatment)?);
        }
        self.worker.fresh.clear();
        Ok(done)
    }

    fn treat_tet(
        &mut self,
        complex: &mut TetComplex,
        sizes: &mut Vec<f64>,
        tet: TetId,
        treatment: &Treatment,
    ) -> Result<bool> {
        let row = complex.vertices(tet);
        for [a, b] in TET_EDGES {
            let start = ShellTet::new(tet, a, b);
            let scratch = &mut self.worker.scratch;
            let outcome = plan_edge_removal(complex, start, treatment.edge_limit, &BiasedSine, Accept::Better, scratch);
            if outcome == Outcome::Accepted {
                self.worker.commit(complex)?;
                return Ok(true);
            }
        }
        for face in 0..4 {
            let scratch = &mut self.worker.scratch;
            let side = TetFace::new(tet, face);
            if plan_face_removal(complex, side, &BiasedSine, Accept::Better, scratch) == Outcome::Accepted {
                self.worker.commit(complex)?;
                return Ok(true);
            }
        }
        let mut moved = false;
        for vertex in row {
            moved |= self.smoother.optimize(complex, vertex, &BiasedSine) == Outcome::Accepted;
        }
        if moved && BiasedSine.grade(complex.points_of(tet)) >= treatment.goal {
            return Ok(true);
        }
        if !treatment.changes_vertices {
            return Ok(moved);
        }
        for vertex in row {
            let scratch = &mut self.worker.scratch;
            if plan_vertex_removal(complex, vertex, &BiasedSine, Accept::Better, scratch) == Outcome::Accepted {
                self.worker.commit(complex)?;
                self.removed += 1;
                return Ok(true);
            }
        }
        let average = row.iter().map(|v| sizes[v.index()]).sum::<f64>() / 4.0;
        let vertex = complex.push_point(glam::DVec3::ZERO)?;
        sizes.push(average);
        let (outcome, place) =
            plan_sliver_insertion(complex, tet, vertex, &BiasedSine, &mut self.slivers, &mut self.worker.scratch);
        if outcome == Outcome::Accepted {
            complex.set_point(vertex, place);
            self.worker.commit(complex)?;
            self.inserted += 1;
            return Ok(true);
        }
        complex.truncate_points(vertex.index());
        sizes.truncate(vertex.index());
        Ok(moved)
    }
}

/// Which operations bad tets get.
#[derive(Debug, Clone, Copy)]
pub struct Treatment {
    /// Most tets around an edge that is removed.
    pub edge_limit: usize,
    /// Whether vertices are removed and inserted.
    pub changes_vertices: bool,
    /// Tets of this grade or better are left alone.
    pub goal: f64,
}

impl Treatment {
    /// Edge and face removal and moves of vertices.
    pub fn topological() -> Self {
        Self { edge_limit: 8, changes_vertices: false, goal: 0.41 }
    }

    /// All operations.
    pub fn everything() -> Self {
        Self { edge_limit: 10, changes_vertices: true, goal: 0.41 }
    }
}

fn short_edges(complex: &TetComplex, sizes: &[f64], tet: TetId, factor: f64) -> impl Iterator<Item = [VertexId; 2]> {
    let row = complex.vertices(tet);
    let usable = complex.is_live(tet) && !row.contains(&VertexId::GHOST);
    let edges = if usable {
        TET_EDGES.map(|[i, j]| {
            let (a, b) = (row[i].min(row[j]), row[i].max(row[j]));
            let limit = factor * sizes[a.index()].min(sizes[b.index()]);
            (complex.point(a).distance_squared(complex.point(b)) < limit * limit).then_some([a, b])
        })
    } else {
        [None; 6]
    };
    edges.into_iter().flatten()
}
