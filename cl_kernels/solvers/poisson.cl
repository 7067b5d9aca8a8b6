/* The two-point Laplacian on the neighbor graph, zero flux through walls:

       (A phi)_i = sum_j w_ij (phi_i - phi_j)        w_ij = rho_ij l_ij / |x_i - x_j|

   One work-item per cell in `assemble`, a block of cells per group elsewhere. Columns are the diagram's neighbors:
   walls are negative, and have weight 0. Weights and the vectors of an iteration are in STORE, which may be single. */
#include "geometry/domain.h"
#include "opencl/blocks.h"
#include "opencl/reduce.h"
#include "solvers/sparse_rows.h"

/* Whether two cells may have several faces: on both sides of a seam, or of a hole. */
#if defined(PERIODIC) || defined(POLYGON)
#define SEVERAL true
#else
#define SEVERAL false
#endif

/* Where the row of cell j names cell i first, negative if it does not; eight entries at a time on a CPU, as in
   row_difference. */
inline int place_of(int i, int j, int last, global const int *starts, global const int *neighbors)
{
    const int end = starts[j + 1];
    int k = starts[j];
#if GROUP_SIZE == 1
    for (; k < end && k <= last; k += 8) {
        const int8 at = k + (int8)(0, 1, 2, 3, 4, 5, 6, 7), named = (vload8(0, neighbors + k) == i) & (at < end);
        const int8 places = select((int8)(INT_MAX), at, named);
        const int4 p4 = min(places.lo, places.hi);
        const int2 p2 = min(p4.lo, p4.hi);
        const int place = min(p2.s0, p2.s1);
        if (place < end)
            return place;
    }
#endif
    for (; k < end; ++k)
        if (neighbors[k] == i)
            return k;
    return -1;
}

/* The measure of face k and of those behind it, up to `end`, that lead to the same cell. */
inline REAL measure_from(int k, int end, global const int *neighbors, global const FACE *face_measures)
{
    REAL measure = face_measures[k];
    for (int l = k + 1; SEVERAL && l < end; ++l)
        measure += neighbors[l] == neighbors[k] ? (REAL)face_measures[l] : 0;
    return measure;
}

/* Weights, where `weights` is 0 so far: each is put into the rows of both cells by the one of the lower number, so that
   A is symmetric to the last bit. The two have measured the face each for itself, with roundings of their own: it is
   the mean of the two. A face that only one of them has seen is shorter than rounding, and keeps the weight 0, as do
   walls and, of several faces of two cells, all but the first. rho_ij is the geometric mean, symmetric and closest to
   rho at the face where log rho is smooth. */
kernel void assemble(int n, int weighted, global const int *starts, global const int *neighbors,
                     global const FACE *face_measures, global const REAL *points, global const REAL *density,
                     global STORE *weights PERIOD_ARGS)
{
    const int i = get_global_id(0);
    if (i >= n)
        return;
    const REAL root_i = weighted ? sqrt(density[i]) : R(1);
    const int last = starts[n] - 8, end = starts[i + 1];
    for (int k = starts[i]; k < end; ++k) {
        const int j = neighbors[k];
        if (j <= i)
            continue;
        const int there = place_of(i, j, last, starts, neighbors);
        if (there < 0)
            continue;
        if (SEVERAL && place_of(j, i, last, starts, neighbors) < k)
            continue;
        REAL square = 0;
        EACH_AXIS(a)
        {
            const REAL d = DIFFERENCE(a, points[i * DIM + a], points[j * DIM + a]);
            square += d * d;
        }
        const REAL here = measure_from(k, end, neighbors, face_measures);
        const REAL other = measure_from(there, starts[j + 1], neighbors, face_measures);
        REAL weight = R(0.5) * (here + other) / sqrt(square);
        if (weighted)
            weight *= root_i * sqrt(density[j]);
        weights[k] = weight;
        weights[there] = weight;
    }
}

/* The inverse of each row's sum, 0 where there is no neighbor: Jacobi's preconditioner. */
kernel void invert_diagonal(int n, global const int *starts, global const STORE *weights, global STORE *inverse)
{
    const int i = get_global_id(0);
    if (i >= n)
        return;
    REAL sum = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k)
        sum += weights[k];
    inverse[i] = sum == 0 ? 0 : 1 / sum;
}

/* y = A x, and row `q` of partial = (x, y). */
kernel void apply(int n, int q, global const int *starts, global const int *columns, global const STORE *weights,
                  global const STORE *x, global STORE *y, global REAL *partial)
{
    local REAL scratch[GROUP_SIZE];
    Sum product = SUM_ZERO;
    for (BLOCK_LOOP(i, n)) {
        const STORE yi = row_difference(i, n, starts, columns, weights, x);
        y[i] = yi;
        sum_add(&product, (REAL)x[i] * yi);
    }
    const REAL put = group_sum(product.value, scratch);
    if (get_local_id(0) == 0)
        partial[q * get_num_groups(0) + get_group_id(0)] = put;
}

/* The same without the product, for an x in full precision: the residual of a start. */
kernel void apply_full(int n, global const int *starts, global const int *columns, global const STORE *weights,
                       global const REAL *x, global STORE *y)
{
    for (BLOCK_LOOP(i, n)) {
        REAL sum = 0;
        for (int k = starts[i]; k < starts[i + 1]; ++k)
            if (columns[k] >= 0)
                sum += weights[k] * (x[i] - x[columns[k]]);
        y[i] = sum;
    }
}

/* The right side V_i (s_i - mean s), mean = sum V s / sum V, whose sum vanishes: partial sums, then the values. */
kernel void source_sums(int n, global const REAL *source, global const REAL *volumes, global REAL *partial)
{
    local REAL scratch[GROUP_SIZE];
    Sum moment = SUM_ZERO, volume = SUM_ZERO;
    for (BLOCK_LOOP(i, n)) {
        sum_add(&moment, volumes[i] * source[i]);
        sum_add(&volume, volumes[i]);
    }
    const REAL put_moment = group_sum(moment.value, scratch), put_volume = group_sum(volume.value, scratch);
    if (get_local_id(0) == 0) {
        partial[get_group_id(0)] = put_moment;
        partial[get_num_groups(0) + get_group_id(0)] = put_volume;
    }
}

kernel void compatible(int n, global const REAL *source, global const REAL *volumes, global REAL *rhs,
                       global const REAL *partial)
{
    local REAL scratch[GROUP_SIZE];
    const REAL moment = total_sum(partial, scratch), volume = total_sum(partial + get_num_groups(0), scratch);
    const REAL mean = moment / volume;
    for (BLOCK_LOOP(i, n))
        rhs[i] = volumes[i] * (source[i] - mean);
}
