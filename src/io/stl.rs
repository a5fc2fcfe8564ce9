//! Stereolithography `.stl` surfaces, text and bytes.
//!
//! # Method
//! Triangles carry their own corners; corners with equal coordinates become one point (equal as numbers: -0 is 0).
//! Text `solid`s become patches.
//!
//! # Differences
//! Written here rather than over the `stl_io` crate: that one keeps single precision only, which loses the digits of
//! text files.

use std::io::Write;
use std::path::Path;

use glam::DVec3;
use rustc_hash::FxHashMap;

use super::file_mesh::{FileMesh, cell};
use super::text_scan::{TextScan, read_whole};
use crate::error::{Error, Result};
use crate::mesh::surface_mesh::{Patch, PatchRole, SurfaceMesh};

/// Bytes before the triangles of a binary file: 80 of title, 4 of count.
const HEADER_BYTES: usize = 84;
/// Bytes of a binary triangle: normal, three corners, attribute.
const TRIANGLE_BYTES: usize = 50;

/// Points by their exact coordinates.
#[derive(Default)]
struct PointMerge {
    numbers: FxHashMap<[u64; 3], i64>,
}

impl PointMerge {
    fn number(&mut self, point: DVec3, points: &mut Vec<DVec3>) -> i64 {
        // Adding 0 makes -0 a 0. NaN is never equal to anything, also not to itself.
        let point = point + DVec3::ZERO;
        if point.is_nan() {
            points.push(point);
            return points.len() as i64 - 1;
        }
        *self.numbers.entry(point.to_array().map(f64::to_bits)).or_insert_with(|| {
            points.push(point);
            points.len() as i64 - 1
        })
    }
}

/// Reads a surface.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] with the line or byte.
pub fn read(path: &Path) -> Result<FileMesh> {
    let bytes = read_whole(path)?;
    // Binary titles may begin with "solid" too: the length decides first.
    if bytes.len() >= HEADER_BYTES {
        let count = u32::from_le_bytes([bytes[80], bytes[81], bytes[82], bytes[83]]) as usize;
        if count.checked_mul(TRIANGLE_BYTES).map(|n| n + HEADER_BYTES) == Some(bytes.len()) {
            return Ok(read_binary(&bytes));
        }
    }
    if bytes.trim_ascii_start().starts_with(b"solid") && !bytes.contains(&0) {
        return read_text(TextScan::new(bytes, path, 0));
    }
    if bytes.len() < HEADER_BYTES {
        return Err(Error::format(path, format!("{} bytes are no STL file", bytes.len())));
    }
    let count = u32::from_le_bytes([bytes[80], bytes[81], bytes[82], bytes[83]]);
    let room = (bytes.len() - HEADER_BYTES) / TRIANGLE_BYTES;
    let whole = u64::from(count) * TRIANGLE_BYTES as u64 + HEADER_BYTES as u64;
    if whole <= bytes.len() as u64 {
        let (triangles, rest) = bytes.split_at(whole as usize);
        if is_remark(rest) {
            return Ok(read_binary(triangles));
        }
        let text = format!("byte {whole}: more than the {count} triangles claimed; the file holds {room}");
        return Err(Error::format(path, text));
    }
    Err(Error::format(path, format!("byte 80: {count} triangles are claimed, the file holds {room}")))
}

/// Whether what follows the triangles is padding or text. The format knows neither, but some programs append them; less
/// than a triangle cannot be a row that was not counted.
fn is_remark(rest: &[u8]) -> bool {
    let begin = rest.iter().position(|&b| b != 0).unwrap_or(rest.len());
    let end = rest.iter().rposition(|&b| b != 0).map_or(begin, |last| last + 1);
    let is_text = |b: &u8| b.is_ascii_graphic() || b.is_ascii_whitespace();
    rest.len() < TRIANGLE_BYTES || rest[begin..end].iter().all(is_text)
}

fn read_binary(bytes: &[u8]) -> FileMesh {
    let mut mesh = FileMesh::new();
    let mut merge = PointMerge::default();
    for record in bytes[HEADER_BYTES..].chunks_exact(TRIANGLE_BYTES) {
        let number =
            |at: usize| f64::from(f32::from_le_bytes([record[at], record[at + 1], record[at + 2], record[at + 3]]));
        let corner = |c: usize| DVec3::new(number(12 + 12 * c), number(16 + 12 * c), number(20 + 12 * c));
        let nodes = [0, 1, 2].map(|c| merge.number(corner(c), &mut mesh.points));
        mesh.push(cell::TRIANGLE, nodes, 0);
    }
    mesh
}

fn read_text(mut scan: TextScan) -> Result<FileMesh> {
    let mut mesh = FileMesh::new();
    let mut merge = PointMerge::default();
    let mut solids = 0;
    while let Some(word) = scan.peek() {
        match word.to_lowercase().as_str() {
            "solid" => {
                let name = scan.line().unwrap_or("").trim().get(5..).unwrap_or("").trim().to_owned();
                solids += 1;
                mesh.patches.push(Patch { id: solids, role: PatchRole::Wall, name });
            }
            "facet" => {
                scan.line();
                read_facet(&mut scan, &mut mesh, &mut merge, solids)?;
            }
            "endsolid" => {
                scan.line();
            }
            _ => {
                return Err(
                    scan.refuse(format!("'{}' where a facet should be", word.chars().take(40).collect::<String>()))
                );
            }
        }
    }
    if solids == 1 {
        mesh.patches.clear();
        mesh.tags.fill(0);
    }
    Ok(mesh)
}

