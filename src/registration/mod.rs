//! Moving and fixed scan to displacement field by physics-based non-rigid registration (PBNRR, Adaptive PBNRR).
//!
//! # Method
//! 1. [`options`]: plain values from the parameter table.
//!
//! # Source
//! [Drakopoulos2017] chapter 3, appendix A.

pub mod options;
mod options_table;
pub mod rigid;
