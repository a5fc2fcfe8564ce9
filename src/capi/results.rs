//! What a run left: mesh, images, arrays, figures, findings.

use std::ffi::{CString, c_char, c_void};
use std::sync::Arc;

use super::guard::{guard, guard_value, to_c_string};
use super::handles::{give, write};
use super::image::{mw_image, mw_type};
use super::job::{mw_job, with_job};
use super::mesh::{mw_mesh, view};
use super::slices::{text, write_sized};
use super::status::mw_status;
use crate::error::{Error, Finding, Result};
use crate::image::voxel_image::VoxelImage;
use crate::mesh::mixed_mesh::{ArrayData, MixedMesh, NamedArray};
use crate::mesh::surface_mesh::Patch;
use crate::pipeline::Output;
use crate::statistics::Statistics;

/// Results of the last run; empty before the first.
#[derive(Default)]
pub struct Results {
    succeeded: bool,
    mesh: Option<Arc<MixedMesh>>,
    meshes: Vec<(String, Arc<MixedMesh>)>,
    images: Vec<(String, Arc<VoxelImage>)>,
    arrays: Vec<NamedArray>,
    statistics: Statistics,
    statistic_names: Vec<CString>,
    findings: Vec<(Finding, CString)>,
    patches: Vec<Patch>,
}

impl Results {
    /// Those of a run that went well.
    pub fn new(output: Output, patches: Vec<Patch>, findings: &[Finding]) -> Self {
        let mut arrays = output.arrays;
        arrays.extend(output.points.into_iter().map(|(name, points)| NamedArray {
            name,
            components: 3,
            data: ArrayData::Real(points.iter().flat_map(|p| p.to_array()).collect()),
        }));
        Self {
            succeeded: true,
            mesh: output.mesh.map(Arc::new),
            meshes: output.meshes.into_iter().map(|(name, mesh)| (name, Arc::new(mesh))).collect(),
            images: output.images.into_iter().map(|(name, image)| (name, Arc::new(image))).collect(),
            arrays,
            statistic_names: output.statistics.entries().iter().map(|(name, _)| to_c_string(name)).collect(),
            statistics: output.statistics,
            patches,
            ..Self::failed(findings)
        }
    }

    /// Those of a run that failed: its findings.
    pub fn failed(findings: &[Finding]) -> Self {
        let findings = findings.iter().map(|finding| (finding.clone(), to_c_string(&finding.text))).collect();
        Self { findings, ..Self::default() }
    }

    fn check(&self) -> Result<()> {
        let reason = "the job has no results: it did not run yet, or its last run failed".into();
        if self.succeeded { Ok(()) } else { Err(Error::State { reason }) }
    }

    fn take_mesh(&self, name: Option<&str>) -> Result<mw_mesh> {
        self.check()?;
        let mesh = match name {
            None => self.mesh.as_ref(),
            Some(name) => self.meshes.iter().find(|(n, _)| n == name).map(|(_, mesh)| mesh),
        };
        match (mesh, name) {
            (Some(mesh), _) => Ok(mw_mesh::new(Arc::clone(mesh), self.patches.clone())),
            (None, None) => Err(Error::State { reason: "the run made no mesh".into() }),
            (None, Some(name)) => Err(no_such("mesh", name, self.meshes.iter().map(|(n, _)| n.as_str()))),
        }
    }

    fn take_image(&self, name: &str) -> Result<mw_image> {
        self.check()?;
        let image = self.images.iter().find(|(n, _)| n == name).map(|(_, image)| image);
        let image = image.ok_or_else(|| no_such("image", name, self.images.iter().map(|(n, _)| n.as_str())))?;
        Ok(mw_image::owned(Arc::clone(image)))
    }
}

fn no_such<'a>(what: &str, name: &str, known: impl Iterator<Item = &'a str>) -> Error {
    let known: Vec<_> = known.collect();
    let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
    Error::argument("name", format!("the run made no {what} '{name}'; it made: {known}"))
}

