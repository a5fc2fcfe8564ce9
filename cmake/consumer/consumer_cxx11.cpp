// A host in C++11: the same ball through the RAII layer.
#include <meshwright.hpp>

#include <cstdint>
#include <iostream>
#include <vector>

int main()
{
    const int n = 24;
    std::vector<std::int16_t> voxels(n * n * n);
    for (int k = 0; k < n; k++)
        for (int j = 0; j < n; j++)
            for (int i = 0; i < n; i++) {
                const double x = i - 11.5, y = j - 11.5, z = k - 11.5;
                voxels[i + n * (j + n * k)] = x * x + y * y + z * z < 81.0 ? 7 : 0;
            }
    try {
        mw::Context context(2);
        mw::Job job(context, MW_JOB_IMAGE_TO_MESH);
        job.set("labels", mw::Image(context, voxels.data(), {{n, n, n}}));
        job.set("lattice-spacing", 4.0);
        job.run();
        const mw::Mesh mesh = job.mesh();
        mesh.check();
        std::cout << mesh.point_count() << " points, " << mesh.cell_count() << " cells\n";
        if (mesh.cell_count() < 100 || mesh.labels()[0] != 7) return 1;
        try {
            job.set("lattice-spaceing", 4.0);
            return 1;
        } catch (const mw::Error &error) {
            if (error.status() != MW_E_PARAM) return 1;
        }
    } catch (const mw::Error &error) {
        std::cerr << error.what() << '\n';
        return 1;
    }
    return 0;
}
