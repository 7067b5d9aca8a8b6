/* What a kernel that places generators has to know of the domain: DOMAIN_ARGS in its signature, DOMAIN to hand them
   on. One that only wants differences of positions has PERIOD_ARGS at the end of its signature, and hands PERIODS on:
   as arguments, so that kernels are built once for all periodic boxes. */
#include "opencl/real.h"

#ifdef PERIODIC
#define PERIOD_ARGS , const REAL4 periods
#define PERIODS , periods
#else
#define PERIOD_ARGS
#define PERIODS
#endif

#ifdef POLYGON
#include "geometry/edges.h"
#else
#define DOMAIN_ARGS const REAL4 box_lower, const REAL4 box_upper PERIOD_ARGS
#define DOMAIN box_lower, box_upper PERIODS
#endif

/* Corners of the box as arrays. */
#define BOX_CORNERS(lower, upper)                                                                                      \
    const REAL lower[4] = {box_lower.s0, box_lower.s1, box_lower.s2, box_lower.s3};                                    \
    const REAL upper[4] = {box_upper.s0, box_upper.s1, box_upper.s2, box_upper.s3}

#ifdef PERIODIC
/* Length of the period along axis a, in which positions lie in [0, period); 0 where there are walls. Positions and
   periods are multiples of eps in the unit box, so that differences are exact, whatever the image. */
#define PERIOD(a) ((a) == 0 ? periods.s0 : (a) == 1 ? periods.s1 : periods.s2)

inline REAL nearest_image(REAL d, REAL period)
{
    const REAL half_period = period / 2;
    return period > 0 ? (d > half_period ? d - period : (d < -half_period ? d + period : d)) : d;
}

/* The image in [0, period), on the grid of eps. */
inline REAL wrapped(REAL y, REAL period)
{
    y = (y - period * floor(y / period) + 1) - 1;
    return y >= period ? y - period : fmax(y, 0);
}
#else
#define PERIOD(a) 0
#define nearest_image(d, period) (d)
#define wrapped(y, period) (y)
#endif

/* Coordinate y along axis a, where an image that is beyond the seam is to stand for it in the domain. */
#define PLACED(a, y) (PERIOD(a) > 0 ? wrapped(y, PERIOD(a)) : (y))

/* The difference along axis a from one position to another: to its nearest image, where the axis is periodic. */
#define DIFFERENCE(a, from, to) nearest_image((to) - (from), PERIOD(a))

#ifndef POLYGON
/* Where a generator that is to go from x to y ends, in the domain: on the way, at a wall of a box; on the other side of
   a periodic one. */
inline void keep_inside(const REAL *x, REAL *y, DOMAIN_ARGS)
{
    BOX_CORNERS(lower, upper);
    EACH_AXIS(a)
    y[a] = PERIOD(a) > 0 ? wrapped(y[a], PERIOD(a)) : clamp(y[a], lower[a], upper[a]);
}

/* The same, but a generator that would leave comes back: so no two meet on a wall. Where h is larger than the domain,
   it goes no further than from one wall to the other, which leaves it inside. */
inline void reflect_inside(const REAL *x, REAL *y, DOMAIN_ARGS)
{
    BOX_CORNERS(lower, upper);
    EACH_AXIS(a)
    {
        if (PERIOD(a) > 0)
            continue;
        const REAL most = upper[a] - lower[a];
        y[a] = clamp(y[a], x[a] - most, x[a] + most);
        if (y[a] < lower[a])
            y[a] = 2 * lower[a] - y[a];
        if (y[a] > upper[a])
            y[a] = 2 * upper[a] - y[a];
    }
    keep_inside(x, y, DOMAIN);
}
#endif
