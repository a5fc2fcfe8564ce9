//! What the mesh still lacks, and which leaves have to be refined for it.
//!
//! # Method
//! 1. [`Targets`]: fidelity and sizes per compact label, from the options.
//! 2. [`Deficit`]: labels below their fidelity, components without an element, from the voxel mismatches.
//! 3. [`mark_leaves`]: a leaf is marked when the signed distance of a label below its fidelity changes sign between its
//!    centroid and its vertices, when it holds voxels that such a label lacks, when it holds voxels of a lost
//!    component, or when it is larger than its label allows.
//! 4. A leaf is marked as well where the signed distance of a label bends within it: the interpolation between its
//!    vertices misses the distance at a sample by more than the tolerance; samples are dense enough for thin rods.
//!    Straight elements cannot follow the boundary there, however many voxels they agree on: walls and gaps
//!    thinner than the element, tips, strong curvature. It ends at elements of two voxels.
//!
//! # Source
//! [Drakopoulos2017] 2.3.3.
//!
//! # Differences
//! The thesis refines only elements whose own label lacks fidelity; a label whose missing voxels lie in its neighbours'
//! elements then never gets them. Here both sides are refined. The share of voxels alone leaves a wall of 1.4 voxels
//! in tatters at a fidelity of 0.8; the error of interpolation ([LabelleShewchuk2007] asks for small elements where
//! features are) finds such places.

use glam::DVec3;
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::image::connected_components::{Component, Components};
use crate::image::label_image::LabelImage;
use crate::index::Label;
use crate::lattice::bcc_lattice::TET_RADIUS;
use crate::lattice::options::Options;
use crate::lattice::red_green::{Elements, RedGreenLattice};
use crate::lattice::voxel_fidelity::{LabelCount, Mismatch};

/// Finest elements against the smallest voxel spacing. Below 1 every voxel centre lies in an element of its own
/// label, so any fidelity is reached; one level more leaves room for the relabelling of the candidate mesh.
const FINEST_EDGE_IN_VOXELS: f64 = 0.5;

/// Cavities of fewer voxels are noise of the segmentation and need not be kept.
const SMALLEST_CAVITY: u64 = 8;

/// The tolerance of boundaries refines no leaf with edges up to this, in voxels: the distance of voxel centres
/// is right within half a voxel only, so finer elements would follow the staircase. On an atlas of 116 regions with
/// rough borders, 1.25 instead of 2 made 18 instead of 2.3 million tets, and nothing better on smooth shapes.
pub const RESOLVED_EDGE: f64 = 2.0;

/// Distance of the samples that look for bends, in voxels: a rod of two voxels between them is met.
const SAMPLED_LENGTH: f64 = 1.5;

/// Parts of an edge at most; elements of more than twelve voxels are sampled more coarsely, their children are not.
const MOST_PARTS: usize = 8;

/// What is asked of each label, by compact label.
#[derive(Debug, Clone)]
pub struct Targets {
    /// Required F1 and F2; 0 for the background.
    pub fidelity: Vec<f64>,
    /// Largest edge, mm.
    pub max_size: Vec<f64>,
    /// Elements with edges up to twice this are not refined for fidelity, mm.
    pub min_size: Vec<f64>,
    /// Distance by which straight elements may miss a boundary, in voxels.
    pub surface_tolerance: f64,
}

