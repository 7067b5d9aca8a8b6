/* Per vector lane a list of half-spaces: the points nearer to the generator x of the lane than to another at x + d,
   y.p <= 1/2 with p = d / |d|^2. A wall is the bisector with the mirror image. */
#include "simd/bin_runs.h"
#include "simd/lanes.h"

typedef struct {
    double8 x, y, z, d2;
} planes_t;

/* Gather: in each lane a component (0: x, 1: y, 2: z, 3: d2) of plane `at` of the lane. */
#define PLANE_LANE(planes, k, component, lane) (((double *)(planes))[((k)*4 + (component)) * LANES + (lane)])
#define PLANE_LANES(planes, at, component)                                                                             \
    (double8)(PLANE_LANE(planes, (at)[0], component, 0), PLANE_LANE(planes, (at)[1], component, 1),                    \
              PLANE_LANE(planes, (at)[2], component, 2), PLANE_LANE(planes, (at)[3], component, 3),                    \
              PLANE_LANE(planes, (at)[4], component, 4), PLANE_LANE(planes, (at)[5], component, 5),                    \
              PLANE_LANE(planes, (at)[6], component, 6), PLANE_LANE(planes, (at)[7], component, 7))

/* Lists are divided into shells by distance: the outer radii, as shares of the whole radius. */
#define SHELLS 2
constant const double SHELL_ENDS[SHELLS] = {0.86, 1};
#define SHELL_CAPACITY 64
#define LIST_CAPACITY (SHELLS * SHELL_CAPACITY + 8)
/* Lists with more than MANY or fewer than FEW generators get another radius, to hold about ENOUGH. */
#define MANY 92
#define ENOUGH 66
#define FEW 24
/* Generators that may be near those of the lanes. */
#define NEAR_CAPACITY 1024
#define NEAR_WORDS (NEAR_CAPACITY / 64)

/* Shells have the same length in all lanes; padding entries have p = 0, which cuts nothing. */
typedef struct {
    planes_t planes[LIST_CAPACITY];
    int places[LIST_CAPACITY * LANES]; /* item of the other generator, or -1 - wall */
    int ends[SHELLS];
    double8 radii2[SHELLS]; /* everything nearer is in this shell or an earlier one */
    double8 nearest2;       /* least d2 */
    long8 nearest;          /* its entry */
} list_t;

inline void put_plane(list_t *list, int k, int lane, double x, double y, double z, int place)
{
    PLANE_LANE(list->planes, k, 0, lane) = x;
    PLANE_LANE(list->planes, k, 1, lane) = y;
    PLANE_LANE(list->planes, k, 2, lane) = z;
    LANE(list->places, k, lane) = place;
}

/* The generators near x: bits for each shell, and cumulative counts. */
typedef struct {
    int length;
    int places[NEAR_CAPACITY + LANES];
    long8 bits[SHELLS][NEAR_WORDS], totals[SHELLS];
} near_t;

/* Find the generators nearer than r, and their shells. */
inline void see_near(near_t *near, list_t *list, global const double *binned, double8 x, double8 y, double8 z,
                     double8 r2)
{
    for (int shell = 0; shell < SHELLS; ++shell) {
        list->radii2[shell] = r2 * (SHELL_ENDS[shell] * SHELL_ENDS[shell]);
        near->totals[shell] = 0;
    }
    for (int word = 0; 64 * word < near->length; ++word) {
        const int count = min(near->length - 64 * word, 64);
        long8 seen[SHELLS] = {0}, bit = 1;
        for (int c = 0; c < count; ++c) {
            global const double *at = binned + 3 * near->places[64 * word + c];
            const double8 dx = at[0] - x, dy = at[1] - y, dz = at[2] - z;
            const double8 d2 = fma(dx, dx, fma(dy, dy, dz * dz));
            for (int shell = 0; shell < SHELLS; ++shell)
                seen[shell] |= (d2 < list->radii2[shell]) & bit;
            bit += bit;
        }
        for (int shell = 0; shell < SHELLS; ++shell) {
            near->bits[shell][word] = shell > 0 ? seen[shell] & ~seen[shell - 1] : seen[0];
            near->totals[shell] += popcount(seen[shell]);
        }
    }
}

