/* Preconditioned conjugate gradients for A x = b:

       u = M^-1 r    gamma = (r, u)    beta = gamma / gamma_old    p = u + beta p
       q = A p       alpha = gamma / (p, q)    x += alpha p    r -= alpha q

   One work-item per unknown of a block; each work-group owns a block of the vectors. A work-group writes one partial
   sum per quantity, and in the next kernel every group adds all of them in the same order: scalars stay on the device.

   Vectors of the iteration are in STORE, which may be single precision where REAL is double, to save memory traffic.
   Solution, right side and sums are in REAL. Vectors are scaled by a power of two so that max |b| ~ 1: the squares of a
   small right side would underflow.

   With `center` the null space of A is the constants. Round-off in the mean of r is then removed one iteration later;
   otherwise the residual could not fall below it.

   partial: 12 rows, named below. Residual norms, gammas and sums of r alternate between two rows.

   There is one kernel per step. `solve_by_group` does all steps in one work-group, for few unknowns. */
#include "opencl/real.h"
#include "opencl/blocks.h"
#include "opencl/reduce.h"
#include "solvers/partial_sums.h"
#include "solvers/sparse_rows.h"

#if IS_DOUBLE
#define EXPONENT_LIMIT (DBL_MAX_EXP - 4)
#else
#define EXPONENT_LIMIT (FLT_MAX_EXP - 4)
#endif

#define SUM_B 0
#define MAX_B 1
#define NORM_B 2
#define CURVATURE 3
#define NORM_R(k) (4 + ((k)&1))
#define GAMMA(k) (6 + ((k)&1))
#define SUM_R(k) (8 + ((k)&1))
#define START 10
#define SUM_X 11

/* The sums and the maximum that center and scale r = b - w; r = b if the start is zero (`from_zero`). */
inline void add_right_sides(int n, int from_zero, global const REAL *b, global const STORE *w, global REAL *partial,
                            group_t group)
{
    Sum sum_b = SUM_ZERO, sum_r = SUM_ZERO;
    REAL max_b = 0;
    for (GROUP_LOOP(i, n)) {
        const REAL bi = b[i];
        sum_add(&sum_b, bi);
        sum_add(&sum_r, from_zero ? bi : bi - w[i]);
        max_b = fmax(max_b, fabs(bi));
    }
    PUT(SUM_B, sum_b.value);
    PUT(START, sum_r.value);
    max_b = group_max(max_b, group);
    if (GROUP_ITEM == 0)
        ROW(MAX_B)[group.id] = max_b;
}

kernel void sum_right_sides(int n, int from_zero, global const REAL *b, global const STORE *w, global REAL *partial)
{
    LONG_GROUP;
    add_right_sides(n, from_zero, b, w, partial, group);
}

/* r = 2^e (r - mean r) with `center`, the number of unknowns of all parts; if it is 0, r = 2^e r; p = 0; x = 0 with
   `from_zero`. NORM_B, NORM_R = |b|^2, |r|^2 after the same scaling and centering. state[1] = 2^-e, state[2] = the part
   of |b|^2 that centering has removed. */
inline void set_residual(int n, int from_zero, int center, global const REAL *b, global const STORE *w, global REAL *x,
                         global STORE *r, global STORE *p, global REAL *partial, global REAL *state, group_t group)
{
    const REAL mean_b = center ? total_sum(ROW(SUM_B), group) / center : 0;
    const REAL mean_r = center ? total_sum(ROW(START), group) / center : 0;
    const REAL max_b = total_max(ROW(MAX_B), group);
    const int exponent = max_b > 0 && max_b <= REAL_MAX ? clamp(-ilogb(max_b), -EXPONENT_LIMIT, EXPONENT_LIMIT) : 0;
    Sum norm_b = SUM_ZERO, norm_r = SUM_ZERO, sum_r = SUM_ZERO, sum_x = SUM_ZERO;
    for (GROUP_LOOP(i, n)) {
        const REAL bi = ldexp(b[i] - mean_b, exponent);
        const STORE ri = ldexp((from_zero ? b[i] : b[i] - w[i]) - mean_r, exponent);
        r[i] = ri;
        p[i] = 0;
        if (from_zero)
            x[i] = 0;
        sum_add(&sum_x, x[i]);
        sum_add(&norm_b, bi * bi);
        sum_add(&norm_r, (REAL)ri * ri);
        sum_add(&sum_r, ri);
    }
    PUT(NORM_B, norm_b.value);
    PUT(NORM_R(0), norm_r.value);
    PUT(SUM_R(0), sum_r.value);
    PUT(SUM_X, sum_x.value);
    if (IS_FIRST_ITEM) {
        const REAL taken = ldexp(mean_b, exponent);
        state[1] = ldexp(R(1), -exponent);
        state[2] = center * taken * taken;
    }
}

