/* One V-cycle of multigrid on graphs of aggregated cells (see solvers/aggregation.cl).

   Vectors are in REAL, the multigrid's own precision. SOURCE is the caller's: `take_residual` and `give_correction` are
   first and last.

   The smoother is Chebyshev's polynomial of degree 2 in B^-1 A on [0.35, 2], applied as two damped pairwise-Jacobi
   steps. There are kernels for each step, kernels for several steps at once, and `cycle_by_group`, which does all
   coarse levels by one work-group. */
#include "opencl/real.h"
#include "opencl/blocks.h"
#include "solvers/sparse_rows.h"

/* (B^-1 r)_i: B holds the diagonal of A and its 2 x 2 blocks for pairs. */
inline REAL apply_pair_inverse(int i, global const int *partner, global const REAL *own, global const REAL *both,
                               global const REAL *r)
{
    return own[i] * r[i] + both[i] * (r[i] + r[partner[i]]);
}

/* b = r, rounded. */
kernel void take_residual(int size, global const SOURCE *r, global REAL *b)
{
    WORK_ITEM(i);
    b[i] = r[i];
}

/* u = x. */
kernel void give_correction(int size, global const REAL *x, global SOURCE *u)
{
    WORK_ITEM(i);
    u[i] = x[i];
}

/* x = omega B^-1 b: the first step from x = 0. */
kernel void smooth_from_zero(int size, REAL omega, global const int *partner, global const REAL *own,
                             global const REAL *both, global const REAL *b, global REAL *x)
{
    WORK_ITEM(i);
    x[i] = omega * apply_pair_inverse(i, partner, own, both, b);
}

/* t = b - A x. */
kernel void compute_defect(int size, global const int *starts, global const int *columns, global const REAL *weights,
                           global const REAL *b, global const REAL *x, global REAL *t)
{
    WORK_ITEM(i);
    t[i] = b[i] - row_difference(i, size, starts, columns, weights, x);
}

