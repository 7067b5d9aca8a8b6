#include "common/morton.h"
#include "common/row_counts.h"
#include "common/walk.h"

/* The cells in 3D of eight generators at a time, one in each lane of vectors: for CPUs, whose compilers make no vectors
   of work-items that branch as clipping does.

   Cells are walked among the nearest generators (common/walk.h), and the walls where these leave them open. What is
   farther than twice the farthest vertex cannot cut; what is nearer and was not among them is looked for where it may
   cut off one of the vertices, and such a cell is walked once more, with others of its kind. A cell is left to be
   clipped (`polyhedra.cl`) where its triangles do not make a closed surface, or a face is so small, or bisectors so
   nearly parallel, that rounding may decide what there is. */

#if !IS_DOUBLE
#error "single precision has too few digits to tell which decisions are certain"
#endif
#define MAX_ROUNDS 20
/* Where hardly any of the first cells of a stretch are certain, as in lattices that are off by little, it is left. */
#define TRIALS 24
#define GROWTH 1.4     /* of the radius from shell to shell */
#define THINNEST 1.001 /* ratio of the radii of a shell that still holds too much */
#define MOST_SHELLS 64 /* that are looked at about one cell where some hold too much */
#ifndef CUBE
#error "build with -DCUBE=bins each way of the cubes of grid 0 that are gone through one by one, a power of 2"
#endif
#ifndef STRETCH
#error "build with -DSTRETCH=generators that a work-item makes the cells of, a multiple of 8"
#endif

/* What is certain: least ratio of squares of the distances of the nearest generator and of the farthest vertex; least
   ratio of a face's area and the square of the distance of its own farthest vertex, as far as which vertices round:
   that distance is the same from both sides of the face. */
#define CERTAIN_NEAREST2 1e-7
#define CERTAIN_AREA 1e-8

/* Where cells are written to, in the layout of `clip_cells` (polyhedra.cl). */
typedef struct {
    int room;
    global const int *items;
    global float *reach;
    global int *row_places, *row_counts, *labels, *report;
    global double *measures, *centroids, *volumes, *offsets, *covariances;
} output_t;

/* Write the cells of some lanes, of generators at `places`, and return how many. `reach` is twice the distance of the
   farthest vertex. */
inline int write_cells(const cells_t *cells, const moments_t *m, long8 done, const int *places, double8 reach,
                       const output_t *out)
{
    long lanes[LANES];
    double reaches[LANES];
    vstore8(done, 0, lanes);
    vstore8(reach, 0, reaches);
    int total = 0, made = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        total += lanes[lane] ? cells->faces[lane] : 0;
        made += lanes[lane] != 0;
    }
    if (made == 0)
        return 0;
    int place = atomic_add(out->report + 2, total);
    const bool fits = place + total <= out->room;
    for (int lane = 0; lane < LANES; ++lane) {
        if (!lanes[lane])
            continue;
        const int i = out->items[places[lane]], count = cells->faces[lane];
        out->reach[places[lane]] = (float)reaches[lane];
        out->row_places[i] = place;
        out->row_counts[i] = count | CERTAIN;
        for (int f = 0; f < count && fits; ++f, ++place) {
            const int other = LANE(cells->places, f, lane);
            out->labels[place] = other < 0 ? other : out->items[other];
            const double4 face = LANE(cells->sums, f, lane);
            out->measures[place] = face.s0;
            out->centroids[3 * place] = face.s1;
            out->centroids[3 * place + 1] = face.s2;
            out->centroids[3 * place + 2] = face.s3;
        }
        out->volumes[i] = LANE((const double *)&m->volume, 0, lane);
        out->offsets[3 * i] = LANE((const double *)&m->x, 0, lane);
        out->offsets[3 * i + 1] = LANE((const double *)&m->y, 0, lane);
        out->offsets[3 * i + 2] = LANE((const double *)&m->z, 0, lane);
        out->covariances[6 * i] = LANE((const double *)&m->xx, 0, lane);
        out->covariances[6 * i + 1] = LANE((const double *)&m->xy, 0, lane);
        out->covariances[6 * i + 2] = LANE((const double *)&m->zx, 0, lane);
        out->covariances[6 * i + 3] = LANE((const double *)&m->yy, 0, lane);
        out->covariances[6 * i + 4] = LANE((const double *)&m->yz, 0, lane);
        out->covariances[6 * i + 5] = LANE((const double *)&m->zz, 0, lane);
    }
    return made;
}

/* Lanes in which the cell, walked among all that is nearer than `reach`, is certain. */
inline long8 certain_cells(const cells_t *cells, const moments_t *m, const list_t *list)
{
    return (list->nearest2 > CERTAIN_NEAREST2 * cells->reach2) & (m->least > CERTAIN_AREA);
}

