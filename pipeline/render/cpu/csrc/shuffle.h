// Permutations of lanes: between the registers of a pair without instructions, within a register by
// constant shuffles.
#pragma once

#include <utility>

#include "simd.h"

namespace splat {

template <int N>
using LaneSequence = std::make_integer_sequence<int, N>;

// Lanes kOrder of a and b, which are one register each; b's are numbered from N.
template <int... kOrder, int N>
SPLAT_INLINE Vector<float, N> shuffle(Vector<float, N> a, Vector<float, N> b) {
    static_assert(sizeof...(kOrder) == N && kOneRegister<float, N>);
#if __has_builtin(__builtin_shufflevector)
    return {__builtin_shufflevector(a.lanes, b.lanes, kOrder...)};
#else  // GCC 11
    return {__builtin_shuffle(a.lanes, b.lanes, typename Signed<N>::Register{kOrder...})};
#endif
}

// ---- N rows of K floats, 2 to 4, to and from a vector per column ----

template <int K, int kColumn, int N, int... kLanes>
SPLAT_INLINE Vector<float, N> column_of(const Vector<float, N>* rows,
                                        std::integer_sequence<int, kLanes...>) {
    constexpr auto at = [](int lane) { return K * lane + kColumn; };
    auto v = shuffle<(at(kLanes) < 2 * N ? at(kLanes) : kLanes)...>(rows[0], rows[1]);
    if constexpr (K > 2)
        v = shuffle<(at(kLanes) / N == 2 ? at(kLanes) - N : kLanes)...>(v, rows[2]);
    if constexpr (K > 3)
        v = shuffle<(at(kLanes) / N == 3 ? at(kLanes) - 2 * N : kLanes)...>(v, rows[3]);
    return v;
}
template <int K, int kPart, int N, int... kLanes>
SPLAT_INLINE Vector<float, N> rows_of(const Vector<float, N>* columns,
                                      std::integer_sequence<int, kLanes...>) {
    constexpr auto column = [](int lane) { return (N * kPart + lane) % K; };
    constexpr auto row = [](int lane) { return (N * kPart + lane) / K; };
    auto v = shuffle<((column(kLanes) == 1 ? N : 0) + row(kLanes))...>(columns[0], columns[1]);
    if constexpr (K > 2)
        v = shuffle<(column(kLanes) == 2 ? N + row(kLanes) : kLanes)...>(v, columns[2]);
    if constexpr (K > 3)
        v = shuffle<(column(kLanes) == 3 ? N + row(kLanes) : kLanes)...>(v, columns[3]);
    return v;
}
template <int K, int N, int... kColumns>
SPLAT_INLINE void deinterleave(const float* from, Vector<float, N>* to,
                               std::integer_sequence<int, kColumns...>) {
    Vector<float, N> rows[K];
    for (int k = 0; k < K; k++) rows[k] = load<Vector<float, N>>(from + N * k);
    ((to[kColumns] = column_of<K, kColumns>(rows, LaneSequence<N>{})), ...);
}
template <int K, int N, int... kParts>
SPLAT_INLINE void interleave(const Vector<float, N>* columns, float* to,
                             std::integer_sequence<int, kParts...>) {
    (store(to + N * kParts, rows_of<K, kParts>(columns, LaneSequence<N>{})), ...);
}
template <int K, int N>
SPLAT_INLINE void deinterleave(const float* from, Vector<float, N> (&to)[K]) {
    if constexpr (kOneRegister<float, N>) {
        deinterleave<K, N>(from, to, std::make_integer_sequence<int, K>{});
    } else {
        Vector<float, N / 2> low[K], high[K];
        deinterleave(from, low);
        deinterleave(from + K * N / 2, high);
        for (int k = 0; k < K; k++) to[k] = {low[k], high[k]};
    }
}
template <int K, int N>
SPLAT_INLINE void interleave(const Vector<float, N> (&columns)[K], float* to) {
    if constexpr (kOneRegister<float, N>) {
        interleave<K, N>(columns, to, std::make_integer_sequence<int, K>{});
    } else {
        Vector<float, N / 2> low[K], high[K];
        for (int k = 0; k < K; k++) low[k] = columns[k].low, high[k] = columns[k].high;
        interleave(low, to);
        interleave(high, to + K * N / 2);
    }
}

// ---- Rows of 4 pixels of K floats, 1 or 3, from and to a vector per channel ----

#if SPLAT_AVX512

// A vector contains one of 4 rows, which starts with 4 pixels.
template <int kRows, int K>
class PixelRows {
    static_assert(kRows == 4);

