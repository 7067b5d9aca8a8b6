/* Numbers of faces of cells in 3D, while a diagram is made. */
#define UNFINISHED INT_MIN /* a cell that must be clipped, or clipped again with more room */
#define CERTAIN (1 << 30)  /* added if no face is near round-off: other certain cells have the same faces */
#define COUNT_OF(n) ((n) & (CERTAIN - 1))

/* Reserve a range in the arrays of faces. Its position depends on the order of work-items, its content does not.
   report[0]: error bits; report[1]: number of faces. */
inline int take_places(global int *report, int count)
{
    return atomic_add(report + 1, count);
}
