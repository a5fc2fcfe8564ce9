//! A triangulated surface: the input of the surface engine, and extracted boundaries.
//!
//! # Method
//! Points and facets as arrays; a patch id per facet, a role and a name per patch; seeds of regions and holes. It is a
//! piecewise linear complex: several components, nesting, internal and non-manifold sheets are allowed. Nothing is
//! checked here beyond shape; `conforming::input_check` finds what is wrong with the geometry.

use glam::DVec3;

use crate::error::{Error, Result};
use crate::index::VertexId;

/// What a patch of the surface is for; names follow CFD practice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PatchRole {
    /// Solid wall: the default.
    #[default]
    Wall,
    /// Wall with boundary-layer spacing.
    WallBoundaryLayer,
    /// Symmetry plane.
    Symmetry,
    /// Far field.
    Farfield,
    /// Transparent sheet inside the volume, kept exactly.
    Embedded,
    /// Only a source of sizes; not part of the mesh.
    Source,
    /// Interface between two regions, kept exactly.
    Internal,
    /// Boundary whose triangulation nothing may change.
    Fixed,
    /// Inflow.
    Inlet,
    /// Outflow.
    Outlet,
}

impl PatchRole {
    const NAMES: [(Self, &'static str); 10] = [
        (Self::Wall, "wall"),
        (Self::WallBoundaryLayer, "wall_bl"),
        (Self::Symmetry, "symmetry"),
        (Self::Farfield, "farfield"),
        (Self::Embedded, "embedded"),
        (Self::Source, "source"),
        (Self::Internal, "internal"),
        (Self::Fixed, "fixed"),
        (Self::Inlet, "inlet"),
        (Self::Outlet, "outlet"),
    ];

    /// The role of a name; `transparent` is another name of `embedded`.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] listing the names.
    pub fn from_name(name: &str) -> Result<Self> {
        let lower = name.to_lowercase();
        let lower = if lower == "transparent" { "embedded" } else { lower.as_str() };
        Self::NAMES.iter().find(|(_, n)| *n == lower).map(|(role, _)| *role).ok_or_else(|| {
            let names: Vec<_> = Self::NAMES.iter().map(|(_, n)| *n).collect();
            Error::argument("role", format!("'{name}' is none of {}", names.join(", ")))
        })
    }

    /// The name of the role.
    pub fn name(self) -> &'static str {
        Self::NAMES.iter().find(|(role, _)| *role == self).map_or("wall", |(_, n)| n)
    }
}

/// A patch of facets.
#[derive(Debug, Clone, PartialEq)]
pub struct Patch {
    /// Id that the facets carry.
    pub id: i32,
    /// What it is for.
    pub role: PatchRole,
    /// Name for writers; may be empty.
    pub name: String,
}

/// A point that gives the region around it a label and a size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RegionSeed {
    /// A point strictly inside the region.
    pub point: DVec3,
    /// Label of its elements.
    pub label: i32,
    /// Largest edge length wanted in it; `None` for no limit.
    pub size: Option<f64>,
}

/// A surface triangulation or piecewise linear complex.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SurfaceMesh {
    /// Coordinates as given, bit for bit.
    pub points: Vec<DVec3>,
    /// `n x 3` vertices.
    pub facets: Vec<[VertexId; 3]>,
    /// Patch id per facet; same length as `facets`.
    pub facet_patches: Vec<i32>,
    /// Patches with a role or name; ids not listed are walls without a name.
    pub patches: Vec<Patch>,
    /// Regions with label and size.
    pub regions: Vec<RegionSeed>,
    /// Points in cavities that stay empty.
    pub holes: Vec<DVec3>,
}

impl SurfaceMesh {
    /// A surface of one patch 0.
    pub fn new(points: Vec<DVec3>, facets: Vec<[VertexId; 3]>) -> Self {
        let facet_patches = vec![0; facets.len()];
        Self { points, facets, facet_patches, ..Self::default() }
    }

    /// The role of a patch id.
    pub fn role_of(&self, patch: i32) -> PatchRole {
        self.patches.iter().find(|p| p.id == patch).map_or(PatchRole::Wall, |p| p.role)
    }

    /// The patch record of an id, made where there is none yet.
    pub fn patch_mut(&mut self, id: i32) -> &mut Patch {
        let position = self.patches.iter().position(|p| p.id == id).unwrap_or_else(|| {
            self.patches.push(Patch { id, role: PatchRole::Wall, name: String::new() });
            self.patches.len() - 1
        });
        &mut self.patches[position]
    }
}
