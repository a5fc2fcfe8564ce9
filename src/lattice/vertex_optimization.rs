//! Vertices move to better places: surface vertices along their surface, others where the worst tet gets best.
//!
//! # Method
//! - Relaxation of a surface vertex: along the surface towards the mean of those neighbours on it that separate at least the
//!   same sides, then back onto the surface (or the junction line) by projection. Full, half and quarter steps are tried; one
//!   is taken when the ball keeps its lowest score or stays above the bound.
//! - Optimisation of any vertex: search along fixed directions with shrinking steps for a noticeably higher lowest score of the
//!   ball;
//!   surface vertices are projected after each trial and may stay off the surface by a small tolerance.
//!
//! # Source
//! [FreitagOllivierGooch1997] for the target of the optimisation; the search is a pattern search [HookeJeeves1961].
//!
//! # Invariants
//! No step lowers the lowest score of a ball that is below the bound.

use glam::DVec3;

use crate::lattice::element_score::{Ball, Threshold};
use crate::lattice::improvement_mesh::{ImprovementMesh, neighbors_in};
use crate::lattice::subvoxel_surface::Side;

/// Directions of the search: axes and diagonals of a cube.
const DIRECTIONS: [DVec3; 14] = {
    const D: f64 = 0.577_350_269_189_625_8;
    [
        DVec3::X,
        DVec3::NEG_X,
        DVec3::Y,
        DVec3::NEG_Y,
        DVec3::Z,
        DVec3::NEG_Z,
        DVec3::new(D, D, D),
        DVec3::new(-D, D, D),
        DVec3::new(D, -D, D),
        DVec3::new(D, D, -D),
        DVec3::new(-D, -D, D),
        DVec3::new(-D, D, -D),
        DVec3::new(D, -D, -D),
        DVec3::new(-D, -D, -D),
    ]
};

/// First step of the search in mean edge lengths, and how often it is halved.
const FIRST_STEP: f64 = 0.2;
const HALVINGS: usize = 5;

/// Least gain of a step of the search, degrees: where steps gain less, shorter ones are tried. Steps that gain anything at all
/// take 10 to 20 % more of the whole improvement's time, and raise no more tets to what is wanted.
const LEAST_GAIN: f64 = 0.3;

/// How far off its surface searches one after another may lead a vertex, in slacks. Of 14 balls the worst vertex ended 0.42 mean spacing
/// off without a bound, 0.20 with 1, 0.21 with 2; the volume of labels in disorder is off by 0.42, 0.47 and 0.45 % at most: what is
/// low still is searched for with more slack.
const CREEP: f64 = 2.0;

/// Part of the way to the neighbours' mean that a relaxation goes.
const RELAXATION: f64 = 0.7;

/// Plans the move of a surface vertex along its surface and onto it; `bound` is the score that may be spent. `None` where it
/// stays. `ball` is a scratch buffer.
pub fn plan_relaxation(mesh: &ImprovementMesh, v: u32, bound: &Threshold, ball: &mut Ball) -> Option<DVec3> {
    if mesh.fixed[v as usize] {
        return None;
    }
    let place = mesh.points[v as usize];
    let (mean, reach) = around_on_surface(mesh, v);
    let toward = mean.map_or(DVec3::ZERO, |mean| along_surface(mesh, v, mean - place));
    let wanted = place + toward * RELAXATION;
    let goal = mesh.surface.project(wanted, mesh.sides(v), reach)?;
    // A border plane is met exactly, however near the vertex is.
    let is_off_plane = goal != place && mesh.sides(v).iter().any(|s| matches!(s, Side::Border(_)));
    if goal.distance_squared(place) < 1e-6 * reach * reach && !is_off_plane {
        return None;
    }
    mesh.gather(v, ball);
    // Most moves stay above the bound: only where one does not, the present score is asked for.
    if ball.score_above(goal, bound).is_some() {
        return Some(goal);
    }
    let before = ball.score(place);
    if ball.score_above(place, bound).is_some() {
        // The score may fall to the bound, no lower.
        return steps(place, goal, &[0.5, 0.25]).find(|trial| ball.score_above(*trial, bound).is_some());
    }
    let needed = Threshold::of(before);
    steps(place, goal, &[1.0, 0.5, 0.25]).find(|trial| ball.score_above(*trial, &needed).is_some())
}

