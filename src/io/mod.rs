//! Files: thin adapters over well-kept crates where one exists, own code only for formats without one.
//!
//! # Method
//! The format follows from the file's name, for images also from its first bytes. Readers check every size that a
//! header claims against the file before they allocate. Writers write beside the target and rename, so that a file
//! appears whole or not at all.
//!
//! # Invariants
//! Images are read and written in LPS millimetres. Meshes keep the frame that their file states.

use std::path::Path;

use crate::error::{Error, Result};
use crate::image::voxel_image::VoxelImage;
use crate::mesh::mixed_mesh::{MixedMesh, Space};
use crate::mesh::surface_mesh::{Patch, SurfaceMesh};

/// A format of mesh and surface files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeshFormat {
    /// VTK XML unstructured grid, `.vtu`.
    Vtu,
    /// VTK XML poly data, `.vtp`: surfaces.
    Vtp,
    /// Legacy VTK file version 4.2, `.vtk`.
    Vtk42,
    /// Legacy VTK file version 5.1, `.vtk`.
    Vtk51,
    /// Gmsh version 2.2, `.msh`.
    Msh22,
    /// Gmsh version 4.1, `.msh`.
    Msh41,
    /// MEDIT text, `.mesh`.
    Medit,
    /// MEDIT binary, `.meshb`.
    MeditBinary,
    /// Stereolithography, `.stl`: surfaces.
    Stl,
    /// Geomview, `.off`: surfaces.
    Off,
    /// Wavefront, `.obj`: surfaces.
    Obj,
    /// Polygon file, `.ply`: surfaces.
    Ply,
    /// AFLR surface, `.surf`.
    Surf,
    /// TetGen piecewise linear complex, `.poly`.
    Poly,
    /// TetGen piecewise linear complex, `.smesh`.
    Smesh,
    /// UGRID text, `.ugrid`.
    Ugrid,
    /// UGRID, big-endian stream, `.b8.ugrid`.
    UgridBig,
    /// UGRID, little-endian stream, `.lb8.ugrid`.
    UgridLittle,
    /// SU2, `.su2`.
    Su2,
    /// OpenFOAM case folder with `constant/polyMesh`.
    OpenFoam,
}

/// Whether numbers are written as text or as bytes, where a format has both.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Encoding {
    /// Bytes: small and fast.
    #[default]
    Binary,
    /// Text, with as many digits as bring the same number back.
    Ascii,
}

/// Whether blocks are compressed, where a format can.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Compression {
    /// As they are: fast.
    #[default]
    None,
    /// zlib.
    Zlib,
}

/// Whether boundary triangles are written beside the elements, where a format has both.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Surfaces {
    /// Written, tagged by label pair or patch.
    #[default]
    Include,
    /// Left out.
    Omit,
}

/// How a mesh is written.
#[derive(Debug, Clone, Default)]
pub struct WriteOptions {
    /// The format; by default that of the file's name.
    pub format: Option<MeshFormat>,
    /// The frame of the coordinates in the file; by default that of the mesh.
    pub space: Option<Space>,
    /// Text or bytes.
    pub encoding: Encoding,
    /// Compressed blocks.
    pub compression: Compression,
    /// Boundary triangles.
    pub surfaces: Surfaces,
    /// Names and roles of the patches of `MixedMesh::boundary`, for the formats of flow solvers.
    pub patches: Vec<Patch>,
}

/// Reads an image: NIfTI, NRRD or MetaImage.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] saying what is wrong, [`Error::OutOfMemory`].
pub fn read_image(path: &Path) -> Result<VoxelImage> {
    Err(Error::Unsupported { reason: format!("{}: reading images", path.display()) })
}

/// Writes an image in the format of the file's name.
///
/// # Errors
/// [`Error::Io`], [`Error::Unsupported`] for an unknown ending.
pub fn write_image(_image: &VoxelImage, path: &Path) -> Result<()> {
    Err(Error::Unsupported { reason: format!("{}: writing images", path.display()) })
}

/// Reads a surface.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] with the line or byte, [`Error::Unsupported`] for an unknown ending.
pub fn read_surface(path: &Path) -> Result<SurfaceMesh> {
    Err(Error::Unsupported { reason: format!("{}: reading surfaces", path.display()) })
}

/// Writes a surface.
///
/// # Errors
/// [`Error::Io`], [`Error::Unsupported`].
pub fn write_surface(_surface: &SurfaceMesh, path: &Path, _options: &WriteOptions) -> Result<()> {
    Err(Error::Unsupported { reason: format!("{}: writing surfaces", path.display()) })
}

/// Reads a mesh.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] with the line or byte, [`Error::Unsupported`] for an unknown ending.
pub fn read_mesh(path: &Path) -> Result<MixedMesh> {
    Err(Error::Unsupported { reason: format!("{}: reading meshes", path.display()) })
}

/// Writes a mesh.
///
/// # Errors
/// [`Error::Io`], [`Error::Unsupported`].
pub fn write_mesh(_mesh: &MixedMesh, path: &Path, _options: &WriteOptions) -> Result<()> {
    Err(Error::Unsupported { reason: format!("{}: writing meshes", path.display()) })
}
