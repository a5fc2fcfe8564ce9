//! Over-decomposed work and its hand-over from busy threads to idle ones.
//!
//! # Protocol
//! The work is cut into buckets; every thread owns a queue of them. All queues stand behind one lock, which is taken
//! once per bucket (thousands of items), never per item.
//! States of a member: *not started*, *running*, *waiting* (its queue is empty), *gone*.
//! - A running member that comes for its next bucket takes one of its own, then serves the waiting ones: each gets
//!   `cbtransf^k * frbtransf * free` buckets, at least one, where `free` is what the giver has left and `k` counts the
//!   transfers between the two so far.
//! - A member whose queue is empty takes from members that have not started, else it waits.
//! - *No bucket is lost*: buckets move between queues and to members only under the lock.
//! - *The end*: when no member runs and every queue is empty, or someone stopped the queue, all waiting members are woken and leave.
//!   A waiting member has an empty queue and a running one comes back, also when it panics (its guard leaves for it),
//!   so the end is always reached; a waiting member holds no claims.
//! # Source
//! [Drakopoulos2017] section 4.8, equation 8; options `nbuckets`, `frbtransf`, `cbtransf`.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// How work is cut and handed over.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorkSettings {
    /// Buckets in all (`nbuckets`); at least one a thread is made.
    pub buckets: usize,
    /// Share of its free buckets that a busy thread hands over, in (0, 1] (`frbtransf`).
    pub transfer_share: f64,
    /// Factor on the share for every earlier transfer between the same two threads, in (0, 1] (`cbtransf`).
    pub transfer_decay: f64,
}

impl WorkSettings {
    /// The thesis's settings: 15 buckets a thread, 30 % handed over.
    pub fn for_threads(threads: usize) -> Self {
        Self { buckets: 15 * threads.max(1), transfer_share: 0.3, transfer_decay: 1.0 }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Member {
    NotStarted,
    Running,
    Waiting,
    Gone,
}

#[derive(Debug)]
struct State<T> {
    queues: Vec<VecDeque<Vec<T>>>,
    members: Vec<Member>,
    /// Transfers from member `i` to member `j` at `i * threads + j`.
    transfers: Vec<u32>,
    ended: bool,
}

/// Buckets of items for a fixed number of threads.
#[derive(Debug)]
pub struct WorkQueue<T> {
    state: Mutex<State<T>>,
    wake: Condvar,
    settings: WorkSettings,
}

impl<T> WorkQueue<T> {
    /// Cuts `items` into buckets of neighbours and deals them to `threads` members, contiguous parts to each.
    pub fn new(items: Vec<T>, threads: usize, settings: WorkSettings) -> Self {
        let threads = threads.max(1);
        let buckets = settings.buckets.clamp(threads, items.len().max(threads));
        let count = items.len();
        let mut queues: Vec<VecDeque<Vec<T>>> = (0..threads).map(|_| VecDeque::new()).collect();
        let mut items = items.into_iter();
        for bucket in 0..buckets {
            let size = count * (bucket + 1) / buckets - count * bucket / buckets;
            if size > 0 {
                queues[bucket * threads / buckets].push_back(items.by_ref().take(size).collect());
            }
        }
        let members = vec![Member::NotStarted; threads];
        let state = State { queues, members, transfers: vec![0; threads * threads], ended: false };
        Self { state: Mutex::new(state), wake: Condvar::new(), settings }
    }

    /// Joins as member `number`; every member joins once.
    pub fn join(&self, number: usize) -> WorkMember<'_, T> {
        self.lock().members[number] = Member::Running;
        WorkMember { queue: self, number }
    }

    /// Makes every member leave at its next bucket.
    pub fn stop(&self) {
        self.lock().ended = true;
        self.wake.notify_all();
    }

    /// Transfers between members so far.
    pub fn transfer_count(&self) -> u64 {
        self.lock().transfers.iter().map(|&t| u64::from(t)).sum()
    }

    fn lock(&self) -> MutexGuard<'_, State<T>> {
        // Buckets are moved whole: a panic elsewhere leaves the state consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn end_if_idle(&self, state: &mut State<T>) {
        let running = state.members.contains(&Member::Running);
        if !running && state.queues.iter().all(VecDeque::is_empty) {
            state.ended = true;
            self.wake.notify_all();
        }
    }

    /// Serves the waiting members from the queue of `giver`.
    fn hand_over(&self, state: &mut State<T>, giver: usize) {
        let threads = state.members.len();
        for taker in 0..threads {
            let free = state.queues[giver].len();
            if free == 0 || state.members[taker] != Member::Waiting || !state.queues[taker].is_empty() {
                continue;
            }
            let earlier = &mut state.transfers[giver * threads + taker];
            let decay = self.settings.transfer_decay.powi((*earlier).min(1 << 20) as i32);
            *earlier += 1;
            let share = (decay * self.settings.transfer_share * free as f64) as usize;
            let kept = free - share.clamp(1, free);
            let given = state.queues[giver].split_off(kept);
            state.queues[taker] = given;
            self.wake.notify_all();
        }
    }
}

