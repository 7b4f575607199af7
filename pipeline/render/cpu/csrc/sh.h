// Spherical harmonics: the colour of a Gaussian from a direction (Kerbl et al. 2023; polynomials
// of Sloan 2013, ordered and signed as in 3DGS).
#pragma once

#include "shuffle.h"

namespace splat {

constexpr int sh_count(int degree) { return (degree + 1) * (degree + 1); }

// The basis at unit directions, and optionally its derivatives with respect to x, y, z as
// independent variables.
template <bool kDerivative>
SPLAT_INLINE void sh_basis(int degree, f32x16 x, f32x16 y, f32x16 z, f32x16* basis, f32x16* dx,
                           f32x16* dy, f32x16* dz) {
    constexpr float a0 = 0.28209479177387814f, a1 = 0.4886025119029199f;
    constexpr float b0 = 1.0925484305920792f, b2 = 0.31539156525252005f, b4 = 0.5462742152960396f;
    constexpr float c0 = 0.5900435899266435f, c1 = 2.890611442640554f, c2 = 0.4570457994644658f;
    constexpr float c3 = 0.3731763325901154f, c5 = 1.445305721320277f;
    const f32x16 xx = x * x, yy = y * y, zz = z * z, o = {};
    const auto term = [&](int k, f32x16 value, f32x16 value_x, f32x16 value_y, f32x16 value_z) {
        basis[k] = value;
        if (kDerivative) dx[k] = value_x, dy[k] = value_y, dz[k] = value_z;
    };
    term(0, splat16(a0), o, o, o);
    if (degree < 1) return;
    term(1, -a1 * y, o, splat16(-a1), o);
    term(2, a1 * z, o, o, splat16(a1));
    term(3, -a1 * x, splat16(-a1), o, o);
    if (degree < 2) return;
    term(4, b0 * x * y, b0 * y, b0 * x, o);
    term(5, -b0 * y * z, o, -b0 * z, -b0 * y);
    term(6, b2 * (2 * zz - xx - yy), -2 * b2 * x, -2 * b2 * y, 4 * b2 * z);
    term(7, -b0 * x * z, -b0 * z, o, -b0 * x);
    term(8, b4 * (xx - yy), 2 * b4 * x, -2 * b4 * y, o);
    if (degree < 3) return;
    term(9, -c0 * y * (3 * xx - yy), -6 * c0 * x * y, -3 * c0 * (xx - yy), o);
    term(10, c1 * x * y * z, c1 * y * z, c1 * x * z, c1 * x * y);
    term(11, -c2 * y * (4 * zz - xx - yy), 2 * c2 * x * y, -c2 * (4 * zz - xx - 3 * yy),
         -8 * c2 * y * z);
    term(12, c3 * z * (2 * zz - 3 * xx - 3 * yy), -6 * c3 * x * z, -6 * c3 * y * z,
         3 * c3 * (2 * zz - xx - yy));
    term(13, -c2 * x * (4 * zz - xx - yy), -c2 * (4 * zz - 3 * xx - yy), 2 * c2 * x * y,
         -8 * c2 * x * z);
    term(14, c5 * z * (xx - yy), 2 * c5 * x * z, -2 * c5 * y * z, c5 * (xx - yy));
    term(15, -c0 * x * (xx - 3 * yy), -3 * c0 * (xx - yy), 6 * c0 * x * y, o);
}

// Directions from the camera's centre to 16 Gaussians.
struct Directions {
    f32x16 x, y, z;  // unit
    f32x16 inv_length;
};

// The coefficients of 16 Gaussians, or their gradients: value[3 k + c] is coefficient k, channel c
// of each.
struct ShBlock {
    f32x16 value[48];

