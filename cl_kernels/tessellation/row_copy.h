#include "opencl/real.h"

/* Per generator i: copy its row of the new graph over the previous graph. */
kernel void put_graph(const int size, global const int *new_starts, global const int *new_neighbors, global int *starts,
                      global int *neighbors)
{
    WORK_ITEM(i);
    const int end = new_starts[i + 1];
    starts[i + 1] = end;
    if (i == 0)
        starts[0] = 0;
    for (int k = new_starts[i]; k < end; ++k)
        neighbors[k] = new_neighbors[k];
}
