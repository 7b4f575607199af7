// Stage 2: which Gaussians touch which tile, front to back.
#pragma once

#include <vector>

#include "types.h"

namespace splat {

// Sorts the visible Gaussians by depth (ties by index), tests their ellipses row by row against
// the tiles, and splits the pairs by tile without disturbing their order. The result does not
// depend on the number of threads: every chunk of the sorted list writes where the chunks before
// it end.
class Binner {
  public:
    // Finds the pairs. False when there would be more than kMaxIntersections.
    bool find(const Record* records, const float* radii, int64_t count, const View& view,
              int threads);

    int64_t intersections() const { return intersections_; }

    // Writes entries (intersections), tile_begin (tiles + 1) and slots (N; zeros where a Gaussian
    // touches nothing).
    void write(Entry* entries, int64_t* tile_begin, Slots* slots);

  private:
    struct Span {
        uint32_t gaussian, tile, blocks;
    };
    struct Chunk {
        std::vector<Span> spans;
        std::vector<uint32_t> tile_count;
    };

    int threads_ = 1;
    int64_t tiles_ = 0, intersections_ = 0;
    std::vector<uint32_t> touched_;  // tiles, by Gaussian
    std::vector<Chunk> chunks_;
};

}  // namespace splat
