/* State of cells in 3D that are traced along their edges (edge_walk.h), one per vector lane. */
#include "simd/plane_lists.h"

#define HULL_CAPACITY 48                    /* most faces of a cell */
#define CORNER_CAPACITY (2 * HULL_CAPACITY) /* most vertices */

typedef struct {
    double8 x, y, z;
} vectors_t;

inline double8 dot8(vectors_t a, vectors_t b)
{
    return fma(a.x, b.x, fma(a.y, b.y, a.z * b.z));
}

inline vectors_t cross_in_space(vectors_t a, vectors_t b)
{
    const vectors_t c = {fma(a.y, b.z, -a.z * b.y), fma(a.z, b.x, -a.x * b.z), fma(a.x, b.y, -a.y * b.x)};
    return c;
}

/* a + s b */
inline vectors_t along8(vectors_t a, double8 s, vectors_t b)
{
    const vectors_t c = {fma(s, b.x, a.x), fma(s, b.y, a.y), fma(s, b.z, a.z)};
    return c;
}

/* The cells: bisectors of their faces, in the order of discovery. */
typedef struct {
    planes_t planes[HULL_CAPACITY + 1];
    int places[(HULL_CAPACITY + 1) * LANES];
    int faces[LANES], corners[LANES];
    long doubt[LANES], lost[LANES]; /* whether a decision is uncertain; whether the cell is open */
    double8 reach2;                 /* largest squared distance of a vertex */
} cells_t;

/* The topology that one lane has found. */
typedef struct {
    ulong sides[HULL_CAPACITY];           /* bit b of [a]: a and b are consecutive at some vertex */
    uchar4 corner_faces[CORNER_CAPACITY]; /* counter-clockwise */
    uchar4 edges[CORNER_CAPACITY + 4];    /* to be traced: two consecutive faces at a corner, and the corner */
    int open;                             /* number of edges */
    uchar face_of[LIST_CAPACITY];         /* face of each entry of the list, or NO_FACE */
} lane_walk_t;

/* Progress of the walk. */
typedef struct {
    planes_t corners[CORNER_CAPACITY];
    lane_walk_t lanes[LANES];
    long a[LANES], b[LANES], from[LANES]; /* the faces of the current edge, and its first corner */
    long active[LANES];
} walk_t;

inline vectors_t planes_at(const planes_t *planes, const long *at)
{
    const vectors_t p = {PLANE_LANES(planes, at, 0), PLANE_LANES(planes, at, 1), PLANE_LANES(planes, at, 2)};
    return p;
}

inline double4 corner_at(const walk_t *walk, int v, int lane)
{
    return (double4)(PLANE_LANE(walk->corners, v, 0, lane), PLANE_LANE(walk->corners, v, 1, lane),
                     PLANE_LANE(walk->corners, v, 2, lane), 0);
}
