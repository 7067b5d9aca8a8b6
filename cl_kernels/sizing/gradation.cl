/* Gradation limiting on a regular grid: the largest u <= f with |grad u| <= g, which is

       u(x) = min over y of f(y) + g |x - y|,

   the solution of the Eikonal equation |grad u| = g wherever u < f. At a node with the smaller neighbors a_k and
   spacings d_k along the axes, Godunov's upwind scheme of first order is

       sum over k of (max(u - a_k, 0) / d_k)^2 = g^2.

   Fast sweeping: the grid is divided into tiles of TILE^DIM nodes. One work-item per tile sweeps it in place in all
   2^DIM directions, if it is active. Stencils reach along the axes only, so that tiles of one color of a checkerboard
   do not read each other: the two colors alternate, and the result does not depend on the order of the work-items. A
   tile that has changed at a side activates the tile across that side. A tile waits while its values and those of its
   neighbors are above a threshold that rises from pass to pass, so that few tiles are swept before their neighbors are
   final. u only decreases, and decreases of a few ulps are ignored, so the sweeps end.

   With GLOBE the grid is one of longitude and latitude on a sphere, its nodes at the centers of pixels. Rows are
   closed, and their spacing is d_x times the cosine of the latitude. Beyond the first and the last row is the node of
   the same row at the opposite longitude. The number of tiles along a row is twice an odd number, so that these tiles,
   too, have different colors. */
#include "opencl/real.h"

/* Least decrease that is not ignored, relative to u. */
#define LEAST_DECREASE (8 * REAL_EPS)

/* u of the scheme from the smaller neighbors a (REAL_MAX: none) at distances d. Axes are used in the order of ascending
   a, as long as a is below the u from the previous axes. */
inline REAL upwind_value(REAL *a, REAL *d, REAL growth)
{
    for (int k = 1; k < DIM; ++k)
        for (int j = k; j > 0 && a[j] < a[j - 1]; --j) {
            REAL swap = a[j];
            a[j] = a[j - 1];
            a[j - 1] = swap;
            swap = d[j];
            d[j] = d[j - 1];
            d[j - 1] = swap;
        }
    /* With b = a - a_0 and w = 1/d^2: u - a_0 = (S + sqrt(g^2 W - W T + S^2)) / W, W = sum w, S = sum w b, T = sum w
       b^2. */
    REAL rise = growth * d[0];
    REAL W = 1 / (d[0] * d[0]), S = 0, T = 0;
    for (int k = 1; k < DIM; ++k) {
        const REAL b = a[k] - a[0];
        if (!(b < rise))
            break;
        const REAL w = 1 / (d[k] * d[k]);
        W += w;
        S += w * b;
        T += w * b * b;
        rise = (S + sqrt(fmax(W * (growth * growth - T) + S * S, (REAL)0))) / W;
    }
    return a[0] + rise;
}

/* Index of the item beside item `at` of a grid along one axis, in the lower (side 0) or upper (1) direction; -1 if
   there is none. place: position along each axis; count: items along each axis; stride: step of the index along each
   axis. */
inline int item_beside(const int at, const int *place, const int *count, const int *stride, const int axis,
                       const int side)
{
    const int onward = place[axis] + (side ? 1 : -1);
    if (onward >= 0 && onward < count[axis])
        return at + (side ? stride[axis] : -stride[axis]);
#ifdef GLOBE
    const int turned = axis == 0 ? (onward + count[0]) % count[0] : (place[0] + count[0] / 2) % count[0];
    return at + turned - place[0];
#else
    return -1;
#endif
}

/* lowest[i] = smallest value of tile i. One work-item per tile. */
kernel void tile_minima(const int size, const int nx, const int ny, const int nz, global const REAL *restrict u,
                        global REAL *restrict lowest)
{
    WORK_ITEM(i);
    const int count[3] = {nx, ny, nz};
    int first[3] = {0, 0, 0}, last[3] = {0, 0, 0}, rest = i;
    for (int a = 0; a < DIM; ++a) {
        const int tiles = (count[a] + TILE - 1) / TILE;
        first[a] = rest % tiles * TILE;
        rest /= tiles;
        last[a] = min(first[a] + TILE, count[a]) - 1;
    }
    REAL least = REAL_MAX;
    for (int z = first[2]; z <= last[2]; ++z)
        for (int y = first[1]; y <= last[1]; ++y)
            for (int x = first[0]; x <= last[0]; ++x)
                least = fmin(least, u[x + nx * (y + ny * z)]);
    lowest[i] = least;
}

