//! Loose pieces of a label, smaller than what counts as a component, go to what is around them.
//!
//! # Method
//! A tip of tissue between two voxels can keep a few elements of the lattice while the elements that joined them to the rest
//! went to another label. For each such piece (elements of one label connected through faces, fewer than
//! `SMALLEST_COMPONENT` voxel centres inside):
//! 1. Every component of the image (through faces) with a voxel in the piece must have a voxel in another piece of the label:
//!    pieces that stand for a component of their own stay. What the image border has cut may hold no voxel centre any more: such
//!    a piece stands for the components whose voxels it touches, where no other piece holds or touches them.
//! 2. A piece stays too where it holds a voxel that is far from every voxel that other pieces of its label hold, as the end of
//!    a thread one voxel thick: without it that part of the tissue would have no mesh near it. Not where sub-meshes are to be
//!    manifold and of as many components as the image has.
//! 3. The piece takes the label behind most of its faces, one that makes no vertex pinch and joins no pieces of its own if there is
//!    one.
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

use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::tetrahedron::{contains, volume6};
use crate::image::connected_components::{Components, Connectivity, Members};
use crate::image::label_image::LabelImage;
use crate::image::voxel_blocks::{box_of, touched_box};
use crate::index::Label;
use crate::lattice::border_clipping::Clipping;
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::face_adjacency::{OUTSIDE, neighbors_of};
use crate::lattice::interface_topology::InterfaceTopology;
use crate::lattice::mesh_regions::{numbers_in, regions_of};

/// A component of fewer voxels may be lost, and a loose piece of as many is told rather than lost.
const SMALLEST_COMPONENT: usize = 8;

/// Pieces of more than this many voxels' volume hold `SMALLEST_COMPONENT` voxel centres, and are not looked at.
const LARGEST_VOLUME: f64 = 24.0;

/// How far a voxel of a piece is from every other that is held where the piece stays, in voxel diagonals. What other pieces reach
/// ends a little beyond their voxels, and smoothing shortens tips: the mesh is to be within two diagonals of the tissue.
const FAR: f64 = 1.5;

/// Elements per parallel work item.
const SWEPT_CHUNK: usize = 4096;

/// Voxels along a block in which elements are looked for.
const BLOCK: u32 = 4;

/// Where voxel centres are taken to lie, off any face of the lattice, in voxels.
const OFF_CENTER: DVec3 = DVec3::new(1.0e-6, 1.37e-6, 1.91e-6);

/// What becomes of loose pieces far from the rest of their label.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FarPieces {
    /// They stay, for the distance of the mesh to its tissue.
    Stay,
    /// They go, for the number of components.
    Go,
}

/// Relabels the loose pieces of a mesh before it is smoothed; returns how many.
///
/// # Errors
/// Those of [`neighbors_of`].
pub fn relabel_loose_pieces(
    mesh: &mut CandidateMesh,
    neighbors: &[[u32; 4]],
    image: &LabelImage,
    far: FarPieces,
    context: &RunContext,
) -> Result<usize> {
    let regions = regions_of(&mesh.tet_labels, neighbors, context)?;
    let pieces = small_pieces(mesh, &regions, image);
    if pieces.is_empty() {
        return Ok(0);
    }
    let components = Components::new(image, Connectivity::Face, Members::Foreground, context)?;
    let inside = VoxelsInside { image, components: &components };
    let pieces: Vec<Piece> = pieces.into_iter().map(|(label, tets)| Piece::new(mesh, &inside, *label, tets)).collect();
    let mut left = Left::new(mesh, &inside, &pieces, image.label_count(), context)?;
    let may_go = |left: &Left, piece: &Piece| piece.held.len() < SMALLEST_COMPONENT && left.is_enough_without(piece);
    let candidates = pieces.iter().filter(|piece| may_go(&left, piece));
    let sought: Vec<Held> =
        candidates.flat_map(|piece| &piece.held).filter(|_| far == FarPieces::Stay).copied().collect();
    let mut reached = Reached::around(mesh, &inside, &sought);
    context.check()?;
    let mut loose: Vec<&[u32]> = Vec::new();
    for piece in pieces {
        if may_go(&left, &piece) && (far == FarPieces::Go || reached.is_enough_without(&inside, &piece.held)) {
            left.take(&piece);
            reached.take(&piece.held);
            loose.push(piece.tets);
        }
    }
    if !loose.is_empty() {
        relabel(mesh, &loose, &regions, context)?;
    }
    Ok(loose.len())
}

