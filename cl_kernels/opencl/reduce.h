/* Deterministic sums and maxima. Every group writes one partial value per quantity; a later kernel adds the partial
   values of all groups in their order. Include after blocks.h and real.h.

   All functions contain barriers. A kernel must not return before a barrier, not even with all work-items: PoCL
   miscompiles this for groups of more than one item. Use a loop without iterations instead. */

/* Running sum of one work-item, which on a CPU adds up many thousands of terms; compensated (Kahan) in float32. */
typedef struct {
    REAL value;
#if !IS_DOUBLE
    REAL lost;
#endif
} Sum;

#if IS_DOUBLE
#define SUM_ZERO                                                                                                       \
    {                                                                                                                  \
        R(0)                                                                                                           \
    }
#else
#define SUM_ZERO                                                                                                       \
    {                                                                                                                  \
        R(0), R(0)                                                                                                     \
    }
#endif

inline void sum_add(Sum *s, REAL x)
{
#if IS_DOUBLE
    s->value += x;
#else
    const REAL y = x - s->lost;
    const REAL t = s->value + y;
    s->lost = (t - s->value) - y;
    s->value = t;
#endif
}

/* Sum (maximum) over the work-items of a group, returned to each; `scratch` has GROUP_SIZE entries. */
inline REAL group_sum(REAL x, local REAL *scratch)
{
#if GROUP_SIZE > 1
    const int me = get_local_id(0);
    barrier(CLK_LOCAL_MEM_FENCE);
    scratch[me] = x;
    for (int half_ = GROUP_SIZE / 2; half_ > 0; half_ /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (me < half_)
            scratch[me] += scratch[me + half_];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    x = scratch[0];
#endif
    return x;
}

inline REAL group_max(REAL x, local REAL *scratch)
{
#if GROUP_SIZE > 1
    const int me = get_local_id(0);
    barrier(CLK_LOCAL_MEM_FENCE);
    scratch[me] = x;
    for (int half_ = GROUP_SIZE / 2; half_ > 0; half_ /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (me < half_)
            scratch[me] = fmax(scratch[me], scratch[me + half_]);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    x = scratch[0];
#endif
    return x;
}

/* Sum (maximum) of the partial values of a block-wise kernel, one per group. */
inline REAL total_sum(global const REAL *partial, local REAL *scratch)
{
    REAL x = 0;
    for (int g = get_local_id(0); g < (int)get_num_groups(0); g += GROUP_SIZE)
        x += partial[g];
    return group_sum(x, scratch);
}

inline REAL total_max(global const REAL *partial, local REAL *scratch)
{
    REAL x = partial[0];
    for (int g = get_local_id(0); g < (int)get_num_groups(0); g += GROUP_SIZE)
        x = fmax(x, partial[g]);
    return group_max(x, scratch);
}
