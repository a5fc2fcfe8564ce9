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

/// An NRRD image of 12 x 12 x 12 voxels of 1 mm with a block of label 1.
fn block() -> Vec<u8> {
    let mut bytes = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 12 12 12\nencoding: raw\n\n".to_vec();
    bytes
        .extend((0..12 * 12 * 12).map(|v| u8::from([v % 12, v / 12 % 12, v / 144].iter().all(|x| (3..9).contains(x)))));
    bytes
}

#[test]
fn quality_beside_an_image_has_the_figures_of_the_run() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("a.nrrd"), block()).unwrap();
    let label_1 = |arguments: &[&str]| {
        let output = meshwright(folder.path(), arguments);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let value: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        value["statistics"]["label"]["1"].clone()
    };
    let evaluated = ["--evaluate-volume", "--evaluate-fidelity", "--json"];
    let run = label_1(&[&["image-to-mesh", "--image", "a.nrrd", "--output", "a.vtu"][..], &evaluated].concat());
    let found = label_1(&["quality", "a.vtu", "--image", "a.nrrd", "--json"]);
    for name in ["hausdorff", "mean_distance", "volume", "voxel_volume", "volume_error"] {
        let [expected, found] = [&run, &found].map(|label| label[name].as_f64().unwrap());
        assert!((found - expected).abs() <= 1e-9 * expected.abs(), "{name}: {found} and {expected}");
    }
    assert!(found["f1"].as_f64().unwrap() > 0.8 && found["voxel_volume"] == 216.0);
}

const TETRAHEDRON: &str = "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n";

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn no_output_replaces_an_input_or_another_output() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::create_dir(folder.join("sub")).unwrap();
    // Labels may be in a file of any name.
    for file in ["a.vtu", "m.txt", "a.nrrd"] {
        fs::write(folder.join(file), block()).unwrap();
    }
    fs::write(folder.join("s-1.off"), TETRAHEDRON).unwrap();
    fs::write(folder.join("tet.mesh"), TET).unwrap();
    let mut left = names(folder);
    let mesh = |image: &str, rest: &[&str], wanted: &str| {
        let line = ends_with(folder, &[&["image-to-mesh", "--image", image], rest].concat(), 2);
        assert!(line.contains(wanted), "{rest:?}: {line}");
    };
    mesh("a.vtu", &["--output", "a.vtu"], "'output': a.vtu is the file of 'image' too");
    mesh("a.vtu", &["--output", "./sub/../a.vtu"], "of 'image' too");
    mesh("a.nrrd", &["--output", "b.vtu", "--output-target-image", "a.nrrd"], "of 'image' too");
    mesh("a.nrrd", &["--output", "b.vtu", "--json", "a.nrrd"], "'json': a.nrrd is the file of 'image' too");
    mesh("a.nrrd", &["--output", "b.vtk", "--output-surface", "sub/../b.vtk"], "of 'output' too");
    mesh("a.nrrd", &["--output", "b.vtu", "--multiple-fidelities", "m.txt", "--json", "m.txt"], "multiple-fidelities");
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(folder.join("a.vtu"), folder.join("link.vtu")).unwrap();
        left.push("link.vtu".into());
        left.sort();
        mesh("a.vtu", &["--output", "link.vtu"], "of 'image' too");
        mesh("link.vtu", &["--output", "a.vtu"], "of 'image' too");
    }
    let surface = ["surface-to-mesh", "--plc", "s-1.off", "--output", "b.vtu", "--output-surface", "s.off"];
    let line = ends_with(folder, &[&surface[..], &["--surfaces", "per-label"]].concat(), 2);
    assert!(line.contains("'output-surface': s-1.off is the file of 'plc' too"), "{line}");
    for arguments in [
        &["convert", "tet.mesh", "tet.mesh"][..],
        &["info", "tet.mesh", "--json", "tet.mesh"],
        &["quality", "tet.mesh", "--json", "tet.mesh"],
        &["check", "s-1.off", "--picture", "s-1.off"],
        &["warp", "tet.mesh", "tet.mesh", "--field", "a.nrrd"],
    ] {
        ends_with(folder, arguments, 2);
    }
    assert_eq!(names(folder), left);
    assert_eq!(fs::read(folder.join("a.vtu")).unwrap(), block());
    assert_eq!(fs::read_to_string(folder.join("tet.mesh")).unwrap(), TET);
}

