//! Uniform tets merge into hexahedra; pyramids stand where hexahedra meet tets.
//!
//! # Method
//! 1. A lattice vertex is full when all 24 tets around it are red, of one level and of one label.
//! 2. A full vertex is the centre of a cube; its tets are cut by the cube's faces. Only one of the two interlaced
//!    lattices of a level gives centres, the one with more full vertices, so cubes never overlap.
//! 3. Between two cubes the tets across their common face vanish. Between a cube and a vertex `c'` that is no centre
//!    the four tets across the face become a pyramid with apex `c'`.
//! 4. A cube with a pyramid that would have more surface triangles than allowed stays tets.
//! 5. The cubes are found in the lattice. The elastic model of the smoothing takes all of them, whether a mixed mesh is
//!    wanted or not ([`elastic_model`](crate::lattice::elastic_model)); they are merged for good after smoothing, where their
//!    tets are still whole and the merged elements are good enough. So the surfaces of the mixed mesh are those of the
//!    tetrahedral mesh.
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
//! tets they replace. The mesh conforms, and elements cut into tets from the mean of their corners do not overlap.

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::predicates::orient3d;
use crate::index::{Label, VertexId};
use crate::lattice::candidate_mesh::{CandidateMesh, MergeableCube};
use crate::lattice::face_adjacency::OUTSIDE;
use crate::lattice::red_green::{Elements, RedGreenLattice};
use crate::lattice::scaffold::Scaffold;
use crate::mesh::mixed_mesh::ElementKind;
use crate::mesh::numbering::{HEX_FACES, PYRAMID_BASE, PYRAMID_TRIANGLES};
use crate::mesh::quality::{pyramid_corner_jacobian, scaled_jacobian};
use crate::parallel::ordered_concat::ordered_concat;

/// Directions across the faces of a cube, in the order of `numbering::HEX_FACES`.
const APEXES: [IVec3; 6] = [IVec3::NEG_X, IVec3::X, IVec3::NEG_Y, IVec3::Y, IVec3::NEG_Z, IVec3::Z];

/// Elements per parallel work item.
const CHUNK: usize = 1 << 14;

/// Cubes per parallel work item.
const CUBE_CHUNK: usize = 256;

/// Vertices that a chunk remembers while it lists its own: some times those of a layer of elements.
const RECENT: usize = 4096;

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

/// Whether a limit on surface triangles will be asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SurfaceCount<'a> {
    /// The surface triangles of pyramids are counted, by the neighbours of the elements.
    Counted(&'a [[u32; 4]]),
    /// They are taken as none.
    Skipped,
}

/// What is known of the tets around a vertex.
#[derive(Clone, Copy)]
struct Around {
    count: u8,
    level: u8,
    label: Label,
}

/// The cubes whose tets can be merged; ids are those of the lattice's vertices. Surface triangles are counted where a limit
/// on them will be asked for.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn find_cubes(
    lattice: &RedGreenLattice,
    elements: &Elements,
    surface: SurfaceCount,
    context: &RunContext,
) -> Result<Vec<MergeableCube>> {
    context.check()?;
    let around = tets_around_vertices(lattice, elements);
    context.check()?;
    let mut is_center: Vec<bool> = around.iter().map(|a| a.count == TETS_AROUND_VERTEX).collect();
    keep_one_lattice_per_level(lattice, &around, &mut is_center);
    let triangles = match surface {
        SurfaceCount::Counted(neighbors) => surface_triangles(elements, neighbors, &is_center),
        SurfaceCount::Skipped => FxHashMap::default(),
    };
    let cube = |center: u32| {
        let half = lattice.frame.edge(u32::from(around[center as usize].level)) / 2;
        let position = lattice.vertices.positions[center as usize];
        let at = |step: IVec3| {
            VertexId(lattice.vertices.find(position + half * step).expect("a full vertex has its 14 neighbours"))
        };
        MergeableCube {
            center: VertexId(center),
            corners: CUBE.map(at),
            apexes: APEXES.map(|a| at(2 * a)),
            surface_triangles: triangles.get(&center).copied().unwrap_or(0),
        }
    };
    Ok((0..around.len() as u32).filter(|v| is_center[*v as usize]).map(cube).collect())
}