  public:
    SPLAT_INLINE void read(int row, const float* from, int count) {
        rows_[row] = {_mm512_maskz_loadu_ps(__mmask16((1u << K * count) - 1), from)};
    }
    SPLAT_INLINE void write(int row, float* to, int count) const {
        _mm512_mask_storeu_ps(to, __mmask16((1u << K * count) - 1), rows_[row].lanes);
    }
    SPLAT_INLINE void to_channels(f32x16 (&channels)[K]) const {
        to_channels(channels, std::make_integer_sequence<int, K>{});
    }
    SPLAT_INLINE void from_channels(const f32x16 (&channels)[K]) {
        from_channels(channels, std::make_integer_sequence<int, 4>{});
    }

  private:
    template <int kChannel, int... kLanes>
    SPLAT_INLINE f32x16 channel(std::integer_sequence<int, kLanes...>) const {
        constexpr auto at = [](int lane) {
            return 16 * (lane / 4 % 2) + K * (lane % 4) + kChannel;
        };
        return shuffle<(kLanes < 8 ? kLanes : 16 + kLanes)...>(
            shuffle<at(kLanes)...>(rows_[0], rows_[1]), shuffle<at(kLanes)...>(rows_[2], rows_[3]));
    }
    template <int kRow, int... kLanes>
    static SPLAT_INLINE f32x16 pixels(const f32x16* channels,
                                      std::integer_sequence<int, kLanes...>) {
        constexpr auto pixel = [](int lane) { return 4 * kRow + lane / K % 4; };
        f32x16 v = shuffle<pixel(kLanes)...>(channels[0], channels[0]);
        if constexpr (K == 3) {
            v = shuffle<(kLanes % K == 1 ? 16 + pixel(kLanes) : kLanes)...>(v, channels[1]);
            v = shuffle<(kLanes % K == 2 ? 16 + pixel(kLanes) : kLanes)...>(v, channels[2]);
        }
        return v;
    }
    template <int... kChannels>
    SPLAT_INLINE void to_channels(f32x16 (&channels)[K],
                                  std::integer_sequence<int, kChannels...>) const {
        ((channels[kChannels] = channel<kChannels>(LaneSequence<16>{})), ...);
    }
    template <int... kEach>
    SPLAT_INLINE void from_channels(const f32x16* channels, std::integer_sequence<int, kEach...>) {
        ((rows_[kEach] = pixels<kEach>(channels, LaneSequence<16>{})), ...);
    }

    f32x16 rows_[4] = {};
};

#else

// A row is one vector of 4 pixels per channel.
template <int kRows, int K>
class PixelRows {
  public:
    SPLAT_INLINE void read(int row, const float* from, int count) {
        float padded[4 * K] = {};
        if (count < 4)
            from = static_cast<float*>(std::memcpy(padded, from, K * count * sizeof(float)));
        Quarter channels[K];
        if constexpr (K == 1)
            channels[0] = load<Quarter>(from);
        else
            deinterleave(from, channels);
        for (int k = 0; k < K; k++) rows_[k][row] = channels[k];
    }
    SPLAT_INLINE void write(int row, float* to, int count) const {
        float padded[4 * K];
        float* const whole = count < 4 ? padded : to;
        Quarter channels[K];
        for (int k = 0; k < K; k++) channels[k] = rows_[k][row];
        if constexpr (K == 1)
            store(whole, channels[0]);
        else
            interleave(channels, whole);
        if (count < 4) std::memcpy(to, padded, K * count * sizeof(float));
    }
    SPLAT_INLINE void to_channels(Vector<float, 4 * kRows> (&channels)[K]) const {
        for (int k = 0; k < K; k++) channels[k] = join<kRows>(rows_[k]);
    }
    SPLAT_INLINE void from_channels(const Vector<float, 4 * kRows> (&channels)[K]) {
        for (int k = 0; k < K; k++)
            for (int row = 0; row < kRows; row++)
                rows_[k][row] =
                    load<Quarter>(reinterpret_cast<const float*>(&channels[k]) + 4 * row);
    }

