//! Loose pieces of a label, smaller than what counts as a component, go to what is around them.
//!
//! # Method
//! A tip of tissue between two voxels can keep a few elements of the lattice while the elements that joined them to the rest
//! went to another label. For each such piece (elements of one label connected through faces, fewer than
//! `SMALLEST_COMPONENT` voxel centres inside):
//! 1. Every component of the image (through faces) with a voxel in the piece must have a voxel in another piece of the label:
//!    pieces that stand for a component of their own stay.
//! 2. The piece takes the label behind most of its faces, one that makes no vertex pinch if there is one.
//!
//! Smaller pieces are first, so that of several pieces of a small component the largest stays.
//!
//! # Source
//! [Drakopoulos2017] 2.3.3, disconnected mesh regions.
//!
//! # Differences
//! There a share of the label's volume decides, and the lattice is refined; here the image does, in every mesh that is
//! smoothed: a loose piece of a few elements has no tissue that a finer lattice would join to it within a voxel.
//!
//! # Cost
//! Two sweeps over the elements, one of them parallel; the rest by the number of small pieces.

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use crate::error::Result;
use crate::geometry::tetrahedron::volume6;
use crate::image::connected_components::{Components, Connectivity, Members};
use crate::image::label_image::LabelImage;
use crate::index::Label;
use crate::lattice::border_clipping::Clipping;
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::face_adjacency::{OUTSIDE, neighbors_of};
use crate::lattice::interface_topology::InterfaceTopology;
use crate::lattice::mesh_regions::regions_of;

/// A component of fewer voxels may be lost, and a loose piece of as many is told rather than lost.
const SMALLEST_COMPONENT: usize = 8;

/// Pieces of more than this many voxels' volume hold `SMALLEST_COMPONENT` voxel centres, and are not looked at.
const LARGEST_VOLUME: f64 = 24.0;

/// Elements per parallel work item.
const SWEPT_CHUNK: usize = 4096;

/// Where voxel centres are taken to lie, off any face of the lattice, in voxels.
const OFF_CENTER: DVec3 = DVec3::new(1.0e-6, 1.37e-6, 1.91e-6);

/// Relabels the loose pieces of a mesh before it is smoothed; returns how many.
///
/// # Errors
/// Those of [`neighbors_of`].
pub fn relabel_loose_pieces(mesh: &mut CandidateMesh, neighbors: &[[u32; 4]], image: &LabelImage) -> Result<usize> {
    let pieces = small_pieces(mesh, neighbors, image);
    if pieces.is_empty() {
        return Ok(0);
    }
    let components = Components::new(image, Connectivity::Face, Members::Foreground);
    let inside = VoxelsInside { image, components: &components };
    let held: Vec<Vec<u32>> =
        pieces.iter().map(|(_, piece)| piece.iter().flat_map(|t| inside.of(mesh, *t)).collect()).collect();
    let mut left = Left::new(mesh, &inside, &pieces, &held, image.label_count());
    let mut loose: Vec<Vec<u32>> = Vec::new();
    for ((label, piece), held) in pieces.into_iter().zip(held) {
        if held.len() < SMALLEST_COMPONENT && left.is_enough_without(label, &piece, &held) {
            left.take(label, &piece, &held);
            loose.push(piece);
        }
    }
    if !loose.is_empty() {
        relabel(mesh, &loose)?;
    }
    Ok(loose.len())
}

/// Pieces of little volume without fixed vertices, by size.
fn small_pieces(mesh: &CandidateMesh, neighbors: &[[u32; 4]], image: &LabelImage) -> Vec<(Label, Vec<u32>)> {
    let voxel = image.grid().spacing().to_array().into_iter().product::<f64>();
    let volume = |t: &u32| volume6(mesh.tets[*t as usize].map(|v| mesh.points[v.index()])) / 6.0;
    let is_small = |(_, piece): &(Label, Vec<u32>)| {
        let mut left = LARGEST_VOLUME * voxel;
        piece.iter().all(|t| {
            left -= volume(t);
            left > 0.0 && !mesh.tets[*t as usize].iter().any(|v| mesh.fixed.contains(v))
        })
    };
    let mut pieces = regions_of(&mesh.tet_labels, neighbors);
    pieces.retain(is_small);
    pieces.sort_by_key(|(_, piece)| piece.len());
    pieces
}

/// What the pieces that stay have.
struct Left {
    /// Elements of each label.
    elements: Vec<usize>,
    /// Voxel centres of each component in elements of its label, for the components that small pieces hold.
    voxels: FxHashMap<u32, usize>,
}

