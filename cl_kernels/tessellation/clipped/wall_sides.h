#include "tessellation/clipped/boundary.h"
#include "tessellation/clipped/outline.h"

/* The sides of a cell as the mesh for solvers has it: its faces with other cells, and straight sides along the
   boundary.

   A run is a contiguous part of a ring that bounds one cell, chord by chord. It becomes one side from its first to its
   last point, with convex corners of the domain between: as in the algorithm of Douglas and Peucker the farthest point
   outside divides a side, if it is far enough, and the domain fills the triangle. A re-entrant corner is cut off. A
   ring around a whole cell stays as it is, and a hole inside a cell is no side. The host does the same
   (straightening.py), and so does the mesh for solvers (walls.py).

   The number of neighbors of a hexagonal lattice at the boundary is 6 - the sum of 2 + turning / 60 degrees over the
   runs. */
typedef struct {
    REAL sides, missing, perimeter;
    moments_t m;
} outline_t;

#ifndef LEAST_BULGE
#error "build with -DLEAST_BULGE, FILLED and LEAST_AREA of straightening.py"
#endif
#define MOST_PARTS 16 /* parts of a run that wait to be divided */

/* The boundary of the cells of a clipped diagram.

   owners[chord]  the generator whose cell it bounds, -1 for chords of zero length, which are skipped
   before[e]      the edge before edge e in its ring; -1 - that if e begins at the sharpest corner of the ring
   turns[e]       turning angle to the left at the start of edge e */
typedef struct {
    chords_t c;
    global const int *owners, *before;
    global const REAL *turns;
} shore_t;

#define SHORE_ARGS CHORD_ARGS, global const int *chord_owners, global const int *edges_before, global const REAL *turns
#define SHORE                                                                                                          \
    {                                                                                                                  \
        CHORDS, chord_owners, edges_before, turns                                                                      \
    }

inline outline_t no_outline(void)
{
    outline_t o = {0, 0, 0, {0, 0, 0, 0, 0, 0}};
    return o;
}

inline void add_side(outline_t *o, REAL2 p, REAL2 q)
{
    const REAL2 e = q - p;
    o->sides += 1;
    o->perimeter += sqrt(dot(e, e));
    add_triangle(&o->m, p, q);
}

/* The next chord of nonzero length, and the turning angle up to it. */
inline int chord_past(const shore_t *s, int chord, REAL *turned)
{
    do {
        chord = chord_after(&s->c, chord);
        if (begins_inside(&s->c, chord))
            *turned += s->turns[s->c.edges[chord]];
    } while (s->owners[chord] < 0);
    return chord;
}

/* Whether all chords of the ring bound generator i. */
inline bool is_ring(const shore_t *s, int chord, int i)
{
    REAL turned = 0;
    int other = chord;
    do
        other = chord_past(s, other, &turned);
    while (other != chord && s->owners[other] == i);
    return other == chord;
}

/* Whether a run of generator i begins with the chord. */
inline bool begins_run(const shore_t *s, int chord, int i)
{
    bool sharpest = false;
    int other = chord;
    do {
        if (begins_inside(&s->c, other)) {
            const int edge = s->before[s->c.edges[other]];
            sharpest |= edge < 0;
            other = s->c.firsts[(edge < 0 ? -1 - edge : edge) + 1];
        }
        --other;
    } while (s->owners[other] < 0);
    return s->owners[other] != i || (sharpest && is_ring(s, chord, i));
}

/* The first chord of the part of a run from chord `first` to chord `last` that begins in a convex corner between
   straight sides, and the chord before; -1 if there is none. Positions are relative to x. */
inline int2 corner_between(const shore_t *s, int first, int last, REAL2 x, REAL size)
{
    const REAL2 p = chord_begin(&s->c, first) - x, side = chord_end(&s->c, last) - x - p;
    const REAL length = sqrt(dot(side, side));
    REAL farthest = 0, area = 0, turned = 0;
    int2 found = -1;
    for (int chord = first; chord != last;) {
        const int next = chord_past(s, chord, &turned);
        const REAL2 u = chord_begin(&s->c, chord) - x - p, v = chord_end(&s->c, chord) - x - p;
        const REAL off = v.s0 * side.s1 - v.s1 * side.s0;
        area += difference_of_products(u.s0, v.s1, u.s1, v.s0);
        if (off > farthest) {
            farthest = off;
            found = (int2)(next, chord);
        }
        chord = next;
    }
    const REAL2 u = chord_begin(&s->c, last) - x - p;
    area += difference_of_products(u.s0, side.s1, u.s1, side.s0);
    const bool is_corner = length > 0 && farthest >= R(LEAST_BULGE) * size * length && area >= R(FILLED) * farthest;
    return is_corner ? found : (int2)(-1);
}

/* Add the run of generator i, at x, that begins with chord `first`. The cell has the size `size`. */
inline void add_wall_sides(outline_t *o, const shore_t *s, int first, int i, REAL2 x, REAL size)
{
    const bool goes_round = is_ring(s, first, i);
    if (goes_round && s->c.shells[s->c.edges[first]] >= 0)
        return; /* a hole */
    REAL turned = 0;
    int last = first;
    for (;;) {
        if (goes_round)
            add_side(o, chord_begin(&s->c, last) - x, chord_end(&s->c, last) - x);
        REAL sum = turned;
        const int next = chord_past(s, last, &sum);
        if (next == first || s->owners[next] != i)
            break;
        turned = sum;
        last = next;
    }
    o->missing += 2 + turned / R(1.0471975511965976);
    if (goes_round)
        return;
    int2 parts[MOST_PARTS];
    parts[0] = (int2)(first, last);
    for (int count = 1; count > 0;) {
        const int2 part = parts[--count];
        const int2 corner = count + 2 <= MOST_PARTS ? corner_between(s, part.s0, part.s1, x, size) : (int2)(-1);
        if (corner.s0 < 0) {
            add_side(o, chord_begin(&s->c, part.s0) - x, chord_end(&s->c, part.s1) - x);
        } else {
            parts[count++] = (int2)(corner.s0, part.s1);
            parts[count++] = (int2)(part.s0, corner.s1);
        }
    }
}
