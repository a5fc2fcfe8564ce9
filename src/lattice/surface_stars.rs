//! The surface faces at each vertex, kept as long as its tets stay, and colors for sweeps over surface vertices.
//!
//! # Method
//! 1. A star is stale when a tet at one of its faces was replaced, or one at the vertex took another label. [`SurfaceStars::refresh`]
//!    takes the faces of stale vertices anew, in parallel, and appends them to one array; when most of that is out of date the array
//!    is made anew.
//! 2. Vertices without a color get the smallest one that no vertex they share a tet with has: vertices of one color can be moved at
//!    the same time, since none is in the ball of another. Of two that come into one tet with the same color one loses it. Sweeps take
//!    the colors of a block of vertices after each other, then those of the next block. Whom a vertex shares a tet with is found in
//!    parallel, for a block of vertices; then they are colored in order.
//!
//! # Invariants
//! Stars and colors depend on the mesh and on the replacements so far, not on the number of threads.
//!
//! # Cost
//! 9 bytes per vertex, 20 per surface face and vertex of it.

use rayon::prelude::*;

use crate::context::RunContext;
use crate::error::Result;
use crate::lattice::improvement_mesh::{ImprovementMesh, SurfaceFace};
use crate::lattice::planned_batches::LEAST_THREADS;

/// No color yet.
const UNCOLORED: u8 = u8::MAX;

/// A star that must be taken anew.
const STALE: u32 = u32::MAX;

/// Surface faces of a vertex that room is made for: six in the mean where two labels meet, more where more do.
const FACES_OF_VERTEX: usize = 8;

/// Vertices per parallel work item.
const CHUNK: usize = 1 << 10;

/// Vertices per parallel work item whose neighbours are looked for before they are colored.
const COLORED_CHUNK: usize = 1 << 8;

/// Vertices of a block: what is around them stays in the cache while their colors follow each other.
const BLOCK: usize = 1 << 14;

/// A set of colors.
#[derive(Debug, Clone, Copy, Default)]
struct Colors([u64; 4]);

impl Colors {
    #[inline]
    fn add(&mut self, color: u8) {
        self.0[usize::from(color / 64)] |= 1 << (color % 64);
    }

    /// The smallest color that is not in the set. A vertex with that many neighbours of all colors keeps none, and a sweep leaves
    /// it out.
    fn first_free(self) -> u8 {
        let free = self.0.iter().enumerate().find(|(_, word)| **word != u64::MAX);
        free.map_or(UNCOLORED, |(at, word)| 64 * at as u8 + word.trailing_ones() as u8)
    }
}

/// Surface faces by vertex, and colors.
#[derive(Debug, Clone, Default)]
pub struct SurfaceStars {
    /// First face of each vertex and how many; `STALE` where they are out of date.
    rows: Vec<[u32; 2]>,
    faces: Vec<SurfaceFace>,
    /// Faces in rows that are up to date.
    live: usize,
    colors: Vec<u8>,
}

impl SurfaceStars {
    /// Stars of so many vertices, all stale.
    pub fn new(vertices: usize) -> Self {
        Self { rows: vec![[0, STALE]; vertices], colors: vec![UNCOLORED; vertices], ..Self::default() }
    }

    /// The faces of a vertex have changed, or the tets at them.
    pub fn invalidate(&mut self, v: u32) {
        if let Some(row) = self.rows.get_mut(v as usize)
            && row[1] != STALE
        {
            self.live -= row[1] as usize;
            row[1] = STALE;
        }
    }

    /// A tet is about to be replaced by others of its label: the faces that it lies at are out of date.
    pub fn invalidate_at(&mut self, t: u32, corners: [u32; 4]) {
        for v in corners {
            if self.of(v).is_some_and(|star| star.iter().any(|face| face.inner == t || face.outer == Some(t))) {
                self.invalidate(v);
            }
        }
    }

    /// Vertices have come into one tet: none keeps the color of another.
    pub fn part_colors(&mut self, corners: [u32; 4]) {
        let mut taken = [UNCOLORED; 4];
        for (at, v) in corners.into_iter().enumerate() {
            let Some(color) = self.colors.get_mut(v as usize) else { continue };
            if *color != UNCOLORED && taken[..at].contains(color) {
                *color = UNCOLORED;
            }
            taken[at] = *color;
        }
    }

    /// The vertices from a number on are no more.
    pub fn truncate(&mut self, vertices: usize) {
        (vertices..self.rows.len()).for_each(|v| self.invalidate(v as u32));
        self.rows.truncate(vertices);
        self.colors.truncate(vertices);
    }

