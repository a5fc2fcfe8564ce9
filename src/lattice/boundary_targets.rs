//! Surface vertices of the mesh and boundary points of the image that belong together.
//!
//! # Method
//! 1. Source points: vertices on a face whose two sides differ, each with the set of its sides: the labels around it, the
//!    background where a face has no element behind it, and the border planes where the image ends there.
//! 2. Target points: voxels with a face neighbour of another label, thinned by a non-connectivity pattern: no two chosen
//!    voxels touch through a vertex, an edge or a face. Even slices are thinned side by side, then the odd ones, which
//!    look at both neighbours: the same points for any number of threads.
//! 3. A target point fits a source point when its 26 neighbours hold the labels of the source point.
//!
//! # Source
//! [Drakopoulos2017] 2.3.5.
//!
//! # Differences
//! The thesis's points depend on the number of threads, ours do not. The label set of a target point is read from the image
//! when it is asked for.

use glam::DVec3;
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::label_image::LabelImage;
use crate::index::{Label, VertexId};
use crate::lattice::face_adjacency::OUTSIDE;
use crate::lattice::options::NonConnectivity;
use crate::lattice::subvoxel_surface::{Side, SubvoxelSurface};
use crate::mesh::numbering::TET_FACES;

/// Surface vertices with what they separate.
#[derive(Debug, Clone, Default)]
pub struct SourcePoints {
    /// Surface vertices in increasing order.
    pub vertices: Vec<VertexId>,
    /// Start of each vertex's sides, one more at the end.
    offsets: Vec<u32>,
    /// Sorted sides.
    sides: Vec<Side>,
    /// Position in `vertices` of every vertex of the mesh; `u32::MAX` inside.
    position: Vec<u32>,
}

impl SourcePoints {
    /// The surface vertices of tets with their face neighbours. Those on one of the border `planes`, along which the mesh and
    /// its scaffold were cut, have it among their sides, also where no face of the mesh is in the plane.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn new(
        points: &[DVec3],
        tets: &[[VertexId; 4]],
        labels: &[Label],
        neighbors: &[[u32; 4]],
        surface: &SubvoxelSurface,
        planes: &[u8],
        context: &RunContext,
    ) -> Result<Self> {
        // (vertex, side) pairs of all faces between different sides, by chunks in order.
        let all = (0..tets.len()).into_par_iter().with_min_len(4096);
        let mut pairs: Vec<(u32, Side)> = context
            .until_cancelled(all)
            .flat_map_iter(|t| {
                let mut found: [Option<(u32, Side)>; 24] = [None; 24];
                let mut count = 0;
                for f in 0..4 {
                    let behind = neighbors[t][f];
                    if behind != OUTSIDE && labels[behind as usize] == labels[t] {
                        continue;
                    }
                    let face = TET_FACES[f].map(|v| tets[t][v]);
                    let other = if behind == OUTSIDE {
                        outside_of(face.map(|v| points[v.index()]), surface)
                    } else {
                        Side::Label(labels[behind as usize])
                    };
                    for v in face {
                        found[count] = Some((v.0, Side::Label(labels[t])));
                        found[count + 1] = Some((v.0, other));
                        count += 2;
                    }
                }
                found.into_iter().flatten()
            })
            .collect();
        context.check()?;
        pairs.par_sort_unstable();
        context.check()?;
        pairs.dedup();
        let on_planes: Vec<(u32, Side)> = pairs
            .chunk_by(|a, b| a.0 == b.0)
            .flat_map(|of_vertex| {
                let v = of_vertex[0].0;
                let is_on = move |plane: &&u8| {
                    let (axis, at) = surface.border(**plane);
                    points[v as usize][axis] == at
                };
                planes.iter().filter(is_on).map(move |plane| (v, Side::Border(*plane)))
            })
            .collect();
        context.check()?;
        if !on_planes.is_empty() {
            pairs.extend(on_planes);
            pairs.par_sort_unstable();
            pairs.dedup();
            context.check()?;
        }
        let mut sources = Self { offsets: vec![0], position: vec![u32::MAX; points.len()], ..Self::default() };
        for (vertex, side) in pairs {
            if sources.vertices.last() != Some(&VertexId(vertex)) {
                if !sources.vertices.is_empty() {
                    sources.offsets.push(sources.sides.len() as u32);
                }
                sources.position[vertex as usize] = sources.vertices.len() as u32;
                sources.vertices.push(VertexId(vertex));
            }
            sources.sides.push(side);
        }
        if !sources.vertices.is_empty() {
            sources.offsets.push(sources.sides.len() as u32);
        }
        Ok(sources)
    }

    /// Sides of the source point of this position.
    pub fn sides(&self, position: usize) -> &[Side] {
        &self.sides[self.offsets[position] as usize..self.offsets[position + 1] as usize]
    }

    /// Position of a vertex among the source points; `None` inside of a label.
    pub fn position_of(&self, vertex: VertexId) -> Option<usize> {
        let at = self.position[vertex.index()];
        (at != u32::MAX).then_some(at as usize)
    }
}

