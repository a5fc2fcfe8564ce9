//! Wavefront `.obj` surfaces.
//!
//! # Differences
//! Written here rather than over the `tobj` crate: that one splits the points by object and renumbers them, and the
//! surface engine promises the caller's points in the caller's order.
//!
//! # Limits
//! Points and faces; a group or material name begins a new patch. Texture and normal indices are passed over.

use std::io::Write;
use std::path::Path;

use super::file_mesh::{FileMesh, cell};
use super::text_scan::TextScan;
use crate::error::Result;
use crate::mesh::surface_mesh::{Patch, PatchRole, SurfaceMesh};

/// Reads a surface.
///
/// # Errors
/// [`crate::Error::Io`], [`crate::Error::Format`] with the line.
pub fn read(path: &Path) -> Result<FileMesh> {
    let mut scan = TextScan::open(path, b'#')?;
    let mut mesh = FileMesh::new();
    let mut patch = 0;
    let mut known = false;
    while !scan.at_end() {
        let Some(line) = scan.line().map(str::to_owned) else { break };
        let mut words = line.split_whitespace();
        let keyword = words.next().unwrap_or("");
        match keyword {
            "v" => {
                let numbers: Option<Vec<f64>> = words.take(3).map(|w| w.parse().ok()).collect();
                match numbers.as_deref() {
                    Some(&[x, y, z]) => mesh.points.push(glam::DVec3::new(x, y, z)),
                    _ => return Err(refuse(&scan, format!("'{line}' is no point"))),
                }
            }
            "f" => {
                let nodes = face_nodes(words, mesh.points.len() as i64);
                let Some(nodes) = nodes.filter(|n| n.len() >= 3) else {
                    return Err(refuse(&scan, format!("'{line}' is no face")));
                };
                mesh.push(if nodes.len() == 3 { cell::TRIANGLE } else { cell::POLYGON }, nodes, patch);
            }
            "g" | "usemtl" | "o" => {
                patch = patch_of_name(&mut mesh.patches, words.next().unwrap_or(""));
            }
            "vn" | "vt" | "vp" | "s" | "mtllib" | "l" | "p" => {}
            _ => {
                if !known {
                    return Err(refuse(
                        &scan,
                        format!("'{}' begins no OBJ line", keyword.chars().take(40).collect::<String>()),
                    ));
                }
            }
        }
        known = known || ["v", "f"].contains(&keyword);
    }
    if mesh.points.is_empty() {
        return Err(crate::Error::format(path, "no points: not an OBJ surface"));
    }
    Ok(mesh)
}

/// `a/b/c` words: the first number counts; negative ones count from the last point.
fn face_nodes<'a>(words: impl Iterator<Item = &'a str>, points: i64) -> Option<Vec<i64>> {
    words
        .map(|word| {
            let index: i64 = word.split('/').next()?.parse().ok()?;
            Some(if index < 0 { points + index } else { index - 1 })
        })
        .collect()
}

/// The scan stands behind the line at fault.
fn refuse(scan: &TextScan, reason: String) -> crate::Error {
    crate::Error::format(scan.path(), format!("line {}: {reason}", scan.line_number().saturating_sub(1).max(1)))
}

/// The id of a named patch, made where it is new.
fn patch_of_name(patches: &mut Vec<Patch>, name: &str) -> i32 {
    if let Some(patch) = patches.iter().find(|p| p.name == name) {
        return patch.id;
    }
    let id = patches.len() as i32 + 1;
    patches.push(Patch { id, role: PatchRole::Wall, name: name.to_owned() });
    id
}

/// Writes a surface; patches become groups.
///
/// # Errors
/// Those of the writer.
pub fn write(surface: &SurfaceMesh, out: &mut dyn Write) -> std::io::Result<()> {
    for p in &surface.points {
        writeln!(out, "v {} {} {}", p.x, p.y, p.z)?;
    }
    let several = surface.facet_patches.iter().any(|p| *p != surface.facet_patches[0]);
    let mut last = None;
    for ([a, b, c], patch) in surface.facets.iter().zip(&surface.facet_patches) {
        if several && last != Some(*patch) {
            let name = surface.patches.iter().find(|p| p.id == *patch && !p.name.is_empty());
            writeln!(out, "g {}", name.map_or_else(|| format!("patch_{patch}"), |p| p.name.clone()))?;
            last = Some(*patch);
        }
        writeln!(out, "f {} {} {}", a.0 + 1, b.0 + 1, c.0 + 1)?;
    }
    Ok(())
}
