//! Shared mutation: the only place of the crate with atomics and claims.
//!
//! # Method
//! Each file holds one protocol and argues its memory ordering; the geometry above knows nothing of threads.

pub mod claim_table;
pub mod coloring;
pub mod id_allocator;
pub mod ordered_concat;
pub mod ordered_reduce;
pub mod pieces;
pub mod pinning;
pub mod shared_rows;
pub mod speculative;
pub mod work_queue;
