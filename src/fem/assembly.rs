//! Parallel assembly of the global stiffness matrix, the same for any number of threads.
//!
//! # Method
//! Rows are cut into fixed ranges. Each range lists the elements that touch it, computes their matrices and adds the
//! rows it owns, element by element in increasing order. An element on the border of two ranges is computed by both:
//! cheaper than any synchronisation, because meshes are numbered for locality.
//!
//! # Invariants
//! The sum of each block is taken in the order of the elements: no atomics, no dependence on threads.

use std::ops::Range;

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::fem::element_mesh::ElementMesh;
use crate::fem::element_stiffness::{
    ElementMatrix, Formulation, coupling_block, element_stiffness, is_inverted, tet_gradients,
};
use crate::fem::material::{Material, MaterialMap};
use crate::mesh::mixed_mesh::ElementKind;
use crate::sparse::block_csr::BlockCsr;
use crate::sparse::pattern::{Incidence, Pattern};

/// The sparsity of a model, kept between assemblies of the same elements.
#[derive(Debug, Clone)]
pub struct ModelPattern {
    /// Elements per node.
    pub incidence: Incidence,
    /// Coupled nodes.
    pub pattern: Pattern,
}

impl ModelPattern {
    /// From the elements of a mesh.
    ///
    /// # Errors
    /// As [`Incidence::new`].
    pub fn new(mesh: &ElementMesh, context: &RunContext) -> Result<Self> {
        context.install(|| {
            let incidence = Incidence::new(mesh.points.len(), mesh.offsets, mesh.connectivity)?;
            context.check()?;
            let pattern = Pattern::from_elements(&incidence, mesh.offsets, mesh.connectivity, context)?;
            Ok(Self { incidence, pattern })
        })
    }
}

/// Assembles the stiffness matrix of a mesh.
///
/// # Errors
/// [`Error::InvalidArgument`] for a label without material or an element of non-positive volume, with its number.
pub fn assemble_stiffness(
    mesh: &ElementMesh,
    model: &ModelPattern,
    materials: &MaterialMap,
    formulation: Formulation,
    context: &RunContext,
) -> Result<BlockCsr> {
    context.check()?;
    let materials = ElementMaterials::new(mesh, materials)?;
    if let Some(element) = context.install(|| first_inverted(mesh)) {
        return Err(Error::argument("mesh", format!("element {element} has no positive volume")));
    }
    context.check()?;
    let mut matrix = BlockCsr::zero(model.pattern.clone());
    context.check()?;
    context.install(|| {
        matrix.fill_rows(|pattern, rows, blocks| {
            // What is left undone is never seen: the check below fails too.
            if context.check().is_err() {
                return;
            }
            fill_rows(mesh, &model.incidence, &materials, formulation, pattern, rows, blocks);
        });
    });
    context.check()?;
    Ok(matrix)
}

/// Materials of the labels that occur, found once.
struct ElementMaterials {
    labels: Vec<i32>,
    materials: Vec<Material>,
}

impl ElementMaterials {
    fn new(mesh: &ElementMesh, map: &MaterialMap) -> Result<Self> {
        let mut labels = Vec::new();
        let mut last = None;
        for &label in mesh.labels {
            if last != Some(label) && !labels.contains(&label) {
                labels.push(label);
            }
            last = Some(label);
        }
        labels.sort_unstable();
        let materials = labels.iter().map(|&label| map.of(label)).collect::<Result<_>>()?;
        Ok(Self { labels, materials })
    }

    #[inline]
    fn of(&self, label: i32) -> &Material {
        let at = self.labels.binary_search(&label).expect("every label of the mesh was entered");
        &self.materials[at]
    }
}

fn first_inverted(mesh: &ElementMesh) -> Option<usize> {
    let is_inverted = |element: &usize| {
        let mut points = [DVec3::ZERO; 20];
        let kind = mesh.element_points(*element, &mut points);
        is_inverted(kind, &points[..kind.node_count()])
    };
    (0..mesh.element_count()).into_par_iter().filter(is_inverted).min()
}

fn fill_rows(
    mesh: &ElementMesh,
    incidence: &Incidence,
    materials: &ElementMaterials,
    formulation: Formulation,
    pattern: &Pattern,
    rows: Range<usize>,
    blocks: &mut [DMat3],
) {
    let base = pattern.offsets()[rows.start];
    // Written before anything is added: a fresh page that is read first is mapped a second time when it is written, and that second
    // time halts every other thread of the process.
    blocks.fill(DMat3::ZERO);
    let mut elements: Vec<u32> = rows.clone().flat_map(|row| incidence.of(row)).copied().collect();
    elements.sort_unstable();
    elements.dedup();
    let mut matrix = ElementMatrix::default();
    let mut points = [DVec3::ZERO; 20];
    let mut add = |row: usize, column: usize, block: DMat3| {
        if let Some(at) = pattern.position(row, column) {
            blocks[at - base] += block;
        }
    };
    for element in elements {
        let element = element as usize;
        let kind = mesh.element_points(element, &mut points);
        let (_, nodes) = mesh.element(element);
        let material = materials.of(mesh.labels[element]);
        if kind == ElementKind::Tet {
            // The closed form, without the detour through an element matrix: tets are most of all elements.
            let (gradients, volume) = tet_gradients([points[0], points[1], points[2], points[3]]);
            let (lambda, mu) = material.lame();
            for (i, row) in nodes.iter().map(|n| n.index()).enumerate().filter(|(_, row)| rows.contains(row)) {
                for (j, column) in nodes.iter().enumerate() {
                    add(row, column.index(), coupling_block(gradients[i], gradients[j], lambda * volume, mu * volume));
                }
            }
            continue;
        }
        let computed = element_stiffness(kind, formulation, &points[..kind.node_count()], material, &mut matrix);
        debug_assert!(computed.is_ok(), "inverted elements are refused before");
        for (i, row) in nodes.iter().map(|n| n.index()).enumerate().filter(|(_, row)| rows.contains(row)) {
            for (j, column) in nodes.iter().enumerate() {
                add(row, column.index(), matrix.block(i, j));
            }
        }
    }
}