impl Left {
    /// What all pieces have; `held` are the components of the voxels in each small piece.
    fn new(
        mesh: &CandidateMesh,
        inside: &VoxelsInside,
        pieces: &[(Label, Vec<u32>)],
        held: &[Vec<u32>],
        labels: usize,
    ) -> Self {
        let mut elements = vec![0; labels];
        mesh.tet_labels.iter().for_each(|l| elements[l.index()] += 1);
        let sought: FxHashSet<u32> = held.iter().flatten().copied().collect();
        let mut is_sought = vec![false; labels];
        pieces
            .iter()
            .zip(held)
            .filter(|(_, held)| !held.is_empty())
            .for_each(|((l, _), _)| is_sought[l.index()] = true);
        let add = |mut voxels: FxHashMap<u32, usize>, t: u32| {
            let found = inside.of(mesh, t).into_iter().filter(|c| sought.contains(c));
            found.for_each(|c| *voxels.entry(c).or_default() += 1);
            voxels
        };
        let sum = |mut l: FxHashMap<u32, usize>, r: FxHashMap<u32, usize>| {
            r.into_iter().for_each(|(c, count)| *l.entry(c).or_default() += count);
            l
        };
        let tets = (0..mesh.tets.len() as u32).into_par_iter().with_min_len(SWEPT_CHUNK);
        let tets = tets.filter(|t| is_sought[mesh.tet_labels[*t as usize].index()]);
        // Whole numbers: the sums do not depend on the order.
        Self { elements, voxels: tets.fold(FxHashMap::default, add).reduce(FxHashMap::default, sum) }
    }

    /// Whether the label keeps an element without a piece, and each component that the piece holds a voxel elsewhere.
    fn is_enough_without(&self, label: Label, piece: &[u32], held: &[u32]) -> bool {
        let in_piece = |component: &u32| held.iter().filter(|c| *c == component).count();
        self.elements[label.index()] > piece.len()
            && held.iter().all(|c| self.voxels.get(c).is_some_and(|all| *all > in_piece(c)))
    }

    /// A piece goes.
    fn take(&mut self, label: Label, piece: &[u32], held: &[u32]) {
        self.elements[label.index()] -= piece.len();
        held.iter().for_each(|c| *self.voxels.entry(*c).or_insert(1) -= 1);
    }
}

/// Which voxel centres lie in an element.
struct VoxelsInside<'a> {
    image: &'a LabelImage,
    components: &'a Components,
}

impl VoxelsInside<'_> {
    /// The components of the voxels of its own label in an element, one entry for each voxel.
    fn of(&self, mesh: &CandidateMesh, tet: u32) -> Vec<u32> {
        let (grid, label) = (self.image.grid(), mesh.tet_labels[tet as usize]);
        let corners = mesh.tets[tet as usize].map(|v| mesh.points[v.index()] / grid.spacing() - OFF_CENTER);
        let low = corners.into_iter().fold(DVec3::INFINITY, DVec3::min).ceil().max(DVec3::ZERO).as_u64vec3();
        let high = corners.into_iter().fold(DVec3::NEG_INFINITY, DVec3::max).floor();
        let mut found = Vec::new();
        if high.min_element() < 0.0 {
            return found;
        }
        let [ni, nj, nk] = grid.size().map(|n| n as u64 - 1);
        let high = high.as_u64vec3();
        for k in low.z..=high.z.min(nk) {
            for j in low.y..=high.y.min(nj) {
                for i in low.x..=high.x.min(ni) {
                    let [i, j, k] = [i, j, k].map(|v| v as usize);
                    if self.image.at(i, j, k) == label && contains(&corners, DVec3::new(i as f64, j as f64, k as f64)) {
                        found.extend(self.components.component_at(i, j, k));
                    }
                }
            }
        }
        found
    }
}

/// Whether a point lies in a positive tet.
fn contains(corners: &[DVec3; 4], point: DVec3) -> bool {
    (0..4).all(|c| {
        let mut part = *corners;
        part[c] = point;
        volume6(part) >= 0.0
    })
}

