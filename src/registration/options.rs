//! Options of the registration, as plain values.
//!
//! # Method
//! [`Options::from_parameters`] turns a checked [`ParameterSet`] into structs, once, at the engine's entry; lists in text
//! form are parsed here.
//!
//! # Limits
//! The rows of the group `Files` and `num-threads` are for the command line; the engine gets data, not files.

use glam::{DMat4, DVec3};

use crate::error::{Error, Result};
use crate::parameters::{ParameterSet, Value};
use crate::sparse::solver::SolverKind;

pub use super::options_table::PARAMETERS;

/// Poisson ratio of a label that is given a Young modulus only: that of both thesis's materials.
const DEFAULT_POISSON_RATIO: f64 = 0.45;

/// Everything that steers a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// The rigid start.
    pub rigid: RigidOptions,
    /// Selection of blocks.
    pub features: FeatureOptions,
    /// Search of the best match of a block.
    pub matching: MatchingOptions,
    /// The mesh of the model.
    pub mesh: MeshOptions,
    /// Materials and solver.
    pub mechanics: MechanicsOptions,
    /// The loop and the resection.
    pub adaptive: AdaptiveOptions,
    /// Whether to evaluate by Canny edges.
    pub hausdorff_evaluation: bool,
}

/// Where the rigid search starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RigidStart {
    /// Coordinates as given.
    Scanner,
    /// Centres of mass put together.
    MassCenters,
    /// The better of both.
    Best,
}

/// Options of the rigid start.
#[derive(Debug, Clone, PartialEq)]
pub struct RigidOptions {
    /// Whether to search.
    pub search: bool,
    /// Transform from outside, fixed to moving.
    pub initial: Option<DMat4>,
    /// Start of the search where no transform is given.
    pub start: RigidStart,
    /// Histogram levels.
    pub histogram_bins: usize,
    /// Sampled fraction of the fixed voxels.
    pub sampling_fraction: f64,
    /// Most steps on each resolution.
    pub max_iterations: usize,
    /// Step length at the end, mm.
    pub min_step: f64,
    /// Resolutions.
    pub levels: usize,
}

/// Which neighbours of a selected block stay unselected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NonConnectivity {
    /// All 26.
    Vertex,
    /// The 18 that share an edge.
    Edge,
    /// The 6 that share a face.
    Face,
}

/// Options of the block selection.
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureOptions {
    /// Half size of a block per axis, voxels of the working grid.
    pub half_block: [usize; 3],
    /// Selected fraction of the blocks inside the mask.
    pub selection_fraction: f64,
    /// Pattern that keeps selected blocks apart.
    pub non_connectivity: NonConnectivity,
}

/// How two blocks are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SimilarityMetric {
    /// Normalised cross-correlation.
    CrossCorrelation,
    /// Normalised mutual information.
    MutualInformation,
}

/// In which scan blocks are selected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MatchingDirection {
    /// In the moving scan, as in the thesis.
    MovingToFixed,
    /// In the fixed scan.
    FixedToMoving,
    /// In both.
    Both,
}

/// Options of the block matching.
#[derive(Debug, Clone, PartialEq)]
pub struct MatchingOptions {
    /// Half size of the search window per axis, voxels of the working grid.
    pub half_window: [usize; 3],
    /// Similarity of blocks.
    pub metric: SimilarityMetric,
    /// Least similarity of a match.
    pub min_similarity: f64,
    /// Where blocks are selected.
    pub direction: MatchingDirection,
    /// The loop ends below this fraction of blocks without correspondence.
    pub zero_blocks_fraction: f64,
    /// Voxel size of the working grid, mm; `None` to choose it from the scans.
    pub working_spacing: Option<f64>,
    /// Gaussian that both scans are smoothed with, mm.
    pub noise_sigma: f64,
}

