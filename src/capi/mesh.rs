//! Meshes: zero-copy views of a finished mesh, reading, writing, checking.

use std::ffi::{CString, c_char, c_void};
use std::sync::Arc;

use super::context::{mw_context, shared_context};
use super::guard::{guard, guard_value, to_c_string};
use super::handles::{borrow, destroy, give, write};
use super::image::{MW_SPACE_LPS, MW_SPACE_RAS, MW_TYPE_F64, MW_TYPE_I32, MW_TYPE_I64, mw_type};
use super::slices::{path, slice, slice_mut, text, write_sized};
use super::status::mw_status;
use super::surface::{to_points, to_vertex};
use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::io::{self, Compression, Encoding, MeshFormat, Surfaces, WriteOptions};
use crate::mesh::mixed_mesh::{ArrayData, MixedMesh, NamedArray, Space};
use crate::mesh::quality::{ElementQuality, element_quality};
use crate::mesh::surface_mesh::Patch;
use crate::mesh::validation::check_mixed_mesh;

/// A finished mesh. It never changes: any number of threads may read it. It outlives the job and the context it came
/// from. Every array that a mw_mesh_ function hands out belongs to the mesh, stays valid until mw_mesh_destroy and must
/// not be written or freed.
pub struct mw_mesh {
    mesh: Arc<MixedMesh>,
    patches: Vec<Patch>,
    point_arrays: Vec<CString>,
    cell_arrays: Vec<CString>,
}

impl mw_mesh {
    /// A handle's content.
    pub fn new(mesh: Arc<MixedMesh>, patches: Vec<Patch>) -> Self {
        let names = |arrays: &[NamedArray]| arrays.iter().map(|a| to_c_string(&a.name)).collect();
        Self { point_arrays: names(&mesh.point_data), cell_arrays: names(&mesh.element_data), mesh, patches }
    }

    /// The mesh, shared.
    pub fn shared(&self) -> Arc<MixedMesh> {
        Arc::clone(&self.mesh)
    }

    fn arrays(&self, on_cells: i32) -> (&[NamedArray], &[CString]) {
        if on_cells != 0 {
            (&self.mesh.element_data, &self.cell_arrays)
        } else {
            (&self.mesh.point_data, &self.point_arrays)
        }
    }
}

/// The surface of a mesh: triangles and quadrilaterals around and between the labels. Set `struct_size` before the
/// call. Arrays over faces list the triangles first, then the quadrilaterals.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct mw_boundary {
    /// sizeof(mw_boundary)
    pub struct_size: usize,
    /// Number of triangles.
    pub triangle_count: i64,
    /// triangle_count x 3 point indices, row-major, outward from the inner label.
    pub triangles: *const i32,
    /// Number of quadrilaterals; 0 for tetrahedral meshes.
    pub quad_count: i64,
    /// quad_count x 4 point indices, row-major, outward from the inner label.
    pub quads: *const i32,
    /// Per face the inner and the outer label; 0 is outside.
    pub labels: *const i32,
    /// Per face the inner and the outer cell; -1 for none.
    pub cells: *const i64,
    /// Per face the patch number of the input surface; null where there was none.
    pub patches: *const i32,
}

const BOUNDARY_SIZE: usize = size_of::<mw_boundary>();

/// A pointer for C: null for an empty array.
fn pointer<T, U>(values: &[T]) -> *const U {
    if values.is_empty() { std::ptr::null() } else { values.as_ptr().cast() }
}

/// Runs a function that reads a mesh and cannot fail but for a null handle.
///
/// # Safety
/// As [`borrow`].
unsafe fn read<T: Copy>(mesh: *const mw_mesh, fallback: T, body: impl FnOnce(&MixedMesh) -> T) -> T {
    // SAFETY: as the caller promises.
    guard_value(fallback, || Ok(body(&unsafe { borrow(mesh, "mesh") }?.mesh)))
}

/// Number of points; 0 for null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_point_count(mesh: *const mw_mesh) -> i64 {
    // SAFETY: the C caller's promise about the handle.
    unsafe { read(mesh, 0, |m| m.points.len() as i64) }
}

/// Number of cells; 0 for null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_cell_count(mesh: *const mw_mesh) -> i64 {
    // SAFETY: the C caller's promise about the handle.
    unsafe { read(mesh, 0, |m| m.types.len() as i64) }
}

