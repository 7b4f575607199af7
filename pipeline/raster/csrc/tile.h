// What the blending kernels, forward and backward, share: a tile's pixels and a Gaussian seen
// from it.
#pragma once

#include "blend.h"
#include "shuffle.h"
#include "types.h"

namespace splat {

// Lane i of a block is its pixel (i % 4, i / 4), block i of a tile its block (i % 4, i / 4):
// compact blocks, because more lanes of them lie inside a small ellipse than of a row of 16 pixels.
constexpr f32x16 kColumn = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
constexpr f32x16 kRow = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

// The pixels of one tile.
struct Tile {
    int64_t x, y;       // of the first pixel
    int columns, rows;  // inside the image

    Tile(int64_t index, const View& view) {
        const int64_t tiles_x = view.tiles_x();
        x = index % tiles_x * kTile;
        y = index / tiles_x * kTile;
        columns = int(view.width - x < kTile ? view.width - x : kTile);
        rows = int(view.height - y < kTile ? view.height - y : kTile);
    }

    // Transmittance of a block before the first Gaussian: 1 inside, 0 outside, where nothing draws.
    SPLAT_INLINE f32x16 start(int block) const {
        const Mask16 inside = lt(kColumn, splat16(float(columns - kBlock * (block % 4)))) &
                              lt(kRow, splat16(float(rows - kBlock * (block / 4))));
        return keep(inside, splat16(1));
    }

    // Calls visit(row in the block, pixel in an image of this width, number of pixels) for each of
    // a block's rows that the image has.
    template <class Visit>
    SPLAT_INLINE void each_row(int block, int64_t width, const Visit& visit) const {
        const int left = kBlock * (block % 4), top = kBlock * (block / 4);
        const int across = columns - left < kBlock ? columns - left : kBlock;
        const int down = rows - top < kBlock ? rows - top : kBlock;
        if (across > 0)
            for (int row = 0; row < down; row++)
                visit(row, (y + top + row) * width + x + left, across);
    }
    // A block of an image of K floats a pixel, a vector a channel; zeros outside it.
    template <int K>
    SPLAT_INLINE void read(int block, const float* image, int64_t width,
                           f32x16 (&channels)[K]) const {
        f32x16 pixels[kBlock] = {};
        each_row(block, width,
                 [&](int row, int64_t pixel, int count) __attribute__((always_inline)) {
                     pixels[row] = load_first(image + K * pixel, K * count);
                 });
        to_channels(pixels, channels);
    }
    // Asks for a tile's lines of an image of K floats a pixel that will be written: rows lie far
    // apart, and each line that is written would wait for its first bytes.
    template <int K>
    SPLAT_INLINE void expect(int64_t width, const float* image) const {
        for (int row = 0; row < rows; row++)
            for (int line = 0; line < K; line++)
                __builtin_prefetch(image + K * ((y + row) * width + x) + 16 * line, 1);
    }
    template <int K>
    SPLAT_INLINE void write(int block, const f32x16 (&channels)[K], int64_t width,
                            float* image) const {
        f32x16 pixels[kBlock];
        to_rows(channels, pixels);
        each_row(block, width,
                 [&](int row, int64_t pixel, int count) __attribute__((always_inline)) {
                     store_first(image + K * pixel, pixels[row], K * count);
                 });
    }
};

// Asks for the next batch's records a few at a time between other work: they are met in no order,
// and many at once would wait for each other.
class Ahead {
  public:
    // Of the `count` entries from number `next` of all on: past the end of a tile lies another.
    SPLAT_INLINE Ahead(const Record* records, const Pairs& pairs, const View& view, int64_t next,
                       int64_t count)
        : records_(records), next_(pairs.entries + next) {
        const int64_t left = pairs.tile_begin[view.tiles()] - next;
        end_ = next_ + (left < count ? left : count);
    }

    SPLAT_INLINE void fetch() {
        if (next_ < end_) __builtin_prefetch(records_ + (next_++)->gaussian);
    }

