//! VTK XML files: `.vtu` meshes and `.vtp` surfaces, one appended block of bytes.
//!
//! # Method
//! The XML head lists every array with its offset in the block behind it, so the sizes are known (or, packed, made)
//! first and the bytes then stream out. The frame stands in a field-data string `SPACE`, where 3D Slicer looks for it.
//! The labels go out under two names, `label` and `labels` (as SegmentMesher's users expect), which share their bytes.
//!
//! # Source
//! [VTKFileFormats].
//!
//! # Cost
//! No copy of the mesh without packing; packed, the packed bytes are held until they are written.

use std::io::Write;

use flate2::Compression as ZlibLevel;
use flate2::write::ZlibEncoder;
use glam::DVec3;

use super::surface_export::SurfaceExport;
use super::{Compression, Encoding, WriteOptions, signs};
use crate::mesh::mixed_mesh::{ArrayData, MixedMesh, NamedArray, Space};

/// Bytes that are packed together; VTK's own choice.
const BLOCK_BYTES: usize = 32768;
/// Points converted at a time.
const CHUNK_POINTS: usize = 4096;

/// The values of an array.
#[derive(Clone, Copy)]
pub enum Values<'a> {
    /// Bytes.
    U8(&'a [u8]),
    /// 32-bit whole numbers.
    I32(&'a [i32]),
    /// 64-bit whole numbers.
    I64(&'a [i64]),
    /// Reals.
    F64(&'a [f64]),
    /// Points, each multiplied by signs.
    Points(&'a [DVec3], DVec3),
}

impl<'a> Values<'a> {
    /// The values of a named array.
    pub fn of(data: &'a ArrayData) -> Self {
        match data {
            ArrayData::Int(values) => Self::I32(values),
            ArrayData::Long(values) => Self::I64(values),
            ArrayData::Real(values) => Self::F64(values),
        }
    }

    fn type_name(self) -> &'static str {
        match self {
            Self::U8(_) => "UInt8",
            Self::I32(_) => "Int32",
            Self::I64(_) => "Int64",
            Self::F64(_) | Self::Points(..) => "Float64",
        }
    }

    fn byte_count(self) -> u64 {
        match self {
            Self::U8(v) => v.len() as u64,
            Self::I32(v) => 4 * v.len() as u64,
            Self::I64(v) => 8 * v.len() as u64,
            Self::F64(v) => 8 * v.len() as u64,
            Self::Points(v, _) => 24 * v.len() as u64,
        }
    }

    fn write_bytes(self, out: &mut dyn Write) -> std::io::Result<()> {
        match self {
            Self::U8(v) => out.write_all(v),
            Self::I32(v) => out.write_all(bytemuck::cast_slice(v)),
            Self::I64(v) => out.write_all(bytemuck::cast_slice(v)),
            Self::F64(v) => out.write_all(bytemuck::cast_slice(v)),
            Self::Points(v, signs) if signs == DVec3::ONE => out.write_all(bytemuck::cast_slice(v)),
            Self::Points(v, signs) => v.chunks(CHUNK_POINTS).try_for_each(|chunk| {
                let turned: Vec<DVec3> = chunk.iter().map(|&p| p * signs).collect();
                out.write_all(bytemuck::cast_slice(&turned))
            }),
        }
    }

    fn write_text(self, out: &mut dyn Write) -> std::io::Result<()> {
        fn words<T: std::fmt::Display>(out: &mut dyn Write, values: &[T]) -> std::io::Result<()> {
            values.chunks(12).try_for_each(|row| {
                row.iter().try_for_each(|v| write!(out, "{v} "))?;
                writeln!(out)
            })
        }
        match self {
            Self::U8(v) => words(out, v),
            Self::I32(v) => words(out, v),
            Self::I64(v) => words(out, v),
            Self::F64(v) => words(out, v),
            Self::Points(v, signs) => v.iter().try_for_each(|&p| {
                let p = p * signs;
                writeln!(out, "{} {} {}", p.x, p.y, p.z)
            }),
        }
    }

    /// Blocks of packed bytes behind VTK's table of their sizes.
    fn packed(self) -> std::io::Result<Vec<u8>> {
        let mut plain = Vec::new();
        self.write_bytes(&mut plain)?;
        let mut sizes = Vec::new();
        let mut body = Vec::new();
        for block in plain.chunks(BLOCK_BYTES) {
            let before = body.len();
            let mut encoder = ZlibEncoder::new(&mut body, ZlibLevel::fast());
            encoder.write_all(block)?;
            encoder.finish()?;
            sizes.push((body.len() - before) as u64);
        }
        let table = [sizes.len() as u64, BLOCK_BYTES as u64, (plain.len() % BLOCK_BYTES) as u64];
        let mut bytes: Vec<u8> = bytemuck::cast_slice(&table).to_vec();
        bytes.extend_from_slice(bytemuck::cast_slice(&sizes));
        bytes.append(&mut body);
        Ok(bytes)
    }
}

/// One array of the file.
struct Array<'a> {
    name: &'a str,
    components: usize,
    values: Values<'a>,
    /// Shares the bytes of the array before it.
    repeats: bool,
}

impl<'a> Array<'a> {
    fn new(name: &'a str, components: usize, values: Values<'a>) -> Self {
        Self { name, components, values, repeats: false }
    }
}

/// A heading of the XML with the arrays under it.
struct Section<'a> {
    name: &'static str,
    arrays: Vec<Array<'a>>,
}

fn named<'a>(arrays: &'a [NamedArray]) -> impl Iterator<Item = Array<'a>> {
    arrays.iter().map(|a| Array::new(&a.name, a.components, Values::of(&a.data)))
}

