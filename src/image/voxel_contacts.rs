//! Voxels of a label that touch only at a corner or along an edge.
//!
//! # Method
//! ```text
//!     corner contact: p and q opposite in a cube of 8       edge contact: p and q opposite in a square of 4
//! ```
//! Contacts at corners are also found from the other side: six voxels of a label in a cube of 8 whose other two, p and q, are
//! opposite.
//!
//! # Source
//! [Drakopoulos2017] 2.3.2.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::euler_numbers::label_at_corner;
use crate::image::label_image::LabelImage;
use crate::index::Label;

/// Two corners of a cube between which the surface of a label pinches: both are of the label, or neither is.
#[derive(Debug, Clone, Copy)]
pub struct Contact {
    /// A corner of the cube, bits x, y, z.
    pub p: usize,
    /// The one opposite, in the cube or in a square of it.
    pub q: usize,
    /// The label whose surface pinches.
    pub label: Label,
}

/// The cubes that hold contacts, by their first voxels, in order.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn cubes_with_contacts(image: &LabelImage, context: &RunContext) -> Result<Vec<[usize; 3]>> {
    let [ni, nj, nk] = image.grid().size();
    let holds_contact = |at: &[usize; 3]| find_contact(image, *at).is_some();
    let of_row = |row| (0..ni).map(move |i| [i, row % nj, row / nj]).filter(holds_contact);
    let cubes = context.until_cancelled(0..nj * nk).flat_map_iter(of_row).collect();
    context.check()?;
    Ok(cubes)
}

/// Voxel `corner` (bits x, y, z) of the cube at `at`, where it is inside the image.
pub fn voxel_of(image: &LabelImage, at: [usize; 3], corner: usize) -> Option<[usize; 3]> {
    let voxel = [at[0] + (corner & 1), at[1] + (corner >> 1 & 1), at[2] + (corner >> 2)];
    let size = image.grid().size();
    (0..3).all(|axis| voxel[axis] < size[axis]).then_some(voxel)
}

/// The label of voxel `corner` of the cube at `at`, where that is inside the image.
pub fn label_of(image: &LabelImage, at: [usize; 3], corner: usize) -> Option<Label> {
    voxel_of(image, at, corner).map(|[i, j, k]| image.at(i, j, k))
}

/// Two corners p and q of the cube at `at` and a label whose surface pinches between them: a corner-only contact, in a
/// cube of 8, of the label or of what is not of it, or an edge-only contact in a square through corner 0.
pub fn find_contact(image: &LabelImage, at: [usize; 3]) -> Option<Contact> {
    if voxel_of(image, at, 7).is_some() {
        let labels: [Label; 8] = std::array::from_fn(|c| label_at_corner(image, &at.map(|x| x + 1), c));
        for (p, q) in [(0, 7), (1, 6), (2, 5), (3, 4)] {
            let others = || (0..8).filter(|c| *c != p && *c != q).map(|c| labels[c]);
            let (ends, side) = (labels[p], labels[p ^ 1]);
            let joins = labels[q] == ends && !ends.is_background() && others().all(|l| l != ends);
            let parts = !side.is_background() && others().all(|l| l == side) && ends != side && labels[q] != side;
            if joins || parts {
                return Some(Contact { p, q, label: if joins { ends } else { side } });
            }
        }
    }
    for (a, b) in [(1, 2), (1, 4), (2, 4)] {
        for [p, q, c, d] in [[0, a + b, a, b], [a, b, 0, a + b]] {
            let (Some(own), Some(other)) = (label_of(image, at, p), label_of(image, at, q)) else { continue };
            if own == other
                && !own.is_background()
                && label_of(image, at, c).is_some_and(|l| l != own)
                && label_of(image, at, d).is_some_and(|l| l != own)
            {
                return Some(Contact { p, q, label: own });
            }
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use glam::{DMat3, DVec3};

    /// The first contact of the cube of 8 voxels with some labels, in the order of the bits of corners.
    fn contact_of(labels: [u16; 8]) -> Option<(usize, usize, u16)> {
        let grid = Grid::new([2, 2, 2], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let image = LabelImage::new(grid, labels.map(Label).to_vec(), vec![0, 1, 2]).unwrap();
        find_contact(&image, [0; 3]).map(|contact| (contact.p, contact.q, contact.label.0))
    }

    #[test]
    fn contacts_are_at_edges_and_at_corners_from_both_sides() {
        assert_eq!(contact_of([1, 0, 0, 1, 0, 0, 0, 0]), Some((0, 3, 1)), "along an edge");
        assert_eq!(contact_of([1, 0, 0, 0, 0, 0, 0, 1]), Some((0, 7, 1)), "at a corner");
        assert_eq!(contact_of([2, 1, 1, 1, 1, 1, 1, 0]), Some((0, 7, 1)), "all but two opposite corners");
        assert_eq!(contact_of([0, 0, 0, 0, 1, 0, 0, 0]), None, "one voxel");
        assert_eq!(contact_of([1, 1, 0, 1, 0, 0, 0, 0]), None, "joined through a face");
        assert_eq!(contact_of([1, 2, 2, 1, 1, 2, 2, 1]), Some((0, 3, 1)), "two labels that cross");
    }
}
