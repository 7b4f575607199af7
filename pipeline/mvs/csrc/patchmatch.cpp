// PatchMatch stereo: a plane for each pixel of a reference view (Bleyer et al. 2011), with
// red-black propagation (Galliani et al. 2015), best-of-region candidates (Xu and Tao 2019) and
// bilaterally weighted NCC (Schönberger et al. 2016).
//
// Pixels of one colour of the checkerboard read planes of the other colour only, and random numbers
// are a hash of seed, pixel and iteration: the order of the pixels does not matter. Lanes of a
// vector are neighbouring pixels of one colour in a row. The arrays of each colour are packed so
// that these are adjacent in memory.

#include "patchmatch.h"

#include <algorithm>
#include <vector>

#include "vectors.h"

namespace mvs {
namespace {

// Regularises the variances of NCC (grey levels squared): windows whose contrast is noise have a
// cost of about 1.
constexpr float NOISE_VARIANCE = 1.0f;
constexpr float MAX_COST = 2.0f;
// Cost of a source in which the point is outside the image, which says nothing about the plane.
constexpr float OUTSIDE_COST = 0.5f;
constexpr int MAX_BEST = 4;
constexpr int MAX_RADIUS = 8;
constexpr int MAX_SAMPLES = (MAX_RADIUS + 1) * (MAX_RADIUS + 1);
// Padding of the packed arrays: reach of candidates and windows, and a vector on the right.
constexpr int MARGIN = 12;

struct Plane {
    Floats w, wx, wy;
};

// An image as 2x2 blocks of bytes: one gather reads all that bilinear interpolation needs.
struct PackedImage {
    std::vector<uint32_t> blocks;
    float last_x, last_y;
    int32_t stride;

    PackedImage(const uint8_t* grey, int width, int height)
        : blocks(size_t(width) * height),
          last_x(float(width - 1)),
          last_y(float(height - 1)),
          stride(width) {
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) {
                const uint8_t* top = grey + size_t(y) * width;
                const uint8_t* bottom = grey + size_t(std::min(y + 1, height - 1)) * width;
                const int right = std::min(x + 1, width - 1);
                blocks[size_t(y) * width + x] = uint32_t(top[x]) | uint32_t(top[right]) << 8 |
                                                uint32_t(bottom[x]) << 16 |
                                                uint32_t(bottom[right]) << 24;
            }
    }

    // Bilinear interpolation at pixel indices; the border is continued.
    MVS_INLINE Floats at(Floats x, Floats y) const {
        x = min(max(x, Floats{}), all(last_x));
        y = min(max(y, Floats{}), all(last_y));
        const Ints column = to_ints(x), row = to_ints(y);
        const Floats fx = x - to_floats(column), fy = y - to_floats(row);
        const Bits block = gather(blocks.data(), row * stride + column);
        const Floats a = to_floats((Ints)(block & 255)), b = to_floats((Ints)(block >> 8 & 255));
        const Floats c = to_floats((Ints)(block >> 16 & 255)), d = to_floats((Ints)(block >> 24));
        const Floats top = a + fx * (b - a), bottom = c + fx * (d - c);
        return top + fy * (bottom - top);
    }
};

// A padded array of floats whose columns of equal parity are adjacent.
class ParityArray {
  public:
    ParityArray(int width, int height, float padding)
        : stride_(MARGIN + (width + 1) / 2 + MARGIN + LANES),
          rows_(height + 2 * MARGIN),
          values_(size_t(2) * stride_ * rows_, padding) {}
    // Values at (x, y), (x + 2, y), ...
    MVS_INLINE float* at(int x, int y) {
        return &values_[(size_t(x & 1) * rows_ + (y + MARGIN)) * stride_ + (x >> 1) + MARGIN];
    }
    MVS_INLINE const float* at(int x, int y) const {
        return const_cast<ParityArray*>(this)->at(x, y);
    }

  private:
    size_t stride_, rows_;
    std::vector<float> values_;
};

// The reference window of each lane: normalised weights, and weights times the deviation from the
// weighted mean.
struct Window {
    Floats weight[MAX_SAMPLES], deviation[MAX_SAMPLES];
    Floats variance;
    Floats x, y;  // Centre, pixel coordinates.
    Bits pixel;   // Index in the image.
    Ints active;
};

// Integer hash with full avalanche (Wellons 2018, "lowbias32").
MVS_INLINE Bits hashed(Bits v) {
    v ^= v >> 16;
    v *= 0x7feb352du;
    v ^= v >> 15;
    v *= 0x846ca68bu;
    return v ^ v >> 16;
}

class Random {
  public:
    MVS_INLINE Random(Bits pixel, uint32_t key) : state_(hashed(pixel) ^ key) {}
    // Uniform in [0, 1).
    MVS_INLINE Floats uniform() {
        state_ += 0x9e3779b9u;
        return to_floats((Ints)(hashed(state_) >> 8)) * 0x1p-24f;
    }
    // Uniform in [-1, 1).
    MVS_INLINE Floats sign() { return 2.0f * uniform() - 1.0f; }

