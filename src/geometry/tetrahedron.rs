//! Measures of one tetrahedron: volume, dihedral and solid angles, circumsphere, inradius, shape, skewness of faces.
//!
//! # Method
//! Closed formulas in double precision on the four points in the order of `mesh::numbering` (positive when
//! [`crate::geometry::predicates::orient3d`] is). Angles come from `atan2`, which stays accurate for flat tets.
//!
//! # Source
//! Dihedral angles and shape measures: [Shewchuk2002b]; names and ranges of the shape measures: [Verdict2007]; skewness:
//! [OpenFOAM], the definition of its mesh check.
//!
//! # Limits
//! Only measures: signs of nearly flat tets are decided by the exact predicates, not here.

use glam::DVec3;

/// The corners of a tet.
pub type Corners = [DVec3; 4];

/// Largest and smallest dihedral angle, in degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AngleRange {
    /// Smallest angle, degrees.
    pub min: f64,
    /// Largest angle, degrees.
    pub max: f64,
}

/// Six times the signed volume.
#[inline]
pub fn volume6([a, b, c, d]: Corners) -> f64 {
    (b - a).cross(c - a).dot(d - a)
}

/// Signed volume.
#[inline]
pub fn volume(corners: Corners) -> f64 {
    volume6(corners) / 6.0
}

/// Outward area vectors of the four faces, twice the area; face `f` is opposite to corner `f`.
#[inline]
pub fn face_normals([a, b, c, d]: Corners) -> [DVec3; 4] {
    let (ab, ac, ad) = (b - a, c - a, d - a);
    let (on_b, on_c, on_d) = (ad.cross(ac), ab.cross(ad), ac.cross(ab));
    [-(on_b + on_c + on_d), on_b, on_c, on_d]
}

/// The six dihedral angles in degrees (of the unsigned tet), at the edges in the order of `mesh::numbering::TET_EDGES`.
pub fn dihedral_angles(corners: Corners) -> [f64; 6] {
    let normals = face_normals(corners);
    let lengths = normals.map(DVec3::length);
    let volume6 = volume6(corners).abs();
    // Edge i j lies between the faces opposite k and l: sin = 6 V |ij| / (|n_k| |n_l|), cos = -n_k . n_l / (...).
    let angle = |i: usize, j: usize, k: usize, l: usize| {
        if lengths[k] == 0.0 || lengths[l] == 0.0 {
            return 0.0;
        }
        let sine = volume6 * corners[i].distance(corners[j]);
        sine.atan2(-normals[k].dot(normals[l])).to_degrees()
    };
    [angle(0, 1, 2, 3), angle(0, 2, 1, 3), angle(0, 3, 1, 2), angle(1, 2, 0, 3), angle(1, 3, 0, 2), angle(2, 3, 0, 1)]
}

/// The extreme dihedral angles, degrees.
pub fn dihedral_range(corners: Corners) -> AngleRange {
    let angles = dihedral_angles(corners);
    let fold = |start: f64, pick: fn(f64, f64) -> f64| angles.iter().copied().fold(start, pick);
    AngleRange { min: fold(f64::INFINITY, f64::min), max: fold(f64::NEG_INFINITY, f64::max) }
}

/// The largest and the smallest cosine of the dihedral angles: no roots of trigonometric functions, for inner loops.
///
/// Returns `(cosine of the smallest angle, cosine of the largest angle)`; `(1, -1)` for a degenerate tet.
#[inline]
pub fn dihedral_cosines(corners: Corners) -> (f64, f64) {
    let normals = face_normals(corners);
    // Written out: closures over arrays are not inlined reliably, and improvement calls this for every tet in every pass.
    let inverse = |n: DVec3| n.length_squared().sqrt().recip();
    let scale = [inverse(normals[0]), inverse(normals[1]), inverse(normals[2]), inverse(normals[3])];
    let cosine = |k: usize, l: usize| -normals[k].dot(normals[l]) * (scale[k] * scale[l]);
    let first = [cosine(2, 3), cosine(1, 3), cosine(1, 2)];
    let second = [cosine(0, 3), cosine(0, 2), cosine(0, 1)];
    let largest = first[0].max(first[1]).max(first[2]).max(second[0]).max(second[1]).max(second[2]);
    let smallest = first[0].min(first[1]).min(first[2]).min(second[0]).min(second[1]).min(second[2]);
    // `max` skips NaN, so a face of zero area is told by its scale.
    if scale.iter().all(|s| s.is_finite()) { (largest, smallest) } else { (1.0, -1.0) }
}

