/* The measures of a cell on the unit sphere: a polygon of great circles. With v = (p, 1) for a corner p in the tangent
   plane and |v| = sqrt(1 + p.p). */
#include "tessellation/moments.h"
#include "geometry/site.h"
#include "tessellation/sphere_arcs.h"

#define measure_face measure_arc_face
#define measure_cell measure_sphere_cell

/* atan(t), t >= 0. */
inline REAL short_atan(REAL t)
{
    const REAL t2 = t * t;
    return t2 > SHORT_ARC2 ? atan(t) : t * ATAN_SERIES(t2);
}

/* arc / sin(arc) - 1. */
inline REAL arc_excess(REAL arc, REAL sine)
{
    const REAL s2 = sine * sine;
    return s2 > SHORT_ARC2 ? arc / sine - 1 : ARC_EXCESS_SERIES(s2);
}

/* The edge from corner p to corner q. */
typedef struct {
    REAL excess;  /* area of the triangle with the generator, by its spherical excess */
    REAL arc;     /* length */
    REAL2 middle; /* of the arc, in the tangent plane */
    REAL weight;  /* arc / |v x w| - 1 */
    REAL cross;   /* n.(v x w), n being the position of the generator */
} arc_t;

inline arc_t measure_arc(REAL2 p, REAL2 q)
{
    arc_t edge;
    const REAL p2 = dot(p, p), q2 = dot(q, q), lp = sqrt(1 + p2), lq = sqrt(1 + q2);
    const REAL cross = difference_of_products(p.s0, q.s1, p.s1, q.s0), cosine = 1 + dot(p, q);
    const REAL2 e = q - p;
    edge.cross = cross;
    const REAL height = sqrt(dot(e, e) + cross * cross); /* |v x w| */
    /* tan(E / 2) = n.(v x w) / (|v| |w| + |v| + |w| + v.w) (Van Oosterom and Strackee 1983). */
    edge.excess = copysign(2 * short_atan(fabs(cross) / (lp * lq + lp + lq + cosine)), cross);
    edge.arc = cosine > 0 ? short_atan(height / cosine) : atan2(height, cosine);
    edge.middle = (p * lq + q * lp) / (lp + lq);
    const REAL inverse = 1 / (lp * lq), beyond_one = (p2 + q2 + p2 * q2) / (1 + lp * lq); /* |v| |w| - 1 */
    edge.weight = (arc_excess(edge.arc, height * inverse) - beyond_one) * inverse;
    return edge;
}

/* Length and middle of the face from p to q of the cell at x, relative to it. */
inline REAL measure_arc_face(const REAL *x, REAL2 p, REAL2 q, REAL *middle)
{
    const arc_t edge = measure_arc(p, q);
    on_sphere(x, edge.middle, middle);
    return edge.arc;
}

/* The integral of the position over a cell is half the sum over its edges of arc n, n being the unit normal of the
   plane of the edge (Gauss). Its tangential part, relative to the generator, follows from the differences of the terms
   from v x w, whose sum is zero: small cells lose no digits. The centroid is its direction. Second moments are those of
   the polygon in the tangent plane, relative to its own area: exact for small cells. */
inline void measure_sphere_cell(const measures_t *to, int i, const int *faces, int n, global const REAL *points,
                                const REAL *lower, const REAL *upper)
{
    SITE(x, i, points);
    const int start = to->starts[i];
    moments_t moments = {0, 0, 0, 0, 0, 0};
    REAL area = 0, radial = 0, d[3];
    REAL2 tangential = 0;
    if (n >= 3) {
        const REAL2 origin = corner(i, x, faces[n - 1], faces[0], points, lower, upper);
        REAL2 p = origin;
        for (int k = 0; k < n; ++k) {
            const REAL2 q = k == n - 1 ? origin : corner(i, x, faces[k], faces[k + 1], points, lower, upper);
            const arc_t edge = measure_arc(p, q);
            add_triangle(&moments, p, q);
            area += edge.excess;
            tangential += edge.weight * (REAL2)(p.s1 - q.s1, q.s0 - p.s0);
            radial += (1 + edge.weight) * edge.cross;
            on_sphere(x, edge.middle, d);
            to->neighbors[start + k] = faces[k];
            to->face_measures[start + k] = edge.arc;
            EACH_AXIS(a)
            to->face_centroids[3 * (start + k) + a] = d[a];
            p = q;
        }
    }
    on_sphere(x, radial > 0 ? tangential / radial : (REAL2)(0), d);
    to->volumes[i] = area;
    EACH_AXIS(a)
    to->offsets[3 * i + a] = d[a];
    global REAL *c = to->covariances + 6 * i;
    const REAL3 m = second_moments(&moments);
    for (int a = 0, k = 0; a < 3; ++a)
        for (int b = a; b < 3; ++b, ++k)
            c[k] = m.s0 * x[3 + a] * x[3 + b] + m.s1 * (x[3 + a] * x[6 + b] + x[6 + a] * x[3 + b]) +
                   m.s2 * x[6 + a] * x[6 + b];
}
