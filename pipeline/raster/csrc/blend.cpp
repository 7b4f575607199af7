#include "blend.h"

#include "tile.h"

namespace splat {
namespace {

struct ColorSum {
    f32x16 red[kTile] = {}, green[kTile] = {}, blue[kTile] = {};

    SPLAT_INLINE void add(int row, const Record& g, const Step& s, f32x16) {
        red[row] += s.weight * g.rgb[0];
        green[row] += s.weight * g.rgb[1];
        blue[row] += s.weight * g.rgb[2];
    }
};

struct DepthSum {
    f32x16 mean[kTile] = {}, median[kTile] = {};

    SPLAT_INLINE void add(int row, const Record& g, const Step& s, f32x16 before) {
        mean[row] += s.weight * g.depth;
        const Mask16 crossing = s.drawn & ge(before, splat16(0.5f)) & lt(s.after, splat16(0.5f));
        median[row] = select(crossing, splat16(g.depth), median[row]);
    }
};

// Composites one tile; returns the entry after the last one needed.
template <class Sum>
SPLAT_INLINE int64_t composite(const Record* records, const Pairs& pairs, int64_t index,
                               const Tile& tile, f32x16* transmittance, Sum& sum) {
    tile.start(transmittance);
    int alive = tile.columns * tile.rows;
    return each_gaussian(
        records, pairs.entries, pairs.tile_begin[index], pairs.tile_begin[index + 1], tile,
        [](const Entry&) {},
        [&](const TileGaussian& here) __attribute__((always_inline)) {
            const Record& g = *here.record;
            const int last = here.last_row();
            for (int row = here.first_row(); row <= last; row++) {
                const f32x16 before = transmittance[row];
                const Step s = step(here.power(row, here.u_row(row)), before);
                Mask16 stopped;
                transmittance[row] = advance(s, before, stopped);
                if (__builtin_expect(any(stopped), 0)) alive -= __builtin_popcount(bits(stopped));
                sum.add(row, g, s, before);
            }
            return alive > 0;
        });
}

// Writes the part of a row inside the image.
SPLAT_INLINE void write_row(f32x16 v, const Tile& tile, int row, int64_t width, float* image) {
    alignas(64) float lanes[kTile];
    store(lanes, v);
    float* to = image + (tile.y + row) * width + tile.x;
    for (int i = 0; i < tile.columns; i++) to[i] = lanes[i];
}

}  // namespace

void blend(const Record* records, const Pairs& pairs, const View& view, const float* background,
           int threads, float* color, float* alpha, int64_t* tile_end) {
    const int64_t tiles = view.tiles();
#pragma omp parallel for num_threads(threads) schedule(dynamic, 4)
    for (int64_t index = 0; index < tiles; index++) {
        const Tile tile(index, view);
        f32x16 transmittance[kTile];
        ColorSum sum;
        tile_end[index] = composite(records, pairs, index, tile, transmittance, sum);
        for (int row = 0; row < tile.rows; row++) {
            const f32x16 left = abs(transmittance[row]);
            alignas(64) float rgb[3][kTile];
            store(rgb[0], sum.red[row] + left * background[0]);
            store(rgb[1], sum.green[row] + left * background[1]);
            store(rgb[2], sum.blue[row] + left * background[2]);
            float* to = color + 3 * ((tile.y + row) * view.width + tile.x);
            for (int i = 0; i < tile.columns; i++)
                for (int c = 0; c < 3; c++) to[3 * i + c] = rgb[c][i];
            write_row(1.0f - left, tile, row, view.width, alpha);
        }
    }
}

void blend_depth(const Record* records, const Pairs& pairs, const View& view, int threads,
                 float* depth, float* median) {
    const int64_t tiles = view.tiles();
#pragma omp parallel for num_threads(threads) schedule(dynamic, 4)
    for (int64_t index = 0; index < tiles; index++) {
        const Tile tile(index, view);
        f32x16 transmittance[kTile];
        DepthSum sum;
        composite(records, pairs, index, tile, transmittance, sum);
        for (int row = 0; row < tile.rows; row++) {
            write_row(sum.mean[row], tile, row, view.width, depth);
            write_row(sum.median[row], tile, row, view.width, median);
        }
    }
}

}  // namespace splat
