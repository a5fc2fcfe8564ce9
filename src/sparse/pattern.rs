//! Sparsity from connectivity: which nodes share an element.
//!
//! # Method
//! 1. [`Incidence`] lists the elements of each node, by counting.
//! 2. [`Pattern`] collects, per node, the nodes of those elements, sorted, without duplicates. Rows are independent, so
//!    fixed chunks of rows are made in parallel and joined in order.
//!
//! # Invariants
//! Columns increase within a row; the diagonal is always present; the pattern is symmetric.
//!
//! # Cost
//! 4 bytes per entry and 8 bytes per row; time linear in the sum of the squared element sizes.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::index::VertexId;

/// Rows that one task builds.
const ROW_CHUNK: usize = 2048;

/// The elements of each node, in increasing order.
#[derive(Debug, Clone, Default)]
pub struct Incidence {
    offsets: Vec<u32>,
    elements: Vec<u32>,
}

impl Incidence {
    /// From elements in one connectivity array; element `e` has the nodes `connectivity[offsets[e]..offsets[e + 1]]`.
    ///
    /// # Errors
    /// [`Error::CapacityExceeded`] past 2^32 - 1 entries; [`Error::InvalidArgument`] for a node out of range.
    pub fn new(node_count: usize, offsets: &[i64], connectivity: &[VertexId]) -> Result<Self> {
        if connectivity.len() >= u32::MAX as usize {
            let needed = connectivity.len() as u64;
            return Err(Error::CapacityExceeded { what: "element nodes", needed, limit: u64::from(u32::MAX) });
        }
        if let Some(node) = connectivity.iter().find(|n| n.index() >= node_count) {
            return Err(Error::argument("connectivity", format!("node {} of {node_count}", node.0)));
        }
        let mut starts = vec![0u32; node_count + 1];
        for node in connectivity {
            starts[node.index() + 1] += 1;
        }
        for node in 0..node_count {
            starts[node + 1] += starts[node];
        }
        let mut fill = starts.clone();
        let mut elements = vec![0u32; connectivity.len()];
        for element in 0..offsets.len().saturating_sub(1) {
            for node in &connectivity[offsets[element] as usize..offsets[element + 1] as usize] {
                let slot = &mut fill[node.index()];
                elements[*slot as usize] = element as u32;
                *slot += 1;
            }
        }
        Ok(Self { offsets: starts, elements })
    }

    /// The elements of a node.
    #[inline]
    pub fn of(&self, node: usize) -> &[u32] {
        &self.elements[self.offsets[node] as usize..self.offsets[node + 1] as usize]
    }

    /// Number of nodes.
    pub fn node_count(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }
}

/// Rows and columns of a symmetric sparse matrix.
#[derive(Debug, Clone, Default)]
pub struct Pattern {
    offsets: Vec<usize>,
    columns: Vec<u32>,
    /// Place of the diagonal within each row.
    diagonals: Vec<u32>,
}

impl Pattern {
    /// Two nodes are coupled when they share an element.
    ///
    /// # Errors
    /// [`Error::Cancelled`], [`Error::LimitReached`].
    pub fn from_elements(
        incidence: &Incidence,
        offsets: &[i64],
        connectivity: &[VertexId],
        context: &RunContext,
    ) -> Result<Self> {
        let node_count = incidence.node_count();
        let chunks: Vec<(Vec<[u32; 2]>, Vec<u32>)> = (0..node_count.div_ceil(ROW_CHUNK))
            .into_par_iter()
            .map(|chunk| {
                context.check()?;
                let rows = chunk * ROW_CHUNK..((chunk + 1) * ROW_CHUNK).min(node_count);
                let (mut lengths, mut columns, mut row) = (Vec::with_capacity(rows.len()), Vec::new(), Vec::new());
                for node in rows {
                    row.clear();
                    row.push(node as u32);
                    for &element in incidence.of(node) {
                        let (begin, end) = (offsets[element as usize] as usize, offsets[element as usize + 1] as usize);
                        row.extend(connectivity[begin..end].iter().map(|n| n.0));
                    }
                    row.sort_unstable();
                    row.dedup();
                    let diagonal = row.partition_point(|column| (*column as usize) < node);
                    lengths.push([row.len() as u32, diagonal as u32]);
                    columns.extend_from_slice(&row);
                }
                Ok((lengths, columns))
            })
            .collect::<Result<_>>()?;
        let mut pattern = Self {
            offsets: Vec::with_capacity(node_count + 1),
            columns: Vec::new(),
            diagonals: Vec::with_capacity(node_count),
        };
        pattern.offsets.push(0);
        pattern.columns.reserve_exact(chunks.iter().map(|(_, c)| c.len()).sum());
        let mut end = 0;
        for (lengths, columns) in chunks {
            for [length, diagonal] in lengths {
                end += length as usize;
                pattern.offsets.push(end);
                pattern.diagonals.push(diagonal);
            }
            pattern.columns.extend_from_slice(&columns);
        }
        Ok(pattern)
    }

    /// Number of block rows.
    pub fn row_count(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// Number of stored blocks.
    pub fn entry_count(&self) -> usize {
        self.columns.len()
    }

    /// Start of each row in the columns, one more at the end.
    pub fn offsets(&self) -> &[usize] {
        &self.offsets
    }

    /// Columns of one row.
    #[inline]
    pub fn row(&self, row: usize) -> &[u32] {
        &self.columns[self.offsets[row]..self.offsets[row + 1]]
    }

    /// Position of the diagonal block of a row; every row has one.
    #[inline]
    pub fn diagonal(&self, row: usize) -> usize {
        self.offsets[row] + self.diagonals[row] as usize
    }

    /// Position of the block (row, column), where it is stored.
    #[inline]
    pub fn position(&self, row: usize, column: usize) -> Option<usize> {
        let columns = self.row(row);
        columns.binary_search(&(column as u32)).ok().map(|at| self.offsets[row] + at)
    }
}
