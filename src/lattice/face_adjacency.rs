//! Which element lies behind each face of a set of tets.
//!
//! # Method
//! 1. Each chunk of tets sorts its faces into buckets of their largest vertex.
//! 2. Each bucket counts its faces into groups of one largest vertex, some twenty faces each, and sorts each group by the
//!    other two vertices; equal neighbours are the two sides of a face.
//! 3. This is done for some of the buckets at a time, so that only their faces are held.
//!
//! After a change of some tets only ([`neighbors_after`]), what lies behind the others is renumbered, and the faces that a
//! tet has lost its neighbour at are matched with those of the new tets; where the others keep their numbers ([`rematch`]), only these
//! faces are touched. Of some of the tets alone ([`neighbors_among`]) they are
//! those that are left, renumbered.
//!
//! # Invariants
//! A face has one or two tets; a third one is an internal error found here.
//!
//! # Cost
//! 16 bytes for each of a quarter of the sides (16 a tet) beside the result, for the time of the call; parallel, the same result
//! for any number of threads.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::lattice::improvement_mesh::numbers_where;
use crate::mesh::numbering::TET_FACES;
use crate::parallel::shared_rows::SharedWords;

/// No element behind a face.
pub const OUTSIDE: u32 = u32::MAX;

/// Tets per parallel work item.
const CHUNK: usize = 1 << 15;

/// Buckets: few enough to be filled in cache, small enough to be sorted in cache at millions of tets.
const BUCKETS: usize = 256;

/// Passes over the tets, each for as many buckets: each looks at all tets again.
const PASSES: usize = 4;

#[derive(Clone, Copy, Default)]
struct Side {
    /// Middle vertex in the high half, smallest in the low half.
    others: u64,
    largest: u32,
    /// `4 * tet + face`, modulo 2^32 only for the face number; tets are below 2^30.
    side: u32,
}

/// For each face of each tet (opposite to the vertex of the same number) the tet behind it, or [`OUTSIDE`].
///
/// # Errors
/// [`Error::CapacityExceeded`] past 2^30 tets; [`Error::Internal`] for a face with three tets; [`Error::Cancelled`],
/// [`Error::LimitReached`].
pub fn neighbors_of(tets: &[[u32; 4]], vertex_count: usize, context: &RunContext) -> Result<Vec<[u32; 4]>> {
    check_count(tets)?;
    // As many vertices a bucket as the power of two that no more than all buckets are needed with.
    let shift = vertex_count.div_ceil(BUCKETS).max(1).next_power_of_two().trailing_zeros();
    let count = vertex_count.div_ceil(1 << shift);
    let mut neighbors = vec![[OUTSIDE; 4]; tets.len()];
    // Each side of a face is written once: the same result in any order.
    let rows = SharedWords::new(neighbors.as_flattened_mut());
    let per_pass = if tets.len() > CHUNK { count.div_ceil(PASSES) } else { count };
    for begin in (0..count).step_by(per_pass.max(1)) {
        context.check()?;
        let buckets = Buckets { begin, end: count.min(begin + per_pass), shift };
        let chunks = context.until_cancelled(tets.par_chunks(CHUNK).enumerate());
        let chunks: Vec<(Vec<Side>, Vec<u32>)> = chunks.map(|(c, chunk)| buckets.fill(chunk, c * CHUNK)).collect();
        let join = |bucket: usize| {
            context.check()?;
            buckets.join_sides(&chunks, bucket, &rows)
        };
        (begin..buckets.end).into_par_iter().try_for_each(join)?;
    }
    Ok(neighbors)
}

/// The buckets of one pass; each is for `1 << shift` vertices.
struct Buckets {
    begin: usize,
    end: usize,
    shift: u32,
}

impl Buckets {
    /// The bucket of a vertex among those of the pass.
    fn of(&self, vertex: u32) -> Option<usize> {
        let bucket = (vertex as usize >> self.shift).wrapping_sub(self.begin);
        (bucket < self.end - self.begin).then_some(bucket)
    }

