//! Iterated local search: where no operation betters a bad tet, the mesh around it is disturbed and improved again.
//!
//! # Method
//! ```text
//!      region of some hundred tets          1. The tets around the bad one are copied; the faces that they share with
//!    +---------------------------+             others, and walls, stay as they are.
//!    |   .  bad tet     .        |          2. One disturbance: a flip or the removal of a vertex whatever becomes of
//!    |  . . /\ .   .   . .  .    |             the angles, or a new vertex on an edge, a face or in a tet.
//!    |   . /__\   .   .    .     |          3. All operations at the region's bad tets, while they help.
//!    +---------------------------+          4. Where fewer tets are left that may not stay, it replaces those of the mesh;
//!                                              else the best of all goes on from there, a few times.
//! ```
//! A search for tets off the boundary ([`Aim::OffBoundary`]) counts only these; the others are taken as good until they are
//! slivers of a hundredth of a degree.
//!
//! # Source
//! [LourencoMartinStutzle2003] for the search; the operations are those of [`super::parallel_reconnection`].
//!
//! # Invariants
//! The mesh changes only by regions that are better. Walls, their edges and the border of the region are kept.
//!
//! # Cost
//! Some milliseconds a disturbance: for the few tets that may not stay. One thread; deterministic.

use glam::DVec3;
use rustc_hash::{FxHashMap, FxHashSet};

use super::flip_criteria::{BiasedSine, Relief, STRICT_ANGLE, StrictInside, TetMeasure};
use super::flips::{
    Accept, Feature, FlipScratch, Outcome, commit, plan_edge_removal, plan_face_removal, plan_insertion,
    plan_vertex_removal,
};
use super::forced_slivers::{is_forced_sliver, sliver_cosine};
use super::needle_faces::NeedleFaces;
use super::options::Options;
use super::parallel_reconnection::{Crowding, Driver, FLAT_BELOW, Treatment};
use super::region_annealing::{Annealer, Annealing};
use crate::context::RunContext;
use crate::error::Result;
use crate::index::{TetFace, TetId, VertexId};
use crate::mesh::numbering::{TET_EDGES, TET_FACES};
use crate::mesh::tet_complex::TetComplex;
use crate::mesh::tet_store::TetStore;
use crate::mesh::topology::ShellTet;

/// Most tets of a region: two to three rings around a tet. With half of them as much is found, in no less time.
const MOST_TETS: usize = 300;

/// The same where slivers are annealed: of small regions more states are seen. On two surfaces, with 3 and 5 slivers that nothing
/// forces, 60 to 150 leave 1 and 2, 200 and more 3 and 2.
const MOST_ANNEALED_FOR_SLIVERS: usize = 120;
/// Most disturbances one after the other before fewer tets may be left: one until that leads nowhere any more, since of 59
/// regions that were replaced on three parts, 50 needed no more, which took half of the disturbances.
pub const DEPTHS: [usize; 2] = [1, 3];
/// Disturbances in all: so many, and more for each region that was replaced; but no more than the last. The parts of
/// the tests ask for a thousand at most.
const DISTURBANCES: [usize; 3] = [800, 30, 2000];
/// Regions with more than one such tet among so many are left alone: between walls much closer than their triangles are wide
/// nearly every tet is a sliver, and to take away one of hundreds helps nobody, at the price of points far too close. On
/// parts where most slivers could be removed, one in twenty or fewer were left where searches began.
const CROWDED: usize = 4;
/// Rounds of operations after a disturbance.
const ROUNDS: usize = 4;
/// Tets below this angle get operations after a disturbance, degrees. With twice as much no more is found.
const IMPROVED_BELOW: f64 = 6.0;
/// Most tets around an edge that is removed.
const EDGE_LIMIT: usize = 10;
/// The large angle that tets off the boundary may have, degrees: half a degree less than demanded.
const LARGEST_OFF_BOUNDARY: f64 = 157.5;
/// How far the lowest grade of the tets off the boundary may fall where there are fewer of them, as a factor.
const PAID_FOR_FEWER: f64 = 0.7;
/// The factor by which it rises where there are as many.
const STEP_OF_LOWEST: f64 = 1.05;
/// The grade from which a tet lacks little: that of a small angle of 10 degrees.
const LACKING_LITTLE: f64 = 0.17;

/// The grade below which tets off the boundary may not stay. Slivers have less.
pub fn grade_off_boundary() -> f64 {
    BiasedSine::grade_of_angles(90.0, LARGEST_OFF_BOUNDARY)
}

