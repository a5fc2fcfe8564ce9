//! Refinement: advancing-front points, direct insertion and local reconnection in rounds, until no point is accepted.
//!
//! # Method
//! 1. Sizes of the boundary vertices from the boundary edges; every tet is active. New points interpolate between the
//!    vertices around; the field of the boundary's own mesh bounds that (`boundary_sizes`).
//! 2. While points are accepted, ahead of the front or, where it rests, at the centres of tets far too large: deactivate satisfied tets (`front`), create candidates (`point_placement`), reject
//!    (`point_filter`), insert with in-sphere reconnection (`vertex_insertion`), then reconnect what changed by the
//!    second objective (`local_reconnection`).
//!
//! # Source
//! [Drakopoulos2017] 4.7.1; B.3 `cdf`, `cdfm`, `cdfr`, `cdfn`, `cdff`, `angmax`, `dfmax`, `mrecm`, `mrecm2`, `mrec4`,
//! `ngen`, `nminpts`.
//!
//! # Differences
//! The thesis ends with the front. Where sizes are smaller than the boundary's edges, or parts thinner than their edges
//! are long, the front never leaves the boundary.
//!
//! # Invariants
//! Constrained faces and edges stay; the mesh is valid after every step. One thread: the same bits every time.
//!
//! # Limits
//! Where half the prediction exceeds the element or memory limits, or what the allocator grants, nothing is done and the
//! estimate is in the error; between the two, what is granted is a limit. The allocator knows the machine's memory and the
//! limits of the process, not those of a control group. A mesh that reaches a limit stops there: it is valid, coarser
//! than asked for, and a finding says so.

use std::time::Instant;

use glam::DVec3;
use rayon::prelude::*;

use super::boundary_sizes::BoundarySizes;
use super::front::{RESTING, SATISFIED, Satisfaction, corner_sizes, deactivate, rest, settled_of, wake};
use super::local_reconnection::{FlipCounts, FourFour, Objective};
use super::options::Options;
use super::parallel_reconnection::{Driver, Insert};
use super::point_filter::{Walk, clearances, interpolated_size, is_clear, walk};
use super::point_placement::{Candidate, Placement, create_candidates};
use super::tet_prediction::predicted_tets;
use super::vertex_insertion::InsertionRule;
use crate::context::RunContext;
use crate::error::{Error, Finding, FindingCode, Result, Severity};
use crate::geometry::spatial_sort::{brio_order, hilbert_order};
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::size_field::{SizeField, average_edges};
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::statistics::Statistics;

/// Memory a tet is taken to need in a run with refinement and improvement, bytes: an estimate from the rows of the mesh,
/// the sizes and the lists of a pass.
pub const BYTES_PER_TET: f64 = 110.0;

/// Figures of one round.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Round {
    /// Active tets at its start.
    pub active: usize,
    /// Candidates created.
    pub created: usize,
    /// Candidates left after the first test.
    pub filtered: usize,
    /// Points inserted.
    pub inserted: usize,
    /// Flips of both objectives.
    pub flips: FlipCounts,
    /// Whether candidates were left out for want of room.
    pub stopped: bool,
}

/// The boundary as triangles: every constrained face and every end of the mesh, once.
pub fn boundary_triangles(complex: &TetComplex, context: &RunContext) -> Vec<[VertexId; 3]> {
    let belongs = |side: &TetFace| {
        let other = complex.neighbor(*side);
        other == TetFace::NONE
            || complex.is_face_constrained(*side) && (*side < other || complex.is_ghost_tet(other.tet()))
    };
    let has_one =
        |tet: TetId| complex.flags(tet).has_constrained_face() || complex.neighbors(tet).contains(&TetFace::NONE);
    let tets = context.install(|| complex.finite_tets_where(has_one));
    let sides = tets.into_iter().flat_map(|tet| (0..4).map(move |face| TetFace::new(tet, face)));
    sides.filter(belongs).map(|side| complex.face_vertices(side)).collect()
}

