//! Step 3: every edge and facet of the surface becomes an edge and a face of the mesh, without a point on the surface.
//!
//! # Method
//! 1. Missing edges are recovered by flips, in passes of growing depth, from both ends and then all along; no face is
//!    kept yet.
//! 2. For edges that constraints lock, segments make room that are recovered anew (`edge_rerouting`); those that are left
//!    get a point between the constraints (`volume_points`), then, with the faces that are there kept, points beside them
//!    (`edge_bridging`); where that fails they are split, at last in sight of their ends (`sight_insertion`).
//! 3. Missing faces are recovered by local reconnections; those that resist are split (`steiner_points`).
//! 4. The Steiner points are taken off the surface again (`partition_elimination`), into the volume where need be. Where
//!    one resists, its split is taken back as a constraint, the point becomes one of the volume, and 1 to 4 are repeated
//!    for what is missing now: all that was eliminated meanwhile has changed what stood in the way.
//! 5. Those in the volume are removed as far as possible (`steiner_removal`), then merged (`steiner_merging`).
//! 6. Where many edges had to be split, all but the merging is done once more with the missing edges in the other order, and
//!    what has fewer points is kept (`EdgeOrder`) and merged.
//!
//! # Source
//! [Drakopoulos2017] 4.6, [GeorgeHechtSaltel1991], [GeorgeBorouchaki2003].
//!
//! # Differences
//! Beside n-m flips, small polyhedra are filled by search (`cavity_filling`), which needs no sequence of valid flips
//! between the old and the new state. Internal surfaces and non-manifold edges are treated like any other.
//!
//! # Invariants
//! The mesh is valid after every step: exact predicates decide, and each change covers what it replaces.
//!
//! # Termination
//! Recovery ends with the surface or with findings that name the places; nothing is repeated without a bound:
//! * Crossings: no change puts a new face into the way of the edge it is made for, so that each leaves less in the way. Edges
//!   looked at and tets placed are counted (`Effort`), passes are repeated only while they recover a tenth of what is missing.
//! * Edges: a round splits each missing edge once; from the round `ROUNDS_OUT_OF_SIGHT` on there may be `MOST_GROWTH` times as
//!   many missing parts as then, and there are `MOST_ROUNDS` rounds. From `ROUNDS_BY_CHOICE` on an edge is split wherever it
//!   crosses the mesh, in place of what it crosses: with exact coordinates that always works and makes it whole at once
//!   (`steiner_points`). Rounded coordinates put the point beside the edge, and a flat tet may refuse it; and each split brings
//!   edges to the other vertices of its facets. So there is no proof that rounds suffice, only the bound, and the error.
//!   The engine then starts anew from the Delaunay mesh with deeper searches, twice at most.
//! * Faces: `MOST_ROUNDS` splits, each with the recovery of the edges it brings. Splits that resist are taken back
//!   `MOST_WITHDRAWALS` times; a pass over Steiner points is repeated only while it removes some.
//!
//! # Cost
//! Edges and faces that the Delaunay mesh has cost one look-up. One thread; deterministic.

pub mod cavity_filling;
pub mod constrained_mesh;
pub mod crossings;
pub mod edge_bridging;
pub mod edge_recovery;
pub mod edge_removal;
pub mod edge_rerouting;
pub mod face_recovery;
mod obstruction;
pub mod partition_elimination;
pub mod sight_insertion;
pub mod steiner_merging;
pub mod steiner_points;
pub mod steiner_removal;
pub mod volume_points;

use std::time::Instant;

use glam::DVec3;
use rustc_hash::FxHashSet;

use self::constrained_mesh::{ConstrainedMesh, EdgeKey, FaceKey};
use self::edge_bridging::Bridge;
use crate::conforming::options::{Options, RecoveryMode};
use crate::conforming::report::RecoveryReport;
use crate::context::RunContext;
use crate::error::{Error, Finding, FindingCode, Result, Severity};
use crate::index::VertexId;
use crate::mesh::tet_complex::TetComplex;

