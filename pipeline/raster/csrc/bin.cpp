#include "bin.h"

#include <atomic>
#include <cstring>

#include "simd.h"

namespace splat {
namespace {

// Parts of the Gaussians for each thread: visible ones are not spread evenly.
constexpr int kPartsPerThread = 4;

// Columns of blocks that are tested at once: a bit each.
constexpr int kColumns = 32, kTilesAcross = kColumns * kBlock / kTile;

// Windows that are worked on at once.
constexpr int kWindows = 64;

// Tiles [first, last] that hold pixel centres in [center - extent, center + extent], one axis.
struct TileRange {
    int64_t first, last;
};
SPLAT_INLINE TileRange tile_range(double center, double extent, int64_t tiles) {
    const double first = (center - extent - 0.5) / kTile, last = (center + extent - 0.5) / kTile;
    return {first > 0 ? int64_t(first < tiles ? first : tiles) : 0,
            last < 0 ? -1 : (last < tiles - 1 ? int64_t(last) : tiles - 1)};
}

// Bits [first, last] of each lane that is `inside`, whole numbers; those of [0, kColumns).
SPLAT_INLINE u32x16 bit_range(Mask16 inside, f32x16 first, f32x16 last) {
    const f32x16 end = splat16(kColumns - 1), zero = {};
    const Mask16 some = inside & ge(last, first) & ge(last, zero) & ge(end, first);
    const auto bit = [&](f32x16 v) {
        return u32x16(__builtin_convertvector(min(max(v, zero), end), i32x16));
    };
    const u32x16 all = u32x16{} + ~0u;
    const u32x16 range = (all << bit(first)) & (all >> (kColumns - 1 - bit(last)));
    return u32x16(keep(some, f32x16(range)));
}

// A Gaussian over a row of tiles, at most kTilesAcross of them.
struct Window {
    const Record* record;
    uint32_t gaussian, tile, tiles;  // tile: the first
    float left, top;                 // the first pixel's centre, from the Gaussian's
};

// Lists the windows of a Gaussian's bounding box.
SPLAT_INLINE void list_windows(const Record& r, uint32_t gaussian, int64_t tiles_x, int64_t tiles_y,
                               std::vector<Window>& windows) {
    const TileRange columns = tile_range(r.x, r.extent_x + 0.01, tiles_x);
    const TileRange rows = tile_range(r.y, r.extent_y + 0.01, tiles_y);
    for (int64_t ty = rows.first; ty <= rows.last; ty++)
        for (int64_t tx = columns.first; tx <= columns.last; tx += kTilesAcross) {
            const int64_t left = columns.last - tx + 1;
            windows.push_back({&r, gaussian, uint32_t(ty * tiles_x + tx),
                               uint32_t(left < kTilesAcross ? left : kTilesAcross),
                               float(tx * kTile + 0.5 - r.x), float(ty * kTile + 0.5 - r.y)});
        }
}

// The blocks of a window in which the ellipse {alpha >= 1/255} comes near a pixel centre: a bit a
// column, for each of the four rows of blocks. In a row of pixels the ellipse is an interval,
//     |uu d_x + uw d_y| <= sqrt(reach - (ww d_y)^2),
// found for the 16 rows at once.
SPLAT_INLINE u32x16 blocks_hit(const Window& window) {
    const Record& r = *window.record;
    const float reach = r.log2_opacity - kLog2AlphaMin + kBinSlack;
    const float inv_uu = 1.0f / r.uu, slope = -r.uw * inv_uu;
    const f32x16 dy = kLane + window.top, w = dy * r.ww, zero = {};
    const f32x16 left_over = reach - w * w;
    const Mask16 inside = ge(left_over, zero);
    const f32x16 middle = dy * slope - window.left;
    const f32x16 half = sqrt(max(left_over, zero)) * inv_uu + abs(dy * slope) * 2e-6f + 1e-3f;
    // Column c has the pixels 4 c + [0, 3].
    const f32x16 first = ceil((middle - half - 3.0f) * 0.25f);
    const f32x16 last = floor((middle + half) * 0.25f);
    return any_of_four(bit_range(inside, first, last));
}

// Positive floats order as their bits do.
SPLAT_INLINE uint32_t depth_bits(float depth) {
    uint32_t bits;
    std::memcpy(&bits, &depth, 4);
    return bits;
}

// Sorts lists by depth: least significant digit first, which is stable.
class TileSorter {
  public:
    void sort(const uint32_t* depths, Entry* entries, int64_t count) {
        uint32_t low = UINT32_MAX, high = 0;
        for (int64_t i = 0; i < count; i++) {
            low = depths[i] < low ? depths[i] : low;
            high = depths[i] > high ? depths[i] : high;
        }
        if (low >= high) return;  // none, or all alike
        keys_.resize(count);
        other_.resize(count);
        for (int64_t i = 0; i < count; i++) keys_[i] = {depths[i] - low, uint32_t(i)};
        constexpr int kPasses = 3;
        const int bits = (32 - __builtin_clz(high - low) + kPasses - 1) / kPasses;
        for (int pass = 0; pass < kPasses; pass++) {
            const auto digit = [=](const Key& k) {
                return (k.depth >> (pass * bits)) & ((1u << bits) - 1);
            };
            uint32_t place[(1 << 11) + 1];
            std::memset(place, 0, ((size_t(1) << bits) + 1) * sizeof(uint32_t));
            for (const Key& k : keys_) place[digit(k) + 1]++;
            for (uint32_t bucket = 0; bucket < 1u << bits; bucket++)
                place[bucket + 1] += place[bucket];
            for (const Key& k : keys_) other_[place[digit(k)]++] = k;
            keys_.swap(other_);
        }
        unsorted_.assign(entries, entries + count);
        for (int64_t i = 0; i < count; i++) entries[i] = unsorted_[keys_[i].number];
    }

