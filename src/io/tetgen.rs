//! TetGen piecewise linear complexes: `.poly` and `.smesh`, with the points in the file or in a `.node` beside it.
//!
//! # Method
//! Points, facets, holes, regions, in this order. A facet of several polygons is cut as a whole, so that a polygon
//! inside another one becomes part of the facet and facet holes stay open.
//!
//! # Source
//! [TetGen] section 5.2.
//!
//! # Limits
//! Lone segments and lone points inside a facet are refused.

use std::path::Path;

use glam::DVec3;

use super::file_mesh::{FileMesh, cell};
use super::polygon;
use super::text_scan::TextScan;
use crate::error::Result;
use crate::index::VertexId;
use crate::mesh::surface_mesh::RegionSeed;

/// Which of the two kinds of facet lists a file holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FacetLists {
    /// `.poly`: polygons and holes per facet.
    Poly,
    /// `.smesh`: one polygon per facet.
    Smesh,
}

/// Reads a complex.
///
/// # Errors
/// [`crate::Error::Io`], [`crate::Error::Format`] with the line.
pub fn read(path: &Path, lists: FacetLists) -> Result<FileMesh> {
    let mut scan = TextScan::open(path, b'#')?;
    let mut mesh = FileMesh::new();
    let mut base = read_points(&mut scan, &mut mesh)?;
    if mesh.points.is_empty() {
        let mut nodes = TextScan::open(&path.with_extension("node"), b'#')?;
        base = read_points(&mut nodes, &mut mesh)?;
        nodes.expect_end(format!("{} points", mesh.points.len()))?;
    }
    expect_count_of_facets(&mut scan, mesh.points.len())?;
    let facets = scan.count("facets", 4)?;
    let marked = scan.line().and_then(|l| l.split_whitespace().next()?.parse::<i64>().ok()).unwrap_or(0) != 0;
    for _ in 0..facets {
        match lists {
            FacetLists::Poly => read_facet(&mut scan, &mut mesh, base)?,
            FacetLists::Smesh => {
                let nodes = read_polygon(&mut scan, base)?;
                let marker = read_marker(&mut scan, marked)?;
                mesh.push(if nodes.len() == 3 { cell::TRIANGLE } else { cell::POLYGON }, nodes, marker);
            }
        }
    }
    read_holes_and_regions(&mut scan, &mut mesh, facets)?;
    let (points, holes, regions) = (mesh.points.len(), mesh.holes.len(), mesh.regions.len());
    scan.expect_end(format!("{points} points, {facets} facets, {holes} holes and {regions} regions"))?;
    Ok(mesh)
}

/// Reads points; returns the number of the first.
fn read_points(scan: &mut TextScan, mesh: &mut FileMesh) -> Result<i64> {
    let count = scan.count("points", 0)?;
    let dimension = scan.integer()?;
    if dimension != 3 {
        return Err(scan.refuse(format!("dimension {dimension}; three are needed")));
    }
    scan.line();
    let count = scan.believable(count as i64, "points", 8)?;
    let mut base = 0;
    for i in 0..count as i64 {
        if scan.at_end() {
            return Err(
                scan.refuse(format!("the file ends where row {i} of {count} points should be, which are claimed"))
            );
        }
        let number = scan.integer()?;
        if i == 0 {
            base = number;
        }
        if number != base + i {
            let wanted = base + i;
            return Err(scan.refuse(format!("point {number} where {wanted} should be; {count} points are claimed")));
        }
        let begin = scan.position();
        mesh.points.push(scan.point_of(i as usize, count)?);
        // A point goes on one line: else the number was that of the facets, which may be the one expected here.
        if scan.bytes()[begin..scan.position()].contains(&b'\n') {
            return Err(
                scan.refuse(format!("row {i} of the points has no three coordinates; {count} points are claimed"))
            );
        }
        // Attributes and markers may follow.
        scan.line();
    }
    Ok(base)
}

/// The number of facets stands with a flag at most: a longer row of numbers there is one more point.
fn expect_count_of_facets(scan: &mut TextScan, points: usize) -> Result<()> {
    let row = row_ahead(scan);
    if row.split_whitespace().count() > 2 && is_of_numbers(&row) {
        let text: String = row.chars().take(40).collect();
        let claimed = format!("more than the {points} points claimed");
        return Err(scan.refuse(format!("'{text}' where the number of facets should be: {claimed}")));
    }
    Ok(())
}

fn read_polygon(scan: &mut TextScan, base: i64) -> Result<Vec<i64>> {
    let corners = scan.count("corners", 2)?;
    let mut nodes = Vec::with_capacity(corners);
    for _ in 0..corners {
        nodes.push(scan.integer()? - base);
    }
    if corners < 3 {
        return Err(scan.refuse(format!("a polygon of {corners} corners")));
    }
    Ok(nodes)
}

