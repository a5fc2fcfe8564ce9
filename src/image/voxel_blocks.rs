//! Boxes of voxels, and blocks of them that hold at least one of some voxels: most boxes are seen to hold none at once.
//!
//! # Cost
//! A byte per block of 4 x 4 x 4 voxels; a few loads for a box of a few voxels.

use glam::DVec3;

use crate::image::label_image::LabelImage;

/// Voxels along a block.
const BLOCK: u32 = 4;

/// The blocks that hold at least one of some voxels.
pub struct VoxelBlocks {
    counts: [usize; 3],
    holds_any: Vec<bool>,
}

impl VoxelBlocks {
    /// The blocks of an image of `size` voxels that hold some.
    pub fn new(size: [usize; 3], voxels: impl Iterator<Item = [u32; 3]>) -> Self {
        let counts = size.map(|n| n.div_ceil(BLOCK as usize));
        let mut blocks = Self { counts, holds_any: vec![false; counts.iter().product()] };
        for voxel in voxels {
            let number = blocks.number(voxel.map(|v| v / BLOCK));
            blocks.holds_any[number] = true;
        }
        blocks
    }

    #[inline]
    fn number(&self, [i, j, k]: [u32; 3]) -> usize {
        i as usize + self.counts[0] * (j as usize + self.counts[1] * k as usize)
    }

    /// Whether a block with voxels from the first to the last one of a box holds any.
    #[inline]
    pub fn hold_any(&self, [low, high]: [[u32; 3]; 2]) -> bool {
        box_of(low.map(|v| v / BLOCK), high.map(|v| v / BLOCK)).any(|block| self.holds_any[self.number(block)])
    }
}

/// First and last voxel that the box around some points (local frame, mm) touches, or comes nearer to than `margin`, in voxels.
pub fn touched_box(corners: &[DVec3; 4], image: &LabelImage, margin: f64) -> [[u32; 3]; 2] {
    let grid = image.grid();
    let last = DVec3::from_array(grid.size().map(|n| n as f64 - 1.0));
    let places = corners.map(|p| p / grid.spacing());
    let low = places.into_iter().fold(DVec3::INFINITY, DVec3::min) - margin;
    let high = places.into_iter().fold(DVec3::NEG_INFINITY, DVec3::max) + margin;
    [low, high].map(|bound| bound.round().clamp(DVec3::ZERO, last).as_uvec3().to_array())
}

/// The voxels, or blocks, from a first to a last one.
pub fn box_of(low: [u32; 3], high: [u32; 3]) -> impl Iterator<Item = [u32; 3]> {
    let range = move |d: usize| low[d]..=high[d];
    range(2).flat_map(move |k| range(1).flat_map(move |j| range(0).map(move |i| [i, j, k])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_that_hold_a_voxel_are_never_ruled_out_and_far_ones_are() {
        let voxels = [[3, 9, 4], [10, 0, 6]];
        let blocks = VoxelBlocks::new([11, 10, 7], voxels.into_iter());
        for low in box_of([0; 3], [10, 9, 6]) {
            let high = [(low[0] + 1).min(10), (low[1] + 2).min(9), low[2]];
            let is_in = |v: &[u32; 3]| (0..3).all(|d| (low[d]..=high[d]).contains(&v[d]));
            assert!(blocks.hold_any([low, high]) || !voxels.iter().any(is_in), "{low:?}");
        }
        assert!(!blocks.hold_any([[4, 4, 0], [11, 7, 6].map(|v: u32| v - 1)]));
    }
}
