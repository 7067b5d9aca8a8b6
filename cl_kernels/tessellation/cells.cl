#include "opencl/blocks.h"
#include "tessellation/corner.h"

#include "tessellation/vertex_walk.h"
#include "tessellation/bins.h"
#include "tessellation/measures.h"
#ifdef SPHERE
#include "tessellation/sphere_search.h"
#else
#include "tessellation/widening.h"
#endif
#if IN_LANES
#include "simd/cell_measures.h"
#endif
#ifdef WEIGHTED
/* Cells of a power diagram may be empty. */
#define TOO_FEW(n) ((n) == 1 || (n) == 2)
#define CLIP_BOUND_ARGS BOUND_ARGS
#define CLIP_BOUNDS BOUNDS
#else
#define TOO_FEW(n) ((n) < 3)
#define CLIP_BOUND_ARGS
#define CLIP_BOUNDS
#endif

/* Per item p in bin order: the cell of generator i = items[p] as its list of neighbors, counter-clockwise.

   V_i = { y in the box : |y - x_i| <= |y - x_j| for all j } (the paper's 2.1), by clipping the box with one bisector
   after the other. A generator farther than twice the farthest corner cannot cut, so the search widens until the
   searched square of bins covers that circle. In a power diagram (the paper's 2.5) see `search_radius`. reach[p] is the
   first guess of the radius, and then the radius. Only the first `rows` generators get cells.

   With s = places[i], which is i for all but the longest rows:
   slots[s * SLOT ...]  neighbors j, or -1 - wall; |slot_counts[s]| of them, negative if round-off leaves a doubt

   If `some`, rows that have faces are there already (`hulls.cl`, or where others had too many). */
kernel void clip_polygons(const int size, const int rows, global const REAL *binned, global const int *items,
                          global float *reach, BIN_ARGS, global const REAL *points, const REAL4 box_lower,
                          const REAL4 box_upper, const int some, global int *slots, global int *slot_counts,
                          global int *places, global int *report CLIP_BOUND_ARGS)
{
    LONG_ITEM(p);
    const int i = items[p];
    if (i >= rows || (some && slot_counts[i]))
        return;
    SITE(x, p, binned);
    BOX_CORNERS(lower, upper);
#ifdef SPHERE
    const search_t in = {points, binned, items, bins, grid_frames, grid_shapes};
#endif
    cell_t cell;
    start_polygon(&cell, i, x, lower, upper);
    int flag = 0;
    REAL w = fmax(reach[p], FLT_MIN), inner = -1; /* a radius of 0 would never widen */
    while (flag == 0) {
#ifdef WEIGHTED
        /* The outermost bins extend beyond the square. */
        cell.most = most_excess(weight_within(x, w + 1 / FRAME_INVERSE(grid_frames[0]) BOUNDS), SITE_WEIGHT(x));
#endif
#ifdef SPHERE
        flag = clip_cell_by_bins(&cell, (REAL4)(x[0], x[1], x[2], 0), p, w, inner, false, &in);
#else
        flag = clip_polygon_by_bins(&cell, x, p, w, inner, points, binned, items, bins, grid_frames, grid_shapes);
#endif
#ifdef WEIGHTED
        const REAL need = cell.n ? search_radius(x, SITE_WEIGHT(x), cell.reach2 * R(1.01) BOUNDS) : 0;
#else
        const REAL need = sqrt(cutting_distance2(&cell));
#endif
        if (!(need > w)) /* a NaN ends the loop, too */
            break;
        inner = w;
        w = fmin(need, 2 * w);
    }
    if (flag == 0)
        reach[p] = (float)(2 * sqrt(cell.reach2) * (1 + 8 * REAL_EPS));
    places[i] = store_cell(&cell, flag, x, points, i, slots, slot_counts, report);
}

#ifdef WEIGHTED
/* Per generator i: its cell, clipped by its neighbors in an earlier, similar diagram, and by theirs. A cell from which
   too little was cut contains that of the diagram. So all are right if the sum of their areas is that of the box. If
   not, the next round starts from these. A cell without neighbors is empty and stays so. In a folded graph neighbors
   are nearest images; images farther away are missing. */
