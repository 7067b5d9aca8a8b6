#include "opencl/real.h"

/* Twice the area of a cell, and its unscaled first and second moments: sums over triangles of the origin and one edge.
   A triangle 0, v, w has the centroid (v + w) / 3 and the second moments area (v v + w w + (v + w) (v + w)) / 12. */
typedef struct {
    REAL area, cx, cy, xx, xy, yy;
} moments_t;

inline void add_triangle(moments_t *m, REAL2 v, REAL2 w)
{
    const REAL2 sum = v + w;
    const REAL cross = difference_of_products(v.s0, w.s1, v.s1, w.s0);
    m->area += cross;
    m->cx += cross * sum.s0;
    m->cy += cross * sum.s1;
    m->xx += cross * (v.s0 * v.s0 + w.s0 * w.s0 + sum.s0 * sum.s0);
    m->xy += cross * (v.s0 * v.s1 + w.s0 * w.s1 + sum.s0 * sum.s1);
    m->yy += cross * (v.s1 * v.s1 + w.s1 * w.s1 + sum.s1 * sum.s1);
}

/* Area, centroid - generator, and second moments about the centroid per unit area (xx, xy, yy) of cell i. */
inline void write_moments(const moments_t *m, int i, global REAL *volumes, global REAL *offsets,
                          global REAL *covariances)
{
    REAL cx = m->cx, cy = m->cy, xx = m->xx, xy = m->xy, yy = m->yy;
    const REAL area = m->area;
    if (area > 0) {
        cx /= 3 * area;
        cy /= 3 * area;
        xx = xx / (12 * area) - cx * cx;
        xy = xy / (12 * area) - cx * cy;
        yy = yy / (12 * area) - cy * cy;
    }
    volumes[i] = area / 2;
    offsets[2 * i] = cx;
    offsets[2 * i + 1] = cy;
    covariances[3 * i] = xx;
    covariances[3 * i + 1] = xy;
    covariances[3 * i + 2] = yy;
}

/* Second moments about the centroid per unit area: xx, xy, yy. */
inline REAL3 second_moments(const moments_t *m)
{
    if (!(m->area > 0))
        return 0;
    const REAL cx = m->cx / (3 * m->area), cy = m->cy / (3 * m->area), scale = 1 / (12 * m->area);
    return (REAL3)(m->xx * scale - cx * cx, m->xy * scale - cx * cy, m->yy * scale - cy * cy);
}
