/* Sums and maxima that repeat bit by bit: every group writes one partial value per quantity, and whoever needs the
   total adds the partial values of all groups in their order. Include after blocks.h and real.h.

   All hold barriers. A kernel must not return before one, not even all of its work-items alike: PoCL then runs astray
   with groups of more than one. What is not to be done becomes a loop of no turns. */

/* Running sum of one work-item; compensated (Kahan) in single precision, where a CPU's work-item adds up many
   thousands. */
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

/* Total (maximum) of the partial values that a block-wise kernel has left, one per group. */
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
