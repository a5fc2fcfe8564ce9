//! Registration of a made-up head with a known deformation: the field is found, whatever the number of threads.

use std::sync::OnceLock;

use glam::{DMat3, DVec3};
use meshwright::context::RunContext;
use meshwright::error::Error;
use meshwright::image::grid::Grid;
use meshwright::image::label_image::LabelImage;
use meshwright::image::voxel_image::{VoxelData, VoxelImage};
use meshwright::parameters::{ParameterSet, Value};
use meshwright::pipeline::Output;
use meshwright::pipeline::registration::{Input, PARAMETERS, run};
use meshwright::pipeline::warp::{Direction, warp_points};

const RADII: DVec3 = DVec3::new(52.0, 60.0, 44.0);

fn moving_grid() -> Grid {
    Grid::new([48, 54, 42], DVec3::new(2.5, 2.5, 2.5), DVec3::new(-58.0, -66.0, -51.0), DMat3::IDENTITY).unwrap()
}

fn fixed_grid() -> Grid {
    let direction = DMat3::from_rotation_x(0.15) * DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
    Grid::new([60, 66, 36], DVec3::new(2.1, 2.1, 3.0), DVec3::new(-60.0, -75.0, 45.0), direction).unwrap()
}

fn anatomy(p: DVec3) -> f64 {
    if (p / RADII).length() > 1.0 {
        return 0.0;
    }
    let wave = |a: f64, b: f64, c: f64, phase: f64| (a * p.x + b * p.y + c * p.z + phase).sin();
    300.0
        + 40.0 * wave(0.31, 0.12, -0.08, 0.0)
        + 40.0 * wave(-0.1, 0.33, 0.14, 1.0)
        + 40.0 * wave(0.07, -0.15, 0.36, 2.0)
        + 25.0 * wave(0.22, 0.2, 0.19, 3.0)
}

/// Fixed to moving: a few millimetres of rigid motion and a bump of brain shift.
fn truth(p: DVec3) -> DVec3 {
    let bump = 5.0 * (-(p - DVec3::new(20.0, 25.0, 10.0)).length_squared() / (2.0 * 22.0 * 22.0)).exp();
    DMat3::from_rotation_z(0.03) * p + DVec3::new(1.5, -1.0, 0.8) + DVec3::new(0.3, -0.9, 0.35) * bump
}

fn scan(grid: &Grid, value: impl Fn(DVec3) -> f64) -> VoxelImage {
    let [ni, nj, nk] = grid.size();
    let mut values = Vec::with_capacity(grid.voxel_count());
    for k in 0..nk {
        for j in 0..nj {
            for i in 0..ni {
                values.push(value(grid.index_to_world(DVec3::new(i as f64, j as f64, k as f64))) as f32);
            }
        }
    }
    VoxelImage::new(*grid, 1, VoxelData::F32(values)).unwrap()
}

fn segmentation() -> LabelImage {
    let tumor = |p: DVec3| (p - DVec3::new(-20.0, 10.0, 5.0)).length() < 9.0;
    let label = |p: DVec3| if anatomy(p) == 0.0 { 0.0 } else { 1.0 + f64::from(u8::from(tumor(p))) };
    scan(&moving_grid(), label).to_label_image().unwrap()
}

fn register(threads: usize, fixed: &VoxelImage, changes: &[(&str, &str)]) -> Result<Output, Error> {
    let mut parameters = ParameterSet::new(PARAMETERS);
    parameters.set_text("working-spacing", "2.5").unwrap();
    parameters.set_text("num-adaptive-iterations", "3").unwrap();
    for (name, value) in changes {
        parameters.set_text(name, value).unwrap();
    }
    let moving = scan(&moving_grid(), anatomy);
    let segmentation = segmentation();
    let input = Input {
        fixed,
        moving: &moving,
        segmentation: &segmentation,
        fixed_mask: None,
        mesh: None,
        rigid: None,
        landmarks: None,
    };
    run(&input, &parameters, &RunContext::with_threads(threads).unwrap())
}

fn deformed_scan() -> &'static VoxelImage {
    static SCAN: OnceLock<VoxelImage> = OnceLock::new();
    SCAN.get_or_init(|| {
        scan(&fixed_grid(), |p| (anatomy(truth(p)) * 0.8 + 20.0) * f64::from(u8::from(anatomy(truth(p)) > 0.0)))
    })
}

fn result() -> &'static Output {
    static RESULT: OnceLock<Output> = OnceLock::new();
    RESULT.get_or_init(|| register(2, deformed_scan(), &[]).unwrap())
}

fn image<'a>(output: &'a Output, name: &str) -> &'a VoxelImage {
    &output.images.iter().find(|(n, _)| n == name).unwrap().1
}

/// Points of the fixed space inside the head.
fn inner_points() -> Vec<DVec3> {
    let mut points = Vec::new();
    for n in 0..1000 {
        let p = DVec3::new((n % 10) as f64, (n / 10 % 10) as f64, (n / 100) as f64) * 9.0 - 40.0;
        if (p / RADII).length() < 0.85 {
            points.push(p);
        }
    }
    points
}

