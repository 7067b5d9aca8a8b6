/* A convex polygon around its generator, and its clipping by the bisector with a neighbor.
   Coordinates are relative to the generator: differences of close positions are exact, so cells of any size are
   accurate. */
#include "tessellation/corner.h"
#ifdef SPHERE
#include "tessellation/sphere_circles.h"
#else
#include "tessellation/half_planes.h"
#endif
#ifdef WEIGHTED
#include "tessellation/weight_bounds.h"
#endif

#ifndef CELL_CAPACITY
#error "build with -DCELL_CAPACITY=faces that a cell may have while it is clipped"
#endif

/* Uncertainty of distances from a bisector, as a share of d or of the distance of the corners. */
#define IN_DOUBT (256 * REAL_EPS)

/* Face k runs counter-clockwise from corner k to corner k + 1 and belongs to faces[k]: a generator, or -1 - wall. */
typedef struct {
    int n;
    REAL x[CELL_CAPACITY];
    REAL y[CELL_CAPACITY];
    int faces[CELL_CAPACITY];
    REAL reach2; /* largest squared distance of a corner from the generator */
    /* The generator and its position. */
    int generator;
    REAL position[SITE_SIZE], lower[2], upper[2];
#ifdef WEIGHTED
    REAL most; /* largest excess of the weight of a generator that is searched over that of this one */
#endif
} cell_t;

/* Square of the distance beyond which no generator cuts the cell: twice the reach. Corners of nearly parallel faces
   have an error of eps over the angle, and so has the reach. */
inline REAL cutting_distance2(const cell_t *cell)
{
#ifdef WEIGHTED
    const REAL far = cutting_radius(cell->reach2 * R(1.01), cell->most);
    return far * far;
#else
    return 4 * cell->reach2 * R(1.01);
#endif
}

/* Start with the whole box around generator x; on a sphere, with a square in the tangent plane. */
inline void start_polygon(cell_t *cell, int i, const REAL *x, const REAL *lower, const REAL *upper)
{
    cell->generator = i;
    for (int a = 0; a < SITE_SIZE; ++a)
        cell->position[a] = x[a];
    for (int a = 0; a < 2; ++a) {
        cell->lower[a] = lower[a];
        cell->upper[a] = upper[a];
    }
    cell->n = 4;
    cell->x[0] = cell->x[3] = LOWER_SIDE(0);
    cell->x[1] = cell->x[2] = UPPER_SIDE(0);
    cell->y[0] = cell->y[1] = LOWER_SIDE(1);
    cell->y[2] = cell->y[3] = UPPER_SIDE(1);
    cell->faces[0] = -1 - 2;
    cell->faces[1] = -1 - 1;
    cell->faces[2] = -1 - 3;
    cell->faces[3] = -1 - 0;
    const REAL rx = fmax(-cell->x[0], cell->x[1]);
    const REAL ry = fmax(-cell->y[0], cell->y[2]);
    cell->reach2 = rx * rx + ry * ry;
}

/* Intersection of a face with the bisector that cuts it between the corners `in` and `out`, at signed distances
   s_in <= 0 < s_out. Interpolation has an error of eps times the length of the face, more if the two are nearly
   parallel. Where this is large, also compared with the distance of the generators (near-duplicates; in single
   precision a ten-thousandth), the corner is computed from the generators instead. */
inline REAL2 cut_face(const cell_t *cell, int in, int out, REAL s_in, REAL s_out, int face, int neighbor, REAL d2,
                      global const REAL *points)
{
    const REAL2 a = (REAL2)(cell->x[in], cell->y[in]);
    const REAL2 ab = (REAL2)(cell->x[out], cell->y[out]) - a;
    const REAL across = s_out - s_in, ab2 = dot(ab, ab);
    if (across * across < R(4e-3) * d2 * ab2 || d2 < R(1e-3) * ab2) {
        const REAL2 v = corner(cell->generator, cell->position, face, neighbor, points, cell->lower, cell->upper);
        /* Parallel lines do not intersect, whatever the round-off. */
        if (dot(v, v) <= 4 * cell->reach2)
            return v;
    }
    const REAL s = s_in < 0 ? s_in : 0;
    return a + ab * (s / (s - s_out));
}

/* Signed distance, times |d|, of corner k from the bisector { y : y.d = level } with the neighbor at x + d. Computed
   from the positions of the generators if round-off may have moved the corner to the other side. */
