/* Volume projection: the smallest displacement that gives all cells their volumes, to first order.

   The derivative of the volumes with respect to the generators is exact,

     dV_i/dx_j = w_ij (x_j - m_ij),   dV_i/dx_i = sum_j w_ij (m_ij - x_i),   w_ij = l_ij / d_ij,

   with m_ij the centroid of the face, stored relative to x_i. Faces on walls contribute nothing. It gives the operator
   J = dr/dx of the log ratios r_i = log V_i - d log h(x_i), and B = J h, without units. Conjugate gradients with the
   diagonal D of the operator as preconditioner solve (B B^T + eps) y = b,

     z = D^-1 r    p = z + beta p    s = B^T p = B^T z + beta s    beta = (r, z) / (r, z)_before
     q = B s + eps p    alpha = (r, z) / (p, q)    r -= alpha q    u -= alpha s

   Because (p, q) = |s|^2 + (p, eps p) is known before q, an iteration takes two kernels: `update_projection_direction`
   and `update_projection`. One work-item per cell of a block, one block per work-group.

   From a start y_0, such as the solution of the last step, the first direction is p = y_0, and the second has beta = 0.
   alpha is optimal along p, so that a poor start, or one of another scale, does no harm.

   Derivatives with respect to a generator have CELL_DIM components: along the axes, or on a sphere along the two
   tangents at that generator.

   Derivatives across faces are in single precision; vectors are in STORE, which is single precision where the tolerance
   allows it. Sums are in REAL. */
#include "geometry/domain.h"
#include "opencl/blocks.h"
#include "opencl/reduce.h"
#include "opencl/row_entries.h"
#include "solvers/partial_sums.h"

/* Rows of partial. */
#define NORM(k) ((k)&1)
#define GAMMA(k) (2 + ((k)&1))
#define CURVATURE 4

/* eps = min(3, penalty (1 + q^2 / quality_scale^2)) / (1 + (r / log_ratio_scale)^power), q = (1 - Q) / sqrt Q.

   Q is the least quality of the cell and its neighbors; q is close to -log Q, without a logarithm. Bad cells and their
   neighbors may miss their size a little, since they limit the quality. Cells far from their size may not, which bounds
   the largest error. The power is 2, or 4: then r below the scale costs less, and r above it more. A scale of 0 leaves
   its factor out. Cells on walls have a quality scale of their own. */
inline float penalty_of(float penalty, float quality_scale, float least_quality, float log_ratio_scale, int power,
                        float log_ratio)
{
    float e = penalty;
    if (quality_scale > 0) {
        const float q = (1 - least_quality) / quality_scale;
        e = fmin(e * (1 + q * q / fmax(least_quality, 1e-6f)), fmax(3.0f, penalty));
    }
    const float r = log_ratio_scale > 0 ? log_ratio / log_ratio_scale : 0, square = r * r;
    return e / (1 + (power == 4 ? square * square : square));
}

/* The arguments of the iteration. */
typedef struct {
    int n, max_iterations, room, warm;
    REAL tolerance;
    global const int *starts, *neighbors;
    global const float *rows, *columns;
    global const STORE *own, *eps, *inverse;
    global STORE *p, *s, *u, *y, *r, *z;
    global REAL *partial, *record;
} iteration_t;

#define ITERATION_ARGS                                                                                                 \
    const int n, const int max_iterations, const int room, const int warm, const REAL tolerance,                       \
        global const int *starts, global const int *neighbors, global float *rows, global float *columns,              \
        global STORE *own, global STORE *eps, global STORE *inverse, global STORE *p, global STORE *s,                 \
        global STORE *u, global STORE *y, global STORE *r, global STORE *z, global REAL *partial, global REAL *record
#define ITERATION                                                                                                      \
    n, max_iterations, room, warm, tolerance, starts, neighbors, rows, columns, own, eps, inverse, p, s, u, y, r, z,   \
        partial, record

/* The further arguments of the assembly. */
#define ASSEMBLY_ARGS                                                                                                  \
    global const FACE *face_measures, global const FACE *face_centroids, global const REAL *volumes,                   \
        global const REAL *points, global const REAL *gradient, global const REAL *h, global const REAL *quality,      \
        global const REAL *log_ratio, global REAL *displacement, const REAL penalty, const REAL quality_scale,         \
        const REAL wall_penalty, const REAL wall_quality_scale, const REAL log_ratio_scale, const int power,           \
        global const REAL *mean_partial, const int mean_groups, global const int *labels, const int fixed,             \
        global float *start
