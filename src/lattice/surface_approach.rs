//! Places where the mesh is far off its surface are brought nearer, also where something stands before them.
//!
//! # Method
//! A vertex goes to its surface step by step, each as far as the scores around it allow, so something may stand before it: at the
//! tip of a vessel the vertices of the wall beyond it. Places that are off by more than a tolerance are gone through, the
//! farthest first: surface vertices, and edges and faces of the surface by their middles
//! ([`chord_splits`](crate::lattice::chord_splits)). Where most labels are vessels an edge counts by the way from it into the crease
//! that it bridges, which is longer than that to the walls of the crease.
//! 1. An edge is flipped where that brings the surface nearer ([`surface_edge_flips`](crate::lattice::surface_edge_flips)), and the
//!    tets around are made better by the means of the improvement; else it gets a new vertex in its middle, as a face does; else
//!    one of its ends moves along the surface to where it cuts that off. At the end a vertex may also go to one tube beside a crease:
//!    between two that run side by side, or three, nothing leads into it, and no tet of good angles has room there.
//! 2. The vertex goes towards the surface, as long as no tet becomes flat, whatever that costs; the tets around are made better
//!    again. This is repeated as long as it comes nearer, a few times: what stood before it has moved.
//! 3. When no more tets are low then, the lowest is no lower, the vertex is nearer by a share and, at the end, nothing around has
//!    come off its surface by as much, it stays; else everything is taken back.
//!
//! # Source
//! [LourencoMartinStutzle2003], with the distance for the objective.
//!
//! # Invariants
//! Never more tets are low than before, and the lowest is no lower.
//!
//! # Cost
//! One distance per surface vertex, edge and face, in parallel, in later passes of those whose vertices were touched; a budget of
//! places for the mesh, each touches a few rings of tets. After a way was tried only what it touched is looked at, by its tets and by
//! its surface; most of that around a place is measured once for the places beside it too ([`KnownCuts`]).

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::chord_splits::{
    Chord, Start, Towards, chords_where, cut_of_edge, flip, insert_in_chord, nearest_on_tube, place_first,
};
use crate::lattice::element_score::Threshold;
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::lattice::iterated_search::{LEAST_PERTURBED, Outcome, Surroundings, vertices_around};
use crate::lattice::surface_cuts::KnownCuts;

/// Times that a vertex goes on after its tets were made better, and where all ways are tried. On 23 trees of vessels the farthest
/// places are off by 0.42 voxel in the mean with 3, by 0.41 with 6 and with 12.
const ADVANCES: usize = 3;
const MORE_ADVANCES: usize = 6;

/// A vertex this near, in tolerances, goes no further.
const NEAR: f64 = 0.5;

/// How far off its nearest surface an edge is, in tolerances, for the way into a crease to be looked for: half of that way where two
/// sides meet at 60 degrees.
const LEAST_DEPTH: f64 = 0.5;

/// How far the surface of a vertex is looked for, in largest spacings.
const REACH: f64 = 2.0;

/// What is off.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum Place {
    Vertex(u32),
    Between(Chord),
}

impl Place {
    /// Its vertices.
    fn corners(&self) -> &[u32] {
        match self {
            Self::Vertex(v) => std::slice::from_ref(v),
            Self::Between(chord) => chord.corners(),
        }
    }
}

/// What an approach aims at and may spend.
#[derive(Debug, Clone, Copy)]
pub struct ApproachBounds {
    /// How far off the places are that are tried, mm.
    pub range: [f64; 2],
    /// Score below which tets are low, degrees.
    pub wanted: f64,
    /// Share of the distance that may be left.
    pub left: f64,
    /// Whether what is around may come off its surface by as much.
    pub around: Around,
    /// What is tried.
    pub ways: Ways,
    /// How often the places are gone through.
    pub passes: usize,
    /// How many of the farthest count each time, those that are left out among them.
    pub budget: usize,
}

/// What is tried at a place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ways {
    /// A vertex that can go some of the way at once.
    Moves,
    /// Also flips, ends of edges that slide, and vertices that something stands right before: creases are full of these. A vertex stays
    /// at its best advance.
    /// On balls of thick slices the vertex that is farthest off is 0.50 voxel off so, 0.39 where it may go on from a worse one.
    Creases,
    /// Also vertices that go to one side of a crease. On 23 trees of vessels 17 places are off by more than 0.4 voxel without, 13 with it
    /// where nothing around may yield, 16 with it everywhere.
    All,
}