inline REAL beyond(const cell_t *cell, int k, const REAL *d, REAL level, REAL doubt, int neighbor,
                   global const REAL *points)
{
    const REAL s = cell->x[k] * d[0] + cell->y[k] * d[1] - level;
    if (fabs(s) > doubt)
        return s;
    const int before = k == 0 ? cell->n - 1 : k - 1;
#ifdef SPHERE
    if (cell->faces[before] < 0 || cell->faces[k] < 0)
        return s;
    const REAL side = beyond_circle(cell->generator, cell->faces[before], cell->faces[k], neighbor, points);
    return side == 0 ? 0 : copysign(fabs(s) + REAL_EPS * doubt, side);
#else
    return beyond_corner(cell->position, cell->faces[before], cell->faces[k], neighbor, points, cell->lower,
                         cell->upper);
#endif
}

/* The first corner beyond the bisector, if some are in doubt; n if there is none. */
OUT_OF_LINE int first_beyond(const cell_t *cell, const REAL *d, REAL level, REAL doubt, int neighbor,
                             global const REAL *points)
{
    int k = 0;
    while (k < cell->n && !(beyond(cell, k, d, level, doubt, neighbor, points) > 0))
        ++k;
    return k;
}

inline void copy_corner(cell_t *cell, int to, int from)
{
    cell->x[to] = cell->x[from];
    cell->y[to] = cell->y[from];
    cell->faces[to] = cell->faces[from];
}

/* Clip the cell by the bisector with the neighbor at x + d: remove the points y with y.d > level; see weights.h. In a
   power diagram nothing may be left. False if the cell is full. */
inline bool clip_polygon(cell_t *cell, const REAL *d, REAL d2, int neighbor, bool seen_before,
                         global const REAL *points)
{
    const int n = cell->n;
    const REAL level = (d2 - WEIGHT_EXCESS(cell->position, neighbor, d2, points)) / 2;
#ifdef WEIGHTED
    if (level > 0 && level * level > R(1.01) * d2 * cell->reach2)
        return true;
#endif
    const REAL doubt = IN_DOUBT * sqrt(d2 * fmax(d2, cell->reach2));
    /* A corner to remove, if any. Usually no corner is in doubt. */
    int first = 0;
    REAL s_first = 0, far = -REAL_MAX;
    for (; first < n; ++first) {
        s_first = cell->x[first] * d[0] + cell->y[first] * d[1] - level;
        if (s_first > doubt)
            break;
        far = fmax(far, s_first);
    }
    if (first == n && far >= -doubt) {
        first = first_beyond(cell, d, level, doubt, neighbor, points);
        s_first = first < n ? beyond(cell, first, d, level, doubt, neighbor, points) : 0;
    }
    if (first == n)
        return true;
    if (seen_before)
        for (int k = 0; k < n; ++k)
            if (cell->faces[k] == neighbor)
                return true;

    /* The removed corners are first..last, cyclically. */
    int last = first, before = first == 0 ? n - 1 : first - 1;
    REAL s_last = s_first, s_before = beyond(cell, before, d, level, doubt, neighbor, points);
    while (s_before > 0 && before != last) {
        first = before;
        s_first = s_before;
        before = first == 0 ? n - 1 : first - 1;
        s_before = beyond(cell, before, d, level, doubt, neighbor, points);
    }
#ifdef WEIGHTED
    if (s_before > 0) {
        cell->n = 0;
        cell->reach2 = 0;
        return true;
    }
#endif
    int after = last == n - 1 ? 0 : last + 1;
    REAL s_after = beyond(cell, after, d, level, doubt, neighbor, points);
    while (s_after > 0 && after != before) {
        last = after;
        s_last = s_after;
        after = last == n - 1 ? 0 : last + 1;
        s_after = beyond(cell, after, d, level, doubt, neighbor, points);
    }
    /* The bisector cuts the faces before -> first and last -> after. */
    const int last_face = cell->faces[last];
    const REAL2 va = cut_face(cell, before, first, s_before, s_first, cell->faces[before], neighbor, d2, points);
    const REAL2 vb = cut_face(cell, after, last, s_after, s_last, last_face, neighbor, d2, points);

    int a; /* indices of the new corners: a and a + 1 */
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
    cell->faces[a] = neighbor;
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
