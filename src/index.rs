//! Index newtypes: one type per entity, so that a vertex is never used as a tet.
//!
//! # Invariants
//! Every id is a `u32` below `u32::MAX`; `u32::MAX` is the documented sentinel `NONE` (for vertices `GHOST`) used
//! in hot storage only. Interfaces use `Option`. [`TetFace`] packs `4 * tet + face`, so at most 2^30 tets exist.

use crate::error::{Error, Result};

/// Members in order, each once.
pub fn each_once<T: Ord>(members: impl Iterator<Item = T>) -> Vec<T> {
    let mut members: Vec<T> = members.collect();
    members.sort_unstable();
    members.dedup();
    members
}

macro_rules! define_id {
    ($(#[$doc:meta])* $name:ident, $what:literal) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, bytemuck::Pod, bytemuck::Zeroable)]
        #[repr(transparent)]
        pub struct $name(pub u32);

        impl $name {
            /// The sentinel of hot storage: no entity.
            pub const NONE: Self = Self(u32::MAX);

            /// The id of the `index`-th entity.
            ///
            /// # Errors
            /// [`Error::CapacityExceeded`] where the index does not fit.
            pub fn try_new(index: usize) -> Result<Self> {
                if index < u32::MAX as usize {
                    Ok(Self(index as u32))
                } else {
                    Err(Error::CapacityExceeded { what: $what, needed: index as u64 + 1, limit: u64::from(u32::MAX) })
                }
            }

            /// The id of an index that is known to fit: the storage that holds it checked the capacity.
            #[inline]
            pub fn from_index(index: usize) -> Self {
                debug_assert!(index < u32::MAX as usize);
                Self(index as u32)
            }

            /// The position in the arrays of this entity.
            #[inline]
            pub fn index(self) -> usize {
                self.0 as usize
            }

            /// `None` for the sentinel.
            #[inline]
            pub fn some(self) -> Option<Self> {
                if self == Self::NONE { None } else { Some(self) }
            }
        }
    };
}

define_id!(
    /// A mesh vertex.
    VertexId, "vertices"
);
define_id!(
    /// A tetrahedron of a [`crate::mesh`] complex.
    TetId, "tets"
);
define_id!(
    /// An element of any kind of a finished mesh.
    ElementId, "elements"
);
define_id!(
    /// An input surface triangle.
    FacetId, "facets"
);
define_id!(
    /// A side of a tet, packed `4 * tet + face`; the face is opposite to the local vertex of the same number.
    TetFace, "tet faces"
);

impl VertexId {
    /// The vertex at infinity that closes the hull of a Delaunay complex.
    pub const GHOST: Self = Self::NONE;

    /// Whether this is the vertex at infinity.
    #[inline]
    pub fn is_ghost(self) -> bool {
        self == Self::GHOST
    }
}

impl TetFace {
    /// Side `face` (0 to 3) of `tet`.
    #[inline]
    pub fn new(tet: TetId, face: usize) -> Self {
        debug_assert!(face < 4 && tet.0 < 1 << 30);
        Self(tet.0 << 2 | face as u32)
    }

    /// The tet of this side.
    #[inline]
    pub fn tet(self) -> TetId {
        TetId(self.0 >> 2)
    }

    /// The local number of this side, 0 to 3.
    #[inline]
    pub fn face(self) -> usize {
        (self.0 & 3) as usize
    }
}

/// An internal material number: 0 is background, 1 and up index a table of the caller's label values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub struct Label(pub u16);

impl Label {
    /// Outside of every material.
    pub const BACKGROUND: Self = Self(0);

    /// Position in per-label arrays.
    #[inline]
    pub fn index(self) -> usize {
        usize::from(self.0)
    }

    /// Whether this is the background.
    #[inline]
    pub fn is_background(self) -> bool {
        self.0 == 0
    }

    /// Whether what has this label is part of the solid of a label: of what has that label, for the background of all labels
    /// together, whose surface is that of the background.
    #[inline]
    pub fn is_in_solid_of(self, label: Self) -> bool {
        (self == label) != label.is_background()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tet_face_packs_and_unpacks() {
        let side = TetFace::new(TetId(77), 3);
        assert_eq!((side.tet(), side.face()), (TetId(77), 3));
    }

    #[test]
    fn id_overflow_is_an_error() {
        assert!(VertexId::try_new(u32::MAX as usize - 1).is_ok());
        assert!(matches!(VertexId::try_new(u32::MAX as usize), Err(Error::CapacityExceeded { .. })));
    }
}
