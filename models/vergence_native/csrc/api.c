/* What Python calls: the variants of this CPU, threads, and steps. */
#include <stdlib.h>
#include "lite.h"

extern const Variant variant_scalar;
#if defined(__x86_64__) || defined(_M_X64)
#define X86 1
#include <cpuid.h>
extern const Variant variant_avx2, variant_avx2_vnni, variant_avx512_vnni;
#elif defined(__aarch64__) && defined(VN_NEON)
extern const Variant variant_neon_dot;
#endif

#ifdef X86
static uint64_t enabled_state(void) {
    uint32_t low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    return (uint64_t)high << 32 | low;
}

/* What both the CPU and the operating system offer, best first. */
static int find(const Variant **found) {
    uint32_t a, b, c, d, b7, c7, a71 = 0, unused;
    int count = 0;
    if (__get_cpuid(1, &a, &b, &c, &d) && (c & bit_OSXSAVE) && (c & bit_FMA) && (c & bit_AVX)) {
        uint64_t state = enabled_state();
        if ((state & 6) == 6 && __get_cpuid_count(7, 0, &a, &b7, &c7, &d) && (b7 & bit_AVX2)) {
            if (a >= 1)
                __get_cpuid_count(7, 1, &a71, &unused, &unused, &unused);
            const uint32_t wide = bit_AVX512F | bit_AVX512DQ | bit_AVX512BW | bit_AVX512VL;
            if ((state & 0xE6) == 0xE6 && (b7 & wide) == wide && (c7 & bit_AVX512VNNI))
                found[count++] = &variant_avx512_vnni;
            if (a71 & bit_AVXVNNI)
                found[count++] = &variant_avx2_vnni;
            found[count++] = &variant_avx2;
        }
    }
    found[count++] = &variant_scalar;
    return count;
}
#else
static int find(const Variant **found) {
    int count = 0;
#if defined(__aarch64__) && defined(VN_NEON)
    found[count++] = &variant_neon_dot;
#endif
    found[count++] = &variant_scalar;
    return count;
}
#endif

/* The name of a variant that this CPU runs, best first; NULL after the last. */
VN_EXPORT const char *vn_variant(int index) {
    const Variant *found[8];
    int count = find(found);
    return index >= 0 && index < count ? found[index]->name : NULL;
}

VN_EXPORT Pool *vn_pool_new(int threads) { return threads < 1 ? NULL : pool_new(threads); }
VN_EXPORT void vn_pool_free(Pool *pool) { pool_free(pool); }
VN_EXPORT int vn_pool_threads(const Pool *pool) { return pool ? pool_threads(pool) : 1; }

/* A step. Without `uvd_curr_from_prev` the state is in the view of this frame already. */
VN_EXPORT int vn_step(int variant, const Model *model, Workspace *space, Pool *pool, const uint8_t *left,
                      const uint8_t *right, const float *uvd_curr_from_prev, const float *prev_disparity,
                      const float *prev_hidden, float *disparity, float *sigma, float *next_disparity,
                      float *next_hidden) {
    const Variant *found[8];
    int count = find(found);
    if (variant < 0 || variant >= count || !model || !space || !left || !right || !prev_disparity || !prev_hidden ||
        !disparity || !sigma || !next_disparity || !next_hidden)
        return VN_BAD_ARGUMENT;
    if (!model->is_ready)
        return VN_INCOMPLETE;
    /* Steps that run at once share no threads: the first has the pool, others their own thread. */
    int has_pool = pool && space->workers >= pool_threads(pool) && pool_take(pool);
    Step step = {.model = model,
                 .space = space,
                 .pool = has_pool ? pool : NULL,
                 .left = left,
                 .right = right,
                 .uvd_curr_from_prev = uvd_curr_from_prev,
                 .prev_disparity = prev_disparity,
                 .prev_hidden = prev_hidden,
                 .disparity = disparity,
                 .sigma = sigma,
                 .next_disparity = next_disparity,
                 .next_hidden = next_hidden};
    Status status = found[variant]->run(&step);
    if (has_pool)
        pool_give(pool);
    return status;
}
