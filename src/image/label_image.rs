//! A segmented image: one material per voxel.
//!
//! # Method
//! The caller's label values (any non-negative integers up to 2^31 - 1) are compacted to 1, 2, 3, ... in increasing
//! order of value, 0 stays background. Engines work on the compact [`Label`]s; results carry the caller's values again.
//!
//! # Invariants
//! `values[0] == 0`; `values` is strictly increasing; every voxel is below `values.len()`.
//!
//! # Limits
//! At most 65535 labels beside the background.

use glam::IVec3;
use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::image::grid::Grid;
use crate::index::Label;

/// Most labels beside the background.
pub const MAX_LABELS: usize = u16::MAX as usize;

/// Voxels counted by one task.
const COUNTED_CHUNK: usize = 1 << 18;

/// A segmented image in memory, 2 bytes per voxel.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelImage {
    grid: Grid,
    voxels: Vec<Label>,
    values: Vec<i32>,
}

impl LabelImage {
    /// An image from compact labels and the caller's value of each (`values[0] == 0` for the background).
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] where an invariant of the module is violated.
    pub fn new(grid: Grid, voxels: Vec<Label>, values: Vec<i32>) -> Result<Self> {
        if voxels.len() != grid.voxel_count() {
            return Err(Error::argument("voxels", format!("{} for {} voxels", voxels.len(), grid.voxel_count())));
        }
        if values.first() != Some(&0) || !values.is_sorted_by(|a, b| a < b) || values.len() > MAX_LABELS + 1 {
            return Err(Error::argument("values", "not 0 followed by increasing label values"));
        }
        if voxels.iter().any(|l| l.index() >= values.len()) {
            return Err(Error::argument("voxels", "a label without a value"));
        }
        Ok(Self { grid, voxels, values })
    }

    /// Where the voxels are.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Compact labels, i fastest.
    pub fn voxels(&self) -> &[Label] {
        &self.voxels
    }

    /// Compact labels for changing; the caller keeps them below [`LabelImage::label_count`].
    pub fn voxels_mut(&mut self) -> &mut [Label] {
        &mut self.voxels
    }

    /// Number of compact labels, the background included.
    pub fn label_count(&self) -> usize {
        self.values.len()
    }

    /// Voxels of each label.
    pub fn voxel_counts(&self) -> Vec<u64> {
        let of_chunk = |voxels: &[Label]| {
            let mut counts = vec![0u64; self.label_count()];
            voxels.iter().for_each(|l| counts[l.index()] += 1);
            counts
        };
        let sum = |mut l: Vec<u64>, r: Vec<u64>| {
            l.iter_mut().zip(r).for_each(|(sum, part)| *sum += part);
            l
        };
        // Whole numbers: the sums do not depend on the order.
        let chunks = self.voxels().par_chunks(COUNTED_CHUNK).map(of_chunk);
        chunks.reduce(|| vec![0; self.label_count()], sum)
    }

    /// The caller's value of a compact label.
    pub fn value(&self, label: Label) -> i32 {
        self.values[label.index()]
    }

    /// The caller's values, position = compact label.
    pub fn values(&self) -> &[i32] {
        &self.values
    }

    /// The compact label of a caller's value.
    pub fn label_of(&self, value: i64) -> Option<Label> {
        let value = i32::try_from(value).ok()?;
        self.values.binary_search(&value).ok().map(|index| Label(index as u16))
    }

    /// The label of voxel (i, j, k).
    #[inline]
    pub fn at(&self, i: usize, j: usize, k: usize) -> Label {
        self.voxels[self.grid.offset(i, j, k)]
    }

    /// The label of a voxel that may lie outside of the image, in the background that surrounds it.
    #[inline]
    pub fn at_or_background(&self, voxel: IVec3) -> Label {
        let size = IVec3::from_array(self.grid.size().map(|n| n as i32));
        let is_inside = voxel.cmpge(IVec3::ZERO).all() && voxel.cmplt(size).all();
        if is_inside { self.at(voxel.x as usize, voxel.y as usize, voxel.z as usize) } else { Label::BACKGROUND }
    }
}
