//! Cutting polygons into triangles without new points.
//!
//! # Method
//! Ear clipping in the plane of the polygon's area vector: the convex ear with the largest smallest angle first, ties to the lowest point
//! number, so that the same polygon is cut the same way wherever its first corner stands in the file.
//!
//! # Cost
//! Cubic in the corners; polygons of files are small.

use glam::{DVec2, DVec3};

use crate::index::VertexId;

/// Adds the triangles of the polygon `nodes` (indices of `points`, in range) to `facets`.
pub fn triangulate(nodes: &[i64], points: &[DVec3], facets: &mut Vec<[VertexId; 3]>) {
    let id = |n: i64| VertexId(n as u32);
    if nodes.len() < 3 {
        return;
    }
    let flat = project(nodes, points);
    let mut rest: Vec<usize> = (0..nodes.len()).collect();
    while rest.len() > 3 {
        let ear = best_ear(&rest, &flat, nodes);
        let n = rest.len();
        let [a, b, c] = [rest[(ear + n - 1) % n], rest[ear], rest[(ear + 1) % n]];
        facets.push([id(nodes[a]), id(nodes[b]), id(nodes[c])]);
        rest.remove(ear);
    }
    facets.push([id(nodes[rest[0]]), id(nodes[rest[1]]), id(nodes[rest[2]])]);
}

/// Adds the triangles of a facet of several polygons in one plane. A polygon that lies inside the first largest one
/// cuts it out; its own inside is filled too unless a point of `holes` lies in it.
pub fn triangulate_facet(polygons: &[Vec<i64>], holes: &[DVec3], points: &[DVec3], facets: &mut Vec<[VertexId; 3]>) {
    let area = |polygon: &Vec<i64>| area_vector(polygon, points).length();
    let Some(largest) = (0..polygons.len()).max_by(|&x, &y| area(&polygons[x]).total_cmp(&area(&polygons[y]))) else {
        return;
    };
    let normal = area_vector(&polygons[largest], points).try_normalize().unwrap_or(DVec3::Z);
    let (u, v) = normal.any_orthonormal_pair();
    let flat = |p: DVec3| DVec2::new(p.dot(u), p.dot(v));
    let corners = |polygon: &[i64]| -> Vec<DVec2> { polygon.iter().map(|&n| flat(points[n as usize])).collect() };
    let outer = corners(&polygons[largest]);
    let mut outline = polygons[largest].clone();
    let mut inner: Vec<&Vec<i64>> = Vec::new();
    for (i, polygon) in polygons.iter().enumerate().filter(|(i, _)| *i != largest) {
        let shares = polygon.iter().any(|n| polygons[largest].contains(n));
        let inside = !shares && corners(polygon).iter().all(|&p| winds_around(&outer, p));
        if inside {
            inner.push(polygon);
        }
        let emptied = holes.iter().any(|&h| winds_around(&corners(polygon), flat(h)));
        if !emptied && polygon.len() >= 3 {
            triangulate(&polygons[i], points, facets);
        }
    }
    if holes.iter().any(|&h| winds_around(&outer, flat(h)) && !inner.iter().any(|p| winds_around(&corners(p), flat(h))))
    {
        return;
    }
    // Bridges start at the rightmost hole, so that none runs through a hole not yet cut out.
    let rightmost = |polygon: &[i64]| corners(polygon).iter().map(|p| p.x).fold(f64::NEG_INFINITY, f64::max);
    inner.sort_by(|x, y| rightmost(y).total_cmp(&rightmost(x)));
    for polygon in inner {
        let mut hole = polygon.clone();
        if area_vector(&hole, points).dot(normal) > 0.0 {
            hole.reverse();
        }
        bridge(&mut outline, &hole, &corners);
    }
    triangulate(&outline, points, facets);
}

