/* The planes of walls that cut the cell of one generator, and no other cell: in a solid (macro SOLID).

   own_rows[i]    place of the first of its planes, and their number
   own_labels     -1 - patch
   own_planes     outward unit normal, and distance from the generator, which is positive
   own_found[i]   the surface is known up to this distance
   own_reach[i]   up to where the cell reaches, and somewhat more: what should be known of the surface next time

   CLIP_BOX_ARGS: what cells start from. The box lies around the solid, so that it never bounds a finished cell. */
#include "opencl/real.h"

#ifdef SOLID
#define OWN_ARGS                                                                                                       \
    , global const int2 *own_rows, global const int *own_labels, global const REAL4 *own_planes,                       \
        global const float *own_found, global float *own_reach
#define OWN , own_rows, own_labels, own_planes, own_found, own_reach
#define WALLS_MOVE 1 /* with the generators */
#define BOX_LABEL(side) (INT_MIN + 1 + (side))
#else
#define OWN_ARGS
#define OWN
#define WALLS_MOVE 0
#define BOX_LABEL(side) (-1 - (side))
#endif
#define CLIP_BOX_ARGS const REAL4 box_lower, const REAL4 box_upper OWN_ARGS
#define CLIP_BOX box_lower, box_upper OWN

#ifdef SOLID
#define FURTHER 1.4f

/* Whether everything of the surface is known that a cell may touch whose farthest vertex has the squared distance
   `reach2`. Notes the reach. */
inline bool knows_walls(int i, REAL reach2, global const float *own_found, global float *own_reach)
{
    const float reach = (float)sqrt(reach2);
    own_reach[i] = FURTHER * reach;
    return reach <= own_found[i];
}
#endif
