#include "tessellation/clipped/boundary.h"
#include "tessellation/half_planes.h"
#include "opencl/sort.h"

/* Chords: the parts of the edges of a polygonal domain in the cells of the convex diagram. Each edge is traced from
   cell to cell. A crossing of an edge with a face is computed once, for both cells, so that the clipped cells tile the
   domain. */

#define FLAG_OUTSIDE 2 /* the cell of a ghost generator reaches into the domain */

#define MOST_STEPS 64 /* among generators at the same distance up to round-off */

/* Square of the distance of y from generator i, or of the power distance. */
inline REAL squared_distance(REAL2 y, int i, global const REAL *points)
{
    const REAL2 d = PLACE(points, i) - y;
#ifdef WEIGHTED
    return dot(d, d) - WEIGHT(points, i);
#else
    return dot(d, d);
#endif
}

/* Signed distance of y beyond the bisector of i and j, on the side of j, times the distance of i and j; antisymmetric
   in i and j. Exact also where the distances from y differ by less than their round-off. */
inline REAL beyond_bisector(REAL2 y, int i, int j, global const REAL *points)
{
    const int o = FIRST_OF(i, j, points), q = o == i ? j : i;
    const REAL2 x = PLACE(points, o), d = PLACE(points, q) - x;
    const REAL s = beyond_face(y, x, d, o, q, points);
    return i == o ? s : -s;
}

/* Per vertex of the polygon: the generator of its cell, and a point of that cell (see boundary.h). A walk goes to the
   neighbor nearest to the vertex while one is nearer; among equally near ones, up to round-off, the bisectors decide.
   `inner` are the vertices moved inwards by a few units of round-off, so that vertices on faces belong to cells inside.
 */
kernel void find_boundary_owners(const int size, global const REAL2 *inner, global const int *starts,
                                 global const int *neighbors, global const REAL *points, global const REAL2 *offsets,
                                 global int *owners, global REAL2 *owner_sites)
{
    WORK_ITEM(v);
    const REAL2 y = inner[v];
    int cell = owners[v];
#ifdef WEIGHTED
    /* No walk leads away from an empty cell. */
    if (starts[cell] == starts[cell + 1])
        for (cell = 0; starts[cell] == starts[cell + 1];)
            ++cell;
#endif
    int next = cell;
    REAL least = squared_distance(y, cell, points);
    do {
        cell = next;
        for (int k = starts[cell]; k < starts[cell + 1]; ++k) {
            const int j = neighbors[k];
            const REAL d2 = j >= 0 ? squared_distance(y, j, points) : REAL_MAX;
            if (d2 < least || (d2 == least && j != next && FIRST_OF(j, next, points) == j)) {
                least = d2;
                next = j;
            }
        }
    } while (next != cell);
    /* With round-off the walk may go in a circle. */
    for (int steps = 0; steps < MOST_STEPS; ++steps) {
        REAL most = 0;
        for (int k = starts[cell]; k < starts[cell + 1]; ++k) {
            const int j = neighbors[k];
            const REAL s = j >= 0 ? beyond_bisector(y, cell, j, points) : 0;
            if (s > most) {
                most = s;
                next = j;
            }
        }
        if (next == cell)
            break;
        cell = next;
    }
    owners[v] = cell;
#ifdef WEIGHTED
    owner_sites[v] = PLACE(points, cell) + offsets[cell];
#else
    owner_sites[v] = PLACE(points, cell);
#endif
}

/* Parameter t at which the line a + t e meets the bisector of two generators; symmetric in the two. */
inline REAL crossing(int i, int j, REAL2 a, REAL2 e, global const REAL *points)
{
    const int o = FIRST_OF(i, j, points), q = o == i ? j : i;
    const REAL2 x = PLACE(points, o), d = PLACE(points, q) - x;
    return -beyond_face(a, x, d, o, q, points) / dot(e, d);
}

/* The side of the face between generator `cell` and one at a distance d to which a polygon corner v on that face
   belongs; v lies in the cell of `owner`, as does `inside`. If v is a point of `cell`, too: the side of `inside`.
   Otherwise: the left of edge e. Positive: away from `cell`. */
