//! Mesh and surface files: what is written comes back, and no file, however cut, does more than end in an error.

use std::fs;
use std::path::{Path, PathBuf};

use glam::DVec3;
use meshwright::index::VertexId;
use meshwright::io::{self, Compression, Encoding, MeshFormat, SurfaceExport, SurfaceSelection, WriteOptions};
use meshwright::mesh::boundary::extract_boundary;
use meshwright::mesh::mixed_mesh::{ArrayData, MixedMesh, NamedArray, Space};
use meshwright::mesh::surface_mesh::SurfaceMesh;
use meshwright::{Error, FindingCode};

/// Every ending of a volume mesh with the options it is tried with.
const VOLUME: [(&str, MeshFormat); 11] = [
    ("a.vtu", MeshFormat::Vtu),
    ("b.vtk", MeshFormat::Vtk42),
    ("c.vtk", MeshFormat::Vtk51),
    ("d.msh", MeshFormat::Msh22),
    ("e.msh", MeshFormat::Msh41),
    ("f.mesh", MeshFormat::Medit),
    ("g.meshb", MeshFormat::MeditBinary),
    ("h.ugrid", MeshFormat::Ugrid),
    ("i.b8.ugrid", MeshFormat::UgridBig),
    ("j.lb8.ugrid", MeshFormat::UgridLittle),
    ("k.su2", MeshFormat::Su2),
];

const SURFACE: [&str; 6] = ["a.off", "b.obj", "c.stl", "d.ply", "e.vtp", "f.surf"];

/// Two labels: tets, a pyramid, a wedge and a hexahedron, apart from one another.
fn mixed_mesh() -> MixedMesh {
    let unit = [
        (0., 0., 0.),
        (1., 0., 0.),
        (1., 1., 0.),
        (0., 1., 0.),
        (0., 0., 1.),
        (1., 0., 1.),
        (1., 1., 1.),
        (0., 1., 1.),
    ];
    let mut points = Vec::new();
    for copy in 0..4 {
        points.extend(unit.map(|(x, y, z)| DVec3::new(x + 2.1 * f64::from(copy), y / 3.0, z * 1e-3 + 1e6)));
    }
    let elements: [(u8, Vec<u32>, i32); 5] = [
        (10, vec![0, 1, 2, 5], 3),
        (10, vec![0, 2, 3, 7], 8),
        (14, vec![8, 9, 10, 11, 12], 3),
        (13, vec![16, 18, 17, 20, 22, 21], 8),
        (12, (24..32).collect(), 3),
    ];
    let mut mesh = MixedMesh { points, offsets: vec![0], space: Space::Lps, ..MixedMesh::default() };
    for (kind, nodes, label) in elements {
        mesh.types.push(kind);
        mesh.connectivity.extend(nodes.into_iter().map(VertexId));
        mesh.offsets.push(mesh.connectivity.len() as i64);
        mesh.labels.push(label);
    }
    mesh.boundary = extract_boundary(&mesh);
    let array = |name: &str, components, data| NamedArray { name: name.into(), components, data };
    mesh.element_data = vec![array("value", 1, ArrayData::Real(vec![0.5, -1.0, 1e-300, 2.0, 1.0 / 3.0]))];
    mesh.point_data = vec![array("moved", 3, ArrayData::Real((0..96).map(f64::from).collect()))];
    mesh.check_shape().unwrap();
    mesh
}

fn tetrahedron_surface() -> SurfaceMesh {
    let points = vec![DVec3::ZERO, DVec3::X, DVec3::new(0.0, 1.0 / 3.0, 0.0), DVec3::new(0.0, 0.0, 1e-5)];
    SurfaceMesh::new(points, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]].map(|f| f.map(VertexId)).to_vec())
}

