//! Shape functions and their gradients on the reference elements, in VTK's node order (see `mesh::numbering`).
//!
//! # Method
//! - tet: barycentric, reference corners at the origin and the unit points; quadratic tet: products of them;
//! - hexahedron: trilinear on [-1, 1]^3; quadratic: 20-node serendipity;
//! - wedge: barycentric times linear; the base triangle is listed so that the reference map keeps the orientation;
//! - pyramid: the rational functions of [Bedrosian1992], which meet tets and hexahedra conformingly.
//!
//! # Source
//! [Hughes2000] chapter 3; [Bedrosian1992].
//!
//! # Invariants
//! Values sum to one, gradients to zero; each function is one at its own node and zero at the others.

use glam::DVec3;

use crate::mesh::mixed_mesh::ElementKind;
use crate::mesh::numbering::QUADRATIC_TET_EDGES;

/// Most nodes of an element.
pub const MAX_NODES: usize = 20;

/// Corners of the reference cube.
pub const CUBE_CORNERS: [[f64; 3]; 8] = [
    [-1.0, -1.0, -1.0],
    [1.0, -1.0, -1.0],
    [1.0, 1.0, -1.0],
    [-1.0, 1.0, -1.0],
    [-1.0, -1.0, 1.0],
    [1.0, -1.0, 1.0],
    [1.0, 1.0, 1.0],
    [-1.0, 1.0, 1.0],
];

/// Mid-edge nodes of the 20-node hexahedron in VTK's order (VTK 25): node `8 + i` lies on edge `i`.
pub const QUADRATIC_HEX_EDGES: [[usize; 2]; 12] =
    [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];

/// Values and reference gradients at one point; entries past the node count are zero.
#[derive(Debug, Clone, Copy)]
pub struct ShapeValues {
    /// One value per node.
    pub values: [f64; MAX_NODES],
    /// One reference gradient per node.
    pub gradients: [DVec3; MAX_NODES],
}

/// Distance to the apex, in reference height, below which a pyramid is evaluated just under it: the gradients of its
/// rational functions have no limit there.
const APEX_GUARD: f64 = 1e-9;

/// Evaluates the shape functions of a kind at a reference point.
pub fn shape_functions(kind: ElementKind, at: DVec3) -> ShapeValues {
    let mut shape = ShapeValues { values: [0.0; MAX_NODES], gradients: [DVec3::ZERO; MAX_NODES] };
    match kind {
        ElementKind::Tet => {
            shape.values[..4].copy_from_slice(&[1.0 - at.x - at.y - at.z, at.x, at.y, at.z]);
            shape.gradients[..4].copy_from_slice(&[-DVec3::ONE, DVec3::X, DVec3::Y, DVec3::Z]);
        }
        ElementKind::QuadraticTet => quadratic_tet(at, &mut shape),
        ElementKind::Hexahedron => trilinear(at, &mut shape),
        ElementKind::QuadraticHexahedron => serendipity(at, &mut shape),
        ElementKind::Wedge => wedge(at, &mut shape),
        ElementKind::Pyramid => pyramid(at, &mut shape),
    }
    shape
}

/// Reference coordinates of the element's middle.
pub fn reference_center(kind: ElementKind) -> DVec3 {
    match kind {
        ElementKind::Tet | ElementKind::QuadraticTet => DVec3::splat(0.25),
        ElementKind::Wedge => DVec3::new(1.0 / 3.0, 1.0 / 3.0, 0.0),
        ElementKind::Pyramid => DVec3::new(0.0, 0.0, 0.25),
        ElementKind::Hexahedron | ElementKind::QuadraticHexahedron => DVec3::ZERO,
    }
}

fn quadratic_tet(at: DVec3, shape: &mut ShapeValues) {
    let bary = [1.0 - at.x - at.y - at.z, at.x, at.y, at.z];
    let slope = [-DVec3::ONE, DVec3::X, DVec3::Y, DVec3::Z];
    for i in 0..4 {
        shape.values[i] = bary[i] * (2.0 * bary[i] - 1.0);
        shape.gradients[i] = slope[i] * (4.0 * bary[i] - 1.0);
    }
    for (i, [a, b]) in QUADRATIC_TET_EDGES.into_iter().enumerate() {
        shape.values[4 + i] = 4.0 * bary[a] * bary[b];
        shape.gradients[4 + i] = 4.0 * (slope[a] * bary[b] + slope[b] * bary[a]);
    }
}

fn trilinear(at: DVec3, shape: &mut ShapeValues) {
    for (i, c) in CUBE_CORNERS.into_iter().enumerate() {
        let f = [1.0 + c[0] * at.x, 1.0 + c[1] * at.y, 1.0 + c[2] * at.z];
        shape.values[i] = f[0] * f[1] * f[2] / 8.0;
        shape.gradients[i] = DVec3::new(c[0] * f[1] * f[2], c[1] * f[0] * f[2], c[2] * f[0] * f[1]) / 8.0;
    }
}

