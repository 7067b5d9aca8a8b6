/* Vectors in 3D in the lanes of wide registers. */
#include "opencl/real.h"

/* Vertices or faces in the lanes of a vector on CPUs: as many as a register of the processor holds; one on other
   devices, which have few registers. Sums have the same bits with four and eight lanes: see `sum_of_lanes`. */
#if !defined(EIGHT_DOUBLES) && defined(__AVX512F__)
#define EIGHT_DOUBLES 1
#elif !defined(EIGHT_DOUBLES)
#define EIGHT_DOUBLES 0
#endif
#if GROUP_SIZE == 1 && IS_DOUBLE && !EIGHT_DOUBLES
#define WIDTH 4
#define WIDE CLVORO_JOIN(REAL, 4)
#define LOAD_WIDE(k, values) vload4(k, values)
#define STORE_WIDE(v, k, values) vstore4(v, k, values)
#define GATHER_WIDE(values, k) (WIDE)((values)[(k)[0]], (values)[(k)[1]], (values)[(k)[2]], (values)[(k)[3]])
#define LANE_NUMBERS (WIDE)(0, 1, 2, 3)
#define HALVES 2
#elif GROUP_SIZE == 1
#define WIDTH 8
#define WIDE CLVORO_JOIN(REAL, 8)
#define LOAD_WIDE(k, values) vload8(k, values)
#define STORE_WIDE(v, k, values) vstore8(v, k, values)
#define GATHER_WIDE(values, k)                                                                                         \
    (WIDE)((values)[(k)[0]], (values)[(k)[1]], (values)[(k)[2]], (values)[(k)[3]], (values)[(k)[4]], (values)[(k)[5]], \
           (values)[(k)[6]], (values)[(k)[7]])
#define LANE_NUMBERS (WIDE)(0, 1, 2, 3, 4, 5, 6, 7)
#define HALVES 1
#else
#define WIDTH 1
#define WIDE REAL
#define LOAD_WIDE(k, values) (values)[k]
#define STORE_WIDE(v, k, values) (values)[k] = (v)
#define GATHER_WIDE(values, k) (values)[(k)[0]]
#define LANE_NUMBERS (WIDE)(0)
#define HALVES 1
#endif
/* Rows and sums of lanes lie in private memory; or, with -DCELL_BYTES=bytes of one cell, in global memory. */
#ifdef CELL_BYTES
#define LANE_SPACE global
#else
#define LANE_SPACE private
#endif
/* The entry of a sum to which a block of lanes belongs. */
#define HALF_OF(block) ((block) % HALVES)

inline REAL largest_lane(WIDE v)
{
#if WIDTH == 1
    return v;
#else
#if WIDTH == 8
    const REAL4 a = v.lo > v.hi ? v.lo : v.hi;
#else
    const REAL4 a = v;
#endif
    const REAL2 b = a.lo > a.hi ? a.lo : a.hi;
    return b.s0 > b.s1 ? b.s0 : b.s1;
#endif
}

/* The sum over the lanes of HALVES vectors; blocks of lanes were added to them by turns. */
inline REAL sum_of_lanes(LANE_SPACE const WIDE *sums)
{
#if WIDTH == 1
    return sums[0];
#else
#if WIDTH == 8
    const REAL4 a = sums[0].lo + sums[0].hi;
#else
    const REAL4 a = sums[0] + sums[1];
#endif
    return (a.s0 + a.s2) + (a.s1 + a.s3);
#endif
}

#if WIDTH > 1
/* Let row k be number k of a, b, c and d. */
inline void transpose_four(REAL4 *rows, REAL4 a, REAL4 b, REAL4 c, REAL4 d)
{
    const REAL4 ab_even = (REAL4)(a.s0, b.s0, a.s2, b.s2), ab_odd = (REAL4)(a.s1, b.s1, a.s3, b.s3);
    const REAL4 cd_even = (REAL4)(c.s0, d.s0, c.s2, d.s2), cd_odd = (REAL4)(c.s1, d.s1, c.s3, d.s3);
    rows[0] = (REAL4)(ab_even.lo, cd_even.lo);
    rows[1] = (REAL4)(ab_odd.lo, cd_odd.lo);
    rows[2] = (REAL4)(ab_even.hi, cd_even.hi);
    rows[3] = (REAL4)(ab_odd.hi, cd_odd.hi);
}
#endif

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

/* Gather rows k[lane] of four numbers: the first three, and the last. */
inline void gather_lanes(places_t *first, WIDE *last, LANE_SPACE const REAL4 *rows, const int *k)
{
#if WIDTH == 1
    const REAL4 row = rows[k[0]];
    first->x = row.s0;
    first->y = row.s1;
    first->z = row.s2;
    *last = row.s3;
#else
    REAL4 low[4];
    transpose_four(low, rows[k[0]], rows[k[1]], rows[k[2]], rows[k[3]]);
#if WIDTH == 4
    first->x = low[0];
    first->y = low[1];
    first->z = low[2];
    *last = low[3];
#else
    REAL4 high[4];
    transpose_four(high, rows[k[4]], rows[k[5]], rows[k[6]], rows[k[7]]);
    first->x = (WIDE)(low[0], high[0]);
    first->y = (WIDE)(low[1], high[1]);
    first->z = (WIDE)(low[2], high[2]);
    *last = (WIDE)(low[3], high[3]);
#endif
#endif
}

/* The rows of four numbers of each lane. */
inline void rows_of_lanes(REAL4 *rows, WIDE a, const places_t *b)
{
#if WIDTH == 1
    rows[0] = (REAL4)(a, b->x, b->y, b->z);
#elif WIDTH == 4
    transpose_four(rows, a, b->x, b->y, b->z);
#else
    transpose_four(rows, a.lo, b->x.lo, b->y.lo, b->z.lo);
    transpose_four(rows + 4, a.hi, b->x.hi, b->y.hi, b->z.hi);
#endif
}
