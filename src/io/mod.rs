//! Files: thin adapters over well-kept crates where one exists, own code only for formats without one.
//!
//! # Method
//! The format follows from the file's name, for images also from its first bytes. Readers check every size that a
//! header claims against the file before they allocate. Writers write beside the target and rename, so that a file
//! appears whole or not at all.
//!
//! # Invariants
//! Images are read and written in LPS millimetres. Meshes keep the frame that their file states.

mod aflr;
mod atomic_file;
#[cfg(test)]
mod count_tests;
mod file_mesh;
mod gmsh_reader;
mod gmsh_writer;
mod medit;
mod metaimage;
mod nifti;
mod nrrd;
mod obj;
mod off;
mod openfoam;
mod ply;
mod polygon;
mod stl;
mod su2;
mod surface_export;
mod tetgen;
mod text_scan;
mod ugrid;
mod voxel_stream;
mod vtk_legacy_reader;
mod vtk_legacy_writer;
mod vtk_xml_reader;
mod vtk_xml_writer;

use std::io::Read;
use std::path::Path;

pub use atomic_file::{check_writable, write_atomically};
pub use surface_export::{SurfaceExport, SurfaceSelection, label_pairs};

use glam::DVec3;

use crate::error::{Error, Result};
use crate::image::voxel_image::VoxelImage;
use crate::index::VertexId;
use crate::mesh::boundary::{extract_boundary, face_pairs, faces_of};
use crate::mesh::mixed_mesh::{BoundaryFaces, MixedMesh, Space};
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
    match image_format(path).map_or_else(|| sniff_image(path), Ok)? {
        ImageFormat::Nifti => nifti::read(path),
        ImageFormat::Nrrd => nrrd::read(path),
        ImageFormat::MetaImage => metaimage::read(path),
    }
}

/// Writes an image in the format of the file's name.
///
/// # Errors
/// [`Error::Io`], [`Error::Unsupported`] for an unknown ending.
pub fn write_image(image: &VoxelImage, path: &Path) -> Result<()> {
    match image_format(path) {
        Some(ImageFormat::Nifti) => nifti::write(image, path),
        Some(ImageFormat::Nrrd) => nrrd::write(image, path),
        Some(ImageFormat::MetaImage) => metaimage::write(image, path),
        None => Err(Error::Unsupported {
            reason: format!("{}: images are written as {}", path.display(), IMAGE_EXTENSIONS.join(" ")),
        }),
    }
}

/// Endings of image files.
pub const IMAGE_EXTENSIONS: &[&str] = &[".nii.gz", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd", ".hdr", ".img"];

#[derive(Debug, Clone, Copy)]
enum ImageFormat {
    Nifti,
    Nrrd,
    MetaImage,
}

fn lower_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().to_lowercase()
}

fn image_format(path: &Path) -> Option<ImageFormat> {
    let name = lower_name(path);
    let ends = |endings: &[&str]| endings.iter().any(|e| name.ends_with(e));
    if ends(&[".nii", ".nii.gz", ".hdr", ".img", ".hdr.gz", ".img.gz"]) {
        Some(ImageFormat::Nifti)
    } else if ends(&[".nrrd", ".nhdr"]) {
        Some(ImageFormat::Nrrd)
    } else if ends(&[".mha", ".mhd"]) {
        Some(ImageFormat::MetaImage)
    } else {
        None
    }
}

/// Whether the name is that of an image file.
pub fn is_image_path(path: &Path) -> bool {
    image_format(path).is_some()
}

/// The format of a file whose name says nothing.
fn sniff_image(path: &Path) -> Result<ImageFormat> {
    let (file, _) = atomic_file::open(path)?;
    let mut start = Vec::new();
    file.take(348).read_to_end(&mut start).map_err(|source| Error::io(path, source))?;
    if start.starts_with(b"NRRD") {
        Ok(ImageFormat::Nrrd)
    } else if start.starts_with(&[0x1f, 0x8b])
        || [348, 540].iter().any(|&n: &i32| start.starts_with(&n.to_le_bytes()) || start.starts_with(&n.to_be_bytes()))
    {
        Ok(ImageFormat::Nifti)
    } else if start.starts_with(b"ObjectType") || start.starts_with(b"NDims") {
        Ok(ImageFormat::MetaImage)
    } else {
        Err(Error::format(path, format!("no known image: {} are read", IMAGE_EXTENSIONS.join(" "))))
    }
}

