// A surface from CGAL goes in, a triangulation of CGAL comes out.
//
//   10_cgal_in_and_out
#include <meshwright.hpp>

#include <CGAL/Exact_predicates_inexact_constructions_kernel.h>
#include <CGAL/Surface_mesh.h>
#include <CGAL/Triangulation_3.h>
#include <CGAL/boost/graph/generators.h>
#include <CGAL/subdivision_method_3.h>

#include <iostream>

using Kernel = CGAL::Exact_predicates_inexact_constructions_kernel;
using Point = Kernel::Point_3;
using Triangulation = CGAL::Triangulation_3<Kernel>;

int main() {
    // A surface of CGAL: a subdivided icosahedron.
    CGAL::Surface_mesh<Point> shape;
    CGAL::make_icosahedron(shape, Point(0, 0, 0), 10.0);
    CGAL::Subdivision_method_3::Loop_subdivision(shape, CGAL::parameters::number_of_iterations(2));
    try {
        const mw::Context context;
        std::vector<double> coordinates;
        std::vector<std::int32_t> triangles;
        for (const auto vertex : shape.vertices())
            for (int axis = 0; axis < 3; ++axis) coordinates.push_back(shape.point(vertex)[axis]);
        for (const auto face : shape.faces())
            for (const auto vertex : CGAL::vertices_around_face(shape.halfedge(face), shape))
                triangles.push_back(static_cast<std::int32_t>(vertex.idx()));

        mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
        job.set("surface", mw::Surface(context, coordinates, triangles));
        job.run();
        const mw::Mesh mesh = job.mesh();
        std::cout << mesh.cell_count() << " tetrahedra\n";

        // A triangulation of CGAL with the same points: its finite vertices are ours, exactly.
        std::vector<Point> points;
        for (std::size_t i = 0; i < mesh.point_count(); ++i)
            points.emplace_back(mesh.points()[3 * i], mesh.points()[3 * i + 1], mesh.points()[3 * i + 2]);
        const Triangulation triangulation(points.begin(), points.end());
        double ours = 0.0, theirs = 0.0;
        for (std::size_t cell = 0; cell < mesh.cell_count(); ++cell) {
            const std::int32_t *v = mesh.tets().data() + 4 * cell;
            ours += CGAL::volume(points[v[0]], points[v[1]], points[v[2]], points[v[3]]);
        }
        for (const auto cell : triangulation.finite_cell_handles()) theirs += triangulation.tetrahedron(cell).volume();
        std::cout << triangulation.number_of_vertices() << " vertices; volume " << ours << ", of the convex hull "
                  << theirs << '\n';
        return triangulation.is_valid() && triangulation.number_of_vertices() == mesh.point_count() &&
                       ours <= theirs * (1.0 + 1e-12) ? 0 : 1;
    } catch (const mw::Error &error) {
        std::cerr << error.what() << '\n';
        return 1;
    }
}
