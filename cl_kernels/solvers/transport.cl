#include "opencl/real.h"

/* Per cell i: the volume of its target size, h_i^d. */
kernel void prescribe_sizes(const int size, global const REAL *h, global REAL *prescribed)
{
    WORK_ITEM(i);
    prescribed[i] = CELL_DIM == 2 ? h[i] * h[i] : h[i] * h[i] * h[i];
}

/* Per cell i: its volume times a common factor. */
kernel void scale_volumes(const int size, const REAL factor, global REAL *prescribed)
{
    WORK_ITEM(i);
    prescribed[i] *= factor;
}

/* Per cell i, with the prescribed volume m_i:

   rhs       2 (m_i - V_i), the right side of Newton's equation L dw = 2 (m - V)
   square    (m_i - V_i)^2
   relative  (V_i - m_i) / m_i */
kernel void compare_volumes(const int size, global const REAL *volumes, global const REAL *prescribed, global REAL *rhs,
                            global REAL *square, global REAL *relative)
{
    WORK_ITEM(i);
    const REAL lack = prescribed[i] - volumes[i];
    rhs[i] = 2 * lack;
    square[i] = lack * lack;
    relative[i] = -lack / prescribed[i];
}

/* Per cell i: the weight after a share of Newton's step. */
kernel void step_weights(const int size, const REAL share, global const REAL *weights, global const REAL *step,
                         global REAL *stepped)
{
    WORK_ITEM(i);
    stepped[i] = weights[i] + share * step[i];
}
