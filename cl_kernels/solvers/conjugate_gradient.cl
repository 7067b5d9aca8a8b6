/* Preconditioned conjugate gradients:

       u = M^-1 r    gamma = (r, u)    beta = gamma / gamma_old    p = u + beta p
       q = A p       alpha = gamma / (p, q)    x += alpha p    r -= alpha q

   A work-group owns a block of the vectors and leaves one partial sum per quantity; in the next kernel all groups add
   the same partial sums, so the scalars never leave the device and no kernel of one work-item is needed. Vectors are
   scaled by a power of two to max |b| ~ 1, lest squares of a small right side underflow. Those of the iteration are in
   STORE, which may be single where REAL is double: memory traffic is the cost. Solution, right side and sums are in
   REAL.

   With `center` the null space is the constants: whatever rounding puts into the mean of r is taken out one iteration
   later, or the residual could not fall below it.

   partial: 11 rows of one value per group, see the names below; residual norms and gammas and sums of r alternate
   between two rows.

   Each step is a kernel; with Jacobi's preconditioner and few unknowns one group takes them all alone. */
#include "opencl/real.h"
#include "opencl/blocks.h"
#include "opencl/reduce.h"
#include "solvers/sparse_rows.h"

#if IS_DOUBLE
#define EXPONENT_LIMIT (DBL_MAX_EXP - 4)
#else
#define EXPONENT_LIMIT (FLT_MAX_EXP - 4)
#endif

#define ROW(q) (partial + (q)*get_num_groups(0))
#define SUM_B 0
#define MAX_B 1
#define NORM_B 2
#define CURVATURE 3
#define NORM_R(k) (4 + ((k)&1))
#define GAMMA(k) (6 + ((k)&1))
#define SUM_R(k) (8 + ((k)&1))
#define START 10

/* One row of the record per iteration. */
#define RECORD_NORM 0
#define RECORD_GAMMA 1
#define RECORD_RUNNING 2
#define RECORD_CURVATURE 3

#define PUT(q, sum)                                                                                                    \
    {                                                                                                                  \
        const REAL put_ = group_sum((sum), scratch);                                                                   \
        if (get_local_id(0) == 0)                                                                                      \
            ROW(q)[get_group_id(0)] = put_;                                                                            \
    }

/* What is needed to center and scale r = b - w (b, where the start is `zero`). */
inline void add_residual(int n, int zero, global const REAL *b, global const STORE *w, global REAL *partial,
                         local REAL *scratch)
{
    Sum sum_b = SUM_ZERO, sum_r = SUM_ZERO;
    REAL max_b = 0;
    for (BLOCK_LOOP(i, n)) {
        const REAL bi = b[i];
        sum_add(&sum_b, bi);
        sum_add(&sum_r, zero ? bi : bi - w[i]);
        max_b = fmax(max_b, fabs(bi));
    }
    PUT(SUM_B, sum_b.value);
    PUT(START, sum_r.value);
    max_b = group_max(max_b, scratch);
    if (get_local_id(0) == 0)
        ROW(MAX_B)[get_group_id(0)] = max_b;
}

kernel void residual(int n, int zero, global const REAL *b, global const STORE *w, global REAL *partial)
{
    local REAL scratch[GROUP_SIZE];
    add_residual(n, zero, b, w, partial, scratch);
}

/* r = 2^e (r - mean r) if `center`, else 2^e r; norms of r and of the right side treated alike; p = 0, and x where it
   starts from `zero`. state[1] = 2^-e, state[2] = the part of the squared norm of b that was taken away. */
