/* The side of a bisector on which two other bisectors intersect, with twice the digits of REAL. All cells that share a
   corner get the same answer, also for close, distant or cocircular generators. */
#include "tessellation/corner.h"
#include "opencl/double_word.h"

/* Generators are near each other if the square of their distance is at most this share of that to the cell. */
#define NEAR_EACH_OTHER R(0.1)
/* Relative error bound of double words in `beyond_corner`, as a share of the terms of its sum. */
#define WIDE_NOISE (64 * REAL_EPS * REAL_EPS)

/* BETWEEN without round-off; along a periodic axis it is exact (see corner.h). */
#define BETWEEN_WIDE(a, from, to) (FOLD(a) > 0 ? (wide_t)(BETWEEN(a, from, to), 0) : wide_sum(to, -(from)))

/* The half-plane { y : n.y <= level }. */
typedef struct {
    wide_t x, y, level;
} wide_half_plane_t;

inline wide_t wide_cross(wide_half_plane_t a, wide_half_plane_t b)
{
    return wide_add(wide_product(a.x, b.y), -wide_product(a.y, b.x));
}

/* The points nearer to a generator at x than to that of `label` (in a power diagram, by the power distance), or inside
   a wall of the box; relative to x. */
inline wide_half_plane_t half_plane_of(const REAL *x, int label, global const REAL *points, const REAL *lower,
                                       const REAL *upper)
{
    wide_half_plane_t h = {0, 0, 0};
    if (label >= 0) {
        h.x = BETWEEN_WIDE(0, x[0], points[STRIDE * label]);
        h.y = BETWEEN_WIDE(1, x[1], points[STRIDE * label + 1]);
        h.level = wide_add(wide_product(h.x, h.x), wide_product(h.y, h.y)) / 2;
#ifdef WEIGHTED
        h.level = wide_add(h.level, wide_sum(SITE_WEIGHT(x), -WEIGHT(points, label)) / 2);
#endif
        return h;
    }
    const int wall = -1 - label, axis = wall / 2;
    const REAL sign = wall % 2 == 0 ? -1 : 1;
    if (axis == 0)
        h.x.s0 = sign;
    else
        h.y.s0 = sign;
    h.level = sign * wide_sum(wall % 2 == 0 ? lower[axis] : upper[axis], -x[axis]);
    return h;
}

/* The difference of the half-planes of two generators: the points nearer to b than to a. The three lines share a point.
 */
inline wide_half_plane_t between_half_planes(wide_half_plane_t a, wide_half_plane_t b)
{
    const wide_t x = wide_add(a.x, -b.x), y = wide_add(a.y, -b.y);
#ifdef WEIGHTED
    const wide_half_plane_t h = {x, y, wide_add(a.level, -b.level)};
#else
    const wide_t twice = wide_add(wide_product(x, wide_add(a.x, b.x)), wide_product(y, wide_add(a.y, b.y)));
    const wide_half_plane_t h = {x, y, twice / 2};
#endif
    return h;
}

/* Squared distance of the generators of two half-planes, and of one from x. */
inline REAL squared_distance_between(wide_half_plane_t a, wide_half_plane_t b)
{
    const REAL x = b.x.s0 - a.x.s0, y = b.y.s0 - a.y.s0;
    return x * x + y * y;
}

inline REAL squared_distance_of(wide_half_plane_t h)
{
    return h.x.s0 * h.x.s0 + h.y.s0 * h.y.s0;
}

/* Signed distance of the corner of the cell of x between its faces a and b (counter-clockwise) beyond the bisector with
   generator j, times the distance to j: the determinant of the three line equations (for generators: Shewchuk's
   InCircle) over that of two. For two generators near each other and far from x, their difference replaces one of them,
   as products of long distances lose the digits in which they differ. 0 if double words cannot decide: all lines share
   a point. */
OUT_OF_LINE REAL beyond_corner(const REAL *x, int a, int b, int j, global const REAL *points, const REAL *lower,
                               const REAL *upper)
{
    wide_half_plane_t u = half_plane_of(x, a, points, lower, upper), v = half_plane_of(x, b, points, lower, upper);
    wide_half_plane_t w = half_plane_of(x, j, points, lower, upper);
    const REAL turn = wide_cross(u, v).s0, near2 = NEAR_EACH_OTHER * squared_distance_of(w);
    const REAL to_u2 = a < 0 ? REAL_MAX : squared_distance_between(w, u);
    const REAL to_v2 = b < 0 ? REAL_MAX : squared_distance_between(w, v);
    if (fmin(to_u2, to_v2) < near2)
        w = between_half_planes(w, to_u2 < to_v2 ? u : v);
    if (a >= 0 && b >= 0 && squared_distance_between(u, v) < NEAR_EACH_OTHER * squared_distance_of(u))
        u = between_half_planes(u, v);
    const wide_t first = wide_product(u.level, wide_cross(w, v)), second = wide_product(v.level, wide_cross(u, w));
    const wide_t third = -wide_product(w.level, wide_cross(u, v));
    const REAL sum = wide_add(wide_add(first, second), third).s0;
    const bool sure = fabs(sum) > WIDE_NOISE * (fabs(first.s0) + fabs(second.s0) + fabs(third.s0));
    return sure && turn > 0 ? sum / turn : 0;
}

/* The half-plane that the line a + t e leaves first. Negative: u. 0: double words cannot decide, or the line does not
   leave both. All coordinates are relative to one point. */
inline REAL leaves_later(wide_half_plane_t u, wide_half_plane_t v, wide_t a_x, wide_t a_y, REAL2 e)
{
    const wide_t e_x = (wide_t)(e.s0, 0), e_y = (wide_t)(e.s1, 0);
    const wide_t u_x = wide_product(u.x, a_x), u_y = wide_product(u.y, a_y);
    const wide_t v_x = wide_product(v.x, a_x), v_y = wide_product(v.y, a_y);
    const wide_t u_along = wide_add(wide_product(u.x, e_x), wide_product(u.y, e_y));
    const wide_t v_along = wide_add(wide_product(v.x, e_x), wide_product(v.y, e_y));
    const wide_t u_left = wide_add(u.level, -wide_add(u_x, u_y)), v_left = wide_add(v.level, -wide_add(v_x, v_y));
    const REAL later = wide_add(wide_product(u_left, v_along), -wide_product(v_left, u_along)).s0;
    const REAL terms = (fabs(u.level.s0) + fabs(u_x.s0) + fabs(u_y.s0)) * v_along.s0 +
                       (fabs(v.level.s0) + fabs(v_x.s0) + fabs(v_y.s0)) * u_along.s0;
    return u_along.s0 > 0 && v_along.s0 > 0 && fabs(later) > WIDE_NOISE * terms ? later : 0;
}
