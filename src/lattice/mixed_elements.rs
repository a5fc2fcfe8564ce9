//! Uniform tets merge into hexahedra; pyramids stand where hexahedra meet tets.
//!
//! # Method
//! 1. A lattice vertex is full when all 24 tets around it are red, of one level and of one label.
//! 2. A full vertex is the centre of a cube; its tets are cut by the cube's faces. Only one of the two interlaced
//!    lattices of a level gives centres, the one with more full vertices, so cubes never overlap.
//! 3. Between two cubes the tets across their common face vanish. Between a cube and a vertex `c'` that is no centre
//!    the four tets across the face become a pyramid with apex `c'`.
//! 4. A cube with a pyramid that would have more surface triangles than allowed stays tets.
//!
//! ```text
//!     v3 ---- v2
//!     |  c    |  . c'      cube around c, pyramid (v0 v1 v2 v3, c') in place of the tets (c, c', v0, v1) ...
//!     v0 ---- v1
//! ```
//! # Source
//! [Drakopoulos2017] 2.3.4.
//!
//! # Invariants
//! Triangles between labels stay what they are: a cube is of one label and pyramids keep the outer triangles of the
//! tets they replace. The mesh conforms.

use glam::IVec3;
use rustc_hash::FxHashMap;

use crate::error::Result;
use crate::index::{Label, VertexId};
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::face_adjacency::{OUTSIDE, neighbors_of};
use crate::lattice::red_green::{Elements, RedGreenLattice};

/// Tets around a vertex of the uniform lattice.
const TETS_AROUND_VERTEX: u8 = 24;

/// Corners of a cube in VTK's order, in half edges from its centre.
const CUBE: [IVec3; 8] = [
    IVec3::new(-1, -1, -1),
    IVec3::new(1, -1, -1),
    IVec3::new(1, 1, -1),
    IVec3::new(-1, 1, -1),
    IVec3::new(-1, -1, 1),
    IVec3::new(1, -1, 1),
    IVec3::new(1, 1, 1),
    IVec3::new(-1, 1, 1),
];

/// Elements of the lattice after merging; vertices are those of the lattice.
#[derive(Default)]
pub struct MixedElements {
    /// Tets that are merged.
    pub is_merged: Vec<bool>,
    /// Hexahedra in VTK order.
    pub hexahedra: Vec<[u32; 8]>,
    /// Label per hexahedron.
    pub hexahedron_labels: Vec<Label>,
    /// Pyramids in VTK order.
    pub pyramids: Vec<[u32; 5]>,
    /// Label per pyramid.
    pub pyramid_labels: Vec<Label>,
}

/// What is known of the tets around a vertex.
#[derive(Clone, Copy)]
struct Around {
    count: u8,
    level: u8,
    label: Label,
}

/// Merges what can be merged; vertices for which `is_fixed` holds stay.
///
/// # Errors
/// As [`neighbors_of`].
pub fn merge(
    lattice: &RedGreenLattice,
    elements: &Elements,
    max_surface_triangles: usize,
    is_fixed: impl Fn(u32) -> bool,
) -> Result<MixedElements> {
    let around = tets_around_vertices(lattice, elements);
    let neighbors = neighbors_of(&elements.tets, around.len())?;
    let mut is_center: Vec<bool> =
        (0..around.len() as u32).map(|v| around[v as usize].count == TETS_AROUND_VERTEX && !is_fixed(v)).collect();
    keep_one_lattice_per_level(lattice, &around, &mut is_center);
    // Surface triangles of each pyramid (centre, apex); a cube with too many stays tets. A refused cube becomes the
    // apex of its neighbours' pyramids, whose triangles then lie inside one label: one pass settles it.
    let mut surface: FxHashMap<(u32, u32), usize> = FxHashMap::default();
    for_each_long_edge(elements, |e, tet, center, apex, corner| {
        if is_center[center as usize] && !is_center[apex as usize] {
            let near = neighbors[e][corner];
            let on_surface = near == OUTSIDE || elements.labels[near as usize] != elements.labels[e];
            *surface.entry((center, apex)).or_default() += usize::from(on_surface);
        }
        let _ = tet;
    });
    for ((center, _), triangles) in surface {
        is_center[center as usize] &= triangles <= max_surface_triangles;
    }
    Ok(build(lattice, elements, &around, &is_center))
}

fn tets_around_vertices(lattice: &RedGreenLattice, elements: &Elements) -> Vec<Around> {
    let mut around = vec![Around { count: 0, level: 0, label: Label::BACKGROUND }; lattice.vertices.positions.len()];
    for (e, tet) in elements.tets.iter().enumerate() {
        let (leaf, label) = (elements.leaves[e] as usize, elements.labels[e]);
        // A leaf with greens has several elements, none of which is the leaf itself.
        if *tet != lattice.tets[leaf] || label.is_background() {
            continue;
        }
        let level = lattice.levels[leaf];
        for v in tet {
            let known = &mut around[*v as usize];
            if known.count == 0 {
                *known = Around { count: 1, level, label };
            } else if (known.level, known.label) == (level, label) {
                known.count += 1;
            } else {
                // Two kinds of tets: never full, however many of one kind follow.
                known.label = Label(u16::MAX);
            }
        }
    }
    around
}

