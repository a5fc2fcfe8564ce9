//! Every option of the table has an effect: on the mesh, or on the figures where it has nothing to do with the mesh.

use glam::DVec3;

use super::options::{FIXED, Options, PARAMETERS};
use super::run;
use super::test_surfaces::{cube, joined, mapped, sphere};
use crate::context::RunContext;
use crate::error::Error;
use crate::mesh::mixed_mesh::MixedMesh;
use crate::mesh::surface_mesh::SurfaceMesh;
use crate::parameters::ParameterSet;
use crate::statistics::Statistics;

/// A lump without symmetry.
fn lump() -> SurfaceMesh {
    mapped(&sphere(3), |p| p * (1.0 + 0.2 * (3.0 * p.x + 1.0).sin() * (2.0 * p.y + 0.5).cos()))
}

/// A flat lump with skinny triangles, where slivers and bad angles are.
fn flat_lump() -> SurfaceMesh {
    mapped(&lump(), |p| p * DVec3::new(1.0, 0.5, 0.12))
}

/// A cube in a cube.
fn nested() -> SurfaceMesh {
    joined(&[cube(3), mapped(&cube(2), |p| 0.3 + 0.4 * p)])
}

/// Options that files, other modules or their own tests answer for, with the place.
const ELSEWHERE: &[(&str, &str)] = &[
    ("plc", "a file"),
    ("output", "a file"),
    ("background", "a file; the field of a background mesh: mesh::size_field"),
    ("hole", "pipeline: added to the surface"),
    ("region", "pipeline: added to the surface"),
    ("patch-role", "pipeline: added to the surface"),
    ("touch-tolerance", "input_check"),
    ("recursion-depth", "boundary_recovery: where recursion starts"),
    ("edge-removal-limit", "boundary_recovery: where removals start"),
    ("discontinuity-angle", "boundary_slivers"),
    ("surface-angle-limit", "boundary_slivers"),
    ("delete-boundary-slivers", "boundary_slivers"),
    ("boundary-sliver-repeats", "boundary_slivers"),
    ("boundary-sliver-angle", "boundary_slivers"),
    ("buckets", "parallel_reconnection"),
    ("quality-buckets", "parallel_reconnection"),
    ("transfer-fraction", "parallel_reconnection"),
    ("transfer-reduction", "parallel_reconnection"),
    ("quality-transfer-fraction", "parallel_reconnection"),
    ("quality-transfer-reduction", "parallel_reconnection"),
    ("delete-small-edges", "parallel_reconnection: collapse of short edges"),
    ("small-edge-factor", "parallel_reconnection: collapse of short edges"),
    ("reserved-elements", "memory only"),
];

