//! The smooth distance of a label as it is kept and evaluated: a quadratic B-spline by blocks of voxels, and tubes.
//!
//! # Method
//! 1. Coefficients are kept for the blocks of 4 x 4 x 4 voxels that hold any. Each row of a block along x has the voxel before and the
//!    one after it too, so that the three around a place lie together.
//! 2. A [`Stencil`] is what the voxels around a place count, the same for all labels. The rows are summed up in single precision, then
//!    the three sums along x.
//! 3. Where tubes tell the distance, that to the segments of the voxels around a place takes its part near a crease between two.
//!
//! # Source
//! [BluThevenazUnser2001] for the spline.
//!
//! # Invariants
//! The image is continued past its border by its outermost voxels. Where a voxel around a place has no coefficient there is no value.
//!
//! # Cost
//! 6 bytes per voxel of a block; nine rows are read for a sample.

use glam::DVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::bcc_lattice::floor_of;
use crate::lattice::centerlines::TubeNode;
use crate::lattice::deepest_segments::depth_in_segment;

/// How much deeper a place is in one tube than in the next, in mean spacings, for the crease between them to be far. Of 16 trees of
/// vessels the mesh has 26 places off by more than half a voxel with it, 33 with the spline alone or with the tubes everywhere, which
/// are less well known at tips.
const CREASE: f64 = 1.5;

/// Voxels of a band between two looks at whether the run is cancelled.
const VOXELS_PER_CHECK: usize = 1 << 14;

/// No voxel, no block.
pub(super) const NONE: u32 = u32::MAX;

/// Voxels of a block along an axis.
pub(super) const BLOCK: usize = 4;

/// Values of a row of a block along x: the voxel before, its own, the one after.
pub(super) const ROW: usize = BLOCK + 2;

/// Values that are read at once: the three around a place, and what follows.
const LANES: usize = 4;

/// A value for each voxel of a block, and one that may be read with the last three.
pub(super) type Block<T> = [T; ROW * BLOCK * BLOCK + 1];

/// Spline coefficients of one label by blocks.
#[derive(Debug, Clone, Default)]
pub(super) struct LabelDistance {
    /// First block along each axis.
    pub(super) first: [usize; 3],
    /// Blocks along each axis.
    pub(super) count: [usize; 3],
    /// Position of each block in `blocks`, or `NONE`.
    pub(super) table: Vec<u32>,
    /// Coefficients, mm; not a number where there is none.
    pub(super) blocks: Vec<Block<f32>>,
    /// The tubes that tell most of it.
    pub(super) tubes: Option<TubeDistance>,
}

/// The distance to tubes and what it lacks to that of the voxels, by the blocks of their label.
#[derive(Debug, Clone, Default)]
pub(super) struct TubeDistance {
    /// Ends of each segment, and the number of its tube.
    pub(super) segments: Vec<([TubeNode; 2], u32)>,
    /// Whether the label is what is outside of the tubes.
    pub(super) is_outside: bool,
    /// The segment that each voxel is deepest in.
    pub(super) deepest: Vec<Block<u32>>,
    /// Coefficients of what the bounds of the voxels changed, mm; not a number where the tubes do not tell.
    pub(super) corrections: Vec<Block<f32>>,
}

/// The smooth distance of a label at a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Distance to the surface, mm, positive inside.
    pub value: f64,
    /// Where it grows; that of the spline.
    pub gradient: DVec3,
    /// Where tubes tell the value, the unit direction in which the depth in the deepest one falls, away from its axis or towards it. The
    /// value is a distance then, also where the gradient is short; elsewhere a short one tells that it is rounded off and too small.
    pub outward: Option<DVec3>,
}

impl LabelDistance {
    /// Place of a voxel's block in the table, and of the voxel in its block.
    pub(super) fn place_of(&self, voxel: [u32; 3]) -> (usize, usize) {
        let at = voxel.map(|v| v as usize);
        let [i, j, k]: [usize; 3] = std::array::from_fn(|d| at[d] / BLOCK - self.first[d]);
        let inside = 1 + at[0] % BLOCK + ROW * (at[1] % BLOCK + BLOCK * (at[2] % BLOCK));
        (i + self.count[0] * (j + self.count[1] * k), inside)
    }

    /// The number of the block beside that of a voxel, one step along x; `None` where there is none.
    fn block_beside(&self, voxel: [u32; 3], step: i32) -> Option<usize> {
        let along = (voxel[0] as usize / BLOCK - self.first[0]).checked_add_signed(step as isize)?;
        if along >= self.count[0] {
            return None;
        }
        let block = self.table[self.place_of(voxel).0.wrapping_add_signed(step as isize)];
        (block != NONE).then_some(block as usize)
    }