/// Sizes of all vertices: the average boundary edge at boundary vertices times `cdf`, bounded by the field; vertices in
/// the volume (Steiner points) take the average of their neighbours.
///
/// # Errors
/// As [`SizeField::bounded`].
pub fn initial_sizes(complex: &TetComplex, field: &SizeField, factor: f64, context: &RunContext) -> Result<Vec<f64>> {
    let points = complex.points();
    let mut sizes = average_edges(points.len(), points, &boundary_triangles(complex, context));
    let mut sums = vec![(0.0, 0u32); points.len()];
    for tet in complex.finite_tets() {
        let row = complex.vertices(tet);
        for v in row.iter().filter(|v| sizes[v.index()] == 0.0) {
            for w in row.iter().filter(|w| sizes[w.index()] > 0.0) {
                sums[v.index()].0 += sizes[w.index()];
                sums[v.index()].1 += 1;
            }
        }
    }
    let fallback = sizes.iter().copied().fold(0.0, f64::max);
    for (size, (sum, count)) in sizes.iter_mut().zip(&sums) {
        if *size == 0.0 {
            *size = if *count > 0 { sum / f64::from(*count) } else { fallback };
        }
    }
    sizes.iter().zip(points).map(|(size, point)| field.bounded(*point, factor * size)).collect()
}

/// Refines the mesh and returns the figures; `sizes` has one entry per vertex and grows with them.
///
/// # Errors
/// [`Error::LimitReached`] or [`Error::OutOfMemory`] where elements or memory would not suffice, predicted before the
/// work; [`Error::Cancelled`]; those of the size field.
pub fn refine(
    complex: &mut TetComplex,
    sizes: &mut Vec<f64>,
    field: &SizeField,
    options: &Options,
    context: &RunContext,
) -> Result<Statistics> {
    let start = Instant::now();
    let mut figures = Statistics::default();
    let predicted = predicted_tets(complex, sizes, field, options.growth_rate, context)?;
    let limit = tet_limit(options);
    if predicted > PREDICTION_MARGIN * limit as f64 {
        check_limits(options, predicted, "predicted")?;
    }
    check_memory(predicted / PREDICTION_MARGIN)?;
    let limit = limit.min(granted_tets(predicted));
    figures.set("refinement.predicted_tets", predicted);
    // One block at the start instead of growth by doubling, which holds old and new rows at once.
    complex.try_reserve_tets(options.reserved_elements.min((1.1 * predicted) as usize))?;
    let mut driver = Driver::for_refinement(options, context);
    let mut active: Vec<TetId> = complex.finite_tets().collect();
    let satisfaction = Satisfaction::new(options.edge_satisfied_factor, options.satisfied_angle);
    context.install(|| settled_of(complex, sizes, satisfaction, &mut active));
    let mut unused: Vec<VertexId> = Vec::new();
    let mut clearances =
        clearances(complex.points(), &boundary_triangles(complex, context), sizes, options.size_factor);
    let mut boundary = BoundarySizes::new(complex, sizes);
    let mut total = Round::default();
    let mut rounds = 0;
    let mut places = Places::Front;
    let known = complex.vertex_count();
    let mut next_renumbering = SMALLEST_RENUMBERING.max(GROWTH_OF_RENUMBERING * complex.live_count());
    while rounds < options.maximum_passes {
        context.check()?;
        let room = limit.saturating_sub(complex.live_count()) / TETS_PER_POINT;
        let mut round = refine_round(
            complex,
            (sizes, &mut clearances, &mut boundary),
            field,
            options,
            context,
            &mut driver,
            &mut active,
            &mut unused,
            room,
            places,
        )?;
        rounds += 1;
        total.created += round.created;
        total.filtered += round.filtered;
        total.inserted += round.inserted;
        total.flips.add(round.flips);
        record_round(&mut figures, rounds, &round);
        let done = complex.live_count() as f64 / predicted.max(1.0);
        context.progress("refinement", 0.15 + 0.5 * done.min(1.0));
        if std::mem::take(&mut round.stopped) {
            report_stop(complex, limit, context);
            figures.set("refinement.stopped_at_limit", 1.0);
            break;
        }
        if round.inserted < options.minimum_points.max(1) {
            if places == Places::Centers {
                break;
            }
            // The front has come to rest; tets that it did not reach may still be far too large.
            places = Places::Centers;
            clear_rest(complex);
            let is_left = |tet| !complex.flags(tet).has_user_bit(SATISFIED);
            active = context.install(|| complex.finite_tets_where(is_left));
            continue;
        }
        places = Places::Front;
        if complex.live_count() > next_renumbering {
            next_renumbering = GROWTH_OF_RENUMBERING * complex.live_count();
            let renumbering = context.install(|| complex.renumber_along_curve(known))?;
            *sizes = renumbering.of_vertices(sizes);
            clearances = renumbering.of_vertices(&clearances);
            boundary.renumber(&renumbering);
            active.iter_mut().for_each(|tet| *tet = renumbering.tet(*tet));
            let mut new_of = vec![VertexId(0); sizes.len()];
            renumbering
                .old_of_vertex
                .iter()
                .enumerate()
                .for_each(|(new, &old)| new_of[old as usize] = VertexId::from_index(new));
            unused.iter_mut().for_each(|vertex| *vertex = new_of[vertex.index()]);
        }
    }
    clear_marks(complex);
    driver.record(&mut figures, "refinement");
    figures.set("refinement.rounds", rounds as f64);
    figures.set("refinement.points_tried", total.created as f64);
    figures.set("refinement.points_filtered", total.filtered as f64);
    figures.set("refinement.points_accepted", total.inserted as f64);
    figures.set("refinement.flips_tried", total.flips.tried as f64);
    figures.set("refinement.flips_accepted", total.flips.accepted as f64);
    figures.set("refinement.flips_lost", total.flips.lost as f64);
    figures.set("time.refinement", start.elapsed().as_secs_f64());
    Ok(figures)
}

