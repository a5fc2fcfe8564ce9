//! Which vertex stands at an integer position of the lattice: blocks of positions, filled by many threads.
//!
//! # Method
//! 1. A position belongs to the coarsest body-centred lattice that holds it: a corner of its cubes or a centre of one.
//! 2. Corners and centres of 4 x 4 x 4 cubes of a lattice are a block of 128 entries, found by one look into a hash
//!    table; positions near each other stand in the same block, so a block just used is in the cache.
//! 3. Blocks are spread over `SHARDS` tables. [`VertexTable::insert_all`] sorts what it is given by shard, and each
//!    shard looks through its own in the order given; new vertices are then numbered in the order of the chunks of the
//!    input, and within a chunk by shard.
//!
//! # Invariants
//! The numbers depend on the input and on `CHUNK`, not on the number of threads. An entry once set stays.
//!
//! # Cost
//! 512 bytes a block; refined regions fill more than half of their entries. Linear, in parallel.

use glam::IVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::parallel::pieces::pieces;

/// No vertex at a position.
const EMPTY: u32 = u32::MAX;

/// Marks a vertex that has no number yet; the other bits are its place among its shard's new ones.
const NEW: u32 = 1 << 31;

/// Parts that are filled independently: some for each of 64 threads would be idle with fewer.
const SHARDS: usize = 128;

/// Entries of a block.
const BLOCK: usize = 128;

/// Rows of the input per parallel work item; part of the result, as numbers follow the chunks.
const CHUNK: usize = 1024;

/// Vertices by position.
#[derive(Default)]
pub struct VertexTable {
    shards: Vec<Shard>,
}

#[derive(Default)]
struct Shard {
    blocks: FxHashMap<u64, u32>,
    /// [`BLOCK`] entries for each block.
    entries: Vec<u32>,
}

/// A vertex that [`VertexTable::insert_all`] made.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct NewVertex {
    /// Where it is.
    pub position: IVec3,
    /// Row of the input and place in the row that asked for it first.
    pub asked_by: (u32, u8),
}

/// What [`VertexTable::insert_all`] found and made.
pub struct Inserted<const N: usize> {
    /// Vertices of each row.
    pub rows: Vec<[u32; N]>,
    /// New vertices; the first has the number that was given.
    pub new: Vec<NewVertex>,
}

/// The requests of one chunk of rows, sorted by shard: `N * row + place` within the chunk.
struct Requests {
    starts: Vec<u32>,
    places: Vec<u32>,
}

/// What a shard answers: a number or a [`NEW`] one for each request, in the order of chunks and requests, and its new
/// vertices with the end of each chunk's.
struct Answers {
    found: Vec<u32>,
    new: Vec<(NewVertex, usize)>,
    ends: Vec<u32>,
}

/// Block and entry of a position.
#[inline]
fn locate(position: IVec3) -> (u64, usize) {
    // The smallest trailing zeros of the three; the origin counts as a corner of the coarsest lattice there is.
    let scale = (position.x | position.y | position.z).trailing_zeros().min(31);
    let is_center = (position.x & position.y & position.z) >> scale & 1 == 1;
    let scale = scale + u32::from(is_center);
    let cell: IVec3 = if scale > 31 { IVec3::ZERO } else { position >> scale as i32 };
    let block: IVec3 = cell >> 2;
    let within: IVec3 = cell & 3;
    let entry = (within.x | within.y << 2 | within.z << 4) as usize | usize::from(is_center) << 6;
    // 19 bits an axis: positions have 21, blocks are 4 wide.
    let key = block.x as u64 | (block.y as u64) << 19 | (block.z as u64) << 38 | u64::from(scale) << 57;
    (key, entry)
}

/// Shard of a block: the high bits of a product with the golden ratio, which `FxHashMap` does not use alike.
#[inline]
fn shard_of(key: u64) -> usize {
    (key.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 57) as usize % SHARDS
}

impl Shard {
    #[inline]
    fn entry(&mut self, key: u64, entry: usize) -> usize {
        let next = (self.entries.len() / BLOCK) as u32;
        let block = *self.blocks.entry(key).or_insert(next);
        if block == next {
            self.entries.resize(self.entries.len() + BLOCK, EMPTY);
        }
        block as usize * BLOCK + entry
    }

