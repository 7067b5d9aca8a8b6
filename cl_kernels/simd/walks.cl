#include "tessellation/morton.h"
#include "simd/second_walk.h"

/* The cells in 3D of eight generators at a time, one per vector lane: for CPUs, whose compilers do not vectorize
   clipping.

   Cells are traced among the nearest generators (edge_walk.h), and the walls if these leave them open. A generator
   farther than twice the farthest vertex cannot cut. Nearer ones that were not listed are searched around the vertices
   that they may cut, and such cells are traced again together. A cell is left to `clip_polyhedra` (polyhedra.cl) if its
   triangles do not form a closed surface, or if a face is so small, or bisectors so nearly parallel, that round-off may
   decide. */

#if !IS_DOUBLE
#error "single precision has too few digits to decide which results are certain"
#endif
#define MAX_ROUNDS 20
/* If few of the first cells of a stretch are certain, as in perturbed lattices, `clip_polyhedra` makes all of them. */
#define TRIALS 24
#ifndef CUBE
#error "build with -DCUBE=edge, in bins, of the cubes of grid 0 that are visited one by one, a power of 2"
#endif
#ifndef STRETCH
#error "build with -DSTRETCH=generators that a work-item makes the cells of, a multiple of 8"
#endif

/* The first bin, along each axis, of a cube of grid 0; cubes are counted along x first. */
inline int4 first_of_cube(int cube, int4 shape)
{
    const int across = (shape.s1 + CUBE - 1) / CUBE, deep = (shape.s2 + CUBE - 1) / CUBE;
    return CUBE * (int4)(cube % across, cube / across % deep, cube / across / deep, 0);
}

/* Per cube: the number of its generators that get cells, those below `rows`. */
kernel void count_cubes(const int size, const int rows, global const int *items, global const int2 *bins,
                        global const int4 *grid_shapes, global int *counts)
{
    WORK_ITEM(cube);
    const int4 shape = grid_shapes[0], first = first_of_cube(cube, shape);
    const int end_x = min(first.s0 + CUBE, shape.s1), end_y = min(first.s1 + CUBE, shape.s2);
    const int end_z = min(first.s2 + CUBE, shape.s3);
    int count = 0;
    for (int z = first.s2; z < end_z; ++z)
        for (int y = first.s1; y < end_y; ++y) {
            global const int2 *row = bins + (z * shape.s2 + y) * shape.s1;
            for (int place = row[first.s0].s0; place < row[end_x].s0; ++place)
                count += items[place] < rows;
        }
    counts[cube] = count;
}

/* Per cube: the items of those generators, from order[starts[cube]] on, in an order that keeps neighbors close: along
   Morton's curve through its bins, depth first through divided bins. The order of bins, row by row, would not be local
   where generators are sparse. */
kernel void order_places(const int size, const int rows, global const int *items, global const int2 *bins,
                         global const int4 *grid_shapes, global const int *starts, global int *order)
{
    LONG_ITEM(cube);
    int n = starts[cube];
    descent_t way; /* position on the curve */
    begin_descent(&way, (int4)(0));
    while (way.depth >= 0) {
        const int4 shape = grid_shapes[way.grids[way.depth]];
        const int4 first = way.depth > 0 ? (int4)(0) : first_of_cube(cube, shape);
        const int side = way.depth > 0 ? shape.s1 : CUBE, end = side * side * side;
        int code = way.places[way.depth].s0, child = -1;
        for (; code < end && child < 0; ++code) {
            const int x = first.s0 + gather_bits(code), y = first.s1 + gather_bits(code >> 1);
            const int z = first.s2 + gather_bits(code >> 2);
            if (x >= shape.s1 || y >= shape.s2 || z >= shape.s3)
                continue;
            global const int2 *bin = bins + shape.s0 + (z * shape.s2 + y) * shape.s1 + x;
            const int2 from = bin[0], to = bin[1];
            if (from.s1 != to.s1)
                child = from.s1;
            for (int place = from.s0; place < to.s0 && child < 0; ++place)
                if (items[place] < rows)
                    order[n++] = place;
        }
        leave_grid(&way, child, (int4)(code, 0, 0, 0), (int4)(0));
    }
}

/* Per stretch of that order: the cells of its generators (see `clip_polyhedra`), or row_counts[i] = UNFINISHED for a
   cell that remains to be clipped, such as those near walls of a solid. `first_reach` is the first search radius, in
   units of `spacing`. In a periodic box the balls around the vertices are tested. */
