// Spherical harmonics: the colour of a Gaussian from a direction (Kerbl et al. 2023; polynomials
// of Sloan 2013, ordered and signed as in 3DGS).
#pragma once

#include "simd.h"

namespace splat {

constexpr int sh_count(int degree) { return (degree + 1) * (degree + 1); }

// The basis at a unit direction, and if asked for its derivatives with respect to x, y, z taken
// as independent.
template <bool kDerivative>
SPLAT_INLINE void sh_basis(int degree, float x, float y, float z, float* basis, float* dx,
                           float* dy, float* dz) {
    constexpr float a0 = 0.28209479177387814f, a1 = 0.4886025119029199f;
    constexpr float b0 = 1.0925484305920792f, b2 = 0.31539156525252005f, b4 = 0.5462742152960396f;
    constexpr float c0 = 0.5900435899266435f, c1 = 2.890611442640554f, c2 = 0.4570457994644658f;
    constexpr float c3 = 0.3731763325901154f, c5 = 1.445305721320277f;
    const float xx = x * x, yy = y * y, zz = z * z;
    const auto term = [&](int k, float value, float value_x, float value_y, float value_z) {
        basis[k] = value;
        if (kDerivative) dx[k] = value_x, dy[k] = value_y, dz[k] = value_z;
    };
    term(0, a0, 0, 0, 0);
    if (degree < 1) return;
    term(1, -a1 * y, 0, -a1, 0);
    term(2, a1 * z, 0, 0, a1);
    term(3, -a1 * x, -a1, 0, 0);
    if (degree < 2) return;
    term(4, b0 * x * y, b0 * y, b0 * x, 0);
    term(5, -b0 * y * z, 0, -b0 * z, -b0 * y);
    term(6, b2 * (2 * zz - xx - yy), -2 * b2 * x, -2 * b2 * y, 4 * b2 * z);
    term(7, -b0 * x * z, -b0 * z, 0, -b0 * x);
    term(8, b4 * (xx - yy), 2 * b4 * x, -2 * b4 * y, 0);
    if (degree < 3) return;
    term(9, -c0 * y * (3 * xx - yy), -6 * c0 * x * y, -3 * c0 * (xx - yy), 0);
    term(10, c1 * x * y * z, c1 * y * z, c1 * x * z, c1 * x * y);
    term(11, -c2 * y * (4 * zz - xx - yy), 2 * c2 * x * y, -c2 * (4 * zz - xx - 3 * yy),
         -8 * c2 * y * z);
    term(12, c3 * z * (2 * zz - 3 * xx - 3 * yy), -6 * c3 * x * z, -6 * c3 * y * z,
         3 * c3 * (2 * zz - xx - yy));
    term(13, -c2 * x * (4 * zz - xx - yy), -c2 * (4 * zz - 3 * xx - yy), 2 * c2 * x * y,
         -8 * c2 * x * z);
    term(14, c5 * z * (xx - yy), 2 * c5 * x * z, -2 * c5 * y * z, c5 * (xx - yy));
    term(15, -c0 * x * (xx - 3 * yy), -3 * c0 * (xx - yy), 6 * c0 * x * y, 0);
}

// From the camera's centre to a Gaussian's.
struct Direction {
    float x, y, z;  // unit
    double inv_length;
};

SPLAT_INLINE Direction direction(const float* mean, const double* center) {
    const double x = mean[0] - center[0], y = mean[1] - center[1], z = mean[2] - center[2];
    const double length = __builtin_sqrt(x * x + y * y + z * z);
    const double inv = length > 0 ? 1.0 / length : 0.0;
    return {float(x * inv), float(y * inv), float(z * inv), inv};
}

// The 16 x 3 coefficients of a Gaussian, flat as they are stored: float f is coefficient f / 3,
// channel f % 3.
struct ShVectors {
    f32x16 part[3];

