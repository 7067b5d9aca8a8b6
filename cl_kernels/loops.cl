#include "common/join.h"
#include "common/noise.h"

#ifndef MOST_DOUBLINGS
#error "build with -DMOST_DOUBLINGS=times that a tolerance may double"
#endif

/* Loops of faces in 3D, from each cell's view of its own faces (corners.cl). Where many cells meet, or a face is as
   narrow as vertices round, cells see different corners. A cell's own view is closed whatever is done to it by

     - joining vertices, everywhere;
     - putting a vertex into one of its edges, in both faces there;
     - leaving out of a loop what it passes there and back (a spur), and with it faces that are nothing else.

   So views of a face that differ are brought together by these, within a tolerance: corners of either view that are
   near each other are joined, and corners near an edge are put into it, as in snap rounding. Where nothing is near
   enough, the tolerance of the face is doubled, MOST_DOUBLINGS times at most: rounding explains no more, and nothing
   that is done makes the views agree. Else both cells of every face see the same loop in the end, or both see none.

   twins (v,)                  the same face in the neighbour's row; itself for a wall, -1 where the graph has no face
   turn_starts, turns          of each view: its loop with what was put into it, corners; labels[u] is the vertex of u
   opposites (t,)              the other side of the edge that leaves turn t: the turn in the other face, the same cell
   chains (t,)                 a name of the edge as the cell was clipped, of which that is a part
   reduced, reduced_counts     of each view: its loop as vertices, without repetitions and spurs */

inline int turn_after(int t, int begin, int end)
{
    return t + 1 == end ? begin : t + 1;
}

/* Per generator i: the twins of its views. */
kernel void find_twins(const int size, global const int *starts, global const int *view_starts,
                       global const int *view_labels, global int *twins)
{
    WORK_ITEM(i);
    const int begin = view_starts[i], end = view_starts[i + 1], listed = starts[i + 1] - starts[i];
    for (int k = begin; k < end; ++k) {
        const int j = view_labels[k];
        int twin = k - begin < listed ? k : -1;
        if (j >= 0)
            for (twin = view_starts[j]; view_labels[twin] != i;)
                ++twin;
        twins[k] = twin;
    }
}

/* Per view k: its loop, reduced. */
kernel void reduce_views(const int size, global const int *turn_starts, global const int *turns,
                         global const int *labels, global int *reduced, global int *reduced_counts)
{
    WORK_ITEM(k);
    const int begin = turn_starts[k], end = turn_starts[k + 1];
    global int *loop = reduced + begin;
    int n = 0;
    for (int t = begin; t < end; ++t) {
        const int label = labels[turns[t]];
        if (n >= 1 && loop[n - 1] == label)
            continue;
        if (n >= 2 && loop[n - 2] == label)
            --n;
        else
            loop[n++] = label;
    }
    /* The same where the end meets the beginning. */
    int first = 0;
    while (n - first >= 2) {
        if (loop[n - 1] == loop[first]) {
            --n;
        } else if (loop[n - 1] == loop[first + 1]) {
            ++first;
            --n;
        } else if (loop[n - 2] == loop[first]) {
            n -= 2;
        } else {
            break;
        }
    }
    n = n - first >= 3 ? n - first : 0;
    if (first > 0)
        for (int s = 0; s < n; ++s)
            loop[s] = loop[first + s];
    reduced_counts[k] = n;
}

/* Per view k: does it differ from its twin, or pass a vertex twice? Views without a face in the graph should be
   nothing. */
kernel void compare_views(const int size, global const int *twins, global const int *turn_starts,
                          global const int *reduced, global const int *reduced_counts, global uchar *differs,
                          global int *any)
{
    WORK_ITEM(k);
    const int twin = twins[k], n = reduced_counts[k];
    global const int *loop = reduced + turn_starts[k];
    bool bad = twin < 0 && n > 0;
    if (twin >= 0) {
        bad = reduced_counts[twin] != n;
        for (int s = 1; s < n && !bad; ++s)
            for (int t = 0; t < s; ++t)
                bad |= loop[s] == loop[t];
        if (!bad && twin != k && n > 0) {
            global const int *other = reduced + turn_starts[twin];
            int at = 0;
            while (at < n && other[at] != loop[0])
                ++at;
            bad = at == n;
            for (int s = 0; s < n && !bad; ++s) {
                bad = other[at] != loop[s];
                at = at == 0 ? n - 1 : at - 1;
            }
        }
    }
    differs[k] = bad;
    if (bad)
        atomic_or(any, 1);
}

/* Per view k: the other sides of its edges, of what has just been clipped. */
kernel void find_opposites(const int size, global const int *owners, global const int *corner_faces,
                           global const int *view_starts, global const int *view_labels, global const int *turn_starts,
                           global const int *turns, global int *opposites, global int *chains)
{
    WORK_ITEM(k);
    const int begin = turn_starts[k], end = turn_starts[k + 1], label = view_labels[k];
    for (int t = begin; t < end; ++t) {
        const int u = turns[t], next = turns[turn_after(t, begin, end)];
        global const int *faces = corner_faces + 3 * u;
        const int beyond = faces[0] == label ? faces[2] : (faces[1] == label ? faces[0] : faces[1]);
        int view = view_starts[owners[u]];
        while (view_labels[view] != beyond)
            ++view;
        int other = turn_starts[view];
        while (turns[other] != next)
            ++other;
        opposites[t] = other;
        chains[t] = min(t, other);
    }
}

