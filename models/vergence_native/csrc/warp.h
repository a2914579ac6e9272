/* The previous frame's state in the view of this frame. */
#ifndef VERGENCE_WARP_H
#define VERGENCE_WARP_H
#include "begin.h"

#define MIN_DISPARITY_PX 0.05f

static void product_4x4(const double a[16], const double b[16], double out[16]) {
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++) {
            double sum = 0;
            for (int n = 0; n < 4; n++)
                sum += a[4 * i + n] * b[4 * n + j];
            out[4 * i + j] = sum;
        }
}

static double trace_4x4(const double m[16]) { return m[0] + m[5] + m[10] + m[15]; }

/* Faddeev-LeVerrier, as the network has it: m1 = A - t1 I, m2 = A m1 - t2 I, ... */
static void inverse_4x4(const float matrix[16], float out[16]) {
    double a[16], m[16], product[16];
    for (int i = 0; i < 16; i++)
        m[i] = a[i] = matrix[i];
    for (int n = 1; n < 4; n++) {
        double t = trace_4x4(m) / n;
        for (int i = 0; i < 16; i += 5)
            m[i] -= t;
        product_4x4(a, m, product);
        if (n < 3)
            memcpy(m, product, sizeof m);
    }
    double t = trace_4x4(product) / 4;
    for (int i = 0; i < 16; i++)
        out[i] = (float)(m[i] / t);
}

/* Points (u, v, d) times the matrix; points behind the camera give 0. */
static inline void moved(const float *m, float u, float v, float d, float *to_u, float *to_v, float *to_d) {
    float x = fmaf(m[2], d, fmaf(m[1], v, m[0] * u)) + m[3];
    float y = fmaf(m[6], d, fmaf(m[5], v, m[4] * u)) + m[7];
    float z = fmaf(m[10], d, fmaf(m[9], v, m[8] * u)) + m[11];
    float w = fmaf(m[14], d, fmaf(m[13], v, m[12] * u)) + m[15];
    float scale = (w > 1e-3f ? 1.0f : 0.0f) / most(w, 1e-3f);
    *to_u = x * scale;
    *to_v = y * scale;
    *to_d = z * scale;
}

/* Where each surface is seen now: the nearest one wins, and cracks of one cell are closed. */
static void splat(Step *s, int worker) {
    const Workspace *k = s->space;
    const int h = k->h4, w = k->w4;
    float *to_u = (float *)scratch(s, worker), *to_v = to_u + w, *to_d = to_v + w;
    float *first = k->prior; /* free until prior_row */
    memset(first, 0, sizeof(float) * (size_t)h * (size_t)w);
    for (int y = 0; y < h; y++) {
        const float *d = s->prev_disparity + (ptrdiff_t)y * w;
        for (int x = 0; x < w; x++)
            moved(k->matrix, (float)x * 4.0f + 1.5f, (float)y * 4.0f + 1.5f, d[x], to_u + x, to_v + x, to_d + x);
        for (int x = 0; x < w; x++) {
            to_d[x] *= d[x] > MIN_DISPARITY_PX ? 1.0f : 0.0f;
            to_u[x] = clamped(floorf((to_u[x] + 0.5f) / 4.0f), -1.0f, (float)w);
            to_v[x] = clamped(floorf((to_v[x] + 0.5f) / 4.0f), -1.0f, (float)h);
        }
        for (int x = 0; x < w; x++) {
            int column = (int)to_u[x], row = (int)to_v[x];
            if (!(to_d[x] > MIN_DISPARITY_PX) || column < 0 || column >= w || row < 0 || row >= h)
                continue;
            float *cell = first + (ptrdiff_t)row * w + column;
            *cell = most(*cell, to_d[x]);
        }
    }
    for (int y = 0; y < h; y++)
        for (int x = 0; x < w; x++) {
            float own = first[(ptrdiff_t)y * w + x];
            if (!(own > 0)) {
                float sum = 0, filled = 0;
                for (int i = x > 0 ? x - 1 : 0; i <= (x < w - 1 ? x + 1 : x); i++) {
                    float column = 0;
                    for (int j = y > 0 ? y - 1 : 0; j <= (y < h - 1 ? y + 1 : y); j++) {
                        column += first[(ptrdiff_t)j * w + i];
                        filled += first[(ptrdiff_t)j * w + i] > 0 ? 1.0f : 0.0f;
                    }
                    sum += column;
                }
                own = filled / 9.0f > 0.5f ? (sum / 9.0f) / (filled / 9.0f) : own;
            }
            k->landed[(ptrdiff_t)y * w + x] = own;
        }
}

