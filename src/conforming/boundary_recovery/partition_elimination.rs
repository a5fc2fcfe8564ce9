//! Takes Steiner points off the surface: the parts of edges and facets become whole again.
//!
//! # Method
//! The splits are undone in reverse order. The ball of a Steiner point s is cut by the subfaces at s into sectors:
//! ```text
//!         link                    link             two sectors, above and below the facets a b c and a b d; in each
//!       /      \                /      \           the subfaces (c s a, c s b, ...) are replaced by the whole faces,
//!     a----s----b    ->       a---------b          and the sector is filled on its own vertices, or else joined to a
//!       \      /                \  s'  /           new point s' that sees its whole boundary, inside the volume.
//!         link                    link
//! ```
//! Where neither works, s is moved along what it splits, the ball is thinned by removing edges at s, then the link of flat
//! sectors by removing edges of it, and all is tried again. Such a point exists close to s in every sector of less than
//! a full turn: s sees the link strictly, and the half spaces of the whole faces share directions.
//!
//! In floating point s lies beside its edge by rounding. In a plane of long thin facets an edge of the mesh may then pass
//! between s and the edge: the sector is flat there, and no number lies between its faces. Tets beyond join such a
//! sector until a place above the whole faces sees all of the border (`grown_sector`), close above where edges of the link
//! cross the facets, and in front of the walls that hid other places (`place_among_walls`). What still stands in the way
//! are points of the volume in the plane of the facets: these are moved off it (`undo_after_centering`).
//!
//! # Source
//! [Drakopoulos2017] 4.6.2, [GeorgeBorouchaki2003]; filling a sector without a point first: ours.
//!
//! # Cost
//! Every split is tried a fixed number of times per effort, and passes go on only while they undo one: it always ends.
//!
//! # Limits
//! The free border of a sheet has a full turn around it: a Steiner point there goes only where the ball can be filled.

use glam::DVec3;
use rustc_hash::{FxHashMap, FxHashSet};

use super::Effort;
use super::constrained_mesh::{ConstrainedMesh, EdgeKey, FaceKey, Split, edge_key, edges_of_face, face_key};
use super::edge_removal::{Journal, remove_edge};
use super::steiner_removal::{center, thin_ball};
use super::volume_points::closest_points;
use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::predicates::orient3d;
use crate::geometry::segment::squared_distance;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::{TET_EDGES, TET_FACES};
use crate::mesh::tet_store::TetStore;

/// Steps of the search for a filling of a sector.
const FILL_STEPS: usize = 1500;

/// Places tried for a point in a sector that grows, each half as far as the one before.
const GROWTH_PLACES: i32 = 50;

/// Most tets that join a sector.
const MOST_GROWN: usize = 60;

/// Shares of the way to a corner of a whole face at which places above it are tried.
const ASIDE: [f64; 5] = [0.1, 0.3, 0.5, 0.7, 0.9];

/// Most tets of a sector whose link is loosened.
const MOST_FLAT: usize = 6;

/// Edges of a link above which places are tried.
const MOST_CROSSING: usize = 4;

/// Constraints that a place above a flat sector is moved in front of.
const MOST_WALLS: usize = 12;

/// Places tried on a split segment.
const SLIDE_PLACES: usize = 50;

/// Undoes every split that can be undone; new points in the volume are appended to `volume`. Returns the number left.
///
/// # Errors
/// `Cancelled`, `LimitReached`, and those of tet creation.
pub fn eliminate_partitions(
    mesh: &mut ConstrainedMesh,
    volume: &mut Vec<VertexId>,
    effort: &Effort,
    context: &RunContext,
) -> Result<usize> {
    loop {
        let before = mesh.splits.len();
        let mut kept = Vec::new();
        while let Some((steiner, split)) = mesh.splits.pop() {
            context.check()?;
            if undo(mesh, steiner, &split, volume)? {
                continue;
            }
            // A better place on the surface, then a smaller ball: both make the kernel larger.
            slide(mesh, steiner, &split);
            if undo(mesh, steiner, &split, volume)? {
                continue;
            }
            thin_ball(mesh, steiner, effort)?;
            slide(mesh, steiner, &split);
            let undone = undo(mesh, steiner, &split, volume)?
                || undo_after_loosening(mesh, steiner, &split, effort, volume)?
                || (effort.grow && undo_after_centering(mesh, steiner, &split, volume)?);
            if !undone {
                kept.push((steiner, split));
            }
        }
        kept.reverse();
        mesh.splits = kept;
        if mesh.splits.is_empty() || mesh.splits.len() == before {
            return Ok(mesh.splits.len());
        }
    }
}