/// Whether a tet is a sliver that walls do not force, or off the boundary and near the angles demanded there.
pub fn may_not_stay(complex: &TetComplex, on_boundary: &[bool], tet: TetId) -> bool {
    let corners = complex.points_of(tet);
    let measure = StrictInside { angles: BiasedSine, on_boundary, relief: Relief::Nothing };
    let is_below = measure.is_strict(&complex.vertices(tet)) && BiasedSine.grade(corners) < grade_off_boundary();
    is_below || sliver_cosine(corners).is_some() && !is_forced_sliver(complex, tet)
}

/// What a search is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Aim {
    /// Fewer tets that may not stay, and no more slivers.
    FewerBad,
    /// Fewer tets off the boundary beyond the demanded angles, or better ones, whatever becomes of the others.
    OffBoundary,
}

/// How bad a region is.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Score {
    /// Tets that may not stay.
    bad: usize,
    /// Those of them off the boundary: none may come for a sliver.
    off: usize,
    /// Their lowest grade: what is beyond the demanded angles may not go farther.
    lowest_off: f64,
    /// Slivers that walls force: one may come for one that they do not.
    forced: usize,
    /// What all tets lack; says which way to go on.
    lack: f64,
    /// The worst of those that may not stay, where there is one.
    worst: Option<TetId>,
}

impl Score {
    /// Tets that may not stay, and slivers that walls force.
    fn slivers(&self) -> usize {
        self.bad + self.forced
    }

    fn is_accepted_after(&self, before: &Self, aim: Aim) -> bool {
        if aim == Aim::OffBoundary {
            let is_fewer = self.off < before.off && self.lowest_off >= PAID_FOR_FEWER * before.lowest_off;
            return is_fewer || self.off == before.off && self.lowest_off > STEP_OF_LOWEST * before.lowest_off;
        }
        let is_better_off = self.off <= before.off && self.lowest_off >= before.lowest_off;
        self.bad < before.bad && is_better_off && self.slivers() <= before.slivers()
    }

    /// Whether nothing that counts is worse than before.
    fn is_as_good_as(&self, before: &Self, aim: Aim) -> bool {
        let is_as_good_off = self.off <= before.off && self.lowest_off >= before.lowest_off;
        is_as_good_off && (aim == Aim::OffBoundary || self.bad <= before.bad && self.slivers() <= before.slivers())
    }

    fn is_better_than(&self, other: &Self, aim: Aim) -> bool {
        if aim == Aim::OffBoundary {
            return (self.off, self.lack) < (other.off, other.lack);
        }
        (self.off + self.bad, self.forced, self.lack) < (other.off + other.bad, other.forced, other.lack)
    }
}

/// A copy of some tets.
#[derive(Clone)]
struct Region {
    /// The tets in the mesh.
    tets: Vec<TetId>,
    /// The vertices in the mesh, by their numbers here.
    vertices: Vec<VertexId>,
    /// The copy. Behind the border of the region there is nothing; walls are constrained.
    complex: TetComplex,
    sizes: Vec<f64>,
    /// Which vertices lie on the boundary of the mesh.
    on_boundary: Vec<bool>,
    /// The needles among the region's walls.
    needles: NeedleFaces,
    /// The bad tet here.
    center: TetId,
}

impl Region {
    /// About `most` tets around one of the mesh, as far as walls let pass.
    fn around(complex: &TetComplex, sizes: &[f64], on_boundary: &[bool], tet: TetId, most: usize) -> Result<Self> {
        let tets = collect(complex, tet, most);
        let mut numbers: FxHashMap<VertexId, VertexId> = FxHashMap::default();
        let mut vertices = Vec::new();
        for v in tets.iter().flat_map(|&t| complex.vertices(t)) {
            numbers.entry(v).or_insert_with(|| {
                vertices.push(v);
                VertexId::from_index(vertices.len() - 1)
            });
        }
        let mut copy = TetComplex::with_points(vertices.iter().map(|v| complex.point(*v)).collect())?;
        let label = complex.label(tet);
        let mut walls = Vec::new();
        for &t in &tets {
            let new = copy.create_tet(complex.vertices(t).map(|v| numbers[&v]), label)?;
            let flags = complex.flags(t).without_user_bits();
            copy.set_flags(new, flags);
            walls.extend((0..4).filter(|f| flags.is_face_constrained(*f)).map(|f| TetFace::new(new, f)));
        }
        copy.pair_faces()?;
        let triangles: Vec<_> = walls.into_iter().map(|side| copy.face_vertices(side)).collect();
        let needles = NeedleFaces::new(copy.points(), &triangles, FLAT_BELOW);
        Ok(Self {
            center: TetId::from_index(0),
            sizes: vertices.iter().map(|v| sizes.get(v.index()).copied().unwrap_or(0.0)).collect(),
            on_boundary: vertices.iter().map(|v| on_boundary.get(v.index()).copied().unwrap_or(false)).collect(),
            needles,
            complex: copy,
            tets,
            vertices,
        })
    }