/// Those of some regions that have little volume and no fixed vertices, by size.
fn small_pieces<'a>(
    mesh: &CandidateMesh,
    regions: &'a [(Label, Vec<u32>)],
    image: &LabelImage,
) -> Vec<&'a (Label, Vec<u32>)> {
    let voxel = image.grid().spacing().to_array().into_iter().product::<f64>();
    let volume = |t: &u32| volume6(mesh.tets[*t as usize].map(|v| mesh.points[v.index()])) / 6.0;
    let is_small = |(_, piece): &&(Label, Vec<u32>)| {
        let mut left = LARGEST_VOLUME * voxel;
        piece.iter().all(|t| {
            left -= volume(t);
            left > 0.0 && !mesh.tets[*t as usize].iter().any(|v| mesh.fixed.contains(v))
        })
    };
    let mut pieces: Vec<&(Label, Vec<u32>)> = regions.iter().filter(is_small).collect();
    pieces.sort_by_key(|(_, piece)| piece.len());
    pieces
}

/// A small piece of a label and what it has of the tissue.
struct Piece<'a> {
    label: Label,
    tets: &'a [u32],
    /// The voxels whose centres it holds.
    held: Vec<Held>,
    /// Where it holds none, the components of the voxels that it touches.
    touched: Vec<u32>,
}

impl<'a> Piece<'a> {
    fn new(mesh: &CandidateMesh, inside: &VoxelsInside, label: Label, tets: &'a [u32]) -> Self {
        let held: Vec<Held> = tets.iter().flat_map(|t| inside.of(mesh, *t)).collect();
        let mut touched = Vec::new();
        if held.is_empty() {
            touched.extend(tets.iter().flat_map(|t| inside.touched_by(mesh, *t)));
            touched.sort_unstable();
            touched.dedup();
        }
        Self { label, tets, held, touched }
    }
}

/// What the pieces that stay have.
struct Left {
    /// Elements of each label.
    elements: Vec<usize>,
    /// Voxel centres of each component in elements of its label, for the components of small pieces.
    voxels: FxHashMap<u32, usize>,
    /// Pieces without voxel centres that touch a component.
    touching: FxHashMap<u32, usize>,
}

impl Left {
    /// What all pieces have, the small ones among them.
    fn new(
        mesh: &CandidateMesh,
        inside: &VoxelsInside,
        pieces: &[Piece],
        labels: usize,
        context: &RunContext,
    ) -> Result<Self> {
        let mut elements = vec![0; labels];
        mesh.tet_labels.iter().for_each(|l| elements[l.index()] += 1);
        let of_piece = |piece: &Piece| piece.held.iter().map(|h| h.component).collect::<Vec<u32>>();
        let sought: FxHashSet<u32> =
            pieces.iter().flat_map(|piece| [of_piece(piece), piece.touched.clone()].concat()).collect();
        let mut is_sought = vec![false; labels];
        let with_tissue = pieces.iter().filter(|piece| !(piece.held.is_empty() && piece.touched.is_empty()));
        with_tissue.for_each(|piece| is_sought[piece.label.index()] = true);
        let mut touching: FxHashMap<u32, usize> = FxHashMap::default();
        pieces.iter().flat_map(|piece| &piece.touched).for_each(|c| *touching.entry(*c).or_default() += 1);
        let add = |mut voxels: FxHashMap<u32, usize>, t: u32| {
            let found = inside.of(mesh, t).into_iter().map(|h| h.component).filter(|c| sought.contains(c));
            found.for_each(|c| *voxels.entry(c).or_default() += 1);
            voxels
        };
        let sum = |mut l: FxHashMap<u32, usize>, r: FxHashMap<u32, usize>| {
            r.into_iter().for_each(|(c, count)| *l.entry(c).or_default() += count);
            l
        };
        let tets = (0..mesh.tets.len() as u32).into_par_iter().with_min_len(SWEPT_CHUNK);
        let tets = context.until_cancelled(tets).filter(|t| is_sought[mesh.tet_labels[*t as usize].index()]);
        // Whole numbers: the sums do not depend on the order.
        let voxels = tets.fold(FxHashMap::default, add).reduce(FxHashMap::default, sum);
        context.check()?;
        Ok(Self { elements, voxels, touching })
    }

