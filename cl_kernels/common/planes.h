/* Per lane of vectors a list of half-spaces: those nearer to the lane's generator x than to another, y.p <= 1/2 with p
   = d / |d|^2 for one at x + d. A wall is the bisector with the mirror image. */
#include "common/runs.h"

#define LANES 8
/* One lane of vector k of an array. */
#define LANE(vectors, k, lane) ((vectors)[(k)*LANES + (lane)])

typedef struct {
    double8 x, y, z, d2;
} planes_t;

/* In each lane a component (0: x, 1: y, 2: z, 3: d2) of that of the planes which `at` says. */
#define PLANE_LANE(planes, k, component, lane) (((double *)(planes))[((k)*4 + (component)) * LANES + (lane)])
#define PLANE_LANES(planes, at, component)                                                                             \
    (double8)(PLANE_LANE(planes, (at)[0], component, 0), PLANE_LANE(planes, (at)[1], component, 1),                    \
              PLANE_LANE(planes, (at)[2], component, 2), PLANE_LANE(planes, (at)[3], component, 3),                    \
              PLANE_LANE(planes, (at)[4], component, 4), PLANE_LANE(planes, (at)[5], component, 5),                    \
              PLANE_LANE(planes, (at)[6], component, 6), PLANE_LANE(planes, (at)[7], component, 7))

/* Lists have shells, by distance: the outer ends of all, as shares of the radius. */
#define SHELLS 2
constant const double SHELL_ENDS[SHELLS] = {0.86, 1};
#define NEAR_CAPACITY 1024
#define SHELL_CAPACITY 64
#define LIST_CAPACITY (SHELLS * SHELL_CAPACITY + 8)
/* A list of more than MANY is cut to about ENOUGH of the nearest. */
#define MANY 96
#define ENOUGH 56

/* Shells are the same in length for all lanes: spare entries are p = 0, which cuts nothing. */
typedef struct {
    planes_t planes[LIST_CAPACITY];
    int places[LIST_CAPACITY * LANES]; /* of the other generator, or -1 - wall */
    int ends[SHELLS];
    double8 radii2[SHELLS]; /* all that is nearer is in the shell, or in those before */
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

/* Add the generators whose bits are set, but those at places `own` + lane, to the lists of counts[lane] entries. */
inline void add_seen(list_t *list, const int *near, int words, const long8 *bits, global const double *binned, int own,
                     const double *xs, const double *ys, const double *zs, int *counts)
{
    for (int lane = 0; lane < LANES; ++lane) {
        const double x = xs[lane], y = ys[lane], z = zs[lane];
        int k = counts[lane];
        for (int word = 0; word < words; ++word)
            for (ulong left = LANE((const ulong *)bits, word, lane); left; left &= left - 1) {
                const int q = near[64 * word + (int)popcount(~left & (left - 1))];
                put_plane(list, k, lane, binned[3 * q] - x, binned[3 * q + 1] - y, binned[3 * q + 2] - z, q);
                k += q != own + lane;
            }
        counts[lane] = k;
    }
}

/* Fill the lists up to a common, even number of entries, which is returned, with what is infinitely far. */
inline int pad_lists(list_t *list, int *counts)
{
    int length = 2; /* some entry is there always */
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

/* List all generators nearer than r, of `runs`, for the chosen lanes, and the walls that [lower, upper] and `reach`
   about it touch. The radius of a `fresh` list that would be long is made less. Lists that do not fit are left empty;
   returns those lanes. */
inline long8 list_near(list_t *list, const runs_t *runs, global const double *binned, int own, const double *xs,
                       const double *ys, const double *zs, long8 chosen, double4 lower, double4 upper, double reach,
                       double4 box_lower, double4 box_upper, long8 fresh, double8 *r)
{
    const double8 x = vload8(0, xs), y = vload8(0, ys), z = vload8(0, zs);
    int near[NEAR_CAPACITY];
    int length = 0;
    for (int run = 0; run < runs->n; ++run)
        for (int c = 0; c < runs->counts[run]; ++c)
            near[length++] = runs->firsts[run] + c;
    const int words = (length + 63) / 64;
    long8 bits[SHELLS][NEAR_CAPACITY / 64], totals[SHELLS];
    double8 r2 = chosen ? *r * *r : 0;
    for (int attempt = 0;; ++attempt) {
        for (int shell = 0; shell < SHELLS; ++shell) {
            list->radii2[shell] = r2 * (SHELL_ENDS[shell] * SHELL_ENDS[shell]);
            totals[shell] = 0;
        }
        for (int word = 0; word < words; ++word) {
            const int count = min(length - 64 * word, 64);
            long8 seen[SHELLS] = {0}, bit = 1;
            for (int c = 0; c < count; ++c) {
                global const double *at = binned + 3 * near[64 * word + c];
                const double8 dx = at[0] - x, dy = at[1] - y, dz = at[2] - z;
                const double8 d2 = fma(dx, dx, fma(dy, dy, dz * dz));
                _Pragma("unroll") for (int shell = 0; shell < SHELLS; ++shell) seen[shell] |=
                    (d2 < list->radii2[shell]) & bit;
                bit += bit;
            }
            for (int shell = 0; shell < SHELLS; ++shell) {
                bits[shell][word] = shell > 0 ? seen[shell] & ~seen[shell - 1] : seen[0];
                totals[shell] += popcount(seen[shell]);
            }
        }
        const long8 many = fresh & (totals[SHELLS - 1] > MANY);
        if (attempt == 3 || !any(many))
            break;
        r2 = many ? r2 * pow(ENOUGH / convert_double8(totals[SHELLS - 1]), (double8)(2.0 / 3)) : r2;
    }
    long8 full = totals[0] > SHELL_CAPACITY;
    for (int shell = 1; shell < SHELLS; ++shell)
        full |= totals[shell] - totals[shell - 1] > SHELL_CAPACITY;
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
            for (int word = 0; word < words; ++word)
                bits[shell][word] &= ~full;
        add_seen(list, near, words, bits[shell], binned, own, xs, ys, zs, counts);
        list->ends[shell] = pad_lists(list, counts);
    }
    list->nearest2 = INFINITY;
    list->nearest = 0;
    for (int k = 0; k < list->ends[SHELLS - 1]; ++k) {
        planes_t *plane = &list->planes[k];
        const double8 d2 = fma(plane->x, plane->x, fma(plane->y, plane->y, plane->z * plane->z)), scale = 1 / d2;
        const long8 there = plane->x < INFINITY;
        plane->x = there ? plane->x * scale : 0;
        plane->y = there ? plane->y * scale : 0;
        plane->z = there ? plane->z * scale : 0;
        plane->d2 = d2;
        const long8 nearer = there & (d2 < list->nearest2);
        list->nearest2 = nearer ? d2 : list->nearest2;
        list->nearest = nearer ? (long8)k : list->nearest;
    }
    *r = sqrt(r2);
    return chosen & full;
}
