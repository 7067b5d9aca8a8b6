#include "geometry/domain.h"
#include "opencl/blocks.h"
#include "opencl/reduce.h"
#include "opencl/row_entries.h"

/* The exact derivative of the cells' volumes by the generators,

     dV_i/dx_j = w_ij (x_j - m_ij),   dV_i/dx_i = sum_j w_ij (m_ij - x_i),   w_ij = l_ij / d_ij,

   as the operator J = d r / d x of the excess r_i = log V_i - d log h(x_i), in displacements over h, B = J h: without
   units. m_ij is stored relative to x_i. A wall is fixed: its faces contribute nothing. The projection solves
   (B B^T + eps) y = b by conjugate gradients, D the operator's diagonal,

     z = D^-1 r    p = z + beta p    s = B^T p = B^T z + beta s    beta = (r, z) / (r, z)_before
     q = B s + eps p    alpha = (r, z) / (p, q)    r -= alpha q    u -= alpha s

   with (p, q) = |s|^2 + (p, eps p), which is known before q is: an iteration takes two kernels, `descend` and `update`.
   Each group leaves its part of a sum, and all groups add the same parts in the next kernel.

   From a start y_0, such as the last step's solution, the first direction is p = y_0, and the second begins anew with
   beta = 0: as alpha is what suits best along it, a start that is poor, or of another scale, does no harm.

   Derivatives across faces are in single precision, in which the two cells of a face agree well enough; vectors in
   STORE, which is single too where the tolerance allows it: memory traffic is the cost. Sums are in REAL. */

#define ROW(q) (partial + (q)*get_num_groups(0))
#define NORM(k) ((k)&1)
#define GAMMA(k) (2 + ((k)&1))
#define CURVATURE 4

#define PUT(q, sum)                                                                                                    \
    {                                                                                                                  \
        const REAL put_ = group_sum((sum), scratch);                                                                   \
        if (get_local_id(0) == 0)                                                                                      \
            ROW(q)[get_group_id(0)] = put_;                                                                            \
    }

/* One row of the record per iteration. */
#define RECORD_NORM 0
#define RECORD_GAMMA 1
#define RECORD_RUNNING 2
#define RECORD_CURVATURE 3

/* eps = min(3, penalty (1 + max (q / lenience)^2)) / (1 + (r / bound)^2), q = (1 - Q) / sqrt Q of the cell and of its
   neighbors, next to -log Q without the cost of a logarithm; `worst` is the least Q of them. Bad cells and those
   around them are let off their size a little, for they are what costs quality; cells that are far off give way less
   than those that are nearly right, which caps the largest error. A lenience or bound of 0 leaves its factor out. */
inline float penalty_of(float penalty, float lenience, float worst, float bound, float excess)
{
    float e = penalty;
    if (lenience > 0) {
        const float q = (1 - worst) / lenience;
        e = fmin(e * (1 + q * q / fmax(worst, 1e-6f)), fmax(3.0f, penalty));
    }
    const float r = bound > 0 ? excess / bound : 0;
    return e / (1 + r * r);
}

/* Per generator i: own[i] = dr_i/dx_i h_i; for each face the derivatives across it, rows[k] = dr_i/dx_j h_j and
   columns[k] = dr_j/dx_i h_i, axis by axis in arrays of `room`; eps; the inverse of the diagonal of B B^T + eps; and
   r = b = excess + J displacement with the first direction, z = start if `warm`, else D^-1 r. Walls have derivatives of
   0. Generators of labels less than `fixed` do not move. Lengths are divided by h before they are rounded, so that any
   size is in range. */
