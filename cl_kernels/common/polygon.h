/* A convex polygon around its generator, and its clip by the half-plane nearer to the generator than to a neighbour.
   Coordinates are relative to the generator: differences of close positions are exact, so cells stay accurate
   whatever their size. */
#include "common/corner.h"
#include "common/real.h"

#ifndef CELL_CAPACITY
#error "build with -DCELL_CAPACITY=faces that a cell may have while it is clipped"
#endif

/* A cut shallower than this is none, so that cocircular generators do not shred a corner: depth times d, as a share of
   d.d. */
#define LEAST_DEPTH (4 * REAL_EPS)
/* Distances from a bisector that rounding may turn, as shares of d or of the corners' distance. */
#define IN_DOUBT (64 * REAL_EPS)
/* Largest square of the distance of generators that are near each other, as a share of that to them. */
#define NEAR_EACH_OTHER R(1e-2)
/* Least side that is believed, as a share of the neighbour's distances from both, one times the other: of four on a
   circle it is 0, of three on a line a half. */
#define LEAST_SIDE R(5e-3)

/* What is hardly ever called is kept out of the way of what is. */
#define OUT_OF_LINE __attribute__((noinline))

/* Face k runs counter-clockwise from corner k to corner k + 1 and belongs to faces[k]: a generator, or -1 - wall. */
typedef struct {
    int n;
    REAL x[CELL_CAPACITY];
    REAL y[CELL_CAPACITY];
    int faces[CELL_CAPACITY];
    REAL reach2; /* largest squared distance of a corner from the generator */
    /* Whose cell it is, and where. */
    int generator;
    REAL position[2], lower[2], upper[2];
} cell_t;

/* The whole box around generator x. */
inline void start_cell(cell_t *cell, int i, const REAL *x, const REAL *lower, const REAL *upper)
{
    cell->generator = i;
    for (int a = 0; a < 2; ++a) {
        cell->position[a] = x[a];
        cell->lower[a] = lower[a];
        cell->upper[a] = upper[a];
    }
    cell->n = 4;
    cell->x[0] = cell->x[3] = lower[0] - x[0];
    cell->x[1] = cell->x[2] = upper[0] - x[0];
    cell->y[0] = cell->y[1] = lower[1] - x[1];
    cell->y[2] = cell->y[3] = upper[1] - x[1];
    cell->faces[0] = -1 - 2;
    cell->faces[1] = -1 - 1;
    cell->faces[2] = -1 - 3;
    cell->faces[3] = -1 - 0;
    const REAL rx = fmax(-cell->x[0], cell->x[1]);
    const REAL ry = fmax(-cell->y[0], cell->y[2]);
    cell->reach2 = rx * rx + ry * ry;
}

/* Where face k of the cell meets the bisector that cuts it between corners `in` and `out`, which lie at the signed
   distances s_in <= 0 < s_out of it. Interpolation rounds by eps of the face's length; where that is much beside the
   distance of the generators (near-duplicates; in single precision also where it is a ten-thousandth), the corner is
   computed from the generators instead. */
inline REAL2 cut_face(const cell_t *cell, int in, int out, REAL s_in, REAL s_out, int face, int neighbour, REAL d2,
                      global const REAL *points)
{
    const REAL2 a = (REAL2)(cell->x[in], cell->y[in]);
    const REAL2 ab = (REAL2)(cell->x[out], cell->y[out]) - a;
    if (d2 < (IS_DOUBLE ? R(1e-10) : R(1e-6)) * dot(ab, ab))
        return corner(cell->generator, cell->position, face, neighbour, points, cell->lower, cell->upper);
    const REAL s = s_in < 0 ? s_in : 0;
    return a + ab * (s / (s - s_out));
}

/* The same as `beyond`, of a corner between the faces of generators a and b, from the places of all: the product of d
   and the corner loses the digits in which the neighbour differs from a or b, if it is near one of them and far from
   the generator. As seen from that one it does not. NAN if it is not so near, or all are on a circle but for little. */
