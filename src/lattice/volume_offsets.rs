//! How far outward each label's surface has to run so that the mesh keeps the volumes of the labels.
//!
//! # Method
//! The volume that each label lacks, over the areas between labels, gives the change of the labels' offsets: Gauss-Seidel for the
//! sum over the neighbours `b` of `area(a, b) (x_a - x_b) = missing(a)`, every offset within its bounds, so that the others take
//! into account which one has reached them. The background stays at 0.
//!
//! Relaxation brings the vertices to where the offsets have their surfaces. At the end, when it would spoil what stands, the vertices of
//! labels that are off go by the change of the offsets alone.
//!
//! # Limits
//! Between labels one voxel thick surfaces follow only a part of an offset: there voxel centres stand close on both sides.
//!
//! # Invariants
//! Volumes are summed in fixed chunks: the same bits for any number of threads.

use std::collections::BTreeMap;

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::tetrahedron::volume6;
use crate::index::Label;
use crate::lattice::element_score::{Part, Threshold};
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::lattice::subvoxel_surface::Side;

/// Sweeps of Gauss-Seidel: labels enclose one another a few deep.
const SWEEPS: usize = 30;

/// Tets, or vertices, per part of a sum.
const SUM_CHUNK: usize = 1 << 16;

/// Vertices between two looks at whether the run is cancelled.
const VERTICES_PER_CHECK: usize = 1024;

/// Sets the offsets of the mesh's surfaces, of `largest` mm at most, so that each label's volume would become the wanted one, mm^3.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn update_offsets(mesh: &mut ImprovementMesh, wanted: &[f64], largest: f64, context: &RunContext) -> Result<()> {
    let missing = missing_volumes(mesh, wanted, context)?;
    offset_by(mesh, &missing, largest, context)
}

/// Which vertices move with the offsets.
pub struct OffsetMoves {
    /// How far a label's volume has to be off for its surface to move, as a share of the wanted one.
    pub least: f64,
    /// Largest offset, mm.
    pub largest: f64,
    /// Score that the tets of a vertex keep, degrees.
    pub bound: f64,
}

/// Sets the offsets as [`update_offsets`] does, and moves the vertices between two labels by what they change: shapes stay, which a
/// relaxation would smooth. Returns whether a label was off.
///
/// # Errors
/// As [`update_offsets`].
pub fn move_by_offsets(
    mesh: &mut ImprovementMesh,
    wanted: &[f64],
    moves: &OffsetMoves,
    context: &RunContext,
) -> Result<bool> {
    let missing = missing_volumes(mesh, wanted, context)?;
    let is_off: Vec<bool> =
        missing.iter().zip(wanted).skip(1).map(|(missing, wanted)| missing.abs() > moves.least * wanted).collect();
    if !is_off.contains(&true) {
        return Ok(false);
    }
    let is_off = |label: Label| !label.is_background() && is_off[label.index() - 1];
    let before = mesh.surface.offsets_mut().to_vec();
    offset_by(mesh, &missing, moves.largest, context)?;
    let outward: Vec<f64> = mesh.surface.offsets_mut().iter().zip(before).map(|(now, then)| *now - then).collect();
    let needed = Threshold::of(moves.bound);
    for v in 0..mesh.points.len() as u32 {
        context.check_every(VERTICES_PER_CHECK, v as usize)?;
        let [Side::Label(a), Side::Label(b)] = *mesh.sides(v) else { continue };
        if mesh.fixed[v as usize] || mesh.ball(v).is_empty() || !(is_off(a) || is_off(b)) {
            continue;
        }
        let place = mesh.points[v as usize];
        let Some((_, normal)) = mesh.surface.signed_distance(place, a, b) else { continue };
        // The normal leads into the first label.
        let place = place - normal * (outward[a.index()] - outward[b.index()]);
        mesh.with_ball(v, |mesh, ball| {
            if ball.score_above(place, &needed).is_some() {
                mesh.move_vertex(v, place);
            }
        });
    }
    Ok(true)
}

