//! Edges and faces of a surface that cut off what bends between their vertices are split there.
//!
//! # Method
//! 1. For each face between two labels, its middle and those of its edges are compared with the sub-voxel surface of these
//!    labels. Edges whose middle is off by more than a tolerance are listed, and faces whose middle is farther off than those
//!    of their edges, the farthest off first.
//!    Edges of vessels are looked at where they are farthest off: creases pass anywhere. Where the image ends there is no surface.
//! 2. Each is split; the new vertex goes from the place towards the surface as far as the scores around it allow
//!    ([`insert_between`]). Later rounds of the improvement bring it the rest of the way. The surface is met
//!    across the face: a flat end of a vessel has its middle on the axis, where all of the wall is equally near.
//! ```text
//!        ___                    _m_                           ________               ________
//!      /     \                 / | \       a thin vessel,               \            f       \
//!     a-------b       ->      a--|--b     a chord through it,        f   |    ->   |\__     m
//!      \_____/                 \_|_/       and its flat end     ____|__/            f___\__/
//! ```
//!
//! # Source
//! [Shewchuk2002] for the bound on what linear elements may miss; the tolerance takes the place of an estimate.
//!
//! # Invariants
//! The mesh conforms. No score falls below the bound that was not below before.
//!
//! # Cost
//! One distance per surface edge and face, in parallel. The splits are planned in parallel and made one after another.

use glam::DVec3;
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::index::Label;
use crate::lattice::element_score::{Ball, Threshold};
use crate::lattice::improvement_mesh::{ImprovementMesh, SurfaceFace};
use crate::lattice::local_transformations::{insert_between, sides_of_edge};
use crate::lattice::planned_batches::{PlannedChange, Touched, change_in_order};
use crate::lattice::subvoxel_surface::Side;
use crate::lattice::surface_cuts::farthest_on_edge;
use crate::lattice::surface_edge_flips::flip_surface_edge;
use crate::mesh::numbering::sorted_edge;

/// Parts of the way from the middle to the surface that are tried.
const WAY: [f64; 5] = [1.0, 0.8, 0.6, 0.4, 0.2];

/// How far from the middle of an edge its surface is looked for, in lengths of the edge.
const REACH: f64 = 0.75;

/// Steps across a face in which its surface is looked for, each a quarter of the smallest spacing: two voxels, the radius of a
/// vessel whose end is flat.
const STEPS_ACROSS: usize = 8;
const STEP_ACROSS: f64 = 0.25;

/// How far off the middle of an edge is, in tolerances, for it to be looked at in other places too.
const LEAST_MIDDLE: f64 = 0.5;

/// Where edges are looked at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Places {
    /// In its middle.
    Middles,
    /// Where it is farthest off.
    Farthest,
}

/// What is split, by its vertices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Chord {
    /// Its ends, the smaller first, and how many eighths of it lie before the place that is looked at.
    Edge([u32; 2], u8),
    /// In outward order, and the labels of both sides.
    Face([u32; 3], [Label; 2]),
}

impl Chord {
    /// Its vertices.
    pub fn corners(&self) -> &[u32] {
        match self {
            Self::Edge(ends, _) => ends,
            Self::Face(corners, _) => corners,
        }
    }
}

/// Where a new vertex may begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Start {
    /// Some of the way from the middle to the surface, where no triangle lies upside down.
    Nearer,
    /// Also in the middle itself.
    Anywhere,
}

/// Splits surface edges and faces whose middle is off by more than `tolerance` (mm); `bound` is the score that may be spent,
/// degrees. The stars of the mesh are up to date. Returns how many were split.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn split_chords(mesh: &mut ImprovementMesh, tolerance: f64, bound: f64, context: &RunContext) -> Result<usize> {
    let far: Vec<Chord> = chords(mesh, tolerance, context)?.into_iter().map(|(_, chord)| chord).collect();
    let mut splits = Splits { bound, made: 0 };
    change_in_order(mesh, &far, &mut splits, context)?;
    Ok(splits.made)
}

/// Splits of chords.
struct Splits {
    bound: f64,
    made: usize,
}

impl PlannedChange for Splits {
    type Item = Chord;
    type Plan = Option<Insertion>;

    fn append_vertices(&self, _: &ImprovementMesh, chord: &Chord, vertices: &mut Vec<u32>) {
        vertices.extend(chord.corners());
    }

    fn plan(&self, mesh: &ImprovementMesh, chord: &Chord, ball: &mut Ball) -> Option<Insertion> {
        Insertion::plan(mesh, *chord, self.bound, Towards::Crease, ball)
    }

