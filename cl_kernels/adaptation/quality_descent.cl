/* Gradient of the cell quality with respect to the generators, in 2D. From the paper's (4.1), up to a constant per
   number of faces,

     E = sum_c omega_c (2 log P_c - log A_c),   dE/dx_i = sum over the vertices and faces of cell i,

   with omega >= 1 larger for bad cells. A cell pulls its vertices along its faces with the tension 2 omega / P, and
   pushes its faces outwards with the pressure omega / A. */
#include "geometry/domain.h"
#include "tessellation/clipped/outline.h"

/* tension = 2 omega / P, pressure = omega / A, omega = 1 - bad_cell_weight log Q. One work-item per four generators,
   because four logarithms cost as much as one on a CPU. */
kernel void compute_tension_pressure(const int size, global const int *starts, global const FACE *face_measures,
                                     global const REAL *volumes, global const REAL *quality, const REAL bad_cell_weight,
                                     global REAL *tension, global REAL *pressure)
{
    const int begin = 4 * get_global_id(0), count = min(4, size - begin);
    REAL q[4] = {1, 1, 1, 1};
    for (int c = 0; c < count; ++c)
        q[c] = fmax(quality[begin + c], R(1e-6));
    const REAL4 omegas = 1 - bad_cell_weight * log((REAL4)(q[0], q[1], q[2], q[3]));
    const REAL omega[4] = {omegas.s0, omegas.s1, omegas.s2, omegas.s3};
    for (int c = 0; c < count; ++c) {
        const int i = begin + c;
        REAL perimeter = 0;
        for (int k = starts[i]; k < starts[i + 1]; ++k)
            perimeter += face_measures[k];
        tension[i] = 2 * omega[c] / perimeter;
        pressure[i] = omega[c] / volumes[i];
    }
}

/* A face of the cell of the generator at x. */
typedef struct {
    int label;
    REAL2 away;    /* to the neighbor; 0 for a wall */
    REAL2 tangent; /* unit vector along the face, counter-clockwise */
    REAL inverse;  /* 1 / distance of the neighbor */
    REAL tension;  /* of the neighbor */
} Face;

inline Face read_face(int label, REAL2 x, global const REAL *points,
                      global const REAL *tension OUTLINE_ARGS PERIOD_ARGS)
{
    Face f;
    f.label = label;
    f.away = 0;
    f.inverse = f.tension = 0;
    if (label >= 0) {
        f.away = (REAL2)(DIFFERENCE(0, x.s0, points[2 * label]), DIFFERENCE(1, x.s1, points[2 * label + 1]));
        f.inverse = 1 / sqrt(dot(f.away, f.away));
        f.tangent = f.inverse * (REAL2)(-f.away.s1, f.away.s0);
        f.tension = tension[label];
    } else {
#ifdef POLYGON
        f.tangent = BOUNDARY_TANGENT(label);
#else
        const int wall = -1 - label;
        const REAL sign = wall % 2 ? 1 : -1;
        f.tangent = wall < 2 ? (REAL2)(0, sign) : (REAL2)(-sign, 0);
#endif
    }
    return f;
}

/* Whether face k ends at the vertex r of its cell. */
inline bool ends_at(REAL2 r, int k, REAL2 tangent, global const FACE *face_measures, global const FACE *face_centroids)
{
    const REAL2 end = (REAL2)(face_centroids[2 * k], face_centroids[2 * k + 1]) + face_measures[k] / 2 * tangent;
    return !(dot(end - r, end - r) > R(1e-6) * dot(r, r));
}

/* lloyd = -rate h^2 dE/dx_i, at most max_displacement h. One work-item per generator.

   The vertex v between the faces to j and q moves by (x_j - x_i).dv = (x_q - x_i).dv = (v - x_i).dx_i; on a wall it
   moves along the wall. Each cell at a face pulls its two vertices along the face, with its tension. The force on v is
   the sum over its faces and their two cells. */
kernel void descend_quality(const int size, global const int *starts, global const int *neighbors,
                            global const FACE *face_measures, global const FACE *face_centroids,
                            global const REAL *points, global const REAL *tension, global const REAL *pressure,
                            global const REAL *h, const REAL rate, const REAL max_displacement,
                            global REAL *lloyd OUTLINE_ARGS PERIOD_ARGS)
{
    WORK_ITEM(i);
    const REAL2 x = (REAL2)(points[2 * i], points[2 * i + 1]);
    const int begin = starts[i], end = starts[i + 1];
    const REAL wi = tension[i];
    REAL2 g = 0;
    Face before = read_face(neighbors[end - 1], x, points, tension OUTLINE PERIODS);
    for (int k = begin; k < end; ++k) {
        const Face face = read_face(neighbors[k], x, points, tension OUTLINE PERIODS);
        const REAL2 m = (REAL2)(face_centroids[2 * k], face_centroids[2 * k + 1]);
        const REAL2 r = m - face_measures[k] / 2 * face.tangent; /* corner k */
        REAL s = 0;
        bool apart = false;
#ifdef POLYGON
        /* A cell may have several loops. The first face of a loop follows its last one. Where no face ends, the cell
           continues in a piece that was added to it. */
        const int last = k == begin ? end - 1 : k - 1;
        apart = !ends_at(r, last, before.tangent, face_measures, face_centroids);
        for (int other = begin; other < end && apart; ++other) {
            const Face ending = read_face(neighbors[other], x, points, tension OUTLINE PERIODS);
            if (ends_at(r, other, ending.tangent, face_measures, face_centroids)) {
                before = ending;
                apart = false;
            }
        }
#endif
        if (apart) {
        } else if (before.label >= 0 && face.label >= 0) {
            const REAL2 a = before.away, b = face.away, c = b - a;
            const REAL det = a.s0 * b.s1 - a.s1 * b.s0;
            const REAL2 between = (REAL2)(-c.s1, c.s0) / sqrt(dot(c, c)); /* against the face between the two */
            const REAL2 pull = (wi + before.tension) * before.tangent - (wi + face.tension) * face.tangent +
                               (before.tension + face.tension) * between;
            if (det > 0)
                s = (c.s1 * pull.s0 - c.s0 * pull.s1) / det;
        } else if (before.label >= 0 || face.label >= 0) {
            const bool first = before.label >= 0;
            const REAL wo = first ? before.tension : face.tension;
            const REAL2 d = first ? before.away : face.away, wall = first ? face.tangent : before.tangent;
            const REAL wj = first ? wo : -wo;
            const REAL2 pull = (wi + wj) * before.tangent - (wi - wj) * face.tangent;
            const REAL slope = dot(d, wall);
            if (slope * slope > R(1e-12) * dot(d, d))
                s = dot(wall, pull) / slope;
        }
        g += s * r;
        if (face.label >= 0)
            g += face_measures[k] * face.inverse * (pressure[face.label] - pressure[i]) * m;
        before = face;
    }
    REAL2 u = -rate * h[i] * h[i] * g;
    const REAL length = sqrt(dot(u, u));
    if (length > max_displacement * h[i])
        u *= max_displacement * h[i] / length;
    /* A degenerate vertex has no gradient. */
    if (!(length < REAL_MAX))
        u = 0;
    lloyd[2 * i] = u.s0;
    lloyd[2 * i + 1] = u.s1;
}
