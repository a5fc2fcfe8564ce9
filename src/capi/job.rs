//! Jobs: inputs, parameters, running, cancelling.
//!
//! # Method
//! A job holds everything a run reads, already converted: label images, scans, snapshots of surface and sizing. Its
//! changeable part stands behind a mutex that calls only try; the cancellation token stands outside of it.

use std::ffi::{c_char, c_void};
use std::ops::ControlFlow;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use glam::{DMat4, DVec3};

use super::context::{ContextShared, mw_context, shared_context};
use super::guard::{call_host, guard, to_c_string};
use super::handles::{borrow, destroy, give, lock};
use super::image::{MW_SPACE_LPS, MW_SPACE_RAS, mw_image};
use super::mesh::mw_mesh;
use super::results::Results;
use super::sizing::mw_sizing;
use super::slices::{slice, text};
use super::status::mw_status;
use super::surface::{mw_surface, to_points};
use crate::context::{CancelToken, RunContext};
use crate::error::{Error, Result};
use crate::image::label_image::LabelImage;
use crate::image::voxel_image::VoxelImage;
use crate::mesh::mixed_mesh::MixedMesh;
use crate::mesh::sizing::Sizing;
use crate::mesh::surface_mesh::SurfaceMesh;
use crate::parameters::{Kind, ParameterSet, Value, find};
use crate::pipeline::{JobKind, Output, image_to_mesh, registration, surface_to_mesh};

/// One mesher or one registration: takes inputs and parameters, runs, hands out results. Used by one thread at a time
/// (a second one gets MW_E_STATE), except mw_job_cancel. It may run again with other inputs or parameters.
pub struct mw_job {
    cancel: CancelToken,
    state: Mutex<JobState>,
}

/// Kind of job: a segmented image becomes a mesh. Input: image "labels". Optional: points "fixed_points".
pub const MW_JOB_IMAGE_TO_MESH: i32 = 1;
/// Kind of job: a surface triangulation becomes a mesh. Input: surface "surface". Optional: sizing "sizing".
pub const MW_JOB_SURFACE_TO_MESH: i32 = 2;
/// Kind of job: two scans become a displacement field. Inputs: images "fixed" (intraoperative), "moving" (preoperative)
/// and "segmentation" (labels of the moving scan: 1 brain, 2 tumour, more allowed). Optional: image "mask" (labels of
/// the fixed scan), mesh "mesh" (of the segmentation, instead of making one), transform "rigid", points
/// "fixed_landmarks" and "moving_landmarks" (for evaluation only).
pub const MW_JOB_REGISTRATION: i32 = 3;

/// Receives progress, on the thread that called mw_job_run, about every 50 ms. `stage` is a stable name of the step,
/// valid during the call; `done` is the fraction of the whole run, from 0 to 1, never decreasing.
/// It must not throw, must not call longjmp, and must not use the job except through mw_job_cancel.
///
/// @return 0 to go on, anything else to cancel
pub type mw_progress_fn = Option<unsafe extern "C" fn(user: *mut c_void, stage: *const c_char, done: f64) -> i32>;

#[derive(Default)]
struct Inputs {
    labels: Option<Arc<LabelImage>>,
    mask: Option<Arc<LabelImage>>,
    fixed: Option<Arc<VoxelImage>>,
    moving: Option<Arc<VoxelImage>>,
    surface: Option<Arc<SurfaceMesh>>,
    sizing: Option<Sizing>,
    mesh: Option<Arc<MixedMesh>>,
    fixed_points: Vec<DVec3>,
    fixed_landmarks: Vec<DVec3>,
    moving_landmarks: Vec<DVec3>,
    rigid: Option<DMat4>,
}

struct Progress {
    function: unsafe extern "C" fn(*mut c_void, *const c_char, f64) -> i32,
    user: *mut c_void,
}

// SAFETY: the function is only called on the thread that runs the job, which one thread at a time may use; moving the
// job, and `user` with it, to another thread is the host's own doing.
unsafe impl Send for Progress {}

/// What a run reads.
struct Task {
    kind: JobKind,
    inputs: Inputs,
    parameters: ParameterSet,
}

/// The changeable part of a job.
pub struct JobState {
    context: Arc<ContextShared>,
    task: Task,
    progress: Option<Progress>,
    time_limit: Option<Duration>,
    /// Of the last run.
    pub results: Results,
}

impl Task {
    fn missing(&self, slot: &str) -> Error {
        Error::State { reason: format!("a {} job needs its input '{slot}' before it runs", self.kind.name()) }
    }

