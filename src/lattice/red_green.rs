//! Red-green refinement: red 1:8 subdivision that keeps the shape, green closure that is made anew every time.
//!
//! # Method
//! 1. Marked tets become red: their six edges are split.
//! 2. Every other tet looks at its edges. All of them split, or one split twice, makes it red too. Other patterns are
//!    treated as the [`Closure`] says. Repeated until nothing changes; the result does not depend on the order.
//! 3. Red tets are replaced by their eight children; children that no label is near are dropped. Children
//!    are looked at as in 2.
//! 4. [`RedGreenLattice::elements`] closes what is left with green templates. Greens are never stored, so they are
//!    gone before the next round; where nothing has changed they are taken over from the round before
//!    ([`RedGreenLattice::elements_after`]).
//!
//! # Source
//! [Molino2003], [Drakopoulos2017] 2.3.3.
//!
//! # Differences
//! Besides the closure of [Molino2003] there is a local one, for which every set of split edges has a template
//! ([`super::red_green_tables`]): refinement stays where it was asked for.
//! A midpoint exists exactly where an integer key is in the vertex table; there are no edge records.
//!
//! # Invariants
//! Every stored tet is a scaled copy of the coarsest, long edges first; all dihedral angles of [`Elements`] lie within
//! 30 and 120 degrees. Tets stay in the order of their coarsest tet, then depth first.
//!
//! # Cost
//! 24 bytes a stored tet and about 40 a vertex. Linear, in parallel; looking up midpoints dominates.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::index::Label;
use crate::lattice::bcc_lattice::{Field, LatticeFrame, LatticeVertices, coarsest_tets};
use crate::lattice::red_green_tables::{RED_CHILDREN, green_children, is_regular, missing_long_edges};
use crate::mesh::numbering::TET_EDGES;
use crate::parallel::ordered_concat::ordered_concat;
use crate::parallel::shared_rows::SharedBytes;

/// All edges of a tet.
const ALL_EDGES: u8 = 0b111111;

/// Edges of each face, in the order of `numbering::TET_EDGES`.
const FACE_EDGES: [[usize; 3]; 4] = [[0, 1, 3], [0, 2, 4], [1, 2, 5], [3, 4, 5]];

/// Tets per parallel work item: some 0.1 ms, far above the cost of handing it over.
const CHUNK: usize = 2048;

/// No number before a change.
pub const CHANGED: u32 = u32::MAX;

/// What becomes of a leaf whose neighbours split some of its edges.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Closure {
    /// Anything but one edge, two opposite ones or a face makes it red. Marks that lie scattered grow together to
    /// regions of one level, with many elements of the best shape; a few hundred marks can refine a whole lattice.
    #[default]
    Uniform,
    /// A face of which only both short edges are split gets its long one split ([`missing_long_edges`]), then every
    /// pattern has a template: marks reach no farther than their neighbours.
    Local,
}

/// The adaptive lattice.
pub struct RedGreenLattice<'a> {
    /// Where the lattice lies.
    pub frame: LatticeFrame,
    /// The image.
    pub field: Field<'a>,
    /// All vertices ever made.
    pub vertices: LatticeVertices,
    /// Leaf tets. 16 B / tet.
    pub tets: Vec<[u32; 4]>,
    /// Level of each leaf. 1 B / tet.
    pub levels: Vec<u8>,
    /// The number that each leaf had before the last refinement, where that left it and its edges as they were; else
    /// [`CHANGED`]. 4 B / tet.
    pub unchanged: Vec<u32>,
    deepest: u8,
    max_elements: usize,
    closure: Closure,
}

/// The conforming elements of the lattice: red leaves and greens.
#[derive(Default, PartialEq)]
pub struct Elements {
    /// Vertices. 16 B / element.
    pub tets: Vec<[u32; 4]>,
    /// Label at the centroid ([`RedGreenLattice::label_at_centroid`]). 2 B / element.
    pub labels: Vec<Label>,
    /// The leaf each element comes from, increasing until elements are carved: what that adds comes at the end. 4 B / element.
    pub leaves: Vec<u32>,
}

/// Middle vertices of the leaves that become red.
struct Splits {
    /// Position in `middles` per leaf; `u32::MAX` for leaves that stay.
    slots: Vec<u32>,
    /// Middle vertices of the edges of each split leaf.
    middles: Vec<[u32; 6]>,
}

