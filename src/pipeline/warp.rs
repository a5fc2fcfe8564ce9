//! Carries other data of the same patient through a displacement field: scans, labels, points, meshes.
//!
//! # Method
//! A field maps points of the fixed scan to points of the moving scan. Images of the moving space are pulled onto a grid of the
//! fixed space; points of the moving space (tracts, targets, meshes) go to the fixed space by Newton's method on the field.
//!
//! # Cost
//! One pass, parallel; same result for any number of threads.

use glam::{DMat4, DVec3};

use crate::error::Result;
use crate::image::grid::Grid;
use crate::image::interpolation::nearest_offset;
use crate::image::resample::map_voxels;
use crate::image::scalar_image::ScalarImage;
use crate::image::vector_image::VectorImage;
use crate::image::voxel_image::{VoxelData, VoxelImage};
use crate::image::warp::{warp_point, warp_scan};
use crate::registration::displacement_field::invert_point;

/// How values between voxels are found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interpolation {
    /// Trilinear: scans and maps; the result is in single precision.
    Linear,
    /// Nearest voxel: labels; the type of the values is kept.
    Nearest,
}

/// Which way points go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// From the fixed scan to the moving scan: as the field says.
    FixedToMoving,
    /// From the moving scan to the fixed scan: the field inverted.
    MovingToFixed,
}

/// An image of the moving space on `grid` of the fixed space, or on the field's own grid.
///
/// # Errors
/// [`crate::Error::InvalidInput`] for a field without three components or an image with several components.
pub fn warp_image(
    image: &VoxelImage,
    field: &VoxelImage,
    grid: Option<&Grid>,
    interpolation: Interpolation,
) -> Result<VoxelImage> {
    let field = VectorImage::from_voxel_image(field)?;
    let grid = *grid.unwrap_or(field.grid());
    if interpolation == Interpolation::Linear {
        let (scan, _) = ScalarImage::from_voxel_image(image)?;
        return Ok(warp_scan(&scan, &field, &grid)?.into_voxel_image());
    }
    let offsets: Vec<Option<usize>> = map_voxels(&grid, |point, _| {
        nearest_offset(image.grid.size(), image.grid.world_to_index(warp_point(&field, point)))
    });
    let data = pick(&image.data, image.components, &offsets);
    VoxelImage::new(grid, image.components, data)
}

/// The values at `offsets`; zero where there is none.
fn pick(data: &VoxelData, components: usize, offsets: &[Option<usize>]) -> VoxelData {
    fn of<T: Copy + Default>(values: &[T], components: usize, offsets: &[Option<usize>]) -> Vec<T> {
        let at = |offset: &Option<usize>, c: usize| offset.map_or(T::default(), |o| values[o * components + c]);
        offsets.iter().flat_map(|o| (0..components).map(move |c| at(o, c))).collect()
    }
    match data {
        VoxelData::U8(v) => VoxelData::U8(of(v, components, offsets)),
        VoxelData::I8(v) => VoxelData::I8(of(v, components, offsets)),
        VoxelData::U16(v) => VoxelData::U16(of(v, components, offsets)),
        VoxelData::I16(v) => VoxelData::I16(of(v, components, offsets)),
        VoxelData::U32(v) => VoxelData::U32(of(v, components, offsets)),
        VoxelData::I32(v) => VoxelData::I32(of(v, components, offsets)),
        VoxelData::U64(v) => VoxelData::U64(of(v, components, offsets)),
        VoxelData::I64(v) => VoxelData::I64(of(v, components, offsets)),
        VoxelData::F32(v) => VoxelData::F32(of(v, components, offsets)),
        VoxelData::F64(v) => VoxelData::F64(of(v, components, offsets)),
    }
}

/// Moves points through the field, LPS mm.
///
/// # Errors
/// As [`VectorImage::from_voxel_image`].
pub fn warp_points(points: &mut [DVec3], field: &VoxelImage, direction: Direction) -> Result<()> {
    let field = VectorImage::from_voxel_image(field)?;
    let start = mean_shift(&field);
    for point in points {
        *point = match direction {
            Direction::FixedToMoving => warp_point(&field, *point),
            Direction::MovingToFixed => invert_point(&field, *point, start.transform_point3(*point)),
        };
    }
    Ok(())
}

/// The mean displacement turned back: where the search for a fixed point begins.
fn mean_shift(field: &VectorImage) -> DMat4 {
    let sum: DVec3 = field.vectors().iter().map(|v| v.as_dvec3()).sum();
    DMat4::from_translation(-sum / field.vectors().len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat3;

    #[test]
    fn images_and_points_move_by_the_field_and_back() {
        let grid = Grid::new([12, 10, 8], DVec3::splat(2.0), DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let vectors: Vec<f32> = (0..960).flat_map(|_| [4.0, 0.0, -2.0]).collect();
        let field = VoxelImage::new(grid, 3, VoxelData::F32(vectors)).unwrap();
        let labels: Vec<u16> = (0..960).map(|at| (at % 12) as u16).collect();
        let image = VoxelImage::new(grid, 1, VoxelData::U16(labels)).unwrap();
        let warped = warp_image(&image, &field, None, Interpolation::Nearest).unwrap();
        let VoxelData::U16(values) = &warped.data else { panic!("the type is kept") };
        assert_eq!(values[grid.offset(3, 4, 5)], 5);
        assert_eq!(values[grid.offset(11, 4, 5)], 0);
        let mut points = vec![DVec3::new(5.0, 6.0, 7.0)];
        warp_points(&mut points, &field, Direction::FixedToMoving).unwrap();
        assert_eq!(points[0], DVec3::new(9.0, 6.0, 5.0));
        warp_points(&mut points, &field, Direction::MovingToFixed).unwrap();
        assert!((points[0] - DVec3::new(5.0, 6.0, 7.0)).length() < 2e-3);
    }
}
