//! What a run of the surface engine did, in figures.

use crate::statistics::Statistics;

/// Figures of the input check.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CheckReport {
    /// Points after merging equal ones.
    pub points: usize,
    /// Facets.
    pub facets: usize,
    /// Equal points that were merged into others.
    pub merged_points: usize,
    /// Pairs of facets whose boxes overlap.
    pub candidate_pairs: usize,
    /// Wall time, s.
    pub seconds: f64,
}

/// Figures of boundary recovery.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct RecoveryReport {
    /// Edges of the surface that the Delaunay mesh lacks.
    pub missing_edges: usize,
    /// Facets of the surface that are missing once all edges are there.
    pub missing_faces: usize,
    /// Reconnections committed.
    pub reconnections: usize,
    /// Cavities searched for a tetrahedralization, and those where one was found.
    pub cavities: [usize; 2],
    /// Steiner points put on edges and on facets.
    pub steiner_on_surface: [usize; 2],
    /// Steiner points left in the volume.
    pub steiner_in_volume: usize,
    /// Wall time of edge recovery, face recovery, partition elimination and Steiner removal, s.
    pub seconds: [f64; 4],
}

/// Figures of the whole run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Report {
    /// Input check.
    pub check: CheckReport,
    /// Wall time of Delaunay tetrahedralization, s.
    pub delaunay_seconds: f64,
    /// Tets of the Delaunay mesh, ghosts not counted.
    pub delaunay_tets: usize,
    /// Boundary recovery.
    pub recovery: RecoveryReport,
    /// Regions meshed.
    pub regions: usize,
    /// Wall time of everything, s.
    pub total_seconds: f64,
    /// Figures of refinement and quality improvement, by name.
    pub refinement: Statistics,
}

impl Report {
    /// The figures by name.
    pub fn statistics(&self) -> Statistics {
        let mut statistics = Statistics::default();
        let recovery = &self.recovery;
        let entries = [
            ("time.input_check", self.check.seconds),
            ("time.delaunay", self.delaunay_seconds),
            ("time.recovery.edges", recovery.seconds[0]),
            ("time.recovery.faces", recovery.seconds[1]),
            ("time.recovery.partition_elimination", recovery.seconds[2]),
            ("time.recovery.steiner_removal", recovery.seconds[3]),
            ("time.recovery", recovery.seconds.iter().sum()),
            ("time.total", self.total_seconds),
            ("input.points", self.check.points as f64),
            ("input.facets", self.check.facets as f64),
            ("input.merged_points", self.check.merged_points as f64),
            ("input.candidate_pairs", self.check.candidate_pairs as f64),
            ("delaunay.tets", self.delaunay_tets as f64),
            ("recovery.missing_edges", recovery.missing_edges as f64),
            ("recovery.missing_faces", recovery.missing_faces as f64),
            ("recovery.reconnections", recovery.reconnections as f64),
            ("recovery.cavities_tried", recovery.cavities[0] as f64),
            ("recovery.cavities_filled", recovery.cavities[1] as f64),
            ("recovery.steiner_on_edges", recovery.steiner_on_surface[0] as f64),
            ("recovery.steiner_on_faces", recovery.steiner_on_surface[1] as f64),
            ("recovery.steiner_points", recovery.steiner_in_volume as f64),
            ("regions", self.regions as f64),
        ];
        for (name, value) in entries {
            statistics.set(name, value);
        }
        statistics.extend(&self.refinement);
        statistics
    }
}