/// How hard one pass tries.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Effort {
    /// Levels of recursion of edge removal.
    pub depth: usize,
    /// Most tets around an edge that is removed.
    pub ring: usize,
    /// Edge removals tried within one recursion.
    pub tries: usize,
    /// Most tets of a cavity that is filled.
    pub tets: usize,
    /// Tets placed in one search for a filling.
    pub steps: usize,
    /// Tets placed in all searches for one edge, face or point.
    pub budget: usize,
    /// Whether cavities are enlarged.
    pub grow: bool,
    /// Where edge removals start on a ring: other turns find other ways.
    pub turn: usize,
    /// Whether everything that a missing edge crosses is tried, not only what lies next to its ends.
    pub everywhere: bool,
    /// Whether segments that the mesh has may be removed.
    pub yields: bool,
}

impl Effort {
    fn reach(&self, aim: Option<EdgeKey>) -> edge_removal::Reach {
        edge_removal::Reach { depth: self.depth, ring: self.ring, turn: self.turn, yields: self.yields, aim }
    }
}

/// The efforts of the passes, growing; the options give where the last ones start.
fn efforts(options: &Options) -> [Effort; 4] {
    // Rings of vertices on needles are large: twice what the option says is still cheap.
    let (depth, ring) = (options.recursion_depth, 2 * options.edge_removal_limit);
    let first = Effort {
        depth: 0,
        ring,
        tries: 0,
        tets: 12,
        steps: 60,
        budget: 500,
        grow: false,
        turn: 0,
        everywhere: true,
        yields: false,
    };
    [
        first,
        Effort { depth: 1, tries: 50, ..first },
        Effort { depth: depth.min(3), tries: 150, steps: 150, budget: 900, ..first },
        Effort { depth, tries: 300, tets: 30, steps: 2000, budget: 12_000, grow: true, ..first },
    ]
}

/// The passes over missing edges: flips only, ever deeper. Each pass finds the mesh changed by the one before. The last
/// one is bounded by its tries alone: along a row of slender prisms one diagonal may have to follow the other.
fn edge_efforts(options: &Options) -> Vec<Effort> {
    let deepest = 4 * options.recursion_depth;
    let flips = Effort { tries: TRIES, tets: 0, everywhere: false, ..efforts(options)[0] };
    let mut passes = vec![flips];
    let (mut depth, mut step) = (1, 1);
    while depth < deepest {
        passes.push(Effort { depth, ..flips });
        (depth, step) = (depth + step, depth);
    }
    passes.push(Effort { depth: deepest, ..flips });
    passes.push(Effort { depth: TRIES, tries: LAST_TRIES, everywhere: true, ..flips });
    let turns = (1..=MOST_TURNS).flat_map(|turn| passes.iter().map(move |effort| Effort { turn, ..*effort }));
    let turned: Vec<Effort> = turns.collect();
    passes.extend(turned);
    passes
}

/// Edges looked at for one missing edge in a pass: 100 leave a fifth more edges missing, 1000 recover hardly more.
const TRIES: usize = 200;

/// Edges looked at in the last pass of a turn: where many edges wait for each other, as on twisted gears, chains of them are
/// long. 500 leave a twentieth more points, 1000 hardly fewer.
const LAST_TRIES: usize = 600;

/// Edges or faces that get the largest effort before they are split.
const MOST_HARD: usize = 4;

/// Turns in which the passes are repeated for few edges: on grids, where diagonals wait for each other, an edge that one
/// order does not recover is often recovered by another. 8 turns recover hardly more.
const MOST_TURNS: usize = 2;

/// Passes in a row without an edge recovered, after which deeper ones are not tried.
const MOST_FRUITLESS: usize = 2;

/// Rounds of splits before the next ones go where they see the ends of their edge: that lifts many edges, and only flat tets
/// ask for it.
const ROUNDS_OUT_OF_SIGHT: usize = 4;

