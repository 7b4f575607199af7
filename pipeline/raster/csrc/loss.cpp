// The window is a product of two rows of 11 taps, and a row of an (H, W, 3) image is a flat
// array whose taps lie 3 apart: all is done on flat rows of vectors. Images are copied into a
// frame of zeros 5 pixels wide and padded to whole vectors, so that no row has a tail.
//
// With m_x, m_y, m_xx, m_yy, m_xy the blurred x, y, x^2, y^2, xy,
//     SSIM = (2 m_x m_y + C1)(2 (m_xy - m_x m_y) + C2) / ((m_x^2 + m_y^2 + C1)(v_x + v_y + C2)),
//     dL/dx = blur(dL/dm_x) + 2 x blur(dL/dm_xx) + y blur(dL/dm_xy),
// as the window is even. First loop: blur vertically, then the row horizontally, then the three
// derivatives; second loop: the same blur of those.

#include "loss.h"

#include <cmath>
#include <vector>

#include "memory.h"
#include "simd.h"

namespace splat {
namespace {

constexpr int kRadius = 5;           // of the window, pixels
constexpr int kFrame = 3 * kRadius;  // the frame's left edge, floats
constexpr float kC1 = 1e-4f, kC2 = 9e-4f;

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

// Rows of floats with the frame around them; row 0 is the image's first.
struct Plane {
    float* first;
    int64_t stride;

