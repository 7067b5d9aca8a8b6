#include "common/real.h"

/* Per generator i: metric error and quality of its cell.

   error    e = (L - h) / min(L, h), L = V^(1/d)             (the paper's 3.1)
   quality  2D: Q = 4 A n tan(pi / n) / P^2                  (the paper's 4.1)
            3D: Q = 36 pi V^2 / S^3, the isoperimetric quotient */
kernel void evaluate_metric(global const REAL *volumes, global const int *starts, global const REAL *face_measures,
                            global const REAL *h, global REAL *error, global REAL *quality)
{
    const int i = get_global_id(0);
    const REAL volume = volumes[i];
    const int begin = starts[i], end = starts[i + 1];
    REAL surface = 0;
    for (int k = begin; k < end; ++k)
        surface += face_measures[k];
#if DIM == 2
    const REAL length = sqrt(volume);
    const REAL n = end - begin;
    quality[i] = 4 * volume * n * tan(R(3.14159265358979324) / n) / (surface * surface);
#else
    const REAL length = cbrt(volume);
    quality[i] = R(113.09733552923255) * volume * volume / (surface * surface * surface);
#endif
    const REAL size = h[i];
    error[i] = (length - size) / fmin(length, size);
}

/* A well-mixed word per neighbour; their sum does not depend on the order of the faces. */
inline ulong mixed(ulong v)
{
    v += 0x9e3779b97f4a7c15UL;
    v = (v ^ (v >> 30)) * 0xbf58476d1ce4e5b9UL;
    v = (v ^ (v >> 27)) * 0x94d049bb133111ebUL;
    return v ^ (v >> 31);
}

/* Per generator i: has its set of neighbours changed since the signature was taken? signatures[i] is renewed, and
   ever[i] remembers. Walls count as neighbours. labels name generators for good, whatever their present index. */
kernel void compare_neighbours(global const int *starts, global const int *neighbours, global const int *labels,
                               const int first, global ulong *signatures, global REAL *changed, global REAL *ever)
{
    const int i = get_global_id(0);
    ulong signature = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbours[k];
        signature += mixed(j < 0 ? (ulong)(long)j : (ulong)labels[j]);
    }
    const int differs = !first && signature != signatures[i];
    signatures[i] = signature;
    changed[i] = differs;
    ever[i] = first ? 0 : fmax(ever[i], (REAL)differs);
}
