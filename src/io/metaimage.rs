//! MetaImage: `.mha` with the voxels inside, `.mhd` with a data file beside it; raw, zlib and text.
//!
//! # Method
//! Lines `Key = Value` up to `ElementDataFile`, the last. Coordinates are LPS millimetres as ITK writes them; each
//! run of three numbers of `TransformMatrix` is the direction of one image axis.
//!
//! # Source
//! [MetaIO].
//!
//! # Limits
//! One data file. `AnatomicalOrientation` is a remark of the format and not used, as in ITK.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use flate2::read::ZlibDecoder;
use flate2::write::ZlibEncoder;
use glam::{DMat3, DVec3};

use super::atomic_file::{open, write_atomically};
use super::voxel_stream::{ByteOrder, VoxelSource, VoxelType, stream_error, write_voxels};
use crate::error::{Error, Result};
use crate::image::grid::Grid;
use crate::image::voxel_image::{VoxelData, VoxelImage};

/// Longest header line that is believed.
const LINE_BYTES: u64 = 1 << 16;
/// Most header lines that are believed.
const MOST_LINES: usize = 10_000;

struct Header<'a> {
    fields: Vec<(String, String)>,
    path: &'a Path,
}

/// Reads a MetaImage.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`], [`Error::OutOfMemory`].
pub fn read(path: &Path) -> Result<VoxelImage> {
    let (file, _) = open(path)?;
    let mut reader = BufReader::with_capacity(1 << 18, file);
    let header = Header::read(&mut reader, path)?;
    let kind = header.voxel_type()?;
    let axes = header.axis_count()?;
    let grid = header.grid(axes)?;
    let components = header.number("elementnumberofchannels", 1)?;
    if components < 1 {
        return Err(header.refuse(format!("{components} channels")));
    }
    let components = components as usize;
    let count = grid.voxel_count().saturating_mul(components);
    let data = header.read_data(reader, kind, count)?;
    VoxelImage::new(grid, components, data)
}

impl<'a> Header<'a> {
    fn read(reader: &mut BufReader<File>, path: &'a Path) -> Result<Self> {
        let mut header = Self { fields: Vec::new(), path };
        for _ in 0..MOST_LINES {
            let mut bytes = Vec::new();
            (&mut *reader).take(LINE_BYTES).read_until(b'\n', &mut bytes).map_err(|e| stream_error(path, &e))?;
            if bytes.is_empty() {
                return Err(header.refuse("the header is truncated: no ElementDataFile"));
            }
            let line = std::str::from_utf8(&bytes).map_err(|_| header.refuse("not a MetaImage: no text header"))?;
            if line.trim().is_empty() {
                continue;
            }
            let Some((name, value)) = line.split_once('=') else {
                return Err(header.refuse(format!("not a MetaImage: header line '{}'", line.trim())));
            };
            let name = name.trim().to_lowercase();
            let last = name == "elementdatafile";
            header.fields.push((name, value.trim().to_owned()));
            if last {
                return Ok(header);
            }
        }
        Err(header.refuse("the header does not end"))
    }

    fn refuse(&self, reason: impl Into<String>) -> Error {
        Error::format(self.path, reason)
    }

    fn field(&self, name: &str) -> Option<&str> {
        self.fields.iter().find(|(n, _)| n == name).map(|(_, v)| v.as_str())
    }

    fn first_field(&self, names: &[&str]) -> Option<&str> {
        names.iter().find_map(|name| self.field(name))
    }

    fn number(&self, name: &str, default: i64) -> Result<i64> {
        let Some(text) = self.field(name) else { return Ok(default) };
        text.parse().map_err(|_| self.refuse(format!("{name} '{text}'")))
    }

    fn flag(&self, names: &[&str]) -> Result<bool> {
        let Some(text) = self.first_field(names) else { return Ok(false) };
        match text.chars().next().map(|c| c.to_ascii_lowercase()) {
            Some('t' | 'y' | '1') => Ok(true),
            Some('f' | 'n' | '0') => Ok(false),
            _ => Err(self.refuse(format!("{} '{text}' is neither True nor False", names[0]))),
        }
    }