    float* row(int64_t y) const { return first + y * stride; }
    void clear(int64_t y, int64_t from, int64_t to) const {
        std::memset(row(y) + from, 0, (to - from) * sizeof(float));
    }
};

SPLAT_INLINE f32x16 blur_across(const float* centre, const Window& k) {
    f32x16 sum = load<f32x16>(centre) * k.tap[0];
    for (int t = 1; t <= kRadius; t++)
        sum += (load<f32x16>(centre - 3 * t) + load<f32x16>(centre + 3 * t)) * k.tap[t];
    return sum;
}

}  // namespace

LossValues l1_ssim(const LossImages& in, double ssim_weight, int threads, float* grad) {
    const Window window;
    const int64_t width = in.width, height = in.height, values = 3 * width;
    // Vectors of a row start at kFrame; the last one, and its taps, must end inside the stride.
    const int64_t vectors = (values + 15) / 16;
    const int64_t stride = (kFrame + 16 * vectors + kFrame + 15) / 16 * 16;
    const bool masked = in.mask != nullptr;
    const int64_t plane = (height + 2 * kRadius) * stride;
    const Scratch<float> scratch(size_t((masked ? 6 : 5) * plane + stride));
    float* const memory = scratch.get() + kRadius * stride;
    const Plane x = {memory, stride}, y = {memory + plane, stride};
    const Plane d_m = {memory + 2 * plane, stride}, d_xx = {memory + 3 * plane, stride};
    const Plane d_xy = {memory + 4 * plane, stride};
    // 1 where a value counts: a plane with a mask, one row for all without.
    const Plane keep = {memory + 5 * plane - (masked ? 0 : kRadius * stride), stride};
    const auto keep_row = [&](int64_t r) { return keep.row(masked ? r : 0); };
    std::vector<int64_t> counted(height);
    std::vector<double> row_l1(height), row_ssim(height);

    for (int64_t r : {-5, -4, -3, -2, -1})
        for (const Plane& p : {x, y, d_m, d_xx, d_xy})
            p.clear(r, 0, stride), p.clear(height - 1 - r, 0, stride);
    if (!masked) {
        keep.clear(0, 0, stride);
        for (int64_t i = 0; i < values; i++) keep.row(0)[kFrame + i] = 1;
    }

#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t r = 0; r < height; r++) {
        for (const Plane& p : {x, y}) p.clear(r, 0, kFrame), p.clear(r, kFrame + values, stride);
        float *to_x = x.row(r) + kFrame, *to_y = y.row(r) + kFrame;
        const float* rendered = in.rendered + r * values;
        if (in.target_float)
            std::memcpy(to_y, in.target_float + r * values, values * sizeof(float));
        else
            for (int64_t i = 0; i < values; i++)
                to_y[i] = float(in.target_bytes[r * values + i]) / 255.0f;
        std::memcpy(to_x, rendered, values * sizeof(float));
        counted[r] = width;
        if (masked) {
            keep.clear(r, 0, stride);
            for (int64_t i = 0; i < width; i++) {
                const bool out = in.mask[r * width + i] != 0;
                counted[r] -= out;
                for (int64_t c = 3 * i; c < 3 * i + 3; c++) {
                    keep.row(r)[kFrame + c] = out ? 0 : 1;
                    if (out) to_x[c] = to_y[c];
                }
            }
        }
    }
    int64_t count = 0;
    for (int64_t n : counted) count += 3 * n;
    if (count == 0) {
        std::memset(grad, 0, height * values * sizeof(float));
        return {0, 0, 1};
    }

#pragma omp parallel num_threads(threads)
    {
        std::vector<float> buffer(5 * stride);
        float* line[5];
        for (int k = 0; k < 5; k++) line[k] = buffer.data() + k * stride;

#pragma omp for schedule(static)
        for (int64_t r = 0; r < height; r++) {
            for (int64_t i = 0; i < stride; i += 16) {
                const f32x16 a = load<f32x16>(x.row(r) + i), b = load<f32x16>(y.row(r) + i);
                f32x16 m_x = a * window.tap[0], m_y = b * window.tap[0];
                f32x16 m_xx = a * m_x, m_yy = b * m_y, m_xy = a * m_y;
                for (int t = 1; t <= kRadius; t++) {
                    const f32x16 a0 = load<f32x16>(x.row(r - t) + i);
                    const f32x16 a1 = load<f32x16>(x.row(r + t) + i);
                    const f32x16 b0 = load<f32x16>(y.row(r - t) + i);
                    const f32x16 b1 = load<f32x16>(y.row(r + t) + i);
                    m_x += (a0 + a1) * window.tap[t];
                    m_y += (b0 + b1) * window.tap[t];
                    m_xx += (a0 * a0 + a1 * a1) * window.tap[t];
                    m_yy += (b0 * b0 + b1 * b1) * window.tap[t];
                    m_xy += (a0 * b0 + a1 * b1) * window.tap[t];
                }
                store(line[0] + i, m_x);
                store(line[1] + i, m_y);
                store(line[2] + i, m_xx);
                store(line[3] + i, m_yy);
                store(line[4] + i, m_xy);
            }
            f32x16 l1 = {}, ssim = {};
            for (const Plane& p : {d_m, d_xx, d_xy})
                p.clear(r, 0, kFrame), p.clear(r, kFrame + values, stride);
            for (int64_t i = kFrame; i < kFrame + values; i += 16) {
                const f32x16 m_x = blur_across(line[0] + i, window);
                const f32x16 m_y = blur_across(line[1] + i, window);
                const f32x16 squares = m_x * m_x + m_y * m_y, product = m_x * m_y;
                const f32x16 a1 = 2.0f * product + kC1;
                const f32x16 a2 = 2.0f * (blur_across(line[4] + i, window) - product) + kC2;
                const f32x16 b1 = squares + kC1;
                const f32x16 b2 = blur_across(line[2] + i, window) +
                                  blur_across(line[3] + i, window) - squares + kC2;
                const f32x16 inverse = 1.0f / (b1 * b2);
                const f32x16 value = a1 * a2 * inverse;
                const f32x16 over_b1 = value * b2 * inverse, over_b2 = value * b1 * inverse;
                const f32x16 weight = load<f32x16>(keep_row(r) + i);
                l1 += weight * abs(load<f32x16>(x.row(r) + i) - load<f32x16>(y.row(r) + i));
                ssim += weight * value;
                store(d_m.row(r) + i,
                      weight * 2.0f * (m_y * (a2 - a1) * inverse + m_x * (over_b2 - over_b1)));
                store(d_xx.row(r) + i, -weight * over_b2);
                store(d_xy.row(r) + i, weight * 2.0f * a1 * inverse);
            }
            row_l1[r] = row_ssim[r] = 0;
            for (int lane = 0; lane < 16; lane++) row_l1[r] += l1[lane], row_ssim[r] += ssim[lane];
        }

        const float l1_scale = float((1 - ssim_weight) / double(count));
        const float ssim_scale = float(-ssim_weight / double(count));
#pragma omp for schedule(static)
        for (int64_t r = 0; r < height; r++) {
            const Plane planes[3] = {d_m, d_xx, d_xy};
            for (int k = 0; k < 3; k++)
                for (int64_t i = 0; i < stride; i += 16) {
                    f32x16 sum = load<f32x16>(planes[k].row(r) + i) * window.tap[0];
                    for (int t = 1; t <= kRadius; t++)
                        sum += (load<f32x16>(planes[k].row(r - t) + i) +
                                load<f32x16>(planes[k].row(r + t) + i)) *
                               window.tap[t];
                    store(line[k] + i, sum);
                }
            for (int64_t i = kFrame; i < kFrame + values; i += 16) {
                const f32x16 a = load<f32x16>(x.row(r) + i), b = load<f32x16>(y.row(r) + i);
                const f32x16 ssim = blur_across(line[0] + i, window) +
                                    2.0f * a * blur_across(line[1] + i, window) +
                                    b * blur_across(line[2] + i, window);
                const f32x16 sign = select(lt(b, a), splat16(1), splat16(0)) -
                                    select(lt(a, b), splat16(1), splat16(0));
                const f32x16 out =
                    load<f32x16>(keep_row(r) + i) * (l1_scale * sign + ssim_scale * ssim);
                const int64_t left = kFrame + values - i;
                std::memcpy(grad + r * values + i - kFrame, &out,
                            (left < 16 ? left : 16) * sizeof(float));
            }
        }
    }
    double l1 = 0, ssim = 0;
    for (int64_t r = 0; r < height; r++) l1 += row_l1[r], ssim += row_ssim[r];
    l1 /= double(count);
    ssim /= double(count);
    return {(1 - ssim_weight) * l1 + ssim_weight * (1 - ssim), l1, ssim};
}

}  // namespace splat
