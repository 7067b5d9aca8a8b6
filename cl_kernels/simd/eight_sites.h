/* The sites of eight cells, and positions around them, one cell per vector lane. */
#include "tessellation/corner.h"
#include "simd/lanes.h"

#ifdef FOLD_0
/* Replace rows of points, up to number `most`, by their images nearest to the points (x, y), so that all differences
   are those of `corner`. */
inline void fold_eight_rows(double2 *behind, int most, double8 x, double8 y)
{
    const double8 even = (double8)(x.s0, y.s0, x.s2, y.s2, x.s4, y.s4, x.s6, y.s6);
    const double8 odd = (double8)(x.s1, y.s1, x.s3, y.s3, x.s5, y.s5, x.s7, y.s7);
    const double8 periods =
        (double8)((double4)(FOLD(0), FOLD(1), FOLD(0), FOLD(1)), (double4)(FOLD(0), FOLD(1), FOLD(0), FOLD(1)));
    const double8 half_way = periods > 0 ? periods / 2 : INFINITY;
    for (int k = 0; k <= most; ++k)
        for (int side = 0; side < 2; ++side) {
            const double8 at = vload8(2 * k + side, (const double *)behind), d = at - (side ? odd : even);
            const double8 nearer = d > half_way ? at - periods : at;
            vstore8(d < -half_way ? at + periods : nearer, 2 * k + side, (double *)behind);
        }
}
#else
#define fold_eight_rows(behind, most, x, y)
#endif

/* The sites of eight cells, and the positions of the neighbors along their rows, one row per lane. On a sphere the
   latter are projected onto the tangent planes, whose origins are the sites. */
typedef struct {
    double8 x, y;
#ifdef SPHERE
    double8 z;
#endif
} eight_t;

#ifdef SPHERE
/* Along the z axis in rows of their own, until they are projected. */
#define ROWS_BEHIND(rows, capacity)                                                                                    \
    double2 rows[(capacity)*LANES];                                                                                    \
    double rows##_z[(capacity)*LANES]
#define put_behind(rows, k, lane, j, points)                                                                           \
    do {                                                                                                               \
        rows[ROW_PLACE(k, lane)] = vload2(0, points + 3 * (j));                                                        \
        rows##_z[(k)*LANES + (lane)] = points[3 * (j) + 2];                                                            \
    } while (0)
#define project_rows(rows, most, sites) project_eight_rows(rows, rows##_z, most, sites)

/* The tangents of `place_site`, with the same bits. */
inline void find_tangents(const eight_t *sites, double8 *e, double8 *f)
{
    const double8 x = sites->x, y = sites->y, z = sites->z;
    const double8 sign = z < 0 ? (double8)(-1) : (double8)(1), s = -1 / (sign + z), t = x * y * s;
    e[0] = 1 + sign * x * x * s;
    e[1] = sign * t;
    e[2] = -sign * x;
    f[0] = t;
    f[1] = sign + y * y * s;
    f[2] = -y;
}

/* Eight times `direction_of`, with the same bits. */
inline void project_eight_rows(double2 *behind, const double *behind_z, int most, const eight_t *sites)
{
    double8 e[3], f[3];
    find_tangents(sites, e, f);
    for (int k = 0; k <= most; ++k) {
        double8 x, y;
        load_row(behind, k, &x, &y);
        x -= sites->x;
        y -= sites->y;
        const double8 z = vload8(k, behind_z) - sites->z;
        const double8 d2 = x * x + y * y + z * z, inverse = 1 / (1 - d2 / 4);
        const long8 near = d2 < OPPOSITE;
        store_row(behind, k, near ? (e[0] * x + e[1] * y + e[2] * z) * inverse : 1 / DBL_EPSILON,
                  near ? (f[0] * x + f[1] * y + f[2] * z) * inverse : 0);
    }
}
#else
#define ROWS_BEHIND(rows, capacity) double2 rows[(capacity)*LANES]
#define put_behind(rows, k, lane, j, points) rows[ROW_PLACE(k, lane)] = vload2(j, points)
#define project_rows(rows, most, sites) fold_eight_rows(rows, most, (sites)->x, (sites)->y)
#endif

/* Load the positions of LANES generators. */
inline eight_t load_listed_sites(const int *listed, global const double *points)
{
    double at[3][LANES];
    for (int lane = 0; lane < LANES; ++lane)
        for (int a = 0; a < DIM; ++a)
            at[a][lane] = points[DIM * listed[lane] + a];
    eight_t sites;
    sites.x = vload8(0, at[0]);
    sites.y = vload8(0, at[1]);
#ifdef SPHERE
    sites.z = vload8(0, at[2]);
#endif
    return sites;
}

/* Those from number `first` on, of `size`. */
inline eight_t load_sites(int first, int size, global const double *points)
{
    int listed[LANES];
    for (int lane = 0; lane < LANES; ++lane)
        listed[lane] = min(first + lane, size - 1);
    return load_listed_sites(listed, points);
}

/* The origin of the coordinates in which rows are. */
inline double8 origin_x(const eight_t *sites)
{
#ifdef SPHERE
    return 0;
#else
    return sites->x;
#endif
}

inline double8 origin_y(const eight_t *sites)
{
#ifdef SPHERE
    return 0;
#else
    return sites->y;
#endif
}

/* Squared distances of generator q from the sites. */
inline double8 squared_distances(const eight_t *sites, long q, global const double *points)
{
    const double8 dx = points[DIM * q] - sites->x, dy = points[DIM * q + 1] - sites->y;
#ifdef SPHERE
    const double8 dz = points[3 * q + 2] - sites->z;
    return fma(dx, dx, fma(dy, dy, dz * dz));
#else
    return fma(dx, dx, dy * dy);
#endif
}

/* Let row k be the sites themselves. */
#ifdef SPHERE
#define put_self(rows, k, sites)                                                                                       \
    store_row(rows, k, (sites)->x, (sites)->y);                                                                        \
    vstore8((sites)->z, k, rows##_z)
#else
#define put_self(rows, k, sites) store_row(rows, k, (sites)->x, (sites)->y)
#endif
