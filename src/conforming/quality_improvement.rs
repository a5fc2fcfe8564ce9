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
//! After the passes, and again up to `nqualf` times while a tet is above `angqmax`, the worst tets get all operations.
//!
//! # Source
//! [Drakopoulos2017] 4.9; B.3 `nqual`, `nqualf`, `angqual`, `angqmsk`, `angqmax`, `mrecqm`, `mrecqmf`, `ordtq`, `mdfs`, `ndfs`,
//! `angdfs`, `mdse`, `cdse`; operations and their order beyond the thesis: [KlingnerShewchuk2007].
//!
//! # Invariants
//! No operation lowers the worst tet of what it touches (except plain smoothing with `smart` off, which stays valid).
//! Constraints are kept.
//!
//! # Cost
//! Scans are linear and parallel; the rest is proportional to the number of bad tets.

use std::time::Instant;

use rayon::prelude::*;

use super::flip_criteria::{BiasedSine, TetMeasure};
use super::local_reconnection::{FourFour, Objective};
use super::options::Options;
use super::parallel_reconnection::{Driver, Treatment};
use super::refinement::boundary_triangles;
use super::smoothing::{Acceptance, SmoothingRule, Target};
use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::tetrahedron::{dihedral_cosines, exceeds_angle};
use crate::index::{TetId, VertexId};
use crate::mesh::quality::SLIVER_DEGREES;
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::statistics::Statistics;

/// Most rounds over the worst tets after the passes.
const WORST_ROUNDS: usize = 6;
/// Angles that the rounds over the worst tets aim at, degrees: beyond what users ask for, so that they get it.
const WORST_GOAL: (f64, f64) = (24.0, 145.0);
/// Tets per parallel chunk.
const CHUNK: usize = 2048;

/// Tets that a rule finds bad, worst first.
fn bad_tets(complex: &TetComplex, context: &RunContext, is_bad: impl Fn(TetId) -> Option<f64> + Sync) -> Vec<TetId> {
    let slots = complex.slot_count();
    let mut found: Vec<(f64, TetId)> = context.install(|| {
        (0..slots)
            .into_par_iter()
            .with_min_len(CHUNK)
            .filter_map(|i| {
                let tet = TetId::from_index(i);
                let usable = complex.is_live(tet) && !complex.label(tet).is_background() && !complex.is_ghost_tet(tet);
                if usable { is_bad(tet).map(|grade| (grade, tet)) } else { None }
            })
            .collect()
    });
    // Stable and by id within a grade: the same order for any thread count.
    found.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    found.into_iter().map(|(_, tet)| tet).collect()
}

/// Tets with a dihedral angle above `degrees`, largest first.
pub fn tets_above(complex: &TetComplex, context: &RunContext, degrees: f64) -> Vec<TetId> {
    let limit = degrees.to_radians().cos();
    bad_tets(complex, context, |tet| {
        let corners = complex.points_of(tet);
        exceeds_angle(corners, limit).then(|| dihedral_cosines(corners).1)
    })
}

/// Slivers: tets with an angle below 2 or above 178 degrees.
pub fn sliver_count(complex: &TetComplex, context: &RunContext) -> usize {
    let limit = SLIVER_DEGREES.to_radians().cos();
    bad_tets(complex, context, |tet| {
        let (largest, smallest) = dihedral_cosines(complex.points_of(tet));
        (largest > limit || smallest < -limit).then_some(smallest)
    })
    .len()
}

/// Tets with a grade below `limit`, worst first.
fn tets_below(complex: &TetComplex, context: &RunContext, limit: f64) -> Vec<TetId> {
    bad_tets(complex, context, |tet| {
        let grade = BiasedSine.grade(complex.points_of(tet));
        (grade < limit).then_some(grade)
    })
}

fn vertices_of(complex: &TetComplex, tets: &[TetId]) -> Vec<VertexId> {
    let mut vertices: Vec<VertexId> =
        tets.iter().flat_map(|&t| complex.vertices(t)).filter(|v| !v.is_ghost()).collect();
    vertices.sort_unstable();
    vertices.dedup();
    vertices
}

