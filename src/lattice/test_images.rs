//! Images for the tests of this engine.

use glam::{DMat3, DVec3};

use crate::context::RunContext;
use crate::image::distance_transform::distance_to_other_labels;
use crate::image::grid::Grid;
use crate::image::label_image::LabelImage;
use crate::index::Label;
use crate::lattice::bcc_lattice::{Field, LatticeFrame};
use crate::lattice::red_green::RedGreenLattice;

/// An image of `n^3` voxels of 1 mm labelled by a function of the voxel centre.
pub fn voxel_image(n: usize, label: impl Fn(DVec3) -> u16) -> LabelImage {
    spaced_image([n; 3], DVec3::ONE, label)
}

/// An image of voxels of any spacing (mm) labelled by a function of the voxel centre (mm).
pub fn spaced_image(size: [usize; 3], spacing: DVec3, label: impl Fn(DVec3) -> u16) -> LabelImage {
    let grid = Grid::new(size, spacing, DVec3::ZERO, DMat3::IDENTITY).unwrap();
    let [nx, ny, nz] = size;
    let at = |i: usize| DVec3::new((i % nx) as f64, (i / nx % ny) as f64, (i / nx / ny) as f64) * spacing;
    let voxels: Vec<Label> = (0..nx * ny * nz).map(|i| Label(label(at(i)))).collect();
    let labels = i32::from(voxels.iter().map(|l| l.0).max().unwrap());
    LabelImage::new(grid, voxels, (0..=labels).collect()).unwrap()
}

/// Distance to a fork of three rods that go from one place to `ends`, mm, negative inside.
pub fn fork_distance(p: DVec3, ends: [[f64; 3]; 3], radius: f64) -> f64 {
    let fork = DVec3::new(18.9, 17.4, 18.7);
    let along = |end: DVec3| {
        let (way, q) = (end - fork, p - fork);
        (q - way * (q.dot(way) / way.length_squared()).clamp(0.0, 1.0)).length() - radius
    };
    ends.map(|end| along(DVec3::from(end))).into_iter().fold(f64::INFINITY, f64::min)
}

/// Calls `work` with the coarsest lattice of an image, and a context of one thread.
pub fn with_lattice<T>(image: &LabelImage, spacing: f64, work: impl FnOnce(RedGreenLattice, &RunContext) -> T) -> T {
    let context = RunContext::with_threads(1).unwrap();
    let distance = distance_to_other_labels(image, &context).unwrap();
    let frame = LatticeFrame::new(image, spacing).unwrap();
    work(RedGreenLattice::new(frame, Field::new(image, &distance), 1 << 22, &context).unwrap(), &context)
}