/// Rounds of splits before edges are split wherever they cross the mesh: that takes the most points, and nothing but rounding
/// can prevent it.
const ROUNDS_BY_CHOICE: usize = 20;

/// Times that the number of missing edges may grow by splits.
const MOST_GROWTH: usize = 8;

/// Times that splits which resist are taken back and recovered once more.
const MOST_WITHDRAWALS: usize = 8;

/// Splits of one edge or face beyond which recovery gives up.
const MOST_ROUNDS: usize = 60;

/// Share of the missing edges that are split, beyond which recovery in the other order is worth its time: where edges wait
/// for each other in a few places only, both orders leave as many points.
const LOCKED_SHARE: f64 = 0.02;

/// In which order missing edges are recovered. Where many lock each other what comes first takes the room: one order may
/// leave half as many points more than the other, and nothing tells in advance which.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EdgeOrder {
    /// By vertex numbers.
    Ascending,
    /// From the last to the first.
    Descending,
}

/// Whether so many edges had to be split that the other order may leave fewer points.
pub fn is_locked(report: &RecoveryReport) -> bool {
    report.steiner_on_surface.iter().sum::<usize>() as f64 > LOCKED_SHARE * report.missing_edges as f64
}

/// Recovers the facets in the mesh of their points.
///
/// # Errors
/// [`Error::NoResult`] naming what could not be recovered; `Cancelled`; `LimitReached`; those of tet creation.
pub fn recover(
    complex: TetComplex,
    facets: &[[VertexId; 3]],
    (options, order): (&Options, EdgeOrder),
    context: &RunContext,
    report: &mut RecoveryReport,
) -> Result<ConstrainedMesh> {
    let mut mesh = ConstrainedMesh::new(complex, facets);
    mesh.cancel = context.cancel_token();
    let efforts = efforts(options);
    let edge_efforts = edge_efforts(options);
    let start = Instant::now();
    let mut missing = mesh.missing_segments();
    report.missing_edges = missing.len();
    if order == EdgeOrder::Descending {
        missing.reverse();
    }

    recover_all_edges(&mut mesh, missing, (&edge_efforts, &efforts), context)?;
    report.steiner_on_surface[0] = mesh.splits.len();
    report.seconds[0] = start.elapsed().as_secs_f64();
    context.progress("boundary recovery", 0.15);
    let start = Instant::now();
    mesh.keeps_faces = true;
    let missing = mesh.missing_subfaces();
    report.missing_faces = missing.len();
    recover_all_faces(&mut mesh, missing, (&edge_efforts, &efforts), context)?;
    report.steiner_on_surface[1] = mesh.splits.len() - report.steiner_on_surface[0];
    report.seconds[1] = start.elapsed().as_secs_f64();
    Ok(mesh)
}

/// Takes Steiner points off the surface; returns those that are in the volume now.
///
/// # Errors
/// As [`recover`].
pub fn restore_surface(
    mesh: &mut ConstrainedMesh,
    options: &Options,
    context: &RunContext,
    report: &mut RecoveryReport,
) -> Result<Vec<VertexId>> {
    let start = Instant::now();
    if options.boundary_recovery == RecoveryMode::Full {
        let mut left = eliminate(mesh, options, context)?;
        for _ in 0..MOST_WITHDRAWALS {
            if left == 0 {
                break;
            }
            withdraw_splits(mesh, options, context)?;
            left = eliminate(mesh, options, context)?;
        }
        if left > 0 {
            let places: Vec<DVec3> = mesh.splits.iter().map(|(v, _)| mesh.at(*v)).collect();
            return Err(not_recovered(places, "a point added on the surface could not be taken off it"));
        }
    }
    report.seconds[2] = start.elapsed().as_secs_f64();
    let mut volume = std::mem::take(&mut mesh.volume_points);
    volume.retain(|&vertex| mesh.has_vertex(vertex));
    Ok(volume)
}

