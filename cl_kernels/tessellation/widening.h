/* The search for generators that may cut a cell in 2D, through the bins around it. */
#include "tessellation/bin_descent.h"
#include "tessellation/face_rows.h"

/* Only searches over more than WIDE bins to each side bound the range of each row. */
#define WIDE 4

/* Range of x, relative to the generator, in which a row of bins may hold generators that cut the cell: the circles
   around the corners through the generator, widened by the round-off. In a power diagram the circles are wider or
   narrower by the difference of weights. */
inline REAL2 row_extent(const cell_t *cell, REAL below, REAL above)
{
    REAL2 extent = (REAL2)(REAL_MAX, -REAL_MAX);
    for (int k = 0; k < cell->n; ++k) {
        const REAL x = cell->x[k], y = cell->y[k];
#ifdef WEIGHTED
        const REAL radius2 = (x * x + y * y) * R(1.01) + cell->most;
#else
        const REAL radius2 = (x * x + y * y) * R(1.01);
#endif
        const REAL away = y < below ? below - y : (y > above ? y - above : 0);
        if (away * away < radius2) {
            const REAL half_chord = sqrt(radius2 - away * away);
            extent = (REAL2)(fmin(extent.s0, x - half_chord), fmax(extent.s1, x + half_chord));
        }
    }
    return extent;
}

/* Clip the cell of item `own` by all generators in the bins within the square of half-width w but outside the square of
   half-width `inner` (inner < 0: no bin has been searched), except those farther than twice the farthest corner. Rows
   are searched from x outwards, as near generators cut most. Returns FLAG_* or 0. */
inline int clip_polygon_by_bins(cell_t *cell, const REAL *x, int own, REAL w, REAL inner, global const REAL *points,
                                global const REAL *binned, global const int *items, BIN_ARGS)
{
    /* Through rows in outward order, parts of rows, bins; and whether the grid's own bin was opened for the inner
       square. */
    const REAL noise = bin_noise(x[1], grid_frames[0].s1);
    descent_t way;
    begin_descent(&way, (int4)(0, 0, -1, inner >= 0));
    while (way.depth >= 0) {
        const int grid = way.grids[way.depth];
        const int4 place = way.places[way.depth];
        const FRAME frame = grid_frames[grid];
        const int4 shape = grid_shapes[grid];
        const REAL inverse = FRAME_INVERSE(frame), edge = 1 / inverse, slack = edge * BIN_SHARE + noise;
        const int left = axis_bin(x[0] - w, frame.s0, inverse, shape.s1);
        const int right = axis_bin(x[0] + w, frame.s0, inverse, shape.s1);
        const int bottom = axis_bin(x[1] - w, frame.s1, inverse, shape.s2);
        const int top = axis_bin(x[1] + w, frame.s1, inverse, shape.s2);
        const int middle = axis_bin(x[1], frame.s1, inverse, shape.s2);
        /* The columns and rows of the inner square. */
        int4 done = (int4)(0, -1, 0, -1);
        if (place.s3)
            done = (int4)(axis_bin(x[0] - inner, frame.s0, inverse, shape.s1),
                          axis_bin(x[0] + inner, frame.s0, inverse, shape.s1),
                          axis_bin(x[1] - inner, frame.s1, inverse, shape.s2),
                          axis_bin(x[1] + inner, frame.s1, inverse, shape.s2));
        const int last_turn = 2 * max(middle - bottom, top - middle);
        int turn = place.s0, part = place.s1, ix = place.s2;
        int child = -1;
        bool inside = false; /* whether that lies in a searched bin */
        while (turn <= last_turn) {
            const int row = turn & 1 ? middle + (turn + 1) / 2 : middle - turn / 2;
            const REAL away = row_distance(x[1], frame.s1, edge, row, slack);
            if (row < bottom || row > top || away * away >= cutting_distance2(cell)) {
                ++turn;
                part = 0;
                ix = -1;
                continue;
            }
            /* Parts of a row: left of the searched bins, these (only grids below may hold more), right of them. */
            const bool row_done = row >= done.s2 && row <= done.s3;
            global const int2 *row_bins = bins + shape.s0 + row * shape.s1;
            int least = left, most = right;
            if (w > WIDE * edge) {
                const REAL below = frame.s1 + row * edge - x[1], wider = R(0.01) * edge + noise;
                const REAL2 extent = row_extent(cell, below - wider, below + edge + wider);
                least = max(least, axis_bin(x[0] + extent.s0, frame.s0, inverse, shape.s1));
                most = min(most, axis_bin(x[0] + extent.s1, frame.s0, inverse, shape.s1));
            }
            while (part < 3 && child < 0) {
                const int from = max(least, part == 0 ? left : (part == 1 ? done.s0 : done.s1 + 1));
                const int to = min(most, !row_done || part == 2 ? right : (part == 0 ? done.s0 - 1 : done.s1));
                const int bin = max(ix, from);
                if (bin > to) {
                    part = row_done ? part + 1 : 3;
                    ix = -1;
                    continue;
                }
                /* Adjacent leaves are a contiguous range of items. */
                int2 first = row_bins[bin], end = row_bins[to + 1];
                ix = to + 1;
                if (first.s1 != end.s1) {
                    /* Divided bins follow: one bin at a time. */
                    end = row_bins[bin + 1];
                    ix = bin + 1;
                    if (first.s1 != end.s1) {
                        child = first.s1;
                        inside = part == 1 && row_done;
                        end.s0 = first.s0;
                    }
                }
                if (part == 1 && row_done)
                    end.s0 = first.s0;
                for (int q = first.s0; q < end.s0; ++q) {
                    const REAL d[2] = {binned[STRIDE * q] - x[0], binned[STRIDE * q + 1] - x[1]};
                    const REAL d2 = d[0] * d[0] + d[1] * d[1];
                    if (d2 >= cutting_distance2(cell) || q == own)
                        continue;
                    if (d2 == 0)
                        return FLAG_COINCIDE;
                    if (!clip_polygon(cell, d, d2, items[q], false, points))
                        return FLAG_FULL;
                }
            }
            if (child >= 0)
                break;
            ++turn;
            part = 0;
            ix = -1;
        }
        leave_grid(&way, child, (int4)(turn, part, ix, place.s3), (int4)(0, 0, -1, inside));
    }
    return 0;
}
