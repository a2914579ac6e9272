/* The weights of a step: checked, and packed for the kernels. */
#include <stdlib.h>
#include "simd.h"
#include "lite.h"

enum { BEGIN_PART = 0, END_PART = 1, FIRST_ITERATION = 2 };

typedef struct { int co, ci, kernel, stride; } Shape;

static const Shape BEGIN_SHAPES[BEGIN_CONVS] = {
    [FEATURES] = {COST, 4, 2, 2},
    [PATCH] = {FINE, 48, 1, 1},
    [QUARTER] = {FINE, FINE, 3, 1},
    [TO_EIGHTH] = {EIGHTH, FINE, 3, 2},
    [IN_EIGHTH] = {EIGHTH, EIGHTH, 1, 1},
    [TO_16TH] = {SIXTEENTH, EIGHTH, 3, 2},
    [TO_32ND] = {SIXTEENTH, SIXTEENTH, 3, 2},
    [IN_32ND] = {SIXTEENTH, SIXTEENTH, 1, 1},
    [IN_16TH] = {SIXTEENTH, SIXTEENTH, 1, 1},
    [BACK_8TH] = {EIGHTH, SIXTEENTH, 1, 1},
    [LEAVE_8TH] = {16, EIGHTH, 1, 1},
    [LEAVE_16TH] = {COST, SIXTEENTH, 1, 1},
};
static const Shape ITERATE_SHAPES[ITERATE_CONVS] = {
    [EXPECTED] = {COST, 4, 1, 1},
    [C_DOWN] = {COST, COST, 3, 2},
    [C_LOW] = {COST, COST, 3, 1},
    [C_MIDDLE] = {COST, COST, 1, 1},
    [C_LEAVE] = {4, COST, 1, 1},
    [GATES] = {2 * HIDDEN, HIDDEN + CELL_INPUTS, 1, 1},
    [CANDIDATE] = {HIDDEN, HIDDEN + CELL_INPUTS, 1, 1},
    [HEAD] = {HIDDEN, HIDDEN, 1, 1},
    [OUT_8TH] = {6, HIDDEN, 1, 1},
    [OF_CONTEXT] = {FINE, FINE, 1, 1},
    [OF_MEASURED] = {FINE, 4 * SURFACES, 1, 1},
    [OF_HIDDEN] = {FINE, HIDDEN, 1, 1},
    [DOWN] = {LOW, FINE, 3, 2},
    [LOW_1] = {LOW, LOW, 3, 1},
    [LOW_2] = {LOW, LOW, 3, 1},
    [BACK_4TH] = {FINE, LOW, 1, 1},
    [CHOOSE] = {16, FINE, 3, 1}, /* three outputs, and zeros: an exported graph has no fewer than 16 */
    [SECOND_X] = {FINE, FINE, 3, 1},
    [SECOND_FIT] = {FINE, 2 * TAPS + 6, 3, 1},
    [OUT_4TH] = {3, FINE, 1, 1},
};
static const Shape END_SHAPES[END_CONVS] = {
    [SHARE_BESIDE] = {16, FINE, 1, 1},
    [SHARE_OTHER] = {16, FINE, 1, 1},
    [SHARE_CORNER] = {16, FINE, 1, 1},
};

Model *model_new(int iterations) {
    Model *m = iterations < 1 || iterations > MAX_ITERATIONS ? NULL : calloc(1, sizeof(Model));
    if (!m)
        return NULL;
    m->iterations = iterations;
    m->iteration = calloc((size_t)iterations, sizeof(Iteration));
    if (!m->iteration) {
        free(m);
        return NULL;
    }
    return m;
}

static void free_convs(Conv *conv, int count) {
    for (int i = 0; i < count; i++) {
        free(conv[i].weights);
        free(conv[i].grouped);
    }
}

void model_free(Model *m) {
    if (!m)
        return;
    free_convs(m->begin.conv, BEGIN_CONVS);
    free_convs(m->end.conv, END_CONVS);
    for (int i = 0; i < m->iterations; i++)
        free_convs(m->iteration[i].conv, ITERATE_CONVS);
    free(m->iteration);
    free(m);
}

static int is_scale(float v) { return v > 1e-20f && v < 1e20f; }
static int is_byte(int v) { return v >= 0 && v <= 255; }

/* Two weights of one sign sum to at most 128, so that two products with bytes fit into 16 bits. */
static int pairs_are_safe(const int8_t *w, int count) {
    int high[2] = {0, 0}, second[2] = {0, 0};
    for (int i = 0; i < count; i++) {
        int sign = w[i] < 0, size = abs(w[i]);
        if (size > high[sign]) {
            second[sign] = high[sign];
            high[sign] = size;
        } else if (size > second[sign])
            second[sign] = size;
    }
    return high[0] + second[0] <= 128 && high[1] + second[1] <= 128;
}

