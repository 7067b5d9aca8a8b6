/* Sites where generators are inserted or deleted, one key per generator: those are chosen that act in the same sweep,
   the strongest first, several rings of cells apart. */
#include "opencl/real.h"

/* A word that orders sites by magnitude, ties by index; 0 is no site. */
inline ulong site_key(REAL magnitude, int i)
{
    return ((ulong)as_uint((float)magnitude) << 32) | (uint)(0x7fffffff - i);
}

/* Per generator i: the largest key in itself and its neighbors. */
kernel void spread_keys(const int size, global const int *starts, global const int *neighbors, global const ulong *keys,
                        global ulong *spread)
{
    WORK_ITEM(i);
    ulong key = keys[i];
    for (int k = starts[i]; k < starts[i + 1]; ++k)
        if (neighbors[k] >= 0)
            key = max(key, keys[neighbors[k]]);
    spread[i] = key;
}

/* Per generator i: a site whose key is the largest for rings around is chosen; `chosen` collects over several
   rounds. */
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

/* Per generator i: a site near a chosen one (spread[i] != 0) is out. */
kernel void drop_sites(const int size, global const ulong *spread, global ulong *keys)
{
    WORK_ITEM(i);
    if (spread[i])
        keys[i] = 0;
}

/* Per generator i: no site where it does not move (labels less than `fixed`) or, with `around`, one of its
   neighbors. */
kernel void exempt_fixed(const int size, global const int *starts, global const int *neighbors,
                         global const int *labels, const int fixed, const int around, global ulong *keys)
{
    WORK_ITEM(i);
    bool near = labels[i] < fixed;
    for (int k = starts[i]; around && k < starts[i + 1] && !near; ++k)
        near = neighbors[k] >= 0 && labels[neighbors[k]] < fixed;
    if (near)
        keys[i] = 0;
}

/* Per chosen site: count it in the histogram of the keys from `low` on, HISTOGRAM bins of `width`. */
kernel void count_sites(const int size, global const ulong *chosen, const ulong low, const ulong width,
                        global int *histogram)
{
    WORK_ITEM(i);
    const ulong key = chosen[i];
    if (key && key >= low && (key - low) / width < HISTOGRAM)
        atomic_inc(histogram + (key - low) / width);
}

/* Per chosen site: drop it if its key is below `least`. */
kernel void limit_sites(const int size, const ulong least, global ulong *chosen)
{
    WORK_ITEM(i);
    if (chosen[i] < least)
        chosen[i] = 0;
}

/* Per generator i: is it a chosen site? For ranks by prefix sums. */
kernel void flag_sites(const int size, global const ulong *chosen, global int *flags)
{
    WORK_ITEM(i);
    flags[i] = chosen[i] != 0;
}
