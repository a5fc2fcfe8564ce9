//! Speed and memory of image to mesh; one CSV row per case.
//!
//! `cargo bench --bench lattice -- [--image FILE] [--threads 1,2] [--smoothing 0,5] [--size 181]`
//!
//! Without a file the image is made here: a head of `size` voxels along its longest axis with 96 parcels, folds and two
//! ventricles. With one, both are meshed. Every row is a process of its own, so that its peak memory is its own. `cpu_s` and
//! `wall_s` hold the engine only, no file; `bytes_per_tet` is the peak of the process beyond four times the label image;
//! `speed_up` is wall seconds against the row of the same case with the first number of threads.

use std::path::Path;
use std::process::Command;
use std::time::Instant;

use glam::{DMat3, DVec3};
use meshwright::context::RunContext;
use meshwright::geometry::spatial_sort::mix;
use meshwright::image::grid::Grid;
use meshwright::image::label_image::LabelImage;
use meshwright::index::Label;
use meshwright::io::read_image;
use meshwright::lattice::{self, Options, PARAMETERS};
use meshwright::mesh::quality::mesh_quality;
use meshwright::parameters::ParameterSet;

mod process_usage;
use process_usage::usage;

/// Parcels of the made head.
const PARCELS: u64 = 96;

/// A head: an ellipsoid with folds, its parcels the regions nearest to random places, two ventricles cut out as labels.
fn head(size: usize) -> LabelImage {
    let extent = [size * 5 / 6, size, size * 5 / 6];
    let half = DVec3::from_array(extent.map(|n| n as f64 / 2.0));
    let number = |seed: u64| (mix(seed) >> 11) as f64 / (1u64 << 53) as f64;
    let places: Vec<DVec3> = (0..PARCELS)
        .map(|parcel| {
            let of = |axis: u64| 2.0 * number(3 * parcel + axis + 1) - 1.0;
            // Well inside, so that every parcel is more than a splinter.
            DVec3::new(of(0), of(1), of(2)).clamp_length_max(0.7)
        })
        .collect();
    let label = |at: DVec3| {
        let (x, y, z) = (at.x * 9.0, at.y * 9.0, at.z * 9.0);
        let folds = 0.05 * (x.sin() * y.cos() + y.sin() * z.cos() + z.sin() * x.cos());
        if at.length() > 0.86 + folds {
            return 0;
        }
        let ventricle = DVec3::new((at.x.abs() - 0.12) / 0.06, at.y / 0.35, (at.z - 0.1) / 0.14);
        if ventricle.length() < 1.0 {
            return 1 + u16::from(at.x > 0.0);
        }
        let nearest = (0..places.len())
            .min_by(|l, r| at.distance_squared(places[*l]).total_cmp(&at.distance_squared(places[*r])))
            .unwrap_or(0);
        3 + nearest as u16
    };
    let [ni, nj, nk] = extent;
    let voxels = (0..ni * nj * nk)
        .map(|v| {
            let voxel = DVec3::new((v % ni) as f64, (v / ni % nj) as f64, (v / ni / nj) as f64);
            Label(label((voxel + 0.5 - half) / half))
        })
        .collect();
    let grid = Grid::new(extent, DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).expect("a valid grid");
    LabelImage::new(grid, voxels, (0..=PARCELS as i32 + 2).collect()).expect("labels within the table")
}

/// Meshes one case in this process; prints tets, CPU and wall seconds, bytes per tet, smallest and largest angle.
fn run_case(image: &LabelImage, threads: &str, smoothing: &str) {
    let mut set = ParameterSet::new(PARAMETERS);
    set.set_text("smoothing-iterations", smoothing).expect("--smoothing takes numbers");
    let options = Options::from_parameters(&set).expect("valid options");
    let context = RunContext::with_threads(threads.parse().expect("--threads takes numbers")).expect("threads");
    let (cpu, _) = usage();
    let clock = Instant::now();
    let (output, _) = lattice::run(image, &options, &context).expect("an image that can be meshed");
    let wall = clock.elapsed().as_secs_f64();
    let (cpu_end, peak) = usage();
    let tets = output.mesh.element_count();
    let beyond = peak.saturating_sub(4 * std::mem::size_of_val(image.voxels()) as u64);
    let quality = mesh_quality(&output.mesh, &context).expect("a run that nobody cancels").statistics();
    let angle = |name: &str| quality.value(name).unwrap_or(f64::NAN);
    println!(
        "{tets},{:.2},{wall:.2},{:.0},{:.1},{:.1}",
        cpu_end - cpu,
        beyond as f64 / tets as f64,
        angle("quality.min_dihedral"),
        angle("quality.max_dihedral")
    );
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let value = |name: &str, default: &str| {
        let place = arguments.iter().position(|a| a == name);
        place.and_then(|i| arguments.get(i + 1)).cloned().unwrap_or_else(|| default.to_owned())
    };
    let (file, size) = (value("--image", ""), value("--size", "181"));
    let (threads, smoothing) = (value("--threads", "1,2"), value("--smoothing", "0,5"));
    if arguments.iter().any(|a| a == "--row") {
        let image = match file.as_str() {
            "" => head(size.parse().expect("--size takes a number")),
            path => read_image(Path::new(path)).and_then(|i| i.to_label_image()).expect("a readable label image"),
        };
        return run_case(&image, &threads, &smoothing);
    }
    println!(
        "case,smoothing,threads,tets,cpu_s,wall_s,tets_per_cpu_s,bytes_per_tet,min_dihedral,max_dihedral,speed_up"
    );
    let program = std::env::current_exe().expect("the path of this program");
    let images: Vec<&str> = if file.is_empty() { vec![""] } else { vec!["", &file] };
    for image in images {
        let case = Path::new(image).file_name().map_or("head".into(), |name| name.to_string_lossy());
        for iterations in smoothing.split(',') {
            let mut first = None;
            for count in threads.split(',') {
                let mut command = Command::new(&program);
                command.args(["--row", "--size", &size, "--threads", count, "--smoothing", iterations]);
                if !image.is_empty() {
                    command.args(["--image", image]);
                }
                let output = command.output().expect("this program starts itself");
                assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
                let row = String::from_utf8_lossy(&output.stdout).trim().to_owned();
                let columns: Vec<f64> = row.split(',').map(|c| c.parse().unwrap_or(f64::NAN)).collect();
                let [tets, cpu, wall, memory, low, high] = columns[..] else { panic!("a row of six: {row}") };
                let speed_up = *first.get_or_insert(wall) / wall;
                println!(
                    "{case},{iterations},{count},{tets},{cpu},{wall},{:.0},{memory},{low},{high},{speed_up:.2}",
                    tets / cpu
                );
            }
        }
    }
}