/// Coordinates: point_count x 3, row-major, mm, in the frame of mw_mesh_space; null for an empty mesh or null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_points(mesh: *const mw_mesh) -> *const f64 {
    // SAFETY: the C caller's promise about the handle.
    unsafe { read(mesh, std::ptr::null(), |m| pointer(bytemuck::cast_slice::<_, f64>(&m.points))) }
}

/// Tetrahedra: cell_count x 4 point indices, row-major; null when the mesh has other cells, is empty, or null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_tets(mesh: *const mw_mesh) -> *const i32 {
    let tets = |m: &MixedMesh| if m.is_all_tets() { pointer(&m.connectivity) } else { std::ptr::null() };
    // SAFETY: the C caller's promise about the handle.
    unsafe { read(mesh, std::ptr::null(), tets) }
}

/// Type of each cell, VTK's numbers: 10 tetrahedron, 12 hexahedron, 13 wedge, 14 pyramid, 24 tetrahedron with 10 nodes,
/// 25 hexahedron with 20 nodes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_cell_types(mesh: *const mw_mesh) -> *const u8 {
    // SAFETY: the C caller's promise about the handle.
    unsafe { read(mesh, std::ptr::null(), |m| pointer(&m.types)) }
}

/// Where each cell begins in mw_mesh_connectivity: cell_count + 1 numbers, the last one its length.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_offsets(mesh: *const mw_mesh) -> *const i64 {
    // SAFETY: the C caller's promise about the handle.
    unsafe { read(mesh, std::ptr::null(), |m| pointer(&m.offsets)) }
}

/// Point indices of all cells, from 0, in VTK's node order.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_connectivity(mesh: *const mw_mesh) -> *const i32 {
    // SAFETY: the C caller's promise about the handle.
    unsafe { read(mesh, std::ptr::null(), |m| pointer(&m.connectivity)) }
}

/// Label of each cell: the label values of the input.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_labels(mesh: *const mw_mesh) -> *const i32 {
    // SAFETY: the C caller's promise about the handle.
    unsafe { read(mesh, std::ptr::null(), |m| pointer(&m.labels)) }
}

/// Frame of the coordinates: MW_SPACE_LPS, MW_SPACE_RAS, or 0 where there is no anatomical frame.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_space(mesh: *const mw_mesh) -> i32 {
    let number = |m: &MixedMesh| match m.space {
        Space::Lps => MW_SPACE_LPS,
        Space::Ras => MW_SPACE_RAS,
        Space::Unspecified => 0,
    };
    // SAFETY: the C caller's promise about the handle.
    unsafe { read(mesh, 0, number) }
}

/// The surface around and between the labels.
///
/// @param mesh  a mesh
/// @param out   receives counts and arrays; set its struct_size before
/// @return MW_OK, MW_E_ARG (null pointer, struct_size too small)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_boundary(mesh: *const mw_mesh, out: *mut mw_boundary) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promise about the handle.
        let boundary = &unsafe { borrow(mesh, "mesh") }?.mesh.boundary;
        let value = mw_boundary {
            struct_size: BOUNDARY_SIZE,
            triangle_count: boundary.triangles.len() as i64,
            triangles: pointer(&boundary.triangles),
            quad_count: boundary.quads.len() as i64,
            quads: pointer(&boundary.quads),
            labels: pointer(&boundary.labels),
            cells: pointer(&boundary.elements),
            patches: pointer(&boundary.patches),
        };
        // SAFETY: the C caller's promise about the struct.
        unsafe { write_sized(out, &value, BOUNDARY_SIZE, "out") }
    })
}

/// Number of named arrays on points (`on_cells` 0) or cells (1); 0 for null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_array_count(mesh: *const mw_mesh, on_cells: i32) -> i32 {
    // SAFETY: the C caller's promise about the handle.
    guard_value(0, || Ok(unsafe { borrow(mesh, "mesh") }?.arrays(on_cells).0.len() as i32))
}

/// Name of a named array, from 0; null where there is none.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_array_name(mesh: *const mw_mesh, on_cells: i32, index: i32) -> *const c_char {
    guard_value(std::ptr::null(), || {
        // SAFETY: the C caller's promise about the handle.
        let (_, names) = unsafe { borrow(mesh, "mesh") }?.arrays(on_cells);
        let name = usize::try_from(index).ok().and_then(|index| names.get(index));
        name.map(|name| name.as_ptr()).ok_or_else(|| Error::argument("index", format!("{index} of {}", names.len())))
    })
}

