/* An iteration at 1/8: the scores of all disparities, the recurrent cell, and a choice. */
#ifndef VERGENCE_SEARCH_H
#define VERGENCE_SEARCH_H
#include "warp.h"

#define MIN_PX 0.1f
#define AROUND 8 /* scores looked up round the current disparity and at the fills */

/* The learned residual of one disparity's scores. */
static void filter_bin(void *context, int bin, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const Iteration *n = s->now;
    const int w = k->w16, h = k->h16, count = w * COST;
    const float bin_px = (float)((BINS - 1 - bin) * 4);
    const Conv *expected = &n->conv[EXPECTED], *leave = &n->conv[C_LEAVE];
    Image x = {NULL, h, w, COST, (ptrdiff_t)(w + 2) * COST}, low = {NULL, k->h32, k->w32, COST, (ptrdiff_t)(k->w32 + 2) * COST};
    uint8_t *at = (uint8_t *)scratch(s, worker);
    x.data = at + x.row + COST;
    at += (h + 2) * x.row;
    low.data = at + low.row + COST;
    at += (k->h32 + 2) * low.row;
    uint8_t *near = at, *row = near + (ptrdiff_t)w * 4, *half = row + count, *sums = half + count;
    float *px = (float *)(void *)((uintptr_t)(sums + count + 63) & ~(uintptr_t)63);
    fill_border(&x, n->conv[C_DOWN].in_zero);
    fill_border(&low, n->conv[C_LOW].in_zero);
    for (int y = 0; y < h; y++) {
        for (int j = 0; j < 2; j++) {
            const float *prior = k->prior8 + (ptrdiff_t)(2 * y + j) * k->p8;
            for (int i = 0; i < k->w8; i++) {
                float far = prior[i] - (prior[i] <= 0 ? 1000.0f : 0.0f);
                px[i] = most(1.0f - fabsf(far - bin_px) * 0.125f, 0.0f);
            }
            for (int i = 0; i < w; i++) {
                near[4 * i + 2 * j] = to_byte(px[2 * i], expected->in_step, expected->in_zero);
                near[4 * i + 2 * j + 1] = to_byte(px[2 * i + 1], expected->in_step, expected->in_zero);
            }
        }
        conv_pixels(expected, near, w, row, COST);
        sum_row(&n->sum[SUM_EXPECTED], k->features + ((ptrdiff_t)bin * h + y) * count, row, count, sums);
        sum_row(&n->sum[SUM_CONTEXT], sums, k->context16 + (ptrdiff_t)y * count, count, pixel_row(&x, y));
    }
    for (int y = 0; y < k->h32; y++)
        conv_3x3(&n->conv[C_DOWN], &x, y, k->w32, pixel_row(&low, y), COST);
    for (int y = 0; y < k->h32; y++) {
        conv_3x3(&n->conv[C_LOW], &low, y, k->w32, half, COST);
        for (int r = 2 * y; r < 2 * y + 2; r++) {
            sum_row_doubled(&n->sum[SUM_COST], pixel_row(&x, r), half, w, COST, row);
            conv_pixels(&n->conv[C_MIDDLE], row, w, pixel_row(&x, r), COST);
            conv_pixels(leave, pixel_row(&x, r), w, row, COST);
            for (int j = 0; j < 2; j++) {
                const ptrdiff_t out = ((ptrdiff_t)(2 * r + j) * BINS + bin) * k->p8;
                const float *fixed = k->fixed + out;
                float *score = k->scores + out;
                for (int i = 0; i < w; i++) {
                    const uint8_t *byte = row + (ptrdiff_t)i * COST + 2 * j;
                    score[2 * i] = fixed[2 * i] + (float)(byte[0] - leave->out_zero) * leave->out_step;
                    score[2 * i + 1] = fixed[2 * i + 1] + (float)(byte[1] - leave->out_zero) * leave->out_step;
                }
            }
        }
    }
}

static inline float sum_of_five(const float v[5]) { return v[0] + v[1] + v[2] + v[3] + v[4]; }

static inline void exp_row(const float *v, const float *high, int w, float *out) {
    for (int x = 0; x < w; x++)
        out[x] = own_exp(v[x] - high[x]);
}

