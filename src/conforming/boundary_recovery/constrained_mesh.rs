//! The mesh under recovery: a tet complex, what it must contain, and the one way to change it.
//!
//! # Method
//! 1. Constraints are kept by their vertices: segments (edges that must exist) and subfaces (faces that must exist),
//!    each subface with its facet. A segment or facet split by a Steiner point is replaced by its parts; the splits are
//!    recorded, so that they can be taken back in reverse order.
//! 2. Every reconnection replaces a set of tets by other tets ([`ConstrainedMesh::replace`]).
//! ```text
//!    old tets, boundary B        new tets, all positive, boundary B as well
//! ```
//!    Each point of the old region is then covered by the new tets exactly once: the number of positive tets that cover
//!    a point is the winding number of their common boundary around it, and that is the same for old and new. So
//!    positive volumes and an equal boundary are all there is to check.
//!
//! # Source
//! [GeorgeHechtSaltel1991] for recovery as a sequence of local changes; the covering argument is ours.
//!
//! # Invariants
//! Every finite tet is positive by the exact predicate. A constraint that the mesh contains is never lost: plans refuse
//! to swallow it.

use glam::DVec3;
use rustc_hash::{FxHashMap, FxHashSet};

use super::cavity_filling::{CavityFilling, fill_cavity};
use super::steiner_points::CavityMarks;
use crate::context::CancelToken;
use crate::error::Result;
use crate::geometry::predicates::orient3d;
use crate::index::{Label, TetFace, TetId, VertexId, each_once};
use crate::mesh::numbering::{TET_EDGES, TET_FACES, sorted_edge};
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::{collect_ball, find_edge, find_face};

/// An edge, smaller vertex first.
pub type EdgeKey = [VertexId; 2];
/// A face, vertices ascending.
pub type FaceKey = [VertexId; 3];

/// How a Steiner point came onto the surface.
#[derive(Debug, Clone, PartialEq)]
pub enum Split {
    /// The segment between two vertices was split; for each subface at it the third vertex and the facet.
    Edge(EdgeKey, Vec<(VertexId, u32)>),
    /// A subface was split.
    Face(FaceKey, u32),
}

/// A mesh with constraints.
#[derive(Debug, Default)]
pub struct ConstrainedMesh {
    /// The tets.
    pub complex: TetComplex,
    /// Faces that must exist, with their facets.
    pub subfaces: FxHashMap<FaceKey, u32>,
    /// Edges that must exist: third vertices of the subfaces at each.
    pub wings: FxHashMap<EdgeKey, Vec<VertexId>>,
    /// Steiner points on the surface in the order of their insertion.
    pub splits: Vec<(VertexId, Split)>,
    /// Steiner points in the volume.
    pub volume_points: Vec<VertexId>,
    /// Reconnections committed.
    pub reconnections: usize,
    /// Cavities searched, and filled.
    pub cavities: [usize; 2],
    /// Whether reconnections keep subfaces; while edges are recovered only segments are kept.
    pub keeps_faces: bool,
    /// The tets that the last change made, in the order of its rows.
    pub created: Vec<TetId>,
    /// Stops searches that take long: they find nothing then, and whoever asked ends at its next check.
    pub cancel: CancelToken,
    /// What undoes the changes of the trials under way, the outermost first.
    trials: Vec<Vec<Undo>>,
    ball: Vec<TetId>,
    /// Scratch of insertions.
    pub marks: CavityMarks,
    /// Scratch of searches for a filling.
    filling: CavityFilling,
    /// Faces of a change: the key in the upper 96 bits, the place in `sides` in the lower 32.
    faces: Vec<u128>,
    sides: Vec<TetFace>,
}

/// The rows of the tets that a change replaced, and the tets that it made.
type Undo = (Vec<[VertexId; 4]>, Vec<TetId>);

/// The key of an edge.
#[inline]
pub fn edge_key(a: VertexId, b: VertexId) -> EdgeKey {
    sorted_edge(a, b)
}

/// The key of a face.
#[inline]
pub fn face_key(mut face: [VertexId; 3]) -> FaceKey {
    face.sort_unstable();
    face
}

