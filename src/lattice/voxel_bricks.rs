//! Voxels of a band in bricks along x, so that one instruction works on several.
//!
//! # Method
//! A brick has `WIDTH` voxels in a row along x. What is one voxel before or after a brick is stored before or after it; the bricks
//! beside it in y and z are listed:
//! ```text
//!    y  |  . o o o | o o o . |           o band; each brick that holds a voxel of the band or is next to one is stored
//!       |  . . o o | o o o o | o . . .
//!       x ->
//! ```
//! Bricks are stored row after row, plane after plane, so that those of a plane have numbers in a row. Their place in an array for a
//! plane alone is behind [`BEFORE_PLANE`] bricks, the second of which stands for all that are not stored there too.
//!
//! # Invariants
//! The first and the last voxel of a row of bricks are not in the band.
//!
//! # Cost
//! 12 bytes per voxel of a brick, 4 per voxel of the band; of bands four voxels thick three quarters of the former are in the band.

use std::ops::Range;

/// Voxels of a brick: as many as a vector register of the plainest processors holds.
pub const WIDTH: usize = 4;

/// Bricks before the first, the second of which stands for all that are not stored; one more follows the last.
const EMPTY_BRICKS: usize = 2;

/// Bricks before the first of a plane, in an array for a plane alone; one more follows the last.
pub const BEFORE_PLANE: usize = 2;

/// First slot of a brick that is not stored.
const EMPTY: u32 = WIDTH as u32;

/// Where the voxels of a band are stored.
#[derive(Debug, Clone, Default)]
pub struct Bricks {
    /// First slots of the bricks beside each: +y, -y, +z, -z, +y +z, -y -z.
    beside: Vec<[u32; 6]>,
    /// Places of the same bricks in arrays for their planes.
    places: Vec<[u32; 6]>,
    /// Slot of each voxel of the band, in order.
    slots: Vec<u32>,
    /// The first brick of each plane in z, and the end of the last.
    planes: Vec<usize>,
}

impl Bricks {
    /// Bricks for the voxels of a box that are in the band, x fastest.
    pub fn new(is_in_band: &[bool], size: [usize; 3]) -> Self {
        // A voxel before and one after each row: the first and last of a brick's row are never in the band.
        let along = (size[0] + 2).div_ceil(WIDTH);
        let mut first_slots = vec![EMPTY; along * size[1] * size[2]];
        let mut places = Vec::new();
        for (row, voxels) in is_in_band.chunks(size[0].max(1)).enumerate() {
            for (i, _) in voxels.iter().enumerate().filter(|(_, is_in)| **is_in) {
                let at = along * row;
                first_slots[at + i / WIDTH..=at + (i + 2) / WIDTH].fill(0);
                places.push((at + (i + 1) / WIDTH, (i + 1) % WIDTH));
            }
        }
        let mut bricks = Self::default();
        let mut stored = Vec::new();
        for (at, slot) in first_slots.iter_mut().enumerate().filter(|(_, slot)| **slot != EMPTY) {
            *slot = ((stored.len() + EMPTY_BRICKS) * WIDTH) as u32;
            stored.push(at);
        }
        let stored_before = |plane: usize| stored.partition_point(|at| *at < plane * along * size[1]);
        bricks.planes.extend((0..=size[2]).map(|plane| EMPTY_BRICKS + stored_before(plane)));
        let steps = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]];
        for at in stored {
            let [x, y, z] = [at % along, at / along % size[1], at / along / size[1]];
            // First slots, and places in the planes.
            let beside = steps.map(|[up, far]| match (y.checked_add_signed(up), z.checked_add_signed(far)) {
                (Some(y), Some(z)) if y < size[1] && z < size[2] => {
                    let slot = first_slots[x + along * (y + size[1] * z)];
                    let place = slot as usize / WIDTH + BEFORE_PLANE;
                    (slot, if slot == EMPTY { BEFORE_PLANE - 1 } else { place - bricks.planes[z] })
                }
                _ => (EMPTY, BEFORE_PLANE - 1),
            });
            bricks.beside.push(beside.map(|(slot, _)| slot));
            bricks.places.push(beside.map(|(_, place)| place as u32));
        }
        bricks.slots.extend(places.into_iter().map(|(brick, lane)| first_slots[brick] + lane as u32));
        bricks
    }

    /// Slot of each voxel of the band, in order.
    pub fn slots(&self) -> &[u32] {
        &self.slots
    }

    /// Number of slots, those of bricks that are not stored included.
    pub fn slot_count(&self) -> usize {
        (self.beside.len() + EMPTY_BRICKS + 1) * WIDTH
    }

    /// Number of bricks that are stored.
    pub fn len(&self) -> usize {
        self.beside.len()
    }

    /// Whether no brick is stored.
    pub fn is_empty(&self) -> bool {
        self.beside.is_empty()
    }

    /// Number of planes.
    pub fn plane_count(&self) -> usize {
        self.planes.len().saturating_sub(1)
    }

    /// The bricks of some planes.
    pub fn of_planes(&self, planes: Range<usize>) -> Range<usize> {
        if planes.is_empty() { 0..0 } else { self.planes[planes.start]..self.planes[planes.end] }
    }

    /// First slots of the bricks beside some: +y, -y, +z, -z, +y +z, -y -z.
    pub fn beside(&self, bricks: Range<usize>) -> &[[u32; 6]] {
        &self.beside[within(bricks)]
    }

    /// Places of the bricks beside some, in the same order, in arrays for their planes.
    pub fn places(&self, bricks: Range<usize>) -> &[[u32; 6]] {
        &self.places[within(bricks)]
    }

    /// Slots of the voxels after and before one of the band along each axis.
    pub fn neighbors(&self, slot: u32) -> [[usize; 2]; 3] {
        let at = slot as usize;
        let beside = self.beside[at / WIDTH - EMPTY_BRICKS];
        let of = |brick: usize| beside[brick] as usize + at % WIDTH;
        [[at + 1, at - 1], [of(0), of(1)], [of(2), of(3)]]
    }
}

