#include "common/outline.h"

/* The outline of a cell, side by side: a face between cells is one, and so is each stretch of the boundary along which
   it turns by no more than 30 degrees. A stretch counts as if it were straight, from its first end to its last, with
   the area that the cell then has: as a polygon of so many sides. How many neighbours a hexagonal lattice would have at
   the boundary: 6 - sum of 2 + turning / 60 degrees over its runs. */
typedef struct {
    REAL2 ahead;                         /* along the chord before, 0 at the start of a run */
    REAL2 begin, end;                    /* of the stretch at hand */
    REAL2 first, first_end, first_ahead; /* of a piece's first stretch: where it begins and ends, its direction */
    REAL turned, sides, missing;
    REAL perimeter, area; /* twice the area */
    bool begun, open;     /* is the first stretch at an end; is there anything else than boundary? */
} outline_t;

#define SIDE_TURN R(0.5235987755982988)

inline outline_t no_outline(void)
{
    outline_t o = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, false, false};
    return o;
}

inline REAL turn_from_to(REAL2 a, REAL2 b)
{
    return atan2(a.s0 * b.s1 - a.s1 * b.s0, dot(a, b));
}

inline bool goes_along(const outline_t *o)
{
    return o->ahead.s0 != 0 || o->ahead.s1 != 0;
}

/* A piece of the outline that is straight, or of an island's, which is no side. */
inline void add_straight(outline_t *o, REAL2 p, REAL2 q)
{
    const REAL2 e = q - p;
    o->perimeter += sqrt(dot(e, e));
    o->area += difference_of_products(p.s0, q.s1, p.s1, q.s0);
}

/* The stretch at hand, if there is one, ends. */
inline void end_stretch(outline_t *o)
{
    if (!goes_along(o))
        return;
    add_straight(o, o->begin, o->end);
    if (!o->begun)
        o->first_end = o->end;
    o->begun = true;
}

/* A face between cells. */
inline void add_face(outline_t *o, REAL2 p, REAL2 q)
{
    end_stretch(o);
    o->open = true;
    o->ahead = 0;
    o->sides += 1;
    add_straight(o, p, q);
}

/* A chord of the boundary with the direction `ahead`. */
inline void add_chord(outline_t *o, REAL2 p, REAL2 q, REAL2 ahead)
{
    const bool goes_on = goes_along(o);
    const REAL turn = goes_on ? turn_from_to(o->ahead, ahead) : 0;
    o->turned = goes_on ? o->turned + turn : 0;
    if (!goes_on || fabs(o->turned) > SIDE_TURN) {
        end_stretch(o);
        if (!goes_on && !o->begun && !o->open) {
            o->first = p;
            o->first_ahead = ahead;
        }
        o->sides += 1;
        o->turned = 0;
        o->begin = p;
    }
    o->end = q;
    o->missing += (goes_on ? 0 : 2) + turn / R(1.0471975511965976);
    o->ahead = ahead;
}

/* A segment between two pieces of the cell: a run that ends there goes on in the other piece, straight on. Its stretch
   does not: both parts, not known to each other, may turn. */
inline void join_runs(outline_t *o)
{
    end_stretch(o);
    o->open = true;
    o->missing -= 2 * goes_along(o);
    o->ahead = 0;
}

/* A piece is complete. If it is boundary all around it may be back on the stretch with which it began. */
inline void end_piece(outline_t *o)
{
    const REAL2 p = o->begin, q = o->first, r = o->first_end;
    const bool around = !o->open && o->begun;
    end_stretch(o);
    if (around && fabs(o->turned + turn_from_to(o->ahead, o->first_ahead)) <= SIDE_TURN) {
        o->sides -= 1;
        o->perimeter += sqrt(dot(r - p, r - p)) - sqrt(dot(q - p, q - p)) - sqrt(dot(r - q, r - q));
        o->area -= difference_of_products(q.s0 - p.s0, r.s1 - p.s1, q.s1 - p.s1, r.s0 - p.s0);
    }
    o->ahead = 0;
    o->begun = o->open = false;
}
