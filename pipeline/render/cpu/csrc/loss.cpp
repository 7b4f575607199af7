// The window is separable into two rows of 11 taps. A row of an (H, W, 3) image is a flat array
// whose taps are 3 apart: all operations are on flat rows of vectors.
//
// With m_x, m_y, m_2, m_xy the blurred x, y, x^2 + y^2, x y,
//     SSIM = (2 m_x m_y + C1)(2 (m_xy - m_x m_y) + C2)
//            / ((m_x^2 + m_y^2 + C1)(m_2 - m_x^2 - m_y^2 + C2)),
//     dL/dx = blur(dL/dm_x) + 2 x blur(dL/dm_2) + y blur(dL/dm_xy),
// as the window is symmetric. A strip of the image is processed once from top to bottom; the last
// 12 rows of the two images and of the three derivatives stay in the cache. The derivatives follow
// 5 rows behind the images, and the gradient 5 rows behind those. Two rows are computed at a time,
// since they use nearly the same rows, and in the same order of summation.

#include "loss.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <vector>

#include "memory.h"
#include "shuffle.h"
#include "simd_math.h"
#include "threads.h"

namespace splat {
namespace {

constexpr int kRadius = 5, kTaps = 2 * kRadius + 1;  // of the window, pixels
constexpr int kRows = kTaps + 1;                     // rows in the windows of two rows
constexpr int kReach = 16;  // floats of a window on each side: 3 kRadius in whole vectors
constexpr float kC1 = 1e-4f, kC2 = 9e-4f;

// Maximum floats of a strip's row: the buffered rows take about 300 KB, less than half an L2 cache.
constexpr int64_t kStripFloats = 1024;

// Minimum rows of a band, and the rows whose processing takes as long as that of the rows above and
// below a band, of which it computes a part.
constexpr int64_t kBandRows = 16, kMoreRows = 8;

struct Window {
    float tap[kRadius + 1];  // from the centre outwards
    Window() {
        double sum = 0, weight[kRadius + 1];
        for (int i = 0; i <= kRadius; i++) {
            weight[i] = std::exp(-i * i / (2 * 1.5 * 1.5));
            sum += weight[i] * (i ? 2 : 1);
        }
        for (int i = 0; i <= kRadius; i++) tap[i] = float(weight[i] / sum);
    }
};

// One register per vector: the four blurs of two rows need eight sums in registers.
constexpr int kLanes = kRegisterBytes / int(sizeof(float));
using Lanes = Vector<float, kLanes>;

#if SPLAT_AVX512
// Lanes [kFirst, kFirst + 16) of two vectors in a row.
template <int kFirst, int... kEach>
SPLAT_INLINE Lanes lanes_from(Lanes left, Lanes right, std::integer_sequence<int, kEach...>) {
    return shuffle<(kFirst + kEach)...>(left, right);
}
// Shifted from three aligned vectors: ten loads across two cache lines each take twice as long.
SPLAT_INLINE Lanes blur_across(const float* centre, const Window& k) {
    const Lanes left = load<Lanes>(centre - 16), here = load<Lanes>(centre),
                right = load<Lanes>(centre + 16);
    constexpr LaneSequence<16> lanes;
    Lanes sum = here * k.tap[0];
    sum += (lanes_from<13>(left, here, lanes) + lanes_from<3>(here, right, lanes)) * k.tap[1];
    sum += (lanes_from<10>(left, here, lanes) + lanes_from<6>(here, right, lanes)) * k.tap[2];
    sum += (lanes_from<7>(left, here, lanes) + lanes_from<9>(here, right, lanes)) * k.tap[3];
    sum += (lanes_from<4>(left, here, lanes) + lanes_from<12>(here, right, lanes)) * k.tap[4];
    sum += (lanes_from<1>(left, here, lanes) + lanes_from<15>(here, right, lanes)) * k.tap[5];
    return sum;
}
#else
SPLAT_INLINE Lanes blur_across(const float* centre, const Window& k) {
    Lanes sum = load<Lanes>(centre) * k.tap[0];
#pragma GCC unroll 5
    for (int i = 1; i <= kRadius; i++)
        sum += (load<Lanes>(centre - 3 * i) + load<Lanes>(centre + 3 * i)) * k.tap[i];
    return sum;
}
#endif
static_assert(kRadius == 5 && kReach == 16, "blur_across");

// A ring buffer of the last kRows rows.
struct Ring {
    float* memory;
    int64_t stride;

    float* row(int64_t y) const { return memory + (y + 2 * kRows) % kRows * stride; }
};

// Sums of a row's |x - y|, SSIM and (x - y)^2.
struct Sums {
    double error, ssim, squared;

