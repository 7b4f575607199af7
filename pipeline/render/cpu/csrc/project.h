// Stage 1: projects world Gaussians to Records on the image; and its backward pass.
#pragma once

#include "sh_adam.h"
#include "types.h"

namespace splat {

struct GaussianUpdate;

struct ProjectCounts {
    int64_t visible = 0, dropped = 0;
};

// Writes radii (N) of all Gaussians, and records (N) of those with radius > 0. Dropped are
// Gaussians with values that are not finite, invalid quaternions, or covariances or SH out of
// range.
ProjectCounts project_view(const Gaussians& in, const View& view, int threads, Record* records,
                           float* radii);

// dL/d(parameter), each shaped as its parameter; means2d (N, 2); colors (N, 3), of the colours
// before they are clamped. colors may be null, and sh if Adam is applied at once. All elements are
// written.
struct GaussianGradients {
    float *means, *log_scales, *quats, *opacity_logits, *means2d, *sh, *colors;

    // Those of the Gaussians from `first` on.
    GaussianGradients from(int64_t first, int64_t sh_width) const {
        const auto at = [first](float* row, int64_t width) {
            return row ? row + width * first : nullptr;
        };
        return {at(means, 3),   at(log_scales, 3), at(quats, 4), at(opacity_logits, 1),
                at(means2d, 2), at(sh, sh_width),  at(colors, 3)};
    }
};

// Sums the gradient slots of each Gaussian in order and computes the gradients of its parameters.
// If any gradient of a Gaussian overflows float32, all of them are zero. With sh_adam, the SH
// coefficients of Gaussians with a gradient are updated. With update, so are the other parameters,
// and out has colours alone. camera: kCameraParameters sums over the Gaussians, may be null.
void project_view_backward(const Gaussians& in, const View& view, int threads,
                           const Record* records, const float* radii, const Slots* slots,
                           const float* slot_gradients, const GaussianGradients& out,
                           double* camera, const ShAdam* sh_adam, const GaussianUpdate* update);

}  // namespace splat
