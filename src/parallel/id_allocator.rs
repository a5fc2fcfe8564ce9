//! Free ids dealt to threads in blocks, and recycled by the thread that frees them.
//!
//! # Protocol
//! The free ids of a pass are listed before it starts; the list never changes while threads run. A shared cursor says
//! how much of it was dealt. A thread takes the next block by advancing the cursor, and uses, frees and reuses ids in a
//! list of its own; when it ends it hands that list back under a lock.
//! - *No id is dealt twice*: the cursor only grows, by one atomic addition per block.
//! - *No id is lost*: what is left is the list before the cursor, which counts from the end, and the lists handed back.
//! - *Reuse*: an id freed by a thread is reused by that thread only, in the same pass. A thread that remembers a freed
//!   id has to look again at what the slot holds after claiming it: no generation stamp is needed where the content
//!   identifies it (the four vertices of a tet, all claimed).
//! - *No deadlock*: the lock is held for one append.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Ids a thread takes at a time: few trips to the cursor, little left over.
const BLOCK: usize = 256;

/// The free ids of one pass.
#[derive(Debug, Default)]
pub struct IdPool {
    ids: Vec<u32>,
    block: usize,
    next: AtomicUsize,
    returned: Mutex<Vec<u32>>,
}

impl IdPool {
    /// A pool of these ids, dealt from the end in blocks, each from its end.
    pub fn new(ids: Vec<u32>) -> Self {
        Self::with_block(ids, BLOCK)
    }

    /// The same with blocks of this size, for threads whose ids should not lie side by side.
    pub fn with_block(ids: Vec<u32>, block: usize) -> Self {
        Self { ids, block, next: AtomicUsize::new(0), returned: Mutex::default() }
    }

    /// An empty allocator of this pool.
    pub fn allocator(&self) -> IdAllocator<'_> {
        IdAllocator { pool: self, free: Vec::new() }
    }

    fn take_block(&self) -> &[u32] {
        // Relaxed: the list itself was complete before the threads started; only the sum has to be exact.
        let dealt = self.next.fetch_add(self.block, Ordering::Relaxed).min(self.ids.len());
        let end = self.ids.len() - dealt;
        &self.ids[end.saturating_sub(self.block)..end]
    }

    /// All ids that are free after the pass, when every allocator is gone.
    pub fn into_free(self) -> Vec<u32> {
        let dealt = self.next.into_inner().min(self.ids.len());
        let mut free = self.ids;
        free.truncate(free.len() - dealt);
        free.append(&mut self.returned.into_inner().unwrap_or_else(PoisonError::into_inner));
        free
    }
}

/// One thread's free ids; what is left goes back to the pool when it is dropped.
#[derive(Debug)]
pub struct IdAllocator<'a> {
    pool: &'a IdPool,
    free: Vec<u32>,
}

impl IdAllocator<'_> {
    /// Makes sure that `count` ids can be taken; false where the pool is used up.
    #[inline]
    pub fn has_room(&mut self, count: usize) -> bool {
        while self.free.len() < count {
            let block = self.pool.take_block();
            if block.is_empty() {
                return false;
            }
            self.free.extend_from_slice(block);
        }
        true
    }

    /// A free id, or `None` where there is none left.
    #[inline]
    pub fn take(&mut self) -> Option<u32> {
        if self.has_room(1) { self.free.pop() } else { None }
    }

    /// Makes an id free again; this thread will reuse it first.
    #[inline]
    pub fn recycle(&mut self, id: u32) {
        self.free.push(id);
    }
}

impl Drop for IdAllocator<'_> {
    fn drop(&mut self) {
        self.pool.returned.lock().unwrap_or_else(PoisonError::into_inner).append(&mut self.free);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_id_is_dealt_once_and_comes_back() {
        const COUNT: u32 = if cfg!(miri) { 1000 } else { 20_000 };
        let pool = IdPool::new((0..COUNT).collect());
        let kept: Vec<u32> = std::thread::scope(|scope| {
            let threads: Vec<_> = (0..4)
                .map(|_| {
                    scope.spawn(|| {
                        let mut ids = pool.allocator();
                        let mut kept = Vec::new();
                        let mut taken = 0;
                        while let Some(id) = ids.take() {
                            kept.push(id);
                            taken += 1;
                            if taken % 3 == 0 {
                                ids.recycle(kept.swap_remove(0));
                            }
                        }
                        // One in two is given back at the end.
                        let half = kept.split_off(kept.len() / 2);
                        half.into_iter().for_each(|id| ids.recycle(id));
                        kept
                    })
                })
                .collect();
            threads.into_iter().flat_map(|t| t.join().unwrap()).collect()
        });
        let mut all = pool.into_free();
        assert!(!all.is_empty() && !kept.is_empty());
        all.extend(kept);
        all.sort_unstable();
        assert_eq!(all, (0..COUNT).collect::<Vec<_>>());
    }

    #[test]
    fn room_is_refused_when_the_pool_is_empty() {
        let pool = IdPool::new(vec![4, 5]);
        let mut ids = pool.allocator();
        assert!(ids.has_room(2) && !ids.has_room(3));
        assert_eq!((ids.take(), ids.take(), ids.take()), (Some(5), Some(4), None));
        drop(ids);
        assert!(pool.into_free().is_empty());
    }
}
