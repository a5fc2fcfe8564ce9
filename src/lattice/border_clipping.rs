//! Where the image cuts the tissue the lattice is cut flat, before surfaces are smoothed.
//!
//! # Method
//! The lattice runs past the image border in a zigzag. For each border plane that the mesh reaches:
//! 1. Vertices next to the plane are moved onto it, or away from it ([`border_snapping`](crate::lattice::border_snapping)).
//! 2. Elements that cross what is inside of it and of another plane without a vertex there take labels that keep the topology
//!    ([`border_edges`](crate::lattice::border_edges)).
//! 3. Elements that still cross it are cut along it. Edges are cut where they meet the plane; a face that becomes a
//!    quadrilateral is divided from that of its two inner vertices that is nearer to the plane, so neighbours agree.
//! 4. What lies beyond is left out. What is left of an element has its label, which past the border is that of the nearest voxels
//!    ([`PastBorder`](crate::lattice::bcc_lattice::PastBorder)). Where its label and the other keep their topology it takes
//!    another one: of a background element that of the voxels there, and what smoothing asks for.
//! ```text
//!     \/\/\/\/\/   elements past the border          ----------- cut; a vertex next to the plane has moved onto it
//!     /\/\/\/\/\                          ->         /\/\/\/\/\
//! ```
//! The last elements of a piece of a label keep it, unless a surface pinches there otherwise: a component of one or two voxels may
//! have no others.
//!
//! Planes are taken one after the other, and vertices that move along one stay on the others or on their side of them: edges and corners
//! of the image come out exactly.
//!
//! # Source
//! [LabelleShewchuk2007] for the move onto the surface before the cut, which bounds the angles.
//!
//! # Invariants
//! The mesh conforms; vertices on a border plane have its coordinate exactly. What the cut leaves of a label has the Euler number that
//! refinement has seen ([`euler_ranges`](crate::lattice::euler_ranges)), within the limits of the first two steps.
//!
//! # Limits
//! A plane beyond which a fixed point lies is left alone.

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::tetrahedron::volume6;
use crate::index::{Label, VertexId};
use crate::lattice::border_edges::settle_labels;
use crate::lattice::border_snapping::{Plane, move_vertices};
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::element_labels::relabel_for_smoothing;
use crate::lattice::element_score::tet_score;
use crate::lattice::face_adjacency::{OUTSIDE, neighbors_of};
use crate::lattice::interface_topology::{InterfaceTopology, labels_of};
use crate::lattice::scaffold::Scaffold;
use crate::lattice::subvoxel_surface::SubvoxelSurface;

/// No vertex.
const NONE: u32 = u32::MAX;

/// Cuts a mesh and its scaffold at the border planes that it reaches; returns these planes.
///
/// # Errors
/// Those of [`neighbors_of`]; the mesh is lost then.
pub fn clip_at_border(mesh: &mut CandidateMesh, surface: &SubvoxelSurface, context: &RunContext) -> Result<Vec<u8>> {
    let borders: Vec<Plane> = (0..6).map(|number| plane_at(surface, number)).collect();
    let planes: Vec<u8> = (0..6).filter(|number| reaches(mesh, borders[usize::from(*number)])).collect();
    if planes.is_empty() {
        return Ok(planes);
    }
    let mut work = Clipping { borders, ..Clipping::new(mesh) };
    let cuts: Vec<Plane> = planes.iter().map(|number| work.borders[usize::from(*number)]).collect();
    for at in 0..cuts.len() {
        context.check()?;
        work.clip(&cuts[at..]);
    }
    let is_beyond = work.elements_beyond(surface);
    work.mark_changed();
    work.relabel(surface, &is_beyond, context)?;
    work.finish(mesh);
    Ok(planes)
}

/// The plane at a border of the image.
fn plane_at(surface: &SubvoxelSurface, number: u8) -> Plane {
    let (axis, at) = surface.border(number);
    Plane { axis, at, is_low: number.is_multiple_of(2) }
}

