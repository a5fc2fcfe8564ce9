//! Reads legacy `.vtk` files up to version 5.1: unstructured grids and poly data, text and bytes.
//!
//! # Method
//! Keyword by keyword; bytes are big-endian. Cells come as rows with their length (up to 4.2) or as offsets and
//! connectivity (from 5.0).
//!
//! # Source
//! [VTKFileFormats].

use std::path::Path;

use glam::DVec3;

use super::file_mesh::{FileMesh, cell};
use super::text_scan::TextScan;
use crate::error::{Error, Result};
use crate::mesh::mixed_mesh::{ArrayData, NamedArray};

struct Legacy {
    scan: TextScan,
    text: bool,
    new_cells: bool,
    mesh: FileMesh,
    types: Vec<i64>,
    grid: bool,
    /// The counts of the section that is read, for messages.
    claims: String,
}

/// What an attribute section stands for.
#[derive(Clone, Copy, PartialEq)]
enum Rows {
    None,
    Points(usize),
    Cells(usize),
}

/// Reads a mesh or a surface.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] with the line.
pub fn read(path: &Path) -> Result<FileMesh> {
    let mut scan = TextScan::open(path, 0)?;
    let first = scan.line().unwrap_or("").to_owned();
    let Some(version) = first.strip_prefix("# vtk DataFile Version ") else {
        return Err(scan.refuse("not a legacy VTK file: it does not begin with '# vtk DataFile Version'"));
    };
    let major: u32 = version.trim().split('.').next().and_then(|v| v.parse().ok()).unwrap_or(0);
    let title = scan.line().unwrap_or("").to_owned();
    let mut mesh = FileMesh::new();
    if let Some((_, after)) = title.split_once("SPACE=") {
        mesh.space = FileMesh::space_of_name(after.split_whitespace().next().unwrap_or(""));
    }
    let text = match scan.word().map(str::to_uppercase).as_deref() {
        Some("ASCII") => true,
        Some("BINARY") => false,
        _ => return Err(scan.refuse("neither ASCII nor BINARY")),
    };
    if scan.word().map(str::to_uppercase).as_deref() != Some("DATASET") {
        return Err(scan.refuse("no DATASET"));
    }
    let kind = scan.word().unwrap_or("").to_uppercase();
    if kind != "UNSTRUCTURED_GRID" && kind != "POLYDATA" {
        return Err(scan.refuse(format!("a data set of kind {kind}; UNSTRUCTURED_GRID and POLYDATA are read")));
    }
    let grid = kind == "UNSTRUCTURED_GRID";
    let mut legacy = Legacy { scan, text, new_cells: major >= 5, mesh, types: Vec::new(), grid, claims: String::new() };
    legacy.read_body()?;
    let mut mesh = legacy.finish()?;
    mesh.adopt_tags();
    Ok(mesh)
}

impl Legacy {
    fn read_body(&mut self) -> Result<()> {
        let mut rows = Rows::None;
        while let Some(word) = self.scan.word().map(str::to_uppercase) {
            match word.as_str() {
                "POINTS" => self.read_points()?,
                "CELLS" => self.read_cells(cell::POLYGON)?,
                "CELL_TYPES" => {
                    let count = self.scan.count("cell types", if self.text { 2 } else { 4 })?;
                    self.claims = format!("{count} cell types");
                    self.types = self.integers("int", count)?;
                }
                "VERTICES" => self.read_cells(0)?,
                "LINES" => self.read_cells(cell::LINE)?,
                "POLYGONS" => self.read_cells(cell::POLYGON)?,
                "TRIANGLE_STRIPS" => self.read_cells(cell::TRIANGLE_STRIP)?,
                "POINT_DATA" | "CELL_DATA" => {
                    let count = self.scan.count("rows of data", 0)?;
                    self.claims = format!("{count} rows of data");
                    rows = if word == "POINT_DATA" { Rows::Points(count) } else { Rows::Cells(count) };
                }
                "METADATA" => self.skip_metadata(),
                _ => self.read_attribute(&word, rows)?,
            }
        }
        Ok(())
    }

    fn read_points(&mut self) -> Result<()> {
        let count = self.scan.count("points", 6)?;
        self.claims = format!("{count} points");
        let kind = self.word("the type of the points")?;
        let values = self.reals(&kind, 3 * count)?;
        self.mesh.points = values.chunks_exact(3).map(DVec3::from_slice).collect();
        Ok(())
    }

    fn word(&mut self, what: &str) -> Result<String> {
        match self.scan.word() {
            Some(word) => Ok(word.to_lowercase()),
            None => Err(self.scan.refuse(format!("the file ends where {what} should be"))),
        }
    }

