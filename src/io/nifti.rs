//! NIfTI-1 and NIfTI-2 images: `.nii`, `.nii.gz`, `.hdr` with `.img`.
//!
//! # Method
//! 1. Read the header in the byte order that makes its size field right.
//! 2. Geometry: the sform where it has a code, else the qform, else the voxel sizes alone; millimetres; from NIfTI's
//!    RAS to LPS by turning the first two axes round.
//! 3. Read the voxels behind `vox_offset`; apply `scl_slope` and `scl_inter` where they change anything.
//!
//! # Source
//! [NIfTI1], [NIfTI2].
//!
//! # Differences
//! Written here rather than over the `nifti` crate: that one knows no NIfTI-2, allocates what a header claims, and
//! writes only with the `ndarray` feature.
//!
//! # Limits
//! Three spatial axes; a fourth axis of one time point is accepted; a fifth holds the components of vectors.
//! Displacements (intent 1006) are in RAS in the file and LPS in memory, as ITK from 5.4 on has it; plain vectors (1007)
//! are passed through: ITK writes its LPS vectors so. Complex, RGB and 128-bit voxels are refused.

use std::fs::File;
use std::io::{BufReader, Read, Write};
use std::path::{Path, PathBuf};

use flate2::read::MultiGzDecoder;
use flate2::write::GzEncoder;
use glam::{DMat3, DVec3};

use super::atomic_file::{open, write_atomically};
use super::voxel_stream::{ByteOrder, VoxelSource, VoxelType, stream_error, write_voxels};
use crate::error::{Error, Result};
use crate::image::grid::Grid;
use crate::image::voxel_image::{VoxelData, VoxelImage, VoxelValue};
use crate::with_voxels;

/// Size of a NIfTI-1 header.
const HEADER_1: usize = 348;
/// Size of a NIfTI-2 header.
const HEADER_2: usize = 540;
/// Where the voxels of a `.nii` file begin: header and an empty extension field.
const VOXELS_AT: usize = 352;
/// Intent of displacement fields.
const INTENT_DISPLACEMENT: i16 = 1006;
/// Intent of other vectors.
const INTENT_VECTOR: i16 = 1007;
/// Millimetres and seconds.
const UNITS_MM_S: u8 = 2 | 8;
/// Turns RAS into LPS and back.
const FLIP: DVec3 = DVec3::new(-1.0, -1.0, 1.0);
/// Voxel sizes and sform columns that differ by less than this are the same number, rounded to single precision.
const SAME_SPACING: f64 = 1e-5;

/// The fields of either header version that matter here.
#[derive(Debug)]
struct Header {
    order: ByteOrder,
    dim: [i64; 8],
    intent: i32,
    datatype: i16,
    pixdim: [f64; 8],
    vox_offset: f64,
    slope: f64,
    inter: f64,
    units: u8,
    qform_code: i32,
    sform_code: i32,
    quaternion: [f64; 3],
    offset: DVec3,
    srow: [[f64; 4]; 3],
    paired: bool,
}

/// Reads a NIfTI image.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`], [`Error::Unsupported`], [`Error::OutOfMemory`].
pub fn read(path: &Path) -> Result<VoxelImage> {
    let header_path = with_stem_ending(path, "img", "hdr");
    let mut stream = ByteStream::open(&header_path)?;
    let header = read_header(&mut stream, &header_path)?;
    let (size, components) = header.shape(&header_path)?;
    let grid = header.grid(size, &header_path)?;
    let kind = header.voxel_type(&header_path)?;
    if header.paired {
        stream = ByteStream::open(&with_stem_ending(path, "hdr", "img"))?;
    }
    // Files with the voxels inside cannot have them in the header, whatever the field says.
    let first = if header.paired { 0.0 } else { VOXELS_AT as f64 };
    stream.skip_to(header.vox_offset.max(first) as u64)?;
    // The fifth axis is the slowest: components come as one block each.
    let count = grid.voxel_count().saturating_mul(components);
    let data = stream.read_voxels(kind, count, header.order)?;
    let mut data = scaled(data, header.slope, header.inter);
    if header.intent == i32::from(INTENT_DISPLACEMENT) && components == 3 {
        turn_blocks(&mut data);
    }
    let data = if components > 1 { with_interleaved(data, components) } else { data };
    VoxelImage::new(grid, components, data)
}

/// A file, unpacked where it is gzip, that knows how far it has been read.
struct ByteStream {
    reader: Box<dyn Read>,
    path: PathBuf,
    position: u64,
    length: Option<u64>,
}

