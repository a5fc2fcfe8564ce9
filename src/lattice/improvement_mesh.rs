//! Tets that can be replaced one group at a time, with the tets of each vertex and what each surface vertex separates.
//!
//! # Method
//! Rows of tets with a list of tets per vertex; neighbours are found through these lists. A group of tets is replaced by
//! another group that fills the same space; slots of removed tets are reused in order.
//!
//! # Invariants
//! Every live tet is in the lists of its four vertices and in no other. Side sets are sorted and stored once.
//!
//! # Cost
//! About 54 bytes per vertex, 24 of them for its place in the lattice, and 20 per tet beside the mesh.

use std::borrow::Cow;

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::context::RunContext;
use crate::error::Result;
use crate::index::{Label, VertexId};
use crate::lattice::boundary_targets::SourcePoints;
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::change_log::{ChangeLog, Filled, Mark, Taken, Undone};
use crate::lattice::element_score::{Ball, LowestScore, Part, Threshold, part_fails, part_score};
use crate::lattice::subvoxel_surface::{Side, SubvoxelSurface};
use crate::lattice::surface_stars::SurfaceStars;
use crate::mesh::numbering::TET_FACES;
use crate::mesh::renumbering::gathered;

/// Rows that are asked for at once: a vertex inside has about 24 tets.
const ROWS_AT_ONCE: usize = 32;

/// Rows per parallel work item.
const CHUNK: usize = 4096;

/// A dead slot.
const DEAD: [u32; 4] = [u32::MAX; 4];

/// A mesh under local improvement.
pub struct ImprovementMesh<'a> {
    /// Local frame, mm.
    pub points: Vec<DVec3>,
    /// Rows of vertices; dead slots hold `u32::MAX`.
    pub tets: Vec<[u32; 4]>,
    /// Label per tet.
    pub labels: Vec<Label>,
    /// The image's surfaces.
    pub surface: SubvoxelSurface<'a>,
    /// Vertices that must stay.
    pub fixed: Vec<bool>,
    /// Tets of each vertex.
    pub(super) balls: Vec<Vec<u32>>,
    pub(super) side_set: Vec<u32>,
    sets: Vec<Vec<Side>>,
    /// Whether the background or a border is among the sides, by set.
    is_outer_set: Vec<bool>,
    set_numbers: FxHashMap<Vec<Side>, u32>,
    pub(super) free: Vec<u32>,
    scratch: Ball,
    log: ChangeLog,
    pub(super) stars: SurfaceStars,
    /// The vertices that the scaffold brought.
    pub(super) still: Vec<bool>,
    /// Where the lattice had each vertex; not a number for those that it did not have.
    pub(super) lattice: Vec<DVec3>,
}

/// A face of the ball of a vertex that separates two sides: the other two vertices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SurfaceFace {
    /// The other vertices, in the order that makes the face outward from `inner`.
    pub others: [u32; 2],
    /// The tet on the inner side.
    pub inner: u32,
    /// The tet on the outer side, where there is one.
    pub outer: Option<u32>,
}

impl SurfaceFace {
    /// A face of one or two tets by its vertices in outward order seen from `inner`, as it is seen from the tet of the smaller number.
    pub fn seen_from_first([a, b]: [u32; 2], inner: u32, outer: Option<u32>) -> Self {
        match outer {
            Some(outer) if outer < inner => Self { others: [b, a], inner: outer, outer: Some(inner) },
            _ => Self { others: [a, b], inner, outer },
        }
    }

    /// What the faces of a vertex are in order of.
    #[inline]
    pub fn key(&self) -> u64 {
        key_of(self.others)
    }
}

/// The other vertices of some faces at a vertex, in order.
pub fn neighbors_in(faces: &[SurfaceFace]) -> Vec<u32> {
    let mut near: Vec<u32> = faces.iter().flat_map(|face| face.others).collect();
    near.sort_unstable();
    near.dedup();
    near
}

/// A face of the ball of a vertex whose second tet has not been met yet.
#[derive(Debug, Clone, Copy)]
pub struct OpenFace {
    /// The other vertices, in the order that makes the face outward from `tet`.
    others: [u32; 2],
    tet: u32,
}

impl OpenFace {
    #[inline]
    fn key(self) -> u64 {
        key_of(self.others)
    }
}