/// Applies `$body` to the typed vector of `$data` and wraps the result in the same variant.
macro_rules! map_voxels {
    ($data:expr, $values:ident => $body:expr) => {
        match $data {
            VoxelData::U8($values) => VoxelData::U8($body),
            VoxelData::I8($values) => VoxelData::I8($body),
            VoxelData::U16($values) => VoxelData::U16($body),
            VoxelData::I16($values) => VoxelData::I16($body),
            VoxelData::U32($values) => VoxelData::U32($body),
            VoxelData::I32($values) => VoxelData::I32($body),
            VoxelData::U64($values) => VoxelData::U64($body),
            VoxelData::I64($values) => VoxelData::I64($body),
            VoxelData::F32($values) => VoxelData::F32($body),
            VoxelData::F64($values) => VoxelData::F64($body),
        }
    };
}
use map_voxels;

/// Reads a surface.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] with the line or byte, [`Error::Unsupported`] for an unknown ending.
pub fn read_surface(path: &Path) -> Result<SurfaceMesh> {
    read_file_mesh(path)?.into_surface().map_err(|e| named(e, path))
}

/// What a mesh or surface file holds.
#[derive(Debug, Clone)]
pub enum Content {
    /// Volume elements.
    Mesh(MixedMesh),
    /// Triangles only, in the frame that the file states.
    Surface(SurfaceMesh, Space),
}

/// Reads a mesh, or a surface where the file has no volume element.
///
/// # Errors
/// As [`read_mesh`] and [`read_surface`].
pub fn read_content(path: &Path) -> Result<Content> {
    let file = read_file_mesh(path)?;
    if file.has_volume() {
        return Ok(Content::Mesh(file.into_mixed_mesh().map_err(|e| named(e, path))?));
    }
    let space = file.space;
    Ok(Content::Surface(file.into_surface().map_err(|e| named(e, path))?, space))
}

/// Whether the name is that of a mesh or surface file.
pub fn is_mesh_path(path: &Path) -> bool {
    MeshFormat::of_path(path).is_ok()
}

/// The error with the file's name in front.
fn named(error: Error, path: &Path) -> Error {
    match error {
        Error::InvalidInput { message, findings } => {
            Error::InvalidInput { message: format!("{}: {message}", path.display()), findings }
        }
        other => other,
    }
}

/// Reads any mesh or surface file.
fn read_file_mesh(path: &Path) -> Result<file_mesh::FileMesh> {
    match MeshFormat::of_path(path)? {
        MeshFormat::Vtu | MeshFormat::Vtp => vtk_xml_reader::read(path),
        MeshFormat::Vtk42 | MeshFormat::Vtk51 => vtk_legacy_reader::read(path),
        format @ (MeshFormat::Ugrid | MeshFormat::UgridBig | MeshFormat::UgridLittle) => ugrid::read(path, format),
        MeshFormat::Su2 => su2::read(path),
        MeshFormat::Msh22 | MeshFormat::Msh41 => gmsh_reader::read(path),
        MeshFormat::Medit | MeshFormat::MeditBinary => medit::read(path),
        MeshFormat::Off => off::read(path),
        MeshFormat::Obj => obj::read(path),
        MeshFormat::Stl => stl::read(path),
        MeshFormat::Ply => ply::read(path),
        MeshFormat::Surf => aflr::read(path),
        MeshFormat::Poly => tetgen::read(path, tetgen::FacetLists::Poly),
        MeshFormat::Smesh => tetgen::read(path, tetgen::FacetLists::Smesh),
        format => Err(Error::Unsupported { reason: format!("{}: {format:?} is not read", path.display()) }),
    }
}

