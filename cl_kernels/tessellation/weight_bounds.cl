#include "tessellation/weight_bounds.h"

/* Per generator i: the key of its weight into the largest one of its tile. Keys begin as INT_MIN. */
kernel void collect_weights(const int size, global const REAL *points, const REAL4 tiles_from, const int side,
                            global int *keys)
{
    WORK_ITEM(i);
    REAL x[DIM];
    EACH_AXIS (a)
        x[a] = points[STRIDE * i + a];
    atomic_max(keys + tile_index(tile_of(x, tiles_from, side), side), key_of_weight(WEIGHT(points, i)));
}

/* Per tile t of a level with `side` tiles along each axis, from `first` on: the largest key of its parts. These are
   just before. */
kernel void coarsen_weights(const int size, const int side, const int first, global int *keys)
{
    WORK_ITEM(t);
    const int3 at = (int3)(t % side, t / side % side, t / side / side) * 2;
    global const int *parts = keys + first - tile_count(2 * side);
    int most = INT_MIN;
    for (int k = 0; k < (1 << DIM); ++k)
        most = max(most, parts[tile_index(at + (int3)(k & 1, (k >> 1) & 1, k >> 2), 2 * side)]);
    keys[first + t] = most;
}

/* Per tile t of such a level: the largest weight in the tile and those around it; -FLT_MAX if they are empty. */
kernel void spread_weights(const int size, const int side, const int first, global const int *keys,
                           global float *bounds)
{
    WORK_ITEM(t);
    const int3 at = (int3)(t % side, t / side % side, t / side / side);
    int most = INT_MIN;
    for (int z = DIM == 2 ? 0 : max(at.s2 - 1, 0); z <= (DIM == 2 ? 0 : min(at.s2 + 1, side - 1)); ++z)
        for (int y = max(at.s1 - 1, 0); y <= min(at.s1 + 1, side - 1); ++y)
            for (int x = max(at.s0 - 1, 0); x <= min(at.s0 + 1, side - 1); ++x)
                most = max(most, keys[first + tile_index((int3)(x, y, z), side)]);
    bounds[first + t] = most == INT_MIN ? -FLT_MAX : weight_of_key(most);
}
