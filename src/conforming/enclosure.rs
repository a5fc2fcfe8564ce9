//! Step 2: the Delaunay mesh of the surface's points inside a box, so that every facet has tets on both sides.
//!
//! # Method
//! ```text
//!   +---------------------+    Eight points around the surface close the mesh far away. Facets on the hull of the
//!   |      .---.          |    surface then are inner faces like all others, and recovery needs no case for the hull.
//!   |     /surf \         |    Everything outside the surface goes when the domain is labelled.
//!   |     '-----'         |
//!   +---------------------+
//! ```
//! # Differences
//! [Drakopoulos2017] 4.4 starts from such a box as well; ours stays until the surface is recovered.

use glam::DVec3;

use crate::geometry::bounding_box::BoundingBox;

/// Distance of the box from the surface over the surface's largest extent: far enough that tets at the surface keep
/// their shape, near enough that the predicates' filters keep their digits.
const MARGIN: f64 = 1.0;

/// The eight corners of the box around the points, in the order of their bits (x 1, y 2, z 4).
pub fn enclosing_corners(points: &[DVec3]) -> [DVec3; 8] {
    let bounds = BoundingBox::of_points(points.iter().copied());
    let extent = bounds.size().max_element();
    let largest = bounds.lower.abs().max(bounds.upper.abs()).max_element();
    // Far from the origin the margin must not drown in rounding.
    let margin = DVec3::splat((MARGIN * extent).max(1e-9 * largest));
    let corners = [bounds.lower - margin, bounds.upper + margin];
    std::array::from_fn(|i| DVec3::new(corners[i & 1].x, corners[i >> 1 & 1].y, corners[i >> 2 & 1].z))
}