    /// The sides of the tets of a chunk, the first of them number `first`, by buckets; where those of each bucket begin.
    fn fill(&self, tets: &[[u32; 4]], first: usize) -> (Vec<Side>, Vec<u32>) {
        let mut starts = vec![0u32; self.end - self.begin + 1];
        for tet in tets {
            let [_, _, second, largest] = ascending(tet).map(|vertex| (vertex >> 2) as u32);
            if let Some(bucket) = self.of(largest) {
                starts[bucket + 1] += 3;
            }
            if let Some(bucket) = self.of(second) {
                starts[bucket + 1] += 1;
            }
        }
        for b in 1..starts.len() {
            starts[b] += starts[b - 1];
        }
        let mut next = starts.clone();
        let mut sides = vec![Side::default(); starts[self.end - self.begin] as usize];
        for (t, tet) in tets.iter().enumerate() {
            let vertices = ascending(tet);
            let [a, b, c, d] = vertices.map(|vertex| (vertex >> 2) as u32);
            let mut list = |bucket: usize, opposite: usize, [smallest, middle, largest]: [u32; 3]| {
                let position = &mut next[bucket];
                let side = (((first + t) << 2) | (vertices[opposite] & 3) as usize) as u32;
                let others = u64::from(middle) << 32 | u64::from(smallest);
                sides[*position as usize] = Side { others, largest, side };
                *position += 1;
            };
            if let Some(bucket) = self.of(d) {
                list(bucket, 0, [b, c, d]);
                list(bucket, 1, [a, c, d]);
                list(bucket, 2, [a, b, d]);
            }
            if let Some(bucket) = self.of(c) {
                list(bucket, 3, [a, b, c]);
            }
        }
        (sides, starts)
    }

    /// Writes for each side of a bucket what lies behind it.
    fn join_sides(&self, chunks: &[(Vec<Side>, Vec<u32>)], bucket: usize, rows: &SharedWords) -> Result<()> {
        let sides = || {
            let b = bucket - self.begin;
            chunks.iter().flat_map(move |(sides, starts)| &sides[starts[b] as usize..starts[b + 1] as usize])
        };
        let width = 1usize << self.shift;
        let group = |side: &Side| side.largest as usize & (width - 1);
        let mut ends = vec![0u32; width + 1];
        sides().for_each(|side| ends[group(side) + 1] += 1);
        for v in 0..width {
            ends[v + 1] += ends[v];
        }
        let mut faces = vec![(0u64, 0u32); ends[width] as usize];
        for side in sides() {
            let position = &mut ends[group(side)];
            faces[*position as usize] = (side.others, side.side);
            *position += 1;
        }
        // Each entry has moved on to the end of its group.
        let mut begin = 0;
        for end in &ends[..width] {
            let group = &mut faces[begin..*end as usize];
            begin = *end as usize;
            group.sort_unstable();
            for face in group.chunk_by(|a, b| a.0 == b.0) {
                match face {
                    [_] => {}
                    [(_, a), (_, b)] => {
                        rows.store(*a as usize, b >> 2);
                        rows.store(*b as usize, a >> 2);
                    }
                    _ => return Err(shared_by_many(face[0].1)),
                }
            }
        }
        Ok(())
    }
}

/// The vertices of a tet, each before its number in the tet in the low two bits, ascending.
#[inline]
fn ascending(tet: &[u32; 4]) -> [u64; 4] {
    let at = |v: usize| u64::from(tet[v]) << 2 | v as u64;
    let in_order = |p: u64, q: u64| (p.min(q), p.max(q));
    let ((a, b), (c, d)) = (in_order(at(0), at(1)), in_order(at(2), at(3)));
    let ((a, c), (b, d)) = (in_order(a, c), in_order(b, d));
    let (b, c) = in_order(b, c);
    [a, b, c, d]
}

/// The neighbours of tets some of which were there before, with the neighbours `before`: `numbers` has for each its number
/// then, or [`OUTSIDE`]. A face without a neighbour stays so as long as its tet does.
///
/// # Errors
/// As [`neighbors_of`].
pub fn neighbors_after(
    before: &[[u32; 4]],
    numbers: &[u32],
    tets: &[[u32; 4]],
    context: &RunContext,
) -> Result<Vec<[u32; 4]>> {
    let mut renumbered = vec![OUTSIDE; before.len()];
    for (tet, number) in (0..).zip(numbers).filter(|(_, number)| **number != OUTSIDE) {
        renumbered[*number as usize] = tet;
    }
    context.check()?;
    let behind = |number: &u32| match *number {
        OUTSIDE => [OUTSIDE; 4],
        number => before[number as usize].map(|n| if n == OUTSIDE { OUTSIDE } else { renumbered[n as usize] }),
    };
    let rows = context.until_cancelled(numbers.par_iter().with_min_len(CHUNK));
    let mut neighbors: Vec<[u32; 4]> = rows.map(behind).collect();
    context.check()?;
    let is_open = |t: usize, f: usize| {
        neighbors[t][f] == OUTSIDE && (numbers[t] == OUTSIDE || before[numbers[t] as usize][f] != OUTSIDE)
    };
    let open_faces = |t: usize| {
        (0..4).filter(move |f| is_open(t, *f)).map(move |f| face_with_side(&tets[t], ((t as u32) << 2) | f as u32))
    };
    let all = (0..tets.len()).into_par_iter().with_min_len(CHUNK);
    let faces: Vec<u128> = context.until_cancelled(all).flat_map_iter(open_faces).collect();
    join_equal(faces, &mut neighbors, context)?;
    Ok(neighbors)
}

