/* Entries of rows, AT_ONCE at a time: eight in the lanes of vectors on a CPU, one on a GPU. Rows are short and have
   different lengths, so that a loop over single entries spends most of its time on mispredicted branches. In 2D almost
   all rows have at most eight entries.

       for (int k = starts[i]; k < end; k += AT_ONCE) {
           const MANY(int) inside = INSIDE(k, end), j = TAKE(int, columns, k, size);
           sum += SUM(REAL, select(..., x, inside));
       }

   Lanes beyond the row's end hold entries of the next rows, or the last of all `size`: mask them.
   Include after domain.h and blocks.h. */
#if GROUP_SIZE == 1
#define AT_ONCE 8
#define MANY(TYPE) CLVORO_JOIN(TYPE, 8)
/* Mask of the entries before the end. */
#define INSIDE(k, end) ((k) + (int8)(0, 1, 2, 3, 4, 5, 6, 7) < (end))
/* Whether a mask holds for one entry or more. */
#define ANY(mask) any(mask)
#define PICK(TYPE, array, j, stride, a)                                                                                \
    ((MANY(TYPE))((array)[(j).s0 * (stride) + (a)], (array)[(j).s1 * (stride) + (a)],                                  \
                  (array)[(j).s2 * (stride) + (a)], (array)[(j).s3 * (stride) + (a)],                                  \
                  (array)[(j).s4 * (stride) + (a)], (array)[(j).s5 * (stride) + (a)],                                  \
                  (array)[(j).s6 * (stride) + (a)], (array)[(j).s7 * (stride) + (a)]))

#define AT_ONCE_FOR(TYPE)                                                                                              \
    inline MANY(TYPE) CLVORO_JOIN(take_, TYPE)(global const TYPE *array, int k, int size)                              \
    {                                                                                                                  \
        if (k + 8 <= size)                                                                                             \
            return vload8(0, array + k);                                                                               \
        const int8 at = min(k + (int8)(0, 1, 2, 3, 4, 5, 6, 7), (int8)(size - 1));                                     \
        return PICK(TYPE, array, at, 1, 0);                                                                            \
    }                                                                                                                  \
    inline MANY(TYPE) CLVORO_JOIN(take_rows_, TYPE)(global const TYPE *array, int a, int k, int size)                  \
    {                                                                                                                  \
        if (k + 8 <= size) {                                                                                           \
            global const TYPE *row = array + DIM * k + a;                                                              \
            return (MANY(TYPE))(row[0], row[DIM], row[2 * DIM], row[3 * DIM], row[4 * DIM], row[5 * DIM],              \
                                row[6 * DIM], row[7 * DIM]);                                                           \
        }                                                                                                              \
        const int8 at = min(k + (int8)(0, 1, 2, 3, 4, 5, 6, 7), (int8)(size - 1));                                     \
        return PICK(TYPE, array, at, DIM, a);                                                                          \
    }                                                                                                                  \
    inline TYPE CLVORO_JOIN(sum_, TYPE)(MANY(TYPE) x)                                                                  \
    {                                                                                                                  \
        const CLVORO_JOIN(TYPE, 4) x4 = x.lo + x.hi;                                                                   \
        const CLVORO_JOIN(TYPE, 2) x2 = x4.lo + x4.hi;                                                                 \
        return x2.s0 + x2.s1;                                                                                          \
    }
AT_ONCE_FOR(int)
AT_ONCE_FOR(float)
#if IS_DOUBLE
AT_ONCE_FOR(double)
#endif

#define mask_int(lanes) (lanes)
#define mask_float(lanes) (lanes)
#define mask_double(lanes) convert_long8(lanes)
/* `x` where `chosen`, else `other`. */
#define CHOOSE(TYPE, chosen, x, other) select((MANY(TYPE))(other), x, CLVORO_JOIN(mask_, TYPE)(chosen))

inline float least_float(float8 x)
{
    const float4 x4 = fmin(x.lo, x.hi);
    const float2 x2 = fmin(x4.lo, x4.hi);
    return fmin(x2.s0, x2.s1);
}

/* Write entries k to the row's `end`. If rows are written in their order, the entries up to `until`, where the rows of
   another work-item begin, may be overwritten. */
inline void put_float(float8 x, global float *array, int k, int end, int until)
{
    if (k + 8 <= until) {
        vstore8(x, 0, array + k);
        return;
    }
    const float *lanes = (const float *)&x;
    for (int lane = 0; lane < 8 && k + lane < end; ++lane)
        array[k + lane] = lanes[lane];
}

/* As `nearest_image`. */
#ifdef PERIODIC
inline MANY(REAL) nearest_images(MANY(REAL) d, REAL period)
{
    const REAL half_period = period / 2;
    return period > 0 ? select(select(d, d + period, d < -half_period), d - period, d > half_period) : d;
}
#else
#define nearest_images(d, period) (d)
#endif
#else
#define AT_ONCE 1
#define MANY(TYPE) TYPE
#define INSIDE(k, end) ((k) < (end))
#define ANY(mask) (mask)
#define PICK(TYPE, array, j, stride, a) ((array)[(j) * (stride) + (a)])
#define take_int(array, k, size) ((array)[k])
#define take_float(array, k, size) ((array)[k])
#define take_double(array, k, size) ((array)[k])
#define take_rows_float(array, a, k, size) ((array)[(k)*DIM + (a)])
#define take_rows_double(array, a, k, size) ((array)[(k)*DIM + (a)])
#define sum_float(x) (x)
#define sum_double(x) (x)
#define CHOOSE(TYPE, chosen, x, other) ((chosen) ? (x) : (TYPE)(other))
#define least_float(x) (x)
#define put_float(x, array, k, end, until) ((array)[k] = (x))
#define nearest_images(d, period) nearest_image(d, period)
#endif

#define TAKE(TYPE, array, k, size) CLVORO_JOIN(take_, TYPE)(array, k, size)
/* Coordinate `a` of rows of DIM. */
#define TAKE_ROWS(TYPE, array, a, k, size) CLVORO_JOIN(take_rows_, TYPE)(array, a, k, size)
#define SUM(TYPE, x) CLVORO_JOIN(sum_, TYPE)(x)
#define CONVERT(TYPE, x) CLVORO_JOIN(convert_, MANY(TYPE))(x)

/* The first entry of row j with column i, or -1. `last`: no entry behind it may be read eight at a time. */
inline int find_entry(int i, int j, int last, global const int *starts, global const int *neighbors)
{
    const int end = starts[j + 1];
    int k = starts[j];
#if GROUP_SIZE == 1
    for (; k < end && k <= last; k += 8) {
        const int8 at = k + (int8)(0, 1, 2, 3, 4, 5, 6, 7), matches = (vload8(0, neighbors + k) == i) & (at < end);
        const int8 entries = select((int8)(INT_MAX), at, matches);
        const int4 p4 = min(entries.lo, entries.hi);
        const int2 p2 = min(p4.lo, p4.hi);
        const int entry = min(p2.s0, p2.s1);
        if (entry < end)
            return entry;
    }
#endif
    for (; k < end; ++k)
        if (neighbors[k] == i)
            return k;
    return -1;
}
