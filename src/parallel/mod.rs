//! Shared mutation: the only place of the crate with atomics and claims.
//!
//! # Method
//! Each file holds one protocol and argues its memory ordering; the geometry above knows nothing of threads.

pub mod coloring;
pub mod ordered_reduce;
