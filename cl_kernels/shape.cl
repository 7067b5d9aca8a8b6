#include "common/real.h"

/* The gradient of cell quality by the generators, in 2D. By the paper's (4.1), up to a constant for each number of faces,

     E = sum_c omega_c (2 log P_c - log A_c),   dE/dx_i = sum over the corners and faces of cell i,

   omega >= 1 weighs bad cells more. A cell pulls at its corners along its faces with the tension 2 omega / P and pushes
   its faces outwards with the pressure omega / A. */

/* Per generator i: tension and pressure of its cell; omega = 1 + emphasis * -log Q. */
kernel void load_cells(const int size, global const int *starts, global const REAL *face_measures, global const REAL *volumes,
                       global const REAL *quality, const REAL emphasis, global REAL *tension, global REAL *pressure)
{
    WORK_ITEM(i);
    REAL perimeter = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k)
        perimeter += face_measures[k];
    const REAL omega = 1 - emphasis * log(fmax(quality[i], R(1e-6)));
    tension[i] = 2 * omega / perimeter;
    pressure[i] = omega / volumes[i];
}

/* Unit vector along the face of `label`, counter-clockwise around the cell of generator i. */
inline REAL2 face_tangent(int i, int label, global const REAL *points)
{
    if (label >= 0) {
        const REAL2 d = (REAL2)(points[2 * label] - points[2 * i], points[2 * label + 1] - points[2 * i + 1]);
        return (REAL2)(-d.s1, d.s0) / sqrt(dot(d, d));
    }
    const int wall = -1 - label;
    const REAL sign = wall % 2 ? 1 : -1;
    return wall < 2 ? (REAL2)(0, sign) : (REAL2)(-sign, 0);
}

/* Per generator i: lloyd = -rate h^2 dE/dx_i, at most `longest` h.

   The corner v between the faces to j and q obeys (x_j - x_i).dv = (x_q - x_i).dv = (v - x_i).dx_i; on a wall it moves
   along the wall. Its pull is the sum of its faces' tensions along them, each that of the two cells beside the face. */
kernel void descend_shape(const int size, global const int *starts, global const int *neighbours, global const REAL *face_measures,
                          global const REAL *face_centroids, global const REAL *points, global const REAL *tension,
                          global const REAL *pressure, global const REAL *h, const REAL rate, const REAL longest,
                          global REAL *lloyd)
{
    WORK_ITEM(i);
    const REAL2 x = (REAL2)(points[2 * i], points[2 * i + 1]);
    const int begin = starts[i], end = starts[i + 1];
    const REAL wi = tension[i];
    REAL2 g = 0;
    for (int k = begin; k < end; ++k) {
        const int before = k == begin ? end - 1 : k - 1;
        const int j = neighbours[before], q = neighbours[k];
        const REAL2 tj = face_tangent(i, j, points), tq = face_tangent(i, q, points);
        const REAL2 m = (REAL2)(face_centroids[2 * k], face_centroids[2 * k + 1]);
        const REAL2 r = m - face_measures[k] / 2 * tq; /* corner k */
        REAL s = 0;
        if (j >= 0 && q >= 0) {
            const REAL2 a = (REAL2)(points[2 * j], points[2 * j + 1]) - x;
            const REAL2 b = (REAL2)(points[2 * q], points[2 * q + 1]) - x;
            const REAL det = a.s0 * b.s1 - a.s1 * b.s0;
            const REAL2 c = b - a;
            const REAL2 away = (REAL2)(-c.s1, c.s0) / sqrt(dot(c, c)); /* against the face between j and q */
            const REAL wj = tension[j], wq = tension[q];
            const REAL2 pull = (wi + wj) * tj - (wi + wq) * tq + (wj + wq) * away;
            if (det > 0)
                s = ((b.s1 - a.s1) * pull.s0 + (a.s0 - b.s0) * pull.s1) / det;
        } else if (j >= 0 || q >= 0) {
            const int other = j >= 0 ? j : q;
            const REAL wo = tension[other];
            const REAL2 d = (REAL2)(points[2 * other], points[2 * other + 1]) - x;
            const REAL2 wall = j >= 0 ? tq : tj;
            const REAL2 pull = j >= 0 ? (wi + wo) * tj - (wi - wo) * tq : (wi - wo) * tj - (wi + wo) * tq;
            const REAL slope = dot(d, wall);
            if (slope * slope > R(1e-12) * dot(d, d))
                s = dot(wall, pull) / slope;
        }
        g += s * r;
        if (q >= 0) {
            const REAL2 d = (REAL2)(points[2 * q], points[2 * q + 1]) - x;
            g += face_measures[k] / sqrt(dot(d, d)) * (pressure[q] - pressure[i]) * m;
        }
    }
    REAL2 u = -rate * h[i] * h[i] * g;
    const REAL length = sqrt(dot(u, u));
    if (length > longest * h[i])
        u *= longest * h[i] / length;
    /* A corner of no angle has no gradient. */
    if (!(length < REAL_MAX))
        u = 0;
    lloyd[2 * i] = u.s0;
    lloyd[2 * i + 1] = u.s1;
}
