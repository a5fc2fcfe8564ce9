//! The Delaunay tetrahedralization of a point set.
//!
//! # Method
//! 1. Check the coordinates; sort the points along the Hilbert curve into the kernel's storage.
//! 2. Make the first tet from the first four points of the insertion order that span space, and its ghost tets.
//! 3. Insert the other points round by round (BRIO): walk to the tet that contains the point, from the last tet
//!    made; replace the cavity. Points equal to a vertex are recorded and left out.
//! 4. Close up the slots, go back to the caller's numbering and hand over a [`TetComplex`].
//!
//! With several threads, large point sets go through `delaunay_parallel` in step 3.
//! # Source
//! [Drakopoulos2017] section 4.4; [Bowyer1981], [Watson1981]; [AmentaChoiRote2003]; data layout after
//! [MarotPellerinRemacle2019].
//! # Differences
//! Ghost tets instead of a box of eight outer vertices: the result is the tetrahedralization of the convex hull exactly.
//! # Invariants
//! Vertex `i` of the complex is point `i`, bit for bit. The set of tets is unique (symbolic perturbation): it depends
//! neither on the order of insertion nor on the thread count; their numbers do, unless they are to be reproducible.
//! # Cost
//! O(n log n) expected for what surfaces and volumes look like. Peak about 37 B a tet and 40 B a point, 48 B a tet where the
//! numbers are to be reproducible.
//! # Limits
//! Coordinates up to 1e60 in magnitude: fifth powers have to stay finite.

use std::time::Instant;

use glam::DVec3;
use rayon::prelude::*;

use super::cavity::{Arithmetic, Cavity, Insertion};
use super::delaunay_numbering::VertexNames;
use super::kernel_mesh::{ExclusiveMesh, KernelMesh, KernelRows, StoredPoint};
use super::point_location::{Location, locate};
use super::{delaunay_numbering, delaunay_parallel};
use crate::context::RunContext;
use crate::error::{Error, Finding, FindingCode, Result, Severity};
use crate::geometry::predicates::{are_collinear, orient3d};
use crate::geometry::spatial_sort::{brio_order, hilbert_order, mix};
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::TET_FACES;
use crate::mesh::tet_complex::TetComplex;

/// Magnitude of a coordinate above which the predicates' products may overflow.
pub(super) const LARGEST_COORDINATE: f64 = 1e60;

/// Insertions between two looks at the cancellation flag: about a millisecond.
const CHECK_INTERVAL: usize = 1024;
/// Tets per parallel chunk of the handing over.
const HANDED_OVER: usize = 4096;

/// Ghost and finite tets a point has in a random set (6.77) and the slack for other sets; more is allocated on demand.
const EXPECTED_TETS: f64 = 7.0;

/// The order in which points are inserted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PointOrder {
    /// As given (`sort 0`).
    Input,
    /// A random permutation (`sort 1`).
    Random,
    /// Rounds at random, each along the Hilbert curve (`sort 2`).
    #[default]
    Spatial,
}

/// The numbers of the tets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TetNumbers {
    /// As the insertion left them: with several threads, different from run to run.
    #[default]
    AsMade,
    /// The same for any number of threads.
    Reproducible,
}

/// What a caller can choose.
#[derive(Debug, Clone, Default)]
pub struct DelaunayOptions {
    /// Order of insertion; the result does not depend on it, the time does.
    pub order: PointOrder,
    /// Seed of the random order and of the rounds.
    pub seed: u64,
    /// Numbers of the tets; the set of tets does not depend on it.
    pub numbers: TetNumbers,
}

/// Counts and times of one run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct DelaunayReport {
    /// Seconds to sort.
    pub sort_seconds: f64,
    /// Seconds to insert.
    pub insertion_seconds: f64,
    /// Seconds to hand over.
    pub conversion_seconds: f64,
    /// In-sphere tests that needed exact arithmetic.
    pub exact_tests: u64,
    /// Insertions that a thread had to leave to a later round (parallel runs).
    pub deferred: u64,
    /// Threads that inserted.
    pub threads: usize,
}

/// The result of [`tetrahedralize`].
#[derive(Debug, Clone)]
pub struct Delaunay {
    /// All points, the tets of their convex hull, and its ghost tets.
    pub complex: TetComplex,
    /// Points equal to an earlier one `(duplicate, kept)`, sorted; a duplicate has no tets.
    pub duplicates: Vec<(VertexId, VertexId)>,
    /// Counts and times.
    pub report: DelaunayReport,
}

