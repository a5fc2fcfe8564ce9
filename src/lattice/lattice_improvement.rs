//! Quality improvement after the deformation: relaxation, volumes, optimisation and local transformations in rounds.
//!
//! # Method
//! Each round:
//! 1. Volumes: the mesh's volume per label is compared with that of the voxels; the offsets of the labels' surfaces are set so that
//!    the difference would vanish, by a few relaxation steps over the areas between labels.
//! 2. Surface vertices relax along their surface and onto it, one color after another
//!    ([`surface_stars`](crate::lattice::surface_stars)); vertices of low score inside follow.
//! 3. The tets below the wanted score are raised ([`low_tets`](crate::lattice::low_tets)): their inner vertices are optimised, in the
//!    last rounds those on surfaces too, local transformations are made.
//!
//! Edges much shorter than those around them are contracted in between and then ([`short_edges`](crate::lattice::short_edges));
//! in two rounds surface edges and faces are split that cut off what bends ([`chord_splits`](crate::lattice::chord_splits)), in a third
//! one what still is far off its surface is brought nearer ([`surface_approach`](crate::lattice::surface_approach)); where labels are
//! vessels also at the end, after tets beyond the surface took the other label and surface edges that bridge a crease were flipped
//! ([`surface_edge_flips`](crate::lattice::surface_edge_flips)); bridges across gaps are cut
//! ([`bridge_cuts`](crate::lattice::bridge_cuts)). The volumes come back after that, elsewhere those of labels that are
//! clearly off at the end, vertex by vertex ([`volume_offsets`](crate::lattice::volume_offsets)). Tets beyond the surface take the
//! other label in the first rounds, those that turn triangles of it upside down also at the end
//! ([`surface_relabelling`](crate::lattice::surface_relabelling)); then vertices go that stand off a surface which is nearer without
//! them ([`surface_spikes`](crate::lattice::surface_spikes)).
//! Vertices and tets are renumbered along a curve first, and again after most splits ([`vertex_order`](crate::lattice::vertex_order)).
//! Around tets that are low after all that, the mesh is searched through worse ones, and surface vertices may stay off their
//! surface by a little more each time ([`iterated_search`](crate::lattice::iterated_search)).
//!
//! # Source
//! [KlingnerShewchuk2007] for the schedule.
//!
//! # Invariants
//! The order of work is fixed and sequential where a step depends on the one before: the same bits for any number of
//! threads. Volumes are summed in fixed chunks.
//!
//! # Limits
//! The scaffold keeps parts of the surface apart across gaps of background; `surface_crossings` counts what crosses all the
//! same, for a finding.

use glam::DVec3;
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::boundary_targets::SourcePoints;
use crate::lattice::bridge_cuts::cut_bridges;
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::chord_splits::{chords, flip, split_chords};
use crate::lattice::element_score::{Ball, Part, Threshold, tet_fails};
use crate::lattice::improvement_mesh::{ImprovementMesh, numbers_where};
use crate::lattice::iterated_search::{IteratedSearch, Perturbations, Reach, Surroundings};
use crate::lattice::local_transformations::{TransformationCounts, loosen_scaffold};
use crate::lattice::low_tets::{Effort, InVain, Raising, Surfaces, low_among, low_tets};
use crate::lattice::planned_batches::{PlannedChange, Touched, change_in_order};
use crate::lattice::progress_shares;
use crate::lattice::scaffold::STIFF_SCAFFOLD_ANGLE;
use crate::lattice::short_edges::{Uncontracted, contract_short_edges};
use crate::lattice::subvoxel_surface::SubvoxelSurface;
use crate::lattice::surface_approach::{ApproachBounds, Around, Ways, approach_surface};
use crate::lattice::surface_crossings::count_crossings;
use crate::lattice::surface_relabelling::{Causes, RelabellingBounds, relabel_beyond_surface};
use crate::lattice::surface_spikes::merge_spikes;
use crate::lattice::vertex_optimization::{plan_inside, plan_relaxation};
use crate::lattice::volume_offsets::{OffsetMoves, move_by_offsets, update_offsets};
use crate::lattice::voxel_cleanup::CleanImage;

