/* All that depends on the images alone: descriptors, coarse scores, and the context. */
#ifndef VERGENCE_BEGIN_H
#define VERGENCE_BEGIN_H
#include "conv.h"

/* Chunks of rows, small enough to keep all threads busy. */
static inline int bands(int rows, int most_rows) { return (rows + most_rows - 1) / most_rows; }
#define ROWS_OF(chunk, size, total, y)                                                              \
    for (int y = (chunk) * (size), end_##y = y + (size) < (total) ? y + (size) : (total); y < end_##y; y++)

static inline char *scratch(const Step *s, int worker) {
    return s->space->scratch + (size_t)worker * s->space->scratch_size;
}

/* A row of gray values with edges repeated, even and odd columns apart: two rows of `split` floats.
   Column c of the padded row is column c - 2 of the image. */
static void write_split(const uint16_t *sums, int width, float factor, float *out, int split) {
    float *even = out, *odd = out + split;
    for (int i = 0; i < width / 2; i++) {
        even[i + 1] = (float)sums[2 * i] * factor;
        odd[i + 1] = (float)sums[2 * i + 1] * factor;
    }
    even[0] = odd[0] = even[1];
    for (int i = width / 2 + 1; i < width / 2 + 3; i++)
        even[i] = odd[i] = odd[width / 2];
}

/* Means of the colours of 2x2 and 4x4 blocks; of the latter the first and the third row count. */
enum { GRAY_BAND = 4 };
static void gray_rows(void *context, int chunk, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const int per_image = bands(k->h4, GRAY_BAND), right = chunk >= per_image;
    const uint8_t *image = right ? s->right : s->left;
    uint16_t *two = (uint16_t *)scratch(s, worker), *six = two + k->width * 3 / 2, *block = six + 4 * k->width / 2;
    ROWS_OF(right ? chunk - per_image : chunk, GRAY_BAND, k->h4, y) {
        for (int r = 0; r < 4; r++) {
            const uint8_t *in = image + (size_t)(4 * y + r) * (size_t)k->width * 3;
            uint16_t *out = six + r * (k->width / 2);
            for (int i = 0; i < k->width * 3 / 2; i++)
                two[i] = (uint16_t)(in[2 * i] + in[2 * i + 1]);
            for (int i = 0; i < k->width / 2; i++)
                out[i] = (uint16_t)(two[3 * i] + two[3 * i + 1] + two[3 * i + 2]);
        }
        for (int r = 0; r < 2; r++) {
            const uint16_t *a = six + 2 * r * (k->width / 2), *b = a + k->width / 2;
            for (int i = 0; i < k->width / 2; i++)
                block[i] = (uint16_t)(a[i] + b[i]);
            write_split(block, k->width / 2, 0.0833333358168602f,
                        k->gray2[right] + (ptrdiff_t)(2 * y + r) * 2 * k->split2, k->split2);
        }
        const uint16_t *a = six, *b = six + 2 * (k->width / 2);
        for (int i = 0; i < k->w4; i++)
            block[i] = (uint16_t)(a[2 * i] + a[2 * i + 1] + b[2 * i] + b[2 * i + 1]);
        write_split(block, k->w4, 0.0416666679084301f, k->gray4[right] + (ptrdiff_t)y * 2 * k->split4,
                    k->split4);
    }
}

/* Four channels of 6x6 filters at 16 cells, two columns apart; tap (ty, tx) at row[ty][tx]. */
static inline void census_4(const float *weights, const float *const row[6][6], int x, Floats out[4]) {
    Floats sum[4];
    for (int c = 0; c < 4; c++)
        sum[c] = f_all(0.0f);
    for (int t = 0; t < CENSUS_TAPS; t++) {
        Floats v = f_load(row[t / 6][t % 6] + x);
        for (int c = 0; c < 4; c++)
            sum[c] = f_fma(f_all(weights[c * CENSUS_TAPS + t]), v, sum[c]);
    }
    for (int c = 0; c < 4; c++)
        out[c] = f_clamp(sum[c], -1.0f, 1.0f);
}

/* The taps' rows of gray values for the cells of row `y`, `shift` columns (0 or 1) further right. */
static inline void census_rows(const float *gray, int split, int height, int y, int shift, const float *row[6][6]) {
    for (int ty = 0; ty < 6; ty++) {
        int at = 2 * y + ty - 2;
        at = at < 0 ? 0 : at >= height ? height - 1 : at;
        for (int tx = 0; tx < 6; tx++) {
            int column = tx + shift;
            row[ty][tx] = gray + (ptrdiff_t)at * 2 * split + (column & 1) * split + column / 2;
        }
    }
}

static inline void fine_census(const Step *s, int y, int right, int shift, int worker) {
    const Workspace *k = s->space;
    const Begin *b = &s->model->begin;
    const float *pairs = b->pairs;
    const float mean = right ? 1.0f : pairs[7], step = pairs[right ? 2 : 0];
    const int zero = (int)pairs[right ? 3 : 1];
    const float *row[6][6];
    uint8_t *out = right ? k->fine_right + ((ptrdiff_t)y * 2 * k->w4 + shift) * FINE_BITS
                         : k->fine_left + (ptrdiff_t)y * k->w4 * FINE_BITS;
    const ptrdiff_t apart = right ? 2 * FINE_BITS : FINE_BITS;
    float *tile = (float *)scratch(s, worker); /* [16 bits][16 cells] */
    uint8_t *bytes = (uint8_t *)(tile + FINE_BITS * LANES);
    census_rows(k->gray2[right], k->split2, 2 * k->h4, y, shift, row);
    for (int x = 0; x < k->w4; x += LANES) {
        for (int c = 0; c < FINE_BITS; c += 4) {
            Floats v[4];
            census_4(b->fine[right] + c * CENSUS_TAPS, row, x, v);
            for (int i = 0; i < 4; i++)
                f_store(tile + (c + i) * LANES, v[i]);
        }
        for (int i = 0; i < FINE_BITS * LANES; i++)
            bytes[i] = to_byte(tile[i] * mean, step, zero);
        const int cells = k->w4 - x < LANES ? k->w4 - x : LANES;
        for (int i = 0; i < cells; i++)
            for (int c = 0; c < FINE_BITS; c++)
                out[(x + i) * apart + c] = bytes[c * LANES + i];
    }
}

/* Coarse scores of a row, [BINS][p8]: mean products of descriptors. */
static inline void coarse_row(const Step *s, int y, int worker) {
    const Workspace *k = s->space;
    const Begin *b = &s->model->begin;
    const int p8 = k->p8, wide = p8 + 32; /* right cells left of the image are zeros */
    float *left = (float *)scratch(s, worker), *right[2];
    right[0] = left + COARSE_BITS * p8;
    right[1] = right[0] + COARSE_BITS * wide;
    for (int side = 0; side < 3; side++) {
        const float *row[6][6];
        const int is_right = side > 0, shift = side == 2;
        float *out = is_right ? right[shift] + 32 : left;
        const int pitch = is_right ? wide : p8;
        const float *weights = b->coarse[is_right];
        census_rows(k->gray4[is_right], k->split4, k->h4, y, shift, row);
        for (int c = 0; is_right && c < COARSE_BITS; c++)
            memset(right[shift] + c * wide, 0, 32 * sizeof(float));
        for (int x = 0; x < k->w8; x += LANES)
            for (int c = 0; c < COARSE_BITS; c += 4) {
                Floats v[4];
                census_4(weights + c * CENSUS_TAPS, row, x, v);
                for (int i = 0; i < 4; i++)
                    f_store(out + (c + i) * pitch + x, v[i]);
            }
    }
    /* Disparity 47 - i is s right entries to the left of 2 x: an even or an odd one. */
    for (int i = 0; i < BINS; i += 4) {
        const float *other[4];
        for (int j = 0; j < 4; j++) {
            int shift = BINS - 1 - i - j;
            other[j] = right[shift & 1] + 32 - (shift + 1) / 2;
        }
        float *out = k->narrow + ((ptrdiff_t)y * BINS + i) * p8;
        for (int x = 0; x < k->w8; x += LANES) {
            Floats sum[4];
            for (int j = 0; j < 4; j++)
                sum[j] = f_all(0.0f);
            for (int c = 0; c < COARSE_BITS; c++) {
                Floats l = f_load(left + c * p8 + x);
                for (int j = 0; j < 4; j++)
                    sum[j] = f_fma(l, f_load(other[j] + c * wide + x), sum[j]);
            }
            for (int j = 0; j < 4; j++)
                f_store(out + j * p8 + x, f_mul(sum[j], f_all(b->pairs[6])));
        }
    }
}

/* Descriptors and coarse scores, and the context's first layer, a row of 1/8 at a time. */
static void match_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    coarse_row(s, y, worker);
    for (int r = 2 * y; r < 2 * y + 2; r++) {
        fine_census(s, r, 0, 0, worker);
        fine_census(s, r, 1, 0, worker);
        fine_census(s, r, 1, 1, worker);
        const uint8_t *tap[4];
        for (int t = 0; t < 4; t++)
            tap[t] = s->left + (size_t)(4 * r + t) * (size_t)k->width * 3;
        conv_row(&s->model->begin.conv[PATCH], tap, 4, k->w4, 12, pixel_row(&k->patch, r), FINE);
    }
}