/// The part of a step along the surface between two labels; the whole step elsewhere. The mean of the neighbours of a tip lies
/// inside of it: a step there and the way back to the nearest surface would shorten the tip each time.
fn along_surface(mesh: &ImprovementMesh, v: u32, step: DVec3) -> DVec3 {
    let [Side::Label(a), Side::Label(b)] = *mesh.sides(v) else { return step };
    let normal = mesh.surface.signed_distance(mesh.points[v as usize], a, b).map(|(_, normal)| normal);
    normal.map_or(step, |normal| step - normal * step.dot(normal))
}

fn steps(place: DVec3, goal: DVec3, fractions: &[f64]) -> impl Iterator<Item = DVec3> {
    fractions.iter().map(move |fraction| place + (goal - place) * *fraction)
}

/// Mean of the neighbours on the surface that separate at least the same sides, `None` below two; and the mean distance of all
/// neighbours on the surface.
fn around_on_surface(mesh: &ImprovementMesh, v: u32) -> (Option<DVec3>, f64) {
    let mut near = neighbors_in(&mesh.surface_faces(v));
    let at = |w: &u32| mesh.points[*w as usize];
    let reach = near.iter().map(|w| at(w).distance(mesh.points[v as usize])).sum::<f64>() / near.len().max(1) as f64;
    near.retain(|w| mesh.sides_within(v, *w));
    ((near.len() >= 2).then(|| near.iter().map(at).sum::<DVec3>() / near.len() as f64), reach)
}

/// Plans the move of an inner vertex towards the mean of its neighbours where that raises the lowest score, if it is below `bound`.
/// `None` where it stays. `ball` is a scratch buffer.
pub fn plan_inside(mesh: &ImprovementMesh, v: u32, bound: f64, ball: &mut Ball) -> Option<DVec3> {
    if mesh.fixed[v as usize] || mesh.is_on_surface(v) {
        return None;
    }
    mesh.gather(v, ball);
    let place = mesh.points[v as usize];
    let before = ball.score(place);
    if before >= bound {
        return None;
    }
    let mean = ball.center().unwrap_or(place);
    let needed = Threshold::of(before);
    steps(place, mean, &[0.8, 0.4, 0.2])
        .find(|trial| ball.score_above(*trial, &needed).is_some_and(|score| score > before))
}

/// Plans the move of an inner vertex towards the middle of its ball, as far as its score stays at `wanted` or where it is,
/// whichever is less. `None` where it stays. `ball` is a scratch buffer.
pub fn plan_centering(mesh: &ImprovementMesh, v: u32, wanted: f64, ball: &mut Ball) -> Option<DVec3> {
    if mesh.fixed[v as usize] || mesh.is_on_surface(v) {
        return None;
    }
    mesh.gather(v, ball);
    let place = mesh.points[v as usize];
    let needed = Threshold::of(ball.score(place).min(wanted));
    let center = ball.center()?;
    steps(place, center, &[1.0, 0.7, 0.4, 0.2, 0.1]).find(|trial| ball.score_above(*trial, &needed).is_some())
}

