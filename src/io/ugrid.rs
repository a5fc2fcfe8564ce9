//! UGRID grids: text `.ugrid`, streams `.b8.ugrid` and `.lb8.ugrid`, with a `.mapbc` of the patches beside them.
//!
//! # Method
//! Seven counts, coordinates, triangles, quadrilaterals, a tag per face, then tets, pyramids, wedges, hexahedra; all
//! numbers from 1. Only outer faces are written, outward.
//!
//! # Source
//! [UGRID].
//!
//! # Limits
//! Linear elements. Labels have no place in this format; the tags are those of the boundary.

use std::io::Write;
use std::path::Path;

use glam::DVec3;

use super::file_mesh::{FileMesh, cell};
use super::text_scan::{TextScan, read_whole};
use super::voxel_stream::ByteOrder;
use super::{MeshFormat, WriteOptions, signs, write_atomically};
use crate::error::{Error, Result};
use crate::index::VertexId;
use crate::mesh::mixed_mesh::MixedMesh;
use crate::mesh::surface_mesh::PatchRole;

/// Elements in the order of the file: VTK type and, for each place in a row, the VTK node. The apex of a pyramid is
/// the third node; the triangles of a wedge turn the other way round than VTK's.
const ELEMENTS: [(u8, &[usize]); 4] =
    [(10, &[0, 1, 2, 3]), (14, &[1, 0, 4, 2, 3]), (13, &[0, 2, 1, 3, 5, 4]), (12, &[0, 1, 2, 3, 4, 5, 6, 7])];

/// Numbers of FUN3D's boundary conditions.
const CONDITIONS: [(PatchRole, i32); 5] = [
    (PatchRole::Symmetry, 6662),
    (PatchRole::Farfield, 5000),
    (PatchRole::Inlet, 7011),
    (PatchRole::Outlet, 7012),
    (PatchRole::Wall, 4000),
];

/// The number of a boundary condition.
fn condition_of(role: PatchRole) -> i32 {
    CONDITIONS.iter().find(|(r, _)| *r == role).map_or(4000, |(_, number)| *number)
}

/// Numbers of one encoding.
struct Numbers<'a> {
    out: &'a mut dyn Write,
    order: Option<ByteOrder>,
}

impl Numbers<'_> {
    fn ints(&mut self, values: &[i32]) -> std::io::Result<()> {
        match self.order {
            None => {
                let words: Vec<String> = values.iter().map(i32::to_string).collect();
                writeln!(self.out, "{}", words.join(" "))
            }
            Some(ByteOrder::Little) => values.iter().try_for_each(|v| self.out.write_all(&v.to_le_bytes())),
            Some(ByteOrder::Big) => values.iter().try_for_each(|v| self.out.write_all(&v.to_be_bytes())),
        }
    }

    fn point(&mut self, point: DVec3) -> std::io::Result<()> {
        match self.order {
            None => writeln!(self.out, "{} {} {}", point.x, point.y, point.z),
            Some(ByteOrder::Little) => point.to_array().iter().try_for_each(|v| self.out.write_all(&v.to_le_bytes())),
            Some(ByteOrder::Big) => point.to_array().iter().try_for_each(|v| self.out.write_all(&v.to_be_bytes())),
        }
    }

    fn row(&mut self, nodes: &[VertexId], order: &[usize]) -> std::io::Result<()> {
        let mut row = [0; 8];
        order.iter().enumerate().for_each(|(i, &place)| row[i] = nodes[place].0 as i32 + 1);
        self.ints(&row[..order.len()])
    }
}

/// Writes a grid whose boundary is filled, and its `.mapbc`.
///
/// # Errors
/// [`Error::Io`]; [`Error::Unsupported`] for quadratic elements.
pub fn write(mesh: &MixedMesh, path: &Path, format: MeshFormat, options: &WriteOptions) -> Result<()> {
    super::refuse_quadratic(mesh, "UGRID")?;
    let order = match format {
        MeshFormat::UgridBig => Some(ByteOrder::Big),
        MeshFormat::UgridLittle => Some(ByteOrder::Little),
        _ => None,
    };
    let boundary = &mesh.boundary;
    let outer = super::outer_faces(mesh);
    let tags = super::medit::face_tags(mesh);
    let triangles: Vec<usize> = outer.iter().copied().filter(|&f| f < boundary.triangles.len()).collect();
    let quads: Vec<usize> = outer.iter().copied().filter(|&f| f >= boundary.triangles.len()).collect();
    let count = |kind: u8| mesh.types.iter().filter(|&&t| t == kind).count() as i32;
    let signs = signs(mesh.space, options);
    write_atomically(path, |out| {
        let mut numbers = Numbers { out, order };
        let head = [mesh.points.len() as i32, triangles.len() as i32, quads.len() as i32];
        let counts: Vec<i32> = head.into_iter().chain(ELEMENTS.iter().map(|(kind, _)| count(*kind))).collect();
        numbers.ints(&counts)?;
        mesh.points.iter().try_for_each(|&p| numbers.point(p * signs))?;
        triangles.iter().try_for_each(|&f| numbers.row(&boundary.triangles[f], &[0, 1, 2]))?;
        let first_quad = boundary.triangles.len();
        quads.iter().try_for_each(|&f| numbers.row(&boundary.quads[f - first_quad], &[0, 1, 2, 3]))?;
        triangles.iter().chain(&quads).try_for_each(|&f| numbers.ints(&[tags[f]]))?;
        for (kind, order) in ELEMENTS {
            for element in (0..mesh.element_count()).filter(|&i| mesh.types[i] == kind) {
                numbers.row(mesh.element(element).1, order)?;
            }
        }
        Ok(())
    })?;
    write_conditions(mesh, &outer, &tags, path, options)
}

