// Meshes the inside of a triangulated surface; every given triangle is a face of the mesh.
//
//   03_mesh_surface [SURFACE.stl [OUTPUT.vtu]]
#include <meshwright.hpp>

#include <cstdint>
#include <iostream>
#include <vector>

/// A cube of side 10 with `n` x `n` squares of two triangles on each side.
static mw::Surface cube(const mw::Context &context, int n) {
    std::vector<double> points;
    std::vector<std::int32_t> triangles;
    // Points of the grid that lie on the surface, numbered in order.
    std::vector<std::int32_t> number((n + 1) * (n + 1) * (n + 1), -1);
    const auto at = [n](int i, int j, int k) { return i + (n + 1) * (j + (n + 1) * k); };
    for (int k = 0; k <= n; ++k)
        for (int j = 0; j <= n; ++j)
            for (int i = 0; i <= n; ++i)
                if (i % n == 0 || j % n == 0 || k % n == 0) {
                    number[at(i, j, k)] = static_cast<std::int32_t>(points.size() / 3);
                    for (int index : {i, j, k}) points.push_back(10.0 * index / n);
                }
    for (int axis = 0; axis < 3; ++axis)
        for (int side = 0; side <= n; side += n)
            for (int v = 0; v < n; ++v)
                for (int u = 0; u < n; ++u) {
                    const auto corner = [&](int du, int dv) {
                        int index[3];
                        index[axis] = side;
                        index[(axis + 1) % 3] = u + du;
                        index[(axis + 2) % 3] = v + dv;
                        return number[at(index[0], index[1], index[2])];
                    };
                    const std::int32_t a = corner(0, 0), b = corner(1, 0), c = corner(1, 1), d = corner(0, 1);
                    const std::int32_t outward[] = {a, b, c, a, c, d}, inward[] = {a, c, b, a, d, c};
                    triangles.insert(triangles.end(), side ? outward : inward, (side ? outward : inward) + 6);
                }
    return mw::Surface(context, points, triangles);
}

int main(int argc, char **argv) {
    try {
        const mw::Context context;
        const mw::Surface surface = argc > 1 ? mw::Surface::read(context, argv[1]) : cube(context, 6);
        mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
        job.set("surface", surface);
        job.run();
        const mw::Mesh mesh = job.mesh();
        mesh.check();
        std::cout << mesh.point_count() << " points, " << mesh.cell_count() << " tetrahedra, "
                  << mesh.boundary().triangle_count << " surface triangles\n";
        mesh.write(argc > 2 ? argv[2] : "03_mesh_surface.vtu");
        return 0;
    } catch (const mw::Error &error) {
        std::cerr << error.what() << '\n';
        for (const mw::Finding &finding : error.findings()) std::cerr << "  " << finding.text << '\n';
        return 1;
    }
}
