/* One V-cycle of multigrid on graphs of aggregated cells (see solvers/aggregation.cl).

   Vectors are in REAL, the multigrid's own precision. SOURCE is the caller's: the residual is read and the correction
   written in it. One work-item per cell or aggregate, or one work-group for a whole level where cells are few (kernels
   *_by_group).

   The smoother is Chebyshev's polynomial of degree 2 in B^-1 A on [0.35, 2], applied as two damped pairwise-Jacobi
   steps. */
#include "opencl/real.h"
#include "opencl/blocks.h"
#include "solvers/sparse_rows.h"

/* (B^-1 r)_i: B holds the diagonal of A and its 2 x 2 blocks for pairs. */
inline REAL apply_pair_inverse(int i, global const int *partner, global const REAL *own, global const REAL *both,
                               global const REAL *r)
{
    return own[i] * r[i] + both[i] * (r[i] + r[partner[i]]);
}

/* b = r rounded to REAL, x = omega B^-1 b: the first step from x = 0 on the finest level. */
kernel void smooth_from_zero_rounded(int n, REAL omega, global const int *partner, global const REAL *own,
                                     global const REAL *both, global const SOURCE *r, global REAL *b, global REAL *x)
{
    const int i = get_global_id(0);
    if (i >= n)
        return;
    const REAL bi = (REAL)r[i];
    b[i] = bi;
    x[i] = omega * (own[i] * bi + both[i] * (bi + (REAL)r[partner[i]]));
}

/* x = omega B^-1 b: the first step from x = 0. */
kernel void smooth_from_zero(int n, REAL omega, global const int *partner, global const REAL *own,
                             global const REAL *both, global const REAL *b, global REAL *x)
{
    const int i = get_global_id(0);
    if (i < n)
        x[i] = omega * apply_pair_inverse(i, partner, own, both, b);
}

/* t = b - A x. */
kernel void compute_defect(int n, global const int *starts, global const int *columns, global const REAL *weights,
                           global const REAL *b, global const REAL *x, global REAL *t)
{
    const int i = get_global_id(0);
    if (i < n)
        t[i] = b[i] - row_difference(i, n, starts, columns, weights, x);
}

/* x += omega B^-1 t. */
kernel void smooth(int n, REAL omega, global const int *partner, global const REAL *own, global const REAL *both,
                   global const REAL *t, global REAL *x)
{
    const int i = get_global_id(0);
    if (i < n)
        x[i] += omega * apply_pair_inverse(i, partner, own, both, t);
}

/* u = x + omega B^-1 t, in the caller's precision: the last step of the cycle. */
kernel void smooth_into(int n, REAL omega, global const int *partner, global const REAL *own, global const REAL *both,
                        global const REAL *t, global const REAL *x, global SOURCE *u)
{
    const int i = get_global_id(0);
    if (i < n)
        u[i] = x[i] + omega * apply_pair_inverse(i, partner, own, both, t);
}

/* Sum of t over the members of aggregate g. */
inline REAL sum_members(int g, global const int *member_starts, global const int *members, global const REAL *t)
{
    REAL sum = 0;
    for (int s = member_starts[g]; s < member_starts[g + 1]; ++s)
        sum += t[members[s]];
    return sum;
}

/* Restriction: b of an aggregate = sum of the defects of its members. */
kernel void restrict_defect(int n_aggregates, global const REAL *t, global const int *member_starts,
                            global const int *members, global REAL *coarse_b)
{
    const int g = get_global_id(0);
    if (g < n_aggregates)
        coarse_b[g] = sum_members(g, member_starts, members, t);
}

/* Prolongation: x_i += correction of the aggregate of i. */
kernel void prolong(int n, global const int *aggregate, global const REAL *e, global REAL *x)
{
    const int i = get_global_id(0);
    if (i < n)
        x[i] += e[aggregate[i]];
}

/* t = b - A x, by one work-group. */
inline void defect_by_group(int n, global const int *starts, global const int *columns, global const REAL *weights,
                            global const REAL *b, global const REAL *x, global REAL *t)
{
    barrier(CLK_GLOBAL_MEM_FENCE);
    for (BLOCK_LOOP(i, n))
        t[i] = b[i] - row_difference(i, n, starts, columns, weights, x);
    barrier(CLK_GLOBAL_MEM_FENCE);
}

/* x += omega B^-1 (b - A x), by one work-group. */
inline void smooth_by_group(int n, REAL omega, global const int *starts, global const int *columns,
                            global const REAL *weights, global const int *partner, global const REAL *own,
                            global const REAL *both, global const REAL *b, global REAL *x, global REAL *t)
{
    defect_by_group(n, starts, columns, weights, b, x, t);
    for (BLOCK_LOOP(i, n))
        x[i] += omega * apply_pair_inverse(i, partner, own, both, t);
}

