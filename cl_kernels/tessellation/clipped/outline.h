/* The boundary as a cell of a trimmed diagram has it. OUTLINE_ARGS come last in a kernel's signature and are empty in
   boxes.

   outlines[i]  (quality of the cell by the paper's 4.1, as the polygon whose sides are its faces, those on the boundary
                taken together and straightened as long as they turn by no more than 30 degrees: see sides.h;
                neighbors that a hexagonal lattice would have there)
   tangents[e]  unit vector along edge e of the boundary, the domain on its left: the face of label -1 - e */
#include "opencl/real.h"

#ifdef POLYGON
#define OUTLINE_ARGS , global const REAL2 *outlines, global const REAL2 *tangents
#define OUTLINE , outlines, tangents
#define BOUNDARY_TANGENT(label) tangents[-1 - (label)]
#else
#define OUTLINE_ARGS
#define OUTLINE
#endif