/// Endings of mesh and surface files.
const MESH_ENDINGS: &[(&str, MeshFormat)] = &[
    (".vtu", MeshFormat::Vtu),
    (".vtp", MeshFormat::Vtp),
    (".vtk", MeshFormat::Vtk42),
    (".msh", MeshFormat::Msh41),
    (".mesh", MeshFormat::Medit),
    (".meshb", MeshFormat::MeditBinary),
    (".stl", MeshFormat::Stl),
    (".off", MeshFormat::Off),
    (".obj", MeshFormat::Obj),
    (".ply", MeshFormat::Ply),
    (".surf", MeshFormat::Surf),
    (".poly", MeshFormat::Poly),
    (".smesh", MeshFormat::Smesh),
    (".b8.ugrid", MeshFormat::UgridBig),
    (".lb8.ugrid", MeshFormat::UgridLittle),
    (".ugrid", MeshFormat::Ugrid),
    (".su2", MeshFormat::Su2),
    (".foam", MeshFormat::OpenFoam),
];

impl MeshFormat {
    /// The format that the ending of a name stands for.
    ///
    /// # Errors
    /// [`Error::Unsupported`] listing the endings.
    pub fn of_path(path: &Path) -> Result<Self> {
        let name = lower_name(path);
        MESH_ENDINGS.iter().find(|(ending, _)| name.ends_with(ending)).map(|(_, format)| *format).ok_or_else(|| {
            let known: Vec<&str> = MESH_ENDINGS.iter().map(|(ending, _)| *ending).collect();
            let reason = format!("{}: unknown ending; meshes and surfaces end in {}", path.display(), known.join(" "));
            Error::Unsupported { reason }
        })
    }

    /// Whether files of this format are written with volume elements; others of a mesh keep its surface alone.
    pub fn holds_elements(self) -> bool {
        match self {
            Self::Vtp | Self::Stl | Self::Off | Self::Obj | Self::Ply | Self::Surf | Self::Poly | Self::Smesh => false,
            Self::Vtu | Self::Vtk42 | Self::Vtk51 | Self::Msh22 | Self::Msh41 | Self::Medit | Self::MeditBinary => true,
            Self::Ugrid | Self::UgridBig | Self::UgridLittle | Self::Su2 | Self::OpenFoam => true,
        }
    }

    /// Whether their elements may have nodes on edges: those of flow solvers may not.
    pub fn holds_quadratic_elements(self) -> bool {
        let is_of_flow_solver =
            matches!(self, Self::Ugrid | Self::UgridBig | Self::UgridLittle | Self::Su2 | Self::OpenFoam);
        self.holds_elements() && !is_of_flow_solver
    }

    /// Whether files of this format are written with a surface and no volume element.
    pub fn holds_lone_surface(self) -> bool {
        match self {
            Self::Vtp | Self::Vtk42 | Self::Vtk51 | Self::Off | Self::Obj | Self::Ply | Self::Surf | Self::Stl => true,
            Self::Msh22 | Self::Msh41 | Self::Medit | Self::MeditBinary => true,
            Self::Vtu | Self::Poly | Self::Smesh => false,
            Self::Ugrid | Self::UgridBig | Self::UgridLittle | Self::Su2 | Self::OpenFoam => false,
        }
    }

    /// The endings of the formats that a test holds for, for messages.
    pub fn endings_of(test: impl Fn(Self) -> bool) -> String {
        let endings: Vec<&str> = MESH_ENDINGS.iter().filter(|(_, f)| test(*f)).map(|(ending, _)| *ending).collect();
        endings.join(" ")
    }
}

/// Writes a surface of no anatomical frame.
///
/// # Errors
/// [`Error::Io`], [`Error::Unsupported`].
pub fn write_surface(surface: &SurfaceMesh, path: &Path, options: &WriteOptions) -> Result<()> {
    write_surface_export(&SurfaceExport::of_surface(surface, Space::Unspecified), path, options)
}

