//! Whole runs of the engine on shapes made here.

use glam::DVec3;

use super::test_surfaces::{chazelle, cube, joined, mapped, sphere, surface_of, translated, twisted_prism};
use super::*;
use crate::geometry::predicates::orient3d;
use crate::geometry::tetrahedron::dihedral_cosines;
use crate::mesh::validation::check_mixed_mesh;

fn options() -> Options {
    Options { refine: false, ..Options::default() }
}

fn volume(mesh: &MixedMesh) -> f64 {
    let tets = mesh.tets().unwrap();
    tets.iter().map(|t| t.map(|v| mesh.points[v.index()])).map(|[a, b, c, d]| orient3d(a, b, c, d) / 6.0).sum()
}

/// Runs without refinement and checks validity, points, and that exactly the facets are the boundary.
fn meshed(surface: &SurfaceMesh, options: &Options) -> (MixedMesh, Report) {
    let context = RunContext::with_threads(1).unwrap();
    let (mesh, report) = run(surface, None, options, &context).unwrap();
    check_mixed_mesh(&mesh).unwrap();
    assert_eq!(mesh.points[..surface.points.len()], surface.points[..]);
    assert_eq!(mesh.boundary.triangles.len(), surface.facets.len());
    (mesh, report)
}

#[test]
fn a_cube_keeps_its_triangles() {
    let (mesh, report) = meshed(&cube(4), &options());
    assert!((volume(&mesh) - 1.0).abs() < 1e-12);
    assert_eq!(report.recovery.steiner_in_volume, 0);
}

#[test]
fn a_sphere_is_meshed_at_any_scale_and_offset() {
    for (scale, offset) in [(1.0, 0.0), (1e-6, 0.0), (1e6, 0.0), (1.0, 1e6)] {
        let surface = mapped(&sphere(3), |p| p * scale + DVec3::splat(offset));
        let (_, report) = meshed(&surface, &options());
        assert_eq!(report.recovery.steiner_in_volume, 0, "{scale} {offset}");
    }
}

/// Schoenhardt's polyhedron: a prism over a triangle, its top turned, with the diagonals that bend inwards.
fn schoenhardt(turn: f64) -> SurfaceMesh {
    let ring = |z: f64, turn: f64| {
        (0..3).map(move |i| {
            let angle = (f64::from(i) * 120.0 + turn).to_radians();
            [angle.cos(), angle.sin(), z]
        })
    };
    let points: Vec<[f64; 3]> = ring(0.0, 0.0).chain(ring(1.0, turn)).collect();
    let mut facets = vec![[0, 2, 1], [3, 4, 5]];
    for i in 0..3 {
        let j = (i + 1) % 3;
        facets.extend([[i, j, 3 + j], [i, 3 + j, 3 + i]]);
    }
    surface_of(&points, &facets)
}

#[test]
fn schoenhardts_polyhedron_needs_one_point() {
    for turn in [-30.0, 30.0] {
        let (_, report) = meshed(&schoenhardt(turn), &options());
        assert!(report.recovery.steiner_in_volume <= 1);
    }
}

#[test]
fn thin_plates_and_needles_are_meshed() {
    let plate = mapped(&cube(3), |p| p * DVec3::new(1.0, 1.0, 0.1));
    let other = mapped(&cube(4), |p| p * DVec3::new(1.0, 1.0, 0.1));
    let plates = joined(&[plate, translated(&other, DVec3::new(0.03, 0.02, 0.1 + 1e-6))]);
    let (mesh, _) = meshed(&plates, &options());
    assert!((volume(&mesh) - 0.2).abs() < 1e-9);
    let needles = mapped(&cube(6), |p| p * DVec3::new(1.0, 1e-3, 1e-3));
    meshed(&needles, &options());
}

