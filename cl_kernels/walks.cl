#include "common/row_counts.h"
#include "common/walk.h"

/* The cells in 3D of eight generators at a time, one in each lane of vectors: for CPUs, whose compilers make no vectors
   of work-items that branch as clipping does.

   Cells are walked among the nearest generators (common/walk.h). What is farther than twice the farthest vertex cannot
   cut; what is nearer and was not among them is looked for where it may cut off one of the vertices, and such a cell is
   walked once more, with others of its kind. A cell is left to be clipped (`polyhedra.cl`) where its triangles do not
   make a closed surface, or a face is so small, or bisectors so nearly parallel, that rounding may decide what there
   is. */

#if !IS_DOUBLE
#error "single precision has too few digits to tell which decisions are certain"
#endif
#define MAX_ROUNDS 20
/* Where hardly any of the first cells of a stretch are certain, as in lattices that are off by little, it is left. */
#define TRIALS 24
#define GROWTH 1.4 /* of the radius where lists were too short */
#ifndef STRETCH
#error "build with -DSTRETCH=generators that a work-item makes the cells of, a multiple of 8"
#endif

/* What is certain: least ratio of squares of the distances of the nearest generator and of the farthest vertex; least
   ratio of a face's area and the latter. */
#define CERTAIN_NEAREST2 1e-7
#define CERTAIN_AREA 1e-7

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
    return (list->nearest2 > CERTAIN_NEAREST2 * cells->reach2) & (m->least > CERTAIN_AREA * cells->reach2);
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

/* Look for generators farther than `from`, and walls, that cut off vertices of one lane's cell, in shell after shell up
   to `need`. If there are any, put the cell among those for later. Returns how many; -1 if they are too many. */
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
        far_x[far] = y.s0;
        far_y[far] = y.s1;
        far_z[far] = y.s2;
        lower = fmin(lower, y);
        upper = fmax(upper, y);
        far += !(4 * dot(y, y) < from * from);
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
    double to = from;
    do {
        const double begin2 = to * to;
        to = fmin(need, GROWTH * to);
        if (!collect_runs(runs, x, x, to, in->bins, in->grid_frames, in->grid_shapes))
            return -1;
        for (int run = 0; run < runs->n; ++run)
            for (int q = runs->firsts[run]; q < runs->firsts[run] + runs->counts[run]; ++q) {
                const double dx = binned[3 * q] - x.s0, dy = binned[3 * q + 1] - x.s1, dz = binned[3 * q + 2] - x.s2;
                const double d2 = fma(dx, dx, fma(dy, dy, dz * dz));
                if (!(d2 < to * to) || d2 < begin2)
                    continue;
                bool cuts = false;
                for (int v = 0; v < far; ++v)
                    cuts |= fma(dx, far_x[v], fma(dy, far_y[v], dz * far_z[v])) > d2 * (0.5 + BIAS);
                if (!cuts)
                    continue;
                if (k == LIST_CAPACITY - 1)
                    return -1;
                put_plane(list, k, slot, dx / d2, dy / d2, dz / d2, q);
                PLANE_LANE(list->planes, k++, 3, slot) = d2;
            }
    } while (to < need && k == faces);
    if (k == faces)
        return 0;
    for (int f = 0; f < faces; ++f) {
        for (int component = 0; component < 4; ++component)
            PLANE_LANE(list->planes, f, component, slot) = PLANE_LANE(cells->planes, f, component, lane);
        LANE(list->places, f, slot) = LANE(cells->places, f, lane);
    }
    later->places[slot] = place;
    later->counts[slot] = k;
    later->seen[slot] = to;
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

/* Per stretch of places in bin order: the cells of the generators there (see `clip_cells`), or row_counts[i] =
   UNFINISHED where a cell is left to be clipped. `first_reach` is how far the first lists go, in units of
   `spacing`. Only the first `rows` generators get cells. */
kernel void wrap_cells(const int size, const int n, const int rows, global const double *binned,
                       global const int *items, global const float *spacing, global float *reach,
                       global const int2 *bins, global const FRAME *grid_frames, global const int4 *grid_shapes,
                       const double4 box_lower, const double4 box_upper, const double first_reach, const int room,
                       global int *row_places, global int *row_counts, global int *labels, global double *measures,
                       global double *centroids, global double *volumes, global double *offsets,
                       global double *covariances, global int *report)
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
    int places[LANES], rounds[LANES];
    long wanted[LANES], guessed[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        wanted[lane] = guessed[lane] = 0;
        places[lane] = rounds[lane] = 0;
        xs[lane] = ys[lane] = zs[lane] = rs[lane] = 0;
    }
    for (;;) {
        /* The next generators take the lanes of those whose cells are done. */
        for (int lane = 0; lane < LANES; ++lane) {
            if (wanted[lane] && rounds[lane]++ < MAX_ROUNDS)
                continue;
            while (next < end && items[next] >= rows)
                ++next;
            wanted[lane] = guessed[lane] = next < end ? -1 : 0;
            if (next < end) {
                row_counts[items[next]] = UNFINISHED;
                places[lane] = next;
                rounds[lane] = 0;
                ++tried;
                xs[lane] = binned[3 * next];
                ys[lane] = binned[3 * next + 1];
                zs[lane] = binned[3 * next + 2];
                rs[lane] = first_reach * spacing[next];
                ++next;
            }
        }
        long8 todo = vload8(0, wanted), fresh = vload8(0, guessed), chosen;
        if (!any(todo) || (tried > TRIALS && 8 * made < tried))
            break;
        double4 lower, upper;
        double widest;
        double8 r = vload8(0, rs);
        const bool fits =
            see_enough(&near, &list, &runs, todo, fresh, places, xs, ys, zs, &r, &chosen, &lower, &upper, &widest, &in);
        vstore8(todo & ~chosen, 0, wanted);
        if (!fits)
            continue;
        chosen &= ~list_near(&list, &near, binned, places, xs, ys, zs, lower, upper, widest, box_lower, box_upper);
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
        vstore8(r, 0, rs);
        for (int lane = 0; lane < LANES; ++lane)
            if (far[lane] &&
                find_more(&later, &runs, &cells, &walk, lane, places[lane], rs[lane], needs[lane], &in) != 0) {
                whole[lane] = 0;
                ++made;
                while (later.n == LANES)
                    walk_later(&later, &runs, &in, &out);
            }
        made += write_cells(&cells, &m, vload8(0, whole) & certain_cells(&cells, &m, &list), places, need, &out);
        vstore8(vload8(0, wanted) | lost, 0, wanted);
        vstore8(fresh & ~chosen, 0, guessed);
        vstore8(lost ? GROWTH * r : r, 0, rs);
    }
    for (; next < end; ++next)
        if (items[next] < rows)
            row_counts[items[next]] = UNFINISHED;
    while (later.n > 0)
        walk_later(&later, &runs, &in, &out);
}
