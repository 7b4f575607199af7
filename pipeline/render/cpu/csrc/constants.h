// Every number the rasterizer decides by, with its reason. twin.py repeats those of the method.
#pragma once

#include <cstdint>

#include "simd.h"

namespace splat {

// ---- The method (3D Gaussian Splatting, Kerbl et al. 2023, unless said otherwise) ----

// Added to the 2D variances, in px^2: no Gaussian is thinner than a pixel, so none slips between
// the samples. The paper's low-pass filter.
constexpr double kDilation = 0.3;

// Below one step of an 8-bit image a contribution cannot be seen; it also ends the ellipse.
constexpr float kAlphaMin = 1.0f / 255.0f;
constexpr float kLog2AlphaMin = -7.994353436858858f;

// Bounds 1 / (1 - alpha) in backward at 1000. The paper says 0.99; 0.999 lets one Gaussian cover.
constexpr float kAlphaMax = 0.999f;

// A pixel stops before its transmittance falls below this: what lies behind adds under 1/8 of an
// 8-bit step in all.
constexpr float kTransmittanceMin = 1e-4f;

// The projection's Jacobian is taken no further out than the image plus this share of
// tan(fov / 2) on each side: beyond, its first order overstretches Gaussians.
constexpr double kFrustumMargin = 0.3;

// Squared norm under which a quaternion has no direction left in float32.
constexpr double kQuatNorm2Min = 1e-8;

// Floor of det(plain) / det(dilated) under Mip-Splatting's square root, whose slope is infinite
// at 0. 3DGS's: opacity is scaled by no less than 0.005.
constexpr double kCompensationMin = 2.5e-5;

// ---- Safety ----

// Variances in px^2 beyond this are taken for overflow: their products leave float32.
constexpr double kCovarianceMax = 1e30;

// Spherical harmonics coefficients beyond this are taken for overflow: sums of them, and their
// gradients, stay finite in float32.
constexpr float kShMax = 1e6f;

// Most (Gaussian, tile) pairs of one view: 1.6 GB of lists, 8.6 GB of gradient slots in backward.
constexpr int64_t kMaxIntersections = int64_t(1) << 27;

// ---- Layout ----

// A tile is 16 x 16 pixels in compact blocks, because more lanes of them lie inside a small ellipse
// than of a row: of 4 x 4 pixels with AVX-512, and of 4 x 2, whose sums stay in 16 registers,
// elsewhere. A block is one vector.
constexpr int kTile = 16;
constexpr int kBlockColumns = 4, kBlockRows = kRegisterBytes == 64 ? 4 : 2;
constexpr int kBlockPixels = kBlockColumns * kBlockRows;
constexpr int kBlocks = kTile * kTile / kBlockPixels;
constexpr int kBlocksAcross = kTile / kBlockColumns, kBlocksDown = kTile / kBlockRows;

// Boxes of Gaussians are kept in cells of 4 x 4 pixels.
constexpr int kCell = 4, kLog2Cell = 2;

// Slack of the ellipse-tile test, in log2(alpha). The blend kernel decides pixel by pixel and
// errs by under 3e-5 in this unit; the test must never leave out what it would draw.
constexpr float kBinSlack = 1e-4f;

}  // namespace splat