    fn change(
        &mut self,
        mesh: &mut ImprovementMesh,
        chord: &Chord,
        plan: Option<Insertion>,
        touched: &mut Touched,
    ) -> Option<Chord> {
        if let Some(insertion) = plan {
            // What is taken back leaves tets in another order.
            touched.mark_tets(mesh, &insertion.tets);
            self.made += usize::from(insertion.make(mesh, *chord, self.bound, Start::Nearer));
        }
        None
    }
}

/// Flips a chord that is an edge.
pub fn flip(mesh: &mut ImprovementMesh, chord: &Chord, bound: f64) -> bool {
    matches!(*chord, Chord::Edge([a, b], _) if flip_surface_edge(mesh, a, b, bound))
}

/// How far off and vertices of what is to be split, the farthest first.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn chords(mesh: &ImprovementMesh, tolerance: f64, context: &RunContext) -> Result<Vec<(f64, Chord)>> {
    chords_where(mesh, tolerance, |_| true, context)
}

/// As [`chords`], of those whose vertices are wanted.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn chords_where(
    mesh: &ImprovementMesh,
    tolerance: f64,
    is_wanted: impl Fn(&[u32]) -> bool + Sync,
    context: &RunContext,
) -> Result<Vec<(f64, Chord)>> {
    context.check()?;
    let places = if mesh.surface.has_mostly_vessels() { Places::Farthest } else { Places::Middles };
    let is_wanted = &is_wanted;
    let of_vertex = |v: u32| {
        let star = mesh.stars().of(v).unwrap_or(&[]);
        star.iter().flat_map(move |face| of_face(mesh, v, face, (tolerance, places), is_wanted)).flatten()
    };
    let vertices = (0..mesh.points.len() as u32).into_par_iter().with_min_len(1024);
    let mut far: Vec<(f64, Chord)> = context.until_cancelled(vertices).flat_map_iter(of_vertex).collect();
    context.check()?;
    far.sort_unstable_by(|l, r| r.0.total_cmp(&l.0).then(l.1.cmp(&r.1)));
    let mut seen = rustc_hash::FxHashSet::default();
    far.retain(|(_, chord)| seen.insert(*chord));
    Ok(far)
}

/// The chords that are listed at one vertex of a face: the edge that begins there, at its smaller vertex, and the face, at its
/// smallest, each with how far off its middle is, where that is more than `tolerance` and its vertices are wanted.
fn of_face(
    mesh: &ImprovementMesh,
    v: u32,
    face: &SurfaceFace,
    (tolerance, places): (f64, Places),
    is_wanted: &impl Fn(&[u32]) -> bool,
) -> [Option<(f64, Chord)>; 2] {
    let Some(sides) = mesh.labels_beside(v, face) else { return [None, None] };
    let [w, u] = face.others;
    // Every edge is found once, in both directions, where the faces beside it are taken around the same label; that of one face and
    // one in a border plane in the direction that it has in the former.
    let next = if sides[0] < sides[1] { w } else { u };
    let ends = sorted_edge(v, next);
    let is_known = next < v && !is_at_border(mesh, ends);
    let at = |v: u32| mesh.points[v as usize];
    let off = |middle: DVec3| mesh.surface.depth(middle, sides[0], sides[1]).map(f64::abs);
    let edge = |v: u32, w: u32| off(at(v).midpoint(at(w)));
    let is_far = |off: &f64| *off > tolerance;
    let along = (!is_known && is_wanted(&ends)).then(|| {
        let [from, to] = ends;
        let middle = edge(from, to)?;
        let place = |eighths: u8| at(from).lerp(at(to), f64::from(eighths) / 8.0);
        let (far, eighths) = match places {
            Places::Farthest if middle > LEAST_MIDDLE * tolerance => {
                farthest_on_edge(|eighths| off(place(eighths)).unwrap_or(0.0))
            }
            _ => (middle, 4),
        };
        is_far(&far).then_some((far, Chord::Edge(ends, eighths)))
    });
    let is_face_wanted = w > v && u > v && is_wanted(&[v, w, u]);
    let across = is_face_wanted.then(|| {
        // The edges are measured for the few faces that are far off: this is asked of every face of the mesh.
        let middle = off((at(v) + at(w) + at(u)) / 3.0).filter(is_far)?;
        let is_farthest = [[v, w], [w, u], [u, v]].iter().all(|[p, q]| edge(*p, *q).is_none_or(|off| off < middle));
        is_farthest.then_some((middle, Chord::Face([v, w, u], sides)))
    });
    [along.flatten(), across.flatten()]
}

