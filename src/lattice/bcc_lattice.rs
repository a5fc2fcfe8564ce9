//! The body-centred cubic lattice: frame, integer vertices, and the coarsest tets over the labelled region.
//!
//! # Method
//! 1. Cubes of edge `spacing` cover the labelled region with one more cube on every side.
//! 2. Across each face between two cubes stand four tets: the two cube centres (a long edge) and one edge of the face
//!    (the other long edge).
//! 3. Tets that no labelled voxel is near, and those far past the border of the image, are left out.
//!
//! ```text
//!     c1 ----|---- c2     c1, c2 centres of neighbouring cubes, v1 v2 one of the four edges of their common face:
//!            v1           tet (c1, c2, v1, v2) has the long edges c1 c2 and v1 v2, both one cube edge.
//! ```
//! Vertices are integers in units of `spacing / 2^depth`, so midpoints are exact and a vertex has one key.
//!
//! # Source
//! [Drakopoulos2017] 2.3.3, [Molino2003].
//!
//! # Invariants
//! Long edges of a stored tet are its local edges 01 and 23; orientation is positive.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::{Error, Result};
use crate::geometry::spatial_sort::hilbert_order;
use crate::image::label_image::LabelImage;
use crate::index::Label;
use crate::lattice::vertex_table::{NewVertex, VertexTable};
use crate::mesh::numbering::TET_EDGES;

/// Bits per axis of a vertex key: three axes fit one word.
const KEY_BITS: u32 = 21;

/// Deepest subdivision that the integers are prepared for; an element of the deepest level is 1/4096 of a cube.
const MAX_DEPTH: u32 = 12;

/// Least depth of the integers: one level of refinement ([`LatticeFrame::max_level`]).
const MIN_DEPTH: u32 = 3;

/// Shift of the lattice against the voxels, in voxels: lattice planes avoid voxel centres and voxel faces, on which the
/// label of a centroid would hang on rounding. Small against a voxel, different along the axes.
const GENERIC_SHIFT: DVec3 = DVec3::new(0.0309, 0.0471, 0.0233);

/// Displacement of voxel centres when they are counted, in voxels: a centre never lies on a face of two elements.
const COUNTING_SHIFT: DVec3 = DVec3::new(1.3e-6, 2.1e-6, 3.7e-6);

/// Elements with edges up to this many voxels take interpolated labels: below two voxels, with room for spacings that are
/// not a power of two times the voxel.
const SMALL_EDGE: f64 = 1.5;

/// Cubes between two looks at whether the run is cancelled.
const CUBES_PER_CHECK: usize = 1024;

/// Distance of a tet's centroid to its farthest vertex, per cube edge: sqrt(5) / 4.
pub const TET_RADIUS: f64 = 0.559_016_994_374_947_5;

/// How far past the border of the image a tet is kept, in radii: up to one it has the label of the nearest voxels where the image
/// continues there, and those at its vertices are two farther.
const RADII_PAST_BORDER: f64 = 3.0;

/// Where the lattice lies in the image.
#[derive(Debug, Clone, Copy)]
pub struct LatticeFrame {
    /// Local point (mm) of integer (0, 0, 0).
    pub origin: DVec3,
    /// Millimetres per integer step.
    pub unit: f64,
    /// Edge of the coarsest cubes, mm.
    pub spacing: f64,
    /// Cubes along each axis.
    pub cubes: IVec3,
    /// `spacing = unit * 2^depth`; levels of refinement stay below `depth - 1`.
    pub depth: u32,
}

