#include "common/real.h"
#include "common/blocks.h"

/* Exclusive prefix sums in three passes. One work-item stands for one contiguous chunk of the array. */

inline int chunk_begin(int n, int w, int width)
{
    return (int)(((long)n * w) / width);
}

/* sums[w] = sum of chunk w. */
kernel void chunk_sums(const int size, global const int *values, const int first, global int *sums, const int n)
{
    WORK_ITEM(w);
    const int end = chunk_begin(n, w + 1, size);
    int sum = 0;
    for (int i = chunk_begin(n, w, size); i < end; ++i)
        sum += values[first + i];
    sums[w] = sum;
}

/* One work-item: sums becomes its own exclusive prefix sum, with the total at sums[width]. */
kernel void scan_sums(const int size, global int *sums, const int width)
{
    WORK_ITEM(only);
    (void)only;
    int total = 0;
    for (int w = 0; w < width; ++w) {
        const int sum = sums[w];
        sums[w] = total;
        total += sum;
    }
    sums[width] = total;
}

/* out[i] = values[first] + ... + values[first + i - 1]; out[n] is the total. `values` may be `out` if first is 0. */
kernel void scan_chunks(const int size, global const int *values, const int first, global const int *sums,
                        global int *out, const int n)
{
    WORK_ITEM(w);
    const int end = chunk_begin(n, w + 1, size);
    int total = sums[w];
    for (int i = chunk_begin(n, w, size); i < end; ++i) {
        const int value = values[first + i];
        out[i] = total;
        total += value;
    }
    if (end == n && w == size - 1)
        out[n] = total;
}

/* Sum, sum of magnitudes, least and largest of an array. Sums are compensated (Neumaier), so that float32 totals of
   millions of terms stay exact to a few ulp. */
typedef struct {
    REAL sum, sum_low, magnitude, magnitude_low, least, largest;
} summary_t;

inline void add_compensated(REAL *sum, REAL *low, REAL value)
{
    const REAL total = *sum + value;
    *low += fabs(*sum) >= fabs(value) ? (*sum - total) + value : (value - total) + *sum;
    *sum = total;
}

inline void merge_summary(summary_t *a, summary_t b)
{
    add_compensated(&a->sum, &a->sum_low, b.sum);
    a->sum_low += b.sum_low;
    add_compensated(&a->magnitude, &a->magnitude_low, b.magnitude);
    a->magnitude_low += b.magnitude_low;
    a->least = fmin(a->least, b.least);
    a->largest = fmax(a->largest, b.largest);
}

/* Block-wise: partials[group] = summary of the group's items. */
kernel void summarise_blocks(global const REAL *values, const int n, global summary_t *partials)
{
    local summary_t shares[GROUP_SIZE];
    const int t = get_local_id(0);
    summary_t mine = {0, 0, 0, 0, REAL_MAX, -REAL_MAX};
    for (BLOCK_LOOP(i, n)) {
        const REAL value = values[i];
        add_compensated(&mine.sum, &mine.sum_low, value);
        add_compensated(&mine.magnitude, &mine.magnitude_low, fabs(value));
        mine.least = fmin(mine.least, value);
        mine.largest = fmax(mine.largest, value);
    }
    shares[t] = mine;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (t == 0) {
        for (int s = 1; s < GROUP_SIZE; ++s)
            merge_summary(&mine, shares[s]);
        partials[get_group_id(0)] = mine;
    }
}

/* One work-item: out[4 slot ...] = sum, sum of magnitudes, least, largest. */
kernel void combine_blocks(const int size, global const summary_t *partials, const int groups, const int slot,
                           global REAL *out)
{
    WORK_ITEM(only);
    (void)only;
    summary_t all = partials[0];
    for (int g = 1; g < groups; ++g)
        merge_summary(&all, partials[g]);
    out[4 * slot] = all.sum + all.sum_low;
    out[4 * slot + 1] = all.magnitude + all.magnitude_low;
    out[4 * slot + 2] = all.least;
    out[4 * slot + 3] = all.largest;
}

/* Row p of `out` is row items[p] of `rows`; a row is `words` 32-bit words, whatever they mean. */
kernel void gather_rows(const int size, global const int *items, global const uint *rows, const int words, global uint *out)
{
    WORK_ITEM(p);
    const int i = items[p];
    for (int w = 0; w < words; ++w)
        out[words * p + w] = rows[words * i + w];
}
