//! Local transformations of the worst tets: edge removal, face exchange, edge contraction, edge split, turning a surface edge.
//!
//! # Method
//! Each transformation is planned on the group of tets it would replace: the lowest score of the new group, after its own vertex
//! has been optimised where it makes one, is compared with that of the old group. Nothing is tried on the mesh.
//! ```text
//!   edge removal, n = 5            split of an inner edge that joins two surface vertices
//!      a above, b below             surface  a-------b           a---m---b
//!    r0---r1      r0---r1                     \  t  /     ->      \ /|\ /     m then sinks below the surface
//!    | \ / |      |  \  |                      \   /               c   d
//!    r4-x-r2  ->  r4--\-r2
//!      \|/          \  \|         turning a surface edge: the tet a b c d with two faces on the surface around the edge
//!       r3            r3          a b changes its label (or leaves the mesh); the surface edge is then c d
//! ```
//! - Edge removal: the tets around an inner edge of one label are replaced by the best triangulation of its ring, found by
//!   dynamic programming; three tets become two, four become four, and so on to seven.
//! - Face exchange: two tets of one label become three around the line of their apexes.
//! - Contraction: an inner vertex, or a surface vertex along an edge of the same surface, is merged into a neighbour.
//!
//! # Source
//! [FreitagOllivierGooch1997], [Shewchuk2002], [Klincsek1980] for the ring; [Molino2003] splits edges that join two surface
//! vertices for the same reason.
//!
//! # Invariants
//! The mesh conforms after each call; the lowest score of the tets that were replaced has risen by `LEAST_GAIN` at least.

use glam::DVec3;

use crate::index::Label;
use crate::lattice::element_score::{Ball, Part, Threshold, lowest_score, part_fails, tet_score};
use crate::lattice::improvement_mesh::{ImprovementMesh, SurfaceFace, neighbors_in, ordered_rest, part_of};
use crate::lattice::scaffold::SCAFFOLD_ANGLE;
use crate::lattice::subvoxel_surface::Side;
use crate::lattice::surface_cuts::{LabelledFace, worst_cut, worst_new_cut};
use crate::lattice::vertex_optimization::better_place;
use crate::mesh::numbering::{TET_EDGES, TET_FACES, sorted_edge};

/// Rise of the lowest score that is worth a change of the mesh, degrees.
const LEAST_GAIN: f64 = 0.3;

/// Longest ring of an edge removal.
pub const LONGEST_RING: usize = 7;

/// How far off its surface the middle of an edge or face may be after a contraction or turn, in voxels of the smallest spacing:
/// a little more than where chords are split, or one would undo the other.
const LARGEST_CUT: f64 = 0.3;

/// Cosine between an old and a new surface normal below which a contraction or turn would fold the surface.
const SMALLEST_NORMAL_COSINE: f64 = 0.6;

/// Edges of surfaces shorter than this, in voxels of the smallest spacing, may be contracted whatever turns by that: it moves the surface
/// by less than what it may be off, where edges zigzag on a line so short that no element beside them becomes good otherwise. On a foam
/// that the image border cuts the lowest angle is 11.0 degrees without, 15.2 with it.
const NOISE: f64 = 0.1;

/// Scores above which nothing more is gained from a vertex optimisation inside of a plan.
const ENOUGH: f64 = 30.0;

/// Counts of successful transformations.
#[derive(Debug, Clone, Copy, Default)]
pub struct TransformationCounts {
    /// Edges removed.
    pub edge_removals: usize,
    /// Faces exchanged.
    pub face_exchanges: usize,
    /// Vertices merged into a neighbour.
    pub contractions: usize,
    /// Edges split.
    pub splits: usize,
    /// Surface edges turned.
    pub turned_edges: usize,
    /// Short edges contracted.
    pub short_edges: usize,
    /// Surface edges split for what they cut off.
    pub chords: usize,
    /// Surface vertices off their surface merged into a neighbour.
    pub spikes: usize,
}

/// A transformation of a tet that gains enough, known before it is made.
#[derive(Debug)]
pub enum Transformation {
    /// An edge is removed: a group of tets and the one that takes its place.
    EdgeRemoval(Replacement),
    /// A face is exchanged.
    FaceExchange(Replacement),
    /// A surface edge is turned.
    Turn(Replacement),
    /// The first vertex is merged into the second.
    Contraction(u32, u32),
    /// An edge is split.
    Split(Split),
}

/// Slots of a group of tets, and the rows and labels of one that fills the same space.
#[derive(Debug)]
pub struct Replacement {
    old: Vec<u32>,
    new: Vec<([u32; 4], Label)>,
}

/// An edge with the tets around it and the place and sides of the vertex that splits it.
#[derive(Debug)]
pub struct Split {
    ends: [u32; 2],
    shell: Vec<u32>,
    place: DVec3,
    sides: Vec<Side>,
}

impl Split {
    fn make(self, mesh: &mut ImprovementMesh) {
        insert(mesh, &self.ends, &self.shell, self.place, self.sides);
    }
}

