#include "common/real.h"

/* Corner between the faces a and b (in this order) of generator i, relative to x_i. It is computed from the generators
   in the order of their indices, so that the cells that share the corner agree on it to a rounding. */
inline REAL2 corner(int i, const REAL *x, int a, int b, global const REAL *points, const REAL *lower,
                    const REAL *upper)
{
    if (a >= 0 && b >= 0) {
        /* Circumcentre of the triangle, relative to the generator o opposite its longest side: then neither the
           differences nor the squares below cancel, also if two of the three are an ulp apart. */
        const int r = min(i, min(a, b)), t = max(i, max(a, b)), s = i + a + b - r - t;
        const REAL2 xr = (REAL2)(points[2 * r], points[2 * r + 1]);
        const REAL2 xs = (REAL2)(points[2 * s], points[2 * s + 1]);
        const REAL2 xt = (REAL2)(points[2 * t], points[2 * t + 1]);
        const REAL rs = dot(xs - xr, xs - xr), rt = dot(xt - xr, xt - xr), st = dot(xt - xs, xt - xs);
        const bool at_r = st >= rs && st >= rt;
        const bool at_s = !at_r && rt >= rs;
        const REAL2 xo = at_r ? xr : (at_s ? xs : xt);
        const REAL2 u = (at_r ? xs : xr) - xo;
        const REAL2 v = (at_r || at_s ? xt : xs) - xo;
        const REAL ox = xo.s0, oy = xo.s1, ux = u.s0, uy = u.s1, vx = v.s0, vy = v.s1;
        const REAL u2 = dot(u, u), v2 = dot(v, v);
        const REAL twice = 2 * difference_of_products(ux, vy, uy, vx);
        return (REAL2)(difference_of_products(u2, vy, v2, uy) / twice + (ox - x[0]),
                       difference_of_products(v2, ux, u2, vx) / twice + (oy - x[1]));
    }
    if (a < 0 && b < 0) {
        /* Two walls: a corner of the box, one wall across each axis. */
        const int wa = -1 - a, wb = -1 - b;
        const int wx = wa < 2 ? wa : wb, wy = wa < 2 ? wb : wa;
        return (REAL2)((wx % 2 ? upper[0] : lower[0]) - x[0], (wy % 2 ? upper[1] : lower[1]) - x[1]);
    }
    /* The bisector of o and q meets a wall. */
    const int j = max(a, b), wall = -1 - min(a, b);
    const int axis = wall / 2;
    const int o = min(i, j), q = max(i, j);
    const REAL level = wall % 2 ? upper[axis] : lower[axis];
    const REAL d_across = points[2 * q + axis] - points[2 * o + axis];
    const REAL d_along = points[2 * q + 1 - axis] - points[2 * o + 1 - axis];
    const REAL across = level - points[2 * o + axis];
    const REAL d2 = d_across * d_across + d_along * d_along;
    const REAL along = difference_of_products(R(0.5), d2, d_across, across) / d_along + (points[2 * o + 1 - axis] - x[1 - axis]);
    return axis == 0 ? (REAL2)(level - x[0], along) : (REAL2)(along, level - x[1]);
}