  private:
    using Quarter = Vector<float, 4>;
    Quarter rows_[K][kRows] = {};
};

#endif

// ---- 16 x 16 transposed ----

template <int kStep, int N, int... kLanes>
SPLAT_INLINE void swap_blocks(Vector<float, N>& a, Vector<float, N>& b,
                              std::integer_sequence<int, kLanes...>) {
    const auto first = shuffle<(kLanes & kStep ? N + kLanes - kStep : kLanes)...>(a, b);
    b = shuffle<(kLanes & kStep ? N + kLanes : kLanes + kStep)...>(a, b);
    a = first;
}
// In each block of 2 kStep lanes, swaps a's upper half with b's lower half.
template <int kStep, int N>
SPLAT_INLINE void swap_blocks(Vector<float, N>& a, Vector<float, N>& b) {
    if constexpr (kOneRegister<float, N>) {
        swap_blocks<kStep>(a, b, LaneSequence<N>{});
    } else if constexpr (kStep == N / 2) {
        std::swap(a.high, b.low);
    } else {
        swap_blocks<kStep>(a.low, b.low);
        swap_blocks<kStep>(a.high, b.high);
    }
}
template <int kStep>
SPLAT_INLINE void transpose_step(f32x16* rows) {
    for (int i = 0; i < 16; i++)
        if (!(i & kStep)) swap_blocks<kStep>(rows[i], rows[i + kStep]);
}
SPLAT_INLINE void transpose(f32x16* rows) {  // 16 x 16
    transpose_step<8>(rows);
    transpose_step<4>(rows);
    transpose_step<2>(rows);
    transpose_step<1>(rows);
}

// ---- Sums over lanes ----

// Lane i is v's lane i ^ kDistance, 1 or 2.
template <int kDistance, int N, int... kLanes>
SPLAT_INLINE Vector<float, N> swapped(Vector<float, N> v, std::integer_sequence<int, kLanes...>) {
    return shuffle<(kLanes ^ kDistance)...>(v, v);
}
template <int kDistance, int N>
SPLAT_INLINE Vector<float, N> swapped(Vector<float, N> v) {
    if constexpr (kOneRegister<float, N>)
        return swapped<kDistance>(v, LaneSequence<N>{});
    else
        return {swapped<kDistance>(v.low), swapped<kDistance>(v.high)};
}

// In every lane: bitwise or of its group of kCount lanes (2 or 4): lanes 0 to kCount - 1 and so on.
template <int kCount>
SPLAT_INLINE u32x16 any_of(u32x16 v) {
    v |= bit_cast<u32x16>(swapped<1>(bit_cast<f32x16>(v)));
    if (kCount == 4) v |= bit_cast<u32x16>(swapped<2>(bit_cast<f32x16>(v)));
    return v;
}

// The sum of the halves of each block of 2 kStep lanes: a's blocks, then b's.
template <int kStep, int N, int... kLanes>
SPLAT_INLINE Vector<float, N> fold(Vector<float, N> a, Vector<float, N> b,
                                   std::integer_sequence<int, kLanes...>) {
    constexpr auto at = [](int lane) { return lane / kStep * 2 * kStep + lane % kStep; };
    return shuffle<at(kLanes)...>(a, b) + shuffle<(at(kLanes) + kStep)...>(a, b);
}
template <int kStep, int N>
SPLAT_INLINE Vector<float, N> fold(Vector<float, N> a, Vector<float, N> b) {
    if constexpr (kOneRegister<float, N>)
        return fold<kStep>(a, b, LaneSequence<N>{});
    else if constexpr (kStep == N / 2)
        return {a.low + a.high, b.low + b.high};
    else
        return {fold<kStep>(a.low, a.high), fold<kStep>(b.low, b.high)};
}

// Lanes kFirst, kSecond of a, then of b, in each quarter of 4 lanes.
template <int kFirst, int kSecond, int N, int... kLanes>
SPLAT_INLINE Vector<float, N> within(Vector<float, N> a, Vector<float, N> b,
                                     std::integer_sequence<int, kLanes...>) {
    return shuffle<(kLanes / 4 * 4 + (kLanes % 2 ? kSecond : kFirst) +
                    (kLanes % 4 < 2 ? 0 : N))...>(a, b);
}
template <int kFirst, int kSecond, int N>
SPLAT_INLINE Vector<float, N> within(Vector<float, N> a, Vector<float, N> b) {
    if constexpr (kOneRegister<float, N>)
        return within<kFirst, kSecond>(a, b, LaneSequence<N>{});
    else
        return {within<kFirst, kSecond>(a.low, b.low), within<kFirst, kSecond>(a.high, b.high)};
}

// Lane sums of 12 vectors in a fixed order: sum(v[i]) is in lane sum_lane(i), the other lanes are
// undefined. Each step adds the halves of two vectors into one.
constexpr int sum_lane(int i) { return 4 * (i % 4) + i / 4; }

template <int N>
SPLAT_INLINE f32x16 sum_lanes(const Vector<float, N> (&v)[12]) {
    f32x16 part[3];  // of four vectors a quarter of lanes each
    for (int i = 0; i < 3; i++) {
        const Vector<float, N>* u = v + 4 * i;
        if constexpr (N == 16)
            part[i] = fold<4>(fold<8>(u[0], u[1]), fold<8>(u[2], u[3]));
        else
            part[i] = combine(fold<4>(u[0], u[1]), fold<4>(u[2], u[3]));
    }
    const f32x16 a = within<0, 1>(part[0], part[1]) + within<2, 3>(part[0], part[1]);
    const f32x16 b = within<0, 1>(part[2], part[2]) + within<2, 3>(part[2], part[2]);
    return within<0, 2>(a, b) + within<1, 3>(a, b);
}

}  // namespace splat
