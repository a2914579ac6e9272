/* An iteration at 1/4: choose among nearby surfaces, fit sub-pixel; then up to full size. */
#ifndef VERGENCE_REFINE_H
#define VERGENCE_REFINE_H
#include "ambiguity.h"

enum { BLOCKS_OF_COLUMNS = 8, CELLS_BEFORE = 50 }; /* the window of right entries that a cell may read */

/* Products of a left cell with right entries of its row, rounded to bytes as the graph has them. */
typedef struct {
    Words left;
    const uint8_t *right;
    int first, last, zero, product_zero;
    float scale, step;
} Matches;

static ALWAYS_INLINE Matches matches_at(const Step *s, int y, int x) {
    const Workspace *k = s->space;
    const float *p = s->model->begin.pairs;
    const int block = k->w4 / BLOCKS_OF_COLUMNS;
    Matches m;
    m.left = words_of(k->fine_left + ((ptrdiff_t)y * k->w4 + x) * FINE_BITS, (int)p[1]);
    m.right = k->fine_right + (ptrdiff_t)y * 2 * k->w4 * FINE_BITS;
    m.first = 2 * (x / block * block - CELLS_BEFORE);
    m.first = m.first < 0 ? 0 : m.first;
    m.last = 2 * k->w4 - 1;
    m.zero = (int)p[3];
    m.product_zero = (int)p[5];
    m.scale = p[2] * p[0] / p[4];
    m.step = p[4];
    return m;
}

static ALWAYS_INLINE float match(const Matches *m, int entry) {
    entry = entry < m->first ? m->first : entry;
    int32_t sum = words_dot(m->left, words_of(m->right + (ptrdiff_t)entry * FINE_BITS, m->zero));
    float low = (float)-m->product_zero, high = (float)(255 - m->product_zero);
    return rintf(clamped((float)sum * m->scale, low, high)) * m->step;
}

static inline float *plane4(float *planes, const Workspace *k, int plane, int y) {
    return planes + ((ptrdiff_t)plane * k->h4 + y) * k->p4;
}

/* Surfaces of a row: the disparity of 1/8 between its cells, and the largest and the least nearby. */
static inline void surfaces_row(const Workspace *k, int y, float *surfaces) {
    const int h = k->h8, w = k->w8, own = y / 2;
    const float *a = k->d8 + (ptrdiff_t)own * k->p8;
    const float *above = k->d8 + (ptrdiff_t)(own ? own - 1 : own) * k->p8;
    const float *below = k->d8 + (ptrdiff_t)(own < h - 1 ? own + 1 : own) * k->p8;
    float *high = surfaces + k->p4, *low = high + k->p4;
    enlarged_row(k->d8, h, w, k->p8, y, surfaces);
    for (int x = 0; x < w; x++) {
        int left = x ? x - 1 : x, right = x < w - 1 ? x + 1 : x;
        float most_px = a[x], least_px = a[x];
        const float *rows[3] = {above, a, below};
        for (int i = 0; i < 3; i++) {
            most_px = most(most(most_px, rows[i][left]), most(rows[i][x], rows[i][right]));
            least_px = least(least(least_px, rows[i][left]), least(rows[i][x], rows[i][right]));
        }
        high[2 * x] = high[2 * x + 1] = most_px;
        low[2 * x] = low[2 * x + 1] = least_px;
    }
}

/* The scores of a row's surfaces. */
static void cost_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    float *surfaces = (float *)scratch(s, worker);
    surfaces_row(k, y, surfaces);
    for (int x = 0; x < k->w4; x++) {
        const Matches m = matches_at(s, y, x);
        for (int i = 0; i < SURFACES; i++) {
            float position = clamped((float)(2 * x) - surfaces[i * k->p4 + x] * 0.5f, -1e6f, 1e6f), low = floorf(position);
            int e = (int)low;
            float v = 0.0f;
            if (e >= 0 && e < m.last) {
                float below = match(&m, e), above = match(&m, e + 1);
                v = below + (above - below) * (position - low);
            }
            plane4(k->cost, k, i, y)[x] = v;
        }
    }
}

