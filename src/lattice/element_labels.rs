//! Labels that surfaces can be smoothed with: no element with two faces on a surface where a relabelling avoids it.
//!
//! # Method
//! An element with two faces on the boundary of its label becomes flat when that boundary becomes flat. Each such
//! element, and each foreign neighbour of it, is tried with the labels around it; the change that lowers the total
//! penalty most is made; its neighbours are looked at again. The penalty of an element grows with the square of its
//! foreign faces beyond the first; background elements have none.
//!
//! # Source
//! [Drakopoulos2017] 2.3.3, candidate mesh selection.
//!
//! # Differences
//! The thesis finishes one label after the other and so erodes those it begins with; here every change lowers one sum,
//! which treats labels alike. The sum is a whole number that falls with each change, so the descent ends.
//!
//! # Invariants
//! Only labels of neighbours are given; vertices and elements stay. The order of work is fixed.

use std::collections::VecDeque;

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::index::Label;
use crate::lattice::face_adjacency::OUTSIDE;

/// Penalty of an element with this many foreign faces.
const PENALTY: [i32; 5] = [0, 1, 8, 20, 40];

/// Elements per parallel work item, at least.
const CHUNK: usize = 1 << 14;

/// Elements tried between two looks at whether the run is cancelled.
const ELEMENTS_PER_CHECK: usize = 1024;

/// What the relabelling did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Relabelled {
    /// Elements with another label than before.
    pub changes: usize,
    /// Labelled elements that still have two or more foreign faces.
    pub remaining: usize,
}

/// Relabels elements so that few have two faces on a surface. `may_take` tells whether elements may take a label, given those
/// of all.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn relabel_for_smoothing(
    labels: &mut [Label],
    neighbors: &[[u32; 4]],
    may_take: impl Fn(&[Label], &[u32], Label) -> bool,
    context: &RunContext,
) -> Result<Relabelled> {
    let work = Relabelling { labels, neighbors };
    let mut queue: VecDeque<u32> = work.bad(context)?.into();
    let mut queued = vec![false; neighbors.len()];
    queue.iter().for_each(|e| queued[*e as usize] = true);
    let (mut changes, mut tried) = (0, 0);
    while let Some(e) = queue.pop_front() {
        context.check_every(ELEMENTS_PER_CHECK, tried)?;
        tried += 1;
        queued[e as usize] = false;
        if !work.is_bad(e as usize) {
            continue;
        }
        let Some((changed, label)) = work.best_change(e as usize, &may_take) else { continue };
        work.labels[changed] = label;
        changes += 1;
        for near in neighbors[changed].into_iter().chain([changed as u32]) {
            if near != OUTSIDE && !queued[near as usize] {
                queued[near as usize] = true;
                queue.push_back(near);
            }
        }
    }
    let remaining = work.bad(context)?.len();
    Ok(Relabelled { changes, remaining })
}

struct Relabelling<'a> {
    labels: &'a mut [Label],
    neighbors: &'a [[u32; 4]],
}

impl Relabelling<'_> {
    fn label_of(&self, element: u32) -> Label {
        if element == OUTSIDE { Label::BACKGROUND } else { self.labels[element as usize] }
    }

    /// Faces of `element`, taken as having `label`, to elements of other labels.
    fn foreign_faces(&self, element: usize, label: Label) -> usize {
        self.neighbors[element].iter().filter(|n| self.label_of(**n) != label).count()
    }

    fn is_bad(&self, element: usize) -> bool {
        let label = self.labels[element];
        !label.is_background() && self.foreign_faces(element, label) >= 2
    }

    /// All bad elements, increasing.
    fn bad(&self, context: &RunContext) -> Result<Vec<u32>> {
        let elements = (0..self.neighbors.len() as u32).into_par_iter().with_min_len(CHUNK);
        let bad = context.until_cancelled(elements).filter(|e| self.is_bad(*e as usize)).collect();
        context.check()?;
        Ok(bad)
    }

    fn penalty(&self, element: usize, label: Label) -> i32 {
        if label.is_background() { 0 } else { PENALTY[self.foreign_faces(element, label)] }
    }

    /// Change of the total penalty when `element` takes `label`.
    fn gain(&self, element: usize, label: Label) -> i32 {
        let old = self.labels[element];
        let mut change = self.penalty(element, label) - self.penalty(element, old);
        for near in self.neighbors[element] {
            let near_label = self.label_of(near);
            if near == OUTSIDE || near_label.is_background() {
                continue;
            }
            let before = self.foreign_faces(near as usize, near_label);
            let after = before + usize::from(near_label == old) - usize::from(near_label == label);
            change += PENALTY[after] - PENALTY[before];
        }
        change
    }

    /// The change at `element` or a foreign neighbour that lowers the penalty most.
    fn best_change(
        &self,
        element: usize,
        may_take: &impl Fn(&[Label], &[u32], Label) -> bool,
    ) -> Option<(usize, Label)> {
        let own = self.labels[element];
        let mut best = (0, None);
        for near in self.neighbors[element] {
            let label = self.label_of(near);
            if label == own {
                continue;
            }
            let inward = (element, label);
            let outward = (near as usize, own);
            for (changed, to) in [inward, outward] {
                if changed == OUTSIDE as usize {
                    continue;
                }
                let gain = self.gain(changed, to);
                if gain < best.0 && may_take(self.labels, &[changed as u32], to) {
                    best = (gain, Some((changed, to)));
                }
            }
        }
        best.1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_element_alone_among_others_takes_their_label() {
        // Element 0 has label 2 and four neighbours of label 1, which see the outside on no other face here.
        let neighbors = [[1, 2, 3, 4], [0, 2, 3, 4], [0, 1, 3, 4], [0, 1, 2, 4], [0, 1, 2, 3]];
        let mut labels = [2, 1, 1, 1, 1].map(Label);
        let context = RunContext::with_threads(1).unwrap();
        let result = relabel_for_smoothing(&mut labels, &neighbors, |_, _, _| true, &context).unwrap();
        assert_eq!((labels, result), ([Label(1); 5], Relabelled { changes: 1, remaining: 0 }));
    }

    #[test]
    fn kept_elements_stay() {
        let neighbors = [[1, 2, 3, 4], [0, 2, 3, 4], [0, 1, 3, 4], [0, 1, 2, 4], [0, 1, 2, 3]];
        let mut labels = [2, 1, 1, 1, 1].map(Label);
        let context = RunContext::with_threads(1).unwrap();
        relabel_for_smoothing(&mut labels, &neighbors, |_, _, _| false, &context).unwrap();
        assert_eq!(labels[0], Label(2));
        context.cancel_token().cancel();
        let cancelled = relabel_for_smoothing(&mut labels, &neighbors, |_, _, _| true, &context);
        assert!(matches!(cancelled, Err(crate::Error::Cancelled)) && labels[0] == Label(2));
    }
}
