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
