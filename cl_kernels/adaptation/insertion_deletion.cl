/* Insertion and deletion of generators, the paper's 2.3.1. One work-item per generator.

   A hexagonal mesh that follows a size field must contain dislocations: pairs of a 5-sided and a 7-sided cell (charges
   -1 and +1). A dislocation under strain climbs: under tension across its axis the 7-sided cell is split, under
   compression the 5-sided one is deleted. A dislocation at a wall can end there. The same changes correct the number of
   generators. Sites that change in the same call are several rings of cells apart. */
#include "adaptation/separation.h"
#include "adaptation/site_selection.h"
#include "opencl/blocks.h"
#include "opencl/row_entries.h"

#if CELL_DIM == 2
inline REAL2 difference(global const REAL *points, int from, int to PERIOD_ARGS)
{
    SITE(x, from, points);
    return VECTOR_TO(x, to, points);
}

/* The strain of cell j in the axes of cell i. */
inline float4 strain_from(int i, int j, global const float4 *strain, global const REAL *points)
{
    float4 s = strain[j];
#ifdef SPHERE
    SITE(own, i, points);
    SITE(other, j, points);
    const REAL2 e = along_tangents(own, other + 3), f = along_tangents(own, other + 6);
    const float a = (float)e.s0, b = (float)e.s1, c = (float)f.s0, d = (float)f.s1;
    s.s012 =
        (float3)(a * a * s.s0 + 2 * a * c * s.s1 + c * c * s.s2, a * b * s.s0 + (a * d + b * c) * s.s1 + c * d * s.s2,
                 b * b * s.s0 + 2 * b * d * s.s1 + d * d * s.s2);
#endif
    return s;
}

#define LATTICE_2 R(1.1547005383792515) /* (neighbor distance / h)^2 of a regular hexagonal mesh: 2 / sqrt 3 */

/* kinds[i] = (charge, walls), charge = number of sides minus that of a perfect lattice: 6 inside, 5 at a wall, 4 in a
   corner. strain[i] = (xx, xy, yy, weight) of S = mean_j 2 d d^T / (a^2 h_i h_j), the identity in an unstrained
   lattice, in single precision. Only six-sided inner cells have weight. */
kernel void measure_strain(const int size, global const int *starts, global const int *neighbors,
                           global const REAL *points, global const REAL *h, global int2 *kinds,
                           global float4 *strain OUTLINE_ARGS PERIOD_ARGS)
{
    WORK_ITEM(i);
    const int n = starts[i + 1] - starts[i];
    int walls = 0;
    REAL4 s = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbors[k];
        if (j < 0) {
            ++walls;
            continue;
        }
        const REAL2 d = difference(points, i, j PERIODS);
        s += 2 / (LATTICE_2 * h[i] * h[j]) * (REAL4)(d.s0 * d.s0, d.s0 * d.s1, d.s1 * d.s1, 0);
    }
#ifdef POLYGON
    /* The charge is rounded to the nearest integer, and halves towards 0. A cell between two boundaries, or at a sharp
       corner, counts as one in a corner. */
    const REAL charge = n - walls - outlines[i].s1;
    kinds[i] = (int2)((int)(charge > 0 ? ceil(charge - R(0.5)) : floor(charge + R(0.5))),
                      walls == 0 ? 0 : (outlines[i].s1 < R(3.2) ? 2 : 1));
#else
    kinds[i] = (int2)(n - (6 - min(walls, 2)), walls);
#endif
    s /= max(n - walls, 1);
    strain[i] = (float4)(s.s0, s.s1, s.s2, walls == 0 && n == 6);
}

#ifdef SPHERE
/* Add to `sum` the strain (xx, xy, yy) of the neighbors times its weight, in the axes of cell i, and the weights: as
   `strain_from`, for AT_ONCE neighbors. */