/* The best window of five scores of each cell of a row: its disparity and its share. */
static void peak_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const int w = k->w8, p8 = k->p8;
    const float *score = k->scores + (ptrdiff_t)y * BINS * p8;
    float *top = k->top + (ptrdiff_t)y * p8;
    int32_t *best = (int32_t *)scratch(s, worker);
    float *window = (float *)(best + p8), *high = window + 5 * p8, *total = high + p8; /* window [5][p8] */
    for (int x = 0; x < w; x++) {
        top[x] = score[x];
        best[x] = 0;
    }
    for (int i = 1; i < BINS; i++)
        for (int x = 0; x < w; x++) {
            float v = score[i * p8 + x];
            best[x] = v > top[x] ? i : best[x];
            top[x] = v > top[x] ? v : top[x];
        }
    for (int x = 0; x < w; x++) {
        best[x] = best[x] < 2 ? 2 : best[x] > BINS - 3 ? BINS - 3 : best[x];
        for (int j = 0; j < 5; j++)
            window[j * p8 + x] = score[(best[x] + j - 2) * p8 + x];
    }
    for (int x = 0; x < w; x++) {
        float v = window[x];
        for (int j = 1; j < 5; j++)
            v = most(window[j * p8 + x], v);
        high[x] = v;
    }
    exp_row(score, high, w, total);
    for (int i = 1; i < BINS; i++)
        for (int x = 0; x < w; x++)
            total[x] += own_exp(score[i * p8 + x] - high[x]);
    float *out = k->best + (ptrdiff_t)y * p8, *log_p = k->best_log + (ptrdiff_t)y * p8;
    float *confidence = k->confidence + (ptrdiff_t)y * p8;
    for (int x = 0; x < w; x++) {
        float share[5], part[5];
        for (int j = 0; j < 5; j++) {
            share[j] = own_exp(window[j * p8 + x] - high[x]);
            part[j] = share[j] * (float)(j - 2);
        }
        float mass = sum_of_five(share), moment = sum_of_five(part);
        out[x] = ((float)(BINS - 1) - (float)best[x] - moment / mass) * 4.0f;
        log_p[x] = own_log(mass / total[x]);
        confidence[x] = own_exp(log_p[x] * 4.0f);
    }
}

/* Row `y` of twice the size, bilinear: `in` has `h` rows of `w` cells. The order of the sums is fixed. */
static inline void enlarged_row(const float *in, int h, int w, ptrdiff_t in_row, int y, float *out) {
    int first = (y - 1) >> 1, second = first + 1;
    float down = y & 1 ? 0.25f : 0.75f, up = 1.0f - down; /* shares of the second and the first row */
    if (first < 0) {
        first = 0, second = h > 1 ? 1 : 0;
        up = 1.0f, down = 0.0f;
    } else if (second >= h) {
        second = first;
        up = down = 0.5f;
    }
    const float *a = in + first * in_row, *b = in + second * in_row;
    const float near_a = 0.75f * up, far_a = 0.25f * up, near_b = 0.75f * down, far_b = 0.25f * down;
    for (int x = 0; x < w - 1; x++) {
        out[2 * x + 1] = near_a * a[x] + far_a * a[x + 1] + near_b * b[x] + far_b * b[x + 1];
        out[2 * x + 2] = far_a * a[x] + near_a * a[x + 1] + far_b * b[x] + near_b * b[x + 1];
    }
    out[0] = up * a[0] + down * b[0];
    const float half_a = 0.5f * up, half_b = 0.5f * down;
    out[2 * w - 1] = half_a * a[w - 1] + half_a * a[w - 1] + half_b * b[w - 1] + half_b * b[w - 1];
}

/* Add a tenth of twice the size to `out`. */
static void add_enlarged(const float *in, int h, int w, ptrdiff_t in_row, float *row, float *out, ptrdiff_t out_row) {
    for (int y = 0; y < 2 * h; y++) {
        enlarged_row(in, h, w, in_row, y, row);
        for (int x = 0; x < 2 * w; x++)
            out[y * out_row + x] += row[x] * 0.1f;
    }
}

static void halve(const float *in, ptrdiff_t in_row, int h, int w, float *out) {
    for (int y = 0; y < h; y++)
        for (int x = 0; x < w; x++) {
            const float *a = in + 2 * y * in_row + 2 * x, *b = a + in_row;
            out[y * w + x] = ((a[0] + b[0]) + (a[1] + b[1])) * 0.25f; /* columns first */
        }
}

