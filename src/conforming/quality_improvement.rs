//! The schedule of quality improvement: reconnection, smoothing, removal of bad tets, until the passes are used up.
//!
//! # Method
//! Each of the `nqual` passes:
//! 1. reconnects the tets with an angle above `angqual` by the edge weight or the skew;
//! 2. collapses small edges (`mdse`);
//! 3. smooths the vertices of the tets above `angqmsk` `nsmth` times;
//! 4. works through the tets above `angqmsk` or below the matching small angle, worst first: edge removal, multi-face
//!    removal, a search for the best place of each vertex; for those above `angdfs` also vertex removal and insertion.
//!
//! After the passes the worst tets get all operations, points close to others only as long as few of them are. Tets that
//! are nearly flat, or bad without a vertex on the boundary, get them wherever the points come to lie.
//! Up to `nqualf` times, while a tet is above `angqmax`, passes and operations are repeated around these tets.
//!
//! Slivers that the boundary does not force and that do not crowd then get all operations and the reconnection of small
//! polyhedra, while tets on the boundary's needles count as better than they are (`needle_faces`). Edges that are still far
//! too long for the sizes get points where no angle pays for it (`edge_splitting`).
//!
//! At the end, tets with faces that finite-volume solvers find skew get all operations under a measure that counts
//! skewness: needles on a small triangle may lean far while their angles are good. Around what may not stay even then,
//! iterated local search goes on (`region_search`); then, for tets off the boundary that are still bad, whatever becomes
//! of those at it, and where it finds nothing, annealing (`region_annealing`); at last annealing around the slivers that the
//! boundary does not force. Where that leaves more slivers than there were before, the mesh with the fewest is put back
//! ([`FewestSlivers`]), and the lowest tets that at most one face of the boundary holds are lifted (`lowest_tets`).
//!
//! # Source
//! [Drakopoulos2017] 4.9; B.3 `nqual`, `nqualf`, `angqual`, `angqmsk`, `angqmax`, `mrecqm`, `mrecqmf`, `ordtq`, `mdfs`, `ndfs`,
//! `angdfs`, `mdse`, `cdse`; operations and their order beyond the thesis: [KlingnerShewchuk2007]; skewness: [OpenFOAM].
//!
//! # Differences
//! The thesis repeats the passes everywhere. Most tets above `angqmax` are forced by the surface, so that nearly every
//! surface would be improved twice for the sake of few places.
//!
//! # Invariants
//! No operation lowers the worst tet of what it touches (except plain smoothing with `smart` off, which stays valid, and
//! points in long edges, beside which good tets stay good).
//! Constraints are kept.
//!
//! # Cost
//! Scans are linear and parallel, and read no more than the flags of tets that have not changed since the last; the rest
//! is proportional to the number of bad tets.

use std::time::Instant;

use super::bad_tets::{Known, Scope, grade_below, sift, slivers, tets_with_skew_faces, vertices_of};
use super::fewest_slivers::{FewestSlivers, State};
use super::flip_criteria::{BiasedSine, Relief, STRICT_ANGLE, StrictInside, TetMeasure};
use super::forced_slivers::{crowded_slivers, is_forced_sliver, sliver_cosine};
use super::local_reconnection::{FourFour, Objective};
use super::lowest_tets::lift_lowest;
use super::needle_faces::NeedleFaces;
use super::options::Options;
use super::parallel_reconnection::{Crowding, Driver, FLAT_BELOW, Touched, Treatment, count_of_bad, longest_excess};
use super::refinement::boundary_triangles;
use super::region_search::{Aim, DEPTHS, RegionSearch, grade_off_boundary, may_not_stay};
use super::smoothing::{Acceptance, SmoothingRule, Target};
use crate::context::RunContext;
use crate::error::Result;
use crate::index::{TetId, VertexId};
use crate::mesh::quality::SLIVER_DEGREES;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::statistics::Statistics;

