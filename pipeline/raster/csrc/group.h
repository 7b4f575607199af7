// Gaussians are projected in groups of 16: the lanes of one vector of float32, or of two of
// float64. Here are the ways between the lanes and the arrays.
#pragma once

#include "project_math.h"
#include "sh.h"

namespace splat {

constexpr int kGroup = 16;

// 16 rows of K floats, of which `count` are there; zeros stand for the others.
template <int K>
SPLAT_INLINE void read_rows(const float* from, int count, f32x16 (&columns)[K]) {
    alignas(64) float padded[16 * K];
    if (count < kGroup) {
        std::memset(padded, 0, sizeof(padded));
        from = static_cast<float*>(std::memcpy(padded, from, count * K * sizeof(float)));
    }
    deinterleave(from, columns);
}
template <int K>
SPLAT_INLINE void write_rows(const f32x16 (&columns)[K], int count, float* to) {
    alignas(64) float padded[16 * K];
    interleave(columns, count < kGroup ? padded : to);
    if (count < kGroup) std::memcpy(to, padded, count * K * sizeof(float));
}
SPLAT_INLINE f32x16 read_column(const float* from, int count) {
    f32x16 column = {};
    std::memcpy(&column, from, (count < kGroup ? count : kGroup) * sizeof(float));
    return column;
}
SPLAT_INLINE void write_column(f32x16 column, int count, float* to) {
    std::memcpy(to, &column, (count < kGroup ? count : kGroup) * sizeof(float));
}

// A group's parameters but for the spherical harmonics. Zeros, which no quaternion survives,
// beyond the last Gaussian.
struct Group {
    int64_t first;
    int count;
    f32x16 mean[3], log_scale[3], quat[4], opacity_logit;

    Group(const Gaussians& g, int64_t number) {
        first = number * kGroup;
        count = int(g.count - first < kGroup ? g.count - first : kGroup);
        read_rows(g.means + 3 * first, count, mean);
        read_rows(g.log_scales + 3 * first, count, log_scale);
        read_rows(g.quats + 4 * first, count, quat);
        opacity_logit = read_column(g.opacity_logits + first, count);
    }
    SPLAT_INLINE Inputs half(int h) const {
        const auto three = [h](const f32x16* v) {
            return Vec3{widen(v[0], h), widen(v[1], h), widen(v[2], h)};
        };
        return {three(mean),
                three(log_scale),
                {widen(quat[0], h), widen(quat[1], h), widen(quat[2], h), widen(quat[3], h)},
                widen(opacity_logit, h)};
    }
};
SPLAT_INLINE int64_t groups(const Gaussians& g) { return (g.count + kGroup - 1) / kGroup; }

// The camera's centre in the world, -R^T t.
struct CameraCenter {
    double xyz[3];

    explicit CameraCenter(const View& v) {
        for (int i = 0; i < 3; i++)
            xyz[i] = -(v.rotation[i] * v.translation[0] + v.rotation[3 + i] * v.translation[1] +
                       v.rotation[6 + i] * v.translation[2]);
    }
    // Directions to eight Gaussians, and the inverse lengths.
    struct Toward {
        Vec3 unit;
        Lanes inv_length;
    };
    SPLAT_INLINE Toward toward(const Vec3& mean) const {
        const Vec3 d = {mean.x - xyz[0], mean.y - xyz[1], mean.z - xyz[2]};
        const Lanes length2 = dot(d, d);
        const Lanes inv = select(length2 > 0.0, inverse_sqrt(length2), splat8(0.0));
        return {inv * d, inv};
    }
};
SPLAT_INLINE Directions directions(const CameraCenter::Toward (&t)[2]) {
    return {narrow(t[0].unit.x, t[1].unit.x), narrow(t[0].unit.y, t[1].unit.y),
            narrow(t[0].unit.z, t[1].unit.z), narrow(t[0].inv_length, t[1].inv_length)};
}

}  // namespace splat
