#include "project.h"

#include <cmath>

#include "project_math.h"
#include "sh.h"

namespace splat {
namespace {

constexpr double kHalfLog2e = 0.72134752044448170368;  // log2(e) / 2

struct Center {
    double xyz[3];
};

// The camera's centre in the world, -R^T t.
Center camera_center(const View& view) {
    Center c;
    for (int i = 0; i < 3; i++)
        c.xyz[i] =
            -(view.rotation[i] * view.translation[0] + view.rotation[3 + i] * view.translation[1] +
              view.rotation[6 + i] * view.translation[2]);
    return c;
}

// Field `k` of eight neighbours in an array of `width` floats each.
SPLAT_INLINE Lanes gather(const float* from, int width, int k) {
    const float* p = from + k;
    return Lanes{p[0],         p[width],     p[2 * width], p[3 * width],
                 p[4 * width], p[5 * width], p[6 * width], p[7 * width]};
}

// Eight Gaussians from `first` on; zeros, which no quaternion survives, beyond the end.
SPLAT_INLINE Inputs load_inputs(const Gaussians& g, int64_t first) {
    const float *means = g.means + 3 * first, *log_scales = g.log_scales + 3 * first;
    const float *quats = g.quats + 4 * first, *opacity_logits = g.opacity_logits + first;
    float padded[4][4 * kProjectLanes];
    if (g.count - first < kProjectLanes) {
        const size_t n = size_t(g.count - first) * sizeof(float);
        std::memset(padded, 0, sizeof(padded));
        means = static_cast<float*>(std::memcpy(padded[0], means, 3 * n));
        log_scales = static_cast<float*>(std::memcpy(padded[1], log_scales, 3 * n));
        quats = static_cast<float*>(std::memcpy(padded[2], quats, 4 * n));
        opacity_logits = static_cast<float*>(std::memcpy(padded[3], opacity_logits, n));
    }
    return {{gather(means, 3, 0), gather(means, 3, 1), gather(means, 3, 2)},
            {gather(log_scales, 3, 0), gather(log_scales, 3, 1), gather(log_scales, 3, 2)},
            {gather(quats, 4, 0), gather(quats, 4, 1), gather(quats, 4, 2), gather(quats, 4, 3)},
            gather(opacity_logits, 1, 0)};
}

// -1 in the lanes whose every input is finite and whose quaternion has a direction.
i64x8 usable(const Inputs& in, const Projected& p) {
    const Lanes sum = (in.mean.x + in.mean.y + in.mean.z) +
                      (in.log_scale.x + in.log_scale.y + in.log_scale.z) +
                      (p.norm2 + in.opacity_logit);
    // float32 values cannot overflow a float64 sum: it is finite when they are.
    return i64x8(sum - sum == 0.0) & i64x8(p.norm2 >= kQuatNorm2Min);
}

// Gaussians that are worked on at once: the lanes of a float32 vector, and two of float64.
constexpr int kBlockSize = 16;

struct Block {
    double x[16], y[16], depth[16], uu[16], uw[16], ww[16], log2_opacity[16], extent_x[16],
        extent_y[16], radius[16];
    int64_t usable[16], in_front[16], sound[16], reaches[16];
};

// The directions from the camera's centre to eight Gaussians, in lanes `at` to `at` + 7.
struct DirectionLanes {
    alignas(64) float x[16] = {}, y[16] = {}, z[16] = {}, inv_length[16] = {};

