//! placeholder
use super::delaunay_kernel::{DelaunayReport, Kernel};
use crate::error::Result;

pub(super) const SMALLEST_ROUND: usize = usize::MAX / 4096;

pub(super) fn insert_round(
    kernel: &mut Kernel<'_>,
    range: std::ops::Range<usize>,
    _threads: usize,
    _report: &mut DelaunayReport,
) -> Result<()> {
    kernel.insert_range(range.start, range.end)
}