    /// Follows new numbers of vertices and tets, `old` the vertices in their new order.
    pub fn renumber(&mut self, old: &[u32], new_vertices: &[u32], new_tets: &[u32]) {
        let before = std::mem::replace(self, Self::new(old.len()));
        let color = |v: &u32| before.colors.get(*v as usize).copied().unwrap_or(UNCOLORED);
        self.colors = old.par_iter().with_min_len(CHUNK).map(color).collect();
        let known: Vec<u32> = (0..old.len() as u32)
            .into_par_iter()
            .with_min_len(CHUNK)
            .filter(|v| before.of(old[*v as usize]).is_some())
            .collect();
        let follow = |face: &SurfaceFace| {
            let tet = |t: u32| new_tets[t as usize];
            let others = face.others.map(|v| new_vertices[v as usize]);
            SurfaceFace::seen_from_first(others, tet(face.inner), face.outer.map(tet))
        };
        let of_chunk = |vertices: &[u32]| {
            let mut faces: Vec<SurfaceFace> = Vec::with_capacity(FACES_OF_VERTEX * vertices.len());
            let count = |v: &u32| {
                let first = faces.len();
                faces.extend(before.of(old[*v as usize]).unwrap_or(&[]).iter().map(follow));
                faces[first..].sort_unstable_by_key(SurfaceFace::key);
                (faces.len() - first) as u32
            };
            (vertices.iter().map(count).collect(), faces)
        };
        let parts: Vec<(Vec<u32>, Vec<SurfaceFace>)> = known.par_chunks(CHUNK).map(of_chunk).collect();
        self.append(&known, parts);
    }

    /// Appends the stars of some vertices, which come in parts: how many faces each vertex has, and the faces.
    fn append(&mut self, vertices: &[u32], parts: Vec<(Vec<u32>, Vec<SurfaceFace>)>) {
        for (vertices, (counts, faces)) in vertices.chunks(CHUNK).zip(parts) {
            let mut first = self.faces.len() as u32;
            for (v, count) in vertices.iter().zip(counts) {
                self.rows[*v as usize] = [first, count];
                first += count;
            }
            self.live += faces.len();
            self.faces.extend(faces);
        }
    }

    /// The surface faces of a vertex; `None` where they are out of date.
    #[inline]
    pub fn of(&self, v: u32) -> Option<&[SurfaceFace]> {
        let [first, count] = *self.rows.get(v as usize)?;
        (count != STALE).then(|| &self.faces[first as usize..][..count as usize])
    }

