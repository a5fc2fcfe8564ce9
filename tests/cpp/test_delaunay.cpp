// The Delaunay mesh of a surface's points (boundary-recovery 0) beside CGAL's: the sphere of every tet is empty, the hull
// is full, and for points in general position the tets are the same.
#include "support.hpp"

#include <CGAL/Delaunay_triangulation_3.h>
#include <CGAL/Exact_predicates_inexact_constructions_kernel.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <map>

using Kernel = CGAL::Exact_predicates_inexact_constructions_kernel;
using Point = Kernel::Point_3;
using Triangulation = CGAL::Delaunay_triangulation_3<Kernel>;

/// Numbers in [0, 1), the same in every run.
static double next_number() {
    static std::uint64_t state = 12345;
    state = state * 6364136223846793005ull + 1442695040888963407ull;
    return static_cast<double>(state >> 11) / 9007199254740992.0;
}

struct Shape {
    std::vector<double> points;
    std::vector<std::int32_t> triangles;
};

/// The six sides of a cube of n^3 cells, each point moved outward from the middle by a factor of up to 1 + `rough`, or
/// brought onto a sphere; all of it scaled and moved.
static Shape cube_surface(int n, double rough, bool round, double scale, double offset) {
    Shape shape;
    std::map<std::array<int, 3>, std::int32_t> known;
    const auto vertex = [&](const std::array<int, 3> &cell) {
        const auto found = known.find(cell);
        if (found != known.end()) return found->second;
        double place[3], length = 0.0;
        for (int axis = 0; axis < 3; ++axis) {
            place[axis] = 2.0 * cell[axis] / n - 1.0;
            length += place[axis] * place[axis];
        }
        const double factor = (round ? 1.0 / std::sqrt(length) : 1.0) * (1.0 + rough * next_number());
        for (double coordinate : place) shape.points.push_back(offset + scale * factor * coordinate);
        return known[cell] = static_cast<std::int32_t>(known.size());
    };
    for (int axis = 0; axis < 3; ++axis)
        for (int side = 0; side < 2; ++side)
            for (int i = 0; i < n; ++i)
                for (int j = 0; j < n; ++j) {
                    const auto at = [&](int u, int v) {
                        std::array<int, 3> cell;
                        cell[axis] = side * n;
                        cell[(axis + 1) % 3] = side ? u : v;
                        cell[(axis + 2) % 3] = side ? v : u;
                        return vertex(cell);
                    };
                    const int u = side ? i : j, v = side ? j : i;
                    const std::int32_t a = at(u, v), b = at(u + 1, v), c = at(u + 1, v + 1), d = at(u, v + 1);
                    for (std::int32_t corner : {a, b, c, a, c, d}) shape.triangles.push_back(corner);
                }
    return shape;
}

static void compare(const mw::Context &context, const char *name, const Shape &shape, bool general) {
    mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
    job.set("surface", mw::Surface(context, shape.points, shape.triangles));
    job.set("boundary-recovery", 0);
    job.run();
    const mw::Mesh mesh = job.mesh();
    std::vector<Point> points;
    for (std::size_t i = 0; i < mesh.point_count(); ++i)
        points.emplace_back(mesh.points()[3 * i], mesh.points()[3 * i + 1], mesh.points()[3 * i + 2]);
    CHECK(mesh.point_count() == shape.points.size() / 3);

    // Empty across every face is empty altogether.
    std::map<std::array<std::int32_t, 3>, std::array<std::size_t, 2>> sides;
    std::size_t inverted = 0, conflicts = 0, pairs = 0;
    double volume = 0.0;
    const std::int32_t *tets = mesh.tets().data();
    for (std::size_t cell = 0; cell < mesh.cell_count(); ++cell) {
        const std::int32_t *v = tets + 4 * cell;
        inverted += CGAL::orientation(points[v[0]], points[v[1]], points[v[2]], points[v[3]]) != CGAL::POSITIVE;
        volume += CGAL::volume(points[v[0]], points[v[1]], points[v[2]], points[v[3]]);
        for (int apex = 0; apex < 4; ++apex) {
            std::array<std::int32_t, 3> face = {{v[(apex + 1) % 4], v[(apex + 2) % 4], v[(apex + 3) % 4]}};
            std::sort(face.begin(), face.end());
            const auto found = sides.find(face);
            if (found == sides.end()) {
                sides[face] = {{cell, static_cast<std::size_t>(apex)}};
                continue;
            }
            const std::int32_t *w = tets + 4 * found->second[0];
            conflicts += CGAL::side_of_oriented_sphere(points[w[0]], points[w[1]], points[w[2]], points[w[3]],
                                                       points[v[apex]]) == CGAL::ON_POSITIVE_SIDE;
            ++pairs;
        }
    }
    CHECK(inverted == 0 && conflicts == 0 && pairs > mesh.cell_count());

    const Triangulation peer(points.begin(), points.end());
    double peer_volume = 0.0;
    for (auto cell = peer.finite_cells_begin(); cell != peer.finite_cells_end(); ++cell)
        peer_volume += peer.tetrahedron(cell).volume();
    CHECK(std::fabs(volume - peer_volume) <= 1e-6 * peer_volume);
    if (general) CHECK(mesh.cell_count() == peer.number_of_finite_cells());
    std::printf("%s: %zu tets, CGAL %zu\n", name, mesh.cell_count(), static_cast<std::size_t>(peer.number_of_finite_cells()));
}

int main() {
    try {
        const mw::Context context(2);
        compare(context, "rough", cube_surface(16, 0.05, false, 1.0, 0.0), true);
        compare(context, "rough, 1e-6", cube_surface(16, 0.05, false, 1e-6, 0.0), true);
        compare(context, "rough, 1e6", cube_surface(16, 0.05, false, 1e6, 0.0), true);
        compare(context, "rough, 1e6 away", cube_surface(16, 0.05, false, 1.0, 1e6), true);
        compare(context, "grid", cube_surface(16, 0.0, false, 1.0, 0.0), false);
        compare(context, "grid of thirds", cube_surface(12, 0.0, false, 1.0 / 3.0, 0.1), false);
        compare(context, "sphere", cube_surface(16, 0.0, true, 1.0, 0.0), false);
        compare(context, "nearly a sphere", cube_surface(16, 1e-14, true, 1.0, 3.0), false);
    } catch (const std::exception &error) {
        std::fprintf(stderr, "%s\n", error.what());
        ++failures;
    }
    return finish("test_delaunay");
}