    fn read_cells(&mut self, kind: u8) -> Result<()> {
        let rows = self.scan.count("cells", 1)?;
        let entries = self.scan.count("cell entries", 1)?;
        self.claims = format!("{rows} cells with {entries} entries");
        if self.new_cells {
            if rows == 0 {
                return Ok(());
            }
            self.scan.word();
            let width = self.word("the type of the offsets")?;
            let offsets = self.integers(&width, rows)?;
            self.scan.word();
            let width = self.word("the type of the connectivity")?;
            let connectivity = self.integers(&width, entries)?;
            for (i, pair) in offsets.windows(2).enumerate() {
                let nodes = usize::try_from(pair[0]).ok().zip(usize::try_from(pair[1]).ok());
                let Some(nodes) = nodes.and_then(|(a, b)| connectivity.get(a..b)) else {
                    return Err(self.scan.refuse(format!("cell {i} ends at entry {} of {entries}", pair[1])));
                };
                self.push(kind, nodes.to_vec());
            }
            let end = offsets.last().copied().unwrap_or(0);
            if end != entries as i64 {
                return Err(self
                    .scan
                    .refuse(format!("more than the {end} entries of the cells: {entries} are claimed")));
            }
            return Ok(());
        }
        let values = self.integers("int", entries)?;
        let mut at = 0;
        for i in 0..rows {
            let length = values.get(at).and_then(|&n| usize::try_from(n).ok());
            let Some(nodes) = length.and_then(|n| values.get(at + 1..at + 1 + n)) else {
                let claims = &self.claims;
                return Err(self.scan.refuse(format!("cell {i} is longer than the list; {claims} are claimed")));
            };
            at += 1 + nodes.len();
            self.push(kind, nodes.to_vec());
        }
        if at != entries {
            return Err(self
                .scan
                .refuse(format!("more than the {at} entries of the cells: {} are claimed", self.claims)));
        }
        Ok(())
    }

    fn push(&mut self, kind: u8, nodes: Vec<i64>) {
        let kind = if kind == cell::POLYGON && nodes.len() == 3 { cell::TRIANGLE } else { kind };
        self.mesh.push(kind, nodes, 0);
    }

    fn finish(mut self) -> Result<FileMesh> {
        if self.grid {
            if self.types.len() != self.mesh.types.len() {
                let reason = format!("{} cell types for {} cells", self.types.len(), self.mesh.types.len());
                return Err(Error::format(self.scan.path(), reason));
            }
            self.mesh.types = self.types.iter().map(|&t| t as u8).collect();
        }
        let (points, cells) = (self.mesh.points.len(), self.mesh.types.len());
        self.mesh.point_data.retain(|a| a.data.len() == points * a.components);
        self.mesh.cell_data.retain(|a| a.data.len() == cells * a.components);
        Ok(self.mesh)
    }

    fn read_attribute(&mut self, keyword: &str, rows: Rows) -> Result<()> {
        let (Rows::Points(count) | Rows::Cells(count)) = rows else {
            if keyword == "FIELD" {
                return self.read_field(rows);
            }
            return Err(self.no_keyword(keyword));
        };
        if keyword == "FIELD" {
            return self.read_field(rows);
        }
        let name = self.word("a name")?;
        let (components, kind) = match keyword {
            "SCALARS" => {
                let kind = self.word("a type")?;
                let components = match self.scan.peek().and_then(|w| w.parse::<usize>().ok()) {
                    Some(n) => {
                        self.scan.word();
                        n
                    }
                    None => 1,
                };
                if self.scan.peek().is_some_and(|w| w.eq_ignore_ascii_case("LOOKUP_TABLE")) {
                    self.scan.word();
                    self.scan.word();
                }
                (components, kind)
            }
            "VECTORS" | "NORMALS" => (3, self.word("a type")?),
            "TENSORS" => (9, self.word("a type")?),
            "TEXTURE_COORDINATES" => {
                let n = self.scan.count("coordinates", 0)?;
                (n, self.word("a type")?)
            }
            "COLOR_SCALARS" => {
                let n = self.scan.count("colours", 0)?;
                (n, if self.text { "float".into() } else { "unsigned_char".into() })
            }
            "LOOKUP_TABLE" => {
                let n = self.scan.count("colours", 0)?;
                let kind = if self.text { "float" } else { "unsigned_char" };
                return self.values(kind, n.saturating_mul(4)).map(|_| ());
            }
            "GLOBAL_IDS" | "PEDIGREE_IDS" => (1, self.word("a type")?),
            _ => return Err(self.no_keyword(keyword)),
        };
        let data = self.values(&kind, count.saturating_mul(components))?;
        self.keep(rows, NamedArray { name, components, data });
        Ok(())
    }

    /// A word that begins no section: a number is one more than the counts say.
    fn no_keyword(&self, word: &str) -> Error {
        let text: String = word.chars().take(40).collect();
        if word.parse::<f64>().is_ok() && !self.claims.is_empty() {
            return self
                .scan
                .refuse(format!("'{text}' where a keyword should be: more than the {} claimed", self.claims));
        }
        self.scan.refuse(format!("keyword '{text}'"))
    }

