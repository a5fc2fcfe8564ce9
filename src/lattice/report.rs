//! Counts and times of a run of the engine.

use std::time::Instant;

use crate::statistics::Statistics;

/// What each step did, in the order of the steps.
#[derive(Debug, Clone, Default)]
pub struct Report {
    statistics: Statistics,
}

impl Report {
    /// Adds a figure.
    pub fn set(&mut self, name: impl Into<String>, value: f64) {
        self.statistics.set(name, value);
    }

    /// Adds to a figure, which begins at 0.
    pub fn add(&mut self, name: &str, value: f64) {
        let sum = self.statistics.value(name).unwrap_or(0.0) + value;
        self.statistics.set(name, sum);
    }

    /// Runs a step and adds its time to `time.<step>`.
    pub fn timed<T>(&mut self, step: &str, work: impl FnOnce() -> T) -> T {
        let begin = Instant::now();
        let result = work();
        self.add(&format!("time.{step}"), begin.elapsed().as_secs_f64());
        result
    }

    /// Takes over figures made elsewhere.
    pub fn merge(&mut self, figures: &Statistics) {
        self.statistics.extend(figures);
    }

    /// All figures.
    pub fn statistics(&self) -> Statistics {
        self.statistics.clone()
    }
}
