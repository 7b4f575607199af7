// Operations on one NEON register of 128 bits (aarch64). Arithmetic needs no entry here: GCC and
// Clang define + - * / & | on register types.
#pragma once

#include <arm_neon.h>

#include <cstdint>

namespace splat {

#define SPLAT_AVX512 0
#define SPLAT_AVX2 0

constexpr int kRegisterBytes = 16;

namespace native {

// min and max are b where a or b is NaN, on every instruction set; NEON's own give NaN.
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

// As many float32 as float64 fit into a register.
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