/* Weights [co][ci][kernel][kernel] to blocks of 16 outputs and 4 inputs. */
static void pack(Conv *c, const int8_t *w) {
    const int taps = c->kernel * c->kernel, blocks = (c->co + LANES - 1) / LANES;
    int8_t *out = c->weights;
    for (int b = 0; b < blocks; b++)
        for (int t = 0; t < taps; t++)
            for (int i = 0; i < c->ci; i += 4)
                for (int o = b * LANES; o < (b + 1) * LANES; o++)
                    for (int j = 0; j < 4; j++)
                        *out++ = o < c->co ? w[((ptrdiff_t)o * c->ci + i + j) * taps + t] : 0;
}

/* The sums of each two neighbouring weights of a step, of one sign: what 16 bits must hold. */
enum { LOADS = 4 * LANES, MOST_LOAD = 128 };
static void loads_of(const int8_t *step, int loads[LOADS]) {
    for (int i = 0; i < 2 * LANES; i++) {
        int a = step[2 * i], b = step[2 * i + 1];
        loads[2 * i] = (a > 0 ? a : 0) + (b > 0 ? b : 0);
        loads[2 * i + 1] = (a < 0 ? -a : 0) + (b < 0 ? -b : 0);
    }
}

static int largest(const int loads[LOADS]) {
    int most = 0;
    for (int i = 0; i < LOADS; i++)
        most = loads[i] > most ? loads[i] : most;
    return most;
}

/* Each step goes to the fullest group that has room for it, the largest first. */
static void group_block(Conv *c, int block, int steps, int8_t *out) {
    enum { SIZE = 4 * LANES };
    const int8_t *in = c->weights + (ptrdiff_t)block * steps * SIZE;
    static const int empty[LOADS];
    int held[MAX_STEPS][LOADS], members[MAX_STEPS][4], count[MAX_STEPS], size[MAX_STEPS], done[MAX_STEPS] = {0};
    int groups = 0;
    for (int n = 0; n < steps; n++) {
        int next = -1, loads[LOADS];
        for (int i = 0; i < steps; i++) {
            if (n == 0) {
                loads_of(in + (ptrdiff_t)i * SIZE, loads);
                size[i] = largest(loads);
            }
            if (!done[i] && (next < 0 || size[i] > size[next]))
                next = i;
        }
        done[next] = 1;
        loads_of(in + (ptrdiff_t)next * SIZE, loads);
        int best = -1, fullest = -1;
        for (int g = 0; g < groups; g++) {
            int sum[LOADS];
            for (int i = 0; i < LOADS; i++)
                sum[i] = held[g][i] + loads[i];
            int most = count[g] < 4 ? largest(sum) : MOST_LOAD + 1;
            if (most <= MOST_LOAD && most > fullest) {
                best = g;
                fullest = most;
            }
        }
        if (best < 0) {
            best = groups++;
            count[best] = 0;
            memcpy(held[best], empty, sizeof empty);
        }
        for (int i = 0; i < LOADS; i++)
            held[best][i] += loads[i];
        members[best][count[best]++] = next;
    }
    int at = 0;
    for (int wanted = 4; wanted > 0; wanted--)
        for (int g = 0; g < groups; g++) {
            if (count[g] != wanted)
                continue;
            c->groups[block][4 - wanted]++;
            for (int i = 0; i < wanted; i++, at++) {
                c->order[block][at] = (uint8_t)members[g][i];
                memcpy(out + (ptrdiff_t)at * SIZE, in + (ptrdiff_t)members[g][i] * SIZE, SIZE);
            }
        }
}

static Conv *conv_of(Model *m, int part, int index, Shape *shape) {
    if (part == BEGIN_PART && index >= 0 && index < BEGIN_CONVS)
        return *shape = BEGIN_SHAPES[index], &m->begin.conv[index];
    if (part == END_PART && index >= 0 && index < END_CONVS)
        return *shape = END_SHAPES[index], &m->end.conv[index];
    if (part >= FIRST_ITERATION && part < FIRST_ITERATION + m->iterations && index >= 0 && index < ITERATE_CONVS)
        return *shape = ITERATE_SHAPES[index], &m->iteration[part - FIRST_ITERATION].conv[index];
    return NULL;
}

