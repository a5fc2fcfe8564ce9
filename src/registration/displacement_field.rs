//! Dense fields: from the nodes of a mesh, composition, folding check and repair, inverse.
//!
//! # Method
//! 1. Every voxel inside the mesh takes the interpolated displacement of its element; voxels outside take the mean of their
//!    neighbours, layer by layer, so that the field continues smoothly.
//! 2. The rigid transform R follows the deformation u: the field at y is `R(y + u(y)) - y`, so that the moving scan is interpolated
//!    once, whatever the number of iterations.
//! 3. Outside of the tissue the displacement is kept up to 10 mm and fades to that of the rigid transform over the given distance:
//!    there is nothing to measure, and a host that warps the skull or the skin gets the rigid transform there.
//! 4. Folding: the Jacobian determinant of `y + d(y)` from central differences and from the eight corners of each voxel; voxels
//!    below the limit and their neighbours are averaged with their neighbours until none is left.
//! 5. Inverse: Newton's method per voxel on the trilinear field.
//!
//! # Source
//! [Drakopoulos2017] section 3.7.2 (deformation field update, eq. 6).
//!
//! # Differences
//! Eq. 6 adds the fields of the iterations; here every iteration fits the whole deformation anew to matches that add up exactly.
//! The fading, the repair and the inverse are ours.
//!
//! # Invariants
//! Same bits for any number of threads; every vector is finite.

use glam::{DMat3, DMat4, DVec3, Mat3, Vec3};
use rayon::prelude::*;

use super::accuracy::squared_distances;
use super::feature_points::voxel_of;
use super::options::apply;
use super::working_grid::coarser;
use crate::error::Result;
use crate::fem::element_mesh::ElementMesh;
use crate::fem::point_interpolation::PointLocator;
use crate::image::grid::Grid;
use crate::image::interpolation::Stencil;
use crate::image::resample::map_voxels;
use crate::image::vector_image::VectorImage;
use crate::mesh::mixed_mesh::MixedMesh;

/// Rounds of averaging at most; a fold of ten voxels across is gone after about a hundred.
const MAX_REPAIRS: usize = 400;

/// The displacement of the tissue is kept this far outside of it, mm: masks miss its rim.
const KEPT: f64 = 10.0;

/// Newton steps per voxel at most.
const MAX_NEWTON: usize = 12;

/// Residual at which an inverse is good, mm.
const INVERSE_TOLERANCE: f64 = 1e-3;

/// The displacements of the nodes of `mesh` on `grid`.
///
/// # Errors
/// As [`PointLocator::new`].
pub fn field_of_mesh(mesh: &MixedMesh, displacements: &[DVec3], grid: &Grid) -> Result<VectorImage> {
    let locator = PointLocator::new(ElementMesh::from_mixed(mesh))?;
    let known: Vec<Option<Vec3>> =
        map_voxels(grid, |point, _| locator.locate(point).map(|at| locator.interpolate(&at, displacements).as_vec3()));
    VectorImage::new(*grid, extend(known, grid.size()))
}

/// Fills unknown voxels layer by layer with the mean of their known neighbours.
fn extend(known: Vec<Option<Vec3>>, size: [usize; 3]) -> Vec<Vec3> {
    let mut vectors: Vec<Vec3> = known.iter().map(|v| v.unwrap_or(Vec3::ZERO)).collect();
    let mut is_known: Vec<bool> = known.iter().map(Option::is_some).collect();
    let is_open = |at: usize, is_known: &[bool]| !is_known[at] && neighbors(at, size).any(|n| is_known[n]);
    let mut layer: Vec<usize> = (0..vectors.len()).into_par_iter().filter(|&at| is_open(at, &is_known)).collect();
    while !layer.is_empty() {
        let filled: Vec<Vec3> = layer
            .par_iter()
            .map(|&at| {
                let (sum, count) = neighbors(at, size)
                    .filter(|n| is_known[*n])
                    .fold((Vec3::ZERO, 0.0), |(sum, count), n| (sum + vectors[n], count + 1.0));
                sum / count
            })
            .collect();
        for (&at, vector) in layer.iter().zip(filled) {
            vectors[at] = vector;
            is_known[at] = true;
        }
        let mut next: Vec<usize> = layer.iter().flat_map(|&at| neighbors(at, size)).filter(|n| !is_known[*n]).collect();
        next.sort_unstable();
        next.dedup();
        layer = next;
    }
    vectors
}

