// Vectors with a fixed number of lanes, independent of the target. A vector that fits is one
// register; a longer one is a pair of vectors of half the lanes. A 16-lane float32 vector is one
// AVX-512 register, two AVX2 registers, or four SSE or NEON registers.
//
// GCC and Clang could split long vectors themselves, but GCC does it lane by lane through memory.
#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>

#define SPLAT_INLINE inline __attribute__((always_inline))

#if defined(__x86_64__)
#include "registers_x86.h"
#elif defined(__aarch64__)
#include "registers_neon.h"
#else
#error "the kernels are written for x86-64 and aarch64"
#endif

namespace splat {

// ---- Types ----

template <class T, int N>
constexpr bool kOneRegister = N * sizeof(T) <= kRegisterBytes;

template <class T, int N, bool = kOneRegister<T, N>>
struct Vector {
    Vector<T, N / 2> low, high;
};
template <class T, int N>
struct Vector<T, N, true> {
    typedef T Register __attribute__((vector_size(N * sizeof(T))));
    Register lanes;
};

// One boolean per lane of Vector<T, N>.
template <class T, int N, bool = kOneRegister<T, N>>
struct Mask {
    Mask<T, N / 2> low, high;
};
template <class T, int N>
struct Mask<T, N, true> {
#if SPLAT_AVX512
    native::MaskBits<N> lanes;
#else
    typename Vector<T, N>::Register lanes;
#endif
};

using f32x16 = Vector<float, 16>;
using i32x16 = Vector<int32_t, 16>;
using u32x16 = Vector<uint32_t, 16>;  // wraps around: for bits, and lanes with undefined values
using Mask16 = Mask<float, 16>;

template <int N>
using Signed = Vector<int32_t, N>;
template <int N>
using Unsigned = Vector<uint32_t, N>;

// ---- Memory ----

// Register by register: GCC 12 copies 32 bytes as two halves, and a load of a whole register after
// stores of its halves stalls.
template <class V>
SPLAT_INLINE V load(const void* from) {
    if constexpr (sizeof(V) <= kRegisterBytes) {
        typedef typename V::Register Unaligned __attribute__((aligned(1), may_alias));
        return {*static_cast<const Unaligned*>(from)};
    } else {
        using Half = decltype(V::low);
        return {load<Half>(from), load<Half>(static_cast<const char*>(from) + sizeof(Half))};
    }
}
template <class V>
SPLAT_INLINE void store(void* to, V v) {
    if constexpr (sizeof(V) <= kRegisterBytes) {
        typedef typename V::Register Unaligned __attribute__((aligned(1), may_alias));
        *static_cast<Unaligned*>(to) = v.lanes;
    } else {
        store(to, v.low);
        store(static_cast<char*>(to) + sizeof(v.low), v.high);
    }
}

// The first `count` lanes of 16; the others are zeros. Whole vectors are not copied through memory.
SPLAT_INLINE f32x16 load_first(const float* from, int64_t count) {
    if (count >= 16) return load<f32x16>(from);
    f32x16 v = {};
    std::memcpy(&v, from, count * sizeof(float));
    return v;
}
SPLAT_INLINE void store_first(float* to, f32x16 v, int64_t count) {
    if (count >= 16)
        store(to, v);
    else
        std::memcpy(to, &v, count * sizeof(float));
}

// The bits of a vector as one of another type.
template <class To, class T, int N>
SPLAT_INLINE To bit_cast(Vector<T, N> v) {
    static_assert(sizeof(To) == sizeof(v));
    if constexpr (kOneRegister<T, N>)
        return {(typename To::Register)v.lanes};
    else
        return {bit_cast<decltype(To::low)>(v.low), bit_cast<decltype(To::high)>(v.high)};
}

// ---- Arithmetic, lane by lane ----

template <class V, class T>
SPLAT_INLINE V broadcast(T x) {
    V v;
    if constexpr (sizeof(V) <= kRegisterBytes) {
        // Not 0 + x, which is +0 for x = -0.
        if constexpr (std::is_floating_point_v<T>)
            v.lanes = x - typename V::Register{};
        else
            v.lanes = typename V::Register{} + x;
    } else {
        v.low = v.high = broadcast<decltype(V::low)>(x);
    }
    return v;
}
SPLAT_INLINE f32x16 splat16(float x) { return broadcast<f32x16>(x); }

template <class T>
using Scalar = std::common_type_t<T>;  // not deduced: literals convert

#define SPLAT_OPERATOR(op)                                                  \
    template <class T, int N>                                               \
    SPLAT_INLINE Vector<T, N> operator op(Vector<T, N> a, Vector<T, N> b) { \
        if constexpr (kOneRegister<T, N>)                                   \
            return {a.lanes op b.lanes};                                    \
        else                                                                \
            return {a.low op b.low, a.high op b.high};                      \
    }                                                                       \
    template <class T, int N>                                               \
    SPLAT_INLINE Vector<T, N> operator op(Vector<T, N> a, Scalar<T> b) {    \
        return a op broadcast<Vector<T, N>>(b);                             \
    }                                                                       \
    template <class T, int N>                                               \
    SPLAT_INLINE Vector<T, N> operator op(Scalar<T> a, Vector<T, N> b) {    \
        return broadcast<Vector<T, N>>(a) op b;                             \
    }                                                                       \
    template <class T, int N, class B>                                      \
    SPLAT_INLINE Vector<T, N>& operator op## = (Vector<T, N> & a, B b) {    \
        return a = a op b;                                                  \
    }