/* Cells to be walked once more, among their faces and what else may cut them. */
typedef struct {
    int n;                            /* lanes in use */
    int places[LANES], counts[LANES]; /* of their generators; entries of their lists */
    double seen[LANES];               /* all that is nearer has been looked at */
    list_t list;
    cells_t cells;
    walk_t walk;
} later_t;

/* Of eight generators at places first, first + 1, ... those less than `end` that are from `from` to `to` away from x
   and cut off one of the vertices, `far` of them, are added to list entries `k` on. Returns the next entry; no more
   than LIST_CAPACITY are written. */
inline int add_cutters(list_t *list, int k, int slot, global const double *binned, int first, int end, double4 x,
                       double from2, double to2, int far, const double *far_x, const double *far_y, const double *far_z)
{
    int places[LANES];
    for (int c = 0; c < LANES; ++c)
        places[c] = min(first + c, end - 1);
#define COORDINATES(axis)                                                                                              \
    (double8)(binned[3 * places[0] + axis], binned[3 * places[1] + axis], binned[3 * places[2] + axis],                \
              binned[3 * places[3] + axis], binned[3 * places[4] + axis], binned[3 * places[5] + axis],                \
              binned[3 * places[6] + axis], binned[3 * places[7] + axis])
    const double8 dx = COORDINATES(0) - x.s0, dy = COORDINATES(1) - x.s1, dz = COORDINATES(2) - x.s2;
    const double8 d2 = fma(dx, dx, fma(dy, dy, dz * dz));
    const long8 number = {0, 1, 2, 3, 4, 5, 6, 7}, inside = (d2 < to2) & (d2 >= from2) & (number < (long)(end - first));
    if (!any(inside))
        return k;
    const double8 level = d2 * (0.5 + BIAS);
    long8 cuts = 0;
    for (int v = 0; v < far; ++v)
        cuts |= fma(dx, far_x[v], fma(dy, far_y[v], dz * far_z[v])) > level;
    cuts &= inside;
    if (!any(cuts))
        return k;
    const double8 scale = 1 / d2, px = dx * scale, py = dy * scale, pz = dz * scale;
    long cut[LANES];
    vstore8(cuts, 0, cut);
    for (int c = 0; c < LANES; ++c)
        if (cut[c] && k < LIST_CAPACITY) {
            put_plane(list, k, slot, LANE((const double *)&px, 0, c), LANE((const double *)&py, 0, c),
                      LANE((const double *)&pz, 0, c), places[c]);
            PLANE_LANE(list->planes, k++, 3, slot) = LANE((const double *)&d2, 0, c);
        }
    return k;
}

/* Balls that hold what is farther than `from` from x and nearer to one of the vertices than x. Vertices that follow
   each other, as a rule near each other, share one where they are many. */
inline balls_t balls_about(double4 x, double from, int far, const double *far_x, const double *far_y,
                           const double *far_z)
{
    double4 centres[CORNER_CAPACITY];
    double radii[CORNER_CAPACITY], xs[LANES], ys[LANES], zs[LANES], rs[LANES];
    for (int v = 0; v < far; ++v) {
        const double4 y = (double4)(far_x[v], far_y[v], far_z[v], 0);
        /* The spheres about x and about the vertex cross at this share of the way to it. */
        const double y2 = dot(y, y), share = from * from / (2 * y2);
        centres[v] = fmax(share, 1.0) * y;
        radii[v] = share > 1 ? sqrt(fmax(from * from - share * share * y2, 0.0)) + 1e-9 * from : sqrt(y2) * (1 + 1e-9);
    }
    for (int ball = 0; ball < LANES; ++ball) {
        const int first = ball * far / LANES, end = max((ball + 1) * far / LANES, first + 1);
        double4 centre = 0;
        for (int v = first; v < end; ++v)
            centre += centres[v];
        centre /= end - first;
        double r = 0;
        for (int v = first; v < end; ++v) {
            const double4 off = centres[v] - centre;
            r = fmax(r, radii[v] + sqrt(dot(off, off)));
        }
        xs[ball] = x.s0 + centre.s0;
        ys[ball] = x.s1 + centre.s1;
        zs[ball] = x.s2 + centre.s2;
        rs[ball] = r;
    }
    const balls_t balls = {vload8(0, xs), vload8(0, ys), vload8(0, zs), vload8(0, rs)};
    return balls;
}

/* Look for generators farther than `from`, and walls, that cut off vertices of one lane's cell, in shell after shell up
   to `need`. If there are any, put the cell among those for later. Returns how many; -1 if they are too many.

   What cuts a vertex off is nearer to it than x is: of a cell that is long and thin no more than what is about its ends
   is looked at. */