  private:
    Bits state_;
};

class Matcher {
  public:
    explicit Matcher(const Problem& problem)
        : p_(problem),
          grey_(problem.width, problem.height, 0.0f),
          valid_(problem.width, problem.height, 0.0f),
          w_(problem.width, problem.height, 0.0f),
          wx_(problem.width, problem.height, 0.0f),
          wy_(problem.width, problem.height, 0.0f),
          cost_(problem.width, problem.height, FAR) {
        for (int y = 0; y < p_.height; ++y)
            for (int x = 0; x < p_.width; ++x) {
                *grey_.at(x, y) = float(p_.grey[size_t(y) * p_.width + x]);
                *valid_.at(x, y) = p_.valid[size_t(y) * p_.width + x] ? 1.0f : 0.0f;
            }
        for (int s = 0; s < p_.num_sources; ++s) {
            const Source& source = p_.sources[s];
            images_.emplace_back(source.grey, source.width, source.height);
        }
    }

    void read(const float* planes) {
        const size_t size = size_t(p_.width) * p_.height;
        for (int y = 0; y < p_.height; ++y)
            for (int x = 0; x < p_.width; ++x) {
                const float* from = planes + size_t(y) * p_.width + x;
                *w_.at(x, y) = from[0];
                *wx_.at(x, y) = from[size];
                *wy_.at(x, y) = from[2 * size];
            }
    }

    void write(float* planes, float* costs) const {
        const size_t size = size_t(p_.width) * p_.height;
        for (int y = 0; y < p_.height; ++y)
            for (int x = 0; x < p_.width; ++x) {
                const size_t i = size_t(y) * p_.width + x;
                const bool found = *cost_.at(x, y) <= MAX_COST;
                costs[i] = found ? *cost_.at(x, y) : MAX_COST;
                planes[i] = found ? *w_.at(x, y) : 0.0f;
                planes[size + i] = found ? *wx_.at(x, y) : 0.0f;
                planes[2 * size + i] = found ? *wy_.at(x, y) : 0.0f;
            }
    }

    // Costs of the planes that were read, and of random ones.
    void start(int num_random) {
        for_each_group(0, [&](const Window& window, int x, int y) {
            evaluate_start(window, x, y, num_random);
        });
        for_each_group(1, [&](const Window& window, int x, int y) {
            evaluate_start(window, x, y, num_random);
        });
    }

    void iterate(int iteration) {
        for (int colour = 0; colour < 2; ++colour)
            for_each_group(colour, [&](const Window& window, int x, int y) {
                Best best = at(x, y);
                propagate(window, x, y, best);
                refine(window, x, y, iteration, best);
                put(x, y, best, window.active);
            });
    }

  private:
    // Cost of pixels without a plane: no candidate.
    static constexpr float FAR = 1e30f;
    struct Best {
        Plane plane;
        Floats cost;
    };

    template <class Body>
    void for_each_group(int colour, const Body& body) {
        Window window;
        for (int y = 0; y < p_.height; ++y)
            for (int x = (y + colour) & 1; x < p_.width; x += 2 * LANES)
                if (fill(window, x, y)) body(window, x, y);
    }

    // Whether any lane has a pixel.
    bool fill(Window& window, int x0, int y0) const {
        const Ints x = x0 + 2 * lane_numbers();
        window.active = (x < p_.width) & (load(valid_.at(x0, y0)) > 0.0f);
        if (!any(window.active)) return false;
        window.pixel = (Bits)(y0 * p_.width + x);
        window.x = to_floats(x) + 0.5f;
        window.y = all(float(y0) + 0.5f);
        const Floats centre = load(grey_.at(x0, y0));
        const float color = -0.5f / (p_.sigma_color * p_.sigma_color);
        const float space = -0.5f / (p_.sigma_space * p_.sigma_space);
        Floats total = all(1e-12f), mean = {};
        int n = 0;
        for (int dy = -p_.radius; dy <= p_.radius; dy += 2)
            for (int dx = -p_.radius; dx <= p_.radius; dx += 2, ++n) {
                const Floats value = load(grey_.at(x0 + dx, y0 + dy)) - centre;
                const Floats weight =
                    load(valid_.at(x0 + dx, y0 + dy)) *
                    exp_negative(color * value * value + space * float(dx * dx + dy * dy));
                window.weight[n] = weight;
                window.deviation[n] = value;
                total += weight;
                mean += weight * value;
            }
        mean /= total;
        window.variance = all(0.0f);
        for (int k = 0; k < n; ++k) {
            const Floats value = window.deviation[k] - mean;
            window.weight[k] /= total;
            window.deviation[k] = window.weight[k] * value;
            window.variance += window.deviation[k] * value;
        }
        return true;
    }

