#include "tessellation/clipped/boundary.h"
#include "tessellation/clipped/outline.h"

/* The outline of a cell, side by side: a face between cells is one, and so is each stretch of the boundary along which
   it turns by no more than 30 degrees. A stretch counts as if it were straight, from its first end to its last, with
   the area that the cell then has: as a polygon of so many sides.

   A run is what one cell has of a ring without a break, in however many pieces it came to the cell: chord by chord, as
   the ring goes on. Its first stretch begins where it begins; of a ring that is all one cell's, in its sharpest corner.
   A hole that is all within a cell is no side of it. How many neighbors a hexagonal lattice would have at the
   boundary: 6 - sum of 2 + turning / 60 degrees over the runs. */
typedef struct {
    REAL sides, missing;
    REAL perimeter, area; /* twice the area */
} outline_t;

/* 30 degrees and a little more, which no part of a regular ring turns by: an arc of 2 x 15 degrees is one side, however
   its sum rounds. The host adds up the same numbers in the same order (outlines.py). */
#define SIDE_TURN R(0.524110102527594)

/* The boundary as the cells of a trimmed diagram have it.

   owners[chord]  the generator whose cell it bounds, -1 for those without length, which are passed over
   before[e]      the edge before edge e in its ring; -1 - that where e begins in the ring's sharpest corner
   turns[e]       how far the boundary turns to the left where edge e begins */
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
    outline_t o = {0, 0, 0, 0};
    return o;
}

inline void add_straight(outline_t *o, REAL2 p, REAL2 q)
{
    const REAL2 e = q - p;
    o->perimeter += sqrt(dot(e, e));
    o->area += difference_of_products(p.s0, q.s1, p.s1, q.s0);
}

/* A face between cells. */
inline void add_wall_face(outline_t *o, REAL2 p, REAL2 q)
{
    o->sides += 1;
    add_straight(o, p, q);
}

/* The next chord that has a length; the boundary turns on the way there. */
inline int chord_past(const shore_t *s, int chord, REAL *turned)
{
    do {
        chord = chord_after(&s->c, chord);
        if (begins_inside(&s->c, chord))
            *turned += s->turns[s->c.edges[chord]];
    } while (s->owners[chord] < 0);
    return chord;
}

/* Are all chords of the ring generator i's? */
inline bool is_ring(const shore_t *s, int chord, int i)
{
    REAL turned = 0;
    int other = chord;
    do
        other = chord_past(s, other, &turned);
    while (other != chord && s->owners[other] == i);
    return other == chord;
}

/* Does a run of generator i begin with the chord? */
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

/* The run of generator i, at x, that begins with `first`. */
inline void add_wall_sides(outline_t *o, const shore_t *s, int first, int i, REAL2 x)
{
    const bool is_hole = s->c.shells[s->c.edges[first]] >= 0 && is_ring(s, first, i);
    REAL2 begin = chord_begin(&s->c, first) - x;
    REAL turned = 0;
    bool goes_on = true;
    o->sides += !is_hole;
    o->missing += is_hole ? 0 : 2;
    for (int chord = first; goes_on;) {
        REAL sum = turned;
        const int next = chord_past(s, chord, &sum);
        const REAL2 end = chord_end(&s->c, chord) - x;
        const bool turns = fabs(sum) > SIDE_TURN;
        goes_on = next != first && s->owners[next] == i;
        if (!goes_on || turns || is_hole) {
            add_straight(o, begin, end);
            begin = end;
        }
        if (goes_on && !is_hole) {
            o->sides += turns;
            o->missing += (sum - turned) / R(1.0471975511965976);
        }
        turned = turns ? 0 : sum;
        chord = next;
    }
}