/* Fill from confident cells: a pull-push pyramid of confidence-weighted means. */
static void smooth_fill(const Step *s, char *memory) {
    const Workspace *k = s->space;
    const int h = k->h8, w = k->w8, p8 = k->p8, h2 = h / 2, w2 = w / 2, h4 = h / 4, w4 = w / 4;
    float *sum = (float *)memory, *full = sum + p8 + 2 * LANES, *wide = full + (ptrdiff_t)h * p8;
    float *half = wide + 2 * (ptrdiff_t)h * p8, *half_box = half + h2 * w2;
    float *quarter = half_box + h2 * w2, *box1 = quarter + h4 * w4, *box2 = box1 + h4 * w4, *box3 = box2 + h4 * w4;
    for (int part = 0; part < 2; part++) {
        for (int y = 0; y < h; y++) {
            const float *d = k->best + (ptrdiff_t)y * p8, *c = k->confidence + (ptrdiff_t)y * p8;
            for (int x = 0; x < w; x++) {
                float weight = c[x] + 1e-4f;
                full[(ptrdiff_t)y * p8 + x] = part ? weight : d[x] * weight;
            }
        }
        halve(full, p8, h2, w2, half);
        halve(half, w2, h4, w4, quarter);
        box_plane(box_row, quarter, w4, h4, w4, sum, box1, w4);
        box_plane(box_row, box1, w4, h4, w4, sum, box2, w4);
        box_plane(box_row, box2, w4, h4, w4, sum, box3, w4);
        for (int i = 0; i < h4 * w4; i++)
            box1[i] += box3[i] * 0.1f;
        box_plane(box_row, half, w2, h2, w2, sum, half_box, w2);
        add_enlarged(box1, h4, w4, w4, sum, half_box, w2);
        float *out = wide + (ptrdiff_t)part * h * p8;
        box_plane(box_row, full, p8, h, w, sum, out, p8);
        add_enlarged(half_box, h2, w2, w2, sum, out, p8);
    }
    for (int y = 0; y < h; y++)
        for (int x = 0; x < w; x++)
            k->fills[(ptrdiff_t)y * p8 + x] = wide[(ptrdiff_t)y * p8 + x] / wide[(ptrdiff_t)(h + y) * p8 + x];
}

/* The largest of 3x9 cells; the row's ends count the cells there are. `in` and `out` [h][p8]. */
static void largest_3x9(const float *in, int h, int w, int p8, float *padded, float *out) {
    for (int y = 0; y < h; y++) {
        const float *a = in + (ptrdiff_t)(y ? y - 1 : y) * p8, *b = in + (ptrdiff_t)y * p8;
        const float *c = in + (ptrdiff_t)(y < h - 1 ? y + 1 : y) * p8;
        for (int x = 0; x < 4; x++)
            padded[x] = padded[w + 4 + x] = -3.0e38f;
        for (int x = 0; x < w; x++)
            padded[x + 4] = most(most(a[x], b[x]), c[x]);
        for (int x = 0; x < w; x++) {
            float v = padded[x];
            for (int i = 1; i < 9; i++)
                v = most(padded[x + i], v);
            out[(ptrdiff_t)y * p8 + x] = v;
        }
    }
}

/* The farthest (sign -1) or the nearest (sign 1) surface among confident neighbours, if there is. */
static void extreme(const Step *s, float sign, char *memory, float *found) {
    const Workspace *k = s->space;
    const ptrdiff_t n = (ptrdiff_t)k->h8 * k->p8;
    float *padded = (float *)memory, *signed_px = padded + k->p8 + LANES, *beside = signed_px + n, *wide = beside + n;
    for (ptrdiff_t i = 0; i < n; i++)
        signed_px[i] = sign * k->best[i] - (k->confidence[i] < 0.5f ? 1000.0f : 0.0f);
    largest_3x9(signed_px, k->h8, k->w8, k->p8, padded, beside);
    largest_3x9(beside, k->h8, k->w8, k->p8, padded, wide);
    for (ptrdiff_t i = 0; i < n; i++) {
        float v = beside[i] > -500.0f ? beside[i] : wide[i];
        found[i] = v > -500.0f ? sign * v : -3.0e38f; /* replaced by the smooth fill: update_row */
    }
}

static void fill(void *context, int part, int worker) {
    Step *s = context;
    const ptrdiff_t plane = (ptrdiff_t)s->space->h8 * s->space->p8;
    if (part == 0)
        smooth_fill(s, scratch(s, worker));
    else
        extreme(s, part == 1 ? -1.0f : 1.0f, scratch(s, worker), s->space->fills + part * plane);
}

