#include "tessellation/corner.h"
#include "tessellation/face_rows.h"

/* Incremental update: the diagram of generators that moved a little, from the previous diagram, without a search.

   The intersection C_i of the box and the half-planes of *some* generators contains the Voronoi cell V_i. If around
   every corner of C_i the cells that meet there name each other as neighbors, in the order of that corner, the C_i fit
   together without gap or overlap, hence cover the box once, and C_i = V_i for all i. So: take the neighbors of the
   previous diagram, check that every cell is still convex and consistent with its neighbors (`check_rows`), clip the
   others by all neighbors of their neighbors (`clip_marked`), check these (`check_clipped`), and repeat until all are
   consistent.

   In a periodic box, with the periods -DFOLD_0 and -DFOLD_1, neighbors are nearest images. Cells without
   gaps might cover the box more than once; then the sum of their volumes is too large. A sphere is simply connected:
   connected cells without gaps cover it once. */

/* Cells with more faces are clipped again in each step: they are rare and would delay their work-group. */
#define CHECKED_FACES 16

/* Whether a gap between corners, given by its square, is within their round-off. d2 is the squared distance of the
   generators across the face. In single precision a spacing may be only a thousand roundings of a position, and a
   corner is less accurate. */
inline bool is_rounding(REAL gap2, REAL d2)
{
    return gap2 <= 16 * POSITION_NOISE * POSITION_NOISE && gap2 <= (IS_DOUBLE ? R(1e-6) : R(1e-4)) * d2;
}

/* Whether i stands between `before` and `after` in a row of n. */
inline bool stands_between(int i, int before, int after, global const int *row, int n)
{
    const int q = place_in_row(row, n, i);
    return q < n && row[q == 0 ? n - 1 : q - 1] == before && row[q == n - 1 ? 0 : q + 1] == after;
}

/* Whether cells i and j have their common face between the same two corners. In the row of i, j stands between `before`
   and `after`, at corners u and v. So in the row of j, i must stand between `after` and `before`, or between faces that
   meet it at the same corners up to round-off. */
inline bool fits_neighbor(int i, int j, int before, int after, REAL2 u, REAL2 v, REAL d2, global const int *row, int n,
                          global const REAL *points, const REAL *lower, const REAL *upper)
{
    const int q = place_in_row(row, n, i);
    if (q == n) {
        /* A face of zero length, which makes i doubtful, will be dropped. */
        const REAL2 e = v - u;
        return is_rounding(dot(e, e), d2);
    }
    const int p = row[q == 0 ? n - 1 : q - 1], s = row[q == n - 1 ? 0 : q + 1];
    /* Where four or more cells share a vertex, cells may drop different faces of zero length. */
    bool fits = true;
    if (p != after) {
        const REAL2 gap = corner_gap(v, i, j, p, i, points, lower, upper);
        fits = is_rounding(dot(gap, gap), d2);
    }
    if (fits && s != before) {
        const REAL2 gap = corner_gap(u, i, j, i, s, points, lower, upper);
        fits = is_rounding(dot(gap, gap), d2);
    }
    return fits;
}

/* The corner of cell i between the faces a and b (in this order) with the directions u and v. The same as `corner`, but
   uses the known directions where both faces belong to generators. */
inline REAL2 row_corner(int i, const REAL *x, int a, int b, REAL2 u, REAL2 v, global const REAL *points,
                        const REAL *lower, const REAL *upper)
{
    if (a < 0 || b < 0)
        return corner(i, x, a, b, points, lower, upper);
    const REAL2 w = v - u;
    const REAL u2 = dot(u, u), w2 = dot(w, w);
    return w2 > R(1e-3) * u2 ? circumcenter(u, v, u2, dot(v, v)) : corner(i, x, a, b, points, lower, upper);
}

