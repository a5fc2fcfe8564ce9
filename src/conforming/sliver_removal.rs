//! Removes bad tets by inserting a point into a small polyhedron around them.
//!
//! # Method
//! ```text
//!   configuration 1: the shell of the edge with the largest angle     the polyhedron's border faces are joined to a
//!   configuration 2: the shell of the opposite edge                   new point: its centroid, moved to where the worst
//!   configuration 3: both shells                                      new tet is best
//! ```
//! The same with the other two pairs of opposite edges, where asked for, or with the shells of any set of edges. The search for
//! the place begins at the centroid; between walls that nearly meet, where that is outside, at the deepest point of the
//! kernel, which may be thousands of times thinner than wide. Where no shell helps the worst tets, the polyhedron grows tet by
//! tet ([`plan_grown_insertion`]).
//!
//! The configuration whose worst new tet is best is taken, if that is better than the worst tet it replaces and not below
//! a floor. Without the floor, tets whose bad angles the surface forces would draw point after point, each a little
//! better than the last, until the thin places of the domain are full of small bad tets.
//!
//! # Source
//! [Drakopoulos2017] 4.9.3, figure 76; B.3 `angdfs`, `mdfs`, `ndfs`.
//!
//! # Differences
//! The thesis smooths the new point afterwards where slivers remain; here its place is searched before anything changes.
//!
//! # Invariants
//! Constrained faces bound the polyhedron; constrained faces, constrained edges and vertices inside it refuse it.

mod grown_cavity;

pub use grown_cavity::plan_grown_insertion;

use glam::DVec3;

use super::flip_criteria::TetMeasure;
use super::flips::{FlipScratch, Outcome, grade_of};
use super::smoothing::Star;
use super::spacing::Spacing;
use crate::geometry::star_kernel::StarKernel;
use crate::geometry::tetrahedron::dihedral_angles;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::{TET_EDGE_BETWEEN, TET_EDGES, TET_OPPOSITE_EDGES};
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::{ShellKind, ShellTet, collect_shell};

/// Most tets of a polyhedron.
const MAX_CAVITY: usize = 40;

/// Buffers of one thread.
#[derive(Debug, Clone, Default)]
pub struct SliverScratch {
    star: Star,
    kernel: StarKernel,
    shell: Vec<ShellTet>,
    cavity: Vec<TetId>,
    border: Vec<TetFace>,
    best: Vec<TetId>,
    /// Tets that a growing polyhedron may not let in.
    refused: Vec<TetId>,
    /// Border faces of a growing polyhedron with the grades of their tets.
    order: Vec<(f64, TetFace)>,
}

/// What an inserted point must keep to.
#[derive(Debug, Clone, Copy)]
pub struct InsertionLimits<'a> {
    /// No new tet is below this grade.
    pub floor: f64,
    /// Distances to the vertices around.
    pub spacing: Spacing<'a>,
    /// The size of the point.
    pub size: f64,
    /// Which polyhedra are tried.
    pub polyhedra: Polyhedra,
}

/// Which of the polyhedra around a tet are tried: unions of the shells of its edges.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Polyhedra {
    /// Those of the edge with the largest angle and of the opposite edge.
    OfLargestAngle,
    /// Those of the other pairs of opposite edges as well: where the surface holds the edges with the largest angles, theirs
    /// are the only polyhedra there are.
    OfEveryPair,
    /// All unions, with a place wherever there is one.
    OfEverySet,
}

/// Claims what an insertion starts from; the outcome where that is not to be had.
fn claim_start<S: TetStore + ?Sized>(store: &mut S, tet: TetId, vertex: VertexId) -> Option<Outcome> {
    if !store.is_live(tet) || store.is_ghost_tet(tet) {
        return Some(Outcome::NotApplicable);
    }
    (!store.try_claim(vertex) || !store.try_claim_tet(tet)).then_some(Outcome::ClaimLost)
}

