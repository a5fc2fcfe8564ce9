//! Integration points of the reference elements.
//!
//! # Method
//! Tensor products of Gauss-Legendre rules on cubes; symmetric rules on triangles and tets; on the pyramid the cube rule
//! in the coordinates that collapse to the apex, which integrates its rational shape functions without touching it.
//!
//! # Source
//! [Hughes2000] chapter 3; [Keast1986] for the tet rules.
//!
//! # Invariants
//! Weights are positive and sum to the reference volume: tet 1/6, wedge 1, cube 8, pyramid 4/3.

use glam::DVec3;

use crate::mesh::mixed_mesh::ElementKind;

/// A point of a reference element and its weight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct QuadraturePoint {
    /// Reference coordinates.
    pub point: DVec3,
    /// Weight, in reference volume.
    pub weight: f64,
}

fn gauss(count: usize) -> &'static [(f64, f64)] {
    match count {
        2 => &[(-0.577_350_269_189_625_8, 1.0), (0.577_350_269_189_625_8, 1.0)],
        _ => &[(-0.774_596_669_241_483_4, 5.0 / 9.0), (0.0, 8.0 / 9.0), (0.774_596_669_241_483_4, 5.0 / 9.0)],
    }
}

fn cube(count: usize) -> Vec<QuadraturePoint> {
    let rule = gauss(count);
    let mut points = Vec::with_capacity(count.pow(3));
    for (z, wz) in rule {
        for (y, wy) in rule {
            for (x, wx) in rule {
                points.push(QuadraturePoint { point: DVec3::new(*x, *y, *z), weight: wx * wy * wz });
            }
        }
    }
    points
}

/// Cube coordinates collapsed to the apex: x = a (1 - z), z = (1 + c) / 2.
fn pyramid() -> Vec<QuadraturePoint> {
    cube(3)
        .into_iter()
        .map(|q| {
            let height = (1.0 + q.point.z) / 2.0;
            let shrink = 1.0 - height;
            let point = DVec3::new(q.point.x * shrink, q.point.y * shrink, height);
            QuadraturePoint { point, weight: q.weight * shrink * shrink / 2.0 }
        })
        .collect()
}

fn wedge() -> Vec<QuadraturePoint> {
    let triangle = [(1.0 / 6.0, 1.0 / 6.0), (2.0 / 3.0, 1.0 / 6.0), (1.0 / 6.0, 2.0 / 3.0)];
    let mut points = Vec::with_capacity(6);
    for (z, wz) in gauss(2) {
        for (x, y) in triangle {
            points.push(QuadraturePoint { point: DVec3::new(x, y, *z), weight: wz / 6.0 });
        }
    }
    points
}

fn tet(kind: ElementKind) -> Vec<QuadraturePoint> {
    if kind == ElementKind::Tet {
        return vec![QuadraturePoint { point: DVec3::splat(0.25), weight: 1.0 / 6.0 }];
    }
    // [Keast1986], 4 points, degree 2: exact for the stiffness of a straight quadratic tet.
    let (a, b) = (0.585_410_196_624_968_5, 0.138_196_601_125_010_5);
    [DVec3::new(b, b, b), DVec3::new(a, b, b), DVec3::new(b, a, b), DVec3::new(b, b, a)]
        .into_iter()
        .map(|point| QuadraturePoint { point, weight: 1.0 / 24.0 })
        .collect()
}

/// The rule that integrates the stiffness of an element kind.
pub fn quadrature(kind: ElementKind) -> &'static [QuadraturePoint] {
    use std::sync::OnceLock;
    static RULES: [OnceLock<Vec<QuadraturePoint>>; 6] = [const { OnceLock::new() }; 6];
    let (slot, make): (usize, fn() -> Vec<QuadraturePoint>) = match kind {
        ElementKind::Tet => (0, || tet(ElementKind::Tet)),
        ElementKind::QuadraticTet => (1, || tet(ElementKind::QuadraticTet)),
        ElementKind::Pyramid => (2, pyramid),
        ElementKind::Wedge => (3, wedge),
        ElementKind::Hexahedron => (4, || cube(2)),
        ElementKind::QuadraticHexahedron => (5, || cube(3)),
    };
    RULES[slot].get_or_init(make)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_sum_to_the_reference_volume() {
        for (kind, volume) in [
            (ElementKind::Tet, 1.0 / 6.0),
            (ElementKind::QuadraticTet, 1.0 / 6.0),
            (ElementKind::Pyramid, 4.0 / 3.0),
            (ElementKind::Wedge, 1.0),
            (ElementKind::Hexahedron, 8.0),
            (ElementKind::QuadraticHexahedron, 8.0),
        ] {
            let sum: f64 = quadrature(kind).iter().map(|q| q.weight).sum();
            assert!((sum - volume).abs() < 1e-14, "{kind:?} {sum}");
            assert!(quadrature(kind).iter().all(|q| q.weight > 0.0));
        }
    }

    #[test]
    fn second_moments_are_exact() {
        // Integral of z^2 over the reference tet is 1/60, over the pyramid 4 * (1/3 - 1/2 + 1/5).
        let moment = |kind| quadrature(kind).iter().map(|q| q.weight * q.point.z.powi(2)).sum::<f64>();
        assert!((moment(ElementKind::QuadraticTet) - 1.0 / 60.0).abs() < 1e-15);
        assert!((moment(ElementKind::Pyramid) - 4.0 * (1.0 / 3.0 - 0.5 + 0.2)).abs() < 1e-14);
    }
}