/// Most rounds over the worst tets after the passes.
const WORST_ROUNDS: usize = 6;
/// Most rounds over the tets that may not stay, after these.
const LAST_ROUNDS: usize = 12;
/// Most rounds over the tets off the boundary between two searches: operations that move a vertex a little go on for long.
const OFF_ROUNDS: usize = 8;
/// Most regions annealed: enough for sixteen of nineteen of Chazelle's polyhedra; twelve of these with 16 at one temperature.
const MOST_ANNEALINGS: usize = 24;
/// Most regions annealed one after the other for slivers without fewer of them: two at each temperature.
const MOST_IN_VAIN: usize = 6;
/// Most rounds over the tets with skew faces, at the end.
const SKEW_ROUNDS: usize = 6;
/// Angles that the rounds over the worst tets aim at, degrees: beyond what users ask for, so that they get it.
const WORST_GOAL: (f64, f64) = (24.0, 145.0);
/// Share of the vertices that may be inserted closer to others than the sizes want, for the worst tets. On surfaces with
/// needles everywhere most edges would be too short if points crowded around each bad tet.
const CROWDED_POINTS: f64 = 0.01;
/// Most rounds over the edges that are far too long: the halves of some are too long still.
const SPLIT_ROUNDS: usize = 4;

/// Rings of vertices around the tets above the repeat angle that repeats of the passes work on: an operation at a tet
/// depends on the balls of its vertices, and what it changes may help the next.
const REPEAT_RINGS: usize = 2;

/// Which vertices lie on the boundary.
pub(super) fn boundary_vertices(complex: &TetComplex, context: &RunContext) -> Vec<bool> {
    let mut marks = vec![false; complex.vertex_count()];
    boundary_triangles(complex, context).as_flattened().iter().for_each(|v| marks[v.index()] = true);
    marks
}

/// Largest grade, as the sine of an angle of 5 degrees, of the tets that the end of refinement treats.
const FLAT_DEGREES: f64 = 5.0;

/// The end of refinement: edge and multi-face removal at the flat tets that the flips 2-3 and 3-2 left behind, or moves of
/// their vertices. What is left are the slivers before quality improvement.
///
/// # Errors
/// As [`improve`].
pub fn treat_flat_tets(
    complex: &mut TetComplex,
    sizes: &mut Vec<f64>,
    options: &Options,
    context: &RunContext,
) -> Result<()> {
    let goal = FLAT_DEGREES.to_radians().sin();
    let flat = sift(complex, context, &Scope::default(), |_| false, grade_below(complex, goal)).0;
    if flat.is_empty() {
        return Ok(());
    }
    let on_boundary = boundary_vertices(complex, context);
    let mut driver = Driver::for_refinement(options, context);
    driver.treat(complex, sizes, &on_boundary, flat, &Treatment::topological(goal)).map(|_| ())
}