impl Targets {
    /// The targets of an image whose compact label `l` stands for the caller's value `values[l]`.
    ///
    /// # Errors
    /// [`Error::ParameterValue`] for a label that is named in an option and not in the image, or sizes that cross.
    pub fn new(values: &[i32], options: &Options) -> Result<Self> {
        let known = |label: i64| label != 0 && values.iter().any(|v| i64::from(*v) == label);
        let check = |name: &str, labels: Vec<i64>| match labels.into_iter().find(|l| !known(*l)) {
            None => Ok(()),
            Some(label) => {
                let reason = format!("label {label} is not in the image");
                Err(Error::ParameterValue { name: name.to_owned(), reason })
            }
        };
        let labels = |pairs: &[(i64, Option<f64>)]| pairs.iter().map(|(l, _)| *l).collect();
        check("fidelity", options.fidelity.values.iter().map(|(l, _)| *l).collect())?;
        check("youngs-modulus", options.youngs_modulus.values.iter().map(|(l, _)| *l).collect())?;
        check("poissons-ratio", options.poissons_ratio.values.iter().map(|(l, _)| *l).collect())?;
        check("max-element-size", labels(&options.max_element_size.values))?;
        check("min-element-size", labels(&options.min_element_size.values))?;
        let interfaces = options.duplicated_interfaces.iter();
        check("duplicate-interface", interfaces.flat_map(|i| [Some(i.first), i.second]).flatten().collect())?;
        let per_label = |of: &dyn Fn(i32) -> f64| values.iter().map(|v| of(*v)).collect::<Vec<f64>>();
        let mut targets = Self {
            fidelity: per_label(&|v| options.fidelity.of(v)),
            max_size: per_label(&|v| options.max_element_size.of(v).unwrap_or(f64::INFINITY)),
            min_size: per_label(&|v| options.min_element_size.of(v).unwrap_or(0.0)),
            surface_tolerance: options.surface_tolerance,
        };
        targets.fidelity[0] = 0.0;
        targets.max_size[0] = f64::INFINITY;
        if let Some(l) = (1..values.len()).find(|l| targets.min_size[*l] > targets.max_size[*l]) {
            let reason = format!("for label {} it is larger than max-element-size", values[l]);
            return Err(Error::ParameterValue { name: "min-element-size".into(), reason });
        }
        Ok(targets)
    }
}

/// Where the mesh falls short of the image.
#[derive(Debug, Clone)]
pub struct Deficit {
    /// Counts per compact label.
    pub counts: Vec<LabelCount>,
    /// Labels below their fidelity.
    pub lacking: Vec<bool>,
    /// Components without a voxel in an element of their label.
    pub lost: Vec<u32>,
}

impl Deficit {
    /// Compares counts with targets.
    pub fn new(totals: &[LabelCount], mismatches: &[Mismatch], components: &Components, targets: &Targets) -> Self {
        let mut counts = totals.to_vec();
        let mut missed_of_component = vec![0u64; components.components().len()];
        for m in mismatches {
            counts[m.voxel_label.index()].missed += u64::from(m.voxels);
            counts[m.element_label.index()].wrong += u64::from(m.voxels);
            if m.component != u32::MAX {
                missed_of_component[m.component as usize] += u64::from(m.voxels);
            }
        }
        let lacking = counts.iter().zip(&targets.fidelity).map(|(c, f)| c.image > 0 && c.fidelity() < *f).collect();
        let lost = components.components().iter().zip(&missed_of_component).enumerate();
        let lost = lost.filter(|(_, (c, missed))| c.voxels == **missed && is_wanted(c));
        let lost = lost.map(|(i, _)| i as u32).collect();
        Self { counts, lacking, lost }
    }

    /// Whether a label lacks fidelity, or a component is lost, that was there before.
    pub fn is_worse_than(&self, before: &Deficit) -> bool {
        let lacks = |(now, then): (&bool, &bool)| *now && !*then;
        self.lost.len() > before.lost.len() || self.lacking.iter().zip(&before.lacking).any(lacks)
    }

    /// Whether nothing is missing.
    pub fn is_empty(&self) -> bool {
        self.lost.is_empty() && !self.lacking.iter().any(|l| *l)
    }
}

/// Whether a component must have an element.
pub fn is_wanted(component: &Component) -> bool {
    !component.label.is_background() || component.voxels >= SMALLEST_CAVITY
}

/// Deepest level that refinement uses in this image.
pub fn finest_level(lattice: &RedGreenLattice, image: &LabelImage) -> u32 {
    let finest = FINEST_EDGE_IN_VOXELS * image.grid().spacing().min_element();
    (0..lattice.frame.max_level())
        .find(|level| lattice.frame.edge_length(*level) <= finest)
        .unwrap_or(lattice.frame.max_level())
}