inline float4 add_strains(float4 sum, int i, int size, global const int *starts, global const int *neighbors,
                          global const REAL *points, global const float4 *strain)
{
    global const float *entries = (global const float *)strain;
    const float x[3] = {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
    float e[3], f[3];
    FLOAT_TANGENTS(float, x, e, f);
    MANY(float) xx = 0, xy = 0, yy = 0, weight = 0;
    const int faces = starts[size], end = starts[i + 1];
    for (int k = starts[i]; k < end; k += AT_ONCE) {
        const MANY(int) inside = INSIDE(k, end), j = TAKE(int, neighbors, k, faces);
        MANY(float) y[3], p[3], q[3];
        EACH_AXIS (axis)
            y[axis] = CONVERT(float, PICK(REAL, points, j, 3, axis));
        FLOAT_TANGENTS(MANY(float), y, p, q);
        const MANY(float) a = ALONG(MANY(float), e, p), b = ALONG(MANY(float), f, p);
        const MANY(float) c = ALONG(MANY(float), e, q), d = ALONG(MANY(float), f, q);
        const MANY(float) w = CHOOSE(float, inside, PICK(float, entries, j, 4, 3), 0);
        const MANY(float) s0 = w * PICK(float, entries, j, 4, 0), s1 = w * PICK(float, entries, j, 4, 1),
                          s2 = w * PICK(float, entries, j, 4, 2);
        xx += a * a * s0 + 2 * a * c * s1 + c * c * s2;
        xy += a * b * s0 + (a * d + b * c) * s1 + c * d * s2;
        yy += b * b * s0 + 2 * b * d * s1 + d * d * s2;
        weight += w;
    }
    return sum + (float4)(SUM(float, xx), SUM(float, xy), SUM(float, yy), SUM(float, weight));
}
#else
inline float4 add_strains(float4 sum, int i, int size, global const int *starts, global const int *neighbors,
                          global const REAL *points, global const float4 *strain)
{
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbors[k];
        if (j < 0)
            continue;
        const float4 other = strain[j];
        sum += (float4)(other.s012 * other.s3, other.s3);
    }
    return sum;
}
#endif

/* mean[i] = weighted mean of the strain over i and its neighbors, and the sum of the weights. */
kernel void average_strain(const int size, global const int *starts, global const int *neighbors,
                           global const REAL *points, global const float4 *strain, global float4 *mean)
{
    WORK_ITEM(i);
    const float4 own = strain[i];
    const float4 sum = add_strains((float4)(own.s012 * own.s3, own.s3), i, size, starts, neighbors, points, strain);
    mean[i] = (float4)(sum.s3 > 0 ? sum.s012 / sum.s3 : (float3)(1, 0, 1), sum.s3);
}

/* pull[i] = b.S.b - t.S.t for a cell i of negative charge and the neighbor of positive charge where |pull| is largest;
   t points to the neighbor, b across. Pairs with both cells at walls are left out. Pairs with one cell at a wall (with
   `at_walls`), and cells with a charge of 2, get the strongest keys. partners[i] = (name, charge, walls, 0) of the
   neighbor; the name is -1 if there is none. */
kernel void score_pairs(const int size, global const int *starts, global const int *neighbors,
                        global const REAL *points, global const int2 *kinds, global const float4 *strain,
                        const int at_walls, NAME_ARGS, global int4 *partners, global REAL *pull,
                        global ulong *keys PERIOD_ARGS)
{
    LONG_ITEM(i);
    REAL best = 0, rank = 0;
    int partner = -1;
    const int2 kind = kinds[i];
    if (kind.s0 < 0 && (kind.s1 == 0 || at_walls))
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            const int j = neighbors[k];
            if (j < 0 || kinds[j].s0 < 1)
                continue;
            const bool one_wall = (kind.s1 > 0) != (kinds[j].s1 > 0);
            if ((kind.s1 > 0 && kinds[j].s1 > 0) || (one_wall && !at_walls))
                continue;
            const REAL2 d = difference(points, i, j PERIODS);
            const float4 s = (strain[i] + strain_from(i, j, strain, points)) / 2;
            const REAL along = s.s0 * d.s0 * d.s0 + 2 * s.s1 * d.s0 * d.s1 + s.s2 * d.s1 * d.s1;
            const REAL across = s.s0 * d.s1 * d.s1 - 2 * s.s1 * d.s0 * d.s1 + s.s2 * d.s0 * d.s0;
            const REAL value = (across - along) / dot(d, d);
            const bool first = one_wall || kind.s0 < -1 || kinds[j].s0 > 1;
            const REAL value_rank = fabs(value) + (first ? R(WALL_STRAIN) : R(0));
            if (partner < 0 || value_rank > rank) {
                best = value;
                rank = value_rank;
                partner = j;
            }
        }
    partners[i] = partner < 0 ? (int4)(-1) : (int4)(NAME(partner), kinds[partner], 0);
    pull[i] = best;
    keys[i] = partner < 0 ? 0 : site_key(rank, NAME(i));
}

