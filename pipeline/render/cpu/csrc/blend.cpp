#include "blend.h"

#include <algorithm>

#include "threads.h"
#include "tile.h"

namespace splat {
namespace {

constexpr int kSize = 64, kAbreast = 4;
// Number of alphas computed before compositing; all of a batch if there are 16 registers. A single
// loop that computes and composites exceeds the reorder window, so that latencies add up.
constexpr int kAlphas = kRegisterBytes == 64 ? kAbreast : kSize;
using Gaussian = Batch<kSize>::Gaussian;

// Sums of a block's pixels.
struct Color {
    Pixels rgb[3] = {};

    SPLAT_INLINE void add(const Gaussian& g, const Step& s, Pixels) {
        for (int c = 0; c < 3; c++) rgb[c] += s.weight * g.rgb[c];
    }
};

struct Depth {
    Pixels mean = {}, median = {};

    SPLAT_INLINE void add(const Gaussian& g, const Step& s, Pixels before) {
        mean += s.weight * g.depth;
        const PixelMask crossing = s.drawn & (before >= 0.5f) & (s.after < 0.5f);
        median = select(crossing, broadcast<Pixels>(g.depth), median);
    }
};

// Lists a block's pairs of a batch in order, followed by kNothing; returns their number.
SPLAT_INLINE int list_pairs(const u32x16* blocks, int batch, int block, uint32_t* pair) {
    int count = 0;
    for (int n = 0; n < batch; n += 16) {
        const uint32_t near = bits(has_bit(blocks[n / 16], block));
        count += list_bits<16, kBlocks>(near, n * kBlocks + block, pair + count);
    }
    for (int k = 0; k < kAbreast; k++) pair[count + k] = Batch<kSize>::kNothing;
    return count;
}

// Composites one tile, batch by batch and block by block, so that a block's pixels stay in
// registers. transmittance (kBlocks): after all Gaussians. block_end (kBlocks): number of entries
// until the last of a block's pixels stops, or of all entries.
template <class Sum>
SPLAT_INLINE void composite(const Record* records, const Pairs& pairs, const View& view,
                            int64_t index, const Tile& tile, Pixels* transmittance, Sum* sums,
                            int32_t* block_end) {
    const int64_t begin = pairs.tile_begin[index], end = pairs.tile_begin[index + 1];
    Pixels going[kBlocks];  // transmittance of pixels that have not stopped, otherwise 0
    uint32_t alive = 0;
    for (int block = 0; block < kBlocks; block++) {
        going[block] = tile.start(block);
        transmittance[block] = broadcast<Pixels>(1.0f);
        const bool inside = any(going[block] > 0.0f);
        alive |= uint32_t(inside) << block;
        block_end[block] = inside ? int32_t(end - begin) : 0;
    }
    Batch<kSize> batch;
    for (int64_t entry = begin; entry < end && alive; entry += batch.count) {
        batch.fill(records, pairs.entries, entry, end, tile);
        alignas(64) uint32_t near[kSize] = {};
        for (int n = 0; n < batch.count; n++) near[n] = batch.gaussian[n].blocks;
        u32x16 blocks[kSize / 16];
        for (int n = 0; n < kSize; n += 16) blocks[n / 16] = load<u32x16>(near + n);
        Ahead ahead(records, pairs, view, entry + batch.count, kSize);
        for (uint32_t left = alive; left; left &= left - 1) {
            for (int k = 0; k < (kSize + kBlocks - 1) / kBlocks; k++) ahead.fetch();
            const int block = __builtin_ctz(left);
            uint32_t pair[kSize + 16];
            const int count = list_pairs(blocks, batch.count, block, pair);
            Pixels before = going[block], behind = transmittance[block];
            Sum sum = sums[block];
            Pixels alpha[kAlphas];
            for (int i = 0; i < count; i += kAbreast) {
                if constexpr (kAlphas == kAbreast) {  // no loop that the compiler would keep
                    batch.alphas<kAbreast>(pair + i, alpha);
                } else if (i % kAlphas == 0) {
                    for (int next = i; next < std::min(count, i + kAlphas); next += kAbreast)
                        batch.alphas<kAbreast>(pair + next, alpha + next - i);
                }
                for (int k = 0; k < kAbreast; k++) {
                    const Step s(alpha[i % kAlphas + k], before);
                    sum.add(batch.of(pair[i + k]), s, before);
                    behind = select(s.drawn, s.after, behind);
                    before = s.after;
                }
                // A stopped pixel stays at 0; its transmittance would become denormal.
                const PixelMask still = before >= kTransmittanceMin;
                before = keep(still, before);
                if (!any(still)) {
                    alive &= ~(1u << block);
                    const uint32_t last = pair[std::min(i + kAbreast, count) - 1];
                    block_end[block] = int32_t(entry - begin + last / kBlocks) + 1;
                    break;
                }
            }
            going[block] = before;
            transmittance[block] = behind;
            sums[block] = sum;
        }
    }
}

}  // namespace

void blend(const Record* records, const Pairs& pairs, const View& view, const float* background,
           int threads, float* color, float* alpha, int32_t* block_end) {
    const int64_t tiles = view.tiles();
    parallel_for(tiles, 4, threads, [&](int64_t index) {
        const Tile tile(index, view);
        tile.expect<3>(view.width, color);
        tile.expect<1>(view.width, alpha);
        Pixels transmittance[kBlocks];
        Color sums[kBlocks];
        composite(records, pairs, view, index, tile, transmittance, sums,
                  block_end + kBlocks * index);
        for (int block = 0; block < kBlocks; block++) {
            const Pixels left = transmittance[block];
            Pixels rgb[3];
            for (int c = 0; c < 3; c++) rgb[c] = sums[block].rgb[c] + left * background[c];
            tile.write(block, rgb, view.width, color);
            const Pixels covered[1] = {1.0f - left};
            tile.write(block, covered, view.width, alpha);
        }
    });
}

void blend_depth(const Record* records, const Pairs& pairs, const View& view, int threads,
                 float* depth, float* median) {
    const int64_t tiles = view.tiles();
    parallel_for(tiles, 4, threads, [&](int64_t index) {
        const Tile tile(index, view);
        tile.expect<1>(view.width, depth);
        tile.expect<1>(view.width, median);
        Pixels transmittance[kBlocks];
        Depth sums[kBlocks];
        int32_t block_end[kBlocks];
        composite(records, pairs, view, index, tile, transmittance, sums, block_end);
        for (int block = 0; block < kBlocks; block++) {
            const Pixels mean[1] = {sums[block].mean}, middle[1] = {sums[block].median};
            tile.write(block, mean, view.width, depth);
            tile.write(block, middle, view.width, median);
        }
    });
}

}  // namespace splat
