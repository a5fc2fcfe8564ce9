//! Numbers for the tets of a Delaunay mesh that do not depend on the order in which they were made.
//!
//! # Method
//! 1. Every row is turned, keeping its orientation, so that its vertices rise but for the last two; the ghost is last.
//! 2. The rows are sorted: by counting for the first vertex, the few with the same first vertex by the others.
//! 3. Neighbours follow: the new number of the tet, and the new place of the face in it.
//!
//! # Invariants
//! The set of tets is the same before and after; equal sets get equal rows in equal order.
//!
//! # Cost
//! 9 B a tet beside a second copy of one half of the rows. Vertex ids are places on the curve, so that tets side by
//! side in space come to stand side by side in memory.

use rayon::prelude::*;

use crate::index::{TetFace, TetId};

/// For each turned row the places that its vertices had, packed two bits each.
fn turn(row: [u32; 4]) -> ([u32; 4], u8) {
    let mut places = [0u8, 1, 2, 3];
    let mut is_even = true;
    for end in (1..4).rev() {
        for i in 0..end {
            if row[usize::from(places[i])] > row[usize::from(places[i + 1])] {
                places.swap(i, i + 1);
                is_even = !is_even;
            }
        }
    }
    if !is_even {
        places.swap(2, 3);
    }
    (places.map(|p| row[usize::from(p)]), places[0] | places[1] << 2 | places[2] << 4 | places[3] << 6)
}

fn place(packed: u8, new: usize) -> usize {
    usize::from(packed >> (2 * new) & 3)
}

/// Renumbers `tets` rows of two halves each (vertices, neighbours), without free slots, over `vertices` ids.
pub(super) fn renumber(halves: &mut [[u32; 4]], vertices: usize) {
    let tets = halves.len() / 2;
    let mut turns = vec![0u8; tets];
    halves.par_chunks_mut(2).zip(turns.par_iter_mut()).for_each(|(row, turned)| (row[0], *turned) = turn(row[0]));
    let order = sorted_order(halves, vertices);
    let mut new_number = vec![0u32; tets];
    for (new, &old) in order.iter().enumerate() {
        new_number[old as usize] = new as u32;
    }
    let rows = &*halves;
    let moved: Vec<[u32; 4]> = order.par_iter().map(|&old| rows[2 * old as usize]).collect();
    halves.par_chunks_mut(2).zip(moved.par_iter()).for_each(|(row, vertices)| row[0] = *vertices);
    drop(moved);
    let rows = &*halves;
    let neighbors_of = |&old: &u32| {
        let (old, mut neighbors) = (old as usize, [0; 4]);
        for face in 0..4 {
            let side = TetFace(rows[2 * old + 1][place(turns[old], face)]);
            let other = side.tet().index();
            let other_face = (0..4).find(|&f| place(turns[other], f) == side.face());
            let tet = TetId(new_number[other]);
            neighbors[face] = TetFace::new(tet, other_face.expect("a turn has all four places")).0;
        }
        neighbors
    };
    let moved: Vec<[u32; 4]> = order.par_iter().map(neighbors_of).collect();
    halves.par_chunks_mut(2).zip(moved.par_iter()).for_each(|(row, neighbors)| row[1] = *neighbors);
}

/// Step 2: the old numbers in the new order.
fn sorted_order(halves: &[[u32; 4]], vertices: usize) -> Vec<u32> {
    let mut ends = vec![0u32; vertices + 1];
    for row in halves.chunks_exact(2) {
        ends[row[0][0] as usize + 1] += 1;
    }
    for v in 0..vertices {
        ends[v + 1] += ends[v];
    }
    let mut order = vec![0u32; halves.len() / 2];
    for (tet, row) in halves.chunks_exact(2).enumerate() {
        let next = &mut ends[row[0][0] as usize];
        order[*next as usize] = tet as u32;
        *next += 1;
    }
    // Each entry is now the end of its vertex's part.
    let mut rest = order.as_mut_slice();
    let mut begin = 0;
    let mut parts = Vec::with_capacity(vertices);
    for &end in &ends[..vertices] {
        let (part, after) = rest.split_at_mut((end - begin) as usize);
        parts.push(part);
        (rest, begin) = (after, end);
    }
    parts.into_par_iter().for_each(|part| part.sort_unstable_by_key(|&tet| halves[2 * tet as usize]));
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turned_rows_rise_and_keep_their_orientation() {
        let mut seen = Vec::new();
        for code in 0..256u32 {
            let row = [code & 3, code >> 2 & 3, code >> 4 & 3, code >> 6];
            let mut sorted = row;
            sorted.sort_unstable();
            if sorted != [0, 1, 2, 3] {
                continue;
            }
            let (turned, packed) = turn(row);
            assert!((0..4).all(|i| turned[i] == row[place(packed, i)]));
            let swaps = (0..4).flat_map(|j| (0..j).map(move |i| (i, j))).filter(|&(i, j)| row[i] > row[j]).count();
            seen.push(turned);
            assert_eq!(turned, if swaps % 2 == 0 { [0, 1, 2, 3] } else { [0, 1, 3, 2] });
        }
        assert_eq!(seen.len(), 24);
    }
}