#define ASSEMBLY                                                                                                       \
    face_measures, face_centroids, volumes, points, gradient, h, quality, log_ratio, displacement, penalty,            \
        quality_scale, wall_penalty, wall_quality_scale, log_ratio_scale, power, mean_partial, mean_groups, labels,    \
        fixed, start

/* Whether cell i is on a wall. */
inline bool is_on_wall(int i, int faces, global const int *starts, global const int *neighbors)
{
    bool found = false;
    for (int k = starts[i], end = starts[i + 1]; k < end && !found; k += AT_ONCE)
        found = ANY(INSIDE(k, end) & (TAKE(int, neighbors, k, faces) < 0));
    return found;
}

/* One work-item per cell: note in p, which is free until the first direction, which cells are on walls, for solids. */
kernel void mark_walls(const int size, global const int *starts, global const int *neighbors, global STORE *p)
{
    WORK_ITEM(i);
    p[i] = is_on_wall(i, starts[size], starts, neighbors);
}

/* Assemble the operator and the right side, one work-item per generator i of a block:

     own[i] = dr_i/dx_i h_i      rows[k] = dr_i/dx_j h_j      columns[k] = dr_j/dx_i h_i   for face k = (i, j)
     r = b = log_ratio + J displacement      z = start if `warm`, else D^-1 r

   together with eps and D^-1. From the log ratios their mean is subtracted if `mean_groups` is not 0, the number of
   groups whose sums, of `sum_log_ratio`, are in `mean_partial`. rows and columns have one array of `room` entries per
   component; entries of walls are 0. Generators with labels below `fixed` do not move. Lengths are divided by h before
   they are rounded, so that sizes of any magnitude are in range. */