/// Makes the Delaunay tetrahedralization of `points`.
///
/// # Errors
/// `InvalidInput` with findings for non-finite or huge coordinates and for fewer than four points that span space;
/// `CapacityExceeded`, `OutOfMemory`, `Cancelled`, `LimitReached`.
pub fn tetrahedralize(points: &[DVec3], options: &DelaunayOptions, context: &RunContext) -> Result<Delaunay> {
    context.install(|| run(points, options, context))
}

fn run(points: &[DVec3], options: &DelaunayOptions, context: &RunContext) -> Result<Delaunay> {
    check_coordinates(points)?;
    let clock = Instant::now();
    let (stored, order, round_ends) = sorted_points(points, options)?;
    context.check()?;
    let mut report = DelaunayReport { sort_seconds: clock.elapsed().as_secs_f64(), threads: 1, ..Default::default() };
    let clock = Instant::now();
    let mut kernel = Kernel::start(&stored, order, round_ends, context)?;
    drop_first_simplex(&mut kernel);
    let threads = if options.order == PointOrder::Spatial { context.threads() } else { 1 };
    kernel.insert_all(threads, &mut report)?;
    report.insertion_seconds = clock.elapsed().as_secs_f64();
    report.exact_tests += kernel.cavity.exact_tests;
    let clock = Instant::now();
    // Where no round is large enough for threads, or they are not used, there is only one way.
    let is_shared = options.order == PointOrder::Spatial && kernel.has_large_round(2);
    let renumber = options.numbers == TetNumbers::Reproducible && is_shared;
    let Kernel { rows, duplicates, .. } = kernel;
    let places = renumber.then(|| insertion_places(points.len(), options.seed));
    let (complex, duplicates) = hand_over(points, stored, rows, duplicates, places)?;
    report.conversion_seconds = clock.elapsed().as_secs_f64();
    Ok(Delaunay { complex, duplicates, report })
}

fn check_coordinates(points: &[DVec3]) -> Result<()> {
    let is_bad = |p: &DVec3| !(p.abs().max_element() <= LARGEST_COORDINATE && p.is_finite());
    let findings: Vec<Finding> = points
        .iter()
        .enumerate()
        .filter(|(_, p)| is_bad(p))
        .map(|(i, p)| {
            let text = format!("point {i} has the coordinates {} {} {}", p.x, p.y, p.z);
            Finding::new(FindingCode::NonFiniteCoordinate, Severity::Error, text).with_ids(i as i64, -1)
        })
        .collect();
    if findings.is_empty() {
        return Ok(());
    }
    let message = format!("{} points have coordinates that are not finite or above 1e60", findings.len());
    Err(Error::InvalidInput { message, findings })
}

/// Step 1: points in storage order, and positions in insertion order with the ends of the rounds.
fn sorted_points(points: &[DVec3], options: &DelaunayOptions) -> Result<(Vec<StoredPoint>, Vec<u32>, Vec<usize>)> {
    let count = points.len();
    let store = |order: &[u32]| -> Vec<StoredPoint> {
        order.iter().map(|&input| StoredPoint { point: points[input as usize], input }).collect()
    };
    let curve = if options.order == PointOrder::Spatial {
        hilbert_order(points)?
    } else {
        VertexId::try_new(count)?;
        let mut order: Vec<u32> = (0..count as u32).collect();
        if options.order == PointOrder::Random {
            order.sort_by_key(|&i| mix(options.seed ^ mix(u64::from(i) + 1)));
        }
        order
    };
    let stored = store(&curve);
    drop(curve);
    let (order, ends) = match options.order {
        PointOrder::Spatial => brio_order(count, options.seed),
        PointOrder::Input | PointOrder::Random => ((0..count as u32).collect(), vec![count]),
    };
    Ok((stored, order, ends))
}

/// State of one run.
pub(super) struct Kernel<'a> {
    pub points: &'a [StoredPoint],
    pub order: Vec<u32>,
    pub round_ends: Vec<usize>,
    pub rows: KernelRows,
    pub cavity: Cavity,
    pub duplicates: Vec<(VertexId, VertexId)>,
    pub arithmetic: Arithmetic,
    pub context: &'a RunContext,
    hint: TetId,
    first_simplex: [usize; 4],
}

