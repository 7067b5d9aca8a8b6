/* The search for generators that may cut a polyhedron, and what may go wrong. */
#include "tessellation/clip.h"

/* Bits of the error word of kernels. */
#define FLAG_FULL 1      /* a cell has more faces than FACE_CAPACITY */
#define FLAG_COINCIDE 2  /* two generators at the same place */
#define FLAG_COLLAPSED 4 /* generators too close for the precision */
#define FLAG_DOUBT 8     /* no error: there are doubtful cells, whose faces must be matched */
#define FLAG_NARROW 16   /* no error: some faces may be no wider than round-off; see consistency.cl */
#define FLAG_UNEVEN 64   /* no error: two cells differ about their common face by more than a small share of one */

/* The flag for an outcome of clip_polyhedron or clip_polyhedron_by_row, or 0. */
inline int flag_of(int what)
{
    return what < CLIP_FULL
               ? 0
               : (what == CLIP_FULL ? FLAG_FULL : (what == CLIP_COINCIDE ? FLAG_COINCIDE : FLAG_COLLAPSED));
}

#define CLIP_BY_ITEM(cell, d, j, warm, points) flag_of(clip_polyhedron(cell, d, (d).s3, j, warm, points))
#ifdef WEIGHTED
#include "tessellation/weight_bounds.h"
#define CUTTING_SQUARE(cell) cutting_square(cell)
inline REAL cutting_square(const CELL *cell)
{
    const REAL far = cutting_radius(cell->reach2, cell->most);
    return far * far;
}
#endif
#include "tessellation/search.h"
