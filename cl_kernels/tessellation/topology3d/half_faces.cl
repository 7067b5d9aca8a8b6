#define CLIP_SHARPLY 1
#include "tessellation/clip.h"

/* The faces of a diagram in 3D as each cell has them by itself. Each cell is clipped once more, by its neighbors alone.
   Its vertices are the corners, numbered cell by cell. A face that two cells share has a half-face in each. Two
   corners surely belong to one vertex where the same four generators or walls meet, and where an edge of zero length
   joins them. consistency.cl does the rest.

   starts, neighbors           the graph
   half_face_starts (n + 1,)   rows of half-faces: the faces of the graph in its order, then walls that the cell touches
                               although the graph has no face there
   half_face_labels (h,)       a generator, or -1 - wall
   corner_starts (n + 1,)      first corner of each cell
   loop_starts (h + 1,)        of the loops of half-faces; those of cell i begin at 3 corner_starts[i]
   loops (3 c,)                corners, counter-clockwise from outside */

/* The cell of generator i; false if there is not enough room. */
inline bool make_cell(CELL *cell, int i, global const REAL *points, CLIP_BOX_ARGS, global const int *starts,
                      global const int *neighbors)
{
    const REAL4 x = SITE_IN_SPACE(points, i);
    return start_cell(cell, i, x, points, CLIP_BOX) != CLIP_FULL &&
           clip_polyhedron_by_row(cell, i, x, starts, neighbors, points) != CLIP_FULL;
}

inline bool is_in_row(int label, int begin, int end, global const int *labels)
{
    for (int k = begin; k < end; ++k)
        if (labels[k] == label)
            return true;
    return false;
}

/* Per generator i with capacities[i] = 0: how many corners and half-faces its cell has; then capacities[i] is
   FACE_CAPACITY. full[0] is set if a cell needs more room. */
kernel void count_corners(const int size, global const REAL *points, CLIP_BOX_ARGS, global const int *starts,
                          global const int *neighbors, global int *capacities, global int *corner_counts,
                          global int *half_face_counts, global int *full CELL_ARGS)
{
    LONG_ITEM(k);
    TAKE_CELL(cell, k);
    EACH_CELL (i, k) {
        if (capacities[i] != 0)
            continue;
#ifdef WEIGHTED
        if (starts[i] == starts[i + 1]) {
            capacities[i] = FACE_CAPACITY;
            corner_counts[i] = half_face_counts[i] = 0;
            continue;
        }
#endif
        if (!make_cell(cell, i, points, CLIP_BOX, starts, neighbors)) {
            atomic_or(full, 1);
            continue;
        }
        const int begin = starts[i], end = starts[i + 1];
        int count = end - begin;
        for (int f = next_face(cell, 0); f < FACE_CAPACITY; f = next_face(cell, f + 1))
            count += !is_in_row(cell->labels[f], begin, end, neighbors);
        capacities[i] = FACE_CAPACITY;
        corner_counts[i] = cell->n;
        half_face_counts[i] = count;
    }
}

/* How sharply the faces of vertex v determine it: the volume that their unit normals span, times d / (d + r) for each
   face, because the round-off of a bisector grows as r / d, with d the distance of its generators and r that of v. */
inline REAL sharpness_of(const CELL *cell, int v)
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

/* Write the loops of a cell's half-faces, from `half_face` up to `end`. */
inline void list_loops(CELL *cell, int base, int half_face, int end, global const int *half_face_labels,
                       global int *loop_starts, global int *loops)
{
    CELL_SPACE const INDEX *start = face_starts(cell);
    int t = 3 * base;
    for (; half_face < end; ++half_face) {
        loop_starts[half_face] = t;
        int f = next_face(cell, 0);
        while (f < FACE_CAPACITY && cell->labels[f] != half_face_labels[half_face])
            f = next_face(cell, f + 1);
        if (f == FACE_CAPACITY) /* the graph has this face, but the clipped cell does not */
            continue;
        const int first = start[f];
        int v = first;
        do {
            loops[t++] = base + v;
            v = vertex_after(cell, v, f);
        } while (v != first);
    }
}

/* Per generator i with capacities[i] = FACE_CAPACITY: its corners (c, 3), relative to x_i, how sharp each is, the
   labels of their faces (c, 3), counter-clockwise, their owner, and its half-faces. same[u] is the least corner of the
   cell that lies where corner u does, joined to it by edges of zero length. */
