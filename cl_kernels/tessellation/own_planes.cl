#include "geometry/walls.h"

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
/* Round-off of the distance from the plane of a triangle. */
#define PLANE_NOISE (8 * REAL_EPS)
/* Share of the way to a foot that must be free. */
#define FREE_SHARE R(0.999)

/* Triangles that are remembered. */
#define KNOWN 32

typedef struct {
    REAL s, t, d2; /* the point a + s (b - a) + t (c - a), and its squared distance */
    int kind;      /* of the edge or corner that it lies on */
} foot_t;

/* The point of triangle abc that is nearest to the origin (Ericson, Real-Time Collision Detection, 2005, 5.1.5). */
inline foot_t foot_on_triangle(REAL4 a, REAL4 b, REAL4 c, int kinds)
{
    const REAL4 ab = b - a, ac = c - a;
    const REAL d1 = -dot(ab, a), d2 = -dot(ac, a), d3 = -dot(ab, b), d4 = -dot(ac, b), d5 = -dot(ab, c),
               d6 = -dot(ac, c);
    const REAL va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2;
    foot_t foot = {0, 0, 0, 0};
    if (d1 <= 0 && d2 <= 0) {
        foot.kind = CORNER_KIND(kinds, 0);
    } else if (d3 >= 0 && d4 <= d3) {
        foot.s = 1;
        foot.kind = CORNER_KIND(kinds, 1);
    } else if (vc <= 0 && d1 >= 0 && d3 <= 0) {
        foot.s = d1 / (d1 - d3);
        foot.kind = EDGE_KIND(kinds, 0);
    } else if (d6 >= 0 && d5 <= d6) {
        foot.t = 1;
        foot.kind = CORNER_KIND(kinds, 2);
    } else if (vb <= 0 && d2 >= 0 && d6 <= 0) {
        foot.t = d2 / (d2 - d6);
        foot.kind = EDGE_KIND(kinds, 2);
    } else if (va <= 0 && d4 >= d3 && d5 >= d6) {
        foot.t = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        foot.s = 1 - foot.t;
        foot.kind = EDGE_KIND(kinds, 1);
    } else {
        const REAL whole = va + vb + vc;
        foot.s = vb / whole;
        foot.t = vc / whole;
    }
    const REAL4 at = a + foot.s * ab + foot.t * ac;
    foot.d2 = dot(at, at);
    return foot;
}

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

/* Per generator i: its own planes, nearest first. `wall_planes`: unit normals and levels of triangles, which tell most
   that are not the nearest of their patch. `wall_normals`: normals at the corners of triangles, and the shift.
   counters: number of planes; most patches near a generator; generators outside of their nearest patch. Where there is
   no room, own_found is -1: nothing is known. */
kernel void find_own_planes(const int size, global const REAL *points, WALL_ARGS, global const REAL4 *wall_planes,
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
    const REAL reach2 = reach * reach;
    int patches[MOST_OWN], triangles[MOST_OWN], order[MOST_OWN], n = 0;
    foot_t feet[MOST_OWN];
    int known[KNOWN]; /* triangles that have been seen in another bin */
    for (int k = 0; k < KNOWN; ++k)
        known[k] = -1;
    EACH_TRIANGLE (t, x - reach, x + reach) {
        if (known[t % KNOWN] == t)
            continue;
        known[t % KNOWN] = t;
        const int2 kinds = wall_kinds[t];
        int k = 0;
        while (k < n && patches[k] != kinds.s0)
            ++k;
        const REAL best = k < n ? feet[k].d2 : reach2;
        const REAL4 plane = wall_planes[t];
        const REAL off = fabs(plane.s0 * x.s0 + plane.s1 * x.s1 + plane.s2 * x.s2 - plane.s3) - PLANE_NOISE;
        if (off > 0 && off * off >= best)
            continue;
        const foot_t foot = foot_on_triangle(wall_corners[3 * t] - x, wall_corners[3 * t + 1] - x,
                                             wall_corners[3 * t + 2] - x, kinds.s1);
        if (!(foot.d2 < best))
            continue;
        if (k == MOST_OWN) {
            atomic_max(counters + 1, MOST_OWN + 1);
            own_found[i] = -1;
            continue;
        }
        n = max(n, k + 1);
        patches[k] = kinds.s0;
        triangles[k] = t;
        feet[k] = foot;
    }
    if (n == 0)
        return;
    for (int k = 0; k < n; ++k) {
        int to = k;
        for (; to > 0 && (feet[order[to - 1]].d2 > feet[k].d2 ||
                          (feet[order[to - 1]].d2 == feet[k].d2 && patches[order[to - 1]] > patches[k]));
             --to)
            order[to] = order[to - 1];
        order[to] = k;
    }
    REAL4 planes[MOST_OWN];
    int count = 0;
    for (int m = 0; m < n; ++m) {
        const int k = order[m], t = triangles[k];
        const foot_t foot = feet[k];
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
        patches[k] = -1 - patches[k]; /* a label now */
        order[count] = k;
        ++count;
    }
    const int place = atomic_add(counters, count);
    if (place + count > room) {
        own_found[i] = -1;
        return;
    }
    own_rows[i] = (int2)(place, count);
    for (int k = 0; k < count; ++k) {
        own_labels[place + k] = patches[order[k]];
        own_planes[place + k] = planes[k];
    }
}

/* Per point: the triangle nearest to it, the first one of several; -1 if all are farther than `most`. */
kernel void find_nearest_triangles(const int size, global const REAL *points, global const REAL *most, WALL_ARGS,
                                   global int *nearest)
{
    LONG_ITEM(i);
    const REAL4 x = (REAL4)(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0);
    const int4 bin = wall_bin(x, wall_frame, wall_shape);
    const REAL width = 1 / wall_frame.s3;
    const int clear = wall_clear[(bin.s2 * wall_shape.s1 + bin.s1) * wall_shape.s0 + bin.s0];
    nearest[i] = -1;
    if ((clear - 1) * width > most[i])
        return;
    /* Balls of growing radius, until the nearest triangle in the bins of one lies in it. */
    for (REAL reach = (clear + R(0.5)) * width;; reach *= 2) {
        const REAL least = fmin(reach, most[i]), least2 = least * least;
        REAL best2 = REAL_MAX;
        int best = INT_MAX;
        EACH_TRIANGLE (t, x - least, x + least) {
            const foot_t foot =
                foot_on_triangle(wall_corners[3 * t] - x, wall_corners[3 * t + 1] - x, wall_corners[3 * t + 2] - x, 0);
            if (foot.d2 < best2 || (foot.d2 == best2 && t < best)) {
                best2 = foot.d2;
                best = t;
            }
        }
        if (best2 <= least2)
            nearest[i] = best;
        if (best2 <= least2 || !(reach < most[i]) || !(reach < 1 / REAL_EPS))
            return;
        if (best2 < 4 * reach * reach)
            reach = sqrt(best2) / 2 * (1 + 8 * REAL_EPS);
    }
}
