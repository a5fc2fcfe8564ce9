//! AFLR surfaces, `.surf`.
//!
//! # Method
//! Counts of triangles, quadrilaterals and points; a line per point (coordinates, perhaps normal spacing and layer
//! thickness); per face its points from 1, surface id, reconnection flag and boundary condition. The surface id becomes
//! the patch, the boundary condition its role.
//!
//! # Source
//! [SimCenterAFLR].

use std::io::Write;
use std::path::Path;

use super::file_mesh::{FileMesh, cell};
use super::text_scan::TextScan;
use crate::error::Result;
use crate::mesh::surface_mesh::{Patch, PatchRole, SurfaceMesh};

/// Grid boundary conditions of the format and what they mean here.
const CONDITIONS: [(i64, PatchRole); 7] = [
    (0, PatchRole::Farfield),
    (1, PatchRole::Wall),
    (-1, PatchRole::WallBoundaryLayer),
    (2, PatchRole::Symmetry),
    (3, PatchRole::Embedded),
    (5, PatchRole::Source),
    (7, PatchRole::Fixed),
];

/// Reads a surface.
///
/// # Errors
/// [`crate::Error::Io`], [`crate::Error::Format`] with the line.
pub fn read(path: &Path) -> Result<FileMesh> {
    let mut scan = TextScan::open(path, 0)?;
    let (triangles, quads, points) = (scan.integer()?, scan.integer()?, scan.integer()?);
    scan.line();
    let points = scan.believable(points, "points", 6)?;
    let triangles = scan.believable(triangles, "triangles", 8)?;
    let quads = scan.believable(quads, "quadrilaterals", 10)?;
    let mut mesh = FileMesh::new();
    for number in 0..points {
        mesh.points.push(scan.point_of(number, points)?);
        // Spacings at the point may follow.
        scan.line();
    }
    let claims = format!("{triangles} triangles, {quads} quadrilaterals and {points} points");
    for face in 0..triangles + quads {
        let corners = if face < triangles { 3 } else { 4 };
        let mut nodes = [0; 4];
        for node in &mut nodes[..corners] {
            *node = face_node(&mut scan, face, &claims)?;
        }
        let rest: Vec<i64> = scan.line().unwrap_or("").split_whitespace().filter_map(|w| w.parse().ok()).collect();
        let id = rest.first().copied().unwrap_or(0) as i32;
        let role = CONDITIONS.iter().find(|(code, _)| rest.get(2) == Some(code)).map(|(_, role)| *role);
        if let Some(role) = role
            && !mesh.patches.iter().any(|p| p.id == id)
        {
            mesh.patches.push(Patch { id, role, name: String::new() });
        }
        mesh.push(if corners == 3 { cell::TRIANGLE } else { cell::QUAD }, nodes[..corners].iter().copied(), id);
    }
    scan.expect_end(claims)?;
    Ok(mesh)
}

/// The next corner of a face, from 0.
fn face_node(scan: &mut TextScan, face: usize, claims: &str) -> Result<i64> {
    let word = scan.peek().unwrap_or_else(|| "the end of the file".into());
    if word.parse::<i64>().is_err() {
        let text: String = word.chars().take(40).collect();
        return Err(scan.refuse(format!("'{text}' where a corner of face {face} should be; {claims} are claimed")));
    }
    Ok(scan.integer()? - 1)
}

/// Writes a surface.
///
/// # Errors
/// Those of the writer.
pub fn write(surface: &SurfaceMesh, out: &mut dyn Write) -> std::io::Result<()> {
    writeln!(out, "{} 0 {}", surface.facets.len(), surface.points.len())?;
    for p in &surface.points {
        writeln!(out, "{} {} {}", p.x, p.y, p.z)?;
    }
    for ([a, b, c], patch) in surface.facets.iter().zip(&surface.facet_patches) {
        let role = surface.role_of(*patch);
        let condition = CONDITIONS.iter().find(|(_, r)| *r == role).map_or(1, |(code, _)| *code);
        writeln!(out, "{} {} {} {patch} 0 {condition}", a.0 + 1, b.0 + 1, c.0 + 1)?;
    }
    Ok(())
}