inline void assemble_rows(ITERATION_ARGS, ASSEMBLY_ARGS PERIOD_ARGS, group_t group)
{
    const REAL weighed = sum_of_groups(mean_partial, mean_groups, group);
    const REAL weight = sum_of_groups(mean_partial + mean_groups, mean_groups, group);
    const REAL mean = mean_groups > 0 ? weighed / weight : 0;
    Sum norm = SUM_ZERO, gamma = SUM_ZERO;
    const int faces = starts[n], until = starts[block_start(n, group.id + 1, group.count)];
    for (GROUP_LOOP(i, n)) {
        REAL x[DIM];
        float self[CELL_DIM], change = 0;
        const REAL hi = h[i], unit = 1 / hi, content = CELL_DIM == 2 ? hi * hi : hi * hi * hi;
        const REAL per_face = CELL_DIM == 2 ? unit : unit * unit;
        const float shrink = content / volumes[i];
        float diagonal = 0, least_quality = quality[i];
        bool on_wall = false, beside_wall = false;
        const bool is_fixed = fixed > 0 && labels[i] < fixed;
        EACH_AXIS (a)
            x[a] = points[DIM * i + a];
        EACH_COMPONENT (c)
            self[c] = 0;
#ifdef SPHERE
        const float at[3] = {x[0], x[1], x[2]};
        float one[3], two[3];
        FLOAT_TANGENTS(float, at, one, two);
#endif
        const int end = starts[i + 1];
        for (int k = starts[i]; k < end; k += AT_ONCE) {
            const MANY(int) facing = TAKE(int, neighbors, k, faces), counts = INSIDE(k, end) & (facing >= 0);
            const MANY(int) j = select((MANY(int))(i), facing, counts);
            on_wall = on_wall || ANY(INSIDE(k, end) & (facing < 0));
#ifdef OWN_WALLS
            beside_wall = beside_wall || ANY(CONVERT(int, PICK(STORE, p, j, 1, 0)) > 0);
#endif
            MANY(float) d[DIM], d2 = 0, square = 0, displaced = 0, middle[DIM], other[DIM];
#ifdef SPHERE
            MANY(float) there_at[DIM];
#endif
            EACH_AXIS (a) {
                const MANY(REAL) xj = PICK(REAL, points, j, DIM, a);
                d[a] = CONVERT(float, nearest_images(xj - x[a], PERIOD(a)) * unit);
                d2 += d[a] * d[a];
#ifdef SPHERE
                there_at[a] = CONVERT(float, xj);
#endif
            }
            /* w = 0 on walls, without a division by their distance of 0. */
            const MANY(float) length = CONVERT(float, CONVERT(REAL, TAKE(FACE, face_measures, k, faces)) * per_face);
            const MANY(float) w = select((MANY(float))(0), length, counts) / sqrt(select((MANY(float))(1), d2, counts));
            const MANY(float) there = w * ((float)content / CONVERT(float, PICK(REAL, volumes, j, 1, 0)));
            const MANY(float) here = w * shrink, ratio = CONVERT(float, PICK(REAL, h, j, 1, 0) * unit);
            MANY(int) fixed_there = 0;
            if (fixed > 0)
                fixed_there = PICK(int, labels, j, 1, 0) < fixed;
            EACH_AXIS (a) {
                const MANY(float) m =
                    CONVERT(float, CONVERT(REAL, TAKE_ROWS(FACE, face_centroids, a, k, faces)) * unit);
                middle[a] = select((MANY(float))(0), m, counts);
                other[a] = here * (d[a] - middle[a]);
                displaced += other[a] * CONVERT(float, PICK(REAL, displacement, j, DIM, a) * unit);
            }
#ifdef SPHERE
            MANY(float) p[3], q[3];
            FLOAT_TANGENTS(MANY(float), there_at, p, q);
            const MANY(float) own_side[2] = {ALONG(MANY(float), one, middle), ALONG(MANY(float), two, middle)};
            const MANY(float) other_side[2] = {ALONG(MANY(float), p, other), ALONG(MANY(float), q, other)};
#else
            const MANY(float) *own_side = middle, *other_side = other;
#endif
            EACH_COMPONENT (c) {
                square += other_side[c] * other_side[c];
                self[c] += SUM(float, here *own_side[c]);
                put_float(select(other_side[c] * ratio, (MANY(float))(0), fixed_there), rows + c * room, k, end, until);
                put_float(is_fixed ? (MANY(float))(0) : -there * own_side[c], columns + c * room, k, end, until);
            }
            change += SUM(float, displaced);
            diagonal += SUM(float, select(square * ratio * ratio, (MANY(float))(0), fixed_there));
            if (quality_scale > 0)
                least_quality = fmin(least_quality, least_float(CONVERT(float, PICK(REAL, quality, j, 1, 0))));
        }
#ifdef OWN_WALLS
        /* Walls cut each cell by itself, so that the face of the cell across may differ. Derivatives are the means of
           those by both faces: else B^T were not the transpose of B, and the iteration could diverge. Faces between
           cells that no wall cuts are the same from both sides. */
        diagonal = beside_wall ? 0 : diagonal;
        for (int k = starts[i]; beside_wall && k < end; ++k) {
            const int j = neighbors[k];
            const int back = j < 0 || !(on_wall || p[j] > 0) ? -1 : find_entry(i, j, faces - 8, starts, neighbors);
            if (back >= 0) {
                REAL away[3], square = 0;
                EACH_AXIS (a) {
                    away[a] = x[a] - points[3 * j + a];
                    square += away[a] * away[a];
                }
                const REAL w = R(0.5) * face_measures[back] / sqrt(square);
                const REAL here = fixed > 0 && labels[j] < fixed ? 0 : w * h[j] / volumes[i];
                const REAL there = is_fixed ? 0 : w * hi / volumes[j];
                EACH_AXIS (a) {
                    const int at = a * room + k;
                    const REAL m = face_centroids[3 * back + a], more = -here * m - R(0.5) * rows[at];
                    rows[at] += more;
                    columns[at] = R(0.5) * columns[at] + there * (away[a] - m);
                    change += more * displacement[3 * j + a] / h[j];
                }
            }
            EACH_AXIS (a)
                diagonal += rows[a * room + k] * rows[a * room + k];
        }
#endif
        float slope[DIM], moved[DIM];
        EACH_AXIS (a) {
            slope[a] = gradient[DIM * i + a] * hi;
            moved[a] = displacement[DIM * i + a] * unit;
        }
#ifdef SPHERE
        const float along[4] = {ALONG(float, one, slope), ALONG(float, two, slope), ALONG(float, one, moved),
                                ALONG(float, two, moved)};
        EACH_COMPONENT (c) {
            slope[c] = along[c];
            moved[c] = along[2 + c];
        }
#endif
        EACH_COMPONENT (c) {
            /* A fixed generator changes neither its volume nor its size. */
            const float t = is_fixed ? 0 : self[c] - CELL_DIM * slope[c];
            change += t * moved[c];
            diagonal += t * t;
            own[CELL_DIM * i + c] = t;
        }
        const float base = on_wall ? wall_penalty : penalty, scale = on_wall ? wall_quality_scale : quality_scale;
        const REAL ratio = log_ratio[i] - mean;
        const float e = penalty_of(base, scale, least_quality, log_ratio_scale, power, ratio);
        const REAL reciprocal = 1 / (diagonal + e), b = ratio + change;
        eps[i] = e;
        inverse[i] = reciprocal;
        const REAL first = warm ? start[i] : reciprocal * b;
        r[i] = b;
        z[i] = first;
        sum_add(&norm, b * b);
        sum_add(&gamma, first * b);
    }
    PUT(NORM(0), norm.value);
    PUT(GAMMA(0), gamma.value);
}

