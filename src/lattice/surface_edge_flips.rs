//! Flips of surface edges that cut off what bends: the two surface triangles at an edge become those at the other diagonal.
//!
//! # Method
//! An edge a b between two labels has one surface triangle to c and one to d. The tets around it form a ring that c and d part
//! into two arcs, one per label. Each arc is triangulated anew, closed by c d, as after an edge removal:
//! ```text
//!          x   vessel                    x   vessel
//!        / | \                         /   \
//!       c--a--d     a above,    ->    c-----d     the surface goes from a b c, a b d
//!        \ | /      b below            \   /      to c d a, c d b
//!          y   wall                      y   wall
//! ```
//! At a crotch an edge from one vessel to the other bridges the crease; the other diagonal runs along it.
//!
//! # Source
//! [FreitagOllivierGooch1997] for swaps of edges at a boundary, [Klincsek1980] for the triangulation of an arc.
//!
//! # Invariants
//! The mesh conforms, every label keeps its topology: c d is no edge before, or one within the label of its only tet between.
//! No score falls below the bound that was not below before. The surface is nearer to where it is to be.

use crate::index::Label;
use crate::lattice::element_score::Part;
use crate::lattice::improvement_mesh::{ImprovementMesh, part_of};
use crate::lattice::local_transformations::{LONGEST_RING, best_triangulation, creates_known_edge};
use crate::lattice::scaffold::SCAFFOLD_ANGLE;
use crate::lattice::subvoxel_surface::Side;
use crate::lattice::surface_cuts::worst_cut;

/// Share of what the surface cuts off that may be left.
const LEFT: f64 = 0.8;

/// Flips a surface edge where the surface comes nearer and no score falls below `bound`, degrees, that was not below before.
pub fn flip_surface_edge(mesh: &mut ImprovementMesh, a: u32, b: u32, bound: f64) -> bool {
    let shell = mesh.shell(a, b);
    if shell.len() < 3 {
        return false;
    }
    let Some(ring) = mesh.ring(a, b, &shell) else { return false };
    let Some([first, second]) = arcs(mesh, [a, b], &shell, &ring) else { return false };
    let [c, d] = [first.vertices[0], second.vertices[0]];
    let at_border = |v: &u32| mesh.sides(*v).iter().any(|s| matches!(s, Side::Border(_)));
    if [a, b, c, d].iter().any(at_border) || !may_join(mesh, [c, d], [&first, &second]) {
        return false;
    }
    let labels = [first.label, second.label];
    let cut = |faces: [[u32; 3]; 2]| worst_cut(mesh, faces.into_iter().map(|corners| (corners, labels)));
    if cut([[c, d, a], [c, d, b]]) > LEFT * cut([[a, b, c], [a, b, d]]) {
        return false;
    }
    let needed = mesh.lowest(&shell).min(bound);
    let mut new = Vec::new();
    for arc in [&first, &second] {
        let needed = if part_of(arc.label) == Part::Scaffold { needed.min(SCAFFOLD_ANGLE) } else { needed };
        let Some(triangles) = best_triangulation(mesh, [a, b], &arc.vertices, needed) else { return false };
        let before = new.len();
        for triangle in triangles {
            let [p, q, r] = triangle.map(|i| arc.vertices[i]);
            new.push(([p, q, r, b], arc.label));
            new.push(([q, p, r, a], arc.label));
        }
        if creates_known_edge(mesh, &arc.vertices, &new[before..]) {
            return false;
        }
    }
    mesh.replace(&shell, &new);
    true
}

/// The vertices around an edge on the side of one label, from one surface triangle to the other.
struct Arc {
    label: Label,
    vertices: Vec<u32>,
}

