#include "geometry/wall_tree.h"

/* The planes that cut the cells of generators near the surface of a solid; see own_planes.h.

   For each patch, its nearest point to the generator x is the foot. The plane has the normal of the patch there, which
   is interpolated between corners of triangles, and passes through the foot, moved inwards by `shift`. A foot on a
   convex crease has a plane, so that patches are continued there; one on a concave crease has none. A patch whose plane
   does not have x inside, or whose foot cannot be seen from x, is hidden behind others. */
#ifndef MOST_OWN
#error "build with -DMOST_OWN=patches that may be near a generator"
#endif
/* Least distance of a generator from its planes. */
#define LEAST_DEPTH (16 * REAL_EPS)
/* Share of the way to a foot that must be free. */
#define FREE_SHARE R(0.999)

/* Whether the way from x to x + way is free of triangles, up to its end. */
inline bool is_free(REAL4 x, REAL4 way, WALL_ARGS)
{
    const REAL4 most = FREE_SHARE * way;
    EACH_TRIANGLE (t, fmin(x, x + most), fmax(x, x + most))
        if (crossing_of(t, x, most, wall_corners) <= 1)
            return false;
    return true;
}

/* Reach of the first search: `factor` times the spacing of generators about item p. */
kernel void guess_reach(const int size, global const int *items, global const float *spacing, const float factor,
                        global float *own_reach)
{
    WORK_ITEM(p);
    own_reach[items[p]] = factor * spacing[p];
}

/* Per generator i: its own planes, nearest first. `wall_normals`: normals at the corners of triangles, and the shift.
   counters: number of planes; most patches near a generator; generators outside of their nearest patch. Where there is
   no room, own_found is -1: nothing is known. */
kernel void find_own_planes(const int size, global const REAL *points, WALL_ARGS, WALL_TREE_ARGS,
                            global const REAL4 *wall_normals, global const float *own_reach, const int room,
                            global int2 *own_rows, global int *own_labels, global REAL4 *own_planes,
                            global float *own_found, global int *counters)
{
    LONG_ITEM(i);
    const REAL4 x = (REAL4)(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0);
    const int4 bin = wall_bin(x, wall_frame, wall_shape);
    const REAL width = 1 / wall_frame.s3;
    const int clear = wall_clear[(bin.s2 * wall_shape.s1 + bin.s1) * wall_shape.s0 + bin.s0];
    const REAL reach = own_reach[i], nearest = (clear - 1) * width;
    own_rows[i] = (int2)(0, 0);
    own_found[i] = (float)fmax(reach, nearest);
    if (reach < nearest)
        return;
    wall_foot_t feet[MOST_OWN];
    const int n = find_feet(x, reach * reach, false, MOST_OWN, feet, wall_corners, wall_kinds, WALL_TREE);
    if (n < 0) {
        atomic_max(counters + 1, MOST_OWN + 1);
        own_found[i] = -1;
        return;
    }
    int order[MOST_OWN], labels[MOST_OWN];
    for (int k = 0; k < n; ++k) {
        int to = k;
        for (; to > 0 && (feet[order[to - 1]].at.d2 > feet[k].at.d2 ||
                          (feet[order[to - 1]].at.d2 == feet[k].at.d2 && feet[order[to - 1]].patch > feet[k].patch));
             --to)
            order[to] = order[to - 1];
        order[to] = k;
    }
    REAL4 planes[MOST_OWN];
    int count = 0;
    for (int m = 0; m < n; ++m) {
        const int t = feet[order[m]].triangle;
        const foot_t foot = feet[order[m]].at;
        if (foot.kind == CONCAVE_CREASE)
            continue;
        const REAL r = 1 - foot.s - foot.t;
        const REAL4 at = r * (wall_corners[3 * t] - x) + foot.s * (wall_corners[3 * t + 1] - x) +
                         foot.t * (wall_corners[3 * t + 2] - x);
        const REAL4 blend =
            r * wall_normals[3 * t] + foot.s * wall_normals[3 * t + 1] + foot.t * wall_normals[3 * t + 2];
        REAL4 normal = (REAL4)(blend.s0, blend.s1, blend.s2, 0);
        normal /= sqrt(dot(normal, normal));
        const REAL depth = dot(normal, at);
        if (m > 0 && (!(depth > 0) || !is_free(x, at, WALL)))
            continue;
        if (!(depth > -LEAST_DEPTH))
            atomic_inc(counters + 2);
        normal.s3 = fmax(fmax(depth - blend.s3, depth / 2), LEAST_DEPTH);
        planes[count] = normal;
        labels[count] = -1 - feet[order[m]].patch;
        ++count;
    }
    const int place = atomic_add(counters, count);
    if (place + count > room) {
        own_found[i] = -1;
        return;
    }
    own_rows[i] = (int2)(place, count);
    for (int k = 0; k < count; ++k) {
        own_labels[place + k] = labels[k];
        own_planes[place + k] = planes[k];
    }
}

/* Per point: the triangle nearest to it, the first one of several; -1 if all are farther than `most`. */
kernel void find_nearest_triangles(const int size, global const REAL *points, global const REAL *most, WALL_ARGS,
                                   WALL_TREE_ARGS, global int *nearest)
{
    LONG_ITEM(i);
    const REAL4 x = (REAL4)(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0);
    const REAL reach2 = most[i] * most[i] * (1 + 4 * REAL_EPS) + R(1e-30);
    wall_foot_t foot;
    nearest[i] = find_feet(x, reach2, true, 1, &foot, wall_corners, wall_kinds, WALL_TREE) > 0 ? foot.triangle : -1;
}
