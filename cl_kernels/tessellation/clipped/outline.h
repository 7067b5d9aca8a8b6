/* The boundary of cells in a clipped diagram. OUTLINE_ARGS come last in the signature of a kernel and are empty in
   boxes.

   outlines[i]  .s0: quality of cell i by the paper's (4.1) with straight sides along the boundary, see wall_sides.h.
                .s1: number of neighbors of a hexagonal lattice there
   tangents[e]  unit vector along edge e of the boundary, the domain on its left: the face with label -1 - e */
#include "opencl/real.h"

#ifdef POLYGON
#define OUTLINE_ARGS , global const REAL2 *outlines, global const REAL2 *tangents
#define OUTLINE , outlines, tangents
#define BOUNDARY_TANGENT(label) tangents[-1 - (label)]
#else
#define OUTLINE_ARGS
#define OUTLINE
#endif