    // Reads rows of `width` floats: the active floats of the lanes in `lanes`; others are zeros.
    SPLAT_INLINE void read(int degree, const float* sh, int64_t width, uint32_t lanes) {
        const int active = 3 * sh_count(degree);
        for (int lane = 0; lane < 16; lane++) {
            const float* row = sh + width * lane;
            alignas(64) float padded[48];
            if (degree < 3 || !(lanes >> lane & 1)) {
                std::memset(padded, 0, sizeof(padded));
                if (lanes >> lane & 1) std::memcpy(padded, row, active * sizeof(float));
                row = padded;
            }
            for (int j = 0; j < 3; j++) value[16 * j + lane] = load<f32x16>(row + 16 * j);
        }
        for (int j = 0; 16 * j < active; j++) transpose(value + 16 * j);
    }
    // Transposes back: value[16 j + lane] are floats 16 j to 16 j + 15 of that lane's row.
    SPLAT_INLINE void to_rows(int degree) {
        for (int j = 0; 16 * j < 3 * sh_count(degree); j++) transpose(value + 16 * j);
    }
    // Transposes and writes `count` rows, with zeros after the active floats.
    SPLAT_INLINE void write(int degree, float* sh, int64_t width, int count) {
        to_rows(degree);
        const int active = 3 * sh_count(degree);
        for (int lane = 0; lane < count; lane++) {
            float* const row = sh + width * lane;
            for (int j = 0; 16 * j < active; j++) {
                if (16 * j + 16 <= active)
                    store(row + 16 * j, value[16 * j + lane]);
                else
                    std::memcpy(row + 16 * j, &value[16 * j + lane],
                                (active - 16 * j) * sizeof(float));
            }
            if (active < width) std::memset(row + active, 0, (width - active) * sizeof(float));
        }
    }
};

// max(0, 1/2 + sum_k basis_k sh_k). Returns the lanes whose coefficients are all at most kShMax.
SPLAT_INLINE uint32_t sh_colors(const Directions& d, int degree, const ShBlock& sh, float limit,
                                f32x16 (&rgb)[3]) {
    f32x16 basis[16];
    sh_basis<false>(degree, d.x, d.y, d.z, basis, nullptr, nullptr, nullptr);
    for (f32x16& c : rgb) c = splat16(0.5f);
    const f32x16 bound = splat16(limit), zero = {};
    Mask16 in_range = bound >= zero;
    for (int k = 0; k < sh_count(degree); k++)
        for (int c = 0; c < 3; c++) {
            const f32x16 value = sh.value[3 * k + c];
            in_range = in_range & (bound >= abs(value));
            rgb[c] += basis[k] * value;
        }
    for (f32x16& c : rgb) c = max(c, zero);
    return bits(in_range);
}

// Given dL/d(rgb) after the clamp: replaces the coefficients by their gradients, and returns
// dL/d(mean) through the viewing direction.
SPLAT_INLINE void sh_backward(const Directions& d, int degree, const f32x16 (&d_rgb)[3],
                              ShBlock& sh, f32x16 (&d_mean)[3]) {
    f32x16 basis[16], dx[16], dy[16], dz[16];
    sh_basis<true>(degree, d.x, d.y, d.z, basis, dx, dy, dz);
    f32x16 gx = {}, gy = {}, gz = {};
    for (int k = 0; k < sh_count(degree); k++) {
        f32x16* const value = sh.value + 3 * k;
        const f32x16 d_basis = value[0] * d_rgb[0] + value[1] * d_rgb[1] + value[2] * d_rgb[2];
        gx += d_basis * dx[k];
        gy += d_basis * dy[k];
        gz += d_basis * dz[k];
        for (int c = 0; c < 3; c++) value[c] = basis[k] * d_rgb[c];
    }
    // d(v / |v|) = (I - d d^T) dv / |v|
    const f32x16 radial = gx * d.x + gy * d.y + gz * d.z;
    d_mean[0] = (gx - radial * d.x) * d.inv_length;
    d_mean[1] = (gy - radial * d.y) * d.inv_length;
    d_mean[2] = (gz - radial * d.z) * d.inv_length;
}

}  // namespace splat
