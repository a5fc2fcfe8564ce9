//! Step 1: everything that is wrong with a surface, with ids and places; what can be repaired is.
//!
//! # Method
//! 1. Coordinates and indices; equal points are merged (exactly equal, -0 and 0 alike).
//! 2. Facets: repeated vertices, no area (exact), duplicates.
//! 3. Edges: facets are counted per edge. Sheets are peeled off: while an edge has one facet left, the facet goes. What
//!    remains is closed; peeled sheets are allowed inside it, and where nothing remains the surface is open.
//! 4. Orientation: propagated over edges of two facets; the smaller part of a component is turned over.
//! 5. Pairs: facets whose boxes overlap are tested with exact predicates, in parallel, in a fixed order.
//! 6. Points that almost touch, points without a facet.
//!
//! # Source
//! [Shewchuk1997] for the predicates; the rest is ours.
//!
//! # Invariants
//! [`CheckedSurface::points`] are the used points in their order with their bits; findings carry the ids of the input.
//!
//! # Cost
//! O(n log n) for surfaces whose facets overlap few boxes; step 5 is parallel; the findings do not depend on threads.

use std::time::Instant;

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use crate::conforming::delaunay_kernel::LARGEST_COORDINATE;
use crate::conforming::options::{DomainRule, Options};
use crate::conforming::report::CheckReport;
use crate::context::RunContext;
use crate::error::{Error, Finding, FindingCode, Result, Severity};
use crate::geometry::aabb_tree::AabbTree;
use crate::geometry::bounding_box::BoundingBox;
use crate::geometry::intersection::{Meeting, is_collinear, segment_meets_triangle, triangle_pair};
use crate::geometry::point_grid::close_pairs;
use crate::geometry::predicates::orient3d;
use crate::index::VertexId;
use crate::mesh::numbering::sorted_edge;
use crate::mesh::surface_mesh::{PatchRole, SurfaceMesh};

/// Facets tested between two looks at the cancellation flag.
const CHUNK: usize = 1024;

/// Rays cast from a sheet to see whether it lies inside; any ray that meets nothing proves that it does not.
const RAYS: [DVec3; 7] = [
    DVec3::new(1.0, 0.013, 0.027),
    DVec3::new(-1.0, 0.017, -0.011),
    DVec3::new(0.019, 1.0, 0.023),
    DVec3::new(0.029, -1.0, 0.031),
    DVec3::new(-0.037, 0.041, 1.0),
    DVec3::new(0.043, 0.047, -1.0),
    DVec3::new(0.577, 0.591, 0.563),
];

/// What the check found, and the surface in the form the engine meshes.
#[derive(Debug, Clone, Default)]
pub struct CheckedSurface {
    /// Used points, equal ones merged, in the order of the input.
    pub points: Vec<DVec3>,
    /// Facets over `points`; sources of sizes are left out.
    pub facets: Vec<[VertexId; 3]>,
    /// For each facet its number in the input.
    pub facet_ids: Vec<u32>,
    /// For each facet its patch.
    pub facet_patches: Vec<i32>,
    /// Every finding, errors first, then in the order of the steps.
    pub findings: Vec<Finding>,
    /// Figures.
    pub report: CheckReport,
}

impl CheckedSurface {
    /// Whether a finding forbids meshing.
    pub fn has_errors(&self) -> bool {
        self.findings.iter().any(|finding| finding.severity == Severity::Error)
    }

    /// The surface, or the error that lists every finding.
    ///
    /// # Errors
    /// [`Error::InvalidInput`].
    pub fn into_valid(self) -> Result<Self> {
        if !self.has_errors() {
            return Ok(self);
        }
        let errors: Vec<&Finding> = self.findings.iter().filter(|f| f.severity == Severity::Error).collect();
        let more = if errors.len() > 1 { format!(" (and {} more errors)", errors.len() - 1) } else { String::new() };
        let message = format!("the surface cannot be meshed: {}{more}", errors[0].text);
        Err(Error::InvalidInput { message, findings: self.findings })
    }
}

