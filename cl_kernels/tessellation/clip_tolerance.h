#include "geometry/weights.h"

/* Least distance of a removed vertex beyond the bisector with the neighbor at x + d, times |d|. It exceeds the
   round-off of the vertex and that of positions in the unit box, unless the generators are nearer than that. So the
   cells of a lattice are not cut into slivers. */
#if IS_DOUBLE
#define FINEST R(4e-11)
#else
#define FINEST R(2e-5)
#endif

inline REAL noise_length(REAL distance)
{
    return 4 * REAL_EPS * distance + fmin(4 * REAL_EPS, FINEST * distance);
}