/// Undoes the splits that can be undone; returns the number left.
fn eliminate(mesh: &mut ConstrainedMesh, options: &Options, context: &RunContext) -> Result<usize> {
    let mut left = mesh.splits.len();
    let mut volume = std::mem::take(&mut mesh.volume_points);
    for effort in &efforts(options)[1..] {
        if left > 0 {
            left = partition_elimination::eliminate_partitions(mesh, &mut volume, effort, context)?;
        }
    }
    mesh.volume_points = volume;
    Ok(left)
}

/// Takes the splits that resist back as constraints, and recovers the whole edges and facets once more: what is around
/// them has changed since, by all that was eliminated, and their points are out of the way.
fn withdraw_splits(mesh: &mut ConstrainedMesh, options: &Options, context: &RunContext) -> Result<()> {
    let (efforts, edge_efforts) = (efforts(options), edge_efforts(options));
    let mut edges = Vec::new();
    // The last first: it may have split a part that an earlier one made.
    while let Some((steiner, split)) = mesh.splits.pop() {
        edges.extend(partition_elimination::withdraw(mesh, steiner, &split));
        if !steiner_removal::remove_vertex(mesh, steiner, &efforts[2])? {
            steiner_removal::center(mesh, steiner);
            mesh.volume_points.push(steiner);
        }
    }
    let mut seen: FxHashSet<EdgeKey> = FxHashSet::default();
    edges.retain(|e| seen.insert(*e) && mesh.is_segment(e[0], e[1]) && !mesh.has_edge(e[0], e[1]));
    recover_all_edges(mesh, edges, (&edge_efforts, &efforts), context)?;
    let missing = mesh.missing_subfaces();
    recover_all_faces(mesh, missing, (&edge_efforts, &efforts), context)
}

/// Removes Steiner points in the volume; returns those that stay.
///
/// # Errors
/// As [`recover`].
pub fn remove_from_volume(
    mesh: &mut ConstrainedMesh,
    volume: Vec<VertexId>,
    options: &Options,
    context: &RunContext,
    report: &mut RecoveryReport,
) -> Result<Vec<VertexId>> {
    let start = Instant::now();
    // Where points are few merging removes what the largest effort does not, which would add time and hardly anything else.
    let volume = steiner_removal::remove_steiner_points(mesh, volume, &efforts(options)[2], context)?;
    report.seconds[3] = start.elapsed().as_secs_f64();
    Ok(volume)
}

/// Merges Steiner points that removal left in the volume; returns those that stay.
///
/// # Errors
/// As [`recover`].
pub fn merge_in_volume(
    mesh: &mut ConstrainedMesh,
    volume: Vec<VertexId>,
    options: &Options,
    context: &RunContext,
    report: &mut RecoveryReport,
) -> Result<Vec<VertexId>> {
    let start = Instant::now();
    let (efforts, edge_efforts) = (efforts(options), edge_efforts(options));
    let volume = steiner_merging::merge_steiner_points(mesh, volume, (&edge_efforts, &efforts), context)?;
    report.seconds[3] += start.elapsed().as_secs_f64();
    report.steiner_in_volume = volume.len();
    report.reconnections = mesh.reconnections;
    report.cavities = mesh.cavities;
    Ok(volume)
}

