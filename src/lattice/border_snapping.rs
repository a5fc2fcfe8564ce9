//! Vertices next to a plane that cuts the lattice go onto it, where that spoils no element and no label's topology.
//!
//! # Method
//! 1. Candidates are the vertices that are near the plane, measured along the edges that cross it.
//! 2. A move that brings an element of low score is taken back.
//! 3. The plane cuts what a label has around a vertex that is not on it in one piece, as it cut the vertex' edges. One on the plane is
//!    looked at: below the plane each label around it is to have one part, without holes, and each edge on the plane one fan of
//!    elements of each label. Then it is one disc on a small sphere around the vertex, or nothing: the tip of a label that reaches past
//!    the plane in one vertex goes with it. Where it is not so the vertex stays where it is.
//! 4. A vertex that may not go onto the plane goes away from it, as the parts of edges between it and the plane would be short: as far as
//!    one that is not near it would be, or a part of that where the lowest of what the plane leaves of its elements is less low then.
//!    Where that leaves low ones it goes to the side too: a pattern search with the same target. Labels keep their topology, as no
//!    vertex changes sides of a border; their surfaces are not smoothed yet.
//! ```text
//!     a a . v . b b       b   label in question, below the plane; v is to go onto the plane: the label would touch
//!      \ a / \ b /            itself in v, and what went through v be parted: v stays
//! ```
//! # Source
//! [LabelleShewchuk2007] for the move onto the surface before the cut, which bounds the angles; [HookeJeeves1961] for the search. The
//! topology is our own: what a plane that meets no vertex leaves of a body shrinks to what the vertices below span of it, so that only a
//! vertex that changes sides can change it, and does not where what it is joined with shrinks to a point.
//!
//! # Limits
//! Vertices that are on the plane already are not looked at, nor those with elements of one label only.
//!
//! # Cost
//! Vertices that go away are taken one after the other, as each sees where those beside it went; where a plane has many, those that share
//! no element could be taken at once.

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::lattice::border_clipping::{Clipping, lowest_left};
use crate::lattice::element_score::{Threshold, tet_fails, tet_score};
use crate::lattice::interface_topology::{labels_of, opposite_to, shape_of};
use crate::mesh::numbering::TET_EDGES;

/// A vertex whose distance to the plane is less than this part of an edge that crosses it moves onto the plane.
const NEAR: f64 = 0.3;

/// Score in degrees below which the move of a vertex onto the plane may bring no element that stays.
const LEAST_SCORE: f64 = 5.0;

/// Score in degrees that what is left of the elements of a vertex that goes away is to have. On disordered images that fill their box 5
/// left more for the improvement to raise, in vain at times, and took more time with it.
const LEAST_LEFT: f64 = 8.0;

/// Parts of the way away from the plane that are tried: small elements beside a large one leave no room for all of it.
const PARTS_AWAY: [f64; 4] = [1.0, 0.5, 0.25, 0.12];

/// Times that vertices away from the plane are looked at: at first the others around are near it yet. The first goes along the normal
/// only, which is enough for most.
const PASSES_AWAY: usize = 4;

/// Steps in any direction, as parts of all of the way along the normal: the first is half as long as the elements reach far on the other
/// side of the plane.
const STEPS_ANYWHERE: [f64; 5] = [1.2, 0.6, 0.3, 0.15, 0.07];

/// Steps of one length, at most.
const STEPS_OF_A_LENGTH: usize = 4;

/// Elements per parallel work item.
const CHUNK: usize = 4096;

/// A plane at a coordinate along an axis; what lies beyond it has positive heights.
#[derive(Debug, Clone, Copy)]
pub(super) struct Plane {
    pub(super) axis: usize,
    pub(super) at: f64,
    /// Whether what lies beyond has lower coordinates.
    pub(super) is_low: bool,
}

impl Plane {
    fn coordinate(&self, height: f64) -> f64 {
        if self.is_low { self.at - height } else { self.at + height }
    }

    /// Height of a point above the plane, mm: beyond it positive.
    pub(super) fn height(&self, point: DVec3) -> f64 {
        if self.is_low { self.at - point[self.axis] } else { point[self.axis] - self.at }
    }
}