impl LatticeFrame {
    /// The frame over the labelled voxels of `image`.
    ///
    /// # Errors
    /// [`Error::InvalidInput`] for an image without a labelled voxel; [`Error::ParameterValue`] for a spacing larger
    /// than the image; [`Error::CapacityExceeded`] for more cubes than the integers hold.
    pub fn new(image: &LabelImage, spacing: f64) -> Result<Self> {
        let (low, high) = labelled_box(image)?;
        let voxel = image.grid().spacing();
        let size = DVec3::from_array(image.grid().size().map(|s| s as f64)) * voxel;
        if spacing > size.max_element() {
            let reason = format!("{spacing} mm is larger than the image, {:?} mm", size.to_array());
            return Err(Error::ParameterValue { name: "lattice-spacing".into(), reason });
        }
        let (low, high) = ((low - 0.5) * voxel, (high + 0.5) * voxel);
        // One cube more on each side: the outermost half cubes hold no tets.
        let cubes = ((high - low) / spacing).ceil() + 2.0;
        let needed = (cubes.max_element() + 1.0).log2().ceil();
        let depth = (f64::from(KEY_BITS) - needed).min(f64::from(MAX_DEPTH));
        if depth < f64::from(MIN_DEPTH) {
            let needed = cubes.max_element() as u64;
            let limit = (1 << (KEY_BITS - MIN_DEPTH)) - 1;
            return Err(Error::CapacityExceeded { what: "lattice cubes along an axis", needed, limit });
        }
        let needed = cubes.element_product() as u64;
        if needed > u64::from(u32::MAX) {
            return Err(Error::CapacityExceeded { what: "lattice cubes", needed, limit: u32::MAX.into() });
        }
        let origin = 0.5 * (low + high) - 0.5 * cubes * spacing + GENERIC_SHIFT * voxel.min_element();
        let depth = depth as u32;
        Ok(Self { origin, unit: spacing / f64::from(1u32 << depth), spacing, cubes: cubes.as_ivec3(), depth })
    }

    /// Local point (mm) of an integer vertex.
    #[inline]
    pub fn local(&self, vertex: IVec3) -> DVec3 {
        self.origin + self.unit * vertex.as_dvec3()
    }

    /// Integer steps of a cube edge at `level`.
    #[inline]
    pub fn edge(&self, level: u32) -> i32 {
        1 << (self.depth - level)
    }

    /// Cube edge at `level`, mm.
    #[inline]
    pub fn edge_length(&self, level: u32) -> f64 {
        self.spacing / f64::from(1u32 << level)
    }

    /// Deepest level whose midpoints are still integers.
    pub fn max_level(&self) -> u32 {
        self.depth - 2
    }
}

/// First and last labelled voxel along each axis.
fn labelled_box(image: &LabelImage) -> Result<(DVec3, DVec3)> {
    let [ni, nj, _] = image.grid().size();
    let (mut low, mut high) = (IVec3::MAX, IVec3::MIN);
    for (row, voxels) in image.voxels().chunks_exact(ni).enumerate() {
        let Some(first) = voxels.iter().position(|l| !l.is_background()) else { continue };
        let last = voxels.iter().rposition(|l| !l.is_background()).unwrap_or(first);
        let (j, k) = ((row % nj) as i32, (row / nj) as i32);
        low = low.min(IVec3::new(first as i32, j, k));
        high = high.max(IVec3::new(last as i32, j, k));
    }
    if low.x > high.x {
        return Err(Error::input("the image has no labelled voxel: everything is background"));
    }
    Ok((low.as_dvec3(), high.as_dvec3()))
}

/// What elements that lie across the image border take for labels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PastBorder {
    /// Those with a centroid outside are background: the mesh ends as near to the border as its elements can.
    Background,
    /// Those of the nearest voxels: the lattice will be cut at the border.
    Continued,
}

/// The image as the lattice sees it: labels and distances at local points.
#[derive(Clone, Copy)]
pub struct Field<'a> {
    /// The segmentation.
    pub image: &'a LabelImage,
    /// Distance to the nearest voxel of another label in the image, mm; infinite where there is none.
    pub distance: &'a [f32],
    past_border: PastBorder,
    size: IVec3,
    voxel: DVec3,
    inverse: DVec3,
    diagonal: f64,
    /// More than any distance within the image, mm.
    extent: f64,
}