impl Transformation {
    /// The first transformation of a tet, in the order of their cost, that gains enough; `slack` is how far a new surface vertex may stay
    /// off its surface, mm, `ball` a scratch buffer. It is found from the tets at the vertices of [`append_vertices_around_tet`]. Edges
    /// that are `unsplit`, lower vertex first, are known not to gain by a split, which depends on the tets around them only.
    pub fn plan(
        mesh: &ImprovementMesh,
        t: u32,
        slack: f64,
        unsplit: impl Fn([u32; 2]) -> bool,
        ball: &mut Ball,
    ) -> Option<Self> {
        let tet = mesh.tets[t as usize];
        let edge = |at: usize| TET_EDGES[at].map(|v| tet[v]);
        let mut shells: [Vec<u32>; 6] = Default::default();
        for (at, shell) in shells.iter_mut().enumerate() {
            *shell = mesh.shell(edge(at)[0], edge(at)[1]);
            if let Some(removal) = edge_removal(mesh, edge(at), shell) {
                return Some(Self::EdgeRemoval(removal));
            }
        }
        let exchange = || (0..4).find_map(|face| face_exchange(mesh, t, face)).map(Self::FaceExchange);
        // Opposite edges have numbers that sum up to 5.
        let turn_at = |at: usize| surface_edge_turn(mesh, t, edge(at), [&shells[at], &shells[5 - at]]);
        let turn = || (0..6).find_map(turn_at).map(Self::Turn);
        let contraction = || one_contraction(mesh, t).map(|(from, to)| Self::Contraction(from, to));
        let split = || {
            let is_open = |at: &usize| !unsplit(sorted_edge(edge(*at)[0], edge(*at)[1]));
            let mut split_at = |at: usize| edge_split(mesh, edge(at), &shells[at], slack, ball);
            (0..6).filter(is_open).find_map(&mut split_at).map(Self::Split)
        };
        exchange().or_else(turn).or_else(contraction).or_else(split)
    }

    /// The tets that it changes.
    pub fn tets<'a>(&'a self, mesh: &'a ImprovementMesh) -> &'a [u32] {
        match self {
            Self::EdgeRemoval(replacement) | Self::FaceExchange(replacement) | Self::Turn(replacement) => {
                &replacement.old
            }
            Self::Contraction(from, _) => mesh.ball(*from),
            Self::Split(split) => &split.shell,
        }
    }

    /// Makes a transformation that was planned on the mesh as it is.
    pub fn make(self, mesh: &mut ImprovementMesh, counts: &mut TransformationCounts) {
        let (count, replacement) = match self {
            Self::EdgeRemoval(replacement) => (&mut counts.edge_removals, replacement),
            Self::FaceExchange(replacement) => (&mut counts.face_exchanges, replacement),
            Self::Turn(replacement) => (&mut counts.turned_edges, replacement),
            Self::Contraction(from, to) => {
                merge_into(mesh, from, to);
                counts.contractions += 1;
                return;
            }
            Self::Split(split) => {
                split.make(mesh);
                counts.splits += 1;
                return;
            }
        };
        mesh.replace(&replacement.old, &replacement.new);
        *count += 1;
    }
}

/// Appends the vertices whose tets tell how a tet can be transformed: those of the tets that share an edge with it, some more than once.
pub fn append_vertices_around_tet(mesh: &ImprovementMesh, t: u32, vertices: &mut Vec<u32>) {
    let tet = mesh.tets[t as usize];
    vertices.extend(tet);
    for (corner, v) in tet.into_iter().enumerate() {
        mesh.for_each_row(mesh.ball(v), |_, row| {
            let is_shared = row.map(|w| tet.contains(&w));
            // At its first corner in `tet` only.
            let is_first = tet[..corner].iter().all(|w| !row.contains(w));
            if is_first && is_shared.iter().filter(|is_shared| **is_shared).count() >= 2 {
                vertices.extend(row.into_iter().zip(is_shared).filter(|(_, is_shared)| !is_shared).map(|(w, _)| w));
            }
        });
    }
}

/// Lowest score of tets of one label, also where that is the scaffold's.
fn lowest_shape(mesh: &ImprovementMesh, tets: &[u32]) -> f64 {
    lowest_score(tets.iter().map(|t| (mesh.corners(*t), Part::Mesh)))
}

/// Makes a nearly flat tet of the scaffold better, so that its vertices can move.
pub fn loosen_scaffold(mesh: &mut ImprovementMesh, t: u32) {
    let tet = mesh.tets[t as usize];
    let removal = TET_EDGES.into_iter().find_map(|[a, b]| {
        let edge = [tet[a], tet[b]];
        edge_removal(mesh, edge, &mesh.shell(edge[0], edge[1]))
    });
    if let Some(Replacement { old, new }) = removal.or_else(|| (0..4).find_map(|face| face_exchange(mesh, t, face))) {
        mesh.replace(&old, &new);
    }
}

/// The best triangulation of the ring of an inner edge in place of its shell, where that is of one label and it gains.
fn edge_removal(mesh: &ImprovementMesh, edge: [u32; 2], shell: &[u32]) -> Option<Replacement> {
    let label = mesh.labels[*shell.first()? as usize];
    let is_within = shell.iter().all(|t| mesh.labels[*t as usize] == label);
    if is_within { ring_triangulation(mesh, edge, shell, label, f64::NEG_INFINITY) } else { None }
}

