//! What a mesh was before the changes of a trial, so that all of them can be taken back.
//!
//! # Method
//! While a trial is open, each replacement of tets, each move and each new vertex adds an entry. Taking a trial back goes
//! through its entries from the last to the first; each undoes exactly what was done, down to the slots of the tets. Trials
//! nest: a step that tries something within a larger trial takes back its own entries only. When the outermost trial ends the
//! log is emptied.
//!
//! # Invariants
//! Outside of trials the log is empty.
//!
//! # Cost
//! 24 bytes per tet of a replacement, 32 per entry, as long as a trial is open.

use glam::DVec3;

use crate::index::Label;

/// A tet that a replacement took.
#[derive(Debug, Clone, Copy)]
pub struct Taken {
    /// Its slot.
    pub slot: u32,
    /// Its vertices.
    pub tet: [u32; 4],
    /// Its label.
    pub label: Label,
}

/// A slot that a replacement filled.
#[derive(Debug, Clone, Copy)]
pub struct Filled {
    /// The slot.
    pub slot: u32,
    /// Whether there was no free slot, so that it was appended.
    pub is_new: bool,
}

/// One change.
#[derive(Debug, Clone, Copy)]
enum Entry {
    /// A vertex moved, from there.
    Move(u32, DVec3),
    /// A vertex was added.
    Vertex,
    /// Tets were replaced: how many were taken and filled in.
    Replacement { taken: u32, filled: u32 },
}

/// The last change, taken from the log.
#[derive(Debug, Clone)]
pub enum Undone {
    /// A vertex moved, from there.
    Move(u32, DVec3),
    /// A vertex was added.
    Vertex,
    /// Tets were replaced.
    Replacement(Vec<Taken>, Vec<Filled>),
}

/// A time to come back to.
#[derive(Debug, Clone, Copy)]
#[must_use]
pub struct Mark(usize);

/// The changes since the outermost open trial began.
#[derive(Debug, Clone, Default)]
pub struct ChangeLog {
    open: usize,
    entries: Vec<Entry>,
    taken: Vec<Taken>,
    filled: Vec<Filled>,
}

impl ChangeLog {
    /// Whether changes are to be noted.
    #[inline]
    pub fn is_open(&self) -> bool {
        self.open > 0
    }

    /// A trial begins.
    pub fn begin(&mut self) -> Mark {
        self.open += 1;
        Mark(self.entries.len())
    }

    /// The trial that began last ends; what it changed stays part of the trial around it.
    pub fn end(&mut self) {
        self.open -= 1;
        if self.open == 0 {
            self.entries.clear();
            self.taken.clear();
            self.filled.clear();
        }
    }

    /// A vertex moves away from a place.
    pub fn note_move(&mut self, v: u32, from: DVec3) {
        self.entries.push(Entry::Move(v, from));
    }

    /// A vertex is added.
    pub fn note_vertex(&mut self) {
        self.entries.push(Entry::Vertex);
    }

    /// Tets are replaced.
    pub fn note_replacement(&mut self, taken: impl Iterator<Item = Taken>, filled: impl Iterator<Item = Filled>) {
        let before = (self.taken.len(), self.filled.len());
        self.taken.extend(taken);
        self.filled.extend(filled);
        let (taken, filled) = ((self.taken.len() - before.0) as u32, (self.filled.len() - before.1) as u32);
        self.entries.push(Entry::Replacement { taken, filled });
    }

    /// Takes the last change since the mark out of the log.
    pub fn pop(&mut self, mark: Mark) -> Option<Undone> {
        if self.entries.len() <= mark.0 {
            return None;
        }
        self.entries.pop().map(|entry| match entry {
            Entry::Move(v, from) => Undone::Move(v, from),
            Entry::Vertex => Undone::Vertex,
            Entry::Replacement { taken, filled } => {
                let taken = self.taken.split_off(self.taken.len() - taken as usize);
                Undone::Replacement(taken, self.filled.split_off(self.filled.len() - filled as usize))
            }
        })
    }

    /// The vertices that moved since the mark, and those of tets that were taken; some more than once.
    pub fn touched(&self, mark: Mark) -> Vec<u32> {
        let entries = &self.entries[mark.0..];
        let taken: u32 =
            entries.iter().map(|e| if let Entry::Replacement { taken, .. } = e { *taken } else { 0 }).sum();
        let moved = entries.iter().filter_map(|e| if let Entry::Move(v, _) = e { Some(*v) } else { None });
        moved.chain(self.taken[self.taken.len() - taken as usize..].iter().flat_map(|row| row.tet)).collect()
    }
}
