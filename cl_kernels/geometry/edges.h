/* The edges of a polygonal domain in uniform bins. They tell which edge the path of a generator crosses first.

   edge_frame   origin (2), 1 / width of a bin, distance by which a generator on an edge may be outside
   edge_shape   number of bins along x, y
   edge_starts  (bins + 1) first of the edges that pass through each bin, row by row
   edge_ends    both ends of each listed edge, the domain on its left */
#include "opencl/real.h"

#define DOMAIN_ARGS                                                                                                    \
    const REAL4 box_lower, const REAL4 box_upper, const REAL4 edge_frame, const int4 edge_shape,                       \
        global const int *edge_starts, global const REAL4 *edge_ends
#define DOMAIN box_lower, box_upper, edge_frame, edge_shape, edge_starts, edge_ends

/* Least distance between a generator that moves and the boundary, so that round-off carries none outside. A generator
   that the caller puts on the boundary, or outside by round-off, may move inwards. */
#define OFF_EDGE (2 * REAL_EPS)
#define BEHIND edge_frame.s3

/* Parameter t in [0, 1] at which the path from x to y leaves the domain first, and the edge that it crosses (a place in
   edge_ends); 2 if it stays inside. Both edges at a corner use the same numbers for it: no path passes between them. */
inline REAL exit_over_edge(const REAL *x, const REAL *y, int *edge, DOMAIN_ARGS)
{
    const REAL2 from = (REAL2)(x[0], x[1]), path = (REAL2)(y[0], y[1]) - from;
    const REAL2 least = fmin(from, from + path), most = fmax(from, from + path);
    const int left = clamp((int)floor((least.s0 - edge_frame.s0) * edge_frame.s2), 0, edge_shape.s0 - 1);
    const int right = clamp((int)floor((most.s0 - edge_frame.s0) * edge_frame.s2), 0, edge_shape.s0 - 1);
    const int bottom = clamp((int)floor((least.s1 - edge_frame.s1) * edge_frame.s2), 0, edge_shape.s1 - 1);
    const int top = clamp((int)floor((most.s1 - edge_frame.s1) * edge_frame.s2), 0, edge_shape.s1 - 1);
    REAL first = 2;
    /* If x is at a corner: the edges that end and begin there, and whether y lies beyond them. */
    REAL2 before = 0, after = 0;
    bool past_before = false, past_after = false;
    for (int row = bottom; row <= top; ++row) {
        /* The edges in the bins of a row are contiguous. */
        const int begin = edge_starts[row * edge_shape.s0 + left], end = edge_starts[row * edge_shape.s0 + right + 1];
        for (int k = begin; k < end; ++k) {
            const REAL2 a = edge_ends[k].s01 - from, b = edge_ends[k].s23 - from, e = b - a;
            const REAL length = sqrt(dot(e, e));
            const REAL here = a.s0 * e.s1 - a.s1 * e.s0 - OFF_EDGE * length; /* e x (x - a): positive inside */
            const REAL there = here + e.s0 * path.s1 - e.s1 * path.s0;
            const REAL side_a = path.s0 * a.s1 - path.s1 * a.s0, side_b = path.s0 * b.s1 - path.s1 * b.s0;
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
    /* In the tip of a sharp corner round-off may put a generator beyond both edges: its path crosses neither. */
    const REAL turn = before.s0 * after.s1 - before.s1 * after.s0;
    if (first > 1 && (turn > 0 ? past_before || past_after : turn < 0 && past_before && past_after))
        first = 0;
    return first;
}

inline REAL exit_parameter(const REAL *x, const REAL *y, DOMAIN_ARGS)
{
    int edge;
    return exit_over_edge(x, y, &edge, DOMAIN);
}
