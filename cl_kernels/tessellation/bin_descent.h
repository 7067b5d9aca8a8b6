/* A walk through nested grids of bins: those that are open, from the root down, and where each was left. */
#include "tessellation/bins.h"

#ifndef MAX_DEPTH
#error "build with -DMAX_DEPTH=levels that the bins may have"
#endif

typedef struct {
    int depth; /* -1 at the end */
    int grids[MAX_DEPTH];
    int4 places[MAX_DEPTH]; /* whatever tells where to go on */
} descent_t;

inline void begin_descent(descent_t *way, int4 start)
{
    way->depth = 0;
    way->grids[0] = 0;
    way->places[0] = start;
}

/* Leave the open grid: for the grid `child` of one of its bins, to come back to `place`; or, if that is negative, for
 *
    good. */
inline void leave_grid(descent_t *way, int child, int4 place, int4 start)
{
    if (child < 0) {
        --way->depth;
        return;
    }
    way->places[way->depth] = place;
    ++way->depth;
    way->grids[way->depth] = child;
    way->places[way->depth] = start;
}

/* The next run of items in the bins from `*next` to `right` of a row, which lie beside each other: all of them if none
   is divided, or if they hold no more than `whole`, for which looking into divided bins costs more than it saves; else
   one bin. `*next` is then what comes behind. Where that one bin is divided and holds more, `*child` is its grid, and
   nothing is in the run. */
inline int2 next_run(global const int2 *row_bins, int *next, int right, int whole, int *child)
{
    const int2 first = row_bins[*next];
    int2 end = row_bins[right + 1];
    if (first.s1 == end.s1 || end.s0 - first.s0 <= whole) {
        *next = right + 1;
    } else {
        end = row_bins[++*next];
        if (first.s1 != end.s1 && end.s0 - first.s0 > whole) {
            *child = first.s1;
            return (int2)(0, 0);
        }
    }
    return (int2)(first.s0, end.s0);
}
