#include "common/domain.h"

/* From a mesh for 2h to one for h: a new generator at the middle of every Delaunay edge, which carries a regular lattice
   over to one twice as fine. Edges across faces of no length are left out. The wall is not a neighbour, so that cells
   along it would be left alone: each gets one new generator between its generator and the wall. */

/* A pair is counted once, by its lower index. */
inline bool has_middle(int i, int j, REAL measure, REAL volume)
{
    const REAL length = DIM == 2 ? sqrt(volume) : cbrt(volume);
    return j > i && measure > SHORT_FACE * (DIM == 2 ? length : length * length);
}

/* Per generator i: how many new generators it brings. */
kernel void count_children(const int size, global const int *starts, global const int *neighbours, global const REAL *face_measures,
                           global const REAL *volumes, global int *counts)
{
    WORK_ITEM(i);
    int count = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbours[k];
        count += j < 0 || has_middle(i, j, face_measures[k], volumes[i]);
    }
    counts[i] = count;
}

/* Per generator i: write itself to row i of `finer` and its new generators behind row n. firsts are the prefix sums of
   the counts; h is the size on the new level. */
kernel void place_children(const int size, global const int *starts, global const int *neighbours, global const REAL *face_measures,
                           global const REAL *volumes, global const REAL *points, global const REAL *h, const int n,
                           DOMAIN_ARGS, global const int *firsts, global REAL *finer)
{
    WORK_ITEM(i);
    BOX_CORNERS(lower, upper);
    for (int a = 0; a < DIM; ++a)
        finer[DIM * i + a] = points[DIM * i + a];
    global REAL *child = finer + DIM * (n + firsts[i]);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbours[k];
        if (j < 0) {
            const int wall = -1 - j, axis = wall / 2;
            const REAL level = wall % 2 ? upper[axis] : lower[axis];
            for (int a = 0; a < DIM; ++a)
                child[a] = points[DIM * i + a];
            /* Half a cell from the wall; not on its own parent where that stands on the wall. */
            const REAL gap = points[DIM * i + axis] - level;
            const REAL way = gap != 0 ? fmin(fabs(gap) / 2, h[i] / 4) : h[i] / 2;
            child[axis] = level + (wall % 2 ? -way : way);
        } else if (has_middle(i, j, face_measures[k], volumes[i])) {
            for (int a = 0; a < DIM; ++a)
                child[a] = points[DIM * i + a] + DIFFERENCE(a, points[DIM * i + a], points[DIM * j + a]) / 2;
        } else {
            continue;
        }
        child += DIM;
    }
}