    fn no_slot(&self, what: &str, slot: &str) -> Error {
        Error::argument("slot", format!("a {} job takes no {what} '{slot}'", self.kind.name()))
    }

    fn set_image(&mut self, slot: &str, image: &mw_image) -> Result<()> {
        match (self.kind, slot) {
            (JobKind::ImageToMesh, "labels") | (JobKind::Registration, "segmentation") => {
                self.inputs.labels = Some(Arc::new(image.to_label_image()?));
            }
            (JobKind::Registration, "mask") => self.inputs.mask = Some(Arc::new(image.to_label_image()?)),
            (JobKind::Registration, "fixed") => self.inputs.fixed = Some(image.to_voxel_image()?),
            (JobKind::Registration, "moving") => self.inputs.moving = Some(image.to_voxel_image()?),
            _ => return Err(self.no_slot("image", slot)),
        }
        Ok(())
    }

    fn set_points(&mut self, slot: &str, points: Vec<DVec3>) -> Result<()> {
        match (self.kind, slot) {
            (JobKind::ImageToMesh, "fixed_points") => self.inputs.fixed_points = points,
            (JobKind::Registration, "fixed_landmarks") => self.inputs.fixed_landmarks = points,
            (JobKind::Registration, "moving_landmarks") => self.inputs.moving_landmarks = points,
            _ => return Err(self.no_slot("points", slot)),
        }
        Ok(())
    }

    /// Refuses parameters that only the command line can follow: in C, data is handed over, not named. The image
    /// mesher's fidelity file is read by the pipeline, and its debugging outputs are switched on by being named.
    fn check_settable(&self, name: &str) -> Result<()> {
        let parameter = &self.kind.parameters()[find(self.kind.parameters(), name)?];
        if self.kind == JobKind::ImageToMesh && parameter.group != "Files" {
            return Ok(());
        }
        let instead = match parameter.kind {
            Kind::InputFile { .. } => "hand the data over with mw_job_set_image, mw_job_set_surface, ...",
            Kind::OutputFile { .. } => "take the result with mw_job_take_mesh, mw_job_take_image, ...",
            _ => return Ok(()),
        };
        let reason = format!("files are for the command line; {instead}");
        Err(Error::ParameterValue { name: parameter.name.to_owned(), reason })
    }

    fn execute(&self, context: &RunContext) -> Result<Output> {
        let inputs = &self.inputs;
        match self.kind {
            JobKind::ImageToMesh => {
                let labels = inputs.labels.as_deref().ok_or_else(|| self.missing("labels"))?;
                let input = image_to_mesh::Input { labels, fixed_points: &inputs.fixed_points };
                image_to_mesh::run(&input, &self.parameters, context)
            }
            JobKind::SurfaceToMesh => {
                let surface = inputs.surface.as_deref().ok_or_else(|| self.missing("surface"))?;
                let input = surface_to_mesh::Input { surface, sizing: inputs.sizing.as_ref() };
                surface_to_mesh::run(&input, &self.parameters, context)
            }
            JobKind::Registration => registration::run(&self.registration_input()?, &self.parameters, context),
        }
    }

    fn registration_input(&self) -> Result<registration::Input<'_>> {
        let inputs = &self.inputs;
        let (fixed, moving) = (&inputs.fixed_landmarks, &inputs.moving_landmarks);
        if fixed.len() != moving.len() {
            let reason = format!("{} fixed landmarks, but {} moving ones", fixed.len(), moving.len());
            return Err(Error::State { reason });
        }
        Ok(registration::Input {
            fixed: inputs.fixed.as_deref().ok_or_else(|| self.missing("fixed"))?,
            moving: inputs.moving.as_deref().ok_or_else(|| self.missing("moving"))?,
            segmentation: inputs.labels.as_deref().ok_or_else(|| self.missing("segmentation"))?,
            fixed_mask: inputs.mask.as_deref(),
            mesh: inputs.mesh.as_deref(),
            rigid: inputs.rigid,
            landmarks: (!fixed.is_empty()).then_some((fixed.as_slice(), moving.as_slice())),
        })
    }
}

