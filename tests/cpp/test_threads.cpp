// Several threads share a context, images and meshes; runs are cancelled at random moments; a job in use answers
// MW_E_STATE to a second thread; callbacks that throw reach the caller of run().
#include "support.hpp"

#include <atomic>
#include <chrono>
#include <random>
#include <thread>

static void one_context_many_threads() {
    const mw::Context context(2);
    const std::vector<std::uint8_t> voxels = two_balls(24);
    const mw::Image image(context, describe(voxels, 24));
    std::vector<std::uint64_t> hashes(4);
    std::vector<std::thread> threads;
    std::atomic<int> bad(0);
    for (std::size_t t = 0; t < hashes.size(); ++t)
        threads.emplace_back([&, t] {
            try {
                mw::Job job(context, MW_JOB_IMAGE_TO_MESH);
                job.set("labels", image);
                job.set("lattice-spacing", 4.0);
                for (int round = 0; round < 3; ++round) job.run();
                const mw::Mesh mesh = job.mesh();
                mesh.check();
                hashes[t] = hash_of(mesh);
                // The last error is this thread's own.
                if (mw_job_run(nullptr) != MW_E_ARG || !std::strstr(mw_last_error(), "job")) ++bad;
            } catch (const std::exception &error) {
                std::fprintf(stderr, "thread %d: %s\n", static_cast<int>(t), error.what());
                ++bad;
            }
        });
    for (std::thread &thread : threads) thread.join();
    CHECK(bad == 0);
    for (std::uint64_t hash : hashes) CHECK(hash == hashes[0]);
}

static void same_bits_for_any_number_of_threads() {
    std::uint64_t first = 0;
    for (int threads : {1, 2, 3}) {
        mw::Context context(threads);
        mw::Job job = ball_job(context);
        job.run();
        const std::uint64_t hash = hash_of(job.mesh());
        if (!first) first = hash;
        CHECK(hash == first);
    }
}

static void cancel_at_random_moments() {
    const mw::Context context(2);
    mw::Job job = ball_job(context, 56, 2.0);
    std::mt19937 random(20261121);
    int cancelled = 0;
    for (int round = 0; round < 12; ++round) {
        const auto delay = std::chrono::microseconds(random() % 60000);
        std::chrono::steady_clock::time_point asked;
        std::thread other([&] {
            std::this_thread::sleep_for(delay);
            asked = std::chrono::steady_clock::now();
            job.cancel();
        });
        const mw_status status = mw_job_run(job.get());
        other.join();
        CHECK(status == MW_OK || status == MW_E_CANCELLED);
        cancelled += status == MW_E_CANCELLED;
        // A cancellation that came too late stops the next run; use it up.
        if (status == MW_OK) CHECK(mw_job_run(job.get()) == MW_E_CANCELLED);
        mw_mesh *mesh = nullptr;
        CHECK(mw_job_take_mesh(job.get(), &mesh) == MW_E_STATE && !mesh);
    }
    std::printf("%d of 12 runs were cancelled in their middle\n", cancelled);
    job.run();
    job.mesh().check();
}

/// A progress function that cancels after a random number of reports, from a context that four threads share.
static void callbacks_cancel_at_random_moments() {
    const mw::Context context(2);
    std::vector<std::thread> threads;
    std::atomic<int> bad(0), cancelled(0);
    for (unsigned t = 0; t < 4; ++t)
        threads.emplace_back([&context, &bad, &cancelled, t] {
            std::mt19937 random(20261121 + t);
            mw::Job job = ball_job(context, 40, 2.0);
            for (int round = 0; round < 3; ++round) {
                const int last = static_cast<int>(random() % 8);
                int reports = 0;
                job.set_progress([&reports, last](const std::string &, double) { return ++reports <= last; });
                const mw_status status = mw_job_run(job.get());
                mw_mesh *mesh = nullptr;
                const mw_status taken = mw_job_take_mesh(job.get(), &mesh);
                const bool whole = status == MW_OK && taken == MW_OK && mw_mesh_check(mesh) == MW_OK;
                bad += !whole && !(status == MW_E_CANCELLED && taken == MW_E_STATE && !mesh);
                cancelled += status == MW_E_CANCELLED;
                mw_mesh_destroy(mesh);
            }
        });
    for (std::thread &thread : threads) thread.join();
    std::printf("%d of 12 runs were cancelled by their progress function\n", cancelled.load());
    CHECK(bad == 0 && cancelled > 0);
}

static void progress_cancels_and_throws() {
    const mw::Context context(2);
    mw::Job job = ball_job(context, 48, 2.0);
    const std::thread::id caller = std::this_thread::get_id();
    double last = 0.0;
    bool ordered = true, own_thread = true;
    job.set_progress([&](const std::string &stage, double done) {
        ordered = ordered && done >= last && done <= 1.0 && !stage.empty();
        own_thread = own_thread && std::this_thread::get_id() == caller;
        last = done;
        return true;
    });
    job.run();
    CHECK(ordered && own_thread && last == 1.0);

    job.set_progress([](const std::string &, double) { return false; });
    const mw_status status = mw_job_run(job.get());
    CHECK(status == MW_E_CANCELLED || status == MW_OK); // the run may end before the first report
    job.set_progress([](const std::string &, double) -> bool { throw std::runtime_error("host"); });
    try {
        job.run();
        CHECK(!"the exception got lost");
    } catch (const std::runtime_error &error) {
        CHECK(std::string(error.what()) == "host");
    }
    job.set_progress(nullptr);
    job.run();
}

static void a_job_in_use_says_so() {
    const mw::Context context(1);
    mw::Job job = ball_job(context, 48, 2.0);
    mw_status inside = MW_OK;
    job.set_progress([&](const std::string &, double done) {
        if (done < 1.0) inside = mw_job_set_f64(job.get(), "lattice-spacing", 3.0);
        return true;
    });
    job.run();
    CHECK(inside == MW_E_STATE || inside == MW_OK); // OK: the run ended before the first report
}

static void log_lines_come_one_at_a_time() {
    mw::Context context(2);
    std::atomic<int> inside(0), overlaps(0), lines(0);
    context.set_log([&](std::int32_t level, const std::string &) {
        if (++inside != 1 || level < MW_LOG_WARNING || level > MW_LOG_DEBUG) ++overlaps;
        ++lines;
        --inside;
    }, MW_LOG_DEBUG);
    std::vector<std::thread> threads;
    for (int t = 0; t < 3; ++t) threads.emplace_back([&] { ball_job(context).run(); });
    for (std::thread &thread : threads) thread.join();
    CHECK(overlaps == 0);
}

int main() {
    one_context_many_threads();
    same_bits_for_any_number_of_threads();
    cancel_at_random_moments();
    callbacks_cancel_at_random_moments();
    progress_cancels_and_throws();
    a_job_in_use_says_so();
    log_lines_come_one_at_a_time();
    return finish("test_threads");
}