/// One figure of a run. Set `struct_size` before the call.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct mw_stat {
    /// sizeof(mw_stat)
    pub struct_size: usize,
    /// Stable dotted name, such as "mesh.tets"; valid until the job runs again or is destroyed.
    pub name: *const c_char,
    /// The figure.
    pub value: f64,
}

/// One thing that is wrong with the data, or worth knowing. Set `struct_size` before the call.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct mw_diag {
    /// sizeof(mw_diag)
    pub struct_size: usize,
    /// MW_DIAG_...
    pub code: i32,
    /// MW_SEVERITY_NOTE, MW_SEVERITY_WARNING or MW_SEVERITY_ERROR.
    pub severity: i32,
    /// Two ids whose meaning the code tells; -1 where there is none.
    pub id: [i64; 2],
    /// Place, mm; NaN where there is none.
    pub xyz: [f64; 3],
    /// One line of UTF-8; valid until the job runs again or is destroyed.
    pub text: *const c_char,
}

const STAT_SIZE: usize = size_of::<mw_stat>();
const DIAG_SIZE: usize = size_of::<mw_diag>();

/// Worth knowing; nothing was changed.
pub const MW_SEVERITY_NOTE: i32 = 0;
/// The input was repaired, or the result deviates from what was asked.
pub const MW_SEVERITY_WARNING: i32 = 1;
/// The input cannot be used.
pub const MW_SEVERITY_ERROR: i32 = 2;

/// A label has no cell. id: label, voxels.
pub const MW_DIAG_LABEL_LOST: i32 = 1;
/// A connected component of a label has no cell. id: label, voxels.
pub const MW_DIAG_COMPONENT_LOST: i32 = 2;
/// A label does not reach its fidelity. id: label.
pub const MW_DIAG_FIDELITY_NOT_REACHED: i32 = 3;
/// A sub-mesh has a non-manifold edge or vertex. id: label.
pub const MW_DIAG_NON_MANIFOLD_MESH: i32 = 4;
/// A sub-mesh has other components than its label. id: label, how many more, negative where it joins some.
pub const MW_DIAG_DISCONNECTED_MESH: i32 = 5;
/// Voxels were relabelled by the clean-up. id: label, voxels.
pub const MW_DIAG_VOXELS_RELABELLED: i32 = 6;
/// Smoothing could not improve the mesh, or stopped early.
pub const MW_DIAG_SMOOTHING_STOPPED: i32 = 7;
/// The image border cuts a label. id: label.
pub const MW_DIAG_LABEL_AT_IMAGE_BORDER: i32 = 8;
/// A sub-mesh has other tunnels, cavities or pieces than its label. id: label, difference of the Euler numbers.
pub const MW_DIAG_OTHER_TOPOLOGY: i32 = 9;
/// A surface edge with one triangle. id: its points.
pub const MW_DIAG_OPEN_EDGE: i32 = 20;
/// A surface edge with three or more triangles where that is not allowed. id: its points.
pub const MW_DIAG_NON_MANIFOLD_EDGE: i32 = 21;
/// Two triangles with the same points. id: the triangles.
pub const MW_DIAG_DUPLICATE_TRIANGLE: i32 = 22;
/// A triangle of zero area. id: the triangle.
pub const MW_DIAG_DEGENERATE_TRIANGLE: i32 = 23;
/// A triangle was turned over to agree with its component. id: the triangle.
pub const MW_DIAG_INCONSISTENT_ORIENTATION: i32 = 24;
/// Two triangles intersect. id: the triangles.
pub const MW_DIAG_INTERSECTING_TRIANGLES: i32 = 25;
/// Two points almost touch. id: the points.
pub const MW_DIAG_NEARLY_COINCIDENT_POINTS: i32 = 26;
/// Two points are equal and were merged. id: the points.
pub const MW_DIAG_MERGED_POINTS: i32 = 27;
/// A coordinate is NaN or infinite. id: the point.
pub const MW_DIAG_NON_FINITE_COORDINATE: i32 = 28;
/// A point index out of range. id: the triangle, the index.
pub const MW_DIAG_INDEX_OUT_OF_RANGE: i32 = 29;
/// All points lie on a point, a line or a plane.
pub const MW_DIAG_DEGENERATE_POINT_SET: i32 = 30;
/// A point that was added stays in the volume. id: the point.
pub const MW_DIAG_STEINER_POINT: i32 = 31;
/// A boundary edge or triangle could not be recovered. id: its points, or the triangle.
pub const MW_DIAG_NOT_RECOVERED: i32 = 32;
/// A region of the domain. id: its label, its cells.
pub const MW_DIAG_REGION: i32 = 33;
/// A point that no triangle uses. id: the point.
pub const MW_DIAG_UNUSED_POINT: i32 = 34;
/// A cell stays bad because the input's own angles force it. id: the cell.
pub const MW_DIAG_FORCED_BAD_ELEMENT: i32 = 35;
/// A hole or region point lies in no bounded region. id: its number.
pub const MW_DIAG_SEED_OUTSIDE: i32 = 36;
/// Blocks without a counterpart. id: how many.
pub const MW_DIAG_MISSING_CORRESPONDENCE: i32 = 50;
/// A solver stopped before its tolerance. id: iterations.
pub const MW_DIAG_NOT_CONVERGED: i32 = 51;
/// The displacement field folds. id: how many voxels.
pub const MW_DIAG_FOLDED_FIELD: i32 = 52;
/// Anything without a code of its own; the text says it.
pub const MW_DIAG_OTHER: i32 = 99;