    // 1 - NCC of the window and its image in a source by the plane's homography.
    MVS_INLINE Floats source_cost(const Window& window, const Plane& plane, int s) const {
        const float* r = p_.sources[s].rotation;
        const float* t = p_.sources[s].translation;
        Floats at[3], by_x[3], by_y[3];
        for (int k = 0; k < 3; ++k) {
            at[k] = r[3 * k] * window.x + r[3 * k + 1] * window.y + r[3 * k + 2] + t[k] * plane.w;
            by_x[k] = r[3 * k] + t[k] * plane.wx;
            by_y[k] = r[3 * k + 1] + t[k] * plane.wy;
        }
        const PackedImage& image = images_[s];
        const Floats u = at[0] / at[2], v = at[1] / at[2];
        // Pixel centres are at half integers.
        const Ints inside = (at[2] > 0.0f) & (u >= 0.0f) & (v >= 0.0f) &
                            (u <= image.last_x + 1.0f) & (v <= image.last_y + 1.0f);
        if (!any(inside & window.active)) return all(OUTSIDE_COST);
        for (int k = 0; k < 2; ++k) {
            at[k] -= 0.5f * at[2];
            by_x[k] -= 0.5f * by_x[2];
            by_y[k] -= 0.5f * by_y[2];
        }
        Floats mean = {}, square = {}, product = {};
        int n = 0;
        for (int dy = -p_.radius; dy <= p_.radius; dy += 2) {
            const Floats row[3] = {at[0] + float(dy) * by_y[0], at[1] + float(dy) * by_y[1],
                                   at[2] + float(dy) * by_y[2]};
            for (int dx = -p_.radius; dx <= p_.radius; dx += 2, ++n) {
                const Floats inverse = 1.0f / (row[2] + float(dx) * by_x[2]);
                const Floats value = image.at((row[0] + float(dx) * by_x[0]) * inverse,
                                              (row[1] + float(dx) * by_x[1]) * inverse);
                const Floats weighted = window.weight[n] * value;
                mean += weighted;
                square += weighted * value;
                product += window.deviation[n] * value;
            }
        }
        const Floats variance = max(square - mean * mean, Floats{});
        const Floats scale = (window.variance + NOISE_VARIANCE) * (variance + NOISE_VARIANCE);
        const Floats cost = 1.0f - product / square_root(scale);
        return inside ? max(min(cost, all(MAX_COST)), Floats{}) : all(OUTSIDE_COST);
    }

    // Whether a plane is in the range of depths and faces the camera.
    MVS_INLINE Ints allowed(const Window& window, const Plane& plane) const {
        const Floats x = window.x - p_.cx, y = window.y - p_.cy;
        // The normal times the inverse of the plane's distance from the camera.
        const Floats nx = plane.wx * p_.fx, ny = plane.wy * p_.fy;
        const Floats nz = plane.w - plane.wx * x - plane.wy * y;
        const Floats rx = x / p_.fx, ry = y / p_.fy;
        const Floats lengths = (nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + 1.0f);
        return (plane.w >= p_.min_inverse_depth) & (plane.w <= p_.max_inverse_depth) &
               (plane.w * plane.w >= p_.min_cosine * p_.min_cosine * lengths) & window.active;
    }

    // Mean of the lowest costs of the sources, FAR for planes that are not allowed.
    Floats cost(const Window& window, const Plane& plane) const {
        const Ints usable = allowed(window, plane);
        if (!any(usable)) return all(FAR);
        const int count = std::min({p_.num_best, p_.num_sources, MAX_BEST});
        Floats lowest[MAX_BEST];
        for (int k = 0; k < count; ++k) lowest[k] = all(MAX_COST);
        for (int s = 0; s < p_.num_sources; ++s) {
            Floats next = source_cost(window, plane, s);
            for (int k = 0; k < count; ++k) {
                const Floats smaller = min(lowest[k], next);
                next = max(lowest[k], next);
                lowest[k] = smaller;
            }
        }
        Floats sum = {};
        for (int k = 0; k < count; ++k) sum += lowest[k];
        return usable ? sum / float(count) : all(FAR);
    }

    MVS_INLINE Best at(int x, int y) const {
        return {{load(w_.at(x, y)), load(wx_.at(x, y)), load(wy_.at(x, y))}, load(cost_.at(x, y))};
    }

