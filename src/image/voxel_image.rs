//! An image as files and hosts hand it over: any number type, any number of components.
//!
//! # Method
//! [`VoxelImage`] keeps the type of the file. Labels are made from it in two passes: the first collects the distinct
//! values and refuses what is no label, the second writes each voxel's compact number.
//!
//! # Invariants
//! `data` holds `components` values per voxel of `grid`, the component fastest, then i, j, k.
//!
//! # Cost
//! Two passes over the voxels; 4 bytes per possible value up to `DENSE_VALUES`, a hash table beyond.

use rustc_hash::FxHashMap;

use crate::error::{Error, Result};
use crate::image::grid::Grid;
use crate::image::label_image::{LabelImage, MAX_LABELS};
use crate::index::Label;

/// Label values below this are looked up in a table, larger ones in a hash map: 4 MiB of table at most.
const DENSE_VALUES: i64 = 1 << 20;

/// Voxel values of one of the types that image files hold.
#[derive(Debug, Clone, PartialEq)]
pub enum VoxelData {
    /// 8 bits, unsigned.
    U8(Vec<u8>),
    /// 8 bits, signed.
    I8(Vec<i8>),
    /// 16 bits, unsigned.
    U16(Vec<u16>),
    /// 16 bits, signed.
    I16(Vec<i16>),
    /// 32 bits, unsigned.
    U32(Vec<u32>),
    /// 32 bits, signed.
    I32(Vec<i32>),
    /// 64 bits, unsigned.
    U64(Vec<u64>),
    /// 64 bits, signed.
    I64(Vec<i64>),
    /// Single precision.
    F32(Vec<f32>),
    /// Double precision.
    F64(Vec<f64>),
}

/// Runs `$body` with `$values` bound to the typed vector of `$data`.
#[macro_export]
macro_rules! with_voxels {
    ($data:expr, $values:ident => $body:expr) => {
        match $data {
            $crate::image::voxel_image::VoxelData::U8($values) => $body,
            $crate::image::voxel_image::VoxelData::I8($values) => $body,
            $crate::image::voxel_image::VoxelData::U16($values) => $body,
            $crate::image::voxel_image::VoxelData::I16($values) => $body,
            $crate::image::voxel_image::VoxelData::U32($values) => $body,
            $crate::image::voxel_image::VoxelData::I32($values) => $body,
            $crate::image::voxel_image::VoxelData::U64($values) => $body,
            $crate::image::voxel_image::VoxelData::I64($values) => $body,
            $crate::image::voxel_image::VoxelData::F32($values) => $body,
            $crate::image::voxel_image::VoxelData::F64($values) => $body,
        }
    };
}

impl VoxelData {
    /// Number of values.
    pub fn len(&self) -> usize {
        with_voxels!(self, values => values.len())
    }

    /// Whether there is no value.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Name of the type: `u8`, `f32`, ...
    pub fn type_name(&self) -> &'static str {
        match self {
            Self::U8(_) => "u8",
            Self::I8(_) => "i8",
            Self::U16(_) => "u16",
            Self::I16(_) => "i16",
            Self::U32(_) => "u32",
            Self::I32(_) => "i32",
            Self::U64(_) => "u64",
            Self::I64(_) => "i64",
            Self::F32(_) => "f32",
            Self::F64(_) => "f64",
        }
    }
}

/// A number type of voxels.
pub trait VoxelValue: Copy + Send + Sync + 'static {
    /// The value as a label; `None` where it is not a whole number that an `i64` holds.
    fn to_label(self) -> Option<i64>;
    /// The value in double precision.
    fn to_f64(self) -> f64;
}

macro_rules! integer_voxels {
    ($($type:ty),*) => {$(
        impl VoxelValue for $type {
            #[inline]
            fn to_label(self) -> Option<i64> {
                i64::try_from(self).ok()
            }
            #[inline]
            fn to_f64(self) -> f64 {
                self as f64
            }
        }
    )*};
}
integer_voxels!(u8, i8, u16, i16, u32, i32, u64, i64);

