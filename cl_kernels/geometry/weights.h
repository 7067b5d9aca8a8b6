/* Weights of generators, for power diagrams: with -DWEIGHTED each row of generators ends with the weight w. The plane
   between the cells of i and j is { x_i + y : y.d = level } with d = x_j - x_i and level = (d.d - (w_j - w_i)) / 2,
   the bisector for equal weights; for the sphere see site.h. Otherwise weights are the constant 0, and compilers leave
   them out. */
#include "opencl/real.h"

#ifdef WEIGHTED
#define STRIDE (DIM + 1)
#define WEIGHT(points, j) (points)[STRIDE * (j) + DIM]

/* Weights in single precision as integers in the same order, so that maxima do not depend on the order of work-items. A
   key is that of its weight, rounded up. */
inline int key_of_weight(REAL weight)
{
    const float w = (float)weight;
    const int bits = as_int(w + fabs(w) * FLT_EPSILON);
    return bits >= 0 ? bits : bits ^ INT_MAX;
}

inline float weight_of_key(int key)
{
    return as_float(key >= 0 ? key : key ^ INT_MAX);
}
#else
#define STRIDE DIM
#define WEIGHT(points, j) R(0)
#endif

/* The position of generator j in the plane. */
#define PLACE(points, j) ((REAL2)((points)[STRIDE * (j)], (points)[STRIDE * (j) + 1]))
