/* Coarse graphs by matching, for multigrid: cells joined by a heavy weight become one. Rows of a graph are
   columns[starts[i] .. starts[i + 1]) with weights > 0; an entry with weight 0 or naming its own row counts for
   nothing, nor does a negative one (a wall).

   Everything is decided by each cell or group for itself from the last kernel's result, so there is one outcome. */
#include "opencl/real.h"
#include "opencl/blocks.h"

#define NONE (-1)

/* The largest weight, one partial value per work-item. Arrays may have room behind the last row: what is there counts
   for nothing. */
kernel void largest(int n, global const int *starts, global const SOURCE *weights, global SOURCE *partial)
{
    const int m = starts[n];
    SOURCE most = 0;
    for (BLOCK_LOOP(k, m))
        most = fmax(most, weights[k]);
    partial[get_global_id(0)] = most;
}

/* Weights times 2^exponent in the multigrid's precision, whose range may be less than the operator's. */
kernel void convert(int m, int exponent, global const SOURCE *weights, global REAL *out)
{
    const int k = get_global_id(0);
    if (k < m)
        out[k] = (REAL)ldexp(weights[k], exponent);
}

/* inverse[i] = 1 / (sum of i's weights), 0 without any. */
kernel void inverse_sums(int n, global const int *starts, global const int *columns, global const REAL *weights,
                         global REAL *inverse)
{
    const int i = get_global_id(0);
    if (i >= n)
        return;
    REAL sum = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k)
        if (columns[k] != i)
            sum += weights[k];
    inverse[i] = sum > 0 ? 1 / sum : 0;
}

/* A weight times 1 + less than a thousandth, by chance but the same from both sides: it breaks the ties of regular
   meshes, where else all cells would look the same way and few would find a partner. */
inline REAL preference(REAL weight, int i, int j)
{
    uint key = (uint)min(i, j) * 0x9E3779B1u ^ (uint)max(i, j) * 0x85EBCA77u;
    key ^= key >> 15;
    key *= 0x2C1B3C6Du;
    key ^= key >> 13;
    return weight * (1 + (key & 0xFFFFu) * R(1.5e-8));
}

/* Cell i without a mate looks at the neighbor it is tied to most, among those without a mate (`mated` 0) or with one
   (1). A tie's strength is w (1/d_i + 1/d_j), d the sums of the cells' weights: the same from both sides, and the same
   everywhere on a mesh whose weights grow steadily. By weight alone all cells of such a mesh would look uphill, and few
   find a mate. */
kernel void propose(int n, int mated, global const int *starts, global const int *columns, global const REAL *weights,
                    global const REAL *inverse_sums, global const int *mate, global int *choice)
{
    const int i = get_global_id(0);
    if (i >= n)
        return;
    int best = NONE;
    if (mate[i] == NONE) {
        REAL most = 0;
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            const int j = columns[k];
            if (j < 0 || j == i || (mate[j] != NONE) != mated)
                continue;
            const REAL p = preference(weights[k] * (inverse_sums[i] + inverse_sums[j]), i, j);
            if (p > most) {
                most = p;
                best = j;
            }
        }
    }
    choice[i] = best;
}

/* Two cells that look at each other are mates. */
kernel void marry(int n, global const int *choice, global int *mate)
{
    const int i = get_global_id(0);
    if (i >= n)
        return;
    const int j = choice[i];
    if (j != NONE && choice[j] == i)
        mate[i] = j;
}

/* The lower one of two mates stands for their group. Who has found no mate joins that of its heaviest neighbor with
   one (its choice now), and stands alone if there is none. is_root[i] = whether i stands for its group. */
inline int root_of(int i, global const int *mate, global const int *choice)
{
    const int to = mate[i] != NONE ? i : choice[i];
    return to == NONE ? i : min(to, mate[to]);
}

kernel void join(int n, global const int *mate, global const int *choice, global int *is_root)
{
    const int i = get_global_id(0);
    if (i < n)
        is_root[i] = root_of(i, mate, choice) == i;
}

/* group[i] = number of i's group, members counted in the order of who stands for them; standing[g] = who stands for
   g. */
kernel void number_groups(int n, global const int *mate, global const int *choice, global const int *numbers,
                          global int *group, global int *standing)
{
    const int i = get_global_id(0);
    if (i >= n)
        return;
    const int r = root_of(i, mate, choice);
    group[i] = numbers[r];
    if (r == i)
        standing[numbers[r]] = i;
}

/* Whether row entry k of i is the first to name its column: a cell may meet another twice around a periodic box. */
inline int is_first(int i, int k, global const int *starts, global const int *columns)
{
    int l = starts[i];
    while (columns[l] != columns[k])
        ++l;
    return l == k;
}

/* Members of a group: the two mates, then those who have joined the one, then the other. With `fill` they are listed at
   members[member_starts[g]], else counted. */
