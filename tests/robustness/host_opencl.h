/* OpenCL C's built-in functions for kernels that are compiled for the host, by clang -x cl with opencl-c-base.h: those
   that kernels and size fields use. Each is its definition, one component after the other. See sanitized.py. */
#define OVERLOADED static __attribute__((overloadable))

size_t get_global_id(uint axis);
size_t get_local_id(uint axis);
size_t get_group_id(uint axis);
size_t get_num_groups(uint axis);
size_t get_global_size(uint axis);
size_t get_local_size(uint axis);
void barrier(uint flags);

/* V result = f(a), f(a, b), ... for T2, T4 and T8 from T's. */
#define MAP1_(T, V, n, name, R)                                                                                        \
    OVERLOADED R name(V a)                                                                                             \
    {                                                                                                                  \
        R r;                                                                                                           \
        for (int k = 0; k < n; ++k)                                                                                    \
            r[k] = name(a[k]);                                                                                         \
        return r;                                                                                                      \
    }
#define MAP2_(V, n, name)                                                                                              \
    OVERLOADED V name(V a, V b)                                                                                        \
    {                                                                                                                  \
        V r;                                                                                                           \
        for (int k = 0; k < n; ++k)                                                                                    \
            r[k] = name(a[k], b[k]);                                                                                   \
        return r;                                                                                                      \
    }
#define MAP2S_(T, V, n, name)                                                                                          \
    OVERLOADED V name(V a, T b)                                                                                        \
    {                                                                                                                  \
        V r;                                                                                                           \
        for (int k = 0; k < n; ++k)                                                                                    \
            r[k] = name(a[k], b);                                                                                      \
        return r;                                                                                                      \
    }
#define MAP3_(V, n, name)                                                                                              \
    OVERLOADED V name(V a, V b, V c)                                                                                   \
    {                                                                                                                  \
        V r;                                                                                                           \
        for (int k = 0; k < n; ++k)                                                                                    \
            r[k] = name(a[k], b[k], c[k]);                                                                             \
        return r;                                                                                                      \
    }
#define MAP3S_(T, V, n, name)                                                                                          \
    OVERLOADED V name(V a, T b, T c)                                                                                   \
    {                                                                                                                  \
        V r;                                                                                                           \
        for (int k = 0; k < n; ++k)                                                                                    \
            r[k] = name(a[k], b, c);                                                                                   \
        return r;                                                                                                      \
    }
