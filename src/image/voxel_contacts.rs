//! Voxels of a label that touch only at a corner or along an edge, and how such contacts are removed.
//!
//! # Method
//! ```text
//!     corner contact: p and q opposite in a cube of 8       edge contact: p and q opposite in a square of 4
//!     six templates: the three axes in any order            two templates: either of the other two voxels
//!         p -> a -> b -> q, a and b take the label               p -> a -> q, a takes the label
//! ```
//! 1. Contacts are also found from the other side: six voxels of a label in a cube of 8 whose other two, p and q, are opposite.
//! 2. Candidates for a contact: each template; both voxels of an edge contact; p or q itself takes a label between them.
//! 3. A candidate costs how far it takes the Euler number of a label out of the range between the numbers of the label's
//!    26- and 6-connected voxels in the image. Then counts which labels it brings face to face that do not touch near there: it opens
//!    the wall between them. Then counts what it changes of the 26-connected number at all: joining p and q keeps it, opening a
//!    tunnel elsewhere, or swallowing the last voxel of another label, does not. Where two labels cross in one square, one is
//!    joined and the other parted, and it is the range that tells which. Then count the contacts around afterwards, and the
//!    voxels changed.
//! 4. One of the cheapest is drawn at random and made; the cubes around the changed voxels are looked at again.
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
//! raise priorities are candidates, of which there is always one, and at most `voxels * labels` can follow. The random
//! choice depends on the seed only.

use std::collections::VecDeque;

use glam::IVec3;
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::euler_numbers::{corner_contributions, euler_numbers, label_at_corner};
use crate::image::label_contacts::touch_near;
use crate::image::label_image::LabelImage;
use crate::index::Label;

/// Changes per contact that may lower a priority: most contacts need one change; chains of them two or three.
const BUDGET: u64 = 8;

/// Labels touch near a voxel where they lie face to face within this many voxels along each axis.
const REACH: i32 = 2;

/// Cubes between two looks at whether the run is cancelled: each tries all candidates for a contact of it.
const CUBES_PER_CHECK: usize = 64;

/// A voxel and the label it takes.
type Change = ([usize; 3], Label);

/// Two corners of a cube between which the surface of a label pinches: both are of the label, or neither is.
#[derive(Debug, Clone, Copy)]
struct Contact {
    p: usize,
    q: usize,
    label: Label,
}

/// What a candidate costs, in the order in which it counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Cost {
    /// How far the Euler numbers are out of their ranges afterwards, in eighths.
    out_of_range: i64,
    /// Pairs of labels that lie face to face afterwards and did not near there before: walls that open.
    opened: usize,
    /// Change of the Euler numbers of the 26-connected labels, absolute, in eighths.
    euler: i64,
    /// The part of it that the 6-connected labels do not show either.
    unexplained: i64,
    /// Contacts in the cubes around, afterwards.
    contacts: usize,
    /// Voxels changed.
    voxels: usize,
}

/// What the removal of contacts did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RemovedContacts {
    /// Voxels that took another label.
    pub voxels: u64,
    /// Pairs of labels that came face to face where they were apart: walls that were opened, to keep Euler numbers.
    pub opened: u64,
}

/// Removes corner-only and edge-only contacts of labels.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`]; some contacts are left then.
pub fn remove_contacts(image: &mut LabelImage, seed: u64, context: &RunContext) -> Result<RemovedContacts> {
    let mut work = Contacts::new(image, seed, context)?;
    work.budget = BUDGET * work.positions_with_contacts(context)?.len() as u64;
    work.remove_all(context)?;
    Ok(work.removed)
}

struct Contacts<'a> {
    image: &'a mut LabelImage,
    /// Background lowest.
    priority: Vec<u32>,
    /// How many more changes may lower a priority.
    budget: u64,
    random: u64,
    removed: RemovedContacts,
    /// Contribution of a corner to the Euler number, in eighths, by which of its eight voxels are set: 26- and 6-connected.
    euler: [[i64; 256]; 2],
    /// By label, in eighths: how far the Euler number of the 26-connected label may change, and how far it has changed.
    allowed: Vec<[i64; 2]>,
    changed_by: Vec<i64>,
}