static inline void box_row_of(float *planes, const Workspace *k, int plane, int y, float *sum, float *out) {
    box_row(y ? plane4(planes, k, plane, y - 1) : NULL, plane4(planes, k, plane, y),
            y < k->h4 - 1 ? plane4(planes, k, plane, y + 1) : NULL, k->w4, sum, out);
}

/* Bytes of a row of values, as channel `channel` of `channels`. */
static inline void put_channel(const float *v, int w, const Conv *c, uint8_t *bytes, uint8_t *out, int channel, int channels) {
    const float step = c->in_step;
    const int zero = c->in_zero;
    for (int x = 0; x < w; x++)
        bytes[x] = to_byte(v[x], step, zero);
    for (int x = 0; x < w; x++)
        out[(ptrdiff_t)x * channels + channel] = bytes[x];
}

/* Features of a row from the surfaces, their scores, the context and the hidden state. */
static void measured_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const Iteration *n = s->now;
    const int w = k->w4, p4 = k->p4;
    float *surfaces = (float *)scratch(s, worker), *sum = surfaces + 3 * p4, *value = sum + p4 + 2 * LANES;
    uint8_t *bytes = (uint8_t *)(value + p4), *in = bytes + p4, *of_context = in + 12 * p4;
    uint8_t *of_measured = of_context + (ptrdiff_t)p4 * FINE, *sums = of_measured + (ptrdiff_t)p4 * FINE;
    const Conv *c = &n->conv[OF_MEASURED];
    const float *prior = k->prior + (ptrdiff_t)y * w;
    float *carried = plane4(k->carried, k, 0, y), *plain = plane4(k->plain, k, 0, y);
    surfaces_row(k, y, surfaces);
    memcpy(plain, surfaces, sizeof(float) * (size_t)w);
    for (int x = 0; x < w; x++)
        carried[x] = prior[x] + (prior[x] <= 0 ? 1.0f : 0.0f) * plain[x];
    for (int i = 0; i < SURFACES; i++) {
        float *wide = plane4(k->wide, k, i, y), *cost = plane4(k->cost, k, i, y);
        const float *other = i < 2 ? surfaces + (i + 1) * p4 : carried;
        box_row_of(k->cost, k, i, y, sum, wide);
        put_channel(cost, w, c, bytes, in, i, 12);
        put_channel(wide, w, c, bytes, in, 3 + i, 12);
        float *apart = i < 2 ? plane4(k->apart, k, i, y) : value;
        for (int x = 0; x < w; x++)
            apart[x] = squash(other[x] - plain[x], 2.0f);
        put_channel(apart, w, c, bytes, in, 6 + i, 12);
        for (int x = 0; x < w; x++)
            value[x] = clamped((surfaces[i * p4 + x] - ((float)x * 4.0f + 1.5f)) * 0.25f, -1.0f, 1.0f);
        put_channel(value, w, c, bytes, in, 9 + i, 12);
    }
    conv_pixels(c, in, w, of_measured, FINE);
    conv_pixels(&n->conv[OF_CONTEXT], pixel_row(&k->context4, y), w, of_context, FINE);
    sum_row(&n->sum[SUM_FIRST], of_context, of_measured, w * FINE, sums);
    sum_row_doubled(&n->sum[SUM_HIDDEN], sums, k->of8.data + (y / 2) * k->of8.row, w, FINE, pixel_row(&k->relu1, y));
}

static void down_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    (void)worker;
    conv_3x3(&s->now->conv[DOWN], &k->relu1, y, k->w8, pixel_row(&k->down8, y), LOW);
}

static void low_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    (void)worker;
    conv_3x3(&s->now->conv[LOW_1], &k->down8, y, k->w8, pixel_row(&k->low8, y), LOW);
}

static void lower_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const Iteration *n = s->now;
    uint8_t *low = (uint8_t *)scratch(s, worker), *back = low + (ptrdiff_t)k->p8 * LOW;
    conv_3x3(&n->conv[LOW_2], &k->low8, y, k->w8, low, LOW);
    conv_pixels(&n->conv[BACK_4TH], low, k->w8, back, FINE);
    for (int r = 2 * y; r < 2 * y + 2; r++)
        sum_row_doubled(&n->sum[SUM_WIDE], pixel_row(&k->relu1, r), back, k->w4, FINE, pixel_row(&k->relu2, r));
}

