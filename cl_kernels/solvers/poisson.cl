/* The Poisson matrix: the two-point Laplacian on the neighbor graph, with zero flux through walls, the paper's (3.2):

       (A phi)_i = sum_j w_ij (phi_i - phi_j)        w_ij = rho_ij l_ij / |x_i - x_j|

   `assemble_laplacian` assembles it, one work-item per cell. The other kernels give each work-group a block of cells.
   Columns are the neighbors of the diagram: walls are negative and have weight 0. Weights and the vectors of an
   iteration are in STORE, which may be single precision. */
#include "geometry/domain.h"
#include "opencl/blocks.h"
#include "opencl/reduce.h"
#include "opencl/row_entries.h"
#include "solvers/partial_sums.h"
#include "solvers/sparse_rows.h"

/* Whether two cells may share several faces: across the periods of a box, or around a hole. */
#if defined(PERIODIC) || defined(POLYGON)
#define SEVERAL true
#else
#define SEVERAL false
#endif

/* Sum of the measures of face k and of the later faces of its row, up to `end`, that lead to the same cell. */
inline REAL sum_measures(int k, int end, global const int *neighbors, global const FACE *face_measures)
{
    REAL measure = face_measures[k];
    for (int l = k + 1; SEVERAL && l < end; ++l)
        measure += neighbors[l] == neighbors[k] ? (REAL)face_measures[l] : 0;
    return measure;
}

/* w_ij = rho_ij l_ij / |x_i - x_j|, rho_ij = sqrt(rho_i rho_j), one work-item per cell i. `weights` must be 0 before.

   The work-item of the lower cell writes the entry of both rows, so that A is symmetric to the last bit. l_ij is the
   mean of the two cells' measures of the face, which differ by round-off. The weight stays 0 for walls, for a face that
   only one cell has (shorter than round-off), and for all but the first of several faces of two cells. A ghost, j >= n,
   has no row: its l_ij is the measure that cell i has. */
kernel void assemble_laplacian(int size, int weighted, global const int *starts, global const int *neighbors,
                               global const FACE *face_measures, global const REAL *points, global const REAL *density,
                               global STORE *weights PERIOD_ARGS)
{
    WORK_ITEM(i);
    const REAL root_i = weighted ? sqrt(density[i]) : R(1);
    const int last = starts[size] - 8, end = starts[i + 1];
    for (int k = starts[i]; k < end; ++k) {
        const int j = neighbors[k];
        if (j <= i)
            continue;
        const int there = j < size ? find_entry(i, j, last, starts, neighbors) : k;
        if (there < 0)
            continue;
        if (SEVERAL && find_entry(j, i, last, starts, neighbors) < k)
            continue;
        REAL square = 0;
        EACH_AXIS (a) {
            const REAL d = DIFFERENCE(a, points[i * DIM + a], points[j * DIM + a]);
            square += d * d;
        }
        const REAL here = sum_measures(k, end, neighbors, face_measures);
        const REAL other = j < size ? sum_measures(there, starts[j + 1], neighbors, face_measures) : here;
        REAL weight = R(0.5) * (here + other) / sqrt(square);
        if (weighted)
            weight *= root_i * sqrt(density[j]);
        weights[k] = weight;
        weights[there] = weight;
    }
}

/* inverse_i = 1 / sum_j w_ij, or 0 if the sum is 0: Jacobi's preconditioner. */
kernel void invert_diagonal(int size, global const int *starts, global const STORE *weights, global STORE *inverse)
{
    WORK_ITEM(i);
    REAL sum = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k)
        sum += weights[k];
    inverse[i] = sum == 0 ? 0 : 1 / sum;
}

/* y = A x, and row q of partial = (x, y). */
kernel void apply_laplacian(int n, int q, global const int *starts, global const int *columns,
                            global const STORE *weights, global const STORE *x, global STORE *y, global REAL *partial)
{
    LONG_GROUP;
    Sum product = SUM_ZERO;
    for (GROUP_LOOP(i, n)) {
        const STORE yi = row_difference(i, n, starts, columns, weights, x);
        y[i] = yi;
        sum_add(&product, (REAL)x[i] * yi);
    }
    PUT(q, product.value);
}

/* y = A x for x in REAL, without the scalar product: for the residual of a start. */
kernel void apply_laplacian_full(int n, global const int *starts, global const int *columns,
                                 global const STORE *weights, global const REAL *x, global STORE *y)
{
    for (BLOCK_LOOP(i, n)) {
        REAL sum = 0;
        for (int k = starts[i]; k < starts[i + 1]; ++k)
            if (columns[k] >= 0)
                sum += weights[k] * (x[i] - x[columns[k]]);
        y[i] = sum;
    }
}

/* Rows 0 and 1 of partial: sum V s and sum V. */
kernel void sum_sources(int n, global const REAL *source, global const REAL *volumes, global REAL *partial)
{
    LONG_GROUP;
    Sum moment = SUM_ZERO, volume = SUM_ZERO;
    for (GROUP_LOOP(i, n)) {
        sum_add(&moment, volumes[i] * source[i]);
        sum_add(&volume, volumes[i]);
    }
    PUT(0, moment.value);
    PUT(1, volume.value);
}

/* rhs_i = V_i (s_i - mean s), mean s = sum V s / sum V: the right sides sum up to 0. */
kernel void subtract_mean_source(int n, global const REAL *source, global const REAL *volumes, global REAL *rhs,
                                 global const REAL *partial)
{
    LONG_GROUP;
    const REAL moment = total_sum(ROW(0), group), volume = total_sum(ROW(1), group);
    const REAL mean = moment / volume;
    for (GROUP_LOOP(i, n))
        rhs[i] = volumes[i] * (source[i] - mean);
}
