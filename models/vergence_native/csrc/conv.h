/* Convolutions of bytes along a row, and sums of bytes. */
#ifndef VERGENCE_CONV_H
#define VERGENCE_CONV_H
#include "lite.h"
#include "simd.h"

enum { MAX_TAPS = 9 };

/* PIXELS pixels and BLOCKS blocks of 16 outputs at once. `tap` points to the first pixel of each tap. */
#define CONV_BLOCK(PIXELS, BLOCKS)                                                                  \
    static inline void conv_##PIXELS##x##BLOCKS(const Conv *c, int block, const uint8_t *const *tap, \
                                                int taps, ptrdiff_t at, ptrdiff_t step,             \
                                                uint8_t *out, ptrdiff_t out_step) {                 \
        const ptrdiff_t stride = (ptrdiff_t)taps * c->ci * LANES;                                   \
        const int8_t *w = c->weights + block * stride;                                              \
        Ints sum[PIXELS][BLOCKS];                                                                   \
        for (int p = 0; p < PIXELS; p++)                                                            \
            for (int b = 0; b < BLOCKS; b++)                                                        \
                sum[p][b] = i_load(c->bias + LANES * (block + b));                                  \
        for (int t = 0; t < taps; t++) {                                                            \
            const uint8_t *a = tap[t] + at;                                                         \
            for (int i = 0; i < c->ci; i += 4, w += 4 * LANES) {                                    \
                QUADS quads[BLOCKS];                                                                \
                for (int b = 0; b < BLOCKS; b++)                                                    \
                    quads[b] = i_quads(w + b * stride);                                             \
                for (int p = 0; p < PIXELS; p++) {                                                  \
                    FOUR four = i_four(a + p * step + i);                                           \
                    for (int b = 0; b < BLOCKS; b++)                                                \
                        sum[p][b] = i_dot(sum[p][b], four, quads[b]);                               \
                }                                                                                   \
            }                                                                                       \
        }                                                                                           \
        for (int p = 0; p < PIXELS; p++)                                                            \
            for (int b = 0; b < BLOCKS; b++)                                                        \
                i_store_bytes(out + p * out_step + LANES * (block + b), sum[p][b],                  \
                              c->scale + LANES * (block + b), c->out_zero);                         \
    }

#ifdef PLAIN_QUADS
#define QUADS Quads
#define FOUR Four
#else
#define QUADS Ints
#define FOUR Ints
#endif

/* Pixels before the last, PIXELS at a time; the last ones again, so that no part is left over. */
#define CONV_ROW(PIXELS, BLOCKS)                                                                    \
    CONV_BLOCK(PIXELS, BLOCKS)                                                                      \
    CONV_BLOCK(1, BLOCKS)                                                                           \
    static void conv_row_##BLOCKS(const Conv *c, int block, const uint8_t *const *tap, int taps,    \
                                  int pixels, ptrdiff_t step, uint8_t *out, ptrdiff_t out_step) {   \
        int x = 0;                                                                                  \
        for (; x + PIXELS <= pixels; x += PIXELS)                                                   \
            conv_##PIXELS##x##BLOCKS(c, block, tap, taps, x * step, step, out + x * out_step, out_step); \
        if (x < pixels && pixels >= PIXELS) {                                                       \
            x = pixels - PIXELS;                                                                    \
            conv_##PIXELS##x##BLOCKS(c, block, tap, taps, x * step, step, out + x * out_step, out_step); \
            return;                                                                                 \
        }                                                                                           \
        for (; x < pixels; x++)                                                                     \
            conv_1x##BLOCKS(c, block, tap, taps, x * step, step, out + x * out_step, out_step);     \
    }

#if defined(__AVX2__) && !defined(__AVXVNNI__) && !defined(__AVX512F__)
#define GROUPED 1
enum { GROUP_PIXELS = 6 }; /* sums, pairs and weights of more would not fit into 16 registers */

