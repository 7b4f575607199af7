// The nearest and second nearest descriptor of another photograph for each descriptor of one, in
// both directions, by exhaustive search in one pass. Squared distances of bytes are integers, so
// the result is exact.
//
// |a - b|^2 = |a|^2 + |b|^2 - 2 a.b. The dot products a.b take nearly all of the time. B is packed
// so that a vector holds 4 elements (VNNI, Arm dot product) or 2 elements (otherwise) of one
// descriptor of B in each 32-bit lane. Elements of A are broadcast to all lanes, so that no sum
// crosses lanes. ROWS x COLUMNS accumulators stay in registers.

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <vector>
#if defined(__SSE2__)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

namespace {

constexpr int SIZE = 128;
// Larger than any squared distance (128 * 255^2 = 8.3M).
constexpr int32_t FAR = 1 << 28;
// Norm of padding in the last block: its distances stay above FAR for any dot product.
constexpr int32_t PADDING = 1 << 29;

// LANES: 32-bit lanes of a vector register. STEP: elements of a descriptor in a lane. ROWS x
// COLUMNS accumulators leave registers for the operands.
#if defined(__AVX512VNNI__)
// The instruction multiplies unsigned by signed bytes: B is stored as b - 128.
constexpr int LANES = 16, STEP = 4, OFFSET = 128, ROWS = 4, COLUMNS = 4;
typedef int8_t Packed;
#elif defined(__AVX512BW__)
constexpr int LANES = 16, STEP = 2, OFFSET = 0, ROWS = 4, COLUMNS = 4;
typedef int16_t Packed;
#elif defined(__AVXVNNI__)
constexpr int LANES = 8, STEP = 4, OFFSET = 128, ROWS = 4, COLUMNS = 2;
typedef int8_t Packed;
#elif defined(__AVX2__)
constexpr int LANES = 8, STEP = 2, OFFSET = 0, ROWS = 4, COLUMNS = 2;
typedef int16_t Packed;
#elif defined(__ARM_FEATURE_DOTPROD)
// Unsigned bytes times unsigned bytes.
constexpr int LANES = 4, STEP = 4, OFFSET = 0, ROWS = 4, COLUMNS = 4;
typedef uint8_t Packed;
#else
constexpr int LANES = 4, STEP = 2, OFFSET = 0, ROWS = 4, COLUMNS = 2;
typedef int16_t Packed;
#endif
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));

// In each lane: sum plus the dot product of STEP elements.
inline Ints add_products(Ints sum, int32_t a, const Packed* b) {
#if defined(__AVX512VNNI__)
    return (Ints)_mm512_dpbusd_epi32((__m512i)sum, _mm512_set1_epi32(a), _mm512_loadu_si512(b));
#elif defined(__AVX512BW__)
    return sum + (Ints)_mm512_madd_epi16(_mm512_set1_epi32(a), _mm512_loadu_si512(b));
#elif defined(__AVXVNNI__)
    const __m256i packed = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(b));
    return (Ints)_mm256_dpbusd_avx_epi32((__m256i)sum, _mm256_set1_epi32(a), packed);
#elif defined(__AVX2__)
    const __m256i packed = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(b));
    return sum + (Ints)_mm256_madd_epi16(_mm256_set1_epi32(a), packed);
#elif defined(__SSE2__)
    const __m128i packed = _mm_loadu_si128(reinterpret_cast<const __m128i*>(b));
    return sum + (Ints)_mm_madd_epi16(_mm_set1_epi32(a), packed);
#elif defined(__ARM_FEATURE_DOTPROD)
    return (Ints)vdotq_u32((uint32x4_t)sum, (uint8x16_t)vdupq_n_s32(a), vld1q_u8(b));
#elif defined(__ARM_NEON)
    const int16x8_t packed = vld1q_s16(b);
    const int16x4_t pair = vreinterpret_s16_s32(vdup_n_s32(a));
    const int32x4_t low = vmull_s16(pair, vget_low_s16(packed));
    const int32x4_t high = vmull_s16(pair, vget_high_s16(packed));
    return sum + (Ints)vpaddq_s32(low, high);
#else
    const int16_t low = int16_t(a & 0xffff), high = int16_t(a >> 16);
    for (int l = 0; l < LANES; ++l) sum[l] += low * b[2 * l] + high * b[2 * l + 1];
    return sum;
#endif
}

// Element type of A: STEP elements are broadcast as 32 bits.
typedef std::conditional_t<STEP == 4, uint8_t, int16_t> Broadcast;

// The two smallest distances seen by each lane, and the index of the smallest.
struct NearestTwo {
    Ints first, second, index;
    void insert(Ints distance, Ints at) {
        const Ints nearer = distance < first;
        const Ints other = nearer ? first : distance;
        second = other < second ? other : second;
        index = nearer ? at : index;
        first = nearer ? distance : first;
    }
};