    /// Whether the label keeps an element without a piece, and each component that the piece stands for a voxel elsewhere.
    fn is_enough_without(&self, piece: &Piece) -> bool {
        let in_piece = |component: u32| piece.held.iter().filter(|h| h.component == component).count();
        let count = |of: &FxHashMap<u32, usize>, component: u32| of.get(&component).copied().unwrap_or(0);
        self.elements[piece.label.index()] > piece.tets.len()
            && piece.held.iter().all(|h| count(&self.voxels, h.component) > in_piece(h.component))
            && piece.touched.iter().all(|c| count(&self.voxels, *c) > 0 || count(&self.touching, *c) > 1)
    }

    /// A piece goes.
    fn take(&mut self, piece: &Piece) {
        self.elements[piece.label.index()] -= piece.tets.len();
        piece.held.iter().for_each(|h| *self.voxels.entry(h.component).or_insert(1) -= 1);
        piece.touched.iter().for_each(|c| *self.touching.entry(*c).or_insert(1) -= 1);
    }
}

/// The voxels near those of some pieces that elements of their own labels hold.
struct Reached(FxHashSet<[u32; 3]>);

impl Reached {
    /// Those near `sought`.
    fn around(mesh: &CandidateMesh, inside: &VoxelsInside, sought: &[Held]) -> Self {
        let near: FxHashSet<[u32; 3]> = sought.iter().flat_map(|h| inside.near(h.voxel)).collect();
        if near.is_empty() {
            return Self(near);
        }
        // Few elements have anything to do with them: those whose box has a part in a block of voxels with one of them.
        let blocks: FxHashSet<[u32; 3]> = near.iter().map(|v| v.map(|c| c / BLOCK)).collect();
        let tets = (0..mesh.tets.len() as u32).into_par_iter().with_min_len(SWEPT_CHUNK);
        let is_near = |t: &u32| {
            let Some((_, [low, high])) = inside.voxel_box(mesh, *t) else { return false };
            let [x, y, z] = std::array::from_fn(|d| low[d] / BLOCK..=high[d] / BLOCK);
            x.into_iter().any(|x| y.clone().any(|y| z.clone().any(|z| blocks.contains(&[x, y, z]))))
        };
        let held = tets.filter(is_near).flat_map_iter(|t| inside.of(mesh, t)).map(|h| h.voxel);
        Self(held.filter(|v| near.contains(v)).collect())
    }

    /// Whether other pieces hold a voxel of the label near each of a piece.
    fn is_enough_without(&self, inside: &VoxelsInside, held: &[Held]) -> bool {
        let is_own = |v: &[u32; 3]| held.iter().any(|h| h.voxel == *v);
        held.iter().all(|h| inside.near(h.voxel).any(|v| self.0.contains(&v) && !is_own(&v)))
    }

    /// A piece goes.
    fn take(&mut self, held: &[Held]) {
        held.iter().for_each(|h| {
            self.0.remove(&h.voxel);
        });
    }
}

/// A voxel whose centre lies in an element of its label, and its component of the image.
#[derive(Debug, Clone, Copy)]
struct Held {
    component: u32,
    voxel: [u32; 3],
}

/// Which voxel centres lie in an element.
struct VoxelsInside<'a> {
    image: &'a LabelImage,
    components: &'a Components,
}

