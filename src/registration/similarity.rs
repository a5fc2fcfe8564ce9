//! Similarity of two blocks: normalised cross-correlation and normalised mutual information, for all offsets of a window.
//!
//! # Method
//! 1. Cross-correlation. The source block is centred once, so that `sum a' b` needs no mean of b; the sums run over eight or sixteen
//!    neighbouring offsets at once, along memory. The spread of b comes from box sums of the whole target.
//! 2. Masked blocks count only their masked voxels, so that a block at a cavity is compared by its tissue alone.
//! 3. Mutual information from a joint histogram of quantised values; entropies from a table of `n ln n`.
//!
//! # Source
//! [Drakopoulos2017] section 3.7.2, eq. 5, for the mutual information; [Bierling1988] for the search.
//!
//! # Differences
//! Eq. 5 reaches 1/2 for equal blocks, while the text gives it the range up to 1; the value here is twice eq. 5.
//!
//! # Cost
//! Cross-correlation: two multiplications per voxel and offset. No allocation: the caller passes the scratch buffers.

use crate::image::gaussian::box_mean;

/// Offsets computed together along the first axis.
const LANES: usize = 8;

/// Levels of the quantised values.
pub const LEVELS: usize = 16;

/// A block: its centre, half size, and the box of offsets that are tried.
#[derive(Debug, Clone, Copy)]
pub struct Search {
    /// Centre of the source block, voxels.
    pub center: [usize; 3],
    /// Half size of the block.
    pub half_block: [usize; 3],
    /// Lowest offset per axis, at most 0.
    pub low: [isize; 3],
    /// Highest offset per axis, at least 0.
    pub high: [isize; 3],
}

impl Search {
    /// The search in an image of `size`, with the window cut where a block would leave the image.
    pub fn new(center: [usize; 3], half_block: [usize; 3], half_window: [usize; 3], size: [usize; 3]) -> Self {
        let (mut low, mut high) = ([0; 3], [0; 3]);
        for axis in 0..3 {
            let room_below = center[axis].saturating_sub(half_block[axis]);
            let room_above = (size[axis] - 1 - center[axis]).saturating_sub(half_block[axis]);
            low[axis] = -(half_window[axis].min(room_below) as isize);
            high[axis] = half_window[axis].min(room_above) as isize;
        }
        Self { center, half_block, low, high }
    }

    /// Offsets tried per axis.
    pub fn extent(&self) -> [usize; 3] {
        [0, 1, 2].map(|axis| (self.high[axis] - self.low[axis] + 1) as usize)
    }
}

/// Sums over the block around every voxel of the target: they do not depend on the source block when all its voxels count.
#[derive(Debug, Clone, Default)]
pub struct BlockSpread(Vec<f32>);

impl BlockSpread {
    /// Sum of the squared deviations from the mean of each block of `half` size.
    pub fn new(values: &[f32], size: [usize; 3], half: [usize; 3]) -> Self {
        let count = half.iter().map(|h| 2 * h + 1).product::<usize>() as f32;
        let squares: Vec<f32> = values.iter().map(|v| v * v).collect();
        let (mean, square) = (box_mean(values, size, half), box_mean(&squares, size, half));
        // Rounding of a constant block leaves this much of its squares.
        let of = |m: f32, q: f32| if q - m * m > 1e-5 * q { count * (q - m * m) } else { 0.0 };
        Self(mean.iter().zip(&square).map(|(m, q)| of(*m, *q)).collect())
    }
}

/// Buffers of one thread.
#[derive(Debug, Clone, Default)]
pub struct Scratch {
    block: Vec<f32>,
    weights: Vec<f32>,
    /// Similarity per offset, first axis fastest.
    pub scores: Vec<f32>,
}

/// Number of values that an image passed as target needs behind its last voxel.
pub const PADDING: usize = LANES;

