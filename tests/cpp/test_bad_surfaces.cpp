// Bad surfaces, bad sizes and callbacks that fail, through C and C++: the status, findings that name the defect, and a
// job that can be run again.
#include "support.hpp"

#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <limits>
#include <stdexcept>
#include <thread>

struct Shape {
    std::vector<double> points;
    std::vector<std::int32_t> triangles;
};

static Shape cube() {
    Shape shape;
    for (int i = 0; i < 8; ++i)
        for (int axis = 0; axis < 3; ++axis) shape.points.push_back(i >> axis & 1);
    shape.triangles = {0, 3, 1, 0, 2, 3, 4, 5, 7, 4, 7, 6, 0, 1, 5, 0, 5, 4, 1, 3, 7, 1, 7, 5, 3, 2, 6, 3, 6, 7, 2, 0, 4, 2, 4, 6};
    return shape;
}

/// The cube and a tetrahedron with these corners.
static Shape with_tet(const std::vector<double> &corners) {
    Shape shape = cube();
    shape.points.insert(shape.points.end(), corners.begin(), corners.end());
    for (std::int32_t v : {8, 10, 9, 8, 9, 11, 9, 10, 11, 8, 11, 10}) shape.triangles.push_back(v);
    return shape;
}

/// Runs the shape and checks that it is refused with a finding of this code, and where it is.
static void refused(const mw::Context &context, const Shape &shape, std::int32_t code, const char *what) {
    mw_surface *surface = nullptr;
    mw_job *job = nullptr;
    mw_mesh *mesh = nullptr;
    const std::int64_t points = static_cast<std::int64_t>(shape.points.size() / 3);
    const std::int64_t triangles = static_cast<std::int64_t>(shape.triangles.size() / 3);
    CHECK(mw_job_create(context.get(), MW_JOB_SURFACE_TO_MESH, &job) == MW_OK);
    mw_status status = mw_surface_create(context.get(), points, shape.points.data(), triangles, shape.triangles.data(),
                                         nullptr, &surface);
    if (status == MW_OK) {
        CHECK(mw_job_set_surface(job, "surface", surface) == MW_OK);
        status = mw_job_run(job);
        bool named = false;
        for (std::int32_t i = 0; i < mw_job_diag_count(job); ++i) {
            mw_diag diag = mw_diag();
            diag.struct_size = sizeof diag;
            CHECK(mw_job_diag_get(job, i, &diag) == MW_OK);
            named = named || diag.code == code;
        }
        if (!named) std::fprintf(stderr, "%s: no finding of code %d\n", what, code);
        CHECK(named);
    }
    if (status != MW_E_INPUT && status != MW_E_ARG) std::fprintf(stderr, "%s: status %d\n", what, status);
    CHECK(status == MW_E_INPUT || status == MW_E_ARG);
    CHECK(mw_job_take_mesh(job, &mesh) == MW_E_STATE && !mesh);
    mw_job_destroy(job);
    mw_surface_destroy(surface);
}

