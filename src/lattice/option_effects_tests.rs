//! Every option acts: for each row of the table a value other than the default changes what comes out.

use std::ops::ControlFlow;

use glam::DVec3;

use crate::context::RunContext;
use crate::error::{Error, FindingCode, Result};
use crate::geometry::tetrahedron::volume;
use crate::image::label_image::LabelImage;
use crate::lattice::options::{Options, PARAMETERS};
use crate::lattice::test_images::voxel_image;
use crate::lattice::{Output, Report};
use crate::mesh::validation::check_mixed_mesh;
use crate::parameters::{ParameterSet, Value};

/// Two halves of a ball, with everything that the clean-up looks for: isolated voxels of both kinds, a small region, a contact
/// at a corner.
fn image() -> LabelImage {
    voxel_image(20, |p| match p.to_array().map(|x| x as usize) {
        [2, 2, 2] | [3, 16, 16] | [4, 16, 16] => 1,
        [8, 9, 9] => 0,
        [16, 16, 3] | [17, 17, 4] | [16, 3, 16] | [17, 4, 17] => 2,
        _ if p.distance(DVec3::new(9.3, 9.6, 9.8)) < 7.2 => 1 + u16::from(p.x > 9.0),
        _ => 0,
    })
}

fn run_with(options: &[(&str, &str)]) -> Result<(Output, Report)> {
    let mut set = ParameterSet::new(PARAMETERS);
    options.iter().try_for_each(|(name, value)| set.set_text(name, value))?;
    let options = Options::from_parameters(&set)?;
    super::run(&image(), &options, &RunContext::with_threads(1).unwrap())
}

/// A plain run on which most options are tried.
const PLAIN: &[(&str, &str)] = &[("output-target-points", "t.vtk"), ("output-source-points", "s.vtk")];
/// For options that act only with another one.
const CHECKED: &[(&str, &str)] = &[("check-image-topology", "1")];
const HALF_SMOOTH: &[(&str, &str)] = &[("min-dihedral-angle", "29"), ("local-transformations", "0")];
const COARSE: &[(&str, &str)] =
    &[("check-image-topology", "1"), ("lattice-spacing", "6"), ("fidelity", "0.5"), ("surface-tolerance", "100")];
const FINE: &[(&str, &str)] = &[("lattice-spacing", "1"), ("surface-tolerance", "100")];
const MIXED: &[(&str, &str)] = &[("mixed-elements", "1"), ("lattice-spacing", "1"), ("surface-tolerance", "100")];
/// All pyramids with triangles on the surface of the little ball are flat.
const FLAT: &[(&str, &str)] =
    &[("mixed-elements", "1"), ("lattice-spacing", "1"), ("surface-tolerance", "100"), ("min-scaled-jacobian", "0.2")];

/// Option, a value that is not its default, and what else is set.
const EFFECTS: &[(&str, &str, &[(&str, &str)])] = &[
    ("upsample-resolution", "twofold", PLAIN),
    ("relabel-isolated-voxels", "background", PLAIN),
    ("relabel-isolated-voxels", "foreground", PLAIN),
    ("check-image-topology", "1", PLAIN),
    ("separate-disconnected-regions", "1", &[("fidelity", "0.97"), ("surface-tolerance", "100")]),
    ("relabel-image-regions-below", "0.01", PLAIN),
    ("random-seed", "2", CHECKED),
    ("lattice-spacing", "3", PLAIN),
    ("fidelity", "0.99", PLAIN),
    ("max-element-size", "1", PLAIN),
    ("min-element-size", "3", &[("fidelity", "0.99"), ("lattice-spacing", "4")]),
    ("surface-tolerance", "100", &[("fidelity", "0.5"), ("lattice-spacing", "8")]),
    ("local-closure", "1", &[("fidelity", "0.99"), ("lattice-spacing", "4")]),
    ("fixed-point", "9,9,9.2", PLAIN),
    ("target-vertices", "300", PLAIN),
    ("check-mesh-topology", "1", COARSE),
    ("duplicate-interface", "1,2", PLAIN),
    ("mixed-elements", "1", FINE),
    ("max-surface-triangles-on-pyramid", "4", FLAT),
    ("shape-functions", "quadratic", PLAIN),
    ("smoothing-iterations", "1", PLAIN),
    ("flexibility", "0.1", PLAIN),
    ("youngs-modulus", "0.1", PLAIN),
    ("poissons-ratio", "0.1", PLAIN),
    ("non-connectivity", "no", PLAIN),
    ("non-connectivity", "face", PLAIN),
    ("non-connectivity", "edge", PLAIN),
    ("min-dihedral-angle", "20", PLAIN),
    ("min-scaled-jacobian", "0.9", MIXED),
    ("search-radius-factor", "0.01", PLAIN),
    ("edge-length-factor", "0.02", PLAIN),
    ("confidence-factor", "0.9", HALF_SMOOTH),
    ("max-confidence-iterations", "0", HALF_SMOOTH),
    ("laplacian-iterations", "2", PLAIN),
    ("local-transformations", "0", PLAIN),
];