SPLAT_OPERATOR(+)
SPLAT_OPERATOR(-)
SPLAT_OPERATOR(*)
SPLAT_OPERATOR(/)
SPLAT_OPERATOR(&)
SPLAT_OPERATOR(|)
#undef SPLAT_OPERATOR

// a - b c with one rounding where the target has fused multiply-add. Compilers contract the plain
// expression only where b c has no other use.
template <int N>
SPLAT_INLINE Vector<float, N> minus_product(Vector<float, N> a, Vector<float, N> b,
                                            Vector<float, N> c) {
    if constexpr (kOneRegister<float, N>)
        return {native::minus_product(a.lanes, b.lanes, c.lanes)};
    else
        return {minus_product(a.low, b.low, c.low), minus_product(a.high, b.high, c.high)};
}

template <class T, int N>
SPLAT_INLINE Vector<T, N> operator-(Vector<T, N> v) {
    if constexpr (kOneRegister<T, N>)
        return {-v.lanes};
    else
        return {-v.low, -v.high};
}
template <class T, int N>
SPLAT_INLINE Vector<T, N> operator<<(Vector<T, N> v, int bits) {
    if constexpr (kOneRegister<T, N>)
        return {v.lanes << bits};
    else
        return {v.low << bits, v.high << bits};
}
template <class T, int N>
SPLAT_INLINE Vector<T, N> operator>>(Vector<T, N> v, int bits) {
    if constexpr (kOneRegister<T, N>)
        return {v.lanes >> bits};
    else
        return {v.low >> bits, v.high >> bits};
}

// v[i] << bits[i], for bits in [0, 31].
template <int N>
SPLAT_INLINE Unsigned<N> shift_left(Unsigned<N> v, Signed<N> bits) {
    if constexpr (kOneRegister<uint32_t, N>)
        return {native::shift_left(v.lanes, bits.lanes)};
    else
        return {shift_left(v.low, bits.low), shift_left(v.high, bits.high)};
}

// min and max return b if a or b is NaN.
#define SPLAT_FUNCTION(name)                                         \
    template <class T, int N>                                        \
    SPLAT_INLINE Vector<T, N> name(Vector<T, N> a, Vector<T, N> b) { \
        if constexpr (kOneRegister<T, N>)                            \
            return {native::name(a.lanes, b.lanes)};                 \
        else                                                         \
            return {name(a.low, b.low), name(a.high, b.high)};       \
    }
SPLAT_FUNCTION(min)
SPLAT_FUNCTION(max)
#undef SPLAT_FUNCTION
#define SPLAT_FUNCTION(name)                         \
    template <class T, int N>                        \
    SPLAT_INLINE Vector<T, N> name(Vector<T, N> v) { \
        if constexpr (kOneRegister<T, N>)            \
            return {native::name(v.lanes)};          \
        else                                         \
            return {name(v.low), name(v.high)};      \
    }
SPLAT_FUNCTION(sqrt)
SPLAT_FUNCTION(floor)
SPLAT_FUNCTION(ceil)
#undef SPLAT_FUNCTION

