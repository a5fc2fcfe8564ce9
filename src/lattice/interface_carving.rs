//! Surfaces that still pinch are made manifold by giving a neighbourhood of the pinch to one label; walls that the lattice has
//! opened are closed likewise.
//!
//! # Method
//! The pinched vertices span a subcomplex. Every element with some of its vertices pinched is cut between them and the
//! others, at the middles of the edges: the inner parts are a regular neighbourhood of the subcomplex. Each connected part of it takes
//! the label that was chosen for it ([`pinch_fillings`](crate::lattice::pinch_fillings)).
//!
//! ```text
//!        a                      a
//!       / \                    / \          v is pinched: tet (v, a, b, c) becomes the small tet
//!      / l \                  / l \         (v, m_a, m_b, m_c) of the chosen label k and a prism (three tets) that
//!     /     \      =>        m_a-m_b        keeps the label l
//!    v-------b              / k \   \
//!                          v-----m---b
//! ```
//!
//! # Source
//! Our own; regular neighbourhoods are textbook topology ([RourkeSanderson1972] chapter 3). Prisms are split by the
//! smallest vertex of each side [Dompierre1999].
//!
//! # Differences
//! The thesis refines until nothing pinches, and where the lattice is in the way that never ends.
//!
//! # Invariants
//! At a new vertex in the middle of an edge (s, a) one half of the ball is of one label, the other half is the ball of
//! the edge; the edge does not pinch, as a is not pinched. So no surface pinches afterwards where the balls of the pinched
//! vertices are closed.

use crate::context::RunContext;
use crate::error::Result;
use crate::index::Label;
use crate::lattice::pinch_fillings::Fillings;
use crate::lattice::red_green::{Elements, RedGreenLattice};

/// Elements that are cut between two looks at whether the run is cancelled.
const ELEMENTS_PER_CHECK: usize = 1 << 16;

/// Cuts the elements around the vertices that are filled (`around`, increasing) and labels the inner parts. Returns the elements that
/// changed, increasing: the first part of each element takes its place, the others come at the end.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`]; some elements are cut then, others beside them not.
pub fn carve(
    lattice: &mut RedGreenLattice,
    elements: &mut Elements,
    fillings: &Fillings,
    around: Vec<u32>,
    context: &RunContext,
) -> Result<Vec<u32>> {
    let first_new = elements.tets.len() as u32;
    let mut parts: Vec<([u32; 4], Label)> = Vec::new();
    for (at, e) in around.iter().map(|e| *e as usize).enumerate() {
        context.check_every(ELEMENTS_PER_CHECK, at)?;
        parts.clear();
        append_parts(lattice, elements.tets[e], elements.labels[e], fillings, &mut parts);
        let mut parts = parts.iter().map(|(tet, label)| (oriented(lattice, *tet), *label));
        if let Some(part) = parts.next() {
            (elements.tets[e], elements.labels[e]) = part;
        }
        for (tet, label) in parts {
            elements.tets.push(tet);
            elements.labels.push(label);
            elements.leaves.push(elements.leaves[e]);
        }
    }
    let mut changed = around;
    changed.extend(first_new..elements.tets.len() as u32);
    Ok(changed)
}

/// What an element with vertices that are filled becomes.
fn append_parts(
    lattice: &mut RedGreenLattice,
    tet: [u32; 4],
    own: Label,
    fillings: &Fillings,
    parts: &mut Vec<([u32; 4], Label)>,
) {
    let Some(filled) = tet.iter().find_map(|v| fillings.label_of[*v as usize]) else {
        parts.push((tet, own));
        return;
    };
    let (inner, outer): (Vec<u32>, Vec<u32>) = tet.iter().partition(|v| fillings.has(**v));
    let mut middle = |i: usize, o: usize| {
        let ends = [inner[i], outer[o]];
        let position = ends.map(|v| lattice.vertices.positions[v as usize]);
        let place = (position[0] + position[1]) / 2;
        lattice.vertices.insert_middle(place, ends, &lattice.frame, &lattice.field)
    };
    match inner.len() {
        1 => {
            let m = [middle(0, 0), middle(0, 1), middle(0, 2)];
            parts.push(([inner[0], m[0], m[1], m[2]], filled));
            let prism = [m[0], m[1], m[2], outer[0], outer[1], outer[2]];
            parts.extend(prism_tets(prism).map(|t| (t, own)));
        }
        2 => {
            let m = [[middle(0, 0), middle(0, 1)], [middle(1, 0), middle(1, 1)]];
            let inside = [inner[0], m[0][0], m[0][1], inner[1], m[1][0], m[1][1]];
            let outside = [outer[0], m[0][0], m[1][0], outer[1], m[0][1], m[1][1]];
            parts.extend(prism_tets(inside).map(|t| (t, filled)));
            parts.extend(prism_tets(outside).map(|t| (t, own)));
        }
        3 => {
            let m = [middle(0, 0), middle(1, 0), middle(2, 0)];
            let prism = [inner[0], inner[1], inner[2], m[0], m[1], m[2]];
            parts.extend(prism_tets(prism).map(|t| (t, filled)));
            parts.push(([m[0], m[1], m[2], outer[0]], own));
        }
        _ => parts.push((tet, filled)),
    }
}

