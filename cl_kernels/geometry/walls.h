/* The surface of a solid: triangles of smooth patches, in uniform bins.

   wall_frame      origin (3), 1 / width of a bin
   wall_shape      number of bins along x, y, z
   wall_starts     (bins + 1) first of the triangles in each bin, x fastest
   wall_listed     the triangles
   wall_clear      (bins) steps to the next bin with a triangle
   wall_corners    (3 t) corners, counter-clockwise from outside
   wall_kinds      (t) patch; kinds of the edges from corner s to s + 1 and of the corners, two bits each: 0 within a
                   patch, 1 on a convex crease, 2 on a concave one */
#include "opencl/real.h"

#define WALL_ARGS                                                                                                      \
    const REAL4 wall_frame, const int4 wall_shape, global const int *wall_starts, global const int *wall_listed,       \
        global const uchar *wall_clear, global const REAL4 *wall_corners, global const int2 *wall_kinds
#define WALL wall_frame, wall_shape, wall_starts, wall_listed, wall_clear, wall_corners, wall_kinds

#define EDGE_KIND(kinds, s) ((kinds) >> (2 * (s)) & 3)
#define CORNER_KIND(kinds, s) ((kinds) >> (6 + 2 * (s)) & 3)
#define CONCAVE_CREASE 2

inline REAL4 cross_of_walls(REAL4 a, REAL4 b)
{
    return (REAL4)(a.s1 * b.s2 - a.s2 * b.s1, a.s2 * b.s0 - a.s0 * b.s2, a.s0 * b.s1 - a.s1 * b.s0, 0);
}

/* The bin of x; the nearest one outside of the bins. */
inline int4 wall_bin(REAL4 x, REAL4 frame, int4 shape)
{
    const REAL4 at = (x - frame) * frame.s3;
    return (int4)(clamp((int)floor(at.s0), 0, shape.s0 - 1), clamp((int)floor(at.s1), 0, shape.s1 - 1),
                  clamp((int)floor(at.s2), 0, shape.s2 - 1), 0);
}

/* EACH_TRIANGLE(t, lower, upper) ...: the triangles in the bins from one corner of a box to the other; one that is in
   several bins comes several times. */
#define EACH_TRIANGLE(t, lower, upper)                                                                                 \
    const int4 low_bin_##t = wall_bin(lower, wall_frame, wall_shape);                                                  \
    const int4 high_bin_##t = wall_bin(upper, wall_frame, wall_shape);                                                 \
    for (int z_##t = low_bin_##t.s2; z_##t <= high_bin_##t.s2; ++z_##t)                                                \
        for (int y_##t = low_bin_##t.s1; y_##t <= high_bin_##t.s1; ++y_##t)                                            \
            for (int row_##t = (z_##t * wall_shape.s1 + y_##t) * wall_shape.s0,                                        \
                     k_##t = wall_starts[row_##t + low_bin_##t.s0],                                                    \
                     end_##t = wall_starts[row_##t + high_bin_##t.s0 + 1], t = 0;                                      \
                 k_##t < end_##t && (t = wall_listed[k_##t], true); ++k_##t)

/* Parameter in [0, 1] at which the path from x to x + way crosses triangle t from inside; 2 if it does not. Triangles
   are a little larger than they are, so that no path passes between two of them. */
inline REAL crossing_of(int t, REAL4 x, REAL4 way, global const REAL4 *wall_corners)
{
    const REAL4 a = wall_corners[3 * t] - x, ab = wall_corners[3 * t + 1] - x - a, ac = wall_corners[3 * t + 2] - x - a;
    const REAL4 normal = cross_of_walls(ab, ac);
    const REAL speed = dot(way, normal);
    if (!(speed > 0))
        return 2;
    const REAL4 turned = cross_of_walls(way, a);
    const REAL u = -dot(ac, turned), v = dot(ab, turned), slack = -R(1e-3) * speed;
    const REAL gone = dot(a, normal), behind = -16 * REAL_EPS * sqrt(dot(normal, normal));
    if (u < slack || v < slack || speed - u - v < slack || gone > speed || gone < behind)
        return 2;
    return fmax(gone, R(0)) / speed;
}

/* The least such parameter of all triangles. */
inline REAL exit_through_wall(REAL4 x, REAL4 way, WALL_ARGS)
{
    REAL first = 2;
    EACH_TRIANGLE (t, fmin(x, x + way), fmax(x, x + way)) {
        const REAL at = crossing_of(t, x, way, wall_corners);
        first = fmin(first, at);
    }
    return first;
}