fn recover_all_edges(
    mesh: &mut ConstrainedMesh,
    mut missing: Vec<EdgeKey>,
    (edge_efforts, efforts): (&[Effort], &[Effort]),
    context: &RunContext,
) -> Result<()> {
    let mut most = usize::MAX;
    for round in 0..MOST_ROUNDS {
        if round == ROUNDS_OUT_OF_SIGHT {
            most = MOST_GROWTH * (missing.len() + MOST_HARD);
        }
        if missing.len() > most {
            break; // parts as short as rounding lock each other, ever more of them
        }
        let mut fruitless = 0;
        for effort in edge_efforts.iter().chain(efforts.last()) {
            if missing.is_empty() {
                return Ok(());
            }
            let is_few = missing.len() <= MOST_HARD;
            let is_shown_fruitless = fruitless >= MOST_FRUITLESS && !effort.everywhere && effort.turn == 0;
            // Parts of split edges are many, and what did not serve the whole seldom serves them.
            let is_late = effort.tets > 0 && round > 0;
            if is_shown_fruitless || is_late || ((effort.turn > 0 || effort.tets > 0) && !is_few) {
                continue;
            }
            let before = missing.len();
            missing = edge_recovery::recover_edges(mesh, missing, effort, context)?;
            fruitless = if missing.len() < before { 0 } else { fruitless + 1 };
        }
        missing = edge_rerouting::reroute_edges(mesh, missing, &edge_efforts[0], context)?;
        missing = volume_points::unlock_edges(mesh, missing, &efforts[2], context)?;
        if !missing.is_empty() {
            recover_present_faces(mesh, efforts, context)?;
            missing = edge_recovery::recover_edges(mesh, missing, &efforts[2], context)?;
        }
        let mut next = Vec::new();
        for edge in missing {
            context.check()?;
            if !mesh.is_segment(edge[0], edge[1]) {
                continue; // split together with a neighbour
            }
            volume_points::free_edge(mesh, edge);
            if round >= ROUNDS_BY_CHOICE
                && let Some(new) = steiner_points::split_at_all_crossings(mesh, edge)?
            {
                next.extend(new.into_iter().filter(|e| !mesh.has_edge(e[0], e[1])).collect::<Vec<_>>());
                continue;
            }
            // Parts that stay missing however short they get have to come into sight of their ends.
            let mut bridged = Bridge::Missing;
            if round >= ROUNDS_OUT_OF_SIGHT {
                bridged = edge_bridging::split_in_sight(mesh, edge)?;
            }
            if bridged == Bridge::Missing {
                let mut volume = std::mem::take(&mut mesh.volume_points);
                let found = edge_bridging::bridge_edge(mesh, edge, &efforts[2], &mut volume, context);
                mesh.volume_points = volume;
                bridged = found?;
            }
            match bridged {
                Bridge::Present => {}
                Bridge::Missing => next.push(edge),
                Bridge::Split(steiner) => {
                    let new = mesh.split_segment(edge, steiner);
                    next.extend(new.into_iter().filter(|e| !mesh.has_edge(e[0], e[1])).collect::<Vec<_>>());
                }
            }
        }
        next.sort_unstable();
        next.dedup();
        next.retain(|e| mesh.is_segment(e[0], e[1]));
        missing = next;
    }
    if missing.is_empty() {
        return Ok(());
    }
    let places = missing.iter().map(|e| 0.5 * (mesh.at(e[0]) + mesh.at(e[1]))).collect();
    Err(not_recovered(places, "an edge of the surface could not be recovered"))
}

/// Recovers the faces whose edges are there, and keeps them from now on. Edges of the mesh in a plane of the surface may
/// pass before one segment and behind another by rounding: nothing but a face between the two shows that they are wrong,
/// and as long as they are there the flat tets at them hide a vertex from all that is above the plane.
fn recover_present_faces(mesh: &mut ConstrainedMesh, efforts: &[Effort], context: &RunContext) -> Result<()> {
    mesh.keeps_faces = true;
    let mut faces = mesh.missing_subfaces();
    faces.retain(|&[a, b, c]| [[a, b], [b, c], [a, c]].iter().all(|e| mesh.has_edge(e[0], e[1])));
    for effort in &efforts[..3] {
        if !faces.is_empty() {
            faces = face_recovery::recover_faces(mesh, faces, effort, context)?;
        }
    }
    Ok(())
}