macro_rules! real_voxels {
    ($($type:ty),*) => {$(
        impl VoxelValue for $type {
            #[inline]
            fn to_label(self) -> Option<i64> {
                // A whole number converts there and back without change; NaN, infinities and fractions do not.
                let whole = self as i64;
                (whole as $type == self && whole != i64::MAX).then_some(whole)
            }
            #[inline]
            fn to_f64(self) -> f64 {
                f64::from(self)
            }
        }
    )*};
}
real_voxels!(f32, f64);

/// An image in memory, as read from a file.
#[derive(Debug, Clone, PartialEq)]
pub struct VoxelImage {
    /// Where the voxels are.
    pub grid: Grid,
    /// Values per voxel: 1 for scans and labels, 3 for displacement fields.
    pub components: usize,
    /// The values, component fastest, then i, j, k.
    pub data: VoxelData,
}

impl VoxelImage {
    /// An image from its parts.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] where `data` has not `components` values per voxel of `grid`.
    pub fn new(grid: Grid, components: usize, data: VoxelData) -> Result<Self> {
        if components == 0 || grid.voxel_count().checked_mul(components) != Some(data.len()) {
            let reason = format!("{} values for {} voxels of {components}", data.len(), grid.voxel_count());
            return Err(Error::argument("data", reason));
        }
        Ok(Self { grid, components, data })
    }

    /// The values in single precision.
    pub fn to_f32(&self) -> Vec<f32> {
        with_voxels!(&self.data, values => values.iter().map(|v| v.to_f64() as f32).collect())
    }

    /// The values in double precision.
    pub fn to_f64(&self) -> Vec<f64> {
        with_voxels!(&self.data, values => values.iter().map(|v| v.to_f64()).collect())
    }

    /// The image as labels: 0 is background, every other value a material.
    ///
    /// # Errors
    /// [`Error::InvalidInput`] for more than one component, a value that is not a whole number from 0 to 2^31 - 1 (the
    /// message names the first such voxel), more than 65535 labels, or no voxel but background.
    pub fn to_label_image(&self) -> Result<LabelImage> {
        if self.components != 1 {
            return Err(Error::input(format!(
                "a label image has one value per voxel, this one has {}",
                self.components
            )));
        }
        let size = self.grid.size();
        let strides = [1, size[0] as isize, (size[0] * size[1]) as isize];
        with_voxels!(&self.data, values => label_image_from_slice(self.grid, values, strides))
    }
}

/// A label image from values in memory: voxel (i, j, k) is `values[i * strides[0] + j * strides[1] + k * strides[2]]`,
/// counted from the start of the slice where strides are positive, from the end of an axis where negative.
///
/// # Errors
/// [`Error::InvalidArgument`] where a voxel would lie outside `values`; else as [`VoxelImage::to_label_image`].
pub fn label_image_from_slice<T: VoxelValue>(grid: Grid, values: &[T], strides: [isize; 3]) -> Result<LabelImage> {
    let base = strided_base(grid.size(), strides, values.len())?;
    let rows = Rows { size: grid.size(), strides, base, values };
    let range = rows.label_range()?;
    if range.1 == 0 {
        return Err(Error::input("the label image has no foreground: every voxel is 0"));
    }
    if range.1 < DENSE_VALUES { rows.compact_dense(grid, range.1) } else { rows.compact_sparse(grid) }
}

/// Position of voxel 0 in the slice, after checking that all voxels lie inside.
fn strided_base(size: [usize; 3], strides: [isize; 3], len: usize) -> Result<usize> {
    let (mut low, mut high) = (0i128, 0i128);
    for axis in 0..3 {
        let reach = (size[axis] as i128 - 1) * strides[axis] as i128;
        if reach < 0 { low += reach } else { high += reach }
    }
    if high - low >= len as i128 {
        return Err(Error::argument("strides", format!("{strides:?} of size {size:?} reach past {len} values")));
    }
    Ok((-low) as usize)
}