/// What may happen around a place that comes nearer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Around {
    /// Later rounds bring back what comes off its surface.
    MayYield,
    /// Nothing comes off by as much as the place was.
    Holds,
}

/// Brings places nearer to their surface; `mend` makes the tets around a place better. Returns how many became nearer.
///
/// # Errors
/// Those of `mend`; [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn approach_surface(
    mesh: &mut ImprovementMesh,
    bounds: ApproachBounds,
    mend: &mut impl FnMut(&mut ImprovementMesh, &Surroundings) -> Result<()>,
    context: &RunContext,
) -> Result<usize> {
    let mut approach = Approach { bounds, cuts: KnownCuts::default(), tried: Tried::default() };
    let (mut nearer, mut far) = (0, Vec::new());
    for pass in 0..bounds.passes {
        mesh.refresh_stars(context)?;
        if pass == 0 {
            far = far_places(mesh, bounds.range, |_| true, context)?;
        } else {
            // The others are where they were.
            let touched = approach.tried.take_touched(mesh.points.len());
            let is_touched = |corners: &[u32]| corners.iter().any(|v| touched[*v as usize]);
            far.retain(|(_, place)| !is_touched(place.corners()));
            far.extend(far_places(mesh, bounds.range, is_touched, context)?);
            sort_farthest_first(&mut far);
        }
        for &(_, place) in far.iter().take(bounds.budget) {
            context.check()?;
            let near = vertices_around(mesh, place.corners());
            if !approach.tried.is_in_vain(&place, &near) {
                nearer += usize::from(approach.approach_place(mesh, place, near, mend)?);
            }
        }
    }
    Ok(nearer)
}

/// One way to bring a place nearer.
#[derive(Debug, Clone, Copy)]
enum Way {
    Flip,
    Move(Towards),
    /// The first or second end of an edge moves to where the surface is that the edge cuts off.
    Slide(usize),
}

/// All ways, in the order in which they are tried; the last one is for [`Ways::All`] only.
const ALL_WAYS: [Way; 5] =
    [Way::Flip, Way::Move(Towards::Crease), Way::Slide(0), Way::Slide(1), Way::Move(Towards::OneTube)];

/// What was tried in vain, and what changed since.
#[derive(Default)]
struct Tried {
    /// Changes that stayed.
    changes: usize,
    /// The last change that touched a vertex.
    touched: FxHashMap<u32, usize>,
    /// The last change before a place was tried in vain.
    in_vain: FxHashMap<Place, usize>,
    /// Changes before [`take_touched`](Self::take_touched) was last asked.
    taken: usize,
}

impl Tried {
    /// Whether a place was tried in vain and none of the vertices around it was touched since.
    fn is_in_vain(&self, place: &Place, near: &[u32]) -> bool {
        let touched = |v: &u32| self.touched.get(v).copied().unwrap_or(0);
        self.in_vain.get(place).is_some_and(|then| near.iter().all(|v| touched(v) <= *then))
    }

    fn note_change(&mut self, touched: impl IntoIterator<Item = u32>) {
        self.changes += 1;
        self.touched.extend(touched.into_iter().map(|v| (v, self.changes)));
    }

    /// For each of so many vertices whether a change that stayed touched it since this was last asked.
    fn take_touched(&mut self, vertices: usize) -> Vec<bool> {
        let mut is_touched = vec![false; vertices];
        for (v, _) in self.touched.iter().filter(|(_, change)| **change > self.taken) {
            is_touched[*v as usize] = true;
        }
        self.taken = self.changes;
        is_touched
    }

    fn note_in_vain(&mut self, place: Place) {
        self.in_vain.insert(place, self.changes);
    }
}

/// An approach at work.
struct Approach {
    bounds: ApproachBounds,
    cuts: KnownCuts,
    tried: Tried,
}

impl Approach {
    /// Whether a place has come nearer in one of the ways; `near` are the vertices around.
    fn approach_place(
        &mut self,
        mesh: &mut ImprovementMesh,
        place: Place,
        near: Vec<u32>,
        mend: &mut impl FnMut(&mut ImprovementMesh, &Surroundings) -> Result<()>,
    ) -> Result<bool> {
        let ways: &[Way] = match self.bounds.ways {
            Ways::Moves => &[Way::Move(Towards::Crease)],
            Ways::Creases => &ALL_WAYS[..ALL_WAYS.len() - 1],
            Ways::All => &ALL_WAYS,
        };
        let before = (Outcome::of(mesh, near.clone(), self.bounds.wanted), self.farthest_around(mesh, &near));
        for way in ways {
            let (trial, count) = (mesh.begin_trial(), mesh.points.len() as u32);
            let around = Surroundings { vertices: &near, before: &before.0, trial };
            if self.try_way(mesh, *way, place, &around, mend)? {
                let touched = mesh.touched_since(trial);
                if self.is_no_worse(mesh, &touched, &before) {
                    mesh.keep_trial();
                    self.tried.note_change(touched.into_iter().chain(count..mesh.points.len() as u32));
                    return Ok(true);
                }
            }
            mesh.take_back(trial);
        }
        self.tried.note_in_vain(place);
        Ok(false)
    }

