//! Reads VTK XML files: `.vtu` and `.vtp`, every encoding that VTK writes.
//!
//! # Method
//! The appended block is no XML; it is cut off behind its `_` and the head parsed alone (crate `roxmltree`). Arrays are
//! text, base64 or appended; plain or in zlib blocks. All pieces are joined.
//!
//! # Source
//! [VTKFileFormats].

use std::io::Read;
use std::path::Path;

use flate2::read::ZlibDecoder;
use glam::DVec3;
use roxmltree::Node;

use super::file_mesh::{FileMesh, cell};
use super::text_scan::read_whole;
use super::voxel_stream::ByteOrder;
use crate::error::{Error, Result};
use crate::mesh::mixed_mesh::{ArrayData, NamedArray};

/// Reads a mesh or a surface.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`].
pub fn read(path: &Path) -> Result<FileMesh> {
    let bytes = read_whole(path)?;
    let (head, appended) = split_appended(&bytes);
    let text = std::str::from_utf8(&head).map_err(|_| Error::format(path, "the XML head is not text"))?;
    let document =
        roxmltree::Document::parse(text).map_err(|e| Error::format(path, format!("the file is no VTK XML: {e}")))?;
    let root = document.root_element();
    if !root.has_tag_name("VTKFile") {
        return Err(Error::format(
            path,
            format!("the file is no VTK XML: it begins with <{}>", root.tag_name().name()),
        ));
    }
    let file = File::new(root, appended, path)?;
    let kind = root.attribute("type").unwrap_or("");
    let Some(grid) = child(root, kind).filter(|_| kind == "UnstructuredGrid" || kind == "PolyData") else {
        return Err(file.refuse(format!("a VTK file of type '{kind}'; UnstructuredGrid and PolyData are read")));
    };
    let mut mesh = FileMesh::new();
    if let Some(space) = child(grid, "FieldData").and_then(|f| file.space_name(f)) {
        mesh.space = FileMesh::space_of_name(&space);
    }
    let pieces: Vec<Node> = grid.children().filter(|n| n.has_tag_name("Piece")).collect();
    for piece in &pieces {
        file.read_piece(*piece, &mut mesh)?;
    }
    if pieces.len() > 1 {
        // Arrays of several pieces would have to agree; the labels are what counts.
        mesh.point_data.clear();
    }
    mesh.adopt_tags();
    if pieces.len() > 1 {
        mesh.cell_data.clear();
    }
    Ok(mesh)
}

/// The head as complete XML, and the appended bytes with whether they are base64.
fn split_appended(bytes: &[u8]) -> (Vec<u8>, Option<(&[u8], bool)>) {
    let tag = b"<AppendedData";
    let Some(begin) = find(bytes, tag, 0) else { return (bytes.to_vec(), None) };
    let Some(end) = find(bytes, b">", begin) else { return (bytes.to_vec(), None) };
    let base64 = find(&bytes[begin..end], b"base64", 0).is_some();
    let data = find(bytes, b"_", end).map_or(&bytes[bytes.len()..], |at| &bytes[at + 1..]);
    let mut head = bytes[..begin].to_vec();
    head.extend_from_slice(b"</VTKFile>");
    (head, Some((data, base64)))
}

fn find(bytes: &[u8], pattern: &[u8], from: usize) -> Option<usize> {
    bytes[from..].windows(pattern.len()).position(|w| w == pattern).map(|at| at + from)
}

fn child<'a, 'd>(node: Node<'a, 'd>, name: &str) -> Option<Node<'a, 'd>> {
    node.children().find(|n| n.has_tag_name(name))
}

/// What holds for all arrays of a file.
struct File<'a> {
    appended: Option<(&'a [u8], bool)>,
    order: ByteOrder,
    wide_header: bool,
    packed: bool,
    path: &'a Path,
}

