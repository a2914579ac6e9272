/* How ambiguous the match of each cell of 1/8 is, and what follows for sigma. */
#ifndef VERGENCE_AMBIGUITY_H
#define VERGENCE_AMBIGUITY_H
#include "search.h"

#if defined(__GNUC__)
#define NOINLINE __attribute__((noinline)) /* inlined, `restrict` is forgotten */
#else
#define NOINLINE
#endif

/* Rows of measures, in the order of the network's inputs. */
enum { SPREAD_SOFT, SPREAD_SHARP, TOP, BELOW_TOP, LEAD, BEYOND, ANSWER, LOG_SIGMA, SPREAD_AROUND, TOP_AROUND,
       SPREAD_FAR, TOP_FAR };

static inline float *measure_row(const Workspace *k, int measure, int y) {
    return k->measures + ((ptrdiff_t)measure * k->h8 + y) * k->p8;
}

/* The best and the sum of a row's scores. `restrict` lets the compiler use vectors. */
static NOINLINE void add_to_top(const float *restrict score, int n, float *restrict top, float *restrict sum) {
    for (int x = 0; x < n; x++) {
        top[x] = most(score[x], top[x]);
        sum[x] += score[x];
    }
}

/* What scores of one disparity add: its share, soft and sharp, and that times the distance from the answer;
   the best score near the answer, and the best elsewhere. */
static NOINLINE void add_to_spread(const float *restrict score, float bin_px, int n, const float *restrict answer,
                                   const float *restrict top, float *restrict own, float *restrict rival,
                                   float *restrict soft_sum, float *restrict sharp_sum, float *restrict soft_px,
                                   float *restrict sharp_px) {
    for (int x = 0; x < n; x++) {
        const float v = score[x], apart = fabsf(bin_px - answer[x]), beside = most(apart - 6.0f, 0.0f);
        const float near = apart <= 6.0f ? 1000.0f : 0.0f;
        const float soft = own_exp((v - top[x]) * 0.25f), square = soft * soft, sharp = square * square;
        own[x] = most(v + near, own[x]);
        rival[x] = most(v - near, rival[x]);
        soft_sum[x] += soft;
        sharp_sum[x] += sharp;
        soft_px[x] += soft * beside;
        sharp_px[x] += sharp * beside;
    }
}

/* Measures of the scores of a row round its answer; the refinement's doubt becomes its sigma. */
static void ambiguity_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const float *sigma = s->model->end.sigma;
    const int w = k->w8, p8 = k->p8;
    float *d = (float *)scratch(s, worker), *top = d + p8, *sum = top + p8, *own = sum + p8, *rival = own + p8;
    float *soft = rival + p8, *sharp = soft + p8, *soft_far = sharp + p8, *sharp_far = soft_far + p8;
    const float *a = k->d4 + (ptrdiff_t)2 * y * k->p4, *b = a + k->p4;
    float *raw_a = k->doubt + (ptrdiff_t)2 * y * k->p4, *raw_b = raw_a + k->p4;
    for (int x = 0; x < k->w4; x++) {
        raw_a[x] = own_exp(clamped(raw_a[x] * sigma[0], sigma[1], sigma[2])) * sigma[3];
        raw_b[x] = own_exp(clamped(raw_b[x] * sigma[0], sigma[1], sigma[2])) * sigma[3];
    }
    const float *score = k->fixed + (ptrdiff_t)y * BINS * p8;
    for (int x = 0; x < w; x++) {
        d[x] = ((a[2 * x] + a[2 * x + 1]) + (b[2 * x] + b[2 * x + 1])) * 0.25f;
        top[x] = sum[x] = score[x];
        own[x] = rival[x] = -3.0e38f;
        soft[x] = sharp[x] = soft_far[x] = sharp_far[x] = 0.0f;
    }
    for (int i = 1; i < BINS; i++)
        add_to_top(score + i * p8, w, top, sum);
    for (int i = 0; i < BINS; i++)
        add_to_spread(score + i * p8, (float)((BINS - 1 - i) * 4), w, d, top, own, rival, soft, sharp, soft_far,
                      sharp_far);
    float *soft_px = measure_row(k, SPREAD_SOFT, y), *sharp_px = measure_row(k, SPREAD_SHARP, y);
    float *best = measure_row(k, TOP, y), *below = measure_row(k, BELOW_TOP, y), *lead = measure_row(k, LEAD, y);
    float *outside = measure_row(k, BEYOND, y), *answer = measure_row(k, ANSWER, y);
    float *log_sigma = measure_row(k, LOG_SIGMA, y);
    for (int x = 0; x < w; x++) {
        const float of_own = own[x] - 1000.0f;
        soft_px[x] = own_log(soft_far[x] / soft[x] + 1.0f);
        sharp_px[x] = own_log(sharp_far[x] / sharp[x] + 1.0f);
        best[x] = (top[x] - sum[x] * (1.0f / BINS)) * 0.1f;
        below[x] = least((top[x] - of_own) * 0.1f, 4.0f);
        lead[x] = clamped((of_own - rival[x]) * 0.1f, -2.0f, 2.0f);
    }
    for (int x = 0; x < w; x++) {
        outside[x] = clamped((d[x] - ((float)x * 8.0f + 3.5f)) * 0.125f, -1.0f, 1.0f);
        answer[x] = d[x] * 0.015625f;
        log_sigma[x] = own_log(((raw_a[2 * x] + raw_a[2 * x + 1]) + (raw_b[2 * x] + raw_b[2 * x + 1])) * 0.25f);
    }
}

