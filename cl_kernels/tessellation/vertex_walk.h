/* Walks around a vertex of a planar graph, from the corner of one cell to that of the next, by the graph alone.
   Corner k of a cell lies between its faces k - 1 and k. */

/* Largest number of steps of a walk. In a graph that is not that of a diagram a walk may never return to its start. */
#define MOST_AROUND 10000

/* Move from the corner before face *at of *cell to the corner of the next cell around the vertex: clockwise, across
   that face, or with `back` across the face before it. False, without a move, at a wall, at a cell without a row (an
   index of `size` or more), or, in an asymmetric graph, at a cell that does not list this one. */
inline bool walk(const int size, global const int *starts, global const int *neighbors, int *cell, int *at, bool back)
{
    const int first = starts[*cell], last = starts[*cell + 1] - 1;
    const int next = neighbors[!back ? *at : *at == first ? last : *at - 1];
    if (next < 0 || next >= size)
        return false;
    const int begin = starts[next], n = starts[next + 1] - begin;
    const int q = place_in_row(neighbors + begin, n, *cell);
    if (q == n)
        return false;
    *at = begin + (back ? q : q + 1 < n ? q + 1 : 0);
    *cell = next;
    return true;
}

/* The next corner of a walk from corner c of cell i around their vertex: clockwise and, after a wall, from c
   counter-clockwise. False at the end: at a wall or, in a symmetric graph, at the start. */
inline bool walk_on(const int size, global const int *starts, global const int *neighbors, int i, int c, int *cell,
                    int *at, bool *back)
{
    if (!*back) {
        if (walk(size, starts, neighbors, cell, at, false))
            return *at != c;
        *back = true;
        *cell = i;
        *at = c;
    }
    return walk(size, starts, neighbors, cell, at, true);
}

/* Whether the walk around one end of face k of cell i passes its other end. In a diagram this happens only if two faces
   cross: with round-off, both pairs of four nearly cocircular generators may become neighbors. */
inline bool is_loop(const int size, global const int *starts, global const int *neighbors, int i, int k)
{
    const int other = k + 1 < starts[i + 1] ? k + 1 : starts[i];
    const int most = min(starts[size], MOST_AROUND);
    int cell = i, at = k, steps = 0;
    bool back = false;
    while (steps++ < most && walk_on(size, starts, neighbors, i, k, &cell, &at, &back))
        if (at == other)
            return true;
    return false;
}