/// Working state of the check: input, merged ids, findings.
struct Check<'a> {
    surface: &'a SurfaceMesh,
    /// Representative of each point.
    merged: Vec<u32>,
    /// Facets that are usable so far: number in the input and representatives.
    facets: Vec<(u32, [u32; 3])>,
    left_out: LeftOut,
    findings: Vec<Finding>,
    report: CheckReport,
}

/// The edges of facets that are not usable: that they are open is no fault of its own.
#[derive(Default)]
struct LeftOut {
    edges: FxHashSet<[u32; 2]>,
    /// Corners of facets that name a point that does not exist: which edges they were to have is not known.
    corners: FxHashSet<u32>,
}

impl LeftOut {
    fn add(&mut self, facet: [u32; 3]) {
        self.edges.extend(edges_of(facet).map(|[a, b]| sorted_edge(a, b)));
    }

    fn explains(&self, edge: [u32; 2]) -> bool {
        self.edges.contains(&edge) || edge.iter().any(|v| self.corners.contains(v))
    }
}

/// Checks a surface; an invalid one is a result here, not an error.
///
/// # Errors
/// [`Error::Cancelled`], [`Error::LimitReached`].
pub fn check(surface: &SurfaceMesh, options: &Options, context: &RunContext) -> Result<CheckedSurface> {
    let start = Instant::now();
    let merged = Vec::new();
    let mut check = Check {
        surface,
        merged,
        facets: Vec::new(),
        left_out: LeftOut::default(),
        findings: Vec::new(),
        report: CheckReport::default(),
    };
    check.merge_points();
    check.check_distinct_points();
    check.collect_facets();
    context.check()?;
    if check.findings.iter().all(|f| f.severity != Severity::Error) && check.facets.is_empty() {
        check.error(FindingCode::DegeneratePointSet, [-1, -1], None, "the surface has no triangles".into());
    }
    check.check_dimension();
    check.check_edges(options, context)?;
    context.check()?;
    check.check_pairs(context)?;
    check.check_near_points(options);
    check.report.seconds = start.elapsed().as_secs_f64();
    Ok(check.finish())
}

