//! Resected tissue: where it is gone, and the model without it.
//!
//! # Method
//! 1. The tissue of the fixed scan: its foreground, without what is darker than a share of the median.
//! 2. Expected brightness: the mean fixed value per level of the warped moving scan. A voxel misses its tissue where the warped
//!    segmentation has a label and the fixed scan is dark and much darker than expected.
//! 3. Seeds: missing voxels whose face neighbours are missing too. Connected groups of seeds that touch the tumour and are
//!    large enough are the cavity; it grows back into the dark voxels that touch it.
//! 4. The model: warped labels where the fixed scan has tissue, but brain for tumour near the cavity; the cavity and a layer around the brain become filling, so that
//!    the field stays defined and smooth there.
//!
//! # Source
//! [Drakopoulos2017] section 3.7.2 (warped segmentation correction); the filling is ours.
//!
//! # Differences
//! The thesis relabels the tumour that falls on the background of a mask of the fixed scan, and resets the field there to zero, which
//! folds it at the rim; here brain beside the tumour can be resected too, and the field in the cavity is that of the soft filling.
//!
//! # Limits
//! A cavity as bright as tissue is not found; the caller then gives a mask of the fixed scan.

use super::displacement_field::neighbors;
use super::options::Resection;
use crate::image::label_image::LabelImage;
use crate::index::Label;

/// Darker than this share of the median of the tissue counts as fluid or air: between fluid (0.35 to 0.5) and grey matter (0.75) of
/// T1-weighted scans.
const DARK: f32 = 0.62;

/// Darker than this share of the expected brightness counts as missing.
const MISSING: f32 = 0.72;

/// Levels of the expected brightness.
const LEVELS: usize = 48;

/// Smallest group of seeds that counts, mm^3.
const MIN_GROUP: f64 = 250.0;

/// A cavity smaller than this is not believed unless the caller says that tissue was resected, mm^3.
const MIN_CAVITY: f64 = 800.0;

/// How far the seeds grow back, mm.
const GROWTH: f64 = 8.0;

/// Around the cavity the warped segmentation is not trusted, mm: a wall that collapses lies where the tumour was, until the loop has
/// moved it away.
pub const CAVITY_REACH: f64 = 12.0;

/// Reach of the tumour: groups this near to it count as touching, mm.
const REACH: f64 = 5.0;

/// Both scans on one grid.
#[derive(Debug, Clone, Copy)]
pub struct Scene<'a> {
    /// Voxels of the grid.
    pub size: [usize; 3],
    /// Spacing, mm.
    pub spacing: f64,
    /// Values of the fixed scan, 0 background.
    pub fixed: &'a [f32],
    /// Tissue of the fixed scan, fluid included.
    pub foreground: &'a [bool],
    /// Whether the foreground is a mask given by the caller: then what is outside of it is gone.
    pub foreground_is_given: bool,
    /// Values of the warped moving scan, 0 background.
    pub warped: &'a [f32],
    /// Warped segmentation.
    pub labels: &'a LabelImage,
}

/// Voxels whose tissue is gone.
pub fn find_cavity(scene: &Scene, mode: Resection) -> Vec<bool> {
    let none = vec![false; scene.fixed.len()];
    if mode == Resection::Off {
        return none;
    }
    let Some(tumor) = scene.labels.label_of(2) else { return none };
    let labels = scene.labels.voxels();
    let dark = dark_voxels(scene);
    let expected = expected_values(scene);
    let missing: Vec<bool> = (0..dark.len())
        .map(|at| labels[at] != Label::BACKGROUND && dark[at] && scene.fixed[at] < MISSING * expected[at])
        .collect();
    let size = scene.size;
    let seeds: Vec<bool> =
        (0..dark.len()).map(|at| missing[at] && neighbors(at, size).filter(|n| missing[*n]).count() >= 6).collect();
    let near_tumor =
        grow(labels.iter().map(|l| *l == tumor).collect(), |_| true, size, (REACH / scene.spacing).ceil() as usize);
    let voxel = scene.spacing.powi(3);
    let kept = groups_touching(&seeds, &near_tumor, size, (MIN_GROUP / voxel).ceil() as usize);
    let steps = (GROWTH / scene.spacing).ceil() as usize;
    let cavity = grow(kept, |at| missing[at] || (dark[at] && labels[at] == tumor), size, steps);
    let volume = cavity.iter().filter(|c| **c).count() as f64 * voxel;
    if mode == Resection::Auto && volume < MIN_CAVITY { none } else { cavity }
}