/// Elements as sorted rows of type, label and nodes: formats may group them.
fn rows(mesh: &MixedMesh, with_labels: bool) -> Vec<(u8, i32, Vec<u32>)> {
    let mut rows: Vec<_> = (0..mesh.element_count())
        .map(|i| {
            let label = if with_labels { mesh.labels[i] } else { 0 };
            (mesh.types[i], label, mesh.element(i).1.iter().map(|v| v.0).collect())
        })
        .collect();
    rows.sort();
    rows
}

fn write(mesh: &MixedMesh, path: &Path, format: MeshFormat, encoding: Encoding) {
    let options = WriteOptions { format: Some(format), encoding, ..WriteOptions::default() };
    io::write_mesh(mesh, path, &options).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
}

#[test]
fn every_volume_format_brings_the_mesh_back() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = mixed_mesh();
    for (name, format) in VOLUME {
        for encoding in [Encoding::Binary, Encoding::Ascii] {
            let path = folder.path().join(name);
            write(&mesh, &path, format, encoding);
            let back = io::read_mesh(&path).unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!(back.points, mesh.points, "{name}");
            // The formats of flow solvers have no labels.
            let labelled = !name.ends_with("ugrid") && !name.ends_with("su2");
            assert_eq!(rows(&back, labelled), rows(&mesh, labelled), "{name} {encoding:?}");
            if name.ends_with("vtu") || name.ends_with("vtk") {
                assert_eq!(back.element_data, mesh.element_data, "{name}");
                assert_eq!(back.point_data, mesh.point_data, "{name}");
                assert_eq!(back.space, Space::Lps, "{name}");
            } else {
                assert_eq!(back.boundary.triangles.len(), mesh.boundary.triangles.len(), "{name}");
                assert_eq!(back.boundary.quads.len(), mesh.boundary.quads.len(), "{name}");
            }
        }
    }
}

#[test]
fn formats_hold_what_they_say() {
    let folder = tempfile::tempdir().unwrap();
    let (mesh, surface) = (mixed_mesh(), tetrahedron_surface());
    let names = VOLUME.iter().map(|(name, _)| *name).chain(SURFACE).chain(["a.poly", "a.smesh", "case.foam"]);
    for name in names {
        let (path, format) = (folder.path().join(name), MeshFormat::of_path(Path::new(name)).unwrap());
        let written = io::write_surface(&surface, &path, &WriteOptions::default());
        assert_eq!(written.is_ok(), format.holds_lone_surface(), "{name}: {written:?}");
        let written = io::write_mesh(&mesh, &path, &WriteOptions::default());
        let elements = io::read_mesh(&path).map(|m| m.element_count());
        // OpenFOAM cases are not read.
        let is_whole = written.is_ok() && (name == "case.foam" || elements.is_ok_and(|n| n == mesh.element_count()));
        assert_eq!(is_whole, format.holds_elements(), "{name}");
    }
}

#[test]
fn packed_blocks_come_back() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = mixed_mesh();
    let path = folder.path().join("a.vtu");
    let options = WriteOptions { compression: Compression::Zlib, ..WriteOptions::default() };
    io::write_mesh(&mesh, &path, &options).unwrap();
    assert_eq!(io::read_mesh(&path).unwrap().points, mesh.points);
}

#[test]
fn quadratic_tets_come_back() {
    let folder = tempfile::tempdir().unwrap();
    let corners = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
    let edges = meshwright::mesh::numbering::QUADRATIC_TET_EDGES;
    let points = corners.into_iter().chain(edges.map(|[a, b]| (corners[a] + corners[b]) / 2.0)).collect();
    let mesh = MixedMesh {
        points,
        types: vec![24],
        offsets: vec![0, 10],
        connectivity: (0..10).map(VertexId).collect(),
        labels: vec![2],
        ..MixedMesh::default()
    };
    for (name, format) in &VOLUME[..7] {
        let path = folder.path().join(name);
        write(&mesh, &path, *format, Encoding::Binary);
        assert_eq!(rows(&io::read_mesh(&path).unwrap(), true), rows(&mesh, true), "{name}");
    }
    let path = folder.path().join("x.su2");
    assert!(matches!(io::write_mesh(&mesh, &path, &WriteOptions::default()), Err(Error::Unsupported { .. })));
    assert!(!path.exists());
}

