// Parts of a training step outside the rasterizer that are as large as the scene or the image.
#pragma once

#include <cstdint>

#include "loss.h"

namespace splat {

// Adds to gradient_sum (rows) the norm of means2d (rows, 2) times (scale_x, scale_y), and to seen
// (rows) 1 where radii (rows) are positive.
void observe_gradients(const float* means2d, const float* radii, double scale_x, double scale_y,
                       int64_t rows, int threads, float* gradient_sum, float* seen);

// Writes scaled (values), the product of image (values) and factors, which has `period` values and
// is repeated: 3 for one colour, or one for each value.
void scale_colors(const float* image, const float* factors, int64_t period, int64_t values,
                  int threads, float* scaled);

// The mean of the squared differences of the images over the unmasked values; 0 if there are none.
double mean_squared_error(const LossImages& images, int threads);

}  // namespace splat