  private:
    const Record* records_;
    const Entry *next_, *end_;
};

// The next Gaussians of a tile, as seen from it, and (Gaussian, block) pairs of them, numbered
// 16 * place in the batch + block.
//
// log2(alpha) = log2_opacity - u^2 - w^2 (see Record), where u and w are those of a block's first
// pixel plus what a pixel's place in the block adds. The tile's first pixel's are found in
// float64, so that a centre a thousand pixels away costs no digits.
template <int kSize>
struct Batch {
    struct alignas(64) Gaussian {
        f32x16 across;                   // u in a block, less its first pixel's
        float uu, uw, ww, log2_opacity;  // as in the Record
        float rgb[3], depth;
        uint32_t slot, blocks;  // as in the Entry
    };
    static constexpr uint32_t kNothing = kSize * kBlocks;  // a pair that draws nothing, to fill up

    int count;
    Gaussian gaussian[kSize + 1];
    alignas(64) float first_u[kNothing + kBlocks], first_w[kNothing + kBlocks];  // of each pair

    Batch() {
        gaussian[kSize] = Gaussian{};
        gaussian[kSize].log2_opacity = 2 * kLog2AlphaMin;
        std::memset(first_u + kNothing, 0, kBlocks * sizeof(float));
        std::memset(first_w + kNothing, 0, kBlocks * sizeof(float));
    }

    // Takes them from entries [from, end).
    SPLAT_INLINE void fill(const Record* records, const Entry* entries, int64_t from, int64_t end,
                           const Tile& tile) {
        count = int(end - from < kSize ? end - from : kSize);
        for (int n = 0; n < count; n++) {
            const Entry& e = entries[from + n];
            const Record& r = records[e.gaussian];
            const double dx = double(tile.x) + 0.5 - r.x, dy = double(tile.y) + 0.5 - r.y;
            Gaussian& g = gaussian[n];
            std::memcpy(&g.uu, &r.uu, 8 * sizeof(float));
            g.slot = e.slot;
            g.blocks = e.blocks;
            const f32x16 across = kColumn * r.uu + kRow * r.uw;
            g.across = across;
            // Blocks lie in a tile as pixels do in a block.
            store(first_u + kBlocks * n, float(kBlock) * across + float(r.uu * dx + r.uw * dy));
            store(first_w + kBlocks * n, float(kBlock) * kRow * r.ww + float(r.ww * dy));
        }
    }

    SPLAT_INLINE const Gaussian& of(uint32_t pair) const { return gaussian[pair / kBlocks]; }
    SPLAT_INLINE f32x16 u(uint32_t pair) const { return of(pair).across + first_u[pair]; }
    SPLAT_INLINE f32x16 w(uint32_t pair) const { return kRow * of(pair).ww + first_w[pair]; }

    // The alphas of some pairs at once, because one alone is a chain of some fifty cycles; 0 where
    // less than kAlphaMin.
    template <int kCount>
    SPLAT_INLINE void alphas(const uint32_t* pairs, f32x16 (&alpha)[kCount]) const {
        f32x16 power[kCount], raw[kCount];
        for (int k = 0; k < kCount; k++) {
            const f32x16 here_u = u(pairs[k]), here_w = w(pairs[k]);
            power[k] = of(pairs[k]).log2_opacity - here_u * here_u - here_w * here_w;
        }
        exp2(power, raw);
        // Junk where nothing is seen could be denormal, which costs a hundred cycles.
        for (int k = 0; k < kCount; k++)
            alpha[k] = keep(ge(power[k], splat16(kLog2AlphaMin)), min(raw[k], splat16(kAlphaMax)));
    }
};

// The blending of one Gaussian over one block of pixels.
struct Step {
    f32x16 after;   // transmittance behind it, if it is drawn
    Mask16 drawn;   // contributes, or has an alpha of 0
    f32x16 weight;  // transmittance before * alpha where drawn, else 0

    SPLAT_INLINE Step(f32x16 alpha, f32x16 before) {
        after = before - alpha * before;
        drawn = ge(after, splat16(kTransmittanceMin));
        weight = product(drawn, alpha, before);
    }
};

}  // namespace splat