inline int find_more(later_t *later, runs_t *runs, const cells_t *cells, const walk_t *walk, int lane, int place,
                     double from, double need, const search_t *in)
{
    global const double *binned = in->binned;
    const double4 x = (double4)(binned[3 * place], binned[3 * place + 1], binned[3 * place + 2], 0);
    double far_x[CORNER_CAPACITY], far_y[CORNER_CAPACITY], far_z[CORNER_CAPACITY];
    double4 lower = 0, upper = 0;
    int far = 0;
    for (int v = 0; v < cells->corners[lane]; ++v) {
        const double4 y = corner_at(walk, v, lane);
        lower = fmin(lower, y);
        upper = fmax(upper, y);
        far_x[far] = y.s0;
        far_y[far] = y.s1;
        far_z[far] = y.s2;
        far +=
            !(4 * dot(y, y) * (1 + 64 * DBL_EPSILON) < from * from); /* the farthest, at least, whatever is rounded */
    }
    list_t *list = &later->list;
    const int slot = later->n, faces = cells->faces[lane];
    int k = faces;
    const double4 low = in->box_lower - x, high = in->box_upper - x;
    const double walls[6] = {low.s0, high.s0, low.s1, high.s1, low.s2, high.s2};
    const double ends[6] = {lower.s0, upper.s0, lower.s1, upper.s1, lower.s2, upper.s2};
    bool known[6] = {false};
    for (int f = 0; f < faces; ++f)
        if (LANE(cells->places, f, lane) < 0)
            known[-1 - LANE(cells->places, f, lane)] = true;
    for (int wall = 0; wall < 6; ++wall)
        if (!known[wall] && fabs(ends[wall]) > fabs(walls[wall]) * (1 + 2 * BIAS)) {
            put_plane(list, k, slot, 0, 0, 0, -1 - wall);
            PLANE_LANE(list->planes, k, wall >> 1, slot) = 0.5 / walls[wall];
            PLANE_LANE(list->planes, k++, 3, slot) = 4 * walls[wall] * walls[wall];
        }
    const int known_faces = k;
    const balls_t balls = balls_about(x, from, far, far_x, far_y, far_z);
    double seen = from, to = fmin(need, GROWTH * from);
    for (int trial = 0;; ++trial) {
        const double from2 = seen * seen, to2 = to * to;
        bool fits = collect_runs(runs, &balls, x - to, x + to, INT_MAX, in->bins, in->grid_frames, in->grid_shapes);
        for (int run = 0; run < runs->n && fits; ++run) {
            const int end = runs->firsts[run] + runs->counts[run];
            for (int first = runs->firsts[run]; first < end; first += LANES)
                k = add_cutters(list, k, slot, binned, first, end, x, from2, to2, far, far_x, far_y, far_z);
            fits = k < LIST_CAPACITY - 1;
        }
        if (!fits) {
            /* A thinner shell. */
            k = known_faces;
            to = sqrt(seen * to);
            if (!(to > THINNEST * seen) || trial >= MOST_SHELLS)
                return -1;
            continue;
        }
        seen = to;
        if (k > known_faces || !(to < need))
            break;
        to = fmin(need, GROWTH * to);
    }
    if (k == faces)
        return 0;
    for (int f = 0; f < faces; ++f) {
        for (int component = 0; component < 4; ++component)
            PLANE_LANE(list->planes, f, component, slot) = PLANE_LANE(cells->planes, f, component, lane);
        LANE(list->places, f, slot) = LANE(cells->places, f, lane);
    }
    later->places[slot] = place;
    later->counts[slot] = k;
    later->seen[slot] = seen;
    ++later->n;
    return k - faces;
}

/* Walk the cells that were put off; write them, or put them off again. */
inline void walk_later(later_t *later, runs_t *runs, const search_t *in, const output_t *out)
{
    list_t *list = &later->list;
    cells_t *cells = &later->cells;
    for (int lane = later->n; lane < LANES; ++lane)
        later->counts[lane] = 0;
    const long8 some = convert_long8(vload8(0, later->counts) > 0);
    const int length = pad_lists(list, later->counts);
    for (int k = 0; k < length; ++k) {
        planes_t *plane = &list->planes[k];
        const long8 spare = plane->x == INFINITY;
        plane->x = spare ? 0 : plane->x;
        plane->d2 = spare ? INFINITY : plane->d2;
    }
    for (int shell = 0; shell < SHELLS; ++shell) {
        list->ends[shell] = length;
        list->radii2[shell] = INFINITY;
    }
    /* The first face of a cell is that of the nearest. */
    list->nearest = 0;
    list->nearest2 = some ? list->planes[0].d2 : 1;
    walk_cells(cells, &later->walk, list, some);
    const long8 closed = some & ~vload8(0, cells->lost) & ~vload8(0, cells->doubt);
    const moments_t m = finish_cells(cells, &later->walk, closed);
    const double8 need = 2 * sqrt(cells->reach2) * (1 + 8 * DBL_EPSILON), seen = vload8(0, later->seen);
    const long8 certain = certain_cells(cells, &m, list);
    int places[LANES];
    double needs[LANES], froms[LANES];
    long whole[LANES];
    vstore8(closed, 0, whole);
    vstore8(need, 0, needs);
    vstore8(seen, 0, froms);
    for (int lane = 0; lane < LANES; ++lane)
        places[lane] = later->places[lane];
    later->n = 0;
    for (int lane = 0; lane < LANES; ++lane)
        if (whole[lane] && !(needs[lane] <= froms[lane]) &&
            find_more(later, runs, cells, &later->walk, lane, places[lane], froms[lane], needs[lane], in) != 0)
            whole[lane] = 0;
    write_cells(cells, &m, vload8(0, whole) & certain, places, need, out);
}

