//! Surfaces that the engine's tests mesh.

use glam::DVec3;
use rustc_hash::FxHashMap;

use crate::index::VertexId;
use crate::mesh::surface_mesh::SurfaceMesh;

/// A surface from plain numbers.
pub fn surface_of(points: &[[f64; 3]], facets: &[[u32; 3]]) -> SurfaceMesh {
    SurfaceMesh::new(
        points.iter().map(|p| DVec3::from_array(*p)).collect(),
        facets.iter().map(|f| f.map(VertexId)).collect(),
    )
}

/// The unit cube, `n x n` squares of two triangles on each side.
pub fn cube(n: usize) -> SurfaceMesh {
    let mut ids: FxHashMap<[usize; 3], u32> = FxHashMap::default();
    let mut points = Vec::new();
    let mut facets = Vec::new();
    let mut vertex = |p: [usize; 3]| {
        *ids.entry(p).or_insert_with(|| {
            points.push(p.map(|c| c as f64 / n as f64));
            points.len() as u32 - 1
        })
    };
    for axis in 0..3 {
        for side in [0, n] {
            for i in 0..n {
                for j in 0..n {
                    let mut corner = |di: usize, dj: usize| {
                        let mut p = [0; 3];
                        p[axis] = side;
                        p[(axis + 1) % 3] = i + di;
                        p[(axis + 2) % 3] = j + dj;
                        vertex(p)
                    };
                    let q = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
                    let pair = if side == 0 {
                        [[q[0], q[2], q[1]], [q[0], q[3], q[2]]]
                    } else {
                        [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]
                    };
                    facets.extend(pair);
                }
            }
        }
    }
    surface_of(&points, &facets)
}

/// The unit sphere: an octahedron, subdivided `levels` times.
pub fn sphere(levels: usize) -> SurfaceMesh {
    let mut points: Vec<DVec3> = vec![DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y, DVec3::Z, DVec3::NEG_Z];
    let mut facets: Vec<[u32; 3]> =
        vec![[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]];
    for _ in 0..levels {
        let mut middles: FxHashMap<[u32; 2], u32> = FxHashMap::default();
        let mut finer = Vec::new();
        for [a, b, c] in facets {
            let mut middle = |u: u32, v: u32| {
                *middles.entry([u.min(v), u.max(v)]).or_insert_with(|| {
                    points.push((points[u as usize] + points[v as usize]).normalize());
                    points.len() as u32 - 1
                })
            };
            let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
            finer.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
        }
        facets = finer;
    }
    SurfaceMesh::new(points, facets.into_iter().map(|f| f.map(VertexId)).collect())
}

/// The same surface, moved.
pub fn translated(surface: &SurfaceMesh, by: DVec3) -> SurfaceMesh {
    mapped(surface, |p| p + by)
}

/// The same surface with every point mapped.
pub fn mapped(surface: &SurfaceMesh, map: impl Fn(DVec3) -> DVec3) -> SurfaceMesh {
    let mut moved = surface.clone();
    moved.points.iter_mut().for_each(|p| *p = map(*p));
    moved
}

/// Several surfaces as one.
pub fn joined(parts: &[SurfaceMesh]) -> SurfaceMesh {
    let mut all = SurfaceMesh::default();
    for (number, part) in parts.iter().enumerate() {
        let first = all.points.len() as u32;
        all.points.extend(&part.points);
        all.facets.extend(part.facets.iter().map(|f| f.map(|v| VertexId(v.0 + first))));
        all.facet_patches.extend(part.facets.iter().map(|_| number as i32));
    }
    all
}

/// A prism over a regular polygon, `layers` high, each layer turned by so many degrees; the diagonals of its sides bend
/// inwards for positive turns. With one layer over a triangle it is Schoenhardt's polyhedron.
pub fn twisted_prism(corners: u32, turn: f64, layers: u32) -> SurfaceMesh {
    let mut points = Vec::new();
    for layer in 0..=layers {
        for i in 0..corners {
            let angle =
                std::f64::consts::TAU * f64::from(i) / f64::from(corners) + turn.to_radians() * f64::from(layer);
            points.push([angle.cos(), angle.sin(), f64::from(layer)]);
        }
    }
    let top = corners * layers;
    let mut facets: Vec<[u32; 3]> =
        (1..corners - 1).flat_map(|i| [[0, i + 1, i], [top, top + i, top + i + 1]]).collect();
    for base in (0..layers).map(|layer| layer * corners) {
        for i in 0..corners {
            let (i, j) = (base + i, base + (i + 1) % corners);
            facets.extend([[i, j, j + corners], [i, j + corners, i + corners]]);
        }
    }
    surface_of(&points, &facets)
}

