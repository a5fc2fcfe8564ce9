//! NRRD images: attached `.nrrd`, detached `.nhdr`; raw, gzip and text.
//!
//! # Method
//! 1. Header lines `field: value` up to the empty line; every field is checked when it is needed.
//! 2. Three axes are spatial, at most one more holds components; which, `space directions` and `kinds` say.
//! 3. Directions and origin are turned from the stated space to LPS.
//!
//! # Source
//! [NRRD].
//!
//! # Limits
//! One data file; encodings bzip2 and hex are refused, so are time axes of more than one step.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use flate2::read::MultiGzDecoder;
use flate2::write::GzEncoder;
use glam::{DMat3, DVec3};

use super::atomic_file::{open, write_atomically};
use super::voxel_stream::{ByteOrder, VoxelSource, VoxelType, stream_error, write_voxels};
use crate::error::{Error, Result};
use crate::image::grid::Grid;
use crate::image::voxel_image::{VoxelData, VoxelImage};

/// Longest header line that is believed; beyond it the file is no NRRD.
const LINE_BYTES: u64 = 1 << 20;
/// Most axes that the format allows.
const MOST_AXES: usize = 16;

/// The header's fields as text, in lower case names.
struct Header<'a> {
    fields: Vec<(String, String)>,
    path: &'a Path,
}

/// How the voxels lie in the data file.
#[derive(Clone, Copy, PartialEq)]
enum Packing {
    Raw,
    Gzip,
    Text,
}

/// Reads an NRRD image.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`], [`Error::OutOfMemory`].
pub fn read(path: &Path) -> Result<VoxelImage> {
    let (file, _) = open(path)?;
    let mut reader = BufReader::with_capacity(1 << 18, file);
    let header = Header::read(&mut reader, path)?;
    let kind = header.voxel_type()?;
    let axes = header.axes()?;
    let grid = header.grid(&axes)?;
    let count = grid.voxel_count().saturating_mul(axes.components);
    let data = header.read_data(reader, kind, count)?;
    let data = if axes.component_axis == Some(3) {
        // Components slowest: one block each.
        super::map_voxels!(data, values => {
            let voxels = values.len() / axes.components;
            (0..values.len()).map(|i| values[i % axes.components * voxels + i / axes.components]).collect()
        })
    } else {
        data
    };
    VoxelImage::new(grid, axes.components, data)
}

/// Which axes are spatial and which holds components.
struct Axes {
    sizes: [usize; 3],
    /// Position of each spatial axis among all.
    spatial: [usize; 3],
    components: usize,
    /// Position of the component axis: 0 fastest or 3 slowest.
    component_axis: Option<usize>,
}

impl<'a> Header<'a> {
    fn read(reader: &mut BufReader<File>, path: &'a Path) -> Result<Self> {
        let mut header = Self { fields: Vec::new(), path };
        let magic = header.line(reader)?;
        if !magic.starts_with("NRRD000") {
            return Err(header.refuse("not an NRRD file: it does not begin with NRRD000"));
        }
        loop {
            let line = header.line(reader)?;
            if line.is_empty() {
                break;
            }
            if line.starts_with('#') || line.contains(":=") {
                continue;
            }
            let Some((name, value)) = line.split_once(':') else {
                return Err(header.refuse(format!("header line '{line}' has no colon")));
            };
            header.fields.push((name.trim().to_lowercase(), value.trim().to_owned()));
            // A detached header may end with the file.
            if reader.fill_buf().map_err(|e| stream_error(path, &e))?.is_empty() {
                break;
            }
        }
        Ok(header)
    }

    fn line(&self, reader: &mut BufReader<File>) -> Result<String> {
        let mut bytes = Vec::new();
        reader.take(LINE_BYTES).read_until(b'\n', &mut bytes).map_err(|e| stream_error(self.path, &e))?;
        if bytes.pop() != Some(b'\n') {
            return Err(self.refuse("the header is truncated"));
        }
        String::from_utf8(bytes)
            .map(|l| l.trim_end_matches('\r').to_owned())
            .map_err(|_| self.refuse("the header is not text"))
    }

    fn refuse(&self, reason: impl Into<String>) -> Error {
        Error::format(self.path, reason)
    }

    fn field(&self, name: &str) -> Option<&str> {
        self.fields.iter().find(|(n, _)| n == name).map(|(_, v)| v.as_str())
    }

    fn required(&self, name: &str) -> Result<&str> {
        self.field(name).ok_or_else(|| self.refuse(format!("the header has no field '{name}'")))
    }

