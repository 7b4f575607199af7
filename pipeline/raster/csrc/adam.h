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

// Rows of `width`, 3 or 4, floats that share a second moment, exp_avg_sq (rows); one rate. With
// log_units (rows, 3) a row counts in a unit of its own, e to the mean of the three.
void adam_step_rows(float* param, const float* grad, float* exp_avg, float* exp_avg_sq,
                    const float* log_units, int64_t rows, int width, const AdamSettings& settings,
                    int threads);

}  // namespace splat
