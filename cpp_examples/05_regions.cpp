// Several regions: a box in a box, each with its label; then the inner one left empty; and a sheet inside the volume
// that is kept exactly.
//
//   05_regions
#include <meshwright.hpp>

#include <cstdint>
#include <iostream>
#include <map>
#include <vector>

struct Shape {
    std::vector<double> points;
    std::vector<std::int32_t> triangles, patches;

    void add_box(double low, double high, std::int32_t patch) {
        const std::int32_t base = static_cast<std::int32_t>(points.size() / 3);
        for (int corner = 0; corner < 8; ++corner)
            for (int axis = 0; axis < 3; ++axis) points.push_back(corner >> axis & 1 ? high : low);
        const int sides[12][3] = {{0, 2, 3}, {0, 3, 1}, {4, 5, 7}, {4, 7, 6}, {0, 1, 5}, {0, 5, 4},
                                  {2, 6, 7}, {2, 7, 3}, {0, 4, 6}, {0, 6, 2}, {1, 3, 7}, {1, 7, 5}};
        for (const auto &side : sides) {
            for (int vertex : side) triangles.push_back(base + vertex);
            patches.push_back(patch);
        }
    }
    /// A square at height z, free on all sides.
    void add_sheet(double low, double high, double z, std::int32_t patch) {
        const std::int32_t base = static_cast<std::int32_t>(points.size() / 3);
        for (double y : {low, high})
            for (double x : {low, high}) points.insert(points.end(), {x, y, z});
        for (int vertex : {0, 1, 3, 0, 3, 2}) triangles.push_back(base + vertex);
        patches.insert(patches.end(), 2, patch);
    }
};

static std::map<int, int> cells_per_label(const mw::Mesh &mesh) {
    std::map<int, int> count;
    for (std::int32_t label : mesh.labels()) ++count[label];
    return count;
}

int main() {
    try {
        const mw::Context context;
        Shape shape;
        shape.add_box(0.0, 10.0, 1);
        shape.add_box(4.0, 6.0, 2);
        shape.add_sheet(2.0, 8.0, 8.0, 3);

        mw::Surface surface(context, shape.points, shape.triangles, shape.patches);
        surface.set_patch(1, "wall", "outside");
        surface.set_patch(2, "internal", "interface");
        surface.set_patch(3, "embedded", "sheet");
        surface.add_region({{1, 1, 1}}, 100);
        surface.add_region({{5, 5, 5}}, 200);

        mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
        job.set("surface", surface);
        job.run();
        const mw::Mesh both = job.mesh();
        both.check();
        const std::map<int, int> labels = cells_per_label(both);
        for (const auto &entry : labels) std::cout << "label " << entry.first << ": " << entry.second << " cells\n";
        if (labels.size() != 2 || !labels.count(100) || !labels.count(200)) return 1;
        const mw_boundary boundary = both.boundary();
        int sheet = 0;
        for (std::int64_t face = 0; boundary.patches && face < boundary.triangle_count; ++face)
            sheet += boundary.patches[face] == 3;
        std::cout << sheet << " triangles of the sheet are faces of the mesh\n";

        mw::Surface cavity(context, shape.points, shape.triangles, shape.patches);
        cavity.set_patch(3, "embedded");
        cavity.add_hole({{5, 5, 5}});
        job.set("surface", cavity);
        job.run();
        const mw::Mesh hollow = job.mesh();
        hollow.check();
        std::cout << hollow.cell_count() << " cells around the cavity\n";
        return sheet >= 2 && cells_per_label(hollow).size() == 1 ? 0 : 1;
    } catch (const mw::Error &error) {
        std::cerr << error.what() << '\n';
        for (const mw::Finding &finding : error.findings()) std::cerr << "  " << finding.text << '\n';
        return 1;
    }
}
