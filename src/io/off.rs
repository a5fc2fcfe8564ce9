//! Geomview `.off` surfaces.
//!
//! # Limits
//! Text only; colours after a face are passed over.

use std::io::Write;
use std::path::Path;

use super::file_mesh::{FileMesh, cell};
use super::text_scan::TextScan;
use crate::error::Result;
use crate::mesh::surface_mesh::SurfaceMesh;

/// Reads a surface.
///
/// # Errors
/// [`crate::Error::Io`], [`crate::Error::Format`] with the line.
pub fn read(path: &Path) -> Result<FileMesh> {
    let mut scan = TextScan::open(path, b'#')?;
    let magic = scan.word().unwrap_or("").to_owned();
    // The keyword may carry prefixes for colours and normals (COFF, NOFF), whose numbers follow each vertex.
    if !magic.ends_with("OFF") || magic.ends_with("4OFF") || magic.ends_with("nOFF") {
        return Err(scan.refuse("not an OFF file: it does not begin with OFF"));
    }
    let by_line = magic != "OFF";
    let (points, faces) = (scan.integer()?, scan.integer()?);
    scan.integer()?;
    let points = scan.believable(points, "points", 6)?;
    let faces = scan.believable(faces, "faces", 4)?;
    let mut mesh = FileMesh::new();
    mesh.points.reserve_exact(points);
    for number in 0..points {
        mesh.points.push(scan.point_of(number, points)?);
        if by_line {
            scan.line();
        }
    }
    for _ in 0..faces {
        let claims = || format!("{points} points and {faces} faces are claimed");
        let corners = match scan.count("corners", 2) {
            Ok(corners) if corners >= 3 => corners,
            Ok(corners) => return Err(scan.refuse(format!("a face of {corners} corners; {}", claims()))),
            Err(_) => return Err(scan.refuse(format!("no number of corners where a face should begin; {}", claims()))),
        };
        let mut nodes = Vec::with_capacity(corners);
        for _ in 0..corners {
            nodes.push(scan.integer()?);
        }
        // Colours may follow on the same line.
        scan.line();
        mesh.push(if corners == 3 { cell::TRIANGLE } else { cell::POLYGON }, nodes, 0);
    }
    if !scan.at_end() {
        return Err(scan.refuse("more follows than the counts say"));
    }
    Ok(mesh)
}

/// Writes a surface.
///
/// # Errors
/// Those of the writer.
pub fn write(surface: &SurfaceMesh, out: &mut dyn Write) -> std::io::Result<()> {
    writeln!(out, "OFF\n{} {} 0", surface.points.len(), surface.facets.len())?;
    for p in &surface.points {
        writeln!(out, "{} {} {}", p.x, p.y, p.z)?;
    }
    for [a, b, c] in &surface.facets {
        writeln!(out, "3 {} {} {}", a.0, b.0, c.0)?;
    }
    Ok(())
}