/// A better place for a vertex of some sides with the tets of a ball, and the lowest score of these there; `wanted` is a score that is
/// enough, degrees, `slack` how far a surface vertex may stay off its surface, mm.
pub fn better_place(
    mesh: &ImprovementMesh,
    start: DVec3,
    sides: &[Side],
    [wanted, slack]: [f64; 2],
    ball: &mut Ball,
) -> (DVec3, f64) {
    let mut place = start;
    let mut best = ball.score(place);
    if best >= wanted {
        return (place, best);
    }
    let needed_above = |best: f64| Threshold::of((best + LEAST_GAIN).min(wanted));
    let mut needed = needed_above(best);
    let mut step = FIRST_STEP * ball.edge_length(place);
    let mut halvings = 0;
    let mut rounds = 0;
    while halvings < HALVINGS && best < wanted && rounds < 4 * HALVINGS {
        rounds += 1;
        let mut found = None;
        for direction in DIRECTIONS {
            let trial = place + direction * step;
            let Some(score) = ball.score_above(trial, &needed) else { continue };
            let better = if sides.is_empty() {
                Some((trial, score))
            } else {
                // Only now the price of a projection: most directions fail already.
                on_surface_trial(mesh, sides, trial, [step, slack], start, &needed, ball)
            };
            if let Some((trial, score)) = better.filter(|(_, score)| *score > best) {
                (found, best) = (Some(trial), score);
                needed = needed_above(best);
            }
        }
        match found {
            Some(trial) => place = trial,
            None => {
                step /= 2.0;
                halvings += 1;
            }
        }
    }
    (place, best)
}

/// The trial brought to within `slack` of the surface, or of where the vertex stood, when it still scores above what is
/// needed. Where many labels crowd, the surfaces of all sides of a vertex may meet nowhere near; where they do, no step leads farther
/// off than [`CREEP`] or the start, or each search would go on from where the last one ended.
fn on_surface_trial(
    mesh: &ImprovementMesh,
    sides: &[Side],
    trial: DVec3,
    [step, slack]: [f64; 2],
    start: DVec3,
    needed: &Threshold,
    ball: &mut Ball,
) -> Option<(DVec3, f64)> {
    let is_bound_to_plane = sides.iter().any(|s| matches!(s, Side::Border(_)));
    let reach = 4.0 * step + 4.0 * slack;
    let within = |center: DVec3| mesh.surface.within_borders(center + (trial - center).clamp_length_max(slack));
    let mut scored = |place: DVec3| Some((place, ball.score_above(place, needed)?));
    let Some(exact) = mesh.surface.project(trial, sides, reach) else {
        return Some(within(start)).filter(|_| !is_bound_to_plane).and_then(scored);
    };
    if is_bound_to_plane {
        return scored(exact);
    }
    let is_no_farther = |place: DVec3| {
        let off = place.distance(exact);
        off <= CREEP * slack || mesh.surface.project(start, sides, reach).is_some_and(|own| off <= start.distance(own))
    };
    let near_surface = [exact, within(exact)].into_iter().find_map(&mut scored);
    near_surface.or_else(|| scored(within(start)).filter(|(place, _)| is_no_farther(*place)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::test_meshes::with_vertex_on_ball;

    #[test]
    fn searches_one_after_another_end_near_the_surface() {
        let slack = 0.1;
        with_vertex_on_ball([0.0, 0.3], |mut mesh| {
            let [Side::Label(a), Side::Label(b)] = *mesh.sides(0) else { panic!("{:?}", mesh.sides(0)) };
            let place = mesh.surface.project(mesh.points[0], mesh.sides(0), 1.0).unwrap();
            mesh.move_vertex(0, place);
            let search = |_| {
                let (place, score) = mesh
                    .with_ball(0, |mesh, ball| better_place(mesh, mesh.points[0], mesh.sides(0), [90.0, slack], ball));
                mesh.move_vertex(0, place);
                score
            };
            let scores: Vec<f64> = (0..8).map(search).collect();
            // Farther off it would gain more.
            let [here, beyond] = [0.0, 0.1].map(|up| {
                let place = mesh.points[0] + DVec3::new(0.0, up, 0.0);
                mesh.with_ball(0, |_, ball| ball.score(place))
            });
            assert!(scores.is_sorted() && beyond > here + 1.0, "{scores:?} {beyond}");
            let off = mesh.surface.depth(mesh.points[0], a, b).unwrap().abs();
            assert!(off > 0.5 * slack && off <= 1.01 * CREEP * slack, "{off} {scores:?}");
        });
    }
}