    void operator+=(const Sums& more) {
        error += more.error;
        ssim += more.ssim;
        squared += more.squared;
    }
};

// Columns [begin, end) of an image's rows of `values` floats. The buffers have 2 kReach more floats
// on each side, for the blur of a blur.
class Strip {
  public:
    // `count`: number of values that the means are over.
    Strip(const LossImages& in, const Window& window, const LossWeights& weights, int64_t count,
          int64_t begin, int64_t end)
        : in_(in),
          window_(window),
          square_(float(weights.square)),
          error_scale_(float((1 - weights.ssim) / double(count))),
          ssim_scale_(float(-weights.ssim / double(count))),
          begin_(begin),
          end_(end),
          values_(3 * in.width),
          own_((end - begin + 15) / 16 * 16),
          stride_(own_ + 4 * kReach),
          origin_(begin - 2 * kReach),
          from_(std::max(origin_, int64_t(0))),
          to_(std::min(origin_ + stride_, values_)),
          memory_(size_t((7 * kRows + 10) * stride_)) {
        float* next = memory_.get();
        for (Ring* ring : {&x_, &y_, &keep_, &factors_, &d_m_, &d_2_, &d_xy_}) {
            *ring = {next, stride_};
            next += kRows * stride_;
        }
        for (auto& lines : line_)
            for (float*& line : lines) line = next, next += stride_;
        inside_ = next;
        factor_ = next + stride_;
        for (int64_t i = 0; i < stride_; i++) {
            const int64_t column = origin_ + i;
            const bool inside = column >= from_ && column < to_;
            inside_[i] = inside ? 1.0f : 0.0f;
            factor_[i] = inside && in.factor && !in.factor_is_image ? in.factor[column % 3] : 1.0f;
        }
    }

    // Rows [first, last) of the gradient, and their sums.
    void walk(int64_t first, int64_t last, float* grad, Sums* rows) {
        for (int64_t y = first - 2 * kRadius; y < last + 2 * kRadius; y += 2) {
            read(y);
            read(y + 1);
            const int64_t middle = y - kRadius, done = y - 2 * kRadius;
            if (middle >= first - kRadius) {
                blur_images_down(middle);
                for (int64_t row = middle; row < middle + 2; row++) {
                    const Sums sums = differentiate(row, line_[row - middle]);
                    if (row >= first && row < last) rows[row] = sums;
                }
            }
            if (done >= first) {
                blur_derivatives_down(done);
                for (int64_t row = done; row < std::min(done + 2, last); row++)
                    write(row, line_[row - done], grad);
            }
        }
    }

  private:
    // Row y of the images: zeros outside, and equal values in both where the mask is set.
    void read(int64_t y) {
        float *x = x_.row(y), *target = y_.row(y);
        const bool outside = y < 0 || y >= in_.height;
        const int64_t first = outside ? stride_ : from_ - origin_;
        for (float* row : {x, target}) {
            std::memset(row, 0, first * sizeof(float));
            if (!outside)
                std::memset(row + to_ - origin_, 0, (origin_ + stride_ - to_) * sizeof(float));
        }
        if (outside) return;
        const int64_t offset = y * values_ + from_, size = to_ - from_;
        const float* const factor = factors(y) + first;
        if (in_.factor_is_image)
            std::memcpy(factors_.row(y) + first, in_.factor + offset, size * sizeof(float));
        for (int64_t i = 0; i < size; i++) x[first + i] = in_.rendered[offset + i] * factor[i];
        if (in_.target_float)
            std::memcpy(target + first, in_.target_float + offset, size * sizeof(float));
        else
            for (int64_t i = 0; i < size; i++)
                target[first + i] = float(in_.target_bytes[offset + i]) / 255.0f;
        if (!in_.mask) return;
        float* const keep = keep_.row(y);
        std::memcpy(keep, inside_, stride_ * sizeof(float));
        for (int64_t i = from_; i < to_; i++)
            if (in_.mask[y * in_.width + i / 3])
                x[i - origin_] = target[i - origin_], keep[i - origin_] = 0;
    }

    // The factors of the rendered row y, undefined outside the image.
    const float* factors(int64_t y) const {
        return in_.factor_is_image ? factors_.row(y) : factor_;
    }

    // 1 for valid values, 0 outside the image and for masked values.
    const float* weights(int64_t y) const { return in_.mask ? keep_.row(y) : inside_; }

