/* Refinement from a mesh for 2h to one for h: a new generator at the midpoint of every Delaunay edge, which turns a
   regular lattice into one of half the spacing. Edges across very short faces are left out. Each cell at a wall also
   gets one new generator between its generator and the wall, or behind its generator if that is almost on the wall. One
   work-item per generator. */
#include "adaptation/separation.h"
#include "adaptation/site_key.h"

/* Whether the edge from generator `name` to `other` gets a new generator. Each edge is counted at its lower name. */
inline bool has_midpoint(int name, int other, REAL measure, REAL volume)
{
    const REAL length = CELL_DIM == 2 ? sqrt(volume) : cbrt(volume);
    return other > name && measure > R(SHORT_FACE) * (CELL_DIM == 2 ? length : length * length);
}

/* Whether an end of the edge is fixed (label below `fixed`): such edges get no new generators. */
inline bool is_fixed(int i, int j, global const int *labels, int fixed)
{
    return fixed > 0 && (labels[i] < fixed || (j >= 0 && labels[j] < fixed));
}

#ifdef POLYGON
/* Whether face k is the longest boundary edge of its cell (the first of equal ones), which gets the new generator. */
inline bool is_wall_side(int k, int begin, int end, global const int *neighbors, global const FACE *face_measures,
                         REAL volume)
{
    bool longest = neighbors[k] < 0 && face_measures[k] > R(SHORT_FACE) * sqrt(volume);
    for (int m = begin; m < end && longest; ++m)
        longest = neighbors[m] >= 0 || m == k || face_measures[m] < face_measures[k] ||
                  (face_measures[m] == face_measures[k] && m > k);
    return longest;
}
#elif defined(SOLID)
/* Not at small faces on a second patch beside a crease. */
#define is_wall_side(k, begin, end, neighbors, face_measures, volume)                                                  \
    (neighbors[k] < 0 && face_measures[k] > R(0.2) * cbrt(volume) * cbrt(volume))
#else
#define is_wall_side(k, begin, end, neighbors, face_measures, volume) (neighbors[k] < 0)
#endif

/* Depth of cell i from a wall with the inward normal n, at most `most`; gap = distance of its generator from the wall.
   In a strip much thinner than h there are already generators from coarser levels. */
inline REAL free_depth(int i, REAL most, REAL gap, const REAL *n, global const int *starts, global const int *neighbors,
                       global const REAL *points PERIOD_ARGS)
{
    REAL room = most;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbors[k];
        if (j < 0)
            continue;
        REAL inwards = 0, d2 = 0;
        for (int a = 0; a < DIM; ++a) {
            const REAL d = DIFFERENCE(a, points[DIM * i + a], points[DIM * j + a]);
            inwards += d * n[a];
            d2 += d * d;
        }
        if (inwards > 0)
            room = fmin(room, fmax(gap, R(0)) + d2 / (2 * inwards));
    }
    return room;
}

/* counts[i] = number of new generators at cell i. */
kernel void count_new_generators(const int size, global const int *starts, global const int *neighbors,
                                 global const FACE *face_measures, global const REAL *volumes, global const int *labels,
                                 const int fixed, NAME_ARGS, global int *counts)
{
    WORK_ITEM(i);
    int count = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbors[k];
        if (is_fixed(i, j, labels, fixed))
            continue;
        count += j < 0 ? is_wall_side(k, starts[i], starts[i + 1], neighbors, face_measures, volumes[i])
                       : has_midpoint(NAME(i), NAME(j), face_measures[k], volumes[i]);
    }
    counts[i] = count;
}

/* Row i of `finer` = generator i; rows from n + child_starts[i] on = its new generators. child_starts are the prefix
   sums of the counts; h is the size on the new level. */
