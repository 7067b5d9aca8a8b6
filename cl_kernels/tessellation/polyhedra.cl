#include "geometry/domain.h"
#include "tessellation/row_counts.h"
#include "tessellation/periodic/halo.h"
#include "tessellation/polyhedron_search.h"
#include "tessellation/cell_output.h"

inline REAL distance_between(global const REAL *points, int i, int j PERIOD_ARGS)
{
    const REAL dx = DIFFERENCE(0, points[STRIDE * i], points[STRIDE * j]);
    const REAL dy = DIFFERENCE(1, points[STRIDE * i + 1], points[STRIDE * j + 1]);
    const REAL dz = DIFFERENCE(2, points[STRIDE * i + 2], points[STRIDE * j + 2]);
    return sqrt(dx * dx + dy * dy + dz * dz);
}

/* Write the vertices as triples of the faces, which are numbered in the order of their places. */
inline void write_corners(const CELL *cell, global uchar4 *corners)
{
    for (int v = 0; v < cell->n; ++v) {
        const INDEX4 f = cell->faces[v];
        corners[v] = (uchar4)(face_number(cell, f.s0), face_number(cell, f.s1), face_number(cell, f.s2), 0);
    }
}

/* Moments of the cell, up to a factor: xx, yy, zz, and yz, zx, xy; see `clip_polyhedra`. They are summed on their own
   and without a square root, because a work-item of a GPU has few registers. */
inline void sum_second_moments(const CELL *cell, CELL_SPACE const INDEX *start, REAL4 *square, REAL4 *mixed)
{
    *square = *mixed = 0;
    for (int f = next_face(cell, 0); f < FACE_CAPACITY; f = next_face(cell, f + 1)) {
        const REAL4 plane = cell->planes[f];
        const REAL height = plane.s3 / (plane.s0 * plane.s0 + plane.s1 * plane.s1 + plane.s2 * plane.s2);
        const REAL4 a = vertex_at(cell, start[f]);
        int v = vertex_after(cell, start[f], f);
        REAL4 b = vertex_at(cell, v), of_square = 0, of_mixed = 0;
        for (v = vertex_after(cell, v, f); v != start[f]; v = vertex_after(cell, v, f)) {
            const REAL4 c = vertex_at(cell, v), s = a + b + c;
            const REAL weight = dot3(cross3(b - a, c - a), plane);
            of_square += weight * (a * a + b * b + c * c + s * s);
            of_mixed += weight * (a.yzxw * a.zxyw + b.yzxw * b.zxyw + c.yzxw * c.zxyw + s.yzxw * s.zxyw);
            b = c;
        }
        *square += height * of_square;
        *mixed += height * of_mixed;
    }
}

#ifdef HALO
/* Test the balls around the vertices of the cell of generator i. */
inline void check_cell_balls(const CELL *cell, int i, REAL4 place, const halo_t *halo)
{
    const REAL x[3] = {place.s0, place.s1, place.s2};
    const REAL widest = widest_ball(halo) * ball_radius(cell->reach2, place.s3, halo);
    const int count = reaches_beyond(x, sqrt(cell->reach2) + widest, halo) ? cell->n : 0;
    for (int v = 0; v < count; ++v) {
        const INDEX4 f = cell->faces[v];
        const REAL4 ways[3] = {cell->planes[f.s0], cell->planes[f.s1], cell->planes[f.s2]};
        const int labels[3] = {cell->labels[f.s0], cell->labels[f.s1], cell->labels[f.s2]};
        check_vertex_ball(x, place.s3, i, vertex_at(cell, v), ways, labels, halo);
    }
}
#endif

#ifdef WEIGHTED
/* Cells of a power diagram may be empty. */
#define TOO_FEW(count) ((count) < 4 && (count) > 0)
#define CLIP_BOUND_ARGS BOUND_ARGS
#define CLIP_BOUNDS BOUNDS
#else
#define TOO_FEW(count) ((count) < 4)
#define CLIP_BOUND_ARGS
#define CLIP_BOUNDS
#endif

