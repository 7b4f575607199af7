// Parts of a training step outside the rasterizer that are as large as the scene or the image.
#pragma once

#include <cstdint>

namespace splat {

// Adds to gradient_sum (rows) the norm of means2d (rows, 2) times (scale_x, scale_y), and to seen
// (rows) 1 where radii (rows) are positive.
void observe_gradients(const float* means2d, const float* radii, double scale_x, double scale_y,
                       int64_t rows, int threads, float* gradient_sum, float* seen);

}  // namespace splat
