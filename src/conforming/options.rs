//! Options of the surface engine: the one parameter table, and the plain struct the steps read.
//!
//! # Method
//! [`PARAMETERS`] describes every option of [Drakopoulos2017] appendix B.3 under a descriptive name with the thesis's
//! name as alias, and ours. [`Options::from_parameters`] turns a checked [`ParameterSet`] into the struct, once.
//!
//! # Differences
//! Files (`plc`, `output`, `background`) stand in the table for the command line and Slicer; the engine
//! does not read them. The thesis's page names no default for `angqmax`; ours is 150 degrees. Options in [`FIXED`] are
//! in the table so that scripts that pass their defaults run; other values are refused, since they would do nothing.

use glam::DVec3;

use crate::error::{Error, Result};
use crate::mesh::sizing::{SizeSource, SourceShape};
use crate::mesh::surface_mesh::{PatchRole, RegionSeed};
use crate::parameters::{Default, Kind, Multiplicity, Parameter, ParameterSet, Table, Value};

const SURFACE_FILES: &[&str] = &[".stl", ".off", ".obj", ".ply", ".vtk", ".vtp", ".mesh", ".surf", ".poly", ".smesh"];
const MESH_FILES: &[&str] =
    &[".vtu", ".vtk", ".msh", ".mesh", ".ugrid", ".b8.ugrid", ".lb8.ugrid", ".su2", ".foam", ".meshb"];

const fn row(
    names: (&'static str, Option<&'static str>),
    kind: Kind,
    default: Default,
    unit: &'static str,
    group: &'static str,
    doc: &'static str,
) -> Parameter {
    Parameter { name: names.0, alias: names.1, kind, default, unit, multiplicity: Multiplicity::Single, group, doc }
}

const fn list(name: &'static str, group: &'static str, doc: &'static str) -> Parameter {
    let (kind, default) = (Kind::Text, Default::Unset);
    Parameter { name, alias: None, kind, default, unit: "", multiplicity: Multiplicity::Repeatable, group, doc }
}

const fn angle(
    name: &'static str,
    alias: &'static str,
    range: (f64, f64),
    default: f64,
    group: &'static str,
    doc: &'static str,
) -> Parameter {
    let kind = Kind::Real { min: range.0, max: range.1, open_min: false };
    row((name, Some(alias)), kind, Default::Real(default), "degrees", group, doc)
}

const fn real(
    name: &'static str,
    alias: &'static str,
    range: (f64, f64),
    default: f64,
    group: &'static str,
    doc: &'static str,
) -> Parameter {
    let kind = Kind::Real { min: range.0, max: range.1, open_min: false };
    row((name, Some(alias)), kind, Default::Real(default), "", group, doc)
}

const fn whole(
    name: &'static str,
    alias: &'static str,
    range: (i64, i64),
    default: i64,
    group: &'static str,
    doc: &'static str,
) -> Parameter {
    let kind = Kind::Integer { min: range.0, max: range.1 };
    row((name, Some(alias)), kind, Default::Integer(default), "", group, doc)
}

const fn flag(
    name: &'static str,
    alias: &'static str,
    default: bool,
    group: &'static str,
    doc: &'static str,
) -> Parameter {
    row((name, Some(alias)), Kind::Flag, Default::Flag(default), "", group, doc)
}

/// Growth of sizes around a source: that of the default growth rate, 1.1.
const DEFAULT_DECAY: f64 = 0.1;

const INF: f64 = f64::INFINITY;
const FILES: &str = "Files";
const DOMAIN: &str = "Domain";
const DELAUNAY: &str = "Delaunay tetrahedralization";
const RECOVERY: &str = "Boundary recovery";
const SIZING: &str = "Sizing";
const REFINE: &str = "Refinement";
const RECONNECT: &str = "Local reconnection";
const QUALITY: &str = "Quality improvement";
const PARALLEL: &str = "Parallel";
const LIMITS: &str = "Limits";