    fn voxel_type(&self) -> Result<VoxelType> {
        let name = self.required("type")?;
        Ok(match name.to_lowercase().as_str() {
            "uchar" | "unsigned char" | "uint8" | "uint8_t" => VoxelType::U8,
            "signed char" | "int8" | "int8_t" => VoxelType::I8,
            "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => VoxelType::U16,
            "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => VoxelType::I16,
            "uint" | "unsigned int" | "uint32" | "uint32_t" => VoxelType::U32,
            "int" | "signed int" | "int32" | "int32_t" => VoxelType::I32,
            "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => VoxelType::U64,
            "longlong"
            | "long long"
            | "long long int"
            | "signed long long"
            | "signed long long int"
            | "int64"
            | "int64_t" => VoxelType::I64,
            "float" => VoxelType::F32,
            "double" => VoxelType::F64,
            _ => return Err(self.refuse(format!("voxel type '{name}' is not supported"))),
        })
    }

    fn axes(&self) -> Result<Axes> {
        let text = self.required("dimension")?;
        let dimension: usize = text.parse().map_err(|_| self.refuse(format!("dimension '{text}'")))?;
        if !(1..=MOST_AXES).contains(&dimension) {
            return Err(self.refuse(format!("dimension {dimension}")));
        }
        let sizes = self.required("sizes")?;
        let sizes: Vec<usize> = sizes
            .split_whitespace()
            .map(|s| s.parse().ok().filter(|&s| s > 0))
            .collect::<Option<_>>()
            .filter(|s: &Vec<usize>| s.len() == dimension)
            .ok_or_else(|| self.refuse(format!("sizes '{sizes}' for dimension {dimension}")))?;
        if dimension < 3 {
            return Err(self.refuse(format!("a {dimension}-D image; three axes are needed")));
        }
        let spatial = self.spatial_axes(&sizes)?;
        let others: Vec<usize> = (0..dimension).filter(|a| !spatial.contains(a)).collect();
        // Axes of one value carry nothing.
        let others: Vec<usize> = others.into_iter().filter(|&a| sizes[a] > 1).collect();
        let component_axis = match others.as_slice() {
            [] => None,
            [0] => Some(0),
            [last] if *last > spatial[2] => Some(3),
            _ => return Err(self.refuse(format!("a {dimension}-D image of sizes {sizes:?}"))),
        };
        if component_axis.is_some() && self.is_time_axis(others[0]) {
            return Err(self.refuse(format!("a 4-D image: {} time points", sizes[others[0]])));
        }
        let components = others.first().map_or(1, |&a| sizes[a]);
        Ok(Axes { sizes: spatial.map(|a| sizes[a]), spatial, components, component_axis })
    }

    /// A fourth axis without a word about its meaning is time.
    fn is_time_axis(&self, axis: usize) -> bool {
        let kind = self.field("kinds").and_then(|k| k.split_whitespace().nth(axis)).unwrap_or("???");
        let by_direction = self.field("space directions").is_some() && axis == 0;
        match kind.to_lowercase().as_str() {
            "time" | "domain" | "space" => true,
            "???" | "none" => !by_direction,
            _ => false,
        }
    }

    fn spatial_axes(&self, sizes: &[usize]) -> Result<[usize; 3]> {
        let dimension = sizes.len();
        let by_direction: Option<Vec<usize>> = match self.field("space directions") {
            Some(text) => {
                let vectors = self.vectors(text)?;
                if vectors.len() != dimension {
                    return Err(self.refuse(format!("{} space directions for {dimension} axes", vectors.len())));
                }
                Some((0..dimension).filter(|&a| vectors[a].is_some()).collect())
            }
            None => None,
        };
        let axes = by_direction.unwrap_or_else(|| {
            let kinds: Vec<String> =
                self.field("kinds").unwrap_or("").split_whitespace().map(str::to_lowercase).collect();
            let marked: Vec<usize> =
                (0..dimension).filter(|&a| kinds.get(a).is_some_and(|k| k == "domain" || k == "space")).collect();
            if marked.len() == 3 { marked } else { (0..3).collect() }
        });
        let axes: [usize; 3] = axes
            .try_into()
            .map_err(|axes: Vec<usize>| self.refuse(format!("{} spatial axes; three are needed", axes.len())))?;
        if axes[2] - axes[0] != 2 {
            return Err(self.refuse("the component axis lies between the spatial axes"));
        }
        Ok(axes)
    }

