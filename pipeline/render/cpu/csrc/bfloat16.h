// bfloat16, the upper half of a float32: its range, and 8 bits of precision.
#pragma once

#include "simd.h"

namespace splat {

template <int N>
struct Halves {
    typedef uint16_t Register __attribute__((vector_size(2 * N)));
};

// Between 16-bit and 32-bit lanes. GCC 12 converts a vector of AVX-512 in halves.
template <int N>
SPLAT_INLINE Unsigned<N> widen_halves(const void* from) {
    if constexpr (kOneRegister<uint32_t, N>) {
#if SPLAT_AVX512
        const __m256i halves = _mm256_loadu_si256(static_cast<const __m256i*>(from));
        return {(typename Unsigned<N>::Register)_mm512_cvtepu16_epi32(halves)};
#else
        typename Halves<N>::Register halves;
        std::memcpy(&halves, from, sizeof(halves));
        return {__builtin_convertvector(halves, typename Unsigned<N>::Register)};
#endif
    } else {
        const auto upper = static_cast<const uint16_t*>(from) + N / 2;
        return {widen_halves<N / 2>(from), widen_halves<N / 2>(upper)};
    }
}
template <int N>
SPLAT_INLINE void narrow_halves(void* to, Unsigned<N> v) {
    if constexpr (kOneRegister<uint32_t, N>) {
#if SPLAT_AVX512
        const __m256i halves = _mm512_cvtepi32_epi16((__m512i)v.lanes);
        _mm256_storeu_si256(static_cast<__m256i*>(to), halves);
#else
        const auto halves = __builtin_convertvector(v.lanes, typename Halves<N>::Register);
        std::memcpy(to, &halves, sizeof(halves));
#endif
    } else {
        narrow_halves(to, v.low);
        narrow_halves(static_cast<uint16_t*>(to) + N / 2, v.high);
    }
}

// The first `count` lanes of 16; the others are zeros.
SPLAT_INLINE f32x16 load_bfloat16(const uint16_t* from, int64_t count) {
    if (count >= 16) return bit_cast<f32x16>(widen_halves<16>(from) << 16);
    uint16_t padded[16] = {};
    std::memcpy(padded, from, count * sizeof(uint16_t));
    return bit_cast<f32x16>(widen_halves<16>(padded) << 16);
}
// Rounds to nearest, ties to even. NaN may become another value.
SPLAT_INLINE void store_bfloat16(uint16_t* to, f32x16 v, int64_t count) {
    const u32x16 bits = bit_cast<u32x16>(v);
    const u32x16 rounded = (bits + 0x7fffu + (bits >> 16 & 1u)) >> 16;
    if (count >= 16) return narrow_halves(to, rounded);
    uint16_t padded[16];
    narrow_halves(padded, rounded);
    std::memcpy(to, padded, count * sizeof(uint16_t));
}

}  // namespace splat
