/* What a new cell in 3D writes: its faces, its moments, and what is wrong with it; see CELL_OUTPUT_ARGS. */
#include "tessellation/polyhedron.h"
#include "tessellation/row_counts.h"

/* Share of the volume of a cell by which its faces may differ from those of neighbors. */
#define EVEN_SHARE R(1e-3)

inline REAL4 vertex_at(const CELL *cell, int v)
{
    return (REAL4)(X(cell)[v], Y(cell)[v], Z(cell)[v], 0);
}

inline REAL dot3(REAL4 a, REAL4 b)
{
    return a.s0 * b.s0 + a.s1 * b.s1 + a.s2 * b.s2;
}

inline REAL4 cross3(REAL4 a, REAL4 b)
{
    return a.yzxw * b.zxyw - a.zxyw * b.yzxw;
}

/* Write face k, from twice its area and 6 times its first moments. */
inline void write_face(int k, int label, REAL area, REAL4 first, global int *labels, global REAL *measures,
                       global REAL *centroids)
{
    const REAL third = area > 0 ? 1 / (3 * area) : 0;
    labels[k] = label;
    measures[k] = area / 2;
    centroids[3 * k] = first.s0 * third;
    centroids[3 * k + 1] = first.s1 * third;
    centroids[3 * k + 2] = first.s2 * third;
}

/* Flag a cell of too few faces, or whose faces below round-off take more than a share of its volume. In a box as thin
   as round-off all faces are below it. Both volumes have the same factor. */
inline void flag_lost_faces(int count, REAL volume, REAL lost, REAL share, global int *report)
{
    if (count < 4 || !(volume > 0 && lost <= share * volume))
        atomic_or(report, FLAG_COLLAPSED);
    else if (lost > EVEN_SHARE * volume)
        atomic_or(report, FLAG_UNEVEN);
}

/* Write the volume, centroid and covariance of cell i, from 6 times the volume, 24 times the first and 120 times the
   second moments: xx, yy, zz, and yz, zx, xy. */
inline void write_cell_moments(int i, REAL volume, REAL4 first, REAL4 square, REAL4 mixed, global REAL *volumes,
                               global REAL *offsets, global REAL *covariances)
{
    const REAL inverse = 1 / volume;
    first *= inverse / 4;
    square = square * (inverse / 20) - first * first;
    mixed = mixed * (inverse / 20) - first.yzxw * first.zxyw;
    volumes[i] = volume / 6;
    offsets[3 * i] = first.s0;
    offsets[3 * i + 1] = first.s1;
    offsets[3 * i + 2] = first.s2;
    covariances[6 * i] = square.s0;
    covariances[6 * i + 1] = mixed.s2;
    covariances[6 * i + 2] = mixed.s1;
    covariances[6 * i + 3] = square.s1;
    covariances[6 * i + 4] = mixed.s0;
    covariances[6 * i + 5] = square.s2;
}