/// Whether both ends of an edge lie in one border plane of the image.
fn is_at_border(mesh: &ImprovementMesh, [a, b]: [u32; 2]) -> bool {
    mesh.are_in_border([a, b, b])
}

/// Where a new vertex goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Towards {
    /// To where all the surface around leads, into a crease.
    Crease,
    /// To the nearest place of one tube, beside a crease: where two tubes run side by side nothing leads into it.
    OneTube,
}

/// What an edge cuts off.
pub struct CutOff {
    /// The tets around the edge.
    pub shell: Vec<u32>,
    /// What meets in the edge.
    pub sides: Vec<Side>,
    /// A place on the edge.
    pub place: DVec3,
    /// Where the surface is that it belongs to.
    pub goal: DVec3,
}

/// What an edge cuts off after some eighths of it; `None` where the edge is no more, or no surface is near.
pub fn cut_of_edge(mesh: &ImprovementMesh, [a, b]: [u32; 2], eighths: u8, towards: Towards) -> Option<CutOff> {
    let shell = mesh.shell(a, b);
    if shell.is_empty() {
        return None; // Another split has taken it.
    }
    let sides = sides_of_edge(mesh, a, b, &shell);
    let [from, to] = [a, b].map(|v| mesh.points[v as usize]);
    let place = from.lerp(to, f64::from(eighths) / 8.0);
    let goal = match towards {
        Towards::Crease => mesh.surface.project(place, &sides, REACH * from.distance(to))?,
        Towards::OneTube => nearest_on_tube(mesh, place, &sides)?,
    };
    Some(CutOff { shell, sides, place, goal })
}

/// The place on the surface where two labels meet that is nearest by one tube.
pub fn nearest_on_tube(mesh: &ImprovementMesh, place: DVec3, sides: &[Side]) -> Option<DVec3> {
    let [Side::Label(a), Side::Label(b)] = *sides else { return None };
    mesh.surface.nearest_on_tube(place, a, b)
}

/// Splits a chord by a vertex that goes towards the surface as far as no score falls below the bound that was not below before.
/// Returns the vertex, the place where it began, and where it is to go; `None` where the chord stays as it is.
pub fn insert_in_chord(
    mesh: &mut ImprovementMesh,
    chord: Chord,
    bound: f64,
    (begin, towards): (Start, Towards),
) -> Option<(u32, [DVec3; 2])> {
    let insertion = mesh.with_scratch(|mesh, ball| Insertion::plan(mesh, chord, bound, towards, ball))?;
    let ends = insertion.ends;
    insertion.make(mesh, chord, bound, begin).then(|| (mesh.points.len() as u32 - 1, ends))
}

/// A vertex that splits a chord.
struct Insertion {
    /// The tets that it splits.
    tets: Vec<u32>,
    sides: Vec<Side>,
    /// Where it begins, and where it is to go.
    ends: [DVec3; 2],
    /// The lowest score of the tets.
    before: f64,
    /// Where it goes at once, the farthest place where no score falls below the bound that was not below before.
    place: Option<DVec3>,
}

impl Insertion {
    /// `ball` is a scratch buffer.
    fn plan(mesh: &ImprovementMesh, chord: Chord, bound: f64, towards: Towards, ball: &mut Ball) -> Option<Self> {
        let (tets, sides, ends) = chord_at(mesh, chord, towards)?;
        let before = mesh.lowest(&tets);
        mesh.gather_split(&tets, chord.corners(), ball);
        let place = first_place(ball, ends, &Threshold::of(before.min(bound)));
        Some(Self { tets, sides, ends, before, place })
    }

    /// Whether the chord is split now.
    fn make(self, mesh: &mut ImprovementMesh, chord: Chord, bound: f64, begin: Start) -> bool {
        let is_good = |mesh: &mut ImprovementMesh, m: u32| {
            self.place.iter().for_each(|place| mesh.move_vertex(m, *place));
            match begin {
                Start::Nearer => self.place.is_some() && is_upright(mesh, m),
                Start::Anywhere => self.place.is_some() || mesh.lowest(mesh.ball(m)) >= bound.min(self.before),
            }
        };
        insert_between(mesh, chord.corners(), &self.tets, self.ends[0], self.sides, is_good)
    }
}