kernel void clip_by_rings(const int size, global const REAL *points, const REAL4 box_lower, const REAL4 box_upper,
                          global const int *old_starts, global const int *old_neighbors, global int *slots,
                          global int *slot_counts, global int *places, global int *report)
{
    LONG_ITEM(i);
    SITE(x, i, points);
    BOX_CORNERS(lower, upper);
    cell_t cell;
    start_polygon(&cell, i, x, lower, upper);
    int flag = 0;
    const int begin = old_starts[i], end = old_starts[i + 1];
    if (begin == end)
        cell.n = 0;
    /* First the neighbors, then those of the k-th one. */
    for (int k = begin - 1; k < end; ++k) {
        const int via = k < begin ? i : old_neighbors[k];
        for (int l = via < 0 ? 0 : old_starts[via]; via >= 0 && l < old_starts[via + 1]; ++l) {
            const int j = old_neighbors[l];
            bool known = j < 0 || j == i;
            for (int f = 0; f < cell.n && !known; ++f)
                known = cell.faces[f] == j;
            const REAL2 way = known ? (REAL2)(1, 0) : direction_of(x, j, points);
            const REAL d[2] = {way.s0, way.s1};
            if (!known && !clip_polygon(&cell, d, dot(way, way), j, false, points))
                flag = FLAG_FULL;
        }
    }
#ifdef FOLD_0
    /* Along a period no cell reaches a side of the box that contains all. There is no corner on it, either. */
    for (int f = 0; f < cell.n; ++f)
        if (cell.faces[f] < 0 && FOLD((-1 - cell.faces[f]) / 2) > 0)
            atomic_or(report, FLAG_OPEN);
#endif
    places[i] = store_cell(&cell, flag, x, points, i, slots, slot_counts, report);
}
#endif

/* Twice the area of the cell of generator j, from its listed faces. */
inline REAL listed_area(const face_rows_t *rows, int j, global const REAL *points, const REAL *lower, const REAL *upper)
{
    SITE(x, j, points);
    int n;
    global const int *row = face_row(rows, j, &n);
    REAL area = 0;
    if (n < 3)
        return area;
    const REAL2 origin = corner(j, x, row[n - 1], row[0], points, lower, upper);
    REAL2 v = origin;
    for (int k = 0; k < n; ++k) {
        const REAL2 w = k == n - 1 ? origin : corner(j, x, row[k], row[k + 1], points, lower, upper);
        area += difference_of_products(v.s0, w.s1, v.s1, w.s0);
        v = w;
    }
    return area;
}

/* Per generator i: bit k of keep[its first slot ...] marks a neighbor that also lists i. With round-off one of two
   cells may have a face of zero length that the other lacks; the cell is doubtful, and the face is dropped, so that the
   graph is symmetric. If such a face cuts off more than the round-off of the box, or more than a share of one of the
   cells, the generators are too close (from far away, two generators one ulp apart have the same bisector): a flag is
   set. Faces with generators without a row are not checked.

   If `repaired`, fits[i] is 1 for rows that are consistent with all neighbors; otherwise it is not read, nor are marks.
   While cells are marked, all rows are empty, and the marked cells are counted. */
