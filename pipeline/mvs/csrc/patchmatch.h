// Types of the PatchMatch kernel that Python passes (pipeline/mvs/patchmatch.py).
#pragma once

#include <cstdint>

extern "C" {

// A source image. A reference pixel (x, y) with inverse depth w is at the homogeneous pixel
// rotation (x, y, 1)^T + translation w of the source: rotation = K_s R K_r^-1, translation = K_s t.
struct Source {
    const uint8_t* grey;
    int32_t width, height;
    float rotation[9];
    float translation[3];
};

// Reference view and parameters. A pixel's plane is its inverse depth w at the pixel's centre and
// the gradient (wx, wy) of the inverse depth per pixel: the inverse depth of a plane is affine in
// the pixel coordinates of a pinhole camera.
struct Problem {
    const uint8_t* grey;
    const uint8_t* valid;  // 0: the pixel is excluded; has no plane and no weight in windows.
    const Source* sources;
    int32_t width, height, num_sources;
    int32_t num_best;    // The cost is the mean of this number of lowest costs of sources.
    int32_t radius;      // Of the window, pixels; every second row and column is used.
    int32_t iterations;  // 0: the given planes get their costs alone.
    int32_t num_random;  // Random planes of each pixel before the first iteration.
    uint32_t seed;
    float sigma_color, sigma_space;  // Of the bilateral weights: grey levels, pixels.
    float fx, fy, cx, cy;
    float min_inverse_depth, max_inverse_depth;
    float pixel_step;  // Change of the inverse depth that moves a point by a pixel in a source.
    float min_cosine;  // Between normal and viewing direction.
    float first_step;  // Size of the first perturbation, pixels; halved in each iteration.
};

// Improves planes (3, H, W) (w, wx, wy; w = 0: none) in place, and writes their costs (H, W) in
// [0, 2]: 1 minus the weighted NCC. Pixels that are excluded or have no plane: w = 0, cost 2.
void patchmatch(const Problem* problem, float* planes, float* costs);
}