/// Which vertices lie on the boundary.
pub(super) fn boundary_vertices(complex: &TetComplex) -> Vec<bool> {
    let mut marks = vec![false; complex.vertex_count()];
    boundary_triangles(complex).as_flattened().iter().for_each(|v| marks[v.index()] = true);
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
    let flat = tets_below(complex, context, goal);
    if flat.is_empty() {
        return Ok(());
    }
    let on_boundary = boundary_vertices(complex);
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
    let mut driver = Driver::for_quality(options, context);
    let on_boundary = boundary_vertices(complex);
    let passes = options.quality_passes;
    for repeat in 0..=options.quality_repeats {
        for pass in 0..passes {
            context.check()?;
            let is_last = pass + 1 == passes;
            let pass_start = Instant::now();
            improvement_pass(complex, sizes, options, context, &on_boundary, &mut driver, is_last)?;
            let number = repeat * passes + pass + 1;
            let counts = driver.take_counts();
            for (name, value) in [
                ("flips_tried", counts.tried as f64),
                ("flips_accepted", counts.accepted as f64),
                ("flips_lost", counts.lost as f64),
                ("slivers", tets_above(complex, context, options.field_sliver_angle).len() as f64),
                ("time", pass_start.elapsed().as_secs_f64()),
            ] {
                figures.set(format!("quality.pass.{number}.{name}"), value);
            }
            if options.quality_statistics {
                let rows: Vec<_> = complex.finite_tets().map(|t| complex.vertices(t)).collect();
                let quality = crate::mesh::quality::tets_quality(complex.points(), &rows, context);
                for (name, value) in quality.statistics().entries() {
                    figures.set(format!("quality.pass.{number}.{name}"), *value);
                }
            }
            context.progress("quality improvement", 0.65 + 0.3 * (pass + 1) as f64 / (passes + 1) as f64);
        }
        improve_worst(complex, sizes, options, context, &on_boundary, &mut driver)?;
        if tets_above(complex, context, options.repeat_angle).is_empty() {
            break;
        }
    }
    driver.record(&mut figures, "quality");
    figures.set("time.quality", start.elapsed().as_secs_f64());
    Ok(figures)
}

fn improvement_pass(
    complex: &mut TetComplex,
    sizes: &mut Vec<f64>,
    options: &Options,
    context: &RunContext,
    on_boundary: &[bool],
    driver: &mut Driver,
    is_last: bool,
) -> Result<()> {
    let criterion = if is_last { options.final_reconnection_criterion } else { options.quality_reconnection_criterion };
    let objective = if criterion == 3 { Objective::Skew } else { Objective::EdgeWeight };
    // 4-4 flips belong to the last pass, or to all where they are switched on.
    let four = match (is_last || options.flip_44, options.flip_44_quality) {
        (false, _) => FourFour::Off,
        (true, false) => FourFour::First,
        (true, true) => FourFour::Best,
    };
    if options.group_active_quality {
        let mut active = tets_above(complex, context, options.quality_angle);
        driver.reconnect(complex, &mut active, objective, four, 1)?;
    } else {
        driver.reconnect_ungrouped(complex, options.quality_angle, objective, four)?;
    }
    if options.delete_small_edges {
        driver.collapse_small_edges(complex, sizes, options.small_edge_factor)?;
    }
    let masked = tets_above(complex, context, options.mask_angle);
    let mut vertices = vertices_of(complex, &masked);
    let rule = SmoothingRule {
        target: if options.smoothing_mode == 2 { Target::Centroids } else { Target::OptimalPlacement },
        coefficient: options.smoothing_coefficient,
        acceptance: if options.smart_smoothing { Acceptance::Smart } else { Acceptance::Valid },
    };
    for _ in 0..options.smoothing_iterations {
        vertices = driver.smooth(complex, vertices, on_boundary, &rule, options.boundary_smoothing_factor)?;
    }
    // The grade that the masking angle has; small angles of the same grade count as well.
    let mask = BiasedSine::grade_of_angles(90.0, options.mask_angle);
    let goal = mask.min(BiasedSine::grade_of_angles(WORST_GOAL.0, WORST_GOAL.1));
    let bad = tets_below(complex, context, goal);
    driver.treat(complex, sizes, on_boundary, bad, &Treatment::topological(goal))?;
    if options.delete_field_slivers {
        for _ in 0..options.field_sliver_repeats {
            let slivers = tets_above(complex, context, options.field_sliver_angle);
            if slivers.is_empty()
                || driver.treat(complex, sizes, on_boundary, slivers, &Treatment::everything(goal))? == 0
            {
                break;
            }
        }
    }
    Ok(())
}

fn improve_worst(
    complex: &mut TetComplex,
    sizes: &mut Vec<f64>,
    options: &Options,
    context: &RunContext,
    on_boundary: &[bool],
    driver: &mut Driver,
) -> Result<()> {
    let goal = BiasedSine::grade_of_angles(WORST_GOAL.0, WORST_GOAL.1);
    let treatment =
        if options.delete_field_slivers { Treatment::everything(goal) } else { Treatment::topological(goal) };
    driver.take_touched();
    let mut touched: Option<Vec<bool>> = None;
    for _ in 0..WORST_ROUNDS {
        context.check()?;
        let mut bad = tets_below(complex, context, goal);
        // Where nothing has changed, what failed fails again.
        if let Some(touched) = &touched {
            bad.retain(|&tet| complex.vertices(tet).iter().any(|v| touched[v.index()]));
        }
        if bad.is_empty() || driver.treat(complex, sizes, on_boundary, bad, &treatment)? == 0 {
            break;
        }
        let mut marks = vec![false; complex.vertex_count()];
        driver.take_touched().iter().filter(|v| !v.is_ghost()).for_each(|v| marks[v.index()] = true);
        touched = Some(marks);
    }
    Ok(())
}
