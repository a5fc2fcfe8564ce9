//! Changes of a segmentation before it is meshed: up-sampling, isolated voxels, regions, contacts.
//!
//! # Method
//! 1. [`upsample`]: each voxel becomes `factor^3` of the same label.
//! 2. [`relabel_isolated`]: voxels without a neighbour of their kind take the commonest label of their 26 neighbours.
//! 3. [`remove_small_regions`], [`separate_regions`]: face-connected regions below a share of their label become
//!    background; each region becomes a label of its own.
//!
//! # Source
//! [Drakopoulos2017] 2.3.2.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::image::connected_components::{Components, Connectivity, Members};
use crate::image::grid::Grid;
use crate::image::label_image::{LabelImage, MAX_LABELS};
use crate::index::Label;

/// Which isolated voxels [`relabel_isolated`] changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IsolatedKind {
    /// Background voxels whose 26 neighbours are all labelled.
    Background,
    /// Labelled voxels whose 26 neighbours all have other labels.
    Foreground,
}

/// Each voxel becomes `factor^3` voxels; the image covers the same place.
///
/// # Errors
/// [`Error::InvalidArgument`] where the size overflows; [`Error::Cancelled`], [`Error::LimitReached`].
pub fn upsample(image: &LabelImage, factor: usize, context: &RunContext) -> Result<LabelImage> {
    let grid = image.grid();
    let size = grid.size().map(|s| s.saturating_mul(factor));
    let shift = glam::DVec3::splat((1.0 / factor as f64 - 1.0) / 2.0);
    let origin = grid.index_to_world(shift);
    let fine = Grid::new(size, grid.spacing() / factor as f64, origin, grid.direction())?;
    let mut voxels = vec![Label::BACKGROUND; fine.voxel_count()];
    context.until_cancelled(voxels.par_chunks_mut(size[0]).enumerate()).for_each(|(row, target)| {
        let (j, k) = (row % size[1] / factor, row / size[1] / factor);
        for (i, voxel) in target.iter_mut().enumerate() {
            *voxel = image.at(i / factor, j, k);
        }
    });
    context.check()?;
    LabelImage::new(fine, voxels, image.values().to_vec())
}

/// Relabels isolated voxels of one kind; returns how many voxels of each label changed.
///
/// # Errors
/// [`Error::Cancelled`], [`Error::LimitReached`].
pub fn relabel_isolated(image: &mut LabelImage, kind: IsolatedKind, context: &RunContext) -> Result<Vec<u64>> {
    let [ni, nj, nk] = image.grid().size();
    let isolated = |i: usize, j: usize, k: usize| -> Option<(usize, Label)> {
        let own = image.at(i, j, k);
        if own.is_background() != (kind == IsolatedKind::Background) {
            return None;
        }
        let mut around: Vec<Label> = Vec::with_capacity(26);
        for (x, y, z) in neighborhood([i, j, k], [ni, nj, nk]) {
            let label = image.at(x, y, z);
            if label == own {
                return None;
            }
            around.push(label);
        }
        // At the border the outside counts as background.
        if own.is_background() && around.len() < 26 {
            return None;
        }
        around.sort_unstable();
        let commonest = around.chunk_by(|a, b| a == b).max_by_key(|run| (run.len(), std::cmp::Reverse(run[0])))?;
        Some((image.grid().offset(i, j, k), commonest[0]))
    };
    let of_row = |row| (0..ni).filter_map(move |i| isolated(i, row % nj, row / nj));
    let changes: Vec<(usize, Label)> = context.until_cancelled(0..nj * nk).flat_map_iter(of_row).collect();
    context.check()?;
    let mut changed = vec![0; image.label_count()];
    for (offset, label) in changes {
        changed[image.voxels()[offset].index()] += 1;
        image.voxels_mut()[offset] = label;
    }
    Ok(changed)
}

fn neighborhood(at: [usize; 3], size: [usize; 3]) -> impl Iterator<Item = (usize, usize, usize)> {
    let range = move |axis: usize| at[axis].saturating_sub(1)..=(at[axis] + 1).min(size[axis] - 1);
    range(2)
        .flat_map(move |z| range(1).flat_map(move |y| range(0).map(move |x| (x, y, z))))
        .filter(move |(x, y, z)| [*x, *y, *z] != at)
}

/// Turns face-connected regions into background that hold less than `threshold` of their label, never its largest;
/// returns how many voxels of each label changed.
///
/// # Errors
/// [`Error::Cancelled`], [`Error::LimitReached`].
pub fn remove_small_regions(image: &mut LabelImage, threshold: f64, context: &RunContext) -> Result<Vec<u64>> {
    let regions = Components::new(image, Connectivity::Face, Members::Foreground, context)?;
    let labels = image.label_count();
    let (mut totals, mut largest) = (vec![0u64; labels], vec![(0u64, usize::MAX); labels]);
    for (r, region) in regions.components().iter().enumerate() {
        totals[region.label.index()] += region.voxels;
        if region.voxels > largest[region.label.index()].0 {
            largest[region.label.index()] = (region.voxels, r);
        }
    }
    let is_small = |r: usize| {
        let region = regions.components()[r];
        let label = region.label.index();
        largest[label].1 != r && (region.voxels as f64) < threshold * totals[label] as f64
    };
    let mut changed = vec![0; labels];
    let [ni, nj, nk] = image.grid().size();
    for row in 0..nj * nk {
        for run in regions.row(row % nj, row / nj) {
            if is_small(run.component as usize) {
                changed[run.label.index()] += u64::from(run.end - run.begin);
                image.voxels_mut()[row * ni + run.begin as usize..row * ni + run.end as usize].fill(Label::BACKGROUND);
            }
        }
    }
    Ok(changed)
}