/// Score that relaxation may spend in each round, degrees. The first rounds bring vertices onto their surface although tets
/// become flat: transformations take those away, so that every round costs. On vessels of 1.5 to 3 voxels radius seven rounds
/// leave a mean angle between surface triangles of 14.9 degrees and a volume error of 0.01 %, these five 15.4 and 0.13 %, four
/// (4, 7, 15.2, 15.2) 16.8 and 0.46 %, with the same angles and distances. The last two are the wanted score: with 12 in the
/// last but one, low tets were left on a cortex of crowded labels. A high bound from the start (19 in all rounds) left vertices
/// off their surface, and 17 instead of 9 degrees between triangles of nested spheres.
const RELAXATION_BOUNDS: [f64; 5] = [4.0, 5.0, 8.0, 15.2, 15.2];

/// The same for surfaces that [follow the staircase](SubvoxelSurface::follows_staircase). On an atlas of brain lobes the mean angle
/// between surface triangles is 17.5 degrees with five rounds, 17.8 with these, 18.9 with three (4, 15.2, 15.2); 95 % of it are within
/// 0.501, 0.505, 0.511 voxel of the image. On tissues cut by the border angles begin at 12.2 degrees with five rounds, at 14.8 with these,
/// for a seventh fewer elements. Two balls within each other have a volume error of 0.003, 0.027 and 0.168 %: where there is one label
/// only, which may be as smooth, there are five.
const RELAXATION_BOUNDS_OF_LABELS: [f64; 4] = [4.0, 8.0, 15.2, 15.2];

/// Rounds in which surface edges are split where they cut off what bends, and how far off their middles are then, in voxels of
/// the smallest spacing. The second one splits the halves of thin rings again. On vessels of 1.5 to 4 voxels radius the
/// largest distances of the mesh from the exact surface are 0.92, 0.73, 0.83 voxel with 0.35, and 0.86, 0.62, 0.69 with 0.2, the
/// mean ones less by a twentieth, for 2 to 7 % more elements where much is curved. With 0.15 elements grow by 15 %, distances no
/// longer fall.
const CHORD_ROUNDS: std::ops::RangeInclusive<usize> = 1..=2;
const CHORD: f64 = 0.2;

/// How far off edges are where most labels are vessels: coarser surfaces are split at less. 37 trees have 1667, 1588, 1463 thousand
/// elements with 0.12, 0.13, 0.15, and 304, 314, 395 places off by more than 0.3 voxel; the largest distances are the same.
const VESSEL_CHORD: f64 = 0.13;

/// Rounds in which tets beyond their surface take the label of the other side, and by how much their middles lie beyond it, in
/// voxels of the smallest spacing. On 21 vessel trees the largest distances of the lumen are 0.91 voxel in the mean without,
/// 0.68 with rounds 1 and 2 and 0.1, 0.65 with these, for 1 % fewer elements. Later rounds leave vertices of the outside off
/// their surface: 0.67 instead of 0.58 voxel. Tets with triangles upside down go once more at the end.
const RELABELLING_ROUNDS: std::ops::RangeInclusive<usize> = 0..=2;
const BEYOND: f64 = 0.05;

/// Round after which edges shorter than this share of those around them are contracted: carved surfaces are full of them. The
/// volumes that it costs come back in the rounds that follow; one round later 0.20 % are missing on the vessels.
const SHORT_EDGE_ROUND: usize = 1;
const COARSENED: f64 = 0.35;

/// The same where most labels are vessels, and the sweeps there: their surfaces are split again where they bend, and what is
/// coarse leaves more room for that. With [`VESSEL_CHORD`] 28 trees have a sixth fewer elements than with the values of other
/// images, and as small mean distances.
const VESSEL_COARSENED: f64 = 0.6;
const VESSEL_COARSENING_PASSES: usize = 2;

/// Share of the longest edge of a tet below which its shortest makes it a needle, at the end: a lattice tet has 0.87, its
/// greens 0.5 and more.
const NEEDLE: f64 = 0.2;

/// Sweeps over needles.
const NEEDLE_PASSES: usize = 3;

/// How far off their surface vertices are that are merged into a neighbour where that brings the surface nearer, at the end, in voxels of
/// the smallest spacing: nearly what may yield to quality in the rounds before.
const SPIKE: f64 = 0.1;

/// Rounds before which vertices and tets are renumbered: that of the lattice, and that after most splits.
const RENUMBERED_ROUNDS: [usize; 2] = [0, 2];

/// Rounds at the end in which surface vertices may yield to quality.
const YIELDING_ROUNDS: usize = 2;

/// Score that optimisation wants: the aim of 15 to 155 degrees, and a little more.
const WANTED: f64 = 15.2;

/// How far a surface vertex may stay off its surface for the sake of quality, in voxels of the smallest spacing.
const SLACK: f64 = 0.12;

