//! Which element lies behind each face of a set of tets.
//!
//! # Method
//! 1. Each chunk of tets sorts its faces into buckets of their largest vertex.
//! 2. Each bucket sorts its faces by vertices; equal neighbours are the two sides of a face.
//!
//! # Invariants
//! A face has one or two tets; a third one is an internal error found here.
//!
//! # Cost
//! 16 bytes a face for the time of the call; parallel, the same result for any number of threads.

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::mesh::numbering::TET_FACES;
use crate::parallel::shared_rows::SharedWords;

/// No element behind a face.
pub const OUTSIDE: u32 = u32::MAX;

/// Tets per parallel work item.
const CHUNK: usize = 1 << 15;

/// Buckets: few enough to be filled in cache, small enough to be sorted in cache at millions of tets.
const BUCKETS: usize = 256;

#[derive(Clone, Copy, Default)]
struct Side {
    /// Largest vertex in the high half, middle vertex in the low half.
    key: u64,
    smallest: u32,
    /// `4 * tet + face`, modulo 2^32 only for the face number; tets are below 2^30.
    side: u32,
}

/// For each face of each tet (opposite to the vertex of the same number) the tet behind it, or [`OUTSIDE`].
///
/// # Errors
/// [`Error::CapacityExceeded`] past 2^30 tets; [`Error::Internal`] for a face with three tets.
pub fn neighbors_of(tets: &[[u32; 4]], vertex_count: usize) -> Result<Vec<[u32; 4]>> {
    if tets.len() >= 1 << 30 {
        return Err(Error::CapacityExceeded { what: "tets", needed: tets.len() as u64, limit: 1 << 30 });
    }
    let width = vertex_count.div_ceil(BUCKETS).max(1);
    let chunks: Vec<(Vec<Side>, Vec<u32>)> =
        tets.par_chunks(CHUNK).enumerate().map(|(c, chunk)| bucketed(chunk, c * CHUNK, width)).collect();
    let pairs: Vec<Vec<[u32; 2]>> = (0..BUCKETS).into_par_iter().map(|b| matched(&chunks, b)).collect::<Result<_>>()?;
    drop(chunks);
    let mut neighbors = vec![[OUTSIDE; 4]; tets.len()];
    // Each side of a face is written once: the same result in any order.
    let rows = SharedWords::new(neighbors.as_flattened_mut());
    pairs.into_par_iter().flatten_iter().for_each(|[a, b]| {
        rows.store(a as usize, b >> 2);
        rows.store(b as usize, a >> 2);
    });
    Ok(neighbors)
}

fn bucketed(tets: &[[u32; 4]], first: usize, width: usize) -> (Vec<Side>, Vec<u32>) {
    let mut starts = vec![0u32; BUCKETS + 1];
    for tet in tets {
        for face in TET_FACES {
            starts[face.map(|v| tet[v]).into_iter().fold(0, u32::max) as usize / width + 1] += 1;
        }
    }
    for b in 0..BUCKETS {
        starts[b + 1] += starts[b];
    }
    let mut next = starts.clone();
    let mut sides = vec![Side::default(); 4 * tets.len()];
    for (t, tet) in tets.iter().enumerate() {
        for (f, face) in TET_FACES.into_iter().enumerate() {
            let mut v = face.map(|v| tet[v]);
            v.sort_unstable();
            let position = &mut next[v[2] as usize / width];
            let side = (((first + t) << 2) | f) as u32;
            sides[*position as usize] = Side { key: u64::from(v[2]) << 32 | u64::from(v[1]), smallest: v[0], side };
            *position += 1;
        }
    }
    (sides, starts)
}

fn matched(chunks: &[(Vec<Side>, Vec<u32>)], bucket: usize) -> Result<Vec<[u32; 2]>> {
    let slice = |(sides, starts): &'_ (Vec<Side>, Vec<u32>)| -> Vec<Side> {
        sides[starts[bucket] as usize..starts[bucket + 1] as usize].to_vec()
    };
    let mut sides: Vec<Side> = chunks.iter().flat_map(slice).collect();
    sides.sort_unstable_by_key(|s| (s.key, s.smallest, s.side));
    let mut pairs = Vec::with_capacity(sides.len() / 2);
    for face in sides.chunk_by(|a, b| (a.key, a.smallest) == (b.key, b.smallest)) {
        match face {
            [_] => {}
            [a, b] => pairs.push([a.side, b.side]),
            _ => {
                let reason = format!("tet {} shares a face with more than one tet", face[0].side >> 2);
                return Err(Error::Internal { reason });
            }
        }
    }
    Ok(pairs)
}
