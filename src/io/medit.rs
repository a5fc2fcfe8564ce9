//! MEDIT files: `.mesh` text and `.meshb` bytes.
//!
//! # Method
//! Keyword, count, rows with a reference number each; the label of an element, the patch of a triangle. The binary
//! form is a chain of the same blocks, each with the place of the next.
//!
//! # Source
//! [libMeshb].
//!
//! # Limits
//! Quadratic hexahedra have no keyword with 20 nodes and are refused. Unknown keywords are read past.

use std::io::Write;
use std::path::Path;

use glam::DVec3;

use super::file_mesh::{FileMesh, cell};
use super::text_scan::{TextScan, read_whole};
use super::voxel_stream::ByteOrder;
use super::{MeshFormat, Surfaces, WriteOptions, signs};
use crate::error::{Error, Result};
use crate::index::VertexId;
use crate::mesh::mixed_mesh::{ElementKind, MixedMesh};

/// A block of cells: keyword, its number in the binary form, VTK type, and for each file node its VTK node.
struct Block {
    keyword: &'static str,
    code: i32,
    vtk_type: u8,
    /// `order[i]` is the VTK node that stands at place `i` of a row.
    order: &'static [usize],
}

/// The wedge's triangles turn the other way round than VTK's.
const BLOCKS: [Block; 9] = [
    Block { keyword: "Triangles", code: 6, vtk_type: cell::TRIANGLE, order: &[0, 1, 2] },
    Block { keyword: "Quadrilaterals", code: 7, vtk_type: cell::QUAD, order: &[0, 1, 2, 3] },
    Block { keyword: "Tetrahedra", code: 8, vtk_type: 10, order: &[0, 1, 2, 3] },
    Block { keyword: "Pyramids", code: 49, vtk_type: 14, order: &[0, 1, 2, 3, 4] },
    Block { keyword: "Prisms", code: 9, vtk_type: 13, order: &[0, 2, 1, 3, 5, 4] },
    Block { keyword: "Hexahedra", code: 10, vtk_type: 12, order: &[0, 1, 2, 3, 4, 5, 6, 7] },
    Block { keyword: "TetrahedraP2", code: 30, vtk_type: 24, order: &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9] },
    Block { keyword: "TrianglesP2", code: 24, vtk_type: cell::QUADRATIC_TRIANGLE, order: &[0, 1, 2, 3, 4, 5] },
    Block { keyword: "Edges", code: 5, vtk_type: cell::LINE, order: &[0, 1] },
];
/// Binary number of `Dimension`.
const DIMENSION: i32 = 3;
/// Binary number of `Vertices`.
const VERTICES: i32 = 4;
/// Binary number of `End`.
const END: i32 = 54;

/// Reads a mesh or a surface.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] with the line or byte.
pub fn read(path: &Path) -> Result<FileMesh> {
    let bytes = read_whole(path)?;
    match bytes.get(..4) {
        Some([1, 0, 0, 0]) => Binary { bytes: &bytes, at: 4, order: ByteOrder::Little, version: 0, path }.read(),
        Some([0, 0, 0, 1]) => Binary { bytes: &bytes, at: 4, order: ByteOrder::Big, version: 0, path }.read(),
        _ => read_text(TextScan::new(bytes, path, b'#')),
    }
}

fn read_text(mut scan: TextScan) -> Result<FileMesh> {
    let first = scan.peek().unwrap_or_default();
    if !first.starts_with("MeshVersionFormatted") {
        return Err(scan.refuse("not a MEDIT file: it does not begin with MeshVersionFormatted"));
    }
    let mut mesh = FileMesh::new();
    let mut ended = false;
    // The block that was read last, for messages.
    let mut last = (String::new(), 0);
    while let Some(word) = scan.word().map(str::to_owned) {
        match word.as_str() {
            "MeshVersionFormatted" => {
                scan.integer()?;
            }
            "Dimension" => {
                let dimension = scan.integer()?;
                if dimension != 3 {
                    return Err(scan.refuse(format!("dimension {dimension}; three are needed")));
                }
            }
            "Vertices" => {
                let count = scan.count("vertices", 8)?;
                last = ("Vertices".to_owned(), count);
                for number in 0..count {
                    mesh.points.push(scan.point_of(number, count)?);
                    scan.integer()?;
                }
            }
            "End" => {
                ended = true;
                scan.expect_end(format!("{} vertices and {} elements", mesh.points.len(), mesh.types.len()))?;
            }
            keyword => match BLOCKS.iter().find(|b| b.keyword == keyword) {
                Some(block) => last = (keyword.to_owned(), read_cells(&mut scan, block, &mut mesh)?),
                None if keyword.starts_with(|c: char| c.is_ascii_alphabetic()) => skip_numbers(&mut scan),
                None => {
                    let text: String = keyword.chars().take(40).collect();
                    let (block, count) = last;
                    return Err(scan
                        .refuse(format!("'{text}' where a keyword should be: more than the {count} {block} claimed")));
                }
            },
        }
    }
    if !ended && mesh.types.is_empty() {
        return Err(scan.refuse("the file ends without elements"));
    }
    Ok(mesh)
}

