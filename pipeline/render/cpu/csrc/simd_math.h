// Elementary functions of vectors.
#pragma once

#include "simd.h"

namespace splat {

// 1 / x to about 2^-26, for x in [1e-37, 1e37].
template <int N>
SPLAT_INLINE Vector<float, N> reciprocal(Vector<float, N> x) {
#if SPLAT_AVX512
    const Vector<float, N> guess = {_mm512_rcp14_ps(x.lanes)};
    return guess * (2.0f - x * guess);
#else
    return 1.0f / x;
#endif
}

// x / y for y in [1e-37, 1e37], to about 2^-23.
template <int N>
SPLAT_INLINE Vector<float, N> quotient(Vector<float, N> x, Vector<float, N> y) {
#if SPLAT_AVX512
    return x * reciprocal(y);
#else
    return x / y;
#endif
}

// 1 / x and 1 / sqrt(x) in float64 to about 2^-52, for x in [1e-300, 1e300]. With AVX-512 by two
// Newton steps from a 14-bit estimate: a division of eight lanes takes 16 to 24 cycles there, a
// square root more. 0 and infinity may give NaN.
template <int N>
SPLAT_INLINE Vector<double, N> reciprocal(Vector<double, N> x) {
#if SPLAT_AVX512
    Vector<double, N> guess = {_mm512_rcp14_pd(x.lanes)};
    for (int i = 0; i < 2; i++) guess += guess * (1.0 - x * guess);
    return guess;
#else
    return 1.0 / x;
#endif
}
template <int N>
SPLAT_INLINE Vector<double, N> inverse_sqrt(Vector<double, N> x) {
#if SPLAT_AVX512
    Vector<double, N> guess = {_mm512_rsqrt14_pd(x.lanes)};
    for (int i = 0; i < 2; i++) guess += 0.5 * guess * (1.0 - x * guess * guess);
    return guess;
#else
    return 1.0 / sqrt(x);
#endif
}

// Polynomial coefficients of 2^x on [-1/2, 1/2], constant first.
constexpr float kExp2[] = {1.0000001192092896f,  0.6931469440460205f,   0.24022120237350464f,
                           0.05550713092088699f, 0.009675540961325169f, 0.001327647129073739f};

// 2^x in float32, relative error below 2e-7 for x in [-126, 126]; undefined outside, without traps.
// Rounds by adding 1.5 * 2^23, whose low bits then contain the exponent. Several vectors at once:
// one alone is a chain of dependent operations.
template <int N, int kCount>
SPLAT_INLINE void exp2(const Vector<float, N> (&x)[kCount], Vector<float, N> (&out)[kCount]) {
    using V = Vector<float, N>;
    const float magic = 12582912.0f;
    V shifted[kCount], f[kCount], power[kCount];
    for (int i = 0; i < kCount; i++) shifted[i] = x[i] + magic;
    for (int i = 0; i < kCount; i++) f[i] = x[i] - (shifted[i] - magic);
#if SPLAT_AVX512
    // Estrin's scheme: a shorter dependency chain.
    V f2[kCount];
    for (int i = 0; i < kCount; i++) f2[i] = f[i] * f[i];
    for (int i = 0; i < kCount; i++) {
        const V low = kExp2[1] * f[i] + kExp2[0];
        const V mid = kExp2[3] * f[i] + kExp2[2];
        const V high = kExp2[5] * f[i] + kExp2[4];
        power[i] = (high * f2[i] + mid) * f2[i] + low;
    }
#else
    // Horner's scheme: fewer live registers.
    for (int i = 0; i < kCount; i++) power[i] = kExp2[5] * f[i] + kExp2[4];
    for (int k = 3; k >= 0; k--)
        for (int i = 0; i < kCount; i++) power[i] = power[i] * f[i] + kExp2[k];
#endif
    for (int i = 0; i < kCount; i++)
        out[i] = bit_cast<V>(bit_cast<Unsigned<N>>(power[i]) +
                             (bit_cast<Unsigned<N>>(shifted[i]) << 23));
}

template <int N>
SPLAT_INLINE Vector<double, N> clamp(Vector<double, N> v, double low, double high) {
    v = max(broadcast<Vector<double, N>>(low), v);
    return min(broadcast<Vector<double, N>>(high), v);
}

// e^x in float64, relative error under 1e-13; x is clamped to [-700, 700]. Taylor to degree 11
// on |r| <= ln(2) / 2.
template <int N>
SPLAT_INLINE Vector<double, N> exp(Vector<double, N> x) {
    using V = Vector<double, N>;
    using Bits = Vector<uint64_t, N>;
    const double magic = 6755399441055744.0;  // 1.5 * 2^52
    x = clamp(x, -700.0, 700.0);
    const V shifted = x * 1.4426950408889634 + magic;
    const V n = shifted - magic;
    const V r = (x - n * 0.693147180369123816490) - n * 1.90821492927058770002e-10;
    constexpr double inverse_factorial[] = {1.0 / 3628800, 1.0 / 362880, 1.0 / 40320, 1.0 / 5040,
                                            1.0 / 720,     1.0 / 120,    1.0 / 24,    1.0 / 6,
                                            0.5,           1.0,          1.0};
    V p = broadcast<V>(1.0 / 39916800);
    for (double c : inverse_factorial) p = p * r + c;
    return bit_cast<V>(bit_cast<Bits>(p) + (bit_cast<Bits>(shifted) << 52));
}

// log2(x) in float64 for normal x > 0, absolute error under 1e-13: x = 2^e m with m in
// [0.71, 1.42], ln m = 2 artanh((m - 1) / (m + 1)).
template <int N>
SPLAT_INLINE Vector<double, N> log2(Vector<double, N> x) {
    using V = Vector<double, N>;
    using Bits = Vector<uint64_t, N>;
    // e, from the exponent of x / sqrt(0.5), biased by 2048 so that it is not negative; as a
    // float64 it is the low bits of 2^52 + e.
    const Bits biased = (bit_cast<Bits>(x) - 0x3fe6a09e667f3bcdULL + (uint64_t(2048) << 52)) >> 52;
    const V e = bit_cast<V>(biased | 0x4330000000000000ULL) - (4503599627370496.0 + 2048.0);
    const V m = bit_cast<V>(bit_cast<Bits>(x) - (biased << 52) + (uint64_t(2048) << 52));
    const V s = (m - 1.0) * reciprocal(m + 1.0), s2 = s * s;
    V p = broadcast<V>(1.0 / 17);
    for (int n = 15; n > 0; n -= 2) p = p * s2 + 1.0 / n;
    return e + 2.8853900817779268 * s * p;
}

}  // namespace splat
