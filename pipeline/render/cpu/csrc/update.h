// What an optimiser step does with the gradients of Gaussians, except those of SH coefficients,
// while they are in a core's cache.
#pragma once

#include "adam.h"
#include "project.h"

namespace splat {

struct GaussianUpdate {
    struct Moments {
        float *exp_avg, *exp_avg_sq;
    };
    float *means, *quats, *log_scales, *opacity_logits;
    FrameMoments frame_moments;
    Moments scale_moments, opacity_moments;
    AdamSettings frames, scales, opacities;
    // Statistics of density control, see observe_gradients; may be null.
    float *gradient_sum, *seen;
    const float* radii;
    double scale_x, scale_y;

    // Updates `count` Gaussians from `first` on, a multiple of 16. gradients: theirs alone.
    void operator()(int64_t first, int64_t count, const GaussianGradients& gradients) const;
};

}  // namespace splat
