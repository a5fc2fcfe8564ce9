//! The run context: worker pool, cancellation, progress, findings and limits of one run.
//!
//! # Method
//! A [`WorkerPool`] is made once and shared by any number of runs. A [`RunContext`] belongs to one run. The calling
//! thread hands its work to the pool with [`RunContext::run`] and waits; every 50 ms it tells the host about
//! progress and asks whether to go on. Engines poll [`RunContext::check`] at least every few milliseconds of work.
//!
//! # Invariants
//! The reported fraction never decreases and stays within [0, 1]. The pool is never rayon's global one. When the
//! last handle of a pool is dropped its threads are joined, so that a host can unload the library's data safely.
//!
//! # Limits
//! The cancellation flag is the one atomic outside `parallel/`: this module stands below it. What the lattice engine does between two
//! polls grows with the mesh: at 2.4 million tets it takes up to 0.15 s on two cores with the default options. The topology checks look at
//! the flag as often as the rest.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use rayon::prelude::*;

use crate::error::{Error, Finding, Result};

/// How often the calling thread looks at progress and cancellation.
const TICK: Duration = Duration::from_millis(50);

/// Stack of a pool thread, bytes; hosts may start us with tiny defaults.
const STACK_BYTES: usize = 8 << 20;

/// Most threads a pool is made with; more is a typing error, not a machine.
pub const MAX_THREADS: usize = 1024;

/// A set of worker threads, shared by runs. Cloning shares the same threads.
#[derive(Clone)]
pub struct WorkerPool {
    inner: Arc<PoolInner>,
}

struct PoolInner {
    pool: Option<rayon::ThreadPool>,
    handles: Mutex<Vec<std::thread::JoinHandle<()>>>,
    threads: usize,
}

impl WorkerPool {
    /// Starts `threads` workers; 0 means one per core.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] above [`MAX_THREADS`]; [`Error::OutOfMemory`] where the system starts no thread.
    pub fn new(threads: usize) -> Result<Self> {
        if threads > MAX_THREADS {
            return Err(Error::argument("threads", format!("{threads} is above the limit of {MAX_THREADS}")));
        }
        let threads =
            if threads == 0 { std::thread::available_parallelism().map_or(1, std::num::NonZero::get) } else { threads };
        let handles = Mutex::new(Vec::with_capacity(threads));
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("meshwright-{i}"))
            .stack_size(STACK_BYTES)
            .spawn_handler(|thread| {
                let builder = std::thread::Builder::new()
                    .name(thread.name().unwrap_or("meshwright").to_owned())
                    .stack_size(thread.stack_size().unwrap_or(STACK_BYTES));
                lock(&handles).push(builder.spawn(|| thread.run())?);
                Ok(())
            })
            .build()
            .map_err(|_| Error::OutOfMemory { what: "worker threads", bytes: (threads * STACK_BYTES) as u64 })?;
        Ok(Self { inner: Arc::new(PoolInner { pool: Some(pool), handles, threads }) })
    }

    /// Number of workers.
    pub fn threads(&self) -> usize {
        self.inner.threads
    }

    fn pool(&self) -> &rayon::ThreadPool {
        self.inner.pool.as_ref().expect("the pool is taken only while it is dropped")
    }
}

impl Drop for PoolInner {
    fn drop(&mut self) {
        // rayon's drop only signals its threads; a host that unloads us needs them gone.
        drop(self.pool.take());
        let current = std::thread::current().id();
        for handle in lock(&self.handles).drain(..) {
            if handle.thread().id() != current {
                // A worker's panic was already turned into the error of its run.
                let _ = handle.join();
            }
        }
    }
}

/// Cancels a run from any thread.
#[derive(Debug, Clone, Default)]
pub struct CancelToken(Arc<AtomicBool>);