impl<'a> Kernel<'a> {
    /// Step 2.
    fn start(
        points: &'a [StoredPoint],
        order: Vec<u32>,
        round_ends: Vec<usize>,
        context: &'a RunContext,
    ) -> Result<Self> {
        let first_simplex = first_simplex(points, &order)?;
        let low = points.iter().fold(DVec3::INFINITY, |low, p| low.min(p.point));
        let high = points.iter().fold(DVec3::NEG_INFINITY, |high, p| high.max(p.point));
        let arithmetic = Arithmetic::new(points.iter().map(|p| p.point), low, high);
        let mut rows = KernelRows::with_capacity((points.len() as f64 * EXPECTED_TETS) as usize + 64)?;
        let corners = first_simplex.map(|i| VertexId(order[i]));
        make_first_tets(&mut ExclusiveMesh { points, rows: &mut rows }, corners);
        Ok(Self {
            points,
            order,
            round_ends,
            rows,
            cavity: Cavity::new(arithmetic),
            duplicates: Vec::new(),
            arithmetic,
            context,
            hint: TetId(0),
            first_simplex,
        })
    }

    /// Step 3.
    fn insert_all(&mut self, threads: usize, report: &mut DelaunayReport) -> Result<()> {
        let mut begin = 0;
        for round in 0..self.round_ends.len() {
            let end = self.round_ends[round];
            if threads > 1 && end - begin >= delaunay_parallel::SMALLEST_ROUND * threads {
                delaunay_parallel::insert_round(self, begin..end, threads, report)?;
            } else {
                self.insert_range(begin, end)?;
            }
            begin = end;
        }
        Ok(())
    }

    /// Whether some round is inserted by so many threads where there are that many.
    fn has_large_round(&self, threads: usize) -> bool {
        let begins = std::iter::once(&0).chain(&self.round_ends);
        begins.zip(&self.round_ends).any(|(b, e)| e - b >= delaunay_parallel::SMALLEST_ROUND * threads)
    }

    /// Inserts positions `begin..end` of the order on this thread.
    pub fn insert_range(&mut self, begin: usize, end: usize) -> Result<()> {
        let mut mesh = ExclusiveMesh { points: self.points, rows: &mut self.rows };
        for i in begin..end {
            if i % CHECK_INTERVAL == 0 {
                self.context.check()?;
                let slots = mesh.rows.marks.capacity() - mesh.rows.slots();
                if slots < 64 * CHECK_INTERVAL {
                    let more = (mesh.rows.slots() / 8).max(64 * CHECK_INTERVAL);
                    mesh.rows.reserve(more)?;
                }
            }
            let vertex = VertexId(self.order[i]);
            let point = mesh.point(vertex);
            match locate(&mesh, point, self.hint, &self.cavity.granularity()) {
                Location::Vertex(kept) => self.duplicates.push((vertex, kept)),
                Location::Tet(tet) => match self.cavity.insert(&mut mesh, vertex, tet) {
                    Insertion::Inserted(tet) => self.hint = tet,
                    Insertion::NoRoom => {
                        let limit = crate::mesh::tet_complex::MAX_TETS as u64;
                        return Err(Error::CapacityExceeded { what: "tets", needed: limit + 1, limit });
                    }
                    Insertion::Claimed | Insertion::Moved => return Err(blocked()),
                },
                Location::Lost => return Err(blocked()),
            }
        }
        Ok(())
    }

    /// Walks start anew from some live tet: others have changed the mesh.
    pub fn restart(&mut self) {
        let slot = (0..self.rows.slots()).find(|&s| !self.rows.is_free(s));
        self.hint = TetId::from_index(slot.expect("a kernel that was started has tets"));
    }
}

/// One thread alone loses neither a tet nor its way.
fn blocked() -> Error {
    Error::Internal { reason: "an insertion without other threads was blocked".into() }
}

/// Takes the vertices of the first tet out of the order.
fn drop_first_simplex(kernel: &mut Kernel<'_>) {
    let mut places = kernel.first_simplex;
    places.sort_unstable();
    for place in places.into_iter().rev() {
        kernel.order.remove(place);
        for end in kernel.round_ends.iter_mut().filter(|end| **end > place) {
            *end -= 1;
        }
    }
}

/// Positions in the order of four points that span space.
fn first_simplex(points: &[StoredPoint], order: &[u32]) -> Result<[usize; 4]> {
    let at = |i: usize| points[order[i] as usize].point;
    let find = |test: &dyn Fn(DVec3) -> bool, what: &str| {
        (1..order.len()).find(|&i| test(at(i))).ok_or_else(|| {
            let message = format!("the {} points have no volume: {what}", order.len());
            let finding = Finding::new(FindingCode::DegeneratePointSet, Severity::Error, message.clone());
            Error::InvalidInput { message, findings: vec![finding] }
        })
    };
    if order.is_empty() {
        return Err(Error::input("there are no points"));
    }
    let a = at(0);
    let i = find(&|p| p != a, "all of them are equal")?;
    let b = at(i);
    let j = find(&|p| !are_collinear(a, b, p), "all of them lie on one line")?;
    let c = at(j);
    let k = find(&|p| orient3d(a, b, c, p) != 0.0, "all of them lie in one plane")?;
    if orient3d(a, b, c, at(k)) > 0.0 { Ok([0, i, j, k]) } else { Ok([0, j, i, k]) }
}

