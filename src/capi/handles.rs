//! Opaque handles: create, borrow, destroy.
//!
//! # Method
//! A handle is a boxed Rust value. What a handle shares with others (an image with a job, a mesh with a job's result)
//! stands behind an `Arc`, so that any order of destruction is right. What can change stands behind a `Mutex` that is
//! only ever tried: a job in use by another thread is an error of the caller, not a reason to wait, and the mutex's
//! poison is the mark that a panic leaves.

use std::sync::{Mutex, MutexGuard, TryLockError};

use crate::error::{Error, Result};

/// The object behind a handle.
///
/// # Errors
/// [`Error::InvalidArgument`] for null.
///
/// # Safety
/// `handle` is null or was made by [`give`] and not yet destroyed, and stays so for `'a`.
pub unsafe fn borrow<'a, T>(handle: *const T, name: &str) -> Result<&'a T> {
    // SAFETY: as the caller promises.
    unsafe { handle.as_ref() }.ok_or_else(|| null(name))
}

/// Hands `make`'s value to the caller as a new handle in `*out`, which is null after an error.
///
/// # Errors
/// [`Error::InvalidArgument`] for a null `out`; those of `make`.
///
/// # Safety
/// `out` is null or valid for writing a pointer.
pub unsafe fn give<T>(out: *mut *mut T, make: impl FnOnce() -> Result<T>) -> Result<()> {
    if out.is_null() {
        return Err(null("out"));
    }
    // SAFETY: not null, so valid for writing as the caller promises.
    unsafe { out.write(std::ptr::null_mut()) };
    let handle = Box::into_raw(Box::new(make()?));
    // SAFETY: as above.
    unsafe { out.write(handle) };
    Ok(())
}

/// Takes a handle back; null is allowed.
///
/// # Safety
/// `handle` is null or was made by [`give`], and nobody uses it any more.
pub unsafe fn destroy<T>(handle: *mut T) {
    if !handle.is_null() {
        // SAFETY: made by Box::into_raw in `give`, as the caller promises.
        drop(unsafe { Box::from_raw(handle) });
    }
}

/// Writes one result.
///
/// # Errors
/// [`Error::InvalidArgument`] for a null `out`.
///
/// # Safety
/// `out` is null or valid for writing a `T`.
pub unsafe fn write<T>(out: *mut T, value: T, name: &str) -> Result<()> {
    if out.is_null() {
        return Err(null(name));
    }
    // SAFETY: not null, so valid for writing as the caller promises.
    unsafe { out.write(value) };
    Ok(())
}

/// The changeable part of an object, for this call alone.
///
/// # Errors
/// [`Error::State`] while another thread uses the object, and for ever after a panic inside it.
pub fn lock<'a, T>(mutex: &'a Mutex<T>, what: &str) -> Result<MutexGuard<'a, T>> {
    mutex.try_lock().map_err(|error| Error::State {
        reason: match error {
            TryLockError::WouldBlock => {
                format!("the {what} is in use: by another thread, or by the run that calls back")
            }
            TryLockError::Poisoned(_) => format!("the {what} is spoilt by an earlier internal error, destroy it"),
        },
    })
}

/// The error for a null pointer.
pub fn null(name: &str) -> Error {
    Error::argument(name, "null pointer")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::panic::{AssertUnwindSafe, catch_unwind};

    #[test]
    fn a_panic_spoils_what_it_happened_in() {
        let object = Mutex::new(1);
        let _ = catch_unwind(AssertUnwindSafe(|| {
            let _held = lock(&object, "job").unwrap();
            std::panic::resume_unwind(Box::new(()));
        }));
        let Err(Error::State { reason }) = lock(&object, "job") else { panic!("not spoilt") };
        assert!(reason.contains("spoilt"));
    }

    #[test]
    fn an_object_in_use_is_an_error() {
        let object = Mutex::new(1);
        let _held = lock(&object, "job").unwrap();
        assert!(matches!(lock(&object, "job"), Err(Error::State { .. })));
    }
}