/// Reads a block of cells; their number.
fn read_cells(scan: &mut TextScan, block: &Block, mesh: &mut FileMesh) -> Result<usize> {
    let count = scan.count(block.keyword, 2 * (block.order.len() + 1))?;
    let mut row = [0; 10];
    for number in 0..count {
        if scan.peek().is_none_or(|word| word.parse::<i64>().is_err()) {
            let text: String = scan.peek().unwrap_or_else(|| "the end of the file".into()).chars().take(40).collect();
            let keyword = block.keyword;
            return Err(scan.refuse(format!("'{text}' where row {number} should begin; {count} {keyword} are claimed")));
        }
        for &place in block.order {
            row[place] = scan.integer()? - 1;
        }
        let tag = scan.integer()? as i32;
        mesh.push(block.vtk_type, row[..block.order.len()].iter().copied(), tag);
    }
    Ok(count)
}

/// Goes to the next keyword.
fn skip_numbers(scan: &mut TextScan) {
    while scan.peek().is_some_and(|w| w.parse::<f64>().is_ok()) {
        scan.word();
    }
}

/// A binary file with a reading position.
struct Binary<'a> {
    bytes: &'a [u8],
    at: usize,
    order: ByteOrder,
    version: i32,
    path: &'a Path,
}

impl Binary<'_> {
    fn refuse(&self, reason: impl std::fmt::Display) -> Error {
        Error::format(self.path, format!("byte {}: {reason}", self.at))
    }

    fn raw<const N: usize>(&mut self) -> Result<[u8; N]> {
        let Some(slice) = self.bytes.get(self.at..self.at + N) else {
            return Err(self.refuse("the file ends in the middle of a block"));
        };
        let mut raw: [u8; N] = slice.try_into().expect("the slice has N bytes");
        self.at += N;
        if self.order == ByteOrder::Big {
            raw.reverse();
        }
        Ok(raw)
    }

    fn int(&mut self) -> Result<i64> {
        self.raw::<4>().map(|r| i64::from(i32::from_le_bytes(r)))
    }

    /// A node, reference or count: 4 bytes, from version 4 on 8.
    fn wide(&mut self) -> Result<i64> {
        if self.version >= 4 { self.raw::<8>().map(i64::from_le_bytes) } else { self.int() }
    }

    fn place(&mut self) -> Result<i64> {
        if self.version >= 3 { self.raw::<8>().map(i64::from_le_bytes) } else { self.int() }
    }

    fn real(&mut self) -> Result<f64> {
        if self.version == 1 {
            self.raw::<4>().map(|r| f64::from(f32::from_le_bytes(r)))
        } else {
            self.raw::<8>().map(f64::from_le_bytes)
        }
    }

    fn count(&mut self, row_bytes: usize) -> Result<usize> {
        let count = self.wide()?;
        let room = (self.bytes.len() - self.at) / row_bytes;
        match usize::try_from(count) {
            Ok(count) if count <= room => Ok(count),
            _ => Err(self.refuse(format!("{count} rows are claimed, {room} fit into the rest of the file"))),
        }
    }

    fn read(mut self) -> Result<FileMesh> {
        self.version = self.int()? as i32;
        if !(1..=4).contains(&self.version) {
            return Err(self.refuse(format!("version {}", self.version)));
        }
        let mut mesh = FileMesh::new();
        let word = if self.version >= 4 { 8 } else { 4 };
        loop {
            let code = self.int()? as i32;
            if code == END {
                // The place of a next block may be left out.
                self.at = self.bytes.len().min(self.at + if self.version >= 3 { 8 } else { 4 });
                return self.ended(mesh);
            }
            let next = self.place()?;
            let mut row_bytes = None;
            match code {
                DIMENSION => {
                    let dimension = self.int()?;
                    if dimension != 3 {
                        return Err(self.refuse(format!("dimension {dimension}; three are needed")));
                    }
                }
                VERTICES => {
                    let real = if self.version == 1 { 4 } else { 8 };
                    row_bytes = Some(3 * real + word);
                    for _ in 0..self.count(3 * real + word)? {
                        let point = DVec3::new(self.real()?, self.real()?, self.real()?);
                        mesh.points.push(point);
                        self.wide()?;
                    }
                }
                code => {
                    if let Some(block) = BLOCKS.iter().find(|b| b.code == code) {
                        row_bytes = Some((block.order.len() + 1) * word);
                        self.read_cells(block, word, &mut mesh)?;
                    }
                }
            }
            match usize::try_from(next) {
                Ok(0) if row_bytes.is_some() => return self.ended(mesh),
                Ok(0) => return Ok(mesh),
                // Less than a row may be padding.
                Ok(next) if row_bytes.is_some_and(|row| next >= self.at + row && next <= self.bytes.len()) => {
                    let (points, elements) = (mesh.points.len(), mesh.types.len());
                    let rest = next - self.at;
                    let text = format!("{rest} bytes more in a block than its rows take");
                    return Err(self.refuse(format!("{text}; {points} points and {elements} elements so far")));
                }
                // Each block lies behind the last, so the chain ends.
                Ok(next) if next >= self.at && next <= self.bytes.len() => self.at = next,
                _ => return Err(self.refuse(format!("the next block is said to be at byte {next}"))),
            }
        }
    }

    /// The mesh, where nothing but padding follows.
    fn ended(&self, mesh: FileMesh) -> Result<FileMesh> {
        let rest = &self.bytes[self.at..];
        if rest.iter().all(|&b| b == 0) {
            return Ok(mesh);
        }
        let (points, elements) = (mesh.points.len(), mesh.types.len());
        let claims = format!("{points} points and {elements} elements");
        Err(self.refuse(format!("{} bytes behind the end: more than the {claims} claimed", rest.len())))
    }

    fn read_cells(&mut self, block: &Block, word: usize, mesh: &mut FileMesh) -> Result<()> {
        let mut row = [0; 10];
        for _ in 0..self.count((block.order.len() + 1) * word)? {
            for &place in block.order {
                row[place] = self.wide()? - 1;
            }
            let tag = self.wide()? as i32;
            mesh.push(block.vtk_type, row[..block.order.len()].iter().copied(), tag);
        }
        Ok(())
    }
}

