/* The position of a generator as the origin of the plane in which its cell is cut. */
#include "geometry/weights.h"

/* Corners of the box as arrays. */
#define BOX_CORNERS(lower, upper)                                                                                      \
    const REAL lower[4] = {box_lower.s0, box_lower.s1, box_lower.s2, box_lower.s3};                                    \
    const REAL upper[4] = {box_upper.s0, box_upper.s1, box_upper.s2, box_upper.s3}

#ifdef SPHERE
/* A generator on the unit sphere as the origin of a plane: its tangent plane, onto which the sphere is projected from
   its center. Great circles become straight lines, so cells become convex polygons. A site holds the position of the
   generator and two tangent unit vectors; seen from outside, the second is counter-clockwise from the first; in a power
   diagram also the weight. */
#ifdef WEIGHTED
#define SITE_SIZE 10
#define SITE_WEIGHT(x) (x)[9]
#else
#define SITE_SIZE 9
#endif
#define SITE(x, i, points)                                                                                             \
    REAL x[SITE_SIZE];                                                                                                 \
    place_site(x, i, points)

/* Half the edge of the square that cells are cut from, in a tangent plane: 89.4 degrees of a great circle. */
#define SQUARE R(100)
/* Square of the distance, 179.2 degrees of a great circle, from which on bisectors do not cut the square. There
   generators seem to be far away, in any direction. */
#define OPPOSITE R(3.9998)

inline void place_site(REAL *x, int i, global const REAL *points)
{
    EACH_AXIS (a)
        x[a] = points[STRIDE * i + a];
    /* Without a branch and without cancellation (Duff et al. 2017, Building an orthonormal basis, revisited). */
    const REAL sign = x[2] < 0 ? -1 : 1, s = -1 / (sign + x[2]), t = x[0] * x[1] * s;
    x[3] = 1 + sign * x[0] * x[0] * s;
    x[4] = sign * t;
    x[5] = -sign * x[0];
    x[6] = t;
    x[7] = sign + x[1] * x[1] * s;
    x[8] = -x[1];
#ifdef WEIGHTED
    SITE_WEIGHT(x) = WEIGHT(points, i);
#endif
}

/* The tangents of `place_site` in single precision, for one or several positions. */
#define FLOAT_TANGENTS(TYPE, x, e, f)                                                                                  \
    do {                                                                                                               \
        const TYPE sign = copysign((TYPE)(1), x[2]), s = -1 / (sign + x[2]), t = x[0] * x[1] * s;                      \
        e[0] = 1 + sign * x[0] * x[0] * s;                                                                             \
        e[1] = sign * t;                                                                                               \
        e[2] = -sign * x[0];                                                                                           \
        f[0] = t;                                                                                                      \
        f[1] = sign + x[1] * x[1] * s;                                                                                 \
        f[2] = -x[1];                                                                                                  \
    } while (0)

/* The component along the tangent e of one vector in space, or of several. */
#define ALONG(TYPE, e, v) fma((TYPE)((e)[0]), (v)[0], fma((TYPE)((e)[1]), (v)[1], (TYPE)((e)[2]) * (v)[2]))

/* Components along the two tangents. */
inline REAL2 along_tangents(const REAL *x, const REAL *d)
{
    return (REAL2)(x[3] * d[0] + x[4] * d[1] + x[5] * d[2], x[6] * d[0] + x[7] * d[1] + x[8] * d[2]);
}

/* The vector in space of p in the tangent plane. */
inline void in_space(const REAL *x, REAL2 p, REAL *d)
{
    EACH_AXIS (a)
        d[a] = x[3 + a] * p.s0 + x[6 + a] * p.s1;
}

/* From the site to generator j in its stereographic projection from the antipode, whose scale is 1 at the site. The
   bisector with j is { p : p.d = d.d / 2 } in the tangent plane, as between points of a plane: with the difference D of
   both positions, (x + p).D = 0 is p.D = -x.D = D.D / 2. */
#define direction_of direction_on_sphere
inline REAL2 direction_on_sphere(const REAL *x, int j, global const REAL *points)
{
    global const REAL *y = points + STRIDE * j;
    const REAL d[3] = {y[0] - x[0], y[1] - x[1], y[2] - x[2]};
    const REAL d2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
    return d2 < OPPOSITE ? along_tangents(x, d) * (1 / (1 - d2 / 4)) : (REAL2)(1 / REAL_EPS, 0);
}

#ifdef WEIGHTED
/* In a power diagram on the sphere a cell holds the points y with the largest (1 + w_i / 2) x_i.y (Sugihara 2002,
   J. Geom. Graph. 6, 69). With the difference D of both positions, (1 + w_i / 2) x.y >= (1 + w_j / 2) (x + D).y is
   p.D <= D.D / 2 + (w_i - w_j) / (2 + w_j). */
inline REAL lift(const REAL *x, int j, global const REAL *points)
{
    return (SITE_WEIGHT(x) - WEIGHT(points, j)) / (2 + WEIGHT(points, j));
}

/* By how much the weight of generator j, at the square d2 of the distance in the projection, exceeds that of the site:
   the bisector is { p : p.d = (d.d - excess) / 2 }. */
#define WEIGHT_EXCESS(x, j, d2, points) (-2 * lift(x, j, points) * (1 + (d2) / 4))
#define EXCESS_BETWEEN(a, b, to_a, to_b, points) ((to_b) - (to_a))
#endif

/* A point of the tangent plane of `from` in that of `to`. */
inline REAL2 seen_from(const REAL *to, const REAL *from, REAL2 p)
{
    REAL y[3], d[3];
    in_space(from, p, y);
    REAL height = 1, gap2 = 0;
    /* The difference of the positions is exact, their product is not. */
    EACH_AXIS (a) {
        const REAL apart = from[a] - to[a];
        gap2 += apart * apart;
        d[a] = y[a] + apart;
        height += y[a] * to[a];
    }
    return along_tangents(to, d) / (height - gap2 / 2);
}

/* The vector from the site to the point of the sphere above p. */
inline void on_sphere(const REAL *x, REAL2 p, REAL *d)
{
    const REAL p2 = dot(p, p), l = sqrt(1 + p2), sink = p2 / (l * (1 + l)); /* 1 - 1 / l */
    in_space(x, p / l, d);
    EACH_AXIS (a)
        d[a] -= sink * x[a];
}
#elif defined(WEIGHTED)
#define SITE_SIZE 3
#define SITE(x, i, points) const REAL x[SITE_SIZE] = {points[STRIDE * (i)], points[STRIDE * (i) + 1], WEIGHT(points, i)}
#define SITE_WEIGHT(x) (x)[2]
#else
#define SITE_SIZE 2
#define SITE(x, i, points) const REAL x[SITE_SIZE] = {points[2 * (i)], points[2 * (i) + 1]}
#endif
#ifndef SITE_WEIGHT
#define SITE_WEIGHT(x) R(0)
#endif
#ifndef WEIGHT_EXCESS
#define WEIGHT_EXCESS(x, j, d2, points) (WEIGHT(points, j) - SITE_WEIGHT(x))
/* By how much that of b exceeds that of a, from those over the site. */
#define EXCESS_BETWEEN(a, b, to_a, to_b, points) (WEIGHT(points, b) - WEIGHT(points, a))
#endif