/// What lies behind a face without an element: the end of the image where the face is in its plane, else the background.
fn outside_of(face: [DVec3; 3], surface: &SubvoxelSurface) -> Side {
    let is_on = |plane: &u8| {
        let (axis, at) = surface.border(*plane);
        face.iter().all(|p| p[axis] == at)
    };
    (0..6).find(is_on).map_or(Side::Label(Label::BACKGROUND), Side::Border)
}

/// Boundary voxels of an image, thinned.
#[derive(Debug, Clone, Default)]
pub struct TargetPoints {
    size: [usize; 3],
    /// Start of each row (j + nj k), one more at the end.
    rows: Vec<u32>,
    /// The i of each point.
    points: Vec<u32>,
}

impl TargetPoints {
    /// The target points of an image.
    pub fn new(image: &LabelImage, pattern: NonConnectivity) -> Self {
        let size = image.grid().size();
        let slices: Vec<Vec<Vec<u32>>> = (0..size[2]).into_par_iter().map(|k| boundary_slice(image, k)).collect();
        let thin = |k: usize, chosen: &[Option<Vec<Vec<u32>>>]| {
            let beside = [k.checked_sub(1), Some(k + 1)].map(|n| n.and_then(|n| chosen.get(n)?.as_ref()));
            thin_slice(&slices[k], beside, pattern)
        };
        let mut chosen: Vec<Option<Vec<Vec<u32>>>> = vec![None; size[2]];
        for parity in 0..2 {
            let done: Vec<(usize, Vec<Vec<u32>>)> =
                (0..size[2]).into_par_iter().filter(|k| k % 2 == parity).map(|k| (k, thin(k, &chosen))).collect();
            done.into_iter().for_each(|(k, slice)| chosen[k] = Some(slice));
        }
        let mut targets = Self { size, rows: vec![0], points: Vec::new() };
        for row in chosen.into_iter().flatten().flatten() {
            targets.points.extend(row);
            targets.rows.push(targets.points.len() as u32);
        }
        targets
    }

    /// Number of target points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether the image has no boundary.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// All target points as voxel indices.
    pub fn voxels(&self) -> impl Iterator<Item = [usize; 3]> + '_ {
        let nj = self.size[1];
        self.rows.windows(2).enumerate().flat_map(move |(row, w)| {
            self.points[w[0] as usize..w[1] as usize].iter().map(move |i| [*i as usize, row % nj, row / nj])
        })
    }

    /// The mean of the target points that fit `sides`, within `radius` (mm, local frame) of a point.
    pub fn mean_within(&self, image: &LabelImage, point: DVec3, radius: f64, sides: &[Side]) -> Option<DVec3> {
        let spacing = image.grid().spacing();
        let range = |axis: usize| {
            let low = ((point[axis] - radius) / spacing[axis]).ceil().max(0.0) as usize;
            let high = ((point[axis] + radius) / spacing[axis]).floor();
            low..if high < 0.0 { 0 } else { (high as usize + 1).min(self.size[axis]) }
        };
        let columns = range(0);
        let (mut sum, mut count) = (DVec3::ZERO, 0usize);
        for k in range(2) {
            for j in range(1) {
                let row = j + self.size[1] * k;
                let entries = &self.points[self.rows[row] as usize..self.rows[row + 1] as usize];
                let first = entries.partition_point(|i| (*i as usize) < columns.start);
                for i in entries[first..].iter().take_while(|i| (**i as usize) < columns.end) {
                    let at = DVec3::new(f64::from(*i), j as f64, k as f64) * spacing;
                    if at.distance_squared(point) <= radius * radius && fits(image, [*i as usize, j, k], sides) {
                        sum += at;
                        count += 1;
                    }
                }
            }
        }
        (count > 0).then(|| sum / count as f64)
    }
}

/// Voxels of slice k with a face neighbour of another label (outside of the image counts as background), by rows.
fn boundary_slice(image: &LabelImage, k: usize) -> Vec<Vec<u32>> {
    let [ni, nj, nk] = image.grid().size();
    let voxels = image.voxels();
    let at = |j: usize, k: usize| &voxels[ni * (j + nj * k)..ni * (j + nj * k + 1)];
    (0..nj)
        .map(|j| {
            let row = at(j, k);
            let beside = [
                (j > 0).then(|| at(j - 1, k)),
                (j + 1 < nj).then(|| at(j + 1, k)),
                (k > 0).then(|| at(j, k - 1)),
                (k + 1 < nk).then(|| at(j, k + 1)),
            ];
            (0..ni)
                .filter(|&i| {
                    let own = row[i];
                    if own.is_background() {
                        return false;
                    }
                    i == 0
                        || i + 1 == ni
                        || row[i - 1] != own
                        || row[i + 1] != own
                        || beside.iter().any(|r| r.is_none_or(|r| r[i] != own))
                })
                .map(|i| i as u32)
                .collect()
        })
        .collect()
}

