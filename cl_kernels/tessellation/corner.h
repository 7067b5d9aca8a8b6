#include "geometry/site.h"

/* One of two generators, the same for both cells. -DBY_PLACE: by their positions, since parts of a domain number them
   differently. */
#ifdef BY_PLACE
#define FIRST_OF(i, j, points) first_in_space(i, j, points)
inline int first_in_space(int i, int j, global const REAL *points)
{
    const REAL x = points[STRIDE * i] - points[STRIDE * j], y = points[STRIDE * i + 1] - points[STRIDE * j + 1];
    return x < 0 || (x == 0 && y < 0) ? i : j;
}
#else
#define FIRST_OF(i, j, points) min(i, j)
#endif

#ifdef SPHERE
#define FOLD(a) 0
#define APART(a, to_one, to_other, one, other) ((to_other) - (to_one))
/* Sides of what a cell is cut from, relative to the site x. */
#define LOWER_SIDE(axis) (-SQUARE)
#define UPPER_SIDE(axis) SQUARE
#else
#define LOWER_SIDE(axis) (lower[axis] - x[axis])
#define UPPER_SIDE(axis) (upper[axis] - x[axis])
/* The difference along axis a from one generator to another. -DFOLD_0, -DFOLD_1: periods of a folded graph (see
   ghost_images.cl), in which a neighbor is the nearest image of its generator; 0 along an axis with walls. */
#ifdef FOLD_0
#define FOLD(a) ((a) == 0 ? R(FOLD_0) : R(FOLD_1))
inline REAL fold_period(REAL d, REAL period)
{
    /* Faster than rint, which PoCL calls. */
    return d > period / 2 ? d - period : (d < -period / 2 ? d + period : d);
}
#define BETWEEN(a, from, to) (FOLD(a) > 0 ? fold_period((to) - (from), FOLD(a)) : (to) - (from))
/* From one neighbor to another, which may be more than half a period apart: the difference of the directions to them,
   which is exact along a periodic axis (see geometry/domain.h). */
#define APART(a, to_one, to_other, one, other) (FOLD(a) > 0 ? (to_other) - (to_one) : (other) - (one))
#else
#define FOLD(a) 0
#define BETWEEN(a, from, to) ((to) - (from))
#define APART(a, to_one, to_other, one, other) ((other) - (one))
#endif

/* From a position x to generator j. */
#define direction_of direction_in_plane
inline REAL2 direction_in_plane(const REAL *x, int j, global const REAL *points)
{
    return (REAL2)(BETWEEN(0, x[0], points[STRIDE * j]), BETWEEN(1, x[1], points[STRIDE * j + 1]));
}

#endif

/* The circumcenter of 0, u and v; u2 and v2 are the squares of u and v. With differences of weights subtracted from
   these, the point in which the three cells meet. */
inline REAL2 circumcenter(REAL2 u, REAL2 v, REAL u2, REAL v2)
{
    const REAL inverse = R(0.5) / difference_of_products(u.s0, v.s1, u.s1, v.s0);
    return (REAL2)(difference_of_products(u2, v.s1, v2, u.s1) * inverse,
                   difference_of_products(v2, u.s0, u2, v.s0) * inverse);
}

#ifdef SPHERE
/* As `corner`, where one face or both are on the square that the cell is cut from. */
inline REAL2 corner_at_square(const REAL *x, int a, int b, global const REAL *points)
{
    const int wall = -1 - min(a, b), axis = wall / 2;
    const REAL level = wall % 2 ? SQUARE : -SQUARE;
    REAL other;
    if (a < 0 && b < 0) {
        other = (-1 - max(a, b)) % 2 ? SQUARE : -SQUARE;
    } else {
        const REAL2 d = direction_of(x, max(a, b), points);
        const REAL d2 = dot(d, d), there = (d2 - WEIGHT_EXCESS(x, max(a, b), d2, points)) / 2;
        other = (there - level * (axis == 0 ? d.s0 : d.s1)) / (axis == 0 ? d.s1 : d.s0);
    }
    return axis == 0 ? (REAL2)(level, other) : (REAL2)(other, level);
}
#endif