/// Whether the largest dihedral angle is above the one with this cosine, or the tet is degenerate: as a comparison with
/// [`dihedral_cosines`], but without roots and divisions where the cosine is negative.
#[inline]
pub fn exceeds_angle(corners: Corners, cosine: f64) -> bool {
    if !(cosine < 0.0) {
        return dihedral_cosines(corners).1 < cosine;
    }
    let normals = face_normals(corners);
    let squares = [
        normals[0].length_squared(),
        normals[1].length_squared(),
        normals[2].length_squared(),
        normals[3].length_squared(),
    ];
    let limit = cosine * cosine;
    let above = |k: usize, l: usize| {
        let product = normals[k].dot(normals[l]);
        product > 0.0 && product * product > limit * (squares[k] * squares[l])
    };
    let is_flat = !(squares[0].min(squares[1]).min(squares[2]).min(squares[3]) > 0.0);
    is_flat || above(2, 3) | above(1, 3) | above(1, 2) | above(0, 3) | above(0, 2) | above(0, 1)
}

/// The solid angle at corner 0, steradian.
pub fn solid_angle([a, b, c, d]: Corners) -> f64 {
    let (u, v, w) = (b - a, c - a, d - a);
    let (lu, lv, lw) = (u.length(), v.length(), w.length());
    let denominator = lu * lv * lw + u.dot(v) * lw + u.dot(w) * lv + v.dot(w) * lu;
    2.0 * u.cross(v).dot(w).abs().atan2(denominator)
}

/// The six edge lengths in the order of `mesh::numbering::TET_EDGES`, written out: `map` over arrays is not inlined reliably.
#[inline]
fn edge_lengths([a, b, c, d]: Corners) -> [f64; 6] {
    [a.distance(b), a.distance(c), a.distance(d), b.distance(c), b.distance(d), c.distance(d)]
}

/// The six edge vectors in the order of `mesh::numbering::TET_EDGES`.
#[inline]
pub fn edge_vectors([a, b, c, d]: Corners) -> [DVec3; 6] {
    [b - a, c - a, d - a, c - b, d - b, d - c]
}

/// Centre and radius of the sphere through the corners; `None` for a flat tet.
pub fn circumsphere([a, b, c, d]: Corners) -> Option<(DVec3, f64)> {
    let (u, v, w) = (b - a, c - a, d - a);
    let doubled = 2.0 * u.cross(v).dot(w);
    let offset =
        (u.length_squared() * v.cross(w) + v.length_squared() * w.cross(u) + w.length_squared() * u.cross(v)) / doubled;
    offset.is_finite().then(|| (a + offset, offset.length()))
}

/// Radius of the inscribed sphere; 0 for a flat tet.
#[inline]
pub fn inradius(corners: Corners) -> f64 {
    let doubled_area: f64 = face_normals(corners).iter().map(|n| n.length()).sum();
    if doubled_area > 0.0 { volume6(corners).abs() / doubled_area } else { 0.0 }
}

