/* Walks around a vertex of a graph in the plane, from the corner of one cell to that of the next, by the graph alone.
   Corner k of a cell lies between its faces k - 1 and k. */

/* Move from the corner before face *at of *cell to the same one of the next cell around the vertex: clockwise, beyond
   that face, or `back`, beyond the face before it. False, and nowhere, where that is a wall or leads to a cell without
   a row: one of `size` or more, or, in a graph that is not symmetric, one that does not list this one. */
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

/* The next corner of a walk from corner c of cell i around their vertex: clockwise and, where a wall ends that, from c
   on the other way. False at its end: at a wall or, in a symmetric graph, where it began. */
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

/* Does the walk around one end of face k of cell i come by its other end? No face of a diagram does that. Two that
   cross do: each is seen from both sides, where rounding has let one pair of four nearly cocircular generators decide
   otherwise than the other pair. */
inline bool is_loop(const int size, global const int *starts, global const int *neighbors, int i, int k)
{
    const int other = k + 1 < starts[i + 1] ? k + 1 : starts[i];
    const int most = starts[size]; /* steps: rounding may leave a graph that is not symmetric */
    int cell = i, at = k, steps = 0;
    bool back = false;
    while (steps++ < most && walk_on(size, starts, neighbors, i, k, &cell, &at, &back))
        if (at == other)
            return true;
    return false;
}
