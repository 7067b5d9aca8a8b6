#define CLIP_SHARPLY 1
#include "common/polyhedron.h"

/* Vertices and face loops of a diagram in 3D, from its graph. Each cell is clipped once more, by its neighbours alone. Its
   vertices, the corners, are numbered cell by cell: corner u. The same point is a corner of every cell that meets
   there: corners are one vertex where an edge between them has no length, and where they lie at the same place of the
   face that two cells share. The least corner of a vertex gives it its label, the sharpest its position. Nearest corners of a face
   belong together whatever they round by, and so this holds where many cells meet in a point.

   starts, neighbours          the graph: faces k, in rows i
   corner_starts (n + 1,)      first corner of each cell
   turn_starts (m + 1,)        first turn of each face: its loop as its own cell sees it, counter-clockwise from outside
   turns (t,)                  corners */

/* The cell of generator i; false if there is not enough room. */
inline bool make_cell(cell_t *cell, int i, global const REAL *points, REAL4 lower, REAL4 upper,
                      global const int *starts, global const int *neighbours)
{
    const REAL4 x = (REAL4)(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0);
    start_cell(cell, x, lower, upper);
    return clip_by_row(cell, i, x, starts, neighbours, points) != CLIP_FULL;
}

/* The face of the cell with a label, or FACE_CAPACITY. */
inline int find_face(const cell_t *cell, int label)
{
    int f = next_face(cell->alive, 0);
    while (f < FACE_CAPACITY && cell->labels[f] != label)
        f = next_face(cell->alive, f + 1);
    return f;
}

inline int vertex_of(const cell_t *cell, int f)
{
    int v = 0;
    while (cell->faces[v].s0 != f && cell->faces[v].s1 != f && cell->faces[v].s2 != f)
        ++v;
    return v;
}

/* Per generator i: how many corners its cell has, and how many turns each of its faces. full[0] is set if a cell has more
   than FACE_CAPACITY faces. */
kernel void count_corners(const int size, global const REAL *points, const REAL4 box_lower, const REAL4 box_upper,
                          global const int *starts, global const int *neighbours, global int *corner_counts,
                          global int *turn_counts, global int *full)
{
    WORK_ITEM(i);
    cell_t cell;
    if (!make_cell(&cell, i, points, box_lower, box_upper, starts, neighbours)) {
        full[0] = 1;
        return;
    }
    corner_counts[i] = cell.n;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int f = find_face(&cell, neighbours[k]);
        int count = 0;
        if (f < FACE_CAPACITY) {
            const int first = vertex_of(&cell, f);
            int v = first;
            do {
                v = vertex_after(&cell, v, f);
                ++count;
            } while (v != first);
        }
        turn_counts[k] = count;
    }
}

/* How sharply the faces of vertex v determine it: the volume that their unit normals span, times d / (d + r) for each, as
   the bisector of generators d apart rounds by r / d of what they do at the distance r. */
inline REAL sharpness_of(const cell_t *cell, int v)
{
    const INDEX4 f = cell->faces[v];
    const int faces[3] = {f.s0, f.s1, f.s2};
    const REAL x = X(cell)[v], y = Y(cell)[v], z = Z(cell)[v];
    const REAL r = sqrt(x * x + y * y + z * z);
    REAL4 normals[3];
    REAL shares = 1;
    for (int k = 0; k < 3; ++k) {
        const REAL4 plane = cell->planes[faces[k]];
        const REAL d = sqrt(plane.s0 * plane.s0 + plane.s1 * plane.s1 + plane.s2 * plane.s2);
        normals[k] = plane / d;
        shares *= cell->labels[faces[k]] >= 0 ? d / (d + r) : 1;
    }
    const REAL4 c = cross_product(normals[1], normals[2]);
    const REAL span = normals[0].s0 * c.s0 + normals[0].s1 * c.s1 + normals[0].s2 * c.s2;
    return fabs(span) * shares;
}

/* Per generator i: its corners (c, 3), relative to x_i, how sharp each is, and turns. same[u] is the least corner of the cell that lies where
   corner u does, joined to it by edges of no length. */