    fn reals(&self, names: &[&str], count: usize) -> Result<Option<Vec<f64>>> {
        let Some(text) = self.first_field(names) else { return Ok(None) };
        let values: Option<Vec<f64>> = text.split_whitespace().map(|w| w.parse().ok()).collect();
        values
            .filter(|v| v.len() == count)
            .map(Some)
            .ok_or_else(|| self.refuse(format!("{} '{text}' are not {count} numbers", names[0])))
    }

    fn axis_count(&self) -> Result<usize> {
        match self.number("ndims", 3)? {
            3 => Ok(3),
            4 => Ok(4),
            other => Err(self.refuse(format!("a {other}-D image; three axes are needed"))),
        }
    }

    fn voxel_type(&self) -> Result<VoxelType> {
        let name = self.field("elementtype").ok_or_else(|| self.refuse("the header has no ElementType"))?;
        Ok(match name.to_uppercase().as_str() {
            "MET_UCHAR" => VoxelType::U8,
            "MET_CHAR" | "MET_ASCII_CHAR" => VoxelType::I8,
            "MET_USHORT" => VoxelType::U16,
            "MET_SHORT" => VoxelType::I16,
            // MetaIO's LONG has four bytes on every machine.
            "MET_UINT" | "MET_ULONG" => VoxelType::U32,
            "MET_INT" | "MET_LONG" => VoxelType::I32,
            "MET_ULONG_LONG" => VoxelType::U64,
            "MET_LONG_LONG" => VoxelType::I64,
            "MET_FLOAT" => VoxelType::F32,
            "MET_DOUBLE" => VoxelType::F64,
            _ => return Err(self.refuse(format!("ElementType '{name}' is not supported"))),
        })
    }

    fn grid(&self, axes: usize) -> Result<Grid> {
        let text = self.field("dimsize").ok_or_else(|| self.refuse("the header has no DimSize"))?;
        let sizes: Vec<usize> = text
            .split_whitespace()
            .map(|w| w.parse().ok().filter(|&s| s > 0))
            .collect::<Option<_>>()
            .filter(|s: &Vec<usize>| s.len() == axes)
            .ok_or_else(|| self.refuse(format!("DimSize '{text}'")))?;
        if axes == 4 && sizes[3] > 1 {
            return Err(self.refuse(format!("a 4-D image: {} time points", sizes[3])));
        }
        let vector = |values: Option<Vec<f64>>, default: DVec3| values.map_or(default, |v| DVec3::from_slice(&v[..3]));
        let spacing = vector(self.reals(&["elementspacing", "elementsize"], axes)?, DVec3::ONE);
        let origin = vector(self.reals(&["offset", "position", "origin"], axes)?, DVec3::ZERO);
        let matrix = self.reals(&["transformmatrix", "rotation", "orientation"], axes * axes)?;
        let direction = matrix.map_or(DMat3::IDENTITY, |m| {
            let column = |c: usize| DVec3::from_slice(&m[c * axes..c * axes + 3]);
            DMat3::from_cols(column(0), column(1), column(2))
        });
        Grid::new([sizes[0], sizes[1], sizes[2]], spacing, origin, direction).map_err(|e| self.refuse(e.to_string()))
    }

