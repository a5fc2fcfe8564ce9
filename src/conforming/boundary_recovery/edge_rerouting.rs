//! Recovers edges for which segments that the mesh has already make room.
//!
//! # Method
//! In a row of slender prisms the diagonals of neighbouring walls have to agree: the edge that comes last finds no room, as
//! the segments around it are kept. Which one comes last is a matter of order.
//! ```text
//!     missing: *          The missing edge takes the place of a segment, which is recovered elsewhere, or is the missing
//!     / / / * \ \         one now; the gap moves on from there until it meets room, as a vacancy in a crystal does.
//!     / / * \ \ \
//! ```
//! 1. The edge is recovered by flips that may remove segments. Those that are lost are recovered by flips that may not.
//! 2. Where none is left missing, that is kept; where one is, and it was not missing on this way before, it is next.
//!    Anything else is undone and tried from elsewhere on the rings.
//! 3. Passes over all missing edges go deeper each time, as long as they recover some.
//!
//! # Source
//! [GeorgeBorouchaki2003] and [Si2015] keep what is recovered; to give it up again, as routers of wires do, is ours.
//!
//! # Invariants
//! No more edges are missing afterwards than before. Faces are not kept yet.

use super::Effort;
use super::constrained_mesh::{ConstrainedMesh, EdgeKey};
use super::edge_recovery::recover_edge;
use crate::context::RunContext;
use crate::error::Result;

/// Levels of edge removal of the passes.
const DEPTHS: [usize; 5] = [2, 3, 5, 8, 20];
/// Levels with which lost segments are tried first: most need no more.
const FIRST_DEPTH: usize = 3;
/// Edges looked at for one edge; 200 leave hardly fewer points, in a third more time.
const TRIES: usize = 50;
/// Edges that one gap moves over.
const MOST_MOVES: usize = 20;
/// Moves of one gap that are undone: 1 leaves a tenth more points, 4 no fewer.
const MOST_UNDONE: usize = 2;

/// Recovers what can be recovered of `missing`; returns what is missing then, which may be other edges.
///
/// # Errors
/// `Cancelled`, `LimitReached`, and those of tet creation.
pub fn reroute_edges(
    mesh: &mut ConstrainedMesh,
    mut missing: Vec<EdgeKey>,
    effort: &Effort,
    context: &RunContext,
) -> Result<Vec<EdgeKey>> {
    for (turn, depth) in DEPTHS.into_iter().enumerate() {
        let effort = &Effort { depth, tries: TRIES, turn, ..*effort };
        let before = missing.len();
        let mut left = Vec::new();
        for edge in missing {
            context.check()?;
            if !recover_edge(mesh, edge, effort)? {
                left.extend(move_gap(mesh, edge, effort)?);
            }
        }
        missing = left;
        if missing.is_empty() || missing.len() == before {
            break;
        }
    }
    Ok(missing)
}

/// Recovers an edge by letting others be missing in its stead, one after the other; the one missing at last, or `None`.
fn move_gap(mesh: &mut ConstrainedMesh, edge: EdgeKey, effort: &Effort) -> Result<Option<EdgeKey>> {
    let mut way = vec![edge];
    let mut current = edge;
    let (mut moves, mut undone) = (0, 0);
    while moves < MOST_MOVES && undone < MOST_UNDONE && !mesh.cancel.is_cancelled() {
        let effort = &Effort { turn: effort.turn + moves + undone, ..*effort };
        mesh.begin_trial();
        let left = take_place(mesh, current, effort)?;
        let next = left.as_ref().and_then(|left| left.first().copied());
        let keep = left.is_some_and(|left| left.len() < 2) && next.is_none_or(|next| !way.contains(&next));
        mesh.end_trial(keep)?;
        match (keep, next) {
            (true, None) => return Ok(None),
            (true, Some(next)) => {
                way.push(next);
                current = next;
                moves += 1;
            }
            (false, _) => undone += 1,
        }
    }
    Ok(Some(current))
}

/// Recovers an edge in the place of others; those that are missing then, or `None` where it cannot be recovered so.
pub fn take_place(mesh: &mut ConstrainedMesh, edge: EdgeKey, effort: &Effort) -> Result<Option<Vec<EdgeKey>>> {
    if !recover_edge(mesh, edge, &Effort { yields: true, ..*effort })? {
        return Ok(None);
    }
    let mut lost = mesh.segments_lost_in_trial();
    for depth in [effort.depth.min(FIRST_DEPTH), effort.depth] {
        let mut left = Vec::new();
        for edge in lost {
            if !recover_edge(mesh, edge, &Effort { depth, ..*effort })? {
                left.push(edge);
            }
        }
        lost = left;
    }
    Ok(Some(lost))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conforming::boundary_recovery::edge_efforts;
    use crate::conforming::boundary_recovery::edge_recovery::recover_edges;
    use crate::conforming::options::Options;
    use crate::conforming::test_meshes::enclosed_mesh;
    use crate::conforming::test_surfaces::{strips, twisted_prism};
    use crate::mesh::tet_store::TetStore;

    #[test]
    fn what_is_returned_is_what_is_missing() {
        let context = RunContext::with_threads(1).unwrap();
        let flips = edge_efforts(&Options::default())[0];
        let mut recovered = 0;
        for surface in [strips(30, 3600.0), twisted_prism(24, 6.0, 4), twisted_prism(5, 15.0, 6)] {
            let mut mesh = ConstrainedMesh::new(enclosed_mesh(&surface.points), &surface.facets);
            let missing = mesh.missing_segments();
            let missing = recover_edges(&mut mesh, missing, &flips, &context).unwrap();
            let before = missing.len();
            let mut left = reroute_edges(&mut mesh, missing, &flips, &context).unwrap();
            left.sort_unstable();
            assert_eq!(left, mesh.missing_segments());
            assert!(left.len() <= before && mesh.volume_points.is_empty());
            recovered += before - left.len();
            mesh.complex.check_invariants().unwrap();
            assert!(mesh.complex.finite_tets().all(|tet| mesh.complex.is_positive(tet)));
        }
        assert!(recovered > 0);
    }

    #[test]
    fn a_gap_moves_and_nothing_else_is_lost() {
        // Schoenhardt's prism: whatever makes room, one diagonal stays missing.
        let surface = twisted_prism(3, 20.0, 1);
        let context = RunContext::with_threads(1).unwrap();
        let mut mesh = ConstrainedMesh::new(enclosed_mesh(&surface.points), &surface.facets);
        let effort = Effort { depth: 3, tries: TRIES, ..edge_efforts(&Options::default())[0] };
        for turn in 0..4 {
            let missing = mesh.missing_segments();
            let missing = recover_edges(&mut mesh, missing, &effort, &context).unwrap();
            let Some(&edge) = missing.first() else { panic!("no tets without a point") };
            let count = missing.len();
            let left = move_gap(&mut mesh, edge, &Effort { turn, ..effort }).unwrap();
            let now = mesh.missing_segments();
            assert!(now.len() <= count && left.is_none_or(|edge| now.contains(&edge)), "{edge:?} {left:?} {now:?}");
            assert!(mesh.complex.finite_tets().all(|tet| mesh.complex.is_positive(tet)));
        }
    }
}