/* Whether planes of its own cut the cell. Neighbors then may differ about common faces, which must be matched. */
inline bool has_own_planes(const CELL *cell)
{
    bool found = false;
    for (int f = next_face(cell, 0); WALLS_MOVE && f < FACE_CAPACITY; f = next_face(cell, f + 1))
        found |= cell->labels[f] < 0;
    return found;
}

/* A cell without faces. */
inline void write_empty_cell(int i, global int *row_places, global int *row_counts, global REAL *volumes,
                             global REAL *offsets, global REAL *covariances)
{
    row_places[i] = row_counts[i] = 0;
    volumes[i] = 0;
    EACH_AXIS (a)
        offsets[3 * i + a] = covariances[6 * i + a] = covariances[6 * i + 3 + a] = 0;
}

/* The radius that the search of a cell must cover, for its present vertices. */
inline REAL needed_radius(const CELL *cell, REAL4 x CLIP_BOUND_ARGS)
{
#ifdef WEIGHTED
    const REAL at[3] = {x.s0, x.s1, x.s2};
    return cell->n ? search_radius(at, x.s3, cell->reach2 BOUNDS) * (1 + 8 * REAL_EPS) : 0;
#else
    return 2 * sqrt(cell->reach2) * (1 + 8 * REAL_EPS);
#endif
}

/* Per item p in bin order: the cell of generator i = items[p], its faces and its measures.

   V_i = { y in the box : |y - x_i| <= |y - x_j| for all j } (the paper's 2.1), by clipping the box with one bisector
   after the other. A generator farther than twice the farthest vertex cannot cut, so the search widens until the
   searched cube of bins covers that ball. In a power diagram (the paper's 2.5) see `search_radius`. reach[p] is the
   first guess of the radius, and then the radius. With `warm` the cell is first clipped by the neighbors of an earlier,
   similar diagram, and the search only has to confirm them. Only the first `rows` generators get cells; in a periodic
   box the balls around their vertices are tested.

   A face is a fan of triangles (A, B, C), and each with x_i a tetrahedron of volume V = A . (B x C) / 6, centroid
   S / 4 with S = A + B + C, second moments V (A A + B B + C C + S S) / 20. */