/// Improves the mesh and returns the figures; `sizes` has one entry per vertex and grows with them.
///
/// # Errors
/// [`crate::error::Error::Cancelled`], or a limit of the run.
pub fn improve(
    complex: &mut TetComplex,
    sizes: &mut Vec<f64>,
    options: &Options,
    context: &RunContext,
) -> Result<Statistics> {
    let start = Instant::now();
    let mut figures = Statistics::default();
    if options.quality_passes == 0 {
        return Ok(figures);
    }
    let on_boundary = boundary_vertices(complex, context);
    let driver = Driver::for_quality(options, context);
    let angle = options.quality_angle.min(options.mask_angle);
    let known = Known { angle, grade: BiasedSine::grade_of_angles(WORST_GOAL.0, WORST_GOAL.1) };
    let crowded_points = (CROWDED_POINTS * complex.vertex_count() as f64) as usize;
    let mut improver = Improver { options, context, on_boundary: &on_boundary, driver, known, crowded_points };
    let passes = options.quality_passes;
    let mut scope = Scope::default();
    let mut fewest = FewestSlivers::default();
    for repeat in 0..=options.quality_repeats {
        for pass in 0..passes {
            context.check()?;
            let pass_start = Instant::now();
            let before = improver.driver.vertex_changes();
            improver.pass(complex, sizes, &scope, pass + 1 == passes)?;
            let state = improver.state(complex);
            fewest.note(complex, sizes, state);
            let after = improver.driver.vertex_changes();
            let prefix = format!("quality.pass.{}", repeat * passes + pass + 1);
            let counts = improver.driver.take_counts();
            for (name, value) in [
                ("flips_tried", counts.tried as f64),
                ("flips_accepted", counts.accepted as f64),
                ("flips_lost", counts.lost as f64),
                ("points_tried", (after.tried - before.tried) as f64),
                ("points_accepted", (after.inserted - before.inserted) as f64),
                ("points_removed", (after.removed - before.removed) as f64),
                (
                    "slivers",
                    improver.known.tets_above(complex, context, &scope, options.field_sliver_angle).len() as f64,
                ),
                ("time", pass_start.elapsed().as_secs_f64()),
            ] {
                figures.set(format!("{prefix}.{name}"), value);
            }
            if options.quality_statistics {
                let rows: Vec<_> = complex.finite_tets().map(|t| complex.vertices(t)).collect();
                let quality = crate::mesh::quality::tets_quality(complex.points(), &rows, context);
                for (name, value) in quality.statistics().entries() {
                    figures.set(format!("{prefix}.{name}"), *value);
                }
            }
            context.progress("quality improvement", 0.65 + 0.3 * (pass + 1) as f64 / (passes + 1) as f64);
        }
        improver.treat_worst(complex, sizes, &scope)?;
        let left = improver.known.tets_above(complex, context, &scope, options.repeat_angle);
        if left.is_empty() {
            break;
        }
        scope = Scope::around(complex, context, &left, REPEAT_RINGS);
    }
    improver.split_long_edges(complex, sizes)?;
    improver.treat_skew_faces(complex, sizes)?;
    let [tried, replaced] = improver.search_regions(complex, sizes)?;
    figures.set("quality.disturbances", tried as f64);
    figures.set("quality.regions_replaced", replaced as f64);
    let state = improver.state(complex);
    figures.set("quality.restored", f64::from(u8::from(fewest.restore(complex, sizes, state))));
    figures.set("quality.lifts", improver.lift_lowest(complex, sizes)? as f64);
    let skew_tets = tets_with_skew_faces(complex, context, &Scope::default()).len();
    figures.set("quality.skew_tets", skew_tets as f64);
    Known::forget(complex);
    improver.driver.record(&mut figures, "quality");
    let slivers = slivers(complex, context);
    figures.set("quality.slivers", slivers.len() as f64);
    let forced = slivers.iter().filter(|tet| is_forced_sliver(complex, **tet)).count();
    figures.set("quality.slivers_forced", forced as f64);
    figures.set("time.quality", start.elapsed().as_secs_f64());
    Ok(figures)
}

/// What the passes share.
struct Improver<'a> {
    options: &'a Options,
    context: &'a RunContext,
    on_boundary: &'a [bool],
    driver: Driver,
    known: Known,
    /// Points that may still be inserted closer to others than the sizes want.
    crowded_points: usize,
}

