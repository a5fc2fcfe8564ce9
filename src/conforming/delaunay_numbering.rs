//! Numbers for the tets of a Delaunay mesh that do not depend on the order in which they were made.
//!
//! # Method
//! 1. Vertices are renamed by their places in the order of insertion, the ghost to 0, and every row is turned, keeping its
//!    orientation, so that its vertices fall but for the last two.
//! 2. The rows are dealt to groups by the first vertex of the turned row; the few of a group are sorted by the others.
//! 3. Each old row learns the new numbers of its four sides; then the neighbour entries are looked up in those of the
//!    neighbours, and the rows go to their new places. Free slots are left out.
//!
//! A tet is made when the last of its vertices is inserted, so that its group stands near its old slot: the order depends
//! on the set of tets only, and nearly every access is near the one before. Groups by places on the curve were no faster.
//!
//! # Invariants
//! The set of tets is the same before and after; equal sets get equal rows in equal order.
//!
//! # Cost
//! 16 B a tet and 16 B a vertex beside the rows. Most tets are made in the last round, along the curve, so that tets side by
//! side in space come to stand side by side in memory.

use std::ops::Range;

use rayon::prelude::*;

use crate::index::{TetFace, VertexId};
use crate::parallel::pieces::pieces;
use crate::parallel::shared_rows::SharedWords;

/// Rows a thread takes at a time.
const CHUNK: usize = 1 << 14;

/// What the ghost is called here: it comes after all vertices.
const GHOST: u32 = 0;

/// Vertices of a free slot; its neighbours are not looked at.
const FREE: [u32; 4] = [GHOST; 4];

/// A tet of a group: the last three vertices of its turned row, and its old number.
type Record = [u32; 4];

/// The turned row; its first vertex is the largest.
#[inline]
fn turn(row: [u32; 4]) -> [u32; 4] {
    let [mut a, mut b, mut c, mut d] = row;
    let mut is_odd = false;
    let mut sort = |x: &mut u32, y: &mut u32| {
        let swap = *x < *y;
        is_odd ^= swap;
        (*x, *y) = if swap { (*y, *x) } else { (*x, *y) };
    };
    sort(&mut a, &mut b);
    sort(&mut c, &mut d);
    sort(&mut a, &mut c);
    sort(&mut b, &mut d);
    sort(&mut b, &mut c);
    if is_odd { [a, b, d, c] } else { [a, b, c, d] }
}

/// One number that sorts as a record does, the first entry first.
#[inline]
fn sort_key([a, b, c, old]: Record) -> u128 {
    u128::from(a) << 96 | u128::from(b) << 64 | u128::from(c) << 32 | u128::from(old)
}

#[inline]
fn record_of(key: u128) -> Record {
    [(key >> 96) as u32, (key >> 64) as u32, (key >> 32) as u32, key as u32]
}

/// Names of the vertices before, meanwhile and after.
pub(super) struct VertexNames<'a> {
    /// For each id in the rows, one more than its place in the order of insertion.
    pub places: &'a [u32],
    /// For each of these the id to be given in the end; first that of the ghost.
    pub names: &'a [u32],
}