impl<'a> Field<'a> {
    /// A view of an image and its distance transform.
    pub fn new(image: &'a LabelImage, distance: &'a [f32], past_border: PastBorder) -> Self {
        let size = IVec3::from_array(image.grid().size().map(|s| s as i32));
        let voxel = image.grid().spacing();
        let extent = (size.as_dvec3() * voxel).length();
        let (inverse, diagonal) = (voxel.recip(), voxel.length());
        Self { image, distance, past_border, size, voxel, inverse, diagonal, extent }
    }

    /// Size of a voxel: the root mean square of its spacings, mm. The staircase of an image is that coarse.
    pub fn voxel_size(&self) -> f64 {
        self.diagonal / 3f64.sqrt()
    }

    /// Size of the image in voxels.
    pub fn size(&self) -> IVec3 {
        self.size
    }

    /// Continuous voxel index of a local point, displaced so that voxel centres are in general position.
    #[inline]
    pub fn counting_index(&self, local: DVec3) -> DVec3 {
        local * self.inverse - COUNTING_SHIFT
    }

    /// The voxel of the image whose centre is nearest.
    #[inline]
    pub fn nearest_voxel(&self, local: DVec3) -> IVec3 {
        self.nearest(local).0
    }

    /// Whether a local point lies in a voxel of the image.
    pub fn contains(&self, local: DVec3) -> bool {
        self.nearest(local).1
    }

    #[inline]
    fn nearest(&self, local: DVec3) -> (IVec3, bool) {
        let index = floor_of(local * self.inverse + 0.5);
        let clamped = index.clamp(IVec3::ZERO, self.size - 1);
        (clamped, clamped == index)
    }

    #[inline]
    fn offset(&self, index: IVec3) -> usize {
        index.x as usize + self.size.x as usize * (index.y as usize + self.size.y as usize * index.z as usize)
    }

    /// The label of the voxel around a local point; outside of the image that of the nearest voxel where it continues there, else
    /// background.
    #[inline]
    pub fn label_at(&self, local: DVec3) -> Label {
        match self.nearest(local) {
            (_, false) if self.past_border == PastBorder::Background => Label::BACKGROUND,
            (index, _) => self.image.voxels()[self.offset(index)],
        }
    }

    /// The label of an element of the given edge around a point.
    ///
    /// For an element smaller than two voxels it is the label with the largest share in the trilinear interpolation of the
    /// labels of the eight voxels around the point: a wall whose voxels touch along edges only is closed there, as it
    /// has two of the four voxels; at the centre of a voxel it is the voxel's label. For a larger element it is the label
    /// of the voxel around the point, a sample without preference, which keeps the shares of rough labels.
    ///
    /// Where the image continues past its border, elements that reach into it have the labels of the nearest voxels.
    #[inline]
    pub fn label_of_element(&self, local: DVec3, edge: f64) -> Label {
        let (index, inside) = self.nearest(local);
        let offset = self.offset(index);
        let own = self.image.voxels()[offset];
        let continues = self.past_border == PastBorder::Continued;
        let has_label = inside || continues && self.reaches_into(local, TET_RADIUS * edge);
        // The eight voxels lie within a voxel's diagonal of the nearest.
        let is_alone = match continues {
            true => f64::from(self.distance[offset]) > self.diagonal,
            false => self.lies_deeper(index, own, self.diagonal) && (inside || own.is_background()),
        };
        if is_alone || edge > SMALL_EDGE * self.voxel_size() || continues && !has_label {
            return if has_label { own } else { Label::BACKGROUND };
        }
        self.interpolated_label(local * self.inverse)
    }

    /// Whether a point is less than `radius` outside of the image, along the axis where that is most; always one inside.
    #[inline]
    fn reaches_into(&self, local: DVec3, radius: f64) -> bool {
        let high = (self.size.as_dvec3() - 0.5) * self.voxel;
        (local - local.clamp(-0.5 * self.voxel, high)).abs().max_element() < radius
    }

    /// Whether no voxel of another label is as near to a voxel of `own` label, the background outside of the image included.
    #[inline]
    fn lies_deeper(&self, index: IVec3, own: Label, distance: f64) -> bool {
        let outside = || ((index.min(self.size - 1 - index) + 1).as_dvec3() * self.voxel).min_element();
        f64::from(self.distance[self.offset(index)]) > distance && (own.is_background() || outside() > distance)
    }

