//! Step 4: which regions are meshed, and their labels.
//!
//! # Method
//! 1. Tets are joined across faces that are no subfaces: each set is a component of space; the one at the hull is the
//!    outside.
//! 2. Components with a hole point stay empty. With `domain = nesting` so do those an even number of surfaces deep. Where
//!    a patch is a far field, symmetry plane, inlet or outlet, only components that such a patch bounds are meshed, and
//!    those joined to them through internal or embedded patches: the inside of the walls stays empty.
//! 3. A region seed gives its component the label and size. Other components are numbered from 1, leaving out labels
//!    of seeds, in the order of their first facet.
//!
//! # Source
//! [Drakopoulos2017] 4.6.1 discards the outside; regions and rules are ours.
//!
//! # Cost
//! Linear; one thread; deterministic.

use glam::DVec3;
use rustc_hash::{FxHashMap, FxHashSet};

use crate::conforming::boundary_recovery::constrained_mesh::{ConstrainedMesh, face_key};
use crate::conforming::boundary_recovery::steiner_points::locate;
use crate::conforming::options::DomainRule;
use crate::context::RunContext;
use crate::error::{Error, Finding, FindingCode, Result, Severity};
use crate::geometry::predicates::orient3d;
use crate::index::{Label, TetFace, TetId};
use crate::mesh::surface_mesh::{PatchRole, SurfaceMesh};
use crate::mesh::tet_store::TetStore;

/// A region that is meshed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// Label of its elements.
    pub label: i32,
    /// Largest edge length wanted in it.
    pub size: Option<f64>,
    /// Tets of the recovered mesh.
    pub tets: usize,
    /// Volume, mm^3.
    pub volume: f64,
}

/// The regions of a recovered mesh.
#[derive(Debug, Clone, Default)]
pub struct Domain {
    /// Per tet slot the region: 0 for what stays empty, else its position in `regions` plus 1.
    pub region_of: Vec<Label>,
    /// The regions.
    pub regions: Vec<Region>,
}

/// A component of space.
#[derive(Debug, Clone, Default)]
struct Component {
    tets: usize,
    volume: f64,
    first_facet: u32,
    inside_point: Option<DVec3>,
    /// Neighbours across subfaces, with the role of the patch.
    neighbors: Vec<(usize, PatchRole)>,
}

/// Finds the regions of the surface, whose facets the mesh contains.
///
/// # Errors
/// [`Error::InvalidInput`] where a facet lies outside of every region, or nothing is left to mesh.
pub fn label_domain(
    mesh: &ConstrainedMesh,
    surface: &SurfaceMesh,
    patches: &[i32],
    rule: DomainRule,
    context: &RunContext,
) -> Result<Domain> {
    let (component_of, count) = flood(mesh);
    let components = describe(mesh, surface, patches, &component_of, count)?;
    let mut kept = vec![true; count];
    kept[0] = false;
    if rule == DomainRule::Nesting {
        keep_odd_levels(&components, &mut kept);
    }
    keep_flow_regions(&components, &mut kept);
    let hint = mesh.complex.live_tets().next().unwrap_or(TetId::NONE);
    let component_at = |point: DVec3| {
        let tet = locate(mesh, point, hint)?;
        let component = component_of[tet.index()] as usize;
        (component != 0).then_some(component)
    };
    for (number, &point) in surface.holes.iter().enumerate() {
        match component_at(point) {
            Some(component) => kept[component] = false,
            None => context.report(seed_outside("hole", number, point)),
        }
    }
    let mut given: FxHashMap<usize, (i32, Option<f64>)> = FxHashMap::default();
    for (number, seed) in surface.regions.iter().enumerate() {
        match component_at(seed.point) {
            Some(component) => drop(given.insert(component, (seed.label, seed.size))),
            None => context.report(seed_outside("region", number, seed.point)),
        }
    }
    number_regions(&components, &kept, &given, &component_of, context)
}

fn seed_outside(kind: &str, number: usize, point: DVec3) -> Finding {
    let text = format!("{kind} point {number} at {point} lies in no bounded region");
    Finding::new(FindingCode::SeedOutside, Severity::Warning, text).with_ids(number as i64, -1).at(point.to_array())
}

/// Number of the component of every tet slot, and how many there are; 0 is the outside.
fn flood(mesh: &ConstrainedMesh) -> (Vec<u32>, usize) {
    let complex = &mesh.complex;
    let mut component_of = vec![u32::MAX; complex.slot_count()];
    let is_outer = |tet: TetId| complex.is_ghost_tet(tet) || complex.neighbors(tet).contains(&TetFace::NONE);
    let mut count = 0_u32;
    let mut stack: Vec<TetId> = complex.live_tets().filter(|&t| is_outer(t)).collect();
    stack.iter().for_each(|t| component_of[t.index()] = 0);
    let live: Vec<TetId> = complex.live_tets().collect();
    let mut seeds = live.iter();
    loop {
        while let Some(tet) = stack.pop() {
            for face in 0..4 {
                let side = TetFace::new(tet, face);
                let other = complex.neighbor(side);
                if other == TetFace::NONE || component_of[other.tet().index()] != u32::MAX || mesh.is_subface(side) {
                    continue;
                }
                component_of[other.tet().index()] = count;
                stack.push(other.tet());
            }
        }
        count += 1;
        let Some(&seed) = seeds.find(|t| component_of[t.index()] == u32::MAX) else { break };
        component_of[seed.index()] = count;
        stack.push(seed);
    }
    (component_of, count as usize)
}

