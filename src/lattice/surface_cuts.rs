//! How far the surface of a mesh is off the surface that it stands for: at vertices, along edges, in the middles of faces.
//!
//! # Method
//! The surface between the labels of both sides is asked for its depth at places of the face. Where most labels are vessels an edge
//! counts where it is farthest off: creases pass anywhere.
//!
//! Who asks again and again around neighbouring places keeps what is known ([`KnownCuts`]): an answer holds as long as the vertices are
//! where they were, and these are compared.
//!
//! # Cost
//! One depth per vertex and face and one, or five, per edge; about 100 bytes per answer that is kept.

use glam::DVec3;
use rustc_hash::FxHashMap;

use crate::index::Label;
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::lattice::subvoxel_surface::Side;
use crate::mesh::numbering::sorted_edge;

/// A surface face: its vertices and the labels of its sides.
pub type LabelledFace = ([u32; 3], [Label; 2]);

/// The two labels that a vertex of the mesh lies between; `None` for any other, and where it has no tets left.
pub fn labels_around(mesh: &ImprovementMesh, v: u32) -> Option<[Label; 2]> {
    match *mesh.sides(v) {
        [Side::Label(a), Side::Label(b)] if !mesh.ball(v).is_empty() => Some([a, b]),
        _ => None,
    }
}

/// How far off its surface a vertex between two labels is, mm.
pub fn distance_off(mesh: &ImprovementMesh, v: u32) -> Option<f64> {
    let [a, b] = labels_around(mesh, v)?;
    mesh.surface.depth(mesh.points[v as usize], a, b).map(f64::abs)
}

/// No vertex.
const NONE: u32 = u32::MAX;

/// How far off their surface the middles of faces and of their edges are at most, mm; each face with the labels of its sides.
pub fn worst_cut(mesh: &ImprovementMesh, faces: impl Iterator<Item = LabelledFace>) -> f64 {
    let off = |([a, b, c], sides): LabelledFace| {
        let edges = [[a, b], [b, c], [c, a]].map(|edge| edge_cut(mesh, edge, sides));
        edges.into_iter().fold(face_cut(mesh, [a, b, c], sides), f64::max)
    };
    faces.map(off).fold(0.0, f64::max)
}

/// The same of the faces and edges that are there after a change and were not before.
pub fn worst_new_cut(
    mesh: &ImprovementMesh,
    before: impl Iterator<Item = LabelledFace>,
    after: impl Iterator<Item = LabelledFace>,
) -> f64 {
    let edges_of =
        |([a, b, c], sides): LabelledFace| [[a, b], [b, c], [c, a]].map(|[from, to]| (sorted_edge(from, to), sides));
    let mut known: Vec<([u32; 2], [Label; 2])> = before.flat_map(edges_of).collect();
    let mut worst = 0.0_f64;
    for face in after {
        worst = worst.max(face_cut(mesh, face.0, face.1));
        for edge in edges_of(face) {
            // A handful: looking through them is faster than a table.
            if !known.contains(&edge) {
                known.push(edge);
                worst = worst.max(edge_cut(mesh, edge.0, edge.1));
            }
        }
    }
    worst
}

fn depth(mesh: &ImprovementMesh, place: DVec3, [inner, outer]: [Label; 2]) -> f64 {
    mesh.surface.depth(place, inner, outer).map_or(0.0, f64::abs)
}

fn face_cut(mesh: &ImprovementMesh, corners: [u32; 3], sides: [Label; 2]) -> f64 {
    let [a, b, c] = corners.map(|v| mesh.points[v as usize]);
    depth(mesh, (a + b + c) / 3.0, sides)
}

fn edge_cut(mesh: &ImprovementMesh, ends: [u32; 2], sides: [Label; 2]) -> f64 {
    let [from, to] = ends.map(|v| mesh.points[v as usize]);
    let at = |eighths: u8| depth(mesh, from.lerp(to, f64::from(eighths) / 8.0), sides);
    if mesh.surface.has_mostly_vessels() { farthest_on_edge(at).0 } else { at(4) }
}

/// How far off an edge is where it is farthest off, of its quarters and the eighths beside the farthest of these, and how many
/// eighths of it lie before that place: across a crease the distance has a peak anywhere. `off` is asked for the distance after some
/// eighths.
pub fn farthest_on_edge(off: impl Fn(u8) -> f64) -> (f64, u8) {
    let farther = |l: (f64, u8), r: (f64, u8)| if r.0 > l.0 { r } else { l };
    let at = |eighths: u8| (off(eighths), eighths);
    let of_quarters = [2, 6].map(at).into_iter().fold(at(4), farther);
    [of_quarters.1 - 1, of_quarters.1 + 1].map(at).into_iter().fold(of_quarters, farther)
}

/// A vertex, an edge or a face: as a face, its vertices in ascending order, then `NONE`, the labels in ascending order.
type SurfacePart = LabelledFace;

/// How far off parts of a surface are that were asked for, as long as the surface itself stays the same.
#[derive(Debug, Default)]
pub struct KnownCuts {
    known: FxHashMap<SurfacePart, ([DVec3; 3], f64)>,
}

