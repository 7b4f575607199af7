// Operations on one NEON register of 128 bits (aarch64). GCC and Clang define + - * / & | on
// register types.
#pragma once

#include <arm_neon.h>

#include <cstdint>

namespace splat {

#define SPLAT_AVX512 0
#define SPLAT_AVX2 0

constexpr int kRegisterBytes = 16;

namespace native {

SPLAT_INLINE float32x4_t minus_product(float32x4_t a, float32x4_t b, float32x4_t c) {
    return vfmsq_f32(a, b, c);
}
// min and max return b if a or b is NaN, on every instruction set; NEON's instructions return NaN.
SPLAT_INLINE float32x4_t min(float32x4_t a, float32x4_t b) {
    return vbslq_f32(vcltq_f32(a, b), a, b);
}
SPLAT_INLINE float32x4_t max(float32x4_t a, float32x4_t b) {
    return vbslq_f32(vcgtq_f32(a, b), a, b);
}
SPLAT_INLINE float64x2_t min(float64x2_t a, float64x2_t b) {
    return vbslq_f64(vcltq_f64(a, b), a, b);
}
SPLAT_INLINE float64x2_t max(float64x2_t a, float64x2_t b) {
    return vbslq_f64(vcgtq_f64(a, b), a, b);
}
SPLAT_INLINE float32x4_t sqrt(float32x4_t v) { return vsqrtq_f32(v); }
SPLAT_INLINE float64x2_t sqrt(float64x2_t v) { return vsqrtq_f64(v); }
SPLAT_INLINE float32x4_t floor(float32x4_t v) { return vrndmq_f32(v); }
SPLAT_INLINE float64x2_t floor(float64x2_t v) { return vrndmq_f64(v); }
SPLAT_INLINE float32x4_t ceil(float32x4_t v) { return vrndpq_f32(v); }
SPLAT_INLINE float64x2_t ceil(float64x2_t v) { return vrndpq_f64(v); }
// v[i] << bits[i]
SPLAT_INLINE uint32x4_t shift_left(uint32x4_t v, int32x4_t bits) { return vshlq_u32(v, bits); }
SPLAT_INLINE int32x4_t truncate(float32x4_t v) { return vcvtq_s32_f32(v); }

// Conversions of as many lanes as float64 values fit into a register.
SPLAT_INLINE float64x2_t widen(float32x2_t v) { return vcvt_f64_f32(v); }
SPLAT_INLINE float32x2_t narrow(float64x2_t v) { return vcvt_f32_f64(v); }

SPLAT_INLINE float32x4_t combine(float32x2_t low, float32x2_t high) {
    return vcombine_f32(low, high);
}

// 8 bytes as 8 numbers of 32 bits.
SPLAT_INLINE void widen_bytes(const uint8_t* from, void* to) {
    const uint16x8_t words = vmovl_u8(vld1_u8(from));
    vst1q_u32(static_cast<uint32_t*>(to), vmovl_u16(vget_low_u16(words)));
    vst1q_u32(static_cast<uint32_t*>(to) + 4, vmovl_high_u16(words));
}

// The low bytes, after a right shift, of lanes 0, kStep, 2 kStep, ... of the 16 numbers at `from`.
// Each kStep neighbours must be equal.
template <int kStep>
SPLAT_INLINE uint64_t first_bytes(const uint32_t* from, int shift) {
    static_assert(kStep == 2);
    const int32x4_t right = vdupq_n_s32(-shift);
    const auto quarter = [&](int i) {
        return vmovn_u32(vshlq_u32(vld1q_u32(from + 4 * i), right));
    };
    const uint16x8_t low = vcombine_u16(quarter(0), quarter(1));
    const uint16x8_t high = vcombine_u16(quarter(2), quarter(3));
    return vget_lane_u64(vreinterpret_u64_u8(vmovn_u16(vuzp1q_u16(low, high))), 0);
}

// The low nibbles of all bytes, packed, in the lower half; the high nibbles in the upper half.
SPLAT_INLINE uint64_t split_nibbles(uint64_t bytes) {
    const uint8x8_t v = vcreate_u8(bytes);
    const uint8x8_t low = vand_u8(v, vdup_n_u8(15)), high = vshr_n_u8(v, 4);
    const uint8x8_t even = vuzp1_u8(low, high), odd = vuzp2_u8(low, high);
    return vget_lane_u64(vreinterpret_u64_u8(vorr_u8(even, vshl_n_u8(odd, 4))), 0);
}

// ---- Masks: lanes of 0 or -1 ----

SPLAT_INLINE uint32_t mask_bits(float32x4_t m) {
    const uint32x4_t bit = {1, 2, 4, 8};
    return vaddvq_u32(vandq_u32(vreinterpretq_u32_f32(m), bit));
}
SPLAT_INLINE uint32_t mask_bits(float64x2_t m) {
    const uint64x2_t bit = {1, 2};
    return uint32_t(vaddvq_u64(vandq_u64(vreinterpretq_u64_f64(m), bit)));
}
SPLAT_INLINE float32x4_t select(float32x4_t m, float32x4_t yes, float32x4_t no) {
    return vbslq_f32(vreinterpretq_u32_f32(m), yes, no);
}
SPLAT_INLINE float64x2_t select(float64x2_t m, float64x2_t yes, float64x2_t no) {
    return vbslq_f64(vreinterpretq_u64_f64(m), yes, no);
}

}  // namespace native
}  // namespace splat