/* The prior of a row at 1/4: each cell looks back to where its surface was. */
static inline void prior_row(const Step *s, int y, int worker) {
    const Workspace *k = s->space;
    const int h = k->h4, w = k->w4;
    float *u = (float *)scratch(s, worker), *v = u + w, *d = v + w, *between = d + w;
    const float *landed = k->landed + (ptrdiff_t)y * w;
    for (int x = 0; x < w; x++)
        moved(k->inverse, (float)x * 4.0f + 1.5f, (float)y * 4.0f + 1.5f, landed[x], u + x, v + x, d + x);
    for (int x = 0; x < w; x++) {
        float column = clamped((u[x] + 0.5f) / 4.0f - 0.5f, 0.0f, (float)(w - 1));
        float row = clamped((v[x] + 0.5f) / 4.0f - 0.5f, 0.0f, (float)(h - 1));
        int x0 = (int)column, y0 = (int)row, x1 = x0 < w - 1 ? x0 + 1 : x0, y1 = y0 < h - 1 ? y0 + 1 : y0;
        float fx = column - (float)x0, fy = row - (float)y0;
        const float *a = s->prev_disparity + (ptrdiff_t)y0 * w, *b = s->prev_disparity + (ptrdiff_t)y1 * w;
        between[x] = a[x0] * ((1.0f - fx) * (1.0f - fy)) + a[x1] * (fx * (1.0f - fy)) +
                     b[x0] * ((1.0f - fx) * fy) + b[x1] * (fx * fy);
    }
    float *prior = k->prior + (ptrdiff_t)y * w;
    for (int x = 0; x < w; x++) {
        float to_u, to_v, refined;
        moved(k->matrix, u[x], v[x], between[x], &to_u, &to_v, &refined);
        float smooth = fabsf(between[x] - d[x]) < 1.0f ? 1.0f : 0.0f;
        float seen = landed[x] > MIN_DISPARITY_PX ? 1.0f : 0.0f;
        prior[x] = (landed[x] + smooth * (refined - landed[x])) * seen;
    }
}

/* A row of the hidden state: each cell takes that of the cell where its surface was. */
static inline void hidden_row(const Step *s, int y, int worker) {
    const Workspace *k = s->space;
    const int w = k->w8;
    const ptrdiff_t plane = (ptrdiff_t)k->h8 * w;
    int32_t *from = (int32_t *)scratch(s, worker);
    float *seen = (float *)(from + w);
    for (int x = 0; x < w; x++) {
        if (!s->uvd_curr_from_prev) {
            from[x] = y * w + x;
            seen[x] = 1.0f;
            continue;
        }
        const float *a = k->landed + (ptrdiff_t)(2 * y) * k->w4 + 2 * x, *b = a + k->w4;
        float low = most(most(a[0], a[1]), most(b[0], b[1])), u, v, d;
        moved(k->inverse, (float)x * 8.0f + 3.5f, (float)y * 8.0f + 3.5f, low, &u, &v, &d);
        u = clamped(floorf((u + 0.5f) / 8.0f - 0.5f + 0.5f), 0.0f, (float)(w - 1));
        v = clamped(floorf((v + 0.5f) / 8.0f - 0.5f + 0.5f), 0.0f, (float)(k->h8 - 1));
        from[x] = (int32_t)v * w + (int32_t)u;
        seen[x] = low > MIN_DISPARITY_PX ? 1.0f : 0.0f;
    }
    float *out = k->hidden + (ptrdiff_t)y * w * HIDDEN;
    for (int c = 0; c < HIDDEN; c++)
        for (int x = 0; x < w; x++)
            out[(ptrdiff_t)x * HIDDEN + c] = s->prev_hidden[c * plane + from[x]] * seen[x];
}

/* The means of known cells of two rows of the prior, and the share of known cells. */
static inline void prior8_row(const Workspace *k, int y) {
    const float *a = k->prior + (ptrdiff_t)2 * y * k->w4, *b = a + k->w4;
    float *prior8 = k->prior8 + (ptrdiff_t)y * k->p8, *seen8 = k->seen8 + (ptrdiff_t)y * k->p8;
    for (int x = 0; x < k->w8; x++) {
        float sum = (a[2 * x] + b[2 * x]) + (a[2 * x + 1] + b[2 * x + 1]), seen = 0;
        seen += a[2 * x] > 0 ? 1.0f : 0.0f;
        seen += a[2 * x + 1] > 0 ? 1.0f : 0.0f;
        seen += b[2 * x] > 0 ? 1.0f : 0.0f;
        seen += b[2 * x + 1] > 0 ? 1.0f : 0.0f;
        seen8[x] = seen * 0.25f;
        prior8[x] = (sum * 0.25f) / most(seen8[x], 0.1f);
    }
}

static void warp_row(void *context, int y, int worker) {
    Step *s = context;
    if (s->uvd_curr_from_prev) {
        prior_row(s, 2 * y, worker);
        prior_row(s, 2 * y + 1, worker);
    }
    hidden_row(s, y, worker);
    prior8_row(s->space, y);
}

static void warp(Step *s) {
    Workspace *k = s->space;
    if (s->uvd_curr_from_prev) {
        memcpy(k->matrix, s->uvd_curr_from_prev, sizeof k->matrix);
        inverse_4x4(k->matrix, k->inverse);
        splat(s, 0);
    } else
        memcpy(k->prior, s->prev_disparity, sizeof(float) * (size_t)k->h4 * (size_t)k->w4);
    pool_run(s->pool, warp_row, s, k->h8);
}
#endif