/// Writes a mesh as `.vtu`.
///
/// # Errors
/// Those of the writer.
pub fn write_vtu(mesh: &MixedMesh, options: &WriteOptions, out: &mut dyn Write) -> std::io::Result<()> {
    let ids: &[i32] = bytemuck::cast_slice(&mesh.connectivity);
    let mut labels = vec![
        Array::new("label", 1, Values::I32(&mesh.labels)),
        Array { repeats: true, ..Array::new("labels", 1, Values::I32(&mesh.labels)) },
    ];
    labels.extend(named(&mesh.element_data));
    let sections = [
        Section { name: "PointData", arrays: named(&mesh.point_data).collect() },
        Section { name: "CellData", arrays: labels },
        Section {
            name: "Points",
            arrays: vec![Array::new("Points", 3, Values::Points(&mesh.points, signs(mesh.space, options)))],
        },
        Section {
            name: "Cells",
            arrays: vec![
                Array::new("connectivity", 1, Values::I32(ids)),
                Array::new("offsets", 1, Values::I64(&mesh.offsets[1..])),
                Array::new("types", 1, Values::U8(&mesh.types)),
            ],
        },
    ];
    let counts = format!("NumberOfPoints=\"{}\" NumberOfCells=\"{}\"", mesh.points.len(), mesh.element_count());
    write_file("UnstructuredGrid", &counts, &sections, options.space.unwrap_or(mesh.space), options, out)
}

/// Writes a surface as `.vtp`.
///
/// # Errors
/// Those of the writer.
pub fn write_vtp(export: &SurfaceExport, options: &WriteOptions, out: &mut dyn Write) -> std::io::Result<()> {
    let surface = &export.surface;
    let ids: &[i32] = bytemuck::cast_slice(&surface.facets);
    let offsets: Vec<i64> = (1..=surface.facets.len() as i64).map(|i| 3 * i).collect();
    let mut cells = vec![Array::new("patch", 1, Values::I32(&surface.facet_patches))];
    cells.extend(named(&export.arrays));
    let sections = [
        Section { name: "PointData", arrays: Vec::new() },
        Section { name: "CellData", arrays: cells },
        Section {
            name: "Points",
            arrays: vec![Array::new("Points", 3, Values::Points(&surface.points, signs(export.space, options)))],
        },
        Section {
            name: "Polys",
            arrays: vec![
                Array::new("connectivity", 1, Values::I32(ids)),
                Array::new("offsets", 1, Values::I64(&offsets)),
            ],
        },
    ];
    let counts = format!(
        "NumberOfPoints=\"{}\" NumberOfVerts=\"0\" NumberOfLines=\"0\" NumberOfStrips=\"0\" NumberOfPolys=\"{}\"",
        surface.points.len(),
        surface.facets.len()
    );
    write_file("PolyData", &counts, &sections, options.space.unwrap_or(export.space), options, out)
}

