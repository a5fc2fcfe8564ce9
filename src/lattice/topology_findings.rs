//! Where the mesh that is handed back has another topology than is asked for: looked at when smoothing is over, and told.
//!
//! # Method
//! Of the elements as they are at the end, whatever step made them so:
//! 1. Each label with more pieces than the image has components through faces becomes a finding, and each with fewer than it has
//!    components through faces, edges and vertices, without those that are told as lost.
//! 2. So does each vertex at which the surface of a label pinches, with its place,
//! 3. and, where the topology is checked, each label with another Euler number than the image's ([`super::euler_ranges`]).
//!
//! # Source
//! [Drakopoulos2017] 2.3.3: the checks are the thesis's, made once more at the end.
//!
//! # Limits
//! Two of the same label that are off by as much in opposite directions hide each other in the sums of 1 and 3.
//!
//! # Cost
//! For 1 a look at every element, 4 bytes a tet while it lasts; for 2 one at every vertex, and 16 bytes a tet.

use crate::context::RunContext;
use crate::error::{Finding, FindingCode, Result, Severity};
use crate::image::connected_components::{Connectivity, component_counts};
use crate::image::euler_numbers::euler_numbers;
use crate::image::label_image::LabelImage;
use crate::index::Label;
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::euler_ranges::EulerRanges;
use crate::lattice::interface_topology::InterfaceTopology;
use crate::lattice::mesh_regions::{regions_of, surplus_of};

/// Tells which labels of a mesh of tets have other pieces than in the image; `neighbors` of the tets, `values` are the caller's
/// labels.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn tell_pieces(
    mesh: &CandidateMesh,
    neighbors: &[[u32; 4]],
    image: &LabelImage,
    values: &[i32],
    context: &RunContext,
) -> Result<()> {
    let regions = regions_of(&mesh.tet_labels, neighbors, context)?;
    let broken = surplus_of(&regions, &component_counts(image, Connectivity::Face, context)?);
    let mut apart = component_counts(image, Connectivity::Vertex, context)?;
    mesh.lost.iter().for_each(|lost| apart[lost.label.index()] -= 1);
    let joined = surplus_of(&regions, &apart);
    for ((value, broken), joined) in values.iter().zip(broken).zip(joined) {
        let (off, text) = if broken > 0 {
            (broken, format!("the mesh of label {value} has {broken} regions more than the image"))
        } else if joined < 0 {
            let count = -joined;
            (joined, format!("the mesh of label {value} has {count} regions fewer than the image: it joins components"))
        } else {
            continue;
        };
        let finding = Finding::new(FindingCode::DisconnectedMesh, Severity::Warning, text);
        context.report(finding.with_ids(i64::from(*value), off));
    }
    Ok(())
}

/// Tells where the surfaces of a mesh of tets are not manifold, and where the topology is checked which labels have other Euler
/// numbers than in the image; `neighbors` of the tets, `values` are the caller's labels. Returns how many vertices are not manifold.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn tell_topology(
    mesh: &CandidateMesh,
    neighbors: &[[u32; 4]],
    image: &LabelImage,
    values: &[i32],
    is_checked: bool,
    context: &RunContext,
) -> Result<usize> {
    let (tets, labels) = (bytemuck::cast_slice(&mesh.tets), &mesh.tet_labels);
    let topology = InterfaceTopology::new(tets, neighbors, mesh.points.len(), context)?;
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
    if is_checked {
        let of_image = euler_numbers(image, context)?;
        tell_euler_numbers(&topology.euler_ranges(labels, &of_image, context)?, values, context);
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
    use crate::image::connected_components::Component;
    use crate::index::VertexId;
    use crate::lattice::face_adjacency::neighbors_of;
    use crate::lattice::test_images::voxel_image;
    use glam::DVec3;

    /// What is told of tets of label 1 with the given vertices out of eight at the corners of a cube.
    fn told(tets: &[[u32; 4]]) -> Vec<(FindingCode, [i64; 2])> {
        told_of(&voxel_image(4, |p| u16::from(p == DVec3::ONE)), tets, Vec::new())
    }

    fn told_of(image: &LabelImage, tets: &[[u32; 4]], lost: Vec<Component>) -> Vec<(FindingCode, [i64; 2])> {
        let corner = |v: u32| DVec3::new(f64::from(v & 1), f64::from(v >> 1 & 1), f64::from(v >> 2));
        let mesh = CandidateMesh {
            points: (0..8).map(corner).collect(),
            tets: tets.iter().map(|t| t.map(VertexId)).collect(),
            tet_labels: vec![Label(1); tets.len()],
            lost,
            ..CandidateMesh::default()
        };
        let context = RunContext::with_threads(1).unwrap();
        let neighbors = neighbors_of(tets, 8, &context).unwrap();
        let [unchecked, told] = [false, true].map(|is_checked| {
            tell_topology(&mesh, &neighbors, image, &[0, 7], is_checked, &context).unwrap();
            tell_pieces(&mesh, &neighbors, image, &[0, 7], &context).unwrap();
            context.take_findings().iter().map(|f| (f.code, f.ids)).collect::<Vec<_>>()
        });
        // All but the Euler numbers is told anyway.
        let others = told.iter().filter(|(code, _)| *code != FindingCode::OtherTopology);
        assert!(unchecked.iter().eq(others), "{unchecked:?}");
        told
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

    #[test]
    fn fewer_pieces_than_the_image_has_are_told_unless_those_missing_are_lost() {
        let image = voxel_image(4, |p| u16::from(p == DVec3::ONE || p == DVec3::splat(3.0)));
        let fewer = (FindingCode::DisconnectedMesh, [7, -1]);
        assert!(told_of(&image, &[[0, 1, 2, 4]], Vec::new()).contains(&fewer));
        let lost = Component { label: Label(1), voxels: 1, first: [3; 3] };
        assert!(!told_of(&image, &[[0, 1, 2, 4]], vec![lost]).contains(&fewer));
        // Voxels that touch at a corner are one piece or two.
        let image = voxel_image(4, |p| u16::from(p == DVec3::ONE || p == DVec3::splat(2.0)));
        for tets in [&[[0, 1, 2, 4]][..], &[[0, 1, 2, 4], [3, 5, 7, 6]]] {
            let told = told_of(&image, tets, Vec::new());
            assert!(told.iter().all(|(code, _)| *code != FindingCode::DisconnectedMesh), "{told:?}");
        }
    }
}