#[test]
fn frames_turn_by_half_about_the_third_axis() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = mixed_mesh();
    let path = folder.path().join("a.vtk");
    let options = WriteOptions { space: Some(Space::Ras), ..WriteOptions::default() };
    io::write_mesh(&mesh, &path, &options).unwrap();
    let back = io::read_mesh(&path).unwrap();
    assert_eq!(back.space, Space::Ras);
    assert_eq!(back.points[5] * DVec3::new(-1.0, -1.0, 1.0), mesh.points[5]);
    let text = String::from_utf8_lossy(&fs::read(&path).unwrap()[..80]).into_owned();
    assert!(text.lines().nth(1).unwrap().contains("SPACE=RAS"));
}

#[test]
fn surfaces_keep_every_bit_of_their_points() {
    let folder = tempfile::tempdir().unwrap();
    let surface = tetrahedron_surface();
    for name in SURFACE {
        let path = folder.path().join(name);
        let options = WriteOptions { encoding: Encoding::Ascii, ..WriteOptions::default() };
        io::write_surface(&surface, &path, &options).unwrap();
        let back = io::read_surface(&path).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(back.facets.len(), 4, "{name}");
        for ours in &back.points {
            assert!(surface.points.contains(ours), "{name}: {ours}");
        }
        if !name.ends_with("stl") {
            assert_eq!((back.points, back.facets), (surface.points.clone(), surface.facets.clone()), "{name}");
        }
    }
}

#[test]
fn label_surfaces_are_closed_and_outward() {
    let points = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z, DVec3::ONE];
    let tets = [[0, 1, 2, 3], [1, 2, 3, 4]].map(|t: [u32; 4]| t.map(VertexId));
    let mut mesh = MixedMesh::from_tets(points, &tets, vec![7, 2]).unwrap();
    mesh.boundary = extract_boundary(&mesh);
    for label in [2, 7] {
        let surface = SurfaceExport::of_mesh(&mesh, SurfaceSelection::Label(label)).unwrap().surface;
        let volume: f64 = surface
            .facets
            .iter()
            .map(|f| f.map(|v| surface.points[v.index()]))
            .map(|[a, b, c]| a.dot(b.cross(c)) / 6.0)
            .sum();
        assert_eq!(surface.facets.len(), 4);
        assert!(volume > 0.1, "label {label}: {volume}");
    }
    let pair = SurfaceExport::of_mesh(&mesh, SurfaceSelection::Pair(7, 2)).unwrap();
    assert_eq!(pair.surface.facets.len(), 1);
    assert!(SurfaceExport::of_mesh(&mesh, SurfaceSelection::Label(9)).is_err());
}

/// Small files of every format that is read.
fn samples(folder: &Path) -> Vec<PathBuf> {
    let mesh = mixed_mesh();
    let mut paths = Vec::new();
    for (name, format) in VOLUME {
        for encoding in [Encoding::Binary, Encoding::Ascii] {
            let path = folder.join(format!("{encoding:?}-{name}"));
            write(&mesh, &path, format, encoding);
            paths.push(path);
        }
    }
    for name in SURFACE {
        for encoding in [Encoding::Binary, Encoding::Ascii] {
            let path = folder.join(format!("{encoding:?}-surface-{name}"));
            let options = WriteOptions { encoding, ..WriteOptions::default() };
            io::write_surface(&tetrahedron_surface(), &path, &options).unwrap();
            paths.push(path);
        }
    }
    let poly = folder.join("x.poly");
    fs::write(&poly, "4 3 0 0\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n4 1\n1 0 5\n3 1 3 2\n1 0 5\n3 1 2 4\n1\n3 1 4 3\n1\n3 2 3 4\n0\n1\n1 .1 .1 .1 3 0.5\n").unwrap();
    paths.push(poly);
    paths
}