kernel void match_polygon_faces(const int size, global const int *places, global const int *slots,
                                global const int *slot_counts, global const int *old_starts,
                                global const int *old_neighbors, global const REAL *points, const REAL4 box_lower,
                                const REAL4 box_upper, const int repaired, const REAL share, global const int *marks,
                                global int *fits, global uint *keep, global int *counts, global int *report)
{
    LONG_ITEM(i);
    counts[i] = 0;
    if (report[REPORT_MARKED]) {
        if (marks[i])
            atomic_inc(report + REPORT_UNFINISHED);
        return;
    }
    const face_rows_t rows = face_rows(places, slots, slot_counts, old_starts, old_neighbors);
    int n;
    global const int *row = face_row(&rows, i, &n);
    const int place = places[i];
    if (place < 0) {
        counts[i] = n;
        return;
    }
    /* FLAG_COLLAPSED may be set meanwhile. */
    const bool some = (report[REPORT_FLAGS] & FLAG_DOUBT) != 0;
    if (repaired ? fits[i] : !some) {
        /* All its faces have two sides: the row is consistent, or every new row is certain. */
        for (int left = n, k = 0; left > 0; left -= 32, ++k)
            keep[place + k] = left < 32 ? (1u << left) - 1 : ~0u;
        counts[i] = n;
        if (TOO_FEW(n))
            atomic_or(report, FLAG_COLLAPSED);
        return;
    }
    uint word = 0;
    int count = 0;
    for (int k = 0; k < n; ++k) {
        const int j = row[k];
        const bool known = j >= 0 && j < size;
        const bool doubtful = some && known && (slot_counts[place] < 0 || is_doubtful_row(&rows, j));
        bool mutual = !known || !(doubtful || repaired);
        if (!mutual) {
            int m;
            global const int *other = face_row(&rows, j, &m);
            mutual = place_in_row(other, m, i) < m;
        }
        if (mutual) {
            word |= 1u << (k % 32);
            ++count;
        } else if (!doubtful) {
            atomic_or(report, FLAG_COLLAPSED);
        } else {
            SITE(x, i, points);
            BOX_CORNERS(lower, upper);
            const int a = row[k == 0 ? n - 1 : k - 1];
            const int b = row[k == n - 1 ? 0 : k + 1];
            const REAL2 tip = corner(i, x, a, b, points, lower, upper);
            const REAL2 u = corner(i, x, a, j, points, lower, upper) - tip;
            const REAL2 v = corner(i, x, j, b, points, lower, upper) - tip;
            const REAL cut = fabs(u.s0 * v.s1 - u.s1 * v.s0);
            if (!(cut < 512 * REAL_EPS && cut <= share * listed_area(&rows, i, points, lower, upper) &&
                  cut <= share * listed_area(&rows, j, points, lower, upper)))
                atomic_or(report, FLAG_COLLAPSED);
            if (repaired) {
                /* `before` and `after` are now adjacent. */
                atomic_and(fits + i, 0);
                if (a >= 0)
                    atomic_and(fits + a, 0);
                if (b >= 0)
                    atomic_and(fits + b, 0);
            }
        }
        if (k % 32 == 31 || k == n - 1) {
            keep[place + k / 32] = word;
            word = 0;
        }
    }
    counts[i] = count;
    if (TOO_FEW(count))
        atomic_or(report, FLAG_COLLAPSED);
}

/* Per generator i: its faces as row i of the graph, and its cell's measures. All vectors are relative to x_i.

   starts, neighbors        the graph; faces in counter-clockwise order
   face_measures (m,)        length of a face
   face_centroids (m, 2)
   volumes (n,)              A_i
   offsets (n, 2)            centroid - x_i, the Lloyd displacement (the paper's 2.2)
   covariances (n, 3)        xx, xy, yy of the second moments about the centroid, per unit area

   With IN_LANES, each work-item takes LANES generators. With `ahead` this and `copy_graph` do nothing unless the report
   says that the rows are right, and that there is room for their faces. */
kernel void measure_cells(const int size, global const int *places, global const int *slots,
                          global const int *slot_counts, global const int *old_starts, global const int *old_neighbors,
                          global const uint *keep, global const int *starts, global const REAL *points,
                          const REAL4 box_lower, const REAL4 box_upper, const int ahead, const int room,
                          global const int *report, global int *neighbors, global FACE *face_measures,
                          global FACE *face_centroids, global REAL *volumes, global REAL *offsets,
                          global REAL *covariances)
{
    if (ahead && !are_right(report, room))
        return;
    BOX_CORNERS(lower, upper);
    const face_rows_t rows = face_rows(places, slots, slot_counts, old_starts, old_neighbors);
    const measures_t to = {starts, neighbors, face_measures, face_centroids, volumes, offsets, covariances};
#if IN_LANES
    const int first = (int)get_global_id(0) * LANES;
    if (first < size)
        measure_eight(&to, first, size, &rows, keep, points, lower, upper);
#else
    WORK_ITEM(i);
    int faces[ROW_CAPACITY];
    const int n = kept_faces(faces, &rows, keep, i);
    measure_cell(&to, i, faces, n, points, lower, upper);
#endif
}

