//! Puts Steiner points: on what could not be recovered, by constrained insertion.
//!
//! # Method
//! 1. A missing edge is split where it crosses a face of the mesh, nearest to its middle; a missing face where an edge
//!    pierces it, farthest from its border. Rounding moves the point off the edge or face by less than any feature.
//!    Where flat tets of a plane lie before an end, every part of the segment at that end stays missing: then the point
//!    goes where it sees the end (`sight_insertion`).
//!    At last a segment is split at all crossings, each in place of what is crossed there.
//! 2. The point is located by a walk; the cavity grows from there over tets whose circumsphere contains the point, as long as
//!    the point sees its whole boundary, never over a subface or around a segment.
//!
//! # Source
//! [Bowyer1981], [Watson1981] for the cavity; [GeorgeBorouchaki2003] for points on constraints.

use super::constrained_mesh::{ConstrainedMesh, EdgeKey, FaceKey};
use super::crossings::{Crossing, Path, tets_across, tets_along, trace};
use crate::error::Result;
use crate::geometry::predicates::{insphere, orient3d};
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::{TET_EDGES, TET_FACES};
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::ShellTet;
use glam::DVec3;

/// Splits of one segment over its crossings at first: a point beside it by rounding may see others.
const ROUNDING_SHARE: usize = 2;
/// Tets that join a cavity whatever the point sees, beyond which the insertion is given up.
const MOST_FORCED: usize = 60;

/// Puts a point on a missing segment where it crosses the mesh; its vertex, or `None` where none could be inserted.
///
/// # Errors
/// Those of vertex and tet creation.
pub fn insert_on_segment(mesh: &mut ConstrainedMesh, [a, b]: EdgeKey) -> Result<Option<VertexId>> {
    let Some(tets) = tets_along(mesh, a, b) else { return Ok(None) };
    let Some(&hint) = tets.first() else { return Ok(None) };
    let (pa, pb) = (mesh.at(a), mesh.at(b));
    let mut places: Vec<f64> = vec![0.5];
    for &tet in &tets {
        for face in 0..4 {
            let side = TetFace::new(tet, face);
            let v = mesh.complex.face_vertices(side);
            if v.contains(&a) || v.contains(&b) || v.iter().any(|v| v.is_ghost()) {
                continue;
            }
            let [x, y, z] = v.map(|v| mesh.at(v));
            let (da, db) = (orient3d(x, y, z, pa), orient3d(x, y, z, pb));
            let other = mesh.complex.neighbor(side);
            let inner = other != TetFace::NONE && tets.contains(&other.tet());
            if inner && (da > 0.0) != (db > 0.0) {
                places.push(da / (da - db));
            }
        }
    }
    places.retain(|t| t.is_finite() && *t > 0.02 && *t < 0.98);
    // The crossing nearest to the middle first, the middle itself last.
    places[1..].sort_by(|l, r| (l - 0.5).abs().total_cmp(&(r - 0.5).abs()));
    places.rotate_left(1);
    for t in places.into_iter().take(6) {
        if let Some(steiner) = insert_point(mesh, pa + (pb - pa) * t, hint_of(mesh, hint, a))? {
            return Ok(Some(steiner));
        }
    }
    insert_at_crossing(mesh, [a, b])
}

/// What a segment crosses: where, as a share of the way, and the tets around it.
pub type Place = (f64, Vec<TetId>);

/// The places where the segment crosses faces and edges that are no constraints, in order; `None` where it cannot be told.
pub fn crossed_places(mesh: &ConstrainedMesh, [a, b]: EdgeKey) -> Option<Vec<Place>> {
    let Some(Path::Through(crossings)) = trace(mesh, a, b) else { return None };
    let (pa, pb) = (mesh.at(a), mesh.at(b));
    let mut places: Vec<Place> = Vec::new();
    for crossing in crossings {
        match crossing {
            Crossing::Face(side) if !mesh.is_subface(side) => {
                let [x, y, z] = mesh.complex.face_vertices(side).map(|v| mesh.at(v));
                let (da, db) = (orient3d(x, y, z, pa), orient3d(x, y, z, pb));
                places.push((da / (da - db), vec![side.tet(), mesh.complex.neighbor(side).tet()]));
            }
            Crossing::Edge(tet, [u, v]) if !mesh.is_segment(u, v) => {
                let (pu, pv) = (mesh.at(u), mesh.at(v));
                // Both lines lie in one plane: the share of the area on one side of u v.
                let (toward, across) = (pb - pa, pv - pu);
                let normal = toward.cross(across);
                let share = (pu - pa).cross(across).dot(normal) / normal.length_squared();
                let shell = mesh.ball(u).into_iter().filter(|&t| mesh.complex.local_vertex(t, v).is_some());
                debug_assert!(mesh.complex.local_vertex(tet, v).is_some());
                places.push((share, shell.collect()));
            }
            _ => {}
        }
    }
    Some(places)
}

