//! Every option of the image-to-mesh engine: the one table, and the plain struct the engine reads.
//!
//! # Method
//! [`PARAMETERS`] lists name, the thesis's name, range, default and text; [`Options::from_parameters`] turns a checked
//! [`ParameterSet`] into [`Options`] once, at the engine's entry, and refuses combinations that make no sense.
//!
//! # Source
//! [Drakopoulos2017] appendix B.1.
//!
//! # Differences
//! Small disconnected regions of the image are removed only where the caller gives the threshold: a component is
//! never lost by default. The lattice spacing adapts to small images where it is not given. Merged elements have a scaled
//! Jacobian of at least 0.5, not 0.2: of three brains' vertices 36.4, 22.0 and 29.9 % are saved so, 37.1, 23.1 and 30.8 % with 0.2.
//!
//! # Invariants
//! Every row is read by the engine, by `pipeline::image_to_mesh`, or (groups `Files` and `Debugging`) by whoever
//! writes files.

use glam::DVec3;

use crate::error::{Error, Result};
use crate::parameters::{Default, Kind, Multiplicity, Parameter, ParameterSet, Table, Value, find};

const MESH_FILES: &[&str] = &[".vtu", ".vtk", ".msh", ".mesh"];
const IMAGE_FILES: &[&str] = &[".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd"];

const fn row(
    name: &'static str,
    alias: &'static str,
    kind: Kind,
    default: Default,
    unit: &'static str,
    group: &'static str,
    doc: &'static str,
) -> Parameter {
    let alias = if alias.is_empty() { None } else { Some(alias) };
    Parameter { name, alias, kind, default, unit, multiplicity: Multiplicity::Single, group, doc }
}

const fn times(mut parameter: Parameter, multiplicity: Multiplicity) -> Parameter {
    parameter.multiplicity = multiplicity;
    parameter
}

const fn real(min: f64, max: f64) -> Kind {
    Kind::Real { min, max, open_min: false }
}

const fn above(min: f64, max: f64) -> Kind {
    Kind::Real { min, max, open_min: true }
}

const COUNT: Kind = Kind::Integer { min: 0, max: i32::MAX as i64 };
const INF: f64 = f64::INFINITY;