/// Every option of the surface engine.
pub const PARAMETERS: Table = &[
    row(
        ("plc", None),
        Kind::InputFile { extensions: SURFACE_FILES },
        Default::Unset,
        "",
        FILES,
        "Surface triangulation or piecewise linear complex to mesh.",
    ),
    row(
        ("output", Some("outmesh")),
        Kind::OutputFile { extensions: MESH_FILES },
        Default::Unset,
        "",
        FILES,
        "Tetrahedral mesh to write; the extension chooses the format.",
    ),
    row(
        ("background", None),
        Kind::InputFile { extensions: MESH_FILES },
        Default::Unset,
        "",
        FILES,
        "Background mesh whose point array 'size' gives the edge lengths wanted.",
    ),
    // Domain.
    row(
        ("domain", None),
        Kind::Choice(&["regions", "nesting"]),
        Default::Integer(0),
        "",
        DOMAIN,
        "Which bounded regions are meshed: 'regions' every one, each with its own label; 'nesting' leaves every second \
         nesting level empty (an aircraft in its far field).",
    ),
    list("hole", DOMAIN, "X,Y,Z: a point in a cavity that stays empty. May be given several times."),
    list(
        "region",
        DOMAIN,
        "X,Y,Z,LABEL[,SIZE]: the region around the point gets the label, and no edge longer than SIZE. May be given \
         several times.",
    ),
    list(
        "patch-role",
        DOMAIN,
        "PATCH=ROLE: what a patch of the surface is for: wall, wall_bl, symmetry, farfield, embedded, source, internal, \
         fixed, inlet or outlet. May be given several times.",
    ),
    // Delaunay.
    whole(
        "sort-points",
        "sort",
        (0, 2),
        2,
        DELAUNAY,
        "Order in which boundary points are inserted: 0 as given, 1 random permutation, 2 BRIO rounds along a Hilbert \
         curve.",
    ),
    whole(
        "location-mode",
        "loc",
        (0, 1),
        0,
        DELAUNAY,
        "Point location: 0 exact; 1 a new field point within the location tolerance of an edge or face is inserted on it.",
    ),
    real(
        "location-tolerance",
        "loctol",
        (0.0, 0.001),
        1e-5,
        DELAUNAY,
        "Tolerance of location mode 1, relative to the element's size.",
    ),
    // Boundary recovery.
    whole(
        "boundary-recovery",
        "brec",
        (0, 2),
        2,
        RECOVERY,
        "0 none: the Delaunay mesh of the points; 1 partitions only: added points stay on the surface; 2 full: the surface \
         is kept exactly.",
    ),
    angle(
        "discontinuity-angle",
        "angrbfdd",
        (120.0, 179.9),
        150.0,
        RECOVERY,
        "With boundary sliver deletion: surface triangles are not reconnected where the dihedral angle of the result \
         would be less.",
    ),
    angle(
        "surface-angle-limit",
        "angrbfmxp",
        (60.0, 179.9),
        140.0,
        RECOVERY,
        "With boundary sliver deletion: surface triangles are not reconnected where their largest angle would grow \
         beyond this.",
    ),
    whole(
        "recursion-depth",
        "depth",
        (1, 20),
        5,
        RECOVERY,
        "Depth at which the recursion of edge removals starts; it grows with need.",
    ),
    whole(
        "edge-removal-limit",
        "nmax",
        (3, 30),
        10,
        RECOVERY,
        "Most elements around an edge that one removal handles at the start; it grows with need.",
    ),
    row(
        ("touch-tolerance", None),
        Kind::Real { min: 0.0, max: 0.01, open_min: false },
        Default::Real(1e-10),
        "",
        RECOVERY,
        "Points closer than this times the diagonal of the surface are reported as almost touching.",
    ),
    // Sizing.
    real(
        "size-factor",
        "cdf",
        (0.5, 3.0),
        1.2,
        SIZING,
        "Multiplier of the distribution function, which is the average of the surrounding boundary edge lengths.",
    ),
    real(
        "size-minimum-weight",
        "cdfm",
        (0.0, 1.0),
        0.0,
        SIZING,
        "Weight of the nearby minimum in the size of a new point; above 0 the elements grow more slowly.",
    ),
    real(
        "growth-rate",
        "cdfr",
        (1.0, 3.0),
        1.1,
        SIZING,
        "Largest ratio of the size of a new point to the local front it is advanced from.",
    ),
    real(
        "size-limit",
        "dfmax",
        (-1.0, 1e19),
        -1.0,
        SIZING,
        "Largest size: below 0 no limit, 0 the largest of the boundary, above 0 this length.",
    ),
    list(
        "size-source",
        SIZING,
        "point:X,Y,Z,SIZE | line:X,Y,Z,X,Y,Z,SIZE | box:X,Y,Z,X,Y,Z,SIZE | sphere:X,Y,Z,RADIUS,SIZE, each with ,DECAY \
         behind where wanted: edges there are no longer than SIZE + DECAY * distance (DECAY 0.1 where not given). May be \
         given several times.",
    ),
    // Refinement.
    flag("refine", "ref", true, REFINE, "Insert points in the volume; off returns the boundary-conforming mesh."),
    real(
        "near-point-factor",
        "cdfn",
        (0.5, 2.0),
        0.7,
        REFINE,
        "Two points are too close below this times the average of their sizes.",
    ),
    real(
        "edge-satisfied-factor",
        "cdff",
        (1.1, 3.0),
        1.5,
        REFINE,
        "An edge is long enough below this times the average size of its ends.",
    ),
    angle(
        "satisfied-angle",
        "angmax",
        (120.0, 179.9),
        150.0,
        REFINE,
        "An element is satisfied with a smaller largest dihedral angle and satisfied edges.",
    ),
    whole("normal-mode", "pivot", (0, 1), 1, REFINE, "Face normals: 0 as numbered, 1 from the two shortest edges."),
    whole(
        "minimum-points",
        "nminpts",
        (0, 1000),
        1,
        REFINE,
        "Refinement has converged when a pass inserts fewer points than this.",
    ),
    flag("count-slivers", "sliv", false, REFINE, "Count the slivers after refinement, before quality improvement."),
    whole("maximum-passes", "ngen", (0, 1_000_000), 10_000, REFINE, "Most passes of point creation."),
    // Reconnection.
    whole(
        "reconnection-criterion",
        "mrecm",
        (1, 3),
        2,
        RECONNECT,
        "1 Delaunay; 2 Delaunay, then min-max Laplacian edge weight; 3 Delaunay, then min-max skew.",
    ),
    flag("repeat-reconnection", "mrecm2", false, RECONNECT, "Repeat the traversal of a pass until nothing changes."),
    whole(
        "quality-reconnection-criterion",
        "mrecqm",
        (2, 3),
        2,
        RECONNECT,
        "Criterion of all quality passes but the last: 2 edge weight, 3 skew.",
    ),
    whole(
        "final-reconnection-criterion",
        "mrecqmf",
        (2, 3),
        2,
        RECONNECT,
        "Criterion of the last quality pass: 2 edge weight, 3 skew.",
    ),
    flag("flip-44", "mrec4", false, RECONNECT, "4-4 flips also during refinement, not only in the last quality pass."),
    flag(
        "flip-44-quality",
        "mrec4q",
        true,
        RECONNECT,
        "4-4 flips try both other diagonals and keep the better; off takes the first that improves (in the last quality \
         pass; with flip-44 everywhere).",
    ),
    angle(
        "low-quality-surface-angle",
        "angqbfm",
        (0.0, 180.0),
        160.0,
        RECONNECT,
        "A surface with a larger angle in a triangle switches flip-44 on.",
    ),
    // Quality.
    whole("quality-passes", "nqual", (0, 10), 2, QUALITY, "Passes of quality improvement; 0 skips all of it."),
    whole("quality-repeats", "nqualf", (0, 10), 1, QUALITY, "Repeats while elements above the repeat angle remain."),
    angle(
        "repeat-angle",
        "angqmax",
        (90.0, 179.9),
        150.0,
        QUALITY,
        "Quality improvement is repeated while elements with a larger dihedral angle exist.",
    ),
    angle(
        "mask-angle",
        "angqmsk",
        (90.0, 179.9),
        120.0,
        QUALITY,
        "Special operations act on elements with a larger angle.",
    ),
    angle(
        "quality-angle",
        "angqual",
        (70.0, 179.9),
        120.0,
        QUALITY,
        "Reconnection acts on elements with a larger angle.",
    ),
    whole("smoothing-iterations", "nsmth", (0, 10), 3, QUALITY, "Iterations of smoothing in each quality pass."),
    real(
        "smoothing-coefficient",
        "csmth",
        (0.0, 1.0),
        0.5,
        QUALITY,
        "Share of the way to the target that a point moves.",
    ),
    real(
        "boundary-smoothing-factor",
        "vsmthb",
        (0.0, 1.0),
        0.5,
        QUALITY,
        "Reduction of the smoothing coefficient beside the boundary.",
    ),
    whole(
        "smoothing-mode",
        "msmth",
        (1, 2),
        1,
        QUALITY,
        "1 optimal placement first, 2 average of centroids first; the other where the first gives an invalid mesh.",
    ),
    flag(
        "smart-smoothing",
        "smartsmth",
        true,
        QUALITY,
        "Accept a move only where the worst element around gets no worse.",
    ),
    flag("delete-field-slivers", "mdfs", true, QUALITY, "Remove slivers of the field by inserting points."),
    whole("field-sliver-repeats", "ndfs", (0, 100), 10, QUALITY, "Most repeats of field sliver deletion."),
    angle(
        "field-sliver-angle",
        "angdfs",
        (120.0, 179.9),
        165.0,
        QUALITY,
        "Field elements with a larger angle are slivers.",
    ),
    flag(
        "delete-boundary-slivers",
        "mdbs",
        false,
        QUALITY,
        "Delete slivers at the boundary and reconnect the surface there: the one option that changes the surface's \
         triangles (never its points).",
    ),
    whole("boundary-sliver-repeats", "ndbs", (0, 100), 5, QUALITY, "Most repeats of boundary sliver deletion."),
    angle(
        "boundary-sliver-angle",
        "angdbs",
        (120.0, 179.9),
        160.0,
        QUALITY,
        "With boundary sliver deletion: boundary elements with a larger angle are slivers.",
    ),
    flag("delete-small-edges", "mdse", true, QUALITY, "Collapse edges much shorter than the size wanted."),
    real("small-edge-factor", "cdse", (0.0, 0.7), 0.25, QUALITY, "Edges shorter than this times the size are small."),
    flag("quality-statistics", "qstat", false, QUALITY, "Add quality histograms of every pass to the statistics."),
    // Parallel.
    row(
        ("refinement-threads", Some("nthreads")),
        Kind::Integer { min: 0, max: 1024 },
        Default::Integer(0),
        "",
        PARALLEL,
        "Threads of refinement; 0 those of the run.",
    ),
    row(
        ("quality-threads", Some("nthreadsq")),
        Kind::Integer { min: 0, max: 1024 },
        Default::Integer(0),
        "",
        PARALLEL,
        "Threads of quality improvement; 0 those of refinement.",
    ),
    whole("buckets", "nbuckets", (0, 1 << 30), 0, PARALLEL, "Work items of a parallel refinement pass; 0 chooses."),
    whole(
        "quality-buckets",
        "nbucketsq",
        (0, 1 << 30),
        0,
        PARALLEL,
        "Work items of a parallel quality pass; 0 chooses.",
    ),
    real(
        "transfer-fraction",
        "frbtransf",
        (0.0, 1.0),
        0.3,
        PARALLEL,
        "Share of its buckets a thread hands over at once.",
    ),
    row(
        ("transfer-reduction", Some("cbtransf")),
        Kind::Real { min: 0.0, max: 1.0, open_min: true },
        Default::Real(1.0),
        "",
        PARALLEL,
        "Factor on the handed over share between the same pair of threads.",
    ),
    real(
        "quality-transfer-fraction",
        "frbtransfq",
        (0.0, 1.0),
        0.3,
        PARALLEL,
        "Share of its buckets a thread hands over in quality passes.",
    ),
    row(
        ("quality-transfer-reduction", Some("cbtransfq")),
        Kind::Real { min: 0.0, max: 1.0, open_min: true },
        Default::Real(1.0),
        "",
        PARALLEL,
        "Factor on the handed over share in quality passes.",
    ),
    flag("group-active", "ordt", true, PARALLEL, "Keep active elements together instead of spread over the list."),
    flag("sort-new-points", "sortp", true, PARALLEL, "Sort the new points of a pass along a Hilbert curve."),
    flag(
        "group-active-quality",
        "ordtq",
        true,
        PARALLEL,
        "As group-active, in quality passes: on, worst elements first; off, in the order of storage among all others.",
    ),
    flag("sort-quality", "sortpq", false, PARALLEL, "Sort the elements of a quality pass along a Hilbert curve."),
    flag(
        "pin-threads",
        "pint",
        false,
        PARALLEL,
        "Bind each worker to one core while refinement and quality improvement run (Linux).",
    ),
    whole(
        "reserved-elements",
        "blockmul",
        (1, 10_000_000_000),
        1_000_000,
        PARALLEL,
        "Elements whose memory is reserved at once before refinement; no more than predicted.",
    ),
    // Limits.
    row(
        ("maximum-stack", Some("maxStack")),
        Kind::Integer { min: 0, max: 65_536 },
        Default::Integer(0),
        "MB",
        LIMITS,
        "Most memory for the stacks of work of boundary recovery; 0 no limit. Only the default is supported.",
    ),
    row(
        ("maximum-elements", None),
        Kind::Integer { min: 0, max: 1 << 30 },
        Default::Integer(0),
        "",
        LIMITS,
        "Refuse or stop above this many elements; 0 only the capacity limits.",
    ),
    row(
        ("maximum-memory", None),
        Kind::Real { min: 0.0, max: INF, open_min: false },
        Default::Real(0.0),
        "MB",
        LIMITS,
        "Refuse or stop where the mesh would need more memory; 0 no limit.",
    ),
];

