//! Functions of the C interface leave no thread behind: a host can unload the library. Alone in its process, since it counts
//! the threads of that.
#![cfg(target_os = "linux")]
#![allow(unsafe_code)] // calls C functions

use std::ptr::null_mut;

use meshwright::capi::context::{mw_context, mw_context_create, mw_context_destroy};
use meshwright::capi::mesh::{mw_mesh, mw_mesh_check, mw_mesh_create, mw_mesh_destroy};
use meshwright::capi::status::MW_OK;

fn threads() -> usize {
    std::fs::read_dir("/proc/self/task").unwrap().count()
}

#[test]
fn checking_a_mesh_leaves_no_thread_behind() {
    let before = threads();
    let points = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let (types, offsets, connectivity) = ([10u8], [0i64, 4], [0i32, 1, 2, 3]);
    let (mut context, mut mesh): (*mut mw_context, *mut mw_mesh) = (null_mut(), null_mut());
    // SAFETY: the arrays have the stated lengths, and the handles are those that were just made.
    unsafe {
        assert_eq!(mw_context_create(1, &mut context), MW_OK);
        let (points, types, offsets) = (points.as_ptr(), types.as_ptr(), offsets.as_ptr());
        let made =
            mw_mesh_create(context, 4, points, 1, types, offsets, connectivity.as_ptr(), std::ptr::null(), &mut mesh);
        assert_eq!(made, MW_OK);
        mw_context_destroy(context);
        // A mesh outlives its context.
        assert_eq!(mw_mesh_check(mesh), MW_OK);
        mw_mesh_destroy(mesh);
    }
    // The system may list a thread for a moment after it was joined.
    let is_gone = |_| {
        std::thread::sleep(std::time::Duration::from_millis(1));
        threads() == before
    };
    assert!((0..5000).any(is_gone), "{} threads instead of {before}", threads());
}