/// The best triangulation of the ring of an edge, all of one label, in place of its shell, where the lowest score gains and is above
/// `at_least`.
fn ring_triangulation(
    mesh: &ImprovementMesh,
    [a, b]: [u32; 2],
    shell: &[u32],
    label: Label,
    at_least: f64,
) -> Option<Replacement> {
    if shell.len() < 3 || shell.len() > LONGEST_RING {
        return None;
    }
    let ring = mesh.ring(a, b, shell)?;
    let needed = (lowest_shape(mesh, shell) + LEAST_GAIN).max(at_least);
    let triangles = best_triangulation(mesh, [a, b], &ring, needed)?;
    let mut new = Vec::with_capacity(2 * triangles.len());
    for [i, j, k] in triangles {
        let [p, q, r] = [ring[i], ring[j], ring[k]];
        new.push(([p, q, r, b], label));
        new.push(([q, p, r, a], label));
    }
    // The new inner faces must not exist elsewhere: an edge between ring vertices outside of the shell would meet them.
    (!creates_known_edge(mesh, &ring, &new)).then_some(Replacement { old: shell.to_vec(), new })
}

/// Whether a new edge between ring vertices that are not neighbours on the ring is an edge already.
pub fn creates_known_edge(mesh: &ImprovementMesh, ring: &[u32], new: &[([u32; 4], Label)]) -> bool {
    let n = ring.len();
    let beside = |i: usize, j: usize| (i + 1) % n == j || (j + 1) % n == i;
    for i in 0..n {
        for j in i + 1..n {
            let [p, q] = [ring[i], ring[j]];
            let used = !beside(i, j) && new.iter().any(|(tet, _)| tet.contains(&p) && tet.contains(&q));
            if used && mesh.ball(p).iter().any(|t| mesh.tets[*t as usize].contains(&q)) {
                return true;
            }
        }
    }
    false
}

/// [Klincsek1980]: the triangulation of the ring with the highest lowest score, above `needed`.
pub fn best_triangulation(
    mesh: &ImprovementMesh,
    [a, b]: [u32; 2],
    ring: &[u32],
    needed: f64,
) -> Option<Vec<[usize; 3]>> {
    let n = ring.len();
    let at = |v: u32| mesh.points[v as usize];
    let mut best = [[f64::INFINITY; LONGEST_RING]; LONGEST_RING];
    let mut middle = [[0usize; LONGEST_RING]; LONGEST_RING];
    for width in 2..n {
        for i in 0..n - width {
            let k = i + width;
            best[i][k] = f64::NEG_INFINITY;
            for j in i + 1..k {
                let mut score = best[i][j].min(best[j][k]);
                if score <= best[i][k].max(needed) {
                    continue;
                }
                let [p, q, r] = [at(ring[i]), at(ring[j]), at(ring[k])];
                score = score.min(tet_score([p, q, r, at(b)]));
                if score > best[i][k].max(needed) {
                    score = score.min(tet_score([q, p, r, at(a)]));
                }
                if score > best[i][k] {
                    best[i][k] = score;
                    middle[i][k] = j;
                }
            }
        }
    }
    if best[0][n - 1] <= needed {
        return None;
    }
    let mut triangles = Vec::with_capacity(n - 2);
    let mut spans = vec![(0, n - 1)];
    while let Some((i, k)) = spans.pop() {
        if k - i >= 2 {
            let j = middle[i][k];
            triangles.push([i, j, k]);
            spans.push((i, j));
            spans.push((j, k));
        }
    }
    Some(triangles)
}

/// Two tets of one label to three around the line between their apexes.
fn face_exchange(mesh: &ImprovementMesh, t: u32, face: usize) -> Option<Replacement> {
    let other = mesh.neighbor(t, face)?;
    let label = mesh.labels[t as usize];
    if mesh.labels[other as usize] != label {
        return None;
    }
    let tet = mesh.tets[t as usize];
    let [p, q, r] = TET_FACES[face].map(|v| tet[v]);
    let inner = tet[face];
    let outer = mesh.tets[other as usize].into_iter().find(|v| ![p, q, r].contains(v))?;
    if mesh.ball(inner).iter().any(|t| mesh.tets[*t as usize].contains(&outer)) {
        return None;
    }
    // The face p q r is outward from `inner`, so p, q, inner, outer is positive where the three new tets fill the old two.
    let new = [[p, q, inner, outer], [q, r, inner, outer], [r, p, inner, outer]].map(|tet| (tet, label));
    let needed = lowest_shape(mesh, &[t, other]) + LEAST_GAIN;
    let is_low = |(tet, _): &([u32; 4], Label)| tet_score(tet.map(|v| mesh.points[v as usize])) <= needed;
    (!new.iter().any(is_low)).then(|| Replacement { old: vec![t, other], new: new.to_vec() })
}

/// Vertices joined to `v` by an edge, sorted.
fn link_vertices(mesh: &ImprovementMesh, v: u32) -> Vec<u32> {
    let mut link: Vec<u32> = mesh.ball(v).iter().flat_map(|t| mesh.tets[*t as usize]).filter(|w| *w != v).collect();
    link.sort_unstable();
    link.dedup();
    link
}

fn common(left: &[u32], right: &[u32]) -> usize {
    left.iter().filter(|v| right.binary_search(v).is_ok()).count()
}

