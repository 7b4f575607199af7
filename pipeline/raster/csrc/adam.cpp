#include "adam.h"

#include <cmath>
#include <vector>

#include "simd.h"
#include "threads.h"

namespace splat {

void adam_step(float* param, const float* grad, float* exp_avg, float* exp_avg_sq, int64_t count,
               const AdamSettings& s, int threads) {
    const float beta1 = float(s.beta1), beta2 = float(s.beta2), eps = float(s.eps);
    const float rest1 = float(1 - s.beta1), rest2 = float(1 - s.beta2);
    // Every pattern of rates starts anew after as many vectors as it has rates.
    std::vector<float> rates(16 * s.num_rates);
    for (size_t i = 0; i < rates.size(); i++)
        rates[i] = float(s.rates[i % s.num_rates] / (1 - std::pow(s.beta1, double(s.step))));
    const float scale = float(1 / std::sqrt(1 - std::pow(s.beta2, double(s.step))));
    const auto update = [&](int64_t k, f32x16& p, f32x16 g, f32x16& m, f32x16& v) {
        m = m * beta1 + g * rest1;
        v = v * beta2 + g * g * rest2;
        p -= load<f32x16>(rates.data() + 16 * (k % s.num_rates)) * m / (sqrt(v) * scale + eps);
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

}  // namespace splat