/// Plans the insertion of `vertex` (a spare one without tets) that removes `tet`. The plan is in `flips`; the second
/// value is the place of the vertex, to be set before the commit.
pub fn plan_sliver_insertion<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    tet: TetId,
    vertex: VertexId,
    limits: InsertionLimits<'_>,
    measure: &M,
    scratch: &mut SliverScratch,
    flips: &mut FlipScratch,
) -> (Outcome, DVec3) {
    if let Some(refusal) = claim_start(store, tet, vertex) {
        return (refusal, DVec3::ZERO);
    }
    let angles = dihedral_angles(store.points_of(tet));
    let first = (0..6).max_by(|&i, &j| angles[i].total_cmp(&angles[j])).unwrap_or(0);
    let [c, d] = TET_OPPOSITE_EDGES[first];
    let second = TET_EDGE_BETWEEN[c][d];
    let opposite = |edge: usize| {
        let [a, b] = TET_OPPOSITE_EDGES[edge];
        TET_EDGE_BETWEEN[a][b]
    };
    let [third, fifth] =
        if first == 0 || second == 0 { [1, 2] } else { [0, if first == 1 || second == 1 { 2 } else { 1 }] };
    let [fourth, sixth] = [opposite(third), opposite(fifth)];
    // Sets of edges as bits, the most promising first.
    let of = |edges: [usize; 2]| 1u8 << edges[0] | 1 << edges[1];
    let likely = [
        of([first, first]),
        of([second, second]),
        of([first, second]),
        of([third, third]),
        of([fourth, fourth]),
        of([fifth, fifth]),
        of([sixth, sixth]),
        of([third, fourth]),
        of([fifth, sixth]),
    ];
    let count = if limits.polyhedra == Polyhedra::OfLargestAngle { 3 } else { likely.len() };
    let others = if limits.polyhedra == Polyhedra::OfEverySet { 1..1u8 << 6 } else { 0..0 };
    let others = others.filter(|set| !likely.contains(set));
    let mut best: Option<(f64, f64, DVec3)> = None;
    let mut last = Outcome::WorsensQuality;
    for set in likely[..count].iter().copied().chain(others) {
        let edges = (0..6).filter(|edge| set >> edge & 1 > 0);
        match gather(store, tet, edges, measure, scratch) {
            Outcome::Accepted => {}
            Outcome::ClaimLost => return (Outcome::ClaimLost, DVec3::ZERO),
            other => {
                last = other;
                continue;
            }
        }
        let graded = |&t: &TetId| grade_of(store, measure, store.vertices(t));
        let old = scratch.cavity.iter().map(graded).fold(f64::INFINITY, f64::min);
        let bound = best.map_or(limits.floor.max(old * (1.0 + 1e-6)), |(grade, ..)| grade);
        let Some((place, grade)) = best_place(store, tet, limits.polyhedra, measure, scratch) else {
            last = Outcome::WouldInvert;
            continue;
        };
        if grade > bound && scratch.keeps_distance(store, place, &limits) {
            best = Some((grade, old, place));
            scratch.best.clone_from(&scratch.cavity);
        }
    }
    let Some((grade, old, place)) = best else { return (last, DVec3::ZERO) };
    scratch.cavity.clone_from(&scratch.best);
    collect_border(store, scratch);
    scratch.write_plan(store, tet, vertex, (old, grade), flips);
    (Outcome::Accepted, place)
}

/// Plans the insertion of `vertex` that splits an edge of `tet`, from the middle of the edge on. No new tet is below
/// the worst that goes, or else below the floor. As [`plan_sliver_insertion`].
pub fn plan_edge_split<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    (tet, edge): (TetId, usize),
    vertex: VertexId,
    limits: InsertionLimits<'_>,
    measure: &M,
    scratch: &mut SliverScratch,
    flips: &mut FlipScratch,
) -> (Outcome, DVec3) {
    if let Some(refusal) = claim_start(store, tet, vertex) {
        return (refusal, DVec3::ZERO);
    }
    match gather(store, tet, std::iter::once(edge), measure, scratch) {
        Outcome::Accepted => {}
        other => return (other, DVec3::ZERO),
    }
    let graded = |&t: &TetId| grade_of(store, measure, store.vertices(t));
    let old = scratch.cavity.iter().map(graded).fold(f64::INFINITY, f64::min);
    let corners = store.points_of(tet);
    let middle = TET_EDGES[edge].map(|end| corners[end]).iter().sum::<DVec3>() / 2.0;
    // All tets around the edge see its middle.
    let (place, grade) = scratch.star.search(measure, middle);
    if grade < old.min(limits.floor) || !scratch.star.is_visible_from(place) {
        return (Outcome::WorsensQuality, DVec3::ZERO);
    }
    if !scratch.keeps_distance(store, place, &limits) {
        return (Outcome::WorsensQuality, DVec3::ZERO);
    }
    scratch.write_plan(store, tet, vertex, (old, grade), flips);
    (Outcome::Accepted, place)
}

