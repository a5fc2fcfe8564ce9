//! Composes engines: the only Rust code that knows two of them.
//!
//! # Method
//! One module per kind of job, each with `Input`, [`Output`] and `run(&Input, &ParameterSet, &RunContext)`. The C
//! interface and the command line call nothing else. Findings go through [`crate::context::RunContext::report`], those
//! of a failed run also through its error.
//!
//! # Invariants
//! The numbers of [`JobKind`] are part of the C interface: append, never renumber.

pub mod evaluation;
pub mod image_to_mesh;
mod model_meshes;
pub mod registration;
pub mod surface_to_mesh;
pub mod warp;

use std::time::Instant;

use glam::DVec3;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::image::voxel_image::VoxelImage;
use crate::mesh::mixed_mesh::{MixedMesh, NamedArray};
use crate::mesh::quality::mesh_quality;
use crate::parameters::Table;
use crate::statistics::Statistics;

/// What a job makes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(i32)]
pub enum JobKind {
    /// A segmented image becomes a mesh.
    ImageToMesh = 1,
    /// A surface triangulation becomes a mesh.
    SurfaceToMesh = 2,
    /// Two scans become a displacement field.
    Registration = 3,
}

impl JobKind {
    /// All kinds, in the order of their numbers.
    pub const ALL: [Self; 3] = [Self::ImageToMesh, Self::SurfaceToMesh, Self::Registration];

    /// The kind of a number.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`].
    pub fn from_number(number: i32) -> Result<Self> {
        Self::ALL
            .into_iter()
            .find(|kind| *kind as i32 == number)
            .ok_or_else(|| Error::argument("kind", format!("{number} is no kind of job (1 to {})", Self::ALL.len())))
    }

    /// The subcommand of the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::ImageToMesh => "image-to-mesh",
            Self::SurfaceToMesh => "surface-to-mesh",
            Self::Registration => "register",
        }
    }

    /// The parameter table of the kind's engine.
    pub fn parameters(self) -> Table {
        match self {
            Self::ImageToMesh => image_to_mesh::PARAMETERS,
            Self::SurfaceToMesh => surface_to_mesh::PARAMETERS,
            Self::Registration => registration::PARAMETERS,
        }
    }
}

/// What a job hands back.
#[derive(Debug, Clone, Default)]
pub struct Output {
    /// The mesh; a registration hands back the deformed mesh of the patient.
    pub mesh: Option<MixedMesh>,
    /// Meshes beside it, by name: debugging outputs, surfaces before and after.
    pub meshes: Vec<(String, MixedMesh)>,
    /// Images by name: `displacement`, `inverse`, `warped`, `labels`.
    pub images: Vec<(String, VoxelImage)>,
    /// Point sets by name, LPS mm: `source_points`, `target_points`.
    pub points: Vec<(String, Vec<DVec3>)>,
    /// Other arrays by name: `similarity` and `rejected` per pair of points, `rigid` (16 values, row-major 4 x 4).
    pub arrays: Vec<NamedArray>,
    /// Counts, times, quality.
    pub statistics: Statistics,
}

impl Output {
    /// The same output with the counts and the quality of its mesh among its statistics.
    ///
    /// # Errors
    /// [`crate::error::Error::Cancelled`].
    fn with_mesh_figures(mut self, context: &RunContext) -> Result<Self> {
        if let Some(mesh) = &self.mesh {
            self.statistics.set("mesh.points", mesh.points.len() as f64);
            self.statistics.set("mesh.elements", mesh.element_count() as f64);
            let begin = Instant::now();
            self.statistics.extend(&mesh_quality(mesh, context)?.statistics());
            self.statistics.set("time.quality_figures", begin.elapsed().as_secs_f64());
        }
        Ok(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parameters::find;

    #[test]
    fn numbers_and_kinds_agree() {
        for kind in JobKind::ALL {
            assert_eq!(JobKind::from_number(kind as i32).unwrap(), kind);
        }
        assert!(JobKind::from_number(0).is_err() && JobKind::from_number(4).is_err());
    }

    #[test]
    fn every_name_and_alias_finds_its_own_row() {
        for kind in JobKind::ALL {
            for (row, parameter) in kind.parameters().iter().enumerate() {
                assert_eq!(find(kind.parameters(), parameter.name).unwrap(), row, "{}", parameter.name);
                if let Some(alias) = parameter.alias {
                    assert_eq!(find(kind.parameters(), alias).unwrap(), row, "{alias}");
                }
                assert!(!parameter.doc.is_empty(), "{} has no documentation", parameter.name);
                if let Some(default) = parameter.default_value() {
                    assert!(parameter.check(default).is_ok(), "default of {} is out of range", parameter.name);
                }
            }
        }
    }
}