/// The keys of the edges of a face key, each with the third vertex.
pub fn edges_of_face([a, b, c]: FaceKey) -> [(EdgeKey, VertexId); 3] {
    [([a, b], c), ([b, c], a), ([a, c], b)]
}

impl ConstrainedMesh {
    /// A mesh that is to contain `facets` and their edges.
    pub fn new(complex: TetComplex, facets: &[[VertexId; 3]]) -> Self {
        let mut mesh = Self { complex, ..Self::default() };
        for (i, &facet) in facets.iter().enumerate() {
            mesh.add_subface(face_key(facet), i as u32);
        }
        mesh
    }

    /// The point of a vertex.
    #[inline]
    pub fn at(&self, vertex: VertexId) -> DVec3 {
        self.complex.point(vertex)
    }

    /// Exact orientation of four vertices.
    #[inline]
    pub fn orient(&self, [a, b, c, d]: [VertexId; 4]) -> f64 {
        orient3d(self.at(a), self.at(b), self.at(c), self.at(d))
    }

    /// Adds a subface and its edges to the constraints.
    pub fn add_subface(&mut self, key: FaceKey, facet: u32) {
        self.subfaces.insert(key, facet);
        for (edge, third) in edges_of_face(key) {
            self.wings.entry(edge).or_default().push(third);
        }
    }

    /// Removes a subface; edges left without one are no constraints any more.
    pub fn remove_subface(&mut self, key: FaceKey) -> Option<u32> {
        let facet = self.subfaces.remove(&key)?;
        for (edge, third) in edges_of_face(key) {
            if let Some(wings) = self.wings.get_mut(&edge) {
                wings.retain(|&v| v != third);
                if wings.is_empty() {
                    self.wings.remove(&edge);
                }
            }
        }
        Some(facet)
    }

    /// Splits a segment and the subfaces at it at `steiner`; returns the new segments.
    pub fn split_segment(&mut self, edge: EdgeKey, steiner: VertexId) -> Vec<EdgeKey> {
        let mut thirds = Vec::new();
        let mut new = vec![edge_key(edge[0], steiner), edge_key(edge[1], steiner)];
        for third in self.wings.get(&edge).cloned().unwrap_or_default() {
            let Some(facet) = self.remove_subface(face_key([edge[0], edge[1], third])) else { continue };
            self.add_subface(face_key([edge[0], steiner, third]), facet);
            self.add_subface(face_key([edge[1], steiner, third]), facet);
            new.push(edge_key(steiner, third));
            thirds.push((third, facet));
        }
        self.splits.push((steiner, Split::Edge(edge, thirds)));
        new
    }

    /// Splits a subface at `steiner`; returns the new segments.
    pub fn split_subface(&mut self, face: FaceKey, steiner: VertexId) -> Vec<EdgeKey> {
        let Some(facet) = self.remove_subface(face) else { return Vec::new() };
        let [a, b, c] = face;
        for (u, v) in [(a, b), (b, c), (a, c)] {
            self.add_subface(face_key([u, v, steiner]), facet);
        }
        self.splits.push((steiner, Split::Face(face, facet)));
        face.map(|v| edge_key(v, steiner)).to_vec()
    }

    /// Whether the edge must exist.
    #[inline]
    pub fn is_segment(&self, a: VertexId, b: VertexId) -> bool {
        self.wings.contains_key(&edge_key(a, b))
    }

    /// Whether the side lies on a subface.
    #[inline]
    pub fn is_subface(&self, side: TetFace) -> bool {
        self.keeps_faces && self.subfaces.contains_key(&face_key(self.complex.face_vertices(side)))
    }

    /// The tets at a vertex.
    pub fn ball(&self, vertex: VertexId) -> Vec<TetId> {
        let mut ball = Vec::with_capacity(32);
        if let Some(start) = self.complex.tet_of(vertex).some() {
            collect_ball(&self.complex, vertex, start, &mut ball);
        }
        ball
    }

    /// Whether a tet has the vertex: cavities are filled on the vertices of their border, so that a point inside of one
    /// that no constraint holds is gone.
    pub fn has_vertex(&self, vertex: VertexId) -> bool {
        let tet = self.complex.tet_of(vertex).some();
        tet.is_some_and(|tet| self.complex.is_live(tet) && self.complex.local_vertex(tet, vertex).is_some())
    }