/* The mean of the sharp spread or of the top (part 0 or 1) near each cell, or farther round it (2 or 3). */
static void surroundings(void *context, int part, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const int h = k->h8, w = k->w8, p8 = k->p8, h4 = k->h32, w4 = k->w32;
    const float *in = measure_row(k, part & 1 ? TOP : SPREAD_SHARP, 0);
    float *out = measure_row(k, SPREAD_AROUND + part, 0);
    float *sum = (float *)scratch(s, worker), *first = sum + p8 + 2 * LANES;
    if (part < 2) {
        box_plane(box_row, in, p8, h, w, sum, first, p8);
        box_plane(box_row, first, p8, h, w, sum, out, p8);
        return;
    }
    float *second = first + (ptrdiff_t)h4 * w4;
    for (int y = 0; y < h4; y++)
        for (int x = 0; x < w4; x++) {
            float total = 0.0f;
            for (int j = 0; j < 4; j++) {
                const float *row = in + (ptrdiff_t)(4 * y + j) * p8 + 4 * x;
                total += (row[0] + row[1]) + (row[2] + row[3]);
            }
            first[(ptrdiff_t)y * w4 + x] = total * 0.0625f;
        }
    box_plane(box_row, first, w4, h4, w4, sum, second, w4);
    box_plane(box_row, second, w4, h4, w4, sum, first, w4);
    for (int y = 0; y < h; y++)
        for (int x = 0; x < w; x++)
            out[(ptrdiff_t)y * p8 + x] = first[(ptrdiff_t)(y / 4) * w4 + x / 4];
}

/* `outputs` sums of weighted rows: weights [output][input], then biases. */
static inline void weighted_rows(const float *weights, int inputs, int outputs, const float *const *in, int p8,
                                 float *out) {
    for (int o = 0; o < outputs; o++)
        for (int x = 0; x < p8; x += LANES) {
            Floats sum = f_all(weights[outputs * inputs + o]);
            for (int i = 0; i < inputs; i++)
                sum = f_fma(f_all(weights[o * inputs + i]), f_load(in[i] + x), sum);
            f_store(out + (ptrdiff_t)o * p8 + x, sum);
        }
}

/* The gain of a row's sigma, and its floor in px. */
static void factors_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const End *e = &s->model->end;
    const int p8 = k->p8;
    float *inner = (float *)scratch(s, worker), *found = inner + SIGMA_HIDDEN * p8;
    const float *in[SIGMA_HIDDEN];
    for (int i = 0; i < MEASURES; i++)
        in[i] = measure_row(k, i, y);
    weighted_rows(e->enter, MEASURES, SIGMA_HIDDEN, in, p8, inner);
    for (int i = 0; i < SIGMA_HIDDEN * p8; i++)
        inner[i] = most(inner[i], 0.0f);
    for (int i = 0; i < SIGMA_HIDDEN; i++)
        in[i] = inner + i * p8;
    weighted_rows(e->leave, SIGMA_HIDDEN, 2, in, p8, found);
    float *gain = k->factors + (ptrdiff_t)y * p8, *floor_px = gain + (ptrdiff_t)k->h8 * p8;
    for (int x = 0; x < k->w8; x++) {
        gain[x] = own_exp(clamped(found[x], -3.0f, 3.0f));
        floor_px[x] = own_exp(clamped(found[p8 + x], -6.0f, 4.6f));
    }
}
#endif