/* Check the row of generator i; see `check_rows`. True if it is wrong. */
inline bool check_row(int i, global const int *starts, global const int *neighbors, global const REAL *points,
                      const REAL *lower, const REAL *upper, global int *fits, global int *marks)
{
    SITE(x, i, points);
    const int start = starts[i], n = starts[i + 1] - start;
    global const int *row = neighbors + start;
    if (n > CHECKED_FACES) {
        atomic_or(marks + i, 1);
        return true;
    }
    /* Face k, its direction, and the corners u before it and v behind it; face `before` lies before it. */
    int before = row[n - 1], face = row[0];
    REAL2 d = face_direction(face, x, points);
    REAL2 u = row_corner(i, x, before, face, face_direction(before, x, points), d, points, lower, upper);
    REAL reach2 = 0, least2 = REAL_MAX;
    int turns = 0;
    bool bad = false, fit = true;
    const bool known = fits[i];
    for (int k = 0; k < n; ++k) {
        const int after = row[k == n - 1 ? 0 : k + 1];
        const REAL2 d_after = face_direction(after, x, points);
        const REAL2 v = row_corner(i, x, face, after, d, d_after, points, lower, upper);
        const REAL2 e = v - u;
        const REAL r2 = dot(v, v);
        reach2 = fmax(reach2, r2);
        turns += d.s1 < 0 && d_after.s1 >= 0;
        const REAL d2 = face >= 0 ? dot(d, d) : r2;
        bool good =
            d.s0 * d_after.s1 - d.s1 * d_after.s0 > 0 && d.s0 * e.s1 - d.s1 * e.s0 > 0 && dot(e, e) >= REAL_EPS * d2;
        if (face >= 0) {
            least2 = fmin(least2, d2);
            if (!known) {
                const int other = starts[face], m = starts[face + 1] - other;
                const bool exact = stands_between(i, after, before, neighbors + other, m);
                good = good && (exact || fits_neighbor(i, face, before, after, u, v, d2, neighbors + other, m, points,
                                                       lower, upper));
                fit = fit && exact;
            }
        }
        if (!good) {
            bad = true;
            if (before >= 0)
                atomic_or(marks + before, 1);
            if (face >= 0)
                atomic_or(marks + face, 1);
            if (after >= 0)
                atomic_or(marks + after, 1);
        }
        before = face;
        face = after;
        d = d_after;
        u = v;
    }
    bad |= turns != 1 || least2 < sqrt(REAL_EPS) * reach2;
    if (bad)
        atomic_or(marks + i, 1);
    if (!known)
        fits[i] = fit;
    return bad;
}

#if IN_LANES
#include "simd/marked_cells.h"
#include "simd/row_checks.h"
#endif

/* Per generator i: set marks[i], and the mark of the neighbor at the face in question, where the previous neighbors no
   longer enclose a cell with all faces longer than round-off, or where the rows are inconsistent. Marks start at 0;
   several work-items may write the same 1. fits[i] records that the rows are consistent, so that only changed rows are
   looked up.

   With LANES a work-item checks LANES generators. Only one work-item in `stride` runs and counts wrong rows in
   report[REPORT_WRONG]; with `rest`, the others run unless these were more than `most_wrong`. */
kernel void check_rows(const int size, const int stride, const int rest, const int most_wrong, global const int *starts,
                       global const int *neighbors, global const REAL *points, const REAL4 box_lower,
                       const REAL4 box_upper, global int *fits, global int *marks, global int *report)
{
    BOX_CORNERS(lower, upper);
    if (rest && report[REPORT_WRONG] > most_wrong)
        return;
    const int id = get_global_id(0);
    const int item = rest ? id + id / (stride - 1) + 1 : id * stride;
#if IN_LANES
    if (item * LANES >= size)
        return;
    const int found = check_eight(item * LANES, size, starts, neighbors, points, lower, upper, fits, marks);
#else
    if (item >= size)
        return;
    const int found = check_row(item, starts, neighbors, points, lower, upper, fits, marks);
#endif
    if (found)
        atomic_or(report + REPORT_MARKED, 1);
    if (found && stride > 1 && !rest)
        atomic_add(report + REPORT_WRONG, found);
}

/* Per generator i: an empty mark, and no new row. The report is reset, with the spare slots from `first_spare` on. */
kernel void begin_update(const int size, global int *marks, global int *places, global int *report,
                         const int report_size, const int first_spare, const int slot_count)
{
    WORK_ITEM(i);
    SHORT_LOOP
    for (int f = 0; i == 0 && f < report_size; ++f)
        report[f] = f == REPORT_SPARE ? first_spare : f == REPORT_SLOTS ? slot_count : 0;
    marks[i] = 0;
    places[i] = -1;
}