    /// Whether the mesh has the edge.
    pub fn has_edge(&mut self, a: VertexId, b: VertexId) -> bool {
        find_edge(&self.complex, a, b, &mut self.ball).is_some()
    }

    /// A side with these vertices.
    pub fn find_face(&mut self, face: FaceKey) -> Option<TetFace> {
        find_face(&self.complex, face, &mut self.ball)
    }

    /// The tet with these vertices.
    pub fn find_tet(&mut self, row: [VertexId; 4]) -> Option<TetId> {
        collect_ball(&self.complex, row[0], self.complex.tet_of(row[0]).some()?, &mut self.ball);
        let has_all = |tet: &TetId| row.iter().all(|&v| self.complex.local_vertex(*tet, v).is_some());
        self.ball.iter().copied().find(has_all)
    }

    /// The segments that the mesh lacks, ascending.
    pub fn missing_segments(&self) -> Vec<EdgeKey> {
        let mut present: FxHashSet<EdgeKey> = FxHashSet::default();
        for tet in self.complex.finite_tets() {
            let v = self.complex.vertices(tet);
            for [i, j] in TET_EDGES {
                let key = edge_key(v[i], v[j]);
                if self.wings.contains_key(&key) {
                    present.insert(key);
                }
            }
        }
        let mut missing: Vec<EdgeKey> = self.wings.keys().filter(|k| !present.contains(*k)).copied().collect();
        missing.sort_unstable();
        missing
    }

    /// The subfaces that the mesh lacks, ascending.
    pub fn missing_subfaces(&self) -> Vec<FaceKey> {
        let mut present: FxHashSet<FaceKey> = FxHashSet::default();
        for tet in self.complex.finite_tets() {
            let v = self.complex.vertices(tet);
            for [i, j, k] in TET_FACES {
                let key = face_key([v[i], v[j], v[k]]);
                if self.subfaces.contains_key(&key) {
                    present.insert(key);
                }
            }
        }
        let mut missing: Vec<FaceKey> = self.subfaces.keys().filter(|k| !present.contains(*k)).copied().collect();
        missing.sort_unstable();
        missing
    }

    /// The faces around a set of tets as seen from inside, and the constraints inside: subfaces between two of them, and
    /// segments that no face of the boundary has.
    pub fn shape_of(&self, tets: &[TetId]) -> CavityShape {
        let inside = TetSet::new(tets);
        let mut shape = CavityShape::default();
        for &tet in tets {
            let v = self.complex.vertices(tet);
            for face in 0..4 {
                let side = TetFace::new(tet, face);
                let [a, b, c] = TET_FACES[face].map(|i| v[i]);
                let other = self.complex.neighbor(side);
                if other != TetFace::NONE && inside.contains(other.tet()) {
                    if side.0 < other.0 && self.is_subface(side) {
                        shape.sheets.push([a, b, c]);
                    }
                    continue;
                }
                shape.front.push([a, c, b]);
            }
            let keys = TET_EDGES.map(|[i, j]| edge_key(v[i], v[j]));
            shape.segments.extend(keys.into_iter().filter(|key| self.wings.contains_key(key)));
        }
        shape.segments.sort_unstable();
        shape.segments.dedup();
        if shape.segments.len() * shape.front.len() < FEW_TESTS {
            let front = &shape.front;
            shape.segments.retain(|[u, v]| !front.iter().any(|face| face.contains(u) && face.contains(v)));
        } else {
            // The front is closed: every edge is met in both directions.
            let ascending = |&[a, b, c]: &[VertexId; 3]| [[a, b], [b, c], [c, a]].into_iter().filter(|e| e[0] < e[1]);
            let mut edges: Vec<EdgeKey> = shape.front.iter().flat_map(ascending).collect();
            edges.sort_unstable();
            shape.segments.retain(|edge| edges.binary_search(edge).is_err());
        }
        shape
    }

