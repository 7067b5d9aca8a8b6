#include "tessellation/clipped/boundary.h"
#include "tessellation/half_planes.h"
#include "opencl/sort.h"

/* The boundary of a polygonal domain is cut into chords by walking along every edge from cell to cell of the convex
   diagram. Each crossing of an edge with a face is computed once, for both cells beside it, so that trimmed cells tile
   the domain. */

#define FLAG_OUTSIDE 2 /* the cell of a generator outside the domain, an auxiliary one, reaches into it */

#define MOST_STEPS 64 /* among generators that are as near as each other, but for rounding */

inline REAL squared_distance(REAL2 y, int i, global const REAL *points)
{
    const REAL2 d = (REAL2)(points[2 * i], points[2 * i + 1]) - y;
    return dot(d, d);
}

/* By how much y is on j's side of the bisector of i and j, times their distance; for i and j the same but for the sign.
   Where they are so near each other that their distances from y differ by less than these round, it is right. */
inline REAL beyond_bisector(REAL2 y, int i, int j, global const REAL *points)
{
    const int o = min(i, j), q = max(i, j);
    const REAL2 x = (REAL2)(points[2 * o], points[2 * o + 1]);
    const REAL2 d = (REAL2)(points[2 * q], points[2 * q + 1]) - x;
    const REAL s = dot(y - x - d / 2, d);
    return i == o ? s : -s;
}

/* Per vertex: the generator in whose cell it lies, the nearest one, from neighbor to neighbor: as long as one is
   nearer; then, among those as near but for rounding, by the bisectors. `inner` are the vertices a few roundings
   further inside, so that what lies on faces counts to the cells within. */
kernel void find_boundary_owners(const int size, global const REAL2 *inner, global const int *starts,
                                 global const int *neighbors, global const REAL *points, global int *owners)
{
    WORK_ITEM(v);
    const REAL2 y = inner[v];
    int cell = owners[v], next = cell;
    REAL least = squared_distance(y, cell, points);
    do {
        cell = next;
        for (int k = starts[cell]; k < starts[cell + 1]; ++k) {
            const int j = neighbors[k];
            const REAL d2 = j >= 0 ? squared_distance(y, j, points) : REAL_MAX;
            if (d2 < least || (d2 == least && j < next)) {
                least = d2;
                next = j;
            }
        }
    } while (next != cell);
    /* Rounding may lead around in a circle. */
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
}

/* Where the line a + t e meets the bisector of two generators; the same for both. */
inline REAL crossing(int i, int j, REAL2 a, REAL2 e, global const REAL *points)
{
    const int o = min(i, j), q = max(i, j);
    const REAL2 x = (REAL2)(points[2 * o], points[2 * o + 1]);
    const REAL2 d = (REAL2)(points[2 * q], points[2 * q + 1]) - x;
    return dot(x - a + d / 2, d) / dot(e, d);
}

/* On which side of the faces between generators at x and x + d does a corner v of the polygon count that lies on their
   line? On that of its own generator at `own`, if v is a point of the cell of x. Elsewhere on the left of edge e.
   Positive: of x + d. */
inline REAL side_of(REAL2 v, REAL2 own, REAL2 x, REAL2 d, REAL2 e)
{
    const REAL2 between = x - own;
    const bool touches = is_on_face(dot(v - own - between / 2, between), dot(between, between));
    const REAL side = touches ? dot(own - v, d) : 0;
    return side != 0 ? side : e.s0 * d.s1 - e.s1 * d.s0;
}

/* How an edge can leave a cell: to which one behind, where on the edge, in which order of those there, and by how much
   rounding may have put the place off; edges on faces are not in doubt. */
typedef struct {
    int behind;
    REAL at, rank, doubt;
} exit_t;

/* Does an edge leave the cell of x by `a` before `b`? Where rounding may have it either way, double words tell; if
   these cannot, the nearer of the two generators behind is the first. */
inline bool leaves_before(exit_t a, exit_t b, REAL2 x, REAL2 start, REAL2 e, global const REAL *points)
{
    if (fabs(a.at - b.at) <= a.doubt + b.doubt) {
        if (a.rank == 0 && b.rank == 0) {
            const REAL from[2] = {x.s0, x.s1};
            const REAL later = leaves_later(half_plane_of(from, a.behind, points, from, from),
                                            half_plane_of(from, b.behind, points, from, from),
                                            wide_sum(start.s0, -x.s0), wide_sum(start.s1, -x.s1), e);
            if (later != 0)
                return later < 0;
        }
        const REAL2 y = start + (a.doubt < b.doubt ? a.at : b.at) * e;
        const REAL nearer = beyond_bisector(y, b.behind, a.behind, points);
        const int i = 2 * a.behind, j = 2 * b.behind;
        const REAL2 d = (REAL2)(points[i] - points[j], points[i + 1] - points[j + 1]);
        if (!is_on_face(nearer, dot(d, d)))
            return nearer > 0;
    }
    return a.at < b.at || (a.at == b.at && a.rank < b.rank);
}

