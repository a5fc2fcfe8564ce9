//! Every kind of bad surface in every format, through the command line: exit code 3, a cause, no output.

use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::process::Command;

/// A unit cube with a defect, and counts to claim in place of the true ones.
#[derive(Clone)]
struct Shape {
    points: Vec<[f64; 3]>,
    triangles: Vec<[i64; 3]>,
    claimed_points: Option<i64>,
    claimed_triangles: Option<i64>,
}

fn cube() -> Shape {
    let points = (0..8).map(|i| [f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2)]).collect();
    let triangles = [
        [0, 3, 1],
        [0, 2, 3],
        [4, 5, 7],
        [4, 7, 6],
        [0, 1, 5],
        [0, 5, 4],
        [1, 3, 7],
        [1, 7, 5],
        [3, 2, 6],
        [3, 6, 7],
        [2, 0, 4],
        [2, 4, 6],
    ];
    Shape { points, triangles: triangles.to_vec(), claimed_points: None, claimed_triangles: None }
}

/// The cube and a tetrahedron with these corners.
fn with_tet(corners: [[f64; 3]; 4]) -> Shape {
    let mut shape = cube();
    shape.points.extend(corners);
    shape.triangles.extend([[8, 10, 9], [8, 9, 11], [9, 10, 11], [8, 11, 10]]);
    shape
}

const FORMATS: [&str; 11] =
    ["ascii.stl", "binary.stl", "a.off", "a.obj", "a.ply", "a.vtk", "a.vtp", "a.mesh", "a.surf", "a.poly", "a.smesh"];

/// The file in this format; none where it has no indices and the shape needs them.
fn written(format: &str, shape: &Shape) -> Option<Vec<u8>> {
    let np = shape.claimed_points.unwrap_or(shape.points.len() as i64);
    let nt = shape.claimed_triangles.unwrap_or(shape.triangles.len() as i64);
    let mut text = String::new();
    let rows = |text: &mut String, before: &str, after: &str, counted: bool| {
        for (i, [x, y, z]) in shape.points.iter().enumerate() {
            let number = if counted { format!("{i} ") } else { String::new() };
            writeln!(text, "{number}{before}{x:e} {y:e} {z:e}{after}").unwrap();
        }
    };
    let triangles = |text: &mut String, before: &str, after: &str, base: i64| {
        for [a, b, c] in &shape.triangles {
            writeln!(text, "{before}{} {} {}{after}", a + base, b + base, c + base).unwrap();
        }
    };
    let corner = |v: &i64| usize::try_from(*v).ok().and_then(|v| shape.points.get(v));
    match format {
        "ascii.stl" | "binary.stl" => {
            let mut bytes = vec![0; 80];
            bytes.extend((nt as u32).to_le_bytes());
            text.push_str("solid a\n");
            for triangle in &shape.triangles {
                text.push_str("facet normal 0 0 0\nouter loop\n");
                bytes.extend([0; 12]);
                for v in triangle {
                    let point = corner(v)?;
                    writeln!(text, "vertex {:e} {:e} {:e}", point[0], point[1], point[2]).unwrap();
                    bytes.extend(point.iter().flat_map(|&x| (x as f32).to_le_bytes()));
                }
                text.push_str("endloop\nendfacet\n");
                bytes.extend([0; 2]);
            }
            text.push_str("endsolid a\n");
            return Some(if format == "ascii.stl" { text.into_bytes() } else { bytes });
        }
        "a.off" => {
            writeln!(text, "OFF\n{np} {nt} 0").unwrap();
            rows(&mut text, "", "", false);
            triangles(&mut text, "3 ", "", 0);
        }
        "a.obj" => {
            rows(&mut text, "v ", "", false);
            triangles(&mut text, "f ", "", 1);
        }
        "a.ply" => {
            let properties = "property double x\nproperty double y\nproperty double z\n";
            let list = "property list uchar int vertex_indices";
            writeln!(
                text,
                "ply\nformat ascii 1.0\nelement vertex {np}\n{properties}element face {nt}\n{list}\nend_header"
            )
            .unwrap();
            rows(&mut text, "", "", false);
            triangles(&mut text, "3 ", "", 0);
        }
        "a.vtk" => {
            writeln!(text, "# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS {np} double").unwrap();
            rows(&mut text, "", "", false);
            writeln!(text, "POLYGONS {nt} {}", nt.saturating_mul(4)).unwrap();
            triangles(&mut text, "3 ", "", 0);
        }
        "a.vtp" => {
            let array = |name: &str, kind: &str| {
                format!("<DataArray type=\"{kind}\" Name=\"{name}\" NumberOfComponents=\"3\" format=\"ascii\">\n")
            };
            writeln!(text, "<VTKFile type=\"PolyData\" version=\"0.1\" byte_order=\"LittleEndian\"><PolyData>")
                .unwrap();
            writeln!(text, "<Piece NumberOfPoints=\"{np}\" NumberOfPolys=\"{nt}\"><Points>").unwrap();
            text.push_str(&array("Points", "Float64"));
            rows(&mut text, "", "", false);
            text.push_str("</DataArray></Points><Polys>");
            text.push_str(&array("connectivity", "Int64").replace("Components=\"3\"", "Components=\"1\""));
            triangles(&mut text, "", "", 0);
            text.push_str("</DataArray>");
            text.push_str(&array("offsets", "Int64").replace("Components=\"3\"", "Components=\"1\""));
            (0..shape.triangles.len()).for_each(|i| write!(text, "{} ", 3 * i + 3).unwrap());
            text.push_str("</DataArray></Polys></Piece></PolyData></VTKFile>\n");
        }
        "a.mesh" => {
            writeln!(text, "MeshVersionFormatted 2\nDimension 3\nVertices\n{np}").unwrap();
            rows(&mut text, "", " 0", false);
            writeln!(text, "Triangles\n{nt}").unwrap();
            triangles(&mut text, "", " 1", 1);
            text.push_str("End\n");
        }
        "a.surf" => {
            writeln!(text, "{nt} 0 {np}").unwrap();
            rows(&mut text, "", "", false);
            triangles(&mut text, "", " 1 0 1", 1);
        }
        _ => {
            writeln!(text, "{np} 3 0 0").unwrap();
            rows(&mut text, "", "", true);
            writeln!(text, "{nt} 0").unwrap();
            triangles(&mut text, if format == "a.poly" { "1\n3 " } else { "3 " }, "", 0);
            text.push_str("0\n0\n");
        }
    }
    Some(text.into_bytes())
}

