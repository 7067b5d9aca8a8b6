#include "common/near.h"

/* The cells of eight generators at a time, one in each lane of vectors: for CPUs, whose compilers make no vectors of
   work-items that branch as clipping does.

   Invert every generator at d from x in a circle about x: p = d / |d|^2. The half-plane y.d <= |d|^2 / 2 is y.p <= 1/2, so the
   neighbours of x are the corners of the convex hull of all p, and the corners of its cell belong to the hull's edges.
   A wall is the bisector with the mirror image. The hull is wrapped from the nearest generator on: of all candidates the
   next one is that which has none to its right. These are the same steps in every lane.

   Where any decision is near to rounding, or something does not fit, a cell is left to be clipped (`cells.cl`): rows do not
   depend on which of the two has made them. */

#if !IS_DOUBLE
#error "single precision has too few digits to tell which decisions are certain"
#endif
#define LANES 8
/* One lane of vector k of an array. */
#define LANE(vectors, k, lane) ((vectors)[(k) * LANES + (lane)])

/* Capacities: candidates of one generator; faces of a cell. */
#define LIST_CAPACITY 48
#define HULL_CAPACITY 16
/* A list that begins with more candidates than MANY is cut to about ENOUGH of the nearest. */
#define MANY 36
#define ENOUGH 28
/* Lanes are searched for together if they are within SPREAD times the radius: rows of bins end within an eight. */
#define SPREAD 4
#define GROWTH 1.4 /* of the radius, from round to round: twice the area */
#define MAX_ROUNDS 10

/* A turn is certain if it is more than this share of the largest p^2: hundreds of times the rounding of p and of the turn. */
#define TURN_ROUNDING 1e-13
/* A cell is certain if it is far from what `is_doubtful` (common/polygon.h) calls doubtful: least square of a face's length
   over that of its generator's distance; largest square of the reach over that of the least distance; least square of that. */
#define CERTAIN_FACE2 1e-9
#define CERTAIN_RATIO2 3e7
#define CERTAIN_DISTANCE2 1e-16

/* Per lane a list of candidates: relative positions, the first `inverted` of them inverted; place, or -1 - wall. */
typedef struct {
    double8 x[LIST_CAPACITY], y[LIST_CAPACITY];
    long8 places[LIST_CAPACITY];
    long8 inverted;
    long counts[LANES];
} list_t;

/* Per lane the corners of a hull, counter-clockwise: inverted positions, and which of the candidates they are. Hulls with
   fewer than `steps` corners begin again behind the last. */
typedef struct {
    int steps;
    double8 x[HULL_CAPACITY + 1], y[HULL_CAPACITY + 1];
    long8 at[HULL_CAPACITY + 1];
    long8 sizes, doubt, lost; /* corners; is a decision near to rounding; does the hull leave out x? */
} hull_t;

inline void put_candidate(list_t *list, long k, int lane, double dx, double dy, long place)
{
    LANE((double *)list->x, k, lane) = dx;
    LANE((double *)list->y, k, lane) = dy;
    LANE((long *)list->places, k, lane) = place;
}

/* Add to each list the generators whose squared distance is in [from2, to2), but not the one itself. Returns to2, which is
   less than asked for where a first list (from2 = 0) would be long. Lists that do not fit, and those of generators at
   whose place there is another, stay as they are and are in doubt. */
inline double8 add_near(list_t *list, const near_t *near, const double *xs, const double *ys, double8 from2,
                        double8 to2, long8 *doubt)
{
    const double8 x = vload8(0, xs), y = vload8(0, ys);
    const long8 before = vload8(0, list->counts);
    long8 bits[NEAR_CAPACITY / 64], counts, same;
    for (int attempt = 0;; ++attempt) {
        counts = before;
        same = 0;
        for (int word = 0; 64 * word < near->count; ++word) {
            const double *near_x = near->x + 64 * word, *near_y = near->y + 64 * word;
            const int end = min(64, near->count - 64 * word);
            long8 seen = 0;
            for (int c = 0; c < end; ++c) {
                const double8 dx = near_x[c] - x, dy = near_y[c] - y;
                const double8 d2 = fma(dx, dx, dy * dy);
                seen |= (d2 < to2) & (d2 >= from2) & (d2 > 0) & (1L << c);
                same -= d2 == 0;
            }
            bits[word] = seen;
            counts += popcount(seen);
        }
        const long8 many = (from2 == 0) & (counts > MANY);
        if (attempt == 3 || !any(many))
            break;
        to2 = many ? to2 * ENOUGH / convert_double8(counts) : to2;
    }
    const long8 fits = (counts <= LIST_CAPACITY) & (same < 2);
    *doubt |= ~fits;
    for (int word = 0; 64 * word < near->count; ++word)
        bits[word] &= fits;
    for (int lane = 0; lane < LANES; ++lane) {
        long k = list->counts[lane];
        for (int word = 0; 64 * word < near->count; ++word)
            for (ulong left = LANE((const ulong *)bits, word, lane); left; left &= left - 1) {
                const int c = 64 * word + (int)popcount(~left & (left - 1));
                put_candidate(list, k++, lane, near->x[c] - xs[lane], near->y[c] - ys[lane], near->places[c]);
            }
    }
    vstore8(fits ? counts : before, 0, list->counts);
    return to2;
}

