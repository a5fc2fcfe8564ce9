//! Which share of a run's time is over when each stage ends; hosts show it as a progress bar.
//!
//! # Method
//! Shares of processor time, measured on a whole-brain atlas with 2.2 million tets: refinement 12 %, targets 13 %,
//! deformation 17 %, improvement 50 %. Without smoothing nearly all of the time is refinement.

/// When refinement begins.
pub const BEGUN: f64 = 0.02;
/// When the lattice is refined and nothing is smoothed.
pub const REFINED_ONLY: f64 = 0.9;
/// When the lattice is refined and smoothing follows.
pub const REFINED: f64 = 0.12;
/// When the surfaces are found that smoothing aims at.
pub const TARGETED: f64 = 0.25;
/// When the deformation ends.
pub const DEFORMED: f64 = 0.42;
/// When the improvement ends.
pub const IMPROVED: f64 = 0.93;
/// When files and evaluations are left.
pub const FINISHING: f64 = 0.95;

/// The share when `done` of `all` steps of a stage are over.
pub fn within((begin, end): (f64, f64), done: usize, all: usize) -> f64 {
    begin + (end - begin) * done as f64 / all.max(1) as f64
}
