//! Vertices move to better places: surface vertices along their surface, others where the worst tet gets best.
//!
//! # Method
//! - Relaxation of a surface vertex: towards the mean of those neighbours on the surface that separate at least the same
//!   sides, then back onto the surface (or the junction line) by projection.
//!   Full, half and quarter steps are tried; one
//!   is taken when the ball keeps its lowest score or stays above the bound.
//! - Optimisation of any vertex: search along fixed directions with shrinking steps for a higher lowest score of the ball;
//!   surface vertices are projected after each trial and may stay off the surface by a small tolerance.
//!
//! # Source
//! [FreitagOllivierGooch1997] for the target of the optimisation; the search is a pattern search [HookeJeeves1961].
//!
//! # Invariants
//! No step lowers the lowest score of a ball that is below the bound.

use glam::DVec3;

use crate::lattice::improvement_mesh::ImprovementMesh;

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

/// Part of the way to the neighbours' mean that a relaxation goes.
const RELAXATION: f64 = 0.7;

/// Moves a surface vertex along its surface and onto it; `bound` is the score that may be spent. Returns whether it moved.
pub fn relax_on_surface(mesh: &mut ImprovementMesh, v: u32, bound: f64) -> bool {
    if mesh.fixed[v as usize] {
        return false;
    }
    let place = mesh.points[v as usize];
    let mut near: Vec<u32> = mesh.surface_faces(v).iter().flat_map(|f| f.others).collect();
    near.sort_unstable();
    near.dedup();
    near.retain(|w| mesh.sides_within(v, *w));
    let reach = mesh.edge_length(v);
    let mean = if near.len() >= 2 {
        near.iter().map(|w| mesh.points[*w as usize]).sum::<DVec3>() / near.len() as f64
    } else {
        place
    };
    let wanted = place + (mean - place) * RELAXATION;
    let Some(goal) = mesh.surface.project(wanted, mesh.sides(v), reach) else { return false };
    if goal.distance_squared(place) < 1e-6 * reach * reach {
        return false;
    }
    // Most moves stay above the bound: only where one does not, the present score is asked for.
    if mesh.lowest_with(v, goal, bound) >= bound {
        mesh.points[v as usize] = goal;
        return true;
    }
    let needed = mesh.lowest_with(v, place, f64::NEG_INFINITY).min(bound);
    for fraction in [1.0, 0.5, 0.25] {
        let trial = place + (goal - place) * fraction;
        if mesh.lowest_with(v, trial, needed) >= needed {
            mesh.points[v as usize] = trial;
            return true;
        }
    }
    false
}

/// Moves an interior vertex towards the mean of its neighbours where that does not lower the lowest score.
pub fn relax_inside(mesh: &mut ImprovementMesh, v: u32, bound: f64) -> bool {
    if mesh.fixed[v as usize] || mesh.is_on_surface(v) {
        return false;
    }
    let place = mesh.points[v as usize];
    let before = mesh.lowest_with(v, place, f64::NEG_INFINITY);
    if before >= bound {
        return false;
    }
    let mut sum = DVec3::ZERO;
    let mut count = 0;
    for &t in mesh.ball(v) {
        for w in mesh.tets[t as usize] {
            if w != v {
                sum += mesh.points[w as usize];
                count += 1;
            }
        }
    }
    let mean = sum / f64::from(count.max(1));
    for fraction in [0.8, 0.4, 0.2] {
        let trial = place + (mean - place) * fraction;
        if mesh.lowest_with(v, trial, before) > before {
            mesh.points[v as usize] = trial;
            return true;
        }
    }
    false
}

/// Searches a better place for a vertex; `slack` (mm) is how far a surface vertex may stay off its surface. Returns the
/// lowest score of its ball.
pub fn optimize_vertex(mesh: &mut ImprovementMesh, v: u32, wanted: f64, slack: f64) -> f64 {
    let mut best = mesh.lowest_with(v, mesh.points[v as usize], f64::NEG_INFINITY);
    if mesh.fixed[v as usize] || best >= wanted {
        return best;
    }
    let on_surface = mesh.is_on_surface(v);
    let mut step = FIRST_STEP * mesh.edge_length(v);
    let mut halvings = 0;
    let mut rounds = 0;
    while halvings < HALVINGS && best < wanted && rounds < 4 * HALVINGS {
        rounds += 1;
        let place = mesh.points[v as usize];
        let mut found = None;
        for direction in DIRECTIONS {
            let trial = place + direction * step;
            let score = mesh.lowest_with(v, trial, best);
            if score <= best {
                continue;
            }
            if on_surface {
                // Only now the price of a projection: most directions fail already.
                let Some((projected, score)) = on_surface_trial(mesh, v, trial, step, slack, best) else { continue };
                best = score;
                found = Some(projected);
            } else {
                best = score;
                found = Some(trial);
            }
        }
        match found {
            Some(trial) => mesh.points[v as usize] = trial,
            None => {
                step /= 2.0;
                halvings += 1;
            }
        }
    }
    best
}

/// The trial brought to within `slack` of the surface, when it still scores above `best`.
fn on_surface_trial(
    mesh: &ImprovementMesh,
    v: u32,
    trial: DVec3,
    step: f64,
    slack: f64,
    best: f64,
) -> Option<(DVec3, f64)> {
    let exact = mesh.surface.project(trial, mesh.sides(v), 4.0 * step + 4.0 * slack)?;
    let offset = trial - exact;
    let is_bound_to_plane =
        mesh.sides(v).iter().any(|s| matches!(s, crate::lattice::subvoxel_surface::Side::Border(_)));
    for part in [0.0, 1.0] {
        let place = exact + offset.clamp_length_max(slack * part);
        let score = mesh.lowest_with(v, place, best);
        if score > best {
            return Some((place, score));
        }
        if is_bound_to_plane {
            break;
        }
    }
    None
}