kernel void walk_all_cells(const int size, const int rows, global const int *order, global const double *binned,
                           global const int *items, global const float *spacing, global float *reach, BIN_ARGS,
                           CLIP_BOX_ARGS, const double first_reach, const int room, CELL_OUTPUT_ARGS HALO_ARGS)
{
    LONG_ITEM(stretch);
    output_t out = {room,
                    items,
                    reach,
                    row_places,
                    row_counts,
                    report,
                    {labels, measures, centroids, volumes, offsets, covariances},
                    with_corners,
                    corners,
                    OWN_OF(0)};
#ifdef HALO
    MAKE_HALO;
    out.halo = halo;
#endif
    const search_t in = {binned, bins, grid_frames, grid_shapes, box_lower, box_upper};
    runs_t runs;
    near_t near;
    list_t list;
    cells_t cells;
    walk_t walk;
    later_t later;
    later.n = 0;
    const int end = min(rows, (stretch + 1) * STRETCH);
    int next = stretch * STRETCH, tried = 0, made = 0;
    double xs[LANES], ys[LANES], zs[LANES], rs[LANES];
    int places[LANES], ranks[LANES], rounds[LANES];
    long wanted[LANES], guessed[LANES], open[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        wanted[lane] = guessed[lane] = open[lane] = 0;
        places[lane] = ranks[lane] = rounds[lane] = 0;
        xs[lane] = ys[lane] = zs[lane] = rs[lane] = 0;
    }
    for (;;) {
        /* The next generators take the lanes of finished cells. */
        for (int lane = 0; lane < LANES; ++lane) {
            if (wanted[lane] && rounds[lane]++ < MAX_ROUNDS)
                continue;
            for (; next < end && has_own(items[order[next]] OWN); ++next)
                row_counts[items[order[next]]] = UNFINISHED;
            wanted[lane] = guessed[lane] = next < end ? -1 : 0;
            if (next < end) {
                const int place = order[next];
                row_counts[items[place]] = UNFINISHED;
                places[lane] = place;
                ranks[lane] = next++;
                rounds[lane] = 0;
                open[lane] = 0;
                ++tried;
                xs[lane] = binned[3 * place];
                ys[lane] = binned[3 * place + 1];
                zs[lane] = binned[3 * place + 2];
                rs[lane] = first_reach * spacing[place];
            }
        }
        long8 todo = vload8(0, wanted), fresh = vload8(0, guessed), chosen;
        if (!any(todo) || (tried > TRIALS && 8 * made < tried))
            break;
        double4 lower, upper;
        double widest;
        double8 r = vload8(0, rs);
        const bool fits =
            see_enough(&near, &list, &runs, todo, fresh, ranks, xs, ys, zs, &r, &chosen, &lower, &upper, &widest, &in);
        vstore8(todo & ~chosen, 0, wanted);
        if (!fits)
            continue;
        /* Walls close a cell that is open among the near generators. */
        const bool walled = any(chosen & vload8(0, open));
        const long8 full = chosen & list_near(&list, &near, binned, places, xs, ys, zs, lower, upper,
                                              walled ? INFINITY : widest, box_lower, box_upper);
        r = full ? 0.8 * r : r;
        vstore8(vload8(0, wanted) | full, 0, wanted);
        vstore8(r, 0, rs);
        chosen &= ~full;
        if (!any(chosen))
            continue;
        walk_cells(&cells, &walk, &list, chosen);
        const long8 lost = chosen & vload8(0, cells.lost), closed = chosen & ~lost & ~vload8(0, cells.doubt);
        const double8 need = 2 * sqrt(cells.reach2) * (1 + 8 * DBL_EPSILON);
        long far[LANES], whole[LANES];
        double needs[LANES];
        vstore8(closed & ~(need <= r), 0, far);
        vstore8(closed, 0, whole);
        vstore8(need, 0, needs);
        for (int lane = 0; lane < LANES; ++lane)
            if (far[lane] &&
                find_more(&later, &runs, &cells, &walk, lane, places[lane], rs[lane], needs[lane], &in) != 0) {
                whole[lane] = 0;
                ++made;
                while (later.n == LANES)
                    walk_later(&later, &runs, &in, &out);
            }
        made += write_cells(&cells, &walk, vload8(0, whole), places, need, binned, &out);
        vstore8(vload8(0, wanted) | (lost & ~vload8(0, open)), 0, wanted);
        vstore8(vload8(0, open) | lost, 0, open);
        vstore8(fresh & ~chosen, 0, guessed);
    }
    for (; next < end; ++next)
        row_counts[items[order[next]]] = UNFINISHED;
    while (later.n > 0)
        walk_later(&later, &runs, &in, &out);
}