    fn read_data(&self, attached: BufReader<File>, kind: VoxelType, count: usize) -> Result<VoxelData> {
        let name = self.field("elementdatafile").unwrap_or("");
        let local = name.eq_ignore_ascii_case("local");
        if !local && (name.is_empty() || name.starts_with("LIST") || name.contains('%')) {
            return Err(self.refuse(format!("ElementDataFile '{name}': one data file is needed")));
        }
        let (mut reader, path) = if local {
            (attached, self.path.to_path_buf())
        } else {
            let path = self.path.parent().unwrap_or(Path::new("")).join(name);
            (BufReader::with_capacity(1 << 18, open(&path)?.0), path)
        };
        let big = self.flag(&["elementbyteordermsb", "binarydatabyteordermsb"])?;
        let order = if big { ByteOrder::Big } else { ByteOrder::Little };
        let text = self.field("binarydata").is_some() && !self.flag(&["binarydata"])?;
        if text {
            return VoxelSource { reader: &mut reader, order, available: None, path: &path }.read_text(kind, count);
        }
        let header_size = self.number("headersize", 0)?;
        if self.flag(&["compresseddata"])? {
            let mut reader = ZlibDecoder::new(reader);
            let mut source = VoxelSource { reader: &mut reader, order, available: None, path: &path };
            let data = source.read_binary(kind, count)?;
            source.finish()?;
            return Ok(data);
        }
        let bytes = (count as u128 * kind.bytes() as u128).min(i64::MAX as u128) as i64;
        let from = match header_size {
            // -1: the voxels are the last bytes of the file.
            ..0 => SeekFrom::End(-bytes),
            skip => SeekFrom::Current(skip),
        };
        let length = reader.get_ref().metadata().map_err(|e| Error::io(&path, e))?.len();
        let at = reader.seek(from).map_err(|_| self.refuse("the header claims more voxels than the file holds"))?;
        let available = Some(length.saturating_sub(at));
        VoxelSource { reader: &mut reader, order, available, path: &path }.read_binary(kind, count)
    }
}

/// Writes `.mha` (voxels inside) or `.mhd` (with a `.zraw` beside it), packed with zlib.
///
/// # Errors
/// [`Error::Io`].
pub fn write(image: &VoxelImage, path: &Path) -> Result<()> {
    let detached: Option<PathBuf> =
        path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mhd")).then(|| path.with_extension("zraw"));
    let mut encoder = ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    // The header states the packed size, so the voxels are packed first.
    write_voxels(&mut encoder, &image.data).map_err(|e| Error::io(path, e))?;
    let packed = encoder.finish().map_err(|e| Error::io(path, e))?;
    let data_name = match &detached {
        Some(data) => data.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        None => "LOCAL".to_owned(),
    };
    let header = encode_header(image, packed.len(), &data_name);
    if let Some(data_path) = detached {
        write_atomically(&data_path, |writer| writer.write_all(&packed))?;
        return write_atomically(path, |writer| writer.write_all(header.as_bytes()));
    }
    write_atomically(path, |writer| {
        writer.write_all(header.as_bytes())?;
        writer.write_all(&packed)
    })
}

fn encode_header(image: &VoxelImage, packed_bytes: usize, data_name: &str) -> String {
    let grid = &image.grid;
    let type_name = match VoxelType::of(&image.data) {
        VoxelType::U8 => "MET_UCHAR",
        VoxelType::I8 => "MET_CHAR",
        VoxelType::U16 => "MET_USHORT",
        VoxelType::I16 => "MET_SHORT",
        VoxelType::U32 => "MET_UINT",
        VoxelType::I32 => "MET_INT",
        VoxelType::U64 => "MET_ULONG_LONG",
        VoxelType::I64 => "MET_LONG_LONG",
        VoxelType::F32 => "MET_FLOAT",
        VoxelType::F64 => "MET_DOUBLE",
    };
    let words = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let big = if ByteOrder::NATIVE == ByteOrder::Big { "True" } else { "False" };
    let channels = match image.components {
        1 => String::new(),
        n => format!("ElementNumberOfChannels = {n}\n"),
    };
    let size = grid.size();
    format!(
        "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = {big}\nCompressedData = True\n\
         CompressedDataSize = {packed_bytes}\nTransformMatrix = {}\nOffset = {}\nCenterOfRotation = 0 0 0\n\
         AnatomicalOrientation = RAI\nElementSpacing = {}\nDimSize = {} {} {}\n{channels}ElementType = {type_name}\n\
         ElementDataFile = {data_name}\n",
        words(&grid.direction().to_cols_array()),
        words(&grid.origin().to_array()),
        words(&grid.spacing().to_array()),
        size[0],
        size[1],
        size[2],
    )
}
