/* Hierarchical bins. Level 0 is a grid of `side`^DIM bins over the unit cube; a bin that holds many generators is
   divided by a grid of its own, and so on, so that a leaf holds a few generators however the set is graded.
   Within a grid the bins lie in Morton order, so that generators sorted by bin follow one Morton curve.

   grid_frames[g]  origin (DIM), 1 / edge of a bin
   grid_shapes[g]  (first bin, bins per axis)
   bins[b]         (first item, count), or (-1 - g, count) where grid g divides the bin */
#include "common/real.h"

#if DIM == 2
#define FRAME REAL4 /* ox, oy, inverse edge, unused */
#define FRAME_INVERSE(f) ((f).s2)
#else
#define FRAME REAL4 /* ox, oy, oz, inverse edge */
#define FRAME_INVERSE(f) ((f).s3)
#endif

/* Bin index along one axis: monotone in x also after rounding, so that a range of x covers its bins. */
inline int axis_bin(REAL x, REAL origin, REAL inverse, int side)
{
    const REAL t = (x - origin) * inverse;
    /* The comparison in REAL keeps far-away x from overflowing the int. */
    return t <= 0 ? 0 : (t >= (REAL)side ? side - 1 : (int)t);
}

#if DIM == 2
/* Bits of v at the even places. */
inline uint spread(uint v)
{
    v = (v | (v << 8)) & 0x00ff00ffu;
    v = (v | (v << 4)) & 0x0f0f0f0fu;
    v = (v | (v << 2)) & 0x33333333u;
    return (v | (v << 1)) & 0x55555555u;
}

inline int morton(int ix, int iy)
{
    return (int)(spread(ix) | (spread(iy) << 1));
}
#else
/* Bits of v at every third place. */
inline uint spread(uint v)
{
    v = (v | (v << 16)) & 0x030000ffu;
    v = (v | (v << 8)) & 0x0300f00fu;
    v = (v | (v << 4)) & 0x030c30c3u;
    return (v | (v << 2)) & 0x09249249u;
}

inline int morton(int ix, int iy, int iz)
{
    return (int)(spread(ix) | (spread(iy) << 1) | (spread(iz) << 2));
}
#endif

/* Bin of generator x in one grid. */
inline int bin_in_grid(global const REAL *x, FRAME frame, int2 shape)
{
    const REAL inverse = FRAME_INVERSE(frame);
    const int ix = axis_bin(x[0], frame.s0, inverse, shape.s1);
    const int iy = axis_bin(x[1], frame.s1, inverse, shape.s1);
#if DIM == 2
    return shape.s0 + morton(ix, iy);
#else
    return shape.s0 + morton(ix, iy, axis_bin(x[2], frame.s2, inverse, shape.s1));
#endif
}
