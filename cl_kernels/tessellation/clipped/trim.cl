#include "tessellation/moments.h"
#include "tessellation/roundness.h"
#include "tessellation/clipped/segments.h"
#include "tessellation/clipped/wall_sides.h"
#include "tessellation/clipped/trimmed.h"

/* The diagram of a polygonal domain from the convex diagram of its generators. A cell that the boundary crosses is
   clipped to the domain. The result consists of pieces, each an outer loop and the islands in it. The piece with the
   generator is the cell. Another piece, cut off by a spit or a slit, goes to the neighboring cell with which it shares
   the longest face, and stays only if there is none. A cell of a power diagram, which need not contain its generator,
   has all its pieces, or none. */

#define FLAG_ORPHANS 4          /* a cell consists of several pieces */
#define OUTSIDE (UNTOUCHED - 1) /* instead of the number of a crossed cell: the cell is outside of the domain */

/* Distance by which a corner may lie outside of the domain; `check` allows the same. */
#define MOST_OUTSIDE (256 * REAL_EPS)

/* Whether a segment on a face, between a corner of the cell and the end of a chord, leaves the domain across the edge
   of that chord. Edges miss corners narrower than round-off. */
inline bool leads_out(const segment_t *s, const chords_t *c)
{
    if ((s->from < 0) == (s->to < 0))
        return false;
    const int edge = c->edges[max(s->from, s->to)];
    const REAL2 e = c->vertices[c->next_vertex[edge]] - c->vertices[edge];
    const REAL2 inwards = s->from < 0 ? s->p - s->q : s->q - s->p;
    return difference_of_products(e.s0, inwards.s1, e.s1, inwards.s0) < -MOST_OUTSIDE * sqrt(dot(e, e));
}

/* Per crossed cell u: its loops, at the indices first = list_starts[u] + u and following.

   loop_chords   first chord of each loop; -1: the loop around the whole cell
   loop_pieces   index of the outer loop of the loop's piece, which may be the loop itself; -1: no loop
   loop_roots    for outer loops: the generator that gets the piece, -1 if unknown
   counts        number of segments of all loops of the cell */
