// Registers two scans: a ball of tissue with texture, and the same after a known deformation. The displacement field
// and the warped scan are images.
//
//   08_registration [VOXELS_PER_SIDE]
#include <meshwright.hpp>

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <vector>

/// Texture of the tissue at a point of the moving scan.
static double texture(double x, double y, double z) {
    return 100.0 + 30.0 * std::sin(0.55 * x + 0.2 * y) * std::cos(0.45 * y - 0.3 * z) + 25.0 * std::sin(0.6 * z + 0.3 * x);
}
/// Where a point of the fixed scan was before: 3 mm of shift at one side, nothing at the other.
static double shift(double z) { return 3.0 * (z + 28.0) / 56.0; }

int main(int argc, char **argv) {
    const int n = argc > 1 ? std::atoi(argv[1]) : 56;
    const double middle = 0.5 * (n - 1), radius = middle - 3.5, squared_radius = radius * radius;
    std::vector<float> fixed(n * n * n), moving(n * n * n);
    std::vector<std::uint8_t> tissue(n * n * n);
    for (int k = 0; k < n; ++k)
        for (int j = 0; j < n; ++j)
            for (int i = 0; i < n; ++i) {
                const double x = i - middle, y = j - middle, z = k - middle;
                const int at = i + n * (j + n * k);
                tissue[at] = x * x + y * y + z * z < squared_radius;
                moving[at] = static_cast<float>(tissue[at] ? texture(x, y, z) : 0.0);
                const double w = z + shift(z);
                fixed[at] = static_cast<float>(x * x + y * y + w * w < squared_radius ? texture(x, y, w) : 0.0);
            }
    try {
        const mw::Context context;
        mw::Geometry geometry;
        geometry.origin = {{-middle, -middle, -middle}};
        const std::array<std::int64_t, 3> dims = {{n, n, n}};
        mw::Job job(context, MW_JOB_REGISTRATION);
        job.set("fixed", mw::Image(context, fixed.data(), dims, geometry));
        job.set("moving", mw::Image(context, moving.data(), dims, geometry));
        job.set("segmentation", mw::Image(context, tissue.data(), dims, geometry));
        job.run();

        const mw::Image displacement = job.image("displacement");
        const mw_image_desc desc = displacement.describe();
        if (desc.components != 3) return 1;
        double before = 0.0, after = 0.0;
        int count = 0;
        for (int k = 8; k < n - 8; ++k)
            for (int j = 8; j < n - 8; ++j)
                for (int i = 8; i < n - 8; ++i) {
                    const double x = i - middle, y = j - middle, z = k - middle, truth = shift(z);
                    if (x * x + y * y + z * z > 0.56 * squared_radius) continue;
                    const std::int64_t at = i * desc.stride[0] + j * desc.stride[1] + k * desc.stride[2];
                    double u[3];
                    for (int axis = 0; axis < 3; ++axis)
                        u[axis] = desc.type == MW_TYPE_F64 ? static_cast<const double *>(desc.data)[at + axis]
                                                           : static_cast<const float *>(desc.data)[at + axis];
                    before += truth;
                    after += std::sqrt(u[0] * u[0] + u[1] * u[1] + (u[2] - truth) * (u[2] - truth));
                    ++count;
                }
        std::cout << "mean error " << before / count << " mm before, " << after / count << " mm after\n";
        displacement.write("08_displacement.nrrd");
        job.image("warped").write("08_warped.nrrd");
        return after < 0.5 * before ? 0 : 1;
    } catch (const mw::Error &error) {
        std::cerr << error.what() << '\n';
        for (const mw::Finding &finding : error.findings()) std::cerr << "  " << finding.text << '\n';
        return 1;
    }
}
