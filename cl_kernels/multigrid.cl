/* One multigrid cycle on graphs of matched cells (coarsening.cl), in a precision of its own (REAL); where that is not
   the caller's (SOURCE), the residual comes and the correction goes in that. One work-item per cell or group, one
   work-group for the coarsest level.

   Smoothing is Chebyshev's polynomial of degree 2 in B^-1 A on [0.35, 2], as two damped pairwise-Jacobi steps. */
#include "common/real.h"
#include "common/blocks.h"
#include "common/rows.h"

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
        x[i] = omega * (own[i] * b[i] + both[i] * (b[i] + b[partner[i]]));
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
        x[i] += omega * (own[i] * t[i] + both[i] * (t[i] + t[partner[i]]));
}

/* u = x + omega B^-1 t in the caller's precision: the cycle's last step. */
kernel void correct_out(int n, REAL omega, global const int *partner, global const REAL *own, global const REAL *both,
                        global const REAL *t, global const REAL *x, global SOURCE *u)
{
    const int i = get_global_id(0);
    if (i < n)
        u[i] = x[i] + omega * (own[i] * t[i] + both[i] * (t[i] + t[partner[i]]));
}

/* b of a group = sum of its members' t. */
kernel void restrict_sum(int groups, global const int *member_starts, global const int *members, global const REAL *t,
                         global REAL *b)
{
    const int g = get_global_id(0);
    if (g >= groups)
        return;
    REAL sum = 0;
    for (int s = member_starts[g]; s < member_starts[g + 1]; ++s)
        sum += t[members[s]];
    b[g] = sum;
}

/* Every member takes its group's correction. */
kernel void prolong(int n, global const int *group, global const REAL *e, global REAL *x)
{
    const int i = get_global_id(0);
    if (i < n)
        x[i] += e[group[i]];
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

/* t = D^-1 Z (b - mean b), then x = Z^T t less its mean: the coarsest level. Such a product is positive semidefinite
   whatever is rounded in it, as an inverse matrix in one piece is not. Without the means the last cell would be the one
   at zero, and the constant by which all others differ from it leave its roundings in the scalar products of the
   iteration. */
kernel void solve_down(int n, global const REAL *factor, global const REAL *b, global REAL *t)
{
    const int i = get_global_id(0);
    if (i >= n)
        return;
    REAL mean = 0, sum = 0;
    for (int k = 0; k < n; ++k)
        mean += b[k];
    mean /= n;
    for (int k = 0; k <= i; ++k)
        sum += factor[i * n + k] * (b[k] - mean);
    t[i] = sum * factor[2 * n * n + i];
}

kernel void solve_up(int n, global const REAL *factor, global const REAL *t, global REAL *x)
{
    const int k = get_global_id(0);
    if (k >= n)
        return;
    global const REAL *means = factor + 2 * n * n + n;
    REAL sum = 0, mean = 0;
    for (int i = 0; i < n; ++i)
        mean += means[i] * t[i];
    for (int i = k; i < n; ++i)
        sum += factor[i * n + k] * t[i];
    x[k] = sum - mean;
}