fn dark_voxels(scene: &Scene) -> Vec<bool> {
    if scene.foreground_is_given {
        return scene.foreground.iter().map(|f| !f).collect();
    }
    let mut tissue: Vec<f32> = scene.fixed.iter().zip(scene.foreground).filter(|(_, f)| **f).map(|(v, _)| *v).collect();
    if tissue.is_empty() {
        return vec![false; scene.fixed.len()];
    }
    let middle = tissue.len() / 2;
    let median = *tissue.select_nth_unstable_by(middle, f32::total_cmp).1;
    scene.fixed.iter().map(|v| *v < DARK * median).collect()
}

/// Mean fixed value per level of the warped value, over the common foreground.
fn expected_values(scene: &Scene) -> Vec<f32> {
    let high = scene.warped.iter().copied().fold(0.0f32, f32::max).max(f32::MIN_POSITIVE);
    let level = |v: f32| ((v / high * LEVELS as f32) as usize).min(LEVELS - 1);
    let (mut sums, mut counts) = ([0.0f64; LEVELS], [0.0f64; LEVELS]);
    for at in 0..scene.fixed.len() {
        if scene.foreground[at] && scene.labels.voxels()[at] == Label(1) {
            sums[level(scene.warped[at])] += f64::from(scene.fixed[at]);
            counts[level(scene.warped[at])] += 1.0;
        }
    }
    // Levels that hardly occur in the brain (the rim of a tumour) take the value of the nearest level that does.
    let least = counts.iter().sum::<f64>() * 1e-3;
    let table: Vec<f32> = (0..LEVELS)
        .map(|l| {
            let frequent = (0..LEVELS).filter(|n| counts[*n] > least).min_by_key(|n| n.abs_diff(l));
            frequent.map_or(0.0, |n| (sums[n] / counts[n]) as f32)
        })
        .collect();
    scene.warped.iter().map(|v| table[level(*v)]).collect()
}

/// Adds the face neighbours that `allowed` accepts, `steps` times.
pub(crate) fn grow(
    mut region: Vec<bool>,
    allowed: impl Fn(usize) -> bool,
    size: [usize; 3],
    steps: usize,
) -> Vec<bool> {
    let mut front: Vec<usize> = (0..region.len()).filter(|at| region[*at]).collect();
    for _ in 0..steps {
        let mut next = Vec::new();
        for at in front {
            for n in neighbors(at, size) {
                if !region[n] && allowed(n) {
                    region[n] = true;
                    next.push(n);
                }
            }
        }
        front = next;
    }
    region
}

/// Connected groups of `seeds` with at least `least` voxels of which one lies in `touch`.
fn groups_touching(seeds: &[bool], touch: &[bool], size: [usize; 3], least: usize) -> Vec<bool> {
    let mut kept = vec![false; seeds.len()];
    let mut seen = vec![false; seeds.len()];
    for start in 0..seeds.len() {
        if !seeds[start] || seen[start] {
            continue;
        }
        seen[start] = true;
        let mut group = vec![start];
        let mut next = 0;
        while next < group.len() {
            for n in neighbors(group[next], size) {
                if seeds[n] && !seen[n] {
                    seen[n] = true;
                    group.push(n);
                }
            }
            next += 1;
        }
        if group.len() >= least && group.iter().any(|at| touch[*at]) {
            group.into_iter().for_each(|at| kept[at] = true);
        }
    }
    kept
}

/// Values with those of `hole` replaced by the mean of their neighbours, layer by layer from its rim: no edge is left there.
pub fn fill_hole(values: &[f32], hole: &[bool], size: [usize; 3]) -> Vec<f32> {
    let mut values = values.to_vec();
    let mut open = hole.to_vec();
    let mut layer: Vec<usize> =
        (0..open.len()).filter(|at| open[*at] && neighbors(*at, size).any(|n| !open[n])).collect();
    while !layer.is_empty() {
        let means: Vec<f32> = layer
            .iter()
            .map(|&at| {
                let (sum, count) = neighbors(at, size)
                    .filter(|n| !open[*n])
                    .fold((0.0, 0.0), |(sum, count), n| (sum + values[n], count + 1.0));
                sum / count
            })
            .collect();
        for (&at, mean) in layer.iter().zip(means) {
            values[at] = mean;
            open[at] = false;
        }
        let mut next: Vec<usize> = layer.iter().flat_map(|&at| neighbors(at, size)).filter(|n| open[*n]).collect();
        next.sort_unstable();
        next.dedup();
        layer = next;
    }
    values
}

/// The corrected segmentation and the model made of it.
#[derive(Debug, Clone)]
pub struct ResectedModel {
    /// Warped labels without the resected tissue.
    pub corrected: LabelImage,
    /// The labels to be meshed: the corrected ones and the filling.
    pub model: LabelImage,
    /// Label value of the filling.
    pub filling: i32,
}

/// Layers of filling around the brain, mm: room for the brain to move in.
const FILLING_LAYER: f64 = 5.0;

