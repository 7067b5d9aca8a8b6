/* The planes of walls that cut the cell of one generator, and no other cell: where cells have walls of their own.

   own_rows[i]    place of the first of its planes, and their number
   own_labels     -1 - patch
   own_planes     outward unit normal, and distance from the generator, which is positive
   own_found[i]   the surface is known up to this distance
   own_reach[i]   up to where the cell reaches, and somewhat more: what should be known of the surface next time

   CLIP_BOX_ARGS: what cells start from. The box lies around the solid, so that it never bounds a finished cell. */
#include "opencl/real.h"

#ifdef OWN_WALLS
#define OWN_ARGS                                                                                                       \
    , global const int2 *own_rows, global const int *own_labels, global const REAL4 *own_planes,                       \
        global const float *own_found, global float *own_reach
#define OWN , own_rows, own_labels, own_planes, own_found, own_reach
#define WALLS_MOVE 1 /* with the generators */
#define BOX_LABEL(side) (INT_MIN + 1 + (side))
#define FURTHER 1.4f

/* What is known of the walls near one generator. */
typedef struct {
    int2 row;
    global const int *labels;
    global const REAL4 *planes;
    global const float *found;
    global float *reach;
} own_t;
#define OWN_OF(i)                                                                                                      \
    {                                                                                                                  \
        own_rows[i], own_labels, own_planes, own_found, own_reach                                                      \
    }

inline int own_count(const own_t *own)
{
    return own->row.s1;
}

inline REAL4 own_plane(const own_t *own, int k)
{
    return own->planes[own->row.s0 + k];
}

inline int own_label(const own_t *own, int k)
{
    return own->labels[own->row.s0 + k];
}

/* Whether everything of the surface is known that the cell of generator i may touch, whose farthest vertex has the
   squared distance `reach2`. Notes the reach. */
inline bool knows_walls(int i, REAL reach2, const own_t *own)
{
    const float reach = (float)sqrt(reach2);
    own->reach[i] = FURTHER * reach;
    return reach <= own->found[i];
}

inline bool has_own(int i OWN_ARGS)
{
    return own_rows[i].s1 > 0;
}
#else
#define OWN_ARGS
#define OWN
#define WALLS_MOVE 0
#define BOX_LABEL(side) (-1 - (side))

typedef struct {
    int none;
} own_t;
#define OWN_OF(i)                                                                                                      \
    {                                                                                                                  \
        0                                                                                                              \
    }
#define own_count(own) 0
#define own_plane(own, k) ((REAL4)(0))
#define own_label(own, k) BOX_LABEL(k)

inline bool knows_walls(int i, REAL reach2, const own_t *own)
{
    return true;
}

inline bool has_own(int i)
{
    return false;
}
#endif
#define CLIP_BOX_ARGS const REAL4 box_lower, const REAL4 box_upper OWN_ARGS
#define CLIP_BOX box_lower, box_upper OWN
