//! Removal of the contacts of labels at corners and along edges of voxels.
//!
//! # Method
//! ```text
//!     corner contact: p and q opposite in a cube of 8       edge contact: p and q opposite in a square of 4
//!     six templates: the three axes in any order            two templates: either of the other two voxels
//!         p -> a -> b -> q, a and b take the label               p -> a -> q, a takes the label
//! ```
//! 1. Candidates for a contact: each template; both voxels of an edge contact; p or q itself takes a label between them.
//! 2. Each has a cost, see `contact_costs`. Where the cheapest takes an Euler number out of its range, each candidate is tried
//!    with one more voxel around too, which takes the label of one beside it.
//! 3. One of the cheapest is drawn at random and made; the cubes around the changed voxels are looked at again.
//! 4. Where a label's Euler number is out of its range in the end, one or two voxels beside the changed ones are changed that bring
//!    it back and make no contact.
//!
//! # Source
//! [Drakopoulos2017] 2.3.2.
//!
//! # Differences
//! The thesis draws from all templates; a label that shares voxels with others then gets handles and loses pieces.
//!
//! # Invariants
//! It ends: labels have priorities (background lowest, then the larger labels before the smaller). A change that lowers the
//! priority of a voxel is paid from a budget, `BUDGET` per contact of the image; when that is spent, only changes that
//! raise priorities are candidates, of which there is always one, and at most `voxels * labels` can follow. Step 4 looks at
//! each changed voxel once, `MOST_LOOKS` at most. The random choice depends on the seed only.

use std::collections::VecDeque;

use glam::IVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::connected_components::{Connectivity, component_counts};
use crate::image::contact_costs::{Change, ContactCosts, Cost, OutOfRange, place};
use crate::image::grid::places_around;
use crate::image::label_image::LabelImage;
use crate::image::voxel_contacts::{Contact, cubes_with_contacts, find_contact, label_of, voxel_of};
use crate::index::{Label, each_once};

/// Changes per contact that may lower a priority: most contacts need one change; chains of them two or three.
const BUDGET: u64 = 8;

/// Changed voxels at most around which others are tried where a label's Euler number is out of its range: each takes 4 ms. One of 192
/// labels of an atlas is out of its range, and in again after 14; one of two of salt and pepper after 21.
const MOST_LOOKS: usize = 2048;

/// Cubes between two looks at whether the run is cancelled: each tries all candidates for a contact of it.
const CUBES_PER_CHECK: usize = 64;

/// What the removal of contacts did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RemovedContacts {
    /// Voxels that took another label, each as often as it did.
    pub voxels: u64,
    /// Pairs of labels that came face to face where they were apart: walls that were opened, to keep Euler numbers.
    pub opened: u64,
    /// The labels whose Euler numbers could not be kept between the two readings of the image.
    pub euler: Vec<OutOfRange>,
    /// The labels whose numbers of pieces could not.
    pub pieces: Vec<OutOfRange>,
}

/// Removes corner-only and edge-only contacts of labels.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`]; some contacts are left then.
pub fn remove_contacts(image: &mut LabelImage, seed: u64, context: &RunContext) -> Result<RemovedContacts> {
    let cubes = cubes_with_contacts(image, context)?;
    let most = component_counts(image, Connectivity::Face, context)?;
    let mut work = Contacts::new(image, seed, context)?;
    work.budget = BUDGET * cubes.len() as u64;
    work.remove_all(cubes, context)?;
    let fewest = work.costs.piece_counts();
    let ranges = || fewest.iter().zip(&most).map(|(fewest, most)| [*fewest, *most]);
    let pieces = |work: &Contacts| -> Result<Vec<OutOfRange>> {
        let now = component_counts(work.costs.image, Connectivity::Face, context)?;
        Ok(OutOfRange::among(now.into_iter().zip(ranges())))
    };
    let undo = work.settle(context)?;
    let mut off = pieces(&work)?;
    if !undo.is_empty() && !off.is_empty() {
        // What was parted for the sake of an Euler number was one in the image: a piece too many is worse.
        undo.iter().rev().for_each(|changes| work.costs.make(changes));
        work.voxels -= undo.iter().map(|changes| changes.len() as u64).sum::<u64>();
        off = pieces(&work)?;
    }
    let Contacts { costs, voxels, opened, .. } = work;
    Ok(RemovedContacts { voxels, opened, euler: OutOfRange::among(costs.euler_numbers()), pieces: off })
}