/* Change of the number of generators by a pair: 1 if it is split, -1 if it is deleted. Thresholds are shifted to
   correct the number: shift m of 0..SHIFTS-1 is (m - SHIFTS / 2) SHIFT_STEP. A pair with one cell at a wall ends there,
   unless the strain is strong: a wall cell of charge -1 is deleted, one of charge +1 is split along the wall. An inner
   cell of four sides is always deleted, one of eight always split. */
inline int count_change(REAL pull, int2 minus, int2 plus, REAL theta, REAL shift)
{
    if (minus.s0 < -1 && minus.s1 == 0)
        return -1;
    if (plus.s0 > 1 && plus.s1 == 0)
        return 1;
    if (minus.s1 > 0)
        return pull < R(WALL_STRAIN) ? -1 : 0;
    if (plus.s1 > 0)
        return pull > -R(WALL_STRAIN) ? 1 : 0;
    if (pull > theta - shift)
        return 1;
    return -pull > theta + shift ? -1 : 0;
}

/* tally[m] += change of the number of generators with shift m. Integer sums do not depend on the order. */
kernel void count_pair_changes(const int size, global const ulong *chosen, global const REAL *pull,
                               global const int2 *kinds, global const int4 *partners, const REAL theta,
                               global int *tally)
{
    WORK_ITEM(i);
    if (chosen[i] == 0)
        return;
    for (int m = 0; m < SHIFTS; ++m) {
        const REAL shift = (m - SHIFTS / 2) * R(SHIFT_STEP);
        const int change = count_change(pull[i], kinds[i], partners[i].s12, theta, shift);
        if (change)
            atomic_add(tally + m, change);
    }
}

/* Per cell j of a chosen pair: of charge -1, delete it; of charge +1, split it into two generators across the pair.
   `busy` marks the cells of charge -1 of the pairs that change. A ghost may be the other cell. */
kernel void mark_pairs(const int size, global const int *starts, global const int *neighbors,
                       global const ulong *chosen, global const REAL *pull, global const int2 *kinds,
                       global const int4 *partners, const REAL theta, const REAL shift, NAME_ARGS,
                       global const REAL *points, global const REAL *local_length, global int *kept,
                       global REAL *shifts, global int *born, global REAL *births, global ulong *busy PERIOD_ARGS)
{
    WORK_ITEM(j);
    if (chosen[j] != 0) {
        const int change = count_change(pull[j], kinds[j], partners[j].s12, theta, shift);
        if (change != 0)
            busy[j] = 1;
        if (change < 0)
            kept[j] = 0;
    }
    for (int k = starts[j]; k < starts[j + 1]; ++k) {
        const int i = neighbors[k];
        if (i < 0 || chosen[i] == 0 || partners[i].s0 != NAME(j) ||
            count_change(pull[i], kinds[i], partners[i].s12, theta, shift) <= 0)
            continue;
        const REAL2 d = difference(points, i, j PERIODS);
        const REAL2 across = (REAL2)(-d.s1, d.s0) / sqrt(dot(d, d));
        born[j] = 1;
        const REAL2 way = R(SPLIT_DISTANCE) * local_length[j] * across;
        SITE(x, i, points);
        put_vector(x, way, j, shifts);
        put_vector(x, -way, j, births);
        return;
    }
}

/* Sites of nucleation: six-sided cells among six-sided cells with an anisotropy of the strain, the difference of its
   eigenvalues, above `threshold`. */
kernel void score_strain(const int size, global const int *starts, global const int *neighbors,
                         global const int2 *kinds, global const float4 *strain, const REAL threshold, NAME_ARGS,
                         global ulong *keys)
{
    WORK_ITEM(i);
    bool clean = kinds[i].s0 == 0 && kinds[i].s1 == 0;
    for (int k = starts[i]; k < starts[i + 1] && clean; ++k)
        clean = kinds[neighbors[k]].s0 == 0 && kinds[neighbors[k]].s1 == 0;
    const float4 s = strain[i];
    const REAL anisotropy = sqrt((s.s0 - s.s2) * (s.s0 - s.s2) + 4 * s.s1 * s.s1);
    keys[i] = clean && anisotropy > threshold ? site_key(anisotropy, NAME(i)) : 0;
}

