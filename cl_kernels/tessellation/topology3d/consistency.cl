#include "tessellation/clip_tolerance.h"

/* Vertices and faces of a diagram in 3D, the same from both cells of every face.

   Each cell has been clipped by itself (half_faces.cl). Its corners are named by the vertex that they belong to. A face
   is a loop of corners in each of its two cells: two half-faces. They agree if both pass the same vertices in opposite
   directions. Where more than four cells meet, on lattices, rings and spheres of generators, round-off decides which
   corners a cell has, and half-faces differ.

   One rule makes them agree: of a half-face that differs, a vertex is merged into another one that lies on its planes,
   within a tolerance. Vertices near each other are merged so, and vertices anywhere along a line in which all their
   planes meet, such as the axis of a ring. A vertex is merged into the nearest such vertex that its faces determine
   better. A loop then leaves out what it passes there and back. Cells stay closed whatever is merged. The tolerance
   doubles whenever no vertex can be merged.

   labels (c,)                   of each corner: its vertex, named by its first corner
   best_corners (c,)             of each vertex: the corner that its faces determine best; its position is the vertex's
   loop_starts (h + 1,), loops   of each half-face: its corners, counter-clockwise from outside
   twins (h,)                    the half-face on the other side; itself at a wall and towards a ghost, which has no
   cell; -1 where the graph has no face reduced, reduced_counts       of each half-face: its loop as vertices, without
   repetitions and spurs; from loop_starts on differs (h,)                  1 where a half-face and its twin do not
   agree */

/* Note that corners u and w belong to one vertex. Labels are read from `old` and written to `new`, which begins as its
   copy. */
inline bool join_labels(global const int *old, global int *new, int u, int w)
{
    const int a = old[u], b = old[w];
    if (a == b)
        return false;
    atomic_min(new + (a > b ? u : w), min(a, b));
    atomic_min(new + max(a, b), min(a, b));
    return true;
}

/* Per corner u: pass on the least label to the corners of the same vertex. */
kernel void spread_labels(const int size, global const int *same, global const int *twin_corners, global const int *old,
                          global int *new, global int *changed)
{
    WORK_ITEM(u);
    bool any = join_labels(old, new, u, same[u]);
    any |= join_labels(old, new, u, twin_corners[u]);
    const int label = old[old[u]];
    if (label < old[u]) {
        atomic_min(new + u, label);
        any = true;
    }
    if (any)
        atomic_or(changed, 1);
}

/* Per corner u: the greatest sharpness at its vertex, in best[label], which begins as 0. The bits of
   floats >= 0, as integers, have the same order. */
kernel void rate_corners(const int size, global const int *labels, global const float *sharpness, global uint *best)
{
    WORK_ITEM(u);
    atomic_max(best + labels[u], as_uint(sharpness[u]));
}

/* Per corner u: the first of the sharpest, in best_corners[label], which begins as INT_MAX. */
kernel void choose_corners(const int size, global const int *labels, global const float *sharpness,
                           global const uint *best, global int *best_corners)
{
    WORK_ITEM(u);
    if (as_uint(sharpness[u]) == best[labels[u]])
        atomic_min(best_corners + labels[u], u);
}

/* Per generator i: the twins of its half-faces, -1 for half-faces that the graph or the neighbor does not have. */
kernel void find_twins(const int size, global const int *starts, global const int *half_face_starts,
                       global const int *half_face_labels, global int *twins)
{
    WORK_ITEM(i);
    const int begin = half_face_starts[i], end = half_face_starts[i + 1], listed = starts[i + 1] - starts[i];
    for (int h = begin; h < end; ++h) {
        const int j = half_face_labels[h];
        int twin = h - begin < listed ? h : -1;
        if (j >= 0 && j < size) {
            const int last = half_face_starts[j + 1];
            for (twin = half_face_starts[j]; twin < last && half_face_labels[twin] != i;)
                ++twin;
            if (twin == last)
                twin = -1;
        }
        twins[h] = twin;
    }
}

/* Per half-face h: its loop, reduced. */
kernel void reduce_loops(const int size, global const int *loop_starts, global const int *loops,
                         global const int *labels, global int *reduced, global int *reduced_counts)
{
    WORK_ITEM(h);
    const int begin = loop_starts[h], end = loop_starts[h + 1];
    global int *loop = reduced + begin;
    int n = 0;
    for (int t = begin; t < end; ++t) {
        const int label = labels[loops[t]];
        if (n >= 1 && loop[n - 1] == label)
            continue;
        if (n >= 2 && loop[n - 2] == label)
            --n;
        else
            loop[n++] = label;
    }
    /* The same where the end meets the beginning. */
    int first = 0;
    while (n - first >= 2) {
        if (loop[n - 1] == loop[first]) {
            --n;
        } else if (loop[n - 1] == loop[first + 1]) {
            ++first;
            --n;
        } else if (loop[n - 2] == loop[first]) {
            n -= 2;
        } else {
            break;
        }
    }
    n = n - first >= 3 ? n - first : 0;
    if (first > 0)
        for (int s = 0; s < n; ++s)
            loop[s] = loop[first + s];
    reduced_counts[h] = n;
}