/// Fills `scratch.scores` with the cross-correlation of the source block and the target at every offset; NaN-free, -1 where the
/// target is constant. Returns whether the source block varies at all.
///
/// `target` has [`PADDING`] values more than the image; `mask` says which voxels of the source count.
pub fn cross_correlation(
    source: &[f32],
    mask: Option<&[bool]>,
    target: (&[f32], &BlockSpread),
    size: [usize; 3],
    search: &Search,
    scratch: &mut Scratch,
) -> bool {
    let (target, spreads) = target;
    let Some(norm) = center_block(source, mask, size, search, scratch) else { return false };
    let count: f32 = scratch.weights.iter().sum();
    let center = search.center[0] + size[0] * (search.center[1] + size[1] * search.center[2]);
    let extent = search.extent();
    scratch.scores.clear();
    scratch.scores.resize(extent.iter().product(), -1.0);
    let Scratch { block, weights, scores } = scratch;
    let full = weights.iter().all(|w| *w == 1.0);
    for oz in 0..extent[2] {
        for oy in 0..extent[1] {
            for first in (0..extent[0]).step_by(LANES) {
                let offset = [search.low[0] + first as isize, search.low[1] + oy as isize, search.low[2] + oz as isize];
                let sums = if full {
                    lane_sums::<false>(block, weights, target, size, search, offset)
                } else {
                    lane_sums::<true>(block, weights, target, size, search, offset)
                };
                let row = (oz * extent[1] + oy) * extent[0];
                let step = offset[0] + size[0] as isize * (offset[1] + size[1] as isize * offset[2]);
                for lane in 0..LANES.min(extent[0] - first) {
                    let spread = if full {
                        spreads.0[(center as isize + step) as usize + lane]
                    } else {
                        let spread = sums.squares[lane] - sums.values[lane] * sums.values[lane] / count;
                        if spread > 1e-5 * sums.squares[lane] { spread } else { 0.0 }
                    };
                    if spread > 0.0 {
                        scores[row + first + lane] = (sums.products[lane] / (norm * spread).sqrt()).min(1.0);
                    }
                }
            }
        }
    }
    true
}

/// Copies the block, centred by its weighted mean; returns the sum of its squares, `None` for a constant block.
fn center_block(
    source: &[f32],
    mask: Option<&[bool]>,
    size: [usize; 3],
    search: &Search,
    scratch: &mut Scratch,
) -> Option<f32> {
    scratch.block.clear();
    scratch.weights.clear();
    let half = search.half_block;
    for k in search.center[2] - half[2]..=search.center[2] + half[2] {
        for j in search.center[1] - half[1]..=search.center[1] + half[1] {
            let row = (k * size[1] + j) * size[0] + search.center[0];
            scratch.block.extend_from_slice(&source[row - half[0]..=row + half[0]]);
            match mask {
                Some(mask) => {
                    scratch.weights.extend(mask[row - half[0]..=row + half[0]].iter().map(|&m| f32::from(u8::from(m))));
                }
                None => scratch.weights.extend(std::iter::repeat_n(1.0, 2 * half[0] + 1)),
            }
        }
    }
    let count: f32 = scratch.weights.iter().sum();
    let sum: f32 = scratch.block.iter().zip(&scratch.weights).map(|(v, w)| v * w).sum();
    let mean = sum / count.max(1.0);
    let mut norm = 0.0;
    let mut level = 0.0;
    for (value, weight) in scratch.block.iter_mut().zip(&scratch.weights) {
        level += *value * *value * weight;
        *value = (*value - mean) * weight;
        norm += *value * *value;
    }
    (norm > 1e-6 * level && norm > 0.0).then_some(norm)
}

/// Sums over the block for neighbouring offsets.
struct LaneSums {
    products: [f32; LANES],
    values: [f32; LANES],
    squares: [f32; LANES],
}

#[inline]
fn lane_sums<const MASKED: bool>(
    block: &[f32],
    weights: &[f32],
    target: &[f32],
    size: [usize; 3],
    search: &Search,
    offset: [isize; 3],
) -> LaneSums {
    let half = search.half_block;
    let width = 2 * half[0] + 1;
    let corner = [0, 1, 2].map(|axis| (search.center[axis] as isize - half[axis] as isize + offset[axis]) as usize);
    let mut sums = LaneSums { products: [0.0; LANES], values: [0.0; LANES], squares: [0.0; LANES] };
    let mut at = 0;
    for k in 0..2 * half[2] + 1 {
        for j in 0..2 * half[1] + 1 {
            let row = ((corner[2] + k) * size[1] + corner[1] + j) * size[0] + corner[0];
            let line = &target[row..row + width - 1 + LANES];
            for x in 0..width {
                let a = block[at];
                let w = weights[at];
                at += 1;
                let lane: &[f32; LANES] = line[x..x + LANES].try_into().expect("the slice has this length");
                for l in 0..LANES {
                    sums.products[l] += a * lane[l];
                    if MASKED {
                        let b = lane[l] * w;
                        sums.values[l] += b;
                        sums.squares[l] += b * lane[l];
                    }
                }
            }
        }
    }
    sums
}