inline REAL beyond_from_near(const cell_t *cell, int a, int b, const REAL *d, REAL d2, int neighbour,
                             global const REAL *points)
{
    const REAL2 to_a = direction_of(cell->position, a, points), to_b = direction_of(cell->position, b, points);
    const REAL2 to_j = (REAL2)(d[0], d[1]);
    if (!(fmin(dot(to_j - to_a, to_j - to_a), dot(to_j - to_b, to_j - to_b)) < NEAR_EACH_OTHER * d2))
        return NAN;
    const REAL2 from_a = (REAL2)(APART(0, to_a.s0, d[0], points[2 * a], points[2 * neighbour]),
                                 APART(1, to_a.s1, d[1], points[2 * a + 1], points[2 * neighbour + 1]));
    const REAL2 from_b = (REAL2)(APART(0, to_b.s0, d[0], points[2 * b], points[2 * neighbour]),
                                 APART(1, to_b.s1, d[1], points[2 * b + 1], points[2 * neighbour + 1]));
    const REAL2 ab = (REAL2)(APART(0, to_a.s0, to_b.s0, points[2 * a], points[2 * b]),
                             APART(1, to_a.s1, to_b.s1, points[2 * a + 1], points[2 * b + 1]));
    const REAL a2 = dot(from_a, from_a), b2 = dot(from_b, from_b);
    /* From the nearer of the two: to the other, the neighbour, and the generator. */
    const bool is_a = a2 <= b2;
    const REAL2 u = is_a ? ab : -ab, v = is_a ? from_a : from_b, w = is_a ? -to_a : -to_b;
    const REAL u2 = dot(u, u), v2 = fmin(a2, b2), w2 = dot(w, w);
    /* The neighbour is inside of the circle through the three if this has the sign of u x w. */
    const REAL uw = difference_of_products(u.s0, w.s1, u.s1, w.s0);
    const REAL uv = w2 * difference_of_products(u.s0, v.s1, u.s1, v.s0);
    const REAL vw = u2 * difference_of_products(v.s0, w.s1, v.s1, w.s0);
    const REAL sum = uv + vw - v2 * uw, rounding = 8 * REAL_EPS * (fabs(uv) + fabs(vw) + fabs(v2 * uw));
    const REAL side = sum / (2 * uw);
    const bool sure = fabs(sum) > rounding && side * side > LEAST_SIDE * LEAST_SIDE * a2 * b2;
    return sure && (is_a ? uw > 0 : uw < 0) ? side : NAN;
}

/* Might the bisector with the neighbour at x + d be nearly parallel to the face from corner k to the next? Only then is
   it near the face's generator. */
inline bool is_nearly_parallel(const cell_t *cell, int k, const REAL *d, REAL d2)
{
    const int next = k == cell->n - 1 ? 0 : k + 1;
    const REAL2 e = (REAL2)(cell->x[next] - cell->x[k], cell->y[next] - cell->y[k]);
    const REAL along = e.s0 * d[0] + e.s1 * d[1];
    return !(along * along > 2 * NEAR_EACH_OTHER * dot(e, e) * d2);
}

/* What `beyond` is for corner k, where it is found to be `s`, which rounding may turn. */
OUT_OF_LINE REAL beyond_in_doubt(const cell_t *cell, int k, REAL s, const REAL *d, REAL d2, int neighbour,
                                 global const REAL *points)
{
    const int before = k == 0 ? cell->n - 1 : k - 1, a = cell->faces[before], b = cell->faces[k];
    if (a < 0 || b < 0 || !(is_nearly_parallel(cell, before, d, d2) || is_nearly_parallel(cell, k, d, d2)))
        return s;
    const REAL sure = beyond_from_near(cell, a, b, d, d2, neighbour, points);
    return sure > 0 ? fmax(sure, 2 * LEAST_DEPTH * d2) : (sure < 0 ? fmin(s, R(0)) : s);
}

/* Signed distance, times |d|, of corner k from the bisector with the neighbour at x + d. */
inline REAL beyond(const cell_t *cell, int k, const REAL *d, REAL d2, REAL doubt, int neighbour,
                   global const REAL *points)
{
    const REAL s = cell->x[k] * d[0] + cell->y[k] * d[1] - d2 / 2;
    return fabs(s) > doubt ? s : beyond_in_doubt(cell, k, s, d, d2, neighbour, points);
}

/* The first corner that is beyond the bisector by more than `depth`, where some are in doubt; n if there is none. */
OUT_OF_LINE int first_beyond(const cell_t *cell, const REAL *d, REAL d2, REAL depth, REAL doubt, int neighbour,
                             global const REAL *points)
{
    int k = 0;
    while (k < cell->n && !(beyond(cell, k, d, d2, doubt, neighbour, points) > depth))
        ++k;
    return k;
}

inline void copy_corner(cell_t *cell, int to, int from)
{
    cell->x[to] = cell->x[from];
    cell->y[to] = cell->y[from];
    cell->faces[to] = cell->faces[from];
}

