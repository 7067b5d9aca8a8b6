/* Generators near a rectangle, on a sphere near a box, as items in the order of bins. */
#include "tessellation/bin_descent.h"

#define NEAR_CAPACITY 512
#define NEAR_STEP 16
#define WHOLE 32 /* divided bins with at most this many generators are taken whole */

/* Entries behind the last one have no meaning. */
typedef struct {
    int count;
    int places[NEAR_CAPACITY + NEAR_STEP];
} near_t;

inline bool add_near_run(near_t *near, int first, int end)
{
    const int count = near->count + end - first;
    if (count > NEAR_CAPACITY)
        return false;
    const int16 steps = (int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    for (int *to = near->places + near->count; first < end; first += NEAR_STEP, to += NEAR_STEP)
        vstore16(first + steps, 0, to);
    near->count = count;
    return true;
}

/* Collect the generators in a rectangle or box, and some near it. False if there are too many. */
inline bool collect_near(near_t *near, double4 lower, double4 upper, BIN_ARGS)
{
    descent_t way; /* position: layer, row and bin */
    near->count = 0;
    begin_descent(&way, (int4)(-1));
    while (way.depth >= 0) {
        const int grid = way.grids[way.depth];
        const int4 place = way.places[way.depth];
        const FRAME frame = grid_frames[grid];
        const int4 shape = grid_shapes[grid];
        const double inverse = FRAME_INVERSE(frame);
        const int left = axis_bin(lower.s0, frame.s0, inverse, shape.s1);
        const int right = axis_bin(upper.s0, frame.s0, inverse, shape.s1);
        const int bottom = axis_bin(lower.s1, frame.s1, inverse, shape.s2);
        const int top = axis_bin(upper.s1, frame.s1, inverse, shape.s2);
        const int last = DIM == 2 ? 0 : axis_bin(upper.s2, frame.s2, inverse, shape.s3);
        int layer = place.s0, row = place.s1, next = place.s2, child = -1;
        if (layer < 0) {
            layer = DIM == 2 ? 0 : axis_bin(lower.s2, frame.s2, inverse, shape.s3);
            row = bottom;
            next = left;
        }
        while (layer <= last && child < 0) {
            global const int2 *row_bins = bins + shape.s0 + (layer * shape.s2 + row) * shape.s1;
            while (next <= right && child < 0) {
                const int2 run = next_run(row_bins, &next, right, WHOLE, &child);
                if (child < 0 && !add_near_run(near, run.s0, run.s1))
                    return false;
            }
            if (next > right && child < 0) {
                layer += row == top;
                row = row == top ? bottom : row + 1;
                next = left;
            }
        }
        leave_grid(&way, child, (int4)(layer, row, next, 0), (int4)(-1));
    }
    return true;
}
