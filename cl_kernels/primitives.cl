#include "common/real.h"

/* Exclusive prefix sums in three passes. One work-item stands for one contiguous chunk of the array. */

inline int chunk_begin(int n, int w)
{
    return (int)(((long)n * w) / get_global_size(0));
}

/* sums[w] = sum of chunk w. */
kernel void chunk_sums(global const int *values, const int first, global int *sums, const int n)
{
    const int w = get_global_id(0);
    const int end = chunk_begin(n, w + 1);
    int sum = 0;
    for (int i = chunk_begin(n, w); i < end; ++i)
        sum += values[first + i];
    sums[w] = sum;
}

/* One work-item: sums becomes its own exclusive prefix sum, with the total at sums[width]. */
kernel void scan_sums(global int *sums, const int width)
{
    int total = 0;
    for (int w = 0; w < width; ++w) {
        const int sum = sums[w];
        sums[w] = total;
        total += sum;
    }
    sums[width] = total;
}

/* out[i] = values[first] + ... + values[first + i - 1]; out[n] is the total. `values` may be `out` if first is 0. */
kernel void scan_chunks(global const int *values, const int first, global const int *sums, global int *out,
                        const int n)
{
    const int w = get_global_id(0);
    const int end = chunk_begin(n, w + 1);
    int total = sums[w];
    for (int i = chunk_begin(n, w); i < end; ++i) {
        const int value = values[first + i];
        out[i] = total;
        total += value;
    }
    if (end == n && w == get_global_size(0) - 1)
        out[n] = total;
}
