//! Direct insertion of accepted points: split the tet, face or edge that contains the point, then reconnect around it.
//!
//! # Method
//! 1. Walk from the tet that contained the point before the round, or from its nearest corner, to the one that does now.
//! 2. Apply the distance rules again (`point_filter`): candidates inserted since then are vertices now.
//! 3. Replace the tets whose circumspheres contain the point ([`super::cavity_insertion`]).
//! 4. Where that cavity would lose something, and for points moved to a face or edge nearby: split by 2-6, n-2n or 1-4 and
//!    restore empty circumspheres around the new vertex by flips.
//!
//! # Source
//! [Drakopoulos2017] 4.7.1 (point insertion), figure 67; B.3 `loc`, `loctol`.
//!
//! # Differences
//! Candidates of one tet stand together in the order of insertion, which is the thesis's list per tet; the reconnection
//! that follows at once replaces the merging of lists.
//!
//! # Invariants
//! Generic over the store. A failed insertion changes nothing.

use glam::DVec3;

use super::flip_criteria::AnyPositive;
use super::flips::{Feature, Outcome, plan_insertion};
use super::local_reconnection::Reconnector;
use super::point_filter::{Walk, contains, feature_of, is_clear, walk};
use crate::error::Result;
use crate::index::{TetId, VertexId};
use crate::mesh::tet_store::TetStore;

/// What became of a candidate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Insertion {
    /// It is a vertex now.
    Inserted,
    /// A vertex or the boundary is too close.
    TooClose,
    /// It lies outside or on the boundary, or on a constraint.
    Outside,
    /// Another thread held what it needs.
    ClaimLost,
    /// The store has no room for its tets.
    NoRoom,
}

/// How insertions are done.
#[derive(Debug, Clone, Copy)]
pub struct InsertionRule {
    /// `cdfn`.
    pub near_factor: f64,
    /// `loctol` where `loc` is 1, else 0.
    pub snap_tolerance: f64,
}

/// Inserts `vertex`, whose point and clearance are set, walking from `start`.
///
/// # Errors
/// As [`crate::conforming::flips::commit`].
pub fn insert_vertex<S: TetStore + ?Sized>(
    store: &mut S,
    clearances: &[f64],
    vertex: VertexId,
    point: DVec3,
    start: TetId,
    rule: &InsertionRule,
    reconnector: &mut Reconnector,
) -> Result<Insertion> {
    // The point is known to lie in its region. The start may be on the other side of a wall that it lies beside.
    let tet = match walk(store, start, point, true) {
        Walk::Inside(tet) => tet,
        Walk::Blocked => return Ok(Insertion::Outside),
        // Too far: not worth another attempt.
        Walk::Lost => return Ok(Insertion::Outside),
        Walk::Gone => return Ok(Insertion::ClaimLost),
    };
    // The walk read without claims: the slot may hold another tet by now, which does not contain the point.
    if !store.try_claim(vertex) || !store.try_claim_tet(tet) || !contains(store, tet, point) {
        store.release_claims();
        return Ok(Insertion::ClaimLost);
    }
    if !is_clear(store, clearances, tet, point, clearances[vertex.index()], rule.near_factor) {
        store.release_claims();
        return Ok(Insertion::TooClose);
    }
    let feature = feature_of(store, tet, point, 0.0);
    let snapped = if rule.snap_tolerance > 0.0 { feature_of(store, tet, point, rule.snap_tolerance) } else { feature };
    // A point on a face or an edge has a cavity like any other: the tets beside it join, their circumspheres hold it.
    if snapped == feature && !matches!(feature, Feature::Vertex(_)) {
        match reconnector.cavity.plan(store, tet, point) {
            Outcome::Accepted => {
                if !reconnector.cavity.is_clear(store, clearances, point, clearances[vertex.index()], rule.near_factor)
                {
                    store.release_claims();
                    return Ok(Insertion::TooClose);
                }
                let committed = reconnector.commit_cavity(store, vertex)?;
                store.release_claims();
                return Ok(if committed { Insertion::Inserted } else { Insertion::NoRoom });
            }
            Outcome::ClaimLost => {
                store.release_claims();
                return Ok(Insertion::ClaimLost);
            }
            _ => {}
        }
    }
    let mut outcome = plan_insertion(store, snapped, vertex, &AnyPositive, &mut reconnector.scratch);
    if outcome != Outcome::Accepted && outcome != Outcome::ClaimLost && snapped != feature {
        outcome = plan_insertion(store, feature, vertex, &AnyPositive, &mut reconnector.scratch);
    }
    let result = match outcome {
        Outcome::Accepted => {
            if !reconnector.commit(store)? {
                store.release_claims();
                return Ok(Insertion::NoRoom);
            }
            store.release_claims();
            reconnector.reconnect_around(store, vertex)?;
            Insertion::Inserted
        }
        Outcome::ClaimLost => Insertion::ClaimLost,
        _ if matches!(feature, Feature::Vertex(_)) => Insertion::TooClose,
        _ => Insertion::Outside,
    };
    store.release_claims();
    Ok(result)
}