/// Options that only their default has an effect for: [`Options::from_parameters`] refuses other values.
pub const FIXED: &[&str] = &["maximum-stack"];

/// Which bounded regions are meshed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DomainRule {
    /// Every bounded region, but those with a hole point.
    #[default]
    Regions,
    /// Nesting levels 1, 3, 5, ... counted from outside.
    Nesting,
}

/// How much of boundary recovery is done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum RecoveryMode {
    /// None: Delaunay tetrahedralization of the points.
    Off,
    /// Added points may stay on the surface.
    Partitions,
    /// The surface is kept exactly.
    #[default]
    Full,
}

/// Values of every parameter, as the steps read them. Field docs are the table's.
#[derive(Debug, Clone, PartialEq)]
#[allow(missing_docs, reason = "each field is one row of PARAMETERS, where its text stands")]
pub struct Options {
    pub domain: DomainRule,
    pub holes: Vec<DVec3>,
    pub regions: Vec<RegionSeed>,
    pub patch_roles: Vec<(i32, String)>,
    pub sort_points: u8,
    pub snap_location: bool,
    pub location_tolerance: f64,
    pub boundary_recovery: RecoveryMode,
    pub recursion_depth: usize,
    pub edge_removal_limit: usize,
    pub touch_tolerance: f64,
    pub size_factor: f64,
    pub size_minimum_weight: f64,
    pub growth_rate: f64,
    pub size_limit: f64,
    pub size_sources: Vec<SizeSource>,
    pub refine: bool,
    pub near_point_factor: f64,
    pub edge_satisfied_factor: f64,
    pub satisfied_angle: f64,
    pub accurate_normals: bool,
    pub minimum_points: usize,
    pub count_slivers: bool,
    pub maximum_passes: usize,
    pub reconnection_criterion: u8,
    pub repeat_reconnection: bool,
    pub quality_reconnection_criterion: u8,
    pub final_reconnection_criterion: u8,
    pub flip_44: bool,
    pub flip_44_quality: bool,
    pub low_quality_surface_angle: f64,
    pub quality_passes: usize,
    pub quality_repeats: usize,
    pub repeat_angle: f64,
    pub mask_angle: f64,
    pub quality_angle: f64,
    pub smoothing_iterations: usize,
    pub smoothing_coefficient: f64,
    pub boundary_smoothing_factor: f64,
    pub smoothing_mode: u8,
    pub smart_smoothing: bool,
    pub delete_field_slivers: bool,
    pub field_sliver_repeats: usize,
    pub field_sliver_angle: f64,
    pub delete_boundary_slivers: bool,
    pub boundary_sliver_repeats: usize,
    pub boundary_sliver_angle: f64,
    pub discontinuity_angle: f64,
    pub surface_angle_limit: f64,
    pub delete_small_edges: bool,
    pub small_edge_factor: f64,
    pub quality_statistics: bool,
    pub refinement_threads: usize,
    pub quality_threads: usize,
    pub buckets: usize,
    pub quality_buckets: usize,
    pub transfer_fraction: f64,
    pub transfer_reduction: f64,
    pub quality_transfer_fraction: f64,
    pub quality_transfer_reduction: f64,
    pub group_active: bool,
    pub group_active_quality: bool,
    pub pin_threads: bool,
    pub sort_new_points: bool,
    pub sort_quality: bool,
    pub reserved_elements: usize,
    pub maximum_elements: usize,
    pub maximum_memory_megabytes: f64,
}

