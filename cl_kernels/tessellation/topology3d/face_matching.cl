#include "tessellation/topology3d/join_vertices.h"
#include "tessellation/clip_tolerance.h"

#ifndef MOST_DOUBLINGS
#error "build with -DMOST_DOUBLINGS=times that a tolerance may double"
#endif

/* Each cell sees its own faces as loops of corners (corners.cl). Where many cells meet, or a face is as narrow as
   vertices round, the two cells of a face see different ones. A cell's own view is closed whatever is done to it by

     - joining vertices, everywhere;
     - putting a vertex into one of its edges, in both faces there;
     - leaving out of a loop what it passes there and back (a spur), and with it faces that are nothing else.

   So views of a face that differ are brought together by these, within a tolerance: corners of either view that are
   near each other are joined, and corners near an edge are put into it, as in snap rounding. Where nothing is near
   enough, the tolerance of the face is doubled, MOST_DOUBLINGS times at most: rounding explains no more, and nothing
   that is done makes the views agree. Else both cells of every face see the same loop in the end, or both see none.

   Planes of generators on a circle all meet in one line, and slits between their cells end anywhere along it: hundreds
   of vertices to be put into each edge. So where that does not come to an end, or not soon, views are brought together
   by sliding, too: a vertex is joined to another that lies on all of its planes.

   twins (v,)                  the same face in the neighbor's row; itself for a wall, -1 where the graph has no face
   turn_starts, turns          of each view: its loop with what was put into it, corners; labels[u] is the vertex of u
   opposites (t,)              the other side of the edge that leaves turn t: the turn in the other face, the same cell
   chains (t,)                 a name of the edge as the cell was clipped, of which that is a part
   reduced, reduced_counts     of each view: its loop as vertices, without repetitions and spurs
   differs (v,)                bits: does it differ from its twin, did it ever, has it a vertex of one that did? 0 to
                               begin with */

#define DIFFERS 1
#define HAS_DIFFERED 2
#define IN_DOUBT 4
/* What has been done to views. */
#define JOINED 1
#define PUT 2
#define WIDENED 4
#define SLID 8

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
    differs[k] = bad ? DIFFERS | HAS_DIFFERED : differs[k] & HAS_DIFFERED;
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

/* The same, from generator i. */
inline places_t places_from(int i, global const REAL *points, global const REAL *corners, global const int *owners,
                            global const int *labels, global const int *chosen, global const int *turns)
{
    const REAL4 x = (REAL4)(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0);
    const places_t places = {points, corners, owners, labels, chosen, turns, x};
    return places;
}

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

/* The unit normals of the planes that corner u lies on. */
inline void normals_at(int u, global const int *corner_faces, const places_t *in, REAL4 *normals)
{
    global const REAL *own = in->points + 3 * in->owners[u];
    for (int k = 0; k < 3; ++k) {
        const int label = corner_faces[3 * u + k];
        if (label < 0) {
            const int axis = (-1 - label) / 2;
            normals[k] = (REAL4)(axis == 0, axis == 1, axis == 2, 0);
        } else {
            global const REAL *other = in->points + 3 * label;
            const REAL4 way = (REAL4)(other[0] - own[0], other[1] - own[1], other[2] - own[2], 0);
            normals[k] = way / sqrt(square_of(way));
        }
    }
}

/* May vertex a slide to vertex b, as that lies on all planes of a within `near`? Ahead only, which is the same way for
   all cells, or the ends of a line became one; but to where roundings may have put a in either direction. `ahead` is
   how far ahead b is. */
inline bool may_slide(REAL4 a, const REAL4 *normals, REAL4 b, REAL near, REAL reach, REAL *ahead)
{
    const REAL4 way = b - a;
    *ahead = way.s0 + R(0.618) * way.s1 + R(0.382) * way.s2;
    bool on = *ahead > near || square_of(way) < reach * reach / 1048576;
    for (int k = 0; k < 3; ++k)
        on &= fabs(normals[k].s0 * way.s0 + normals[k].s1 * way.s1 + normals[k].s2 * way.s2) < near;
    return on;
}

/* The range of turns of a view, or of none. */
inline int2 turns_of(int view, global const int *turn_starts)
{
    return view < 0 ? (int2)(0, 0) : (int2)(turn_starts[view], turn_starts[view + 1]);
}

