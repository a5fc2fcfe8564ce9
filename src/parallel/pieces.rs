//! An array cut into pieces of given lengths, for tasks that write one each.
//!
//! # Cost
//! One step per piece.

/// The pieces of an array in their order; what follows the last is left out.
///
/// # Panics
/// Where the lengths are more than the array's.
pub fn pieces<T>(mut rest: &mut [T], lengths: impl IntoIterator<Item = usize>) -> Vec<&mut [T]> {
    let next = |length: usize| {
        let (piece, after) = std::mem::take(&mut rest).split_at_mut(length);
        rest = after;
        piece
    };
    lengths.into_iter().map(next).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_have_their_lengths_and_follow_each_other() {
        let mut numbers: Vec<u32> = (0..10).collect();
        let cut = pieces(&mut numbers, [3, 0, 5]);
        assert_eq!(cut, [&[0, 1, 2][..], &[], &[3, 4, 5, 6, 7]]);
    }
}