/// The up to six face neighbours of a voxel.
pub(crate) fn neighbors(at: usize, size: [usize; 3]) -> impl Iterator<Item = usize> {
    let voxel = voxel_of(at, size);
    let strides = [1, size[0], size[0] * size[1]];
    (0..3).flat_map(move |axis| {
        let low = (voxel[axis] > 0).then(|| at - strides[axis]);
        let high = (voxel[axis] + 1 < size[axis]).then(|| at + strides[axis]);
        low.into_iter().chain(high)
    })
}

/// The field that applies `deformation` first, then a rigid transform.
///
/// # Errors
/// [`crate::Error::InvalidArgument`] where it is not finite.
pub fn before_rigid(deformation: &VectorImage, matrix: &DMat4) -> Result<VectorImage> {
    let vectors = map_voxels(deformation.grid(), |point, at| {
        let moved = point + deformation.vectors()[at].as_dvec3();
        (apply(matrix, moved) - point).as_vec3()
    });
    VectorImage::new(*deformation.grid(), vectors)
}

/// The field of a rigid transform on a grid.
///
/// # Errors
/// [`crate::Error::InvalidArgument`] where it is not finite.
pub fn rigid_field(matrix: &DMat4, grid: &Grid) -> Result<VectorImage> {
    VectorImage::new(*grid, map_voxels(grid, |point, _| (apply(matrix, point) - point).as_vec3()))
}

/// The field on another grid.
///
/// # Errors
/// None for a finite field.
pub fn resample_field(field: &VectorImage, grid: &Grid) -> Result<VectorImage> {
    VectorImage::new(*grid, map_voxels(grid, |point, _| field.at_clamped(point).as_vec3()))
}

/// Fades a field to that of a rigid transform over `distance` mm outside of `inside`, beginning 10 mm from it.
pub fn fade_to_rigid(field: &mut VectorImage, inside: &[bool], matrix: &DMat4, distance: f64) {
    let grid = *field.grid();
    let squared = squared_distances(inside, grid.size(), grid.spacing().to_array());
    let faded = map_voxels(&grid, |point, at| {
        let share = ((f64::from(squared[at]).sqrt() - KEPT) / distance).clamp(0.0, 1.0);
        // The cubic with slope 0 at both ends.
        let kept = 1.0 - share * share * (3.0 - 2.0 * share);
        let rigid = (apply(matrix, point) - point).as_vec3();
        if share == 0.0 { field.vectors()[at] } else { rigid + (field.vectors()[at] - rigid) * kept as f32 }
    });
    field.vectors_mut().copy_from_slice(&faded);
}

/// Smallest Jacobian determinant at every voxel: of central differences, and of the eight corners.
pub fn jacobian_determinants(field: &VectorImage) -> Vec<f32> {
    let slopes = Slopes::new(field);
    (0..field.vectors().len()).into_par_iter().map(|at| slopes.determinant(at)).collect()
}

struct Slopes<'a> {
    field: &'a VectorImage,
    size: [usize; 3],
    /// World derivative from index derivative: columns are the rows of the inverse of direction times spacing.
    to_world: Mat3,
}

impl<'a> Slopes<'a> {
    fn new(field: &'a VectorImage) -> Self {
        let grid = field.grid();
        let inverse = DMat3::from_diagonal(grid.spacing().recip()) * grid.direction().inverse();
        Self { field, size: grid.size(), to_world: inverse.as_mat3() }
    }

    fn determinant(&self, at: usize) -> f32 {
        let voxel = voxel_of(at, self.size);
        let strides = [1, self.size[0], self.size[0] * self.size[1]];
        let v = self.field.vectors();
        // Per axis the step down and the step up; at the border the one that exists.
        let mut steps = [[Vec3::ZERO; 2]; 3];
        for axis in 0..3 {
            let low = (voxel[axis] > 0).then(|| v[at] - v[at - strides[axis]]);
            let high = (voxel[axis] + 1 < self.size[axis]).then(|| v[at + strides[axis]] - v[at]);
            steps[axis] = [low.or(high).unwrap_or(Vec3::ZERO), high.or(low).unwrap_or(Vec3::ZERO)];
        }
        let of = |x: Vec3, y: Vec3, z: Vec3| (Mat3::IDENTITY + Mat3::from_cols(x, y, z) * self.to_world).determinant();
        let middle = steps.map(|[low, high]| 0.5 * (low + high));
        (0..8)
            .map(|corner| of(steps[0][corner & 1], steps[1][corner >> 1 & 1], steps[2][corner >> 2]))
            .fold(of(middle[0], middle[1], middle[2]), f32::min)
    }
}