    // Reads the active ones; zeros stand for the rest.
    SPLAT_INLINE ShVectors(int degree, const float* sh) {
        alignas(64) float padded[48] = {};
        if (degree < 3) {
            std::memcpy(padded, sh, 3 * sh_count(degree) * sizeof(float));
            sh = padded;
        }
        for (int j = 0; j < 3; j++) part[j] = load<f32x16>(sh + 16 * j);
    }
    SPLAT_INLINE bool within(float limit) const {
        const f32x16 bound = splat16(limit);
        return bits(ge(bound, abs(part[0])) & ge(bound, abs(part[1])) & ge(bound, abs(part[2]))) ==
               0xffff;
    }
};

template <int kPart, int... kLanes>
constexpr i32x16 coefficient_lanes(std::integer_sequence<int, kLanes...>) {
    return i32x16{(16 * kPart + kLanes) / 3 ...};
}
template <int kPart, int... kLanes>
constexpr i32x16 channel_lanes(std::integer_sequence<int, kLanes...>) {
    return i32x16{(16 * kPart + kLanes) % 3 ...};
}

// A value per coefficient, and a value per channel (lanes 0 to 2), brought to part kPart's lanes.
template <int kPart>
SPLAT_INLINE f32x16 by_coefficient(f32x16 values) {
    return __builtin_shuffle(values, coefficient_lanes<kPart>(SixteenLanes{}));
}
template <int kPart>
SPLAT_INLINE f32x16 by_channel(f32x16 values) {
    return __builtin_shuffle(values, channel_lanes<kPart>(SixteenLanes{}));
}

// max(0, 1/2 + sum_k basis_k sh_k) into rgb; false when a coefficient is not a sane number.
SPLAT_INLINE bool sh_color(const Direction& d, int degree, const float* sh, float limit,
                           float* rgb) {
    alignas(64) float basis[16] = {};
    sh_basis<false>(degree, d.x, d.y, d.z, basis, nullptr, nullptr, nullptr);
    const f32x16 b = load<f32x16>(basis);
    const ShVectors s(degree, sh);
    const f32x16 terms[3] = {s.part[0] * by_coefficient<0>(b), s.part[1] * by_coefficient<1>(b),
                             s.part[2] * by_coefficient<2>(b)};
    f32x16 sums[4] = {};
    for (int c = 0; c < 3; c++) {
        f32x16 one = {};
        one[c] = 1;
        sums[c] = terms[0] * by_channel<0>(one) + terms[1] * by_channel<1>(one) +
                  terms[2] * by_channel<2>(one);
    }
    const f32x16 total = sum_lanes(sums);
    for (int c = 0; c < 3; c++) {
        const float value = total[4 * c] + 0.5f;
        rgb[c] = value > 0 ? value : 0;
    }
    return s.within(limit);
}

// Given dL/d(rgb), already zero where the clamp held: dL/d(sh) for the active coefficients, and
// the view direction's share of dL/d(mean), added to d_mean.
SPLAT_INLINE void sh_backward(const Direction& d, int degree, const float* sh, const float* d_rgb,
                              float* d_sh, double* d_mean) {
    alignas(64) float basis[16] = {}, dx[16] = {}, dy[16] = {}, dz[16] = {};
    sh_basis<true>(degree, d.x, d.y, d.z, basis, dx, dy, dz);
    const f32x16 b = load<f32x16>(basis);
    const f32x16 x = load<f32x16>(dx), y = load<f32x16>(dy), z = load<f32x16>(dz);
    const f32x16 channels = {d_rgb[0], d_rgb[1], d_rgb[2]};
    const f32x16 c[3] = {by_channel<0>(channels), by_channel<1>(channels), by_channel<2>(channels)};
    const ShVectors s(degree, sh);
    const f32x16 pull[3] = {s.part[0] * c[0], s.part[1] * c[1], s.part[2] * c[2]};
    const f32x16 sums[4] = {
        pull[0] * by_coefficient<0>(x) + pull[1] * by_coefficient<1>(x) +
            pull[2] * by_coefficient<2>(x),
        pull[0] * by_coefficient<0>(y) + pull[1] * by_coefficient<1>(y) +
            pull[2] * by_coefficient<2>(y),
        pull[0] * by_coefficient<0>(z) + pull[1] * by_coefficient<1>(z) +
            pull[2] * by_coefficient<2>(z),
    };
    const f32x16 total = sum_lanes(sums);
    alignas(64) float out[48];
    float* to = degree < 3 ? out : d_sh;
    store(to, by_coefficient<0>(b) * c[0]);
    store(to + 16, by_coefficient<1>(b) * c[1]);
    store(to + 32, by_coefficient<2>(b) * c[2]);
    if (degree < 3) std::memcpy(d_sh, out, 3 * sh_count(degree) * sizeof(float));
    // d(v / |v|) = (I - d d^T) dv / |v|
    const double gx = total[0], gy = total[4], gz = total[8];
    const double radial = gx * d.x + gy * d.y + gz * d.z;
    d_mean[0] += (gx - radial * d.x) * d.inv_length;
    d_mean[1] += (gy - radial * d.y) * d.inv_length;
    d_mean[2] += (gz - radial * d.z) * d.inv_length;
}

}  // namespace splat
