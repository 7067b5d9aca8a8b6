/* The measures of a cell on the unit sphere: a polygon of great circles. With v = (p, 1) for a corner p in the tangent
   plane and |v| = sqrt(1 + p.p). */
#include "tessellation/moments.h"
#include "geometry/site.h"
#include "tessellation/sphere_arcs.h"

#define measure_face measure_arc_face
#define measure_cell measure_sphere_cell

/* A corner p of a cell. */
typedef struct {
    REAL2 p;   /* in the tangent plane */
    REAL p2;   /* p.p */
    REAL sink; /* 1 - 1 / |v|: by how much it lies below the plane */
} corner_t;

/* The edge from corner p to corner q. */
typedef struct {
    REAL excess;  /* area of the triangle with the generator, by its spherical excess */
    REAL arc;     /* length */
    REAL2 middle; /* of the arc, on the sphere: its components along the tangents */
    REAL rise;    /* and along the position of the generator, less 1 */
    REAL weight;  /* arc / |v x w| - 1 */
    REAL cross;   /* n.(v x w), n being the position of the generator */
} arc_t;

inline corner_t corner_of_arc(REAL2 p)
{
    const REAL p2 = dot(p, p), l = sqrt(1 + p2);
    return (corner_t){p, p2, p2 > SHORT_REACH2 ? p2 / (l * (1 + l)) : SINK_SERIES(REAL, p2)};
}

/* An arc between corners near the generator: series, one division and one square root. With S = s + t for the sinks of
   both corners, the sum and the difference of the points on the sphere are, in the tangent plane,
   (p + q) (1 - S / 2) - (q - p) (t - s) / 2 and (q - p) (1 - S / 2) - (p + q) (t - s) / 2: no digit is lost. */
inline arc_t measure_short_arc(corner_t from, corner_t to, REAL cross)
{
    arc_t edge;
    const REAL2 e = to.p - from.p, sum = from.p + to.p;
    const REAL sinks = from.sink + to.sink, fall = to.sink - from.sink;
    const REAL share = 1 - sinks / 2, half_fall = fall / 2, both = fma(-from.sink, to.sink, sinks);
    const REAL2 chord = fma(e, (REAL2)(share), -sum * half_fall);
    const REAL chord2 = fma(chord.s0, chord.s0, fma(chord.s1, chord.s1, fall * fall)), length = sqrt(chord2);
    const REAL u2 = chord2 / 4, below = -u2;
    const REAL asine = ASIN_SERIES(REAL, u2), lift = -SINK_SERIES(REAL, below);
    const REAL inverse = 1 - both, grown = 1 + lift, outwards = grown / 2; /* inverse = 1 / (|v| |w|) */
    /* tan(E / 2) = n.(v x w) / (|v| |w| + |v| + |w| + v.w) (Van Oosterom and Strackee 1983). */
    const REAL tangent = cross * inverse / (4 - fma(R(2), u2, sinks)), tangent2 = tangent * tangent;
    edge.cross = cross;
    edge.excess = 2 * (tangent * ATAN_SERIES(REAL, tangent2));
    edge.arc = fma(length, asine, length);
    edge.middle = fma(sum, (REAL2)(share), -e * half_fall) * outwards;
    edge.rise = fma(-sinks, outwards, lift);
    edge.weight = fma(fma(asine, lift, asine + lift), inverse, -both);
    return edge;
}

inline arc_t measure_arc(corner_t from, corner_t to)
{
    const REAL2 p = from.p, q = to.p;
    const REAL cross = difference_of_products(p.s0, q.s1, p.s1, q.s0);
    if (from.p2 <= SHORT_REACH2 && to.p2 <= SHORT_REACH2)
        return measure_short_arc(from, to, cross);
    arc_t edge;
    const REAL lp = sqrt(1 + from.p2), lq = sqrt(1 + to.p2), cosine = 1 + dot(p, q);
    const REAL2 e = q - p;
    edge.cross = cross;
    const REAL height = sqrt(dot(e, e) + cross * cross); /* |v x w| */
    edge.excess = 2 * atan(cross / (lp * lq + lp + lq + cosine));
    edge.arc = atan2(height, cosine);
    const REAL2 middle = (p * lq + q * lp) / (lp + lq);
    const REAL m2 = dot(middle, middle), lm = sqrt(1 + m2);
    edge.middle = middle / lm;
    edge.rise = -m2 / (lm * (1 + lm));
    /* A short edge of a large cell has no digits to lose here: the other terms of the sum are large. */
    edge.weight = height > 0 ? edge.arc / height - 1 : 1 / (lp * lq) - 1;
    return edge;
}

/* The vector from the site at x to the middle of an edge. */
inline void middle_of_arc(const REAL *x, const arc_t *edge, REAL *d)
{
    EACH_AXIS (a)
        d[a] = fma(x[3 + a], edge->middle.s0, fma(x[6 + a], edge->middle.s1, edge->rise * x[a]));
}

/* Length and middle of the face from p to q of the cell at x, relative to it. */
inline REAL measure_arc_face(const REAL *x, REAL2 p, REAL2 q, REAL *middle)
{
    const arc_t edge = measure_arc(corner_of_arc(p), corner_of_arc(q));
    middle_of_arc(x, &edge, middle);
    return edge.arc;
}

/* The integral of the position over a cell is half the sum over its edges of arc n, n being the unit normal of the
   plane of the edge (Gauss). Its tangential part, relative to the generator, follows from the differences of the terms
   from v x w, whose sum is zero: small cells lose no digits. The centroid is its direction. Second moments, along the
   tangents, are those of the polygon in the tangent plane, relative to its own area: exact for small cells. */
inline void measure_sphere_cell(const measures_t *to, int i, const int *faces, int n, global const REAL *points,
                                const REAL *lower, const REAL *upper)
{
    SITE(x, i, points);
    const int start = to->starts[i];
    moments_t moments = {0, 0, 0, 0, 0, 0};
    REAL area = 0, radial = 0, far2 = 0, d[3];
    REAL2 tangential = 0;
    if (n >= 3) {
        const REAL2 origin = corner(i, x, faces[n - 1], faces[0], points, lower, upper);
        const corner_t last = corner_of_arc(origin);
        corner_t from = last;
        for (int k = 0; k < n; ++k) {
            const corner_t next =
                k == n - 1 ? last : corner_of_arc(corner(i, x, faces[k], faces[k + 1], points, lower, upper));
            const REAL2 p = from.p, q = next.p;
            const arc_t edge = measure_arc(from, next);
            add_triangle(&moments, p, q);
            area += edge.excess;
            far2 = fmax(far2, next.p2);
            tangential += edge.weight * (REAL2)(p.s1 - q.s1, q.s0 - p.s0);
            radial += (1 + edge.weight) * edge.cross;
            middle_of_arc(x, &edge, d);
            to->neighbors[start + k] = faces[k];
            to->face_measures[start + k] = edge.arc;
            EACH_AXIS (a)
                to->face_centroids[3 * (start + k) + a] = d[a];
            from = next;
        }
    }
    on_sphere(x, radial > 0 ? tangential / radial : (REAL2)(0), d);
    to->volumes[i] = area;
    write_reach(to, i, far2);
    EACH_AXIS (a)
        to->offsets[3 * i + a] = d[a];
    const REAL3 m = second_moments(&moments);
    to->covariances[3 * i] = m.s0;
    to->covariances[3 * i + 1] = m.s1;
    to->covariances[3 * i + 2] = m.s2;
}
