/* Runs of generators near a few others in 3D, from the bins that a box about these covers, in double precision. */
#include "common/descent.h"

#define RUN_CAPACITY 256
#define RUN_LENGTH 64 /* a bit of a word for each */

/* Generators by their places in the order of bins: counts[k] of them from firsts[k] on. */
typedef struct {
    int n, total; /* runs; generators */
    int firsts[RUN_CAPACITY], counts[RUN_CAPACITY];
} runs_t;

/* Add the generators at places first .. end - 1. False if there is no room. */
inline bool add_run(runs_t *runs, int first, int end)
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

/* How far the rows of bins number `row` are from [lower, upper] on one axis; a little less, as positions are put into
   bins with rounding. */
inline double gap_to_row(double lower, double upper, double origin, double edge, int row)
{
    const double begin = origin + row * edge, slack = edge * 1e-6;
    return fmax(fmax(begin - upper, lower - (begin + edge)) - slack, 0.0);
}

/* Collect all that is within `r` of the box [lower, upper], and some more. False if that is too much. */
inline bool collect_runs(runs_t *runs, double4 lower, double4 upper, double r, global const int2 *bins,
                         global const FRAME *grid_frames, global const int4 *grid_shapes)
{
    descent_t way; /* through layers, rows and bins */
    runs->n = runs->total = 0;
    begin_descent(&way, (int4)(-1));
    while (way.depth >= 0) {
        const int grid = way.grids[way.depth];
        const int4 place = way.places[way.depth];
        const FRAME frame = grid_frames[grid];
        const int4 shape = grid_shapes[grid];
        const double inverse = FRAME_INVERSE(frame), edge = 1 / inverse;
        const int low_y = axis_bin(lower.s1 - r, frame.s1, inverse, shape.s2);
        const int high_y = axis_bin(upper.s1 + r, frame.s1, inverse, shape.s2);
        const int high_z = axis_bin(upper.s2 + r, frame.s2, inverse, shape.s3);
        int layer = place.s0, row = place.s1, next = place.s2, child = -1;
        if (layer < 0)
            layer = axis_bin(lower.s2 - r, frame.s2, inverse, shape.s3);
        for (; layer <= high_z && child < 0; ++layer, row = -1) {
            const double gap_z = gap_to_row(lower.s2, upper.s2, frame.s2, edge, layer);
            for (row = max(row, low_y); row <= high_y; ++row, next = -1) {
                const double gap_y = gap_to_row(lower.s1, upper.s1, frame.s1, edge, row);
                const double left2 = r * r - gap_y * gap_y - gap_z * gap_z;
                if (!(left2 > 0))
                    continue;
                const double span = sqrt(left2) + edge * 1e-6;
                const int right = axis_bin(upper.s0 + span, frame.s0, inverse, shape.s1);
                next = max(next, axis_bin(lower.s0 - span, frame.s0, inverse, shape.s1));
                global const int2 *row_bins = bins + shape.s0 + (layer * shape.s2 + row) * shape.s1;
                while (next <= right) {
                    /* A run of leaves beside each other is a run of items; where there are divided bins ahead, one bin.
                     */
                    const int2 first = row_bins[next];
                    int2 end = row_bins[right + 1];
                    if (first.s1 == end.s1) {
                        next = right + 1;
                    } else {
                        end = row_bins[++next];
                        if (first.s1 != end.s1) {
                            child = first.s1;
                            break;
                        }
                    }
                    if (!add_run(runs, first.s0, end.s0))
                        return false;
                }
                if (child >= 0)
                    break;
            }
            if (child >= 0)
                break;
        }
        leave_grid(&way, child, (int4)(layer, row, next, 0), (int4)(-1));
    }
    return true;
}
