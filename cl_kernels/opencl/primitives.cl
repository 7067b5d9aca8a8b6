#include "opencl/real.h"
#include "opencl/blocks.h"

/* Exclusive prefix sums in two passes: sums of the groups' blocks, then each block tile by tile. With one group the
   second pass is enough. A work-item takes four numbers of a tile. Kernels must not return before a barrier (see
   reduce.h). */

#if GROUP_SIZE > 1
#define GROUP_INTS(name) local int name[GROUP_SIZE]
#else
#define GROUP_INTS(name) local int *const name = 0
#endif

/* The sum of x over the work-items before this one; *total is that over the group. */
inline int group_scan(int x, local int *scratch, int *total)
{
#if GROUP_SIZE > 1
    const int me = get_local_id(0);
    int sum = x;
    barrier(CLK_LOCAL_MEM_FENCE);
    scratch[me] = x;
    for (int step = 1; step < GROUP_SIZE; step *= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        const int before = me >= step ? scratch[me - step] : 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        sum += before;
        scratch[me] = sum;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    *total = scratch[GROUP_SIZE - 1];
    return sum - x;
#else
    *total = x;
    return 0;
#endif
}

/* sums[group] = sum of the group's block of values[first ...]. */
kernel void sum_scan_blocks(global const int *values, const int first, const int n, global int *sums)
{
    GROUP_INTS(scratch);
    int mine = 0, sum;
    for (BLOCK_LOOP(i, n))
        mine += values[first + i];
    group_scan(mine, scratch, &sum);
    if (get_local_id(0) == 0)
        sums[get_group_id(0)] = sum;
}

/* out[i] = values[first] + ... + values[first + i - 1]; out[n] and all[place] are the total. `values` may be `out` if
   first is 0. */
kernel void scan_blocks(global const int *values, const int first, const int n, global const int *sums, global int *out,
                        global int *all, const int place)
{
    GROUP_INTS(scratch);
    const int t = get_local_id(0), end = block_end(n);
    int before = 0, total;
    for (int g = t; g < (int)get_group_id(0); g += GROUP_SIZE)
        before += sums[g];
    group_scan(before, scratch, &total);
    for (int tile = block_begin(n); tile < end; tile += 4 * GROUP_SIZE) {
        const int mine = tile + 4 * t, count = end - mine;
        int4 value = 0;
        if (count >= 4)
            value = vload4(0, values + first + mine);
        else if (count > 0)
            value = (int4)(values[first + mine], count > 1 ? values[first + mine + 1] : 0,
                           count > 2 ? values[first + mine + 2] : 0, 0);
        const int2 pair = value.s02 + value.s13;
        int of_tile;
        const int place = total + group_scan(pair.s0 + pair.s1, scratch, &of_tile);
        const int4 sums_before = place + (int4)(0, value.s0, pair.s0, pair.s0 + value.s2);
        if (count >= 4)
            vstore4(sums_before, 0, out + mine);
        else if (count > 0) {
            out[mine] = sums_before.s0;
            if (count > 1)
                out[mine + 1] = sums_before.s1;
            if (count > 2)
                out[mine + 2] = sums_before.s2;
        }
        total += of_tile;
    }
    if (end == n && t == 0 && get_group_id(0) == get_num_groups(0) - 1) {
        out[n] = total;
        all[place] = total;
    }
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

/* The summary of all work-items of a group, for the first of them: a tree. `shares` has GROUP_SIZE entries. */
inline void merge_group(summary_t *mine, local summary_t *shares)
{
#if GROUP_SIZE > 1
    const int me = get_local_id(0);
    barrier(CLK_LOCAL_MEM_FENCE);
    shares[me] = *mine;
    for (int half_ = GROUP_SIZE / 2; half_ > 0; half_ /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (me < half_) {
            merge_summary(mine, shares[me + half_]);
            shares[me] = *mine;
        }
    }
#endif
}

#if GROUP_SIZE > 1
#define GROUP_SUMMARIES(name) local summary_t name[GROUP_SIZE]
#else
#define GROUP_SUMMARIES(name) local summary_t *const name = 0
#endif

inline void add_value(summary_t *a, REAL value)
{
    ADD_COMPENSATED(REAL, a->sum, a->sum_low, value);
    ADD_COMPENSATED(REAL, a->magnitude, a->magnitude_low, fabs(value));
    a->least = fmin(a->least, value);
    a->largest = fmax(a->largest, value);
}

/* |u_i| / h_i. */
inline REAL length_over(int i, global const REAL *u, global const REAL *h)
{
    REAL square = 0;
    EACH_AXIS (a)
        square += u[DIM * i + a] * u[DIM * i + a];
    return sqrt(square) / h[i];
}

#if GROUP_SIZE == 1
#define REAL8 CLVORO_JOIN(REAL, 8)

/* Define a function that adds items [begin, end), eight at a time, because one sum would wait for each addition.
   EIGHT(i) are the eight from i on and ONE(i) is one; they may use `names`, the function's further arguments. */
#define ADD_RUN(name, EIGHT, ONE, ...)                                                                                 \
    inline void name(summary_t *a, int begin, int end, __VA_ARGS__)                                                    \
    {                                                                                                                  \
        REAL8 sum = 0, sum_low = 0, magnitude = 0, magnitude_low = 0, least = REAL_MAX, largest = -REAL_MAX;           \
        int i = begin;                                                                                                 \
        for (; i + 8 <= end; i += 8) {                                                                                 \
            const REAL8 value = EIGHT(i);                                                                              \
            ADD_COMPENSATED(REAL8, sum, sum_low, value);                                                               \
            ADD_COMPENSATED(REAL8, magnitude, magnitude_low, fabs(value));                                             \
            least = fmin(least, value);                                                                                \
            largest = fmax(largest, value);                                                                            \
        }                                                                                                              \
        REAL s[8], l[8], m[8], n[8], lo[8], hi[8];                                                                     \
        vstore8(sum, 0, s);                                                                                            \
        vstore8(sum_low, 0, l);                                                                                        \
        vstore8(magnitude, 0, m);                                                                                      \
        vstore8(magnitude_low, 0, n);                                                                                  \
        vstore8(least, 0, lo);                                                                                         \
        vstore8(largest, 0, hi);                                                                                       \
        for (int k = 0; k < 8; ++k) {                                                                                  \
            const summary_t lane = {s[k], l[k], m[k], n[k], lo[k], hi[k]};                                             \
            merge_summary(a, lane);                                                                                    \
        }                                                                                                              \
        for (; i < end; ++i)                                                                                           \
            add_value(a, ONE(i));                                                                                      \
    }

#define EIGHT_VALUES(i) vload8(0, values + (i))
#define ONE_VALUE(i) values[i]
ADD_RUN(add_run, EIGHT_VALUES, ONE_VALUE, global const REAL *values)

/* Component a of the vectors i to i + 7. */
#define EIGHT_COMPONENTS(u, i, a)                                                                                      \
    (REAL8)(u[DIM * (i) + (a)], u[DIM * ((i) + 1) + (a)], u[DIM * ((i) + 2) + (a)], u[DIM * ((i) + 3) + (a)],          \
            u[DIM * ((i) + 4) + (a)], u[DIM * ((i) + 5) + (a)], u[DIM * ((i) + 6) + (a)], u[DIM * ((i) + 7) + (a)])

inline REAL8 eight_lengths(int i, global const REAL *u, global const REAL *h)
{
    REAL8 square = 0;
    EACH_AXIS (a) {
        const REAL8 part = EIGHT_COMPONENTS(u, i, a);
        square += part * part;
    }
    return sqrt(square) / vload8(0, h + i);
}

#define EIGHT_LENGTHS(i) eight_lengths(i, u, h)
#define ONE_LENGTH(i) length_over(i, u, h)
ADD_RUN(add_lengths, EIGHT_LENGTHS, ONE_LENGTH, global const REAL *u, global const REAL *h)
#endif

/* Block-wise: partials[groups * slot + group] = summary of the group's items of an array, of the first `count` of eight
   arrays; slots has the slot of each. With `lengths` an array has vectors u_i, and its items are |u_i| / h_i. */
kernel void summarize_blocks(global const REAL *a0, global const REAL *a1, global const REAL *a2, global const REAL *a3,
                             global const REAL *a4, global const REAL *a5, global const REAL *a6, global const REAL *a7,
                             const int count, const int n, const int8 slots, global summary_t *partials,
                             const int lengths, global const REAL *h)
{
    const int slot_of[8] = {slots.s0, slots.s1, slots.s2, slots.s3, slots.s4, slots.s5, slots.s6, slots.s7};
    GROUP_SUMMARIES(shares);
    for (int a = 0; a < count; ++a) {
        global const REAL *values =
            a < 4 ? (a < 2 ? (a < 1 ? a0 : a1) : (a < 3 ? a2 : a3)) : (a < 6 ? (a < 5 ? a4 : a5) : (a < 7 ? a6 : a7));
        global summary_t *out = partials + get_num_groups(0) * slot_of[a] + get_group_id(0);
        summary_t mine = {0, 0, 0, 0, REAL_MAX, -REAL_MAX};
#if GROUP_SIZE == 1
        if (lengths)
            add_lengths(&mine, block_begin(n), block_end(n), values, h);
        else
            add_run(&mine, block_begin(n), block_end(n), values);
#else
        for (BLOCK_LOOP(i, n))
            add_value(&mine, lengths ? length_over(i, values, h) : values[i]);
#endif
        merge_group(&mine, shares);
        if (get_local_id(0) == 0)
            *out = mine;
    }
}

/* One work-group per slot. If bit `slot` of `which` is set, out[4 slot ...] = sum, sum of magnitudes, minimum, maximum.
   The first numbers of two arrays follow the last slot: the host reads all in one transfer. */
kernel void combine_blocks(global const summary_t *partials, const int groups, const int which, const int first_count,
                           global const int *first, const int second_count, global const int *second, global REAL *out,
                           global int *behind)
{
    GROUP_SUMMARIES(shares);
    const int slot = get_group_id(0), t = get_local_id(0), size = get_num_groups(0);
    const int end = which >> slot & 1 ? groups : 0;
    summary_t all = {0, 0, 0, 0, REAL_MAX, -REAL_MAX};
    if (t < end)
        all = partials[groups * slot + t];
    for (int g = t + GROUP_SIZE; g < end; g += GROUP_SIZE)
        merge_summary(&all, partials[groups * slot + g]);
    merge_group(&all, shares);
    if (t == 0 && end > 0) {
        global REAL *put = out + 4 * slot;
        put[0] = all.sum + all.sum_low;
        put[1] = all.magnitude + all.magnitude_low;
        put[2] = all.least;
        put[3] = all.largest;
    }
    global int *notes = behind + 4 * size * (int)(sizeof(REAL) / sizeof(int));
    const int count = slot == 0 ? first_count + second_count : 0;
    for (int k = t; k < count; k += GROUP_SIZE)
        notes[k] = k < first_count ? first[k] : second[k - first_count];
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

/* Row p of `out` is list order[p] of `items`, which begins at starts[order[p]], and begins at to[p]. An item has
   `words` 32-bit words of any type. */
kernel void gather_lists(const int size, global const int *order, global const int *starts, global const int *to,
                         global const uint *items, const int words, global uint *out)
{
    WORK_ITEM(p);
    const int begin = starts[order[p]];
    const ulong count = (ulong)words * (starts[order[p] + 1] - begin);
    items += (ulong)words * begin;
    out += (ulong)words * to[p];
    for (ulong w = 0; w < count; ++w)
        out[w] = items[w];
}

/* The same for items that are integers: names[item] where an item is not negative. */
kernel void gather_renamed_lists(const int size, global const int *order, global const int *starts,
                                 global const int *to, global const int *items, global const int *names,
                                 global int *out)
{
    WORK_ITEM(p);
    const int shift = to[p] - starts[order[p]];
    for (int c = starts[order[p]]; c < starts[order[p] + 1]; ++c)
        out[c + shift] = items[c] < 0 ? items[c] : names[items[c]];
}