impl JobState {
    fn run(&mut self, cancel: &CancelToken) -> Result<()> {
        self.results = Results::default();
        let context = self.context.run_context(cancel.clone());
        context.set_time_limit(self.time_limit);
        let tick = |stage: &'static str, done: f64| match &self.progress {
            Some(progress) => report(progress, stage, done),
            None => ControlFlow::Continue(()),
        };
        let task = &self.task;
        let outcome = context.run(tick, |context| task.execute(context));
        let mut findings = context.take_findings();
        match outcome {
            Ok(output) => {
                let patches = task.inputs.surface.as_ref().map(|s| s.patches.clone()).unwrap_or_default();
                self.results = Results::new(output, patches, &findings);
                Ok(())
            }
            Err(error) => {
                findings.extend_from_slice(error.findings());
                self.results = Results::failed(&findings);
                Err(error)
            }
        }
    }
}

fn report(progress: &Progress, stage: &str, done: f64) -> ControlFlow<()> {
    let stage = to_c_string(stage);
    // SAFETY: the host promised a function of this type; this is the thread that called mw_job_run.
    let answer = call_host(|| unsafe { (progress.function)(progress.user, stage.as_ptr(), done) });
    if answer == 0 { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
}

/// Runs `body` on the changeable part of a job.
///
/// # Errors
/// [`Error::InvalidArgument`] for null, [`Error::State`] while another thread uses the job; those of `body`.
///
/// # Safety
/// As [`borrow`].
pub unsafe fn with_job<T>(job: *const mw_job, body: impl FnOnce(&mut JobState) -> Result<T>) -> Result<T> {
    // SAFETY: as the caller promises.
    body(&mut *lock(&unsafe { borrow(job, "job") }?.state, "job")?)
}

/// Makes a job.
///
/// @param context  a context; the job keeps what it needs of it
/// @param kind     MW_JOB_IMAGE_TO_MESH, MW_JOB_SURFACE_TO_MESH or MW_JOB_REGISTRATION
/// @param out      receives the job, null after an error; destroy it with mw_job_destroy
/// @return MW_OK, MW_E_ARG (null pointer, unknown kind)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_create(context: *mut mw_context, kind: i32, out: *mut *mut mw_job) -> mw_status {
    let make = || {
        // SAFETY: the C caller's promise about the handle.
        let context = Arc::clone(unsafe { shared_context(context) }?);
        let kind = JobKind::from_number(kind)?;
        let state = JobState {
            context,
            task: Task { kind, inputs: Inputs::default(), parameters: ParameterSet::new(kind.parameters()) },
            progress: None,
            time_limit: None,
            results: Results::default(),
        };
        Ok(mw_job { cancel: CancelToken::default(), state: Mutex::new(state) })
    };
    // SAFETY: the C caller's promise about `out`.
    guard(|| unsafe { give(out, make) })
}

/// Destroys a job; null is allowed. Not while it runs.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_destroy(job: *mut mw_job) {
    guard(|| {
        // SAFETY: the C caller's promise about the handle.
        unsafe { destroy(job) };
        Ok(())
    });
}

/// Gives a job an image. Labels are converted and checked at once; borrowed voxels are copied as far as needed: the
/// image may be destroyed afterwards.
///
/// @param job    a job
/// @param slot   which input: see MW_JOB_...
/// @param image  an image; null takes the input away
/// @return MW_OK, MW_E_ARG (null job or slot, no such input), MW_E_INPUT (no label image: a value that is not whole or
///         negative, more than 65535 labels, only background), MW_E_STATE, MW_E_MEMORY
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_image(job: *mut mw_job, slot: *const c_char, image: *const mw_image) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handles and the string.
        let (slot, image) = unsafe { (text(slot, "slot")?, image.as_ref()) };
        let set = |state: &mut JobState| match image {
            Some(image) => state.task.set_image(slot, image),
            None => state.task.clear(slot, "image"),
        };
        // SAFETY: as above.
        unsafe { with_job(job, set) }
    })
}

/// Gives a surface job its surface, in its present state.
///
/// @param job      a job
/// @param slot     "surface"
/// @param surface  a surface; null takes the input away
/// @return MW_OK, MW_E_ARG (null job or slot, no such input), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_surface(
    job: *mut mw_job,
    slot: *const c_char,
    surface: *const mw_surface,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handles and the string.
        let (slot, surface) = unsafe { (text(slot, "slot")?, surface.as_ref()) };
        let set = |state: &mut JobState| match (state.task.kind, slot, surface) {
            (JobKind::SurfaceToMesh, "surface", Some(surface)) => {
                state.task.inputs.surface = Some(surface.snapshot()?);
                Ok(())
            }
            (_, _, None) => state.task.clear(slot, "surface"),
            _ => Err(state.task.no_slot("surface", slot)),
        };
        // SAFETY: as above.
        unsafe { with_job(job, set) }
    })
}