/* The mean of five surfaces by the softmax of logits: both [5][pitch]. */
static inline void expected_of_five(const float *logits, const float *surfaces, int pitch, int w, float *out) {
    for (int x = 0; x < w; x++) {
        float high = logits[x], share[5], part[5];
        for (int i = 1; i < 5; i++)
            high = most(logits[i * pitch + x], high);
        for (int i = 0; i < 5; i++) {
            share[i] = own_exp(logits[i * pitch + x] - high);
            part[i] = share[i] * surfaces[i * pitch + x];
        }
        out[x] = sum_of_five(part) / sum_of_five(share);
    }
}

/* Scores round the current disparity and at the fills, as logarithms below the best. */
static inline void look_up(const float *score, int p8, int w, const float *d, const float *fills, ptrdiff_t plane,
                           const float *top, float *log_p) {
    for (int x = 0; x < w; x++) {
        float position = clamped((float)(BINS - 1) - d[x] * 0.25f, -1e4f, 1e4f), low = floorf(position);
        float share = position - low, entry[6];
        for (int i = 0; i < 6; i++) {
            int e = (int)low + i - 2;
            entry[i] = e >= 0 && e < BINS ? score[e * p8 + x] : 0.0f;
        }
        for (int i = 0; i < TAPS; i++)
            log_p[i * p8 + x] = entry[i] + (entry[i + 1] - entry[i]) * share;
        for (int i = 0; i < 3; i++) {
            position = clamped((float)(BINS - 1) - fills[i * plane + x] * 0.25f, -1e4f, 1e4f);
            low = floorf(position);
            int e = (int)low;
            float v = 0.0f;
            if (e >= 0 && e < BINS - 1)
                v = score[e * p8 + x] + (score[(e + 1) * p8 + x] - score[e * p8 + x]) * (position - low);
            log_p[(TAPS + i) * p8 + x] = v;
        }
    }
    for (int i = 0; i < AROUND; i++)
        for (int x = 0; x < w; x++)
            log_p[i * p8 + x] = clamped(log_p[i * p8 + x] - top[x], -20.0f, 0.0f);
}

