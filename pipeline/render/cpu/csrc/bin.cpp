#include "bin.h"

#include <algorithm>
#include <atomic>
#include <cstring>
#include <utility>

#include "shuffle.h"
#include "threads.h"

namespace splat {
namespace {

// Number of parts for each thread, and the least number of all: visible Gaussians are distributed
// unevenly.
constexpr int kPartsPerThread = 4, kLeastParts = 16;

// Number of tiles whose pairs are summed at a time: some cache lines of counts.
constexpr int64_t kSummedTiles = 128;

// Number of columns of cells tested at a time, one bit each.
constexpr int kColumns = 32;

// Number of windows processed at a time.
constexpr int kWindows = 64;

// Bits [first, last], limited to [0, kColumns), of each lane in `inside`; whole numbers.
SPLAT_INLINE u32x16 bit_range(Mask16 inside, f32x16 first, f32x16 last) {
    const f32x16 end = splat16(kColumns - 1), zero = {};
    const Mask16 some = inside & (last >= first) & (last >= zero) & (end >= first);
    const auto bit = [&](f32x16 v) { return to_int(min(max(v, zero), end)); };
    const u32x16 from_first = shift_left(broadcast<u32x16>(~0u), bit(first));
    const u32x16 to_last = shift_left(broadcast<u32x16>(2u), bit(last)) - 1u;
    return bit_cast<u32x16>(keep(some, bit_cast<f32x16>(from_first & to_last)));
}

// Up to four rows of cells of a Gaussian's bounding box, and kColumns columns from the first of a
// tile.
struct Window {
    const Record* record;
    uint32_t gaussian, tile;        // tile of the first cell
    uint32_t rows_down, row_count;  // first row of cells in the tile, and their number, 1 to 4
    uint32_t columns;               // number of columns of cells
    float left, top;                // first pixel centre relative to the Gaussian's centre
};

SPLAT_INLINE void list_windows(const Record& r, uint32_t gaussian, uint32_t tiles_x,
                               std::vector<Window>& windows) {
    constexpr uint32_t kAcross = kTile / kCell;
    const uint32_t left = r.cell_left / kAcross * kAcross;
    // A low box has one window that starts anywhere; the windows of a high box are aligned to rows
    // of tiles. So no two windows share a tile.
    const bool low = uint32_t(r.cell_bottom - r.cell_top) < kAcross;
    const uint32_t top = low ? r.cell_top : r.cell_top / kAcross * kAcross;
    for (uint32_t y = top; y <= r.cell_bottom; y += kAcross)
        for (uint32_t x = left; x <= r.cell_right; x += kColumns) {
            const uint32_t rows = r.cell_bottom - y + 1, columns = r.cell_right - x + 1;
            windows.push_back({&r, gaussian, y / kAcross * tiles_x + x / kAcross, y % kAcross,
                               std::min(rows, kAcross), std::min(columns, uint32_t(kColumns)),
                               float(double(kCell) * x + 0.5 - r.x),
                               float(double(kCell) * y + 0.5 - r.y)});
        }
}

// The blocks of a window in which the ellipse {alpha >= 1/255} comes close to a pixel centre: one
// bit per column of cells, in every kBlockRows-th lane, one per row of blocks. In a row of pixels
// the ellipse is an interval,
//     |uu d_x + uw d_y| <= sqrt(reach - (ww d_y)^2),
// computed for 16 rows at once.
SPLAT_INLINE u32x16 blocks_hit(const Window& window) {
    const Record& r = *window.record;
    const float reach = r.log2_opacity - kLog2AlphaMin + kBinSlack;
    const float inv_uu = 1.0f / r.uu, slope = -r.uw * inv_uu;
    const f32x16 dy = lane_numbers() + window.top, w = dy * r.ww, zero = {};
    const f32x16 left_over = reach - w * w;
    const Mask16 inside = left_over >= zero;
    const f32x16 middle = dy * slope - window.left;
    const f32x16 half = sqrt(max(left_over, zero)) * inv_uu + abs(dy * slope) * 2e-6f + 1e-3f;
    // Column c contains the pixels 4 c + [0, 3].
    const f32x16 first = ceil((middle - half - 3.0f) * 0.25f);
    const f32x16 last = floor((middle + half) * 0.25f);
    const uint32_t here = ~0u >> (kColumns - (window.columns + 3) / 4 * 4);
    return any_of<kBlockRows>(bit_range(inside, first, last)) & here;
}

// Bit masks of a tile's blocks, and of its blocks in a row of cells.
constexpr uint64_t kTileBits = (uint64_t(1) << kBlocks) - 1;
constexpr int kRowBits = kBlocks / (kTile / kCell);

// Positive floats are ordered like their bit patterns.
SPLAT_INLINE uint32_t depth_bits(float depth) {
    uint32_t bits;
    std::memcpy(&bits, &depth, 4);
    return bits;
}

// An entry while it is sorted.
struct TilePair {
    Entry entry;
    uint32_t depth;
};

// Sorts a tile's list by depth, and equal depths by position in the list.
class TileSorter {
  public:
    void sort(const TilePair* pairs, int64_t count, Entry* to) {
        if (int64_t(keys_.size()) < count) {
            keys_.resize(count + count / 2);
            other_.resize(keys_.size());
        }
        sort_keys(pairs, count);
        for (int64_t i = 0; i < count; i++) to[i] = pairs[uint32_t(keys_[i])].entry;
    }