    /// Replaces `old` tets by `new` ones; nothing happens and false is returned where the boundaries differ or a new tet
    /// is not positive.
    ///
    /// # Errors
    /// As [`TetStore::create_tet`].
    pub fn replace(&mut self, old: &[TetId], new: &[[VertexId; 4]]) -> Result<bool> {
        if new.iter().any(|&tet| self.orient(tet) <= 0.0) {
            return Ok(false);
        }
        self.replace_by_positive(old, new)
    }

    /// As [`Self::replace`], for new tets that are known to be positive: those of a plan, and those that were there before.
    ///
    /// # Errors
    /// As [`TetStore::create_tet`].
    pub fn replace_by_positive(&mut self, old: &[TetId], new: &[[VertexId; 4]]) -> Result<bool> {
        debug_assert!(new.iter().all(|&tet| self.orient(tet) > 0.0));
        let (mut faces, mut sides) = (std::mem::take(&mut self.faces), std::mem::take(&mut self.sides));
        let replaced = self.replace_with(old, new, &mut faces, &mut sides);
        (self.faces, self.sides) = (faces, sides);
        replaced
    }

    fn replace_with(
        &mut self,
        old: &[TetId],
        new: &[[VertexId; 4]],
        faces: &mut Vec<u128>,
        sides: &mut Vec<TetFace>,
    ) -> Result<bool> {
        // Every face twice: from a new tet and from its neighbour, new or outside.
        faces.clear();
        sides.clear();
        let inside = TetSet::new(old);
        for &tet in old {
            for face in 0..4 {
                let side = TetFace::new(tet, face);
                let other = self.complex.neighbor(side);
                if other == TetFace::NONE || !inside.contains(other.tet()) {
                    faces.push(packed(self.complex.face_vertices(side), sides.len()));
                    sides.push(other);
                }
            }
        }
        let border = sides.len();
        for (i, tet) in new.iter().enumerate() {
            for (face, corners) in TET_FACES.iter().enumerate() {
                faces.push(packed(corners.map(|c| tet[c]), border + 4 * i + face));
            }
        }
        faces.sort_unstable();
        let paired = faces.len().is_multiple_of(2) && faces.chunks_exact(2).all(|pair| pair[0] >> 32 == pair[1] >> 32);
        if !paired || faces.windows(3).any(|three| three[0] >> 32 == three[2] >> 32) {
            return Ok(false);
        }
        if let Some(trial) = self.trials.last_mut() {
            trial.push((old.iter().map(|&tet| self.complex.vertices(tet)).collect(), Vec::new()));
        }
        for &tet in old {
            self.complex.delete_tet(tet);
        }
        self.created.clear();
        for &row in new {
            let tet = self.complex.create_tet(row, Label::BACKGROUND)?;
            self.created.push(tet);
            sides.extend((0..4).map(|face| TetFace::new(tet, face)));
        }
        for pair in faces.chunks_exact(2) {
            let [one, two] = [sides[pair[0] as u32 as usize], sides[pair[1] as u32 as usize]];
            match (one == TetFace::NONE, two == TetFace::NONE) {
                (false, false) => self.complex.glue(one, two),
                (true, false) => self.complex.unglue(two),
                (false, true) => self.complex.unglue(one),
                (true, true) => {}
            }
        }
        self.reconnections += 1;
        if let Some(change) = self.trials.last_mut().and_then(|trial| trial.last_mut()) {
            change.1.clone_from(&self.created);
        }
        Ok(true)
    }

    /// A filling of a polyhedron as by [`fill_cavity`], or `None`, also where the run is cancelled.
    pub fn fill(
        &mut self,
        front: &[[VertexId; 3]],
        sheets: &[[VertexId; 3]],
        steps: usize,
        budget: &mut usize,
    ) -> Option<Vec<[VertexId; 4]>> {
        let Self { filling, complex, cancel, .. } = self;
        fill_cavity(filling, (front, sheets), |v| complex.point(v), (steps, cancel), budget)
    }

    /// Begins a trial: [`Self::end_trial`] keeps or undoes what is changed until then. One may be made within another.
    pub fn begin_trial(&mut self) {
        self.trials.push(Vec::new());
    }