#[test]
fn devices_may_be_named_twice() {
    if !cfg!(target_os = "linux") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("a.nrrd"), block()).unwrap();
    let arguments = ["image-to-mesh", "--image", "a.nrrd", "--output", "/dev/null", "--output-surface", "/dev/null"];
    ends_with(folder.path(), &arguments, 0);
    assert_eq!(names(folder.path()), ["a.nrrd"]);
}

#[test]
fn a_format_that_does_not_hold_the_output_is_refused_before_the_work() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("a.nrrd"), block()).unwrap();
    fs::write(folder.join("s.off"), TETRAHEDRON).unwrap();
    let refused = |rest: &[&str], wanted: &str| {
        let line = ends_with(folder, &[&["image-to-mesh", "--image", "a.nrrd"], rest].concat(), 2);
        assert!(line.contains(wanted), "{rest:?}: {line}");
        assert_eq!(names(folder), ["a.nrrd", "s.off"], "{rest:?}");
    };
    for name in ["m.stl", "m.off", "m.obj", "m.ply", "m.vtp", "m.surf", "m.poly", "m.smesh"] {
        refused(&["--output", name], "would hold no volume elements; .vtu .vtk .msh");
    }
    refused(&["--output", "m.vtu", "--output-bcc-mesh", "n.stl"], "n.stl would hold no volume elements");
    for name in ["x.vtu", "x.ugrid", "x.su2", "x.poly"] {
        refused(&["--output", "m.vtu", "--output-surface", name], "would hold no surface alone; .vtp .vtk");
    }
    refused(&["--output", "m.vtu", "--output-bcc-surface", "x.vtu"], "no surface alone");
    refused(&["--output", "m.su2", "--shape-functions", "quadratic"], "m.su2 would hold no quadratic elements");
    ends_with(folder, &["surface-to-mesh", "--plc", "s.off", "--output", "m.stl"], 2);
    // What the reference names is written.
    let files = ["--output-bcc-surface", "b.vtp", "--output-smooth-surface", "c.vtk", "--output-surface", "d.stl"];
    ends_with(folder, &[&["image-to-mesh", "--image", "a.nrrd", "--output", "m.vtu"], &files[..]].concat(), 0);
    assert_eq!(names(folder), ["a.nrrd", "b.vtp", "c.vtk", "d.stl", "m.vtu", "s.off"]);
    // A conversion may leave the surface alone.
    ends_with(folder, &["convert", "m.vtu", "m.stl"], 0);
}

#[test]
fn an_empty_value_is_refused_but_for_modules_of_3d_slicer() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("a.nrrd"), block()).unwrap();
    let files = ["--image", "a.nrrd", "--output", "m.vtu"];
    for rest in [
        &["--fidelity="][..],
        &["--fidelity", ""],
        &["--fidelity-for", ""],
        &["--fixed-point="],
        &["--duplicate-interface", " "],
    ] {
        let line = ends_with(folder, &[&["image-to-mesh"], &files[..], rest].concat(), 2);
        assert!(line.contains("its value is empty"), "{rest:?}: {line}");
    }
    assert_eq!(names(folder), ["a.nrrd"]);
    #[cfg(unix)]
    {
        let module = folder.join("MeshwrightImageToMesh");
        std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_meshwright"), &module).unwrap();
        let arguments = [&files[..], &["--fidelity", "", "--fixed-point", ""]].concat();
        let output = Command::new(module).args(arguments).current_dir(folder).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
}