int32_t norm(const uint8_t* d) {
    int32_t sum = 0;
    for (int k = 0; k < SIZE; ++k) sum += int32_t(d[k]) * d[k];
    return sum;
}

}  // namespace

// a (n, 128), b (m, 128). Outputs of each row: index of the nearest row of the other table (the
// lowest of ties; -1 if there is none), its squared distance, and that of the second nearest (FAR
// if there is none).
extern "C" void nearest(const uint8_t* a, int32_t n, const uint8_t* b, int32_t m, int32_t* a_index,
                        int32_t* a_first, int32_t* a_second, int32_t* b_index, int32_t* b_first,
                        int32_t* b_second) {
    const int groups = (m + LANES - 1) / LANES;
    const int blocks = (groups + COLUMNS - 1) / COLUMNS;
    const int rows = (n + ROWS - 1) / ROWS * ROWS;
    constexpr int STEPS = SIZE / STEP;

    std::vector<Packed> packed(size_t(blocks) * COLUMNS * LANES * SIZE);
    std::vector<int32_t> b_norm(size_t(blocks) * COLUMNS * LANES, PADDING);
    for (int j = 0; j < m; ++j) {
        Packed* group = &packed[size_t(j / LANES) * LANES * SIZE];
        for (int k = 0; k < SIZE; ++k)
            group[(k / STEP * LANES + j % LANES) * STEP + k % STEP] =
                Packed(int(b[size_t(j) * SIZE + k]) - OFFSET);
        b_norm[j] = norm(b + size_t(j) * SIZE);
    }
    std::vector<Broadcast> elements(size_t(rows) * SIZE);
    std::vector<int32_t> a_norm(rows, PADDING);
    for (int i = 0; i < n; ++i) {
        int32_t sum = 0;
        for (int k = 0; k < SIZE; ++k) {
            elements[size_t(i) * SIZE + k] = a[size_t(i) * SIZE + k];
            sum += a[size_t(i) * SIZE + k];
        }
        // -2 a.b = -2 a.(b - OFFSET) - 2 OFFSET |a|_1.
        a_norm[i] = norm(a + size_t(i) * SIZE) - 2 * OFFSET * sum;
    }

    const Ints far = Ints{} + FAR, none = Ints{} - 1;
    Ints lane;
    for (int l = 0; l < LANES; ++l) lane[l] = l;
    std::vector<NearestTwo> of_a(rows, NearestTwo{far, far, none});
    for (int block = 0; block < blocks; ++block) {
        NearestTwo of_b[COLUMNS];
        Ints norms[COLUMNS];
        for (int c = 0; c < COLUMNS; ++c) {
            of_b[c] = {far, far, none};
            std::memcpy(&norms[c], &b_norm[(block * COLUMNS + c) * LANES], sizeof norms[c]);
        }
        const Packed* panel = &packed[size_t(block) * COLUMNS * LANES * SIZE];
        for (int row = 0; row < rows; row += ROWS) {
            Ints sum[ROWS][COLUMNS] = {};
            for (int k = 0; k < STEPS; ++k)
#pragma GCC unroll 16
                for (int r = 0; r < ROWS; ++r) {
                    int32_t step;
                    std::memcpy(&step, &elements[size_t(row + r) * SIZE + k * STEP], sizeof step);
#pragma GCC unroll 16
                    for (int c = 0; c < COLUMNS; ++c)
                        sum[r][c] = add_products(sum[r][c], step,
                                                 panel + (size_t(c) * STEPS + k) * LANES * STEP);
                }
#pragma GCC unroll 16
            for (int r = 0; r < ROWS; ++r)
#pragma GCC unroll 16
                for (int c = 0; c < COLUMNS; ++c) {
                    const Ints distance = a_norm[row + r] + norms[c] - 2 * sum[r][c];
                    of_a[row + r].insert(distance, (block * COLUMNS + c) * LANES + lane);
                    of_b[c].insert(distance, Ints{} + (row + r));
                }
        }
        for (int c = 0; c < COLUMNS; ++c)
            for (int l = 0; l < LANES; ++l) {
                const int j = (block * COLUMNS + c) * LANES + l;
                if (j >= m) break;
                b_index[j] = of_b[c].index[l];
                b_first[j] = of_b[c].first[l];
                b_second[j] = of_b[c].second[l];
            }
    }
    for (int i = 0; i < n; ++i) {
        int32_t first = FAR, second = FAR, index = -1;
        for (int l = 0; l < LANES; ++l) {
            const int32_t d = of_a[i].first[l], at = of_a[i].index[l];
            if (d < first || (d == first && at >= 0 && at < index)) {
                second = std::min(second, first);
                first = d;
                index = at;
            } else {
                second = std::min(second, d);
            }
            second = std::min(second, of_a[i].second[l]);
        }
        a_index[i] = index;
        a_first[i] = first;
        a_second[i] = second;
    }
}