impl std::default::Default for Options {
    fn default() -> Self {
        Self::from_parameters(&ParameterSet::new(PARAMETERS)).expect("the defaults of the table are valid: tested")
    }
}

impl Options {
    /// The options of a parameter set over [`PARAMETERS`].
    ///
    /// # Errors
    /// [`Error::ParameterValue`] for lists that cannot be read (`hole`, `region`, `patch-role`, `size-source`) and for
    /// options of [`FIXED`] with another value than the default.
    pub fn from_parameters(set: &ParameterSet) -> Result<Self> {
        refuse_unsupported(set)?;
        let count = |name: &str| set.integer(name) as usize;
        let small = |name: &str| set.integer(name) as u8;
        Ok(Self {
            domain: if set.integer("domain") == 1 { DomainRule::Nesting } else { DomainRule::Regions },
            holes: texts(set, "hole").map(parse_hole).collect::<Result<_>>()?,
            regions: texts(set, "region").map(parse_region).collect::<Result<_>>()?,
            patch_roles: texts(set, "patch-role").map(parse_patch_role).collect::<Result<_>>()?,
            sort_points: small("sort-points"),
            snap_location: set.integer("location-mode") == 1,
            location_tolerance: set.real("location-tolerance"),
            boundary_recovery: match set.integer("boundary-recovery") {
                0 => RecoveryMode::Off,
                1 => RecoveryMode::Partitions,
                _ => RecoveryMode::Full,
            },
            recursion_depth: count("recursion-depth"),
            edge_removal_limit: count("edge-removal-limit"),
            touch_tolerance: set.real("touch-tolerance"),
            size_factor: set.real("size-factor"),
            size_minimum_weight: set.real("size-minimum-weight"),
            growth_rate: set.real("growth-rate"),
            size_limit: set.real("size-limit"),
            size_sources: texts(set, "size-source").map(parse_size_source).collect::<Result<_>>()?,
            refine: set.flag("refine"),
            near_point_factor: set.real("near-point-factor"),
            edge_satisfied_factor: set.real("edge-satisfied-factor"),
            satisfied_angle: set.real("satisfied-angle"),
            accurate_normals: set.integer("normal-mode") == 1,
            minimum_points: count("minimum-points"),
            count_slivers: set.flag("count-slivers"),
            maximum_passes: count("maximum-passes"),
            reconnection_criterion: small("reconnection-criterion"),
            repeat_reconnection: set.flag("repeat-reconnection"),
            quality_reconnection_criterion: small("quality-reconnection-criterion"),
            final_reconnection_criterion: small("final-reconnection-criterion"),
            flip_44: set.flag("flip-44"),
            flip_44_quality: set.flag("flip-44-quality"),
            low_quality_surface_angle: set.real("low-quality-surface-angle"),
            quality_passes: count("quality-passes"),
            quality_repeats: count("quality-repeats"),
            repeat_angle: set.real("repeat-angle"),
            mask_angle: set.real("mask-angle"),
            quality_angle: set.real("quality-angle"),
            smoothing_iterations: count("smoothing-iterations"),
            smoothing_coefficient: set.real("smoothing-coefficient"),
            boundary_smoothing_factor: set.real("boundary-smoothing-factor"),
            smoothing_mode: small("smoothing-mode"),
            smart_smoothing: set.flag("smart-smoothing"),
            delete_field_slivers: set.flag("delete-field-slivers"),
            field_sliver_repeats: count("field-sliver-repeats"),
            field_sliver_angle: set.real("field-sliver-angle"),
            delete_boundary_slivers: set.flag("delete-boundary-slivers"),
            boundary_sliver_repeats: count("boundary-sliver-repeats"),
            boundary_sliver_angle: set.real("boundary-sliver-angle"),
            discontinuity_angle: set.real("discontinuity-angle"),
            surface_angle_limit: set.real("surface-angle-limit"),
            delete_small_edges: set.flag("delete-small-edges"),
            small_edge_factor: set.real("small-edge-factor"),
            quality_statistics: set.flag("quality-statistics"),
            refinement_threads: count("refinement-threads"),
            quality_threads: count("quality-threads"),
            buckets: count("buckets"),
            quality_buckets: count("quality-buckets"),
            transfer_fraction: set.real("transfer-fraction"),
            transfer_reduction: set.real("transfer-reduction"),
            quality_transfer_fraction: set.real("quality-transfer-fraction"),
            quality_transfer_reduction: set.real("quality-transfer-reduction"),
            group_active: set.flag("group-active"),
            group_active_quality: set.flag("group-active-quality"),
            pin_threads: set.flag("pin-threads"),
            sort_new_points: set.flag("sort-new-points"),
            sort_quality: set.flag("sort-quality"),
            reserved_elements: count("reserved-elements"),
            maximum_elements: count("maximum-elements"),
            maximum_memory_megabytes: set.real("maximum-memory"),
        })
    }
}

