#include "opencl/real.h"

/* How deep beyond the bisector with the neighbor at x + d, times |d|, a vertex must lie to be cut off: deeper than
   what rounds in the vertex, and than what rounded in the positions of generators in the unit box, unless generators
   are so near each other that they must differ by less. Cells of a lattice are thus not shredded. */
#if IS_DOUBLE
#define FINEST R(4e-11)
#else
#define FINEST R(2e-5)
#endif

inline REAL noise_length(REAL distance)
{
    return 4 * REAL_EPS * distance + fmin(4 * REAL_EPS, FINEST * distance);
}
