//! Drives insertions and reconnections over many tets: alone, or speculatively on several threads.

use super::local_reconnection::{FlipCounts, FourFour, Objective, Reconnector};
use super::options::Options;
use super::vertex_insertion::{Insertion, InsertionRule, insert_vertex};
use crate::context::RunContext;
use crate::error::Result;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
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
}

impl Driver {
    /// The driver of refinement.
    pub fn for_refinement(_options: &Options, context: &RunContext) -> Self {
        Self { context: context.clone(), worker: Reconnector::default(), counts: FlipCounts::default() }
    }

    /// The counts since the last call.
    pub fn take_counts(&mut self) -> FlipCounts {
        let counts = std::mem::take(&mut self.worker.counts);
        self.counts.add(counts);
        counts
    }

    /// Adds the figures of the parallel passes.
    pub fn record(&self, _figures: &mut Statistics, _prefix: &str) {}

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
        let _ = TetFace::NONE;
        Ok(())
    }
}
