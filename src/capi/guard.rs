//! What every exported function runs in: panic guard, last error, floating-point environment.
//!
//! # Method
//! [`guard`] clears the thread's last error, switches to round-to-nearest without flush-to-zero, runs the body under
//! `catch_unwind`, restores the host's floating-point environment and turns the outcome into a status. Hosts do switch
//! that environment (CGAL rounds upward, `-ffast-math` plug-ins flush denormals), which would break the exact
//! predicates. Threads inherit it from the thread that creates them, so pools are made inside the guard.
//!
//! # Invariants
//! Nothing unwinds past [`guard`]. A panic of a thread that works for us prints nothing: the library never writes to
//! the host's standard error.

use std::any::Any;
use std::cell::{Cell, RefCell};
use std::ffi::{CString, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Once;

use super::status::{MW_E_INTERNAL, MW_OK, mw_status, status_of};
use crate::error::{Error, Result};

thread_local! {
    static LAST_ERROR: RefCell<CString> = RefCell::default();
    static INSIDE: Cell<bool> = const { Cell::new(false) };
    static HOST_WORD: Cell<u64> = const { Cell::new(DEFAULT_CONTROL_WORD) };
}

/// Prefix of the names of pool threads, as `context::WorkerPool` gives them.
const WORKER_PREFIX: &str = "meshwright-";

/// Runs the body of an exported function.
pub fn guard(body: impl FnOnce() -> Result<()>) -> mw_status {
    guard_or(MW_E_INTERNAL, || body().map(|()| MW_OK), status_of)
}

/// Runs the body of an exported function that returns a value instead of a status; `fallback` after an error.
pub fn guard_value<T: Copy>(fallback: T, body: impl FnOnce() -> Result<T>) -> T {
    guard_or(fallback, body, |_| fallback)
}

fn guard_or<T>(panicked: T, body: impl FnOnce() -> Result<T>, failed: impl FnOnce(&Error) -> T) -> T {
    silence_panics();
    set_last_error("");
    let nested = INSIDE.try_with(|inside| inside.replace(true)).unwrap_or(true);
    let environment = FloatEnvironment::enter();
    let outcome = catch_unwind(AssertUnwindSafe(body));
    drop(environment);
    let _ = INSIDE.try_with(|inside| inside.set(nested));
    match outcome {
        Ok(Ok(value)) => value,
        Ok(Err(error)) => {
            set_last_error(&error.to_string());
            failed(&error)
        }
        Err(payload) => {
            set_last_error(&format!("internal error: {}", panic_text(payload.as_ref())));
            // Dropping a payload may panic in its turn; leaking this one value may not.
            std::mem::forget(payload);
            panicked
        }
    }
}

/// The text of a panic.
fn panic_text(payload: &(dyn Any + Send)) -> &str {
    payload
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| payload.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("a panic without a text")
}

fn set_last_error(text: &str) {
    // A thread whose thread-local data is already gone has nobody left to ask for the text.
    let _ = LAST_ERROR.try_with(|last| *last.borrow_mut() = to_c_string(text));
}

/// Text for C: what follows an embedded NUL is replaced, not lost.
pub fn to_c_string(text: &str) -> CString {
    CString::new(text.replace('\0', "?")).expect("no NUL is left")
}

/// Panics of our own threads and calls print nothing; all others go to the hook that was there before.
fn silence_panics() {
    static INSTALLED: Once = Once::new();
    INSTALLED.call_once(|| {
        let previous = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            let ours = INSIDE.try_with(Cell::get).unwrap_or(false)
                || std::thread::current().name().is_some_and(|name| name.starts_with(WORKER_PREFIX));
            if !ours {
                previous(info);
            }
        }));
    });
}

/// The host's floating-point control word, kept while ours is in force.
struct FloatEnvironment {
    host: u64,
    outer: u64,
}

impl FloatEnvironment {
    /// Switches to round-to-nearest, no flush-to-zero, exceptions masked.
    fn enter() -> Self {
        let host = control_word();
        set_control_word(DEFAULT_CONTROL_WORD);
        let outer = HOST_WORD.try_with(|word| word.replace(host)).unwrap_or(DEFAULT_CONTROL_WORD);
        Self { host, outer }
    }
}

impl Drop for FloatEnvironment {
    fn drop(&mut self) {
        let _ = HOST_WORD.try_with(|word| word.set(self.outer));
        set_control_word(self.host);
    }
}

/// Runs a callback of the host in the environment in which the host called us on this thread; on a pool thread, where
/// no host called, in ours.
pub fn call_host<T>(callback: impl FnOnce() -> T) -> T {
    set_control_word(HOST_WORD.try_with(Cell::get).unwrap_or(DEFAULT_CONTROL_WORD));
    let result = callback();
    set_control_word(DEFAULT_CONTROL_WORD);
    result
}

