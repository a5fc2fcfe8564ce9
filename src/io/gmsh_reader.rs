//! Reads Gmsh `.msh` files: versions 2.x, 4.0 is refused, 4.1; text and bytes.
//!
//! # Method
//! Sections `$Name ... $EndName`; the physical number of an element is its label or patch, its elementary number where
//! it has none. Sections that are not needed are read past.
//!
//! # Source
//! [Gmsh] section 10.1.

use std::path::Path;

use glam::DVec3;
use rustc_hash::FxHashMap;

use super::file_mesh::{FileMesh, cell};
use super::gmsh_writer::node_order;
use super::text_scan::TextScan;
use crate::error::{Error, Result};
use crate::mesh::surface_mesh::{Patch, PatchRole};

struct Gmsh {
    scan: TextScan,
    text: bool,
    swapped: bool,
    mesh: FileMesh,
    /// Position of a node by its number.
    numbers: FxHashMap<i64, i64>,
    /// Physical number of an entity (dimension, number).
    physical: FxHashMap<(i32, i32), i32>,
}

/// VTK types that occur, to be looked up by Gmsh's number.
const KINDS: [u8; 10] = [cell::LINE, cell::TRIANGLE, cell::QUAD, 10, 12, 13, 14, cell::QUADRATIC_TRIANGLE, 24, 25];
/// Gmsh's element of one point.
const POINT: i32 = 15;

/// Reads a mesh or a surface.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] with the line.
pub fn read(path: &Path) -> Result<FileMesh> {
    let mut scan = TextScan::open(path, 0)?;
    if scan.line() != Some("$MeshFormat") {
        return Err(Error::format(path, "not a Gmsh file: it does not begin with $MeshFormat"));
    }
    let version = scan.real()?;
    let text = scan.integer()? == 0;
    let size = scan.integer()?;
    scan.line();
    let new = (4.05..5.0).contains(&version);
    if !(new || (2.0..3.0).contains(&version)) {
        return Err(scan.refuse(format!("version {version}; 2.x and 4.1 are read")));
    }
    if size != 8 {
        return Err(scan.refuse(format!("numbers of {size} bytes; 8 are read")));
    }
    let mut gmsh = Gmsh {
        scan,
        text,
        swapped: false,
        mesh: FileMesh::new(),
        numbers: FxHashMap::default(),
        physical: FxHashMap::default(),
    };
    if !text {
        let one = gmsh.int()?;
        gmsh.swapped = one != 1;
        if gmsh.swapped && one.swap_bytes() != 1 {
            return Err(gmsh.scan.refuse("the mark of the byte order is neither 1 nor its mirror"));
        }
    }
    gmsh.read_sections(new)?;
    Ok(gmsh.mesh)
}

impl Gmsh {
    fn raw<const N: usize>(&mut self) -> Result<[u8; N]> {
        let at = self.scan.position();
        let Some(slice) = self.scan.bytes().get(at..at + N) else {
            return Err(Error::format(
                self.scan.path(),
                format!("byte {at}: the file ends in the middle of a section"),
            ));
        };
        let mut raw: [u8; N] = slice.try_into().expect("the slice has N bytes");
        self.scan.seek(at + N);
        if self.swapped != cfg!(target_endian = "big") {
            raw.reverse();
        }
        Ok(raw)
    }

    fn int(&mut self) -> Result<i32> {
        if self.text { Ok(self.scan.integer()? as i32) } else { self.raw().map(i32::from_le_bytes) }
    }

    fn size(&mut self) -> Result<i64> {
        if self.text { self.scan.integer() } else { self.raw().map(i64::from_le_bytes) }
    }

    fn real(&mut self) -> Result<f64> {
        if self.text { self.scan.real() } else { self.raw().map(f64::from_le_bytes) }
    }

    fn point(&mut self) -> Result<DVec3> {
        Ok(DVec3::new(self.real()?, self.real()?, self.real()?))
    }

    fn count(&mut self, what: &str, bytes: usize) -> Result<usize> {
        let count = self.size()?;
        self.scan.believable(count, what, if self.text { 2 } else { bytes })
    }

    fn read_sections(&mut self, new: bool) -> Result<()> {
        let (mut nodes, mut elements) = (false, false);
        while let Some(word) = self.scan.word().map(str::to_owned) {
            match word.as_str() {
                "$Nodes" | "$Elements" | "$Entities" if !self.text => {
                    self.scan.line();
                }
                _ => {}
            }
            match (word.as_str(), new) {
                ("$PhysicalNames", _) => self.read_names()?,
                ("$Entities", true) => self.read_entities()?,
                ("$Nodes", true) => self.read_nodes_41()?,
                ("$Nodes", false) => self.read_nodes_22()?,
                ("$Elements", true) => self.read_elements_41()?,
                ("$Elements", false) => self.read_elements_22()?,
                (name, _) if name.starts_with("$End") => continue,
                (name, _) if name.starts_with('$') => {
                    self.skip_section(&name[1..])?;
                    continue;
                }
                _ => return Err(self.scan.refuse("a section should begin here")),
            }
            nodes |= word == "$Nodes";
            elements |= word == "$Elements";
            let end = format!("$End{}", &word[1..]);
            if self.scan.word() != Some(end.as_str()) {
                return Err(self.scan.refuse(format!("{end} should stand here")));
            }
        }
        if nodes && elements { Ok(()) } else { Err(self.scan.refuse("the file ends without nodes or elements")) }
    }

    fn skip_section(&mut self, name: &str) -> Result<()> {
        let end = format!("$End{name}");
        let at = self.scan.position();
        let found = self.scan.bytes()[at..].windows(end.len()).position(|w| w == end.as_bytes());
        match found {
            Some(offset) => {
                self.scan.seek(at + offset + end.len());
                Ok(())
            }
            None => Err(self.scan.refuse(format!("section {name} does not end"))),
        }
    }