inline REAL side_of(REAL2 v, int owner, REAL2 inside, int cell, REAL2 d, REAL2 e, global const REAL *points)
{
    const REAL2 own = PLACE(points, owner), between = PLACE(points, cell) - own;
    const bool touches = is_on_face(beyond_face(v, own, between, owner, cell, points), dot(between, between));
    const REAL side = touches ? dot(inside - v, d) : 0;
    return side != 0 ? side : e.s0 * d.s1 - e.s1 * d.s0;
}

/* A possible exit of an edge from a cell: the cell behind, the parameter on the edge, the rank among exits at that
   parameter, and the error bound of the parameter. Edges along faces have no doubt. */
typedef struct {
    int behind;
    REAL at, rank, doubt;
} exit_t;

/* Whether an edge leaves the cell by exit `a` before exit `b`. In doubt double words decide; if they cannot, the
   nearer of the two generators behind comes first. */
inline bool leaves_before(exit_t a, exit_t b, int cell, REAL2 start, REAL2 e, global const REAL *points)
{
    if (fabs(a.at - b.at) <= a.doubt + b.doubt) {
        if (a.rank == 0 && b.rank == 0) {
            SITE(from, cell, points);
            const REAL later = leaves_later(half_plane_of(from, a.behind, points, from, from),
                                            half_plane_of(from, b.behind, points, from, from),
                                            wide_sum(start.s0, -from[0]), wide_sum(start.s1, -from[1]), e);
            if (later != 0)
                return later < 0;
        }
        const REAL2 y = start + (a.doubt < b.doubt ? a.at : b.at) * e;
        const REAL nearer = beyond_bisector(y, b.behind, a.behind, points);
        const REAL2 d = PLACE(points, a.behind) - PLACE(points, b.behind);
        if (!is_on_face(nearer, dot(d, d)))
            return nearer > 0;
    }
    return a.at < b.at || (a.at == b.at && a.rank < b.rank);
}

/* The cell after `cell` on edge a + t e, 0 <= t <= 1, from cell `origin` to cell `target`, with the points `start` and
   `goal` inside; -1 if there is none. It is the first exit of the edge. Generators then come in the order of e.x, so
   the tracing ends. If round-off has led past the end of the edge, it is the neighbor nearest to `goal`.

   Round-off must not produce an order of crossings that is geometrically impossible. An end of the edge on a face is
   treated as slightly inside its cell, towards `start` or `goal`; faces there are crossed in that order (rank). An edge
   along a face belongs to the side of its ends: to the cell on its left, as ends are moved inwards. */
inline int step_along(int cell, int origin, int target, REAL2 start, REAL2 goal, REAL2 a, REAL2 e,
                      global const int *starts, global const int *neighbors, global const REAL *points, REAL *t)
{
    const REAL2 x = PLACE(points, cell);
    const REAL e2 = dot(e, e);
    REAL least = squared_distance(goal, cell, points);
    exit_t first = {-1, 0, 0, 0};
    int towards = -1;
    for (int k = starts[cell]; k < starts[cell + 1]; ++k) {
        const int j = neighbors[k];
        if (j < 0)
            continue;
        const REAL2 d = PLACE(points, j) - x;
        const REAL d2 = squared_distance(goal, j, points);
        if (d2 < least) {
            least = d2;
            towards = j;
        }
        const REAL along = dot(e, d), dd = dot(d, d);
        const bool begins_on = is_on_face(beyond_face(a, x, d, cell, j, points), dd),
                   ends_on = is_on_face(beyond_face(a + e, x, d, cell, j, points), dd);
        exit_t way = {j, 0, -REAL_MAX, -REAL_MAX};
        if (begins_on && ends_on) {
            if (side_of(a + e, target, goal, cell, d, e, points) <= 0)
                continue;
            way.at = side_of(a, origin, start, cell, d, e, points) > 0 ? 0 : 1;
        } else {
            if (along <= 0)
                continue;
            way.at = crossing(cell, j, a, e, points);
            way.rank = 0;
            way.doubt = ON_FACE * sqrt(dd) / along;
            if (begins_on && is_at_corner(way.at, e2)) {
                way.at = 0;
                way.rank = dot(a - start, d) / along;
            } else if (ends_on && is_at_corner(1 - way.at, e2)) {
                way.at = 1;
                way.rank = dot(a + e - goal, d) / along;
            }
        }
        const bool past = !(way.at < 1 || (way.at == 1 && way.rank < 0));
        if (!past && (first.behind < 0 || leaves_before(way, first, cell, a, e, points)))
            first = way;
    }
    *t = first.behind < 0 ? 1 : fmax(*t, first.at);
    return first.behind < 0 ? towards : first.behind;
}