fn read_marker(scan: &mut TextScan, marked: bool) -> Result<i32> {
    let rest = scan.line().unwrap_or("").split_whitespace().next().map(str::to_owned);
    match rest {
        Some(word) if marked => word.parse().map_err(|_| scan.refuse(format!("'{word}' is no boundary marker"))),
        _ => Ok(0),
    }
}

fn read_facet(scan: &mut TextScan, mesh: &mut FileMesh, base: i64) -> Result<()> {
    if scan.at_end() {
        return Err(scan.refuse("the file ends where a facet should be"));
    }
    let head: Vec<i64> = scan.line().unwrap_or("").split_whitespace().map_while(|w| w.parse().ok()).collect();
    let (Some(&polygons), holes, marker) = (head.first(), head.get(1).copied(), head.get(2).copied()) else {
        return Err(scan.refuse("a facet begins with its number of polygons"));
    };
    let polygons = scan.believable(polygons, "polygons", 6)?;
    if polygons == 0 {
        // Most likely a line of the next section: there are fewer facets than the file says.
        return Err(scan.refuse("a facet without polygons"));
    }
    let holes = scan.believable(holes.unwrap_or(0), "facet holes", 6)?;
    let tag = marker.unwrap_or(0) as i32;
    let mut rings = Vec::with_capacity(polygons);
    for _ in 0..polygons {
        rings.push(read_polygon(scan, base)?);
    }
    let mut hole_points = Vec::with_capacity(holes);
    for _ in 0..holes {
        scan.integer()?;
        hole_points.push(scan.point()?);
    }
    let in_range = |n: &i64| (0..mesh.points.len() as i64).contains(n);
    if rings.len() == 1 && hole_points.is_empty() || !rings.iter().flatten().all(in_range) {
        for nodes in rings {
            mesh.push(if nodes.len() == 3 { cell::TRIANGLE } else { cell::POLYGON }, nodes, tag);
        }
        return Ok(());
    }
    let mut triangles: Vec<[VertexId; 3]> = Vec::new();
    polygon::triangulate_facet(&rings, &hole_points, &mesh.points, &mut triangles);
    for triangle in triangles {
        mesh.push(cell::TRIANGLE, triangle.map(|v| i64::from(v.0)), tag);
    }
    Ok(())
}

fn read_holes_and_regions(scan: &mut TextScan, mesh: &mut FileMesh, facets: usize) -> Result<()> {
    if scan.at_end() {
        return Ok(());
    }
    expect_lone_number(scan, &format!("{facets} facets"))?;
    let holes = scan.count("holes", 6)?;
    for _ in 0..holes {
        // Holes are numbered from 0 or 1; the row of a polygon begins with three corners or more.
        let number = scan.integer()?;
        if !(0..=holes as i64).contains(&number) {
            let text = format!("'{number}' where the number of one of {holes} holes should be");
            return Err(scan.refuse(format!("{text}, or more than the {facets} facets claimed")));
        }
        mesh.holes.push(scan.point()?);
    }
    if scan.at_end() {
        return Ok(());
    }
    expect_lone_number(scan, &format!("{facets} facets and {holes} holes"))?;
    for _ in 0..scan.count("regions", 6)? {
        scan.integer()?;
        let point = scan.point()?;
        let rest: Vec<f64> = scan.line().unwrap_or("").split_whitespace().map_while(|w| w.parse().ok()).collect();
        mesh.regions.push(region(point, &rest));
    }
    Ok(())
}

/// The numbers of holes and of regions stand alone on their lines: a row of numbers there is one more of what came before.
fn expect_lone_number(scan: &mut TextScan, claims: &str) -> Result<()> {
    let row = row_ahead(scan);
    if row.split_whitespace().count() > 1 && is_of_numbers(&row) {
        let text: String = row.chars().take(40).collect();
        return Err(scan.refuse(format!("'{text}' where a number stands alone: more than the {claims} claimed")));
    }
    Ok(())
}

/// The next row, which is read again.
fn row_ahead(scan: &mut TextScan) -> String {
    scan.peek(); // past empty lines and comments
    let begin = scan.position();
    let row = scan.line().unwrap_or("").to_owned();
    scan.seek(begin);
    row
}

fn is_of_numbers(row: &str) -> bool {
    row.split_whitespace().all(|word| word.parse::<f64>().is_ok())
}

/// A region from its attribute and its largest tet volume.
fn region(point: DVec3, rest: &[f64]) -> RegionSeed {
    // The edge of the regular tet of that volume: V = a^3 / (6 sqrt 2).
    let edge = |volume: f64| (6.0 * std::f64::consts::SQRT_2 * volume).cbrt();
    let size = rest.get(1).copied().filter(|v| *v > 0.0).map(edge);
    RegionSeed { point, label: rest.first().map_or(0, |a| *a as i32), size }
}