#[test]
fn regions_holes_and_nesting_follow_the_rules() {
    let inner = mapped(&cube(1), |p| p * 0.5 + DVec3::splat(0.25));
    let nested = joined(&[cube(2), inner]);
    let (mesh, report) = meshed(&nested, &options());
    assert_eq!((report.regions, mesh.labels.iter().max()), (2, Some(&2)));
    assert!((volume(&mesh) - 1.0).abs() < 1e-12);
    let nesting = Options { domain: options::DomainRule::Nesting, ..options() };
    let (mesh, _) = meshed(&nested, &nesting);
    assert!((volume(&mesh) - 0.875).abs() < 1e-12);
    let mut hollow = nested.clone();
    hollow.holes.push(DVec3::splat(0.5));
    let (mesh, _) = meshed(&hollow, &options());
    assert!((volume(&mesh) - 0.875).abs() < 1e-12);
    let mut labelled = nested;
    let seed = crate::mesh::surface_mesh::RegionSeed { point: DVec3::splat(0.5), label: 1, size: None };
    labelled.regions.push(seed);
    let (mesh, _) = meshed(&labelled, &options());
    let inner_volume: f64 = mesh
        .tets()
        .unwrap()
        .iter()
        .zip(&mesh.labels)
        .filter(|(_, label)| **label == 1)
        .map(|(t, _)| t.map(|v| mesh.points[v.index()]))
        .map(|[a, b, c, d]| orient3d(a, b, c, d) / 6.0)
        .sum();
    assert!((inner_volume - 0.125).abs() < 1e-12);
}

#[test]
fn a_sheet_inside_is_kept() {
    let sheet =
        surface_of(&[[0.2, 0.2, 0.4], [0.7, 0.25, 0.45], [0.75, 0.7, 0.5], [0.3, 0.8, 0.55]], &[[0, 1, 2], [0, 2, 3]]);
    let (mesh, _) = meshed(&joined(&[cube(3), sheet]), &options());
    assert!((volume(&mesh) - 1.0).abs() < 1e-12);
    assert_eq!(mesh.boundary.labels.iter().filter(|l| **l == [1, 1]).count(), 2);
}

#[test]
fn recovery_that_fails_is_attempted_anew_but_not_for_ever() {
    let missing = || crate::error::Error::NoResult { message: String::new(), findings: Vec::new() };
    for successful in 0..MOST_ATTEMPTS {
        let result = first_recovered(|deeper| if deeper == successful { Ok(deeper) } else { Err(missing()) });
        assert_eq!(result.unwrap(), successful);
    }
    let mut attempts = 0;
    let failed: Result<()> = first_recovered(|_| {
        attempts += 1;
        Err(missing())
    });
    assert!(attempts == MOST_ATTEMPTS && matches!(failed, Err(crate::error::Error::NoResult { .. })));
    // What does not come from the mesh ends it at once.
    let mut attempts = 0;
    let cancelled: Result<()> = first_recovered(|_| {
        attempts += 1;
        Err(crate::error::Error::Cancelled)
    });
    assert!(attempts == 1 && matches!(cancelled, Err(crate::error::Error::Cancelled)));
}

#[test]
fn an_open_surface_is_refused() {
    let mut surface = cube(2);
    surface.facets.pop();
    let result = run(&surface, None, &options(), &RunContext::with_threads(1).unwrap());
    let Err(crate::error::Error::InvalidInput { findings, .. }) = result else { panic!() };
    assert_eq!(findings.len(), 3);
}

/// Refines with so many threads and checks that the surface is kept exactly and tets off the surface are well shaped.
fn refined(surface: &SurfaceMesh, threads: usize, volume_wanted: f64) -> MixedMesh {
    let context = RunContext::with_threads(threads).unwrap();
    let (mesh, _) = run(surface, None, &Options::default(), &context).unwrap();
    check_mixed_mesh(&mesh).unwrap();
    assert_eq!(mesh.points[..surface.points.len()], surface.points[..]);
    assert!((volume(&mesh) - volume_wanted).abs() < 1e-9 * volume_wanted);
    let sorted = |faces: &[[VertexId; 3]]| {
        let turned = |mut face: [VertexId; 3]| {
            face.sort_unstable();
            face
        };
        let mut rows: Vec<[VertexId; 3]> = faces.iter().copied().map(turned).collect();
        rows.sort_unstable();
        rows
    };
    assert_eq!(sorted(&mesh.boundary.triangles), sorted(&surface.facets));
    let is_inner = |tet: &&[VertexId; 4]| tet.iter().all(|v| v.index() >= surface.points.len());
    let tets = mesh.tets().unwrap();
    let inner: Vec<_> = tets.iter().filter(is_inner).collect();
    assert!(!inner.is_empty());
    for tet in inner {
        let (smallest_cosine_bound, row) = (12.0_f64.to_radians().cos(), tet.map(|v| mesh.points[v.index()]));
        assert!(dihedral_cosines(row).0 < smallest_cosine_bound, "{tet:?}");
    }
    mesh
}