/// Whether elements of the mesh cross a plane, and no fixed point lies beyond.
fn reaches(mesh: &CandidateMesh, plane: Plane) -> bool {
    let is_beyond = |v: &VertexId| plane.height(mesh.points[v.index()]) > 0.0;
    // Most often no point is beyond: they are looked at before the more numerous tets.
    let is_passed = mesh.points.par_iter().with_min_len(4096).any(|point| plane.height(*point) > 0.0);
    is_passed
        && mesh.tets.par_iter().with_min_len(4096).any(|tet| tet.iter().any(is_beyond))
        && !mesh.fixed.iter().any(is_beyond)
}

/// The elements of a mesh and its scaffold under the knife.
pub(super) struct Clipping {
    pub(super) points: Vec<DVec3>,
    pub(super) tets: Vec<[u32; 4]>,
    pub(super) labels: Vec<Label>,
    pub(super) fixed: Vec<bool>,
    /// Whether a vertex lay beyond a plane, was moved, or is new.
    pub(super) changed: Vec<bool>,
    /// Whether an element may take another label.
    relabels: Vec<bool>,
    /// Planes that vertices stay on or beside where they move for the angles.
    pub(super) borders: Vec<Plane>,
}

impl Clipping {
    pub(super) fn new(mesh: &mut CandidateMesh) -> Self {
        let scaffold = std::mem::take(&mut mesh.scaffold);
        let mut points = std::mem::take(&mut mesh.points);
        points.extend(scaffold.points);
        let tets: Vec<[u32; 4]> = mesh.tets.iter().chain(&scaffold.tets).map(|t| t.map(|v| v.0)).collect();
        let mut labels = std::mem::take(&mut mesh.tet_labels);
        labels.resize(tets.len(), Label::BACKGROUND);
        mesh.tets = Vec::new();
        let mut fixed = vec![false; points.len()];
        mesh.fixed.iter().for_each(|v| fixed[v.index()] = true);
        let (changed, relabels) = (vec![false; points.len()], vec![false; tets.len()]);
        Self { points, tets, labels, fixed, changed, relabels, borders: Vec::new() }
    }

    /// Cuts the elements at the first of some planes; the others are still to come.
    fn clip(&mut self, planes: &[Plane]) {
        let plane = planes[0];
        let mut heights: Vec<f64> = self.points.par_iter().map(|p| plane.height(*p)).collect();
        for v in move_vertices(self, &mut heights, plane) {
            self.changed[v] = true;
        }
        settle_labels(&self.tets, &mut self.labels, &self.points, planes);
        self.cut_along(plane, &heights);
    }

    /// Leaves out what lies beyond a plane; `heights` are those of all vertices above it.
    pub(super) fn cut_along(&mut self, plane: Plane, heights: &[f64]) {
        let mut cuts: FxHashMap<(u32, u32), u32> = FxHashMap::default();
        let old = std::mem::take(&mut self.tets);
        let labels = std::mem::take(&mut self.labels);
        let relabels = std::mem::take(&mut self.relabels);
        for ((tet, label), relabel) in old.into_iter().zip(labels).zip(relabels) {
            if tet.iter().all(|v| heights[*v as usize] <= 0.0) {
                if tet.iter().any(|v| heights[*v as usize] < 0.0) {
                    self.push(tet, label, relabel);
                }
                continue;
            }
            let cut = |work: &mut Self, inner: u32, outer: u32| {
                *cuts.entry((inner, outer)).or_insert_with(|| work.cut([inner, outer], heights, plane))
            };
            for piece in pieces(self, tet, heights, cut) {
                self.push(piece, label, true);
            }
        }
    }

    /// Where a vertex may go that is to move somewhere: not along an axis along which it would leave a border or pass through it.
    pub(super) fn beside_borders(&self, from: DVec3, mut to: DVec3) -> DVec3 {
        for plane in &self.borders {
            if plane.height(from) * plane.height(to) <= 0.0 {
                to[plane.axis] = from[plane.axis];
            }
        }
        to
    }

