// What the blending kernels, forward and backward, share: a tile's pixels and a Gaussian seen
// from it.
#pragma once

#include "simd.h"
#include "types.h"

namespace splat {

// The pixels of one tile, 16 rows of 16.
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
        const Mask16 inside = lt(kLane, splat16(float(columns)));
        for (int row = 0; row < kTile; row++)
            transmittance[row] = row < rows ? select(inside, splat16(1), splat16(-1)) : splat16(-1);
    }
};

// log2(alpha) over a tile, row by row: power(row) = rest[row] - (across + u[row])^2. The rows'
// terms are found 16 at once; the origin's are taken in float64, so that a centre a thousand
// pixels away costs no digits.
struct TileGaussian {
    alignas(64) float u[kTile], rest[kTile], w[kTile];
    f32x16 across;

    SPLAT_INLINE TileGaussian(const Record& g, const Tile& tile) {
        const double dx = double(tile.x) + 0.5 - g.x, dy = double(tile.y) + 0.5 - g.y;
        const f32x16 w_rows = float(g.ww * dy) + kLane * g.ww;
        store(u, float(g.uu * dx + g.uw * dy) + kLane * g.uw);
        store(w, w_rows);
        store(rest, g.log2_opacity - w_rows * w_rows);
        across = kLane * g.uu;
    }
    SPLAT_INLINE f32x16 u_row(int row) const { return across + u[row]; }
    SPLAT_INLINE f32x16 power(int row, f32x16 u_row) const { return rest[row] - u_row * u_row; }
};

// One Gaussian over one row of pixels.
struct Step {
    Mask16 drawn;       // contributes
    Mask16 visible;     // alpha reaches its minimum
    f32x16 raw, alpha;  // unbounded, and at most kAlphaMax
    f32x16 weight;      // transmittance before * alpha where drawn, else 0
    f32x16 after;       // transmittance after, where drawn
};

// A stopped pixel has its transmittance's sign turned: its next one is negative too, under the
// minimum, so it never draws again.
SPLAT_INLINE Step step(f32x16 power, f32x16 transmittance) {
    Step s;
    s.visible = ge(power, splat16(kLog2AlphaMin));
    s.raw = exp2(power);
    s.alpha = min(s.raw, splat16(kAlphaMax));
    const f32x16 weight = s.alpha * transmittance;
    s.after = transmittance - weight;
    s.drawn = s.visible & ge(s.after, splat16(kTransmittanceMin));
    s.weight = keep(s.drawn, weight);
    return s;
}

// The transmittance to carry on with, and in `stopped` the pixels that end here.
SPLAT_INLINE f32x16 advance(const Step& s, f32x16 before, Mask16& stopped) {
    stopped = and_not(s.visible, s.drawn) & lt(splat16(0), before);
    const f32x16 next = select(s.drawn, s.after, before);
    return __builtin_expect(any(stopped), 0) ? negate_where(stopped, next) : next;
}

}  // namespace splat