kernel void list_corners(const int size, global const REAL *points, const REAL4 box_lower, const REAL4 box_upper,
                         global const int *starts, global const int *neighbours, global const int *corner_starts,
                         global const int *turn_starts, global REAL *corners, global float *sharpness, global int *same,
                         global int *turns)
{
    WORK_ITEM(i);
    cell_t cell;
    make_cell(&cell, i, points, box_lower, box_upper, starts, neighbours);
    const int base = corner_starts[i];
    const REAL least = 4 * noise_length(sqrt(cell.reach2));
    INDEX joined[VERTEX_CAPACITY];
    for (int v = 0; v < cell.n; ++v) {
        corners[3 * (base + v)] = X(&cell)[v];
        corners[3 * (base + v) + 1] = Y(&cell)[v];
        corners[3 * (base + v) + 2] = Z(&cell)[v];
        sharpness[base + v] = (float)sharpness_of(&cell, v);
        joined[v] = v;
    }
    bool changed = true;
    while (changed) {
        changed = false;
        for (int v = 0; v < cell.n; ++v) {
            const INDEX4 f = cell.faces[v];
            const int a[4] = {f.s0, f.s1, f.s2, f.s0};
            for (int e = 0; e < 3; ++e) {
                const int w = cell.at[a[e + 1] * FACE_CAPACITY + a[e]];
                if (joined[w] >= joined[v])
                    continue;
                const REAL dx = X(&cell)[w] - X(&cell)[v], dy = Y(&cell)[w] - Y(&cell)[v], dz = Z(&cell)[w] - Z(&cell)[v];
                if (dx * dx + dy * dy + dz * dz < least * least) {
                    joined[v] = joined[w];
                    changed = true;
                }
            }
        }
    }
    for (int v = 0; v < cell.n; ++v)
        same[base + v] = base + joined[v];
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int f = find_face(&cell, neighbours[k]);
        if (f == FACE_CAPACITY)
            continue;
        int v = vertex_of(&cell, f);
        for (int t = turn_starts[k]; t < turn_starts[k + 1]; ++t) {
            turns[t] = base + v;
            v = vertex_after(&cell, v, f);
        }
    }
}

/* Per generator i: twins[k], the same face in the neighbour's row (k for a wall), and partners[t] of its turns: the corner
   of the twin that lies nearest. */
kernel void match_corners(const int size, global const REAL *points, global const int *starts,
                          global const int *neighbours, global const REAL *corners, global const int *turn_starts,
                          global const int *turns, global int *twins, global int *partners)
{
    WORK_ITEM(i);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbours[k];
        int twin = k;
        REAL d[3] = {0, 0, 0};
        if (j >= 0) {
            twin = starts[j];
            while (twin < starts[j + 1] && neighbours[twin] != i)
                ++twin;
            twin = twin < starts[j + 1] ? twin : k;
            for (int a = 0; a < 3; ++a)
                d[a] = points[3 * j + a] - points[3 * i + a];
        }
        twins[k] = twin;
        for (int t = turn_starts[k]; t < turn_starts[k + 1]; ++t) {
            const int u = turns[t];
            int nearest = u;
            REAL least = REAL_MAX, widest = 0;
            for (int s = turn_starts[twin]; s < turn_starts[twin + 1] && twin != k; ++s) {
                const int w = turns[s];
                REAL r2 = 0;
                for (int a = 0; a < 3; ++a) {
                    const REAL r = corners[3 * w + a] + d[a] - corners[3 * u + a];
                    r2 += r * r;
                }
                widest = fmax(widest, r2);
                if (r2 < least) {
                    least = r2;
                    nearest = w;
                }
            }
            /* A corner that only one of the cells sees, where others meet in the middle of an edge, has no partner. */
            const REAL d2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
            const REAL noise = 64 * REAL_EPS + sqrt(REAL_EPS * d2);
            partners[t] = least < fmax(R(1e-6) * widest, noise * noise) ? nearest : u;
        }
    }
}

/* Note that the corners u and w are one vertex. What is read is not written meanwhile: labels go from `old` to `new`, which
   begins as its copy. */
inline bool join(global const int *old, global int *new, int u, int w)
{
    const int a = old[u], b = old[w];
    if (a == b)
        return false;
    atomic_min(new + (a > b ? u : w), min(a, b));
    atomic_min(new + max(a, b), min(a, b));
    return true;
}

/* Per corner u: pass on the least label to where it lies. */
kernel void spread_in_cells(const int size, global const int *same, global const int *old, global int *new,
                            global int *changed)
{
    WORK_ITEM(u);
    if (join(old, new, u, same[u]))
        changed[0] = 1;
    const int label = old[old[u]];
    if (label < old[u]) {
        atomic_min(new + u, label);
        changed[0] = 1;
    }
}