    /// Puts a vertex on an edge where it meets a plane.
    fn cut(&mut self, edge: [u32; 2], heights: &[f64], plane: Plane) -> u32 {
        let [low, high] = edge.map(|v| heights[v as usize]);
        let [inner, outer] = edge.map(|v| self.points[v as usize]);
        let mut point = inner.lerp(outer, low / (low - high));
        point[plane.axis] = plane.at;
        self.points.push(point);
        self.fixed.push(false);
        self.changed.push(true);
        self.points.len() as u32 - 1
    }

    fn push(&mut self, tet: [u32; 4], label: Label, relabel: bool) {
        self.tets.push(tet);
        self.labels.push(label);
        self.relabels.push(relabel);
    }

    /// Background elements that run past a border plane which the mesh did not reach: the image says nothing of them.
    fn elements_beyond(&self, surface: &SubvoxelSurface) -> Vec<bool> {
        let is_inside = |v: &u32| {
            let point = self.points[*v as usize];
            surface.within_borders(point) == point
        };
        let is_beyond = |(tet, label): (&[u32; 4], &Label)| label.is_background() && !tet.iter().all(is_inside);
        self.tets.par_iter().with_min_len(4096).zip(&self.labels).map(is_beyond).collect()
    }

    /// What has a vertex that changed may take another label.
    fn mark_changed(&mut self) {
        for (tet, relabels) in self.tets.iter().zip(&mut self.relabels) {
            *relabels |= tet.iter().any(|v| self.changed[*v as usize]);
        }
    }

    /// The middle of an element.
    fn center(&self, element: usize) -> DVec3 {
        self.tets[element].iter().map(|v| self.points[*v as usize]).sum::<DVec3>() / 4.0
    }

    /// The elements at the border get labels that surfaces can be smoothed with.
    fn relabel(&mut self, surface: &SubvoxelSurface, is_beyond: &[bool], context: &RunContext) -> Result<()> {
        let neighbors = neighbors_of(&self.tets, self.points.len(), context)?;
        // The plane is no surface that moves: an element counts as its own neighbour there.
        let mut continued = neighbors.clone();
        for (t, row) in continued.iter_mut().enumerate() {
            if self.relabels[t] {
                row.iter_mut().filter(|n| **n == OUTSIDE).for_each(|n| *n = t as u32);
            }
        }
        let relabels = &self.relabels;
        let is_within = |changed: &[u32]| changed.iter().all(|e| !is_beyond[*e as usize]);
        let topology = InterfaceTopology::new(&self.tets, &neighbors, self.points.len(), context)?;
        let may_take = |labels: &[Label], changed: &[u32], _: Label| {
            is_within(changed) && changed.iter().all(|e| relabels[*e as usize]) && !is_piece(&topology, labels, changed)
        };
        // Of a background element the middle of what is left can lie in a label.
        for e in 0..self.tets.len() {
            if self.relabels[e] && !is_beyond[e] && self.labels[e].is_background() {
                let label = surface.nearest_label(self.center(e));
                if !label.is_background() && topology.is_simple(e as u32, label, &self.labels) {
                    self.labels[e] = label;
                }
            }
        }
        let may_take_simply = |labels: &[Label], changed: &[u32], label: Label| {
            may_take(labels, changed, label) && changed.iter().all(|e| topology.is_simple(*e, label, labels))
        };
        relabel_for_smoothing(&mut self.labels, &continued, may_take_simply, context)?;
        let cost = |labels: &[Label], changed: &[u32], to: Label| may_take(labels, changed, to).then_some(0);
        topology.repair(&mut self.labels, None, context, cost)?;
        // What still pinches needs a change farther inside, or of all its elements at once. What pinches elsewhere is left as it is: it
        // has withstood the carving, or would open a wall.
        let mut is_near_vertex = vec![false; self.points.len()];
        let at_border = self.tets.iter().zip(relabels).filter(|(_, relabels)| **relabels);
        at_border.flat_map(|(tet, _)| tet).for_each(|v| is_near_vertex[*v as usize] = true);
        let is_near = |e: u32| self.tets[e as usize].iter().any(|v| is_near_vertex[*v as usize]);
        let may_change_near = |e: u32| is_near(e) && !is_beyond[e as usize];
        let cost = |changed: &[u32]| changed.iter().all(|e| may_change_near(*e)).then_some(0);
        topology.repair(&mut self.labels, None, context, |_, changed, _| cost(changed))?;
        let mut is_candidate = vec![false; self.points.len()];
        let near = (0..self.tets.len() as u32).filter(|e| is_near(*e)).flat_map(|e| self.tets[e as usize]);
        near.for_each(|v| is_candidate[v as usize] = true);
        let is_candidate = |v: u32| is_candidate[v as usize];
        let may_change: Vec<bool> = relabels.iter().zip(is_beyond).map(|(may, beyond)| *may && !beyond).collect();
        unite_at_pinches(&topology, &mut self.labels, &may_change, is_candidate, context)?;
        // What is left has elements of three labels around it, some of which the border has not reached.
        let may_change: Vec<bool> = (0..self.tets.len() as u32).map(may_change_near).collect();
        unite_at_pinches(&topology, &mut self.labels, &may_change, is_candidate, context)?;
        Ok(())
    }