/// Writes a surface with its arrays.
///
/// # Errors
/// [`Error::Io`], [`Error::Unsupported`] for a format that holds no lone surface.
pub fn write_surface_export(export: &SurfaceExport, path: &Path, options: &WriteOptions) -> Result<()> {
    let format = options.format.map_or_else(|| MeshFormat::of_path(path), Ok)?;
    let turned = in_frame(export, options);
    let surface = &turned.as_ref().unwrap_or(export).surface;
    match format {
        MeshFormat::Vtp => write_atomically(path, |out| vtk_xml_writer::write_vtp(export, options, out)),
        MeshFormat::Vtk42 | MeshFormat::Vtk51 => {
            write_atomically(path, |out| vtk_legacy_writer::write_surface(export, format, options, out))
        }
        MeshFormat::Off => write_atomically(path, |out| off::write(surface, out)),
        MeshFormat::Obj => write_atomically(path, |out| obj::write(surface, out)),
        MeshFormat::Ply => write_atomically(path, |out| ply::write(surface, options.encoding, out)),
        MeshFormat::Surf => write_atomically(path, |out| aflr::write(surface, out)),
        MeshFormat::Stl if options.encoding == Encoding::Ascii => {
            write_atomically(path, |out| stl::write_text(surface, out))
        }
        MeshFormat::Stl => {
            let space = space_name(options.space.unwrap_or(export.space));
            let title = space.map_or("Meshwright".to_owned(), |name| format!("Meshwright SPACE={name}"));
            write_atomically(path, |out| stl::write_binary(surface, &title, out))
        }
        MeshFormat::Msh22 | MeshFormat::Msh41 | MeshFormat::Medit | MeshFormat::MeditBinary => {
            let lone = mesh_of_surface(export);
            let options = WriteOptions { patches: surface.patches.clone(), ..options.clone() };
            write_mesh(&lone, path, &options)
        }
        _ => Err(Error::Unsupported { reason: format!("{}: {format:?} holds no lone surface", path.display()) }),
    }
}

/// A mesh of boundary triangles only.
fn mesh_of_surface(export: &SurfaceExport) -> MixedMesh {
    let surface = &export.surface;
    let boundary = BoundaryFaces {
        triangles: surface.facets.clone(),
        labels: vec![[0, 0]; surface.facets.len()],
        elements: vec![[-1, -1]; surface.facets.len()],
        patches: surface.facet_patches.clone(),
        ..BoundaryFaces::default()
    };
    MixedMesh {
        points: surface.points.clone(),
        offsets: vec![0],
        boundary,
        space: export.space,
        ..MixedMesh::default()
    }
}

/// A copy in the frame that was asked for; `None` where nothing changes.
fn in_frame(export: &SurfaceExport, options: &WriteOptions) -> Option<SurfaceExport> {
    let signs = signs(export.space, options);
    (signs != DVec3::ONE).then(|| {
        let mut turned = export.clone();
        turned.surface.points.iter_mut().for_each(|p| *p *= signs);
        turned
    })
}

/// Signs that turn the coordinates of `from` into the frame that was asked for. A turn by half about the third axis:
/// orientations stay.
fn signs(from: Space, options: &WriteOptions) -> DVec3 {
    match (from, options.space.unwrap_or(from)) {
        (Space::Lps, Space::Ras) | (Space::Ras, Space::Lps) => DVec3::new(-1.0, -1.0, 1.0),
        _ => DVec3::ONE,
    }
}

/// The name of a frame in files.
fn space_name(space: Space) -> Option<&'static str> {
    match space {
        Space::Lps => Some("LPS"),
        Space::Ras => Some("RAS"),
        Space::Unspecified => None,
    }
}

/// Reads a mesh.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] with the line or byte, [`Error::Unsupported`] for an unknown ending.
pub fn read_mesh(path: &Path) -> Result<MixedMesh> {
    read_file_mesh(path)?.into_mixed_mesh().map_err(|e| named(e, path))
}

