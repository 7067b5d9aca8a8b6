#include "tessellation/update_rows.h"
#include "tessellation/corner_flips.h"
#include "tessellation/corner_sums.h"

/* Update of a diagram in 3D: the cells of generators that moved a little, from those that they had before.

   The intersection C_i of the box and the half-spaces of *some* generators contains the Voronoi cell V_i. If any two
   cells have the same vertices on their common face, each between the same generators, the C_i fit together without gap
   or overlap, hence cover the box once, and C_i = V_i for all i.

   C_i among the previous neighbors: each vertex is a triple of faces. The triples of the previous cell are kept while
   they stay counter-clockwise and no vertex lies beyond another face; they form a closed surface (Euler's formula), so
   they are the vertices of C_i. Else edges are flipped; if that fails, the cell is walked along its edges.

   Agreement: cells that keep their triples agree as before. A face (p, q) appears where an edge between cells a, b, c
   vanishes. In these, an edge is flipped to one between p and q, which are made neighbors (`update_cells`). All faces
   of changed cells are compared by sums of hashes over their vertices (`check_cells`); where they differ, both cells
   are clipped by all generators near them (`clip_polyhedra`), and never wrong. If round-off may decide about the faces
   of such a cell, areas are compared, and `match_polyhedron_faces` handles the rest.

   In a periodic box neighbors are nearest images, as long as no vertex is as far from its generator as a quarter of a
   period. Then any two generators about a vertex are less than half a period apart, and all their cells see the same
   images there. Cells without gap or overlap may cover the box more than once; the host compares the volumes.

   In a part of a domain ghosts have no cells with which faces could be compared. So cells beside them are always
   clipped by all generators near them. */

/* Largest difference of the areas of two half-faces, as a share of the area of the cell, where one is from a cell that
   was clipped. */
#define AREA_NOISE (IS_DOUBLE ? R(1e-9) : R(1e-4))

/* Add the plane of a neighbor or wall to the cell of a generator at x. */
inline void add_plane(CORNERS *cell, int label, REAL4 x, const rows_t *in)
{
    const int f = cell->faces++;
    cell->labels[f] = label;
    cell->planes[f] = plane_of_face(label, x, in);
}

/* Start with the planes of the previous neighbors of generator i at x, and of further ones in ascending order. Returns
   the number of the former; -1 if there is no room, or the cell is to be clipped. */
inline int list_planes(CORNERS *cell, int i, REAL4 x, global const int *further, const rows_t *in)
{
    const int start = in->starts[i], n = in->starts[i + 1] - start;
    cell->faces = 0;
    if (n > MOST_FACES)
        return -1;
    for (int k = 0; k < n; ++k) {
        if (must_clip(in->neighbors[start + k], in))
            return -1;
        add_plane(cell, in->neighbors[start + k], x, in);
    }
    for (int last = NO_NEIGHBOR; further;) {
        int next = INT_MAX;
        for (int m = 0; m < MORE; ++m) {
            const int label = further[m];
            next = label > last ? min(next, label) : next;
        }
        if (next == INT_MAX)
            break;
        if (cell->faces == MOST_FACES || must_clip(next, in))
            return -1;
        add_plane(cell, next, x, in);
        last = next;
    }
    pad_planes(cell);
    return n;
}

/* The set of the walls that the cell of a generator at x crosses, one bit each. */
inline uint crossed_walls(const CORNERS *cell, REAL4 x, const rows_t *in)
{
    const REAL reach = sqrt(cell->reach2), noise = WALL_NOISE(reach);
    uint crossed = 0;
    if (WALLS_MOVE) {
        for (int v = 0; own_count(&in->own) > 0 && v < cell->corners; ++v)
            crossed |= own_planes_before(corner_place(cell, v), noise, &in->own);
        return crossed;
    }
    const REAL4 low = x - in->box_lower, high = in->box_upper - x;
    const REAL rooms[6] = {low.s0, high.s0, low.s1, high.s1, low.s2, high.s2};
    for (int wall = 0; wall < 6; ++wall) {
        if (reach <= rooms[wall] + noise)
            continue;
        const REAL *places = (const REAL *)(wall < 2 ? cell->x : (wall < 4 ? cell->y : cell->z));
        REAL farthest = 0;
        for (int v = 0; v < cell->corners; ++v)
            farthest = fmax(farthest, wall & 1 ? places[v] : -places[v]);
        crossed |= (uint) !(farthest <= rooms[wall] + noise) << wall;
    }
    return crossed;
}

/* Keep the cell of generator i at x within the walls: those that it does not have become further neighbors. True if
   there is none, and all walls near the cell are known. */