/* Cut off what is nearer to the neighbour at x + d: the points y with y.d > d.d / 2. False if the cell is full. */
inline bool clip_cell(cell_t *cell, const REAL *d, REAL d2, int neighbour, bool seen_before, global const REAL *points)
{
    const int n = cell->n;
    const REAL depth = LEAST_DEPTH * d2, doubt = IN_DOUBT * sqrt(d2 * fmax(d2, cell->reach2));
    /* A corner that is cut off, if there is one: as a rule all are far from doubt. */
    int first = 0;
    REAL s_first = 0, far = -REAL_MAX;
    for (; first < n; ++first) {
        s_first = cell->x[first] * d[0] + cell->y[first] * d[1] - d2 / 2;
        if (s_first > depth)
            break;
        far = fmax(far, s_first);
    }
    if (first == n ? far >= -doubt : s_first <= doubt) {
        first = first_beyond(cell, d, d2, depth, doubt, neighbour, points);
        s_first = first < n ? beyond(cell, first, d, d2, doubt, neighbour, points) : 0;
    }
    if (first == n)
        return true;
    if (seen_before)
        for (int k = 0; k < n; ++k)
            if (cell->faces[k] == neighbour)
                return true;

    /* The corners cut off are first..last, cyclically. */
    int last = first, before = first == 0 ? n - 1 : first - 1;
    REAL s_last = s_first, s_before = beyond(cell, before, d, d2, doubt, neighbour, points);
    while (s_before > depth && before != last) {
        first = before;
        s_first = s_before;
        before = first == 0 ? n - 1 : first - 1;
        s_before = beyond(cell, before, d, d2, doubt, neighbour, points);
    }
    int after = last == n - 1 ? 0 : last + 1;
    REAL s_after = beyond(cell, after, d, d2, doubt, neighbour, points);
    while (s_after > depth && after != before) {
        last = after;
        s_last = s_after;
        after = last == n - 1 ? 0 : last + 1;
        s_after = beyond(cell, after, d, d2, doubt, neighbour, points);
    }
    /* Where the bisector meets the faces before -> first and last -> after. */
    const int last_face = cell->faces[last];
    const REAL2 va = cut_face(cell, before, first, s_before, s_first, cell->faces[before], neighbour, d2, points);
    const REAL2 vb = cut_face(cell, after, last, s_after, s_last, last_face, neighbour, d2, points);

    int a; /* where the new corners go: a and a + 1 */
    if (first <= last && first > 0) {
        /* The gap lies inside the list: move the tail so that it is two wide. */
        const int shift = 2 - (last - first + 1);
        if (n + shift > CELL_CAPACITY)
            return false;
        if (shift > 0)
            for (int k = n - 1; k > last; --k)
                copy_corner(cell, k + shift, k);
        else if (shift < 0)
            for (int k = last + 1; k < n; ++k)
                copy_corner(cell, k + shift, k);
        cell->n = n + shift;
        a = first;
    } else {
        /* The gap wraps around the ends: the kept corners after..before move to the front. */
        const int kept = before - after + 1;
        if (kept + 2 > CELL_CAPACITY)
            return false;
        if (after > 0)
            for (int k = 0; k < kept; ++k)
                copy_corner(cell, k, k + after);
        cell->n = kept + 2;
        a = kept;
    }
    cell->x[a] = va.s0;
    cell->y[a] = va.s1;
    cell->faces[a] = neighbour;
    cell->x[a + 1] = vb.s0;
    cell->y[a + 1] = vb.s1;
    cell->faces[a + 1] = last_face;

    REAL reach2 = 0;
    for (int k = 0; k < cell->n; ++k) {
        const REAL r2 = cell->x[k] * cell->x[k] + cell->y[k] * cell->y[k];
        reach2 = r2 > reach2 ? r2 : reach2;
    }
    cell->reach2 = reach2;
    return true;
}

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

/* Might rounding let a neighbour see this cell's faces otherwise? Only where a face is short, or a generator is near
   beside the cell (then far corners are ill-conditioned) or beside the rounding of positions. In single precision
   anything may. */
inline bool is_doubtful(const cell_t *cell, const REAL *x, global const REAL *points)
{
    bool doubtful = !IS_DOUBLE;
    const REAL near2 = fmax(sqrt(REAL_EPS) * cell->reach2, R(1e8) * POSITION_NOISE * POSITION_NOISE);
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
        /* A hundred times what counts as short beside d: the neighbour's rounding is another. */
        doubtful |= e2 < REAL_EPS * d2 || is_short(e2, R(100) * d2) || d2 < near2;
    }
    return doubtful;
}

/* Drop short faces: they arise where more than three cells meet in one point, as in a lattice. One whose two neighbours
   are so nearly parallel that they would meet elsewhere stays. */
inline void drop_short_faces(cell_t *cell, const REAL *x, global const REAL *points)
{
    for (int k = cell->n - 1; k >= 0 && cell->n > 3; --k) {
        const int n = cell->n;
        const int next = k == n - 1 ? 0 : k + 1;
        const REAL ex = cell->x[next] - cell->x[k];
        const REAL ey = cell->y[next] - cell->y[k];
        const REAL e2 = ex * ex + ey * ey;
        if (cell->faces[k] < 0)
            continue;
        const REAL2 d = face_direction(cell->faces[k], x, points);
        if (!is_short(e2, dot(d, d)))
            continue;
        const REAL2 u = face_direction(cell->faces[k == 0 ? n - 1 : k - 1], x, points);
        const REAL2 v = face_direction(cell->faces[next], x, points);
        const REAL turn = u.s0 * v.s1 - u.s1 * v.s0;
        if (turn <= 0 || turn * turn < R(4e-4) * dot(u, u) * dot(v, v))
            continue;
        /* Face k and corner k + 1 go; the faces before and after now meet in corner k. */
        for (int m = k; m < n - 1; ++m) {
            cell->faces[m] = cell->faces[m + 1];
            if (m > k) {
                cell->x[m] = cell->x[m + 1];
                cell->y[m] = cell->y[m + 1];
            }
        }
        if (next == 0) {
            cell->x[0] = cell->x[k];
            cell->y[0] = cell->y[k];
        }
        cell->n = n - 1;
    }
}