/* All steps of a level on the way down, by one work-group: the same bits as with one kernel per step. */
kernel void descend_by_group(int n, REAL late, REAL early, global const int *starts, global const int *columns,
                             global const REAL *weights, global const int *partner, global const REAL *own,
                             global const REAL *both, global const REAL *b, global REAL *x, global REAL *t,
                             int n_aggregates, global const int *member_starts, global const int *members,
                             global REAL *coarse_b)
{
    for (BLOCK_LOOP(i, n))
        x[i] = late * apply_pair_inverse(i, partner, own, both, b);
    smooth_by_group(n, early, starts, columns, weights, partner, own, both, b, x, t);
    defect_by_group(n, starts, columns, weights, b, x, t);
    for (BLOCK_LOOP(g, n_aggregates))
        coarse_b[g] = sum_members(g, member_starts, members, t);
}

/* All steps of a level on the way up, by one work-group: the same bits as with one kernel per step. */
kernel void ascend_by_group(int n, REAL late, REAL early, global const int *starts, global const int *columns,
                            global const REAL *weights, global const int *partner, global const REAL *own,
                            global const REAL *both, global const REAL *b, global REAL *x, global REAL *t,
                            global const int *aggregate, global const REAL *e)
{
    for (BLOCK_LOOP(i, n))
        x[i] += e[aggregate[i]];
    smooth_by_group(n, early, starts, columns, weights, partner, own, both, b, x, t);
    smooth_by_group(n, late, starts, columns, weights, partner, own, both, b, x, t);
}

/* A = L D L^T on the coarsest level, by one work-group. Eliminating cell i leaves a graph of the remaining cells,

       w_jk += w_ij w_ik / d_i        d_i = sum_k w_ik over the remaining k

   L^-1 = Z: entry (i, k) is the share of the right side of k that has reached i when i is eliminated. Because d is
   summed anew from the weights, nothing is subtracted, and Z and D are accurate to the last digits for any weights. The
   last cell of a connected component has 1 / d = 0.

   factor: Z (n, n), the remaining weights (n, n), 1 / d (n), the means of the rows of Z (n). */
kernel void factorize_coarsest(int n, global const int *starts, global const int *columns, global const REAL *weights,
                               global REAL *factor)
{
    const int me = get_local_id(0);
    global REAL *z = factor, *w = factor + n * n, *inverse = factor + 2 * n * n;
    for (int i = me; i < n; i += GROUP_SIZE) {
        for (int j = 0; j < n; ++j) {
            w[i * n + j] = 0;
            z[i * n + j] = i == j;
        }
        for (int k = starts[i]; k < starts[i + 1]; ++k)
            if (columns[k] >= 0 && columns[k] != i)
                w[i * n + columns[k]] += weights[k];
    }
    barrier(CLK_GLOBAL_MEM_FENCE);
    for (int p = 0; p < n; ++p) {
        REAL sum = 0;
        for (int j = p + 1; j < n; ++j)
            sum += w[p * n + j];
        const REAL pivot = sum > 0 ? 1 / sum : 0;
        if (me == 0)
            inverse[p] = pivot;
        for (int i = p + 1 + me; i < n; i += GROUP_SIZE) {
            const REAL share = w[p * n + i] * pivot;
            if (share == 0)
                continue;
            for (int j = p + 1; j < n; ++j)
                if (j != i)
                    w[i * n + j] += share * w[p * n + j];
            for (int k = 0; k <= p; ++k)
                z[i * n + k] += share * z[p * n + k];
        }
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
    for (int i = me; i < n; i += GROUP_SIZE) {
        REAL sum = 0;
        for (int k = 0; k <= i; ++k)
            sum += z[i * n + k];
        inverse[n + i] = sum / n;
    }
}

/* x = A^+ b on the coarsest level, by one work-group: t = D^-1 Z (b - mean b), then x = Z^T t minus its mean.

   This product is positive semidefinite in spite of round-off, which an explicit inverse matrix is not. Without the
   means the last cell would be zero, and the round-off of the constant that all others have in common would enter the
   scalar products of the iteration. */
kernel void solve_coarsest(int n, global const REAL *factor, global const REAL *b, global REAL *t, global REAL *x)
{
    global const REAL *inverse = factor + 2 * n * n, *means = inverse + n;
    REAL mean_b = 0, mean_x = 0;
    for (int k = 0; k < n; ++k)
        mean_b += b[k];
    mean_b /= n;
    for (BLOCK_LOOP(i, n)) {
        REAL sum = 0;
        for (int k = 0; k <= i; ++k)
            sum += factor[i * n + k] * (b[k] - mean_b);
        t[i] = sum * inverse[i];
    }
    barrier(CLK_GLOBAL_MEM_FENCE);
    for (int k = 0; k < n; ++k)
        mean_x += means[k] * t[k];
    for (BLOCK_LOOP(j, n)) {
        REAL sum = 0;
        for (int i = j; i < n; ++i)
            sum += factor[i * n + j] * t[i];
        x[j] = sum - mean_x;
    }
}