static void surfaces(const mw::Context &context) {
    Shape shape = cube();
    shape.triangles.resize(33);
    refused(context, shape, MW_DIAG_OPEN_EDGE, "open");
    refused(context, with_tet({.2, .3, .5, .8, .3, .5, .3, .7, .5, .3, .3, 1.5}), MW_DIAG_INTERSECTING_TRIANGLES, "pierced");
    refused(context, with_tet({.2, .2, 1, .7, .2, 1, .2, .7, 1, .2, .2, 2}), MW_DIAG_INTERSECTING_TRIANGLES, "coplanar overlap");
    refused(context, with_tet({.5, .3, 1, .4, .3, 2, .6, .3, 2, .5, .6, 2}), MW_DIAG_INTERSECTING_TRIANGLES, "touching vertex");
    refused(context, with_tet({.3, .2, 1, .6, .3, 1, .4, .4, 2, .5, .6, 2}), MW_DIAG_INTERSECTING_TRIANGLES, "touching edge");
    shape = cube();
    for (int i = 9; i < 12; ++i) shape.triangles.push_back(shape.triangles[i]);
    refused(context, shape, MW_DIAG_DUPLICATE_TRIANGLE, "duplicate");
    for (double value : {std::nan(""), std::numeric_limits<double>::infinity(), 1e300}) {
        shape = cube();
        shape.points[10] = value;
        refused(context, shape, MW_DIAG_NON_FINITE_COORDINATE, "coordinate");
    }
    for (std::int32_t index : {99, -5, std::numeric_limits<std::int32_t>::max(), std::numeric_limits<std::int32_t>::min()}) {
        shape = cube();
        shape.triangles[35] = index;
        refused(context, shape, MW_DIAG_INDEX_OUT_OF_RANGE, "index");
    }
    shape = cube();
    shape.triangles[35] = 4;
    refused(context, shape, MW_DIAG_DEGENERATE_TRIANGLE, "index twice");
    shape = cube();
    shape.triangles.clear();
    refused(context, shape, MW_DIAG_DEGENERATE_POINT_SET, "no triangles");
    shape = cube();
    shape.points.assign(24, 1.0);
    refused(context, shape, MW_DIAG_DEGENERATE_TRIANGLE, "equal points");
    for (int i = 0; i < 24; ++i) shape.points[i] = i / 3;
    refused(context, shape, MW_DIAG_DEGENERATE_TRIANGLE, "collinear points");
    shape = cube();
    for (int i = 2; i < 24; i += 3) shape.points[i] = 0;
    refused(context, shape, MW_DIAG_DEGENERATE_POINT_SET, "coplanar points");

    // Counts that cannot be, without a look at the arrays.
    shape = cube();
    mw_surface *surface = nullptr;
    CHECK(mw_surface_create(context.get(), 8, shape.points.data(), -1, shape.triangles.data(), nullptr, &surface) == MW_E_ARG);
    CHECK(mw_surface_create(context.get(), -8, shape.points.data(), 12, shape.triangles.data(), nullptr, &surface) == MW_E_ARG);
    CHECK(mw_surface_create(context.get(), 8, nullptr, 12, shape.triangles.data(), nullptr, &surface) == MW_E_ARG);
    CHECK(mw_surface_create(context.get(), 8, shape.points.data(), std::numeric_limits<std::int64_t>::max(),
                            shape.triangles.data(), nullptr, &surface) != MW_OK);
    CHECK(!surface);
}

/// Two equal points are merged: a note, and a mesh.
static void merged_points(const mw::Context &context) {
    Shape shape = cube();
    for (int axis = 0; axis < 3; ++axis) shape.points.push_back(shape.points[axis]);
    for (int i = 0; i < 18; ++i)
        if (shape.triangles[i] == 0) shape.triangles[i] = 8;
    mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
    job.set("surface", mw::Surface(context, shape.points, shape.triangles));
    job.run();
    int merged = 0;
    for (const mw::Finding &finding : job.findings()) merged += finding.code == MW_DIAG_MERGED_POINTS;
    CHECK(merged == 1 && job.mesh().cell_count() > 0);
}

static void files(const mw::Context &context) {
    const char *name = "test_bad_surfaces.off";
    const std::string head = "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n", tail = "3 1 2 3\n3 0 3 2\n";
    for (const std::string &text : {std::string(), std::string("OFF\n"), head, head.substr(0, 30), "OFF\n4 2147483648 0\n" + head,
                                    std::string("OFF\n-4 4 0\n")}) {
        std::ofstream(name) << text;
        mw_surface *surface = nullptr;
        CHECK(mw_surface_read(context.get(), name, &surface) == MW_E_FORMAT && !surface);
        CHECK(std::strlen(mw_last_error()) > 0);
    }
    mw_surface *surface = nullptr;
    std::ofstream(name) << head << "3 1 2 9\n3 0 3 2\n";
    CHECK(mw_surface_read(context.get(), name, &surface) == MW_E_INPUT && !surface);
    std::ofstream(name) << head << tail;
    CHECK(mw_surface_read(context.get(), name, &surface) == MW_OK);
    mw_surface_destroy(surface);
    std::remove(name);
    CHECK(mw_surface_read(context.get(), name, &surface) == MW_E_IO);
}

/// A cube that refinement fills with some thousand tets.
static mw::Job refined(const mw::Context &context, const mw::Sizing &sizing) {
    const Shape shape = cube();
    mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
    job.set("surface", mw::Surface(context, shape.points, shape.triangles));
    job.set("sizing", sizing);
    return job;
}