#[test]
fn every_option_changes_the_mesh() {
    let mut plain_runs: Vec<(&[(&str, &str)], Output)> = Vec::new();
    let mut idle = Vec::new();
    for (name, value, others) in EFFECTS {
        if !plain_runs.iter().any(|(o, _)| o == others) {
            plain_runs.push((others, run_with(others).unwrap().0));
        }
        let plain = &plain_runs.iter().find(|(o, _)| o == others).unwrap().1;
        let changed = run_with(&[others, &[(*name, *value)][..]].concat()).unwrap().0;
        if changed.mesh == plain.mesh && changed.points == plain.points {
            idle.push((*name, *value));
        }
    }
    assert!(idle.is_empty(), "without effect: {idle:?}");
}

#[test]
fn no_option_is_left_out() {
    // Tested where they act: files by the command line, loose regions in `mesh_regions`.
    let elsewhere = ["multiple-fidelities", "relabel-mesh-regions-below"];
    for row in PARAMETERS.iter().filter(|row| !["Files", "Evaluation", "Debugging", "Limits"].contains(&row.group)) {
        let is_tried = EFFECTS.iter().any(|(name, ..)| *name == row.name);
        assert!(is_tried || elsewhere.contains(&row.name), "{}", row.name);
    }
}

#[test]
fn debugging_outputs_and_evaluations_come_only_when_asked_for() {
    let (plain, figures) = run_with(&[]).unwrap();
    assert!(plain.meshes.is_empty() && plain.images.is_empty() && plain.points.is_empty());
    let meshes = ["output-bcc-mesh", "output-bcc-surface", "output-smooth-mesh", "output-smooth-surface"];
    for name in meshes {
        let output = run_with(&[(name, "x.vtk")]).unwrap().0;
        assert_eq!(output.meshes.len(), 1, "{name}");
        assert_eq!(output.mesh, plain.mesh, "{name}");
    }
    assert_eq!(run_with(&[("output-source-points", "x.vtk")]).unwrap().0.points.len(), 1);
    assert_eq!(run_with(&[("output-target-points", "x.vtk")]).unwrap().0.points.len(), 1);
    assert_eq!(run_with(&[("output-target-image", "x.nii")]).unwrap().0.images.len(), 1);
    let evaluations = [
        ("evaluate-quality", "quality.min_dihedral"),
        ("evaluate-volume", "label.1.volume"),
        ("evaluate-fidelity", "label.1.hausdorff"),
    ];
    for (name, figure) in evaluations {
        assert!(figures.statistics().value(figure).is_none(), "{figure}");
        let with = run_with(&[(name, "1")]).unwrap().1.statistics();
        assert!(with.value(figure).is_some(), "{figure}: {with:?}");
    }
}

#[test]
fn limits_end_a_run_with_their_error() {
    assert!(matches!(run_with(&[("max-elements", "10")]), Err(Error::LimitReached { .. })));
    assert!(matches!(run_with(&[("time-limit", "1e-9")]), Err(Error::LimitReached { .. })));
}

