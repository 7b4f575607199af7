// Backward of blend, front to back like forward. With e_i = dL/d(color) . rgb_i + dL/d(alpha)
// + dL/d(depth) z_i and S_i = sum_{j > i} w_j e_j, known from the finished pixel,
//
//     dL/d(alpha_i) = T_i e_i - S_i / (1 - alpha_i).
//
// A Gaussian's contribution in a tile is reduced to moments of v = alpha dL/d(alpha) =
// dL/d(ln alpha) over (u, w) (see Record), and written to its slot by the thread of the tile: one
// writer, and a fixed order of summation.

#include "blend.h"
#include "threads.h"
#include "tile.h"

namespace splat {
namespace {

constexpr int kSize = 16, kAbreast = kRegisterBytes == 64 ? 4 : 2;
constexpr int kSums = 12;  // of sum_lanes; the last are zero
static_assert(kMoments <= kSums);

// Gradients and compositing state of a block's pixels.
struct BlockTargets {
    Pixels rgb[3], alpha, depth;
    Pixels transmittance;  // 0 once stopped
    Pixels behind;         // S: starts as the whole sum, ends as 0

    // Pixels outside the image have zero gradients.
    SPLAT_INLINE void set(int block, const Tile& tile, const View& view,
                          const ImageGradientsIn& in) {
        Pixels color[3];
        tile.read(block, in.color, view.width, color);
        tile.read(block, in.d_color, view.width, rgb);
        // The weight of the background is 1 - alpha.
        Pixels under = {};
        behind = Pixels{};
        for (int c = 0; c < 3; c++) {
            under += rgb[c] * in.background[c];
            behind += color[c] * rgb[c];
        }
        alpha = -under;
        behind -= under;
        const auto plane = [&](const float* image) {
            Pixels values[1];
            tile.read(block, image, view.width, values);
            return values[0];
        };
        if (in.d_alpha) {
            const Pixels d_alpha = plane(in.d_alpha);
            alpha += d_alpha;
            behind += plane(in.alpha) * d_alpha;
        }
        if (in.d_depth) {
            depth = plane(in.d_depth);
            behind += plane(in.depth) * depth;
        }
        transmittance = tile.start(block);
    }
};

// The pairs of a batch, sorted by Gaussian, and their alphas: one flat list, because the end of a
// short loop over a Gaussian's blocks would often be mispredicted.
struct GaussianPairs {
    Pixels alpha[kSize * kBlocks + kAbreast];
    uint32_t pair[kSize * kBlocks + kBlocks];
    int first[kSize + 1];  // pair of each Gaussian, and the number of pairs

    SPLAT_INLINE void list(const Batch<kSize>& batch, uint32_t alive) {
        int count = 0;
        for (int n = 0; n < batch.count; n++) {
            first[n] = count;
            const uint32_t blocks = batch.gaussian[n].blocks & alive;
            count += list_bits<kBlocks, 1>(blocks, n * kBlocks, pair + count);
        }
        first[batch.count] = count;
        for (int k = 0; k < kAbreast; k++) pair[count + k] = batch.kNothing;
        for (int i = 0; i < count; i += kAbreast) {
            batch.alphas<kAbreast>(pair + i, alpha + i);
        }
    }
};

// Adds one Gaussian's moments over one block to the lanes.
template <bool kDepthGradient>
SPLAT_INLINE void backward_pair(const Batch<kSize>& batch, uint32_t pair, Pixels alpha,
                                BlockTargets& t, Pixels (&moments)[kSums]) {
    const auto& g = batch.of(pair);
    const Pixels u = batch.u(pair), w = batch.w(pair);
    const Step s(alpha, t.transmittance);
    t.transmittance = keep(s.drawn, s.after);
    Pixels e = t.alpha + t.rgb[0] * g.rgb[0] + t.rgb[1] * g.rgb[1] + t.rgb[2] * g.rgb[2];
    if (kDepthGradient) e += t.depth * g.depth;
    t.behind -= s.weight * e;
    const Pixels odds = quotient(alpha, 1.0f - alpha);
    // A clamped alpha has no gradient.
    const Pixels v = keep(s.drawn & (alpha < kAlphaMax), s.weight * e - odds * t.behind);
    const Pixels vu = v * u, vw = v * w;
    moments[kV] += v;
    moments[kVU] += vu;
    moments[kVW] += vw;
    moments[kVUU] += vu * u;
    moments[kVUW] += vu * w;
    moments[kVWW] += vw * w;
    for (int c = 0; c < 3; c++) moments[kRed + c] += s.weight * t.rgb[c];
    if (kDepthGradient) moments[kDepth] += s.weight * t.depth;
}

template <bool kDepthGradient>
void backward_tiles(const Record* records, const Pairs& pairs, const View& view,
                    const ImageGradientsIn& in, const int32_t* block_end, int threads,
                    float* slot_gradients) {
    const int64_t tiles = view.tiles();
    parallel_for(tiles, 4, threads, [&](int64_t index) {
        const int64_t begin = pairs.tile_begin[index], end = pairs.tile_begin[index + 1];
        if (begin == end) return;
        const Tile tile(index, view);
        BlockTargets targets[kBlocks];
        for (int block = 0; block < kBlocks; block++) targets[block].set(block, tile, view, in);
        const auto end_of_blocks = load<Signed<kBlocks>>(block_end + kBlocks * index);
        Batch<kSize> batch;
        GaussianPairs list;
        const auto slot = [&](uint32_t number) {
            return slot_gradients + int64_t(number) * kSlotFloats;
        };
        int64_t entry = begin;
        for (; entry < end; entry += batch.count) {
            const uint32_t alive = bits(gt(end_of_blocks, int32_t(entry - begin)));
            if (!alive) break;
            batch.fill(records, pairs.entries, entry, end, tile);
            for (int n = 0; n < batch.count; n++)
                __builtin_prefetch(slot(batch.gaussian[n].slot), 1);
            list.list(batch, alive);
            Ahead ahead(records, pairs, view, entry + batch.count, kSize);
            for (int n = 0; n < batch.count; n++) {
                ahead.fetch();
                Pixels moments[kSums] = {};
                for (int i = list.first[n]; i < list.first[n + 1]; i++)
                    backward_pair<kDepthGradient>(batch, list.pair[i], list.alpha[i],
                                                  targets[list.pair[i] % kBlocks], moments);
                store(slot(batch.gaussian[n].slot), sum_lanes(moments));
            }
        }
        for (; entry < end; entry++) store(slot(pairs.entries[entry].slot), f32x16{});
    });
}

}  // namespace

void blend_backward(const Record* records, const Pairs& pairs, const View& view,
                    const ImageGradientsIn& in, const int32_t* block_end, int threads,
                    float* slot_gradients) {
    const auto run = in.d_depth ? backward_tiles<true> : backward_tiles<false>;
    run(records, pairs, view, in, block_end, threads, slot_gradients);
}

}  // namespace splat