inline void set_residual(int n, int zero, int center, global const REAL *b, global const STORE *w, global REAL *x,
                         global STORE *r, global STORE *p, global REAL *partial, global REAL *state,
                         local REAL *scratch)
{
    const REAL mean_b = center ? total_sum(ROW(SUM_B), scratch) / n : 0;
    const REAL mean_r = center ? total_sum(ROW(START), scratch) / n : 0;
    const REAL max_b = total_max(ROW(MAX_B), scratch);
    const int exponent = max_b > 0 && max_b <= REAL_MAX ? clamp(-ilogb(max_b), -EXPONENT_LIMIT, EXPONENT_LIMIT) : 0;
    Sum norm_b = SUM_ZERO, norm_r = SUM_ZERO, sum_r = SUM_ZERO;
    for (BLOCK_LOOP(i, n)) {
        const REAL bi = ldexp(b[i] - mean_b, exponent);
        const STORE ri = ldexp((zero ? b[i] : b[i] - w[i]) - mean_r, exponent);
        r[i] = ri;
        p[i] = 0;
        if (zero)
            x[i] = 0;
        sum_add(&norm_b, bi * bi);
        sum_add(&norm_r, (REAL)ri * ri);
        sum_add(&sum_r, ri);
    }
    PUT(NORM_B, norm_b.value);
    PUT(NORM_R(0), norm_r.value);
    PUT(SUM_R(0), sum_r.value);
    if (get_global_id(0) == 0) {
        const REAL taken = ldexp(mean_b, exponent);
        state[1] = ldexp(R(1), -exponent);
        state[2] = n * taken * taken;
    }
}

kernel void begin(int n, int zero, int center, global const REAL *b, global const STORE *w, global REAL *x,
                  global STORE *r, global STORE *p, global REAL *partial, global REAL *state)
{
    local REAL scratch[GROUP_SIZE];
    set_residual(n, zero, center, b, w, x, r, p, partial, state, scratch);
}

/* One group: the sum of row q of what so many `groups` have left, as `total_sum` is in a kernel of all of them. */
inline REAL sum_of(global const REAL *partial, int q, int groups, local REAL *scratch)
{
    REAL sum = 0;
    for (int g = get_local_id(0); g < groups; g += GROUP_SIZE)
        sum += partial[q * groups + g];
    return group_sum(sum, scratch);
}

/* One group: state[4], state[5] = the squared norms of b and r, for the host to read. */
kernel void sum_norms(global const REAL *partial, global REAL *state, const int groups)
{
    local REAL scratch[GROUP_SIZE];
    const REAL norm_b = sum_of(partial, NORM_B, groups, scratch);
    const REAL norm_r = sum_of(partial, NORM_R(0), groups, scratch);
    if (get_local_id(0) == 0) {
        state[4] = norm_b;
        state[5] = norm_r;
    }
}

/* u = D^-1 r and gamma: Jacobi's method, for the first iteration. */
inline void precondition(int n, global const STORE *inverse_diagonal, global const STORE *r, global STORE *u,
                         global REAL *partial, local REAL *scratch)
{
    Sum gamma = SUM_ZERO;
    for (BLOCK_LOOP(i, n)) {
        const STORE ui = inverse_diagonal[i] * r[i];
        u[i] = ui;
        sum_add(&gamma, (REAL)r[i] * ui);
    }
    PUT(GAMMA(0), gamma.value);
}

kernel void jacobi(int n, global const STORE *inverse_diagonal, global const STORE *r, global STORE *u,
                   global REAL *partial)
{
    local REAL scratch[GROUP_SIZE];
    precondition(n, inverse_diagonal, r, u, partial, scratch);
}

/* partial row q = (a, b). */
kernel void dot_product(int n, int q, global const STORE *a, global const STORE *b, global REAL *partial)
{
    local REAL scratch[GROUP_SIZE];
    Sum sum = SUM_ZERO;
    for (BLOCK_LOOP(i, n))
        sum_add(&sum, (REAL)a[i] * b[i]);
    PUT(q, sum.value);
}

/* p = u + beta p. From the iteration on that finds the residual at its target (or anything out of order, NaN included)
   record[k].running is 0 and nothing changes any more, so that the host may run ahead without changing the result. */
inline void turn(int k, int n, REAL tolerance, global const STORE *u, global STORE *p, global const REAL *partial,
                 global REAL *state, global REAL *record, local REAL *scratch)
{
    const int first = get_global_id(0) == 0;
    global REAL *now = record + 4 * k;
    global const REAL *last = now - 4;
    const int over = k > 0 && !(last[RECORD_RUNNING] != 0 && last[RECORD_CURVATURE] > 0);
    const REAL norm = total_sum(ROW(NORM_R(k)), scratch), gamma = total_sum(ROW(GAMMA(k)), scratch);
    const REAL norm_b = total_sum(ROW(NORM_B), scratch);
    const REAL target = k > 0 ? state[0] : tolerance * tolerance * norm_b;
    const int running = !over && norm > target && norm <= REAL_MAX && gamma > 0;
    if (first)
        now[RECORD_RUNNING] = running;
    if (first && !over) {
        now[RECORD_NORM] = norm;
        now[RECORD_GAMMA] = gamma;
        if (k == 0)
            state[3] = target;
    }
    const REAL beta = k > 0 ? gamma / last[RECORD_GAMMA] : 0;
    const int end = running ? n : 0;
    for (BLOCK_LOOP(i, end))
        p[i] = u[i] + beta * p[i];
}