impl<'a> RedGreenLattice<'a> {
    /// The coarsest lattice.
    ///
    /// # Errors
    /// As [`coarsest_tets`]; [`Error::LimitReached`] for more than `max_elements` tets.
    pub fn new(frame: LatticeFrame, field: Field<'a>, max_elements: usize, context: &RunContext) -> Result<Self> {
        let mut vertices = LatticeVertices::default();
        let tets = coarsest_tets(&frame, &field, &mut vertices, context)?;
        let levels = vec![0; tets.len()];
        let closure = Closure::default();
        let unchanged = vec![CHANGED; tets.len()];
        let lattice = Self { frame, field, vertices, tets, levels, unchanged, deepest: 0, max_elements, closure };
        lattice.check_size(lattice.tets.len())?;
        Ok(lattice)
    }

    /// Closes refinement locally from now on: what has been closed so cannot be closed otherwise.
    pub fn close_locally(&mut self) {
        self.closure = Closure::Local;
    }

    /// Deepest level of any leaf.
    pub fn deepest_level(&self) -> u32 {
        u32::from(self.deepest)
    }

    /// Edge of the cubes that a leaf belongs to, its longest, mm.
    #[inline]
    pub fn leaf_edge(&self, leaf: u32) -> f64 {
        self.frame.edge_length(u32::from(self.levels[leaf as usize]))
    }

    /// Centroid of a tet in the local frame, mm.
    #[inline]
    pub fn centroid(&self, tet: &[u32; 4]) -> DVec3 {
        let sum: IVec3 = tet.iter().map(|v| self.vertices.positions[*v as usize]).sum();
        self.frame.origin + 0.25 * self.frame.unit * sum.as_dvec3()
    }

    /// The label that an element of a leaf with a given edge, mm, has by its centroid ([`Field::label_of_element`]).
    #[inline]
    pub fn label_at_centroid(&self, tet: &[u32; 4], edge: f64) -> Label {
        self.field.label_of_element(self.centroid(tet), edge)
    }

    /// Corners of a tet in the local frame, mm.
    #[inline]
    pub fn corners(&self, tet: &[u32; 4]) -> [DVec3; 4] {
        tet.map(|v| self.frame.local(self.vertices.positions[v as usize]))
    }

    /// Subdivides the marked leaves and whatever conformity asks for.
    ///
    /// # Errors
    /// [`Error::Cancelled`], [`Error::LimitReached`].
    pub fn refine(&mut self, marked: &[bool], context: &RunContext) -> Result<()> {
        let max_level = self.frame.max_level() as u8;
        let refinable = |t: &u32| marked[*t as usize] && self.levels[*t as usize] < max_level;
        let leaves = (0..self.tets.len() as u32).into_par_iter().with_min_len(CHUNK);
        let mut pending: Vec<u32> = leaves.filter(refinable).collect();
        let mut unchanged: Vec<u32> = (0..self.tets.len() as u32).collect();
        let mut long_edges = Vec::new();
        while !(pending.is_empty() && long_edges.is_empty()) {
            let mut splits = Splits { slots: vec![u32::MAX; self.tets.len()], middles: Vec::new() };
            while !(pending.is_empty() && long_edges.is_empty()) {
                context.check()?;
                let touched = self.split_edges_of(&pending, &long_edges, &mut splits)?;
                let is_touched = |tet: &[u32; 4]| tet.iter().filter(|v| touched[**v as usize] != 0).count() >= 2;
                let touched: Vec<bool> = self.tets.par_iter().with_min_len(CHUNK).map(is_touched).collect();
                let rows = unchanged.par_iter_mut().zip(&touched).with_min_len(CHUNK);
                rows.filter(|(_, touched)| **touched).for_each(|(number, _)| *number = CHANGED);
                let near = |t: usize| splits.slots[t] == u32::MAX && touched[t];
                (pending, long_edges) = self.to_be_split(near);
            }
            self.vertices.label_new(&self.frame, &self.field);
            // A child of a promoted tet can itself have edges that its neighbours split.
            let is_new = self.replace_by_children(&splits, context)?;
            let mut staying = unchanged.iter().zip(&splits.slots).filter(|(_, slot)| **slot == u32::MAX);
            let number = |is_new: &bool| if *is_new { CHANGED } else { staying.next().map_or(CHANGED, |(n, _)| *n) };
            unchanged = is_new.iter().map(number).collect();
            (pending, long_edges) = self.to_be_split(|t| is_new[t]);
        }
        self.unchanged = unchanged;
        Ok(())
    }

