//! Changes of a segmentation before it is meshed: up-sampling, isolated voxels, regions, contacts.
//!
//! # Method
//! 1. [`upsample`]: each voxel becomes `factor^3` of the same label.
//! 2. [`relabel_isolated`]: voxels without a neighbour of their kind take the commonest label of their 26 neighbours.
//! 3. [`remove_small_regions`], [`separate_regions`]: face-connected regions below a share of their label become
//!    background; each region becomes a label of its own.
//! 4. [`remove_contacts`]: two voxels of a label that touch only at a corner or along an edge are joined through face
//!    neighbours.
//!
//! ```text
//!     corner contact: p and q opposite in a cube of 8       edge contact: p and q opposite in a square of 4
//!     six templates: the three axes in any order            two templates: either of the other two voxels
//!         p -> a -> b -> q, a and b take the label               p -> a -> q, a takes the label
//! ```
//! # Source
//! [Drakopoulos2017] 2.3.2.
//!
//! # Differences
//! A voxel is only ever given to a label of higher priority (background lowest, then the larger labels before the
//! smaller). Where every template would lower a priority, p or q itself goes to the higher label between them. So the
//! sum of priorities rises with each change and the loop ends after at most `voxels * labels` changes.
//!
//! # Invariants
//! The random choice depends on the seed only.

use std::collections::VecDeque;

use rayon::prelude::*;

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
/// [`Error::InvalidArgument`] where the size overflows.
pub fn upsample(image: &LabelImage, factor: usize) -> Result<LabelImage> {
    let grid = image.grid();
    let size = grid.size().map(|s| s.saturating_mul(factor));
    let shift = glam::DVec3::splat((1.0 / factor as f64 - 1.0) / 2.0);
    let origin = grid.index_to_world(shift);
    let fine = Grid::new(size, grid.spacing() / factor as f64, origin, grid.direction())?;
    let mut voxels = vec![Label::BACKGROUND; fine.voxel_count()];
    voxels.par_chunks_mut(size[0]).enumerate().for_each(|(row, target)| {
        let (j, k) = (row % size[1] / factor, row / size[1] / factor);
        for (i, voxel) in target.iter_mut().enumerate() {
            *voxel = image.at(i / factor, j, k);
        }
    });
    LabelImage::new(fine, voxels, image.values().to_vec())
}

/// Relabels isolated voxels of one kind; returns how many voxels of each label changed.
pub fn relabel_isolated(image: &mut LabelImage, kind: IsolatedKind) -> Vec<u64> {
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
    let changes: Vec<(usize, Label)> = (0..nj * nk)
        .into_par_iter()
        .flat_map_iter(|row| (0..ni).filter_map(move |i| isolated(i, row % nj, row / nj)))
        .collect();
    let mut changed = vec![0; image.label_count()];
    for (offset, label) in changes {
        changed[image.voxels()[offset].index()] += 1;
        image.voxels_mut()[offset] = label;
    }
    changed
}

fn neighborhood(at: [usize; 3], size: [usize; 3]) -> impl Iterator<Item = (usize, usize, usize)> {
    let range = move |axis: usize| at[axis].saturating_sub(1)..=(at[axis] + 1).min(size[axis] - 1);
    range(2)
        .flat_map(move |z| range(1).flat_map(move |y| range(0).map(move |x| (x, y, z))))
        .filter(move |(x, y, z)| [*x, *y, *z] != at)
}

/// Turns face-connected regions into background that hold less than `threshold` of their label, never its largest;
/// returns how many voxels of each label changed.
pub fn remove_small_regions(image: &mut LabelImage, threshold: f64) -> Vec<u64> {
    let regions = Components::new(image, Connectivity::Face, Members::Foreground);
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
    changed
}

/// Each face-connected region as a label of its own; the second result is the original label of each.
///
/// # Errors
/// [`Error::CapacityExceeded`] for more than 65535 regions.
pub fn separate_regions(image: &LabelImage) -> Result<(LabelImage, Vec<Label>)> {
    let regions = Components::new(image, Connectivity::Face, Members::Foreground);
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

/// Removes corner-only and edge-only contacts of labels; returns how many voxels changed.
pub fn remove_contacts(image: &mut LabelImage, seed: u64) -> u64 {
    let mut work = Contacts::new(image, seed);
    let mut queue: VecDeque<[usize; 3]> = work.positions_with_contacts().into();
    while let Some(position) = queue.pop_front() {
        for changed in work.repair(position) {
            // Contacts can appear only in cubes that hold the changed voxel.
            let from = changed.map(|c| c.saturating_sub(1));
            for step in 0..8 {
                let near = [from[0] + (step & 1), from[1] + (step >> 1 & 1), from[2] + (step >> 2)];
                if (0..3).all(|axis| near[axis] <= changed[axis]) {
                    queue.push_back(near);
                }
            }
        }
    }
    work.changes
}

struct Contacts<'a> {
    image: &'a mut LabelImage,
    /// Higher values are never given to lower ones.
    priority: Vec<u32>,
    random: u64,
    changes: u64,
}