kernel void direction(int k, int n, REAL tolerance, global const STORE *u, global STORE *p, global const REAL *partial,
                      global REAL *state, global REAL *record)
{
    local REAL scratch[GROUP_SIZE];
    turn(k, n, tolerance, u, p, partial, state, record, scratch);
}

/* How far iteration k goes along its direction: alpha, and the same for x, which is not scaled as the residual is; the
   mean that is taken from the residual; the unknowns that are concerned, none once the iteration is over. */
typedef struct {
    int end;
    REAL alpha, alpha_x, mean;
} Stride;

inline Stride stride_of(int k, int n, int center, global const REAL *partial, global REAL *state, global REAL *record,
                        local REAL *scratch)
{
    global REAL *now = record + 4 * k;
    const int running = now[RECORD_RUNNING] != 0;
    Stride s;
    const REAL curvature = total_sum(ROW(CURVATURE), scratch);
    if (running && get_global_id(0) == 0) {
        now[RECORD_CURVATURE] = curvature;
        if (k == 0)
            state[0] = state[3];
    }
    s.end = running && curvature > 0 ? n : 0;
    s.alpha = now[RECORD_GAMMA] / curvature;
    s.alpha_x = s.alpha * state[1];
    s.mean = center ? total_sum(ROW(SUM_R(k)), scratch) / n : 0;
    return s;
}

/* One group: what the host may look at once iteration k - 1 has been enqueued, and whether k has anything left to do.
   The row is written again by `direction`, if it comes to that. */
kernel void look(int k, global const REAL *partial, global const REAL *state, global REAL *record, const int groups)
{
    local REAL scratch[GROUP_SIZE];
    global REAL *now = record + 4 * k;
    const REAL norm = sum_of(partial, NORM_R(k), groups, scratch);
    if (get_local_id(0) == 0) {
        now[RECORD_NORM] = norm;
        now[RECORD_RUNNING] = !(norm <= state[0]);
        now[RECORD_CURVATURE] = 1;
    }
}

/* x += alpha p, r -= alpha q. */
kernel void update(int k, int n, int center, global const STORE *p, global const STORE *q, global REAL *x,
                   global STORE *r, global REAL *partial, global REAL *state, global REAL *record)
{
    local REAL scratch[GROUP_SIZE];
    const Stride s = stride_of(k, n, center, partial, state, record, scratch);
    Sum norm = SUM_ZERO, sum = SUM_ZERO;
    for (BLOCK_LOOP(i, s.end)) {
        const STORE ri = r[i] - s.mean - s.alpha * q[i];
        x[i] += s.alpha_x * p[i];
        r[i] = ri;
        sum_add(&norm, (REAL)ri * ri);
        sum_add(&sum, ri);
    }
    PUT(NORM_R(k + 1), norm.value);
    PUT(SUM_R(k + 1), sum.value);
}

/* The same with u = D^-1 r and gamma for the next iteration. */
inline void advance(int k, int n, int center, global const STORE *inverse_diagonal, global const STORE *p,
                    global const STORE *q, global REAL *x, global STORE *r, global STORE *u, global REAL *partial,
                    global REAL *state, global REAL *record, local REAL *scratch)
{
    const Stride s = stride_of(k, n, center, partial, state, record, scratch);
    Sum norm = SUM_ZERO, gamma = SUM_ZERO, sum = SUM_ZERO;
    for (BLOCK_LOOP(i, s.end)) {
        const STORE ri = r[i] - s.mean - s.alpha * q[i], ui = inverse_diagonal[i] * ri;
        x[i] += s.alpha_x * p[i];
        r[i] = ri;
        u[i] = ui;
        sum_add(&norm, (REAL)ri * ri);
        sum_add(&sum, ri);
        sum_add(&gamma, (REAL)ri * ui);
    }
    PUT(NORM_R(k + 1), norm.value);
    PUT(SUM_R(k + 1), sum.value);
    PUT(GAMMA(k + 1), gamma.value);
}