/// The parameters of the image-to-mesh engine.
#[rustfmt::skip]
pub const PARAMETERS: Table = &[
    row("image", "", Kind::InputFile { extensions: IMAGE_FILES }, Default::Unset, "", "Files",
        "The segmented image: one whole number per voxel, 0 is background."),
    row("output", "", Kind::OutputFile { extensions: MESH_FILES }, Default::Unset, "", "Files",
        "The mesh that is written."),
    // --- image clean-up
    row("upsample-resolution", "upsampleResolution", Kind::Choice(&["none", "twofold", "fourfold"]), Default::Integer(0), "", "Image",
        "Up-samples the image along every axis before meshing, each voxel becomes 8 or 64 of the same label."),
    row("relabel-isolated-voxels", "relabelIsolatedVoxels", Kind::Choice(&["none", "background", "foreground", "both"]), Default::Integer(0), "", "Image",
        "Gives isolated voxels the commonest label around them: background voxels without a background neighbour, foreground voxels without a neighbour of their label, or both kinds."),
    row("check-image-topology", "checkImageTopology", Kind::Flag, Default::Flag(false), "", "Image",
        "Changes voxels until no two voxels of a label touch only along an edge or at a corner."),
    row("separate-disconnected-regions", "separateDisconnectedRegions", Kind::Flag, Default::Flag(false), "", "Image",
        "Treats each face-connected region of a label as a material of its own with its own fidelity; the mesh carries the caller's labels again."),
    row("relabel-image-regions-below", "thresholdToRelabelDisconnectedImageRegions", above(0.0, 0.01), Default::Unset, "fraction of the label", "Image",
        "Turns disconnected regions of a label into background when they hold less than this fraction of its voxels (0.001 is usual); nothing is removed when it is not given."),
    row("random-seed", "randomSeed", COUNT, Default::Integer(1), "", "Image",
        "Seed of the template choice of check-image-topology; the same seed gives the same mesh."),
    // --- lattice
    row("lattice-spacing", "latticeSpacing", above(0.0, INF), Default::Real(8.0), "mm", "Lattice",
        "Edge length of the coarsest lattice cubes, and so of the largest elements. Where it is not given it grows to two voxels where these are large, shrinks to a twelfth of the longest side of the image, and is moved by up to 41 % so that halving it leads to edges of two voxels."),
    times(row("fidelity", "", real(0.1, 1.0), Default::Real(0.8), "", "Lattice",
        "Smallest share of voxels on which mesh and image agree, for every label (F1 and F2); can be given per label. Higher means finer elements at the boundaries."), Multiplicity::PerLabel),
    row("multiple-fidelities", "", Kind::InputFile { extensions: &[".txt"] }, Default::Unset, "", "Lattice",
        "Text file with a label and its fidelity on each line."),
    times(row("max-element-size", "", above(0.0, INF), Default::Unset, "mm", "Lattice",
        "Largest edge length of elements; can be given per label."), Multiplicity::PerLabel),
    times(row("min-element-size", "", above(0.0, INF), Default::Unset, "mm", "Lattice",
        "Elements with edges up to twice this length are not refined further for fidelity; can be given per label. Labels and components are kept all the same."), Multiplicity::PerLabel),
    row("surface-tolerance", "", above(0.0, INF), Default::Real(0.8), "voxels", "Lattice",
        "Elements at boundaries are refined past the fidelity, down to edges of two voxels, where straight elements miss the boundary by more than this many voxels: thin walls, narrow gaps, strong curvature; down to edges of one voxel where smoothing could not reach single voxels. A large value leaves the fidelity alone to decide, and so does target-vertices where this is not given."),
    row("local-closure", "", Kind::Flag, Default::Flag(false), "", "Lattice",
        "Keeps refinement where it is asked for, with 2 to 8 times fewer elements away from boundaries; they meet at up to 120 instead of 117 degrees before smoothing. Otherwise refined places grow together to uniform regions, as in the thesis. With fewer elements a surface-tolerance of 0.25 follows smooth boundaries as closely as uniform regions do."),
    times(row("fixed-point", "", Kind::Text, Default::Unset, "mm", "Lattice",
        "A point X,Y,Z (LPS mm) that becomes a vertex of the mesh: an electrode, a landmark. Repeatable."), Multiplicity::Repeatable),
    row("target-vertices", "", COUNT, Default::Unset, "", "Lattice",
        "Chooses the lattice spacing so that the mesh has about this many vertices."),
    // --- mesh topology
    row("check-mesh-topology", "checkMeshTopology", Kind::Flag, Default::Flag(false), "", "Mesh topology",
        "Refines until the mesh of every label is manifold and has the pieces, tunnels and cavities of the image; needs check-image-topology."),
    row("relabel-mesh-regions-below", "thresholdToRelabelDisconnectedMeshRegions", above(0.0, 0.1), Default::Real(0.001), "fraction of the label", "Mesh topology",
        "With check-mesh-topology, disconnected mesh regions below this fraction of their label's volume take a neighbour's label, unless a component of the image would vanish."),
    times(row("duplicate-interface", "", Kind::Text, Default::Unset, "", "Mesh topology",
        "Two labels A,B whose shared surface gets separate vertices on each side, for contact; A,* for all neighbours of A. Repeatable."), Multiplicity::Repeatable),
    // --- elements
    row("mixed-elements", "hybridMesh", Kind::Flag, Default::Flag(false), "", "Elements",
        "Merges uniform tets into hexahedra, with pyramids where they meet tets."),
    row("max-surface-triangles-on-pyramid", "maxNumberSurfaceTrianglesOnPyramid", Kind::Integer { min: 0, max: 4 }, Default::Integer(0), "", "Elements",
        "How many triangles of a pyramid may lie on a surface or interface."),
    row("shape-functions", "shapeFunctionType", Kind::Choice(&["linear", "quadratic"]), Default::Integer(0), "", "Elements",
        "Linear elements, or quadratic tets with ten nodes."),
    // --- smoothing
    row("smoothing-iterations", "numIterations", COUNT, Default::Integer(5), "", "Smoothing",
        "Iterations of the physics-based smoothing of surfaces and interfaces, at most: where several labels meet that are no vessels, they end once one moves the surfaces by less than a tenth of a voxel in the mean; 0 returns the lattice as it is."),
    row("flexibility", "", real(0.1, 1.0), Default::Real(1.0), "", "Smoothing",
        "Trade-off between the elastic energy and the match to the image boundary; larger follows the image more."),
    times(row("youngs-modulus", "E", above(0.0, INF), Default::Real(0.0021), "N/mm^2", "Smoothing",
        "Young's modulus of the elastic model; can be given per label."), Multiplicity::PerLabel),
    times(row("poissons-ratio", "v", real(0.1, 0.49), Default::Real(0.45), "", "Smoothing",
        "Poisson's ratio of the elastic model; can be given per label."), Multiplicity::PerLabel),
    row("non-connectivity", "nonConnectivity", Kind::Choice(&["vertex", "edge", "face", "no"]), Default::Integer(0), "", "Smoothing",
        "Which neighbouring boundary voxels are left out as target points; vertex takes the fewest, no takes all."),
    row("min-dihedral-angle", "minDihedralAngle", above(0.0, 30.0), Default::Real(5.0), "degrees", "Smoothing",
        "Smallest dihedral angle of a tet that smoothing may leave."),
    row("min-scaled-jacobian", "minScaledJacobian", real(0.0, 1.0), Default::Real(0.5), "", "Smoothing",
        "Smallest scaled Jacobian of a hexahedron or pyramid that smoothing may leave; the thesis has 0.2."),
    row("search-radius-factor", "scaleFactorForSearchRadius", above(0.0, INF), Default::Real(1.5), "", "Smoothing",
        "Scales the neighbourhood in which target points are searched."),
    row("edge-length-factor", "scaleFactorForEdges", above(0.0, 5.0), Default::Real(0.2), "", "Smoothing",
        "Scales the mean length of a vertex's edges that bounds its search region."),
    row("confidence-factor", "scaleFactorForConfidence", above(0.0, 1.0), Default::Real(0.2), "", "Smoothing",
        "Scales the confidence of source points at elements of low quality."),
    row("max-confidence-iterations", "maxNumberScaledConfidenceIterations", COUNT, Default::Integer(3), "", "Smoothing",
        "How often the confidence is scaled in an iteration at most; it ends earlier where that helps little."),
    row("laplacian-iterations", "numberLaplacianSmoothingIterations", COUNT, Default::Integer(0), "", "Smoothing",
        "Iterations of quality-guarded Laplacian smoothing of the vertices."),
    row("local-transformations", "localTransformations", Kind::Flag, Default::Flag(true), "", "Smoothing",
        "Improves elements by local transformations after smoothing."),
    // --- evaluation
    row("evaluate-quality", "evaluateMeshQuality", Kind::Flag, Default::Flag(false), "", "Evaluation",
        "Adds the histogram of dihedral angles in steps of 5 degrees and the extremes of quality to the statistics."),
    row("evaluate-volume", "evaluateMeshVolume", Kind::Flag, Default::Flag(false), "", "Evaluation",
        "Adds the volume of each label against its voxels, and checks the sum of elements against the enclosed volume."),
    row("evaluate-fidelity", "evaluateMeshFidelity", Kind::Flag, Default::Flag(false), "", "Evaluation",
        "Adds the two-sided Hausdorff distance and the mean surface distance of each label."),
    // --- debugging
    row("output-bcc-surface", "outputSurfaceBCCMeshTriangles", Kind::OutputFile { extensions: &[".vtk", ".vtp"] }, Default::Unset, "", "Debugging",
        "Writes the surface triangles before smoothing."),
    row("output-bcc-mesh", "outputBCCMesh", Kind::OutputFile { extensions: &[".vtk", ".vtu"] }, Default::Unset, "", "Debugging",
        "Writes the mesh before smoothing."),
    row("output-source-points", "outputSourcePoints", Kind::OutputFile { extensions: &[".vtk", ".vtu"] }, Default::Unset, "", "Debugging",
        "Writes the mesh vertices that smoothing moves."),
    row("output-target-points", "outputTargetPoints1", Kind::OutputFile { extensions: &[".vtk", ".vtu"] }, Default::Unset, "", "Debugging",
        "Writes the image points that smoothing moves them to."),
    row("output-target-image", "outputTargetPoints2", Kind::OutputFile { extensions: IMAGE_FILES }, Default::Unset, "", "Debugging",
        "Writes an image that marks the voxels of the target points."),
    row("output-smooth-surface", "outputSurfaceSmoothMeshTriangles", Kind::OutputFile { extensions: &[".vtk", ".vtp"] }, Default::Unset, "", "Debugging",
        "Writes the surface triangles after smoothing."),
    row("output-smooth-mesh", "outputSmoothMesh", Kind::OutputFile { extensions: &[".vtk", ".vtu"] }, Default::Unset, "", "Debugging",
        "Writes the mesh after smoothing, before mid-edge nodes and duplicated vertices are added."),
    // --- limits
    row("max-elements", "", Kind::Integer { min: 1, max: 1 << 30 }, Default::Integer(400_000_000), "", "Limits",
        "Ends the run with an error when the lattice grows past this many elements."),
    row("time-limit", "", above(0.0, INF), Default::Unset, "s", "Limits",
        "Ends the run with an error when it takes longer."),
];