    pub(super) fn finish(self, mesh: &mut CandidateMesh) {
        let mut renumbered = vec![NONE; self.points.len()];
        for (tet, _) in self.tets.iter().zip(&self.labels).filter(|(_, label)| !label.is_background()) {
            tet.iter().for_each(|v| renumbered[*v as usize] = 0);
        }
        for (v, number) in renumbered.iter_mut().enumerate().filter(|(_, number)| **number == 0) {
            *number = mesh.points.len() as u32;
            mesh.points.push(self.points[v]);
        }
        let number = |v: u32| VertexId(renumbered[v as usize]);
        for (tet, label) in self.tets.iter().zip(&self.labels).filter(|(_, label)| !label.is_background()) {
            mesh.tets.push(tet.map(number));
            mesh.tet_labels.push(*label);
        }
        // A cube that reached a border has lost tets or its shape.
        mesh.cubes.retain(|cube| cube.vertices().all(|v| !self.changed[v.index()]));
        mesh.renumber_records(&renumbered);
        let count = mesh.points.len();
        mesh.scaffold =
            Scaffold::around(&self.tets, &self.labels, &mut renumbered, count, |v| self.points[v as usize], None);
    }
}

/// Whether elements are all that there is of a label, as far as anything touches them: the last that stand for a component.
fn is_piece(topology: &InterfaceTopology, labels: &[Label], elements: &[u32]) -> bool {
    let label = labels[elements[0] as usize];
    let mut touching = elements.iter().flat_map(|e| topology.tets[*e as usize]).flat_map(|v| topology.ball(v));
    !label.is_background() && touching.all(|e| labels[*e as usize] != label || elements.contains(e))
}

