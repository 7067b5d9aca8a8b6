/* One multigrid cycle on graphs of matched cells (coarsening.cl), in a precision of its own (REAL); where that is not
   the caller's (SOURCE), the residual comes and the correction goes in that. One work-item per cell or group, one
   work-group where cells are few.

   Smoothing is Chebyshev's polynomial of degree 2 in B^-1 A on [0.35, 2], as two damped pairwise-Jacobi steps. */
#include "opencl/real.h"
#include "opencl/blocks.h"
#include "solvers/sparse_rows.h"

/* (B^-1 r)_i: B has the diagonal and 2 x 2 blocks of A. */
inline REAL pairwise(int i, global const int *partner, global const REAL *own, global const REAL *both,
                     global const REAL *r)
{
    return own[i] * r[i] + both[i] * (r[i] + r[partner[i]]);
}

/* b = r, x = omega B^-1 b: the first step from a start of zero. On the finest level b is rounded from `r`. */
kernel void first_rounded(int n, REAL omega, global const int *partner, global const REAL *own, global const REAL *both,
                          global const SOURCE *r, global REAL *b, global REAL *x)
{
    const int i = get_global_id(0);
    if (i >= n)
        return;
    const REAL bi = (REAL)r[i];
    b[i] = bi;
    x[i] = omega * (own[i] * bi + both[i] * (bi + (REAL)r[partner[i]]));
}

kernel void first(int n, REAL omega, global const int *partner, global const REAL *own, global const REAL *both,
                  global const REAL *b, global REAL *x)
{
    const int i = get_global_id(0);
    if (i < n)
        x[i] = omega * pairwise(i, partner, own, both, b);
}

/* t = b - A x. */
kernel void defect(int n, global const int *starts, global const int *columns, global const REAL *weights,
                   global const REAL *b, global const REAL *x, global REAL *t)
{
    const int i = get_global_id(0);
    if (i < n)
        t[i] = b[i] - row_difference(i, n, starts, columns, weights, x);
}

/* x += omega B^-1 t. */
kernel void correct(int n, REAL omega, global const int *partner, global const REAL *own, global const REAL *both,
                    global const REAL *t, global REAL *x)
{
    const int i = get_global_id(0);
    if (i < n)
        x[i] += omega * pairwise(i, partner, own, both, t);
}

/* u = x + omega B^-1 t in the caller's precision: the cycle's last step. */
kernel void correct_out(int n, REAL omega, global const int *partner, global const REAL *own, global const REAL *both,
                        global const REAL *t, global const REAL *x, global SOURCE *u)
{
    const int i = get_global_id(0);
    if (i < n)
        u[i] = x[i] + omega * pairwise(i, partner, own, both, t);
}

/* Sum over the members of group g. */
inline REAL group_total(int g, global const int *member_starts, global const int *members, global const REAL *t)
{
    REAL sum = 0;
    for (int s = member_starts[g]; s < member_starts[g + 1]; ++s)
        sum += t[members[s]];
    return sum;
}

/* b of a group = sum of its members' defects. */
kernel void restrict_defect(int groups, global const REAL *t, global const int *member_starts,
                            global const int *members, global REAL *coarse_b)
{
    const int g = get_global_id(0);
    if (g < groups)
        coarse_b[g] = group_total(g, member_starts, members, t);
}

/* Every member takes its group's correction. */
kernel void prolong(int n, global const int *group, global const REAL *e, global REAL *x)
{
    const int i = get_global_id(0);
    if (i < n)
        x[i] += e[group[i]];
}

/* One group of work-items, where cells are few: t = b - A x. */
inline void defect_alone(int n, global const int *starts, global const int *columns, global const REAL *weights,
                         global const REAL *b, global const REAL *x, global REAL *t)
{
    barrier(CLK_GLOBAL_MEM_FENCE);
    for (BLOCK_LOOP(i, n))
        t[i] = b[i] - row_difference(i, n, starts, columns, weights, x);
    barrier(CLK_GLOBAL_MEM_FENCE);
}

/* One group: a step of smoothing. */
inline void relax_alone(int n, REAL omega, global const int *starts, global const int *columns,
                        global const REAL *weights, global const int *partner, global const REAL *own,
                        global const REAL *both, global const REAL *b, global REAL *x, global REAL *t)
{
    defect_alone(n, starts, columns, weights, b, x, t);
    for (BLOCK_LOOP(i, n))
        x[i] += omega * pairwise(i, partner, own, both, t);
}

/* One group: all that is done on a level on the way down, with the same bits as by the kernels above. */
kernel void descend_alone(int n, REAL late, REAL early, global const int *starts, global const int *columns,
                          global const REAL *weights, global const int *partner, global const REAL *own,
                          global const REAL *both, global const REAL *b, global REAL *x, global REAL *t, int groups,
                          global const int *member_starts, global const int *members, global REAL *coarse_b)
{
    for (BLOCK_LOOP(i, n))
        x[i] = late * pairwise(i, partner, own, both, b);
    relax_alone(n, early, starts, columns, weights, partner, own, both, b, x, t);
    defect_alone(n, starts, columns, weights, b, x, t);
    for (BLOCK_LOOP(g, groups))
        coarse_b[g] = group_total(g, member_starts, members, t);
}

/* One group: the same on the way up. */
kernel void ascend_alone(int n, REAL late, REAL early, global const int *starts, global const int *columns,
                         global const REAL *weights, global const int *partner, global const REAL *own,
                         global const REAL *both, global const REAL *b, global REAL *x, global REAL *t,
                         global const int *group, global const REAL *e)
{
    for (BLOCK_LOOP(i, n))
        x[i] += e[group[i]];
    relax_alone(n, early, starts, columns, weights, partner, own, both, b, x, t);
    relax_alone(n, late, starts, columns, weights, partner, own, both, b, x, t);
}

/* One group of work-items: cells are eliminated one by one, which leaves a graph of the others,

       w_jk += w_ij w_ik / d_i        d_i = sum_k w_ik over those not yet eliminated

   so that A = L D L^T with L^-1 = Z, whose entry (i, k) is the share of k's right side that has come to i when it is
   its turn. As d is summed anew from the weights, nothing is ever subtracted, and Z and D are right to the last digits
   whatever the weights are. A cell without anyone left (the last one, or the last of a part on its own) has 1 / d = 0.

   factor: Z (n, n), then the weights left (n, n), then 1 / d (n), then the means of Z's rows (n). */
kernel void eliminate(int n, global const int *starts, global const int *columns, global const REAL *weights,
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

/* One group, on the coarsest level: t = D^-1 Z (b - mean b), then x = Z^T t less its mean. Such a product is positive
   semidefinite whatever is rounded in it, as an inverse matrix in one piece is not. Without the means the last cell
   would be the one at zero, and the constant by which all others differ from it leave its roundings in the scalar
   products of the iteration. */
kernel void solve(int n, global const REAL *factor, global const REAL *b, global REAL *t, global REAL *x)
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
