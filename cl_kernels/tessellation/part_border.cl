/* What tells the host which generators of a part are near others. A run has RUN successive generators. */
#include "opencl/real.h"

inline REAL square_of_way(global const REAL *x, global const REAL *y)
{
    REAL sum = 0;
    for (int a = 0; a < DIM; ++a)
        sum += (x[a] - y[a]) * (x[a] - y[a]);
    return sum;
}

/* Lower and upper corner of the box around points first to end - 1. */
inline void bound(int first, int end, global const REAL *points, global REAL *box)
{
    for (int a = 0; a < DIM; ++a) {
        REAL lower = REAL_MAX, upper = -REAL_MAX;
        for (int i = first; i < end; ++i) {
            lower = fmin(lower, points[DIM * i + a]);
            upper = fmax(upper, points[DIM * i + a]);
        }
        box[a] = lower;
        box[DIM + a] = upper;
    }
}

/* Row q of `found`: the boxes around the generators of run q before and after its longest step, and the median of
   the squares of their distances from the nearest of the next AHEAD. One work-item per run. */
kernel void bound_runs(const int size, const int n, global const REAL *points, global REAL *found)
{
    WORK_ITEM(q);
    global REAL *row = found + (4 * DIM + 1) * q;
    const int first = RUN * q, end = min(first + RUN, n), count = min(end, n - 1) - first;
    REAL nearest[RUN], longest = -1;
    int split = first + 1;
    for (int i = first; i < first + count; ++i) {
        const REAL step = square_of_way(points + DIM * i, points + DIM * (i + 1));
        REAL least = step;
        for (int j = i + 2; j < min(i + AHEAD + 1, n); ++j)
            least = fmin(least, square_of_way(points + DIM * i, points + DIM * j));
        nearest[i - first] = least;
        if (i + 1 < end && step > longest) {
            longest = step;
            split = i + 1;
        }
    }
    REAL middle = 0;
    for (int k = 0; k <= count / 2 && k < count; ++k) {
        int least = k;
        for (int other = k + 1; other < count; ++other)
            least = nearest[other] < nearest[least] ? other : least;
        middle = nearest[least];
        nearest[least] = nearest[k];
    }
    bound(first, split, points, row);
    bound(split < end ? split : first, end, points, row + 2 * DIM);
    row[4 * DIM] = middle;
}

/* Row q of `largest`: over run q the largest of both columns of `needed`, and of their sums. One work-item per run. */
kernel void largest_needs(const int size, const int n, global const float2 *needed, global float *largest)
{
    WORK_ITEM(q);
    float2 most = 0;
    float both = 0;
    for (int i = RUN * q; i < min(RUN * (q + 1), n); ++i) {
        most = fmax(most, needed[i]);
        both = fmax(both, needed[i].s0 + needed[i].s1);
    }
    largest[3 * q] = most.s0;
    largest[3 * q + 1] = most.s1;
    largest[3 * q + 2] = both;
}

/* limits[i] = of_runs[q] for the generators i of run q, or those of `of_each` from begins[q] on, unless that is
   negative. One work-item per run. */
kernel void place_limits(const int size, const int n, global const int *begins, global const float2 *of_runs,
                         global const float2 *of_each, global float2 *limits)
{
    WORK_ITEM(q);
    const int first = RUN * q, begin = begins[q];
    for (int i = first; i < min(first + RUN, n); ++i)
        limits[i] = begin < 0 ? of_runs[q] : of_each[begin + i - first];
}

/* Copy these rows of `values`, `words` 32-bit words each, to the same rows of `to`. One work-item per row. */
kernel void copy_rows(const int size, global const int *rows, const int words, global const uint *values,
                      global uint *to)
{
    WORK_ITEM(p);
    for (int w = 0; w < words; ++w)
        to[words * rows[p] + w] = values[words * rows[p] + w];
}
