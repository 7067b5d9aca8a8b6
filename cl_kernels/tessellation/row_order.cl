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

kernel void order_rows(const int size, global const int *starts, global int *neighbors, global const int *labels,
                       global const REAL *points, const REAL4 box_lower, const REAL4 box_upper,
                       global FACE *face_measures, global FACE *face_centroids, global REAL *volumes,
                       global REAL *offsets, global REAL *covariances, global float *reach)
{
    LONG_ITEM(i);
    BOX_CORNERS(lower, upper);
    const measures_t to = {starts, neighbors, face_measures, face_centroids, volumes, offsets, covariances};
    const int begin = starts[i], n = starts[i + 1] - begin;
    int faces[ROW_CAPACITY], first = 0;
    for (int k = 1; k < n; ++k)
        first = label_of(neighbors[begin + k], labels) < label_of(neighbors[begin + first], labels) ? k : first;
    for (int k = 0; k < n; ++k)
        faces[k] = neighbors[begin + (first + k < n ? first + k : first + k - n)];
    measure_cell(&to, i, faces, n, points, lower, upper);
    SITE(x, i, points);
    REAL far2 = 0;
    for (int k = 0; k < n; ++k) {
        const REAL2 v = corner(i, x, faces[k], faces[k + 1 < n ? k + 1 : 0], points, lower, upper);
        far2 = fmax(far2, dot(v, v));
    }
    reach[i] = (float)sqrt(far2);
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

/* Largest relative difference of the volumes of a cell by both measurements. */
#define ALIKE (IS_DOUBLE ? R(1e-8) : R(1e-4))

/* Cells of which a face or a vertex is not known because of round-off stay as they are. Those with more faces than are
   updated are ordered in a second launch, of a kernel with -DCELL_BYTES=bytes of `cell_t` for them only. */
kernel void order_rows(const int size, global const int *starts, global int *neighbors, global const int *labels,
                       global const REAL *points, CLIP_BOX_ARGS, global uchar4 *corners, global REAL *face_measures,
                       global REAL *face_centroids, global REAL *volumes, global REAL *offsets,
                       global REAL *covariances, global float *reach PERIOD_ARGS CELL_ARGS)
{
    LONG_ITEM(k);
    TAKE_CELL(cell, k);
    EACH_CELL (i, k) {
        const int begin = starts[i], n = starts[i + 1] - begin;
        if (n < LEAST_FACES)
            continue;
        /* No corner of a convex body is farther from its centroid than sqrt(d (d + 2)) standard deviations. */
        REAL offset2 = 0;
        EACH_AXIS (a)
            offset2 += offsets[3 * i + a] * offsets[3 * i + a];
        reach[i] =
            (float)(sqrt(offset2) + sqrt(15 * (covariances[6 * i] + covariances[6 * i + 3] + covariances[6 * i + 5])));
        const int state = n > MOST_FACES ? NO_CORNERS : corners[2 * begin].s3;
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
        write_triples(body, corners + 2 * begin, clear ? NEW_CORNERS : NO_CORNERS);
    }
}
#endif