/* Choose among the surfaces of a row, and look at the scores round the choice. */
static void choose_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const Iteration *n = s->now;
    const Conv *choose = &n->conv[CHOOSE];
    const int w = k->w4, p4 = k->p4;
    float *surfaces = (float *)scratch(s, worker), *logits = surfaces + 3 * p4;
    uint8_t *learned = (uint8_t *)(logits + 3 * p4);
    float *d = plane4(k->d4, k, 0, y), *phase = plane4(k->phase, k, 0, y);
    surfaces_row(k, y, surfaces);
    conv_3x3(choose, &k->relu2, y, w, learned, LANES);
    conv_3x3(&n->conv[SECOND_X], &k->relu2, y, w, k->second4 + (ptrdiff_t)y * w * FINE, FINE);
    for (int i = 0; i < SURFACES; i++) {
        const float *cost = plane4(k->cost, k, i, y), *wide = plane4(k->wide, k, i, y);
        for (int x = 0; x < w; x++) {
            float part = (float)(learned[(ptrdiff_t)x * LANES + i] - choose->out_zero) * choose->out_step * 4.0f;
            logits[i * p4 + x] = cost[x] * n->sharpness[0] + wide[x] * n->sharpness[1] + part;
        }
    }
    for (int x = 0; x < w; x++) {
        float high = most(most(logits[x], logits[p4 + x]), logits[2 * p4 + x]), share[SURFACES];
        for (int i = 0; i < SURFACES; i++)
            share[i] = own_exp(logits[i * p4 + x] - high);
        float sum = share[0] * surfaces[x] + share[1] * surfaces[p4 + x] + share[2] * surfaces[2 * p4 + x];
        d[x] = sum / (share[0] + share[1] + share[2]);
    }
    for (int x = 0; x < w; x++) {
        const Matches m = matches_at(s, y, x);
        float position = clamped((float)(2 * x) - d[x] * 0.5f, -1e6f, 1e6f), low = floorf(position), entry[TAPS + 1];
        for (int i = 0; i < TAPS + 1; i++) {
            int e = (int)low + i - 2;
            entry[i] = e >= 0 && e <= m.last ? match(&m, e) : 0.0f;
        }
        phase[x] = position - low;
        for (int i = 0; i < TAPS; i++)
            plane4(k->taps, k, i, y)[x] = entry[i] + (entry[i + 1] - entry[i]) * phase[x];
    }
}

/* The centre of the peak of a row's scores, and the inputs of the last correction. */
static void fit_row(void *context, int y, int worker) {
    static const float tap_px[TAPS] = {4.0f, 2.0f, 0.0f, -2.0f, -4.0f};
    Step *s = context;
    const Workspace *k = s->space;
    const Iteration *n = s->now;
    const Conv *c = &n->conv[SECOND_FIT];
    const int w = k->w4, p4 = k->p4;
    float *smooth = (float *)scratch(s, worker), *sum = smooth + TAPS * p4, *offset = sum + p4 + 2 * LANES;
    float *logits = offset + p4, *value = logits + TAPS * p4;
    uint8_t *bytes = (uint8_t *)(value + p4), *out = pixel_row(&k->fit, y);
    float *d = plane4(k->d4, k, 0, y);
    const float *carried = plane4(k->carried, k, 0, y), *prior = k->prior + (ptrdiff_t)y * w;
    for (int i = 0; i < TAPS; i++) {
        float *mean = smooth + i * p4;
        box_row_of(k->taps, k, i, y, sum, mean);
        put_channel(plane4(k->taps, k, i, y), w, c, bytes, out, i, 16);
        put_channel(mean, w, c, bytes, out, TAPS + i, 16);
        for (int x = 0; x < w; x++)
            logits[i * p4 + x] = n->sharpness[2] * mean[x];
    }
    for (int x = 0; x < w; x++) {
        float high = logits[x], share[TAPS], part[TAPS];
        for (int i = 1; i < TAPS; i++)
            high = most(logits[i * p4 + x], high);
        for (int i = 0; i < TAPS; i++) {
            share[i] = own_exp(logits[i * p4 + x] - high);
            part[i] = share[i] * tap_px[i];
        }
        offset[x] = sum_of_five(part) / sum_of_five(share);
        d[x] += offset[x];
    }
    for (int x = 0; x < w; x++)
        value[x] = squash(carried[x] - d[x], 0.5f);
    put_channel(value, w, c, bytes, out, 10, 16);
    for (int x = 0; x < w; x++)
        value[x] = squash(offset[x], 0.5f);
    put_channel(value, w, c, bytes, out, 11, 16);
    for (int i = 0; i < 2; i++)
        put_channel(plane4(k->apart, k, i, y), w, c, bytes, out, 12 + i, 16);
    put_channel(plane4(k->phase, k, 0, y), w, c, bytes, out, 14, 16);
    for (int x = 0; x < w; x++)
        value[x] = prior[x] <= 0 ? 1.0f : 0.0f;
    put_channel(value, w, c, bytes, out, 15, 16);
}