#[test]
fn a_file_cut_anywhere_never_panics() {
    let folder = tempfile::tempdir().unwrap();
    for path in samples(folder.path()) {
        let bytes = fs::read(&path).unwrap();
        // The head byte by byte, the rest in steps: the same code reads all of it.
        let step = (bytes.len() / 400).max(1);
        for length in (0..bytes.len().min(300)).step_by(3).chain((300..bytes.len()).step_by(step)) {
            fs::write(&path, &bytes[..length]).unwrap();
            let _ = io::read_content(&path);
            let _ = io::read_surface(&path);
        }
        assert!(!matches!(fs::write(&path, b"").map(|()| io::read_content(&path)), Ok(Ok(_))));
    }
}

#[test]
fn a_file_with_wrong_bytes_never_panics() {
    let folder = tempfile::tempdir().unwrap();
    // A linear congruential generator with a fixed seed.
    let mut state = 12345u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize
    };
    for path in samples(folder.path()) {
        let bytes = fs::read(&path).unwrap();
        for _ in 0..20 {
            let mut broken = bytes.clone();
            for _ in 0..3 {
                let at = random() % broken.len();
                broken[at] = random() as u8;
            }
            fs::write(&path, &broken).unwrap();
            let _ = io::read_content(&path);
        }
    }
}

#[test]
fn claims_that_the_file_cannot_hold_are_refused_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let cases: [(&str, &[u8]); 9] = [
        ("a.off", b"OFF\n2147483648 1 0\n0 0 0\n"),
        ("b.off", b"OFF\n3 2147483648 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"),
        ("c.ply", b"ply\nformat ascii 1.0\nelement vertex 4294967296\nproperty float x\nproperty float y\nproperty float z\nend_header\n"),
        ("d.stl", b"                                                                                \xff\xff\xff\x7f0123456789"),
        ("e.mesh", b"MeshVersionFormatted 2\nDimension 3\nVertices\n99999999999\n0 0 0 0\n"),
        ("f.surf", b"2147483647 0 3\n0 0 0\n"),
        ("g.poly", b"2147483647 3 0 0\n1 0 0 0\n"),
        ("h.vtk", b"# vtk DataFile Version 4.2\nx\nBINARY\nDATASET UNSTRUCTURED_GRID\nPOINTS 9999999999 double\n"),
        ("i.ugrid", b"2147483647 1 1 1 1 1 1\n"),
    ];
    for (name, bytes) in cases {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        let error = io::read_content(&path).unwrap_err();
        assert!(matches!(error, Error::Format { .. }), "{name}: {error}");
    }
}

#[test]
fn bad_indices_are_findings_and_nan_passes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.off");
    fs::write(&path, "OFF\n3 2 0\n0 0 0\n1 0 nan\n0 1 0\n3 0 1 7\n3 0 -1 2\n").unwrap();
    let error = io::read_surface(&path).unwrap_err();
    let ids: Vec<_> = error.findings().iter().map(|f| (f.code, f.ids)).collect();
    assert_eq!(ids, [(FindingCode::IndexOutOfRange, [0, 7]), (FindingCode::IndexOutOfRange, [1, -1])]);
    fs::write(&path, "OFF\n3 1 0\n0 0 0\n1 0 nan\n0 1 0\n3 0 1 2\n").unwrap();
    assert!(io::read_surface(&path).unwrap().points[1].z.is_nan());
}

#[test]
fn errors_name_the_line() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.off");
    fs::write(&path, "OFF\n3 1 0\n0 0 0\n1 0 x\n0 1 0\n3 0 1 2\n").unwrap();
    assert!(io::read_surface(&path).unwrap_err().to_string().contains("line 4: 'x'"));
}
