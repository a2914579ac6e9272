/* Sixteen lanes at a time, in the instructions of this variant.

   Float operations are the same in every variant and lane by lane, in a fixed order. FMA is written
   where it is meant; the compiler must not make any (-ffp-contract=off). */
#ifndef VERGENCE_SIMD_H
#define VERGENCE_SIMD_H
#include <math.h>
#include <stdint.h>
#include <string.h>
#if defined(__AVX2__)
#include <immintrin.h>
#elif defined(__ARM_FEATURE_DOTPROD)
#include <arm_neon.h>
#endif

#define ALWAYS_INLINE inline __attribute__((always_inline))

#if defined(__AVX512F__)

typedef __m512 Floats;
typedef __m512i Ints;
static inline Floats f_load(const float *p) { return _mm512_loadu_ps(p); }
static inline void f_store(float *p, Floats v) { _mm512_storeu_ps(p, v); }
static inline Floats f_all(float v) { return _mm512_set1_ps(v); }
static inline Floats f_fma(Floats a, Floats b, Floats c) { return _mm512_fmadd_ps(a, b, c); }
static inline Floats f_mul(Floats a, Floats b) { return _mm512_mul_ps(a, b); }
static inline Floats f_clamp(Floats v, float low, float high) {
    return _mm512_min_ps(_mm512_max_ps(v, _mm512_set1_ps(low)), _mm512_set1_ps(high));
}
static inline Ints i_load(const int32_t *p) { return _mm512_loadu_si512(p); }
static inline Ints i_quads(const int8_t *p) { return _mm512_loadu_si512(p); }
static inline Ints i_four(const uint8_t *p) {
    int32_t four;
    memcpy(&four, p, 4);
    return _mm512_set1_epi32(four);
}
static inline Ints i_dot(Ints sum, Ints bytes, Ints weights) {
    return _mm512_dpbusd_epi32(sum, bytes, weights);
}
static inline void i_store_bytes(uint8_t *p, Ints sum, const float *scale, int zero) {
    Floats v = _mm512_mul_ps(_mm512_cvtepi32_ps(sum), _mm512_loadu_ps(scale));
    v = f_clamp(v, (float)-zero, (float)(255 - zero));
    Ints whole = _mm512_add_epi32(_mm512_cvtps_epi32(v), _mm512_set1_epi32(zero));
    _mm_storeu_si128((__m128i *)p, _mm512_cvtepi32_epi8(whole));
}

#elif defined(__AVX2__)

