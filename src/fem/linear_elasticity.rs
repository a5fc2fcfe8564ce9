//! Linear elasticity from mesh to displacements: assemble, constrain, solve, report.
//!
//! # Method
//! `K u = f` with prescribed displacements and point loads.
//!
//! # Source
//! [Hughes2000].
//!
//! # Limits
//! A model that can move as a whole has no unique solution: the report's outcome then is a breakdown or exhausted
//! iterations, and the displacements are finite but not an equilibrium.

use glam::DVec3;

use crate::context::RunContext;
use crate::error::Result;
use crate::fem::assembly::{ModelPattern, assemble_stiffness};
use crate::fem::constraints::{PointLoad, PrescribedDisplacement, apply_loads, prescribe};
use crate::fem::element_mesh::ElementMesh;
use crate::fem::element_stiffness::Formulation;
use crate::fem::material::MaterialMap;
use crate::sparse::conjugate_gradient::{SolveReport, StoppingRule};
use crate::sparse::solver::{SolverKind, solve};

/// A boundary value problem on a mesh.
#[derive(Debug, Clone)]
pub struct ElasticProblem {
    /// Material per label.
    pub materials: MaterialMap,
    /// Element formulation.
    pub formulation: Formulation,
    /// Given displacements.
    pub prescribed: Vec<PrescribedDisplacement>,
    /// Given forces.
    pub loads: Vec<PointLoad>,
    /// Solver.
    pub solver: SolverKind,
    /// When the solver stops.
    pub stopping: StoppingRule,
}