/* Add the mirror images in the walls to the lists of some lanes, if there is room. */
inline void add_walls(list_t *list, const double *xs, const double *ys, long8 lanes, double4 box_lower,
                      double4 box_upper, long8 *doubt)
{
    long some[LANES];
    vstore8(lanes, 0, some);
    *doubt |= lanes & (vload8(0, list->counts) > LIST_CAPACITY - 4);
    for (int lane = 0; lane < LANES; ++lane) {
        const long count = list->counts[lane];
        if (some[lane] && count <= LIST_CAPACITY - 4) {
            put_candidate(list, count, lane, 2 * (box_lower.s0 - xs[lane]), 0, -1);
            put_candidate(list, count + 1, lane, 2 * (box_upper.s0 - xs[lane]), 0, -2);
            put_candidate(list, count + 2, lane, 0, 2 * (box_lower.s1 - ys[lane]), -3);
            put_candidate(list, count + 3, lane, 0, 2 * (box_upper.s1 - ys[lane]), -4);
            list->counts[lane] = count + 4;
        }
    }
}

/* Invert what was added to the lists, and pad all to the same even length, which is returned, by x itself. Finds the
   nearest candidates, where p^2 is largest2. */
inline int invert(list_t *list, double8 *largest2, long8 *nearest)
{
    const long8 counts = vload8(0, list->counts);
    long length = 0;
    for (int lane = 0; lane < LANES; ++lane)
        length = max(length, list->counts[lane]);
    length += length % 2;
    *largest2 = 0;
    *nearest = 0;
    for (int k = 0; k < length; ++k) {
        const double8 x = list->x[k], y = list->y[k];
        const double8 square = fma(x, x, y * y);
        const long8 done = k < list->inverted, valid = k < counts;
        const double8 scale = done ? 1 : 1 / square;
        list->x[k] = valid ? x * scale : 0;
        list->y[k] = valid ? y * scale : 0;
        const double8 p2 = done ? square : scale;
        /* A NaN or an infinity, of two generators at one place, stays. */
        const long8 nearer = valid & !(p2 <= *largest2);
        *largest2 = nearer ? p2 : *largest2;
        *nearest = nearer ? (long8)k : *nearest;
    }
    return length;
}

/* A candidate on the right of which none has been found yet, and its direction from the hull's last corner; has another one
   come so near to that line that rounding may decide? */
typedef struct {
    double8 x, y, dx, dy;
    long8 at, doubt;
} best_t;

/* Take candidate (x, y), number k, for the best if it lies to its right by more than rounding, as seen from corner number
   `from` at (from_x, from_y). */
inline void take_right(best_t *best, double8 x, double8 y, long8 k, long8 doubt, double8 from_x, double8 from_y,
                       long8 from, double8 rounding)
{
    const double8 dx = x - from_x, dy = y - from_y;
    const double8 turn = fma(dx, best->dy, -dy * best->dx);
    const long8 right = turn > rounding;
    const long8 close = (turn > -rounding) & (k != from);
    best->doubt = right ? doubt : best->doubt | close;
    best->x = right ? x : best->x;
    best->y = right ? y : best->y;
    best->dx = right ? dx : best->dx;
    best->dy = right ? dy : best->dy;
    best->at = right ? k : best->at;
}