/// Strided voxels with their grid size.
struct Rows<'a, T> {
    size: [usize; 3],
    strides: [isize; 3],
    base: usize,
    values: &'a [T],
}

impl<T: VoxelValue> Rows<'_, T> {
    /// Calls `visit` with each voxel's value in the order i, j, k.
    #[inline]
    fn for_each(&self, mut visit: impl FnMut(T)) {
        let [ni, nj, nk] = self.size;
        for k in 0..nk as isize {
            for j in 0..nj as isize {
                let row = self.base as isize + j * self.strides[1] + k * self.strides[2];
                if self.strides[0] == 1 {
                    self.values[row as usize..row as usize + ni].iter().for_each(|&v| visit(v));
                } else {
                    (0..ni as isize).for_each(|i| visit(self.values[(row + i * self.strides[0]) as usize]));
                }
            }
        }
    }

    /// Smallest and largest value, after checking that every voxel is a label.
    fn label_range(&self) -> Result<(i64, i64)> {
        let (mut low, mut high, mut whole) = (i64::MAX, i64::MIN, true);
        self.for_each(|v| match v.to_label() {
            Some(label) => (low, high) = (low.min(label), high.max(label)),
            None => whole = false,
        });
        if whole && low >= 0 && high <= i64::from(i32::MAX) { Ok((low, high)) } else { Err(self.first_fault()) }
    }

    /// The error that names the first voxel that is no label.
    fn first_fault(&self) -> Error {
        let (mut at, mut fault) = (0usize, None);
        self.for_each(|v| {
            if fault.is_none() && !v.to_label().is_some_and(|l| (0..=i64::from(i32::MAX)).contains(&l)) {
                fault = Some((at, v));
            }
            at += 1;
        });
        let (at, value) = fault.expect("label_range saw a value that is no label");
        let [ni, nj, _] = self.size;
        let voxel = (at % ni, at / ni % nj, at / (ni * nj));
        let reason = match value.to_label() {
            Some(label) if label < 0 => format!("negative label {label}"),
            Some(label) => format!("label {label} above 2147483647"),
            None => format!("value {} is not a whole number: this is no label image", value.to_f64()),
        };
        Error::input(format!("voxel {voxel:?}: {reason}"))
    }

    fn compact_dense(&self, grid: Grid, highest: i64) -> Result<LabelImage> {
        let mut numbers = vec![u32::MAX; highest as usize + 1];
        self.for_each(|v| numbers[label_of(v) as usize] = 0);
        numbers[0] = 0;
        let mut values = Vec::new();
        for (value, number) in numbers.iter_mut().enumerate().filter(|(_, n)| **n == 0) {
            *number = values.len() as u32;
            values.push(value as i32);
        }
        check_label_count(values.len() - 1)?;
        let mut voxels = Vec::with_capacity(grid.voxel_count());
        self.for_each(|v| voxels.push(Label(numbers[label_of(v) as usize] as u16)));
        LabelImage::new(grid, voxels, values)
    }

    fn compact_sparse(&self, grid: Grid) -> Result<LabelImage> {
        let mut numbers: FxHashMap<i64, u16> = FxHashMap::default();
        let mut last = 0;
        numbers.insert(0, 0);
        self.for_each(|v| {
            let label = label_of(v);
            // Neighbours mostly share their label, and past the limit the answer is known.
            if label != last && numbers.len() <= MAX_LABELS + 1 {
                numbers.insert(label, 0);
                last = label;
            }
        });
        check_label_count(numbers.len() - 1)?;
        let mut values: Vec<i32> = numbers.keys().map(|&v| v as i32).collect();
        values.sort_unstable();
        for (number, value) in values.iter().enumerate() {
            numbers.insert(i64::from(*value), number as u16);
        }
        let mut voxels = Vec::with_capacity(grid.voxel_count());
        let mut last = (0, 0);
        self.for_each(|v| {
            let label = label_of(v);
            if label != last.0 {
                last = (label, numbers[&label]);
            }
            voxels.push(Label(last.1));
        });
        LabelImage::new(grid, voxels, values)
    }
}

