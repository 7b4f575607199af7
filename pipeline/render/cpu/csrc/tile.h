// Common parts of the forward and backward blending kernels: a tile's pixels, and Gaussians
// relative to it.
#pragma once

#include "blend.h"
#include "shuffle.h"
#include "simd_math.h"
#include "types.h"

namespace splat {

// A block's pixels: lane i is pixel (i % 4, i / 4) of a block, block i is (i % 4, i / 4) of a tile.
using Pixels = Vector<float, kBlockPixels>;
using PixelMask = Mask<float, kBlockPixels>;
alignas(64) constexpr float kColumnNumbers[16] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
alignas(64) constexpr float kRowNumbers[16] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
SPLAT_INLINE Pixels columns() { return load<Pixels>(kColumnNumbers); }
SPLAT_INLINE Pixels rows() { return load<Pixels>(kRowNumbers); }
static_assert(kBlockColumns == 4 && kBlockPixels <= 16);

#if !SPLAT_AVX512
// The positions of the bits of a byte, lowest first.
struct BitPlaces {
    uint8_t of[256][8];
    constexpr BitPlaces() : of() {
        for (int byte = 0; byte < 256; byte++)
            for (int bit = 0, n = 0; bit < 8; bit++)
                if (byte >> bit & 1) of[byte][n++] = uint8_t(bit);
    }
};
alignas(64) constexpr BitPlaces kBitPlaces;
#endif

// Writes base + kStep i for every set bit i of kBits, lowest first; returns their number. May write
// undefined values up to to[kBits - 1].
template <int kBits, uint32_t kStep>
SPLAT_INLINE int list_bits(uint32_t bits, uint32_t base, uint32_t* to) {
#if SPLAT_AVX512
    static_assert(kBits == 16);
    const u32x16 all = bit_cast<u32x16>(to_int(lane_numbers())) * kStep + base;
    _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(__mmask16(bits), (__m512i)all.lanes));
    return __builtin_popcount(bits);
#else
    int count = 0;
    for (int byte = 0; byte < kBits / 8; byte++, bits >>= 8) {
        Unsigned<8> places;
        native::widen_bytes(kBitPlaces.of[bits & 255], &places);
        store(to + count, places * kStep + (base + 8 * byte * kStep));
        count += __builtin_popcount(bits & 255);
    }
    return count;
#endif
}

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

    // Transmittance of a block before the first Gaussian: 1 inside the image, 0 outside.
    SPLAT_INLINE Pixels start(int block) const {
        const PixelMask inside =
            (splat::columns() < float(columns - kBlockColumns * (block % kBlocksAcross))) &
            (splat::rows() < float(rows - kBlockRows * (block / kBlocksAcross)));
        return keep(inside, broadcast<Pixels>(1.0f));
    }

    // Calls visit(row in the block, pixel in an image of this width, number of pixels) for each row
    // of a block inside the image.
    template <class Visit>
    SPLAT_INLINE void each_row(int block, int64_t width, const Visit& visit) const {
        const int left = kBlockColumns * (block % kBlocksAcross);
        const int top = kBlockRows * (block / kBlocksAcross);
        const int across = columns - left < kBlockColumns ? columns - left : kBlockColumns;
        const int down = rows - top < kBlockRows ? rows - top : kBlockRows;
        if (across > 0)
            for (int row = 0; row < down; row++)
                visit(row, (y + top + row) * width + x + left, across);
    }
    // Reads a block of an image with K floats per pixel, one vector per channel; zeros outside.
    template <int K>
    SPLAT_INLINE void read(int block, const float* image, int64_t width,
                           Pixels (&channels)[K]) const {
        PixelRows<kBlockRows, K> pixels;
        each_row(block, width,
                 [&](int row, int64_t pixel, int count) __attribute__((always_inline)) {
                     pixels.read(row, image + K * pixel, count);
                 });
        pixels.to_channels(channels);
    }
    // Prefetches a tile's cache lines of an image with K floats per pixel for writing.
    template <int K>
    SPLAT_INLINE void expect(int64_t width, const float* image) const {
        for (int row = 0; row < rows; row++)
            for (int line = 0; line < K; line++)
                __builtin_prefetch(image + K * ((y + row) * width + x) + 16 * line, 1);
    }
    template <int K>
    SPLAT_INLINE void write(int block, const Pixels (&channels)[K], int64_t width,
                            float* image) const {
        PixelRows<kBlockRows, K> pixels;
        pixels.from_channels(channels);
        each_row(block, width,
                 [&](int row, int64_t pixel, int count) __attribute__((always_inline)) {
                     pixels.write(row, image + K * pixel, count);
                 });
    }
};

