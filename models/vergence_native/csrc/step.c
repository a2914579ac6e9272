/* One step, compiled once for each set of instructions: VARIANT names it. */
#include "refine.h"

static Status run(Step *s) {
    const Workspace *k = s->space;
    begin(s);
    warp(s);
    for (int i = 0; i < s->model->iterations; i++) {
        s->now = &s->model->iteration[i];
        if (i) { /* the result of an iteration is the prior of the next one */
            for (int y = 0; y < k->h4; y++)
                memcpy(k->prior + (ptrdiff_t)y * k->w4, k->d4 + (ptrdiff_t)y * k->p4, sizeof(float) * (size_t)k->w4);
            for (int y = 0; y < k->h8; y++)
                prior8_row(k, y);
        }
        search(s);
        refine(s);
    }
    finish(s);
    return s->not_finite ? VN_NOT_FINITE : VN_OK;
}

#define NAME_OF(variant) #variant
#define NAME(variant) NAME_OF(variant)
#define SYMBOL_OF(variant) variant_##variant
#define SYMBOL(variant) SYMBOL_OF(variant)
const Variant SYMBOL(VARIANT) = {NAME(VARIANT), run};
