/* A cell in 3D as the vertices of its planes: a vertex is a triple of faces, counter-clockwise seen from outside. It
   lies in private or global memory. */
#include "tessellation/corner_shares.h"

#define CORNERS LANE_SPACE corners_t
#define LINKS LANE_SPACE links_t
#define NO_CORNER 255

typedef struct {
    int faces, corners;
    int labels[MOST_FACES];
    REAL4 planes[MOST_FACES];                                                       /* p and d^2 */
    uchar4 at[MOST_CORNERS];                                                        /* faces of a vertex */
    WIDE x[MOST_CORNERS / WIDTH], y[MOST_CORNERS / WIDTH], z[MOST_CORNERS / WIDTH]; /* its position */
    WIDE beyond[MOST_CORNERS / WIDTH];                                              /* its largest y.p - 1/2 */
    REAL reach2;
} corners_t;

/* The numbers in vectors of WIDTH. */
#define NUMBERS(vectors) ((LANE_SPACE REAL *)(vectors))

/* Where two faces are consecutive at a vertex: its number, [a][b]. */
typedef struct {
    uchar at[MOST_FACES * MOST_FACES];
} links_t;

inline REAL4 face_plane(const CORNERS *cell, int f)
{
    const REAL4 plane = cell->planes[f];
    return (REAL4)(plane.s0, plane.s1, plane.s2, 0);
}

inline REAL4 corner_place(const CORNERS *cell, int v)
{
    return (REAL4)(NUMBERS(cell->x)[v], NUMBERS(cell->y)[v], NUMBERS(cell->z)[v], 0);
}

#include "tessellation/corner_measures.h"