    fn score(&self) -> Score {
        let mut score = Score { bad: 0, off: 0, lowest_off: f64::INFINITY, forced: 0, lack: 0.0, worst: None };
        let mut least = f64::INFINITY;
        for tet in self.complex.finite_tets() {
            let corners = self.complex.points_of(tet);
            let grade = BiasedSine.grade(corners);
            if may_not_stay(&self.complex, &self.on_boundary, tet) {
                score.bad += 1;
                let is_off = |v: &VertexId| !self.on_boundary.get(v.index()).copied().unwrap_or(false);
                if self.complex.vertices(tet).iter().all(is_off) {
                    score.off += 1;
                    score.lowest_off = score.lowest_off.min(grade);
                }
                if grade < least {
                    (least, score.worst) = (grade, Some(tet));
                }
            } else {
                score.forced += usize::from(sliver_cosine(corners).is_some());
            }
            // The fourth power makes one flat tet count more than all that are only poor; below a degree it is the same.
            score.lack += (LACKING_LITTLE / grade).min(10.0).powi(4);
        }
        score
    }

    /// Puts the region in the place of its tets in the mesh.
    fn replace(self, complex: &mut TetComplex, sizes: &mut Vec<f64>, flips: &mut FlipScratch) -> Result<()> {
        let Self { tets, mut vertices, complex: copy, sizes: new_sizes, .. } = self;
        let mut is_used = vec![false; copy.vertex_count()];
        let rows: Vec<_> = copy.finite_tets().map(|tet| copy.vertices(tet)).collect();
        rows.iter().flatten().for_each(|v| is_used[v.index()] = true);
        let plan = &mut flips.plan;
        plan.reset(complex.label(tets[0]));
        plan.old = tets;
        for v in (0..copy.vertex_count()).map(VertexId::from_index) {
            let place = copy.point(v);
            match vertices.get(v.index()) {
                Some(&known) if is_used[v.index()] => complex.set_point(known, place),
                Some(&known) => plan.removed_vertices.push(known),
                None if is_used[v.index()] => {
                    vertices.push(complex.push_point(place)?);
                    sizes.resize(complex.vertex_count(), 0.0);
                    sizes[complex.vertex_count() - 1] = new_sizes[v.index()];
                }
                None => vertices.push(VertexId::GHOST),
            }
        }
        plan.new.extend(rows.into_iter().map(|row| row.map(|v| vertices[v.index()])));
        commit(complex, flips)
    }
}

/// About `most` tets around one, nearest rings first, in one piece without crossing walls and with no wall inside.
fn collect(complex: &TetComplex, tet: TetId, most: usize) -> Vec<TetId> {
    let label = complex.label(tet);
    let (mut tets, mut known) = (vec![tet], FxHashSet::from_iter([tet]));
    let mut ring: FxHashSet<VertexId> = complex.vertices(tet).into_iter().collect();
    loop {
        let before = tets.len();
        let mut at = 0;
        while at < tets.len() && tets.len() < most {
            let (flags, neighbors) = (complex.flags(tets[at]), complex.neighbors(tets[at]));
            for (face, other) in neighbors.into_iter().enumerate() {
                if other == TetFace::NONE || flags.is_face_constrained(face) || known.contains(&other.tet()) {
                    continue;
                }
                let next = other.tet();
                let wall_inside = |f: usize| {
                    let beyond = complex.neighbor(TetFace::new(next, f));
                    complex.flags(next).is_face_constrained(f)
                        && beyond != TetFace::NONE
                        && known.contains(&beyond.tet())
                };
                let row = complex.vertices(next);
                let fits = complex.label(next) == label && row.iter().any(|v| ring.contains(v));
                if fits && !row.contains(&VertexId::GHOST) && !(0..4).any(wall_inside) {
                    known.insert(next);
                    tets.push(next);
                }
            }
            at += 1;
        }
        if tets.len() == before || tets.len() >= most {
            return tets;
        }
        ring.extend(tets.iter().flat_map(|&t| complex.vertices(t)));
    }
}