/// The `.mapbc`: tag, boundary condition, name.
fn write_conditions(
    mesh: &MixedMesh,
    outer: &[usize],
    tags: &[i32],
    path: &Path,
    options: &WriteOptions,
) -> Result<()> {
    let mut used: Vec<i32> = outer.iter().map(|&f| tags[f]).collect();
    used.sort_unstable();
    used.dedup();
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let stem = [".b8.ugrid", ".lb8.ugrid", ".ugrid"].iter().find_map(|e| name.strip_suffix(e)).unwrap_or(&name);
    write_atomically(&path.with_file_name(format!("{stem}.mapbc")), |out| {
        writeln!(out, "{}", used.len())?;
        for tag in used {
            let patch = options.patches.iter().find(|p| p.id == tag);
            let role = patch.map_or(PatchRole::Wall, |p| p.role);
            writeln!(out, "{tag} {} {}", condition_of(role), super::patch_name(mesh, options, tag))?;
        }
        Ok(())
    })
}

/// Reads numbers of one encoding.
struct Source {
    scan: TextScan,
    order: Option<ByteOrder>,
}

impl Source {
    fn raw<const N: usize>(&mut self) -> Result<[u8; N]> {
        let at = self.scan.position();
        let Some(slice) = self.scan.bytes().get(at..at + N) else {
            return Err(Error::format(self.scan.path(), format!("byte {at}: the file ends in the middle of the grid")));
        };
        let mut raw: [u8; N] = slice.try_into().expect("the slice has N bytes");
        self.scan.seek(at + N);
        if self.order == Some(ByteOrder::Big) {
            raw.reverse();
        }
        Ok(raw)
    }

    fn int(&mut self) -> Result<i64> {
        match self.order {
            None => self.scan.integer(),
            Some(_) => self.raw().map(|r| i64::from(i32::from_le_bytes(r))),
        }
    }

    fn real(&mut self) -> Result<f64> {
        match self.order {
            None => self.scan.real(),
            Some(_) => self.raw().map(f64::from_le_bytes),
        }
    }
}

/// Reads a grid.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] with the line or byte.
pub fn read(path: &Path, format: MeshFormat) -> Result<FileMesh> {
    let order = match format {
        MeshFormat::UgridBig => Some(ByteOrder::Big),
        MeshFormat::UgridLittle => Some(ByteOrder::Little),
        _ => None,
    };
    let mut source = Source { scan: TextScan::new(read_whole(path)?, path, 0), order };
    let mut counts = [0; 7];
    for count in &mut counts {
        *count = source.int()?;
    }
    let words = [3, 4, 5, 4, 5, 6, 8];
    for (count, row) in counts.iter().zip(words) {
        source.scan.believable(*count, "rows", 2 * row)?;
    }
    let mut mesh = FileMesh::new();
    for _ in 0..counts[0] {
        mesh.points.push(DVec3::new(source.real()?, source.real()?, source.real()?));
    }
    let faces: [(u8, i64, &[usize]); 2] =
        [(cell::TRIANGLE, counts[1], &[0, 1, 2]), (cell::QUAD, counts[2], &[0, 1, 2, 3])];
    for (kind, count, order) in faces {
        read_rows(&mut source, &mut mesh, kind, count, order)?;
    }
    for face in 0..mesh.types.len() {
        mesh.tags[face] = source.int()? as i32;
    }
    for ((kind, order), count) in ELEMENTS.into_iter().zip(counts[3..].iter()) {
        read_rows(&mut source, &mut mesh, kind, *count, order)?;
    }
    Ok(mesh)
}

fn read_rows(source: &mut Source, mesh: &mut FileMesh, kind: u8, count: i64, order: &[usize]) -> Result<()> {
    let mut row = [0; 8];
    for _ in 0..count {
        for &place in order {
            row[place] = source.int()? - 1;
        }
        // The format has no labels: every element is of label 1.
        mesh.push(kind, row[..order.len()].iter().copied(), 1);
    }
    Ok(())
}
