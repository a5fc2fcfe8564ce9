//! Iterated local search around tets that no single step makes better: perturb, mend, keep what became better.
//!
//! # Method
//! The steps of the improvement each raise the lowest score around them, so they end where any one of them would lower it
//! first. For each low tet, until one helps:
//! 1. A perturbation is made, whatever it costs, as long as no tet becomes flat: the tet's vertices go half of the way back to
//!    where the lattice had them, one of its edges is contracted, or one is split.
//! 2. The tets around are made better by the means of the improvement; in a crowd of low tets only those near what changed, and no longer
//!    than there is hope.
//! 3. When fewer tets are low then, or the lowest is less low, and no vertex is farther off its surface than the slack and than any
//!    was before, it stays; else everything is taken back.
//!
//! # Source
//! [LourencoMartinStutzle2003].
//!
//! # Differences
//! [Drakopoulos2017] 2.3.5 takes the smoothing of the whole mesh back where an element stays bad. Taking it back around bad
//! elements only, replacements included, has no bound: each replacement that is undone undoes those that built on it, and what
//! is left between smoothed and unsmoothed parts is worse than before.
//!
//! # Invariants
//! Never more tets are low than before, and the lowest is no lower. No vertex between two labels ends farther off their surface than
//! the slack, or than the farthest around was. A vertex on the image border stays in its plane, and a fixed vertex where it is.
//!
//! # Cost
//! At most 19 perturbations per low tet, some 170 with the edges around it, and a budget for the mesh; each touches a few rings of tets.

use glam::DVec3;
use rustc_hash::FxHashSet;

use crate::error::Result;
use crate::lattice::change_log::Mark;
use crate::lattice::element_score::{Part, Threshold};
use crate::lattice::improvement_mesh::ImprovementMesh;
use crate::lattice::local_transformations::{contract_edge, may_contract, split_edge};
use crate::lattice::subvoxel_surface::Side;
use crate::lattice::surface_cuts::distance_off;
use crate::mesh::numbering::{TET_EDGES, sorted_edge};

/// Rings of vertices around a low tet that are mended and compared.
const RINGS: usize = 2;

/// Score that a perturbation leaves to all tets, degrees: from flat ones the way back is lost in rounding.
pub const LEAST_PERTURBED: f64 = 1.0;

/// Parts of the way back to the lattice that are tried, the largest first.
const STEPS_BACK: [f64; 3] = [0.5, 0.25, 0.12];

/// Low tets around a place from which on they are a crowd, and how many more may be low after the first sweep of a trial in it. A trial
/// in a crowd costs ten to twenty times what one elsewhere does. Of 1203 trials in those of an atlas cut out of its image 802 had eleven
/// or more new low tets after the first sweep; 8 of them ended better than before, 174 of the others. Nine images with crowds take 125
/// instead of 137 s with both bounds, and 92 instead of 115 tets stay low. With a crowd of 4 and 6 more it is 122 s and 114 tets, of 8
/// and 4 more 131 s and 161.
const CROWD: usize = 16;
const MOST_SPOILED: usize = 10;

/// Rise of the lowest score that counts, degrees.
const LEAST_RISE: f64 = 0.05;

/// What perturbations may change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Perturbations {
    /// Places of vertices only.
    Moves,
    /// Elements too.
    All,
}

/// How far from a low tet edges are perturbed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Reach {
    /// Its own edges.
    Tet,
    /// Those of the tets that share a face with it.
    Faces,
    /// Those of the tets that share an edge with it.
    Edges,
}

/// A change that need not make anything better.
#[derive(Debug, Clone, Copy)]
enum Perturbation {
    /// The vertices go towards where the lattice had them.
    StepBack([u32; 4]),
    /// The first vertex is merged into the second.
    Contract(u32, u32),
    /// The edge gets a vertex in its middle.
    Split(u32, u32),
}

/// How low the tets of some vertices are: those that are low, and the lowest score.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    low: Vec<u32>,
    lowest: f64,
}

impl Outcome {
    /// Of the tets of some vertices; those below `wanted` are low.
    pub fn of(mesh: &ImprovementMesh, vertices: Vec<u32>, wanted: f64) -> Self {
        Self::among(mesh, low_tets_of(mesh, vertices, wanted))
    }