kernel void find_loops(const int size, CONVEX_ARGS, CHORD_ARGS, global int *chord_loops, global int *loop_chords,
                       global int *loop_pieces, global int *loop_roots, global int *counts, global int *flags)
{
    WORK_ITEM(u);
    const chords_t c = CHORDS;
    const convex_t cell = convex_cell(u, CONVEX);
    const int first = list_starts[u] + u;
    int loops = 0, outer = 0, main = -1, total = 0;
    bool crossed = false, rim = false, main_winds = false, astray = false;
    REAL nearest = REAL_MAX;
    for (int k = 0; k < cell.chord_count; ++k)
        chord_loops[cell.chords[k]] = -1;
    /* First the loops with chords that enter across a face: they begin with such a chord. */
    for (int turn = 0; turn < 2 * cell.chord_count; ++turn) {
        const int begin = cell.chords[turn % cell.chord_count];
        if (chord_loops[begin] >= 0 || (turn < cell.chord_count && begins_inside(&c, begin)))
            continue;
        cursor_t cursor = loop_begin(begin);
        REAL near = REAL_MAX;
        int around = 0, count = 0;
        bool open = false, lost = false;
        /* A loop with more segments than the cell has is an error. */
        const int most = 2 * (cell.chord_count + 1) * (cell.n + 2);
        do {
            const bool on_chord = cursor.chord >= 0;
            if (on_chord)
                chord_loops[cursor.chord] = loops;
            const segment_t s = next_segment(&cursor, &cell, &c);
            around += winding(s, 0);
            near = fmin(near, squared_distance_to(s, 0));
            open |= !on_chord;
            astray |= !on_chord && leads_out(&s, &c);
            lost |= !on_chord && s.label < 0; /* a wall of the clip box, far outside */
        } while (!is_complete(&cursor, begin) && ++count < most);
        if (lost || count == most) {
            /* The next loops would fail, too. */
            atomic_or(flags, FLAG_LOST);
            for (int place = first; place < list_starts[u + 1] + u + 1; ++place)
                loop_pieces[place] = -1;
            counts[u] = 0;
            return;
        }
        const int shell = c.shells[c.edges[begin]];
        const bool is_outer = open || shell < 0;
        /* A hole inside the cell whose piece extends beyond it: the faces of the cell lie in the domain if no chord
           leaves it. */
        rim |= !is_outer && c.cells[c.firsts[shell]] != cell.i;
        const int place = first + loops;
        loop_chords[place] = begin;
        loop_pieces[place] = is_outer ? place : -1;
        loop_roots[place] = -1;
        crossed |= open;
        total += count + 1;
        /* The piece of the generator winds around it, the closest if several do, or has it on its boundary. */
        const bool winds = around > 0 || near <= ON_BOUNDARY * ON_BOUNDARY;
        if (is_outer && (main < 0 || winds > main_winds || (winds == main_winds && near < nearest))) {
            main = place;
            main_winds = winds;
            nearest = near;
        }
        outer += is_outer;
        ++loops;
    }
    if (astray)
        atomic_or(flags, FLAG_LOST);
    if (!crossed && rim) {
        const int place = first + loops++;
        loop_chords[place] = -1;
        loop_pieces[place] = place;
        loop_roots[place] = -1;
        ++outer;
        total += cell.n;
        /* But not if the generator is on an island in a hole. */
        if (!main_winds)
            main = place;
    }
    if (main < 0) {
        atomic_or(flags, FLAG_LOST);
        main = first;
    }
    for (int place = first; place < first + loops; ++place)
        if (loop_pieces[place] < 0) {
            /* A hole lies in the outer ring of its piece. If that ring leaves the cell, one of the pieces along it
               contains the hole. */
            const int shell = c.firsts[c.shells[c.edges[loop_chords[place]]]];
            const int ring = c.cells[shell] == cell.i ? first + chord_loops[shell] : -1;
            loop_pieces[place] = main;
            if (ring >= 0 && !is_open(&cell, &c, loop_chords[ring])) {
                loop_pieces[place] = ring;
                continue;
            }
            for (int other = first; outer > 1 && other < first + loops; ++other)
                if (loop_pieces[other] == other && is_open(&cell, &c, loop_chords[other]) &&
                    lies_within(&cell, &c, loop_chords[other], loop_chords[place]))
                    loop_pieces[place] = other;
        }
    loop_roots[main] = cell.i;
    for (int place = first + loops; place < list_starts[u + 1] + u + 1; ++place)
        loop_pieces[place] = -1;
    counts[u] = total;
#ifdef WEIGHTED
    for (int place = first; place < first + loops; ++place)
        loop_roots[place] = cell.i;
#else
    if (outer > 1)
        atomic_or(flags, FLAG_ORPHANS);
#endif
}

#ifdef WEIGHTED
/* Per generator of the domain: mark its cell, and empty it, if it lies outside. The boundary does not cross such a
   cell, and the generator is not in it: then a ray from the centroid to the right tells. */
kernel void find_outside(const int size, global const int *starts, global const int *neighbors,
                         global const REAL *points, global const REAL2 *vertices, global const int *next_vertex,
                         const int edges, global int *slots, global REAL *volumes, global REAL2 *offsets)
{
    WORK_ITEM(i);
    if (slots[i] != UNTOUCHED || starts[i] == starts[i + 1])
        return;
    const REAL2 x = PLACE(points, i), y = x + offsets[i];
    bool inside = true;
    for (int k = starts[i]; k < starts[i + 1] && inside; ++k) {
        const int j = neighbors[k];
        inside = j < 0 || beyond_face(x, x, PLACE(points, j) - x, i, j, points) < 0;
    }
    if (inside)
        return;
    for (int e = 0; e < edges; ++e) {
        const REAL2 a = vertices[e] - y, b = vertices[next_vertex[e]] - y;
        const REAL side = difference_of_products(a.s0, b.s1, a.s1, b.s0);
        inside ^= (a.s1 <= 0) != (b.s1 <= 0) && (side > 0) == (b.s1 > 0);
    }
    if (!inside) {
        slots[i] = OUTSIDE;
        volumes[i] = 0;
        offsets[i] = 0;
    }
}
#endif