impl KnownCuts {
    /// How far off their surface the surface faces at some vertices are at most, and these vertices, mm. Removed vertices, and those
    /// inside, count for nothing.
    pub fn farthest_around(&mut self, mesh: &ImprovementMesh, vertices: &[u32]) -> f64 {
        let mut parts: Vec<SurfacePart> = Vec::new();
        for v in vertices.iter().copied().filter(|v| mesh.is_on_surface(*v) && !mesh.ball(*v).is_empty()) {
            let faces = mesh.surface_faces(v);
            let labelled = faces.iter().filter_map(|face| Some((face, mesh.labels_beside(v, face)?)));
            for (at, (face, mut sides)) in labelled.enumerate() {
                sides.sort_unstable();
                if at == 0 {
                    parts.push(([v, NONE, NONE], sides));
                }
                let mut corners = [v, face.others[0], face.others[1]];
                corners.sort_unstable();
                let [a, b, c] = corners;
                parts.extend([[a, b, c], [a, b, NONE], [b, c, NONE], [a, c, NONE]].map(|part| (part, sides)));
            }
        }
        // Faces have been found at each of their vertices, edges at both of their faces.
        parts.sort_unstable();
        parts.dedup();
        parts.into_iter().map(|part| self.cut(mesh, part)).fold(0.0, f64::max)
    }

    fn cut(&mut self, mesh: &ImprovementMesh, part: SurfacePart) -> f64 {
        let ([a, b, c], sides) = part;
        let at = |v: u32| if v == NONE { DVec3::ZERO } else { mesh.points[v as usize] };
        let places = [a, b, c].map(at);
        if let Some((then, cut)) = self.known.get(&part)
            && *then == places
        {
            return *cut;
        }
        let cut = match part.0 {
            [_, NONE, _] => depth(mesh, places[0], sides),
            [_, _, NONE] => edge_cut(mesh, [a, b], sides),
            corners => face_cut(mesh, corners, sides),
        };
        self.known.insert(part, (places, cut));
        cut
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::improvement_mesh::SurfaceFace;
    use crate::lattice::test_meshes::{with_edge_on_ball, with_faces_in_border};

    #[test]
    fn what_is_known_is_what_would_be_measured_again() {
        with_edge_on_ball(0.7, [0, 1, 2, 3], |mut mesh| {
            let mut known = KnownCuts::default();
            let corners = [0, 1, 2, 3];
            let first = known.farthest_around(&mesh, &corners);
            let at_vertex = |v: u32| {
                let faces = mesh.surface_faces(v);
                let of_face = |f: &SurfaceFace| ([v, f.others[0], f.others[1]], mesh.labels_beside(v, f).unwrap());
                let of_vertex = depth(&mesh, mesh.points[v as usize], mesh.labels_beside(v, &faces[0]).unwrap());
                worst_cut(&mesh, faces.iter().map(of_face)).max(of_vertex)
            };
            assert!((first - corners.map(at_vertex).into_iter().fold(0.0, f64::max)).abs() < 1e-9, "{first}");
            // What is there before and after does not count; an edge of two faces counts once.
            let faces: Vec<LabelledFace> = mesh
                .surface_faces(0)
                .iter()
                .map(|f| ([0, f.others[0], f.others[1]], mesh.labels_beside(0, f).unwrap()))
                .collect();
            let new = |before: usize, after: &[LabelledFace]| {
                worst_new_cut(&mesh, faces[..before].iter().copied(), after.iter().copied())
            };
            assert_eq!(new(0, &faces), worst_cut(&mesh, faces.iter().copied()));
            let centers = faces.iter().map(|(corners, sides)| face_cut(&mesh, *corners, *sides));
            assert_eq!(new(faces.len(), &faces), centers.fold(0.0, f64::max));
            let answers = known.known.len();
            assert_eq!(known.farthest_around(&mesh, &corners), first);
            assert_eq!(known.known.len(), answers);
            // A vertex leaves the ball: what was known of it no longer holds.
            let place = mesh.points[0];
            mesh.move_vertex(0, place + DVec3::new(0.0, 3.0, 0.0));
            let second = known.farthest_around(&mesh, &corners);
            assert_eq!(second, KnownCuts::default().farthest_around(&mesh, &corners));
            assert!(second > first);
            // It comes back: so does the answer. Without vertices there is none.
            mesh.move_vertex(0, place);
            assert_eq!(known.farthest_around(&mesh, &corners), first);
            assert_eq!(known.farthest_around(&mesh, &[]), 0.0);
        });
    }

    #[test]
    fn faces_in_the_image_border_cut_nothing_off() {
        with_faces_in_border([0, 1, 2, 3], |mesh| {
            let labels = [Label(1), Label(0)];
            let at_face =
                |corners: [u32; 3]| face_cut(&mesh, corners, labels).max(depth(&mesh, mesh.points[0], labels));
            let edges = [[0, 2], [0, 3], [0, 4], [2, 4], [3, 4]].map(|edge| edge_cut(&mesh, edge, labels));
            let expected = edges.into_iter().fold(at_face([0, 2, 4]).max(at_face([0, 3, 4])), f64::max);
            let found = KnownCuts::default().farthest_around(&mesh, &[0]);
            assert!((found - expected).abs() < 1e-9 && found > 0.0, "{found} {expected}");
        });
    }

    #[test]
    fn an_edge_is_farthest_off_at_the_peak_over_a_crease() {
        for peak in 1..8 {
            let (off, eighths) = farthest_on_edge(|eighths| 1.0 - 0.1 * f64::from(eighths.abs_diff(peak)));
            assert_eq!((off, eighths), (1.0, peak));
        }
        // Where it is as far off all along, its middle is what is split.
        assert_eq!(farthest_on_edge(|_| 0.3), (0.3, 4));
    }
}
