// Vectors of 512 bits in GCC's vector extension, which clang shares: one vector register with
// AVX-512, two with AVX2, four with SSE or NEON; the compiler splits. The arithmetic is written
// once. Only what the extension cannot say well has a second form for AVX-512.
#pragma once

#include <cstdint>
#include <cstring>
#if defined(__AVX512F__) && defined(__AVX512DQ__)
#include <immintrin.h>
#define SPLAT_AVX512 1
#else
#define SPLAT_AVX512 0
#endif

#define SPLAT_INLINE inline __attribute__((always_inline))

namespace splat {

typedef float f32x16 __attribute__((vector_size(64)));
typedef int32_t i32x16 __attribute__((vector_size(64)));
typedef float f32x8 __attribute__((vector_size(32)));
typedef double f64x8 __attribute__((vector_size(64)));
typedef int64_t i64x8 __attribute__((vector_size(64)));
// Where bits are put together, or lanes may hold junk: these wrap around by definition.
typedef uint32_t u32x16 __attribute__((vector_size(64)));
typedef uint64_t u64x8 __attribute__((vector_size(64)));

constexpr f32x16 kLane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

SPLAT_INLINE f32x16 splat16(float x) { return f32x16{} + x; }
SPLAT_INLINE f64x8 splat8(double x) { return f64x8{} + x; }

template <class V, class T>
SPLAT_INLINE V load(const T* from) {
    V v;
    std::memcpy(&v, from, sizeof(V));
    return v;
}
template <class V, class T>
SPLAT_INLINE void store(T* to, V v) {
    std::memcpy(to, &v, sizeof(V));
}

// The first `count` lanes, 0 to 16, from and to memory; zeros stand for the others.
SPLAT_INLINE f32x16 load_first(const float* from, int count) {
#if SPLAT_AVX512
    return _mm512_maskz_loadu_ps(__mmask16((1u << count) - 1), from);
#else
    f32x16 v = {};
    std::memcpy(&v, from, count * sizeof(float));
    return v;
#endif
}
SPLAT_INLINE void store_first(float* to, f32x16 v, int count) {
#if SPLAT_AVX512
    _mm512_mask_storeu_ps(to, __mmask16((1u << count) - 1), v);
#else
    std::memcpy(to, &v, count * sizeof(float));
#endif
}

// ---- Masks of 16 lanes: a mask register with AVX-512, lanes of 0 or -1 elsewhere ----

#if SPLAT_AVX512
struct Mask16 {
    __mmask16 bits;
};
SPLAT_INLINE Mask16 ge(f32x16 a, f32x16 b) { return {_mm512_cmp_ps_mask(a, b, _CMP_GE_OQ)}; }
SPLAT_INLINE Mask16 lt(f32x16 a, f32x16 b) { return {_mm512_cmp_ps_mask(a, b, _CMP_LT_OQ)}; }
SPLAT_INLINE Mask16 operator&(Mask16 a, Mask16 b) { return {__mmask16(a.bits & b.bits)}; }
SPLAT_INLINE Mask16 and_not(Mask16 a, Mask16 b) { return {__mmask16(a.bits & ~b.bits)}; }
SPLAT_INLINE f32x16 select(Mask16 m, f32x16 yes, f32x16 no) {
    return _mm512_mask_mov_ps(no, m.bits, yes);
}
SPLAT_INLINE f32x16 keep(Mask16 m, f32x16 v) { return _mm512_maskz_mov_ps(m.bits, v); }
SPLAT_INLINE f32x16 product(Mask16 m, f32x16 a, f32x16 b) {  // 0 where not m
    return _mm512_maskz_mul_ps(m.bits, a, b);
}
SPLAT_INLINE uint32_t bits(Mask16 m) { return m.bits; }
SPLAT_INLINE f32x16 min(f32x16 a, f32x16 b) { return _mm512_min_ps(a, b); }
SPLAT_INLINE f32x16 max(f32x16 a, f32x16 b) { return _mm512_max_ps(a, b); }
SPLAT_INLINE f32x16 floor(f32x16 v) { return _mm512_roundscale_ps(v, _MM_FROUND_TO_NEG_INF); }
SPLAT_INLINE f32x16 ceil(f32x16 v) { return _mm512_roundscale_ps(v, _MM_FROUND_TO_POS_INF); }
SPLAT_INLINE f32x16 sqrt(f32x16 v) { return _mm512_sqrt_ps(v); }
SPLAT_INLINE f64x8 sqrt(f64x8 v) { return _mm512_sqrt_pd(v); }
SPLAT_INLINE f64x8 floor(f64x8 v) { return _mm512_roundscale_pd(v, _MM_FROUND_TO_NEG_INF); }
SPLAT_INLINE f64x8 ceil(f64x8 v) { return _mm512_roundscale_pd(v, _MM_FROUND_TO_POS_INF); }
SPLAT_INLINE uint32_t bits(i64x8 m) { return _mm512_movepi64_mask(__m512i(m)); }
SPLAT_INLINE Mask16 mask(uint32_t bits) { return {__mmask16(bits)}; }
#else
struct Mask16 {
    i32x16 lanes;
};
SPLAT_INLINE Mask16 ge(f32x16 a, f32x16 b) { return {i32x16(a >= b)}; }
SPLAT_INLINE Mask16 lt(f32x16 a, f32x16 b) { return {i32x16(a < b)}; }
SPLAT_INLINE Mask16 operator&(Mask16 a, Mask16 b) { return {a.lanes & b.lanes}; }
SPLAT_INLINE Mask16 and_not(Mask16 a, Mask16 b) { return {a.lanes & ~b.lanes}; }
SPLAT_INLINE f32x16 select(Mask16 m, f32x16 yes, f32x16 no) {
    return f32x16((m.lanes & i32x16(yes)) | (~m.lanes & i32x16(no)));
}
SPLAT_INLINE f32x16 keep(Mask16 m, f32x16 v) { return f32x16(m.lanes & i32x16(v)); }
SPLAT_INLINE f32x16 product(Mask16 m, f32x16 a, f32x16 b) { return keep(m, a * b); }
SPLAT_INLINE uint32_t bits(Mask16 m) {
    uint32_t packed = 0;
    for (int i = 0; i < 16; i++) packed |= uint32_t(m.lanes[i] & 1) << i;
    return packed;
}
SPLAT_INLINE f32x16 min(f32x16 a, f32x16 b) { return select(lt(a, b), a, b); }
SPLAT_INLINE f32x16 max(f32x16 a, f32x16 b) { return select(lt(a, b), b, a); }
SPLAT_INLINE f32x16 floor(f32x16 v) {
    for (int i = 0; i < 16; i++) v[i] = __builtin_floorf(v[i]);
    return v;
}
SPLAT_INLINE f32x16 ceil(f32x16 v) {
    for (int i = 0; i < 16; i++) v[i] = __builtin_ceilf(v[i]);
    return v;
}
SPLAT_INLINE f32x16 sqrt(f32x16 v) {
    for (int i = 0; i < 16; i++) v[i] = __builtin_sqrtf(v[i]);
    return v;
}
SPLAT_INLINE f64x8 sqrt(f64x8 v) {
    for (int i = 0; i < 8; i++) v[i] = __builtin_sqrt(v[i]);
    return v;
}
SPLAT_INLINE f64x8 floor(f64x8 v) {
    for (int i = 0; i < 8; i++) v[i] = __builtin_floor(v[i]);
    return v;
}
SPLAT_INLINE f64x8 ceil(f64x8 v) {
    for (int i = 0; i < 8; i++) v[i] = __builtin_ceil(v[i]);
    return v;
}
SPLAT_INLINE uint32_t bits(i64x8 m) {
    uint32_t packed = 0;
    for (int i = 0; i < 8; i++) packed |= uint32_t(m[i] & 1) << i;
    return packed;
}
SPLAT_INLINE Mask16 mask(uint32_t bits) {
    i32x16 lanes;
    for (int i = 0; i < 16; i++) lanes[i] = -int32_t(bits >> i & 1);
    return {lanes};
}
#endif

SPLAT_INLINE Mask16 gt(i32x16 a, int32_t b) {
#if SPLAT_AVX512
    return {_mm512_cmpgt_epi32_mask(__m512i(a), _mm512_set1_epi32(b))};
#else
    return {a > b};
#endif
}

// Lanes of which bit number `bit` is set.
SPLAT_INLINE Mask16 has_bit(u32x16 v, int bit) {
#if SPLAT_AVX512
    return {_mm512_test_epi32_mask(__m512i(v), _mm512_set1_epi32(1 << bit))};
#else
    return {-i32x16(v >> uint32_t(bit) & 1u)};
#endif
}

SPLAT_INLINE bool any(Mask16 m) {
#if SPLAT_AVX512
    return m.bits != 0;
#else
    int32_t seen = 0;
    for (int i = 0; i < 16; i++) seen |= m.lanes[i];
    return seen != 0;
#endif
}

// Writes base + kStep i for every bit i of `bits`, lowest first; returns how many. May write junk
// up to to[15].
template <uint32_t kStep>
SPLAT_INLINE int list_bits(uint32_t bits, uint32_t base, uint32_t* to) {
#if SPLAT_AVX512
    const u32x16 all = base + kStep * __builtin_convertvector(kLane, u32x16);
    _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(__mmask16(bits), __m512i(all)));
    return __builtin_popcount(bits);
#else
    int n = 0;
    for (; bits; bits &= bits - 1) to[n++] = base + kStep * uint32_t(__builtin_ctz(bits));
    return n;
#endif
}

