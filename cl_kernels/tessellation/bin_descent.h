/* Depth-first traversal of nested grids of bins: a stack of the open grids, with the position reached in each. */
#include "tessellation/bins.h"

#ifndef MAX_DEPTH
#error "build with -DMAX_DEPTH=levels that the bins may have"
#endif

typedef struct {
    int depth; /* -1 at the end */
    int grids[MAX_DEPTH];
    int4 places[MAX_DEPTH]; /* position at which each grid continues */
} descent_t;

inline void begin_descent(descent_t *way, int4 start)
{
    way->depth = 0;
    way->grids[0] = 0;
    way->places[0] = start;
}

/* Push the grid `child` of one of the bins, to continue at `place` afterwards; pop the open grid if child < 0. */
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

/* The next range of items in the bins from `*next` to `right` of a row; `*next` moves behind it. It spans all these
   bins if none is divided or they hold at most `whole` items, for which opening divided bins does not pay. Otherwise it
   is one bin; if that bin is divided and holds more, the range is empty and `*child` is its grid. */
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
