/* The cells of eight generators at a time as hulls, one in each lane of vectors.

   Invert every generator at d from x in a circle about x: p = d / |d|^2. The half-plane y.d <= |d|^2 / 2 is y.p <= 1/2,
   so the neighbors of x are the corners of the convex hull of all p, and the corners of its cell belong to the hull's
   edges. A wall is the bisector with the mirror image. The hull is wrapped from the nearest generator on: of all
   candidates the next one is that which has none to its right. These are the same steps in every lane. */
#include "simd/lists.h"

/* Faces of a cell. */
#define HULL_CAPACITY 16
/* A turn is certain if it is more than this share of the largest p^2: hundreds of times the rounding of p and of the
   turn. */
#define TURN_ROUNDING 1e-13
/* A cell is certain if it is far from what `is_doubtful` (tessellation/short_faces.h) calls doubtful: least square of a
   face's length over that of its generator's distance; largest square of the reach over that of the least distance;
   least square of that. */
#define CERTAIN_FACE2 1e-9
#define CERTAIN_RATIO2 3e7
#define CERTAIN_DISTANCE2 1e-16

/* Per lane the corners of a hull, counter-clockwise: inverted positions, which of the candidates they are, and
   their places. Hulls with fewer than `steps` corners begin again behind the last. */
typedef struct {
    int steps;
    double8 x[HULL_CAPACITY + 1], y[HULL_CAPACITY + 1];
    long8 at[HULL_CAPACITY];
    int8 places[HULL_CAPACITY];
    long8 sizes, doubt, lost; /* corners; is a decision near to rounding; does the hull leave out x? */
} hull_t;

/* A candidate on the right of which none has been found yet: its direction from the hull's last corner, and its
   number. */
typedef struct {
    double8 dx, dy;
    long8 at;
} best_t;

/* Take the candidate in direction (dx, dy) for the best if that is to the right by more than rounding. */
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
        /* x itself lies inside, or the hull is lost. */
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

/* Not 1, as compilers then count by more instructions. */
#define COUNT 2

/* Measure the cells: squared distance of the farthest corner, and the least ratio of the square of a face's length to
   that of its generator's distance. A hull is in doubt if any candidate but an edge's own two ends is outside of the
   edge, or so near to it that rounding may decide.

   The face of the nearest, where hulls begin and end, is not looked at: by bisectors no nearer than its own, at an
   angle t, it is cut off no nearer to its foot than a quarter of t times that generator's distance. Where it is small,
   the turns there are near to rounding: by the third power of t. */
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
        /* From the generator itself to the first corner it is as far as half way to the nearest, or farther. */
        const double8 ex = x - before_x, ey = y - before_y;
        *least = min(*least, fma(ex, ex, ey * ey) * fma(ax, ax, ay * ay));
        const double8 bound = 0.5 - TURN_ROUNDING * list->largest2 * scale;
        for (int c = 0; c < list->length; c += CHAINS)
            _Pragma("unroll") for (int chain = 0; chain < CHAINS; ++chain) outside =
                fma(list->x[c + chain], x, list->y[c + chain] * y) > bound ? outside + COUNT : outside;
    }
    hull->doubt |= outside != 2 * COUNT * hull->steps;
}

/* Is any decision that made or measured the hulls near to rounding? A hull that leaves out x is of no use, but
   certain. */
inline long8 is_uncertain(const hull_t *hull, const list_t *list, double8 reach2, double8 least)
{
    return !(list->largest2 < 1 / CERTAIN_DISTANCE2) |
           (~hull->lost & (hull->doubt | !(least > CERTAIN_FACE2) | !(list->largest2 * reach2 < CERTAIN_RATIO2)));
}

/* Write the labels of a row's faces, the least first. */
inline void write_labels(const int *labels, int count, global int *row)
{
    /* Label and place in one number. */
    long least = LONG_MAX;
    for (int k = 0; k < count; ++k)
        least = min(least, (long)labels[k] * HULL_CAPACITY + k);
    const int first = least & (HULL_CAPACITY - 1);
    for (int k = 0; k < count; ++k)
        row[k] = labels[first + k < count ? first + k : first + k - count];
}
