#include "adam.h"

#include <vector>

#include "constants.h"
#include "group.h"
#include "threads.h"

namespace splat {
namespace {

// Log scales are clamped to plus or minus this (1e-12 and 1e12); NaN becomes the minimum.
constexpr float kLnUnitMax = 28.0f;

// Gradients are clamped to this, so that their squares are finite in float32.
constexpr float kGradientMax = 1e18f;

// Gaussians of a range in groups, and vectors of a range: some microseconds of work, so that small
// scenes have ranges for many threads.
constexpr int64_t kGroupsPerRange = 64, kVectorsPerRange = 256;

constexpr float kLog2E = 1.4426950408889634f;

// Squared norm of a quaternion above which the square of a component may overflow float32.
constexpr float kNorm2Max = 1e37f;

template <int K>
void adam_rows(float* param, const float* grad, float* exp_avg, float* exp_avg_sq, int64_t rows,
               const AdamSettings& s, int threads) {
    const float rate = float(s.rates[0] * s.to_rate), eps = float(s.eps);
    const float beta1 = float(s.beta1), beta2 = float(s.beta2);
    const float rest1 = float(1 - s.beta1), rest2 = float((1 - s.beta2) / K);
    parallel_for((rows + kGroup - 1) / kGroup, kGroupsPerRange, threads, [&](int64_t number) {
        const int64_t first = kGroup * number;
        const int count = int(rows - first < kGroup ? rows - first : kGroup);
        f32x16 p[K], g[K], m[K], squares = {};
        read_rows(param + K * first, count, p);
        read_rows(grad + K * first, count, g);
        read_rows(exp_avg + K * first, count, m);
        for (int k = 0; k < K; k++) squares += g[k] * g[k];
        const f32x16 v = load_first(exp_avg_sq + first, count) * beta2 + squares * rest2;
        const f32x16 far = rate / (sqrt(v) * s.to_root + eps);
        for (int k = 0; k < K; k++) {
            m[k] = m[k] * beta1 + g[k] * rest1;
            p[k] -= far * m[k];
        }
        write_rows(p, count, param + K * first);
        write_rows(m, count, exp_avg + K * first);
        store_first(exp_avg_sq + first, v, count);
    });
}

}  // namespace

void adam_step(float* param, const float* grad, float* exp_avg, float* exp_avg_sq, int64_t count,
               const AdamSettings& s, int threads) {
    const float beta1 = float(s.beta1), beta2 = float(s.beta2), eps = float(s.eps);
    const float rest1 = float(1 - s.beta1), rest2 = float(1 - s.beta2);
    // The pattern of rates repeats after as many vectors as it has rates.
    std::vector<float> rates(16 * s.num_rates);
    for (size_t i = 0; i < rates.size(); i++)
        rates[i] = float(s.rates[i % s.num_rates] * s.to_rate);
    const auto update = [&](int64_t k, f32x16& p, f32x16 g, f32x16& m, f32x16& v) {
        m = m * beta1 + g * rest1;
        v = v * beta2 + g * g * rest2;
        p -= load<f32x16>(rates.data() + 16 * (k % s.num_rates)) * m / (sqrt(v) * s.to_root + eps);
    };
    const int64_t vectors = count / 16;
    parallel_for(vectors, kVectorsPerRange, threads, [&](int64_t k) {
        const int64_t i = 16 * k;
        f32x16 p = load<f32x16>(param + i), m = load<f32x16>(exp_avg + i);
        f32x16 v = load<f32x16>(exp_avg_sq + i);
        update(k, p, load<f32x16>(grad + i), m, v);
        store(param + i, p);
        store(exp_avg + i, m);
        store(exp_avg_sq + i, v);
    });
    const int64_t done = 16 * vectors, left = count - done;
    if (left == 0) return;
    f32x16 p = load_first(param + done, left), m = load_first(exp_avg + done, left);
    f32x16 v = load_first(exp_avg_sq + done, left);
    update(vectors, p, load_first(grad + done, left), m, v);
    store_first(param + done, p, left);
    store_first(exp_avg + done, m, left);
    store_first(exp_avg_sq + done, v, left);
}

void adam_step_rows(float* param, const float* grad, float* exp_avg, float* exp_avg_sq,
                    int64_t rows, int width, const AdamSettings& settings, int threads) {
    (width == 3 ? adam_rows<3> : adam_rows<4>)(param, grad, exp_avg, exp_avg_sq, rows, settings,
                                               threads);
}

void frame_adam(float* means, float* quats, const float* log_scales, const float* d_means,
                const float* d_quats, const FrameMoments& moments, int64_t rows,
                const AdamSettings& s, int threads) {
    const float mean_rate = float(s.rates[0] * s.to_rate);
    const float rotation_rate = float(s.rates[1] * s.to_rate);
    const float beta1 = float(s.beta1), beta2 = float(s.beta2), eps = float(s.eps);
    const float rest1 = float(1 - s.beta1), rest2 = float(1 - s.beta2);
    // Replaces gradients by Adam's normalised steps; moments are rows of 3.
    const auto normalised = [=](f32x16(&g)[3], float* exp_avg, float* exp_avg_sq, int count) {
        f32x16 m[3], v[3];
        read_rows(exp_avg, count, m);
        read_rows(exp_avg_sq, count, v);
        for (int k = 0; k < 3; k++) {
            g[k] = min(max(g[k], splat16(-kGradientMax)), splat16(kGradientMax));
            m[k] = m[k] * beta1 + g[k] * rest1;
            v[k] = v[k] * beta2 + g[k] * g[k] * rest2;
            g[k] = m[k] / (sqrt(v[k]) * s.to_root + eps);
        }
        write_rows(m, count, exp_avg);
        write_rows(v, count, exp_avg_sq);
    };
    parallel_for((rows + kGroup - 1) / kGroup, kGroupsPerRange, threads, [&](int64_t number) {
        const int64_t first = kGroup * number;
        const int count = int(rows - first < kGroup ? rows - first : kGroup);
        f32x16 mean[3], d_mean[3], q[4], d_quat[4], log2_scale[3], scale[3];
        read_rows(means + 3 * first, count, mean);
        read_rows(d_means + 3 * first, count, d_mean);
        read_rows(quats + 4 * first, count, q);
        read_rows(d_quats + 4 * first, count, d_quat);
        read_rows(log_scales + 3 * first, count, log2_scale);
        for (f32x16& power : log2_scale)
            power = min(select(power >= -kLnUnitMax, power, splat16(-kLnUnitMax)),
                        splat16(kLnUnitMax)) *
                    kLog2E;
        exp2(log2_scale, scale);

        // A quaternion of almost zero norm counts as the identity and is not updated.
        const f32x16 norm2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
        const Mask16 valid = (norm2 >= float(kQuatNorm2Min)) & (norm2 < kNorm2Max);
        const f32x16 norm = sqrt(select(valid, norm2, splat16(1.0f))), inverse = 1.0f / norm;
        f32x16 unit[4];
        for (int i = 0; i < 4; i++)
            unit[i] = select(valid, q[i] * inverse, splat16(i ? 0.0f : 1.0f));
        const f32x16 w = unit[0], x = unit[1], y = unit[2], z = unit[3];

        // Columns of R: the local axes.
        const f32x16 axes[3][3] = {
            {1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y + w * z), 2.0f * (x * z - w * y)},
            {2.0f * (x * y - w * z), 1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z + w * x)},
            {2.0f * (x * z + w * y), 2.0f * (y * z - w * x), 1.0f - 2.0f * (x * x + y * y)}};
        f32x16 along[3];
        for (int k = 0; k < 3; k++)
            along[k] = scale[k] *
                       (axes[k][0] * d_mean[0] + axes[k][1] * d_mean[1] + axes[k][2] * d_mean[2]);
        normalised(along, moments.mean + 3 * first, moments.mean_sq + 3 * first, count);
        for (int k = 0; k < 3; k++) along[k] *= mean_rate * scale[k];
        for (int i = 0; i < 3; i++)
            mean[i] -= axes[0][i] * along[0] + axes[1][i] * along[1] + axes[2][i] * along[2];

        // q i, q j and q k: the tangents of rotations about the local axes.
        const f32x16 tangents[3][4] = {{-x, w, z, -y}, {-y, -z, w, x}, {-z, y, -x, w}};
        f32x16 about[3];
        for (int k = 0; k < 3; k++) {
            const f32x16(&t)[4] = tangents[k];
            about[k] = keep(valid, norm * (t[0] * d_quat[0] + t[1] * d_quat[1] + t[2] * d_quat[2] +
                                           t[3] * d_quat[3]));
        }
        normalised(about, moments.rotation + 3 * first, moments.rotation_sq + 3 * first, count);
        for (int k = 0; k < 3; k++) about[k] = keep(valid, rotation_rate * norm * about[k]);
        for (int i = 0; i < 4; i++)
            q[i] -=
                tangents[0][i] * about[0] + tangents[1][i] * about[1] + tangents[2][i] * about[2];
        write_rows(mean, count, means + 3 * first);
        write_rows(q, count, quats + 4 * first);
    });
}

}  // namespace splat
