//! The one error type of the crate, and the findings that say where data is at fault.
//!
//! # Method
//! An [`Error`] ends a call; a [`Finding`] is a piece of data about the input or the result (an open edge, a label
//! that was lost). Errors about input data carry their findings, so that a host can list every fault at once.
//!
//! # Invariants
//! Each variant maps to exactly one C status code (`capi::status`) and one exit code of the command line.

use std::path::PathBuf;

/// Result of every fallible function of the crate.
pub type Result<T> = std::result::Result<T, Error>;

/// Everything that can end a call.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A value handed over by the caller is unusable by itself: null, non-finite, wrong size.
    #[error("invalid argument {name}: {reason}")]
    InvalidArgument {
        /// Which argument.
        name: String,
        /// What is wrong with it, with the offending value.
        reason: String,
    },
    /// A parameter name that no table knows.
    #[error("unknown parameter '{name}'{}", nearest.as_ref().map(|n| format!(", did you mean '{n}'?")).unwrap_or_default())]
    UnknownParameter {
        /// The name as given.
        name: String,
        /// The nearest known name, where one is near.
        nearest: Option<String>,
    },
    /// A parameter value of the wrong kind or outside its range.
    #[error("parameter '{name}': {reason}")]
    ParameterValue {
        /// The canonical name.
        name: String,
        /// What was given and what is allowed.
        reason: String,
    },
    /// The input data cannot be meshed or registered; the findings say what and where.
    #[error("{message}")]
    InvalidInput {
        /// One line for a person.
        message: String,
        /// Every fault found, each with ids and coordinates.
        findings: Vec<Finding>,
    },
    /// No valid result could be made from valid input.
    #[error("{message}")]
    NoResult {
        /// Why, in one line.
        message: String,
        /// Where, as far as known.
        findings: Vec<Finding>,
    },
    /// The operating system refused a read or a write.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file that is not what its name or its header says.
    #[error("{}: {reason}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong and where.
        reason: String,
    },
    /// The file kind, cell type or combination is valid but not supported here.
    #[error("unsupported: {reason}")]
    Unsupported {
        /// What, and what is supported instead.
        reason: String,
    },
    /// An index space is full: more entities than the 32-bit ids allow.
    #[error("capacity exceeded: {what} needs {needed}, the limit is {limit}")]
    CapacityExceeded {
        /// Which entities.
        what: &'static str,
        /// How many were needed.
        needed: u64,
        /// How many fit.
        limit: u64,
    },
    /// Memory could not be had.
    #[error("out of memory: {bytes} bytes for {what}")]
    OutOfMemory {
        /// For what.
        what: &'static str,
        /// How much was asked for.
        bytes: u64,
    },
    /// A limit set by the caller (time, elements, memory) was reached.
    #[error("limit reached: {reason}")]
    LimitReached {
        /// Which limit, and how far the work was.
        reason: String,
    },
    /// The caller cancelled.
    #[error("cancelled")]
    Cancelled,
    /// The call does not fit the state of the object (results before a run, for one).
    #[error("{reason}")]
    State {
        /// What has to happen first.
        reason: String,
    },
    /// A defect of this library.
    #[error("internal error: {reason}")]
    Internal {
        /// What was violated.
        reason: String,
    },
}

impl Error {
    /// Shorthand for [`Error::InvalidArgument`].
    pub fn argument(name: impl Into<String>, reason: impl Into<String>) -> Self {
        Self::InvalidArgument { name: name.into(), reason: reason.into() }
    }

    /// Shorthand for [`Error::InvalidInput`] without findings.
    pub fn input(message: impl Into<String>) -> Self {
        Self::InvalidInput { message: message.into(), findings: Vec::new() }
    }

    /// Shorthand for [`Error::Format`].
    pub fn format(path: impl Into<PathBuf>, reason: impl Into<String>) -> Self {
        Self::Format { path: path.into(), reason: reason.into() }
    }

    /// Shorthand for [`Error::Io`].
    pub fn io(path: impl Into<PathBuf>, source: std::io::Error) -> Self {
        Self::Io { path: path.into(), source }
    }

    /// The findings that the error carries; empty for most.
    pub fn findings(&self) -> &[Finding] {
        match self {
            Self::InvalidInput { findings, .. } | Self::NoResult { findings, .. } => findings,
            _ => &[],
        }
    }
}

/// How serious a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(i32)]
pub enum Severity {
    /// Worth knowing; nothing was changed.
    Note = 0,
    /// The input was repaired, or the result deviates from what was asked.
    Warning = 1,
    /// The input cannot be used.
    Error = 2,
}

