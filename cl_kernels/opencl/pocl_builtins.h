/* The built-in functions that the kernels and the formulas of size fields call. PoCL reads 18,000 lines of
   declarations for every program, which takes longer than to compile most of them; with -D_OPENCL_H_ it leaves
   them out, and reads these. */
#define CONST_FUNCTION __attribute__((overloadable, const))
#define READING_FUNCTION __attribute__((overloadable, pure))
#define WRITING_FUNCTION __attribute__((overloadable))

#define DECLARE_ARITHMETIC(T)                                                                                          \
    T CONST_FUNCTION min(T, T);                                                                                        \
    T CONST_FUNCTION max(T, T);                                                                                        \
    T CONST_FUNCTION clamp(T, T, T);                                                                                   \
    T CONST_FUNCTION convert_##T(T)

#define DECLARE_MIXED_ARITHMETIC(T, S)                                                                                 \
    T CONST_FUNCTION min(T, S);                                                                                        \
    T CONST_FUNCTION max(T, S);                                                                                        \
    T CONST_FUNCTION clamp(T, S, S)

/* Functions of a real type or vector T; I is the type of integers as wide. */
#define DECLARE_REAL(T, I)                                                                                             \
    DECLARE_ARITHMETIC(T);                                                                                             \
    T CONST_FUNCTION sqrt(T);                                                                                          \
    T CONST_FUNCTION cbrt(T);                                                                                          \
    T CONST_FUNCTION fabs(T);                                                                                          \
    T CONST_FUNCTION floor(T);                                                                                         \
    T CONST_FUNCTION ceil(T);                                                                                          \
    T CONST_FUNCTION exp(T);                                                                                           \
    T CONST_FUNCTION expm1(T);                                                                                         \
    T CONST_FUNCTION log(T);                                                                                           \
    T CONST_FUNCTION sin(T);                                                                                           \
    T CONST_FUNCTION cos(T);                                                                                           \
    T CONST_FUNCTION tan(T);                                                                                           \
    T CONST_FUNCTION atan(T);                                                                                          \
    T CONST_FUNCTION atan2(T, T);                                                                                      \
    T CONST_FUNCTION copysign(T, T);                                                                                   \
    T CONST_FUNCTION fmin(T, T);                                                                                       \
    T CONST_FUNCTION fmax(T, T);                                                                                       \
    T CONST_FUNCTION fma(T, T, T);                                                                                     \
    T CONST_FUNCTION select(T, T, I)

/* Those that only formulas of size fields call; see clvoro/sizing/expression.py. */
#define DECLARE_FORMULAS(T)                                                                                            \
    T CONST_FUNCTION exp2(T);                                                                                          \
    T CONST_FUNCTION log2(T);                                                                                          \
    T CONST_FUNCTION log10(T);                                                                                         \
    T CONST_FUNCTION sinh(T);                                                                                          \
    T CONST_FUNCTION cosh(T);                                                                                          \
    T CONST_FUNCTION tanh(T);                                                                                          \
    T CONST_FUNCTION asin(T);                                                                                          \
    T CONST_FUNCTION acos(T);                                                                                          \
    T CONST_FUNCTION pow(T, T);                                                                                        \
    T CONST_FUNCTION hypot(T, T);                                                                                      \
    T CONST_FUNCTION fmod(T, T);                                                                                       \
    T CONST_FUNCTION mix(T, T, T);                                                                                     \
    T CONST_FUNCTION step(T, T);                                                                                       \
    T CONST_FUNCTION smoothstep(T, T, T)

#define DECLARE_INTEGER(T)                                                                                             \
    DECLARE_ARITHMETIC(T);                                                                                             \
    T CONST_FUNCTION popcount(T);                                                                                      \
    T CONST_FUNCTION clz(T)

#define DECLARE_SIGNED(T, U)                                                                                           \
    DECLARE_INTEGER(T);                                                                                                \
    DECLARE_INTEGER(U);                                                                                                \
    T CONST_FUNCTION select(T, T, T);                                                                                  \
    int CONST_FUNCTION any(T);                                                                                         \
    int CONST_FUNCTION all(T);                                                                                         \
    U CONST_FUNCTION abs(T)

#define DECLARE_VECTOR_ACCESS(SPACE, S, N)                                                                             \
    S##N READING_FUNCTION vload##N(size_t, const SPACE S *);                                                           \
    void WRITING_FUNCTION vstore##N(S##N, size_t, SPACE S *)

