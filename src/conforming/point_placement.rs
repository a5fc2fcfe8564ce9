//! Ideal points ahead of the front: what an equilateral tet on each front face would need.
//!
//! # Method
//! ```text
//!            p            p = centroid + n * sqrt(2/3) * length,   length = average size of the corners,
//!           /:\               at most cdfr times the average edge of the face
//!          / : \          Two front faces of one tet whose points would stand too close give one point between them.
//!         a--o--c
//!           b
//! ```
//! # Source
//! [Drakopoulos2017] 4.7.1 (point creation), figure 65; B.3 `cdfr`, `cdfn`, `pivot`.
//!
//! # Cost
//! Linear in the active tets, parallel over fixed chunks, deterministic.

use glam::DVec3;
use rayon::prelude::*;

use super::front::is_front;
use crate::index::{TetFace, TetId};
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;

/// Height of the regular tet over its edge.
const EQUILATERAL_HEIGHT: f64 = 0.816_496_580_927_726;
/// Tets per parallel chunk.
const CHUNK: usize = 512;

/// A point that may become a vertex.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Where.
    pub point: DVec3,
    /// Length scale it was advanced with: an upper bound of its size.
    pub scale: f64,
    /// The tet whose front face it advances from.
    pub tet: TetId,
}

/// How points are placed.
#[derive(Debug, Clone, Copy)]
pub struct Placement {
    /// `cdfr`: largest ratio of the length scale to the face's average edge.
    pub growth_rate: f64,
    /// `cdfn`: points closer than this times their scale are merged within a tet.
    pub near_factor: f64,
    /// `pivot`: normals from the two shortest edges of the face.
    pub accurate_normals: bool,
}

/// The candidates of all active tets, in the order of the list.
pub fn create_candidates(complex: &TetComplex, sizes: &[f64], active: &[TetId], how: &Placement) -> Vec<Candidate> {
    active
        .par_chunks(CHUNK)
        .flat_map_iter(|chunk| {
            let mut found = Vec::new();
            for &tet in chunk {
                place_in_tet(complex, sizes, tet, how, &mut found);
            }
            found
        })
        .collect()
}

fn place_in_tet(complex: &TetComplex, sizes: &[f64], tet: TetId, how: &Placement, found: &mut Vec<Candidate>) {
    let mut points = [Candidate { point: DVec3::ZERO, scale: 0.0, tet }; 4];
    let mut count = 0;
    for face in 0..4 {
        let side = TetFace::new(tet, face);
        if is_front(complex, side)
            && let Some((point, scale)) = advance(complex, sizes, side, how)
        {
            points[count] = Candidate { point, scale, tet };
            count += 1;
        }
    }
    // Average what would stand too close: each point joins the first group that is near enough.
    let mut groups: [(DVec3, f64, f64); 4] = [(DVec3::ZERO, 0.0, 0.0); 4];
    let mut used = 0;
    for candidate in &points[..count] {
        let near = groups[..used].iter_mut().find(|(sum, scale, members)| {
            let limit = how.near_factor * candidate.scale.max(*scale / *members);
            (*sum / *members).distance_squared(candidate.point) < limit * limit
        });
        match near {
            Some((sum, scale, members)) => {
                *sum += candidate.point;
                *scale += candidate.scale;
                *members += 1.0;
            }
            None => {
                groups[used] = (candidate.point, candidate.scale, 1.0);
                used += 1;
            }
        }
    }
    found.extend(groups[..used].iter().map(|(sum, scale, members)| Candidate {
        point: *sum / *members,
        scale: *scale / *members,
        tet,
    }));
}

/// The point ahead of a face and its length scale; `None` for a face of no area.
fn advance(complex: &TetComplex, sizes: &[f64], side: TetFace, how: &Placement) -> Option<(DVec3, f64)> {
    let vertices = complex.face_vertices(side);
    let [a, b, c] = complex.triangle(vertices);
    let edges = [b - a, c - b, a - c];
    let lengths = [edges[0].length(), edges[1].length(), edges[2].length()];
    // Outward from the tet, so the point lies against it.
    let normal = if how.accurate_normals {
        let longest = (0..3).max_by(|&i, &j| lengths[i].total_cmp(&lengths[j])).unwrap_or(0);
        edges[(longest + 1) % 3].cross(edges[(longest + 2) % 3])
    } else {
        edges[0].cross(edges[1])
    };
    let normal = normal.try_normalize()?;
    let average_size = vertices.iter().map(|v| sizes[v.index()]).sum::<f64>() / 3.0;
    let average_edge = lengths.iter().sum::<f64>() / 3.0;
    let scale = average_size.min(how.growth_rate * average_edge);
    let point = (a + b + c) / 3.0 - EQUILATERAL_HEIGHT * scale * normal;
    point.is_finite().then_some((point, scale))
}
