//! What it costs to remove a contact of voxels by giving some of them other labels.
//!
//! # Method
//! Costs are compared in the order of the fields of [`Cost`]:
//! 1. A voxel that has been changed `VISITS` times is left alone where it can: changes follow one another in a circle there.
//! 2. How far it takes the Euler number of a label out of the range between the numbers of the label's 26- and 6-connected
//!    voxels in the image, and whether it swallows the last voxel of a piece or joins pieces that are two in either reading.
//! 3. Which labels it brings face to face that do not touch near there: it opens the wall between them.
//! 4. What it changes of the 26-connected number at all: joining p and q keeps it, opening a tunnel elsewhere does not. Where
//!    two labels cross in one square, one is joined and the other parted, and it is the range that tells which.
//! 5. How often its voxels have been changed, the contacts around afterwards, and the voxels changed.
//!
//! # Source
//! Our own; Euler numbers of both readings of a label after [KongRosenfeld1989].

use glam::IVec3;
use rustc_hash::FxHashMap;

use crate::context::RunContext;
use crate::error::Result;
use crate::image::connected_components::{Components, Connectivity, Members, unite};
use crate::image::euler_numbers::{corner_contributions, euler_numbers, label_at_corner};
use crate::image::grid::places_around;
use crate::image::label_contacts::touch_near;
use crate::image::label_image::LabelImage;
use crate::image::voxel_contacts::find_contact;
use crate::index::{Label, each_once};

/// Labels touch near a voxel where they lie face to face within this many voxels along each axis.
const REACH: i32 = 2;

/// Changes of a voxel past which others are preferred to it whatever they cost: where contacts pile up, a few are needed.
const VISITS: u32 = 4;

/// A voxel and the label it takes.
pub type Change = ([usize; 3], Label);

/// What changes cost, in the order in which it counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Cost {
    /// How often the voxels have been changed past `VISITS`.
    pub circling: u32,
    /// How far the Euler numbers of the labels concerned are out of their ranges afterwards, in eighths.
    pub out_of_range: i64,
    /// Pieces that go, as a whole or by being joined with another.
    pub lost: usize,
    /// Pairs of labels that lie face to face afterwards and did not near there before: walls that open.
    pub opened: usize,
    /// Change of the Euler numbers of the 26-connected labels, absolute, in eighths.
    pub euler: i64,
    /// The part of it that the 6-connected labels do not show either.
    pub unexplained: i64,
    /// How often the voxels have been changed.
    pub visits: u32,
    /// Contacts in the cubes around, afterwards.
    pub contacts: usize,
    /// Voxels changed.
    pub voxels: usize,
}

/// A label of which a number, Euler's or of its pieces, has left the range between the two readings of the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OutOfRange {
    /// The label.
    pub label: Label,
    /// The number.
    pub number: i64,
    /// Least and largest number of the image.
    pub range: [i64; 2],
}

impl OutOfRange {
    /// The labels whose numbers are out of range, the background left out.
    pub fn among(numbers: impl IntoIterator<Item = (i64, [i64; 2])>) -> Vec<Self> {
        let of_label = |(label, (number, range)): (usize, (i64, [i64; 2]))| {
            let is_out = number < range[0] || number > range[1];
            is_out.then_some(Self { label: Label(label as u16), number, range })
        };
        numbers.into_iter().enumerate().skip(1).filter_map(of_label).collect()
    }
}

/// The image while its contacts are removed, with what costs are counted from.
pub struct ContactCosts<'a> {
    /// The image.
    pub image: &'a mut LabelImage,
    /// Contribution of a corner to the Euler number, in eighths, by which of its eight voxels are set: 26- and 6-connected.
    euler: [[i64; 256]; 2],
    /// Euler number of each 26-connected label at first.
    first: Vec<i64>,
    /// How far that may change and how far it has changed, in eighths.
    allowed: Vec<[i64; 2]>,
    changed_by: Vec<i64>,
    /// The 26-connected pieces of labels at first; each leads to the first of those that it was joined with.
    pieces: Components,
    parents: Vec<u32>,
    /// Voxels that have been changed, by their places in the grid: how often, and the piece that they are of now.
    changed: FxHashMap<usize, (u32, u32)>,
}