/// The union of the shells of some edges of `tet`, claimed, in `cavity`, with its border and star.
fn gather<S: TetStore + ?Sized, M: TetMeasure>(
    store: &mut S,
    tet: TetId,
    edges: impl Iterator<Item = usize>,
    measure: &M,
    scratch: &mut SliverScratch,
) -> Outcome {
    scratch.cavity.clear();
    let mut shells = 0;
    for edge in edges {
        shells += 1;
        let [a, b] = TET_EDGES[edge];
        if store.is_edge_constrained(tet, a, b) {
            return Outcome::Constrained;
        }
        match collect_shell(store, ShellTet::new(tet, a, b), MAX_CAVITY, &mut scratch.shell) {
            ShellKind::Closed => {}
            ShellKind::Open => return Outcome::Constrained,
            ShellKind::TooLarge => return Outcome::NotApplicable,
        }
        for at in 0..scratch.shell.len() {
            let shell = scratch.shell[at];
            if store.is_face_constrained(TetFace::new(shell.tet, shell.c)) || store.is_ghost_tet(shell.tet) {
                return Outcome::Constrained;
            }
            let row = store.vertices(shell.tet);
            if !store.try_claim_all(&row) {
                return Outcome::ClaimLost;
            }
            if !scratch.cavity.contains(&shell.tet) {
                scratch.cavity.push(shell.tet);
            }
        }
    }
    collect_border(store, scratch);
    if shells > 1 && !scratch.keeps_all(store) {
        return Outcome::Constrained;
    }
    scratch.fill_star(store, measure);
    Outcome::Accepted
}

impl SliverScratch {
    /// Whether a point at `place` keeps its distance from the vertices of the border.
    fn keeps_distance<S: TetStore + ?Sized>(&self, store: &S, place: DVec3, limits: &InsertionLimits<'_>) -> bool {
        let keeps = |v: VertexId| limits.spacing.holds(limits.size, v, store.point(v).distance_squared(place));
        limits.spacing.is_free() || self.border.iter().all(|&side| store.face_vertices(side).into_iter().all(keeps))
    }

    /// The star of the border's faces.
    fn fill_star<S: TetStore + ?Sized, M: TetMeasure>(&mut self, store: &S, measure: &M) {
        self.star.faces.clear();
        self.star.weights.clear();
        for &side in &self.border {
            let vertices = store.face_vertices(side);
            let [a, b, c] = vertices.map(|v| store.point(v));
            self.star.faces.push([a, c, b]);
            self.star.weights.push(measure.weight(&vertices));
        }
    }

    /// The replacement of the cavity by the star of `vertex` over its border.
    fn write_plan<S: TetStore + ?Sized>(
        &self,
        store: &S,
        tet: TetId,
        vertex: VertexId,
        (old_grade, new_grade): (f64, f64),
        flips: &mut FlipScratch,
    ) {
        let plan = &mut flips.plan;
        plan.reset(store.label(tet));
        plan.old.extend_from_slice(&self.cavity);
        plan.new.extend(self.border.iter().map(|&side| {
            let [a, b, c] = store.face_vertices(side);
            [a, c, b, vertex]
        }));
        (plan.old_grade, plan.new_grade) = (old_grade, new_grade);
    }

    /// Whether no vertex, constrained face or constrained edge is inside the polyhedron. Within one shell there is nothing
    /// but the edge that it goes round.
    fn keeps_all<S: TetStore + ?Sized>(&self, store: &S) -> bool {
        let on_border = |ends: &[VertexId]| {
            self.border.iter().any(|&side| {
                let face = store.face_vertices(side);
                ends.iter().all(|v| face.contains(v))
            })
        };
        self.cavity.iter().all(|&tet| {
            let (row, flags, neighbors) = (store.vertices(tet), store.flags(tet), store.neighbors(tet));
            let is_wall = |face: usize| flags.is_face_constrained(face) && self.cavity.contains(&neighbors[face].tet());
            let is_lost = |edge: usize| {
                let [i, j] = TET_EDGES[edge];
                flags.is_edge_constrained(edge) && !on_border(&[row[i], row[j]])
            };
            row.iter().all(|&v| on_border(&[v]))
                && !(0..4).any(|face| neighbors[face] != TetFace::NONE && is_wall(face))
                && !(flags.has_constrained_edge() && (0..6).any(is_lost))
        })
    }
}