/// The same number for both orders of two vertices, ordered by the smaller one.
#[inline]
fn key_of([a, b]: [u32; 2]) -> u64 {
    u64::from(a.min(b)) << 32 | u64::from(a.max(b))
}

impl<'a> ImprovementMesh<'a> {
    /// Takes over the tets of a mesh.
    pub fn new(mesh: &mut CandidateMesh, sources: &SourcePoints, surface: SubvoxelSurface<'a>) -> Self {
        let mut points = std::mem::take(&mut mesh.points);
        let scaffold = std::mem::take(&mut mesh.scaffold);
        let rows = mesh.tets.par_iter().chain(&scaffold.tets).with_min_len(CHUNK);
        let tets: Vec<[u32; 4]> = rows.map(|t| t.map(|v| v.0)).collect();
        let mut labels = std::mem::take(&mut mesh.tet_labels);
        labels.resize(tets.len(), Label::BACKGROUND);
        mesh.tets = Vec::new();
        let in_mesh = points.len();
        points.extend(scaffold.points);
        let balls = balls_of(&tets, points.len());
        let mut fixed = vec![false; points.len()];
        mesh.fixed.iter().for_each(|v| fixed[v.index()] = true);
        fixed[in_mesh..].fill(true);
        let mut result = Self {
            side_set: vec![0; points.len()],
            log: ChangeLog::default(),
            stars: SurfaceStars::new(points.len()),
            still: (0..points.len()).map(|v| v >= in_mesh).collect(),
            lattice: vec![DVec3::NAN; points.len()],
            points,
            tets,
            labels,
            surface,
            fixed,
            balls,
            sets: vec![Vec::new()],
            is_outer_set: vec![false],
            set_numbers: FxHashMap::from_iter([(Vec::new(), 0)]),
            free: Vec::new(),
            scratch: Ball::default(),
        };
        for (at, v) in sources.vertices.iter().enumerate() {
            result.side_set[v.index()] = result.intern(sources.sides(at).to_vec());
        }
        result
    }

    /// Gives the tets back, without dead slots, the scaffold and unused vertices.
    pub fn finish(self, mesh: &mut CandidateMesh) {
        let all = |count: usize| (0..count as u32).into_par_iter().with_min_len(CHUNK);
        let is_used = |v: &u32| self.ball(*v).iter().any(|t| self.part(*t) == Part::Mesh);
        let vertices: Vec<u32> = all(self.points.len()).filter(is_used).collect();
        let mut renumbered = vec![u32::MAX; self.points.len()];
        vertices.iter().zip(0..).for_each(|(old, new)| renumbered[*old as usize] = new);
        mesh.points = gathered(&self.points, &vertices);
        let is_kept = |t: &u32| self.is_live(*t) && self.part(*t) == Part::Mesh;
        let tets: Vec<u32> = all(self.tets.len()).filter(is_kept).collect();
        let row = |t: &u32| self.tets[*t as usize].map(|v| VertexId(renumbered[v as usize]));
        mesh.tets = tets.par_iter().with_min_len(CHUNK).map(row).collect();
        mesh.tet_labels = gathered(&self.labels, &tets);
        mesh.renumber_records(&renumbered);
    }

    /// A trial begins, which can be taken back until it ends.
    pub fn begin_trial(&mut self) -> Mark {
        self.log.begin()
    }

    /// The trial that began last ends; its changes stay.
    pub fn keep_trial(&mut self) {
        self.log.end();
    }

    /// The trial that began last, at the mark, ends; its changes are taken back.
    pub fn take_back(&mut self, mark: Mark) {
        while let Some(change) = self.log.pop(mark) {
            match change {
                Undone::Move(v, from) => self.points[v as usize] = from,
                Undone::Vertex => self.remove_last_vertex(),
                Undone::Replacement(taken, filled) => self.put_back(&taken, &filled),
            }
        }
        self.log.end();
    }

    /// The vertices that changes since the mark of an open trial moved or took tets from, in order.
    pub fn touched_since(&self, mark: Mark) -> Vec<u32> {
        let mut touched = self.log.touched(mark);
        touched.sort_unstable();
        touched.dedup();
        touched
    }

    /// Moves a vertex.
    #[inline]
    pub fn move_vertex(&mut self, v: u32, place: DVec3) {
        if self.log.is_open() {
            self.log.note_move(v, self.points[v as usize]);
        }
        self.points[v as usize] = place;
    }