/// Gives all elements around a pinched vertex that may change one label, where that leaves fewer pinches among some vertices.
fn unite_at_pinches(
    topology: &InterfaceTopology,
    labels: &mut [Label],
    may_change: &[bool],
    is_candidate: impl Fn(u32) -> bool + Sync,
    context: &RunContext,
) -> Result<()> {
    let cost = |changed: &[u32]| changed.iter().all(|e| may_change[*e as usize]).then_some(0);
    let mut pinched = topology.pinched_among(labels, &is_candidate, context)?;
    for vertex in pinched.clone() {
        let ball = topology.ball(vertex);
        for label in labels_of(ball, labels) {
            let mut changed = Vec::new();
            for e in ball.iter().filter(|e| may_change[**e as usize]) {
                changed.push((*e, labels[*e as usize]));
                labels[*e as usize] = label;
            }
            // Nothing but what changes here pinches otherwise than before.
            let around = topology.vertices_of(ball);
            changed.extend(topology.repair_from(around, labels, None, context, |_, changed, _| cost(changed))?.changed);
            let elements: Vec<u32> = changed.iter().map(|(e, _)| *e).collect();
            let concerned = topology.vertices_of(&elements);
            let before = concerned.iter().filter(|v| pinched.binary_search(v).is_ok()).count();
            let pinches = |v: &u32| is_candidate(*v) && topology.excess(*v, labels) > 0;
            let left: Vec<u32> = concerned.iter().copied().filter(pinches).collect();
            if left.len() < before {
                pinched.retain(|v| concerned.binary_search(v).is_err());
                pinched.extend(left);
                pinched.sort_unstable();
                break;
            }
            changed.into_iter().rev().for_each(|(e, label)| labels[e as usize] = label);
        }
    }
    Ok(())
}

/// The lowest score, degrees, of what a plane leaves of a tet with these corners and heights; infinite where nothing is left, below 0 where
/// the tet is inverted. Where two corners are of a height the first counts as that of the smaller number.
pub(super) fn lowest_left(corners: [DVec3; 4], heights: [f64; 4], plane: Plane) -> f64 {
    if volume6(corners) <= 0.0 {
        return f64::NEG_INFINITY;
    }
    let mut work = Clipping {
        points: corners.to_vec(),
        tets: Vec::new(),
        labels: Vec::new(),
        fixed: vec![false; 4],
        changed: vec![false; 4],
        relabels: Vec::new(),
        borders: Vec::new(),
    };
    let left = match heights.iter().any(|height| *height > 0.0) {
        true => {
            pieces(&mut work, [0, 1, 2, 3], &heights, |work, inner, outer| work.cut([inner, outer], &heights, plane))
        }
        false => vec![[0, 1, 2, 3]],
    };
    let scores = left.into_iter().map(|piece| tet_score(piece.map(|v| work.points[v as usize])));
    scores.fold(f64::INFINITY, f64::min)
}

