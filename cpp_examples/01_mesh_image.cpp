// Meshes a label image that the program holds in memory, reads the tetrahedra, writes a file.
//
//   01_mesh_image [OUTPUT.vtu]
#include <meshwright.hpp>

#include <cmath>
#include <cstdint>
#include <iostream>
#include <map>
#include <vector>

int main(int argc, char **argv) {
    // A head of 48^3 voxels of 3 mm: label 1 is tissue, label 2 a tumour in it, 0 is air.
    const int n = 48;
    std::vector<std::uint16_t> voxels(n * n * n);
    for (int k = 0; k < n; ++k)
        for (int j = 0; j < n; ++j)
            for (int i = 0; i < n; ++i) {
                const double x = (i - 23.5) / 19, y = (j - 23.5) / 22, z = (k - 23.5) / 18;
                const double u = i - 30.0, v = j - 26.0, w = k - 25.0;
                const bool tissue = x * x + y * y + z * z < 1.0, tumour = u * u + v * v + w * w < 36.0;
                voxels[i + n * (j + n * k)] = tumour ? 2 : tissue ? 1 : 0;
            }

    try {
        const mw::Context context; // one thread per core

        mw::Geometry geometry;
        geometry.spacing = {{3.0, 3.0, 3.0}};
        geometry.origin = {{-70.5, -70.5, -70.5}};
        const mw::Image image(context, voxels.data(), {{n, n, n}}, geometry, MW_BORROW);

        mw::Job job(context, MW_JOB_IMAGE_TO_MESH);
        job.set("labels", image);
        job.set("lattice-spacing", 10.0);  // largest elements, mm
        job.set("fidelity", 0.85);         // share of each label's voxels that the mesh must get right
        job.set_for("fidelity", 2, 0.9);   // more for the tumour
        job.run();

        const mw::Mesh mesh = job.mesh();
        const mw::View<double> points = mesh.points();      // rows of x y z, LPS mm
        const mw::View<std::int32_t> tets = mesh.tets();    // rows of four point indices
        const mw::View<std::int32_t> labels = mesh.labels();
        std::map<int, double> volume;
        for (std::size_t cell = 0; cell < mesh.cell_count(); ++cell) {
            const double *a = points.data() + 3 * tets[4 * cell];
            double edge[3][3];
            for (int e = 0; e < 3; ++e)
                for (int axis = 0; axis < 3; ++axis)
                    edge[e][axis] = points[3 * tets[4 * cell + e + 1] + axis] - a[axis];
            const double determinant = edge[0][0] * (edge[1][1] * edge[2][2] - edge[1][2] * edge[2][1]) -
                                       edge[0][1] * (edge[1][0] * edge[2][2] - edge[1][2] * edge[2][0]) +
                                       edge[0][2] * (edge[1][0] * edge[2][1] - edge[1][1] * edge[2][0]);
            volume[labels[cell]] += determinant / 6.0;
        }
        std::cout << mesh.point_count() << " points, " << mesh.cell_count() << " tetrahedra\n";
        for (const auto &entry : volume) std::cout << "label " << entry.first << ": " << entry.second << " mm^3\n";

        mesh.write(argc > 1 ? argv[1] : "01_mesh_image.vtu");
        return volume.size() == 2 ? 0 : 1;
    } catch (const mw::Error &error) {
        std::cerr << error.what() << '\n';
        for (const mw::Finding &finding : error.findings()) std::cerr << "  " << finding.text << '\n';
        return 1;
    }
}
