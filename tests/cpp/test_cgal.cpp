// CGAL's exact kernel: every tet is positively oriented, and the volumes add up to what the surface encloses.
#include "support.hpp"

#include <CGAL/Exact_predicates_exact_constructions_kernel.h>

#include <cmath>
#include <map>

using Kernel = CGAL::Exact_predicates_exact_constructions_kernel;
using Point = Kernel::Point_3;
using Sums = std::map<int, Kernel::FT>;

namespace {

/// The sum of a label; a number that CGAL makes from nothing has no value, not 0.
Kernel::FT &sum_of(Sums &sums, int label) { return sums.emplace(label, Kernel::FT(0)).first->second; }

} // namespace

int main() {
    try {
        const mw::Context context(2);
        mw::Job job = ball_job(context, 28, 5.0);
        job.run();
        const mw::Mesh mesh = job.mesh();
        std::vector<Point> points;
        for (std::size_t i = 0; i < mesh.point_count(); ++i)
            points.emplace_back(mesh.points()[3 * i], mesh.points()[3 * i + 1], mesh.points()[3 * i + 2]);

        // Orientation and volume of every tet, exactly; volume per label.
        Sums volume;
        std::size_t inverted = 0;
        for (std::size_t cell = 0; cell < mesh.cell_count(); ++cell) {
            const std::int32_t *v = mesh.tets().data() + 4 * cell;
            const Point &a = points[v[0]], &b = points[v[1]], &c = points[v[2]], &d = points[v[3]];
            inverted += CGAL::orientation(a, b, c, d) != CGAL::POSITIVE;
            sum_of(volume, mesh.labels()[cell]) += CGAL::volume(a, b, c, d);
        }
        CHECK(inverted == 0);

        // Volume enclosed by the surface of each label, by the divergence theorem.
        const mw_boundary boundary = mesh.boundary();
        Sums enclosed;
        const Point origin(0, 0, 0);
        for (std::int64_t t = 0; t < boundary.triangle_count; ++t) {
            const std::int32_t *v = boundary.triangles + 3 * t;
            const Kernel::FT part = CGAL::volume(origin, points[v[0]], points[v[1]], points[v[2]]);
            sum_of(enclosed, boundary.labels[2 * t]) += part;
            sum_of(enclosed, boundary.labels[2 * t + 1]) -= part;
        }
        CHECK(volume.size() == 2 && volume.count(3) && volume.count(250));
        for (const auto &entry : volume) {
            const double size = CGAL::to_double(entry.second);
            CHECK(std::fabs(size - CGAL::to_double(sum_of(enclosed, entry.first))) < 1e-12 * size);
            std::printf("label %d: %.12g mm^3 from tets, %.12g from the surface\n", entry.first,
                        CGAL::to_double(entry.second), CGAL::to_double(sum_of(enclosed, entry.first)));
        }

        // The library's own figure, where it gives one.
        double total = 0.0, reported = 0.0;
        for (const auto &entry : volume) total += CGAL::to_double(entry.second);
        if (mw_job_stat(job.get(), "quality.tet_volume", &reported) == MW_OK)
            CHECK(std::fabs(reported - total) < 1e-9 * total);
    } catch (const std::exception &error) {
        std::fprintf(stderr, "%s\n", error.what());
        ++failures;
    }
    return finish("test_cgal");
}