/// Solves the problem; one displacement per node, unit of the points.
///
/// # Errors
/// As [`assemble_stiffness`] and [`crate::sparse::solver::solve`].
pub fn solve_elasticity(
    mesh: &ElementMesh,
    problem: &ElasticProblem,
    context: &RunContext,
) -> Result<(Vec<DVec3>, SolveReport)> {
    mesh.check()?;
    let model = ModelPattern::new(mesh, context)?;
    let mut matrix = assemble_stiffness(mesh, &model, &problem.materials, problem.formulation, context)?;
    let mut right = vec![DVec3::ZERO; mesh.points.len()];
    apply_loads(&problem.loads, &mut right);
    prescribe(&problem.prescribed, &mut matrix, &mut right);
    let mut displacements = vec![DVec3::ZERO; mesh.points.len()];
    let report = solve(&matrix, &right, &mut displacements, problem.solver, &problem.stopping, context)?;
    Ok((displacements, report))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fem::material::Material;
    use crate::fem::quadrature::quadrature;
    use crate::fem::shape_functions::QUADRATIC_HEX_EDGES;
    use crate::fem::shape_functions::{MAX_NODES, shape_functions};
    use crate::index::VertexId;
    use crate::mesh::mixed_mesh::{ElementKind, MixedMesh};
    use crate::mesh::numbering::QUADRATIC_TET_EDGES;
    use std::collections::BTreeMap;

    /// Elements that fill a unit hexahedron with corners 0 to 7 (8 is its center), for each kind.
    fn pieces(kind: ElementKind) -> Vec<Vec<usize>> {
        match kind {
            ElementKind::Hexahedron | ElementKind::QuadraticHexahedron => vec![(0..8).collect()],
            // VTK's wedges: base 0 1 2 clockwise seen from the top.
            ElementKind::Wedge => vec![vec![0, 2, 1, 4, 6, 5], vec![0, 3, 2, 4, 7, 6]],
            ElementKind::Pyramid => {
                crate::mesh::numbering::HEX_FACES.iter().map(|f| vec![f[0], f[3], f[2], f[1], 8]).collect()
            }
            ElementKind::Tet | ElementKind::QuadraticTet => {
                [[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]]
                    .map(|t| t.to_vec())
                    .to_vec()
            }
        }
    }

    /// `n^3` distorted unit cells of the unit cube, meshed with one kind; mid-edge nodes are added on straight edges.
    fn cube_mesh(kind: ElementKind, n: usize, distortion: f64) -> MixedMesh {
        let mut points = Vec::new();
        let at = |i: usize, j: usize, k: usize| i + (n + 1) * (j + (n + 1) * k);
        for k in 0..=n {
            for j in 0..=n {
                for i in 0..=n {
                    let p = DVec3::new(i as f64, j as f64, k as f64) / n as f64;
                    let bump = (p * std::f64::consts::PI).to_array().iter().map(|a| a.sin()).product::<f64>();
                    points.push(p + DVec3::new(0.4, -0.3, 0.5) * (bump * distortion));
                }
            }
        }
        let mut mesh = MixedMesh { offsets: vec![0], ..MixedMesh::default() };
        let mut edges: BTreeMap<(usize, usize), usize> = BTreeMap::new();
        for k in 0..n {
            for j in 0..n {
                for i in 0..n {
                    let mut corners: Vec<usize> = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
                        .into_iter()
                        .chain([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
                        .map(|o| at(i + o[0], j + o[1], k + o[2]))
                        .collect();
                    if kind == ElementKind::Pyramid {
                        let center = corners.iter().map(|c| points[*c]).sum::<DVec3>() / 8.0;
                        corners.push(points.len());
                        points.push(center);
                    }
                    for piece in pieces(kind) {
                        let mut nodes: Vec<usize> = piece.iter().map(|p| corners[*p]).collect();
                        let table: &[[usize; 2]] = match kind {
                            ElementKind::QuadraticTet => &QUADRATIC_TET_EDGES,
                            ElementKind::QuadraticHexahedron => &QUADRATIC_HEX_EDGES,
                            _ => &[],
                        };
                        for [a, b] in table {
                            let key = (nodes[*a].min(nodes[*b]), nodes[*a].max(nodes[*b]));
                            let middle = *edges.entry(key).or_insert_with(|| {
                                points.push(points[key.0].midpoint(points[key.1]));
                                points.len() - 1
                            });
                            nodes.push(middle);
                        }
                        mesh.types.push(kind.vtk_type());
                        mesh.labels.push(1);
                        mesh.connectivity.extend(nodes.iter().map(|n| VertexId::from_index(*n)));
                        mesh.offsets.push(mesh.connectivity.len() as i64);
                    }
                }
            }
        }
        mesh.points = points;
        mesh.check_shape().unwrap();
        mesh
    }

    const CASES: [(ElementKind, Formulation); 8] = [
        (ElementKind::Tet, Formulation::Standard),
        (ElementKind::QuadraticTet, Formulation::Standard),
        (ElementKind::Pyramid, Formulation::Standard),
        (ElementKind::Wedge, Formulation::Standard),
        (ElementKind::Hexahedron, Formulation::Standard),
        (ElementKind::Hexahedron, Formulation::ExtraShapeFunctions),
        (ElementKind::QuadraticHexahedron, Formulation::Standard),
        (ElementKind::QuadraticHexahedron, Formulation::ExtraShapeFunctions),
    ];

    fn is_on_boundary(p: DVec3) -> bool {
        p.min_element() < 1e-9 || p.max_element() > 1.0 - 1e-9
    }

    fn problem(
        formulation: Formulation,
        prescribed: Vec<PrescribedDisplacement>,
        loads: Vec<PointLoad>,
    ) -> ElasticProblem {
        ElasticProblem {
            materials: MaterialMap::uniform(Material::new(2.0, 0.3).unwrap()),
            formulation,
            prescribed,
            loads,
            solver: SolverKind::default(),
            stopping: StoppingRule { relative_tolerance: 1e-12, max_iterations: 4000 },
        }
    }

    fn on_boundary(mesh: &MixedMesh, field: impl Fn(DVec3) -> DVec3) -> Vec<PrescribedDisplacement> {
        (0..mesh.points.len())
            .filter(|&i| is_on_boundary(mesh.points[i]))
            .map(|i| PrescribedDisplacement::full(VertexId::from_index(i), field(mesh.points[i])))
            .collect()
    }

    #[test]
    fn patch_test_every_element_reproduces_a_linear_field() {
        let field = |p: DVec3| {
            DVec3::new(0.01 * p.x + 0.02 * p.y, -0.03 * p.y + 0.01 * p.z + 0.1, 0.02 * p.z - 0.01 * p.x) + DVec3::X
        };
        let context = RunContext::with_threads(2).unwrap();
        for (kind, formulation) in CASES {
            let mesh = cube_mesh(kind, 3, 0.15);
            let problem = problem(formulation, on_boundary(&mesh, field), Vec::new());
            let (u, report) = solve_elasticity(&ElementMesh::from_mixed(&mesh), &problem, &context).unwrap();
            assert!(report.is_converged(), "{kind:?} {report:?}");
            let error = u.iter().zip(&mesh.points).map(|(u, p)| (*u - field(*p)).length()).fold(0.0, f64::max);
            assert!(error < 1e-9, "{kind:?} {formulation:?} {error}");
        }
    }

    /// Displacement and body force of a manufactured solution for E = 2, nu = 0.3.
    fn manufactured(p: DVec3) -> (DVec3, DVec3) {
        let (lambda, mu) = Material::new(2.0, 0.3).unwrap().lame();
        let (sx, cx) = (2.0 * p.x).sin_cos();
        let (sy, cy) = (1.5 * p.y).sin_cos();
        // u = (sin 2x sin 1.5y, 0, 0): div u = 2 cos 2x sin 1.5y.
        let u = DVec3::new(sx * sy, 0.0, 0.0);
        let gradient_of_divergence = DVec3::new(-4.0 * sx * sy, 3.0 * cx * cy, 0.0);
        let laplacian = DVec3::new(-(4.0 + 2.25) * sx * sy, 0.0, 0.0);
        (u, -((lambda + mu) * gradient_of_divergence + mu * laplacian))
    }

    /// L2 error of the finite-element solution of the manufactured problem.
    fn manufactured_error(kind: ElementKind, formulation: Formulation, n: usize, context: &RunContext) -> f64 {
        let mesh = cube_mesh(kind, n, 0.0);
        let view = ElementMesh::from_mixed(&mesh);
        let mut right = vec![DVec3::ZERO; mesh.points.len()];
        integrate(&view, |nodes, values, point, weight| {
            for (node, value) in nodes.iter().zip(values) {
                right[node.index()] += manufactured(point).1 * (*value * weight);
            }
        });
        let loads =
            right.iter().enumerate().map(|(i, f)| PointLoad { node: VertexId::from_index(i), force: *f }).collect();
        let problem = problem(formulation, on_boundary(&mesh, |p| manufactured(p).0), loads);
        let (u, report) = solve_elasticity(&view, &problem, context).unwrap();
        assert!(report.is_converged());
        let mut squared = 0.0;
        integrate(&view, |nodes, values, point, weight| {
            let reached: DVec3 = nodes.iter().zip(values).map(|(n, v)| u[n.index()] * *v).sum();
            squared += (reached - manufactured(point).0).length_squared() * weight;
        });
        squared.sqrt()
    }

    /// Calls `visit(nodes, shape values, point, weight)` at the integration points; tets use the 4-point rule.
    fn integrate(mesh: &ElementMesh, mut visit: impl FnMut(&[VertexId], &[f64; MAX_NODES], DVec3, f64)) {
        for element in 0..mesh.element_count() {
            let (kind, nodes) = mesh.element(element);
            let rule = if kind == ElementKind::Tet { ElementKind::QuadraticTet } else { kind };
            for q in quadrature(rule) {
                let shape = shape_functions(kind, q.point);
                let mut point = DVec3::ZERO;
                let mut map = glam::DMat3::ZERO;
                for (i, node) in nodes.iter().enumerate() {
                    let p = mesh.points[node.index()];
                    point += p * shape.values[i];
                    map.x_axis += p * shape.gradients[i].x;
                    map.y_axis += p * shape.gradients[i].y;
                    map.z_axis += p * shape.gradients[i].z;
                }
                visit(nodes, &shape.values, point, q.weight * map.determinant());
            }
        }
    }

    #[test]
    fn errors_fall_with_the_order_of_the_element() {
        let context = RunContext::with_threads(2).unwrap();
        for (kind, formulation) in CASES {
            let quadratic = kind.node_count() > kind.corner_count();
            // The coarsest meshes are not yet in the range where the order shows.
            let (coarse, fine) = if quadratic { (3, 6) } else { (5, 10) };
            let [before, after] = [coarse, fine].map(|n| manufactured_error(kind, formulation, n, &context));
            let order = (before / after).log2();
            let expected = if quadratic { 2.7 } else { 1.8 };
            assert!(order > expected, "{kind:?} {formulation:?}: order {order:.2}, errors {before:.2e} {after:.2e}");
        }
    }

    #[test]
    fn extra_shape_functions_bend_where_plain_hexahedra_lock() {
        // A cantilever, 8 x 1 x 1, one element thick, end load: beam theory gives F L^3 / (3 E I) = 4 F L^3 / E.
        let deflection = |formulation| {
            let mut mesh = cube_mesh(ElementKind::Hexahedron, 1, 0.0);
            mesh.points.clear();
            mesh.types.clear();
            mesh.connectivity.clear();
            mesh.labels.clear();
            mesh.offsets.truncate(1);
            for i in 0..=8 {
                for (y, z) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
                    mesh.points.push(DVec3::new(f64::from(i), y, z));
                }
            }
            for i in 0..8u32 {
                let at = |layer: u32, c: u32| VertexId(4 * (i + layer) + c);
                let nodes = [at(0, 0), at(1, 0), at(1, 1), at(0, 1), at(0, 3), at(1, 3), at(1, 2), at(0, 2)];
                mesh.connectivity.extend(nodes);
                mesh.offsets.push(mesh.connectivity.len() as i64);
                mesh.types.push(ElementKind::Hexahedron.vtk_type());
                mesh.labels.push(1);
            }
            let fixed = (0..4).map(|i| PrescribedDisplacement::full(VertexId(i), DVec3::ZERO)).collect();
            let loads = (32..36).map(|i| PointLoad { node: VertexId(i), force: DVec3::Z * 0.25e-3 }).collect();
            let mut problem = problem(formulation, fixed, loads);
            problem.materials = MaterialMap::uniform(Material::new(1.0, 0.3).unwrap());
            let context = RunContext::with_threads(1).unwrap();
            let (u, _) = solve_elasticity(&ElementMesh::from_mixed(&mesh), &problem, &context).unwrap();
            u[32].z
        };
        let beam = 4.0 * 512.0 * 1e-3;
        let (plain, extra) = (deflection(Formulation::Standard), deflection(Formulation::ExtraShapeFunctions));
        assert!(plain < 0.75 * beam && (0.95..1.05).contains(&(extra / beam)), "{plain} {extra} {beam}");
    }

    #[test]
    fn all_solvers_agree_on_an_elastic_system_for_any_number_of_threads() {
        let mesh = cube_mesh(ElementKind::Tet, 4, 0.1);
        let field = |p: DVec3| DVec3::new(p.y * p.y, p.x * p.z, 0.3 * p.x) * 0.1;
        let run = |solver, threads| {
            let mut problem = problem(Formulation::Standard, on_boundary(&mesh, field), Vec::new());
            problem.solver = solver;
            problem.stopping.max_iterations = 20_000;
            let context = RunContext::with_threads(threads).unwrap();
            let (u, report) = solve_elasticity(&ElementMesh::from_mixed(&mesh), &problem, &context).unwrap();
            assert!(report.is_converged(), "{solver:?} {report:?}");
            u
        };
        let reference = run(SolverKind::Direct, 1);
        let size = reference.iter().map(|r| r.length()).fold(0.0, f64::max);
        for solver in [
            SolverKind::IncompleteCholeskyCg,
            SolverKind::BlockJacobiCg,
            SolverKind::JacobiCg,
            SolverKind::BiCgStab,
            SolverKind::Lsqr,
        ] {
            let (one, three) = (run(solver, 1), run(solver, 3));
            assert_eq!(one, three, "{solver:?}");
            let error = one.iter().zip(&reference).map(|(a, b)| (*a - *b).length()).fold(0.0, f64::max);
            assert!(error < 1e-6 * size, "{solver:?} {error}");
        }
    }

    #[test]
    fn incomplete_cholesky_holds_on_nearly_incompressible_tissue_beside_a_soft_cavity() {
        let mut mesh = cube_mesh(ElementKind::Hexahedron, 14, 0.1);
        for element in 0..mesh.element_count() {
            let middle = mesh.element(element).1.iter().map(|n| mesh.points[n.index()]).sum::<DVec3>() / 8.0;
            let distance = (middle - DVec3::new(0.4, 0.5, 0.6)).length();
            mesh.labels[element] = if distance < 0.2 { 3 } else { 1 + i32::from(distance < 0.3) };
        }
        let of = |young, poisson| Material::new(young, poisson).unwrap();
        let entries = [(1, of(2.1, 0.45)), (2, of(21.0, 0.49)), (3, of(0.021, 0.1))];
        let context = RunContext::with_threads(2).unwrap();
        let iterations = [SolverKind::IncompleteCholeskyCg, SolverKind::BlockJacobiCg].map(|solver| {
            // The whole first layer: 15 x 15 nodes.
            let fixed = (0..225).map(|i| PrescribedDisplacement::full(VertexId(i), DVec3::ZERO)).collect();
            let loads = vec![PointLoad { node: VertexId(2000), force: DVec3::ONE }];
            let mut problem = problem(Formulation::Standard, fixed, loads);
            problem.materials = MaterialMap::new(None, entries.to_vec());
            (problem.solver, problem.stopping.relative_tolerance) = (solver, 1e-6);
            let (_, report) = solve_elasticity(&ElementMesh::from_mixed(&mesh), &problem, &context).unwrap();
            assert!(report.is_converged(), "{solver:?} {report:?}");
            report.iterations
        });
        let findings = context.take_findings();
        assert!(findings.is_empty(), "{findings:?}");
        assert!(2 * iterations[0] < iterations[1], "{iterations:?}");
    }
}