VN_EXPORT int vn_model_conv(Model *m, int part, int index, const int32_t *dims, const int8_t *weights,
                            const float *steps, const int32_t *bias, float in_step, int in_zero, float out_step,
                            int out_zero) {
    Shape shape = {0, 0, 0, 0};
    Conv *c = m ? conv_of(m, part, index, &shape) : NULL;
    if (!c || !dims || !weights || !steps || !bias || c->is_set || m->is_ready)
        return VN_BAD_ARGUMENT;
    if (dims[0] != shape.co || dims[1] != shape.ci || dims[2] != shape.kernel || dims[3] != shape.kernel ||
        dims[4] != shape.stride || dims[5] != shape.stride)
        return VN_BAD_WEIGHTS;
    if (!is_scale(in_step) || !is_scale(out_step) || !is_byte(in_zero) || !is_byte(out_zero))
        return VN_BAD_WEIGHTS;
    const int count = shape.ci * shape.kernel * shape.kernel;
    for (int o = 0; o < shape.co; o++) {
        float scale = in_step * steps[o] / out_step;
        if (!is_scale(steps[o]) || !is_scale(scale) || !pairs_are_safe(weights + (ptrdiff_t)o * count, count) ||
            bias[o] > 1 << 30 || bias[o] < -(1 << 30))
            return VN_BAD_WEIGHTS;
    }
    c->co = shape.co;
    c->ci = shape.ci;
    c->kernel = shape.kernel;
    c->stride = shape.stride;
    c->in_step = in_step;
    c->out_step = out_step;
    c->in_zero = in_zero;
    c->out_zero = out_zero;
    const int blocks = (shape.co + LANES - 1) / LANES;
    c->weights = malloc((size_t)count * LANES * (size_t)blocks);
    c->grouped = malloc((size_t)count * LANES * (size_t)blocks);
    if (!c->weights || !c->grouped)
        return VN_NO_MEMORY;
    pack(c, weights);
    for (int b = 0; b < blocks; b++)
        group_block(c, b, count / 4, c->grouped + (ptrdiff_t)b * count * LANES);
    for (int o = 0; o < shape.co; o++) {
        int32_t sum = 0;
        for (int i = 0; i < count; i++)
            sum += weights[(ptrdiff_t)o * count + i];
        c->bias[o] = bias[o] - in_zero * sum;
        c->scale[o] = in_step * steps[o] / out_step;
    }
    if (part == BEGIN_PART && index == PATCH)
        c->ci = 12; /* four rows of an image, 4 pixels of 3 colours each */
    c->is_set = 1;
    return VN_OK;
}

VN_EXPORT int vn_model_sum(Model *m, int part, int index, float a_step, int a_zero, float b_step, int b_zero,
                           float out_step, int out_zero) {
    Sum *s = NULL;
    if (!m || m->is_ready || index < 0)
        return VN_BAD_ARGUMENT;
    if (part == BEGIN_PART && index < BEGIN_SUMS)
        s = &m->begin.sum[index];
    if (part >= FIRST_ITERATION && part < FIRST_ITERATION + m->iterations && index < ITERATE_SUMS)
        s = &m->iteration[part - FIRST_ITERATION].sum[index];
    if (!s)
        return VN_BAD_ARGUMENT;
    float ra = a_step / out_step, rb = b_step / out_step;
    if (!is_scale(a_step) || !is_scale(b_step) || !is_scale(out_step) || !is_scale(ra) || !is_scale(rb) ||
        !is_byte(a_zero) || !is_byte(b_zero) || !is_byte(out_zero))
        return VN_BAD_WEIGHTS;
    s->ra = ra;
    s->rb = rb;
    s->fixed = (float)out_zero - fmaf(ra, (float)a_zero, rb * (float)b_zero);
    s->is_set = 1;
    return VN_OK;
}

VN_EXPORT int vn_model_floats(Model *m, int part, int index, const float *values, int count) {
    float *out = NULL;
    int wanted = 0, *has = NULL;
    if (!m || m->is_ready || !values || index < 0)
        return VN_BAD_ARGUMENT;
    if (part == BEGIN_PART && index < BEGIN_FLOATS) {
        Begin *b = &m->begin;
        float *all[BEGIN_FLOATS] = {b->coarse[0], b->coarse[1], b->fine[0], b->fine[1], b->sharpness, b->pairs};
        const int counts[BEGIN_FLOATS] = {COARSE_BITS * CENSUS_TAPS, COARSE_BITS * CENSUS_TAPS, FINE_BITS * CENSUS_TAPS,
                                          FINE_BITS * CENSUS_TAPS, 4, 8};
        out = all[index];
        wanted = counts[index];
        has = &b->has[index];
    } else if (part == END_PART && index < END_FLOATS) {
        End *e = &m->end;
        float *all[END_FLOATS] = {e->sigma, e->enter, e->leave};
        const int counts[END_FLOATS] = {4, SIGMA_HIDDEN * (MEASURES + 1), 2 * (SIGMA_HIDDEN + 1)};
        out = all[index];
        wanted = counts[index];
        has = &m->end.has[index];
    } else if (part >= FIRST_ITERATION && part < FIRST_ITERATION + m->iterations && index < ITERATE_FLOATS) {
        Iteration *n = &m->iteration[part - FIRST_ITERATION];
        out = n->sharpness;
        wanted = 3;
        has = &n->has[index];
    }
    if (!out)
        return VN_BAD_ARGUMENT;
    if (count != wanted)
        return VN_BAD_WEIGHTS;
    for (int i = 0; i < count; i++)
        if (!(fabsf(values[i]) < 1e6f))
            return VN_BAD_WEIGHTS;
    if (part == BEGIN_PART && index == PAIRS)
        for (int i = 0; i < 6; i++) {
            int zero = i & 1 ? (int)values[i] : 0;
            if (i & 1 ? !is_byte(zero) || (float)zero != values[i] : !is_scale(values[i]))
                return VN_BAD_WEIGHTS;
        }
    memcpy(out, values, sizeof(float) * (size_t)count);
    *has = 1;
    return VN_OK;
}

