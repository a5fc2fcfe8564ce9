//! Findings about a surface as JSON, and as a `.vtp` file one can look at.
//!
//! # Method
//! One cell per finding that names triangles, edges or points of the surface: a vertex, a line or the triangles, with
//! the finding's code, severity and number as cell arrays.

use std::fmt::Write;

use crate::error::{Finding, FindingCode, Severity};
use crate::mesh::surface_mesh::SurfaceMesh;

/// The findings as a JSON array of objects `code`, `name`, `severity`, `ids`, `point`, `text`.
pub fn to_json(findings: &[Finding]) -> String {
    let rows: Vec<serde_json::Value> = findings
        .iter()
        .map(|finding| {
            let point = finding.point.iter().all(|v| v.is_finite()).then_some(finding.point);
            serde_json::json!({
                "code": finding.code as i32,
                "name": format!("{:?}", finding.code),
                "severity": severity_name(finding.severity),
                "ids": finding.ids,
                "point": point,
                "text": finding.text,
            })
        })
        .collect();
    serde_json::to_string_pretty(&rows).unwrap_or_else(|_| "[]".into())
}

fn severity_name(severity: Severity) -> &'static str {
    match severity {
        Severity::Note => "note",
        Severity::Warning => "warning",
        Severity::Error => "error",
    }
}

/// Cells of one kind of the picture.
#[derive(Default)]
struct Cells {
    connectivity: Vec<i64>,
    offsets: Vec<i64>,
    findings: Vec<usize>,
}

impl Cells {
    fn push(&mut self, vertices: &[i64], finding: usize) {
        self.connectivity.extend(vertices);
        self.offsets.push(self.connectivity.len() as i64);
        self.findings.push(finding);
    }
}

/// The faulty points, edges and triangles as the text of a `.vtp` file (VTK XML PolyData, ASCII).
pub fn to_vtp(surface: &SurfaceMesh, findings: &[Finding]) -> String {
    let (mut vertices, mut lines, mut triangles) = (Cells::default(), Cells::default(), Cells::default());
    let points = surface.points.len() as i64;
    let is_point = |id: i64| (0..points).contains(&id) && surface.points[id as usize].is_finite();
    for (number, finding) in findings.iter().enumerate() {
        let [first, second] = finding.ids;
        match finding.code {
            FindingCode::OpenEdge | FindingCode::NonManifoldEdge | FindingCode::NearlyCoincidentPoints
                if is_point(first) && is_point(second) =>
            {
                lines.push(&[first, second], number);
            }
            FindingCode::DuplicateTriangle
            | FindingCode::DegenerateTriangle
            | FindingCode::InconsistentOrientation
            | FindingCode::IntersectingTriangles => {
                for id in [first, second] {
                    let Some(facet) = usize::try_from(id).ok().and_then(|i| surface.facets.get(i)) else { continue };
                    let corners = facet.map(|v| i64::from(v.0));
                    if corners.iter().all(|&v| is_point(v)) {
                        triangles.push(&corners, number);
                    }
                }
            }
            FindingCode::MergedPoints | FindingCode::UnusedPoint if is_point(first) => {
                vertices.push(&[first], number);
            }
            _ => {}
        }
    }
    write_vtp(surface, findings, [&vertices, &lines, &triangles])
}

fn write_vtp(surface: &SurfaceMesh, findings: &[Finding], cells: [&Cells; 3]) -> String {
    let mut text = String::from("<?xml version=\"1.0\"?>\n");
    text.push_str("<VTKFile type=\"PolyData\" version=\"1.0\" byte_order=\"LittleEndian\">\n<PolyData>\n");
    let counts = cells.map(|c| c.offsets.len());
    let _ = writeln!(
        text,
        "<Piece NumberOfPoints=\"{}\" NumberOfVerts=\"{}\" NumberOfLines=\"{}\" NumberOfStrips=\"0\" NumberOfPolys=\"{}\">",
        surface.points.len(),
        counts[0],
        counts[1],
        counts[2]
    );
    text.push_str("<CellData>\n");
    let order: Vec<usize> = cells.iter().flat_map(|c| c.findings.iter().copied()).collect();
    let array = |text: &mut String, name: &str, kind: &str, values: &mut dyn Iterator<Item = i64>| {
        let _ = writeln!(text, "<DataArray type=\"{kind}\" Name=\"{name}\" format=\"ascii\">");
        for value in values {
            let _ = write!(text, "{value} ");
        }
        text.push_str("\n</DataArray>\n");
    };
    array(&mut text, "code", "Int32", &mut order.iter().map(|&i| i64::from(findings[i].code as i32)));
    array(&mut text, "severity", "Int32", &mut order.iter().map(|&i| i64::from(findings[i].severity as i32)));
    array(&mut text, "finding", "Int64", &mut order.iter().map(|&i| i as i64));
    text.push_str("</CellData>\n<Points>\n");
    text.push_str("<DataArray type=\"Float64\" Name=\"Points\" NumberOfComponents=\"3\" format=\"ascii\">\n");
    for point in &surface.points {
        // Readers refuse files with NaN in ASCII; such points have no cell.
        let p = if point.is_finite() { *point } else { glam::DVec3::ZERO };
        let _ = writeln!(text, "{:?} {:?} {:?}", p.x, p.y, p.z);
    }
    text.push_str("</DataArray>\n</Points>\n");
    for (name, kind) in ["Verts", "Lines", "Polys"].iter().zip(cells) {
        let _ = writeln!(text, "<{name}>");
        array(&mut text, "connectivity", "Int64", &mut kind.connectivity.iter().copied());
        array(&mut text, "offsets", "Int64", &mut kind.offsets.iter().copied());
        let _ = writeln!(text, "</{name}>");
    }
    text.push_str("</Piece>\n</PolyData>\n</VTKFile>\n");
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::VertexId;
    use glam::DVec3;

    #[test]
    fn faults_become_cells_and_rows() {
        let points = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::NAN];
        let surface = SurfaceMesh::new(points, vec![[VertexId(0), VertexId(1), VertexId(2)]]);
        let findings = [
            Finding::new(FindingCode::OpenEdge, Severity::Error, "open").with_ids(0, 1).at([0.5, 0.0, 0.0]),
            Finding::new(FindingCode::DegenerateTriangle, Severity::Error, "flat").with_ids(0, -1),
            Finding::new(FindingCode::NonFiniteCoordinate, Severity::Error, "nan").with_ids(3, -1),
        ];
        let vtp = to_vtp(&surface, &findings);
        assert!(vtp.contains("NumberOfLines=\"1\"") && vtp.contains("NumberOfPolys=\"1\"") && !vtp.contains("NaN"));
        let json: serde_json::Value = serde_json::from_str(&to_json(&findings)).unwrap();
        assert_eq!(json[0]["ids"][1], 1);
        assert!(json[2]["point"].is_null());
    }
}
