//! The generic loop of speculative work: attempt, give back on conflict, try again later.
//!
//! # Method
//! 1. Items are cut into buckets and handed between threads by `work_queue`.
//! 2. A worker attempts an item: it plans, claims what it will change, looks again at what it read, and commits; or it
//!    loses a claim, changes nothing, gives all claims back and says so. New items go to the end of the same bucket.
//! 3. Items that lost are tried again when the bucket is empty, and once more with the thread's last bucket.
//! 4. What still lost is finished by one worker after the others have stopped: nothing can be in its way.
//!
//! # Protocol
//! This file has no shared state of its own but the queue and the list of step 4, which threads append to under a lock
//! when they are done.
//! - *No livelock*: an item is attempted at most three times beside others, then alone.
//! - *No deadlock*: attempts never wait for a claim; waiting for buckets holds none.
//! - *No item is lost*: an item is in a bucket, in the lost list of its worker, or in the common list; a worker that
//!   stops early (error, cancellation) stops the whole run with that error.
//!
//! # Cost
//! One lock per bucket. The order of work, and with it the result, depends on timing when there are several workers.

use std::sync::{Mutex, PoisonError};

use super::work_queue::{WorkQueue, WorkSettings};
use crate::context::RunContext;
use crate::error::{Error, Result};

/// Attempts between two looks at the cancellation flag: well below a millisecond each.
const CHECK_INTERVAL: u64 = 256;

/// What became of an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Attempt {
    /// Carried out, or found not to be wanted.
    Done,
    /// Another thread was in the way; nothing was changed.
    ClaimLost,
    /// There is no room for what would be made; nothing was changed. The item is handed back to the caller.
    NoRoom,
}

/// One thread's side of the work.
pub trait Worker: Send {
    /// A piece of work.
    type Item: Send;

    /// Attempts one item, holding no claim before and after; new items go to `more`.
    ///
    /// # Errors
    /// Anything that has to end the whole run.
    fn attempt(&mut self, item: &Self::Item, more: &mut Vec<Self::Item>) -> Result<Attempt>;
}

/// How the work went.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SpeculativeCounts {
    /// Attempts.
    pub attempts: u64,
    /// Attempts that lost a claim.
    pub lost: u64,
    /// Items finished by one worker at the end.
    pub finished_alone: u64,
    /// Transfers of buckets between threads.
    pub transfers: u64,
}

impl SpeculativeCounts {
    /// Adds the counts of another pass.
    pub fn add(&mut self, other: Self) {
        self.attempts += other.attempts;
        self.lost += other.lost;
        self.finished_alone += other.finished_alone;
        self.transfers += other.transfers;
    }
}

struct Leftovers<I> {
    lost: Vec<I>,
    no_room: Vec<I>,
    counts: SpeculativeCounts,
    error: Option<Error>,
}

/// Does all items with one thread per worker; returns the counts and the items for which there was no room.
///
/// # Errors
/// The first error of an attempt; `Cancelled` or `LimitReached` of the context.
pub fn run_speculative<W: Worker>(
    context: &RunContext,
    workers: &mut [W],
    items: Vec<W::Item>,
    settings: WorkSettings,
) -> Result<(SpeculativeCounts, Vec<W::Item>)> {
    assert!(!workers.is_empty(), "speculative work needs a worker");
    let queue = WorkQueue::new(items, workers.len(), settings);
    let common = Mutex::new(Leftovers {
        lost: Vec::new(),
        no_room: Vec::new(),
        counts: SpeculativeCounts::default(),
        error: None,
    });
    context.install(|| {
        rayon::scope(|scope| {
            for (number, worker) in workers.iter_mut().enumerate() {
                let (queue, common) = (&queue, &common);
                scope.spawn(move |_| {
                    let mut member = queue.join(number);
                    let mut side = Side::new(context, worker);
                    let result = side.work(|| member.next_bucket());
                    if result.is_err() {
                        queue.stop();
                    }
                    let mut common = common.lock().unwrap_or_else(PoisonError::into_inner);
                    common.lost.append(&mut side.lost);
                    common.no_room.append(&mut side.no_room);
                    common.counts.add(side.counts);
                    if let Err(error) = result {
                        common.error.get_or_insert(error);
                    }
                });
            }
        });
    });
    let Leftovers { lost, no_room, mut counts, error } = common.into_inner().unwrap_or_else(PoisonError::into_inner);
    if let Some(error) = error {
        return Err(error);
    }
    counts.transfers += queue.transfer_count();
    counts.finished_alone += lost.len() as u64;
    let mut side = Side::new(context, &mut workers[0]);
    side.no_room = no_room;
    let mut bucket = Some(lost);
    side.work(|| bucket.take())?;
    counts.add(side.counts);
    if !side.lost.is_empty() {
        return Err(Error::Internal { reason: "a claim was lost although no other thread works".into() });
    }
    Ok((counts, side.no_room))
}

