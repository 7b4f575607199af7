// The loss of 3DGS, (1 - w) E + w (1 - SSIM), with its gradient. E is the mean of |d| + k d^2; with
// k = 0 it is the L1 loss of 3DGS.
#pragma once

#include <cstdint>

namespace splat {

struct LossImages {
    int64_t width, height;
    const float* rendered;  // (H, W, 3)
    const float* factor;    // of the rendered image: (3) or (H, W, 3); may be null: 1
    bool factor_is_image;
    const float* target_float;    // (H, W, 3), or null: target_bytes is used
    const uint8_t* target_bytes;  // (H, W, 3), 255 represents 1
    const uint8_t* mask;          // (H, W), non-zero: ignored; may be null
};

struct LossWeights {
    double ssim, square;  // w, k
};

struct LossValues {
    double loss, error, ssim, squared_error;  // the last is the mean of d^2
};

// SSIM (Wang et al. 2004) in an 11 x 11 Gaussian window of sigma 1.5 with zero padding; means over
// the unmasked pixels and the three channels. Writes grad (H, W, 3), with respect to the rendered
// image before it is multiplied by the factor.
LossValues l1_ssim(const LossImages& images, const LossWeights& weights, int threads, float* grad);

}  // namespace splat
