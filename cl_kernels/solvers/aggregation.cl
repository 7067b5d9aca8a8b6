/* Coarse graphs for multigrid by pairwise aggregation: cells that a heavy weight connects form one coarse cell.

   Row i of a graph is columns[starts[i] .. starts[i + 1]) with its weights. Entries of weight 0, entries with
   columns[k] == i and negative columns (walls) are ignored. Columns from n on are cells of other parts: they add to
   sums of weights and to coarse graphs, but are in no aggregate.

   One work-item per cell or aggregate, unless a kernel says otherwise. Each work-item reads only results of earlier
   kernels, so the outcome does not depend on their order. */
#include "opencl/real.h"
#include "opencl/blocks.h"

#define NONE (-1)

/* partial[group] = largest weight of the entries of a group. Entries behind the last row are ignored. */
kernel void find_largest_weight(int n, global const int *starts, global const SOURCE *weights, global SOURCE *partial)
{
    const int m = starts[n];
    SOURCE most = 0;
    for (BLOCK_LOOP(k, m))
        most = fmax(most, weights[k]);
    local SOURCE shares[GROUP_SIZE];
    shares[get_local_id(0)] = most;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (get_local_id(0) > 0)
        return;
    for (int item = 1; item < GROUP_SIZE; ++item)
        most = fmax(most, shares[item]);
    partial[get_group_id(0)] = most;
}

/* out[k] = 2^exponent weights[k], in the multigrid's precision, whose range may be smaller than the operator's. One
   work-item per entry. */
kernel void scale_weights(int size, int exponent, global const SOURCE *weights, global REAL *out)
{
    WORK_ITEM(k);
    out[k] = (REAL)ldexp(weights[k], exponent);
}

/* inverse[i] = 1 / sum_j w_ij, or 0 if the sum is 0. */
kernel void invert_row_sums(int size, global const int *starts, global const int *columns, global const REAL *weights,
                            global REAL *inverse)
{
    WORK_ITEM(i);
    REAL sum = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k)
        if (columns[k] != i)
            sum += weights[k];
    inverse[i] = sum > 0 ? 1 / sum : 0;
}

/* weight (1 + r), 0 <= r < 0.001, r a hash of the pair (i, j). It breaks ties on regular meshes, where all cells would
   otherwise choose in the same direction and few pairs would form. */
inline REAL break_tie(REAL weight, int i, int j)
{
    uint key = (uint)min(i, j) * 0x9E3779B1u ^ (uint)max(i, j) * 0x85EBCA77u;
    key ^= key >> 15;
    key *= 0x2C1B3C6Du;
    key ^= key >> 13;
    return weight * (1 + (key & 0xFFFFu) * R(1.5e-8));
}

/* choice[i] = the neighbor j with the largest strength w_ij (1/d_i + 1/d_j), d_i = sum_j w_ij, or NONE.

   Only cells without a mate choose. They choose among neighbors without a mate (`matched` 0) or with one (1). The
   strength is symmetric, and independent of position on a mesh whose weights grow steadily. By weight alone all cells
   of such a mesh would choose in the direction of growth, and few pairs would form. */
kernel void choose_neighbor(int size, int matched, global const int *starts, global const int *columns,
                            global const REAL *weights, global const REAL *inverse_sums, global const int *mate,
                            global int *choice)
{
    WORK_ITEM(i);
    int best = NONE;
    if (mate[i] == NONE) {
        REAL most = 0;
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            const int j = columns[k];
            if (j < 0 || j >= size || j == i || (mate[j] != NONE) != matched)
                continue;
            const REAL p = break_tie(weights[k] * (inverse_sums[i] + inverse_sums[j]), i, j);
            if (p > most) {
                most = p;
                best = j;
            }
        }
    }
    choice[i] = best;
}

/* mate[i] = j and mate[j] = i where the two have chosen each other. */
kernel void match_pairs(int size, global const int *choice, global int *mate)
{
    WORK_ITEM(i);
    const int j = choice[i];
    if (j != NONE && choice[j] == i)
        mate[i] = j;
}

/* Root of the aggregate of cell i: the lower one of two mates. A cell without a mate belongs to the aggregate of its
   choice; without a choice it is its own root. */
