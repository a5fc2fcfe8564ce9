//! Writes legacy `.vtk` files, versions 4.2 and 5.1: meshes and surfaces.
//!
//! # Method
//! The title line carries `SPACE=LPS` or `SPACE=RAS`, where 3D Slicer looks for the frame. Bytes are big-endian.
//! Version 4.2 is what OpenFOAM and older programs read, 5.1 what VTK 9 writes.
//!
//! # Source
//! [VTKFileFormats].

use std::io::Write;

use glam::DVec3;

use super::surface_export::SurfaceExport;
use super::{Encoding, MeshFormat, WriteOptions, signs};
use crate::mesh::mixed_mesh::{ArrayData, MixedMesh, NamedArray, Space};

/// Values converted at a time.
const CHUNK: usize = 8192;

/// The output with what holds for all of it.
struct Legacy<'a> {
    out: &'a mut dyn Write,
    text: bool,
}

/// Writes a mesh.
///
/// # Errors
/// Those of the writer; more than 2^31 entries in version 4.2.
pub fn write_mesh(
    mesh: &MixedMesh,
    version: MeshFormat,
    options: &WriteOptions,
    out: &mut dyn Write,
) -> std::io::Result<()> {
    let mut legacy = Legacy { out, text: options.encoding == Encoding::Ascii };
    legacy.head(version, options.space.unwrap_or(mesh.space), "UNSTRUCTURED_GRID")?;
    legacy.points(&mesh.points, signs(mesh.space, options))?;
    let cells = mesh.element_count();
    let ids: &[i32] = bytemuck::cast_slice(&mesh.connectivity);
    if version == MeshFormat::Vtk51 {
        writeln!(legacy.out, "CELLS {} {}\nOFFSETS vtktypeint64", cells + 1, ids.len())?;
        legacy.longs(&mesh.offsets)?;
        writeln!(legacy.out, "CONNECTIVITY vtktypeint64")?;
        let wide: Vec<i64> = ids.iter().map(|&v| i64::from(v)).collect();
        legacy.longs(&wide)?;
    } else {
        let rows = mesh.offsets.windows(2).map(|w| &ids[w[0] as usize..w[1] as usize]);
        legacy.counted_rows("CELLS", cells, ids.len(), rows)?;
    }
    writeln!(legacy.out, "CELL_TYPES {cells}")?;
    let types: Vec<i32> = mesh.types.iter().map(|&t| i32::from(t)).collect();
    legacy.ints(&types)?;
    let labels =
        |name: &str| NamedArray { name: name.into(), components: 1, data: ArrayData::Int(mesh.labels.clone()) };
    let own = [labels("label"), labels("labels")];
    legacy.arrays("CELL_DATA", cells, own.iter().chain(&mesh.element_data))?;
    legacy.arrays("POINT_DATA", mesh.points.len(), mesh.point_data.iter())
}

/// Writes a surface.
///
/// # Errors
/// Those of the writer.
pub fn write_surface(
    export: &SurfaceExport,
    version: MeshFormat,
    options: &WriteOptions,
    out: &mut dyn Write,
) -> std::io::Result<()> {
    let mut legacy = Legacy { out, text: options.encoding == Encoding::Ascii };
    let surface = &export.surface;
    legacy.head(version, options.space.unwrap_or(export.space), "POLYDATA")?;
    legacy.points(&surface.points, signs(export.space, options))?;
    let ids: &[i32] = bytemuck::cast_slice(&surface.facets);
    let faces = surface.facets.len();
    if version == MeshFormat::Vtk51 {
        writeln!(legacy.out, "POLYGONS {} {}\nOFFSETS vtktypeint64", faces + 1, ids.len())?;
        let offsets: Vec<i64> = (0..=faces as i64).map(|i| 3 * i).collect();
        legacy.longs(&offsets)?;
        writeln!(legacy.out, "CONNECTIVITY vtktypeint64")?;
        let wide: Vec<i64> = ids.iter().map(|&v| i64::from(v)).collect();
        legacy.longs(&wide)?;
    } else {
        legacy.counted_rows("POLYGONS", faces, ids.len(), ids.chunks(3))?;
    }
    let patch = NamedArray { name: "patch".into(), components: 1, data: ArrayData::Int(surface.facet_patches.clone()) };
    legacy.arrays("CELL_DATA", faces, std::iter::once(&patch).chain(&export.arrays))
}

