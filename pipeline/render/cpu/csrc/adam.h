// Adam (Kingma & Ba 2015), dense and in place.
#pragma once

#include <cstdint>

namespace splat {

struct AdamSettings {
    const double* rates;  // learning rates, repeated over the elements
    int64_t num_rates;    // at least 1
    double beta1, beta2, eps;
    int64_t step;  // from 1
};

void adam_step(float* param, const float* grad, float* exp_avg, float* exp_avg_sq, int64_t count,
               const AdamSettings& settings, int threads);

// Rows of `width`, 3 or 4, floats that share a second moment, exp_avg_sq (rows); one rate.
void adam_step_rows(float* param, const float* grad, float* exp_avg, float* exp_avg_sq,
                    int64_t rows, int width, const AdamSettings& settings, int threads);

// The first and second moments, rows of 3 each, of means and of turns.
struct FrameMoments {
    float *mean, *mean_sq, *turn, *turn_sq;
};

// Means (rows, 3) and quaternions (rows, 4) along and about each Gaussian's own axes: a mean's
// steps count in the scale along the axis. Two rates.
void frame_adam(float* means, float* quats, const float* log_scales, const float* d_means,
                const float* d_quats, const FrameMoments& moments, int64_t rows,
                const AdamSettings& settings, int threads);

}  // namespace splat
