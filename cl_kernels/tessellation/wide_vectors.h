/* Vectors in 3D in the lanes of wide registers. */
#include "opencl/real.h"

/* Eight vertices or faces at a time in the lanes of a vector on CPUs; one on other devices, which have few registers.
 */
#if GROUP_SIZE == 1
#define WIDTH 8
#define WIDE CLVORO_JOIN(REAL, 8)
#define LOAD_WIDE(k, values) vload8(k, values)
#define STORE_WIDE(v, k, values) vstore8(v, k, values)
#define GATHER_WIDE(values, k)                                                                                         \
    (WIDE)((values)[(k)[0]], (values)[(k)[1]], (values)[(k)[2]], (values)[(k)[3]], (values)[(k)[4]], (values)[(k)[5]], \
           (values)[(k)[6]], (values)[(k)[7]])
#define LANE_NUMBERS (WIDE)(0, 1, 2, 3, 4, 5, 6, 7)
#else
#define WIDTH 1
#define WIDE REAL
#define LOAD_WIDE(k, values) (values)[k]
#define STORE_WIDE(v, k, values) (values)[k] = (v)
#define GATHER_WIDE(values, k) (values)[(k)[0]]
#define LANE_NUMBERS (WIDE)(0)
#endif

inline REAL largest_lane(WIDE v)
{
#if WIDTH == 1
    return v;
#else
    const REAL4 a = v.lo > v.hi ? v.lo : v.hi;
    const REAL2 b = a.lo > a.hi ? a.lo : a.hi;
    return b.s0 > b.s1 ? b.s0 : b.s1;
#endif
}

inline REAL sum_of_lanes(WIDE v)
{
#if WIDTH == 1
    return v;
#else
    const REAL4 a = v.lo + v.hi;
    return (a.s0 + a.s2) + (a.s1 + a.s3);
#endif
}

typedef struct {
    WIDE x, y, z;
} places_t;

/* Results are written through pointers: a structure returned by value would be an alias for some compilers. */
inline WIDE product_of(const places_t *a, const places_t *b)
{
    return fma(a->x, b->x, fma(a->y, b->y, a->z * b->z));
}

inline void cross_of(places_t *c, const places_t *a, const places_t *b)
{
    c->x = fma(a->y, b->z, -a->z * b->y);
    c->y = fma(a->z, b->x, -a->x * b->z);
    c->z = fma(a->x, b->y, -a->y * b->x);
}

/* c += s a */
inline void add_along(places_t *c, WIDE s, const places_t *a)
{
    c->x = fma(s, a->x, c->x);
    c->y = fma(s, a->y, c->y);
    c->z = fma(s, a->z, c->z);
}
