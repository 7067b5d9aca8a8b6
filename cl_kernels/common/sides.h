#include "common/outline.h"

/* The boundary of a cell, run by run of chords: how many sides it has there, a side turning by less than 30 degrees,
   and how many neighbours a hexagonal lattice would have there: 6 - sum of 2 + turning / 60 degrees over the runs. */
typedef struct {
    REAL2 ahead; /* along the chord before, 0 at the start of a run */
    REAL turned, sides, missing;
} outline_t;

#define SIDE_TURN R(0.5235987755982988)

inline void add_side(outline_t *o, REAL2 e, bool chord)
{
    if (!chord) {
        o->ahead = 0;
        o->sides += 1;
        return;
    }
    const bool goes_on = o->ahead.s0 != 0 || o->ahead.s1 != 0;
    const REAL turn = goes_on ? atan2(o->ahead.s0 * e.s1 - o->ahead.s1 * e.s0, dot(o->ahead, e)) : 0;
    o->turned = goes_on ? o->turned + turn : 0;
    if (!goes_on || fabs(o->turned) > SIDE_TURN) {
        o->sides += 1;
        o->turned = 0;
    }
    o->missing += (goes_on ? 0 : 2) + turn / R(1.0471975511965976);
    o->ahead = e;
}

/* A segment between two pieces of the cell: a run that ends there goes on in the other piece, straight on. */
inline void join_runs(outline_t *o)
{
    const bool goes_on = o->ahead.s0 != 0 || o->ahead.s1 != 0;
    o->sides -= goes_on;
    o->missing -= 2 * goes_on;
    o->ahead = 0;
}
