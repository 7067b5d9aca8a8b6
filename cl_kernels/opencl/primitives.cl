#include "opencl/real.h"
#include "opencl/blocks.h"

/* Exclusive prefix sums in two passes. Each work-item has one contiguous chunk of the array. */

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

/* out[i] = values[first] + ... + values[first + i - 1]; out[n] is the total. `values` may be `out` if first is 0. Each
   work-item adds up the sums of the chunks before its own. */
kernel void scan_chunks(const int size, global const int *values, const int first, global const int *sums,
                        global int *out, const int n)
{
    WORK_ITEM(w);
    const int end = chunk_begin(n, w + 1, size);
    int total = 0;
    for (int v = 0; v < w; ++v)
        total += sums[v];
    for (int i = chunk_begin(n, w, size); i < end; ++i) {
        const int value = values[first + i];
        out[i] = total;
        total += value;
    }
    if (end == n && w == size - 1)
        out[n] = total;
}

/* The same in one pass, by one work-item. */
kernel void scan_few(const int size, global const int *values, const int first, global int *out, const int n)
{
    WORK_ITEM(only);
    (void)only;
    int total = 0;
    for (int i = 0; i < n; ++i) {
        const int value = values[first + i];
        out[i] = total;
        total += value;
    }
    out[n] = total;
}

/* Sum, sum of magnitudes, minimum and maximum of an array. Sums are compensated (Neumaier, with Knuth's exact
   difference, which has no branch): float32 sums of millions of terms err by a few ulp. */
typedef struct {
    REAL sum, sum_low, magnitude, magnitude_low, least, largest;
} summary_t;

#define ADD_COMPENSATED(T, sum, low, value)                                                                            \
    do {                                                                                                               \
        const T total_ = (sum) + (value), part_ = total_ - (sum);                                                      \
        (low) += ((sum) - (total_ - part_)) + ((value)-part_);                                                         \
        (sum) = total_;                                                                                                \
    } while (0)

inline void merge_summary(summary_t *a, summary_t b)
{
    ADD_COMPENSATED(REAL, a->sum, a->sum_low, b.sum);
    a->sum_low += b.sum_low;
    ADD_COMPENSATED(REAL, a->magnitude, a->magnitude_low, b.magnitude);
    a->magnitude_low += b.magnitude_low;
    a->least = fmin(a->least, b.least);
    a->largest = fmax(a->largest, b.largest);
}

inline void add_value(summary_t *a, REAL value)
{
    ADD_COMPENSATED(REAL, a->sum, a->sum_low, value);
    ADD_COMPENSATED(REAL, a->magnitude, a->magnitude_low, fabs(value));
    a->least = fmin(a->least, value);
    a->largest = fmax(a->largest, value);
}

#if GROUP_SIZE == 1
#define REAL8 CLVORO_JOIN(REAL, 8)

/* Items [begin, end), eight at a time, because one sum would wait for each addition. */
inline void add_run(summary_t *a, global const REAL *values, int begin, int end)
{
    REAL8 sum = 0, sum_low = 0, magnitude = 0, magnitude_low = 0, least = REAL_MAX, largest = -REAL_MAX;
    int i = begin;
    for (; i + 8 <= end; i += 8) {
        const REAL8 value = vload8(0, values + i);
        ADD_COMPENSATED(REAL8, sum, sum_low, value);
        ADD_COMPENSATED(REAL8, magnitude, magnitude_low, fabs(value));
        least = fmin(least, value);
        largest = fmax(largest, value);
    }
    REAL s[8], l[8], m[8], n[8], lo[8], hi[8];
    vstore8(sum, 0, s);
    vstore8(sum_low, 0, l);
    vstore8(magnitude, 0, m);
    vstore8(magnitude_low, 0, n);
    vstore8(least, 0, lo);
    vstore8(largest, 0, hi);
    for (int k = 0; k < 8; ++k) {
        const summary_t lane = {s[k], l[k], m[k], n[k], lo[k], hi[k]};
        merge_summary(a, lane);
    }
    for (; i < end; ++i)
        add_value(a, values[i]);
}
#endif

/* Block-wise: partials[groups * slot + group] = summary of the group's items of an array, of the first `count` of eight
   arrays; slots has the slot of each. */
kernel void summarize_blocks(global const REAL *a0, global const REAL *a1, global const REAL *a2, global const REAL *a3,
                             global const REAL *a4, global const REAL *a5, global const REAL *a6, global const REAL *a7,
                             const int count, const int n, const int8 slots, global summary_t *partials)
{
    const int slot_of[8] = {slots.s0, slots.s1, slots.s2, slots.s3, slots.s4, slots.s5, slots.s6, slots.s7};
#if GROUP_SIZE > 1
    local summary_t shares[GROUP_SIZE];
#endif
    for (int a = 0; a < count; ++a) {
        global const REAL *values =
            a < 4 ? (a < 2 ? (a < 1 ? a0 : a1) : (a < 3 ? a2 : a3)) : (a < 6 ? (a < 5 ? a4 : a5) : (a < 7 ? a6 : a7));
        global summary_t *out = partials + get_num_groups(0) * slot_of[a] + get_group_id(0);
        summary_t mine = {0, 0, 0, 0, REAL_MAX, -REAL_MAX};
#if GROUP_SIZE == 1
        add_run(&mine, values, block_begin(n), block_end(n));
        *out = mine;
#else
        const int t = get_local_id(0);
        for (BLOCK_LOOP(i, n))
            add_value(&mine, values[i]);
        barrier(CLK_LOCAL_MEM_FENCE);
        shares[t] = mine;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (t == 0) {
            for (int s = 1; s < GROUP_SIZE; ++s)
                merge_summary(&mine, shares[s]);
            *out = mine;
        }
#endif
    }
}

/* One work-item per slot. If bit `slot` of `which` is set, out[4 slot ...] = sum, sum of magnitudes, minimum, maximum.
   If `noted`, the first number of `note` follows the last slot: the host reads all in one transfer. */
kernel void combine_blocks(const int size, global const summary_t *partials, const int groups, const int which,
                           const int noted, global const int *note, global REAL *out, global int *behind)
{
    WORK_ITEM(slot);
    if (noted && slot == 0)
        behind[4 * size * (int)(sizeof(REAL) / sizeof(int))] = note[0];
    if (!(which >> slot & 1))
        return;
    summary_t all = partials[groups * slot];
    for (int g = 1; g < groups; ++g)
        merge_summary(&all, partials[groups * slot + g]);
    global REAL *put = out + 4 * slot;
    put[0] = all.sum + all.sum_low;
    put[1] = all.magnitude + all.magnitude_low;
    put[2] = all.least;
    put[3] = all.largest;
}

/* Row p of `out` is row items[p] of `rows`; a row has `words` 32-bit words of any type. */
kernel void gather_rows(const int size, global const int *items, global const uint *rows, const int words,
                        global uint *out)
{
    WORK_ITEM(p);
    const int i = items[p];
    for (int w = 0; w < words; ++w)
        out[words * p + w] = rows[words * i + w];
}