/// How the model is meshed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeshMethod {
    /// The lattice engine.
    Cbc3d,
    /// A Delaunay mesh of the image.
    Delaunay,
    /// Lattice decimation.
    LatticeDecimation,
    /// Structured hexahedra.
    StructuredHexahedra,
}

/// Options of the mesh.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshOptions {
    /// Which mesher.
    pub method: MeshMethod,
    /// Lattice spacing of CBC3D, mm.
    pub lattice_spacing: f64,
    /// Fidelity of CBC3D.
    pub fidelity: f64,
    /// Smoothing iterations of CBC3D.
    pub smoothing_iterations: usize,
    /// Fidelity of CBC3D per caller's label.
    pub label_fidelities: Vec<(i64, f64)>,
    /// Element size of the Delaunay mesh, mm.
    pub delaunay_delta: f64,
    /// Edge of the structured hexahedra, mm.
    pub hexahedron_size: f64,
    /// Counts of structured hexahedra per axis, where given.
    pub hexahedra: [Option<usize>; 3],
}

/// Shape functions of the elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ShapeFunctions {
    /// Linear.
    Linear,
    /// Linear, hexahedra with extra shape functions.
    LinearExtra,
    /// Quadratic.
    Quadratic,
    /// Quadratic, hexahedra with extra shape functions.
    QuadraticExtra,
}

/// Material of a label.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LabelMaterial {
    /// The caller's label.
    pub label: i64,
    /// Young modulus, N/mm^2.
    pub young_modulus: f64,
    /// Poisson ratio.
    pub poisson_ratio: f64,
}

/// Options of the mechanics.
#[derive(Debug, Clone, PartialEq)]
pub struct MechanicsOptions {
    /// Shape functions.
    pub shape_functions: ShapeFunctions,
    /// Weight of the measurements.
    pub trade_off: f64,
    /// Fraction of the blocks rejected over all approximation steps.
    pub rejection_fraction: f64,
    /// Approximation steps.
    pub approximation_steps: usize,
    /// Interpolation steps.
    pub interpolation_steps: usize,
    /// Solver.
    pub solver: SolverKind,
    /// Relative residual of an iterative solver.
    pub tolerance: f64,
    /// Most iterations of an iterative solver.
    pub max_iterations: usize,
    /// Materials, by increasing label; 1 and 2 always have one.
    pub materials: Vec<LabelMaterial>,
}

/// Whether tissue was resected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Resection {
    /// No.
    Off,
    /// Yes.
    On,
    /// To be found out.
    Auto,
}

/// Options of the adaptive loop.
#[derive(Debug, Clone, PartialEq)]
pub struct AdaptiveOptions {
    /// Off for plain PBNRR.
    pub enabled: bool,
    /// Most iterations.
    pub max_iterations: usize,
    /// Resection.
    pub resection: Resection,
    /// Young modulus of the resected region as a fraction of that of label 1.
    pub resected_stiffness: f64,
    /// Mean update of the field at which the loop ends, mm.
    pub min_update: f64,
    /// Smallest Jacobian determinant of the returned field.
    pub min_jacobian: f64,
    /// Distance over which the field becomes rigid outside of the tissue, mm.
    pub fade_distance: f64,
}

impl Options {
    /// The options of a parameter set of [`PARAMETERS`].
    ///
    /// # Errors
    /// [`Error::ParameterValue`] for a list that cannot be read.
    pub fn from_parameters(parameters: &ParameterSet) -> Result<Self> {
        Ok(Self {
            rigid: rigid_options(parameters)?,
            features: feature_options(parameters),
            matching: matching_options(parameters),
            mesh: mesh_options(parameters)?,
            mechanics: mechanics_options(parameters),
            adaptive: adaptive_options(parameters),
            hausdorff_evaluation: parameters.flag("hd-evaluation"),
        })
    }

    /// The material of a caller's label.
    pub fn material(&self, label: i64) -> Option<LabelMaterial> {
        self.mechanics.materials.iter().copied().find(|m| m.label == label)
    }
}

