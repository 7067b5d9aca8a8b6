#include "opencl/real.h"

/* Note that the corners u and w are one vertex. What is read is not written meanwhile: labels go from `old` to `new`,
   which begins as its copy. */
inline bool join(global const int *old, global int *new, int u, int w)
{
    const int a = old[u], b = old[w];
    if (a == b)
        return false;
    atomic_min(new + (a > b ? u : w), min(a, b));
    atomic_min(new + max(a, b), min(a, b));
    return true;
}
