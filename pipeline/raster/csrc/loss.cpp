// The window is a product of two rows of 11 taps, and a row of an (H, W, 3) image is a flat array
// whose taps lie 3 apart: all is done on flat rows of vectors.
//
// With m_x, m_y, m_2, m_xy the blurred x, y, x^2 + y^2, x y,
//     SSIM = (2 m_x m_y + C1)(2 (m_xy - m_x m_y) + C2)
//            / ((m_x^2 + m_y^2 + C1)(m_2 - m_x^2 - m_y^2 + C2)),
//     dL/dx = blur(dL/dm_x) + 2 x blur(dL/dm_2) + y blur(dL/dm_xy),
// as the window is even. A strip of the image is walked from top to bottom once, with the last 12
// rows of the two images and of the three derivatives at hand, so that they stay in the cache: the
// derivatives follow the images 5 rows behind, and the gradient follows those. Two rows are found
// at a time, for they look at nearly the same ones; in the same order, so that a row's sums do not
// depend on which of the two it is.

#include "loss.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "memory.h"
#include "simd.h"
#include "threads.h"

namespace splat {
namespace {

constexpr int kRadius = 5, kTaps = 2 * kRadius + 1;  // of the window, pixels
constexpr int kRows = kTaps + 1;                     // what two rows look at
constexpr int kReach = 16;  // how far a blur looks to each side, floats: 3 kRadius in vectors
constexpr float kC1 = 1e-4f, kC2 = 9e-4f;

// Floats of a strip's row, at most: the rows at hand take some 300 KB, less than half an L2 cache.
constexpr int64_t kStripFloats = 1024;

// Fewest rows for a thread to begin in the middle of a strip: it goes through 10 more on each side.
constexpr int64_t kBandRows = 32;

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

// Lanes [kFirst, kFirst + 16) of two vectors in a row.
template <int kFirst>
SPLAT_INLINE f32x16 lanes_from(f32x16 left, f32x16 right) {
    constexpr int k = kFirst;
    return __builtin_shuffle(left, right,
                             i32x16{k, k + 1, k + 2, k + 3, k + 4, k + 5, k + 6, k + 7, k + 8,
                                    k + 9, k + 10, k + 11, k + 12, k + 13, k + 14, k + 15});
}

// Shifted from three whole vectors: a load of ten others, each across two cache lines, takes twice
// as long.
SPLAT_INLINE f32x16 blur_across(const float* centre, const Window& k) {
    const f32x16 left = load<f32x16>(centre - 16), here = load<f32x16>(centre),
                 right = load<f32x16>(centre + 16);
    f32x16 sum = here * k.tap[0];
    sum += (lanes_from<13>(left, here) + lanes_from<3>(here, right)) * k.tap[1];
    sum += (lanes_from<10>(left, here) + lanes_from<6>(here, right)) * k.tap[2];
    sum += (lanes_from<7>(left, here) + lanes_from<9>(here, right)) * k.tap[3];
    sum += (lanes_from<4>(left, here) + lanes_from<12>(here, right)) * k.tap[4];
    sum += (lanes_from<1>(left, here) + lanes_from<15>(here, right)) * k.tap[5];
    return sum;
}
static_assert(kRadius == 5 && kReach == 16, "blur_across");

// The last kRows rows of something.
struct Ring {
    float* memory;
    int64_t stride;

    float* row(int64_t y) const { return memory + (y + 2 * kRows) % kRows * stride; }
};

// The columns [begin, end) of an image's rows of `values` floats. Its buffers hold 2 kReach floats
// more on each side: what the blur of a blur looks at.
class Strip {
  public:
    // `count`: the values that the means are over.
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
          memory_(size_t((6 * kRows + 8) * stride_)) {
        float* next = memory_.get();
        for (Ring* ring : {&x_, &y_, &keep_, &d_m_, &d_2_, &d_xy_}) {
            *ring = {next, stride_};
            next += kRows * stride_;
        }
        for (auto& lines : line_)
            for (float*& line : lines) line = next, next += stride_;
    }