impl<'a> File<'a> {
    fn new(root: Node, appended: Option<(&'a [u8], bool)>, path: &'a Path) -> Result<Self> {
        let packed = match root.attribute("compressor") {
            None | Some("") => false,
            Some("vtkZLibDataCompressor") => true,
            Some(other) => return Err(Error::format(path, format!("compressor {other}; zlib is read"))),
        };
        let order = if root.attribute("byte_order") == Some("BigEndian") { ByteOrder::Big } else { ByteOrder::Little };
        Ok(Self { appended, order, wide_header: root.attribute("header_type") == Some("UInt64"), packed, path })
    }

    fn refuse(&self, reason: impl Into<String>) -> Error {
        Error::format(self.path, reason)
    }

    fn space_name(&self, fields: Node) -> Option<String> {
        let array = fields.children().find(|n| n.attribute("Name") == Some("SPACE"))?;
        let data = self.values(array).ok()?;
        let codes: Vec<u8> = match data {
            ArrayData::Long(values) => values.iter().map(|&v| v as u8).collect(),
            _ => return None,
        };
        Some(String::from_utf8_lossy(&codes).trim_end_matches('\0').to_owned())
    }

    fn count(&self, piece: Node, name: &str) -> Result<usize> {
        match piece.attribute(name) {
            None => Ok(0),
            Some(text) => text.trim().parse().map_err(|_| self.refuse(format!("{name} '{text}'"))),
        }
    }

    fn read_piece(&self, piece: Node, mesh: &mut FileMesh) -> Result<()> {
        let base = mesh.points.len() as i64;
        let count = self.count(piece, "NumberOfPoints")?;
        let array = child(piece, "Points").and_then(|p| child(p, "DataArray"));
        let Some(array) = array else { return Err(self.refuse("a piece without points")) };
        let values = self.reals(array)?;
        if values.len() != 3 * count {
            return Err(self.refuse(format!("{} coordinates for {count} points", values.len())));
        }
        mesh.points.extend(values.chunks_exact(3).map(DVec3::from_slice));
        let first_cell = mesh.types.len();
        if let Some(cells) = child(piece, "Cells") {
            self.read_cells(cells, None, base, mesh)?;
            if piece.attribute("NumberOfCells").is_some() {
                self.compare_count(piece, "NumberOfCells", mesh.types.len() - first_cell)?;
            }
        }
        for (name, kind) in
            [("Verts", 0), ("Lines", cell::LINE), ("Strips", cell::TRIANGLE_STRIP), ("Polys", cell::POLYGON)]
        {
            if let Some(cells) = child(piece, name)
                && self.count(piece, &format!("NumberOf{name}"))? > 0
            {
                let before = mesh.types.len();
                self.read_cells(cells, Some(kind), base, mesh)?;
                self.compare_count(piece, &format!("NumberOf{name}"), mesh.types.len() - before)?;
            }
        }
        if let Some(data) = child(piece, "PointData") {
            self.read_arrays(data, mesh.points.len() - base as usize, &mut mesh.point_data)?;
        }
        if let Some(data) = child(piece, "CellData") {
            let cells = mesh.types.len() - first_cell;
            self.read_arrays(data, cells, &mut mesh.cell_data)?;
        }
        Ok(())
    }

    /// A count that is not what the arrays hold is a sign of a damaged file.
    fn compare_count(&self, piece: Node, name: &str, found: usize) -> Result<()> {
        let claimed = self.count(piece, name)?;
        if claimed == found {
            return Ok(());
        }
        Err(self.refuse(format!("{name} is {claimed}, but there are {found}")))
    }

    /// Cells of a piece; `kind` for poly data, whose section says it.
    fn read_cells(&self, cells: Node, kind: Option<u8>, base: i64, mesh: &mut FileMesh) -> Result<()> {
        let array = |name: &str| {
            cells
                .children()
                .find(|n| n.attribute("Name") == Some(name))
                .ok_or_else(|| self.refuse(format!("cells without {name}")))
                .and_then(|n| self.integers(n))
        };
        let (connectivity, offsets) = (array("connectivity")?, array("offsets")?);
        let types = if kind.is_none() { array("types")? } else { Vec::new() };
        if kind.is_none() && types.len() != offsets.len() {
            return Err(self.refuse(format!("{} types for {} cells", types.len(), offsets.len())));
        }
        let mut begin = 0usize;
        for (i, &end) in offsets.iter().enumerate() {
            let nodes = usize::try_from(end).ok().and_then(|end| connectivity.get(begin..end));
            let Some(nodes) = nodes else {
                return Err(self.refuse(format!("cell {i} ends at entry {end} of {}", connectivity.len())));
            };
            let kind = match kind {
                Some(cell::POLYGON) if nodes.len() == 3 => cell::TRIANGLE,
                Some(kind) => kind,
                None => types[i] as u8,
            };
            mesh.push(kind, nodes.iter().map(|n| n + base), 0);
            begin += nodes.len();
        }
        Ok(())
    }

    fn read_arrays(&self, section: Node, rows: usize, arrays: &mut Vec<NamedArray>) -> Result<()> {
        for node in section.children().filter(|n| n.has_tag_name("DataArray")) {
            let name = node.attribute("Name").unwrap_or("").to_owned();
            let components = node.attribute("NumberOfComponents").and_then(|c| c.parse().ok()).unwrap_or(1usize).max(1);
            let data = self.values(node)?;
            if data.len() != rows * components {
                return Err(self.refuse(format!("array '{name}' has {} values for {rows} rows", data.len())));
            }
            match (arrays.iter_mut().find(|a| a.name == name), data) {
                (None, data) => arrays.push(NamedArray { name, components, data }),
                (Some(NamedArray { data: ArrayData::Long(all), .. }), ArrayData::Long(more)) => all.extend(more),
                (Some(NamedArray { data: ArrayData::Real(all), .. }), ArrayData::Real(more)) => all.extend(more),
                (Some(_), _) => {}
            }
        }
        Ok(())
    }

    fn reals(&self, node: Node) -> Result<Vec<f64>> {
        Ok(match self.values(node)? {
            ArrayData::Real(values) => values,
            ArrayData::Long(values) => values.into_iter().map(|v| v as f64).collect(),
            ArrayData::Int(values) => values.into_iter().map(f64::from).collect(),
        })
    }

    fn integers(&self, node: Node) -> Result<Vec<i64>> {
        match self.values(node)? {
            ArrayData::Long(values) => Ok(values),
            _ => Err(self.refuse(format!("array '{}' is not whole numbers", node.attribute("Name").unwrap_or("")))),
        }
    }

    /// The values of an array: whole numbers as `Long`, others as `Real`.
    fn values(&self, node: Node) -> Result<ArrayData> {
        let kind = node.attribute("type").unwrap_or("");
        let whole = !kind.starts_with("Float");
        let text = node.text().unwrap_or("");
        if node.attribute("format") == Some("ascii") {
            let words = text.split_ascii_whitespace();
            let bad =
                |word: &str| self.refuse(format!("'{}' in array '{}'", word, node.attribute("Name").unwrap_or("")));
            return if whole {
                words.map(|w| w.parse::<i64>().map_err(|_| bad(w))).collect::<Result<_>>().map(ArrayData::Long)
            } else {
                words.map(|w| w.parse::<f64>().map_err(|_| bad(w))).collect::<Result<_>>().map(ArrayData::Real)
            };
        }
        let bytes = if node.attribute("format") == Some("appended") {
            let offset: usize = node
                .attribute("offset")
                .and_then(|o| o.trim().parse().ok())
                .ok_or_else(|| self.refuse("an appended array without offset"))?;
            let Some((data, base64)) = self.appended else { return Err(self.refuse("no appended data")) };
            let data =
                data.get(offset..).ok_or_else(|| self.refuse(format!("offset {offset} lies behind the file")))?;
            self.decode(data, base64)?
        } else {
            self.decode(text.trim().as_bytes(), true)?
        };
        self.numbers(kind, &bytes)
    }

    fn numbers(&self, kind: &str, bytes: &[u8]) -> Result<ArrayData> {
        macro_rules! convert {
            ($type:ty, $variant:ident, $target:ty) => {
                ArrayData::$variant(
                    bytes
                        .chunks_exact(size_of::<$type>())
                        .map(|c| {
                            let raw = c.try_into().expect("chunks have the type's size");
                            (match self.order {
                                ByteOrder::Little => <$type>::from_le_bytes(raw),
                                ByteOrder::Big => <$type>::from_be_bytes(raw),
                            }) as $target
                        })
                        .collect(),
                )
            };
        }
        Ok(match kind {
            "Int8" => convert!(i8, Long, i64),
            "UInt8" | "String" => convert!(u8, Long, i64),
            "Int16" => convert!(i16, Long, i64),
            "UInt16" => convert!(u16, Long, i64),
            "Int32" => convert!(i32, Long, i64),
            "UInt32" => convert!(u32, Long, i64),
            "Int64" => convert!(i64, Long, i64),
            "UInt64" => convert!(u64, Long, i64),
            "Float32" => convert!(f32, Real, f64),
            "Float64" => convert!(f64, Real, f64),
            _ => return Err(self.refuse(format!("array type '{kind}'"))),
        })
    }

    fn header_word(&self, bytes: &[u8], index: usize) -> Result<usize> {
        let width = if self.wide_header { 8 } else { 4 };
        let raw = bytes.get(index * width..(index + 1) * width);
        let Some(raw) = raw else { return Err(self.refuse("the file ends in the head of an array")) };
        let mut word = [0u8; 8];
        word[..width].copy_from_slice(raw);
        if self.order == ByteOrder::Big {
            word[..width].reverse();
        }
        Ok(u64::from_le_bytes(word) as usize)
    }

    /// The plain bytes of an array behind its size head.
    fn decode(&self, data: &[u8], base64: bool) -> Result<Vec<u8>> {
        let width = if self.wide_header { 8 } else { 4 };
        let truncated = || self.refuse("the file ends in the middle of an array");
        if !self.packed {
            if base64 {
                let bytes = decode_base64(data, usize::MAX);
                let size = self.header_word(&bytes, 0)?;
                return bytes.get(width..).and_then(|b| b.get(..size)).map(<[u8]>::to_vec).ok_or_else(truncated);
            }
            let size = self.header_word(data, 0)?;
            return data.get(width..).and_then(|b| b.get(..size)).map(<[u8]>::to_vec).ok_or_else(truncated);
        }
        // In base64 the size table and the blocks are two separate runs of letters.
        let letters = |bytes: usize| bytes.div_ceil(3) * 4;
        let start = if base64 { decode_base64(data, width) } else { data.to_vec_prefix(width) };
        let blocks = self.header_word(&start, 0)?;
        if blocks > data.len() {
            return Err(truncated());
        }
        let table_bytes = (3 + blocks) * width;
        let table = if base64 { decode_base64(data, table_bytes) } else { data.to_vec_prefix(table_bytes) };
        let body_owned;
        let body = if base64 {
            body_owned = decode_base64(data.get(letters(table_bytes)..).unwrap_or(&[]), usize::MAX);
            &body_owned[..]
        } else {
            data.get(table_bytes..).ok_or_else(truncated)?
        };
        let mut plain = Vec::new();
        let mut at = 0usize;
        for block in 0..blocks {
            let size = self.header_word(&table, 3 + block)?;
            let packed = body.get(at..).and_then(|b| b.get(..size)).ok_or_else(truncated)?;
            ZlibDecoder::new(packed)
                .read_to_end(&mut plain)
                .map_err(|e| self.refuse(format!("block {block} of an array: {e}")))?;
            at += size;
        }
        Ok(plain)
    }
}

/// The first bytes of a slice, as many as there are.
trait Prefix {
    fn to_vec_prefix(&self, length: usize) -> Vec<u8>;
}

impl Prefix for [u8] {
    fn to_vec_prefix(&self, length: usize) -> Vec<u8> {
        self[..length.min(self.len())].to_vec()
    }
}

/// Decodes base64 until `limit` bytes are there, the letters end, or a padded group ends the run.
fn decode_base64(letters: &[u8], limit: usize) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(limit.min(letters.len() / 4 * 3 + 3));
    let mut group = [0u32; 4];
    let mut filled = 0;
    let mut padding = 0;
    for &letter in letters {
        let value = match letter {
            b'A'..=b'Z' => letter - b'A',
            b'a'..=b'z' => letter - b'a' + 26,
            b'0'..=b'9' => letter - b'0' + 52,
            b'+' => 62,
            b'/' => 63,
            b'=' => {
                padding += 1;
                0
            }
            b' ' | b'\n' | b'\r' | b'\t' => continue,
            _ => break,
        };
        group[filled] = u32::from(value);
        filled += 1;
        if filled == 4 {
            let word = group[0] << 18 | group[1] << 12 | group[2] << 6 | group[3];
            bytes.extend_from_slice(&[(word >> 16) as u8, (word >> 8) as u8, word as u8][..3 - padding.min(2)]);
            filled = 0;
            // A padded group ends one run; a size head may be one of its own, with the data behind it.
            if bytes.len() >= limit {
                break;
            }
            padding = 0;
        }
    }
    bytes
}