/* Per view k that differs from its twin, the lesser of both: bring them together by one step. joined[u] is the new
   label, proposals[t] a vertex to be put into the edge that leaves turn t, or -1. */
kernel void snap_views(const int size, const int sliding, global const REAL *points, global const REAL *corners,
                       global const int *owners, global const int *labels, global const int *chosen,
                       global const int *twins, global const int *turn_starts, global const int *turns,
                       global const int *chains, global const int *corner_faces, global const uchar *differs,
                       global uchar *levels, global int *joined, global int *proposals, global int *done)
{
    WORK_ITEM(k);
    const int twin = twins[k];
    if (!(differs[k] & DIFFERS) || (twin >= 0 && twin < k))
        return;
    const int2 ranges[2] = {turns_of(k, turn_starts), turns_of(twin > k ? twin : -1, turn_starts)};
    const int own = ranges[0].s0 < ranges[0].s1 ? ranges[0].s0 : ranges[1].s0;
    const places_t in = places_from(owners[turns[own]], points, corners, owners, labels, chosen, turns);
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
        atomic_or(done, JOINED);
        return;
    }
    for (int r = 0; r < 2 && sliding; ++r)
        for (int t = ranges[r].s0; t < ranges[r].s1; ++t) {
            const int label = labels[turns[t]];
            const REAL4 p = place_of(label, &in);
            REAL4 normals[3];
            normals_at(chosen[label], corner_faces, &in, normals);
            REAL farthest = -INFINITY;
            int end = -1;
            for (int q = 0; q < 2; ++q)
                for (int s = ranges[q].s0; s < ranges[q].s1; ++s) {
                    REAL ahead;
                    if (labels[turns[s]] != label &&
                        may_slide(p, normals, place_of(labels[turns[s]], &in), near, sqrt(far2), &ahead) &&
                        ahead > farthest) {
                        farthest = ahead;
                        end = s;
                    }
                }
            if (end >= 0)
                any |= join(labels, joined, turns[t], turns[end]);
        }
    if (any) {
        atomic_or(done, JOINED | SLID);
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
        atomic_or(done, PUT);
    } else if (levels[k] < MOST_DOUBLINGS) {
        ++levels[k];
        atomic_or(done, WIDENED);
    }
}

/* Per view k that agrees with its twin by now, the lesser of both: is what both see no wider than vertices round, now
   that these are where they should be? */
kernel void find_slits(const int size, global const REAL *points, global const REAL *corners, global const int *owners,
                       global const int *labels, global const int *chosen, global const int *twins,
                       global const int *turn_starts, global const int *turns, global const int *reduced,
                       global const int *reduced_counts, global const uchar *levels, global uchar *differs,
                       global int *any)
{
    WORK_ITEM(k);
    const int n = reduced_counts[k];
    if (n == 0 || twins[k] < k || !(differs[k] & IN_DOUBT))
        return;
    global const int *loop = reduced + turn_starts[k];
    const int i = owners[turns[turn_starts[k]]];
    const places_t in = places_from(i, points, corners, owners, labels, chosen, turns);
    /* Its two ends: what is farthest from any vertex, and what is farthest from that. */
    REAL4 ends[2];
    ends[1] = place_of(loop[0], &in);
    REAL far2 = 0;
    for (int e = 0; e < 2; ++e) {
        REAL most = -1;
        const REAL4 from = ends[1 - e];
        for (int s = 0; s < n; ++s) {
            const REAL4 p = place_of(loop[s], &in);
            far2 = fmax(far2, square_of(p));
            if (square_of(p - from) > most) {
                most = square_of(p - from);
                ends[e] = p;
            }
        }
    }
    const REAL4 way = ends[1] - ends[0];
    const REAL near = ldexp(4 * noise_length(sqrt(far2)), (int)levels[k]), inverse = 1 / square_of(way);
    bool narrow = true;
    for (int s = 0; s < n; ++s) {
        const REAL4 d = place_of(loop[s], &in) - ends[0];
        const REAL along = d.s0 * way.s0 + d.s1 * way.s1 + d.s2 * way.s2;
        narrow &= square_of(d - way * (along * inverse)) < near * near;
    }
    if (narrow) {
        differs[k] |= DIFFERS;
        atomic_or(any, 1);
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
