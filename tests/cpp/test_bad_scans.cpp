// Scans and options that cannot be registered, and runs that end before they are done: the status, the text, and that
// nothing is handed out.
#include "support.hpp"

#include <cmath>
#include <functional>
#include <limits>

static const int side = 24;
static const double spacing = 4.0;

using Values = std::vector<float>;
using Place = std::array<double, 3>;

static Values values(const std::function<double(const Place &)> &of) {
    Values result;
    for (int k = 0; k < side; ++k)
        for (int j = 0; j < side; ++j)
            for (int i = 0; i < side; ++i) {
                const double middle = 0.5 * (side - 1);
                result.push_back(static_cast<float>(of({{(i - middle) * spacing, (j - middle) * spacing, (k - middle) * spacing}})));
            }
    return result;
}

static double ball(const Place &p) { return p[0] * p[0] + p[1] * p[1] + p[2] * p[2] < 38.0 * 38.0; }

static double tissue(const Place &p) {
    return ball(p) * (100.0 + 30.0 * std::sin(0.2 * p[0] + 0.05 * p[1]) * std::cos(0.17 * p[1] - 0.1 * p[2]) + 20.0 * std::sin(0.21 * p[2]));
}

static double shifted(const Place &p) { return tissue({{p[0] + 2.0 + 0.05 * p[2], p[1], p[2]}}); }

static mw::Image image(const mw::Context &context, const Values &voxels, double origin = 0.0) {
    mw::Geometry geometry;
    geometry.origin = {{origin, origin, origin}};
    geometry.spacing = {{spacing, spacing, spacing}};
    return mw::Image(context, voxels.data(), {{side, side, side}}, geometry);
}

/// A job with good scans and a small amount of work.
static mw::Job job(const mw::Context &context) {
    mw::Job result(context, MW_JOB_REGISTRATION);
    result.set("fixed", image(context, values(shifted)));
    result.set("moving", image(context, values(tissue)));
    result.set("segmentation", image(context, values(ball)));
    result.set("working-spacing", 4.0);
    result.set("num-adaptive-iterations", 2);
    return result;
}

static void ends(mw::Job &job, mw_status wanted, const char *text) {
    const mw_status status = mw_job_run(job.get());
    CHECK(status == wanted);
    if (!std::strstr(mw_last_error(), text)) {
        std::fprintf(stderr, "'%s' lacks '%s'\n", mw_last_error(), text);
        ++failures;
    }
    mw_image *field = nullptr;
    CHECK(mw_job_take_image(job.get(), "displacement", &field) == MW_E_STATE && !field);
}

static void replaced(const mw::Context &context, const char *role, const Values &voxels, double origin, const char *text) {
    mw::Job bad = job(context);
    const mw::Image picture = image(context, voxels, origin);
    const mw_status status = mw_job_set_image(bad.get(), role, picture.get());
    if (status == MW_OK) return ends(bad, MW_E_INPUT, text);
    CHECK(status == MW_E_INPUT && std::strstr(mw_last_error(), text)); // an image without labels is refused at once
}

static void scans(const mw::Context &context) {
    const double nan = std::numeric_limits<double>::quiet_NaN();
    replaced(context, "fixed", values(shifted), 900.0, "do not overlap");
    replaced(context, "segmentation", values(ball), 900.0, "does not lie on the moving scan");
    replaced(context, "segmentation", values([](const Place &) { return 0.0; }), 0.0, "no foreground");
    replaced(context, "segmentation", values([](const Place &p) { return 3.0 * ball(p); }), 0.0, "label 3");
    replaced(context, "fixed", values([](const Place &) { return 7.0; }), 0.0, "constant");
    replaced(context, "moving", values([](const Place &) { return 7.0; }), 0.0, "constant");
    replaced(context, "fixed", values([nan](const Place &) { return nan; }), 0.0, "NaN");
    mw::Job incomplete(context, MW_JOB_REGISTRATION);
    incomplete.set("fixed", image(context, values(shifted)));
    CHECK(mw_job_run(incomplete.get()) != MW_OK);
}

static void options(const mw::Context &context) {
    mw::Job window = job(context);
    window.set("half-window-size-x", 60);
    ends(window, MW_E_INPUT, "axis X");
    mw::Job rejected = job(context);
    rejected.set("rejection-fraction", 1.0);
    rejected.set("adaptive", 0);
    ends(rejected, MW_E_NO_RESULT, "rejection");
    mw::Job unlike = job(context);
    unlike.set("min-similarity", 1.0);
    unlike.set("adaptive", 0);
    unlike.set("matching-direction", "fixed-to-moving");
    ends(unlike, MW_E_NO_RESULT, "correspondence");
    const double shear[16] = {1, 0.5, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    mw::Job sheared = job(context);
    CHECK(mw_job_set_transform(sheared.get(), "rigid", shear, 0) != MW_OK || mw_job_run(sheared.get()) == MW_E_ARG);
}

/// A run that is stopped in one of its stages hands out nothing, and the job can run again. The callback is asked from time
/// to time, so that a short stage can pass without it: only the loop, which is made long here, is sure to be seen.
static void cancelled_loops(const mw::Context &context) {
    for (const std::string stage : {"rigid", "registration", "output"}) {
        const bool is_loop = stage == "registration";
        mw::Job stopped = job(context);
        if (is_loop) stopped.set("working-spacing", 1.0);
        bool seen = false;
        stopped.set_progress([&seen, stage](const std::string &name, double) {
            seen |= name == stage;
            return name != stage;
        });
        const mw_status status = mw_job_run(stopped.get());
        CHECK(status == MW_E_CANCELLED || (!is_loop && status == MW_OK));
        CHECK(seen || !is_loop);
        if (status == MW_E_CANCELLED) {
            mw_image *field = nullptr;
            CHECK(mw_job_take_image(stopped.get(), "displacement", &field) == MW_E_STATE && !field);
        }
        stopped.set_progress(nullptr);
        stopped.set("working-spacing", 4.0);
        stopped.run();
        CHECK(stopped.image("displacement").describe().components == 3);
    }
    mw::Job late = job(context);
    CHECK(mw_job_set_time_limit(late.get(), 1e-6) == MW_OK);
    ends(late, MW_E_LIMIT, "time");
}

static void solvers_that_stop_early(const mw::Context &context) {
    for (const char *solver : {"iccg", "bjcg", "jcg", "bicgstab", "lsqr"}) {
        mw::Job early = job(context);
        early.set("solver", solver);
        early.set("solver-max-iterations", 1);
        early.set("solver-tolerance", 1e-14);
        early.run();
        bool said = false;
        for (const mw::Finding &finding : early.findings()) said |= finding.code == MW_DIAG_NOT_CONVERGED;
        CHECK(said);
        const mw::Image field = early.image("displacement");
        const mw_image_desc desc = field.describe();
        bool finite = true;
        for (std::int64_t at = 0; at < 3 * side * side * side; ++at) finite &= std::isfinite(static_cast<const float *>(desc.data)[at]);
        CHECK(finite);
    }
}

int main() {
    const mw::Context context(2);
    scans(context);
    options(context);
    cancelled_loops(context);
    solvers_that_stop_early(context);
    return finish("test_bad_scans");
}