fn refuse_unsupported(set: &ParameterSet) -> Result<()> {
    let defaults = ParameterSet::new(PARAMETERS);
    match FIXED.iter().find(|name| set.value(name) != defaults.value(name)) {
        Some(name) => {
            Err(Error::ParameterValue { name: (*name).into(), reason: "this build supports only the default".into() })
        }
        None => Ok(()),
    }
}

fn texts<'a>(set: &'a ParameterSet, name: &str) -> impl Iterator<Item = &'a str> {
    set.values(name).iter().filter_map(|value| match value {
        Value::Text(text) => Some(text.as_str()),
        _ => None,
    })
}

fn refuse<T>(name: &str, text: &str, form: &str) -> Result<T> {
    Err(Error::ParameterValue { name: name.into(), reason: format!("'{text}' is not of the form {form}") })
}

/// Finite numbers separated by commas.
fn numbers(text: &str) -> Option<Vec<f64>> {
    text.split(',').map(|part| part.trim().parse::<f64>().ok().filter(|v| v.is_finite())).collect()
}

fn parse_hole(text: &str) -> Result<DVec3> {
    match numbers(text).as_deref() {
        Some(&[x, y, z]) => Ok(DVec3::new(x, y, z)),
        _ => refuse("hole", text, "X,Y,Z"),
    }
}

