//! Tets between vertices of a surface that lie on its other side take the label of that side.
//!
//! # Method
//! 1. A tet whose four vertices all lie on the surface between two labels is on neither side by its vertices. The lattice gave
//!    it the label of its middle, which has moved since. It is listed where its middle lies beyond the surface by more than a
//!    tolerance, the farthest first.
//! 2. It takes the other label where it touches that label in two or three of its faces and nothing else, and its own in the
//!    rest of its faces and nothing else: the surface goes over the tet from one side to the other and stays of one piece,
//!    without holes, and no edge or vertex is pinched.
//! 3. What this uncovers is looked at again, until nothing is beyond.
//! ```text
//!     a tet of the wall across a thin vessel            the vessel is open
//!       a   ____                                        ____
//!     _____/   /\_____                           ______/    \_____
//!     b     \ /a \    b         ->               b   b        b    b
//!     _______/____\___                           __________________
//! ```
//!
//! # Source
//! [BertrandMalandain1994] for what keeps the topology: both what is beside and what is left form one disc.
//!
//! # Invariants
//! No two labels touch that did not. Points and tets stay as they are.
//!
//! # Cost
//! One distance per tet whose vertices all lie on one surface, in parallel; the changes are few.

use glam::DVec3;
use rayon::prelude::*;

use crate::index::Label;
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::lattice::subvoxel_surface::Side;

/// Times that the neighbours of what changed are looked at: tets of a wall lie a few deep.
const PASSES: usize = 4;

/// Tets per parallel work item.
const CHUNK: usize = 4096;

/// Gives the other label to tets that lie beyond their surface by more than `tolerance`, mm. Returns how many.
pub fn relabel_beyond_surface(mesh: &mut ImprovementMesh, tolerance: f64) -> usize {
    let mut changed = 0;
    let all = (0..mesh.tets.len() as u32).into_par_iter().with_min_len(CHUNK);
    let mut beyond: Vec<(f64, u32)> = all.filter_map(|t| Some((depth_beyond(mesh, t, tolerance)?, t))).collect();
    for _ in 0..PASSES {
        beyond.sort_unstable_by(|l, r| r.0.total_cmp(&l.0).then(l.1.cmp(&r.1)));
        let mut around = Vec::new();
        for (_, t) in beyond {
            if let Some(label) = label_beyond(mesh, t) {
                mesh.relabel(t, label);
                changed += 1;
                around.extend(mesh.tets[t as usize]);
            }
        }
        beyond = mesh.tets_of(around).into_iter().filter_map(|t| Some((depth_beyond(mesh, t, tolerance)?, t))).collect();
        if beyond.is_empty() {
            break;
        }
    }
    changed
}

/// The labels that meet at all vertices of a tet whose vertices lie on the surface between two labels: its own, the other.
fn labels_of(mesh: &ImprovementMesh, t: u32) -> Option<[Label; 2]> {
    if !mesh.is_live(t) {
        return None;
    }
    let [first, rest @ ..] = mesh.tets[t as usize];
    let [Side::Label(a), Side::Label(b)] = *mesh.sides(first) else { return None };
    if !rest.iter().all(|v| mesh.sides(*v) == mesh.sides(first)) {
        return None;
    }
    let own = mesh.labels[t as usize];
    let other = if own == a { b } else { a };
    (own == a || own == b).then_some([own, other]).filter(|labels| labels.iter().all(|l| !l.is_background()))
}

/// How far the middle of a tet lies beyond its surface, mm, where that is more than `tolerance`.
fn depth_beyond(mesh: &ImprovementMesh, t: u32, tolerance: f64) -> Option<f64> {
    let [own, other] = labels_of(mesh, t)?;
    let middle = mesh.corners(t).into_iter().sum::<DVec3>() / 4.0;
    mesh.surface.depth(middle, other, own).filter(|depth| *depth > tolerance)
}

/// The label that a tet may take without a change of topology.
fn label_beyond(mesh: &ImprovementMesh, t: u32) -> Option<Label> {
    let [own, other] = labels_of(mesh, t)?;
    let tet = mesh.tets[t as usize];
    // Whether another tet of a label has all of some vertices.
    let touches = |vertices: &[u32], label: Label| {
        let has_all = |n: &u32| vertices[1..].iter().all(|v| mesh.tets[*n as usize].contains(v));
        mesh.ball(vertices[0]).iter().any(|n| *n != t && mesh.labels[*n as usize] == label && has_all(n))
    };
    let mut towards = Vec::new();
    for face in 0..4 {
        let label = mesh.labels[mesh.neighbor(t, face)? as usize];
        if label == other {
            towards.push(face);
        } else if label != own {
            return None;
        }
    }
    let [a, b, c, d] = tet;
    let keeps = match *towards {
        // The other faces share the edge between the corners opposite to these, these the edge between the other two.
        [one, two] => {
            let ends = [tet[one], tet[two]];
            let rest: Vec<u32> = [a, b, c, d].into_iter().filter(|v| !ends.contains(v)).collect();
            !touches(&ends, other) && !touches(&rest, own)
        }
        // The vertex of all three faces becomes one inside.
        [_, _, _] => {
            let apex = (0..4).find(|face| !towards.contains(face)).map(|face| tet[face])?;
            !mesh.fixed[apex as usize] && !touches(&[apex], own)
        }
        _ => false,
    };
    keeps.then_some(other)
}