    fn among(mesh: &ImprovementMesh, low: Vec<u32>) -> Self {
        Self { lowest: mesh.lowest(&low), low }
    }

    /// That of the same vertices, and of those that were `touched` since (in order), once changes have been made: what none of these
    /// is part of is as it was.
    pub fn after(&self, mesh: &ImprovementMesh, touched: &[u32], wanted: f64) -> Self {
        let mut low = low_tets_of(mesh, touched.to_vec(), wanted);
        // A slot that was filled anew has a vertex that was touched.
        let stays = |t: &&u32| mesh.is_live(**t) && !has_any_of(mesh, **t, touched);
        low.extend(self.low.iter().filter(stays));
        low.sort_unstable();
        Self::among(mesh, low)
    }

    /// Not more are low, and the lowest is no lower.
    pub fn is_no_worse_than(&self, other: &Self) -> bool {
        self.low.len() <= other.low.len() && self.lowest >= other.lowest
    }

    fn is_better_than(&self, other: &Self) -> bool {
        self.low.len() < other.low.len() && self.lowest >= other.lowest
            || self.low.len() <= other.low.len() && self.lowest > other.lowest + LEAST_RISE
    }
}

/// The tets of some vertices below a score, in order.
fn low_tets_of(mesh: &ImprovementMesh, vertices: Vec<u32>, wanted: f64) -> Vec<u32> {
    let wanted = Threshold::of(wanted);
    let mut low = mesh.tets_of(vertices);
    low.retain(|t| mesh.fails(*t, &wanted));
    low
}

/// Whether a tet has any of some vertices, which are in order.
fn has_any_of(mesh: &ImprovementMesh, t: u32, vertices: &[u32]) -> bool {
    mesh.tets[t as usize].iter().any(|v| vertices.binary_search(v).is_ok())
}

/// What is around a place that is worked on within a trial.
#[derive(Debug, Clone, Copy)]
pub struct Surroundings<'a> {
    /// The vertices around, in order.
    pub vertices: &'a [u32],
    /// How low their tets were when the trial began.
    pub before: &'a Outcome,
    /// The trial.
    pub trial: Mark,
}

impl Surroundings<'_> {
    /// The tets of the vertices that are to be mended if they are low now, in order: those with a vertex that was touched and, unless
    /// they are a crowd, those that were low before.
    pub fn candidates(&self, mesh: &ImprovementMesh) -> Vec<u32> {
        let mut tets = mesh.tets_of(mesh.touched_since(self.trial));
        if self.before.low.len() < CROWD {
            tets.extend(&self.before.low);
        }
        tets.sort_unstable();
        tets.dedup();
        // A slot that was filled anew may be that of a tet elsewhere; an empty one has no vertex.
        tets.retain(|t| has_any_of(mesh, *t, self.vertices));
        tets
    }

    /// Whether a sweep has spoiled so much in a crowd that hardly any other would mend it; those below `wanted` are low.
    pub fn are_spoiled(&self, mesh: &ImprovementMesh, wanted: f64) -> bool {
        let before = self.before.low.len();
        let after = || self.before.after(mesh, &mesh.touched_since(self.trial), wanted).low.len();
        before >= CROWD && after() > before + MOST_SPOILED
    }
}

/// What a search reads and may spend.
pub struct IteratedSearch {
    /// Score below which a tet is low, degrees.
    pub wanted: f64,
    /// How far a surface vertex may stay off its surface, mm.
    pub slack: f64,
    /// What may change.
    pub perturbations: Perturbations,
    /// How far from the low tets.
    pub reach: Reach,
    /// Perturbations left to try.
    pub budget: usize,
    /// Vertices around what became better; some more than once.
    pub changed: Vec<u32>,
}

