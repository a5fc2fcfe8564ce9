//! Ownership of numbered things (vertices) by threads, without waiting.
//!
//! # Protocol
//! One word per thing: 0 is free, `holder + 1` is held. Only two transitions exist: free to held, by the thread that
//! will hold it, and held to free, by its holder.
//! - *No state is lost*: the first transition is a compare-exchange, so of several threads exactly one succeeds; the
//!   second is a store by the only thread that may change a held word.
//! - *No deadlock*: a claim never waits. A thread that loses one gives back all that it holds and tries later.
//! - *Visibility*: a successful claim acquires what the previous holder released, so everything that was written
//!   under the previous claim is seen under this one.
//!
//! # Cost
//! 4 B a thing; a claim of a free word is one compare-exchange, of an own word one load.

use std::sync::atomic::{AtomicU32, Ordering};

const FREE: u32 = 0;

/// What became of a claim.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Claim {
    /// Free before, now held by the caller, who has to release it.
    Taken,
    /// Held by the caller before.
    Held,
    /// Held by another thread.
    Lost,
}

/// One claim word per thing.
#[derive(Debug, Default)]
pub struct ClaimTable {
    words: Vec<AtomicU32>,
}

impl ClaimTable {
    /// A table of `count` free things.
    pub fn new(count: usize) -> Self {
        Self { words: (0..count).map(|_| AtomicU32::new(FREE)).collect() }
    }

    /// Makes the table at least `count` things long; new ones are free. A table kept from pass to pass costs only this.
    pub fn grow_to(&mut self, count: usize) {
        if self.words.len() < count {
            self.words.resize_with(count, || AtomicU32::new(FREE));
        }
    }

    /// Number of things.
    pub fn len(&self) -> usize {
        self.words.len()
    }

    /// Whether there is nothing to claim.
    pub fn is_empty(&self) -> bool {
        self.words.is_empty()
    }

    /// Tries to take thing `index` for thread `holder`.
    #[inline]
    pub fn try_claim(&self, index: usize, holder: u32) -> Claim {
        let word = &self.words[index];
        // Relaxed: the value `holder + 1` can only have been stored by this thread; any other value decides nothing
        // but whether the compare-exchange is worth trying.
        let seen = word.load(Ordering::Relaxed);
        if seen == holder + 1 {
            return Claim::Held;
        }
        // Acquire: pairs with the Release in `release`; makes the previous holder's writes visible. Relaxed on
        // failure: the caller learns nothing about the data.
        if seen == FREE && word.compare_exchange(FREE, holder + 1, Ordering::Acquire, Ordering::Relaxed).is_ok() {
            Claim::Taken
        } else {
            Claim::Lost
        }
    }

    /// Gives thing `index` back; the caller holds it.
    #[inline]
    pub fn release(&self, index: usize, holder: u32) {
        // Relaxed: only this thread can have stored its own mark.
        debug_assert_eq!(self.words[index].load(Ordering::Relaxed), holder + 1);
        let _ = holder;
        // Release: pairs with the Acquire in `try_claim`; publishes what was written under the claim.
        self.words[index].store(FREE, Ordering::Release);
    }

    /// Whether nothing is held; meaningful only while no thread claims.
    pub fn is_all_free(&self) -> bool {
        // Relaxed: the caller has joined the threads, which orders their stores before.
        self.words.iter().all(|w| w.load(Ordering::Relaxed) == FREE)
    }
}

#[cfg(test)]
mod tests {
    use super::super::shared_rows::SharedWords;
    use super::*;

    #[test]
    fn a_claim_excludes_others_until_released() {
        let table = ClaimTable::new(3);
        assert_eq!(table.try_claim(1, 0), Claim::Taken);
        assert_eq!(table.try_claim(1, 0), Claim::Held);
        assert_eq!(table.try_claim(1, 7), Claim::Lost);
        table.release(1, 0);
        assert_eq!(table.try_claim(1, 7), Claim::Taken);
        assert!(!table.is_all_free());
        table.release(1, 7);
        assert!(table.is_all_free());
    }

    #[test]
    fn plain_counters_under_claims_lose_no_increment() {
        const ROUNDS: u32 = if cfg!(miri) { 50 } else { 20_000 };
        let table = ClaimTable::new(5);
        let mut counters = vec![0u32; 5];
        let shared = SharedWords::new(&mut counters);
        std::thread::scope(|scope| {
            for holder in 0..4 {
                let (table, shared) = (&table, &shared);
                scope.spawn(move || {
                    let mut left = ROUNDS;
                    let mut at = holder as usize;
                    while left > 0 {
                        at = (at * 7 + 3) % 5;
                        if table.try_claim(at, holder) == Claim::Taken {
                            // Two accesses: without the claim an increment would get lost.
                            shared.store(at, shared.load(at) + 1);
                            table.release(at, holder);
                            left -= 1;
                        } else {
                            std::thread::yield_now();
                        }
                    }
                });
            }
        });
        assert_eq!(counters.iter().sum::<u32>(), 4 * ROUNDS);
        assert!(table.is_all_free());
    }
}