/// What a repair found and did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoldReport {
    /// Voxels whose determinant was not positive before.
    pub folded_before: usize,
    /// Voxels that were smoothed.
    pub smoothed: usize,
    /// Smallest determinant after.
    pub minimum: f32,
}

/// Smooths the field where its Jacobian determinant is below `limit`, until it is nowhere or the rounds end.
pub fn repair_folds(field: &mut VectorImage, limit: f64) -> FoldReport {
    let size = field.grid().size();
    let mut determinants = jacobian_determinants(field);
    let folded_before = determinants.iter().filter(|d| **d <= 0.0).count();
    let mut touched = vec![false; determinants.len()];
    for _ in 0..MAX_REPAIRS {
        let bad: Vec<usize> =
            (0..determinants.len()).into_par_iter().filter(|&at| f64::from(determinants[at]) < limit).collect();
        if bad.is_empty() {
            break;
        }
        // Two rings: the fold is spread over more voxels each round.
        let region = ring(&ring(&bad, size), size);
        let averaged: Vec<Vec3> = region
            .par_iter()
            .map(|&at| {
                let (sum, count) = neighbors(at, size)
                    .fold((Vec3::ZERO, 0.0), |(sum, count), n| (sum + field.vectors()[n], count + 1.0));
                0.4 * field.vectors()[at] + sum * (0.6 / count)
            })
            .collect();
        for (&at, vector) in region.iter().zip(averaged) {
            field.vectors_mut()[at] = vector;
            touched[at] = true;
        }
        let changed = ring(&region, size);
        let slopes = Slopes::new(field);
        let fresh: Vec<f32> = changed.par_iter().map(|&at| slopes.determinant(at)).collect();
        for (&at, determinant) in changed.iter().zip(fresh) {
            determinants[at] = determinant;
        }
    }
    FoldReport {
        folded_before,
        smoothed: touched.iter().filter(|t| **t).count(),
        minimum: determinants.iter().copied().fold(f32::INFINITY, f32::min),
    }
}

/// The voxels and their face neighbours, sorted.
fn ring(voxels: &[usize], size: [usize; 3]) -> Vec<usize> {
    let mut grown: Vec<usize> = voxels.iter().flat_map(|&at| std::iter::once(at).chain(neighbors(at, size))).collect();
    grown.sort_unstable();
    grown.dedup();
    grown
}

/// The inverse of `field` on `grid`: displacements from points of the moving space to the fixed space. `start` maps moving
/// points to fixed points roughly. Voxels outside of `inside` are interpolated from a grid of twice the spacing, where the
/// inverse is that of `outer`.
///
/// # Errors
/// None for a finite field.
pub fn invert(
    field: &VectorImage,
    outer: &VectorImage,
    grid: &Grid,
    inside: &[bool],
    start: &DMat4,
) -> Result<VectorImage> {
    let coarse = coarser(grid, 2.0)?;
    let rough = map_voxels(&coarse, |point, _| (invert_point(outer, point, apply(start, point)) - point).as_vec3());
    let rough = VectorImage::new(coarse, rough)?;
    let vectors = map_voxels(grid, |point, at| {
        let guess = rough.at_clamped(point);
        if inside[at] { (invert_point(field, point, point + guess) - point).as_vec3() } else { guess.as_vec3() }
    });
    VectorImage::new(*grid, vectors)
}