inline bool keep_in_walls(const CORNERS *cell, int i, REAL4 x, const rows_t *in, global int *marks)
{
    if (!knows_walls(i, cell->reach2, &in->own))
        return false;
    const uint crossed = crossed_walls(cell, x, in);
    for (uint rest = crossed; rest; rest &= rest - 1)
        add_neighbor(i, own_label(&in->own, popcount(~rest & (rest - 1))), in, marks);
    return crossed == 0;
}

/* Remove all links, and link the vertices. */
inline void link_corners(CORNERS *cell, LINKS *links)
{
    for (int k = 0; k < cell->faces * MOST_FACES; ++k)
        links->at[k] = NO_CORNER;
    for (int v = 0; v < cell->corners; ++v) {
        const uchar4 at = cell->at[v];
        link_corner(cell, links, v, at.s0, at.s1, at.s2);
    }
}

/* Bit b of next[a]: face b follows a at a vertex. */
inline void find_edges(const CORNERS *cell, uint *next)
{
    for (int f = 0; f < MOST_FACES; ++f)
        next[f] = 0;
    for (int v = 0; v < cell->corners; ++v) {
        const uchar4 at = cell->at[v];
        next[at.s0] |= 1u << at.s1;
        next[at.s1] |= 1u << at.s2;
        next[at.s2] |= 1u << at.s0;
    }
}

/* Number the faces that have vertices anew. False if the vertices form no closed surface. */
inline bool number_faces(CORNERS *cell, const uint *next)
{
    uchar number[MOST_FACES];
    int faces = 0;
    for (int f = 0; f < cell->faces; ++f) {
        number[f] = faces;
        faces += next[f] != 0;
    }
    if (faces < 4 || cell->corners != 2 * faces - 4)
        return false;
    if (faces == cell->faces)
        return true;
    for (int v = 0; v < cell->corners; ++v) {
        const uchar4 at = cell->at[v];
        cell->at[v] = (uchar4)(number[at.s0], number[at.s1], number[at.s2], 0);
    }
    for (int f = 0; f < cell->faces; ++f)
        if (next[f] != 0) {
            const int to = number[f];
            cell->labels[to] = cell->labels[f];
            cell->planes[to] = cell->planes[f];
        }
    cell->faces = faces;
    pad_planes(cell);
    return true;
}

/* Write the keys that neighbors are compared with: for each face the sum, over its vertices, of the products of the
   hashes of the two other faces there. Returns the set of the faces whose keys differ from the `n` previous ones; these
   faces were in the same order. */
inline uint write_keys(const CORNERS *cell, int place, global uint *keys, int n, global const int *old_labels,
                       global const uint *old_keys)
{
    uint hashes[MOST_FACES], sums[MOST_FACES];
    for (int f = 0; f < cell->faces; ++f) {
        hashes[f] = hash_of_label(cell->labels[f]);
        sums[f] = 0;
    }
    for (int v = 0; v < cell->corners; ++v) {
        const uchar4 at = cell->at[v];
        const uint a = hashes[at.s0], b = hashes[at.s1], c = hashes[at.s2];
        sums[at.s0] += b * c;
        sums[at.s1] += c * a;
        sums[at.s2] += a * b;
    }
    uint differ = 0;
    for (int f = 0, k = 0; f < cell->faces; ++f) {
        keys[place + f] = sums[f];
        while (k < n && old_labels[k] != cell->labels[f])
            ++k;
        differ |= (uint)(k == n || old_keys[k] != sums[f]) << f;
    }
    return differ;
}

/* Make the faces with a new edge between them neighbors. Bit b of old[a], next[a]: there was, is an edge between faces
   a and b. */
inline void join_new_edges(const CORNERS *cell, const uint *old, const uint *next, const rows_t *in, global int *marks)
{
    for (int a = 0; a < cell->faces; ++a)
        for (uint rest = next[a] & ~old[a]; rest; rest &= rest - 1)
            add_neighbor(cell->labels[a], cell->labels[popcount(~rest & (rest - 1))], in, marks);
}

/* The links of a cell are not needed any more when its sums are. */
typedef union {
    links_t links;
    sums_t sums;
} links_or_sums_t;

/* Per generator i: no marks, no further neighbors. `used` are the faces of the previous diagram. */
kernel void begin_cell_updates(const int size, const int used, const int report_size, global int *report,
                               global int *marks, global int *more)
{
    WORK_ITEM(i);
    marks[i] = 0;
    for (int k = 0; k < MORE; ++k)
        more[MORE * i + k] = NO_NEIGHBOR;
    SHORT_LOOP
    for (int k = 0; i == 0 && k < report_size; ++k)
        report[k] = k == REPORT_FACES ? used : 0;
}