/// The mesh of the last run. It shares the data: no copy, and it outlives the job.
///
/// @param job  a job
/// @param out  receives the mesh, null after an error; destroy it with mw_mesh_destroy
/// @return MW_OK, MW_E_ARG (null pointer), MW_E_STATE (no run yet, the last run failed or made no mesh)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_take_mesh(job: *mut mw_job, out: *mut *mut mw_mesh) -> mw_status {
    // SAFETY: the C caller's promises about the handle and `out`.
    guard(|| unsafe { give(out, || with_job(job, |state| state.results.take_mesh(None))) })
}

/// A mesh that the last run made beside its result, by name.
///
/// @param job   a job
/// @param name  its name
/// @param out   receives the mesh, null after an error; destroy it with mw_mesh_destroy
/// @return MW_OK, MW_E_ARG (null pointer; no mesh of this name, the text lists the names), MW_E_STATE (no results)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_take_named_mesh(
    job: *mut mw_job,
    name: *const c_char,
    out: *mut *mut mw_mesh,
) -> mw_status {
    let take = || {
        // SAFETY: the C caller's promises about the string and the handle.
        let name = unsafe { text(name, "name") }?;
        // SAFETY: as above.
        unsafe { with_job(job, |state| state.results.take_mesh(Some(name))) }
    };
    // SAFETY: the C caller's promise about `out`.
    guard(|| unsafe { give(out, take) })
}

/// An image that the last run made. A registration makes "displacement" (3 components, LPS mm, from points of the fixed
/// image to the moving image), "inverse" and "warped".
///
/// @param job   a job
/// @param name  its name
/// @param out   receives the image, null after an error; destroy it with mw_image_destroy
/// @return MW_OK, MW_E_ARG (null pointer; no image of this name, the text lists the names), MW_E_STATE (no results)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_take_image(
    job: *mut mw_job,
    name: *const c_char,
    out: *mut *mut mw_image,
) -> mw_status {
    let take = || {
        // SAFETY: the C caller's promises about the string and the handle.
        let name = unsafe { text(name, "name") }?;
        // SAFETY: as above.
        unsafe { with_job(job, |state| state.results.take_image(name)) }
    };
    // SAFETY: the C caller's promise about `out`.
    guard(|| unsafe { give(out, take) })
}

