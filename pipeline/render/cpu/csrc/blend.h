// Stage 3: alpha compositing, front to back (Kerbl et al. 2023, eq. 3).
#pragma once

#include "types.h"

namespace splat {

struct Pairs {
    const Entry* entries;
    const int64_t* tile_begin;
};

// color (H, W, 3), over the background (3); alpha (H, W); block_end (tiles, kBlocks): number of the
// tile's entries after which no pixel of the block changes.
void blend(const Record* records, const Pairs& pairs, const View& view, const float* background,
           int threads, float* color, float* alpha, int32_t* block_end);

// depth (H, W) sum of weight * z; median (H, W) z at which the transmittance falls below 1/2, or 0.
void blend_depth(const Record* records, const Pairs& pairs, const View& view, int threads,
                 float* depth, float* median);

// Writes the gradient slots (intersections, kSlotFloats). d_alpha and d_depth may be null; depth is
// the output of blend_depth, needed with d_depth only.
struct ImageGradientsIn {
    const float *color, *alpha, *depth;        // outputs of forward
    const float *d_color, *d_alpha, *d_depth;  // their gradients
    const float* background;
};
void blend_backward(const Record* records, const Pairs& pairs, const View& view,
                    const ImageGradientsIn& in, const int32_t* block_end, int threads,
                    float* slot_gradients);

}  // namespace splat