/* Adjust the radius of one lane so that it holds about ENOUGH generators. */
inline void see_less(near_t *near, list_t *list, global const double *binned, int lane, const double *xs,
                     const double *ys, const double *zs, double *radii)
{
    long *totals[SHELLS], *bits[SHELLS];
    double ends2[SHELLS];
    radii[lane] *= fmax(cbrt(ENOUGH / (double)LANE((long *)&near->totals[SHELLS - 1], 0, lane)), 0.5);
    for (int shell = 0; shell < SHELLS; ++shell) {
        totals[shell] = (long *)&near->totals[shell] + lane;
        bits[shell] = (long *)near->bits[shell] + lane;
        ends2[shell] = radii[lane] * radii[lane] * (SHELL_ENDS[shell] * SHELL_ENDS[shell]);
        LANE((double *)&list->radii2[shell], 0, lane) = ends2[shell];
        *totals[shell] = 0;
    }
    for (int word = 0; 64 * word < near->length; ++word) {
        ulong left = 0, seen[SHELLS];
        for (int shell = 0; shell < SHELLS; ++shell) {
            left |= bits[shell][word * LANES];
            seen[shell] = 0;
        }
        for (; left; left &= left - 1) {
            const ulong bit = left & -left;
            global const double *at = binned + 3 * near->places[64 * word + (int)popcount(bit - 1)];
            const double dx = at[0] - xs[lane], dy = at[1] - ys[lane], dz = at[2] - zs[lane];
            const double d2 = fma(dx, dx, fma(dy, dy, dz * dz));
            for (int shell = 0; shell < SHELLS; ++shell)
                seen[shell] |= d2 < ends2[shell] ? bit : 0;
        }
        for (int shell = 0; shell < SHELLS; ++shell) {
            bits[shell][word * LANES] = shell > 0 ? seen[shell] & ~seen[shell - 1] : seen[0];
            *totals[shell] += popcount(seen[shell]);
        }
    }
}

/* Append the generators of a shell, except items own[lane], to the lists with counts[lane] entries. */
inline void add_seen(list_t *list, const near_t *near, int shell, global const double *binned, const int *own,
                     const double *xs, const double *ys, const double *zs, int *counts)
{
    const ulong *bits = (const ulong *)near->bits[shell];
    for (int lane = 0; lane < LANES; ++lane) {
        const double x = xs[lane], y = ys[lane], z = zs[lane];
        int k = counts[lane];
        for (int word = 0; 64 * word < near->length; ++word)
            for (ulong left = LANE(bits, word, lane); left; left &= left - 1) {
                const int q = near->places[64 * word + (int)popcount(~left & (left - 1))];
                put_plane(list, k, lane, binned[3 * q] - x, binned[3 * q + 1] - y, binned[3 * q + 2] - z, q);
                k += q != own[lane];
            }
        counts[lane] = k;
    }
}

/* Pad the lists with infinitely distant entries to a common, even length, which is returned. */
inline int pad_lists(list_t *list, int *counts)
{
    int length = 2; /* there is always an entry */
    for (int lane = 0; lane < LANES; ++lane)
        length = max(length, counts[lane]);
    length += length % 2;
    for (int lane = 0; lane < LANES; ++lane) {
        for (int k = counts[lane]; k < length; ++k)
            put_plane(list, k, lane, INFINITY, 0, 0, 0);
        counts[lane] = length;
    }
    return length;
}

/* Add wall number `wall`, at signed distances. */
inline void add_wall(list_t *list, double8 distances, int wall, int *counts)
{
    double along[LANES];
    vstore8(2 * distances, 0, along);
    for (int lane = 0; lane < LANES; ++lane)
        put_plane(list, counts[lane]++, lane, wall < 2 ? along[lane] : 0, wall >> 1 == 1 ? along[lane] : 0,
                  wall > 3 ? along[lane] : 0, -1 - wall);
}

/* List the near generators, and the walls within `reach` of [lower, upper]. Lists that are too long stay empty; returns
   those lanes. */
inline long8 list_near(list_t *list, near_t *near, global const double *binned, const int *own, const double *xs,
                       const double *ys, const double *zs, double4 lower, double4 upper, double reach,
                       double4 box_lower, double4 box_upper)
{
    const double8 x = vload8(0, xs), y = vload8(0, ys), z = vload8(0, zs);
    long8 full = near->totals[0] > SHELL_CAPACITY;
    for (int shell = 1; shell < SHELLS; ++shell)
        full |= near->totals[shell] - near->totals[shell - 1] > SHELL_CAPACITY;
    int counts[LANES];
    for (int lane = 0; lane < LANES; ++lane)
        counts[lane] = 0;
    if (lower.s0 - reach < box_lower.s0)
        add_wall(list, box_lower.s0 - x, 0, counts);
    if (upper.s0 + reach > box_upper.s0)
        add_wall(list, box_upper.s0 - x, 1, counts);
    if (lower.s1 - reach < box_lower.s1)
        add_wall(list, box_lower.s1 - y, 2, counts);
    if (upper.s1 + reach > box_upper.s1)
        add_wall(list, box_upper.s1 - y, 3, counts);
    if (lower.s2 - reach < box_lower.s2)
        add_wall(list, box_lower.s2 - z, 4, counts);
    if (upper.s2 + reach > box_upper.s2)
        add_wall(list, box_upper.s2 - z, 5, counts);
    for (int shell = 0; shell < SHELLS; ++shell) {
        if (any(full))
            for (int word = 0; 64 * word < near->length; ++word)
                near->bits[shell][word] &= ~full;
        add_seen(list, near, shell, binned, own, xs, ys, zs, counts);
        list->ends[shell] = pad_lists(list, counts);
    }
    list->nearest2 = INFINITY;
    list->nearest = 0;
    for (int k = 0; k < list->ends[SHELLS - 1]; ++k) {
        planes_t *plane = &list->planes[k];
        /* As in plane_of_face (tessellation/update_rows.h): an update then has the same bits. */
        const double8 d2 = plane->x * plane->x + plane->y * plane->y + plane->z * plane->z, scale = 1 / d2;
        const long8 there = plane->x < INFINITY;
        plane->x = there ? plane->x * scale : 0;
        plane->y = there ? plane->y * scale : 0;
        plane->z = there ? plane->z * scale : 0;
        plane->d2 = d2;
        const long8 nearer = there & (d2 < list->nearest2);
        list->nearest2 = nearer ? d2 : list->nearest2;
        list->nearest = nearer ? (long8)k : list->nearest;
    }
    return full;
}