fn serendipity(at: DVec3, shape: &mut ShapeValues) {
    for (i, c) in CUBE_CORNERS.into_iter().enumerate() {
        let f = [1.0 + c[0] * at.x, 1.0 + c[1] * at.y, 1.0 + c[2] * at.z];
        let sum = c[0] * at.x + c[1] * at.y + c[2] * at.z - 2.0;
        shape.values[i] = f[0] * f[1] * f[2] * sum / 8.0;
        shape.gradients[i] = DVec3::new(
            c[0] * f[1] * f[2] * (sum + f[0]),
            c[1] * f[0] * f[2] * (sum + f[1]),
            c[2] * f[0] * f[1] * (sum + f[2]),
        ) / 8.0;
    }
    for (i, [a, b]) in QUADRATIC_HEX_EDGES.into_iter().enumerate() {
        let middle: [f64; 3] = std::array::from_fn(|d| f64::midpoint(CUBE_CORNERS[a][d], CUBE_CORNERS[b][d]));
        let mut factor = [0.0; 3];
        let mut slope = [0.0; 3];
        for d in 0..3 {
            (factor[d], slope[d]) = if middle[d] == 0.0 {
                (1.0 - at[d] * at[d], -2.0 * at[d])
            } else {
                (1.0 + middle[d] * at[d], middle[d])
            };
        }
        shape.values[8 + i] = factor[0] * factor[1] * factor[2] / 4.0;
        shape.gradients[8 + i] = DVec3::new(
            slope[0] * factor[1] * factor[2],
            slope[1] * factor[0] * factor[2],
            slope[2] * factor[0] * factor[1],
        ) / 4.0;
    }
}

fn wedge(at: DVec3, shape: &mut ShapeValues) {
    // VTK's base 0 1 2 turns clockwise seen from the top: node 1 takes y, node 2 takes x.
    let bary = [1.0 - at.x - at.y, at.y, at.x];
    let slope = [DVec3::new(-1.0, -1.0, 0.0), DVec3::Y, DVec3::X];
    for (level, sign) in [(0, -1.0), (3, 1.0)] {
        let height = (1.0 + sign * at.z) / 2.0;
        for i in 0..3 {
            shape.values[level + i] = bary[i] * height;
            shape.gradients[level + i] = slope[i] * height + DVec3::Z * (bary[i] * sign / 2.0);
        }
    }
}

fn pyramid(at: DVec3, shape: &mut ShapeValues) {
    let z = at.z.min(1.0 - APEX_GUARD);
    let top = 1.0 - z;
    let ratio = at.x * at.y * z / top;
    for (i, c) in CUBE_CORNERS[..4].iter().enumerate() {
        let s = c[0] * c[1];
        shape.values[i] = ((1.0 + c[0] * at.x) * (1.0 + c[1] * at.y) - z + s * ratio) / 4.0;
        shape.gradients[i] = DVec3::new(
            c[0] * (1.0 + c[1] * at.y) + s * at.y * z / top,
            c[1] * (1.0 + c[0] * at.x) + s * at.x * z / top,
            -1.0 + s * at.x * at.y / (top * top),
        ) / 4.0;
    }
    shape.values[4] = z;
    shape.gradients[4] = DVec3::Z;
}

/// Reference coordinates of every node of a kind.
pub fn reference_nodes(kind: ElementKind) -> Vec<DVec3> {
    let cube = || CUBE_CORNERS.into_iter().map(DVec3::from_array).collect::<Vec<_>>();
    let tet = || vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
    let with_edges = |mut nodes: Vec<DVec3>, edges: &[[usize; 2]]| {
        nodes.extend(edges.iter().map(|[a, b]| nodes[*a].midpoint(nodes[*b])).collect::<Vec<_>>());
        nodes
    };
    match kind {
        ElementKind::Tet => tet(),
        ElementKind::QuadraticTet => with_edges(tet(), &QUADRATIC_TET_EDGES),
        ElementKind::Hexahedron => cube(),
        ElementKind::QuadraticHexahedron => with_edges(cube(), &QUADRATIC_HEX_EDGES),
        ElementKind::Wedge => [-1.0, 1.0]
            .into_iter()
            .flat_map(|z| [DVec3::new(0.0, 0.0, z), DVec3::new(0.0, 1.0, z), DVec3::new(1.0, 0.0, z)])
            .collect(),
        ElementKind::Pyramid => {
            let mut nodes: Vec<DVec3> = CUBE_CORNERS[..4].iter().map(|c| DVec3::new(c[0], c[1], 0.0)).collect();
            nodes.push(DVec3::Z);
            nodes
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KINDS: [ElementKind; 6] = [
        ElementKind::Tet,
        ElementKind::Hexahedron,
        ElementKind::Wedge,
        ElementKind::Pyramid,
        ElementKind::QuadraticTet,
        ElementKind::QuadraticHexahedron,
    ];

    #[test]
    fn each_function_is_one_at_its_own_node_only() {
        for kind in KINDS {
            for (i, node) in reference_nodes(kind).into_iter().enumerate() {
                let shape = shape_functions(kind, node);
                for j in 0..kind.node_count() {
                    let expected = f64::from(u8::from(i == j));
                    assert!((shape.values[j] - expected).abs() < 1e-8, "{kind:?} {i} {j} {}", shape.values[j]);
                }
            }
        }
    }

    #[test]
    fn gradients_are_the_slopes_of_the_values() {
        let at = DVec3::new(0.21, 0.17, 0.33);
        let step = 1e-6;
        for kind in KINDS {
            let shape = shape_functions(kind, at);
            assert!((shape.values.iter().sum::<f64>() - 1.0).abs() < 1e-14);
            for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
                let (up, down) = (shape_functions(kind, at + axis * step), shape_functions(kind, at - axis * step));
                for i in 0..kind.node_count() {
                    let slope = (up.values[i] - down.values[i]) / (2.0 * step);
                    assert!((slope - shape.gradients[i].dot(axis)).abs() < 1e-8, "{kind:?} {i}");
                }
            }
        }
    }
}
