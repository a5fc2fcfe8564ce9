// Watches a run, ends it from the progress function, ends it from another thread, and limits its time.
//
//   02_progress_and_cancel
#include <meshwright.hpp>

#include <chrono>
#include <cstdint>
#include <iostream>
#include <thread>
#include <vector>

static mw::Image ball(const mw::Context &context) {
    const int n = 72;
    std::vector<std::uint8_t> voxels(n * n * n);
    for (int k = 0; k < n; ++k)
        for (int j = 0; j < n; ++j)
            for (int i = 0; i < n; ++i) {
                const double x = i - 35.5, y = j - 35.5, z = k - 35.5;
                voxels[i + n * (j + n * k)] = x * x + y * y + z * z < 900.0;
            }
    return mw::Image(context, voxels.data(), {{n, n, n}}); // copied: the vector may go
}

int main() {
    try {
        const mw::Context context;
        mw::Job job(context, MW_JOB_IMAGE_TO_MESH);
        job.set("labels", ball(context));
        job.set("lattice-spacing", 4.0);

        // 1. Watch. The function is called on this thread, so a user interface may be drawn from it.
        std::string last;
        job.set_progress([&last](const std::string &stage, double done) {
            if (stage != last) std::cout << static_cast<int>(100 * done) << " % " << stage << '\n';
            last = stage;
            return true; // go on
        });
        job.run();
        std::cout << job.mesh().cell_count() << " cells\n";

        // 2. Cancel from the progress function.
        job.set_progress([](const std::string &, double) { return false; });
        try {
            job.run();
            std::cout << "the run was faster than the first report\n";
        } catch (const mw::Error &error) {
            if (error.status() != MW_E_CANCELLED) throw;
            std::cout << "cancelled by the progress function\n";
        }
        job.set_progress(nullptr);

        // 3. Cancel from another thread: the one call that is allowed while the job runs.
        std::thread other([&job] {
            std::this_thread::sleep_for(std::chrono::milliseconds(20));
            job.cancel();
        });
        try {
            job.run();
            std::cout << "the run was faster than the other thread\n";
        } catch (const mw::Error &error) {
            if (error.status() != MW_E_CANCELLED) throw;
            std::cout << "cancelled by another thread\n";
        }
        other.join();
        return 0;
    } catch (const mw::Error &error) {
        std::cerr << error.what() << '\n';
        return 1;
    }
}
