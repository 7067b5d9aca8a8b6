#include "opencl/real.h"

#if CELL_DIM == 2
/* 4 n tan(pi / n): perimeter^2 / area of a regular polygon. Tabulated for the numbers of sides that
   nearly all cells have. */
constant REAL ROUNDNESS[12] = {0,
                               0,
                               0,
                               R(20.784609690826521),
                               R(15.999999999999998),
                               R(14.530850560107218),
                               R(13.856406460551018),
                               R(13.484089326610802),
                               R(13.254833995939041),
                               R(13.102928433583283),
                               R(12.996787849316252),
                               R(12.919565689288136)};

inline REAL regular_roundness(int n)
{
    return n < 12 ? ROUNDNESS[n] : 4 * n * tan(R(3.14159265358979324) / n);
}

/* Q = 4 A n tan(pi / n) / P^2 of a polygon of n sides (the paper's 4.1). */
inline REAL polygon_quality(int n, REAL area, REAL perimeter)
{
    return regular_roundness(max(n, 3)) * area / (perimeter * perimeter);
}
#endif