impl<'a> Contacts<'a> {
    fn new(image: &'a mut LabelImage, seed: u64, context: &RunContext) -> Result<Self> {
        let counts = image.voxel_counts();
        let mut order: Vec<usize> = (1..counts.len()).collect();
        order.sort_by_key(|l| (std::cmp::Reverse(counts[*l]), *l));
        let mut priority = vec![0; counts.len()];
        order.into_iter().enumerate().for_each(|(rank, label)| priority[label] = rank as u32 + 1);
        let random = seed ^ 0x9e37_79b9_7f4a_7c15;
        let changed_by = vec![0; counts.len()];
        let mut work = Self {
            image,
            priority,
            budget: 0,
            random,
            removed: RemovedContacts { voxels: 0, opened: 0 },
            euler: corner_contributions(),
            allowed: Vec::new(),
            changed_by,
        };
        let range = |[closed, open]: [i64; 2]| [(open - closed).min(0), (open - closed).max(0)];
        let numbers = euler_numbers(work.image, context)?;
        work.allowed = numbers.into_iter().map(|numbers| range(numbers.map(|n| 8 * n))).collect();
        Ok(work)
    }

    fn remove_all(&mut self, context: &RunContext) -> Result<()> {
        let mut queue: VecDeque<[usize; 3]> = self.positions_with_contacts(context)?.into();
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

    fn positions_with_contacts(&self, context: &RunContext) -> Result<Vec<[usize; 3]>> {
        let [ni, nj, nk] = self.image.grid().size();
        let of_row = |row| (0..ni).map(move |i| [i, row % nj, row / nj]).filter(|at| self.find_contact(*at).is_some());
        let positions = context.until_cancelled(0..nj * nk).flat_map_iter(of_row).collect();
        context.check()?;
        Ok(positions)
    }

    /// Voxel `corner` (bits x, y, z) of the cube at `at`, where it is inside the image.
    fn corner(&self, at: [usize; 3], corner: usize) -> Option<[usize; 3]> {
        let voxel = [at[0] + (corner & 1), at[1] + (corner >> 1 & 1), at[2] + (corner >> 2 & 1)];
        let size = self.image.grid().size();
        (0..3).all(|axis| voxel[axis] < size[axis]).then_some(voxel)
    }

    fn label(&self, at: [usize; 3], corner: usize) -> Option<Label> {
        self.corner(at, corner).map(|[i, j, k]| self.image.at(i, j, k))
    }

    /// Two corners p and q of the cube at `at` and a label whose surface pinches between them: a corner-only contact, in a
    /// cube of 8, of the label or of what is not of it, or an edge-only contact in a square through corner 0.
    fn find_contact(&self, at: [usize; 3]) -> Option<Contact> {
        if self.corner(at, 7).is_some() {
            let labels: [Label; 8] = std::array::from_fn(|c| label_at_corner(self.image, &at.map(|x| x + 1), c));
            for (p, q) in [(0, 7), (1, 6), (2, 5), (3, 4)] {
                let others = || (0..8).filter(|c| *c != p && *c != q).map(|c| labels[c]);
                let (ends, side) = (labels[p], labels[p ^ 1]);
                let joins = labels[q] == ends && !ends.is_background() && others().all(|l| l != ends);
                let parts = !side.is_background() && others().all(|l| l == side) && ends != side && labels[q] != side;
                if joins || parts {
                    return Some(Contact { p, q, label: if joins { ends } else { side } });
                }
            }
        }
        for (a, b) in [(1, 2), (1, 4), (2, 4)] {
            for [p, q, c, d] in [[0, a + b, a, b], [a, b, 0, a + b]] {
                let (Some(own), Some(other)) = (self.label(at, p), self.label(at, q)) else { continue };
                if own == other
                    && !own.is_background()
                    && self.label(at, c).is_some_and(|l| l != own)
                    && self.label(at, d).is_some_and(|l| l != own)
                {
                    return Some(Contact { p, q, label: own });
                }
            }
        }
        None
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
        let Some(contact) = self.find_contact(at) else { return Vec::new() };
        let mut cheapest: Option<Cost> = None;
        let mut best: Vec<Vec<Change>> = Vec::new();
        for candidate in self.candidates(at, &contact) {
            if self.budget == 0 && !self.is_rising(&candidate) {
                continue;
            }
            let cost = self.cost(&candidate);
            if cheapest.is_none_or(|c| cost < c) {
                cheapest = Some(cost);
                best.clear();
            }
            if cheapest == Some(cost) {
                best.push(candidate);
            }
        }
        let choice = self.next_random(best.len());
        let chosen = best.swap_remove(choice);
        if !self.is_rising(&chosen) {
            self.budget -= 1;
        }
        self.removed.voxels += chosen.len() as u64;
        self.removed.opened += cheapest.map_or(0, |cost| cost.opened as u64);
        for (label, [closed, _]) in self.euler_changes(&chosen) {
            self.changed_by[label.index()] += closed;
        }
        self.apply(&chosen);
        // The cube may hold another contact.
        chosen.into_iter().map(|(voxel, _)| voxel).chain([at]).collect()
    }

    /// What can remove a contact. Some candidate raises every voxel that it changes: a template, or, where one of its voxels
    /// ranks higher than the label, an end that joins that voxel's label. Seen from the other side: an end that joins the
    /// label around, or, where the end ranks higher, a template of the end's label.
    fn candidates(&self, at: [usize; 3], contact: &Contact) -> Vec<Vec<Change>> {
        let Contact { p, q, label } = *contact;
        let voxel = |corner: usize| self.corner(at, corner).expect("a contact's cube or square lies inside the image");
        let own = |corner: usize| self.label(at, corner).expect("a contact's cube or square lies inside the image");
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
            let mut other: Vec<Label> = between.map(own).filter(|l| *l != label).collect();
            other.sort_unstable();
            other.dedup();
            candidates.extend(other.into_iter().flat_map(|to| [vec![(p, to)], vec![(q, to)]]));
        } else {
            candidates.extend([vec![(p, label)], vec![(q, label)]]);
            candidates.extend(templates(own(p)));
            candidates.extend(templates(own(q)));
        }
        candidates.into_iter().map(|c| c.into_iter().map(|(corner, to)| (voxel(corner), to)).collect()).collect()
    }

