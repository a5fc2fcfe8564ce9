//! Images for the tests of this engine.

use glam::{DMat3, DVec3};

use crate::context::RunContext;
use crate::image::distance_transform::distance_to_other_labels;
use crate::image::grid::Grid;
use crate::image::label_image::LabelImage;
use crate::image::voxel_index::VoxelIndex;
use crate::index::Label;
use crate::lattice::bcc_lattice::{Field, LatticeFrame, PastBorder};
use crate::lattice::centerlines::{Tube, TubeNode};
use crate::lattice::deepest_segments::{BoundaryVoxels, depth_in_segment};
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

/// Distance to the segment between two places, mm.
pub fn segment_distance(p: DVec3, [from, to]: [[f64; 3]; 2]) -> f64 {
    let (from, way) = (DVec3::from(from), DVec3::from(to) - DVec3::from(from));
    p.distance(from + way * ((p - from).dot(way) / way.length_squared()).clamp(0.0, 1.0))
}

/// Distance to a fork of three rods that go from one place to `ends`, mm, negative inside.
pub fn fork_distance(p: DVec3, ends: [[f64; 3]; 3], radius: f64) -> f64 {
    let rods = ends.map(|end| segment_distance(p, [[18.9, 17.4, 18.7], end]) - radius);
    rods.into_iter().fold(f64::INFINITY, f64::min)
}

/// Calls `work` with the coarsest lattice of an image, and a context of one thread.
pub fn with_lattice<T>(image: &LabelImage, spacing: f64, work: impl FnOnce(RedGreenLattice, &RunContext) -> T) -> T {
    let context = RunContext::with_threads(1).unwrap();
    let distance = distance_to_other_labels(image, &context).unwrap();
    let frame = LatticeFrame::new(image, spacing).unwrap();
    work(
        RedGreenLattice::new(frame, Field::new(image, &distance, PastBorder::Background), 1 << 22, &context).unwrap(),
        &context,
    )
}

/// All voxels of a cube, and whether they are inside of something.
pub fn boundary_voxels(size: i32, spacing: DVec3, is_inside: impl Fn(DVec3) -> bool) -> BoundaryVoxels {
    let voxels: Vec<[i32; 3]> = (0..size * size * size).map(|n| [n % size, n / size % size, n / size / size]).collect();
    let place = |at: &[i32; 3]| DVec3::from_array(at.map(f64::from)) * spacing;
    let is_inside = voxels.iter().map(|at| is_inside(place(at))).collect();
    BoundaryVoxels { index: VoxelIndex::new(&voxels), voxels, is_inside, spacing }
}

/// A tube of nodes with their radii.
pub fn tube(nodes: &[([f64; 3], f64)]) -> Tube {
    Tube { nodes: nodes.iter().map(|(at, r)| TubeNode { center: DVec3::from(*at), radius: *r }).collect() }
}

/// Depth of a point in the tube that it is deepest in.
pub fn tubes_depth(tubes: &[Tube], point: DVec3) -> f64 {
    let of_tube =
        |t: &Tube| (0..t.segment_count()).map(|n| depth_in_segment(point, &t.segment(n)).0).collect::<Vec<_>>();
    tubes.iter().flat_map(of_tube).fold(f64::NEG_INFINITY, f64::max)
}
