/* Numbers of faces of cells in 3D, while a diagram is made. */
#define UNFINISHED INT_MIN /* of a cell that is to be clipped, or to be clipped again with more room */
#define CERTAIN (1 << 30)  /* added where no face is near to rounding: others that are certain see the same */
#define COUNT_OF(n) ((n) & (CERTAIN - 1))
