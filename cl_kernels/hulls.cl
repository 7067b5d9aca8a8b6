#include "common/candidates.h"

/* The cells of eight generators at a time, one in each lane of vectors: for CPUs.

   Invert every generator at d from x in a circle about x: p = d / |d|^2. The half-plane y.d <= |d|^2 / 2 is y.p <= 1/2,
   so the neighbours of x are the corners of the convex hull of all p, and the corners of its cell belong to the hull's
   edges. A wall is the bisector with the mirror image. The hull is wrapped from the nearest generator on: of all
   candidates the next one is that which has none to its right. These are the same steps in every lane.

   Where any decision is near to rounding, or something does not fit, a cell is left to be clipped (`cells.cl`): rows do
   not depend on which of the two has made them. */

/* Faces of a cell. */
#define HULL_CAPACITY 16
/* Lanes are searched for together if they are within so many spacings: rows of bins end within an eight. */
#define SPREAD 20
#ifndef EIGHTS
#error "build with -DEIGHTS=eights of cells that a work-item does"
#endif
/* A work-item learns from each eight how far the next should look at first: as far as has been needed in the mean, and
   WIDTH standard deviations more. What it has learned fades by MEMORY from eight to eight. */
#define WIDTH 2.4
#define MEMORY 0.75
#define GROWTH 1.4 /* of the radius, from round to round: twice the area */
#define MAX_ROUNDS 10

/* A turn is certain if it is more than this share of the largest p^2: hundreds of times the rounding of p and of the
 * turn. */
#define TURN_ROUNDING 1e-13
/* A cell is certain if it is far from what `is_doubtful` (common/polygon.h) calls doubtful: least square of a face's
   length over that of its generator's distance; largest square of the reach over that of the least distance; least
   square of that. */
#define CERTAIN_FACE2 1e-9
#define CERTAIN_RATIO2 3e7
#define CERTAIN_DISTANCE2 1e-16

/* Per lane the corners of a hull, counter-clockwise: inverted positions, which of the candidates they are, and
   their places. Hulls with fewer than `steps` corners begin again behind the last. */
typedef struct {
    int steps;
    double8 x[HULL_CAPACITY + 1], y[HULL_CAPACITY + 1];
    long8 at[HULL_CAPACITY + 1];
    int8 places[HULL_CAPACITY];
    long8 sizes, doubt, lost; /* corners; is a decision near to rounding; does the hull leave out x? */
} hull_t;

/* A candidate on the right of which none has been found yet: its direction from the hull's last corner, and its number.
 */
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
    hull->at[steps] = from;
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
   edge, or so near to it that rounding may decide. */
inline void measure_hulls(hull_t *hull, const list_t *list, double8 *reach2, double8 *least)
{
    double8 x = 0, y = 0, first_x = 0, first_y = 0;
    long8 outside = 0;
    *reach2 = 0;
    *least = 1;
    for (int k = 0; k < hull->steps; ++k) {
        const double8 ax = hull->x[k], ay = hull->y[k], bx = hull->x[k + 1], by = hull->y[k + 1];
        const double8 scale = 0.5 / fma(ax, by, -ay * bx);
        const double8 before_x = x, before_y = y;
        x = (by - ay) * scale;
        y = (ax - bx) * scale;
        *reach2 = max(*reach2, fma(x, x, y * y));
        if (k > 0) {
            const double8 ex = x - before_x, ey = y - before_y;
            *least = min(*least, fma(ex, ex, ey * ey) * fma(ax, ax, ay * ay));
        } else {
            first_x = x;
            first_y = y;
        }
        const double8 bound = 0.5 - TURN_ROUNDING * list->largest2 * scale;
        for (int c = 0; c < list->length; c += CHAINS)
            _Pragma("unroll") for (int chain = 0; chain < CHAINS; ++chain) outside =
                fma(list->x[c + chain], x, list->y[c + chain] * y) > bound ? outside + COUNT : outside;
    }
    hull->doubt |= outside != 2 * COUNT * hull->steps;
    /* The largest hulls have not begun again. */
    const double8 ex = first_x - x, ey = first_y - y, ax = hull->x[0], ay = hull->y[0];
    const double8 ratio = fma(ex, ex, ey * ey) * fma(ax, ax, ay * ay);
    *least = hull->sizes == hull->steps ? min(*least, ratio) : *least;
}