/// Searches at the end: how far from a low tet edges are perturbed, and how far a surface vertex may stay off its surface, in
/// voxels of the smallest spacing. Each takes what the one before left: of 600 low tets of a cortex 25, 3, 0. Sweeps without
/// perturbations in their place, with a slack of up to 0.6, left 59, and twice the tets for searches.
const SEARCHES: [(Reach, f64); 4] = [(Reach::Tet, 0.2), (Reach::Tet, 0.3), (Reach::Faces, 0.45), (Reach::Edges, 0.6)];

/// Sweeps over what is low after each perturbation of a search, or step towards the surface.
const SEARCH_SWEEPS: usize = 2;

/// Rounds in which places that are far off their surface are brought nearer, whatever stands before them: rounds that bring the
/// quality and the volumes back follow. At the end it moves half as many, and costs a quarter of a per cent of volume.
const APPROACH_ROUNDS: std::ops::RangeInclusive<usize> = 2..=3;

/// One more such round where most labels are vessels: it costs a twentieth of the time, and of 32 places of seven trees of vessels that
/// are off by more than half a voxel 24 are left.
const VESSEL_APPROACH_ROUND: usize = 1;

/// How far off such places are, in voxels of the smallest spacing: more is no distance, since the surface passes every voxel centre
/// on its side. In the crease of a crotch it is the way into that.
const FAR: f64 = 0.2;
const FARTHEST: f64 = 1.5;

/// The same where most labels are vessels, by the way into creases, and at the end. On 12 trees places of the exact surface are off the
/// mesh by up to 0.43 voxel in the mean where 0.2 is far and the nearest surface counts, by 0.37 with these, and places of the mesh by
/// up to 0.37 and 0.33, for 2 % more elements.
const VESSEL_FAR: f64 = 0.12;
const LAST_FAR: f64 = 0.1;
const VESSEL_FARTHEST: f64 = 3.0;

/// Share of the distance that may be left when such a place has been brought nearer.
const LEFT: f64 = 0.5;

/// Tets of the mesh for each place that is tried to be brought nearer, and the least number of places.
const TETS_PER_APPROACH: usize = 5000;
const LEAST_APPROACHES: usize = 500;

/// Approaches at the end of images that are mostly vessels, when quality and volumes stand, and the share of a distance that may
/// be left then: every bit counts where nothing around comes off its surface for it. On 16 trees 114 places are off by more than 0.35
/// voxel without slides, 105 with two such rounds, 101 with these; the largest distance is 0.46, 0.45, 0.45 voxel in the mean.
const LAST_APPROACHES: usize = 3;
const LAST_LEFT: f64 = 0.95;

/// Steps that bring the volumes back in the end, at most: what comes nearer in a crotch is volume of the vessel. On 13 trees up to 0.69 %
/// are off without.
const VOLUME_STEPS: usize = 3;

/// How far a label's volume has to be off at the end for its surface to move once more: half of what is promised.
const LEAST_VOLUME_ERROR: f64 = 0.0025;

/// Perturbations that searches may try in one mesh.
const LARGEST_SEARCH: usize = 20_000;

/// Vertices between two looks at whether the run is cancelled.
const VERTICES_PER_CHECK: usize = 1024;

/// Scaffold tets between two such looks.
const SCAFFOLD_TETS_PER_CHECK: usize = 256;

/// Largest offset of a label's surface, in smallest spacings.
const LARGEST_OFFSET: f64 = 0.5;

/// Whether elements may be replaced.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Transformations {
    /// Vertices move only; elements stay the same.
    None,
    /// Elements may be replaced.
    Local,
}

/// Options of the improvement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImprovementOptions {
    /// Whether elements may be replaced.
    pub transformations: Transformations,
    /// Sweeps that move inner vertices towards the mean of their neighbours wherever that helps.
    pub laplacian_iterations: usize,
    /// Smallest dihedral angle that is asked for, degrees.
    pub min_dihedral_angle: f64,
}

/// What the improvement did.
#[derive(Debug, Clone, Copy, Default)]
pub struct ImprovementSummary {
    /// Tets below the wanted score at the beginning and at the end.
    pub low_before: usize,
    /// See `low_before`.
    pub low_after: usize,
    /// Lowest score at the end, degrees.
    pub lowest: f64,
    /// Places that only a search through worse meshes made better.
    pub searched: usize,
    /// Tets beyond their surface that took the label of the other side.
    pub relabelled: usize,
    /// Places far off their surface that came nearer.
    pub approached: usize,
    /// Bridges across gaps that were cut.
    pub bridges: usize,
    /// Transformations made.
    pub counts: TransformationCounts,
    /// Pairs of outer faces that still cross.
    pub crossings: usize,
}