kernel void list_members(int groups, int fill, global const int *starts, global const int *columns,
                         global const int *mate, global const int *choice, global const int *standing,
                         global int *member_starts, global int *members)
{
    const int g = get_global_id(0);
    if (g >= groups)
        return;
    const int pair[2] = {standing[g], mate[standing[g]]};
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
            if (j < 0 || choice[j] != i || !is_first(i, k, starts, columns))
                continue;
            if (fill)
                members[at] = j;
            ++at;
        }
    }
    if (!fill)
        member_starts[g] = at;
}

/* Whether an entry before row entry `last` of the group's member number `until` leads to group h, too. */
inline int is_known(int h, int first, int until, int last, global const int *starts, global const int *columns,
                    global const REAL *weights, global const int *group, global const int *members)
{
    for (int s = first; s <= until; ++s) {
        const int end = s == until ? last : starts[members[s] + 1];
        for (int k = starts[members[s]]; k < end; ++k)
            if (weights[k] > 0 && group[columns[k]] == h)
                return 1;
    }
    return 0;
}

/* lengths[g] = how many other groups the members of group g are tied to. The first of them are remembered; beyond,
   where a cell has very many neighbors, it takes another look at the entries before. */
#define REMEMBERED 32

kernel void count_rows(int groups, global const int *starts, global const int *columns, global const REAL *weights,
                       global const int *group, global const int *member_starts, global const int *members,
                       global int *lengths)
{
    const int g = get_global_id(0);
    if (g >= groups)
        return;
    int known[REMEMBERED], count = 0;
    for (int s = member_starts[g]; s < member_starts[g + 1]; ++s) {
        const int i = members[s];
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            if (weights[k] <= 0)
                continue;
            const int h = group[columns[k]];
            if (h == g)
                continue;
            int at = 0;
            while (at < min(count, REMEMBERED) && known[at] != h)
                ++at;
            if (at < min(count, REMEMBERED))
                continue;
            if (count < REMEMBERED)
                known[count++] = h;
            else if (!is_known(h, member_starts[g], s, k, starts, columns, weights, group, members))
                ++count;
        }
    }
    lengths[g] = count;
}

/* Row of group g: the weights between its members and those of each other group added up, times a factor. */
kernel void merge_rows(int groups, REAL factor, global const int *starts, global const int *columns,
                       global const REAL *weights, global const int *group, global const int *member_starts,
                       global const int *members, global const int *row_starts, global int *row_columns,
                       global REAL *row_weights)
{
    const int g = get_global_id(0);
    if (g >= groups)
        return;
    const int begin = row_starts[g];
    int end = begin;
    for (int s = member_starts[g]; s < member_starts[g + 1]; ++s) {
        const int i = members[s];
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            const REAL w = weights[k];
            if (w <= 0)
                continue;
            const int h = group[columns[k]];
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

/* Of the two sums of a pair of groups, which differ by rounding, the lower group's is taken, so that the graph is
   symmetric to the last bit: the upper groups' are written only, the lower ones' only read. */
kernel void share_weights(int groups, global const int *starts, global const int *columns, global REAL *weights)
{
    const int g = get_global_id(0);
    if (g >= groups)
        return;
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

/* Groups of groups: their members among the first, at most 2 passes deep (counts first, as above). */
kernel void compose_members(int groups, int fill, global const int *outer_starts, global const int *outer,
                            global const int *inner_starts, global const int *inner, global int *member_starts,
                            global int *members)
{
    const int g = get_global_id(0);
    if (g >= groups)
        return;
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

kernel void compose_groups(int n, global const int *inner, global const int *outer, global int *group)
{
    const int i = get_global_id(0);
    if (i < n)
        group[i] = outer[inner[i]];
}

/* Pairwise Jacobi: u = B^-1 r, B the operator's diagonal, with its 2 x 2 blocks for cells that are each other's first
   choice. A tight pair moves as one against the others, which the diagonal alone would take many steps to see. No
   eigenvalue of B^-1 A is above 2, as 2 B - A is a sum of squares.

       u_i = own_i r_i + both_i (r_i + r_partner_i)

   in these terms, all >= 0 (but for a pair without neighbors), because the entries of the block's inverse differ by
   less than rounding when the pair is tight: rounded on their own they can make the inverse indefinite. both is the
   same to the last bit for the two.

   mate may be `partner` itself, of an earlier call: who is its own mate has none. */
kernel void pair_inverse(int n, global const int *starts, global const int *columns, global const REAL *weights,
                         global const int *mate, global int *partner, global REAL *own, global REAL *both)
{
    const int i = get_global_id(0);
    if (i >= n)
        return;
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
    /* The block is [mine + between, -between; -between, theirs + between]. Without neighbors outside it is singular,
       and its pseudo-inverse the answer. */
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