/// Removes edges of the link of sectors that are too flat, one after the other, until the split can be undone. Rounding
/// may put the Steiner point on the other side of an edge of the mesh that crosses the facets' plane next to it: that
/// edge stands in the way of the whole facets.
fn undo_after_loosening(
    mesh: &mut ConstrainedMesh,
    steiner: VertexId,
    split: &Split,
    effort: &Effort,
    volume: &mut Vec<VertexId>,
) -> Result<bool> {
    let whole = whole_faces(steiner, split);
    let ball = mesh.ball(steiner);
    let Some(sectors) = sectors_of(mesh, steiner, &ball, &whole) else { return Ok(false) };
    let mut tries = effort.tries;
    for sector in sectors.iter().filter(|sector| sector.tets.len() <= MOST_FLAT) {
        let edges: FxHashSet<EdgeKey> = sector
            .link
            .iter()
            .flat_map(|(_, [a, b, c])| [edge_key(*a, *b), edge_key(*b, *c), edge_key(*a, *c)])
            .collect();
        let mut edges: Vec<EdgeKey> = edges.into_iter().filter(|e| !mesh.is_segment(e[0], e[1])).collect();
        edges.sort_unstable();
        for edge in edges {
            let removed =
                remove_edge(mesh, (edge, TetId::NONE), effort.reach(None), &mut tries, &mut Journal::default())?;
            if removed && undo(mesh, steiner, split, volume)? {
                return Ok(true);
            }
        }
    }
    Ok(false)
}

/// Moves points of the volume that lie in a facet's plane by rounding to the depth of their balls, and undoes the split
/// then if that is possible.
fn undo_after_centering(
    mesh: &mut ConstrainedMesh,
    steiner: VertexId,
    split: &Split,
    volume: &mut Vec<VertexId>,
) -> Result<bool> {
    let whole = whole_faces(steiner, split);
    let ball = mesh.ball(steiner);
    let Some(sectors) = sectors_of(mesh, steiner, &ball, &whole) else { return Ok(false) };
    for vertex in sectors.iter().flat_map(|sector| sector.front.iter().flatten().copied()) {
        if volume.contains(&vertex) {
            center(mesh, vertex);
        }
    }
    undo(mesh, steiner, split, volume)
}

/// The edges of the link of a sector that are neither constraints nor edges of its whole faces, those that pass nearest
/// to an edge of these or to the Steiner point first.
fn crossing_edges(mesh: &ConstrainedMesh, place: DVec3, sector: &Sector) -> Vec<EdgeKey> {
    let edges_of = |faces: &mut dyn Iterator<Item = [VertexId; 3]>| -> Vec<EdgeKey> {
        let mut edges: Vec<EdgeKey> =
            faces.flat_map(|[a, b, c]| [edge_key(a, b), edge_key(b, c), edge_key(a, c)]).collect();
        edges.sort_unstable();
        edges.dedup();
        edges
    };
    let closing = edges_of(&mut sector.closing.iter().copied());
    let distance = |edge: &EdgeKey| {
        let ends = edge.map(|v| mesh.at(v));
        let others = closing.iter().filter(|other| other.iter().all(|v| !edge.contains(v)));
        let ways = others.map(|other| {
            let [p, q] = closest_points(ends, other.map(|v| mesh.at(v)));
            p.distance_squared(q)
        });
        ways.fold(squared_distance(place, ends[0], ends[1]), f64::min)
    };
    let link = edges_of(&mut sector.link.iter().map(|(_, face)| *face));
    let free = link.into_iter().filter(|e| !mesh.is_segment(e[0], e[1]) && !closing.contains(e));
    let mut edges: Vec<(f64, EdgeKey)> = free.map(|edge| (distance(&edge), edge)).collect();
    edges.sort_by(|l, r| l.0.total_cmp(&r.0).then(l.1.cmp(&r.1)));
    edges.into_iter().map(|(_, edge)| edge).collect()
}