kernel void assemble(int n, const int room, global const int *starts, global const int *neighbors,
                     global const FACE *face_measures, global const FACE *face_centroids, global const REAL *volumes,
                     global const REAL *points, global const REAL *gradient, global const REAL *h,
                     global const REAL *quality, global const REAL *excess, global const REAL *displacement,
                     const REAL penalty, const REAL lenience, const REAL bound, global float *rows,
                     global float *columns, global STORE *own, global STORE *eps, global STORE *inverse_diagonal,
                     global STORE *r, global STORE *z, global REAL *partial, global const int *labels, const int fixed,
                     const int warm, global const float *start PERIOD_ARGS)
{
    local REAL scratch[GROUP_SIZE];
    Sum norm = SUM_ZERO, gamma = SUM_ZERO;
    const int faces = starts[n], until = starts[block_end(n)];
    for (BLOCK_LOOP(i, n)) {
        REAL x[DIM];
        float self[DIM], moved = 0;
        const REAL hi = h[i], unit = 1 / hi, content = DIM == 2 ? hi * hi : hi * hi * hi;
        const REAL per_face = DIM == 2 ? unit : unit * unit;
        const float shrink = content / volumes[i];
        float diagonal = 0, worst = quality[i];
        const bool still = fixed > 0 && labels[i] < fixed;
        EACH_AXIS(a)
        {
            x[a] = points[DIM * i + a];
            self[a] = 0;
        }
        const int end = starts[i + 1];
        for (int k = starts[i]; k < end; k += AT_ONCE) {
            const MANY(int) facing = TAKE(int, neighbors, k, faces), counts = INSIDE(k, end) & (facing >= 0);
            const MANY(int) j = select((MANY(int))(i), facing, counts);
            MANY(float) d[DIM], d2 = 0, square = 0, changed = 0;
            EACH_AXIS(a)
            {
                d[a] = CONVERT(float, nearest_images(PICK(REAL, points, j, DIM, a) - x[a], PERIOD(a)) * unit);
                d2 += d[a] * d[a];
            }
            /* 0 where nothing counts, and no division by its distance of 0. */
            const MANY(float) length = CONVERT(float, CONVERT(REAL, TAKE(FACE, face_measures, k, faces)) * per_face);
            const MANY(float) w = select((MANY(float))(0), length, counts) / sqrt(select((MANY(float))(1), d2, counts));
            const MANY(float) there = w * ((float)content / CONVERT(float, PICK(REAL, volumes, j, 1, 0)));
            const MANY(float) here = w * shrink, ratio = CONVERT(float, PICK(REAL, h, j, 1, 0) * unit);
            MANY(int) stands = 0;
            if (fixed > 0)
                stands = PICK(int, labels, j, 1, 0) < fixed;
            EACH_AXIS(a)
            {
                const MANY(float) m =
                    CONVERT(float, CONVERT(REAL, TAKE_ROWS(FACE, face_centroids, a, k, faces)) * unit);
                const MANY(float) middle = select((MANY(float))(0), m, counts), other = here * (d[a] - middle);
                changed += other * CONVERT(float, PICK(REAL, displacement, j, DIM, a) * unit);
                square += other * other;
                self[a] += SUM(float, here *middle);
                put_float(select(other * ratio, (MANY(float))(0), stands), rows + a * room, k, end, until);
                put_float(still ? (MANY(float))(0) : -there * middle, columns + a * room, k, end, until);
            }
            moved += SUM(float, changed);
            diagonal += SUM(float, select(square * ratio * ratio, (MANY(float))(0), stands));
            if (lenience > 0)
                worst = fmin(worst, least_float(CONVERT(float, PICK(REAL, quality, j, 1, 0))));
        }
        EACH_AXIS(a)
        {
            /* The size of a cell whose generator does not move does not change by its motion. */
            const float t = still ? 0 : self[a] - DIM * (float)(gradient[DIM * i + a] * hi);
            moved += t * (float)(displacement[DIM * i + a] * unit);
            diagonal += t * t;
            own[DIM * i + a] = t;
        }
        const float e = penalty_of(penalty, lenience, worst, bound, excess[i]);
        const REAL inverse = 1 / (diagonal + e), b = excess[i] + moved;
        eps[i] = e;
        inverse_diagonal[i] = inverse;
        const REAL first = warm ? start[i] : inverse * b;
        r[i] = b;
        z[i] = first;
        sum_add(&norm, b * b);
        sum_add(&gamma, first * b);
    }
    PUT(NORM(0), norm.value);
    PUT(GAMMA(0), gamma.value);
}

