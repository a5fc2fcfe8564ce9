//! A small least-squares system whose unknowns meet only those near them: Cholesky within a band.
//!
//! # Method
//! Weighted squares of `row . x - target` are summed into the normal matrix, of which the lower half of a band is stored; it is
//! factored and solved in place.
//!
//! # Source
//! [GolubVanLoan2013] section 4.3.5.
//!
//! # Invariants
//! Every unknown of a row is less than [`BANDWIDTH`] + 1 away from the others of it. The matrix is positive definite: the caller
//! damps every unknown.
//!
//! # Cost
//! 96 bytes and 150 multiplications per unknown.

/// How far apart unknowns of a row may be.
pub const BANDWIDTH: usize = 11;

/// Normal equations in work.
#[derive(Debug, Clone)]
pub struct BandedSystem {
    /// Row by row the entry on the diagonal, then those before it.
    rows: Vec<[f64; BANDWIDTH + 1]>,
    right: Vec<f64>,
}

impl BandedSystem {
    /// A system without equations.
    pub fn new(unknowns: usize) -> Self {
        Self { rows: vec![[0.0; BANDWIDTH + 1]; unknowns], right: vec![0.0; unknowns] }
    }

    /// Adds the square of `row . x - target`; the row has unknowns and their factors.
    pub fn add(&mut self, row: &[(usize, f64)], weight: f64, target: f64) {
        for (i, own) in row {
            self.right[*i] += weight * own * target;
            for (j, other) in row.iter().filter(|(j, _)| j <= i) {
                self.rows[*i][i - j] += weight * own * other;
            }
        }
    }

    /// The unknowns that make the sum least.
    pub fn solve(mut self) -> Vec<f64> {
        let count = self.right.len();
        let rows = &mut self.rows;
        let before = |i: usize| i.saturating_sub(BANDWIDTH);
        for i in 0..count {
            for j in before(i)..=i {
                let known: f64 = (before(i).max(before(j))..j).map(|k| rows[i][i - k] * rows[j][j - k]).sum();
                let left = rows[i][i - j] - known;
                rows[i][i - j] = if i == j { left.sqrt() } else { left / rows[j][0] };
            }
        }
        let mut x = self.right;
        for i in 0..count {
            let known: f64 = (before(i)..i).map(|k| rows[i][i - k] * x[k]).sum();
            x[i] = (x[i] - known) / rows[i][0];
        }
        for i in (0..count).rev() {
            let known: f64 = (i + 1..(i + BANDWIDTH + 1).min(count)).map(|k| rows[k][k - i] * x[k]).sum();
            x[i] = (x[i] - known) / rows[i][0];
        }
        x
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_polynomial_is_found_from_its_second_differences_and_some_values() {
        let count = 40;
        let value = |n: usize| 0.3 * (n * n) as f64 - 2.0 * n as f64 + 5.0;
        let mut system = BandedSystem::new(count);
        for n in 0..count {
            if n % 13 == 0 {
                system.add(&[(n, 2.0)], 3.0, 2.0 * value(n));
            }
            if n + 8 < count {
                let target = value(n) - 2.0 * value(n + 4) + value(n + 8);
                system.add(&[(n, 1.0), (n + 4, -2.0), (n + 8, 1.0)], 7.0, target);
            }
            if n + 11 < count {
                system.add(&[(n, 1.0), (n + 11, -1.0)], 0.5, value(n) - value(n + 11));
            }
        }
        for (n, x) in system.solve().into_iter().enumerate() {
            assert!((x - value(n)).abs() < 1e-6, "{n} {x} {}", value(n));
        }
    }
}
