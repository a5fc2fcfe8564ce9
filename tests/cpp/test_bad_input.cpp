// Misuse of every function: null everywhere, sizes too small, unknown codes, calls out of order. Every answer is a
// status with a text, and the process lives on.
#include "support.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <limits>
#include <unistd.h>

static void null_everywhere() {
    CHECK(mw_context_create(1, nullptr) == MW_E_ARG);
    CHECK(std::strlen(mw_last_error()) > 0);
    mw_context_destroy(nullptr);
    CHECK(mw_context_threads(nullptr) == 0);
    CHECK(mw_context_set_log(nullptr, nullptr, nullptr, MW_LOG_INFO) == MW_E_ARG);
    CHECK(mw_image_create(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_image_read(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_image_write(nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_image_describe(nullptr, nullptr) == MW_E_ARG);
    mw_image_destroy(nullptr);
    CHECK(mw_surface_create(nullptr, 0, nullptr, 0, nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_surface_read(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_surface_set_patch(nullptr, 0, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_surface_add_region(nullptr, nullptr, 0, 0.0) == MW_E_ARG);
    CHECK(mw_surface_add_hole(nullptr, nullptr) == MW_E_ARG);
    mw_surface_destroy(nullptr);
    CHECK(mw_sizing_create(nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_sizing_add_source(nullptr, 0, nullptr, 0, 0.0, 0.0) == MW_E_ARG);
    CHECK(mw_sizing_set_function(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_sizing_set_background(nullptr, nullptr, nullptr, 0) == MW_E_ARG);
    mw_sizing_destroy(nullptr);
    CHECK(mw_job_create(nullptr, MW_JOB_IMAGE_TO_MESH, nullptr) == MW_E_ARG);
    mw_job_destroy(nullptr);
    CHECK(mw_job_set_image(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_job_set_surface(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_job_set_sizing(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_job_set_mesh(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_job_set_points(nullptr, nullptr, 0, nullptr) == MW_E_ARG);
    CHECK(mw_job_set_transform(nullptr, nullptr, nullptr, 0) == MW_E_ARG);
    CHECK(mw_job_set_f64(nullptr, nullptr, 0.0) == MW_E_ARG);
    CHECK(mw_job_set_i64(nullptr, nullptr, 0) == MW_E_ARG);
    CHECK(mw_job_set_str(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_job_set_f64_for(nullptr, nullptr, 0, 0.0) == MW_E_ARG);
    CHECK(mw_job_set_str_for(nullptr, nullptr, 0, nullptr) == MW_E_ARG);
    CHECK(mw_job_reset_params(nullptr) == MW_E_ARG);
    CHECK(mw_job_set_progress(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_job_set_time_limit(nullptr, 1.0) == MW_E_ARG);
    CHECK(mw_job_run(nullptr) == MW_E_ARG);
    mw_job_cancel(nullptr);
    CHECK(mw_job_take_mesh(nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_job_take_named_mesh(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_job_take_image(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_job_array(nullptr, nullptr, nullptr, nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_job_stat(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_job_stat_count(nullptr) == 0);
    CHECK(mw_job_stat_get(nullptr, 0, nullptr) == MW_E_ARG);
    CHECK(mw_job_diag_count(nullptr) == 0);
    CHECK(mw_job_diag_get(nullptr, 0, nullptr) == MW_E_ARG);
    CHECK(mw_param_count(MW_JOB_IMAGE_TO_MESH, nullptr) == MW_E_ARG);
    CHECK(mw_param_get(MW_JOB_IMAGE_TO_MESH, 0, nullptr) == MW_E_ARG);
    CHECK(mw_mesh_point_count(nullptr) == 0 && mw_mesh_cell_count(nullptr) == 0);
    CHECK(!mw_mesh_points(nullptr) && !mw_mesh_tets(nullptr) && !mw_mesh_cell_types(nullptr));
    CHECK(!mw_mesh_offsets(nullptr) && !mw_mesh_connectivity(nullptr) && !mw_mesh_labels(nullptr));
    CHECK(mw_mesh_space(nullptr) == 0);
    CHECK(mw_mesh_boundary(nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_mesh_array_count(nullptr, 0) == 0 && !mw_mesh_array_name(nullptr, 0, 0));
    CHECK(mw_mesh_array(nullptr, 0, nullptr, nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_mesh_copy_connectivity_i64(nullptr, nullptr, 0) == MW_E_ARG);
    CHECK(mw_mesh_quality(nullptr, nullptr, nullptr, 0) == MW_E_ARG);
    CHECK(mw_mesh_check(nullptr) == MW_E_ARG);
    CHECK(mw_mesh_create(nullptr, 0, nullptr, 0, nullptr, nullptr, nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_mesh_read(nullptr, nullptr, nullptr) == MW_E_ARG);
    CHECK(mw_mesh_write(nullptr, nullptr, nullptr) == MW_E_ARG);
    mw_mesh_destroy(nullptr);
}

static void images(const mw::Context &context) {
    const std::vector<std::uint8_t> voxels = two_balls(8);
    const mw_image_desc good = describe(voxels, 8);
    std::string text;
    const auto status = [&context, &text](const mw_image_desc &desc) {
        mw_image *image = reinterpret_cast<mw_image *>(1);
        const mw_status result = mw_image_create(context.get(), &desc, &image);
        text = mw_last_error();
        CHECK((result == MW_OK) == (image != nullptr));
        mw_image_destroy(image);
        return result;
    };
    CHECK(status(good) == MW_OK);
    mw_image_desc bad = good;
    bad.struct_size = 0;
    CHECK(status(bad) == MW_E_ARG);
    bad.struct_size = sizeof bad - 1;
    CHECK(status(bad) == MW_E_ARG && text.find("struct_size") != std::string::npos);
    for (mw_type type : {0, 11, -1, 1 << 30}) {
        bad = good;
        bad.type = type;
        CHECK(status(bad) == MW_E_ARG);
    }
    const double nan = std::numeric_limits<double>::quiet_NaN(), inf = std::numeric_limits<double>::infinity();
    for (double spacing : {0.0, -1.0, nan, inf}) {
        bad = good;
        bad.spacing[1] = spacing;
        CHECK(status(bad) == MW_E_ARG);
    }
    for (std::int64_t size : {std::int64_t(0), std::int64_t(-3), INT64_MAX}) {
        bad = good;
        bad.dims[2] = size;
        CHECK(status(bad) == MW_E_ARG);
    }
    bad = good;
    for (double &entry : bad.direction) entry = 1.0;
    CHECK(status(bad) == MW_E_ARG);
    bad = good;
    bad.origin[0] = nan;
    CHECK(status(bad) == MW_E_ARG);
    bad = good;
    bad.data = nullptr;
    CHECK(status(bad) == MW_E_ARG);

    mw::Image image(context, good);
    mw_image_desc out = mw_image_desc();
    CHECK(mw_image_describe(image.get(), &out) == MW_E_ARG);
    mw_image *none = nullptr;
    CHECK(mw_image_read(context.get(), "/no/such/file.nii", &none) == MW_E_IO && !none);
    CHECK(mw_image_read(context.get(), "", &none) == MW_E_ARG);
    CHECK(mw_image_read(context.get(), "\xff\xfe.nii", &none) == MW_E_ARG);
}

template <class T>
static mw_status set_labels(const mw::Context &context, const std::vector<T> &voxels) {
    mw::Job job(context, MW_JOB_IMAGE_TO_MESH);
    const mw::Image image(context, voxels.data(), {{static_cast<std::int64_t>(voxels.size()), 1, 1}});
    return mw_job_set_image(job.get(), "labels", image.get());
}

static void labels(const mw::Context &context) {
    CHECK(set_labels<std::int8_t>(context, {0, 1, 2}) == MW_OK);
    CHECK(set_labels<float>(context, {0.f, 1.f, 2.f}) == MW_OK);
    CHECK(set_labels<double>(context, {0.0, 1.5, 2.0}) == MW_E_INPUT);
    CHECK(set_labels<float>(context, {0.f, std::numeric_limits<float>::quiet_NaN()}) == MW_E_INPUT);
    CHECK(set_labels<std::int64_t>(context, {0, -1}) == MW_E_INPUT);
    CHECK(set_labels<std::uint64_t>(context, {0, UINT64_MAX}) == MW_E_INPUT);
    CHECK(set_labels<std::uint16_t>(context, {0, 0, 0}) == MW_E_INPUT);
    std::vector<std::uint32_t> many(70000);
    for (std::uint32_t i = 0; i < many.size(); ++i) many[i] = i;
    CHECK(set_labels(context, many) == MW_E_INPUT);
}

static void parameters(const mw::Context &context) {
    std::int32_t count = 0;
    for (std::int32_t kind : {MW_JOB_IMAGE_TO_MESH, MW_JOB_SURFACE_TO_MESH, MW_JOB_REGISTRATION}) {
        CHECK(mw_param_count(kind, &count) == MW_OK);
        for (std::int32_t i = 0; i < count; ++i) {
            mw_param_info info = mw_param_info();
            CHECK(mw_param_get(kind, i, &info) == MW_E_ARG);
            info.struct_size = sizeof info;
            CHECK(mw_param_get(kind, i, &info) == MW_OK);
            CHECK(info.name && info.doc && info.unit && info.group && std::strlen(info.doc) > 0);
            CHECK(info.kind >= MW_PARAM_FLAG && info.kind <= MW_PARAM_OUTPUT_FILE);
        }
        mw_param_info info = mw_param_info();
        info.struct_size = sizeof info;
        CHECK(mw_param_get(kind, count, &info) == MW_E_ARG);
        CHECK(mw_param_get(kind, -1, &info) == MW_E_ARG);
    }
    CHECK(mw_param_count(0, &count) == MW_E_ARG && mw_param_count(4, &count) == MW_E_ARG);

    mw::Job job(context, MW_JOB_IMAGE_TO_MESH);
    const double nan = std::numeric_limits<double>::quiet_NaN();
    CHECK(mw_job_set_f64(job.get(), "latice-spacing", 1.0) == MW_E_PARAM);
    CHECK(std::strstr(mw_last_error(), "lattice-spacing"));
    CHECK(mw_job_set_f64(job.get(), "latticeSpacing", 2.0) == MW_OK);
    CHECK(mw_job_set_f64(job.get(), "lattice_spacing", 2.0) == MW_OK);
    for (double value : {0.0, -1.0, nan}) CHECK(mw_job_set_f64(job.get(), "lattice-spacing", value) == MW_E_PARAM);
    for (double value : {0.0, 1.5, nan}) CHECK(mw_job_set_f64(job.get(), "fidelity", value) == MW_E_PARAM);
    CHECK(mw_job_set_str(job.get(), "fidelity", "high") == MW_E_PARAM);
    CHECK(mw_job_set_f64_for(job.get(), "lattice-spacing", 1, 2.0) == MW_E_PARAM);
    CHECK(mw_job_set_str(job.get(), "output", "mesh.vtu") == MW_E_PARAM);
    CHECK(mw_job_set_str(job.get(), "lattice-spacing", nullptr) == MW_E_ARG);
    CHECK(mw_job_set_time_limit(job.get(), nan) == MW_E_ARG && mw_job_set_time_limit(job.get(), -1.0) == MW_E_ARG);
    CHECK(mw_job_reset_params(job.get()) == MW_OK);
}

static void order_of_calls(const mw::Context &context) {
    mw_job *job = nullptr;
    mw_mesh *mesh = reinterpret_cast<mw_mesh *>(1);
    double value = 0.0;
    CHECK(mw_job_create(context.get(), 99, &job) == MW_E_ARG && !job);
    for (std::int32_t kind : {MW_JOB_IMAGE_TO_MESH, MW_JOB_SURFACE_TO_MESH, MW_JOB_REGISTRATION}) {
        CHECK(mw_job_create(context.get(), kind, &job) == MW_OK);
        CHECK(mw_job_run(job) == MW_E_STATE);
        CHECK(mw_job_take_mesh(job, &mesh) == MW_E_STATE && !mesh);
        CHECK(mw_job_stat(job, "time.total", &value) == MW_E_STATE);
        CHECK(mw_job_stat_count(job) == 0);
        CHECK(mw_job_set_image(job, "nonsense", nullptr) == MW_E_ARG);
        mw_job_destroy(job);
    }
    // A job outlives the image and the context it was made with; a mesh outlives the job.
    mw_context *own = nullptr;
    CHECK(mw_context_create(1, &own) == MW_OK);
    std::vector<std::uint8_t> voxels = two_balls(16);
    mw_image_desc desc = describe(voxels, 16);
    desc.borrow = MW_BORROW;
    mw_image *image = nullptr;
    CHECK(mw_image_create(own, &desc, &image) == MW_OK);
    CHECK(mw_job_create(own, MW_JOB_IMAGE_TO_MESH, &job) == MW_OK);
    CHECK(mw_job_set_image(job, "labels", image) == MW_OK);
    mw_image_destroy(image);
    std::vector<std::uint8_t>().swap(voxels);
    mw_context_destroy(own);
    CHECK(mw_job_set_f64(job, "lattice-spacing", 4.0) == MW_OK);
    CHECK(mw_job_run(job) == MW_OK);
    CHECK(mw_job_take_mesh(job, &mesh) == MW_OK);
    mw_stat stat = mw_stat();
    CHECK(mw_job_stat_get(job, 0, &stat) == MW_E_ARG);
    CHECK(mw_job_stat_count(job) > 0);
    mw_job_destroy(job);
    CHECK(mw_mesh_check(mesh) == MW_OK && mw_mesh_cell_count(mesh) > 0);
    std::vector<double> few(1);
    CHECK(mw_mesh_quality(mesh, "min_dihedral", few.data(), 1) == MW_E_ARG);
    CHECK(mw_mesh_quality(mesh, "beauty", few.data(), 1) == MW_E_ARG);
    CHECK(mw_mesh_write(mesh, "/no/such/folder/mesh.vtu", nullptr) == MW_E_IO);
    CHECK(mw_mesh_write(mesh, "mesh.vtu", "colour=red") == MW_E_ARG);
    CHECK(mw_mesh_write(mesh, "mesh.docx", nullptr) == MW_E_UNSUPPORTED);
    mw_mesh_destroy(mesh);
}

/// Every order of destroying a context, an image, a job that ran and its mesh; what is left stays usable.
static void destroy_in_any_order() {
    int order[] = {0, 1, 2, 3};
    do {
        mw_context *context = nullptr;
        mw_image *image = nullptr;
        mw_job *job = nullptr;
        mw_mesh *mesh = nullptr;
        const std::vector<std::uint8_t> voxels = two_balls(12);
        const mw_image_desc desc = describe(voxels, 12);
        CHECK(mw_context_create(1, &context) == MW_OK);
        CHECK(mw_image_create(context, &desc, &image) == MW_OK);
        CHECK(mw_job_create(context, MW_JOB_IMAGE_TO_MESH, &job) == MW_OK);
        CHECK(mw_job_set_image(job, "labels", image) == MW_OK);
        CHECK(mw_job_set_f64(job, "lattice-spacing", 4.0) == MW_OK);
        CHECK(mw_job_run(job) == MW_OK && mw_job_take_mesh(job, &mesh) == MW_OK);
        const std::int64_t cells = mw_mesh_cell_count(mesh);
        for (int step = 0; step < 4; ++step) {
            switch (order[step]) {
            case 0: mw_context_destroy(context), context = nullptr; break;
            case 1: mw_image_destroy(image), image = nullptr; break;
            case 2: mw_job_destroy(job), job = nullptr; break;
            default: mw_mesh_destroy(mesh), mesh = nullptr; break;
            }
            mw_image_desc out = mw_image_desc();
            out.struct_size = sizeof out;
            double value = 0.0;
            if (image) CHECK(mw_image_describe(image, &out) == MW_OK && out.dims[0] == 12);
            if (job) CHECK(mw_job_stat(job, "time.total", &value) == MW_OK || mw_job_stat_count(job) > 0);
            if (mesh) CHECK(mw_mesh_cell_count(mesh) == cells && mw_mesh_check(mesh) == MW_OK);
        }
    } while (std::next_permutation(order, order + 4));
}

/// What is wrong with the values together with the image shows when the job runs; the job can be run again after.
static void runs_that_cannot_be(const mw::Context &context) {
    const std::vector<std::uint8_t> voxels = two_balls(12);
    mw::Job job(context, MW_JOB_IMAGE_TO_MESH);
    job.set("labels", mw::Image(context, describe(voxels, 12)));
    mw_mesh *mesh = nullptr;
    CHECK(mw_job_set_f64(job.get(), "lattice-spacing", 1000.0) == MW_OK && mw_job_run(job.get()) == MW_E_PARAM);
    CHECK(std::strstr(mw_last_error(), "larger than the image"));
    CHECK(mw_job_take_mesh(job.get(), &mesh) == MW_E_STATE && !mesh);
    CHECK(mw_job_set_f64(job.get(), "lattice-spacing", 4.0) == MW_OK);
    CHECK(mw_job_set_f64_for(job.get(), "fidelity", 9, 0.9) == MW_OK && mw_job_run(job.get()) == MW_E_PARAM);
    CHECK(std::strstr(mw_last_error(), "label 9"));
    CHECK(mw_job_reset_params(job.get()) == MW_OK && mw_job_set_f64(job.get(), "lattice-spacing", 4.0) == MW_OK);
    job.run();
    CHECK(mw_mesh_write(job.mesh().get(), "/dev/full", "format=vtu") == MW_E_IO);

    const std::vector<std::uint8_t> one(1, 9);
    mw::Job smallest(context, MW_JOB_IMAGE_TO_MESH);
    smallest.set("labels", mw::Image(context, one.data(), {{1, 1, 1}}));
    smallest.run();
    smallest.mesh().check();
}

/// Files that are no image: what the reader answers, and that it makes no handle.
static void image_files(const mw::Context &context) {
    const std::string head = "NRRD0004\ntype: uchar\ndimension: 3\n";
    const std::string contents[] = {"", "this is\nno image\n", head, head + "sizes: 1048576 1024 1024\nencoding: raw\n\n1234",
                                    head + "sizes: 2 2 1\nspacings: 1 0 1\nencoding: raw\n\n1234",
                                    "NRRD0004\ntype: uchar\ndimension: 2\nsizes: 2 2\nencoding: raw\n\n1234",
                                    "NRRD0004\ntype: uchar\ndimension: 4\nsizes: 2 1 1 2\nencoding: raw\n\n1234",
                                    head + "sizes: 2 2 1\nencoding: gzip\n\n\x1f\x8b\x08"};
    char path[] = "/tmp/meshwright-bad-XXXXXX.nrrd";
    const int file = mkstemps(path, 5);
    CHECK(file >= 0);
    for (const std::string &text : contents) {
        std::FILE *out = std::fopen(path, "wb");
        CHECK(out && std::fwrite(text.data(), 1, text.size(), out) == text.size() && std::fclose(out) == 0);
        mw_image *image = reinterpret_cast<mw_image *>(1);
        const mw_status status = mw_image_read(context.get(), path, &image);
        CHECK(status == MW_E_FORMAT && !image && std::strstr(mw_last_error(), path));
        if (status != MW_E_FORMAT) std::fprintf(stderr, "status %d for: %s\n", status, text.c_str());
    }
    close(file);
    std::remove(path);
}

static void meshes(const mw::Context &context) {
    const double points[] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1};
    const std::uint8_t types[] = {10};
    const std::int64_t offsets[] = {0, 4};
    const std::int32_t good[] = {0, 1, 2, 3}, inverted[] = {1, 0, 2, 3}, wild[] = {0, 1, 2, -4};
    mw_mesh *mesh = nullptr;
    const auto create = [&](const std::uint8_t *kinds, const std::int64_t *ends, const std::int32_t *nodes) {
        return mw_mesh_create(context.get(), 4, points, 1, kinds, ends, nodes, nullptr, &mesh);
    };
    CHECK(create(types, offsets, good) == MW_OK);
    CHECK(mw_mesh_check(mesh) == MW_OK && mw_mesh_labels(mesh)[0] == 1 && mw_mesh_tets(mesh)[3] == 3);
    mw_boundary boundary = mw_boundary();
    CHECK(mw_mesh_boundary(mesh, &boundary) == MW_E_ARG);
    mw_mesh_destroy(mesh);
    CHECK(create(types, offsets, inverted) == MW_OK);
    CHECK(mw_mesh_check(mesh) == MW_E_INPUT);
    mw_mesh_destroy(mesh);
    const std::uint8_t unknown[] = {99};
    const std::int64_t negative[] = {0, -4}, huge[] = {0, INT64_MAX};
    CHECK(create(types, offsets, wild) == MW_E_ARG && !mesh);
    CHECK(create(unknown, offsets, good) == MW_E_ARG);
    CHECK(create(types, negative, good) == MW_E_ARG);
    CHECK(create(types, huge, good) == MW_E_ARG);
    CHECK(mw_mesh_create(context.get(), INT64_MAX, points, 1, types, offsets, good, nullptr, &mesh) == MW_E_ARG);
    CHECK(mw_mesh_create(context.get(), 4, points, INT64_MAX, types, offsets, good, nullptr, &mesh) == MW_E_ARG);
}

static void surfaces_and_sizes(const mw::Context &context) {
    const std::vector<double> points = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1};
    mw::Surface surface(context, points, {0, 2, 1, 0, 1, 3, 1, 2, 3});
    CHECK(mw_surface_set_patch(surface.get(), 0, "carpet", nullptr) == MW_E_ARG);
    CHECK(std::strstr(mw_last_error(), "farfield"));
    CHECK(mw_surface_set_patch(surface.get(), 0, "wall", "body") == MW_OK);
    const double nan[] = {std::nan(""), 0, 0};
    CHECK(mw_surface_add_hole(surface.get(), nan) == MW_E_ARG);
    CHECK(mw_surface_add_region(surface.get(), points.data(), 1, -1.0) == MW_E_ARG);
    mw::Sizing sizing(context);
    CHECK(mw_sizing_add_source(sizing.get(), 9, points.data(), 3, 1.0, 0.1) == MW_E_ARG);
    CHECK(mw_sizing_add_source(sizing.get(), MW_SOURCE_LINE, points.data(), 3, 1.0, 0.1) == MW_E_ARG);
    for (double size : {0.0, -1.0, std::nan("")})
        CHECK(mw_sizing_add_source(sizing.get(), MW_SOURCE_POINT, points.data(), 3, size, 0.1) == MW_E_ARG);
    CHECK(mw_sizing_add_source(sizing.get(), MW_SOURCE_POINT, points.data(), 3, 1.0, -0.1) == MW_E_ARG);
    CHECK(mw_sizing_add_source(sizing.get(), MW_SOURCE_POINT, points.data(), 3, 1.0, 0.1) == MW_OK);
    mw::Job job(context, MW_JOB_REGISTRATION);
    CHECK(mw_job_set_surface(job.get(), "surface", surface.get()) == MW_E_ARG);
    CHECK(mw_job_set_points(job.get(), "fixed_landmarks", 1, nan) == MW_E_ARG);
    CHECK(mw_job_set_points(job.get(), "fixed_landmarks", -1, nan) == MW_E_ARG);
    CHECK(mw_job_set_transform(job.get(), "rigid", nullptr, 0) == MW_OK);
}

static void open_surface_lists_its_faults(const mw::Context &context) {
    const std::vector<double> points = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1};
    mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
    job.set("surface", mw::Surface(context, points, {0, 2, 1, 0, 1, 3, 1, 2, 3}));
    try {
        job.run();
        CHECK(!"an open surface was meshed");
    } catch (const mw::Error &error) {
        CHECK(error.status() == MW_E_INPUT);
        int open = 0;
        for (const mw::Finding &finding : error.findings()) open += finding.code == MW_DIAG_OPEN_EDGE;
        CHECK(open == 3);
    }
    mw_diag diag = mw_diag();
    CHECK(mw_job_diag_get(job.get(), 0, &diag) == MW_E_ARG);
}

int main() {
    null_everywhere();
    CHECK(std::strcmp(mw_status_string(12345), "unknown status") == 0);
    CHECK(mw_version() == MW_VERSION && MW_CHECK_VERSION());
    mw_context *context = nullptr;
    CHECK(mw_context_create(-1, &context) == MW_E_ARG && !context);
    CHECK(mw_context_create(1 << 20, &context) == MW_E_ARG && !context);
    const mw::Context two(2);
    CHECK(two.threads() == 2);
    CHECK(mw_context_set_log(two.get(), nullptr, nullptr, 9) == MW_E_ARG);
    images(two);
    labels(two);
    parameters(two);
    order_of_calls(two);
    destroy_in_any_order();
    runs_that_cannot_be(two);
    image_files(two);
    meshes(two);
    surfaces_and_sizes(two);
    open_surface_lists_its_faults(two);
    return finish("test_bad_input");
}