/// A value for all labels, with exceptions.
#[derive(Debug, Clone, PartialEq)]
pub struct PerLabel<T> {
    /// For labels without a value of their own.
    pub default: T,
    /// Caller's label and its value, sorted by label.
    pub values: Vec<(i64, T)>,
}

impl<T: Copy> PerLabel<T> {
    /// The value of a caller's label.
    pub fn of(&self, label: i32) -> T {
        self.values
            .binary_search_by_key(&i64::from(label), |(l, _)| *l)
            .map_or(self.default, |position| self.values[position].1)
    }
}

/// Which isolated voxels are relabelled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IsolatedVoxels {
    /// None.
    Keep,
    /// Background voxels whose 26 neighbours are all foreground.
    Background,
    /// Foreground voxels whose 26 neighbours all have another label.
    Foreground,
    /// Both kinds.
    Both,
}

/// Which neighbouring boundary voxels are left out as target points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NonConnectivity {
    /// Neighbours through a vertex (26).
    Vertex,
    /// Neighbours through an edge (18).
    Edge,
    /// Neighbours through a face (6).
    Face,
    /// None.
    No,
}

/// Order of the elements' shape functions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ShapeFunctions {
    /// Corner nodes only.
    Linear,
    /// Mid-edge nodes.
    Quadratic,
}

