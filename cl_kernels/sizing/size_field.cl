/* The size field at points: h' = h / scale and, on request, grad log h, in normalized coordinates.
   `size_at` and its data come from the host (see sizing/size_fields.h). Work-item i serves point i;
   points are (size, DIM). `bad` keeps the smallest index with an h that is not positive, or above MOST_SIZE (NaN, too):
   a minimum of integers, so the order of the atomics does not matter. */
#include "geometry/domain.h"

#ifndef MOST_SIZE
#error "build with -DMOST_SIZE=largest h' whose error and density are numbers"
#endif

inline void note_bad(REAL h, int i, global int *bad)
{
    if (!(h > 0 && h <= R(MOST_SIZE)))
        atomic_min(bad, i);
}

/* h is noted as it is, and written times a factor. */
kernel void evaluate(const int size, global const REAL *restrict points, global const REAL *restrict data,
                     const REAL factor, global REAL *restrict h_out, global int *bad)
{
    WORK_ITEM(i);
    REAL x[DIM];
    for (int a = 0; a < DIM; ++a)
        x[a] = points[i * DIM + a];
    const REAL h = size_at(x, data);
    note_bad(h, i, bad);
    h_out[i] = factor * h;
}

/* grad_a log h = (h(x + s e_a) - h(x - s e_a)) / (2 s h), s = GRADIENT_STEP * h. Both sample points are kept inside
   the domain, where alone the field must be defined; 2 s is then the distance that was really stepped. */
kernel void evaluate_with_gradient(const int size, global const REAL *restrict points, global const REAL *restrict data,
                                   DOMAIN_ARGS, global REAL *restrict h_out, global REAL *restrict gradient,
                                   global int *bad)
{
    WORK_ITEM(i);
    BOX_CORNERS(lower, upper);
    REAL x[DIM];
    for (int a = 0; a < DIM; ++a)
        x[a] = points[i * DIM + a];
    const REAL h = size_at(x, data);
    note_bad(h, i, bad);
    h_out[i] = h;
    const REAL step = fmax(R(GRADIENT_STEP) * h, 8 * REAL_EPS);
    for (int a = 0; a < DIM; ++a) {
        const REAL here = x[a];
        REAL ahead = fmin(here + step, upper[a]), behind = fmax(here - step, lower[a]);
#ifdef POLYGON
        REAL y[DIM] = {x[0], x[1]};
        y[a] = ahead;
        if (leaves_at(x, y, DOMAIN) <= 1)
            ahead = here;
        y[a] = behind;
        if (leaves_at(x, y, DOMAIN) <= 1)
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