/// Meshes are renumbered when they have grown by this factor: what a round creates lies where the slots of earlier rounds
/// became free.
const GROWTH_OF_RENUMBERING: usize = 2;
/// Smaller meshes lie in the cache of the processor in any order.
const SMALLEST_RENUMBERING: usize = 200_000;

/// Rounds listed one by one in the statistics.
const LISTED_ROUNDS: usize = 200;

fn record_round(figures: &mut Statistics, number: usize, round: &Round) {
    if number > LISTED_ROUNDS {
        return;
    }
    for (name, value) in [
        ("active", round.active as f64),
        ("tried", round.created as f64),
        ("accepted", round.inserted as f64),
        ("flips_tried", round.flips.tried as f64),
        ("flips_accepted", round.flips.accepted as f64),
        ("flips_lost", round.flips.lost as f64),
    ] {
        figures.set(format!("refinement.round.{number}.{name}"), value);
    }
}

/// Whether so many tets are within the limits of the options and of the numbering.
///
/// # Errors
/// [`Error::LimitReached`].
pub fn check_limits(options: &Options, tets: f64, what: &str) -> Result<()> {
    let megabytes = tets * BYTES_PER_TET / 1e6;
    if options.maximum_elements > 0 && tets > options.maximum_elements as f64 {
        return Err(Error::LimitReached {
            reason: format!("{tets:.3e} elements {what}, at most {} allowed", options.maximum_elements),
        });
    }
    if options.maximum_memory_megabytes > 0.0 && megabytes > options.maximum_memory_megabytes {
        return Err(Error::LimitReached {
            reason: format!(
                "{tets:.3e} elements {what} need about {megabytes:.0} MB, at most {:.0} MB allowed",
                options.maximum_memory_megabytes
            ),
        });
    }
    let capacity = crate::mesh::tet_complex::MAX_TETS;
    if tets > capacity as f64 {
        let reason = format!(
            "{tets:.3e} elements {what} need about {megabytes:.3e} MB; a mesh has at most {capacity} elements: larger sizes \
             give fewer"
        );
        return Err(Error::LimitReached { reason });
    }
    Ok(())
}

/// Factor by which a prediction may be too high (at most 1.8 was seen, on a far field with sizes half the boundary's
/// edges): within it the work starts, and stops at the limit if it has to.
const PREDICTION_MARGIN: f64 = 2.0;

/// Tets that a new point adds at most, on average over a round.
const TETS_PER_POINT: usize = 8;

/// The most tets that options and numbering allow.
fn tet_limit(options: &Options) -> usize {
    let mut limit = crate::mesh::tet_complex::MAX_TETS;
    if options.maximum_elements > 0 {
        limit = limit.min(options.maximum_elements);
    }
    if options.maximum_memory_megabytes > 0.0 {
        limit = limit.min((options.maximum_memory_megabytes * 1e6 / BYTES_PER_TET) as usize);
    }
    limit
}

/// Whether the allocator would grant what so many tets need: it refuses what the machine, or the limit set for the
/// process, could never hold. No page of it is touched.
fn check_memory(tets: f64) -> Result<()> {
    let bytes = tets * BYTES_PER_TET;
    if !is_granted(bytes) {
        return Err(Error::OutOfMemory { what: "the predicted mesh", bytes: bytes as u64 });
    }
    Ok(())
}