    /// Signed distance to the boundary of `label`, mm, positive inside: interpolated between the voxels' distances, half
    /// a voxel short of the nearest centre beyond the boundary. Past the image its outermost voxels continue: a boundary that
    /// the image cuts does not bend there.
    pub fn signed_distance(&self, local: DVec3, label: Label) -> f64 {
        let at = local * self.inverse;
        let base = floor_of(at);
        let fraction = at - base.as_dvec3();
        let half = 0.5 * self.voxel.min_element();
        let mut sum = 0.0;
        for corner in 0..8 {
            let step = IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2);
            let along = |d: usize| if step[d] == 1 { fraction[d] } else { 1.0 - fraction[d] };
            let offset = self.offset((base + step).clamp(IVec3::ZERO, self.size - 1));
            let distance = f64::from(self.distance[offset]).min(self.extent) - half;
            let sign = if self.image.voxels()[offset] == label { 1.0 } else { -1.0 };
            sum += along(0) * along(1) * along(2) * sign * distance;
        }
        sum
    }

    /// The label with the largest share at a continuous voxel index.
    fn interpolated_label(&self, at: DVec3) -> Label {
        let base = floor_of(at);
        let fraction = at - base.as_dvec3();
        let mut shares = [(Label::BACKGROUND, 0.0f64); 8];
        let mut count = 0;
        for corner in 0..8 {
            let step = IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2);
            let along = |d: usize| if step[d] == 1 { fraction[d] } else { 1.0 - fraction[d] };
            let weight = along(0) * along(1) * along(2);
            let label = match self.past_border {
                PastBorder::Background => self.image.at_or_background(base + step),
                PastBorder::Continued => {
                    self.image.voxels()[self.offset((base + step).clamp(IVec3::ZERO, self.size - 1))]
                }
            };
            match shares[..count].iter_mut().find(|(l, _)| *l == label) {
                Some((_, share)) => *share += weight,
                None => {
                    shares[count] = (label, weight);
                    count += 1;
                }
            }
        }
        let largest = |a: (Label, f64), b: (Label, f64)| if b.1 > a.1 { b } else { a };
        shares[..count].iter().copied().fold((Label::BACKGROUND, 0.0), largest).0
    }

    /// The label that the centres of all voxels within `radius` of `local` share, where there is one label and the
    /// distance transform shows it.
    #[inline]
    pub fn uniform_label(&self, local: DVec3, radius: f64) -> Option<Label> {
        let (index, inside) = self.nearest(local);
        let offset = self.offset(index);
        let label = self.image.voxels()[offset];
        if !inside && !label.is_background() {
            return None;
        }
        // No voxel centre is nearer to a point past them than to where it is nearest to them.
        let within = local.clamp(DVec3::ZERO, (self.size - 1).as_dvec3() * self.voxel);
        let reach = radius + within.distance(index.as_dvec3() * self.voxel);
        self.lies_deeper(index, label, reach).then_some(label)
    }

    /// Whether a tet of the given edge around a point can hold a labelled voxel, have a label, or share a vertex with a tet that has
    /// one, so that what surrounds a thin wall's vertices is there and a pinch can be seen and filled. The label of a small
    /// element comes from voxels within half a diagonal of its centroid, and two centroids at a vertex are at most two radii
    /// apart. Larger elements follow no wall.
    #[inline]
    pub fn is_near_labels(&self, local: DVec3, edge: f64) -> bool {
        let around_wall = 2.0 * TET_RADIUS * edge.min(SMALL_EDGE * self.voxel_size()) + 0.5 * self.diagonal;
        let reach = (TET_RADIUS * edge).max(around_wall);
        self.uniform_label(local, reach) != Some(Label::BACKGROUND)
            && self.reaches_into(local, RADII_PAST_BORDER * TET_RADIUS * edge)
    }
}