/* Per generator i of n: its cell among its previous neighbors and `further` ones, with the measures of
   `clip_polyhedra`; or row_counts[i] = UNFINISHED where the cell is open, has many faces, is near round-off, or is to
   be clipped. `which` are all cells, or marked ones, which are `listed`, as ~i if they are to be clipped. Only these
   have further neighbors.

   `old_corners` and `old_keys`: the triples, from 2 old_starts[i] on, and keys of the previous cells; none if not
   `known`. Cells are written to their previous places, and those with more faces behind all these, from report[1] on.
   changed[i]: the set of its faces that neighbors must be compared with. reach[i], if `with_reach`: the distance of its
   farthest corner. */
kernel void update_cells(const int size, const int which, const int n, global const int *listed,
                         global const int *further, global const int *old_starts, global const int *old_neighbors,
                         const int known, global const uchar4 *old_corners, global const uint *old_keys,
                         global const REAL *points, CLIP_BOX_ARGS, const int room, CELL_OUTPUT_ARGS, global uint *keys,
                         global int *changed, const int with_reach, global float *reach, global int *more,
                         global int *marks PERIOD_ARGS)
{
    LONG_ITEM(item);
    if (which == MARKED_CELLS && item >= report[REPORT_PLACED])
        return;
    if (item == 0)
        report[REPORT_MARKED] = 0; /* they are counted again */
    const int what = which == ALL_CELLS ? item : listed[item], i = max(what, ~what);
    const rows_t in = ROWS(i);
    const REAL4 x = (REAL4)(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0);
    global const int *added = which == MARKED_CELLS ? further + MORE * item : 0;
    corners_t cell;
    links_or_sums_t work;
    const int start = old_starts[i], listed_before = what < 0 ? -1 : list_planes(&cell, i, x, added, &in);
    const int state = listed_before >= 4 && known ? old_corners[2 * start].s3 : NO_CORNERS;
    const bool has_corners = state != NO_CORNERS;
    bool done = listed_before >= 4, kept = false, flips = false;
    row_counts[i] = UNFINISHED;
    if (has_corners) {
        cell.corners = 2 * listed_before - 4;
        for (int v = 0; v < cell.corners; ++v)
            cell.at[v] = old_corners[2 * start + v];
        const int faces = cell.faces;
        cell.faces = listed_before;
        /* With further neighbors the cell is measured later. */
        flips = place_corners(&cell, &work.sums, faces == listed_before);
        cell.faces = faces;
        kept = flips && faces == listed_before && fits_corners(&cell);
    }
    if (done && !kept) {
        uint old[MOST_FACES], next[MOST_FACES];
        cell.corners = has_corners ? cell.corners : 0;
        find_edges(&cell, old);
        link_corners(&cell, &work.links);
        if (!(flips && repair_corners(&cell, &work.links, listed_before))) {
            list_planes(&cell, i, x, added, &in); /* flips may have removed faces */
            cell.corners = 0;
            link_corners(&cell, &work.links);
            done = walk_corners(&cell, &work.links);
        }
        if (done) {
            find_edges(&cell, next);
            join_new_edges(&cell, old, next, &in, marks);
            done = number_faces(&cell, next) && place_corners(&cell, &work.sums, true) && fits_corners(&cell);
        }
    }
    kept = kept && state == KNOWN_CORNERS;
    changed[i] = done && kept ? 0 : ALL_FACES;
    if (done && has_nearest_images(cell.reach2, &in) && keep_in_walls(&cell, i, x, &in, marks)) {
        const bool longer = cell.faces > old_starts[i + 1] - start;
        const int place = longer ? take_places(report, cell.faces) : start;
        const measured_t out = {labels, measures, centroids, volumes, offsets, covariances};
        if (place + cell.faces <= room && write_measures(&cell, &work.sums, i, place, &out)) {
            row_places[i] = place;
            row_counts[i] = cell.faces | CERTAIN;
            write_triples(&cell, corners + 2 * place, KNOWN_CORNERS);
            if (with_reach)
                reach[i] = (float)sqrt(cell.reach2);
            for (int f = 0; kept && f < cell.faces; ++f)
                keys[place + f] = old_keys[start + f];
            if (!kept) {
                const bool comparable = state == KNOWN_CORNERS && which != MARKED_CELLS;
                const uint differ = write_keys(&cell, place, keys, comparable ? listed_before : 0,
                                               old_neighbors + start, old_keys + start);
                changed[i] = differ;
            }
        }
    }
}

/* Mark a cell, and count it if it is the first time. */
inline void mark_counted(int i, int mark, global int *marks, global int *report)
{
    if (!(atomic_or(marks + i, mark | COUNTED) & COUNTED))
        atomic_inc(report + REPORT_MARKED);
}