/// A named array on points or cells, such as "displacement" on points.
///
/// @param mesh        a mesh
/// @param on_cells    0 for an array on points, 1 on cells
/// @param name        its name
/// @param type        receives MW_TYPE_I32, MW_TYPE_I64 or MW_TYPE_F64
/// @param components  receives the number of values per point or cell
/// @param data        receives the values, row-major
/// @return MW_OK, MW_E_ARG (null pointer, no array of this name)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_array(
    mesh: *const mw_mesh,
    on_cells: i32,
    name: *const c_char,
    r#type: *mut mw_type,
    components: *mut i32,
    data: *mut *const c_void,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handle and the string.
        let (mesh, name) = unsafe { (borrow(mesh, "mesh")?, text(name, "name")?) };
        let array = mesh.arrays(on_cells).0.iter().find(|array| array.name == name);
        let array = array.ok_or_else(|| Error::argument("name", format!("the mesh has no array '{name}'")))?;
        let (kind, values) = view(&array.data);
        // SAFETY: the C caller's promises about the outputs.
        unsafe {
            write(r#type, kind, "type")?;
            write(components, array.components as i32, "components")?;
            write(data, values, "data")
        }
    })
}

/// Type and values of an array, for C.
pub fn view(data: &ArrayData) -> (mw_type, *const c_void) {
    match data {
        ArrayData::Int(values) => (MW_TYPE_I32, pointer(values)),
        ArrayData::Long(values) => (MW_TYPE_I64, pointer(values)),
        ArrayData::Real(values) => (MW_TYPE_F64, pointer(values)),
    }
}

/// Copies mw_mesh_connectivity as 64-bit numbers, VTK's vtkIdType.
///
/// @param mesh      a mesh
/// @param out       receives the numbers
/// @param capacity  how many fit; mw_mesh_offsets(mesh)[cell_count] are needed
/// @return MW_OK, MW_E_ARG (null pointer, too small)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_copy_connectivity_i64(
    mesh: *const mw_mesh,
    out: *mut i64,
    capacity: i64,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handle and the array.
        let (mesh, out) = unsafe { (borrow(mesh, "mesh")?, slice_mut(out, capacity, "out")?) };
        let connectivity = &mesh.mesh.connectivity;
        let out = fitting(out, connectivity.len())?;
        out.iter_mut().zip(connectivity).for_each(|(to, from)| *to = i64::from(from.0));
        Ok(())
    })
}

/// The part of `out` that is written.
fn fitting<T>(out: &mut [T], needed: usize) -> Result<&mut [T]> {
    let capacity = out.len();
    out.get_mut(..needed).ok_or_else(|| Error::argument("capacity", format!("{capacity} is too small for {needed}")))
}

/// Computes a measure of every cell, with the definitions of VTK's vtkMeshQuality.
///
/// @param mesh      a mesh
/// @param measure   "min_dihedral", "max_dihedral" (degrees), "radius_ratio" (circumradius over 3 inradii, 1 is best),
///                  "mean_ratio", "scaled_jacobian" (1 is best); NaN where a kind of cell has no such measure
/// @param out       receives one number per cell
/// @param capacity  how many fit; mw_mesh_cell_count(mesh) are needed
/// @return MW_OK, MW_E_ARG (null pointer, unknown measure, too small)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_quality(
    mesh: *const mw_mesh,
    measure: *const c_char,
    out: *mut f64,
    capacity: i64,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handle, the string and the array.
        let (mesh, measure, out) =
            unsafe { (borrow(mesh, "mesh")?, text(measure, "measure")?, slice_mut(out, capacity, "out")?) };
        let select = measure_of(measure)?;
        let mesh = &mesh.mesh;
        let out = fitting(out, mesh.element_count())?;
        for (index, value) in out.iter_mut().enumerate() {
            let (kind, nodes) = mesh.element(index);
            let mut corners = [glam::DVec3::ZERO; 8];
            let count = kind.corner_count();
            corners.iter_mut().zip(&nodes[..count]).for_each(|(c, v)| *c = mesh.points[v.index()]);
            *value = select(&element_quality(kind, &corners[..count]));
        }
        Ok(())
    })
}