    fn priority_of(&self, label: Label) -> u32 {
        self.priority[label.index()]
    }

    fn is_rising(&self, changes: &[Change]) -> bool {
        changes.iter().all(|([i, j, k], to)| self.priority_of(self.image.at(*i, *j, *k)) < self.priority_of(*to))
    }

    /// Makes changes; returns those that undo them.
    fn apply(&mut self, changes: &[Change]) -> Vec<Change> {
        let mut back = Vec::with_capacity(changes.len());
        for (voxel, to) in changes {
            let offset = self.image.grid().offset(voxel[0], voxel[1], voxel[2]);
            back.push((*voxel, self.image.voxels()[offset]));
            self.image.voxels_mut()[offset] = *to;
        }
        back
    }

    fn cost(&mut self, changes: &[Change]) -> Cost {
        let mut cost = Cost {
            out_of_range: 0,
            opened: self.opened_by(changes),
            euler: 0,
            unexplained: 0,
            contacts: 0,
            voxels: changes.len(),
        };
        for (label, [closed, open]) in self.euler_changes(changes) {
            let [low, high] = self.allowed[label.index()];
            let now = self.changed_by[label.index()] + closed;
            cost.out_of_range += (low - now).max(now - high).max(0);
            cost.euler += closed.abs();
            cost.unexplained += closed.abs().min(open.abs());
        }
        let back = self.apply(changes);
        let has_contact = |w: &&[usize; 3]| w.iter().all(|x| *x > 0) && self.find_contact(w.map(|x| x - 1)).is_some();
        cost.contacts = corners_of(changes).iter().filter(has_contact).count();
        self.apply(&back);
        cost
    }

