//! What a host says about element sizes: sources, a background mesh, a function.

use std::ffi::c_void;
use std::sync::{Arc, Mutex};

use glam::DVec3;

use super::context::{mw_context, shared_context};
use super::guard::{call_host, guard};
use super::handles::{borrow, destroy, give, lock};
use super::mesh::mw_mesh;
use super::slices::slice;
use super::status::mw_status;
use crate::error::{Error, Result};
use crate::mesh::sizing::{SizeSource, Sizing, SourceShape};

/// Element sizes for a surface job. Every part is an upper bound of the edge length; the smallest bound holds. Used by
/// one thread at a time while it is filled; a job keeps the state it was given.
pub struct mw_sizing {
    sizing: Mutex<Sizing>,
}

/// A size function: the largest edge length wanted at a point.
///
/// Called from several threads at once, on threads of the library: it must not change data without a lock of its own,
/// must not throw, must not call longjmp. `point` are 3 coordinates, mm; `size` is the edge length wanted so far, mm.
/// The run ends with MW_E_INPUT when the function returns a number that is not finite and positive.
pub type mw_size_fn = Option<unsafe extern "C" fn(user: *mut c_void, point: *const f64, size: f64) -> f64>;

/// Source of sizes: a point; 3 numbers.
pub const MW_SOURCE_POINT: i32 = 1;
/// Source of sizes: a segment; 6 numbers, its ends.
pub const MW_SOURCE_LINE: i32 = 2;
/// Source of sizes: an axis-aligned box with its inside; 6 numbers, smallest and largest corner.
pub const MW_SOURCE_BOX: i32 = 3;
/// Source of sizes: a ball with its inside; 4 numbers, centre and radius.
pub const MW_SOURCE_SPHERE: i32 = 4;

/// A host's function with its data.
struct HostFunction {
    function: unsafe extern "C" fn(*mut c_void, *const f64, f64) -> f64,
    user: *mut c_void,
}

// SAFETY: the header tells the host that the function is called from several threads at once.
unsafe impl Send for HostFunction {}
// SAFETY: as above.
unsafe impl Sync for HostFunction {}

impl HostFunction {
    fn call(&self, point: DVec3, size: f64) -> f64 {
        let point = point.to_array();
        // SAFETY: the host promised a function of this type, callable from any thread while a job holds the sizing.
        call_host(|| unsafe { (self.function)(self.user, point.as_ptr(), size) })
    }
}

impl mw_sizing {
    /// The sizing as it is now.
    ///
    /// # Errors
    /// [`Error::State`] while another thread changes it.
    pub fn snapshot(&self) -> Result<Sizing> {
        Ok(lock(&self.sizing, "sizing")?.clone())
    }

    /// Applies `change` when the outcome is usable.
    fn change(&self, change: impl FnOnce(&mut Sizing)) -> Result<()> {
        let mut sizing = lock(&self.sizing, "sizing")?;
        let mut changed = sizing.clone();
        change(&mut changed);
        changed.check()?;
        *sizing = changed;
        Ok(())
    }
}

fn shape_of(kind: i32, numbers: &[f64]) -> Result<SourceShape> {
    let point = |at: usize| DVec3::from_slice(&numbers[at..at + 3]);
    Ok(match (kind, numbers.len()) {
        (MW_SOURCE_POINT, 3) => SourceShape::Point(point(0)),
        (MW_SOURCE_LINE, 6) => SourceShape::Line(point(0), point(3)),
        (MW_SOURCE_BOX, 6) => SourceShape::Box(point(0), point(3)),
        (MW_SOURCE_SPHERE, 4) => SourceShape::Sphere(point(0), numbers[3]),
        (MW_SOURCE_POINT..=MW_SOURCE_SPHERE, n) => {
            return Err(Error::argument("count", format!("{n} numbers do not describe a source of kind {kind}")));
        }
        _ => return Err(Error::argument("kind", format!("{kind} is no MW_SOURCE_ number (1 to 4)"))),
    })
}

/// Makes a sizing without any bound.
///
/// @param context  a context
/// @param out      receives the sizing, null after an error; destroy it with mw_sizing_destroy
/// @return MW_OK, MW_E_ARG
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_sizing_create(context: *mut mw_context, out: *mut *mut mw_sizing) -> mw_status {
    let make = || {
        // SAFETY: the C caller's promise about the handle.
        unsafe { shared_context(context) }?;
        Ok(mw_sizing { sizing: Mutex::default() })
    };
    // SAFETY: the C caller's promise about `out`.
    guard(|| unsafe { give(out, make) })
}

/// Adds a source: edge length at most `size + decay * distance`.
///
/// @param sizing   a sizing
/// @param kind     MW_SOURCE_POINT, _LINE, _BOX or _SPHERE
/// @param numbers  coordinates and radius as the kind says, mm
/// @param count    how many numbers: 3, 6, 6 or 4
/// @param size     edge length at the source, mm, positive
/// @param decay    growth per millimetre of distance, at least 0
/// @return MW_OK, MW_E_ARG (null pointer, unknown kind, wrong count, not finite or positive), MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_sizing_add_source(
    sizing: *mut mw_sizing,
    kind: i32,
    numbers: *const f64,
    count: i32,
    size: f64,
    decay: f64,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handle and the array.
        let (sizing, numbers) = unsafe { (borrow(sizing, "sizing")?, slice(numbers, i64::from(count), 1, "numbers")?) };
        let shape = shape_of(kind, numbers)?;
        sizing.change(|sizing| sizing.sources.push(SizeSource { shape, size, decay }))
    })
}

/// Sets the size function.
///
/// @param sizing  a sizing
/// @param fn      the function; null for none
/// @param user    handed to the function as it is; alive until every job given the sizing is destroyed
/// @return MW_OK, MW_E_ARG, MW_E_STATE
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_sizing_set_function(
    sizing: *mut mw_sizing,
    r#fn: mw_size_fn,
    user: *mut c_void,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promise about the handle.
        let sizing = unsafe { borrow(sizing, "sizing") }?;
        let host = r#fn.map(|function| HostFunction { function, user });
        sizing.change(|sizing| match host {
            Some(host) => sizing.function = Some(Arc::new(move |point, size| host.call(point, size))),
            None => sizing.function = None,
        })
    })
}

/// Sets a background mesh with an edge length at each of its points, interpolated linearly between them; outside of the
/// mesh there is no bound.
///
/// @param sizing  a sizing
/// @param mesh    a mesh; kept
/// @param sizes   one edge length per point of the mesh, mm, positive
/// @param count   how many: mw_mesh_point_count(mesh)
/// @return MW_OK, MW_E_ARG (null pointer, wrong count, not finite or positive), MW_E_STATE, MW_E_MEMORY
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_sizing_set_background(
    sizing: *mut mw_sizing,
    mesh: *const mw_mesh,
    sizes: *const f64,
    count: i64,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promises about the handles and the array.
        let (sizing, mesh, sizes) =
            unsafe { (borrow(sizing, "sizing")?, borrow(mesh, "mesh")?, slice(sizes, count, 1, "sizes")?) };
        sizing.change(|sizing| sizing.background = Some((mesh.shared(), sizes.to_vec())))
    })
}

/// Destroys a sizing; null is allowed. Jobs that were given it keep their state of it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_sizing_destroy(sizing: *mut mw_sizing) {
    guard(|| {
        // SAFETY: the C caller's promise about the handle.
        unsafe { destroy(sizing) };
        Ok(())
    });
}
