// Adam (Kingma & Ba 2015), dense and in place.
#pragma once

#include <cmath>
#include <cstdint>

namespace splat {

struct AdamSettings {
    const double* rates;  // learning rates, repeated over the elements
    int64_t num_rates;    // at least 1
    double beta1, beta2, eps;
    int64_t step;  // from 1
    // Bias corrections: factors of the learning rates and of the root of the second moment.
    double to_rate = 1 / (1 - std::pow(beta1, double(step)));
    float to_root = float(1 / std::sqrt(1 - std::pow(beta2, double(step))));
};

void adam_step(float* param, const float* grad, float* exp_avg, float* exp_avg_sq, int64_t count,
               const AdamSettings& settings, int threads);

// Adam over rows of `width` floats (3 or 4) that share a second moment exp_avg_sq (rows); one rate.
void adam_step_rows(float* param, const float* grad, float* exp_avg, float* exp_avg_sq,
                    int64_t rows, int width, const AdamSettings& settings, int threads);

// First and second moments of means and of rotations, (rows, 3) each.
struct FrameMoments {
    float *mean, *mean_sq, *rotation, *rotation_sq;
};

// Adam over means (rows, 3) and quaternions (rows, 4) in the local frame of each Gaussian: steps of
// a mean are relative to the scale along each axis. Two rates.
void frame_adam(float* means, float* quats, const float* log_scales, const float* d_means,
                const float* d_quats, const FrameMoments& moments, int64_t rows,
                const AdamSettings& settings, int threads);

}  // namespace splat