    /// Splits all edges of leaves, and single edges. Touches the ends of the edges that are new, and the ends of the edges in whose middle
    /// these ends lie: every leaf for which a new vertex matters has two touched corners.
    fn split_edges_of(&mut self, leaves: &[u32], edges: &[[u32; 2]], splits: &mut Splits) -> Result<Vec<u8>> {
        let first_new = self.vertices.positions.len();
        let tets: Vec<[u32; 4]> = leaves.par_iter().with_min_len(CHUNK).map(|t| self.tets[*t as usize]).collect();
        let middles = self.vertices.insert_middles(&tets)?;
        self.vertices.split_edges(edges)?;
        for (slot, leaf) in (splits.middles.len() as u32..).zip(leaves) {
            splits.slots[*leaf as usize] = slot;
            self.deepest = self.deepest.max(self.levels[*leaf as usize] + 1);
        }
        splits.middles.extend(middles);
        let mut touched = vec![0; self.vertices.positions.len()];
        // Only ones are written, so that the order does not matter.
        let marks = SharedBytes::new(&mut touched);
        let parents = &self.vertices.parents;
        parents[first_new..].par_iter().with_min_len(CHUNK).flatten_iter().for_each(|end| {
            marks.store(*end as usize, 1);
            parents[*end as usize].iter().for_each(|p| marks.store(*p as usize, 1));
        });
        Ok(touched)
    }

    /// Leaves among the candidates that have to become red, and single edges of the others that have to be split.
    fn to_be_split(&self, is_candidate: impl Fn(usize) -> bool + Sync) -> (Vec<u32>, Vec<[u32; 2]>) {
        let chunks: (Vec<Vec<u32>>, Vec<Vec<[u32; 2]>>) = (0..self.tets.len().div_ceil(CHUNK))
            .into_par_iter()
            .map(|c| {
                let (mut red, mut edges) = (Vec::new(), Vec::new());
                let range = c * CHUNK..((c + 1) * CHUNK).min(self.tets.len());
                for t in range.filter(|t| self.levels[*t] < self.deepest && is_candidate(*t)) {
                    let tet = &self.tets[t];
                    let (mask, middles) = self.split_edges(tet);
                    if self.must_be_red(tet, mask, &middles) {
                        red.push(t as u32);
                        continue;
                    }
                    let missing = missing_long_edges(mask);
                    edges.extend((0..6).filter(|e| missing >> e & 1 == 1).map(|e| TET_EDGES[e].map(|v| tet[v])));
                }
                (red, edges)
            })
            .unzip();
        (chunks.0.concat(), chunks.1.concat())
    }

    /// Which edges are split, and at which vertices.
    fn split_edges(&self, tet: &[u32; 4]) -> (u8, [u32; 6]) {
        let (mut mask, mut middles) = (0, [u32::MAX; 6]);
        for (e, [a, b]) in TET_EDGES.into_iter().enumerate() {
            if let Some(middle) = self.vertices.middle(tet[a], tet[b]) {
                mask |= 1 << e;
                middles[e] = middle;
            }
        }
        (mask, middles)
    }

    fn must_be_red(&self, tet: &[u32; 4], mask: u8, middles: &[u32; 6]) -> bool {
        if mask == 0 {
            return false;
        }
        if mask == ALL_EDGES || (self.closure == Closure::Uniform && !is_regular(mask)) {
            return true;
        }
        let split_again = |e: usize| {
            let [a, b] = TET_EDGES[e];
            let m = middles[e];
            self.vertices.middle(tet[a], m).is_some() || self.vertices.middle(m, tet[b]).is_some()
        };
        // Three edges of a face: its middle triangle belongs to a child of the neighbour, which may be split as well.
        let ring_split = |[a, b, c]: [usize; 3]| {
            let [a, b, c] = [middles[a], middles[b], middles[c]];
            let whole = [a, b, c].iter().all(|m| *m != u32::MAX);
            whole && [(a, b), (b, c), (a, c)].iter().any(|(a, b)| self.vertices.middle(*a, *b).is_some())
        };
        (0..6).any(|e| mask >> e & 1 == 1 && split_again(e)) || FACE_EDGES.into_iter().any(ring_split)
    }

    /// Replaces split leaves by their children; tells which leaves are new.
    fn replace_by_children(&mut self, splits: &Splits, context: &RunContext) -> Result<Vec<bool>> {
        type Children = ((Vec<[u32; 4]>, Vec<u8>), Vec<bool>);
        let chunks: Vec<Children> = (0..self.tets.len().div_ceil(CHUNK))
            .into_par_iter()
            .map(|c| {
                context.check()?;
                let range = c * CHUNK..((c + 1) * CHUNK).min(self.tets.len());
                let (mut tets, mut levels, mut is_new) = (Vec::new(), Vec::new(), Vec::new());
                for t in range {
                    if splits.slots[t] == u32::MAX {
                        tets.push(self.tets[t]);
                        levels.push(self.levels[t]);
                        is_new.push(false);
                    } else {
                        self.push_children(t, &splits.middles[splits.slots[t] as usize], &mut tets);
                        levels.resize(tets.len(), self.levels[t] + 1);
                        is_new.resize(tets.len(), true);
                    }
                }
                tets.shrink_to_fit();
                levels.shrink_to_fit();
                is_new.shrink_to_fit();
                Ok(((tets, levels), is_new))
            })
            .collect::<Result<_>>()?;
        self.check_size(chunks.iter().map(|((tets, _), _)| tets.len()).sum())?;
        let ((tets, levels), is_new): (_, Vec<_>) = chunks.into_iter().unzip();
        (self.tets, self.levels) = (ordered_concat(tets), ordered_concat(levels));
        Ok(ordered_concat(is_new))
    }