fn parse_region(text: &str) -> Result<RegionSeed> {
    let form = "X,Y,Z,LABEL[,SIZE] with a whole number LABEL above 0 and SIZE above 0";
    let values = numbers(text).unwrap_or_default();
    let (size, valid) = match values.len() {
        4 => (None, true),
        5 => (Some(values[4]), values[4] > 0.0),
        _ => (None, false),
    };
    if !valid || values[3].fract() != 0.0 || values[3] < 1.0 || values[3] > f64::from(i32::MAX) {
        return refuse("region", text, form);
    }
    Ok(RegionSeed { point: DVec3::new(values[0], values[1], values[2]), label: values[3] as i32, size })
}

fn parse_patch_role(text: &str) -> Result<(i32, String)> {
    let parsed = text.split_once('=').and_then(|(patch, role)| Some((patch.trim().parse().ok()?, role.trim())));
    let Some((patch, role)) = parsed else { return refuse("patch-role", text, "PATCH=ROLE") };
    match PatchRole::from_name(role) {
        Ok(known) => Ok((patch, known.name().to_owned())),
        Err(error) => Err(Error::ParameterValue { name: "patch-role".into(), reason: error.to_string() }),
    }
}

fn parse_size_source(text: &str) -> Result<SizeSource> {
    let form = "point:X,Y,Z,SIZE, line:X,Y,Z,X,Y,Z,SIZE, box:X,Y,Z,X,Y,Z,SIZE or sphere:X,Y,Z,RADIUS,SIZE, each with \
                ,DECAY behind where wanted; SIZE above 0, RADIUS and DECAY not below 0";
    let Some((kind, rest)) = text.split_once(':') else { return refuse("size-source", text, form) };
    let values = numbers(rest).unwrap_or_default();
    let shape_values = match kind.trim() {
        "point" => 3,
        "sphere" => 4,
        "line" | "box" => 6,
        _ => return refuse("size-source", text, form),
    };
    if values.len() != shape_values + 1 && values.len() != shape_values + 2 {
        return refuse("size-source", text, form);
    }
    let at = |i: usize| DVec3::new(values[i], values[i + 1], values[i + 2]);
    let shape = match kind.trim() {
        "point" => SourceShape::Point(at(0)),
        "sphere" => SourceShape::Sphere(at(0), values[3]),
        "line" => SourceShape::Line(at(0), at(3)),
        _ => SourceShape::Box(at(0).min(at(3)), at(0).max(at(3))),
    };
    let size = values[shape_values];
    let decay = values.get(shape_values + 1).copied().unwrap_or(DEFAULT_DECAY);
    let radius_fits = shape_values != 4 || values[3] >= 0.0;
    if radius_fits && size > 0.0 && decay >= 0.0 {
        Ok(SizeSource { shape, size, decay })
    } else {
        refuse("size-source", text, form)
    }
}

#[cfg(test)]
mod tests;