fn measure_of(name: &str) -> Result<fn(&ElementQuality) -> f64> {
    Ok(match name {
        "min_dihedral" => |q| q.min_dihedral,
        "max_dihedral" => |q| q.max_dihedral,
        "radius_ratio" => |q| q.radius_ratio,
        "mean_ratio" => |q| q.mean_ratio,
        "scaled_jacobian" => |q| q.scaled_jacobian,
        _ => {
            let known = "min_dihedral, max_dihedral, radius_ratio, mean_ratio, scaled_jacobian";
            return Err(Error::argument("measure", format!("'{name}' is none of {known}")));
        }
    })
}

/// Checks that a mesh is valid: every cell positively oriented (exactly), no duplicate, no face with three cells.
/// Meshes that a job returns are; this is for meshes from elsewhere. Runs on one thread.
///
/// @return MW_OK, MW_E_ARG, MW_E_INPUT (the text names the first fault)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_check(mesh: *const mw_mesh) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promise about the handle.
        let mesh = unsafe { borrow(mesh, "mesh") }?;
        // A mesh outlives its context. Outside of any pool the check would start rayon's global one, whose threads never end.
        let context = RunContext::with_threads(1)?;
        context.install(|| check_mixed_mesh(&mesh.mesh)).map_err(|violation| Error::input(violation.to_string()))
    })
}

/// Makes a mesh of arrays, which are copied.
///
/// @param context       a context
/// @param point_count   number of points
/// @param points        point_count x 3 coordinates, row-major, LPS mm
/// @param cell_count    number of cells
/// @param types         cell_count VTK cell types, as in mw_mesh_cell_types
/// @param offsets       cell_count + 1 positions in connectivity, the first 0
/// @param connectivity  point indices of all cells, from 0, VTK's node order
/// @param labels        cell_count labels; null for all 1
/// @param out           receives the mesh, null after an error; destroy it with mw_mesh_destroy
/// @return MW_OK, MW_E_ARG (null pointer, unknown type, offsets that do not match, index out of range), MW_E_MEMORY
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_create(
    context: *mut mw_context,
    point_count: i64,
    points: *const f64,
    cell_count: i64,
    types: *const u8,
    offsets: *const i64,
    connectivity: *const i32,
    labels: *const i32,
    out: *mut *mut mw_mesh,
) -> mw_status {
    let make = || {
        // SAFETY: the C caller's promises about the handle and the arrays.
        let (_, points, types) = unsafe {
            (shared_context(context)?, slice(points, point_count, 3, "points")?, slice(types, cell_count, 1, "types")?)
        };
        let offset_count = cell_count.checked_add(1).ok_or_else(|| Error::argument("cell_count", "too large"))?;
        // SAFETY: as above.
        let offsets = unsafe { slice(offsets, offset_count, 1, "offsets") }?;
        let entries = offsets.last().copied().unwrap_or(0);
        // SAFETY: as above; the last offset is the length, as documented.
        let connectivity = unsafe { slice(connectivity, entries, 1, "connectivity") }?;
        let labels = if labels.is_null() {
            vec![1; types.len()]
        } else {
            // SAFETY: as above.
            unsafe { slice(labels, cell_count, 1, "labels") }?.to_vec()
        };
        let mesh = MixedMesh {
            points: to_points(points),
            types: types.to_vec(),
            offsets: offsets.to_vec(),
            connectivity: connectivity.iter().map(|&v| to_vertex(v)).collect(),
            labels,
            ..MixedMesh::default()
        };
        mesh.check_shape()?;
        Ok(mw_mesh::new(Arc::new(mesh), Vec::new()))
    };
    // SAFETY: the C caller's promise about `out`.
    guard(|| unsafe { give(out, make) })
}

/// Reads a mesh file, by the ending of its name: .vtu .vtk .msh .mesh .ugrid and others.
///
/// @param context  a context
/// @param path     file name, UTF-8
/// @param out      receives the mesh, null after an error; destroy it with mw_mesh_destroy
/// @return MW_OK, MW_E_ARG, MW_E_IO, MW_E_FORMAT, MW_E_UNSUPPORTED (unknown ending), MW_E_MEMORY
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_read(
    context: *mut mw_context,
    path: *const c_char,
    out: *mut *mut mw_mesh,
) -> mw_status {
    let make = || {
        // SAFETY: the C caller's promises about the handle and the string.
        let (_, path) = unsafe { (shared_context(context)?, self::path(path)?) };
        Ok(mw_mesh::new(Arc::new(io::read_mesh(&path)?), Vec::new()))
    };
    // SAFETY: the C caller's promise about `out`.
    guard(|| unsafe { give(out, make) })
}

