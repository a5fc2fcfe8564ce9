//! Speed and memory of the Delaunay kernel; one CSV row per case.
//!
//! `cargo bench --bench delaunay -- [--cases random,surfaces,grid] [--points 1000000] [--threads 1,2] [--write DIR]`
//!
//! `--write` leaves each point set as raw little-endian doubles (x y z), which the peers in `benches/peers` read. CPU
//! seconds and peak memory come from the operating system; run one case at a time for a meaningful peak.

use std::io::Write;
use std::time::Instant;

use glam::DVec3;
use meshwright::conforming::delaunay_kernel::{DelaunayOptions, tetrahedralize};
use meshwright::context::RunContext;
use meshwright::geometry::spatial_sort::mix;

mod process_usage;
use process_usage::usage;

fn sequence(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        state = mix(state.wrapping_add(0x9e37_79b9_7f4a_7c15));
        (state >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// Points at random in the unit cube.
fn random(count: usize) -> Vec<DVec3> {
    let mut next = sequence(1);
    (0..count).map(|_| DVec3::new(next(), next(), next())).collect()
}

/// A quarter of the points each on a sphere, a torus, a plane and a cylinder.
fn surfaces(count: usize) -> Vec<DVec3> {
    let mut next = sequence(2);
    let tau = std::f64::consts::TAU;
    let point = |i: usize| {
        let (u, v) = (next(), next());
        let (angle, other) = (u * tau, v * tau);
        match i % 4 {
            0 => {
                let z = 2.0 * v - 1.0;
                let r = (1.0 - z * z).sqrt();
                DVec3::new(r * angle.cos(), r * angle.sin(), z)
            }
            1 => {
                let r = 1.0 + 0.3 * other.cos();
                DVec3::new(3.0 + r * angle.cos(), r * angle.sin(), 0.3 * other.sin())
            }
            2 => DVec3::new(4.0 * u, 4.0 * v - 2.0, -2.0),
            _ => DVec3::new(1.5 + 0.5 * angle.cos(), 3.0 + 0.5 * angle.sin(), 2.0 * v - 1.0),
        }
    };
    (0..count).map(point).collect()
}

/// A cubic grid of about `count` points with a step that is not a binary fraction.
fn grid(count: usize) -> Vec<DVec3> {
    let side = (count as f64).cbrt().round() as usize;
    let at = |i: usize| i as f64 * 0.1;
    (0..side * side * side).map(|i| DVec3::new(at(i % side), at(i / side % side), at(i / side / side))).collect()
}

/// A cubic grid of about `count` points with whole coordinates.
fn lattice(count: usize) -> Vec<DVec3> {
    grid(count).into_iter().map(|p| (p * 10.0).round()).collect()
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let value = |name: &str, default: &str| {
        let place = arguments.iter().position(|a| a == name);
        place.and_then(|i| arguments.get(i + 1)).cloned().unwrap_or_else(|| default.to_owned())
    };
    let count: usize = value("--points", "1000000").parse().expect("--points takes a number");
    let write = value("--write", "");
    println!(
        "engine,case,threads,points,tets,seconds,cpu_seconds,points_per_cpu_second,peak_mib,bytes_per_tet,exact,deferred,sort_s,insert_s,convert_s"
    );
    for case in value("--cases", "random,surfaces,grid,lattice").split(',') {
        let points = match case {
            "random" => random(count),
            "surfaces" => surfaces(count),
            "grid" => grid(count),
            "lattice" => lattice(count),
            other => panic!("unknown case {other}"),
        };
        if !write.is_empty() {
            let bytes: Vec<u8> = points.iter().flat_map(|p| p.to_array()).flat_map(f64::to_le_bytes).collect();
            let mut file = std::fs::File::create(format!("{write}/{case}.f64")).expect("a writable folder");
            file.write_all(&bytes).expect("room on the disk");
            continue;
        }
        for threads in value("--threads", "1").split(',') {
            let context = RunContext::with_threads(threads.parse().expect("a number of threads")).expect("threads");
            let (cpu, before) = usage();
            let clock = Instant::now();
            let result = tetrahedralize(&points, &DelaunayOptions::default(), &context).expect("valid points");
            let seconds = clock.elapsed().as_secs_f64();
            let (cpu_end, peak) = usage();
            let (cpu, n, tets) = (cpu_end - cpu, points.len(), result.complex.live_count());
            let report = &result.report;
            println!(
                "meshwright,{case},{threads},{n},{tets},{seconds:.2},{cpu:.2},{:.0},{},{:.1},{},{},{:.2},{:.2},{:.2}",
                n as f64 / cpu,
                peak >> 20,
                (peak.saturating_sub(before) as f64 - 40.0 * n as f64) / tets as f64,
                report.exact_tests,
                report.deferred,
                report.sort_seconds,
                report.insertion_seconds,
                report.conversion_seconds
            );
        }
    }
}
