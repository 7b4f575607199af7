// 3DGS's loss, (1 - w) E + w (1 - SSIM), with its gradient. Its E is L1; here k squared errors
// may join: |d| + k d^2.
#pragma once

#include <cstdint>

namespace splat {

struct LossImages {
    int64_t width, height;
    const float* rendered;        // (H, W, 3)
    const float* target_float;    // (H, W, 3), or null:
    const uint8_t* target_bytes;  // (H, W, 3), 255 is 1
    const uint8_t* mask;          // (H, W), not 0: left out; may be null
};

struct LossWeights {
    double ssim, square;  // w, k
};

struct LossValues {
    double loss, error, ssim;
};

// SSIM of Wang et al. 2004 in an 11 x 11 Gaussian window of sigma 1.5, zeros beyond the image;
// means over the pixels that the mask leaves and the three channels. Writes grad (H, W, 3).
LossValues l1_ssim(const LossImages& images, const LossWeights& weights, int threads, float* grad);

}  // namespace splat
