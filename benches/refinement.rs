//! Speed and memory of surface-to-mesh refinement and improvement; one CSV row per case and number of threads.
//!
//! `cargo bench --bench refinement -- [--cases ball,box,shell] [--tets 1000000] [--threads 1,2] [--passes 3]`
//!
//! The surfaces are made here: a ball (one size), a box (one size) and a ball in a far field (sizes grow a hundredfold).
//! Each is meshed from its file to a file, as the command line does. The speed-up is against the first number of
//! threads in the list. Every run is a process of its own, so that its peak memory is its own.

use std::path::Path;
use std::process::Command;
use std::time::Instant;

use glam::DVec3;
use meshwright::conforming::{self, options::Options};
use meshwright::context::RunContext;
use meshwright::index::VertexId;
use meshwright::io::{WriteOptions, read_surface, write_mesh, write_surface};
use meshwright::mesh::surface_mesh::SurfaceMesh;
use rustc_hash::FxHashMap;

mod process_usage;
use process_usage::usage;

/// A sphere: the octahedron's faces cut into `n * n` triangles each.
fn sphere(n: usize, radius: f64) -> SurfaceMesh {
    projected(n, |p| radius * p.normalize(), false)
}

/// The surface of the octahedron |x| + |y| + |z| = 1 with `8 n^2` triangles, mapped; `inward` turns them over.
fn projected(n: usize, map: impl Fn(DVec3) -> DVec3, inward: bool) -> SurfaceMesh {
    let mut numbers: FxHashMap<[i64; 3], u32> = FxHashMap::default();
    let (mut points, mut facets) = (Vec::new(), Vec::new());
    let mut vertex = |key: [i64; 3]| {
        *numbers.entry(key).or_insert_with(|| {
            points.push(map(DVec3::new(key[0] as f64, key[1] as f64, key[2] as f64) / n as f64));
            points.len() as u32 - 1
        })
    };
    let n = n as i64;
    for octant in 0..8 {
        let sign = [0, 1, 2].map(|axis| if octant >> axis & 1 == 1 { -1 } else { 1 });
        let turned = (sign[0] * sign[1] * sign[2] < 0) != inward;
        for i in 0..n {
            for j in 0..n - i {
                let at = |i: i64, j: i64| [sign[0] * i, sign[1] * j, sign[2] * (n - i - j)];
                let mut add = |corners: [[i64; 3]; 3]| {
                    let [a, b, c] = corners.map(|key| VertexId(vertex(key)));
                    facets.push(if turned { [a, c, b] } else { [a, b, c] });
                };
                add([at(i, j), at(i + 1, j), at(i, j + 1)]);
                if i + j + 1 < n {
                    add([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
                }
            }
        }
    }
    SurfaceMesh::new(points, facets)
}

/// The surface of case `name` that gives about `tets` tets with the default options.
fn surface(name: &str, tets: f64) -> SurfaceMesh {
    // Tets per volume of the cube of the size: 1 / 0.118 for regular ones. The size is 1.2 times the boundary's edge.
    let per_edge = |volume: f64| (volume / (tets * 0.118 * 1.2f64.powi(3) * 1.1)).cbrt();
    match name {
        "ball" => sphere((1.25 / per_edge(4.19)).ceil() as usize, 1.0),
        "box" => {
            let cube = |p: DVec3| p * (p.abs().element_sum() / p.abs().max_element());
            projected((1.4 / per_edge(8.0)).ceil() as usize, cube, false)
        }
        "shell" => {
            // Growth from the inner surface makes about as many tets as its triangles times a constant.
            let n = (tets / 140.0).sqrt().ceil() as usize;
            let mut both = sphere(n, 1.0);
            both = SurfaceMesh::new(both.points, both.facets.into_iter().map(|[a, b, c]| [a, c, b]).collect());
            let far = sphere(12, 60.0);
            let first = both.points.len() as u32;
            both.points.extend(far.points);
            let moved = far.facets.into_iter().map(|f| f.map(|v| VertexId(v.0 + first)));
            SurfaceMesh::new(both.points, both.facets.into_iter().chain(moved).collect())
        }
        other => panic!("unknown case {other}"),
    }
}

/// One run in this process: prints `tets cpu wall peak`.
fn run_once(from: &Path, threads: usize, passes: usize) {
    let clock = Instant::now();
    let context = RunContext::with_threads(threads).expect("threads");
    let surface = read_surface(from).expect("the file written before");
    let options = Options { quality_passes: passes, ..Options::default() };
    let (mesh, _) = conforming::run(&surface, None, &options, &context).expect("a valid surface");
    let to = from.with_extension("vtu");
    write_mesh(&mesh, &to, &WriteOptions::default()).expect("room on the disk");
    let wall = clock.elapsed().as_secs_f64();
    let (cpu, peak) = usage();
    println!("{} {cpu} {wall} {peak}", mesh.element_count());
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let value = |name: &str, default: &str| {
        let place = arguments.iter().position(|a| a == name);
        place.and_then(|i| arguments.get(i + 1)).cloned().unwrap_or_else(|| default.to_owned())
    };
    let passes = value("--passes", "3");
    if arguments.iter().any(|a| a == "--once") {
        let threads = value("--threads", "1").parse().expect("--threads takes a number");
        return run_once(Path::new(&value("--once", "")), threads, passes.parse().expect("--passes takes a number"));
    }
    let tets: f64 = value("--tets", "1000000").parse().expect("--tets takes a number");
    let folder = tempfile::tempdir().expect("a folder for temporary files");
    println!("case,threads,triangles,tets,cpu_seconds,wall_seconds,kilotets_per_cpu_second,bytes_per_tet,speed_up");
    for case in value("--cases", "ball,box,shell").split(',') {
        let surface = surface(case, tets);
        let file = folder.path().join(format!("{case}.off"));
        write_surface(&surface, &file, &WriteOptions::default()).expect("room on the disk");
        let mut first = None;
        for threads in value("--threads", "1,2").split(',') {
            let this = std::env::current_exe().expect("the path of this program");
            let mut command = Command::new(this);
            command.arg("--once").arg(&file).args(["--threads", threads, "--passes", &passes]);
            let output = command.output().expect("this program runs again");
            let text = String::from_utf8_lossy(&output.stdout);
            let figures: Vec<f64> = text.split_whitespace().filter_map(|word| word.parse().ok()).collect();
            let &[count, cpu, wall, peak] = figures.as_slice() else {
                panic!("{case} failed: {}", String::from_utf8_lossy(&output.stderr));
            };
            let start: f64 = *first.get_or_insert(wall);
            println!(
                "{case},{threads},{},{count},{cpu:.2},{wall:.2},{:.1},{:.0},{:.2}",
                surface.facets.len(),
                count / cpu / 1000.0,
                peak / count,
                start / wall
            );
        }
    }
}