/// Moves vertices onto a plane or away from it; `heights` are those of all vertices above it, which follow. Returns the vertices that
/// moved.
pub(super) fn move_vertices(work: &mut Clipping, heights: &mut [f64], plane: Plane) -> Vec<usize> {
    let near = near(work, heights);
    let mut moves = near.clone();
    loop {
        retain_harmless(work, &mut moves, heights, plane);
        let harmless = moves.clone();
        moves = Topology::new(work, heights, &harmless).kept(&harmless);
        // An element may have been well because more of its vertices moved.
        if moves.len() == harmless.len() {
            break;
        }
    }
    for &v in &moves {
        work.points[v][plane.axis] = plane.at;
        heights[v] = 0.0;
    }
    let stay: Vec<usize> = near.into_iter().filter(|v| moves.binary_search(v).is_err()).collect();
    moves.extend(move_away(work, heights, stay, plane));
    moves
}

/// Moves vertices near a plane away from it, as far as that makes what is left of their elements better; returns those that moved.
fn move_away(work: &mut Clipping, heights: &mut [f64], mut vertices: Vec<usize>, plane: Plane) -> Vec<usize> {
    let balls = balls_of(work, &vertices);
    let mut moved = Vec::new();
    for pass in 0..PASSES_AWAY {
        vertices.retain(|v| {
            let remains = Remains::new(work, heights, *v, &balls[&(*v as u32)], plane);
            let own = remains.scored(work.points[*v], f64::NEG_INFINITY);
            let mut best = remains.along_normal(own);
            if pass > 0 && best.score < LEAST_LEFT {
                best = remains.in_any_direction(best);
            }
            if best.place != own.place {
                work.points[*v] = best.place;
                heights[*v] = plane.height(best.place);
                moved.push(*v);
            }
            best.score < LEAST_LEFT
        });
    }
    moved.sort_unstable();
    moved.dedup();
    moved
}

/// A place for a vertex, and the lowest score of what the plane leaves of its elements then.
#[derive(Debug, Clone, Copy)]
struct Scored {
    place: DVec3,
    score: f64,
}

/// The elements of a vertex of which a plane leaves something.
struct Remains<'a> {
    work: &'a Clipping,
    heights: &'a [f64],
    plane: Plane,
    v: u32,
    tets: Vec<[u32; 4]>,
}

impl<'a> Remains<'a> {
    fn new(work: &'a Clipping, heights: &'a [f64], v: usize, ball: &[u32], plane: Plane) -> Self {
        let tets = ball.iter().map(|e| work.tets[*e as usize]);
        let tets = tets.filter(|tet| tet.iter().any(|w| heights[*w as usize] < 0.0)).collect();
        Self { work, heights, plane, v: v as u32, tets }
    }

    /// A place with its score, or with one that is not above a least.
    fn scored(&self, place: DVec3, least: f64) -> Scored {
        let height = self.plane.height(place);
        let height_of = |w: u32| if w == self.v { height } else { self.heights[w as usize] };
        let place_of = |w: u32| if w == self.v { place } else { self.work.points[w as usize] };
        let mut score = f64::INFINITY;
        for tet in &self.tets {
            score = lowest_left(tet.map(place_of), tet.map(height_of), self.plane).min(score);
            if score <= least {
                break;
            }
        }
        Scored { place, score }
    }

    /// The better of a place and one that has been found.
    fn better(&self, found: Scored, place: DVec3) -> Scored {
        let scored = self.scored(place, found.score);
        if scored.score > found.score { scored } else { found }
    }

    /// The height up to which the longest of the edges that cross the plane has the vertex near it.
    fn far(&self, height: f64) -> f64 {
        let others = self.tets.iter().flatten().map(|w| self.heights[*w as usize]);
        let across = others.filter(|other| other * height < 0.0).fold(0.0, |far: f64, other| far.max(other.abs()));
        across * NEAR / (1.0 - NEAR)
    }

    /// The best of some places along the normal.
    fn along_normal(&self, own: Scored) -> Scored {
        let height = self.plane.height(own.place);
        let far = self.far(height);
        let mut best = own;
        for part in PARTS_AWAY.into_iter().filter(|_| far > height.abs()) {
            let mut place = own.place;
            place[self.plane.axis] = self.plane.coordinate(height + part * (far.copysign(height) - height));
            best = self.better(best, place);
            if best.score >= LEAST_LEFT {
                break;
            }
        }
        best
    }