kernel void start_residual(int n, int from_zero, int center, global const REAL *b, global const STORE *w,
                           global REAL *x, global STORE *r, global STORE *p, global REAL *partial, global REAL *state,
                           global int *counts)
{
    LONG_GROUP;
    if (IS_FIRST_ITEM)
        counts[UPDATES] = 0;
    set_residual(n, from_zero, center, b, w, x, r, p, partial, state, group);
}

/* state[4] = |b|^2, state[5] = |r|^2, for the host. One work-group. */
kernel void read_norms(global const REAL *partial, global REAL *state, const int groups)
{
    LONG_GROUP;
    const REAL norm_b = sum_of_groups(partial + NORM_B * groups, groups, group);
    const REAL norm_r = sum_of_groups(partial + NORM_R(0) * groups, groups, group);
    if (GROUP_ITEM == 0) {
        state[4] = norm_b;
        state[5] = norm_r;
    }
}

/* u = D^-1 r and gamma = (r, u), for the first iteration. */
inline void apply_jacobi(int n, global const STORE *inverse_diagonal, global const STORE *r, global STORE *u,
                         global REAL *partial, group_t group)
{
    Sum gamma = SUM_ZERO;
    for (GROUP_LOOP(i, n)) {
        const STORE ui = inverse_diagonal[i] * r[i];
        u[i] = ui;
        sum_add(&gamma, (REAL)r[i] * ui);
    }
    PUT(GAMMA(0), gamma.value);
}

kernel void precondition_jacobi(int n, global const STORE *inverse_diagonal, global const STORE *r, global STORE *u,
                                global REAL *partial)
{
    LONG_GROUP;
    apply_jacobi(n, inverse_diagonal, r, u, partial, group);
}

/* Row q of partial = (a, b). */
kernel void dot_product(int n, int q, global const STORE *a, global const STORE *b, global REAL *partial)
{
    LONG_GROUP;
    Sum sum = SUM_ZERO;
    for (GROUP_LOOP(i, n))
        sum_add(&sum, (REAL)a[i] * b[i]);
    PUT(q, sum.value);
}

/* beta of iteration k. record[k].running becomes 0, as *end does instead of n, if |r| is within the tolerance, or if a
   value is not positive or not finite. */
inline REAL find_beta(int k, int n, REAL tolerance, global const REAL *partial, global REAL *state, global REAL *record,
                      group_t group, int *end)
{
    const int first = IS_FIRST_ITEM;
    global REAL *now = record + 4 * k;
    global const REAL *last = now - 4;
    const int over = k > 0 && !(last[RECORD_RUNNING] != 0 && last[RECORD_CURVATURE] > 0);
    const REAL norm = total_sum(ROW(NORM_R(k)), group), gamma = total_sum(ROW(GAMMA(k)), group);
    const REAL norm_b = total_sum(ROW(NORM_B), group);
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
    *end = running ? n : 0;
    return k > 0 ? gamma / last[RECORD_GAMMA] : 0;
}

/* p = u + beta p. */
inline void step_direction(int k, int n, REAL tolerance, global const STORE *u, global STORE *p,
                           global const REAL *partial, global REAL *state, global REAL *record, group_t group)
{
    int end;
    const REAL beta = find_beta(k, n, tolerance, partial, state, record, group, &end);
    for (GROUP_LOOP(i, end))
        p[i] = u[i] + beta * p[i];
}

kernel void update_direction(global int *counts, int n, REAL tolerance, global const STORE *u, global STORE *p,
                             global const REAL *partial, global REAL *state, global REAL *record)
{
    LONG_GROUP;
    step_direction(number_of_direction(counts, group), n, tolerance, u, p, partial, state, record, group);
}

/* Both in one launch, p = u + beta old and q = A p, with A in sparse rows: p_j is evaluated for each neighbor. */
#define ENTRY_OF_DIRECTION(j) ((STORE)(u[j] + beta * old[j]))
ROW_DIFFERENCE(direction_difference, ENTRY_OF_DIRECTION, global const STORE *u, global const STORE *old, REAL beta)