/// Two labels whose shared surface gets separate vertices; `None` stands for any label.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DuplicatedInterface {
    /// The label whose side keeps the original vertices.
    pub first: i64,
    /// The other side.
    pub second: Option<i64>,
}

/// What the engine does, as plain values.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Factor of up-sampling per axis: 1, 2 or 4.
    pub upsampling: usize,
    /// Which isolated voxels are relabelled.
    pub isolated_voxels: IsolatedVoxels,
    /// Whether vertex-only and edge-only voxel contacts are removed.
    pub check_image_topology: bool,
    /// Whether each region of a label has its own fidelity.
    pub separate_regions: bool,
    /// Fraction of a label below which its disconnected regions become background.
    pub image_region_threshold: Option<f64>,
    /// Seed of the template choice.
    pub seed: u64,
    /// Edge length of the coarsest cubes, mm; `None` adapts to the image.
    pub lattice_spacing: Option<f64>,
    /// Required F1 and F2.
    pub fidelity: PerLabel<f64>,
    /// Largest edge length, mm.
    pub max_element_size: PerLabel<Option<f64>>,
    /// Elements with edges up to twice this length are not refined for fidelity, mm.
    pub min_element_size: PerLabel<Option<f64>>,
    /// Largest distance of straight elements from a boundary before they are refined, in voxels (root mean square of the spacings).
    pub surface_tolerance: f64,
    /// Whether refinement is closed locally.
    pub local_closure: bool,
    /// Points that become vertices, LPS mm.
    pub fixed_points: Vec<DVec3>,
    /// Wanted number of vertices.
    pub target_vertices: Option<usize>,
    /// Whether sub-meshes are made manifold.
    pub check_mesh_topology: bool,
    /// Fraction of a label's volume below which disconnected mesh regions are relabelled.
    pub mesh_region_threshold: f64,
    /// Interfaces with separate vertices on each side.
    pub duplicated_interfaces: Vec<DuplicatedInterface>,
    /// Whether tets are merged into hexahedra.
    pub mixed_elements: bool,
    /// Most triangles of a pyramid on a surface.
    pub max_surface_triangles_on_pyramid: usize,
    /// Order of the elements.
    pub shape_functions: ShapeFunctions,
    /// Iterations of physics-based smoothing.
    pub smoothing_iterations: usize,
    /// Weight of the image boundary against the elastic energy.
    pub flexibility: f64,
    /// Young's modulus, N/mm^2.
    pub youngs_modulus: PerLabel<f64>,
    /// Poisson's ratio.
    pub poissons_ratio: PerLabel<f64>,
    /// Thinning of target points.
    pub non_connectivity: NonConnectivity,
    /// Smallest dihedral angle smoothing may leave, degrees.
    pub min_dihedral_angle: f64,
    /// Smallest scaled Jacobian smoothing may leave.
    pub min_scaled_jacobian: f64,
    /// Scale of the target search region.
    pub search_radius_factor: f64,
    /// Scale of the mean edge length that bounds the search region.
    pub edge_length_factor: f64,
    /// Scale of the confidence at bad elements.
    pub confidence_factor: f64,
    /// Tries with scaled confidence.
    pub max_confidence_iterations: usize,
    /// Iterations of Laplacian smoothing.
    pub laplacian_iterations: usize,
    /// Whether local transformations improve the mesh.
    pub local_transformations: bool,
    /// Whether quality figures go to the statistics.
    pub evaluate_quality: bool,
    /// Whether volumes go to the statistics.
    pub evaluate_volume: bool,
    /// Whether distances go to the statistics.
    pub evaluate_fidelity: bool,
    /// Whether the mesh before smoothing is handed back.
    pub keep_bcc_mesh: bool,
    /// Whether the surface before smoothing is handed back.
    pub keep_bcc_surface: bool,
    /// Whether the mesh after smoothing is handed back on its own.
    pub keep_smooth_mesh: bool,
    /// Whether the surface after smoothing is handed back.
    pub keep_smooth_surface: bool,
    /// Whether the source points are handed back.
    pub keep_source_points: bool,
    /// Whether the target points are handed back.
    pub keep_target_points: bool,
    /// Whether the image of target points is handed back.
    pub keep_target_image: bool,
    /// Most elements.
    pub max_elements: usize,
    /// Longest run, s.
    pub time_limit: Option<f64>,
}