    /// Brings stars and colors up to date.
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`], [`crate::Error::LimitReached`]: colors are not to be used then.
    pub fn refresh(&mut self, mesh: &ImprovementMesh, context: &RunContext) -> Result<()> {
        let count = mesh.points.len();
        self.rows.resize(count, [0, STALE]);
        self.colors.resize(count, UNCOLORED);
        if self.faces.len() > 2 * self.live + CHUNK {
            self.rows.fill([0, STALE]);
            self.faces.clear();
            self.live = 0;
        }
        let is_stale = |v: &u32| self.rows[*v as usize][1] == STALE && mesh.is_on_surface(*v);
        let stale: Vec<u32> = (0..count as u32).into_par_iter().with_min_len(CHUNK).filter(is_stale).collect();
        let of_chunk = |vertices: &[u32]| {
            context.check()?;
            let (mut open, mut faces) = (Vec::new(), Vec::with_capacity(FACES_OF_VERTEX * vertices.len()));
            let count = |v: &u32| {
                let first = faces.len();
                mesh.append_surface_faces(*v, &mut open, &mut faces);
                (faces.len() - first) as u32
            };
            Ok((vertices.iter().map(count).collect::<Vec<u32>>(), faces))
        };
        let parts: Vec<(Vec<u32>, Vec<SurfaceFace>)> = stale.par_chunks(CHUNK).map(of_chunk).collect::<Result<_>>()?;
        self.append(&stale, parts);
        let is_uncolored = |v: &u32| self.colors[*v as usize] == UNCOLORED && mesh.is_on_surface(*v);
        let uncolored: Vec<u32> = (0..count as u32).into_par_iter().with_min_len(CHUNK).filter(is_uncolored).collect();
        self.color(mesh, &uncolored, context)
    }

    fn color(&mut self, mesh: &ImprovementMesh, uncolored: &[u32], context: &RunContext) -> Result<()> {
        if context.threads() < LEAST_THREADS {
            let mut open = Vec::new();
            for (at, &v) in uncolored.iter().enumerate() {
                context.check_every(CHUNK, at)?;
                // All before it have their colors.
                self.colors[v as usize] = self.colors_beside(mesh, v, v, &mut open).first_free();
            }
            return Ok(());
        }
        for block in uncolored.chunks(BLOCK) {
            let of_chunk = |vertices: &[u32]| {
                context.check()?;
                let mut open = Vec::new();
                let beside = |v: &u32| {
                    let first = open.len();
                    (self.colors_beside(mesh, *v, block[0], &mut open), open.len() - first)
                };
                Ok((vertices.iter().map(beside).collect::<Vec<(Colors, usize)>>(), open))
            };
            let parts: Vec<(Vec<(Colors, usize)>, Vec<u32>)> =
                block.par_chunks(COLORED_CHUNK).map(of_chunk).collect::<Result<_>>()?;
            for (vertices, (beside, open)) in block.chunks(COLORED_CHUNK).zip(parts) {
                let mut open = open.as_slice();
                for (v, (mut taken, count)) in vertices.iter().zip(beside) {
                    let (own, rest) = open.split_at(count);
                    own.iter().for_each(|w| taken.add(self.colors[*w as usize]));
                    self.colors[*v as usize] = taken.first_free();
                    open = rest;
                }
            }
        }
        Ok(())
    }

    /// Colors of the vertices around one; appends those from `first` up to it that may have none yet, each once.
    fn colors_beside(&self, mesh: &ImprovementMesh, v: u32, first: u32, open: &mut Vec<u32>) -> Colors {
        let begin = open.len();
        let mut taken = Colors::default();
        for t in mesh.ball(v) {
            for w in mesh.tets[*t as usize] {
                let color = self.colors[w as usize];
                taken.add(color);
                if color == UNCOLORED && (first..v).contains(&w) && !open[begin..].contains(&w) {
                    open.push(w);
                }
            }
        }
        taken
    }

    /// The surface vertices with tets by block and color, in order.
    pub fn by_color(&self, mesh: &ImprovementMesh) -> Vec<Vec<u32>> {
        let mut sets: Vec<Vec<u32>> = Vec::new();
        for (block, colors) in self.colors.chunks(BLOCK).enumerate() {
            let first = sets.len();
            for (v, &color) in (block * BLOCK..).zip(colors).filter(|(_, color)| **color != UNCOLORED) {
                if mesh.is_on_surface(v as u32) && !mesh.ball(v as u32).is_empty() {
                    if sets.len() <= first + usize::from(color) {
                        sets.resize(first + usize::from(color) + 1, Vec::new());
                    }
                    sets[first + usize::from(color)].push(v as u32);
                }
            }
        }
        sets
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::grid::Grid;
    use crate::image::label_image::LabelImage;
    use crate::index::{Label, VertexId};
    use crate::lattice::boundary_targets::SourcePoints;
    use crate::lattice::candidate_mesh::CandidateMesh;
    use crate::lattice::local_transformations::{Transformation, TransformationCounts};
    use crate::lattice::subvoxel_surface::SubvoxelSurface;
    use crate::lattice::test_images::voxel_image;
    use crate::lattice::test_meshes::{helix, shaken_block, with_tets};
    use glam::{DMat3, DVec3};

    fn agrees(stars: &SurfaceStars, mesh: &ImprovementMesh) {
        let sets = stars.by_color(mesh);
        let on_surface = |v: &u32| mesh.is_on_surface(*v) && !mesh.ball(*v).is_empty();
        let count = (0..mesh.points.len() as u32).filter(on_surface).count();
        assert_eq!(sets.iter().map(Vec::len).sum::<usize>(), count);
        for set in sets {
            for &v in &set {
                let mut faces = Vec::new();
                mesh.append_surface_faces(v, &mut Vec::new(), &mut faces);
                assert_eq!(stars.of(v).unwrap(), faces);
                let beside = mesh.ball(v).iter().flat_map(|t| mesh.tets[*t as usize]);
                assert!(beside.filter(|w| *w != v).all(|w| !set.contains(&w)));
            }
        }
    }

    #[test]
    fn colors_are_those_of_one_thread() {
        let (points, tets) = helix(3000);
        let image = voxel_image(4, |_| 1);
        let colors = |threads: usize| {
            with_tets(points.clone(), &tets, &image, |mut mesh| {
                let context = RunContext::with_threads(threads).unwrap();
                mesh.refresh_stars(&context).unwrap();
                agrees(mesh.stars(), &mesh);
                mesh.relabel(1500, Label(3));
                mesh.replace(&[700], &[]);
                mesh.refresh_stars(&context).unwrap();
                mesh.stars().colors.clone()
            })
        };
        assert!(colors(1).iter().filter(|color| **color != UNCOLORED).count() > 2000);
        assert_eq!(colors(1), colors(3));
    }

    /// Stars that are not stale are those that would be found anew, and no two vertices of a tet have one color.
    fn holds(mesh: &ImprovementMesh) -> usize {
        let known = |v: &u32| mesh.stars().of(*v).map(|star| (*v, star));
        let stars = (0..mesh.points.len() as u32).filter_map(|v| known(&v));
        let count = stars.map(|(v, star)| {
            let mut faces = Vec::new();
            mesh.append_surface_faces(v, &mut Vec::new(), &mut faces);
            assert_eq!(star, faces, "{v}");
        });
        let count = count.count();
        for tet in (0..mesh.tets.len() as u32).filter(|t| mesh.is_live(*t)).map(|t| mesh.tets[t as usize]) {
            let color = |v: u32| mesh.stars().colors.get(v as usize).copied().unwrap_or(UNCOLORED);
            let mut colors = tet.map(color);
            colors.sort_unstable();
            assert!(colors.windows(2).all(|pair| pair[0] != pair[1] || pair[0] == UNCOLORED), "{tet:?} {colors:?}");
        }
        count
    }

    #[test]
    fn what_is_known_holds_after_transformations_trials_and_new_numbers() {
        let (points, labelled) = shaken_block(0.2, |i| 1 + u16::from(i >= 5));
        let image = voxel_image(12, |p| 1 + u16::from(p.x >= 6.0));
        with_tets(points, &labelled, &image, |mut mesh| {
            let context = RunContext::with_threads(1).unwrap();
            mesh.refresh_stars(&context).unwrap();
            let all = holds(&mesh);
            let (mut counts, mut kept) = (TransformationCounts::default(), 0);
            let mut transform = |mesh: &mut ImprovementMesh, step: usize| {
                for t in (0..mesh.tets.len() as u32).step_by(step) {
                    if mesh.is_live(t)
                        && let Some(found) =
                            mesh.with_scratch(|mesh, ball| Transformation::plan(mesh, t, 0.2, |_| false, ball))
                    {
                        found.make(mesh, &mut counts);
                    }
                }
                kept += holds(mesh);
            };
            transform(&mut mesh, 31);
            let trial = mesh.begin_trial();
            transform(&mut mesh, 29);
            mesh.take_back(trial);
            holds(&mesh);
            // Stars that were refreshed within a trial are none of the mesh before it.
            let trial = mesh.begin_trial();
            transform(&mut mesh, 23);
            mesh.refresh_stars(&context).unwrap();
            mesh.take_back(trial);
            holds(&mesh);
            mesh.refresh_stars(&context).unwrap();
            transform(&mut mesh, 19);
            let known = holds(&mesh);
            mesh.renumber_along_curve(&mut CandidateMesh::default(), &context).unwrap();
            assert_eq!(holds(&mesh), known);
            mesh.refresh_stars(&context).unwrap();
            agrees(mesh.stars(), &mesh);
            let made = [counts.edge_removals, counts.contractions, counts.splits];
            assert!(made.iter().all(|count| *count > 0) && all > 300 && kept > all, "{made:?} {all} {kept}");
        });
    }

    #[test]
    fn stars_and_colors_follow_the_tets() {
        // An octahedron around an edge, one of its four tets of another label.
        let points = vec![DVec3::NEG_Z, DVec3::Z, DVec3::X, DVec3::Y, DVec3::NEG_X, DVec3::NEG_Y];
        let v = VertexId::from_index;
        let tets: Vec<[VertexId; 4]> = (0..4).map(|i| [v(0), v(1), v(2 + i), v(2 + (i + 1) % 4)]).collect();
        let tet_labels = [1, 1, 1, 2].map(Label).to_vec();
        let mut mesh = CandidateMesh { points, tets, tet_labels, ..CandidateMesh::default() };
        let grid = Grid::new([4; 3], DVec3::ONE, DVec3::ZERO, DMat3::IDENTITY).unwrap();
        let image = LabelImage::new(grid, vec![Label(1); 64], vec![0, 1, 2]).unwrap();
        let context = RunContext::with_threads(1).unwrap();
        let surface = SubvoxelSurface::new(&image, &context).unwrap();
        let alone = [[u32::MAX; 4]; 4];
        let sources =
            SourcePoints::new(&mesh.points, &mesh.tets, &mesh.tet_labels, &alone, &surface, &[], &context).unwrap();
        let mut work = ImprovementMesh::new(&mut mesh, &sources, surface);
        work.refresh_stars(&context).unwrap();
        agrees(work.stars(), &work);
        assert_eq!(work.stars().by_color(&work).len(), 4);
        let label = Label(1);
        work.replace(&[0, 1], &[[0, 3, 2, 4], [1, 2, 3, 4], [0, 1, 2, 4]].map(|tet| (tet, label)));
        assert!(work.stars().of(3).is_none() && work.stars().of(5).is_some());
        work.refresh_stars(&context).unwrap();
        agrees(work.stars(), &work);
        work.replace(&[2], &[]);
        context.cancel_token().cancel();
        assert!(matches!(work.refresh_stars(&context), Err(crate::Error::Cancelled)));
        assert!(work.stars().of(0).is_none());
    }
}
