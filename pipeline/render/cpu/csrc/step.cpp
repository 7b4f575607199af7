#include "step.h"

#include <cmath>

#include "threads.h"

namespace splat {
namespace {

// Values of a range: some microseconds of work.
constexpr int64_t kGrain = 8192;

}  // namespace

void observe_gradients(const float* means2d, const float* radii, double scale_x, double scale_y,
                       int64_t rows, int threads, float* gradient_sum, float* seen) {
    const float to_x = float(scale_x), to_y = float(scale_y);
    parallel_for(rows, kGrain, threads, [&](int64_t i) {
        // Squares of float32 neither overflow nor vanish in float64.
        const double x = means2d[2 * i] * to_x, y = means2d[2 * i + 1] * to_y;
        gradient_sum[i] += float(std::sqrt(x * x + y * y));
        seen[i] += float(radii[i] > 0);
    });
}

}  // namespace splat
