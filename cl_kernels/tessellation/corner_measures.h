/* Areas and centroids of the faces of a cell in 3D, and its moments, from the shares of its vertices. */
#include "tessellation/corner_shares.h"

/* Area and centroid of a face from triangles around its first vertex: as accurate as the vertices, also for small
   faces. `wide`: the area is more than round-off. In double precision the face may be as small as it likes, but not too
   slim; in single precision vertices are not accurate enough to measure small faces. */
inline REAL4 measure_flat(const CORNERS *cell, int f, REAL4 normal, bool *wide)
{
    /* For each vertex of the face, the faces before and after it. */
    uchar ins[MOST_FACES], outs[MOST_FACES];
    ushort at[MOST_FACES];
    int n = 0;
    for (int v = 0; v < cell->corners && n < MOST_FACES; ++v) {
        const uchar4 faces = cell->at[v];
        ins[n] = faces.s0 == f ? faces.s1 : (faces.s1 == f ? faces.s2 : faces.s0);
        outs[n] = faces.s0 == f ? faces.s2 : (faces.s1 == f ? faces.s0 : faces.s1);
        at[n] = v;
        n += faces.s0 == f || faces.s1 == f || faces.s2 == f;
    }
    const REAL4 first = corner_place(cell, at[0]);
    REAL4 before = 0, sum = 0;
    REAL twice = 0, far2 = dot(first, first), width2 = 0;
    for (int k = 0, steps = 1; steps < n; ++steps) {
        int next = 0;
        while (next < n - 1 && ins[next] != outs[k])
            ++next;
        const REAL4 y = corner_place(cell, at[next]), after = y - first;
        far2 = fmax(far2, dot(y, y));
        width2 = fmax(width2, dot(after, after));
        const REAL weight = dot(normal, cross(before, after));
        twice += weight;
        sum += weight * (before + after);
        before = after;
        k = next;
    }
    *wide = twice / 2 > LEAST_AREA * (IS_DOUBLE ? sqrt(far2 * width2) : far2);
    const REAL4 centroid = first + sum / (3 * twice);
    return (REAL4)(twice / 2, centroid.s0, centroid.s1, centroid.s2);
}

/* The output arrays, see `clip_polyhedra`. */
typedef struct {
    global int *labels;
    global REAL *measures, *centroids, *volumes, *offsets, *covariances;
} measured_t;

#define SECONDS 6 /* second moments: xx, yy, zz, yz, zx, xy */

/* A face, and its terms of the sums over a cell: 24 times the volume, 24 times the first moments, and what the shares
   of vertices omit of the second moments. */
typedef struct {
    REAL area, volume, seconds[SECONDS];
    REAL4 centroid, first;
    bool wide; /* its area is more than round-off */
} face_t;

/* Measure face f on `plane` (p and d^2); `sum` are the shares of its vertices. */
inline void measure_face(face_t *face, const CORNERS *cell, int f, REAL4 plane, REAL4 sum, REAL reach2)
{
    const REAL4 p = (REAL4)(plane.s0, plane.s1, plane.s2, 0), moment = (REAL4)(sum.s1, sum.s2, sum.s3, 0);
    const REAL d2 = plane.s3, length = sqrt(d2);
    const REAL4 foot = p * (d2 / 2);
    face->area = sum.s0 * length / 4;
    face->wide = true;
    /* The centroid, projected to the plane. */
    REAL4 centroid = (moment / sum.s0 + foot) / 3;
    centroid += (1 - 2 * dot(centroid, p)) * foot;
    if (!(face->area > FLAT_AREA * reach2)) {
        const REAL4 flat = measure_flat(cell, f, p * length, &face->wide);
        face->area = flat.s0;
        centroid = (REAL4)(flat.s1, flat.s2, flat.s3, 0);
    }
    face->centroid = centroid;
    /* Shares omit twice the square of the foot, and its products with f and v. */
    const REAL4 m = d2 * (sum.s0 * foot + moment);
    face->volume = d2 * sum.s0;
    face->first = m;
    face->seconds[0] = 2 * foot.s0 * m.s0;
    face->seconds[1] = 2 * foot.s1 * m.s1;
    face->seconds[2] = 2 * foot.s2 * m.s2;
    face->seconds[3] = foot.s1 * m.s2 + foot.s2 * m.s1;
    face->seconds[4] = foot.s2 * m.s0 + foot.s0 * m.s2;
    face->seconds[5] = foot.s0 * m.s1 + foot.s1 * m.s0;
}

inline void put_face(int place, int label, const face_t *face, const measured_t *out)
{
    out->labels[place] = label;
    out->measures[place] = face->area;
    out->centroids[3 * place] = face->centroid.s0;
    out->centroids[3 * place + 1] = face->centroid.s1;
    out->centroids[3 * place + 2] = face->centroid.s2;
}

/* Write the moments of the cell of generator i from the sums over its faces. */
inline void put_moments(int i, REAL volume, REAL4 first, const REAL *seconds, const measured_t *out)
{
    const REAL inverse = 1 / volume;
    first *= inverse / 4;
    out->volumes[i] = volume / 24;
    out->offsets[3 * i] = first.s0;
    out->offsets[3 * i + 1] = first.s1;
    out->offsets[3 * i + 2] = first.s2;
    out->covariances[6 * i] = seconds[0] * inverse / 20 - first.s0 * first.s0;
    out->covariances[6 * i + 1] = seconds[5] * inverse / 20 - first.s0 * first.s1;
    out->covariances[6 * i + 2] = seconds[4] * inverse / 20 - first.s2 * first.s0;
    out->covariances[6 * i + 3] = seconds[1] * inverse / 20 - first.s1 * first.s1;
    out->covariances[6 * i + 4] = seconds[3] * inverse / 20 - first.s1 * first.s2;
    out->covariances[6 * i + 5] = seconds[2] * inverse / 20 - first.s2 * first.s2;
}