/// Power-on value of MXCSR: all exceptions masked, round to nearest, no FTZ, no DAZ.
#[cfg(target_arch = "x86_64")]
const DEFAULT_CONTROL_WORD: u64 = 0x1F80;
/// All of FPCR zero: round to nearest, no flush-to-zero, no traps.
#[cfg(not(target_arch = "x86_64"))]
const DEFAULT_CONTROL_WORD: u64 = 0;

#[cfg(target_arch = "x86_64")]
fn control_word() -> u64 {
    let mut word = 0u32;
    // SAFETY: stmxcsr writes four bytes to the given address, which is a live u32.
    unsafe { std::arch::asm!("stmxcsr [{}]", in(reg) &raw mut word, options(nostack)) };
    u64::from(word)
}

#[cfg(target_arch = "x86_64")]
fn set_control_word(word: u64) {
    let word = word as u32;
    // SAFETY: ldmxcsr reads four bytes from the address of a live u32. The value was read by stmxcsr or is the
    // power-on value, so no reserved bit is set. Rust code runs in the default environment: we only ever enter it, or
    // leave it for the host's code.
    unsafe { std::arch::asm!("ldmxcsr [{}]", in(reg) &raw const word, options(nostack)) };
}

#[cfg(target_arch = "aarch64")]
fn control_word() -> u64 {
    let word: u64;
    // SAFETY: reading FPCR has no effect.
    unsafe { std::arch::asm!("mrs {}, fpcr", out(reg) word, options(nomem, nostack)) };
    word
}

#[cfg(target_arch = "aarch64")]
fn set_control_word(word: u64) {
    // SAFETY: the value was read from FPCR or is zero, the architecture's default; see the x86-64 version.
    unsafe { std::arch::asm!("msr fpcr, {}", in(reg) word, options(nostack)) };
}

#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
fn control_word() -> u64 {
    0
}

#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
fn set_control_word(_word: u64) {}

/// Why the last call on this thread failed, in one line of UTF-8; empty when it did not fail.
///
/// @return Never null; valid until the next mw_ call on this thread (mw_last_error, mw_version, mw_version_string and
///         mw_status_string excepted). Copy it if you need it longer.
#[unsafe(no_mangle)]
pub extern "C" fn mw_last_error() -> *const c_char {
    LAST_ERROR.try_with(|last| last.borrow().as_ptr()).unwrap_or(c"".as_ptr())
}

/// Panics inside the guard: the test that nothing unwinds into C.
#[cfg(any(test, feature = "test-panic"))]
#[unsafe(no_mangle)]
pub extern "C" fn mw__test_panic() -> mw_status {
    guard(|| panic!("on purpose"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::ffi::CStr;

    fn last_error() -> String {
        // SAFETY: mw_last_error returns a live, terminated string.
        unsafe { CStr::from_ptr(mw_last_error()) }.to_str().unwrap().to_owned()
    }

    #[test]
    fn a_panic_becomes_a_status_with_its_text() {
        assert_eq!(mw__test_panic(), MW_E_INTERNAL);
        assert_eq!(last_error(), "internal error: on purpose");
        assert_eq!(guard(|| Ok(())), MW_OK);
        assert_eq!(last_error(), "");
    }

    #[test]
    fn a_panic_of_a_worker_becomes_a_status() {
        let status = guard(|| {
            let context = crate::context::RunContext::with_threads(2)?;
            context.run(|_, _| std::ops::ControlFlow::Continue(()), |_| -> Result<()> { panic!("in a worker") })
        });
        assert_eq!((status, last_error().as_str()), (MW_E_INTERNAL, "internal error: in a worker"));
    }

    #[test]
    #[cfg(target_arch = "x86_64")]
    fn the_body_rounds_to_nearest_and_the_host_gets_its_mode_back() {
        const ROUND_UP_AND_FLUSH: u64 = 0x1F80 | 0x4000 | 0x8000 | 0x40;
        set_control_word(ROUND_UP_AND_FLUSH);
        let mut inside = (0, 0);
        guard(|| {
            let in_thread = std::thread::spawn(control_word).join().unwrap();
            inside = (control_word(), in_thread);
            Ok(())
        });
        // The low six bits are sticky exception flags, no modes.
        let after = control_word() & !0x3F;
        set_control_word(DEFAULT_CONTROL_WORD);
        assert_eq!((inside.0 & !0x3F, inside.1 & !0x3F), (0x1F80, 0x1F80));
        assert_eq!(after, ROUND_UP_AND_FLUSH & !0x3F);
    }
}