kernel void clip_polyhedra(const int size, const int rows, global const REAL *binned, global const int *items,
                           global float *reach, BIN_ARGS, global const REAL *points, CLIP_BOX_ARGS, const int warm,
                           global const int *old_starts, global const int *old_neighbors, const int again,
                           const int room, const REAL share, CELL_OUTPUT_ARGS CELL_ARGS HALO_ARGS CLIP_BOUND_ARGS)
{
    LONG_ITEM(k);
    TAKE_CELL(cell, k);
    const search_t in = {points, binned, items, bins, grid_frames, grid_shapes};
    EACH_CELL (p, k) {
        const int i = items[p];
        if (i >= rows || (again && row_counts[i] != UNFINISHED))
            continue;
        const REAL4 x = SITE_IN_SPACE(binned, p);
        int flag = flag_of(start_cell(cell, i, x, points, CLIP_BOX));
        REAL w = fmax(reach[p], FLT_MIN), inner = -1; /* a radius of 0 would never widen */
        if (warm && flag == 0) {
            flag = flag_of(clip_polyhedron_by_row(cell, i, x, old_starts, old_neighbors, points));
            w = needed_radius(cell, x CLIP_BOUNDS);
        }
        while (flag == 0) {
#ifdef WEIGHTED
            /* The outermost bins extend beyond the cube. */
            const REAL at[3] = {x.s0, x.s1, x.s2};
            cell->most = weight_within(at, w + 1 / FRAME_INVERSE(grid_frames[0]) BOUNDS) - x.s3;
#endif
            flag = clip_cell_by_bins(cell, x, p, w, inner, warm, &in);
            const REAL need = needed_radius(cell, x CLIP_BOUNDS);
            if (!(need > w)) /* a NaN ends the loop, too */
                break;
            inner = w;
            w = need < 4 * w ? need : 2 * w;
        }
        const own_t own = OWN_OF(i);
        flag = flag == 0 && !knows_walls(i, cell->reach2, &own) ? FLAG_UNKNOWN : flag;
        if (flag != 0) {
            atomic_or(report, flag);
            row_counts[i] = flag == FLAG_FULL || flag == FLAG_UNKNOWN ? UNFINISHED : 0;
            continue;
        }
#ifdef WEIGHTED
        if (cell->n == 0) {
            write_empty_cell(i, row_places, row_counts, volumes, offsets, covariances);
            if (cell->torn)
                atomic_or(report, FLAG_DOUBT);
            continue;
        }
#endif

        reach[p] = (float)(2 * sqrt(cell->reach2) * (1 + 8 * REAL_EPS));
#ifdef HALO
        MAKE_HALO;
        if (i < halo.own)
            check_cell_balls(cell, i, x, &halo);
#endif

        CELL_SPACE const INDEX *start = face_starts(cell);
        const int face_count = cell->n / 2 + 2; /* Euler's formula */
        const int place = take_places(report, face_count);
        const bool fits = place + face_count <= room;
        const REAL reach_length = sqrt(cell->reach2), near2 = sqrt(REAL_EPS) * cell->reach2;
        const REAL slim = 512 * noise_length(reach_length);
        int count = 0;
        bool doubtful = cell->torn, narrow = false;
        REAL volume = 0, lost = 0;
        REAL4 first = 0; /* moments x, y, z */
        for (int f = next_face(cell, 0); f < FACE_CAPACITY; f = next_face(cell, f + 1)) {
            const REAL4 plane = cell->planes[f];
            const REAL d2 = plane.s0 * plane.s0 + plane.s1 * plane.s1 + plane.s2 * plane.s2;
            const REAL inverse = 1 / sqrt(d2);
            const REAL4 normal = plane * inverse; /* and its distance */
            const int first_vertex = start[f];
            const REAL4 a = vertex_at(cell, first_vertex);
            int v = vertex_after(cell, first_vertex, f);
            REAL4 b = vertex_at(cell, v);
            REAL area = 0;
            REAL4 face_first = 0;
            for (v = vertex_after(cell, v, f); v != first_vertex; v = vertex_after(cell, v, f)) {
                const REAL4 c = vertex_at(cell, v);
                const REAL weight = dot3(cross3(b - a, c - a), normal);
                area += weight;
                face_first += weight * (a + b + c);
                b = c;
            }
            volume += normal.s3 * area;
            first += normal.s3 * face_first;
            const int label = cell->labels[f];
            /* Faces below round-off are dropped. Faces so small that a neighbor might drop them are doubtful. */
            const REAL across2 = label >= 0 ? d2 : cell->reach2;
            const bool small = !(area > sqrt(REAL_EPS) * across2);
            if (small || !(area > slim * reach_length)) {
                REAL width2 = 0;
                for (v = vertex_after(cell, first_vertex, f); v != first_vertex; v = vertex_after(cell, v, f)) {
                    const REAL4 e = vertex_at(cell, v) - a;
                    width2 = fmax(width2, dot3(e, e));
                }
                doubtful |= small && label >= 0;
                if (!(area > 16 * noise_length(sqrt(across2)) * sqrt(width2))) {
                    lost += fabs(normal.s3 * area);
                    continue;
                }
                narrow |= !(area > slim / 2 * sqrt(width2));
            }
            doubtful |= across2 < near2;
            if (fits)
                write_face(place + count, label, area, face_first, labels, measures, centroids);
            ++count;
        }
#ifdef WEIGHTED
        if (count < 4) { /* no larger than round-off */
            write_empty_cell(i, row_places, row_counts, volumes, offsets, covariances);
            atomic_or(report, FLAG_DOUBT);
            continue;
        }
#endif
        row_places[i] = place;
        row_counts[i] = count;
        if (with_corners && fits) {
            const bool whole = count == face_count && count <= MOST_NUMBERED;
            const bool clear = whole && count <= MOST_FACES && !doubtful && !narrow;
            const int unclear = whole && with_corners == UNSURE_CORNERS ? UNSURE_CORNERS : NO_CORNERS;
            if (clear || unclear)
                write_corners(cell, corners + 2 * place);
            corners[2 * place].s3 = clear ? NEW_CORNERS : unclear;
        }
        doubtful |= has_own_planes(cell);
        if (doubtful || narrow)
            atomic_or(report, (doubtful ? FLAG_DOUBT : 0) | (narrow ? FLAG_NARROW : 0));
        flag_lost_faces(count, volume, lost, share, report);
        REAL4 square, mixed;
        sum_second_moments(cell, start, &square, &mixed);
        write_cell_moments(i, volume, first, square, mixed, volumes, offsets, covariances);
    }
}