impl Check<'_> {
    fn push(&mut self, code: FindingCode, severity: Severity, ids: [i64; 2], at: Option<DVec3>, text: String) {
        let mut finding = Finding::new(code, severity, text).with_ids(ids[0], ids[1]);
        if let Some(point) = at {
            finding = finding.at(point.to_array());
        }
        self.findings.push(finding);
    }

    fn error(&mut self, code: FindingCode, ids: [i64; 2], at: Option<DVec3>, text: String) {
        self.push(code, Severity::Error, ids, at, text);
    }

    fn at(&self, vertex: u32) -> DVec3 {
        self.surface.points[vertex as usize]
    }

    fn merge_points(&mut self) {
        let mut known: FxHashMap<[u64; 3], u32> = FxHashMap::default();
        let mut merged = Vec::with_capacity(self.surface.points.len());
        for (i, &point) in self.surface.points.iter().enumerate() {
            let id = i as u32;
            if !is_usable(point) {
                let what = if point.is_finite() { "too large" } else { "not finite" };
                let text = format!("point {i} has a coordinate that is {what}: {point}");
                self.error(FindingCode::NonFiniteCoordinate, [i as i64, -1], None, text);
                merged.push(id);
                continue;
            }
            // Adding zero turns -0 into 0: the two are one place.
            let first = *known.entry((point + DVec3::ZERO).to_array().map(f64::to_bits)).or_insert(id);
            if first != id {
                self.report.merged_points += 1;
                let text = format!("points {first} and {i} are equal and were merged");
                let ids = [i64::from(first), i as i64];
                self.push(FindingCode::MergedPoints, Severity::Note, ids, Some(point), text);
            }
            merged.push(first);
        }
        self.merged = merged;
        self.report.points = self.surface.points.len() - self.report.merged_points;
        self.report.facets = self.surface.facets.len();
    }

    /// Where all points are one, that is the fault, and not each triangle.
    fn check_distinct_points(&mut self) {
        let Some(&first) = self.surface.points.first() else { return };
        if is_usable(first) && self.merged.iter().all(|&id| id == 0) && !self.surface.facets.is_empty() {
            let text = format!("all points of the surface are equal: {first}");
            self.error(FindingCode::DegeneratePointSet, [0, -1], Some(first), text);
        }
    }

    fn collect_facets(&mut self) {
        let mut known: FxHashMap<[u32; 3], u32> = FxHashMap::default();
        for (i, facet) in self.surface.facets.iter().enumerate() {
            let patch = self.surface.facet_patches.get(i).copied().unwrap_or(0);
            let id = i as i64;
            if let Some(bad) = facet.iter().find(|v| v.index() >= self.surface.points.len()) {
                let text = format!("triangle {i} uses point {} of {}", i64::from(bad.0), self.surface.points.len());
                self.error(FindingCode::IndexOutOfRange, [id, i64::from(bad.0)], None, text);
                let known = facet.iter().filter_map(|v| self.merged.get(v.index()));
                self.left_out.corners.extend(known);
                continue;
            }
            if self.surface.role_of(patch) == PatchRole::Source {
                continue;
            }
            let corners = facet.map(|v| self.merged[v.index()]);
            let [a, b, c] = corners.map(|v| self.at(v));
            if ![a, b, c].into_iter().all(is_usable) {
                self.left_out.add(corners);
                continue;
            }
            let center = (a + b + c) / 3.0;
            if corners[0] == corners[1] || corners[1] == corners[2] || corners[2] == corners[0] {
                let text = format!("triangle {i} has the vertices {} {} {}", corners[0], corners[1], corners[2]);
                self.error(FindingCode::DegenerateTriangle, [id, -1], Some(center), text);
                continue;
            }
            if is_collinear(a, b, c) {
                let text = format!("triangle {i} has no area: its vertices lie on one line");
                self.error(FindingCode::DegenerateTriangle, [id, -1], Some(center), text);
                self.left_out.add(corners);
                continue;
            }
            let mut key = corners;
            key.sort_unstable();
            let first = *known.entry(key).or_insert(i as u32);
            if first != i as u32 {
                let text = format!("triangles {first} and {i} have the same vertices");
                self.error(FindingCode::DuplicateTriangle, [i64::from(first), id], Some(center), text);
                continue;
            }
            self.facets.push((i as u32, corners));
        }
    }

    /// All points on a point, a line or a plane bound no volume.
    fn check_dimension(&mut self) {
        let Some(&(_, [a, b, c])) = self.facets.first() else { return };
        let [a, b, c] = [a, b, c].map(|v| self.at(v));
        let flat = self.facets.iter().flat_map(|(_, f)| f).all(|&v| orient3d(a, b, c, self.at(v)) == 0.0);
        if flat {
            let text = "all points of the surface lie in one plane".into();
            self.error(FindingCode::DegeneratePointSet, [-1, -1], Some(a), text);
        }
    }

    fn check_edges(&mut self, options: &Options, context: &RunContext) -> Result<()> {
        let edges = context.install(|| EdgeTable::new(&self.facets));
        let sheets = self.find_sheets(&edges);
        self.report_open_edges(&edges, &sheets, context)?;
        for edge in (0..edges.ends.len()).filter(|&edge| edges.facets(edge).len() > 2) {
            let (key, count) = (edges.ends[edge], edges.facets(edge).len());
            let forbidden = options.domain == DomainRule::Nesting && count % 2 == 1;
            let severity = if forbidden { Severity::Error } else { Severity::Note };
            let why = if forbidden { ": nesting levels need an even number" } else { "" };
            let text = format!("edge {} {} has {count} triangles{why}", key[0], key[1]);
            let ids = key.map(i64::from);
            self.push(FindingCode::NonManifoldEdge, severity, ids, Some(self.middle(key)), text);
        }
        self.check_orientation(&edges);
        Ok(())
    }

    fn middle(&self, edge: [u32; 2]) -> DVec3 {
        0.5 * self.at(edge[0]) + 0.5 * self.at(edge[1])
    }

    /// For each facet, whether it is peeled off as part of a sheet.
    fn find_sheets(&self, edges: &EdgeTable) -> Vec<bool> {
        let mut left: Vec<usize> = (0..edges.ends.len()).map(|edge| edges.facets(edge).len()).collect();
        let mut peeled = vec![false; self.facets.len()];
        let singles = (0..left.len()).filter(|&edge| left[edge] == 1);
        let mut stack: Vec<u32> = singles.map(|edge| edges.facets(edge)[0]).collect();
        while let Some(facet) = stack.pop() {
            if std::mem::replace(&mut peeled[facet as usize], true) {
                continue;
            }
            for edge in edges.of_facet[facet as usize].map(|edge| edge as usize) {
                left[edge] -= 1;
                if left[edge] == 1 {
                    stack.extend(edges.facets(edge).iter().filter(|&&f| !peeled[f as usize]));
                }
            }
        }
        peeled
    }

    /// Open edges are errors unless their sheet lies inside what is closed, or its patch says embedded. Those of facets that
    /// were left out follow from what was found before.
    fn report_open_edges(&mut self, edges: &EdgeTable, sheets: &[bool], context: &RunContext) -> Result<()> {
        if !sheets.contains(&true) {
            return Ok(());
        }
        let component = self.sheet_components(edges, sheets);
        let core: Vec<u32> = (0..self.facets.len() as u32).filter(|&f| !sheets[f as usize]).collect();
        let boxes = core.iter().map(|&f| self.facet_box(f)).collect();
        let tree = AabbTree::new(boxes, context)?;
        let mut inside: FxHashMap<u32, bool> = FxHashMap::default();
        for edge in 0..edges.ends.len() {
            let &[facet] = edges.facets(edge) else { continue };
            let key = edges.ends[edge];
            if self.left_out.explains(key) {
                continue;
            }
            let sheet = component[facet as usize];
            let enclosed = *inside.entry(sheet).or_insert_with(|| self.is_enclosed(facet, &core, &tree));
            let severity = if enclosed { Severity::Note } else { Severity::Error };
            let text = if enclosed {
                format!("edge {} {} ends a sheet inside the volume", key[0], key[1])
            } else {
                let id = self.facets[facet as usize].0;
                format!("open edge {} {}: only triangle {id} is there", key[0], key[1])
            };
            let ids = key.map(i64::from);
            self.push(FindingCode::OpenEdge, severity, ids, Some(self.middle(key)), text);
        }
        Ok(())
    }

    fn facet_box(&self, facet: u32) -> BoundingBox {
        BoundingBox::of_points(self.facets[facet as usize].1.map(|v| self.at(v)))
    }

    /// Number of the sheet (its smallest facet) of each peeled facet.
    fn sheet_components(&self, edges: &EdgeTable, sheets: &[bool]) -> Vec<u32> {
        let mut component = vec![u32::MAX; self.facets.len()];
        for seed in (0..self.facets.len() as u32).filter(|&f| sheets[f as usize]) {
            if component[seed as usize] != u32::MAX {
                continue;
            }
            let mut stack = vec![seed];
            component[seed as usize] = seed;
            while let Some(facet) = stack.pop() {
                for edge in edges.of_facet[facet as usize] {
                    for &other in edges.facets(edge as usize) {
                        if sheets[other as usize] && component[other as usize] == u32::MAX {
                            component[other as usize] = seed;
                            stack.push(other);
                        }
                    }
                }
            }
        }
        component
    }

    /// Whether no ray from the middle of the facet escapes the closed part.
    fn is_enclosed(&self, facet: u32, core: &[u32], tree: &AabbTree) -> bool {
        if core.is_empty() {
            return false;
        }
        let bounds = core.iter().fold(BoundingBox::EMPTY, |b, &f| b.union(self.facet_box(f)));
        let [a, b, c] = self.facets[facet as usize].1.map(|v| self.at(v));
        let start = (a + b + c) / 3.0;
        let reach = 2.0 * (bounds.diagonal() + (start - bounds.center()).length());
        RAYS.iter().all(|ray| {
            let end = start + *ray * reach;
            let mut met = false;
            tree.along_segment(start, end, |i| {
                let corners = self.facets[core[i] as usize].1.map(|v| self.at(v));
                met = met || segment_meets_triangle(start, end, corners);
            });
            met
        })
    }

    /// Propagates the turn over edges of two facets and reports the smaller part of each component.
    fn check_orientation(&mut self, edges: &EdgeTable) {
        let mut turned: Vec<Option<bool>> = vec![None; self.facets.len()];
        let mut to_report = Vec::new();
        for seed in 0..self.facets.len() {
            if turned[seed].is_some() {
                continue;
            }
            let mut members = vec![seed];
            turned[seed] = Some(false);
            let mut next = 0;
            while next < members.len() {
                let facet = members[next];
                next += 1;
                for (place, [u, v]) in edges_of(self.facets[facet].1).into_iter().enumerate() {
                    let edge = edges.of_facet[facet][place] as usize;
                    let &[one, two] = edges.facets(edge) else { continue };
                    let other = if one as usize == facet { two } else { one } as usize;
                    let same_way = edges_of(self.facets[other].1).contains(&[u, v]);
                    if turned[other].is_none() {
                        turned[other] = Some(turned[facet].unwrap_or(false) != same_way);
                        members.push(other);
                    }
                }
            }
            let count = members.iter().filter(|&&f| turned[f] == Some(true)).count();
            let minority = 2 * count <= members.len();
            to_report.extend(members.into_iter().filter(|&f| (turned[f] == Some(true)) == minority && count > 0));
        }
        to_report.sort_unstable();
        for facet in to_report {
            let (id, corners) = self.facets[facet];
            let [a, b, c] = corners.map(|v| self.at(v));
            let text = format!("triangle {id} is turned against its neighbours; the mesh does not depend on it");
            let at = Some((a + b + c) / 3.0);
            let ids = [i64::from(id), -1];
            self.push(FindingCode::InconsistentOrientation, Severity::Warning, ids, at, text);
            self.facets[facet].1.swap(1, 2);
        }
    }

    fn check_pairs(&mut self, context: &RunContext) -> Result<()> {
        let boxes: Vec<BoundingBox> = (0..self.facets.len() as u32).map(|f| self.facet_box(f)).collect();
        let tree = AabbTree::new(boxes.clone(), context)?;
        let facets = &self.facets;
        let points = &self.surface.points;
        let chunks: Vec<usize> = (0..facets.len()).step_by(CHUNK).collect();
        let test_chunk = |&begin: &usize| -> Result<(usize, Vec<(u32, u32)>)> {
            context.check()?;
            let mut tested = 0;
            let mut bad = Vec::new();
            let mut near = Vec::new();
            for i in begin..(begin + CHUNK).min(facets.len()) {
                near.clear();
                tree.overlapping(boxes[i], |j| {
                    if j > i {
                        near.push(j);
                    }
                });
                near.sort_unstable();
                tested += near.len();
                let at = |v: u32| points[v as usize];
                let meets = |j: &usize| triangle_pair(facets[i].1, facets[*j].1, at) != Meeting::Proper;
                bad.extend(near.iter().filter(|j| meets(j)).map(|&j| (i as u32, j as u32)));
            }
            Ok((tested, bad))
        };
        let results: Vec<Result<_>> = context.install(|| chunks.par_iter().map(test_chunk).collect());
        for result in results {
            let (tested, bad) = result?;
            self.report.candidate_pairs += tested;
            for (i, j) in bad {
                let (first, second) = (self.facets[i as usize], self.facets[j as usize]);
                let overlap = self.facet_box(i).lower.max(self.facet_box(j).lower);
                let upper = self.facet_box(i).upper.min(self.facet_box(j).upper);
                let text = format!("triangles {} and {} intersect", first.0, second.0);
                let ids = [i64::from(first.0), i64::from(second.0)];
                let at = Some(0.5 * overlap + 0.5 * upper);
                self.error(FindingCode::IntersectingTriangles, ids, at, text);
            }
        }
        Ok(())
    }

    fn check_near_points(&mut self, options: &Options) {
        let mut used = vec![false; self.surface.points.len()];
        for v in self.surface.facets.iter().flatten() {
            if let Some(&merged) = self.merged.get(v.index()) {
                used[merged as usize] = true;
                used[v.index()] = true;
            }
        }
        for i in (0..used.len()).filter(|&i| !used[i]) {
            let point = self.surface.points[i];
            let text = format!("point {i} belongs to no triangle; it is left out");
            let at = is_usable(point).then_some(point);
            self.push(FindingCode::UnusedPoint, Severity::Note, [i as i64, -1], at, text);
        }
        let ids: Vec<usize> = (0..used.len())
            .filter(|&i| used[i] && self.merged[i] == i as u32 && is_usable(self.surface.points[i]))
            .collect();
        let points: Vec<DVec3> = ids.iter().map(|&i| self.surface.points[i]).collect();
        let tolerance = BoundingBox::of_points(points.iter().copied()).diagonal() * options.touch_tolerance;
        for (i, j) in close_pairs(&points, tolerance) {
            let distance = points[i].distance(points[j]);
            let text = format!("points {} and {} almost touch: {distance:e} apart", ids[i], ids[j]);
            let pair = [ids[i] as i64, ids[j] as i64];
            self.push(FindingCode::NearlyCoincidentPoints, Severity::Warning, pair, Some(points[i]), text);
        }
    }

    fn finish(mut self) -> CheckedSurface {
        // Stable: errors first, otherwise the order of the steps.
        self.findings.sort_by_key(|finding| std::cmp::Reverse(finding.severity));
        let mut number = vec![u32::MAX; self.surface.points.len()];
        let mut points = Vec::new();
        let mut used: Vec<u32> = self.facets.iter().flat_map(|(_, f)| *f).collect();
        used.sort_unstable();
        used.dedup();
        for v in used {
            number[v as usize] = points.len() as u32;
            points.push(self.at(v));
        }
        let patch = |id: u32| self.surface.facet_patches.get(id as usize).copied().unwrap_or(0);
        CheckedSurface {
            points,
            facets: self.facets.iter().map(|(_, f)| f.map(|v| VertexId(number[v as usize]))).collect(),
            facet_ids: self.facets.iter().map(|(id, _)| *id).collect(),
            facet_patches: self.facets.iter().map(|(id, _)| patch(*id)).collect(),
            findings: self.findings,
            report: self.report,
        }
    }
}