    fn answer<const N: usize>(
        &mut self,
        own: usize,
        requests: &[Requests],
        position_of: &(impl Fn(usize, usize) -> IVec3 + Sync),
    ) -> Answers {
        let count = requests.iter().map(|r| (r.starts[own + 1] - r.starts[own]) as usize).sum();
        let mut answers = Answers { found: Vec::with_capacity(count), new: Vec::new(), ends: Vec::new() };
        for (c, chunk) in requests.iter().enumerate() {
            for place in &chunk.places[chunk.starts[own] as usize..chunk.starts[own + 1] as usize] {
                let (row, column) = (c * CHUNK + *place as usize / N, *place as usize % N);
                let position = position_of(row, column);
                let (key, entry) = locate(position);
                let at = self.entry(key, entry);
                if self.entries[at] == EMPTY {
                    self.entries[at] = NEW | answers.new.len() as u32;
                    answers.new.push((NewVertex { position, asked_by: (row as u32, column as u8) }, at));
                }
                answers.found.push(self.entries[at]);
            }
            answers.ends.push(answers.new.len() as u32);
        }
        answers
    }
}

impl VertexTable {
    /// The vertex at a position.
    #[inline]
    pub fn find(&self, position: IVec3) -> Option<u32> {
        let (key, entry) = locate(position);
        let shard = self.shards.get(shard_of(key))?;
        let block = *shard.blocks.get(&key)?;
        Some(shard.entries[block as usize * BLOCK + entry]).filter(|v| *v != EMPTY)
    }

    /// The vertex at a position, `next` where there was none.
    pub fn insert(&mut self, position: IVec3, next: u32) -> u32 {
        self.shards.resize_with(SHARDS, Shard::default);
        let (key, entry) = locate(position);
        let shard = &mut self.shards[shard_of(key)];
        let at = shard.entry(key, entry);
        if shard.entries[at] == EMPTY {
            shard.entries[at] = next;
        }
        shard.entries[at]
    }

    /// The vertices at the `N` positions of each of `rows` rows; those that were not there are numbered from `next` on.
    /// The caller makes sure that all numbers stay below 2^31.
    pub fn insert_all<const N: usize>(
        &mut self,
        rows: usize,
        next: u32,
        position_of: impl Fn(usize, usize) -> IVec3 + Sync,
    ) -> Inserted<N> {
        self.shards.resize_with(SHARDS, Shard::default);
        let chunk_count = rows.div_ceil(CHUNK);
        let range = |c: usize| c * CHUNK..((c + 1) * CHUNK).min(rows);
        let requests: Vec<Requests> =
            (0..chunk_count).into_par_iter().map(|c| sorted_requests::<N>(range(c), &position_of)).collect();
        let answer = |(own, shard): (usize, &mut Shard)| shard.answer::<N>(own, &requests, &position_of);
        let answers: Vec<Answers> = self.shards.par_iter_mut().enumerate().map(answer).collect();
        // Numbers in the order of chunks and shards: neighbours in the input are neighbours in memory.
        let mut firsts = vec![[0u32; SHARDS]; chunk_count];
        let mut total = 0;
        for (c, firsts) in firsts.iter_mut().enumerate() {
            for (first, answers) in firsts.iter_mut().zip(&answers) {
                *first = next + total;
                total += answers.ends[c] - answers.begin(c);
            }
        }
        let set_numbers = |(s, (shard, answers)): (usize, (&mut Shard, &Answers))| {
            let mut numbers = Vec::with_capacity(answers.new.len());
            for (c, firsts) in firsts.iter().enumerate() {
                for (vertex, i) in (firsts[s]..).zip(answers.begin(c)..answers.ends[c]) {
                    shard.entries[answers.new[i as usize].1] = vertex;
                    numbers.push(vertex);
                }
            }
            numbers
        };
        let numbers: Vec<Vec<u32>> = self.shards.par_iter_mut().zip(&answers).enumerate().map(set_numbers).collect();
        let begins = request_begins(&requests);
        let mut result = Inserted { rows: vec![[0; N]; rows], new: vec![NewVertex::default(); total as usize] };
        let count = |c: usize| answers.iter().map(|a| (a.ends[c] - a.begin(c)) as usize).sum();
        let chunks = result.rows.par_chunks_mut(CHUNK).enumerate();
        let parts = pieces(&mut result.new, (0..chunks.len()).map(count));
        chunks.zip(parts).for_each(|((c, rows), part)| {
            let mut made = part.iter_mut();
            for (s, answers) in answers.iter().enumerate() {
                let new = &answers.new[answers.begin(c) as usize..answers.ends[c] as usize];
                made.by_ref().zip(new).for_each(|(slot, (vertex, _))| *slot = *vertex);
                let places = &requests[c].places[requests[c].starts[s] as usize..requests[c].starts[s + 1] as usize];
                for (place, found) in places.iter().zip(&answers.found[begins[c][s] as usize..]) {
                    let is_new = *found & NEW != 0;
                    let vertex = if is_new { numbers[s][(*found & !NEW) as usize] } else { *found };
                    rows[*place as usize / N][*place as usize % N] = vertex;
                }
            }
        });
        result
    }
}