/* Per crossed cell u: its segments, from segment_starts[u] on; `places` holds the piece of each. */
kernel void write_segments(const int size, CONVEX_ARGS, CHORD_ARGS, global const int *loop_chords,
                           global const int *loop_pieces, global const int *segment_starts, global int *labels,
                           global int *from, global int *to, global int *places, global REAL2 *p, global REAL2 *q)
{
    WORK_ITEM(u);
    const chords_t c = CHORDS;
    const convex_t cell = convex_cell(u, CONVEX);
    const int first = list_starts[u] + u, end = list_starts[u + 1] + u + 1;
    int at = segment_starts[u];
    for (int piece = first; piece < end; ++piece) {
        if (loop_pieces[piece] != piece)
            continue;
        /* The outer loop, then the islands. */
        for (int turn = 0; turn < 2; ++turn)
            for (int place = turn ? first : piece; place < (turn ? end : piece + 1); ++place) {
                if (loop_pieces[place] != piece || (turn && place == piece))
                    continue;
                const int begin = loop_chords[place];
                cursor_t cursor = loop_begin(begin);
                do {
                    const segment_t s = next_segment(&cursor, &cell, &c);
                    labels[at] = s.label;
                    /* An empty segment ends where it begins; -1 on the boundary. */
                    from[at] = !s.empty ? s.from : (s.label < 0 ? -1 : s.to);
                    to[at] = turn ? ISLAND : s.to;
                    places[at] = piece;
                    p[at] = s.p;
                    q[at] = s.q;
                    ++at;
                } while (!is_complete(&cursor, begin) && at < segment_starts[u + 1]);
            }
    }
}

/* Per crossed cell: the reach of its pieces in the domain, in a part of the domain (part.cl). */
kernel void limit_reach(const int size, SEGMENT_ARGS, global const int *touched, global float *reach)
{
    WORK_ITEM(u);
    REAL far2 = 0;
    for (int k = segment_starts[u]; k < segment_starts[u + 1]; ++k)
        far2 = fmax(far2, fmax(dot(segment_p[k], segment_p[k]), dot(segment_q[k], segment_q[k])));
    reach[touched[u]] = (float)sqrt(far2);
}

/* Per crossed cell: check that its pieces fit to the neighboring ones. All faces must have two sides and none may
   belong to a ghost generator; then the cells tile the domain. This fails where edges cross a face closer to each other
   than round-off. Check also that the generator keeps a piece. `n` generators are in the domain. */
kernel void check_segments(const int size, const int n, SEGMENT_ARGS, global const int *touched,
                           global const int *slots, global const int *roots, global const int *starts,
                           global const int *neighbors, global int *flags)
{
    WORK_ITEM(u);
    const segments_t s = SEGMENTS;
    const int i = touched[u];
    bool fits = true;
    REAL area = 0;
    for (int k = s.starts[u]; k < s.starts[u + 1]; ++k) {
        const int j = s.labels[k];
        if (roots[s.places[k]] == i)
            area += difference_of_products(s.p[k].s0, s.q[k].s1, s.p[k].s1, s.q[k].s0);
        if (j < 0 || is_empty(&s, k))
            continue;
        if (j >= n)
            fits = false;
        else if (slots[j] == OUTSIDE)
            fits = false;
        else if (slots[j] == UNTOUCHED)
            fits &= s.from[k] < 0 && s.to[k] < 0;
        else
            fits &= other_side(&s, k, i, slots[j]) >= 0;
    }
    for (int f = starts[i]; f < starts[i + 1]; ++f) {
        const int j = neighbors[f];
        if (j < 0 || j >= n || slots[j] != UNTOUCHED)
            continue;
        bool found = false;
        for (int k = s.starts[u]; k < s.starts[u + 1] && !found; ++k)
            found = s.labels[k] == j;
        fits &= found;
    }
    if (!fits || !(area > 0))
        atomic_or(flags, FLAG_LOST);
}

/* Per crossed cell: pieces without a generator take that of the piece across their longest face, if it is known. Only
   crossed cells take pieces. */