    // Rows [first, last) of the gradient, and their sums.
    void walk(int64_t first, int64_t last, float* grad, double* row_error, double* row_ssim) {
        for (int64_t y = first - 2 * kRadius; y < last + 2 * kRadius; y += 2) {
            read(y);
            read(y + 1);
            const int64_t middle = y - kRadius, done = y - 2 * kRadius;
            if (middle >= first - kRadius) {
                blur_images_down(middle);
                for (int64_t row = middle; row < middle + 2; row++) {
                    const Sums sums = differentiate(row, line_[row - middle]);
                    if (row >= first && row < last)
                        row_error[row] = sums.error, row_ssim[row] = sums.ssim;
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
    struct Sums {
        double error, ssim;
    };

    // Row y of the images, zeros beyond them and, in both, nothing to tell where a mask hides them.
    void read(int64_t y) {
        float *x = x_.row(y), *target = y_.row(y), *keep = keep_.row(y);
        for (float* row : {x, target, keep}) std::memset(row, 0, stride_ * sizeof(float));
        if (y < 0 || y >= in_.height) return;
        const int64_t origin = begin_ - 2 * kReach;  // column of a buffer's first float
        const int64_t from = std::max(origin, int64_t(0));
        const int64_t to = std::min(origin + stride_, values_);
        const int64_t offset = y * values_;
        std::memcpy(x + from - origin, in_.rendered + offset + from, (to - from) * sizeof(float));
        if (in_.target_float)
            std::memcpy(target + from - origin, in_.target_float + offset + from,
                        (to - from) * sizeof(float));
        else
            for (int64_t i = from; i < to; i++)
                target[i - origin] = float(in_.target_bytes[offset + i]) / 255.0f;
        for (int64_t i = from; i < to; i++) keep[i - origin] = 1;
        if (!in_.mask) return;
        for (int64_t i = from; i < to; i++)
            if (in_.mask[y * in_.width + i / 3])
                x[i - origin] = target[i - origin], keep[i - origin] = 0;
    }

    // Adds a row's taps to two sums, of the row kRadius below the first of kRows and of the next.
    SPLAT_INLINE void add_row(int row, f32x16 value, f32x16 (&sums)[2]) const {
        if (row < kTaps) sums[0] += value * window_.tap[std::abs(row - kRadius)];
        if (row > 0) sums[1] += value * window_.tap[std::abs(row - 1 - kRadius)];
    }

    // m_x, m_y, m_2 and m_xy of rows y and y + 1, blurred from top to bottom alone, to line_.
    void blur_images_down(int64_t y) {
        const float *xs[kRows], *ys[kRows];
        for (int t = 0; t < kRows; t++)
            xs[t] = x_.row(y + t - kRadius), ys[t] = y_.row(y + t - kRadius);
        for (int64_t i = 0; i < stride_; i += 16) {
            f32x16 m_x[2] = {}, m_y[2] = {}, m_2[2] = {}, m_xy[2] = {};
#pragma GCC unroll 12
            for (int t = 0; t < kRows; t++) {
                const f32x16 a = load<f32x16>(xs[t] + i), b = load<f32x16>(ys[t] + i);
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

    // Row y of the three derivatives, from what blur_images_down left; its own sums of |x - y| and
    // SSIM.
    Sums differentiate(int64_t y, float* const* line) {
        if (y < 0 || y >= in_.height) {
            for (const Ring& ring : {d_m_, d_2_, d_xy_})
                std::memset(ring.row(y), 0, stride_ * sizeof(float));
            return {0, 0};
        }
        const float *x = x_.row(y), *target = y_.row(y);
        float *to_m = d_m_.row(y), *to_2 = d_2_.row(y), *to_xy = d_xy_.row(y);
        const float* keep = keep_.row(y);
        f32x16 error = {}, ssim = {};
        for (int64_t i = kReach; i < stride_ - kReach; i += 16) {
            const f32x16 m_x = blur_across(line[0] + i, window_);
            const f32x16 m_y = blur_across(line[1] + i, window_);
            const f32x16 squares = m_x * m_x + m_y * m_y, product = m_x * m_y;
            const f32x16 a1 = 2.0f * product + kC1;
            const f32x16 a2 = 2.0f * (blur_across(line[3] + i, window_) - product) + kC2;
            const f32x16 b1 = squares + kC1;
            // No variance is negative, whatever rounding says.
            const f32x16 variance = max(blur_across(line[2] + i, window_) - squares, f32x16{});
            const f32x16 b2 = variance + kC2;
            const f32x16 inverse = reciprocal(b1 * b2);
            const f32x16 value = a1 * a2 * inverse;
            const f32x16 over_b1 = value * b2 * inverse, over_b2 = value * b1 * inverse;
            const f32x16 weight = load<f32x16>(keep + i);
            if (i >= 2 * kReach && i < 2 * kReach + own_) {
                const f32x16 d = load<f32x16>(x + i) - load<f32x16>(target + i);
                error += weight * (abs(d) + square_ * d * d);
                ssim += weight * value;
            }
            const f32x16 d_m = m_y * (a2 - a1) * inverse + m_x * (over_b2 - over_b1);
            store(to_m + i, weight * 2.0f * d_m);
            store(to_2 + i, -weight * over_b2);
            store(to_xy + i, weight * 2.0f * a1 * inverse);
        }
        Sums sums = {};
        for (int lane = 0; lane < 16; lane++) sums.error += error[lane], sums.ssim += ssim[lane];
        return sums;
    }

    // The derivatives of rows y and y + 1, blurred from top to bottom alone, to line_.
    void blur_derivatives_down(int64_t y) {
        const Ring rings[3] = {d_m_, d_2_, d_xy_};
        for (int k = 0; k < 3; k++) {
            const float* rows[kRows];
            for (int t = 0; t < kRows; t++) rows[t] = rings[k].row(y + t - kRadius);
            for (int64_t i = kReach; i < stride_ - kReach; i += 16) {
                f32x16 sums[2] = {};
#pragma GCC unroll 12
                for (int t = 0; t < kRows; t++) add_row(t, load<f32x16>(rows[t] + i), sums);
                store(line_[0][k] + i, sums[0]);
                store(line_[1][k] + i, sums[1]);
            }
        }
    }

    // Row y of the gradient, from what blur_derivatives_down left.
    void write(int64_t y, float* const* line, float* grad) {
        for (int64_t i = 2 * kReach; i < 2 * kReach + own_; i += 16) {
            const f32x16 a = load<f32x16>(x_.row(y) + i), b = load<f32x16>(y_.row(y) + i);
            const f32x16 ssim = blur_across(line[0] + i, window_) +
                                2.0f * a * blur_across(line[1] + i, window_) +
                                b * blur_across(line[2] + i, window_);
            const f32x16 sign =
                select(lt(b, a), splat16(1), splat16(0)) - select(lt(a, b), splat16(1), splat16(0));
            const f32x16 out = load<f32x16>(keep_.row(y) + i) *
                               (error_scale_ * (sign + 2 * square_ * (a - b)) + ssim_scale_ * ssim);
            const int64_t column = begin_ + i - 2 * kReach;
            std::memcpy(grad + y * values_ + column, &out,
                        std::min(end_ - column, int64_t(16)) * sizeof(float));
        }
    }

    const LossImages& in_;
    const Window& window_;
    const float square_, error_scale_, ssim_scale_;
    const int64_t begin_, end_, values_;
    const int64_t own_, stride_;  // floats of the strip in whole vectors; of a buffer's row
    const Scratch<float> memory_;
    Ring x_, y_, keep_, d_m_, d_2_, d_xy_;
    float* line_[2][4];
};

// Values that no mask hides.
int64_t count_values(const LossImages& in) {
    const int64_t pixels = in.width * in.height;
    if (!in.mask) return 3 * pixels;
    int64_t counted = 0;
    for (int64_t i = 0; i < pixels; i++) counted += in.mask[i] == 0;
    return 3 * counted;
}

}  // namespace

LossValues l1_ssim(const LossImages& in, const LossWeights& weights, int threads, float* grad) {
    const Window window;
    const int64_t values = 3 * in.width, height = in.height, count = count_values(in);
    if (count == 0) {
        std::memset(grad, 0, height * values * sizeof(float));
        return {0, 0, 1};
    }
    // Strips follow from the image alone, so that sums do not depend on the threads; every row is
    // found in the same way in whatever band it lies.
    const int64_t strips = (values + kStripFloats - 1) / kStripFloats;
    const int64_t across = (values + 16 * strips - 1) / (16 * strips) * 16;
    const int64_t bands = std::max(std::min(int64_t(threads), height / kBandRows), int64_t(1));
    std::vector<double> row_error(strips * height), row_ssim(strips * height);
    parallel_for(strips * bands, 1, threads, [&](int64_t unit) {
        const int64_t number = unit / bands, band = unit % bands, begin = number * across;
        if (begin >= values) return;
        Strip strip(in, window, weights, count, begin, std::min(begin + across, values));
        strip.walk(height * band / bands, height * (band + 1) / bands, grad,
                   row_error.data() + number * height, row_ssim.data() + number * height);
    });
    double error = 0, ssim = 0;
    for (double sum : row_error) error += sum;
    for (double sum : row_ssim) ssim += sum;
    error /= double(count);
    ssim /= double(count);
    return {(1 - weights.ssim) * error + weights.ssim * (1 - ssim), error, ssim};
}

}  // namespace splat
