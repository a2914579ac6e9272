/* The buffers of a step. One workspace serves one step at a time. */
#include <stdlib.h>
#include <string.h>
#include "lite.h"

enum { ALIGNMENT = 64, SLACK = 256 }; /* bytes; vectors may read and write past a row's end */

typedef struct {
    char *memory; /* NULL: only count */
    size_t used;
} Layout;

static void *take(Layout *layout, size_t size) {
    size_t at = layout->used;
    layout->used += (size + SLACK + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
    return layout->memory ? layout->memory + at : NULL;
}

static float *floats(Layout *layout, size_t count) { return take(layout, count * sizeof(float)); }

static Image image(Layout *layout, int height, int width, int channels) {
    Image result = {NULL, height, width, channels, (ptrdiff_t)(width + 2) * channels};
    uint8_t *all = take(layout, (size_t)(height + 2) * (size_t)result.row);
    if (all)
        result.data = all + result.row + channels;
    return result;
}

static size_t larger(size_t a, size_t b) { return a > b ? a : b; }

/* What the tasks of a step use at most, in bytes: each names the function that needs it. */
static size_t scratch_size(const Workspace *k) {
    const size_t p8 = (size_t)k->p8, p4 = (size_t)k->p4, h8 = (size_t)k->h8, w16 = (size_t)k->w16;
    const size_t plane = h8 * p8, f = sizeof(float);
    size_t most = (size_t)k->width * 8;                                                     /* gray_rows */
    most = larger(most, COARSE_BITS * f * (3 * p8 + 64));                                   /* coarse_row */
    most = larger(most, f * (2 * plane + p8 + 64));                                         /* box_scores */
    most = larger(most, f * (3 * p8 + 2 * BINS) + 4 * p8 + (size_t)BINS * 8 * p8);          /* cost_features */
    most = larger(most, 8 * p8 * EIGHTH);                                                   /* fifth_stage */
    most = larger(most, (size_t)COST * ((size_t)(k->h16 + 2) * (w16 + 2) + (size_t)(k->h32 + 2) * (size_t)(k->w32 + 2))
                            + 4 * w16 + 3 * COST * w16 + 64 + f * p8);                      /* filter_bin */
    most = larger(most, f * (6 * plane + p8 + 64));                                         /* smooth_fill, extreme */
    most = larger(most, f * (9 * p8 + 64 + plane));                                         /* ambiguity_row, surroundings */
    most = larger(most, p8 * f * (SIGMA_HIDDEN + 2));                                       /* factors_row */
    most = larger(most, p8 * (f * 40 + 64 * 2 + 1 + HIDDEN));                               /* update_row */
    most = larger(most, p4 * (f * 20 + 12 + 3 * FINE + LANES) + 4096);                      /* rows at 1/4 */
    most = larger(most, p4 * (LANES + f * (3 + 3 * LANES)) + 6 * LANES * f);                /* enlarge_row */
    return (most + 2 * SLACK + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
}

static size_t arrange(Workspace *k, char *memory) {
    Layout layout = {memory, 0}, *l = &layout;
    const size_t cells4 = (size_t)k->h4 * (size_t)k->w4, plane4 = (size_t)k->h4 * (size_t)k->p4;
    const size_t plane8 = (size_t)k->h8 * (size_t)k->p8, cells8 = (size_t)k->h8 * (size_t)k->w8;
    const size_t cells16 = (size_t)k->h16 * (size_t)k->w16;
    for (int i = 0; i < 2; i++) {
        k->gray2[i] = floats(l, (size_t)k->h4 * 4 * (size_t)k->split2);
        k->gray4[i] = floats(l, (size_t)k->h4 * 2 * (size_t)k->split4);
    }
    k->fine_left = take(l, cells4 * FINE_BITS);
    k->fine_right = take(l, cells4 * 2 * FINE_BITS);
    k->narrow = floats(l, plane8 * BINS);
    k->middle = floats(l, plane8 * BINS);
    k->fixed = floats(l, plane8 * BINS);
    k->scores = floats(l, plane8 * BINS);
    k->features = take(l, cells16 * BINS * COST);
    k->patch = image(l, k->h4, k->w4, FINE);
    k->context4 = image(l, k->h4, k->w4, FINE);
    k->in8 = image(l, k->h8, k->w8, EIGHTH);
    k->of8 = image(l, k->h8, k->w8, FINE);
    k->low16 = image(l, k->h16, k->w16, SIXTEENTH);
    k->relu1 = image(l, k->h4, k->w4, FINE);
    k->relu2 = image(l, k->h4, k->w4, FINE);
    k->down8 = image(l, k->h8, k->w8, LOW);
    k->low8 = image(l, k->h8, k->w8, LOW);
    k->fit = image(l, k->h4, k->w4, 2 * TAPS + 6);
    k->context8 = take(l, cells8 * 16);
    k->context16 = take(l, cells16 * COST);
    k->second4 = take(l, cells4 * FINE);
    k->features4 = take(l, cells4 * FINE);
    k->hidden8 = take(l, cells8 * HIDDEN);
    k->prior = floats(l, cells4);
    k->landed = floats(l, cells4);
    k->prior8 = floats(l, plane8);
    k->seen8 = floats(l, plane8);
    k->hidden = floats(l, cells8 * HIDDEN);
    k->best = floats(l, plane8);
    k->best_log = floats(l, plane8);
    k->confidence = floats(l, plane8);
    k->top = floats(l, plane8);
    k->fills = floats(l, 3 * plane8);
    k->d8 = floats(l, plane8);
    k->measures = floats(l, MEASURES * plane8);
    k->factors = floats(l, 2 * plane8);
    k->plain = floats(l, plane4);
    k->carried = floats(l, plane4);
    k->cost = floats(l, SURFACES * plane4);
    k->wide = floats(l, SURFACES * plane4);
    k->taps = floats(l, TAPS * plane4);
    k->apart = floats(l, 2 * plane4);
    k->d4 = floats(l, plane4);
    k->phase = floats(l, plane4);
    k->doubt = floats(l, plane4);
    k->scratch_size = scratch_size(k);
    k->scratch = take(l, k->scratch_size * (size_t)k->workers);
    return layout.used;
}

static int padded(int count) { return (count + LANES - 1) / LANES * LANES; }

Workspace *workspace_new(int height, int width, int workers) {
    if (height < STRIDE || width < MIN_WIDTH || height > MAX_SIDE || width > MAX_SIDE || height % STRIDE ||
        width % STRIDE || workers < 1 || workers > MAX_THREADS)
        return NULL;
    Workspace *k = calloc(1, sizeof(Workspace));
    if (!k)
        return NULL;
    k->height = height;
    k->width = width;
    k->workers = workers;
    k->h4 = height / 4, k->w4 = width / 4;
    k->h8 = height / 8, k->w8 = width / 8;
    k->h16 = height / 16, k->w16 = width / 16;
    k->h32 = height / 32, k->w32 = width / 32;
    k->p8 = padded(k->w8);
    k->p4 = padded(k->w4);
    k->split2 = k->p4 + LANES;
    k->split4 = k->p8 + LANES;
    k->size = arrange(k, NULL) + ALIGNMENT;
    k->memory = calloc(1, k->size);
    if (!k->memory) {
        free(k);
        return NULL;
    }
    arrange(k, (char *)(((uintptr_t)k->memory + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT));
    return k;
}

void workspace_free(Workspace *k) {
    if (!k)
        return;
    free(k->memory);
    free(k);
}

VN_EXPORT Workspace *vn_workspace_new(int height, int width, int workers) { return workspace_new(height, width, workers); }
VN_EXPORT void vn_workspace_free(Workspace *space) { workspace_free(space); }
VN_EXPORT size_t vn_workspace_bytes(const Workspace *space) { return space ? space->size : 0; }