/// The neighbours once some tets have changed in their places and others have come at the end; `changed` has the numbers of all of these.
///
/// # Errors
/// As [`neighbors_of`]; the neighbours are not whole then.
pub fn rematch(neighbors: &mut Vec<[u32; 4]>, tets: &[[u32; 4]], changed: &[u32], context: &RunContext) -> Result<()> {
    check_count(tets)?;
    neighbors.resize(tets.len(), [OUTSIDE; 4]);
    let mut sides: Vec<u32> = changed.iter().flat_map(|t| (0..4).map(move |f| t << 2 | f)).collect();
    for &t in changed {
        for n in std::mem::replace(&mut neighbors[t as usize], [OUTSIDE; 4]).into_iter().filter(|n| *n != OUTSIDE) {
            let row = &mut neighbors[n as usize];
            if let Some(f) = row.iter().position(|behind| *behind == t) {
                row[f] = OUTSIDE;
                sides.push(n << 2 | f as u32);
            }
        }
    }
    context.check()?;
    // Two that have changed and were side by side list the face between them twice.
    sides.par_sort_unstable();
    sides.dedup();
    let faces = sides.par_iter().with_min_len(CHUNK).map(|side| face_with_side(&tets[(side >> 2) as usize], *side));
    join_equal(faces.collect(), neighbors, context)
}

/// The vertices of a face in the high part, ascending, and its side: sorting compares once.
fn face_with_side(tet: &[u32; 4], side: u32) -> u128 {
    let mut face = TET_FACES[(side & 3) as usize].map(|v| tet[v]);
    face.sort_unstable();
    let [a, b, c] = face.map(u128::from);
    a << 96 | b << 64 | c << 32 | u128::from(side)
}

/// Makes the two sides of each face that is there twice neighbours.
fn join_equal(mut faces: Vec<u128>, neighbors: &mut [[u32; 4]], context: &RunContext) -> Result<()> {
    context.check()?;
    faces.par_sort_unstable();
    context.check()?;
    for face in faces.chunk_by(|a, b| a >> 32 == b >> 32) {
        match face {
            [_] => {}
            [a, b] => {
                let [a, b] = [*a as u32, *b as u32];
                neighbors[(a >> 2) as usize][(a & 3) as usize] = b >> 2;
                neighbors[(b >> 2) as usize][(b & 3) as usize] = a >> 2;
            }
            _ => return Err(shared_by_many(face[0] as u32)),
        }
    }
    Ok(())
}

/// The neighbours of those tets of which something holds, in their order and with the numbers that they have in it.
///
/// # Errors
/// [`Error::Cancelled`], [`Error::LimitReached`].
pub fn neighbors_among(
    before: &[[u32; 4]],
    is_kept: impl Fn(usize) -> bool + Sync,
    context: &RunContext,
) -> Result<Vec<[u32; 4]>> {
    let kept = numbers_where(before.len(), &|t| is_kept(t as usize), context)?;
    let mut numbers = vec![OUTSIDE; before.len()];
    (0..).zip(&kept).for_each(|(number, t)| numbers[*t as usize] = number);
    let number = |n: u32| if n == OUTSIDE { OUTSIDE } else { numbers[n as usize] };
    let kept = context.until_cancelled(kept.par_iter().with_min_len(CHUNK));
    let neighbors = kept.map(|t| before[*t as usize].map(number)).collect();
    context.check()?;
    Ok(neighbors)
}

fn check_count(tets: &[[u32; 4]]) -> Result<()> {
    let (needed, limit) = (tets.len() as u64, 1 << 30);
    if needed >= limit { Err(Error::CapacityExceeded { what: "tets", needed, limit }) } else { Ok(()) }
}

fn shared_by_many(side: u32) -> Error {
    Error::Internal { reason: format!("tet {} shares a face with more than one tet", side >> 2) }
}