inline int root_of(int i, global const int *mate, global const int *choice)
{
    const int to = mate[i] != NONE ? i : choice[i];
    return to == NONE ? i : min(to, mate[to]);
}

/* is_root[i] = 1 for roots, else 0. */
kernel void mark_roots(int size, global const int *mate, global const int *choice, global int *is_root)
{
    WORK_ITEM(i);
    is_root[i] = root_of(i, mate, choice) == i;
}

/* aggregate[i] = number of the aggregate of cell i, in the order of the roots; roots[g] = root of aggregate g. */
kernel void number_aggregates(int size, global const int *mate, global const int *choice, global const int *numbers,
                              global int *aggregate, global int *roots)
{
    WORK_ITEM(i);
    const int r = root_of(i, mate, choice);
    aggregate[i] = numbers[r];
    if (r == i)
        roots[numbers[r]] = i;
}

/* Whether entry k is the first of row i with its column. In a periodic box two cells may share several faces. */
inline int is_first_entry(int i, int k, global const int *starts, global const int *columns)
{
    int l = starts[i];
    while (columns[l] != columns[k])
        ++l;
    return l == k;
}

/* Members of aggregate g: the two mates, then the cells that have chosen the first mate, then those that have chosen
   the second. With `fill` they are written from members[member_starts[g]] on; without it member_starts[g] becomes
   their number. `choice` of cells of other parts is NONE. */
kernel void list_members(int size, int fill, global const int *starts, global const int *columns,
                         global const int *mate, global const int *choice, global const int *roots,
                         global int *member_starts, global int *members)
{
    WORK_ITEM(g);
    const int pair[2] = {roots[g], mate[roots[g]]};
    int at = fill ? member_starts[g] : 0;
    for (int s = 0; s < 2; ++s) {
        if (pair[s] == NONE)
            continue;
        if (fill)
            members[at] = pair[s];
        ++at;
    }
    for (int s = 0; s < 2; ++s) {
        const int i = pair[s];
        if (i == NONE)
            continue;
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            const int j = columns[k];
            if (j < 0 || choice[j] != i || !is_first_entry(i, k, starts, columns))
                continue;
            if (fill)
                members[at] = j;
            ++at;
        }
    }
    if (!fill)
        member_starts[g] = at;
}

/* Whether an entry of the aggregate before entry `last` of its member `until` connects it to aggregate h, too. */
inline int is_counted(int h, int first, int until, int last, global const int *starts, global const int *columns,
                      global const REAL *weights, global const int *aggregate, global const int *members)
{
    for (int s = first; s <= until; ++s) {
        const int end = s == until ? last : starts[members[s] + 1];
        for (int k = starts[members[s]]; k < end; ++k)
            if (weights[k] > 0 && aggregate[columns[k]] == h)
                return 1;
    }
    return 0;
}

/* counts[g] = number of aggregates that aggregate g is connected to. The first ones are kept in private memory; with
   more of them, earlier entries are searched again. */
#define REMEMBERED 32

kernel void count_coarse_entries(int size, global const int *starts, global const int *columns,
                                 global const REAL *weights, global const int *aggregate,
                                 global const int *member_starts, global const int *members, global int *counts)
{
    WORK_ITEM(g);
    int known[REMEMBERED], count = 0;
    for (int s = member_starts[g]; s < member_starts[g + 1]; ++s) {
        const int i = members[s];
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            if (weights[k] <= 0)
                continue;
            const int h = aggregate[columns[k]];
            if (h == g)
                continue;
            int at = 0;
            while (at < min(count, REMEMBERED) && known[at] != h)
                ++at;
            if (at < min(count, REMEMBERED))
                continue;
            if (count < REMEMBERED)
                known[count++] = h;
            else if (!is_counted(h, member_starts[g], s, k, starts, columns, weights, aggregate, members))
                ++count;
        }
    }
    counts[g] = count;
}

