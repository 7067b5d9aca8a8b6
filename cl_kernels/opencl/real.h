/* Dimension and precision: every kernel file is built with -DDIM=2|3 -DREAL=double|float. */
#ifndef DIM
#error "build with -DDIM=2 or -DDIM=3"
#endif
#ifndef REAL
#error "build with -DREAL=double or -DREAL=float"
#endif
/* Geometry relies on each operation being rounded as written; only fma() contracts. */
#pragma OPENCL FP_CONTRACT OFF

/* Intel's CPU compiler runs several work-items as the lanes of one vector, and then gets private arrays in loops that
   diverge wrong (seen in 2026.2: cells of negative area). One lane is as this is written. */
#ifdef cl_intel_vec_len_hint
#define kernel __attribute__((intel_vec_len_hint(1))) __kernel
#endif

#define CLVORO_JOIN_(a, b) a##b
#define CLVORO_JOIN(a, b) CLVORO_JOIN_(a, b)
#define CLVORO_IS_double 1
#define CLVORO_IS_float 0
#define IS_DOUBLE CLVORO_JOIN(CLVORO_IS_, REAL)
#if IS_DOUBLE
#if defined(__OPENCL_C_VERSION__) && __OPENCL_C_VERSION__ < 120
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#endif
#define REAL_EPS DBL_EPSILON
#define REAL_MAX DBL_MAX
#else
#define REAL_EPS FLT_EPSILON
#define REAL_MAX FLT_MAX
#endif
#define REAL2 CLVORO_JOIN(REAL, 2)
#define REAL3 CLVORO_JOIN(REAL, 3)
#define REAL4 CLVORO_JOIN(REAL, 4)
/* EACH_AXIS(a) ...: a loop over the axes, unrolled: PoCL keeps such loops, and with them every array of DIM values in
   memory. */
#define EACH_AXIS(a) _Pragma("unroll") for (int a = 0; a < DIM; ++a)
/* A literal in the working precision: R(0.5). */
#define R(x) ((REAL)(x))

/* The index of a work-item, one of `size`, the kernel's first argument; the rest of the last work-group is idle.
   Launches are rounded up to whole groups of one fixed size: PoCL compiles a kernel anew for every group size it
   meets. */
#define WORK_ITEM(i)                                                                                                   \
    const int i = get_global_id(0);                                                                                    \
    if (i >= size)                                                                                                     \
    return

/* Rounds to 1 ulp where a*b and c*d cancel (Kahan): the determinant of two short vectors. */
inline REAL difference_of_products(REAL a, REAL b, REAL c, REAL d)
{
    const REAL cd = c * d;
    return fma(a, b, -cd) + fma(-c, d, cd);
}
