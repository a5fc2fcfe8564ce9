//! The replacements of tets in the order they were made, so that any of them can be taken back later.
//!
//! # Method
//! A change is a row of tets that went and a row of tets that came. Each tet that came remembers its slot while it lives, and
//! the change that took it afterwards. A change can be undone when all tets it brought are live, that is after those changes
//! that took them; what comes back is then joined to the change that had brought it.
//!
//! # Invariants
//! Undoing fills the same space with the tets there were before, so the mesh conforms after each step.
//!
//! # Cost
//! 32 bytes per tet of a change and 4 per slot.

use crate::index::Label;

/// No row, no change, no slot.
pub const NONE: u32 = u32::MAX;

/// A tet that went or came.
#[derive(Debug, Clone, Copy)]
struct Row {
    tet: [u32; 4],
    label: Label,
    /// A tet that went: the row of it when it came, `NONE` for one of the first mesh. A tet that came: its slot.
    link: u32,
    /// A tet that came: the change that took it, `NONE` while it is live.
    taken_by: u32,
}

/// Where the rows of a change are.
#[derive(Debug, Clone, Copy, Default)]
struct Change {
    first_old: u32,
    first_new: u32,
    end: u32,
}

/// Changes of a mesh of tets in slots.
#[derive(Debug, Clone, Default)]
pub struct ChangeLog {
    rows: Vec<Row>,
    changes: Vec<Change>,
    /// The row of the tet in each slot, `NONE` for one of the first mesh.
    row_of: Vec<u32>,
}

impl ChangeLog {
    /// The log of a mesh of so many tets that has not changed yet.
    pub fn new(tets: usize) -> Self {
        Self { row_of: vec![NONE; tets], ..Self::default() }
    }

    /// A new change begins.
    pub fn begin(&mut self) {
        let at = self.rows.len() as u32;
        self.changes.push(Change { first_old: at, first_new: at, end: at });
    }

    /// The change takes the tet in a slot; all of these come before those it brings.
    pub fn remove(&mut self, slot: u32, tet: [u32; 4], label: Label) {
        let change = self.changes.len() as u32 - 1;
        let link = std::mem::replace(&mut self.row_of[slot as usize], NONE);
        if let Some(row) = self.rows.get_mut(link as usize) {
            row.taken_by = change;
        }
        self.rows.push(Row { tet, label, link, taken_by: NONE });
        let end = self.rows.len() as u32;
        if let Some(last) = self.changes.last_mut() {
            (last.first_new, last.end) = (end, end);
        }
    }

    /// The change brings a tet into a slot.
    pub fn add(&mut self, slot: u32, tet: [u32; 4], label: Label) {
        self.set_row(slot, self.rows.len() as u32);
        self.rows.push(Row { tet, label, link: slot, taken_by: NONE });
        if let Some(last) = self.changes.last_mut() {
            last.end = self.rows.len() as u32;
        }
    }

    fn set_row(&mut self, slot: u32, row: u32) {
        if slot as usize >= self.row_of.len() {
            self.row_of.resize(slot as usize + 1, NONE);
        }
        self.row_of[slot as usize] = row;
    }

    /// The last change.
    pub fn last(&self) -> Option<u32> {
        (self.changes.len() as u32).checked_sub(1)
    }

    /// The change that brought the tet in a slot; `None` for one of the first mesh.
    pub fn change_of(&self, slot: u32) -> Option<u32> {
        let row = self.row_of[slot as usize];
        (row != NONE).then(|| self.changes.partition_point(|c| c.end <= row) as u32)
    }

    /// A later change that must be undone before this one.
    pub fn blocker(&self, change: u32) -> Option<u32> {
        self.brought(change).map(|row| row.taken_by).find(|c| *c != NONE)
    }

    fn brought(&self, change: u32) -> impl Iterator<Item = &Row> {
        let change = &self.changes[change as usize];
        self.rows[change.first_new as usize..change.end as usize].iter()
    }

    /// Slots of the tets that a change brought; it has no blocker.
    pub fn slots(&self, change: u32) -> Vec<u32> {
        self.brought(change).map(|row| row.link).filter(|slot| *slot != NONE).collect()
    }

    /// The tets that a change took.
    pub fn taken(&self, change: u32) -> Vec<([u32; 4], Label)> {
        let change = &self.changes[change as usize];
        let rows = &self.rows[change.first_old as usize..change.first_new as usize];
        rows.iter().map(|row| (row.tet, row.label)).collect()
    }

    /// The tets that a change took are back in these slots, and what it brought is gone.
    pub fn forget(&mut self, change: u32, slots: &[u32]) {
        let at = self.changes[change as usize];
        for row in at.first_new..at.end {
            let slot = std::mem::replace(&mut self.rows[row as usize].link, NONE);
            // The slot may hold one of the tets that came back.
            if self.row_of.get(slot as usize) == Some(&row) {
                self.row_of[slot as usize] = NONE;
            }
        }
        for (row, slot) in (at.first_old..at.first_new).zip(slots) {
            let link = self.rows[row as usize].link;
            if let Some(maker) = self.rows.get_mut(link as usize) {
                (maker.link, maker.taken_by) = (*slot, NONE);
            }
            self.set_row(*slot, link);
        }
        if change as usize + 1 == self.changes.len() {
            self.rows.truncate(at.first_old as usize);
            self.changes.pop();
        }
    }
}
