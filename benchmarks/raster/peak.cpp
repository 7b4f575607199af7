// What one machine can do at most, for the fractions in the table: multiply-adds in registers, and
// bytes read and written by a sweep over arrays far larger than the caches.

#include <omp.h>
#include <time.h>

#include <cstdint>
#include <vector>

#include "simd.h"

using namespace splat;

namespace {

double cpu_seconds() {
    timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return double(now.tv_sec) + 1e-9 * double(now.tv_nsec);
}

// The least CPU time of a thread, over some rounds of all threads at once.
template <class Work>
double best_seconds(int threads, const Work& work) {
    double best = 1e30;
    for (int round = 0; round < 9; round++) {
        double sum = 0;
#pragma omp parallel num_threads(threads) reduction(+ : sum)
        {
            const double start = cpu_seconds();
            work(omp_get_thread_num());
            sum += cpu_seconds() - start;
        }
        if (sum / threads < best) best = sum / threads;
    }
    return best;
}

}  // namespace

extern "C" double peak_flops(int threads) {
    constexpr int kChains = 12, kRounds = 400000;
    const double seconds = best_seconds(threads, [](int) {
        f32x16 chain[kChains];
        for (int i = 0; i < kChains; i++) chain[i] = lane_numbers() * float(i);
        for (int round = 0; round < kRounds; round++) {
            for (int i = 0; i < kChains; i++) chain[i] = chain[i] * 0.999f + 1e-4f;
            asm volatile("");
        }
        for (const f32x16& c : chain) {
            volatile float kept;
            kept = *reinterpret_cast<const float*>(&c);
            (void)kept;
        }
    });
    return 2.0 * 16 * kChains * kRounds * threads / seconds;
}

extern "C" double peak_bytes(int threads) {
    const int64_t share = (int64_t(96) << 20) / threads / 64 * 16;  // floats of a thread
    std::vector<float> from(share * threads, 1.0f), to(share * threads);
    const double seconds = best_seconds(threads, [&](int thread) {
        const float* a = from.data() + share * thread;
        float* b = to.data() + share * thread;
        for (int64_t i = 0; i < share; i += 16)
            store(b + i, load<f32x16>(b + i) + load<f32x16>(a + i));
    });
    return 3.0 * sizeof(float) * share * threads / seconds;
}