/* Cut the lists to the corners of the hulls in the lanes that were wrapped, to nothing where a hull is lost, and to the
   `kept` first candidates in the others. Returns how many are kept now. */
inline int keep_hulls(list_t *list, const hull_t *hull, long8 wrapped, int kept)
{
    const long8 sizes = wrapped ? (hull->lost ? 0 : hull->sizes) : kept;
    const int most = max_lane(sizes);
    for (int k = 0; k < most; ++k) {
        const long8 moved = wrapped & (k < sizes), stays = ~wrapped & (k < sizes);
        list->x[k] = moved ? hull->x[k] : (stays ? list->x[k] : NAN);
        list->y[k] = moved ? hull->y[k] : (stays ? list->y[k] : NAN);
        list->places[k] = convert_int8(moved) ? hull->places[k] : list->places[k];
    }
    list->length = most;
    list->largest2 = wrapped & hull->lost ? 0 : list->largest2;
    list->nearest = wrapped ? 0 : list->nearest;
    return most;
}

/* Choose from the lanes to do those near the first of them, no farther than what it calls far; the rectangle is to hold
   all that is within r of them. */
inline long8 choose_lanes(long8 todo, double8 x, double8 y, double8 r, double8 far_away, double2 *lower, double2 *upper)
{
    long wanted[LANES];
    double xs[LANES], ys[LANES], fars[LANES];
    vstore8(todo, 0, wanted);
    vstore8(x, 0, xs);
    vstore8(y, 0, ys);
    vstore8(far_away, 0, fars);
    int first = 0;
    while (!wanted[first])
        ++first;
    const double far = fars[first];
    const long8 lanes = (long8)(0, 1, 2, 3, 4, 5, 6, 7);
    const long8 chosen = todo & ((lanes == first) | ((fabs(x - xs[first]) <= far) & (fabs(y - ys[first]) <= far)));
    const double8 slack = r * (1 + 1e-6);
    *lower = (double2)(min_lane(chosen ? x - slack : DBL_MAX), min_lane(chosen ? y - slack : DBL_MAX));
    *upper = -(double2)(min_lane(chosen ? -x - slack : DBL_MAX), min_lane(chosen ? -y - slack : DBL_MAX));
    return chosen;
}

/* Write the rows of some lanes, whose first place is `own`; see `clip_cells`. */
inline void write_rows(const hull_t *hull, long8 lanes, double8 need, int own, global const int *items,
                       global float *reach, global int *rows, global int *row_counts)
{
    long written[LANES], sizes[LANES];
    double radii[LANES];
    vstore8(lanes, 0, written);
    vstore8(hull->sizes, 0, sizes);
    vstore8(need, 0, radii);
    for (int lane = 0; lane < LANES; ++lane) {
        if (!written[lane])
            continue;
        const int i = items[own + lane], count = sizes[lane];
        int labels[HULL_CAPACITY];
        /* The least label first: label and place in one number. */
        long least = LONG_MAX;
        for (int k = 0; k < count; ++k) {
            const int place = LANE((const int *)hull->places, k, lane);
            labels[k] = place < 0 ? place : items[place];
            least = min(least, (long)labels[k] * HULL_CAPACITY + k);
        }
        const int first = least & (HULL_CAPACITY - 1);
        for (int k = 0; k < count; ++k)
            rows[i * ROW_CAPACITY + k] = labels[first + k < count ? first + k : first + k - count];
        row_counts[i] = count;
        reach[own + lane] = (float)radii[lane];
    }
}

/* How far cells have looked in the end, in spacings: their number, sum and sum of squares, lane by lane. */
typedef struct {
    double8 number, sum, squares;
} needs_t;

inline void note_needs(needs_t *needs, long8 lanes, double8 need)
{
    needs->number += lanes ? (double8)1 : 0;
    needs->sum += lanes ? need : 0;
    needs->squares += lanes ? need * need : 0;
}

/* How far to look at first, at most `most`. */
inline double first_look(needs_t *needs, double most)
{
    const double number = sum_lanes(needs->number);
    if (number < LANES / 2)
        return most;
    const double mean = sum_lanes(needs->sum) / number;
    const double variance = max(sum_lanes(needs->squares) / number - mean * mean, 0.0);
    needs->number *= MEMORY;
    needs->sum *= MEMORY;
    needs->squares *= MEMORY;
    return min(mean + WIDTH * sqrt(variance), most);
}