kernel void adopt_pieces(const int size, SEGMENT_ARGS, global const int *touched, global const int *slots,
                         global const int *list_starts, global const int *loop_pieces, global const int *roots,
                         global int *new_roots)
{
    WORK_ITEM(u);
    const segments_t s = SEGMENTS;
    const int i = touched[u];
    for (int piece = list_starts[u] + u; piece < list_starts[u + 1] + u + 1; ++piece) {
        if (loop_pieces[piece] != piece)
            continue;
        int root = roots[piece];
        REAL longest = -1;
        if (root < 0)
            for (int k = s.starts[u]; k < s.starts[u + 1]; ++k) {
                if (s.places[k] != piece || s.labels[k] < 0 || is_empty(&s, k))
                    continue;
                const int other = other_root(&s, k, i, slots, roots);
                const REAL2 e = s.q[k] - s.p[k];
                if (other >= 0 && slots[other] != UNTOUCHED && dot(e, e) > longest) {
                    longest = dot(e, e);
                    root = other;
                }
            }
        new_roots[piece] = root;
    }
}

/* Per crossed cell: a piece that no other cell takes stays. orphans[place] = 1 for pieces that go to another cell;
   their uncrossed neighbors, which must list that cell, are marked. */
kernel void settle_pieces(const int size, SEGMENT_ARGS, global const int *touched, global const int *slots,
                          global const int *list_starts, global const int *loop_pieces, global int *roots,
                          global int *orphans, global int *marks)
{
    WORK_ITEM(u);
    const segments_t s = SEGMENTS;
    const int i = touched[u];
    for (int piece = list_starts[u] + u; piece < list_starts[u + 1] + u + 1; ++piece) {
        orphans[piece] = 0;
        if (loop_pieces[piece] != piece)
            continue;
        if (roots[piece] < 0)
            roots[piece] = i;
        if (roots[piece] == i)
            continue;
        orphans[piece] = 1;
        for (int k = s.starts[u]; k < s.starts[u + 1]; ++k)
            if (s.places[k] == piece && s.labels[k] >= 0 && slots[s.labels[k]] == UNTOUCHED)
                atomic_or(marks + s.labels[k], 1);
    }
}

/* Per loop: list the orphans, and the crossed cell that each lies in. */
kernel void list_orphans(const int size, global const int *ranks, global int *orphans)
{
    WORK_ITEM(place);
    if (ranks[place + 1] > ranks[place])
        orphans[ranks[place]] = place;
}

/* Per generator of the domain: number of faces of its cell, if the boundary does not cross it. */
kernel void count_whole(const int size, global const int *starts, global const int *slots, global int *counts)
{
    WORK_ITEM(i);
    counts[i] = slots[i] == UNTOUCHED ? starts[i + 1] - starts[i] : 0;
}

/* Per crossed cell: add the faces of each piece to the count of the generator that gets it. */
kernel void count_trimmed(const int size, SEGMENT_ARGS, global const int *touched, global const int *slots,
                          global const int *roots, global int *counts)
{
    WORK_ITEM(u);
    const segments_t s = SEGMENTS;
    int other;
    for (int k = s.starts[u]; k < s.starts[u + 1]; ++k) {
        const int root = roots[s.places[k]];
        if (is_face(&s, k, touched[u], root, slots, roots, &other))
            atomic_inc(counts + root);
    }
}

/* Per generator of the domain with an uncrossed cell: copy its row. Where the piece of a neighbor goes to another cell
   (marks), list that cell. */
kernel void copy_whole(const int size, global const int *starts, global const int *neighbors,
                       global const REAL *face_measures, global const REAL2 *face_centroids, SEGMENT_ARGS,
                       global const int *slots, global const int *roots, global const int *marks,
                       global const int *new_starts, global int *new_neighbors, global REAL *new_measures,
                       global REAL2 *new_centroids, global const REAL *volumes, global REAL2 *outlines)
{
    WORK_ITEM(i);
    if (starts[i] == starts[i + 1] || slots[i] == OUTSIDE)
        outlines[i] = (REAL2)(0, 6);
    if (starts[i] == starts[i + 1] || slots[i] != UNTOUCHED)
        return;
    const segments_t s = SEGMENTS;
    const int shift = new_starts[i] - starts[i];
    const bool marked = marks[i];
    REAL perimeter = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        int j = neighbors[k];
        if (marked && j >= 0 && slots[j] != UNTOUCHED) {
            const int u = slots[j];
            for (int m = s.starts[u]; m < s.starts[u + 1]; ++m)
                if (s.labels[m] == i && s.from[m] < 0 && s.to[m] < 0)
                    j = roots[s.places[m]];
        }
        new_neighbors[k + shift] = j;
        new_measures[k + shift] = face_measures[k];
        new_centroids[k + shift] = face_centroids[k];
        perimeter += face_measures[k];
    }
    outlines[i] = (REAL2)(polygon_quality(starts[i + 1] - starts[i], volumes[i], perimeter), 6);
}

