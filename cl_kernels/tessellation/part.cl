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

/* A number from 1 to 2 for the face between the generators with labels a and b, whichever comes first. */
inline REAL weight_of_face(int a, int b)
{
    uint h = as_uint(min(a, b)) * 2654435761u ^ as_uint(max(a, b)) * 2246822519u;
    h = (h ^ h >> 15) * 3266489917u;
    return 1 + (REAL)(h >> 16) / 65536;
}

/* sums[3 t ...] = the volumes of the generators t, t + size, ... of n; the weighted measures of their faces with
   ghosts, positive in the cell of the lower label; and those without signs. Over all parts the second sum is zero if
   each face has both sides. One work-item per t. */
kernel void sum_cells(const int size, const int n, global const int *starts, global const int *neighbors,
                      global const int *labels, global const FACE *face_measures, global const REAL *volumes,
                      global REAL *sums)
{
    WORK_ITEM(t);
    REAL volume = 0, signed_sum = 0, sum = 0;
    for (int i = t; i < n; i += size) {
        volume += volumes[i];
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            const int j = neighbors[k];
            if (j < n)
                continue;
            const REAL part = face_measures[k] * weight_of_face(labels[i], labels[j]);
            signed_sum += labels[i] < labels[j] ? part : -part;
            sum += part;
        }
    }
    sums[3 * t] = volume;
    sums[3 * t + 1] = signed_sum;
    sums[3 * t + 2] = sum;
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
