//! Exact orientation and in-sphere tests with our sign convention.
//!
//! # Method
//! ```text
//!            d
//!           /|\         orient3d(a, b, c, d) > 0  when  ((b - a) x (c - a)) . (d - a) > 0:
//!          / | \        seen from d, the triangle a b c turns clockwise; from outside (below), counter-clockwise
//!         a--|--c       is (a, c, b), the outward face of the tet. This is VTK's order of a positive tet.
//!          \ | /
//!            b          insphere(a, b, c, d, e) > 0 when e lies inside the sphere of a positive tet a b c d.
//! ```
//! # Source
//! [Shewchuk1997], through the crate `robust`.

use glam::DVec3;
use robust::Coord3D;

fn coord(point: DVec3) -> Coord3D<f64> {
    Coord3D { x: point.x, y: point.y, z: point.z }
}

/// Sign of the volume of the tet a b c d (six times the volume, magnitude approximate): positive in VTK's order.
#[inline]
pub fn orient3d(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> f64 {
    // `robust` follows [Shewchuk1997]: positive when d lies below the plane of a b c seen counter-clockwise.
    -robust::orient3d(coord(a), coord(b), coord(c), coord(d))
}

/// Positive when `e` lies inside the circumsphere of the positive tet a b c d, zero on it.
#[inline]
pub fn insphere(a: DVec3, b: DVec3, c: DVec3, d: DVec3, e: DVec3) -> f64 {
    -robust::insphere(coord(a), coord(b), coord(c), coord(d), coord(e))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signs_follow_the_drawing() {
        let (a, b, c, d) = (DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z);
        assert!(orient3d(a, b, c, d) > 0.0);
        assert!(orient3d(a, c, b, d) < 0.0);
        assert_eq!(orient3d(a, b, c, DVec3::new(0.3, 0.4, 0.0)), 0.0);
        assert!(insphere(a, b, c, d, DVec3::splat(0.4)) > 0.0);
        assert!(insphere(a, b, c, d, DVec3::splat(2.0)) < 0.0);
        assert_eq!(insphere(a, b, c, d, DVec3::splat(1.0)), 0.0);
    }
}