/// The most surface triangles of a pyramid of each cube, by centre; zeros are left out.
///
/// A refused cube becomes the apex of its neighbours' pyramids, whose triangles then lie inside one label: counts do not
/// depend on which cubes are refused.
fn surface_triangles(elements: &Elements, neighbors: &[[u32; 4]], is_center: &[bool]) -> FxHashMap<u32, u8> {
    let mut of_pyramid: FxHashMap<(u32, u32), u8> = FxHashMap::default();
    for (e, tet) in elements.tets.iter().enumerate() {
        for [a, b] in [[0, 1], [1, 0], [2, 3], [3, 2]] {
            let (center, apex) = (tet[a], tet[b]);
            if is_center[center as usize] && !is_center[apex as usize] {
                let near = neighbors[e][a];
                if near == OUTSIDE || elements.labels[near as usize] != elements.labels[e] {
                    *of_pyramid.entry((center, apex)).or_default() += 1;
                }
            }
        }
    }
    let mut most: FxHashMap<u32, u8> = FxHashMap::default();
    for ((center, _), count) in of_pyramid {
        let known = most.entry(center).or_default();
        *known = (*known).max(count);
    }
    most
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

/// All labelled elements as a candidate mesh, with the cubes that can be merged later; vertices are renumbered in the
/// order of first use. A mesh that is to be smoothed gets a scaffold.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn compact(
    lattice: &RedGreenLattice,
    elements: &Elements,
    cubes: &[MergeableCube],
    with_scaffold: bool,
    context: &RunContext,
) -> Result<CandidateMesh> {
    let (order, mut renumbered) = vertices_by_first_use(elements, lattice.vertices.positions.len());
    context.check()?;
    let labelled = |c: usize| {
        let range = c * CHUNK..((c + 1) * CHUNK).min(elements.tets.len());
        range.filter(|e| !elements.labels[*e].is_background())
    };
    let chunks = 0..elements.tets.len().div_ceil(CHUNK);
    let rows = |c| labelled(c).map(|e| elements.tets[e].map(|v| VertexId(renumbered[v as usize]))).collect();
    let labels = |c| labelled(c).map(|e| elements.labels[e]).collect();
    let place = |v: &u32| lattice.frame.local(lattice.vertices.positions[*v as usize]);
    let mut mesh = CandidateMesh {
        points: order.par_iter().with_min_len(CHUNK).map(place).collect(),
        tets: ordered_concat(chunks.clone().into_par_iter().map(rows).collect()),
        tet_labels: ordered_concat(chunks.into_par_iter().map(labels).collect()),
        ..CandidateMesh::default()
    };
    let number = |v: VertexId| VertexId(renumbered[v.index()]);
    mesh.cubes = cubes
        .iter()
        .map(|c| MergeableCube {
            center: number(c.center),
            corners: c.corners.map(number),
            apexes: c.apexes.map(number),
            surface_triangles: c.surface_triangles,
        })
        .collect();
    context.check()?;
    if with_scaffold {
        let place = |v: u32| lattice.frame.local(lattice.vertices.positions[v as usize]);
        let count = mesh.points.len();
        let planes = planes_passed(lattice, &mesh.points);
        let is_cut = |tet: &[u32; 4]| {
            planes.iter().any(|(axis, sign, at)| {
                let height = |v: &u32| sign * (place(*v)[*axis] - at);
                tet.iter().any(|v| height(v) >= 0.0) && tet.iter().any(|v| height(v) < 0.0)
            })
        };
        let is_cut: Option<&(dyn Fn(&[u32; 4]) -> bool + Sync)> = if planes.is_empty() { None } else { Some(&is_cut) };
        mesh.scaffold = Scaffold::around(&elements.tets, &elements.labels, &mut renumbered, count, place, is_cut);
    }
    Ok(mesh)
}

