// Backward of blend, front to back like forward. With e_i = dL/d(color) . rgb_i + dL/d(alpha)
// + dL/d(depth) z_i and S_i = sum_{j > i} w_j e_j, known from the finished pixel,
//
//     dL/d(alpha_i) = T_i e_i - S_i / (1 - alpha_i).
//
// A Gaussian's share of a tile is reduced to moments of v = alpha dL/d(alpha) = dL/d(ln alpha)
// over (u, w) (see Record), and written to its slot by whoever does the tile: no two writers, and
// a sum whose order is fixed.

#include "blend.h"
#include "tile.h"

namespace splat {
namespace {

// What a tile's pixels ask for, and where they have come to.
struct TileTargets {
    f32x16 red[kBlocks], green[kBlocks], blue[kBlocks], alpha[kBlocks], depth[kBlocks];
    f32x16 transmittance[kBlocks];
    f32x16 behind[kBlocks];  // S: starts as the whole sum, ends as 0

    // Pixels outside the image ask for nothing.
    TileTargets(const Tile& tile, const View& view, const ImageGradientsIn& in) {
        alignas(64) float pixels[3 * 16];
        const auto plane = [&](int block, const float* image) {
            tile.read<1>(block, image, view.width, pixels);
            return load<f32x16>(pixels);
        };
        const auto rgb = [&](int block, const float* image, f32x16(&to)[3]) {
            tile.read<3>(block, image, view.width, pixels);
            deinterleave(pixels, to);
        };
        const float* background = in.background;
        for (int block = 0; block < kBlocks; block++) {
            f32x16 c[3], d[3];
            rgb(block, in.color, c);
            rgb(block, in.d_color, d);
            // The background shows through 1 - alpha.
            const f32x16 under = d[0] * background[0] + d[1] * background[1] + d[2] * background[2];
            red[block] = d[0];
            green[block] = d[1];
            blue[block] = d[2];
            alpha[block] = -under;
            behind[block] = c[0] * d[0] + c[1] * d[1] + c[2] * d[2] - under;
            if (in.d_alpha) {
                const f32x16 d_alpha = plane(block, in.d_alpha);
                alpha[block] += d_alpha;
                behind[block] += plane(block, in.alpha) * d_alpha;
            }
            if (in.d_depth) {
                depth[block] = plane(block, in.d_depth);
                behind[block] += plane(block, in.depth) * depth[block];
            }
        }
        tile.start(transmittance);
    }
};

// One Gaussian over one block: adds to the lanes' moments.
template <bool kDepthGradient, bool kAbsolute>
SPLAT_INLINE void backward_pair(const TileGaussian& g, int block, f32x16 alpha, TileTargets& t,
                                uint32_t& alive, f32x16 (&moments)[12]) {
    const f32x16 u = g.u_at(block), w = g.w_at(block);
    const Step s = step(alpha, block, t.transmittance, alive);
    f32x16 e = t.alpha[block] + t.red[block] * g.rgb[0] + t.green[block] * g.rgb[1] +
               t.blue[block] * g.rgb[2];
    if (kDepthGradient) e += t.depth[block] * g.depth;
    const f32x16 behind = t.behind[block] - s.weight * e;
    t.behind[block] = behind;
    const f32x16 odds = alpha * reciprocal(1.0f - alpha);
    // Where alpha is held at its maximum it does not move with the Gaussian.
    const f32x16 v = keep(s.drawn & lt(alpha, splat16(kAlphaMax)), s.weight * e - odds * behind);
    const f32x16 vu = v * u, vw = v * w;
    moments[kV] += v;
    moments[kVU] += vu;
    moments[kVW] += vw;
    moments[kVUU] += vu * u;
    moments[kVUW] += vu * w;
    moments[kVWW] += vw * w;
    moments[kRed] += s.weight * t.red[block];
    moments[kGreen] += s.weight * t.green[block];
    moments[kBlue] += s.weight * t.blue[block];
    if (kDepthGradient) moments[kDepth] += s.weight * t.depth[block];
    if (kAbsolute) {
        moments[kAbsX] += abs(vu * g.uu);
        moments[kAbsY] += abs(vu * g.uw + vw * g.ww);
    }
}

template <bool kDepthGradient, bool kAbsolute>
void backward_tiles(const Record* records, const Pairs& pairs, const View& view,
                    const ImageGradientsIn& in, const int64_t* tile_end, int threads,
                    float* slot_gradients) {
    const int64_t tiles = view.tiles();
#pragma omp parallel for num_threads(threads) schedule(dynamic, 4)
    for (int64_t index = 0; index < tiles; index++) {
        int64_t entry = pairs.tile_begin[index];
        const int64_t last = tile_end[index], end = pairs.tile_begin[index + 1];
        if (entry == end) continue;
        const Tile tile(index, view);
        TileTargets targets(tile, view, in);
        uint32_t alive = alive_blocks(targets.transmittance);
        Batch batch;
        while (entry < last) {
            entry = batch.fill(records, pairs.entries, entry, last, tile, alive);
            const auto slot = [&](int n) {
                return slot_gradients + int64_t(batch.gaussian[n].slot) * kSlotFloats;
            };
            for (int n = 0; n < batch.count; n++) __builtin_prefetch(slot(n), 1);
            for (int n = 0; n < batch.count; n++) {
                f32x16 moments[12] = {};
                for (int i = batch.first[n]; i < batch.first[n + 1]; i++)
                    backward_pair<kDepthGradient, kAbsolute>(
                        batch.gaussian[n], int(batch.pair[i] % kBlocks), batch.alpha[i], targets,
                        alive, moments);
                store(slot(n), sum_lanes(moments));
            }
        }
        for (; entry < end; entry++)
            store(slot_gradients + int64_t(pairs.entries[entry].slot) * kSlotFloats, f32x16{});
    }
}

}  // namespace

void blend_backward(const Record* records, const Pairs& pairs, const View& view,
                    const ImageGradientsIn& in, const int64_t* tile_end, int threads,
                    float* slot_gradients) {
    const auto run =
        in.d_depth ? (in.absolute ? backward_tiles<true, true> : backward_tiles<true, false>)
                   : (in.absolute ? backward_tiles<false, true> : backward_tiles<false, false>);
    run(records, pairs, view, in, tile_end, threads, slot_gradients);
}

}  // namespace splat