    /// Numbers as text; where they end too early, the counts are named.
    fn numbers<T: std::str::FromStr>(&mut self, count: usize, what: &str) -> Result<Vec<T>> {
        let mut values = Vec::with_capacity(count);
        for number in 0..count {
            let word = self.scan.word().unwrap_or("the end of the file");
            let Ok(value) = word.parse() else {
                let text: String = word.chars().take(40).collect();
                let claims = &self.claims;
                let text = format!("'{text}' is not {what}: value {number} of {count}; {claims} are claimed");
                return Err(self.scan.refuse(text));
            };
            values.push(value);
        }
        Ok(values)
    }

    fn read_field(&mut self, rows: Rows) -> Result<()> {
        self.word("the field's name")?;
        for _ in 0..self.scan.count("arrays", 1)? {
            let Some(name) = self.scan.word().map(str::to_owned) else {
                return Err(self.scan.refuse("the file ends in a field"));
            };
            let components = self.scan.count("components", 0)?;
            let tuples = self.scan.count("tuples", 0)?;
            let kind = self.word("a type")?;
            let data = self.values(&kind, tuples.saturating_mul(components))?;
            self.keep(rows, NamedArray { name, components, data });
            if self.scan.peek().is_some_and(|w| w.eq_ignore_ascii_case("METADATA")) {
                self.scan.word();
                self.skip_metadata();
            }
        }
        Ok(())
    }

    /// Behind the word METADATA: the rest of its line, then lines up to an empty one.
    fn skip_metadata(&mut self) {
        self.scan.line();
        while self.scan.line().is_some_and(|l| !l.is_empty()) {}
    }

    fn keep(&mut self, rows: Rows, array: NamedArray) {
        match rows {
            Rows::Points(_) => self.mesh.point_data.push(array),
            Rows::Cells(_) => self.mesh.cell_data.push(array),
            Rows::None => {}
        }
    }

    fn integers(&mut self, kind: &str, count: usize) -> Result<Vec<i64>> {
        match self.values(kind, count)? {
            ArrayData::Long(values) => Ok(values),
            _ => Err(self.scan.refuse(format!("type '{kind}' where whole numbers should be"))),
        }
    }

    fn reals(&mut self, kind: &str, count: usize) -> Result<Vec<f64>> {
        Ok(match self.values(kind, count)? {
            ArrayData::Real(values) => values,
            ArrayData::Long(values) => values.into_iter().map(|v| v as f64).collect(),
            ArrayData::Int(values) => values.into_iter().map(f64::from).collect(),
        })
    }

    fn values(&mut self, kind: &str, count: usize) -> Result<ArrayData> {
        let width = match kind {
            "unsigned_char" | "char" | "signed_char" | "vtktypeuint8" | "vtktypeint8" => 1,
            "unsigned_short" | "short" => 2,
            "unsigned_int" | "int" | "float" | "vtktypeint32" | "vtktypeuint32" => 4,
            "unsigned_long" | "long" | "double" | "vtkidtype" | "vtktypeint64" | "vtktypeuint64" => 8,
            _ => return Err(self.scan.refuse(format!("type '{kind}'"))),
        };
        // vtkIdType is written with 4 bytes in these files.
        let width = if kind == "vtkidtype" { 4 } else { width };
        let real = kind == "float" || kind == "double";
        self.scan.believable(count as i64, "values", if self.text { 2 } else { width })?;
        if self.text {
            return if real {
                self.numbers(count, "a number").map(ArrayData::Real)
            } else {
                self.numbers(count, "a whole number").map(ArrayData::Long)
            };
        }
        // Bytes begin behind the end of the keyword's line.
        if self.scan.bytes().get(self.scan.position()) == Some(&b'\r') {
            self.scan.seek(self.scan.position() + 1);
        }
        let begin = self.scan.position() + 1;
        let Some(bytes) = self.scan.bytes().get(begin..begin + count * width) else {
            let claims = &self.claims;
            let text = format!("the file ends before {count} values of type {kind}; {claims} are claimed");
            return Err(self.scan.refuse(text));
        };
        let data = convert(kind, bytes);
        self.scan.seek(begin + count * width);
        Ok(data)
    }
}

fn convert(kind: &str, bytes: &[u8]) -> ArrayData {
    macro_rules! numbers {
        ($type:ty, $variant:ident, $target:ty) => {
            ArrayData::$variant(
                bytes
                    .chunks_exact(size_of::<$type>())
                    .map(|c| <$type>::from_be_bytes(c.try_into().expect("chunks have the type's size")) as $target)
                    .collect(),
            )
        };
    }
    match kind {
        "unsigned_char" | "vtktypeuint8" => numbers!(u8, Long, i64),
        "char" | "signed_char" | "vtktypeint8" => numbers!(i8, Long, i64),
        "unsigned_short" => numbers!(u16, Long, i64),
        "short" => numbers!(i16, Long, i64),
        "unsigned_int" | "vtktypeuint32" => numbers!(u32, Long, i64),
        "int" | "vtkidtype" | "vtktypeint32" => numbers!(i32, Long, i64),
        "unsigned_long" | "vtktypeuint64" => numbers!(u64, Long, i64),
        "float" => numbers!(f32, Real, f64),
        "double" => numbers!(f64, Real, f64),
        _ => numbers!(i64, Long, i64),
    }
}