/// The subfaces a split made, each with the whole face it is part of and the facet.
fn parts_of(steiner: VertexId, split: &Split) -> Vec<(FaceKey, [VertexId; 3], u32)> {
    match split {
        Split::Edge([a, b], thirds) => thirds
            .iter()
            .flat_map(|&(c, facet)| [*a, *b].map(|end| (face_key([end, steiner, c]), [*a, *b, c], facet)))
            .collect(),
        Split::Face(face, facet) => {
            let [a, b, c] = *face;
            [[a, b], [b, c], [a, c]].map(|[u, v]| (face_key([u, v, steiner]), *face, *facet)).to_vec()
        }
    }
}

/// For each subface a split made the whole face it is part of.
fn whole_faces(steiner: VertexId, split: &Split) -> FxHashMap<FaceKey, [VertexId; 3]> {
    parts_of(steiner, split).iter().map(|&(key, face, _)| (key, face)).collect()
}

fn undo(mesh: &mut ConstrainedMesh, steiner: VertexId, split: &Split, volume: &mut Vec<VertexId>) -> Result<bool> {
    let whole = whole_faces(steiner, split);
    let ball = mesh.ball(steiner);
    let count = mesh.complex.points().len();
    let Some(sectors) = sectors_of(mesh, steiner, &ball, &whole) else { return Ok(false) };
    let mut old = ball;
    let mut new: Vec<[VertexId; 4]> = Vec::new();
    let mut added = Vec::new();
    for sector in sectors {
        if let Some(filled) = mesh.fill(&sector.front, &[], FILL_STEPS, &mut { 2 * FILL_STEPS }) {
            new.extend(filled);
            continue;
        }
        let faces: Vec<[DVec3; 3]> = sector.front.iter().map(|f| f.map(|v| mesh.at(v))).collect();
        let room = match kernel_point(&faces, mesh.at(steiner), sector.inward) {
            Some(place) => Some((place, sector.front)),
            None => grown_sector(mesh, steiner, &sector, &mut old, volume),
        };
        let Some((place, front)) = room else {
            mesh.complex.truncate_points(count);
            return Ok(false);
        };
        let vertex = mesh.complex.push_point(place)?;
        added.push(vertex);
        new.extend(front.iter().map(|&[a, b, c]| [a, b, c, vertex]));
    }
    let lost = lost_vertices(mesh, &old, &new);
    if !mesh.replace(&old, &new)? {
        mesh.complex.truncate_points(count);
        return Ok(false);
    }
    for vertex in lost {
        mesh.complex.set_tet_of(vertex, TetId::NONE);
        volume.retain(|&v| v != vertex);
    }
    mesh.complex.set_tet_of(steiner, TetId::NONE);
    volume.extend(added);
    withdraw(mesh, steiner, split);
    Ok(true)
}

/// Makes the whole faces of a split constraints again instead of its parts; the edges of the whole faces.
pub fn withdraw(mesh: &mut ConstrainedMesh, steiner: VertexId, split: &Split) -> Vec<EdgeKey> {
    let parts = parts_of(steiner, split);
    for (part, _, _) in &parts {
        mesh.remove_subface(*part);
    }
    let mut edges = Vec::new();
    for (_, face, facet) in parts {
        let key = face_key(face);
        if !mesh.subfaces.contains_key(&key) {
            mesh.add_subface(key, facet);
        }
        edges.extend(edges_of_face(key).map(|(edge, _)| edge));
    }
    edges
}