impl CancelToken {
    /// Asks the run to stop; it ends with [`Error::Cancelled`] within 0.2 s.
    pub fn cancel(&self) {
        // Relaxed: the flag guards no other data, it is only polled. A pass that saw it set and left work out is joined before the
        // check that follows, which can see no older value of the same atomic.
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether [`CancelToken::cancel`] was called.
    #[inline]
    pub fn is_cancelled(&self) -> bool {
        // Relaxed: as in `cancel`.
        self.0.load(Ordering::Relaxed)
    }

    /// Makes the token usable for another run, once the one that it cancelled has ended: what that has left undone would pass for
    /// done.
    pub fn reset(&self) {
        // Relaxed: as in `cancel`.
        self.0.store(false, Ordering::Relaxed);
    }
}

/// How serious a log line is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(i32)]
pub enum LogLevel {
    /// Something is wrong but the run goes on.
    Warning = 1,
    /// Steps of the run.
    Info = 2,
    /// Details for whoever develops.
    Debug = 3,
}

/// Receives log lines, one at a time.
pub type LogSink = Arc<dyn Fn(LogLevel, &str) + Send + Sync>;

#[derive(Default)]
struct Progress {
    stage: &'static str,
    fraction: f64,
    finished: bool,
}

struct Shared {
    progress: Mutex<Progress>,
    wake: Condvar,
    findings: Mutex<Vec<Finding>>,
    cancel: CancelToken,
    log: Mutex<Option<LogSink>>,
    deadline: Mutex<Option<Instant>>,
}

/// Everything a run shares with its surroundings. Cloning shares the same run.
#[derive(Clone)]
pub struct RunContext {
    pool: WorkerPool,
    shared: Arc<Shared>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // The data behind these locks is plain values, never half-written: a panic elsewhere does not spoil them.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl RunContext {
    /// A run on `pool` that `cancel` can stop.
    pub fn new(pool: WorkerPool, cancel: CancelToken) -> Self {
        let shared = Shared {
            progress: Mutex::default(),
            wake: Condvar::new(),
            findings: Mutex::default(),
            cancel,
            log: Mutex::new(None),
            deadline: Mutex::new(None),
        };
        Self { pool, shared: Arc::new(shared) }
    }

    /// A run on a fresh pool of `threads` workers (0: one per core).
    ///
    /// # Errors
    /// As [`WorkerPool::new`].
    pub fn with_threads(threads: usize) -> Result<Self> {
        Ok(Self::new(WorkerPool::new(threads)?, CancelToken::default()))
    }

    /// Sends log lines to `sink`.
    pub fn set_log(&self, sink: Option<LogSink>) {
        *lock(&self.shared.log) = sink;
    }

    /// Ends the run with [`Error::LimitReached`] when it is still going after `limit`.
    pub fn set_time_limit(&self, limit: Option<Duration>) {
        *lock(&self.shared.deadline) = limit.map(|l| Instant::now() + l);
    }

    /// Number of workers.
    pub fn threads(&self) -> usize {
        self.pool.threads()
    }

    /// The workers, for a run within this run.
    pub fn pool(&self) -> WorkerPool {
        self.pool.clone()
    }

    /// The token that cancels this run.
    pub fn cancel_token(&self) -> CancelToken {
        self.shared.cancel.clone()
    }

    /// Whether the caller cancelled. Cheap enough for inner loops.
    #[inline]
    pub fn is_cancelled(&self) -> bool {
        self.shared.cancel.is_cancelled()
    }

    /// To be called between chunks of work.
    ///
    /// # Errors
    /// [`Error::Cancelled`], or [`Error::LimitReached`] past the time limit.
    pub fn check(&self) -> Result<()> {
        if self.is_cancelled() {
            return Err(Error::Cancelled);
        }
        match *lock(&self.shared.deadline) {
            Some(deadline) if Instant::now() >= deadline => {
                Err(Error::LimitReached { reason: format!("time limit, during {}", lock(&self.shared.progress).stage) })
            }
            _ => Ok(()),
        }
    }

    /// [`check`](Self::check) at every `interval`-th of the items of a loop, from the first one on.
    ///
    /// # Errors
    /// As [`check`](Self::check).
    #[inline]
    pub fn check_every(&self, interval: usize, item: usize) -> Result<()> {
        if item.is_multiple_of(interval) { self.check() } else { Ok(()) }
    }

    /// The items of a parallel pass, no more of them once the run is cancelled. What the pass makes is not whole then:
    /// [`check`](Self::check) is to follow it.
    pub fn until_cancelled<I: IntoParallelIterator>(&self, items: I) -> impl ParallelIterator<Item = I::Item> {
        items.into_par_iter().take_any_while(|_| !self.is_cancelled())
    }

    /// Says where the run is: a stable stage name and the fraction of the whole run, 0 to 1.
    pub fn progress(&self, stage: &'static str, fraction: f64) {
        let mut progress = lock(&self.shared.progress);
        progress.stage = stage;
        if fraction.is_finite() {
            progress.fraction = progress.fraction.max(fraction.clamp(0.0, 1.0));
        }
    }