    /// The best of the places that a pattern search comes to.
    fn in_any_direction(&self, start: Scored) -> Scored {
        let far = self.far(self.plane.height(start.place));
        let mut best = start;
        for part in STEPS_ANYWHERE {
            for _ in 0..STEPS_OF_A_LENGTH {
                let from = best.place;
                for n in (0..27).filter(|n| *n != 13) {
                    let way = DVec3::new(f64::from(n % 3), f64::from(n / 3 % 3), f64::from(n / 9)) - 1.0;
                    best = self.better(best, self.work.beside_borders(from, from + part * far * way.normalize()));
                }
                if best.place == from {
                    break;
                }
            }
        }
        best
    }
}

/// Whether a tet fails a bound once its vertices have moved, and is worse than before.
fn is_lowered(before: [DVec3; 4], after: [DVec3; 4], bound: &Threshold) -> bool {
    tet_fails(after, bound) && tet_score(after) < tet_score(before)
}

/// Vertices next to the plane.
fn near(work: &Clipping, heights: &[f64]) -> Vec<usize> {
    let near_of = |tet: &[u32; 4]| {
        let crosses = tet.iter().any(|v| heights[*v as usize] > 0.0) && tet.iter().any(|v| heights[*v as usize] < 0.0);
        let tet = *tet;
        TET_EDGES.into_iter().filter(move |_| crosses).filter_map(move |edge| {
            let [a, b] = edge.map(|v| tet[v] as usize);
            let [low, high] = [heights[a].abs(), heights[b].abs()];
            let nearer = if low < high { a } else { b };
            let is_near = heights[a] * heights[b] < 0.0 && low.min(high) < NEAR * (low + high);
            (is_near && !work.fixed[nearer]).then_some(nearer)
        })
    };
    let mut near: Vec<usize> = work.tets.par_iter().with_min_len(CHUNK).flat_map_iter(near_of).collect();
    near.par_sort_unstable();
    near.dedup();
    near
}

/// Takes out vertices whose move onto the plane would spoil an element that stays: one beside a large element that crosses
/// the plane may have small elements too, which the move would turn over.
fn retain_harmless(work: &Clipping, near: &mut Vec<usize>, heights: &[f64], plane: Plane) {
    let mut moves = vec![false; work.points.len()];
    near.iter().for_each(|v| moves[*v] = true);
    let bound = Threshold::of(LEAST_SCORE);
    let is_spoiled = |tet: &&[u32; 4], moves: &[bool]| {
        let is_moved = |v: &u32| moves[*v as usize];
        let stays = tet.iter().any(|v| !is_moved(v) && heights[*v as usize] < 0.0);
        if !stays || !tet.iter().any(is_moved) {
            return false;
        }
        let before = tet.map(|v| work.points[v as usize]);
        let mut after = before;
        tet.iter().zip(&mut after).filter(|(v, _)| is_moved(v)).for_each(|(_, place)| place[plane.axis] = plane.at);
        is_lowered(before, after, &bound)
    };
    loop {
        let spoiled = work.tets.par_iter().with_min_len(CHUNK).filter(|tet| is_spoiled(tet, &moves));
        let back: Vec<u32> = spoiled.flat_map_iter(|tet| *tet).filter(|v| moves[*v as usize]).collect();
        if back.is_empty() {
            break;
        }
        back.into_iter().for_each(|v| moves[v as usize] = false);
    }
    near.retain(|v| moves[*v]);
}

/// The elements of some vertices.
fn balls_of(work: &Clipping, vertices: &[usize]) -> FxHashMap<u32, Vec<u32>> {
    let mut is_wanted = vec![false; work.points.len()];
    vertices.iter().for_each(|v| is_wanted[*v] = true);
    let elements = (0..work.tets.len() as u32).into_par_iter().with_min_len(CHUNK);
    let has_any = |e: &u32| work.tets[*e as usize].iter().any(|v| is_wanted[*v as usize]);
    let mut balls: FxHashMap<u32, Vec<u32>> = FxHashMap::default();
    for e in elements.filter(has_any).collect::<Vec<u32>>() {
        for v in work.tets[e as usize].into_iter().filter(|v| is_wanted[*v as usize]) {
            balls.entry(v).or_default().push(e);
        }
    }
    balls
}

/// Where a vertex is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    Below,
    On,
    Above,
}

/// What labels have around the vertices that may move.
struct Topology<'a> {
    work: &'a Clipping,
    places: Vec<Place>,
    /// Elements of the candidates with more than one label around them.
    balls: FxHashMap<u32, Vec<u32>>,
}