/// Some elements and their neighbours through faces, increasing.
pub fn with_neighbors(elements: &[u32], neighbors: &[[u32; 4]]) -> Vec<u32> {
    let beside = |e: &u32| neighbors[*e as usize].into_iter().filter(|n| *n != OUTSIDE).chain([*e]);
    let mut all: Vec<u32> = elements.iter().flat_map(beside).collect();
    all.sort_unstable();
    all.dedup();
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustc_hash::FxHashMap;

    /// A cube of `n` cells a side, six tets each around the cell's diagonal, and the number of vertices.
    fn cube(n: u32) -> (Vec<[u32; 4]>, usize) {
        let row = n + 1;
        let vertex = |at: [u32; 3]| (at[2] * row + at[1]) * row + at[0];
        let mut tets = Vec::new();
        for cell in 0..n.pow(3) {
            let at = [cell % n, cell / n % n, cell / n / n];
            for axes in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
                let mut corner = at;
                let mut tet = [vertex(at); 4];
                for (i, axis) in axes.into_iter().enumerate() {
                    corner[axis] += 1;
                    tet[i + 1] = vertex(corner);
                }
                tets.push(tet);
            }
        }
        (tets, row.pow(3) as usize)
    }

    #[test]
    fn tets_of_one_pass_and_of_several_find_each_other() {
        let context = RunContext::with_threads(1).unwrap();
        for n in [3, 18] {
            let (tets, vertices) = cube(n);
            assert_eq!(tets.len() > CHUNK, n == 18);
            let mut sides: FxHashMap<[u32; 3], Vec<[usize; 2]>> = FxHashMap::default();
            for (t, tet) in tets.iter().enumerate() {
                for (f, face) in TET_FACES.into_iter().enumerate() {
                    let mut face = face.map(|v| tet[v]);
                    face.sort_unstable();
                    sides.entry(face).or_default().push([t, f]);
                }
            }
            let mut expected = vec![[OUTSIDE; 4]; tets.len()];
            for sides in sides.values() {
                if let [[t, f], [u, g]] = sides[..] {
                    (expected[t][f], expected[u][g]) = (u as u32, t as u32);
                }
            }
            assert!(neighbors_of(&tets, vertices, &context).unwrap() == expected);
        }
    }

    #[test]
    fn tets_cut_in_their_places_and_those_around_find_each_other() {
        let context = RunContext::with_threads(1).unwrap();
        let (tets, vertices) = cube(4);
        let neighbors = neighbors_of(&tets, vertices, &context).unwrap();
        // Cut into four at a vertex of their own: side by side, at the outside, and apart.
        for cut in [vec![], vec![0, 1, 2, 57], (0..tets.len() as u32).step_by(3).collect(), (9..200).collect()] {
            let (mut after, mut changed) = (tets.clone(), cut);
            for (middle, t) in (vertices as u32..).zip(changed.clone()) {
                let [a, b, c, d] = tets[t as usize];
                after[t as usize] = [a, b, c, middle];
                after.extend([[a, b, middle, d], [a, middle, c, d], [middle, b, c, d]]);
            }
            changed.extend(tets.len() as u32..after.len() as u32);
            let mut found = neighbors.clone();
            rematch(&mut found, &after, &changed, &context).unwrap();
            assert_eq!(found, neighbors_of(&after, vertices + changed.len(), &context).unwrap());
        }
        let twice = [vec![tets[0]], tets.clone(), vec![tets[0]]].concat();
        let all: Vec<u32> = (0..twice.len() as u32).collect();
        assert!(matches!(rematch(&mut Vec::new(), &twice, &all, &context), Err(Error::Internal { .. })));
        context.cancel_token().cancel();
        assert!(matches!(rematch(&mut neighbors.clone(), &tets, &[0], &context), Err(Error::Cancelled)));
    }

    #[test]
    fn those_left_of_a_set_are_each_others_neighbours() {
        let context = RunContext::with_threads(1).unwrap();
        let (tets, vertices) = cube(4);
        let neighbors = neighbors_of(&tets, vertices, &context).unwrap();
        for step in [1, 2, 3, 5] {
            let is_kept = |t: usize| t.is_multiple_of(step) || t % 7 == 1;
            let left: Vec<[u32; 4]> = (0..tets.len()).filter(|t| is_kept(*t)).map(|t| tets[t]).collect();
            let expected = neighbors_of(&left, vertices, &context).unwrap();
            assert_eq!(neighbors_among(&neighbors, is_kept, &context).unwrap(), expected, "{step}");
        }
        context.cancel_token().cancel();
        assert!(matches!(neighbors_among(&neighbors, |_| true, &context), Err(Error::Cancelled)));
    }

    #[test]
    fn a_third_tet_at_a_face_is_an_error_in_any_pass() {
        let (mut tets, vertices) = cube(18);
        let [a, b, c, _] = tets[100];
        tets.extend([vertices, vertices + 1].map(|apex| [a, b, c, apex as u32]));
        let context = RunContext::with_threads(1).unwrap();
        assert!(matches!(neighbors_of(&tets, vertices + 2, &context), Err(Error::Internal { .. })));
    }

    #[test]
    fn a_cancelled_run_finds_no_neighbors() {
        let (tets, vertices) = cube(3);
        let context = RunContext::with_threads(1).unwrap();
        context.cancel_token().cancel();
        assert!(matches!(neighbors_of(&tets, vertices, &context), Err(Error::Cancelled)));
    }
}