/// An array that the last run made, such as a registration's "source_points", "target_points" (3 components, LPS mm),
/// "similarity", "rejected" (one per pair of points) and "rigid" (16 numbers, 4 x 4, row-major).
///
/// @param job         a job
/// @param name        its name
/// @param type        receives MW_TYPE_I32, MW_TYPE_I64 or MW_TYPE_F64
/// @param components  receives the number of values per row
/// @param rows        receives the number of rows
/// @param data        receives the values, row-major; valid until the job runs again or is destroyed
/// @return MW_OK, MW_E_ARG (null pointer; no array of this name, the text lists the names), MW_E_STATE (no results)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_array(
    job: *const mw_job,
    name: *const c_char,
    r#type: *mut mw_type,
    components: *mut i32,
    rows: *mut i64,
    data: *mut *const c_void,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promise about the string.
        let name = unsafe { text(name, "name") }?;
        // SAFETY: the C caller's promises about the handle and the outputs.
        unsafe {
            with_job(job, |state| {
                state.results.check()?;
                let arrays = &state.results.arrays;
                let array = arrays.iter().find(|array| array.name == name);
                let array =
                    array.ok_or_else(|| no_such("array", name, arrays.iter().map(|array| array.name.as_str())))?;
                let (kind, values) = view(&array.data);
                write(r#type, kind, "type")?;
                write(components, array.components as i32, "components")?;
                write(rows, (array.data.len() / array.components.max(1)) as i64, "rows")?;
                write(data, values, "data")
            })
        }
    })
}

/// A figure of the last run by name, such as "time.total" (s), "memory.peak" (bytes), "mesh.tets",
/// "quality.min_dihedral" (degrees), "label.3.volume" (mm^3).
///
/// @return MW_OK, MW_E_ARG (null pointer, no figure of this name), MW_E_STATE (no results)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_stat(job: *const mw_job, name: *const c_char, out: *mut f64) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promise about the string.
        let name = unsafe { text(name, "name") }?;
        let find = |results: &Results| {
            results.check()?;
            let value = results.statistics.value(name);
            value.ok_or_else(|| Error::argument("name", format!("the run has no figure '{name}'")))
        };
        // SAFETY: the C caller's promises about the handle and the output.
        unsafe { write(out, with_job(job, |state| find(&state.results))?, "out") }
    })
}

/// Number of figures of the last run; 0 without results or for null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_stat_count(job: *const mw_job) -> i64 {
    // SAFETY: the C caller's promise about the handle.
    guard_value(0, || unsafe { with_job(job, |state| Ok(state.results.statistic_names.len() as i64)) })
}

/// A figure of the last run by position, in the order in which they were made.
///
/// @param job    a job
/// @param index  from 0
/// @param out    receives name and value; set its struct_size before
/// @return MW_OK, MW_E_ARG (null pointer, index out of range, struct_size too small), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_stat_get(job: *const mw_job, index: i64, out: *mut mw_stat) -> mw_status {
    let find = |results: &Results| {
        let position = usize::try_from(index).ok().filter(|&i| i < results.statistic_names.len());
        let position = position.ok_or_else(|| Error::argument("index", format!("{index} is out of range")))?;
        let name = results.statistic_names[position].as_ptr();
        Ok(mw_stat { struct_size: STAT_SIZE, name, value: results.statistics.entries()[position].1 })
    };
    // SAFETY: the C caller's promises about the handle and the struct.
    guard(|| unsafe { write_sized(out, &with_job(job, |state| find(&state.results))?, STAT_SIZE, "out") })
}

/// Number of findings of the last run, also of one that failed; 0 before a run or for null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_diag_count(job: *const mw_job) -> i64 {
    // SAFETY: the C caller's promise about the handle.
    guard_value(0, || unsafe { with_job(job, |state| Ok(state.results.findings.len() as i64)) })
}