/* A row of the mean over 3x3 cells; borders count the cells there are. Columns are summed first. */
static inline void box_row(const float *above, const float *own, const float *below, int width, float *sum,
                           float *out) {
    const float rows = 1.0f + (above ? 1.0f : 0.0f) + (below ? 1.0f : 0.0f);
    const int last = width - 1;
    if (above && below)
        for (int x = 0; x < width; x++)
            sum[x] = above[x] + own[x] + below[x];
    else if (above || below) {
        const float *first = above ? above : own, *second = above ? own : below;
        for (int x = 0; x < width; x++)
            sum[x] = first[x] + second[x];
    } else
        memcpy(sum, own, sizeof(float) * (size_t)width);
    for (int x = 1; x < last; x++)
        out[x] = (sum[x - 1] + sum[x] + sum[x + 1]) / (3.0f * rows);
    out[0] = (sum[0] + sum[1]) / (2.0f * rows);
    out[last] = (sum[last - 1] + sum[last]) / (2.0f * rows);
}

/* The same, where cells are summed row by row: so it is for planes of many channels. */
static inline void box_row_in_order(const float *above, const float *own, const float *below, int width, float *sum,
                                    float *out) {
    const float rows = 1.0f + (above ? 1.0f : 0.0f) + (below ? 1.0f : 0.0f);
    const float *row[3];
    int count = 0;
    if (above)
        row[count++] = above;
    row[count++] = own;
    if (below)
        row[count++] = below;
    const int last = width - 1;
    for (int x = 1; x < last; x++)
        sum[x] = row[0][x - 1] + row[0][x] + row[0][x + 1];
    sum[0] = row[0][0] + row[0][1];
    sum[last] = row[0][last - 1] + row[0][last];
    for (int i = 1; i < count; i++) {
        const float *r = row[i];
        for (int x = 1; x < last; x++)
            sum[x] = sum[x] + r[x - 1] + r[x] + r[x + 1];
        sum[0] = sum[0] + r[0] + r[1];
        sum[last] = sum[last] + r[last - 1] + r[last];
    }
    for (int x = 1; x < last; x++)
        out[x] = sum[x] / (3.0f * rows);
    out[0] = sum[0] / (2.0f * rows);
    out[last] = sum[last] / (2.0f * rows);
}