impl ByteStream {
    fn open(path: &Path) -> Result<Self> {
        let (file, length) = open(path)?;
        let mut reader: BufReader<File> = BufReader::with_capacity(1 << 18, file);
        let start = std::io::BufRead::fill_buf(&mut reader).map_err(|e| stream_error(path, &e))?;
        let packed = start.starts_with(&[0x1f, 0x8b]);
        let (reader, length): (Box<dyn Read>, _) =
            if packed { (Box::new(MultiGzDecoder::new(reader)), None) } else { (Box::new(reader), Some(length)) };
        Ok(Self { reader, path: path.to_path_buf(), position: 0, length })
    }

    fn read_exact(&mut self, target: &mut [u8]) -> Result<()> {
        self.reader.read_exact(target).map_err(|e| stream_error(&self.path, &e))?;
        self.position += target.len() as u64;
        Ok(())
    }

    fn skip_to(&mut self, position: u64) -> Result<()> {
        let distance = position.saturating_sub(self.position);
        let mut skipped = (&mut self.reader).take(distance);
        let got = std::io::copy(&mut skipped, &mut std::io::sink()).map_err(|e| stream_error(&self.path, &e))?;
        if got < distance {
            return Err(Error::format(&self.path, format!("the file ends before its voxels at byte {position}")));
        }
        self.position += got;
        Ok(())
    }

    fn read_voxels(&mut self, kind: VoxelType, count: usize, order: ByteOrder) -> Result<VoxelData> {
        let available = self.length.map(|l| l.saturating_sub(self.position));
        let mut source = VoxelSource { reader: &mut self.reader, order, available, path: &self.path };
        let data = source.read_binary(kind, count)?;
        if available.is_none() {
            source.finish()?;
        }
        Ok(data)
    }
}

/// The path with the ending `from` (perhaps with `.gz` behind it) replaced by `to`.
fn with_stem_ending(path: &Path, from: &str, to: &str) -> PathBuf {
    let name = path.to_string_lossy();
    let (stem, packed) = name.strip_suffix(".gz").map_or((name.as_ref(), ""), |stem| (stem, ".gz"));
    match stem.strip_suffix(&format!(".{from}")) {
        Some(stem) => PathBuf::from(format!("{stem}.{to}{packed}")),
        None => path.to_path_buf(),
    }
}

/// Numbers at given places of a header.
struct Fields<'a> {
    bytes: &'a [u8],
    order: ByteOrder,
}

macro_rules! field {
    ($name:ident, $type:ty) => {
        fn $name(&self, at: usize) -> $type {
            let bytes = self.bytes[at..at + size_of::<$type>()].try_into().expect("the slice has the type's size");
            match self.order {
                ByteOrder::Little => <$type>::from_le_bytes(bytes),
                ByteOrder::Big => <$type>::from_be_bytes(bytes),
            }
        }
    };
}

impl Fields<'_> {
    field!(i16, i16);
    field!(i32, i32);
    field!(i64, i64);
    field!(f32, f32);
    field!(f64, f64);

    fn real(&self, at: usize) -> f64 {
        f64::from(self.f32(at))
    }
}

fn read_header(stream: &mut ByteStream, path: &Path) -> Result<Header> {
    let mut bytes = vec![0; HEADER_1];
    stream.read_exact(&mut bytes).map_err(|error| match error {
        Error::Format { reason, .. } => Error::format(path, format!("no NIfTI header: {reason}")),
        other => other,
    })?;
    let size = |order| Fields { bytes: &bytes, order }.i32(0);
    let orders = [ByteOrder::Little, ByteOrder::Big];
    if let Some(order) = orders.into_iter().find(|&o| size(o) == HEADER_1 as i32) {
        return parse_header_1(&bytes, order, path);
    }
    if let Some(order) = orders.into_iter().find(|&o| size(o) == HEADER_2 as i32) {
        bytes.resize(HEADER_2, 0);
        stream.read_exact(&mut bytes[HEADER_1..])?;
        return parse_header_2(&bytes, order, path);
    }
    Err(Error::format(path, "not a NIfTI file: the header does not begin with its size 348 or 540"))
}