/// Puts a point where the segment crosses a face or edge of the mesh, in place of that face or edge: the point sees all
/// around it, whatever the rest of the mesh is like.
fn insert_at_crossing(mesh: &mut ConstrainedMesh, [a, b]: EdgeKey) -> Result<Option<VertexId>> {
    let Some(mut places) = crossed_places(mesh, [a, b]) else { return Ok(None) };
    let (pa, pb) = (mesh.at(a), mesh.at(b));
    places.retain(|(t, _)| *t > 0.0 && *t < 1.0);
    places.sort_by(|l, r| (l.0 - 0.5).abs().total_cmp(&(r.0 - 0.5).abs()));
    for (t, cavity) in places {
        let count = mesh.complex.points().len();
        let vertex = mesh.complex.push_point(pa + (pb - pa) * t)?;
        let front = mesh.shape_of(&cavity).front;
        let new: Vec<[VertexId; 4]> = front.iter().map(|&[x, y, z]| [x, y, z, vertex]).collect();
        let is_finite = !new.iter().flatten().any(|v| v.is_ghost());
        if is_finite && mesh.replace(&cavity, &new)? {
            return Ok(Some(vertex));
        }
        mesh.complex.truncate_points(count);
    }
    Ok(None)
}

/// Splits a missing segment where it crosses the mesh, and its parts in the same way until the mesh has them all; the
/// segments that come with that, those to the facets' other vertices among them, or `None` where nothing was split.
///
/// A point in place of a crossing cuts the tets around it, and only their faces: what the parts cross is what the segment
/// crossed, less the place of the point. So there are as many splits as crossings at most, but for rounding.
///
/// # Errors
/// Those of vertex and tet creation.
pub fn split_at_all_crossings(mesh: &mut ConstrainedMesh, edge: EdgeKey) -> Result<Option<Vec<EdgeKey>>> {
    let mut most = ROUNDING_SHARE * crossed_places(mesh, edge).map_or(0, |places| places.len());
    let mut segments = Vec::new();
    let mut parts = vec![edge];
    while let Some(part) = parts.pop() {
        if most == 0 || mesh.has_edge(part[0], part[1]) {
            continue;
        }
        most -= 1;
        if let Some(steiner) = insert_at_crossing(mesh, part)? {
            let new = mesh.split_segment(part, steiner);
            parts.extend(&new[..2]);
            segments.extend(new);
        }
    }
    Ok((!segments.is_empty()).then_some(segments))
}

/// `hint` where it is alive, else a tet of the vertex.
fn hint_of(mesh: &ConstrainedMesh, hint: TetId, vertex: VertexId) -> TetId {
    if mesh.complex.is_live(hint) { hint } else { mesh.complex.tet_of(vertex) }
}