/// What each label lacks of its wanted volume, mm^3.
fn missing_volumes(mesh: &ImprovementMesh, wanted: &[f64], context: &RunContext) -> Result<Vec<f64>> {
    context.check()?;
    let volumes = volumes_of(mesh, wanted.len());
    context.check()?;
    Ok(wanted.iter().zip(volumes).map(|(wanted, volume)| wanted - volume).collect())
}

/// Shifts the mesh's offsets by what is missing.
fn offset_by(mesh: &mut ImprovementMesh, missing: &[f64], largest: f64, context: &RunContext) -> Result<()> {
    mesh.refresh_stars(context)?;
    let pairs = areas_between(mesh);
    shift(mesh.surface.offsets_mut(), missing, &pairs, largest);
    Ok(())
}

/// Shifts the offsets by what is missing in volume, mm^3 per label, over the areas between labels, mm^2.
fn shift(offsets: &mut [f64], missing: &[f64], pairs: &[((usize, usize), f64)], largest: f64) {
    let before = offsets.to_vec();
    for _ in 0..SWEEPS {
        for label in 1..missing.len() {
            let (mut total, mut pull) = (0.0, missing[label]);
            for ((a, b), area) in pairs {
                if *a == label || *b == label {
                    let other = if *a == label { *b } else { *a };
                    total += area;
                    pull += area * (offsets[other] - before[other]);
                }
            }
            if total > 0.0 {
                offsets[label] = (before[label] + pull / total).clamp(-largest, largest);
            }
        }
    }
}

/// Volume per label, mm^3.
fn volumes_of(mesh: &ImprovementMesh, labels: usize) -> Vec<f64> {
    let of_chunk = |(chunk, rows): (usize, &[[u32; 4]])| {
        let mut volumes = vec![0.0; labels];
        for t in (chunk * SUM_CHUNK) as u32..(chunk * SUM_CHUNK + rows.len()) as u32 {
            if mesh.part(t) == Part::Mesh && mesh.is_live(t) {
                volumes[mesh.labels[t as usize].index()] += volume6(mesh.corners(t)) / 6.0;
            }
        }
        volumes
    };
    let parts: Vec<Vec<f64>> = mesh.tets.par_chunks(SUM_CHUNK).enumerate().map(of_chunk).collect();
    let mut volumes = vec![0.0; labels];
    for part in parts {
        volumes.iter_mut().zip(part).for_each(|(sum, part)| *sum += part);
    }
    volumes
}

