#include "blend.h"

#include "tile.h"

namespace splat {
namespace {

struct ColorSum {
    f32x16 red[kBlocks] = {}, green[kBlocks] = {}, blue[kBlocks] = {};

    SPLAT_INLINE void add(int block, const TileGaussian& g, const Step& s, f32x16) {
        red[block] += s.weight * g.rgb[0];
        green[block] += s.weight * g.rgb[1];
        blue[block] += s.weight * g.rgb[2];
    }
};

struct DepthSum {
    f32x16 mean[kBlocks] = {}, median[kBlocks] = {};

    SPLAT_INLINE void add(int block, const TileGaussian& g, const Step& s, f32x16 before) {
        mean[block] += s.weight * g.depth;
        const Mask16 crossing = s.drawn & ge(before, splat16(0.5f)) & lt(s.after, splat16(0.5f));
        median[block] = select(crossing, splat16(g.depth), median[block]);
    }
};

// Composites one tile; returns the entry after the last one needed.
template <class Sum>
SPLAT_INLINE int64_t composite(const Record* records, const Pairs& pairs, int64_t index,
                               const Tile& tile, f32x16* transmittance, Sum& sum) {
    tile.start(transmittance);
    uint32_t alive = alive_blocks(transmittance);
    int64_t entry = pairs.tile_begin[index];
    const int64_t end = pairs.tile_begin[index + 1];
    Batch batch;
    while (entry < end && alive) {
        entry = batch.fill(records, pairs.entries, entry, end, tile, alive);
        for (int i = 0; i < batch.pairs(); i++) {
            const TileGaussian& g = batch.gaussian[batch.pair[i] / kBlocks];
            const int block = int(batch.pair[i] % kBlocks);
            const f32x16 before = transmittance[block];
            sum.add(block, g, step(batch.alpha[i], block, transmittance, alive), before);
        }
    }
    return entry;
}

}  // namespace

void blend(const Record* records, const Pairs& pairs, const View& view, const float* background,
           int threads, float* color, float* alpha, int64_t* tile_end) {
    const int64_t tiles = view.tiles();
#pragma omp parallel for num_threads(threads) schedule(dynamic, 4)
    for (int64_t index = 0; index < tiles; index++) {
        const Tile tile(index, view);
        f32x16 transmittance[kBlocks];
        ColorSum sum;
        tile_end[index] = composite(records, pairs, index, tile, transmittance, sum);
        for (int block = 0; block < kBlocks; block++) {
            const f32x16 left = abs(transmittance[block]);
            const f32x16 rgb[3] = {sum.red[block] + left * background[0],
                                   sum.green[block] + left * background[1],
                                   sum.blue[block] + left * background[2]};
            alignas(64) float pixels[3 * 16];
            interleave(rgb, pixels);
            tile.write<3>(block, pixels, view.width, color);
            store(pixels, 1.0f - left);
            tile.write<1>(block, pixels, view.width, alpha);
        }
    }
}

void blend_depth(const Record* records, const Pairs& pairs, const View& view, int threads,
                 float* depth, float* median) {
    const int64_t tiles = view.tiles();
#pragma omp parallel for num_threads(threads) schedule(dynamic, 4)
    for (int64_t index = 0; index < tiles; index++) {
        const Tile tile(index, view);
        f32x16 transmittance[kBlocks];
        DepthSum sum;
        composite(records, pairs, index, tile, transmittance, sum);
        for (int block = 0; block < kBlocks; block++) {
            alignas(64) float pixels[16];
            store(pixels, sum.mean[block]);
            tile.write<1>(block, pixels, view.width, depth);
            store(pixels, sum.median[block]);
            tile.write<1>(block, pixels, view.width, median);
        }
    }
}

}  // namespace splat
