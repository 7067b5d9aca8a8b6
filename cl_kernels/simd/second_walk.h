/* Cells with vertices beyond the searched radius: generators that may cut these vertices are searched, and such cells
   are traced again together. */
#include "simd/walk_output.h"

#define GROWTH 1.4     /* growth of the radius from shell to shell */
#define THINNEST 1.001 /* least ratio of the radii of a shell */
#define MOST_SHELLS 64 /* most shells for one cell */

/* Cells to trace again, among their faces and further generators that may cut them. */
typedef struct {
    int n;                            /* lanes in use */
    int places[LANES], counts[LANES]; /* items of their generators; lengths of their lists */
    double seen[LANES];               /* everything nearer has been searched */
    list_t list;
    cells_t cells;
    walk_t walk;
} later_t;

/* Among eight items first, first + 1, ... below `end`, append to the list, from entry `k` on, those at a distance
   between `from` and `to` from x that cut one of the `far` vertices. Returns the next entry; at most LIST_CAPACITY are
   written. */
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
    const double8 d2 = dx * dx + dy * dy + dz * dz;
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

/* Balls that cover all points farther than `from` from x and nearer to one of the vertices than x. If there are many
   vertices, consecutive ones, which are usually close, share a ball. */
inline balls_t balls_about(double4 x, double from, int far, const double *far_x, const double *far_y,
                           const double *far_z)
{
    double4 centers[CORNER_CAPACITY];
    double radii[CORNER_CAPACITY], xs[LANES], ys[LANES], zs[LANES], rs[LANES];
    for (int v = 0; v < far; ++v) {
        const double4 y = (double4)(far_x[v], far_y[v], far_z[v], 0);
        /* The spheres around x and around the vertex intersect at this share of the way. */
        const double y2 = dot(y, y), share = from * from / (2 * y2);
        centers[v] = fmax(share, 1.0) * y;
        radii[v] = share > 1 ? sqrt(fmax(from * from - share * share * y2, 0.0)) + 1e-9 * from : sqrt(y2) * (1 + 1e-9);
    }
    for (int ball = 0; ball < LANES; ++ball) {
        const int first = ball * far / LANES, end = max((ball + 1) * far / LANES, first + 1);
        double4 center = 0;
        for (int v = first; v < end; ++v)
            center += centers[v];
        center /= end - first;
        double r = 0;
        for (int v = first; v < end; ++v) {
            const double4 off = centers[v] - center;
            r = fmax(r, radii[v] + sqrt(dot(off, off)));
        }
        xs[ball] = x.s0 + center.s0;
        ys[ball] = x.s1 + center.s1;
        zs[ball] = x.s2 + center.s2;
        rs[ball] = r;
    }
    const balls_t balls = {vload8(0, xs), vload8(0, ys), vload8(0, zs), vload8(0, rs)};
    return balls;
}

/* Search generators farther than `from`, and walls, that cut vertices of the cell of one lane, shell by shell up to
   `need`. If there are any, queue the cell. Returns their number; -1 if there are too many.

   A generator that cuts a vertex is nearer to it than x. For a long, thin cell only its ends are searched. */
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
        far += !(4 * dot(y, y) * (1 + 64 * DBL_EPSILON) < from * from); /* at least the farthest, despite round-off */
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
            /* Try a thinner shell. */
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

/* Trace the queued cells; write them, or queue them again. */
inline void walk_later(later_t *later, runs_t *runs, const search_t *in, const output_t *out)
{
    global const double *binned = in->binned;
    list_t *list = &later->list;
    cells_t *cells = &later->cells;
    for (int lane = later->n; lane < LANES; ++lane)
        later->counts[lane] = 0;
    const long8 some = convert_long8(vload8(0, later->counts) > 0);
    const int length = pad_lists(list, later->counts);
    /* The first face may be a wall, if no generator was found before. */
    list->nearest = 0;
    list->nearest2 = some ? (double8)INFINITY : 1;
    for (int k = 0; k < length; ++k) {
        planes_t *plane = &list->planes[k];
        const long8 spare = plane->x == INFINITY;
        plane->x = spare ? 0 : plane->x;
        plane->d2 = spare ? INFINITY : plane->d2;
        const long8 nearer = some & (plane->d2 < list->nearest2);
        list->nearest2 = nearer ? plane->d2 : list->nearest2;
        list->nearest = nearer ? (long8)k : list->nearest;
    }
    for (int shell = 0; shell < SHELLS; ++shell) {
        list->ends[shell] = length;
        list->radii2[shell] = INFINITY;
    }
    walk_cells(cells, &later->walk, list, some);
    const long8 closed = some & ~vload8(0, cells->lost) & ~vload8(0, cells->doubt);
    const double8 need = 2 * sqrt(cells->reach2) * (1 + 8 * DBL_EPSILON), seen = vload8(0, later->seen);
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
    write_cells(cells, &later->walk, vload8(0, whole), places, need, binned, out);
}
