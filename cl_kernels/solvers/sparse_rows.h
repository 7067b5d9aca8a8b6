/* Sparse rows of a weighted graph: columns[starts[i] .. starts[i + 1]) with their weights; starts has n + 1 entries.
   Negative columns (walls) have weight 0. Weights and vectors are in STORE, by default REAL. Include after real.h and
   blocks.h. */

#ifndef STORE
#define STORE REAL
#endif
#define STORE8 CLVORO_JOIN(STORE, 8)
/* The type of mask that select() takes for eight values of TYPE. */
#define MASK8_double(inside) convert_long8(inside)
#define MASK8_float(inside) (inside)
#define MASK8(TYPE) CLVORO_JOIN(MASK8_, TYPE)

/* Define a function that returns (A x)_i = sum_k w_k (x_i - x_columns[k]), where VALUE(j) is x_j; it may use `names`,
   the function's further arguments.

   On a CPU eight entries at a time; entries behind the end of the row get weight 0. Rows are short and of different
   lengths, so that a plain loop mispredicts branches (measured: 2.7 times as long). The last eight entries of the
   arrays are left to the plain loop. */
#if GROUP_SIZE == 1
#define ADD_EIGHT_ENTRIES(VALUE)                                                                                       \
    const int last = starts[n] - 8;                                                                                    \
    for (; k < end && k <= last; k += 8) {                                                                             \
        const int8 inside = k + (int8)(0, 1, 2, 3, 4, 5, 6, 7) < end;                                                  \
        const int8 c = max(vload8(0, columns + k), (int8)(0));                                                         \
        const STORE8 w = select((STORE8)(0), vload8(0, weights + k), MASK8(STORE)(inside));                            \
        const STORE8 there = (STORE8)(VALUE(c.s0), VALUE(c.s1), VALUE(c.s2), VALUE(c.s3), VALUE(c.s4), VALUE(c.s5),    \
                                      VALUE(c.s6), VALUE(c.s7));                                                       \
        const STORE8 p = w * (xi - there);                                                                             \
        const CLVORO_JOIN(STORE, 4) p4 = p.lo + p.hi;                                                                  \
        const CLVORO_JOIN(STORE, 2) p2 = p4.lo + p4.hi;                                                                \
        sum += p2.s0 + p2.s1;                                                                                          \
    }
#else
#define ADD_EIGHT_ENTRIES(VALUE)
#endif
#define ROW_DIFFERENCE(name, VALUE, ...)                                                                               \
    inline STORE name(int i, int n, global const int *starts, global const int *columns, global const STORE *weights,  \
                      __VA_ARGS__)                                                                                     \
    {                                                                                                                  \
        const STORE xi = VALUE(i);                                                                                     \
        const int end = starts[i + 1];                                                                                 \
        int k = starts[i];                                                                                             \
        STORE sum = 0;                                                                                                 \
        ADD_EIGHT_ENTRIES(VALUE)                                                                                       \
        for (; k < end; ++k)                                                                                           \
            if (columns[k] >= 0)                                                                                       \
                sum += weights[k] * (xi - VALUE(columns[k]));                                                          \
        return sum;                                                                                                    \
    }

#define ENTRY_OF_X(j) x[j]
ROW_DIFFERENCE(row_difference, ENTRY_OF_X, global const STORE *x)