/// One way to disturb the region.
#[derive(Debug, Clone, Copy)]
enum Disturbance {
    RemoveEdge(TetId, usize),
    RemoveFace(TetFace),
    RemoveVertex(VertexId),
    Insert(Feature),
}

/// The disturbances at a tet and at those that share a face with it; those that help most often come first.
fn disturbances(complex: &TetComplex, tet: TetId) -> Vec<Disturbance> {
    let mut all = Vec::new();
    let beside = complex.neighbors(tet).into_iter().filter(|side| *side != TetFace::NONE).map(TetFace::tet);
    let near: Vec<TetId> = std::iter::once(tet).chain(beside).collect();
    let mut vertices: Vec<VertexId> = Vec::new();
    for v in near.iter().flat_map(|&t| complex.vertices(t)) {
        if !vertices.contains(&v) {
            vertices.push(v);
        }
    }
    all.extend((0..6).map(|edge| Disturbance::RemoveEdge(tet, edge)));
    all.extend(vertices.into_iter().map(Disturbance::RemoveVertex));
    all.extend(TET_EDGES.map(|[a, b]| Disturbance::Insert(Feature::Edge(tet, a, b))));
    all.extend((0..4).map(|face| Disturbance::RemoveFace(TetFace::new(tet, face))));
    all.extend((0..4).map(|face| Disturbance::Insert(Feature::Face(TetFace::new(tet, face)))));
    all.extend(near.into_iter().map(|t| Disturbance::Insert(Feature::Tet(t))));
    all
}

/// Searches regions.
pub struct RegionSearch {
    context: RunContext,
    /// Remembers what fails: disturbances leave most of a region as it was.
    driver: Driver,
    flips: FlipScratch,
    goal: f64,
    /// Tets around which nothing was found, and how deep; they are not searched again before something changes there.
    failed: Vec<(usize, [VertexId; 4])>,
    annealer: Annealer,
    /// What is searched for.
    aim: Aim,
    /// Disturbances tried, and those that led to something better.
    pub counts: [usize; 2],
}

impl RegionSearch {
    /// A search for `aim` whose operations aim at a grade.
    pub fn new(options: &Options, context: &RunContext, goal: f64, aim: Aim) -> Self {
        let driver = Driver::for_quality(options, context);
        let context = context.clone();
        Self {
            context,
            driver,
            flips: FlipScratch::default(),
            goal,
            failed: Vec::new(),
            annealer: Annealer::default(),
            aim,
            counts: [0; 2],
        }
    }

    /// Searches around a tet, so many disturbances deep; true where fewer tets are left that may not stay.
    ///
    /// # Errors
    /// [`crate::error::Error::Cancelled`], or what the store refuses.
    pub fn search(
        &mut self,
        complex: &mut TetComplex,
        sizes: &mut Vec<f64>,
        on_boundary: &[bool],
        (tet, depth): (TetId, usize),
    ) -> Result<bool> {
        let row = complex.vertices(tet);
        if !may_not_stay(complex, on_boundary, tet) || self.failed.contains(&(depth, row)) {
            return Ok(false);
        }
        self.failed.push((depth, row));
        let mut current = Region::around(complex, sizes, on_boundary, tet, MOST_TETS)?;
        let before = current.score();
        if self.is_crowded(&current, &before) {
            return Ok(false);
        }
        // What was reached is not gone on from again.
        let mut reached = vec![before.lack];
        for _ in 0..depth {
            let Some((after, region)) = self.best_beside(&current, &before, &reached)? else { return Ok(false) };
            if after.is_accepted_after(&before, self.aim) {
                self.counts[1] += 1;
                self.failed.retain(|(_, row)| !row.iter().any(|v| region.vertices.contains(v)));
                region.replace(complex, sizes, &mut self.flips)?;
                return Ok(true);
            }
            let Some(worst) = after.worst else { return Ok(false) };
            reached.push(after.lack);
            current = Region { center: worst, ..region };
        }
        Ok(false)
    }