    SPLAT_INLINE void set(const Vec3& mean, const Center& center, int at) {
        const Vec3 d = {mean.x - center.xyz[0], mean.y - center.xyz[1], mean.z - center.xyz[2]};
        const Lanes length = sqrt(dot(d, d));
        const Lanes inv = select(length > 0.0, 1.0 / length, splat8(0.0));
        const Lanes all[4] = {d.x * inv, d.y * inv, d.z * inv, inv};
        float* const to[4] = {x, y, z, inv_length};
        for (int k = 0; k < 4; k++) store(to[k] + at, __builtin_convertvector(all[k], f32x8));
    }
    SPLAT_INLINE Directions get() const {
        return {load<f32x16>(x), load<f32x16>(y), load<f32x16>(z), load<f32x16>(inv_length)};
    }
};

void project_half(const Inputs& in, const View& view, int at, Block& out) {
    const Projected p = project(in, view);
    const Lanes log2_opacity = log2(p.opacity);
    const Lanes reach = log2_opacity - double(kLog2AlphaMin);
    // d^T inverse(cov) d at alpha_min, and its root
    const Lanes reach2 = clamp(reach, 0.0, 16.0) * (1 / kHalfLog2e), root = sqrt(reach2);
    const Lanes inv_yy = 1.0 / p.yy;
    const Lanes uu = sqrt(kHalfLog2e * p.yy / p.det);
    const Lanes half_difference = 0.5 * (p.xx - p.yy);
    const Lanes longest =
        0.5 * (p.xx + p.yy) + sqrt(half_difference * half_difference + p.xy * p.xy);
    store(out.x + at, p.x);
    store(out.y + at, p.y);
    store(out.depth + at, p.cam.z);
    store(out.uu + at, uu);
    store(out.uw + at, -uu * p.xy * inv_yy);
    store(out.ww + at, sqrt(kHalfLog2e * inv_yy));
    store(out.log2_opacity + at, log2_opacity);
    store(out.extent_x + at, root * sqrt(p.xx));
    store(out.extent_y + at, root * sqrt(p.yy));
    store(out.radius + at, root * sqrt(longest));
    store(out.usable + at, usable(in, p));
    store(out.in_front + at, i64x8(p.cam.z > view.near));
    // The centre may lie anywhere, but the depth is kept in float32.
    store(out.sound + at, i64x8(p.det > 0.0) & i64x8(p.xx < kCovarianceMax) &
                              i64x8(p.yy < kCovarianceMax) & i64x8(p.x - p.x == 0.0) &
                              i64x8(p.y - p.y == 0.0) & i64x8(p.cam.z < 1e38));
    store(out.reaches + at, i64x8(reach > 0.0));
}

// Whether [center - extent, center + extent] holds the centre of a pixel among `size`.
bool holds_pixel(double center, double extent, int64_t size) {
    const double first = std::ceil(center - extent - 0.5);
    const double last = std::floor(center + extent - 0.5);
    return (first > 0 ? first : 0) <= (last < size - 1 ? last : size - 1);
}

}  // namespace

ProjectCounts project_view(const Gaussians& in, const View& view, int threads, Record* records,
                           float* radii) {
    const Center center = camera_center(view);
    const int64_t blocks = (in.count + kBlockSize - 1) / kBlockSize;
    const int64_t sh_width = 3 * in.sh_coefficients;
    int64_t visible = 0, dropped = 0;
#pragma omp parallel for num_threads(threads) schedule(static) reduction(+ : visible, dropped)
    for (int64_t block = 0; block < blocks; block++) {
        const int64_t first = block * kBlockSize;
        const int lanes = int(in.count - first < kBlockSize ? in.count - first : kBlockSize);
        Block b;
        DirectionLanes directions;
        for (int at = 0; at < lanes; at += kProjectLanes) {
            const Inputs inputs = load_inputs(in, first + at);
            project_half(inputs, view, at, b);
            directions.set(inputs.mean, center, at);
        }
        uint32_t drawn = 0;
        for (int lane = 0; lane < lanes; lane++) {
            radii[first + lane] = 0;
            if (!b.usable[lane] || (b.in_front[lane] && !b.sound[lane]))
                dropped++;
            else if (b.in_front[lane] && b.reaches[lane] &&
                     holds_pixel(b.x[lane], b.extent_x[lane], view.width) &&
                     holds_pixel(b.y[lane], b.extent_y[lane], view.height))
                drawn |= 1u << lane;
        }
        if (!drawn) continue;
        ShBlock sh;
        sh.read(view.sh_degree, in.sh + sh_width * first, sh_width, drawn);
        f32x16 rgb[3];
        const uint32_t sane = sh_colors(directions.get(), view.sh_degree, sh, kShMax, rgb);
        alignas(64) float channels[3][kBlockSize];
        for (int c = 0; c < 3; c++) store(channels[c], rgb[c]);
        dropped += __builtin_popcount(drawn & ~sane);
        drawn &= sane;
        visible += __builtin_popcount(drawn);
        for (; drawn; drawn &= drawn - 1) {
            const int lane = __builtin_ctz(drawn);
            Record r = {};
            r.x = b.x[lane];
            r.y = b.y[lane];
            r.uu = float(b.uu[lane]);
            r.uw = float(b.uw[lane]);
            r.ww = float(b.ww[lane]);
            r.log2_opacity = float(b.log2_opacity[lane]);
            for (int c = 0; c < 3; c++) r.rgb[c] = channels[c][lane];
            r.depth = float(b.depth[lane]);
            r.extent_x = float(b.extent_x[lane]);
            r.extent_y = float(b.extent_y[lane]);
            records[first + lane] = r;
            radii[first + lane] = float(b.radius[lane]);
        }
    }
    return {visible, dropped};
}

namespace {

// The sums of one Gaussian's slots, by Moment.
struct Sums {
    double moment[kSlotFloats];
};

Sums sum_slots(const Slots& slots, const float* slot_gradients) {
    Lanes low = {}, high = {};
    for (uint32_t s = 0; s < slots.count; s++) {
        const float* from = slot_gradients + int64_t(slots.first + s) * kSlotFloats;
        low += __builtin_convertvector(load<f32x8>(from), Lanes);
        high += __builtin_convertvector(load<f32x8>(from + 8), Lanes);
    }
    double lanes[kSlotFloats];
    store(lanes, low);
    store(lanes + 8, high);
    Sums sums;
    for (int m = 0; m < 12; m++) sums.moment[m] = lanes[sum_lane(m)];
    return sums;
}

// From the moments of y = (u, w) to the image plane. ln alpha = ln opacity - ln 2 (u^2 + w^2) and
// y = L^T d with L = [uu 0; uw ww], so d(ln alpha) / d(centre) = 2 ln 2 L y.
// Of eight Gaussians from lane `at` on.
ImageGradients image_gradients(const double (*m)[kBlockSize], const Record* const* records,
                               int at) {
    double uu[8], uw[8], ww[8];
    for (int lane = 0; lane < kProjectLanes; lane++) {
        const Record* r = records[at + lane];
        uu[lane] = r ? r->uu : 0;
        uw[lane] = r ? r->uw : 0;
        ww[lane] = r ? r->ww : 0;
    }
    const Lanes l00 = load<Lanes>(uu), l10 = load<Lanes>(uw), l11 = load<Lanes>(ww);
    const auto get = [&](Moment k) { return load<Lanes>(m[k] + at); };
    const double ln2 = 0.69314718055994530942;
    ImageGradients g;
    g.x = 2.0 * ln2 * l00 * get(kVU);
    g.y = 2.0 * ln2 * (l10 * get(kVU) + l11 * get(kVW));
    // inverse(cov) = 2 ln2 L L^T, d = L^-T y: 1/2 inverse(cov) (sum v d d^T) inverse(cov)
    //   = 2 ln2^2 L (sum v y y^T) L^T
    const double k = 2.0 * ln2 * ln2;
    const Lanes a = get(kVUU), b = get(kVUW), c = get(kVWW);
    g.xx = k * l00 * l00 * a;
    g.xy = 2.0 * k * l00 * (l10 * a + l11 * b);
    g.yy = k * (l10 * l10 * a + 2.0 * l10 * l11 * b + l11 * l11 * c);
    g.depth = get(kDepth);
    g.ln_opacity = get(kV);
    return g;
}

// Row i of every gradient, zeroed.
void zero_gradients(const Gaussians& in, int64_t i, const GaussianGradients& out) {
    for (int k = 0; k < 3; k++) out.means[3 * i + k] = out.log_scales[3 * i + k] = 0;
    for (int k = 0; k < 4; k++) out.quats[4 * i + k] = 0;
    out.opacity_logits[i] = 0;
    for (int k = 0; k < 2; k++) {
        out.means2d[2 * i + k] = 0;
        if (out.means2d_abs) out.means2d_abs[2 * i + k] = 0;
    }
    const int64_t width = 3 * in.sh_coefficients;
    for (int64_t k = 0; k < width; k++) out.sh[width * i + k] = 0;
}

}  // namespace

void project_view_backward(const Gaussians& in, const View& view, int threads,
                           const Record* records, const float* radii, const Slots* slots,
                           const float* slot_gradients, const GaussianGradients& out) {
    const Center center = camera_center(view);
    const int active = 3 * sh_count(view.sh_degree);
    const int64_t sh_width = 3 * in.sh_coefficients;
    const int64_t blocks = (in.count + kBlockSize - 1) / kBlockSize;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 32)
    for (int64_t block = 0; block < blocks; block++) {
        const int64_t first = block * kBlockSize;
        const int lanes = int(in.count - first < kBlockSize ? in.count - first : kBlockSize);
        double moments[12][kBlockSize] = {};
        const Record* record[kBlockSize] = {};
        uint32_t drawn = 0;
        for (int lane = 0; lane < lanes; lane++) {
            const int64_t i = first + lane;
            if (!(radii[i] > 0) || slots[i].count == 0) {
                zero_gradients(in, i, out);
                continue;
            }
            drawn |= 1u << lane;
            record[lane] = records + i;
            const Sums sums = sum_slots(slots[i], slot_gradients);
            for (int m = 0; m < 12; m++) moments[m][lane] = sums.moment[m];
        }
        if (!drawn) continue;
        double field[11][kBlockSize], xy[2][kBlockSize];
        DirectionLanes directions;
        for (int at = 0; at < lanes; at += kProjectLanes) {
            const Inputs inputs = load_inputs(in, first + at);
            const ImageGradients image = image_gradients(moments, record, at);
            const InputGradients g = project_backward(project(inputs, view), image, view);
            const Lanes all[11] = {g.mean.x,      g.mean.y,      g.mean.z,       g.log_scale.x,
                                   g.log_scale.y, g.log_scale.z, g.quat[0],      g.quat[1],
                                   g.quat[2],     g.quat[3],     g.opacity_logit};
            for (int k = 0; k < 11; k++) store(field[k] + at, all[k]);
            store(xy[0] + at, image.x);
            store(xy[1] + at, image.y);
            directions.set(inputs.mean, center, at);
        }
        uint32_t sound = drawn;  // of which every gradient fits into float32
        const auto fits = [&](double v, int lane) {
            if (!(std::fabs(v) <= 1e37)) sound &= ~(1u << lane);
            return float(v);
        };
        alignas(64) float d_rgb[3][kBlockSize] = {}, d_mean[3][kBlockSize];
        for (uint32_t left = drawn; left; left &= left - 1) {
            const int lane = __builtin_ctz(left);
            for (int c = 0; c < 3; c++)
                if (record[lane]->rgb[c] > 0) d_rgb[c][lane] = fits(moments[kRed + c][lane], lane);
        }
        ShBlock sh;
        sh.read(view.sh_degree, in.sh + sh_width * first, sh_width, drawn);
        f32x16 toward[3];
        sh_backward(directions.get(), view.sh_degree,
                    {load<f32x16>(d_rgb[0]), load<f32x16>(d_rgb[1]), load<f32x16>(d_rgb[2])}, sh,
                    toward);
        for (int k = 0; k < 3; k++) store(d_mean[k], toward[k]);
        sh.write(view.sh_degree, out.sh + sh_width * first, sh_width, drawn);
        for (uint32_t left = drawn; left; left &= left - 1) {
            const int lane = __builtin_ctz(left);
            const int64_t i = first + lane;
            for (int64_t k = active; k < sh_width; k++) out.sh[sh_width * i + k] = 0;
            for (int k = 0; k < 3; k++) {
                out.means[3 * i + k] = fits(field[k][lane] + d_mean[k][lane], lane);
                out.log_scales[3 * i + k] = fits(field[3 + k][lane], lane);
            }
            for (int k = 0; k < 4; k++) out.quats[4 * i + k] = fits(field[6 + k][lane], lane);
            out.opacity_logits[i] = fits(field[10][lane], lane);
            const double ln2 = 0.69314718055994530942;
            for (int k = 0; k < 2; k++) {
                out.means2d[2 * i + k] = fits(xy[k][lane], lane);
                if (out.means2d_abs)
                    out.means2d_abs[2 * i + k] = fits(2.0 * ln2 * moments[kAbsX + k][lane], lane);
            }
            if (!(sound >> lane & 1)) zero_gradients(in, i, out);
        }
    }
}

}  // namespace splat