impl IteratedSearch {
    /// Searches around each of the tets `low`; `mend` makes those around a place better. Returns how often something became
    /// better.
    ///
    /// # Errors
    /// Those of `mend`.
    pub fn run(
        &mut self,
        mesh: &mut ImprovementMesh,
        low: &[u32],
        mend: &mut impl FnMut(&mut ImprovementMesh, &Surroundings) -> Result<()>,
    ) -> Result<usize> {
        let mut better = 0;
        for &t in low {
            if mesh.is_live(t) && mesh.part(t) == Part::Mesh && mesh.score(t) < self.wanted {
                better += usize::from(self.search_around(mesh, t, mend)?);
            }
        }
        Ok(better)
    }

    fn search_around(
        &mut self,
        mesh: &mut ImprovementMesh,
        t: u32,
        mend: &mut impl FnMut(&mut ImprovementMesh, &Surroundings) -> Result<()>,
    ) -> Result<bool> {
        let near = vertices_around(mesh, &mesh.tets[t as usize]);
        let before = Outcome::of(mesh, near.clone(), self.wanted);
        // A step back leaves the surface, and what is mended does not lead all vertices to it again.
        let slack = self.slack.max(farthest_off(mesh, &near));
        for perturbation in self.perturbations_of(mesh, t) {
            if self.budget == 0 {
                return Ok(false);
            }
            self.budget -= 1;
            let trial = mesh.begin_trial();
            if self.perturb(mesh, perturbation) {
                mend(mesh, &Surroundings { vertices: &near, before: &before, trial })?;
                let touched = mesh.touched_since(trial);
                let is_better = before.after(mesh, &touched, self.wanted).is_better_than(&before);
                // The others are where they were.
                if is_better && farthest_off(mesh, &touched) <= slack {
                    mesh.keep_trial();
                    self.changed.extend(near.iter().chain(&touched));
                    return Ok(true);
                }
            }
            mesh.take_back(trial);
        }
        Ok(false)
    }

    /// The perturbations of a tet, then those of the tets around it within reach.
    fn perturbations_of(&self, mesh: &ImprovementMesh, t: u32) -> Vec<Perturbation> {
        let tet = mesh.tets[t as usize];
        let mut found = vec![Perturbation::StepBack(tet)];
        if self.perturbations == Perturbations::Moves {
            return found;
        }
        let mut tets = vec![t];
        let shared = |n: &u32| mesh.tets[*n as usize].iter().filter(|v| tet.contains(v)).count();
        let common = match self.reach {
            Reach::Tet => 4,
            Reach::Faces => 3,
            Reach::Edges => 2,
        };
        let mut beside = mesh.tets_of(tet.to_vec());
        beside.retain(|n| *n != t && mesh.part(*n) == Part::Mesh && shared(n) >= common);
        beside.sort_by_key(|n| (std::cmp::Reverse(shared(n)), *n));
        tets.extend(beside);
        let edges_of = |t: u32| TET_EDGES.map(|edge| edge.map(|v| mesh.tets[t as usize][v]));
        let mut seen = FxHashSet::default();
        for t in tets {
            let mut ends = edges_of(t).to_vec();
            ends.retain(|[a, b]| seen.insert(sorted_edge(*a, *b)));
            let both_ways = ends.iter().flat_map(|[a, b]| [(*a, *b), (*b, *a)]);
            let contractions = both_ways.filter(|(from, to)| may_contract(mesh, *from, *to));
            found.extend(contractions.map(|(from, to)| Perturbation::Contract(from, to)));
            found.extend(ends.iter().map(|[a, b]| Perturbation::Split(*a, *b)));
        }
        found
    }

    fn perturb(&self, mesh: &mut ImprovementMesh, perturbation: Perturbation) -> bool {
        match perturbation {
            Perturbation::StepBack(vertices) => vertices.map(|v| step_back(mesh, v)).contains(&true),
            Perturbation::Contract(from, to) => contract_edge(mesh, from, to, &Threshold::of(LEAST_PERTURBED)),
            Perturbation::Split(a, b) => split_edge(mesh, a, b, LEAST_PERTURBED, self.slack),
        }
    }
}

/// The vertices within some rings of others, in order.
pub fn vertices_around(mesh: &ImprovementMesh, others: &[u32]) -> Vec<u32> {
    let mut vertices = others.to_vec();
    for _ in 0..RINGS {
        vertices = mesh.tets_of(vertices).into_iter().flat_map(|t| mesh.tets[t as usize]).collect();
        vertices.sort_unstable();
        vertices.dedup();
    }
    vertices
}

