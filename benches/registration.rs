//! Accuracy, time and memory of the registration; one CSV row per case and mode.
//!
//! `cargo bench --bench registration -- CASE_DIR... [--threads N] [--set NAME=VALUE]...`
//!
//! A case is a folder with `intraop.nii.gz` (fixed), `preop.nii.gz` (moving), `preop_seg.nii.gz` and `landmarks.csv` (fixed x y z, moving
//! x y z as the last six columns, LPS mm). Each is run with the adaptive loop and as plain PBNRR; peak memory is that of the
//! process so far.

use std::path::{Path, PathBuf};
use std::time::Instant;

use glam::DVec3;
use meshwright::context::RunContext;
use meshwright::io::read_image;
use meshwright::parameters::ParameterSet;
use meshwright::pipeline::registration::{Input, PARAMETERS, run};

fn landmarks(path: &Path) -> (Vec<DVec3>, Vec<DVec3>) {
    let text = std::fs::read_to_string(path).unwrap_or_default();
    text.lines()
        .filter_map(|line| {
            let words: Vec<&str> = line.split(',').collect();
            let tail = &words[words.len().checked_sub(6)?..];
            let v = tail.iter().map(|w| w.trim().parse().ok()).collect::<Option<Vec<f64>>>()?;
            Some((DVec3::new(v[0], v[1], v[2]), DVec3::new(v[3], v[4], v[5])))
        })
        .unzip()
}

fn peak_mebibytes() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|l| l.starts_with("VmHWM")).unwrap_or_default();
    line.split_whitespace().nth(1).and_then(|kb| kb.parse::<f64>().ok()).map_or(f64::NAN, |kb| kb / 1024.0)
}

fn main() {
    let mut threads = 0;
    let mut changes = Vec::new();
    let mut cases = Vec::new();
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--threads" => threads = arguments.next().and_then(|n| n.parse().ok()).expect("--threads N"),
            "--set" => changes.push(arguments.next().expect("--set NAME=VALUE")),
            "--bench" => {}
            case => cases.push(PathBuf::from(case)),
        }
    }
    println!(
        "case,mode,threads,seconds,peak_mib,landmarks_rigid_mm,landmarks_mm,landmarks_max_mm,jacobian_min,iterations"
    );
    for case in cases {
        let read = |name: &str| read_image(&case.join(name)).expect("the case has its images");
        let (fixed, moving) = (read("intraop.nii.gz"), read("preop.nii.gz"));
        let segmentation = read("preop_seg.nii.gz").to_label_image().expect("a segmentation");
        let (fixed_points, moving_points) = landmarks(&case.join("landmarks.csv"));
        for mode in ["adaptive", "plain"] {
            let mut parameters = ParameterSet::new(PARAMETERS);
            parameters.set_text("adaptive", if mode == "plain" { "off" } else { "on" }).expect("a flag");
            for change in &changes {
                let (name, value) = change.split_once('=').expect("NAME=VALUE");
                parameters.set_text(name, value).expect("a parameter");
            }
            let input = Input {
                fixed: &fixed,
                moving: &moving,
                segmentation: &segmentation,
                fixed_mask: None,
                mesh: None,
                rigid: None,
                landmarks: (!fixed_points.is_empty()).then_some((&fixed_points[..], &moving_points[..])),
            };
            let context = RunContext::with_threads(threads).expect("threads");
            let start = Instant::now();
            let output = run(&input, &parameters, &context).expect("a registration");
            let figure = |name: &str| output.statistics.value(name).unwrap_or(f64::NAN);
            println!(
                "{},{mode},{},{:.1},{:.0},{:.3},{:.3},{:.2},{:.3},{}",
                case.file_name().unwrap_or_default().to_string_lossy(),
                context.threads(),
                start.elapsed().as_secs_f64(),
                peak_mebibytes(),
                figure("landmarks.rigid.mean"),
                figure("landmarks.mean"),
                figure("landmarks.max"),
                figure("field.jacobian_minimum"),
                figure("adaptive.iterations")
            );
        }
    }
}
