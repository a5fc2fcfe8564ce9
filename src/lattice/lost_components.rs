//! Components of the image that have no element: looked for once more when smoothing is over, and told.
//!
//! # Method
//! 1. Refinement lists the components that no lattice fine enough holds (`CandidateMesh::lost`).
//! 2. After smoothing, each component of at most `LARGEST` voxels is looked for among the elements of its label: one whose box
//!    comes within `NEAR` of a voxel of it stands for it. Larger ones have elements inside, which no surface reaches.
//! 3. Each component that is lost becomes a finding with its first voxel.
//!
//! # Limits
//! An element of the same label that is no farther than a voxel counts also where it belongs to another component.
//!
//! # Cost
//! One parallel sweep over the elements, where the image has small components.

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::context::RunContext;
use crate::error::{Finding, FindingCode, Result, Severity};
use crate::image::connected_components::{Component, Components, Connectivity, Members};
use crate::image::label_image::LabelImage;
use crate::image::voxel_blocks::{VoxelBlocks, box_of, touched_box};
use crate::index::Label;
use crate::lattice::candidate_mesh::CandidateMesh;

/// Voxels of the largest component that is looked for: a ball of five voxels across.
const LARGEST: u64 = 64;

/// How far from its voxels the elements of a component may be, in voxels: smoothing rounds off a lone element of one voxel.
const NEAR: f64 = 0.5;

/// Elements per parallel work item.
const CHUNK: usize = 4096;

/// Adds the small components without an element to those that the lattice has lost.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn find_lost(mesh: &mut CandidateMesh, image: &LabelImage, context: &RunContext) -> Result<()> {
    let components = Components::new(image, Connectivity::Vertex, Members::Foreground, context)?;
    let is_small = |c: u32| components.components()[c as usize].voxels <= LARGEST;
    let [_, nj, nk] = image.grid().size();
    let rows = (0..nk).flat_map(|k| (0..nj).map(move |j| (j, k)));
    let runs = rows.flat_map(|(j, k)| components.row(j, k).iter().map(move |run| (j, k, run)));
    let mut sought: FxHashMap<[u32; 3], u32> = FxHashMap::default();
    for (j, k, run) in runs.filter(|(.., run)| is_small(run.component)) {
        sought.extend((run.begin..run.end).map(|i| ([i, j as u32, k as u32], run.component)));
    }
    if sought.is_empty() {
        return Ok(());
    }
    let blocks = VoxelBlocks::new(image.grid().size(), sought.keys().copied());
    let label_of = |c: u32| components.components()[c as usize].label;
    let mut has_small = vec![false; image.label_count()];
    sought.values().for_each(|c| has_small[label_of(*c).index()] = true);
    let seen_by = |(corners, label): ([DVec3; 4], Label)| {
        let [low, high] = touched_box(&corners, image, NEAR);
        let voxels = blocks.hold_any([low, high]).then(|| box_of(low, high)).into_iter().flatten();
        let found = voxels.filter_map(|voxel| sought.get(&voxel).copied());
        found.filter(move |c| label_of(*c) == label).collect::<Vec<u32>>()
    };
    let elements = mesh.tets.par_iter().zip(&mesh.tet_labels).with_min_len(CHUNK);
    let elements = elements.filter(|(_, label)| has_small[label.index()]);
    let corners = elements.map(|(tet, label)| (tet.map(|v| mesh.points[v.index()]), *label));
    let mut seen: Vec<u32> = context.until_cancelled(corners).flat_map_iter(seen_by).collect();
    context.check()?;
    seen.sort_unstable();
    let mut unseen: Vec<u32> = sought.into_values().filter(|c| seen.binary_search(c).is_err()).collect();
    unseen.sort_unstable();
    unseen.dedup();
    for component in unseen.into_iter().map(|c| components.components()[c as usize]) {
        if !mesh.lost.iter().any(|known| known.first == component.first) {
            mesh.lost.push(component);
        }
    }
    Ok(())
}

/// Tells the components that are lost; `values` are the caller's labels.
pub fn tell_lost(lost: &[Component], image: &LabelImage, values: &[i32], context: &RunContext) {
    if lost.is_empty() {
        return;
    }
    let counts = image.voxel_counts();
    for component in lost {
        let value = values[component.label.index()];
        let is_whole = counts[component.label.index()] == component.voxels;
        let code = if is_whole { FindingCode::LabelLost } else { FindingCode::ComponentLost };
        let text = format!("a component of label {value} with {} voxels has no element", component.voxels);
        let place = image.grid().index_to_world(DVec3::from_array(component.first.map(|v| v as f64)));
        let finding = Finding::new(code, Severity::Warning, text);
        context.report(finding.with_ids(i64::from(value), component.voxels as i64).at(place.to_array()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::VertexId;
    use crate::lattice::test_images::voxel_image;

    #[test]
    fn a_component_without_an_element_of_its_label_is_told_once() {
        // One tet of label 1 around voxel (1, 1, 1); voxels of label 1 there and at (6, 6, 6), of label 2 beside the tet.
        let image = voxel_image(8, |p| {
            let is = |at: DVec3| p == at;
            u16::from(is(DVec3::ONE) || is(DVec3::splat(6.0))) + 2 * u16::from(is(DVec3::new(2.0, 0.0, 0.0)))
        });
        let points = [[0.6, 0.6, 0.6], [2.4, 0.6, 0.6], [0.6, 2.4, 0.6], [0.6, 0.6, 2.4]].map(DVec3::from_array);
        let mut mesh = CandidateMesh {
            points: points.to_vec(),
            tets: vec![[0, 1, 2, 3].map(VertexId)],
            tet_labels: vec![Label(1)],
            ..CandidateMesh::default()
        };
        let context = RunContext::with_threads(1).unwrap();
        find_lost(&mut mesh, &image, &context).unwrap();
        find_lost(&mut mesh, &image, &context).unwrap();
        tell_lost(&mesh.lost, &image, &[0, 10, 20], &context);
        let findings = context.take_findings();
        let told: Vec<(FindingCode, [i64; 2])> = findings.iter().map(|f| (f.code, f.ids)).collect();
        assert_eq!(told, [(FindingCode::LabelLost, [20, 1]), (FindingCode::ComponentLost, [10, 1])]);
    }
}
