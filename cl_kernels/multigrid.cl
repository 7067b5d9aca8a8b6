/* One multigrid cycle on graphs of matched cells (coarsening.cl), in a precision of its own (REAL); the residual comes and
   the correction goes in the caller's (SOURCE). One work-item per cell or group, one work-group for the coarsest level.

   Smoothing is Chebyshev's polynomial of degree 2 in B^-1 A on [0.35, 2], as two damped pairwise-Jacobi steps. */
#include "common/real.h"
#include "common/blocks.h"
#include "common/rows.h"

/* b = r, x = omega B^-1 b: the first step from a start of zero. On the finest level b is rounded from `r`. */
kernel void first_rounded(
    int n, REAL omega, global const int *partner, global const REAL *same, global const REAL *other,
    global const SOURCE *r, global REAL *b, global REAL *x)
{
    const int i = get_global_id(0);
    if (i >= n) return;
    const REAL bi = (REAL)r[i];
    b[i] = bi;
    x[i] = omega * (same[i] * bi + other[i] * (REAL)r[partner[i]]);
}

kernel void first(
    int n, REAL omega, global const int *partner, global const REAL *same, global const REAL *other,
    global const REAL *b, global REAL *x)
{
    const int i = get_global_id(0);
    if (i < n) x[i] = omega * (same[i] * b[i] + other[i] * b[partner[i]]);
}

/* t = b - A x. */
kernel void defect(
    int n, global const int *starts, global const int *columns, global const REAL *weights, global const REAL *b,
    global const REAL *x, global REAL *t)
{
    const int i = get_global_id(0);
    if (i < n) t[i] = b[i] - row_difference(i, n, starts, columns, weights, x);
}

/* x += omega B^-1 t. */
kernel void correct(
    int n, REAL omega, global const int *partner, global const REAL *same, global const REAL *other,
    global const REAL *t, global REAL *x)
{
    const int i = get_global_id(0);
    if (i < n) x[i] += omega * (same[i] * t[i] + other[i] * t[partner[i]]);
}

/* u = x + omega B^-1 t in the caller's precision: the cycle's last step. */
kernel void correct_out(
    int n, REAL omega, global const int *partner, global const REAL *same, global const REAL *other,
    global const REAL *t, global const REAL *x, global SOURCE *u)
{
    const int i = get_global_id(0);
    if (i < n) u[i] = x[i] + omega * (same[i] * t[i] + other[i] * t[partner[i]]);
}

/* b of a group = sum of its members' t. */
kernel void restrict_sum(
    int groups, global const int *member_starts, global const int *members, global const REAL *t, global REAL *b)
{
    const int g = get_global_id(0);
    if (g >= groups) return;
    REAL sum = 0;
    for (int s = member_starts[g]; s < member_starts[g + 1]; ++s) sum += t[members[s]];
    b[g] = sum;
}

/* Every member takes its group's correction. */
kernel void prolong(int n, global const int *group, global const REAL *e, global REAL *x)
{
    const int i = get_global_id(0);
    if (i < n) x[i] += e[group[i]];
}

/* One group: inverse of A + (t/n) 1 1^T, t = its mean diagonal (and a millionth of t against rows that hang together with
   no other), by Gauss and Jordan without exchange of rows, as the matrix is positive definite. */
kernel void invert(
    int n, global const int *starts, global const int *columns, global const REAL *weights, global REAL *inverse)
{
    const int me = get_local_id(0);
    local REAL mean;
    for (int i = me; i < n; i += GROUP_SIZE) {
        REAL sum = 0;
        for (int j = 0; j < n; ++j) inverse[i * n + j] = 0;
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            if (columns[k] == i) continue;
            inverse[i * n + columns[k]] -= weights[k];
            sum += weights[k];
        }
        inverse[i * n + i] = sum;
    }
    barrier(CLK_GLOBAL_MEM_FENCE);
    if (me == 0) {
        REAL sum = 0;
        for (int i = 0; i < n; ++i) sum += inverse[i * n + i];
        mean = sum > 0 ? sum / n : 1;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const REAL shift = mean;
    for (int q = me; q < n * n; q += GROUP_SIZE) inverse[q] += shift / n + (q / n == q % n ? R(1e-6) * shift : 0);
    barrier(CLK_GLOBAL_MEM_FENCE);
    for (int p = 0; p < n; ++p) {
        /* Rows other than p, then row p itself, then column p: nothing is read after it has changed. */
        const REAL pivot = 1 / inverse[p * n + p];
        for (int i = me; i < n; i += GROUP_SIZE) {
            if (i == p) continue;
            const REAL factor = inverse[i * n + p] * pivot;
            for (int j = 0; j < n; ++j)
                if (j != p) inverse[i * n + j] -= factor * inverse[p * n + j];
            inverse[i * n + p] = -factor;
        }
        barrier(CLK_GLOBAL_MEM_FENCE);
        for (int j = me; j < n; j += GROUP_SIZE) inverse[p * n + j] = j == p ? pivot : inverse[p * n + j] * pivot;
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
}

/* x = inverse b, on the coarsest level. */
kernel void solve_dense(int n, global const REAL *inverse, global const REAL *b, global REAL *x)
{
    const int i = get_global_id(0);
    if (i >= n) return;
    REAL sum = 0;
    for (int j = 0; j < n; ++j) sum += inverse[i * n + j] * b[j];
    x[i] = sum;
}
