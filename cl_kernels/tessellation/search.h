/* The search for generators that may cut a cell, through the bins around it in space. The file that includes this one
   has defined CELL, FLAG_COINCIDE, and CLIP_BY_ITEM(cell, d, j, warm, points): clip the cell by generator j at x + d,
   whose squared distance is d.s3, and return FLAG_* or 0. In a power diagram it has defined CUTTING_SQUARE(cell), the
   square of the distance beyond which no generator cuts: otherwise twice that of the farthest vertex. */
#include "tessellation/bins.h"

#ifndef MAX_DEPTH
#error "build with -DMAX_DEPTH=levels that the bins may have"
#endif

#define BATCH 256 /* generators that are sorted by distance at a time, at most 256 */
#define SHELLS 32 /* bits of a word */

#ifndef CUTTING_SQUARE
#define CUTTING_SQUARE(cell) (4 * (cell)->reach2)
#endif

/* The arrays to search for neighbors. */
typedef struct {
    global const REAL *points, *binned;
    global const int *items;
    global const int2 *bins;
    global const FRAME *grid_frames;
    global const int4 *grid_shapes;
} search_t;

/* Generators that may cut a cell, as items in bin order; and shells, lists of those at similar distances. */
typedef struct {
    int n;
    int places[BATCH];
    uchar next[BATCH]; /* in the same shell */
    uchar first[SHELLS], last[SHELLS];
} batch_t;

/* The vector from x to the generator of item q, and its squared length. */
inline REAL4 vector_to_item(int q, REAL4 x, const search_t *in)
{
    const REAL dx = in->binned[STRIDE * q] - x.s0, dy = in->binned[STRIDE * q + 1] - x.s1,
               dz = in->binned[STRIDE * q + 2] - x.s2;
    return (REAL4)(dx, dy, dz, dx * dx + dy * dy + dz * dz);
}

/* Clip the cell by a batch of generators, roughly the nearest first: in shells of squared distance 1 / `per_shell`.
   Returns FLAG_* or 0. */
inline int clip_by_batch(CELL *cell, REAL4 x, batch_t *batch, REAL per_shell, bool warm, const search_t *in)
{
    uint shells = 0; /* those with generators */
    SHORT_LOOP
    for (int k = 0; k < batch->n; ++k) {
        const REAL place = vector_to_item(batch->places[k], x, in).s3 * per_shell;
        const int shell = place < SHELLS - 1 ? (int)place : SHELLS - 1;
        const uint known = (shells >> shell) & 1;
        batch->next[known ? batch->last[shell] : k] = k;
        batch->first[shell] = known ? batch->first[shell] : k;
        batch->last[shell] = k;
        shells |= (uint)1 << shell;
    }
    batch->n = 0;
    for (; shells != 0; shells &= shells - 1) {
        const int shell = 31 - (int)clz(shells & -shells);
        const int last = batch->last[shell];
        for (int k = batch->first[shell];; k = batch->next[k]) {
            const int q = batch->places[k];
            const REAL4 d = vector_to_item(q, x, in);
            if (d.s3 < CUTTING_SQUARE(cell)) {
                if (d.s3 == 0)
                    return FLAG_COINCIDE;
                const int flag = CLIP_BY_ITEM(cell, d, in->items[q], warm, in->points);
                if (flag != 0)
                    return flag;
            }
            if (k == last)
                break;
        }
    }
    return 0;
}

/* Bins along one axis that [x - w, x + w] touches. */
inline int2 bin_range(REAL x, REAL w, REAL origin, REAL inverse, int side)
{
    return (int2)(axis_bin(x - w, origin, inverse, side), axis_bin(x + w, origin, inverse, side));
}

/* An open grid: its number, its position (layer, row, part of the row, bin), and whether its bin lies in the inner
 * cube. */
typedef struct {
    int grid, iz, iy, part, bin;
    bool inside;
} open_grid_t;

/* A walk through the grids, and the items that it has found but that are still to be taken. */
typedef struct {
    open_grid_t open[MAX_DEPTH]; /* from the root down */
    int depth, begin, end;
} grid_walk_t;

/* Begin with all bins of a grid, at a depth. */
inline void open_grid(grid_walk_t *walk, int depth, int grid, bool inside)
{
    walk->depth = depth;
    walk->open[depth].grid = grid;
    walk->open[depth].part = 0;
    walk->open[depth].iz = walk->open[depth].iy = walk->open[depth].bin = -1;
    walk->open[depth].inside = inside;
}

/* Find the next items in the bins within the cube of half-width w but outside the cube of half-width `inner` (inner <
   0: no bin has been searched), except in bins farther than the root of `cut2`. False if there are no more.

   Nothing but the position is kept from call to call: a work-item of a GPU needs its registers to clip. */
