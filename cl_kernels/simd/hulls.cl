#include "simd/candidates.h"
#include "simd/hull.h"

/* The cells of eight generators at a time, one per vector lane, as hulls (simd/hull.h): for CPUs.

   If a decision is near round-off, or a capacity is exceeded, the cell is left to `clip_polygons` (cells.cl). Both give
   the same rows. */

/* Lanes share a search if they are within this many spacings: a batch may span the end of a row of bins. */
#define SPREAD 20
#ifndef EIGHTS
#error "build with -DEIGHTS=eights of cells that a work-item does"
#endif
/* The first search radius of a batch: the mean of the radii that earlier batches needed, plus WIDTH standard
   deviations. Their weight decays by MEMORY from batch to batch. */
#define WIDTH 2.4
#define MEMORY 0.75
#define GROWTH 1.4 /* growth of the radius per round: twice the area */
#define MAX_ROUNDS 10

/* Reduce the lists of the wrapped lanes to the corners of the hulls (to nothing if a hull is invalid), those of the
   others to the first `kept` candidates. Returns the new numbers. */
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

/* Lanes whose coordinate x is within `far` of that of lane `first`. */
inline long8 near_lane(double8 x, int first, double far)
{
    double xs[LANES];
    vstore8(x, 0, xs);
    return fabs(x - xs[first]) <= far;
}

/* The least x - slack of the chosen lanes. */
inline double least_beyond(long8 chosen, double8 x, double8 slack)
{
    return min_lane(chosen ? x - slack : DBL_MAX);
}

/* Choose the lanes near the first one; the rectangle, or box, holds everything within r of them. */
inline long8 choose_lanes(long8 todo, const eight_t *sites, double8 r, double8 far_away, double4 *lower, double4 *upper)
{
    long wanted[LANES];
    double fars[LANES];
    vstore8(todo, 0, wanted);
    vstore8(far_away, 0, fars);
    int first = 0;
    while (!wanted[first])
        ++first;
    const double far = fars[first];
    const long8 lanes = (long8)(0, 1, 2, 3, 4, 5, 6, 7);
    const double8 x = sites->x, y = sites->y, slack = r * (1 + 1e-6);
    long8 near = near_lane(x, first, far) & near_lane(y, first, far);
#ifdef SPHERE
    const double8 z = sites->z;
    near &= near_lane(z, first, far);
#else
    const double8 z = 0;
#endif
    const long8 chosen = todo & ((lanes == first) | near);
    *lower =
        (double4)(least_beyond(chosen, x, slack), least_beyond(chosen, y, slack), least_beyond(chosen, z, slack), 0);
    *upper = -(double4)(least_beyond(chosen, -x, slack), least_beyond(chosen, -y, slack),
                        least_beyond(chosen, -z, slack), 0);
    return chosen;
}

/* Write the rows of some lanes, from item `own` on; see `clip_polygons`. */
inline void write_rows(const hull_t *hull, long8 lanes, double8 need, int own, global const int *items,
                       global float *reach, global int *slots, global int *slot_counts)
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
        for (int k = 0; k < count; ++k) {
            const int place = LANE((const int *)hull->places, k, lane);
            labels[k] = place < 0 ? place : items[place];
        }
        write_labels(labels, count, slots + i * SLOT);
        slot_counts[i] = count;
        reach[own + lane] = (float)radii[lane];
    }
}

/* Final search radii in units of the spacing: count, sum and sum of squares, per lane. */
typedef struct {
    double8 number, sum, squares;
} needs_t;

inline void note_needs(needs_t *needs, long8 lanes, double8 need)
{
    needs->number += lanes ? (double8)1 : 0;
    needs->sum += lanes ? need : 0;
    needs->squares += lanes ? need * need : 0;
}

/* The first search radius, at most `most`. */
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

/* Per EIGHTS batches of eight items in bin order: the rows of their generators (see `clip_polygons`), or slot_counts[i]
   = 0 for a cell that remains to be clipped. `first_reach` bounds the first search radius, in units of the spacing.
   Only the first `rows` generators get rows. */
kernel void wrap_all_hulls(const int size, const int n, const int rows, global const double *binned,
                           global const int *items, global const float *spacing, global float *reach, BIN_ARGS,
                           const double4 box_lower, const double4 box_upper, const double first_reach,
                           global int *slots, global int *slot_counts, global int *places)
{
    WORK_ITEM(group);
    needs_t needs = {0, 0, 0};
    for (int own = group * EIGHTS * LANES; own < min((group + 1) * EIGHTS * LANES, n); own += LANES) {
        double spacings[LANES];
        long wanted[LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            const int p = min(own + lane, n - 1), i = items[p];
            const bool is_wanted = own + lane < n && i < rows;
            wanted[lane] = is_wanted ? -1 : 0;
            spacings[lane] = spacing[p];
            if (is_wanted) {
                slot_counts[i] = 0;
                places[i] = i;
            }
        }
        const eight_t sites = load_sites(own, n, binned);
        near_t near;
        list_t list;
        hull_t hull;
        list.length = 0;
        list.largest2 = 0;
        list.nearest = 0;
        int kept = 0;
        /* The list holds all possible neighbors nearer than `done`; now those nearer than `r` are added. */
        const double8 unit = vload8(0, spacings);
        double8 done2 = 0, r = first_look(&needs, first_reach) * unit;
        long8 todo = vload8(0, wanted), walled = 0;
        for (int round = 0; any_lane(todo) && round < MAX_ROUNDS; ++round) {
            double4 lower, upper;
            long8 lanes = choose_lanes(todo, &sites, r, SPREAD * unit, &lower, &upper), doubt = 0;
            bool fits = collect_near(&near, lower, upper, bins, grid_frames, grid_shapes);
            for (int attempt = 0; !fits && attempt < 4; ++attempt) {
                lanes = choose_lanes(todo, &sites, r, attempt == 0 ? 2 * unit : 0, &lower, &upper);
                r = (lanes & (done2 == 0) & (attempt > 1 ? -1L : 0L)) ? r / 2 : r;
                fits = collect_near(&near, lower, upper, bins, grid_frames, grid_shapes);
            }
            if (!fits) {
                todo &= ~lanes;
                continue;
            }
#ifndef SPHERE
            if (any(lower.s01 < box_lower.s01) || any(upper.s01 > box_upper.s01)) {
                add_walls(&list, sites.x, sites.y, lanes & ~walled, box_lower, box_upper, &doubt);
                walled |= lanes;
            }
#endif
            const double8 to2 = add_near(&list, &near, binned, own, &sites, lanes, done2, r * r, &doubt);
            r = (lanes & (to2 < r * r)) ? sqrt(to2) : r;
            pad_list(&list);
            wrap_hulls(&hull, &list, lanes);
            double8 reach2, least;
            measure_hulls(&hull, &list, &reach2, &least);
            doubt |= is_uncertain(&hull, &list, reach2, least);
            const double8 need = 2 * sqrt(reach2) * (1 + 8 * DBL_EPSILON);
            const long8 again = lanes & ~doubt & (hull.lost | (need > r));
            write_rows(&hull, lanes & ~doubt & ~again, need, own, items, reach, slots, slot_counts);
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
