/* What the kernels of an iterative solver share: partial sums, and the record of the iterations that the host reads.
   Include after reduce.h. */

/* Row q of `partial`: one value per work-group. */
#define ROW(q) (partial + (q)*group.count)

/* Write the sum over the work-group to row q. */
#define PUT(q, sum)                                                                                                    \
    {                                                                                                                  \
        const REAL put_ = group_sum((sum), group);                                                                     \
        if (GROUP_ITEM == 0)                                                                                           \
            ROW(q)[group.id] = put_;                                                                                   \
    }

/* Numbers of launches so far: `counts` tells the kernels of an iteration its number k, so that their arguments are the
   same in all iterations. A kernel reads the count of the other one and writes its own. A kernel before
   the first iteration sets counts[UPDATES] = 0. */
#define UPDATES 0
#define DIRECTIONS 1

inline int number_of_direction(global int *counts, group_t group)
{
    const int k = counts[UPDATES];
    if (IS_FIRST_ITEM)
        counts[DIRECTIONS] = k + 1;
    return k;
}

inline int number_of_update(global int *counts, group_t group)
{
    const int k = counts[DIRECTIONS] - 1;
    if (IS_FIRST_ITEM)
        counts[UPDATES] = k + 1;
    return k;
}

/* The record has one row of four values per iteration: |r|^2, (r, M^-1 r), whether the iteration is carried out, and
   (p, A p). From the iteration on that is not carried out, kernels change nothing. The host may therefore enqueue more
   iterations than needed: the result is the same. */
#define RECORD_NORM 0
#define RECORD_GAMMA 1
#define RECORD_RUNNING 2
#define RECORD_CURVATURE 3
