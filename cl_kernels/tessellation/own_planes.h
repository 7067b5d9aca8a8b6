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
#define BOX_LABEL(side) (INT_MIN + 1 + (side))
#else
#define OWN_ARGS
#define OWN
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

/* The outward unit normal of the wall at a face of the cell of generator i, by the label of the face. */
inline REAL4 wall_normal(int i, int label, CLIP_BOX_ARGS)
{
    REAL4 normal = 0;
#ifdef SOLID
    for (int k = own_rows[i].s0; k < own_rows[i].s0 + own_rows[i].s1; ++k)
        normal = own_labels[k] == label ? own_planes[k] : normal;
    normal.s3 = 0;
#else
    const int wall = -1 - label;
    const REAL sign = wall % 2 ? 1 : -1;
    normal = (REAL4)(wall < 2 ? sign : 0, wall / 2 == 1 ? sign : 0, wall > 3 ? sign : 0, 0);
#endif
    return normal;
}