// In lanes 0, 4, 8 and 12: the bits set in any of the four lanes from there on.
SPLAT_INLINE u32x16 any_of_four(u32x16 v) {
    v |= __builtin_shuffle(v, u32x16{1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14});
    return v | __builtin_shuffle(v, u32x16{2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13});
}

SPLAT_INLINE f32x16 abs(f32x16 v) { return f32x16(i32x16(v) & 0x7fffffff); }

// 1 / x to about 2^-26, for x in [1e-37, 1e37].
SPLAT_INLINE f32x16 reciprocal(f32x16 x) {
#if SPLAT_AVX512
    const f32x16 guess = _mm512_rcp14_ps(x);
    return guess * (2.0f - x * guess);
#else
    return 1.0f / x;
#endif
}

// 1 / x and 1 / sqrt(x) in float64 to about 2^-52, for x in [1e-300, 1e300]: Newton's steps from a
// guess of 14 bits, where a division of eight lanes takes 16 to 24 cycles and a root more. 0 and
// infinity may give NaN.
SPLAT_INLINE f64x8 reciprocal(f64x8 x) {
#if SPLAT_AVX512
    f64x8 guess = _mm512_rcp14_pd(x);
    for (int i = 0; i < 2; i++) guess += guess * (1.0 - x * guess);
    return guess;
#else
    return 1.0 / x;
#endif
}
SPLAT_INLINE f64x8 inverse_sqrt(f64x8 x) {
#if SPLAT_AVX512
    f64x8 guess = _mm512_rsqrt14_pd(x);
    for (int i = 0; i < 2; i++) guess += 0.5 * guess * (1.0 - x * guess * guess);
    return guess;
#else
    return 1.0 / sqrt(x);
#endif
}