template <int N>
SPLAT_INLINE Vector<float, N> abs(Vector<float, N> v) {
    return bit_cast<Vector<float, N>>(bit_cast<Unsigned<N>>(v) & 0x7fffffffu);
}

// ---- Masks ----

#if SPLAT_AVX512
#define SPLAT_COMPARISON(name, op)                                 \
    template <class T, int N>                                      \
    SPLAT_INLINE Mask<T, N> name(Vector<T, N> a, Vector<T, N> b) { \
        return {native::name(a.lanes, b.lanes)};                   \
    }
#else
#define SPLAT_COMPARISON(name, op)                                          \
    template <class T, int N>                                               \
    SPLAT_INLINE Mask<T, N> name(Vector<T, N> a, Vector<T, N> b) {          \
        if constexpr (kOneRegister<T, N>)                                   \
            return {(typename Vector<T, N>::Register)(a.lanes op b.lanes)}; \
        else                                                                \
            return {name(a.low, b.low), name(a.high, b.high)};              \
    }
#endif
SPLAT_COMPARISON(ge, >=)
SPLAT_COMPARISON(gt, >)
SPLAT_COMPARISON(eq, ==)
#undef SPLAT_COMPARISON
// False for NaN, as all comparisons.
#define SPLAT_COMPARISON(op, expression)                                  \
    template <class T, int N>                                             \
    SPLAT_INLINE Mask<T, N> operator op(Vector<T, N> a, Vector<T, N> b) { \
        return expression;                                                \
    }                                                                     \
    template <class T, int N>                                             \
    SPLAT_INLINE Mask<T, N> operator op(Vector<T, N> a, Scalar<T> b) {    \
        return a op broadcast<Vector<T, N>>(b);                           \
    }
SPLAT_COMPARISON(>=, ge(a, b))
SPLAT_COMPARISON(>, gt(a, b))
SPLAT_COMPARISON(<=, ge(b, a))
SPLAT_COMPARISON(<, gt(b, a))
SPLAT_COMPARISON(==, eq(a, b))
#undef SPLAT_COMPARISON

#if SPLAT_AVX512
#define SPLAT_MASK_OPERATOR(op)                                       \
    template <class T, int N>                                         \
    SPLAT_INLINE Mask<T, N> operator op(Mask<T, N> a, Mask<T, N> b) { \
        return {{uint16_t(a.lanes.bits op b.lanes.bits)}};            \
    }
#else
#define SPLAT_MASK_OPERATOR(op)                                                         \
    template <class T, int N>                                                           \
    SPLAT_INLINE Mask<T, N> operator op(Mask<T, N> a, Mask<T, N> b) {                   \
        if constexpr (kOneRegister<T, N>) {                                             \
            using Bits = typename Vector<uint32_t, int(N * sizeof(T) / 4)>::Register;   \
            return {(typename Vector<T, N>::Register)((Bits)a.lanes op(Bits) b.lanes)}; \
        } else {                                                                        \
            return {a.low op b.low, a.high op b.high};                                  \
        }                                                                               \
    }
#endif
SPLAT_MASK_OPERATOR(&)
SPLAT_MASK_OPERATOR(|)
#undef SPLAT_MASK_OPERATOR

template <class T, int N>
SPLAT_INLINE Vector<T, N> select(Mask<T, N> m, Vector<T, N> yes, Vector<T, N> no) {
    if constexpr (kOneRegister<T, N>)
        return {native::select(m.lanes, yes.lanes, no.lanes)};
    else
        return {select(m.low, yes.low, no.low), select(m.high, yes.high, no.high)};
}

// v if m, otherwise 0.
template <class T, int N>
SPLAT_INLINE Vector<T, N> keep(Mask<T, N> m, Vector<T, N> v) {
#if SPLAT_AVX512
    return {native::keep(m.lanes, v.lanes)};
#else
    if constexpr (kOneRegister<T, N>) {
        using Bits = typename Vector<uint32_t, int(N * sizeof(T) / 4)>::Register;
        return {(typename Vector<T, N>::Register)((Bits)m.lanes & (Bits)v.lanes)};
    } else {
        return {keep(m.low, v.low), keep(m.high, v.high)};
    }
#endif
}