impl Options {
    /// The options of a checked parameter set.
    ///
    /// # Errors
    /// [`Error::ParameterValue`] for text of the wrong form and for options that exclude one another.
    pub fn from_parameters(set: &ParameterSet) -> Result<Self> {
        let options = Self {
            upsampling: 1 << set.integer("upsample-resolution"),
            isolated_voxels: [
                IsolatedVoxels::Keep,
                IsolatedVoxels::Background,
                IsolatedVoxels::Foreground,
                IsolatedVoxels::Both,
            ][set.integer("relabel-isolated-voxels") as usize],
            check_image_topology: set.flag("check-image-topology"),
            separate_regions: set.flag("separate-disconnected-regions"),
            image_region_threshold: set.optional_real("relabel-image-regions-below"),
            seed: set.integer("random-seed") as u64,
            lattice_spacing: set.is_set("lattice-spacing").then(|| set.real("lattice-spacing")),
            fidelity: per_label(set, "fidelity"),
            max_element_size: optional_per_label(set, "max-element-size"),
            min_element_size: optional_per_label(set, "min-element-size"),
            local_closure: set.flag("local-closure"),
            surface_tolerance: match set.is_set("target-vertices") && !set.is_set("surface-tolerance") {
                true => f64::INFINITY,
                false => set.real("surface-tolerance"),
            },
            fixed_points: fixed_points(set)?,
            target_vertices: set.is_set("target-vertices").then(|| set.integer("target-vertices") as usize),
            check_mesh_topology: set.flag("check-mesh-topology"),
            mesh_region_threshold: set.real("relabel-mesh-regions-below"),
            duplicated_interfaces: duplicated_interfaces(set)?,
            mixed_elements: set.flag("mixed-elements"),
            max_surface_triangles_on_pyramid: set.integer("max-surface-triangles-on-pyramid") as usize,
            shape_functions: [ShapeFunctions::Linear, ShapeFunctions::Quadratic]
                [set.integer("shape-functions") as usize],
            smoothing_iterations: set.integer("smoothing-iterations") as usize,
            flexibility: set.real("flexibility"),
            youngs_modulus: per_label(set, "youngs-modulus"),
            poissons_ratio: per_label(set, "poissons-ratio"),
            non_connectivity: [
                NonConnectivity::Vertex,
                NonConnectivity::Edge,
                NonConnectivity::Face,
                NonConnectivity::No,
            ][set.integer("non-connectivity") as usize],
            min_dihedral_angle: set.real("min-dihedral-angle"),
            min_scaled_jacobian: set.real("min-scaled-jacobian"),
            search_radius_factor: set.real("search-radius-factor"),
            edge_length_factor: set.real("edge-length-factor"),
            confidence_factor: set.real("confidence-factor"),
            max_confidence_iterations: set.integer("max-confidence-iterations") as usize,
            laplacian_iterations: set.integer("laplacian-iterations") as usize,
            local_transformations: set.flag("local-transformations"),
            evaluate_quality: set.flag("evaluate-quality"),
            evaluate_volume: set.flag("evaluate-volume"),
            evaluate_fidelity: set.flag("evaluate-fidelity"),
            keep_bcc_mesh: set.is_set("output-bcc-mesh"),
            keep_bcc_surface: set.is_set("output-bcc-surface"),
            keep_smooth_mesh: set.is_set("output-smooth-mesh"),
            keep_smooth_surface: set.is_set("output-smooth-surface"),
            keep_source_points: set.is_set("output-source-points"),
            keep_target_points: set.is_set("output-target-points"),
            keep_target_image: set.is_set("output-target-image"),
            max_elements: set.integer("max-elements") as usize,
            time_limit: set.optional_real("time-limit"),
        };
        options.refuse_idle(set)?;
        options.check()
    }