#define MAP1(T, name)                                                                                                  \
    MAP1_(T, T##2, 2, name, T##2)                                                                                      \
    MAP1_(T, T##3, 3, name, T##3) MAP1_(T, T##4, 4, name, T##4) MAP1_(T, T##8, 8, name, T##8)
#define MAP2(T, name) MAP2_(T##2, 2, name) MAP2_(T##4, 4, name) MAP2_(T##8, 8, name)
#define MAP2S(T, name) MAP2S_(T, T##2, 2, name) MAP2S_(T, T##4, 4, name) MAP2S_(T, T##8, 8, name)
#define MAP3(T, name) MAP3_(T##2, 2, name) MAP3_(T##4, 4, name) MAP3_(T##8, 8, name)
#define MAP3S(T, name) MAP3S_(T, T##2, 2, name) MAP3S_(T, T##4, 4, name) MAP3S_(T, T##8, 8, name)

/* Functions of floating point, by those of C. */
#define REAL1(name)                                                                                                    \
    OVERLOADED float name(float a)                                                                                     \
    {                                                                                                                  \
        return __builtin_##name##f(a);                                                                                 \
    }                                                                                                                  \
    OVERLOADED double name(double a)                                                                                   \
    {                                                                                                                  \
        return __builtin_##name(a);                                                                                    \
    }                                                                                                                  \
    MAP1(float, name) MAP1(double, name)
#define REAL2_(name)                                                                                                   \
    OVERLOADED float name(float a, float b)                                                                            \
    {                                                                                                                  \
        return __builtin_##name##f(a, b);                                                                              \
    }                                                                                                                  \
    OVERLOADED double name(double a, double b)                                                                         \
    {                                                                                                                  \
        return __builtin_##name(a, b);                                                                                 \
    }                                                                                                                  \
    MAP2(float, name) MAP2(double, name)
REAL1(sqrt)
REAL1(cbrt)
REAL1(fabs)
REAL1(floor)
REAL1(ceil)
REAL1(log)
REAL1(log2)
REAL1(log10)
REAL1(exp)
REAL1(exp2)
REAL1(expm1)
REAL1(sin)
REAL1(cos)
REAL1(tan)
REAL1(sinh)
REAL1(cosh)
REAL1(tanh)
REAL1(asin)
REAL1(acos)
REAL1(atan)
REAL1(rint)
REAL2_(fmax)
REAL2_(fmin)
REAL2_(atan2)
REAL2_(pow)
REAL2_(hypot)
REAL2_(copysign)
REAL2_(fmod)
MAP2S(float, fmax)
MAP2S(double, fmax)
MAP2S(float, fmin)
MAP2S(double, fmin)
OVERLOADED float fma(float a, float b, float c)
{
    return __builtin_fmaf(a, b, c);
}
OVERLOADED double fma(double a, double b, double c)
{
    return __builtin_fma(a, b, c);
}
MAP3(float, fma)
MAP3(double, fma)
OVERLOADED float ldexp(float a, int n)
{
    return __builtin_ldexpf(a, n);
}
OVERLOADED double ldexp(double a, int n)
{
    return __builtin_ldexp(a, n);
}
OVERLOADED int ilogb(float a)
{
    return __builtin_ilogbf(a);
}
OVERLOADED int ilogb(double a)
{
    return __builtin_ilogb(a);
}
#define REAL_OTHERS(T, I, U)                                                                                           \
    OVERLOADED T min(T a, T b)                                                                                         \
    {                                                                                                                  \
        return b < a ? b : a;                                                                                          \
    }                                                                                                                  \
    OVERLOADED T max(T a, T b)                                                                                         \
    {                                                                                                                  \
        return a < b ? b : a;                                                                                          \
    }                                                                                                                  \
    MAP2(T, min) MAP2(T, max) OVERLOADED T clamp(T a, T low, T high)                                                   \
    {                                                                                                                  \
        return fmin(fmax(a, low), high);                                                                               \
    }                                                                                                                  \
    MAP3(T, clamp) MAP3S(T, clamp) OVERLOADED T mix(T a, T b, T t)                                                     \
    {                                                                                                                  \
        return a + (b - a) * t;                                                                                        \
    }                                                                                                                  \
    OVERLOADED T step(T edge, T a)                                                                                     \
    {                                                                                                                  \
        return a < edge ? 0 : 1;                                                                                       \
    }                                                                                                                  \
    OVERLOADED T smoothstep(T low, T high, T a)                                                                        \
    {                                                                                                                  \
        const T t = clamp((a - low) / (high - low), (T)0, (T)1);                                                       \
        return t * t * (3 - 2 * t);                                                                                    \
    }                                                                                                                  \
    OVERLOADED T dot(T a, T b)                                                                                         \
    {                                                                                                                  \
        return a * b;                                                                                                  \
    }                                                                                                                  \
    OVERLOADED T dot(T##2 a, T##2 b)                                                                                   \
    {                                                                                                                  \
        return a.x * b.x + a.y * b.y;                                                                                  \
    }                                                                                                                  \
    OVERLOADED T dot(T##3 a, T##3 b)                                                                                   \
    {                                                                                                                  \
        return a.x * b.x + a.y * b.y + a.z * b.z;                                                                      \
    }                                                                                                                  \
    OVERLOADED T dot(T##4 a, T##4 b)                                                                                   \
    {                                                                                                                  \
        return a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w;                                                          \
    }                                                                                                                  \
    OVERLOADED T##3 cross(T##3 a, T##3 b)                                                                              \
    {                                                                                                                  \
        return a.yzx * b.zxy - a.zxy * b.yzx;                                                                          \
    }                                                                                                                  \
    OVERLOADED T##4 cross(T##4 a, T##4 b)                                                                              \
    {                                                                                                                  \
        return (T##4)(a.yzx * b.zxy - a.zxy * b.yzx, 0);                                                               \
    }                                                                                                                  \
    OVERLOADED int isnan(T a)                                                                                          \
    {                                                                                                                  \
        return a != a;                                                                                                 \
    }                                                                                                                  \
    OVERLOADED int isfinite(T a)                                                                                       \
    {                                                                                                                  \
        return fabs(a) < (T)INFINITY;                                                                                  \
    }                                                                                                                  \
    SELECT(T, 2, I) SELECT(T, 4, I) SELECT(T, 8, I) SELECT(T, 2, U) SELECT(T, 4, U) SELECT(T, 8, U)

/* Every bit of the choice counts, as in select() for vectors: its highest. */
#define SELECT(T, n, I)                                                                                                \
    OVERLOADED T##n select(T##n a, T##n b, I##n c)                                                                     \
    {                                                                                                                  \
        T##n r;                                                                                                        \
        for (int k = 0; k < n; ++k)                                                                                    \
            r[k] = (c[k] >> (8 * sizeof(c[k]) - 1)) & 1 ? b[k] : a[k];                                                 \
        return r;                                                                                                      \
    }
REAL_OTHERS(float, int, uint)
REAL_OTHERS(double, long, ulong)
SELECT(int, 2, int)
SELECT(int, 4, int)
SELECT(int, 8, int)
SELECT(long, 2, long)
SELECT(long, 4, long)
SELECT(long, 8, long)
/* Of scalars any number but 0 chooses. */
OVERLOADED int select(int a, int b, int c)
{
    return c ? b : a;
}
OVERLOADED float select(float a, float b, int c)
{
    return c ? b : a;
}

#define INTEGER(T)                                                                                                     \
    OVERLOADED T min(T a, T b)                                                                                         \
    {                                                                                                                  \
        return a < b ? a : b;                                                                                          \
    }                                                                                                                  \
    OVERLOADED T max(T a, T b)                                                                                         \
    {                                                                                                                  \
        return a > b ? a : b;                                                                                          \
    }                                                                                                                  \
    MAP2(T, min) MAP2(T, max) MAP2S(T, min) MAP2S(T, max) OVERLOADED T clamp(T a, T low, T high)                       \
    {                                                                                                                  \
        return min(max(a, low), high);                                                                                 \
    }                                                                                                                  \
    MAP3(T, clamp) MAP3S(T, clamp)
INTEGER(int)
INTEGER(uint)
INTEGER(long)
INTEGER(ulong)
OVERLOADED uint abs(int a)
{
    return a < 0 ? -(uint)a : (uint)a;
}
#define COUNT(T, U, bits, ones, zeros)                                                                                 \
    OVERLOADED T popcount(T a)                                                                                         \
    {                                                                                                                  \
        return ones((U)a);                                                                                             \
    }                                                                                                                  \
    OVERLOADED T clz(T a)                                                                                              \
    {                                                                                                                  \
        return a ? zeros((U)a) : bits;                                                                                 \
    }                                                                                                                  \
    MAP1(T, popcount)
/* long long is wider than long here. */
COUNT(int, uint, 32, __builtin_popcount, __builtin_clz)
COUNT(uint, uint, 32, __builtin_popcount, __builtin_clz)
COUNT(long, ulong, 64, __builtin_popcountl, __builtin_clzl)
COUNT(ulong, ulong, 64, __builtin_popcountl, __builtin_clzl)

#define ANY_(V, n)                                                                                                     \
    OVERLOADED int any(V a)                                                                                            \
    {                                                                                                                  \
        int found = 0;                                                                                                 \
        for (int k = 0; k < n; ++k)                                                                                    \
            found |= a[k] < 0;                                                                                         \
        return found;                                                                                                  \
    }                                                                                                                  \
    OVERLOADED int all(V a)                                                                                            \
    {                                                                                                                  \
        int found = 1;                                                                                                 \
        for (int k = 0; k < n; ++k)                                                                                    \
            found &= a[k] < 0;                                                                                         \
        return found;                                                                                                  \
    }
#define ANY(T) ANY_(T##2, 2) ANY_(T##4, 4) ANY_(T##8, 8)
ANY(int)
ANY(long)

/* vloadn and vstoren ask for the alignment of one component only. */
#define LOAD(T, n, SPACE)                                                                                              \
    OVERLOADED T##n vload##n(size_t at, SPACE const T *from)                                                           \
    {                                                                                                                  \
        T##n r;                                                                                                        \
        for (int k = 0; k < n; ++k)                                                                                    \
            r[k] = from[at * n + k];                                                                                   \
        return r;                                                                                                      \
    }                                                                                                                  \
    OVERLOADED void vstore##n(T##n a, size_t at, SPACE T *to)                                                          \
    {                                                                                                                  \
        for (int k = 0; k < n; ++k)                                                                                    \
            to[at * n + k] = a[k];                                                                                     \
    }
#define LOADS_(T, SPACE) LOAD(T, 2, SPACE) LOAD(T, 3, SPACE) LOAD(T, 4, SPACE) LOAD(T, 8, SPACE) LOAD(T, 16, SPACE)
#define LOADS(T) LOADS_(T, global) LOADS_(T, private)
LOADS(float)
LOADS(double)
LOADS(char)
LOADS(uchar)
LOADS(short)
LOADS(ushort)
LOADS(int)
LOADS(uint)
LOADS(long)
LOADS(ulong)

#define CONVERT(T, S)                                                                                                  \
    OVERLOADED T##8 convert_##T##8(S##8 a)                                                                             \
    {                                                                                                                  \
        return __builtin_convertvector(a, T##8);                                                                       \
    }                                                                                                                  \
    OVERLOADED T##4 convert_##T##4(S##4 a)                                                                             \
    {                                                                                                                  \
        return __builtin_convertvector(a, T##4);                                                                       \
    }                                                                                                                  \
    OVERLOADED T##2 convert_##T##2(S##2 a)                                                                             \
    {                                                                                                                  \
        return __builtin_convertvector(a, T##2);                                                                       \
    }
CONVERT(long, int)
CONVERT(long, long)
CONVERT(int, int)
CONVERT(int, long)
CONVERT(int, float)
CONVERT(int, double)
CONVERT(double, int)
CONVERT(double, long)
CONVERT(double, float)
CONVERT(double, double)
CONVERT(float, int)
CONVERT(float, float)
CONVERT(float, double)

#define CONVERT_ONE(T, S)                                                                                              \
    OVERLOADED T convert_##T(S a)                                                                                      \
    {                                                                                                                  \
        return (T)a;                                                                                                   \
    }
CONVERT_ONE(float, float)
CONVERT_ONE(float, double)
CONVERT_ONE(double, float)
CONVERT_ONE(double, double)

OVERLOADED int convert_int_rte(float a)
{
    return (int)rint(a);
}
OVERLOADED int convert_int_rte(double a)
{
    return (int)rint(a);
}

/* Work-items of a group may be threads, where barriers are met. */
#define ATOMIC(NAME, FETCH, T, SPACE)                                                                                  \
    OVERLOADED T NAME(volatile SPACE T *a, T b)                                                                        \
    {                                                                                                                  \
        return FETCH(a, b, __ATOMIC_RELAXED);                                                                          \
    }
#define ATOMICS(T, SPACE)                                                                                              \
    ATOMIC(atomic_add, __atomic_fetch_add, T, SPACE)                                                                   \
    ATOMIC(atomic_or, __atomic_fetch_or, T, SPACE)                                                                     \
    ATOMIC(atomic_and, __atomic_fetch_and, T, SPACE)                                                                   \
    ATOMIC(atomic_min, __atomic_fetch_min, T, SPACE)                                                                   \
    ATOMIC(atomic_max, __atomic_fetch_max, T, SPACE)                                                                   \
    OVERLOADED T atomic_cmpxchg(volatile SPACE T *a, T expected, T desired)                                            \
    {                                                                                                                  \
        __atomic_compare_exchange_n(a, &expected, desired, 0, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST);                     \
        return expected;                                                                                               \
    }                                                                                                                  \
    OVERLOADED T atomic_inc(volatile SPACE T *a)                                                                       \
    {                                                                                                                  \
        return atomic_add(a, (T)1);                                                                                    \
    }
ATOMICS(int, global)
ATOMICS(uint, global)
ATOMICS(int, local)
ATOMICS(uint, local)
