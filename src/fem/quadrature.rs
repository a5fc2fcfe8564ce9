//! Integration points of the reference elements.
//!
//! # Method
//! Tensor products of Gauss-Legendre rules on cubes; symmetric rules on triangles and tets; on the pyramid a product rule
//! in the coordinates that collapse to the apex, which integrates its rational shape functions without touching it. There
//! the gradients are bilinear across and constant along the height, so that 2 x 2 x 3 points are exact on any affine
//! pyramid. Each point carries the shape functions' values there, as every element of a kind asks for the same ones.
//!
//! # Source
//! [Hughes2000] chapter 3; [Keast1986] for the tet rules.
//!
//! # Invariants
//! Weights are positive and sum to the reference volume: tet 1/6, wedge 1, cube 8, pyramid 4/3.

use glam::DVec3;

use crate::fem::shape_functions::{ShapeValues, shape_functions};
use crate::mesh::mixed_mesh::ElementKind;

/// A point of a reference element and its weight.
#[derive(Debug, Clone, Copy)]
pub struct QuadraturePoint {
    /// Reference coordinates.
    pub point: DVec3,
    /// Weight, in reference volume.
    pub weight: f64,
    /// The kind's shape functions there.
    pub shape: ShapeValues,
}

/// Places and weights of a rule.
type Rule = Vec<(DVec3, f64)>;

fn gauss(count: usize) -> &'static [(f64, f64)] {
    match count {
        2 => &[(-0.577_350_269_189_625_8, 1.0), (0.577_350_269_189_625_8, 1.0)],
        _ => &[(-0.774_596_669_241_483_4, 5.0 / 9.0), (0.0, 8.0 / 9.0), (0.774_596_669_241_483_4, 5.0 / 9.0)],
    }
}

/// Gauss points across (both axes) and along the third axis.
fn product(across: usize, along: usize) -> Rule {
    let mut points = Vec::with_capacity(across * across * along);
    for (z, wz) in gauss(along) {
        for (y, wy) in gauss(across) {
            for (x, wx) in gauss(across) {
                points.push((DVec3::new(*x, *y, *z), wx * wy * wz));
            }
        }
    }
    points
}

/// Cube coordinates collapsed to the apex: x = a (1 - z), z = (1 + c) / 2.
fn pyramid() -> Rule {
    let collapsed = |(at, weight): (DVec3, f64)| {
        let height = (1.0 + at.z) / 2.0;
        let shrink = 1.0 - height;
        (DVec3::new(at.x * shrink, at.y * shrink, height), weight * shrink * shrink / 2.0)
    };
    product(2, 3).into_iter().map(collapsed).collect()
}

fn wedge() -> Rule {
    let triangle = [(1.0 / 6.0, 1.0 / 6.0), (2.0 / 3.0, 1.0 / 6.0), (1.0 / 6.0, 2.0 / 3.0)];
    let of_height = |(z, wz): &(f64, f64)| triangle.map(|(x, y)| (DVec3::new(x, y, *z), wz / 6.0));
    gauss(2).iter().flat_map(of_height).collect()
}

fn linear_tet() -> Rule {
    vec![(DVec3::splat(0.25), 1.0 / 6.0)]
}

/// [Keast1986], 4 points, degree 2: exact for the stiffness of a straight quadratic tet.
fn quadratic_tet() -> Rule {
    let (a, b) = (0.585_410_196_624_968_5, 0.138_196_601_125_010_5);
    [DVec3::new(b, b, b), DVec3::new(a, b, b), DVec3::new(b, a, b), DVec3::new(b, b, a)]
        .map(|p| (p, 1.0 / 24.0))
        .to_vec()
}

/// The rule that integrates the stiffness of an element kind.
pub fn quadrature(kind: ElementKind) -> &'static [QuadraturePoint] {
    use std::sync::OnceLock;
    static RULES: [OnceLock<Vec<QuadraturePoint>>; 6] = [const { OnceLock::new() }; 6];
    let (slot, make): (usize, fn() -> Rule) = match kind {
        ElementKind::Tet => (0, linear_tet),
        ElementKind::QuadraticTet => (1, quadratic_tet),
        ElementKind::Pyramid => (2, pyramid),
        ElementKind::Wedge => (3, wedge),
        ElementKind::Hexahedron => (4, || product(2, 2)),
        ElementKind::QuadraticHexahedron => (5, || product(3, 3)),
    };
    let evaluated = |(point, weight)| QuadraturePoint { point, weight, shape: shape_functions(kind, point) };
    RULES[slot].get_or_init(|| make().into_iter().map(evaluated).collect())
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
