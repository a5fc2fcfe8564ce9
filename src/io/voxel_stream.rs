//! Voxel values from and to byte streams: types, byte order, sizes checked against what is there.
//!
//! # Method
//! A header's claim is checked before memory is asked for: against the file's length where the bytes lie plain, by
//! growing the array only as far as bytes arrive where they are compressed or text.

use std::io::{Read, Write};
use std::path::Path;

use bytemuck::Pod;

use crate::error::{Error, Result};
use crate::image::voxel_image::VoxelData;
use crate::with_voxels;

/// Bytes read at a time: the array grows by at most this much past what the stream holds.
const CHUNK_BYTES: usize = 8 << 20;

/// Most bytes after the voxels that are read to see whether a compressed stream ends well.
const TRAILING_BYTES: u64 = 1 << 20;

/// Order of the bytes of a number in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ByteOrder {
    /// Least significant byte first.
    Little,
    /// Most significant byte first.
    Big,
}

impl ByteOrder {
    /// The order of this machine.
    pub const NATIVE: Self = if cfg!(target_endian = "little") { Self::Little } else { Self::Big };
}

/// Number type of voxels in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum VoxelType {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl VoxelType {
    /// Bytes of one value.
    pub fn bytes(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    /// The type of values in memory.
    pub fn of(data: &VoxelData) -> Self {
        match data {
            VoxelData::U8(_) => Self::U8,
            VoxelData::I8(_) => Self::I8,
            VoxelData::U16(_) => Self::U16,
            VoxelData::I16(_) => Self::I16,
            VoxelData::U32(_) => Self::U32,
            VoxelData::I32(_) => Self::I32,
            VoxelData::U64(_) => Self::U64,
            VoxelData::I64(_) => Self::I64,
            VoxelData::F32(_) => Self::F32,
            VoxelData::F64(_) => Self::F64,
        }
    }
}

/// Where values come from and how much can be there.
pub struct VoxelSource<'a> {
    /// The bytes, standing at the first value.
    pub reader: &'a mut dyn Read,
    /// Byte order of the values.
    pub order: ByteOrder,
    /// Bytes that remain, where known before reading.
    pub available: Option<u64>,
    /// For error messages.
    pub path: &'a Path,
}

impl VoxelSource<'_> {
    /// Reads `count` binary values of `kind`.
    ///
    /// # Errors
    /// [`Error::Format`] where fewer are there, [`Error::OutOfMemory`].
    pub fn read_binary(&mut self, kind: VoxelType, count: usize) -> Result<VoxelData> {
        let bytes = (count as u128) * kind.bytes() as u128;
        if let Some(available) = self.available
            && bytes > u128::from(available)
        {
            let reason = format!("the header claims {bytes} bytes of voxels, the file holds {available}");
            return Err(Error::format(self.path, reason));
        }
        if bytes > isize::MAX as u128 {
            return Err(Error::format(self.path, format!("the header claims {bytes} bytes of voxels")));
        }
        let data = match kind {
            VoxelType::U8 => VoxelData::U8(self.read_array(count, |v| v)?),
            VoxelType::I8 => VoxelData::I8(self.read_array(count, |v| v)?),
            VoxelType::U16 => VoxelData::U16(self.read_array(count, u16::swap_bytes)?),
            VoxelType::I16 => VoxelData::I16(self.read_array(count, i16::swap_bytes)?),
            VoxelType::U32 => VoxelData::U32(self.read_array(count, u32::swap_bytes)?),
            VoxelType::I32 => VoxelData::I32(self.read_array(count, i32::swap_bytes)?),
            VoxelType::U64 => VoxelData::U64(self.read_array(count, u64::swap_bytes)?),
            VoxelType::I64 => VoxelData::I64(self.read_array(count, i64::swap_bytes)?),
            VoxelType::F32 => {
                VoxelData::F32(self.read_array(count, |v: f32| f32::from_bits(v.to_bits().swap_bytes()))?)
            }
            VoxelType::F64 => {
                VoxelData::F64(self.read_array(count, |v: f64| f64::from_bits(v.to_bits().swap_bytes()))?)
            }
        };
        Ok(data)
    }

    fn read_array<T: Pod>(&mut self, count: usize, swap: fn(T) -> T) -> Result<Vec<T>> {
        let step = CHUNK_BYTES / size_of::<T>();
        let mut values: Vec<T> = Vec::new();
        // A known length was checked: one allocation. An unknown one grows with the bytes that arrive.
        let first = if self.available.is_some() { count } else { count.min(step) };
        reserve(&mut values, first)?;
        while values.len() < count {
            let begin = values.len();
            let end = count.min(begin + step);
            if end > values.capacity() {
                let more = (end - begin).max(begin).min(count - begin);
                reserve(&mut values, more)?;
            }
            values.resize(end, T::zeroed());
            let target: &mut [u8] = bytemuck::cast_slice_mut(&mut values[begin..end]);
            let read = read_up_to(self.reader, target).map_err(|e| stream_error(self.path, &e))?;
            if read < target.len() {
                let have = begin * size_of::<T>() + read;
                let reason = format!("the file ends after {have} of {} bytes of voxels", count * size_of::<T>());
                return Err(Error::format(self.path, reason));
            }
        }
        if self.order != ByteOrder::NATIVE {
            values.iter_mut().for_each(|v| *v = swap(*v));
        }
        Ok(values)
    }

    /// Reads `count` values of `kind` written as text, separated by white space.
    ///
    /// # Errors
    /// [`Error::Format`] where fewer are there or one does not parse.
    pub fn read_text(&mut self, kind: VoxelType, count: usize) -> Result<VoxelData> {
        let mut text = String::new();
        self.reader.read_to_string(&mut text).map_err(|e| stream_error(self.path, &e))?;
        if count > text.len() {
            let reason = format!("the header claims {count} values, the text has {} letters", text.len());
            return Err(Error::format(self.path, reason));
        }
        macro_rules! parse {
            ($variant:ident) => {
                VoxelData::$variant(parse_values(&text, count, self.path)?)
            };
        }
        Ok(match kind {
            VoxelType::U8 => parse!(U8),
            VoxelType::I8 => parse!(I8),
            VoxelType::U16 => parse!(U16),
            VoxelType::I16 => parse!(I16),
            VoxelType::U32 => parse!(U32),
            VoxelType::I32 => parse!(I32),
            VoxelType::U64 => parse!(U64),
            VoxelType::I64 => parse!(I64),
            VoxelType::F32 => parse!(F32),
            VoxelType::F64 => parse!(F64),
        })
    }

    /// Reads past the end of a compressed stream, so that its checksum is compared.
    ///
    /// # Errors
    /// [`Error::Format`] for a stream that ends early or whose checksum is wrong.
    pub fn finish(&mut self) -> Result<()> {
        let mut rest = (&mut *self.reader).take(TRAILING_BYTES);
        std::io::copy(&mut rest, &mut std::io::sink()).map_err(|e| stream_error(self.path, &e))?;
        Ok(())
    }
}

