/* Selection of sites where generators are inserted or deleted. Each generator has a key. The strongest sites that are
   several rings of cells apart are chosen. One work-item per generator. */
#include "adaptation/site_key.h"
#include "opencl/blocks.h"
#include "opencl/reduce.h"

/* Block-wise: one[i] = largest key of i and its neighbors. One group may do more than one ring: the second is from
   `one` to `other`, the third back. */
kernel void spread_keys(const int n, const int rings, global const int *starts, global const int *neighbors,
                        global const ulong *keys, global ulong *one, global ulong *other)
{
    for (int ring = 0; ring < rings; ++ring) {
        global ulong *to = ring & 1 ? other : one;
        for (BLOCK_LOOP(i, n)) {
            ulong key = keys[i];
            for (int k = starts[i]; k < starts[i + 1]; ++k)
                if (neighbors[k] >= 0)
                    key = max(key, keys[neighbors[k]]);
            to[i] = key;
        }
        keys = to;
        GROUP_BARRIER;
    }
}

/* A site is chosen if its key is the largest in the rings around it. `chosen` collects several rounds. */
kernel void choose_sites(const int size, global const ulong *keys, global const ulong *spread, global ulong *chosen,
                         global ulong *latest)
{
    WORK_ITEM(i);
    const ulong key = keys[i];
    const ulong mine = key != 0 && spread[i] == key ? key : 0;
    latest[i] = mine;
    if (mine)
        chosen[i] = mine;
}

/* Remove sites near a chosen one, spread[i] != 0. */
kernel void drop_sites(const int size, global const ulong *spread, global ulong *keys)
{
    WORK_ITEM(i);
    if (spread[i])
        keys[i] = 0;
}

/* Remove sites at fixed generators (labels below `fixed`) and, with `around`, at their neighbors. */
kernel void drop_fixed_sites(const int size, global const int *starts, global const int *neighbors,
                             global const int *labels, const int fixed, const int around, global ulong *keys)
{
    WORK_ITEM(i);
    bool near = labels[i] < fixed;
    for (int k = starts[i]; around && k < starts[i + 1] && !near; ++k)
        near = neighbors[k] >= 0 && labels[neighbors[k]] < fixed;
    if (near)
        keys[i] = 0;
}

/* Histogram of the keys of chosen sites from `low` on, HISTOGRAM bins of `width`. */
kernel void count_sites(const int size, global const ulong *chosen, const ulong low, const ulong width,
                        global int *histogram)
{
    WORK_ITEM(i);
    const ulong key = chosen[i];
    if (key && key >= low && (key - low) / width < HISTOGRAM)
        atomic_inc(histogram + (key - low) / width);
}

/* Remove chosen sites with keys below `least`. */
kernel void limit_sites(const int size, const ulong least, global ulong *chosen)
{
    WORK_ITEM(i);
    if (chosen[i] < least)
        chosen[i] = 0;
}

/* flags[i] = 1 for chosen sites, for ranks by prefix sums. */
kernel void flag_sites(const int size, global const ulong *chosen, global int *flags)
{
    WORK_ITEM(i);
    flags[i] = chosen[i] != 0;
}