/* The key of face f of a cell with `n` faces, from its triples; see write_keys. */
inline uint key_of_face(int f, int place, int n, global const int *labels, global const uchar4 *corners)
{
    uint sum = 0;
    for (int v = 2 * place; v < 2 * place + 2 * n - 4; ++v) {
        const int at[3] = {corners[v].s0, corners[v].s1, corners[v].s2};
        for (int a = 0; a < 3; ++a)
            if (at[a] == f)
                sum += hash_of_label(labels[place + at[(a + 1) % 3]]) * hash_of_label(labels[place + at[(a + 2) % 3]]);
    }
    return sum;
}

/* Whether face f of a cell and face g of another one have the same vertices. At walls of a solid their areas differ. */
inline bool have_same_corners(int f, int place, int n, int g, int other_place, int m, global const int *labels,
                              global const uchar4 *corners)
{
    return corners[2 * place].s3 != NO_CORNERS && corners[2 * other_place].s3 != NO_CORNERS &&
           key_of_face(f, place, n, labels, corners) == key_of_face(g, other_place, m, labels, corners);
}

/* Per generator i with a changed cell: compare its faces with those of its neighbors. Cells that differ are marked.
   Faces with the keys of the previous diagram agree with neighbors that have these, too; others compare them. Two cells
   that compare all faces do it once. Unfinished cells are compared when they are known; none are if the faces of some
   cells are missing, as there is only room for `room`: FLAG_FULL. Marked and unfinished cells are counted. */
kernel void check_cells(const int size, const int room, global int *report, global const int *row_places,
                        global const int *row_counts, global const int *labels, global const REAL *measures,
                        global const uchar4 *corners, global const uint *keys, global const int *changed,
                        global int *marks)
{
    LONG_ITEM(i);
    const bool full = report[REPORT_FACES] > room;
    if (i == 0) {
        report[REPORT_PLACED] = 0; /* for the next round */
        if (full)
            atomic_or(report + REPORT_FLAGS, FLAG_FULL);
    }
    if (atomic_or(marks + i, 0))
        mark_counted(i, 0, marks, report);
    if (row_counts[i] == UNFINISHED)
        atomic_inc(report + REPORT_UNFINISHED);
    if (!changed[i] || row_counts[i] == UNFINISHED || full)
        return;
    const int n = COUNT_OF(row_counts[i]), begin = row_places[i];
    const bool certain = (row_counts[i] & CERTAIN) != 0, all = changed[i] == ALL_FACES;
    for (int f = 0; f < n; ++f) {
        const int k = begin + f, j = labels[k];
        if (j < 0 || j >= size || !(all || ((uint)changed[i] >> f & 1)) || row_counts[j] == UNFINISHED)
            continue;
        const bool other_certain = (row_counts[j] & CERTAIN) != 0;
        if (!(certain || other_certain) || (j < i && changed[j] == ALL_FACES))
            continue;
        const int place = row_places[j], m = COUNT_OF(row_counts[j]);
        const bool by_keys = certain && other_certain;
        bool same = false;
        for (int q = place; by_keys && !same && q < place + m; ++q)
            same = labels[q] == i && keys[q] == keys[k];
        if (!by_keys) {
            REAL area = 0;
            for (int q = begin; q < begin + n; ++q)
                area += measures[q];
            for (int q = place; q < place + m; ++q)
                same |= labels[q] == i && (fabs(measures[q] - measures[k]) <= AREA_NOISE * area ||
                                           have_same_corners(f, begin, n, q - place, place, m, labels, corners));
        }
        /* A cell that will be updated again is compared then. Other work-items change other bits of its mark now. */
        if (same || ((atomic_or(marks + i, 0) | atomic_or(marks + j, 0)) & UPDATE_AGAIN))
            continue;
        if (certain)
            mark_counted(i, CLIP_ANEW, marks, report);
        if (other_certain)
            mark_counted(j, CLIP_ANEW, marks, report);
    }
}

/* Per generator i: list it with its further neighbors if it is marked, as ~i if it is to be clipped, and remove the
   mark. The order of the list depends on that of the work-items, the cells do not. No cell is changed now, but for
   those to be clipped. Nothing is done if there are more than `most` marked ones. `round` numbers the launches. */
kernel void list_marked_cells(const int size, const int most, const int round, global const int *more,
                              global const int *row_counts, global int *marks, global int *changed, global int *listed,
                              global int *further, global int *report)
{
    WORK_ITEM(i);
    if (i == 0)
        report[REPORT_UNFINISHED] = 0; /* they are counted again */
    if (report[REPORT_MARKED] > most)
        return;
    if (i == 0)
        report[REPORT_LISTED + round] = report[REPORT_MARKED];
    changed[i] = row_counts[i] == UNFINISHED ? ALL_FACES : 0;
    if (!marks[i])
        return;
    const int to = atomic_inc(report + REPORT_PLACED);
    listed[to] = marks[i] & CLIP_ANEW ? ~i : i;
    for (int k = 0; k < MORE; ++k)
        further[MORE * to + k] = more[MORE * i + k];
    marks[i] = 0;
}
