/* Block-wise work: group g owns the items [block_begin(n), block_end(n)), its work-items stride through them.
   With GROUP_SIZE 1 this is a plain loop per CPU core, with 128 it is coalesced on a GPU. Which items a group sums
   depends on n and the device alone, so sums repeat bit by bit from run to run. */
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
