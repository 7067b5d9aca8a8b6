/* The size field as a density of generators, rho = h^-d: weights of the cells, grad log h, weighted centroids. One
   work-item per generator unless a kernel says otherwise. */
#include "geometry/domain.h"
#include "opencl/blocks.h"
#include "opencl/reduce.h"
#include "opencl/row_entries.h"
#include "geometry/site.h"

/* density = rho = h^-d, weight = V rho (the number of generators that the cell should have), log_ratio = r = log(V rho)
   = log(V / h^d) = d log(L / h).

   One work-item per four generators, because four logarithms cost as much as one on a CPU. */
kernel void evaluate_density(const int size, global const REAL *volumes, global const REAL *h, global REAL *density,
                             global REAL *weight, global REAL *log_ratio, global REAL *log_h)
{
    LONG_ITEM(quad);
    const int begin = 4 * quad;
    if (begin >= size)
        return;
    if (begin + 4 <= size) {
        const REAL4 target = vload4(0, h + begin), volume = vload4(0, volumes + begin);
        const REAL4 rho = 1 / (CELL_DIM == 2 ? target * target : target * target * target), v = volume * rho;
        vstore4(rho, 0, density + begin);
        vstore4(v, 0, weight + begin);
        vstore4(log(v), 0, log_ratio + begin);
        vstore4(log(target), 0, log_h + begin);
        return;
    }
    for (int i = begin; i < size; ++i) {
        const REAL target = h[i];
        const REAL rho = 1 / (CELL_DIM == 2 ? target * target : target * target * target);
        density[i] = rho;
        weight[i] = volumes[i] * rho;
        log_ratio[i] = log(volumes[i] * rho);
        log_h[i] = log(target);
    }
}

/* Component `a` in space of a vector in the plane of a cell. */
#ifdef SPHERE
#define SPATIAL(site, v, a) ((v)[0] * (site)[3 + (a)] + (v)[1] * (site)[6 + (a)])
#else
#define SPATIAL(site, v, a) ((v)[a])
#endif

/* Displacement to the centroid weighted by h^-(d + 2), the paper's (2.4): centroidal diagrams of this density have
   cells of size h.

       c + Cov (-(d + 2) g),   g = grad log h, Cov the covariance of the cell

   This is exact for rho = rho_i exp(-(d + 2) g.(y - x_i)) to first order in the cell. Measured, quadrature of h inside
   the cells is not better. */
inline void weighted_offset(const int i, const REAL *gradient, const REAL *site, global const REAL *offsets,
                            global const REAL *covariances, global REAL *lloyd)
{
    REAL g[CELL_DIM];
    EACH_COMPONENT (a)
        g[a] = -(CELL_DIM + 2) * gradient[a];
#if CELL_DIM == 2
    const REAL xx = covariances[3 * i], xy = covariances[3 * i + 1], yy = covariances[3 * i + 2];
#ifdef SPHERE
    const REAL along[2] = {xx * g[0] + xy * g[1], xy * g[0] + yy * g[1]};
    EACH_AXIS (a)
        lloyd[3 * i + a] = offsets[3 * i + a] + SPATIAL(site, along, a);
#else
    lloyd[2 * i] = offsets[2 * i] + xx * g[0] + xy * g[1];
    lloyd[2 * i + 1] = offsets[2 * i + 1] + xy * g[0] + yy * g[1];
#endif
#else
    global const REAL *c = covariances + 6 * i;
    lloyd[3 * i] = offsets[3 * i] + c[0] * g[0] + c[1] * g[1] + c[2] * g[2];
    lloyd[3 * i + 1] = offsets[3 * i + 1] + c[1] * g[0] + c[3] * g[1] + c[4] * g[2];
    lloyd[3 * i + 2] = offsets[3 * i + 2] + c[2] * g[0] + c[4] * g[1] + c[5] * g[2];
#endif
}

/* gradient = grad log h by least squares over the neighbors, weighted by 1 / distance^2, on a sphere in the tangent
   plane; lloyd = displacement to the weighted centroid. One evaluation of h per generator is enough, and the fit
   averages kinks of h over a cell. */