    /// Whether the tets around are no lower than before, and nothing there is farther off, after some vertices were touched: nothing
    /// else can be.
    fn is_no_worse(&mut self, mesh: &ImprovementMesh, touched: &[u32], before: &(Outcome, f64)) -> bool {
        before.0.after(mesh, touched, self.bounds.wanted).is_no_worse_than(&before.0)
            && self.farthest_around(mesh, touched) <= before.1
    }

    /// How far off the surface is at some vertices, mm; 0 where that does not matter.
    fn farthest_around(&mut self, mesh: &ImprovementMesh, vertices: &[u32]) -> f64 {
        match self.bounds.around {
            Around::MayYield => 0.0,
            Around::Holds => self.cuts.farthest_around(mesh, vertices),
        }
    }

    /// Whether a place is nearer after a way was tried; what was changed stays to be kept or taken back.
    fn try_way(
        &mut self,
        mesh: &mut ImprovementMesh,
        way: Way,
        place: Place,
        around: &Surroundings,
        mend: &mut impl FnMut(&mut ImprovementMesh, &Surroundings) -> Result<()>,
    ) -> Result<bool> {
        match (way, place) {
            (Way::Flip, Place::Between(chord)) => {
                let is_flipped = flip(mesh, &chord, LEAST_PERTURBED);
                if is_flipped {
                    mend(mesh, around)?;
                }
                Ok(is_flipped)
            }
            (Way::Slide(end), Place::Between(Chord::Edge(ends, eighths))) => {
                self.slide(mesh, (ends, eighths), end, around, mend)
            }
            (Way::Flip | Way::Slide(_), _) => Ok(false),
            (Way::Move(towards), _) => self.bring_nearer(mesh, (place, towards), around, mend),
        }
    }

    /// Whether a vertex of a place has come nearer, a new one where it is a chord.
    fn bring_nearer(
        &self,
        mesh: &mut ImprovementMesh,
        (place, towards): (Place, Towards),
        around: &Surroundings,
        mend: &mut impl FnMut(&mut ImprovementMesh, &Surroundings) -> Result<()>,
    ) -> Result<bool> {
        let ApproachBounds { range: [tolerance, _], left, ways, .. } = self.bounds;
        let start = if ways != Ways::Moves { Start::Anywhere } else { Start::Nearer };
        let found = match place {
            Place::Vertex(v) if mesh.ball(v).is_empty() => None,
            Place::Vertex(v) => {
                let goal = match towards {
                    Towards::Crease => surface_of(mesh, v),
                    Towards::OneTube => nearest_on_tube(mesh, mesh.points[v as usize], mesh.sides(v)),
                };
                goal.map(|goal| (v, [mesh.points[v as usize], goal]))
            }
            Place::Between(chord) => insert_in_chord(mesh, chord, LEAST_PERTURBED, (start, towards)),
        };
        let Some((v, [start, goal])) = found else { return Ok(false) };
        let off = goal.distance(start);
        // Others may have brought it nearer.
        if off <= tolerance {
            return Ok(false);
        }
        let mut near = around.vertices.to_vec();
        if let Err(at) = near.binary_search(&v) {
            near.insert(at, v);
        }
        let around = Surroundings { vertices: &near, ..*around };
        let needed = Threshold::of(LEAST_PERTURBED);
        let mut nearest = f64::INFINITY;
        let advances = if ways != Ways::Moves { MORE_ADVANCES } else { ADVANCES };
        for _ in 0..advances {
            let advance = mesh.begin_trial();
            let from = mesh.points[v as usize];
            place_first(mesh, v, from, goal, &needed);
            mend(mesh, &around)?;
            let now = if mesh.ball(v).is_empty() { f64::INFINITY } else { goal.distance(mesh.points[v as usize]) };
            if now >= nearest && ways != Ways::Moves {
                mesh.take_back(advance);
                break;
            }
            mesh.keep_trial();
            nearest = now;
            if now < NEAR * tolerance {
                break;
            }
        }
        Ok(nearest <= left * off)
    }