/// A vertex of the tet that is to be merged into another one of it, the first of the twelve ways that gains enough.
fn one_contraction(mesh: &ImprovementMesh, t: u32) -> Option<(u32, u32)> {
    let tet = mesh.tets[t as usize];
    tet.into_iter().find_map(|from| {
        // The ball is looked at only for an edge that may be contracted at all.
        let mut threshold = None;
        let mut is_good = |to: &u32| {
            let needed = threshold.get_or_insert_with(|| Threshold::of(mesh.lowest(mesh.ball(from)) + LEAST_GAIN));
            contraction_is_good(mesh, from, *to, needed)
        };
        let mut others = tet.into_iter().filter(|to| *to != from && may_contract(mesh, from, *to));
        others.find(|to| is_good(to)).map(|to| (from, to))
    })
}

/// Whether `from` may be merged into `to` as far as the vertices themselves say: a surface vertex only into one that separates
/// the same sides and more.
pub fn may_contract(mesh: &ImprovementMesh, from: u32, to: u32) -> bool {
    !mesh.fixed[from as usize] && mesh.sides_within(from, to)
}

/// Merges `from` into `to` where all changed tets reach the threshold; [`may_contract`] has said yes.
pub fn contract_edge(mesh: &mut ImprovementMesh, from: u32, to: u32, needed: &Threshold) -> bool {
    let is_good = contraction_is_good(mesh, from, to, needed);
    if is_good {
        merge_into(mesh, from, to);
    }
    is_good
}

/// Whether [`contract_edge`] would merge two vertices: a question about their tets and the corners of these only.
pub fn contraction_is_good(mesh: &ImprovementMesh, from: u32, to: u32, needed: &Threshold) -> bool {
    let place = |v: u32| mesh.points[if v == from { to } else { v } as usize];
    // Quality fails far more often than topology, and at the first tets.
    let is_good = |t: &u32| {
        let tet = mesh.tets[*t as usize];
        let [a, b, c, d] = tet;
        tet.contains(&to) || !part_fails([place(a), place(b), place(c), place(d)], mesh.part(*t), needed)
    };
    let stays = |t: &u32| !mesh.tets[*t as usize].contains(&to);
    mesh.ball(from).iter().all(is_good) && contraction_is_safe(mesh, from, to) && mesh.ball(from).iter().any(stays)
}

/// Merges `from` into `to`, whatever comes of it.
pub fn merge_into(mesh: &mut ImprovementMesh, from: u32, to: u32) {
    let old: Vec<u32> = mesh.ball(from).to_vec();
    let kept =
        old.iter().map(|t| (mesh.tets[*t as usize], mesh.labels[*t as usize])).filter(|(tet, _)| !tet.contains(&to));
    let new: Vec<_> = kept.map(|(tet, label)| (tet.map(|v| if v == from { to } else { v }), label)).collect();
    mesh.replace(&old, &new);
}

fn contraction_is_safe(mesh: &ImprovementMesh, from: u32, to: u32) -> bool {
    let shell = mesh.shell(from, to);
    // The vertices joined to both ends must be those around the edge, or the contraction would glue distant parts.
    let mut around: Vec<u32> =
        shell.iter().flat_map(|t| mesh.tets[*t as usize]).filter(|v| *v != from && *v != to).collect();
    around.sort_unstable();
    around.dedup();
    common(&link_vertices(mesh, from), &link_vertices(mesh, to)) == around.len()
        && (!mesh.is_on_surface(from) || surface_contraction_is_safe(mesh, from, to, &shell))
}

/// A surface vertex may be merged along a surface edge into a vertex that separates the same sides and more, when the
/// triangles keep their direction. A vertex on a line where surfaces meet is merged along that line only.
fn surface_contraction_is_safe(mesh: &ImprovementMesh, from: u32, to: u32, shell: &[u32]) -> bool {
    if !mesh.is_surface_edge(from, to, shell) {
        return false;
    }
    let faces = mesh.surface_faces(from);
    let near = neighbors_in(&faces);
    let faces_to = mesh.surface_faces(to);
    let near_to = neighbors_in(&faces_to);
    // The vertices joined to both ends through surfaces are those of the triangles at the edge, or a surface would fold
    // onto itself.
    let at_edge = faces.iter().filter(|f| f.others.contains(&to)).count();
    if common(&near, &near_to) != at_edge {
        return false;
    }
    let at = |v: u32| mesh.points[v as usize];
    let may_bend = at(from).distance(at(to)) < NOISE * mesh.surface.spacing().min_element();
    if mesh.sides(from).len() > 2 && !lies_along_line(mesh, from, to, &near, may_bend) {
        return false;
    }
    // Nor may a face that stays fall on another one: a piece that four faces bound, as a single tet, would vanish.
    let has_at =
        |faces: &[SurfaceFace], [p, q]: [u32; 2]| faces.iter().any(|f| f.others == [p, q] || f.others == [q, p]);
    if faces.iter().any(|f| !f.others.contains(&to) && has_at(&faces_to, f.others)) {
        return false;
    }
    let keeps_direction = |f: &&SurfaceFace| {
        let [p, q] = f.others.map(at);
        let before = (p - at(from)).cross(q - at(from)).normalize_or_zero();
        let after = (p - at(to)).cross(q - at(to)).normalize_or_zero();
        before.dot(after) > SMALLEST_NORMAL_COSINE
    };
    let stay = || faces.iter().filter(|f| !f.others.contains(&to));
    let with = |v: u32, f: &SurfaceFace| Some(([v, f.others[0], f.others[1]], mesh.labels_beside(v, f)?));
    stay().all(|f| may_bend || keeps_direction(&f))
        && !cuts_off(mesh, faces.iter().filter_map(|f| with(from, f)), stay().filter_map(|f| with(to, f)))
}