/// Joins a hole to the outline by a doubled edge between the closest pair of corners that see each other.
fn bridge(outline: &mut Vec<i64>, hole: &[i64], corners: &dyn Fn(&[i64]) -> Vec<DVec2>) {
    let (outer, inner) = (corners(outline), corners(hole));
    let mut pairs: Vec<(usize, usize)> = (0..outer.len()).flat_map(|o| (0..inner.len()).map(move |h| (o, h))).collect();
    let length = |&(o, h): &(usize, usize)| outer[o].distance_squared(inner[h]);
    pairs.sort_by(|x, y| length(x).total_cmp(&length(y)));
    let crosses = |ring: &[DVec2], a: DVec2, b: DVec2| {
        (0..ring.len()).any(|k| properly_crosses(ring[k], ring[(k + 1) % ring.len()], a, b))
    };
    let free = |&&(o, h): &&(usize, usize)| {
        !crosses(&outer, outer[o], inner[h])
            && !crosses(&inner, outer[o], inner[h])
            && opens_towards(&outer, o, inner[h])
    };
    let (o, h) = pairs.iter().find(free).copied().unwrap_or((0, 0));
    let mut cut: Vec<i64> = hole[h..].iter().chain(&hole[..=h]).copied().collect();
    cut.push(outline[o]);
    outline.splice(o + 1..o + 1, cut);
}

/// Whether `target` lies in the inside angle of corner `o`: at a doubled corner only one copy faces a target.
fn opens_towards(ring: &[DVec2], o: usize, target: DVec2) -> bool {
    let n = ring.len();
    let (before, at, after) = (ring[(o + n - 1) % n], ring[o], ring[(o + 1) % n]);
    let left_of = |a: DVec2, b: DVec2| (b - a).perp_dot(target - a) > 0.0;
    let convex = (at - before).perp_dot(after - at) > 0.0;
    if convex { left_of(before, at) && left_of(at, after) } else { left_of(before, at) || left_of(at, after) }
}

fn properly_crosses(a: DVec2, b: DVec2, c: DVec2, d: DVec2) -> bool {
    if a == c || a == d || b == c || b == d {
        return false;
    }
    let side = |p: DVec2, q: DVec2, r: DVec2| (q - p).perp_dot(r - p);
    side(a, b, c) * side(a, b, d) <= 0.0 && side(c, d, a) * side(c, d, b) <= 0.0
}

/// Whether a polygon contains a point, by crossings.
fn winds_around(ring: &[DVec2], p: DVec2) -> bool {
    let n = ring.len();
    let crossing = |k: &usize| {
        let (a, b) = (ring[*k], ring[(*k + 1) % n]);
        (a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x)
    };
    (0..n).filter(crossing).count() % 2 == 1
}

fn area_vector(nodes: &[i64], points: &[DVec3]) -> DVec3 {
    let at = |k: usize| points[nodes[k % nodes.len()] as usize] - points[nodes[0] as usize];
    (0..nodes.len()).map(|k| at(k).cross(at(k + 1))).sum()
}

/// The polygon in the plane across its area vector, counter-clockwise.
fn project(nodes: &[i64], points: &[DVec3]) -> Vec<DVec2> {
    let at = |k: usize| points[nodes[k % nodes.len()] as usize] - points[nodes[0] as usize];
    let normal = area_vector(nodes, points).try_normalize().unwrap_or(DVec3::Z);
    let (u, v) = normal.any_orthonormal_pair();
    (0..nodes.len()).map(|k| DVec2::new(at(k).dot(u), at(k).dot(v))).collect()
}

