//! Axis-parallel boxes.

use glam::DVec3;

/// A closed axis-parallel box; [`BoundingBox::EMPTY`] contains nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoundingBox {
    /// Lower corner.
    pub lower: DVec3,
    /// Upper corner.
    pub upper: DVec3,
}

impl BoundingBox {
    /// Contains no point; growing it by a point gives that point.
    pub const EMPTY: Self = Self { lower: DVec3::INFINITY, upper: DVec3::NEG_INFINITY };

    /// The smallest box of some points.
    pub fn of_points(points: impl IntoIterator<Item = DVec3>) -> Self {
        points.into_iter().fold(Self::EMPTY, Self::with_point)
    }

    /// Whether no point is inside.
    pub fn is_empty(self) -> bool {
        self.lower.cmpgt(self.upper).any()
    }

    /// The smallest box that contains this one and `point`.
    #[must_use]
    #[inline]
    pub fn with_point(self, point: DVec3) -> Self {
        Self { lower: self.lower.min(point), upper: self.upper.max(point) }
    }

    /// The smallest box that contains both.
    #[must_use]
    #[inline]
    pub fn union(self, other: Self) -> Self {
        Self { lower: self.lower.min(other.lower), upper: self.upper.max(other.upper) }
    }

    /// Whether the closed boxes share a point.
    #[inline]
    pub fn overlaps(self, other: Self) -> bool {
        self.lower.cmple(other.upper).all() && other.lower.cmple(self.upper).all()
    }

    /// Whether `point` is inside or on the border.
    #[inline]
    pub fn contains(self, point: DVec3) -> bool {
        self.lower.cmple(point).all() && point.cmple(self.upper).all()
    }

    /// Edge lengths.
    pub fn size(self) -> DVec3 {
        self.upper - self.lower
    }

    /// Length of the diagonal; 0 for an empty box.
    pub fn diagonal(self) -> f64 {
        if self.is_empty() { 0.0 } else { self.size().length() }
    }

    /// The middle.
    pub fn center(self) -> DVec3 {
        0.5 * self.lower + 0.5 * self.upper
    }

    /// Squared distance of `point` to the box, 0 inside.
    #[inline]
    pub fn squared_distance(self, point: DVec3) -> f64 {
        (point - point.clamp(self.lower, self.upper)).length_squared()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_grow_and_overlap() {
        let unit = BoundingBox::of_points([DVec3::ZERO, DVec3::ONE]);
        assert!(BoundingBox::EMPTY.is_empty() && !unit.is_empty());
        assert!(unit.overlaps(BoundingBox::of_points([DVec3::ONE, DVec3::splat(2.0)])));
        assert!(!unit.overlaps(BoundingBox::of_points([DVec3::splat(1.1), DVec3::splat(2.0)])));
        assert!(unit.contains(DVec3::splat(0.5)));
        assert_eq!(unit.squared_distance(DVec3::new(3.0, 0.5, 0.5)), 4.0);
    }
}
