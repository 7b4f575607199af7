// Constants of the rasterizer, with their reasons. reference.py repeats those of the method.
#pragma once

#include <cstdint>

#include "simd.h"

namespace splat {

// ---- The method (3D Gaussian Splatting, Kerbl et al. 2023, unless stated otherwise) ----

// Added to the 2D variances, in px^2: the paper's low-pass filter. No Gaussian is thinner than a
// pixel, so none falls between the samples.
constexpr double kDilation = 0.3;

// Contributions below one step of an 8-bit image are skipped; this also bounds the ellipse.
constexpr float kAlphaMin = 1.0f / 255.0f;
constexpr float kLog2AlphaMin = -7.994353436858858f;

// Bounds 1 / (1 - alpha) in backward at 1000. The paper has 0.99; with 0.999 a single Gaussian can
// be practically opaque.
constexpr float kAlphaMax = 0.999f;

// As in 3DGS, the Gaussian that would lower a pixel's transmittance below this is not drawn, and
// the pixel stops. What remains is below kTransmittanceMin / (1 - kAlphaMax) = 0.1, and usually
// near kTransmittanceMin, since few Gaussians are that opaque.
constexpr float kTransmittanceMin = 1e-4f;

// Squared norm below which a quaternion is invalid: its direction is lost in float32.
constexpr double kQuatNorm2Min = 1e-8;

// A Gaussian is drawn if its camera z is more than this many of its standard deviations along z, so
// that the ellipsoid of these is in front of the camera. The perspective image of others is no
// ellipse, and the linearised one can cover the view. benchmarks/projection.py measures the error.
constexpr double kMinDepthSigmas = 2.0;

// Lower bound of det(undilated) / det(dilated) in Mip-Splatting's square root, whose slope is
// infinite at 0. As in 3DGS, opacity is scaled by at least 0.005.
constexpr double kCompensationMin = 2.5e-5;

// ---- Safety ----

// Variances in px^2 above this count as overflow: their products overflow float32.
constexpr double kCovarianceMax = 1e30;

// SH coefficients above this count as overflow: below it, their sums and gradients are finite in
// float32.
constexpr float kShMax = 1e6f;

// Maximum number of (Gaussian, tile) pairs of a view: 1.6 GB of lists, 8.6 GB of gradient slots in
// backward.
constexpr int64_t kMaxIntersections = int64_t(1) << 27;

// ---- Layout ----

// A tile is 16 x 16 pixels in compact blocks, one vector each: more lanes of a block than of a row
// are inside a small ellipse. Blocks are 4 x 4 pixels with AVX-512, otherwise 4 x 2, whose sums
// stay in 16 registers.
constexpr int kTile = 16;
constexpr int kBlockColumns = 4, kBlockRows = kRegisterBytes == 64 ? 4 : 2;
constexpr int kBlockPixels = kBlockColumns * kBlockRows;
constexpr int kBlocks = kTile * kTile / kBlockPixels;
constexpr int kBlocksAcross = kTile / kBlockColumns, kBlocksDown = kTile / kBlockRows;

// Bounding boxes of Gaussians are in cells of 4 x 4 pixels.
constexpr int kCell = 4, kLog2Cell = 2;

// Tolerance of the ellipse-tile test, in log2(alpha). The blend kernel's error is below 3e-5 in
// this unit; the test must not exclude a Gaussian that the blend kernel would draw.
constexpr float kBinSlack = 1e-4f;

}  // namespace splat
