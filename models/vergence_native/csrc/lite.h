/* The step of `lite`: its weights, its buffers, and what each part of the library offers. */
#ifndef VERGENCE_LITE_H
#define VERGENCE_LITE_H
#include <stddef.h>
#include <stdint.h>

/* The architecture that this code computes. A loader refuses weights of any other. */
enum {
    BINS = 48,        /* coarse disparities, 4 px apart, largest first */
    COARSE_BITS = 48, /* descriptor channels of the wide search */
    FINE_BITS = 16,   /* and of the narrow search */
    HIDDEN = 32,
    COST = 16,    /* channels of the cost filter */
    FINE = 32,    /* channels at 1/4 */
    LOW = 48,     /* channels of the refinement at 1/8 */
    EIGHTH = 48,  /* channels of the context at 1/8 */
    SIXTEENTH = 64,
    CELL_INPUTS = 32, /* inputs of the recurrent cell besides the hidden state */
    SURFACES = 3,
    MEASURES = 12,    /* of the ambiguity of the match, for sigma */
    SIGMA_HIDDEN = 16,
    TAPS = 5,
    CENSUS_TAPS = 36,
    STRIDE = 32,
    MIN_WIDTH = 4 * BINS,
    MAX_SIDE = 1 << 14,
    MAX_ITERATIONS = 16,
    LANES = 16, /* output channels of a block of weights, and floats of a vector */
    MAX_CHANNELS = 64,
    MAX_STEPS = 144, /* of four inputs, in a convolution: 3x3 of 64 channels */
    MAX_THREADS = 64
};

typedef enum {
    VN_OK = 0,
    VN_BAD_ARGUMENT = 1, /* an index, size or pointer */
    VN_BAD_WEIGHTS = 2,  /* a shape, scale or value that this code cannot compute with */
    VN_INCOMPLETE = 3,   /* a step before all weights are set */
    VN_NO_MEMORY = 4,
    VN_NOT_FINITE = 5
} Status;

/* A convolution of bytes. Sums are int32; the input's zero point is in the bias. */
typedef struct {
    int ci, co, kernel, stride; /* its shape, of a table: see weights.c */
    int is_set;
    int in_zero, out_zero;
    float in_step, out_step;
    int8_t *weights; /* [blocks of 16 outputs][tap][ci / 4][16][4] */
    /* The same in groups of up to four steps (tap, 4 inputs), whose products of two bytes each sum up
       within 16 bits: [blocks][steps of the groups][16][4]. Groups of four come first, single steps last. */
    int8_t *grouped;
    uint8_t order[MAX_CHANNELS / LANES][MAX_STEPS];
    uint8_t groups[MAX_CHANNELS / LANES][4]; /* how many of four, three, two steps and of one */
    int32_t bias[MAX_CHANNELS];
    float scale[MAX_CHANNELS]; /* from sums to bytes of the output */
} Conv;

/* The sum of two tensors of bytes: c = round(a * ra + (b * rb + fixed)), with FMA. */
typedef struct {
    int is_set;
    float ra, rb, fixed;
} Sum;

/* Convolutions and sums of the two graphs before the iterations, in the graphs' order. */
enum { FEATURES, PATCH, QUARTER, TO_EIGHTH, IN_EIGHTH, TO_16TH, TO_32ND, IN_32ND, IN_16TH, BACK_8TH,
       LEAVE_8TH, LEAVE_16TH, BEGIN_CONVS };
enum { SUM_16TH, SUM_8TH, BEGIN_SUMS };
/* Of an iteration. */
enum { EXPECTED, C_DOWN, C_LOW, C_MIDDLE, C_LEAVE, GATES, CANDIDATE, HEAD, OUT_8TH, OF_CONTEXT,
       OF_MEASURED, OF_HIDDEN, DOWN, LOW_1, LOW_2, BACK_4TH, CHOOSE, SECOND_X, SECOND_FIT, OUT_4TH,
       ITERATE_CONVS };
enum { SUM_EXPECTED, SUM_CONTEXT, SUM_COST, SUM_FIRST, SUM_HIDDEN, SUM_WIDE, SUM_SECOND,
       ITERATE_SUMS };
enum { SHARE_BESIDE, SHARE_OTHER, SHARE_CORNER, END_CONVS };
/* Sets of floats, by part. */
enum { COARSE_CENSUS_L, COARSE_CENSUS_R, FINE_CENSUS_L, FINE_CENSUS_R, COARSE_SHARPNESS, PAIRS,
       BEGIN_FLOATS };
enum { FINE_SHARPNESS, ITERATE_FLOATS };
enum { SIGMA, SIGMA_ENTER, SIGMA_LEAVE, END_FLOATS };
enum { MAX_FLOATS = 8 };

