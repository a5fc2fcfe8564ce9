//! Writes Gmsh `.msh` files, versions 2.2 and 4.1, text and bytes.
//!
//! # Method
//! A label is a physical volume and an elementary volume of the same number; a patch or a pair of labels is a physical
//! and an elementary surface with a name. Arrays on points and elements follow as node and element data.
//!
//! # Source
//! [Gmsh] section 10.1.
//!
//! # Differences
//! Gmsh numbers the mid-edge nodes of quadratic elements otherwise than VTK, and the triangles of its wedges turn the
//! other way; [`node_order`] says how.

use std::io::Write;

use glam::DVec3;

use super::file_mesh::cell;
use super::{Encoding, MeshFormat, Surfaces, WriteOptions, signs};
use crate::index::VertexId;
use crate::mesh::mixed_mesh::{ArrayData, ElementKind, MixedMesh, NamedArray};

/// Gmsh's element type and, for each of its nodes, the VTK node.
pub(super) fn node_order(vtk_type: u8) -> Option<(i32, &'static [usize])> {
    Some(match vtk_type {
        cell::LINE => (1, &[0, 1]),
        cell::TRIANGLE => (2, &[0, 1, 2]),
        cell::QUAD => (3, &[0, 1, 2, 3]),
        10 => (4, &[0, 1, 2, 3]),
        12 => (5, &[0, 1, 2, 3, 4, 5, 6, 7]),
        13 => (6, &[0, 2, 1, 3, 5, 4]),
        14 => (7, &[0, 1, 2, 3, 4]),
        cell::QUADRATIC_TRIANGLE => (9, &[0, 1, 2, 3, 4, 5]),
        24 => (11, &[0, 1, 2, 3, 4, 5, 6, 7, 9, 8]),
        25 => (17, &[0, 1, 2, 3, 4, 5, 6, 7, 8, 11, 16, 9, 17, 10, 18, 19, 12, 15, 13, 14]),
        _ => return None,
    })
}

/// Cells of one kind and one entity.
struct Group<'a> {
    dimension: i32,
    entity: i32,
    vtk_type: u8,
    rows: Vec<&'a [VertexId]>,
    /// The element whose values belong to each row; for a face the one inside.
    elements: Vec<Option<usize>>,
}

/// The output with what holds for all of it.
struct Gmsh<'a> {
    out: &'a mut dyn Write,
    text: bool,
}

/// Writes a mesh.
///
/// # Errors
/// Those of the writer.
pub fn write(mesh: &MixedMesh, format: MeshFormat, options: &WriteOptions, out: &mut dyn Write) -> std::io::Result<()> {
    let tags = if options.surfaces == Surfaces::Include { super::medit::face_tags(mesh) } else { Vec::new() };
    let groups = groups_of(mesh, &tags);
    let mut gmsh = Gmsh { out, text: options.encoding == Encoding::Ascii };
    let signs = signs(mesh.space, options);
    let new = format == MeshFormat::Msh41;
    let version = if new { "4.1" } else { "2.2" };
    writeln!(gmsh.out, "$MeshFormat\n{version} {} 8", i32::from(!gmsh.text))?;
    if !gmsh.text {
        gmsh.out.write_all(&1i32.to_ne_bytes())?;
        writeln!(gmsh.out)?;
    }
    writeln!(gmsh.out, "$EndMeshFormat")?;
    gmsh.physical_names(mesh, options, &groups)?;
    if new {
        gmsh.entities(mesh, &groups, signs)?;
        gmsh.nodes_41(mesh, &groups, signs)?;
        gmsh.elements_41(&groups)?;
    } else {
        gmsh.nodes_22(mesh, signs)?;
        gmsh.elements_22(&groups)?;
    }
    let points: Vec<Option<usize>> = (0..mesh.points.len()).map(Some).collect();
    mesh.point_data.iter().try_for_each(|array| gmsh.data("NodeData", array, &points))?;
    // Elements are numbered in the order of the groups, and every one gets a value: meshio reads nothing else.
    let elements: Vec<Option<usize>> = groups.iter().flat_map(|g| g.elements.iter().copied()).collect();
    mesh.element_data.iter().try_for_each(|array| gmsh.data("ElementData", array, &elements))
}