    /// Records a finding about the input or the result.
    pub fn report(&self, finding: Finding) {
        lock(&self.shared.findings).push(finding);
    }

    /// The findings recorded so far, in order; the record is empty afterwards.
    pub fn take_findings(&self) -> Vec<Finding> {
        std::mem::take(&mut *lock(&self.shared.findings))
    }

    /// Sends one line to the log sink, if there is one.
    pub fn log(&self, level: LogLevel, text: &str) {
        // The lock is held during the call: sinks are promised one line at a time.
        if let Some(sink) = lock(&self.shared.log).as_ref() {
            sink(level, text);
        }
    }

    /// Runs `job` on the pool; rayon's parallel iterators inside use its workers.
    pub fn install<T: Send>(&self, job: impl FnOnce() -> T + Send) -> T {
        self.pool.pool().install(job)
    }

    /// Runs `job` on the pool while the calling thread waits and calls `tick(stage, fraction)` about every 50 ms;
    /// a `Break` cancels.
    ///
    /// # Errors
    /// What `job` returns; [`Error::Cancelled`] after a `Break`.
    pub fn run<T: Send>(
        &self,
        mut tick: impl FnMut(&'static str, f64) -> ControlFlow<()>,
        job: impl FnOnce(&Self) -> Result<T> + Send,
    ) -> Result<T> {
        *lock(&self.shared.progress) = Progress::default();
        let mut result = None;
        self.pool.pool().in_place_scope(|scope| {
            let slot = &mut result;
            scope.spawn(move |_| {
                let finish = FinishGuard(&self.shared);
                *slot = Some(job(self));
                drop(finish);
            });
            self.wait_with_ticks(&mut tick);
        });
        let result = result.unwrap_or(Err(Error::Internal { reason: "the run ended without a result".into() }))?;
        let _ = tick("done", 1.0);
        Ok(result)
    }

    fn wait_with_ticks(&self, tick: &mut impl FnMut(&'static str, f64) -> ControlFlow<()>) {
        let mut progress = lock(&self.shared.progress);
        while !progress.finished {
            progress = self.shared.wake.wait_timeout(progress, TICK).unwrap_or_else(PoisonError::into_inner).0;
            if progress.finished {
                break;
            }
            let (stage, fraction) = (progress.stage, progress.fraction);
            drop(progress); // the host's callback may take its time, and may call back into us
            if tick(stage, fraction).is_break() {
                self.shared.cancel.cancel();
            }
            progress = lock(&self.shared.progress);
        }
    }
}

/// Wakes the waiting thread also when the job panics.
struct FinishGuard<'a>(&'a Shared);

impl Drop for FinishGuard<'_> {
    fn drop(&mut self) {
        lock(&self.0.progress).finished = true;
        self.0.wake.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn run_reports_progress_on_the_calling_thread_and_cancels() {
        let context = RunContext::with_threads(2).unwrap();
        let caller = std::thread::current().id();
        let result: Result<()> = context.run(
            |_, _| {
                assert_eq!(std::thread::current().id(), caller);
                ControlFlow::Break(())
            },
            |context| {
                loop {
                    context.check()?;
                    std::thread::sleep(Duration::from_millis(1));
                }
            },
        );
        assert!(matches!(result, Err(Error::Cancelled)));
    }

    #[test]
    fn a_loop_asks_at_every_so_many_items() {
        let context = RunContext::with_threads(1).unwrap();
        context.cancel_token().cancel();
        let ends = (0..7).filter(|item| context.check_every(3, *item).is_err());
        assert_eq!(ends.collect::<Vec<usize>>(), [0, 3, 6]);
    }

    #[test]
    fn a_pass_has_all_items_in_order_until_the_run_is_cancelled() {
        let context = RunContext::with_threads(2).unwrap();
        let items = || context.install(|| context.until_cancelled(0..1000).collect::<Vec<usize>>());
        assert_eq!(items(), (0..1000).collect::<Vec<usize>>());
        context.cancel_token().cancel();
        assert!(items().is_empty());
    }

    #[test]
    fn progress_never_decreases() {
        let context = RunContext::with_threads(1).unwrap();
        context.progress("a", 0.5);
        context.progress("b", 0.2);
        assert_eq!(lock(&context.shared.progress).fraction, 0.5);
    }

    #[test]
    fn too_many_threads_is_an_error() {
        assert!(WorkerPool::new(MAX_THREADS + 1).is_err());
    }
}