static float polynomial(float x, const float *c, int count) {
    float p = c[0];
    for (int i = 1; i < count; i++)
        p = fmaf(p, x, c[i]);
    return p;
}

/* Rationals of MLAS: the sigmoid and the hyperbolic tangent. */
static float own_sigmoid(float x) {
    static const float above[] = {4.37031012579801e-11f, 1.15627324459942e-07f, 6.08574864600143e-05f,
                                  8.51377133304701e-03f, 2.48287947061529e-01f};
    static const float below[] = {6.10247389755681e-13f, 5.76102136993427e-09f, 6.29106785017040e-06f,
                                  1.70198817374094e-03f, 1.16817656904453e-01f, 9.93151921023180e-01f};
    x = clamped(x, -18.0f, 18.0f);
    return clamped(polynomial(x * x, above, 5) * x / polynomial(x * x, below, 6) + 0.5f, 0.0f, 1.0f);
}

static float own_tanh(float x) {
    static const float above[] = {-2.76076847742355e-16f, 2.00018790482477e-13f, -8.60467152213735e-11f,
                                  5.12229709037114e-08f, 1.48572235717979e-05f, 6.37261928875436e-04f,
                                  4.89352455891786e-03f};
    static const float below[] = {1.19825839466702e-06f, 1.18534705686654e-04f, 2.26843463243900e-03f,
                                  4.89352518554385e-03f};
    x = clamped(x, -9.0f, 9.0f);
    return polynomial(x * x, above, 7) * x / polynomial(x * x, below, 4);
}

static void fill_tables(Iteration *n, const Begin *b) {
    const Conv *gates = &n->conv[GATES], *candidate = &n->conv[CANDIDATE], *last = &n->conv[OUT_4TH];
    const Conv *context = &b->conv[LEAVE_8TH];
    for (int i = 0; i < 256; i++) {
        float of_context = (float)(i - context->out_zero) * context->out_step;
        n->sigmoid_gates[i] = own_sigmoid((float)(i - gates->out_zero) * gates->out_step);
        n->tanh_candidate[i] = own_tanh((float)(i - candidate->out_zero) * candidate->out_step);
        n->sigmoid_keep[i] = own_sigmoid((float)(i - last->out_zero) * last->out_step * 4.0f);
        n->context_gates[i] = to_byte(of_context, gates->in_step, gates->in_zero);
        n->context_candidate[i] = to_byte(of_context, candidate->in_step, candidate->in_zero);
    }
}

VN_EXPORT int vn_model_finish(Model *m) {
    if (!m)
        return VN_BAD_ARGUMENT;
    int complete = 1;
    for (int i = 0; i < BEGIN_CONVS; i++)
        complete &= m->begin.conv[i].is_set;
    for (int i = 0; i < BEGIN_SUMS; i++)
        complete &= m->begin.sum[i].is_set;
    for (int i = 0; i < BEGIN_FLOATS; i++)
        complete &= m->begin.has[i];
    for (int i = 0; i < END_CONVS; i++)
        complete &= m->end.conv[i].is_set;
    for (int i = 0; i < END_FLOATS; i++)
        complete &= m->end.has[i];
    for (int n = 0; n < m->iterations; n++) {
        for (int i = 0; i < ITERATE_CONVS; i++)
            complete &= m->iteration[n].conv[i].is_set;
        for (int i = 0; i < ITERATE_SUMS; i++)
            complete &= m->iteration[n].sum[i].is_set;
        complete &= m->iteration[n].has[FINE_SHARPNESS];
    }
    if (!complete)
        return VN_INCOMPLETE;
    for (int n = 0; n < m->iterations; n++)
        fill_tables(&m->iteration[n], &m->begin);
    m->is_ready = 1;
    return VN_OK;
}

VN_EXPORT Model *vn_model_new(int iterations) { return model_new(iterations); }
VN_EXPORT void vn_model_free(Model *m) { model_free(m); }