/// The whole numbers at or below the coordinates. Without SSE 4.1 `floor` is a call; truncation is one instruction.
#[inline]
pub fn floor_of(at: DVec3) -> IVec3 {
    let whole = at.as_ivec3();
    whole - IVec3::select(whole.as_dvec3().cmpgt(at), IVec3::ONE, IVec3::ZERO)
}

/// Vertices of the lattice: integers, labels, and the index of each key.
#[derive(Default)]
pub struct LatticeVertices {
    /// Integer coordinates. 12 B / vertex.
    pub positions: Vec<IVec3>,
    /// Label of the voxel around the vertex. 2 B / vertex.
    pub labels: Vec<Label>,
    /// Ends of the edge in whose middle the vertex lies; the vertex itself, twice, at the coarsest level. 8 B / vertex.
    pub parents: Vec<[u32; 2]>,
    table: VertexTable,
}

impl LatticeVertices {
    /// The vertex at an integer position of the coarsest level, made where there is none yet.
    pub fn insert(&mut self, position: IVec3, frame: &LatticeFrame, field: &Field) -> u32 {
        let own = self.positions.len() as u32;
        self.insert_middle(position, [own, own], frame, field)
    }

    /// The vertex in the middle of an edge, made where there is none yet.
    pub fn insert_middle(&mut self, position: IVec3, ends: [u32; 2], frame: &LatticeFrame, field: &Field) -> u32 {
        let next = self.positions.len() as u32;
        let vertex = self.table.insert(position, next);
        if vertex == next {
            self.positions.push(position);
            self.parents.push(ends);
            self.label_new(frame, field);
        }
        vertex
    }

    /// The vertices in the middles of the six edges of each of the tets, without labels: [`Self::label_new`] follows.
    ///
    /// # Errors
    /// [`Error::CapacityExceeded`] past 2^31 vertices.
    pub fn insert_middles(&mut self, tets: &[[u32; 4]]) -> Result<Vec<[u32; 6]>> {
        self.insert_between(tets.len(), |tet, e| TET_EDGES[e].map(|v| tets[tet][v]))
    }

    /// The middle vertices of edges.
    ///
    /// # Errors
    /// As [`Self::insert_middles`].
    pub fn split_edges(&mut self, edges: &[[u32; 2]]) -> Result<()> {
        self.insert_between::<1>(edges.len(), |edge, _| edges[edge]).map(|_| ())
    }

    /// `N` middle vertices a row, each between the ends that are given.
    fn insert_between<const N: usize>(
        &mut self,
        rows: usize,
        ends: impl Fn(usize, usize) -> [u32; 2] + Sync,
    ) -> Result<Vec<[u32; N]>> {
        let old = self.positions.len();
        if old + N * rows > i32::MAX as usize {
            let needed = (old + N * rows) as u64;
            return Err(Error::CapacityExceeded { what: "lattice vertices", needed, limit: i32::MAX as u64 });
        }
        let positions = &self.positions;
        let middle = |row: usize, column: usize| {
            let [a, b] = ends(row, column).map(|v| positions[v as usize]);
            (a + b) / 2
        };
        let inserted = self.table.insert_all(rows, old as u32, middle);
        let ends_of = |vertex: &NewVertex| ends(vertex.asked_by.0 as usize, usize::from(vertex.asked_by.1));
        self.positions.par_extend(inserted.new.par_iter().with_min_len(1024).map(|v| v.position));
        self.parents.par_extend(inserted.new.par_iter().with_min_len(1024).map(ends_of));
        Ok(inserted.rows)
    }

    /// Labels the vertices that have none yet.
    pub fn label_new(&mut self, frame: &LatticeFrame, field: &Field) {
        let new = &self.positions[self.labels.len()..];
        let label = |position: &IVec3| field.label_at(frame.local(*position));
        self.labels.par_extend(new.par_iter().with_min_len(1024).map(label));
    }

    /// The vertex at an integer position.
    #[inline]
    pub fn find(&self, position: IVec3) -> Option<u32> {
        self.table.find(position)
    }

    /// The vertex at the middle of an edge, where the edge is split.
    #[inline]
    pub fn middle(&self, a: u32, b: u32) -> Option<u32> {
        self.find((self.positions[a as usize] + self.positions[b as usize]) / 2)
    }
}