/* Rounds are enqueued before the host knows how many cells are marked. The number of cells clipped in a round is 0 if
   no cell is marked, or if more are than have been launched or may be clipped. */
inline int count_of_round(int round, global const int *report)
{
    return report[REPORT_LISTED + round + 1] - report[REPORT_LISTED + round];
}

/* Per generator i: list it if it is marked; sums are the exclusive prefix sums of the marks. `most` is the largest
   number of cells to clip in this round, `most_in_all` in all rounds; nothing is done if a sample has more than
   `most_wrong` wrong rows. */
kernel void list_marked(const int size, const int round, const int most, const int most_in_all, const int most_wrong,
                        global const int *marks, global const int *sums, global int *listed, global int *report)
{
    WORK_ITEM(i);
    if (i > 0 && !marks[i])
        return;
    const int base = report[REPORT_LISTED + round], count = sums[size];
    const bool over = count > most || base + count > most_in_all || report[REPORT_WRONG] > most_wrong;
    if (i == 0) {
        report[REPORT_LISTED + round + 1] = over ? base : base + count;
        report[REPORT_UNFINISHED] = 0;
    }
    if (!over && marks[i])
        listed[sums[i]] = i;
}

/* Clip by those generators of row i that are near enough. */
inline int clip_polygon_by_row(cell_t *cell, const REAL *x, global const int *row, int n, global const REAL *points)
{
    for (int k = 0; k < n; ++k) {
        const int j = row[k];
        if (j < 0 || j == cell->generator)
            continue;
        const REAL2 way = direction_of(x, j, points);
        const REAL d[2] = {way.s0, way.s1};
        const REAL d2 = d[0] * d[0] + d[1] * d[1];
        if (d2 >= cutting_distance2(cell))
            continue;
        if (d2 == 0)
            return FLAG_COINCIDE;
        if (!clip_polygon(cell, d, d2, j, true, points))
            return FLAG_FULL;
    }
    return 0;
}

#if IN_LANES
/* Per LANES listed generators of the first round, if there are at least `few`: their cells from a few candidates, in
   slots from 0 on; slot_counts[w] = 0 where a cell remains to be clipped. */
kernel void wrap_marked(const int size, const int few, global const int *report, global const int *listed,
                        global const int *places, global int *slots, global int *slot_counts,
                        global const int *old_starts, global const int *old_neighbors, global const REAL *points,
                        const REAL4 box_lower, const REAL4 box_upper)
{
    WORK_ITEM(group);
    const int count = count_of_round(0, report);
    if (count < few || group * LANES >= count)
        return;
    const face_rows_t rows = face_rows(places, slots, slot_counts, old_starts, old_neighbors);
    wrap_eight(group * LANES, count, listed, &rows, points, box_lower, box_upper, slots, slot_counts);
}
#endif

/* Per listed generator w: its cell, clipped by its neighbors and their neighbors, in slot base + w. With at least
   `wrapped_from` generators rows with faces are complete. */
