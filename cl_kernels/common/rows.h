/* Rows of a weighted graph: columns[starts[i] .. starts[i + 1]) with their weights; starts has n + 1 entries.
   Include after real.h and blocks.h. */

#define REAL8 CLVORO_JOIN(REAL, 8)
#if IS_DOUBLE
#define ROW_MASK(inside) convert_long8(inside)
#else
#define ROW_MASK(inside) (inside)
#endif

/* (A x)_i = sum_k w_k (x_i - x_columns[k]). On a CPU eight entries at a time, those behind the row's end with weight 0: rows
   are short and of all lengths, so that a plain loop waits for mispredicted branches most of the time (measured: 2.7
   times as long). Near the end of the arrays, where eight entries might reach beyond them, it is that plain loop. */
inline REAL row_difference(
    int i, int n, global const int *starts, global const int *columns, global const REAL *weights, global const REAL *x)
{
    const REAL xi = x[i];
    const int end = starts[i + 1];
    int k = starts[i];
    REAL sum = 0;
#if GROUP_SIZE == 1
    const int last = starts[n] - 8;
    for (; k < end && k <= last; k += 8) {
        const int8 inside = k + (int8)(0, 1, 2, 3, 4, 5, 6, 7) < end;
        const int8 c = select((int8)(i), vload8(0, columns + k), inside);
        const REAL8 w = select((REAL8)(0), vload8(0, weights + k), ROW_MASK(inside));
        const REAL8 there = (REAL8)(x[c.s0], x[c.s1], x[c.s2], x[c.s3], x[c.s4], x[c.s5], x[c.s6], x[c.s7]);
        const REAL8 p = w * (xi - there);
        sum += ((p.s0 + p.s1) + (p.s2 + p.s3)) + ((p.s4 + p.s5) + (p.s6 + p.s7));
    }
#endif
    for (; k < end; ++k) sum += weights[k] * (xi - x[columns[k]]);
    return sum;
}
