/* The rows of a diagram in the order of labels, and the measures of its cells in this order. They do not depend on the
   numbers of generators, nor on the order in which cells were clipped: parts of a domain that have the same cell have
   the same bits.

   In 2D a row, which runs counter-clockwise, begins with the least label. In 3D labels ascend; vertices are triples of
   faces that begin with the least one, in ascending order. Walls come first. One work-item per generator.

   reach[i] is the distance of the farthest corner of cell i from its generator, or a bound of it. */
#include "geometry/site.h"
#include "tessellation/report.h"

/* The label of a neighbor; that of a wall is negative. */
inline int label_of(int row, global const int *labels)
{
    return row < 0 ? row : labels[row];
}

#if CELL_DIM == 2
#include "tessellation/corner.h"

#include "tessellation/measures.h"

#if IN_LANES
#include "simd/cell_measures.h"
#endif

/* The row of generator i from its least label on. Returns its length. */
inline int turn_row(int *faces, int i, global const int *starts, global const int *neighbors, global const int *labels)
{
    const int begin = starts[i], n = starts[i + 1] - begin;
    int first = 0;
    for (int k = 1; k < n; ++k)
        first = label_of(neighbors[begin + k], labels) < label_of(neighbors[begin + first], labels) ? k : first;
    for (int k = 0; k < n; ++k)
        faces[k] = neighbors[begin + (first + k < n ? first + k : first + k - n)];
    return n;
}

/* With IN_LANES, each work-item takes LANES generators. */
kernel void order_rows(const int size, global const int *starts, global int *neighbors, global const int *labels,
                       global const REAL *points, const REAL4 box_lower, const REAL4 box_upper,
                       global FACE *face_measures, global FACE *face_centroids, global REAL *volumes,
                       global REAL *offsets, global REAL *covariances, global float *reach)
{
    LONG_ITEM(item);
    BOX_CORNERS(lower, upper);
    const measures_t to = {starts, neighbors, face_measures, face_centroids, volumes, offsets, covariances, reach};
    int faces[ROW_CAPACITY];
#if IN_LANES
    const int first = item * LANES;
    for (int i = first; i < min(first + LANES, size); ++i) {
        const int n = turn_row(faces, i, starts, neighbors, labels);
        for (int k = 0; k < n; ++k)
            neighbors[starts[i] + k] = faces[k];
    }
    const face_rows_t rows = {0, 0, 0, starts, neighbors};
    if (first < size)
        measure_eight(&to, first, size, &rows, 0, points, lower, upper);
#else
    const int n = turn_row(faces, item, starts, neighbors, labels);
    measure_cell(&to, item, faces, n, points, lower, upper);
#endif
}
#else
#include "tessellation/cell_space.h"

#include "tessellation/update_rows.h"

#include "tessellation/corner_sums.h"

/* A cell, sums over its vertices, the new numbers of its faces, and its triples. */
typedef struct {
    corners_t body;
    sums_t sums;
    int place[MOST_FACES], triples[MOST_CORNERS];
} cell_t;

#ifdef CELL_BYTES
typedef char CELL_BYTES_suffice[sizeof(cell_t) <= CELL_BYTES ? 1 : -1];
#endif

/* A triple of faces as one number, from the least face on. */
inline int triple_of(int a, int b, int c)
{
    const int from_a = a << 16 | b << 8 | c, from_b = b << 16 | c << 8 | a, from_c = c << 16 | a << 8 | b;
    return min(from_a, min(from_b, from_c));
}

#ifndef LEAST_FACES
#define LEAST_FACES 0
#endif

/* Whether the row of a cell with n faces and its triples are in order. Then `update_cells` has measured it so. */
inline bool is_in_order(int begin, int n, global const int *neighbors, global const int *labels,
                        global const uchar4 *corners)
{
    bool in_order = true;
    for (int f = 1; f < n; ++f)
        in_order &= label_of(neighbors[begin + f - 1], labels) < label_of(neighbors[begin + f], labels);
    for (int v = 0, last = -1; v < 2 * n - 4; ++v) {
        const uchar4 at = corners[2 * begin + v];
        const int triple = at.s0 << 16 | at.s1 << 8 | at.s2;
        in_order &= triple > last && triple == triple_of(at.s0, at.s1, at.s2);
        last = triple;
    }
    return in_order;
}

