//! The command line: exit codes, both spellings, one line on stderr, nothing half-written.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

const TET: &str = "MeshVersionFormatted 2\nDimension 3\nVertices\n4\n0 0 0 0\n1 0 0 0\n0 1 0 0\n0 0 1 0\nTetrahedra\n1\n1 2 3 4 6\nEnd\n";

fn meshwright(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_meshwright"))
        .args(arguments)
        .current_dir(folder)
        .env_remove("SLICER_HOME")
        .output()
        .expect("the binary was built for this test")
}

/// Runs, and checks the exit code and that a failure is one line on stderr.
fn ends_with(folder: &Path, arguments: &[&str], code: i32) -> String {
    let output = meshwright(folder, arguments);
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {stderr}");
    if code != 0 {
        assert!(stderr.starts_with("meshwright: "), "{arguments:?}: {stderr}");
    }
    stderr
}

#[test]
fn exit_codes_say_what_kind_of_failure_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("tet.mesh"), TET).unwrap();
    fs::write(folder.join("empty.nii"), "").unwrap();
    fs::write(folder.join("wrong.nrrd"), "this is no image").unwrap();
    ends_with(folder, &[], 2);
    ends_with(folder, &["no-such-command"], 2);
    ends_with(folder, &["info"], 2);
    ends_with(folder, &["info", "missing.nii"], 5);
    ends_with(folder, &["info", "empty.nii"], 3);
    ends_with(folder, &["info", "wrong.nrrd"], 3);
    ends_with(folder, &["info", "tet.mesh"], 0);
    ends_with(folder, &["convert", "tet.mesh", "tet.vtu"], 0);
    ends_with(folder, &["convert", "tet.mesh", "missing/tet.vtu"], 5);
    ends_with(folder, &["convert", "tet.mesh", "tet.unknown"], 2);
    ends_with(folder, &["convert", "tet.mesh", "tet.nii"], 2);
    if cfg!(target_os = "linux") {
        ends_with(folder, &["convert", "tet.mesh", "/dev/full"], 5);
    }
    let mut names: Vec<_> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["empty.nii", "tet.mesh", "tet.vtu", "wrong.nrrd"]);
}

#[test]
fn values_out_of_range_are_refused_under_both_spellings() {
    let folder = tempfile::tempdir().unwrap();
    for flag in ["--lattice-spacing", "--latticeSpacing", "-latticeSpacing", "--lattice_spacing"] {
        for value in ["0", "nan", "-1", "x"] {
            let line = ends_with(folder.path(), &["image-to-mesh", flag, value], 2);
            assert!(line.contains("lattice-spacing"), "{flag} {value}: {line}");
        }
    }
    for value in ["0", "1.5", "nan"] {
        ends_with(folder.path(), &["image-to-mesh", "--fidelity", value], 2);
        ends_with(folder.path(), &["image-to-mesh", "--fidelity-for", &format!("3={value}")], 2);
    }
    let line = ends_with(folder.path(), &["image-to-mesh", "--latice-spacing", "3"], 2);
    assert!(line.contains("did you mean '--lattice-spacing'"), "{line}");
}

#[test]
fn slicer_gets_a_description_of_every_job() {
    let folder = tempfile::tempdir().unwrap();
    for job in ["image-to-mesh", "surface-to-mesh", "register"] {
        let output = meshwright(folder.path(), &[job, "--xml"]);
        assert!(output.status.success());
        let xml = String::from_utf8(output.stdout).unwrap();
        let document = roxmltree::Document::parse(&xml).unwrap();
        let mut flags: Vec<&str> =
            document.descendants().filter(|n| n.has_tag_name("longflag")).filter_map(|n| n.text()).collect();
        assert!(flags.len() > 10);
        let count = flags.len();
        flags.sort_unstable();
        flags.dedup();
        assert_eq!(flags.len(), count, "{job}: a flag stands twice");
    }
}

#[test]
fn quality_measures_a_tet() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("tet.mesh"), TET).unwrap();
    let output = meshwright(folder.path(), &["quality", "tet.mesh", "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let value: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(value["valid"], true);
    assert_eq!(value["statistics"]["label"]["6"]["elements"], 1);
    let volume = value["statistics"]["label"]["6"]["volume"].as_f64().unwrap();
    assert!((volume - 1.0 / 6.0).abs() < 1e-15);
}
