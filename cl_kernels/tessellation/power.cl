#include "geometry/weights.h"

/* Per generator i: its row with its weight (see weights.h). */
kernel void attach_weights(const int size, global const REAL *points, global const REAL *weights, global REAL *weighted)
{
    WORK_ITEM(i);
    for (int a = 0; a < DIM; ++a)
        weighted[(DIM + 1) * i + a] = points[DIM * i + a];
    weighted[(DIM + 1) * i + DIM] = weights[i];
}
