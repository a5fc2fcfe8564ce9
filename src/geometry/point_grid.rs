//! Pairs of points closer than a distance, by hashing into cells of that size.
//!
//! # Cost
//! O(n) for points that do not crowd in a cell; deterministic order.

use glam::{DVec3, I64Vec3};
use rustc_hash::FxHashMap;

/// All pairs `(i, j)`, `i < j`, of points closer than `distance`, sorted.
pub fn close_pairs(points: &[DVec3], distance: f64) -> Vec<(usize, usize)> {
    if !distance.is_normal() || distance < 0.0 {
        return Vec::new();
    }
    let cell_of = |p: DVec3| (p / distance).floor().as_i64vec3();
    let mut cells: FxHashMap<I64Vec3, Vec<u32>> = FxHashMap::default();
    for (i, p) in points.iter().enumerate() {
        cells.entry(cell_of(*p)).or_default().push(i as u32);
    }
    let mut pairs = Vec::new();
    for (i, &p) in points.iter().enumerate() {
        let cell = cell_of(p);
        for offset in 0..27 {
            let step = I64Vec3::new(offset % 3 - 1, offset / 3 % 3 - 1, offset / 9 - 1);
            let Some(items) = cells.get(&cell.wrapping_add(step)) else { continue };
            let near = items.iter().map(|&j| j as usize).filter(|&j| j > i && points[j].distance(p) < distance);
            pairs.extend(near.map(|j| (i, j)));
        }
    }
    pairs.sort_unstable();
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_are_found_across_cells() {
        let points = [DVec3::ZERO, DVec3::splat(1e-7), DVec3::splat(-1e-7), DVec3::ONE];
        assert_eq!(close_pairs(&points, 1e-6), [(0, 1), (0, 2), (1, 2)]);
        assert!(close_pairs(&points, 0.0).is_empty());
    }
}