fn groups_of<'a>(mesh: &'a MixedMesh, tags: &[i32]) -> Vec<Group<'a>> {
    let mut groups: std::collections::BTreeMap<(i32, i32, u8), Group> = std::collections::BTreeMap::new();
    let mut add = |dimension: i32, entity: i32, vtk_type: u8, row: &'a [VertexId], element: Option<usize>| {
        let group = groups.entry((dimension, entity, vtk_type)).or_insert_with(|| Group {
            dimension,
            entity,
            vtk_type,
            rows: Vec::new(),
            elements: Vec::new(),
        });
        group.rows.push(row);
        group.elements.push(element);
    };
    let boundary = &mesh.boundary;
    let inside = |face: usize| boundary.elements.get(face).and_then(|e| usize::try_from(e[0]).ok());
    let triangles = boundary.triangles.len();
    for (face, (row, &tag)) in boundary.triangles.iter().zip(tags).enumerate() {
        add(2, tag, cell::TRIANGLE, row, inside(face));
    }
    for (face, (row, &tag)) in boundary.quads.iter().zip(tags.iter().skip(triangles)).enumerate() {
        add(2, tag, cell::QUAD, row, inside(triangles + face));
    }
    for element in 0..mesh.element_count() {
        add(3, mesh.labels[element], mesh.types[element], mesh.element(element).1, Some(element));
    }
    groups.into_values().collect()
}

/// Distinct entities of the groups.
fn entities_of(groups: &[Group], dimension: i32) -> Vec<i32> {
    let mut entities: Vec<i32> = groups.iter().filter(|g| g.dimension == dimension).map(|g| g.entity).collect();
    entities.dedup();
    entities
}