kernel void assemble_projection(ITERATION_ARGS, global int *counts, ASSEMBLY_ARGS PERIOD_ARGS)
{
    LONG_GROUP;
    if (IS_FIRST_ITEM)
        counts[UPDATES] = 0;
    assemble_rows(ITERATION, ASSEMBLY PERIODS, group);
}

/* For AT_ONCE faces from f on: the cells across them (any cell for walls), and the derivatives across them, 0 for walls
   and for faces of other rows. */
#define FACING(f) max(TAKE(int, it->neighbors, f, faces), (MANY(int))(0))
#define DERIVATIVE(across, f, a)                                                                                       \
    CONVERT(STORE, select((MANY(float))(0), TAKE(float, across + (a)*it->room, f, faces), inside))

/* p = z + beta p, s = B^T z + beta s. record[k].running becomes 0 if |r| is within the tolerance, if `max_iterations`
   are done, or if a value is not positive or not finite. */
inline void step_projection_direction(int k, const iteration_t *it, group_t group)
{
    global REAL *partial = it->partial, *now = it->record + 4 * k;
    global const REAL *last = now - 4;
    const int first = IS_FIRST_ITEM;
    const int start = it->warm != 0;
    const int stopped = k > 0 && !(last[RECORD_RUNNING] != 0 && (last[RECORD_CURVATURE] > 0 || k == start));
    const REAL norm = total_sum(ROW(NORM(k)), group), gamma = total_sum(ROW(GAMMA(k)), group);
    const REAL target = it->tolerance * it->tolerance * (k > 0 ? it->record[RECORD_NORM] : norm);
    const int running =
        !stopped && k < it->max_iterations && norm > target && norm <= REAL_MAX && (gamma > 0 || k < start);
    if (first) {
        now[RECORD_RUNNING] = running;
        now[RECORD_NORM] = norm;
        now[RECORD_GAMMA] = gamma;
    }
    const STORE beta = k > start ? gamma / last[RECORD_GAMMA] : 0;
    const int end = running ? it->n : 0, faces = it->starts[it->n];
    Sum curvature = SUM_ZERO;
    for (GROUP_LOOP(i, end)) {
        const STORE zi = it->z[i], pi = k > start ? zi + beta * it->p[i] : zi;
        STORE sum[CELL_DIM];
        EACH_COMPONENT (a)
            sum[a] = it->own[CELL_DIM * i + a] * zi + (k > start ? beta * it->s[CELL_DIM * i + a] : 0);
        const int end_of_row = it->starts[i + 1];
        for (int f = it->starts[i]; f < end_of_row; f += AT_ONCE) {
            const MANY(int) inside = INSIDE(f, end_of_row), j = FACING(f);
            const MANY(STORE) zj = PICK(STORE, it->z, j, 1, 0);
            EACH_COMPONENT (a)
                sum[a] += SUM(STORE, DERIVATIVE(it->columns, f, a) * zj);
        }
        it->p[i] = pi;
        REAL product = (REAL)it->eps[i] * pi * pi;
        EACH_COMPONENT (a) {
            it->s[CELL_DIM * i + a] = sum[a];
            product += (REAL)sum[a] * sum[a];
        }
        sum_add(&curvature, product);
    }
    PUT(CURVATURE, curvature.value);
}

