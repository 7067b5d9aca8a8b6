#include "tessellation/clipped/outline.h"
#include "tessellation/roundness.h"

/* A hash of a neighbor. The sum of hashes does not depend on the order of the faces. */
inline ulong hash64(ulong v)
{
    v += 0x9e3779b97f4a7c15UL;
    v = (v ^ (v >> 30)) * 0xbf58476d1ce4e5b9UL;
    v = (v ^ (v >> 27)) * 0x94d049bb133111ebUL;
    return v ^ (v >> 31);
}

/* changed = 1 if the set of neighbors of generator i differs from that of the last call, by its hash in signatures[i];
   ever_changed = 1 if it has ever differed; with `first` there was no call. Walls are neighbors. labels are permanent.
 */
inline void compare_neighbors(int i, global const int *starts, global const int *neighbors, global const int *labels,
                              bool first, global ulong *signatures, global REAL *changed, global REAL *ever_changed)
{
    ulong signature = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbors[k];
        signature += hash64(j < 0 ? (ulong)(long)j : (ulong)labels[j]);
    }
    const int differs = !first && signature != signatures[i];
    signatures[i] = signature;
    changed[i] = differs;
    ever_changed[i] = first ? 0 : fmax(ever_changed[i], (REAL)differs);
}

/* Error, quality, energy and local length of the cell of generator i, one work-item per generator.

   error         e = (L - h) / min(L, h), L = V^(1/d)             (the paper's 3.1)
   local_length  min(L, h), the unit of bounds of the motion
   energy        integral of |y - x_i|^2 over the cell            (the paper's 2.3)
   quality       2D: Q = 4 A n tan(pi / n) / P^2                  (the paper's 4.1; trimmed cells have their own)
                 3D: Q = 36 pi V^2 / S^3, the isoperimetric quotient

   Measures of faces are in FACE, or with `exact` in REAL. Neighbors are compared as well if `comparison` is 1, or 2 the
   first time. */
kernel void evaluate_metric(const int size, global const REAL *volumes, global const int *starts,
                            global const void *face_measures, const int exact, global const REAL *offsets,
                            global const REAL *covariances, global const REAL *h, global REAL *error,
                            global REAL *quality, global REAL *energy, global REAL *local_length, const int comparison,
                            global const int *neighbors, global const int *labels, global ulong *signatures,
                            global REAL *changed, global REAL *ever_changed OUTLINE_ARGS)
{
    WORK_ITEM(i);
    const REAL volume = volumes[i];
#if CELL_DIM == 2
    const REAL length = sqrt(volume);
#else
    const REAL length = cbrt(volume);
#endif
#ifdef POLYGON
    quality[i] = outlines[i].s0;
#else
    const int begin = starts[i], end = starts[i + 1];
    REAL surface = 0;
    for (int k = begin; k < end; ++k)
        surface += exact ? ((global const REAL *)face_measures)[k] : ((global const FACE *)face_measures)[k];
#if CELL_DIM == 2
    quality[i] = polygon_quality(end - begin, volume, surface);
#else
    quality[i] = R(113.09733552923255) * volume * volume / (surface * surface * surface);
#endif
#endif
    REAL square = 0;
    for (int a = 0, diagonal = 0; a < CELL_DIM; ++a) {
        const REAL spread = covariances[CELL_DIM * (CELL_DIM + 1) / 2 * i + diagonal];
        square += offsets[DIM * i + a] * offsets[DIM * i + a] + spread;
        diagonal += CELL_DIM - a;
    }
#ifdef SPHERE
    square += offsets[3 * i + 2] * offsets[3 * i + 2];
#endif
    energy[i] = volume * square;
    const REAL target = h[i];
    local_length[i] = fmin(length, target);
    error[i] = (length - target) / fmin(length, target);
    if (comparison)
        compare_neighbors(i, starts, neighbors, labels, comparison == 2, signatures, changed, ever_changed);
}

/* h[i] = L_i for generators of layers, first <= labels[i] < fixed: their size is right. But a cell much larger than
   h[i] has taken the place of cells that are missing beside it: it counts as too large. One work-item per generator. */
kernel void set_fixed_sizes(const int size, global const int *labels, const int first, const int fixed,
                            global const REAL *volumes, global REAL *h)
{
    WORK_ITEM(i);
    const REAL length = CELL_DIM == 2 ? sqrt(volumes[i]) : cbrt(volumes[i]);
    if (labels[i] >= first && labels[i] < fixed && length <= (REAL)1.5 * h[i])
        h[i] = length;
}

/* h *= factor. One work-item per generator. */
kernel void scale_sizes(const int size, const REAL factor, global REAL *h)
{
    WORK_ITEM(i);
    h[i] *= factor;
}