    /// The segments that the innermost trial under way took from the mesh, ascending.
    pub fn segments_lost_in_trial(&mut self) -> Vec<EdgeKey> {
        let edges = self.replaced_in_trial(|v| TET_EDGES.map(|[i, j]| edge_key(v[i], v[j])));
        // Others are left out before: few edges and faces are constraints.
        let mut edges = each_once(edges.filter(|edge| self.wings.contains_key(edge)));
        edges.retain(|edge| !self.has_edge(edge[0], edge[1]));
        edges
    }

    /// The subfaces that the innermost trial under way took from the mesh, ascending.
    pub fn subfaces_lost_in_trial(&mut self) -> Vec<FaceKey> {
        let faces = self.replaced_in_trial(|v| TET_FACES.map(|face| face_key(face.map(|i| v[i]))));
        let mut faces = each_once(faces.filter(|face| self.subfaces.contains_key(face)));
        faces.retain(|face| self.find_face(*face).is_none());
        faces
    }

    /// What the tets have that the innermost trial under way replaced, some of it several times.
    fn replaced_in_trial<T, const N: usize>(
        &self,
        parts: impl Fn(&[VertexId; 4]) -> [T; N],
    ) -> impl Iterator<Item = T> {
        self.trials.last().into_iter().flatten().flat_map(|(rows, _)| rows).flat_map(parts)
    }

    /// Removes the points from `count` on, whose tets are gone.
    pub fn forget_points(&mut self, count: usize) {
        for vertex in count..self.complex.points().len() {
            self.complex.set_tet_of(VertexId::from_index(vertex), TetId::NONE);
        }
        self.complex.truncate_points(count);
    }

    /// Ends the innermost trial under way; what is kept of it is a part of the one around it. Points added since are left to
    /// the caller.
    ///
    /// # Errors
    /// As [`TetStore::create_tet`].
    pub fn end_trial(&mut self, keep: bool) -> Result<()> {
        let changes = self.trials.pop().unwrap_or_default();
        if keep {
            if let Some(outer) = self.trials.last_mut() {
                outer.extend(changes);
            }
            return Ok(());
        }
        // The way back is not for the trial around this one to remember.
        let outer = std::mem::take(&mut self.trials);
        // Slots are given out last freed first: in reverse order every change gets the ids it had.
        for (mut rows, mut ids) in changes.into_iter().rev() {
            rows.reverse();
            ids.reverse();
            let undone = self.replace_by_positive(&ids, &rows)?;
            debug_assert!(undone, "the tets of a change have the border of what they replaced");
        }
        self.trials = outer;
        Ok(())
    }
}

/// A face by its vertices, ascending, and a place in a list.
#[inline]
fn packed(face: [VertexId; 3], place: usize) -> u128 {
    let [a, b, c] = face_key(face).map(|v| u128::from(v.0));
    a << 96 | b << 64 | c << 32 | place as u128
}

/// Most tets that are searched one by one: that is faster than hashing.
const FEW_TETS: usize = 24;

/// Tests of segments against faces, up to which sorting the edges costs more.
const FEW_TESTS: usize = 400;

/// A set of tets.
enum TetSet<'a> {
    Few(&'a [TetId]),
    Many(FxHashSet<TetId>),
}

impl<'a> TetSet<'a> {
    fn new(tets: &'a [TetId]) -> Self {
        if tets.len() <= FEW_TETS { Self::Few(tets) } else { Self::Many(tets.iter().copied().collect()) }
    }

    #[inline]
    fn contains(&self, tet: TetId) -> bool {
        match self {
            Self::Few(tets) => tets.contains(&tet),
            Self::Many(tets) => tets.contains(&tet),
        }
    }
}

/// A set of tets seen as a polyhedron to be filled anew.
#[derive(Debug, Clone, Default)]
pub struct CavityShape {
    /// Boundary faces; a new tet `(a, b, c, apex)` on them is positive.
    pub front: Vec<[VertexId; 3]>,
    /// Subfaces inside, which a filling must contain.
    pub sheets: Vec<[VertexId; 3]>,
    /// Segments inside, which a filling must contain.
    pub segments: Vec<EdgeKey>,
}