/* The first bin, along each axis, of a cube of grid 0; cubes are counted along x first. */
inline int4 first_of_cube(int cube, int4 shape)
{
    const int across = (shape.s1 + CUBE - 1) / CUBE, deep = (shape.s2 + CUBE - 1) / CUBE;
    return CUBE * (int4)(cube % across, cube / across % deep, cube / across / deep, 0);
}

/* Per cube: the number of generators there. */
kernel void count_cubes(const int size, global const int2 *bins, global const int4 *grid_shapes, global int *counts)
{
    WORK_ITEM(cube);
    const int4 shape = grid_shapes[0], first = first_of_cube(cube, shape);
    const int end_x = min(first.s0 + CUBE, shape.s1), end_y = min(first.s1 + CUBE, shape.s2);
    const int end_z = min(first.s2 + CUBE, shape.s3);
    int count = 0;
    for (int z = first.s2; z < end_z; ++z)
        for (int y = first.s1; y < end_y; ++y) {
            global const int2 *row = bins + (z * shape.s2 + y) * shape.s1;
            count += row[end_x].s0 - row[first.s0].s0;
        }
    counts[cube] = count;
}

/* Per cube: the places of its generators, from order[starts[cube]] on, so that those which follow each other are near
   each other: along Morton's curve through its bins, and through those of a divided bin before the next. Rows of bins,
   in whose order places are, are long where generators are sparse. */
kernel void order_places(const int size, global const int2 *bins, global const int4 *grid_shapes,
                         global const int *starts, global int *order)
{
    WORK_ITEM(cube);
    int n = starts[cube];
    descent_t way; /* along the curve */
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
                order[n++] = place;
        }
        leave_grid(&way, child, (int4)(code, 0, 0, 0), (int4)(0));
    }
}

/* Per stretch of places in bin order: the cells of the generators there (see `clip_cells`), or row_counts[i] =
   UNFINISHED where a cell is left to be clipped. `first_reach` is how far the first lists go, in units of
   `spacing`. Only the first `rows` generators get cells. */
kernel void wrap_cells(const int size, const int n, const int rows, global const int *order,
                       global const double *binned, global const int *items, global const float *spacing,
                       global float *reach, global const int2 *bins, global const FRAME *grid_frames,
                       global const int4 *grid_shapes, const double4 box_lower, const double4 box_upper,
                       const double first_reach, const int room, global int *row_places, global int *row_counts,
                       global int *labels, global double *measures, global double *centroids, global double *volumes,
                       global double *offsets, global double *covariances, global int *report)
{
    WORK_ITEM(stretch);
    const output_t out = {room,   items,    reach,     row_places, row_counts, labels,
                          report, measures, centroids, volumes,    offsets,    covariances};
    const search_t in = {binned, bins, grid_frames, grid_shapes, box_lower, box_upper};
    runs_t runs;
    near_t near;
    list_t list;
    cells_t cells;
    walk_t walk;
    later_t later;
    later.n = 0;
    const int end = min(n, (stretch + 1) * STRETCH);
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
        /* The next generators take the lanes of those whose cells are done. */
        for (int lane = 0; lane < LANES; ++lane) {
            if (wanted[lane] && rounds[lane]++ < MAX_ROUNDS)
                continue;
            while (next < end && items[order[next]] >= rows)
                ++next;
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
        /* A cell that is open among what is near is closed by walls, to begin with. */
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
        const moments_t m = finish_cells(&cells, &walk, closed);
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
        made += write_cells(&cells, &m, vload8(0, whole) & certain_cells(&cells, &m, &list), places, need, &out);
        vstore8(vload8(0, wanted) | (lost & ~vload8(0, open)), 0, wanted);
        vstore8(vload8(0, open) | lost, 0, open);
        vstore8(fresh & ~chosen, 0, guessed);
    }
    for (; next < end; ++next)
        if (items[order[next]] < rows)
            row_counts[items[order[next]]] = UNFINISHED;
    while (later.n > 0)
        walk_later(&later, &runs, &in, &out);
}