impl VoxelsInside<'_> {
    /// The corners of an element in voxels, and the first and last voxel whose centres its box holds.
    fn voxel_box(&self, mesh: &CandidateMesh, tet: u32) -> Option<([DVec3; 4], [[u32; 3]; 2])> {
        let grid = self.image.grid();
        let corners = mesh.tets[tet as usize].map(|v| mesh.points[v.index()] / grid.spacing() - OFF_CENTER);
        let low = corners.into_iter().fold(DVec3::INFINITY, DVec3::min).ceil().max(DVec3::ZERO);
        let last = DVec3::from_array(grid.size().map(|n| n as f64 - 1.0));
        let high = corners.into_iter().fold(DVec3::NEG_INFINITY, DVec3::max).floor().min(last);
        low.cmple(high).all().then(|| (corners, [low, high].map(|v| v.as_uvec3().to_array())))
    }

    /// The components of the voxels of its own label that the box of an element touches.
    fn touched_by(&self, mesh: &CandidateMesh, tet: u32) -> Vec<u32> {
        let label = mesh.tet_labels[tet as usize];
        let [low, high] = touched_box(&mesh.tets[tet as usize].map(|v| mesh.points[v.index()]), self.image, 0.0);
        let voxels = box_of(low, high).map(|voxel| voxel.map(|v| v as usize));
        let own = voxels.filter(|[i, j, k]| self.image.at(*i, *j, *k) == label);
        own.filter_map(|[i, j, k]| self.components.component_at(i, j, k)).collect()
    }

    /// The voxels of its own label in an element.
    fn of(&self, mesh: &CandidateMesh, tet: u32) -> Vec<Held> {
        let label = mesh.tet_labels[tet as usize];
        let mut found = Vec::new();
        let Some((corners, [low, high])) = self.voxel_box(mesh, tet) else { return found };
        for k in low[2]..=high[2] {
            for j in low[1]..=high[1] {
                for i in low[0]..=high[0] {
                    let [x, y, z] = [i, j, k].map(|v| v as usize);
                    let center = DVec3::new(f64::from(i), f64::from(j), f64::from(k));
                    if self.image.at(x, y, z) == label && contains(corners, center) {
                        let component = self.components.component_at(x, y, z);
                        found.extend(component.map(|component| Held { component, voxel: [i, j, k] }));
                    }
                }
            }
        }
        found
    }

    /// The voxels of the label of a voxel that are not far from it, with itself.
    fn near(&self, voxel: [u32; 3]) -> impl Iterator<Item = [u32; 3]> {
        let grid = self.image.grid();
        let reach = FAR * grid.spacing().length();
        let steps = (reach / grid.spacing()).as_uvec3().to_array();
        let size = grid.size();
        let range = move |d: usize| voxel[d].saturating_sub(steps[d])..=(voxel[d] + steps[d]).min(size[d] as u32 - 1);
        let at = |[i, j, k]: [u32; 3]| self.image.at(i as usize, j as usize, k as usize);
        let label = at(voxel);
        let center = |v: [u32; 3]| DVec3::from_array(v.map(f64::from)) * grid.spacing();
        let [low, high] = [[0, 1, 2].map(|d| *range(d).start()), [0, 1, 2].map(|d| *range(d).end())];
        box_of(low, high).filter(move |v| at(*v) == label && center(*v).distance(center(voxel)) <= reach)
    }
}

