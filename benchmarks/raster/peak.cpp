// What one machine can do at most, for the fractions in the table: multiply-adds in registers, and
// bytes read and written by a sweep over arrays far larger than the caches. By explicit
// instructions of the widest set that the processor has, so that neither compiler nor flags matter.

#include <time.h>

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstring>
#include <thread>
#include <vector>
#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace {

struct InstructionSet {
    const char* name;
    int lanes;  // float32
    bool fused;
    int chains;
    void (*multiply_add)(int rounds);                                // on every chain
    void (*add)(const float* from, float* to, const float* to_end);  // to += from
};

// Independent chains that cover the latency (about 4 cycles) of all units that multiply and add
// (2 on most x86, 4 on large Arm cores), in fewer registers than there are (16; 32 where kMany is
// used).
constexpr int kFew = 12, kMany = 16;

// A macro, because a template's lambdas and operators would not inherit the target attribute.
#define SPLAT_LOOPS(NAME, TARGET, V, LANES, CHAINS, SET, LOAD, STORE, MULTIPLY_ADD, ADD)        \
    TARGET void multiply_add_##NAME(int rounds) {                                               \
        V chain[CHAINS];                                                                        \
        for (int i = 0; i < CHAINS; i++) chain[i] = SET(float(i));                              \
        const V factor = SET(0.999f), offset = SET(1e-4f);                                      \
        for (int round = 0; round < rounds; round++)                                            \
            for (int i = 0; i < CHAINS; i++) chain[i] = MULTIPLY_ADD(chain[i], factor, offset); \
        V sum = chain[0];                                                                       \
        for (int i = 1; i < CHAINS; i++) sum = ADD(sum, chain[i]);                              \
        float kept[LANES];                                                                      \
        STORE(kept, sum);                                                                       \
        volatile float used = kept[0];                                                          \
        (void)used;                                                                             \
    }                                                                                           \
    TARGET void add_##NAME(const float* from, float* to, const float* to_end) {                 \
        for (; to != to_end; from += LANES, to += LANES) STORE(to, ADD(LOAD(to), LOAD(from)));  \
    }

#if defined(__x86_64__)

#define SPLAT_SSE_MULTIPLY_ADD(a, b, c) _mm_add_ps(_mm_mul_ps(a, b), c)
SPLAT_LOOPS(sse, __attribute__((target("sse2"))), __m128, 4, kFew, _mm_set1_ps, _mm_loadu_ps,
            _mm_storeu_ps, SPLAT_SSE_MULTIPLY_ADD, _mm_add_ps)
SPLAT_LOOPS(avx2, __attribute__((target("avx2,fma"))), __m256, 8, kFew, _mm256_set1_ps,
            _mm256_loadu_ps, _mm256_storeu_ps, _mm256_fmadd_ps, _mm256_add_ps)
SPLAT_LOOPS(avx512, __attribute__((target("avx512f"))), __m512, 16, kMany, _mm512_set1_ps,
            _mm512_loadu_ps, _mm512_storeu_ps, _mm512_fmadd_ps, _mm512_add_ps)

InstructionSet widest() {
    if (__builtin_cpu_supports("avx512f"))
        return {"AVX-512", 16, true, kMany, multiply_add_avx512, add_avx512};
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
        return {"AVX2", 8, true, kFew, multiply_add_avx2, add_avx2};
    return {"SSE2", 4, false, kFew, multiply_add_sse, add_sse};
}

#elif defined(__aarch64__)

#define SPLAT_NEON_MULTIPLY_ADD(a, b, c) vfmaq_f32(c, a, b)
SPLAT_LOOPS(neon, , float32x4_t, 4, kMany, vdupq_n_f32, vld1q_f32, vst1q_f32,
            SPLAT_NEON_MULTIPLY_ADD, vaddq_f32)

InstructionSet widest() { return {"NEON", 4, true, kMany, multiply_add_neon, add_neon}; }

#else
#error "peak.cpp has instructions for x86-64 and AArch64 only"
#endif

constexpr int kRounds = 200000, kTurns = 9;

double cpu_seconds() {
    timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return double(now.tv_sec) + 1e-9 * double(now.tv_nsec);
}

// One cycle an addition: each needs the one before it. A register is added, because additions of
// constants take no cycle on some processors.
double clock_hz() {
    constexpr int kLoops = 20000, kAdditions = 16;
    uint64_t sum = 0, one = 1;
    asm volatile("" : "+r"(one));
    const double start = cpu_seconds();
    for (int loop = 0; loop < kLoops; loop++)
        for (int i = 0; i < kAdditions; i++) {
            sum += one;
            asm volatile("" : "+r"(sum));
        }
    return kLoops * kAdditions / (cpu_seconds() - start);
}

// Runs work(thread) on all threads at once.
template <class Work>
void on_threads(int threads, const Work& work) {
    std::atomic<int> ready{0};
    std::vector<std::thread> running;
    for (int thread = 0; thread < threads; thread++)
        running.emplace_back([&, thread] {
            ready++;
            while (ready < threads) std::this_thread::yield();
            work(thread);
        });
    for (std::thread& thread : running) thread.join();
}

// The least mean CPU time of a thread over some turns.
template <class Work>
double best_seconds(int threads, const Work& work) {
    std::vector<double> seconds(threads);
    double best = 1e30;
    for (int turn = 0; turn < kTurns; turn++) {
        on_threads(threads, [&](int thread) {
            const double start = cpu_seconds();
            work(thread);
            seconds[thread] = cpu_seconds() - start;
        });
        double sum = 0;
        for (double s : seconds) sum += s;
        best = std::min(best, sum / threads);
    }
    return best;
}

}  // namespace

extern "C" {

const char* peak_name() { return widest().name; }
int peak_lanes() { return widest().lanes; }
int peak_fused() { return widest().fused; }

// Operations a second, of all threads together.
double peak_flops(int threads) {
    const InstructionSet set = widest();
    const double seconds = best_seconds(threads, [&](int) { set.multiply_add(kRounds); });
    return 2.0 * set.lanes * set.chains * kRounds * threads / seconds;
}

// Cycles a second of one core. Measured right behind multiply-adds, because some processors lower
// their clock for wide vectors.
double peak_clock() {
    const InstructionSet set = widest();
    double best = 0;
    for (int turn = 0; turn < kTurns; turn++) {
        set.multiply_add(kRounds);
        best = std::max(best, clock_hz());
    }
    return best;
}

// Bytes read and written a second, of all threads together.
double peak_bytes(int threads) {
    const InstructionSet set = widest();
    const int64_t share = (int64_t(96) << 20) / threads / 64 * 16;  // floats of a thread
    std::vector<float> from(share * threads, 1.0f), to(share * threads);
    const double seconds = best_seconds(threads, [&](int thread) {
        float* begin = to.data() + share * thread;
        set.add(from.data() + share * thread, begin, begin + share);
    });
    return 3.0 * sizeof(float) * share * threads / seconds;
}

}  // extern "C"