/// Runs `surface-to-mesh` on the file; a failure names its cause and leaves nothing behind.
fn ends(folder: &Path, format: &str, bytes: &[u8], code: i32, wanted: &str, what: &str) {
    fs::write(folder.join(format), bytes).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_meshwright"))
        .args(["surface-to-mesh", "--quiet", "--ref", "0", "--output", "mesh.vtu", "--plc", format])
        .current_dir(folder)
        .env_remove("SLICER_HOME")
        .output()
        .expect("the binary was built for this test");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{what}, {format}: {stderr}");
    assert_eq!(folder.join("mesh.vtu").exists(), code == 0, "{what}, {format}");
    if code != 0 {
        assert!(stderr.starts_with("meshwright: ") && stderr.contains(wanted), "{what}, {format}: {stderr}");
        assert_eq!(fs::read_dir(folder).unwrap().count(), 1, "{what}, {format}");
    }
    fs::read_dir(folder).unwrap().for_each(|entry| fs::remove_file(entry.unwrap().path()).unwrap());
}

/// The shape in all formats that can hold it, less those named.
fn all_end(shape: &Shape, code: i32, wanted: &str, what: &str, without: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    for format in FORMATS.into_iter().filter(|f| !without.contains(f)) {
        if let Some(bytes) = written(format, shape) {
            ends(folder.path(), format, &bytes, code, wanted, what);
        }
    }
}