/// Each face-connected region as a label of its own; the second result is the original label of each.
///
/// # Errors
/// [`Error::CapacityExceeded`] for more than 65535 regions; [`Error::Cancelled`], [`Error::LimitReached`].
pub fn separate_regions(image: &LabelImage, context: &RunContext) -> Result<(LabelImage, Vec<Label>)> {
    let regions = Components::new(image, Connectivity::Face, Members::Foreground, context)?;
    let count = regions.components().len();
    if count > MAX_LABELS {
        return Err(Error::CapacityExceeded { what: "regions", needed: count as u64, limit: MAX_LABELS as u64 });
    }
    let mut originals = vec![Label::BACKGROUND];
    originals.extend(regions.components().iter().map(|c| c.label));
    let mut voxels = image.voxels().to_vec();
    let [ni, nj, nk] = image.grid().size();
    for row in 0..nj * nk {
        for run in regions.row(row % nj, row / nj) {
            let label = Label(run.component as u16 + 1);
            voxels[row * ni + run.begin as usize..row * ni + run.end as usize].fill(label);
        }
    }
    Ok((LabelImage::new(*image.grid(), voxels, (0..=count as i32).collect())?, originals))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3};

    fn image(size: [usize; 3], voxels: Vec<u16>) -> LabelImage {
        let grid = Grid::new(size, DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, DMat3::IDENTITY).unwrap();
        LabelImage::new(grid, voxels.into_iter().map(Label).collect(), vec![0, 1, 2, 3]).unwrap()
    }

    fn context() -> RunContext {
        RunContext::with_threads(1).unwrap()
    }

    #[test]
    fn upsampling_keeps_the_place() {
        let coarse = image([2, 1, 1], vec![1, 2]);
        let fine = upsample(&coarse, 2, &context()).unwrap();
        assert_eq!(fine.grid().size(), [4, 2, 2]);
        assert_eq!((fine.at(1, 1, 1), fine.at(2, 0, 0)), (Label(1), Label(2)));
        let border = |g: &Grid| g.index_to_world(DVec3::splat(-0.5));
        assert!((border(coarse.grid()) - border(fine.grid())).length() < 1e-12);
    }

    #[test]
    fn isolated_voxels_take_the_commonest_label() {
        let mut voxels = vec![1; 27];
        voxels[13] = 0;
        let relabelled = |image: &mut LabelImage, kind| relabel_isolated(image, kind, &context()).unwrap();
        let mut holed = image([3, 3, 3], voxels.clone());
        assert_eq!(relabelled(&mut holed, IsolatedKind::Foreground).iter().sum::<u64>(), 0);
        assert_eq!(relabelled(&mut holed, IsolatedKind::Background)[0], 1);
        assert_eq!(holed.at(1, 1, 1), Label(1));
        voxels[13] = 2;
        let mut speck = image([3, 3, 3], voxels);
        assert_eq!(relabelled(&mut speck, IsolatedKind::Foreground)[2], 1);
        assert_eq!(speck.at(1, 1, 1), Label(1));
    }

    #[test]
    fn small_regions_vanish_and_others_are_told_apart() {
        let mut row = image([8, 1, 1], vec![1, 1, 1, 1, 0, 1, 0, 2]);
        assert_eq!(separate_regions(&row, &context()).unwrap().1, [0, 1, 1, 2].map(Label));
        assert_eq!(remove_small_regions(&mut row, 0.1, &context()).unwrap(), vec![0, 0, 0, 0]);
        assert_eq!(remove_small_regions(&mut row, 0.5, &context()).unwrap(), vec![0, 1, 0, 0]);
    }

    #[test]
    fn a_cancelled_run_changes_no_image() {
        let mut voxels = vec![1; 27];
        voxels[13] = 2;
        let mut speck = image([3, 3, 3], voxels);
        let before = speck.clone();
        let context = context();
        context.cancel_token().cancel();
        assert!(matches!(upsample(&speck, 2, &context), Err(Error::Cancelled)));
        assert!(matches!(relabel_isolated(&mut speck, IsolatedKind::Foreground, &context), Err(Error::Cancelled)));
        assert!(matches!(remove_small_regions(&mut speck, 0.5, &context), Err(Error::Cancelled)));
        assert!(matches!(separate_regions(&speck, &context), Err(Error::Cancelled)));
        assert_eq!(speck, before);
    }
}
