//! Edges of a surface that cut off what bends between their ends are split there.
//!
//! # Method
//! 1. For each face between two labels, the middles of its edges are compared with the sub-voxel surface of these labels.
//!    Edges whose middle is off by more than a tolerance are listed, the farthest off first.
//! 2. Each is split; the new vertex goes from the middle towards the surface as far as the scores around it allow
//!    ([`insert_in_edge`]). Later rounds of the improvement bring it the rest of the way.
//! ```text
//!        ___                    _m_
//!      /     \                 / | \       a thin vessel, and a chord through it
//!     a-------b       ->      a--|--b
//!      \_____/                 \_|_/
//! ```
//!
//! # Source
//! [Shewchuk2002] for the bound on what linear elements may miss; the tolerance takes the place of an estimate.
//!
//! # Invariants
//! The mesh conforms. No score falls below the bound that was not below before.
//!
//! # Cost
//! One distance per surface edge, in parallel; the splits are few.

use glam::DVec3;
use rayon::prelude::*;

use crate::index::Label;
use crate::lattice::element_score::Threshold;
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::lattice::local_transformations::{insert_in_edge, sides_of_edge};

/// Parts of the way from the middle of the edge to the surface that are tried.
const WAY: [f64; 5] = [1.0, 0.8, 0.6, 0.4, 0.2];

/// How far from the middle of an edge its surface is looked for, in lengths of the edge.
const REACH: f64 = 0.75;

/// Splits surface edges whose middle is off by more than `tolerance` (mm); `bound` is the score that may be spent, degrees. The
/// stars of the mesh are up to date. Returns how many were split.
pub fn split_chords(mesh: &mut ImprovementMesh, tolerance: f64, bound: f64) -> usize {
    let far = chords(mesh, tolerance);
    far.into_iter().filter(|(_, [a, b])| split_chord(mesh, *a, *b, bound)).count()
}

/// How far off and ends of the edges to be split, the farthest first.
fn chords(mesh: &ImprovementMesh, tolerance: f64) -> Vec<(f64, [u32; 2])> {
    let label = |t: u32| mesh.labels[t as usize];
    let of_vertex = |v: u32| {
        let star = mesh.stars().of(v).unwrap_or(&[]);
        // Each edge at its smaller vertex, in the face that runs along it.
        star.iter().filter(move |face| face.others[0] > v).filter_map(move |face| {
            let w = face.others[0];
            let middle = mesh.points[v as usize].midpoint(mesh.points[w as usize]);
            let outer = face.outer.map_or(Label::BACKGROUND, label);
            let (distance, _) = mesh.surface.signed_distance(middle, label(face.inner), outer)?;
            (distance.abs() > tolerance).then_some((distance.abs(), [v, w]))
        })
    };
    let vertices = (0..mesh.points.len() as u32).into_par_iter().with_min_len(1024);
    let mut far: Vec<(f64, [u32; 2])> = vertices.flat_map_iter(of_vertex).collect();
    far.sort_unstable_by(|l, r| r.0.total_cmp(&l.0).then(l.1.cmp(&r.1)));
    let mut seen = rustc_hash::FxHashSet::default();
    far.retain(|(_, ends)| seen.insert(*ends));
    far
}

fn split_chord(mesh: &mut ImprovementMesh, a: u32, b: u32, bound: f64) -> bool {
    let shell = mesh.shell(a, b);
    if shell.is_empty() {
        return false;
    }
    let sides = sides_of_edge(mesh, a, b, &shell);
    let [from, to] = [a, b].map(|v| mesh.points[v as usize]);
    let middle = from.midpoint(to);
    let Some(goal) = mesh.surface.project(middle, &sides, REACH * from.distance(to)) else { return false };
    let needed = Threshold::of(mesh.lowest(&shell).min(bound));
    let places = WAY.map(|part| middle + (goal - middle) * part);
    insert_in_edge(mesh, [a, b], &shell, middle, sides, |mesh, m| place_first(mesh, m, &places, &needed))
}

/// Moves a vertex to the first place where its tets reach the threshold.
fn place_first(mesh: &mut ImprovementMesh, v: u32, places: &[DVec3], needed: &Threshold) -> bool {
    mesh.with_ball(v, |mesh, ball| {
        let found = places.iter().find(|place| ball.score_above(**place, needed).is_some());
        found.inspect(|place| mesh.move_vertex(v, **place)).is_some()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
    use crate::image::label_image::LabelImage;
    use crate::lattice::options::{Options, PARAMETERS};
    use crate::lattice::test_images::voxel_image;
    use crate::mesh::validation::check_mixed_mesh;
    use crate::parameters::ParameterSet;

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
