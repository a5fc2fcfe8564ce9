//! Every kind of scan, segmentation and option that cannot be registered, through the command line: the exit code and one line
//! that names the cause, or a warning and a finite field.

use std::fs;
use std::path::Path;
use std::process::Command;

const SIZE: usize = 24;
const SPACING: f64 = 4.0;

/// A value per voxel from its place in mm.
fn values(of: impl Fn([f64; 3]) -> f32) -> Vec<f32> {
    let middle = (SIZE as f64 - 1.0) / 2.0;
    (0..SIZE.pow(3))
        .map(|v| of([v % SIZE, v / SIZE % SIZE, v / SIZE / SIZE].map(|x| (x as f64 - middle) * SPACING)))
        .collect()
}

fn length(p: [f64; 3]) -> f64 {
    p.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Tissue with texture in a ball.
fn tissue(p: [f64; 3]) -> f32 {
    let texture =
        100.0 + 30.0 * (0.2 * p[0] + 0.05 * p[1]).sin() * (0.17 * p[1] - 0.1 * p[2]).cos() + 20.0 * (0.21 * p[2]).sin();
    if length(p) < 38.0 { texture as f32 } else { 0.0 }
}

fn shifted(p: [f64; 3]) -> f32 {
    tissue([p[0] + 2.0 + 0.05 * p[2], p[1], p[2]])
}

fn ball(p: [f64; 3]) -> f32 {
    f32::from(u8::from(length(p) < 38.0))
}

/// An NRRD image at an origin, LPS mm.
fn nrrd(values: &[f32], origin: f64) -> Vec<u8> {
    let mut bytes = format!(
        "NRRD0004\ntype: float\ndimension: 3\nspace: left-posterior-superior\nsizes: {SIZE} {SIZE} {SIZE}\n\
         space directions: ({SPACING},0,0) (0,{SPACING},0) (0,0,{SPACING})\nspace origin: ({origin},{origin},{origin})\n\
         endian: little\nencoding: raw\n\n"
    )
    .into_bytes();
    bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    bytes
}

/// The vectors of an uncompressed field.
fn read_field(path: &Path) -> Vec<f32> {
    let bytes = fs::read(path).unwrap();
    let end = bytes.windows(2).position(|w| w == b"\n\n").unwrap() + 2;
    let header = String::from_utf8_lossy(&bytes[..end]).into_owned();
    let mut data = Vec::new();
    match header.contains("encoding: gz") {
        true => {
            std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&bytes[end..]), &mut data).unwrap();
        }
        false => data.extend_from_slice(&bytes[end..]),
    }
    assert!(header.contains("type: float"), "{header}");
    data.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
}

struct Case {
    fixed: Vec<u8>,
    moving: Vec<u8>,
    labels: Vec<u8>,
}

impl Case {
    fn good() -> Self {
        Self {
            fixed: nrrd(&values(shifted), 0.0),
            moving: nrrd(&values(tissue), 0.0),
            labels: nrrd(&values(ball), 0.0),
        }
    }

    /// Runs `register` with `options`; a failure ends with `code` and one line with `wanted`, and leaves no field. A success
    /// leaves a finite field and says `wanted`.
    fn ends(&self, options: &[&str], code: i32, wanted: &str) {
        let folder = tempfile::tempdir().unwrap();
        let files = [("fixed.nrrd", &self.fixed), ("moving.nrrd", &self.moving), ("labels.nrrd", &self.labels)];
        files.iter().for_each(|(name, bytes)| fs::write(folder.path().join(name), bytes).unwrap());
        let output = Command::new(env!("CARGO_BIN_EXE_meshwright"))
            .args(["register", "--fixed-image", "fixed.nrrd", "--moving-image", "moving.nrrd"])
            .args(["--segmented-image", "labels.nrrd", "--output-deformation-field", "field.nrrd"])
            .args(["--working-spacing", "4", "--num-adaptive-iterations", "2"])
            .args(options)
            .current_dir(folder.path())
            .env_remove("SLICER_HOME")
            .output()
            .expect("the binary was built for this test");
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{wanted} {options:?}: {stderr}");
        assert!(stderr.contains(wanted), "{wanted} {options:?}: {stderr}");
        let field = folder.path().join("field.nrrd");
        if code == 0 {
            let field = read_field(&field);
            assert_eq!(field.len(), 3 * SIZE.pow(3));
            assert!(field.iter().all(|v| v.is_finite()), "{wanted} {options:?}");
        } else {
            assert!(!field.exists(), "{wanted} {options:?} left a field");
            let said: Vec<_> = stderr.lines().filter(|line| line.starts_with("meshwright: ")).collect();
            assert!(!said.is_empty(), "{stderr}");
        }
    }
}