/* Corner between the faces a and b (in this order) of generator i, relative to x_i, from the generators, so that
   all cells that share the corner get the same point up to one rounding. */
inline REAL2 corner(int i, const REAL *x, int a, int b, global const REAL *points, const REAL *lower, const REAL *upper)
{
    if (a >= 0 && b >= 0) {
        const REAL2 u = direction_of(x, a, points), v = direction_of(x, b, points);
        const REAL2 w = (REAL2)(APART(0, u.s0, v.s0, points[STRIDE * a], points[STRIDE * b]),
                                APART(1, u.s1, v.s1, points[STRIDE * a + 1], points[STRIDE * b + 1]));
        const REAL u2 = dot(u, u), v2 = dot(v, v), w2 = dot(w, w);
        const REAL to_a = WEIGHT_EXCESS(x, a, u2, points), to_b = WEIGHT_EXCESS(x, b, v2, points);
        /* The circumcenter of the triangle, relative to x_i. If the other two generators are near each other, the
           squares cancel, and it is computed relative to one of them. */
        if (w2 > R(1e-3) * u2)
            return circumcenter(u, v, u2 - to_a, v2 - to_b);
        return circumcenter(w, -u, w2 - EXCESS_BETWEEN(a, b, to_a, to_b, points), u2 + to_a) + u;
    }
#ifdef SPHERE
    return corner_at_square(x, a, b, points);
#else
    if (a < 0 && b < 0) {
        /* Two walls: a corner of the box, one wall across each axis. */
        const int wa = -1 - a, wb = -1 - b;
        const int wx = wa < 2 ? wa : wb, wy = wa < 2 ? wb : wa;
        return (REAL2)((wx % 2 ? upper[0] : lower[0]) - x[0], (wy % 2 ? upper[1] : lower[1]) - x[1]);
    }
    /* The bisector of o and q meets a wall. */
    const int j = max(a, b), wall = -1 - min(a, b);
    const int axis = wall / 2;
    const int o = FIRST_OF(i, j, points), q = o == i ? j : i;
    const REAL level = wall % 2 ? upper[axis] : lower[axis];
#ifdef FOLD_0
    if (FOLD(axis) > 0) {
        /* Only cells that are not finished reach the sides of a box wider than the period. */
        const REAL2 d = direction_of(x, j, points);
        const REAL from = axis == 0 ? d.s0 : d.s1, by = axis == 0 ? d.s1 : d.s0, to = level - x[axis];
        const REAL there = ((dot(d, d) - (WEIGHT(points, j) - SITE_WEIGHT(x))) / 2 - from * to) / by;
        return axis == 0 ? (REAL2)(to, there) : (REAL2)(there, to);
    }
#endif
    const REAL d_across = points[STRIDE * q + axis] - points[STRIDE * o + axis];
    const REAL d_along = BETWEEN(1 - axis, points[STRIDE * o + 1 - axis], points[STRIDE * q + 1 - axis]);
    const REAL across = level - points[STRIDE * o + axis];
    const REAL d2 = d_across * d_across + d_along * d_along - (WEIGHT(points, q) - WEIGHT(points, o));
    const REAL along = difference_of_products(R(0.5), d2, d_across, across) / d_along +
                       BETWEEN(1 - axis, x[1 - axis], points[STRIDE * o + 1 - axis]);
    return axis == 0 ? (REAL2)(level - x[0], along) : (REAL2)(along, level - x[1]);
#endif
}

/* From the corner of cell j between its faces p and q to the same corner of cell i, relative to x_i. */
inline REAL2 corner_gap(REAL2 mine, int i, int j, int p, int q, global const REAL *points, const REAL *lower,
                        const REAL *upper)
{
    SITE(x, j, points);
#ifdef SPHERE
    SITE(own, i, points);
    return mine - seen_from(own, x, corner(j, x, p, q, points, lower, upper));
#else
    const REAL2 from = direction_of(x, i, points);
    return mine + from - corner(j, x, p, q, points, lower, upper);
#endif
}

/* Index of j in a row of n; n if it is missing. */
inline int place_in_row(global const int *row, int n, int j)
{
    int q = 0;
    while (q < n && row[q] != j)
        ++q;
    return q;
}