// a b if m, otherwise 0.
template <class T, int N>
SPLAT_INLINE Vector<T, N> product(Mask<T, N> m, Vector<T, N> a, Vector<T, N> b) {
#if SPLAT_AVX512
    return {native::product(m.lanes, a.lanes, b.lanes)};
#else
    return keep(m, a * b);
#endif
}

// One bit per lane, the first lane in bit 0.
template <class T, int N>
SPLAT_INLINE uint32_t bits(Mask<T, N> m) {
#if SPLAT_AVX512
    return m.lanes.bits;
#else
    if constexpr (kOneRegister<T, N>)
        return native::mask_bits(m.lanes);
    else
        return bits(m.low) | bits(m.high) << (N / 2);
#endif
}
template <class T, int N>
SPLAT_INLINE bool any(Mask<T, N> m) {
#if SPLAT_AVX512
    return m.lanes.bits != 0;
#else
    if constexpr (kOneRegister<T, N>)
        return native::mask_bits(m.lanes) != 0;
    else
        return any(m.low | m.high);
#endif
}

// Lanes in which bit number `bit` is set.
template <int N>
SPLAT_INLINE Mask<float, N> has_bit(Unsigned<N> v, int bit) {
#if SPLAT_AVX512
    return {native::has_bit((__m512i)v.lanes, bit)};
#else
    if constexpr (kOneRegister<uint32_t, N>)
        return {(typename Vector<float, N>::Register)(
            (typename Signed<N>::Register)(v.lanes << (31 - bit)) < 0)};
    else
        return {has_bit(v.low, bit), has_bit(v.high, bit)};
#endif
}

template <int N>
SPLAT_INLINE Mask<float, N> gt(Signed<N> a, int32_t b) {
#if SPLAT_AVX512
    return {native::gt((__m512i)a.lanes, _mm512_set1_epi32(b))};
#else
    if constexpr (kOneRegister<int32_t, N>)
        return {(typename Vector<float, N>::Register)(a.lanes > b)};
    else
        return {gt(a.low, b), gt(a.high, b)};
#endif
}

// The lanes whose bits are set.
SPLAT_INLINE Mask16 mask(uint32_t bits) {
#if SPLAT_AVX512
    return {{uint16_t(bits)}};
#else
    alignas(64) static constexpr uint32_t kBit[16] = {
        1,      1 << 1, 1 << 2,  1 << 3,  1 << 4,  1 << 5,  1 << 6,  1 << 7,
        1 << 8, 1 << 9, 1 << 10, 1 << 11, 1 << 12, 1 << 13, 1 << 14, 1 << 15};
    const i32x16 set = bit_cast<i32x16>(load<u32x16>(kBit) & bits);
    return gt(set, 0);
#endif
}

// ---- Conversions ----

alignas(64) constexpr float kLaneNumbers[16] = {0, 1, 2,  3,  4,  5,  6,  7,
                                                8, 9, 10, 11, 12, 13, 14, 15};
SPLAT_INLINE f32x16 lane_numbers() { return load<f32x16>(kLaneNumbers); }

// Truncates; undefined if the result does not fit.
template <int N>
SPLAT_INLINE Signed<N> to_int(Vector<float, N> v) {
    if constexpr (kOneRegister<float, N>)
        return {(typename Signed<N>::Register)native::truncate(v.lanes)};
    else
        return {to_int(v.low), to_int(v.high)};
}

// Between float32 and float64, if the latter is one register.
template <int N>
SPLAT_INLINE Vector<double, N> widen(Vector<float, N> v) {
    return {native::widen(v.lanes)};
}
template <int N>
SPLAT_INLINE Vector<float, N> narrow(Vector<double, N> v) {
    return {native::narrow(v.lanes)};
}

// Joins vectors in registers: a load of a whole register after stores of its parts would stall.
template <int N>
SPLAT_INLINE Vector<float, 2 * N> combine(Vector<float, N> low, Vector<float, N> high) {
    if constexpr (kOneRegister<float, 2 * N>)
        return {native::combine(low.lanes, high.lanes)};
    else
        return {low, high};
}
template <int kCount, int N>
SPLAT_INLINE Vector<float, kCount * N> join(const Vector<float, N>* parts) {
    if constexpr (kCount == 1)
        return parts[0];
    else
        return combine(join<kCount / 2>(parts), join<kCount / 2>(parts + kCount / 2));
}

}  // namespace splat