/// How far off their surface the vertices between two labels are at most, mm.
fn farthest_off(mesh: &ImprovementMesh, vertices: &[u32]) -> f64 {
    vertices.iter().filter_map(|v| distance_off(mesh, *v)).fold(0.0, f64::max)
}

/// A vertex goes back a part of its way from the lattice, the largest that leaves no tet flat.
fn step_back(mesh: &mut ImprovementMesh, v: u32) -> bool {
    let Some(goal) = mesh.place_in_lattice(v).filter(|_| !mesh.fixed[v as usize]) else { return false };
    let place = mesh.points[v as usize];
    let needed = Threshold::of(LEAST_PERTURBED);
    mesh.with_ball(v, |mesh, ball| {
        let at = |part: f64| in_planes(mesh, v, place.lerp(goal, part));
        let found = STEPS_BACK.into_iter().map(at).find(|place| ball.score_above(*place, &needed).is_some());
        found.inspect(|place| mesh.move_vertex(v, *place)).is_some()
    })
}

/// The place in the border planes that a vertex lies in.
fn in_planes(mesh: &ImprovementMesh, v: u32, mut place: DVec3) -> DVec3 {
    for side in mesh.sides(v) {
        if let Side::Border(plane) = side {
            let (axis, at) = mesh.surface.border(*plane);
            place[axis] = at;
        }
    }
    place
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
    use crate::index::{Label, VertexId};
    use crate::lattice::boundary_targets::SourcePoints;
    use crate::lattice::candidate_mesh::CandidateMesh;
    use crate::lattice::options::{Options, PARAMETERS};
    use crate::lattice::subvoxel_surface::SubvoxelSurface;
    use crate::lattice::test_images::{spaced_image, voxel_image};
    use crate::lattice::test_meshes::{helix, with_tets};
    use crate::mesh::quality::mesh_quality;
    use crate::mesh::validation::check_mixed_mesh;
    use crate::parameters::ParameterSet;

    #[test]
    fn what_helps_stays_and_all_else_is_taken_back_to_the_slot() {
        // An octahedron around two inner vertices, one of them next to a face of it.
        let ring = [DVec3::X, DVec3::Y, DVec3::NEG_X, DVec3::NEG_Y];
        let mut points = vec![DVec3::NEG_Z, DVec3::ZERO, DVec3::new(0.04, 0.04, 0.9), DVec3::Z];
        points.extend(ring);
        let v = VertexId::from_index;
        let rows = [(0, 1), (1, 2), (2, 3)].into_iter();
        let of_row = |(low, high)| (0..4).map(move |i| [v(low), v(high), v(4 + i), v(4 + (i + 1) % 4)]);
        let tets: Vec<[VertexId; 4]> = rows.flat_map(of_row).collect();
        let image = voxel_image(4, |_| 1);
        let context = RunContext::with_threads(1).unwrap();
        let surface = SubvoxelSurface::new(&image, &context).unwrap();
        let tet_labels = vec![Label(1); tets.len()];
        let mut mesh = CandidateMesh { points: points.clone(), tets, tet_labels, ..CandidateMesh::default() };
        let mut work = ImprovementMesh::new(&mut mesh, &SourcePoints::default(), surface);
        work.set_lattice(points);
        [0, 3, 4, 5, 6, 7].into_iter().for_each(|v: usize| work.fixed[v] = true);
        let before = (work.points.clone(), work.tets.clone(), work.labels.clone());
        let low = || (8..12).collect::<Vec<u32>>();
        let mut search = IteratedSearch {
            wanted: 90.0,
            slack: 0.0,
            perturbations: Perturbations::All,
            reach: Reach::Edges,
            budget: 1000,
            changed: Vec::new(),
        };
        // Nobody reaches ninety degrees, and a mend that spoils all makes every perturbation fail.
        let mut spoil = |mesh: &mut ImprovementMesh, _: &Surroundings| {
            mesh.move_vertex(3, DVec3::new(0.0, 0.0, -0.5));
            Ok(())
        };
        assert_eq!(search.run(&mut work, &low(), &mut spoil).unwrap(), 0);
        assert!(search.budget < 1000);
        assert_eq!((&work.points, &work.tets, &work.labels), (&before.0, &before.1, &before.2));
        for v in 0..8 {
            assert!(work.ball(v).iter().all(|t| work.tets[*t as usize].contains(&v)));
            assert_eq!(work.ball(v).len(), before.1.iter().filter(|tet| tet.contains(&v)).count());
        }
        // Contracting the edge between the inner vertices helps without a mend.
        search.wanted = 20.0;
        let lowest = work.lowest(&low());
        assert!(search.changed.is_empty());
        assert!(search.run(&mut work, &low(), &mut |_, _| Ok(())).unwrap() > 0);
        assert!(!search.changed.is_empty());
        let live: Vec<u32> = (0..work.tets.len() as u32).filter(|t| work.is_live(*t)).collect();
        assert!(work.lowest(&live) > lowest);
    }

    #[test]
    fn what_became_of_tets_is_known_from_those_that_were_touched() {
        let (points, tets) = helix(300);
        let image = voxel_image(4, |_| 1);
        with_tets(points, &tets, &image, |mut mesh| {
            // The tets are all alike; some become low.
            (0..300).step_by(8).for_each(|v| mesh.points[v] *= 1.0 - 0.001 * v as f64);
            let wanted = mesh.lowest(&[30]) + 0.1;
            let near = vertices_around(&mesh, &mesh.tets[150]);
            let before = Outcome::of(&mesh, near.clone(), wanted);
            assert!((3..CROWD).contains(&before.low.len()), "{before:?}");
            let trial = mesh.begin_trial();
            // Within and beside the rings: a vertex moves, tets go, slots are filled anew.
            mesh.move_vertex(near[1], mesh.points[near[1] as usize] + 0.05);
            let [low, last] = [before.low[0], before.low[before.low.len() - 1]];
            let row = (mesh.tets[low as usize], mesh.labels[low as usize]);
            mesh.replace(&[last, low], &[row]);
            mesh.replace(&[near[0] - 2], &[]);
            let touched = mesh.touched_since(trial);
            assert!(touched.is_sorted_by(|l, r| l < r) && touched.contains(&(near[0] - 2)));
            let after = before.after(&mesh, &touched, wanted);
            let all = [near.as_slice(), &touched].concat();
            assert_eq!(after, Outcome::of(&mesh, all, wanted));
            assert_ne!(after, before);
            let around = Surroundings { vertices: &near, before: &before, trial };
            let mut low = around.candidates(&mesh);
            low.retain(|t| mesh.fails(*t, &Threshold::of(wanted)));
            assert_eq!(low, Outcome::of(&mesh, near.clone(), wanted).low);
            mesh.take_back(trial);
            assert_eq!(Outcome::of(&mesh, near, wanted), before);
        });
    }

    #[test]
    fn in_a_crowd_only_what_was_touched_is_mended_as_long_as_there_is_hope() {
        let (points, tets) = helix(300);
        with_tets(points, &tets, &voxel_image(4, |_| 1), |mut mesh| {
            // The tets of some vertices become low.
            let wanted = mesh.lowest(&[30]) - 0.1;
            let lower = |mesh: &mut ImprovementMesh, vertices: std::ops::Range<usize>| {
                vertices.step_by(4).for_each(|v| mesh.move_vertex(v as u32, mesh.points[v] * 0.5));
            };
            lower(&mut mesh, 100..160);
            let crowd: Vec<u32> = (100..200).collect();
            let before = Outcome::of(&mesh, crowd.clone(), wanted);
            assert!(before.low.len() >= CROWD);
            let few = Outcome::of(&mesh, crowd[..10].to_vec(), wanted);
            assert!(!few.low.is_empty() && few.low.len() < CROWD);
            let trial = mesh.begin_trial();
            mesh.move_vertex(104, mesh.points[104] * 1.01);
            let around = Surroundings { vertices: &crowd, before: &before, trial };
            assert_eq!(around.candidates(&mesh), mesh.tets_of(vec![104]));
            let in_few = Surroundings { before: &few, ..around };
            assert!(few.low.iter().all(|t| in_few.candidates(&mesh).contains(t)));
            assert!(!around.are_spoiled(&mesh, wanted));
            lower(&mut mesh, 164..200);
            let after = before.after(&mesh, &mesh.touched_since(trial), wanted);
            assert!(after.low.len() > before.low.len() + MOST_SPOILED);
            assert!(around.are_spoiled(&mesh, wanted) && !in_few.are_spoiled(&mesh, wanted));
            mesh.take_back(trial);
        });
    }

    #[test]
    fn disordered_labels_keep_angles_and_volumes() {
        // Six labels in pieces of a few voxels, everywhere.
        let wave = |p: DVec3, phase: f64| {
            let d = DVec3::new((3.1 * phase).cos(), (5.3 * phase).sin(), (7.7 * phase + 1.0).cos());
            let e = DVec3::new((2.3 * phase).sin(), (4.1 * phase + 2.0).cos(), (6.1 * phase).sin());
            (0.7 * p.dot(d) + phase).sin() + (0.7 * p.dot(e) + 2.0 * phase).sin()
        };
        let label = |p: DVec3| {
            let value = |l: &u16| wave(p, 3.0 * 0.37 + 1.7 * f64::from(*l));
            (0..6u16).max_by(|l, r| value(l).total_cmp(&value(r))).unwrap()
        };
        let image = voxel_image(14, label);
        let mut set = ParameterSet::new(PARAMETERS);
        set.set_text("min-dihedral-angle", "15").unwrap();
        let options = Options::from_parameters(&set).unwrap();
        let context = RunContext::with_threads(1).unwrap();
        let (output, report) = crate::lattice::run(&image, &options, &context).unwrap();
        check_mixed_mesh(&output.mesh).unwrap();
        let lowest = mesh_quality(&output.mesh, &context).unwrap().statistics().value("quality.min_dihedral").unwrap();
        let tets = output.mesh.tets().unwrap();
        let volume = |label: i32| -> f64 {
            let own = (0..tets.len()).filter(|t| output.mesh.labels[*t] == label);
            own.map(|t| crate::geometry::tetrahedron::volume(tets[t].map(|v| output.mesh.points[v.index()]))).sum()
        };
        let error = |label: u16| {
            let voxels = image.voxels().iter().filter(|l| l.0 == label).count() as f64;
            (volume(i32::from(label)) / voxels - 1.0).abs()
        };
        let worst = (1..6).map(error).fold(0.0, f64::max);
        let searched = report.statistics().value("improvement.searched").unwrap();
        assert!(lowest > 14.9 && worst < 0.01 && searched > 0.0, "{lowest} {worst} {searched}");
    }

    #[test]
    fn angles_are_not_bought_with_vertices_far_off_their_surface() {
        let (spacing, radius) = (0.959_309_875_965, 22.570_257_647);
        let center = DVec3::new(26.554_825_287, 26.158_181_520, 26.731_616_879);
        let image = spaced_image([56; 3], DVec3::splat(spacing), |p| u16::from(p.distance(center) < radius));
        let options = Options::from_parameters(&ParameterSet::new(PARAMETERS)).unwrap();
        let context = RunContext::with_threads(2).unwrap();
        let (output, _) = crate::lattice::run(&image, &options, &context).unwrap();
        let mut faces: Vec<[VertexId; 3]> = Vec::new();
        for tet in output.mesh.tets().unwrap() {
            faces.extend((0..4).map(|left| {
                let mut face: [VertexId; 3] = std::array::from_fn(|k| tet[(left + 1 + k) % 4]);
                face.sort_unstable();
                face
            }));
        }
        faces.sort_unstable();
        let outer = faces.chunk_by(|l, r| l == r).filter(|same| same.len() == 1).flat_map(|same| same[0]);
        let off = |v: VertexId| (output.mesh.points[v.index()].distance(center) - radius).abs() / spacing;
        let worst = outer.map(off).fold(0.0, f64::max);
        // Measured 0.32; a step back towards the lattice left one vertex at 0.63.
        assert!(worst < 0.45, "{worst}");
    }
}