#[test]
fn scans_and_segmentations_that_cannot_be_registered_end_with_3() {
    let good = Case::good;
    Case { fixed: nrrd(&values(shifted), 900.0), ..good() }.ends(&[], 3, "do not overlap");
    Case { labels: nrrd(&values(ball), 900.0), ..good() }.ends(&[], 3, "does not lie on the moving scan");
    Case { labels: nrrd(&values(|_| 0.0), 0.0), ..good() }.ends(&[], 3, "no foreground");
    Case { labels: nrrd(&values(|p| 3.0 * ball(p)), 0.0), ..good() }.ends(
        &[],
        3,
        "label 3 of the segmentation has no material",
    );
    Case { labels: nrrd(&values(|p| 0.5 * ball(p)), 0.0), ..good() }.ends(&[], 3, "whole number");
    Case { fixed: nrrd(&values(|_| 7.0), 0.0), ..good() }.ends(&[], 3, "constant");
    Case { moving: nrrd(&values(|_| 7.0), 0.0), ..good() }.ends(&[], 3, "constant");
    Case { fixed: nrrd(&values(|_| f32::NAN), 0.0), ..good() }.ends(&[], 3, "NaN");
    good().ends(&["--half-window-size-x", "60"], 3, "axis X");
}

#[test]
fn nothing_left_to_fit_ends_with_4() {
    let plain = ["--adaptive", "off"];
    Case::good().ends(&[&plain[..], &["--rejection-fraction", "1"]].concat(), 4, "rejection");
    Case::good().ends(
        &[&plain[..], &["--min-similarity", "1", "--matching-direction", "fixed-to-moving"]].concat(),
        4,
        "correspondence",
    );
}

#[test]
fn what_can_be_worked_around_is_said_and_the_field_is_finite() {
    let holes = |p: [f64; 3]| if length([p[0] - 10.0, p[1], p[2]]) < 7.0 { f32::NAN } else { shifted(p) };
    Case { fixed: nrrd(&values(holes), 0.0), ..Case::good() }.ends(&[], 0, "not finite and count as outside");
    let infinite = |p: [f64; 3]| if p[0] > 45.0 { f32::INFINITY } else { tissue(p) };
    Case { moving: nrrd(&values(infinite), 0.0), ..Case::good() }.ends(&[], 0, "not finite and count as outside");
    for solver in ["iccg", "bjcg", "jcg", "bicgstab", "lsqr"] {
        let options = ["--solver", solver, "--solver-max-iterations", "1", "--solver-tolerance", "1e-14"];
        Case::good().ends(&options, 0, "solver stopped");
    }
    // A second piece of tissue that the fixed scan does not show: without a match nothing would hold it.
    let two = |p: [f64; 3]| {
        if length([p[0] - 20.0, p[1], p[2]]) < 16.0 || length([p[0] + 20.0, p[1], p[2]]) < 16.0 { 1.0 } else { 0.0 }
    };
    let one = |p: [f64; 3]| if p[0] > 0.0 { shifted(p) * two(p) } else { 0.0 };
    let pieces = Case {
        fixed: nrrd(&values(one), 0.0),
        moving: nrrd(&values(|p| tissue(p) * two(p)), 0.0),
        labels: nrrd(&values(two), 0.0),
    };
    for solver in ["iccg", "direct"] {
        pieces.ends(&["--solver", solver, "--rigid-initialization", "off", "--adaptive", "off"], 0, "");
    }
}