    // Adds a row's taps to the sums of two rows: kRadius below the first of kRows, and the next.
    SPLAT_INLINE void add_row(int row, Lanes value, Lanes (&sums)[2]) const {
        if (row < kTaps) sums[0] += value * window_.tap[std::abs(row - kRadius)];
        if (row > 0) sums[1] += value * window_.tap[std::abs(row - 1 - kRadius)];
    }

    // Vertically blurred m_x, m_y, m_2 and m_xy of rows y and y + 1, to line_.
    void blur_images_down(int64_t y) {
        const float *xs[kRows], *ys[kRows];
        for (int t = 0; t < kRows; t++)
            xs[t] = x_.row(y + t - kRadius), ys[t] = y_.row(y + t - kRadius);
        for (int64_t i = 0; i < stride_; i += kLanes) {
            Lanes m_x[2] = {}, m_y[2] = {}, m_2[2] = {}, m_xy[2] = {};
#pragma GCC unroll 12
            for (int t = 0; t < kRows; t++) {
                const Lanes a = load<Lanes>(xs[t] + i), b = load<Lanes>(ys[t] + i);
                add_row(t, a, m_x);
                add_row(t, b, m_y);
                add_row(t, a * a + b * b, m_2);
                add_row(t, a * b, m_xy);
            }
            for (int k = 0; k < 2; k++) {
                store(line_[k][0] + i, m_x[k]);
                store(line_[k][1] + i, m_y[k]);
                store(line_[k][2] + i, m_2[k]);
                store(line_[k][3] + i, m_xy[k]);
            }
        }
    }

    // Row y of the three derivatives, from the output of blur_images_down; returns the sums.
    Sums differentiate(int64_t y, float* const* line) {
        if (y < 0 || y >= in_.height) {
            for (const Ring& ring : {d_m_, d_2_, d_xy_})
                std::memset(ring.row(y), 0, stride_ * sizeof(float));
            return {};
        }
        const float *x = x_.row(y), *target = y_.row(y);
        float *to_m = d_m_.row(y), *to_2 = d_2_.row(y), *to_xy = d_xy_.row(y);
        const float* keep = weights(y);
        // 16 sums each, on every target
        Lanes error[16 / kLanes] = {}, ssim[16 / kLanes] = {}, squared[16 / kLanes] = {};
        for (int64_t i = kReach; i < stride_ - kReach; i += kLanes) {
            const Lanes m_x = blur_across(line[0] + i, window_);
            const Lanes m_y = blur_across(line[1] + i, window_);
            const Lanes squares = m_x * m_x + m_y * m_y, product = m_x * m_y;
            const Lanes a1 = 2.0f * product + kC1;
            const Lanes a2 = 2.0f * (blur_across(line[3] + i, window_) - product) + kC2;
            const Lanes b1 = squares + kC1;
            // Rounding may make variances negative.
            const Lanes variance = max(blur_across(line[2] + i, window_) - squares, Lanes{});
            const Lanes b2 = variance + kC2;
            const Lanes inverse = reciprocal(b1 * b2);
            const Lanes value = a1 * a2 * inverse;
            const Lanes over_b1 = value * b2 * inverse, over_b2 = value * b1 * inverse;
            const Lanes weight = load<Lanes>(keep + i);
            if (i >= 2 * kReach && i < 2 * kReach + own_) {
                const Lanes d = load<Lanes>(x + i) - load<Lanes>(target + i);
                const int64_t part = i / kLanes % (16 / kLanes);
                error[part] += weight * abs(d);
                ssim[part] += weight * value;
                squared[part] += weight * d * d;
            }
            const Lanes d_m = m_y * (a2 - a1) * inverse + m_x * (over_b2 - over_b1);
            store(to_m + i, weight * 2.0f * d_m);
            store(to_2 + i, -weight * over_b2);
            store(to_xy + i, weight * 2.0f * a1 * inverse);
        }
        Sums sums = {};
        float errors[16], ssims[16], squares[16];
        std::memcpy(errors, error, sizeof(errors));
        std::memcpy(ssims, ssim, sizeof(ssims));
        std::memcpy(squares, squared, sizeof(squares));
        for (int lane = 0; lane < 16; lane++) sums += {errors[lane], ssims[lane], squares[lane]};
        return sums;
    }