    /// Anneals the region around a tet; whether that bettered it. One that is as good as before is taken too, so that another
    /// annealing begins elsewhere.
    ///
    /// # Errors
    /// As [`RegionSearch::search`].
    pub fn anneal(
        &mut self,
        complex: &mut TetComplex,
        sizes: &mut Vec<f64>,
        on_boundary: &[bool],
        tet: TetId,
    ) -> Result<bool> {
        if !may_not_stay(complex, on_boundary, tet) {
            return Ok(false);
        }
        let most = match self.aim {
            Aim::FewerBad => MOST_ANNEALED_FOR_SLIVERS,
            Aim::OffBoundary => MOST_TETS,
        };
        let mut region = Region::around(complex, sizes, on_boundary, tet, most)?;
        let before = region.score();
        if self.is_crowded(&region, &before) {
            return Ok(false);
        }
        let Region { complex: copy, sizes: new_sizes, on_boundary, .. } = &mut region;
        let annealing = Annealing { aim: self.aim, on_boundary };
        self.annealer.anneal(copy, new_sizes, &annealing, &self.context)?;
        self.counts[0] += 1;
        let after = region.score();
        let is_better = after.is_accepted_after(&before, self.aim);
        if !is_better && !after.is_as_good_as(&before, self.aim) {
            return Ok(false);
        }
        if is_better {
            self.counts[1] += 1;
            self.failed.retain(|(_, row)| !row.iter().any(|v| region.vertices.contains(v)));
        }
        region.replace(complex, sizes, &mut self.flips)?;
        Ok(is_better)
    }

    /// The best region that one disturbance leads to; the first that is accepted.
    fn best_beside(&mut self, start: &Region, before: &Score, reached: &[f64]) -> Result<Option<(Score, Region)>> {
        let mut best: Option<(Score, Region)> = None;
        for disturbance in disturbances(&start.complex, start.center) {
            self.context.check()?;
            let mut region = start.clone();
            if self.is_spent() || !self.disturb(&mut region, disturbance)? {
                continue;
            }
            self.counts[0] += 1;
            self.improve(&mut region)?;
            let after = region.score();
            let is_known = reached.iter().any(|lack| (lack - after.lack).abs() < 1e-9 * lack);
            if !is_known && best.as_ref().is_none_or(|(least, _)| after.is_better_than(least, self.aim)) {
                best = Some((after, region));
                if after.is_accepted_after(before, self.aim) {
                    break;
                }
            }
        }
        Ok(best)
    }

    /// Whether slivers are sought in a region where they crowd.
    fn is_crowded(&self, region: &Region, score: &Score) -> bool {
        self.aim == Aim::FewerBad && score.slivers() > region.tets.len() / CROWDED
    }

    /// Whether there have been as many disturbances as there may be.
    fn is_spent(&self) -> bool {
        let [tried, replaced] = self.counts;
        let [first, each, most] = DISTURBANCES;
        tried >= (first + each * replaced).min(most)
    }

    /// Disturbs the region; false where that cannot be.
    fn disturb(&mut self, region: &mut Region, disturbance: Disturbance) -> Result<bool> {
        let Region { complex, sizes, .. } = region;
        let flips = &mut self.flips;
        let outcome = match disturbance {
            Disturbance::RemoveEdge(tet, edge) => {
                let [a, b] = TET_EDGES[edge];
                plan_edge_removal(complex, ShellTet::new(tet, a, b), EDGE_LIMIT, &BiasedSine, Accept::Valid, flips)
            }
            Disturbance::RemoveFace(side) => plan_face_removal(complex, side, &BiasedSine, Accept::Valid, flips),
            Disturbance::RemoveVertex(v) => plan_vertex_removal(complex, v, &BiasedSine, Accept::Valid, flips),
            Disturbance::Insert(feature) => {
                let (tet, locals): (TetId, &[usize]) = match feature {
                    Feature::Edge(tet, a, b) => (tet, &[a, b]),
                    Feature::Face(side) => (side.tet(), &TET_FACES[side.face()]),
                    Feature::Tet(tet) => (tet, &[0, 1, 2, 3]),
                    Feature::Vertex(_) => return Ok(false),
                };
                let row = complex.vertices(tet);
                let place = locals.iter().map(|&i| complex.point(row[i])).sum::<DVec3>() / locals.len() as f64;
                let size = locals.iter().map(|&i| sizes[row[i].index()]).sum::<f64>() / locals.len() as f64;
                let vertex = complex.push_point(place)?;
                sizes.push(size);
                plan_insertion(complex, feature, vertex, &BiasedSine, flips)
            }
        };
        if outcome == Outcome::Accepted {
            commit(complex, flips)?;
        }
        Ok(outcome == Outcome::Accepted)
    }

