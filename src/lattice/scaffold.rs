//! The background elements around the mesh, which keep its surface from running through itself while it is smoothed.
//!
//! # Method
//! The lattice fills the background too. Those of its background elements that share a vertex with a labelled one are kept
//! until smoothing is over. Their vertices that no labelled element has stay where they are; all elements, labelled or not,
//! stay positive. A map that keeps every element positive and the outermost vertices in place is one to one: no two parts
//! of the surface can pass through each other, however thin the background between them.
//!
//! # Source
//! [Jiang2017]; there for maps in the plane.
//!
//! # Differences
//! The lattice leaves out what can hold no labelled voxel, so there are places without a scaffold, as wide as the coarsest
//! elements; what crosses there all the same is found by `overlap_removal`.
//!
//! # Invariants
//! Scaffold elements have no part in the result. Their shape counts `SCAFFOLD_WEIGHT` times milder than that of others.

use glam::DVec3;

use crate::index::{Label, VertexId};

/// Score of a scaffold element counts this many times: an angle of 1.5 degrees is as good as one of 15 elsewhere. They need
/// to be positive, no more.
pub const SCAFFOLD_WEIGHT: f64 = 10.0;

/// Background elements around a mesh.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Scaffold {
    /// Vertices that no element of the mesh has, local frame, mm. They do not move.
    pub points: Vec<DVec3>,
    /// `n x 4` vertices, positive orientation: those of the mesh, then `points`.
    pub tets: Vec<[VertexId; 4]>,
}

impl Scaffold {
    /// Where a vertex of an element lies; `points` are those of the mesh.
    pub fn place(&self, points: &[DVec3], v: VertexId) -> DVec3 {
        points.get(v.index()).copied().unwrap_or_else(|| self.points[v.index() - points.len()])
    }

    /// The background elements with a vertex of the mesh. `renumbered` holds the number in the mesh of each vertex,
    /// `u32::MAX` where it has none, and `count` such numbers are in use.
    pub fn around(
        tets: &[[u32; 4]],
        labels: &[Label],
        renumbered: &mut [u32],
        count: usize,
        place: impl Fn(u32) -> DVec3,
    ) -> Self {
        let mut scaffold = Self::default();
        let is_of_mesh = |v: u32| (v as usize) < count;
        let background = tets.iter().zip(labels).filter(|(_, label)| label.is_background());
        for (tet, _) in background {
            if !tet.iter().any(|v| is_of_mesh(renumbered[*v as usize])) {
                continue;
            }
            scaffold.tets.push(tet.map(|v| {
                let slot = &mut renumbered[v as usize];
                if *slot == u32::MAX {
                    *slot = (count + scaffold.points.len()) as u32;
                    scaffold.points.push(place(v));
                }
                VertexId(*slot)
            }));
        }
        scaffold
    }
}