/// What leaves are refined for.
#[derive(Clone, Copy)]
pub struct Demands<'a> {
    /// Where the mesh falls short of the image.
    pub deficit: &'a Deficit,
    /// What is asked of each label.
    pub targets: &'a Targets,
    /// Deepest level, but for the sizes that the caller asks for.
    pub finest: u32,
}

/// The leaves that have to be refined; of those in `straight` it is known that they miss no boundary.
///
/// # Errors
/// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`].
pub fn mark_leaves(
    lattice: &RedGreenLattice,
    elements: &Elements,
    mismatches: &[Mismatch],
    demands: &Demands,
    straight: impl Fn(usize) -> bool + Sync + Send,
    context: &RunContext,
) -> Result<Vec<bool>> {
    let Demands { deficit, targets, finest } = *demands;
    let lacks_any = deficit.lacking.contains(&true);
    let leaves = lattice.tets.par_iter().zip(lattice.levels.par_iter()).enumerate();
    let mut marked: Vec<bool> = context
        .until_cancelled(leaves)
        .map(|(leaf, (tet, level))| {
            u32::from(*level) < finest
                && (lacks_any && changes_sign(lattice, tet, *level, deficit, targets)
                    || !straight(leaf) && misses_boundary(lattice, tet, *level, targets))
        })
        .collect();
    context.check()?;
    for m in mismatches {
        let leaf = elements.leaves[m.element as usize];
        let needed =
            |l: Label| deficit.lacking[l.index()] && lattice.leaf_edge(leaf) > 2.0 * targets.min_size[l.index()];
        let lost = m.component != u32::MAX && deficit.lost.binary_search(&m.component).is_ok();
        if lost || needed(m.element_label) || needed(m.voxel_label) {
            marked[leaf as usize] |= u32::from(lattice.levels[leaf as usize]) < finest;
        }
    }
    if targets.max_size.iter().any(|s| s.is_finite()) {
        for (leaf, label) in elements.leaves.iter().zip(&elements.labels) {
            // The size is the caller's own limit, so it may go past the voxels.
            marked[*leaf as usize] |= lattice.leaf_edge(*leaf) > targets.max_size[label.index()];
        }
    }
    Ok(marked)
}

/// Whether the signed distance of a label that lacks fidelity changes sign within the leaf.
fn changes_sign(lattice: &RedGreenLattice, tet: &[u32; 4], level: u8, deficit: &Deficit, targets: &Targets) -> bool {
    let vertex_labels = tet.map(|v| lattice.vertices.labels[v as usize]);
    let center = lattice.field.label_at(lattice.centroid(tet));
    if vertex_labels == [center; 4] {
        return false;
    }
    let edge = lattice.frame.edge_length(u32::from(level));
    vertex_labels
        .into_iter()
        .chain([center])
        .any(|l| deficit.lacking[l.index()] && edge > 2.0 * targets.min_size[l.index()])
}