/// Gives a surface job element sizes, in their present state.
///
/// @param job     a job
/// @param slot    "sizing"
/// @param sizing  a sizing; null takes the input away
/// @return MW_OK, MW_E_ARG (null job or slot, no such input), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_sizing(
    job: *mut mw_job,
    slot: *const c_char,
    sizing: *const mw_sizing,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handles and the string.
        let (slot, sizing) = unsafe { (text(slot, "slot")?, sizing.as_ref()) };
        let set = |state: &mut JobState| match (state.task.kind, slot, sizing) {
            (JobKind::SurfaceToMesh, "sizing", Some(sizing)) => {
                state.task.inputs.sizing = Some(sizing.snapshot()?);
                Ok(())
            }
            (_, _, None) => state.task.clear(slot, "sizing"),
            _ => Err(state.task.no_slot("sizing", slot)),
        };
        // SAFETY: as above.
        unsafe { with_job(job, set) }
    })
}

/// Gives a registration a mesh of the segmentation, to be used instead of making one.
///
/// @param job   a job
/// @param slot  "mesh"
/// @param mesh  a mesh, which the job shares; null takes the input away
/// @return MW_OK, MW_E_ARG (null job or slot, no such input), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_mesh(job: *mut mw_job, slot: *const c_char, mesh: *const mw_mesh) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handles and the string.
        let (slot, mesh) = unsafe { (text(slot, "slot")?, mesh.as_ref()) };
        let set = |state: &mut JobState| match (state.task.kind, slot, mesh) {
            (JobKind::Registration, "mesh", Some(mesh)) => {
                state.task.inputs.mesh = Some(mesh.shared());
                Ok(())
            }
            (_, _, None) => state.task.clear(slot, "mesh"),
            _ => Err(state.task.no_slot("mesh", slot)),
        };
        // SAFETY: as above.
        unsafe { with_job(job, set) }
    })
}

/// Gives a job points: "fixed_points" of an image job become vertices of the mesh; "fixed_landmarks" and
/// "moving_landmarks" of a registration are compared after it, pair by pair.
///
/// @param job     a job
/// @param slot    which input
/// @param count   number of points; 0 takes the input away
/// @param points  count x 3 finite coordinates, row-major, LPS mm; copied
/// @return MW_OK, MW_E_ARG (null pointer, no such input, not finite), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_points(
    job: *mut mw_job,
    slot: *const c_char,
    count: i64,
    points: *const f64,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the string and the array.
        let (slot, points) = unsafe { (text(slot, "slot")?, slice(points, count, 3, "points")?) };
        if points.iter().any(|v| !v.is_finite()) {
            return Err(Error::argument("points", "a coordinate is not finite"));
        }
        // SAFETY: the C caller's promise about the handle.
        unsafe { with_job(job, |state| state.task.set_points(slot, to_points(points))) }
    })
}

/// Gives a registration its rigid start, from points of the fixed image to points of the moving image.
///
/// @param job     a job
/// @param slot    "rigid"
/// @param matrix  16 numbers, 4 x 4, row-major, last row 0 0 0 1, translation in mm; null takes the input away
/// @param space   frame of both sides: MW_SPACE_LPS or MW_SPACE_RAS
/// @return MW_OK, MW_E_ARG (null job or slot, no such input, no rigid transform, unknown space), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_transform(
    job: *mut mw_job,
    slot: *const c_char,
    matrix: *const f64,
    space: i32,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promise about the string.
        let slot = unsafe { text(slot, "slot") }?;
        let rigid = if matrix.is_null() {
            None
        } else {
            // SAFETY: the C caller's promise about the array.
            Some(rigid_transform(unsafe { slice(matrix, 16, 1, "matrix") }?, space)?)
        };
        let set = |state: &mut JobState| match (state.task.kind, slot) {
            (JobKind::Registration, "rigid") => {
                state.task.inputs.rigid = rigid;
                Ok(())
            }
            _ => Err(state.task.no_slot("transform", slot)),
        };
        // SAFETY: the C caller's promise about the handle.
        unsafe { with_job(job, set) }
    })
}

/// Deviation from orthonormality that is still rounding: transforms often travel in single precision.
const RIGID_TOLERANCE: f64 = 1e-4;