impl Legacy<'_> {
    fn head(&mut self, version: MeshFormat, space: Space, dataset: &str) -> std::io::Result<()> {
        let number = if version == MeshFormat::Vtk51 { "5.1" } else { "4.2" };
        let space = super::space_name(space).map_or(String::new(), |name| format!(" SPACE={name}"));
        let encoding = if self.text { "ASCII" } else { "BINARY" };
        writeln!(self.out, "# vtk DataFile Version {number}\nMeshwright{space}\n{encoding}\nDATASET {dataset}")
    }

    fn points(&mut self, points: &[DVec3], signs: DVec3) -> std::io::Result<()> {
        writeln!(self.out, "POINTS {} double", points.len())?;
        for chunk in points.chunks(CHUNK) {
            let turned: Vec<f64> = chunk.iter().flat_map(|&p| (p * signs).to_array()).collect();
            self.reals(&turned)?;
        }
        if self.text { Ok(()) } else { writeln!(self.out) }
    }

    /// Rows as `length entries...`, the way of version 4.2.
    fn counted_rows<'b>(
        &mut self,
        keyword: &str,
        rows: usize,
        entries: usize,
        cells: impl Iterator<Item = &'b [i32]>,
    ) -> std::io::Result<()> {
        let total = rows + entries;
        if total > i32::MAX as usize {
            return Err(std::io::Error::other("too many cells for version 4.2; version 5.1 holds them"));
        }
        writeln!(self.out, "{keyword} {rows} {total}")?;
        let mut buffer: Vec<i32> = Vec::with_capacity(CHUNK + 32);
        for row in cells {
            if self.text {
                write!(self.out, "{}", row.len())?;
                row.iter().try_for_each(|v| write!(self.out, " {v}"))?;
                writeln!(self.out)?;
                continue;
            }
            buffer.push(row.len() as i32);
            buffer.extend_from_slice(row);
            if buffer.len() >= CHUNK {
                self.int_bytes(&buffer)?;
                buffer.clear();
            }
        }
        if self.text {
            return Ok(());
        }
        self.int_bytes(&buffer)?;
        writeln!(self.out)
    }

    fn int_bytes(&mut self, values: &[i32]) -> std::io::Result<()> {
        let bytes: Vec<[u8; 4]> = values.iter().map(|v| v.to_be_bytes()).collect();
        self.out.write_all(bytes.as_flattened())
    }

    fn ints(&mut self, values: &[i32]) -> std::io::Result<()> {
        for chunk in values.chunks(CHUNK) {
            if self.text { self.words(chunk)? } else { self.int_bytes(chunk)? }
        }
        if self.text { Ok(()) } else { writeln!(self.out) }
    }

    fn longs(&mut self, values: &[i64]) -> std::io::Result<()> {
        for chunk in values.chunks(CHUNK) {
            if self.text {
                self.words(chunk)?;
                continue;
            }
            let bytes: Vec<[u8; 8]> = chunk.iter().map(|v| v.to_be_bytes()).collect();
            self.out.write_all(bytes.as_flattened())?;
        }
        if self.text { Ok(()) } else { writeln!(self.out) }
    }

    fn reals(&mut self, values: &[f64]) -> std::io::Result<()> {
        for chunk in values.chunks(CHUNK) {
            if self.text {
                self.words(chunk)?;
                continue;
            }
            let bytes: Vec<[u8; 8]> = chunk.iter().map(|v| v.to_be_bytes()).collect();
            self.out.write_all(bytes.as_flattened())?;
        }
        Ok(())
    }

    fn words<T: std::fmt::Display>(&mut self, values: &[T]) -> std::io::Result<()> {
        for row in values.chunks(9) {
            row.iter().try_for_each(|v| write!(self.out, "{v} "))?;
            writeln!(self.out)?;
        }
        Ok(())
    }

    fn arrays<'b>(
        &mut self,
        keyword: &str,
        rows: usize,
        arrays: impl Iterator<Item = &'b NamedArray>,
    ) -> std::io::Result<()> {
        let arrays: Vec<&NamedArray> = arrays.collect();
        if arrays.is_empty() {
            return Ok(());
        }
        writeln!(self.out, "{keyword} {rows}\nFIELD FieldData {}", arrays.len())?;
        for array in arrays {
            let kind = match &array.data {
                ArrayData::Int(_) => "int",
                ArrayData::Long(_) => "vtktypeint64",
                ArrayData::Real(_) => "double",
            };
            // Names end at white space in this format.
            let name = array.name.replace(char::is_whitespace, "_");
            writeln!(self.out, "{name} {} {rows} {kind}", array.components)?;
            match &array.data {
                ArrayData::Int(values) => self.ints(values)?,
                ArrayData::Long(values) => self.longs(values)?,
                ArrayData::Real(values) => {
                    self.reals(values)?;
                    if !self.text {
                        writeln!(self.out)?;
                    }
                }
            }
        }
        Ok(())
    }
}