/* Per crossed cell u: row and measures of all pieces of its generator. orphans lists the pieces that changed cells, in
   order; place_cells[place] is the crossed cell that they lie in.

   With `straight` the measures are those of cells with straight sides along the boundary (wall_sides.h).

   outlines[i] = (quality, number of neighbors of a hexagonal lattice here) */
kernel void write_trimmed(const int size, const int straight, SEGMENT_ARGS, SHORE_ARGS, global const REAL2 *points,
                          global const int *touched, global const int *slots, global const int *roots,
                          global const int *orphans, const int orphan_count, global const int *place_cells,
                          global const int *new_starts, global int *new_neighbors, global REAL *new_measures,
                          global REAL2 *new_centroids, global int *face_segments, global REAL *volumes,
                          global REAL *offsets, global REAL *covariances, global REAL2 *outlines)
{
    WORK_ITEM(u);
    const segments_t s = SEGMENTS;
    const shore_t shore = SHORE;
    const int i = touched[u];
    moments_t m = {0, 0, 0, 0, 0, 0};
    outline_t o = no_outline();
    REAL perimeter = 0;
    int at = new_starts[i];
    for (int turn = -1; turn < orphan_count; ++turn) {
        /* First the pieces in this cell, then those from other cells. */
        const int place = turn < 0 ? -1 : orphans[turn];
        if (turn >= 0 && roots[place] != i)
            continue;
        const int v = turn < 0 ? u : place_cells[place];
        const int home = touched[v];
        const REAL2 shift = points[home] - points[i];
        for (int k = s.starts[v]; k < s.starts[v + 1]; ++k) {
            if (turn < 0 ? roots[s.places[k]] != i : s.places[k] != place)
                continue;
            const REAL2 p = s.p[k] + shift, q = s.q[k] + shift, e = q - p;
            add_triangle(&m, p, q);
            int other;
            if (!is_face(&s, k, home, i, slots, roots, &other))
                continue;
            if (other >= 0)
                add_side(&o, p, q);
            perimeter += sqrt(dot(e, e));
            new_neighbors[at] = other;
            new_measures[at] = sqrt(dot(e, e));
            new_centroids[at] = (p + q) / 2;
            face_segments[at] = k;
            ++at;
        }
    }
    const REAL cell_size = sqrt(m.area / 2);
    for (int face = new_starts[i]; face < at; ++face) {
        const int chord = s.from[face_segments[face]];
        if (new_neighbors[face] < 0 && begins_run(&shore, chord, i))
            add_wall_sides(&o, &shore, chord, i, points[i], cell_size);
    }
    /* Two sides do not form a polygon, even if one is bent, nor do straight sides that enclose next to nothing. */
    const bool is_polygon = o.sides > 2 && o.m.area > R(LEAST_AREA) * m.area;
    write_moments(straight && is_polygon ? &o.m : &m, i, volumes, offsets, covariances);
    const REAL quality =
        is_polygon ? polygon_quality(o.sides, o.m.area / 2, o.perimeter) : polygon_quality(3, m.area / 2, perimeter);
    outlines[i] = (REAL2)(fmax(quality, R(0)), 6 - o.missing);
}

/* Per crossed cell: write its number for its loops, and the owner of the bounded piece for its chords. */
kernel void name_chord_owners(const int size, SEGMENT_ARGS, global const int *list_starts, global const int *listed,
                              global const int *roots, global int *place_cells, global int *chord_owners)
{
    WORK_ITEM(u);
    const segments_t s = SEGMENTS;
    for (int place = list_starts[u] + u; place < list_starts[u + 1] + u + 1; ++place)
        place_cells[place] = u;
    for (int k = list_starts[u]; k < list_starts[u + 1]; ++k)
        chord_owners[listed[k]] = -1;
    for (int k = s.starts[u]; k < s.starts[u + 1]; ++k)
        if (s.labels[k] < 0 && !is_empty(&s, k))
            chord_owners[s.from[k]] = roots[s.places[k]];
}
