// What the blending kernels, forward and backward, share: a tile's pixels and a Gaussian seen
// from it.
#pragma once

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

    // Transmittance before the first Gaussian: 1 inside, a stopped pixel's outside.
    SPLAT_INLINE void start(f32x16* transmittance) const {
        for (int block = 0; block < kBlocks; block++) {
            const Mask16 inside = lt(kColumn, splat16(float(columns - kBlock * (block % 4)))) &
                                  lt(kRow, splat16(float(rows - kBlock * (block / 4))));
            transmittance[block] = select(inside, splat16(1), splat16(-1));
        }
    }

    // Calls visit(row in the block, pixel in an image of this width, number of pixels) for each of
    // a block's rows that the image has.
    template <class Visit>
    SPLAT_INLINE void each_row(int block, int64_t width, const Visit& visit) const {
        const int left = kBlock * (block % 4), top = kBlock * (block / 4);
        const int across = columns - left < kBlock ? columns - left : kBlock;
        const int down = rows - top < kBlock ? rows - top : kBlock;
        if (across == kBlock)  // a constant, for the compiler
            for (int row = 0; row < down; row++)
                visit(row, (y + top + row) * width + x + left, kBlock);
        else if (across > 0)
            for (int row = 0; row < down; row++)
                visit(row, (y + top + row) * width + x + left, across);
    }
    // A block of an image of `kChannels` floats a pixel; zeros outside it.
    template <int kChannels>
    SPLAT_INLINE void read(int block, const float* image, int64_t width, float* pixels) const {
        std::memset(pixels, 0, kChannels * 16 * sizeof(float));
        each_row(block, width,
                 [&](int row, int64_t pixel, int count) __attribute__((always_inline)) {
                     std::memcpy(pixels + kChannels * kBlock * row, image + kChannels * pixel,
                                 kChannels * count * sizeof(float));
                 });
    }
    template <int kChannels>
    SPLAT_INLINE void write(int block, const float* pixels, int64_t width, float* image) const {
        each_row(block, width,
                 [&](int row, int64_t pixel, int count) __attribute__((always_inline)) {
                     std::memcpy(image + kChannels * pixel, pixels + kChannels * kBlock * row,
                                 kChannels * count * sizeof(float));
                 });
    }
};

// log2(alpha) of a Gaussian over a tile: log2_opacity - u^2 - w^2, where u and w are those of the
// first block plus what a block's place adds. The origin's are found in float64, so that a centre
// a thousand pixels away costs no digits.
struct alignas(64) TileGaussian {
    f32x16 u, w;
    float u_step[kBlocks], w_step[kBlocks];
    float uu, uw, ww, log2_opacity;  // as in the Record
    float rgb[3], depth;
    uint32_t slot;

    SPLAT_INLINE void set(const Record& g, uint32_t slot_, const Tile& tile) {
        const double dx = double(tile.x) + 0.5 - g.x, dy = double(tile.y) + 0.5 - g.y;
        const f32x16 across = kColumn * g.uu + kRow * g.uw, down = kRow * g.ww;
        u = float(g.uu * dx + g.uw * dy) + across;
        w = float(g.ww * dy) + down;
        store(u_step, float(kBlock) * across);  // blocks lie in a tile as pixels do in a block
        store(w_step, float(kBlock) * down);
        std::memcpy(&uu, &g.uu, 8 * sizeof(float));
        slot = slot_;
    }
    SPLAT_INLINE f32x16 u_at(int block) const { return u + u_step[block]; }
    SPLAT_INLINE f32x16 w_at(int block) const { return w + w_step[block]; }
    SPLAT_INLINE f32x16 power(f32x16 u_here, f32x16 w_here) const {
        return log2_opacity - u_here * u_here - w_here * w_here;
    }
};

