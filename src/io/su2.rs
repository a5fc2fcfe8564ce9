//! SU2 grids, `.su2`.
//!
//! # Method
//! Elements with VTK's numbers, points, and a named marker per patch of the outer boundary. Text only.
//!
//! # Source
//! [SU2].
//!
//! # Limits
//! Linear elements; labels have no place in a grid of one zone.

use std::io::Write;
use std::path::Path;

use super::file_mesh::{FileMesh, cell};
use super::text_scan::TextScan;
use super::{WriteOptions, signs};
use crate::error::Result;
use crate::mesh::mixed_mesh::MixedMesh;
use crate::mesh::surface_mesh::{Patch, PatchRole};

/// Writes a grid whose boundary is filled.
///
/// # Errors
/// Those of the writer.
pub fn write(mesh: &MixedMesh, options: &WriteOptions, out: &mut dyn Write) -> std::io::Result<()> {
    let signs = signs(mesh.space, options);
    writeln!(out, "NDIME= 3\nNELEM= {}", mesh.element_count())?;
    for i in 0..mesh.element_count() {
        write!(out, "{}", mesh.types[i])?;
        mesh.element(i).1.iter().try_for_each(|v| write!(out, " {}", v.0))?;
        writeln!(out, " {i}")?;
    }
    writeln!(out, "NPOIN= {}", mesh.points.len())?;
    for (i, &point) in mesh.points.iter().enumerate() {
        let p = point * signs;
        writeln!(out, "{} {} {} {i}", p.x, p.y, p.z)?;
    }
    let tags = super::medit::face_tags(mesh);
    let mut faces = super::outer_faces(mesh);
    faces.sort_by_key(|&f| tags[f]);
    let markers: Vec<&[usize]> = faces.chunk_by(|&a, &b| tags[a] == tags[b]).collect();
    writeln!(out, "NMARK= {}", markers.len())?;
    let triangles = mesh.boundary.triangles.len();
    for marker in markers {
        let name = super::patch_name(mesh, options, tags[marker[0]]);
        writeln!(out, "MARKER_TAG= {name}\nMARKER_ELEMS= {}", marker.len())?;
        for &face in marker {
            if face < triangles {
                let [a, b, c] = mesh.boundary.triangles[face];
                writeln!(out, "5 {} {} {}", a.0, b.0, c.0)?;
            } else {
                let [a, b, c, d] = mesh.boundary.quads[face - triangles];
                writeln!(out, "9 {} {} {} {}", a.0, b.0, c.0, d.0)?;
            }
        }
    }
    Ok(())
}

/// Reads a grid; markers become patches.
///
/// # Errors
/// [`crate::Error::Io`], [`crate::Error::Format`] with the line.
pub fn read(path: &Path) -> Result<FileMesh> {
    let mut scan = TextScan::open(path, b'%')?;
    let mut mesh = FileMesh::new();
    while !scan.at_end() {
        let line = scan.line().unwrap_or("").to_owned();
        let Some((keyword, value)) = line.split_once('=') else {
            return Err(scan.refuse(format!("'{}' is no keyword", line.chars().take(40).collect::<String>())));
        };
        let number = || value.split_whitespace().next().and_then(|w| w.parse::<i64>().ok()).unwrap_or(-1);
        match keyword.trim() {
            "NDIME" if number() != 3 => return Err(scan.refuse("three dimensions are needed")),
            "NELEM" => {
                let count = scan.believable(number(), "elements", 8)?;
                read_cells(&mut scan, &mut mesh, count, 1)?;
            }
            "NPOIN" => {
                for _ in 0..scan.believable(number(), "points", 6)? {
                    mesh.points.push(scan.point()?);
                    scan.line();
                }
            }
            "MARKER_TAG" => {
                let id = mesh.patches.len() as i32 + 1;
                mesh.patches.push(Patch { id, role: PatchRole::Wall, name: value.trim().to_owned() });
            }
            "MARKER_ELEMS" => {
                let count = scan.believable(number(), "faces", 6)?;
                let tag = mesh.patches.len() as i32;
                read_cells(&mut scan, &mut mesh, count, tag)?;
            }
            _ => {}
        }
    }
    if mesh.points.is_empty() {
        return Err(scan.refuse("not an SU2 grid: no points"));
    }
    Ok(mesh)
}

fn read_cells(scan: &mut TextScan, mesh: &mut FileMesh, count: usize, tag: i32) -> Result<()> {
    for _ in 0..count {
        let kind = scan.integer()?;
        let length = match kind as u8 {
            cell::LINE => 2,
            cell::TRIANGLE => 3,
            cell::QUAD | 10 => 4,
            14 => 5,
            13 => 6,
            12 => 8,
            _ => return Err(scan.refuse(format!("element type {kind}"))),
        };
        let mut nodes = [0; 8];
        for node in &mut nodes[..length] {
            *node = scan.integer()?;
        }
        scan.line();
        mesh.push(kind as u8, nodes[..length].iter().copied(), tag);
    }
    Ok(())
}
