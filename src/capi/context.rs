//! The context: worker threads and log.

use std::ffi::{c_char, c_void};
use std::sync::{Arc, Mutex, PoisonError};

use super::guard::{call_host, guard, to_c_string};
use super::handles::{borrow, destroy, give};
use super::status::mw_status;
use crate::context::{CancelToken, LogLevel, LogSink, RunContext, WorkerPool};
use crate::error::{Error, Result};

/// Worker threads and log, shared by any number of jobs. Any thread may use it, several at once.
pub struct mw_context {
    shared: Arc<ContextShared>,
}

/// What jobs keep of a context, also when the handle is gone.
pub struct ContextShared {
    pool: WorkerPool,
    log: Mutex<Option<Log>>,
}

/// Receives log lines: one at a time for a context, on any thread, never after mw_context_set_log replaced it or
/// mw_context_destroy returned. `level` is MW_LOG_WARNING, MW_LOG_INFO or MW_LOG_DEBUG; `text` is one line of UTF-8
/// without a line end, valid during the call. It must not throw, must not call longjmp, and must not call
/// mw_context_set_log or mw_context_destroy.
pub type mw_log_fn = Option<unsafe extern "C" fn(user: *mut c_void, level: i32, text: *const c_char)>;

/// Log level: something is wrong, but the work goes on.
pub const MW_LOG_WARNING: i32 = 1;
/// Log level: the steps of a run.
pub const MW_LOG_INFO: i32 = 2;
/// Log level: details for developers.
pub const MW_LOG_DEBUG: i32 = 3;

struct Log {
    function: unsafe extern "C" fn(*mut c_void, i32, *const c_char),
    user: *mut c_void,
    max_level: i32,
}

// SAFETY: the header tells the host that the log function is called on any thread, so `user` is made for that; the
// mutex around the log keeps the calls apart.
unsafe impl Send for Log {}

impl ContextShared {
    /// A run on this context's threads, logging to this context's log.
    pub fn run_context(self: &Arc<Self>, cancel: CancelToken) -> RunContext {
        let context = RunContext::new(self.pool.clone(), cancel);
        let shared = Arc::clone(self);
        let sink: LogSink = Arc::new(move |level, text| shared.log_line(level, text));
        context.set_log(Some(sink));
        context
    }

    fn log_line(&self, level: LogLevel, text: &str) {
        let log = self.log.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(log) = log.as_ref().filter(|log| level as i32 <= log.max_level) {
            let text = to_c_string(text);
            // SAFETY: the host promised a function of this type that may be called until it is replaced, which the
            // lock held here delays.
            call_host(|| unsafe { (log.function)(log.user, level as i32, text.as_ptr()) });
        }
    }

    fn set_log(&self, log: Option<Log>) {
        *self.log.lock().unwrap_or_else(PoisonError::into_inner) = log;
    }
}

/// The shared part of a context handle.
///
/// # Errors
/// [`Error::InvalidArgument`] for null.
///
/// # Safety
/// As [`borrow`].
pub unsafe fn shared_context<'a>(context: *const mw_context) -> Result<&'a Arc<ContextShared>> {
    // SAFETY: as the caller promises.
    Ok(&unsafe { borrow(context, "context") }?.shared)
}

/// Makes a context with its own worker threads.
///
/// @param threads  number of worker threads; 0 for one per core
/// @param out      receives the context, null after an error; destroy it with mw_context_destroy
/// @return MW_OK, MW_E_ARG (null `out`; threads negative or above 1024), MW_E_MEMORY (no threads to be had)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_context_create(threads: i32, out: *mut *mut mw_context) -> mw_status {
    let make = || {
        let threads = usize::try_from(threads).map_err(|_| Error::argument("threads", format!("{threads} < 0")))?;
        let shared = ContextShared { pool: WorkerPool::new(threads)?, log: Mutex::new(None) };
        Ok(mw_context { shared: Arc::new(shared) })
    };
    // SAFETY: the C caller's promise about `out`.
    guard(|| unsafe { give(out, make) })
}

/// Destroys a context; null is allowed. Its log function is not called any more. Threads end when the last job made
/// with the context is destroyed too. Not from inside a callback.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_context_destroy(context: *mut mw_context) {
    guard(|| {
        // SAFETY: the C caller's promise about the handle.
        if let Some(context) = unsafe { context.as_ref() } {
            context.shared.set_log(None);
        }
        // SAFETY: as above; the reference is gone.
        unsafe { destroy(context) };
        Ok(())
    });
}

/// Number of worker threads of a context; 0 for null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_context_threads(context: *const mw_context) -> i32 {
    // SAFETY: the C caller's promise about the handle.
    super::guard::guard_value(0, || Ok(unsafe { shared_context(context) }?.pool.threads() as i32))
}

/// Sets the function that receives log lines. Without one nothing is logged: the library never prints.
///
/// @param fn         the function; null for none
/// @param user       handed to the function as it is
/// @param max_level  lines above this level are left out: MW_LOG_WARNING, MW_LOG_INFO or MW_LOG_DEBUG
/// @return MW_OK, MW_E_ARG (null context, unknown level)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_context_set_log(
    context: *mut mw_context,
    r#fn: mw_log_fn,
    user: *mut c_void,
    max_level: i32,
) -> mw_status {
    guard(|| {
        // SAFETY: the C caller's promise about the handle.
        let shared = unsafe { shared_context(context) }?;
        if !(MW_LOG_WARNING..=MW_LOG_DEBUG).contains(&max_level) {
            return Err(Error::argument("max_level", format!("{max_level} is no log level (1 to 3)")));
        }
        shared.set_log(r#fn.map(|function| Log { function, user, max_level }));
        Ok(())
    })
}