/// A finding of the last run, also of one that failed: every open edge, every intersecting pair, every lost label.
///
/// @param job    a job
/// @param index  from 0
/// @param out    receives the finding; set its struct_size before
/// @return MW_OK, MW_E_ARG (null pointer, index out of range, struct_size too small), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_job_diag_get(job: *const mw_job, index: i64, out: *mut mw_diag) -> mw_status {
    let find = |results: &Results| {
        let entry = usize::try_from(index).ok().and_then(|i| results.findings.get(i));
        let (finding, text) = entry.ok_or_else(|| Error::argument("index", format!("{index} is out of range")))?;
        Ok(mw_diag {
            struct_size: DIAG_SIZE,
            code: finding.code as i32,
            severity: finding.severity as i32,
            id: finding.ids,
            xyz: finding.point,
            text: text.as_ptr(),
        })
    };
    // SAFETY: the C caller's promises about the handle and the struct.
    guard(|| unsafe { write_sized(out, &with_job(job, |state| find(&state.results))?, DIAG_SIZE, "out") })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::{FindingCode, Severity};

    #[test]
    fn codes_agree_with_the_library() {
        let pairs = [
            (MW_DIAG_LABEL_LOST, FindingCode::LabelLost),
            (MW_DIAG_COMPONENT_LOST, FindingCode::ComponentLost),
            (MW_DIAG_FIDELITY_NOT_REACHED, FindingCode::FidelityNotReached),
            (MW_DIAG_NON_MANIFOLD_MESH, FindingCode::NonManifoldMesh),
            (MW_DIAG_DISCONNECTED_MESH, FindingCode::DisconnectedMesh),
            (MW_DIAG_VOXELS_RELABELLED, FindingCode::VoxelsRelabelled),
            (MW_DIAG_SMOOTHING_STOPPED, FindingCode::SmoothingStopped),
            (MW_DIAG_LABEL_AT_IMAGE_BORDER, FindingCode::LabelAtImageBorder),
            (MW_DIAG_OTHER_TOPOLOGY, FindingCode::OtherTopology),
            (MW_DIAG_OPEN_EDGE, FindingCode::OpenEdge),
            (MW_DIAG_NON_MANIFOLD_EDGE, FindingCode::NonManifoldEdge),
            (MW_DIAG_DUPLICATE_TRIANGLE, FindingCode::DuplicateTriangle),
            (MW_DIAG_DEGENERATE_TRIANGLE, FindingCode::DegenerateTriangle),
            (MW_DIAG_INCONSISTENT_ORIENTATION, FindingCode::InconsistentOrientation),
            (MW_DIAG_INTERSECTING_TRIANGLES, FindingCode::IntersectingTriangles),
            (MW_DIAG_NEARLY_COINCIDENT_POINTS, FindingCode::NearlyCoincidentPoints),
            (MW_DIAG_MERGED_POINTS, FindingCode::MergedPoints),
            (MW_DIAG_NON_FINITE_COORDINATE, FindingCode::NonFiniteCoordinate),
            (MW_DIAG_INDEX_OUT_OF_RANGE, FindingCode::IndexOutOfRange),
            (MW_DIAG_DEGENERATE_POINT_SET, FindingCode::DegeneratePointSet),
            (MW_DIAG_STEINER_POINT, FindingCode::SteinerPoint),
            (MW_DIAG_NOT_RECOVERED, FindingCode::NotRecovered),
            (MW_DIAG_REGION, FindingCode::Region),
            (MW_DIAG_UNUSED_POINT, FindingCode::UnusedPoint),
            (MW_DIAG_FORCED_BAD_ELEMENT, FindingCode::ForcedBadElement),
            (MW_DIAG_SEED_OUTSIDE, FindingCode::SeedOutside),
            (MW_DIAG_MISSING_CORRESPONDENCE, FindingCode::MissingCorrespondence),
            (MW_DIAG_NOT_CONVERGED, FindingCode::NotConverged),
            (MW_DIAG_FOLDED_FIELD, FindingCode::FoldedField),
            (MW_DIAG_OTHER, FindingCode::Other),
        ];
        for (number, code) in pairs {
            assert_eq!(number, code as i32, "{code:?}");
        }
        assert_eq!(MW_SEVERITY_ERROR, Severity::Error as i32);
    }
}
