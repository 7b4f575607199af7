// Stage 2: lists the Gaussians that overlap each tile, front to back.
#pragma once

#include <vector>

#include "memory.h"
#include "types.h"

namespace splat {

// Tests the ellipses of the visible Gaussians against the blocks of the tiles, in order of index;
// lists the pairs of each tile in that order; sorts each list by depth, stably, so that equal
// depths stay in order of index. The result does not depend on the number of threads: every part
// of the Gaussians writes after the parts before it.
class Binner {
  public:
    // Finds the pairs. Returns false if there are more than kMaxIntersections. `slots` (N) are zero
    // for Gaussians that overlap no tile, and complete after `write`.
    bool find(const Record* records, const float* radii, int64_t count, const View& view,
              int threads, Slots* slots);

    int64_t intersections() const { return intersections_; }

    // Writes entries (intersections) and tile_begin (tiles + 1), after `find`.
    void write(Entry* entries, int64_t* tile_begin);

  private:
    // One (Gaussian, tile) pair.
    struct Found {
        uint32_t tile, depth, gaussian, blocks;
    };
    // A contiguous range of Gaussians. Threads change the numbers of neighbouring parts at once:
    // each part has cache lines of its own.
    struct alignas(64) Part {
        int64_t begin, end;
        Scratch<Found> found;
        int64_t used = 0, capacity = 0;
        std::vector<uint32_t> tile_count;

        void make_room(int64_t pairs_more);
    };

    // Replaces the counts of each tile by the first places of the parts' pairs in the tile's list.
    void place_pairs(int64_t* tile_begin);

    int threads_ = 1;
    int64_t tiles_ = 0, intersections_ = 0;
    Slots* slots_ = nullptr;
    std::vector<Part> parts_;
};

}  // namespace splat