/* Per half-face h: does it differ from its twin, or pass a vertex twice? A half-face without a face in the graph has to
   be empty. */
kernel void compare_half_faces(const int size, global const int *twins, global const int *loop_starts,
                               global const int *reduced, global const int *reduced_counts, global uchar *differs,
                               global int *any)
{
    WORK_ITEM(h);
    const int twin = twins[h], n = reduced_counts[h];
    global const int *loop = reduced + loop_starts[h];
    bool bad = twin < 0 && n > 0;
    if (twin >= 0) {
        bad = reduced_counts[twin] != n;
        for (int s = 1; s < n && !bad; ++s)
            for (int t = 0; t < s; ++t)
                bad |= loop[s] == loop[t];
        if (!bad && twin != h && n > 0) {
            global const int *other = reduced + loop_starts[twin];
            int at = 0;
            while (at < n && other[at] != loop[0])
                ++at;
            bad = at == n;
            for (int s = 0; s < n && !bad; ++s) {
                bad = other[at] != loop[s];
                at = at == 0 ? n - 1 : at - 1;
            }
        }
    }
    differs[h] = bad;
    if (bad)
        atomic_or(any, 1);
}

/* Corners and their vertices, and the walls; positions are taken relative to generator `origin`. */
typedef struct {
    global const REAL *points, *corners;
    global const int *owners, *corner_faces, *labels, *best_corners;
    REAL4 lower, upper;
    int origin;
} vertices_t;

#define VERTEX_ARGS                                                                                                    \
    global const REAL *points, global const REAL *corners, global const int *owners, global const int *corner_faces,   \
        global const int *labels, global const int *best_corners, const REAL4 lower, const REAL4 upper
#define VERTICES_FROM(origin)                                                                                          \
    {                                                                                                                  \
        points, corners, owners, corner_faces, labels, best_corners, lower, upper, origin                              \
    }

inline REAL4 way_between(int i, int j, global const REAL *points)
{
    return (REAL4)(points[STRIDE * j] - points[STRIDE * i], points[STRIDE * j + 1] - points[STRIDE * i + 1],
                   points[STRIDE * j + 2] - points[STRIDE * i + 2], 0);
}

inline REAL inner_product(REAL4 a, REAL4 b)
{
    return a.s0 * b.s0 + a.s1 * b.s1 + a.s2 * b.s2;
}

inline REAL4 vertex_position(int label, const vertices_t *in)
{
    const int u = in->best_corners[label];
    return way_between(in->origin, in->owners[u], in->points) +
           (REAL4)(in->corners[3 * u], in->corners[3 * u + 1], in->corners[3 * u + 2], 0);
}

/* Does the position y lie on the three planes that corner u lies on, within `tolerance`? */
inline bool is_on_planes(int u, REAL4 y, REAL tolerance, const vertices_t *in)
{
    const int i = in->owners[u];
    const REAL4 x = way_between(in->origin, i, in->points), from = y - x;
    const REAL4 own = (REAL4)(in->points[STRIDE * i], in->points[STRIDE * i + 1], in->points[STRIDE * i + 2], 0);
    const REAL4 to_lower = from - (in->lower - own), to_upper = from - (in->upper - own);
    const REAL off_walls[6] = {to_lower.s0, to_upper.s0, to_lower.s1, to_upper.s1, to_lower.s2, to_upper.s2};
    bool on = true;
    for (int k = 0; k < 3; ++k) {
        const int label = in->corner_faces[3 * u + k];
        REAL off;
        if (label < 0) {
            off = off_walls[-1 - label];
        } else {
            const REAL4 way = way_between(i, label, in->points);
            const REAL shift = (WEIGHT(in->points, i) - WEIGHT(in->points, label)) / 2;
            off = (inner_product(way, from - way / 2) - shift) / sqrt(inner_product(way, way));
        }
        on &= fabs(off) < tolerance;
    }
    return on;
}

/* The tolerance at a distance from a generator, after it has doubled so often. */
inline REAL tolerance_at(REAL distance, int doublings)
{
    return ldexp(4 * noise_length(distance), doublings);
}

/* Per half-face that differs, the lesser of two: for each vertex of either the nearest one that it may be merged into.
   The first pass finds least squared distances, which begin as UINT_MAX; the second the first vertex at that distance,
   in targets[label], which begin as INT_MAX. */