impl<'a> ContactCosts<'a> {
    /// Counts from the image as it is.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn new(image: &'a mut LabelImage, context: &RunContext) -> Result<Self> {
        let range = |[closed, open]: &[i64; 2]| [8 * (open - closed).min(0), 8 * (open - closed).max(0)];
        let numbers = euler_numbers(image, context)?;
        let pieces = Components::new(image, Connectivity::Vertex, Members::Foreground, context)?;
        Ok(Self {
            image,
            euler: corner_contributions(),
            first: numbers.iter().map(|[closed, _]| *closed).collect(),
            allowed: numbers.iter().map(range).collect(),
            changed_by: vec![0; numbers.len()],
            parents: (0..pieces.components().len() as u32).collect(),
            pieces,
            changed: FxHashMap::default(),
        })
    }

    /// Makes changes that stay.
    pub fn make(&mut self, changes: &[Change]) {
        for (label, [closed, _]) in self.euler_changes(changes) {
            self.changed_by[label.index()] += closed;
        }
        self.apply(changes);
        for label in each_once(changes.iter().map(|change| change.1)) {
            let beside = self.pieces_beside(changes, label);
            let own = beside.first().copied().unwrap_or(self.parents.len() as u32);
            if beside.is_empty() {
                self.parents.push(own);
            }
            beside.iter().for_each(|other| _ = unite(&mut self.parents, own, *other));
            for ([i, j, k], _) in changes.iter().filter(|change| change.1 == label) {
                let (times, piece) = self.changed.entry(self.image.grid().offset(*i, *j, *k)).or_default();
                (*times, *piece) = (*times + 1, own);
            }
        }
    }

    /// Makes changes to be undone; returns those that undo them.
    pub fn apply(&mut self, changes: &[Change]) -> Vec<Change> {
        let mut back = Vec::with_capacity(changes.len());
        for (voxel, to) in changes {
            let offset = self.image.grid().offset(voxel[0], voxel[1], voxel[2]);
            back.push((*voxel, self.image.voxels()[offset]));
            self.image.voxels_mut()[offset] = *to;
        }
        back
    }

    /// What changes cost.
    pub fn cost(&mut self, changes: &[Change]) -> Cost {
        let visits = changes.iter().map(|([i, j, k], _)| self.image.grid().offset(*i, *j, *k));
        let visits: Vec<u32> = visits.map(|voxel| self.changed.get(&voxel).map_or(0, |(times, _)| *times)).collect();
        let mut cost = Cost {
            circling: visits.iter().map(|count| count.saturating_sub(VISITS)).sum(),
            out_of_range: 0,
            lost: 0,
            opened: self.opened_by(changes),
            euler: 0,
            unexplained: 0,
            visits: visits.iter().sum(),
            contacts: 0,
            voxels: changes.len(),
        };
        for (label, [closed, open]) in self.euler_changes(changes) {
            cost.out_of_range += beyond(self.allowed[label.index()], self.changed_by[label.index()] + closed);
            cost.euler += closed.abs();
            cost.unexplained += closed.abs().min(open.abs());
        }
        let back = self.apply(changes);
        let has_contact =
            |w: &&[usize; 3]| w.iter().all(|x| *x > 0) && find_contact(self.image, w.map(|x| x - 1)).is_some();
        cost.contacts = corners_of(changes).iter().filter(has_contact).count();
        cost.lost = self.lost_by(&back) + self.joined_by(changes);
        self.apply(&back);
        cost
    }

    /// The Euler number of each label, and the range between both readings of the image.
    pub fn euler_numbers(&self) -> impl Iterator<Item = (i64, [i64; 2])> {
        let changes = self.changed_by.iter().zip(&self.allowed);
        let of_label = |(first, (now, allowed)): (&i64, (&i64, &[i64; 2]))| {
            (first + now / 8, allowed.map(|change| first + change / 8))
        };
        self.first.iter().zip(changes).map(of_label)
    }

    /// The labels that changes give or take, the background left out.
    pub fn labels_concerned(&self, changes: &[Change]) -> Vec<Label> {
        let mut labels = each_once(changes.iter().flat_map(|([i, j, k], to)| [self.image.at(*i, *j, *k), *to]));
        labels.retain(|l| !l.is_background());
        labels
    }

    /// How far the Euler numbers of some labels are out of their ranges, in eighths.
    pub fn out_of_range(&self, labels: &[Label]) -> i64 {
        labels.iter().map(|l| beyond(self.allowed[l.index()], self.changed_by[l.index()])).sum()
    }

    /// The changed voxels that have a label or are beside one that has, in their order.
    pub fn changed_near(&self, label: Label) -> Vec<[usize; 3]> {
        let has = |at: IVec3| self.image.at_or_background(at) == label;
        let mut voxels: Vec<usize> = self.changed.keys().copied().collect();
        voxels.sort_unstable();
        let voxels = voxels.into_iter().map(|voxel| self.image.grid().voxel_at(voxel));
        voxels.filter(|voxel| places_around(place(*voxel)).any(has)).collect()
    }

    /// The 26-connected pieces of the image at first, by label.
    pub fn piece_counts(&self) -> Vec<i64> {
        self.pieces.counts(self.first.len())
    }

    /// How many of the labels that changed voxels had are at no voxel around these any more: a whole piece has gone.
    fn lost_by(&self, back: &[Change]) -> usize {
        let is_left = |label: Label| {
            let places = back.iter().filter(|change| change.1 == label).map(|change| place(change.0));
            places.flat_map(places_around).any(|at| self.image.at_or_background(at) == label)
        };
        let labels = each_once(back.iter().map(|change| change.1));
        labels.into_iter().filter(|label| !label.is_background() && !is_left(*label)).count()
    }

    /// How many pieces of labels changes join with others, once they are made.
    fn joined_by(&self, changes: &[Change]) -> usize {
        let labels = each_once(changes.iter().map(|change| change.1));
        labels.into_iter().map(|label| self.pieces_beside(changes, label).len().saturating_sub(1)).sum()
    }

    /// The pieces of a label beside the voxels that have taken it, each by its first.
    fn pieces_beside(&self, changes: &[Change], label: Label) -> Vec<u32> {
        if label.is_background() {
            return Vec::new();
        }
        let taken = changes.iter().filter(|change| change.1 == label);
        let beside = taken.flat_map(|change| places_around(place(change.0)));
        let own =
            beside.filter(|at| self.image.at_or_background(*at) == label).map(|at| at.to_array().map(|x| x as usize));
        let before = own.filter(|at| changes.iter().all(|(voxel, _)| voxel != at));
        each_once(before.filter_map(|[i, j, k]| {
            let known = self.changed.get(&self.image.grid().offset(i, j, k)).map(|(_, piece)| *piece);
            let mut piece = known.or_else(|| self.pieces.component_at(i, j, k))?;
            while self.parents[piece as usize] != piece {
                piece = self.parents[piece as usize];
            }
            Some(piece)
        }))
    }

    /// How many pairs of labels would lie face to face at changed voxels that do not near these.
    fn opened_by(&self, changes: &[Change]) -> usize {
        let size = self.image.grid().size().map(|n| n as i32);
        let mut pairs: Vec<(IVec3, [Label; 2])> = Vec::new();
        for (voxel, to) in changes {
            let at = place(*voxel);
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
        let labels = self.labels_concerned(changes);
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

/// How far a number is out of a range.
fn beyond([low, high]: [i64; 2], number: i64) -> i64 {
    (low - number).max(number - high).max(0)
}

/// A voxel's place.
pub fn place(voxel: [usize; 3]) -> IVec3 {
    IVec3::from_array(voxel.map(|x| x as i32))
}

/// The corners of changed voxels; corner w lies between the voxels w - 1 and w.
fn corners_of(changes: &[Change]) -> Vec<[usize; 3]> {
    let step = |v: &[usize; 3], s: usize| [v[0] + (s & 1), v[1] + (s >> 1 & 1), v[2] + (s >> 2)];
    each_once(changes.iter().flat_map(|(v, _)| (0..8).map(move |s| step(v, s))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use glam::{DMat3, DVec3};

    const SIZE: [usize; 3] = [9, 9, 9];

    /// A cube of label 1 with edges of five voxels, one of label 2 beside it, and three voxels of label 2 of which two touch along an edge.
    fn image() -> LabelImage {
        let label = |at: [usize; 3]| match at {
            [2..7, 2..7, 2..7] => 1,
            [7, 4, 4] | [0, 0, 0] | [1, 1, 0] | [3, 1, 0] => 2,
            _ => 0,
        };
        let grid = Grid::new(SIZE, DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let voxels = (0..SIZE.iter().product()).map(|v| Label(label(grid.voxel_at(v)))).collect();
        LabelImage::new(grid, voxels, vec![0, 1, 2]).unwrap()
    }

    #[test]
    fn tunnels_and_swallowed_pieces_cost_more_than_a_join() {
        let mut image = image();
        let context = RunContext::with_threads(1).unwrap();
        let mut costs = ContactCosts::new(&mut image, &context).unwrap();
        let join = costs.cost(&[([1, 0, 0], Label(2))]);
        assert_eq!((join.out_of_range, join.lost, join.opened, join.euler, join.contacts), (0, 0, 0, 0, 0));
        // One voxel of two touching is taken away: parted, as the 6-connected reading has it.
        let part = costs.cost(&[([1, 1, 0], Label(0))]);
        assert_eq!((part.out_of_range, part.lost, part.euler), (0, 0, 0));
        let merge = costs.cost(&[([2, 1, 0], Label(2))]);
        assert_eq!((merge.out_of_range, merge.lost, merge.euler), (8, 1, 8));
        let swallow = costs.cost(&[([7, 4, 4], Label(0))]);
        assert_eq!((swallow.out_of_range, swallow.lost, swallow.euler), (8, 1, 8));
        let tunnel: Vec<Change> = (2..7).map(|i| ([i, 4, 4], Label(0))).collect();
        let tunnel = costs.cost(&tunnel);
        assert_eq!((tunnel.out_of_range, tunnel.euler, tunnel.opened), (8, 8, 0));
        assert!(join < part.max(swallow) && part < tunnel && tunnel < swallow);
    }

    #[test]
    fn a_voxel_that_changes_over_and_over_costs_most() {
        let mut image = image();
        let context = RunContext::with_threads(1).unwrap();
        let mut costs = ContactCosts::new(&mut image, &context).unwrap();
        for _ in 0..3 {
            costs.make(&[([1, 0, 0], Label(2))]);
            costs.make(&[([1, 0, 0], Label(0))]);
        }
        let (again, swallow) = (costs.cost(&[([1, 0, 0], Label(2))]), costs.cost(&[([7, 4, 4], Label(0))]));
        assert_eq!((again.visits, again.circling), (6, 6 - VISITS));
        assert!(swallow < again);
    }

    #[test]
    fn pieces_that_were_joined_are_one() {
        let mut image = image();
        let context = RunContext::with_threads(1).unwrap();
        let mut costs = ContactCosts::new(&mut image, &context).unwrap();
        // Parted and joined again, the two that touch along an edge; then with the third, and around it.
        costs.make(&[([1, 1, 0], Label(0))]);
        assert_eq!(costs.cost(&[([1, 1, 0], Label(2)), ([1, 0, 0], Label(2))]).lost, 0);
        costs.make(&[([1, 1, 0], Label(2))]);
        assert_eq!(costs.cost(&[([2, 1, 0], Label(2))]).lost, 1);
        costs.make(&[([2, 1, 0], Label(2))]);
        assert_eq!(costs.cost(&[([2, 0, 0], Label(2))]).lost, 0);
        // A piece of its own, then joined with that.
        costs.make(&[([5, 0, 0], Label(2))]);
        assert_eq!(costs.cost(&[([4, 0, 0], Label(2))]).lost, 1);
        assert_eq!(costs.cost(&[([6, 0, 0], Label(2))]).lost, 0);
    }

    #[test]
    fn labels_out_of_range_are_told_with_their_numbers() {
        let mut image = image();
        let context = RunContext::with_threads(1).unwrap();
        let mut costs = ContactCosts::new(&mut image, &context).unwrap();
        assert!(OutOfRange::among(costs.euler_numbers()).is_empty());
        // A cavity, and another piece of label 2, which has three or four.
        costs.make(&[([4, 4, 4], Label(2))]);
        assert_eq!(
            OutOfRange::among(costs.euler_numbers()),
            [OutOfRange { label: Label(1), number: 2, range: [1, 1] }]
        );
        costs.make(&[([4, 4, 4], Label(1)), ([7, 4, 4], Label(0)), ([0, 0, 0], Label(0)), ([1, 1, 0], Label(0))]);
        assert_eq!(
            OutOfRange::among(costs.euler_numbers()),
            [OutOfRange { label: Label(2), number: 1, range: [3, 4] }]
        );
    }

    #[test]
    fn numbers_at_the_ends_of_their_ranges_are_in_range() {
        let numbers = [(9, [0, 1]), (1, [1, 3]), (3, [1, 3]), (0, [1, 3]), (4, [1, 3])];
        let out: Vec<(u16, i64)> = OutOfRange::among(numbers).into_iter().map(|o| (o.label.0, o.number)).collect();
        assert_eq!(out, [(3, 0), (4, 4)]);
    }
}