/// The edges of the facets, in the order of their ends.
struct EdgeTable {
    /// Smaller and larger end of each edge.
    ends: Vec<[u32; 2]>,
    /// Where the facets of each edge begin in `facets`, and one entry for the end.
    starts: Vec<u32>,
    /// The facets of all edges, in rising order for each.
    facets: Vec<u32>,
    /// The edges of each facet, in the order of `edges_of`.
    of_facet: Vec<[u32; 3]>,
}

impl EdgeTable {
    fn new(facets: &[(u32, [u32; 3])]) -> Self {
        let sides = |(facet, row): (usize, &(u32, [u32; 3]))| {
            let edges = edges_of(row.1);
            [0, 1, 2].map(|place| (sorted_edge(edges[place][0], edges[place][1]), facet as u32, place as u8))
        };
        let mut all: Vec<_> = facets.iter().enumerate().flat_map(sides).collect();
        all.par_sort_unstable();
        let mut table = Self {
            ends: Vec::new(),
            starts: Vec::new(),
            facets: Vec::with_capacity(all.len()),
            of_facet: vec![[0; 3]; facets.len()],
        };
        for (ends, facet, place) in all {
            if table.ends.last() != Some(&ends) {
                table.ends.push(ends);
                table.starts.push(table.facets.len() as u32);
            }
            table.of_facet[facet as usize][usize::from(place)] = table.ends.len() as u32 - 1;
            table.facets.push(facet);
        }
        table.starts.push(table.facets.len() as u32);
        table
    }