/* What there is to know of vertices: where they lie, relative to x. */
typedef struct {
    global const REAL *points, *corners;
    global const int *owners, *labels, *chosen, *turns;
    REAL4 x;
} places_t;

inline REAL4 place_of(int label, const places_t *in)
{
    const int u = in->chosen[label], i = in->owners[u];
    return (REAL4)(in->points[3 * i] - in->x.s0 + in->corners[3 * u],
                   in->points[3 * i + 1] - in->x.s1 + in->corners[3 * u + 1],
                   in->points[3 * i + 2] - in->x.s2 + in->corners[3 * u + 2], 0);
}

inline REAL square_of(REAL4 a)
{
    return a.s0 * a.s0 + a.s1 * a.s1 + a.s2 * a.s2;
}

/* Is the vertex on the chain that turn t of the loop [begin, end) is part of? */
inline bool is_on_chain(int label, int t, int begin, int end, global const int *chains, const places_t *in)
{
    const int chain = chains[t];
    int from = t, steps = end - begin;
    for (int s = t; chains[s] == chain && steps > 0; --steps) {
        from = s;
        s = s == begin ? end - 1 : s - 1;
    }
    steps = end - begin;
    for (int s = from; steps >= 0; --steps) {
        if (in->labels[in->turns[s]] == label)
            return true;
        if (chains[s] != chain)
            break;
        s = turn_after(s, begin, end);
    }
    return false;
}

/* The range of turns of a view, or of none. */
inline int2 turns_of(int view, global const int *turn_starts)
{
    return view < 0 ? (int2)(0, 0) : (int2)(turn_starts[view], turn_starts[view + 1]);
}

/* Per view k that differs from its twin, the lesser of both: bring them together by one step. joined[u] is the new
   label, proposals[t] a vertex to be put into the edge that leaves turn t, or -1. */
kernel void snap_views(const int size, global const REAL *points, global const REAL *corners, global const int *owners,
                       global const int *labels, global const int *chosen, global const int *twins,
                       global const int *turn_starts, global const int *turns, global const int *chains,
                       global const uchar *differs, global uchar *levels, global int *joined, global int *proposals,
                       global int *done)
{
    WORK_ITEM(k);
    const int twin = twins[k];
    if (!differs[k] || (twin >= 0 && twin < k))
        return;
    const int2 ranges[2] = {turns_of(k, turn_starts), turns_of(twin > k ? twin : -1, turn_starts)};
    const int own = ranges[0].s0 < ranges[0].s1 ? ranges[0].s0 : ranges[1].s0;
    const int i = owners[turns[own]];
    const places_t in = {points,
                         corners,
                         owners,
                         labels,
                         chosen,
                         turns,
                         (REAL4)(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0)};
    REAL far2 = 0;
    for (int r = 0; r < 2; ++r)
        for (int t = ranges[r].s0; t < ranges[r].s1; ++t) {
            global const REAL *c = corners + 3 * turns[t];
            far2 = fmax(far2, c[0] * c[0] + c[1] * c[1] + c[2] * c[2]);
        }
    const REAL near = ldexp(4 * noise_length(sqrt(far2)), (int)levels[k]), near2 = near * near;
    bool any = false;
    for (int r = 0; r < 2; ++r)
        for (int t = ranges[r].s0; t < ranges[r].s1; ++t) {
            const REAL4 p = place_of(labels[turns[t]], &in);
            for (int q = 0; q <= r; ++q)
                for (int s = ranges[q].s0; s < (q == r ? t : ranges[q].s1); ++s)
                    if (labels[turns[s]] != labels[turns[t]] && square_of(place_of(labels[turns[s]], &in) - p) < near2)
                        any |= join(labels, joined, turns[s], turns[t]);
        }
    if (any) {
        atomic_or(done, 1);
        return;
    }
    for (int r = 0; r < 2; ++r)
        for (int t = ranges[r].s0; t < ranges[r].s1; ++t) {
            const int a = labels[turns[t]], b = labels[turns[turn_after(t, ranges[r].s0, ranges[r].s1)]];
            if (a == b)
                continue;
            const REAL4 p = place_of(a, &in), e = place_of(b, &in) - p;
            REAL first = square_of(e);
            const REAL inverse = 1 / first;
            int best = -1;
            for (int q = 0; q < 2; ++q)
                for (int s = ranges[q].s0; s < ranges[q].s1; ++s) {
                    const int label = labels[turns[s]];
                    const REAL4 d = place_of(label, &in) - p;
                    const REAL along = d.s0 * e.s0 + d.s1 * e.s1 + d.s2 * e.s2;
                    if (along > 0 && along < first && square_of(d - e * (along * inverse)) < near2 &&
                        !is_on_chain(label, t, ranges[r].s0, ranges[r].s1, chains, &in)) {
                        first = along;
                        best = label;
                    }
                }
            if (best >= 0) {
                proposals[t] = best;
                any = true;
            }
        }
    if (any) {
        atomic_or(done, 2);
    } else if (levels[k] < MOST_DOUBLINGS) {
        ++levels[k];
        atomic_or(done, 4);
    }
}