/* Read the scores, step the recurrent cell, choose among surfaces: a row of 1/8. */
static void update_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const Iteration *n = s->now;
    const int w = k->w8, p8 = k->p8;
    const ptrdiff_t plane = (ptrdiff_t)k->h8 * p8, at = (ptrdiff_t)y * p8;
    enum { OWN = CELL_INPUTS - 16 }; /* inputs besides the context */
    float *input = (float *)scratch(s, worker), *logits = input + OWN * p8, *surfaces = logits + 5 * p8;
    float *log_p = surfaces + 5 * p8, *mean = log_p + AROUND * p8;
    uint8_t *cell = (uint8_t *)(mean + p8), *gates = cell + 64 * p8, *column = gates + 64 * p8;
    const float *prior = k->prior8 + at, *seen = k->seen8 + at, *best_log = k->best_log + at;
    float *d = surfaces, *fills = surfaces + 2 * p8;
    for (int x = 0; x < w; x++) {
        float smooth = k->fills[at + x], hole = seen[x] <= 0 ? 1.0f : 0.0f;
        d[x] = prior[x] + hole * (smooth - prior[x]);
        surfaces[p8 + x] = k->best[at + x];
        fills[x] = smooth;
        for (int i = 1; i < 3; i++) {
            float found = k->fills[i * plane + at + x];
            fills[i * p8 + x] = found > -1e38f ? found : smooth;
        }
    }
    look_up(k->scores + at * BINS, p8, w, d, fills, p8, k->top + at, log_p);
    for (int i = 0; i < AROUND; i++)
        for (int x = 0; x < w; x++)
            input[i * p8 + x] = log_p[i * p8 + x] * 0.1f;
    for (int i = 0; i < 4; i++)
        for (int x = 0; x < w; x++)
            input[(9 + i) * p8 + x] = squash(surfaces[(1 + i) * p8 + x] - d[x], 2.0f);
    for (int x = 0; x < w; x++) {
        input[8 * p8 + x] = best_log[x];
        input[13 * p8 + x] = seen[x] <= 0 ? 1.0f : 0.0f;
        input[14 * p8 + x] = d[x] * 0.015625f;
        input[15 * p8 + x] = clamped((d[x] - ((float)x * 8.0f + 3.5f)) * 0.125f, -1.0f, 1.0f);
    }
    /* The cell: hidden state and inputs, as bytes of two scales. */
    float *hidden = k->hidden + (ptrdiff_t)y * w * HIDDEN;
    const uint8_t *context8 = k->context8 + (ptrdiff_t)y * w * 16;
    for (int pass = 0; pass < 2; pass++) {
        const Conv *c = &n->conv[pass ? CANDIDATE : GATES];
        const uint8_t *table = pass ? n->context_candidate : n->context_gates;
        const float step = c->in_step;
        const int zero = c->in_zero;
        for (int i = 0; i < OWN; i++) {
            for (int x = 0; x < w; x++)
                column[x] = to_byte(input[i * p8 + x], step, zero);
            for (int x = 0; x < w; x++)
                cell[(ptrdiff_t)x * 64 + HIDDEN + 16 + i] = column[x];
        }
        for (int x = 0; x < w; x++) {
            uint8_t *out = cell + (ptrdiff_t)x * 64;
            const float *h = hidden + (ptrdiff_t)x * HIDDEN;
            if (pass) {
                float reset[HIDDEN];
                for (int i = 0; i < HIDDEN; i++)
                    reset[i] = n->sigmoid_gates[gates[(ptrdiff_t)x * 64 + HIDDEN + i]];
                for (int i = 0; i < HIDDEN; i++)
                    out[i] = to_byte(reset[i] * h[i], step, zero);
            } else
                for (int i = 0; i < HIDDEN; i++)
                    out[i] = to_byte(h[i], step, zero);
            for (int i = 0; i < 16; i++)
                out[HIDDEN + i] = table[context8[(ptrdiff_t)x * 16 + i]];
        }
        if (!pass)
            conv_pixels(c, cell, w, gates, 64);
    }
    uint8_t *candidate = column + p8, *bytes = k->hidden8 + (ptrdiff_t)y * w * HIDDEN;
    conv_pixels(&n->conv[CANDIDATE], cell, w, candidate, HIDDEN);
    const Conv *head = &n->conv[HEAD];
    for (int x = 0; x < w; x++) {
        float update[HIDDEN], wanted[HIDDEN], *h = hidden + (ptrdiff_t)x * HIDDEN;
        for (int i = 0; i < HIDDEN; i++) {
            update[i] = n->sigmoid_gates[gates[(ptrdiff_t)x * 64 + i]];
            wanted[i] = n->tanh_candidate[candidate[(ptrdiff_t)x * HIDDEN + i]];
        }
        for (int i = 0; i < HIDDEN; i++) {
            uint8_t byte = to_byte(h[i] + update[i] * (wanted[i] - h[i]), head->in_step, head->in_zero);
            bytes[(ptrdiff_t)x * HIDDEN + i] = byte;
            h[i] = (float)(byte - head->in_zero) * head->in_step;
        }
    }
    uint8_t *of_head = cell, *learned = gates;
    const Conv *out = &n->conv[OUT_8TH];
    conv_pixels(head, bytes, w, of_head, HIDDEN);
    conv_pixels(out, of_head, w, learned, LANES);
    conv_pixels(&n->conv[OF_HIDDEN], bytes, w, k->of8.data + y * k->of8.row, FINE);
    /* The fixed part of the choice is the score, and a penalty on peaks that are not unique. */
    for (int x = 0; x < w; x++) {
        float fixed[5] = {log_p[2 * p8 + x] + 1.0f, best_log[x] * 2.0f, log_p[5 * p8 + x] - 1.0f,
                          log_p[6 * p8 + x] - 1.0f, log_p[7 * p8 + x] - 1.0f};
        for (int i = 0; i < 5; i++)
            logits[i * p8 + x] =
                fixed[i] + (float)(learned[(ptrdiff_t)x * LANES + i] - out->out_zero) * out->out_step * 4.0f;
    }
    expected_of_five(logits, surfaces, p8, w, mean);
    for (int x = 0; x < w; x++) {
        float offset = (float)(learned[(ptrdiff_t)x * LANES + 5] - out->out_zero) * out->out_step * 4.0f;
        k->d8[at + x] = most(mean[x] + offset, MIN_PX);
    }
}

static void search(Step *s) {
    const Workspace *k = s->space;
    pool_run(s->pool, filter_bin, s, BINS);
    pool_run(s->pool, peak_row, s, k->h8);
    pool_run(s->pool, fill, s, 3);
    pool_run(s->pool, update_row, s, k->h8);
}
#endif
