//! The flag word of a tet: bit table and accessors.
//!
//! # Method
//! One `u16` per tet.
//!
//! | bit | name | meaning |
//! |---|---|---|
//! | 0-3 | constrained face `f` | face `f` lies on an input facet or another interface; flips must keep it |
//! | 4-9 | constrained edge `e` | edge `e` of `numbering::TET_EDGES` lies on an input segment; flips must keep it |
//! | 10 | deleted | the slot holds no tet and may be reused |
//! | 11 | queued | the tet waits in a work list (front, reconnection queue) |
//! | 12 | marked | scratch mark of one operation; clear between operations |
//! | 13-15 | user 0-2 | free for the engine that edits the complex; clear when it hands the complex on |
//!
//! # Invariants
//! A constrained face is flagged on both of its sides, a constrained edge in every tet of its shell. A deleted tet has
//! only the bit `deleted`.

/// Flags of one tet; see the module table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub struct TetFlags(u16);

const FACES: u16 = 0x000f;
const FIRST_EDGE: usize = 4;
const EDGES: u16 = 0x03f0;
const DELETED: u16 = 1 << 10;
const QUEUED: u16 = 1 << 11;
const MARKED: u16 = 1 << 12;
const FIRST_USER: usize = 13;

impl TetFlags {
    /// A live tet without constraints.
    pub const LIVE: Self = Self(0);
    /// A free slot.
    pub const DELETED: Self = Self(DELETED);

    /// The flags of a stored word.
    #[inline]
    pub fn from_bits(bits: u16) -> Self {
        Self(bits)
    }

    /// The word to store.
    #[inline]
    pub fn bits(self) -> u16 {
        self.0
    }

    #[inline]
    fn with(self, mask: u16, on: bool) -> Self {
        if on { Self(self.0 | mask) } else { Self(self.0 & !mask) }
    }

    /// Whether face `face` is constrained.
    #[inline]
    pub fn is_face_constrained(self, face: usize) -> bool {
        debug_assert!(face < 4);
        self.0 & (1 << face) != 0
    }

    /// Whether any face is constrained.
    #[inline]
    pub fn has_constrained_face(self) -> bool {
        self.0 & FACES != 0
    }

    /// Sets or clears the constraint of face `face`.
    #[inline]
    #[must_use]
    pub fn with_face(self, face: usize, constrained: bool) -> Self {
        debug_assert!(face < 4);
        self.with(1 << face, constrained)
    }

    /// Whether edge `edge` of `numbering::TET_EDGES` is constrained.
    #[inline]
    pub fn is_edge_constrained(self, edge: usize) -> bool {
        debug_assert!(edge < 6);
        self.0 & (1 << (FIRST_EDGE + edge)) != 0
    }

    /// Whether any edge is constrained.
    #[inline]
    pub fn has_constrained_edge(self) -> bool {
        self.0 & EDGES != 0
    }

    /// Sets or clears the constraint of edge `edge`.
    #[inline]
    #[must_use]
    pub fn with_edge(self, edge: usize, constrained: bool) -> Self {
        debug_assert!(edge < 6);
        self.with(1 << (FIRST_EDGE + edge), constrained)
    }

    /// Whether the slot is free.
    #[inline]
    pub fn is_deleted(self) -> bool {
        self.0 & DELETED != 0
    }

    /// Whether the tet waits in a work list.
    #[inline]
    pub fn is_queued(self) -> bool {
        self.0 & QUEUED != 0
    }

    /// Sets or clears `queued`.
    #[inline]
    #[must_use]
    pub fn with_queued(self, queued: bool) -> Self {
        self.with(QUEUED, queued)
    }

    /// Whether the scratch mark is set.
    #[inline]
    pub fn is_marked(self) -> bool {
        self.0 & MARKED != 0
    }

    /// Sets or clears the scratch mark.
    #[inline]
    #[must_use]
    pub fn with_mark(self, marked: bool) -> Self {
        self.with(MARKED, marked)
    }

    /// Whether user bit `bit` (0 to 2) is set.
    #[inline]
    pub fn has_user_bit(self, bit: usize) -> bool {
        debug_assert!(bit < 3);
        self.0 & (1 << (FIRST_USER + bit)) != 0
    }

    /// Sets or clears user bit `bit` (0 to 2).
    #[inline]
    #[must_use]
    pub fn with_user_bit(self, bit: usize, on: bool) -> Self {
        debug_assert!(bit < 3);
        self.with(1 << (FIRST_USER + bit), on)
    }

    /// Clears all user bits.
    #[inline]
    #[must_use]
    pub fn without_user_bits(self) -> Self {
        self.with(0b111 << FIRST_USER, false)
    }

    /// Only the constraint bits.
    #[inline]
    #[must_use]
    pub fn constraints(self) -> Self {
        Self(self.0 & (FACES | EDGES))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_do_not_overlap() {
        let mut flags = TetFlags::LIVE;
        for face in 0..4 {
            flags = flags.with_face(face, true);
        }
        for edge in 0..6 {
            flags = flags.with_edge(edge, true);
        }
        assert!(!flags.is_deleted() && !flags.is_queued() && !flags.is_marked());
        flags = flags.with_queued(true).with_mark(true).with_user_bit(0, true).with_user_bit(2, true);
        assert!(!flags.is_deleted() && !flags.has_user_bit(1));
        assert_eq!(flags.bits().count_ones(), 14);
        assert_eq!(flags.constraints().bits(), 0x3ff);
        assert!(TetFlags::DELETED.is_deleted() && !flags.with_face(2, false).is_face_constrained(2));
    }
}
