#include "step.h"

#include <cmath>
#include <vector>

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

void scale_colors(const float* image, const float* factors, int64_t period, int64_t values,
                  int threads, float* scaled) {
    if (period == values) {
        parallel_for(values, kGrain, threads,
                     [&](int64_t i) { scaled[i] = image[i] * factors[i]; });
        return;
    }
    parallel_for(values / 3, kGrain / 2, threads, [&](int64_t pixel) {
        for (int64_t c = 0; c < 3; c++) scaled[3 * pixel + c] = image[3 * pixel + c] * factors[c];
    });
}

double mean_squared_error(const LossImages& in, int threads) {
    // Sums of each row, added in order: the result does not depend on the number of threads.
    std::vector<double> errors(in.height, 0);
    std::vector<int64_t> counts(in.height, 0);
    parallel_for(in.height, 8, threads, [&](int64_t y) {
        const int64_t row = y * in.width;
        double error = 0;
        int64_t count = 0;
        for (int64_t i = row; i < row + in.width; i++) {
            if (in.mask && in.mask[i]) continue;
            for (int64_t k = 3 * i; k < 3 * i + 3; k++) {
                const float target =
                    in.target_float ? in.target_float[k] : float(in.target_bytes[k]) / 255.0f;
                const double difference = double(in.rendered[k]) - double(target);
                error += difference * difference;
            }
            count += 3;
        }
        errors[y] = error;
        counts[y] = count;
    });
    double error = 0;
    int64_t count = 0;
    for (int64_t y = 0; y < in.height; y++) error += errors[y], count += counts[y];
    return count ? error / double(count) : 0;
}

}  // namespace splat