fn recover_all_faces(
    mesh: &mut ConstrainedMesh,
    mut missing: Vec<FaceKey>,
    (edge_efforts, efforts): (&[Effort], &[Effort]),
    context: &RunContext,
) -> Result<()> {
    for _ in 0..MOST_ROUNDS {
        for (level, effort) in efforts.iter().enumerate() {
            if missing.is_empty() || (level == 3 && missing.len() > MOST_HARD) {
                break;
            }
            missing = face_recovery::recover_faces(mesh, missing, effort, context)?;
        }
        if missing.is_empty() {
            // Reconnections keep what is recovered; this look is the proof.
            missing = mesh.missing_subfaces();
            if missing.is_empty() {
                return Ok(());
            }
            continue;
        }
        let face = missing[0];
        if volume_points::free_face(mesh, face) {
            missing = mesh.missing_subfaces();
            continue;
        }
        if let Some(new) = steiner_points::split_missing_face(mesh, face)? {
            let absent = new.into_iter().filter(|e| !mesh.has_edge(e[0], e[1])).collect::<Vec<_>>();
            recover_all_edges(mesh, absent, (edge_efforts, efforts), context)?;
        }
        missing = mesh.missing_subfaces();
    }
    if missing.is_empty() {
        return Ok(());
    }
    let places = missing.iter().map(|f| f.iter().map(|&v| mesh.at(v)).sum::<DVec3>() / 3.0).collect();
    Err(not_recovered(places, "a triangle of the surface could not be recovered"))
}