    fn intern(&mut self, set: Vec<Side>) -> u32 {
        if let Some(found) = self.set_numbers.get(&set) {
            return *found;
        }
        let number = self.sets.len() as u32;
        self.set_numbers.insert(set.clone(), number);
        let is_outer = |side: &Side| !matches!(side, Side::Label(label) if !label.is_background());
        self.is_outer_set.push(set.iter().any(is_outer));
        self.sets.push(set);
        number
    }

    /// Sides that meet at a vertex; empty inside of a label.
    #[inline]
    pub fn sides(&self, v: u32) -> &[Side] {
        &self.sets[self.side_set[v as usize] as usize]
    }

    /// Whether a vertex lies on a surface.
    #[inline]
    pub fn is_on_surface(&self, v: u32) -> bool {
        self.side_set[v as usize] != 0
    }

    /// Whether a vertex lies on the outside of the mesh.
    #[inline]
    pub fn is_at_outside(&self, v: u32) -> bool {
        self.is_outer_set[self.side_set[v as usize] as usize]
    }

    /// Whether every side of `v` is a side of `w`.
    pub fn sides_within(&self, v: u32, w: u32) -> bool {
        self.side_set[v as usize] == self.side_set[w as usize]
            || self.sides(v).iter().all(|s| self.sides(w).contains(s))
    }

    /// Whether a vertex is one of the scaffold's own, which are where the lattice has them.
    #[inline]
    pub fn is_still(&self, v: u32) -> bool {
        self.still[v as usize]
    }

    /// Says where the lattice had the vertices, those of the scaffold included; before any is added.
    pub fn set_lattice(&mut self, lattice: Vec<DVec3>) {
        debug_assert_eq!(lattice.len(), self.points.len());
        self.lattice = lattice;
    }

    /// Where the lattice had a vertex; `None` for those that came later.
    #[inline]
    pub fn place_in_lattice(&self, v: u32) -> Option<DVec3> {
        Some(self.lattice[v as usize]).filter(|place| !place.is_nan())
    }

    /// Tets of a vertex.
    #[inline]
    pub fn ball(&self, v: u32) -> &[u32] {
        &self.balls[v as usize]
    }

    /// The tets of some vertices, each once, in order.
    pub fn tets_of(&self, mut vertices: Vec<u32>) -> Vec<u32> {
        vertices.sort_unstable();
        vertices.dedup();
        let mut tets: Vec<u32> = vertices.iter().flat_map(|v| self.ball(*v)).copied().collect();
        tets.sort_unstable();
        tets.dedup();
        tets
    }

    /// Whether a slot holds a tet.
    #[inline]
    pub fn is_live(&self, t: u32) -> bool {
        self.tets[t as usize] != DEAD
    }

    /// Points of a tet.
    #[inline]
    pub fn corners(&self, t: u32) -> [DVec3; 4] {
        self.corners_of(self.tets[t as usize])
    }

    /// Points of a row.
    #[inline]
    fn corners_of(&self, [a, b, c, d]: [u32; 4]) -> [DVec3; 4] {
        // Written out: a closure over the row is not inlined into the loops that call this most.
        [self.points[a as usize], self.points[b as usize], self.points[c as usize], self.points[d as usize]]
    }

    /// What a tet is part of.
    #[inline]
    pub fn part(&self, t: u32) -> Part {
        part_of(self.labels[t as usize])
    }

    /// Score of a tet.
    #[inline]
    pub fn score(&self, t: u32) -> f64 {
        part_score(self.corners(t), self.part(t))
    }

    /// Whether the score of a tet is below a threshold.
    #[inline]
    pub fn fails(&self, t: u32, threshold: &Threshold) -> bool {
        part_fails(self.corners(t), self.part(t), threshold)
    }

    /// Goes through the rows of a group of tets. They lie apart in memory: all rows of a chunk are asked for before the first is
    /// used, so that the processor waits for them side by side.
    #[inline]
    pub fn for_each_row(&self, tets: &[u32], mut work: impl FnMut(u32, [u32; 4])) {
        let mut rows = [DEAD; ROWS_AT_ONCE];
        for chunk in tets.chunks(ROWS_AT_ONCE) {
            rows.iter_mut().zip(chunk).for_each(|(row, t)| *row = self.tets[*t as usize]);
            rows.iter().zip(chunk).for_each(|(row, t)| work(*t, *row));
        }
    }