struct Contacts<'a> {
    costs: ContactCosts<'a>,
    /// Background lowest.
    priority: Vec<u32>,
    /// How many more changes may lower a priority.
    budget: u64,
    random: u64,
    voxels: u64,
    opened: u64,
}

impl<'a> Contacts<'a> {
    fn new(image: &'a mut LabelImage, seed: u64, context: &RunContext) -> Result<Self> {
        let counts = image.voxel_counts();
        let mut order: Vec<usize> = (1..counts.len()).collect();
        order.sort_by_key(|l| (std::cmp::Reverse(counts[*l]), *l));
        let mut priority = vec![0; counts.len()];
        order.into_iter().enumerate().for_each(|(rank, label)| priority[label] = rank as u32 + 1);
        let random = seed ^ 0x9e37_79b9_7f4a_7c15;
        let costs = ContactCosts::new(image, context)?;
        Ok(Self { costs, priority, budget: 0, random, voxels: 0, opened: 0 })
    }

    fn remove_all(&mut self, cubes: Vec<[usize; 3]>, context: &RunContext) -> Result<()> {
        let mut queue: VecDeque<[usize; 3]> = cubes.into();
        let mut seen = 0;
        while let Some(position) = queue.pop_front() {
            context.check_every(CUBES_PER_CHECK, seen)?;
            seen += 1;
            for changed in self.repair(position) {
                // Contacts can appear only in cubes that hold the changed voxel.
                let from = changed.map(|c| c.saturating_sub(1));
                for step in 0..8 {
                    let near = [from[0] + (step & 1), from[1] + (step >> 1 & 1), from[2] + (step >> 2)];
                    if (0..3).all(|axis| near[axis] <= changed[axis]) {
                        queue.push_back(near);
                    }
                }
            }
        }
        Ok(())
    }

    /// Brings Euler numbers that are out of their ranges nearer to these, where another voxel or two beside the changed ones do:
    /// a contact that was joined can be parted, to make up for one elsewhere that could only be parted or joined. Returns what undoes
    /// each step, in the order of the steps.
    fn settle(&mut self, context: &RunContext) -> Result<Vec<Vec<Change>>> {
        let (mut looks, mut undo) = (0, Vec::new());
        for OutOfRange { label, .. } in OutOfRange::among(self.costs.euler_numbers()) {
            for voxel in self.costs.changed_near(label) {
                context.check()?;
                if self.costs.out_of_range(&[label]) == 0 || looks == MOST_LOOKS {
                    break;
                }
                looks += 1;
                let around = changes_at(self.costs.image, places_around(place(voxel)));
                let one: Vec<Vec<Change>> = around.into_iter().map(|change| vec![change]).collect();
                let better = self.cheapest_gain(&one).or_else(|| {
                    let two: Vec<Vec<Change>> = one.iter().flat_map(|change| self.widened(change)).collect();
                    self.cheapest_gain(&two)
                });
                if let Some(changes) = better {
                    self.voxels += changes.len() as u64;
                    let image = &*self.costs.image;
                    undo.push(changes.iter().map(|(at, _)| (*at, image.at(at[0], at[1], at[2]))).collect());
                    self.costs.make(&changes);
                }
            }
        }
        Ok(undo)
    }