/* Of the faces from f on: the cells beyond, any one beyond a wall, and the derivatives across, 0 there and for other
   rows' faces. */
#define FACING(f) max(TAKE(int, it->neighbors, f, faces), (MANY(int))(0))
#define DERIVATIVE(across, f, a)                                                                                       \
    CONVERT(STORE, select((MANY(float))(0), TAKE(float, across + (a)*it->room, f, faces), inside))

/* What the iteration works on. */
typedef struct {
    int n, most, room, warm;
    REAL tolerance;
    global const int *starts, *neighbors;
    global const float *rows, *columns;
    global const STORE *own, *eps, *inverse_diagonal;
    global STORE *p, *s, *u, *y, *r, *z;
    global REAL *partial, *record;
} iteration_t;

#define ITERATION_ARGS                                                                                                 \
    const int n, const int most, const int room, const int warm, const REAL tolerance, global const int *starts,       \
        global const int *neighbors, global const float *rows, global const float *columns, global const STORE *own,   \
        global const STORE *eps, global const STORE *inverse_diagonal, global STORE *p, global STORE *s,               \
        global STORE *u, global STORE *y, global STORE *r, global STORE *z, global REAL *partial, global REAL *record
#define ITERATION                                                                                                      \
    {                                                                                                                  \
        n, most, room, warm, tolerance, starts, neighbors, rows, columns, own, eps, inverse_diagonal, p, s, u, y, r,   \
            z, partial, record                                                                                         \
    }

/* p = z + beta p and s = B^T z + beta s. From the iteration on that finds the residual at its target, or is the last
   (or finds anything out of order, NaN included), record[k].running is 0 and nothing changes any more, so that the host
   may run ahead without changing the result. */
inline void go_down(int k, const iteration_t *it, local REAL *scratch)
{
    global REAL *partial = it->partial, *now = it->record + 4 * k;
    global const REAL *last = now - 4;
    const int first = get_global_id(0) == 0;
    const int start = it->warm != 0;
    const int over = k > 0 && !(last[RECORD_RUNNING] != 0 && (last[RECORD_CURVATURE] > 0 || k == start));
    const REAL norm = total_sum(ROW(NORM(k)), scratch), gamma = total_sum(ROW(GAMMA(k)), scratch);
    const REAL target = it->tolerance * it->tolerance * (k > 0 ? it->record[RECORD_NORM] : norm);
    const int running = !over && k < it->most && norm > target && norm <= REAL_MAX && (gamma > 0 || k < start);
    if (first) {
        now[RECORD_RUNNING] = running;
        now[RECORD_NORM] = norm;
        now[RECORD_GAMMA] = gamma;
    }
    const STORE beta = k > start ? gamma / last[RECORD_GAMMA] : 0;
    const int end = running ? it->n : 0, faces = it->starts[it->n];
    Sum curvature = SUM_ZERO;
    for (BLOCK_LOOP(i, end)) {
        const STORE zi = it->z[i], pi = k > start ? zi + beta * it->p[i] : zi;
        STORE sum[DIM];
        EACH_AXIS(a)
        sum[a] = it->own[DIM * i + a] * zi + (k > start ? beta * it->s[DIM * i + a] : 0);
        const int end_of_row = it->starts[i + 1];
        for (int f = it->starts[i]; f < end_of_row; f += AT_ONCE) {
            const MANY(int) inside = INSIDE(f, end_of_row), j = FACING(f);
            const MANY(STORE) zj = PICK(STORE, it->z, j, 1, 0);
            EACH_AXIS(a)
            sum[a] += SUM(STORE, DERIVATIVE(it->columns, f, a) * zj);
        }
        it->p[i] = pi;
        REAL product = (REAL)it->eps[i] * pi * pi;
        EACH_AXIS(a)
        {
            it->s[DIM * i + a] = sum[a];
            product += (REAL)sum[a] * sum[a];
        }
        sum_add(&curvature, product);
    }
    PUT(CURVATURE, curvature.value);
}