    fn facets(&self, edge: usize) -> &[u32] {
        &self.facets[self.starts[edge] as usize..self.starts[edge + 1] as usize]
    }
}

/// Whether the predicates can work with the point's coordinates.
fn is_usable(point: DVec3) -> bool {
    point.is_finite() && point.abs().max_element() <= LARGEST_COORDINATE
}

fn edges_of([a, b, c]: [u32; 3]) -> [[u32; 2]; 3] {
    [[a, b], [b, c], [c, a]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::test_surfaces::{cube, joined, sphere, surface_of, translated};

    fn findings(surface: &SurfaceMesh) -> Vec<Finding> {
        check(surface, &Options::default(), &RunContext::with_threads(2).unwrap()).unwrap().findings
    }

    fn errors(surface: &SurfaceMesh) -> Vec<(FindingCode, [i64; 2])> {
        let errors = findings(surface).into_iter().filter(|f| f.severity == Severity::Error);
        errors.map(|f| (f.code, f.ids)).collect()
    }

    #[test]
    fn valid_surfaces_have_no_findings() {
        assert!(findings(&cube(3)).is_empty());
        assert!(findings(&joined(&[cube(2), translated(&cube(2), DVec3::splat(1.0 + 1e-6))])).is_empty());
    }

    #[test]
    fn every_open_edge_is_named() {
        let mut surface = cube(3);
        let removed = surface.facets.remove(5);
        surface.facet_patches.pop();
        let found = errors(&surface);
        assert_eq!(found.len(), 3);
        assert!(
            found.iter().all(|(code, ids)| *code == FindingCode::OpenEdge
                && ids.iter().all(|&v| removed.contains(&VertexId(v as u32))))
        );
    }

    #[test]
    fn what_follows_from_a_facet_left_out_is_not_told() {
        let whole = cube(3);
        let codes = |surface: &SurfaceMesh| errors(surface).into_iter().map(|(code, _)| code).collect::<Vec<_>>();
        for value in [f64::NAN, f64::INFINITY] {
            let mut surface = whole.clone();
            surface.points[7].y = value;
            assert_eq!(errors(&surface), [(FindingCode::NonFiniteCoordinate, [7, -1])]);
        }
        let mut index = whole.clone();
        index.facets[5][1] = VertexId(999);
        assert_eq!(errors(&index), [(FindingCode::IndexOutOfRange, [5, 999])]);
        // A facet that has become a line by the move of a corner onto the middle of its opposite edge.
        let mut flat = surface_of(
            &[[0., 0., 0.], [2., 0., 0.], [1., 2., 0.], [1., 1., 2.], [1., 0., 0.]],
            &[[0, 2, 1], [0, 4, 3], [4, 1, 3], [1, 2, 3], [2, 0, 3], [0, 1, 4]],
        );
        let told = codes(&flat);
        assert!(told.contains(&FindingCode::DegenerateTriangle) && !told.contains(&FindingCode::OpenEdge));
        // A defect elsewhere is told beside it.
        flat.facets.remove(3);
        flat.facet_patches.pop();
        let told = codes(&flat);
        assert!(told.contains(&FindingCode::DegenerateTriangle) && told.contains(&FindingCode::OpenEdge));
    }

    #[test]
    fn a_sheet_is_allowed_inside_only() {
        let sheet = surface_of(&[[0.2, 0.2, 0.4], [0.7, 0.2, 0.4], [0.4, 0.7, 0.5]], &[[0, 1, 2]]);
        let inside = joined(&[cube(2), sheet.clone()]);
        assert!(errors(&inside).is_empty() && findings(&inside).len() == 3);
        let outside = joined(&[cube(2), translated(&sheet, DVec3::new(2.0, 0.0, 0.0))]);
        assert_eq!(errors(&outside).len(), 3);
    }

    #[test]
    fn crossing_and_touching_triangles_are_named() {
        let crossing = joined(&[sphere(2), translated(&sphere(2), DVec3::new(0.7, 0.1, 0.2))]);
        let found = errors(&crossing);
        assert!(found.len() > 10 && found.iter().all(|(code, _)| *code == FindingCode::IntersectingTriangles));
        // A cube that stands with a corner on the face of another one.
        let corner = surface_of(
            &[[0.5, 0.5, 1.0], [0.4, 0.5, 2.0], [0.6, 0.4, 2.0], [0.6, 0.6, 2.0]],
            &[[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]],
        );
        let touching = errors(&joined(&[cube(1), corner]));
        assert!(!touching.is_empty() && touching.iter().all(|(code, _)| *code == FindingCode::IntersectingTriangles));
    }

    #[test]
    fn bad_numbers_and_triangles_are_named_together() {
        let mut surface = cube(2);
        surface.points.push(DVec3::new(f64::NAN, 0.0, 0.0));
        surface.points.push(DVec3::new(0.0, -1e300, 0.0));
        surface.points.push(DVec3::new(0.25, 0.0, 0.0));
        surface.facets.push([VertexId(0), VertexId(1), VertexId(999)]);
        surface.facets.push(surface.facets[0]);
        surface.facets.push([VertexId(1), VertexId(1), VertexId(2)]);
        surface.facet_patches.resize(surface.facets.len(), 0);
        let codes: Vec<FindingCode> = errors(&surface).into_iter().map(|(code, _)| code).collect();
        for code in [
            FindingCode::NonFiniteCoordinate,
            FindingCode::IndexOutOfRange,
            FindingCode::DuplicateTriangle,
            FindingCode::DegenerateTriangle,
        ] {
            assert!(codes.contains(&code), "{code:?}");
        }
        assert!(findings(&surface).iter().any(|f| f.code == FindingCode::UnusedPoint));
    }

    #[test]
    fn turned_triangles_and_equal_points_are_repaired() {
        let mut surface = sphere(1);
        for facet in surface.facets.iter_mut().step_by(4) {
            facet.swap(0, 1);
        }
        let repeated = surface.points[surface.facets[0][0].index()];
        surface.points.push(repeated);
        surface.facets[0][0] = VertexId(surface.points.len() as u32 - 1);
        let checked = check(&surface, &Options::default(), &RunContext::with_threads(1).unwrap()).unwrap();
        assert!(!checked.has_errors());
        let count = |code| checked.findings.iter().filter(|f| f.code == code).count();
        assert_eq!(count(FindingCode::MergedPoints), 1);
        assert_eq!(count(FindingCode::InconsistentOrientation), 8);
        assert_eq!(checked.points.len(), surface.points.len() - 1);
    }

    #[test]
    fn flat_and_empty_surfaces_are_refused() {
        assert!(!errors(&SurfaceMesh::default()).is_empty());
        let flat = surface_of(&[[0., 0., 0.], [1., 0., 0.], [0., 1., 0.]], &[[0, 1, 2]]);
        assert!(errors(&flat).iter().any(|(code, _)| *code == FindingCode::DegeneratePointSet));
    }
}
