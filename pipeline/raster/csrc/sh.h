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

// max(0, 1/2 + sum_k basis_k sh_k) into rgb; false when a coefficient is not a sane number.
inline bool sh_color(const Direction& d, int degree, const float* sh, float limit, float* rgb) {
    float basis[16];
    sh_basis<false>(degree, d.x, d.y, d.z, basis, nullptr, nullptr, nullptr);
    float sum[3] = {0.5f, 0.5f, 0.5f};
    bool sane = true;
    for (int k = 0; k < sh_count(degree); k++)
        for (int c = 0; c < 3; c++) {
            const float coefficient = sh[3 * k + c];
            sane &= __builtin_fabsf(coefficient) <= limit;
            sum[c] += basis[k] * coefficient;
        }
    for (int c = 0; c < 3; c++) rgb[c] = sum[c] > 0 ? sum[c] : 0;
    return sane;
}

// Given dL/d(rgb), already zero where the clamp held: dL/d(sh) for the active coefficients, and
// the view direction's share of dL/d(mean), added to d_mean.
inline void sh_backward(const Direction& d, int degree, const float* sh, const float* d_rgb,
                        float* d_sh, double* d_mean) {
    float basis[16], dx[16], dy[16], dz[16];
    sh_basis<true>(degree, d.x, d.y, d.z, basis, dx, dy, dz);
    float gx = 0, gy = 0, gz = 0;
    for (int k = 0; k < sh_count(degree); k++) {
        const float along =
            d_rgb[0] * sh[3 * k] + d_rgb[1] * sh[3 * k + 1] + d_rgb[2] * sh[3 * k + 2];
        for (int c = 0; c < 3; c++) d_sh[3 * k + c] = basis[k] * d_rgb[c];
        gx += along * dx[k];
        gy += along * dy[k];
        gz += along * dz[k];
    }
    // d(v / |v|) = (I - d d^T) dv / |v|
    const double radial = double(gx) * d.x + double(gy) * d.y + double(gz) * d.z;
    d_mean[0] += (gx - radial * d.x) * d.inv_length;
    d_mean[1] += (gy - radial * d.y) * d.inv_length;
    d_mean[2] += (gz - radial * d.z) * d.inv_length;
}

}  // namespace splat