    /// Whether the surface at an edge has come nearer with an end that moved along the surface: no new vertex is in the way of others.
    fn slide(
        &mut self,
        mesh: &mut ImprovementMesh,
        (ends, eighths): ([u32; 2], u8),
        end: usize,
        around: &Surroundings,
        mend: &mut impl FnMut(&mut ImprovementMesh, &Surroundings) -> Result<()>,
    ) -> Result<bool> {
        let v = ends[end];
        let Some(cut) = cut_of_edge(mesh, ends, eighths, Towards::Crease) else { return Ok(false) };
        // Where more labels meet it would leave their line.
        if mesh.fixed[v as usize] || mesh.sides(v) != cut.sides {
            return Ok(false);
        }
        let off = self.cuts.farthest_around(mesh, &ends);
        if !place_first(mesh, v, mesh.points[v as usize], cut.goal, &Threshold::of(LEAST_PERTURBED)) {
            return Ok(false);
        }
        mend(mesh, around)?;
        Ok(self.cuts.farthest_around(mesh, &ends) <= self.bounds.left * off)
    }
}

/// How far off and what, of the places whose vertices are wanted, the farthest first.
fn far_places(
    mesh: &ImprovementMesh,
    [tolerance, farthest]: [f64; 2],
    is_wanted: impl Fn(&[u32]) -> bool + Sync,
    context: &RunContext,
) -> Result<Vec<(f64, Place)>> {
    context.check()?;
    let of_vertex = |v: u32| {
        let is_on_surface = mesh.is_on_surface(v) && !mesh.fixed[v as usize] && !mesh.ball(v).is_empty();
        let is_candidate = is_on_surface && is_wanted(&[v]);
        let off = is_candidate.then(|| surface_of(mesh, v))?.map(|goal| goal.distance(mesh.points[v as usize]))?;
        (off > tolerance).then_some((off, Place::Vertex(v)))
    };
    let vertices = (0..mesh.points.len() as u32).into_par_iter().with_min_len(1024);
    let mut far: Vec<(f64, Place)> = context.until_cancelled(vertices).filter_map(of_vertex).collect();
    // What a cancelled run left out above is never seen: this fails too.
    let has_creases = mesh.surface.has_mostly_vessels();
    let least = if has_creases { LEAST_DEPTH * tolerance } else { tolerance };
    let listed = chords_where(mesh, least, &is_wanted, context)?;
    let of_chord = |(off, chord): (f64, Chord)| {
        let off = if has_creases { off.max(way_into_crease(mesh, &chord)) } else { off };
        (off > tolerance).then_some((off, Place::Between(chord)))
    };
    let listed = listed.into_par_iter().with_min_len(64);
    far.par_extend(context.until_cancelled(listed).filter_map(of_chord));
    context.check()?;
    far.retain(|(off, _)| *off < farthest);
    sort_farthest_first(&mut far);
    Ok(far)
}

fn sort_farthest_first(far: &mut [(f64, Place)]) {
    far.sort_unstable_by(|l, r| r.0.total_cmp(&l.0).then(l.1.cmp(&r.1)));
}

/// How far off an edge is in the direction in which all the surface around leads, mm; 0 for a face.
fn way_into_crease(mesh: &ImprovementMesh, chord: &Chord) -> f64 {
    let Chord::Edge(ends, eighths) = *chord else { return 0.0 };
    cut_of_edge(mesh, ends, eighths, Towards::Crease).map_or(0.0, |cut| cut.goal.distance(cut.place))
}