/* Per eight places in bin order: the rows of the generators there (see `clip_cells`), or row_counts[i] = 0 where a cell
   is left to be clipped. `first_reach` is how far the first lists go at most, in units of the spacing. Only the first
   `rows_wanted` generators get rows. */
kernel void wrap_cells(const int size, const int n, const int rows_wanted, global const double *binned,
                       global const int *items, global const float *spacing, global float *reach,
                       global const int2 *bins, global const FRAME *grid_frames, global const int4 *grid_shapes,
                       const double4 box_lower, const double4 box_upper, const double first_reach, global int *rows,
                       global int *row_counts, global int *places)
{
    WORK_ITEM(group);
    needs_t needs = {0, 0, 0};
    for (int own = group * EIGHTS * LANES; own < min((group + 1) * EIGHTS * LANES, n); own += LANES) {
        double xs[LANES], ys[LANES], spacings[LANES];
        long wanted[LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            const int p = min(own + lane, n - 1), i = items[p];
            const bool is_wanted = own + lane < n && i < rows_wanted;
            wanted[lane] = is_wanted ? -1 : 0;
            xs[lane] = binned[2 * p];
            ys[lane] = binned[2 * p + 1];
            spacings[lane] = spacing[p];
            if (is_wanted) {
                row_counts[i] = 0;
                places[i] = i;
            }
        }
        const double8 x = vload8(0, xs), y = vload8(0, ys);
        near_t near;
        list_t list;
        hull_t hull;
        list.length = 0;
        list.largest2 = 0;
        list.nearest = 0;
        int kept = 0;
        /* Of the generators nearer than `done` all are in the list that can be neighbours; now those nearer than `r`
         * are added. */
        const double8 unit = vload8(0, spacings);
        double8 done2 = 0, r = first_look(&needs, first_reach) * unit;
        long8 todo = vload8(0, wanted), walled = 0;
        for (int round = 0; any_lane(todo) && round < MAX_ROUNDS; ++round) {
            double2 lower, upper;
            long8 lanes = choose_lanes(todo, x, y, r, SPREAD * unit, &lower, &upper), doubt = 0;
            bool fits = collect_near(&near, lower, upper, bins, grid_frames, grid_shapes);
            for (int attempt = 0; !fits && attempt < 4; ++attempt) {
                lanes = choose_lanes(todo, x, y, r, attempt == 0 ? 2 * unit : 0, &lower, &upper);
                r = (lanes & (done2 == 0) & (attempt > 1 ? -1L : 0L)) ? r / 2 : r;
                fits = collect_near(&near, lower, upper, bins, grid_frames, grid_shapes);
            }
            if (!fits) {
                todo &= ~lanes;
                continue;
            }
            if (any(lower < box_lower.s01) || any(upper > box_upper.s01)) {
                add_walls(&list, x, y, lanes & ~walled, box_lower, box_upper, &doubt);
                walled |= lanes;
            }
            const double8 to2 = add_near(&list, &near, binned, own, x, y, lanes, done2, r * r, &doubt);
            r = (lanes & (to2 < r * r)) ? sqrt(to2) : r;
            pad_list(&list);
            wrap_hulls(&hull, &list, lanes);
            double8 reach2, least;
            measure_hulls(&hull, &list, &reach2, &least);
            doubt |= !(list.largest2 < 1 / CERTAIN_DISTANCE2);
            doubt |= ~hull.lost & (hull.doubt | !(least > CERTAIN_FACE2) | !(list.largest2 * reach2 < CERTAIN_RATIO2));
            const double8 need = 2 * sqrt(reach2) * (1 + 8 * DBL_EPSILON);
            const long8 again = lanes & ~doubt & (hull.lost | (need > r));
            write_rows(&hull, lanes & ~doubt & ~again, need, own, items, reach, rows, row_counts);
            note_needs(&needs, lanes & ~doubt & ~again, need / unit);
            todo = (todo & ~lanes) | again;
            if (!any_lane(todo))
                break;
            done2 = hull.lost ? 0 : (lanes ? to2 : done2);
            walled &= ~hull.lost;
            r = again ? (hull.lost ? 2 * r : fmin(need, GROWTH * r)) : r;
            kept = keep_hulls(&list, &hull, lanes, kept);
        }
    }
}
