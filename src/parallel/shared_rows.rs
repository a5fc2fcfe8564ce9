//! Arrays that several threads read and write at once, by a protocol of the caller's (claims, or disjoint parts).
//!
//! # Protocol
//! A view borrows a plain array exclusively and shares it as atomic words. Every access is a relaxed load or store of
//! one word, so a race is never undefined behaviour: at worst a row is seen half old and half new. Who may write a
//! row, and how a reader makes sure that what it saw still holds, is the caller's protocol; the order between threads
//! comes from its claims (`claim_table`) or from joining the threads.
//!
//! # Cost
//! Relaxed accesses are plain moves on every common processor.

#![allow(unsafe_code)] // one cast from plain to atomic words, argued below

use std::sync::atomic::{AtomicU8, AtomicU16, AtomicU32, AtomicU64, Ordering};

macro_rules! shared_words {
    ($(#[$doc:meta])* $name:ident, $word:ty, $atomic:ty) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy)]
        pub struct $name<'a> {
            words: &'a [$atomic],
        }

        impl<'a> $name<'a> {
            /// Shares an array for as long as the view lives.
            pub fn new(words: &'a mut [$word]) -> Self {
                const { assert!(size_of::<$word>() == size_of::<$atomic>()) };
                const { assert!(align_of::<$word>() == align_of::<$atomic>()) };
                // SAFETY: the atomic type has the size and bit validity of the plain one by its documentation, and
                // its alignment by the assertion; the exclusive borrow lasts as long as the view, so all accesses in
                // that time go through the atomics.
                let words = unsafe { &*(std::ptr::from_mut(words) as *const [$atomic]) };
                Self { words }
            }

            /// Number of words.
            #[inline]
            pub fn len(&self) -> usize {
                self.words.len()
            }

            /// Whether there are none.
            pub fn is_empty(&self) -> bool {
                self.words.is_empty()
            }

            /// Reads one word.
            #[inline]
            pub fn load(&self, index: usize) -> $word {
                // Relaxed: see the module's protocol.
                self.words[index].load(Ordering::Relaxed)
            }

            /// Writes one word.
            #[inline]
            pub fn store(&self, index: usize, word: $word) {
                // Relaxed: see the module's protocol.
                self.words[index].store(word, Ordering::Relaxed);
            }

            /// Reads `N` words from `first` on, one after the other.
            #[inline]
            pub fn load_row<const N: usize>(&self, first: usize) -> [$word; N] {
                let row = &self.words[first..first + N];
                // A loop, because closures over arrays are not inlined reliably and this is the hottest read of all.
                let mut values = [0; N];
                for i in 0..N {
                    // Relaxed: see the module's protocol.
                    values[i] = row[i].load(Ordering::Relaxed);
                }
                values
            }

            /// Writes `N` words from `first` on, one after the other.
            #[inline]
            pub fn store_row<const N: usize>(&self, first: usize, values: [$word; N]) {
                let row = &self.words[first..first + N];
                for i in 0..N {
                    // Relaxed: see the module's protocol.
                    row[i].store(values[i], Ordering::Relaxed);
                }
            }
        }
    };
}

shared_words!(
    /// A shared view of bytes.
    SharedBytes, u8, AtomicU8
);
shared_words!(
    /// A shared view of 16-bit words.
    SharedShorts, u16, AtomicU16
);
shared_words!(
    /// A shared view of 32-bit words.
    SharedWords, u32, AtomicU32
);
shared_words!(
    /// A shared view of 64-bit words.
    SharedLongs, u64, AtomicU64
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_of_a_view_are_those_of_the_array() {
        let mut array = [1u32, 2, 3, 4, 5, 6];
        let view = SharedWords::new(&mut array);
        assert_eq!(view.load_row::<3>(1), [2, 3, 4]);
        view.store_row(4, [50, 60]);
        view.store(0, 10);
        assert_eq!((view.len(), view.load(5)), (6, 60));
        assert_eq!(array, [10, 2, 3, 4, 50, 60]);
    }

    #[test]
    fn threads_write_disjoint_parts() {
        let mut array = vec![0u64; 64];
        let view = SharedLongs::new(&mut array);
        std::thread::scope(|scope| {
            for part in 0..4 {
                scope.spawn(move || (part * 16..part * 16 + 16).for_each(|i| view.store(i, i as u64)));
            }
        });
        assert!(array.iter().enumerate().all(|(i, &v)| v == i as u64));
    }
}