typedef struct { __m256 a, b; } Floats;
typedef struct { __m256i a, b; } Ints;
static inline Floats f_load(const float *p) {
    return (Floats){_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)};
}
static inline void f_store(float *p, Floats v) {
    _mm256_storeu_ps(p, v.a);
    _mm256_storeu_ps(p + 8, v.b);
}
static inline Floats f_all(float v) { return (Floats){_mm256_set1_ps(v), _mm256_set1_ps(v)}; }
static inline Floats f_fma(Floats a, Floats b, Floats c) {
    return (Floats){_mm256_fmadd_ps(a.a, b.a, c.a), _mm256_fmadd_ps(a.b, b.b, c.b)};
}
static inline Floats f_mul(Floats a, Floats b) {
    return (Floats){_mm256_mul_ps(a.a, b.a), _mm256_mul_ps(a.b, b.b)};
}
static inline __m256 f_clamp8(__m256 v, float low, float high) {
    return _mm256_min_ps(_mm256_max_ps(v, _mm256_set1_ps(low)), _mm256_set1_ps(high));
}
static inline Floats f_clamp(Floats v, float low, float high) {
    return (Floats){f_clamp8(v.a, low, high), f_clamp8(v.b, low, high)};
}
static inline Ints i_load(const int32_t *p) {
    return (Ints){_mm256_loadu_si256((const __m256i *)p), _mm256_loadu_si256((const __m256i *)p + 1)};
}
static inline Ints i_quads(const int8_t *p) { return i_load((const int32_t *)(const void *)p); }
static inline Ints i_four(const uint8_t *p) {
    int32_t four;
    memcpy(&four, p, 4);
    return (Ints){_mm256_set1_epi32(four), _mm256_set1_epi32(four)};
}
#if defined(__AVXVNNI__)
static inline Ints i_dot(Ints sum, Ints bytes, Ints weights) {
    return (Ints){_mm256_dpbusd_avx_epi32(sum.a, bytes.a, weights.a),
                  _mm256_dpbusd_avx_epi32(sum.b, bytes.b, weights.b)};
}
#else
/* Two products are added in 16 bits: no pair of weights of a channel exceeds that, see weights.c. */
static inline __m256i dot8(__m256i sum, __m256i bytes, __m256i weights) {
    __m256i pairs = _mm256_maddubs_epi16(bytes, weights);
    return _mm256_add_epi32(sum, _mm256_madd_epi16(pairs, _mm256_set1_epi16(1)));
}
static inline Ints i_dot(Ints sum, Ints bytes, Ints weights) {
    return (Ints){dot8(sum.a, bytes.a, weights.a), dot8(sum.b, bytes.b, weights.b)};
}
#endif
static inline __m256i to_bytes8(__m256i sum, const float *scale, int zero) {
    __m256 v = _mm256_mul_ps(_mm256_cvtepi32_ps(sum), _mm256_loadu_ps(scale));
    v = f_clamp8(v, (float)-zero, (float)(255 - zero));
    return _mm256_add_epi32(_mm256_cvtps_epi32(v), _mm256_set1_epi32(zero));
}
static inline void i_store_bytes(uint8_t *p, Ints sum, const float *scale, int zero) {
    __m256i words = _mm256_packs_epi32(to_bytes8(sum.a, scale, zero), to_bytes8(sum.b, scale + 8, zero));
    words = _mm256_permute4x64_epi64(words, 0xD8);
    __m128i low = _mm256_castsi256_si128(words), high = _mm256_extracti128_si256(words, 1);
    _mm_storeu_si128((__m128i *)p, _mm_packus_epi16(low, high));
}

#else /* the reference: plain C */

typedef struct { float v[16]; } Floats;
typedef struct { int32_t v[16]; } Ints;
#define EACH for (int i = 0; i < 16; i++)
static inline Floats f_load(const float *p) { Floats r; EACH r.v[i] = p[i]; return r; }
static inline void f_store(float *p, Floats v) { EACH p[i] = v.v[i]; }
static inline Floats f_all(float v) { Floats r; EACH r.v[i] = v; return r; }
static inline Floats f_fma(Floats a, Floats b, Floats c) {
    EACH c.v[i] = fmaf(a.v[i], b.v[i], c.v[i]);
    return c;
}
static inline Floats f_mul(Floats a, Floats b) { EACH a.v[i] *= b.v[i]; return a; }
static inline Floats f_clamp(Floats v, float low, float high) {
    EACH v.v[i] = v.v[i] > low ? (v.v[i] < high ? v.v[i] : high) : low;
    return v;
}
static inline Ints i_load(const int32_t *p) { Ints r; EACH r.v[i] = p[i]; return r; }
typedef struct { const int8_t *p; } Quads;
static inline Quads i_quads(const int8_t *p) { return (Quads){p}; }
typedef struct { int32_t v[4]; } Four;
static inline Four i_four(const uint8_t *p) { return (Four){{p[0], p[1], p[2], p[3]}}; }
static inline Ints i_dot(Ints sum, Four b, Quads w) {
    EACH sum.v[i] += b.v[0] * w.p[4 * i] + b.v[1] * w.p[4 * i + 1] + b.v[2] * w.p[4 * i + 2] +
                     b.v[3] * w.p[4 * i + 3];
    return sum;
}
static inline void i_store_bytes(uint8_t *p, Ints sum, const float *scale, int zero) {
    float low = (float)-zero, high = (float)(255 - zero);
    EACH {
        float v = (float)sum.v[i] * scale[i];
        v = v > low ? (v < high ? v : high) : low;
        p[i] = (uint8_t)((int)rintf(v) + zero);
    }
}
#undef EACH
#define PLAIN_QUADS 1
#endif

