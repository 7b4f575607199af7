// Vectors of 512 bits in GCC's vector extension, which clang shares: one vector register with
// AVX-512, two with AVX2, four with SSE or NEON; the compiler splits. The arithmetic is written
// once. Only what the extension cannot say well has a second form for AVX-512.
#pragma once

#include <cstdint>
#include <cstring>
#include <utility>
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
SPLAT_INLINE uint32_t bits(Mask16 m) { return m.bits; }
SPLAT_INLINE f32x16 min(f32x16 a, f32x16 b) { return _mm512_min_ps(a, b); }
SPLAT_INLINE f32x16 max(f32x16 a, f32x16 b) { return _mm512_max_ps(a, b); }
SPLAT_INLINE f32x16 floor(f32x16 v) { return _mm512_roundscale_ps(v, _MM_FROUND_TO_NEG_INF); }
SPLAT_INLINE f32x16 ceil(f32x16 v) { return _mm512_roundscale_ps(v, _MM_FROUND_TO_POS_INF); }
SPLAT_INLINE f32x16 sqrt(f32x16 v) { return _mm512_sqrt_ps(v); }
SPLAT_INLINE f64x8 sqrt(f64x8 v) { return _mm512_sqrt_pd(v); }
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
#endif

SPLAT_INLINE bool any(Mask16 m) {
#if SPLAT_AVX512
    return m.bits != 0;
#else
    int32_t seen = 0;
    for (int i = 0; i < 16; i++) seen |= m.lanes[i];
    return seen != 0;
#endif
}

// Writes base + i for every bit i of `bits`, lowest first; returns how many. May write junk up to
// to[15].
SPLAT_INLINE int list_bits(uint32_t bits, uint32_t base, uint32_t* to) {
#if SPLAT_AVX512
    const __m512i all =
        _mm512_add_epi32(_mm512_set1_epi32(int(base)),
                         _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15));
    _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(__mmask16(bits), all));
    return __builtin_popcount(bits);
#else
    int n = 0;
    for (; bits; bits &= bits - 1) to[n++] = base + uint32_t(__builtin_ctz(bits));
    return n;
#endif
}

// In lanes 0, 4, 8 and 12: the bits set in any of the four lanes from there on.
SPLAT_INLINE u32x16 any_of_four(u32x16 v) {
    v |= __builtin_shuffle(v, u32x16{1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14});
    return v | __builtin_shuffle(v, u32x16{2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13});
}

// The sign bit alone turns: -x where m.
SPLAT_INLINE f32x16 negate_where(Mask16 m, f32x16 v) { return select(m, -v, v); }

SPLAT_INLINE f32x16 abs(f32x16 v) { return f32x16(i32x16(v) & 0x7fffffff); }

// 1 / x to about 2^-26, for x in [0.001, 1].
SPLAT_INLINE f32x16 reciprocal(f32x16 x) {
#if SPLAT_AVX512
    const f32x16 guess = _mm512_rcp14_ps(x);
    return guess * (2.0f - x * guess);
#else
    return 1.0f / x;
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
    const f64x8 s = (m - 1.0) / (m + 1.0), s2 = s * s;
    f64x8 p = splat8(1.0 / 17);
    for (int n = 15; n > 0; n -= 2) p = p * s2 + 1.0 / n;
    return __builtin_convertvector(e, f64x8) + 2.8853900817779268 * s * p;
}

// ---- Pixels of three channels ----

struct Rgb {
    f32x16 red, green, blue;
};

template <int kPart, int... kLanes>
SPLAT_INLINE f32x16 interleave_part(const Rgb& v, std::integer_sequence<int, kLanes...>) {
    const auto lane = [](int i, int channel) { return (16 * kPart + i) % 3 == channel; };
    const i32x16 two = {(lane(kLanes, 1) ? 16 : 0) + (16 * kPart + kLanes) / 3 ...};
    const i32x16 three = {(lane(kLanes, 2) ? 16 + (16 * kPart + kLanes) / 3 : kLanes)...};
    return __builtin_shuffle(__builtin_shuffle(v.red, v.green, two), v.blue, three);
}
template <int kChannel, int... kLanes>
SPLAT_INLINE f32x16 channel(const float* pixels, std::integer_sequence<int, kLanes...>) {
    const i32x16 two = {(3 * kLanes + kChannel) % 32 ...};
    const i32x16 three = {(3 * kLanes + kChannel < 32 ? kLanes : 3 * kLanes + kChannel - 16)...};
    return __builtin_shuffle(
        __builtin_shuffle(load<f32x16>(pixels), load<f32x16>(pixels + 16), two),
        load<f32x16>(pixels + 32), three);
}
using SixteenLanes = std::make_integer_sequence<int, 16>;

