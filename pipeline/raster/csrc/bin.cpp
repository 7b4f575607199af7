#include "bin.h"

#include <atomic>
#include <cstring>

#include "simd.h"

namespace splat {
namespace {

struct Key {
    uint32_t depth, gaussian;
};

// Positive floats order as their bits do.
uint32_t depth_bits(float depth) {
    uint32_t bits;
    std::memcpy(&bits, &depth, 4);
    return bits;
}

// The half-open share of [0, count) of one of `parts`.
int64_t share(int64_t count, int part, int parts) { return count * part / parts; }

std::vector<Key> visible_keys(const Record* records, const float* radii, int64_t count,
                              int threads) {
    std::vector<int64_t> begin(threads + 1, 0);
    std::vector<Key> keys;
#pragma omp parallel for num_threads(threads) schedule(static, 1)
    for (int part = 0; part < threads; part++) {
        int64_t n = 0;
        for (int64_t i = share(count, part, threads); i < share(count, part + 1, threads); i++)
            n += radii[i] > 0;
        begin[part + 1] = n;
    }
    for (int part = 0; part < threads; part++) begin[part + 1] += begin[part];
    keys.resize(begin[threads]);
#pragma omp parallel for num_threads(threads) schedule(static, 1)
    for (int part = 0; part < threads; part++) {
        int64_t at = begin[part];
        for (int64_t i = share(count, part, threads); i < share(count, part + 1, threads); i++)
            if (radii[i] > 0) keys[at++] = {depth_bits(records[i].depth), uint32_t(i)};
    }
    return keys;
}

// Least significant digit first, 11 bits a pass: stable, so equal depths keep the order of their
// index. Each part counts its digits, then writes behind the parts before it.
void radix_sort(std::vector<Key>& keys, int threads) {
    constexpr int kBits = 11, kBuckets = 1 << kBits;
    const int64_t n = int64_t(keys.size());
    std::vector<Key> other(keys.size());
    std::vector<uint32_t> place(size_t(threads) * kBuckets);
    for (int shift = 0; shift < 32; shift += kBits) {
        const auto digit = [shift](const Key& k) { return (k.depth >> shift) & (kBuckets - 1); };
#pragma omp parallel for num_threads(threads) schedule(static, 1)
        for (int part = 0; part < threads; part++) {
            uint32_t* mine = place.data() + size_t(part) * kBuckets;
            std::memset(mine, 0, kBuckets * sizeof(uint32_t));
            for (int64_t i = share(n, part, threads); i < share(n, part + 1, threads); i++)
                mine[digit(keys[i])]++;
        }
        uint32_t total = 0;
        bool one_bucket = false;
        for (int bucket = 0; bucket < kBuckets; bucket++) {
            const uint32_t before = total;
            for (int part = 0; part < threads; part++) {
                uint32_t& slot = place[size_t(part) * kBuckets + bucket];
                const uint32_t here = slot;
                slot = total;
                total += here;
            }
            one_bucket |= total - before == uint64_t(n);
        }
        if (one_bucket) continue;  // all alike in this digit
#pragma omp parallel for num_threads(threads) schedule(static, 1)
        for (int part = 0; part < threads; part++) {
            uint32_t* mine = place.data() + size_t(part) * kBuckets;
            for (int64_t i = share(n, part, threads); i < share(n, part + 1, threads); i++)
                other[mine[digit(keys[i])]++] = keys[i];
        }
        keys.swap(other);
    }
}

// Tiles [first, last] that hold pixel centres in [center - extent, center + extent], one axis.
struct TileRange {
    int64_t first, last;
};
TileRange tile_range(double center, double extent, int64_t tiles) {
    const double first = (center - extent - 0.5) / kTile, last = (center + extent - 0.5) / kTile;
    return {first > 0 ? int64_t(first < tiles ? first : tiles) : 0,
            last < 0 ? -1 : (last < tiles - 1 ? int64_t(last) : tiles - 1)};
}

// Calls emit(tile, blocks) for every tile in which the ellipse {alpha >= 1/255}
// comes near a pixel centre. In each row of pixels the ellipse is an interval,
//     |uu d_x + uw d_y| <= sqrt(reach - (ww d_y)^2),
// found for the 16 rows of a tile at once; a column of tiles is then two comparisons.
template <class Emit>
SPLAT_INLINE void each_tile(const Record& r, int64_t tiles_x, int64_t tiles_y, const Emit& emit) {
    const TileRange columns = tile_range(r.x, r.extent_x + 0.01, tiles_x);
    const TileRange rows = tile_range(r.y, r.extent_y + 0.01, tiles_y);
    const float reach = r.log2_opacity - kLog2AlphaMin + kBinSlack;
    const float inv_uu = 1.0f / r.uu, slope = -r.uw * inv_uu;
    for (int64_t ty = rows.first; ty <= rows.last; ty++) {
        const f32x16 dy = kLane + float(ty * kTile + 0.5 - r.y);
        const f32x16 w = dy * r.ww;
        const f32x16 left_over = reach - w * w;
        const Mask16 inside = ge(left_over, splat16(0));
        if (!any(inside)) continue;
        const f32x16 middle = dy * slope;
        const f32x16 half = sqrt(max(left_over, splat16(0))) * inv_uu + abs(middle) * 2e-6f + 1e-3f;
        const f32x16 low = middle - half, high = middle + half;
        for (int64_t tx = columns.first; tx <= columns.last; tx++) {
            // The rows in which the interval meets each column of blocks, 16 bits a column.
            uint64_t hit = 0;
            for (int column = 0; column < kTile / kBlock; column++) {
                const float left = float(tx * kTile + kBlock * column + 0.5 - r.x);
                const Mask16 meets =
                    inside & ge(splat16(left + (kBlock - 1)), low) & ge(high, splat16(left));
                hit |= uint64_t(bits(meets)) << 16 * column;
            }
            if (!hit) continue;
            hit |= hit >> 1;  // any of a block's four rows
            hit |= hit >> 2;
            hit &= 0x1111111111111111;
            emit(ty * tiles_x + tx, uint32_t(hit | hit >> 15 | hit >> 30 | hit >> 45) & 0xffff);
        }
    }
}

}  // namespace

bool Binner::find(const Record* records, const float* radii, int64_t count, const View& view,
                  int threads) {
    threads_ = threads;
    touched_.assign(count, 0);
    tiles_ = view.tiles();
    std::vector<Key> keys = visible_keys(records, radii, count, threads);
    radix_sort(keys, threads);

    const int64_t n = int64_t(keys.size()), tiles_x = view.tiles_x(), tiles_y = view.tiles_y();
    chunks_.assign(threads, Chunk());
    std::atomic<int64_t> found{0};
#pragma omp parallel for num_threads(threads) schedule(static, 1)
    for (int part = 0; part < threads; part++) {
        Chunk& chunk = chunks_[part];
        chunk.tile_count.assign(tiles_, 0);
        const int64_t begin = share(n, part, threads), end = share(n, part + 1, threads);
        chunk.spans.reserve(3 * (end - begin));
        int64_t reported = 0;
        for (int64_t k = begin; k < end && found.load() <= kMaxIntersections; k++) {
            if (k + 8 < end) __builtin_prefetch(records + keys[k + 8].gaussian);
            const uint32_t gaussian = keys[k].gaussian;
            const size_t before = chunk.spans.size();
            each_tile(records[gaussian], tiles_x, tiles_y, [&](int64_t tile, uint32_t blocks) {
                chunk.tile_count[tile]++;
                chunk.spans.push_back({gaussian, uint32_t(tile), blocks});
            });
            touched_[gaussian] = uint32_t(chunk.spans.size() - before);
            if (int64_t(chunk.spans.size()) - reported > 65536) {
                found += int64_t(chunk.spans.size()) - reported;
                reported = int64_t(chunk.spans.size());
            }
        }
        found += int64_t(chunk.spans.size()) - reported;
    }
    intersections_ = 0;
    for (const Chunk& chunk : chunks_) intersections_ += int64_t(chunk.spans.size());
    return intersections_ <= kMaxIntersections;
}

void Binner::write(Entry* entries, int64_t* tile_begin, Slots* slots) {
    int64_t total = 0;
    for (int64_t tile = 0; tile < tiles_; tile++) {
        tile_begin[tile] = total;
        for (Chunk& chunk : chunks_) {
            const uint32_t here = chunk.tile_count[tile];
            chunk.tile_count[tile] = uint32_t(total);
            total += here;
        }
    }
    tile_begin[tiles_] = total;
    uint32_t first = 0;
    for (size_t i = 0; i < touched_.size(); i++) {
        slots[i] = {first, touched_[i]};
        first += touched_[i];
    }
#pragma omp parallel for num_threads(threads_) schedule(static, 1)
    for (int part = 0; part < threads_; part++) {
        Chunk& chunk = chunks_[part];
        // A Gaussian's spans are neighbours, and no other chunk has any.
        uint32_t gaussian = UINT32_MAX, slot = 0;
        for (const Span& span : chunk.spans) {
            if (span.gaussian != gaussian) {
                gaussian = span.gaussian;
                slot = slots[gaussian].first;
            }
            entries[chunk.tile_count[span.tile]++] = {gaussian, slot++, span.blocks};
        }
    }
}

}  // namespace splat