fn parse_header_1(bytes: &[u8], order: ByteOrder, path: &Path) -> Result<Header> {
    let paired = match &bytes[344..348] {
        b"n+1\0" => false,
        b"ni1\0" => true,
        magic => {
            let reason = format!("not a NIfTI file: magic {:?}", String::from_utf8_lossy(magic));
            return Err(Error::format(path, reason));
        }
    };
    let f = Fields { bytes, order };
    Ok(Header {
        order,
        dim: std::array::from_fn(|i| i64::from(f.i16(40 + 2 * i))),
        intent: i32::from(f.i16(68)),
        datatype: f.i16(70),
        pixdim: std::array::from_fn(|i| f.real(76 + 4 * i)),
        vox_offset: f.real(108),
        slope: f.real(112),
        inter: f.real(116),
        units: bytes[123],
        qform_code: i32::from(f.i16(252)),
        sform_code: i32::from(f.i16(254)),
        quaternion: std::array::from_fn(|i| f.real(256 + 4 * i)),
        offset: DVec3::from_array(std::array::from_fn(|i| f.real(268 + 4 * i))),
        srow: std::array::from_fn(|r| std::array::from_fn(|c| f.real(280 + 16 * r + 4 * c))),
        paired,
    })
}

fn parse_header_2(bytes: &[u8], order: ByteOrder, path: &Path) -> Result<Header> {
    let paired = match &bytes[4..8] {
        b"n+2\0" => false,
        b"ni2\0" => true,
        magic => {
            let reason = format!("not a NIfTI-2 file: magic {:?}", String::from_utf8_lossy(magic));
            return Err(Error::format(path, reason));
        }
    };
    let f = Fields { bytes, order };
    Ok(Header {
        order,
        dim: std::array::from_fn(|i| f.i64(16 + 8 * i)),
        intent: f.i32(504),
        datatype: f.i16(12),
        pixdim: std::array::from_fn(|i| f.f64(104 + 8 * i)),
        vox_offset: f.i64(168) as f64,
        slope: f.f64(176),
        inter: f.f64(184),
        units: f.i32(500) as u8,
        qform_code: f.i32(344),
        sform_code: f.i32(348),
        quaternion: std::array::from_fn(|i| f.f64(352 + 8 * i)),
        offset: DVec3::from_array(std::array::from_fn(|i| f.f64(376 + 8 * i))),
        srow: std::array::from_fn(|r| std::array::from_fn(|c| f.f64(400 + 32 * r + 8 * c))),
        paired,
    })
}

impl Header {
    /// Voxels along i, j, k, and components per voxel.
    fn shape(&self, path: &Path) -> Result<([usize; 3], usize)> {
        let refuse = |reason: String| Err(Error::format(path, reason));
        let axes = self.dim[0];
        if !(1..=7).contains(&axes) {
            return refuse(format!("the header has {axes} axes"));
        }
        let sizes = &self.dim[1..=axes as usize];
        if let Some(axis) = sizes.iter().position(|&s| s < 1) {
            return refuse(format!("axis {} has size {}", axis + 1, sizes[axis]));
        }
        if axes < 3 {
            return refuse(format!("a {axes}-D image; three axes are needed"));
        }
        if let Some(axis) = (3..sizes.len()).find(|&a| a != 4 && sizes[a] > 1) {
            return refuse(format!("a {}-D image: {} values along axis {}", axis + 1, sizes[axis], axis + 1));
        }
        if !self.vox_offset.is_finite() || self.vox_offset < 0.0 || self.vox_offset > 1e15 {
            return refuse(format!("voxels at byte {}", self.vox_offset));
        }
        let components = sizes.get(4).map_or(1, |&s| s as usize);
        Ok(([sizes[0] as usize, sizes[1] as usize, sizes[2] as usize], components))
    }

    fn voxel_type(&self, path: &Path) -> Result<VoxelType> {
        Ok(match self.datatype {
            2 => VoxelType::U8,
            4 => VoxelType::I16,
            8 => VoxelType::I32,
            16 => VoxelType::F32,
            64 => VoxelType::F64,
            256 => VoxelType::I8,
            512 => VoxelType::U16,
            768 => VoxelType::U32,
            1024 => VoxelType::I64,
            1280 => VoxelType::U64,
            other => {
                let reason = format!("NIfTI datatype {other}; integers of 8 to 64 bits and floats are supported");
                return Err(Error::format(path, reason));
            }
        })
    }

    /// The grid in LPS millimetres.
    fn grid(&self, size: [usize; 3], path: &Path) -> Result<Grid> {
        let to_mm = match self.units & 7 {
            1 => 1e3,
            3 => 1e-3,
            _ => 1.0,
        };
        let spacing = DVec3::new(self.pixdim[1], self.pixdim[2], self.pixdim[3]);
        if !(spacing.is_finite() && spacing.min_element() > 0.0) {
            let reason = format!("voxel size {:?} is not finite and positive", spacing.to_array());
            return Err(Error::format(path, reason));
        }
        if self.sform_code <= 0 && self.qform_code <= 0 {
            // No frame is stated: as ITK, the axes are taken for those of LPS.
            return Grid::new(size, spacing * to_mm, DVec3::ZERO, DMat3::IDENTITY)
                .map_err(|e| Error::format(path, e.to_string()));
        }
        let (direction, spacing, origin) = if self.sform_code > 0 {
            self.sform_geometry(spacing, path)?
        } else {
            (self.quaternion_direction(path)?, spacing, self.offset)
        };
        let direction = DMat3::from_diagonal(FLIP) * direction;
        Grid::new(size, spacing * to_mm, FLIP * origin * to_mm, direction)
            .map_err(|e| Error::format(path, e.to_string()))
    }