// Some Gaussians of a tile, and their (Gaussian, block) pairs in order: one flat list, because the
// end of a short loop over a Gaussian's blocks would be mispredicted as often as not.
struct Batch {
    static constexpr int kSize = 16, kAbreast = 4;
    TileGaussian gaussian[kSize];
    f32x16 alpha[kSize * kBlocks + kAbreast];   // of a pair; 0 where less than kAlphaMin
    uint32_t pair[kSize * kBlocks + kAbreast];  // number in the batch * 16 + block
    int first[kSize + 1];                       // pair of each Gaussian, and the number of pairs
    int count;

    SPLAT_INLINE int pairs() const { return first[count]; }

    // Fills the batch from entries [from, end), looking at `alive` blocks only; returns the entry
    // after the last one taken.
    SPLAT_INLINE int64_t fill(const Record* records, const Entry* entries, int64_t from,
                              int64_t end, const Tile& tile, uint32_t alive) {
        constexpr int64_t kAhead = 16;
        count = 0;
        int pairs = 0;
        const int64_t stop = end - from < kSize ? end : from + kSize;
        for (int64_t e = from; e < stop; e++) {
            if (e + kAhead < end) __builtin_prefetch(records + entries[e + kAhead].gaussian);
            gaussian[count].set(records[entries[e].gaussian], entries[e].slot, tile);
            first[count] = pairs;
            pairs += list_bits(entries[e].blocks & alive, count * kBlocks, pair + pairs);
            count++;
        }
        first[count] = pairs;
        for (int i = 0; i < kAbreast; i++) pair[pairs + i] = 0;
        // Some at once: one alone is a chain of some fifty cycles, and few fit into the
        // processor's window.
        for (int i = 0; i < pairs; i += kAbreast) {
            f32x16 power[kAbreast];
            for (int k = 0; k < kAbreast; k++) {
                const TileGaussian& g = gaussian[pair[i + k] / kBlocks];
                const int block = int(pair[i + k] % kBlocks);
                power[k] = g.power(g.u_at(block), g.w_at(block));
            }
            f32x16 raw[kAbreast];
            exp2(power, raw);
            // Zero where nothing is seen: junk there could be denormal, which costs a hundred
            // cycles.
            for (int k = 0; k < kAbreast; k++)
                alpha[i + k] =
                    keep(ge(power[k], splat16(kLog2AlphaMin)), min(raw[k], splat16(kAlphaMax)));
        }
        return stop;
    }
};

// The blending of one Gaussian over one block of pixels.
struct Step {
    Mask16 drawn;   // contributes
    f32x16 weight;  // transmittance before * alpha where drawn, else 0
    f32x16 after;   // transmittance after, where drawn
};

// Takes a block's transmittance one Gaussian further. A stopped pixel has its transmittance's sign
// turned: its next one is negative too, under the minimum, so it never draws again. A block whose
// last pixel stops leaves `alive`.
SPLAT_INLINE Step step(f32x16 alpha, int block, f32x16* transmittance, uint32_t& alive) {
    Step s;
    const f32x16 before = transmittance[block], zero = {};
    const f32x16 weight = alpha * before;
    s.after = before - weight;
    const Mask16 visible = lt(zero, alpha);
    s.drawn = visible & ge(s.after, splat16(kTransmittanceMin));
    s.weight = keep(s.drawn, weight);
    f32x16 next = select(s.drawn, s.after, before);
    const Mask16 stopped = and_not(visible, s.drawn) & lt(zero, before);
    if (__builtin_expect(any(stopped), 0)) {
        next = negate_where(stopped, next);
        if (!any(lt(zero, next))) alive &= ~(1u << block);
    }
    transmittance[block] = next;
    return s;
}

// The blocks that have a pixel to draw.
SPLAT_INLINE uint32_t alive_blocks(const f32x16* transmittance) {
    uint32_t alive = 0;
    for (int block = 0; block < kBlocks; block++)
        alive |= uint32_t(any(lt(splat16(0), transmittance[block]))) << block;
    return alive;
}

}  // namespace splat