/* x += omega B^-1 t. */
kernel void smooth(int size, REAL omega, global const int *partner, global const REAL *own, global const REAL *both,
                   global const REAL *t, global REAL *x)
{
    WORK_ITEM(i);
    x[i] += omega * apply_pair_inverse(i, partner, own, both, t);
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
kernel void restrict_defect(int size, global const REAL *t, global const int *member_starts, global const int *members,
                            global REAL *coarse_b)
{
    WORK_ITEM(g);
    coarse_b[g] = sum_members(g, member_starts, members, t);
}

/* Prolongation: x_i += correction of the aggregate of i. */
kernel void prolong(int size, global const int *aggregate, global const REAL *e, global REAL *x)
{
    WORK_ITEM(i);
    x[i] += e[aggregate[i]];
}

/* Several steps at once, for GPUs, on which a launch costs more than the steps of most levels. They evaluate values of
   neighbors anew instead of storing them first. One work-item does both cells of a pair. The bits are the same. */

/* The pair of cells i <= j of a work-item; it returns where there is none. */
#define PAIR(i, j)                                                                                                     \
    const int i = get_global_id(0);                                                                                    \
    if (i >= n || partner[i] < i)                                                                                      \
        return;                                                                                                        \
    const int j = partner[i]

/* (B^-1 t)_i from t_i and t of its partner. */
inline REAL pair_inverse(REAL own, REAL both, REAL ti, REAL tj)
{
    return own * ti + both * (ti + tj);
}

/* x after the first step from x = 0, omega B^-1 b. */
#define FIRST_STEP(j) (omega * apply_pair_inverse(j, partner, own, both, b))
ROW_DIFFERENCE(first_step_difference, FIRST_STEP, REAL omega, global const int *partner, global const REAL *own,
               global const REAL *both, global const REAL *b)

/* to = x + damping B^-1 (b - A x), for the pair of the work-item. */
#define SMOOTH_PAIR(damping, VALUE, DIFFERENCE, to, ...)                                                               \
    PAIR(i, j);                                                                                                        \
    const REAL ti = b[i] - DIFFERENCE(i, n, starts, columns, weights, __VA_ARGS__);                                    \
    const REAL tj = i == j ? ti : b[j] - DIFFERENCE(j, n, starts, columns, weights, __VA_ARGS__);                      \
    to[i] = VALUE(i) + damping * pair_inverse(own[i], both[i], ti, tj);                                                \
    if (i != j)                                                                                                        \
    to[j] = VALUE(j) + damping * pair_inverse(own[j], both[j], tj, ti)

/* Two steps from x = 0. */
kernel void smooth_pairs_from_zero(int n, REAL omega, REAL next, global const int *starts, global const int *columns,
                                   global const REAL *weights, global const int *partner, global const REAL *own,
                                   global const REAL *both, global const REAL *b, global REAL *x)
{
    SMOOTH_PAIR(next, FIRST_STEP, first_step_difference, x, omega, partner, own, both, b);
}

/* One step, to another array. */
kernel void smooth_pairs(int n, REAL omega, global const int *starts, global const int *columns,
                         global const REAL *weights, global const int *partner, global const REAL *own,
                         global const REAL *both, global const REAL *b, global const REAL *x, global REAL *to)
{
    SMOOTH_PAIR(omega, ENTRY_OF_X, row_difference, to, x);
}

/* x + the correction of the aggregate. */
#define CORRECTED(j) (x[j] + e[aggregate[j]])
ROW_DIFFERENCE(corrected_difference, CORRECTED, global const REAL *x, global const int *aggregate, global const REAL *e)

/* Prolongation, x_i += correction of the aggregate of i, and one step, to another array. */
kernel void prolong_and_smooth_pairs(int n, REAL omega, global const int *starts, global const int *columns,
                                     global const REAL *weights, global const int *partner, global const REAL *own,
                                     global const REAL *both, global const REAL *b, global const REAL *x,
                                     global const int *aggregate, global const REAL *e, global REAL *to)
{
    SMOOTH_PAIR(omega, CORRECTED, corrected_difference, to, x, aggregate, e);
}

/* Restriction: b of an aggregate = sum of the defects b - A x of its members. */
kernel void restrict_new_defect(int size, int n, global const int *starts, global const int *columns,
                                global const REAL *weights, global const REAL *b, global const REAL *x,
                                global const int *member_starts, global const int *members, global REAL *coarse_b)
{
    WORK_ITEM(g);
    REAL sum = 0;
    for (int s = member_starts[g]; s < member_starts[g + 1]; ++s) {
        const int i = members[s];
        const REAL defect = b[i] - row_difference(i, n, starts, columns, weights, x);
        sum += defect;
    }
    coarse_b[g] = sum;
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
inline void solve_coarsest(int n, global const REAL *factor, global const REAL *b, global REAL *t, global REAL *x)
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

/* Where the arrays of a level begin in `ints` and `reals`, in a row of the table of levels. */
#define LEVEL_ENTRIES 14
typedef struct {
    int n, n_aggregates, starts, columns, partner, aggregate, member_starts, members, weights, own, both, b, x, t;
} level_t;

inline level_t read_level(global const int *table, int depth)
{
    global const int *row = table + LEVEL_ENTRIES * depth;
    const level_t level = {row[0], row[1], row[2], row[3],  row[4],  row[5],  row[6],
                           row[7], row[8], row[9], row[10], row[11], row[12], row[13]};
    return level;
}

/* A level, its arrays, and the next coarser one. */
#define FINE_AND_COARSE(depth)                                                                                         \
    const level_t fine = read_level(table, depth), coarse = read_level(table, depth + 1);                              \
    global const int *partner = ints + fine.partner, *starts = ints + fine.starts, *columns = ints + fine.columns;     \
    global const REAL *own = reals + fine.own, *both = reals + fine.both, *weights = reals + fine.weights;             \
    global REAL *bs = reals + fine.b, *xs = reals + fine.x, *ts = reals + fine.t

/* The cycle from a coarse level on, by one work-group: x = correction for b. The last level is solved exactly. */
kernel void cycle_by_group(int levels, REAL late, REAL early, global const int *table, global const int *ints,
                           global REAL *reals, global const REAL *factor, global const REAL *b, global REAL *x)
{
    const level_t top = read_level(table, 0);
    for (BLOCK_LOOP(i, top.n))
        reals[top.b + i] = b[i];
    for (int depth = 0; depth < levels - 1; ++depth) {
        FINE_AND_COARSE(depth);
        barrier(CLK_GLOBAL_MEM_FENCE);
        for (BLOCK_LOOP(i, fine.n))
            xs[i] = late * apply_pair_inverse(i, partner, own, both, bs);
        smooth_by_group(fine.n, early, starts, columns, weights, partner, own, both, bs, xs, ts);
        defect_by_group(fine.n, starts, columns, weights, bs, xs, ts);
        for (BLOCK_LOOP(g, fine.n_aggregates))
            reals[coarse.b + g] = sum_members(g, ints + fine.member_starts, ints + fine.members, ts);
    }
    barrier(CLK_GLOBAL_MEM_FENCE);
    const level_t last = read_level(table, levels - 1);
    solve_coarsest(last.n, factor, reals + last.b, reals + last.t, reals + last.x);
    for (int depth = levels - 2; depth >= 0; --depth) {
        FINE_AND_COARSE(depth);
        barrier(CLK_GLOBAL_MEM_FENCE);
        for (BLOCK_LOOP(i, fine.n))
            xs[i] += reals[coarse.x + ints[fine.aggregate + i]];
        smooth_by_group(fine.n, early, starts, columns, weights, partner, own, both, bs, xs, ts);
        smooth_by_group(fine.n, late, starts, columns, weights, partner, own, both, bs, xs, ts);
    }
    barrier(CLK_GLOBAL_MEM_FENCE);
    for (BLOCK_LOOP(j, top.n))
        x[j] = reals[top.x + j];
}
