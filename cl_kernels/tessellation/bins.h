/* Hierarchical bins. Grid 0 covers the domain; a bin that holds many generators is divided by a grid of its own, and so
   on, so that a leaf holds a few generators however the set is graded. Within a grid the bins lie row by row, and what
   a divided bin holds stays in its place: the generators in neighboring bins of a row are one run of memory.

   grid_frames[g]  origin (DIM), 1 / edge of a bin
   grid_shapes[g]  (first bin, bins along x, y, z); behind its bins a grid has one more entry, which only ends the last
   bins[b]         (first item, next grid): bin b holds the items up to those of bin b + 1, and is divided, by grid
                   bins[b].s1, if that of bin b + 1 is another */
#include "opencl/real.h"

#define FRAME REAL4
#define FRAME_INVERSE(f) ((f).s3)

/* Bin index along one axis: monotone in x also after rounding, so that a range of x covers its bins. A NaN is put into
   bin 0: an index must not leave the grid. */
inline int axis_bin(REAL x, REAL origin, REAL inverse, int side)
{
    const REAL t = (x - origin) * inverse;
    /* The comparison in REAL keeps far-away x from overflowing the int. */
    return t > 0 ? (t >= (REAL)side ? side - 1 : (int)t) : 0;
}

/* By how much what is in a bin may lie outside of it, along an axis, where x is near it and the first grid begins at
   `start`: positions are put into bins with rounding, and a grid begins where the bin was that it divides, give or take
   a rounding at each level. They add up to 10. */
inline REAL bin_noise(REAL x, REAL start)
{
    return 16 * REAL_EPS * (fabs(x) + fabs(start));
}

/* Share of a bin's edge by which it may be off, too, where it is not near x. */
#define BIN_SHARE (64 * REAL_EPS + R(1e-6))

/* How far a row of bins is from y, give or take `slack`: no more than it is. */
inline REAL row_distance(REAL y, REAL origin, REAL edge, int row, REAL slack)
{
    const REAL below = origin + row * edge - y;
    const REAL distance = (below > 0 ? below : -below - edge) - slack;
    return distance > 0 ? distance : 0;
}

/* Bin of generator x in one grid. */
inline int bin_in_grid(global const REAL *x, FRAME frame, int4 shape)
{
    const REAL inverse = FRAME_INVERSE(frame);
    const int ix = axis_bin(x[0], frame.s0, inverse, shape.s1);
    const int iy = axis_bin(x[1], frame.s1, inverse, shape.s2);
#if DIM == 2
    return shape.s0 + iy * shape.s1 + ix;
#else
    const int iz = axis_bin(x[2], frame.s2, inverse, shape.s3);
    return shape.s0 + (iz * shape.s2 + iy) * shape.s1 + ix;
#endif
}