typedef void BoxRow(const float *above, const float *own, const float *below, int width, float *sum, float *out);

/* The mean over 3x3 cells of a plane. */
static inline void box_plane(BoxRow *box, const float *in, ptrdiff_t in_row, int height, int width, float *sum,
                             float *out, ptrdiff_t out_row) {
    for (int y = 0; y < height; y++)
        box(y ? in + (y - 1) * in_row : NULL, in + y * in_row, y < height - 1 ? in + (y + 1) * in_row : NULL, width,
            sum, out + y * out_row);
}

/* Box windows of three sizes of the scores of one disparity. */
static inline void box_scores(const Step *s, int bin, int worker) {
    const Workspace *k = s->space;
    const float *sharp = s->model->begin.sharpness;
    const ptrdiff_t row = (ptrdiff_t)BINS * k->p8;
    float *sum = (float *)scratch(s, worker), *first = sum + k->p8 + 2 * LANES;
    float *second = first + (ptrdiff_t)k->h8 * k->p8;
    const float *narrow = k->narrow + (ptrdiff_t)bin * k->p8;
    float *middle = k->middle + (ptrdiff_t)bin * k->p8, *fixed = k->fixed + (ptrdiff_t)bin * k->p8;
    box_plane(box_row_in_order, narrow, row, k->h8, k->w8, sum, middle, row);
    box_plane(box_row_in_order, middle, row, k->h8, k->w8, sum, first, k->p8);
    box_plane(box_row_in_order, first, k->p8, k->h8, k->w8, sum, second, k->p8);
    for (int y = 0; y < k->h8; y++) {
        const float *a = narrow + y * row, *b = middle + y * row, *c = second + (ptrdiff_t)y * k->p8;
        float *out = fixed + y * row;
        for (int x = 0; x < k->w8; x++)
            out[x] = a[x] * sharp[0] + b[x] * sharp[1] + c[x] * sharp[2];
    }
}

