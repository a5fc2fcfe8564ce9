//! Images for the tests of this engine.

use glam::{DMat3, DVec3};

use crate::context::RunContext;
use crate::image::connected_components::{Components, Connectivity, Members};
use crate::image::distance_transform::distance_to_other_labels;
use crate::image::grid::Grid;
use crate::image::label_image::LabelImage;
use crate::image::voxel_index::VoxelIndex;
use crate::index::Label;
use crate::lattice::bcc_lattice::{Field, LatticeFrame, PastBorder};
use crate::lattice::centerlines::{Tube, TubeNode};
use crate::lattice::deepest_segments::{BoundaryVoxels, depth_in_segment};
use crate::lattice::interface_topology::InterfaceTopology;
use crate::lattice::red_green::{Elements, RedGreenLattice};

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

/// Three labels in disorder that fill an image.
pub fn foam(n: usize) -> LabelImage {
    let wave =
        |p: DVec3, k: f64| (0.66 * p.x + 1.3 * k).sin() + (0.88 * p.y + 2.1 * k).sin() + (0.77 * p.z + 0.7 * k).sin();
    voxel_image(n, |p| {
        let waves = [0.0, 1.0, 2.0].map(|k| wave(p * (1.0 + 0.13 * k), k));
        1 + (0..3).max_by(|a, b| waves[*a].total_cmp(&waves[*b])).unwrap_or(0) as u16
    })
}

/// The components of all voxels of an image, the background too, through faces, edges and vertices.
pub fn components_of(image: &LabelImage, context: &RunContext) -> Components {
    Components::new(image, Connectivity::Vertex, Members::All, context).unwrap()
}

/// What meets at the vertices of elements.
pub fn topology_of<'a>(
    lattice: &RedGreenLattice,
    elements: &'a Elements,
    neighbors: &'a [[u32; 4]],
    context: &RunContext,
) -> InterfaceTopology<'a> {
    InterfaceTopology::new(&elements.tets, neighbors, lattice.vertices.positions.len(), context).unwrap()
}

/// Calls `work` with the coarsest lattice of an image, and a context of one thread.
pub fn with_lattice<T>(image: &LabelImage, spacing: f64, work: impl FnOnce(RedGreenLattice, &RunContext) -> T) -> T {
    with_lattice_past(PastBorder::Background, image, spacing, work)
}

/// As [`with_lattice`], of an image that is taken so past its border.
pub fn with_lattice_past<T>(
    border: PastBorder,
    image: &LabelImage,
    spacing: f64,
    work: impl FnOnce(RedGreenLattice, &RunContext) -> T,
) -> T {
    let context = RunContext::with_threads(1).unwrap();
    let distance = distance_to_other_labels(image, &context).unwrap();
    let frame = LatticeFrame::new(image, spacing).unwrap();
    let field = Field::new(image, &distance, border);
    work(RedGreenLattice::new(frame, field, 1 << 22, &context).unwrap(), &context)
}

/// The simplices of a label's tets of which all corners pass, these in order.
fn simplices_where(tets: &[[u32; 4]], labels: &[Label], own: u16, passes: impl Fn(u32) -> bool) -> Vec<Vec<u32>> {
    let mut simplices: Vec<Vec<u32>> = Vec::new();
    for (tet, _) in tets.iter().zip(labels).filter(|(_, label)| label.0 == own) {
        let corners_of = |set: u32| (0..4).filter(|at| set >> at & 1 == 1).map(|at| tet[at]).collect::<Vec<u32>>();
        simplices.extend((1..16).map(corners_of).filter(|corners| corners.iter().all(|v| passes(*v))));
    }
    simplices.iter_mut().for_each(|corners| corners.sort_unstable());
    simplices.sort_unstable();
    simplices.dedup();
    simplices
}

/// Euler number of the simplices of some tets of which all corners pass, for each label from 1 on.
pub fn euler_numbers_of(tets: &[[u32; 4]], labels: &[Label], passes: impl Fn(u32) -> bool) -> Vec<i64> {
    let last = labels.iter().map(|label| label.0).max().unwrap_or(0);
    let simplices = (1..=last).map(|own| simplices_where(tets, labels, own, &passes));
    simplices.map(|simplices| simplices.iter().map(|s| if s.len() % 2 == 1 { 1 } else { -1 }).sum()).collect()
}

/// As [`euler_numbers_of`], without vertices that stand alone.
pub fn euler_numbers_where(tets: &[[u32; 4]], labels: &[Label], passes: impl Fn(u32) -> bool) -> Vec<i64> {
    let mut numbers = euler_numbers_of(tets, labels, &passes);
    for (number, own) in numbers.iter_mut().zip(1..) {
        let simplices = simplices_where(tets, labels, own, &passes);
        let edges: Vec<u32> = simplices.iter().filter(|corners| corners.len() == 2).flatten().copied().collect();
        *number -= simplices.iter().filter(|corners| corners.len() == 1 && !edges.contains(&corners[0])).count() as i64;
    }
    numbers
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