/// Circumradius over three times the inradius: 1 for the regular tet, infinite for a flat one.
#[inline]
pub fn radius_ratio(corners: Corners) -> f64 {
    let [ab, ac, ad, bc, bd, cd] = edge_lengths(corners);
    // R = sqrt(q) / (24 V) with the products of opposite edges (Crelle).
    let (x, y, z) = (ab * cd, ac * bd, ad * bc);
    let q = ((x + y + z) * (x + y - z) * (x - y + z) * (y + z - x)).max(0.0);
    let ratio = q.sqrt() / (4.0 * volume6(corners).abs()) / (3.0 * inradius(corners));
    if ratio.is_finite() { ratio } else { f64::INFINITY }
}

/// 12 (3 V)^(2/3) over the sum of squared edge lengths: 1 for the regular tet, 0 for a flat one, negative inverted.
#[inline]
pub fn mean_ratio(corners: Corners) -> f64 {
    let squares: f64 = edge_vectors(corners).iter().map(|e| e.length_squared()).sum();
    let half = volume6(corners) / 2.0;
    if squares > 0.0 { 12.0 * half.signum() * half.abs().cbrt().powi(2) / squares } else { 0.0 }
}

/// Smallest corner Jacobian over the product of its edge lengths, times sqrt(2): 1 for the regular tet.
#[inline]
pub fn scaled_jacobian(corners: Corners) -> f64 {
    let [ab, ac, ad, bc, bd, cd] = edge_lengths(corners);
    let product = (ab * ac * ad).max(ab * bc * bd).max(ac * bc * cd).max(ad * bd * cd);
    if product > 0.0 { std::f64::consts::SQRT_2 * volume6(corners) / product } else { 0.0 }
}

/// Skewness of a face between the tets to the apexes `apex` and `beyond`, or on the boundary: how far the line between
/// their centroids passes from the face's centroid, over the extent of the face in that direction. On the boundary the
/// line is the normal through the centroid. 0 is best; finite-volume solvers ask for less than 4.
pub fn face_skewness([a, b, c]: [DVec3; 3], apex: DVec3, beyond: Option<DVec3>) -> f64 {
    let center = (a + b + c) / 3.0;
    let normal = (b - a).cross(c - a);
    // A tet's centroid lies a quarter of the way from the face's to the apex.
    let from = (center - apex) / 4.0;
    // The solver's extents are at least these shares of the line.
    let (line, share) = match beyond {
        Some(beyond) => ((beyond - apex) / 4.0, 0.2),
        None => (normal * (normal.dot(from) / normal.length_squared()), 0.4),
    };
    let offset = from - line * (normal.dot(from) / normal.dot(line));
    let distance = offset.length();
    let extent = [a, b, c].map(|p| (offset.dot(p - center) / distance).abs()).into_iter().fold(0.0, f64::max);
    let skewness = distance / extent.max(share * line.length());
    // Nothing is skew where the line passes through the centroid; a flat tet is as skew as can be.
    if skewness.is_finite() {
        skewness
    } else if distance == 0.0 {
        0.0
    } else {
        f64::INFINITY
    }
}

/// The largest skewness that the faces of a tet would have on a boundary. An inner face, whose line is between those of
/// its two tets, is hardly skewer than with the worse of them.
pub fn largest_skewness([a, b, c, d]: Corners) -> f64 {
    let faces = [([b, c, d], a), ([a, c, d], b), ([a, b, d], c), ([a, b, c], d)];
    faces.into_iter().map(|(face, apex)| face_skewness(face, apex, None)).fold(0.0, f64::max)
}

/// Whether a point lies in a positive tet or at its boundary, as far as rounding lets volumes tell.
pub fn contains(corners: Corners, point: DVec3) -> bool {
    (0..4).all(|corner| {
        let mut part = corners;
        part[corner] = point;
        volume6(part) >= 0.0
    })
}

