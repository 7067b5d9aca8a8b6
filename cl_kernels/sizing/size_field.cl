/* The size field h' = h / scale and grad log h in normalized coordinates. One work-item per point.

   `size_at` and its data come from the host (see sizing/size_fields.h). points: (size, DIM). invalid: the smallest
   index with an h that is not positive or above MAX_SIZE (NaN included); integer minima do not depend on the order. */
#include "geometry/domain.h"

#ifndef MAX_SIZE
#error "build with -DMAX_SIZE=largest h' whose error and density are numbers"
#endif

inline void record_invalid(REAL h, int i, global int *invalid)
{
    if (!(h > 0 && h <= R(MAX_SIZE)))
        atomic_min(invalid, i);
}

/* h_out = factor h'. The check is without the factor. */
kernel void evaluate_size(const int size, global const REAL *restrict points, global const REAL *restrict data,
                          const REAL factor, global REAL *restrict h_out, global int *invalid)
{
    WORK_ITEM(i);
    REAL x[DIM];
    for (int a = 0; a < DIM; ++a)
        x[a] = points[i * DIM + a];
    const REAL h = size_at(x, data);
    record_invalid(h, i, invalid);
    h_out[i] = factor * h;
}

/* grad_a log h = (h(x + s e_a) - h(x - s e_a)) / (2 s h), s = GRADIENT_STEP * h.

   Both sample points are kept inside the domain, because the field need not be defined outside; 2 s is replaced by
   their distance. */
kernel void evaluate_size_gradient(const int size, global const REAL *restrict points, global const REAL *restrict data,
                                   DOMAIN_ARGS, global REAL *restrict h_out, global REAL *restrict gradient,
                                   global int *invalid)
{
    WORK_ITEM(i);
    BOX_CORNERS(lower, upper);
    REAL x[DIM];
    for (int a = 0; a < DIM; ++a)
        x[a] = points[i * DIM + a];
    const REAL h = size_at(x, data);
    record_invalid(h, i, invalid);
    h_out[i] = h;
    const REAL step = fmax(R(GRADIENT_STEP) * h, 8 * REAL_EPS);
    for (int a = 0; a < DIM; ++a) {
        const REAL here = x[a];
        REAL ahead = fmin(here + step, upper[a]), behind = fmax(here - step, lower[a]);
#if defined(POLYGON) || defined(SOLID)
        REAL y[DIM];
        EACH_AXIS (b)
            y[b] = x[b];
        y[a] = ahead;
        if (exit_parameter(x, y, DOMAIN) <= 1)
            ahead = here;
        y[a] = behind;
        if (exit_parameter(x, y, DOMAIN) <= 1)
            behind = here;
#endif
        x[a] = ahead;
        const REAL h_ahead = size_at(x, data);
        x[a] = behind;
        const REAL h_behind = size_at(x, data);
        x[a] = here;
        gradient[i * DIM + a] = ahead > behind ? (h_ahead - h_behind) / ((ahead - behind) * h) : 0;
    }
}