/// Area between each pair of labels, mm^2, the background among them but not the image border; the stars are up to date.
fn areas_between(mesh: &ImprovementMesh) -> Vec<((usize, usize), f64)> {
    let of_chunk = |chunk: usize| {
        let mut areas: FxHashMap<(usize, usize), f64> = FxHashMap::default();
        for v in chunk * SUM_CHUNK..((chunk + 1) * SUM_CHUNK).min(mesh.points.len()) {
            let v = v as u32;
            // Each face once, at its vertex of the smallest number.
            let star = mesh.stars().of(v).unwrap_or(&[]);
            for face in star.iter().filter(|face| face.others.iter().all(|w| *w > v)) {
                let Some(labels) = mesh.labels_beside(v, face) else { continue };
                let [a, b] = face.others;
                let [p, q, r]: [DVec3; 3] = [v, a, b].map(|w| mesh.points[w as usize]);
                let [inner, outer] = labels.map(Label::index);
                *areas.entry((inner.min(outer), inner.max(outer))).or_default() += (q - p).cross(r - p).length() / 2.0;
            }
        }
        areas
    };
    let parts: Vec<_> = (0..mesh.points.len().div_ceil(SUM_CHUNK)).into_par_iter().map(of_chunk).collect();
    let mut areas: BTreeMap<(usize, usize), f64> = BTreeMap::new();
    for (pair, area) in parts.into_iter().flatten() {
        *areas.entry(pair).or_default() += area;
    }
    areas.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
    use crate::index::VertexId;
    use crate::lattice::boundary_targets::SourcePoints;
    use crate::lattice::candidate_mesh::CandidateMesh;
    use crate::lattice::face_adjacency::neighbors_of;
    use crate::lattice::subvoxel_surface::SubvoxelSurface;
    use crate::lattice::test_images::voxel_image;

    #[test]
    fn vertices_move_so_that_a_label_has_its_volume() {
        // An octahedron around a vertex, within a ball of 3 voxels radius.
        let center = DVec3::splat(6.0);
        let ring = [DVec3::X, DVec3::Y, DVec3::NEG_X, DVec3::NEG_Y];
        let mut points = vec![center, center - 3.0 * DVec3::Z, center + 3.0 * DVec3::Z];
        points.extend(ring.map(|p| center + 3.0 * p));
        let mut rows: Vec<[u32; 4]> = Vec::new();
        for i in 0..4 {
            let [p, q] = [3 + i, 3 + (i + 1) % 4];
            rows.extend([[0, p, q, 2], [0, q, p, 1]]);
        }
        let tets: Vec<[VertexId; 4]> = rows.iter().map(|tet| tet.map(VertexId)).collect();
        let tet_labels = vec![Label(1); tets.len()];
        let image = voxel_image(13, |p| u16::from(p.distance(center) < 3.0));
        let context = RunContext::with_threads(1).unwrap();
        let surface = SubvoxelSurface::new(&image, &context).unwrap();
        let neighbors = neighbors_of(&rows, points.len(), &context).unwrap();
        let sources = SourcePoints::new(&points, &tets, &tet_labels, &neighbors, &surface, &[], &context).unwrap();
        let mut mesh = CandidateMesh { points, tets, tet_labels, ..CandidateMesh::default() };
        let mut work = ImprovementMesh::new(&mut mesh, &sources, surface);
        let volume = |work: &ImprovementMesh| volumes_of(work, 2)[1];
        assert!((volume(&work) - 36.0).abs() < 1e-9);
        let moves = |least: f64, bound: f64| OffsetMoves { least, largest: 0.5, bound };
        let mut steps = |wanted: f64, moves: OffsetMoves, context: &RunContext| {
            let moved = move_by_offsets(&mut work, &[0.0, wanted], &moves, context);
            (moved, volume(&work))
        };
        // Off by 5.3 %.
        let (moved, held) = steps(38.0, moves(0.06, 15.0), &context);
        assert!(!moved.unwrap() && (held - 36.0).abs() < 1e-9);
        assert!((0..2).all(|_| steps(38.0, moves(0.0, 15.0), &context).0.unwrap()));
        let (_, held) = steps(38.0, moves(0.0, 15.0), &context);
        // Measured 37.85: the vertices of so coarse a mesh go less far than its faces would have to.
        assert!((held - 38.0).abs() < 0.2, "{held}");
        for wanted in [38.0, 30.0] {
            let (moved, volume) = steps(wanted, moves(0.0, 89.0), &context);
            assert!(moved.unwrap());
            assert_eq!(volume, held);
        }
        context.cancel_token().cancel();
        let (cancelled, volume) = steps(30.0, moves(0.0, 15.0), &context);
        assert!(matches!(cancelled, Err(crate::Error::Cancelled)));
        assert_eq!(volume, held);
    }

    #[test]
    fn a_label_around_one_at_its_bound_lacks_nothing() {
        // Label 1 inside of label 2: areas of 10 and 40 mm^2.
        let pairs = [((0, 2), 40.0), ((1, 2), 10.0)];
        let mut offsets = [0.0; 3];
        shift(&mut offsets, &[0.0, 10.0, -2.0], &pairs, 0.5);
        // Label 1 gets half of the millimetre that it asks for, which takes 10 (0.5 - x) of label 2; 40 x comes from the outside.
        let x = offsets[2];
        assert_eq!(offsets[1], 0.5);
        assert!((40.0 * x - 10.0 * (0.5 - x) + 2.0).abs() < 1e-9, "{x}");
        // Without bounds both volumes are met.
        let mut offsets = [0.0; 3];
        shift(&mut offsets, &[0.0, 10.0, -2.0], &pairs, 5.0);
        assert!((10.0 * (offsets[1] - offsets[2]) - 10.0).abs() < 1e-9, "{offsets:?}");
    }
}