typedef struct {
    Conv conv[BEGIN_CONVS];
    Sum sum[BEGIN_SUMS];
    int has[BEGIN_FLOATS];
    float coarse[2][COARSE_BITS * CENSUS_TAPS]; /* [bit][tap] of the left and the right image */
    float fine[2][FINE_BITS * CENSUS_TAPS];
    float sharpness[4]; /* of narrow, middle, wide scores; of the claim of another surface */
    float pairs[8]; /* step and zero point of left, right, products; bits' mean, coarse and fine */
} Begin;

typedef struct {
    Conv conv[ITERATE_CONVS];
    Sum sum[ITERATE_SUMS];
    int has[ITERATE_FLOATS];
    float sharpness[3]; /* of cost, of its mean, and of the sub-pixel fit */
    /* Tables of byte functions; filled when the iteration is complete. */
    float sigmoid_gates[256], tanh_candidate[256], sigmoid_keep[256];
    uint8_t context_gates[256], context_candidate[256];
} Iteration;

typedef struct {
    Conv conv[END_CONVS];
    int has[END_FLOATS];
    float sigma[4]; /* factor of doubt, least and largest logarithm, factor of the exponential */
    float enter[SIGMA_HIDDEN * (MEASURES + 1)]; /* weights [output][input], then the biases */
    float leave[2 * (SIGMA_HIDDEN + 1)];
} End;

typedef struct {
    int iterations;
    int is_ready;
    Begin begin;
    End end;
    Iteration *iteration;
} Model;

/* A plane of bytes, channels last, with a border of one pixel. */
typedef struct {
    uint8_t *data; /* pixel (0, 0) */
    int height, width, channels;
    ptrdiff_t row; /* bytes from row to row */
} Image;

typedef struct {
    int height, width; /* of the pair */
    int h4, w4, h8, w8, h16, w16, h32, w32;
    int p8, p4; /* floats of a row at 1/8 and 1/4, a multiple of LANES */
    int workers;
    char *memory;
    size_t size;
    /* Gray images, columns split into even and odd: rows of split2 / split4 floats each. */
    float *gray2[2], *gray4[2];
    int split2, split4;
    uint8_t *fine_left, *fine_right; /* descriptors [h4][w4 or 2 w4][16] */
    float *narrow, *middle, *fixed, *scores; /* [h8][BINS][p8] */
    uint8_t *features; /* [BINS][h16][w16][16] */
    Image patch, context4, in8, of8, low16, relu1, relu2, down8, low8, fit;
    uint8_t *context8, *context16, *second4, *features4, *hidden8;
    float *prior, *landed;                      /* [h4][w4] */
    float *prior8, *seen8;                      /* [h8][p8] */
    float *hidden;                              /* [h8][w8][HIDDEN] */
    float *best, *best_log, *confidence, *top;  /* [h8][p8] */
    float *fills, *d8;                          /* [3][h8][p8], [h8][p8] */
    float *measures, *factors;                  /* [MEASURES][h8][p8], [2][h8][p8] */
    float *plain, *carried, *cost, *wide, *taps, *apart, *d4, *phase, *doubt; /* [planes][h4][p4] */
    char *scratch; /* workers times scratch_size */
    size_t scratch_size;
    float inverse[16], matrix[16];
} Workspace;

typedef struct Pool Pool;
typedef void Task(void *context, int chunk, int worker);

Pool *pool_new(int threads);
void pool_free(Pool *pool);
int pool_threads(const Pool *pool);
/* Take the pool for one step, or fail if another step has it. */
int pool_take(Pool *pool);
void pool_give(Pool *pool);
/* Run all chunks; returns when all are done. Without a pool they run here, in order. */
void pool_run(Pool *pool, Task *task, void *context, int chunks);

typedef struct {
    const Model *model;
    Workspace *space;
    Pool *pool; /* or NULL */
    const uint8_t *left, *right;
    const float *uvd_curr_from_prev; /* 16, or NULL: the state is in this view already */
    const float *prev_disparity, *prev_hidden; /* [h4][w4], [HIDDEN][h8][w8] */
    float *disparity, *sigma, *next_disparity, *next_hidden;
    const Iteration *now; /* the iteration that runs */
    _Atomic int not_finite;
} Step;

typedef struct {
    const char *name;
    Status (*run)(Step *step);
} Variant;

Model *model_new(int iterations);
void model_free(Model *model);
Workspace *workspace_new(int height, int width, int workers);
void workspace_free(Workspace *space);

#if defined(_WIN32)
#define VN_EXPORT __declspec(dllexport)
#else
#define VN_EXPORT __attribute__((visibility("default")))
#endif
#endif
