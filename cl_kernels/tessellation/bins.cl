#include "tessellation/bins.h"
#include "opencl/sort.h"

/* A counting sort, level by level. The order of the atomics only changes the ranks within a bin, and the last pass
   sorts each bin by generator index: the result is deterministic. */

/* Per generator i: keys[i] = its bin in grid 0, ranks[i] = its place in the bin. counts must be zero. */
kernel void count_root(const int size, global const REAL *points, const FRAME frame, const int4 shape, global int *keys,
                       global int *ranks, global int *counts)
{
    WORK_ITEM(i);
    const int key = bin_in_grid(points + STRIDE * i, frame, shape);
    keys[i] = key;
    ranks[i] = atomic_inc(counts + key);
}

/* Bins per axis of the grid that divides a bin of `count` generators; 0 keeps the bin whole. In 3D a power of two. */
inline int child_side(int count)
{
    if (count <= SPLIT_COUNT)
        return 0;
    int side = 2;
#if DIM == 2
    while (side < MAX_CHILD_SIDE && count >= OCCUPANCY * (side + 1) * (side + 1))
        ++side;
#else
    while (side < MAX_CHILD_SIDE && count > OCCUPANCY * 8 * side * side * side)
        side *= 2;
#endif
    return side;
}

/* Per bin b of the newest level [begin, begin + n): whether it is divided, and into how many bins, with the end entry.
 */
kernel void plan_children(const int size, global const int *counts, const int begin, const int may_divide,
                          global int *grid_flags, global int *child_bins)
{
    WORK_ITEM(b);
    const int side = may_divide ? child_side(counts[begin + b]) : 0;
    grid_flags[b] = side > 0;
    child_bins[b] = side == 0 ? 0 : (DIM == 2 ? side * side : side * side * side) + 1;
}

/* Per bin b of the newest level: write bins[b]. starts are the prefix sums of this level's counts; a grid below level 0
   starts where its bin does. grid_ids are the prefix sums of the flags. */
kernel void place_bins(const int size, global const int *starts, const int begin, global const int *bin_grid,
                       global const int4 *grid_shapes, global const int *grid_items, const int first_grid,
                       global const int *grid_ids, global int2 *bins)
{
    WORK_ITEM(b);
    int start = starts[b];
    if (begin > 0) {
        const int g = bin_grid[begin + b];
        start += grid_items[g] - starts[grid_shapes[g].s0 - begin];
    }
    bins[begin + b] = (int2)(start, first_grid + grid_ids[b]);
}

/* Per divided bin b: create grid g over its box, and write g into each of its bins. */
kernel void make_grids(const int size, global const int2 *bins, global const int *counts, const int begin,
                       const int next_begin, global const int *child_firsts, global int *bin_grid,
                       global FRAME *grid_frames, global int4 *grid_shapes, global int *grid_items)
{
    WORK_ITEM(b);
    const int side = child_side(counts[begin + b]);
    if (side == 0)
        return;
    const int2 bin = bins[begin + b];
    const int parent = bin_grid[begin + b];
    const int g = bin.s1;
    const int first = next_begin + child_firsts[b];
    const int4 shape = grid_shapes[parent];
    const int place = begin + b - shape.s0;
    FRAME frame = grid_frames[parent];
    const REAL edge = 1 / FRAME_INVERSE(frame);
    frame.s0 += place % shape.s1 * edge;
    frame.s1 += place / shape.s1 % shape.s2 * edge;
#if DIM == 3
    frame.s2 += place / shape.s1 / shape.s2 * edge;
#endif
    FRAME_INVERSE(frame) *= side;
    grid_frames[g] = frame;
    grid_shapes[g] = (int4)(first, side, side, DIM == 3 ? side : 1);
    grid_items[g] = bin.s0;
    const int volume = DIM == 2 ? side * side : side * side * side;
    for (int c = 0; c <= volume; ++c)
        bin_grid[first + c] = g;
}

/* Per generator i whose bin was divided: count it into its new bin. */
kernel void count_in_child_bins(const int size, global const REAL *points, BIN_ARGS, global int *keys,
                                global int *ranks, global int *counts)
{
    WORK_ITEM(i);
    const int g = bins[keys[i]].s1;
    if (bins[keys[i] + 1].s1 == g)
        return;
    const int key = bin_in_grid(points + STRIDE * i, grid_frames[g], grid_shapes[g]);
    keys[i] = key;
    ranks[i] = atomic_inc(counts + key);
}

/* Per generator i: write it at its position in the order of bins. */
kernel void place_items(const int size, global const int *keys, global const int *ranks, global const int2 *bins,
                        global int *items)
{
    WORK_ITEM(i);
    items[bins[keys[i]].s0 + ranks[i]] = i;
}

/* The edge of a bin with OCCUPANCY generators, estimated from a block of bins around bin b in its grid: 3 along each
   axis, or more until they hold SPACING_COUNT generators. The few generators of one leaf are a poor estimate. */
inline REAL local_spacing(int b, REAL edge, int4 shape, global const int2 *bins)
{
    const int place = b - shape.s0, rows = place / shape.s1, column = place - rows * shape.s1;
    const int layer = DIM == 2 ? 0 : rows / shape.s2, row = rows - layer * shape.s2;
    int count = 0, held = 1, before = 0;
    for (int width = 1; count < SPACING_COUNT && held > before; ++width) {
        const int left = max(column - width, 0), right = min(column + width, shape.s1 - 1);
        const int front = max(row - width, 0), back = min(row + width, shape.s2 - 1);
        const int bottom = max(layer - width, 0), top = min(layer + width, shape.s3 - 1);
        count = 0;
        for (int l = bottom; l <= top; ++l)
            for (int r = front; r <= back; ++r) {
                global const int2 *row_bins = bins + shape.s0 + (l * shape.s2 + r) * shape.s1;
                count += row_bins[right + 1].s0 - row_bins[left].s0;
            }
        before = held;
        held = (right - left + 1) * (back - front + 1) * (top - bottom + 1);
    }
    const REAL share = (REAL)(OCCUPANCY * held) / count;
    return edge * (DIM == 2 ? sqrt(share) : cbrt(share));
}

/* Per bin: sort its items by generator index; write the edge of the leaf and the local spacing for each item. */
kernel void sort_bins(const int size, global const int2 *bins, global const int *bin_grid,
                      global const FRAME *grid_frames, global const int4 *grid_shapes, global int *items,
                      global float *reach, global float *spacing)
{
    LONG_ITEM(b);
    const int g = bin_grid[b];
    const int4 shape = grid_shapes[g];
    if (b - shape.s0 == shape.s1 * shape.s2 * shape.s3)
        return; /* the end entry of a grid */
    const int first = bins[b].s0, end = bins[b + 1].s0;
    if (first == end || bins[b].s1 != bins[b + 1].s1)
        return;
    sort_list(items + first, end - first);
    const REAL edge = 1 / FRAME_INVERSE(grid_frames[g]);
    const REAL mean = local_spacing(b, edge, shape, bins);
    for (int p = first; p < end; ++p) {
        reach[p] = (float)edge;
        spacing[p] = (float)mean;
    }
}

/* Per item p: generator p, once the generators have been sorted into the order of the bins. */
kernel void number_items(const int size, global int *items)
{
    WORK_ITEM(p);
    items[p] = p;
}