/// Values as levels 0 to `LEVELS - 1` of the range of the image.
pub fn quantize(values: &[f32]) -> Vec<u8> {
    let (low, high) =
        values.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), &v| (low.min(v), high.max(v)));
    let scale = if high > low { LEVELS as f32 / (high - low) } else { 0.0 };
    values.iter().map(|v| (((v - low) * scale) as usize).min(LEVELS - 1) as u8).collect()
}

/// Fills `scratch.scores` with the normalised mutual information, 0 to 1, at every offset; returns whether the block varies.
pub fn mutual_information(
    source: &[u8],
    mask: Option<&[bool]>,
    target: &[u8],
    size: [usize; 3],
    search: &Search,
    scratch: &mut Scratch,
) -> bool {
    let half = search.half_block;
    let mut voxels: Vec<(isize, u8)> = Vec::new();
    for k in search.center[2] - half[2]..=search.center[2] + half[2] {
        for j in search.center[1] - half[1]..=search.center[1] + half[1] {
            for i in search.center[0] - half[0]..=search.center[0] + half[0] {
                let at = (k * size[1] + j) * size[0] + i;
                if mask.is_none_or(|m| m[at]) {
                    voxels.push((at as isize, source[at]));
                }
            }
        }
    }
    let table: Vec<f32> = (0..=voxels.len()).map(|n| if n == 0 { 0.0 } else { n as f32 * (n as f32).ln() }).collect();
    let entropy = |counts: &[u16]| -> f32 {
        // H N = N ln N - sum n ln n
        table[voxels.len()] - counts.iter().map(|&n| table[usize::from(n)]).sum::<f32>()
    };
    let mut own = [0u16; LEVELS];
    voxels.iter().for_each(|(_, v)| own[usize::from(*v)] += 1);
    let own_entropy = entropy(&own);
    if own_entropy <= 0.0 {
        return false;
    }
    scratch.scores.clear();
    for oz in search.low[2]..=search.high[2] {
        for oy in search.low[1]..=search.high[1] {
            for ox in search.low[0]..=search.high[0] {
                let step = (oz * size[1] as isize + oy) * size[0] as isize + ox;
                let (mut joint, mut other) = ([0u16; LEVELS * LEVELS], [0u16; LEVELS]);
                for (at, a) in &voxels {
                    let b = target[(at + step) as usize];
                    joint[usize::from(*a) * LEVELS + usize::from(b)] += 1;
                    other[usize::from(b)] += 1;
                }
                // [Drakopoulos2017] eq. 5, doubled: 2 - 2 H(a, b) / (H(a) + H(b))
                let both = own_entropy + entropy(&other);
                scratch.scores.push((2.0 - 2.0 * entropy(&joint) / both).max(0.0));
            }
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 3] = [20, 18, 16];

    fn noise(seed: usize) -> Vec<f32> {
        let hash = |at: usize| {
            let h = ((at + 1000 * seed) as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            (h ^ h >> 29).wrapping_mul(0xBF58_476D_1CE4_E5B9) >> 40
        };
        (0..SIZE.iter().product()).map(|at| hash(at) as f32 / (1u64 << 24) as f32).collect()
    }

    fn padded(mut values: Vec<f32>) -> Vec<f32> {
        values.extend([0.0; PADDING]);
        values
    }

    fn shifted(values: &[f32], shift: [isize; 3]) -> Vec<f32> {
        (0..values.len() as isize)
            .map(|at| {
                let from = at - shift[0] - SIZE[0] as isize * (shift[1] + SIZE[1] as isize * shift[2]);
                values.get(from as usize).copied().unwrap_or(0.0)
            })
            .collect()
    }

    fn best(search: &Search, scores: &[f32]) -> [isize; 3] {
        let at = (0..scores.len()).max_by(|a, b| scores[*a].total_cmp(&scores[*b])).unwrap();
        let extent = search.extent();
        let position = [at % extent[0], at / extent[0] % extent[1], at / (extent[0] * extent[1])];
        [0, 1, 2].map(|axis| position[axis] as isize + search.low[axis])
    }

    #[test]
    fn both_measures_find_a_shift_and_correlation_agrees_with_its_definition() {
        let source = noise(1);
        let target: Vec<f32> = shifted(&source, [2, -3, 1]).iter().map(|v| 5.0 - 2.0 * v).collect();
        let negated: Vec<f32> = target.iter().map(|v| -v).collect();
        let search = Search::new([9, 9, 8], [2, 1, 2], [4, 5, 3], SIZE);
        let mut scratch = Scratch::default();
        let spread = BlockSpread::new(&negated, SIZE, search.half_block);
        assert!(cross_correlation(&source, None, (&padded(negated.clone()), &spread), SIZE, &search, &mut scratch));
        assert_eq!(best(&search, &scratch.scores), [2, -3, 1]);
        let block = |values: &[f32], o: [isize; 3]| -> Vec<f32> {
            let mut out = Vec::new();
            for k in -2..=2 {
                for j in -1..=1 {
                    for i in -2..=2 {
                        let at = [9 + i + o[0], 9 + j + o[1], 8 + k + o[2]].map(|x: isize| x as usize);
                        out.push(values[at[0] + SIZE[0] * (at[1] + SIZE[1] * at[2])]);
                    }
                }
            }
            out
        };
        let correlate = |a: &[f32], b: &[f32]| {
            let mean = |v: &[f32]| v.iter().sum::<f32>() / v.len() as f32;
            let (ma, mb) = (mean(a), mean(b));
            let sum = |f: &dyn Fn(usize) -> f32| (0..a.len()).map(f).sum::<f32>();
            sum(&|n| (a[n] - ma) * (b[n] - mb)) / (sum(&|n| (a[n] - ma).powi(2)) * sum(&|n| (b[n] - mb).powi(2))).sqrt()
        };
        let expected = correlate(&block(&source, [0; 3]), &block(&negated, [-4, -5, -3]));
        assert!((scratch.scores[0] - expected).abs() < 1e-4);
        assert!(mutual_information(&quantize(&source), None, &quantize(&target), SIZE, &search, &mut scratch));
        assert_eq!(best(&search, &scratch.scores), [2, -3, 1]);
        assert!(scratch.scores.iter().all(|s| (0.0..=1.0).contains(s)));
    }

    #[test]
    fn masked_voxels_do_not_count() {
        let source = noise(3);
        let mut target = shifted(&source, [1, 0, 0]);
        let mask: Vec<bool> = (0..source.len()).map(|at| at % SIZE[0] != 8).collect();
        for (at, value) in target.iter_mut().enumerate() {
            if at % SIZE[0] == 9 {
                *value = 40.0;
            }
        }
        let search = Search::new([9, 9, 8], [1, 1, 1], [2, 2, 2], SIZE);
        let mut scratch = Scratch::default();
        let spread = BlockSpread::new(&target, SIZE, search.half_block);
        cross_correlation(&source, Some(&mask), (&padded(target), &spread), SIZE, &search, &mut scratch);
        assert_eq!(best(&search, &scratch.scores), [1, 0, 0]);
        assert!(scratch.scores.iter().copied().fold(0.0, f32::max) > 0.999);
    }

    #[test]
    fn constant_blocks_have_no_similarity() {
        let search = Search::new([9, 9, 8], [1, 1, 1], [2, 2, 2], SIZE);
        let flat = vec![3.0; SIZE.iter().product()];
        let mut scratch = Scratch::default();
        let spread = |values: &[f32]| BlockSpread::new(values, SIZE, search.half_block);
        let other = noise(1);
        assert!(!cross_correlation(
            &flat,
            None,
            (&padded(other.clone()), &spread(&other)),
            SIZE,
            &search,
            &mut scratch
        ));
        assert!(cross_correlation(&other, None, (&padded(flat.clone()), &spread(&flat)), SIZE, &search, &mut scratch));
        assert!(scratch.scores.iter().all(|s| *s == -1.0));
    }
}