fn rigid_transform(numbers: &[f64], space: i32) -> Result<DMat4> {
    let mut matrix = DMat4::from_cols_slice(numbers).transpose();
    match space {
        MW_SPACE_LPS => {}
        MW_SPACE_RAS => {
            let flip = DMat4::from_scale(DVec3::new(-1.0, -1.0, 1.0));
            matrix = flip * matrix * flip;
        }
        other => return Err(Error::argument("space", format!("{other} is no MW_SPACE_ number"))),
    }
    let rotation = glam::DMat3::from_mat4(matrix);
    let rigid = matrix.is_finite()
        && (rotation * rotation.transpose()).abs_diff_eq(glam::DMat3::IDENTITY, RIGID_TOLERANCE)
        && rotation.determinant() > 0.0
        && matrix.row(3) == glam::DVec4::W;
    if rigid { Ok(matrix) } else { Err(Error::argument("matrix", "not a rigid transform (rotation and translation)")) }
}

impl Task {
    fn clear(&mut self, slot: &str, what: &str) -> Result<()> {
        match (self.kind, what, slot) {
            (JobKind::ImageToMesh, "image", "labels") | (JobKind::Registration, "image", "segmentation") => {
                self.inputs.labels = None;
            }
            (JobKind::Registration, "image", "mask") => self.inputs.mask = None,
            (JobKind::Registration, "image", "fixed") => self.inputs.fixed = None,
            (JobKind::Registration, "image", "moving") => self.inputs.moving = None,
            (JobKind::Registration, "mesh", "mesh") => self.inputs.mesh = None,
            (JobKind::SurfaceToMesh, "surface", "surface") => self.inputs.surface = None,
            (JobKind::SurfaceToMesh, "sizing", "sizing") => self.inputs.sizing = None,
            _ => return Err(self.no_slot(what, slot)),
        }
        Ok(())
    }
}

/// Sets one value, for all labels or for one.
unsafe fn set_value(job: *mut mw_job, name: *const c_char, label: Option<i64>, value: Value) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promise about the string.
        let name = unsafe { text(name, "name") }?;
        let set = |state: &mut JobState| {
            state.task.check_settable(name)?;
            match label {
                Some(label) => state.task.parameters.set_for_label(name, label, value),
                None => state.task.parameters.set(name, value),
            }
        };
        // SAFETY: the C caller's promise about the handle.
        unsafe { with_job(job, set) }
    })
}

/// Sets a parameter to a number. mw_param_get lists names, ranges and units.
///
/// @return MW_OK, MW_E_ARG (null pointer), MW_E_PARAM (unknown name, wrong kind, out of range, not finite), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_f64(job: *mut mw_job, name: *const c_char, value: f64) -> mw_status {
    // SAFETY: the C caller's promises about the handle and the string.
    unsafe { set_value(job, name, None, Value::Real(value)) }
}

/// Sets a parameter to a whole number: numbers, flags (0, 1), positions of choices.
///
/// @return as mw_job_set_f64
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_i64(job: *mut mw_job, name: *const c_char, value: i64) -> mw_status {
    // SAFETY: the C caller's promises about the handle and the string.
    unsafe { set_value(job, name, None, Value::Integer(value)) }
}

/// Sets a parameter from text, as the command line does: any kind but files. A repeatable parameter gets one value more.
///
/// @return as mw_job_set_f64; also MW_E_ARG for text that is not UTF-8
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_str(job: *mut mw_job, name: *const c_char, value: *const c_char) -> mw_status {
    // SAFETY: the C caller's promise about the string.
    match unsafe { text(value, "value") } {
        // SAFETY: as above, and about the handle.
        Ok(value) => unsafe { set_value(job, name, None, Value::Text(value.to_owned())) },
        Err(error) => guard(|| Err(error)),
    }
}

/// Sets a parameter for one label; mw_param_get tells which parameters allow it.
///
/// @param label  the label's value in the image
/// @return as mw_job_set_f64
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_f64_for(
    job: *mut mw_job,
    name: *const c_char,
    label: i64,
    value: f64,
) -> mw_status {
    // SAFETY: the C caller's promises about the handle and the string.
    unsafe { set_value(job, name, Some(label), Value::Real(value)) }
}

/// Sets a parameter for one label from text.
///
/// @param label  the label's value in the image
/// @return as mw_job_set_str
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_str_for(
    job: *mut mw_job,
    name: *const c_char,
    label: i64,
    value: *const c_char,
) -> mw_status {
    // SAFETY: the C caller's promise about the string.
    match unsafe { text(value, "value") } {
        // SAFETY: as above, and about the handle.
        Ok(value) => unsafe { set_value(job, name, Some(label), Value::Text(value.to_owned())) },
        Err(error) => guard(|| Err(error)),
    }
}