/// What is left of a tet below the plane; it has a vertex above.
fn pieces(
    work: &mut Clipping,
    tet: [u32; 4],
    heights: &[f64],
    mut cut: impl FnMut(&mut Clipping, u32, u32) -> u32,
) -> Vec<[u32; 4]> {
    let at = |v: u32| heights[v as usize];
    let mut inside: Vec<u32> = tet.into_iter().filter(|v| at(*v) < 0.0).collect();
    let on: Vec<u32> = tet.into_iter().filter(|v| at(*v) == 0.0).collect();
    let outside: Vec<u32> = tet.into_iter().filter(|v| at(*v) > 0.0).collect();
    // Nearest to the plane first: quadrilaterals are divided from there.
    inside.sort_unstable_by(|l, r| at(*r).total_cmp(&at(*l)).then(l.cmp(r)));
    let mut found = match (inside.as_slice(), on.as_slice(), outside.as_slice()) {
        (&[a], ..) => {
            vec![tet.map(|v| if at(v) > 0.0 { cut(work, a, v) } else { v })]
        }
        (&[a, b], &[z], &[c]) => {
            let [ac, bc] = [cut(work, a, c), cut(work, b, c)];
            vec![[a, b, bc, z], [a, bc, ac, z]]
        }
        (&[a, b], _, &[c, d]) => {
            let [ac, ad, bc, bd] = [cut(work, a, c), cut(work, a, d), cut(work, b, c), cut(work, b, d)];
            let length = |p: u32, q: u32| work.points[p as usize].distance_squared(work.points[q as usize]);
            let mut found = vec![[a, b, bc, bd]];
            if length(ac, bd) < length(ad, bc) {
                found.extend([[a, ac, ad, bd], [a, ac, bc, bd]]);
            } else {
                found.extend([[a, ac, ad, bc], [a, ad, bc, bd]]);
            }
            found
        }
        (&[a, b, c], _, &[d]) => {
            let [ad, bd, cd] = [cut(work, a, d), cut(work, b, d), cut(work, c, d)];
            vec![[a, b, c, cd], [a, b, bd, cd], [a, ad, bd, cd]]
        }
        _ => Vec::new(),
    };
    for piece in &mut found {
        if volume6(piece.map(|v| work.points[v as usize])) < 0.0 {
            piece.swap(2, 3);
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
    use crate::image::grid::Grid;
    use crate::image::label_image::LabelImage;
    use crate::lattice;
    use crate::lattice::options::{Options, PARAMETERS};
    use crate::mesh::quality::mesh_quality;
    use crate::mesh::validation::check_mixed_mesh;
    use crate::parameters::ParameterSet;
    use glam::DMat3;

    /// Two labels that fill the image but for a ball at one of its edges.
    fn filled() -> LabelImage {
        let n = [15, 13, 12];
        let grid = Grid::new(n, DVec3::new(1.0, 1.1, 0.9), DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let label = |v: usize| {
            let p = DVec3::new((v % n[0]) as f64, (v / n[0] % n[1]) as f64, (v / n[0] / n[1]) as f64);
            if p.distance(DVec3::new(0.0, 0.0, 6.0)) < 3.6 {
                Label(0)
            } else {
                Label(1 + u16::from(p.x + 0.4 * p.y > 9.0))
            }
        };
        LabelImage::new(grid, (0..n.iter().product()).map(label).collect(), vec![0, 1, 2]).unwrap()
    }

    #[test]
    fn tissue_that_fills_the_image_becomes_a_box_with_good_angles() {
        let mut set = ParameterSet::new(PARAMETERS);
        set.set_text("lattice-spacing", "4").unwrap();
        let options = Options::from_parameters(&set).unwrap();
        let image = filled();
        let (output, report) = lattice::run(&image, &options, &RunContext::with_threads(2).unwrap()).unwrap();
        check_mixed_mesh(&output.mesh).unwrap();
        assert_eq!(report.statistics().value("improvement.crossings"), Some(0.0));
        let quality = mesh_quality(&output.mesh, &RunContext::with_threads(1).unwrap()).unwrap().statistics();
        assert!(quality.value("quality.min_dihedral").unwrap() > 12.0, "{quality:?}");
        assert!(quality.value("quality.max_dihedral").unwrap() < 160.0, "{quality:?}");
        let high = DVec3::new(14.5, 12.5 * 1.1, 11.5 * 0.9);
        let low = DVec3::new(-0.5, -0.55, -0.45);
        let points = &output.mesh.points;
        assert!(points.iter().all(|p| p.cmpge(low - 0.01).all() && p.cmple(high + 0.01).all()));
        for corner in [high, DVec3::new(high.x, low.y, high.z)] {
            assert!(points.iter().any(|p| p.distance(corner) < 0.3), "{corner}");
        }
    }

    #[test]
    fn specks_at_the_border_stay_within_the_image() {
        // The lattice has vertices on one border plane, so that the mesh does not reach past it; elements behind have the specks'
        // voxels next to them.
        let size = [21, 18, 15];
        let grid = Grid::new(size, DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let label = |v: usize| Label(u16::from((v as u32).wrapping_mul(2_654_435_761) >> 28 == 0));
        let image = LabelImage::new(grid, (0..size.iter().product()).map(label).collect(), vec![0, 1]).unwrap();
        let options = Options::from_parameters(&ParameterSet::new(PARAMETERS)).unwrap();
        let (output, _) = lattice::run(&image, &options, &RunContext::with_threads(2).unwrap()).unwrap();
        check_mixed_mesh(&output.mesh).unwrap();
        let high = DVec3::from_array(size.map(|n| n as f64 - 0.5));
        let farthest = |p: &DVec3| (DVec3::splat(-0.5) - *p).max(*p - high).max_element();
        let beyond = output.mesh.points.iter().map(farthest).fold(f64::MIN, f64::max);
        assert!(beyond < 1e-9, "{beyond}");
    }

    #[test]
    fn what_pinches_far_from_the_border_keeps_its_labels() {
        // Cubes of six tets each within label 1, two of which, of label 2, meet along an edge; a tet at the border x = -0.5.
        let number = |at: [usize; 3]| VertexId((at[0] + 5 * (at[1] + 5 * at[2])) as u32);
        let place = |v: usize| DVec3::new((5 + v % 5) as f64, (3 + v / 5 % 5) as f64, (3 + v / 25) as f64);
        let mut mesh = CandidateMesh { points: (0..125).map(place).collect(), ..CandidateMesh::default() };
        for cube in (0..64).map(|n| [n % 4, n / 4 % 4, n / 16]) {
            for axes in [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]] {
                let mut at = cube;
                let mut tet = [number(cube); 4];
                axes.into_iter().zip(&mut tet[1..]).for_each(|(axis, v)| (at[axis] += 1, *v = number(at)).1);
                if (axes[0] + 1) % 3 != axes[1] {
                    tet.swap(2, 3);
                }
                mesh.tets.push(tet);
                mesh.tet_labels.push(Label(1 + u16::from([[1, 1, 1], [2, 2, 1]].contains(&cube))));
            }
        }
        mesh.points.extend([[-1.0, 4.0, 4.0], [0.0, 4.0, 4.0], [0.0, 5.0, 4.0], [0.0, 4.0, 5.0]].map(DVec3::from));
        mesh.tets.push([125, 126, 127, 128].map(VertexId));
        mesh.tet_labels.push(Label(1));
        assert!(mesh.tets.iter().all(|t| volume6(t.map(|v| mesh.points[v.index()])) > 0.0));
        let context = RunContext::with_threads(1).unwrap();
        let before = mesh.tet_labels.clone();
        let image = filled();
        let surface = SubvoxelSurface::new(&image, &context).unwrap();
        assert_eq!(clip_at_border(&mut mesh, &surface, &context).unwrap(), [0]);
        assert_eq!(mesh.tet_labels[..384], before[..384]);
    }

    #[test]
    fn what_is_left_of_a_tet_fills_the_part_below_the_plane() {
        // All ways in which the plane x = -0.5 can meet a tet; the volumes below are integrals of the slices.
        let image = filled();
        let context = RunContext::with_threads(1).unwrap();
        let surface = SubvoxelSurface::new(&image, &context).unwrap();
        for heights in [[1.0, -1.0, -1.0, -1.0], [1.0, 1.0, -1.0, -1.0], [1.0, 1.0, 1.0, -1.0], [1.0, 0.0, -1.0, -1.0]]
        {
            let place = |i: usize, y: f64, z: f64| DVec3::new(-0.5 - heights[i], y, z);
            let mut points = vec![place(0, 4.0, 4.0), place(1, 7.0, 4.0), place(2, 4.0, 8.0), place(3, 5.0, 5.0)];
            if volume6([points[0], points[1], points[2], points[3]]) < 0.0 {
                points.swap(0, 1);
            }
            let whole = volume6([points[0], points[1], points[2], points[3]]);
            let mut mesh = CandidateMesh {
                points,
                tets: vec![[0, 1, 2, 3].map(VertexId)],
                tet_labels: vec![Label(1)],
                ..CandidateMesh::default()
            };
            assert_eq!(clip_at_border(&mut mesh, &surface, &context).unwrap(), [0]);
            let volume = |t: &[VertexId; 4]| volume6(t.map(|v| mesh.points[v.index()]));
            assert!(mesh.tets.iter().all(|t| volume(t) > 0.0));
            // Heights are linear: the part cut off at a vertex is the product of the parts of its edges.
            let part = match heights.iter().filter(|h| **h > 0.0).count() {
                1 if heights[1] == 0.0 => 0.75,
                1 => 0.875,
                2 => 0.5,
                _ => 0.125,
            };
            assert!((mesh.tets.iter().map(volume).sum::<f64>() - part * whole).abs() < 1e-12, "{heights:?}");
        }
    }

    #[test]
    fn a_vertex_next_to_the_plane_moves_onto_it() {
        let image = filled();
        let context = RunContext::with_threads(1).unwrap();
        let surface = SubvoxelSurface::new(&image, &context).unwrap();
        let points = vec![
            DVec3::new(-0.6, 4.0, 4.0),
            DVec3::new(2.0, 4.0, 3.0),
            DVec3::new(2.0, 6.0, 4.0),
            DVec3::new(2.0, 4.0, 6.0),
        ];
        let mut mesh = CandidateMesh {
            points,
            tets: vec![[0, 1, 2, 3].map(VertexId)],
            tet_labels: vec![Label(1)],
            ..CandidateMesh::default()
        };
        clip_at_border(&mut mesh, &surface, &context).unwrap();
        assert_eq!((mesh.points[0].x, mesh.tets.len()), (-0.5, 1));
        assert!(tet_score([0, 1, 2, 3].map(|v: usize| mesh.points[v])) > 10.0);
    }

    /// A tet of label 2 with one face on the border, three of label 1 behind its other faces, and the labels that these four have
    /// after relabelling; `further` more of label 2, at most one, lie behind the first of the three.
    fn relabelled(further: usize) -> Vec<Label> {
        let points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.3, 0.3, 1.0]];
        let beyond = [[1.0, 1.0, 1.0], [-1.0, 0.3, 1.0], [0.3, -1.0, 1.0], [2.0, 2.0, 0.5]];
        let mut tets = vec![[0, 1, 2, 3], [1, 2, 3, 4], [0, 2, 3, 5], [0, 1, 3, 6]];
        tets.extend([[1, 2, 4, 7]].iter().take(further));
        let mut mesh = CandidateMesh {
            points: points.into_iter().chain(beyond).map(DVec3::from_array).collect(),
            tet_labels: [2, 1, 1, 1, 2].into_iter().take(tets.len()).map(Label).collect(),
            tets: tets.iter().map(|t| t.map(VertexId)).collect(),
            ..CandidateMesh::default()
        };
        labels_after(Clipping::new(&mut mesh))
    }

    /// The labels when all elements may take others.
    fn labels_after(mut work: Clipping) -> Vec<Label> {
        let context = RunContext::with_threads(1).unwrap();
        let (image, is_beyond) = (filled(), vec![false; work.tets.len()]);
        work.relabels.fill(true);
        work.relabel(&SubvoxelSurface::new(&image, &context).unwrap(), &is_beyond, &context).unwrap();
        work.labels
    }

    #[test]
    fn background_whose_middle_lies_in_a_label_joins_it_as_long_as_some_is_left() {
        // Four tets in a row where the image has label 1.
        let points =
            (0..7).map(|i| DVec3::new(4.0 + 0.3 * f64::from(i), 5.0 + f64::from(i % 3), 5.0 + f64::from(i % 2)));
        let mut mesh = CandidateMesh {
            points: points.collect(),
            tets: (0..4).map(|v| [v, v + 1, v + 2, v + 3].map(VertexId)).collect(),
            tet_labels: [1, 0, 0, 0].map(Label).to_vec(),
            ..CandidateMesh::default()
        };
        assert_eq!(labels_after(Clipping::new(&mut mesh)), [1, 1, 1, 0].map(Label));
    }

    #[test]
    fn the_last_element_of_a_piece_keeps_its_label_and_one_that_touches_others_does_not() {
        assert_eq!(relabelled(0)[0], Label(2));
        // The fifth touches the first along an edge only.
        assert_ne!(relabelled(1)[0], Label(2), "{:?}", relabelled(1));
    }
}
