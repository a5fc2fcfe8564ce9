//! Exact anisotropic Euclidean distance from every voxel to the nearest voxel of another label, all labels at once.
//!
//! # Method
//! 1. Along i: each run of one label takes the distance to the nearer of the two voxels that bound it.
//! 2. Along j, then k: within each run of one label, the lower envelope of the parabolas `f(q) + w (p - q)^2`; the two
//!    voxels that bound the run contribute parabolas of height 0.
//!
//! A voxel beyond the bounding voxel is never nearer than the bounding voxel itself, so runs are independent and one
//! pass serves all labels: it is the inside distance of every label, and its sign for a label L at a point is positive
//! where the point's label is L.
//!
//! # Source
//! [Felzenszwalb2012] for the envelope, [Maurer2003] for the separation into axes.
//!
//! # Differences
//! One multi-label pass in place of one transform per label.
//!
//! # Invariants
//! Distances are in mm between voxel centres of the image. Of what lies outside nothing is known: a surface that the border cuts goes
//! straight on there.
//!
//! # Cost
//! Linear time, 4 bytes a voxel; parallel over slices, the same bits for any number of threads.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::label_image::LabelImage;
use crate::index::Label;

/// Distance in mm of each voxel's centre to the nearest centre of another label, i fastest; infinite where there is
/// none.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`] from the context.
pub fn distance_to_other_labels(image: &LabelImage, context: &RunContext) -> Result<Vec<f32>> {
    let [ni, nj, _] = image.grid().size();
    let spacing = image.grid().spacing();
    let labels = image.voxels();
    let mut squared = vec![0.0f32; labels.len()];
    squared.par_chunks_mut(ni * nj).enumerate().try_for_each(|(k, slice)| {
        context.check()?;
        let slice_labels = &labels[k * ni * nj..][..ni * nj];
        for (row, row_labels) in slice.chunks_exact_mut(ni).zip(slice_labels.chunks_exact(ni)) {
            along_row(row_labels, row, spacing.x);
        }
        let mut column = Column::new(nj, spacing.y);
        for i in 0..ni {
            column.transform(|j| slice_labels[i + ni * j], slice, |j| i + ni * j);
        }
        Ok::<(), crate::Error>(())
    })?;
    along_k(image, &mut squared, context)?;
    Ok(squared)
}

/// The pass along k and the square roots, parallel over j.
fn along_k(image: &LabelImage, squared: &mut [f32], context: &RunContext) -> Result<()> {
    let [ni, nj, nk] = image.grid().size();
    let labels = image.voxels();
    let mut planes: Vec<Vec<&mut [f32]>> = (0..nj).map(|_| Vec::with_capacity(nk)).collect();
    for (row, slice) in squared.chunks_exact_mut(ni).enumerate() {
        planes[row % nj].push(slice);
    }
    planes.into_par_iter().enumerate().try_for_each(|(j, mut rows)| {
        context.check()?;
        let mut plane = vec![0.0f32; ni * nk];
        let mut column = Column::new(nk, image.grid().spacing().z);
        for (k, row) in rows.iter().enumerate() {
            plane[k * ni..][..ni].copy_from_slice(row);
        }
        for i in 0..ni {
            column.transform(|k| labels[i + ni * (j + nj * k)], &mut plane, |k| i + ni * k);
        }
        for (k, row) in rows.iter_mut().enumerate() {
            for (target, value) in row.iter_mut().zip(&plane[k * ni..]) {
                *target = value.sqrt();
            }
        }
        Ok(())
    })
}

/// Squared distance along the row to the nearer end of each run of one label.
fn along_row(labels: &[Label], row: &mut [f32], spacing: f64) {
    let mut begin = 0;
    for run in labels.chunk_by(|a, b| a == b) {
        let end = begin + run.len();
        let (open_left, open_right) = (begin == 0, end == labels.len());
        for (p, value) in row[begin..end].iter_mut().enumerate() {
            let left = if open_left { usize::MAX } else { p + 1 };
            let right = if open_right { usize::MAX } else { run.len() - p };
            let nearest = left.min(right);
            *value = if nearest == usize::MAX { f32::INFINITY } else { (nearest as f64 * spacing).powi(2) as f32 };
        }
        begin = end;
    }
}

/// Scratch of the envelope along one line of voxels.
struct Column {
    weight: f64,
    labels: Vec<Label>,
    heights: Vec<f64>,
    /// Positions of the parabolas on the envelope, and where each begins to be the lowest.
    apexes: Vec<(usize, f64)>,
}

impl Column {
    fn new(length: usize, spacing: f64) -> Self {
        let (labels, heights) = (vec![Label::BACKGROUND; length], vec![0.0; length]);
        Self { weight: spacing * spacing, labels, heights, apexes: Vec::with_capacity(length) }
    }