/// The vertices of `old` that no tet of `new` has: their balls lie in `old`.
fn lost_vertices(mesh: &ConstrainedMesh, old: &[TetId], new: &[[VertexId; 4]]) -> Vec<VertexId> {
    let kept: FxHashSet<VertexId> = new.iter().flatten().copied().collect();
    let mut lost: Vec<VertexId> = old.iter().flat_map(|&tet| mesh.complex.vertices(tet)).collect();
    lost.retain(|v| !kept.contains(v));
    lost.sort_unstable();
    lost.dedup();
    lost
}

/// A place inside of a sector too flat for one, with the tets beyond the link faces that it would not see: they join
/// `old`. Rounding puts a point on an edge of the mesh next to it: then a sector between two facets of one plane is
/// flat, and that edge has to go as well.
fn grown_sector(
    mesh: &ConstrainedMesh,
    steiner: VertexId,
    sector: &Sector,
    old: &mut Vec<TetId>,
    volume: &[VertexId],
) -> Option<(DVec3, Vec<[VertexId; 3]>)> {
    let start = mesh.at(steiner);
    let direction = sector.inward.normalize_or_zero();
    let corners = sector.front.iter().flatten().map(|&v| mesh.at(v));
    let size = corners.map(|p| p.distance(start)).fold(0.0, f64::max);
    // Far steps first: a place far from the surface leaves better tets. Another facet may hide what lies around the
    // Steiner point from all places above it; places above the rest of the whole faces come then.
    let corners: FxHashSet<VertexId> = sector.closing.iter().flatten().copied().collect();
    let mut corners: Vec<VertexId> = corners.into_iter().collect();
    corners.sort_unstable();
    let aside = corners.iter().flat_map(|&v| ASIDE.map(|share| (mesh.at(v) - start) * share));
    // A place close above such an edge sees all around it.
    let above = feet_on_crossing_edges(mesh, start, sector).into_iter().map(|foot| foot - start);
    let feet = std::iter::once(DVec3::ZERO).chain(aside).chain(above);
    let places =
        feet.flat_map(|foot| (1..GROWTH_PLACES).map(move |i| start + foot + direction * (size * 0.5_f64.powi(i))));
    let grown = |place: DVec3| {
        let (tets, front) = grow_to(mesh, place, sector, old)?;
        // Points of the volume may go with their balls, others not.
        let kept: FxHashSet<VertexId> = front.iter().flatten().copied().collect();
        let mut corners = tets.iter().flat_map(|&tet| mesh.complex.vertices(tet));
        let loses = corners.any(|v| v != steiner && !kept.contains(&v) && !volume.contains(&v));
        if loses { Err(None) } else { Ok((place, tets, front)) }
    };
    let found = { places }.find_map(|place| grown(place).ok());
    let found = found.or_else(|| {
        (1..GROWTH_PLACES).find_map(|i| place_among_walls(mesh, sector, (start, size * 0.5_f64.powi(i)), grown))
    });
    let (place, tets, front) = found?;
    old.extend(tets);
    Some((place, front))
}

/// A place, the tets that join a sector for it, and the border it sees.
type Grown = (DVec3, Vec<TetId>, Vec<[VertexId; 3]>);

/// A place below a height that sees the whole faces and every constraint that stood in the way of the places before it.
fn place_among_walls(
    mesh: &ConstrainedMesh,
    sector: &Sector,
    (start, height): (DVec3, f64),
    grown: impl Fn(DVec3) -> std::result::Result<Grown, Option<[VertexId; 3]>>,
) -> Option<Grown> {
    let direction = sector.inward.normalize_or_zero();
    let (across, along) = direction.any_orthonormal_pair();
    let top = start + direction * height;
    // Turned so that what lies below the ceiling sees it.
    let mut wanted = vec![[top, top + along, top + across]];
    wanted.extend(sector.closing.iter().map(|f| f.map(|v| mesh.at(v))));
    for _ in 0..MOST_WALLS {
        let place = kernel_point(&wanted, start + direction * (0.5 * height), direction)?;
        match grown(place) {
            Ok(found) => return Some(found),
            Err(wall) => wanted.push(wall?.map(|v| mesh.at(v))),
        }
    }
    None
}

