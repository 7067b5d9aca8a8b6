/* Numbers of faces of cells in 3D, while a diagram is made. */
#define UNFINISHED INT_MIN /* of a cell that is to be clipped, or to be clipped again with more room */
#define CERTAIN (1 << 30)  /* added where no face is near to rounding: others that are certain see the same */
#define COUNT_OF(n) ((n) & (CERTAIN - 1))

/* Where in the arrays of faces so many of a cell, or of several, have their place: which one is chance, what they will
   hold is not. report[0] says what went wrong, report[1] counts faces. */
inline int take_places(global int *report, int count)
{
    return atomic_add(report + 1, count);
}