/// Chooses points of a slice in order, leaving out those that touch one chosen before.
fn thin_slice(slice: &[Vec<u32>], beside: [Option<&Vec<Vec<u32>>>; 2], pattern: NonConnectivity) -> Vec<Vec<u32>> {
    // Largest sum of |di| + |dj| + |dk| (each at most 1) that counts as touching.
    let reach = match pattern {
        NonConnectivity::No => return slice.to_vec(),
        NonConnectivity::Face => 1,
        NonConnectivity::Edge => 2,
        NonConnectivity::Vertex => 3,
    };
    let mut chosen: Vec<Vec<u32>> = Vec::with_capacity(slice.len());
    for (j, row) in slice.iter().enumerate() {
        let mut kept: Vec<u32> = Vec::new();
        for &i in row {
            let touches = |other: Option<&Vec<u32>>, distance: u32| {
                other.is_some_and(|other| {
                    distance <= reach
                        && (i.saturating_sub(1)..=i + 1)
                            .any(|o| distance + o.abs_diff(i) <= reach && other.binary_search(&o).is_ok())
                })
            };
            let in_slice = touches(Some(&kept), 0) || (j > 0 && touches(chosen.get(j - 1), 1));
            let in_beside = beside.iter().flatten().any(|rows| {
                touches(rows.get(j), 1) || touches(rows.get(j + 1), 2) || (j > 0 && touches(rows.get(j - 1), 2))
            });
            if !in_slice && !in_beside {
                kept.push(i);
            }
        }
        chosen.push(kept);
    }
    chosen
}

/// Whether the 26 neighbours of a voxel (and itself) hold every label of `sides`.
fn fits(image: &LabelImage, [i, j, k]: [usize; 3], sides: &[Side]) -> bool {
    let size = image.grid().size();
    let around = |at: usize, axis: usize| at.saturating_sub(1)..(at + 2).min(size[axis]);
    let at_border = i == 0 || j == 0 || k == 0 || i + 1 == size[0] || j + 1 == size[1] || k + 1 == size[2];
    sides.iter().all(|side| match side {
        Side::Border(_) => at_border,
        Side::Label(label) => {
            (at_border && label.is_background())
                || around(k, 2).any(|k| around(j, 1).any(|j| around(i, 0).any(|i| image.at(i, j, k) == *label)))
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
    use crate::image::grid::Grid;
    use glam::DMat3;

    fn ball() -> LabelImage {
        let grid = Grid::new([20, 19, 18], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let mut voxels = Vec::new();
        for k in 0..18 {
            for j in 0..19 {
                for i in 0..20 {
                    let p = DVec3::new(f64::from(i), f64::from(j), f64::from(k));
                    voxels.push(Label(u16::from(p.distance(DVec3::splat(9.0)) < 7.0)));
                }
            }
        }
        LabelImage::new(grid, voxels, vec![0, 1]).unwrap()
    }

    #[test]
    fn patterns_keep_chosen_voxels_apart_for_any_number_of_threads() {
        let image = ball();
        let run = |pattern, threads| {
            let context = RunContext::with_threads(threads).unwrap();
            context.install(|| TargetPoints::new(&image, pattern).voxels().collect::<Vec<_>>())
        };
        let mut counts = Vec::new();
        for (pattern, reach) in [
            (NonConnectivity::Vertex, 3),
            (NonConnectivity::Edge, 2),
            (NonConnectivity::Face, 1),
            (NonConnectivity::No, 0),
        ] {
            let points = run(pattern, 1);
            assert_eq!(points, run(pattern, 3));
            for (n, a) in points.iter().enumerate() {
                for b in &points[n + 1..] {
                    let d: [usize; 3] = std::array::from_fn(|x| a[x].abs_diff(b[x]));
                    assert!(d.iter().any(|x| *x > 1) || d.iter().sum::<usize>() > reach, "{a:?} {b:?}");
                }
            }
            counts.push(points.len());
        }
        assert!(counts.is_sorted() && counts[0] > 50, "{counts:?}");
    }

    #[test]
    fn the_mean_of_targets_lies_near_the_boundary() {
        let image = ball();
        let targets = TargetPoints::new(&image, NonConnectivity::No);
        let sides = [Side::Label(Label(0)), Side::Label(Label(1))];
        let mean = targets.mean_within(&image, DVec3::new(17.0, 9.0, 9.0), 2.5, &sides).expect("targets are near");
        assert!((mean.x - 15.0).abs() < 1.0, "{mean}");
        assert!(targets.mean_within(&image, DVec3::splat(9.0), 2.0, &sides).is_none());
    }
}