/* Per chosen site, alternating by rank, from `first` on: insert a generator at the midpoint of its longest edge, or
   merge it with its nearest neighbor, whose name is merged[i]; else -1. */
kernel void mark_nuclei(const int size, global const ulong *chosen, global const int *ranks, const int first,
                        global const int *starts, global const int *neighbors, global const REAL *points, NAME_ARGS,
                        global REAL *shifts, global int *born, global REAL *births, global ulong *busy,
                        global int *merged PERIOD_ARGS)
{
    WORK_ITEM(i);
    merged[i] = -1;
    if (chosen[i] == 0)
        return;
    const bool insert = (first + ranks[i]) % 2 == 0;
    REAL best = 0;
    int partner = -1;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const REAL2 d = difference(points, i, neighbors[k] PERIODS);
        const REAL d2 = dot(d, d);
        if (partner < 0 || (insert ? d2 > best : d2 < best)) {
            best = d2;
            partner = neighbors[k];
        }
    }
    const REAL2 half_way = difference(points, i, partner PERIODS) / 2;
    SITE(x, i, points);
    if (insert) {
        born[i] = 1;
        put_vector(x, half_way, i, births);
    } else {
        put_vector(x, half_way, i, shifts);
        merged[i] = NAME(partner);
    }
    busy[i] = 1;
}

/* Per cell j: delete it if a neighbor, maybe a ghost, merges with it. */
kernel void delete_merged(const int size, global const int *starts, global const int *neighbors,
                          global const int *merged, NAME_ARGS, global int *kept)
{
    WORK_ITEM(j);
    for (int k = starts[j]; k < starts[j + 1]; ++k)
        if (neighbors[k] >= 0 && merged[neighbors[k]] == NAME(j))
            kept[j] = 0;
}
#endif

/* Sites to split (sign > 0) or to delete (sign < 0): cells that are too large or too small for h. Cells of many faces
   are preferred for splitting, cells of few faces for deletion. Magnitudes are limited to 4. A cell without neighbors,
   the last one of a piece of the domain, is never deleted. */
kernel void score_log_ratio(const int size, global const int *starts, global const int *neighbors,
                            global const REAL *log_ratio, const REAL sign, NAME_ARGS, global ulong *keys)
{
    WORK_ITEM(i);
    bool isolated = sign < 0;
    for (int k = starts[i]; k < starts[i + 1] && isolated; ++k)
        isolated = neighbors[k] < 0;
    if (isolated) {
        keys[i] = 0;
        return;
    }
    const REAL magnitude = 2 + sign * need_of_split(log_ratio[i], starts[i + 1] - starts[i]);
    keys[i] = magnitude > 0 ? site_key(fmin(magnitude, R(4)), NAME(i)) : 0;
}

/* Unit vector along the longest axis of a cell, from its second moments. */
#if CELL_DIM == 2
inline void longest_axis(global const REAL *moments, REAL *axis)
{
    const REAL angle = atan2(2 * moments[1], moments[0] - moments[2]) / 2;
    axis[0] = cos(angle);
    axis[1] = sin(angle);
}
#else
inline void longest_axis(global const REAL *moments, REAL *axis)
{
    /* Power iteration from the longest coordinate axis. The axis of a nearly round cell does not matter. */
    const REAL xx = moments[0], xy = moments[1], xz = moments[2], yy = moments[3], yz = moments[4], zz = moments[5];
    REAL3 v = (REAL3)(xx >= yy && xx >= zz, yy > xx && yy >= zz, zz > xx && zz > yy);
    for (int k = 0; k < 12; ++k) {
        v = (REAL3)(xx * v.s0 + xy * v.s1 + xz * v.s2, xy * v.s0 + yy * v.s1 + yz * v.s2,
                    xz * v.s0 + yz * v.s1 + zz * v.s2);
        v /= sqrt(dot(v, v));
    }
    axis[0] = v.s0;
    axis[1] = v.s1;
    axis[2] = v.s2;
}
#endif