    fn transform(&mut self, label: impl Fn(usize) -> Label, values: &mut [f32], at: impl Fn(usize) -> usize) {
        let length = self.labels.len();
        for p in 0..length {
            self.labels[p] = label(p);
            self.heights[p] = f64::from(values[at(p)]);
        }
        let mut begin = 0;
        while begin < length {
            let own = self.labels[begin];
            let end = begin + self.labels[begin..].iter().take_while(|l| **l == own).count();
            let (open_left, open_right) = (begin == 0, end == length);
            self.envelope(begin, end);
            let mut current = 0;
            for p in begin..end {
                let mut best = f64::INFINITY;
                if !self.apexes.is_empty() {
                    while current + 1 < self.apexes.len() && self.apexes[current + 1].1 <= p as f64 {
                        current += 1;
                    }
                    let apex = self.apexes[current].0;
                    best = self.heights[apex] + self.weight * (p as f64 - apex as f64).powi(2);
                }
                if !open_left {
                    best = best.min(self.weight * ((p + 1 - begin) as f64).powi(2));
                }
                if !open_right {
                    best = best.min(self.weight * ((end - p) as f64).powi(2));
                }
                values[at(p)] = best as f32;
            }
            begin = end;
        }
    }

    /// Lower envelope of the parabolas of one run.
    fn envelope(&mut self, begin: usize, end: usize) {
        self.apexes.clear();
        for q in begin..end {
            if self.heights[q] == f64::INFINITY {
                continue;
            }
            let mut from = f64::NEG_INFINITY;
            while let Some(&(v, start)) = self.apexes.last() {
                let (fq, fv) = (self.heights[q], self.heights[v]);
                // [Felzenszwalb2012]: the parabolas of q and v cross at the mean position plus a share of the heights.
                let cross = 0.5 * ((q + v) as f64 + (fq - fv) / (self.weight * (q - v) as f64));
                if cross > start {
                    from = cross;
                    break;
                }
                self.apexes.pop();
            }
            self.apexes.push((q, from));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use glam::{DMat3, DVec3, IVec3};

    fn brute_force(image: &LabelImage) -> Vec<f32> {
        let [ni, nj, nk] = image.grid().size();
        let spacing = image.grid().spacing();
        let mut result = Vec::new();
        let positions = |n: usize| 0..n as i32;
        for (k, j, i) in itertools3(nk, nj, ni) {
            let own = image.at(i, j, k);
            let mut best = f64::INFINITY;
            for z in positions(nk) {
                for y in positions(nj) {
                    for x in positions(ni) {
                        if image.at_or_background(IVec3::new(x, y, z)) != own {
                            let step = (IVec3::new(x, y, z) - IVec3::new(i as i32, j as i32, k as i32)).as_dvec3();
                            best = best.min((step * spacing).length());
                        }
                    }
                }
            }
            result.push(best as f32);
        }
        result
    }

    fn itertools3(nk: usize, nj: usize, ni: usize) -> impl Iterator<Item = (usize, usize, usize)> {
        (0..nk).flat_map(move |k| (0..nj).flat_map(move |j| (0..ni).map(move |i| (k, j, i))))
    }

    #[test]
    fn it_equals_brute_force_on_random_labels() {
        let context = RunContext::with_threads(2).unwrap();
        let mut state = 12345u64;
        for (labels, spacing) in [(2u64, DVec3::ONE), (4, DVec3::new(0.7, 1.3, 2.9)), (3, DVec3::new(2.0, 0.4, 1.0))] {
            let size = [9, 8, 7];
            let grid = Grid::new(size, spacing, DVec3::ZERO, DMat3::IDENTITY).unwrap();
            let voxels: Vec<Label> = (0..504)
                .map(|_| {
                    state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                    Label(if (state >> 40).is_multiple_of(3) { ((state >> 33) % labels) as u16 } else { 1 })
                })
                .collect();
            let image = LabelImage::new(grid, voxels, (0..labels as i32).collect()).unwrap();
            let fast = context.install(|| distance_to_other_labels(&image, &context)).unwrap();
            for (f, b) in fast.iter().zip(brute_force(&image)) {
                assert!((f - b).abs() <= 1e-5 * b, "{f} {b}");
            }
        }
    }

    #[test]
    fn an_image_of_one_label_has_no_distance() {
        let context = RunContext::with_threads(1).unwrap();
        let grid = Grid::new([3, 3, 3], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        for label in [0, 1] {
            let image = LabelImage::new(grid, vec![Label(label); 27], vec![0, 7]).unwrap();
            assert!(distance_to_other_labels(&image, &context).unwrap().iter().all(|d| d.is_infinite()));
        }
    }
}