/// The tets of a chord, what meets in it, a place on it, and where the surface is that it belongs to.
fn chord_at(mesh: &ImprovementMesh, chord: Chord, towards: Towards) -> Option<(Vec<u32>, Vec<Side>, [DVec3; 2])> {
    match chord {
        Chord::Edge(ends, eighths) => {
            let CutOff { shell, sides, place, goal } = cut_of_edge(mesh, ends, eighths, towards)?;
            Some((shell, sides, [place, goal]))
        }
        Chord::Face(corners, labels) => {
            let tets = mesh.tets_at_face(corners);
            if tets.is_empty() {
                return None;
            }
            let [a, b, c] = corners.map(|v| mesh.points[v as usize]);
            let middle = (a + b + c) / 3.0;
            let mut sides = labels.map(Side::Label).to_vec();
            sides.sort_unstable();
            let goal = match towards {
                Towards::Crease => across(mesh, middle, (b - a).cross(c - a).normalize_or_zero(), labels)?,
                Towards::OneTube => nearest_on_tube(mesh, middle, &sides)?,
            };
            Some((tets, sides, [middle, goal]))
        }
    }
}

/// Whether all surface triangles at a vertex look where the surface does there. The halves of a triangle that lies upside down do not:
/// folds would grow finer.
fn is_upright(mesh: &ImprovementMesh, v: u32) -> bool {
    let at = |v: u32| mesh.points[v as usize];
    // Most vertices lie between two labels: one normal is asked for.
    let mut known = None;
    mesh.surface_faces(v).iter().all(|face| {
        let Some([inner, outer]) = mesh.labels_beside(v, face) else { return true };
        let pair = [inner.min(outer), inner.max(outer)];
        let normal = match known {
            Some((of, normal)) if of == pair => normal,
            _ => mesh.surface.signed_distance(at(v), pair[0], pair[1]).map(|(_, normal)| normal),
        };
        known = Some((pair, normal));
        let [w, u] = face.others;
        let outward = (at(w) - at(v)).cross(at(u) - at(v));
        // The normal leads into the first label of the pair.
        normal.is_none_or(|normal| (outward.dot(normal) < 0.0) == (inner == pair[0]))
    })
}

/// Where the line through the middle of a face along its outward normal meets the surface between the labels of its sides.
fn across(mesh: &ImprovementMesh, middle: DVec3, normal: DVec3, [inner, outer]: [Label; 2]) -> Option<DVec3> {
    let depth = |at: DVec3| mesh.surface.depth(at, inner, outer);
    let mut before = depth(middle)?;
    // Within the inner label the surface lies beyond the face.
    let step = normal * before.signum() * STEP_ACROSS * mesh.surface.spacing().min_element();
    for count in 1..=STEPS_ACROSS {
        let after = depth(middle + step * count as f64)?;
        if (after > 0.0) != (before > 0.0) {
            return Some(mesh.surface.within_borders(middle + step * (count as f64 - after / (after - before))));
        }
        before = after;
    }
    None
}

/// Moves a vertex from the middle towards the goal, to the farthest place where its tets reach the threshold.
pub fn place_first(mesh: &mut ImprovementMesh, v: u32, middle: DVec3, goal: DVec3, needed: &Threshold) -> bool {
    mesh.with_ball(v, |mesh, ball| {
        let found = first_place(ball, [middle, goal], needed);
        found.inspect(|place| mesh.move_vertex(v, *place)).is_some()
    })
}