impl<'a> Contacts<'a> {
    fn new(image: &'a mut LabelImage, seed: u64) -> Self {
        let mut counts = vec![0u64; image.label_count()];
        image.voxels().iter().for_each(|l| counts[l.index()] += 1);
        let mut order: Vec<usize> = (1..counts.len()).collect();
        order.sort_by_key(|l| (std::cmp::Reverse(counts[*l]), *l));
        let mut priority = vec![0; counts.len()];
        order.into_iter().enumerate().for_each(|(rank, label)| priority[label] = rank as u32 + 1);
        Self { image, priority, random: seed ^ 0x9e37_79b9_7f4a_7c15, changes: 0 }
    }

    fn positions_with_contacts(&self) -> Vec<[usize; 3]> {
        let [ni, nj, nk] = self.image.grid().size();
        (0..nj * nk)
            .into_par_iter()
            .flat_map_iter(|row| {
                (0..ni).map(move |i| [i, row % nj, row / nj]).filter(|at| self.find_contact(*at).is_some())
            })
            .collect()
    }

    /// Voxel `corner` (bits x, y, z) of the cube at `at`, where it is inside the image.
    fn corner(&self, at: [usize; 3], corner: usize) -> Option<[usize; 3]> {
        let voxel = [at[0] + (corner & 1), at[1] + (corner >> 1 & 1), at[2] + (corner >> 2 & 1)];
        let size = self.image.grid().size();
        (0..3).all(|axis| voxel[axis] < size[axis]).then_some(voxel)
    }

    fn label(&self, at: [usize; 3], corner: usize) -> Option<Label> {
        self.corner(at, corner).map(|[i, j, k]| self.image.at(i, j, k))
    }

    /// Two corners of the cube at `at` that touch only at a corner, or along an edge of a square through corner 0.
    fn find_contact(&self, at: [usize; 3]) -> Option<(usize, usize)> {
        let is_whole = self.corner(at, 7).is_some();
        for (p, q) in [(0, 7), (1, 6), (2, 5), (3, 4)] {
            let Some(own) = self.label(at, p).filter(|l| is_whole && !l.is_background()) else { continue };
            let alone = |c: usize| c == p || c == q || self.label(at, c) != Some(own);
            if self.label(at, q) == Some(own) && (0..8).all(alone) {
                return Some((p, q));
            }
        }
        for (a, b) in [(1, 2), (1, 4), (2, 4)] {
            for [p, q, c, d] in [[0, a + b, a, b], [a, b, 0, a + b]] {
                let (Some(own), Some(other)) = (self.label(at, p), self.label(at, q)) else { continue };
                if own == other
                    && !own.is_background()
                    && self.label(at, c).is_some_and(|l| l != own)
                    && self.label(at, d).is_some_and(|l| l != own)
                {
                    return Some((p, q));
                }
            }
        }
        None
    }