/* Largest relative difference of the volumes of a cell by both measurements. */
#define ALIKE (IS_DOUBLE ? R(1e-8) : R(1e-4))

/* Cells of which a face or a vertex is not known because of round-off stay as they are. Those with more faces than are
   updated are ordered in a second launch, of a kernel with -DCELL_BYTES=bytes of `cell_t` for them only. */
kernel void order_rows(const int size, global const int *starts, global int *neighbors, global const int *labels,
                       global const REAL *points, CLIP_BOX_ARGS, global uchar4 *corners, global uint *keys,
                       global REAL *face_measures, global REAL *face_centroids, global REAL *volumes,
                       global REAL *offsets, global REAL *covariances, global float *reach PERIOD_ARGS CELL_ARGS)
{
    LONG_ITEM(k);
    TAKE_CELL(cell, k);
    EACH_CELL (i, k) {
        const int begin = starts[i], n = starts[i + 1] - begin;
        if (n < LEAST_FACES)
            continue;
        const int state = n > MOST_FACES ? NO_CORNERS : corners[2 * begin].s3;
        if (state == KNOWN_CORNERS && is_in_order(begin, n, neighbors, labels, corners))
            continue;
        /* No corner of a convex body is farther from its centroid than sqrt(d (d + 2)) standard deviations. */
        REAL offset2 = 0;
        EACH_AXIS (a)
            offset2 += offsets[3 * i + a] * offsets[3 * i + a];
        reach[i] =
            (float)(sqrt(offset2) + sqrt(15 * (covariances[6 * i] + covariances[6 * i + 3] + covariances[6 * i + 5])));
        if (state == NO_CORNERS)
            continue;
        const rows_t in = {starts, neighbors, 0, points, box_lower, box_upper PERIODS, OWN_OF(i)};
        const REAL4 x = (REAL4)(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0);
        CORNERS *body = &cell->body;
        SUMS *sums = &cell->sums;
        CELL_SPACE int *place = cell->place, *triples = cell->triples;
        body->faces = n;
        body->corners = 2 * n - 4;
        for (int f = 0; f < n; ++f) {
            const int label = label_of(neighbors[begin + f], labels);
            place[f] = 0;
            for (int g = 0; g < n; ++g)
                place[f] += label_of(neighbors[begin + g], labels) < label;
            body->labels[place[f]] = neighbors[begin + f];
            body->planes[place[f]] = plane_of_face(neighbors[begin + f], x, &in);
        }
        pad_planes(body);
        for (int v = 0; v < body->corners; ++v) {
            const uchar4 at = corners[2 * begin + v];
            const int triple = triple_of(place[at.s0], place[at.s1], place[at.s2]);
            int to = v;
            for (; to > 0 && triples[to - 1] > triple; --to)
                triples[to] = triples[to - 1];
            triples[to] = triple;
        }
        for (int v = 0; v < body->corners; ++v)
            body->at[v] = (uchar4)(triples[v] >> 16, triples[v] >> 8 & 255, triples[v] & 255, 0);
        const bool fits = place_corners(body, sums, true) && fits_corners(body);
        const bool clear = fits && state != UNSURE_CORNERS;
        REAL volume = 0;
        for (int f = 0; f < n; ++f)
            volume += body->planes[f].s3 * sums->faces[f].s0 / 24;
        if (!(fabs(volume - volumes[i]) <= ALIKE * volumes[i]))
            continue;
        if (fits)
            reach[i] = (float)sqrt(body->reach2);
        const measured_t out = {neighbors, face_measures, face_centroids, volumes, offsets, covariances};
        write_measures(body, sums, i, begin, &out);
        write_triples(body, corners + 2 * begin, !clear ? NO_CORNERS : state == KNOWN_CORNERS ? state : NEW_CORNERS);
        if (state == KNOWN_CORNERS) {
            CELL_SPACE uint *moved = (CELL_SPACE uint *)triples;
            for (int f = 0; f < n; ++f)
                moved[place[f]] = keys[begin + f];
            for (int f = 0; f < n; ++f)
                keys[begin + f] = moved[f];
        }
    }
}
#endif