/// A box whose bottom and top are cut into strips of one part in `slenderness`, with diagonals in opposite senses.
pub fn strips(count: u32, slenderness: f64) -> SurfaceMesh {
    let around = 2 * (count + 1);
    let ring = (0..=count).map(|i| (i, 0.0)).chain((0..=count).rev().map(|i| (i, 1.0)));
    let ring: Vec<(f64, f64)> = ring.map(|(i, y)| (f64::from(i) / slenderness, y)).collect();
    let points: Vec<[f64; 3]> = [0.0, 0.3].iter().flat_map(|&z| ring.iter().map(move |&(x, y)| [x, y, z])).collect();
    let mut facets: Vec<[u32; 3]> = Vec::new();
    for i in 0..count {
        let [a, b, c, d] = [i, i + 1, around - 2 - i, around - 1 - i];
        let halves = [[[a, b, c], [a, c, d]], [[a, b, d], [b, c, d]]];
        facets.extend(halves[(i % 2) as usize].map(|[x, y, z]| [x, z, y]));
        facets.extend(halves[((i + 1) % 2) as usize].map(|face| face.map(|v| v + around)));
    }
    for i in 0..around {
        let j = (i + 1) % around;
        facets.extend([[i, j, j + around], [i, j + around, i + around]]);
    }
    surface_of(&points, &facets)
}

/// Chazelle's polyhedron: a box with `count` notches from above, whose bottoms lie on z = x y, and as many from below and
/// across, which end `gap` under that saddle.
pub fn chazelle(count: u32, gap: f64) -> SurfaceMesh {
    let above = notched_half(count, |x, y| x * y);
    let below = notched_half(count, |x, y| gap - x * y).into_iter().map(|f| f.map(|[x, y, z]| [y, x, -z]));
    let (mut points, mut facets): (Vec<[f64; 3]>, Vec<[u32; 3]>) = (Vec::new(), Vec::new());
    for triangle in above.into_iter().chain(below) {
        facets.push(triangle.map(|p| {
            let known = points.iter().position(|q| *q == p);
            known.unwrap_or_else(|| {
                points.push(p);
                points.len() - 1
            }) as u32
        }));
    }
    surface_of(&points, &facets)
}

/// Top and two sides of a box with notches along y, whose bottoms are at `depth(x, y)`.
fn notched_half(count: u32, depth: impl Fn(f64, f64) -> f64) -> Vec<[[f64; 3]; 3]> {
    const HALF_WIDTH: f64 = 0.05;
    let end = f64::from(count + 1);
    let height = end * end + 1.0;
    let (left, right) = (|i: f64| i - HALF_WIDTH, |i: f64| i + HALF_WIDTH);
    let places: Vec<f64> = (1..=count).map(f64::from).collect();
    let mut triangles = Vec::new();
    let starts = std::iter::once(0.0).chain(places.iter().map(|&i| right(i)));
    let ends = places.iter().map(|&i| left(i)).chain([end]);
    for (from, to) in starts.zip(ends) {
        let [a, b, c, d] = [[from, 0.0, height], [to, 0.0, height], [to, end, height], [from, end, height]];
        triangles.extend([[a, b, c], [a, c, d]]);
    }
    for &i in &places {
        let [t, u] = [0.0, end].map(|y| [i, y, depth(i, y)]);
        let [a, b] = [0.0, end].map(|y| [left(i), y, height]);
        let [c, d] = [0.0, end].map(|y| [right(i), y, height]);
        triangles.extend([[a, t, u], [a, u, b], [c, u, t], [c, d, u]]);
    }
    for y in [0.0, end] {
        let tip = |i: f64| [i, y, depth(i, y)];
        let at = |x: f64, z: f64| [x, y, z];
        let (corner, other, last) = (at(0.0, -height), at(end, -height), at(end, height));
        let mut side = vec![
            [corner, at(left(1.0), height), at(0.0, height)],
            [corner, tip(1.0), at(left(1.0), height)],
            [corner, other, tip(end - 1.0)],
            [tip(end - 1.0), other, last],
            [tip(end - 1.0), last, at(right(end - 1.0), height)],
        ];
        for pair in places.windows(2) {
            let [i, j] = [pair[0], pair[1]];
            let [m, n] = [at(right(i), height), at(left(j), height)];
            side.extend([[corner, tip(j), tip(i)], [tip(i), tip(j), n], [tip(i), n, m]]);
        }
        triangles.extend(side.into_iter().map(|[a, b, c]| if y > 0.0 { [a, c, b] } else { [a, b, c] }));
    }
    triangles
}