/// Whether a boundary bends within the leaf by more than the tolerance.
fn misses_boundary(lattice: &RedGreenLattice, tet: &[u32; 4], level: u8, targets: &Targets) -> bool {
    let field = &lattice.field;
    let edge = lattice.frame.edge_length(u32::from(level));
    let centroid = lattice.centroid(tet);
    let tolerance = targets.surface_tolerance * field.voxel_size();
    // A distance changes by no more than the way, so the centroid misses by at most its way to the vertices.
    let is_fine = edge <= RESOLVED_EDGE * field.voxel_size() || TET_RADIUS * edge <= tolerance;
    if is_fine || field.uniform_label(centroid, TET_RADIUS * edge).is_some() {
        return false;
    }
    let corners = lattice.corners(tet);
    let samples = sample_weights(edge / field.voxel_size());
    let place = |weights: &[f64; 4]| (0..4).map(|i| weights[i] * corners[i]).sum::<DVec3>();
    let mut labels: Vec<Label> = tet.iter().map(|v| lattice.vertices.labels[*v as usize]).collect();
    labels.extend(samples.iter().map(|w| field.label_at(place(w))));
    labels.sort_unstable();
    labels.dedup();
    // Of two labels one is enough: the distances differ in sign only.
    let first = usize::from(labels.len() == 2 || labels[0].is_background());
    labels[first.min(labels.len() - 1)..].iter().any(|label| {
        if edge <= 2.0 * targets.min_size[label.index()] {
            return false;
        }
        let at_corners = corners.map(|p| field.signed_distance(p, *label));
        let (mut any_inside, mut any_outside) = (false, false);
        at_corners.iter().for_each(|d| if *d > 0.0 { any_inside = true } else { any_outside = true });
        let mut bends = false;
        for weights in &samples {
            let distance = field.signed_distance(place(weights), *label);
            if distance > 0.0 {
                any_inside = true
            } else {
                any_outside = true
            }
            let straight: f64 = weights.iter().zip(&at_corners).map(|(w, d)| w * d).sum();
            bends |= (distance - straight).abs() > tolerance;
            if bends && any_inside && any_outside {
                return true;
            }
        }
        false
    })
}

/// Barycentric weights of the samples in a leaf whose edge is that many voxels long: the centroid, and the points that
/// divide the edges into parts of `SAMPLED_LENGTH` or less, at least the middles.
fn sample_weights(edge: f64) -> Vec<[f64; 4]> {
    let parts = ((edge / SAMPLED_LENGTH).ceil() as usize).clamp(2, MOST_PARTS);
    let mut samples = vec![[0.25; 4]];
    for a in 0..=parts {
        for b in 0..=parts - a {
            for c in 0..=parts - a - b {
                let steps = [a, b, c, parts - a - b - c];
                if !steps.contains(&parts) {
                    samples.push(steps.map(|s| s as f64 / parts as f64));
                }
            }
        }
    }
    samples
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::connected_components::{Connectivity, Members};
    use crate::lattice::options::PARAMETERS;
    use crate::lattice::test_images::{voxel_image, with_lattice};
    use crate::parameters::ParameterSet;

    #[test]
    fn samples_of_a_leaf_stand_closer_than_a_thin_rod_is_wide() {
        for edge in [2.5, 4.0, 8.0] {
            let samples = sample_weights(edge);
            assert!(samples.iter().all(|w| (w.iter().sum::<f64>() - 1.0).abs() < 1e-12));
            // The corners are known, all other steps along an edge are sampled.
            let on_first_edge = samples.iter().filter(|w| w[2] == 0.0 && w[3] == 0.0).count();
            assert!(edge / (on_first_edge + 1) as f64 <= SAMPLED_LENGTH);
        }
    }

    #[test]
    fn a_plane_that_the_image_border_cuts_bends_nowhere() {
        let marked = |image: &LabelImage| {
            let mut set = ParameterSet::new(PARAMETERS);
            set.set_text("fidelity", "0.1").unwrap();
            let targets = Targets::new(image.values(), &Options::from_parameters(&set).unwrap()).unwrap();
            with_lattice(image, 6.0, |lattice, context| {
                let elements = lattice.elements(context).unwrap();
                let components = Components::new(image, Connectivity::Vertex, Members::All, context).unwrap();
                let deficit = Deficit::new(&[LabelCount::default(); 2], &[], &components, &targets);
                let demands = Demands { deficit: &deficit, targets: &targets, finest: 2 };
                mark_leaves(&lattice, &elements, &[], &demands, |_| false, context).unwrap()
            })
        };
        let plane = marked(&voxel_image(36, |p| u16::from(p.x + 0.3 * p.y < 21.0)));
        assert!(plane.len() > 200 && !plane.contains(&true));
        // A wall thinner than the leaves does not go by straight elements.
        assert!(marked(&voxel_image(36, |p| u16::from((p.x - 17.2).abs() < 1.5))).contains(&true));
    }
}
