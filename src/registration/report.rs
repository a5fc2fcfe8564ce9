//! What a run did: counts and times per step.

use crate::statistics::Statistics;

/// One iteration of the adaptive loop.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct IterationReport {
    /// Spacing of the grid that was matched on, mm.
    pub spacing: f64,
    /// Blocks selected in both scans.
    pub blocks: usize,
    /// Blocks without correspondence.
    pub missing: usize,
    /// Blocks paired with the brain surface.
    pub paired: usize,
    /// Blocks rejected as outliers.
    pub rejected: usize,
    /// Mean length of the update of the field in the tissue, mm.
    pub mean_update: f64,
    /// Volume of the cavity, mm^3.
    pub cavity: f64,
    /// Nodes and elements of the model.
    pub nodes: usize,
    /// Elements of the model.
    pub elements: usize,
    /// Iterations of all solves.
    pub solver_iterations: usize,
    /// Seconds of warping and cavity search, meshing, matching, solving, composing.
    pub seconds: [f64; 5],
}

/// Counts and times of a run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Report {
    /// Mutual information before and after the rigid search; empty where there was none.
    pub rigid_information: Option<[f64; 2]>,
    /// Steps of the rigid search.
    pub rigid_iterations: usize,
    /// The iterations of the loop.
    pub iterations: Vec<IterationReport>,
    /// Voxels that folded before the repair.
    pub folded_before: usize,
    /// Voxels smoothed by the repair.
    pub smoothed: usize,
    /// Smallest Jacobian determinant of the field in the tissue.
    pub jacobian_minimum: f64,
    /// Mean and largest length of the displacement beyond the rigid part in the tissue, mm.
    pub displacement: [f64; 2],
    /// Evaluation by Canny edges: Hausdorff distance, its 95th percentile, mean distance, mm; before, then after.
    pub edges: Option<[[f64; 3]; 2]>,
    /// Evaluation by landmarks: mean and largest distance, mm; before (rigid), then after.
    pub landmarks: Option<[[f64; 2]; 2]>,
    /// Seconds: rigid search, loop, output, evaluation, all.
    pub seconds: [f64; 5],
}

impl Report {
    /// The report as named figures.
    pub fn statistics(&self) -> Statistics {
        let mut s = Statistics::default();
        let names = ["time.rigid", "time.loop", "time.output", "time.evaluation", "time.total"];
        names.into_iter().zip(self.seconds).for_each(|(name, value)| s.set(name, value));
        if let Some([before, after]) = self.rigid_information {
            s.set("rigid.information_before", before);
            s.set("rigid.information", after);
            s.set("rigid.iterations", self.rigid_iterations as f64);
        }
        s.set("adaptive.iterations", self.iterations.len() as f64);
        for (n, iteration) in self.iterations.iter().enumerate() {
            iteration.add_to(&mut s, n + 1);
        }
        s.set("field.folded_before_repair", self.folded_before as f64);
        s.set("field.smoothed_voxels", self.smoothed as f64);
        s.set("field.jacobian_minimum", self.jacobian_minimum);
        s.set("field.mean_displacement", self.displacement[0]);
        s.set("field.max_displacement", self.displacement[1]);
        if let Some(pair) = self.edges {
            for (name, values) in ["edges.rigid", "edges"].into_iter().zip(pair) {
                s.set(format!("{name}.hausdorff"), values[0]);
                s.set(format!("{name}.hausdorff_95"), values[1]);
                s.set(format!("{name}.mean"), values[2]);
            }
        }
        if let Some(pair) = self.landmarks {
            for (name, values) in ["landmarks.rigid", "landmarks"].into_iter().zip(pair) {
                s.set(format!("{name}.mean"), values[0]);
                s.set(format!("{name}.max"), values[1]);
            }
        }
        s
    }
}

impl IterationReport {
    fn add_to(&self, s: &mut Statistics, number: usize) {
        let figures = [
            ("spacing", self.spacing),
            ("blocks", self.blocks as f64),
            ("missing", self.missing as f64),
            ("paired", self.paired as f64),
            ("rejected", self.rejected as f64),
            ("mean_update", self.mean_update),
            ("cavity_volume", self.cavity),
            ("nodes", self.nodes as f64),
            ("elements", self.elements as f64),
            ("solver_iterations", self.solver_iterations as f64),
            ("time.warp", self.seconds[0]),
            ("time.mesh", self.seconds[1]),
            ("time.matching", self.seconds[2]),
            ("time.solve", self.seconds[3]),
            ("time.field", self.seconds[4]),
        ];
        for (name, value) in figures {
            s.set(format!("iteration.{number}.{name}"), value);
        }
    }
}