/// Elements of one kind with their block.
fn element_rows(mesh: &MixedMesh, vtk_type: u8) -> impl Iterator<Item = (&[VertexId], i32)> {
    (0..mesh.element_count()).filter(move |&i| mesh.types[i] == vtk_type).map(|i| (mesh.element(i).1, mesh.labels[i]))
}

/// The number that stands for a boundary face: its patch, else a number for its pair of labels.
pub(super) fn face_tags(mesh: &MixedMesh) -> Vec<i32> {
    if !mesh.boundary.patches.is_empty() {
        return mesh.boundary.patches.clone();
    }
    let pairs = super::label_pairs(mesh);
    mesh.boundary
        .labels
        .iter()
        .map(|pair| pairs.binary_search(pair).map_or(0, |position| position as i32 + 1))
        .collect()
}

/// Writes a mesh, text or bytes as the format says.
///
/// # Errors
/// Those of the writer; quadratic hexahedra.
pub fn write(mesh: &MixedMesh, format: MeshFormat, options: &WriteOptions, out: &mut dyn Write) -> std::io::Result<()> {
    if mesh.types.contains(&ElementKind::QuadraticHexahedron.vtk_type()) {
        return Err(std::io::Error::other("MEDIT has no hexahedra of 20 nodes"));
    }
    let tags = if options.surfaces == Surfaces::Include { face_tags(mesh) } else { Vec::new() };
    let mut writer: Box<dyn Blocks> = if format == MeshFormat::MeditBinary {
        Box::new(BinaryBlocks { out, at: 0 })
    } else {
        Box::new(TextBlocks { out })
    };
    writer.begin()?;
    writer.vertices(&mesh.points, signs(mesh.space, options))?;
    for block in &BLOCKS {
        let rows: Box<dyn Iterator<Item = (&[VertexId], i32)>> = match block.vtk_type {
            cell::TRIANGLE => Box::new(mesh.boundary.triangles.iter().zip(&tags).map(|(t, tag)| (&t[..], *tag))),
            cell::QUAD => {
                let quad_tags = tags.iter().skip(mesh.boundary.triangles.len());
                Box::new(mesh.boundary.quads.iter().zip(quad_tags).map(|(q, tag)| (&q[..], *tag)))
            }
            kind => Box::new(element_rows(mesh, kind)),
        };
        let count = match block.vtk_type {
            cell::TRIANGLE => mesh.boundary.triangles.len().min(tags.len()),
            cell::QUAD => mesh.boundary.quads.len().min(tags.len()),
            kind => mesh.types.iter().filter(|&&t| t == kind).count(),
        };
        if count > 0 {
            writer.cells(block, count, rows)?;
        }
    }
    writer.end()
}