#[test]
fn a_known_deformation_is_recovered() {
    let output = result();
    let points = inner_points();
    let mut found = points.clone();
    warp_points(&mut found, image(output, "displacement"), Direction::FixedToMoving).unwrap();
    let error = found.iter().zip(&points).map(|(f, p)| (*f - truth(*p)).length()).sum::<f64>() / points.len() as f64;
    let before = points.iter().map(|p| (*p - truth(*p)).length()).sum::<f64>() / points.len() as f64;
    assert!(error < 0.5 && error < 0.25 * before, "{error} of {before}");
    assert!(output.statistics.value("field.jacobian_minimum").unwrap() > 0.1);
}

#[test]
fn the_inverse_undoes_the_field() {
    let output = result();
    let mut points = inner_points();
    warp_points(&mut points, image(output, "displacement"), Direction::FixedToMoving).unwrap();
    warp_points(&mut points, image(output, "inverse"), Direction::FixedToMoving).unwrap();
    let back = inner_points();
    let worst = points.iter().zip(&back).map(|(p, b)| (*p - *b).length()).fold(0.0, f64::max);
    assert!(worst < 0.2, "{worst}");
    assert!(output.mesh.as_ref().unwrap().point_data.iter().any(|a| a.name == "displacement" && a.components == 3));
}

#[test]
fn one_and_two_threads_give_the_same_bits() {
    let (one, two) = (register(1, deformed_scan(), &[]).unwrap(), result());
    for ((name, a), (_, b)) in one.images.iter().zip(&two.images) {
        assert!(a == b, "{name} differs");
    }
    assert_eq!(one.points, two.points);
}

#[test]
fn unusable_input_is_named() {
    let message = |fixed: &VoxelImage, changes: &[(&str, &str)]| register(1, fixed, changes).unwrap_err().to_string();
    let far = Grid::new([20, 20, 20], DVec3::splat(3.0), DVec3::splat(900.0), DMat3::IDENTITY).unwrap();
    assert!(message(&scan(&far, |p| p.x), &[]).contains("do not overlap"));
    assert!(message(&scan(&fixed_grid(), |_| 7.0), &[]).contains("constant"));
    assert!(message(&scan(&fixed_grid(), |_| f64::NAN), &[]).contains("NaN"));
    assert!(message(deformed_scan(), &[("half-window-size-x", "60")]).contains("axis X"));
    let alike = [("min-similarity", "1"), ("adaptive", "off"), ("matching-direction", "fixed-to-moving")];
    assert!(message(deformed_scan(), &alike).contains("correspondence"));
    assert!(message(deformed_scan(), &[("rejection-fraction", "1"), ("adaptive", "off")]).contains("rejection"));
}

/// A small, fast problem with a resection: half the resolution, a dark hole where the tumour was.
fn small_run(changes: &[(&str, &str)]) -> Output {
    let coarse = |grid: Grid| {
        let size = grid.size().map(|n| n / 2);
        Grid::new(size, grid.spacing() * 2.0, grid.origin(), grid.direction()).unwrap()
    };
    let center = DVec3::new(-20.0, 10.0, 5.0);
    let (moving_grid, fixed_grid) = (coarse(moving_grid()), coarse(fixed_grid()));
    let label = |p: DVec3| {
        let tumor = (p - center).length() < 12.0;
        if anatomy(p) == 0.0 { 0.0 } else { 1.0 + f64::from(u8::from(tumor)) }
    };
    let moving = scan(&moving_grid, |p| if label(p) == 2.0 { 1.2 * anatomy(p) } else { anatomy(p) });
    let hole = |p: DVec3| if (p - center).length() < 10.0 { 0.1 } else { 1.0 };
    let fixed = scan(&fixed_grid, |p| anatomy(truth(p)) * hole(truth(p)));
    let segmentation = scan(&moving_grid, label).to_label_image().unwrap();
    let mut parameters = ParameterSet::new(PARAMETERS);
    let defaults = [
        ("working-spacing", "4.5"),
        ("num-adaptive-iterations", "2"),
        ("initial-transform", "1 0 0 1, 0 1 0 -1, 0 0 1 0.5"),
        ("tumor-resection", "on"),
        ("selection-fraction", "0.2"),
    ];
    for (name, value) in defaults.iter().chain(changes).filter(|(_, value)| !value.is_empty()) {
        match name.split_once('@') {
            Some((name, label)) => {
                let value = Value::Real(value.parse().unwrap());
                parameters.set_for_label(name, label.parse().unwrap(), value).unwrap();
            }
            None => parameters.set_text(name, value).unwrap(),
        }
    }
    let input = Input {
        fixed: &fixed,
        moving: &moving,
        segmentation: &segmentation,
        fixed_mask: None,
        mesh: None,
        rigid: None,
        landmarks: None,
    };
    run(&input, &parameters, &RunContext::with_threads(2).unwrap()).unwrap()
}

#[test]
fn solvers_that_stop_early_say_so_and_leave_a_finite_field() {
    for solver in ["iccg", "bjcg", "jcg", "bicgstab", "lsqr"] {
        let changes = [("solver", solver), ("solver-max-iterations", "1"), ("solver-tolerance", "1e-12")];
        let output = small_run(&changes);
        let VoxelData::F32(values) = &image(&output, "displacement").data else { panic!("the field is not f32") };
        assert!(values.iter().all(|v| v.is_finite()), "{solver}");
        assert!(output.statistics.value("field.jacobian_minimum").unwrap() > 0.0, "{solver}");
    }
}