/* The scores of each disparity, and the context at 1/4. */
static void second_stage(void *context, int chunk, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    if (chunk < BINS) {
        box_scores(s, chunk, worker);
        return;
    }
    ROWS_OF(chunk - BINS, 4, k->h4, y)
        conv_3x3(&s->model->begin.conv[QUARTER], &k->patch, y, k->w4, pixel_row(&k->context4, y), FINE);
}

/* Inputs of the cost filter of two rows: how far each score is below the best of its left cell, and
   of its right cell, which another surface may claim. */
static inline void cost_features(const Step *s, int pair, int worker) {
    const Workspace *k = s->space;
    const Begin *b = &s->model->begin;
    const Conv *conv = &b->conv[FEATURES];
    const int p8 = k->p8, w8 = k->w8, groups = BINS / 2;
    float *top = (float *)scratch(s, worker), *claimed[2];
    claimed[0] = top + p8;
    claimed[1] = claimed[0] + p8 + BINS;
    uint8_t *plane[4];
    plane[0] = (uint8_t *)(claimed[1] + p8 + BINS);
    for (int i = 1; i < 4; i++)
        plane[i] = plane[i - 1] + p8;
    uint8_t *stack = plane[3] + p8; /* [BINS][2][w8][4] */
    for (int r = 0; r < 2; r++) {
        const ptrdiff_t at = (ptrdiff_t)(2 * pair + r) * BINS * p8;
        float *fixed = k->fixed + at;
        memcpy(top, fixed, sizeof(float) * (size_t)w8);
        for (int i = 0; i < 2 * (p8 + BINS); i++)
            claimed[0][i] = -1e4f;
        for (int i = 0; i < BINS; i++) {
            const float *score = fixed + (ptrdiff_t)i * p8;
            float *best = claimed[i & 1] + i / 2; /* at x: right entry 2 x - (47 - i) */
            for (int x = 0; x < w8; x++)
                top[x] = most(score[x], top[x]);
            for (int x = 0; x < w8; x++)
                best[x] = most(score[x], best[x]);
        }
        /* What lies left of the image has the first entry's rival. */
        for (int i = 0; i < groups; i++)
            claimed[0][i] = claimed[1][i] = claimed[1][groups - 1];
        for (int i = 0; i < BINS; i++) {
            float *score = fixed + (ptrdiff_t)i * p8;
            const float *rival = claimed[i & 1] + i / 2;
            const float *narrow = k->narrow + at + (ptrdiff_t)i * p8, *middle = k->middle + at + (ptrdiff_t)i * p8;
            for (int x = 0; x < w8; x++) {
                plane[0][x] = to_byte(narrow[x], conv->in_step, conv->in_zero);
                plane[1][x] = to_byte(middle[x], conv->in_step, conv->in_zero);
            }
            for (int x = 0; x < w8; x++) {
                float lead = (score[x] - top[x]) * 0.1f, claim = least(score[x] - rival[x], 0.0f) * 0.1f;
                plane[2][x] = to_byte(most(lead, -1.0f), conv->in_step, conv->in_zero);
                plane[3][x] = to_byte(most(claim, -1.0f), conv->in_step, conv->in_zero);
                score[x] = score[x] + b->sharpness[3] * claim;
            }
            uint8_t *out = stack + (ptrdiff_t)(2 * i + r) * w8 * 4;
            for (int x = 0; x < w8; x++)
                for (int j = 0; j < 4; j++)
                    out[4 * x + j] = plane[j][x];
        }
    }
    for (int i = 0; i < BINS; i++) {
        const uint8_t *first = stack + (ptrdiff_t)2 * i * w8 * 4, *second = first + w8 * 4;
        const uint8_t *tap[4] = {first, first + 4, second, second + 4};
        conv_row(conv, tap, 4, k->w16, 8, k->features + ((ptrdiff_t)i * k->h16 + pair) * k->w16 * COST, COST);
    }
}

