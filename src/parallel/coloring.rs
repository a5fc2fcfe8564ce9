//! Independent sets for race-free sweeps: items of one color share nothing, so their updates commute.
//!
//! # Method
//! Greedy: items in order take the smallest color that no conflicting item before them has. Items conflict when they
//! appear in a common group (vertices of one element, for one).
//!
//! # Invariants
//! Two items of one color are in no common group. The coloring depends on the input only.
//!
//! # Cost
//! Sequential; time proportional to the sum of the squared group sizes, 8 bytes per item.

/// Items sorted by color; within a color in increasing order.
#[derive(Debug, Clone, Default)]
pub struct Coloring {
    offsets: Vec<usize>,
    items: Vec<u32>,
}

impl Coloring {
    /// Colors the items `0..item_count` listed in `selected`; `groups_of(item, visit)` calls `visit` for every item in
    /// a common group with `item` (itself allowed).
    pub fn greedy(item_count: usize, selected: &[u32], mut groups_of: impl FnMut(u32, &mut dyn FnMut(u32))) -> Self {
        const NONE: u32 = u32::MAX;
        let mut color = vec![NONE; item_count];
        // `last_seen[c] == item + 1` marks color c as taken by a neighbor of the current item.
        let mut last_seen: Vec<u32> = Vec::new();
        let mut color_count = 0usize;
        for &item in selected {
            groups_of(item, &mut |other| {
                let taken = color[other as usize];
                if taken != NONE {
                    last_seen[taken as usize] = item + 1;
                }
            });
            let free = (0..color_count).find(|&c| last_seen[c] != item + 1).unwrap_or_else(|| {
                last_seen.push(0);
                color_count += 1;
                color_count - 1
            });
            color[item as usize] = free as u32;
        }
        let mut offsets = vec![0usize; color_count + 1];
        for &item in selected {
            offsets[color[item as usize] as usize + 1] += 1;
        }
        for c in 0..color_count {
            offsets[c + 1] += offsets[c];
        }
        let mut fill = offsets.clone();
        let mut items = vec![0u32; selected.len()];
        for &item in selected {
            let slot = &mut fill[color[item as usize] as usize];
            items[*slot] = item;
            *slot += 1;
        }
        Self { offsets, items }
    }

    /// The independent sets, one after another.
    pub fn colors(&self) -> impl Iterator<Item = &[u32]> {
        self.offsets.windows(2).map(|w| &self.items[w[0]..w[1]])
    }

    /// Number of colors.
    pub fn color_count(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn items_of_one_color_share_no_group() {
        let groups: Vec<[u32; 3]> = (0..40u32).map(|g| [g, (g * 7 + 3) % 40, (g * 11 + 5) % 40]).collect();
        let selected: Vec<u32> = (0..40).collect();
        let coloring = Coloring::greedy(40, &selected, |item, visit| {
            groups.iter().filter(|g| g.contains(&item)).flatten().for_each(|&o| visit(o));
        });
        let mut count = 0;
        for color in coloring.colors() {
            count += color.len();
            for (at, a) in color.iter().enumerate() {
                for b in &color[at + 1..] {
                    assert!(!groups.iter().any(|g| g.contains(a) && g.contains(b)));
                }
            }
        }
        assert_eq!(count, 40);
    }
}
