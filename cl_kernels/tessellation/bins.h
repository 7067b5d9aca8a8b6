/* Hierarchical bins. Grid 0 covers the domain. A bin with many generators is divided by a finer grid, and so on:
   a leaf holds a few generators, however graded the set is. The bins of a grid are stored row by row, and the
   generators of a divided bin stay in its range. So the generators in neighboring bins of a row are contiguous.

   grid_frames[g]  origin (DIM), 1 / edge of a bin
   grid_shapes[g]  (first bin, bins along x, y, z); one more entry behind the last bin marks its end
   bins[b]         (first item, next grid): bin b holds items [bins[b].s0, bins[b + 1].s0); it is divided, by grid
                   bins[b].s1, if bins[b + 1].s1 differs */
#include "geometry/weights.h"

#define FRAME REAL4
#define FRAME_INVERSE(f) ((f).s3)
#define BIN_ARGS global const int2 *bins, global const FRAME *grid_frames, global const int4 *grid_shapes
#define BINS bins, grid_frames, grid_shapes

/* Bin index along one axis. It is monotone in x, also after rounding: a range of x covers its bins. A NaN goes to bin
   0, so that no index leaves the grid. */
inline int axis_bin(REAL x, REAL origin, REAL inverse, int side)
{
    const REAL t = (x - origin) * inverse;
    /* The comparison in REAL keeps far-away x from overflowing the int. */
    return t > 0 ? (t >= (REAL)side ? side - 1 : (int)t) : 0;
}

/* Bound of the distance of a generator from its bin, along one axis, for x near the bin and the first grid starting at
   `start`. Positions are binned with round-off, and each level adds one rounding to the origin of its grid: at most 10
   in all. */
inline REAL bin_noise(REAL x, REAL start)
{
    return 16 * REAL_EPS * (fabs(x) + fabs(start));
}

/* The same bound as a share of the edge of the bin, for x far from the bin. */
#define BIN_SHARE (64 * REAL_EPS + R(1e-6))

/* Lower bound of the distance of a row of bins from y, less `slack`. */
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