/// The cubes of the coarsest lattice along a Hilbert curve. Leaves keep the order of their cubes, elements and vertices that of the
/// leaves: what is near in space is near in memory through all that follows.
fn cubes_along_curve(frame: &LatticeFrame) -> Result<Vec<IVec3>> {
    let [x, y, z] = frame.cubes.to_array();
    let cubes: Vec<DVec3> = (0..z)
        .flat_map(|k| {
            (0..y).flat_map(move |j| (0..x).map(move |i| DVec3::new(f64::from(i), f64::from(j), f64::from(k))))
        })
        .collect();
    Ok(hilbert_order(&cubes)?.into_iter().map(|cube| cubes[cube as usize].as_ivec3()).collect())
}

/// The coarsest tets that are near labels, cube by cube.
///
/// # Errors
/// [`Error::Cancelled`], [`Error::LimitReached`].
pub fn coarsest_tets(
    frame: &LatticeFrame,
    field: &Field,
    vertices: &mut LatticeVertices,
    context: &RunContext,
) -> Result<Vec<[u32; 4]>> {
    let edge = frame.edge(0);
    let axes = [IVec3::X, IVec3::Y, IVec3::Z];
    let mut tets = Vec::new();
    for (number, cube) in cubes_along_curve(frame)?.into_iter().enumerate() {
        context.check_every(CUBES_PER_CHECK, number)?;
        let corner = edge * cube;
        for axis in 0..3 {
            if corner[axis] + edge >= edge * frame.cubes[axis] {
                continue;
            }
            let [along, u, v] = [axes[axis], axes[(axis + 1) % 3], axes[(axis + 2) % 3]];
            let center = corner + edge / 2;
            let face = corner + edge * along;
            let ring = [face, face + edge * u, face + edge * (u + v), face + edge * v];
            for side in 0..4 {
                let tet = [center, center + edge * along, ring[side], ring[(side + 1) % 4]];
                let centroid = 0.25 * tet.iter().map(|p| frame.local(*p)).sum::<DVec3>();
                if field.is_near_labels(centroid, frame.spacing) {
                    tets.push(tet.map(|p| vertices.insert(p, frame, field)));
                }
            }
        }
    }
    Ok(tets)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::distance_transform::distance_to_other_labels;
    use crate::lattice::test_images::voxel_image;

    #[test]
    fn too_many_cubes_are_refused_with_the_number_that_is_too_large() {
        let image = voxel_image(24, |_| 1);
        let numbers = |spacing: f64| match LatticeFrame::new(&image, spacing) {
            Err(Error::CapacityExceeded { what, needed, limit }) => (what, needed, limit),
            other => panic!("{spacing}: {other:?}"),
        };
        // 240 000 cubes across 24 mm, and one on each side; past 2^18 - 1 along an axis no level of refinement is left.
        assert_eq!(numbers(1e-4), ("lattice cubes", 240_002u64.pow(3), u64::from(u32::MAX)));
        assert_eq!(numbers(5e-5), ("lattice cubes along an axis", 480_002, (1 << 18) - 1));
    }

    #[test]
    fn elements_across_the_border_continue_the_image_where_it_does() {
        // The border is at -0.5.
        let image = voxel_image(8, |p| if p.y < 3.9 { 1 } else { 2 });
        let context = RunContext::with_threads(1).unwrap();
        let distance = distance_to_other_labels(&image, &context).unwrap();
        let [plain, continued] =
            [PastBorder::Background, PastBorder::Continued].map(|past| Field::new(&image, &distance, past));
        let label = |field: &Field, x: f64, y: f64, edge: f64| field.label_of_element(DVec3::new(x, y, 4.2), edge).0;
        for (y, own) in [(2.2, 1), (5.3, 2)] {
            for edge in [1.0, 4.0] {
                let reach = TET_RADIUS * edge;
                assert_eq!([&plain, &continued].map(|f| label(f, 0.1, y, edge)), [own; 2]);
                assert_eq!([&plain, &continued].map(|f| label(f, -0.4 - reach, y, edge)), [0, own]);
                assert_eq!([&plain, &continued].map(|f| label(f, -0.6 - reach, y, edge)), [0; 2]);
            }
            let past = DVec3::new(-2.0, y, 4.2);
            assert_eq!([&plain, &continued].map(|f| f.label_at(past).0), [0, own]);
        }
        assert!(continued.contains(DVec3::new(-0.4, 2.2, 4.2)) && !continued.contains(DVec3::new(-0.6, 2.2, 4.2)));
        // Near a corner of the image most of the eight voxels around lie outside.
        let corner = DVec3::splat(-0.4);
        assert_eq!([&plain, &continued].map(|f| f.label_of_element(corner, 1.0).0), [0, 1]);
    }

    #[test]
    fn a_boundary_that_the_image_cuts_goes_straight_on() {
        let image = voxel_image(12, |p| u16::from(p.x < 5.9));
        let context = RunContext::with_threads(1).unwrap();
        let distance = distance_to_other_labels(&image, &context).unwrap();
        let field = Field::new(&image, &distance, PastBorder::Continued);
        for x in [1.3, 4.0, 5.5, 7.2, 13.0] {
            let at = |y: f64| field.signed_distance(DVec3::new(x, y, 6.1), Label(1));
            assert!([-3.0, -0.5, 0.0, 11.0, 14.0].iter().all(|y| (at(*y) - at(6.0)).abs() < 1e-6), "{x}");
        }
        // What may lie outside counts where elements are told to have one label.
        let deep = |y: f64| field.uniform_label(DVec3::new(1.0, y, 6.0), 1.5);
        assert_eq!([deep(6.0), deep(0.2)], [Some(Label(1)), None]);
        assert_eq!(field.uniform_label(DVec3::new(10.0, 0.2, 6.0), 1.5), Some(Label::BACKGROUND));
    }

    #[test]
    fn the_lattice_ends_soon_past_the_border_and_around_all_that_is_labelled() {
        use crate::lattice::face_adjacency::neighbors_of;
        use crate::lattice::interface_topology::InterfaceTopology;
        use crate::lattice::test_images::with_lattice_past;
        // Tissue up to the border on all sides but one, where background lies in between.
        let image = voxel_image(12, |p| if p.x < 8.9 { 1 + u16::from(p.y < 5.9) } else { 0 });
        for border in [PastBorder::Background, PastBorder::Continued] {
            with_lattice_past(border, &image, 6.0, |mut lattice, context| {
                for _ in 0..2 {
                    lattice.refine(&vec![true; lattice.tets.len()], context).unwrap();
                }
                let elements = lattice.elements(context).unwrap();
                let vertices = lattice.vertices.positions.len();
                let neighbors = neighbors_of(&elements.tets, vertices, context).unwrap();
                let topology = InterfaceTopology::new(&elements.tets, &neighbors, vertices, context).unwrap();
                let past = |p: DVec3| (-0.5 - p).max(p - 11.5).max_element();
                let is_inside = |v: u32| past(lattice.frame.local(lattice.vertices.positions[v as usize])) < 0.0;
                let (edge, mut labelled) = (lattice.frame.edge_length(2), 0);
                for (tet, label) in elements.tets.iter().zip(&elements.labels) {
                    assert!(past(lattice.centroid(tet)) < RADII_PAST_BORDER * TET_RADIUS * edge);
                    if !label.is_background() {
                        labelled += 1;
                        assert!(tet.iter().all(|v| !is_inside(*v) || !topology.is_open(*v)), "{border:?}");
                    }
                }
                // A tet is a twelfth of the cube of its edge; where the image continues the mesh is up to a radius larger.
                let volume = |past: f64| (12.0 + 2.0 * past) * (12.0 + 2.0 * past) * (9.4 + past);
                let count = |past: f64| 12.0 * volume(past) / edge.powi(3);
                assert!(labelled as f64 > 0.9 * count(0.0) && (labelled as f64) < 1.05 * count(TET_RADIUS * edge));
            });
        }
    }
}