    /// `(a,b,c) none (d,e,f)`: one entry per word.
    fn vectors(&self, text: &str) -> Result<Vec<Option<DVec3>>> {
        let mut vectors = Vec::new();
        let mut rest = text.trim();
        while !rest.is_empty() {
            if let Some(after) = rest.strip_prefix("none") {
                vectors.push(None);
                rest = after.trim_start();
                continue;
            }
            let inner = rest.strip_prefix('(').and_then(|r| r.split_once(')'));
            let Some((inner, after)) = inner else {
                return Err(self.refuse(format!("'{text}' is no list of vectors")));
            };
            let numbers: Option<Vec<f64>> = inner.split(',').map(|n| n.trim().parse().ok()).collect();
            match numbers.as_deref() {
                Some(&[x, y, z]) => vectors.push(Some(DVec3::new(x, y, z))),
                _ => return Err(self.refuse(format!("'({inner})' is no vector of three numbers"))),
            }
            rest = after.trim_start();
        }
        Ok(vectors)
    }

    /// Signs that turn the header's space into LPS.
    fn to_lps(&self) -> Result<DVec3> {
        let Some(space) = self.field("space") else { return Ok(DVec3::ONE) };
        Ok(match space.to_lowercase().as_str() {
            "left-posterior-superior" | "lps" | "left-posterior-superior-time" | "lpst" => DVec3::ONE,
            "right-anterior-superior" | "ras" | "right-anterior-superior-time" | "rast" => DVec3::new(-1.0, -1.0, 1.0),
            "left-anterior-superior" | "las" | "left-anterior-superior-time" | "last" => DVec3::new(1.0, -1.0, 1.0),
            "scanner-xyz" | "3d-right-handed" | "3d-left-handed" => DVec3::ONE,
            _ => return Err(self.refuse(format!("space '{space}' is not known"))),
        })
    }

    fn grid(&self, axes: &Axes) -> Result<Grid> {
        let flip = self.to_lps()?;
        let mut spacing = DVec3::ONE;
        let mut direction = DMat3::IDENTITY;
        if let Some(text) = self.field("space directions") {
            let vectors = self.vectors(text)?;
            for (i, axis) in axes.spatial.into_iter().enumerate() {
                let vector = vectors[axis].expect("spatial axes have a direction");
                spacing[i] = vector.length();
                if !(spacing[i] > 0.0 && spacing[i].is_finite()) {
                    return Err(self.refuse(format!("space direction {:?} of axis {axis}", vector.to_array())));
                }
                *direction.col_mut(i) = flip * vector / spacing[i];
            }
        } else if let Some(text) = self.field("spacings") {
            let words: Vec<&str> = text.split_whitespace().collect();
            for (i, axis) in axes.spatial.into_iter().enumerate() {
                let word = words.get(axis).copied().unwrap_or("");
                spacing[i] = word.parse().map_err(|_| self.refuse(format!("spacing '{word}'")))?;
            }
            direction = DMat3::from_diagonal(flip);
        }
        let origin = match self.field("space origin") {
            Some(text) => match self.vectors(text)?.as_slice() {
                [Some(origin)] => flip * *origin,
                _ => return Err(self.refuse(format!("space origin '{text}'"))),
            },
            None => DVec3::ZERO,
        };
        Grid::new(axes.sizes, spacing, origin, direction).map_err(|e| self.refuse(e.to_string()))
    }

    fn packing(&self) -> Result<Packing> {
        let name = self.required("encoding")?;
        match name.to_lowercase().as_str() {
            "raw" => Ok(Packing::Raw),
            "gzip" | "gz" => Ok(Packing::Gzip),
            "text" | "txt" | "ascii" => Ok(Packing::Text),
            _ => Err(self.refuse(format!("encoding '{name}' is not supported (raw, gzip and ascii are)"))),
        }
    }

    fn skip(&self, short: &str, long: &str) -> Result<i64> {
        let Some(text) = self.field(short).or_else(|| self.field(long)) else { return Ok(0) };
        text.parse().map_err(|_| self.refuse(format!("{short} '{text}'")))
    }