fn not_recovered(places: Vec<DVec3>, text: &str) -> Error {
    let finding =
        |p: &DVec3| Finding::new(FindingCode::NotRecovered, Severity::Error, format!("{text} at {p}")).at(p.to_array());
    let findings: Vec<Finding> = places.iter().map(finding).collect();
    Error::NoResult { message: format!("{text} ({} places)", findings.len()), findings }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::test_meshes::enclosed_mesh;
    use crate::conforming::test_surfaces::cube;
    use crate::mesh::tet_store::TetStore;

    #[test]
    fn a_face_whose_edges_are_there_is_recovered_and_kept() {
        let points = [[1., 0., 0.], [-0.5, 0.8, 0.], [-0.5, -0.8, 0.], [0., 0., 1.], [0., 0., -1.]];
        let mut complex = TetComplex::with_points(points.map(DVec3::from_array).to_vec()).unwrap();
        for row in [[3, 4, 0, 1], [3, 4, 1, 2], [3, 4, 2, 0]] {
            let [a, b, c, d] = row.map(|v: usize| DVec3::from_array(points[v]));
            let positive = crate::geometry::predicates::orient3d(a, b, c, d) > 0.0;
            let row = row.map(|v| VertexId(v as u32));
            let row = if positive { row } else { [row[1], row[0], row[2], row[3]] };
            complex.create_tet(row, crate::index::Label(0)).unwrap();
        }
        complex.pair_faces().unwrap();
        let wanted = [0, 1, 2].map(VertexId);
        let mut mesh = ConstrainedMesh::new(complex, &[wanted]);
        assert_eq!((mesh.missing_segments().len(), mesh.missing_subfaces().len()), (0, 1));
        let context = RunContext::with_threads(1).unwrap();
        recover_present_faces(&mut mesh, &efforts(&Options::default()), &context).unwrap();
        let side = mesh.find_face(wanted).unwrap();
        assert!(mesh.missing_subfaces().is_empty() && mesh.is_subface(side));
        assert_eq!(mesh.complex.finite_tets().count(), 2);
        assert!(edge_removal::plan_flip_23(&mesh, side, None).is_none(), "a face that is kept is not flipped away");
        // A face without one of its edges stays missing.
        mesh.add_subface([0, 3, 4].map(VertexId), 1);
        recover_present_faces(&mut mesh, &efforts(&Options::default()), &context).unwrap();
        assert_eq!(mesh.missing_subfaces(), vec![[0, 3, 4].map(VertexId)]);
        mesh.complex.check_invariants().unwrap();
    }

    #[test]
    fn a_cancelled_recovery_ends_at_once() {
        let surface = crate::conforming::test_surfaces::twisted_prism(3, 20.0, 1);
        let context = RunContext::with_threads(1).unwrap();
        let complex = enclosed_mesh(&surface.points);
        context.cancel_token().cancel();
        let mut report = RecoveryReport::default();
        let recovered =
            recover(complex, &surface.facets, (&Options::default(), EdgeOrder::Ascending), &context, &mut report);
        assert!(report.missing_edges > 0 && matches!(recovered, Err(Error::Cancelled)));
    }

    #[test]
    fn what_cannot_be_recovered_ends_with_findings() {
        // What the input check refuses: a vertex on an edge that is no end of it, and a facet through another facet.
        let on_edge = [[-1., 0., 0.], [1., 0., 0.], [0., 1., 0.], [0., 0., 1.], [0., 0., 0.], [0.5, -1., 0.]];
        let through = [[-1., -1., 0.], [1., -1., 0.], [0., 1., 0.], [0., 0., -1.], [0., 0., 1.], [0., -3., 0.]];
        for (points, facets) in [(on_edge, [[0, 1, 2], [3, 4, 5]]), (through, [[0, 1, 2], [3, 4, 5]])] {
            let points = points.map(DVec3::from_array);
            let facets = facets.map(|f| f.map(VertexId));
            let (context, mut report) = (RunContext::with_threads(1).unwrap(), RecoveryReport::default());
            let (options, ascending) = (Options::default(), EdgeOrder::Ascending);
            let recovered = recover(enclosed_mesh(&points), &facets, (&options, ascending), &context, &mut report);
            let Err(Error::NoResult { findings, .. }) = recovered else { panic!("{:?}", report) };
            assert!(findings.iter().all(|f| f.code == FindingCode::NotRecovered) && !findings.is_empty());
        }
    }

    #[test]
    fn a_split_that_is_taken_back_is_whole_again() {
        let surface = cube(3);
        let context = RunContext::with_threads(1).unwrap();
        let complex = enclosed_mesh(&surface.points);
        let options = Options::default();
        let mut report = RecoveryReport::default();
        let mut mesh =
            recover(complex, &surface.facets, (&options, EdgeOrder::Ascending), &context, &mut report).unwrap();
        assert!(mesh.splits.is_empty());
        let constraints = (mesh.subfaces.clone(), mesh.wings.len());
        // Two splits, the second of a part of the first.
        for _ in 0..2 {
            let last = mesh.splits.last().map(|(v, _)| *v);
            let mut edges: Vec<EdgeKey> = mesh.wings.keys().copied().collect();
            edges.sort_unstable();
            let edge = *edges.iter().find(|e| last.is_none_or(|v| e.contains(&v))).unwrap();
            let at = |v: VertexId| mesh.at(v);
            let steiner = mesh.complex.push_point(0.5 * (at(edge[0]) + at(edge[1]))).unwrap();
            let mut shell = mesh.ball(edge[0]);
            shell.retain(|&tet| mesh.complex.local_vertex(tet, edge[1]).is_some());
            let front = mesh.shape_of(&shell).front;
            let new: Vec<[VertexId; 4]> = front.iter().map(|&[a, b, c]| [a, b, c, steiner]).collect();
            assert!(mesh.replace(&shell, &new).unwrap());
            mesh.split_segment(edge, steiner);
            assert!(mesh.missing_subfaces().is_empty());
        }
        withdraw_splits(&mut mesh, &options, &context).unwrap();
        assert!(mesh.splits.is_empty() && mesh.missing_segments().is_empty() && mesh.missing_subfaces().is_empty());
        assert_eq!(constraints.0.keys().filter(|key| !mesh.subfaces.contains_key(*key)).count(), 0);
        assert_eq!((constraints.0.len(), constraints.1), (mesh.subfaces.len(), mesh.wings.len()));
        mesh.complex.check_invariants().unwrap();
        assert!(mesh.complex.finite_tets().all(|tet| mesh.complex.is_positive(tet)));
    }
}
