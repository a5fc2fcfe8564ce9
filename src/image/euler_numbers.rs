//! Euler numbers of labels: components minus tunnels plus cavities.
//!
//! # Method
//! The sum over all corners of voxels of what the eight voxels around say: a corner has an eighth of each voxel, a quarter of
//! each square and half of each edge.
//!
//! # Source
//! [KongRosenfeld1989].
//!
//! # Invariants
//! Where no two voxels of a label touch only along an edge or at a corner, and none of the rest do, both numbers agree.

use glam::IVec3;
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::label_image::LabelImage;
use crate::index::Label;

/// Euler numbers of all labels, 26- and 6-connected; that of the background is that of all labels together.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn euler_numbers(image: &LabelImage, context: &RunContext) -> Result<Vec<[i64; 2]>> {
    let [ni, nj, nk] = image.grid().size();
    let contributions = corner_contributions();
    let none = || vec![[0i64; 2]; image.label_count()];
    let add = |mut sums: Vec<[i64; 2]>, other: Vec<[i64; 2]>| {
        sums.iter_mut().zip(other).for_each(|(s, o)| *s = [s[0] + o[0], s[1] + o[1]]);
        sums
    };
    let of_layer = |mut sums: Vec<[i64; 2]>, k: usize| {
        for corner in (0..=nj).flat_map(|j| (0..=ni).map(move |i| [i, j, k])) {
            let labels: [Label; 8] = std::array::from_fn(|s| label_at_corner(image, &corner, s));
            if labels.iter().all(|l| *l == labels[0]) {
                // Inside of a label the parts cancel.
                continue;
            }
            let is_first = |side: &usize| !labels[..*side].contains(&labels[*side]);
            for label in (0..8).filter(is_first).map(|side| labels[side]) {
                let is_in = |side: &usize| labels[*side].is_in_solid_of(label);
                let bits = (0..8).filter(is_in).fold(0, |bits, side| bits | 1usize << side);
                let sum = &mut sums[label.index()];
                *sum = [sum[0] + contributions[0][bits], sum[1] + contributions[1][bits]];
            }
        }
        sums
    };
    // Whole numbers: the sum does not depend on the order.
    let eighths = context.until_cancelled(0..=nk).fold(none, of_layer).reduce(none, add);
    context.check()?;
    Ok(eighths.into_iter().map(|numbers| numbers.map(|n| n / 8)).collect())
}

/// Label of one of the eight voxels at a corner (bits of `side`: x, y, z), which lies between the voxels `corner - 1` and
/// `corner`; background outside of the image.
pub fn label_at_corner(image: &LabelImage, corner: &[usize; 3], side: usize) -> Label {
    let step = [side & 1, side >> 1 & 1, side >> 2];
    let voxel: [i32; 3] = std::array::from_fn(|axis| (corner[axis] + step[axis]) as i32 - 1);
    image.at_or_background(IVec3::from_array(voxel))
}

/// What a corner adds to the 26- and the 6-connected Euler number, in eighths, by which of its eight voxels are set: closed
/// voxels are there where any voxel around is set, open ones where all are.
pub fn corner_contributions() -> [[i64; 256]; 2] {
    let mut tables = [[0; 256]; 2];
    for bits in 0..256usize {
        // Cells at the corner: those of the voxels that agree with `side` on the axes in `mask`; a mask of three axes is a
        // voxel, of two a square, of one an edge, of none the corner itself.
        for mask in 0..8usize {
            for side in (0..8usize).filter(|side| side & !mask == 0) {
                let mut around = (0..8usize).filter(|c| c & mask == side).map(|c| bits >> c & 1 == 1);
                let (is_any, is_all) = (around.clone().any(|b| b), around.all(|b| b));
                let dimension = mask.count_ones();
                let weight = if dimension % 2 == 0 { 8 >> dimension } else { -(8 >> dimension) };
                tables[0][bits] += if is_any { weight } else { 0 };
                // Open cells count with the other sign: a voxel alone has Euler number 1 either way.
                tables[1][bits] -= if is_all { weight } else { 0 };
            }
        }
    }
    tables
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use glam::{DMat3, DVec3};

    #[test]
    fn euler_numbers_are_those_of_known_bodies() {
        const SIZE: [usize; 3] = [12, 11, 10];
        let context = RunContext::with_threads(1).unwrap();
        let number = |is_set: &dyn Fn([usize; 3]) -> bool| {
            let at = |i: usize| [i % SIZE[0], i / SIZE[0] % SIZE[1], i / SIZE[0] / SIZE[1]];
            let grid = Grid::new(SIZE, DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, DMat3::IDENTITY).unwrap();
            let voxels = (0..SIZE.iter().product()).map(|i| Label(u16::from(is_set(at(i))))).collect();
            euler_numbers(&LabelImage::new(grid, voxels, vec![0, 1]).unwrap(), &context).unwrap()[1]
        };
        assert_eq!(number(&|p| p == [0, 0, 0]), [1, 1]);
        assert_eq!(number(&|p| p == [4, 4, 4] || p == [5, 5, 4]), [1, 2]);
        assert_eq!(number(&|p| p == [4, 4, 4] || p == [5, 5, 5]), [1, 2]);
        let ring = |p: [usize; 3]| p[2] == 3 && p[0] < 3 && p[1] < 3 && p[..2] != [1, 1];
        assert_eq!(number(&ring), [0, 0]);
        let shell = |p: [usize; 3]| p.iter().all(|x| (1..4).contains(x)) && p != [2, 2, 2];
        assert_eq!(number(&shell), [2, 2]);
    }
}
