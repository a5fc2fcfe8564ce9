//! Meshwright: mesh generation and registration.
//!
//! A host hands over a segmented image, a surface triangulation or a pair of brain scans, and gets tetrahedra,
//! mixed elements or a displacement field back. The C interface is in [`capi`]; Rust programs use [`pipeline`].
//!
//! ```text
//! level 6   capi                                       the C boundary
//! level 5   pipeline                                   composes engines; the only code that knows two of them
//! level 4   lattice  |  conforming  |  registration    engines
//! level 3   fem  |  io
//! level 2   image  |  mesh  |  sparse
//! level 1   geometry
//! level 0   error -> index -> context -> parallel      (parameters stands beside context)
//! ```
//!
//! A module imports only from strictly lower levels; `tests/architecture.rs` keeps it so.

// `[Key]` in the docs cites REFERENCES.md, it is no link; tests/architecture.rs checks that each key stands there.
#![allow(rustdoc::broken_intra_doc_links)]

pub mod capi;
pub mod conforming;
pub mod context;
pub mod error;
pub mod fem;
pub mod geometry;
pub mod image;
pub mod index;
pub mod io;
pub mod lattice;
pub mod mesh;
pub mod parallel;
pub mod parameters;
pub mod pipeline;
pub mod registration;
pub mod sparse;
pub mod statistics;

pub use error::{Error, Finding, FindingCode, Result, Severity};