/// The point that the field maps to `target`, searched from `start`.
pub fn invert_point(field: &VectorImage, target: DVec3, start: DVec3) -> DVec3 {
    // Longer steps leave the neighbourhood where the field is nearly linear.
    const LONGEST_STEP: f64 = 6.0;
    let grid = field.grid();
    let to_world = DMat3::from_diagonal(grid.spacing().recip()) * grid.direction().inverse();
    let residual_at = |y: DVec3| y + field.at_clamped(y) - target;
    let mut y = start;
    let mut residual = residual_at(y);
    for _ in 0..MAX_NEWTON {
        if residual.length() < INVERSE_TOLERANCE {
            break;
        }
        let jacobian = match Stencil::at(grid.size(), grid.world_to_index(y)) {
            Some(stencil) => {
                let [x, j, k] = stencil.derivative(field.vectors());
                DMat3::IDENTITY + DMat3::from_cols(x.as_dvec3(), j.as_dvec3(), k.as_dvec3()) * to_world
            }
            None => DMat3::IDENTITY,
        };
        let step = if jacobian.determinant() > 1e-3 { jacobian.inverse() * residual } else { residual };
        let step = step.clamp_length_max(LONGEST_STEP);
        let mut damping = 1.0;
        let mut next = y - step;
        let mut next_residual = residual_at(next);
        while next_residual.length() > residual.length() && damping > 0.1 {
            damping *= 0.5;
            next = y - step * damping;
            next_residual = residual_at(next);
        }
        (y, residual) = (next, next_residual);
    }
    y
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> Grid {
        let direction = DMat3::from_rotation_z(0.3);
        Grid::new([30, 28, 26], DVec3::splat(2.0), DVec3::new(-20.0, -30.0, 5.0), direction).unwrap()
    }

    fn wave(amplitude: f64) -> VectorImage {
        let vectors = map_voxels(&grid(), |p, _| {
            (DVec3::new((p.y * 0.2).sin(), (p.z * 0.15).cos(), (p.x * 0.18).sin()) * amplitude).as_vec3()
        });
        VectorImage::new(grid(), vectors).unwrap()
    }

    #[test]
    fn field_and_inverse_cancel() {
        let field = wave(2.0);
        let inverse = invert(&field, &field, &grid(), &vec![true; 30 * 28 * 26], &DMat4::IDENTITY).unwrap();
        for index in [DVec3::new(10.0, 12.0, 9.0), DVec3::new(15.0, 8.0, 20.0)] {
            let at = grid().offset(index.x as usize, index.y as usize, index.z as usize);
            let moving = grid().index_to_world(index);
            let fixed = moving + inverse.vectors()[at].as_dvec3();
            assert!((fixed + field.at(fixed).unwrap() - moving).length() < 2e-3);
        }
    }

    #[test]
    fn determinants_are_exact_for_linear_fields() {
        let matrix =
            DMat3::from_cols(DVec3::new(0.1, 0.02, 0.0), DVec3::new(-0.1, 0.2, 0.05), DVec3::new(0.0, 0.0, -0.3));
        let field = VectorImage::new(grid(), map_voxels(&grid(), |p, _| (matrix * p).as_vec3())).unwrap();
        let expected = (DMat3::IDENTITY + matrix).determinant();
        assert!(jacobian_determinants(&field).iter().all(|d| (f64::from(*d) - expected).abs() < 1e-3));
    }

    #[test]
    fn outside_of_the_tissue_the_field_becomes_rigid() {
        let matrix = DMat4::from_translation(DVec3::new(3.0, -2.0, 1.0)) * DMat4::from_rotation_z(0.1);
        let mut field = before_rigid(&wave(2.0), &matrix).unwrap();
        let before = field.clone();
        let inside: Vec<bool> = (0..field.vectors().len()).map(|at| voxel_of(at, grid().size())[0] < 8).collect();
        fade_to_rigid(&mut field, &inside, &matrix, 20.0);
        for (at, (was, is)) in before.vectors().iter().zip(field.vectors()).enumerate() {
            let [i, j, k] = voxel_of(at, grid().size());
            let distance = 2.0 * (i as f64 - 7.0).max(0.0);
            let point = grid().index_to_world(DVec3::new(i as f64, j as f64, k as f64));
            let rigid = (apply(&matrix, point) - point).as_vec3();
            let kept = (*is - rigid).length() / (*was - rigid).length();
            assert!(distance > KEPT || was == is, "{distance}");
            assert!(distance < KEPT + 20.0 || (*is - rigid).length() < 1e-6, "{distance}");
            assert!(distance != KEPT + 10.0 || (kept - 0.5).abs() < 1e-3, "{kept}");
        }
    }

    #[test]
    fn folds_are_repaired() {
        let mut field = wave(0.5);
        let at = grid().offset(14, 14, 12);
        field.vectors_mut()[at] = Vec3::new(9.0, -9.0, 4.0);
        let report = repair_folds(&mut field, 0.1);
        assert!(report.folded_before > 0 && report.minimum >= 0.1, "{report:?}");
        assert!(report.smoothed < 3000, "{report:?}");
    }

    #[test]
    fn the_deformation_comes_before_the_rigid_transform() {
        let matrix = DMat4::from_rotation_z(0.5) * DMat4::from_translation(DVec3::new(3.0, -2.0, 1.0));
        let deformation = wave(1.0);
        let both = before_rigid(&deformation, &matrix).unwrap();
        let at = grid().offset(12, 13, 14);
        let point = grid().index_to_world(DVec3::new(12.0, 13.0, 14.0));
        let expected = matrix.transform_point3(point + deformation.vectors()[at].as_dvec3());
        assert!((point + both.vectors()[at].as_dvec3() - expected).length() < 1e-5);
    }
}