    fn push_children(&self, tet: usize, middles: &[u32; 6], tets: &mut Vec<[u32; 4]>) {
        let edge = self.frame.edge_length(u32::from(self.levels[tet]) + 1);
        for child in RED_CHILDREN {
            let child = child.map(|v| local_vertex(v, &self.tets[tet], middles));
            if self.field.is_near_labels(self.centroid(&child), edge) {
                tets.push(child);
            }
        }
    }

    fn check_size(&self, tets: usize) -> Result<()> {
        if tets > self.max_elements {
            let reason = format!("the lattice needs {tets} elements, {} are allowed", self.max_elements);
            return Err(Error::LimitReached { reason });
        }
        Ok(())
    }

    /// The conforming elements with their labels by centroid.
    ///
    /// # Errors
    /// [`Error::Cancelled`], [`Error::LimitReached`].
    pub fn elements(&self, context: &RunContext) -> Result<Elements> {
        self.collect_elements(context, |t, elements| self.push_elements(t, elements))
    }

    /// As [`Self::elements`], taken over from those before the last refinement where that changed nothing, whose labels are
    /// still those by centroid. For each element its number before, or [`CHANGED`].
    ///
    /// # Errors
    /// As [`Self::elements`].
    pub fn elements_after(&self, before: &Elements, context: &RunContext) -> Result<(Elements, Vec<u32>)> {
        let mut firsts = vec![0u32; before.leaves.last().map_or(0, |leaf| *leaf as usize + 1) + 1];
        (1..).zip(&before.leaves).for_each(|(end, leaf)| firsts[*leaf as usize + 1] = end);
        let range_of = |leaf: u32| firsts[leaf as usize] as usize..firsts[leaf as usize + 1] as usize;
        let elements = self.collect_elements(context, |t, elements| {
            if self.unchanged[t] == CHANGED {
                return self.push_elements(t, elements);
            }
            let range = range_of(self.unchanged[t]);
            elements.leaves.resize(elements.leaves.len() + range.len(), t as u32);
            elements.tets.extend_from_slice(&before.tets[range.clone()]);
            elements.labels.extend_from_slice(&before.labels[range]);
            Ok(())
        })?;
        context.check()?;
        let mut numbers = Vec::with_capacity(elements.leaves.len());
        for of_leaf in elements.leaves.chunk_by(|a, b| a == b) {
            let first = match self.unchanged[of_leaf[0] as usize] {
                CHANGED => None,
                leaf => Some(range_of(leaf).start),
            };
            numbers.extend((0..of_leaf.len()).map(|at| first.map_or(CHANGED, |first| (first + at) as u32)));
        }
        Ok((elements, numbers))
    }

    /// What `push` adds for each leaf, in order.
    fn collect_elements(
        &self,
        context: &RunContext,
        push: impl Fn(usize, &mut Elements) -> Result<()> + Sync,
    ) -> Result<Elements> {
        let chunks: Vec<Elements> = (0..self.tets.len().div_ceil(CHUNK))
            .into_par_iter()
            .map(|c| {
                context.check()?;
                let mut elements = Elements::default();
                for t in c * CHUNK..((c + 1) * CHUNK).min(self.tets.len()) {
                    push(t, &mut elements)?;
                }
                // All chunks wait for the last: what they grew by beyond their length would be half as much again.
                elements.tets.shrink_to_fit();
                elements.labels.shrink_to_fit();
                elements.leaves.shrink_to_fit();
                Ok(elements)
            })
            .collect::<Result<_>>()?;
        context.check()?;
        self.check_size(chunks.iter().map(|c| c.tets.len()).sum())?;
        let (mut tets, mut labels, mut leaves) = (Vec::new(), Vec::new(), Vec::new());
        for chunk in chunks {
            tets.push(chunk.tets);
            labels.push(chunk.labels);
            leaves.push(chunk.leaves);
        }
        Ok(Elements { tets: ordered_concat(tets), labels: ordered_concat(labels), leaves: ordered_concat(leaves) })
    }