/// Whether the surface would cut off more than it may if the faces after took the place of those before, each with the labels
/// of its sides; where it already did, more than before.
fn cuts_off(
    mesh: &ImprovementMesh,
    before: impl Iterator<Item = LabelledFace> + Clone,
    after: impl Iterator<Item = LabelledFace>,
) -> bool {
    let limit = LARGEST_CUT * mesh.surface.spacing().min_element();
    // What is there before and after is no reason.
    let worst = worst_new_cut(mesh, before.clone(), after);
    worst > limit && worst > worst_cut(mesh, before)
}

/// Whether a vertex is in the middle of a line where surfaces meet, `to` is next to it, and the line bends little there or may bend.
fn lies_along_line(mesh: &ImprovementMesh, from: u32, to: u32, near: &[u32], may_bend: bool) -> bool {
    let is_on_line = |w: &u32| {
        mesh.sides_within(from, *w) && {
            let sides = sides_of_edge(mesh, from, *w, &mesh.shell(from, *w));
            sides.len() == mesh.sides(from).len() && sides.iter().all(|s| mesh.sides(from).contains(s))
        }
    };
    let line: Vec<u32> = near.iter().copied().filter(is_on_line).collect();
    let [first, second] = line[..] else { return false };
    let before = match to {
        t if t == first => second,
        t if t == second => first,
        _ => return false,
    };
    let at = |v: u32| mesh.points[v as usize];
    let (arriving, leaving) = (at(from) - at(before), at(to) - at(from));
    // Where the other neighbour is joined to `to` the line would close to a triangle and vanish.
    (may_bend || arriving.normalize_or_zero().dot(leaving.normalize_or_zero()) > SMALLEST_NORMAL_COSINE)
        && mesh.shell(before, to).is_empty()
}

/// Sides of a vertex in the middle of an edge. An edge between two vertices on a border plane lies in it, and its middle has
/// to stay there, also where only the scaffold has faces in the plane: the outside of both may not move.
pub fn sides_of_edge(mesh: &ImprovementMesh, a: u32, b: u32, shell: &[u32]) -> Vec<Side> {
    if !mesh.is_surface_edge(a, b, shell) {
        return Vec::new();
    }
    let inside = |t: &&u32| mesh.part(**t) == Part::Mesh;
    let is_open = !shell.iter().all(|t| inside(&t)) || mesh.ring(a, b, shell).is_none();
    let mut sides: Vec<Side> = shell.iter().filter(inside).map(|t| Side::Label(mesh.labels[*t as usize])).collect();
    if is_open {
        // Behind an open face is the border where all its vertices are on it, else the background.
        for face in mesh.surface_faces(a).iter().filter(|f| f.outer.is_none() && f.others.contains(&b)) {
            let is_on = |side: &&Side| face.others.iter().all(|v| mesh.sides(*v).contains(side));
            let border = mesh.sides(a).iter().filter(|s| matches!(s, Side::Border(_))).find(is_on);
            sides.push(border.copied().unwrap_or(Side::Label(Label::BACKGROUND)));
        }
        let is_plane = |side: &&Side| matches!(side, Side::Border(_)) && mesh.sides(b).contains(side);
        sides.extend(mesh.sides(a).iter().filter(is_plane));
    }
    sides.sort_unstable();
    sides.dedup();
    sides
}

/// The split of an edge with the tets of its shell at its middle when that, with the new vertex optimised, scores higher.
pub fn edge_split(
    mesh: &ImprovementMesh,
    [a, b]: [u32; 2],
    shell: &[u32],
    slack: f64,
    ball: &mut Ball,
) -> Option<Split> {
    let needed = mesh.lowest(shell) + LEAST_GAIN;
    // The angle of a tet at the edge opposite to the split one is shared by its two halves, wherever the new vertex goes.
    if shell.iter().any(|t| mesh.part(*t) == Part::Mesh && 0.5 * opposite_angle(mesh, *t, a, b) < needed) {
        return None;
    }
    split_above(mesh, [a, b], shell, [needed, slack], ball)
}

