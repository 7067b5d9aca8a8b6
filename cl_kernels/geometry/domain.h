/* The domain, for kernels that move generators: DOMAIN_ARGS in a signature, DOMAIN in a call. A kernel that needs only
   differences of positions has PERIOD_ARGS at the end of its signature and passes PERIODS on. Periods are arguments, so
   one program serves all periodic boxes. */
#include "geometry/site.h"

#ifdef PERIODIC
#define PERIOD_ARGS , const REAL4 periods
#define PERIODS , periods
#else
#define PERIOD_ARGS
#define PERIODS
#endif

#ifdef POLYGON
#include "geometry/edges.h"
#define keep_inside keep_inside_by_path
#define reflect_inside reflect_inside_polygon
#elif defined(SOLID)
#include "geometry/walls.h"
#define DOMAIN_ARGS const REAL4 box_lower, const REAL4 box_upper, WALL_ARGS
#define DOMAIN box_lower, box_upper, WALL
#define keep_inside keep_inside_by_path
#define reflect_inside stay_off_walls
#define exit_parameter exit_from_solid
#elif defined(SPHERE)
#define DOMAIN_ARGS const REAL4 box_lower, const REAL4 box_upper
#define DOMAIN box_lower, box_upper
#define keep_inside(x, y, ...) onto_sphere(y)
#define reflect_inside(x, y, ...) onto_sphere(y)
#else
#define DOMAIN_ARGS const REAL4 box_lower, const REAL4 box_upper PERIOD_ARGS
#define DOMAIN box_lower, box_upper PERIODS
#define keep_inside keep_inside_box
#define reflect_inside reflect_inside_box
#endif

#ifdef PERIODIC
/* Length of the period along axis a, where positions lie in [0, period); 0 between walls. In the unit box positions and
   periods are multiples of eps, so differences to any image are exact. */
#define PERIOD(a) ((a) == 0 ? periods.s0 : (a) == 1 ? periods.s1 : periods.s2)

inline REAL nearest_image(REAL d, REAL period)
{
    const REAL half_period = period / 2;
    return period > 0 ? (d > half_period ? d - period : (d < -half_period ? d + period : d)) : d;
}

/* The image of y in [0, period), rounded to a multiple of eps. */
inline REAL wrapped(REAL y, REAL period)
{
    y = (y - period * floor(y / period) + 1) - 1;
    return y >= period ? y - period : fmax(y, 0);
}
#else
#define PERIOD(a) 0
#define nearest_image(d, period) (d)
#define wrapped(y, period) (y)
#endif

/* Coordinate y along axis a, or that of its image in the domain if the axis is periodic. */
#define PLACED(a, y) (PERIOD(a) > 0 ? wrapped(y, PERIOD(a)) : (y))

/* The difference between two positions along axis a, to the nearest image if the axis is periodic. */
#define DIFFERENCE(a, from, to) nearest_image((to) - (from), PERIOD(a))

#if CELL_DIM == 2
/* Vectors in the plane of the cell at x: to generator j; row k of an array of vectors; and back, into an array. */
#ifdef SPHERE
#define VECTOR_TO(x, j, points) direction_of(x, j, points)
inline REAL2 vector_in_plane(const REAL *x, REAL d0, REAL d1, REAL d2)
{
    const REAL d[3] = {d0, d1, d2};
    return along_tangents(x, d);
}
#define VECTOR_OF(x, array, k) vector_in_plane(x, (array)[3 * (k)], (array)[3 * (k) + 1], (array)[3 * (k) + 2])
inline void put_vector(const REAL *x, REAL2 v, int k, global REAL *array)
{
    REAL d[3];
    in_space(x, v, d);
    EACH_AXIS (a)
        array[3 * k + a] = d[a];
}
#else
#define VECTOR_TO(x, j, points)                                                                                        \
    ((REAL2)(DIFFERENCE(0, x[0], points[2 * (j)]), DIFFERENCE(1, x[1], points[2 * (j) + 1])))