    fn read_names(&mut self) -> Result<()> {
        for _ in 0..self.scan.count("names", 4)? {
            let dimension = self.scan.integer()?;
            let id = self.scan.integer()? as i32;
            let name = self.scan.line().unwrap_or("").trim_matches('"').to_owned();
            if dimension == 2 {
                self.mesh.patches.push(Patch { id, role: PatchRole::Wall, name });
            }
        }
        Ok(())
    }

    fn read_entities(&mut self) -> Result<()> {
        let counts = [self.size()?, self.size()?, self.size()?, self.size()?];
        for (dimension, &count) in counts.iter().enumerate() {
            for _ in 0..self.scan.believable(count, "entities", 8)? {
                let tag = self.int()?;
                (0..if dimension == 0 { 3 } else { 6 }).try_for_each(|_| self.real().map(|_| ()))?;
                let physical = self.count("physical numbers", 4)?;
                for i in 0..physical {
                    let number = self.int()?;
                    if i == 0 {
                        self.physical.insert((dimension as i32, tag), number.abs());
                    }
                }
                if dimension > 0 {
                    for _ in 0..self.count("bounding entities", 4)? {
                        self.int()?;
                    }
                }
            }
        }
        Ok(())
    }

    fn add_node(&mut self, number: i64, point: DVec3) {
        self.numbers.insert(number, self.mesh.points.len() as i64);
        self.mesh.points.push(point);
    }

    fn read_nodes_22(&mut self) -> Result<()> {
        for _ in 0..self.text_count("nodes", if self.text { 8 } else { 28 })? {
            let number = i64::from(self.int()?);
            let point = self.point()?;
            self.add_node(number, point);
        }
        Ok(())
    }

    /// Version 2 writes its counts as text also before bytes.
    fn text_count(&mut self, what: &str, bytes: usize) -> Result<usize> {
        let count = self.scan.count(what, bytes)?;
        if !self.text {
            self.scan.line();
        }
        Ok(count)
    }

    fn read_nodes_41(&mut self) -> Result<()> {
        let blocks = self.count("blocks", 20)?;
        (0..3).try_for_each(|_| self.size().map(|_| ()))?;
        for _ in 0..blocks {
            let dimension = self.int()?;
            self.int()?;
            let parametric = self.int()? != 0;
            let count = self.count("nodes", 32)?;
            let mut numbers = Vec::with_capacity(count);
            for _ in 0..count {
                numbers.push(self.size()?);
            }
            for number in numbers {
                let point = self.point()?;
                if parametric {
                    (0..dimension).try_for_each(|_| self.real().map(|_| ()))?;
                }
                self.add_node(number, point);
            }
        }
        Ok(())
    }

    fn kind(&self, gmsh_type: i32) -> Result<(u8, &'static [usize])> {
        if gmsh_type == POINT {
            return Ok((1, &[0]));
        }
        KINDS
            .into_iter()
            .find_map(|vtk| node_order(vtk).filter(|(g, _)| *g == gmsh_type).map(|(_, order)| (vtk, order)))
            .ok_or_else(|| self.scan.refuse(format!("element type {gmsh_type} of Gmsh is not read")))
    }

    /// Adds a cell from Gmsh's node numbers.
    fn push(&mut self, kind: (u8, &[usize]), nodes: &[i64], tag: i32) {
        if kind.0 < cell::TRIANGLE {
            return;
        }
        let mut row = [0; 20];
        for (&number, &place) in nodes.iter().zip(kind.1) {
            // A number without a node stays out of range, for the conversion to find.
            row[place] = self.numbers.get(&number).copied().unwrap_or(-1 - number.abs());
        }
        self.mesh.push(kind.0, row[..kind.1.len()].iter().copied(), tag);
    }

    fn read_elements_22(&mut self) -> Result<()> {
        let mut left = self.text_count("elements", 8)?;
        let mut nodes = Vec::new();
        while left > 0 {
            let (mut kind, mut rows, mut tags) = (0, 1, 0);
            if !self.text {
                kind = self.int()?;
                rows = self.int()?;
                tags = self.int()?;
                if rows < 1 || rows as usize > left {
                    return Err(self.scan.refuse(format!("a block of {rows} elements")));
                }
            }
            for _ in 0..rows {
                self.int()?;
                if self.text {
                    kind = self.int()?;
                    tags = self.int()?;
                }
                let known = self.kind(kind)?;
                let mut tag = 0;
                for i in 0..self.scan.believable(i64::from(tags), "tags", 1)? {
                    let value = self.int()?;
                    if i == 0 || (i == 1 && tag == 0) {
                        tag = value;
                    }
                }
                nodes.clear();
                for _ in known.1 {
                    nodes.push(i64::from(self.int()?));
                }
                self.push(known, &nodes, tag);
            }
            left -= rows as usize;
        }
        Ok(())
    }

    fn read_elements_41(&mut self) -> Result<()> {
        let blocks = self.count("blocks", 20)?;
        (0..3).try_for_each(|_| self.size().map(|_| ()))?;
        let mut nodes = Vec::new();
        for _ in 0..blocks {
            let (dimension, entity) = (self.int()?, self.int()?);
            let gmsh_type = self.int()?;
            let kind = self.kind(gmsh_type)?;
            let tag = self.physical.get(&(dimension, entity)).copied().unwrap_or(entity);
            for _ in 0..self.count("elements", 16)? {
                self.size()?;
                nodes.clear();
                for _ in kind.1 {
                    nodes.push(self.size()?);
                }
                self.push(kind, &nodes, tag);
            }
        }
        Ok(())
    }
}