fn is_granted(bytes: f64) -> bool {
    let mut probe: Vec<u8> = Vec::new();
    bytes < isize::MAX as f64 && probe.try_reserve_exact(bytes as usize).is_ok()
}

/// Most bytes a tet that were seen with refinement, renumbering and improvement on two threads.
const MOST_BYTES_PER_TET: f64 = 150.0;
/// Share of the memory that the allocator grants at once that is taken; the rest is for what else runs.
const MEMORY_SHARE: f64 = 0.75;

/// How many tets the memory holds, where the predicted ones may not fit: refinement stops there with a valid mesh.
fn granted_tets(predicted: f64) -> usize {
    let mut bytes = PREDICTION_MARGIN * predicted * MOST_BYTES_PER_TET;
    if is_granted(bytes) {
        return usize::MAX;
    }
    while !is_granted(bytes) {
        bytes *= MEMORY_SHARE;
    }
    (MEMORY_SHARE * bytes / MOST_BYTES_PER_TET) as usize
}

fn report_stop(complex: &TetComplex, limit: usize, context: &RunContext) {
    let text = format!(
        "refinement stopped at {} elements, because at most {limit} are allowed: the mesh is valid but coarser than asked for",
        complex.live_count()
    );
    context.report(Finding::new(FindingCode::Other, Severity::Warning, text));
}

/// Where the points of a round come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Places {
    /// Ahead of the front.
    Front,
    /// The centres of tets that the front did not reach: it stops where the boundary's edges are longer than the sizes
    /// (no tet there is ever satisfied) or where its points are too close to another part of the boundary.
    Centers,
}

/// Edges longer than this many times the average size of their ends are out of the range that meshes are judged by: with
/// the default factor of 1.2 they are twice as long as the boundary's.
const FAR_TOO_LONG: f64 = 1.7;
/// How far the centres of such tets stay from other points, in shares of the average of their sizes: as far as vertices do in
/// quality improvement. With the distance that points ahead of the front keep (`cdfn`), hardly any centre is left between
/// walls whose vertices have uneven edges, and on a gear every fifth edge stays too long.
const NEAR_CENTER: f64 = 0.5;

fn centers_of_large(complex: &TetComplex, sizes: &[f64], active: &[TetId]) -> Vec<Candidate> {
    let tolerated = Satisfaction::new(FAR_TOO_LONG, 180.0);
    let place = |&tet: &TetId| {
        let (corners, corner_sizes) = (complex.points_of(tet), corner_sizes(complex, sizes, tet));
        let point = corners.iter().sum::<DVec3>() / 4.0;
        let scale = corner_sizes.iter().sum::<f64>() / 4.0;
        (!tolerated.is_short(corners, corner_sizes)).then_some(Candidate { point, scale, tet })
    };
    active.par_iter().with_min_len(1024).filter_map(place).collect()
}

fn clear_rest(complex: &mut TetComplex) {
    for tet in (0..complex.slot_count()).map(TetId::from_index) {
        if complex.is_live(tet) {
            complex.set_flags(tet, complex.flags(tet).with_user_bit(RESTING, false));
        }
    }
}

fn clear_marks(complex: &mut TetComplex) {
    for tet in (0..complex.slot_count()).map(TetId::from_index) {
        if !complex.is_live(tet) {
            continue;
        }
        let flags = complex.flags(tet);
        complex.set_flags(tet, flags.without_user_bits());
    }
}

