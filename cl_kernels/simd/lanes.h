/* Eight cells at a time, one per vector lane: for CPUs, whose compilers do not vectorize work-items that branch. */
#include "opencl/real.h"

#if !IS_DOUBLE
#error "lanes are of doubles"
#endif
#define LANES 8
/* One lane of vector k of an array. */
#define LANE(vectors, k, lane) ((vectors)[(k)*LANES + (lane)])

inline bool any_lane(long8 lanes)
{
    const long4 four = lanes.lo | lanes.hi;
    const long2 two = four.lo | four.hi;
    return (two.lo | two.hi) < 0;
}

inline long max_lane(long8 values)
{
    const long4 four = max(values.lo, values.hi);
    const long2 two = max(four.lo, four.hi);
    return max(two.lo, two.hi);
}

inline double min_lane(double8 values)
{
    const double4 four = min(values.lo, values.hi);
    const double2 two = min(four.lo, four.hi);
    return min(two.lo, two.hi);
}

inline double sum_lanes(double8 values)
{
    const double4 four = values.lo + values.hi;
    const double2 two = four.lo + four.hi;
    return two.lo + two.hi;
}

/* Gather: lane `lane` of vector k[lane] of an array. */
inline double8 pick(const double8 *vectors, long8 k)
{
    const double *values = (const double *)vectors;
    return (double8)(LANE(values, k.s0, 0), LANE(values, k.s1, 1), LANE(values, k.s2, 2), LANE(values, k.s3, 3),
                     LANE(values, k.s4, 4), LANE(values, k.s5, 5), LANE(values, k.s6, 6), LANE(values, k.s7, 7));
}

/* Rows of points, one per lane, even lanes before odd ones: two vectors hold them, and each coordinate takes one more
   instruction. */
#define ROW_PLACE(k, lane) ((k)*LANES + (lane) / 2 + (lane) % 2 * (LANES / 2))

inline void load_row(const double2 *points, int k, double8 *x, double8 *y)
{
    const double8 even = vload8(2 * k, (const double *)points), odd = vload8(2 * k + 1, (const double *)points);
    *x = (double8)(even.s0, odd.s0, even.s2, odd.s2, even.s4, odd.s4, even.s6, odd.s6);
    *y = (double8)(even.s1, odd.s1, even.s3, odd.s3, even.s5, odd.s5, even.s7, odd.s7);
}

inline void store_row(double2 *points, int k, double8 x, double8 y)
{
    vstore8((double8)(x.s0, y.s0, x.s2, y.s2, x.s4, y.s4, x.s6, y.s6), 2 * k, (double *)points);
    vstore8((double8)(x.s1, y.s1, x.s3, y.s3, x.s5, y.s5, x.s7, y.s7), 2 * k + 1, (double *)points);
}
