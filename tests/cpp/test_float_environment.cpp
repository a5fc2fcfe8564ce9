// A host that rounds upward, or flushes denormals to zero, gets the same mesh, and keeps its mode.
#include "support.hpp"

#include <cfenv>
#if defined(__x86_64__)
#include <xmmintrin.h>
#endif

static std::uint64_t mesh_hash() {
    mw::Context context(2);
    mw::Job job = ball_job(context);
    job.run();
    return hash_of(job.mesh());
}

int main() {
    const std::uint64_t expected = mesh_hash();
    for (int mode : {FE_UPWARD, FE_DOWNWARD, FE_TOWARDZERO}) {
        std::fesetround(mode);
        const std::uint64_t hash = mesh_hash();
        CHECK(hash == expected);
        CHECK(std::fegetround() == mode);
        std::fesetround(FE_TONEAREST);
    }
#if defined(__x86_64__)
    const unsigned int flush = 0x8040; // FTZ and DAZ
    _mm_setcsr(_mm_getcsr() | flush);
    CHECK(mesh_hash() == expected);
    CHECK((_mm_getcsr() & flush) == flush);

    // A context made in the host's mode, and a callback that runs in it.
    mw::Context context(1);
    mw::Job job = ball_job(context, 40, 2.0);
    bool host_mode = true;
    job.set_progress([&host_mode, flush](const std::string &, double) {
        host_mode = host_mode && (_mm_getcsr() & flush) == flush;
        return true;
    });
    job.run();
    CHECK(host_mode);
    _mm_setcsr(_mm_getcsr() & ~flush);
#endif
    return finish("test_float_environment");
}