/* SIZE steps at PIXELS pixels: sums of 16 bits, widened once. */
#define CONV_GROUP(SIZE, PIXELS)                                                                    \
    static ALWAYS_INLINE void group_##SIZE##x##PIXELS(const uint8_t *const *from, ptrdiff_t at, ptrdiff_t step, \
                                                      const int8_t *w, __m256i sum[PIXELS][2]) {    \
        const __m256i one = _mm256_set1_epi16(1);                                                   \
        for (int p = 0; p < PIXELS; p++) {                                                          \
            __m256i low = _mm256_setzero_si256(), high = low;                                       \
            for (int n = 0; n < SIZE; n++) {                                                        \
                const __m256i *quads = (const __m256i *)(w + 4 * LANES * n);                        \
                const __m256i four = i_four(from[n] + at + p * step).a;                             \
                const __m256i first = _mm256_maddubs_epi16(four, _mm256_loadu_si256(quads));        \
                const __m256i second = _mm256_maddubs_epi16(four, _mm256_loadu_si256(quads + 1));   \
                low = n ? _mm256_add_epi16(low, first) : first;                                     \
                high = n ? _mm256_add_epi16(high, second) : second;                                 \
            }                                                                                       \
            sum[p][0] = _mm256_add_epi32(sum[p][0], _mm256_madd_epi16(low, one));                   \
            sum[p][1] = _mm256_add_epi32(sum[p][1], _mm256_madd_epi16(high, one));                  \
        }                                                                                           \
    }

#define CONV_GROUPED(PIXELS)                                                                        \
    CONV_GROUP(4, PIXELS)                                                                           \
    CONV_GROUP(3, PIXELS)                                                                           \
    CONV_GROUP(2, PIXELS)                                                                           \
    CONV_GROUP(1, PIXELS)                                                                           \
    static inline void grouped_##PIXELS(const Conv *c, int block, const uint8_t *const *from, const int8_t *w, \
                                        ptrdiff_t at, ptrdiff_t step, uint8_t *out, ptrdiff_t out_step) { \
        const uint8_t *groups = c->groups[block];                                                   \
        const Ints bias = i_load(c->bias + LANES * block);                                          \
        __m256i sum[PIXELS][2];                                                                     \
        for (int p = 0; p < PIXELS; p++) {                                                          \
            sum[p][0] = bias.a;                                                                     \
            sum[p][1] = bias.b;                                                                     \
        }                                                                                           \
        for (int g = 0; g < groups[0]; g++, from += 4, w += 16 * LANES)                             \
            group_4x##PIXELS(from, at, step, w, sum);                                               \
        for (int g = 0; g < groups[1]; g++, from += 3, w += 12 * LANES)                             \
            group_3x##PIXELS(from, at, step, w, sum);                                               \
        for (int g = 0; g < groups[2]; g++, from += 2, w += 8 * LANES)                              \
            group_2x##PIXELS(from, at, step, w, sum);                                               \
        for (int g = 0; g < groups[3]; g++, from += 1, w += 4 * LANES)                              \
            group_1x##PIXELS(from, at, step, w, sum);                                               \
        for (int p = 0; p < PIXELS; p++)                                                            \
            i_store_bytes(out + p * out_step + LANES * block, (Ints){sum[p][0], sum[p][1]},         \
                          c->scale + LANES * block, c->out_zero);                                   \
    }
CONV_GROUPED(6)
CONV_GROUPED(1)

static void conv_row_grouped(const Conv *c, int block, const uint8_t *const *tap, int taps, int pixels, ptrdiff_t step,
                             uint8_t *out, ptrdiff_t out_step) {
    const uint8_t *from[MAX_STEPS];
    const int per_tap = c->ci / 4, steps = taps * per_tap;
    const int8_t *w = c->grouped + (ptrdiff_t)block * steps * 4 * LANES;
    for (int n = 0; n < steps; n++) {
        int at = c->order[block][n];
        from[n] = tap[at / per_tap] + 4 * (at % per_tap);
    }
    int x = 0;
    for (; x + GROUP_PIXELS <= pixels; x += GROUP_PIXELS)
        grouped_6(c, block, from, w, x * step, step, out + x * out_step, out_step);
    if (x < pixels && pixels >= GROUP_PIXELS) {
        x = pixels - GROUP_PIXELS;
        grouped_6(c, block, from, w, x * step, step, out + x * out_step, out_step);
        return;
    }
    for (; x < pixels; x++)
        grouped_1(c, block, from, w, x * step, step, out + x * out_step, out_step);
}
#elif defined(__AVX512F__)
CONV_ROW(12, 1)
CONV_ROW(10, 2)
CONV_ROW(8, 3)
CONV_ROW(6, 4)
#elif defined(__AVXVNNI__)
CONV_ROW(6, 1)
#else
CONV_ROW(4, 1)
#endif