/// Writes a mesh. The file appears whole or not at all.
///
/// @param mesh     a mesh
/// @param path     file name, UTF-8; its ending decides the format: .vtu .vtk .msh .mesh .meshb .ugrid .b8.ugrid
///                 .lb8.ugrid .su2, or CASE/NAME.foam for an OpenFOAM case in the folder CASE
/// @param options  null, or settings as "key=value" with ';' between them: "format=" vtu, vtk42, vtk51, msh22, msh41,
///                 medit, meditb, ugrid, b8.ugrid, lb8.ugrid, su2, openfoam; "encoding=" binary, ascii;
///                 "compression=" none, zlib; "space=" lps, ras, none; "surfaces=" include, omit
/// @return MW_OK, MW_E_ARG (null pointer, unknown setting), MW_E_IO, MW_E_UNSUPPORTED (unknown ending, a kind of cell
///         that the format has not)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_write(mesh: *const mw_mesh, path: *const c_char, options: *const c_char) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handle and the string.
        let (mesh, path) = unsafe { (borrow(mesh, "mesh")?, self::path(path)?) };
        // SAFETY: as above.
        let options = if options.is_null() { "" } else { unsafe { text(options, "options") }? };
        let options = WriteOptions { patches: mesh.patches.clone(), ..write_options(options)? };
        io::write_mesh(&mesh.mesh, &path, &options)
    })
}

fn write_options(text: &str) -> Result<WriteOptions> {
    let mut options = WriteOptions::default();
    for setting in text.split(';').map(str::trim).filter(|s| !s.is_empty()) {
        let unknown = || Error::argument("options", format!("unknown setting '{setting}'"));
        let (key, value) = setting.split_once('=').ok_or_else(unknown)?;
        let value = value.trim().to_lowercase();
        match (key.trim(), value.as_str()) {
            ("format", name) => options.format = Some(format_of(name).ok_or_else(unknown)?),
            ("encoding", "binary") => options.encoding = Encoding::Binary,
            ("encoding", "ascii") => options.encoding = Encoding::Ascii,
            ("compression", "none") => options.compression = Compression::None,
            ("compression", "zlib") => options.compression = Compression::Zlib,
            ("space", "lps") => options.space = Some(Space::Lps),
            ("space", "ras") => options.space = Some(Space::Ras),
            ("space", "none") => options.space = Some(Space::Unspecified),
            ("surfaces", "include") => options.surfaces = Surfaces::Include,
            ("surfaces", "omit") => options.surfaces = Surfaces::Omit,
            _ => return Err(unknown()),
        }
    }
    Ok(options)
}

fn format_of(name: &str) -> Option<MeshFormat> {
    Some(match name {
        "vtu" => MeshFormat::Vtu,
        "vtk42" => MeshFormat::Vtk42,
        "vtk51" => MeshFormat::Vtk51,
        "msh22" => MeshFormat::Msh22,
        "msh41" => MeshFormat::Msh41,
        "medit" => MeshFormat::Medit,
        "meditb" => MeshFormat::MeditBinary,
        "ugrid" => MeshFormat::Ugrid,
        "b8.ugrid" => MeshFormat::UgridBig,
        "lb8.ugrid" => MeshFormat::UgridLittle,
        "su2" => MeshFormat::Su2,
        "openfoam" => MeshFormat::OpenFoam,
        _ => return None,
    })
}

/// Destroys a mesh and every array it handed out; null is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_mesh_destroy(mesh: *mut mw_mesh) {
    guard(|| {
        // SAFETY: the C caller's promise about the handle.
        unsafe { destroy(mesh) };
        Ok(())
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn write_settings_are_read_and_unknown_ones_refused() {
        let options = write_options("encoding=ascii; space=RAS;format=vtk42;").unwrap();
        assert_eq!(options.encoding, Encoding::Ascii);
        assert_eq!(options.space, Some(Space::Ras));
        assert_eq!(options.format, Some(MeshFormat::Vtk42));
        for bad in ["ascii", "encoding=text", "colour=red", "format=docx"] {
            assert!(write_options(bad).is_err(), "{bad}");
        }
    }
}