kernel void apply_to_direction(global int *counts, int n, REAL tolerance, global const int *starts,
                               global const int *columns, global const STORE *weights, global const STORE *u,
                               global const STORE *old, global STORE *p, global STORE *q, global REAL *partial,
                               global REAL *state, global REAL *record)
{
    LONG_GROUP;
    int end;
    const int k = number_of_direction(counts, group);
    const REAL beta = find_beta(k, n, tolerance, partial, state, record, group, &end);
    Sum product = SUM_ZERO;
    for (GROUP_LOOP(i, end)) {
        const STORE pi = ENTRY_OF_DIRECTION(i);
        const STORE qi = direction_difference(i, n, starts, columns, weights, u, old, beta);
        p[i] = pi;
        q[i] = qi;
        sum_add(&product, (REAL)pi * qi);
    }
    PUT(CURVATURE, product.value);
}

/* Step of iteration k: alpha, alpha for the unscaled x, the mean to remove from r, and the number of unknowns to
   change, 0 where the iteration is over. */
typedef struct {
    int end;
    REAL alpha, alpha_x, mean;
} Step;

inline Step step_length(int k, int n, int center, global const REAL *partial, global REAL *state, global REAL *record,
                        group_t group)
{
    global REAL *now = record + 4 * k;
    const int running = now[RECORD_RUNNING] != 0;
    Step s;
    const REAL curvature = total_sum(ROW(CURVATURE), group);
    if (running && IS_FIRST_ITEM) {
        now[RECORD_CURVATURE] = curvature;
        if (k == 0)
            state[0] = state[3];
    }
    s.end = running && curvature > 0 ? n : 0;
    s.alpha = now[RECORD_GAMMA] / curvature;
    s.alpha_x = s.alpha * state[1];
    s.mean = center ? total_sum(ROW(SUM_R(k)), group) / center : 0;
    return s;
}

/* Record |r| before iteration k, for the host, and whether k is needed. The next row gets state[2] and |b|^2. One
   work-group. Iteration k overwrites both rows. */
kernel void record_norm(global const int *counts, global const REAL *partial, global const REAL *state,
                        global REAL *record, const int groups)
{
    LONG_GROUP;
    const int k = counts[UPDATES];
    global REAL *now = record + 4 * k;
    const REAL norm = sum_of_groups(partial + NORM_R(k) * groups, groups, group);
    const REAL norm_b = sum_of_groups(partial + NORM_B * groups, groups, group);
    if (GROUP_ITEM == 0) {
        now[RECORD_NORM] = norm;
        now[RECORD_RUNNING] = !(norm <= state[0]);
        now[RECORD_CURVATURE] = 1;
        now[4] = state[2];
        now[5] = norm_b;
    }
}

/* Row SUM_X of partial = sum x, for `center_solution`, unless the iteration is over. */
inline void put_sum_of_solution(const Step *s, const Sum *sum_x, global REAL *partial, group_t group)
{
    const REAL sum = group_sum(sum_x->value, group);
    if (GROUP_ITEM == 0 && s->end > 0)
        ROW(SUM_X)[group.id] = sum;
}

/* x += alpha p, r -= alpha q. */
kernel void update_solution(global int *counts, int n, int center, global const STORE *p, global const STORE *q,
                            global REAL *x, global STORE *r, global REAL *partial, global REAL *state,
                            global REAL *record)
{
    LONG_GROUP;
    const int k = number_of_update(counts, group);
    const Step s = step_length(k, n, center, partial, state, record, group);
    Sum norm = SUM_ZERO, sum = SUM_ZERO, sum_x = SUM_ZERO;
    for (GROUP_LOOP(i, s.end)) {
        const STORE ri = r[i] - s.mean - s.alpha * q[i];
        const REAL xi = x[i] + s.alpha_x * p[i];
        x[i] = xi;
        sum_add(&sum_x, xi);
        r[i] = ri;
        sum_add(&norm, (REAL)ri * ri);
        sum_add(&sum, ri);
    }
    PUT(NORM_R(k + 1), norm.value);
    PUT(SUM_R(k + 1), sum.value);
    put_sum_of_solution(&s, &sum_x, partial, group);
}

/* x += alpha p, r -= alpha q, u = D^-1 r, and gamma of the next iteration. */
inline void step_jacobi(int k, int n, int center, global const STORE *inverse_diagonal, global const STORE *p,
                        global const STORE *q, global REAL *x, global STORE *r, global STORE *u, global REAL *partial,
                        global REAL *state, global REAL *record, group_t group)
{
    const Step s = step_length(k, n, center, partial, state, record, group);
    Sum norm = SUM_ZERO, gamma = SUM_ZERO, sum = SUM_ZERO, sum_x = SUM_ZERO;
    for (GROUP_LOOP(i, s.end)) {
        const STORE ri = r[i] - s.mean - s.alpha * q[i], ui = inverse_diagonal[i] * ri;
        const REAL xi = x[i] + s.alpha_x * p[i];
        x[i] = xi;
        sum_add(&sum_x, xi);
        r[i] = ri;
        u[i] = ui;
        sum_add(&norm, (REAL)ri * ri);
        sum_add(&sum, ri);
        sum_add(&gamma, (REAL)ri * ui);
    }
    PUT(NORM_R(k + 1), norm.value);
    PUT(SUM_R(k + 1), sum.value);
    PUT(GAMMA(k + 1), gamma.value);
    put_sum_of_solution(&s, &sum_x, partial, group);
}

