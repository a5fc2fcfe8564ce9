//! Where the mesh that is handed back has another topology than is asked for: looked at when smoothing is over, and told.
//!
//! # Method
//! Of the elements as they are at the end, whatever step made them so:
//! 1. Each vertex at which the surface of a label pinches becomes a finding with its place.
//! 2. So does each label with more pieces than the image has components through faces,
//! 3. and each label with another Euler number than the image's ([`super::euler_ranges`]).
//!
//! # Source
//! [Drakopoulos2017] 2.3.3: the checks are the thesis's, made once more at the end.
//!
//! # Limits
//! Two of the same label that are off by as much in opposite directions hide each other in the sums of 2 and 3.
//!
//! # Cost
//! Faces are matched once, and every vertex is looked at once. Neighbours and balls take 32 bytes a tet while it lasts.

use crate::context::RunContext;
use crate::error::{Finding, FindingCode, Result, Severity};
use crate::image::euler_numbers::euler_numbers;
use crate::image::label_image::LabelImage;
use crate::index::Label;
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::euler_ranges::EulerRanges;
use crate::lattice::face_adjacency::neighbors_of;
use crate::lattice::interface_topology::InterfaceTopology;
use crate::lattice::mesh_regions::{component_counts, regions_of, surplus_of};

/// Tells where the surfaces of a mesh of tets are not manifold, and which labels have other pieces and Euler numbers than in the
/// image; `values` are the caller's labels. Returns how many vertices are not manifold.
///
/// # Errors
/// Those of [`neighbors_of`]; [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn tell_topology(mesh: &CandidateMesh, image: &LabelImage, values: &[i32], context: &RunContext) -> Result<usize> {
    let (tets, labels) = (bytemuck::cast_slice(&mesh.tets), &mesh.tet_labels);
    let neighbors = neighbors_of(tets, mesh.points.len(), context)?;
    let topology = InterfaceTopology::new(tets, &neighbors, mesh.points.len(), context)?;
    let pinched = topology.pinched(labels, context)?;
    for vertex in &pinched {
        let mut around = topology.labels_around(*vertex, labels).into_iter().filter(|l| !l.is_background());
        let label = around.find(|label| topology.excess_of(*vertex, *label, labels) > 0);
        let value = label.map_or(0, |l| values[l.index()]);
        let text = format!("the surface of label {value} is not manifold at a vertex");
        let finding = Finding::new(FindingCode::NonManifoldMesh, Severity::Warning, text);
        let place = image.grid().local_to_world(mesh.points[*vertex as usize]).to_array();
        context.report(finding.with_ids(i64::from(value), -1).at(place));
    }
    tell_euler_numbers(&topology.euler_ranges(labels, &euler_numbers(image, context)?, context)?, values, context);
    let regions = regions_of(labels, &neighbors, context)?;
    let surplus = surplus_of(&regions, &component_counts(image, values.len(), context)?);
    for (value, count) in values.iter().zip(surplus).filter(|(_, count)| *count > 0) {
        let text = format!("the mesh of label {value} has {count} regions more than the image");
        let finding = Finding::new(FindingCode::DisconnectedMesh, Severity::Warning, text);
        context.report(finding.with_ids(i64::from(*value), count));
    }
    Ok(pinched.len())
}

fn tell_euler_numbers(euler: &EulerRanges, values: &[i32], context: &RunContext) {
    for (label, value) in values.iter().enumerate().skip(1) {
        if let Some([mesh, image]) = euler.out_of_reach(Label(label as u16)) {
            let text = format!("the mesh of label {value} has the Euler number {mesh} instead of the image's {image}");
            let finding = Finding::new(FindingCode::OtherTopology, Severity::Warning, text);
            context.report(finding.with_ids(i64::from(*value), mesh - image));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::VertexId;
    use crate::lattice::test_images::voxel_image;
    use glam::DVec3;

    /// What is told of tets of label 1 with the given vertices out of eight at the corners of a cube.
    fn told(tets: &[[u32; 4]]) -> Vec<(FindingCode, [i64; 2])> {
        let image = voxel_image(4, |p| u16::from(p == DVec3::ONE));
        let corner = |v: u32| DVec3::new(f64::from(v & 1), f64::from(v >> 1 & 1), f64::from(v >> 2));
        let mesh = CandidateMesh {
            points: (0..8).map(corner).collect(),
            tets: tets.iter().map(|t| t.map(VertexId)).collect(),
            tet_labels: vec![Label(1); tets.len()],
            ..CandidateMesh::default()
        };
        let context = RunContext::with_threads(1).unwrap();
        tell_topology(&mesh, &image, &[0, 7], &context).unwrap();
        context.take_findings().iter().map(|f| (f.code, f.ids)).collect()
    }

    #[test]
    fn a_single_tet_for_a_single_voxel_is_nothing_to_tell() {
        assert_eq!(told(&[[0, 1, 2, 4]]), []);
    }

    #[test]
    fn tets_that_touch_at_a_vertex_pinch_and_are_two_regions() {
        let expected = [(FindingCode::NonManifoldMesh, [7, -1]), (FindingCode::DisconnectedMesh, [7, 1])];
        assert_eq!(told(&[[0, 1, 2, 4], [4, 5, 7, 6]]), expected);
    }

    #[test]
    fn tets_apart_have_another_euler_number_too() {
        let expected = [(FindingCode::OtherTopology, [7, 1]), (FindingCode::DisconnectedMesh, [7, 1])];
        assert_eq!(told(&[[0, 1, 2, 4], [3, 5, 7, 6]]), expected);
    }
}
