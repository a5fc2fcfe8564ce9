//! Which labels lie face to face somewhere near a voxel.
//!
//! # Method
//! Pairs of voxels that share a face, the 6-adjacency, in a cube around the voxel; the background surrounds the image.
//!
//! # Source
//! [KongRosenfeld1989] for adjacencies.

use glam::IVec3;

use crate::image::label_image::LabelImage;
use crate::index::Label;

/// Whether voxels of two labels lie face to face, one of them within `reach` voxels along each axis.
pub fn touch_near(image: &LabelImage, place: IVec3, labels: [Label; 2], reach: i32) -> bool {
    let touches = |at: IVec3| {
        let own = image.at_or_background(at);
        let is_other = |step: IVec3| {
            let other = image.at_or_background(at + step);
            other != own && labels.contains(&other)
        };
        labels.contains(&own) && [IVec3::X, IVec3::Y, IVec3::Z].into_iter().any(is_other)
    };
    let side = || -reach..=reach;
    side().any(|k| side().any(|j| side().any(|i| touches(place + IVec3::new(i, j, k)))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use glam::{DMat3, DVec3};

    #[test]
    fn labels_touch_where_their_voxels_share_a_face_and_not_across_a_wall() {
        // Slabs: label 1 up to the image border, a wall of label 2, label 3 in one row behind it.
        let grid = Grid::new([9, 5, 5], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let label = |v: usize| match v % 9 {
            0..4 => 1,
            4 => 2,
            x => {
                if v / 9 == 12 && x < 7 {
                    3
                } else {
                    0
                }
            }
        };
        let image = LabelImage::new(grid, (0..225).map(|v| Label(label(v))).collect(), vec![0, 1, 2, 3]).unwrap();
        let touch =
            |at: [i32; 3], pair: [u16; 2], reach: i32| touch_near(&image, IVec3::from(at), pair.map(Label), reach);
        assert!(touch([4, 2, 2], [1, 2], 1) && touch([4, 2, 2], [3, 2], 0) && touch([4, 2, 2], [2, 0], 1));
        assert!(!touch([4, 2, 2], [1, 3], 2) && !touch([4, 2, 2], [1, 0], 1));
        // What surrounds the image is background.
        assert!(touch([0, 2, 2], [0, 1], 1) && touch([2, 4, 2], [0, 1], 0) && !touch([2, 2, 2], [0, 1], 1));
    }
}
