//! OpenFOAM's polyMesh: `constant/polyMesh/{points,faces,owner,neighbour,boundary}` in a case folder.
//!
//! # Method
//! 1. Every face of the mesh once, seen from the element of the smaller number: outward from the owner.
//! 2. Inner faces first, by owner, then neighbour: OpenFOAM's upper triangular order. Then the outer faces, grouped by
//!    patch.
//! 3. Labels that are more than one become cell zones.
//!
//! # Source
//! [OpenFOAM] section on mesh files.
//!
//! # Differences
//! `NAME.foam` names the case: the folder `NAME.foam`'s parent holds it, and the empty `.foam` file is what ParaView opens.
//! The five files appear one by one, each whole; `boundary`, without which no program reads the mesh, comes last.

use std::io::Write;
use std::path::Path;

use rustc_hash::FxHashMap;

use super::{WriteOptions, signs, write_atomically};
use crate::error::{Error, Result};
use crate::index::VertexId;
use crate::mesh::boundary::{FacePair, face_pairs, faces_of};
use crate::mesh::mixed_mesh::MixedMesh;
use crate::mesh::surface_mesh::PatchRole;

/// Outer faces of one patch.
struct PatchFaces {
    name: String,
    kind: &'static str,
    faces: Vec<FacePair>,
}

/// Writes the case that `path` (`CASE/NAME.foam`) names; the boundary of the mesh is filled.
///
/// # Errors
/// [`Error::Io`]; [`Error::Unsupported`] for quadratic elements.
pub fn write(mesh: &MixedMesh, path: &Path, options: &WriteOptions) -> Result<()> {
    super::refuse_quadratic(mesh, "polyMesh")?;
    let case = path.parent().unwrap_or(Path::new(""));
    let folder = case.join("constant").join("polyMesh");
    std::fs::create_dir_all(&folder).map_err(|source| Error::io(&folder, source))?;
    let (mut inner, outer): (Vec<FacePair>, Vec<FacePair>) =
        face_pairs(mesh).into_iter().partition(|pair| pair.neighbor >= 0);
    inner.sort_by_key(|pair| (pair.element, pair.neighbor));
    let patches = patches_of(mesh, outer, options);
    let all: Vec<FacePair> = inner.iter().chain(patches.iter().flat_map(|p| &p.faces)).copied().collect();
    let turn = signs(mesh.space, options);
    let list = |name: &str, class: &str, fill: &dyn Fn(&mut dyn Write) -> std::io::Result<()>| {
        write_atomically(&folder.join(name), |out| {
            write_head(out, name, class)?;
            fill(out)
        })
    };
    list("points", "vectorField", &|out| {
        writeln!(out, "{}\n(", mesh.points.len())?;
        mesh.points.iter().try_for_each(|&p| {
            let p = p * turn;
            writeln!(out, "({} {} {})", p.x, p.y, p.z)
        })?;
        writeln!(out, ")")
    })?;
    list("faces", "faceList", &|out| {
        writeln!(out, "{}\n(", all.len())?;
        for pair in &all {
            let corners = corners_of(mesh, pair);
            write!(out, "{}(", corners.len())?;
            let words: Vec<String> = corners.iter().map(|v| v.0.to_string()).collect();
            writeln!(out, "{})", words.join(" "))?;
        }
        writeln!(out, ")")
    })?;
    list("owner", "labelList", &|out| {
        writeln!(out, "{}\n(", all.len())?;
        all.iter().try_for_each(|pair| writeln!(out, "{}", pair.element))?;
        writeln!(out, ")")
    })?;
    list("neighbour", "labelList", &|out| {
        writeln!(out, "{}\n(", inner.len())?;
        inner.iter().try_for_each(|pair| writeln!(out, "{}", pair.neighbor))?;
        writeln!(out, ")")
    })?;
    write_zones(mesh, &folder)?;
    list("boundary", "polyBoundaryMesh", &|out| {
        let mut start = inner.len();
        writeln!(out, "{}\n(", patches.len())?;
        for patch in &patches {
            let count = patch.faces.len();
            writeln!(
                out,
                "    {}\n    {{\n        type {};\n        nFaces {count};\n        startFace {start};\n    }}",
                patch.name, patch.kind
            )?;
            start += count;
        }
        writeln!(out, ")")
    })?;
    write_system(case)?;
    write_atomically(path, |_| Ok(()))
}