// Prefetches the records of the next batch a few at a time: their addresses are scattered, and many
// requests at once would be queued.
class Ahead {
  public:
    // `count` entries from number `next` on: after a tile's entries follow those of the next tile.
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

// The next Gaussians of a tile, relative to it, and their (Gaussian, block) pairs, numbered
// kBlocks * position in the batch + block.
//
// log2(alpha) = log2_opacity - u^2 - w^2 (see Record), where u and w are those of a block's first
// pixel plus the offset of the pixel in the block. Those of the tile's first pixel are computed in
// float64, so that distant centres do not lose accuracy.
template <int kSize>
struct Batch {
    // w relative to a block's first pixel is stored for rows 0 and 1, where it is exact.
    static constexpr bool kKeepsDown = kBlockRows == 2;
    // One vector has a lane per block of a tile, and blocks are square: u of their first pixels is
    // u in a block, scaled.
    static constexpr bool kSquareBlocks = kBlocks == kBlockPixels && kBlockColumns == kBlockRows;
    struct Nothing {};
    using Down = std::conditional_t<kKeepsDown, Pixels, Nothing>;
    struct alignas(64) Gaussian {
        Pixels across;                   // u in a block, relative to its first pixel
        Down down;                       // the same for w
        float uu, uw, ww, log2_opacity;  // as in Record
        float rgb[3], depth;
        uint32_t slot, blocks;  // as in Entry
    };
    static constexpr uint32_t kNothing = kSize * kBlocks;  // padding: a pair that draws nothing

    int count;
    Gaussian gaussian[kSize + 1];
    alignas(64) float first_u[kNothing + kBlocks], first_w[kNothing + kBlocks];  // of each pair

    Batch() {
        gaussian[kSize] = Gaussian{};
        gaussian[kSize].log2_opacity = 2 * kLog2AlphaMin;
        std::memset(first_u + kNothing, 0, kBlocks * sizeof(float));
        std::memset(first_w + kNothing, 0, kBlocks * sizeof(float));
    }

    // Reads the Gaussians of entries [from, end).
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
            const Pixels across = columns() * r.uu + rows() * r.uw;
            g.across = across;
            if constexpr (kKeepsDown) g.down = rows() * r.ww;
            // Lanes are blocks here, arranged in a tile like pixels in a block.
            const float u = float(r.uu * dx + r.uw * dy), w = float(r.ww * dy);
            if constexpr (kSquareBlocks) {
                store(first_u + kBlocks * n, float(kBlockColumns) * across + u);
                store(first_w + kBlocks * n, float(kBlockRows) * rows() * r.ww + w);
            } else {
                const Pixels right = columns() * (float(kBlockColumns) * r.uu);
                for (int block = 0; block < kBlocks; block += kBlockPixels) {
                    const Pixels row = rows() + float(block / kBlocksAcross);
                    const int at = kBlocks * n + block;
                    store(first_u + at, right + row * (float(kBlockRows) * r.uw) + u);
                    store(first_w + at, row * (float(kBlockRows) * r.ww) + w);
                }
            }
        }
    }

    SPLAT_INLINE const Gaussian& of(uint32_t pair) const { return gaussian[pair / kBlocks]; }
    SPLAT_INLINE Pixels u(uint32_t pair) const { return of(pair).across + first_u[pair]; }
    SPLAT_INLINE Pixels w(uint32_t pair) const {
        if constexpr (kKeepsDown)
            return of(pair).down + first_w[pair];
        else
            return rows() * of(pair).ww + first_w[pair];
    }

    // The alphas of several pairs at once, since one alone is a chain of about fifty cycles; 0 if
    // below kAlphaMin.
    template <int kCount>
    SPLAT_INLINE void alphas(const uint32_t* pairs, Pixels* alpha) const {
        Pixels power[kCount], raw[kCount];
        for (int k = 0; k < kCount; k++) {
            const Pixels here_u = u(pairs[k]), here_w = w(pairs[k]);
            power[k] = of(pairs[k]).log2_opacity - here_u * here_u - here_w * here_w;
        }
        exp2(power, raw);
        // Undefined values of invisible lanes could be denormal, which is slow.
        for (int k = 0; k < kCount; k++)
            alpha[k] = keep(power[k] >= kLog2AlphaMin, min(raw[k], broadcast<Pixels>(kAlphaMax)));
    }
};

// Blending of one Gaussian over one block of pixels.
struct Step {
    Pixels after;     // transmittance after it, if it is drawn
    PixelMask drawn;  // contributes, or has an alpha of 0
    Pixels weight;    // transmittance before * alpha if drawn, otherwise 0

    SPLAT_INLINE Step(Pixels alpha, Pixels before) {
        after = minus_product(before, alpha, before);
        drawn = after >= kTransmittanceMin;
        weight = product(drawn, alpha, before);
    }
};

}  // namespace splat