/* Wrap the hulls of lists of inverted candidates, from number `start` on. */
inline void wrap_hulls(hull_t *hull, const list_t *list, int length, long8 start, double8 rounding)
{
    long starts[LANES];
    vstore8(start, 0, starts);
    double xs[LANES], ys[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        xs[lane] = LANE((const double *)list->x, starts[lane], lane);
        ys[lane] = LANE((const double *)list->y, starts[lane], lane);
    }
    double8 x = vload8(0, xs), y = vload8(0, ys);
    long8 from = start, open = -1, doubt = 0, lost = 0, sizes = 0;
    int steps = 0;
    while (any(open) && steps < HULL_CAPACITY) {
        hull->x[steps] = x;
        hull->y[steps] = y;
        hull->at[steps] = from;
        sizes -= open;
        /* x itself lies inside, or the hull is lost. Two chains of comparisons, as a processor works on both at a time. */
        best_t even = {0, 0, -x, -y, -1, 0}, odd = even;
        for (int k = 0; k < length; k += 2) {
            take_right(&even, list->x[k], list->y[k], k, 0, x, y, from, rounding);
            take_right(&odd, list->x[k + 1], list->y[k + 1], k + 1, 0, x, y, from, rounding);
        }
        take_right(&even, odd.x, odd.y, odd.at, odd.doubt, x, y, from, rounding);
        doubt |= even.doubt & open;
        from = even.at;
        x = even.x;
        y = even.y;
        lost |= from < 0;
        open &= (from != start) & (from >= 0);
        ++steps;
    }
    hull->x[steps] = x;
    hull->y[steps] = y;
    hull->at[steps] = from;
    hull->steps = steps;
    hull->sizes = sizes;
    hull->lost = lost;
    hull->doubt = (doubt | open) & ~lost;
}

/* Measure the cells: squared distance of the farthest corner, and the least ratio of the square of a face's length to that
   of its generator's distance. */
inline void measure_hulls(const hull_t *hull, double8 *reach2, double8 *least)
{
    double8 x = 0, y = 0, first_x = 0, first_y = 0;
    *reach2 = 0;
    *least = 1;
    for (int k = 0; k < hull->steps; ++k) {
        const double8 ax = hull->x[k], ay = hull->y[k], bx = hull->x[k + 1], by = hull->y[k + 1];
        const double8 scale = 0.5 / fma(ax, by, -ay * bx);
        const double8 before_x = x, before_y = y;
        x = (by - ay) * scale;
        y = (ax - bx) * scale;
        *reach2 = fmax(*reach2, fma(x, x, y * y));
        if (k > 0) {
            const double8 ex = x - before_x, ey = y - before_y;
            *least = fmin(*least, fma(ex, ex, ey * ey) * fma(ax, ax, ay * ay));
        } else {
            first_x = x;
            first_y = y;
        }
    }
    /* The largest hulls have not begun again. */
    const double8 ex = first_x - x, ey = first_y - y, ax = hull->x[0], ay = hull->y[0];
    const double8 ratio = fma(ex, ex, ey * ey) * fma(ax, ax, ay * ay);
    *least = hull->sizes == hull->steps ? fmin(*least, ratio) : *least;
}

/* Begin the next lists with the hulls, or go on with the present one where the hull is lost. */
inline void keep_hulls(list_t *list, hull_t *hull)
{
    long8 places[HULL_CAPACITY];
    for (int k = 0; k < hull->steps; ++k)
        for (int lane = 0; lane < LANES; ++lane)
            LANE((long *)places, k, lane) =
                LANE((const long *)list->places, max(LANE((const long *)hull->at, k, lane), 0L), lane);
    for (int k = 0; k < hull->steps; ++k) {
        list->x[k] = hull->lost ? list->x[k] : hull->x[k];
        list->y[k] = hull->lost ? list->y[k] : hull->y[k];
        list->places[k] = hull->lost ? list->places[k] : places[k];
        hull->at[k] = k;
    }
    list->inverted = hull->lost ? vload8(0, list->counts) : hull->sizes;
    vstore8(list->inverted, 0, list->counts);
}

/* Choose from the lanes to do those near the first of them, within `spread` of its radius; the rectangle is to hold all that
   is within r of them. */
inline long8 choose_lanes(long8 todo, const double *xs, const double *ys, double8 r, double spread, double2 *lower,
                          double2 *upper)
{
    long wanted[LANES], chosen[LANES];
    double rs[LANES];
    vstore8(todo, 0, wanted);
    vstore8(r, 0, rs);
    int first = 0;
    while (!wanted[first])
        ++first;
    const double2 centre = (double2)(xs[first], ys[first]);
    *lower = *upper = centre;
    for (int lane = 0; lane < LANES; ++lane) {
        const double2 x = (double2)(xs[lane], ys[lane]);
        const bool near = wanted[lane] && (lane == first || all(fabs(x - centre) <= spread * rs[first]));
        const double slack = rs[lane] * (1 + 1e-6);
        *lower = near ? fmin(*lower, x - slack) : *lower;
        *upper = near ? fmax(*upper, x + slack) : *upper;
        chosen[lane] = near ? -1 : 0;
    }
    return vload8(0, chosen);
}

/* Per eight places in bin order: the rows of the generators there (see `clip_cells`), or row_counts[i] = 0 where a cell is
   left to be clipped. `first_reach` is how far the first lists go, in edges of the generator's leaf. Only the first
   `rows_wanted` generators get rows. */