impl std::default::Default for Options {
    fn default() -> Self {
        Self::from_parameters(&ParameterSet::new(PARAMETERS)).expect("the defaults of the table are valid")
    }
}

fn size_of(parameters: &ParameterSet, name: &str) -> usize {
    // The table's ranges exclude negative values.
    parameters.integer(name) as usize
}

fn rigid_options(parameters: &ParameterSet) -> Result<RigidOptions> {
    let initial = parameters.text("initial-transform").map(|text| parse_transform(&text)).transpose()?;
    let asked_for = parameters.is_set("rigid-initialization");
    Ok(RigidOptions {
        search: parameters.integer("rigid-initialization") == 1 && (initial.is_none() || asked_for),
        initial,
        start: match parameters.integer("rigid-start") {
            0 => RigidStart::Scanner,
            1 => RigidStart::MassCenters,
            _ => RigidStart::Best,
        },
        histogram_bins: size_of(parameters, "rigid-histogram-bins"),
        sampling_fraction: parameters.real("rigid-sampling-fraction"),
        max_iterations: size_of(parameters, "rigid-max-iterations"),
        min_step: parameters.real("rigid-min-step"),
        levels: size_of(parameters, "rigid-levels"),
    })
}

fn feature_options(parameters: &ParameterSet) -> FeatureOptions {
    FeatureOptions {
        half_block: ["half-block-size-x", "half-block-size-y", "half-block-size-z"].map(|n| size_of(parameters, n)),
        selection_fraction: parameters.real("selection-fraction"),
        non_connectivity: match parameters.integer("non-connectivity") {
            0 => NonConnectivity::Vertex,
            1 => NonConnectivity::Edge,
            _ => NonConnectivity::Face,
        },
    }
}

fn matching_options(parameters: &ParameterSet) -> MatchingOptions {
    MatchingOptions {
        half_window: ["half-window-size-x", "half-window-size-y", "half-window-size-z"].map(|n| size_of(parameters, n)),
        metric: match parameters.integer("sim-metric") {
            0 => SimilarityMetric::CrossCorrelation,
            _ => SimilarityMetric::MutualInformation,
        },
        min_similarity: parameters.real("min-similarity"),
        direction: match parameters.integer("matching-direction") {
            0 => MatchingDirection::MovingToFixed,
            1 => MatchingDirection::FixedToMoving,
            _ => MatchingDirection::Both,
        },
        zero_blocks_fraction: parameters.real("zero-blocks-fraction"),
        working_spacing: parameters.optional_real("working-spacing"),
        noise_sigma: parameters.real("noise-sigma"),
    }
}

fn mesh_options(parameters: &ParameterSet) -> Result<MeshOptions> {
    let fidelities = parameters.text("cbc3d-multiple-fidelities").map(|text| parse_fidelities(&text)).transpose()?;
    let count = |name| match parameters.value(name) {
        Some(Value::Integer(n)) => Some(n as usize),
        _ => None,
    };
    Ok(MeshOptions {
        method: match parameters.integer("mesh-method") {
            0 => MeshMethod::Cbc3d,
            1 => MeshMethod::Delaunay,
            2 => MeshMethod::LatticeDecimation,
            _ => MeshMethod::StructuredHexahedra,
        },
        lattice_spacing: parameters.real("cbc3d-spacing"),
        fidelity: parameters.real("cbc3d-fidelity"),
        smoothing_iterations: size_of(parameters, "cbc3d-num-iterations"),
        label_fidelities: fidelities.unwrap_or_default(),
        delaunay_delta: parameters.real("delaunay-delta"),
        hexahedron_size: parameters.real("hexahedron-size"),
        hexahedra: ["hexahedra-x", "hexahedra-y", "hexahedra-z"].map(count),
    })
}

