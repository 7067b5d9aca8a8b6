/* Areas and centroids of the faces of a cell in 3D, and its moments, from its corners. */
#include "tessellation/cell_corners3d.h"

/* Area and centroid of a face from triangles around its first vertex: as accurate as the vertices, also for small
   faces. `far2` becomes the squared distance of the farthest vertex. */
inline REAL4 measure_flat(const corners_t *cell, int f, REAL4 normal, REAL *far2)
{
    /* For each vertex of the face, the faces before and after it. */
    uchar ins[MOST_FACES], outs[MOST_FACES], at[MOST_FACES];
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
    REAL twice = 0;
    *far2 = dot(first, first);
    for (int k = 0, steps = 1; steps < n; ++steps) {
        int next = 0;
        while (next < n - 1 && ins[next] != outs[k])
            ++next;
        const REAL4 y = corner_place(cell, at[next]), after = y - first;
        *far2 = fmax(*far2, dot(y, y));
        const REAL weight = dot(normal, cross(before, after));
        twice += weight;
        sum += weight * (before + after);
        before = after;
        k = next;
    }
    const REAL4 centroid = first + sum / (3 * twice);
    return (REAL4)(twice / 2, centroid.s0, centroid.s1, centroid.s2);
}

/* The output arrays, see `clip_polyhedra`. */
typedef struct {
    global int *labels;
    global REAL *measures, *centroids, *volumes, *offsets, *covariances;
} measured_t;

/* Write the faces from `place` on, and the moments of the cell of generator i, from its sums. False if a face has no
   more area than round-off. */
inline bool write_measures(const corners_t *cell, const sums_t *sums, int i, int place, const measured_t *out)
{
    REAL volume = 0, xx = sum_of_lanes(sums->xx), yy = sum_of_lanes(sums->yy), zz = sum_of_lanes(sums->zz);
    REAL yz = sum_of_lanes(sums->yz), zx = sum_of_lanes(sums->zx), xy = sum_of_lanes(sums->xy);
    REAL4 first = 0;
    bool good = true;
    for (int f = 0; f < cell->faces; ++f, ++place) {
        const REAL4 p = face_plane(cell, f), sum = sums->faces[f];
        const REAL d2 = cell->planes[f].s3, length = sqrt(d2);
        const REAL4 foot = p * (d2 / 2), moment = (REAL4)(sum.s1, sum.s2, sum.s3, 0);
        REAL area = sum.s0 * length / 4;
        /* The centroid, projected to the plane. */
        REAL4 centroid = (moment / sum.s0 + foot) / 3;
        centroid += (1 - 2 * dot(centroid, p)) * foot;
        if (!(area > FLAT_AREA * cell->reach2)) {
            REAL far2;
            const REAL4 flat = measure_flat(cell, f, p * length, &far2);
            area = flat.s0;
            centroid = (REAL4)(flat.s1, flat.s2, flat.s3, 0);
            good &= area > LEAST_AREA * far2;
        }
        out->labels[place] = cell->labels[f];
        out->measures[place] = area;
        out->centroids[3 * place] = centroid.s0;
        out->centroids[3 * place + 1] = centroid.s1;
        out->centroids[3 * place + 2] = centroid.s2;
        const REAL4 m = d2 * (sum.s0 * foot + moment);
        volume += d2 * sum.s0;
        first += m;
        /* The terms that `place_corners` omits: twice the square of the foot, and its products with f and v. */
        xx += 2 * foot.s0 * m.s0;
        yy += 2 * foot.s1 * m.s1;
        zz += 2 * foot.s2 * m.s2;
        yz += foot.s1 * m.s2 + foot.s2 * m.s1;
        zx += foot.s2 * m.s0 + foot.s0 * m.s2;
        xy += foot.s0 * m.s1 + foot.s1 * m.s0;
    }
    const REAL inverse = 1 / volume;
    first *= inverse / 4;
    out->volumes[i] = volume / 24;
    out->offsets[3 * i] = first.s0;
    out->offsets[3 * i + 1] = first.s1;
    out->offsets[3 * i + 2] = first.s2;
    out->covariances[6 * i] = xx * inverse / 20 - first.s0 * first.s0;
    out->covariances[6 * i + 1] = xy * inverse / 20 - first.s0 * first.s1;
    out->covariances[6 * i + 2] = zx * inverse / 20 - first.s2 * first.s0;
    out->covariances[6 * i + 3] = yy * inverse / 20 - first.s1 * first.s1;
    out->covariances[6 * i + 4] = yz * inverse / 20 - first.s1 * first.s2;
    out->covariances[6 * i + 5] = zz * inverse / 20 - first.s2 * first.s2;
    return good && volume > 0;
}
