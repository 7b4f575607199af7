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

// What a tile's pixels ask for, and where they have come to. The gap keeps a row that is written
// half a page off the same row of what is read: 4096 bytes apart, the processor takes a load for
// one of what it has just stored, and waits.
struct TileTargets {
    f32x16 red[kTile], green[kTile], blue[kTile], alpha[kTile];
    f32x16 gap[kTile / 2];
    f32x16 transmittance[kTile];
    f32x16 behind[kTile];  // S: starts as the whole sum, ends as 0
    f32x16 depth[kTile];

    TileTargets(const Tile& tile, const View& view, const ImageGradientsIn& in) {
        // Rows and columns outside the image ask for nothing.
        alignas(64) float lanes[6][kTile];
        for (int row = 0; row < kTile; row++) {
            std::memset(lanes, 0, sizeof(lanes));
            const int columns = row < tile.rows ? tile.columns : 0;
            for (int i = 0; i < columns; i++) {
                const int64_t pixel = (tile.y + row) * view.width + tile.x + i;
                const float* c = in.color + 3 * pixel;
                const float* d = in.d_color + 3 * pixel;
                // The background shows through 1 - alpha.
                const float under =
                    d[0] * in.background[0] + d[1] * in.background[1] + d[2] * in.background[2];
                const float d_alpha = in.d_alpha ? in.d_alpha[pixel] : 0;
                float whole =
                    c[0] * d[0] + c[1] * d[1] + c[2] * d[2] - under + in.alpha[pixel] * d_alpha;
                if (in.d_depth) {
                    whole += in.depth[pixel] * in.d_depth[pixel];
                    lanes[5][i] = in.d_depth[pixel];
                }
                for (int k = 0; k < 3; k++) lanes[k][i] = d[k];
                lanes[3][i] = d_alpha - under;
                lanes[4][i] = whole;
            }
            red[row] = load<f32x16>(lanes[0]);
            green[row] = load<f32x16>(lanes[1]);
            blue[row] = load<f32x16>(lanes[2]);
            alpha[row] = load<f32x16>(lanes[3]);
            behind[row] = load<f32x16>(lanes[4]);
            depth[row] = load<f32x16>(lanes[5]);
        }
    }
};

// 0, 1, ... and their squares: rows counted from a Gaussian's first.
struct RowNumbers {
    float value[kTile], square[kTile];
    constexpr RowNumbers() : value(), square() {
        for (int i = 0; i < kTile; i++) value[i] = float(i), square[i] = float(i * i);
    }
};
constexpr RowNumbers kRows;

// One Gaussian over its rows of a tile, to one slot.
template <bool kDepthGradient, bool kAbsolute>
SPLAT_INLINE void backward_gaussian(const TileGaussian& here, TileTargets& t, float* slot) {
    const Record& g = *here.record;
    const int first = here.first_row(), last = here.last_row();
    const f32x16 zero = {};
    f32x16 v0 = zero, v1 = zero, v2 = zero;  // sums over rows of v, v * n, v * n^2
    f32x16 red = zero, green = zero, blue = zero, depth = zero, abs_x = zero, abs_y = zero;
    for (int row = first; row <= last; row++) {
        const f32x16 before = t.transmittance[row], u = here.u_row(row);
        const Step s = step(here.power(row, u), before);
        Mask16 stopped;
        t.transmittance[row] = advance(s, before, stopped);
        f32x16 e =
            t.alpha[row] + t.red[row] * g.rgb[0] + t.green[row] * g.rgb[1] + t.blue[row] * g.rgb[2];
        if (kDepthGradient) e += t.depth[row] * g.depth;
        const f32x16 behind = t.behind[row] - s.weight * e;
        t.behind[row] = behind;
        const f32x16 odds = s.alpha * reciprocal(1.0f - s.alpha);
        // Where alpha is held at its maximum it does not move with the Gaussian.
        const f32x16 v =
            keep(s.drawn & lt(s.raw, splat16(kAlphaMax)), s.weight * e - odds * behind);
        const int n = row - first;
        v0 += v;
        v1 += v * kRows.value[n];
        v2 += v * kRows.square[n];
        red += s.weight * t.red[row];
        green += s.weight * t.green[row];
        blue += s.weight * t.blue[row];
        if (kDepthGradient) depth += s.weight * t.depth[row];
        if (kAbsolute) {
            abs_x += abs(v * u);
            abs_y += abs(v * (u * g.uw + here.w[row] * g.ww));
        }
    }
    // u = p + n uw, w = q + n ww, with n counted from the first row, so that nothing cancels.
    const f32x16 p = here.u_row(first);
    const f32x16 q = splat16(here.w[first]);
    const f32x16 vu = p * v0 + g.uw * v1, vw = q * v0 + g.ww * v1;
    const f32x16 vu1 = p * v1 + g.uw * v2, vw1 = q * v1 + g.ww * v2;  // weighted by n
    const f32x16 moments[12] = {v0,
                                vu,
                                vw,
                                p * vu + g.uw * vu1,
                                q * vu + g.ww * vu1,
                                q * vw + g.ww * vw1,
                                red,
                                green,
                                blue,
                                depth,
                                abs_x * g.uu,
                                abs_y};
    store(slot, sum_lanes(moments));
}

template <bool kDepthGradient, bool kAbsolute>
void backward_tiles(const Record* records, const Pairs& pairs, const View& view,
                    const ImageGradientsIn& in, const int64_t* tile_end, int threads,
                    float* slot_gradients) {
    const int64_t tiles = view.tiles();
#pragma omp parallel for num_threads(threads) schedule(dynamic, 4)
    for (int64_t index = 0; index < tiles; index++) {
        const int64_t begin = pairs.tile_begin[index], end = pairs.tile_begin[index + 1];
        if (begin == end) continue;
        const Tile tile(index, view);
        TileTargets targets(tile, view, in);
        tile.start(targets.transmittance);
        const auto slot_of = [=](const Entry& entry) {
            return slot_gradients + int64_t(entry.slot) * kSlotFloats;
        };
        each_gaussian(
            records, pairs.entries, begin, tile_end[index], tile,
            [&](const Entry& entry) { __builtin_prefetch(slot_of(entry), 1); },
            [&](const TileGaussian& here) __attribute__((always_inline)) {
                backward_gaussian<kDepthGradient, kAbsolute>(here, targets, slot_of(here.entry));
                return true;
            });
        for (int64_t e = tile_end[index]; e < end; e++) store(slot_of(pairs.entries[e]), f32x16{});
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
