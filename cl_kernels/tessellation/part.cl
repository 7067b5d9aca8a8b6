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

/* values[n + g] = owned[rows[g]] for each ghost g whose owner is in this part: parts[g] = part, or part < 0 if all are.
   Rows of values have `words` 32-bit words of any type. A ghost without owner, rows[g] < 0, keeps its values. One
   work-item per ghost. */
kernel void forward_values(const int size, const int n, global const int *rows, global const int *parts, const int part,
                           const int words, global const uint *owned, global uint *values)
{
    WORK_ITEM(g);
    const int i = rows[g];
    if (i < 0 || (part >= 0 && parts[g] != part))
        return;
    for (int w = 0; w < words; ++w)
        values[words * (n + g) + w] = owned[words * i + w];
}
