// Rearrangements of lanes: constant shuffles of two vectors at a time.
#pragma once

#include <utility>

#include "simd.h"

namespace splat {

using SixteenLanes = std::make_integer_sequence<int, 16>;

// ---- 16 rows of K floats, 2 to 4, to and from a vector per column ----

template <int K, int kColumn, int... kLanes>
SPLAT_INLINE f32x16 column_of(const f32x16* rows, std::integer_sequence<int, kLanes...>) {
    constexpr auto at = [](int lane) { return K * lane + kColumn; };
    f32x16 v =
        __builtin_shuffle(rows[0], rows[1], i32x16{(at(kLanes) < 32 ? at(kLanes) : kLanes)...});
    if constexpr (K > 2)
        v = __builtin_shuffle(v, rows[2],
                              i32x16{(at(kLanes) / 16 == 2 ? at(kLanes) - 16 : kLanes)...});
    if constexpr (K > 3)
        v = __builtin_shuffle(v, rows[3],
                              i32x16{(at(kLanes) / 16 == 3 ? at(kLanes) - 32 : kLanes)...});
    return v;
}
template <int K, int kPart, int... kLanes>
SPLAT_INLINE f32x16 rows_of(const f32x16* columns, std::integer_sequence<int, kLanes...>) {
    constexpr auto column = [](int lane) { return (16 * kPart + lane) % K; };
    constexpr auto row = [](int lane) { return (16 * kPart + lane) / K; };
    f32x16 v = __builtin_shuffle(columns[0], columns[1],
                                 i32x16{((column(kLanes) == 1 ? 16 : 0) + row(kLanes))...});
    if constexpr (K > 2)
        v = __builtin_shuffle(v, columns[2],
                              i32x16{(column(kLanes) == 2 ? 16 + row(kLanes) : kLanes)...});
    if constexpr (K > 3)
        v = __builtin_shuffle(v, columns[3],
                              i32x16{(column(kLanes) == 3 ? 16 + row(kLanes) : kLanes)...});
    return v;
}
template <int K, int... kColumns>
SPLAT_INLINE void deinterleave(const float* from, f32x16* to,
                               std::integer_sequence<int, kColumns...>) {
    f32x16 rows[K];
    std::memcpy(rows, from, sizeof(rows));
    ((to[kColumns] = column_of<K, kColumns>(rows, SixteenLanes{})), ...);
}
template <int K, int... kParts>
SPLAT_INLINE void interleave(const f32x16* columns, float* to,
                             std::integer_sequence<int, kParts...>) {
    (store(to + 16 * kParts, rows_of<K, kParts>(columns, SixteenLanes{})), ...);
}
template <int K>
SPLAT_INLINE void deinterleave(const float* from, f32x16 (&to)[K]) {
    deinterleave<K>(from, to, std::make_integer_sequence<int, K>{});
}
template <int K>
SPLAT_INLINE void interleave(const f32x16 (&columns)[K], float* to) {
    interleave<K>(columns, to, std::make_integer_sequence<int, K>{});
}

// ---- 4 x 4 pixels: from rows, which begin with 4 pixels of K floats, to a vector per channel ----

template <int K, int kChannel, int... kLanes>
SPLAT_INLINE f32x16 channel_of(const f32x16* rows, std::integer_sequence<int, kLanes...>) {
    const i32x16 order = {(16 * (kLanes / 4 % 2) + K * (kLanes % 4) + kChannel)...};
    return __builtin_shuffle(__builtin_shuffle(rows[0], rows[1], order),
                             __builtin_shuffle(rows[2], rows[3], order),
                             i32x16{(kLanes < 8 ? kLanes : 16 + kLanes)...});
}
template <int K, int kRow, int... kLanes>
SPLAT_INLINE f32x16 pixels_of(const f32x16* channels, std::integer_sequence<int, kLanes...>) {
    constexpr auto pixel = [](int lane) { return 4 * kRow + lane / K % 4; };
    f32x16 v = __builtin_shuffle(channels[0], i32x16{pixel(kLanes)...});
    if constexpr (K == 3) {
        v = __builtin_shuffle(v, channels[1],
                              i32x16{(kLanes % K == 1 ? 16 + pixel(kLanes) : kLanes)...});
        v = __builtin_shuffle(v, channels[2],
                              i32x16{(kLanes % K == 2 ? 16 + pixel(kLanes) : kLanes)...});
    }
    return v;
}
template <int K, int... kChannels>
SPLAT_INLINE void to_channels(const f32x16* rows, f32x16* channels,
                              std::integer_sequence<int, kChannels...>) {
    ((channels[kChannels] = channel_of<K, kChannels>(rows, SixteenLanes{})), ...);
}
template <int K, int... kRows>
SPLAT_INLINE void to_rows(const f32x16* channels, f32x16* rows,
                          std::integer_sequence<int, kRows...>) {
    ((rows[kRows] = pixels_of<K, kRows>(channels, SixteenLanes{})), ...);
}
template <int K>
SPLAT_INLINE void to_channels(const f32x16 (&rows)[4], f32x16 (&channels)[K]) {
    to_channels<K>(rows, channels, std::make_integer_sequence<int, K>{});
}
template <int K>
SPLAT_INLINE void to_rows(const f32x16 (&channels)[K], f32x16 (&rows)[4]) {
    to_rows<K>(channels, rows, std::make_integer_sequence<int, 4>{});
}

// ---- 16 x 16 transposed ----

template <int kStep, int... kLanes>
SPLAT_INLINE void swap_blocks(f32x16& a, f32x16& b, std::integer_sequence<int, kLanes...>) {
    const i32x16 upper = {(kLanes & kStep ? 16 + kLanes - kStep : kLanes)...};
    const i32x16 lower = {(kLanes & kStep ? 16 + kLanes : kLanes + kStep)...};
    const f32x16 first = __builtin_shuffle(a, b, upper);
    b = __builtin_shuffle(a, b, lower);
    a = first;
}
template <int kStep>
SPLAT_INLINE void transpose_step(f32x16* rows) {
    for (int i = 0; i < 16; i++)
        if (!(i & kStep)) swap_blocks<kStep>(rows[i], rows[i + kStep], SixteenLanes{});
}
SPLAT_INLINE void transpose(f32x16* rows) {  // 16 x 16
    transpose_step<8>(rows);
    transpose_step<4>(rows);
    transpose_step<2>(rows);
    transpose_step<1>(rows);
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
