#include "surroundings.h"

#include "threads.h"

namespace splat {
namespace {

constexpr float kUnit = 1.0f / 255;
// Pixels of a range: rows of an image, in the nearest cache.
constexpr int64_t kGrain = 2048;

float clamp(float value, float low, float high) {
    return value < low ? low : value > high ? high : value;
}

}  // namespace

void compose(const Surroundings& s, const float* color, const float* alpha, int threads,
             float* image) {
    parallel_ranges(s.pixels, kGrain, threads, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i++) {
            const float through = (1 - alpha[i]) * kUnit;
            for (int64_t k = 3 * i; k < 3 * i + 3; k++)
                image[k] = color[k] + through * float(s.behind[k]);
        }
        if (s.front)
            for (int64_t i = begin; i < end; i++) {
                const float passing = float(s.transmittance[i]) * kUnit;
                for (int64_t k = 3 * i; k < 3 * i + 3; k++)
                    image[k] = image[k] * passing + float(s.front[k]) * kUnit;
            }
        if (s.correction)
            for (int64_t k = 3 * begin; k < 3 * end; k++)
                image[k] += float(s.correction[k]) * kUnit;
    });
}

void compose_backward(const Surroundings& s, const float* alpha, const float* d_image,
                      const AlphaChangeLoss& loss, int threads, float* d_color, float* d_alpha) {
    const float factor = 2 * loss.weight / float(s.pixels);
    parallel_ranges(s.pixels, kGrain, threads, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i++) {
            const float passing = s.front ? float(s.transmittance[i]) * kUnit : 1.0f;
            float hidden = 0;
            for (int64_t k = 3 * i; k < 3 * i + 3; k++) {
                d_color[k] = d_image[k] * passing;
                hidden += d_color[k] * float(s.behind[k]);
            }
            const float change = alpha[i] - float(s.alpha[i]) * kUnit;
            const float beyond = change - clamp(change, -loss.fade, loss.growth);
            d_alpha[i] = factor * beyond - hidden * kUnit;
        }
    });
}

}  // namespace splat