kernel void clip_marked(const int size, global const int *listed, const int round, const int wrapped_from,
                        global const int *places, global int *slots, global int *slot_counts,
                        global const int *old_starts, global const int *old_neighbors, global const REAL *points,
                        const REAL4 box_lower, const REAL4 box_upper, global int *fits, global int *report)
{
    LONG_ITEM(w);
    const int count = count_of_round(round, report);
    if (w >= count)
        return;
    const int i = listed[w], base = report[REPORT_LISTED + round];
    if (count >= wrapped_from && slot_counts[base + w] > 0)
        return;
    SITE(x, i, points);
    BOX_CORNERS(lower, upper);
    const face_rows_t rows = face_rows(places, slots, slot_counts, old_starts, old_neighbors);
    cell_t cell;
    start_polygon(&cell, i, x, lower, upper);
    int n, m;
    global const int *row = face_row(&rows, i, &n);
    int flag = clip_polygon_by_row(&cell, x, row, n, points);
    for (int k = 0; k < n && flag == 0; ++k)
        if (row[k] >= 0) {
            global const int *other = face_row(&rows, row[k], &m);
            flag = clip_polygon_by_row(&cell, x, other, m, points);
        }
#ifdef FOLD_0
    /* A periodic axis has no wall: a cell with one has lost its neighbors. */
    for (int k = 0; k < cell.n; ++k)
        if (cell.faces[k] < 0 && FOLD((-1 - cell.faces[k]) / 2) > 0)
            flag = FLAG_FULL;
#endif
    const int to = store_cell(&cell, flag, x, points, base + w, slots, slot_counts, report),
              faces = abs(slot_counts[to]);
    if (places[i] < 0)
        return;
    /* A cell that is clipped again may lose neighbors that were consistent with it. */
    for (int k = 0; k < n; ++k)
        if (row[k] >= 0 && place_in_row(slots + to * SLOT, faces, row[k]) == faces)
            atomic_and(fits + row[k], 0);
}

/* Per listed generator: replace its old row by the new one, which is consistent until a neighbor finds otherwise. No
   cell is marked any more. */
kernel void place_clipped(const int size, global const int *listed, const int round, global int *report,
                          global const int *slots, global const int *slot_counts, global int *places, global int *marks,
                          global int *fits)
{
    WORK_ITEM(w);
    if (w >= count_of_round(round, report))
        return;
    if (w == 0)
        report[REPORT_MARKED] = 0;
    const int place = report[REPORT_LISTED + round] + w;
    places[listed[w]] = slot_counts[place] == ELSEWHERE ? slots[place * SLOT] : place;
    marks[listed[w]] = 0;
    fits[listed[w]] = 1;
}

inline void mark_both(int i, int j, global int *marks, global int *report)
{
    atomic_or(marks + i, 1);
    atomic_or(marks + j, 1);
    atomic_or(report + REPORT_MARKED, 1);
}

/* Per listed generator: mark it and its neighbors where they are inconsistent. Cells that were not clipped have been
   checked against each other before. */
kernel void check_clipped(const int size, global const int *listed, const int round, global int *report,
                          global const int *places, global const int *slots, global const int *slot_counts,
                          global const int *old_starts, global const int *old_neighbors, global const REAL *points,
                          const REAL4 box_lower, const REAL4 box_upper, global int *marks, global int *fits)
{
    LONG_ITEM(w);
    if (w >= count_of_round(round, report))
        return;
    const int i = listed[w];
    SITE(x, i, points);
    BOX_CORNERS(lower, upper);
    const face_rows_t rows = face_rows(places, slots, slot_counts, old_starts, old_neighbors);
    int n, m;
    global const int *row = face_row(&rows, i, &n);
    for (int k = 0; k < n; ++k) {
        const int j = row[k], a = row[k == 0 ? n - 1 : k - 1], b = row[k == n - 1 ? 0 : k + 1];
        if (j < 0)
            continue;
        global const int *other = face_row(&rows, j, &m);
        if (stands_between(i, b, a, other, m))
            continue;
        atomic_and(fits + i, 0);
        atomic_and(fits + j, 0);
        const REAL2 u = corner(i, x, a, j, points, lower, upper), v = corner(i, x, j, b, points, lower, upper);
        const REAL2 d = face_direction(j, x, points);
        if (!fits_neighbor(i, j, a, b, u, v, dot(d, d), other, m, points, lower, upper))
            mark_both(i, j, marks, report);
    }
    /* Neighbors of the previous row are marked, too: they may still list i. */
    const int end = old_starts[i + 1];
    for (int k = old_starts[i]; k < end; ++k) {
        const int j = old_neighbors[k];
        if (j < 0)
            continue;
        if (place_in_row(row, n, j) < n)
            continue;
        global const int *other = face_row(&rows, j, &m);
        if (place_in_row(other, m, i) == m)
            continue;
        atomic_and(fits + j, 0);
        if (!is_doubtful_row(&rows, j)) /* else its faces are matched with those of its neighbors */
            mark_both(i, j, marks, report);
    }
}
