/* Whether a generator lies in the circle of three others: the same answer for all cells that share the corner. */
#include "geometry/site.h"

/* Relative round-off of the sum below, as a share of its terms. */
#define CIRCLE_NOISE (32 * REAL_EPS)

/* The bisector of the site and j, { p : n.p = level }, as (n, level, size of the terms of the level). */
inline REAL4 bisector_line(const REAL *x, int j, global const REAL *points)
{
    global const REAL *y = points + STRIDE * j;
    const REAL d[3] = {y[0] - x[0], y[1] - x[1], y[2] - x[2]};
    const REAL2 n = along_tangents(x, d);
    const REAL level = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) / 2;
#ifdef WEIGHTED
    const REAL more = lift(x, j, points);
    return (REAL4)(n.s0, n.s1, level + more, level + fabs(more));
#else
    return (REAL4)(n.s0, n.s1, level, level);
#endif
}

/* Positive if the intersection of the bisectors of generator i with a and b (counter-clockwise) lies beyond the one
   with j; 0 if all four lie on a circle, up to round-off. The generators are sorted first: the value depends on the
   order only by its sign. */
inline REAL beyond_circle(int i, int a, int b, int j, global const REAL *points)
{
    int ids[4] = {i, a, b, j};
    REAL sign = 1;
    for (int end = 3; end > 0; --end)
        for (int k = 0; k < end; ++k)
            if (ids[k] > ids[k + 1]) {
                const int held = ids[k];
                ids[k] = ids[k + 1];
                ids[k + 1] = held;
                sign = -sign;
            }
    SITE(x, ids[0], points);
    const REAL4 u = bisector_line(x, ids[1], points), v = bisector_line(x, ids[2], points),
                w = bisector_line(x, ids[3], points);
    const REAL first = difference_of_products(w.s0, v.s1, w.s1, v.s0);
    const REAL second = difference_of_products(u.s0, w.s1, u.s1, w.s0);
    const REAL third = difference_of_products(u.s0, v.s1, u.s1, v.s0);
    const REAL sum = u.s2 * first + v.s2 * second - w.s2 * third;
    const REAL terms = u.s3 * fabs(first) + v.s3 * fabs(second) + w.s3 * fabs(third);
    return fabs(sum) > CIRCLE_NOISE * terms ? sign * sum : 0;
}