/* A row of a convolution. An output pixel has a multiple of 16 channels, `out_step` bytes apart. */
static inline void conv_row(const Conv *c, const uint8_t *const *tap, int taps, int pixels, ptrdiff_t step,
                     uint8_t *out, ptrdiff_t out_step) {
#if defined(__AVX512F__)
    switch ((c->co + LANES - 1) / LANES) {
    case 1: conv_row_1(c, 0, tap, taps, pixels, step, out, out_step); break;
    case 2: conv_row_2(c, 0, tap, taps, pixels, step, out, out_step); break;
    case 3: conv_row_3(c, 0, tap, taps, pixels, step, out, out_step); break;
    default: conv_row_4(c, 0, tap, taps, pixels, step, out, out_step);
    }
#elif defined(GROUPED)
    for (int block = 0; block * LANES < c->co; block++)
        conv_row_grouped(c, block, tap, taps, pixels, step, out, out_step);
#else
    for (int block = 0; block * LANES < c->co; block++)
        conv_row_1(c, block, tap, taps, pixels, step, out, out_step);
#endif
}

/* A 1x1 convolution of so many pixels that lie side by side. */
static inline void conv_pixels(const Conv *c, const uint8_t *in, int pixels, uint8_t *out, ptrdiff_t out_step) {
    conv_row(c, &in, 1, pixels, c->ci, out, out_step);
}

/* Row `y` of a 3x3 convolution of an image with a border. */
static inline void conv_3x3(const Conv *c, const Image *in, int y, int pixels, uint8_t *out, ptrdiff_t out_step) {
    const uint8_t *tap[MAX_TAPS];
    for (int t = 0; t < 9; t++)
        tap[t] = in->data + (c->stride * y + t / 3 - 1) * in->row + (t % 3 - 1) * in->channels;
    conv_row(c, tap, 9, pixels, (ptrdiff_t)c->stride * c->ci, out, out_step);
}

static inline uint8_t *pixel_row(const Image *image, int y) { return image->data + y * image->row; }

/* out = a + b. */
static inline void sum_row(const Sum *s, const uint8_t *restrict a, const uint8_t *restrict b, int count,
                           uint8_t *restrict out) {
    const float ra = s->ra, rb = s->rb, fixed = s->fixed;
    for (int i = 0; i < count; i++) {
        float v = fmaf((float)a[i], ra, fmaf((float)b[i], rb, fixed));
        out[i] = (uint8_t)(int)rintf(clamped(v, 0.0f, 255.0f));
    }
}

/* The same, where each pixel of `b` stands for two: count pixels of `a`, a multiple of 16 channels. */
static inline void sum_row_doubled(const Sum *s, const uint8_t *restrict a, const uint8_t *restrict b, int count,
                                   int channels, uint8_t *restrict out) {
    const float ra = s->ra, rb = s->rb, fixed = s->fixed;
    for (int x = 0; x < count; x += 2, a += 2 * channels, out += 2 * channels, b += channels)
        for (int c = 0; c < channels; c += LANES)
            for (int i = c; i < c + LANES; i++) {
                float half = fmaf((float)b[i], rb, fixed);
                float first = fmaf((float)a[i], ra, half), second = fmaf((float)a[i + channels], ra, half);
                out[i] = (uint8_t)(int)rintf(clamped(first, 0.0f, 255.0f));
                out[i + channels] = (uint8_t)(int)rintf(clamped(second, 0.0f, 255.0f));
            }
}

/* The border of an image holds `value`, the zero of its convolution. */
static inline void fill_border(const Image *image, int value) {
    const size_t wide = (size_t)(image->width + 2) * (size_t)image->channels, one = (size_t)image->channels;
    memset(image->data - image->row - image->channels, value, wide);
    memset(image->data + image->height * image->row - image->channels, value, wide);
    for (int y = 0; y < image->height; y++) {
        memset(pixel_row(image, y) - image->channels, value, one);
        memset(pixel_row(image, y) + image->width * image->channels, value, one);
    }
}
#endif