static void size_functions(const mw::Context &context) {
    for (double wrong : {std::nan(""), 0.0, -1.0, -std::numeric_limits<double>::infinity()}) {
        mw::Sizing sizing(context);
        sizing.set_function([wrong](const std::array<double, 3> &, double) { return wrong; });
        mw::Job job = refined(context, sizing);
        mw_mesh *mesh = nullptr;
        const mw_status status = mw_job_run(job.get());
        if (status == MW_OK) std::fprintf(stderr, "a size of %g was accepted\n", wrong);
        CHECK(status != MW_OK && std::strlen(mw_last_error()) > 0);
        CHECK(mw_job_take_mesh(job.get(), &mesh) == MW_E_STATE && !mesh);
    }
    // What the function throws comes out of run(), at the first call or later; the job runs again after.
    for (long last : {0L, 50L}) {
        std::atomic<long> calls(0);
        std::atomic<bool> throws(true);
        mw::Sizing sizing(context);
        sizing.set_function([&](const std::array<double, 3> &, double size) {
            if (throws && calls++ >= last) throw std::runtime_error("no size today");
            return size < 0.2 ? size : 0.2;
        });
        mw::Job job = refined(context, sizing);
        try {
            job.run();
            CHECK(!"the exception was lost");
        } catch (const std::runtime_error &error) {
            CHECK(std::strcmp(error.what(), "no size today") == 0);
        }
        throws = false;
        job.run();
        CHECK(job.mesh().cell_count() > 100);
    }
    // A function that cancels its own job.
    mw::Sizing sizing(context);
    mw_job *running = nullptr;
    std::atomic<long> calls(0);
    sizing.set_function([&](const std::array<double, 3> &, double) {
        if (calls++ == 100) mw_job_cancel(running);
        return 0.02;
    });
    mw::Job job = refined(context, sizing);
    running = job.get();
    CHECK(mw_job_run(job.get()) == MW_E_CANCELLED);
}

/// Cancelled by another thread at any moment, and by a progress callback that throws.
static void cancellation(const mw::Context &context) {
    mw::Sizing sizing(context);
    sizing.add_point({{0.5, 0.5, 0.5}}, 0.02, 0.1);
    for (int milliseconds : {0, 1, 5, 20, 60}) {
        mw::Job job = refined(context, sizing);
        std::atomic<bool> ended(false);
        std::thread other([&] {
            std::this_thread::sleep_for(std::chrono::milliseconds(milliseconds));
            while (!ended) { // before the run has started a call does nothing
                job.cancel();
                std::this_thread::sleep_for(std::chrono::milliseconds(1));
            }
        });
        const mw_status status = mw_job_run(job.get());
        ended = true;
        other.join();
        CHECK(status == MW_E_CANCELLED || status == MW_OK);
    }
    mw::Job job = refined(context, sizing);
    job.set_progress([](const std::string &, double) -> bool { throw std::logic_error("enough"); });
    try {
        job.run();
        CHECK(!"the exception was lost");
    } catch (const std::logic_error &error) {
        CHECK(std::strcmp(error.what(), "enough") == 0);
    }
}

static void options(const mw::Context &context) {
    mw::Job job(context, MW_JOB_SURFACE_TO_MESH);
    const double nan = std::nan("");
    std::int32_t count = 0;
    CHECK(mw_param_count(MW_JOB_SURFACE_TO_MESH, &count) == MW_OK && count > 0);
    for (std::int32_t i = 0; i < count; ++i) {
        mw_param_info info = mw_param_info();
        info.struct_size = sizeof info;
        CHECK(mw_param_get(MW_JOB_SURFACE_TO_MESH, i, &info) == MW_OK);
        if (info.kind == MW_PARAM_REAL) CHECK(mw_job_set_f64(job.get(), info.name, nan) == MW_E_PARAM);
        if (info.kind == MW_PARAM_INTEGER)
            CHECK(mw_job_set_i64(job.get(), info.name, std::numeric_limits<std::int64_t>::min()) == MW_E_PARAM);
    }
    // More threads than the machine has cores mesh the same cube.
    const mw::Context many(4 * static_cast<int>(std::thread::hardware_concurrency() + 1));
    mw::Sizing sizing(many);
    sizing.add_point({{0.5, 0.5, 0.5}}, 0.1, 0.1);
    mw::Job crowded = refined(many, sizing);
    crowded.run();
    crowded.mesh().check();
}

int main() {
    try {
        const mw::Context context(2);
        surfaces(context);
        merged_points(context);
        files(context);
        size_functions(context);
        cancellation(context);
        options(context);
    } catch (const std::exception &error) {
        std::fprintf(stderr, "%s\n", error.what());
        ++failures;
    }
    return finish("test_bad_surfaces");
}