#[allow(clippy::too_many_arguments, reason = "the state of the rounds, kept apart so that each is borrowed alone")]
fn refine_round(
    complex: &mut TetComplex,
    (sizes, clearances, boundary): (&mut Vec<f64>, &mut Vec<f64>, &mut BoundarySizes),
    field: &SizeField,
    options: &Options,
    context: &RunContext,
    driver: &mut Driver,
    active: &mut Vec<TetId>,
    unused: &mut Vec<VertexId>,
    room: usize,
    places: Places,
) -> Result<Round> {
    if !options.group_active {
        *active = context.install(|| complex.finite_tets_where(|tet| !complex.flags(tet).has_user_bit(RESTING)));
    }
    let satisfaction = Satisfaction::new(options.edge_satisfied_factor, options.satisfied_angle);
    let placement = Placement {
        growth_rate: options.growth_rate,
        near_factor: options.near_point_factor,
        accurate_normals: options.accurate_normals,
    };
    let near_factor = match places {
        Places::Front => options.near_point_factor,
        Places::Centers => options.near_point_factor.min(NEAR_CENTER),
    };
    let mut round = Round::default();
    context.install(|| deactivate(complex, sizes, satisfaction, active));
    round.active = active.len();
    let candidates = context.install(|| match places {
        Places::Front => create_candidates(complex, sizes, active, &placement),
        Places::Centers => centers_of_large(complex, sizes, active),
    });
    round.created = candidates.len();
    let fields = (&**sizes, &**clearances, &*boundary, field);
    let accepted = context.install(|| filter(complex, fields, options, near_factor, &candidates))?;
    drop(candidates);
    round.filtered = accepted.len();
    rest(complex, active);
    let mut accepted = accepted;
    round.stopped = accepted.len() > room;
    accepted.truncate(room);
    let (accepted, ends) =
        if options.sort_new_points { sorted_along_curve(&accepted)? } else { (accepted.clone(), vec![accepted.len()]) };
    let inserts = assign_vertices(complex, (sizes, boundary), &accepted, unused)?;
    let rule = InsertionRule {
        near_factor,
        snap_tolerance: if options.snap_location { options.location_tolerance } else { 0.0 },
    };
    let mut fresh = Vec::new();
    let count = inserts.len();
    clearances.resize(sizes.len(), 0.0);
    inserts.iter().for_each(|insert| clearances[insert.vertex.index()] = sizes[insert.vertex.index()]);
    let rejected = driver.insert(complex, clearances, (&inserts, &ends), &rule, &mut fresh)?;
    round.inserted = count - rejected.len();
    // The walk to them failed; another will not.
    let mut unreached: Vec<VertexId> = rejected.iter().filter(|r| r.unreached).map(|r| r.vertex).collect();
    unreached.sort_unstable();
    let places = inserts.iter().zip(&accepted);
    let origins = places.filter(|(i, _)| unreached.binary_search(&i.vertex).is_ok()).map(|(_, place)| place.origin);
    wake(complex, origins, active);
    drop((inserts, accepted));
    unused.extend(rejected.into_iter().map(|r| r.vertex));
    let objective = match options.reconnection_criterion {
        1 => Objective::InSphere,
        2 => Objective::EdgeWeight,
        _ => Objective::Skew,
    };
    let four = match (options.flip_44, options.flip_44_quality) {
        (false, _) => FourFour::Off,
        (true, false) => FourFour::First,
        (true, true) => FourFour::Best,
    };
    let repeats = if options.repeat_reconnection { usize::MAX } else { 1 };
    // Tets that still have a long edge will be replaced by points: the second objective is for those that may stay.
    let mut settled = context.install(|| settled_of(complex, sizes, satisfaction, &mut fresh));
    let known = settled.len();
    driver.reconnect(complex, &mut settled, objective, four, repeats)?;
    round.flips = driver.take_counts();
    active.extend(fresh);
    active.extend_from_slice(&settled[known..]);
    Ok(round)
}

/// A candidate that passed the first test.
#[derive(Clone, Copy)]
struct Accepted {
    point: DVec3,
    size: f64,
    /// The tet that contains it.
    tet: TetId,
    /// The tet whose front face it advances from.
    origin: TetId,
    /// The tet of the boundary's mesh that contains it, `NONE` where it was not found.
    place: TetId,
}

/// The least share of the boundary's field at a new point that it gets. Ahead of a small facet among large ones the local
/// front is much finer than the sizes of its vertices, and where the field grows faster than the growth rate, all that follows
/// is: points would crowd there, all edges too short. With the default factors, points of this share keep 0.7 of 0.6 of 1.2 of
/// the boundary's edges from each other: half of them. A share of the size interpolated between points that got a share
/// themselves would be no limit: on a fine wing in a far field a quarter of all edges was shorter than half the field.
const LEAST_SHARE: f64 = 0.6;

