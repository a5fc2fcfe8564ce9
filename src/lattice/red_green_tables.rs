//! Templates of red-green subdivision of a body-centred cubic tet.
//!
//! ```text
//!            3            Local vertices 0 to 3, then the mid-edge vertices 4 + e in the order of
//!           /|\           numbering::TET_EDGES: 4 = 01, 5 = 02, 6 = 03, 7 = 12, 8 = 13, 9 = 23.
//!          6 | 9          Edges 01 and 23 are the long ones (one cube edge), the other four are sqrt(3)/2 of it.
//!         /  8  \         Red: the corners 0 1 2 3 and four tets around the shortest inner diagonal 4-9; every child
//!        0---|-5-2        is again a tet of this shape with 01 and 23 long, half as large.
//!         4  |  7         Green: one split edge, two opposite ones, or the three of a face.
//!          \ | /
//!            1
//! ```
//!
//! # Source
//! [Molino2003] for the three green patterns; the bounds of the angles are computed by the test.

/// Children of a red tet; each begins with its long edges 01 and 23.
pub const RED_CHILDREN: [[u8; 4]; 8] =
    [[0, 4, 5, 6], [4, 1, 7, 8], [5, 7, 2, 9], [6, 8, 9, 3], [4, 9, 5, 6], [4, 9, 6, 8], [4, 9, 8, 7], [4, 9, 7, 5]];