/* Lanes share a search if they are within SPREAD times the radius: a batch may span the end of a row of bins. */
#define SPREAD 3

/* The arrays to search for generators and walls. */
typedef struct {
    global const double *binned;
    global const int2 *bins;
    global const FRAME *grid_frames;
    global const int4 *grid_shapes;
    double4 box_lower, box_upper;
} search_t;

/* Choose the lanes near that of the least rank; the box holds them, r is their largest radius. */
inline long8 choose_planes(long8 todo, const int *ranks, const double *xs, const double *ys, const double *zs,
                           double8 radii, double spread, double4 *lower, double4 *upper, double *r)
{
    long wanted[LANES], chosen[LANES];
    double rs[LANES];
    vstore8(todo, 0, wanted);
    vstore8(radii, 0, rs);
    int first = -1;
    for (int lane = 0; lane < LANES; ++lane)
        first = wanted[lane] && (first < 0 || ranks[lane] < ranks[first]) ? lane : first;
    const double4 center = (double4)(xs[first], ys[first], zs[first], 0);
    *lower = *upper = center;
    *r = rs[first];
    for (int lane = 0; lane < LANES; ++lane) {
        const double4 x = (double4)(xs[lane], ys[lane], zs[lane], 0);
        const bool near = wanted[lane] && (lane == first || all(fabs(x - center) <= spread * rs[first]));
        *lower = near ? fmin(*lower, x) : *lower;
        *upper = near ? fmax(*upper, x) : *upper;
        *r = near ? fmax(*r, rs[lane]) : *r;
        chosen[lane] = near ? -1 : 0;
    }
    return vload8(0, chosen);
}

/* Choose lanes and find the generators near them. A guessed radius that holds too many or too few generators is
   changed. False if too many are near the chosen lanes. */
inline bool see_enough(near_t *near, list_t *list, runs_t *runs, long8 todo, long8 fresh, const int *ranks,
                       const double *xs, const double *ys, const double *zs, double8 *r, long8 *chosen, double4 *lower,
                       double4 *upper, double *widest, const search_t *in)
{
    const double8 x = vload8(0, xs), y = vload8(0, ys), z = vload8(0, zs);
    double spread = SPREAD;
    int guesses = 0;
    for (int attempt = 0;; ++attempt) {
        *chosen = choose_planes(todo, ranks, xs, ys, zs, *r, spread, lower, upper, widest);
        const double8 collected = *chosen ? *r : -1;
        const balls_t balls = {x, y, z, collected};
        const bool fits = collect_runs(runs, &balls, (double4)(-INFINITY), (double4)(INFINITY), NEAR_CAPACITY, in->bins,
                                       in->grid_frames, in->grid_shapes);
        if (!fits) {
            if (attempt == 12)
                return false;
            /* First fewer lanes, then a smaller radius. */
            *r = (*chosen & (spread < SPREAD / 4.0 ? -1L : 0L)) ? 0.7 * *r : *r;
            spread = spread < SPREAD / 4.0 ? 0 : spread / 2;
            continue;
        }
        int length = 0;
        for (int run = 0; run < runs->n; ++run) {
            const int first = runs->firsts[run], count = runs->counts[run];
            for (int c = 0; c < count; c += LANES)
                vstore8(first + c + (int8)(0, 1, 2, 3, 4, 5, 6, 7), 0, near->places + length + c);
            length += count;
        }
        near->length = length;
        see_near(near, list, in->binned, x, y, z, *chosen ? *r * *r : 0);
        const double8 total = convert_double8(near->totals[SHELLS - 1]);
        const long8 few = *chosen & fresh & (total < FEW);
        if (guesses < 4 && any(few)) {
            ++guesses;
            *r = few ? *r * clamp(cbrt(ENOUGH / total), 1.0, 1.6) : *r;
            continue;
        }
        long many[LANES];
        double radii[LANES];
        vstore8(*chosen & fresh & (total > MANY), 0, many);
        vstore8(*r, 0, radii);
        for (int lane = 0; lane < LANES; ++lane)
            for (int trial = 0; trial < 4 && many[lane] && LANE((long *)&near->totals[SHELLS - 1], 0, lane) > MANY;
                 ++trial)
                see_less(near, list, in->binned, lane, xs, ys, zs, radii);
        *r = vload8(0, radii);
        return true;
    }
}