    /// Refuses values that nothing would read; the default may be said.
    fn refuse_idle(&self, set: &ParameterSet) -> Result<()> {
        let needs = [
            ("relabel-mesh-regions-below", "check-mesh-topology", self.check_mesh_topology),
            ("max-surface-triangles-on-pyramid", "mixed-elements", self.mixed_elements),
        ];
        for (name, needed, is_on) in needs {
            let default = set.table()[find(set.table(), name)?].default_value();
            if !is_on && set.value(name) != default {
                return Err(Error::ParameterValue { name: name.into(), reason: format!("it needs {needed}") });
            }
        }
        Ok(())
    }

    fn check(self) -> Result<Self> {
        let refuse =
            |name: &str, reason: &str| Err(Error::ParameterValue { name: name.to_owned(), reason: reason.to_owned() });
        if self.check_mesh_topology && !self.check_image_topology {
            return refuse("check-mesh-topology", "it needs check-image-topology");
        }
        if self.mixed_elements && self.shape_functions == ShapeFunctions::Quadratic {
            return refuse("shape-functions", "quadratic elements exist for tets only, not with mixed-elements");
        }
        if self.target_vertices.is_some_and(|n| n < 4) {
            return refuse("target-vertices", "a mesh has at least 4 vertices");
        }
        if self.target_vertices.is_some() && self.lattice_spacing.is_some() {
            return refuse("target-vertices", "it chooses the lattice spacing, which is given too");
        }
        Ok(self)
    }
}

fn per_label(set: &ParameterSet, name: &str) -> PerLabel<f64> {
    PerLabel { default: set.real(name), values: label_reals(set, name) }
}

fn optional_per_label(set: &ParameterSet, name: &str) -> PerLabel<Option<f64>> {
    let values = label_reals(set, name).into_iter().map(|(label, v)| (label, Some(v))).collect();
    PerLabel { default: set.optional_real(name), values }
}

fn label_reals(set: &ParameterSet, name: &str) -> Vec<(i64, f64)> {
    let real = |value: &Value| match value {
        Value::Real(v) => *v,
        other => unreachable!("the table makes {name} a real: {other:?}"),
    };
    set.label_values(name).iter().map(|(label, value)| (*label, real(value))).collect()
}

fn fixed_points(set: &ParameterSet) -> Result<Vec<DVec3>> {
    let parse = |text: &str| -> Option<DVec3> {
        let numbers: Vec<f64> = text.split(',').map(|t| t.trim().parse().ok()).collect::<Option<_>>()?;
        let point = DVec3::from_array(numbers.try_into().ok()?);
        point.is_finite().then_some(point)
    };
    texts(set, "fixed-point", "X,Y,Z in mm", parse)
}

fn duplicated_interfaces(set: &ParameterSet) -> Result<Vec<DuplicatedInterface>> {
    let parse = |text: &str| -> Option<DuplicatedInterface> {
        let (first, second) = text.split_once(',')?;
        let second = match second.trim() {
            "*" => None,
            number => Some(number.parse().ok()?),
        };
        let first = first.trim().parse().ok()?;
        (second != Some(first)).then_some(DuplicatedInterface { first, second })
    };
    texts(set, "duplicate-interface", "A,B (two labels) or A,*", parse)
}