/* Per turn t: the same across the face. The least label of all is where this ends, in whatever order. */
kernel void spread_over_faces(const int size, global const int *turns, global const int *partners,
                              global const int *old, global int *new, global int *changed)
{
    WORK_ITEM(t);
    if (join(old, new, turns[t], partners[t]))
        changed[0] = 1;
}

/* Per corner u: the greatest sharpness at its vertex, in best[label], which begins as 0. Bits of floats >= 0 are in their
   order. */
kernel void rate_corners(const int size, global const int *labels, global const float *sharpness, global uint *best)
{
    WORK_ITEM(u);
    atomic_max(best + labels[u], as_uint(sharpness[u]));
}

/* Per corner u: the first of the sharpest, in chosen[label], which begins as INT_MAX. */
kernel void choose_corners(const int size, global const int *labels, global const float *sharpness,
                           global const uint *best, global int *chosen)
{
    WORK_ITEM(u);
    if (as_uint(sharpness[u]) == best[labels[u]])
        atomic_min(chosen + labels[u], u);
}

/* Vertices of a loop, each once where corners are the same; written to `out` in its order, or against it. Their number is
   less than 3 if the face is no wider than its vertices round. */
inline int walk_loop(int k, bool reverse, global const int *turn_starts, global const int *turns, global const int *labels,
                     global const int *ids, global int *out)
{
    const int begin = turn_starts[k], n = turn_starts[k + 1] - begin;
    int count = 0;
    for (int s = 0; s < n; ++s) {
        const int at = reverse ? n - 1 - s : s;
        const int label = labels[turns[begin + at]];
        const int last = labels[turns[begin + (reverse ? (at == n - 1 ? 0 : at + 1) : (at == 0 ? n - 1 : at - 1))]];
        if (label == last)
            continue;
        if (out)
            out[count] = ids[label];
        ++count;
    }
    return count;
}

/* Which of a face and its twin gives both their loop: that of the lesser cell, unless it is no polygon there. */
inline int giver_of(int k, int twin, global const int *turn_starts, global const int *turns, global const int *labels)
{
    const int first = min(k, twin), second = max(k, twin);
    if (first == second || walk_loop(first, false, turn_starts, turns, labels, labels, 0) >= 3)
        return first;
    return walk_loop(second, false, turn_starts, turns, labels, labels, 0) >= 3 ? second : first;
}

/* Per face k: the length of its loop, 0 if it is no polygon; marks the labels that are in use. */
kernel void measure_loops(const int size, global const int *twins, global const int *turn_starts, global const int *turns,
                          global const int *labels, global int *loop_counts, global int *used)
{
    WORK_ITEM(k);
    const int giver = giver_of(k, twins[k], turn_starts, turns, labels);
    const int count = walk_loop(giver, false, turn_starts, turns, labels, labels, 0);
    loop_counts[k] = count >= 3 ? count : 0;
    if (count < 3)
        return;
    for (int t = turn_starts[giver]; t < turn_starts[giver + 1]; ++t)
        used[labels[turns[t]]] = 1;
}

/* Per face k: its loop, in the numbers of vertices; ids are the prefix sums of `used`. */
kernel void write_loops(const int size, global const int *twins, global const int *turn_starts, global const int *turns,
                        global const int *labels, global const int *ids, global const int *loop_starts,
                        global int *loops)
{
    WORK_ITEM(k);
    if (loop_starts[k + 1] == loop_starts[k])
        return;
    const int giver = giver_of(k, twins[k], turn_starts, turns, labels);
    walk_loop(giver, giver != k, turn_starts, turns, labels, ids, loops + loop_starts[k]);
}

/* Per generator i: the positions of the vertices (v, 3) whose sharpest corner is one of its cell's. */
kernel void place_vertices(const int size, global const REAL *points, const REAL4 box_lower, const REAL4 box_upper,
                           global const int *corner_starts, global const REAL *corners, global const int *labels,
                           global const int *chosen, global const int *ids, global REAL *vertices)
{
    WORK_ITEM(i);
    const REAL lower[3] = {box_lower.s0, box_lower.s1, box_lower.s2};
    const REAL upper[3] = {box_upper.s0, box_upper.s1, box_upper.s2};
    for (int u = corner_starts[i]; u < corner_starts[i + 1]; ++u) {
        const int label = labels[u];
        if (chosen[label] == u && ids[label] != ids[label + 1])
            for (int a = 0; a < 3; ++a)
                vertices[3 * ids[label] + a] = clamp(points[3 * i + a] + corners[3 * u + a], lower[a], upper[a]);
    }
}

