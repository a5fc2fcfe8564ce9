//! The elements around each vertex of the lattice, followed while some of them are cut.
//!
//! # Method
//! Listed by counting. Once elements have changed in their places and others have come at the end, the vertices of these get new rows
//! at the end of the array; what was theirs stays unused.
//!
//! # Invariants
//! The elements around a vertex are increasing.
//!
//! # Cost
//! 9 bytes a vertex, 16 an element; the listing runs on one thread.

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::face_adjacency::OUTSIDE;
use crate::mesh::numbering::TET_FACES;

/// Elements between two looks at whether the run is cancelled.
const ELEMENTS_PER_CHECK: usize = 1 << 16;

/// Elements by vertex.
pub struct VertexBalls {
    /// The first element of each vertex, and how many.
    rows: Vec<[u32; 2]>,
    elements: Vec<u32>,
    /// Whether a face at the vertex has nothing behind it.
    open: Vec<bool>,
}

impl VertexBalls {
    /// The balls of all vertices.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn new(tets: &[[u32; 4]], neighbors: &[[u32; 4]], vertex_count: usize, context: &RunContext) -> Result<Self> {
        let mut rows = vec![[0u32; 2]; vertex_count];
        for (e, tet) in tets.iter().enumerate() {
            context.check_every(ELEMENTS_PER_CHECK, e)?;
            tet.iter().for_each(|v| rows[*v as usize][1] += 1);
        }
        let mut first = 0;
        for row in &mut rows {
            let count = std::mem::take(&mut row[1]);
            row[0] = first;
            first += count;
        }
        let mut elements = vec![0u32; 4 * tets.len()];
        for (e, tet) in tets.iter().enumerate() {
            context.check_every(ELEMENTS_PER_CHECK, e)?;
            for v in tet {
                let [first, count] = &mut rows[*v as usize];
                elements[(*first + *count) as usize] = e as u32;
                *count += 1;
            }
        }
        context.check()?;
        let mut balls = Self { rows, elements, open: vec![false; vertex_count] };
        (0..tets.len()).for_each(|e| balls.open_at(&tets[e], &neighbors[e]));
        Ok(balls)
    }

    /// Follows elements that have changed in their places and others that have come at the end, `changed` in order; no vertex of one
    /// that was cut has left all of its parts.
    pub fn update(&mut self, tets: &[[u32; 4]], neighbors: &[[u32; 4]], changed: &[u32], vertex_count: usize) {
        self.rows.resize(vertex_count, [0; 2]);
        self.open.resize(vertex_count, false);
        let mut vertices: Vec<u32> = changed.iter().flat_map(|e| tets[*e as usize]).collect();
        vertices.sort_unstable();
        vertices.dedup();
        let place = |v: u32| vertices.binary_search(&v).unwrap_or(usize::MAX);
        let mut around: Vec<Vec<u32>> = vertices.iter().map(|v| self.of(*v).to_vec()).collect();
        around.iter_mut().for_each(|ball| ball.retain(|e| changed.binary_search(e).is_err()));
        for e in changed {
            tets[*e as usize].iter().for_each(|v| around[place(*v)].push(*e));
            self.open_at(&tets[*e as usize], &neighbors[*e as usize]);
        }
        for (v, mut ball) in vertices.into_iter().zip(around) {
            ball.sort_unstable();
            self.rows[v as usize] = [self.elements.len() as u32, ball.len() as u32];
            self.elements.extend(ball);
        }
    }

    fn open_at(&mut self, tet: &[u32; 4], row: &[u32; 4]) {
        for (face, _) in TET_FACES.iter().zip(row).filter(|(_, near)| **near == OUTSIDE) {
            face.iter().for_each(|v| self.open[tet[*v] as usize] = true);
        }
    }

    /// Number of vertices.
    pub fn vertex_count(&self) -> usize {
        self.rows.len()
    }

    /// Elements around a vertex, increasing.
    #[inline]
    pub fn of(&self, vertex: u32) -> &[u32] {
        let [first, count] = self.rows[vertex as usize];
        &self.elements[first as usize..][..count as usize]
    }

    /// Whether a face at the vertex has nothing behind it.
    #[inline]
    pub fn is_open(&self, vertex: u32) -> bool {
        self.open[vertex as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::face_adjacency::neighbors_of;

    #[test]
    fn balls_that_follow_are_those_found_anew() {
        let context = RunContext::with_threads(1).unwrap();
        // Four tets around the edge 0 1, of which some are cut at a vertex of their own, and then one of its parts again.
        let mut tets = vec![[0, 1, 2, 3], [0, 1, 3, 4], [0, 1, 4, 5], [0, 1, 5, 2]];
        let mut vertices = 6;
        let mut neighbors = neighbors_of(&tets, vertices, &context).unwrap();
        let mut balls = VertexBalls::new(&tets, &neighbors, vertices, &context).unwrap();
        assert_eq!((balls.of(0), balls.of(3)), ([0, 1, 2, 3].as_slice(), [0, 1].as_slice()));
        for cut in [vec![0u32, 2], vec![4]] {
            let mut changed = cut.clone();
            changed.extend(tets.len() as u32..(tets.len() + 3 * cut.len()) as u32);
            for t in cut {
                let ([a, b, c, d], middle) = (tets[t as usize], vertices as u32);
                tets[t as usize] = [a, b, c, middle];
                tets.extend([[a, b, middle, d], [a, middle, c, d], [middle, b, c, d]]);
                vertices += 1;
            }
            neighbors = neighbors_of(&tets, vertices, &context).unwrap();
            balls.update(&tets, &neighbors, &changed, vertices);
            let anew = VertexBalls::new(&tets, &neighbors, vertices, &context).unwrap();
            assert_eq!(balls.vertex_count(), vertices);
            for v in 0..vertices as u32 {
                assert_eq!((balls.of(v), balls.is_open(v)), (anew.of(v), anew.is_open(v)), "{v}");
            }
        }
        assert!(!balls.is_open(6) && balls.is_open(0));
        context.cancel_token().cancel();
        let cancelled = VertexBalls::new(&tets, &neighbors, vertices, &context);
        assert!(matches!(cancelled, Err(crate::Error::Cancelled)));
    }
}