/// Where edges of the link of a sector pass edges of its whole faces.
fn feet_on_crossing_edges(mesh: &ConstrainedMesh, place: DVec3, sector: &Sector) -> Vec<DVec3> {
    let mut feet = Vec::new();
    for edge in crossing_edges(mesh, place, sector).into_iter().take(MOST_CROSSING) {
        let ends = edge.map(|v| mesh.at(v));
        for &[a, b, c] in &sector.closing {
            for other in [[a, b], [b, c], [c, a]] {
                if other.iter().all(|v| !edge.contains(v)) {
                    feet.push(closest_points(ends, other.map(|v| mesh.at(v)))[0]);
                }
            }
        }
    }
    feet
}

/// The tets that join a sector so that the place sees its whole border, and that border; else the constraint that it does
/// not see, if that is what stands in the way.
fn grow_to(
    mesh: &ConstrainedMesh,
    place: DVec3,
    sector: &Sector,
    old: &[TetId],
) -> std::result::Result<(Vec<TetId>, Vec<[VertexId; 3]>), Option<[VertexId; 3]>> {
    let sees = |f: &[VertexId; 3]| {
        let [a, b, c] = f.map(|v| mesh.at(v));
        orient3d(a, b, c, place) > 0.0
    };
    if !sector.closing.iter().all(sees) {
        return Err(None);
    }
    // Sides of tets outside, as seen from there; faces of the border by their keys.
    let mut border = sector.link.clone();
    let mut tets: Vec<TetId> = Vec::new();
    let mut checked = 0;
    while checked < border.len() {
        let (side, face) = border[checked];
        if sees(&face) {
            checked += 1;
            continue;
        }
        let tet = side.tet();
        let free = side != TetFace::NONE && !mesh.is_subface(side) && !mesh.complex.is_ghost_tet(tet);
        if !free || tets.len() == MOST_GROWN || old.contains(&tet) || tets.contains(&tet) {
            return Err((side != TetFace::NONE && mesh.is_subface(side)).then_some(face));
        }
        tets.push(tet);
        border.retain(|(s, _)| s.tet() != tet);
        let v = mesh.complex.vertices(tet);
        for face in 0..4 {
            let inner = TetFace::new(tet, face);
            let [a, b, c] = TET_FACES[face].map(|i| v[i]);
            let other = mesh.complex.neighbor(inner);
            let joined = other != TetFace::NONE && (tets.contains(&other.tet()) || sector.tets.contains(&other.tet()));
            if !joined {
                border.push((other, [a, c, b]));
            }
        }
        checked = 0;
    }
    let mut front: Vec<[VertexId; 3]> = border.iter().map(|(_, face)| *face).collect();
    let edges = |faces: &[[VertexId; 3]]| -> FxHashSet<EdgeKey> {
        faces.iter().flat_map(|&[a, b, c]| [edge_key(a, b), edge_key(b, c), edge_key(a, c)]).collect()
    };
    front.extend(&sector.closing);
    let left = edges(&front);
    let lost = tets.iter().flat_map(|&tet| {
        let v = mesh.complex.vertices(tet);
        TET_EDGES.map(|[i, j]| edge_key(v[i], v[j]))
    });
    let swallows = lost.into_iter().any(|e| mesh.is_segment(e[0], e[1]) && !left.contains(&e));
    if swallows { Err(None) } else { Ok((tets, front)) }
}