fn relabel(mesh: &mut CandidateMesh, loose: &[Vec<u32>]) -> Result<()> {
    let mut work = Clipping::new(mesh);
    // Whether a surface pinches at a vertex of a piece depends on the elements there: the others are left out.
    let mut is_near = vec![false; work.points.len()];
    loose.iter().flatten().for_each(|t| work.tets[*t as usize].iter().for_each(|v| is_near[*v as usize] = true));
    let numbers: Vec<u32> = (0..work.tets.len() as u32)
        .into_par_iter()
        .with_min_len(SWEPT_CHUNK)
        .filter(|t| work.tets[*t as usize].iter().any(|v| is_near[*v as usize]))
        .collect();
    let tets: Vec<[u32; 4]> = numbers.iter().map(|t| work.tets[*t as usize]).collect();
    let mut labels: Vec<Label> = numbers.iter().map(|t| work.labels[*t as usize]).collect();
    let neighbors = neighbors_of(&tets, work.points.len())?;
    let topology = InterfaceTopology::new(&tets, &neighbors, work.points.len());
    for piece in loose {
        let piece: Vec<u32> = piece.iter().map(|t| numbers.partition_point(|n| n < t) as u32).collect();
        let own = labels[piece[0] as usize];
        let mut around: Vec<Label> = Vec::new();
        for near in piece.iter().flat_map(|t| neighbors[*t as usize]).filter(|near| *near != OUTSIDE) {
            let label = labels[near as usize];
            if label != own {
                around.push(label);
            }
        }
        around.sort_unstable();
        let runs = around.chunk_by(|a, b| a == b).map(|run| (run.len(), run[0]));
        let candidates: Vec<(usize, Label)> = runs.collect();
        let cost = |label: Label, labels: &mut Vec<Label>| topology.gain(&piece, label, labels).max(0);
        let best = candidates
            .into_iter()
            .min_by_key(|(faces, label)| (cost(*label, &mut labels), std::cmp::Reverse(*faces), *label));
        // Nothing beside it: the piece is alone in a lattice that ends with it.
        let label = best.map_or(Label::BACKGROUND, |(_, label)| label);
        for t in &piece {
            labels[*t as usize] = label;
            work.labels[numbers[*t as usize] as usize] = label;
            tets[*t as usize].iter().for_each(|v| work.changed[*v as usize] = true);
        }
    }
    work.finish(mesh);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::VertexId;
    use crate::lattice::scaffold::Scaffold;
    use crate::lattice::test_images::voxel_image;

    /// Two tets of a column, one or both of label 1, and a background tet between them and a third one above.
    fn column() -> CandidateMesh {
        let corner = |x: f64, y: f64, z: f64| DVec3::new(x, y, z);
        let mut points = Vec::new();
        // A stack of triangles, three tets to a prism; levels at z = 0, 1, 2, 3.
        for level in 0..4 {
            let z = f64::from(level) + 0.6;
            points.extend([corner(0.5, 0.5, z), corner(2.6, 0.5, z), corner(0.5, 2.6, z)]);
        }
        let prism = |l: u32| {
            let [a, b, c, d, e, f] = [0, 1, 2, 3, 4, 5].map(|v| 3 * l + v);
            [[a, b, c, d], [b, c, d, e], [c, d, e, f]].map(|tet| tet.map(VertexId))
        };
        let tets = [prism(0), prism(2)].concat();
        let scaffold = Scaffold { points: Vec::new(), tets: prism(1).to_vec() };
        let mut mesh =
            CandidateMesh { points, tet_labels: vec![Label(1); 6], tets, scaffold, ..CandidateMesh::default() };
        let orient = |tet: &mut [VertexId; 4]| {
            if volume6(tet.map(|v| mesh.points[v.index()])) < 0.0 {
                tet.swap(2, 3);
            }
        };
        mesh.tets.iter_mut().for_each(orient);
        mesh.scaffold.tets.iter_mut().for_each(orient);
        mesh
    }

    fn pieces_left(image: &LabelImage) -> (usize, usize) {
        let mut mesh = column();
        let neighbors = neighbors_of(bytemuck::cast_slice(&mesh.tets), mesh.points.len()).unwrap();
        let loose = relabel_loose_pieces(&mut mesh, &neighbors, image).unwrap();
        let neighbors = neighbors_of(bytemuck::cast_slice(&mesh.tets), mesh.points.len()).unwrap();
        (loose, regions_of(&mesh.tet_labels, &neighbors).len())
    }

    #[test]
    fn a_piece_goes_where_the_image_is_in_one_piece_and_stays_where_it_is_not() {
        // Voxel (1, 1, 1) is in the lower prism and (1, 1, 3) in the upper one; (1, 1, 2) joins them or does not.
        let column = |joined: bool| {
            voxel_image(6, move |p| {
                let beside = p.x == 1.0 && p.y == 1.0;
                u16::from(beside && (p.z == 1.0 || p.z == 3.0 || joined && p.z == 2.0))
            })
        };
        assert_eq!(pieces_left(&column(true)), (1, 1));
        assert_eq!(pieces_left(&column(false)), (0, 2));
    }

    #[test]
    fn a_piece_without_tissue_goes_and_the_last_one_stays() {
        let above = voxel_image(6, |p| u16::from(p == DVec3::new(1.0, 1.0, 3.0)));
        assert_eq!(pieces_left(&above), (1, 1));
        let aside = voxel_image(6, |p| u16::from(p == DVec3::splat(5.0)));
        assert_eq!(pieces_left(&aside), (1, 1));
    }
}