/// The first test of the candidates, in parallel: where they lie, how large they are, what is too close.
fn filter(
    complex: &TetComplex,
    (sizes, clearances, boundary, field): (&[f64], &[f64], &BoundarySizes, &SizeField),
    options: &Options,
    near_factor: f64,
    candidates: &[Candidate],
) -> Result<Vec<Accepted>> {
    let is_free = field.is_free();
    let test = |candidate: &Candidate| -> Option<Result<Accepted>> {
        let Walk::Inside(tet) = walk(complex, candidate.tet, candidate.point, false) else { return None };
        let interpolated = interpolated_size(complex, sizes, tet, candidate.point, options.size_minimum_weight);
        let found = boundary.at(complex, tet, candidate.point, options.size_minimum_weight);
        let (of_boundary, place) = found.unwrap_or((f64::INFINITY, TetId::NONE));
        let local = interpolated.min(of_boundary);
        let least = LEAST_SHARE * found.map_or(local, |_| of_boundary);
        let wanted = local.min(options.growth_rate * candidate.scale).max(least);
        let size = if is_free { Ok(wanted) } else { field.bounded_in(complex.label(tet), candidate.point, wanted) };
        let size = match size {
            Ok(size) => size,
            Err(error) => return Some(Err(error)),
        };
        is_clear(complex, clearances, tet, candidate.point, size, near_factor).then_some(Ok(Accepted {
            point: candidate.point,
            size,
            tet,
            origin: candidate.tet,
            place,
        }))
    };
    candidates.par_iter().with_min_len(256).filter_map(test).collect()
}

/// Accepted candidates in random rounds of doubling size, each along a Hilbert curve [AmentaChoiRote2003]: neighbours in
/// space become neighbours in memory and in the work, and the few first points break up tets that reach across the
/// domain before the many come (round a sphere every early cavity is the whole mesh). Threads that began with different
/// rounds would all meet such cavities, so the ends of the rounds are returned too.
fn sorted_along_curve(accepted: &[Accepted]) -> Result<(Vec<Accepted>, Vec<usize>)> {
    let points: Vec<DVec3> = accepted.iter().map(|a| a.point).collect();
    let mut order = hilbert_order(&points)?;
    let (random, ends) = brio_order(points.len(), 0);
    let mut round_of = vec![0u32; points.len()];
    let mut begin = 0;
    for (round, &end) in ends.iter().enumerate() {
        random[begin..end].iter().for_each(|&i| round_of[i as usize] = round as u32);
        begin = end;
    }
    // Stable: the curve's order stays within a round.
    order.sort_by_key(|&i| round_of[i as usize]);
    Ok((order.into_iter().map(|i| accepted[i as usize]).collect(), ends))
}

/// Gives every accepted candidate a vertex: ones left over from earlier rounds first.
fn assign_vertices(
    complex: &mut TetComplex,
    (sizes, boundary): (&mut Vec<f64>, &mut BoundarySizes),
    accepted: &[Accepted],
    unused: &mut Vec<VertexId>,
) -> Result<Vec<Insert>> {
    let mut inserts = Vec::with_capacity(accepted.len());
    for Accepted { point, size, tet, place, .. } in accepted {
        let near = nearest_corner(complex, *tet, *point);
        let vertex = match unused.pop() {
            Some(vertex) => {
                complex.set_point(vertex, *point);
                sizes[vertex.index()] = *size;
                vertex
            }
            None => {
                sizes.push(*size);
                complex.push_point(*point)?
            }
        };
        boundary.set_place(vertex, *place);
        inserts.push(Insert { vertex, start: *tet, near });
    }
    Ok(inserts)
}

fn nearest_corner(complex: &TetComplex, tet: TetId, point: DVec3) -> VertexId {
    let [a, b, c, d] = complex.vertices(tet);
    let nearer = |v: VertexId, w: VertexId| {
        let is_nearer = complex.point(w).distance_squared(point) < complex.point(v).distance_squared(point);
        if is_nearer { w } else { v }
    };
    nearer(nearer(a, b), nearer(c, d))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_tets_than_can_be_counted_are_named_as_they_were_predicted() {
        let message = check_limits(&Options::default(), 3.1e28, "predicted").unwrap_err().to_string();
        assert!(message.contains("3.100e28 elements predicted") && message.contains("1073741823"), "{message}");
    }

    #[test]
    fn what_the_allocator_refuses_is_a_limit() {
        assert_eq!(granted_tets(1000.0), usize::MAX);
        let most = granted_tets(1e15);
        assert!(most > 1000 && (most as f64) < 1e15);
        assert!(is_granted(most as f64 * MOST_BYTES_PER_TET) && !is_granted(f64::INFINITY));
    }
}
