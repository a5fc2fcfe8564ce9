//! Renumbers the mesh under improvement so that neighbours in space are neighbours in memory.
//!
//! # Method
//! 1. Vertices with tets get their rank along a Hilbert curve; those without are dropped.
//! 2. Tets are sorted by the smallest rank of their vertices, by counting; dead slots are dropped.
//! 3. The tets of each vertex are listed anew, in the order of the vertices.
//!
//! New vertices and tets take numbers at the end: after a round of splits half of the vertices have tets far apart in memory.
//!
//! # Source
//! [AmentaChoiRote2003] for the curve; locality of unstructured meshes in general.
//!
//! # Invariants
//! The mesh is the same up to numbers. The result does not depend on the number of threads.
//!
//! # Cost
//! About 0.3 s a million vertices and 0.1 s a million tets.

use rayon::prelude::*;

use crate::error::Result;
use crate::geometry::spatial_sort::hilbert_order;
use crate::index::VertexId;
use crate::lattice::candidate_mesh::{CandidateMesh, MergeableCube};
use crate::lattice::improvement_mesh::{ImprovementMesh, balls_of};
use crate::lattice::surface_stars::SurfaceStars;

/// Rows per parallel work item.
const CHUNK: usize = 4096;

/// A vertex or tet that is gone.
const GONE: u32 = u32::MAX;

impl ImprovementMesh<'_> {
    /// Renumbers vertices and tets, also in what `mesh` says of them. Not within a trial.
    ///
    /// # Errors
    /// As [`hilbert_order`].
    pub fn renumber_along_curve(&mut self, mesh: &mut CandidateMesh) -> Result<()> {
        let mut old_vertices = hilbert_order(&self.points)?;
        old_vertices.retain(|v| !self.ball(*v).is_empty());
        let mut new_of = vec![GONE; self.points.len()];
        old_vertices.iter().zip(0..).for_each(|(old, new)| new_of[*old as usize] = new);
        let old_tets = self.tets_by_vertex(&new_of, old_vertices.len());
        self.balls = Vec::new();
        self.points = taken(&self.points, &old_vertices);
        self.lattice = taken(&self.lattice, &old_vertices);
        self.side_set = taken(&self.side_set, &old_vertices);
        self.fixed = taken(&self.fixed, &old_vertices);
        self.still = taken(&self.still, &old_vertices);
        self.labels = taken(&self.labels, &old_tets);
        self.tets = taken(&self.tets, &old_tets);
        self.tets.par_iter_mut().with_min_len(CHUNK).for_each(|tet| *tet = tet.map(|v| new_of[v as usize]));
        self.free.clear();
        self.stars = SurfaceStars::new(self.points.len());
        self.balls = balls_of(&self.tets, self.points.len());
        renumber_records(mesh, &new_of);
        Ok(())
    }

    /// The live tets, sorted by the smallest new number of their vertices.
    fn tets_by_vertex(&self, new_of: &[u32], vertices: usize) -> Vec<u32> {
        let key = |t: u32| {
            let tet = self.tets[t as usize];
            if self.is_live(t) { tet.into_iter().map(|v| new_of[v as usize]).fold(GONE, u32::min) } else { GONE }
        };
        let keys: Vec<u32> = (0..self.tets.len() as u32).into_par_iter().with_min_len(CHUNK).map(key).collect();
        let mut starts = vec![0u32; vertices + 1];
        keys.iter().filter(|key| **key != GONE).for_each(|key| starts[*key as usize + 1] += 1);
        (0..vertices).for_each(|v| starts[v + 1] += starts[v]);
        let mut sorted = vec![0; starts[vertices] as usize];
        for (t, key) in (0..).zip(keys).filter(|(_, key)| *key != GONE) {
            let next = &mut starts[key as usize];
            sorted[*next as usize] = t;
            *next += 1;
        }
        sorted
    }
}

/// Follows new numbers in what a mesh says of single vertices; cubes that lost a vertex go.
pub fn renumber_records(mesh: &mut CandidateMesh, new_of: &[u32]) {
    let number = |v: &mut VertexId| *v = VertexId(new_of[v.index()]);
    mesh.fixed.iter_mut().for_each(number);
    let vertices = |c: &MergeableCube| [&[c.center], &c.corners[..], &c.apexes[..]].concat();
    mesh.cubes.retain(|c| vertices(c).iter().all(|v| new_of[v.index()] != GONE));
    for cube in &mut mesh.cubes {
        number(&mut cube.center);
        cube.corners.iter_mut().for_each(number);
        cube.apexes.iter_mut().for_each(number);
    }
}

fn taken<T: Copy + Send + Sync>(values: &[T], from: &[u32]) -> Vec<T> {
    from.par_iter().with_min_len(CHUNK).map(|at| values[*at as usize]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
    use crate::index::Label;
    use crate::lattice::boundary_targets::SourcePoints;
    use crate::lattice::subvoxel_surface::SubvoxelSurface;
    use crate::lattice::test_images::voxel_image;
    use glam::DVec3;

    #[test]
    fn renumbering_keeps_tets_labels_and_records_and_drops_what_is_gone() {
        // An octahedron of four tets around its axis; numbers run against the curve, vertex 3 has no tet.
        let points = [DVec3::Z, DVec3::NEG_Z, DVec3::X, DVec3::splat(9.0), DVec3::Y, DVec3::NEG_X, DVec3::NEG_Y];
        let ring = [2, 4, 5, 6];
        let tets = (0..4).map(|i| [1, 0, ring[i], ring[(i + 1) % 4]].map(VertexId)).collect();
        let mut mesh = CandidateMesh {
            points: points.to_vec(),
            tets,
            tet_labels: [1, 2, 1, 2].map(Label).to_vec(),
            fixed: vec![VertexId(4)],
            ..CandidateMesh::default()
        };
        let image = voxel_image(4, |_| 1);
        let surface = SubvoxelSurface::new(&image, &RunContext::with_threads(1).unwrap()).unwrap();
        let mut work = ImprovementMesh::new(&mut mesh, &SourcePoints::default(), surface);
        work.set_lattice(points.to_vec());
        work.replace(&[2], &[]);
        let shapes = |work: &ImprovementMesh| {
            let live = (0..work.tets.len() as u32).filter(|t| work.is_live(*t));
            let shape = |t: u32| (work.corners(t).map(|p| p.to_array()), work.labels[t as usize]);
            let mut shapes: Vec<_> = live.map(shape).collect();
            shapes.sort_by(|l, r| l.partial_cmp(r).unwrap());
            shapes
        };
        let before = shapes(&work);
        work.renumber_along_curve(&mut mesh).unwrap();
        assert_eq!(shapes(&work), before);
        assert_eq!((work.points.len(), work.tets.len()), (6, 3));
        assert_eq!(work.points[mesh.fixed[0].index()], DVec3::Y);
        for v in 0..6u32 {
            assert_eq!(work.place_in_lattice(v), Some(work.points[v as usize]));
            let has = |t: &u32| work.tets[*t as usize].contains(&v);
            assert_eq!(work.ball(v), (0..3).filter(has).collect::<Vec<u32>>());
        }
        assert!(work.tets.is_sorted_by_key(|tet| tet.iter().min().copied()));
    }
}