impl<'a> Topology<'a> {
    /// Before any candidate moves.
    fn new(work: &'a Clipping, heights: &[f64], candidates: &[usize]) -> Self {
        let place = |height: &f64| match *height {
            h if h < 0.0 => Place::Below,
            h if h > 0.0 => Place::Above,
            _ => Place::On,
        };
        let mut balls = balls_of(work, candidates);
        balls.retain(|_, ball| labels_of(ball, &work.labels).len() > 1);
        Self { work, places: heights.iter().map(place).collect(), balls }
    }

    /// Those of the candidates that can move one after the other.
    fn kept(mut self, candidates: &[usize]) -> Vec<usize> {
        let (mixed, plain): (Vec<usize>, Vec<usize>) =
            candidates.iter().partition(|v| self.balls.contains_key(&(**v as u32)));
        plain.iter().for_each(|v| self.places[*v] = Place::On);
        let mut kept = plain;
        kept.extend(mixed.into_iter().filter(|v| self.may_move(*v as u32)));
        kept.sort_unstable();
        kept
    }

    /// Moves a vertex onto the plane if it may.
    fn may_move(&mut self, v: u32) -> bool {
        let before = self.places[v as usize];
        self.places[v as usize] = Place::On;
        let ball = &self.balls[&v];
        let is_beside = |w: &u32| *w != v && self.places[*w as usize] == Place::On && self.balls.contains_key(w);
        let mut beside: Vec<u32> = ball.iter().flat_map(|e| self.work.tets[*e as usize]).filter(is_beside).collect();
        beside.sort_unstable();
        beside.dedup();
        let may = [v].into_iter().chain(beside).all(|w| self.is_whole(w));
        if !may {
            self.places[v as usize] = before;
        }
        may
    }

