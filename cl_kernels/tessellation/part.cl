#include "opencl/blocks.h"
#include "opencl/real.h"

/* A number from 1 to 2 for the face between the generators with labels a and b, whichever comes first. */
inline REAL weight_of_face(int a, int b)
{
    uint h = as_uint(min(a, b)) * 2654435761u ^ as_uint(max(a, b)) * 2246822519u;
    h = (h ^ h >> 15) * 3266489917u;
    return 1 + (REAL)(h >> 16) / 65536;
}

/* Radius of the ball around generator i in which its part must know all generators. The radius is `factor` times the
   reach of the cell. If the cells of ghosts must be final, too (`with_ghosts`), the ball also contains the balls of the
   ghosts beside the cell, generators n to rows - 1. Where a boundary cuts cells, these are the convex cells, with the
   reach of what is in the domain. */
inline REAL certified_radius(int i, int n, int rows, int with_ghosts, REAL factor, global const int *starts,
                             global const int *neighbors, global const float *reach, global const REAL *points)
{
    REAL radius = factor * reach[i];
    for (int k = with_ghosts ? starts[i] : starts[i + 1]; k < starts[i + 1]; ++k) {
        const int j = neighbors[k];
        if (j < n || j >= rows)
            continue;
        REAL way2 = 0;
        for (int a = 0; a < DIM; ++a) {
            const REAL d = points[DIM * j + a] - points[DIM * i + a];
            way2 += d * d;
        }
        radius = fmax(radius, sqrt(way2) + factor * reach[j]);
    }
    return radius;
}

/* Length of the period along axis a; 0 between walls. Positions and periods are multiples of eps, so that their sums
   and differences are exact. */
inline REAL period_along(int a, REAL4 periods)
{
    return a == 0 ? periods.s0 : a == 1 ? periods.s1 : periods.s2;
}

/* Whether y is half a period or farther from x along an axis. */
inline bool is_far(global const REAL *x, global const REAL *y, REAL4 periods)
{
    bool far = false;
    for (int a = 0; a < DIM; ++a) {
        const REAL period = period_along(a, periods);
        far = far || (period > 0 && 2 * fabs(y[a] - x[a]) >= period);
    }
    return far;
}

/* points[i] = own[i] = the image of sites[i] that is nearest to own[i]. One work-item per generator. */
kernel void follow_images(const int size, global const REAL *sites, const REAL4 periods, global REAL *own,
                          global REAL *points)
{
    WORK_ITEM(i);
    for (int k = DIM * i; k < DIM * (i + 1); ++k) {
        const REAL period = period_along(k - DIM * i, periods), d = sites[k] - own[k];
        points[k] = own[k] = sites[k] + (2 * d > period ? -period : 2 * d < -period ? period : 0);
    }
}

/* Move ghost g, points[n + g], by the periods of its code (see `Ghosts` in part.py). One work-item per ghost. */
kernel void shift_ghosts(const int size, const int n, global const int *codes, const REAL4 periods, global REAL *points)
{
    WORK_ITEM(g);
    for (int a = 0, code = codes[g]; a < DIM; ++a, code /= 3)
        points[DIM * (n + g) + a] += (code % 3 - 1) * period_along(a, periods);
}

/* placed[i] = the image of points[i] in the domain. One work-item per row. */
kernel void place_unfolded(const int size, global const REAL *points, const REAL4 periods, global REAL *placed)
{
    WORK_ITEM(i);
    for (int k = DIM * i; k < DIM * (i + 1); ++k) {
        const REAL period = period_along(k - DIM * i, periods);
        REAL x = points[k];
        /* An image of a generator that has crossed the seam may be two periods away. */
        for (int turn = 0; turn < 2 && period > 0; ++turn)
            x = x < 0 ? x + period : x >= period ? x - period : x;
        placed[k] = x;
    }
}

/* sums[6 t ...] = the volumes of a share of the n generators; the weighted measures of their faces with ghosts,
   positive in the cell of the lower label; those without signs; how many of these generators have too small a ball; how
   many have moved too far; and how many neighbors are half a period away or farther. Over all parts the second sum is
   zero if each face has both sides. One work-item per t; `size` is a multiple of GROUP_SIZE.

   needed[i] is the radius above, and how far generator i has moved. When generator i was at at[i], its part knew all
   generators within limits[i].s0 of it, and it was at least limits[i].s1 away from the balls of other parts that do not
   know it. */
