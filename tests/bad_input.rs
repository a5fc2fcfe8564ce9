//! Every kind of bad input, through the command line: the exit code, one line that names the cause, nothing written.

use std::fs;
use std::path::Path;
use std::process::Command;

const SIZE: usize = 12;

/// A ball of label 1.
fn ball() -> Vec<u8> {
    let middle = (SIZE as f64 - 1.0) / 2.0;
    let place = |v: usize| (v as f64 - middle).powi(2);
    (0..SIZE.pow(3))
        .map(|v| u8::from(place(v % SIZE) + place(v / SIZE % SIZE) + place(v / SIZE / SIZE) < 20.0))
        .collect()
}

/// An NRRD image of the given type, sizes and axes over `voxels`.
fn nrrd(kind: &str, sizes: &str, axes: &str, voxels: &[u8]) -> Vec<u8> {
    let dimension = sizes.split(' ').count();
    let mut bytes = format!(
        "NRRD0004\ntype: {kind}\ndimension: {dimension}\nsizes: {sizes}\n{axes}endian: little\nencoding: raw\n\n"
    )
    .into_bytes();
    bytes.extend_from_slice(voxels);
    bytes
}

fn bytes_of<T: Copy, const N: usize>(
    values: &[u8],
    convert: impl Fn(u8) -> T,
    bytes: impl Fn(T) -> [u8; N],
) -> Vec<u8> {
    values.iter().flat_map(|&v| bytes(convert(v))).collect()
}

/// Runs `image-to-mesh` on a file of the given bytes and checks how it ends; a failure leaves no other file behind.
fn meshes(folder: &Path, name: &str, image: &[u8], options: &[&str], code: i32, wanted: &str) {
    fs::write(folder.join(name), image).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_meshwright"))
        .args(["image-to-mesh", "--quiet", "--image", name])
        .args(options)
        .args(if options.contains(&"--output") { &[][..] } else { &["--output", "mesh.vtu"] })
        .current_dir(folder)
        .env_remove("SLICER_HOME")
        .output()
        .expect("the binary was built for this test");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{name} {options:?}: {stderr}");
    let mut left: Vec<_> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name()).collect();
    left.retain(|f| f != name);
    if code == 0 {
        assert_eq!(left, ["mesh.vtu"], "{name} {options:?}");
        fs::remove_file(folder.join("mesh.vtu")).unwrap();
    } else {
        assert!(left.is_empty(), "{name} {options:?} left {left:?}");
        assert!(stderr.starts_with("meshwright: ") && stderr.lines().count() == 1, "{name} {options:?}: {stderr}");
        assert!(stderr.contains(wanted), "{name} {options:?}: {stderr}");
    }
    fs::remove_file(folder.join(name)).unwrap();
}

#[test]
fn files_that_are_no_label_image_end_with_3() {
    let folder = tempfile::tempdir().unwrap();
    let image = |kind: &str, sizes: &str, axes: &str, voxels: &[u8], wanted: &str| {
        meshes(folder.path(), "a.nrrd", &nrrd(kind, sizes, axes, voxels), &[], 3, wanted);
    };
    let ball = ball();
    meshes(folder.path(), "a.nrrd", b"", &[], 3, "empty");
    meshes(folder.path(), "a.nrrd", b"this is\nno image\n", &[], 3, "not an NRRD");
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut packed, &[7; 5000]).unwrap();
    let packed = packed.finish().unwrap();
    meshes(folder.path(), "a.nii.gz", &packed[..packed.len() / 2], &[], 3, "a.nii.gz");
    image("uchar", "1048576 1024 1024", "", &ball, "claims");
    image("uchar", "12 144", "", &ball, "2-D");
    image("uchar", "12 12 4 3", "", &ball, "4-D");
    let axes = |rows: &str| format!("space: left-posterior-superior\nspace directions: {rows}\n");
    image("uchar", "12 12 12", &axes("(1,0,0) (1,0,0) (0,0,1)"), &ball, "singular");
    image("uchar", "12 12 12", &axes("(0,0,0) (0,1,0) (0,0,1)"), &ball, "space direction");
    image("uchar", "12 12 12", "spacings: 1 0 1\n", &ball, "spacing");
    image("uchar", "12 12 12", "spacings: 1 1 -2\n", &ball, "spacing");
    image("uchar", "12 12 12", "spacings: nan 1 1\n", &ball, "spacing");
    for spacings in ["1e-300 1 1", "1e-7 1 1", "1e300 1e300 1e300", "1e-40 1e-40 1e-40", "1 1 1e7"] {
        image("uchar", "12 12 12", &format!("spacings: {spacings}\n"), &ball, "is not within 1e-6 and 1e6 mm");
    }
    for spacings in ["1e-5 1 1", "1e-3 1 1", "1 1 1000"] {
        image("uchar", "12 12 12", &format!("spacings: {spacings}\n"), &ball, "voxels are too long to be meshed");
    }
    let halves = bytes_of(&ball, |v| f32::from(v) * 1.5, f32::to_le_bytes);
    image("float", "12 12 12", "", &halves, "not a whole number");
    let negative = bytes_of(&ball, |v| -i16::from(v), i16::to_le_bytes);
    image("short", "12 12 12", "", &negative, "negative label");
    image("uchar", "12 12 12", "", &vec![0; ball.len()], "no foreground");
    let many: Vec<u8> = (0..70_000u32).flat_map(u32::to_le_bytes).collect();
    image("uint", "10 70 100", "", &many, "65535");
}

#[test]
fn options_that_cannot_be_end_with_2() {
    let folder = tempfile::tempdir().unwrap();
    let good = nrrd("uchar", "12 12 12", "", &ball());
    let ends = |options: &[&str], wanted: &str| meshes(folder.path(), "a.nrrd", &good, options, 2, wanted);
    for value in ["0", "nan", "1000"] {
        ends(&["--lattice-spacing", value], "lattice-spacing");
    }
    for value in ["0", "1.5", "nan"] {
        ends(&["--fidelity", value], "fidelity");
        ends(&["--fidelity-for", &format!("1={value}")], "fidelity");
    }
    ends(&["--fidelity-for", "9=0.9"], "label 9 is not in the image");
    ends(&["--no-such-option", "3"], "--no-such-option");
}

#[test]
fn outputs_that_cannot_be_written_end_with_5() {
    let folder = tempfile::tempdir().unwrap();
    let good = nrrd("uchar", "12 12 12", "", &ball());
    let ends = |output: &str, wanted: &str| meshes(folder.path(), "a.nrrd", &good, &["--output", output], 5, wanted);
    ends("missing/mesh.vtu", "missing/mesh.vtu");
    if cfg!(target_os = "linux") {
        ends("/dev/full", "/dev/full");
    }
}

#[test]
fn one_voxel_and_whole_numbers_in_floating_point_are_meshed() {
    let folder = tempfile::tempdir().unwrap();
    let mut one = vec![0; 27];
    one[13] = 9;
    meshes(folder.path(), "a.nrrd", &nrrd("uchar", "3 3 3", "", &one), &[], 0, "");
    meshes(folder.path(), "a.nrrd", &nrrd("uchar", "1 1 1", "", &[9]), &[], 0, "");
    let whole = bytes_of(&ball(), |v| f32::from(v) * 3.0, f32::to_le_bytes);
    meshes(folder.path(), "a.nrrd", &nrrd("float", "12 12 12", "", &whole), &[], 0, "");
}
