/* The search for generators that may cut a polyhedron, and what may go wrong. */
#include "tessellation/clip.h"
#include "tessellation/row_counts.h"

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