fn describe(
    mesh: &ConstrainedMesh,
    surface: &SurfaceMesh,
    patches: &[i32],
    component_of: &[u32],
    count: usize,
) -> Result<Vec<Component>> {
    let mut components = vec![Component { first_facet: u32::MAX, ..Component::default() }; count];
    let mut links: FxHashSet<(usize, usize, i32)> = FxHashSet::default();
    let mut outside_facets: Vec<u32> = Vec::new();
    for tet in mesh.complex.finite_tets() {
        let own = component_of[tet.index()] as usize;
        let [a, b, c, d] = mesh.complex.points_of(tet);
        let component = &mut components[own];
        component.tets += 1;
        component.volume += orient3d(a, b, c, d) / 6.0;
        component.inside_point.get_or_insert((a + b + c + d) / 4.0);
        for face in 0..4 {
            let side = TetFace::new(tet, face);
            let Some(&facet) = mesh.subfaces.get(&face_key(mesh.complex.face_vertices(side))) else { continue };
            let other = mesh.complex.neighbor(side);
            let beyond = if other == TetFace::NONE { 0 } else { component_of[other.tet().index()] as usize };
            component.first_facet = component.first_facet.min(facet);
            if own == 0 && beyond == 0 {
                outside_facets.push(facet);
            } else if own != beyond {
                links.insert((own, beyond, patches[facet as usize]));
            }
        }
    }
    if !outside_facets.is_empty() {
        outside_facets.sort_unstable();
        outside_facets.dedup();
        let finding = |f: &u32| {
            let text = format!("triangle {f} bounds no region: the surface around it is open");
            Finding::new(FindingCode::OpenEdge, Severity::Error, text).with_ids(i64::from(*f), -1)
        };
        let findings: Vec<Finding> = outside_facets.iter().map(finding).collect();
        let message = format!("{} triangles of the surface bound no region", findings.len());
        return Err(Error::InvalidInput { message, findings });
    }
    let mut links: Vec<_> = links.into_iter().collect();
    links.sort_unstable();
    for (own, beyond, patch) in links {
        components[own].neighbors.push((beyond, surface.role_of(patch)));
    }
    Ok(components)
}

/// Keeps components an odd number of surfaces away from the outside.
fn keep_odd_levels(components: &[Component], kept: &mut [bool]) {
    let mut level = vec![usize::MAX; components.len()];
    level[0] = 0;
    let mut queue = std::collections::VecDeque::from([0]);
    while let Some(own) = queue.pop_front() {
        for &(beyond, _) in &components[own].neighbors {
            if level[beyond] == usize::MAX {
                level[beyond] = level[own] + 1;
                queue.push_back(beyond);
            }
        }
    }
    for (keep, level) in kept.iter_mut().zip(level) {
        *keep &= level != usize::MAX && level % 2 == 1;
    }
}

/// Where patches say where a flow is, the rest stays empty.
fn keep_flow_regions(components: &[Component], kept: &mut [bool]) {
    use PatchRole::{Embedded, Farfield, Inlet, Internal, Outlet, Symmetry};
    let touches = |c: &Component| c.neighbors.iter().any(|(_, r)| matches!(r, Farfield | Inlet | Outlet | Symmetry));
    let mut stack: Vec<usize> = (1..components.len()).filter(|&c| touches(&components[c])).collect();
    if stack.is_empty() {
        return;
    }
    let mut flow = vec![false; components.len()];
    stack.iter().for_each(|&c| flow[c] = true);
    while let Some(own) = stack.pop() {
        for &(beyond, role) in &components[own].neighbors {
            if beyond != 0 && matches!(role, Internal | Embedded) && !std::mem::replace(&mut flow[beyond], true) {
                stack.push(beyond);
            }
        }
    }
    kept.iter_mut().zip(flow).for_each(|(keep, flow)| *keep &= flow);
}

fn number_regions(
    components: &[Component],
    kept: &[bool],
    given: &FxHashMap<usize, (i32, Option<f64>)>,
    component_of: &[u32],
    context: &RunContext,
) -> Result<Domain> {
    let mut order: Vec<usize> = (1..components.len()).filter(|&c| kept[c]).collect();
    order.sort_by_key(|&c| (components[c].first_facet, c));
    if order.is_empty() {
        return Err(Error::input("the surface bounds no region that is to be meshed"));
    }
    if order.len() >= usize::from(u16::MAX) {
        let needed = order.len() as u64;
        return Err(Error::CapacityExceeded { what: "regions", needed, limit: u64::from(u16::MAX) - 1 });
    }
    let taken: FxHashSet<i32> = given.values().map(|(label, _)| *label).collect();
    let mut next = 1;
    let mut number = vec![Label::BACKGROUND; components.len()];
    let mut regions: Vec<Region> = Vec::new();
    for &c in &order {
        let (label, size) = given.get(&c).copied().unwrap_or_else(|| {
            while taken.contains(&next) {
                next += 1;
            }
            next += 1;
            (next - 1, None)
        });
        let component = &components[c];
        regions.push(Region { label, size, tets: component.tets, volume: component.volume });
        number[c] = Label(regions.len() as u16);
        let text = format!("region {label}: volume {:e}, from triangle {}", component.volume, component.first_facet);
        let mut finding = Finding::new(FindingCode::Region, Severity::Note, text);
        finding = finding.with_ids(i64::from(label), component.tets as i64);
        if let Some(point) = component.inside_point {
            finding = finding.at(point.to_array());
        }
        context.report(finding);
    }
    let region_of = component_of.iter().map(|&c| number.get(c as usize).copied().unwrap_or_default()).collect();
    Ok(Domain { region_of, regions })
}
