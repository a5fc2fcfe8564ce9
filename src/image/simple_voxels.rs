//! Voxels that can join or leave a body without changing its topology.
//!
//! # Method
//! A voxel is simple where, among its 26 neighbours, those of the body that it hangs together with are one piece, and those of
//! the rest are one piece. The body is 6-connected, the rest 26-connected.
//!
//! # Source
//! [BertrandMalandain1994].

/// Voxels of a block of 3 x 3 x 3.
const BLOCK: usize = 27;

/// All of them.
pub const WHOLE_BLOCK: Block = (1 << BLOCK) - 1;

/// The voxel in the middle of its block.
const MIDDLE: usize = 13;

/// Bits of a block: voxel (i, j, k) of it is bit `i + 3 j + 9 k`.
pub type Block = u32;

/// Neighbours of each voxel of a block within it, the middle left out.
#[derive(Debug, Clone)]
pub struct SimpleVoxels {
    /// Through faces, in the 18 neighbours that share a face or an edge with the middle.
    by_faces: [Block; BLOCK],
    /// Through faces, edges and corners.
    by_corners: [Block; BLOCK],
    /// The 18 neighbours.
    near: Block,
    /// The 6 that share a face with the middle.
    beside: Block,
}

impl Default for SimpleVoxels {
    fn default() -> Self {
        let at = |v: usize| [v % 3, v / 3 % 3, v / 9].map(|x| x as i32);
        let steps = |v: usize, w: usize| {
            let (v, w) = (at(v), at(w));
            (0..3).map(|d| (v[d] - w[d]).abs()).fold((0, 0), |(sum, most), s| (sum + s, most.max(s)))
        };
        let set = |of: usize, passes: &dyn Fn((i32, i32)) -> bool| {
            (0..BLOCK).filter(|w| *w != MIDDLE && *w != of && passes(steps(of, *w))).fold(0, |set, w| set | 1 << w)
        };
        let near = set(MIDDLE, &|(sum, _)| sum <= 2);
        Self {
            by_faces: std::array::from_fn(|v| set(v, &|(sum, _)| sum == 1) & near),
            by_corners: std::array::from_fn(|v| set(v, &|(_, most)| most == 1)),
            near,
            beside: set(MIDDLE, &|(sum, _)| sum == 1),
        }
    }
}

impl SimpleVoxels {
    /// Whether the voxel in the middle of a block, whose voxels in the body are set, is simple; its own bit does not count.
    pub fn is_simple(&self, body: Block) -> bool {
        let rest = !body & WHOLE_BLOCK & !(1 << MIDDLE);
        let body = body & self.near;
        let beside = body & self.beside;
        if beside == 0 || rest == 0 {
            return false;
        }
        let piece = |seed: Block, among: Block, neighbors: &[Block; BLOCK]| {
            let (mut found, mut fresh) = (0, seed & seed.wrapping_neg());
            while fresh != 0 {
                found |= fresh;
                let mut reached = 0;
                while fresh != 0 {
                    reached |= neighbors[fresh.trailing_zeros() as usize];
                    fresh &= fresh - 1;
                }
                fresh = reached & among & !found;
            }
            found
        };
        beside & !piece(beside, body, &self.by_faces) == 0 && piece(rest, rest, &self.by_corners) == rest
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::euler_numbers::corner_contributions;

    #[test]
    fn a_simple_voxel_changes_no_euler_number_and_no_component() {
        // The change of the 6-connected Euler number around the middle, from the eight corners of it.
        let tables = corner_contributions();
        let euler = |block: Block| -> i64 {
            (0..8)
                .map(|c| {
                    let low = [c & 1, c >> 1 & 1, c >> 2];
                    let bit = |s: usize| (low[0] + (s & 1)) + 3 * (low[1] + (s >> 1 & 1)) + 9 * (low[2] + (s >> 2));
                    let bits = (0..8).filter(|s| block >> bit(*s) & 1 != 0).fold(0, |b, s| b | 1usize << s);
                    tables[1][bits]
                })
                .sum()
        };
        let simple = SimpleVoxels::default();
        let mut state = 12345u64;
        let mut count = [0; 2];
        for _ in 0..20_000 {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            let block = (state >> 33) as u32 & WHOLE_BLOCK & !(1 << MIDDLE);
            let same = euler(block) == euler(block | 1 << MIDDLE);
            let is_simple = simple.is_simple(block);
            assert!(same || !is_simple, "{block:b}");
            assert_eq!(is_simple, simple.is_simple(block | 1 << MIDDLE));
            count[usize::from(is_simple)] += 1;
        }
        assert!(count.iter().all(|c| *c > 500), "{count:?}");
    }

    #[test]
    fn ends_of_rods_are_simple_and_middles_are_not() {
        let simple = SimpleVoxels::default();
        let rod = |ends: &[usize]| ends.iter().fold(0, |b, e| b | 1 << e);
        assert!(simple.is_simple(rod(&[12])));
        assert!(!simple.is_simple(rod(&[12, 14])));
        // The last voxel of a body, and a hole in the middle of one.
        assert!(!simple.is_simple(0) && !simple.is_simple(!0));
    }
}