    fn sform_geometry(&self, pixdim: DVec3, path: &Path) -> Result<(DMat3, DVec3, DVec3)> {
        let column = |c: usize| DVec3::new(self.srow[0][c], self.srow[1][c], self.srow[2][c]);
        let mut spacing = DVec3::new(column(0).length(), column(1).length(), column(2).length());
        if !(spacing.is_finite() && spacing.min_element() > 0.0) {
            let reason = format!("singular direction: sform columns of length {:?}", spacing.to_array());
            return Err(Error::format(path, reason));
        }
        let direction = DMat3::from_cols(column(0) / spacing.x, column(1) / spacing.y, column(2) / spacing.z);
        for axis in 0..3 {
            // The sizes themselves carry less rounding than the length of a rounded column.
            if (spacing[axis] - pixdim[axis]).abs() < SAME_SPACING * pixdim[axis] {
                spacing[axis] = pixdim[axis];
            }
        }
        Ok((direction, spacing, column(3)))
    }

    fn quaternion_direction(&self, path: &Path) -> Result<DMat3> {
        let [b, c, d] = self.quaternion;
        let rest = 1.0 - (b * b + c * c + d * d);
        if !rest.is_finite() {
            return Err(Error::format(path, format!("qform quaternion {:?}", self.quaternion)));
        }
        let quaternion = glam::DQuat::from_xyzw(b, c, d, rest.max(0.0).sqrt()).normalize();
        let handed = if self.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
        Ok(DMat3::from_quat(quaternion) * DMat3::from_diagonal(DVec3::new(1.0, 1.0, handed)))
    }
}

/// Values after `slope * value + inter`; unchanged where the header asks for no scaling.
fn scaled(data: VoxelData, slope: f64, inter: f64) -> VoxelData {
    let inter = if inter.is_finite() { inter } else { 0.0 };
    if !slope.is_finite() || slope == 0.0 || (slope == 1.0 && inter == 0.0) {
        return data;
    }
    let single = VoxelType::of(&data).bytes() <= 2 || matches!(data, VoxelData::F32(_));
    with_voxels!(&data, values => if single {
        VoxelData::F32(values.iter().map(|v| (slope * v.to_f64() + inter) as f32).collect())
    } else {
        VoxelData::F64(values.iter().map(|v| slope * v.to_f64() + inter).collect())
    })
}

/// Turns the first two of three blocks of displacement components between RAS and LPS; whole numbers stay.
fn turn_blocks(data: &mut VoxelData) {
    let turned = data.len() / 3 * 2;
    match data {
        VoxelData::F32(values) => values[..turned].iter_mut().for_each(|v| *v = -*v),
        VoxelData::F64(values) => values[..turned].iter_mut().for_each(|v| *v = -*v),
        _ => {}
    }
}

/// One block per component becomes component fastest.
fn with_interleaved(data: VoxelData, components: usize) -> VoxelData {
    fn interleave<T: Copy>(values: &[T], components: usize) -> Vec<T> {
        let voxels = values.len() / components;
        (0..values.len()).map(|i| values[i % components * voxels + i / components]).collect()
    }
    super::map_voxels!(data, values => interleave(&values, components))
}

/// Component fastest becomes one block per component.
fn with_blocks(data: VoxelData, components: usize) -> VoxelData {
    fn separate<T: Copy>(values: &[T], components: usize) -> Vec<T> {
        let voxels = values.len() / components;
        (0..values.len()).map(|i| values[i % voxels * components + i / voxels]).collect()
    }
    super::map_voxels!(data, values => separate(&values, components))
}