/// Renumbers the rows of two halves each (vertices, neighbours) that follow one half of padding, and takes the free slots
/// out.
pub(super) fn renumber(halves: &mut Vec<[u32; 4]>, vertices: &VertexNames<'_>) {
    let VertexNames { places, names } = *vertices;
    let place = |v: u32| if v == VertexId::GHOST.0 { GHOST } else { places[v as usize] };
    halves[1..].par_chunks_exact_mut(2).with_min_len(CHUNK).for_each(|row| row[0] = row[0].map(place));
    let starts = group_starts(halves, names.len());
    let mut records = sorted_records(halves, &starts);
    let words = SharedWords::new(halves.as_flattened_mut());
    leave_new_sides(words, &records);
    follow_neighbors(words);
    // From here on the first halves are free for the vertices, in the new order.
    let rows = halves[1..].par_chunks_mut(2 * CHUNK).zip(records.par_chunks(CHUNK)).enumerate();
    rows.for_each(|(chunk, (rows, records))| {
        let begin = chunk * CHUNK;
        let mut first = starts.partition_point(|&start| start as usize <= begin) - 1;
        for (position, (row, &key)) in (begin..).zip(rows.chunks_exact_mut(2).zip(records)) {
            while starts[first + 1] as usize <= position {
                first += 1;
            }
            let [b, c, d, _] = record_of(key);
            row[0] = [first as u32, b, c, d].map(|v| names[v as usize]);
        }
    });
    // The neighbours by way of the records, whose numbers are not needed any more.
    let old_rows = &*halves;
    let fetch = |key: &mut u128| *key = bytemuck::cast(old_rows[2 * record_of(*key)[3] as usize + 2]);
    records.par_iter_mut().with_min_len(CHUNK).for_each(fetch);
    halves.truncate(2 * records.len() + 1);
    let rows = halves[1..].par_chunks_exact_mut(2).zip(records.par_iter()).with_min_len(CHUNK);
    rows.for_each(|(row, neighbors)| row[1] = bytemuck::cast(*neighbors));
    halves.shrink_to_fit();
}

/// Parts of the vertices, one for each thread, with what of `entries` belongs to each: as many as `count` says of a range.
fn parts<T>(
    vertices: usize,
    entries: &mut [T],
    count: impl Fn(&Range<usize>) -> usize,
) -> Vec<(Range<usize>, &mut [T])> {
    let length = vertices.div_ceil(rayon::current_num_threads()).max(1);
    let ranges = || (0..vertices).step_by(length).map(|begin| begin..(begin + length).min(vertices));
    ranges().zip(pieces(entries, ranges().map(|range| count(&range)))).collect()
}

/// The vertices of all rows that are not free, with their old numbers.
fn live_rows(halves: &[[u32; 4]]) -> impl Iterator<Item = (usize, [u32; 4])> + '_ {
    halves[1..].chunks_exact(2).map(|row| row[0]).enumerate().filter(|(_, row)| *row != FREE)
}

/// Where the group of each vertex begins, and the end of the last.
fn group_starts(halves: &[[u32; 4]], vertices: usize) -> Vec<u32> {
    let mut starts = vec![0u32; vertices + 1];
    let jobs = parts(vertices, &mut starts[1..], |range| range.len());
    // Each thread looks at all rows and counts those of its own vertices: the rows are read in a row, and no count is shared.
    jobs.into_par_iter().for_each(|(range, counts)| {
        for (_, [a, b, c, d]) in live_rows(halves) {
            let first = a.max(b).max(c.max(d)) as usize;
            if range.contains(&first) {
                counts[first - range.start] += 1;
            }
        }
    });
    for v in 0..vertices {
        starts[v + 1] += starts[v];
    }
    starts
}

/// Steps 1 and 2: the records of all groups, as sort keys.
fn sorted_records(halves: &[[u32; 4]], starts: &[u32]) -> Vec<u128> {
    let vertices = starts.len() - 1;
    let mut records = vec![0u128; starts[vertices] as usize];
    let jobs = parts(vertices, &mut records, |range| (starts[range.end] - starts[range.start]) as usize);
    jobs.into_par_iter().for_each(|(range, records)| {
        let begin = starts[range.start];
        let mut next: Vec<u32> = starts[range.clone()].iter().map(|start| start - begin).collect();
        for (old, row) in live_rows(halves) {
            let [a, b, c, d] = turn(row);
            if range.contains(&(a as usize)) {
                let place = &mut next[a as usize - range.start];
                records[*place as usize] = sort_key([b, c, d, old as u32]);
                *place += 1;
            }
        }
        // Each entry is now the end of its group.
        let mut start = 0;
        for end in next {
            records[start..end as usize].sort_unstable();
            start = end as usize;
        }
    });
    records
}

