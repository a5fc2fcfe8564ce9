//! Triangles: area, normal, closest point.
//!
//! # Source
//! [Ericson2004] section 5.1.5 for the closest point.

use glam::DVec3;

/// Twice the area times the unit normal; the triangle turns counter-clockwise seen from its tip.
#[inline]
pub fn scaled_normal(a: DVec3, b: DVec3, c: DVec3) -> DVec3 {
    (b - a).cross(c - a)
}

/// Area.
#[inline]
pub fn area(a: DVec3, b: DVec3, c: DVec3) -> f64 {
    0.5 * scaled_normal(a, b, c).length()
}

/// The point of the closed triangle closest to `point`.
pub fn closest_point(point: DVec3, a: DVec3, b: DVec3, c: DVec3) -> DVec3 {
    let (ab, ac) = (b - a, c - a);
    let ap = point - a;
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return a;
    }
    let bp = point - b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return b;
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return a + ab * (d1 / (d1 - d3));
    }
    let cp = point - c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return c;
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return a + ac * (d2 / (d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 >= d3 && d5 >= d6 {
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
    }
    let denominator = va + vb + vc;
    if denominator == 0.0 {
        return a; // no area: any corner is as near as rounding can tell
    }
    a + ab * (vb / denominator) + ac * (vc / denominator)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn closest_points_lie_on_face_edge_and_corner() {
        let (a, b, c) = (DVec3::ZERO, DVec3::X, DVec3::Y);
        assert!(closest_point(DVec3::new(0.2, 0.2, 5.0), a, b, c).distance(DVec3::new(0.2, 0.2, 0.0)) < 1e-15);
        assert_eq!(closest_point(DVec3::new(0.5, -1.0, 0.0), a, b, c), DVec3::new(0.5, 0.0, 0.0));
        assert_eq!(closest_point(DVec3::new(-1.0, -1.0, 0.0), a, b, c), a);
        assert_eq!(area(a, b, c), 0.5);
    }
}