kernel void place_new_generators(const int size, global const int *starts, global const int *neighbors,
                                 global const FACE *face_measures, global const REAL *volumes,
                                 global const REAL *points, global const int *labels, const int fixed, NAME_ARGS,
                                 global const REAL *h, const int n, DOMAIN_ARGS, global const int *child_starts,
                                 global REAL *finer, global const FACE *face_centroids OUTLINE_ARGS)
{
    WORK_ITEM(i);
    BOX_CORNERS(lower, upper);
    for (int a = 0; a < DIM; ++a)
        finer[DIM * i + a] = points[DIM * i + a];
    global REAL *child = finer + DIM * (n + child_starts[i]);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbors[k];
        if (is_fixed(i, j, labels, fixed))
            continue;
        if (j < 0) {
            if (!is_wall_side(k, starts[i], starts[i + 1], neighbors, face_measures, volumes[i]))
                continue;
#ifdef POLYGON
            const REAL2 m = (REAL2)(face_centroids[2 * k], face_centroids[2 * k + 1]), t = BOUNDARY_TANGENT(j);
            const REAL gap = m.s0 * t.s1 - m.s1 * t.s0;
            const REAL normal[2] = {-t.s1, t.s0};
            const REAL room = free_depth(i, h[i] / 2, gap, normal, starts, neighbors, points PERIODS);
            const REAL way = gap > h[i] / 8 ? fmin(gap / 2, h[i] / 4) : room / 2;
            const REAL x[2] = {points[2 * i], points[2 * i + 1]};
            REAL y[2] = {x[0] + m.s0 - way * t.s1, x[1] + m.s1 + way * t.s0};
            keep_separate(x, y, h[i] / 16, place_at_face(x, m, j, way, fixed, tangents, DOMAIN), DOMAIN);
            child[0] = y[0];
            child[1] = y[1];
#elif defined(SOLID)
            /* From the generator toward the wall face: half of the way, if that is not much less than h. */
            const REAL m[3] = {face_centroids[3 * k], face_centroids[3 * k + 1], face_centroids[3 * k + 2]};
            const REAL gap = sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2]), most = h[i];
            REAL normal[3], x[3], y[3];
            EACH_AXIS (a) {
                normal[a] = -m[a] / gap;
                x[a] = points[3 * i + a];
            }
            const REAL room = free_depth(i, most, gap, normal, starts, neighbors, points PERIODS);
            const REAL way = gap > most / 8 || room < 3 * gap ? fmax(gap / 2, gap - most / 4) : gap - room / 2;
            EACH_AXIS (a)
                y[a] = x[a] - way * normal[a];
            keep_inside(x, y, DOMAIN);
            EACH_AXIS (a)
                child[a] = y[a];
#else
            const int wall = -1 - j, axis = wall / 2;
            const REAL level = wall % 2 ? upper[axis] : lower[axis];
            REAL normal[DIM];
            for (int a = 0; a < DIM; ++a) {
                child[a] = points[DIM * i + a];
                normal[a] = a != axis ? 0 : wall % 2 ? -1 : 1;
            }
            /* In a box thinner than the cell: inside the cell, and not beyond the middle of the box. */
            const REAL gap = fabs(points[DIM * i + axis] - level);
            const REAL most = fmin(h[i], (upper[axis] - lower[axis]) / 2);
            const REAL room = free_depth(i, most, gap, normal, starts, neighbors, points PERIODS);
            const REAL way = gap > most / 8 || room < 3 * gap ? fmin(gap / 2, h[i] / 4) : room / 2;
            child[axis] = level + (wall % 2 ? -way : way);
#endif
        } else if (has_midpoint(NAME(i), NAME(j), face_measures[k], volumes[i])) {
#ifdef SPHERE
            REAL middle[3];
            EACH_AXIS (a)
                middle[a] = points[3 * i + a] + points[3 * j + a];
            onto_sphere(middle);
            EACH_AXIS (a)
                child[a] = middle[a];
#else
            for (int a = 0; a < DIM; ++a)
                child[a] = PLACED(a, points[DIM * i + a] + DIFFERENCE(a, points[DIM * i + a], points[DIM * j + a]) / 2);
#endif
#ifdef POLYGON
            /* Around a corner of the boundary the midpoint of the common face is visible from both generators. Of
               several common faces, all but the longest one (the first of equal ones) get their own new generator. */
            bool several = false;
            for (int m = starts[i]; m < starts[i + 1] && !several; ++m)
                several = neighbors[m] == j && m != k &&
                          (face_measures[m] > face_measures[k] || (face_measures[m] == face_measures[k] && m < k));
            const REAL x[2] = {points[2 * i], points[2 * i + 1]};
            REAL y[2] = {child[0], child[1]};
            if (several || exit_parameter(x, y, DOMAIN) <= 1) {
                const REAL2 m = (REAL2)(face_centroids[2 * k], face_centroids[2 * k + 1]);
                y[0] = x[0] + m.s0;
                y[1] = x[1] + m.s1;
                keep_separate(x, y, h[i] / 16, place_at_face(x, m, j, 0, fixed, tangents, DOMAIN), DOMAIN);
            }
            child[0] = y[0];
            child[1] = y[1];
#elif defined(SOLID)
            /* Around a concave crease: toward the common face. */
            const REAL x[3] = {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
            REAL y[3] = {child[0], child[1], child[2]};
            if (exit_parameter(x, y, DOMAIN) <= 1) {
                EACH_AXIS (a)
                    y[a] = x[a] + face_centroids[3 * k + a];
                keep_inside(x, y, DOMAIN);
                EACH_AXIS (a)
                    child[a] = y[a];
            }
#endif
        } else {
            continue;
        }
        child += DIM;
    }
}