/// Writes over the vertices of each old row the new numbers of its sides.
fn leave_new_sides(words: SharedWords<'_>, records: &[u128]) {
    records.par_iter().enumerate().with_min_len(CHUNK).for_each(|(new, &key)| {
        let [b, c, d, old] = record_of(key);
        let first_word = 8 * old as usize + 4;
        let row = words.load_row::<4>(first_word);
        let mut sides = [0; 4];
        for face in 0..4 {
            let v = row[face];
            let place = u32::from(v == b) + 2 * u32::from(v == c) + 3 * u32::from(v == d);
            sides[face] = 4 * new as u32 + place;
        }
        // Every old row is in one record: no two threads write the same.
        words.store_row(first_word, sides);
    });
}

/// Writes over the neighbours of each old row the new ones, in the order of its turned row.
fn follow_neighbors(words: SharedWords<'_>) {
    let tets = words.len() / 8;
    (0..tets).into_par_iter().with_min_len(CHUNK).for_each(|old| {
        let own = words.load_row::<4>(8 * old + 4);
        if own == FREE {
            return;
        }
        let neighbors = words.load_row::<4>(8 * old + 8);
        let mut turned = [0; 4];
        for face in 0..4 {
            let side = TetFace(neighbors[face]);
            turned[TetFace(own[face]).face()] = words.load(8 * side.tet().index() + 4 + side.face());
        }
        // Only the new sides of other rows are read here, and those stay.
        words.store_row(8 * old + 8, turned);
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turned_rows_fall_and_keep_their_orientation() {
        let mut seen = 0;
        for code in 0..256u32 {
            let row = [code & 3, code >> 2 & 3, code >> 4 & 3, code >> 6];
            let mut sorted = row;
            sorted.sort_unstable();
            if sorted != [0, 1, 2, 3] {
                continue;
            }
            let rises = (0..4).flat_map(|j| (0..j).map(move |i| (i, j))).filter(|&(i, j)| row[i] < row[j]).count();
            assert_eq!(turn(row), if rises % 2 == 0 { [3, 2, 1, 0] } else { [3, 2, 0, 1] });
            seen += 1;
        }
        assert_eq!(seen, 24);
    }

    #[test]
    fn equal_meshes_in_different_slots_get_equal_rows() {
        // Two tets glued at a face, their other sides at each other, in every order and turn, and with a free slot.
        let tets = [[0, 1, 2, 3], [1, 0, 2, u32::MAX]];
        let turns = [[0, 1, 2, 3], [1, 2, 0, 3], [1, 0, 3, 2], [3, 2, 1, 0], [0, 2, 3, 1]];
        let mut results = Vec::new();
        for slots in [[0, 1], [1, 0], [2, 0], [1, 2]] {
            for places in turns {
                // The second row stays as it is: `places` are the old places of the first one's vertices.
                let mut halves = vec![[u32::MAX; 4]; 7];
                let new_face = |old: usize| places.iter().position(|&p| p == old).unwrap() as u32;
                halves[2 * slots[0] + 1] = places.map(|p| tets[0][p]);
                halves[2 * slots[1] + 1] = tets[1];
                for face in 0..4 {
                    halves[2 * slots[0] + 2][new_face(face) as usize] = 4 * slots[1] as u32 + face as u32;
                    halves[2 * slots[1] + 2][face] = 4 * slots[0] as u32 + new_face(face);
                }
                let names = VertexNames { places: &[3, 1, 4, 2], names: &[u32::MAX, 11, 13, 10, 12] };
                renumber(&mut halves, &names);
                results.push(halves);
            }
        }
        assert!(results.iter().all(|rows| *rows == results[0]), "{results:?}");
        assert_eq!(results[0][1..], [[12, 10, u32::MAX, 11], [4, 6, 7, 5], [12, 10, 11, 13], [0, 3, 1, 2]]);
    }
}