fn texts<T>(set: &ParameterSet, name: &str, form: &str, parse: impl Fn(&str) -> Option<T>) -> Result<Vec<T>> {
    let convert = |value: &Value| match value {
        Value::Text(text) => parse(text).ok_or_else(|| Error::ParameterValue {
            name: name.to_owned(),
            reason: format!("'{text}' is not of the form {form}"),
        }),
        other => unreachable!("the table makes {name} a text: {other:?}"),
    };
    set.values(name).iter().map(convert).collect()
}

/// Reads the text of a `multiple-fidelities` file: a label and its fidelity on each line, `#` starts a comment.
///
/// # Errors
/// [`Error::ParameterValue`] naming the line.
pub fn parse_fidelities(text: &str) -> Result<Vec<(i64, f64)>> {
    let mut values = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let line = line.split('#').next().unwrap_or("").trim();
        if line.is_empty() {
            continue;
        }
        let mut words = line.split([' ', '\t', ',', '=', ':']).filter(|w| !w.is_empty());
        match (words.next().and_then(|w| w.parse().ok()), words.next().and_then(|w| w.parse().ok()), words.next()) {
            (Some(label), Some(fidelity), None) => values.push((label, fidelity)),
            _ => {
                let reason = format!("line {} is not a label and a fidelity: '{line}'", number + 1);
                return Err(Error::ParameterValue { name: "multiple-fidelities".into(), reason });
            }
        }
    }
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_are_those_of_the_thesis() {
        let options = Options::from_parameters(&ParameterSet::new(PARAMETERS)).unwrap();
        assert_eq!((options.fidelity.of(3), options.poissons_ratio.of(1)), (0.8, 0.45));
        assert_eq!((options.min_dihedral_angle, options.search_radius_factor), (5.0, 1.5));
        assert!(options.lattice_spacing.is_none() && options.image_region_threshold.is_none());
    }

    #[test]
    fn excluded_combinations_and_bad_text_are_refused() {
        let refused = |pairs: &[(&str, &str)]| {
            let mut set = ParameterSet::new(PARAMETERS);
            pairs.iter().try_for_each(|(n, v)| set.set_text(n, v)).is_err() || Options::from_parameters(&set).is_err()
        };
        assert!(refused(&[("checkMeshTopology", "1")]));
        assert!(!refused(&[("checkMeshTopology", "1"), ("checkImageTopology", "1")]));
        assert!(refused(&[("v", "0.5")]));
        assert!(refused(&[("latticeSpacing", "0")]));
        assert!(refused(&[("fixed-point", "1,2")]));
        assert!(refused(&[("duplicate-interface", "1;2")]));
        assert!(!refused(&[("duplicate-interface", "1,*"), ("fixed-point", "1,2,-3.5")]));
        assert!(refused(&[("hybridMesh", "1"), ("shapeFunctionType", "quadratic")]));
        assert!(refused(&[("thresholdToRelabelDisconnectedImageRegions", "0.02")]));
    }

    #[test]
    fn values_that_nothing_would_read_are_refused_but_for_the_default() {
        let made = |pairs: &[(&str, &str)]| {
            let mut set = ParameterSet::new(PARAMETERS);
            pairs.iter().try_for_each(|(n, v)| set.set_text(n, v)).unwrap();
            Options::from_parameters(&set).map_err(|e| e.to_string())
        };
        let (regions, pyramids) = ("relabel-mesh-regions-below", "max-surface-triangles-on-pyramid");
        assert!(made(&[(regions, "0.01")]).unwrap_err().contains("it needs check-mesh-topology"));
        assert!(made(&[(pyramids, "2")]).unwrap_err().contains("it needs mixed-elements"));
        made(&[(regions, "0.001"), (pyramids, "0")]).unwrap();
        made(&[(regions, "0.01"), ("check-mesh-topology", "1"), ("check-image-topology", "1")]).unwrap();
        made(&[(pyramids, "2"), ("mixed-elements", "1")]).unwrap();
    }

    #[test]
    fn a_fidelity_file_is_read() {
        assert_eq!(parse_fidelities("1 0.9 # lumen\n\n2, 0.7\n").unwrap(), vec![(1, 0.9), (2, 0.7)]);
        assert!(parse_fidelities("1 x").is_err());
    }
}
