/* Ranges of generators in a few balls in 3D, from the bins that the balls touch, in double precision. */
#include "tessellation/bin_descent.h"

#define RUN_CAPACITY 2048
#define RUN_LENGTH 64 /* one bit of a word per range */
#define WHOLE 64 /* divided bins with at most this many generators are taken whole: opening their grids costs more */

/* Generators by their index in the order of bins: counts[k] of them from firsts[k] on. */
typedef struct {
    int n, total; /* number of ranges; number of generators */
    int firsts[RUN_CAPACITY], counts[RUN_CAPACITY];
} runs_t;

/* Add the generators first .. end - 1. False if there is no room. */
inline bool add_bin_run(runs_t *runs, int first, int end)
{
    runs->total += end - first;
    if (runs->n > 0) {
        const int last = runs->n - 1, room = RUN_LENGTH - runs->counts[last];
        if (runs->firsts[last] + runs->counts[last] == first) {
            const int more = min(end - first, room);
            runs->counts[last] += more;
            first += more;
        }
    }
    for (; first < end; first += RUN_LENGTH) {
        if (runs->n == RUN_CAPACITY)
            return false;
        runs->firsts[runs->n] = first;
        runs->counts[runs->n++] = min(end - first, RUN_LENGTH);
    }
    return true;
}

/* The balls to search. */
typedef struct {
    double8 x, y, z, r;
} balls_t;

inline double least_of(double8 v)
{
    const double4 a = v.lo < v.hi ? v.lo : v.hi;
    const double2 b = a.lo < a.hi ? a.lo : a.hi;
    return b.s0 < b.s1 ? b.s0 : b.s1;
}

/* Distance of rows of bins, from `begin` to `end` on one axis, from y. */
inline double8 gap_to_rows(double8 begin, double8 end, double y)
{
    const double8 below = begin - y, above = y - end, gap = below > above ? below : above;
    return gap > 0 ? gap : 0;
}

/* For eight rows of bins of a grid, restricted to the box [least, most]: the first and last bin that may touch the
   balls. The rows are numbers `pair` and following, layer by layer, with `across` rows per layer, from row low_y and
   layer low_z on. `noise` bounds the distance of positions from their bins. */
inline void span_rows(int *nexts, int *rights, int *offsets, int pair, int pairs, int across, int low_y, int low_z,
                      FRAME frame, int4 shape, const double *xs, const double *ys, const double *zs, const double *rs,
                      double4 least, double4 most, double noise)
{
    const double inverse = FRAME_INVERSE(frame), edge = 1 / inverse;
    /* A square root below is in single precision. */
    const double slack = edge * 1e-6 + noise;
    const int8 pair8 = pair + (int8)(0, 1, 2, 3, 4, 5, 6, 7);
    const int8 layer = convert_int8((convert_float8(pair8) + 0.5f) / across), row = pair8 - layer * across + low_y;
    const double8 begin_y = frame.s1 + convert_double8(row) * edge - slack;
    const double8 begin_z = frame.s2 + convert_double8(layer + low_z) * edge - slack;
    const double8 end_y = begin_y + (edge + 2 * slack), end_z = begin_z + (edge + 2 * slack);
    double8 from = INFINITY, to = -INFINITY;
    for (int ball = 0; ball < 8; ++ball) {
        const double8 gap_y = gap_to_rows(begin_y, end_y, ys[ball]), gap_z = gap_to_rows(begin_z, end_z, zs[ball]);
        const double8 left2 = rs[ball] * rs[ball] - fma(gap_y, gap_y, gap_z * gap_z);
        const long8 there = left2 > 0;
        const double8 span = convert_double8(sqrt(convert_float8(there ? left2 : 0))) * (1 + 1e-6) + slack;
        const double8 left = xs[ball] - span, right = xs[ball] + span;
        from = (there & (left < from)) ? left : from;
        to = (there & (right > to)) ? right : to;
    }
    const long8 some = (to >= from) & convert_long8(pair8 < pairs);
    from = ((from > least.s0 ? from : least.s0) - frame.s0) * inverse;
    to = ((to < most.s0 ? to : most.s0) - frame.s0) * inverse;
    const double last = shape.s1 - 1;
    from = (some & (from > 0)) ? (from < last ? from : last) : 0;
    to = (some & (to > 0)) ? (to < last ? to : last) : 0;
    vstore8(convert_int8(from), 0, nexts);
    vstore8(convert_int8(to) | convert_int8(~some), 0, rights);
    vstore8(shape.s0 + ((layer + low_z) * shape.s2 + row) * shape.s1, 0, offsets);
}

/* Collect all generators in the balls and in the box [least, most], and some others. False if there are more than
   `limit` generators, or too many ranges. */
inline bool collect_runs(runs_t *runs, const balls_t *balls, double4 least, double4 most, int limit, BIN_ARGS)
{
    double xs[8], ys[8], zs[8], rs[8];
    const double8 r = balls->r;
    vstore8(balls->x, 0, xs);
    vstore8(balls->y, 0, ys);
    vstore8(balls->z, 0, zs);
    vstore8(r > 0 ? r : 0, 0, rs);
    least = fmax(least, (double4)(least_of(balls->x - r), least_of(balls->y - r), least_of(balls->z - r), 0));
    most = fmin(most, -(double4)(least_of(-balls->x - r), least_of(-balls->y - r), least_of(-balls->z - r), 0));
    const FRAME root = grid_frames[0];
    const double4 far = fmax(fabs(least), fabs(most));
    const double noise = fmax(fmax(bin_noise(far.s0, root.s0), bin_noise(far.s1, root.s1)), bin_noise(far.s2, root.s2));
    runs->n = runs->total = 0;
    descent_t way; /* position: row and bin */
    begin_descent(&way, (int4)(0));
    while (way.depth >= 0) {
        const int grid = way.grids[way.depth];
        const FRAME frame = grid_frames[grid];
        const int4 shape = grid_shapes[grid];
        const double inverse = FRAME_INVERSE(frame);
        const int low_y = axis_bin(least.s1, frame.s1, inverse, shape.s2);
        const int low_z = axis_bin(least.s2, frame.s2, inverse, shape.s3);
        const int across = axis_bin(most.s1, frame.s1, inverse, shape.s2) - low_y + 1;
        const int pairs = across * (axis_bin(most.s2, frame.s2, inverse, shape.s3) - low_z + 1);
        int pair = way.places[way.depth].s0, next = way.places[way.depth].s1, child = -1;
        while (pair < pairs && child < 0) {
            int nexts[8], rights[8], offsets[8];
            const int first_pair = pair & ~7, end_pair = min(pairs, first_pair + 8);
            span_rows(nexts, rights, offsets, first_pair, pairs, across, low_y, low_z, frame, shape, xs, ys, zs, rs,
                      least, most, noise);
            for (; pair < end_pair; ++pair, next = 0) {
                const int right = rights[pair - first_pair];
                next = max(next, nexts[pair - first_pair]);
                global const int2 *row_bins = bins + offsets[pair - first_pair];
                while (next <= right && child < 0) {
                    const int2 run = next_run(row_bins, &next, right, WHOLE, &child);
                    if (child < 0 && (!add_bin_run(runs, run.s0, run.s1) || runs->total > limit))
                        return false;
                }
                if (child >= 0)
                    break;
            }
        }
        leave_grid(&way, child, (int4)(pair, next, 0, 0), (int4)(0));
    }
    return true;
}