/// The planes of the image border that points lie beyond: axis, sign of the outward normal, position (mm).
fn planes_passed(lattice: &RedGreenLattice, points: &[DVec3]) -> Vec<(usize, f64, f64)> {
    let grid = lattice.field.image.grid();
    let [low, high] = points
        .par_iter()
        .map(|p| [*p, *p])
        .reduce(|| [DVec3::INFINITY, DVec3::NEG_INFINITY], |a, b| [a[0].min(b[0]), a[1].max(b[1])]);
    let of_axis = |axis: usize| {
        let first = -0.5 * grid.spacing()[axis];
        let last = (grid.size()[axis] as f64 - 0.5) * grid.spacing()[axis];
        let passed = [(low[axis] < first, -1.0, first), (high[axis] > last, 1.0, last)];
        passed.into_iter().filter(|(is_passed, ..)| *is_passed).map(move |(_, sign, at)| (axis, sign, at))
    };
    (0..3).flat_map(of_axis).collect()
}

/// The vertices of the labelled elements in the order of first use, and the place of each vertex in that order,
/// `u32::MAX` where it has none.
fn vertices_by_first_use(elements: &Elements, vertex_count: usize) -> (Vec<u32>, Vec<u32>) {
    // Each chunk lists its vertices in the order of use, without most of the repetitions: what is left to do one after
    // the other is little more than one look a vertex.
    let listed = |(tets, labels): (&[[u32; 4]], &[Label])| {
        let mut recent = [u32::MAX; RECENT];
        let mut list = Vec::with_capacity(tets.len());
        for (tet, _) in tets.iter().zip(labels).filter(|(_, label)| !label.is_background()) {
            for v in tet {
                let slot = &mut recent[*v as usize % RECENT];
                if *slot != *v {
                    *slot = *v;
                    list.push(*v);
                }
            }
        }
        list
    };
    let lists: Vec<Vec<u32>> =
        elements.tets.par_chunks(CHUNK).zip(elements.labels.par_chunks(CHUNK)).map(listed).collect();
    let mut order = Vec::new();
    let mut renumbered = vec![u32::MAX; vertex_count];
    for v in lists.into_iter().flatten() {
        let slot = &mut renumbered[v as usize];
        if *slot == u32::MAX {
            *slot = order.len() as u32;
            order.push(v);
        }
    }
    (order, renumbered)
}

/// What becomes of the tets of a mesh when cubes are merged.
pub struct MergedElements {
    /// Hexahedra with their labels.
    pub hexahedra: Vec<([VertexId; 8], Label)>,
    /// Pyramids with their labels.
    pub pyramids: Vec<([VertexId; 5], Label)>,
    /// Whether each tet stays.
    pub is_kept: Vec<bool>,
    /// The vertices that vanish, each the middle of a hexahedron, in the order of `hexahedra`.
    pub centers: Vec<VertexId>,
}

/// The elements that come of merging the cubes whose tets are all still there, where no hexahedron and no pyramid gets a
/// scaled Jacobian below `min_scaled_jacobian`, of a pyramid also at the corners of its base, no pyramid has more than
/// `max_surface_triangles`, and each sees all its faces from its middle.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn merged_elements(
    mesh: &CandidateMesh,
    max_surface_triangles: usize,
    min_scaled_jacobian: f64,
    context: &RunContext,
) -> Result<MergedElements> {
    let cubes = &mesh.cubes;
    let mut cube_of = vec![u32::MAX; mesh.points.len()];
    cubes.iter().enumerate().for_each(|(c, cube)| cube_of[cube.center.index()] = c as u32);
    let labels = labels_of_whole_cubes(mesh, cubes, &cube_of);
    context.check()?;
    let is_allowed = |(cube, label): (&MergeableCube, &Option<Label>)| {
        label.is_some() && usize::from(cube.surface_triangles) <= max_surface_triangles
    };
    let mut is_merged: Vec<bool> = cubes.iter().zip(&labels).map(is_allowed).collect();
    give_up_bad_cubes(&mesh.points, cubes, &cube_of, min_scaled_jacobian, &mut is_merged, context)?;
    let is_center = |v: &VertexId| cube_of[v.index()] != u32::MAX && is_merged[cube_of[v.index()] as usize];
    let mut result = MergedElements {
        hexahedra: Vec::new(),
        pyramids: Vec::new(),
        is_kept: mesh.tets.par_iter().with_min_len(CHUNK).map(|t| !t.iter().any(is_center)).collect(),
        centers: Vec::new(),
    };
    for (c, cube) in cubes.iter().enumerate() {
        let Some(label) = labels[c].filter(|_| is_merged[c]) else { continue };
        result.hexahedra.push((cube.corners, label));
        result.centers.push(cube.center);
        result.pyramids.extend(pyramids_of(cube, &cube_of, &is_merged).map(|p| (p, label)));
    }
    context.check()?;
    Ok(result)
}