/// Moves the Steiner point along the segment or on the face it splits, to where its link is farthest.
fn slide(mesh: &mut ConstrainedMesh, steiner: VertexId, split: &Split) {
    let front = mesh.shape_of(&mesh.ball(steiner)).front;
    if front.iter().flatten().any(|v| v.is_ghost()) {
        return;
    }
    let faces: Vec<[DVec3; 3]> = front.iter().map(|f| f.map(|v| mesh.at(v))).collect();
    let planes: Vec<(DVec3, DVec3)> =
        faces.iter().map(|&[a, b, c]| ((b - a).cross(c - a).normalize_or_zero(), a)).collect();
    let depth = |x: DVec3| planes.iter().map(|(n, p)| n.dot(x - *p)).fold(f64::INFINITY, f64::min);
    let old = mesh.at(steiner);
    let places: Vec<DVec3> = match split {
        Split::Edge([a, b], _) => {
            (1..SLIDE_PLACES).map(|i| mesh.at(*a).lerp(mesh.at(*b), i as f64 / SLIDE_PLACES as f64)).collect()
        }
        Split::Face(face, _) => {
            let corners = face.map(|v| mesh.at(v));
            let toward = corners.iter().flat_map(|c| (1..10).map(move |i| old.lerp(*c, f64::from(i) / 20.0)));
            toward.chain([corners.iter().sum::<DVec3>() / 3.0]).collect()
        }
    };
    let sees = |x: DVec3| faces.iter().all(|&[a, b, c]| orient3d(a, b, c, x) > 0.0);
    let better = places.into_iter().map(|x| (depth(x), x)).filter(|(value, x)| *value > depth(old) && sees(*x));
    if let Some((_, place)) = better.max_by(|l, r| l.0.total_cmp(&r.0)) {
        mesh.complex.set_point(steiner, place);
    }
}

/// One part of a ball, bounded by link faces and whole faces.
struct Sector {
    front: Vec<[VertexId; 3]>,
    /// Sum of the inward unit normals of the whole faces.
    inward: DVec3,
    /// Its tets.
    tets: Vec<TetId>,
    /// The link faces of `front`, each with the side beyond.
    link: Vec<(TetFace, [VertexId; 3])>,
    /// The whole faces of `front`.
    closing: Vec<[VertexId; 3]>,
}

/// The sectors of the ball of `steiner`; `None` where other subfaces than those of the split meet there.
fn sectors_of(
    mesh: &ConstrainedMesh,
    steiner: VertexId,
    ball: &[TetId],
    whole: &FxHashMap<FaceKey, [VertexId; 3]>,
) -> Option<Vec<Sector>> {
    let mut seen: FxHashSet<TetId> = FxHashSet::default();
    let mut sectors = Vec::new();
    let mut parts_met: FxHashSet<FaceKey> = FxHashSet::default();
    for &seed in ball {
        if mesh.complex.is_ghost_tet(seed) {
            return None;
        }
        if !seen.insert(seed) {
            continue;
        }
        let mut front: Vec<[VertexId; 3]> = Vec::new();
        let mut link: Vec<(TetFace, [VertexId; 3])> = Vec::new();
        let mut tets: Vec<TetId> = Vec::new();
        let mut closing: Vec<[VertexId; 3]> = Vec::new();
        let mut stack = vec![seed];
        while let Some(tet) = stack.pop() {
            tets.push(tet);
            let v = mesh.complex.vertices(tet);
            for face in 0..4 {
                let side = TetFace::new(tet, face);
                let [a, b, c] = TET_FACES[face].map(|i| v[i]);
                if v[face] == steiner {
                    front.push([a, c, b]);
                    link.push((mesh.complex.neighbor(side), [a, c, b]));
                } else if mesh.is_subface(side) {
                    let key = face_key([a, b, c]);
                    let corners = whole.get(&key)?;
                    parts_met.insert(key);
                    // The corner of the whole face that this part lacks takes the place of the Steiner point.
                    let missing = *corners.iter().find(|v| !key.contains(v))?;
                    let face = [a, c, b].map(|v| if v == steiner { missing } else { v });
                    if !closing.iter().any(|f| face_key(*f) == face_key(face)) {
                        closing.push(face);
                    }
                } else {
                    let other = mesh.complex.neighbor(side);
                    if other != TetFace::NONE && seen.insert(other.tet()) {
                        stack.push(other.tet());
                    }
                }
            }
        }
        let normal = |f: &[VertexId; 3]| {
            let [a, b, c] = f.map(|v| mesh.at(v));
            (b - a).cross(c - a).normalize_or_zero()
        };
        let inward = closing.iter().map(normal).sum();
        let mut kept = Vec::new();
        for face in closing {
            match front.iter().position(|f| face_key(*f) == face_key(face)) {
                Some(position) => {
                    front.swap_remove(position);
                    link.retain(|(_, f)| face_key(*f) != face_key(face));
                }
                None => {
                    front.push(face);
                    kept.push(face);
                }
            }
        }
        sectors.push(Sector { front, inward, tets, link, closing: kept });
    }
    (parts_met.len() == whole.len()).then_some(sectors)
}