/// The label of a voxel that [`Rows::label_range`] has passed.
#[inline]
fn label_of<T: VoxelValue>(value: T) -> i64 {
    value.to_label().unwrap_or(0)
}

fn check_label_count(labels: usize) -> Result<()> {
    if labels > MAX_LABELS {
        return Err(Error::input(format!("more than {MAX_LABELS} different labels: is this a label image?")));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3};

    fn grid(size: [usize; 3]) -> Grid {
        Grid::new(size, DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap()
    }

    fn labels(data: VoxelData) -> Result<LabelImage> {
        VoxelImage::new(grid([data.len(), 1, 1]), 1, data).unwrap().to_label_image()
    }

    #[test]
    fn every_number_type_gives_the_same_labels() {
        let images = [
            labels(VoxelData::U8(vec![0, 7, 3, 7])),
            labels(VoxelData::I8(vec![0, 7, 3, 7])),
            labels(VoxelData::U16(vec![0, 7, 3, 7])),
            labels(VoxelData::I64(vec![0, 7, 3, 7])),
            labels(VoxelData::U64(vec![0, 7, 3, 7])),
            labels(VoxelData::F32(vec![0.0, 7.0, 3.0, 7.0])),
            labels(VoxelData::F64(vec![-0.0, 7.0, 3.0, 7.0])),
        ];
        for image in images {
            let image = image.unwrap();
            assert_eq!(image.values(), [0, 3, 7]);
            assert_eq!(image.voxels(), [Label(0), Label(2), Label(1), Label(2)]);
        }
    }

    #[test]
    fn large_values_are_compacted_too() {
        let image = labels(VoxelData::U32(vec![i32::MAX as u32, 0, 5_000_000, 1])).unwrap();
        assert_eq!(image.values(), [0, 1, 5_000_000, i32::MAX]);
        assert_eq!(image.voxels(), [Label(3), Label(0), Label(2), Label(1)]);
    }

    #[test]
    fn what_is_no_label_is_refused_with_its_voxel() {
        let message = |data| labels(data).unwrap_err().to_string();
        assert!(message(VoxelData::F32(vec![1.0, 2.5])).contains("voxel (1, 0, 0): value 2.5"));
        assert!(message(VoxelData::F64(vec![f64::NAN])).contains("NaN"));
        assert!(message(VoxelData::F64(vec![f64::INFINITY])).contains("inf"));
        assert!(message(VoxelData::F32(vec![1e30])).contains("whole"));
        assert!(message(VoxelData::I16(vec![1, -3])).contains("negative label -3"));
        assert!(message(VoxelData::U64(vec![u64::MAX])).contains("voxel (0, 0, 0)"));
        assert!(message(VoxelData::U32(vec![1 << 31])).contains("above"));
        assert!(message(VoxelData::U8(vec![0, 0])).contains("no foreground"));
        assert!(message(VoxelData::U32((0..70_000).collect())).contains("65535"));
        assert!(message(VoxelData::U32((0..70_000).map(|v| v * 20_000).collect())).contains("65535"));
        assert_eq!(labels(VoxelData::U16((0..=65535).collect())).unwrap().label_count(), 65536);
    }

    #[test]
    fn strides_walk_the_memory_of_the_host() {
        let values = [1u8, 2, 3, 4, 5, 6];
        let image = label_image_from_slice(grid([2, 3, 1]), &values, [3, 1, 6]).unwrap();
        assert_eq!(image.voxels(), [1, 4, 2, 5, 3, 6].map(Label));
        let image = label_image_from_slice(grid([2, 3, 1]), &values, [-1, 2, 6]).unwrap();
        assert_eq!(image.voxels(), [2, 1, 4, 3, 6, 5].map(Label));
        assert!(label_image_from_slice(grid([2, 3, 2]), &values, [3, 1, 6]).is_err());
    }
}