fn write_file(
    kind: &str,
    counts: &str,
    sections: &[Section],
    space: Space,
    options: &WriteOptions,
    out: &mut dyn Write,
) -> std::io::Result<()> {
    let packs = options.compression == Compression::Zlib && options.encoding == Encoding::Binary;
    let order = if cfg!(target_endian = "little") { "LittleEndian" } else { "BigEndian" };
    let compressor = if packs { " compressor=\"vtkZLibDataCompressor\"" } else { "" };
    writeln!(
        out,
        "<?xml version=\"1.0\"?>\n<VTKFile type=\"{kind}\" version=\"1.0\" byte_order=\"{order}\" \
         header_type=\"UInt64\"{compressor}>\n<{kind}>"
    )?;
    write_space(space, out)?;
    writeln!(out, "<Piece {counts}>")?;
    let mut packed = Vec::new();
    let (mut offset, mut last) = (0u64, 0u64);
    for section in sections {
        writeln!(out, "<{}>", section.name)?;
        for array in &section.arrays {
            let name = escaped(array.name);
            let (type_name, components) = (array.values.type_name(), array.components);
            write!(out, "<DataArray type=\"{type_name}\" Name=\"{name}\" NumberOfComponents=\"{components}\" ")?;
            if options.encoding == Encoding::Ascii {
                writeln!(out, "format=\"ascii\">")?;
                array.values.write_text(out)?;
                writeln!(out, "</DataArray>")?;
                continue;
            }
            let at = if array.repeats { last } else { offset };
            writeln!(out, "format=\"appended\" offset=\"{at}\"/>")?;
            if !array.repeats {
                last = offset;
                offset += if packs {
                    packed.push(array.values.packed()?);
                    packed.last().map_or(0, Vec::len) as u64
                } else {
                    8 + array.values.byte_count()
                };
            }
        }
        writeln!(out, "</{}>", section.name)?;
    }
    writeln!(out, "</Piece>\n</{kind}>")?;
    if options.encoding == Encoding::Binary {
        write!(out, "<AppendedData encoding=\"raw\">\n_")?;
        let arrays = sections.iter().flat_map(|s| &s.arrays).filter(|a| !a.repeats);
        if packs {
            packed.iter().try_for_each(|bytes| out.write_all(bytes))?;
        } else {
            for array in arrays {
                out.write_all(&array.values.byte_count().to_ne_bytes())?;
                array.values.write_bytes(out)?;
            }
        }
        writeln!(out, "\n</AppendedData>")?;
    }
    writeln!(out, "</VTKFile>")
}

/// The frame as VTK writes strings: their letters' codes and a 0.
fn write_space(space: Space, out: &mut dyn Write) -> std::io::Result<()> {
    let Some(name) = super::space_name(space) else { return Ok(()) };
    let codes: Vec<String> = name.bytes().map(|b| b.to_string()).collect();
    writeln!(
        out,
        "<FieldData>\n<DataArray type=\"String\" Name=\"SPACE\" NumberOfComponents=\"1\" NumberOfTuples=\"1\" format=\"ascii\">\n{} 0\n\
         </DataArray>\n</FieldData>",
        codes.join(" ")
    )
}

fn escaped(name: &str) -> String {
    name.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
