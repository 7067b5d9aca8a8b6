/* Cells in 3D that are updated; see polyhedra_update.cl. */
#include "geometry/domain.h"
#include "tessellation/corner_shares.h"
#include "tessellation/own_planes.h"

#define ALL_FACES (-1)
#define MORE 8 /* room for further neighbors of a cell */
#define NO_NEIGHBOR INT_MIN

/* Marks of a cell: it must be updated again with further neighbors, or clipped; it has been counted. */
#define UPDATE_AGAIN 1
#define CLIP_ANEW 2
#define COUNTED 4

/* Which cells an update makes: all; or those that are marked, with further neighbors. */
#define ALL_CELLS 0
#define MARKED_CELLS 1

/* A hash of the other cell or wall at a face. */
inline uint hash_of_label(int label)
{
    uint h = as_uint(label) * 2654435761u;
    h = (h ^ (h >> 15)) * 2246822519u;
    return (h ^ (h >> 13)) | 1;
}

typedef struct {
    global const int *starts, *neighbors;
    global int *more; /* MORE further neighbors per generator */
    global const REAL *points;
    REAL4 box_lower, box_upper;
#ifdef PERIODIC
    REAL4 periods;
#endif
    own_t own;
    int n; /* number of cells; generators from n on have none */
} rows_t;

/* The rows for generator i, from the arguments of a kernel. */
#define ROWS(i)                                                                                                        \
    {                                                                                                                  \
        old_starts, old_neighbors, more, points, box_lower, box_upper PERIODS, OWN_OF(i), n                            \
    }

/* Number of the plane of its own that a cell has with this label; -1 if it has none. */
inline int own_plane_of(int label, const own_t *own)
{
    int found = -1;
    for (int k = 0; k < own_count(own); ++k)
        found = own_label(own, k) == label ? k : found;
    return found;
}

/* Whether a cell with a face of this label must be clipped: it has lost this wall, or no cell is behind it with which
   the face could be compared. */
inline bool must_clip(int label, const rows_t *in)
{
    if (label < 0)
        return WALLS_MOVE && own_plane_of(label, &in->own) < 0;
    return label >= in->n;
}

/* The plane (p, d^2) between a generator at x and a neighbor or wall. */
inline REAL4 plane_of_face(int label, REAL4 x, const rows_t *in)
{
    REAL4 d = 0;
    if (label >= 0) {
        d = (REAL4)(in->points[3 * label], in->points[3 * label + 1], in->points[3 * label + 2], 0) - x;
        d = (REAL4)(nearest_image(d.s0, in->periods.s0), nearest_image(d.s1, in->periods.s1),
                    nearest_image(d.s2, in->periods.s2), 0);
    } else if (WALLS_MOVE) {
        const REAL4 own = own_plane(&in->own, own_plane_of(label, &in->own));
        d = (REAL4)(own.s0, own.s1, own.s2, 0) * (2 * own.s3);
    } else {
        const int wall = -1 - label;
        const REAL4 across = 2 * ((wall & 1 ? in->box_upper : in->box_lower) - x);
        d = (REAL4)(wall < 2 ? across.s0 : 0, wall >> 1 == 1 ? across.s1 : 0, wall > 3 ? across.s2 : 0, 0);
    }
    const REAL d2 = d.s0 * d.s0 + d.s1 * d.s1 + d.s2 * d.s2, inverse = 1 / d2;
    return (REAL4)(d.s0 * inverse, d.s1 * inverse, d.s2 * inverse, d2);
}

/* Whether the generators about each vertex are nearest images of each other; no vertex is farther than reach2. */
inline bool has_nearest_images(REAL reach2, const rows_t *in)
{
    bool nearest = true;
#ifdef PERIODIC
    const REAL4 periods = in->periods;
    EACH_AXIS (a)
        nearest = nearest && !(PERIOD(a) > 0 && 16 * reach2 >= PERIOD(a) * PERIOD(a));
#endif
    return nearest;
}

inline bool names_neighbor(int label, int i, const rows_t *in)
{
    bool found = false;
    const int end = in->starts[i + 1];
    for (int k = in->starts[i]; k < end; ++k)
        found |= in->neighbors[k] == label;
    return found;
}

/* Round-off of the distance from a wall, of a vertex as far as `reach`. */
#define WALL_NOISE(reach) (64 * REAL_EPS * (1 + (reach)))

/* The set of the planes of its own that vertex y of a cell is beyond: one bit each. */
inline uint own_planes_before(REAL4 y, REAL noise, const own_t *own)
{
    uint set = 0;
    for (int k = 0; k < own_count(own); ++k) {
        const REAL4 plane = own_plane(own, k);
        const REAL along = fma(plane.s0, y.s0, fma(plane.s1, y.s1, plane.s2 * y.s2));
        set |= (uint)(along > plane.s3 + noise) << k;
    }
    return set;
}

/* Make `label` a further neighbor of i, unless it was one; i is clipped if there is no room. */
inline void add_neighbor(int i, int label, const rows_t *in, global int *marks)
{
    if (i < 0 || names_neighbor(label, i, in))
        return;
    for (int k = 0; k < MORE; ++k) {
        const int known = atomic_cmpxchg(in->more + MORE * i + k, NO_NEIGHBOR, label);
        if (known == label)
            return;
        if (known == NO_NEIGHBOR) {
            atomic_or(marks + i, UPDATE_AGAIN);
            return;
        }
    }
    atomic_or(marks + i, CLIP_ANEW);
}