    /// Lowest score in a group of tets.
    pub fn lowest(&self, tets: &[u32]) -> f64 {
        let mut lowest = LowestScore::default();
        self.for_each_row(tets, |t, row| lowest.join(self.corners_of(row), self.part(t)));
        lowest.score()
    }

    /// Fills `ball` with the tets of a vertex.
    pub fn gather(&self, v: u32, ball: &mut Ball) {
        ball.clear();
        self.for_each_row(self.ball(v), |t, tet| {
            let own = tet.iter().position(|w| *w == v).unwrap_or(0);
            let [a, b, c] = TET_FACES[own].map(|at| self.points[tet[at] as usize]);
            ball.push([a, b, c], self.part(t));
        });
    }

    /// Fills `ball` with the tets that a new vertex would have which splits a group of tets between some of their vertices, in the
    /// order that they would have as well.
    pub fn gather_split(&self, tets: &[u32], between: &[u32], ball: &mut Ball) {
        ball.clear();
        self.for_each_row(tets, |t, tet| {
            for own in between.iter().filter_map(|corner| tet.iter().position(|v| v == corner)) {
                let [a, b, c] = TET_FACES[own].map(|at| self.points[tet[at] as usize]);
                ball.push([a, b, c], self.part(t));
            }
        });
    }

    /// The tet on the other side of the face of `t` opposite to its corner `face`.
    pub fn neighbor(&self, t: u32, face: usize) -> Option<u32> {
        let tet = self.tets[t as usize];
        let [a, b, c] = TET_FACES[face].map(|v| tet[v]);
        self.ball(a).iter().copied().find(|&n| {
            n != t && {
                let other = &self.tets[n as usize];
                other.contains(&b) && other.contains(&c)
            }
        })
    }

    /// The label on the other side of the face of `t` opposite to its corner `face`, that of the scaffold included; `None` where there is
    /// nothing. Where the star of one of its vertices is up to date, most faces are known from that: it has all but those within a label.
    pub fn label_behind(&self, t: u32, face: usize) -> Option<Label> {
        let [a, b, c] = TET_FACES[face].map(|corner| self.tets[t as usize][corner]);
        let label = |n: u32| self.labels[n as usize];
        let key = key_of([b, c]);
        match self.stars.of(a).map(|star| star.iter().find(|face| face.key() == key)) {
            Some(None) if self.part(t) == Part::Mesh => Some(label(t)),
            Some(Some(SurfaceFace { inner, outer: Some(outer), .. })) => {
                Some(label(if *inner == t { *outer } else { *inner }))
            }
            Some(Some(SurfaceFace { inner, outer: None, .. })) if *inner != t => Some(label(*inner)),
            _ => self.neighbor(t, face).map(label),
        }
    }

    /// Tets around an edge.
    pub fn shell(&self, a: u32, b: u32) -> Vec<u32> {
        self.ball(a).iter().copied().filter(|t| self.tets[*t as usize].contains(&b)).collect()
    }

    /// Tets at a face: two, or one.
    pub fn tets_at_face(&self, [a, b, c]: [u32; 3]) -> Vec<u32> {
        let has_both = |t: &u32| self.tets[*t as usize].contains(&b) && self.tets[*t as usize].contains(&c);
        self.ball(a).iter().copied().filter(has_both).collect()
    }

    /// Brings the stars of surface vertices up to date.
    ///
    /// # Errors
    /// As [`SurfaceStars::refresh`].
    pub fn refresh_stars(&mut self, context: &RunContext) -> Result<()> {
        let mut stars = std::mem::take(&mut self.stars);
        let result = stars.refresh(self, context);
        self.stars = stars;
        result
    }

    /// Surface faces by vertex as of the last refresh, without those that changed since.
    #[inline]
    pub fn stars(&self) -> &SurfaceStars {
        &self.stars
    }

