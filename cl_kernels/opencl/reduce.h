/* Deterministic sums and maxima. Every group writes one partial value per quantity; a later kernel adds the partial
   values of all groups in their order. Include after blocks.h and real.h.

   All functions contain barriers. A kernel must not return before a barrier, not even with all work-items: PoCL
   miscompiles this for groups of more than one item. Use a loop without iterations instead. */

/* A work-group: its number, the number of groups, and memory that its items share. Kernels begin with LONG_GROUP, and
   pass `group` to functions. Functions do not ask for the group themselves, and have no barriers where a group is one
   item: PoCL would paste them into their callers. */
typedef struct {
    int id, count;
    local REAL *scratch;
} group_t;
#define MAKE_GROUP                                                                                                     \
    local REAL scratch_of_group[GROUP_SIZE];                                                                           \
    const group_t group = {get_group_id(0), get_num_groups(0), scratch_of_group}
#define LONG_GROUP MAKE_GROUP
#if GROUP_SIZE > 1
#define GROUP_ITEM get_local_id(0)
#define GROUP_BARRIER barrier(CLK_GLOBAL_MEM_FENCE)
#else
#define GROUP_ITEM 0
#define GROUP_BARRIER
#endif
#define IS_FIRST_ITEM (group.id == 0 && GROUP_ITEM == 0)

/* for (GROUP_LOOP(i, n)) { ... }: the same items as BLOCK_LOOP. */
#define GROUP_LOOP(i, n) LOOP_OF_ITEM(i, n, group.id, group.count, GROUP_ITEM)

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

/* x = the sum (maximum) over the work-items of a group, for each. */
#if GROUP_SIZE > 1
#define REDUCE_GROUP(x, COMBINE)                                                                                       \
    const int me = get_local_id(0);                                                                                    \
    local REAL *scratch = group.scratch;                                                                               \
    barrier(CLK_LOCAL_MEM_FENCE);                                                                                      \
    scratch[me] = x;                                                                                                   \
    for (int half_ = GROUP_SIZE / 2; half_ > 0; half_ /= 2) {                                                          \
        barrier(CLK_LOCAL_MEM_FENCE);                                                                                  \
        if (me < half_)                                                                                                \
            scratch[me] = COMBINE(scratch[me], scratch[me + half_]);                                                   \
    }                                                                                                                  \
    barrier(CLK_LOCAL_MEM_FENCE);                                                                                      \
    x = scratch[0]
#else
#define REDUCE_GROUP(x, COMBINE)
#endif
#define SUM_OF_TWO(a, b) ((a) + (b))

inline REAL group_sum(REAL x, group_t group)
{
    REDUCE_GROUP(x, SUM_OF_TWO);
    return x;
}

inline REAL group_max(REAL x, group_t group)
{
    REDUCE_GROUP(x, fmax);
    return x;
}

/* Sum of the partial values of `count` groups of an earlier kernel. */
inline REAL sum_of_groups(global const REAL *partial, int count, group_t group)
{
    REAL x = 0;
    for (int g = GROUP_ITEM; g < count; g += GROUP_SIZE)
        x += partial[g];
    return group_sum(x, group);
}

/* Sum (maximum) of the partial values of as many groups as there are now. */
inline REAL total_sum(global const REAL *partial, group_t group)
{
    return sum_of_groups(partial, group.count, group);
}

inline REAL total_max(global const REAL *partial, group_t group)
{
    REAL x = partial[0];
    for (int g = GROUP_ITEM; g < group.count; g += GROUP_SIZE)
        x = fmax(x, partial[g]);
    return group_max(x, group);
}
