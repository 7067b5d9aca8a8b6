#include "tessellation/clipped/boundary.h"
#include "tessellation/clipped/outline.h"

/* The sides of a cell: its faces with other cells, and each stretch of the boundary that turns by at most 30 degrees. A
   stretch counts as one straight side, from its first to its last point; area and quality follow.

   A run is a contiguous part of a ring that bounds one cell, chord by chord. Its first stretch begins at its start or,
   for a ring around a whole cell, at the sharpest corner. A hole inside a cell is not a side. The number of neighbors
   of a hexagonal lattice at the boundary is 6 - the sum of 2 + turning / 60 degrees over the runs. */
typedef struct {
    REAL sides, missing;
    REAL perimeter, area; /* twice the area */
} outline_t;

/* Slightly more than 30 degrees, so that an arc of 2 x 15 degrees is one side despite round-off. The host adds the same
   numbers in the same order (straightening.py). */
#define SIDE_TURN R(0.524110102527594)

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

/* Add the run of generator i, at x, that begins with chord `first`. */
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