// ---- Two vectors of eight for one of sixteen ----

SPLAT_INLINE f64x8 widen(f32x16 v, int half) {
    f32x8 part;
    std::memcpy(&part, reinterpret_cast<const char*>(&v) + half * sizeof(part), sizeof(part));
    return __builtin_convertvector(part, f64x8);
}
SPLAT_INLINE f32x16 narrow(f64x8 low, f64x8 high) {
#if SPLAT_AVX512
    const __m512 lower = _mm512_castps256_ps512(_mm512_cvtpd_ps(low));
    return _mm512_insertf32x8(lower, _mm512_cvtpd_ps(high), 1);
#else
    const f32x8 parts[2] = {__builtin_convertvector(low, f32x8),
                            __builtin_convertvector(high, f32x8)};
    return load<f32x16>(parts);
#endif
}

// ---- Elementary functions ----

// 2^x in float32, relative error under 2e-7 for x in [-126, 126]; junk, but no trap, outside.
// Rounds by the magic number 1.5 * 2^23, whose low bits are then the exponent.
template <int kCount>
SPLAT_INLINE void exp2(const f32x16 (&x)[kCount], f32x16 (&out)[kCount]) {
    const float magic = 12582912.0f;
    f32x16 shifted[kCount], f[kCount], f2[kCount];
    for (int i = 0; i < kCount; i++) shifted[i] = x[i] + magic;
    for (int i = 0; i < kCount; i++) f[i] = x[i] - (shifted[i] - magic);
    for (int i = 0; i < kCount; i++) f2[i] = f[i] * f[i];
    for (int i = 0; i < kCount; i++) {
        const f32x16 low = 0.6931469440460205f * f[i] + 1.0000001192092896f;
        const f32x16 mid = 0.05550713092088699f * f[i] + 0.24022120237350464f;
        const f32x16 high = 0.001327647129073739f * f[i] + 0.009675540961325169f;
        const f32x16 power = (high * f2[i] + mid) * f2[i] + low;
        out[i] = f32x16(u32x16(power) + (u32x16(shifted[i]) << 23));
    }
}

