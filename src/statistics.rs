//! Named figures of a run: counts, times, quality, in the order they were made.
//!
//! # Method
//! Each engine's report turns into [`Statistics`]; the C function `mw_job_stat`, `--json` and the benchmarks read them.
//! Names are stable and dotted: `time.total` [s], `memory.peak` [bytes], `mesh.tets`, `quality.min_dihedral` [degrees],
//! `label.3.volume` [mm^3], `histogram.dihedral.0` (count of the first bin).

/// Named figures of one run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Statistics {
    entries: Vec<(String, f64)>,
}

impl Statistics {
    /// Adds a figure, or replaces the one of the same name.
    pub fn set(&mut self, name: impl Into<String>, value: f64) {
        let name = name.into();
        match self.entries.iter_mut().find(|(n, _)| *n == name) {
            Some(entry) => entry.1 = value,
            None => self.entries.push((name, value)),
        }
    }

    /// The figure of a name.
    pub fn value(&self, name: &str) -> Option<f64> {
        self.entries.iter().find(|(n, _)| n == name).map(|(_, v)| *v)
    }

    /// All figures in the order they were made.
    pub fn entries(&self) -> &[(String, f64)] {
        &self.entries
    }

    /// Takes over all figures of `other`.
    pub fn extend(&mut self, other: &Self) {
        for (name, value) in &other.entries {
            self.set(name.clone(), *value);
        }
    }
}