static void third_stage(void *context, int chunk, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const Begin *b = &s->model->begin;
    if (chunk < k->h16) {
        cost_features(s, chunk, worker);
        return;
    }
    ROWS_OF(chunk - k->h16, 4, k->h8, y) {
        uint8_t *row = (uint8_t *)scratch(s, worker);
        conv_3x3(&b->conv[TO_EIGHTH], &k->context4, y, k->w8, row, EIGHTH);
        conv_pixels(&b->conv[IN_EIGHTH], row, k->w8, pixel_row(&k->in8, y), EIGHTH);
    }
}

/* The context at 1/16 and 1/32. */
static void fourth_stage(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    (void)worker;
    conv_3x3(&s->model->begin.conv[TO_16TH], &k->in8, y, k->w16, pixel_row(&k->low16, y), SIXTEENTH);
}

static void fifth_stage(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const Begin *b = &s->model->begin;
    uint8_t *row = (uint8_t *)scratch(s, worker), *low = row + (ptrdiff_t)k->w32 * SIXTEENTH;
    conv_3x3(&b->conv[TO_32ND], &k->low16, y, k->w32, row, SIXTEENTH);
    conv_pixels(&b->conv[IN_32ND], row, k->w32, low, SIXTEENTH);
    uint8_t *sums = low + (ptrdiff_t)k->w32 * SIXTEENTH, *at16 = sums + (ptrdiff_t)k->w16 * SIXTEENTH;
    uint8_t *back = at16 + (ptrdiff_t)k->w16 * SIXTEENTH, *at8 = back + (ptrdiff_t)k->w16 * EIGHTH;
    for (int r = 2 * y; r < 2 * y + 2; r++) {
        sum_row_doubled(&b->sum[SUM_16TH], pixel_row(&k->low16, r), low, k->w16, SIXTEENTH, sums);
        conv_pixels(&b->conv[IN_16TH], sums, k->w16, at16, SIXTEENTH);
        conv_pixels(&b->conv[LEAVE_16TH], at16, k->w16, k->context16 + (ptrdiff_t)r * k->w16 * COST, COST);
        conv_pixels(&b->conv[BACK_8TH], at16, k->w16, back, EIGHTH);
        for (int q = 2 * r; q < 2 * r + 2; q++) {
            sum_row_doubled(&b->sum[SUM_8TH], pixel_row(&k->in8, q), back, k->w8, EIGHTH, at8);
            conv_pixels(&b->conv[LEAVE_8TH], at8, k->w8, k->context8 + (ptrdiff_t)q * k->w8 * 16, 16);
        }
    }
}

static void begin(Step *s) {
    const Workspace *k = s->space;
    const Begin *b = &s->model->begin;
    fill_border(&k->patch, b->conv[QUARTER].in_zero);
    fill_border(&k->context4, b->conv[TO_EIGHTH].in_zero);
    fill_border(&k->in8, b->conv[TO_16TH].in_zero);
    fill_border(&k->low16, b->conv[TO_32ND].in_zero);
    pool_run(s->pool, gray_rows, s, 2 * bands(k->h4, GRAY_BAND));
    pool_run(s->pool, match_row, s, k->h8);
    pool_run(s->pool, second_stage, s, BINS + bands(k->h4, 4));
    pool_run(s->pool, third_stage, s, k->h16 + bands(k->h8, 4));
    pool_run(s->pool, fourth_stage, s, k->h16);
    pool_run(s->pool, fifth_stage, s, k->h32);
}
#endif