/// The split of an edge with the tets of its shell in its middle, on the surface where it lies on one, where the tets of the new vertex
/// score above what is needed once that is optimised; not one of the scaffold alone. `ball` is a scratch buffer.
fn split_above(
    mesh: &ImprovementMesh,
    [a, b]: [u32; 2],
    shell: &[u32],
    [needed, slack]: [f64; 2],
    ball: &mut Ball,
) -> Option<Split> {
    if shell.iter().all(|t| mesh.part(*t) == Part::Scaffold) {
        return None;
    }
    let sides = sides_of_edge(mesh, a, b, shell);
    let [from, to] = [a, b].map(|v| mesh.points[v as usize]);
    let mut middle = from.midpoint(to);
    if !sides.is_empty() {
        // Only where the surface passes by: a surface vertex off its surface helps nobody.
        middle = mesh.surface.project(middle, &sides, 0.5 * from.distance(to))?;
    }
    mesh.gather_split(shell, &[a, b], ball);
    let (place, score) = better_place(mesh, middle, &sides, [ENOUGH, slack], ball);
    (score > needed).then_some(Split { ends: [a, b], shell: shell.to_vec(), place, sides })
}

/// Splits an edge of the mesh in its middle, on the surface where it lies on one, where the tets of the new vertex score above what is
/// needed.
pub fn split_edge(mesh: &mut ImprovementMesh, a: u32, b: u32, needed: f64, slack: f64) -> bool {
    let shell = mesh.shell(a, b);
    let found = mesh.with_scratch(|mesh, ball| split_above(mesh, [a, b], &shell, [needed, slack], ball));
    found.map(|split| split.make(mesh)).is_some()
}

/// Dihedral angle of a tet at the edge opposite to a b, degrees.
fn opposite_angle(mesh: &ImprovementMesh, t: u32, a: u32, b: u32) -> f64 {
    let [c, d] = ordered_rest(mesh.tets[t as usize], a, b).map(|v| mesh.points[v as usize]);
    let [a, b] = [a, b].map(|v| mesh.points[v as usize]);
    let along = d - c;
    let [p, q] = [a - c, b - c].map(|side| along.cross(side));
    p.angle_between(q).to_degrees()
}

/// Splits an edge or a face, whose tets are `tets`, by a new vertex of the given sides; keeps it where `is_good` says so.
pub fn insert_between(
    mesh: &mut ImprovementMesh,
    corners: &[u32],
    tets: &[u32],
    place: DVec3,
    sides: Vec<Side>,
    is_good: impl FnOnce(&mut ImprovementMesh, u32) -> bool,
) -> bool {
    let trial = mesh.begin_trial();
    let m = insert(mesh, corners, tets, place, sides);
    if is_good(mesh, m) {
        mesh.keep_trial();
        return true;
    }
    mesh.take_back(trial);
    false
}

/// Splits an edge or a face, whose tets are `tets`; returns the new vertex.
fn insert(mesh: &mut ImprovementMesh, corners: &[u32], tets: &[u32], place: DVec3, sides: Vec<Side>) -> u32 {
    let m = mesh.add_vertex(place, sides);
    let mut new = Vec::with_capacity(corners.len() * tets.len());
    for (tet, label) in mesh.rows(tets) {
        new.extend(corners.iter().map(|corner| (tet.map(|v| if v == *corner { m } else { v }), label)));
    }
    mesh.replace(tets, &new);
    m
}