/* The area that a face of cell i may have by round-off alone. The bisector of generators d apart is off by eps R / d at
   the distance R. Two bisectors with generators at the least distance d meet at an angle of about d / R, as in a ring.
   Their edge is off by eps R^2 / d^2 of R, and the area of a face along it by as much of R^2. The area of all faces
   replaces R^2. */
inline REAL rounded_area(int i, int begin, int count, global const int *labels, global const REAL *measures,
                         global const REAL *points PERIOD_ARGS)
{
    REAL surface = 0, least = INFINITY;
    for (int k = begin; k < begin + count; ++k) {
        surface += measures[k];
        if (labels[k] >= 0)
            least = fmin(least, distance_between(points, i, labels[k] PERIODS));
    }
    return surface * fmin(64 * REAL_EPS * surface / (least * least), sqrt(REAL_EPS));
}

/* Whether a wall cuts one of two cells with these rows. In a solid each cell has planes of its own, so that the cells
   need not agree about a face there. */
inline bool touches_walls(global const int *labels, int begin, int count, int other, int other_count)
{
    bool found = false;
    for (int k = begin; WALLS_MOVE && k < begin + count; ++k)
        found |= labels[k] < 0;
    for (int k = other; WALLS_MOVE && k < other + other_count; ++k)
        found |= labels[k] < 0;
    return found;
}

/* Per generator i: kept[k] of each of its faces, and the number kept. Where any cell is doubtful, round-off may let one
   of two cells have a face of zero area that the other does not have. Such a face is dropped, so that the graph is
   symmetric. The cell is flagged as collapsed if the face is wider than round-off explains, or if the areas of its
   faces and those of its neighbors differ by more than a share of the cell. In a power diagram cells may be so small
   that they are uncertain, as long as that is no more than the round-off of a neighbor. Faces of a neighbor without a
   row are not compared, nor are those of two certain cells, nor those at walls of a solid, where cells at a sharp tip
   may share three faces or fewer. In a diagram with ghost images the periods are 0. While cells are missing or wrong,
   this and the next two kernels do nothing. */
