/* Faces no longer than rounding, and cells in which there may be any. */
#include "tessellation/polygon.h"

/* A vector across the face of `label`, pointing out of the cell at x; its length has no meaning for a wall. */
inline REAL2 face_direction(int label, const REAL *x, global const REAL *points)
{
    if (label >= 0)
        return direction_of(x, label, points);
    const int wall = -1 - label;
    const REAL sign = wall % 2 == 0 ? -1 : 1;
    return wall < 2 ? (REAL2)(sign, 0) : (REAL2)(0, sign);
}

/* The rounding of positions in the unit box. */
#define POSITION_NOISE (16 * REAL_EPS)

/* Is a face of squared length e2, between generators at squared distance d2, no longer than rounding of positions? One
   that is long beside the distance of its generators is real: in a cluster everything is tiny. */
inline bool is_short(REAL e2, REAL d2)
{
    return e2 <= POSITION_NOISE * POSITION_NOISE && e2 <= R(1e-6) * d2;
}

/* May a face be left out by this cell and not by its neighbor, or too little of it be certain? Only where a face is
   short, or a generator is near beside the cell (then far corners are ill-conditioned) or beside the rounding of
   positions. */
inline bool is_doubtful(const cell_t *cell, const REAL *x, global const REAL *points)
{
    bool doubtful = false;
    const REAL near2 =
        fmax(sqrt(REAL_EPS) * cell->reach2, (IS_DOUBLE ? R(1e8) : R(4096)) * POSITION_NOISE * POSITION_NOISE);
    for (int k = 0; k < cell->n; ++k) {
        const int next = k == cell->n - 1 ? 0 : k + 1;
        const REAL ex = cell->x[next] - cell->x[k];
        const REAL ey = cell->y[next] - cell->y[k];
        REAL d2 = cell->reach2;
        if (cell->faces[k] >= 0) {
            const REAL2 d = face_direction(cell->faces[k], x, points);
            d2 = dot(d, d);
        }
        const REAL e2 = ex * ex + ey * ey;
        /* Some times what counts as short: the neighbor's rounding is another, and a repair takes as much for none. */
        doubtful |= e2 < REAL_EPS * d2 || is_short(e2 / 64, R(100) * d2) || d2 < near2;
    }
    return doubtful;
}

/* Is the face of generators i and j, from the one of a to that of b, counter-clockwise about i, nothing but rounding,
   and do the corners stay where they are without it? Both cells ask the same, from one of the two. */
inline bool is_nothing(int i, int j, int a, int b, const cell_t *cell, global const REAL *points)
{
    const int o = min(i, j), q = max(i, j), from = i < j ? a : b, to = i < j ? b : a;
    const REAL x[2] = {points[2 * o], points[2 * o + 1]};
    const REAL2 d = direction_of(x, q, points);
    const REAL2 begin = corner(o, x, from, q, points, cell->lower, cell->upper);
    const REAL2 e = corner(o, x, q, to, points, cell->lower, cell->upper) - begin;
    if (!is_short(dot(e, e), dot(d, d)))
        return false;
    const REAL2 one = corner(o, x, from, to, points, cell->lower, cell->upper) - begin;
    const REAL2 other = corner_gap(begin, o, q, to, from, points, cell->lower, cell->upper);
    const REAL most2 = POSITION_NOISE * POSITION_NOISE / 4;
    return dot(one, one) <= most2 && dot(other, other) <= most2; /* no number, of parallel ones, is not */
}

/* Drop faces that are nothing: they arise where more than three cells meet in one point, as in a lattice. */
inline void drop_short_faces(cell_t *cell, global const REAL *points)
{
    const int n = cell->n, first = cell->faces[0];
    int kept = 0, before = cell->faces[n - 1];
    for (int k = 0; k < n; ++k) {
        const int next = k == n - 1 ? 0 : k + 1, label = cell->faces[k], after = k == n - 1 ? first : cell->faces[next];
        /* A look at the corners as they are spares most of the time: these are off by less than a hundred times. */
        const REAL ex = cell->x[next] - cell->x[k], ey = cell->y[next] - cell->y[k];
        const bool is_long = ex * ex + ey * ey > R(1e4) * POSITION_NOISE * POSITION_NOISE;
        if (is_long || label < 0 || !is_nothing(cell->generator, label, before, after, cell, points)) {
            cell->faces[kept++] = label;
        }
        before = label;
    }
    cell->n = kept;
}
