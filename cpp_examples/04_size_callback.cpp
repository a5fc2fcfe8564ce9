// Element sizes from sources and from a function of the program.
//
//   04_size_callback
#include <meshwright.hpp>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <iostream>
#include <vector>

/// An octahedron of radius 10, each side cut into n^2 triangles and pushed out to a ball.
static mw::Surface ball(const mw::Context &context, int n) {
    std::vector<double> points;
    std::vector<std::int32_t> triangles;
    const auto vertex = [&points](double x, double y, double z) {
        const double scale = 10.0 / std::sqrt(x * x + y * y + z * z);
        const double p[3] = {scale * x, scale * y, scale * z};
        for (std::size_t i = 0; i < points.size(); i += 3)
            if (std::fabs(points[i] - p[0]) + std::fabs(points[i + 1] - p[1]) + std::fabs(points[i + 2] - p[2]) < 1e-9)
                return static_cast<std::int32_t>(i / 3);
        points.insert(points.end(), p, p + 3);
        return static_cast<std::int32_t>(points.size() / 3 - 1);
    };
    for (int octant = 0; octant < 8; ++octant) {
        const double sx = octant & 1 ? -1 : 1, sy = octant & 2 ? -1 : 1, sz = octant & 4 ? -1 : 1;
        const bool turned = sx * sy * sz < 0;
        const auto at = [&](int i, int j) { return vertex(sx * i, sy * j, sz * (n - i - j)); };
        const auto add = [&](std::int32_t a, std::int32_t b, std::int32_t c) {
            triangles.insert(triangles.end(), {a, turned ? c : b, turned ? b : c});
        };
        for (int i = 0; i < n; ++i)
            for (int j = 0; i + j < n; ++j) {
                add(at(i, j), at(i + 1, j), at(i, j + 1));
                if (i + j + 1 < n) add(at(i + 1, j), at(i + 1, j + 1), at(i, j + 1));
            }
    }
    return mw::Surface(context, points, triangles);
}

/// Mean length of the edges whose middle lies within `radius` of the origin.
static double mean_edge(const mw::Mesh &mesh, double radius) {
    double sum = 0.0;
    int count = 0;
    for (std::size_t cell = 0; cell < mesh.cell_count(); ++cell)
        for (int a = 0; a < 4; ++a)
            for (int b = a + 1; b < 4; ++b) {
                const double *p = mesh.points().data() + 3 * mesh.tets()[4 * cell + a];
                const double *q = mesh.points().data() + 3 * mesh.tets()[4 * cell + b];
                double length = 0.0, middle = 0.0;
                for (int axis = 0; axis < 3; ++axis) {
                    length += (p[axis] - q[axis]) * (p[axis] - q[axis]);
                    middle += 0.25 * (p[axis] + q[axis]) * (p[axis] + q[axis]);
                }
                if (middle > radius * radius) continue;
                sum += std::sqrt(length);
                ++count;
            }
    return count ? sum / count : 0.0;
}

int main() {
    try {
        const mw::Context context;
        mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
        job.set("surface", ball(context, 6));
        job.run();
        const mw::Mesh plain = job.mesh();

        // A source at the middle: edges of 0.6 there, growing by a quarter of the distance.
        mw::Sizing sizing(context);
        sizing.add_point({{0, 0, 0}}, 0.6, 0.25);
        // A function: fine towards large x. Several threads call it at once, so the counter is atomic.
        std::atomic<long> calls(0);
        sizing.set_function([&calls](const std::array<double, 3> &point, double size) {
            ++calls;
            return point[0] > 5.0 ? std::min(size, 1.0) : size;
        });
        job.set("sizing", sizing);
        job.run();
        const mw::Mesh fine = job.mesh();
        fine.check();
        std::cout << plain.cell_count() << " tetrahedra without, " << fine.cell_count() << " with sizes; mean edge in "
                  << "the middle " << mean_edge(plain, 2.0) << " and " << mean_edge(fine, 2.0) << " mm; " << calls
                  << " calls of the function\n";
        if (fine.cell_count() <= plain.cell_count() || calls == 0) return 1;

        // What the function throws comes out of run().
        sizing.set_function([](const std::array<double, 3> &, double) -> double { throw std::out_of_range("size"); });
        job.set("sizing", sizing);
        try {
            job.run();
            return 1;
        } catch (const std::out_of_range &error) {
            std::cout << "thrown by the size function: " << error.what() << '\n';
        }
        return 0;
    } catch (const mw::Error &error) {
        std::cerr << error.what() << '\n';
        return 1;
    }
}