type Rows<'r> = Box<dyn Iterator<Item = (&'r [VertexId], i32)> + 'r>;

/// The two encodings.
trait Blocks {
    fn begin(&mut self) -> std::io::Result<()>;
    fn vertices(&mut self, points: &[DVec3], signs: DVec3) -> std::io::Result<()>;
    fn cells(&mut self, block: &Block, count: usize, rows: Rows) -> std::io::Result<()>;
    fn end(&mut self) -> std::io::Result<()>;
}

struct TextBlocks<'a> {
    out: &'a mut dyn Write,
}

impl Blocks for TextBlocks<'_> {
    fn begin(&mut self) -> std::io::Result<()> {
        writeln!(self.out, "MeshVersionFormatted 2\nDimension 3\n")
    }

    fn vertices(&mut self, points: &[DVec3], signs: DVec3) -> std::io::Result<()> {
        writeln!(self.out, "Vertices\n{}", points.len())?;
        points.iter().try_for_each(|&p| {
            let p = p * signs;
            writeln!(self.out, "{} {} {} 0", p.x, p.y, p.z)
        })
    }

    fn cells(&mut self, block: &Block, count: usize, rows: Rows) -> std::io::Result<()> {
        writeln!(self.out, "\n{}\n{count}", block.keyword)?;
        for (nodes, tag) in rows {
            block.order.iter().try_for_each(|&place| write!(self.out, "{} ", nodes[place].0 + 1))?;
            writeln!(self.out, "{tag}")?;
        }
        Ok(())
    }

    fn end(&mut self) -> std::io::Result<()> {
        writeln!(self.out, "\nEnd")
    }
}

/// Version 3: 32-bit numbers, double precision, 64-bit places.
struct BinaryBlocks<'a> {
    out: &'a mut dyn Write,
    at: u64,
}

impl BinaryBlocks<'_> {
    fn ints(&mut self, values: &[i32]) -> std::io::Result<()> {
        self.at += 4 * values.len() as u64;
        values.iter().try_for_each(|v| self.out.write_all(&v.to_ne_bytes()))
    }

    /// Keyword and the place of the next block, which begins `bytes` behind this head.
    fn head(&mut self, code: i32, bytes: u64) -> std::io::Result<()> {
        self.ints(&[code])?;
        self.at += 8;
        let next = (self.at + bytes) as i64;
        self.out.write_all(&next.to_ne_bytes())
    }
}

impl Blocks for BinaryBlocks<'_> {
    fn begin(&mut self) -> std::io::Result<()> {
        self.ints(&[1, 3])?;
        self.head(DIMENSION, 4)?;
        self.ints(&[3])
    }

    fn vertices(&mut self, points: &[DVec3], signs: DVec3) -> std::io::Result<()> {
        self.head(VERTICES, 4 + 28 * points.len() as u64)?;
        self.ints(&[points.len() as i32])?;
        for &point in points {
            self.out.write_all(bytemuck::bytes_of(&(point * signs)))?;
            self.at += 24;
            self.ints(&[0])?;
        }
        Ok(())
    }

    fn cells(&mut self, block: &Block, count: usize, rows: Rows) -> std::io::Result<()> {
        self.head(block.code, 4 + (4 * (block.order.len() as u64 + 1)) * count as u64)?;
        self.ints(&[count as i32])?;
        let mut row = [0; 11];
        for (nodes, tag) in rows {
            for (i, &place) in block.order.iter().enumerate() {
                row[i] = nodes[place].0 as i32 + 1;
            }
            row[block.order.len()] = tag;
            self.ints(&row[..=block.order.len()])?;
        }
        Ok(())
    }

    fn end(&mut self) -> std::io::Result<()> {
        self.ints(&[END])?;
        self.out.write_all(&0i64.to_ne_bytes())
    }
}