kernel void match_polyhedron_faces(const int size, global const int *row_places, global const int *row_counts,
                                   global const int *labels, global const REAL *measures, global const REAL *volumes,
                                   global const REAL *points, const REAL share, global uchar *kept, global int *counts,
                                   global int *report PERIOD_ARGS)
{
    LONG_ITEM(i);
    const int n = COUNT_OF(row_counts[i]);
    const bool certain = (row_counts[i] & CERTAIN) != 0;
    counts[i] = n;
    /* FLAG_COLLAPSED may be set meanwhile. */
    const int flags = report[REPORT_FLAGS];
    const bool known = !(flags & FLAG_FULL) && report[REPORT_UNFINISHED] == 0 && report[REPORT_MARKED] == 0;
    if (!known || !(flags & FLAG_DOUBT))
        return;
    int count = 0;
    REAL apart = 0; /* volume of the cones to the differences of areas */
    REAL most = share * volumes[i];
    for (int k = row_places[i]; k < row_places[i] + n; ++k) {
        const int j = labels[k];
        bool mutual = j < 0 || j >= size || (certain && (row_counts[j] & CERTAIN) != 0);
        if (!mutual) {
            const int m = COUNT_OF(row_counts[j]);
            global const int *row = labels + row_places[j];
            int q = 0;
            while (q < m && row[q] != i)
                ++q;
            mutual = q < m;
            if (touches_walls(labels, row_places[i], n, row_places[j], m)) {
                kept[k] = mutual;
                count += mutual;
                continue;
            }
            const REAL distance = distance_between(points, i, j PERIODS);
            const REAL other = mutual ? measures[row_places[j] + q] : 0;
            apart += fabs(measures[k] - other) * distance / 6;
            if (!mutual && !(measures[k] < fmax(2048 * REAL_EPS * distance,
                                                rounded_area(i, row_places[i], n, labels, measures, points PERIODS))))
                atomic_or(report, FLAG_COLLAPSED);
        }
        kept[k] = mutual;
        count += mutual;
#ifdef WEIGHTED
        most = fmax(most, j >= 0 && j < size ? 64 * REAL_EPS * volumes[j] : 0);
#endif
    }
    counts[i] = count;
    if ((TOO_FEW(count) && !touches_walls(labels, row_places[i], n, 0, 0)) || !(apart <= most))
        atomic_or(report, FLAG_COLLAPSED);
    else if (apart > EVEN_SHARE * volumes[i])
        atomic_or(report, FLAG_UNEVEN);
}

/* Per generator i: its faces, those kept, as row i of the graph; all if there is no doubt. There is room for `room`.

   neighbors, face_measures (m,), face_centroids (m, 3)  areas, and centroids relative to x_i */
kernel void place_faces(const int size, global const int *row_places, global const int *row_counts,
                        global const int *labels, global const REAL *measures, global const REAL *centroids,
                        global const uchar *kept, global const int *report, const int room, global const int *starts,
                        global int *neighbors, global FACE *face_measures, global FACE *face_centroids)
{
    WORK_ITEM(i);
    if (!are_complete(report) || report[REPORT_KEPT] > room)
        return;
    const bool doubt = (report[REPORT_FLAGS] & FLAG_DOUBT) != 0;
    const int n = COUNT_OF(row_counts[i]), from = row_places[i];
    int to = starts[i];
    for (int k = from; k < from + n; ++k) {
        if (doubt && !kept[k])
            continue;
        neighbors[to] = labels[k];
        face_measures[to] = measures[k];
        for (int axis = 0; axis < 3; ++axis)
            face_centroids[3 * to + axis] = centroids[3 * k + axis];
        ++to;
    }
}

/* Per generator i: copy its row of the new graph over the previous graph and, with `with_corners`, its triples and
   keys. There are none if faces were dropped. `keys` are those of KNOWN_CORNERS. */
kernel void put_rows(const int size, global const int *row_places, global const int *row_counts,
                     global const int *report, const int room, global const int *new_starts,
                     global const int *new_neighbors, const int with_corners, global const uchar4 *corners,
                     global const uint *keys, global int *starts, global int *neighbors, global uchar4 *new_corners,
                     global uint *new_keys)
{
    WORK_ITEM(i);
    if (!are_complete(report) || report[REPORT_KEPT] > room)
        return;
    const int to = new_starts[i], end = new_starts[i + 1], n = end - to;
    starts[i + 1] = end;
    if (i == 0)
        starts[0] = 0;
    for (int k = to; k < end; ++k)
        neighbors[k] = new_neighbors[k];
    if (!with_corners)
        return;
    const int from = row_places[i], state = COUNT_OF(row_counts[i]) == n ? corners[2 * from].s3 : NO_CORNERS;
    for (int v = 0; state != NO_CORNERS && v < 2 * n - 4; ++v)
        new_corners[2 * to + v] = corners[2 * from + v];
    for (int f = 0; state == KNOWN_CORNERS && f < n; ++f)
        new_keys[to + f] = keys[from + f];
    new_corners[2 * to].s3 = state;
}
