//! Binds the workers of a pool to one core each for the time of a run.
//!
//! # Method
//! Every worker saves the set of cores it may run on and takes one core of it, by its number; when the guard is dropped
//! every worker takes its saved set back, so that a pool shared with the host is left as it was.
//!
//! # Source
//! [Drakopoulos2017] B.3 `pint`.
//!
//! # Protocol
//! No shared state: each worker changes its own set only, inside `rayon::broadcast`, which returns when all are done.
//!
//! # Limits
//! Linux only; elsewhere, or where the system refuses, nothing is bound and the count is 0.

#![allow(unsafe_code, reason = "two calls of the C library; see their SAFETY")]

use crate::context::RunContext;

/// Words of a set of cores: 1024 cores, the size of glibc's `cpu_set_t`.
const WORDS: usize = 16;

/// Cores that a thread may run on, one bit each.
type CoreSet = [u64; WORDS];

#[cfg(target_os = "linux")]
mod system {
    use super::{CoreSet, WORDS};

    // Declared here because the crate does not depend on `libc`; std links the C library on Linux.
    unsafe extern "C" {
        fn sched_getaffinity(pid: i32, bytes: usize, set: *mut u64) -> i32;
        fn sched_setaffinity(pid: i32, bytes: usize, set: *const u64) -> i32;
    }

    /// The set of the calling thread.
    pub fn current() -> Option<CoreSet> {
        let mut set = [0; WORDS];
        // SAFETY: the pointer is to WORDS words, and the size given is theirs; 0 names the calling thread.
        let result = unsafe { sched_getaffinity(0, size_of::<CoreSet>(), set.as_mut_ptr()) };
        (result == 0).then_some(set)
    }

    /// Gives the calling thread a set; whether the system agreed.
    pub fn apply(set: &CoreSet) -> bool {
        // SAFETY: as in `current`; the set is only read.
        unsafe { sched_setaffinity(0, size_of::<CoreSet>(), set.as_ptr()) == 0 }
    }
}

#[cfg(not(target_os = "linux"))]
mod system {
    use super::CoreSet;

    pub fn current() -> Option<CoreSet> {
        None
    }

    pub fn apply(_set: &CoreSet) -> bool {
        false
    }
}

/// The `number`-th core of a set, counted round and round; `None` for the empty set.
fn one_core(set: &CoreSet, number: usize) -> Option<CoreSet> {
    let cores: Vec<usize> = (0..64 * WORDS).filter(|core| set[core / 64] >> (core % 64) & 1 == 1).collect();
    let core = *cores.get(number.checked_rem(cores.len())?)?;
    let mut one = [0; WORDS];
    one[core / 64] = 1 << (core % 64);
    Some(one)
}

/// Workers bound to one core each; dropping it sets them free.
pub struct PinnedWorkers {
    context: RunContext,
    before: Vec<Option<CoreSet>>,
}

impl PinnedWorkers {
    /// Binds every worker of the context's pool.
    pub fn new(context: &RunContext) -> Self {
        let bind = |worker: rayon::BroadcastContext| {
            let before = system::current()?;
            let one = one_core(&before, worker.index())?;
            system::apply(&one).then_some(before)
        };
        Self { context: context.clone(), before: context.install(|| rayon::broadcast(bind)) }
    }

    /// How many workers are bound.
    pub fn count(&self) -> usize {
        self.before.iter().flatten().count()
    }
}

impl Drop for PinnedWorkers {
    fn drop(&mut self) {
        let before = &self.before;
        self.context.install(|| {
            rayon::broadcast(|worker| before[worker.index()].as_ref().map(system::apply));
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn allowed(context: &RunContext) -> Vec<u32> {
        let count = |set: CoreSet| set.iter().map(|word| word.count_ones()).sum();
        context.install(|| rayon::broadcast(|_| system::current().map_or(0, count)))
    }

    #[test]
    fn one_core_goes_round_the_set() {
        let mut set = [0; WORDS];
        (set[0], set[1]) = (0b101, 1);
        let cores: Vec<_> = (0..4).map(|n| one_core(&set, n).unwrap()).collect();
        assert_eq!((cores[0][0], cores[1][0], cores[2][1], cores[3]), (1, 4, 1, cores[0]));
        assert!(one_core(&[0; WORDS], 3).is_none());
    }

    #[test]
    #[cfg_attr(miri, ignore = "Miri has no scheduler")]
    fn workers_are_bound_while_the_guard_lives() {
        let context = RunContext::with_threads(3).unwrap();
        let before = allowed(&context);
        let pinned = PinnedWorkers::new(&context);
        if cfg!(target_os = "linux") {
            assert_eq!((pinned.count(), allowed(&context)), (3, vec![1; 3]));
        }
        drop(pinned);
        assert_eq!(allowed(&context), before);
    }
}