/* One pass over the tiles of one `color`, one work-item per tile. active, next_active: 1 for tiles to sweep now, in the
   next pass. Tiles of the other color stay active, and so do tiles without a value below `threshold` in themselves and
   their neighbors. lowest: smallest value of each tile. u: nx ny nz values with x running fastest, dx, dy, dz apart
   (on a sphere dx at the equator). */
kernel void sweep_tiles(const int size, const int nx, const int ny, const int nz, const REAL dx, const REAL dy,
                        const REAL dz, const int color, const REAL growth, const REAL threshold,
                        global const int *restrict active, global int *restrict next_active, global REAL *lowest,
                        global REAL *u)
{
    WORK_ITEM(i);
    if (!active[i])
        return;
    const int count[3] = {nx, ny, nz};
    const REAL spacing[3] = {dx, dy, dz};
    int tile[DIM], tiles[DIM], first[DIM], last[DIM], stride[DIM], tile_stride[DIM];
    int rest = i, parity = 0;
    for (int a = 0; a < DIM; ++a) {
        tiles[a] = (count[a] + TILE - 1) / TILE;
        tile[a] = rest % tiles[a];
        rest /= tiles[a];
        parity += tile[a];
        first[a] = tile[a] * TILE;
        last[a] = min(first[a] + TILE, count[a]) - 1;
        stride[a] = a ? stride[a - 1] * count[a - 1] : 1;
        tile_stride[a] = a ? tile_stride[a - 1] * tiles[a - 1] : 1;
    }
    if ((parity & 1) != color) {
        atomic_or(next_active + i, 1);
        return;
    }
    REAL least = lowest[i], around = least;
    int beside[2 * DIM];
    for (int k = 0; k < 2 * DIM; ++k) {
        beside[k] = item_beside(i, tile, tiles, tile_stride, k / 2, k % 2);
        around = fmin(around, beside[k] >= 0 ? lowest[beside[k]] : REAL_MAX);
    }
    if (around > threshold) {
        atomic_or(next_active + i, 1);
        return;
    }
#ifdef GLOBE
    REAL width[TILE];
    for (int row = first[1]; row <= last[1]; ++row)
        width[row - first[1]] = spacing[0] * sin((REAL)3.14159265358979323846 * (row + (REAL)0.5) / count[1]);
#endif
    /* Bits 2 a and 2 a + 1: a node at the lower or upper side along axis a has changed. */
    int changed = 0, sweeps_left = 1 << DIM, direction = 0;
    /* Sweep until all directions in turn have changed nothing. */
    while (sweeps_left > 0) {
        int moved = 0;
        int nodes = 1;
        for (int a = 0; a < DIM; ++a)
            nodes *= last[a] - first[a] + 1;
        for (int k = 0; k < nodes; ++k) {
            int at = 0, sides = 0, left = k, place[DIM];
            for (int a = 0; a < DIM; ++a) {
                const int width = last[a] - first[a] + 1;
                const int step = left % width;
                left /= width;
                place[a] = (direction >> a) & 1 ? last[a] - step : first[a] + step;
                at += place[a] * stride[a];
                sides |= (place[a] == first[a]) << (2 * a) | (place[a] == last[a]) << (2 * a + 1);
            }
            REAL lesser[DIM], across[DIM];
            for (int a = 0; a < DIM; ++a) {
                const int below = item_beside(at, place, count, stride, a, 0);
                const int above = item_beside(at, place, count, stride, a, 1);
                lesser[a] = fmin(below >= 0 ? u[below] : REAL_MAX, above >= 0 ? u[above] : REAL_MAX);
                across[a] = spacing[a];
            }
#ifdef GLOBE
            across[0] = width[place[1] - first[1]];
#endif
            const REAL now = u[at], limit = upwind_value(lesser, across, growth);
            if (limit < now * (1 - LEAST_DECREASE)) {
                u[at] = limit;
                least = fmin(least, limit);
                moved = 1;
                changed |= sides;
            }
        }
        direction = (direction + 1) & ((1 << DIM) - 1);
        sweeps_left = moved ? 1 << DIM : sweeps_left - 1;
    }
    lowest[i] = least;
    for (int k = 0; k < 2 * DIM; ++k)
        if ((changed >> k & 1) && beside[k] >= 0)
            atomic_or(next_active + beside[k], 1);
}
