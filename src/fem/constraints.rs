//! Prescribed displacements and point loads.
//!
//! # Method
//! A fixed degree of freedom keeps its row and column in the pattern: its column is moved to the right side, row and
//! column are cleared and the diagonal set to a value of the matrix's own size. The matrix stays symmetric and positive
//! definite, and its pattern unchanged.

use glam::{BVec3, DMat3, DVec3};

use crate::index::VertexId;
use crate::sparse::block_csr::BlockCsr;

/// A node whose displacement is given, by component.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PrescribedDisplacement {
    /// The node.
    pub node: VertexId,
    /// Components that are fixed.
    pub fixed: BVec3,
    /// Values of the fixed components, in the unit of the points.
    pub value: DVec3,
}

impl PrescribedDisplacement {
    /// All three components given.
    pub fn full(node: VertexId, value: DVec3) -> Self {
        Self { node, fixed: BVec3::TRUE, value }
    }
}

/// A force on a node.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointLoad {
    /// The node.
    pub node: VertexId,
    /// The force, unit of the modulus times area.
    pub force: DVec3,
}

/// Adds the loads to the right side.
pub fn apply_loads(loads: &[PointLoad], right: &mut [DVec3]) {
    for load in loads {
        right[load.node.index()] += load.force;
    }
}

/// Brings prescribed displacements into a symmetric system.
pub fn prescribe(constraints: &[PrescribedDisplacement], matrix: &mut BlockCsr, right: &mut [DVec3]) {
    let n = matrix.row_count();
    let mut free = vec![DVec3::ONE; n];
    let mut value = vec![DVec3::ZERO; n];
    for c in constraints {
        for d in 0..3 {
            if c.fixed.test(d) {
                free[c.node.index()][d] = 0.0;
                value[c.node.index()][d] = c.value[d];
            }
        }
    }
    let mut moved = vec![DVec3::ZERO; n];
    matrix.multiply(&value, &mut moved);
    let diagonals: Vec<DMat3> = (0..n).map(|row| matrix.diagonal(row)).collect();
    matrix.fill_rows(|pattern, rows, blocks| {
        let base = pattern.offsets()[rows.start];
        for row in rows {
            for (at, column) in pattern.row(row).iter().enumerate() {
                let column = *column as usize;
                let block = &mut blocks[pattern.offsets()[row] + at - base];
                *block = DMat3::from_cols(
                    block.x_axis * free[row] * free[column].x,
                    block.y_axis * free[row] * free[column].y,
                    block.z_axis * free[row] * free[column].z,
                );
                if row == column {
                    let trace = diagonals[row].x_axis.x + diagonals[row].y_axis.y + diagonals[row].z_axis.z;
                    let size = if trace > 0.0 { trace / 3.0 } else { 1.0 };
                    *block += DMat3::from_diagonal((DVec3::ONE - free[row]) * size);
                }
            }
        }
    });
    for row in 0..n {
        let fixed = (DVec3::ONE - free[row]) * matrix_diagonal(matrix, row) * value[row];
        right[row] = (right[row] - moved[row]) * free[row] + fixed;
    }
}

fn matrix_diagonal(matrix: &BlockCsr, row: usize) -> DVec3 {
    let block = matrix.diagonal(row);
    DVec3::new(block.x_axis.x, block.y_axis.y, block.z_axis.z)
}