/* Split cell i across its longest axis. */
inline void split_cell(int i, global const REAL *points, global const REAL *offsets, global const REAL *covariances,
                       global const REAL *volumes, global REAL *shifts, global int *born, global REAL *births)
{
    REAL axis[DIM];
    longest_axis(covariances + CELL_DIM * (CELL_DIM + 1) / 2 * i, axis);
#ifdef SPHERE
    SITE(x, i, points);
    in_space(x, (REAL2)(axis[0], axis[1]), axis);
#endif
    const REAL quarter = (CELL_DIM == 2 ? sqrt(volumes[i]) : cbrt(volumes[i])) / 4;
    born[i] = 1;
    for (int a = 0; a < DIM; ++a) {
        shifts[DIM * i + a] = offsets[DIM * i + a] + quarter * axis[a];
        births[DIM * i + a] = offsets[DIM * i + a] - quarter * axis[a];
    }
}

/* Per chosen site: split a cell of at least `split_from` faces, delete any other. */
kernel void mark_split_delete(const int size, global const ulong *chosen, global const int *starts,
                              const int split_from, global const REAL *points, global const REAL *offsets,
                              global const REAL *covariances, global const REAL *volumes, global int *kept,
                              global REAL *shifts, global int *born, global REAL *births)
{
    WORK_ITEM(i);
    if (chosen[i] == 0)
        return;
    if (starts[i + 1] - starts[i] < split_from)
        kept[i] = 0;
    else
        split_cell(i, points, offsets, covariances, volumes, shifts, born, births);
}

#if CELL_DIM == 2
/* Sites to repair: inner cells with 1 - Q above `deficit`. Cells of at most four or at least eight sides come first,
   at any Q: they have a generator too many or too few around them. */
kernel void score_bad_cells(const int size, global const int *starts, global const int *neighbors,
                            global const REAL *quality, const REAL deficit, NAME_ARGS, global ulong *keys)
{
    WORK_ITEM(i);
    const int n = starts[i + 1] - starts[i];
    const bool odd = n < 5 || n > 7;
    const REAL own = 1 - quality[i];
    bool site = odd || own > deficit;
    for (int k = starts[i]; k < starts[i + 1] && site; ++k)
        site = neighbors[k] >= 0;
    keys[i] = site ? site_key(odd + own, NAME(i)) : 0;
}
#endif

/* Write generator i, if it is kept, and its new generator, if there is one, to the new arrays. place and birth_place
   are the prefix sums of kept and born. New generators follow all kept ones and get new labels. */
kernel void apply_changes(const int size, global const int *place, global const int *birth_place, const int next_label,
                          const int fixed, DOMAIN_ARGS, global const REAL *points, global const int *labels,
                          global const REAL *velocity, global const ulong *signatures, global const REAL *ever_changed,
                          global const REAL *shifts, global const REAL *births, global REAL *new_points,
                          global int *new_labels, global REAL *new_velocity, global ulong *new_signatures,
                          global REAL *new_ever_changed, global const int *starts, global const int *neighbors,
                          global const FACE *face_centroids OUTLINE_ARGS)
{
    LONG_ITEM(i);
    const bool kept = place[i + 1] > place[i], born = birth_place[i + 1] > birth_place[i];
    REAL x[DIM], y[DIM], child[DIM];
    bool moved = false;
    EACH_AXIS (a) {
        x[a] = points[DIM * i + a];
        y[a] = x[a] + shifts[DIM * i + a];
        child[a] = x[a] + births[DIM * i + a];
        moved |= shifts[DIM * i + a] != 0;
    }
    if (moved)
        keep_inside(x, y, DOMAIN);
    if (born)
        keep_inside(x, child, DOMAIN);
#ifdef POLYGON
    if (born && kept)
        moved &=
            !separate_child(x, y, child, (REAL2)(births[2 * i] - shifts[2 * i], births[2 * i + 1] - shifts[2 * i + 1]),
                            fixed, neighbors, face_centroids, starts[i], starts[i + 1], tangents, DOMAIN);
#endif
    if (kept) {
        const int p = place[i];
        EACH_AXIS (a) {
            new_points[DIM * p + a] = y[a];
            new_velocity[DIM * p + a] = moved ? 0 : velocity[DIM * i + a];
        }
        new_labels[p] = labels[i];
        new_signatures[p] = signatures[i];
        new_ever_changed[p] = ever_changed[i];
    }
    if (born) {
        const int q = place[size] + birth_place[i];
        EACH_AXIS (a) {
            new_points[DIM * q + a] = child[a];
            new_velocity[DIM * q + a] = 0;
        }
        new_labels[q] = next_label + birth_place[i];
        new_signatures[q] = 0;
        new_ever_changed[q] = 1;
    }
}