#[test]
fn smoothing_without_a_surface_to_move_returns_the_mesh_with_a_finding() {
    let filled = voxel_image(9, |_| 1);
    let context = RunContext::with_threads(1).unwrap();
    let mesh = |smoothing: &str| {
        let mut set = ParameterSet::new(PARAMETERS);
        set.set_text("smoothing-iterations", smoothing).unwrap();
        super::run(&filled, &Options::from_parameters(&set).unwrap(), &context).unwrap().0.mesh
    };
    let smoothed = mesh("5");
    let findings = context.take_findings();
    assert!(findings.iter().any(|f| f.code == FindingCode::SmoothingStopped), "{findings:?}");
    check_mixed_mesh(&smoothed).unwrap();
    // The border is cut flat all the same: the box of the voxels, to the last bit of its planes.
    let volume: f64 = smoothed.tets().unwrap().iter().map(|t| volume(t.map(|v| smoothed.points[v.index()]))).sum();
    assert!((volume - 729.0).abs() < 1e-9, "{volume}");
    mesh("0");
    assert!(context.take_findings().is_empty());
}

#[test]
fn a_run_that_is_cancelled_in_the_middle_of_a_stage_ends_with_the_error() {
    let ball = voxel_image(56, |p| u16::from(p.distance(DVec3::splat(27.3)) < 24.0));
    let options = Options::from_parameters(&ParameterSet::new(PARAMETERS)).unwrap();
    let mut met = 0;
    for wanted in ["refinement", "target surface", "deformation", "improvement"] {
        let context = RunContext::with_threads(2).unwrap();
        let mut is_seen = false;
        let tick = |stage: &'static str, share: f64| {
            assert!((0.0..=1.0).contains(&share));
            is_seen |= stage == wanted;
            if stage == wanted { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        let result = context.run(tick, |context| super::run(&ball, &options, context));
        // A stage may pass between two reports, or be at its end when the report comes.
        met += usize::from(is_seen && matches!(result, Err(Error::Cancelled)));
        assert!(result.is_ok() || matches!(result, Err(Error::Cancelled)));
    }
    assert!(met > 0);
}

#[test]
fn values_out_of_range_are_refused_as_parameter_values() {
    let cases: &[&[(&str, &str)]] = &[
        &[("relabel-image-regions-below", "0.02")],
        &[("relabel-image-regions-below", "0")],
        &[("relabel-mesh-regions-below", "0.2")],
        &[("relabel-mesh-regions-below", "-1")],
        &[("check-mesh-topology", "1")],
        &[("poissons-ratio", "0.5")],
        &[("poissons-ratio", "0.05")],
        &[("fidelity", "1.01")],
        &[("fidelity", "nan")],
        &[("upsample-resolution", "threefold")],
        &[("relabel-isolated-voxels", "all")],
        &[("max-surface-triangles-on-pyramid", "5")],
        &[("flexibility", "0")],
        &[("youngs-modulus", "0")],
        &[("youngs-modulus", "-1")],
        &[("non-connectivity", "corner")],
        &[("min-dihedral-angle", "31")],
        &[("min-scaled-jacobian", "1.5")],
        &[("edge-length-factor", "6")],
        &[("search-radius-factor", "0")],
        &[("confidence-factor", "2")],
        &[("smoothing-iterations", "-1")],
        &[("laplacian-iterations", "x")],
        &[("lattice-spacing", "inf")],
        &[("max-element-size", "0")],
        &[("min-element-size", "3"), ("max-element-size", "2")],
        &[("target-vertices", "2")],
        &[("target-vertices", "100"), ("lattice-spacing", "2")],
        &[("mixed-elements", "1"), ("shape-functions", "quadratic")],
        &[("fixed-point", "1,2,inf")],
        &[("duplicate-interface", "1")],
        &[("duplicate-interface", "1,1")],
        &[("duplicate-interface", "1,7")],
        &[("duplicate-interface", "7,*")],
    ];
    for case in cases {
        let result = run_with(case);
        assert!(matches!(result, Err(Error::ParameterValue { .. })), "{case:?}: {:?}", result.map(|_| ()));
    }
    let mut set = ParameterSet::new(PARAMETERS);
    for (name, value) in
        [("fidelity", 1.2), ("poissons-ratio", 0.5), ("youngs-modulus", -2.0), ("max-element-size", 0.0)]
    {
        assert!(set.set_for_label(name, 1, Value::Real(value)).is_err(), "{name}");
    }
    set.set_for_label("fidelity", 9, Value::Real(0.9)).unwrap();
    let options = Options::from_parameters(&set).unwrap();
    let result = super::run(&image(), &options, &RunContext::with_threads(1).unwrap());
    assert!(matches!(result, Err(Error::ParameterValue { .. })));
}