/* The last correction of a row: a blend with the previous frame's surface, and a step. */
static void correct_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const Iteration *n = s->now;
    const Conv *last = &n->conv[OUT_4TH];
    const int w = k->w4;
    uint8_t *of_fit = (uint8_t *)scratch(s, worker), *learned = of_fit + (ptrdiff_t)k->p4 * FINE;
    uint8_t *features = k->features4 + (ptrdiff_t)y * w * FINE;
    conv_3x3(&n->conv[SECOND_FIT], &k->fit, y, w, of_fit, FINE);
    sum_row(&n->sum[SUM_SECOND], k->second4 + (ptrdiff_t)y * w * FINE, of_fit, w * FINE, features);
    conv_pixels(last, features, w, learned, LANES);
    float *d = plane4(k->d4, k, 0, y), *doubt = plane4(k->doubt, k, 0, y);
    const float *carried = plane4(k->carried, k, 0, y), *prior = k->prior + (ptrdiff_t)y * w;
    for (int x = 0; x < w; x++) {
        const uint8_t *byte = learned + (ptrdiff_t)x * LANES;
        float step = carried[x] - d[x], hole = prior[x] <= 0 ? 1.0f : 0.0f;
        float keep = n->sigmoid_keep[byte[1]] * own_exp(-fabsf(step)) * (1.0f - hole);
        float correction = (float)(byte[0] - last->out_zero) * last->out_step * 2.0f;
        d[x] = most(d[x] + keep * step + correction, MIN_PX);
        doubt[x] = (float)(byte[2] - last->out_zero) * last->out_step;
    }
}

static void refine(Step *s) {
    const Workspace *k = s->space;
    const Iteration *n = s->now;
    fill_border(&k->relu1, n->conv[DOWN].in_zero);
    fill_border(&k->relu2, n->conv[CHOOSE].in_zero);
    fill_border(&k->down8, n->conv[LOW_1].in_zero);
    fill_border(&k->low8, n->conv[LOW_2].in_zero);
    fill_border(&k->fit, n->conv[SECOND_FIT].in_zero);
    pool_run(s->pool, cost_row, s, k->h4);
    pool_run(s->pool, measured_row, s, k->h4);
    pool_run(s->pool, down_row, s, k->h8);
    pool_run(s->pool, low_row, s, k->h8);
    pool_run(s->pool, lower_row, s, k->h8);
    pool_run(s->pool, choose_row, s, k->h4);
    pool_run(s->pool, fit_row, s, k->h4);
    pool_run(s->pool, correct_row, s, k->h4);
}

