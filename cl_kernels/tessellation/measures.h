/* A cell's row of the graph and its measures, from its faces; see `measure_cells` in cells.cl. */
#include "tessellation/face_rows.h"
#include "tessellation/moments.h"

typedef struct {
    global const int *starts;
    global int *neighbors;
    global FACE *face_measures, *face_centroids;
    global REAL *volumes, *offsets, *covariances;
    global float *reach; /* distances of the farthest corners; may be 0 */
} measures_t;

inline void write_reach(const measures_t *to, int i, REAL far2)
{
    if (to->reach)
        to->reach[i] = (float)sqrt(far2);
}

/* The faces of generator i that are kept. Returns their number. */
inline int kept_faces(int *faces, const face_rows_t *rows, global const uint *keep, int i)
{
    int n = 0, listed;
    const int place = place_of_row(rows, i);
    global const int *row = face_row(rows, i, &listed);
    for (int k = 0; k < listed; ++k)
        if (place < 0 || ((keep[place + k / 32] >> (k % 32)) & 1u))
            faces[n++] = row[k];
    return n;
}

#ifdef SPHERE
#include "tessellation/sphere_measures.h"
#else
#define measure_face measure_straight_face
#define measure_cell measure_plane_cell

/* Length and middle of the face from v to w of the cell at x. */
inline REAL measure_straight_face(const REAL *x, REAL2 v, REAL2 w, REAL *middle)
{
    const REAL2 e = w - v;
    const REAL2 sum = v + w;
    middle[0] = sum.s0 / 2;
    middle[1] = sum.s1 / 2;
    return sqrt(dot(e, e));
}

/* Measure the cell of generator i from its n faces. */
inline void measure_plane_cell(const measures_t *to, int i, const int *faces, int n, global const REAL *points,
                               const REAL *lower, const REAL *upper)
{
    SITE(x, i, points);
    const int start = to->starts[i];
    moments_t moments = {0, 0, 0, 0, 0, 0};
    REAL far2 = 0;
    if (n >= 3) {
        const REAL2 origin = corner(i, x, faces[n - 1], faces[0], points, lower, upper);
        REAL2 v = origin;
        for (int k = 0; k < n; ++k) {
            const REAL2 w = k == n - 1 ? origin : corner(i, x, faces[k], faces[k + 1], points, lower, upper);
            REAL middle[2];
            add_triangle(&moments, v, w);
            far2 = fmax(far2, dot(w, w));
            to->neighbors[start + k] = faces[k];
            to->face_measures[start + k] = measure_face(x, v, w, middle);
            to->face_centroids[2 * (start + k)] = middle[0];
            to->face_centroids[2 * (start + k) + 1] = middle[1];
            v = w;
        }
    }
    write_moments(&moments, i, to->volumes, to->offsets, to->covariances);
    write_reach(to, i, far2);
}
#endif