    /// How many pairs of labels would lie face to face at changed voxels that do not near these.
    fn opened_by(&self, changes: &[Change]) -> usize {
        let size = self.image.grid().size().map(|n| n as i32);
        let mut pairs: Vec<(IVec3, [Label; 2])> = Vec::new();
        for (voxel, to) in changes {
            let at = IVec3::from_array(voxel.map(|x| x as i32));
            for step in [IVec3::X, IVec3::Y, IVec3::Z].into_iter().flat_map(|step| [step, -step]) {
                let near = (at + step).to_array();
                let is_inside = (0..3).all(|axis| (0..size[axis]).contains(&near[axis]));
                let near = near.map(|x| x as usize);
                if !is_inside || changes.iter().any(|(voxel, _)| *voxel == near) {
                    continue;
                }
                let other = self.image.at(near[0], near[1], near[2]);
                if other != *to {
                    pairs.push((at, [*to, other]));
                }
            }
        }
        pairs.sort_unstable_by_key(|(at, pair)| (*pair, at.to_array()));
        pairs.dedup_by_key(|(_, pair)| *pair);
        pairs.iter().filter(|(at, pair)| !touch_near(self.image, *at, *pair, REACH)).count()
    }

    /// What changes would do to the Euler numbers of the labels concerned, 26- and 6-connected, in eighths.
    fn euler_changes(&mut self, changes: &[Change]) -> Vec<(Label, [i64; 2])> {
        let mut labels: Vec<Label> =
            changes.iter().flat_map(|([i, j, k], to)| [self.image.at(*i, *j, *k), *to]).collect();
        labels.sort_unstable();
        labels.dedup();
        labels.retain(|l| !l.is_background());
        let corners = corners_of(changes);
        let numbers = |work: &Self| -> Vec<[i64; 2]> { labels.iter().map(|l| work.euler_at(&corners, *l)).collect() };
        let before = numbers(self);
        let back = self.apply(changes);
        let after = numbers(self);
        self.apply(&back);
        let difference = |(old, new): ([i64; 2], [i64; 2])| [new[0] - old[0], new[1] - old[1]];
        labels.into_iter().zip(before.into_iter().zip(after).map(difference)).collect()
    }

    /// Contributions of some corners to the Euler numbers of a label, 26- and 6-connected, in eighths.
    fn euler_at(&self, corners: &[[usize; 3]], label: Label) -> [i64; 2] {
        let mut sums = [0; 2];
        for corner in corners {
            let is_set = |side: &usize| label_at_corner(self.image, corner, *side) == label;
            let bits = (0..8).filter(is_set).fold(0, |bits, side| bits | 1usize << side);
            sums[0] += self.euler[0][bits];
            sums[1] += self.euler[1][bits];
        }
        sums
    }
}

/// The corners of changed voxels; corner w lies between the voxels w - 1 and w.
fn corners_of(changes: &[Change]) -> Vec<[usize; 3]> {
    let step = |v: &[usize; 3], s: usize| [v[0] + (s & 1), v[1] + (s >> 1 & 1), v[2] + (s >> 2)];
    let mut corners: Vec<[usize; 3]> = changes.iter().flat_map(|(v, _)| (0..8).map(move |s| step(v, s))).collect();
    corners.sort_unstable();
    corners.dedup();
    corners
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
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
            let left = Contacts::new(&mut labels, 1, &context).unwrap().positions_with_contacts(&context).unwrap();
            assert!(left.is_empty());
            remove_contacts(&mut again, 1, &context).unwrap();
            assert_eq!(labels, again);
        }
    }

    #[test]
    fn without_a_budget_it_ends_all_the_same() {
        let mut labels = image(noise(9).into_iter().map(|x| (4.0 * x) as u16).collect());
        let context = context();
        let mut work = Contacts::new(&mut labels, 1, &context).unwrap();
        work.remove_all(&context).unwrap();
        assert!(work.positions_with_contacts(&context).unwrap().is_empty());
    }

    #[test]
    fn contacts_of_a_cancelled_run_stay() {
        let mut labels = blobs(1);
        let before = labels.clone();
        let context = context();
        let mut work = Contacts::new(&mut labels, 1, &context).unwrap();
        context.cancel_token().cancel();
        assert!(matches!(work.positions_with_contacts(&context), Err(crate::Error::Cancelled)));
        assert!(matches!(work.remove_all(&context), Err(crate::Error::Cancelled)));
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
    fn labels_keep_the_topology_of_their_26_connected_voxels() {
        let (mut contacts, mut off) = (0, Vec::new());
        for seed in 0..6u64 {
            let before = blobs(seed);
            let mut after = before.clone();
            contacts += remove_contacts(&mut after, 1, &context()).unwrap().voxels;
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
}