/* Per generator i: the measures of its faces again, in full precision. */
kernel void measure_faces(const int size, global const int *starts, global const int *neighbors,
                          global const REAL *points, const REAL4 box_lower, const REAL4 box_upper,
                          global REAL *measures, global REAL *centroids)
{
    LONG_ITEM(i);
    SITE(x, i, points);
    BOX_CORNERS(lower, upper);
    const int begin = starts[i], end = starts[i + 1];
    if (begin == end)
        return;
    const REAL2 origin = corner(i, x, neighbors[end - 1], neighbors[begin], points, lower, upper);
    REAL2 v = origin;
    for (int k = begin; k < end; ++k) {
        const REAL2 w = k == end - 1 ? origin : corner(i, x, neighbors[k], neighbors[k + 1], points, lower, upper);
        REAL middle[DIM];
        measures[k] = measure_face(x, v, w, middle);
        EACH_AXIS (a)
            centroids[DIM * k + a] = middle[a];
        v = w;
    }
}

/* Number of cells around a vertex from which short faces may have been dropped one after the other, and the largest
   distance of the positions that these cells compute for the vertex. */
#define MANY_AROUND 8
#define MOST_SPREAD (64 * REAL_EPS)

/* Whether many cells around corner c of cell i, at v, compute positions for it that are too far apart. Checked by the
   cell with the smallest angle there, at most 45 degrees. */
inline bool is_spread(const int size, global const int *starts, global const int *neighbors, int i, int c, REAL2 v,
                      const REAL *x, global const REAL *points, const REAL *lower, const REAL *upper)
{
    const int last = starts[i + 1] - 1, most = min(starts[size], MOST_AROUND);
    const REAL2 one = face_direction(neighbors[c], x, points);
    const REAL2 other = face_direction(neighbors[c > starts[i] ? c - 1 : last], x, points);
    const REAL turn = dot(one, other);
    if (turn > 0 || turn * turn < R(0.49) * dot(one, one) * dot(other, other))
        return false;
    int cell = i, at = c, count = 1;
    bool back = false;
    while (count < most && walk_on(size, starts, neighbors, i, c, &cell, &at, &back))
        ++count;
    if (count < MANY_AROUND)
        return false;
    cell = i;
    at = c;
    back = false;
    for (int steps = 0; steps < count && walk_on(size, starts, neighbors, i, c, &cell, &at, &back); ++steps) {
        const int before = neighbors[at > starts[cell] ? at - 1 : starts[cell + 1] - 1];
        const REAL2 gap = corner_gap(v, i, cell, before, neighbors[at], points, lower, upper);
        if (!(dot(gap, gap) <= MOST_SPREAD * MOST_SPREAD))
            return true;
    }
    return false;
}

/* Per new cell, if some cells are doubtful: check that its area is positive, and that its faces lie where its neighbors
   have them, if one of the two is doubtful. Two cells that dropped different faces may differ by no more than the
   round-off of the box and a share of the cell; otherwise too many faces were dropped, and a flag is set. Crossing
   faces are flagged, too: they are short compared with the distance of their corners from the generators. */
