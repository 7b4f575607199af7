#include "adam.h"

#include <cmath>
#include <vector>

#include "group.h"
#include "threads.h"

namespace splat {
namespace {

// What a step's rates are multiplied by, and a second moment's root.
struct Corrections {
    double to_rate;
    float to_root;

    explicit Corrections(const AdamSettings& s)
        : to_rate(1 / (1 - std::pow(s.beta1, double(s.step)))),
          to_root(float(1 / std::sqrt(1 - std::pow(s.beta2, double(s.step))))) {}
};

// Powers of two beyond this are taken for overflow: squares of gradients in such units stay finite.
constexpr float kLog2UnitMax = 40.0f;

// e to the mean of three logarithms a row.
SPLAT_INLINE f32x16 units(const float* logs, int count) {
    constexpr float kLog2E = 1.4426950408889634f;
    f32x16 log[3];
    read_rows(logs, count, log);
    const f32x16 mean = (log[0] + log[1] + log[2]) * (kLog2E / 3.0f);
    const f32x16 power[1] = {min(max(mean, splat16(-kLog2UnitMax)), splat16(kLog2UnitMax))};
    f32x16 unit[1];
    exp2(power, unit);
    return unit[0];
}

template <int K>
void adam_rows(float* param, const float* grad, float* exp_avg, float* exp_avg_sq,
               const float* log_units, int64_t rows, const AdamSettings& s, int threads) {
    const Corrections correct(s);
    const float rate = float(s.rates[0] * correct.to_rate), eps = float(s.eps);
    const float beta1 = float(s.beta1), beta2 = float(s.beta2);
    const float rest1 = float(1 - s.beta1), rest2 = float((1 - s.beta2) / K);
    parallel_for((rows + kGroup - 1) / kGroup, 256, threads, [&](int64_t number) {
        const int64_t first = kGroup * number;
        const int count = int(rows - first < kGroup ? rows - first : kGroup);
        f32x16 p[K], g[K], m[K], squares = {};
        read_rows(param + K * first, count, p);
        read_rows(grad + K * first, count, g);
        read_rows(exp_avg + K * first, count, m);
        const f32x16 unit = log_units ? units(log_units + 3 * first, count) : splat16(1.0f);
        for (int k = 0; k < K; k++) g[k] *= unit;
        for (int k = 0; k < K; k++) squares += g[k] * g[k];
        const f32x16 v = read_column(exp_avg_sq + first, count) * beta2 + squares * rest2;
        const f32x16 far = rate * unit / (sqrt(v) * correct.to_root + eps);
        for (int k = 0; k < K; k++) {
            m[k] = m[k] * beta1 + g[k] * rest1;
            p[k] -= far * m[k];
        }
        write_rows(p, count, param + K * first);
        write_rows(m, count, exp_avg + K * first);
        write_column(v, count, exp_avg_sq + first);
    });
}

}  // namespace

void adam_step(float* param, const float* grad, float* exp_avg, float* exp_avg_sq, int64_t count,
               const AdamSettings& s, int threads) {
    const float beta1 = float(s.beta1), beta2 = float(s.beta2), eps = float(s.eps);
    const float rest1 = float(1 - s.beta1), rest2 = float(1 - s.beta2);
    // Every pattern of rates starts anew after as many vectors as it has rates.
    std::vector<float> rates(16 * s.num_rates);
    const Corrections correct(s);
    for (size_t i = 0; i < rates.size(); i++)
        rates[i] = float(s.rates[i % s.num_rates] * correct.to_rate);
    const auto update = [&](int64_t k, f32x16& p, f32x16 g, f32x16& m, f32x16& v) {
        m = m * beta1 + g * rest1;
        v = v * beta2 + g * g * rest2;
        p -= load<f32x16>(rates.data() + 16 * (k % s.num_rates)) * m /
             (sqrt(v) * correct.to_root + eps);
    };
    const int64_t vectors = count / 16;
    parallel_for(vectors, 1024, threads, [&](int64_t k) {
        const int64_t i = 16 * k;
        f32x16 p = load<f32x16>(param + i), m = load<f32x16>(exp_avg + i);
        f32x16 v = load<f32x16>(exp_avg_sq + i);
        update(k, p, load<f32x16>(grad + i), m, v);
        store(param + i, p);
        store(exp_avg + i, m);
        store(exp_avg_sq + i, v);
    });
    const int64_t done = 16 * vectors, bytes = (count - done) * int64_t(sizeof(float));
    if (bytes == 0) return;
    f32x16 p = {}, g = {}, m = {}, v = {};
    std::memcpy(&p, param + done, bytes);
    std::memcpy(&g, grad + done, bytes);
    std::memcpy(&m, exp_avg + done, bytes);
    std::memcpy(&v, exp_avg_sq + done, bytes);
    update(vectors, p, g, m, v);
    std::memcpy(param + done, &p, bytes);
    std::memcpy(exp_avg + done, &m, bytes);
    std::memcpy(exp_avg_sq + done, &v, bytes);
}

void adam_step_rows(float* param, const float* grad, float* exp_avg, float* exp_avg_sq,
                    const float* log_units, int64_t rows, int width, const AdamSettings& settings,
                    int threads) {
    (width == 3 ? adam_rows<3> : adam_rows<4>)(param, grad, exp_avg, exp_avg_sq, log_units, rows,
                                               settings, threads);
}

}  // namespace splat