/* y += alpha p, u -= alpha s, r -= alpha (B s + eps p), z = D^-1 r. */
inline void go_up(int k, const iteration_t *it, local REAL *scratch)
{
    global REAL *partial = it->partial, *now = it->record + 4 * k;
    const int running = now[RECORD_RUNNING] != 0;
    const REAL curvature = total_sum(ROW(CURVATURE), scratch);
    if (running && get_global_id(0) == 0)
        now[RECORD_CURVATURE] = curvature;
    /* A start of zero has no curvature. */
    const int ahead = curvature > 0, started = k < it->warm;
    const STORE alpha = ahead ? now[RECORD_GAMMA] / curvature : 0;
    const int end = running && (ahead || started) ? it->n : 0, faces = it->starts[it->n];
    Sum norm = SUM_ZERO, gamma = SUM_ZERO;
    for (BLOCK_LOOP(i, end)) {
        const STORE pi = it->p[i];
        STORE q = it->eps[i] * pi;
        it->y[i] = (k > 0 ? it->y[i] : 0) + alpha * pi;
        EACH_AXIS(a)
        {
            const STORE si = it->s[DIM * i + a];
            q += it->own[DIM * i + a] * si;
            it->u[DIM * i + a] = (k > 0 ? it->u[DIM * i + a] : 0) - alpha * si;
        }
        const int end_of_row = it->starts[i + 1];
        for (int f = it->starts[i]; f < end_of_row; f += AT_ONCE) {
            const MANY(int) inside = INSIDE(f, end_of_row), j = FACING(f);
            MANY(STORE) sum = 0;
            EACH_AXIS(a)
            sum += DERIVATIVE(it->rows, f, a) * PICK(STORE, it->s, j, DIM, a);
            q += SUM(STORE, sum);
        }
        const STORE ri = it->r[i] - alpha * q, zi = it->inverse_diagonal[i] * ri;
        it->r[i] = ri;
        it->z[i] = zi;
        sum_add(&norm, (REAL)ri * ri);
        sum_add(&gamma, (REAL)ri * zi);
    }
    PUT(NORM(k + 1), norm.value);
    PUT(GAMMA(k + 1), gamma.value);
}

kernel void descend(const int k, ITERATION_ARGS)
{
    local REAL scratch[GROUP_SIZE];
    const iteration_t it = ITERATION;
    go_down(k, &it, scratch);
}

kernel void update(const int k, ITERATION_ARGS)
{
    local REAL scratch[GROUP_SIZE];
    const iteration_t it = ITERATION;
    go_up(k, &it, scratch);
}

/* One group, where cells are few: all iterations. */
kernel void iterate(ITERATION_ARGS)
{
    local REAL scratch[GROUP_SIZE];
    const iteration_t it = ITERATION;
    bool running = true;
    for (int k = 0; running; ++k) {
        go_down(k, &it, scratch);
        barrier(CLK_GLOBAL_MEM_FENCE);
        running = record[4 * k + RECORD_RUNNING] != 0;
        go_up(k, &it, scratch);
        barrier(CLK_GLOBAL_MEM_FENCE);
    }
}

/* Per generator i: what the projection takes from the displacement, correction = h u, and the next start. */
kernel void put_correction(const int size, global const STORE *u, global const STORE *y, global const REAL *h,
                           global REAL *correction, global float *start)
{
    WORK_ITEM(i);
    start[i] = y[i];
    EACH_AXIS(a)
    correction[DIM * i + a] = h[i] * u[DIM * i + a];
}
