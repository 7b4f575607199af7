// Operations on one x86 register: 128 bits with SSE4.1, 256 with AVX2, 512 with AVX-512 (F, BW, DQ,
// VL). GCC and Clang define + - * / & | on register types.
#pragma once

#include <immintrin.h>

#include <cstdint>

namespace splat {

#if defined(__AVX512F__) && defined(__AVX512BW__) && defined(__AVX512DQ__) && defined(__AVX512VL__)
#define SPLAT_AVX512 1
#else
#define SPLAT_AVX512 0
#endif
#if defined(__AVX2__)
#define SPLAT_AVX2 1
#else
#define SPLAT_AVX2 0
#endif
#if !defined(__SSE4_1__)
#error "the x86 kernels need SSE4.1: compile with -march=x86-64-v2 or newer"
#endif

constexpr int kRegisterBytes = SPLAT_AVX512 ? 64 : SPLAT_AVX2 ? 32 : 16;

namespace native {

// min and max return b if a or b is NaN, on every instruction set.
SPLAT_INLINE __m128 min(__m128 a, __m128 b) { return _mm_min_ps(a, b); }
SPLAT_INLINE __m128 max(__m128 a, __m128 b) { return _mm_max_ps(a, b); }
SPLAT_INLINE __m128d min(__m128d a, __m128d b) { return _mm_min_pd(a, b); }
SPLAT_INLINE __m128d max(__m128d a, __m128d b) { return _mm_max_pd(a, b); }
SPLAT_INLINE __m128 sqrt(__m128 v) { return _mm_sqrt_ps(v); }
SPLAT_INLINE __m128d sqrt(__m128d v) { return _mm_sqrt_pd(v); }
SPLAT_INLINE __m128 floor(__m128 v) { return _mm_floor_ps(v); }
SPLAT_INLINE __m128d floor(__m128d v) { return _mm_floor_pd(v); }
SPLAT_INLINE __m128 ceil(__m128 v) { return _mm_ceil_ps(v); }
SPLAT_INLINE __m128d ceil(__m128d v) { return _mm_ceil_pd(v); }
SPLAT_INLINE __m128i truncate(__m128 v) { return _mm_cvttps_epi32(v); }

#if defined(__FMA__)
SPLAT_INLINE __m128 minus_product(__m128 a, __m128 b, __m128 c) { return _mm_fnmadd_ps(b, c, a); }
SPLAT_INLINE __m256 minus_product(__m256 a, __m256 b, __m256 c) {
    return _mm256_fnmadd_ps(b, c, a);
}
#else
SPLAT_INLINE __m128 minus_product(__m128 a, __m128 b, __m128 c) { return a - b * c; }
#endif

#if SPLAT_AVX2
SPLAT_INLINE __m256 min(__m256 a, __m256 b) { return _mm256_min_ps(a, b); }
SPLAT_INLINE __m256 max(__m256 a, __m256 b) { return _mm256_max_ps(a, b); }
SPLAT_INLINE __m256d min(__m256d a, __m256d b) { return _mm256_min_pd(a, b); }
SPLAT_INLINE __m256d max(__m256d a, __m256d b) { return _mm256_max_pd(a, b); }
SPLAT_INLINE __m256 sqrt(__m256 v) { return _mm256_sqrt_ps(v); }
SPLAT_INLINE __m256d sqrt(__m256d v) { return _mm256_sqrt_pd(v); }
SPLAT_INLINE __m256 floor(__m256 v) { return _mm256_floor_ps(v); }
SPLAT_INLINE __m256d floor(__m256d v) { return _mm256_floor_pd(v); }
SPLAT_INLINE __m256 ceil(__m256 v) { return _mm256_ceil_ps(v); }
SPLAT_INLINE __m256d ceil(__m256d v) { return _mm256_ceil_pd(v); }
SPLAT_INLINE __m256i truncate(__m256 v) { return _mm256_cvttps_epi32(v); }
#endif

#if SPLAT_AVX512
SPLAT_INLINE __m512 minus_product(__m512 a, __m512 b, __m512 c) {
    return _mm512_fnmadd_ps(b, c, a);
}
SPLAT_INLINE __m512 min(__m512 a, __m512 b) { return _mm512_min_ps(a, b); }
SPLAT_INLINE __m512 max(__m512 a, __m512 b) { return _mm512_max_ps(a, b); }
SPLAT_INLINE __m512d min(__m512d a, __m512d b) { return _mm512_min_pd(a, b); }
SPLAT_INLINE __m512d max(__m512d a, __m512d b) { return _mm512_max_pd(a, b); }
SPLAT_INLINE __m512 sqrt(__m512 v) { return _mm512_sqrt_ps(v); }
SPLAT_INLINE __m512d sqrt(__m512d v) { return _mm512_sqrt_pd(v); }
SPLAT_INLINE __m512 floor(__m512 v) { return _mm512_roundscale_ps(v, _MM_FROUND_TO_NEG_INF); }
SPLAT_INLINE __m512d floor(__m512d v) { return _mm512_roundscale_pd(v, _MM_FROUND_TO_NEG_INF); }
SPLAT_INLINE __m512 ceil(__m512 v) { return _mm512_roundscale_ps(v, _MM_FROUND_TO_POS_INF); }
SPLAT_INLINE __m512d ceil(__m512d v) { return _mm512_roundscale_pd(v, _MM_FROUND_TO_POS_INF); }
SPLAT_INLINE __m512i truncate(__m512 v) { return _mm512_cvttps_epi32(v); }
#endif

// Conversions of as many lanes as float64 values fit into a register.
#if SPLAT_AVX512
SPLAT_INLINE __m512d widen(__m256 v) { return _mm512_cvtps_pd(v); }
SPLAT_INLINE __m256 narrow(__m512d v) { return _mm512_cvtpd_ps(v); }
#elif SPLAT_AVX2
SPLAT_INLINE __m256d widen(__m128 v) { return _mm256_cvtps_pd(v); }
SPLAT_INLINE __m128 narrow(__m256d v) { return _mm256_cvtpd_ps(v); }
#else
typedef float Pair __attribute__((vector_size(8)));
SPLAT_INLINE __m128d widen(Pair v) { return (__m128d){v[0], v[1]}; }
SPLAT_INLINE Pair narrow(__m128d v) { return (Pair){float(v[0]), float(v[1])}; }
#endif

// Two halves of a register.
#if SPLAT_AVX512
SPLAT_INLINE __m512 combine(__m256 low, __m256 high) {
    return _mm512_insertf32x8(_mm512_castps256_ps512(low), high, 1);
}
#elif SPLAT_AVX2
SPLAT_INLINE __m256 combine(__m128 low, __m128 high) {
    return _mm256_insertf128_ps(_mm256_castps128_ps256(low), high, 1);
}
#else
SPLAT_INLINE __m128 combine(Pair low, Pair high) {
    return (__m128){low[0], low[1], high[0], high[1]};
}
#endif

// v[i] << bits[i] of 32-bit lanes.
template <class Register, class Bits>
SPLAT_INLINE Register shift_left(Register v, Bits bits) {
#if SPLAT_AVX512
    return (Register)_mm512_sllv_epi32((__m512i)v, (__m512i)bits);
#elif SPLAT_AVX2
    return (Register)_mm256_sllv_epi32((__m256i)v, (__m256i)bits);
#else  // v 2^bits, with 2^bits built as a float; the conversion of 2^31 overflows to its bit
       // pattern
    const __m128i exponent = _mm_slli_epi32(_mm_add_epi32((__m128i)bits, _mm_set1_epi32(127)), 23);
    return (Register)_mm_mullo_epi32((__m128i)v, _mm_cvttps_epi32(_mm_castsi128_ps(exponent)));
#endif
}

// 8 bytes as 8 numbers of 32 bits.
SPLAT_INLINE void widen_bytes(const uint8_t* from, void* to) {
    const __m128i bytes = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(from));
#if SPLAT_AVX2
    _mm256_storeu_si256(static_cast<__m256i*>(to), _mm256_cvtepu8_epi32(bytes));
#else
    _mm_storeu_si128(static_cast<__m128i*>(to), _mm_cvtepu8_epi32(bytes));
    _mm_storeu_si128(static_cast<__m128i*>(to) + 1, _mm_cvtepu8_epi32(_mm_srli_si128(bytes, 4)));
#endif
}

// The low bytes, after a right shift, of lanes 0, kStep, 2 kStep, ... of the 16 numbers at `from`.
// Each kStep neighbours must be equal.
template <int kStep>
SPLAT_INLINE uint64_t first_bytes(const uint32_t* from, int shift) {
    const __m128i count = _mm_cvtsi32_si128(shift);
#if SPLAT_AVX512
    const __m128i bytes = _mm512_cvtepi32_epi8(_mm512_srl_epi32(_mm512_loadu_si512(from), count));
    const __m128i order = kStep == 4 ? _mm_setr_epi32(0x0c080400, -1, -1, -1)
                                     : _mm_setr_epi32(0x06040200, 0x0e0c0a08, -1, -1);
    return uint64_t(_mm_cvtsi128_si64(_mm_shuffle_epi8(bytes, order)));
#elif SPLAT_AVX2
    static_assert(kStep == 2);
    const auto* const halves = reinterpret_cast<const __m256i*>(from);
    // Lanes 0 8 2 10 4 12 6 14
    __m256i v =
        _mm256_blend_epi32(_mm256_loadu_si256(halves), _mm256_loadu_si256(halves + 1), 0xaa);
    v = _mm256_and_si256(_mm256_srl_epi32(v, count), _mm256_set1_epi32(255));
    const __m128i words =
        _mm_packus_epi32(_mm256_castsi256_si128(v), _mm256_extracti128_si256(v, 1));
    const __m128i order = _mm_setr_epi32(0x0c080400, 0x0e0a0602, -1, -1);
    return uint64_t(_mm_cvtsi128_si64(_mm_shuffle_epi8(words, order)));
#else
    static_assert(kStep == 2);
    const auto quarter = [&](int i) {
        const __m128i v = _mm_loadu_si128(reinterpret_cast<const __m128i*>(from) + i);
        return _mm_and_si128(_mm_srl_epi32(v, count), _mm_set1_epi32(255));
    };
    const __m128i low = _mm_packus_epi32(quarter(0), quarter(1));
    const __m128i high = _mm_packus_epi32(quarter(2), quarter(3));
    const __m128i order = _mm_setr_epi32(0x0c080400, -1, -1, -1);
    return uint64_t(_mm_cvtsi128_si64(
        _mm_unpacklo_epi32(_mm_shuffle_epi8(low, order), _mm_shuffle_epi8(high, order))));
#endif
}

// The low nibbles of all bytes, packed, in the lower half; the high nibbles in the upper half.
SPLAT_INLINE uint64_t split_nibbles(uint64_t bytes) {
    const __m128i v = _mm_cvtsi64_si128(int64_t(bytes)), low = _mm_set1_epi8(15);
    const __m128i nibbles =
        _mm_unpacklo_epi64(_mm_and_si128(v, low), _mm_and_si128(_mm_srli_epi16(v, 4), low));
    const __m128i pairs = _mm_maddubs_epi16(nibbles, _mm_set1_epi16(0x1001));
    return uint64_t(_mm_cvtsi128_si64(_mm_packus_epi16(pairs, pairs)));
}

// ---- Masks: a mask register with AVX-512, otherwise lanes of 0 or -1 ----

#if SPLAT_AVX512
// Bits of a mask register. A separate class for each number of lanes.
template <int N>
struct MaskBits {
    uint16_t bits;
};
#define SPLAT_COMPARE(name, predicate)                    \
    SPLAT_INLINE MaskBits<16> name(__m512 a, __m512 b) {  \
        return {_mm512_cmp_ps_mask(a, b, predicate)};     \
    }                                                     \
    SPLAT_INLINE MaskBits<8> name(__m512d a, __m512d b) { \
        return {_mm512_cmp_pd_mask(a, b, predicate)};     \
    }
SPLAT_COMPARE(ge, _CMP_GE_OQ)
SPLAT_COMPARE(gt, _CMP_GT_OQ)
SPLAT_COMPARE(eq, _CMP_EQ_OQ)
#undef SPLAT_COMPARE
SPLAT_INLINE MaskBits<16> gt(__m512i a, __m512i b) { return {_mm512_cmpgt_epi32_mask(a, b)}; }
SPLAT_INLINE MaskBits<16> has_bit(__m512i v, int bit) {
    return {_mm512_test_epi32_mask(v, _mm512_set1_epi32(1 << bit))};
}
SPLAT_INLINE __m512 select(MaskBits<16> m, __m512 yes, __m512 no) {
    return _mm512_mask_mov_ps(no, m.bits, yes);
}
SPLAT_INLINE __m512d select(MaskBits<8> m, __m512d yes, __m512d no) {
    return _mm512_mask_mov_pd(no, __mmask8(m.bits), yes);
}
SPLAT_INLINE __m512 keep(MaskBits<16> m, __m512 v) { return _mm512_maskz_mov_ps(m.bits, v); }
SPLAT_INLINE __m512 product(MaskBits<16> m, __m512 a, __m512 b) {
    return _mm512_maskz_mul_ps(m.bits, a, b);
}
#else
SPLAT_INLINE uint32_t mask_bits(__m128 m) { return uint32_t(_mm_movemask_ps(m)); }
SPLAT_INLINE uint32_t mask_bits(__m128d m) { return uint32_t(_mm_movemask_pd(m)); }
SPLAT_INLINE __m128 select(__m128 m, __m128 yes, __m128 no) { return _mm_blendv_ps(no, yes, m); }
SPLAT_INLINE __m128d select(__m128d m, __m128d yes, __m128d no) {
    return _mm_blendv_pd(no, yes, m);
}
#if SPLAT_AVX2
SPLAT_INLINE uint32_t mask_bits(__m256 m) { return uint32_t(_mm256_movemask_ps(m)); }
SPLAT_INLINE uint32_t mask_bits(__m256d m) { return uint32_t(_mm256_movemask_pd(m)); }
SPLAT_INLINE __m256 select(__m256 m, __m256 yes, __m256 no) { return _mm256_blendv_ps(no, yes, m); }
SPLAT_INLINE __m256d select(__m256d m, __m256d yes, __m256d no) {
    return _mm256_blendv_pd(no, yes, m);
}
#endif
#endif

}  // namespace native
}  // namespace splat