    /// Gives the rows of all blocks what those of some voxels have that lie before and after them; past an image of so many voxels along x,
    /// what its outermost ones have.
    pub(super) fn complete_rows<T: Copy>(
        &self,
        voxels: &[[u32; 3]],
        along: u32,
        blocks: &mut [Block<T>],
        context: &RunContext,
    ) -> Result<()> {
        for (at, voxel) in voxels.iter().enumerate() {
            context.check_every(VOXELS_PER_CHECK, at)?;
            let (block, inside) = self.place_of(*voxel);
            let own = self.table[block] as usize;
            let value = blocks[own][inside];
            for step in [-1, 1] {
                match voxel[0].checked_add_signed(step).filter(|beside| *beside < along) {
                    Some(beside) if beside as usize / BLOCK == voxel[0] as usize / BLOCK => {}
                    Some(_) => {
                        if let Some(block) = self.block_beside(*voxel, step) {
                            // From one end of its row to the other end of that.
                            blocks[block][inside.wrapping_add_signed(-(BLOCK as isize) * step as isize)] = value;
                        }
                    }
                    None => blocks[own][inside.wrapping_add_signed(step as isize)] = value,
                }
            }
        }
        Ok(())
    }

    /// The blocks that the rows of a stencil lie in, z first: each row's is at its `Stencil::part`. `None` where one is missing.
    pub(super) fn blocks_of(&self, stencil: &Stencil) -> Option<BlockNumbers> {
        let mut low = [0; 3];
        for axis in 0..3 {
            low[axis] = stencil.block[axis].checked_sub(self.first[axis])?;
            if low[axis] + stencil.part[axis][2] >= self.count[axis] {
                return None;
            }
        }
        let mut blocks = [[NONE; 2]; 2];
        for z in 0..=stencil.part[2][2] {
            for y in 0..=stencil.part[1][2] {
                let block = self.table[((low[2] + z) * self.count[1] + low[1] + y) * self.count[0] + low[0]];
                if block == NONE {
                    return None;
                }
                blocks[z][y] = block;
            }
        }
        Some(blocks)
    }

    /// The distance at the place of a stencil; `None` where the surface is far.
    pub(super) fn sample(&self, stencil: &Stencil) -> Option<Sample> {
        let blocks = self.blocks_of(stencil)?;
        let mut sample = self.spline(stencil, &blocks);
        if let Some(tubes) = &self.tubes
            && let Some(found) = tubes.distance(stencil, &blocks)
        {
            let share = (1.0 - found.ahead / (CREASE * stencil.spacing.element_sum() / 3.0)).max(0.0);
            sample.value += share * (found.distance - sample.value);
            sample.outward = Some(found.outward);
        }
        // A missing coefficient is not a number, and so is every sum with it.
        sample.value.is_finite().then_some(sample)
    }

    pub(super) fn spline(&self, stencil: &Stencil, blocks: &BlockNumbers) -> Sample {
        // Sums over the rows for each voxel along x: of the values, and of the slopes along y and z.
        let [mut values, mut along_y, mut along_z] = [[0.0f32; LANES]; 3];
        for k in 0..3 {
            for j in 0..3 {
                let row = stencil.row(&self.blocks, blocks, j, k);
                let [value, y, z] = stencil.of_row[k][j];
                for l in 0..LANES {
                    values[l] += value * row[l];
                    along_y[l] += y * row[l];
                    along_z[l] += z * row[l];
                }
            }
        }
        let sum = |weights: &[f64; 3], [a, b, c, _]: [f32; LANES]| {
            weights[0] * f64::from(a) + weights[1] * f64::from(b) + weights[2] * f64::from(c)
        };
        let Stencil { value, slope, .. } = stencil;
        let gradient = DVec3::new(sum(slope, values), sum(value, along_y), sum(value, along_z));
        Sample { value: sum(value, values), gradient, outward: None }
    }
}

/// Blocks of a label, two along y and z, z first.
pub(super) type BlockNumbers = [[u32; 2]; 2];

/// The three voxels around a place along each axis, and what each counts: the same for all labels.
#[derive(Debug, Clone, Copy)]
pub struct Stencil {
    /// The place, voxels, and the size of these, mm.
    place: DVec3,
    spacing: DVec3,
    /// The block along each axis: along x that of the middle voxel, else that of the first one.
    block: [usize; 3],
    /// How many blocks after that each voxel's is, 0 or 1, and where the voxel is in it; along x, where its row is read.
    part: [[usize; 3]; 3],
    inside: [[usize; 3]; 3],
    /// What each voxel along x counts for the value and for the slope along x.
    value: [f64; 3],
    slope: [f64; 3],
    /// What each row counts for the value and for the slopes along y and z, z first.
    of_row: [[[f32; 3]; 3]; 3],
}

