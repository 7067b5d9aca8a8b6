/* The edges of a polygonal domain in uniform bins, for all that moves: which edge does a generator's way cross first?

   edge_frame   origin (2), 1 / edge of a bin, how far beyond an edge a generator may be that was put on it
   edge_shape   bins along x, y
   edge_starts  (bins + 1) first of the edges that pass through each bin, row by row
   edge_ends    both ends of each edge, the domain on the left */
#include "opencl/real.h"

#define DOMAIN_ARGS                                                                                                    \
    const REAL4 box_lower, const REAL4 box_upper, const REAL4 edge_frame, const int4 edge_shape,                       \
        global const int *edge_starts, global const REAL4 *edge_ends
#define DOMAIN box_lower, box_upper, edge_frame, edge_shape, edge_starts, edge_ends

/* Generators come no nearer to the boundary than this, so that no rounding carries them out. Those that the caller has
   put on it, or on it but for rounding, may leave it inwards. */
#define OFF_EDGE (2 * REAL_EPS)
#define BEHIND edge_frame.s3

/* Where the way from x to y, t = 0 to 1, leaves the domain first, and over which edge (a place in edge_ends); 2 if it
   does not. Corners are seen by both their edges with the same numbers, so that no way slips through between them. */
inline REAL leaves_over(const REAL *x, const REAL *y, int *edge, DOMAIN_ARGS)
{
    const REAL2 from = (REAL2)(x[0], x[1]), way = (REAL2)(y[0], y[1]) - from;
    const REAL2 least = fmin(from, from + way), most = fmax(from, from + way);
    const int left = clamp((int)floor((least.s0 - edge_frame.s0) * edge_frame.s2), 0, edge_shape.s0 - 1);
    const int right = clamp((int)floor((most.s0 - edge_frame.s0) * edge_frame.s2), 0, edge_shape.s0 - 1);
    const int bottom = clamp((int)floor((least.s1 - edge_frame.s1) * edge_frame.s2), 0, edge_shape.s1 - 1);
    const int top = clamp((int)floor((most.s1 - edge_frame.s1) * edge_frame.s2), 0, edge_shape.s1 - 1);
    REAL first = 2;
    /* Of a corner at x: the edges that end and begin there, and whether y lies beyond them. */
    REAL2 before = 0, after = 0;
    bool past_before = false, past_after = false;
    for (int row = bottom; row <= top; ++row) {
        /* The bins of a row are one run of edges. */
        const int begin = edge_starts[row * edge_shape.s0 + left], end = edge_starts[row * edge_shape.s0 + right + 1];
        for (int k = begin; k < end; ++k) {
            const REAL2 a = edge_ends[k].s01 - from, b = edge_ends[k].s23 - from, e = b - a;
            const REAL length = sqrt(dot(e, e));
            const REAL here = a.s0 * e.s1 - a.s1 * e.s0 - OFF_EDGE * length; /* e x (x - a): positive inside */
            const REAL there = here + e.s0 * way.s1 - e.s1 * way.s0;
            const REAL side_a = way.s0 * a.s1 - way.s1 * a.s0, side_b = way.s0 * b.s1 - way.s1 * b.s0;
            if (there <= 0 && there < here && here > -BEHIND * length && (side_a < 0 ? side_b >= 0 : side_b <= 0)) {
                const REAL t = fmax(here, 0) / (fmax(here, 0) - there);
                if (t < first) {
                    first = t;
                    *edge = k;
                }
            }
            if (fmin(dot(a, a), dot(b, b)) <= BEHIND * BEHIND) {
                const bool ends = dot(b, b) <= dot(a, a), past = there <= 0 && there < here;
                before = ends ? e : before;
                after = ends ? after : e;
                past_before = ends ? past : past_before;
                past_after = ends ? past_after : past;
                if (past && first > 1)
                    *edge = k;
            }
        }
    }
    /* A generator in the tip of a spit may lie beyond both edges, but for rounding: no way from there crosses them. */
    const REAL turn = before.s0 * after.s1 - before.s1 * after.s0;
    if (first > 1 && (turn > 0 ? past_before || past_after : turn < 0 && past_before && past_after))
        first = 0;
    return first;
}

inline REAL leaves_at(const REAL *x, const REAL *y, DOMAIN_ARGS)
{
    int edge;
    return leaves_over(x, y, &edge, DOMAIN);
}

/* Where a generator that is to go from x to y ends: if its way leads out of the domain, half-way to the boundary. */
inline void keep_inside(const REAL *x, REAL *y, DOMAIN_ARGS)
{
    const REAL t = leaves_at(x, y, DOMAIN);
    if (t <= 1)
        EACH_AXIS(a)
    y[a] = x[a] + t / 2 * (y[a] - x[a]);
}

/* The same, but a generator that would leave comes back from the edge, if that is not over another one. */
inline void reflect_inside(const REAL *x, REAL *y, DOMAIN_ARGS)
{
    int edge;
    if (leaves_over(x, y, &edge, DOMAIN) > 1)
        return;
    const REAL2 a = edge_ends[edge].s01, e = edge_ends[edge].s23 - a;
    const REAL beyond = ((y[0] - a.s0) * e.s1 - (y[1] - a.s1) * e.s0) / dot(e, e);
    REAL back[2] = {y[0] - 2 * beyond * e.s1, y[1] + 2 * beyond * e.s0};
    if (leaves_at(x, back, DOMAIN) > 1) {
        y[0] = back[0];
        y[1] = back[1];
    } else {
        keep_inside(x, y, DOMAIN);
    }
}