kernel void list_corners(const int size, global const REAL *points, CLIP_BOX_ARGS, global const int *starts,
                         global const int *neighbors, global const int *capacities, global const int *corner_starts,
                         global const int *half_face_starts, global REAL *corners, global float *sharpness,
                         global int *corner_faces, global int *owners, global int *same, global int *half_face_labels,
                         global int *loop_starts, global int *loops CELL_ARGS)
{
    LONG_ITEM(k);
    TAKE_CELL(cell, k);
    EACH_CELL (i, k) {
        if (capacities[i] != FACE_CAPACITY)
            continue;
        const int base = corner_starts[i];
#ifdef WEIGHTED
        if (starts[i] == starts[i + 1]) {
            if (i == size - 1)
                loop_starts[half_face_starts[i]] = 3 * base;
            continue;
        }
#endif
        make_cell(cell, i, points, CLIP_BOX, starts, neighbors);
        REAL least = 4 * noise_length(sqrt(cell->reach2));
        for (int f = next_face(cell, 0); f < FACE_CAPACITY; f = next_face(cell, f + 1))
            if (cell->labels[f] >= 0)
                least = fmin(least, sqrt(SQUARE_OF(cell->planes[f])) / 64);
        CELL_SPACE INDEX *joined = (CELL_SPACE INDEX *)cell->rim.edges; /* of no more use */
        for (int v = 0; v < cell->n; ++v) {
            const int u = base + v;
            corners[3 * u] = X(cell)[v];
            corners[3 * u + 1] = Y(cell)[v];
            corners[3 * u + 2] = Z(cell)[v];
            const INDEX4 f = cell->faces[v];
            corner_faces[3 * u] = cell->labels[f.s0];
            corner_faces[3 * u + 1] = cell->labels[f.s1];
            corner_faces[3 * u + 2] = cell->labels[f.s2];
            sharpness[u] = (float)sharpness_of(cell, v);
            owners[u] = i;
            joined[v] = v;
        }
        bool changed = true;
        while (changed) {
            changed = false;
            for (int v = 0; v < cell->n; ++v) {
                const INDEX4 links = cell->links[v];
                const int ends[3] = {links.s0, links.s1, links.s2};
                for (int e = 0; e < 3; ++e) {
                    const int w = ends[e];
                    if (joined[w] >= joined[v])
                        continue;
                    const REAL dx = X(cell)[w] - X(cell)[v], dy = Y(cell)[w] - Y(cell)[v], dz = Z(cell)[w] - Z(cell)[v];
                    if (dx * dx + dy * dy + dz * dz < least * least) {
                        joined[v] = joined[w];
                        changed = true;
                    }
                }
            }
        }
        for (int v = 0; v < cell->n; ++v)
            same[base + v] = base + joined[v];
        const int begin = starts[i], end = starts[i + 1], half_face = half_face_starts[i];
        int to = half_face;
        for (int k = begin; k < end; ++k)
            half_face_labels[to++] = neighbors[k];
        for (int f = next_face(cell, 0); f < FACE_CAPACITY; f = next_face(cell, f + 1))
            if (!is_in_row(cell->labels[f], begin, end, neighbors))
                half_face_labels[to++] = cell->labels[f];
        list_loops(cell, base, half_face, to, half_face_labels, loop_starts, loops);
        if (i == size - 1)
            loop_starts[to] = 3 * (base + cell->n);
    }
}

/* Is label one of the three faces of corner u? */
inline bool has_label(global const int *corner_faces, int u, int label)
{
    return corner_faces[3 * u] == label || corner_faces[3 * u + 1] == label || corner_faces[3 * u + 2] == label;
}

/* Per corner u of cell i, where the faces a, b, c meet: twin_corners[u], that of the first cell before i in which the
   same four meet, or u. */
kernel void match_corners(const int size, const int n, global const int *owners, global const int *corner_starts,
                          global const int *corner_faces, global int *twin_corners)
{
    WORK_ITEM(u);
    const int i = owners[u];
    int best = i, found = u;
    for (int k = 0; k < 3; ++k) {
        const int j = corner_faces[3 * u + k];
        if (j < 0 || j >= min(best, n))
            continue;
        const int one = corner_faces[3 * u + (k + 1) % 3], two = corner_faces[3 * u + (k + 2) % 3];
        for (int w = corner_starts[j]; w < corner_starts[j + 1]; ++w)
            if (has_label(corner_faces, w, i) && has_label(corner_faces, w, one) && has_label(corner_faces, w, two)) {
                best = j;
                found = w;
                break;
            }
    }
    twin_corners[u] = found;
}