fn mechanics_options(parameters: &ParameterSet) -> MechanicsOptions {
    MechanicsOptions {
        shape_functions: match parameters.integer("shape-function-type") {
            0 => ShapeFunctions::Linear,
            1 => ShapeFunctions::LinearExtra,
            2 => ShapeFunctions::Quadratic,
            _ => ShapeFunctions::QuadraticExtra,
        },
        trade_off: parameters.real("trade-off"),
        rejection_fraction: parameters.real("rejection-fraction"),
        approximation_steps: size_of(parameters, "num-approx-steps"),
        interpolation_steps: size_of(parameters, "num-inter-steps"),
        solver: match parameters.integer("solver") {
            0 => SolverKind::IncompleteCholeskyCg,
            1 => SolverKind::BlockJacobiCg,
            2 => SolverKind::JacobiCg,
            3 => SolverKind::BiCgStab,
            4 => SolverKind::Lsqr,
            _ => SolverKind::Direct,
        },
        tolerance: parameters.real("solver-tolerance"),
        max_iterations: size_of(parameters, "solver-max-iterations"),
        materials: materials(parameters),
    }
}

fn materials(parameters: &ParameterSet) -> Vec<LabelMaterial> {
    let of = |label, e, v| LabelMaterial { label, young_modulus: e, poisson_ratio: v };
    let mut materials =
        vec![of(1, parameters.real("e1"), parameters.real("v1")), of(2, parameters.real("e2"), parameters.real("v2"))];
    let reals = |name| {
        parameters.label_values(name).iter().filter_map(|(label, value)| match value {
            Value::Real(v) => Some((*label, *v)),
            _ => None,
        })
    };
    for (label, young) in reals("young-modulus") {
        match materials.iter_mut().find(|m| m.label == label) {
            Some(material) => material.young_modulus = young,
            None => materials.push(of(label, young, DEFAULT_POISSON_RATIO)),
        }
    }
    for (label, poisson) in reals("poisson-ratio") {
        if let Some(material) = materials.iter_mut().find(|m| m.label == label) {
            material.poisson_ratio = poisson;
        }
    }
    materials.sort_by_key(|m| m.label);
    materials
}

fn adaptive_options(parameters: &ParameterSet) -> AdaptiveOptions {
    AdaptiveOptions {
        enabled: parameters.flag("adaptive"),
        max_iterations: size_of(parameters, "num-adaptive-iterations"),
        resection: match parameters.integer("tumor-resection") {
            0 => Resection::Off,
            1 => Resection::On,
            _ => Resection::Auto,
        },
        resected_stiffness: parameters.real("resected-stiffness"),
        min_update: parameters.real("min-update"),
        min_jacobian: parameters.real("min-jacobian"),
        fade_distance: parameters.real("fade-distance"),
    }
}

/// A matrix of 12 or 16 numbers, row-major, separated by commas or blanks.
fn parse_transform(text: &str) -> Result<DMat4> {
    let refuse = |reason: String| Error::ParameterValue { name: "initial-transform".into(), reason };
    let numbers: Vec<f64> = text
        .split(|c: char| c == ',' || c == ';' || c.is_whitespace())
        .filter(|word| !word.is_empty())
        .map(|word| word.parse().map_err(|_| refuse(format!("'{word}' is not a number"))))
        .collect::<Result<_>>()?;
    let last = [0.0, 0.0, 0.0, 1.0];
    let rows: Vec<f64> = match numbers.len() {
        12 => numbers.into_iter().chain(last).collect(),
        16 => numbers,
        n => return Err(refuse(format!("{n} numbers, a matrix has 12 or 16"))),
    };
    let matrix = DMat4::from_cols_slice(&rows).transpose();
    check_rigid(&matrix).map_err(refuse)?;
    Ok(matrix)
}