fn first_place(ball: &mut Ball, [middle, goal]: [DVec3; 2], needed: &Threshold) -> Option<DVec3> {
    let mut places = WAY.iter().map(|part| middle.lerp(goal, *part));
    places.find(|place| ball.score_above(*place, needed).is_some())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::label_image::LabelImage;
    use crate::lattice::options::{Options, PARAMETERS};
    use crate::lattice::test_images::voxel_image;
    use crate::lattice::test_meshes::{with_edge_on_ball, with_faces_in_border, with_fold};
    use crate::mesh::validation::check_mixed_mesh;
    use crate::parameters::ParameterSet;

    #[test]
    fn a_triangle_that_lies_upside_down_is_not_split() {
        with_fold([Label(2); 2], |mut mesh| {
            let chord = Chord::Edge([0, 1], 4);
            assert_eq!(insert_in_chord(&mut mesh, chord, 0.1, (Start::Nearer, Towards::Crease)), None);
            // The edge between the upright triangles is split, at the same price.
            mesh.move_vertex(2, DVec3::new(2.5, 4.0, 4.55));
            assert!(insert_in_chord(&mut mesh, chord, 0.1, (Start::Nearer, Towards::Crease)).is_some());
        });
    }

    /// How many chords were split, and the farthest middle of a surface triangle from where `distance` is 0.
    fn split(image: &LabelImage, distance: impl Fn(DVec3) -> f64) -> (f64, f64) {
        let options = Options::from_parameters(&ParameterSet::new(PARAMETERS)).unwrap();
        let context = RunContext::with_threads(1).unwrap();
        let (output, report) = crate::lattice::run(image, &options, &context).unwrap();
        check_mixed_mesh(&output.mesh).unwrap();
        let middle =
            |t: &[crate::index::VertexId; 3]| t.iter().map(|v| output.mesh.points[v.index()]).sum::<DVec3>() / 3.0;
        let farthest = output.mesh.boundary.triangles.iter().map(|t| distance(middle(t)).abs()).fold(0.0, f64::max);
        (report.statistics().value("improvement.chords").unwrap(), farthest)
    }

    #[test]
    fn an_edge_between_labels_is_found_whichever_tets_come_first() {
        // The tet that comes first of those at a face is its inner one: of one label at both faces, or of two.
        for order in [[0, 1, 2, 3], [2, 3, 0, 1], [0, 3, 1, 2], [3, 0, 2, 1], [1, 2, 3, 0]] {
            with_edge_on_ball(0.7, order, |mut mesh| {
                let context = RunContext::with_threads(1).unwrap();
                mesh.refresh_stars(&context).unwrap();
                let found = chords(&mesh, 0.5, &context)
                    .unwrap()
                    .into_iter()
                    .filter(|(_, chord)| *chord == Chord::Edge([0, 1], 4));
                assert_eq!(found.count(), 1, "{order:?}");
            });
        }
    }

    #[test]
    fn an_edge_at_the_image_border_is_looked_at_where_a_surface_ends_there() {
        for order in [[0, 1, 2, 3], [3, 2, 1, 0], [1, 3, 0, 2]] {
            with_faces_in_border(order, |mut mesh| {
                let context = RunContext::with_threads(1).unwrap();
                mesh.refresh_stars(&context).unwrap();
                let [a, b, c, d] = order;
                let found = chords(&mesh, 0.3, &context).unwrap();
                let count = |p: u32, q: u32| {
                    let edge = Chord::Edge(sorted_edge(p, q), 4);
                    found.iter().filter(|(_, chord)| *chord == edge).count()
                };
                assert_eq!([[a, c], [b, c], [a, d], [b, d]].map(|[p, q]| count(p, q)), [1; 4], "{order:?}");
                // Both faces at this one are cuts through the label.
                assert_eq!(count(a, b), 0, "{order:?}");
                let is_of_border = |chord: &Chord| matches!(chord, Chord::Face(corners, _) if !corners.contains(&4));
                assert!(!found.iter().any(|(_, chord)| is_of_border(chord)), "{order:?}");
            });
        }
    }

    #[test]
    fn where_the_image_cuts_a_block_nothing_is_split() {
        let (chords, _) = split(&voxel_image(16, |p| u16::from(p.z < 8.4)), |p| p.z - 8.5);
        // 3621 where edges within the border planes count as chords of the surface near them.
        assert_eq!(chords, 0.0);
    }

    #[test]
    fn a_cancelled_run_splits_nothing() {
        with_edge_on_ball(0.7, [0, 1, 2, 3], |mut mesh| {
            let context = RunContext::with_threads(1).unwrap();
            mesh.refresh_stars(&context).unwrap();
            context.cancel_token().cancel();
            let before = mesh.points.len();
            assert!(matches!(split_chords(&mut mesh, 0.5, 15.0, &context), Err(crate::error::Error::Cancelled)));
            assert_eq!(mesh.points.len(), before);
        });
    }

    #[test]
    fn chords_through_a_thin_rod_are_split_and_a_ball_has_none() {
        let axis = DVec3::new(0.8, 0.5, 0.33).normalize();
        let (from, to) = (DVec3::new(9.2, 10.7, 10.4), DVec3::new(9.2, 10.7, 10.4) + axis * 18.0);
        let rod = |p: DVec3| (p - from - axis * (p - from).dot(axis).clamp(0.0, (to - from).length())).length() - 1.7;
        let (chords, farthest) = split(&voxel_image(34, |p| u16::from(rod(p) < 0.0)), rod);
        // Measured 91 and 0.28; 10 and 0.36 where edges could cut off 0.35 voxel.
        assert!(chords > 0.0 && farthest < 0.35, "{chords} {farthest}");
        let ball = |p: DVec3| p.distance(DVec3::new(15.3, 15.8, 16.1)) - 11.0;
        let (chords, farthest) = split(&voxel_image(32, |p| u16::from(ball(p) < 0.0)), ball);
        assert!(chords == 0.0 && farthest < 0.5, "{chords} {farthest}");
    }
}
