/* Block-wise kernels: a group works on the items [block_begin(n), block_end(n)), its work-items with stride GROUP_SIZE.
   On CPUs, with GROUP_SIZE 1, this is a plain loop. On GPUs accesses are coalesced. The items of a group depend on n
   and the number of groups only, so that sums have the same bits in every run. */
#ifndef GROUP_SIZE
#error "build with -DGROUP_SIZE=work-items per group"
#endif

inline int block_begin(int n)
{
    return (int)(((long)n * get_group_id(0)) / get_num_groups(0));
}

inline int block_end(int n)
{
    return (int)(((long)n * (get_group_id(0) + 1)) / get_num_groups(0));
}

/* for (BLOCK_LOOP(i, n)) { ... } */
#define BLOCK_LOOP(i, n)                                                                                               \
    int i = block_begin(n) + get_local_id(0), i##_end = block_end(n);                                                  \
    i < i##_end;                                                                                                       \
    i += GROUP_SIZE
