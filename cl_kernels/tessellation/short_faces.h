/* Faces no longer than round-off, and cells that may have such faces. */
#include "tessellation/polygon.h"

/* A vector normal to the face of `label`, out of the cell at x. For a wall its length has no meaning. */
inline REAL2 face_direction(int label, const REAL *x, global const REAL *points)
{
    if (label >= 0)
        return direction_of(x, label, points);
    const int wall = -1 - label;
    const REAL sign = wall % 2 == 0 ? -1 : 1;
    return wall < 2 ? (REAL2)(sign, 0) : (REAL2)(0, sign);
}

/* The round-off of positions in the unit box. */
#define POSITION_NOISE (16 * REAL_EPS)

/* Whether a face of squared length e2, between generators at squared distance d2, is no longer than the round-off of
   positions. A face that is long compared with d is real: in a cluster all lengths are tiny. */
inline bool is_short(REAL e2, REAL d2)
{
    return e2 <= POSITION_NOISE * POSITION_NOISE && e2 <= R(1e-6) * d2;
}

/* Whether this cell might drop a face that its neighbor keeps, or might be inaccurate. This needs a short face, or a
   generator that is near compared with the size of the cell (far corners are then ill-conditioned) or with the
   round-off of positions. */
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
        /* A multiple of the short length: the neighbor rounds differently, and so does an incremental update. */
        doubtful |= e2 < REAL_EPS * d2 || is_short(e2 / 64, R(100) * d2) || d2 < near2;
    }
    return doubtful;
}

/* Whether the face of generators i and j, from its corner at a to that at b, counter-clockwise around i, is within
   round-off and its corners stay in place without it. Both cells get the same answer: it is computed from one of them.
 */
inline bool is_nothing(int i, int j, int a, int b, const cell_t *cell, global const REAL *points)
{
    const int o = min(i, j), q = max(i, j), from = i < j ? a : b, to = i < j ? b : a;
    SITE(x, o, points);
    const REAL2 d = direction_of(x, q, points);
    const REAL2 begin = corner(o, x, from, q, points, cell->lower, cell->upper);
    const REAL2 e = corner(o, x, q, to, points, cell->lower, cell->upper) - begin;
    if (!is_short(dot(e, e), dot(d, d)))
        return false;
    const REAL2 one = corner(o, x, from, to, points, cell->lower, cell->upper) - begin;
    const REAL2 other = corner_gap(begin, o, q, to, from, points, cell->lower, cell->upper);
    const REAL most2 = POSITION_NOISE * POSITION_NOISE / 4;
    return dot(one, one) <= most2 && dot(other, other) <= most2; /* false for the NaN of parallel faces */
}

/* Drop faces within round-off: they arise where more than three cells share a vertex, as in a lattice. */
inline void drop_short_faces(cell_t *cell, global const REAL *points)
{
    const int n = cell->n, first = cell->faces[0];
    int kept = 0, before = cell->faces[n - 1];
    for (int k = 0; k < n; ++k) {
        const int next = k == n - 1 ? 0 : k + 1, label = cell->faces[k], after = k == n - 1 ? first : cell->faces[next];
        /* A cheap first test with the corners as they are, which are less than a hundred roundings off. */
        const REAL ex = cell->x[next] - cell->x[k], ey = cell->y[next] - cell->y[k];
        const bool is_long = ex * ex + ey * ey > R(1e4) * POSITION_NOISE * POSITION_NOISE;
        if (is_long || label < 0 || !is_nothing(cell->generator, label, before, after, cell, points)) {
            cell->faces[kept++] = label;
        }
        before = label;
    }
    cell->n = kept;
}
