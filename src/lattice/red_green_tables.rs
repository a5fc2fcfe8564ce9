//! Templates of red-green subdivision of a body-centred cubic tet.
//!
//! ```text
//!            3            Local vertices 0 to 3, then the mid-edge vertices 4 + e in the order of
//!           /|\           numbering::TET_EDGES: 4 = 01, 5 = 02, 6 = 03, 7 = 12, 8 = 13, 9 = 23.
//!          6 | 9          Edges 01 and 23 are the long ones (one cube edge), the other four are sqrt(3)/2 of it.
//!         /  8  \         Red: the corners 0 1 2 3 and four tets around the shortest inner diagonal 4-9; every child
//!        0---|-5-2        is again a tet of this shape with 01 and 23 long, half as large.
//!         4  |  7         Green: every other set of split edges, as long as no face has only its two short ones split.
//!          \ | /
//!            1
//! ```
//! A face is an isosceles triangle with a long edge. Where only a short and the long edge are split, the four-sided rest
//! of the face is divided from its tip to the middle of the long edge, the shorter diagonal; where only both short ones
//! are split, both diagonals are equally long, so [`missing_long_edges`] splits the long one too. Each face therefore
//! looks the same from both sides without a tie to break.
//!
//! # Source
//! [Molino2003] for red tets and the green patterns of one edge, two opposite ones and a face; the bounds of the angles
//! are computed by the test.
//!
//! # Differences
//! [Molino2003] makes tets with any other pattern red ([`is_regular`]), which spreads: a few hundred marks at random in a
//! lattice of 400 thousand tets refined nearly all of it. With a template for every pattern a mark reaches its neighbours
//! only, at angles up to 120 instead of 116.6 degrees.

/// Children of a red tet; each begins with its long edges 01 and 23.
pub const RED_CHILDREN: [[u8; 4]; 8] =
    [[0, 4, 5, 6], [4, 1, 7, 8], [5, 7, 2, 9], [6, 8, 9, 3], [4, 9, 5, 6], [4, 9, 6, 8], [4, 9, 8, 7], [4, 9, 7, 5]];

/// Whether split edges are one of the patterns of [Molino2003]: none, one, two opposite ones, the three of a face.
#[inline]
pub fn is_regular(mask: u8) -> bool {
    let opposite = [0b100001, 0b010010, 0b001100];
    let faces = [0b001011, 0b010101, 0b100110, 0b111000];
    mask.count_ones() < 2 || opposite.contains(&mask) || faces.contains(&mask)
}

/// Long edges (bits 0 and 5) that have to be split before the split edges `mask` have a template: those of faces of which
/// only both short edges are split.
#[inline]
pub fn missing_long_edges(mask: u8) -> u8 {
    let is_split = |edges: u8| mask & edges == edges;
    let first = is_split(0b001010) || is_split(0b010100);
    let second = is_split(0b000110) || is_split(0b011000);
    (u8::from(first) | u8::from(second) << 5) & !mask
}

