#include "geometry/site.h"

/* Per generator i: its row with its weight (see weights.h). most[0] becomes the key of the largest weight. On the
   sphere 1 + w / 2 is the factor exp(w / 2) of the given weight: differences of given weights, times 2, are logarithms
   of the ratios of factors, and only these count. */
kernel void attach_weights(const int size, global const REAL *points, global const REAL *weights, global REAL *weighted,
                           global int *most)
{
    WORK_ITEM(i);
    for (int a = 0; a < DIM; ++a)
        weighted[(DIM + 1) * i + a] = points[DIM * i + a];
#ifdef SPHERE
    const REAL weight = 2 * expm1(weights[i] / 2);
#else
    const REAL weight = weights[i];
#endif
    weighted[(DIM + 1) * i + DIM] = weight;
    atomic_max(most, key_of_weight(weight));
}

#ifdef SPHERE
/* Per cell i of a power diagram on the sphere: for each of its faces |x_i - x_j| times the rate at which it sweeps area
   as half the given weight of j grows, in place of its length l. With the ratio q of the factors of j and i the face
   lies in the plane normal to x_i - q x_j, so that it sweeps x_i.y / |x_i - q x_j| per length: integrated, 2 sin(l / 2)
   at its middle. */
kernel void weigh_arcs(const int size, global const int *starts, global const int *neighbors, global const REAL *points,
                       global const FACE *arcs, global const FACE *middles, global FACE *weighed)
{
    WORK_ITEM(i);
    SITE(x, i, points);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const REAL more = (WEIGHT(points, neighbors[k]) - SITE_WEIGHT(x)) / (2 + SITE_WEIGHT(x));
        REAL d2 = 0, height = 1;
        EACH_AXIS (a) {
            const REAL d = points[STRIDE * neighbors[k] + a] - x[a];
            d2 += d * d;
            height += x[a] * middles[3 * k + a];
        }
        weighed[k] = 2 * sin((REAL)arcs[k] / 2) * height * sqrt(d2 / (more * more + (1 + more) * d2));
    }
}
#endif
