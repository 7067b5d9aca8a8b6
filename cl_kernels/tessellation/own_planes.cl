#include "geometry/wall_tree.h"

/* The planes that cut the cells of generators near the surface of a solid; see own_planes.h.

   For each patch, its nearest point to the generator x is the foot. The plane has the normal of the patch there, which
   is interpolated between corners of triangles, and passes through the foot, moved inwards by `shift`. A foot on a
   convex crease has a plane, so that patches are continued there; one on a concave crease has none. A patch whose plane
   does not have x inside, or whose foot cannot be seen from x, is hidden behind others.

   Where a patch is bent around x, as in the tip of a cone or in a rod, it has further planes, in AROUND directions from
   x about its mean normal there. */
#ifndef MOST_OWN
#error "build with -DMOST_OWN=patches that may be near a generator"
#endif
/* Least distance of a generator from its planes. */
#define LEAST_DEPTH (16 * REAL_EPS)
/* Share of the way to a foot that must be free. */
#define FREE_SHARE R(0.999)

/* A patch may be bent around a generator if `shift` is more than this share of the depth. It is if it is opposite, too,
   within OPPOSITE of the reach. Planes are moved inwards by at most AREA_SHARE of their depth then, so that they
   enclose the area of a circle. The first share is less than the last: a cell that has further planes keeps them, and
   its volume, while its generator moves a little. */
#define BENT R(0.05)
#define OPPOSITE R(0.75)
#define AREA_SHARE R(0.1)
#define AROUND 5

/* Whether the way from x to x + way is free of triangles, up to its end. */
inline bool is_free(REAL4 x, REAL4 way, WALL_ARGS)
{
    const REAL4 most = FREE_SHARE * way;
    EACH_TRIANGLE (t, fmin(x, x + most), fmax(x, x + most))
        if (crossing_of(t, x, most, wall_corners) <= 1)
            return false;
    return true;
}

/* The blend of the normals at point (s, t) of triangle n, with the shift; sets `at` to the way there from x. */
inline REAL4 blend_at(int n, REAL s, REAL t, REAL4 x, REAL4 *at, global const REAL4 *wall_corners,
                      global const REAL4 *wall_normals)
{
    const REAL r = 1 - s - t;
    *at = r * (wall_corners[3 * n] - x) + s * (wall_corners[3 * n + 1] - x) + t * (wall_corners[3 * n + 2] - x);
    return r * wall_normals[3 * n] + s * wall_normals[3 * n + 1] + t * wall_normals[3 * n + 2];
}

/* The unit vector along a blend of normals. */
inline REAL4 direction_of(REAL4 blend)
{
    const REAL4 normal = (REAL4)(blend.s0, blend.s1, blend.s2, 0);
    return normal / sqrt(dot(normal, normal));
}

/* Whether the way from x ends on `patch`; then `plane` is its tangent plane there. */
inline bool meets_patch(REAL4 x, REAL4 way, int patch, REAL4 *plane, WALL_ARGS, global const REAL4 *wall_normals)
{
    REAL first = 2;
    int hit = -1;
    EACH_TRIANGLE (t, fmin(x, x + way), fmax(x, x + way)) {
        const REAL gone = crossing_of(t, x, way, wall_corners);
        if (gone < first || (gone == first && gone < 2 && t < hit)) {
            first = gone;
            hit = t;
        }
    }
    if (hit < 0 || wall_kinds[hit].s0 != patch)
        return false;
    const REAL4 there = x + first * way;
    const foot_t foot = foot_on_triangle(wall_corners[3 * hit] - there, wall_corners[3 * hit + 1] - there,
                                         wall_corners[3 * hit + 2] - there, wall_kinds[hit].s1);
    REAL4 at;
    const REAL4 blend = blend_at(hit, foot.s, foot.t, x, &at, wall_corners, wall_normals);
    *plane = direction_of(blend);
    const REAL depth = dot(*plane, at);
    plane->s3 = fmax(depth - fmin(blend.s3, AREA_SHARE * depth), LEAST_DEPTH);
    return depth > 0;
}

/* Direction k from a generator with a wall in the direction of `normal`: first away from it. */
inline REAL4 direction_around(int k, REAL4 normal)
{
    const REAL4 other = fabs(normal.s0) < R(0.6) ? (REAL4)(1, 0, 0, 0) : (REAL4)(0, 1, 0, 0);
    const REAL4 across = cross_of_walls(normal, other), side = across / sqrt(dot(across, across));
    if (k == 0)
        return -normal;
    return (k & 1 ? 1 : -1) * (k < 3 ? side : cross_of_walls(normal, side));
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
        const int patch = feet[order[m]].patch;
        REAL4 at;
        const REAL4 blend = blend_at(t, foot.s, foot.t, x, &at, wall_corners, wall_normals);
        REAL4 normal = direction_of(blend), plane;
        const REAL depth = dot(normal, at);
        if (m > 0 && (!(depth > 0) || !is_free(x, at, WALL)))
            continue;
        if (!(depth > -LEAST_DEPTH))
            atomic_inc(counters + 2);
        const bool bent = blend.s3 > BENT * depth && meets_patch(x, OPPOSITE * reach * direction_around(0, normal),
                                                                 patch, &plane, WALL, wall_normals);
        const REAL4 direction = normal;
        normal.s3 = fmax(depth - fmin(blend.s3, (bent ? AREA_SHARE : R(0.5)) * depth), LEAST_DEPTH);
        planes[count] = normal;
        labels[count] = -1 - patch;
        ++count;
        for (int k = 0; bent && k < AROUND; ++k)
            if (count + n - m <= MOST_OWN &&
                meets_patch(x, reach * direction_around(k, direction), patch, &plane, WALL, wall_normals)) {
                planes[count] = plane;
                labels[count++] = -1 - patch;
            }
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
