//! A binary tree of boxes: overlap and ray queries over many boxes.
//!
//! # Method
//! Items are split at the median of the longest axis of their centres; nodes lie in one array, children behind their
//! parent. Leaves hold up to four items.
//!
//! # Cost
//! Building O(n log n), a query O(log n + hits). Immutable after building: queries from any thread. Deterministic.

use glam::DVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::geometry::bounding_box::BoundingBox;

/// Items of a leaf: below four the nodes cost more than the tests they save.
const LEAF_ITEMS: usize = 4;

/// Parts of more items look at whether the run is cancelled before they are split.
const ITEMS_PER_CHECK: usize = 4096;

#[derive(Debug, Clone, Copy)]
struct Node {
    bounds: BoundingBox,
    /// Leaf: first item; inner node: index of the second child (the first follows its parent).
    next: u32,
    /// Items of a leaf; 0 for an inner node.
    items: u32,
}

/// A tree over boxes, numbered as given.
#[derive(Debug, Clone, Default)]
pub struct AabbTree {
    nodes: Vec<Node>,
    order: Vec<u32>,
    boxes: Vec<BoundingBox>,
}

impl AabbTree {
    /// The tree of some boxes.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
    pub fn new(boxes: Vec<BoundingBox>, context: &RunContext) -> Result<Self> {
        let mut tree = Self { nodes: Vec::new(), order: (0..boxes.len() as u32).collect(), boxes };
        if !tree.boxes.is_empty() {
            tree.build(0, tree.boxes.len(), context)?;
        }
        Ok(tree)
    }

    fn build(&mut self, begin: usize, end: usize, context: &RunContext) -> Result<()> {
        if end - begin > ITEMS_PER_CHECK {
            context.check()?;
        }
        let items = &self.order[begin..end];
        let bounds = items.iter().fold(BoundingBox::EMPTY, |b, &i| b.union(self.boxes[i as usize]));
        let node = self.nodes.len();
        self.nodes.push(Node { bounds, next: begin as u32, items: (end - begin) as u32 });
        if end - begin <= LEAF_ITEMS {
            return Ok(());
        }
        let centers = BoundingBox::of_points(items.iter().map(|&i| self.boxes[i as usize].center()));
        let axis = centers.size().max_position();
        let middle = (end - begin) / 2;
        let boxes = &self.boxes;
        self.order[begin..end].select_nth_unstable_by(middle, |&l, &r| {
            let key = |i: u32| boxes[i as usize].center()[axis];
            key(l).total_cmp(&key(r)).then(l.cmp(&r))
        });
        self.build(begin, begin + middle, context)?;
        self.nodes[node].next = self.nodes.len() as u32;
        self.nodes[node].items = 0;
        self.build(begin + middle, end, context)
    }

    /// Calls `visit` for every item whose box passes `test`; `test` must hold for boxes that contain a passing one.
    pub fn visit(&self, test: impl Fn(BoundingBox) -> bool, mut visit: impl FnMut(usize)) {
        let mut stack = Vec::with_capacity(64);
        if !self.nodes.is_empty() {
            stack.push(0_u32);
        }
        while let Some(index) = stack.pop() {
            let node = self.nodes[index as usize];
            if !test(node.bounds) {
                continue;
            }
            if node.items == 0 {
                stack.push(node.next);
                stack.push(index + 1);
                continue;
            }
            for &item in &self.order[node.next as usize..(node.next + node.items) as usize] {
                if test(self.boxes[item as usize]) {
                    visit(item as usize);
                }
            }
        }
    }

    /// Calls `visit` for every item whose box overlaps `bounds`.
    pub fn overlapping(&self, bounds: BoundingBox, visit: impl FnMut(usize)) {
        self.visit(|b| b.overlaps(bounds), visit);
    }

    /// Calls `visit` for every item whose box a segment may meet.
    pub fn along_segment(&self, start: DVec3, end: DVec3, visit: impl FnMut(usize)) {
        let direction = end - start;
        let test = |b: BoundingBox| {
            let (mut near, mut far) = (0.0_f64, 1.0_f64);
            for axis in 0..3 {
                if direction[axis] == 0.0 {
                    if start[axis] < b.lower[axis] || start[axis] > b.upper[axis] {
                        return false;
                    }
                    continue;
                }
                let one = (b.lower[axis] - start[axis]) / direction[axis];
                let two = (b.upper[axis] - start[axis]) / direction[axis];
                near = near.max(one.min(two));
                far = far.min(one.max(two));
            }
            // Rounding must not lose a box that is just touched.
            near <= far + 1e-9
        };
        self.visit(test, visit);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tree_of(boxes: Vec<BoundingBox>) -> AabbTree {
        AabbTree::new(boxes, &RunContext::with_threads(1).unwrap()).unwrap()
    }

    fn cubes(count: usize) -> Vec<BoundingBox> {
        (0..count)
            .map(|i| {
                let p = DVec3::new((i * 37 % 101) as f64, (i * 53 % 89) as f64, (i * 71 % 97) as f64);
                BoundingBox { lower: p, upper: p + DVec3::splat(3.0) }
            })
            .collect()
    }

    #[test]
    fn overlaps_agree_with_all_pairs() {
        let boxes = cubes(300);
        let tree = tree_of(boxes.clone());
        for query in &boxes {
            let mut found = Vec::new();
            tree.overlapping(*query, |i| found.push(i));
            found.sort_unstable();
            let expected: Vec<usize> = (0..boxes.len()).filter(|&i| boxes[i].overlaps(*query)).collect();
            assert_eq!(found, expected);
        }
    }

    #[test]
    fn a_cancelled_run_builds_no_large_tree() {
        let context = RunContext::with_threads(1).unwrap();
        context.cancel_token().cancel();
        let tree = AabbTree::new(cubes(ITEMS_PER_CHECK + 1), &context);
        assert!(matches!(tree, Err(crate::Error::Cancelled)));
    }

    #[test]
    fn a_segment_finds_the_boxes_on_its_way() {
        let tree = tree_of(cubes(300));
        let mut found = Vec::new();
        tree.along_segment(DVec3::splat(-1.0), DVec3::splat(1.0), |i| found.push(i));
        assert_eq!(found, [0]);
        tree_of(Vec::new()).overlapping(BoundingBox::EMPTY, |_| panic!("an empty tree has no items"));
    }
}