/// Improves the tets of a mesh; `surface` gets the offsets that keep the volumes.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn improve(
    mesh: &mut CandidateMesh,
    clean: &CleanImage,
    surface: SubvoxelSurface,
    sources: &SourcePoints,
    lattice: Vec<DVec3>,
    options: &ImprovementOptions,
    context: &RunContext,
) -> Result<ImprovementSummary> {
    let mut summary = ImprovementSummary::default();
    let has_vessels = surface.has_mostly_vessels();
    let bounds: &[f64] = if surface.follows_staircase() { &RELAXATION_BOUNDS_OF_LABELS } else { &RELAXATION_BOUNDS };
    let rounds = bounds.len();
    let voxel = clean.image.grid().spacing().min_element();
    let slack = SLACK * voxel;
    let wanted = WANTED.max(options.min_dihedral_angle);
    let beyond =
        RelabellingBounds { tolerance: BEYOND * voxel, causes: Causes::All, one_inside: has_vessels, least_score: 0.0 };
    // Later nothing raises the score of what joins the mesh.
    let upside_down = RelabellingBounds { causes: Causes::UpsideDown, least_score: wanted, ..beyond };
    context.check()?;
    let mut work = ImprovementMesh::new(mesh, sources, surface);
    work.set_lattice(lattice);
    context.check()?;
    summary.low_before = low_tets(&work, wanted, context)?.len();
    let advance = |passes: usize| {
        let shares = (progress_shares::DEFORMED, progress_shares::IMPROVED);
        context.progress("improvement", progress_shares::within(shares, passes, rounds + 2));
    };
    for (round, &bound) in bounds.iter().enumerate() {
        advance(round);
        if RENUMBERED_ROUNDS.contains(&round) {
            work.renumber_along_curve(mesh, context)?;
            context.check()?;
        }
        let may_transform = options.transformations == Transformations::Local;
        let surfaces = if round + YIELDING_ROUNDS >= rounds { Surfaces::MayYield } else { Surfaces::Stay };
        let low = relax_all(&mut work, bound, wanted, context)?;
        let effort = Effort { wanted, surfaces, slack };
        if may_transform {
            loosen_all(&mut work, context)?;
        }
        if may_transform && RELABELLING_ROUNDS.contains(&round) {
            summary.relabelled += relabel_beyond_surface(&mut work, &beyond, context)?;
        }
        if may_transform && CHORD_ROUNDS.contains(&round) {
            work.refresh_stars(context)?;
            let chord = if has_vessels { VESSEL_CHORD } else { CHORD };
            summary.counts.chords += split_chords(&mut work, chord * voxel, bound, context)?;
        }
        let counts = may_transform.then_some(&mut summary.counts);
        Raising::new(effort, InVain::Forgotten, counts).sweep(&mut work, low, context)?;
        let approaches = APPROACH_ROUNDS.contains(&round) || (has_vessels && round == VESSEL_APPROACH_ROUND);
        if may_transform && approaches {
            let effort = Effort { wanted: bound, surfaces: Surfaces::Stay, slack };
            let mut mend = |work: &mut ImprovementMesh, around: &Surroundings| {
                mend_around(work, around, &effort, Some(&mut summary.counts), context)
            };
            context.check()?;
            let budget = (work.tets.len() / TETS_PER_APPROACH).max(LEAST_APPROACHES);
            let (range, ways) = if has_vessels {
                ([VESSEL_FAR, VESSEL_FARTHEST], Ways::Creases)
            } else {
                ([FAR, FARTHEST], Ways::Moves)
            };
            let range = range.map(|f| f * voxel);
            let (wanted, around) = (effort.wanted, Around::MayYield);
            let bounds = ApproachBounds { range, wanted, left: LEFT, around, ways, passes: 1, budget };
            summary.approached += approach_surface(&mut work, bounds, &mut mend, context)?;
        }
        if may_transform && round == SHORT_EDGE_ROUND {
            // The next round moves all vertices.
            let (short, passes) =
                if has_vessels { (VESSEL_COARSENED, VESSEL_COARSENING_PASSES) } else { (COARSENED, 1) };
            summary.counts.short_edges +=
                contract_short_edges(&mut work, wanted, short, passes, Uncontracted::Stay, context)?;
        }
        if round + 1 < rounds {
            update_offsets(&mut work, &clean.volumes, LARGEST_OFFSET * voxel, context)?;
            context.check()?;
        }
    }
    advance(rounds);
    if options.transformations == Transformations::Local {
        summary.counts.short_edges +=
            contract_short_edges(&mut work, wanted, NEEDLE, NEEDLE_PASSES, Uncontracted::Lengthen, context)?;
        summary.relabelled += relabel_beyond_surface(&mut work, &upside_down, context)?;
        loosen_all(&mut work, context)?;
        summary.counts.spikes += merge_spikes(&mut work, SPIKE * voxel, wanted, context)?;
    }
    advance(rounds + 1);
    let (searched, left) = search_last(&mut work, options, voxel, &mut summary.counts, context)?;
    summary.searched = searched;
    let is_approached = options.transformations == Transformations::Local && has_vessels;
    if is_approached {
        // Vertices are where they are to be, so that what is still beyond is seen.
        let bounds = RelabellingBounds { least_score: wanted, ..beyond };
        summary.relabelled += relabel_beyond_surface(&mut work, &bounds, context)?;
        work.refresh_stars(context)?;
        let far = chords(&work, CHORD * voxel, context)?;
        summary.counts.turned_edges += far.iter().filter(|(_, chord)| flip(&mut work, chord, wanted)).count();
        let effort = Effort { wanted, surfaces: Surfaces::MayYield, slack };
        let mut mend = |work: &mut ImprovementMesh, around: &Surroundings| {
            mend_around(work, around, &effort, Some(&mut summary.counts), context)
        };
        let range = [LAST_FAR, VESSEL_FARTHEST].map(|f| f * voxel);
        let bounds = ApproachBounds {
            range,
            wanted: effort.wanted,
            left: LAST_LEFT,
            around: Around::Holds,
            ways: Ways::All,
            passes: LAST_APPROACHES,
            budget: LEAST_APPROACHES,
        };
        summary.approached += approach_surface(&mut work, bounds, &mut mend, context)?;
        summary.bridges = cut_bridges(&mut work, context)?;
        if summary.bridges > 0 {
            // What they held back goes to its surface.
            summary.approached += approach_surface(&mut work, bounds, &mut mend, context)?;
        }
    }
    let least = if is_approached { 0.0 } else { LEAST_VOLUME_ERROR };
    let moves = OffsetMoves { least, largest: LARGEST_OFFSET * voxel, bound: wanted };
    let mut is_moved = false;
    for _ in 0..VOLUME_STEPS {
        if !move_by_offsets(&mut work, &clean.volumes, &moves, context)? {
            break;
        }
        is_moved = true;
    }
    for _ in 0..options.laplacian_iterations {
        for v in 0..work.points.len() as u32 {
            context.check_every(VERTICES_PER_CHECK, v as usize)?;
            let planned = work.with_scratch(|mesh, ball| plan_inside(mesh, v, f64::INFINITY, ball));
            planned.into_iter().for_each(|place| work.move_vertex(v, place));
        }
    }
    context.check()?;
    summary.crossings = count_crossings(&work, context)?;
    let is_known = options.laplacian_iterations == 0 && !is_approached && !is_moved;
    let mut low = if is_known { left } else { low_tets(&work, wanted, context)? };
    low.retain(|(_, t)| work.part(*t) == Part::Mesh);
    summary.low_after = low.len();
    summary.lowest = low.first().map_or(wanted, |(score, _)| *score);
    work.finish(mesh);
    Ok(summary)
}

