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

// log2(alpha) of a Gaussian over a tile, row by row: power(row) = rest[row] - (across + u[row])^2.
// The rows' terms are found 16 at once; the origin's are taken in float64, so that a centre a
// thousand pixels away costs no digits.
struct TileGaussian {
    alignas(64) float u[kTile], rest[kTile], w[kTile];
    f32x16 across;
    const Record* record;
    Entry entry;

    SPLAT_INLINE void set(const Record& g, const Entry& from, const Tile& tile) {
        const double dx = double(tile.x) + 0.5 - g.x, dy = double(tile.y) + 0.5 - g.y;
        const f32x16 w_rows = float(g.ww * dy) + kLane * g.ww;
        store(u, float(g.uu * dx + g.uw * dy) + kLane * g.uw);
        store(w, w_rows);
        store(rest, g.log2_opacity - w_rows * w_rows);
        across = kLane * g.uu;
        record = &g;
        entry = from;
    }
    SPLAT_INLINE int first_row() const { return int(entry.rows & 255); }
    SPLAT_INLINE int last_row() const { return int(entry.rows >> 8); }
    SPLAT_INLINE f32x16 u_row(int row) const { return across + u[row]; }
    SPLAT_INLINE f32x16 power(int row, f32x16 u_row) const { return rest[row] - u_row * u_row; }
};

// Goes through entries [begin, end) of a tile while visit(TileGaussian) says so; returns the entry
// after the last one visited. `announce` hears of an entry some time before its visit. Each
// Gaussian is set up before its predecessor's rows are drawn: when the processor mispredicts the
// end of those rows, as it often does, the next rows' terms are there already.
template <class Announce, class Visit>
SPLAT_INLINE int64_t each_gaussian(const Record* records, const Entry* entries, int64_t begin,
                                   int64_t end, const Tile& tile, const Announce& announce,
                                   const Visit& visit) {
    constexpr int kAhead = 6;
    if (begin == end) return end;
    TileGaussian two[2];
    two[begin & 1].set(records[entries[begin].gaussian], entries[begin], tile);
    for (int64_t e = begin; e < end; e++) {
        if (e + kAhead < end) {
            __builtin_prefetch(records + entries[e + kAhead].gaussian);
            announce(entries[e + kAhead]);
        }
        const Entry& next = entries[e + 1 < end ? e + 1 : e];
        two[(e + 1) & 1].set(records[next.gaussian], next, tile);
        if (!visit(two[e & 1])) return e + 1;
    }
    return end;
}

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
    // Zero where nothing is seen: junk there could be denormal, which costs a hundred cycles.
    s.alpha = keep(s.visible, min(s.raw, splat16(kAlphaMax)));
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
