//! Polygon files `.ply`: text and bytes of either order.
//!
//! # Limits
//! The elements `vertex` (with x, y, z) and `face` (with a list of vertex indices) count; other elements and
//! properties are read past.

use std::io::Write;
use std::path::Path;

use glam::DVec3;

use super::Encoding;
use super::file_mesh::{FileMesh, cell};
use super::text_scan::TextScan;
use super::voxel_stream::ByteOrder;
use crate::error::{Error, Result};
use crate::mesh::surface_mesh::SurfaceMesh;

#[derive(Clone, Copy, PartialEq)]
enum Number {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Number {
    fn of_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

struct Property {
    name: String,
    /// Type of the count where this is a list.
    list: Option<Number>,
    number: Number,
}

struct Element {
    name: String,
    count: i64,
    properties: Vec<Property>,
}

/// Reads numbers of the body, as text or bytes.
struct Body {
    scan: TextScan,
    order: Option<ByteOrder>,
}

impl Body {
    fn next(&mut self, number: Number) -> Result<f64> {
        let Some(order) = self.order else { return self.scan.real() };
        let at = self.scan.position();
        let width = number.bytes();
        let Some(raw) = self.scan.bytes().get(at..at + width) else {
            return Err(Error::format(self.scan.path(), format!("byte {at}: the file ends in the middle of its body")));
        };
        let mut bytes = [0u8; 8];
        bytes[..width].copy_from_slice(raw);
        if order == ByteOrder::Big {
            bytes[..width].reverse();
        }
        let low = u64::from_le_bytes(bytes);
        self.scan.seek(at + width);
        Ok(match number {
            Number::I8 => f64::from(low as u8 as i8),
            Number::U8 => f64::from(low as u8),
            Number::I16 => f64::from(low as u16 as i16),
            Number::U16 => f64::from(low as u16),
            Number::I32 => f64::from(low as u32 as i32),
            Number::U32 => f64::from(low as u32),
            Number::F32 => f64::from(f32::from_bits(low as u32)),
            Number::F64 => f64::from_bits(low),
        })
    }

    fn count(&mut self, number: Number) -> Result<usize> {
        let count = self.next(number)? as i64;
        self.scan.believable(count, "list entries", 1)
    }
}

/// Reads a surface.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] with the line or byte.
pub fn read(path: &Path) -> Result<FileMesh> {
    let mut scan = TextScan::open(path, 0)?;
    if scan.line() != Some("ply") {
        return Err(Error::format(path, "not a PLY file: it does not begin with ply"));
    }
    let (order, elements) = read_header(&mut scan)?;
    let mut body = Body { scan, order };
    let mut mesh = FileMesh::new();
    for element in &elements {
        let smallest: usize = match order {
            Some(_) => element.properties.iter().map(|p| p.list.unwrap_or(p.number).bytes()).sum(),
            None => 2 * element.properties.len(),
        };
        let count = body.scan.believable(element.count, &element.name, smallest.max(1))?;
        for _ in 0..count {
            read_row(&mut body, element, &mut mesh)?;
        }
    }
    // Behind bytes some programs leave more of them; text that follows is rows that were not counted.
    if order.is_none() && !body.scan.at_end() {
        return Err(body.scan.refuse("more follows than the counts say"));
    }
    Ok(mesh)
}

fn read_row(body: &mut Body, element: &Element, mesh: &mut FileMesh) -> Result<()> {
    let mut point = DVec3::NAN;
    for property in &element.properties {
        if let Some(list) = property.list {
            let is_face = element.name == "face" && property.name.starts_with("vert");
            let points = mesh.points.len();
            let length = match body.count(list) {
                Err(_) if is_face => {
                    let text = format!("no number of corners where a face should begin; {points} points are claimed");
                    return Err(body.scan.refuse(text));
                }
                other => other?,
            };
            let mut nodes = Vec::with_capacity(length);
            for _ in 0..length {
                nodes.push(body.next(property.number)? as i64);
            }
            if is_face {
                if length < 3 {
                    let text = format!("a face of {length} corners; {points} points are claimed before the faces");
                    return Err(body.scan.refuse(text));
                }
                mesh.push(if length == 3 { cell::TRIANGLE } else { cell::POLYGON }, nodes, 0);
            }
            continue;
        }
        let value = body.next(property.number)?;
        match property.name.as_str() {
            "x" => point.x = value,
            "y" => point.y = value,
            "z" => point.z = value,
            _ => {}
        }
    }
    if element.name == "vertex" {
        mesh.points.push(point);
    }
    Ok(())
}

fn read_header(scan: &mut TextScan) -> Result<(Option<ByteOrder>, Vec<Element>)> {
    let mut order = None;
    let mut elements: Vec<Element> = Vec::new();
    loop {
        let Some(line) = scan.line().map(str::to_owned) else {
            return Err(scan.refuse("the header has no end_header"));
        };
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["end_header"] => return Ok((order, elements)),
            ["format", "ascii", ..] => order = None,
            ["format", "binary_little_endian", ..] => order = Some(ByteOrder::Little),
            ["format", "binary_big_endian", ..] => order = Some(ByteOrder::Big),
            ["element", name, count] => {
                let count = count.parse().map_err(|_| scan.refuse(format!("'{count}' is no count")))?;
                elements.push(Element { name: (*name).to_owned(), count, properties: Vec::new() });
            }
            ["property", rest @ ..] => {
                let property = match rest {
                    ["list", count, number, name] => Number::of_name(count)
                        .zip(Number::of_name(number))
                        .map(|(list, number)| Property { name: (*name).to_owned(), list: Some(list), number }),
                    [number, name] => {
                        Number::of_name(number).map(|number| Property { name: (*name).to_owned(), list: None, number })
                    }
                    _ => None,
                };
                match (property, elements.last_mut()) {
                    (Some(property), Some(element)) => element.properties.push(property),
                    _ => return Err(scan.refuse(format!("'{line}' is no property"))),
                }
            }
            ["comment" | "obj_info", ..] | [] => {}
            _ => return Err(scan.refuse(format!("header line '{}'", line.chars().take(60).collect::<String>()))),
        }
    }
}

/// Writes a surface in double precision.
///
/// # Errors
/// Those of the writer.
pub fn write(surface: &SurfaceMesh, encoding: Encoding, out: &mut dyn Write) -> std::io::Result<()> {
    let format = if encoding == Encoding::Ascii { "ascii" } else { "binary_little_endian" };
    write!(
        out,
        "ply\nformat {format} 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n\
         element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        surface.points.len(),
        surface.facets.len()
    )?;
    for p in &surface.points {
        if encoding == Encoding::Ascii {
            writeln!(out, "{} {} {}", p.x, p.y, p.z)?;
        } else {
            p.to_array().iter().try_for_each(|v| out.write_all(&v.to_le_bytes()))?;
        }
    }
    for [a, b, c] in &surface.facets {
        if encoding == Encoding::Ascii {
            writeln!(out, "3 {} {} {}", a.0, b.0, c.0)?;
        } else {
            out.write_all(&[3])?;
            [a, b, c].iter().try_for_each(|v| out.write_all(&v.0.to_le_bytes()))?;
        }
    }
    Ok(())
}
