// Data that is passed between the stages.
#pragma once

#include <cstdint>

#include "constants.h"

namespace splat {

// Parameters of a camera's gradients: rotation and translation of the scene in its frame, focal
// lengths, principal point.
constexpr int kCameraParameters = 10;

// A pinhole camera. Pixel centres are at half integers; x right, y down, z forward.
struct View {
    int64_t width, height;
    double fx, fy, cx, cy;
    double rotation[9], translation[3];  // world to camera, row major
    double near;
    double min_u, max_u, min_v, max_v;  // between which the Jacobian clamps x / z and y / z
    bool antialias;
    int sh_degree;
    bool clamp_color_gradient = false;  // a colour clamped to 0 has no gradient at all (3DGS)

    int64_t tiles_x() const { return (width + kTile - 1) / kTile; }
    int64_t tiles_y() const { return (height + kTile - 1) / kTile; }
    int64_t tiles() const { return tiles_x() * tiles_y(); }
};

// N Gaussians: means (N,3), log_scales (N,3), quats (N,4) wxyz, opacity_logits (N), sh (N,K,3).
struct Gaussians {
    int64_t count, sh_coefficients;
    const float *means, *log_scales, *quats, *opacity_logits, *sh;
};

// A projected Gaussian, one cache line. With d the vector from its centre in pixels,
//
//     log2(alpha) = log2_opacity - u^2 - w^2,  u = uu d_x + uw d_y,  w = ww d_y.
//
// [uu 0; uw ww] is the Cholesky factor of log2(e)/2 times the inverse covariance. u and w are at
// most 2.83 inside the ellipse, so that thin, long Gaussians do not suffer the cancellation of
// a dx^2 + 2 b dx dy + c dy^2. The centre is in float64: rounding to float32 would change colours
// by up to 1e-5.
struct alignas(64) Record {
    double x, y;
    float uu, uw, ww, log2_opacity;
    float rgb[3], depth;
    // The bounding box of {alpha >= 1/255} inside the image, in cells of 4 x 4 pixels; inclusive
    uint16_t cell_left, cell_top, cell_right, cell_bottom;
    float unused[2];
};
static_assert(sizeof(Record) == 64);

// One (Gaussian, tile) pair. Slots number the pairs in order of Gaussians' indices: the pairs of a
// Gaussian are contiguous.
struct Entry {
    uint32_t gaussian, slot;
    uint32_t blocks;  // bit i: may overlap block i of the tile
};
static_assert(sizeof(Entry) == 12);

// The slots of a Gaussian: first and count.
struct Slots {
    uint32_t first, count;
};

// One slot of gradients: sums over the pixels of a tile, in the lanes of sum_lanes (shuffle.h). v
// is dL/d(ln alpha) of a pixel.
enum Moment { kV, kVU, kVW, kVUU, kVUW, kVWW, kRed, kGreen, kBlue, kDepth, kMoments };
constexpr int kSlotFloats = 16;

}  // namespace splat
