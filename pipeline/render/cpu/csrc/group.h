// Gaussians are projected in groups of 16, the lanes of one float32 vector. This file converts
// between these lanes and the arrays.
#pragma once

#include "project_math.h"
#include "sh.h"

namespace splat {

constexpr int kGroup = 16;

// Reads 16 rows of K floats, of which `count` exist; the others are zeros.
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

// A group is projected in float64 in parts of one register each. `widened` converts part `number`
// to float64; `narrowed` joins the parts' values into one float32 vector.
constexpr int kGroupParts = kGroup / kProjectLanes;
SPLAT_INLINE Lanes widened(const f32x16& v, int number) {
    return widen(load<Vector<float, kProjectLanes>>(reinterpret_cast<const float*>(&v) +
                                                    kProjectLanes * number));
}
template <class Part, class Of>
SPLAT_INLINE f32x16 narrowed(const Part (&parts)[kGroupParts], const Of& of) {
    Vector<float, kProjectLanes> lanes[kGroupParts];
    for (int i = 0; i < kGroupParts; i++) lanes[i] = narrow(of(parts[i]));
    return join<kGroupParts>(lanes);
}

// A group's parameters except for the SH coefficients. Zeros after the last Gaussian: a zero
// quaternion is invalid.
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
        opacity_logit = load_first(g.opacity_logits + first, count);
    }
    SPLAT_INLINE Inputs part(int number) const {
        const auto wide = [number](const f32x16& v) { return widened(v, number); };
        const auto three = [&](const f32x16* v) {
            return Vec3{wide(v[0]), wide(v[1]), wide(v[2])};
        };
        return {three(mean),
                three(log_scale),
                {wide(quat[0]), wide(quat[1]), wide(quat[2]), wide(quat[3])},
                wide(opacity_logit)};
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
    // Unit directions to a part's Gaussians, and the inverse distances.
    struct Toward {
        Vec3 unit;
        Lanes inv_length;
    };
    SPLAT_INLINE Toward toward(const Vec3& mean) const {
        const Vec3 d = {mean.x - xyz[0], mean.y - xyz[1], mean.z - xyz[2]};
        const Lanes length2 = dot(d, d);
        const Lanes inv = select(length2 > 0.0, inverse_sqrt(length2), all_lanes(0.0));
        return {inv * d, inv};
    }
};
SPLAT_INLINE Directions directions(const CameraCenter::Toward (&toward)[kGroupParts]) {
    using Toward = CameraCenter::Toward;
    return {narrowed(toward, [](const Toward& t) { return t.unit.x; }),
            narrowed(toward, [](const Toward& t) { return t.unit.y; }),
            narrowed(toward, [](const Toward& t) { return t.unit.z; }),
            narrowed(toward, [](const Toward& t) { return t.inv_length; })};
}

}  // namespace splat