/* Coarse weights w_gh = factor sum_{i in g, j in h} w_ij: the row of aggregate g. */
kernel void sum_coarse_weights(int size, REAL factor, global const int *starts, global const int *columns,
                               global const REAL *weights, global const int *aggregate, global const int *member_starts,
                               global const int *members, global const int *row_starts, global int *row_columns,
                               global REAL *row_weights)
{
    WORK_ITEM(g);
    const int begin = row_starts[g];
    int end = begin;
    for (int s = member_starts[g]; s < member_starts[g + 1]; ++s) {
        const int i = members[s];
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            const REAL w = weights[k];
            if (w <= 0)
                continue;
            const int h = aggregate[columns[k]];
            if (h == g)
                continue;
            int at = begin;
            while (at < end && row_columns[at] != h)
                ++at;
            if (at == end) {
                row_columns[at] = h;
                row_weights[at] = w;
                ++end;
            } else
                row_weights[at] += w;
        }
    }
    for (int at = begin; at < end; ++at)
        row_weights[at] *= factor;
}

/* w_gh = w_hg for h < g. The two sums differ by round-off; the row of the lower aggregate is kept, so that the graph is
   symmetric to the last bit. Entries with h < g are only written, the others only read. */
kernel void symmetrize_weights(int size, global const int *starts, global const int *columns, global REAL *weights)
{
    WORK_ITEM(g);
    for (int k = starts[g]; k < starts[g + 1]; ++k) {
        const int h = columns[k];
        if (h > g)
            continue;
        int l = starts[h];
        while (columns[l] != g)
            ++l;
        weights[k] = weights[l];
    }
}

/* Members of aggregates of aggregates, as cells of the fine graph. `fill` as in `list_members`. */
kernel void compose_members(int size, int fill, global const int *outer_starts, global const int *outer,
                            global const int *inner_starts, global const int *inner, global int *member_starts,
                            global int *members)
{
    WORK_ITEM(g);
    int at = fill ? member_starts[g] : 0;
    for (int s = outer_starts[g]; s < outer_starts[g + 1]; ++s)
        for (int k = inner_starts[outer[s]]; k < inner_starts[outer[s] + 1]; ++k) {
            if (fill)
                members[at] = inner[k];
            ++at;
        }
    if (!fill)
        member_starts[g] = at;
}

/* aggregate[i] = outer[inner[i]]: the aggregate after two passes. */
kernel void compose_aggregates(int size, global const int *inner, global const int *outer, global int *aggregate)
{
    WORK_ITEM(i);
    aggregate[i] = outer[inner[i]];
}

/* Pairwise Jacobi smoother u = B^-1 r. B is the diagonal of A, with 2 x 2 blocks for matched pairs:

       u_i = own_i r_i + both_i (r_i + r_partner_i)

   A strongly connected pair then changes as one, which takes the diagonal alone many steps. All eigenvalues of B^-1 A
   are at most 2, because 2 B - A is a sum of squares.

   own and both are >= 0, except for a pair without other neighbors. The entries of the inverse block itself are not
   stored: for a strongly connected pair they differ by less than round-off, and rounding them separately can make the
   inverse indefinite. both is the same to the last bit for the two cells of a pair.

   mate may be the array `partner` of an earlier call: a cell that is its own mate has none. */
kernel void invert_pair_blocks(int size, global const int *starts, global const int *columns,
                               global const REAL *weights, global const int *mate, global int *partner,
                               global REAL *own, global REAL *both)
{
    WORK_ITEM(i);
    const int j = mate[i] == i ? NONE : mate[i];
    REAL mine = 0, theirs = 0, between = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        if (columns[k] == i)
            continue;
        if (columns[k] == j)
            between += weights[k];
        else
            mine += weights[k];
    }
    if (j != NONE)
        for (int k = starts[j]; k < starts[j + 1]; ++k)
            if (columns[k] != j && columns[k] != i)
                theirs += weights[k];
    /* The block is [mine + between, -between; -between, theirs + between]. For a pair without other neighbors it is
       singular, and its pseudo-inverse is used. */
    REAL a = 0, c = 0;
    if (j == NONE || between <= 0)
        a = mine > 0 ? 1 / mine : 0;
    else if (mine + theirs <= 0) {
        a = R(0.5) / between;
        c = -R(0.5) * a;
    } else {
        c = 1 / (mine + theirs + (fmin(mine, theirs) / between) * fmax(mine, theirs));
        a = c * (theirs / between);
    }
    partner[i] = j == NONE ? i : j;
    own[i] = a;
    both[i] = c;
}
