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
    // Finds the pairs. False when there would be more than kMaxIntersections.
    bool find(const Record* records, const float* radii, int64_t count, const View& view,
              int threads);

    int64_t intersections() const { return intersections_; }

    // Writes entries (intersections), tile_begin (tiles + 1) and slots (N; zeros where a Gaussian
    // touches nothing), after find and with its records.
    void write(const Record* records, Entry* entries, int64_t* tile_begin, Slots* slots);

  private:
    // One Gaussian in one tile.
    struct Span {
        uint32_t tile, blocks;
    };
    // A run of the Gaussians.
    struct Part {
        int64_t begin, end;
        Scratch<Span> spans;
        int64_t used = 0, capacity = 0;
        std::vector<uint32_t> tile_count;

        void make_room(int64_t spans_more);
    };

    int threads_ = 1;
    int64_t tiles_ = 0, intersections_ = 0;
    Scratch<uint32_t> touched_;  // tiles, by Gaussian
    std::vector<Part> parts_;
};

}  // namespace splat
