#include "tessellation/clipped/outline.h"
#include "tessellation/roundness.h"

/* Per generator i: metric error and quality of its cell.

   error    e = (L - h) / min(L, h), L = V^(1/d)             (the paper's 3.1)
   reach    min(L, h): the length that limits a generator's motion, also where the target has only just grown or shrunk
   energy   integral of |y - x_i|^2 over the cell            (the paper's 2.3)
   quality  2D: Q = 4 A n tan(pi / n) / P^2                  (the paper's 4.1; trimmed cells come with theirs)
            3D: Q = 36 pi V^2 / S^3, the isoperimetric quotient */
kernel void evaluate_metric(const int size, global const REAL *volumes, global const int *starts,
                            global const FACE *face_measures, global const REAL *offsets,
                            global const REAL *covariances, global const REAL *h, global REAL *error,
                            global REAL *quality, global REAL *energy, global REAL *reach OUTLINE_ARGS)
{
    WORK_ITEM(i);
    const REAL volume = volumes[i];
#if DIM == 2
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
        surface += face_measures[k];
#if DIM == 2
    quality[i] = polygon_quality(end - begin, volume, surface);
#else
    quality[i] = R(113.09733552923255) * volume * volume / (surface * surface * surface);
#endif
#endif
    REAL square = 0;
    for (int a = 0, diagonal = 0; a < DIM; ++a) {
        square += offsets[DIM * i + a] * offsets[DIM * i + a] + covariances[DIM * (DIM + 1) / 2 * i + diagonal];
        diagonal += DIM - a;
    }
    energy[i] = volume * square;
    const REAL target = h[i];
    reach[i] = fmin(length, target);
    error[i] = (length - target) / fmin(length, target);
}

/* A well-mixed word per neighbor; their sum does not depend on the order of the faces. */
inline ulong mixed(ulong v)
{
    v += 0x9e3779b97f4a7c15UL;
    v = (v ^ (v >> 30)) * 0xbf58476d1ce4e5b9UL;
    v = (v ^ (v >> 27)) * 0x94d049bb133111ebUL;
    return v ^ (v >> 31);
}

/* Per generator i: has its set of neighbors changed since the signature was taken? signatures[i] is renewed, and
   ever[i] remembers. Walls count as neighbors. labels name generators for good, whatever their present index. */
kernel void compare_neighbors(const int size, global const int *starts, global const int *neighbors,
                              global const int *labels, const int first, global ulong *signatures, global REAL *changed,
                              global REAL *ever)
{
    WORK_ITEM(i);
    ulong signature = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbors[k];
        signature += mixed(j < 0 ? (ulong)(long)j : (ulong)labels[j]);
    }
    const int differs = !first && signature != signatures[i];
    signatures[i] = signature;
    changed[i] = differs;
    ever[i] = first ? 0 : fmax(ever[i], (REAL)differs);
}

/* Per generator i that does not move, labels[i] < fixed: the size that its cell has is the right one. */
kernel void hold_sizes(const int size, global const int *labels, const int fixed, global const REAL *volumes,
                       global REAL *h)
{
    WORK_ITEM(i);
    if (labels[i] < fixed)
        h[i] = DIM == 2 ? sqrt(volumes[i]) : cbrt(volumes[i]);
}

/* Per generator i: h times a factor: the size on a coarser level. */
kernel void scale_sizes(const int size, const REAL factor, global REAL *h)
{
    WORK_ITEM(i);
    h[i] *= factor;
}