    fn push_elements(&self, t: usize, elements: &mut Elements) -> Result<()> {
        let corners = self.tets[t];
        let edge = self.leaf_edge(t as u32);
        let mut push = |tet: [u32; 4]| {
            elements.tets.push(tet);
            elements.labels.push(self.label_at_centroid(&tet, edge));
            elements.leaves.push(t as u32);
        };
        if self.levels[t] >= self.deepest {
            push(corners);
            return Ok(());
        }
        let (mask, middles) = self.split_edges(&corners);
        let Some(children) = green_children(mask) else {
            return Err(Error::Internal { reason: format!("leaf {t} has no template for its edges {mask:06b}") });
        };
        for child in children {
            push(child.map(|v| local_vertex(v, &corners, &middles)));
        }
        Ok(())
    }
}

#[inline]
fn local_vertex(local: u8, corners: &[u32; 4], middles: &[u32; 6]) -> u32 {
    if local < 4 { corners[usize::from(local)] } else { middles[usize::from(local) - 4] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::distance_transform::distance_to_other_labels;
    use crate::image::grid::Grid;
    use crate::image::label_image::LabelImage;
    use crate::lattice::bcc_lattice::PastBorder;
    use crate::lattice::face_adjacency::{neighbors_after, neighbors_of};
    use glam::DMat3;

    /// Marks leaves at random over several rounds: whatever edges are split, every leaf has a template afterwards.
    #[test]
    fn random_marks_always_close() {
        let uniform = elements_of_random_marks(Closure::Uniform);
        let local = elements_of_random_marks(Closure::Local);
        assert!(2 * local < uniform, "{local} and {uniform}");
    }

    /// Refines with marks at random; returns the number of elements of all lattices.
    fn elements_of_random_marks(closure: Closure) -> usize {
        let grid = Grid::new([16; 3], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let at = |i: usize| DVec3::new((i % 16) as f64, (i / 16 % 16) as f64, (i / 256) as f64);
        let inside = |i: usize| u16::from(at(i).distance(DVec3::splat(7.3)) < 5.2);
        let voxels = (0..4096).map(|i| Label(inside(i))).collect();
        let image = LabelImage::new(grid, voxels, vec![0, 1]).unwrap();
        let context = RunContext::with_threads(1).unwrap();
        let distance = distance_to_other_labels(&image, &context).unwrap();
        let (mut count, mut kept) = (0, 0);
        for seed in 0..20u64 {
            let frame = LatticeFrame::new(&image, 5.0).unwrap();
            let field = Field::new(&image, &distance, PastBorder::Background);
            let mut lattice = RedGreenLattice::new(frame, field, 1 << 22, &context).unwrap();
            if closure == Closure::Local {
                lattice.close_locally();
            }
            let mut state = 0x9e37_79b9_7f4a_7c15u64.wrapping_mul(seed + 1);
            let mut before = lattice.elements(&context).unwrap();
            let mut neighbors_before = neighbors_of(&before.tets, lattice.vertices.positions.len(), &context).unwrap();
            // In the last round a few marks, so that most stays as it was.
            for rarity in [23, 23, 23, 23, 5003] {
                let marked: Vec<bool> = (0..lattice.tets.len())
                    .map(|_| {
                        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                        (state >> 33).is_multiple_of(rarity)
                    })
                    .collect();
                lattice.refine(&marked, &context).unwrap();
                let elements = lattice.elements(&context).unwrap();
                assert!(elements.tets.len() >= lattice.tets.len(), "seed {seed}");
                let neighbors = neighbors_of(&elements.tets, lattice.vertices.positions.len(), &context).unwrap();
                // What is taken over is what would be made anew.
                let (taken_over, numbers) = lattice.elements_after(&before, &context).unwrap();
                assert!(taken_over == elements, "seed {seed}");
                kept += numbers.iter().filter(|n| **n != CHANGED).count();
                assert!(neighbors_after(&neighbors_before, &numbers, &elements.tets, &context).unwrap() == neighbors);
                (before, neighbors_before) = (taken_over, neighbors);
                // No vertex hangs in the middle of an edge.
                let edges = |tet: &[u32; 4]| TET_EDGES.map(|edge| edge.map(|v| tet[v]));
                assert!(elements.tets.iter().flat_map(edges).all(|[a, b]| lattice.vertices.middle(a, b).is_none()));
            }
            count += before.tets.len();
        }
        assert!(kept > count / 100, "{kept} of {count}");
        count
    }
}
