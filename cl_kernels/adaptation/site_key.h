/* Sites where generators are inserted or deleted, and how they are ordered. */
#include "opencl/real.h"

#if CELL_DIM == 2
#define REGULAR_FACES 6
#define FACE_WEIGHT R(0.2)
#else
#define REGULAR_FACES 14
#define FACE_WEIGHT R(0.05)
#endif

/* The name of a generator: its index; if `named`, its label, which is the same in all parts of a domain. */
#define NAME_ARGS const int named, global const int *names
#define NAMES named, names
#define NAME(i) (named ? names[i] : (i))

/* A key that orders sites by magnitude, then by name. 0 is not a site. */
inline ulong site_key(REAL magnitude, int name)
{
    return ((ulong)as_uint((float)magnitude) << 32) | (uint)(0x7fffffff - name);
}

/* How much a cell is to be split: log (V rho), and more for many faces. Negative: to be deleted. */
inline REAL need_of_split(REAL log_ratio, int faces)
{
    return log_ratio + FACE_WEIGHT * (faces - REGULAR_FACES);
}