    /// The cheapest of the candidates that bring Euler numbers nearer to their ranges and make no contact, and take, join and open
    /// nothing.
    fn cheapest_gain(&mut self, candidates: &[Vec<Change>]) -> Option<Vec<Change>> {
        let mut best: Option<(Cost, &Vec<Change>)> = None;
        for candidate in candidates {
            let before = self.costs.out_of_range(&self.costs.labels_concerned(candidate));
            if before == 0 {
                continue;
            }
            let cost = self.costs.cost(candidate);
            let fits =
                cost.out_of_range < before && (cost.contacts, cost.lost, cost.opened, cost.circling) == (0, 0, 0, 0);
            if fits && best.is_none_or(|(least, _)| cost < least) {
                best = Some((cost, candidate));
            }
        }
        best.map(|(_, candidate)| candidate.clone())
    }

    fn next_random(&mut self, below: usize) -> usize {
        // xorshift64*: small, and the same everywhere.
        self.random ^= self.random >> 12;
        self.random ^= self.random << 25;
        self.random ^= self.random >> 27;
        ((self.random.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize) % below
    }

    /// Removes one contact of the cube at `at`; returns the changed voxels.
    fn repair(&mut self, at: [usize; 3]) -> Vec<[usize; 3]> {
        let Some(contact) = find_contact(self.costs.image, at) else { return Vec::new() };
        let candidates = self.candidates(at, &contact);
        let (mut cost, mut best) = self.cheapest(&candidates).expect("a candidate that raises priorities");
        if cost.out_of_range > 0 || cost.lost + cost.opened > 0 {
            let widened: Vec<Vec<Change>> = candidates.iter().flat_map(|c| self.widened(c)).collect();
            if let Some(better) = self.cheapest(&widened).filter(|(wider, _)| *wider < cost) {
                (cost, best) = better;
            }
        }
        let choice = self.next_random(best.len());
        let chosen = best.swap_remove(choice);
        if !self.is_rising(&chosen) {
            self.budget -= 1;
        }
        self.voxels += chosen.len() as u64;
        self.opened += cost.opened as u64;
        self.costs.make(&chosen);
        // The cube may hold another contact.
        chosen.into_iter().map(|(voxel, _)| voxel).chain([at]).collect()
    }

    /// The cheapest of some candidates, of those that raise priorities once the budget is spent, with what they cost.
    fn cheapest(&mut self, candidates: &[Vec<Change>]) -> Option<(Cost, Vec<Vec<Change>>)> {
        let mut cheapest: Option<(Cost, Vec<Vec<Change>>)> = None;
        for candidate in candidates {
            if self.budget == 0 && !self.is_rising(candidate) {
                continue;
            }
            let cost = self.costs.cost(candidate);
            match &mut cheapest {
                Some((least, best)) if *least == cost => best.push(candidate.clone()),
                Some((least, _)) if *least < cost => {}
                _ => cheapest = Some((cost, vec![candidate.clone()])),
            }
        }
        cheapest
    }

    /// A candidate with one more voxel around, which takes the label of one beside it: all there are.
    fn widened(&mut self, candidate: &[Change]) -> Vec<Vec<Change>> {
        let back = self.costs.apply(candidate);
        let around = candidate.iter().flat_map(|(voxel, _)| places_around(place(*voxel)));
        let more = changes_at(self.costs.image, around);
        self.costs.apply(&back);
        let is_free = |(at, _): &&Change| candidate.iter().all(|(voxel, _)| voxel != at);
        more.iter().filter(is_free).map(|change| [candidate, &[*change]].concat()).collect()
    }

    /// What can remove a contact. Some candidate raises every voxel that it changes: a template, or, where one of its voxels
    /// ranks higher than the label, an end that joins that voxel's label. Seen from the other side: an end that joins the
    /// label around, or, where the end ranks higher, a template of the end's label.
    fn candidates(&self, at: [usize; 3], contact: &Contact) -> Vec<Vec<Change>> {
        let Contact { p, q, label } = *contact;
        let voxel = |corner: usize| {
            voxel_of(self.costs.image, at, corner).expect("a contact's cube or square lies inside the image")
        };
        let own = |corner: usize| {
            label_of(self.costs.image, at, corner).expect("a contact's cube or square lies inside the image")
        };
        let axes: Vec<usize> = [1, 2, 4].into_iter().filter(|axis| (p ^ q) & axis != 0).collect();
        let orders: &[&[usize]] = match axes.len() {
            2 => &[&[0], &[1]],
            _ => &[&[0, 1], &[1, 0], &[0, 2], &[2, 0], &[1, 2], &[2, 1]],
        };
        let path = |order: &[usize], to: Label| -> Vec<(usize, Label)> {
            let mut corner = p;
            order.iter().map(|step| (corner ^= axes[*step], (corner, to)).1).collect()
        };
        let templates = |to: Label| orders.iter().map(|order| path(order, to)).collect::<Vec<_>>();
        let mut candidates: Vec<Vec<(usize, Label)>> = Vec::new();
        if own(p) == label {
            candidates.extend(templates(label));
            if axes.len() == 2 {
                candidates.push(candidates.concat());
            }
            let between = (0..8).filter(|c| *c != p && *c != q && (c ^ p) & !(p ^ q) == 0);
            let other = each_once(between.map(own).filter(|l| *l != label));
            candidates.extend(other.into_iter().flat_map(|to| [vec![(p, to)], vec![(q, to)]]));
        } else {
            candidates.extend([vec![(p, label)], vec![(q, label)]]);
            candidates.extend(templates(own(p)));
            candidates.extend(templates(own(q)));
        }
        candidates.into_iter().map(|c| c.into_iter().map(|(corner, to)| (voxel(corner), to)).collect()).collect()
    }

    fn is_rising(&self, changes: &[Change]) -> bool {
        let priority_of = |label: Label| self.priority[label.index()];
        changes.iter().all(|([i, j, k], to)| priority_of(self.costs.image.at(*i, *j, *k)) < priority_of(*to))
    }
}

/// What voxels can become that take the label of one beside them.
fn changes_at(image: &LabelImage, places: impl Iterator<Item = IVec3>) -> Vec<Change> {
    let size = IVec3::from_array(image.grid().size().map(|n| n as i32));
    let voxels = places.filter(|at| at.cmpge(IVec3::ZERO).all() && at.cmplt(size).all());
    let mut changes = Vec::new();
    for voxel in each_once(voxels.map(|at| at.to_array().map(|x| x as usize))) {
        let at = place(voxel);
        let beside = [IVec3::X, IVec3::Y, IVec3::Z].into_iter().flat_map(|step| [at + step, at - step]);
        let others = beside.map(|near| image.at_or_background(near)).filter(|l| *l != image.at_or_background(at));
        changes.extend(each_once(others).into_iter().map(|to| (voxel, to)));
    }
    changes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::euler_numbers::euler_numbers;
    use crate::image::grid::Grid;
    use crate::image::label_contacts::touch_near;
    use glam::{DMat3, DVec3};

    const SIZE: [usize; 3] = [12, 11, 10];

    fn image(voxels: Vec<u16>) -> LabelImage {
        let grid = Grid::new(SIZE, DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, DMat3::IDENTITY).unwrap();
        LabelImage::new(grid, voxels.into_iter().map(Label).collect(), vec![0, 1, 2, 3]).unwrap()
    }

    fn noise(seed: u64) -> Vec<f64> {
        let mut state = seed * 77 + 5;
        let mut next = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 41) as f64 / (1u64 << 23) as f64
        };
        (0..SIZE.iter().product()).map(|_| next()).collect()
    }

    /// Labels by the largest of four smooth random fields.
    fn blobs(seed: u64) -> LabelImage {
        let at = |i: usize| [i % SIZE[0], i / SIZE[0] % SIZE[1], i / SIZE[0] / SIZE[1]];
        let smooth = |field: Vec<f64>| -> Vec<f64> {
            let near = |i: usize, j: usize| (0..3).all(|d| at(i)[d].abs_diff(at(j)[d]) <= 1);
            (0..field.len()).map(|i| (0..field.len()).filter(|j| near(i, *j)).map(|j| field[j] - 0.5).sum()).collect()
        };
        let fields: Vec<Vec<f64>> = (0..4).map(|f| smooth(noise(4 * seed + f))).collect();
        let largest = |i: usize| (0..4).max_by(|a, b| fields[*a][i].total_cmp(&fields[*b][i])).unwrap() as u16;
        image((0..fields[0].len()).map(largest).collect())
    }

    /// Euler numbers of a label, 26- and 6-connected.
    fn euler(image: &LabelImage, label: u16) -> [i64; 2] {
        euler_numbers(image, &context()).unwrap()[usize::from(label)]
    }

    fn context() -> RunContext {
        RunContext::with_threads(1).unwrap()
    }

    #[test]
    fn no_contact_is_left_in_random_labels() {
        for seed in 0..4u64 {
            let mut labels = image(noise(seed).into_iter().map(|x| (4.0 * x) as u16).collect());
            let mut again = labels.clone();
            let context = context();
            assert!(remove_contacts(&mut labels, 1, &context).unwrap().voxels > 0);
            let left = cubes_with_contacts(&labels, &context).unwrap();
            assert!(left.is_empty());
            remove_contacts(&mut again, 1, &context).unwrap();
            assert_eq!(labels, again);
        }
    }

    #[test]
    fn without_a_budget_it_ends_all_the_same() {
        let mut labels = image(noise(9).into_iter().map(|x| (4.0 * x) as u16).collect());
        let context = context();
        let cubes = cubes_with_contacts(&labels, &context).unwrap();
        let mut work = Contacts::new(&mut labels, 1, &context).unwrap();
        work.remove_all(cubes, &context).unwrap();
        assert!(cubes_with_contacts(work.costs.image, &context).unwrap().is_empty());
    }

    #[test]
    fn contacts_of_a_cancelled_run_stay() {
        let mut labels = blobs(1);
        let before = labels.clone();
        let context = context();
        let cubes = cubes_with_contacts(&labels, &context).unwrap();
        let mut work = Contacts::new(&mut labels, 1, &context).unwrap();
        context.cancel_token().cancel();
        assert!(matches!(cubes_with_contacts(work.costs.image, &context), Err(crate::Error::Cancelled)));
        assert!(matches!(work.remove_all(cubes, &context), Err(crate::Error::Cancelled)));
        assert!(matches!(remove_contacts(&mut labels, 1, &context), Err(crate::Error::Cancelled)));
        assert_eq!(labels, before);
    }

    #[test]
    fn walls_stay_closed() {
        // A bent wall of a voxel and a half in several directions; labels 1 and 3 on its sides meet at corners of voxels.
        let normals = [[1.0, 0.8, 0.6], [0.9, 0.2, -0.5], [0.3, -0.7, 0.8], [0.5, 0.5, 0.9], [1.0, -0.6, 0.1]];
        let mut changed = 0;
        for normal in normals.map(|n| DVec3::from(n).normalize()) {
            let label = |i: usize| {
                let at = [i % SIZE[0], i / SIZE[0] % SIZE[1], i / SIZE[0] / SIZE[1]].map(|x| x as f64);
                let p = DVec3::from(at) - DVec3::from(SIZE.map(|n| 0.5 * n as f64));
                let across = p.dot(normal) + (0.5 * p.dot(DVec3::new(0.8, 0.6, 0.7))).sin();
                if across.abs() < 0.9 { 2 } else { 1 + 2 * u16::from(across > 0.0) }
            };
            let mut labels = image((0..SIZE.iter().product()).map(label).collect());
            let touch = |labels: &LabelImage| touch_near(labels, IVec3::splat(6), [Label(1), Label(3)], 6);
            assert!(!touch(&labels));
            let removed = remove_contacts(&mut labels, 1, &context()).unwrap();
            changed += removed.voxels;
            assert_eq!(removed.opened, 0, "{normal}");
            assert!(!touch(&labels), "{normal}");
        }
        assert!(changed > 20, "{changed}");
    }

    #[test]
    fn labels_keep_numbers_between_those_of_their_26_and_6_connected_voxels() {
        let (mut contacts, mut off) = (0, Vec::new());
        for seed in 0..6u64 {
            let before = blobs(seed);
            let mut after = before.clone();
            let removed = remove_contacts(&mut after, 1, &context()).unwrap();
            contacts += removed.voxels;
            assert!(removed.euler.is_empty() && removed.pieces.is_empty(), "{removed:?}");
            let pieces = |image, connectivity| component_counts(image, connectivity, &context()).unwrap();
            let (fewest, most) = (pieces(&before, Connectivity::Vertex), pieces(&before, Connectivity::Face));
            let now = pieces(&after, Connectivity::Face);
            assert!((1..4).all(|l| (fewest[l]..=most[l]).contains(&now[l])), "{fewest:?} {now:?} {most:?}");
            for label in 1..4 {
                let ([closed, open], [now, same]) = (euler(&before, label), euler(&after, label));
                assert_eq!(now, same, "without contacts both readings agree");
                if now < closed.min(open) || now > closed.max(open) {
                    off.push((seed, label, closed, open, now));
                }
            }
        }
        assert!(contacts > 20, "{contacts}");
        assert!(off.is_empty(), "{off:?}");
    }

    #[test]
    fn a_contact_is_parted_after_all_where_the_number_needs_it() {
        // Two plates that touch along an edge, and a voxel far away: an Euler number of two or three.
        let label = |at: [usize; 3]| match at {
            [2..4, 2..4, 3] | [4..6, 4..6, 3] | [9, 9, 8] => 1,
            _ => 0,
        };
        let at = |i: usize| [i % SIZE[0], i / SIZE[0] % SIZE[1], i / SIZE[0] / SIZE[1]];
        let mut labels = image((0..SIZE.iter().product()).map(|i| label(at(i))).collect());
        let context = context();
        let mut work = Contacts::new(&mut labels, 1, &context).unwrap();
        work.costs.make(&[([4, 3, 3], Label(1))]);
        assert!(work.settle(&context).unwrap().is_empty());
        assert_eq!(work.costs.euler_numbers().nth(1), Some((2, [2, 3])), "nothing to be done");
        work.costs.make(&[([9, 9, 8], Label(0))]);
        let off = |work: &Contacts| OutOfRange::among(work.costs.euler_numbers());
        assert_eq!(off(&work).len(), 1);
        let cancelled = RunContext::with_threads(1).unwrap();
        cancelled.cancel_token().cancel();
        assert!(matches!(work.settle(&cancelled), Err(crate::Error::Cancelled)));
        let undo = work.settle(&context).unwrap();
        assert_eq!((off(&work), work.voxels), (Vec::new(), undo.iter().map(|changes| changes.len() as u64).sum()));
        assert!(cubes_with_contacts(work.costs.image, &context).unwrap().is_empty());
        assert_eq!(component_counts(work.costs.image, Connectivity::Face, &context).unwrap()[1], 2);
        undo.iter().rev().for_each(|changes| work.costs.make(changes));
        assert_eq!(off(&work).len(), 1);
        assert_eq!(component_counts(work.costs.image, Connectivity::Face, &context).unwrap()[1], 1);
    }

    #[test]
    fn changes_do_not_go_in_circles() {
        for seed in 0..4u64 {
            let mut labels = image(noise(seed).into_iter().map(|x| (4.0 * x) as u16).collect());
            let cubes = cubes_with_contacts(&labels, &context()).unwrap().len() as u64;
            let changed = remove_contacts(&mut labels, 1, &context()).unwrap().voxels;
            assert!(cubes > 500 && changed < 4 * cubes, "{changed} changes for {cubes} cubes");
        }
    }
}
