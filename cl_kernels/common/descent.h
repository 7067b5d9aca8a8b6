/* A walk through nested grids of bins: those that are open, from the root down, and where each was left. */
#include "common/bins.h"

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
 * good.
 */
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