/* Where many cells meet, a vertex may lie in the middle of an edge of a cell that does not see it as a corner: its loops
   of the two faces at the edge, which come from different cells, then differ. Such a vertex is put into the loops that
   lack it, one per edge at a time, until every cell closes. */

inline int turn_after(int t, int begin, int end)
{
    return t + 1 == end ? begin : t + 1;
}

/* Is there an edge from vertex a to b in the loops of the faces [from, to)? */
inline bool has_edge(int a, int b, int from, int to, global const int *loop_starts, global const int *loops)
{
    for (int k = from; k < to; ++k) {
        const int begin = loop_starts[k], end = loop_starts[k + 1];
        for (int t = begin; t < end; ++t)
            if (loops[t] == a && loops[turn_after(t, begin, end)] == b)
                return true;
    }
    return false;
}

/* Per generator i: missing[t], the vertex that should follow place t of one of its loops, or -1. */
kernel void find_missing(const int size, global const int *starts, global const int *loop_starts,
                         global const int *loops, global int *missing, global int *changed)
{
    WORK_ITEM(i);
    const int from = starts[i], to = starts[i + 1];
    for (int k = from; k < to; ++k) {
        const int begin = loop_starts[k], end = loop_starts[k + 1];
        for (int t = begin; t < end; ++t) {
            const int a = loops[t], b = loops[turn_after(t, begin, end)];
            missing[t] = -1;
            if (has_edge(b, a, from, to, loop_starts, loops))
                continue;
            /* Another loop goes from b to a by way of it. */
            for (int q = from; q < to && missing[t] < 0; ++q) {
                const int first = loop_starts[q], last = loop_starts[q + 1];
                int place = -1;
                bool passes = false;
                for (int s = first; s < last; ++s) {
                    passes |= loops[s] == b;
                    place = loops[turn_after(s, first, last)] == a ? s : place;
                }
                if (q == k || !passes || place < 0)
                    continue;
                const int p = loops[place];
                bool here = false;
                for (int s = begin; s < end; ++s)
                    here |= loops[s] == p;
                if (!here && !has_edge(a, p, from, to, loop_starts, loops)) {
                    missing[t] = p;
                    changed[0] = 1;
                }
            }
        }
    }
}

/* What follows place t of face k: as its own cell or the other says, the lesser first. */
inline int missing_at(int k, int twin, int t, global const int *loop_starts, global const int *loops,
                      global const int *missing)
{
    const int begin = loop_starts[k], end = loop_starts[k + 1];
    if (twin == k)
        return missing[t];
    const int b = loops[turn_after(t, begin, end)];
    int s = loop_starts[twin];
    while (s < loop_starts[twin + 1] && loops[s] != b)
        ++s;
    const int own = missing[t], other = s < loop_starts[twin + 1] ? missing[s] : -1;
    const int one = k < twin ? own : other, two = k < twin ? other : own;
    return one >= 0 ? one : two;
}

/* Per face k: the length of its loop with what was missing. */
kernel void measure_mended(const int size, global const int *twins, global const int *loop_starts,
                           global const int *loops, global const int *missing, global int *counts)
{
    WORK_ITEM(k);
    int count = 0;
    for (int t = loop_starts[k]; t < loop_starts[k + 1]; ++t)
        count += 1 + (missing_at(k, twins[k], t, loop_starts, loops, missing) >= 0);
    counts[k] = count;
}

kernel void write_mended(const int size, global const int *twins, global const int *loop_starts,
                         global const int *loops, global const int *missing, global const int *new_starts,
                         global int *mended)
{
    WORK_ITEM(k);
    int to = new_starts[k];
    for (int t = loop_starts[k]; t < loop_starts[k + 1]; ++t) {
        mended[to++] = loops[t];
        const int p = missing_at(k, twins[k], t, loop_starts, loops, missing);
        if (p >= 0)
            mended[to++] = p;
    }
}