/// Which of the two interlaced lattices of its level a vertex belongs to.
fn sublattice(lattice: &RedGreenLattice, vertex: u32, level: u8) -> usize {
    usize::from(lattice.vertices.positions[vertex as usize].x & (lattice.frame.edge(u32::from(level)) - 1) != 0)
}

fn keep_one_lattice_per_level(lattice: &RedGreenLattice, around: &[Around], is_center: &mut [bool]) {
    let mut counts = vec![[0usize; 2]; lattice.deepest_level() as usize + 1];
    let level_of = |v: usize| around[v].level;
    for v in (0..around.len()).filter(|v| is_center[*v]) {
        counts[usize::from(level_of(v))][sublattice(lattice, v as u32, level_of(v))] += 1;
    }
    for v in 0..around.len() {
        let [zero, one] = counts[usize::from(level_of(v))];
        is_center[v] &= sublattice(lattice, v as u32, level_of(v)) == usize::from(one > zero);
    }
}

/// Calls `visit(element, tet, end, other end, local number of end)` for both ends of both long edges of each tet.
fn for_each_long_edge(elements: &Elements, mut visit: impl FnMut(usize, &[u32; 4], u32, u32, usize)) {
    for (e, tet) in elements.tets.iter().enumerate() {
        for [a, b] in [[0, 1], [1, 0], [2, 3], [3, 2]] {
            visit(e, tet, tet[a], tet[b], a);
        }
    }
}

fn build(lattice: &RedGreenLattice, elements: &Elements, around: &[Around], is_center: &[bool]) -> MixedElements {
    let mut mixed = MixedElements { is_merged: vec![false; elements.tets.len()], ..MixedElements::default() };
    let corner_at = |position: IVec3| lattice.vertices.find(position).expect("a full vertex has its 14 neighbours");
    let mut pyramids: Vec<(u32, u32)> = Vec::new();
    for_each_long_edge(elements, |e, _, center, apex, _| {
        if is_center[center as usize] {
            mixed.is_merged[e] = true;
            if !is_center[apex as usize] {
                pyramids.push((center, apex));
            }
        }
    });
    pyramids.sort_unstable();
    pyramids.dedup();
    for center in (0..around.len()).filter(|v| is_center[*v]) {
        let half = lattice.frame.edge(u32::from(around[center].level)) / 2;
        let position = lattice.vertices.positions[center];
        mixed.hexahedra.push(CUBE.map(|step| corner_at(position + half * step)));
        mixed.hexahedron_labels.push(around[center].label);
    }
    for (center, apex) in pyramids {
        let (position, top) = (lattice.vertices.positions[center as usize], lattice.vertices.positions[apex as usize]);
        let half = lattice.frame.edge(u32::from(around[center as usize].level)) / 2;
        let outward = (top - position) / (2 * half);
        // Two axes u, v with u x v = outward turn counter-clockwise seen from the apex.
        let u = IVec3::new(outward.y, outward.z, outward.x);
        let u = if outward.min_element() < 0 { -u } else { u };
        let v = outward.cross(u);
        let ring = [-u - v, u - v, u + v, v - u].map(|step| corner_at(position + half * (outward + step)));
        mixed.pyramids.push([ring[0], ring[1], ring[2], ring[3], apex]);
        mixed.pyramid_labels.push(around[center as usize].label);
    }
    mixed
}

/// The merged elements as a candidate mesh; vertices are renumbered in the order of first use.
pub fn compact(lattice: &RedGreenLattice, elements: &Elements, mixed: &MixedElements) -> CandidateMesh {
    let mut mesh = CandidateMesh::default();
    let mut renumbered = vec![u32::MAX; lattice.vertices.positions.len()];
    let mut points = Vec::new();
    let mut number = |v: u32| {
        let slot = &mut renumbered[v as usize];
        if *slot == u32::MAX {
            *slot = points.len() as u32;
            points.push(lattice.frame.local(lattice.vertices.positions[v as usize]));
        }
        VertexId(*slot)
    };
    for (e, (tet, label)) in elements.tets.iter().zip(&elements.labels).enumerate() {
        if !label.is_background() && !mixed.is_merged.get(e).copied().unwrap_or(false) {
            mesh.tets.push(tet.map(&mut number));
            mesh.tet_labels.push(*label);
        }
    }
    mesh.pyramids = mixed.pyramids.iter().map(|p| p.map(&mut number)).collect();
    mesh.hexahedra = mixed.hexahedra.iter().map(|h| h.map(&mut number)).collect();
    mesh.pyramid_labels.clone_from(&mixed.pyramid_labels);
    mesh.hexahedron_labels.clone_from(&mixed.hexahedron_labels);
    mesh.points = points;
    mesh
}