#[test]
fn surfaces_that_bound_nothing_are_refused() {
    all_end(&cube(), 0, "", "the cube", &[]);
    let changed = |change: &dyn Fn(&mut Shape)| {
        let mut shape = cube();
        change(&mut shape);
        shape
    };
    let open = changed(&|s| s.triangles.truncate(11));
    all_end(&open, 3, "open edge", "a triangle missing", &[]);
    let pierced = with_tet([[0.2, 0.3, 0.5], [0.8, 0.3, 0.5], [0.3, 0.7, 0.5], [0.3, 0.3, 1.5]]);
    all_end(&pierced, 3, "intersect", "edges through a face", &[]);
    let overlapping = with_tet([[0.2, 0.2, 1.0], [0.7, 0.2, 1.0], [0.2, 0.7, 1.0], [0.2, 0.2, 2.0]]);
    all_end(&overlapping, 3, "intersect", "faces in one plane", &[]);
    let on_vertex = with_tet([[0.5, 0.3, 1.0], [0.4, 0.3, 2.0], [0.6, 0.3, 2.0], [0.5, 0.6, 2.0]]);
    all_end(&on_vertex, 3, "intersect", "a vertex on a face", &[]);
    let on_edge = with_tet([[0.3, 0.2, 1.0], [0.6, 0.3, 1.0], [0.4, 0.4, 2.0], [0.5, 0.6, 2.0]]);
    all_end(&on_edge, 3, "intersect", "an edge on a face", &[]);
    all_end(&changed(&|s| s.triangles.push(s.triangles[3])), 3, "same vertices", "a triangle twice", &[]);
    all_end(&changed(&|s| s.points[3][1] = f64::NAN), 3, "not finite", "NaN", &[]);
    all_end(&changed(&|s| s.points[3][1] = f64::INFINITY), 3, "not finite", "infinity", &[]);
    all_end(&changed(&|s| s.points[3][1] = 1e300), 3, "too large", "1e300", &["binary.stl"]);
    all_end(&changed(&|s| s.points.fill([1.0; 3])), 3, "all points of the surface are equal", "equal points", &[]);
    all_end(&changed(&|s| (0..8).for_each(|i| s.points[i] = [i as f64; 3])), 3, "one line", "collinear points", &[]);
    all_end(&changed(&|s| s.points.iter_mut().for_each(|p| p[2] *= 0.0)), 3, "one plane", "coplanar points", &[]);
}

#[test]
fn indices_and_counts_that_cannot_be_are_refused() {
    let indexed = |corner: i64| {
        let mut shape = cube();
        shape.triangles[11][2] = corner;
        shape
    };
    all_end(&indexed(99), 3, "point 99", "an index out of range", &["a.obj"]);
    all_end(&indexed(1 << 40), 3, "point 1099511627776", "an index beyond 32 bits", &[]);
    all_end(&indexed(-5), 3, "point -5", "a negative index", &["a.obj"]);
    all_end(&indexed(4), 3, "has the vertices", "an index twice", &[]);
    // Formats without counts have none that could be wrong.
    let countless = ["ascii.stl", "a.obj"];
    let claimed = |points, triangles| Shape { claimed_points: points, claimed_triangles: triangles, ..cube() };
    // Rows of numbers do not show where points end; what is wrong is the claim, so that it is named.
    let less = |kept: &[&str]| -> Vec<&'static str> { FORMATS.into_iter().filter(|f| !kept.contains(f)).collect() };
    let shown = ["a.off", "a.ply", "a.vtk", "a.mesh", "a.poly", "a.smesh", "a.vtp"];
    all_end(&claimed(Some(9), None), 3, "9 points", "9 points claimed", &less(&shown));
    all_end(&claimed(Some(7), None), 3, "7 points", "7 points claimed", &less(&["a.off", "a.ply", "a.vtk", "a.vtp"]));
    let unseen = ["ascii.stl", "a.obj", "a.vtp"];
    all_end(&claimed(None, Some(11)), 3, "more", "11 triangles claimed", &unseen);
    for points in [7, 9, 1 << 31, -3] {
        let without = ["ascii.stl", "a.obj", "binary.stl"];
        all_end(&claimed(Some(points), None), 3, "a.", &format!("{points} points claimed"), &without);
    }
    for triangles in [11, 13, 1 << 31] {
        all_end(&claimed(None, Some(triangles)), 3, "", &format!("{triangles} triangles claimed"), &countless);
    }
    let mut empty = cube();
    empty.triangles.clear();
    all_end(&empty, 3, "triangle", "no triangles", &[]);
}

#[test]
fn damaged_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for format in FORMATS {
        let bytes = written(format, &cube()).unwrap();
        ends(folder.path(), format, b"", 3, "empty", "nothing in the file");
        ends(folder.path(), format, b"hello\nworld\n", 3, format, "prose");
        for tenth in [1, 3, 5, 8] {
            let cut = &bytes[..bytes.len() * tenth / 10];
            ends(folder.path(), format, cut, 3, "", &format!("cut after {tenth} tenths"));
        }
    }
}

#[test]
fn equal_points_are_merged() {
    let mut shape = cube();
    shape.points.push(shape.points[0]);
    for triangle in &mut shape.triangles[..6] {
        triangle.iter_mut().filter(|v| **v == 0).for_each(|v| *v = 8);
    }
    all_end(&shape, 0, "", "a point twice", &[]);
}