impl Improver<'_> {
    /// One pass over the tets of the scope.
    fn pass(&mut self, complex: &mut TetComplex, sizes: &mut Vec<f64>, scope: &Scope, is_last: bool) -> Result<()> {
        let Self { options, context, .. } = *self;
        self.reconnect(complex, scope, is_last)?;
        if options.delete_small_edges {
            let within = |row: &[VertexId; 4]| scope.holds(row);
            self.driver.collapse_small_edges(complex, sizes, options.small_edge_factor, &within)?;
        }
        self.smooth(complex, sizes, scope)?;
        // The grade that the masking angle has; small angles of the same grade count as well.
        let mask = BiasedSine::grade_of_angles(90.0, options.mask_angle);
        let goal = mask.min(BiasedSine::grade_of_angles(WORST_GOAL.0, WORST_GOAL.1));
        let bad = self.known.tets_below(complex, context, scope, goal);
        self.driver.take_touched();
        // Slivers are among these, or what becomes of them.
        let mut near = Touched { made: bad.iter().flat_map(|&t| complex.vertices(t)).collect(), moved: Vec::new() };
        self.driver.treat(complex, sizes, self.on_boundary, bad, &Treatment::topological(goal))?;
        if options.delete_field_slivers {
            for _ in 0..options.field_sliver_repeats {
                near.append(self.driver.take_touched());
                let around = Scope::of_changes(complex, &std::mem::take(&mut near));
                let slivers = self.known.tets_above(complex, context, &around, options.field_sliver_angle);
                // What was tried in vain is tried again only where something has changed beside it.
                let treatment = Treatment::everything(goal, Crowding::Refused);
                if slivers.is_empty() || self.driver.treat(complex, sizes, self.on_boundary, slivers, &treatment)? == 0
                {
                    break;
                }
            }
        }
        Ok(())
    }

    fn reconnect(&mut self, complex: &mut TetComplex, scope: &Scope, is_last: bool) -> Result<()> {
        let options = self.options;
        let criterion =
            if is_last { options.final_reconnection_criterion } else { options.quality_reconnection_criterion };
        let objective = if criterion == 3 { Objective::Skew } else { Objective::EdgeWeight };
        // 4-4 flips belong to the last pass, or to all where they are switched on.
        let four = match (is_last || options.flip_44, options.flip_44_quality) {
            (false, _) => FourFour::Off,
            (true, false) => FourFour::First,
            (true, true) => FourFour::Best,
        };
        if options.group_active_quality || scope.is_partial() {
            let mut active = self.known.tets_above(complex, self.context, scope, options.quality_angle);
            self.driver.reconnect(complex, &mut active, objective, four, 1)
        } else {
            self.driver.reconnect_ungrouped(complex, options.quality_angle, objective, four)
        }
    }

    fn smooth(&mut self, complex: &mut TetComplex, sizes: &[f64], scope: &Scope) -> Result<()> {
        let options = self.options;
        let masked = self.known.tets_above(complex, self.context, scope, options.mask_angle);
        let mut vertices = vertices_of(complex, &masked);
        let rule = SmoothingRule {
            target: if options.smoothing_mode == 2 { Target::Centroids } else { Target::OptimalPlacement },
            coefficient: options.smoothing_coefficient,
            acceptance: if options.smart_smoothing { Acceptance::Smart } else { Acceptance::Valid },
        };
        let factor = options.boundary_smoothing_factor;
        for _ in 0..options.smoothing_iterations {
            vertices = self.driver.smooth(complex, vertices, (self.on_boundary, sizes), &rule, factor)?;
        }
        Ok(())
    }

    /// All operations at the worst tets of the scope, while they help.
    fn treat_worst(&mut self, complex: &mut TetComplex, sizes: &mut Vec<f64>, scope: &Scope) -> Result<()> {
        let goal = BiasedSine::grade_of_angles(WORST_GOAL.0, WORST_GOAL.1);
        self.driver.take_touched();
        let mut touched: Option<Scope> = None;
        for _ in 0..WORST_ROUNDS {
            self.context.check()?;
            // Where nothing has changed, what failed fails again.
            let scope = touched.as_ref().unwrap_or(scope);
            let bad = self.known.tets_below(complex, self.context, scope, goal);
            if bad.is_empty() || self.treat_bad(complex, sizes, bad, goal)? == 0 {
                break;
            }
            touched = Some(Scope::of_changes(complex, &self.driver.take_touched()));
        }
        self.treat_unbearable(complex, sizes)
    }

    /// All operations, wherever points come to lie, at the tets that may not stay: nearly flat ones and bad ones off the
    /// boundary, which nothing forces.
    fn treat_unbearable(&mut self, complex: &mut TetComplex, sizes: &mut Vec<f64>) -> Result<()> {
        if !self.options.delete_field_slivers {
            return Ok(());
        }
        let (flat, limit) = (FLAT_BELOW.to_radians().sin(), STRICT_ANGLE.to_radians().sin());
        let goal = BiasedSine::grade_of_angles(WORST_GOAL.0, WORST_GOAL.1);
        let treatment = Treatment::everything(goal, Crowding::Allowed);
        let mut scope = Scope::default();
        self.driver.take_touched();
        for _ in 0..LAST_ROUNDS {
            self.context.check()?;
            let mut bad = self.known.tets_below(complex, self.context, &scope, limit);
            let measure = StrictInside { angles: BiasedSine, on_boundary: self.on_boundary, relief: Relief::Nothing };
            bad.retain(|&tet| {
                measure.is_strict(&complex.vertices(tet)) || BiasedSine.grade(complex.points_of(tet)) < flat
            });
            if bad.is_empty() || self.driver.treat(complex, sizes, self.on_boundary, bad, &treatment)? == 0 {
                break;
            }
            scope = Scope::beside_changes(complex, self.context, self.driver.take_touched());
        }
        self.treat_unforced_slivers(complex, sizes)
    }

    /// The slivers that the boundary does not force and that do not crowd.
    fn unforced_slivers(&mut self, complex: &mut TetComplex) -> Vec<TetId> {
        // No sliver has a better grade: large angles weigh more.
        let limit = SLIVER_DEGREES.to_radians().sin();
        let mut bad = self.known.tets_below(complex, self.context, &Scope::default(), limit);
        bad.retain(|&tet| sliver_cosine(complex.points_of(tet)).is_some());
        let mut crowded = crowded_slivers(complex, &bad).into_iter();
        bad.retain(|&tet| crowded.next() == Some(false) && !is_forced_sliver(complex, tet));
        bad
    }

    /// All operations, and the reconnection of small polyhedra, at the slivers that the boundary does not force, while tets on
    /// its needles count as better than they are: what is forced bounds no other tet then.
    fn treat_unforced_slivers(&mut self, complex: &mut TetComplex, sizes: &mut Vec<f64>) -> Result<()> {
        if !self.options.delete_field_slivers {
            return Ok(());
        }
        let goal = BiasedSine::grade_of_angles(WORST_GOAL.0, WORST_GOAL.1);
        let mut needles: Option<NeedleFaces> = None;
        for _ in 0..LAST_ROUNDS {
            self.context.check()?;
            let bad = self.unforced_slivers(complex);
            if bad.is_empty() {
                break;
            }
            let needles = needles.get_or_insert_with(|| {
                NeedleFaces::new(complex.points(), &boundary_triangles(complex, self.context), FLAT_BELOW)
            });
            let treatment = Treatment::last_resort(goal, needles);
            if self.driver.treat(complex, sizes, self.on_boundary, bad, &treatment)? == 0 {
                break;
            }
        }
        Ok(())
    }

    /// Iterated local search around the tets that may not stay and that no operation removes: slivers that the boundary does
    /// not force, and tets off the boundary with angles near those demanded.
    fn search_regions(&mut self, complex: &mut TetComplex, sizes: &mut Vec<f64>) -> Result<[usize; 2]> {
        let goal = BiasedSine::grade_of_angles(WORST_GOAL.0, WORST_GOAL.1);
        let mut search = RegionSearch::new(self.options, self.context, goal, Aim::FewerBad);
        if !self.options.delete_field_slivers {
            return Ok(search.counts);
        }
        for depth in DEPTHS {
            for _ in 0..LAST_ROUNDS {
                let mut bad = self.known.tets_below(complex, self.context, &Scope::default(), grade_off_boundary());
                bad.retain(|&tet| may_not_stay(complex, self.on_boundary, tet));
                // Those off the boundary first and as deep as can be: there are few, and nothing forces them.
                let is_sliver = |tet: &TetId| sliver_cosine(complex.points_of(*tet)).is_some();
                let (slivers, others): (Vec<_>, Vec<_>) = bad.into_iter().partition(is_sliver);
                let others = others.into_iter().map(|tet| (tet, DEPTHS[1]));
                let bad: Vec<_> = others.chain(slivers.into_iter().map(|tet| (tet, depth))).collect();
                let before = search.counts[1];
                for (tet, depth) in bad {
                    // The tet may be gone, or another in its place, by the searches before.
                    while complex.is_live(tet) && search.search(complex, sizes, self.on_boundary, (tet, depth))? {}
                }
                if search.counts[1] == before {
                    break;
                }
            }
        }
        let more = self.treat_off_boundary(complex, sizes)?;
        self.anneal_slivers(complex, sizes, &mut search)?;
        Ok([0, 1].map(|i| search.counts[i] + more[i]))
    }

    /// Anneals the regions around the slivers that the boundary does not force and that even the search has left.
    fn anneal_slivers(
        &mut self,
        complex: &mut TetComplex,
        sizes: &mut Vec<f64>,
        search: &mut RegionSearch,
    ) -> Result<()> {
        let mut in_vain = 0;
        while in_vain < MOST_IN_VAIN {
            let bad = self.unforced_slivers(complex);
            if bad.is_empty() {
                break;
            }
            // One after the other: what betters one may have taken others away.
            for tet in bad {
                if in_vain < MOST_IN_VAIN && complex.is_live(tet) {
                    let helped = search.anneal(complex, sizes, self.on_boundary, tet)?;
                    in_vain = if helped { 0 } else { in_vain + 1 };
                }
            }
        }
        Ok(())
    }

    /// What is wrong with the mesh.
    fn state(&mut self, complex: &mut TetComplex) -> State {
        // No sliver has a better grade: large angles weigh more.
        let mut slivers =
            self.known.tets_below(complex, self.context, &Scope::default(), SLIVER_DEGREES.to_radians().sin());
        slivers.retain(|tet| sliver_cosine(complex.points_of(*tet)).is_some());
        State { bad_off_boundary: self.bad_off_boundary(complex).len(), slivers: slivers.len() }
    }

    /// The tets off the boundary that are beyond the angles demanded.
    fn bad_off_boundary(&mut self, complex: &mut TetComplex) -> Vec<TetId> {
        let measure = StrictInside { angles: BiasedSine, on_boundary: self.on_boundary, relief: Relief::Nothing };
        let mut bad = self.known.tets_below(complex, self.context, &Scope::default(), grade_off_boundary());
        bad.retain(|&tet| measure.is_strict(&complex.vertices(tet)));
        bad
    }

    /// All operations, the iterated local search and annealing at the tets off the boundary that are still beyond the angles
    /// demanded, whatever becomes of those at the boundary: between walls that nearly meet slivers cannot be avoided, but off
    /// them.
    fn treat_off_boundary(&mut self, complex: &mut TetComplex, sizes: &mut Vec<f64>) -> Result<[usize; 2]> {
        let goal = BiasedSine::grade_of_angles(WORST_GOAL.0, WORST_GOAL.1);
        let mut search = RegionSearch::new(self.options, self.context, goal, Aim::OffBoundary);
        let mut annealings = 0;
        for _ in 0..LAST_ROUNDS + MOST_ANNEALINGS {
            self.operate_off_boundary(complex, sizes, goal)?;
            let before = search.counts[1];
            for tet in self.bad_off_boundary(complex) {
                while complex.is_live(tet) && search.search(complex, sizes, self.on_boundary, (tet, DEPTHS[1]))? {}
            }
            if search.counts[1] > before {
                continue;
            }
            let annealed = self.anneal_off_boundary(complex, sizes, &mut search, MOST_ANNEALINGS - annealings)?;
            if annealed == 0 {
                break;
            }
            annealings += annealed;
        }
        Ok(search.counts)
    }

    /// All operations at the tets off the boundary beyond the angles demanded, while they help.
    fn operate_off_boundary(&mut self, complex: &mut TetComplex, sizes: &mut Vec<f64>, goal: f64) -> Result<()> {
        for _ in 0..OFF_ROUNDS {
            self.context.check()?;
            let bad = self.bad_off_boundary(complex);
            let treatment = Treatment::off_boundary(goal);
            if bad.is_empty() || self.driver.treat(complex, sizes, self.on_boundary, bad, &treatment)? == 0 {
                break;
            }
        }
        Ok(())
    }

    /// Anneals the regions around the tets off the boundary beyond the angles demanded, `most` of them; how many there were.
    fn anneal_off_boundary(
        &mut self,
        complex: &mut TetComplex,
        sizes: &mut Vec<f64>,
        search: &mut RegionSearch,
        most: usize,
    ) -> Result<usize> {
        let mut annealed = 0;
        for tet in self.bad_off_boundary(complex) {
            // The tet may be gone, or another in its place, by the annealings before.
            if annealed < most && complex.is_live(tet) {
                annealed += 1;
                search.anneal(complex, sizes, self.on_boundary, tet)?;
            }
        }
        Ok(annealed)
    }

    /// Points in edges that are far too long: where walls are close, removals of edges and vertices for the sake of angles
    /// leave many.
    fn split_long_edges(&mut self, complex: &mut TetComplex, sizes: &mut Vec<f64>) -> Result<()> {
        if !self.options.delete_field_slivers {
            return Ok(());
        }
        for _ in 0..SPLIT_ROUNDS {
            self.context.check()?;
            let excess = |tet: TetId| longest_excess(complex, sizes, tet).map(|excess| -excess);
            let long = sift(complex, self.context, &Scope::default(), |_| false, excess).0;
            if long.is_empty() || self.driver.split_long_edges(complex, sizes, self.on_boundary, long)? == 0 {
                break;
            }
        }
        Ok(())
    }

    /// All operations at tets with skew faces but no sliver's angles.
    /// Slivers have had all operations, and for their sake tets off the boundary would become bad here.
    fn treat_skew_faces(&mut self, complex: &mut TetComplex, sizes: &mut Vec<f64>) -> Result<()> {
        let flat = FLAT_BELOW.to_radians().sin();
        let mut skew = tets_with_skew_faces(complex, self.context, &Scope::default());
        if skew.is_empty() || !self.options.delete_field_slivers {
            return Ok(());
        }
        self.driver.take_touched();
        for _ in 0..SKEW_ROUNDS {
            self.context.check()?;
            skew.retain(|&tet| BiasedSine.grade(complex.points_of(tet)) > flat);
            let treatment = Treatment::of_skew_faces();
            if skew.is_empty() || self.driver.treat(complex, sizes, self.on_boundary, skew, &treatment)? == 0 {
                break;
            }
            let scope = Scope::beside_changes(complex, self.context, self.driver.take_touched());
            skew = tets_with_skew_faces(complex, self.context, &scope);
        }
        Ok(())
    }

    /// All operations, however little they help, at the few lowest tets; returns how many were carried out.
    fn lift_lowest(&mut self, complex: &mut TetComplex, sizes: &mut Vec<f64>) -> Result<usize> {
        if !self.options.delete_field_slivers {
            return Ok(0);
        }
        let Self { driver, known, on_boundary, context, .. } = self;
        lift_lowest((complex, sizes), on_boundary, (driver, known), context)
    }

    /// All operations at bad tets, worst first; returns how many were carried out. Points crowd around the first ones
    /// while there is room for that.
    fn treat_bad(
        &mut self,
        complex: &mut TetComplex,
        sizes: &mut Vec<f64>,
        mut bad: Vec<TetId>,
        goal: f64,
    ) -> Result<usize> {
        let mut done = 0;
        if !self.options.delete_field_slivers {
            return self.driver.treat(complex, sizes, self.on_boundary, bad, &Treatment::topological(goal));
        }
        let count = self.crowded_points.min(count_of_bad(complex, &bad));
        if count > 0 {
            let rest = bad.split_off(count);
            let before = self.driver.vertex_changes().inserted;
            let treatment = Treatment::everything(goal, Crowding::Allowed);
            done += self.driver.treat(complex, sizes, self.on_boundary, bad, &treatment)?;
            let inserted = self.driver.vertex_changes().inserted - before;
            self.crowded_points = self.crowded_points.saturating_sub(inserted as usize);
            bad = rest;
        }
        let treatment = Treatment::everything(goal, Crowding::Refused);
        Ok(done + self.driver.treat(complex, sizes, self.on_boundary, bad, &treatment)?)
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::conforming::delaunay_kernel::{DelaunayOptions, tetrahedralize};
    use crate::index::Label;

    #[test]
    fn skew_faces_are_mended() {
        // A small triangle in the floor of a wide box, and one point far above to the side.
        let corners = [[-9.0, -8.0], [8.5, -9.0], [9.0, 9.5], [-8.0, 9.0]];
        let mut points: Vec<DVec3> =
            [0.0, 14.0].iter().flat_map(|&z| corners.map(|[x, y]| DVec3::new(x, y, z))).collect();
        points.extend([[0.0, 0.0], [0.3, 0.0], [0.0, 0.3]].map(|[x, y]| DVec3::new(x, y, 0.0)));
        points.push(DVec3::new(5.0, 1.0, 4.0));
        let (options, context) = (Options::default(), RunContext::with_threads(1).unwrap());
        let mut complex = tetrahedralize(&points, &DelaunayOptions::default(), &context).unwrap().complex;
        let tets: Vec<TetId> = complex.finite_tets().collect();
        tets.into_iter().for_each(|tet| complex.set_label(tet, Label(1)));
        assert!(!tets_with_skew_faces(&complex, &context, &Scope::default()).is_empty());
        let on_boundary = boundary_vertices(&complex, &context);
        let mut sizes = vec![1.0; points.len()];
        let driver = Driver::for_quality(&options, &context);
        let known = Known { angle: 90.0, grade: 0.0 };
        let options = &options;
        let mut improver =
            Improver { options, context: &context, on_boundary: &on_boundary, driver, known, crowded_points: 0 };
        improver.treat_skew_faces(&mut complex, &mut sizes).unwrap();
        assert!(tets_with_skew_faces(&complex, &context, &Scope::default()).is_empty());
        complex.check_invariants().unwrap();
        complex.check_orientation().unwrap();
    }
}