fn read_facet(scan: &mut TextScan, mesh: &mut FileMesh, merge: &mut PointMerge, patch: i32) -> Result<()> {
    let expect = |scan: &mut TextScan, wanted: &str| {
        let word = scan.word().unwrap_or("the end of the file").to_lowercase();
        if word == wanted { Ok(()) } else { Err(scan.refuse(format!("'{word}' where '{wanted}' should be"))) }
    };
    expect(scan, "outer")?;
    expect(scan, "loop")?;
    let mut nodes = [0; 3];
    for node in &mut nodes {
        expect(scan, "vertex")?;
        *node = merge.number(scan.point()?, &mut mesh.points);
    }
    expect(scan, "endloop")?;
    expect(scan, "endfacet")?;
    mesh.push(cell::TRIANGLE, nodes, patch);
    Ok(())
}

fn normal(surface: &SurfaceMesh, facet: usize) -> DVec3 {
    let [a, b, c] = surface.facets[facet].map(|v| surface.points[v.index()]);
    (b - a).cross(c - a).normalize_or_zero()
}

/// Writes a surface as text: one solid per patch, full precision.
///
/// # Errors
/// Those of the writer.
pub fn write_text(surface: &SurfaceMesh, out: &mut dyn Write) -> std::io::Result<()> {
    let mut patches: Vec<i32> = surface.facet_patches.clone();
    patches.sort_unstable();
    patches.dedup();
    for patch in patches {
        let name = surface.patches.iter().find(|p| p.id == patch && !p.name.is_empty());
        let name = name.map_or_else(|| format!("patch_{patch}"), |p| p.name.clone());
        writeln!(out, "solid {name}")?;
        for i in (0..surface.facets.len()).filter(|&i| surface.facet_patches[i] == patch) {
            let n = normal(surface, i);
            writeln!(out, "facet normal {} {} {}\nouter loop", n.x, n.y, n.z)?;
            for p in surface.facets[i].map(|v| surface.points[v.index()]) {
                writeln!(out, "vertex {} {} {}", p.x, p.y, p.z)?;
            }
            writeln!(out, "endloop\nendfacet")?;
        }
        writeln!(out, "endsolid {name}")?;
    }
    Ok(())
}

/// Writes a surface as bytes: single precision, as the format has it.
///
/// # Errors
/// Those of the writer.
pub fn write_binary(surface: &SurfaceMesh, title: &str, out: &mut dyn Write) -> std::io::Result<()> {
    let mut header = [b' '; 80];
    header[..title.len().min(80)].copy_from_slice(&title.as_bytes()[..title.len().min(80)]);
    out.write_all(&header)?;
    let count = u32::try_from(surface.facets.len()).map_err(|_| std::io::Error::other("too many triangles for STL"))?;
    out.write_all(&count.to_le_bytes())?;
    for i in 0..surface.facets.len() {
        let [a, b, c] = surface.facets[i].map(|v| surface.points[v.index()]);
        for p in [normal(surface, i), a, b, c] {
            for v in p.to_array() {
                out.write_all(&(v as f32).to_le_bytes())?;
            }
        }
        out.write_all(&[0, 0])?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {

    #[test]
    fn reads_indented_text_with_blank_lines_and_merges_equal_points() {
        let facet = |a: &str, b: &str, c: &str| {
            format!(
                "facet normal -1 0 -0\n outer loop\n  vertex {a}\n  vertex {b}\n  vertex {c}\n endloop\nendfacet\n\n"
            )
        };
        let text =
            format!("solid s\n{}  {}endsolid s\n", facet("0 0 0", "0 1 0", "1 0 0"), facet("0 0 0", "1 0 0", "0 0 1"));
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("two.stl");
        std::fs::write(&path, text).unwrap();
        let surface = crate::io::read_surface(&path).unwrap();
        assert_eq!((surface.points.len(), surface.facets.len()), (4, 2));
    }

    #[test]
    fn bytes_behind_the_counted_triangles_are_padding_or_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("two.stl");
        let mut triangle: Vec<u8> =
            [0.0_f32, 0., 1., 0., 0., 0., 2., 0., 0., 0., 2., 0.].map(f32::to_le_bytes).concat();
        triangle.extend([0, 0]);
        let mut file = vec![b' '; 80];
        file.extend(1_u32.to_le_bytes());
        file.extend(&triangle);
        let read = |rest: &[u8]| {
            std::fs::write(&path, [&file[..], rest].concat()).unwrap();
            super::read(&path)
        };
        for rest in [
            &[][..],
            &[0; 512],
            &[7; 49],
            &[&b"exported by a program that likes to say who it is"[..], b", twice\n"].concat(),
        ] {
            assert_eq!(read(rest).unwrap().types.len(), 1);
        }
        let refused = read(&triangle).map(|_| ()).unwrap_err().to_string();
        assert!(refused.contains("more than the 1 triangles claimed") && refused.contains("holds 2"), "{refused}");
    }
}
