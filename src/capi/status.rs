//! Status codes, their texts, and the version.
//!
//! # Invariants
//! Each [`Error`] variant maps to exactly one status. Codes are never renumbered.

use std::ffi::{CStr, c_char};

use crate::error::Error;

/// Result of most functions: `MW_OK`, or a negative `MW_E_...`; positive values are reserved.
pub type mw_status = i32;

/// Done.
pub const MW_OK: mw_status = 0;
/// An argument is unusable by itself: null pointer, bad size, wrong type code, non-finite number.
pub const MW_E_ARG: mw_status = -1;
/// A parameter: unknown name (the text of mw_last_error names the nearest known one), wrong kind, out of range.
pub const MW_E_PARAM: mw_status = -2;
/// The data cannot be meshed or registered; mw_job_diag_get lists every fault found, with ids and coordinates.
pub const MW_E_INPUT: mw_status = -3;
/// The operating system refused a read or a write.
pub const MW_E_IO: mw_status = -4;
/// Memory or threads could not be had.
pub const MW_E_MEMORY: mw_status = -5;
/// Cancelled by the progress callback or by mw_job_cancel.
pub const MW_E_CANCELLED: mw_status = -6;
/// A limit was reached: time limit of the caller, or more entities than 32-bit indices can name.
pub const MW_E_LIMIT: mw_status = -7;
/// Valid, but not supported; the text says what is supported instead.
pub const MW_E_UNSUPPORTED: mw_status = -8;
/// The call does not fit the state of the object: no input yet, no result yet, in use by another thread, or spoilt by
/// an earlier MW_E_INTERNAL.
pub const MW_E_STATE: mw_status = -9;
/// No valid result could be made from valid input; mw_job_diag_get says where.
pub const MW_E_NO_RESULT: mw_status = -10;
/// A file is not what its name or its header says.
pub const MW_E_FORMAT: mw_status = -11;
/// A defect of this library was caught. The object is spoilt: destroy it. The host can go on.
pub const MW_E_INTERNAL: mw_status = -99;

/// The one status of an error.
pub fn status_of(error: &Error) -> mw_status {
    match error {
        Error::InvalidArgument { .. } => MW_E_ARG,
        Error::UnknownParameter { .. } | Error::ParameterValue { .. } => MW_E_PARAM,
        Error::InvalidInput { .. } => MW_E_INPUT,
        Error::NoResult { .. } => MW_E_NO_RESULT,
        Error::Io { .. } => MW_E_IO,
        Error::Format { .. } => MW_E_FORMAT,
        Error::Unsupported { .. } => MW_E_UNSUPPORTED,
        Error::CapacityExceeded { .. } | Error::LimitReached { .. } => MW_E_LIMIT,
        Error::OutOfMemory { .. } => MW_E_MEMORY,
        Error::Cancelled => MW_E_CANCELLED,
        Error::State { .. } => MW_E_STATE,
        Error::Internal { .. } => MW_E_INTERNAL,
    }
}

fn text_of(status: mw_status) -> &'static CStr {
    match status {
        MW_OK => c"ok",
        MW_E_ARG => c"invalid argument",
        MW_E_PARAM => c"invalid parameter",
        MW_E_INPUT => c"invalid input data",
        MW_E_IO => c"reading or writing failed",
        MW_E_MEMORY => c"out of memory",
        MW_E_CANCELLED => c"cancelled",
        MW_E_LIMIT => c"limit reached",
        MW_E_UNSUPPORTED => c"unsupported",
        MW_E_STATE => c"wrong state",
        MW_E_NO_RESULT => c"no valid result could be made",
        MW_E_FORMAT => c"malformed file",
        MW_E_INTERNAL => c"internal error",
        _ => c"unknown status",
    }
}

fn version_part(text: &str) -> u32 {
    text.parse().expect("Cargo's version parts are numbers")
}

/// Version of the library that is running, packed as by MW_MAKE_VERSION.
///
/// Compare it with the header's: `MW_CHECK_VERSION()` does so. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn mw_version() -> u32 {
    let major = version_part(env!("CARGO_PKG_VERSION_MAJOR"));
    let minor = version_part(env!("CARGO_PKG_VERSION_MINOR"));
    let patch = version_part(env!("CARGO_PKG_VERSION_PATCH"));
    major << 22 | minor << 12 | patch
}

/// Version of the library that is running, such as "0.1.0".
///
/// @return A static string, never null. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn mw_version_string() -> *const c_char {
    const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), "\0");
    VERSION.as_ptr().cast()
}

/// A few words for a status, such as "invalid argument".
///
/// @return A static string, never null; "unknown status" for a number that is none. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn mw_status_string(status: mw_status) -> *const c_char {
    text_of(status).as_ptr()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_status_has_a_text() {
        for status in (MW_E_FORMAT..=MW_OK).chain([MW_E_INTERNAL]) {
            assert_ne!(text_of(status), c"unknown status", "{status}");
        }
    }
}