/* Per edge: trace it. The first pass only counts the chords. `generators` is the number of generators in the domain;
   ghost generators whose cells are crossed are marked. */
kernel void walk_edges(const int size, const int generators, global const REAL2 *vertices,
                       global const int *next_vertex, global const int *owners, global const REAL2 *owner_sites,
                       global const int *starts, global const int *neighbors, global const REAL *points,
                       const int write, global int *firsts, global int *chord_cells, global int *chord_edges,
                       global REAL *chord_ends, global int *intruders, global int *flags)
{
    WORK_ITEM(v);
    const int w = next_vertex[v], target = owners[w];
    const REAL2 a = vertices[v], e = vertices[w] - a;
    int cell = owners[v], chord = write ? firsts[v] : 0;
    REAL t = 0;
    /* The tracing enters a cell once at most, whatever the round-off. */
    for (int steps = 0; cell >= 0; ++steps) {
        const bool last = cell == target || steps > size + generators;
        const int next = last ? -1
                              : step_along(cell, owners[v], target, owner_sites[v], owner_sites[w], a, e, starts,
                                           neighbors, points, &t);
        if (cell >= generators) {
            atomic_or(intruders + cell - generators, 1);
            atomic_or(flags, FLAG_OUTSIDE);
        }
        if (cell != target && next < 0)
            atomic_or(flags, FLAG_LOST);
        if (write) {
            chord_cells[chord] = cell;
            chord_edges[chord] = v;
            chord_ends[chord] = next < 0 ? 1 : t;
        }
        ++chord;
        cell = next;
    }
    if (!write)
        firsts[v] = chord;
}

/* Per chord: slots[cell] = the first chord of the cell (INT_MAX: the boundary does not cross the cell). */
kernel void find_firsts(const int size, global const int *chord_cells, global int *slots)
{
    WORK_ITEM(c);
    atomic_min(slots + chord_cells[c], c);
}

/* Per chord: 1 if it is the first of its cell. */
kernel void flag_firsts(const int size, global const int *chord_cells, global const int *slots, global int *ranks)
{
    WORK_ITEM(c);
    ranks[c] = slots[chord_cells[c]] == c;
}

/* Per first chord of a cell: list the cell as crossed cell number ranks[c]. */
kernel void list_touched(const int size, global const int *chord_cells, global const int *ranks, global int *touched)
{
    WORK_ITEM(c);
    if (ranks[c + 1] > ranks[c])
        touched[ranks[c]] = chord_cells[c];
}

/* Per crossed cell: replace its first chord by its number. */
kernel void number_touched(const int size, global const int *touched, global int *slots, global int *counts)
{
    WORK_ITEM(u);
    slots[touched[u]] = u;
    counts[u] = 0;
}

/* Per chord: count it in its cell. */
kernel void count_chords(const int size, global const int *chord_cells, global const int *slots, global int *ranks,
                         global int *counts)
{
    WORK_ITEM(c);
    ranks[c] = atomic_inc(counts + slots[chord_cells[c]]);
}

/* Per chord: append it to the list of its cell; sort_chords sorts the lists. */
kernel void place_chords(const int size, global const int *chord_cells, global const int *slots,
                         global const int *ranks, global const int *starts, global int *listed)
{
    WORK_ITEM(c);
    listed[starts[slots[chord_cells[c]]] + ranks[c]] = c;
}

/* Per crossed cell: sort its chords. */
kernel void sort_chords(const int size, global const int *starts, global int *listed)
{
    WORK_ITEM(u);
    sort_list(listed + starts[u], starts[u + 1] - starts[u]);
}