/// The segmentation without the cavity, and the model with filling in the cavity and around the brain.
pub fn resected_model(scene: &Scene, cavity: &[bool], layer: bool) -> ResectedModel {
    let size = scene.size;
    let mut corrected = scene.labels.clone();
    let brain = corrected.label_of(1).unwrap_or(Label(1));
    for (at, label) in corrected.voxels_mut().iter_mut().enumerate() {
        if cavity[at] {
            *label = Label::BACKGROUND;
        }
    }
    let filling = corrected.values().iter().copied().max().unwrap_or(0) + 1;
    let mut values = corrected.values().to_vec();
    let filling_label = Label(values.len() as u16);
    values.push(filling);
    let is_tissue = |at: usize| scene.foreground[at] && !cavity[at];
    let tissue: Vec<bool> = (0..cavity.len()).map(is_tissue).collect();
    let steps = if layer { (FILLING_LAYER / scene.spacing).ceil() as usize } else { 0 };
    let covered: Vec<bool> =
        (0..cavity.len()).map(|at| tissue[at] || corrected.voxels()[at] != Label::BACKGROUND || cavity[at]).collect();
    let covered = grow(covered, |_| true, size, steps);
    let near_cavity = grow(cavity.to_vec(), |_| true, size, (CAVITY_REACH / scene.spacing).ceil() as usize);
    let tumor = corrected.label_of(2);
    let voxels = (0..cavity.len())
        .map(|at| {
            let label = corrected.voxels()[at];
            if tissue[at] {
                let unsure = near_cavity[at] && Some(label) == tumor;
                if label == Label::BACKGROUND || unsure { brain } else { label }
            } else if covered[at] {
                filling_label
            } else {
                Label::BACKGROUND
            }
        })
        .collect();
    let model = LabelImage::new(*corrected.grid(), voxels, values).unwrap_or_else(|_| corrected.clone());
    ResectedModel { corrected, model, filling }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use crate::registration::feature_points::voxel_of;
    use glam::{DMat3, DVec3};

    const SIZE: [usize; 3] = [30, 30, 30];

    fn ball(at: usize, center: [f64; 3], radius: f64) -> bool {
        let v = voxel_of(at, SIZE);
        (0..3).map(|axis| (v[axis] as f64 - center[axis]).powi(2)).sum::<f64>() <= radius * radius
    }

    fn find(hole: Option<([f64; 3], f64)>, mode: Resection) -> (usize, ResectedModel) {
        let grid = Grid::new(SIZE, DVec3::splat(2.0), DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let n: usize = SIZE.iter().product();
        let label = |at: usize| {
            if ball(at, [15.0, 15.0, 20.0], 4.0) { 2 } else { u16::from(ball(at, [15.0; 3], 13.0)) }
        };
        let labels = LabelImage::new(grid, (0..n).map(|at| Label(label(at))).collect(), vec![0, 1, 2]).unwrap();
        let warped: Vec<f32> = (0..n).map(|at| [0.0, 1.0, 0.8][label(at) as usize]).collect();
        let fixed: Vec<f32> = (0..n)
            .map(|at| if hole.is_some_and(|(c, r)| ball(at, c, r)) { 0.3 * warped[at] } else { warped[at] })
            .collect();
        let foreground: Vec<bool> = fixed.iter().map(|v| *v > 0.0).collect();
        let scene = Scene {
            size: SIZE,
            spacing: 2.0,
            fixed: &fixed,
            foreground: &foreground,
            foreground_is_given: false,
            warped: &warped,
            labels: &labels,
        };
        let cavity = find_cavity(&scene, mode);
        (cavity.iter().filter(|c| **c).count(), resected_model(&scene, &cavity, true))
    }

    #[test]
    fn a_dark_hole_at_the_tumour_is_a_cavity() {
        let (voxels, model) = find(Some(([15.0, 15.0, 20.0], 5.0)), Resection::Auto);
        let truth = (0..27000).filter(|at| ball(*at, [15.0, 15.0, 20.0], 5.0)).count();
        assert_eq!(voxels, truth);
        assert!(model.corrected.voxels().iter().all(|l| *l != Label(2)));
        assert_eq!(model.filling, 3);
        assert!(model.model.at(15, 15, 20) == Label(3) && model.model.at(15, 15, 8) == Label(1));
    }

    #[test]
    fn a_hole_elsewhere_and_no_hole_are_none() {
        assert_eq!(find(Some(([15.0, 15.0, 5.0], 3.0)), Resection::On).0, 0);
        assert_eq!(find(None, Resection::Auto).0, 0);
        assert_eq!(find(Some(([15.0, 15.0, 20.0], 5.0)), Resection::Off).0, 0);
    }
}