/// What a finding is about. The numbers are part of the C interface: append, never renumber.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(i32)]
#[non_exhaustive]
pub enum FindingCode {
    /// A label of the input has no element in the mesh. `ids[0]` label, `ids[1]` voxels.
    LabelLost = 1,
    /// A connected component of a label has no element. `ids[0]` label, `ids[1]` voxels.
    ComponentLost = 2,
    /// A label does not reach its fidelity. `ids[0]` label.
    FidelityNotReached = 3,
    /// A sub-mesh has a non-manifold edge or vertex. `ids[0]` label.
    NonManifoldMesh = 4,
    /// A sub-mesh has other components than its label. `ids[0]` label, `ids[1]` how many more, negative where it joins some.
    DisconnectedMesh = 5,
    /// Voxels were relabelled by the clean-up. `ids[0]` label, `ids[1]` voxels.
    VoxelsRelabelled = 6,
    /// Smoothing could not improve the mesh, or stopped early.
    SmoothingStopped = 7,
    /// The image border cuts a label. `ids[0]` label.
    LabelAtImageBorder = 8,
    /// A sub-mesh has other tunnels, cavities or pieces than its label. `ids[0]` label, `ids[1]` difference of the Euler numbers.
    OtherTopology = 9,
    /// A surface edge with one triangle. `ids` the two vertices.
    OpenEdge = 20,
    /// A surface edge with three or more triangles where that is not allowed. `ids` the two vertices.
    NonManifoldEdge = 21,
    /// Two triangles with the same vertices. `ids` the triangles.
    DuplicateTriangle = 22,
    /// A triangle of zero area. `ids[0]` the triangle.
    DegenerateTriangle = 23,
    /// A triangle was turned over to make its component consistent. `ids[0]` the triangle.
    InconsistentOrientation = 24,
    /// Two triangles intersect. `ids` the triangles.
    IntersectingTriangles = 25,
    /// Two points almost touch. `ids` the points.
    NearlyCoincidentPoints = 26,
    /// Two points are equal and were merged. `ids` the points.
    MergedPoints = 27,
    /// A coordinate is NaN or infinite. `ids[0]` the point.
    NonFiniteCoordinate = 28,
    /// A vertex index outside the points. `ids[0]` the triangle, `ids[1]` the index.
    IndexOutOfRange = 29,
    /// All points lie on a point, a line or a plane.
    DegeneratePointSet = 30,
    /// A Steiner point stays in the volume. `ids[0]` its vertex.
    SteinerPoint = 31,
    /// A boundary edge or face could not be recovered. `ids` its vertices or triangle.
    NotRecovered = 32,
    /// A region of the domain. `ids[0]` its label, `ids[1]` its elements.
    Region = 33,
    /// A point of the surface that no triangle uses. `ids[0]` the point.
    UnusedPoint = 34,
    /// An element stays bad because the input's own angles force it. `ids[0]` the element.
    ForcedBadElement = 35,
    /// A hole or region seed lies in no bounded region. `ids[0]` its number.
    SeedOutside = 36,
    /// Blocks without correspondence. `ids[0]` how many.
    MissingCorrespondence = 50,
    /// A solver stopped before its tolerance. `ids[0]` iterations.
    NotConverged = 51,
    /// The displacement field folds. `ids[0]` how many voxels.
    FoldedField = 52,
    /// Anything that has no code of its own; the text says it.
    Other = 99,
}

/// One fault or remark, with ids and a place.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// What it is about.
    pub code: FindingCode,
    /// How serious it is.
    pub severity: Severity,
    /// Two ids whose meaning the code states; -1 where there is none.
    pub ids: [i64; 2],
    /// A place in world millimetres (LPS for images); NaN where there is none.
    pub point: [f64; 3],
    /// One line for a person.
    pub text: String,
}

impl Finding {
    /// A finding without ids and place; add them with [`Finding::with_ids`] and [`Finding::at`].
    pub fn new(code: FindingCode, severity: Severity, text: impl Into<String>) -> Self {
        Self { code, severity, ids: [-1, -1], point: [f64::NAN; 3], text: text.into() }
    }

    /// The same finding with its ids.
    #[must_use]
    pub fn with_ids(mut self, first: i64, second: i64) -> Self {
        self.ids = [first, second];
        self
    }

    /// The same finding with its place, world millimetres.
    #[must_use]
    pub fn at(mut self, point: [f64; 3]) -> Self {
        self.point = point;
        self
    }
}
