//! The C boundary: converts and calls, no algorithm.
//!
//! # Method
//! Every function is: check pointers, build slices, call one Rust function, write outputs, return a status. It runs
//! inside [`guard`], which turns errors and panics into status codes, keeps the text for `mw_last_error` and gives the
//! work a clean floating-point environment. `include/meshwright.h` is generated from the doc comments here, which are
//! therefore written for a C reader.
//!
//! # Invariants
//! - Nothing unwinds into C. A panic gives `MW_E_INTERNAL`; the object it happened in answers `MW_E_STATE` from then on.
//! - A handle owns what it points to, or shares it by reference count: handles may be destroyed in any order.
//! - No array that C receives is ever freed by C; no array that C hands over is kept, borrowed images excepted.
//! - Parameters have no struct. The structs that do cross begin with `struct_size` and only grow at the end.
//! - Functions that change a job, a surface or a sizing lock it; a second thread gets `MW_E_STATE`, not a data race.
//!
//! # Limits
//! A handle that was already destroyed, or a pointer to too little memory, cannot be detected.

#![allow(unsafe_code)] // this module is the C boundary
#![allow(non_camel_case_types)] // its types carry their C names
#![allow(clippy::missing_safety_doc)] // the doc comments are for C readers: they state each pointer's duty per parameter

pub mod context;
pub mod guard;
pub mod handles;
pub mod image;
pub mod job;
pub mod mesh;
pub mod params;
pub mod results;
pub mod sizing;
pub mod slices;
pub mod status;
pub mod surface;