/// A thread at work; leaves the queue when dropped.
#[derive(Debug)]
pub struct WorkMember<'a, T> {
    queue: &'a WorkQueue<T>,
    number: usize,
}

impl<T> WorkMember<'_, T> {
    /// The next bucket, waiting for one where other threads still have some; `None` when all work is done.
    pub fn next_bucket(&mut self) -> Option<Vec<T>> {
        let queue = self.queue;
        let mut state = queue.lock();
        loop {
            if state.ended {
                return None;
            }
            let sleeper = |state: &State<T>| {
                let mut others = 0..state.members.len();
                others.find(|&m| state.members[m] == Member::NotStarted && !state.queues[m].is_empty())
            };
            // One's own next bucket comes first: two members would hand a single one to and fro for ever.
            let mut bucket = state.queues[self.number].pop_front();
            queue.hand_over(&mut state, self.number);
            if bucket.is_none() {
                bucket = sleeper(&state).and_then(|m| state.queues[m].pop_back());
            }
            if bucket.is_some() {
                state.members[self.number] = Member::Running;
                return bucket;
            }
            state.members[self.number] = Member::Waiting;
            queue.end_if_idle(&mut state);
            if !state.ended {
                state = queue.wake.wait(state).unwrap_or_else(PoisonError::into_inner);
            }
        }
    }
}

impl<T> Drop for WorkMember<'_, T> {
    fn drop(&mut self) {
        let mut state = self.queue.lock();
        state.members[self.number] = Member::Gone;
        // A member that leaves early (stopped, or by a panic) leaves its buckets to nobody.
        state.queues[self.number].clear();
        self.queue.end_if_idle(&mut state);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drain(items: u32, threads: usize, settings: WorkSettings) -> (Vec<u32>, u64) {
        let queue = WorkQueue::new((0..items).collect(), threads, settings);
        let mut done: Vec<u32> = std::thread::scope(|scope| {
            let handles: Vec<_> = (0..threads)
                .map(|number| {
                    let queue = &queue;
                    scope.spawn(move || {
                        let mut member = queue.join(number);
                        let mut done = Vec::new();
                        while let Some(bucket) = member.next_bucket() {
                            if number == 0 {
                                std::thread::yield_now(); // one slow thread gives its work away
                            }
                            done.extend(bucket);
                        }
                        done
                    })
                })
                .collect();
            handles.into_iter().flat_map(|h| h.join().unwrap()).collect()
        });
        done.sort_unstable();
        (done, queue.transfer_count())
    }

    #[test]
    fn every_item_is_done_once() {
        for threads in [1, 2, 5] {
            for buckets in [1, 7, 1000] {
                let settings = WorkSettings { buckets, transfer_share: 0.4, transfer_decay: 0.9 };
                assert_eq!(drain(997, threads, settings).0, (0..997).collect::<Vec<_>>());
            }
        }
        assert!(drain(0, 3, WorkSettings::for_threads(3)).0.is_empty());
        assert_eq!(drain(2, 3, WorkSettings::for_threads(3)).0, [0, 1]);
    }

    #[test]
    fn a_member_that_never_starts_loses_its_work_to_others() {
        let queue = WorkQueue::new((0..100).collect::<Vec<u32>>(), 2, WorkSettings::for_threads(2));
        let mut member = queue.join(0);
        let mut count = 0;
        while let Some(bucket) = member.next_bucket() {
            count += bucket.len();
        }
        assert_eq!(count, 100);
    }

    #[test]
    fn stopping_ends_the_wait() {
        let queue = WorkQueue::new((0..100).collect::<Vec<u32>>(), 2, WorkSettings::for_threads(2));
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let mut member = queue.join(1);
                while member.next_bucket().is_some() {}
            });
            let mut member = queue.join(0);
            let _ = member.next_bucket();
            queue.stop();
            assert!(member.next_bucket().is_none());
        });
    }

    #[test]
    fn shares_follow_the_equation() {
        let settings = WorkSettings { buckets: 40, transfer_share: 0.5, transfer_decay: 0.5 };
        let queue = WorkQueue::new((0..40).collect::<Vec<u32>>(), 2, settings);
        let mut state = queue.lock();
        state.members = vec![Member::Running, Member::Waiting];
        state.queues[1].clear();
        assert_eq!(state.queues[0].len(), 20);
        queue.hand_over(&mut state, 0);
        assert_eq!((state.queues[0].len(), state.queues[1].len()), (10, 10));
        state.queues[1].clear();
        queue.hand_over(&mut state, 0);
        assert_eq!((state.queues[0].len(), state.queues[1].len()), (8, 2));
    }
}
