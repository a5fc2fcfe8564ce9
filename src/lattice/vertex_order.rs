//! Renumbers the mesh under improvement so that neighbours in space are neighbours in memory.
//!
//! # Method
//! 1. Vertices with tets get their rank along a Hilbert curve; those without are dropped.
//! 2. Tets are sorted by the smallest rank of their vertices, by counting; dead slots are dropped.
//! 3. The tets of each vertex are listed anew, in the order of the vertices; surface stars and colors follow the new numbers.
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
//! A sort of the vertices; the rest is linear, of which the counting, the new numbers and the lists of tets run on one thread.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::spatial_sort::hilbert_order;
use crate::lattice::candidate_mesh::{CandidateMesh, GONE};
use crate::lattice::improvement_mesh::{ImprovementMesh, balls_of};
use crate::mesh::renumbering::{gathered, number_by_key};

/// Rows per parallel work item.
const CHUNK: usize = 4096;

impl ImprovementMesh<'_> {
    /// Renumbers vertices and tets, also in what `mesh` says of them. Not within a trial.
    ///
    /// # Errors
    /// As [`hilbert_order`]; [`crate::Error::Cancelled`], [`crate::Error::LimitReached`]: the mesh is not to be used then.
    pub fn renumber_along_curve(&mut self, mesh: &mut CandidateMesh, context: &RunContext) -> Result<()> {
        context.check()?;
        let mut old_vertices = hilbert_order(&self.points)?;
        context.check()?;
        old_vertices.retain(|v| !self.ball(*v).is_empty());
        let mut new_of = vec![GONE; self.points.len()];
        old_vertices.iter().zip(0..).for_each(|(old, new)| new_of[*old as usize] = new);
        context.check()?;
        let old_tets = self.tets_by_vertex(&new_of, old_vertices.len());
        let mut new_tet_of = vec![GONE; self.tets.len()];
        old_tets.iter().zip(0..).for_each(|(old, new)| new_tet_of[*old as usize] = new);
        context.check()?;
        self.balls = Vec::new();
        context.check()?;
        self.points = gathered(&self.points, &old_vertices);
        self.lattice = gathered(&self.lattice, &old_vertices);
        self.side_set = gathered(&self.side_set, &old_vertices);
        self.fixed = gathered(&self.fixed, &old_vertices);
        self.still = gathered(&self.still, &old_vertices);
        self.labels = gathered(&self.labels, &old_tets);
        self.tets = gathered(&self.tets, &old_tets);
        self.tets.par_iter_mut().with_min_len(CHUNK).for_each(|tet| *tet = tet.map(|v| new_of[v as usize]));
        context.check()?;
        self.free.clear();
        self.stars.renumber(&old_vertices, &new_of, &new_tet_of);
        self.balls = balls_of(&self.tets, self.points.len());
        mesh.renumber_records(&new_of);
        Ok(())
    }

    /// The live tets, sorted by the smallest new number of their vertices.
    fn tets_by_vertex(&self, new_of: &[u32], vertices: usize) -> Vec<u32> {
        let key = |t: u32| {
            let tet = self.tets[t as usize];
            // Dead slots come last.
            if self.is_live(t) {
                tet.into_iter().map(|v| new_of[v as usize]).fold(GONE, u32::min)
            } else {
                vertices as u32
            }
        };
        let mut keys: Vec<u32> = (0..self.tets.len() as u32).into_par_iter().with_min_len(CHUNK).map(key).collect();
        let (mut sorted, live) = number_by_key(&mut keys, vertices);
        sorted.truncate(live);
        sorted
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::{Label, VertexId};
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
        let context = RunContext::with_threads(1).unwrap();
        let surface = SubvoxelSurface::new(&image, &context).unwrap();
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
        work.renumber_along_curve(&mut mesh, &context).unwrap();
        assert_eq!(shapes(&work), before);
        assert_eq!((work.points.len(), work.tets.len()), (6, 3));
        assert_eq!(work.points[mesh.fixed[0].index()], DVec3::Y);
        for v in 0..6u32 {
            assert_eq!(work.place_in_lattice(v), Some(work.points[v as usize]));
            let has = |t: &u32| work.tets[*t as usize].contains(&v);
            assert_eq!(work.ball(v), (0..3).filter(has).collect::<Vec<u32>>());
        }
        assert!(work.tets.is_sorted_by_key(|tet| tet.iter().min().copied()));
        context.cancel_token().cancel();
        assert!(matches!(work.renumber_along_curve(&mut mesh, &context), Err(crate::Error::Cancelled)));
    }
}