/// One sweep over the surface vertices, then the vertices inside that low tets have. Returns the low tets, worst first.
fn relax_all(work: &mut ImprovementMesh, bound: f64, wanted: f64, context: &RunContext) -> Result<Vec<(f64, u32)>> {
    let bound = Threshold::of(bound);
    work.refresh_stars(context)?;
    for set in work.stars().by_color(work) {
        context.check()?;
        // No vertex of the set is in the ball of another: all see the same places, whoever is first.
        let plan = |ball: &mut Ball, v: &u32| plan_relaxation(work, *v, &bound, ball).map(|place| (*v, place));
        let moves: Vec<(u32, DVec3)> =
            set.par_iter().with_min_len(32).map_init(Ball::default, plan).flatten_iter().collect();
        moves.into_iter().for_each(|(v, place)| work.points[v as usize] = place);
    }
    let threshold = Threshold::of(wanted);
    let fails = |t: u32| work.is_live(t) && work.fails(t, &threshold);
    let mut candidates = numbers_where(work.tets.len(), &fails, context)?;
    let mut low: Vec<u32> = candidates.iter().flat_map(|t| work.tets[*t as usize]).collect();
    low.sort_unstable();
    low.dedup();
    let mut inner = InnerRelaxation { wanted, near: Vec::new() };
    change_in_order(work, &low, &mut inner, context)?;
    candidates.append(&mut inner.near);
    candidates.sort_unstable();
    candidates.dedup();
    low_among(work, candidates, wanted, context)
}

