//! The loop of refinement: elements, labels, comparison with the image, marking, until nothing is missing.
//!
//! # Method
//! 1. Close the lattice with greens, label by centroid, count mismatches ([`super::voxel_fidelity`]).
//! 2. Where labels lack fidelity or components are lost, mark leaves and refine ([`super::subdivision_criteria`]).
//! 3. Where no leaves are marked, or a few, relabel the candidate mesh ([`super::element_labels`]) and count again; refine
//!    where that costs the fidelity. At the finest level the relabelling spares what a label needs instead. From the first
//!    round on that marks a few leaves only, the lattice is closed locally, and what a refinement leaves as it was is taken
//!    over from the round before: elements, mismatches, neighbours. Where edges become shorter than a voxel, ten times as many
//!    leaves are a few to the closure.
//! 4. Where surfaces are smoothed, leaves with voxels that smoothing cannot reach are refined ([`super::missed_voxels`]), the
//!    lattice closed locally around them, and those with voxels that no element of their label is near ([`super::stray_voxels`]).
//! 5. Where surfaces are smoothed or checked, pinches are relabelled ([`super::interface_topology`]). Then refinement goes on for a
//!    few rounds where a label is broken ([`super::region_gaps`]) or components of one are joined ([`super::region_joints`]), with
//!    the check also where pinches are left and where a label has other tunnels than the image ([`super::topology_differences`]).
//!    Where one has when the rounds are over, passages that the mesh closes are opened ([`super::closed_passages`]). What still
//!    pinches is carved ([`super::interface_carving`]). Where the border of the image cuts the elements afterwards
//!    ([`super::border_clipping`]), what is left inside counts.
//!
//! A relabelling of 3 or 5 gives no two labels a contact that the image does not have ([`super::image_contacts`]).
//!
//! # Source
//! [Drakopoulos2017] 2.3.3.
//!
//! # Invariants
//! Each round refines at least one leaf, levels are bounded, so the loop ends. What is still missing then is returned
//! and reported as findings.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::{Error, Finding, FindingCode, Result, Severity};
use crate::image::connected_components::{Component, Components, Connectivity, Members, component_counts};
use crate::image::distance_transform::distance_to_other_labels;
use crate::image::euler_numbers::euler_numbers;
use crate::image::label_image::LabelImage;
use crate::index::Label;
use crate::lattice::bcc_lattice::{Field, LatticeFrame, PastBorder};
use crate::lattice::candidate_mesh::CandidateMesh;
use crate::lattice::closed_passages::Passages;
use crate::lattice::element_labels::{Relabelled, relabel_for_smoothing};
use crate::lattice::euler_ranges::EulerRanges;
use crate::lattice::face_adjacency::{neighbors_after, neighbors_among, neighbors_of, rematch};
use crate::lattice::image_contacts::ImageContacts;
use crate::lattice::interface_carving::carve;
use crate::lattice::interface_topology::InterfaceTopology;
use crate::lattice::kept_components::KeptComponents;
use crate::lattice::last_repair::LastRepair;
use crate::lattice::mesh_regions::{
    fill_unseen_regions, joinable_regions, number_by_image, regions_inside, regions_of, regions_with_background,
    relabel_loose_regions, surplus_of,
};
use crate::lattice::missed_voxels::mark_missed_voxels;
use crate::lattice::mixed_elements::{self, SurfaceCount};
use crate::lattice::options::Options;
use crate::lattice::pinch_fillings::{Extent, FillingRules, Pinches, choose_fillings};
use crate::lattice::progress_shares;
use crate::lattice::red_green::{CHANGED, Elements, RedGreenLattice};
use crate::lattice::region_gaps::elements_at_gaps;
use crate::lattice::region_joints::elements_at_joints;
use crate::lattice::report::Report;
use crate::lattice::stray_voxels::mark_stray_voxels;
use crate::lattice::subdivision_criteria::{Deficit, Demands, Targets, finest_level, mark_leaves};
use crate::lattice::topology_differences::elements_at_differences;
use crate::lattice::vertex_balls::VertexBalls;
use crate::lattice::voxel_fidelity::{
    LabelCount, Mismatch, counted_anew, for_each_voxel, mismatches, mismatches_after, recounted,
};

/// Rounds of refinement for the sake of topology: a pinch that comes from the image's own shape is gone after two or three
/// (edges of 4 voxels become half a voxel), one that the lattice makes anew each time never goes. On an atlas of brain lobes the
/// last label has the image's Euler number after five, where features of two voxels fill the whole image after nine.
const TOPOLOGY_ROUNDS: u32 = 9;

/// Rounds among these that refine around pinches alone, with all pieces and Euler numbers within reach: those of the image's own shape.
const PINCH_ROUNDS: u32 = 2;