/// A tet with two faces on one surface, around the edge a b, goes to the other side; with the shells of that edge and of the opposite one.
fn surface_edge_turn(
    mesh: &ImprovementMesh,
    t: u32,
    [a, b]: [u32; 2],
    [shell, shell_of_turned]: [&[u32]; 2],
) -> Option<Replacement> {
    let tet = mesh.tets[t as usize];
    let label = mesh.labels[t as usize];
    // The edge that comes in place of a b lies inside, or the surface would not stay a surface: most do not.
    if shell_of_turned.iter().any(|n| mesh.labels[*n as usize] != label) {
        return None;
    }
    let [c, d] = {
        let mut rest = tet.into_iter().filter(|v| *v != a && *v != b);
        [rest.next().unwrap_or(a), rest.next().unwrap_or(b)]
    };
    let face_of = |v: u32| tet.iter().position(|w| *w == v).unwrap_or(0);
    let behind = [c, d].map(|v| mesh.neighbor(t, face_of(v)));
    let inside = [a, b].map(|v| mesh.neighbor(t, face_of(v)));
    if inside.iter().any(|n| n.is_none_or(|n| mesh.labels[n as usize] != label)) {
        return None;
    }
    // a b is an edge of exactly two surface faces.
    if mesh.is_surface_edge(c, d, shell_of_turned) {
        return None;
    }
    let at = |v: u32| mesh.points[v as usize];
    let normal = |p: u32, q: u32, r: u32| (at(q) - at(p)).cross(at(r) - at(p)).normalize_or_zero();
    let before = [normal(a, b, c), normal(b, a, d)];
    let after = [normal(c, d, b), normal(d, c, a)];
    // All four triangles look the same way when the tet is flat; the sign of the order cancels.
    let flat = before[0].dot(before[1]) > SMALLEST_NORMAL_COSINE
        && after[0].dot(after[1]) > SMALLEST_NORMAL_COSINE
        && before[0].dot(after[0]).abs() > SMALLEST_NORMAL_COSINE;
    // Two labels only meet at a b and one at c d, so no junction line is touched; the image border keeps its own edges.
    let at_border = |v: u32| mesh.sides(v).iter().any(|s| matches!(s, Side::Border(_)));
    let must_stay = |v: u32| mesh.fixed[v as usize] || at_border(v) && mesh.sides(v).len() > 2;
    if !flat || [a, b, c, d].into_iter().any(must_stay) {
        return None;
    }
    match behind {
        [None, None] => {
            // Outside of the mesh: nothing is left to be flat. Both ends keep other tets, or they would be lost.
            if shell.len() < 2 || mesh.ball(a).len() < 2 || mesh.ball(b).len() < 2 {
                return None;
            }
            Some(Replacement { old: vec![t], new: Vec::new() })
        }
        [Some(first), Some(second)] if mesh.labels[first as usize] == mesh.labels[second as usize] => {
            let other = mesh.labels[first as usize];
            if shell.iter().any(|n| *n != t && mesh.labels[*n as usize] != other) {
                return None;
            }
            let sides = [label, other];
            if cuts_off(
                mesh,
                [([a, b, c], sides), ([a, b, d], sides)].into_iter(),
                [([c, d, a], sides), ([c, d, b], sides)].into_iter(),
            ) {
                return None;
            }
            // As part of the other side it is in the way no more, or harms nobody there.
            let score = lowest_shape(mesh, &[t]);
            let removal = ring_triangulation(mesh, [a, b], shell, other, score);
            // A scaffold may be flat, and the ends of the edge keep other tets, or they would be lost.
            let is_used = |v: u32| mesh.ball(v).iter().any(|n| *n != t && mesh.part(*n) == Part::Mesh);
            let may_stay = || part_of(other) == Part::Scaffold && score >= SCAFFOLD_ANGLE && is_used(a) && is_used(b);
            removal.or_else(|| may_stay().then(|| Replacement { old: vec![t], new: vec![(tet, other)] }))
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
    use crate::geometry::tetrahedron::volume6;
    use crate::index::VertexId;
    use crate::lattice::boundary_targets::SourcePoints;
    use crate::lattice::candidate_mesh::CandidateMesh;
    use crate::lattice::face_adjacency::neighbors_of;
    use crate::lattice::scaffold::Scaffold;
    use crate::lattice::subvoxel_surface::SubvoxelSurface;
    use crate::lattice::test_images::voxel_image;
    use crate::lattice::test_meshes::{with_edge_on_ball, with_tets};

    #[test]
    fn no_split_scores_more_than_half_the_angle_opposite_to_its_edge() {
        // A flat tet alone; the edge 0 1 is split at places all over it.
        let points = vec![DVec3::ZERO, DVec3::new(1.0, 0.2, 0.1), DVec3::new(0.4, 0.9, 0.0), DVec3::new(0.6, 0.5, 0.3)];
        let image = voxel_image(6, |_| 1);
        let surface = SubvoxelSurface::new(&image, &RunContext::with_threads(1).unwrap()).unwrap();
        let tets = vec![[0, 1, 2, 3].map(VertexId)];
        let mut mesh =
            CandidateMesh { points: points.clone(), tets, tet_labels: vec![Label(1)], ..CandidateMesh::default() };
        let work = ImprovementMesh::new(&mut mesh, &SourcePoints::default(), surface);
        let bound = 0.5 * opposite_angle(&work, 0, 0, 1);
        assert!((bound - 0.5 * opposite_angle(&work, 0, 1, 0)).abs() < 1e-9);
        let mut best = f64::NEG_INFINITY;
        for n in 0..1000 {
            let weights = [n % 10, n / 10 % 10, n / 100, 5].map(|w| f64::from(w) + 0.5);
            let sum: f64 = weights.iter().sum();
            let m = points.iter().zip(weights).map(|(p, w)| *p * (w / sum)).sum::<DVec3>();
            let halves = [[m, points[1], points[2], points[3]], [points[0], m, points[2], points[3]]];
            best = halves.map(tet_score).into_iter().fold(f64::INFINITY, f64::min).max(best);
        }
        assert!(best > 0.5 * bound && best <= bound + 1e-4, "{best} {bound}");
    }

    #[test]
    fn a_split_is_known_to_the_last_bit_before_it_is_made() {
        for order in [[0, 1, 2, 3], [2, 0, 3, 1], [3, 2, 1, 0]] {
            with_edge_on_ball(0.4, order, |mut mesh| {
                let shell = mesh.shell(0, 1);
                let counts = (mesh.points.len(), mesh.tets.len());
                assert!(!split_edge(&mut mesh, 0, 1, 90.0, 0.1));
                assert_eq!((mesh.points.len(), mesh.tets.len()), counts);
                let figures = |ball: &mut Ball, at: DVec3| (ball.score(at), ball.edge_length(at), ball.center());
                let sides = sides_of_edge(&mesh, 0, 1, &shell);
                let place = DVec3::new(8.25, 12.8, 8.2);
                let mut ball = Ball::default();
                mesh.gather_split(&shell, &[0, 1], &mut ball);
                let before = figures(&mut ball, place);
                let m = insert(&mut mesh, &[0, 1], &shell, place, sides);
                mesh.gather(m, &mut ball);
                assert_eq!(figures(&mut ball, place), before);
                assert!(before.0 > 0.0 && (mesh.lowest(mesh.ball(m)) - before.0).abs() < 1e-9, "{before:?}");
            });
        }
    }

    #[test]
    fn the_middle_of_an_edge_in_a_border_plane_stays_there_where_only_the_scaffold_has_faces_in_it() {
        // The edge 0 1 lies in the plane x = -0.5; a tet of the mesh stands on it, scaffold tets lean on both sides of that.
        let image = voxel_image(6, |p| u16::from(p.x < 3.0));
        let context = RunContext::with_threads(1).unwrap();
        let surface = SubvoxelSurface::new(&image, &context).unwrap();
        let points = vec![
            DVec3::new(-0.5, 2.0, 2.0),
            DVec3::new(-0.5, 2.0, 3.0),
            DVec3::new(0.5, 1.6, 2.5),
            DVec3::new(0.5, 2.4, 2.5),
        ];
        let scaffold = Scaffold {
            points: vec![DVec3::new(-0.5, 1.0, 2.5), DVec3::new(-0.5, 3.0, 2.5)],
            tets: vec![[0, 1, 4, 2].map(VertexId), [0, 1, 3, 5].map(VertexId)],
        };
        let mut mesh = CandidateMesh {
            points,
            tets: vec![[0, 1, 2, 3].map(VertexId)],
            tet_labels: vec![Label(1)],
            scaffold,
            ..CandidateMesh::default()
        };
        let alone = [[u32::MAX; 4]];
        let sources =
            SourcePoints::new(&mesh.points, &mesh.tets, &mesh.tet_labels, &alone, &surface, &[0], &context).unwrap();
        let expected = [Side::Label(Label(0)), Side::Label(Label(1)), Side::Border(0)];
        assert_eq!(sources.sides(0), expected);
        assert_eq!(sources.sides(2), &expected[..2]);
        let work = ImprovementMesh::new(&mut mesh, &sources, surface);
        assert_eq!(sides_of_edge(&work, 0, 1, &work.shell(0, 1)), expected);
    }

    #[test]
    fn a_piece_of_one_tet_is_not_contracted_away() {
        // A slender tet of label 2, whose edge 0 1 is the short one, in a larger tet turned against it: every set of its
        // corners makes a tet with the larger one's corners behind the others.
        let corners = [
            DVec3::new(2.0, 2.9, 2.5),
            DVec3::new(2.0, 3.1, 2.5),
            DVec3::new(3.5, 3.0, 2.0),
            DVec3::new(3.5, 3.0, 3.0),
        ];
        let middle = corners.iter().sum::<DVec3>() / 4.0;
        let points: Vec<DVec3> =
            corners.into_iter().chain(corners.iter().map(|c| middle + 4.0 * (middle - *c))).collect();
        let positive = |mut tet: [u32; 4]| {
            if volume6(tet.map(|v| points[v as usize])) < 0.0 {
                tet.swap(2, 3);
            }
            tet
        };
        let rows: Vec<[u32; 4]> =
            (1..16).map(|set| positive([0, 1, 2, 3].map(|v| if set >> v & 1 == 1 { v } else { 4 + v }))).collect();
        let tets: Vec<[VertexId; 4]> = rows.iter().map(|tet| tet.map(VertexId)).collect();
        let mut tet_labels = vec![Label(1); 14];
        tet_labels.push(Label(2));
        let image = voxel_image(6, |_| 1);
        let context = RunContext::with_threads(1).unwrap();
        let surface = SubvoxelSurface::new(&image, &context).unwrap();
        let neighbors = neighbors_of(&rows, points.len(), &context).unwrap();
        let sources = SourcePoints::new(&points, &tets, &tet_labels, &neighbors, &surface, &[], &context).unwrap();
        let mut mesh = CandidateMesh { points, tets, tet_labels, ..CandidateMesh::default() };
        let work = ImprovementMesh::new(&mut mesh, &sources, surface);
        let shell = work.shell(0, 1);
        assert!(work.is_surface_edge(0, 1, &shell));
        assert!(!surface_contraction_is_safe(&work, 0, 1, &shell));
    }

    #[test]
    fn an_edge_shorter_than_noise_is_contracted_whatever_turns() {
        // A cone on a ring of six between two labels, as high as its ring is wide: its triangles turn flat when the apex goes.
        let image = voxel_image(6, |p| if p.z < 3.0 { 1 } else { 2 });
        let is_safe = |scale: f64| {
            let at = |x: f64, y: f64, z: f64| DVec3::splat(3.0) + scale * DVec3::new(x, y, z);
            let on_ring = |i: u32| f64::from(i) * std::f64::consts::TAU / 6.0;
            let ring = (0..6).map(|i| at(on_ring(i).cos(), on_ring(i).sin(), 0.0));
            let points: Vec<DVec3> = ring.chain([at(0.0, 0.0, 2.0), at(0.0, 0.0, 6.0), at(0.0, 0.0, -4.0)]).collect();
            let pair = |i: u32| [([6, i, (i + 1) % 6, 7], Label(2)), ([6, i, (i + 1) % 6, 8], Label(1))];
            let tets: Vec<([u32; 4], Label)> = (0..6).flat_map(pair).collect();
            with_tets(points, &tets, &image, |mesh| surface_contraction_is_safe(&mesh, 6, 0, &mesh.shell(6, 0)))
        };
        // The slant is the root of five times as long as the scale.
        assert_eq!([0.044, 0.046].map(is_safe), [true, false]);
    }
}