/// Gives loose pieces other labels; `regions` are the tets of the mesh of each label that are connected through faces.
fn relabel(
    mesh: &mut CandidateMesh,
    loose: &[&[u32]],
    regions: &[(Label, Vec<u32>)],
    context: &RunContext,
) -> Result<()> {
    let mut work = Clipping::new(mesh);
    // Whether a surface pinches at a vertex of a piece depends on the elements there: the others are left out.
    let mut is_near = vec![false; work.points.len()];
    let tets_of_pieces = loose.iter().copied().flatten().map(|t| work.tets[*t as usize]);
    tets_of_pieces.flatten().for_each(|v| is_near[v as usize] = true);
    let numbers: Vec<u32> = (0..work.tets.len() as u32)
        .into_par_iter()
        .with_min_len(SWEPT_CHUNK)
        .filter(|t| work.tets[*t as usize].iter().any(|v| is_near[*v as usize]))
        .collect();
    let tets: Vec<[u32; 4]> = numbers.iter().map(|t| work.tets[*t as usize]).collect();
    let mut labels: Vec<Label> = numbers.iter().map(|t| work.labels[*t as usize]).collect();
    // The scaffold, which comes after the tets of the mesh, is in none.
    let of_all = numbers_in(regions, work.tets.len());
    let mut region_of: Vec<u32> = numbers.iter().map(|t| of_all[*t as usize]).collect();
    let neighbors = neighbors_of(&tets, work.points.len(), context)?;
    let topology = InterfaceTopology::new(&tets, &neighbors, work.points.len(), context)?;
    for piece in loose {
        let piece: Vec<u32> = piece.iter().map(|t| numbers.partition_point(|n| n < t) as u32).collect();
        let own = labels[piece[0] as usize];
        // The label behind each face, and its region there.
        let mut around: Vec<(Label, u32)> = Vec::new();
        for near in piece.iter().flat_map(|t| neighbors[*t as usize]).filter(|near| *near != OUTSIDE) {
            let label = labels[near as usize];
            if label != own {
                around.push((label, region_of[near as usize]));
            }
        }
        around.sort_unstable();
        let runs = around.chunk_by(|a, b| a.0 == b.0);
        let mut cost = |run: &[(Label, u32)]| {
            let joined = run.chunk_by(|a, b| a == b).count() as i64 - 1;
            (topology.gain(&piece, run[0].0, &mut labels).max(0) + joined, std::cmp::Reverse(run.len()))
        };
        let best = runs.min_by_key(|run| (cost(run), run[0].0));
        // Nothing beside it: the piece is alone in a lattice that ends with it.
        let (label, region) = best.map_or((Label::BACKGROUND, u32::MAX), |run| run[0]);
        for t in &piece {
            region_of[*t as usize] = region;
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

    /// A column of three prisms, the lower and the upper one of label 1, the upper one from a height on; the middle one is
    /// background.
    fn column(upper: f64) -> CandidateMesh {
        let corner = |x: f64, y: f64, z: f64| DVec3::new(x, y, z);
        let mut points = Vec::new();
        // A stack of triangles, three tets to a prism.
        for z in [0.6, 1.6, upper, upper + 1.0] {
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
        pieces_left_of(column(2.6), image, FarPieces::Stay)
    }

    /// How many loose pieces went, and how many pieces are left.
    fn pieces_left_of(mut mesh: CandidateMesh, image: &LabelImage, far: FarPieces) -> (usize, usize) {
        let context = RunContext::with_threads(1).unwrap();
        let neighbors = neighbors_of(bytemuck::cast_slice(&mesh.tets), mesh.points.len(), &context).unwrap();
        let loose = relabel_loose_pieces(&mut mesh, &neighbors, image, far, &context).unwrap();
        let neighbors = neighbors_of(bytemuck::cast_slice(&mesh.tets), mesh.points.len(), &context).unwrap();
        (loose, regions_of(&mesh.tet_labels, &neighbors, &context).unwrap().len())
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

    #[test]
    fn a_piece_without_a_voxel_centre_stays_where_nothing_else_stands_for_a_voxel_that_it_touches() {
        // Voxel (2, 2, 3) lies beside the upper prism, which touches it and holds none.
        let alone = voxel_image(6, |p| u16::from(p == DVec3::new(2.0, 2.0, 3.0) || p == DVec3::ONE));
        assert_eq!(pieces_left(&alone), (0, 2));
        // Joined to voxel (1, 2, 1), which the lower prism holds.
        let joined = voxel_image(6, |p| {
            u16::from(p.x == 2.0 && p.y == 2.0 && (1.0..=3.0).contains(&p.z) || p == DVec3::new(1.0, 2.0, 1.0))
        });
        assert_eq!(pieces_left(&joined), (1, 1));
    }

    #[test]
    fn a_piece_goes_where_it_joins_nothing_though_more_of_its_faces_are_elsewhere() {
        // The middle prism is of label 2, between two of label 1; a tet of the scaffold stands on one of its sides. Label 2 has a voxel
        // elsewhere.
        let mut mesh = column(2.6);
        let [a, b, c] = [4, 6, 7].map(VertexId);
        mesh.tets.append(&mut mesh.scaffold.tets);
        mesh.scaffold = Scaffold { points: vec![DVec3::new(1.5, -0.5, 2.1)], tets: vec![[a, b, c, VertexId(16)]] };
        let corners = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z].map(|p| DVec3::splat(4.8) + p);
        mesh.tets.push([12, 13, 14, 15].map(VertexId));
        mesh.points.extend(corners);
        mesh.tet_labels.extend([Label(2); 4]);
        let image = voxel_image(7, |p| match (p.x, p.y, p.z) {
            (1.0, 1.0, 1.0 | 3.0) => 1,
            (5.0, 5.0, 5.0) => 2,
            _ => 0,
        });
        assert_eq!(pieces_left_of(mesh, &image, FarPieces::Go), (1, 3));
    }

    #[test]
    fn the_end_of_a_thread_stays_unless_components_count() {
        // Voxel (1, 1, 1) is in the lower prism, (1, 1, 5) or, within reach, (1, 1, 3) in the upper one.
        for (height, far, left) in
            [(5.0, FarPieces::Stay, (0, 2)), (5.0, FarPieces::Go, (1, 1)), (3.0, FarPieces::Stay, (1, 1))]
        {
            let thread = voxel_image(8, |p| u16::from(p.x == 1.0 && p.y == 1.0 && p.z >= 1.0 && p.z <= height));
            assert_eq!(pieces_left_of(column(height - 0.4), &thread, far), left, "{height} {far:?}");
        }
    }
}
