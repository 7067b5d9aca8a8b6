/* The search for generators that may cut a cell on the sphere. */
#include "tessellation/face_rows.h"

/* Clip the cell by generator j. Returns FLAG_* or 0. */
inline int clip_sphere_cell(cell_t *cell, int j, bool seen_before, global const REAL *points)
{
    const REAL2 way = direction_of(cell->position, j, points);
    const REAL d[2] = {way.s0, way.s1};
    return clip_polygon(cell, d, dot(way, way), j, seen_before, points) ? 0 : FLAG_FULL;
}

#define CELL cell_t
#ifdef WEIGHTED
#define CUTTING_SQUARE(cell) cutting_distance2(cell)
#endif
#define CLIP_BY_ITEM(cell, d, j, warm, points) clip_sphere_cell(cell, j, warm, points)
#include "tessellation/search.h"