/// Splits a missing face whose edges are there; the new segments, or `None` where no point could be inserted.
///
/// # Errors
/// Those of vertex and tet creation.
pub fn split_missing_face(mesh: &mut ConstrainedMesh, face: FaceKey) -> Result<Option<Vec<EdgeKey>>> {
    let Some(crossing) = tets_across(mesh, face) else { return Ok(Some(Vec::new())) };
    let [a, b, c] = face.map(|v| mesh.at(v));
    let normal = (b - a).cross(c - a);
    let mut places: Vec<(f64, DVec3)> = Vec::new();
    for &[u, v] in &crossing.edges {
        let (pu, pv) = (mesh.at(u), mesh.at(v));
        let (du, dv) = (orient3d(a, b, c, pu), orient3d(a, b, c, pv));
        let place = pu + (pv - pu) * (du / (du - dv));
        let share = |x: DVec3, y: DVec3| (y - x).cross(place - x).dot(normal) / normal.length_squared();
        let depth = share(a, b).min(share(b, c)).min(share(c, a));
        if place.is_finite() && depth > 1e-3 {
            places.push((depth, place));
        }
    }
    places.sort_by(|l, r| r.0.total_cmp(&l.0));
    places.truncate(5);
    places.push((0.0, (a + b + c) / 3.0));
    for (_, place) in places {
        let hint = mesh.complex.tet_of(face[0]);
        if let Some(steiner) = insert_point(mesh, place, hint)? {
            return Ok(Some(mesh.split_subface(face, steiner)));
        }
    }
    Ok(None)
}

/// The finite tet whose closure contains the point; `None` outside.
pub fn locate(mesh: &ConstrainedMesh, point: DVec3, start: TetId) -> Option<TetId> {
    let mut tet = start;
    let mut seed = 12_345_u32;
    let mut came_from = TetFace::NONE;
    for _ in 0..1_000_000 {
        let v = mesh.complex.vertices(tet);
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let first = (seed >> 16) as usize;
        let mut exit = None;
        for i in 0..4 {
            let face = (first + i) % 4;
            let side = TetFace::new(tet, face);
            if mesh.complex.neighbor(side) == came_from && came_from != TetFace::NONE {
                continue;
            }
            let corners = TET_FACES[face].map(|i| v[i]);
            if corners.iter().any(|c| c.is_ghost()) {
                continue;
            }
            let [a, b, c] = corners.map(|c| mesh.at(c));
            if orient3d(a, b, c, point) > 0.0 {
                exit = Some(side);
                break;
            }
        }
        let Some(side) = exit else { return (!mesh.complex.is_ghost_tet(tet)).then_some(tet) };
        let other = mesh.complex.neighbor(side);
        if other == TetFace::NONE {
            return None;
        }
        came_from = side;
        tet = other.tet();
    }
    None
}

/// Inserts a point; its vertex, or `None` where no valid cavity was found (nothing has changed then).
///
/// # Errors
/// Those of vertex and tet creation.
pub fn insert_point(mesh: &mut ConstrainedMesh, point: DVec3, hint: TetId) -> Result<Option<VertexId>> {
    let Some(host) = locate(mesh, point, hint) else { return Ok(None) };
    if mesh.complex.points_of(host).contains(&point) {
        return Ok(None);
    }
    Ok(insert_with(mesh, point, vec![host])?.ok())
}

/// Inserts a point in a cavity that contains the tets `forced`; without a valid one nothing changes, and the tets that
/// were to go are returned.
///
/// # Errors
/// Those of vertex and tet creation.
pub fn insert_with(
    mesh: &mut ConstrainedMesh,
    point: DVec3,
    forced: Vec<TetId>,
) -> Result<std::result::Result<VertexId, Vec<TetId>>> {
    let mut marks = std::mem::take(&mut mesh.marks);
    let cavity = star_cavity(mesh, point, forced, &mut marks);
    mesh.marks = marks;
    let (cavity, front) = match cavity {
        Ok(found) => found,
        Err(tets) => return Ok(Err(tets)),
    };
    let count = mesh.complex.points().len();
    let vertex = mesh.complex.push_point(point)?;
    let new: Vec<[VertexId; 4]> = front.iter().map(|&[a, b, c]| [a, b, c, vertex]).collect();
    if !mesh.replace(&cavity, &new)? {
        mesh.complex.truncate_points(count);
        return Ok(Err(cavity));
    }
    Ok(Ok(vertex))
}

/// What is known of the tets while a cavity is sought: an entry counts for one insertion.
#[derive(Debug, Default)]
pub struct CavityMarks {
    /// The insertion, and below it the bits of what was computed in it.
    known: Vec<u64>,
    insertion: u64,
}

/// Bits of [`CavityMarks::known`]; for each of the four faces one of `SEEN` and one of `HIDDEN`.
const TESTED: u64 = 1;
const CONFLICT: u64 = 2;
const INSIDE: u64 = 4;
const SEEN: u64 = 8;
const HIDDEN: u64 = 128;
const BITS: u32 = 16;