/// Whether `point` lies in the tet, with the weights of its corners (they sum to 1; all at least 0 inside).
pub fn barycentric([a, b, c, d]: Corners, point: DVec3) -> [f64; 4] {
    let whole = volume6([a, b, c, d]);
    let weights = [
        volume6([point, b, c, d]) / whole,
        volume6([a, point, c, d]) / whole,
        volume6([a, b, point, d]) / whole,
        volume6([a, b, c, point]) / whole,
    ];
    if weights.iter().all(|w| w.is_finite()) { weights } else { [0.25; 4] }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn regular() -> Corners {
        [
            DVec3::new(1.0, 1.0, 1.0),
            DVec3::new(-1.0, 1.0, -1.0),
            DVec3::new(1.0, -1.0, -1.0),
            DVec3::new(-1.0, -1.0, 1.0),
        ]
    }

    #[test]
    fn regular_tet_is_ideal_in_every_measure() {
        let tet = regular();
        assert!(volume(tet) > 0.0);
        let ideal = (1.0f64 / 3.0).acos().to_degrees();
        assert!(dihedral_angles(tet).iter().all(|a| (a - ideal).abs() < 1e-12));
        assert!((radius_ratio(tet) - 1.0).abs() < 1e-12);
        assert!((mean_ratio(tet) - 1.0).abs() < 1e-12);
        assert!((scaled_jacobian(tet) - 1.0).abs() < 1e-12);
        let (largest, smallest) = dihedral_cosines(tet);
        assert!((largest - 1.0 / 3.0).abs() < 1e-12 && (smallest - 1.0 / 3.0).abs() < 1e-12);
    }

    #[test]
    fn corner_tet_has_known_angles_and_spheres() {
        let tet = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        let range = dihedral_range(tet);
        assert!(
            (range.max - 90.0).abs() < 1e-12 && (range.min - (1.0 / 3f64.sqrt()).acos().to_degrees()).abs() < 1e-12
        );
        let (centre, radius) = circumsphere(tet).unwrap();
        assert!(centre.distance(DVec3::splat(0.5)) < 1e-15 && (radius - 0.75f64.sqrt()).abs() < 1e-15);
        assert!((inradius(tet) - 1.0 / (3.0 + 3f64.sqrt())).abs() < 1e-15);
        assert!((solid_angle(tet) - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        assert_eq!(barycentric(tet, DVec3::splat(0.25)), [0.25; 4]);
    }

    #[test]
    fn skewness_follows_its_definition() {
        let tet = regular();
        assert!(largest_skewness(tet) < 1e-7);
        // The centroid of a right triangle with legs of 3 is at (1, 1); the apex stands 4 s beside it, 4 h above.
        let face = [DVec3::ZERO, 3.0 * DVec3::X, 3.0 * DVec3::Y];
        let apex = |s: f64, h: f64| DVec3::new(1.0 + 4.0 * s, 1.0, 4.0 * h);
        assert!((face_skewness(face, apex(5.0, 1.0), None) - 2.5).abs() < 1e-12, "the face extends by 2");
        assert!((face_skewness(face, apex(5.0, 20.0), None) - 0.625).abs() < 1e-12, "0.4 of the height is more");
        // Between apexes on both sides at the same distance the line passes half way between their feet.
        let beyond = apex(1.0, -1.0);
        assert!((face_skewness(face, apex(5.0, 1.0), Some(beyond)) - 1.5).abs() < 1e-12);
        assert_eq!(face_skewness(face, apex(0.0, 1.0), None), 0.0);
        assert_eq!(face_skewness(face, apex(1.0, 0.0), None), f64::INFINITY);
    }

    #[test]
    fn flat_tets_measure_without_nan() {
        let flat = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::new(1.0, 1.0, 0.0)];
        assert!(circumsphere(flat).is_none() && inradius(flat) == 0.0 && radius_ratio(flat).is_infinite());
        assert_eq!((dihedral_range(flat).min, dihedral_range(flat).max), (0.0, 180.0));
        let point = [DVec3::ZERO; 4];
        assert_eq!(dihedral_cosines(point), (1.0, -1.0));
        assert_eq!((mean_ratio(point), scaled_jacobian(point)), (0.0, 0.0));
    }
}
