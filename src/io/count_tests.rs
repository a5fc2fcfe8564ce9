//! Counts that do not match the rows: refused by every reader, with the counts.

use std::path::Path;

use super::read_surface;

const POINTS: [&str; 4] = ["0 0 0", "1 0 0", "0 1 0", "0 0 1"];

/// The points and the triangles of a tet, each row with something before and behind it; nodes count from `base`.
fn rows(base: usize, (number_points, before, behind): (bool, &str, &str)) -> (String, String) {
    let number = |i: usize| if number_points { format!("{} ", i + base) } else { String::new() };
    let points = POINTS.iter().enumerate().map(|(i, p)| format!("{}{p}\n", number(i))).collect();
    let faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]].map(|f| f.map(|v| v + base));
    (points, faces.map(|[a, b, c]| format!("{before}{a} {b} {c}{behind}\n")).concat())
}

/// The tet in a format, with counts that may be wrong.
fn written(format: &str, points: usize, faces: usize) -> String {
    match format {
        "a.mesh" => {
            let (p, f) = rows(1, (false, "", " 7"));
            let p = p.replace('\n', " 0\n");
            format!("MeshVersionFormatted 2\nDimension 3\nVertices\n{points}\n{p}\nTriangles\n{faces}\n{f}\nEnd\n")
        }
        "a.surf" => {
            let (p, f) = rows(1, (false, "", " 1 0 1"));
            format!("{faces} 0 {points}\n{p}{f}\n")
        }
        "a.smesh" => {
            let (p, f) = rows(0, (true, "3 ", ""));
            format!("# a tet\n{points} 3 0 0\n{p}{faces} 0\n{f}0 # holes\n0 # regions\n\n# the end\n")
        }
        "a.poly" => {
            let (p, f) = rows(0, (true, "1\n3 ", ""));
            format!("{points} 3 0 0\n{p}{faces} 0\n{f}0\n")
        }
        _ => {
            let (p, f) = rows(0, (false, "3 ", ""));
            let head = "# vtk DataFile Version 3.0\nt\nASCII\nDATASET POLYDATA";
            format!("{head}\nPOINTS {points} double\n{p}POLYGONS {faces} {}\n{f}\n", 4 * faces)
        }
    }
}

fn refusal(folder: &Path, format: &str, text: &str) -> String {
    let path = folder.join(format);
    std::fs::write(&path, text).unwrap();
    read_surface(&path).map(|_| ()).expect_err(format).to_string()
}

#[test]
fn counts_that_do_not_match_are_named() {
    let folder = tempfile::tempdir().unwrap();
    for format in ["a.mesh", "a.surf", "a.smesh", "a.poly", "a.vtk"] {
        let path = folder.path().join(format);
        std::fs::write(&path, written(format, 4, 4)).unwrap();
        let surface = read_surface(&path).unwrap();
        assert_eq!((surface.points.len(), surface.facets.len()), (4, 4), "{format}");
        let fewer = refusal(folder.path(), format, &written(format, 4, 3));
        assert!(fewer.contains("more than the") && fewer.contains('3'), "{format}: {fewer}");
        for (points, faces) in [(4, 5), (3, 4), (5, 4)] {
            let wrong = refusal(folder.path(), format, &written(format, points, faces));
            assert!(wrong.contains("line"), "{format}: {wrong}");
        }
        let appended = refusal(folder.path(), format, &(written(format, 4, 4) + "1 2 3 4\n"));
        assert!(appended.contains("more than the") && appended.contains('4'), "{format}: {appended}");
    }
}

#[test]
fn counts_of_points_are_named() {
    let folder = tempfile::tempdir().unwrap();
    for format in ["a.mesh", "a.surf", "a.smesh", "a.poly", "a.vtk"] {
        for points in [3, 5] {
            let wrong = refusal(folder.path(), format, &written(format, points, 4));
            assert!(wrong.contains(&format!("{points} ")) && wrong.contains("claimed"), "{format}: {wrong}");
        }
    }
}

#[test]
fn counts_of_points_in_node_files_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let facets = format!("0 3 0 0\n4 0\n{}0\n", rows(0, (true, "1\n3 ", "")).1);
    for points in [3, 5] {
        let nodes = rows(0, (true, "", "")).0;
        std::fs::write(folder.path().join("a.node"), format!("{points} 3 0 0\n{nodes}")).unwrap();
        let wrong = refusal(folder.path(), "a.poly", &facets);
        assert!(wrong.contains(&format!("{points} points")) && wrong.contains("claimed"), "{wrong}");
    }
}

#[test]
fn entries_that_no_cell_takes_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let text = written("a.vtk", 4, 4).replace("POLYGONS 4 16", "POLYGONS 3 16");
    let refused = refusal(folder.path(), "a.vtk", &text);
    assert!(refused.contains("12 entries") && refused.contains("3 cells with 16 entries"), "{refused}");
}

#[test]
fn bytes_that_no_binary_medit_block_takes_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.meshb");
    // Version 2: places of four bytes, reals of eight.
    let file = |faces: i32, rest: &[u8]| {
        let mut bytes: Vec<u8> = [1, 2, 3, 20, 3, 4, 20 + 12 + 4 * 28, 4].map(i32::to_le_bytes).concat();
        for point in POINTS {
            bytes.extend(point.split(' ').flat_map(|c| c.parse::<f64>().unwrap().to_le_bytes()));
            bytes.extend(0_i32.to_le_bytes());
        }
        let end = bytes.len() as i32 + 12 + 4 * 16;
        bytes.extend([6, end, faces].map(i32::to_le_bytes).concat());
        bytes.extend(
            [[1, 3, 2, 7], [1, 2, 4, 7], [2, 3, 4, 7], [3, 1, 4, 7]]
                .as_flattened()
                .iter()
                .flat_map(|v: &i32| v.to_le_bytes()),
        );
        bytes.extend([54, 0].map(i32::to_le_bytes).concat());
        bytes.extend(rest);
        std::fs::write(&path, bytes).unwrap();
        read_surface(&path)
    };
    assert_eq!(file(4, &[]).unwrap().facets.len(), 4);
    assert_eq!(file(4, &[0; 8]).unwrap().facets.len(), 4);
    let fewer = file(3, &[]).unwrap_err().to_string();
    assert!(fewer.contains("16 bytes more") && fewer.contains("3 elements"), "{fewer}");
    let appended = file(4, &[1; 16]).unwrap_err().to_string();
    assert!(appended.contains("16 bytes behind the end"), "{appended}");
}