    /// Whether each label around a vertex on the plane has at most one part there below it, without holes, and one fan around each edge
    /// on the plane. All labels together are a body too, whose rest is the background.
    fn is_whole(&self, v: u32) -> bool {
        let ball = &self.balls[&v];
        let is_below = |w: u32| self.places[w as usize] == Place::Below;
        labels_of(ball, &self.work.labels).into_iter().all(|label| {
            let own = || {
                let is_own = |e: &&u32| self.work.labels[**e as usize].is_in_solid_of(label);
                ball.iter().filter(is_own).map(|e| opposite_to(v, self.work.tets[*e as usize]))
            };
            let (found, euler) = shape_of(own(), is_below);
            let mut on_plane: Vec<u32> = own().flatten().filter(|w| self.places[*w as usize] == Place::On).collect();
            on_plane.sort_unstable();
            on_plane.dedup();
            let has_one_fan = |w: u32| {
                let (mut ends, mut sides) = (Vec::new(), 0);
                for side in own().filter(|triangle| triangle.contains(&w)) {
                    let below = side.into_iter().filter(|u| *u != w && is_below(*u));
                    let count = ends.len();
                    ends.extend(below);
                    sides += usize::from(ends.len() == count + 2);
                }
                ends.sort_unstable();
                ends.dedup();
                ends.len() <= sides + 1
            };
            found <= 1 && euler == found && on_plane.into_iter().all(has_one_fan)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::tetrahedron::volume6;
    use crate::index::{Label, VertexId};
    use crate::lattice::bcc_lattice::PastBorder;
    use crate::lattice::candidate_mesh::CandidateMesh;
    use crate::lattice::mixed_elements::compact;
    use crate::lattice::test_images::{euler_numbers_where, foam, with_lattice_past};

    #[test]
    fn vertices_go_onto_the_plane_or_away_from_it_and_labels_keep_their_topology() {
        with_lattice_past(PastBorder::Continued, &foam(15), 1.7, |lattice, context| {
            let elements = lattice.elements(context).unwrap();
            let mut mesh = compact(&lattice, &elements, &[], true, context).unwrap();
            let mut work = Clipping::new(&mut mesh);
            let plane = Plane { axis: 2, at: -0.5, is_low: true };
            let mut heights: Vec<f64> = work.points.iter().map(|p| plane.at - p.z).collect();
            let before = heights.clone();
            let euler = |work: &Clipping, heights: &[f64]| {
                euler_numbers_where(&work.tets, &work.labels, |v| heights[v as usize] < 0.0)
            };
            let wanted = euler(&work, &heights);
            let moved = move_vertices(&mut work, &mut heights, plane);
            assert_eq!(euler(&work, &heights), wanted);
            let (on, away): (Vec<usize>, Vec<usize>) = moved.into_iter().partition(|v| heights[*v] == 0.0);
            assert!(on.len() > 50 && !away.is_empty(), "{} {}", on.len(), away.len());
            assert!(on.iter().all(|v| work.points[*v].z == plane.at));
            // On their own side, and where their heights are.
            let has_gone = |v: &usize| {
                heights[*v] / before[*v] > 1.0 && (plane.at - work.points[*v].z - heights[*v]).abs() < 1e-12
            };
            assert!(away.iter().all(has_gone));
        });
    }

    #[test]
    fn a_vertex_that_no_height_helps_goes_to_the_side_as_far_as_borders_allow() {
        // A flat tet beside the wall x = 0.05, the plane z = 0 just below its vertex 0.
        let corners = [[0.0, 0.0, 0.05], [0.05, 0.0, -0.2], [0.05, 1.0, -0.6], [0.05, -1.0, -0.6]].map(DVec3::from);
        let plane = Plane { axis: 2, at: 0.0, is_low: false };
        let heights = corners.map(|p| plane.height(p));
        let moved = |wall: Option<f64>| {
            let mut tet = [0, 1, 2, 3];
            if volume6(corners) < 0.0 {
                tet.swap(2, 3);
            }
            let mut mesh = CandidateMesh {
                points: corners.to_vec(),
                tets: vec![tet.map(VertexId)],
                tet_labels: vec![Label(1)],
                ..CandidateMesh::default()
            };
            let mut work = Clipping::new(&mut mesh);
            work.borders = wall.map(|at| Plane { axis: 0, at, is_low: true }).into_iter().chain([plane]).collect();
            let mut heights = heights.to_vec();
            assert_eq!(move_away(&mut work, &mut heights, vec![0], plane), [0]);
            assert!(heights[0] > 0.0 && heights[0] == plane.height(work.points[0]));
            let left = |points: &[DVec3]| {
                lowest_left(tet.map(|v| points[v as usize]), tet.map(|v| heights[v as usize]), plane)
            };
            (work.points[0], left(&work.points))
        };
        let (free, score) = moved(None);
        assert!(free.x < -0.1 && score > LEAST_LEFT, "{free} {score}");
        // On a border it stays there, beside one it does not pass.
        let (held, lower) = moved(Some(0.0));
        assert!(held.x == 0.0 && lower < LEAST_LEFT, "{held} {lower}");
        let (held, between) = moved(Some(-0.02));
        assert!(held.x >= -0.02 && lower < between && between < score, "{held} {between}");
    }

    #[test]
    fn a_vertex_that_holds_a_label_together_stays_off_the_plane() {
        // Vertex 0 just below the plane z = 0, between two tets of label 1 that share the edge to vertex 1 above, in a ring of
        // label 2. Without the vertex nothing of label 1 would be joined below.
        let ring = [[1.0, 0.0], [0.3, 1.0], [-1.0, 0.3], [-0.8, -0.8], [0.4, -1.0]];
        let mut points = vec![DVec3::new(0.0, 0.0, -0.05), DVec3::Z, DVec3::NEG_Z];
        points.extend(ring.map(|[x, y]| DVec3::new(x, y, -0.4)));
        let positive = |mut tet: [u32; 4]| {
            if volume6(tet.map(|v| points[v as usize])) < 0.0 {
                tet.swap(2, 3);
            }
            tet.map(VertexId)
        };
        let around = |apex: u32| (0..5u32).map(move |i| [0, 3 + i, 3 + (i + 1) % 5, apex]);
        let labels_above = [1, 2, 1, 2, 2];
        let moved = |above: [u16; 5], bottom: f64| {
            let mut points = points.clone();
            points[2].z = bottom;
            let mut mesh = CandidateMesh {
                points,
                tets: around(1).chain(around(2)).map(positive).collect(),
                tet_labels: above.into_iter().chain([2; 5]).map(Label).collect(),
                ..CandidateMesh::default()
            };
            let mut work = Clipping::new(&mut mesh);
            let mut heights: Vec<f64> = work.points.iter().map(|p| p.z).collect();
            move_vertices(&mut work, &mut heights, Plane { axis: 2, at: 0.0, is_low: false });
            heights[0]
        };
        let free = moved(labels_above, -1.0);
        assert!((free + 0.3 / 0.7).abs() < 1e-12, "{free}");
        // Elements below that so long a way would turn over.
        let held = moved(labels_above, -0.42);
        assert!(-0.42 < held && held < -0.05, "{held}");
        // Beside each other they are one part.
        assert_eq!(moved([1, 1, 2, 2, 2], -1.0), 0.0);
    }
}
