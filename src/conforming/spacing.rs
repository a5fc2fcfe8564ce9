//! How close vertices may come to each other in quality improvement, and how far they may part.
//!
//! # Method
//! An edge keeps its length when it is at least a factor times the average size of its ends, and at most another: with others
//! the mesh would no longer follow the size field.
//!
//! # Source
//! [Drakopoulos2017] 4.7.1 (distribution function).

use crate::index::VertexId;

/// The least and the largest length of edges.
#[derive(Debug, Clone, Copy)]
pub struct Spacing<'a> {
    /// Sizes of the vertices; those beyond the end, and new ones of size 0, ask for nothing.
    pub sizes: &'a [f64],
    /// Share of the average size of an edge's ends; 0 where vertices may crowd.
    pub factor: f64,
    /// The most of it; infinite where vertices may part.
    pub longest: f64,
}

impl Spacing<'_> {
    /// No limit.
    pub const FREE: Self = Self { sizes: &[], factor: 0.0, longest: f64::INFINITY };

    /// Whether every length is allowed.
    #[inline]
    pub fn is_free(&self) -> bool {
        self.factor <= 0.0
    }

    /// The size of a vertex.
    #[inline]
    pub fn size_of(&self, vertex: VertexId) -> f64 {
        self.sizes.get(vertex.index()).copied().unwrap_or(0.0)
    }

    /// Whether a point of `size` may lie so far from a vertex.
    #[inline]
    pub fn reaches(&self, size: f64, vertex: VertexId, squared_distance: f64) -> bool {
        let limit = 0.5 * self.longest * (size + self.size_of(vertex));
        // Without sizes the limit of infinitely long edges is no number.
        self.longest.is_infinite() || squared_distance <= limit * limit
    }

    /// Whether a point of `size` may lie so close to a vertex.
    #[inline]
    pub fn holds(&self, size: f64, vertex: VertexId, squared_distance: f64) -> bool {
        let limit = 0.5 * self.factor * (size + self.size_of(vertex));
        squared_distance >= limit * limit
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_average_size_of_the_ends_decides() {
        let spacing = Spacing { sizes: &[1.0, 3.0], factor: 0.5, longest: f64::INFINITY };
        assert!(spacing.holds(1.0, VertexId(0), 0.25) && !spacing.holds(1.0, VertexId(0), 0.24));
        assert!(spacing.holds(1.0, VertexId(1), 1.0) && !spacing.holds(1.0, VertexId(1), 0.99));
        let bounded = Spacing { longest: 1.5, ..spacing };
        assert!(bounded.reaches(1.0, VertexId(1), 9.0) && !bounded.reaches(1.0, VertexId(1), 9.01));
        assert!(spacing.reaches(0.0, VertexId(7), 9.0), "endlessly far where there is no limit");
        assert_eq!(spacing.size_of(VertexId(7)), 0.0, "newer than the sizes");
        assert!(!spacing.is_free() && Spacing::FREE.is_free() && Spacing::FREE.holds(9.0, VertexId(1), 0.0));
    }
}