/// Whether a matrix is a rigid transform; else why not.
pub(crate) fn check_rigid(matrix: &DMat4) -> std::result::Result<(), String> {
    // A rotation printed with five digits is orthonormal to this.
    const TOLERANCE: f64 = 1e-3;
    let linear = glam::DMat3::from_mat4(*matrix);
    let defect = linear * linear.transpose() - glam::DMat3::IDENTITY;
    if !matrix.is_finite() {
        return Err("the matrix is not finite".into());
    }
    if matrix.row(3) != glam::DVec4::W {
        return Err("the last row is not 0 0 0 1".into());
    }
    if defect.to_cols_array().iter().any(|v| v.abs() > TOLERANCE) || linear.determinant() < 0.0 {
        return Err("the matrix is not a rotation and a translation".into());
    }
    Ok(())
}

fn parse_fidelities(text: &str) -> Result<Vec<(i64, f64)>> {
    let refuse = |word: &str| Error::ParameterValue {
        name: "cbc3d-multiple-fidelities".into(),
        reason: format!("'{word}' is not label=value with a value in [0.1, 1]"),
    };
    text.split([',', ';', ' '])
        .filter(|word| !word.is_empty())
        .map(|word| {
            let (label, value) = word.split_once(['=', ':']).ok_or_else(|| refuse(word))?;
            let label = label.trim().parse::<i64>().map_err(|_| refuse(word))?;
            let value = value.trim().parse::<f64>().map_err(|_| refuse(word))?;
            if (0.1..=1.0).contains(&value) { Ok((label, value)) } else { Err(refuse(word)) }
        })
        .collect()
}

/// The point that a rigid matrix maps `point` to.
#[inline]
pub(crate) fn apply(matrix: &DMat4, point: DVec3) -> DVec3 {
    matrix.transform_point3(point)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parameters(values: &[(&str, &str)]) -> ParameterSet {
        let mut set = ParameterSet::new(PARAMETERS);
        for (name, value) in values {
            set.set_text(name, value).unwrap();
        }
        set
    }

    #[test]
    fn the_names_of_the_thesis_are_understood() {
        let set = parameters(&[
            ("halfBlockSizeX", "1"),
            ("simMetric", "1"),
            ("nonConnectivity", "2"),
            ("meshMethod", "0"),
            ("E2", "0.0042"),
            ("v2", "0.4"),
            ("CBC3DMultipleFidelities", "1=0.8,2=0.95"),
            ("numAdaptiveIterations", "1"),
        ]);
        let options = Options::from_parameters(&set).unwrap();
        assert_eq!(options.features.half_block, [1, 2, 2]);
        assert_eq!(options.matching.metric, SimilarityMetric::MutualInformation);
        assert_eq!(options.features.non_connectivity, NonConnectivity::Face);
        assert_eq!(options.mesh.method, MeshMethod::Cbc3d);
        assert_eq!(options.mesh.label_fidelities, [(1, 0.8), (2, 0.95)]);
        assert_eq!(options.material(2).unwrap().young_modulus, 0.0042);
    }

    #[test]
    fn labels_get_their_own_material() {
        let mut set = parameters(&[]);
        set.set_for_label("young-modulus", 7, Value::Real(0.06)).unwrap();
        let options = Options::from_parameters(&set).unwrap();
        assert_eq!(options.material(7).unwrap().poisson_ratio, DEFAULT_POISSON_RATIO);
        assert!(options.material(3).is_none());
    }

    #[test]
    fn transforms_that_are_not_rigid_are_refused() {
        let read = |text| Options::from_parameters(&parameters(&[("initial-transform", text)]));
        let options = read("1 0 0 5, 0 1 0 6, 0 0 1 7").unwrap();
        assert!(!options.rigid.search);
        assert_eq!(apply(&options.rigid.initial.unwrap(), DVec3::ZERO), DVec3::new(5.0, 6.0, 7.0));
        for bad in ["1 0 0", "2 0 0 0 0 1 0 0 0 0 1 0", "-1 0 0 0 0 1 0 0 0 0 1 0", "1 0 0 x 0 1 0 0 0 0 1 0"] {
            assert!(read(bad).is_err(), "{bad}");
        }
    }
}