fn parse_values<T: std::str::FromStr>(text: &str, count: usize, path: &Path) -> Result<Vec<T>> {
    let mut values = Vec::with_capacity(count);
    for token in text.split(|c: char| c.is_ascii_whitespace() || c == ',').filter(|t| !t.is_empty()).take(count) {
        let value = token.parse().map_err(|_| {
            Error::format(path, format!("voxel value {}: '{token}' is not a number of this type", values.len()))
        })?;
        values.push(value);
    }
    if values.len() < count {
        return Err(Error::format(path, format!("the file ends after {} of {count} voxel values", values.len())));
    }
    Ok(values)
}

fn reserve<T>(values: &mut Vec<T>, more: usize) -> Result<()> {
    let bytes = (more * size_of::<T>()) as u64;
    values.try_reserve_exact(more).map_err(|_| Error::OutOfMemory { what: "voxels", bytes })
}

/// Fills `target` as far as the stream goes.
fn read_up_to(reader: &mut dyn Read, target: &mut [u8]) -> std::io::Result<usize> {
    let mut filled = 0;
    while filled < target.len() {
        match reader.read(&mut target[filled..]) {
            Ok(0) => break,
            Ok(n) => filled += n,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(filled)
}

/// A failed read: a broken stream is the file's fault, anything else the system's.
pub fn stream_error(path: &Path, error: &std::io::Error) -> Error {
    use std::io::ErrorKind::{InvalidData, InvalidInput, UnexpectedEof};
    match error.kind() {
        UnexpectedEof => Error::format(path, "the file is truncated"),
        InvalidData | InvalidInput => Error::format(path, format!("broken data: {error}")),
        kind => Error::io(
            path,
            error.raw_os_error().map_or_else(|| std::io::Error::from(kind), std::io::Error::from_raw_os_error),
        ),
    }
}

/// Writes values in the byte order of this machine.
///
/// # Errors
/// Those of the writer.
pub fn write_voxels(writer: &mut dyn Write, data: &VoxelData) -> std::io::Result<()> {
    with_voxels!(data, values => writer.write_all(bytemuck::cast_slice(values)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source<'a>(reader: &'a mut dyn Read, available: Option<u64>) -> VoxelSource<'a> {
        VoxelSource { reader, order: ByteOrder::Big, available, path: Path::new("x") }
    }

    #[test]
    fn big_endian_values_are_swapped() {
        let mut bytes: &[u8] = &[1, 2, 3, 4];
        let data = source(&mut bytes, Some(4)).read_binary(VoxelType::U16, 2).unwrap();
        assert_eq!(data, VoxelData::U16(vec![0x0102, 0x0304]));
    }

    #[test]
    fn a_huge_claim_over_few_bytes_is_refused_without_memory() {
        for available in [Some(4), None] {
            let mut bytes: &[u8] = &[1, 2, 3, 4];
            let result = source(&mut bytes, available).read_binary(VoxelType::F64, 1 << 40);
            assert!(matches!(result, Err(Error::Format { .. })));
        }
    }

    #[test]
    fn text_values_are_counted() {
        let mut text: &[u8] = b"1 2\n3";
        assert_eq!(source(&mut text, None).read_text(VoxelType::I8, 3).unwrap(), VoxelData::I8(vec![1, 2, 3]));
        let mut text: &[u8] = b"1 2 x 4";
        assert!(source(&mut text, None).read_text(VoxelType::I8, 4).is_err());
        let mut text: &[u8] = b"1 2  ";
        assert!(source(&mut text, None).read_text(VoxelType::I8, 3).is_err());
    }
}
