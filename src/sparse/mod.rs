//! Sparse symmetric systems in 3 x 3 blocks; a matrix does not know its origin.

pub mod bicgstab;
pub mod block_csr;
pub mod conjugate_gradient;
pub mod direct;
pub mod lsqr;
pub mod pattern;
pub mod preconditioner;
pub mod solver;
