//! The background elements around the mesh, which keep its surface from running through itself while it is smoothed.
//!
//! # Method
//! The lattice fills the background too. Those of its background elements that share a vertex with a labelled one are kept
//! until smoothing is over. Their vertices that no labelled element has stay where they are; all elements, labelled or not,
//! stay positive. A map that keeps every element positive and the outermost vertices in place is one to one: no two parts
//! of the surface can pass through each other, however thin the background between them.
//!
//! # Source
//! [Jiang2017]; there for maps in the plane.
//!
//! # Differences
//! One layer of elements in space; `surface_crossings` has a last look.
//!
//! # Invariants
//! Scaffold elements have no part in the result. Their shape does not count as long as they stay above `SCAFFOLD_ANGLE`.

use glam::DVec3;

use crate::index::{Label, VertexId};

/// Score in degrees that scaffold elements keep: positive, with room for rounding, no more.
pub const SCAFFOLD_ANGLE: f64 = 0.5;

/// Scaffold elements below this score are transformed where that helps, so that they do not lock their vertices.
pub const STIFF_SCAFFOLD_ANGLE: f64 = 4.0;

/// Background elements around a mesh.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Scaffold {
    /// Vertices that no element of the mesh has, local frame, mm. They do not move.
    pub points: Vec<DVec3>,
    /// `n x 4` vertices, positive orientation: those of the mesh, then `points`.
    pub tets: Vec<[VertexId; 4]>,
}

impl Scaffold {
    /// Where a vertex of an element lies; `points` are those of the mesh.
    pub fn place(&self, points: &[DVec3], v: VertexId) -> DVec3 {
        points.get(v.index()).copied().unwrap_or_else(|| self.points[v.index() - points.len()])
    }

    /// The background elements with a vertex of the mesh. `renumbered` holds the number in the mesh of each vertex,
    /// `u32::MAX` where it has none, and `count` such numbers are in use. Elements for which `is_cut` holds are kept too,
    /// with all around them: what a border plane cuts may become part of the mesh, and needs its own surroundings then.
    pub fn around(
        tets: &[[u32; 4]],
        labels: &[Label],
        renumbered: &mut [u32],
        count: usize,
        place: impl Fn(u32) -> DVec3,
        is_cut: Option<&(dyn Fn(&[u32; 4]) -> bool + Sync)>,
    ) -> Self {
        let mut scaffold = Self::default();
        let is_of_mesh = |v: u32| (v as usize) < count;
        let background = || tets.iter().zip(labels).filter(|(_, label)| label.is_background()).map(|(tet, _)| tet);
        let mut is_beside_cut = vec![false; if is_cut.is_some() { renumbered.len() } else { 0 }];
        for tet in background().filter(|tet| is_cut.is_some_and(|is_cut| is_cut(tet))) {
            tet.iter().for_each(|v| is_beside_cut[*v as usize] = true);
        }
        let is_beside_cut = |v: u32| is_beside_cut.get(v as usize).is_some_and(|is| *is);
        for tet in background() {
            if !tet.iter().any(|v| is_of_mesh(renumbered[*v as usize]) || is_beside_cut(*v)) {
                continue;
            }
            scaffold.tets.push(tet.map(|v| {
                let slot = &mut renumbered[v as usize];
                if *slot == u32::MAX {
                    *slot = (count + scaffold.points.len()) as u32;
                    scaffold.points.push(place(v));
                }
                VertexId(*slot)
            }));
        }
        scaffold
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::context::RunContext;
    use crate::image::grid::Grid;
    use crate::image::label_image::LabelImage;
    use crate::lattice;
    use crate::lattice::options::{Options, PARAMETERS};
    use crate::mesh::validation::check_mixed_mesh;
    use crate::parameters::ParameterSet;
    use glam::DMat3;

    /// Labels without any order, smoothed a little: walls, gaps and contacts of one voxel everywhere.
    fn disorder(n: usize) -> LabelImage {
        let mut state = 12345u64;
        let mut noise = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f64 / (1u64 << 24) as f64
        };
        let raw: Vec<f64> = (0..n * n * n).map(|_| noise()).collect();
        let smooth = |i: usize| {
            let near = [0, 1, n - 1, n, n * (n - 1), n * n, n * n * (n - 1)];
            near.iter().map(|step| raw[(i + step) % raw.len()]).sum::<f64>()
        };
        let label = |value: f64| Label(if value < 3.4 { 0 } else { 1 + u16::from(value > 3.8) });
        let voxels = (0..n * n * n).map(|i| label(smooth(i))).collect();
        let grid = Grid::new([n; 3], DVec3::new(1.0, 1.0, 1.4), DVec3::ZERO, DMat3::IDENTITY).unwrap();
        LabelImage::new(grid, voxels, vec![0, 1, 2]).unwrap()
    }

    #[test]
    fn the_surface_of_a_disordered_image_does_not_run_through_itself() {
        let context = RunContext::with_threads(2).unwrap();
        let mut set = ParameterSet::new(PARAMETERS);
        set.set_text("lattice-spacing", "4").unwrap();
        let options = Options::from_parameters(&set).unwrap();
        let (output, report) = lattice::run(&disorder(10), &options, &context).unwrap();
        check_mixed_mesh(&output.mesh).unwrap();
        assert_eq!(report.statistics().value("improvement.crossings"), Some(0.0));
        assert!(output.mesh.element_count() > 1000);
    }

    #[test]
    fn the_scaffold_is_what_touches_the_mesh() {
        // Two background elements beside a labelled one, and one apart.
        let tets = [[0, 1, 2, 3], [1, 2, 3, 4], [0, 5, 6, 7], [4, 5, 6, 7]];
        let labels = [1, 0, 0, 0].map(Label);
        let mut renumbered = [0, 1, 2, 3, u32::MAX, u32::MAX, u32::MAX, u32::MAX];
        let place = |v: u32| DVec3::splat(f64::from(v));
        let scaffold = Scaffold::around(&tets, &labels, &mut renumbered, 4, place, None);
        assert_eq!(scaffold.tets, [[1, 2, 3, 4].map(VertexId), [0, 5, 6, 7].map(VertexId)]);
        assert_eq!(scaffold.points, [4.0, 5.0, 6.0, 7.0].map(DVec3::splat));
        let of_mesh = [DVec3::X; 4];
        assert_eq!(
            (scaffold.place(&of_mesh, VertexId(2)), scaffold.place(&of_mesh, VertexId(5))),
            (DVec3::X, DVec3::splat(5.0))
        );
    }

    #[test]
    fn what_a_plane_cuts_is_kept_with_its_neighbours() {
        // A row of background elements that leads away from a labelled one; the third one is cut.
        let tets = [[0, 1, 2, 3], [3, 4, 5, 6], [6, 7, 8, 9], [9, 10, 11, 12], [12, 13, 14, 15], [15, 16, 17, 18]];
        let labels = [1, 0, 0, 0, 0, 0].map(Label);
        let kept = |is_cut: Option<&(dyn Fn(&[u32; 4]) -> bool + Sync)>| {
            let mut renumbered: Vec<u32> = (0..19).map(|v| if v < 4 { v } else { u32::MAX }).collect();
            let place = |v: u32| DVec3::splat(f64::from(v));
            Scaffold::around(&tets, &labels, &mut renumbered, 4, place, is_cut).tets.len()
        };
        assert_eq!(kept(None), 1);
        assert_eq!(kept(Some(&|tet| tet[0] == 9)), 4);
    }
}