    /// Faces at a vertex that separate two sides, by their other vertices: its star where that is up to date.
    pub fn surface_faces(&self, v: u32) -> Cow<'_, [SurfaceFace]> {
        self.stars.of(v).map_or_else(
            || {
                let mut faces = Vec::new();
                self.append_surface_faces(v, &mut Vec::new(), &mut faces);
                Cow::Owned(faces)
            },
            Cow::Borrowed,
        )
    }

    /// Appends the faces at a vertex that separate two sides, found from its tets, by their other vertices; `open` is a scratch buffer.
    pub fn append_surface_faces(&self, v: u32, open: &mut Vec<OpenFace>, faces: &mut Vec<SurfaceFace>) {
        let first = faces.len();
        open.clear();
        self.for_each_row(self.ball(v), |t, tet| {
            let own = tet.iter().position(|w| *w == v).unwrap_or(0);
            // The other vertices in outward order seen from outside of the face opposite to v: with v, each pair of them in
            // reverse order is an outward face.
            let [p, q, r] = TET_FACES[own];
            let rest = [tet[p], tet[q], tet[r]];
            // A face between two sides has all its vertices on the surface.
            let on = rest.map(|w| self.is_on_surface(w));
            for (at, after) in [(0, 1), (1, 2), (2, 0)] {
                if on[at] && on[after] {
                    let face = OpenFace { others: [rest[after], rest[at]], tet: t };
                    // A few faces are open at a time: going through them is faster than sorting all.
                    match open.iter().position(|o| o.key() == face.key()) {
                        Some(at) => faces.extend(self.face_between(open.swap_remove(at), face)),
                        None => open.push(face),
                    }
                }
            }
        });
        let is_of_mesh = |face: &&OpenFace| self.part(face.tet) == Part::Mesh;
        let outermost = open.iter().filter(is_of_mesh);
        faces.extend(outermost.map(|face| SurfaceFace { others: face.others, inner: face.tet, outer: None }));
        // The order of the tets at the vertex depends on how they came about.
        faces[first..].sort_unstable_by_key(SurfaceFace::key);
    }

    /// The surface face between two tets seen from either; `None` within a label.
    fn face_between(&self, one: OpenFace, other: OpenFace) -> Option<SurfaceFace> {
        if self.labels[one.tet as usize] == self.labels[other.tet as usize] {
            return None;
        }
        // Behind a scaffold is the outside.
        Some(match (self.part(one.tet), self.part(other.tet)) {
            (Part::Mesh, Part::Mesh) => SurfaceFace::seen_from_first(one.others, one.tet, Some(other.tet)),
            (Part::Mesh, Part::Scaffold) => SurfaceFace::seen_from_first(one.others, one.tet, None),
            (Part::Scaffold, _) => SurfaceFace::seen_from_first(other.others, other.tet, None),
        })
    }

    /// The labels on the inner and the outer side of a surface face at a vertex; `None` where the image ends, since nothing is known of
    /// what is behind and no surface passes there.
    #[inline]
    pub fn labels_beside(&self, v: u32, face: &SurfaceFace) -> Option<[Label; 2]> {
        let [w, u] = face.others;
        let is_border = face.outer.is_none() && self.are_in_border([v, w, u]);
        let label = |t: u32| self.labels[t as usize];
        (!is_border).then(|| [label(face.inner), face.outer.map_or(Label::BACKGROUND, label)])
    }

    /// Whether three vertices lie in one border plane of the image, and so does a face between them.
    pub fn are_in_border(&self, [a, b, c]: [u32; 3]) -> bool {
        let has = |v: u32, side: &Side| self.sides(v).contains(side);
        self.sides(a).iter().any(|side| matches!(side, Side::Border(_)) && has(b, side) && has(c, side))
    }

    /// Whether an edge lies on a surface: its tets differ in label or do not close around it.
    pub fn is_surface_edge(&self, a: u32, b: u32, shell: &[u32]) -> bool {
        if !(self.is_on_surface(a) && self.is_on_surface(b)) {
            return false;
        }
        let label = self.labels[shell[0] as usize];
        shell.iter().any(|t| self.labels[*t as usize] != label) || self.ring(a, b, shell).is_none()
    }

    /// Vertices around an edge in order, such that the tets are a, b, ring i, ring i + 1; `None` where the tets do not close.
    pub fn ring(&self, a: u32, b: u32, shell: &[u32]) -> Option<Vec<u32>> {
        let mut links: Vec<[u32; 2]> = Vec::with_capacity(shell.len());
        for &t in shell {
            links.push(ordered_rest(self.tets[t as usize], a, b));
        }
        let mut ring = vec![links[0][0]];
        let mut next = links[0][1];
        while next != ring[0] {
            if ring.len() >= links.len() {
                return None;
            }
            ring.push(next);
            next = links.iter().find(|l| l[0] == next)?[1];
        }
        (ring.len() == shell.len()).then_some(ring)
    }

    /// Replaces a group of tets; returns the slots of the new ones.
    pub fn replace(&mut self, old: &[u32], new: &[([u32; 4], Label)]) -> Vec<u32> {
        let noted = self.log.is_open().then(|| {
            let taken =
                |slot: &u32| Taken { slot: *slot, tet: self.tets[*slot as usize], label: self.labels[*slot as usize] };
            (old.iter().map(taken).collect::<Vec<Taken>>(), self.tets.len() as u32)
        });
        self.invalidate_stars(old, new);
        for &t in old {
            self.take_from_balls(t);
            self.free.push(t);
        }
        let mut slots = Vec::with_capacity(new.len());
        for (tet, label) in new {
            let slot = self.free.pop().unwrap_or_else(|| {
                self.tets.push(DEAD);
                self.labels.push(*label);
                self.tets.len() as u32 - 1
            });
            self.fill(slot, *tet, *label);
            slots.push(slot);
        }
        if let Some((taken, slot_count)) = noted {
            let filled = slots.iter().map(|slot| Filled { slot: *slot, is_new: *slot >= slot_count });
            self.log.note_replacement(taken.into_iter(), filled);
        }
        slots
    }

    /// Stars that a replacement changes are out of date. Where some tets take the place of others, all of one label, the faces around the
    /// group stay, and those within are on no surface before and after.
    fn invalidate_stars(&mut self, old: &[u32], new: &[([u32; 4], Label)]) {
        let label = old.first().and(new.first()).map(|(_, label)| *label);
        let is_within = label.is_some()
            && old.iter().all(|t| Some(self.labels[*t as usize]) == label)
            && new.iter().all(|(_, of_new)| Some(*of_new) == label);
        for &t in old {
            let corners = self.tets[t as usize];
            if is_within {
                self.stars.invalidate_at(t, corners);
            } else {
                corners.into_iter().for_each(|v| self.stars.invalidate(v));
            }
        }
        for v in new.iter().flat_map(|(tet, _)| *tet) {
            // A vertex that has had no tets may have a star without faces.
            if !is_within || self.balls[v as usize].is_empty() {
                self.stars.invalidate(v);
            }
        }
    }

    /// Gives a tet another label; a vertex that no longer lies between two labels has no sides. Not within a trial.
    pub fn relabel(&mut self, t: u32, label: Label) {
        debug_assert!(!self.log.is_open());
        self.labels[t as usize] = label;
        for v in self.tets[t as usize] {
            self.stars.invalidate(v);
            if self.ball(v).iter().all(|n| self.labels[*n as usize] == label) {
                self.side_set[v as usize] = 0;
            }
        }
    }

    /// Puts an inner vertex that lies between two labels now on the surface that `like` is on.
    pub fn join_surface(&mut self, v: u32, like: u32) {
        debug_assert!(!self.log.is_open());
        self.side_set[v as usize] = self.side_set[like as usize];
    }

    fn take_from_balls(&mut self, t: u32) {
        for v in std::mem::replace(&mut self.tets[t as usize], DEAD) {
            let ball = &mut self.balls[v as usize];
            if let Some(at) = ball.iter().position(|u| *u == t) {
                ball.swap_remove(at);
            }
        }
    }

    fn fill(&mut self, slot: u32, tet: [u32; 4], label: Label) {
        self.tets[slot as usize] = tet;
        self.labels[slot as usize] = label;
        self.stars.part_colors(tet);
        for v in tet {
            self.balls[v as usize].push(slot);
        }
    }

    /// Undoes [`replace`](Self::replace), the last one: all tets get their slots again.
    fn put_back(&mut self, taken: &[Taken], filled: &[Filled]) {
        let slots: Vec<u32> = filled.iter().map(|Filled { slot, .. }| *slot).collect();
        let rows: Vec<([u32; 4], Label)> = taken.iter().map(|Taken { tet, label, .. }| (*tet, *label)).collect();
        self.invalidate_stars(&slots, &rows);
        for Filled { slot, is_new } in filled.iter().rev() {
            self.take_from_balls(*slot);
            if *is_new {
                // The last one that was appended is the last one there is.
                self.tets.pop();
                self.labels.pop();
            } else {
                self.free.push(*slot);
            }
        }
        for Taken { slot, tet, label } in taken.iter().rev() {
            let last = self.free.pop();
            debug_assert_eq!(last, Some(*slot));
            self.fill(*slot, *tet, *label);
        }
    }

    /// Works on a vertex with its ball gathered into the mesh's own buffer.
    pub fn with_ball<T>(&mut self, v: u32, work: impl FnOnce(&mut Self, &mut Ball) -> T) -> T {
        self.with_scratch(|mesh, ball| {
            mesh.gather(v, ball);
            work(mesh, ball)
        })
    }

    /// Works with the mesh's own buffer for a ball.
    pub fn with_scratch<T>(&mut self, work: impl FnOnce(&mut Self, &mut Ball) -> T) -> T {
        let mut ball = std::mem::take(&mut self.scratch);
        let result = work(self, &mut ball);
        self.scratch = ball;
        result
    }

    /// Rows and labels of a group of tets.
    pub fn rows(&self, tets: &[u32]) -> Vec<([u32; 4], Label)> {
        tets.iter().map(|t| (self.tets[*t as usize], self.labels[*t as usize])).collect()
    }

    /// A new vertex without tets.
    pub fn add_vertex(&mut self, point: DVec3, sides: Vec<Side>) -> u32 {
        let set = self.intern(sides);
        if self.log.is_open() {
            self.log.note_vertex();
        }
        self.points.push(point);
        self.balls.push(Vec::new());
        self.side_set.push(set);
        self.fixed.push(false);
        self.still.push(false);
        self.lattice.push(DVec3::NAN);
        self.points.len() as u32 - 1
    }

    /// Takes the last vertex away again; it has no tets.
    fn remove_last_vertex(&mut self) {
        debug_assert!(self.balls.last().is_some_and(Vec::is_empty));
        self.points.pop();
        self.stars.truncate(self.points.len());
        self.balls.pop();
        self.side_set.pop();
        self.fixed.pop();
        self.still.pop();
        self.lattice.pop();
    }
}