impl CavityMarks {
    fn begin(&mut self, slots: usize) {
        self.insertion += 1;
        self.known.resize(slots, 0);
    }

    /// The entry of a tet in this insertion.
    fn known(&mut self, tet: TetId) -> &mut u64 {
        let entry = &mut self.known[tet.index()];
        if *entry >> BITS != self.insertion {
            *entry = self.insertion << BITS;
        }
        entry
    }

    fn is_inside(&self, tet: TetId) -> bool {
        let entry = self.known[tet.index()];
        entry >> BITS == self.insertion && entry & INSIDE != 0
    }

    /// Whether the circumsphere of the tet contains the point.
    fn conflicts(&mut self, mesh: &ConstrainedMesh, tet: TetId, point: DVec3) -> bool {
        let known = self.known(tet);
        if *known & TESTED == 0 {
            let [a, b, c, d] = mesh.complex.points_of(tet);
            *known |= if insphere(a, b, c, d, point) > 0.0 { TESTED | CONFLICT } else { TESTED };
        }
        *known & CONFLICT != 0
    }

    /// Whether the point does not lie strictly inside of a face of the tet.
    fn hides(&mut self, mesh: &ConstrainedMesh, side: TetFace, point: DVec3) -> bool {
        let known = self.known(side.tet());
        let [seen, hidden] = [SEEN, HIDDEN].map(|bit| bit << side.face());
        if *known & (seen | hidden) == 0 {
            let [a, b, c] = mesh.complex.face_vertices(side).map(|v| mesh.at(v));
            *known |= if orient3d(a, b, c, point) >= 0.0 { hidden } else { seen };
        }
        *known & hidden != 0
    }
}

/// Tets, and the faces around them as seen from inside.
type Cavity = (Vec<TetId>, Vec<[VertexId; 3]>);

/// A set of tets around the point that it sees from inside, and that swallows no constraint; else the tets that had to be in
/// it, with those that would have joined.
fn star_cavity(
    mesh: &ConstrainedMesh,
    point: DVec3,
    forced: Vec<TetId>,
    marks: &mut CavityMarks,
) -> std::result::Result<Cavity, Vec<TetId>> {
    marks.begin(mesh.complex.slot_count());
    let mut cavity = forced;
    cavity.iter().for_each(|&tet| *marks.known(tet) |= INSIDE);
    // What the tets that have to be there hide has to go as well.
    let mut added = 0;
    let is_whole = grow(mesh, &mut cavity, marks, |side, other, marks| {
        let is_inside = other != TetFace::NONE && marks.is_inside(other.tet());
        if is_inside || !marks.hides(mesh, side, point) {
            return Some(false);
        }
        let closed = other == TetFace::NONE || mesh.is_subface(side) || mesh.complex.is_ghost_tet(other.tet());
        added += 1;
        (!closed && added <= MOST_FORCED + 1).then_some(true)
    });
    if !is_whole {
        return Err(conflict_region(mesh, point, cavity, marks));
    }
    if !mesh.shape_of(&cavity).segments.is_empty() {
        return Err(conflict_region(mesh, point, cavity, marks));
    }
    // A tet that was refused is looked at again when another one beside it joins.
    grow(mesh, &mut cavity, marks, |_, other, marks| {
        Some(other != TetFace::NONE && may_join(mesh, point, other.tet(), marks))
    });
    let front = mesh.shape_of(&cavity).front;
    Ok((cavity, front))
}

/// Adds tets beside the cavity, told by a face of it and what is behind, as long as some join; false where `joins` gives up.
fn grow(
    mesh: &ConstrainedMesh,
    cavity: &mut Vec<TetId>,
    marks: &mut CavityMarks,
    mut joins: impl FnMut(TetFace, TetFace, &mut CavityMarks) -> Option<bool>,
) -> bool {
    let mut next = 0;
    while next < cavity.len() {
        let tet = cavity[next];
        next += 1;
        for side in (0..4).map(|face| TetFace::new(tet, face)) {
            let other = mesh.complex.neighbor(side);
            match joins(side, other, marks) {
                Some(true) => {
                    *marks.known(other.tet()) |= INSIDE;
                    cavity.push(other.tet());
                }
                Some(false) => {}
                None => return false,
            }
        }
    }
    true
}