kernel void fit_gradient(const int size, global const int *starts, global const int *neighbors,
                         global const REAL *points, global const REAL *log_h, global const REAL *offsets,
                         global const REAL *covariances, global REAL *gradient, global REAL *lloyd PERIOD_ARGS)
{
    LONG_ITEM(i);
    MANY(REAL) sums[CELL_DIM][CELL_DIM], rises[CELL_DIM];
    REAL m[CELL_DIM][CELL_DIM], b[CELL_DIM], g[CELL_DIM];
    EACH_COMPONENT (p) {
        rises[p] = 0;
        EACH_COMPONENT (q)
            sums[p][q] = 0;
    }
#ifdef SPHERE
    SITE(site, i, points);
#else
    const REAL *site = 0;
#endif
    const int faces = starts[size], end = starts[i + 1];
    for (int k = starts[i]; k < end; k += AT_ONCE) {
        const MANY(int) facing = TAKE(int, neighbors, k, faces), counts = INSIDE(k, end) & (facing >= 0);
        const MANY(int) j = CHOOSE(int, counts, facing, i);
        MANY(REAL) d[DIM], d2 = 0;
        EACH_AXIS (a)
            d[a] = nearest_images(PICK(REAL, points, j, DIM, a) - points[DIM * i + a], PERIOD(a));
#ifdef SPHERE
        const MANY(REAL) one = ALONG(MANY(REAL), site + 3, d), two = ALONG(MANY(REAL), site + 6, d);
        d[0] = one;
        d[1] = two;
#endif
        EACH_COMPONENT (a)
            d2 += d[a] * d[a];
        /* Walls have distance 1 and no difference. */
        const MANY(REAL) weight = 1 / CHOOSE(REAL, counts, d2, 1), rise = PICK(REAL, log_h, j, 1, 0) - log_h[i];
        EACH_COMPONENT (p) {
            const MANY(REAL) weighted = d[p] * weight;
            rises[p] += weighted * rise;
            EACH_COMPONENT (q)
                if (q >= p)
                    sums[p][q] += weighted * d[q];
        }
    }
    EACH_COMPONENT (p) {
        b[p] = SUM(REAL, rises[p]);
        EACH_COMPONENT (q)
            if (q >= p)
                m[p][q] = m[q][p] = SUM(REAL, sums[p][q]);
    }
    /* The gradient is 0 if neighbors are too few or collinear. Division by infinity, because PoCL 6 with LLVM 18
       crashes on a branch here. */
    const REAL trace = m[0][0] + m[1][1] + (CELL_DIM == 3 ? m[CELL_DIM - 1][CELL_DIM - 1] : 0);
    const REAL least = sqrt(REAL_EPS);
#if CELL_DIM == 2
    const REAL det = m[0][0] * m[1][1] - m[0][1] * m[1][0];
    const REAL over = det > least * trace * trace ? det : INFINITY;
    g[0] = (b[0] * m[1][1] - b[1] * m[0][1]) / over;
    g[1] = (m[0][0] * b[1] - m[1][0] * b[0]) / over;
#else
    const REAL c0 = m[1][1] * m[2][2] - m[1][2] * m[2][1];
    const REAL c1 = m[1][2] * m[2][0] - m[1][0] * m[2][2];
    const REAL c2 = m[1][0] * m[2][1] - m[1][1] * m[2][0];
    const REAL det = m[0][0] * c0 + m[0][1] * c1 + m[0][2] * c2;
    const REAL over = det > least * trace * trace * trace ? det : INFINITY;
    g[0] =
        (b[0] * c0 + b[1] * (m[0][2] * m[2][1] - m[0][1] * m[2][2]) + b[2] * (m[0][1] * m[1][2] - m[0][2] * m[1][1])) /
        over;
    g[1] =
        (b[0] * c1 + b[1] * (m[0][0] * m[2][2] - m[0][2] * m[2][0]) + b[2] * (m[0][2] * m[1][0] - m[0][0] * m[1][2])) /
        over;
    g[2] =
        (b[0] * c2 + b[1] * (m[0][1] * m[2][0] - m[0][0] * m[2][1]) + b[2] * (m[0][0] * m[1][1] - m[0][1] * m[1][0])) /
        over;
#endif
    EACH_AXIS (a)
        gradient[DIM * i + a] = SPATIAL(site, g, a);
    weighted_offset(i, g, site, offsets, covariances, lloyd);
}

/* partial = per work-group, sum of V rho r, then sum of V rho: the ratio of their sums is the mean of r. A wrong number
   of generators changes the mean; motion cannot correct it, insertion and deletion can. */
kernel void sum_log_ratio(const int size, global const REAL *weight, global const REAL *log_ratio, global REAL *partial)
{
    LONG_GROUP;
    Sum weighed = SUM_ZERO, total = SUM_ZERO;
    for (GROUP_LOOP(i, size)) {
        sum_add(&weighed, weight[i] * log_ratio[i]);
        sum_add(&total, weight[i]);
    }
    const REAL sums[2] = {group_sum(weighed.value, group), group_sum(total.value, group)};
    if (GROUP_ITEM == 0) {
        partial[group.id] = sums[0];
        partial[group.count + group.id] = sums[1];
    }
}