/// The two arcs of a ring; `None` where the edge is not between two labels or a ring is too long.
fn arcs(mesh: &ImprovementMesh, [a, b]: [u32; 2], shell: &[u32], ring: &[u32]) -> Option<[Arc; 2]> {
    let n = ring.len();
    // The label of the tet from each vertex of the ring to the next.
    let label_after = |i: usize| {
        let has = |t: &&u32| [a, b, ring[i], ring[(i + 1) % n]].iter().all(|v| mesh.tets[**t as usize].contains(v));
        shell.iter().find(has).map(|t| mesh.labels[*t as usize])
    };
    let labels: Vec<Label> = (0..n).map(label_after).collect::<Option<_>>()?;
    let mut changes = (0..n).filter(|i| labels[*i] != labels[(i + n - 1) % n]);
    let (Some(from), Some(to), None) = (changes.next(), changes.next(), changes.next()) else { return None };
    let arc = |from: usize, to: usize| Arc {
        label: labels[from],
        vertices: (0..=(to + n - from) % n).map(|step| ring[(from + step) % n]).collect(),
    };
    let both = [arc(from, to), arc(to, from)];
    both.iter().all(|arc| arc.vertices.len() <= LONGEST_RING).then_some(both)
}

/// Whether the other diagonal may become a surface edge.
fn may_join(mesh: &ImprovementMesh, [c, d]: [u32; 2], arcs: [&Arc; 2]) -> bool {
    let between = mesh.shell(c, d);
    if between.is_empty() {
        return true;
    }
    let only = arcs.into_iter().find(|arc| arc.vertices.len() == 2);
    only.is_some_and(|arc| between.iter().all(|t| mesh.labels[*t as usize] == arc.label))
        && !mesh.is_surface_edge(c, d, &between)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::tetrahedron::volume6;
    use crate::lattice::test_meshes::with_edge_on_ball;
    use glam::DVec3;

    /// Both outer tets first.
    const ORDER: [usize; 4] = [0, 1, 2, 3];

    fn volume_of(mesh: &ImprovementMesh, label: Label) -> f64 {
        let of_label = (0..mesh.tets.len() as u32).filter(|t| mesh.is_live(*t) && mesh.labels[*t as usize] == label);
        of_label.map(|t| volume6(mesh.corners(t))).sum()
    }

    #[test]
    fn the_long_diagonal_over_a_ball_is_flipped_and_the_space_stays_filled() {
        with_edge_on_ball(0.7, ORDER, |mut mesh| {
            let before = [1, 2].map(|label| volume_of(&mesh, Label(label)));
            assert!(flip_surface_edge(&mut mesh, 0, 1, 1.0));
            assert!(mesh.shell(0, 1).is_empty() && mesh.shell(2, 3).len() == 4);
            let after = [1, 2].map(|label| volume_of(&mesh, Label(label)));
            assert!((before[0] + before[1] - after[0] - after[1]).abs() < 1e-9 && after[0] > before[0]);
            assert!((0..mesh.tets.len() as u32).all(|t| !mesh.is_live(t) || volume6(mesh.corners(t)) > 0.0));
            // The way back leads farther off.
            assert!(!flip_surface_edge(&mut mesh, 2, 3, 1.0));
        });
    }

    #[test]
    fn a_flip_that_brings_nothing_or_costs_too_much_is_not_made() {
        with_edge_on_ball(0.3, ORDER, |mut mesh| assert!(!flip_surface_edge(&mut mesh, 0, 1, 1.0)));
        with_edge_on_ball(0.7, ORDER, |mut mesh| {
            let lowest = mesh.lowest(&mesh.shell(0, 1));
            assert!(lowest > 1.0);
            // The outer tets would be flat on the other diagonal.
            mesh.points[4] = mesh.points[2].midpoint(mesh.points[3]) + DVec3::new(0.0, 0.05, 0.0);
            assert!(!flip_surface_edge(&mut mesh, 0, 1, 60.0));
        });
    }

    #[test]
    fn an_edge_within_a_label_is_not_flipped() {
        with_edge_on_ball(0.7, ORDER, |mut mesh| {
            [0, 1].into_iter().for_each(|t| mesh.relabel(t, Label(1)));
            assert!(!flip_surface_edge(&mut mesh, 0, 1, 1.0));
        });
    }
}
