/* Block-wise kernels: a group works on the items [block_begin(n), block_end(n)), its work-items with stride GROUP_SIZE.
   On CPUs, with GROUP_SIZE 1, this is a plain loop. On GPUs accesses are coalesced. The items of a group depend on n
   and the number of groups only, so that sums have the same bits in every run. */
#ifndef GROUP_SIZE
#error "build with -DGROUP_SIZE=work-items per group"
#endif

/* The first item of block g of `groups`. */
inline int block_start(int n, int g, int groups)
{
    return (int)(((long)n * g) / groups);
}

inline int block_begin(int n)
{
    return block_start(n, get_group_id(0), get_num_groups(0));
}

inline int block_end(int n)
{
    return block_start(n, get_group_id(0) + 1, get_num_groups(0));
}

/* for (BLOCK_LOOP(i, n)) { ... } */
#define BLOCK_LOOP(i, n) LOOP_OF_ITEM(i, n, get_group_id(0), get_num_groups(0), get_local_id(0))
#define LOOP_OF_ITEM(i, n, group, groups, item)                                                                        \
    int i = block_start(n, group, groups) + item, i##_end = block_start(n, group + 1, groups);                         \
    i < i##_end;                                                                                                       \
    i += GROUP_SIZE