/* Four rows of the full size: each pixel is a convex combination of the four cells round it. */
static void enlarge_row(void *context, int y, int worker) {
    Step *s = context;
    const Workspace *k = s->space;
    const End *e = &s->model->end;
    const int w = k->w4, p4 = k->p4;
    uint8_t *bytes = (uint8_t *)scratch(s, worker);
    float *share[3], *rows = (float *)(bytes + (ptrdiff_t)p4 * LANES), *pad[3];
    for (int i = 0; i < 3; i++) {
        int at = y + i - 1;
        at = at < 0 ? 0 : at >= k->h4 ? k->h4 - 1 : at;
        pad[i] = rows + i * (p4 + 2 * LANES) + LANES;
        memcpy(pad[i], plane4(k->d4, k, 0, at), sizeof(float) * (size_t)w);
        pad[i][-1] = pad[i][0];
        pad[i][w] = pad[i][w - 1];
        share[i] = rows + 3 * (p4 + 2 * LANES) + (ptrdiff_t)i * p4 * LANES;
    }
    for (int i = 0; i < 3; i++) {
        const Conv *c = &e->conv[SHARE_BESIDE + i];
        const float step = c->out_step;
        const int zero = c->out_zero;
        conv_pixels(c, k->features4 + (ptrdiff_t)y * w * FINE, w, bytes, LANES);
        for (int x = 0; x < w * LANES; x++)
            share[i][x] = own_exp((float)(bytes[x] - zero) * step);
    }
    const size_t wide = (size_t)k->width;
    float *out = s->disparity + (size_t)(4 * y) * wide, *sigma = s->sigma + (size_t)(4 * y) * wide;
    for (int x = 0; x < w; x++) {
        const float own = pad[1][x], *a = share[0] + (ptrdiff_t)x * LANES, *b = share[1] + (ptrdiff_t)x * LANES;
        const float *c = share[2] + (ptrdiff_t)x * LANES;
        const float left = pad[1][x - 1] - own, right = pad[1][x + 1] - own;
        float beside[16], other[16], corner[16], pixel[16];
        for (int i = 0; i < 16; i++) {
            const float *row = pad[i < 8 ? 0 : 2];
            beside[i] = (i & 3) < 2 ? left : right;
            other[i] = row[x] - own;
            corner[i] = row[(i & 3) < 2 ? x - 1 : x + 1] - own;
        }
        for (int i = 0; i < 16; i++)
            pixel[i] = (a[i] * beside[i] + b[i] * other[i] + c[i] * corner[i]) / (a[i] + b[i] + c[i] + 1.0f) + own;
        for (int r = 0; r < 4; r++)
            memcpy(out + (size_t)r * wide + 4 * x, pixel + 4 * r, 4 * sizeof(float));
    }
    const float *raw = plane4(k->doubt, k, 0, y), *gain = k->factors + (ptrdiff_t)(y / 2) * k->p8;
    const float *floor_px = gain + (ptrdiff_t)k->h8 * k->p8;
    float *size = share[0];
    int bad = 0;
    for (int x = 0; x < w; x++)
        size[x] = raw[x] * gain[x / 2] + floor_px[x / 2];
    for (int r = 0; r < 4; r++)
        for (int x = 0; x < w; x++)
            for (int i = 0; i < 4; i++)
                sigma[(size_t)r * wide + 4 * x + i] = size[x];
    for (size_t i = 0; i < 4 * wide; i++)
        bad |= !(fabsf(out[i]) < 3.0e38f);
    if (bad)
        s->not_finite = 1; /* every writer writes the same */
    memcpy(s->next_disparity + (ptrdiff_t)y * w, pad[1], sizeof(float) * (size_t)w);
}

static void hidden_out(void *context, int c, int worker) {
    Step *s = context;
    const ptrdiff_t cells = (ptrdiff_t)s->space->h8 * s->space->w8;
    (void)worker;
    for (ptrdiff_t i = 0; i < cells; i++)
        s->next_hidden[c * cells + i] = s->space->hidden[i * HIDDEN + c];
}

static void finish(Step *s) {
    pool_run(s->pool, ambiguity_row, s, s->space->h8);
    pool_run(s->pool, surroundings, s, 4);
    pool_run(s->pool, factors_row, s, s->space->h8);
    pool_run(s->pool, enlarge_row, s, s->space->h4);
    pool_run(s->pool, hidden_out, s, HIDDEN);
}
#endif