  private:
    using Key = uint64_t;  // depth, position
    static constexpr int kPlaceBits = 32, kMostBits = 11;

    void sort_keys(const TilePair* pairs, int64_t count) {
        uint32_t low = UINT32_MAX, high = 0;
        for (int64_t i = 0; i < count; i++) {
            low = std::min(low, pairs[i].depth);
            high = std::max(high, pairs[i].depth);
        }
        for (int64_t i = 0; i < count; i++)
            keys_[i] = Key(pairs[i].depth - low) << kPlaceBits | uint32_t(i);
        if (low >= high) return;  // empty, or all equal
        // Two passes of radix sort by the leading bits of the depth, twice as many bits as number
        // the list, so that few entries agree in them. Least significant digit first: stable.
        const int depth_bits = 32 - __builtin_clz(high - low);
        const int needed = 32 - __builtin_clz(uint32_t(count));
        const int bits = std::min({needed, kMostBits, (depth_bits + 1) / 2});
        const int shift = kPlaceBits + std::max(depth_bits - 2 * bits, 0);
        const uint32_t buckets = 1u << bits;
        uint32_t place[2][1 << kMostBits];
        for (auto& p : place) std::memset(p, 0, buckets * sizeof(uint32_t));
        const auto digit = [=](Key key, int pass) {
            return uint32_t(key >> (shift + pass * bits)) & (buckets - 1);
        };
        for (int64_t i = 0; i < count; i++) {
            place[0][digit(keys_[i], 0)]++;
            place[1][digit(keys_[i], 1)]++;
        }
        uint32_t sum[2] = {};
        for (uint32_t bucket = 0; bucket < buckets; bucket++)
            for (int pass = 0; pass < 2; pass++) {
                const uint32_t here = place[pass][bucket];
                place[pass][bucket] = sum[pass];
                sum[pass] += here;
            }
        for (int64_t i = 0; i < count; i++) other_[place[0][digit(keys_[i], 0)]++] = keys_[i];
        for (int64_t i = 0; i < count; i++) keys_[place[1][digit(other_[i], 1)]++] = other_[i];
        // Entries that agree in the leading bits, by the remaining bits.
        for (int64_t i = 1; i < count; i++) {
            if (keys_[i - 1] < keys_[i]) continue;
            int64_t begin = i - 1, end = i + 1;
            while (begin > 0 && keys_[begin - 1] >> shift == keys_[i] >> shift) begin--;
            while (end < count && keys_[end] >> shift == keys_[i] >> shift) end++;
            std::sort(keys_.begin() + begin, keys_.begin() + end);
            i = end;
        }
    }