    /// All operations at the bad tets beside what was disturbed, while they help.
    fn improve(&mut self, region: &mut Region) -> Result<()> {
        let Region { complex, sizes, on_boundary, needles, .. } = region;
        let driver = &mut self.driver;
        driver.turn_to_another_mesh();
        let relief = if self.aim == Aim::OffBoundary { Relief::Boundary } else { Relief::Needles(needles) };
        let treatment = Treatment { relief, ..Treatment::everything(self.goal, Crowding::Allowed) };
        let measure = StrictInside { angles: BiasedSine, on_boundary, relief: Relief::Nothing };
        let is_for_off = self.aim == Aim::OffBoundary;
        let limit = if is_for_off { STRICT_ANGLE } else { IMPROVED_BELOW }.to_radians().sin();
        let is_meant = |row: [VertexId; 4]| !is_for_off || measure.is_strict(&row);
        let mut changed: Vec<VertexId> = self.flips.plan.new.iter().flatten().copied().collect();
        for _ in 0..ROUNDS {
            let is_near = |tet: TetId| complex.vertices(tet).iter().filter(|v| changed.contains(v)).count() >= 3;
            let mut bad: Vec<(f64, TetId)> = complex
                .finite_tets()
                .filter(|&tet| is_near(tet) && is_meant(complex.vertices(tet)))
                .map(|tet| (BiasedSine.grade(complex.points_of(tet)), tet))
                .filter(|(grade, _)| *grade < limit)
                .collect();
            bad.sort_unstable_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
            let bad = bad.into_iter().map(|(_, tet)| tet).collect();
            if driver.treat(complex, sizes, on_boundary, bad, &treatment)? == 0 {
                break;
            }
            let touched = driver.take_touched();
            changed = touched.made.into_iter().chain(touched.moved).collect();
            changed.sort_unstable();
            changed.dedup();
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::test_meshes::{add_walls, random_mesh, walls};

    #[test]
    fn only_a_search_off_the_boundary_pays_with_slivers() {
        let score = |bad, off, lowest_off| Score { bad, off, lowest_off, forced: 1, lack: 0.0, worst: None };
        let before = score(3, 1, 0.1);
        let (paid, fewer, worse) = (score(5, 0, 0.2), score(2, 1, 0.1), score(2, 0, 0.05));
        for (after, accepted) in [(paid, [false, true]), (fewer, [true, false]), (worse, [false, false])] {
            let found = [Aim::FewerBad, Aim::OffBoundary].map(|aim| after.is_accepted_after(&before, aim));
            assert_eq!(found, accepted, "{after:?}");
        }
    }

    #[test]
    fn what_is_as_good_costs_nothing_that_counts() {
        let score = |bad, off, lowest_off, forced| Score { bad, off, lowest_off, forced, lack: 0.0, worst: None };
        let before = score(3, 1, 0.1, 1);
        assert!([Aim::FewerBad, Aim::OffBoundary].map(|aim| before.is_as_good_as(&before, aim)) == [true; 2]);
        let (lower, one_off, more_bad, more_forced) =
            (score(3, 1, 0.09, 1), score(3, 2, 0.1, 1), score(4, 1, 0.1, 0), score(3, 1, 0.1, 2));
        for (after, as_good) in
            [(lower, [false; 2]), (one_off, [false; 2]), (more_bad, [false, true]), (more_forced, [false, true])]
        {
            let found = [Aim::FewerBad, Aim::OffBoundary].map(|aim| after.is_as_good_as(&before, aim));
            assert_eq!(found, as_good, "{after:?}");
        }
    }

    #[test]
    fn a_region_goes_back_as_it_came() {
        let mut complex = random_mesh(7, 300);
        add_walls(&mut complex, 11);
        let (before, count) = (walls(&complex), complex.live_count());
        let mut sizes = vec![1.0; 300];
        let tet = complex.finite_tets().nth(100).unwrap();
        let region = Region::around(&complex, &sizes, &[], tet, MOST_TETS).unwrap();
        assert!(region.tets.len() > 20 && region.tets.len() < MOST_TETS + 4 && region.tets[0] == tet);
        region.complex.check_invariants().unwrap();
        region.replace(&mut complex, &mut sizes, &mut FlipScratch::default()).unwrap();
        complex.check_invariants().unwrap();
        assert!(walls(&complex) == before && complex.live_count() == count);
    }

    #[test]
    fn annealing_betters_tets_off_the_boundary_and_keeps_walls() {
        let mut complex = random_mesh(3, 300);
        add_walls(&mut complex, 11);
        let before = walls(&complex);
        let mut sizes = vec![0.1; 300];
        // Every second vertex counts as one of the boundary.
        let on_boundary: Vec<bool> = (0..300).map(|v| v % 2 == 0).collect();
        let left = |complex: &TetComplex| {
            let is_off =
                |tet: &TetId| complex.vertices(*tet).iter().all(|v| !on_boundary.get(v.index()).is_some_and(|b| *b));
            complex
                .finite_tets()
                .filter(|tet| is_off(tet) && may_not_stay(complex, &on_boundary, *tet))
                .collect::<Vec<_>>()
        };
        let bad = left(&complex);
        let context = RunContext::with_threads(1).unwrap();
        let mut search = RegionSearch::new(&Options::default(), &context, 0.4, Aim::OffBoundary);
        let mut anneal =
            |tet: TetId| complex.is_live(tet) && search.anneal(&mut complex, &mut sizes, &on_boundary, tet).unwrap();
        assert!(bad.iter().take(8).any(|tet| anneal(*tet)));
        let after = left(&complex);
        assert!(after.len() <= bad.len(), "{} of {}", after.len(), bad.len());
        complex.check_invariants().unwrap();
        complex.check_orientation().unwrap();
        assert!(walls(&complex) == before && sizes.len() == complex.vertex_count());
    }

    #[test]
    fn searching_leaves_fewer_slivers_and_keeps_walls() {
        let mut complex = random_mesh(3, 300);
        add_walls(&mut complex, 11);
        let before = walls(&complex);
        // All vertices that are there count as the boundary's: only slivers may not stay.
        let on_boundary = vec![true; 300];
        let mut sizes = vec![0.1; 300];
        let left = |complex: &TetComplex| {
            complex.finite_tets().filter(|&tet| may_not_stay(complex, &on_boundary, tet)).collect::<Vec<_>>()
        };
        let bad = left(&complex);
        let context = RunContext::with_threads(1).unwrap();
        let mut search = RegionSearch::new(&Options::default(), &context, 0.4, Aim::FewerBad);
        let mut found = 0;
        for &tet in &bad {
            let is_there = complex.is_live(tet) && !complex.is_ghost_tet(tet);
            let count = left(&complex).len();
            if is_there && search.search(&mut complex, &mut sizes, &on_boundary, (tet, 3)).unwrap() {
                found += 1;
                assert!(left(&complex).len() < count);
                complex.check_invariants().unwrap();
                complex.check_orientation().unwrap();
            }
        }
        assert!(found > 3 && search.counts[1] == found, "{found} of {}", bad.len());
        assert!(walls(&complex) == before && sizes.len() == complex.vertex_count());
    }

    #[test]
    fn annealing_leaves_fewer_slivers_and_keeps_walls() {
        let mut complex = random_mesh(3, 300);
        add_walls(&mut complex, 11);
        let before = walls(&complex);
        let on_boundary = vec![true; 300];
        let mut sizes = vec![0.1; 300];
        let left = |complex: &TetComplex| {
            complex.finite_tets().filter(|&tet| may_not_stay(complex, &on_boundary, tet)).collect::<Vec<_>>()
        };
        let bad = left(&complex);
        let context = RunContext::with_threads(1).unwrap();
        let mut search = RegionSearch::new(&Options::default(), &context, 0.4, Aim::FewerBad);
        let mut anneal = |tet: TetId| {
            let count = left(&complex).len();
            let helped = complex.is_live(tet) && search.anneal(&mut complex, &mut sizes, &on_boundary, tet).unwrap();
            // In vain, the region may end elsewhere, but with no more slivers.
            assert!(if helped { left(&complex).len() < count } else { left(&complex).len() <= count });
            helped
        };
        assert!(bad.iter().take(8).filter(|tet| anneal(**tet)).count() > 0);
        complex.check_invariants().unwrap();
        complex.check_orientation().unwrap();
        assert!(walls(&complex) == before && sizes.len() == complex.vertex_count());
    }
}
