/* Dimension and precision: every kernel file is built with -DDIM=2|3 -DREAL=double|float. */
#ifndef DIM
#error "build with -DDIM=2 or -DDIM=3"
#endif
#ifndef REAL
#error "build with -DREAL=double or -DREAL=float"
#endif
/* Dimension of the cells. On a sphere positions have three coordinates, and cells are polygons. */
#ifdef SPHERE
#define CELL_DIM 2
#else
#define CELL_DIM DIM
#endif
/* Geometry relies on the rounding of each operation. fma() is the only contraction. */
#pragma OPENCL FP_CONTRACT OFF

/* Intel's CPU compiler runs several work-items in the lanes of a vector. Version 2026.2 then miscompiles private arrays
   in divergent loops (cells of negative area). With one lane it does not. */
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
/* EACH_AXIS(a) ...: an unrolled loop over the axes. PoCL does not unroll such loops, and then keeps arrays of DIM
   values in memory. */
#define EACH_AXIS(a) _Pragma("unroll") for (int a = 0; a < DIM; ++a)
/* The same over the components of a vector in the plane of a cell: on a sphere two, along the tangents. */
#define EACH_COMPONENT(a) _Pragma("unroll") for (int a = 0; a < CELL_DIM; ++a)
/* A literal in the working precision: R(0.5). */
#define R(x) ((REAL)(x))

/* Rare code is kept out of line. */
#define OUT_OF_LINE __attribute__((noinline))

/* Before a loop that is usually short: vectorization would not pay. */
#ifdef __clang__
#define SHORT_LOOP _Pragma("clang loop vectorize(disable) interleave(disable) unroll(disable)")
#else
#define SHORT_LOOP
#endif

/* The index of a work-item below `size`, the kernel's first argument. Launches are rounded up to whole groups of one
   size, because PoCL compiles a kernel for every group size; the other items of the last group return. */
#define WORK_ITEM(i)                                                                                                   \
    const int i = get_global_id(0);                                                                                    \
    if (i >= size)                                                                                                     \
    return
/* The same at the beginning of a kernel with a long body, which for PoCL becomes a function; see
   clvoro/opencl/program.py. Short bodies stay in kernels: PoCL
   vectorizes them across work-items, and a call with many arguments takes 10 ns. */
#define LONG_ITEM WORK_ITEM

/* a b - c d, with an error of 1 ulp even if the products cancel (Kahan): the determinant of two vectors. */
inline REAL difference_of_products(REAL a, REAL b, REAL c, REAL d)
{
    const REAL cd = c * d;
    return fma(a, b, -cd) + fma(-c, d, cd);
}