/* Sixteen products of bytes, each less its zero point. */
#if defined(__AVX2__)
typedef __m256i Words;
static inline Words words_of(const uint8_t *p, int zero) {
    __m256i wide = _mm256_cvtepu8_epi16(_mm_loadu_si128((const __m128i *)p));
    return _mm256_sub_epi16(wide, _mm256_set1_epi16((short)zero));
}
static ALWAYS_INLINE int32_t words_dot(Words a, Words b) {
    __m256i four = _mm256_madd_epi16(a, b);
    __m128i sum = _mm_add_epi32(_mm256_castsi256_si128(four), _mm256_extracti128_si256(four, 1));
    sum = _mm_add_epi32(sum, _mm_shuffle_epi32(sum, 0x4E));
    sum = _mm_add_epi32(sum, _mm_shuffle_epi32(sum, 0xB1));
    return _mm_cvtsi128_si32(sum);
}
#else
typedef struct { int16_t v[16]; } Words;
static inline Words words_of(const uint8_t *p, int zero) {
    Words r;
    for (int i = 0; i < 16; i++)
        r.v[i] = (int16_t)(p[i] - zero);
    return r;
}
static ALWAYS_INLINE int32_t words_dot(Words a, Words b) {
    int32_t sum = 0;
    for (int i = 0; i < 16; i++)
        sum += a.v[i] * b.v[i];
    return sum;
}
#endif

static ALWAYS_INLINE float least(float a, float b) { return a < b ? a : b; }
static ALWAYS_INLINE float most(float a, float b) { return a > b ? a : b; }
/* Not a number becomes `low`, so that no index comes from one. */
static ALWAYS_INLINE float clamped(float v, float low, float high) { return least(most(v, low), high); }
static ALWAYS_INLINE uint8_t to_byte(float v, float step, int zero) {
    return (uint8_t)((int)rintf(clamped(v / step, (float)-zero, (float)(255 - zero))) + zero);
}
static ALWAYS_INLINE float bits_float(int32_t bits) { float f; memcpy(&f, &bits, 4); return f; }
static ALWAYS_INLINE int32_t float_bits(float f) { int32_t bits; memcpy(&bits, &f, 4); return bits; }

/* e^x within 1e-7, relatively; x is clamped to +-87. The constants are those of MLAS. */
static ALWAYS_INLINE float own_exp(float x) {
    x = clamped(x, -87.0f, 87.0f);
    float biased = fmaf(x, 1.44269504088896341f, 12582912.0f), n = biased - 12582912.0f;
    float r = fmaf(n, -1.42860677e-6f, fmaf(n, -6.93145752e-1f, x));
    float p = 0x1.694000p-10f;
    p = fmaf(p, r, 0x1.125edcp-7f);
    p = fmaf(p, r, 0x1.555b5ap-5f);
    p = fmaf(p, r, 0x1.555450p-3f);
    p = fmaf(p, r, 0x1.fffff6p-2f);
    p = fmaf(p, r, 1.0f);
    p = fmaf(p, r, 1.0f);
    return p * bits_float(((int32_t)n + 127) * (1 << 23));
}

/* The natural logarithm of a normal number above 0, within 1e-7: a rational of Eigen's. */
static ALWAYS_INLINE float own_log(float x) {
    x = clamped(x, 1.17549435e-38f, 3.0e38f);
    int32_t bits = float_bits(x);
    int32_t e = (bits - 0x3F3504F3) >> 23; /* so that the mantissa is sqrt(1/2) to sqrt(2) */
    float m = bits_float(bits - e * (1 << 23)) - 1.0f;
    float p = ((0.18256296349849254f * m + 1.0000000190281063f) * m + 1.0000000190281136f) * m;
    float q = ((0.049616247954120038f * m + 0.59923249590823520f) * m + 1.4999999999999927f) * m + 1.0f;
    return (float)e * 0.6931471805599453f + p / q;
}

/* Signed logarithm of a difference in pixels: fine near zero, bounded far from it. */
static ALWAYS_INLINE float squash(float px, float scale) {
    float size = own_log(fabsf(px) / scale + 1.0f);
    return (px > 0 ? size : px < 0 ? -size : 0.0f) / 2.3025851249694824f;
}
#endif