/// Writes a mesh.
///
/// # Errors
/// [`Error::Io`], [`Error::Unsupported`].
pub fn write_mesh(mesh: &MixedMesh, path: &Path, options: &WriteOptions) -> Result<()> {
    let format = options.format.map_or_else(|| MeshFormat::of_path(path), Ok)?;
    match format {
        MeshFormat::Vtu => write_atomically(path, |out| vtk_xml_writer::write_vtu(mesh, options, out)),
        MeshFormat::Vtk42 | MeshFormat::Vtk51 => {
            write_atomically(path, |out| vtk_legacy_writer::write_mesh(mesh, format, options, out))
        }
        MeshFormat::Vtp | MeshFormat::Stl | MeshFormat::Off | MeshFormat::Obj | MeshFormat::Ply | MeshFormat::Surf => {
            let with_boundary = with_boundary(mesh);
            let export = SurfaceExport::of_mesh(with_boundary.as_ref().unwrap_or(mesh), SurfaceSelection::All)?;
            write_surface_export(&export, path, options)
        }
        MeshFormat::Msh22 | MeshFormat::Msh41 | MeshFormat::Medit | MeshFormat::MeditBinary => {
            let with_boundary = if options.surfaces == Surfaces::Include { with_boundary(mesh) } else { None };
            let mesh = with_boundary.as_ref().unwrap_or(mesh);
            if matches!(format, MeshFormat::Medit | MeshFormat::MeditBinary) {
                write_atomically(path, |out| medit::write(mesh, format, options, out))
            } else {
                write_atomically(path, |out| gmsh_writer::write(mesh, format, options, out))
            }
        }
        MeshFormat::Ugrid | MeshFormat::UgridBig | MeshFormat::UgridLittle => {
            let with_boundary = with_boundary(mesh);
            ugrid::write(with_boundary.as_ref().unwrap_or(mesh), path, format, options)
        }
        MeshFormat::Su2 => {
            refuse_quadratic(mesh, "SU2")?;
            let with_boundary = with_boundary(mesh);
            write_atomically(path, |out| su2::write(with_boundary.as_ref().unwrap_or(mesh), options, out))
        }
        MeshFormat::OpenFoam => {
            let with_boundary = with_boundary(mesh);
            openfoam::write(with_boundary.as_ref().unwrap_or(mesh), path, options)
        }
        MeshFormat::Poly | MeshFormat::Smesh => {
            Err(Error::Unsupported { reason: format!("{}: {format:?} is not written", path.display()) })
        }
    }
}

/// Formats of flow solvers hold linear elements only.
fn refuse_quadratic(mesh: &MixedMesh, format: &str) -> Result<()> {
    if mesh.types.iter().any(|&t| t > 20) {
        return Err(Error::Unsupported { reason: format!("{format} holds linear elements only") });
    }
    Ok(())
}

/// Boundary faces with nothing on their other side, triangles first. Faces read from a file do not know their sides:
/// then those that occur in one element count.
fn outer_faces(mesh: &MixedMesh) -> Vec<usize> {
    let boundary = &mesh.boundary;
    let faces = boundary.triangles.len() + boundary.quads.len();
    if boundary.elements.iter().any(|e| e[0] >= 0) {
        return (0..faces).filter(|&f| boundary.elements[f].contains(&-1)).collect();
    }
    let key = |corners: &[VertexId]| {
        let mut key: Vec<u32> = corners.iter().map(|v| v.0).collect();
        key.sort_unstable();
        key
    };
    let outer: rustc_hash::FxHashSet<Vec<u32>> = face_pairs(mesh)
        .into_iter()
        .filter(|pair| pair.neighbor < 0)
        .map(|pair| {
            let (kind, vertices) = mesh.element(pair.element as usize);
            key(&faces_of(kind)[pair.face as usize].iter().map(|&c| vertices[c]).collect::<Vec<_>>())
        })
        .collect();
    let corners = |f: usize| -> &[VertexId] {
        if f < boundary.triangles.len() {
            &boundary.triangles[f]
        } else {
            &boundary.quads[f - boundary.triangles.len()]
        }
    };
    (0..faces).filter(|&f| outer.contains(&key(corners(f)))).collect()
}

/// The name of a patch, or of the pair of labels that stands for it.
fn patch_name(mesh: &MixedMesh, options: &WriteOptions, tag: i32) -> String {
    let named = options.patches.iter().find(|p| p.id == tag && !p.name.is_empty());
    let plain = |name: &str| name.replace(|c: char| c.is_whitespace() || "(){};\"".contains(c), "_");
    match named {
        Some(patch) => plain(&patch.name),
        None if mesh.boundary.patches.is_empty() => label_pairs(mesh)
            .get((tag - 1).max(0) as usize)
            .map_or_else(|| format!("patch_{tag}"), |p| format!("surface_{}_{}", p[0], p[1])),
        None => format!("patch_{tag}"),
    }
}

/// The mesh with its boundary where it has none yet.
fn with_boundary(mesh: &MixedMesh) -> Option<MixedMesh> {
    let bare = mesh.boundary.triangles.is_empty() && mesh.boundary.quads.is_empty();
    bare.then(|| MixedMesh { boundary: extract_boundary(mesh), ..mesh.clone() })
}