/// Share of the leaves below which those that are marked must not refine the whole lattice: the closure is local then. It is a
/// few places that lack something, components of a voxel or two most often, where boundaries are whole layers of leaves. On a
/// cortex of 48 regions 333 leaves of 3 million made 23 million elements without it. A hundredth instead of a thousandth saves
/// five sixths of the elements of a whole brain, but its surface is smoother and nearer with them, and mixed meshes need the
/// uniform regions.
const FEW_LEAVES: f64 = 0.001;

/// The same share where edges are about to become shorter than a voxel: a whole lattice of these shows no more of the image than
/// one of voxels does. Ten labels of 8 voxels each in a block of 40^3 mark 122 of 19 008 leaves, 345 of 151 476, 1408 of 1.2
/// million: the last of these three rounds made 6.2 million elements of 0.8.
const FEW_FINE_LEAVES: f64 = 0.01;

/// Edges shorter than this part of the smallest voxel spacing are shorter than a voxel; those that are meant to be as long as one
/// can come out a rounding below it.
const BELOW_A_VOXEL: f64 = 0.9;

/// Rounds that refine where the mesh joins components of a label, or breaks one, without the check. Of 400 images of thin walls around
/// tubes and random shapes 24 have a label with other pieces than the image without such rounds, 6 with these.
const PIECE_ROUNDS: u32 = 3;

/// Rounds of carving: a group that may not be filled at first can be once another one has joined or parted its pieces.
const CARVING_ROUNDS: u32 = 3;

/// Rounds that refine around stray voxels: from edges of two voxels to those of half a one, and once more where relabelling
/// lost some. On a cortex of 48 regions they mark 1138, 66 and 1 leaves of 3 million, on one of 41 regions 104, 3, 0.
const STRAY_ROUNDS: u32 = 3;

/// Vertices per parallel work item.
const CHUNK: usize = 4096;

/// What refinement works with.
#[derive(Clone, Copy)]
pub struct RefinementInput<'a> {
    /// The cleaned segmentation, internal labels.
    pub image: &'a LabelImage,
    /// The caller's value of each internal label.
    pub values: &'a [i32],
    /// What is asked of each label.
    pub targets: &'a Targets,
    /// Edge of the coarsest cubes, mm.
    pub spacing: f64,
    /// Where sub-meshes are to be manifold: share of a label's volume below which its loose regions are relabelled.
    pub region_threshold: Option<f64>,
}

/// Refines until every label has its fidelity and every component an element; the mesh, and the neighbours of its tets.
///
/// # Errors
/// Those of [`LatticeFrame::new`]; [`Error::Cancelled`], [`Error::LimitReached`].
pub fn refine(
    input: &RefinementInput,
    options: &Options,
    report: &mut Report,
    context: &RunContext,
) -> Result<(CandidateMesh, Vec<[u32; 4]>)> {
    context.progress("distance transform", progress_shares::BEGUN);
    let frame = LatticeFrame::new(input.image, input.spacing)?;
    // The components are found by one thread, while the others are at the distances.
    let (distance, components) = report.timed("distance_transform", || {
        rayon::join(
            || distance_to_other_labels(input.image, context),
            || Components::new(input.image, Connectivity::Vertex, Members::All, context),
        )
    });
    let (distance, components) = (distance?, components?);
    let count = |image: u64| LabelCount { image, ..LabelCount::default() };
    let totals = input.image.voxel_counts().into_iter().map(count).collect();
    let smooths = options.smoothing_iterations > 0;
    let past_border = if smooths { PastBorder::Continued } else { PastBorder::Background };
    let field = Field::new(input.image, &distance, past_border);
    context.progress("lattice", progress_shares::BEGUN);
    let mut lattice = report.timed("lattice", || RedGreenLattice::new(frame, field, options.max_elements, context))?;
    if options.local_closure {
        lattice.close_locally();
    }
    let euler = match smooths || input.region_threshold.is_some() {
        true => report.timed("topology", || euler_numbers(input.image, context))?,
        false => Vec::new(),
    };
    let (elements, neighbors, lost) = {
        let (face_components, last_repairs, lost) = (None, [None, None], Vec::new());
        let mut rounds =
            Rounds { input, components, totals, face_components, euler, smooths, lost, last_repairs, report, context };
        let (elements, neighbors) = rounds.run(&mut lattice)?;
        (elements, neighbors, rounds.lost)
    };
    report.set("lattice.level", f64::from(lattice.deepest_level()));
    report.set("lattice.spacing", input.spacing);
    let mut cubes = Vec::new();
    if options.mixed_elements || smooths {
        let surface = if options.mixed_elements { SurfaceCount::Counted(&neighbors) } else { SurfaceCount::Skipped };
        cubes = report.timed("mixed_elements", || mixed_elements::find_cubes(&lattice, &elements, surface, context))?;
    }
    context.check()?;
    let mut mesh =
        report.timed("compaction", || mixed_elements::compact(&lattice, &elements, &cubes, smooths, context))?;
    mesh.lost = lost;
    let is_labelled = |e: usize| !elements.labels[e].is_background();
    let neighbors = report.timed("adjacency", || neighbors_among(&neighbors, is_labelled, context))?;
    // Giving memory back takes the system some time.
    rayon::join(|| drop(elements), || drop(lattice));
    context.check()?;
    Ok((mesh, neighbors))
}