  private:
    struct Key {
        uint32_t depth, number;
    };
    std::vector<Key> keys_, other_;
    std::vector<Entry> unsorted_;
};

}  // namespace

void Binner::Part::make_room(int64_t spans_more) {
    if (used + spans_more <= capacity) return;
    capacity = 2 * capacity + spans_more;
    Scratch<Span> grown(capacity);
    std::memcpy(grown.get(), spans.get(), used * sizeof(Span));
    spans = std::move(grown);
}

bool Binner::find(const Record* records, const float* radii, int64_t count, const View& view,
                  int threads) {
    threads_ = threads;
    tiles_ = view.tiles();
    touched_ = Scratch<uint32_t>(count);
    const int64_t tiles_x = view.tiles_x(), tiles_y = view.tiles_y();
    const int parts = threads * kPartsPerThread;
    parts_ = std::vector<Part>(parts);
    std::atomic<int64_t> found{0};
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int number = 0; number < parts; number++) {
        Part& part = parts_[number];
        part.begin = count * number / parts;
        part.end = count * (number + 1) / parts;
        part.tile_count.assign(tiles_, 0);
        part.capacity = 2 * (part.end - part.begin) + tiles_;
        part.spans = Scratch<Span>(part.capacity);
        std::vector<Window> windows;
        alignas(64) uint32_t hit[kWindows][16];
        // Step by step for many windows, because a Gaussian's numbers of windows and tiles are
        // mispredicted: the processor loses no more than the one step's work.
        const auto list_spans = [&] {
            for (size_t begin = 0; begin < windows.size(); begin += kWindows) {
                const size_t left = windows.size() - begin;
                const int count = int(left < kWindows ? left : kWindows);
                for (int i = 0; i < count; i++) store(hit[i], blocks_hit(windows[begin + i]));
                part.make_room(count * kTilesAcross);
                for (int i = 0; i < count; i++) {
                    const Window& window = windows[begin + i];
                    Span* const first = part.spans.get() + part.used;
                    Span* next = first;
                    for (uint32_t tile = 0; tile < window.tiles; tile++) {
                        uint32_t blocks = 0;
                        for (int row = 0; row < 4; row++)
                            blocks |= (hit[i][4 * row] >> 4 * tile & 15) << 4 * row;
                        *next = {window.tile + tile, blocks};
                        next += blocks != 0;
                        part.tile_count[window.tile + tile] += blocks != 0;
                    }
                    touched_[window.gaussian] += uint32_t(next - first);
                    part.used += next - first;
                }
            }
            windows.clear();
        };
        int64_t reported = 0;
        for (int64_t i = part.begin; i < part.end && found <= kMaxIntersections; i++) {
            touched_[i] = 0;
            if (!(radii[i] > 0)) continue;
            list_windows(records[i], uint32_t(i), tiles_x, tiles_y, windows);
            if (windows.size() < kWindows) continue;
            list_spans();
            if (part.used - reported > 65536) {
                found += part.used - reported;
                reported = part.used;
            }
        }
        list_spans();
    }
    intersections_ = 0;
    for (const Part& part : parts_) intersections_ += part.used;
    return intersections_ <= kMaxIntersections;
}

void Binner::write(const Record* records, Entry* entries, int64_t* tile_begin, Slots* slots) {
    int64_t total = 0;
    for (int64_t tile = 0; tile < tiles_; tile++) {
        tile_begin[tile] = total;
        for (Part& part : parts_) {
            const uint32_t here = part.tile_count[tile];
            part.tile_count[tile] = uint32_t(total);
            total += here;
        }
    }
    tile_begin[tiles_] = total;
    const Scratch<uint32_t> depths(intersections_);
    const int parts = int(parts_.size());
    std::vector<uint32_t> first(parts, 0);
    for (int number = 1; number < parts; number++)
        first[number] = first[number - 1] + uint32_t(parts_[number - 1].used);
#pragma omp parallel num_threads(threads_)
    {
#pragma omp for schedule(dynamic, 1)
        for (int number = 0; number < parts; number++) {
            Part& part = parts_[number];
            const Span* span = part.spans.get();
            uint32_t slot = first[number];
            for (int64_t i = part.begin; i < part.end; i++) {
                slots[i] = {slot, touched_[i]};
                if (touched_[i] == 0) continue;
                const uint32_t depth = depth_bits(records[i].depth);
                for (uint32_t k = 0; k < touched_[i]; k++, span++) {
                    const uint32_t to = part.tile_count[span->tile]++;
                    entries[to] = {uint32_t(i), slot++, span->blocks};
                    depths[to] = depth;
                }
            }
        }
        TileSorter sorter;
#pragma omp for schedule(dynamic, 16)
        for (int64_t tile = 0; tile < tiles_; tile++)
            sorter.sort(depths.get() + tile_begin[tile], entries + tile_begin[tile],
                        tile_begin[tile + 1] - tile_begin[tile]);
    }
}

}  // namespace splat