/// A cube that is given up turns its neighbours' faces towards it into pyramids: again until nothing changes.
fn give_up_bad_cubes(
    points: &[DVec3],
    cubes: &[MergeableCube],
    cube_of: &[u32],
    min_scaled_jacobian: f64,
    is_merged: &mut [bool],
    context: &RunContext,
) -> Result<()> {
    let quality = |kind: ElementKind, nodes: &[VertexId]| {
        let mut corners = [DVec3::ZERO; 8];
        corners.iter_mut().zip(nodes).for_each(|(corner, v)| *corner = points[v.index()]);
        let worst = scaled_jacobian(kind, &corners[..nodes.len()]);
        match kind {
            _ if !sees_its_faces(kind, &corners[..nodes.len()]) => f64::NEG_INFINITY,
            ElementKind::Pyramid => worst.min(pyramid_corner_jacobian(&corners)),
            _ => worst,
        }
    };
    loop {
        let now: &[bool] = is_merged;
        let spoils = |c: &usize| {
            let cube = &cubes[*c];
            now[*c]
                && (quality(ElementKind::Hexahedron, &cube.corners) < min_scaled_jacobian
                    || pyramids_of(cube, cube_of, now).any(|p| quality(ElementKind::Pyramid, &p) < min_scaled_jacobian))
        };
        let all = (0..cubes.len()).into_par_iter().with_min_len(CUBE_CHUNK);
        let spoiled: Vec<usize> = context.until_cancelled(all).filter(spoils).collect();
        context.check()?;
        if spoiled.is_empty() {
            return Ok(());
        }
        spoiled.into_iter().for_each(|c| is_merged[c] = false);
    }
}

/// Whether the mean of an element's corners lies strictly inside of all its faces, whichever diagonal cuts a quadrilateral: then
/// the tets from there to the faces fill the element without folding.
///
/// The base of a pyramid may be warped by about a fifth of the pyramid's height.
fn sees_its_faces(kind: ElementKind, corners: &[DVec3]) -> bool {
    let center = corners.iter().sum::<DVec3>() / corners.len() as f64;
    let is_outward = |[a, b, c]: [usize; 3]| orient3d(corners[a], corners[c], corners[b], center) > 0.0;
    let cuts = |[a, b, c, d]: [usize; 4]| [[a, b, c], [a, c, d], [a, b, d], [b, c, d]].into_iter().all(is_outward);
    match kind {
        ElementKind::Pyramid => cuts(PYRAMID_BASE) && PYRAMID_TRIANGLES.into_iter().all(is_outward),
        _ => HEX_FACES.into_iter().all(cuts),
    }
}

/// Merges the cubes of a mesh, see [`merged_elements`].
///
/// # Errors
/// As [`merged_elements`].
pub fn merge_cubes(
    mesh: &mut CandidateMesh,
    max_surface_triangles: usize,
    min_scaled_jacobian: f64,
    context: &RunContext,
) -> Result<()> {
    let merged = merged_elements(mesh, max_surface_triangles, min_scaled_jacobian, context)?;
    mesh.cubes.clear();
    (mesh.hexahedra, mesh.hexahedron_labels) = merged.hexahedra.into_iter().unzip();
    (mesh.pyramids, mesh.pyramid_labels) = merged.pyramids.into_iter().unzip();
    let mut kept = merged.is_kept.iter();
    mesh.tets.retain(|_| *kept.next().expect("one flag per tet"));
    let mut kept = merged.is_kept.iter();
    mesh.tet_labels.retain(|_| *kept.next().expect("one flag per tet"));
    drop_unused_points(mesh);
    Ok(())
}