#define DECLARE_VECTOR(S, N)                                                                                           \
    DECLARE_MIXED_ARITHMETIC(S##N, S);                                                                                 \
    DECLARE_VECTOR_ACCESS(global, S, N);                                                                               \
    DECLARE_VECTOR_ACCESS(local, S, N);                                                                                \
    DECLARE_VECTOR_ACCESS(private, S, N);                                                                              \
    S##N READING_FUNCTION vload##N(size_t, const constant S *)

#define DECLARE_REAL_VECTOR(S, N, I)                                                                                   \
    DECLARE_REAL(S##N, I##N);                                                                                          \
    DECLARE_VECTOR(S, N);                                                                                              \
    S##N CONST_FUNCTION fmin(S##N, S);                                                                                 \
    S##N CONST_FUNCTION fmax(S##N, S)

#define DECLARE_REALS(S, I)                                                                                            \
    DECLARE_REAL(S, I);                                                                                                \
    DECLARE_REAL_VECTOR(S, 2, I);                                                                                      \
    DECLARE_REAL_VECTOR(S, 3, I);                                                                                      \
    DECLARE_REAL_VECTOR(S, 4, I);                                                                                      \
    DECLARE_REAL_VECTOR(S, 8, I);                                                                                      \
    DECLARE_REAL_VECTOR(S, 16, I);                                                                                     \
    S CONST_FUNCTION dot(S, S);                                                                                        \
    S CONST_FUNCTION dot(S##2, S##2);                                                                                  \
    S CONST_FUNCTION dot(S##3, S##3);                                                                                  \
    S CONST_FUNCTION dot(S##4, S##4);                                                                                  \
    S##3 CONST_FUNCTION cross(S##3, S##3);                                                                             \
    S##4 CONST_FUNCTION cross(S##4, S##4);                                                                             \
    S CONST_FUNCTION ldexp(S, int);                                                                                    \
    int CONST_FUNCTION ilogb(S)

#define DECLARE_INTEGER_VECTOR(S, U, N)                                                                                \
    DECLARE_SIGNED(S##N, U##N);                                                                                        \
    DECLARE_VECTOR(S, N);                                                                                              \
    DECLARE_VECTOR(U, N)

#define DECLARE_INTEGERS(S, U)                                                                                         \
    DECLARE_SIGNED(S, U);                                                                                              \
    DECLARE_INTEGER_VECTOR(S, U, 2);                                                                                   \
    DECLARE_INTEGER_VECTOR(S, U, 4);                                                                                   \
    DECLARE_INTEGER_VECTOR(S, U, 8);                                                                                   \
    DECLARE_INTEGER_VECTOR(S, U, 16)

#define DECLARE_CONVERSIONS(A, B, N)                                                                                   \
    A##N CONST_FUNCTION convert_##A##N(B##N);                                                                          \
    B##N CONST_FUNCTION convert_##B##N(A##N)

#define DECLARE_VECTOR_CONVERSIONS(N)                                                                                  \
    DECLARE_CONVERSIONS(double, float, N);                                                                             \
    DECLARE_CONVERSIONS(double, long, N);                                                                              \
    DECLARE_CONVERSIONS(double, int, N);                                                                               \
    DECLARE_CONVERSIONS(float, long, N);                                                                               \
    DECLARE_CONVERSIONS(float, int, N);                                                                                \
    DECLARE_CONVERSIONS(long, int, N)

#define DECLARE_ATOMICS(SPACE, S)                                                                                      \
    S WRITING_FUNCTION atomic_add(volatile SPACE S *, S);                                                              \
    S WRITING_FUNCTION atomic_inc(volatile SPACE S *);                                                                 \
    S WRITING_FUNCTION atomic_cmpxchg(volatile SPACE S *, S, S);                                                       \
    S WRITING_FUNCTION atomic_min(volatile SPACE S *, S);                                                              \
    S WRITING_FUNCTION atomic_max(volatile SPACE S *, S);                                                              \
    S WRITING_FUNCTION atomic_or(volatile SPACE S *, S);                                                               \
    S WRITING_FUNCTION atomic_and(volatile SPACE S *, S)

DECLARE_REALS(float, int);
DECLARE_REALS(double, long);
DECLARE_FORMULAS(float);
DECLARE_FORMULAS(double);
DECLARE_INTEGERS(int, uint);
DECLARE_INTEGERS(long, ulong);
DECLARE_VECTOR_CONVERSIONS();
DECLARE_VECTOR_CONVERSIONS(2);
DECLARE_VECTOR_CONVERSIONS(4);
DECLARE_VECTOR_CONVERSIONS(8);
DECLARE_ATOMICS(global, int);
DECLARE_ATOMICS(global, uint);
DECLARE_ATOMICS(local, int);
DECLARE_ATOMICS(local, uint);

size_t CONST_FUNCTION get_global_id(uint);
size_t CONST_FUNCTION get_local_id(uint);
size_t CONST_FUNCTION get_group_id(uint);
size_t CONST_FUNCTION get_num_groups(uint);
void __attribute__((overloadable, convergent)) barrier(cl_mem_fence_flags);