kernel void update_jacobi(int k, int n, int center, global const STORE *inverse_diagonal, global const STORE *p,
                          global const STORE *q, global REAL *x, global STORE *r, global STORE *u, global REAL *partial,
                          global REAL *state, global REAL *record)
{
    local REAL scratch[GROUP_SIZE];
    advance(k, n, center, inverse_diagonal, p, q, x, r, u, partial, state, record, scratch);
}

/* Leave the partial sums of x, then (next kernel) take its mean away. */
kernel void add_up(int n, global const REAL *x, global REAL *partial)
{
    local REAL scratch[GROUP_SIZE];
    Sum sum = SUM_ZERO;
    for (BLOCK_LOOP(i, n))
        sum_add(&sum, x[i]);
    PUT(SUM_B, sum.value);
}

kernel void remove_mean(int n, global REAL *x, global const REAL *partial)
{
    local REAL scratch[GROUP_SIZE];
    const REAL mean = total_sum(ROW(SUM_B), scratch) / n;
    for (BLOCK_LOOP(i, n))
        x[i] -= mean;
}

/* One group, where unknowns are few: all of it for A of rows (see solvers/sparse_rows.h) and Jacobi's preconditioner.
   It begins by taking the residual from x, and goes on if that is above `enough` and not above `most` of b; b without
   its mean is nothing if that leaves no more than rounding. The record is behind the state. */
#define STATE 8
kernel void solve_alone(int n, int zero, int center, int turns, REAL tolerance, REAL enough, REAL most,
                        global const int *starts, global const int *columns, global const STORE *weights,
                        global const STORE *inverse_diagonal, global const REAL *b, global REAL *x, global STORE *r,
                        global STORE *u, global STORE *p, global STORE *q, global REAL *partial, global REAL *state)
{
    local REAL scratch[GROUP_SIZE];
    global REAL *record = state + STATE;
    const int begun = zero ? 0 : n;
    for (BLOCK_LOOP(i, begun)) {
        REAL sum = 0;
        for (int k = starts[i]; k < starts[i + 1]; ++k)
            if (columns[k] >= 0)
                sum += weights[k] * (x[i] - x[columns[k]]);
        q[i] = sum;
    }
    add_residual(n, zero, b, q, partial, scratch);
    barrier(CLK_GLOBAL_MEM_FENCE);
    set_residual(n, zero, center, b, q, x, r, p, partial, state, scratch);
    barrier(CLK_GLOBAL_MEM_FENCE);
    const REAL norm_b = partial[NORM_B], norm_r = partial[NORM_R(0)], least = 8 * REAL_EPS;
    bool running = turns > 0 && norm_b > least * least * state[2] && norm_r > enough * enough * norm_b &&
                   norm_r <= most * most * norm_b;
    if (get_local_id(0) == 0) {
        state[4] = norm_b;
        state[5] = norm_r;
        record[RECORD_RUNNING] = 0;
        record[RECORD_NORM] = norm_r;
    }
    precondition(running ? n : 0, inverse_diagonal, r, u, partial, scratch);
    for (int k = 0; running; ++k) {
        barrier(CLK_GLOBAL_MEM_FENCE);
        turn(k, n, tolerance, u, p, partial, state, record, scratch);
        barrier(CLK_GLOBAL_MEM_FENCE);
        const int end = record[4 * k + RECORD_RUNNING] != 0 ? n : 0;
        Sum product = SUM_ZERO;
        for (BLOCK_LOOP(i, end)) {
            const STORE qi = row_difference(i, n, starts, columns, weights, p);
            q[i] = qi;
            sum_add(&product, (REAL)p[i] * qi);
        }
        PUT(CURVATURE, product.value);
        barrier(CLK_GLOBAL_MEM_FENCE);
        advance(k, n, center, inverse_diagonal, p, q, x, r, u, partial, state, record, scratch);
        running = end > 0 && partial[CURVATURE] > 0 && k + 1 < turns;
    }
    barrier(CLK_GLOBAL_MEM_FENCE);
    const int centerd = center ? n : 0;
    Sum sum = SUM_ZERO;
    for (BLOCK_LOOP(i, centerd))
        sum_add(&sum, x[i]);
    const REAL mean = group_sum(sum.value, scratch) / n;
    for (BLOCK_LOOP(j, centerd))
        x[j] -= mean;
}