/// A worker with its lists.
struct Side<'a, W: Worker> {
    context: &'a RunContext,
    worker: &'a mut W,
    more: Vec<W::Item>,
    lost: Vec<W::Item>,
    no_room: Vec<W::Item>,
    counts: SpeculativeCounts,
}

impl<'a, W: Worker> Side<'a, W> {
    fn new(context: &'a RunContext, worker: &'a mut W) -> Self {
        let counts = SpeculativeCounts::default();
        Self { context, worker, more: Vec::new(), lost: Vec::new(), no_room: Vec::new(), counts }
    }

    fn work(&mut self, mut next_bucket: impl FnMut() -> Option<Vec<W::Item>>) -> Result<()> {
        // Lost once in their bucket, lost again: the latter wait for the thread's last bucket.
        let mut lost_twice = Vec::new();
        while let Some(bucket) = next_bucket() {
            self.attempt_all(bucket)?;
            let again = std::mem::take(&mut self.lost);
            self.attempt_all(again)?;
            lost_twice.append(&mut self.lost);
        }
        self.attempt_all(lost_twice)
    }

    fn attempt_all(&mut self, mut bucket: Vec<W::Item>) -> Result<()> {
        while !bucket.is_empty() {
            for item in bucket.drain(..) {
                if self.counts.attempts.is_multiple_of(CHECK_INTERVAL) {
                    self.context.check()?;
                }
                self.counts.attempts += 1;
                match self.worker.attempt(&item, &mut self.more)? {
                    Attempt::Done => {}
                    Attempt::ClaimLost => {
                        self.counts.lost += 1;
                        self.lost.push(item);
                    }
                    Attempt::NoRoom => self.no_room.push(item),
                }
            }
            std::mem::swap(&mut bucket, &mut self.more);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::claim_table::{Claim, ClaimTable};
    use super::super::shared_rows::SharedWords;
    use super::*;

    /// Adds one to two neighbouring counters; an item with `children` left makes more.
    struct Adder<'a> {
        holder: u32,
        claims: &'a ClaimTable,
        counters: SharedWords<'a>,
    }

    impl Worker for Adder<'_> {
        type Item = (usize, u32);

        fn attempt(&mut self, &(at, children): &Self::Item, more: &mut Vec<Self::Item>) -> Result<Attempt> {
            let pair = [at, (at + 1) % self.counters.len()];
            if children == 99 {
                return Err(Error::input("bad item"));
            }
            if children == 50 {
                return Ok(Attempt::NoRoom);
            }
            for (i, &index) in pair.iter().enumerate() {
                if self.claims.try_claim(index, self.holder) == Claim::Lost {
                    pair[..i].iter().for_each(|&p| self.claims.release(p, self.holder));
                    return Ok(Attempt::ClaimLost);
                }
            }
            for index in pair {
                self.counters.store(index, self.counters.load(index) + 1);
                self.claims.release(index, self.holder);
            }
            more.extend((0..children).map(|_| (at, 0)));
            Ok(Attempt::Done)
        }
    }

    fn add(items: Vec<(usize, u32)>, threads: u32) -> (Result<(SpeculativeCounts, Vec<(usize, u32)>)>, u32, bool) {
        let context = RunContext::with_threads(threads as usize).unwrap();
        let claims = ClaimTable::new(3);
        let mut counters = [0u32; 3];
        let shared = SharedWords::new(&mut counters);
        let mut workers: Vec<_> =
            (0..threads).map(|holder| Adder { holder, claims: &claims, counters: shared }).collect();
        let settings = WorkSettings { buckets: 40, transfer_share: 0.3, transfer_decay: 1.0 };
        let result = run_speculative(&context, &mut workers, items, settings);
        (result, counters.iter().sum(), claims.is_all_free())
    }

    #[test]
    fn every_item_is_carried_out_however_many_threads_fight() {
        for threads in [1, 2, 4] {
            let count = if cfg!(miri) { 60 } else { 6000 };
            let items = (0..count).map(|i| (i % 3, u32::from(i % 2 == 0))).collect();
            let (result, sum, all_free) = add(items, threads);
            let (counts, no_room) = result.unwrap();
            assert_eq!(sum as usize, 2 * (count + count / 2));
            assert!(all_free && no_room.is_empty());
            assert_eq!(counts.attempts - counts.lost, (count + count / 2) as u64);
        }
    }

    #[test]
    fn items_without_room_come_back() {
        let (result, sum, _) = add(vec![(0, 0), (1, 50), (2, 0)], 2);
        assert_eq!((result.unwrap().1, sum), (vec![(1, 50)], 4));
    }

    #[test]
    fn an_error_ends_the_run() {
        let mut items = vec![(0, 0); 500];
        items[250] = (0, 99);
        assert!(matches!(add(items, 3).0, Err(Error::InvalidInput { .. })));
    }
}