    fn next_random(&mut self, below: usize) -> usize {
        // xorshift64*: small, and the same everywhere.
        self.random ^= self.random >> 12;
        self.random ^= self.random << 25;
        self.random ^= self.random >> 27;
        ((self.random.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize) % below
    }

    /// Removes one contact of the cube at `at`; returns the changed voxels.
    fn repair(&mut self, at: [usize; 3]) -> Vec<[usize; 3]> {
        let Some((p, q)) = self.find_contact(at) else { return Vec::new() };
        let label = self.label(at, p).expect("a contact lies inside the image");
        let axes: Vec<usize> = [1, 2, 4].into_iter().filter(|axis| (p ^ q) & axis != 0).collect();
        let orders: &[&[usize]] = match axes.len() {
            2 => &[&[0], &[1]],
            _ => &[&[0, 1], &[1, 0], &[0, 2], &[2, 0], &[1, 2], &[2, 1]],
        };
        let templates: Vec<Vec<usize>> = orders
            .iter()
            .map(|order| {
                let mut corner = p;
                order.iter().map(|step| (corner ^= axes[*step], corner).1).collect::<Vec<usize>>()
            })
            .filter(|path: &Vec<usize>| path.iter().all(|c| self.rank(at, *c) < self.priority[label.index()]))
            .collect();
        let changes: Vec<(usize, Label)> = if templates.is_empty() {
            // Some voxel between p and q ranks higher: one of the two joins it.
            let between = (0..8).filter(|c| *c != p && *c != q && (c ^ p) & !(p ^ q) == 0);
            let higher = between.max_by_key(|c| (self.rank(at, *c), *c)).expect("a square has four voxels");
            let end = if self.next_random(2) == 0 { p } else { q };
            vec![(end, self.label(at, higher).expect("it lies between voxels of the image"))]
        } else {
            let choice = self.next_random(templates.len());
            templates[choice].iter().map(|c| (*c, label)).collect()
        };
        let mut changed = Vec::new();
        for (corner, to) in changes {
            let voxel = self.corner(at, corner).expect("templates stay inside the cube of the contact");
            let offset = self.image.grid().offset(voxel[0], voxel[1], voxel[2]);
            self.image.voxels_mut()[offset] = to;
            self.changes += 1;
            changed.push(voxel);
        }
        // The cube may hold another contact.
        changed.push(at);
        changed
    }

    fn rank(&self, at: [usize; 3], corner: usize) -> u32 {
        self.label(at, corner).map_or(u32::MAX, |l| self.priority[l.index()])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3};

    fn image(size: [usize; 3], voxels: Vec<u16>) -> LabelImage {
        let grid = Grid::new(size, DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, DMat3::IDENTITY).unwrap();
        LabelImage::new(grid, voxels.into_iter().map(Label).collect(), vec![0, 1, 2, 3]).unwrap()
    }

    #[test]
    fn upsampling_keeps_the_place() {
        let coarse = image([2, 1, 1], vec![1, 2]);
        let fine = upsample(&coarse, 2).unwrap();
        assert_eq!(fine.grid().size(), [4, 2, 2]);
        assert_eq!((fine.at(1, 1, 1), fine.at(2, 0, 0)), (Label(1), Label(2)));
        let border = |g: &Grid| g.index_to_world(DVec3::splat(-0.5));
        assert!((border(coarse.grid()) - border(fine.grid())).length() < 1e-12);
    }

    #[test]
    fn isolated_voxels_take_the_commonest_label() {
        let mut voxels = vec![1; 27];
        voxels[13] = 0;
        let mut holed = image([3, 3, 3], voxels.clone());
        assert_eq!(relabel_isolated(&mut holed, IsolatedKind::Foreground).iter().sum::<u64>(), 0);
        assert_eq!(relabel_isolated(&mut holed, IsolatedKind::Background)[0], 1);
        assert_eq!(holed.at(1, 1, 1), Label(1));
        voxels[13] = 2;
        let mut speck = image([3, 3, 3], voxels);
        assert_eq!(relabel_isolated(&mut speck, IsolatedKind::Foreground)[2], 1);
        assert_eq!(speck.at(1, 1, 1), Label(1));
    }

    #[test]
    fn small_regions_vanish_and_others_are_told_apart() {
        let mut row = image([8, 1, 1], vec![1, 1, 1, 1, 0, 1, 0, 2]);
        assert_eq!(separate_regions(&row).unwrap().1, [0, 1, 1, 2].map(Label));
        assert_eq!(remove_small_regions(&mut row, 0.1), vec![0, 0, 0, 0]);
        assert_eq!(remove_small_regions(&mut row, 0.5), vec![0, 1, 0, 0]);
    }

    #[test]
    fn no_contact_is_left_in_random_labels() {
        for seed in 0..4u64 {
            let mut state = seed * 77 + 5;
            let voxels = (0..12 * 11 * 10)
                .map(|_| {
                    state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                    ((state >> 41) % 4) as u16
                })
                .collect();
            let mut noise = image([12, 11, 10], voxels);
            let mut again = noise.clone();
            assert!(remove_contacts(&mut noise, 1) > 0);
            assert!(Contacts::new(&mut noise, 1).positions_with_contacts().is_empty());
            remove_contacts(&mut again, 1);
            assert_eq!(noise, again);
        }
    }
}