/// Three tets of a prism with triangles (0 1 2) and (3 4 5), 3 across 0: every side is cut at its smallest vertex, so that
/// neighbours agree.
fn prism_tets(mut prism: [u32; 6]) -> [[u32; 4]; 3] {
    let smallest = (0..6).min_by_key(|v| prism[*v]).unwrap_or(0);
    if smallest >= 3 {
        prism = [prism[3], prism[4], prism[5], prism[0], prism[1], prism[2]];
    }
    let turn = smallest % 3;
    let p = |corner: usize| prism[(corner % 3 + turn) % 3 + corner / 3 * 3];
    // Two sides are cut at 0; the third is (1 2 5 4).
    if p(1).min(p(5)) < p(2).min(p(4)) {
        [[p(0), p(1), p(2), p(5)], [p(0), p(1), p(5), p(4)], [p(0), p(4), p(5), p(3)]]
    } else {
        [[p(0), p(1), p(2), p(4)], [p(0), p(4), p(2), p(5)], [p(0), p(4), p(5), p(3)]]
    }
}

fn oriented(lattice: &RedGreenLattice, tet: [u32; 4]) -> [u32; 4] {
    let [a, b, c, d] = tet.map(|v| lattice.vertices.positions[v as usize].as_dvec3());
    // Whole numbers below 2^21: products of three differences of neighbours are exact in doubles.
    if (b - a).cross(c - a).dot(d - a) > 0.0 { tet } else { [tet[0], tet[1], tet[3], tet[2]] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::euler_ranges::changes_by_filling;
    use crate::lattice::face_adjacency::{neighbors_of, rematch};
    use crate::lattice::image_contacts::ImageContacts;
    use crate::lattice::interface_topology::InterfaceTopology;
    use crate::lattice::kept_components::KeptComponents;
    use crate::lattice::pinch_fillings::{Extent, FillingRules, Pinches, Regions, choose_fillings, groups_of};
    use crate::lattice::test_images::{components_of, topology_of, voxel_image, with_lattice};
    use glam::{DVec3, IVec3};

    /// Numbers with no order to be seen, of points.
    fn noise(p: DVec3) -> f64 {
        ((p.x * 12.9898 + p.y * 78.233 + p.z * 37.719).sin() * 43758.5453).rem_euclid(1.0)
    }

    #[test]
    fn a_label_is_not_carried_far_from_itself_while_other_rounds_are_left() {
        // The boundary runs through a vertex: that is beyond it for neither label.
        let image = voxel_image(16, |p| if p.x < 8.0 { 1 } else { 2 });
        let carved = |extent: Extent| {
            with_lattice(&image, 2.0, |mut lattice, context| {
                let mut elements = lattice.elements(context).unwrap();
                let vertices = lattice.vertices.positions.len();
                let neighbors = neighbors_of(&elements.tets, vertices, context).unwrap();
                let topology = topology_of(&lattice, &elements, &neighbors, context);
                // A line of vertices through both labels; nothing pinches there, which carving does not ask for.
                let place = |v: u32| lattice.frame.local(lattice.vertices.positions[v as usize]);
                let inner: Vec<u32> =
                    (0..vertices as u32).filter(|v| (place(*v).x - 8.0).abs() < 6.0 && !topology.is_open(*v)).collect();
                let off_axis = |v: &u32| (place(*v) - 8.0).y.hypot((place(*v) - 8.0).z);
                let axis = inner.iter().copied().min_by(|a, b| off_axis(a).total_cmp(&off_axis(b))).unwrap();
                let is_beside = |v: &&u32| {
                    let [p, q] = [**v, axis].map(|v| lattice.vertices.positions[v as usize]);
                    (p.y, p.z) == (q.y, q.z)
                };
                let line: Vec<u32> = inner.iter().filter(is_beside).copied().collect();
                let regions = Regions {
                    of_element: elements.labels.iter().map(|l| u32::from(l.0)).collect(),
                    surplus: vec![0; 3],
                };
                let has = |label: u16| {
                    line.iter().filter(|v| topology.has_label(**v, Label(label), &elements.labels)).count()
                };
                let near = has(1).max(has(2));
                let pinches = Pinches { vertices: line.clone() };
                let components = components_of(&image, context);
                let kept = KeptComponents::new(&components, &[]);
                let rules = FillingRules { regions: &regions, euler: None, are_checked: false, extent, kept };
                let fillings =
                    choose_fillings(&lattice, &elements.labels, &topology, &pinches, rules, context).unwrap();
                let filled = fillings.vertices();
                let around = topology.elements_around(&filled);
                drop(topology);
                let before = neighbors.len();
                assert!(!around.is_empty() && around.len() < before);
                let changed = carve(&mut lattice, &mut elements, &fillings, around.clone(), context).unwrap();
                let new = before as u32..elements.tets.len() as u32;
                assert!(new.len() > around.len());
                assert_eq!(changed, around.into_iter().chain(new).collect::<Vec<u32>>());
                let mut after = neighbors;
                rematch(&mut after, &elements.tets, &changed, context).unwrap();
                assert_eq!(after, neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap());
                (filled.len(), near, line.len())
            })
        };
        let (treated, near, all) = carved(Extent::NearLabel);
        assert!(near < all && near > 0, "{near} of {all}");
        assert_eq!(treated, near, "the label that is at more of the line fills what it is at");
        assert_eq!(carved(Extent::Whole).0, all);
    }

    #[test]
    fn what_is_to_be_carved_next_is_where_carving_was() {
        // Scattered voxels on one side, an oblique wall of one voxel on the other.
        let across = |p: DVec3| p.dot(DVec3::new(0.8, 0.0, 0.6)) - 12.0;
        let wall = |p: DVec3| if across(p) < 0.0 { 1 } else { 2 * u16::from(across(p) < 1.0) };
        let image = voxel_image(20, |p| if p.y < 10.0 { wall(p) } else { (3.0 * noise(p)) as u16 });
        with_lattice(&image, 2.0, |mut lattice, context| {
            let mut elements = lattice.elements(context).unwrap();
            // A hole in the wall.
            let is_at_hole = |tet: &[u32; 4]| lattice.centroid(tet).distance(DVec3::new(8.6, 5.0, 10.5)) < 1.8;
            let tets = elements.labels.iter_mut().zip(&elements.tets);
            tets.filter(|(label, tet)| label.0 == 2 && is_at_hole(tet)).for_each(|(label, _)| *label = Label(1));
            let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
            let topology = topology_of(&lattice, &elements, &neighbors, context);
            let first = Pinches::among(&lattice, &elements.labels, &topology, [None; 2], context).unwrap();
            let contacts = ImageContacts::new(&lattice, &elements.tets, &neighbors);
            let breached = contacts.breached(&elements.labels, &topology, |_| true, context).unwrap();
            let counts = [breached.len(), first.vertices.len(), lattice.vertices.positions.len()];
            assert!(counts[0] > 0 && counts[1] > counts[0] && counts[2] > counts[1], "{counts:?}");
            let regions = Regions { of_element: vec![0; elements.tets.len()], surplus: vec![9; 3] };
            let components = components_of(&image, context);
            let rules = || FillingRules {
                regions: &regions,
                euler: None,
                are_checked: false,
                extent: Extent::NearLabel,
                kept: KeptComponents::new(&components, &[]),
            };
            let fillings = choose_fillings(&lattice, &elements.labels, &topology, &first, rules(), context).unwrap();
            let around = topology.elements_around(&fillings.vertices());
            drop(topology);
            let changed = carve(&mut lattice, &mut elements, &fillings, around, context).unwrap();
            let to_see = first.to_see_after(&lattice, &elements, &changed);
            let mut neighbors = neighbors;
            rematch(&mut neighbors, &elements.tets, &changed, context).unwrap();
            let topology = topology_of(&lattice, &elements, &neighbors, context);
            let among = |candidates: [Option<&[bool]>; 2]| {
                Pinches::among(&lattice, &elements.labels, &topology, candidates, context)
            };
            let all = among([None; 2]).unwrap();
            let near = among([Some(&to_see); 2]).unwrap();
            assert!(!changed.is_empty() && to_see.contains(&false) && !all.vertices.is_empty());
            assert_eq!(near.vertices, all.vertices);
            context.cancel_token().cancel();
            assert!(matches!(among([None; 2]), Err(crate::Error::Cancelled)));
            let chosen = choose_fillings(&lattice, &elements.labels, &topology, &first, rules(), context);
            assert!(matches!(chosen, Err(crate::Error::Cancelled)));
            drop(topology);
            let all = Fillings { label_of: vec![Some(Label(1)); lattice.vertices.positions.len()] };
            let carved = carve(&mut lattice, &mut elements, &all, changed, context);
            assert!(matches!(carved, Err(crate::Error::Cancelled)));
        });
    }

    #[test]
    fn euler_numbers_change_by_fillings_as_they_say() {
        let image = voxel_image(26, |p| u16::from(noise(p) > 0.5));
        with_lattice(&image, 2.0, |mut lattice, context| {
            let mut elements = lattice.elements(context).unwrap();
            // Labels up to the outside of the lattice, some of single elements.
            let label_at = |tet: &[u32; 4]| Label((3.0 * noise((lattice.centroid(tet) / 1.5).floor())) as u16);
            elements.labels = elements.tets.iter().map(label_at).collect();
            let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
            let wanted = [[0; 2]; 3];
            let vertices = lattice.vertices.positions.len();
            let topology = topology_of(&lattice, &elements, &neighbors, context);
            let mut expected = topology.euler_ranges(&elements.labels, &wanted, context).unwrap();
            // Groups of one to some twenty vertices, pinched or not, inside and at the outside of the lattice.
            let is_chosen = |v: &u32| noise(lattice.frame.local(lattice.vertices.positions[*v as usize])) > 0.8;
            let chosen = (0..vertices as u32).filter(is_chosen).collect::<Vec<_>>();
            let mut fillings = Fillings { label_of: vec![None; vertices] };
            let groups = groups_of(&topology, &chosen);
            let are_open = |group: &Vec<u32>| group.iter().filter(|v| topology.is_open(**v)).count();
            let open: Vec<usize> = groups.iter().map(are_open).collect();
            let count =
                |passes: &dyn Fn((&Vec<u32>, &usize)) -> bool| groups.iter().zip(&open).filter(|g| passes(*g)).count();
            let counts = [count(&|(g, o)| g.len() > 5 && *o == 0), count(&|(g, o)| *o > 1 && *o < g.len())];
            assert!(counts.iter().all(|c| *c > 3), "{counts:?} of {}", groups.len());
            let mut filled_open = [0; 3];
            for (at, (group, open)) in groups.iter().zip(&open).enumerate() {
                let around = topology.labels_around(group[0], &elements.labels);
                let label = around[at % around.len()];
                filled_open[label.index()] += open;
                expected.add(&changes_by_filling(&topology.fillings_of(group, &elements.labels), label));
                group.iter().for_each(|v| fillings.label_of[*v as usize] = Some(label));
            }
            assert!(filled_open.iter().all(|open| *open > 3), "{filled_open:?}");
            let around = topology.elements_around(&fillings.vertices());
            drop(topology);
            carve(&mut lattice, &mut elements, &fillings, around, context).unwrap();
            let vertices = lattice.vertices.positions.len();
            let neighbors = neighbors_of(&elements.tets, vertices, context).unwrap();
            let topology = topology_of(&lattice, &elements, &neighbors, context);
            let found = topology.euler_ranges(&elements.labels, &wanted, context).unwrap();
            assert_eq!(expected, found);
        });
    }

    #[test]
    fn fillings_keep_euler_numbers_within_reach_also_where_a_whole_chain_would_not() {
        let image = voxel_image(20, |p| u16::from(noise((p / 2.0).floor()) > 0.6));
        // The labels whose Euler numbers are out of reach afterwards, and how many groups are filled in part.
        let carved = |keeps: bool| {
            with_lattice(&image, 2.0, |mut lattice, context| {
                let mut elements = lattice.elements(context).unwrap();
                let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
                let topology = topology_of(&lattice, &elements, &neighbors, context);
                let ranges = |topology: &InterfaceTopology, labels: &[Label], wanted: [[i64; 2]; 2]| {
                    topology.euler_ranges(labels, &wanted, context).unwrap()
                };
                // That of a closed body is within reach as long as nothing is filled.
                let none = ranges(&topology, &elements.labels, [[i64::MAX >> 8; 2]; 2]);
                let wanted = [0, 1].map(|label| [none.out_of_reach(Label(label)).unwrap()[0]; 2]);
                let mut kept = ranges(&topology, &elements.labels, wanted);
                assert!([0, 1].iter().all(|label| kept.out_of_reach(Label(*label)).is_none()));
                let pinches = Pinches::among(&lattice, &elements.labels, &topology, [None; 2], context).unwrap();
                let regions = Regions { of_element: vec![0; elements.tets.len()], surplus: vec![0; 2] };
                let euler = keeps.then_some(&mut kept);
                let components = components_of(&image, context);
                let (kept, extent) = (KeptComponents::new(&components, &[]), Extent::NearLabel);
                let rules = FillingRules { regions: &regions, euler, are_checked: false, extent, kept };
                let fillings =
                    choose_fillings(&lattice, &elements.labels, &topology, &pinches, rules, context).unwrap();
                let filled = |group: &Vec<u32>| group.iter().filter(|v| fillings.has(**v)).count();
                let groups = groups_of(&topology, &pinches.vertices);
                let in_part = groups.iter().filter(|group| (1..group.len()).contains(&filled(group))).count();
                let around = topology.elements_around(&fillings.vertices());
                drop(topology);
                carve(&mut lattice, &mut elements, &fillings, around, context).unwrap();
                let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), context).unwrap();
                let topology = topology_of(&lattice, &elements, &neighbors, context);
                let after = ranges(&topology, &elements.labels, wanted);
                let out = [0, 1].into_iter().filter(|label| after.out_of_reach(Label(*label)).is_some()).count();
                (out, in_part)
            })
        };
        let (with, without) = (carved(true), carved(false));
        assert_eq!(with.0, 0);
        assert!(with.1 > 0 && without.0 > 0, "{with:?} {without:?}");
    }

    #[test]
    fn prisms_of_any_numbering_have_cuts_at_smallest_vertices() {
        // Volume of the unit prism is covered, and each side's diagonal starts at the side's smallest vertex.
        let corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]].map(IVec3::from_array);
        let sides = [[0, 1, 4, 3], [1, 2, 5, 4], [0, 2, 5, 3]];
        let mut numbers = [0u32, 1, 2, 3, 4, 5];
        for step in 0..720usize {
            let tets = prism_tets(numbers);
            let at = |v: u32| numbers.iter().position(|n| *n == v).unwrap();
            let volume6 = |t: &[u32; 4]| {
                let [a, b, c, d] = t.map(|v| corners[at(v)].as_dvec3());
                (b - a).cross(c - a).dot(d - a).abs()
            };
            assert_eq!(tets.iter().map(volume6).sum::<f64>(), 3.0);
            for side in sides {
                let smallest = side.into_iter().min_by_key(|c| numbers[*c]).unwrap();
                let place = side.iter().position(|c| *c == smallest).unwrap();
                let (from, to) = (numbers[smallest], numbers[side[(place + 2) % 4]]);
                assert!(tets.iter().any(|t| t.contains(&from) && t.contains(&to)), "{numbers:?} {side:?}");
            }
            // The next permutation by Heap's transpositions in factorial base.
            let i = 1 + step % 5;
            numbers.swap(i, (step / 5) % i.max(1));
        }
    }
}