/// Position in `rest` of the corner to cut off.
fn best_ear(rest: &[usize], flat: &[DVec2], nodes: &[i64]) -> usize {
    let n = rest.len();
    let corner = |k: usize| {
        let [a, b, c] = [rest[(k + n - 1) % n], rest[k], rest[(k + 1) % n]];
        let blocked = (flat[b] - flat[a]).perp_dot(flat[c] - flat[a]) <= 0.0
            || rest.iter().any(|&p| {
                ![nodes[a], nodes[b], nodes[c]].contains(&nodes[p]) && contains([flat[a], flat[b], flat[c]], flat[p])
            });
        let quality = if blocked { -1.0 } else { smallest_sine([flat[a], flat[b], flat[c]]) };
        (quality, -nodes[b])
    };
    (0..n).max_by(|&x, &y| corner(x).partial_cmp(&corner(y)).unwrap_or(std::cmp::Ordering::Equal)).unwrap_or(0)
}

fn contains([a, b, c]: [DVec2; 3], p: DVec2) -> bool {
    [(a, b), (b, c), (c, a)].into_iter().all(|(s, e)| (e - s).perp_dot(p - s) >= 0.0)
}

/// Smallest of the sines of the three angles: grows with the smallest angle.
fn smallest_sine([a, b, c]: [DVec2; 3]) -> f64 {
    let sine = |p: DVec2, q: DVec2, r: DVec2| (q - p).normalize_or_zero().perp_dot((r - p).normalize_or_zero());
    sine(a, b, c).min(sine(b, c, a)).min(sine(c, a, b))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(points: &[DVec3], facets: &[[VertexId; 3]]) -> f64 {
        let at = |v: VertexId| points[v.index()];
        facets.iter().map(|&[a, b, c]| (at(b) - at(a)).cross(at(c) - at(a)).z / 2.0).sum()
    }

    #[test]
    fn a_concave_polygon_keeps_its_area() {
        let points: Vec<DVec3> =
            [(0., 0.), (4., 0.), (4., 4.), (2., 1.), (0., 4.)].map(|(x, y)| DVec3::new(x, y, 1.0)).to_vec();
        let mut facets = Vec::new();
        triangulate(&[0, 1, 2, 3, 4], &points, &mut facets);
        assert_eq!(facets.len(), 3);
        assert!((area(&points, &facets) - 10.0).abs() < 1e-12);
        for facet in &facets {
            assert!(area(&points, &[*facet]) > 0.0);
        }
    }

    #[test]
    fn a_facet_with_holes_keeps_what_is_left() {
        let square = |x: f64, y: f64, w: f64| {
            [(x, y), (x + w, y), (x + w, y + w), (x, y + w)].map(|(x, y)| DVec3::new(x, y, 2.0))
        };
        let points: Vec<DVec3> =
            [square(0., 0., 10.), square(1., 1., 3.), square(6., 2., 3.), square(3., 6., 2.)].concat();
        let ring = |k: i64| (4 * k..4 * k + 4).collect::<Vec<i64>>();
        let polygons = vec![ring(0), ring(1), ring(2).into_iter().rev().collect(), ring(3)];
        let mut facets = Vec::new();
        let holes = [DVec3::new(2., 2., 2.), DVec3::new(7., 3., 2.), DVec3::new(4., 7., 2.)];
        triangulate_facet(&polygons, &holes, &points, &mut facets);
        assert!((area(&points, &facets) - (100.0 - 9.0 - 9.0 - 4.0)).abs() < 1e-9);
        assert!(facets.iter().all(|f| area(&points, &[*f]) > 0.0));
        facets.clear();
        triangulate_facet(&polygons[..2], &[], &points, &mut facets);
        assert!((area(&points, &facets) - 100.0).abs() < 1e-9);
    }

    #[test]
    fn the_first_corner_does_not_matter() {
        let points = vec![DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::Y];
        let cut = |nodes: &[i64]| {
            let mut facets = Vec::new();
            triangulate(nodes, &points, &mut facets);
            facets.iter_mut().for_each(|f| f.sort());
            facets.sort();
            facets
        };
        assert_eq!(cut(&[0, 1, 2, 3]), cut(&[2, 3, 0, 1]));
        assert_eq!(cut(&[0, 1, 2, 3]), cut(&[1, 2, 3, 0]));
    }
}
