/* The boundary as a cell of a trimmed diagram has it. OUTLINE_ARGS come last in a kernel's signature and are empty in
   boxes.

   outlines[i]  (sides of the cell, those of the boundary that turn by less than 30 degrees counted as one; neighbours
   that a hexagonal lattice would have there) tangents[e]  unit vector along edge e of the boundary, the domain on its
   left: the face of label -1 - e */
#include "common/real.h"

#ifdef POLYGON
#define OUTLINE_ARGS , global const REAL2 *outlines, global const REAL2 *tangents
#define OUTLINE , outlines, tangents
#define BOUNDARY_TANGENT(label) tangents[-1 - (label)]
#else
#define OUTLINE_ARGS
#define OUTLINE
#endif