/// Numbers of some bricks, from the first stored one on; of none 0..0.
fn within(bricks: Range<usize>) -> Range<usize> {
    bricks.start.saturating_sub(EMPTY_BRICKS)..bricks.end.saturating_sub(EMPTY_BRICKS)
}

/// What an array by slots has for some bricks.
pub fn lanes_of<T>(values: &[T], bricks: Range<usize>) -> &[[T; WIDTH]] {
    &values.as_chunks().0[bricks]
}

/// What an array by slots has for a brick.
#[inline]
pub fn lanes<T>(values: &[T], slot: usize) -> &[T; WIDTH] {
    // One check of the bounds for all lanes.
    values[slot..].first_chunk().expect("an empty brick is last")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bricks_of_a_plane_are_in_a_row_and_know_those_beside_them() {
        let size = [9, 4, 5];
        let is_in_band: Vec<bool> = (0..size.iter().product()).map(|n: usize| n * n % 7 < 3 && n / 36 != 2).collect();
        let bricks = Bricks::new(&is_in_band, size);
        let voxels: Vec<usize> = (0..is_in_band.len()).filter(|n| is_in_band[*n]).collect();
        let slot_of = |n: usize| voxels.binary_search(&n).map(|at| bricks.slots()[at] as usize);
        assert_eq!(bricks.of_planes(0..5).len(), bricks.len());
        assert!(bricks.of_planes(2..3).is_empty() && bricks.of_planes(3..3).is_empty());
        let mut met = 0;
        for (n, slot) in voxels.iter().zip(bricks.slots()) {
            let brick = *slot as usize / WIDTH;
            let plane = n / 36;
            assert!(bricks.of_planes(plane..plane + 1).contains(&brick));
            let at = [n % 9, n / 9 % 4, plane];
            let neighbors = bricks.neighbors(*slot);
            let ([beside], [places]) = (bricks.beside(brick..brick + 1), bricks.places(brick..brick + 1)) else {
                panic!()
            };
            for (n, (slot, place)) in beside.iter().zip(places).enumerate() {
                let plane = [plane, plane, plane + 1, plane.wrapping_sub(1), plane + 1, plane.wrapping_sub(1)][n];
                let expected = if *slot == EMPTY { 1 } else { 2 + *slot as usize / WIDTH - bricks.planes[plane] };
                assert_eq!(*place as usize, expected);
            }
            for (axis, stride) in [1, 9, 36].into_iter().enumerate() {
                if at[axis] + 1 < size[axis] && is_in_band[n + stride] {
                    assert_eq!(Ok(neighbors[axis][0]), slot_of(n + stride));
                    met += 1;
                }
                if at[axis] > 0 && is_in_band[n - stride] {
                    assert_eq!(Ok(neighbors[axis][1]), slot_of(n - stride));
                }
            }
        }
        assert!(met > 50, "{met}");
        assert_eq!(Bricks::new(&[], [0; 3]).plane_count(), 0);
    }
}