kernel void check_doubtful(const int size, global const int *places, global const int *slot_counts,
                           global const int *starts, global const int *neighbors, global const REAL *volumes,
                           global const REAL *points, const REAL4 box_lower, const REAL4 box_upper, const REAL share,
                           global int *report)
{
    WORK_ITEM(i);
    if (places[i] < 0)
        return;
    SITE(x, i, points);
    BOX_CORNERS(lower, upper);
    global const int *row = neighbors + starts[i];
    const int n = starts[i + 1] - starts[i];
    if (n == 0)
        return;
    const REAL least = fmin(512 * REAL_EPS, share * volumes[i]);
    const REAL noise2 = report[REPORT_WHOLE] ? 16 * REAL_EPS * REAL_EPS : 0;
    bool right = volumes[i] > 0;
    const bool doubtful = slot_counts[places[i]] < 0;
    bool any = doubtful;
    for (int k = 0; k < n && !any; ++k)
        any = row[k] >= 0 && row[k] < size && places[row[k]] >= 0 && slot_counts[places[row[k]]] < 0;
    if (!any)
        return;
    REAL2 v = corner(i, x, row[n - 1], row[0], points, lower, upper);
    /* PoCL 6 with LLVM 18 crashes on `right = right && ...` in this loop. */
    for (int k = 0; k < n; ++k) {
        const int j = row[k], before = row[k == 0 ? n - 1 : k - 1], after = row[k == n - 1 ? 0 : k + 1];
        const REAL2 u = v;
        v = corner(i, x, j, after, points, lower, upper);
        if (j < 0) {
            /* Opposite walls never meet: the faces between them were lost. */
            if (after < 0 && (-1 - j) / 2 == (-1 - after) / 2)
                right = false;
            continue;
        }
        if (j >= size)
            continue;
        /* Corner k. If no face was dropped, there is nothing to check. */
        if (doubtful && !report[REPORT_WHOLE] &&
            is_spread(size, starts, neighbors, i, starts[i] + k, u, x, points, lower, upper))
            right = false;
        const REAL2 e = v - u;
        if (dot(e, e) < R(1e-4) * fmax(dot(u, u), dot(v, v)) && is_loop(size, starts, neighbors, i, starts[i] + k))
            atomic_or(report, FLAG_LOOPED);
        global const int *other = neighbors + starts[j];
        const int m = starts[j + 1] - starts[j];
        const int q = place_in_row(other, m, i);
        if (q == m) {
            right = false;
            continue;
        }
        const int p = other[q == 0 ? m - 1 : q - 1], s = other[q == m - 1 ? 0 : q + 1];
        /* The area is at most the gap times the distance of the farther corner. If no face was dropped, a gap
           within round-off does not count. */
        const REAL reach2 = fmax(dot(u, u), dot(v, v));
        if (p != after) {
            const REAL2 gap = corner_gap(v, i, j, p, i, points, lower, upper);
            if (!(dot(gap, gap) <= fmax(least * least / reach2, noise2 * reach2)))
                right = false;
        }
        if (s != before) {
            const REAL2 gap = corner_gap(u, i, j, i, s, points, lower, upper);
            if (!(dot(gap, gap) <= fmax(least * least / reach2, noise2 * reach2)))
                right = false;
        }
    }
    if (!right)
        atomic_or(report, FLAG_COLLAPSED);
}

/* Per generator i, for a new graph: remove crossing faces from keep[its first slot ...]. Of two that cross both go, and
   the four cells share a vertex. counts[i] is the number of remaining faces. */
kernel void drop_loops(const int size, global const int *places, global const int *slot_counts,
                       global const int *starts, global const int *neighbors, global uint *keep, global int *counts,
                       global int *report)
{
    WORK_ITEM(i);
    const int place = places[i], listed = abs(slot_counts[place]);
    int face = starts[i], count = 0;
    for (int k = 0; k < listed; ++k) {
        const uint bit = 1u << (k % 32);
        if (!(keep[place + k / 32] & bit))
            continue;
        if (neighbors[face] >= 0 && is_loop(size, starts, neighbors, i, face))
            keep[place + k / 32] &= ~bit;
        else
            ++count;
        ++face;
    }
    counts[i] = count;
    if (TOO_FEW(count))
        atomic_or(report, FLAG_COLLAPSED);
}

/* The starts of n rows, and their neighbors if `whole`, to their place, once nothing is read from there any more. */
kernel void copy_graph(const int n, const int whole, const int ahead, const int room, global const int *report,
                       global const int *starts, global const int *neighbors, global int *starts_to,
                       global int *neighbors_to)
{
    const bool right = !ahead || are_right(report, room);
    const int rows = right ? n + 1 : 0, faces = right && whole ? starts[n] : 0;
    for (BLOCK_LOOP(i, rows))
        starts_to[i] = starts[i];
    for (BLOCK_LOOP(k, faces))
        neighbors_to[k] = neighbors[k];
}