// 16 pixels red, green, blue, red, ... to and from a vector per channel.
SPLAT_INLINE void interleave(const Rgb& v, float* pixels) {
    store(pixels, interleave_part<0>(v, SixteenLanes{}));
    store(pixels + 16, interleave_part<1>(v, SixteenLanes{}));
    store(pixels + 32, interleave_part<2>(v, SixteenLanes{}));
}
SPLAT_INLINE Rgb deinterleave(const float* pixels) {
    return {channel<0>(pixels, SixteenLanes{}), channel<1>(pixels, SixteenLanes{}),
            channel<2>(pixels, SixteenLanes{})};
}

// ---- Sums over lanes ----

// Lane sums of 12 vectors in a fixed order: sum(v[i]) lands in lane sum_lane(i), the other lanes
// are junk. Each step halves the lanes of two vectors into one.
constexpr int sum_lane(int i) { return 4 * (i % 4) + i / 4; }

template <int A, int B, int C, int D>
SPLAT_INLINE f32x16 quarters(f32x16 a, f32x16 b) {  // 128-bit parts A, B of a, then C, D of b
    const i32x16 order = {4 * A,      4 * A + 1,  4 * A + 2,  4 * A + 3,  4 * B,      4 * B + 1,
                          4 * B + 2,  4 * B + 3,  4 * C + 16, 4 * C + 17, 4 * C + 18, 4 * C + 19,
                          4 * D + 16, 4 * D + 17, 4 * D + 18, 4 * D + 19};
    return __builtin_shuffle(a, b, order);
}
template <int A, int B>
SPLAT_INLINE f32x16 within(f32x16 a, f32x16 b) {  // in each 128-bit part: A, B of a, A, B of b
    const i32x16 order = {A,     B,     A + 16, B + 16, A + 4,  B + 4,  A + 20, B + 20,
                          A + 8, B + 8, A + 24, B + 24, A + 12, B + 12, A + 28, B + 28};
    return __builtin_shuffle(a, b, order);
}

SPLAT_INLINE f32x16 sum_lanes(const f32x16 (&v)[12]) {
    f32x16 part[3];
    for (int i = 0; i < 3; i++) {
        const f32x16* u = v + 4 * i;
        const f32x16 a = quarters<0, 1, 0, 1>(u[0], u[1]) + quarters<2, 3, 2, 3>(u[0], u[1]);
        const f32x16 b = quarters<0, 1, 0, 1>(u[2], u[3]) + quarters<2, 3, 2, 3>(u[2], u[3]);
        part[i] = quarters<0, 2, 0, 2>(a, b) + quarters<1, 3, 1, 3>(a, b);
    }
    const f32x16 a = within<0, 1>(part[0], part[1]) + within<2, 3>(part[0], part[1]);
    const f32x16 b = within<0, 1>(part[2], part[2]) + within<2, 3>(part[2], part[2]);
    return within<0, 2>(a, b) + within<1, 3>(a, b);
}

// The same for 4 vectors: sum(v[i]) lands in lane 4 i.
SPLAT_INLINE f32x16 sum_lanes(const f32x16 (&v)[4]) {
    const f32x16 a = quarters<0, 1, 0, 1>(v[0], v[1]) + quarters<2, 3, 2, 3>(v[0], v[1]);
    const f32x16 b = quarters<0, 1, 0, 1>(v[2], v[3]) + quarters<2, 3, 2, 3>(v[2], v[3]);
    const f32x16 part = quarters<0, 2, 0, 2>(a, b) + quarters<1, 3, 1, 3>(a, b);
    const f32x16 pairs = within<0, 1>(part, part) + within<2, 3>(part, part);
    return within<0, 2>(pairs, pairs) + within<1, 3>(pairs, pairs);
}

}  // namespace splat