    MVS_INLINE void put(int x, int y, const Best& best, Ints active) {
        const Best old = at(x, y);
        store(w_.at(x, y), active ? best.plane.w : old.plane.w);
        store(wx_.at(x, y), active ? best.plane.wx : old.plane.wx);
        store(wy_.at(x, y), active ? best.plane.wy : old.plane.wy);
        store(cost_.at(x, y), active ? best.cost : old.cost);
    }

    MVS_INLINE void improve(const Window& window, const Plane& plane, Best& best) const {
        take(plane, cost(window, plane), best);
    }
    static MVS_INLINE void take(const Plane& plane, Floats cost, Best& best) {
        const Ints better = cost < best.cost;
        best.cost = better ? cost : best.cost;
        best.plane.w = better ? plane.w : best.plane.w;
        best.plane.wx = better ? plane.wx : best.plane.wx;
        best.plane.wy = better ? plane.wy : best.plane.wy;
    }

    // The planes of eight regions around the pixel: of each, the plane with the lowest cost there,
    // continued to the pixel.
    void propagate(const Window& window, int x, int y, Best& best) const {
        // Offsets along and across the direction: near, in the shape of a V, and far, on a line.
        static constexpr int NEAR[][2] = {{1, 0}, {2, -1}, {2, 1}, {3, -2}, {3, 2}};
        static constexpr int AWAY[][2] = {{3, 0}, {5, 0}, {7, 0}, {9, 0}, {11, 0}};
        static constexpr int DIRECTIONS[][2] = {{0, -1}, {0, 1}, {-1, 0}, {1, 0}};
        for (const auto& region : {NEAR, AWAY})
            for (const auto& d : DIRECTIONS) {
                Best found = {{}, all(FAR)};
                for (int k = 0; k < 5; ++k) {
                    const int along = region[k][0], across = region[k][1];
                    const int dx = along * d[0] + across * d[1];
                    const int dy = along * d[1] + across * d[0];
                    if (y + dy < 0 || y + dy >= p_.height) continue;
                    Best other = at(x + dx, y + dy);
                    other.plane.w -= float(dx) * other.plane.wx + float(dy) * other.plane.wy;
                    take(other.plane, other.cost, found);
                }
                improve(window, found.plane, best);
            }
    }

    MVS_INLINE Floats random_depth(Random& random) const {
        return p_.min_inverse_depth +
               (p_.max_inverse_depth - p_.min_inverse_depth) * random.uniform();
    }
    // A gradient up to that of a plane inclined by 60 degrees.
    MVS_INLINE void random_gradient(Random& random, Plane& plane) const {
        plane.wx = plane.w * random.sign() * (1.7f / p_.fx);
        plane.wy = plane.w * random.sign() * (1.7f / p_.fy);
    }

    MVS_INLINE Random random_of(const Window& window, int round) const {
        return Random(window.pixel, p_.seed + 0x632be5abu * uint32_t(round));
    }

    void evaluate_start(const Window& window, int x, int y, int num_random) {
        Best best = at(x, y);
        best.cost = cost(window, best.plane);
        Random random = random_of(window, 0);
        for (int k = 0; k < num_random; ++k) {
            Plane plane;
            plane.w = random_depth(random);
            random_gradient(random, plane);
            improve(window, plane, best);
        }
        put(x, y, best, window.active);
    }

    void refine(const Window& window, int x, int y, int iteration, Best& best) const {
        Random random = random_of(window, 1 + iteration);
        const float step = p_.first_step / float(1 << iteration) * p_.pixel_step;
        const float tilt = step / float(p_.radius);
        Plane plane;
        plane.w = random_depth(random);
        random_gradient(random, plane);
        improve(window, plane, best);
        plane = best.plane;
        random_gradient(random, plane);
        improve(window, plane, best);
        for (int k = 0; k < 2; ++k) {
            plane = best.plane;
            plane.w += step * random.sign();
            improve(window, plane, best);
            plane = best.plane;
            plane.wx += tilt * random.sign();
            plane.wy += tilt * random.sign();
            improve(window, plane, best);
        }
        plane = best.plane;
        plane.w += step * random.sign();
        plane.wx += tilt * random.sign();
        plane.wy += tilt * random.sign();
        improve(window, plane, best);
    }

    const Problem& p_;
    ParityArray grey_, valid_, w_, wx_, wy_, cost_;
    std::vector<PackedImage> images_;
};

}  // namespace
}  // namespace mvs

extern "C" void patchmatch(const Problem* problem, float* planes, float* costs) {
    mvs::Matcher matcher(*problem);
    matcher.read(planes);
    matcher.start(problem->num_random);
    for (int k = 0; k < problem->iterations; ++k) matcher.iterate(k);
    matcher.write(planes, costs);
}