kernel void find_targets(const int size, VERTEX_ARGS, global const float *sharpness, global const int *loop_starts,
                         global const int *loops, global const int *twins, global const uchar *differs,
                         const int doublings, const int second_pass, global uint *distances, global int *targets)
{
    WORK_ITEM(h);
    const int twin = twins[h];
    if (!differs[h] || (twin >= 0 && twin < h))
        return;
    const int begins[2] = {loop_starts[h], twin > h ? loop_starts[twin] : 0};
    const int ends[2] = {loop_starts[h + 1], twin > h ? loop_starts[twin + 1] : 0};
    const int any = begins[0] < ends[0] ? begins[0] : begins[1];
    const vertices_t in = VERTICES_FROM(owners[loops[any]]);
    REAL reach2 = 0;
    for (int r = 0; r < 2; ++r)
        for (int t = begins[r]; t < ends[r]; ++t) {
            global const REAL *c = corners + 3 * loops[t];
            reach2 = fmax(reach2, c[0] * c[0] + c[1] * c[1] + c[2] * c[2]);
        }
    const REAL tolerance = tolerance_at(sqrt(reach2), doublings);
    for (int r = 0; r < 2; ++r)
        for (int t = begins[r]; t < ends[r]; ++t) {
            const int a = labels[loops[t]], corner = best_corners[a];
            const REAL4 here = vertex_position(a, &in);
            for (int q = 0; q < 2; ++q)
                for (int s = begins[q]; s < ends[q]; ++s) {
                    const int b = labels[loops[s]];
                    const float sharper = sharpness[best_corners[b]] - sharpness[corner];
                    if (a == b || sharper < 0 || (sharper == 0 && b > a))
                        continue;
                    const REAL4 there = vertex_position(b, &in), way = there - here;
                    const uint distance = as_uint((float)inner_product(way, way));
                    if ((second_pass && distance != distances[a]) || !is_on_planes(corner, there, tolerance, &in))
                        continue;
                    if (second_pass)
                        atomic_min(targets + a, b);
                    else
                        atomic_min(distances + a, distance);
                }
        }
}

/* Per corner u: its vertex is not merged if the target does not lie on the planes of this corner, too. */
kernel void reject_targets(const int size, VERTEX_ARGS, global const int *targets, const int doublings,
                           global int *rejected)
{
    WORK_ITEM(u);
    const int a = labels[u], target = targets[a];
    if (target >= size)
        return;
    const vertices_t in = VERTICES_FROM(owners[u]);
    const REAL4 there = vertex_position(target, &in), here = vertex_position(a, &in);
    const REAL reach = sqrt(fmax(inner_product(there, there), inner_product(here, here)));
    if (!is_on_planes(u, there, tolerance_at(reach, doublings), &in))
        atomic_or(rejected + a, 1);
}

/* Per vertex: join it to its target. */
kernel void merge_vertices(const int size, global const int *labels, global const int *targets,
                           global const int *rejected, global int *merged, global int *any)
{
    WORK_ITEM(u);
    if (targets[u] < size && !rejected[u]) {
        join_labels(labels, merged, u, targets[u]);
        atomic_or(any, 1);
    }
}

/* Per generator i: the lengths of the loops of its faces k, 0 for those that have vanished; marks the labels in use. */
kernel void measure_loops(const int size, global const int *starts, global const int *half_face_starts,
                          global const int *loop_starts, global const int *reduced, global const int *reduced_counts,
                          global int *counts, global int *used)
{
    WORK_ITEM(i);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int h = half_face_starts[i] + k - starts[i];
        counts[k] = reduced_counts[h];
        for (int s = 0; s < reduced_counts[h]; ++s)
            atomic_or(used + reduced[loop_starts[h] + s], 1);
    }
}

/* Per generator i: the loops in the numbers of vertices; ids are the prefix sums of `used`. */
kernel void write_loops(const int size, global const int *starts, global const int *half_face_starts,
                        global const int *loop_starts, global const int *reduced, global const int *ids,
                        global const int *new_starts, global int *new_loops)
{
    WORK_ITEM(i);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int h = half_face_starts[i] + k - starts[i], begin = new_starts[k], n = new_starts[k + 1] - begin;
        for (int s = 0; s < n; ++s)
            new_loops[begin + s] = ids[reduced[loop_starts[h] + s]];
    }
}

/* Per corner u: the position of its vertex, if it is the best corner of one in use. */
kernel void write_positions(const int size, VERTEX_ARGS, global const int *ids, global REAL *positions)
{
    WORK_ITEM(u);
    const REAL low[3] = {lower.s0, lower.s1, lower.s2}, high[3] = {upper.s0, upper.s1, upper.s2};
    const int label = labels[u], id = ids[label];
    if (best_corners[label] == u && id != ids[label + 1])
        for (int a = 0; a < 3; ++a)
            positions[3 * id + a] = clamp(points[STRIDE * owners[u] + a] + corners[3 * u + a], low[a], high[a]);
}