impl Stencil {
    /// The stencil of a place in voxels of an image.
    pub fn around(place: DVec3, size: [usize; 3], spacing: DVec3) -> Self {
        // The image is continued past its border by its outermost voxels.
        let end = DVec3::new(size[0] as f64, size[1] as f64, size[2] as f64) - 0.5;
        let within = place.clamp(DVec3::splat(-0.5), end);
        let mut block = [0; 3];
        let [mut part, mut inside] = [[[0; 3]; 3]; 2];
        let [mut value, mut slope] = [[[0.0; 3]; 3]; 2];
        let nearest = floor_of(within + 0.5).as_dvec3().min(end - 0.5);
        for axis in 0..3 {
            let at = within[axis] - nearest[axis];
            let (low, high) = (0.5 - at, 0.5 + at);
            value[axis] = [0.5 * low * low, 0.75 - at * at, 0.5 * high * high];
            slope[axis] = [-low, -2.0 * at, high].map(|s| s / spacing[axis]);
            let middle = nearest[axis] as usize;
            if axis == 0 {
                // Rows have the voxels beside those of their block.
                block[0] = middle / BLOCK;
                inside[0] = [middle % BLOCK; 3];
                continue;
            }
            let voxels = [middle.saturating_sub(1), middle, (middle + 1).min(size[axis] - 1)];
            block[axis] = voxels[0] / BLOCK;
            part[axis] = voxels.map(|v| v / BLOCK - block[axis]);
            inside[axis] = voxels.map(|v| v % BLOCK);
        }
        let mut of_row = [[[0.0; 3]; 3]; 3];
        for k in 0..3 {
            for j in 0..3 {
                let (y, z) = (value[1][j], value[2][k]);
                of_row[k][j] = [(y * z) as f32, (slope[1][j] * z) as f32, (y * slope[2][k]) as f32];
            }
        }
        Self { place, spacing, block, part, inside, value: value[0], slope: slope[0], of_row }
    }

    /// What is kept for the three voxels of a row along x, and what follows.
    #[inline]
    fn row<'a, T>(&self, kept: &'a [Block<T>], blocks: &BlockNumbers, j: usize, k: usize) -> &'a [T; LANES] {
        let first = self.inside[0][0] + ROW * (self.inside[1][j] + BLOCK * self.inside[2][k]);
        let block = blocks[self.part[2][k]][self.part[1][j]];
        kept[block as usize][first..].first_chunk().expect("a value follows the last three")
    }
}

/// The tube that a point is deepest in.
#[derive(Debug, Clone, Copy)]
struct DeepestTube {
    /// Distance to the surface of the tubes, mm, positive inside of the label.
    distance: f64,
    /// How much deeper the point is in this tube than in the next, mm.
    ahead: f64,
    /// Unit direction in which that distance falls.
    outward: DVec3,
}

/// The segments of the voxels around a place, each once.
#[derive(Debug, Clone, Copy, Default)]
struct NearSegments {
    numbers: [u32; 27],
    count: usize,
}

impl NearSegments {
    fn add(&mut self, number: u32) {
        if !self.numbers[..self.count].contains(&number) {
            self.numbers[self.count] = number;
            self.count += 1;
        }
    }
}

impl TubeDistance {
    /// The distance within the bounds of the voxels; `None` where the tubes do not tell.
    fn distance(&self, stencil: &Stencil, blocks: &BlockNumbers) -> Option<DeepestTube> {
        let mut correction = 0.0;
        let mut segments = NearSegments::default();
        for k in 0..3 {
            for j in 0..3 {
                let corrections = stencil.row(&self.corrections, blocks, j, k);
                let along: f64 = stencil.value.iter().zip(corrections).map(|(value, c)| value * f64::from(*c)).sum();
                correction += f64::from(stencil.of_row[k][j][0]) * along;
                stencil.row(&self.deepest, blocks, j, k)[..3].iter().for_each(|segment| segments.add(*segment));
            }
        }
        correction.is_finite().then(|| {
            let exact = self.exact_distance(stencil.place * stencil.spacing, &segments);
            DeepestTube { distance: exact.distance + correction, ..exact }
        })
    }

    /// The distance to the surface of some of the tubes' segments.
    fn exact_distance(&self, point: DVec3, segments: &NearSegments) -> DeepestTube {
        let mut best = [(f64::NEG_INFINITY, u32::MAX), (f64::NEG_INFINITY, u32::MAX)];
        let mut outward = DVec3::ZERO;
        for number in &segments.numbers[..segments.count] {
            let (ends, tube) = &self.segments[*number as usize];
            let (depth, part) = depth_in_segment(point, ends);
            if depth > best[0].0 {
                if best[0].1 != *tube {
                    best[1] = best[0];
                }
                best[0] = (depth, *tube);
                outward = (point - ends[0].center.lerp(ends[1].center, part)).normalize_or_zero();
            } else if *tube != best[0].1 && depth > best[1].0 {
                best[1] = (depth, *tube);
            }
        }
        let sign = if self.is_outside { -1.0 } else { 1.0 };
        DeepestTube { distance: sign * best[0].0, ahead: best[0].0 - best[1].0, outward: sign * outward }
    }
}
