// Stage 3: alpha compositing, front to back (Kerbl et al. 2023, eq. 3).
#pragma once

#include "types.h"

namespace splat {

struct Pairs {
    const Entry* entries;
    const int64_t* tile_begin;
};

// color (H, W, 3) with the background (3) under it; alpha (H, W); block_end (tiles, kBlocks): the
// number of the tile's entries behind which no pixel of the block draws.
void blend(const Record* records, const Pairs& pairs, const View& view, const float* background,
           int threads, float* color, float* alpha, int32_t* block_end);

// depth (H, W) sum of weight * z; median (H, W) z where the transmittance falls below 1/2, else 0.
void blend_depth(const Record* records, const Pairs& pairs, const View& view, int threads,
                 float* depth, float* median);

// The gradient slots (intersections, kSlotFloats). d_alpha and d_depth may be null; depth is
// blend_depth's, needed with d_depth only. Absolute moments are filled in if asked for. A pixel's
// gradients go to the per_pixel Gaussians that it draws first; 0: to all.
struct ImageGradientsIn {
    const float *color, *alpha, *depth;        // what forward made
    const float *d_color, *d_alpha, *d_depth;  // dL/d of it
    const float* background;
    bool absolute;
    int64_t per_pixel;
};
void blend_backward(const Record* records, const Pairs& pairs, const View& view,
                    const ImageGradientsIn& in, const int32_t* block_end, int threads,
                    float* slot_gradients);

}  // namespace splat