/* y += alpha p, u -= alpha s, r -= alpha (B s + eps p), z = D^-1 r. */
inline void step_projection(int k, const iteration_t *it, group_t group)
{
    global REAL *partial = it->partial, *now = it->record + 4 * k;
    const int running = now[RECORD_RUNNING] != 0;
    const REAL curvature = total_sum(ROW(CURVATURE), group);
    if (running && IS_FIRST_ITEM)
        now[RECORD_CURVATURE] = curvature;
    /* A start of 0 has curvature 0. */
    const int ahead = curvature > 0, first_direction = k < it->warm;
    const STORE alpha = ahead ? now[RECORD_GAMMA] / curvature : 0;
    const int end = running && (ahead || first_direction) ? it->n : 0, faces = it->starts[it->n];
    Sum norm = SUM_ZERO, gamma = SUM_ZERO;
    for (GROUP_LOOP(i, end)) {
        const STORE pi = it->p[i];
        STORE q = it->eps[i] * pi;
        it->y[i] = (k > 0 ? it->y[i] : 0) + alpha * pi;
        EACH_COMPONENT (a) {
            const STORE si = it->s[CELL_DIM * i + a];
            q += it->own[CELL_DIM * i + a] * si;
            it->u[CELL_DIM * i + a] = (k > 0 ? it->u[CELL_DIM * i + a] : 0) - alpha * si;
        }
        const int end_of_row = it->starts[i + 1];
        for (int f = it->starts[i]; f < end_of_row; f += AT_ONCE) {
            const MANY(int) inside = INSIDE(f, end_of_row), j = FACING(f);
            MANY(STORE) sum = 0;
            EACH_COMPONENT (a)
                sum += DERIVATIVE(it->rows, f, a) * PICK(STORE, it->s, j, CELL_DIM, a);
            q += SUM(STORE, sum);
        }
        const STORE ri = it->r[i] - alpha * q, zi = it->inverse[i] * ri;
        it->r[i] = ri;
        it->z[i] = zi;
        sum_add(&norm, (REAL)ri * ri);
        sum_add(&gamma, (REAL)ri * zi);
    }
    PUT(NORM(k + 1), norm.value);
    PUT(GAMMA(k + 1), gamma.value);
}

kernel void update_projection_direction(ITERATION_ARGS, global int *counts)
{
    LONG_GROUP;
    const iteration_t it = {ITERATION};
    step_projection_direction(number_of_direction(counts, group), &it, group);
}

kernel void update_projection(ITERATION_ARGS, global int *counts)
{
    LONG_GROUP;
    const iteration_t it = {ITERATION};
    step_projection(number_of_update(counts, group), &it, group);
}

/* The correction h u of generator i, and y as the start of the next projection. */
inline void put_correction(int i, global const STORE *u, global const STORE *y, global const REAL *h,
                           global const REAL *points, global REAL *correction, global float *start)
{
    start[i] = y[i];
#ifdef SPHERE
    const float x[3] = {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
    float e[3], f[3];
    FLOAT_TANGENTS(float, x, e, f);
    EACH_AXIS (a)
        correction[3 * i + a] = h[i] * (u[2 * i] * e[a] + u[2 * i + 1] * f[a]);
#else
    EACH_AXIS (a)
        correction[DIM * i + a] = h[i] * u[DIM * i + a];
#endif
}

/* One work-item per generator. */
kernel void write_correction(const int size, global const STORE *u, global const STORE *y, global const REAL *h,
                             global const REAL *points, global REAL *correction, global float *start)
{
    WORK_ITEM(i);
    put_correction(i, u, y, h, points, correction, start);
}

/* All of the projection by one work-group, for few cells. The correction is 0 if there is no iteration. If a number is
   not finite, the displacement becomes 0 as well: the host learns of it later. */
kernel void project_by_group(ITERATION_ARGS, global REAL *correction, ASSEMBLY_ARGS PERIOD_ARGS)
{
    LONG_GROUP;
#ifdef OWN_WALLS
    for (GROUP_LOOP(i, n))
        p[i] = is_on_wall(i, starts[n], starts, neighbors);
    GROUP_BARRIER;
#endif
    assemble_rows(ITERATION, ASSEMBLY PERIODS, group);
    GROUP_BARRIER;
    const iteration_t it = {ITERATION};
    int k = 0;
    for (bool running = true; running; k += running) {
        step_projection_direction(k, &it, group);
        GROUP_BARRIER;
        running = record[4 * k + RECORD_RUNNING] != 0;
        step_projection(k, &it, group);
        GROUP_BARRIER;
    }
    const REAL curvature = k > 0 ? record[4 * (k - 1) + RECORD_CURVATURE] : 1;
    const bool flat = !(curvature > 0), sound = record[4 * k + RECORD_NORM] <= REAL_MAX && (!flat || curvature == 0);
    const int moving = sound && k - flat > 0 ? n : 0;
    for (GROUP_LOOP(i, moving))
        put_correction(i, u, y, h, points, correction, start);
    for (GROUP_LOOP(i, n - moving)) {
        EACH_AXIS (a) {
            correction[DIM * i + a] = 0;
            if (!sound)
                displacement[DIM * i + a] = 0;
        }
    }
}
