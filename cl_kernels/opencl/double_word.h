/* Numbers as the unevaluated sum of two REALs, the larger one first: twice the digits (Dekker; Joldes, Muller and
   Popescu 2017 on the errors). Sums and products err by a few REAL_EPS^2 of the result. */
#include "opencl/real.h"

typedef REAL2 wide_t;

inline wide_t wide_sum(REAL a, REAL b)
{
    const REAL s = a + b, t = s - a;
    return (wide_t)(s, (a - (s - t)) + (b - t));
}

/* The same for |a| >= |b|. */
inline wide_t wide_sum_ordered(REAL a, REAL b)
{
    const REAL s = a + b;
    return (wide_t)(s, b - (s - a));
}

inline wide_t wide_add(wide_t a, wide_t b)
{
    const wide_t s = wide_sum(a.s0, b.s0), t = wide_sum(a.s1, b.s1);
    const wide_t v = wide_sum_ordered(s.s0, s.s1 + t.s0);
    return wide_sum_ordered(v.s0, t.s1 + v.s1);
}

inline wide_t wide_product(wide_t a, wide_t b)
{
    const REAL p = a.s0 * b.s0;
    const REAL rest = fma(a.s0, b.s0, -p) + fma(a.s1, b.s0, a.s0 * b.s1);
    return wide_sum_ordered(p, rest);
}
