#include "opencl/real.h"

/* Loops of faces in 3D, once both cells of every face see the same (agreement.cl), for output. Views, their turns, and
   `reduced` as there. */

/* Per generator i: the lengths of the loops of its faces k, 0 for those that are nothing; marks the labels in use. */
kernel void measure_loops(const int size, global const int *starts, global const int *view_starts,
                          global const int *turn_starts, global const int *reduced, global const int *reduced_counts,
                          global int *loop_counts, global int *used)
{
    WORK_ITEM(i);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int view = view_starts[i] + k - starts[i];
        loop_counts[k] = reduced_counts[view];
        for (int s = 0; s < reduced_counts[view]; ++s)
            atomic_or(used + reduced[turn_starts[view] + s], 1);
    }
}

/* Per generator i: the loops, in the numbers of vertices; ids are the prefix sums of `used`. */
kernel void write_loops(const int size, global const int *starts, global const int *view_starts,
                        global const int *turn_starts, global const int *reduced, global const int *ids,
                        global const int *loop_starts, global int *loops)
{
    WORK_ITEM(i);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int view = view_starts[i] + k - starts[i], begin = loop_starts[k], n = loop_starts[k + 1] - begin;
        for (int s = 0; s < n; ++s)
            loops[begin + s] = ids[reduced[turn_starts[view] + s]];
    }
}

/* Per corner u: the position of its vertex (v, 3), if it is the one that gives it. */
kernel void place_vertices(const int size, global const REAL *points, const REAL4 box_lower, const REAL4 box_upper,
                           global const int *owners, global const REAL *corners, global const int *labels,
                           global const int *chosen, global const int *ids, global REAL *vertices)
{
    WORK_ITEM(u);
    const REAL lower[3] = {box_lower.s0, box_lower.s1, box_lower.s2};
    const REAL upper[3] = {box_upper.s0, box_upper.s1, box_upper.s2};
    const int label = labels[u], id = ids[label];
    if (chosen[label] == u && id != ids[label + 1])
        for (int a = 0; a < 3; ++a)
            vertices[3 * id + a] = clamp(points[3 * owners[u] + a] + corners[3 * u + a], lower[a], upper[a]);
}