/// Whether the circumsphere of a tet beside the cavity contains the point, which then sees all the cavity's border still, and
/// no constraint is swallowed.
fn may_join(mesh: &ConstrainedMesh, point: DVec3, tet: TetId, marks: &mut CavityMarks) -> bool {
    if marks.is_inside(tet) || mesh.complex.is_ghost_tet(tet) || !marks.conflicts(mesh, tet, point) {
        return false;
    }
    let mut inside = [false; 4];
    for side in (0..4).map(|face| TetFace::new(tet, face)) {
        let other = mesh.complex.neighbor(side);
        inside[side.face()] = other != TetFace::NONE && marks.is_inside(other.tet());
        let fits = if inside[side.face()] { !mesh.is_subface(side) } else { !marks.hides(mesh, side, point) };
        if !fits {
            return false;
        }
    }
    // A segment is swallowed with the last tet around it, which has others on both sides then.
    let row = mesh.complex.vertices(tet);
    !TET_EDGES.iter().any(|&[i, j]| {
        (0..4).all(|face| face == i || face == j || inside[face])
            && mesh.is_segment(row[i], row[j])
            && all_inside(mesh, ShellTet::new(tet, i, j), marks)
    })
}

/// Whether all tets around an edge but the first one are in the cavity.
fn all_inside(mesh: &ConstrainedMesh, first: ShellTet, marks: &CavityMarks) -> bool {
    let mut current = first;
    while let Some(next) = current.next(&mesh.complex) {
        if next.tet == first.tet {
            return true;
        }
        if !marks.is_inside(next.tet) {
            return false;
        }
        current = next;
    }
    false
}

/// The tets reachable from a cavity whose circumsphere contains the point.
fn conflict_region(
    mesh: &ConstrainedMesh,
    point: DVec3,
    mut cavity: Vec<TetId>,
    marks: &mut CavityMarks,
) -> Vec<TetId> {
    grow(mesh, &mut cavity, marks, |side, other, marks| {
        let open = other != TetFace::NONE
            && !mesh.is_subface(side)
            && !marks.is_inside(other.tet())
            && !mesh.complex.is_ghost_tet(other.tet());
        Some(open && marks.conflicts(mesh, other.tet(), point))
    });
    cavity
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::test_meshes::enclosed_mesh;
    use crate::conforming::test_surfaces::{chazelle, strips, twisted_prism};

    #[test]
    fn a_segment_split_at_all_crossings_is_there() {
        // Two crossings may be one by rounding: then no point goes between them.
        let (mut whole, mut torn, mut splits) = (0, 0, 0);
        for surface in [twisted_prism(5, 20.0, 3), twisted_prism(3, 25.0, 1), chazelle(3, 0.1), strips(12, 50.0)] {
            let mut mesh = ConstrainedMesh::new(enclosed_mesh(&surface.points), &surface.facets);
            for edge in mesh.missing_segments() {
                let crossings = crossed_places(&mesh, edge).unwrap().len();
                let before = mesh.splits.len();
                let Some(segments) = split_at_all_crossings(&mut mesh, edge).unwrap() else { continue };
                // The other segments that come with a split may be missing.
                let mut on_edge = edge.to_vec();
                on_edge.extend(mesh.splits[before..].iter().map(|(steiner, _)| *steiner));
                let mut parts: Vec<EdgeKey> = segments;
                parts.retain(|s| mesh.wings.contains_key(s) && s.iter().all(|v| on_edge.contains(v)));
                let is_whole = parts.iter().all(|part| mesh.has_edge(part[0], part[1]));
                let count = if is_whole { &mut whole } else { &mut torn };
                *count += 1;
                assert!(!mesh.is_segment(edge[0], edge[1]) && on_edge.len() - 2 <= ROUNDING_SHARE * crossings);
                splits += on_edge.len() - 2;
            }
            mesh.complex.check_invariants().unwrap();
            assert!(mesh.complex.finite_tets().all(|tet| mesh.complex.is_positive(tet)));
        }
        assert!(splits > whole && whole > 20 * torn, "{splits} {whole} {torn}");
    }
}
