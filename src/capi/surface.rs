//! Surfaces: triangulations with patches, regions and holes.

use std::ffi::c_char;
use std::sync::{Arc, Mutex};

use glam::DVec3;

use super::context::{mw_context, shared_context};
use super::guard::guard;
use super::handles::{borrow, destroy, give, lock};
use super::slices::{path, slice, text};
use super::status::mw_status;
use crate::error::{Error, Result};
use crate::index::VertexId;
use crate::io;
use crate::mesh::surface_mesh::{PatchRole, RegionSeed, SurfaceMesh};

/// A surface triangulation: one or several closed components, nested, with internal sheets where wanted. Used by one
/// thread at a time while patches, regions and holes are set; a job keeps the state it was given.
pub struct mw_surface {
    mesh: Mutex<Arc<SurfaceMesh>>,
}

impl mw_surface {
    /// The surface as it is now.
    ///
    /// # Errors
    /// [`Error::State`] while another thread changes it.
    pub fn snapshot(&self) -> Result<Arc<SurfaceMesh>> {
        Ok(Arc::clone(&*lock(&self.mesh, "surface")?))
    }

    /// A handle's content.
    pub fn new(mesh: SurfaceMesh) -> Self {
        Self { mesh: Mutex::new(Arc::new(mesh)) }
    }

    fn change(&self, change: impl FnOnce(&mut SurfaceMesh) -> Result<()>) -> Result<()> {
        change(Arc::make_mut(&mut *lock(&self.mesh, "surface")?))
    }
}

/// Rows of three coordinates as points.
pub fn to_points(xyz: &[f64]) -> Vec<DVec3> {
    xyz.as_chunks::<3>().0.iter().map(|&p| DVec3::from_array(p)).collect()
}

/// A C index as a vertex id; negative and other impossible ones become an id that no mesh has, so that the input check
/// names the triangle.
pub fn to_vertex(index: i32) -> VertexId {
    u32::try_from(index).map_or(VertexId::NONE, VertexId)
}

fn finite_point(point: &[f64], name: &str) -> Result<DVec3> {
    let point = DVec3::from_slice(point);
    if point.is_finite() { Ok(point) } else { Err(Error::argument(name, format!("{point} is not finite"))) }
}

/// Makes a surface of arrays, which are copied. Its geometry is checked when a job runs: every fault is then a finding.
///
/// @param context         a context
/// @param point_count     number of points
/// @param points          point_count x 3 coordinates, row-major, mm
/// @param triangle_count  number of triangles
/// @param triangles       triangle_count x 3 point indices, from 0, row-major
/// @param patches         triangle_count patch numbers; null for all 0
/// @param out             receives the surface, null after an error; destroy it with mw_surface_destroy
/// @return MW_OK, MW_E_ARG (null pointer, negative count), MW_E_MEMORY
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_surface_create(
    context: *mut mw_context,
    point_count: i64,
    points: *const f64,
    triangle_count: i64,
    triangles: *const i32,
    patches: *const i32,
    out: *mut *mut mw_surface,
) -> mw_status {
    let make = || {
        // SAFETY: the C caller's promises about the handle and the arrays.
        let (_, points, triangles) = unsafe {
            (
                shared_context(context)?,
                slice(points, point_count, 3, "points")?,
                slice(triangles, triangle_count, 3, "triangles")?,
            )
        };
        let facets = triangles.as_chunks::<3>().0.iter().map(|t| t.map(to_vertex)).collect();
        let mut mesh = SurfaceMesh::new(to_points(points), facets);
        if !patches.is_null() {
            // SAFETY: as above.
            mesh.facet_patches = unsafe { slice(patches, triangle_count, 1, "patches") }?.to_vec();
        }
        Ok(mw_surface::new(mesh))
    };
    // SAFETY: the C caller's promise about `out`.
    guard(|| unsafe { give(out, make) })
}

/// Reads a surface file: .stl .off .obj .ply .vtk .vtp .mesh .surf .poly .smesh, by the ending of its name.
///
/// @param context  a context
/// @param path     file name, UTF-8
/// @param out      receives the surface, null after an error; destroy it with mw_surface_destroy
/// @return MW_OK, MW_E_ARG, MW_E_IO, MW_E_FORMAT, MW_E_UNSUPPORTED (unknown ending), MW_E_MEMORY
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_surface_read(
    context: *mut mw_context,
    path: *const c_char,
    out: *mut *mut mw_surface,
) -> mw_status {
    let make = || {
        // SAFETY: the C caller's promises about the handle and the string.
        let (_, path) = unsafe { (shared_context(context)?, self::path(path)?) };
        Ok(mw_surface::new(io::read_surface(&path)?))
    };
    // SAFETY: the C caller's promise about `out`.
    guard(|| unsafe { give(out, make) })
}

/// Says what a patch is for.
///
/// @param surface  a surface
/// @param patch    patch number, as in mw_surface_create
/// @param role     "wall", "wall_bl", "symmetry", "farfield", "embedded" (or "transparent"), "source", "internal",
///                 "fixed", "inlet", "outlet"
/// @param name     name for files of flow solvers; null for none
/// @return MW_OK, MW_E_ARG (null pointer, unknown role), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_surface_set_patch(
    surface: *mut mw_surface,
    patch: i32,
    role: *const c_char,
    name: *const c_char,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handle and the strings.
        let (surface, role) = unsafe { (borrow(surface, "surface")?, text(role, "role")?) };
        let role = PatchRole::from_name(role)?;
        // SAFETY: as above.
        let name = if name.is_null() { "" } else { unsafe { text(name, "name") }? };
        surface.change(|mesh| {
            let record = mesh.patch_mut(patch);
            record.role = role;
            name.clone_into(&mut record.name);
            Ok(())
        })
    })
}

/// Gives the region around a point its label and, where wanted, its own largest edge length.
///
/// @param surface  a surface
/// @param point    3 coordinates strictly inside the region, mm
/// @param label    label of its elements
/// @param size     largest edge length in it, mm; 0 for no limit of its own
/// @return MW_OK, MW_E_ARG (null pointer, not finite, negative size), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_surface_add_region(
    surface: *mut mw_surface,
    point: *const f64,
    label: i32,
    size: f64,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handle and the array.
        let (surface, point) = unsafe { (borrow(surface, "surface")?, slice(point, 3, 1, "point")?) };
        let point = finite_point(point, "point")?;
        if !(size.is_finite() && size >= 0.0) {
            return Err(Error::argument("size", format!("{size} is not finite and at least 0")));
        }
        let size = (size > 0.0).then_some(size);
        surface.change(|mesh| {
            mesh.regions.push(RegionSeed { point, label, size });
            Ok(())
        })
    })
}

/// Leaves the cavity around a point empty.
///
/// @param surface  a surface
/// @param point    3 coordinates strictly inside the cavity, mm
/// @return MW_OK, MW_E_ARG (null pointer, not finite), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_surface_add_hole(surface: *mut mw_surface, point: *const f64) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handle and the array.
        let (surface, point) = unsafe { (borrow(surface, "surface")?, slice(point, 3, 1, "point")?) };
        let point = finite_point(point, "point")?;
        surface.change(|mesh| {
            mesh.holes.push(point);
            Ok(())
        })
    })
}

/// Destroys a surface; null is allowed. Jobs that were given it keep their state of it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_surface_destroy(surface: *mut mw_surface) {
    guard(|| {
        // SAFETY: the C caller's promise about the handle.
        unsafe { destroy(surface) };
        Ok(())
    });
}