impl Answers {
    /// First new vertex of a chunk.
    fn begin(&self, chunk: usize) -> u32 {
        if chunk == 0 { 0 } else { self.ends[chunk - 1] }
    }
}

fn sorted_requests<const N: usize>(
    rows: std::ops::Range<usize>,
    position_of: &(impl Fn(usize, usize) -> IVec3 + Sync),
) -> Requests {
    let mut shards = Vec::with_capacity(N * rows.len());
    let mut starts = vec![0u32; SHARDS + 1];
    for row in rows {
        for column in 0..N {
            let shard = shard_of(locate(position_of(row, column)).0);
            shards.push(shard as u8);
            starts[shard + 1] += 1;
        }
    }
    for s in 0..SHARDS {
        starts[s + 1] += starts[s];
    }
    let mut next = starts.clone();
    let mut places = vec![0; shards.len()];
    for (place, shard) in shards.into_iter().enumerate() {
        let slot = &mut next[usize::from(shard)];
        places[*slot as usize] = place as u32;
        *slot += 1;
    }
    Requests { starts, places }
}

/// Where the answers to each chunk begin in each shard.
fn request_begins(requests: &[Requests]) -> Vec<[u32; SHARDS]> {
    let mut sums = [0; SHARDS];
    let begins = requests.iter().map(|chunk| {
        let begin = sums;
        sums.iter_mut().zip(chunk.starts.windows(2)).for_each(|(sum, at)| *sum += at[1] - at[0]);
        begin
    });
    begins.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;

    fn positions(count: usize) -> Vec<[IVec3; 3]> {
        let mut state = 7u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as i32 % 40
        };
        (0..count).map(|_| [(); 3].map(|()| IVec3::new(next(), next(), next()) * 2)).collect()
    }

    #[test]
    fn every_position_has_an_entry_of_its_own() {
        let mut seen = std::collections::HashSet::new();
        for i in 0..32 * 32 * 32 {
            assert!(seen.insert(locate(IVec3::new(i % 32, i / 32 % 32, i / 1024))));
        }
        let far = (1 << 21) - 1;
        assert!(seen.insert(locate(IVec3::splat(far))) && seen.insert(locate(IVec3::new(1 << 20, 0, 1 << 20))));
    }

    #[test]
    fn many_at_once_are_the_same_as_one_after_the_other() {
        let rows = positions(5000);
        let mut known = std::collections::HashMap::new();
        for threads in [1, 3] {
            let mut table = VertexTable::default();
            let context = RunContext::with_threads(threads).unwrap();
            let (old, new) = rows.split_at(2000);
            let mut places = Vec::new();
            for part in [old, new] {
                let first = places.len() as u32;
                let inserted: Inserted<3> =
                    context.install(|| table.insert_all(part.len(), first, |row, column| part[row][column]));
                for (i, vertex) in inserted.new.iter().enumerate() {
                    let (row, column) = vertex.asked_by;
                    assert_eq!(part[row as usize][usize::from(column)], vertex.position);
                    assert_eq!(table.find(vertex.position), Some(first + i as u32));
                }
                places.extend(inserted.new.iter().map(|v| v.position));
                for (row, wanted) in inserted.rows.iter().zip(part) {
                    assert_eq!(row.map(|v| places[v as usize]), *wanted);
                }
            }
            // The same numbers for any number of threads, and as many as there are positions.
            let numbers: Vec<u32> = rows.iter().flatten().map(|p| table.find(*p).unwrap()).collect();
            assert_eq!(*known.entry("numbers").or_insert_with(|| numbers.clone()), numbers);
            let distinct: std::collections::HashSet<IVec3> = rows.iter().flatten().copied().collect();
            assert_eq!(distinct.len(), places.len());
            assert_eq!(table.find(IVec3::new(1, 1, 1)), None);
        }
        let mut one_by_one = VertexTable::default();
        assert_eq!(one_by_one.insert(IVec3::ONE, 4), 4);
        assert_eq!(one_by_one.insert(IVec3::ONE, 5), 4);
    }
}
