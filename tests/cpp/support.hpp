// Shapes and checks that the tests share.
#ifndef MESHWRIGHT_TEST_SUPPORT_HPP
#define MESHWRIGHT_TEST_SUPPORT_HPP

#include <meshwright.hpp>

#include <cstdint>
#include <cstdio>
#include <cstring>
#include <string>
#include <vector>

static int failures = 0;

#define CHECK(condition)                                                                                    \
    do {                                                                                                    \
        if (!(condition)) {                                                                                 \
            std::fprintf(stderr, "%s:%d: %s (last error: %s)\n", __FILE__, __LINE__, #condition, mw_last_error()); \
            ++failures;                                                                                     \
        }                                                                                                   \
    } while (0)

/// Two balls of labels 3 and 250, one inside the other, in a box of n^3 voxels.
inline std::vector<std::uint8_t> two_balls(int n) {
    std::vector<std::uint8_t> voxels(static_cast<std::size_t>(n) * n * n);
    const double middle = (n - 1) / 2.0, outer = 0.42 * n, inner = 0.22 * n;
    for (int k = 0; k < n; ++k)
        for (int j = 0; j < n; ++j)
            for (int i = 0; i < n; ++i) {
                const double x = i - middle, y = j - middle, z = k - middle, squared = x * x + y * y + z * z;
                const std::size_t at = i + static_cast<std::size_t>(n) * (j + static_cast<std::size_t>(n) * k);
                voxels[at] = squared < inner * inner ? 250 : squared < outer * outer ? 3 : 0;
            }
    return voxels;
}

inline mw_image_desc describe(const std::vector<std::uint8_t> &voxels, int n) {
    mw_image_desc desc = mw_image_desc();
    desc.struct_size = sizeof desc;
    for (int axis = 0; axis < 3; ++axis) {
        desc.dims[axis] = n;
        desc.spacing[axis] = 1.0;
    }
    desc.data = voxels.data();
    desc.type = MW_TYPE_U8;
    return desc;
}

/// A job that is ready to run on two balls.
inline mw::Job ball_job(const mw::Context &context, int n = 28, double spacing = 4.0) {
    const std::vector<std::uint8_t> voxels = two_balls(n);
    mw::Job job(context, MW_JOB_IMAGE_TO_MESH);
    job.set("labels", mw::Image(context, describe(voxels, n)));
    job.set("lattice-spacing", spacing);
    return job;
}

/// FNV-1a over points, connectivity and labels.
inline std::uint64_t hash_of(const mw::Mesh &mesh) {
    std::uint64_t hash = 14695981039346656037ull;
    const auto add = [&hash](const void *data, std::size_t bytes) {
        const unsigned char *byte = static_cast<const unsigned char *>(data);
        for (std::size_t i = 0; i < bytes; ++i) hash = (hash ^ byte[i]) * 1099511628211ull;
    };
    add(mesh.points().data(), mesh.points().size() * sizeof(double));
    add(mesh.connectivity().data(), mesh.connectivity().size() * sizeof(std::int32_t));
    add(mesh.labels().data(), mesh.labels().size() * sizeof(std::int32_t));
    return hash;
}

inline int finish(const char *name) {
    if (failures) std::fprintf(stderr, "%s: %d checks failed\n", name, failures);
    return failures ? 1 : 0;
}

#endif