/* What is put into the edge that leaves turn t, or -1: what one of its faces has proposed. */
inline int accepted(int t, global const int *proposals, global const int *opposites)
{
    const int other = opposites[t], one = proposals[min(t, other)];
    return one >= 0 ? one : proposals[max(t, other)];
}

/* Per view k: how many turns it has with what is put into it. */
kernel void measure_views(const int size, global const int *turn_starts, global const int *opposites,
                          global const int *proposals, global int *counts)
{
    WORK_ITEM(k);
    int count = 0;
    for (int t = turn_starts[k]; t < turn_starts[k + 1]; ++t)
        count += 1 + (accepted(t, proposals, opposites) >= 0);
    counts[k] = count;
}

/* Per view k: where its turns go. */
kernel void place_turns(const int size, global const int *turn_starts, global const int *opposites,
                        global const int *proposals, global const int *new_starts, global int *places)
{
    WORK_ITEM(k);
    int to = new_starts[k];
    for (int t = turn_starts[k]; t < turn_starts[k + 1]; ++t) {
        places[t] = to;
        to += 1 + (accepted(t, proposals, opposites) >= 0);
    }
}

kernel void write_views(const int size, global const int *turn_starts, global const int *turns,
                        global const int *opposites, global const int *chains, global const int *proposals,
                        global const int *places, global int *new_turns, global int *new_opposites,
                        global int *new_chains)
{
    WORK_ITEM(k);
    for (int t = turn_starts[k]; t < turn_starts[k + 1]; ++t) {
        const int to = places[t], other = places[opposites[t]], put = accepted(t, proposals, opposites);
        new_turns[to] = turns[t];
        new_chains[to] = chains[t];
        new_opposites[to] = put >= 0 ? other + 1 : other;
        if (put >= 0) {
            new_turns[to + 1] = put;
            new_chains[to + 1] = chains[t];
            new_opposites[to + 1] = other;
        }
    }
}

/* Per corner u: the greatest sharpness at its vertex, in best[label], which begins as 0. Bits of floats >= 0 are in
   their order. */
kernel void rate_corners(const int size, global const int *labels, global const float *sharpness, global uint *best)
{
    WORK_ITEM(u);
    atomic_max(best + labels[u], as_uint(sharpness[u]));
}

/* Per corner u: the first of the sharpest, in chosen[label], which begins as INT_MAX. */
kernel void choose_corners(const int size, global const int *labels, global const float *sharpness,
                           global const uint *best, global int *chosen)
{
    WORK_ITEM(u);
    if (as_uint(sharpness[u]) == best[labels[u]])
        atomic_min(chosen + labels[u], u);
}

/* Per generator i: the lengths of the loops of its faces k, 0 for those that are nothing; marks the labels in use. */
kernel void measure_loops(const int size, global const int *starts, global const int *view_starts,
                          global const int *turn_starts, global const int *reduced, global const int *reduced_counts,
                          global int *loop_counts, global int *used)
{
    WORK_ITEM(i);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int view = view_starts[i] + k - starts[i];
        loop_counts[k] = reduced_counts[view];
        for (int s = 0; s < reduced_counts[view]; ++s)
            atomic_or(used + reduced[turn_starts[view] + s], 1);
    }
}

/* Per generator i: the loops, in the numbers of vertices; ids are the prefix sums of `used`. */
kernel void write_loops(const int size, global const int *starts, global const int *view_starts,
                        global const int *turn_starts, global const int *reduced, global const int *ids,
                        global const int *loop_starts, global int *loops)
{
    WORK_ITEM(i);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int view = view_starts[i] + k - starts[i], begin = loop_starts[k], n = loop_starts[k + 1] - begin;
        for (int s = 0; s < n; ++s)
            loops[begin + s] = ids[reduced[turn_starts[view] + s]];
    }
}

/* Per corner u: the position of its vertex (v, 3), if it is the one that gives it. */
kernel void place_vertices(const int size, global const REAL *points, const REAL4 box_lower, const REAL4 box_upper,
                           global const int *owners, global const REAL *corners, global const int *labels,
                           global const int *chosen, global const int *ids, global REAL *vertices)
{
    WORK_ITEM(u);
    const REAL lower[3] = {box_lower.s0, box_lower.s1, box_lower.s2};
    const REAL upper[3] = {box_upper.s0, box_upper.s1, box_upper.s2};
    const int label = labels[u], id = ids[label];
    if (chosen[label] == u && id != ids[label + 1])
        for (int a = 0; a < 3; ++a)
            vertices[3 * id + a] = clamp(points[3 * owners[u] + a] + corners[3 * u + a], lower[a], upper[a]);
}