/// Children of a tet whose split edges are the bits of `mask` (bit e = edge e of `numbering::TET_EDGES`); `None` where
/// the tet has to become red instead.
#[inline]
pub fn green_children(mask: u8) -> Option<&'static [[u8; 4]]> {
    Some(match mask {
        0b000000 => &[[0, 1, 2, 3]],
        0b000001 => &[[0, 4, 2, 3], [4, 1, 2, 3]],
        0b000010 => &[[0, 1, 5, 3], [5, 1, 2, 3]],
        0b000100 => &[[0, 1, 2, 6], [6, 1, 2, 3]],
        0b001000 => &[[0, 1, 7, 3], [0, 7, 2, 3]],
        0b001011 => &[[0, 4, 5, 3], [4, 1, 7, 3], [5, 7, 2, 3], [4, 7, 5, 3]],
        0b001100 => &[[0, 1, 7, 6], [0, 7, 2, 6], [6, 1, 7, 3], [6, 7, 2, 3]],
        0b010000 => &[[0, 1, 2, 8], [0, 8, 2, 3]],
        0b010010 => &[[0, 1, 5, 8], [0, 8, 5, 3], [5, 1, 2, 8], [5, 8, 2, 3]],
        0b010101 => &[[0, 4, 2, 6], [4, 1, 2, 8], [6, 8, 2, 3], [4, 8, 2, 6]],
        0b100000 => &[[0, 1, 2, 9], [0, 1, 9, 3]],
        0b100001 => &[[0, 4, 2, 9], [0, 4, 9, 3], [4, 1, 2, 9], [4, 1, 9, 3]],
        0b100110 => &[[0, 1, 5, 6], [5, 1, 2, 9], [6, 1, 9, 3], [5, 9, 6, 1]],
        0b111000 => &[[0, 1, 7, 8], [0, 7, 2, 9], [0, 8, 9, 3], [7, 9, 0, 8]],
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::predicates::orient3d;
    use crate::mesh::numbering::{TET_EDGES, TET_FACES};
    use glam::DVec3;
    use std::collections::BTreeMap;

    fn nodes() -> Vec<DVec3> {
        let mut nodes = vec![DVec3::ZERO, DVec3::X, DVec3::new(0.5, 0.5, -0.5), DVec3::new(0.5, 0.5, 0.5)];
        for [a, b] in TET_EDGES {
            nodes.push(0.5 * (nodes[a] + nodes[b]));
        }
        nodes
    }

    fn dihedral_range(p: [DVec3; 4]) -> (f64, f64) {
        let normals = TET_FACES.map(|[a, b, c]| (p[b] - p[a]).cross(p[c] - p[a]).normalize());
        let angle = |[a, b]: [usize; 2]| (-normals[a].dot(normals[b])).acos().to_degrees();
        TET_EDGES.map(angle).into_iter().fold((180.0, 0.0), |(l, h), a| (l.min(a), h.max(a)))
    }

    fn all_templates() -> Vec<Vec<[u8; 4]>> {
        let greens = (0..64).filter_map(green_children).map(<[_]>::to_vec);
        greens.chain(std::iter::once(RED_CHILDREN.to_vec())).collect()
    }

    #[test]
    fn templates_fill_their_parent_with_positive_tets_of_bounded_angles() {
        let nodes = nodes();
        let volume = |t: &[u8; 4]| {
            let [a, b, c, d] = t.map(|v| nodes[usize::from(v)]);
            orient3d(a, b, c, d)
        };
        let parent = volume(&[0, 1, 2, 3]);
        for template in all_templates() {
            assert!(template.iter().all(|t| volume(t) > 0.0), "{template:?}");
            assert!((template.iter().map(volume).sum::<f64>() - parent).abs() < 1e-12, "{template:?}");
            for t in &template {
                let (low, high) = dihedral_range(t.map(|v| nodes[usize::from(v)]));
                assert!(low > 29.999 && high < 116.566, "{t:?} {low} {high}");
            }
        }
    }

    #[test]
    fn red_children_are_half_scale_copies_of_the_parent() {
        let nodes = nodes();
        for child in RED_CHILDREN {
            let p = child.map(|v| nodes[usize::from(v)]);
            for (e, [a, b]) in TET_EDGES.into_iter().enumerate() {
                let expected = if e == 0 || e == 5 { 0.5 } else { 0.75f64.sqrt() / 2.0 };
                assert!((p[a].distance(p[b]) - expected).abs() < 1e-12);
            }
        }
    }

    /// Every inner face twice, every outer face of the parent tiled by the same triangles whatever the pattern.
    #[test]
    fn templates_conform_inside_and_across_faces() {
        let nodes = nodes();
        let mut outer_by_face_and_mask: BTreeMap<(usize, Vec<usize>), Vec<Vec<u8>>> = BTreeMap::new();
        let masks = (0..64u8).filter(|m| green_children(*m).is_some()).chain(std::iter::once(63));
        for (mask, template) in masks.zip(all_templates()) {
            let mut faces: BTreeMap<Vec<u8>, usize> = BTreeMap::new();
            for t in &template {
                for face in TET_FACES {
                    let mut key: Vec<u8> = face.iter().map(|v| t[*v]).collect();
                    key.sort_unstable();
                    *faces.entry(key).or_default() += 1;
                }
            }
            assert!(faces.values().all(|n| *n <= 2));
            for (f, face) in TET_FACES.into_iter().enumerate() {
                let [a, b, c] = face.map(|v| nodes[v]);
                let on_face = |key: &[u8]| key.iter().all(|v| orient3d(a, b, c, nodes[usize::from(*v)]) == 0.0);
                let outer: Vec<Vec<u8>> =
                    faces.iter().filter(|(k, n)| **n == 1 && on_face(k)).map(|(k, _)| k.clone()).collect();
                let split: Vec<usize> =
                    (0..6).filter(|e| mask >> e & 1 == 1 && TET_EDGES[*e].iter().all(|v| face.contains(v))).collect();
                let known = outer_by_face_and_mask.entry((f, split)).or_insert_with(|| outer.clone());
                assert_eq!(*known, outer, "face {f} of mask {mask:06b}");
            }
            let outer_count: usize = faces.values().filter(|n| **n == 1).count();
            let listed: usize = (0..4)
                .map(|f| {
                    let [a, b, c] = TET_FACES[f].map(|v| nodes[v]);
                    let on = |k: &&Vec<u8>| k.iter().all(|v| orient3d(a, b, c, nodes[usize::from(*v)]) == 0.0);
                    faces.iter().filter(|(_, n)| **n == 1).map(|(k, _)| k).filter(on).count()
                })
                .sum();
            assert_eq!(outer_count, listed, "an inner face of mask {mask:06b} has one tet");
        }
    }
}
