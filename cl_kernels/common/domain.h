/* What a kernel that places generators has to know of the domain: DOMAIN_ARGS in its signature, DOMAIN to hand them on. */
#include "common/real.h"

#define DOMAIN_ARGS const REAL4 box_lower, const REAL4 box_upper
#define DOMAIN box_lower, box_upper

/* Corners of the box as arrays. */
#define BOX_CORNERS(lower, upper) \
    const REAL lower[4] = {box_lower.s0, box_lower.s1, box_lower.s2, box_lower.s3}; \
    const REAL upper[4] = {box_upper.s0, box_upper.s1, box_upper.s2, box_upper.s3}

/* The difference along axis a from one position to another. */
#define DIFFERENCE(a, from, to) ((to) - (from))

/* Where a generator that is to go from x to y ends, in the domain: on the way, at a wall of a box. */
inline void keep_inside(const REAL *x, REAL *y, DOMAIN_ARGS)
{
    BOX_CORNERS(lower, upper);
    EACH_AXIS(a)
        y[a] = clamp(y[a], lower[a], upper[a]);
}

/* The same, but a generator that would leave comes back: so no two meet on a wall. */
inline void reflect_inside(const REAL *x, REAL *y, DOMAIN_ARGS)
{
    BOX_CORNERS(lower, upper);
    EACH_AXIS(a) {
        if (y[a] < lower[a])
            y[a] = 2 * lower[a] - y[a];
        if (y[a] > upper[a])
            y[a] = 2 * upper[a] - y[a];
    }
    keep_inside(x, y, DOMAIN);
}
