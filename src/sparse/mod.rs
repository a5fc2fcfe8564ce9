//! Sparse symmetric systems in 3 x 3 blocks; a matrix does not know its origin.