fn corners_of(mesh: &MixedMesh, pair: &FacePair) -> Vec<VertexId> {
    let (kind, vertices) = mesh.element(pair.element as usize);
    faces_of(kind)[pair.face as usize].iter().map(|&c| vertices[c]).collect()
}

fn patches_of(mesh: &MixedMesh, outer: Vec<FacePair>, options: &WriteOptions) -> Vec<PatchFaces> {
    let tags = super::medit::face_tags(mesh);
    let triangles = mesh.boundary.triangles.len();
    let mut tag_of: FxHashMap<[u32; 4], i32> = FxHashMap::default();
    for (face, tag) in tags.iter().enumerate() {
        let corners: &[VertexId] =
            if face < triangles { &mesh.boundary.triangles[face] } else { &mesh.boundary.quads[face - triangles] };
        tag_of.insert(face_key(corners), *tag);
    }
    let mut groups: std::collections::BTreeMap<i32, Vec<FacePair>> = std::collections::BTreeMap::new();
    for pair in outer {
        let tag = tag_of.get(&face_key(&corners_of(mesh, &pair))).copied().unwrap_or(0);
        groups.entry(tag).or_default().push(pair);
    }
    groups
        .into_iter()
        .map(|(tag, faces)| {
            let role = options.patches.iter().find(|p| p.id == tag).map_or(PatchRole::Wall, |p| p.role);
            let kind = match role {
                PatchRole::Wall | PatchRole::WallBoundaryLayer | PatchRole::Fixed => "wall",
                PatchRole::Symmetry => "symmetry",
                _ => "patch",
            };
            PatchFaces { name: super::patch_name(mesh, options, tag), kind, faces }
        })
        .collect()
}

fn face_key(corners: &[VertexId]) -> [u32; 4] {
    let mut key = [u32::MAX; 4];
    corners.iter().zip(&mut key).for_each(|(v, k)| *k = v.0);
    key.sort_unstable();
    key
}

fn write_head(out: &mut dyn Write, object: &str, class: &str) -> std::io::Result<()> {
    writeln!(
        out,
        "FoamFile\n{{\n    version 2.0;\n    format ascii;\n    class {class};\n    location \"constant/polyMesh\";\n    object {object};\n}}\n"
    )
}

/// One cell zone per label, where there are several.
fn write_zones(mesh: &MixedMesh, folder: &Path) -> Result<()> {
    let mut labels: Vec<i32> = mesh.labels.clone();
    labels.sort_unstable();
    labels.dedup();
    if labels.len() < 2 {
        return Ok(());
    }
    write_atomically(&folder.join("cellZones"), |out| {
        write_head(out, "cellZones", "regIOobject")?;
        writeln!(out, "{}\n(", labels.len())?;
        for label in &labels {
            let cells: Vec<usize> = (0..mesh.labels.len()).filter(|&i| mesh.labels[i] == *label).collect();
            writeln!(out, "label_{label}\n{{\n    type cellZone;\n    cellLabels List<label>\n{}\n(", cells.len())?;
            cells.iter().try_for_each(|c| writeln!(out, "{c}"))?;
            writeln!(out, ");\n}}")?;
        }
        writeln!(out, ")")
    })
}

/// The least that OpenFOAM's programs want beside the mesh; files that are there already stay.
fn write_system(case: &Path) -> Result<()> {
    let folder = case.join("system");
    std::fs::create_dir_all(&folder).map_err(|source| Error::io(&folder, source))?;
    let files = [
        (
            "controlDict",
            "application checkMesh;\nstartFrom startTime;\nstartTime 0;\nstopAt endTime;\nendTime 1;\ndeltaT 1;\nwriteControl timeStep;\nwriteInterval 1;\n",
        ),
        (
            "fvSchemes",
            "ddtSchemes { default steadyState; }\ngradSchemes { default Gauss linear; }\ndivSchemes { default none; }\nlaplacianSchemes { default Gauss linear corrected; }\ninterpolationSchemes { default linear; }\nsnGradSchemes { default corrected; }\n",
        ),
        ("fvSolution", "solvers { }\n"),
    ];
    for (name, body) in files {
        let path = folder.join(name);
        if !path.exists() {
            write_atomically(&path, |out| {
                writeln!(
                    out,
                    "FoamFile\n{{\n    version 2.0;\n    format ascii;\n    class dictionary;\n    object {name};\n}}\n{body}"
                )
            })?;
        }
    }
    Ok(())
}
