//! Pointer and count become slices, C strings become text, sized structs are read and written.

use std::ffi::{CStr, c_char};
use std::path::PathBuf;

use crate::error::{Error, Result};

use super::handles::null;

/// `count` values at `data`, with `width` values each.
///
/// # Errors
/// [`Error::InvalidArgument`] for a null pointer with values, a negative count, a misaligned pointer or an overflow.
///
/// # Safety
/// `data` is null or valid for reading `count * width` values for `'a`, and nobody writes them meanwhile.
pub unsafe fn slice<'a, T>(data: *const T, count: i64, width: usize, name: &str) -> Result<&'a [T]> {
    let length = usize::try_from(count).ok().and_then(|n| n.checked_mul(width));
    let Some(length) = length.filter(|n| n.checked_mul(size_of::<T>()).is_some_and(|b| b <= isize::MAX as usize))
    else {
        return Err(Error::argument(name, format!("{count} is not a valid count")));
    };
    if length == 0 {
        return Ok(&[]);
    }
    if data.is_null() {
        return Err(null(name));
    }
    if !data.is_aligned() {
        return Err(Error::argument(name, format!("the pointer is not aligned to {} bytes", align_of::<T>())));
    }
    // SAFETY: not null, aligned, within isize::MAX bytes; valid for reading as the caller promises.
    Ok(unsafe { std::slice::from_raw_parts(data, length) })
}

/// As [`slice`], for writing.
///
/// # Errors
/// As [`slice`].
///
/// # Safety
/// `data` is null or valid for writing `count` values for `'a`, and nobody else uses them meanwhile.
pub unsafe fn slice_mut<'a, T>(data: *mut T, count: i64, name: &str) -> Result<&'a mut [T]> {
    // SAFETY: as the caller promises; the checks are those of `slice`.
    let length = unsafe { slice(data.cast_const(), count, 1, name) }?.len();
    if length == 0 {
        return Ok(&mut []);
    }
    // SAFETY: checked by `slice`; valid for writing as the caller promises.
    Ok(unsafe { std::slice::from_raw_parts_mut(data, length) })
}

/// A null-terminated string as UTF-8.
///
/// # Errors
/// [`Error::InvalidArgument`] for null and for bytes that are not UTF-8.
///
/// # Safety
/// `text` is null or a terminated string that stays valid for `'a`.
pub unsafe fn text<'a>(text: *const c_char, name: &str) -> Result<&'a str> {
    if text.is_null() {
        return Err(null(name));
    }
    // SAFETY: not null, so terminated as the caller promises.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map_err(|error| Error::argument(name, format!("not UTF-8: {error}")))
}

/// A null-terminated UTF-8 string as a path; empty paths are refused.
///
/// # Errors
/// As [`text`].
///
/// # Safety
/// As [`text`].
pub unsafe fn path(path: *const c_char) -> Result<PathBuf> {
    // SAFETY: as the caller promises.
    match unsafe { text(path, "path") }? {
        "" => Err(Error::argument("path", "empty")),
        path => Ok(PathBuf::from(path)),
    }
}

/// A struct that begins with its size, as C handed it over. Fields past the caller's size are zero; a caller from the
/// future may hand over more than we know.
///
/// # Errors
/// [`Error::InvalidArgument`] for null and for a size below `smallest`, the size of the struct's first version.
///
/// # Safety
/// `data` is null or points to a `size_t` that tells how many bytes are valid for reading. All-zero bytes are a `T`.
pub unsafe fn sized<T: Copy>(data: *const T, smallest: usize, name: &str) -> Result<T> {
    if data.is_null() {
        return Err(null(name));
    }
    // SAFETY: the first field is the size, valid for reading as the caller promises.
    let size = unsafe { data.cast::<usize>().read_unaligned() };
    if size < smallest {
        let reason = format!("struct_size is {size}, at least {smallest} is needed: set it to sizeof");
        return Err(Error::argument(name, reason));
    }
    // SAFETY: all-zero bytes are a T as the caller promises.
    let mut value = unsafe { std::mem::zeroed::<T>() };
    let bytes = size.min(size_of::<T>());
    // SAFETY: `bytes` bytes are valid for reading as struct_size says, and fit into `value`.
    unsafe { std::ptr::copy_nonoverlapping(data.cast::<u8>(), (&raw mut value).cast::<u8>(), bytes) };
    Ok(value)
}

/// Writes a struct that begins with its size, as much of it as the caller's size holds; `struct_size` stays the
/// caller's.
///
/// # Errors
/// As [`sized`].
///
/// # Safety
/// `out` is null or points to a `size_t` that tells how many bytes are valid for writing.
pub unsafe fn write_sized<T: Copy>(out: *mut T, value: &T, smallest: usize, name: &str) -> Result<()> {
    if out.is_null() {
        return Err(null(name));
    }
    // SAFETY: the first field is the size, valid for reading as the caller promises.
    let size = unsafe { out.cast::<usize>().read_unaligned() };
    if size < smallest {
        let reason = format!("struct_size is {size}, at least {smallest} is needed: set it to sizeof");
        return Err(Error::argument(name, reason));
    }
    let head = size_of::<usize>();
    let bytes = size.min(size_of::<T>()) - head;
    let (from, to) = ((&raw const *value).cast::<u8>(), out.cast::<u8>());
    // SAFETY: head + bytes is within both structs.
    unsafe { std::ptr::copy_nonoverlapping(from.add(head), to.add(head), bytes) };
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone, Copy)]
    #[repr(C)]
    struct Sized2 {
        struct_size: usize,
        first: i32,
        second: i32,
    }

    #[test]
    fn an_older_struct_is_filled_up_with_zeros() {
        let old = Sized2 { struct_size: 12, first: 5, second: 77 };
        // SAFETY: a live struct.
        let read = unsafe { sized(&raw const old, 12, "s") }.unwrap();
        assert_eq!((read.first, read.second), (5, 0));
        let small = Sized2 { struct_size: 8, ..old };
        // SAFETY: a live struct.
        assert!(unsafe { sized(&raw const small, 12, "s") }.is_err());
    }

    #[test]
    fn an_older_struct_is_not_written_past_its_end() {
        let mut old = Sized2 { struct_size: 12, first: 0, second: 77 };
        let value = Sized2 { struct_size: 16, first: 1, second: 2 };
        // SAFETY: a live struct.
        unsafe { write_sized(&raw mut old, &value, 12, "s") }.unwrap();
        assert_eq!((old.struct_size, old.first, old.second), (12, 1, 77));
    }

    #[test]
    fn counts_that_overflow_are_refused() {
        for count in [-1, i64::MAX, i64::MAX / 8] {
            // SAFETY: never read: the count is refused.
            assert!(unsafe { slice(std::ptr::dangling::<f64>(), count, 3, "points") }.is_err());
        }
    }
}