inline bool find_items(grid_walk_t *walk, REAL4 x, REAL w, REAL inner, REAL cut2, const search_t *in)
{
    const REAL noise_y = bin_noise(x.s1, in->grid_frames[0].s1), noise_z = bin_noise(x.s2, in->grid_frames[0].s2);
    while (walk->depth >= 0) {
        open_grid_t here = walk->open[walk->depth];
        const FRAME frame = in->grid_frames[here.grid];
        const int4 shape = in->grid_shapes[here.grid];
        const REAL inverse = FRAME_INVERSE(frame), edge = 1 / inverse;
        const int2 ys = bin_range(x.s1, w, frame.s1, inverse, shape.s2);
        const int2 zs = bin_range(x.s2, w, frame.s2, inverse, shape.s3);
        /* The bins of the inner cube. */
        int2 done_x = (int2)(0, -1), done_y = done_x, done_z = done_x;
        if (here.inside) {
            done_x = bin_range(x.s0, inner, frame.s0, inverse, shape.s1);
            done_y = bin_range(x.s1, inner, frame.s1, inverse, shape.s2);
            done_z = bin_range(x.s2, inner, frame.s2, inverse, shape.s3);
        }
        int child = -1;
        bool inside = false;
        for (here.iz = max(here.iz, zs.s0); here.iz <= zs.s1 && child < 0; ++here.iz, here.iy = -1) {
            const REAL away_z = row_distance(x.s2, frame.s2, edge, here.iz, edge * BIN_SHARE + noise_z);
            const bool layer_done = here.iz >= done_z.s0 && here.iz <= done_z.s1;
            for (here.iy = max(here.iy, ys.s0); here.iy <= ys.s1; ++here.iy, here.part = 0, here.bin = -1) {
                const REAL away_y = row_distance(x.s1, frame.s1, edge, here.iy, edge * BIN_SHARE + noise_y);
                const REAL left2 = cut2 - away_y * away_y - away_z * away_z;
                if (!(left2 > 0))
                    continue;
                const REAL span = left2 < w * w ? sqrt(left2) * (1 + 8 * REAL_EPS) + edge * R(1e-6) : w;
                const int2 xs = bin_range(x.s0, span, frame.s0, inverse, shape.s1);
                global const int2 *row_bins = in->bins + shape.s0 + (here.iz * shape.s2 + here.iy) * shape.s1;
                /* Parts of a row: left of the searched bins, these (only grids below may hold more), right of them. */
                const bool row_done = layer_done && here.iy >= done_y.s0 && here.iy <= done_y.s1;
                while (here.part < 3) {
                    int from = xs.s0, to = xs.s1;
                    if (row_done) {
                        from = here.part == 0 ? from : max(from, here.part == 1 ? done_x.s0 : done_x.s1 + 1);
                        to = here.part == 2 ? to : min(to, here.part == 0 ? done_x.s0 - 1 : done_x.s1);
                    }
                    from = max(here.bin, from);
                    if (from > to) {
                        here.part = row_done ? here.part + 1 : 3;
                        here.bin = -1;
                        continue;
                    }
                    /* Adjacent leaves are a contiguous range of items. */
                    const int2 first = row_bins[from];
                    int2 end = row_bins[to + 1];
                    here.bin = to + 1;
                    if (first.s1 != end.s1) {
                        /* Divided bins follow: one bin at a time. */
                        end = row_bins[from + 1];
                        here.bin = from + 1;
                        if (first.s1 != end.s1) {
                            child = first.s1;
                            break;
                        }
                    }
                    if ((here.part == 1 && row_done) || first.s0 >= end.s0)
                        continue;
                    walk->begin = first.s0;
                    walk->end = end.s0;
                    walk->open[walk->depth] = here;
                    return true;
                }
                if (child >= 0) {
                    inside = here.part == 1 && row_done;
                    walk->open[walk->depth] = here;
                    break;
                }
            }
        }
        if (child >= 0)
            open_grid(walk, walk->depth + 1, child, inside);
        else
            --walk->depth;
    }
    return false;
}

/* Clip the cell of item `own` by all generators that `find_items` finds, except those farther than twice the farthest
   vertex. Returns FLAG_* or 0. */
inline int clip_cell_by_bins(CELL *cell, REAL4 x, int own, REAL w, REAL inner, bool warm, const search_t *in)
{
    const REAL per_shell = SHELLS / (6 * w * w);
    grid_walk_t walk;
    open_grid(&walk, 0, 0, inner >= 0);
    walk.begin = walk.end = 0;
    batch_t batch;
    batch.n = 0;
    bool more = true;
    while (more) {
        while (batch.n < BATCH) {
            if (walk.begin == walk.end && !(more = find_items(&walk, x, w, inner, CUTTING_SQUARE(cell), in)))
                break;
            const int stop = min(walk.end, walk.begin + BATCH - batch.n);
            const REAL limit = CUTTING_SQUARE(cell);
            int n = batch.n;
            SHORT_LOOP
            for (int q = walk.begin; q < stop; ++q) {
                batch.places[n] = q;
                n += vector_to_item(q, x, in).s3 < limit && q != own;
            }
            batch.n = n;
            walk.begin = stop;
        }
        const int flag = clip_by_batch(cell, x, &batch, per_shell, warm, in);
        if (flag != 0)
            return flag;
    }
    return 0;
}