kernel void update_solution_jacobi(global int *counts, int n, int center, global const STORE *inverse_diagonal,
                                   global const STORE *p, global const STORE *q, global REAL *x, global STORE *r,
                                   global STORE *u, global REAL *partial, global REAL *state, global REAL *record)
{
    LONG_GROUP;
    step_jacobi(number_of_update(counts, group), n, center, inverse_diagonal, p, q, x, r, u, partial, state, record,
                group);
}

/* x -= mean x. */
kernel void center_solution(int n, int center, global REAL *x, global const REAL *partial)
{
    LONG_GROUP;
    const REAL mean = total_sum(ROW(SUM_X), group) / center;
    for (GROUP_LOOP(i, n))
        x[i] -= mean;
}

/* The whole solve by one work-group, for few unknowns: A in sparse rows (see solvers/sparse_rows.h), Jacobi's
   preconditioner. It computes r = b - A x, and iterates if converged_ratio |b| < |r| <= stagnated_ratio |b|. b counts
   as zero if centering has left only round-off. `state` is followed by the record. */
#define STATE 8
kernel void solve_by_group(int n, int from_zero, int center, int max_iterations, REAL tolerance, REAL converged_ratio,
                           REAL stagnated_ratio, global const int *starts, global const int *columns,
                           global const STORE *weights, global const STORE *inverse_diagonal, global const REAL *b,
                           global REAL *x, global STORE *r, global STORE *u, global STORE *p, global STORE *q,
                           global REAL *partial, global REAL *state)
{
    LONG_GROUP;
    global REAL *record = state + STATE;
    const int n_start = from_zero ? 0 : n;
    for (GROUP_LOOP(i, n_start)) {
        REAL sum = 0;
        for (int k = starts[i]; k < starts[i + 1]; ++k)
            if (columns[k] >= 0)
                sum += weights[k] * (x[i] - x[columns[k]]);
        q[i] = sum;
    }
    add_right_sides(n, from_zero, b, q, partial, group);
    GROUP_BARRIER;
    set_residual(n, from_zero, center, b, q, x, r, p, partial, state, group);
    GROUP_BARRIER;
    const REAL norm_b = partial[NORM_B], norm_r = partial[NORM_R(0)], least = 8 * REAL_EPS;
    bool running = max_iterations > 0 && norm_b > least * least * state[2] &&
                   norm_r > converged_ratio * converged_ratio * norm_b &&
                   norm_r <= stagnated_ratio * stagnated_ratio * norm_b;
    if (GROUP_ITEM == 0) {
        state[4] = norm_b;
        state[5] = norm_r;
        record[RECORD_RUNNING] = 0;
        record[RECORD_NORM] = norm_r;
    }
    apply_jacobi(running ? n : 0, inverse_diagonal, r, u, partial, group);
    for (int k = 0; running; ++k) {
        GROUP_BARRIER;
        step_direction(k, n, tolerance, u, p, partial, state, record, group);
        GROUP_BARRIER;
        const int end = record[4 * k + RECORD_RUNNING] != 0 ? n : 0;
        Sum product = SUM_ZERO;
        for (GROUP_LOOP(i, end)) {
            const STORE qi = row_difference(i, n, starts, columns, weights, p);
            q[i] = qi;
            sum_add(&product, (REAL)p[i] * qi);
        }
        PUT(CURVATURE, product.value);
        GROUP_BARRIER;
        step_jacobi(k, n, center, inverse_diagonal, p, q, x, r, u, partial, state, record, group);
        running = end > 0 && partial[CURVATURE] > 0 && k + 1 < max_iterations;
    }
    GROUP_BARRIER;
    const int centered = center ? n : 0;
    Sum sum = SUM_ZERO;
    for (GROUP_LOOP(i, centered))
        sum_add(&sum, x[i]);
    const REAL mean = group_sum(sum.value, group) / n;
    for (GROUP_LOOP(j, centered))
        x[j] -= mean;
}