kernel void sum_cells(const int size, const int n, const int rows, global const int *convex_starts,
                      global const int *convex_neighbors, global const int *starts, global const int *neighbors,
                      global const int *labels, global const FACE *face_measures, global const REAL *volumes,
                      const int with_ghosts, const REAL factor, global const float *reach, global const REAL *points,
                      global const REAL *at, global const float2 *limits, global float2 *needed, const REAL4 periods,
                      global REAL *sums)
{
    WORK_ITEM(t);
    const bool folds = fmax(periods.s0, fmax(periods.s1, periods.s2)) > 0;
    REAL volume = 0, signed_sum = 0, sum = 0, small = 0, beyond = 0, far = 0;
    for (LOOP_OF_ITEM(i, n, t / GROUP_SIZE, size / GROUP_SIZE, t % GROUP_SIZE)) {
        REAL moved2 = 0;
        for (int a = 0; a < DIM; ++a) {
            const REAL d = points[DIM * i + a] - at[DIM * i + a];
            moved2 += d * d;
        }
        const REAL moved = sqrt(moved2);
        const REAL radius =
            certified_radius(i, n, rows, with_ghosts, factor, convex_starts, convex_neighbors, reach, points);
        needed[i] = (float2)((float)(radius * (1 + R(1e-6))), (float)(moved * (1 + R(1e-6))));
        small += !(radius + moved <= limits[i].s0);
        beyond += !(moved <= limits[i].s1);
        volume += volumes[i];
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            const int j = neighbors[k];
            if (folds && j >= 0)
                far += is_far(points + DIM * i, points + DIM * j, periods);
            if (j < n)
                continue;
            const REAL part = face_measures[k] * weight_of_face(labels[i], labels[j]);
            signed_sum += labels[i] < labels[j] ? part : -part;
            sum += part;
        }
    }
    const REAL all[6] = {volume, signed_sum, sum, small, beyond, far};
    for (int k = 0; k < 6; ++k)
        sums[6 * t + k] = all[k];
}

/* bounds[2 DIM t ...] = the lower and the upper corner of the box around a share of the n points. One work-item per t;
   `size` is a multiple of GROUP_SIZE. */
kernel void bound_points(const int size, const int n, global const REAL *points, global REAL *bounds)
{
    WORK_ITEM(t);
    for (int a = 0; a < DIM; ++a) {
        REAL lower = REAL_MAX, upper = -REAL_MAX;
        for (LOOP_OF_ITEM(i, n, t / GROUP_SIZE, size / GROUP_SIZE, t % GROUP_SIZE)) {
            lower = fmin(lower, points[DIM * i + a]);
            upper = fmax(upper, points[DIM * i + a]);
        }
        bounds[2 * DIM * t + a] = lower;
        bounds[2 * DIM * t + DIM + a] = upper;
    }
}

/* values[n + g] = values[rows[g]] for each ghost g. Rows of values have `words` 32-bit words of any type. A ghost
   without owner, rows[g] < 0, keeps its values. One work-item per ghost. */
kernel void forward_values(const int size, const int n, global const int *rows, const int words, global uint *values)
{
    WORK_ITEM(g);
    const int i = rows[g];
    for (int w = 0; w < words && i >= 0; ++w)
        values[words * (n + g) + w] = values[words * i + w];
}

/* Copy row items[p] of `values` to row p of `packed`, from column `first` on. Columns are 32-bit words of any type;
   there are `words` in a row of `values`, and `row` in one of `packed`. One work-item per item. */
kernel void pack_rows(const int size, global const int *items, global const uint *values, const int words,
                      const int row, const int first, global uint *packed)
{
    WORK_ITEM(p);
    for (int w = 0; w < words; ++w)
        packed[row * p + first + w] = values[words * items[p] + w];
}

/* Copy the same columns of row p of `packed` to row n + p of `values`. One work-item per row. */
kernel void unpack_rows(const int size, const int n, global const uint *packed, const int words, const int row,
                        const int first, global uint *values)
{
    WORK_ITEM(p);
    for (int w = 0; w < words; ++w)
        values[words * (n + p) + w] = packed[row * p + first + w];
}