#[test]
fn a_refined_cube_keeps_its_surface() {
    for threads in [1, 2] {
        refined(&cube(8), threads, 1.0);
    }
}

#[test]
fn a_refined_sphere_keeps_its_surface() {
    let surface = sphere(4);
    let corner = |f: &[VertexId; 3]| f.map(|v| surface.points[v.index()]);
    let enclosed = surface.facets.iter().map(corner).map(|[a, b, c]| a.dot(b.cross(c)) / 6.0).sum();
    let first = refined(&surface, 1, enclosed);
    let again = refined(&surface, 1, enclosed);
    assert_eq!((first.points, first.boundary.triangles), (again.points, again.boundary.triangles));
    refined(&surface, 2, enclosed);
}

#[test]
fn small_meshes_are_the_same_for_any_number_of_threads() {
    // Improvement needs spare vertices here, which the threads share.
    let surface = chazelle(3, 0.1);
    let mesh_of = |threads| {
        let context = RunContext::with_threads(threads).unwrap();
        run(&surface, None, &Options::default(), &context).unwrap().0
    };
    let [one, two] = [1, 2].map(mesh_of);
    assert_eq!(one.points, two.points);
    assert_eq!(one.tets().unwrap(), two.tets().unwrap());
}

#[test]
fn limits_end_a_run_with_or_without_refinement() {
    for refine in [false, true] {
        let options = Options { refine, maximum_elements: 20, ..Options::default() };
        let result = run(&cube(4), None, &options, &RunContext::with_threads(1).unwrap());
        assert!(matches!(result, Err(crate::error::Error::LimitReached { .. })));
    }
}

#[test]
fn a_mesh_that_outgrows_its_prediction_stops_at_the_limit() {
    let surface = sphere(4);
    let context = RunContext::with_threads(1).unwrap();
    let free = Options { edge_satisfied_factor: 1.2, near_point_factor: 0.5, ..Options::default() };
    let (whole, report) = run(&surface, None, &free, &context).unwrap();
    let predicted = report.refinement.value("refinement.predicted_tets").unwrap();
    let limit = predicted.ceil() as usize + 1;
    assert!(whole.element_count() > limit + limit / 10, "{} of {predicted}", whole.element_count());
    let limited = Options { maximum_elements: limit, ..free };
    let (mesh, report) = run(&surface, None, &limited, &context).unwrap();
    check_mixed_mesh(&mesh).unwrap();
    assert_eq!(report.refinement.value("refinement.stopped_at_limit"), Some(1.0));
    assert!(mesh.element_count() <= limit && mesh.element_count() > limit / 2);
    assert!(context.take_findings().iter().any(|f| f.text.contains("stopped")));
}

#[test]
fn improvement_leaves_no_more_slivers_than_its_passes() {
    // A plate 300 times thinner than its triangles are wide: nearly every tet is a sliver, whatever is done.
    let plate = mapped(&twisted_prism(24, 0.1, 1), |p| p * DVec3::new(1.0, 1.0, 1.0 / 300.0));
    let options = Options { quality_statistics: true, ..Options::default() };
    let (_, report) = meshed(&plate, &options);
    let value = |name: &str| report.refinement.value(name).unwrap();
    let slivers = value("quality.slivers");
    for pass in 1..=options.quality_passes {
        assert!(slivers > 0.0 && slivers <= value(&format!("quality.pass.{pass}.quality.slivers")));
    }
    assert_eq!(value("quality.restored"), 1.0);
}