/// Sets every parameter back to its default.
///
/// @return MW_OK, MW_E_ARG, MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_reset_params(job: *mut mw_job) -> mw_status {
    let reset = |state: &mut JobState| {
        state.task.parameters = ParameterSet::new(state.task.kind.parameters());
        Ok(())
    };
    // SAFETY: the C caller's promise about the handle.
    guard(|| unsafe { with_job(job, reset) })
}

/// Sets the function that receives progress.
///
/// @param job   a job
/// @param fn    the function; null for none
/// @param user  handed to the function as it is
/// @return MW_OK, MW_E_ARG, MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_progress(job: *mut mw_job, r#fn: mw_progress_fn, user: *mut c_void) -> mw_status {
    let progress = r#fn.map(|function| Progress { function, user });
    let set = |state: &mut JobState| {
        state.progress = progress;
        Ok(())
    };
    // SAFETY: the C caller's promise about the handle.
    guard(|| unsafe { with_job(job, set) })
}

/// Limits the time of a run, after which it ends with MW_E_LIMIT.
///
/// @param job      a job
/// @param seconds  positive and finite; 0 for no limit
/// @return MW_OK, MW_E_ARG (null, negative, not finite), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_set_time_limit(job: *mut mw_job, seconds: f64) -> mw_status {
    guard(|| {
        let limit = Duration::try_from_secs_f64(seconds)
            .map_err(|error| Error::argument("seconds", format!("{seconds}: {error}")))?;
        let set = |state: &mut JobState| {
            state.time_limit = (!limit.is_zero()).then_some(limit);
            Ok(())
        };
        // SAFETY: the C caller's promise about the handle.
        unsafe { with_job(job, set) }
    })
}

/// Runs a job and waits for it. Results of an earlier run are dropped first; what was taken of them stays.
/// Same inputs and parameters give the same bits for any number of threads, except where a parameter's documentation
/// says otherwise.
///
/// @return MW_OK; MW_E_STATE (an input is missing, the job is in use); MW_E_PARAM; MW_E_INPUT and MW_E_NO_RESULT (see
///         mw_job_diag_get); MW_E_CANCELLED; MW_E_LIMIT; MW_E_UNSUPPORTED; MW_E_MEMORY; MW_E_INTERNAL
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_run(job: *mut mw_job) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promise about the handle.
        let cancel = &unsafe { borrow(job, "job") }?.cancel;
        // SAFETY: as above.

        unsafe { with_job(job, |state| finish(cancel, || state.run(cancel))) }
    })
}

/// Uses up a cancellation when `run` ends, also by a panic.
fn finish<T>(cancel: &CancelToken, run: impl FnOnce() -> T) -> T {
    struct Reset<'a>(&'a CancelToken);
    impl Drop for Reset<'_> {
        fn drop(&mut self) {
            self.0.reset();
        }
    }
    let _reset = Reset(cancel);
    run()
}

/// Cancels the run in progress, or the next one where none is: the run ends with MW_E_CANCELLED within 0.2 s. The one
/// function that may be called from another thread while the job runs, also from callbacks. Null is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_cancel(job: *mut mw_job) {
    guard(|| {
        // SAFETY: the C caller's promise about the handle.
        unsafe { borrow(job, "job") }?.cancel.cancel();
        Ok(())
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_agree_with_the_pipeline() {
        let numbers = [MW_JOB_IMAGE_TO_MESH, MW_JOB_SURFACE_TO_MESH, MW_JOB_REGISTRATION];
        assert_eq!(numbers, JobKind::ALL.map(|kind| kind as i32));
    }

    #[test]
    fn only_rigid_transforms_are_taken() {
        let mut matrix = [1.0, 0.0, 0.0, 5.0, 0.0, 1.0, 0.0, 6.0, 0.0, 0.0, 1.0, 7.0, 0.0, 0.0, 0.0, 1.0];
        let ras = rigid_transform(&matrix, MW_SPACE_RAS).unwrap();
        assert_eq!(ras.transform_point3(DVec3::ZERO), DVec3::new(-5.0, -6.0, 7.0));
        assert!(rigid_transform(&matrix, 0).is_err());
        matrix[0] = 2.0;
        assert!(rigid_transform(&matrix, MW_SPACE_LPS).is_err());
        matrix[0] = f64::NAN;
        assert!(rigid_transform(&matrix, MW_SPACE_LPS).is_err());
    }
}