/* The cell behind `cell` on the way along edge a + t e, t = 0 to 1, from cell `origin` to cell `target`; -1 if there is
   none. Of the faces that the edge can leave by, the first; so generators come in the order of e.x, and a walk ends.
   Where rounding has led past the end of the edge, the neighbor that is nearest to the target's generator: that way
   leads to it.

   Rounding must not choose an order of crossings that no edges could have. An end of the edge on a face counts as a
   little inside the cell that it is in, a share of the way to its generator, and faces there are crossed in that order
   (rank), at the end itself. An edge on a face counts to the side of its ends: to the cell on its left, as ends are
   moved inwards. */
inline int step_along(int cell, int origin, int target, REAL2 a, REAL2 e, global const int *starts,
                      global const int *neighbors, global const REAL *points, REAL *t)
{
    const REAL2 x = (REAL2)(points[2 * cell], points[2 * cell + 1]);
    const REAL2 start = (REAL2)(points[2 * origin], points[2 * origin + 1]);
    const REAL2 goal = (REAL2)(points[2 * target], points[2 * target + 1]);
    const REAL e2 = dot(e, e);
    REAL least = squared_distance(goal, cell, points);
    exit_t first = {-1, 0, 0, 0};
    int towards = -1;
    for (int k = starts[cell]; k < starts[cell + 1]; ++k) {
        const int j = neighbors[k];
        if (j < 0)
            continue;
        const REAL2 d = (REAL2)(points[2 * j], points[2 * j + 1]) - x;
        const REAL d2 = squared_distance(goal, j, points);
        if (d2 < least) {
            least = d2;
            towards = j;
        }
        const REAL along = dot(e, d), dd = dot(d, d);
        const bool begins_on = is_on_face(dot(a - x - d / 2, d), dd),
                   ends_on = is_on_face(dot(a + e - x - d / 2, d), dd);
        exit_t way = {j, 0, -REAL_MAX, -REAL_MAX};
        if (begins_on && ends_on) {
            if (side_of(a + e, goal, x, d, e) <= 0)
                continue;
            way.at = side_of(a, start, x, d, e) > 0 ? 0 : 1;
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
        if (!past && (first.behind < 0 || leaves_before(way, first, x, a, e, points)))
            first = way;
    }
    *t = first.behind < 0 ? 1 : fmax(*t, first.at);
    return first.behind < 0 ? towards : first.behind;
}

/* Per edge: walk along it. Without chord_cells only the number of chords is counted. `generators` are those in the
   domain; the cells of others must not be met: those are marked. */
kernel void walk_edges(const int size, const int generators, global const REAL2 *vertices,
                       global const int *next_vertex, global const int *owners, global const int *starts,
                       global const int *neighbors, global const REAL *points, const int write, global int *firsts,
                       global int *chord_cells, global int *chord_edges, global REAL *chord_ends, global int *intruders,
                       global int *flags)
{
    WORK_ITEM(v);
    const int w = next_vertex[v], target = owners[w];
    const REAL2 a = vertices[v], e = vertices[w] - a;
    int cell = owners[v], chord = write ? firsts[v] : 0;
    REAL t = 0;
    /* A walk meets a cell once, whatever rounding does. */
    for (int steps = 0; cell >= 0; ++steps) {
        const bool last = cell == target || steps > size + generators;
        const int next = last ? -1 : step_along(cell, owners[v], target, a, e, starts, neighbors, points, &t);
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

/* Per chord: slots[cell] = the first chord of the cell (INT_MAX before: the boundary does not pass through). */
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

/* Per first chord of a cell: list the cell as number ranks[c] of those that the boundary passes through. */
kernel void list_touched(const int size, global const int *chord_cells, global const int *ranks, global int *touched)
{
    WORK_ITEM(c);
    if (ranks[c + 1] > ranks[c])
        touched[ranks[c]] = chord_cells[c];
}

/* Per touched cell: its number in place of its first chord. */
kernel void number_touched(const int size, global const int *touched, global int *slots, global int *counts)
{
    WORK_ITEM(u);
    slots[touched[u]] = u;
    counts[u] = 0;
}

/* Per chord: count it to its cell. */
kernel void count_chords(const int size, global const int *chord_cells, global const int *slots, global int *ranks,
                         global int *counts)
{
    WORK_ITEM(c);
    ranks[c] = atomic_inc(counts + slots[chord_cells[c]]);
}

/* Per chord: into the list of its cell. The order is put right by sort_chords. */
kernel void place_chords(const int size, global const int *chord_cells, global const int *slots,
                         global const int *ranks, global const int *starts, global int *listed)
{
    WORK_ITEM(c);
    listed[starts[slots[chord_cells[c]]] + ranks[c]] = c;
}

/* Per touched cell: its chords in order. */
kernel void sort_chords(const int size, global const int *starts, global int *listed)
{
    WORK_ITEM(u);
    sort_list(listed + starts[u], starts[u + 1] - starts[u]);
}