/// Whether so many leaves are marked that the whole lattice is still being refined.
fn marks_many(marked: &[bool]) -> bool {
    share_of(marked) >= FEW_LEAVES && marked.contains(&true)
}

/// Whether the lattice is to be closed locally around the leaves that are marked.
fn closes_locally(lattice: &RedGreenLattice, marked: &[bool], voxel: DVec3) -> bool {
    let levels = lattice.levels.iter().zip(marked).filter(|(_, marked)| **marked).map(|(level, _)| u32::from(*level));
    let shortest = levels.max().map_or(f64::INFINITY, |level| lattice.frame.edge_length(level + 1));
    let is_fine = shortest < BELOW_A_VOXEL * voxel.min_element();
    !marks_many(marked) || is_fine && share_of(marked) < FEW_FINE_LEAVES
}

fn share_of(marked: &[bool]) -> f64 {
    marked.iter().filter(|m| **m).count() as f64 / marked.len() as f64
}

/// Marks the leaves of `more` too.
fn join(marked: &mut [bool], more: &[bool]) {
    marked.iter_mut().zip(more).for_each(|(marked, more)| *marked |= more);
}

/// How far refinement for the sake of topology may go.
#[derive(Clone, Copy)]
struct RefinementLimit {
    finest: u32,
    rounds_left: u32,
}

struct Rounds<'a> {
    input: &'a RefinementInput<'a>,
    components: Components,
    totals: Vec<LabelCount>,
    /// How many pieces each label has in the image, once somebody asked.
    face_components: Option<Vec<i64>>,
    /// Euler numbers of the labels in the image, in both readings, where what is pinched is made manifold; else none.
    euler: Vec<[i64; 2]>,
    /// Whether surfaces are smoothed afterwards: then pinches are in the way.
    smooths: bool,
    /// Components without an element at the end.
    lost: Vec<Component>,
    /// The last repairs of pinches, of the elements as they are now: any, and those that take no voxel from its label.
    last_repairs: [Option<LastRepair>; 2],
    report: &'a mut Report,
    context: &'a RunContext,
}

/// What a round leaves for the next one.
struct RoundBefore {
    /// With their labels by centroid.
    elements: Elements,
    /// The mismatches of these.
    found: Vec<Mismatch>,
    neighbors: Vec<[u32; 4]>,
}

/// Whether so few elements have changed that matching the faces of these alone is less work, and memory, than matching all.
fn changes_few(numbers: &[u32]) -> bool {
    numbers.iter().filter(|number| **number == CHANGED).count() < numbers.len() / 4
}

/// What relabelling pinched elements leaves.
struct RelabelledPinches {
    /// The mismatches then.
    found: Vec<Mismatch>,
    /// The Euler numbers, where they are to be kept and known.
    euler: Option<EulerRanges>,
    /// All vertices that still pinch, and some others, where they are known.
    left: Option<Vec<u32>>,
    /// The elements around vertices.
    balls: Option<VertexBalls>,
}

/// What is known from the round before.
struct Known {
    /// The number then of each element, or [`CHANGED`].
    numbers: Vec<u32>,
    /// The neighbours then.
    neighbors: Vec<[u32; 4]>,
}

