// AVX-VNNI's instruction in AVX2's, for processors without it. Included before nearest.cpp, it
// makes nearest.cpp compile its AVX-VNNI form.
#include <immintrin.h>

inline __m256i dpbusd(__m256i sum, __m256i unsigned_bytes, __m256i signed_bytes) {
    // Even bytes, then odd ones, as 16 bits: madd multiplies them and adds neighbours.
    const __m256i even =
        _mm256_madd_epi16(_mm256_and_si256(unsigned_bytes, _mm256_set1_epi16(255)),
                          _mm256_srai_epi16(_mm256_slli_epi16(signed_bytes, 8), 8));
    const __m256i odd =
        _mm256_madd_epi16(_mm256_srli_epi16(unsigned_bytes, 8), _mm256_srai_epi16(signed_bytes, 8));
    return _mm256_add_epi32(sum, _mm256_add_epi32(even, odd));
}

#define __AVXVNNI__ 1
#define _mm256_dpbusd_avx_epi32 dpbusd
