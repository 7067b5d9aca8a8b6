#include "opencl/real.h"

/* Per row i: owners in place of the ghosts, neighbors from number n on, that have one. */
kernel void name_owners(const int size, const int n, global const int *owners, global const int *starts,
                        global const int *neighbors, global int *named)
{
    WORK_ITEM(i);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int row = neighbors[k], owner = row < n ? row : owners[row - n];
        named[k] = owner < 0 ? row : owner;
    }
}

/* marks[g] = 1 for ghosts g that are neighbors of one of the first `size` generators. One work-item per generator. */
kernel void mark_ghosts(const int size, global const int *starts, global const int *neighbors, global int *marks)
{
    WORK_ITEM(i);
    for (int k = starts[i]; k < starts[i + 1]; ++k)
        if (neighbors[k] >= size)
            marks[neighbors[k] - size] = 1;
}

/* values[n + g] = values[rows[g]] for each ghost g. Rows of values have `words` 32-bit words of any type. A ghost
   without owner, rows[g] < 0, keeps its values. One work-item per ghost. */
kernel void forward_values(const int size, const int n, global const int *rows, const int words, global uint *values)
{
    WORK_ITEM(g);
    const int i = rows[g];
    for (int w = 0; w < words && i >= 0; ++w)
        values[words * (n + g) + w] = values[words * i + w];
}