/// Writes a NIfTI-1 image, packed where the name ends in `.gz`; three components get the intent of displacements.
///
/// # Errors
/// [`Error::Io`]; [`Error::Unsupported`] for an axis above 32767 voxels.
pub fn write(image: &VoxelImage, path: &Path) -> Result<()> {
    if image.grid.size().iter().any(|&s| s > i16::MAX as usize) || image.components > i16::MAX as usize {
        return Err(Error::Unsupported { reason: "NIfTI-1 holds at most 32767 voxels along an axis".into() });
    }
    let mut header = encode_header(image);
    header.resize(VOXELS_AT, 0);
    let mut blocks;
    let data = if image.components > 1 {
        blocks = with_blocks(image.data.clone(), image.components);
        if is_displacement(image) {
            turn_blocks(&mut blocks);
        }
        &blocks
    } else {
        &image.data
    };
    let packed = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("gz"));
    write_atomically(path, |writer| {
        if packed {
            let mut encoder = GzEncoder::new(writer, flate2::Compression::fast());
            encoder.write_all(&header)?;
            write_voxels(&mut encoder, data)?;
            encoder.finish().map(|_| ())
        } else {
            writer.write_all(&header)?;
            write_voxels(writer, data)
        }
    })
}

/// Three real components are a displacement.
fn is_displacement(image: &VoxelImage) -> bool {
    image.components == 3 && matches!(image.data, VoxelData::F32(_) | VoxelData::F64(_))
}

fn encode_header(image: &VoxelImage) -> Vec<u8> {
    let mut bytes = vec![0u8; HEADER_1];
    let mut put = |at: usize, value: &[u8]| bytes[at..at + value.len()].copy_from_slice(value);
    let grid = &image.grid;
    let (size, spacing) = (grid.size(), grid.spacing());
    let vector = image.components > 1;
    let axes: i16 = if vector { 5 } else { 3 };
    let dim = [axes, size[0] as i16, size[1] as i16, size[2] as i16, 1, image.components as i16, 1, 1];
    put(0, &(HEADER_1 as i32).to_ne_bytes());
    put(38, b"r");
    put(40, bytemuck::cast_slice(&dim));
    if vector {
        let intent = if is_displacement(image) { INTENT_DISPLACEMENT } else { INTENT_VECTOR };
        put(68, &intent.to_ne_bytes());
    }
    let (datatype, bits) = datatype_of(&image.data);
    put(70, &datatype.to_ne_bytes());
    put(72, &bits.to_ne_bytes());
    let matrix = DMat3::from_diagonal(FLIP) * grid.direction();
    let origin = FLIP * grid.origin();
    let (quaternion, handed) = quaternion_of(matrix);
    let pixdim = [handed, spacing.x, spacing.y, spacing.z, 1.0, 1.0, 1.0, 1.0].map(|v| v as f32);
    put(76, bytemuck::cast_slice(&pixdim));
    put(108, &(VOXELS_AT as f32).to_ne_bytes());
    put(112, &1f32.to_ne_bytes());
    put(123, &[UNITS_MM_S]);
    put(148, b"meshwright");
    // A sheared direction is no rotation: only the sform can hold it.
    let sheared = (matrix.transpose() * matrix - DMat3::IDENTITY).to_cols_array().iter().any(|v| v.abs() > 1e-4);
    put(252, &i16::from(!sheared).to_ne_bytes());
    put(254, &1i16.to_ne_bytes());
    put(256, bytemuck::cast_slice(&quaternion.map(|v| v as f32)));
    put(268, bytemuck::cast_slice(&origin.to_array().map(|v| v as f32)));
    for row in 0..3 {
        let values = [0, 1, 2].map(|c| (matrix.col(c)[row] * spacing[c]) as f32);
        put(280 + 16 * row, bytemuck::cast_slice(&[values[0], values[1], values[2], origin[row] as f32]));
    }
    put(344, b"n+1\0");
    bytes
}

fn datatype_of(data: &VoxelData) -> (i16, i16) {
    let code = match VoxelType::of(data) {
        VoxelType::U8 => 2,
        VoxelType::I16 => 4,
        VoxelType::I32 => 8,
        VoxelType::F32 => 16,
        VoxelType::F64 => 64,
        VoxelType::I8 => 256,
        VoxelType::U16 => 512,
        VoxelType::U32 => 768,
        VoxelType::I64 => 1024,
        VoxelType::U64 => 1280,
    };
    (code, 8 * VoxelType::of(data).bytes() as i16)
}

/// The quaternion part b, c, d of a rotation, and -1 where the matrix reflects (its third column is then turned).
fn quaternion_of(matrix: DMat3) -> ([f64; 3], f64) {
    let handed = if matrix.determinant() < 0.0 { -1.0 } else { 1.0 };
    let rotation = DMat3::from_cols(matrix.x_axis, matrix.y_axis, matrix.z_axis * handed);
    let q = glam::DQuat::from_mat3(&rotation).normalize();
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    ([q.x * sign, q.y * sign, q.z * sign], handed)
}