/// Children of a tet whose split edges are the bits of `mask` (bit e = edge e of `numbering::TET_EDGES`); `None` where
/// the tet has to become red, or a long edge is missing.
#[inline]
pub fn green_children(mask: u8) -> Option<&'static [[u8; 4]]> {
    Some(match mask {
        0b000000 => &[[0, 1, 2, 3]],
        0b000001 => &[[0, 4, 2, 3], [4, 1, 2, 3]],
        0b000010 => &[[0, 1, 5, 3], [5, 1, 2, 3]],
        0b000011 => &[[0, 4, 5, 3], [5, 4, 2, 3], [4, 1, 2, 3]],
        0b000100 => &[[0, 1, 2, 6], [6, 1, 2, 3]],
        0b000101 => &[[0, 4, 2, 6], [6, 4, 2, 3], [4, 1, 2, 3]],
        0b001000 => &[[0, 1, 7, 3], [0, 7, 2, 3]],
        0b001001 => &[[1, 4, 3, 7], [7, 4, 3, 2], [4, 0, 3, 2]],
        0b001011 => &[[0, 4, 5, 3], [4, 1, 7, 3], [5, 7, 2, 3], [4, 7, 5, 3]],
        0b001100 => &[[0, 1, 7, 6], [0, 7, 2, 6], [6, 1, 7, 3], [6, 7, 2, 3]],
        0b001101 => &[[0, 4, 2, 6], [6, 4, 2, 3], [4, 1, 7, 3], [4, 7, 2, 3]],
        0b010000 => &[[0, 1, 2, 8], [0, 8, 2, 3]],
        0b010001 => &[[1, 4, 8, 2], [8, 4, 3, 2], [4, 0, 3, 2]],
        0b010010 => &[[0, 1, 5, 8], [0, 8, 5, 3], [5, 1, 2, 8], [5, 8, 2, 3]],
        0b010011 => &[[0, 4, 5, 3], [5, 4, 2, 3], [4, 1, 2, 8], [4, 8, 2, 3]],
        0b010101 => &[[0, 4, 2, 6], [4, 1, 2, 8], [6, 8, 2, 3], [4, 8, 2, 6]],
        0b100000 => &[[0, 1, 2, 9], [0, 1, 9, 3]],
        0b100001 => &[[0, 4, 2, 9], [0, 4, 9, 3], [4, 1, 2, 9], [4, 1, 9, 3]],
        0b100010 => &[[2, 9, 5, 1], [5, 9, 0, 1], [9, 3, 0, 1]],
        0b100011 => &[[0, 4, 5, 9], [5, 4, 2, 9], [0, 4, 9, 3], [4, 1, 2, 9], [4, 1, 9, 3]],
        0b100100 => &[[3, 9, 1, 6], [6, 9, 1, 0], [9, 2, 1, 0]],
        0b100101 => &[[0, 4, 9, 6], [6, 4, 9, 3], [0, 4, 2, 9], [4, 1, 9, 3], [4, 1, 2, 9]],
        0b100110 => &[[0, 1, 5, 6], [5, 1, 2, 9], [6, 1, 9, 3], [5, 9, 6, 1]],
        0b100111 => &[[2, 9, 5, 4], [9, 3, 6, 4], [5, 6, 0, 4], [9, 6, 5, 4], [2, 9, 4, 1], [9, 3, 4, 1]],
        0b101000 => &[[2, 9, 0, 7], [7, 9, 0, 1], [9, 3, 0, 1]],
        0b101001 => &[[1, 4, 9, 7], [7, 4, 9, 2], [1, 4, 3, 9], [4, 0, 9, 2], [4, 0, 3, 9]],
        0b101011 => &[[0, 4, 5, 9], [4, 1, 7, 9], [5, 7, 2, 9], [4, 7, 5, 9], [0, 4, 9, 3], [4, 1, 9, 3]],
        0b101100 => &[[2, 9, 0, 7], [7, 9, 0, 1], [9, 3, 6, 1], [9, 6, 0, 1]],
        0b101101 => &[[0, 4, 9, 6], [6, 4, 9, 3], [0, 4, 2, 9], [4, 1, 9, 3], [4, 1, 7, 9], [4, 7, 2, 9]],
        0b101111 => &[[0, 4, 5, 6], [5, 7, 2, 9], [4, 9, 5, 6], [4, 9, 7, 5], [4, 1, 7, 9], [4, 6, 3, 9], [4, 1, 9, 3]],
        0b110000 => &[[3, 9, 8, 0], [8, 9, 1, 0], [9, 2, 1, 0]],
        0b110001 => &[[1, 4, 8, 9], [8, 4, 3, 9], [1, 4, 9, 2], [4, 0, 3, 9], [4, 0, 9, 2]],
        0b110010 => &[[2, 9, 5, 1], [5, 9, 0, 1], [9, 3, 0, 8], [9, 8, 0, 1]],
        0b110011 => &[[0, 4, 5, 9], [5, 4, 2, 9], [0, 4, 9, 3], [4, 1, 2, 9], [4, 1, 9, 8], [4, 8, 9, 3]],
        0b110101 => &[[0, 4, 9, 6], [4, 1, 9, 8], [6, 8, 9, 3], [4, 8, 9, 6], [0, 4, 2, 9], [4, 1, 2, 9]],
        0b110111 => &[[0, 4, 5, 6], [6, 8, 9, 3], [4, 9, 5, 6], [4, 9, 6, 8], [4, 1, 9, 8], [4, 5, 9, 2], [4, 1, 2, 9]],
        0b111000 => &[[0, 1, 7, 8], [0, 7, 2, 9], [0, 8, 9, 3], [7, 9, 0, 8]],
        0b111001 => &[[2, 9, 4, 7], [9, 3, 4, 8], [7, 8, 4, 1], [9, 8, 4, 7], [2, 9, 0, 4], [9, 3, 0, 4]],
        0b111011 => &[[1, 4, 8, 7], [7, 5, 9, 2], [4, 9, 8, 7], [4, 9, 7, 5], [4, 0, 9, 5], [4, 8, 9, 3], [4, 0, 3, 9]],
        0b111101 => &[[1, 4, 8, 7], [8, 6, 3, 9], [4, 9, 8, 7], [4, 9, 6, 8], [4, 0, 6, 9], [4, 7, 2, 9], [4, 0, 9, 2]],
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
                assert!(low > 29.999 && high < 120.001, "{t:?} {low} {high}");
            }
        }
    }

    #[test]
    fn every_pattern_has_a_template_once_its_long_edges_are_split() {
        for mask in 0..63u8 {
            let missing = missing_long_edges(mask);
            assert!(missing == 0 || !is_regular(mask));
            assert_eq!(green_children(mask).is_some(), missing == 0, "{mask:06b}");
            assert_eq!(missing_long_edges(mask | missing), 0);
        }
        assert!(green_children(63).is_none());
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

    /// Tip and the ends of the long edge of a face.
    fn roles(face: [usize; 3]) -> Option<[usize; 3]> {
        let [a, b, c] = face;
        let is_long = |v: usize, w: usize| [v.min(w), v.max(w)] == [0, 1] || [v.min(w), v.max(w)] == [2, 3];
        [[a, b, c], [b, c, a], [c, a, b]].into_iter().find(|[_, first, second]| is_long(*first, *second))
    }

    /// Barycentric coordinates within a face, in quarters, exactly.
    fn place_on_face(point: DVec3, [tip, first, second]: [DVec3; 3]) -> DVec3 {
        let area = |a: DVec3, b: DVec3, c: DVec3| (b - a).cross(c - a).length();
        let whole = area(tip, first, second);
        let part = |a, b| (4.0 * area(point, a, b) / whole).round();
        DVec3::new(part(first, second), part(second, tip), part(tip, first))
    }

    fn order(a: &DVec3, b: &DVec3) -> std::cmp::Ordering {
        a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)).then(a.z.total_cmp(&b.z))
    }

    /// Every inner face twice, every outer face of the parent tiled by the same triangles whatever the pattern.
    #[test]
    fn templates_conform_inside_and_across_faces() {
        let nodes = nodes();
        // Faces are compared by what they are, not by their number: tip, first and second end of the long edge.
        let mut outer_by_mask: BTreeMap<Vec<bool>, Vec<Vec<DVec3>>> = BTreeMap::new();
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
                let Some([tip, first, second]) = roles(face) else { panic!("face {f} has a long edge") };
                for [first, second] in [[first, second], [second, first]] {
                    let is_split = |v: usize, w: usize| {
                        let edge = TET_EDGES.iter().position(|[a, b]| [*a, *b] == [v.min(w), v.max(w)]).unwrap();
                        mask >> edge & 1 == 1
                    };
                    let split = vec![is_split(first, second), is_split(tip, first), is_split(tip, second)];
                    let at = |v: &u8| place_on_face(nodes[usize::from(*v)], [tip, first, second].map(|v| nodes[v]));
                    let mut seen: Vec<Vec<DVec3>> = outer.iter().map(|t| t.iter().map(at).collect()).collect();
                    seen.iter_mut().for_each(|t| t.sort_by(order));
                    seen.sort_by(|l, r| l.iter().zip(r).map(|(a, b)| order(a, b)).find(|o| o.is_ne()).unwrap());
                    let known = outer_by_mask.entry(split).or_insert_with(|| seen.clone());
                    assert_eq!(*known, seen, "face {f} of mask {mask:06b}");
                }
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
