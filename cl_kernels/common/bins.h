/* Hierarchical bins. Grid 0 covers the domain; a bin that holds many generators is divided by a grid of its own, and so
   on, so that a leaf holds a few generators however the set is graded. Within a grid the bins lie row by row, and what
   a divided bin holds stays in its place: the generators in neighbouring bins of a row are one run of memory.

   grid_frames[g]  origin (DIM), 1 / edge of a bin
   grid_shapes[g]  (first bin, bins along x, y, z); behind its bins a grid has one more entry, which only ends the last
   bins[b]         (first item, next grid): bin b holds the items up to those of bin b + 1, and is divided, by grid
                   bins[b].s1, if that of bin b + 1 is another */
#include "common/real.h"

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