    // Vertically blurred derivatives of rows y and y + 1, to line_.
    void blur_derivatives_down(int64_t y) {
        const Ring rings[3] = {d_m_, d_2_, d_xy_};
        for (int k = 0; k < 3; k++) {
            const float* rows[kRows];
            for (int t = 0; t < kRows; t++) rows[t] = rings[k].row(y + t - kRadius);
            for (int64_t i = kReach; i < stride_ - kReach; i += kLanes) {
                Lanes sums[2] = {};
#pragma GCC unroll 12
                for (int t = 0; t < kRows; t++) add_row(t, load<Lanes>(rows[t] + i), sums);
                store(line_[0][k] + i, sums[0]);
                store(line_[1][k] + i, sums[1]);
            }
        }
    }

    // Row y of the gradient, from the output of blur_derivatives_down.
    void write(int64_t y, float* const* line, float* grad) {
        for (int64_t i = 2 * kReach; i < 2 * kReach + end_ - begin_; i += kLanes) {
            const Lanes a = load<Lanes>(x_.row(y) + i), b = load<Lanes>(y_.row(y) + i);
            const Lanes ssim = blur_across(line[0] + i, window_) +
                               2.0f * a * blur_across(line[1] + i, window_) +
                               b * blur_across(line[2] + i, window_);
            const Lanes one = broadcast<Lanes>(1.0f);
            const Lanes sign = keep(a > b, one) - keep(b > a, one);
            const Lanes out = load<Lanes>(weights(y) + i) * load<Lanes>(factors(y) + i) *
                              (error_scale_ * (sign + 2 * square_ * (a - b)) + ssim_scale_ * ssim);
            const int64_t column = begin_ + i - 2 * kReach;
            float* const to = grad + y * values_ + column;
            if (column + kLanes <= end_)
                store(to, out);
            else
                std::memcpy(to, &out, (end_ - column) * sizeof(float));
        }
    }

    const LossImages& in_;
    const Window& window_;
    const float square_, error_scale_, ssim_scale_;
    const int64_t begin_, end_, values_;
    const int64_t own_, stride_;        // floats of the strip in whole vectors; of a buffer's row
    const int64_t origin_, from_, to_;  // columns: a buffer's first, those that the image has
    const Scratch<float> memory_;
    Ring x_, y_, keep_, factors_, d_m_, d_2_, d_xy_;
    float *line_[2][4], *inside_, *factor_;
};

// Number of bands of each strip, such that threads which take one after another end earliest.
int64_t bands_of(int64_t strips, int64_t height, int64_t threads) {
    int64_t best = 1, least = std::numeric_limits<int64_t>::max();
    for (int64_t bands = 1; bands <= height / kBandRows; bands++) {
        const int64_t rounds = (strips * bands + threads - 1) / threads;
        const int64_t rows = rounds * ((height + bands - 1) / bands + (bands > 1 ? kMoreRows : 0));
        if (rows < least) best = bands, least = rows;
    }
    return best;
}

// Number of unmasked values.
int64_t count_values(const LossImages& in, int threads) {
    const int64_t pixels = in.width * in.height;
    if (!in.mask) return 3 * pixels;
    std::atomic<int64_t> counted{0};
    parallel_ranges(pixels, 1 << 16, threads, [&](int64_t begin, int64_t end) {
        int64_t here = 0;
        for (int64_t i = begin; i < end; i++) here += in.mask[i] == 0;
        counted += here;
    });
    return 3 * counted;
}

}  // namespace

LossValues l1_ssim(const LossImages& in, const LossWeights& weights, int threads, float* grad) {
    const Window window;
    const int64_t values = 3 * in.width, height = in.height, count = count_values(in, threads);
    if (count == 0) {
        std::memset(grad, 0, height * values * sizeof(float));
        return {0, 0, 1, 0};
    }
    // Strips depend on the image only, and rows are computed identically in any band: sums do not
    // depend on the number of threads.
    const int64_t strips = (values + kStripFloats - 1) / kStripFloats;
    const int64_t across = (values + 16 * strips - 1) / (16 * strips) * 16;
    const int64_t bands = bands_of(strips, height, threads);
    std::vector<Sums> rows(strips * height);
    parallel_for(strips * bands, 1, threads, [&](int64_t unit) {
        const int64_t number = unit / bands, band = unit % bands, begin = number * across;
        if (begin >= values) return;
        Strip strip(in, window, weights, count, begin, std::min(begin + across, values));
        strip.walk(height * band / bands, height * (band + 1) / bands, grad,
                   rows.data() + number * height);
    });
    Sums all = {};
    for (const Sums& row : rows) all += row;
    const double ssim = all.ssim / double(count), squared = all.squared / double(count);
    const double error = all.error / double(count) + weights.square * squared;
    return {(1 - weights.ssim) * error + weights.ssim * (1 - ssim), error, ssim, squared};
}

}  // namespace splat
