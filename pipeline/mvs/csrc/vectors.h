// Vectors of one register: 16 lanes with AVX-512, 8 with AVX2, otherwise 4. GCC and Clang define
// the arithmetic of these types on every target.
#pragma once

#include <cstdint>
#if defined(__SSE2__)
#include <immintrin.h>
#endif

#define MVS_INLINE inline __attribute__((always_inline))

namespace mvs {

#if defined(__AVX512F__)
constexpr int LANES = 16;
#elif defined(__AVX2__)
constexpr int LANES = 8;
#else
constexpr int LANES = 4;
#endif

typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));
typedef uint32_t Bits __attribute__((vector_size(4 * LANES)));

MVS_INLINE Floats all(float x) { return x - Floats{}; }
MVS_INLINE Ints all_ints(int32_t x) { return x + Ints{}; }

MVS_INLINE Floats load(const float* from) {
    typedef Floats Unaligned __attribute__((aligned(4), may_alias));
    return *reinterpret_cast<const Unaligned*>(from);
}
MVS_INLINE void store(float* to, Floats v) {
    typedef Floats Unaligned __attribute__((aligned(4), may_alias));
    *reinterpret_cast<Unaligned*>(to) = v;
}

MVS_INLINE Ints lane_numbers() {
    Ints v;
    for (int l = 0; l < LANES; ++l) v[l] = l;
    return v;
}

// Both return b if a is NaN.
MVS_INLINE Floats min(Floats a, Floats b) {
#if defined(__AVX512F__)
    return (Floats)_mm512_min_ps((__m512)a, (__m512)b);
#elif defined(__AVX2__)
    return (Floats)_mm256_min_ps((__m256)a, (__m256)b);
#else
    return a < b ? a : b;
#endif
}
MVS_INLINE Floats max(Floats a, Floats b) {
#if defined(__AVX512F__)
    return (Floats)_mm512_max_ps((__m512)a, (__m512)b);
#elif defined(__AVX2__)
    return (Floats)_mm256_max_ps((__m256)a, (__m256)b);
#else
    return a > b ? a : b;
#endif
}

MVS_INLINE Floats square_root(Floats v) {
#if defined(__AVX512F__)
    return (Floats)_mm512_sqrt_ps((__m512)v);
#elif defined(__AVX2__)
    return (Floats)_mm256_sqrt_ps((__m256)v);
#elif defined(__SSE2__)
    return (Floats)_mm_sqrt_ps((__m128)v);
#else
    for (int l = 0; l < LANES; ++l) v[l] = __builtin_sqrtf(v[l]);
    return v;
#endif
}

// table[index] for each lane.
MVS_INLINE Bits gather(const uint32_t* table, Ints index) {
#if defined(__AVX512F__)
    return (Bits)_mm512_i32gather_epi32((__m512i)index, table, 4);
#elif defined(__AVX2__)
    return (Bits)_mm256_i32gather_epi32(reinterpret_cast<const int*>(table), (__m256i)index, 4);
#else
    Bits v;
    for (int l = 0; l < LANES; ++l) v[l] = table[index[l]];
    return v;
#endif
}

MVS_INLINE bool any(Ints mask) {
#if defined(__AVX512F__)
    return _mm512_test_epi32_mask((__m512i)mask, (__m512i)mask) != 0;
#elif defined(__AVX2__)
    return _mm256_movemask_epi8((__m256i)mask) != 0;
#else
    int32_t found = 0;
    for (int l = 0; l < LANES; ++l) found |= mask[l];
    return found != 0;
#endif
}

MVS_INLINE Floats to_floats(Ints v) { return __builtin_convertvector(v, Floats); }
// Truncates.
MVS_INLINE Ints to_ints(Floats v) { return __builtin_convertvector(v, Ints); }

// exp(x) for x <= 0, relative error 2e-6: 2^n 2^f with |f| <= 1/2, and the Taylor series of 2^f.
MVS_INLINE Floats exp_negative(Floats x) {
    const Floats scaled = max(x * 1.44269504f, all(-100.0f));
    const Ints n = to_ints(scaled - 0.5f);
    const Floats f = (scaled - to_floats(n)) * 0.693147181f;
    Floats sum = f * (1.0f / 720) + 1.0f / 120;
    sum = sum * f + 1.0f / 24;
    sum = sum * f + 1.0f / 6;
    sum = sum * f + 0.5f;
    sum = sum * f + 1.0f;
    sum = sum * f + 1.0f;
    return sum * (Floats)((n + 127) << 23);
}

}  // namespace mvs