kernel void wrap_cells(const int size, const int n, const int rows_wanted, global const double *binned, global const int *items,
                       global float *reach, global const int2 *bins, global const FRAME *grid_frames,
                       global const int4 *grid_shapes, const double4 box_lower, const double4 box_upper,
                       const double first_reach, global int *rows, global int *row_counts, global int *places)
{
    WORK_ITEM(group);
    const int own = group * LANES;
    double xs[LANES], ys[LANES], rs[LANES];
    long wanted[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        const int p = min(own + lane, n - 1);
        wanted[lane] = items[p] < rows_wanted ? -1 : 0;
        xs[lane] = binned[2 * p];
        ys[lane] = binned[2 * p + 1];
        rs[lane] = first_reach * reach[p];
    }
    near_t near;
    list_t list;
    hull_t hull;
    for (int lane = 0; lane < LANES; ++lane)
        list.counts[lane] = 0;
    list.inverted = 0;
    list.x[0] = list.y[0] = 0; /* hulls begin there where all lists are empty */
    /* Of the generators nearer than `done` all are in the list that can be neighbours; now those nearer than `r` are added. */
    double8 done2 = 0, r = vload8(0, rs), need = 0;
    long8 todo = vload8(0, wanted), doubt = 0, walled = 0;
    if (!any(todo))
        return;
    for (int round = 0; any(todo) && round < MAX_ROUNDS; ++round) {
        double2 lower, upper;
        long8 chosen = choose_lanes(todo, xs, ys, r, SPREAD, &lower, &upper);
        bool fits = collect_near(&near, lower, upper, binned, bins, grid_frames, grid_shapes);
        for (int attempt = 0; !fits && attempt < 4; ++attempt) {
            chosen = choose_lanes(todo, xs, ys, r, attempt == 0 ? 1 : 0, &lower, &upper);
            r = (chosen & (done2 == 0) & (attempt > 1 ? -1L : 0L)) ? r / 2 : r;
            fits = collect_near(&near, lower, upper, binned, bins, grid_frames, grid_shapes);
        }
        if (!fits) {
            doubt |= chosen;
            todo &= ~chosen;
            continue;
        }
        if (any(lower < box_lower.s01) || any(upper > box_upper.s01)) {
            add_walls(&list, xs, ys, chosen & ~walled, box_lower, box_upper, &doubt);
            walled |= chosen;
        }
        const double8 to2 = add_near(&list, &near, xs, ys, done2, chosen ? r * r : done2, &doubt);
        r = (chosen & (to2 < r * r)) ? sqrt(to2) : r;
        done2 = to2;
        double8 largest2, reach2, least;
        long8 nearest;
        const int length = invert(&list, &largest2, &nearest);
        wrap_hulls(&hull, &list, length, nearest, TURN_ROUNDING * largest2);
        measure_hulls(&hull, &reach2, &least);
        doubt |= hull.doubt | (hull.lost & ~todo) | !(largest2 < 1 / CERTAIN_DISTANCE2);
        doubt |= ~hull.lost & (!(least > CERTAIN_FACE2) | !(largest2 * reach2 < CERTAIN_RATIO2));
        need = 2 * sqrt(reach2) * (1 + 8 * DBL_EPSILON);
        todo &= ~doubt & (~chosen | hull.lost | (need > r));
        r = (todo & chosen) ? (hull.lost ? 2 * r : fmin(need, GROWTH * r)) : r;
        if (any(todo))
            keep_hulls(&list, &hull);
    }
    doubt |= todo;
    long failed[LANES], sizes[LANES];
    vstore8(doubt, 0, failed);
    vstore8(need, 0, rs);
    vstore8(hull.sizes, 0, sizes);
    for (int lane = 0; lane < LANES && own + lane < n; ++lane) {
        const int i = items[own + lane];
        if (!wanted[lane])
            continue;
        const int count = failed[lane] ? 0 : sizes[lane];
        int labels[HULL_CAPACITY];
        /* The least label first: label and place in one number. */
        long least = LONG_MAX;
        for (int k = 0; k < count; ++k) {
            const long place = LANE((const long *)list.places, LANE((const long *)hull.at, k, lane), lane);
            labels[k] = place < 0 ? place : items[place];
            least = min(least, (long)labels[k] * HULL_CAPACITY + k);
        }
        const int first = least & (HULL_CAPACITY - 1);
        for (int k = 0; k < count; ++k)
            rows[i * ROW_CAPACITY + k] = labels[first + k < count ? first + k : first + k - count];
        row_counts[i] = count;
        places[i] = i;
        if (count > 0)
            reach[own + lane] = (float)rs[lane];
    }
}