    fn read_data(&self, attached: BufReader<File>, kind: VoxelType, count: usize) -> Result<VoxelData> {
        let packing = self.packing()?;
        let order = self.byte_order(kind, packing)?;
        let (mut reader, path) = match self.field("data file").or_else(|| self.field("datafile")) {
            None => (attached, self.path.to_path_buf()),
            Some(name) => {
                if name.starts_with("LIST") || name.contains('%') {
                    return Err(self.refuse("voxels in several files are not supported"));
                }
                let path = self.path.parent().unwrap_or(Path::new("")).join(name);
                (BufReader::with_capacity(1 << 18, open(&path)?.0), path)
            }
        };
        for _ in 0..self.skip("line skip", "lineskip")? {
            reader.read_until(b'\n', &mut Vec::new()).map_err(|e| stream_error(&path, &e))?;
        }
        let byte_skip = self.skip("byte skip", "byteskip")?;
        let length = reader.get_ref().metadata().map_err(|e| Error::io(&path, e))?.len();
        if packing == Packing::Raw {
            let bytes = (count as u128 * kind.bytes() as u128).min(i64::MAX as u128) as i64;
            // -1: the voxels are the last bytes of the file.
            let from = if byte_skip < 0 { SeekFrom::End(-bytes) } else { SeekFrom::Current(byte_skip) };
            let moved = reader.seek(from).map_err(|_| self.refuse("the header claims more voxels than the file holds"));
            let available = Some(length.saturating_sub(moved?));
            return VoxelSource { reader: &mut reader, order, available, path: &path }.read_binary(kind, count);
        }
        if packing == Packing::Text {
            let mut reader = skipped(reader, byte_skip, &path)?;
            return VoxelSource { reader: &mut reader, order, available: None, path: &path }.read_text(kind, count);
        }
        // In a packed file the skip counts unpacked bytes.
        let mut reader = skipped(MultiGzDecoder::new(reader), byte_skip, &path)?;
        let mut source = VoxelSource { reader: &mut reader, order, available: None, path: &path };
        let data = source.read_binary(kind, count)?;
        source.finish()?;
        Ok(data)
    }

    fn byte_order(&self, kind: VoxelType, packing: Packing) -> Result<ByteOrder> {
        match self.field("endian").map(str::to_lowercase).as_deref() {
            Some("little") => Ok(ByteOrder::Little),
            Some("big") => Ok(ByteOrder::Big),
            None if kind.bytes() == 1 || packing == Packing::Text => Ok(ByteOrder::NATIVE),
            other => Err(self.refuse(format!("endian '{}'", other.unwrap_or("missing")))),
        }
    }
}

fn skipped<R: Read>(mut reader: R, bytes: i64, path: &Path) -> Result<R> {
    let bytes = u64::try_from(bytes).map_err(|_| Error::format(path, "byte skip -1 needs raw encoding"))?;
    std::io::copy(&mut (&mut reader).take(bytes), &mut std::io::sink()).map_err(|e| stream_error(path, &e))?;
    Ok(reader)
}

/// Writes `.nrrd` (header and packed voxels in one file) or `.nhdr` (with a `.raw.gz` beside it).
///
/// # Errors
/// [`Error::Io`].
pub fn write(image: &VoxelImage, path: &Path) -> Result<()> {
    let detached: Option<PathBuf> =
        path.extension().is_some_and(|e| e.eq_ignore_ascii_case("nhdr")).then(|| path.with_extension("raw.gz"));
    let mut header = encode_header(image);
    let pack = |writer: &mut dyn Write| {
        let mut encoder = GzEncoder::new(writer, flate2::Compression::fast());
        write_voxels(&mut encoder, &image.data)?;
        encoder.finish().map(|_| ())
    };
    if let Some(data_path) = detached {
        write_atomically(&data_path, pack)?;
        let name = data_path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        header.push_str(&format!("data file: {name}\n"));
        return write_atomically(path, |writer| writer.write_all(header.as_bytes()));
    }
    header.push('\n');
    write_atomically(path, |writer| {
        writer.write_all(header.as_bytes())?;
        pack(writer)
    })
}

fn encode_header(image: &VoxelImage) -> String {
    let grid = &image.grid;
    let size = grid.size();
    let type_name = match VoxelType::of(&image.data) {
        VoxelType::U8 => "uint8",
        VoxelType::I8 => "int8",
        VoxelType::U16 => "uint16",
        VoxelType::I16 => "int16",
        VoxelType::U32 => "uint32",
        VoxelType::I32 => "int32",
        VoxelType::U64 => "uint64",
        VoxelType::I64 => "int64",
        VoxelType::F32 => "float",
        VoxelType::F64 => "double",
    };
    let vector = |v: DVec3| format!("({},{},{})", v.x, v.y, v.z);
    let directions: Vec<String> = (0..3).map(|c| vector(grid.direction().col(c) * grid.spacing()[c])).collect();
    let (dimension, sizes, directions, kinds) = if image.components > 1 {
        let sizes = format!("{} {} {} {}", image.components, size[0], size[1], size[2]);
        (4, sizes, format!("none {}", directions.join(" ")), "vector domain domain domain")
    } else {
        (3, format!("{} {} {}", size[0], size[1], size[2]), directions.join(" "), "domain domain domain")
    };
    let endian = if ByteOrder::NATIVE == ByteOrder::Little { "little" } else { "big" };
    format!(
        "NRRD0005\ntype: {type_name}\ndimension: {dimension}\nspace: left-posterior-superior\nsizes: {sizes}\n\
         space directions: {directions}\nkinds: {kinds}\nendian: {endian}\nencoding: gzip\nspace origin: {}\n",
        vector(grid.origin())
    )
}