impl Gmsh<'_> {
    fn ints(&mut self, values: &[i32]) -> std::io::Result<()> {
        if self.text {
            return values.iter().try_for_each(|v| write!(self.out, "{v} "));
        }
        self.out.write_all(bytemuck::cast_slice(values))
    }

    fn sizes(&mut self, values: &[usize]) -> std::io::Result<()> {
        if self.text {
            return values.iter().try_for_each(|v| write!(self.out, "{v} "));
        }
        values.iter().try_for_each(|&v| self.out.write_all(&(v as u64).to_ne_bytes()))
    }

    fn reals(&mut self, values: &[f64]) -> std::io::Result<()> {
        if self.text {
            return values.iter().try_for_each(|v| write!(self.out, "{v} "));
        }
        self.out.write_all(bytemuck::cast_slice(values))
    }

    /// Ends a row of text.
    fn row(&mut self) -> std::io::Result<()> {
        if self.text { writeln!(self.out) } else { Ok(()) }
    }

    /// Ends a block of bytes, so that the closing keyword begins a line.
    fn block(&mut self) -> std::io::Result<()> {
        if self.text { Ok(()) } else { writeln!(self.out) }
    }

    fn physical_names(&mut self, mesh: &MixedMesh, options: &WriteOptions, groups: &[Group]) -> std::io::Result<()> {
        let (surfaces, volumes) = (entities_of(groups, 2), entities_of(groups, 3));
        if surfaces.is_empty() && volumes.is_empty() {
            return Ok(());
        }
        let pairs = super::label_pairs(mesh);
        writeln!(self.out, "$PhysicalNames\n{}", surfaces.len() + volumes.len())?;
        for tag in surfaces {
            let named = options.patches.iter().find(|p| p.id == tag && !p.name.is_empty());
            let name = match (named, mesh.boundary.patches.is_empty()) {
                (Some(patch), _) => patch.name.replace('"', "'"),
                (None, true) => {
                    pairs.get(tag as usize - 1).map_or(String::new(), |p| format!("surface_{}_{}", p[0], p[1]))
                }
                (None, false) => format!("patch_{tag}"),
            };
            writeln!(self.out, "2 {tag} \"{name}\"")?;
        }
        for label in volumes {
            writeln!(self.out, "3 {label} \"label_{label}\"")?;
        }
        writeln!(self.out, "$EndPhysicalNames")
    }

    fn entities(&mut self, mesh: &MixedMesh, groups: &[Group], signs: DVec3) -> std::io::Result<()> {
        let (surfaces, volumes) = (entities_of(groups, 2), entities_of(groups, 3));
        let low = mesh.points.iter().map(|&p| p * signs).fold(DVec3::INFINITY, DVec3::min);
        let high = mesh.points.iter().map(|&p| p * signs).fold(DVec3::NEG_INFINITY, DVec3::max);
        writeln!(self.out, "$Entities")?;
        self.sizes(&[0, 0, surfaces.len(), volumes.len()])?;
        self.row()?;
        for tag in surfaces.into_iter().chain(volumes) {
            self.ints(&[tag])?;
            self.reals(&low.to_array())?;
            self.reals(&high.to_array())?;
            self.sizes(&[1])?;
            self.ints(&[tag])?;
            self.sizes(&[0])?;
            self.row()?;
        }
        self.block()?;
        writeln!(self.out, "$EndEntities")
    }

    fn nodes_41(&mut self, mesh: &MixedMesh, groups: &[Group], signs: DVec3) -> std::io::Result<()> {
        let count = mesh.points.len();
        writeln!(self.out, "$Nodes")?;
        // All nodes are filed under one entity: Gmsh needs one, and readers look at the cells.
        let home = groups.last().map(|g| (g.dimension, g.entity));
        let blocks = usize::from(home.is_some() && count > 0);
        self.sizes(&[blocks, if blocks > 0 { count } else { 0 }, blocks, if blocks > 0 { count } else { 0 }])?;
        self.row()?;
        if let Some((dimension, entity)) = home.filter(|_| count > 0) {
            self.ints(&[dimension, entity, 0])?;
            self.sizes(&[count])?;
            self.row()?;
            for number in 1..=count {
                self.sizes(&[number])?;
                self.row()?;
            }
            for &point in &mesh.points {
                self.reals(&(point * signs).to_array())?;
                self.row()?;
            }
        }
        self.block()?;
        writeln!(self.out, "$EndNodes")
    }

    fn elements_41(&mut self, groups: &[Group]) -> std::io::Result<()> {
        let count: usize = groups.iter().map(|g| g.rows.len()).sum();
        writeln!(self.out, "$Elements")?;
        self.sizes(&[groups.len(), count, usize::from(count > 0), count])?;
        self.row()?;
        let mut number = 0;
        for group in groups {
            let (kind, order) = known_order(group.vtk_type)?;
            self.ints(&[group.dimension, group.entity, kind])?;
            self.sizes(&[group.rows.len()])?;
            self.row()?;
            let mut row = [0; 21];
            for nodes in &group.rows {
                number += 1;
                row[0] = number;
                order.iter().enumerate().for_each(|(i, &place)| row[i + 1] = nodes[place].index() + 1);
                self.sizes(&row[..=order.len()])?;
                self.row()?;
            }
        }
        self.block()?;
        writeln!(self.out, "$EndElements")
    }

    fn nodes_22(&mut self, mesh: &MixedMesh, signs: DVec3) -> std::io::Result<()> {
        writeln!(self.out, "$Nodes\n{}", mesh.points.len())?;
        for (i, &point) in mesh.points.iter().enumerate() {
            self.ints(&[i as i32 + 1])?;
            self.reals(&(point * signs).to_array())?;
            self.row()?;
        }
        self.block()?;
        writeln!(self.out, "$EndNodes")
    }

    fn elements_22(&mut self, groups: &[Group]) -> std::io::Result<()> {
        let count: usize = groups.iter().map(|g| g.rows.len()).sum();
        writeln!(self.out, "$Elements\n{count}")?;
        let mut number = 0;
        for group in groups {
            let (kind, order) = known_order(group.vtk_type)?;
            if !self.text {
                self.ints(&[kind, group.rows.len() as i32, 2])?;
            }
            let mut row = [0; 23];
            for nodes in &group.rows {
                number += 1;
                if self.text {
                    self.ints(&[number, kind, 2, group.entity, group.entity])?;
                } else {
                    self.ints(&[number, group.entity, group.entity])?;
                }
                order.iter().enumerate().for_each(|(i, &place)| row[i] = nodes[place].0 as i32 + 1);
                self.ints(&row[..order.len()])?;
                self.row()?;
            }
        }
        self.block()?;
        writeln!(self.out, "$EndElements")
    }

    /// Node or element data: for each number from 1 on the row of the array, or none for 0.
    fn data(&mut self, section: &str, array: &NamedArray, rows: &[Option<usize>]) -> std::io::Result<()> {
        let name = array.name.replace('"', "'");
        // Gmsh knows scalars, vectors and tensors.
        let width = [1, 3, 9].into_iter().find(|&w| w >= array.components);
        let Some(width) = width else {
            return Err(std::io::Error::other(format!("Gmsh has no array of {} components", array.components)));
        };
        writeln!(self.out, "${section}\n1\n\"{name}\"\n1\n0\n3\n0\n{width}\n{}", rows.len())?;
        let mut row = vec![0.0; width];
        for (i, source) in rows.iter().enumerate() {
            for (c, value) in row[..array.components].iter_mut().enumerate() {
                let at = source.map(|s| s * array.components + c);
                *value = match (&array.data, at) {
                    (_, None) => 0.0,
                    (ArrayData::Int(values), Some(at)) => f64::from(values[at]),
                    (ArrayData::Long(values), Some(at)) => values[at] as f64,
                    (ArrayData::Real(values), Some(at)) => values[at],
                };
            }
            self.ints(&[i as i32 + 1])?;
            self.reals(&row)?;
            self.row()?;
        }
        self.block()?;
        writeln!(self.out, "$End{section}")
    }
}

fn known_order(vtk_type: u8) -> std::io::Result<(i32, &'static [usize])> {
    debug_assert!(vtk_type < 10 || ElementKind::from_vtk_type(vtk_type).is_some());
    node_order(vtk_type).ok_or_else(|| std::io::Error::other(format!("Gmsh has no element for VTK type {vtk_type}")))
}