impl Rounds<'_> {
    /// The elements in the end, and their neighbours.
    fn run(&mut self, lattice: &mut RedGreenLattice) -> Result<(Elements, Vec<[u32; 4]>)> {
        let finest = finest_level(lattice, self.input.image);
        let is_checked = self.input.region_threshold.is_some();
        let mut topology_rounds = if is_checked { TOPOLOGY_ROUNDS } else { PIECE_ROUNDS };
        // Missed voxels in the first of these only: on an atlas of brain lobes a second round takes a tenth more time, for 0.573
        // instead of 0.581 voxel from the staircase at 95 % of it.
        let mut stray_rounds = if self.smooths { STRAY_ROUNDS } else { 0 };
        let mut before = None;
        for round in 0.. {
            let reached = f64::from(round) / (f64::from(round) + 4.0);
            let end = if self.smooths { progress_shares::REFINED } else { progress_shares::REFINED_ONLY };
            let share = progress_shares::BEGUN + (end - progress_shares::BEGUN) * reached;
            self.context.progress("refinement", share);
            let (mut elements, found, known) = self.begin_round(lattice, before.take())?;
            let mut deficit = self.deficit(&found);
            // What bends in a leaf was marked in the round before.
            let is_straight = |leaf: usize| known.is_some() && lattice.unchanged[leaf] != CHANGED;
            let mut marked = self.mark(lattice, &elements, &found, &deficit, finest, is_straight)?;
            // A round costs as much for a few leaves as for all: what relabelling lacks joins a few marks.
            if !marks_many(&marked) {
                let by_centroid = elements.labels.clone();
                let mut neighbors = self.neighbors(lattice, &elements, known)?;
                let mut relabelled = self.relabel(lattice, &mut elements, &neighbors, |_| false)?;
                let at_centroid = found;
                let mut found = self.recount(&at_centroid, &by_centroid, lattice, &elements)?;
                let after = self.deficit(&found);
                if after.is_worse_than(&deficit) {
                    join(&mut marked, &self.mark(lattice, &elements, &found, &after, finest, |_| true)?);
                    if !marked.contains(&true) {
                        // At the finest level: keep the elements that hold voxels of their own label.
                        elements.labels.clone_from(&by_centroid);
                        relabelled = self.relabel_within_fidelity(lattice, &mut elements, &neighbors)?;
                        found = self.recount(&at_centroid, &by_centroid, lattice, &elements)?;
                    }
                }
                deficit = self.deficit(&found);
                if stray_rounds > 0 && !marks_many(&marked) {
                    let (targets, context) = (self.input.targets, self.context);
                    let mut unreached = self
                        .report
                        .timed("marking", || mark_stray_voxels(lattice, &elements, &found, targets, finest, context))?;
                    if stray_rounds == STRAY_ROUNDS {
                        let missed = self
                            .report
                            .timed("marking", || mark_missed_voxels(lattice, &elements, targets, context))?;
                        join(&mut unreached, &missed);
                        if unreached.contains(&true) {
                            // What a round that comes anyway sets right does not ask for one of its own.
                            let others = self.mark_other_pieces(lattice, &elements, &neighbors, &found, finest)?;
                            join(&mut unreached, &others);
                        }
                    }
                    stray_rounds -= 1;
                    if unreached.contains(&true) {
                        lattice.close_locally();
                    }
                    join(&mut marked, &unreached);
                }
                if !marked.contains(&true) {
                    let limit = RefinementLimit { finest, rounds_left: topology_rounds };
                    topology_rounds = topology_rounds.saturating_sub(1);
                    if is_checked {
                        (marked, found) =
                            self.make_manifold(lattice, &mut elements, &mut neighbors, found, &deficit, limit)?;
                    } else if self.smooths {
                        (marked, found) =
                            self.keep_pieces(lattice, &mut elements, &mut neighbors, found, &deficit, limit)?;
                    }
                    deficit = self.deficit(&found);
                }
                if !marked.contains(&true) {
                    self.finish(&deficit, relabelled);
                    self.report.set("lattice.rounds", f64::from(round));
                    return Ok((elements, neighbors));
                }
                elements.labels = by_centroid;
                before = Some(RoundBefore { elements, found: at_centroid, neighbors });
            }
            if closes_locally(lattice, &marked, self.input.image.grid().spacing()) {
                lattice.close_locally();
            }
            let context = self.context;
            self.report.timed("refinement", || lattice.refine(&marked, context))?;
        }
        Err(Error::Internal { reason: "refinement ran out of rounds".into() })
    }

    /// The elements with their labels by centroid and the mismatches; where there is a round before, what is known from it.
    fn begin_round(
        &mut self,
        lattice: &RedGreenLattice,
        before: Option<RoundBefore>,
    ) -> Result<(Elements, Vec<Mismatch>, Option<Known>)> {
        let context = self.context;
        let Some(before) = before else {
            self.last_repairs = [None, None];
            let elements = self.report.timed("elements", || lattice.elements(context))?;
            let found = self.count(lattice, &elements)?;
            return Ok((elements, found, None));
        };
        let (elements, numbers) =
            self.report.timed("elements", || lattice.elements_after(&before.elements, context))?;
        drop(before.elements);
        self.last_repairs = self.last_repairs.each_mut().map(|last| last.take().map(|last| last.renumbered(&numbers)));
        let found = self.count_after(&before.found, &numbers, lattice, &elements)?;
        Ok((elements, found, Some(Known { numbers, neighbors: before.neighbors })))
    }

    fn count(&mut self, lattice: &RedGreenLattice, elements: &Elements) -> Result<Vec<Mismatch>> {
        self.report.timed("fidelity", || mismatches(lattice, elements, &self.components, self.context))
    }

    /// The mismatches, from those `found` before: `numbers` has for each element its number then, or [`CHANGED`].
    fn count_after(
        &mut self,
        found: &[Mismatch],
        numbers: &[u32],
        lattice: &RedGreenLattice,
        elements: &Elements,
    ) -> Result<Vec<Mismatch>> {
        let (components, context) = (&self.components, self.context);
        self.report.timed("fidelity", || mismatches_after(found, numbers, lattice, elements, components, context))
    }

    /// The mismatches after labels have changed from `before`, when there were those `found`.
    fn recount(
        &mut self,
        found: &[Mismatch],
        before: &[Label],
        lattice: &RedGreenLattice,
        elements: &Elements,
    ) -> Result<Vec<Mismatch>> {
        let (components, context) = (&self.components, self.context);
        self.report.timed("fidelity", || recounted(found, before, lattice, elements, components, context))
    }

    fn deficit(&self, found: &[Mismatch]) -> Deficit {
        Deficit::new(&self.totals, found, &self.components, self.input.targets)
    }

    fn mark(
        &mut self,
        lattice: &RedGreenLattice,
        elements: &Elements,
        found: &[Mismatch],
        deficit: &Deficit,
        finest: u32,
        is_straight: impl Fn(usize) -> bool + Sync + Send,
    ) -> Result<Vec<bool>> {
        let demands = Demands { deficit, targets: self.input.targets, finest };
        let context = self.context;
        self.report.timed("marking", || mark_leaves(lattice, elements, found, &demands, is_straight, context))
    }

    fn neighbors(
        &mut self,
        lattice: &RedGreenLattice,
        elements: &Elements,
        known: Option<Known>,
    ) -> Result<Vec<[u32; 4]>> {
        let vertices = lattice.vertices.positions.len();
        let known = known.filter(|known| changes_few(&known.numbers));
        let context = self.context;
        self.report.timed("adjacency", || match known {
            Some(Known { numbers, neighbors }) => neighbors_after(&neighbors, &numbers, &elements.tets, context),
            None => neighbors_of(&elements.tets, vertices, context),
        })
    }

    /// The topology of the interfaces, of what is left inside of the image where smoothing cuts the elements at its border; `balls` are
    /// those of the elements where they are known.
    fn topology<'a>(
        &self,
        lattice: &RedGreenLattice,
        tets: &'a [[u32; 4]],
        neighbors: &'a [[u32; 4]],
        balls: Option<VertexBalls>,
    ) -> Result<InterfaceTopology<'a>> {
        let list = || VertexBalls::new(tets, neighbors, lattice.vertices.positions.len(), self.context);
        let mut topology = InterfaceTopology::with_balls(tets, neighbors, balls.map_or_else(list, Ok)?);
        if let Some(is_inside) = self.inside(lattice) {
            topology.cut_at_border(&is_inside);
        }
        Ok(topology)
    }

    /// The Euler numbers of the labels, counted where they are not known.
    fn euler_ranges(
        &self,
        known: Option<EulerRanges>,
        topology: &InterfaceTopology,
        labels: &[Label],
    ) -> Result<EulerRanges> {
        known.map_or_else(|| topology.euler_ranges(labels, &self.euler, self.context), Ok)
    }

    /// Whether each vertex is inside of the image; `None` where all are, or nothing is cut at its border.
    fn inside(&self, lattice: &RedGreenLattice) -> Option<Vec<bool>> {
        let positions = lattice.vertices.positions.par_iter().with_min_len(CHUNK);
        let is_inside = |position: &IVec3| lattice.field.contains(lattice.frame.local(*position));
        self.smooths.then(|| positions.map(is_inside).collect()).filter(|inside: &Vec<bool>| inside.contains(&false))
    }

    fn relabel(
        &mut self,
        lattice: &RedGreenLattice,
        elements: &mut Elements,
        neighbors: &[[u32; 4]],
        is_kept: impl Fn(usize) -> bool,
    ) -> Result<Relabelled> {
        let contacts = ImageContacts::new(lattice, &elements.tets, neighbors);
        let may_take = |labels: &[Label], changed: &[u32], label: Label| {
            changed.iter().all(|e| !is_kept(*e as usize)) && contacts.allow(labels, changed, label)
        };
        let context = self.context;
        self.report.timed("relabelling", || relabel_for_smoothing(&mut elements.labels, neighbors, may_take, context))
    }

    /// Relabels only elements that hold no voxel centre of their own label.
    fn relabel_within_fidelity(
        &mut self,
        lattice: &RedGreenLattice,
        elements: &mut Elements,
        neighbors: &[[u32; 4]],
    ) -> Result<Relabelled> {
        let holds_any = |tet: &[u32; 4]| {
            let mut any = false;
            for_each_voxel(lattice, tet, |_, _| any = true);
            any
        };
        let holds: Vec<bool> = self.context.until_cancelled(elements.tets.par_iter()).map(holds_any).collect();
        self.context.check()?;
        self.relabel(lattice, elements, neighbors, |e| holds[e])
    }

    /// Relabels pinched elements where that costs neither fidelity nor a component.
    fn relabel_pinches(
        &mut self,
        lattice: &RedGreenLattice,
        elements: &mut Elements,
        neighbors: &[[u32; 4]],
        found: Vec<Mismatch>,
        before: &Deficit,
    ) -> Result<RelabelledPinches> {
        let unchanged = elements.labels.clone();
        let topology = self.topology(lattice, &elements.tets, neighbors, None)?;
        let contacts = ImageContacts::new(lattice, &elements.tets, neighbors);
        let context = self.context;
        // What pinches without a repair, and the Euler numbers then.
        let mut unrepaired: Option<(Vec<u32>, Option<EulerRanges>)> = None;
        // Where the changes cost too many voxels all told, those that cost none remain.
        for (pass, most_lost) in [usize::MAX, 0].into_iter().enumerate() {
            let may_lose = |labels: &[Label], changed: &[u32], label: Label| {
                contacts.voxels_lost(labels, changed, label).filter(|lost| *lost <= most_lost)
            };
            let labels = &mut elements.labels;
            let wanted = self.input.region_threshold.map(|_| self.euler.as_slice());
            let last = self.last_repairs[pass].take();
            let (euler, repaired) = self.report.timed("topology", || -> Result<_> {
                let (from, mut euler, done) = match last {
                    Some(last) => {
                        let (from, done) = last.take_over(&topology, labels);
                        (from, None, done)
                    }
                    None => {
                        let count = || -> Result<_> {
                            let euler = wanted.map(|wanted| topology.euler_ranges(labels, wanted, context));
                            Ok((topology.pinched(labels, context)?, euler.transpose()?))
                        };
                        let known = unrepaired.take().map_or_else(count, Ok)?;
                        let (from, euler) = unrepaired.insert(known).clone();
                        (from, euler, Vec::new())
                    }
                };
                let mut repaired = topology.repair_from(from, labels, euler.as_mut(), context, may_lose)?;
                repaired.left.extend(done);
                Ok((euler, repaired))
            })?;
            // Where Euler numbers are to be kept, what was best for them before need not be now.
            self.last_repairs[pass] =
                wanted.is_none().then(|| LastRepair::new(&unchanged, &elements.labels, repaired.left.clone()));
            let after = self.recount(&found, &unchanged, lattice, elements)?;
            if !self.deficit(&after).is_worse_than(before) {
                self.report.add("topology.relabelled", repaired.changed.len() as f64);
                let balls = Some(topology.into_balls());
                return Ok(RelabelledPinches { found: after, euler, left: Some(repaired.left), balls });
            }
            elements.labels.clone_from(&unchanged);
        }
        Ok(RelabelledPinches { found, euler: None, left: None, balls: Some(topology.into_balls()) })
    }

    /// Relabels loose regions and pinched elements; returns the leaves to refine where that was not enough, and
    /// the mismatches. When nothing is to be refined any more, what still pinches is carved; the neighbours follow.
    fn make_manifold(
        &mut self,
        lattice: &mut RedGreenLattice,
        elements: &mut Elements,
        neighbors: &mut Vec<[u32; 4]>,
        mut found: Vec<Mismatch>,
        before: &Deficit,
        limit: RefinementLimit,
    ) -> Result<(Vec<bool>, Vec<Mismatch>)> {
        let unchanged = elements.labels.clone();
        let (threshold, labels) = (self.input.region_threshold.unwrap_or(0.0), self.input.values.len());
        relabel_loose_regions(lattice, elements, neighbors, labels, threshold, self.context)?;
        let after = self.recount(&found, &unchanged, lattice, elements)?;
        if self.deficit(&after).is_worse_than(before) {
            elements.labels = unchanged;
        } else {
            found = after;
        }
        let mut relabelled = self.relabel_pinches(lattice, elements, neighbors, found, before)?;
        if let Some(found) = self.fill_unseen(lattice, elements, neighbors, &relabelled.found)? {
            relabelled = RelabelledPinches { found, euler: None, left: None, balls: relabelled.balls };
        }
        let context = self.context;
        let mut marked = vec![false; lattice.tets.len()];
        if limit.rounds_left > 0 {
            let topology = self.topology(lattice, &elements.tets, neighbors, relabelled.balls.take())?;
            let known = self.euler_ranges(relabelled.euler.take(), &topology, &elements.labels)?;
            marked = self.mark_other_pieces(lattice, elements, neighbors, &relabelled.found, limit.finest)?;
            let others = known.all_out_of_reach();
            let has_settled = limit.rounds_left + PINCH_ROUNDS <= TOPOLOGY_ROUNDS;
            // Carving chooses the numbers of the image where they are within reach.
            if marked.contains(&true) || !others.is_empty() || !has_settled {
                let components = &self.components;
                let concerned = self.report.timed("topology", || -> Result<Vec<u32>> {
                    let pinched = topology.elements_around(&topology.pinched(&elements.labels, context)?);
                    let differing = elements_at_differences(lattice, elements, neighbors, &known, components, context)?;
                    Ok([pinched, differing].concat())
                })?;
                self.mark_refinable(lattice, elements, &concerned, limit.finest, &mut marked);
            }
            if !marked.contains(&true) {
                // What the voxels do not show can be between them and the border.
                let across = topology.elements_across_border(&others, &elements.labels);
                self.mark_refinable(lattice, elements, &across, limit.finest, &mut marked);
            }
            relabelled.euler = Some(known);
            relabelled.balls = Some(topology.into_balls());
        }
        if marked.contains(&true) {
            // A few gaps must not refine the whole lattice.
            lattice.close_locally();
            return Ok((marked, relabelled.found));
        }
        self.open_passages(lattice, elements, neighbors, &mut relabelled)?;
        let found = self.carve_pinches(lattice, elements, neighbors, relabelled)?;
        let after = self.fill_unseen(lattice, elements, neighbors, &found)?;
        Ok((marked, after.unwrap_or(found)))
    }

    /// Opens passages that the mesh closes, where a label has other tunnels than the image; what is known of the elements follows.
    fn open_passages(
        &mut self,
        lattice: &RedGreenLattice,
        elements: &mut Elements,
        neighbors: &[[u32; 4]],
        relabelled: &mut RelabelledPinches,
    ) -> Result<()> {
        if relabelled.euler.as_ref().is_some_and(|known| known.all_out_of_reach().is_empty()) {
            return Ok(());
        }
        let context = self.context;
        let topology = self.topology(lattice, &elements.tets, neighbors, relabelled.balls.take())?;
        let mut euler = self.euler_ranges(relabelled.euler.take(), &topology, &elements.labels)?;
        let unchanged = elements.labels.clone();
        let passages = Passages { lattice, topology: &topology, leaves: &elements.leaves };
        let opened = self.report.timed("topology", || passages.open(&mut elements.labels, &mut euler, context))?;
        if opened > 0 {
            relabelled.found = self.recount(&relabelled.found, &unchanged, lattice, elements)?;
            relabelled.left = None;
        }
        self.report.add("topology.opened_passages", opened as f64);
        relabelled.euler = Some(euler);
        relabelled.balls = Some(topology.into_balls());
        Ok(())
    }

    /// Relabels pinched elements; returns the leaves to refine where components of labels are joined or broken, and the mismatches. When
    /// nothing is to be refined any more, what still pinches is carved; the neighbours follow.
    fn keep_pieces(
        &mut self,
        lattice: &mut RedGreenLattice,
        elements: &mut Elements,
        neighbors: &mut Vec<[u32; 4]>,
        found: Vec<Mismatch>,
        before: &Deficit,
        limit: RefinementLimit,
    ) -> Result<(Vec<bool>, Vec<Mismatch>)> {
        let relabelled = self.relabel_pinches(lattice, elements, neighbors, found, before)?;
        let mut marked = Vec::new();
        if limit.rounds_left > 0 {
            marked = self.mark_other_pieces(lattice, elements, neighbors, &relabelled.found, limit.finest)?;
        }
        if marked.contains(&true) {
            // A few places must not refine the whole lattice.
            lattice.close_locally();
            return Ok((marked, relabelled.found));
        }
        let found = self.carve_pinches(lattice, elements, neighbors, relabelled)?;
        Ok((marked, found))
    }

    /// Marks the leaves where the mesh joins components of a label that the image keeps apart, or breaks one.
    fn mark_other_pieces(
        &mut self,
        lattice: &RedGreenLattice,
        elements: &Elements,
        neighbors: &[[u32; 4]],
        found: &[Mismatch],
        finest: u32,
    ) -> Result<Vec<bool>> {
        let context = self.context;
        let regions =
            self.report.timed("topology", || regions_with_background(&elements.labels, neighbors, context))?;
        // What hangs together past the border only is in pieces once it is cut.
        let inside = self.inside(lattice);
        let inside = inside.as_deref();
        let of_cut = |inside: &[bool]| regions_inside(&elements.tets, &elements.labels, neighbors, inside, context);
        let cut = self.report.timed("topology", || inside.map(of_cut).transpose())?;
        let pieces = cut.as_ref().unwrap_or(&regions);
        let surplus = self.surplus(pieces)?;
        let components = &self.components;
        let concerned = self.report.timed("topology", || -> Result<Vec<u32>> {
            let joints = elements_at_joints(lattice, elements, neighbors, &regions, inside, components, context)?;
            let regions = joinable_regions(elements, pieces, surplus);
            Ok([joints, elements_at_gaps(lattice, elements, neighbors, found, &regions, context)?].concat())
        })?;
        let mut marked = vec![false; lattice.tets.len()];
        self.mark_refinable(lattice, elements, &concerned, finest, &mut marked);
        Ok(marked)
    }

    /// Marks the leaves of some elements that may be refined: coarser than the finest, with children of the least size of their label.
    fn mark_refinable(
        &self,
        lattice: &RedGreenLattice,
        elements: &Elements,
        concerned: &[u32],
        finest: u32,
        marked: &mut [bool],
    ) {
        for &e in concerned {
            let leaf = elements.leaves[e as usize];
            let least = self.input.targets.min_size[elements.labels[e as usize].index()];
            let may_shrink = u32::from(lattice.levels[leaf as usize]) < finest && lattice.leaf_edge(leaf) > 2.0 * least;
            marked[leaf as usize] |= may_shrink;
        }
    }

    /// Fills regions without a voxel; returns the mismatches then, where there were such regions.
    fn fill_unseen(
        &mut self,
        lattice: &RedGreenLattice,
        elements: &mut Elements,
        neighbors: &[[u32; 4]],
        found: &[Mismatch],
    ) -> Result<Option<Vec<Mismatch>>> {
        let unchanged = elements.labels.clone();
        let changed = fill_unseen_regions(lattice, elements, neighbors, self.context)?;
        if changed == 0 { Ok(None) } else { self.recount(found, &unchanged, lattice, elements).map(Some) }
    }

    /// Regions of each label more than the image has, found there once.
    fn surplus(&mut self, regions: &[(Label, Vec<u32>)]) -> Result<Vec<i64>> {
        let in_image = match self.face_components.take() {
            Some(known) => known,
            None => component_counts(self.input.image, Connectivity::Face, self.context)?,
        };
        let surplus = surplus_of(regions, &in_image);
        self.face_components = Some(in_image);
        Ok(surplus)
    }

    /// Carves what still pinches after a relabelling; returns the mismatches afterwards, the neighbours follow.
    fn carve_pinches(
        &mut self,
        lattice: &mut RedGreenLattice,
        elements: &mut Elements,
        neighbors: &mut Vec<[u32; 4]>,
        relabelled: RelabelledPinches,
    ) -> Result<Vec<Mismatch>> {
        let RelabelledPinches { mut found, mut euler, left, mut balls } = relabelled;
        // In the first round all vertices, but those known not to pinch.
        let mut to_see: Option<Vec<bool>> = None;
        let mut may_pinch = left.map(|left| {
            let mut marks = vec![false; lattice.vertices.positions.len()];
            left.into_iter().for_each(|v| marks[v as usize] = true);
            marks
        });
        for round in 1..=CARVING_ROUNDS {
            let context = self.context;
            let topology = self.topology(lattice, &elements.tets, neighbors, balls.take())?;
            let breaches = to_see.as_deref();
            let candidates = [breaches, may_pinch.as_deref().or(breaches)];
            let pinches = Pinches::among(lattice, &elements.labels, &topology, candidates, context)?;
            may_pinch = None;
            if pinches.vertices.is_empty() {
                break;
            }
            let joinable = {
                let regions = regions_of(&elements.labels, neighbors, context)?;
                let surplus = self.surplus(&regions)?;
                let mut joinable = joinable_regions(elements, &regions, surplus);
                number_by_image(&mut joinable, &regions, lattice, elements, &self.components, context)?;
                joinable
            };
            let extent = if round < CARVING_ROUNDS { Extent::NearLabel } else { Extent::Whole };
            let are_checked = self.input.region_threshold.is_some();
            let known = self.euler_ranges(euler.take(), &topology, &elements.labels)?;
            let kept = KeptComponents::new(&self.components, &found);
            let rules =
                FillingRules { regions: &joinable, euler: Some(euler.insert(known)), are_checked, extent, kept };
            let fillings = choose_fillings(lattice, &elements.labels, &topology, &pinches, rules, context)?;
            let filled = fillings.vertices();
            self.report.add("topology.carved_vertices", filled.len() as f64);
            if filled.is_empty() {
                break;
            }
            let around = topology.elements_around(&filled);
            let mut known = topology.into_balls();
            let changed = carve(lattice, elements, &fillings, around, context)?;
            to_see = Some(pinches.to_see_after(lattice, elements, &changed));
            drop((pinches, joinable));
            self.report.timed("adjacency", || rematch(neighbors, &elements.tets, &changed, context))?;
            known.update(&elements.tets, neighbors, &changed, lattice.vertices.positions.len());
            balls = Some(known);
            let components = &self.components;
            let count = || counted_anew(&found, changed, lattice, elements, components, context);
            found = self.report.timed("fidelity", count)?;
        }
        Ok(found)
    }

    fn finish(&mut self, deficit: &Deficit, relabelled: Relabelled) {
        let report = &mut self.report;
        report.set("relabelling.changes", relabelled.changes as f64);
        report.set("relabelling.remaining", relabelled.remaining as f64);
        for (label, count) in deficit.counts.iter().enumerate().skip(1) {
            let value = self.input.values[label];
            if count.image == 0 {
                continue;
            }
            let common = (count.image - count.missed) as f64;
            report.set(format!("label.{value}.f1"), common / (common + count.wrong as f64).max(1.0));
            report.set(format!("label.{value}.f2"), common / count.image as f64);
            if deficit.lacking[label] {
                let reached = count.fidelity();
                let text = format!("label {value} reaches a fidelity of {reached:.4} only");
                let finding = Finding::new(FindingCode::FidelityNotReached, Severity::Warning, text);
                self.context.report(finding.with_ids(i64::from(value), -1));
            }
        }
        self.lost = deficit.lost.iter().map(|lost| self.components.components()[*lost as usize]).collect();
    }
}
