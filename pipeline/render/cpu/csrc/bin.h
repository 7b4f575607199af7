// Stage 2: which Gaussians touch which tile, front to back.
#pragma once

#include <vector>

#include "memory.h"
#include "types.h"

namespace splat {

// Tests the visible Gaussians' ellipses row by row against the blocks of the tiles, in order of
// index; lists the pairs by tile without disturbing that order; sorts each tile's list by depth,
// stably, so that equal depths stay in order of index. The result does not depend on the number
// of threads: every part of the Gaussians writes where the parts before it end.
class Binner {
  public:
    // Finds the pairs. False when there would be more than kMaxIntersections. `slots` (N): zeros
    // where a Gaussian touches nothing; whole after `write`.
    bool find(const Record* records, const float* radii, int64_t count, const View& view,
              int threads, Slots* slots);

    int64_t intersections() const { return intersections_; }

    // Writes entries (intersections) and tile_begin (tiles + 1), after `find`.
    void write(Entry* entries, int64_t* tile_begin);

  private:
    // One Gaussian in one tile.
    struct Found {
        uint32_t tile, depth, gaussian, blocks;
    };
    // A run of the Gaussians.
    struct Part {
        int64_t begin, end;
        Scratch<Found> found;
        int64_t used = 0, capacity = 0;
        std::vector<uint32_t> tile_count;

        void make_room(int64_t pairs_more);
    };

    int threads_ = 1;
    int64_t tiles_ = 0, intersections_ = 0;
    Slots* slots_ = nullptr;
    std::vector<Part> parts_;
};

}  // namespace splat