fn collect_border<S: TetStore + ?Sized>(store: &S, scratch: &mut SliverScratch) {
    scratch.border.clear();
    for &tet in &scratch.cavity {
        for (face, other) in store.neighbors(tet).into_iter().enumerate() {
            if other == TetFace::NONE || !scratch.cavity.contains(&other.tet()) {
                scratch.border.push(TetFace::new(tet, face));
            }
        }
    }
}

/// The best place for the point of the star in the scratch: from the centroid of the border, or of the sliver, or from the
/// deepest point of the kernel.
fn best_place<S: TetStore + ?Sized, M: TetMeasure>(
    store: &S,
    tet: TetId,
    polyhedra: Polyhedra,
    measure: &M,
    scratch: &mut SliverScratch,
) -> Option<(DVec3, f64)> {
    let SliverScratch { star, kernel, .. } = scratch;
    let centroid = star.faces.iter().map(|[a, b, c]| (*a + *b + *c) / 3.0).sum::<DVec3>() / star.faces.len() as f64;
    let sliver = store.points_of(tet).iter().sum::<DVec3>() / 4.0;
    let mut start = [centroid, sliver].into_iter().find(|start| star.is_visible_from(*start));
    if start.is_none() && polyhedra == Polyhedra::OfEverySet {
        start = kernel.deepest_point(&star.faces).filter(|start| star.is_visible_from(*start));
    }
    let start = start?;
    let (place, grade) = star.search(measure, start);
    let place = if star.is_visible_from(place) { place } else { start };
    Some((place, grade))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::flip_criteria::BiasedSine;
    use crate::conforming::flips::commit;
    use crate::conforming::test_meshes::random_mesh;
    use crate::mesh::tet_complex::TetComplex;

    const FREE: InsertionLimits<'_> =
        InsertionLimits { floor: 0.0, spacing: Spacing::FREE, size: 0.0, polyhedra: Polyhedra::OfLargestAngle };

    /// Constrains an edge in all tets that have it.
    fn hold_edge(complex: &mut TetComplex, ends: [VertexId; 2]) {
        let tets: Vec<TetId> = complex.live_tets().collect();
        for tet in tets {
            if let [Some(i), Some(j)] = ends.map(|v| complex.local_vertex(tet, v)) {
                complex.set_flags(tet, complex.flags(tet).with_edge(TET_EDGE_BETWEEN[i][j], true));
            }
        }
    }

    #[test]
    fn polyhedra_of_other_edges_help_where_the_worst_edge_is_held() {
        let mesh = random_mesh(11, 300);
        let worst = |tet: TetId| dihedral_angles(mesh.points_of(tet)).into_iter().fold(0.0, f64::max);
        let bad: Vec<TetId> = mesh.finite_tets().filter(|&tet| worst(tet) > 2.9).collect();
        let mut accepted = [0, 0];
        for tet in bad {
            for (number, every_edge) in [false, true].into_iter().enumerate() {
                let mut complex = mesh.clone();
                let spare = complex.push_point(DVec3::ZERO).unwrap();
                let angles = dihedral_angles(complex.points_of(tet));
                let first = (0..6).max_by(|&i, &j| angles[i].total_cmp(&angles[j])).unwrap();
                let held = TET_EDGES[first].map(|i| complex.vertices(tet)[i]);
                hold_edge(&mut complex, held);
                let polyhedra = if every_edge { Polyhedra::OfEveryPair } else { Polyhedra::OfLargestAngle };
                let limits = InsertionLimits { polyhedra, ..FREE };
                let (mut scratch, mut flips) = (SliverScratch::default(), FlipScratch::default());
                let (outcome, place) =
                    plan_sliver_insertion(&mut complex, tet, spare, limits, &BiasedSine, &mut scratch, &mut flips);
                if outcome != Outcome::Accepted {
                    continue;
                }
                accepted[number] += 1;
                complex.set_point(spare, place);
                commit(&mut complex, &mut flips).unwrap();
                complex.check_invariants().unwrap();
                complex.check_orientation().unwrap();
                let holds = |t: TetId| held.iter().all(|v| complex.local_vertex(t, *v).is_some());
                assert!(complex.live_tets().any(holds), "the held edge stays");
                assert!((0..300).all(|v| complex.tet_of(VertexId(v)) != TetId::NONE), "no vertex is lost");
            }
        }
        assert!(accepted[1] > accepted[0] && accepted[0] > 0, "{accepted:?}");
    }

    #[test]
    fn grown_polyhedra_better_what_they_replace_and_keep_held_edges() {
        let mesh = random_mesh(11, 300);
        let smallest = |tet: TetId| dihedral_angles(mesh.points_of(tet)).into_iter().fold(f64::INFINITY, f64::min);
        let bad: Vec<TetId> = mesh.finite_tets().filter(|&tet| smallest(tet) < 5.0).collect();
        let mut accepted = [0, 0];
        for (tet, is_held) in bad.iter().flat_map(|&tet| [(tet, false), (tet, true)]) {
            let mut complex = mesh.clone();
            let spare = complex.push_point(DVec3::ZERO).unwrap();
            let angles = dihedral_angles(complex.points_of(tet));
            let first = (0..6).max_by(|&i, &j| angles[i].total_cmp(&angles[j])).unwrap();
            let held = TET_EDGES[first].map(|i| mesh.vertices(tet)[i]);
            if is_held {
                hold_edge(&mut complex, held);
            }
            let grade = BiasedSine.grade(mesh.points_of(tet));
            let (mut scratch, mut flips) = (SliverScratch::default(), FlipScratch::default());
            let limits = (InsertionLimits { floor: 1.3 * grade, ..FREE }, 1.3);
            let (outcome, place) =
                plan_grown_insertion(&mut complex, (tet, spare), None, limits, &BiasedSine, &mut scratch, &mut flips);
            if outcome != Outcome::Accepted {
                continue;
            }
            accepted[usize::from(is_held)] += 1;
            let worst = |of: &TetComplex, tets: &[TetId]| {
                tets.iter().map(|&t| BiasedSine.grade(of.points_of(t))).fold(f64::INFINITY, f64::min)
            };
            let old = worst(&mesh, &flips.plan.old);
            complex.set_point(spare, place);
            commit(&mut complex, &mut flips).unwrap();
            complex.check_invariants().unwrap();
            complex.check_orientation().unwrap();
            assert!(worst(&complex, &flips.created) > 1.3 * old.max(grade));
            let holds = |t: TetId| held.iter().all(|v| complex.local_vertex(t, *v).is_some());
            assert!(!is_held || complex.live_tets().any(holds), "the held edge stays");
            assert!((0..300).all(|v| complex.tet_of(VertexId(v)) != TetId::NONE), "no vertex is lost");
        }
        assert!(accepted[0] > 3 && accepted[0] >= accepted[1], "{accepted:?} of {}", bad.len());
    }

    #[test]
    fn grown_polyhedra_keep_the_distance_asked_for() {
        let mesh = random_mesh(11, 300);
        let sizes: Vec<f64> = (0..300).map(|v| if v % 2 == 0 { 0.1 } else { 0.3 }).collect();
        let bad = mesh.finite_tets().filter(|&tet| BiasedSine.grade(mesh.points_of(tet)) < 0.1);
        let mut accepted = [0, 0];
        for tet in bad {
            for (number, factor) in [0.0, 0.5].into_iter().enumerate() {
                let mut complex = mesh.clone();
                let spare = complex.push_point(DVec3::ZERO).unwrap();
                let grade = BiasedSine.grade(mesh.points_of(tet));
                let (mut scratch, mut flips) = (SliverScratch::default(), FlipScratch::default());
                let spacing = Spacing { sizes: &sizes, factor, longest: f64::INFINITY };
                let limits =
                    InsertionLimits { floor: 1.3 * grade, spacing, size: 0.1, polyhedra: Polyhedra::OfEveryPair };
                let (outcome, place) = plan_grown_insertion(
                    &mut complex,
                    (tet, spare),
                    None,
                    (limits, 1.3),
                    &BiasedSine,
                    &mut scratch,
                    &mut flips,
                );
                if outcome == Outcome::Accepted {
                    accepted[number] += 1;
                    let around = flips.plan.new.iter().flatten().filter(|v| **v != spare);
                    let asked = |v: VertexId| 0.5 * factor * (0.1 + sizes[v.index()]);
                    assert!(around.into_iter().all(|v| mesh.point(*v).distance(place) >= asked(*v)));
                }
            }
        }
        assert!(accepted[0] > accepted[1] && accepted[1] > 0, "{accepted:?}");
    }
}