#define VECTOR_OF(x, array, k) ((REAL2)((array)[2 * (k)], (array)[2 * (k) + 1]))
inline void put_vector(const REAL *x, REAL2 v, int k, global REAL *array)
{
    array[2 * k] = v.s0;
    array[2 * k + 1] = v.s1;
}
#endif
#endif

#ifdef SPHERE
/* The point of the unit sphere above or below y. */
inline void onto_sphere(REAL *y)
{
    const REAL length = sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2]);
    EACH_AXIS (a)
        y[a] /= length;
}
#elif defined(SOLID)
/* Parameter t in [0, 1] at which the path from x to y leaves the domain first; 2 if it stays inside. */
inline REAL exit_from_solid(const REAL *x, const REAL *y, DOMAIN_ARGS)
{
    const REAL4 from = (REAL4)(x[0], x[1], x[2], 0), way = (REAL4)(y[0] - x[0], y[1] - x[1], y[2] - x[2], 0);
    return exit_through_wall(from, way, WALL);
}
#elif !defined(POLYGON)
/* Move the target y of a generator at x into the domain: to the nearest wall, or to its image along a period. */
inline void keep_inside_box(const REAL *x, REAL *y, DOMAIN_ARGS)
{
    BOX_CORNERS(lower, upper);
    EACH_AXIS (a)
        y[a] = PERIOD(a) > 0 ? wrapped(y[a], PERIOD(a)) : clamp(y[a], lower[a], upper[a]);
}

/* As keep_inside_box, but mirrors y at the wall, so that no two generators coincide on it. A step is at most as long as
   the box first, so that the mirror image is inside. */
inline void reflect_inside_box(const REAL *x, REAL *y, DOMAIN_ARGS)
{
    BOX_CORNERS(lower, upper);
    EACH_AXIS (a) {
        if (PERIOD(a) > 0)
            continue;
        const REAL most = upper[a] - lower[a];
        y[a] = clamp(y[a], x[a] - most, x[a] + most);
        if (y[a] < lower[a])
            y[a] = 2 * lower[a] - y[a];
        if (y[a] > upper[a])
            y[a] = 2 * upper[a] - y[a];
    }
    keep_inside_box(x, y, DOMAIN);
}
#endif

#if defined(POLYGON) || defined(SOLID)
/* Moves the target y of a generator at x into the domain: if the path leaves it, half-way to the boundary. */
inline void keep_inside_by_path(const REAL *x, REAL *y, DOMAIN_ARGS)
{
    const REAL t = exit_parameter(x, y, DOMAIN);
    if (t <= 1)
        EACH_AXIS (a)
            y[a] = x[a] + t / 2 * (y[a] - x[a]);
}
#endif

#ifdef SOLID
/* As keep_inside_by_path, but a generator much nearer to the wall than the way is long stays: in each step in which it
   is pushed out, it would halve its distance, down to round-off. */
inline void stay_off_walls(const REAL *x, REAL *y, DOMAIN_ARGS)
{
    const REAL t = exit_parameter(x, y, DOMAIN);
    if (t <= 1)
        EACH_AXIS (a)
            y[a] = t < R(0.0625) ? x[a] : x[a] + t / 2 * (y[a] - x[a]);
}
#endif

#ifdef POLYGON
/* As keep_inside_by_path, but mirrors y at the edge, unless the path to the mirror image leaves the domain. */
inline void reflect_inside_polygon(const REAL *x, REAL *y, DOMAIN_ARGS)
{
    int edge;
    if (exit_over_edge(x, y, &edge, DOMAIN) > 1)
        return;
    const REAL2 a = edge_ends[edge].s01, e = edge_ends[edge].s23 - a;
    const REAL beyond = ((y[0] - a.s0) * e.s1 - (y[1] - a.s1) * e.s0) / dot(e, e);
    REAL back[2] = {y[0] - 2 * beyond * e.s1, y[1] + 2 * beyond * e.s0};
    if (exit_parameter(x, back, DOMAIN) > 1) {
        y[0] = back[0];
        y[1] = back[1];
    } else {
        keep_inside_by_path(x, y, DOMAIN);
    }
}
#endif