/// Name, values that both runs have, the value of the second run.
type Effect = (&'static str, &'static [(&'static str, &'static str)], &'static str);

const ON_LUMP: &[Effect] = &[
    ("sort-points", &[], "1"),
    ("boundary-recovery", &[], "0"),
    ("size-factor", &[], "0.8"),
    ("size-minimum-weight", &[], "1"),
    ("growth-rate", &[], "3"),
    ("size-limit", &[], "0.1"),
    ("size-source", &[], "point:0,0,0,0.05"),
    ("size-source", &[], "line:0,0,0,0.1,0.2,0.3,0.05"),
    ("size-source", &[], "box:0,0,0,0.2,0.2,0.2,0.06"),
    ("size-source", &[], "sphere:0,0,0,0.1,0.06"),
    ("refine", &[], "off"),
    ("near-point-factor", &[], "1"),
    ("edge-satisfied-factor", &[], "1.1"),
    ("satisfied-angle", &[], "120"),
    ("normal-mode", &[], "0"),
    ("minimum-points", &[], "1000"),
    ("count-slivers", &[], "on"),
    ("maximum-passes", &[], "1"),
    ("reconnection-criterion", &[], "1"),
    ("reconnection-criterion", &[("reconnection-criterion", "1")], "3"),
    ("repeat-reconnection", &[("quality-passes", "0")], "on"),
    ("flip-44", &[], "on"),
    ("low-quality-surface-angle", &[], "0"),
    ("quality-passes", &[], "0"),
    ("quality-statistics", &[], "on"),
    ("refinement-threads", &[], "1"),
    ("quality-threads", &[], "1"),
    ("pin-threads", &[], "on"),
    ("group-active", &[("sort-new-points", "off")], "off"),
    ("sort-new-points", &[], "off"),
];

const ON_FLAT_LUMP: &[Effect] = &[
    ("location-mode", &[("location-tolerance", "0.001"), ("size-limit", "0.04")], "1"),
    ("location-tolerance", &[("location-mode", "1"), ("size-limit", "0.04")], "0.001"),
    ("quality-reconnection-criterion", &[], "3"),
    ("final-reconnection-criterion", &[], "3"),
    ("flip-44-quality", &[], "off"),
    ("quality-repeats", &[("repeat-angle", "90")], "0"),
    ("repeat-angle", &[("repeat-angle", "90")], "179.9"),
    ("mask-angle", &[], "170"),
    ("quality-angle", &[], "75"),
    ("smoothing-iterations", &[], "0"),
    ("smoothing-coefficient", &[], "0.9"),
    ("boundary-smoothing-factor", &[], "0"),
    ("smoothing-mode", &[], "2"),
    ("smart-smoothing", &[], "off"),
    ("delete-field-slivers", &[], "off"),
    ("field-sliver-repeats", &[("field-sliver-angle", "120")], "0"),
    ("field-sliver-angle", &[], "120"),
    ("group-active-quality", &[], "off"),
    ("sort-quality", &[], "on"),
];

/// Mesh and figures, times left out.
type Outcome = (MixedMesh, Vec<(String, f64)>);

fn result_of(surface: &SurfaceMesh, values: &[(&str, &str)], threads: usize) -> Outcome {
    let mut set = ParameterSet::new(PARAMETERS);
    values.iter().for_each(|(name, text)| set.set_text(name, text).unwrap());
    let options = Options::from_parameters(&set).unwrap();
    let context = RunContext::with_threads(threads).unwrap();
    let (mesh, report) = run(surface, None, &options, &context).unwrap();
    let statistics: Statistics = report.statistics();
    (mesh, statistics.entries().iter().filter(|(name, _)| !name.contains("time")).cloned().collect())
}

/// Whether an effect shows beside what is `before`, a mesh with the values that both runs have.
fn acts_beside(before: &Outcome, surface: &SurfaceMesh, (name, common, value): &Effect) -> bool {
    let mut changed = common.to_vec();
    changed.push((name, value));
    if ["refinement-threads", "quality-threads"].contains(name) {
        // With several threads two meshes differ anyway: only the counts are compared.
        let counts = |values: &[(&str, &str)]| -> Vec<_> {
            result_of(surface, values, 2).1.into_iter().filter(|(name, _)| name.ends_with(".threads")).collect()
        };
        return counts(common) != counts(&changed);
    }
    let after = result_of(surface, &changed, 1);
    before.0.points != after.0.points || before.0.tets().unwrap() != after.0.tets().unwrap() || before.1 != after.1
}

/// Those effects that do not show. What several are seen beside is meshed once.
fn idle(surface: &SurfaceMesh, effects: &[Effect]) -> Vec<&'static str> {
    let mut known: Vec<(&[(&str, &str)], Outcome)> = Vec::new();
    let mut idle = Vec::new();
    for effect @ (name, common, _) in effects {
        let at = known.iter().position(|(values, _)| values == common).unwrap_or_else(|| {
            known.push((common, result_of(surface, common, 1)));
            known.len() - 1
        });
        if !acts_beside(&known[at].1, surface, effect) {
            idle.push(*name);
        }
    }
    idle
}

#[test]
fn options_of_sizes_and_refinement_have_effects() {
    assert_eq!(idle(&lump(), ON_LUMP), [""; 0]);
}

#[test]
fn options_of_quality_improvement_have_effects() {
    assert_eq!(idle(&flat_lump(), ON_FLAT_LUMP), [""; 0]);
}

#[test]
fn the_domain_rule_and_limits_have_effects() {
    assert_eq!(idle(&nested(), &[("domain", &[("refine", "off")], "nesting")]), [""; 0]);
    let unlimited = result_of(&cube(3), &[], 1).0.labels.len();
    for (name, value) in [("maximum-elements", "20"), ("maximum-memory", "0.001")] {
        let mut set = ParameterSet::new(PARAMETERS);
        set.set_text(name, value).unwrap();
        let options = Options::from_parameters(&set).unwrap();
        match run(&cube(3), None, &options, &RunContext::with_threads(1).unwrap()) {
            Err(error) => assert!(matches!(error, Error::LimitReached { .. }), "{name}: {error}"),
            Ok((mesh, _)) => assert!(mesh.labels.len() < unlimited, "{name}"),
        }
    }
}

#[test]
fn every_option_of_the_table_is_tried_somewhere() {
    let tried = ON_LUMP.iter().chain(ON_FLAT_LUMP).map(|(name, ..)| *name);
    let known: Vec<&str> = tried
        .chain(ELSEWHERE.iter().map(|(name, _)| *name))
        .chain(FIXED.iter().copied())
        .chain(["domain", "maximum-elements", "maximum-memory"])
        .collect();
    let missing: Vec<&str> = PARAMETERS.iter().map(|p| p.name).filter(|name| !known.contains(name)).collect();
    assert!(missing.is_empty(), "{missing:?}");
}