template <class V>
SPLAT_INLINE f64x8 select(V m, f64x8 yes, f64x8 no) {
    return f64x8((i64x8(m) & i64x8(yes)) | (~i64x8(m) & i64x8(no)));
}

SPLAT_INLINE f64x8 clamp(f64x8 v, double low, double high) {
    v = select(v < low, splat8(low), v);
    return select(v > high, splat8(high), v);
}

// e^x in float64, relative error under 1e-13; x is clamped to [-700, 700]. Taylor to degree 11
// on |r| <= ln(2) / 2.
SPLAT_INLINE f64x8 exp(f64x8 x) {
    const double magic = 6755399441055744.0;  // 1.5 * 2^52
    x = clamp(x, -700.0, 700.0);
    const f64x8 shifted = x * 1.4426950408889634 + magic;
    const f64x8 n = shifted - magic;
    const f64x8 r = (x - n * 0.693147180369123816490) - n * 1.90821492927058770002e-10;
    constexpr double inverse_factorial[] = {1.0 / 3628800, 1.0 / 362880, 1.0 / 40320, 1.0 / 5040,
                                            1.0 / 720,     1.0 / 120,    1.0 / 24,    1.0 / 6,
                                            0.5,           1.0,          1.0};
    f64x8 p = splat8(1.0 / 39916800);
    for (double c : inverse_factorial) p = p * r + c;
    return f64x8(u64x8(p) + (u64x8(shifted) << 52));
}

// log2(x) in float64 for normal x > 0, absolute error under 1e-13: x = 2^e m with m in
// [0.71, 1.42], ln m = 2 artanh((m - 1) / (m + 1)).
SPLAT_INLINE f64x8 log2(f64x8 x) {
    const i64x8 e = i64x8(u64x8(x) - 0x3fe6a09e667f3bcdULL) >> 52;  // less the bits of sqrt(0.5)
    const f64x8 m = f64x8(u64x8(x) - (u64x8(e) << 52));
    const f64x8 s = (m - 1.0) * reciprocal(m + 1.0), s2 = s * s;
    f64x8 p = splat8(1.0 / 17);
    for (int n = 15; n > 0; n -= 2) p = p * s2 + 1.0 / n;
    return __builtin_convertvector(e, f64x8) + 2.8853900817779268 * s * p;
}

}  // namespace splat