/// The place of a vertex on its surface.
fn surface_of(mesh: &ImprovementMesh, v: u32) -> Option<DVec3> {
    mesh.surface.project(mesh.points[v as usize], mesh.sides(v), REACH * mesh.surface.spacing().max_element())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::options::{Options, PARAMETERS};
    use crate::lattice::test_images::{fork_distance, voxel_image};
    use crate::mesh::validation::check_mixed_mesh;
    use crate::parameters::ParameterSet;

    #[test]
    fn places_are_tried_and_measured_again_when_something_around_them_has_changed() {
        let (place, near) = (Place::Vertex(7), [6, 7, 8]);
        let mut tried = Tried::default();
        tried.note_change(vec![6]);
        assert!(!tried.is_in_vain(&place, &near));
        tried.note_in_vain(place);
        tried.note_change(vec![1, 2]);
        assert!(tried.is_in_vain(&place, &near) && !tried.is_in_vain(&Place::Vertex(8), &near));
        tried.note_change(vec![2, 8]);
        assert!(!tried.is_in_vain(&place, &near));
        tried.note_in_vain(place);
        assert!(tried.is_in_vain(&place, &near));
        let take = |tried: &mut Tried| -> Vec<usize> {
            tried
                .take_touched(10)
                .into_iter()
                .enumerate()
                .filter_map(|(v, is_touched)| is_touched.then_some(v))
                .collect()
        };
        assert_eq!(take(&mut tried), [1, 2, 6, 8]);
        assert!(take(&mut tried).is_empty());
        tried.note_change(vec![2, 9]);
        assert_eq!(take(&mut tried), [2, 9]);
    }

    #[test]
    fn vessels_in_their_walls_end_where_their_voxels_do() {
        // Lumens of 1.5 voxels radius in walls of 1.4 voxels, two from each of eight places in one image.
        let along = |i: i32| DVec3::from([4, 2, 1].map(|bit| if i & bit == 0 { 1.0 } else { -0.6 })).normalize();
        let center = |i: i32| DVec3::from([4, 2, 1].map(|bit| if i & bit == 0 { 12.3 } else { 37.4 }));
        let both = |i: i32| [along(i), along((3 * i + 1) % 8)];
        let rod = |p: DVec3, i: i32| {
            let q = p - center(i);
            both(i).map(|axis| (q - axis * q.dot(axis).clamp(0.0, 7.0)).length()).into_iter().fold(f64::MAX, f64::min)
        };
        let nearest = |p: DVec3| (0..8).map(|i| rod(p, i)).fold(f64::INFINITY, f64::min);
        let image = voxel_image(50, |p| {
            let r = nearest(p);
            if r < 1.5 { 1 } else { 2 * u16::from(r < 2.9) }
        });
        let options = Options::from_parameters(&ParameterSet::new(PARAMETERS)).unwrap();
        let (output, report) = crate::lattice::run(&image, &options, &RunContext::with_threads(1).unwrap()).unwrap();
        check_mixed_mesh(&output.mesh).unwrap();
        // The vertices of the lumens that are nearest to their ends.
        let mut inside: Vec<DVec3> = Vec::new();
        for (tet, label) in output.mesh.connectivity.chunks_exact(4).zip(&output.mesh.labels) {
            inside.extend(tet.iter().filter(|_| *label == 1).map(|v| output.mesh.points[v.index()]));
        }
        let ends = (0..8).flat_map(|i| both(i).map(|axis| center(i) + axis * 8.5));
        let off = |end: DVec3| inside.iter().map(|p| p.distance(end)).fold(f64::INFINITY, f64::min);
        let farthest = ends.map(off).fold(0.0, f64::max);
        let approached = report.statistics().value("improvement.approached").unwrap();
        assert!(approached > 0.0 && farthest < 1.0, "{approached} {farthest}");
    }

    #[test]
    fn the_creases_of_forks_are_met() {
        let of_fork = |turn: f64| {
            let end = |angle: f64, z: f64| [18.9 + 9.6 * angle.cos(), 17.4 + 9.6 * angle.sin(), z];
            let ends = [[18.9, 16.2, 5.5], end(turn, 31.7), end(turn + 2.8, 31.2)];
            let off = |p: DVec3| fork_distance(p, ends, 1.9);
            let image = voxel_image(38, |p| u16::from(off(p) < 0.0));
            let options = Options::from_parameters(&ParameterSet::new(PARAMETERS)).unwrap();
            let (output, _) = crate::lattice::run(&image, &options, &RunContext::with_threads(1).unwrap()).unwrap();
            let at = |v: crate::index::VertexId| output.mesh.points[v.index()];
            let of_edge =
                |[a, b]: [DVec3; 2]| (0..=8).map(|n| off(a.lerp(b, f64::from(n) / 8.0)).abs()).fold(0.0, f64::max);
            let of_face = |[a, b, c]: [DVec3; 3]| [[a, b], [b, c], [c, a]].map(of_edge).into_iter().fold(0.0, f64::max);
            output.mesh.boundary.triangles.iter().map(|t| of_face(t.map(at))).fold(0.0, f64::max)
        };
        let farthest = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5].map(of_fork);
        let mean = farthest.iter().sum::<f64>() / farthest.len() as f64;
        // Measured 0.360; 0.418 where nothing is approached.
        assert!(mean < 0.37, "{mean} {farthest:?}");
    }
}