    std::vector<Key> keys_, other_;
};

}  // namespace

void Binner::Part::make_room(int64_t pairs_more) {
    if (used + pairs_more <= capacity) return;
    capacity = 2 * capacity + pairs_more;
    Scratch<Found> grown(capacity);
    if (used) std::memcpy(grown.get(), found.get(), used * sizeof(Found));
    found = std::move(grown);
}

bool Binner::find(const Record* records, const float* radii, int64_t count, const View& view,
                  int threads, Slots* slots) {
    threads_ = threads;
    tiles_ = view.tiles();
    slots_ = slots;
    const uint32_t tiles_x = uint32_t(view.tiles_x());
    const int parts = std::max(threads * kPartsPerThread, kLeastParts);
    parts_ = std::vector<Part>(parts);
    std::atomic<int64_t> total{0};
    parallel_for(parts, 1, threads, [&](int64_t number) {
        Part& part = parts_[number];
        part.begin = count * number / parts;
        part.end = count * (number + 1) / parts;
        // Blocks that are not hit are written too but not counted, and may exceed the count.
        part.tile_count.assign(tiles_ + tiles_x + 2, 0);
        part.make_room(2 * (part.end - part.begin));
        std::vector<Window> windows;
        alignas(64) uint32_t hit[kWindows][16];
        // Each step runs for many windows: the numbers of windows and tiles of a Gaussian are
        // mispredicted, and a misprediction then costs only the work of one step.
        const auto list_pairs = [&] {
            for (size_t begin = 0; begin < windows.size(); begin += kWindows) {
                const int here = int(std::min(windows.size() - begin, size_t(kWindows)));
                for (int i = 0; i < here; i++) store(hit[i], blocks_hit(windows[begin + i]));
                part.make_room(here * (kColumns / 4 + 1) * 2);
                for (int i = 0; i < here; i++) {
                    const Window& window = windows[begin + i];
                    const uint32_t depth = depth_bits(window.record->depth);
                    const uint64_t rows = (uint64_t(1) << kRowBits * window.row_count) - 1;
                    Found* const first = part.found.get() + part.used;
                    Found* next = first;
                    const auto list = [&](uint32_t tile, uint32_t blocks) {
                        *next = {tile, depth, window.gaussian, blocks};
                        next += blocks != 0;
                        part.tile_count[tile] += blocks != 0;
                    };
                    // Two tiles at once, since most windows have at most two: 8 bits of each row
                    // of blocks, 4 per tile.
                    for (uint32_t column = 0; column < window.columns; column += 8) {
                        const uint64_t both =
                            native::split_nibbles(native::first_bytes<kBlockRows>(hit[i], column));
                        for (uint32_t k = 0; k < 2; k++) {
                            const uint32_t tile = window.tile + column / 4 + k;
                            const uint64_t blocks = (both >> 32 * k & rows)
                                                    << kRowBits * window.rows_down;
                            list(tile, uint32_t(blocks & kTileBits));
                            list(tile + tiles_x, uint32_t(blocks >> kBlocks));
                        }
                    }
                    slots[window.gaussian].count += uint32_t(next - first);
                    part.used += next - first;
                }
            }
            windows.clear();
        };
        int64_t reported = 0;
        for (int64_t i = part.begin; i < part.end && total <= kMaxIntersections; i++) {
            slots[i].count = 0;
            if (!(radii[i] > 0)) continue;
            list_windows(records[i], uint32_t(i), tiles_x, windows);
            if (windows.size() < kWindows) continue;
            list_pairs();
            if (part.used - reported > 65536) {
                total += part.used - reported;
                reported = part.used;
            }
        }
        list_pairs();
    });
    intersections_ = 0;
    for (const Part& part : parts_) intersections_ += part.used;
    return intersections_ <= kMaxIntersections;
}

void Binner::place_pairs(int64_t* tile_begin) {
    // The counts of all parts grow with the number of threads: their sum over the tiles before each
    // range, by range, and then the places in each.
    std::vector<int64_t> before((tiles_ + kSummedTiles - 1) / kSummedTiles, 0);
    const auto end_of = [&](int64_t range) { return std::min((range + 1) * kSummedTiles, tiles_); };
    const int64_t ranges = int64_t(before.size());
    parallel_for(ranges, 1, threads_, [&](int64_t range) {
        int64_t pairs = 0;
        for (const Part& part : parts_)
            for (int64_t tile = range * kSummedTiles; tile < end_of(range); tile++)
                pairs += part.tile_count[tile];
        before[range] = pairs;
    });
    int64_t total = 0;
    for (int64_t& pairs : before) total += std::exchange(pairs, total);
    parallel_for(ranges, 1, threads_, [&](int64_t range) {
        int64_t place = before[range];
        for (int64_t tile = range * kSummedTiles; tile < end_of(range); tile++) {
            tile_begin[tile] = place;
            for (Part& part : parts_)
                place += std::exchange(part.tile_count[tile], uint32_t(place));
        }
    });
    tile_begin[tiles_] = total;
}

void Binner::write(Entry* entries, int64_t* tile_begin) {
    place_pairs(tile_begin);
    const Scratch<TilePair> by_tile(intersections_);
    const int parts = int(parts_.size());
    std::vector<uint32_t> first(parts, 0);
    for (int number = 1; number < parts; number++)
        first[number] = first[number - 1] + uint32_t(parts_[number - 1].used);
    parallel_for(parts, 1, threads_, [&](int64_t number) {
        Part& part = parts_[number];
        uint32_t slot = first[number];
        for (int64_t i = part.begin; i < part.end; i++) {
            slots_[i].first = slot;
            slot += slots_[i].count;
        }
        slot = first[number];
        for (int64_t k = 0; k < part.used; k++) {
            const Found& f = part.found[k];
            by_tile[part.tile_count[f.tile]++] = {{f.gaussian, slot++, f.blocks}, f.depth};
        }
    });
    parallel_ranges(tiles_, 16, threads_, [&](int64_t begin, int64_t end) {
        TileSorter sorter;
        for (int64_t tile = begin; tile < end; tile++)
            sorter.sort(by_tile.get() + tile_begin[tile], tile_begin[tile + 1] - tile_begin[tile],
                        entries + tile_begin[tile]);
    });
}

}  // namespace splat
