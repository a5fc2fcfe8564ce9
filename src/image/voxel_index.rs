//! Numbers of some voxels of an image: a sparse map from places to positions.
//!
//! # Method
//! Blocks of 4 x 4 x 4 voxels; a table over the box of the voxels has the position of each block that is stored.
//!
//! # Invariants
//! The voxels are numbered in the order they were given, each once. Places may lie outside of the image, also below zero.
//!
//! # Cost
//! 256 bytes per block that holds a voxel, 4 bytes per block of the box. One or two loads a look-up.

/// Voxels of a block along an axis.
pub const BLOCK: i32 = 4;

/// Voxels of a block.
const BLOCK_VOXELS: usize = (BLOCK * BLOCK * BLOCK) as usize;

/// No block, no voxel.
const NONE: u32 = u32::MAX;

/// Positions of voxels by their places.
#[derive(Debug, Clone, Default)]
pub struct VoxelIndex {
    /// First block along each axis.
    first: [i32; 3],
    /// Blocks along each axis.
    count: [i32; 3],
    /// Position of each block in `blocks`, or `NONE`.
    table: Vec<u32>,
    blocks: Vec<[u32; BLOCK_VOXELS]>,
}

impl VoxelIndex {
    /// Numbers the voxels in their order; there are less than 2^32 - 1.
    pub fn new(voxels: &[[i32; 3]]) -> Self {
        let mut index = Self::default();
        let (mut low, mut high) = ([i32::MAX; 3], [i32::MIN; 3]);
        for at in voxels {
            (0..3).for_each(|d| (low[d], high[d]) = (low[d].min(at[d]), high[d].max(at[d])));
        }
        if voxels.is_empty() {
            return index;
        }
        index.first = low.map(|l| l.div_euclid(BLOCK));
        index.count = std::array::from_fn(|d| high[d].div_euclid(BLOCK) - index.first[d] + 1);
        index.table = vec![NONE; index.count.iter().map(|c| *c as usize).product()];
        for (number, at) in voxels.iter().enumerate() {
            let slot = index.block_of(*at).expect("the box holds all voxels");
            if index.table[slot] == NONE {
                index.table[slot] = index.blocks.len() as u32;
                index.blocks.push([NONE; BLOCK_VOXELS]);
            }
            index.blocks[index.table[slot] as usize][inside(*at)] = number as u32;
        }
        index
    }

    /// The number of a voxel; `None` where it has none.
    pub fn get(&self, at: [i32; 3]) -> Option<usize> {
        let block = self.table[self.block_of(at)?];
        if block == NONE {
            return None;
        }
        let number = self.blocks[block as usize][inside(at)];
        (number != NONE).then_some(number as usize)
    }

    /// Number of blocks that hold a voxel.
    pub fn block_count(&self) -> usize {
        self.blocks.len()
    }

    /// The numbers of the voxels of a block, along rows and slices.
    pub fn voxels_of(&self, block: usize) -> impl Iterator<Item = usize> {
        self.blocks[block].iter().filter(|number| **number != NONE).map(|number| *number as usize)
    }

    /// The blocks with places from `low` to `high` that hold a voxel, and the first place of each.
    pub fn blocks_between(&self, low: [i32; 3], high: [i32; 3]) -> impl Iterator<Item = (usize, [i32; 3])> {
        let range = move |d: usize| {
            let from = low[d].div_euclid(BLOCK).max(self.first[d]);
            from..=high[d].div_euclid(BLOCK).min(self.first[d] + self.count[d] - 1)
        };
        let rows = range(2).flat_map(move |k| range(1).map(move |j| (j, k)));
        rows.flat_map(move |(j, k)| range(0).map(move |i| [i, j, k].map(|x| x * BLOCK))).filter_map(|corner| {
            let block = self.table[self.block_of(corner)?];
            (block != NONE).then_some((block as usize, corner))
        })
    }

    /// Place in the table of the block around a voxel.
    fn block_of(&self, at: [i32; 3]) -> Option<usize> {
        let [i, j, k]: [i32; 3] = std::array::from_fn(|d| at[d].div_euclid(BLOCK) - self.first[d]);
        let is_in = [i, j, k].iter().zip(self.count).all(|(block, count)| (0..count).contains(block));
        is_in.then(|| i as usize + self.count[0] as usize * (j as usize + self.count[1] as usize * k as usize))
    }
}

/// Place of a voxel in its block.
fn inside(at: [i32; 3]) -> usize {
    let [i, j, k] = at.map(|x| x.rem_euclid(BLOCK));
    (i + BLOCK * (j + BLOCK * k)) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn voxels_have_their_numbers_and_no_others_have_one() {
        let all: Vec<[i32; 3]> = (0..1000).map(|n| [n % 10 - 3, n / 10 % 10 + 5, n / 100 - 9]).collect();
        let some: Vec<[i32; 3]> = all.iter().copied().filter(|[i, j, k]| (i * 7 + j * 3 + k * 5) % 4 == 0).collect();
        let index = VoxelIndex::new(&some);
        for at in all.iter().chain(&[[100, 0, 0], [-40, 6, -5]]) {
            assert_eq!(index.get(*at), some.iter().position(|other| other == at), "{at:?}");
        }
        assert_eq!(VoxelIndex::new(&[]).get([0; 3]), None);
    }

    #[test]
    fn blocks_of_a_box_hold_the_voxels_there() {
        let all: Vec<[i32; 3]> = (0..1000).map(|n| [n % 10 - 3, n / 10 % 10 + 5, n / 100 - 9]).collect();
        let some: Vec<[i32; 3]> = all.into_iter().filter(|[i, j, k]| (i - j) % 5 == 0 && *k != -4).collect();
        let index = VoxelIndex::new(&some);
        let (low, high) = ([-1, 6, -100], [3, 20, -3]);
        let mut found: Vec<usize> = Vec::new();
        for (block, corner) in index.blocks_between(low, high) {
            let is_there = |voxel: &usize| (0..3).all(|d| (0..BLOCK).contains(&(some[*voxel][d] - corner[d])));
            assert!(index.voxels_of(block).all(|voxel| is_there(&voxel)));
            found.extend(index.voxels_of(block));
        }
        let is_within = |voxel: &usize| (0..3).all(|d| (low[d]..=high[d]).contains(&some[*voxel][d]));
        assert!((0..some.len()).filter(is_within).all(|voxel| found.contains(&voxel)));
        assert!(found.len() < some.len() && index.blocks_between([40; 3], [50; 3]).next().is_none());
        assert_eq!((0..index.block_count()).map(|block| index.voxels_of(block).count()).sum::<usize>(), some.len());
        assert!(VoxelIndex::new(&[]).blocks_between([-9; 3], [9; 3]).next().is_none());
    }
}