/// One positive tet, and a ghost tet on each of its faces.
fn make_first_tets<M: KernelMesh>(mesh: &mut M, corners: [VertexId; 4]) {
    let mut rows = vec![corners];
    for face in TET_FACES {
        // Behind the face, which is outward from the tet, the ghost is on the positive side.
        let [a, b, c] = face.map(|i| corners[i]);
        rows.push([a, b, c, VertexId::GHOST]);
    }
    for row in &rows {
        let tet = mesh.take_slot();
        mesh.set_row(tet, *row, [TetFace::NONE; 4]);
    }
    let side_vertices = |side: usize| {
        let mut v = TET_FACES[side % 4].map(|i| rows[side / 4][i]);
        v.sort_unstable();
        v
    };
    for side in 0..20 {
        let other = (0..20).find(|&o| o != side && side_vertices(o) == side_vertices(side));
        let other = other.expect("the boundary of a 4-simplex is closed");
        mesh.set_neighbor(TetFace(side as u32), TetFace(other as u32));
    }
}

/// For each place in storage one more than that in the order of insertion.
fn insertion_places(count: usize, seed: u64) -> Vec<u32> {
    let (order, _) = brio_order(count, seed);
    let mut places = vec![0; count];
    for (place, &stored) in (1..).zip(&order) {
        places[stored as usize] = place;
    }
    places
}

/// Step 4. Of equal points the first one in the input is kept.
fn hand_over(
    points: &[DVec3],
    stored: Vec<StoredPoint>,
    mut rows: KernelRows,
    duplicates: Vec<(VertexId, VertexId)>,
    places: Option<Vec<u32>>,
) -> Result<(TetComplex, Vec<(VertexId, VertexId)>)> {
    let places = places.map(|places| unify_equal_points(places, &duplicates));
    let mut to_input: Vec<VertexId> = stored.iter().map(|p| VertexId(p.input)).collect();
    drop(stored);
    let mut first_of = rustc_hash::FxHashMap::default();
    let input_of = |stored: &VertexId| to_input[stored.index()];
    for (duplicate, kept) in &duplicates {
        let first = first_of.entry(*kept).or_insert(input_of(kept));
        *first = (*first).min(input_of(duplicate));
    }
    let groups =
        duplicates.iter().flat_map(|(duplicate, kept)| [(*duplicate, first_of[kept]), (*kept, first_of[kept])]);
    let mut duplicates: Vec<_> = groups.map(|(stored, first)| (stored, input_of(&stored), first)).collect();
    for (stored, _, first) in &duplicates {
        to_input[stored.index()] = *first;
    }
    duplicates.retain(|(_, input, first)| input != first);
    let mut duplicates: Vec<_> = duplicates.into_iter().map(|(_, input, first)| (input, first)).collect();
    duplicates.sort_unstable();
    duplicates.dedup();
    let input = |v: u32| if v == u32::MAX { v } else { to_input[v as usize].0 };
    if let Some(places) = places {
        // With several threads a fifth of the slots is never used; the numbering needs room.
        rows.trim();
        rows.marks = Vec::new();
        rows.free = Vec::new();
        let mut names = vec![VertexId::GHOST.0; places.len() + 1];
        for (stored, &place) in places.iter().enumerate() {
            names[place as usize] = to_input[stored].0;
        }
        delaunay_numbering::renumber(&mut rows.halves, &VertexNames { places: &places, names: &names });
    } else {
        rows.compact();
        let rows = rows.halves[1..].par_chunks_exact_mut(2).with_min_len(HANDED_OVER);
        rows.for_each(|row| row[0] = row[0].map(input));
    }
    drop(to_input);
    let complex = TetComplex::from_rows(points.to_vec(), rows.halves)?;
    Ok((complex, duplicates))
}

/// Which of equal points is a vertex depends on the threads: all of them get the place of the one that is inserted first.
fn unify_equal_points(mut places: Vec<u32>, duplicates: &[(VertexId, VertexId)]) -> Vec<u32> {
    // All duplicates of a point name the same vertex.
    for (duplicate, kept) in duplicates {
        places[kept.index()] = places[kept.index()].min(places[duplicate.index()]);
    }
    for (duplicate, kept) in duplicates {
        places[duplicate.index()] = places[kept.index()];
    }
    places
}

#[cfg(test)]
#[path = "delaunay_tests.rs"]
mod tests;