fn pyramids_of<'a>(
    cube: &'a MergeableCube,
    cube_of: &'a [u32],
    is_merged: &'a [bool],
) -> impl Iterator<Item = [VertexId; 5]> + 'a {
    let is_open = |apex: VertexId| cube_of[apex.index()] == u32::MAX || !is_merged[cube_of[apex.index()] as usize];
    (0..6).filter(move |f| is_open(cube.apexes[*f])).map(|f| {
        let [a, b, c, d] = HEX_FACES[f].map(|v| cube.corners[v]);
        [a, b, c, d, cube.apexes[f]]
    })
}

/// The label of each cube whose 24 tets are all there and of one label.
fn labels_of_whole_cubes(mesh: &CandidateMesh, cubes: &[MergeableCube], cube_of: &[u32]) -> Vec<Option<Label>> {
    let mut counts = vec![(0u32, Label::BACKGROUND, true); cubes.len()];
    for (tet, label) in mesh.tets.iter().zip(&mesh.tet_labels) {
        for v in tet {
            let Some(c) = Some(cube_of[v.index()]).filter(|c| *c != u32::MAX) else { continue };
            let cube = &cubes[c as usize];
            // One of the four tets across a face: its apex, and the two ends of one of the face's edges. Improvement can make
            // 24 other tets of the same vertices.
            let is_of_face = |f: usize| {
                let on_face = |i: usize| tet.contains(&cube.corners[HEX_FACES[f][i]]);
                tet.contains(&cube.apexes[f]) && (0..4).any(|i| on_face(i) && on_face((i + 1) % 4))
            };
            let (count, first, is_whole) = &mut counts[c as usize];
            if *count == 0 {
                *first = *label;
            }
            *count += 1;
            *is_whole &= *first == *label && (0..6).any(is_of_face);
        }
    }
    let label = |(v, (count, label, is_whole)): (&MergeableCube, (u32, Label, bool))| {
        let is_fixed = mesh.fixed.contains(&v.center);
        (count == u32::from(TETS_AROUND_VERTEX) && is_whole && !is_fixed).then_some(label)
    };
    cubes.iter().zip(counts).map(label).collect()
}

fn drop_unused_points(mesh: &mut CandidateMesh) {
    let mut is_used = vec![false; mesh.points.len()];
    mesh.elements().for_each(|(nodes, _)| nodes.iter().for_each(|v| is_used[v.index()] = true));
    let mut renumbered = vec![VertexId::NONE; mesh.points.len()];
    let mut next = 0;
    for (v, used) in is_used.iter().enumerate() {
        if *used {
            renumbered[v] = VertexId::from_index(next);
            mesh.points[next] = mesh.points[v];
            next += 1;
        }
    }
    mesh.points.truncate(next);
    let number = |v: &mut VertexId| *v = renumbered[v.index()];
    mesh.tets.iter_mut().flatten().for_each(number);
    mesh.pyramids.iter_mut().flatten().for_each(number);
    mesh.hexahedra.iter_mut().flatten().for_each(number);
    mesh.fixed.iter_mut().for_each(number);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pyramid_with_a_base_as_warped_as_its_middle_is_high_is_none() {
        let with_warp = |warp: f64| {
            let up = DVec3::Z * warp;
            [DVec3::ZERO + up, DVec3::X - up, DVec3::new(1.0, 1.0, 0.0) + up, DVec3::Y - up, DVec3::new(0.5, 0.5, 0.5)]
        };
        // The middle is .1 above the base; the planes of the base's triangles pass .1 above it in its middle.
        for warp in [0.099, -0.099] {
            assert!(sees_its_faces(ElementKind::Pyramid, &with_warp(warp)));
        }
        for warp in [0.101, -0.101] {
            assert!(!sees_its_faces(ElementKind::Pyramid, &with_warp(warp)));
            assert!(pyramid_corner_jacobian(&with_warp(warp)) > 0.2);
        }
        let cube = CUBE.map(|c| c.as_dvec3());
        assert!(sees_its_faces(ElementKind::Hexahedron, &cube));
        let mut folded = cube;
        folded[0] = DVec3::splat(0.5);
        assert!(!sees_its_faces(ElementKind::Hexahedron, &folded));
    }
}