/// Moves of vertices inside of a label.
struct InnerRelaxation {
    /// Score above which balls stay as they are.
    wanted: f64,
    /// The tets of those that moved.
    near: Vec<u32>,
}

impl PlannedChange for InnerRelaxation {
    type Item = u32;
    type Plan = Option<DVec3>;

    fn append_vertices(&self, _: &ImprovementMesh, v: &u32, vertices: &mut Vec<u32>) {
        vertices.push(*v);
    }

    fn plan(&self, mesh: &ImprovementMesh, v: &u32, ball: &mut Ball) -> Option<DVec3> {
        plan_inside(mesh, *v, self.wanted, ball)
    }

    fn change(
        &mut self,
        mesh: &mut ImprovementMesh,
        v: &u32,
        plan: Option<DVec3>,
        touched: &mut Touched,
    ) -> Option<u32> {
        if let Some(place) = plan {
            touched.mark(mesh, *v);
            mesh.move_vertex(*v, place);
            self.near.extend(mesh.ball(*v));
        }
        None
    }
}

/// Searches around the tets below the wanted score, also through worse meshes; returns how many places became better, and the
/// tets that are still low, worst first.
fn search_last(
    work: &mut ImprovementMesh,
    options: &ImprovementOptions,
    voxel: f64,
    counts: &mut TransformationCounts,
    context: &RunContext,
) -> Result<(usize, Vec<(f64, u32)>)> {
    let wanted = WANTED.max(options.min_dihedral_angle);
    let may_transform = options.transformations == Transformations::Local;
    let perturbations = if may_transform { Perturbations::All } else { Perturbations::Moves };
    let mut better = 0;
    let mut budget = LARGEST_SEARCH;
    let mut left = low_tets(work, wanted, context)?;
    for (reach, slack) in SEARCHES {
        let mut low: Vec<u32> = left.iter().map(|(_, t)| *t).collect();
        let effort = Effort { wanted, surfaces: Surfaces::MayYield, slack: slack * voxel };
        let mut mend = |work: &mut ImprovementMesh, around: &Surroundings| {
            mend_around(work, around, &effort, may_transform.then_some(&mut *counts), context)
        };
        let mut search =
            IteratedSearch { wanted, slack: effort.slack, perturbations, reach, budget, changed: Vec::new() };
        better += search.run(work, &low, &mut mend)?;
        budget = search.budget;
        // Nowhere else has anything changed.
        low.extend(work.tets_of(search.changed));
        low.sort_unstable();
        low.dedup();
        left = low_among(work, low, wanted, context)?;
    }
    Ok((better, left))
}

/// Sweeps over the low tets around a place, as long as there is hope; what is low is what it was before the trial there.
fn mend_around(
    work: &mut ImprovementMesh,
    around: &Surroundings,
    effort: &Effort,
    counts: Option<&mut TransformationCounts>,
    context: &RunContext,
) -> Result<()> {
    let mut raising = Raising::new(*effort, InVain::Remembered, counts);
    for sweep in 0..SEARCH_SWEEPS {
        if sweep > 0 && around.are_spoiled(work, effort.wanted) {
            break;
        }
        let low = low_among(work, around.candidates(work), effort.wanted, context)?;
        raising.sweep(work, low, context)?;
    }
    Ok(())
}

/// Makes nearly flat tets of the scaffold better.
fn loosen_all(work: &mut ImprovementMesh, context: &RunContext) -> Result<()> {
    context.check()?;
    let limit = Threshold::of(STIFF_SCAFFOLD_ANGLE);
    let is_stiff = |t: u32| work.part(t) == Part::Scaffold && work.is_live(t) && tet_fails(work.corners(t), &limit);
    let stiff = numbers_where(work.tets.len(), &is_stiff, context)?;
    for (at, t) in stiff.into_iter().enumerate() {
        context.check_every(SCAFFOLD_TETS_PER_CHECK, at)?;
        if work.is_live(t) && work.part(t) == Part::Scaffold {
            loosen_scaffold(work, t);
        }
    }
    Ok(())
}