/// A point that every face sees on its positive side, as far from all of them as a local search finds; near `start`.
pub fn kernel_point(faces: &[[DVec3; 3]], start: DVec3, direction: DVec3) -> Option<DVec3> {
    let planes: Vec<(DVec3, DVec3)> =
        faces.iter().map(|&[a, b, c]| ((b - a).cross(c - a).normalize_or_zero(), a)).collect();
    let depth = |x: DVec3| planes.iter().map(|(n, p)| n.dot(x - *p)).fold(f64::INFINITY, f64::min);
    let sees = |x: DVec3| faces.iter().all(|&[a, b, c]| orient3d(a, b, c, x) > 0.0);
    let size = faces.iter().flatten().map(|p| p.distance(start)).fold(0.0, f64::max);
    let direction = direction.normalize_or_zero();
    let middle = faces.iter().flatten().copied().sum::<DVec3>() / (3 * faces.len()) as f64;
    let mut candidates = vec![start, middle];
    for i in 0..50 {
        let step = size * 0.5_f64.powi(i);
        candidates.push(start + direction * step);
        candidates.push(start + (middle - start) * 0.5_f64.powi(i));
    }
    let mut ranked: Vec<(f64, DVec3)> = candidates.into_iter().map(|x| (depth(x), x)).collect();
    ranked.sort_by(|l, r| r.0.total_cmp(&l.0));
    // The deepest that sees everything, else the deepest: exact tests end with the first.
    let seeing = ranked.iter().find(|(_, x)| sees(*x)).map(|&(depth, x)| (true, depth, x));
    let mut best = seeing.or_else(|| ranked.first().map(|&(depth, x)| (false, depth, x)))?;
    // Climb the smallest distance: along the normals of the nearest planes, then along the axes.
    let mut step = size * 0.25;
    let mut rounds = 0;
    while step > size * 1e-13 && rounds < 400 {
        rounds += 1;
        let near = planes.iter().map(|(n, p)| (n.dot(best.2 - *p), *n));
        let mut order: Vec<(f64, DVec3)> = near.collect();
        order.sort_by(|l, r| l.0.total_cmp(&r.0));
        let pushes = (1..=4.min(order.len())).map(|k| order[..k].iter().map(|(_, n)| *n).sum::<DVec3>());
        let mut moves: Vec<DVec3> = pushes.map(|d| d.normalize_or_zero()).collect();
        moves.extend([DVec3::X, DVec3::Y, DVec3::Z].iter().flat_map(|&d| [d, -d]));
        let better = moves
            .into_iter()
            .map(|d| best.2 + d * step)
            .map(|x| (depth(x), x))
            .filter(|(value, _)| *value > best.1)
            .max_by(|l, r| l.0.total_cmp(&r.0));
        match better {
            Some((value, x)) if !best.0 || sees(x) => best = (best.0 || sees(x), value, x),
            _ => step *= 0.5,
        }
    }
    (best.0 || sees(best.2)).then_some(best.2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::delaunay_kernel::{DelaunayOptions, PointOrder, tetrahedralize};
    use crate::context::RunContext;

    #[test]
    fn a_place_above_a_flat_sector_goes_in_front_of_walls() {
        let mut points = vec![DVec3::ZERO, DVec3::X, DVec3::Y];
        points.extend([DVec3::X, DVec3::X + DVec3::Y, DVec3::X + DVec3::Z].map(|p| p * 0.3 + DVec3::Z * 1e-3));
        points.extend([-1.0, 1.0].map(|z| DVec3::new(0.3, 0.2, z)));
        let context = RunContext::with_threads(1).unwrap();
        let options = DelaunayOptions { order: PointOrder::Input, ..Default::default() };
        let complex = tetrahedralize(&points, &options, &context).unwrap().complex;
        let mesh = ConstrainedMesh::new(complex, &[]);
        let (whole, wall) = ([0, 1, 2].map(VertexId), [3, 4, 5].map(VertexId));
        let sector = Sector { front: vec![], inward: DVec3::Z, tets: vec![], link: vec![], closing: vec![whole] };
        let sees = |f: [VertexId; 3], x: DVec3| orient3d(mesh.at(f[0]), mesh.at(f[1]), mesh.at(f[2]), x) > 0.0;
        let start = DVec3::new(0.1, 0.1, 0.0);
        for height in [1.0, 1e-3, 1e-9] {
            let grown = |x: DVec3| if sees(wall, x) { Ok((x, vec![], vec![])) } else { Err(Some(wall)) };
            let (place, ..) = place_among_walls(&mesh, &sector, (start, height), grown).unwrap();
            assert!(sees(whole, place) && place.x > 0.3 && place.z < height, "{height}: {place}");
            // A wall that hides all places, or an obstacle that is none.
            assert!(
                place_among_walls(&mesh, &sector, (start, height), |_| Err(Some([2, 1, 0].map(VertexId)))).is_none()
            );
            assert!(place_among_walls(&mesh, &sector, (start, height), |_| Err(None)).is_none());
        }
    }

    #[test]
    fn a_split_is_undone_once_points_of_the_volume_left_the_plane() {
        use crate::conforming::boundary_recovery::EdgeOrder;
        use crate::conforming::boundary_recovery::steiner_points::insert_point;
        use crate::conforming::test_meshes::enclosed_mesh;
        use crate::conforming::test_surfaces::cube;

        let surface = cube(2);
        let context = RunContext::with_threads(1).unwrap();
        let complex = enclosed_mesh(&surface.points);
        let (options, mut report) = Default::default();
        let facets = &surface.facets;
        let mut mesh =
            super::super::recover(complex, facets, (&options, EdgeOrder::Ascending), &context, &mut report).unwrap();
        assert!(mesh.splits.is_empty());
        // The diagonal of a facet of the bottom is split, with a point of the volume hardly above it.
        let is_diagonal = |e: &EdgeKey| {
            let [a, b] = e.map(|v| surface.points[v.index()]);
            a.z == 0.0 && b.z == 0.0 && a.x != b.x && a.y != b.y
        };
        let mut edges: Vec<EdgeKey> = mesh.wings.keys().copied().filter(is_diagonal).collect();
        edges.sort_unstable();
        let edge = edges[0];
        let middle = 0.5 * (mesh.at(edge[0]) + mesh.at(edge[1]));
        let steiner = mesh.complex.push_point(middle).unwrap();
        let mut shell = mesh.ball(edge[0]);
        shell.retain(|&tet| mesh.complex.local_vertex(tet, edge[1]).is_some());
        let front = mesh.shape_of(&shell).front;
        let new: Vec<[VertexId; 4]> = front.iter().map(|&[a, b, c]| [a, b, c, steiner]).collect();
        assert!(mesh.replace(&shell, &new).unwrap());
        mesh.split_segment(edge, steiner);
        let height = 1e-12;
        let hint = mesh.complex.tet_of(steiner);
        let above = insert_point(&mut mesh, middle + DVec3::new(0.01, 0.02, height), hint).unwrap().unwrap();
        let (steiner, split) = mesh.splits.pop().unwrap();
        let mut volume = vec![above];
        assert!(undo_after_centering(&mut mesh, steiner, &split, &mut volume).unwrap());
        assert!(mesh.has_edge(edge[0], edge[1]) && mesh.missing_segments().is_empty());
        assert!(mesh.missing_subfaces().is_empty());
        let is_off = |v: &VertexId| (mesh.at(*v) - middle).z.abs() > 1e3 * height;
        assert!(volume.iter().all(is_off), "{volume:?}");
        mesh.complex.check_invariants().unwrap();
        assert!(mesh.complex.finite_tets().all(|tet| mesh.complex.is_positive(tet)));
    }
}
