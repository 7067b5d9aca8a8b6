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

/* (A x)_i = sum_k w_k (x_i - x_columns[k]).

   On a CPU eight entries at a time; entries behind the end of the row get weight 0. Rows are short and of different
   lengths, so that a plain loop mispredicts branches (measured: 2.7 times as long). The last eight entries of the
   arrays are left to the plain loop. */
inline STORE row_difference(int i, int n, global const int *starts, global const int *columns,
                            global const STORE *weights, global const STORE *x)
{
    const STORE xi = x[i];
    const int end = starts[i + 1];
    int k = starts[i];
    STORE sum = 0;
#if GROUP_SIZE == 1
    const int last = starts[n] - 8;
    for (; k < end && k <= last; k += 8) {
        const int8 inside = k + (int8)(0, 1, 2, 3, 4, 5, 6, 7) < end;
        const int8 c = max(vload8(0, columns + k), (int8)(0));
        const STORE8 w = select((STORE8)(0), vload8(0, weights + k), MASK8(STORE)(inside));
        const STORE8 there = (STORE8)(x[c.s0], x[c.s1], x[c.s2], x[c.s3], x[c.s4], x[c.s5], x[c.s6], x[c.s7]);
        const STORE8 p = w * (xi - there);
        const CLVORO_JOIN(STORE, 4) p4 = p.lo + p.hi;
        const CLVORO_JOIN(STORE, 2) p2 = p4.lo + p4.hi;
        sum += p2.s0 + p2.s1;
    }
#endif
    for (; k < end; ++k)
        if (columns[k] >= 0)
            sum += weights[k] * (xi - x[columns[k]]);
    return sum;
}
