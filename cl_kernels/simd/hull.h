/* The cells of eight generators at a time as convex hulls, one per vector lane.

   Invert every generator at d from x in a circle about x: p = d / |d|^2. The half-plane y.d <= |d|^2 / 2 is y.p <= 1/2,
   so the neighbors of x are the corners of the convex hull of all p, and the corners of its cell are the edges of the
   hull. A wall is the bisector with the mirror image. Gift wrapping starts at the nearest generator: the next corner is
   the candidate with no other to its right. All lanes take the same steps. */
#include "simd/candidate_lists.h"

/* Faces of a cell. */
#define HULL_CAPACITY 16
/* A turn is certain if it exceeds this share of the largest p^2: hundreds of times the round-off of p and of the turn.
 */
#define TURN_ROUNDING 1e-13
/* A cell is certain if it is far from the limits of `is_doubtful` (tessellation/short_faces.h). Limits: least squared
   ratio of the length of a face to the distance of its generator; largest squared ratio of the reach to the least
   distance; least squared distance. */
#define CERTAIN_FACE2 1e-9
#define CERTAIN_RATIO2 3e7
#define CERTAIN_DISTANCE2 1e-16

/* Per lane the corners of a hull, counter-clockwise: inverted positions, candidate numbers, and items. Hulls with fewer
   than `steps` corners repeat from the start. */
typedef struct {
    int steps;
    double8 x[HULL_CAPACITY + 1], y[HULL_CAPACITY + 1];
    long8 at[HULL_CAPACITY];
    int8 places[HULL_CAPACITY];
    long8 sizes, doubt,
        lost; /* number of corners; whether a decision is near round-off; whether x is outside the hull */
} hull_t;

/* The rightmost candidate so far: its direction from the last corner of the hull, and its number. */
typedef struct {
    double8 dx, dy;
    long8 at;
} best_t;

/* Take the candidate in direction (dx, dy) if it is to the right by more than round-off. */
inline void take_right(best_t *best, double8 dx, double8 dy, long8 at, double8 rounding)
{
    const long8 right = fma(dx, best->dy, -dy * best->dx) > rounding;
    best->at = right ? at : best->at;
    best->dx = right ? dx : best->dx;
    best->dy = right ? dy : best->dy;
}

/* Wrap the hulls of the candidates in some lanes. */
inline void wrap_hulls(hull_t *hull, const list_t *list, long8 lanes)
{
    const double8 rounding = TURN_ROUNDING * list->largest2;
    const long8 start = list->nearest;
    double8 x = pick(list->x, start), y = pick(list->y, start);
    long8 from = start, open = lanes, lost = 0, sizes = 0;
    int steps = 0;
    while (any_lane(open) && steps < HULL_CAPACITY) {
        hull->x[steps] = x;
        hull->y[steps] = y;
        hull->at[steps] = from;
        sizes -= open;
        /* x lies inside, or the hull is invalid. */
        best_t a = {-x, -y, -1}, b = a, c = a, d = a;
        for (int k = 0; k < list->length; k += CHAINS) {
            take_right(&a, list->x[k] - x, list->y[k] - y, k, rounding);
            take_right(&b, list->x[k + 1] - x, list->y[k + 1] - y, k + 1, rounding);
            take_right(&c, list->x[k + 2] - x, list->y[k + 2] - y, k + 2, rounding);
            take_right(&d, list->x[k + 3] - x, list->y[k + 3] - y, k + 3, rounding);
        }
        take_right(&a, b.dx, b.dy, b.at, rounding);
        take_right(&c, d.dx, d.dy, d.at, rounding);
        take_right(&a, c.dx, c.dy, c.at, rounding);
        from = a.at;
        x += a.dx;
        y += a.dy;
        lost |= from < 0;
        open &= (from != start) & (from >= 0);
        ++steps;
    }
    hull->x[steps] = x;
    hull->y[steps] = y;
    for (int k = 0; k < steps; ++k)
        for (int lane = 0; lane < LANES; ++lane)
            LANE((int *)hull->places, k, lane) =
                LANE((const int *)list->places, max(LANE((const long *)hull->at, k, lane), 0L), lane);
    hull->steps = steps;
    hull->sizes = sizes;
    hull->lost = lost & lanes;
    hull->doubt = open & ~lost;
}

/* Not 1, for which compilers generate more instructions. */
#define COUNT 2

/* Measure the cells: squared distance of the farthest corner, and the least squared ratio of the length of a face to
   the distance of its generator. A hull is in doubt if any candidate, other than the two ends of an edge, is outside of
   the edge or near it within round-off.

   The face of the nearest generator, where hulls begin and end, needs no check. Other bisectors are not nearer; one at
   an angle t cuts the face at least a quarter of t times the distance of that generator from its foot. If the face is
   small, the turns there, of order t^3, are near round-off. */
inline void measure_hulls(hull_t *hull, const list_t *list, double8 *reach2, double8 *least)
{
    double8 x = 0, y = 0;
    long8 outside = 0;
    *reach2 = 0;
    *least = INFINITY;
    for (int k = 0; k < hull->steps; ++k) {
        const double8 ax = hull->x[k], ay = hull->y[k], bx = hull->x[k + 1], by = hull->y[k + 1];
        const double8 scale = 0.5 / fma(ax, by, -ay * bx);
        const double8 before_x = x, before_y = y;
        x = (by - ay) * scale;
        y = (ax - bx) * scale;
        *reach2 = max(*reach2, fma(x, x, y * y));
        /* The first corner is at least half as far as the nearest generator. */
        const double8 ex = x - before_x, ey = y - before_y;
        *least = min(*least, fma(ex, ex, ey * ey) * fma(ax, ax, ay * ay));
        const double8 bound = 0.5 - TURN_ROUNDING * list->largest2 * scale;
        for (int c = 0; c < list->length; c += CHAINS)
            _Pragma("unroll") for (int chain = 0; chain < CHAINS; ++chain) outside =
                fma(list->x[c + chain], x, list->y[c + chain] * y) > bound ? outside + COUNT : outside;
    }
    hull->doubt |= outside != 2 * COUNT * hull->steps;
}

/* Whether any decision for the hulls is near round-off. A hull with x outside is useless, but certain. */
inline long8 is_uncertain(const hull_t *hull, const list_t *list, double8 reach2, double8 least)
{
    return !(list->largest2 < 1 / CERTAIN_DISTANCE2) |
           (~hull->lost & (hull->doubt | !(least > CERTAIN_FACE2) | !(list->largest2 * reach2 < CERTAIN_RATIO2)));
}

/* Write the labels of the faces of a row, starting with the least. */
inline void write_labels(const int *labels, int count, global int *row)
{
    /* Label and index in one number. */
    long least = LONG_MAX;
    for (int k = 0; k < count; ++k)
        least = min(least, (long)labels[k] * HULL_CAPACITY + k);
    const int first = least & (HULL_CAPACITY - 1);
    for (int k = 0; k < count; ++k)
        row[k] = labels[first + k < count ? first + k : first + k - count];
}