/// Those of the numbers below `count` for which something holds, in order. One function for all questions: each loop over threads is
/// several kilobytes of code.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn numbers_where(count: usize, holds: &(dyn Fn(u32) -> bool + Sync), context: &RunContext) -> Result<Vec<u32>> {
    let all = (0..count as u32).into_par_iter().with_min_len(CHUNK);
    let found = context.until_cancelled(all).filter(|n| holds(*n)).collect();
    context.check()?;
    Ok(found)
}

/// The tets of each vertex, in order.
pub fn balls_of(tets: &[[u32; 4]], vertices: usize) -> Vec<Vec<u32>> {
    let mut counts = vec![0u32; vertices];
    tets.as_flattened().iter().for_each(|v| counts[*v as usize] += 1);
    let mut balls: Vec<Vec<u32>> = counts.iter().map(|c| Vec::with_capacity(*c as usize)).collect();
    for (t, tet) in tets.iter().enumerate() {
        tet.iter().for_each(|v| balls[*v as usize].push(t as u32));
    }
    balls
}

/// The part that tets of a label are of.
#[inline]
pub fn part_of(label: Label) -> Part {
    if label.is_background() { Part::Scaffold } else { Part::Mesh }
}

/// The other two vertices of a tet in the order that makes (a, b, first, second) positive like the tet.
pub fn ordered_rest(tet: [u32; 4], a: u32, b: u32) -> [u32; 2] {
    use crate::mesh::numbering::{TET_EDGES, TET_OPPOSITE_EDGES};
    for (edge, opposite) in TET_EDGES.into_iter().zip(TET_OPPOSITE_EDGES) {
        let [c, d] = opposite.map(|v| tet[v]);
        if tet[edge[0]] == a && tet[edge[1]] == b {
            return [c, d];
        }
        if tet[edge[0]] == b && tet[edge[1]] == a {
            return [d, c];
        }
    }
    debug_assert!(false, "the edge belongs to the tet");
    [a, b]
}
