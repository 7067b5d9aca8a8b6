#include "tessellation/corner.h"

#include "tessellation/vertex_walk.h"

/* Corners of cells and the vertices that they share. Corner k of cell i, with the index c = starts[i] + k, lies between
   its faces k - 1 and k. A walk from cell to cell visits all corners of one vertex; the least of them owns it. The walk
   uses the graph alone: it needs no tolerance and works for any number of cells at a vertex. */

/* Per generator i: owners[c] for each of its corners c. A walk that does not end sets `endless` to i + 1. */
kernel void find_vertex_owners(const int size, global const int *starts, global const int *neighbors,
                               global int *owners, global int *is_owner, global int *endless)
{
    WORK_ITEM(i);
    const int begin = starts[i], end = starts[i + 1], most = min(starts[size], MOST_AROUND);
    for (int c = begin; c < end; ++c) {
        int owner = c, cell = i, at = c, steps = 0;
        bool back = false;
        while (++steps < most && walk_on(size, starts, neighbors, i, c, &cell, &at, &back))
            owner = min(owner, at);
        if (steps == most && walk_on(size, starts, neighbors, i, c, &cell, &at, &back))
            atomic_max(endless, i + 1);
        owners[c] = owner;
        is_owner[c] = owner == c;
    }
}

/* Per generator i: cell_vertices[c] = index of the vertex at corner c; the owner writes its position in the frame of
   the box. ids are the prefix sums of is_owner. */
kernel void place_polygon_vertices(const int size, global const REAL *points, const REAL4 box_lower,
                                   const REAL4 box_upper, global const int *starts, global const int *neighbors,
                                   global const int *owners, global const int *ids, global int *cell_vertices,
                                   global REAL *vertices)
{
    WORK_ITEM(i);
    SITE(x, i, points);
    BOX_CORNERS(lower, upper);
    const int begin = starts[i], end = starts[i + 1];
    for (int c = begin; c < end; ++c) {
        const int v = ids[owners[c]];
        cell_vertices[c] = v;
        if (owners[c] == c) {
            const int previous = neighbors[c == begin ? end - 1 : c - 1];
            const REAL2 y = corner(i, x, previous, neighbors[c], points, lower, upper);
#ifdef SPHERE
            REAL d[3];
            on_sphere(x, y, d);
            EACH_AXIS (a)
                vertices[3 * v + a] = x[a] + d[a];
#else
            vertices[2 * v] = clamp(x[0] + y.s0, lower[0], upper[0]);
            vertices[2 * v + 1] = clamp(x[1] + y.s1, lower[1], upper[1]);
#endif
        }
    }
}
