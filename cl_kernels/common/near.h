/* Generators in a rectangle, collected from the bins that it covers, in double precision. */
#include "common/bins.h"

#ifndef MAX_DEPTH
#error "build with -DMAX_DEPTH=levels that the bins may have"
#endif
#define NEAR_CAPACITY 384

/* Generators by their places in the order of bins. */
typedef struct {
    int count;
    double x[NEAR_CAPACITY], y[NEAR_CAPACITY];
    int places[NEAR_CAPACITY];
} near_t;

/* Collect the generators in a rectangle. False if they are too many. */
inline bool collect_near(near_t *near, double2 lower, double2 upper, global const double *binned, global const int2 *bins,
                         global const FRAME *grid_frames, global const int4 *grid_shapes)
{
    /* The grids that are open, from the root down, and the row and bin at which each was left. */
    int grids[MAX_DEPTH], rows[MAX_DEPTH], nexts[MAX_DEPTH];
    int depth = 0, count = 0;
    grids[0] = 0;
    rows[0] = -1;
    while (depth >= 0) {
        const FRAME frame = grid_frames[grids[depth]];
        const int4 shape = grid_shapes[grids[depth]];
        const double inverse = FRAME_INVERSE(frame);
        const int left = axis_bin(lower.s0, frame.s0, inverse, shape.s1);
        const int right = axis_bin(upper.s0, frame.s0, inverse, shape.s1);
        const int top = axis_bin(upper.s1, frame.s1, inverse, shape.s2);
        int row = rows[depth], next = nexts[depth], child = -1;
        if (row < 0) {
            row = axis_bin(lower.s1, frame.s1, inverse, shape.s2);
            next = left;
        }
        while (row <= top && child < 0) {
            global const int2 *row_bins = bins + shape.s0 + row * shape.s1;
            while (next <= right && child < 0) {
                /* A run of leaves beside each other is a run of items; where there are divided bins ahead, one bin. */
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
                if (count + end.s0 - first.s0 > NEAR_CAPACITY)
                    return false;
                for (int q = first.s0; q < end.s0; ++q) {
                    const double x = binned[2 * q], y = binned[2 * q + 1];
                    near->x[count] = x;
                    near->y[count] = y;
                    near->places[count] = q;
                    count += (x >= lower.s0) & (x <= upper.s0) & (y >= lower.s1) & (y <= upper.s1);
                }
            }
            if (next > right) {
                ++row;
                next = left;
            }
        }
        if (child >= 0) {
            rows[depth] = row;
            nexts[depth] = next;
            ++depth;
            grids[depth] = child;
            rows[depth] = -1;
        } else {
            --depth;
        }
    }
    near->count = count;
    return true;
}
