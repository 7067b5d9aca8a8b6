/* The test of traced cells for certainty, and their output. */
#include "tessellation/own_planes.h"
#include "tessellation/row_counts.h"
#include "tessellation/periodic/halo.h"
#include "simd/edge_walk.h"

/* Thickness of a face, as a share of the distance of its farthest vertex, from which on it is certain: both of its
   cells have it. */
#define LEAST_AREA 1e-8
#include "tessellation/corner_sums.h"

/* The output arrays, in the layout of `clip_polyhedra` (polyhedra.cl). */
typedef struct {
    int room;
    global const int *items;
    global float *reach;
    global int *row_places, *row_counts, *report;
    measured_t measures;
    int with_corners;
    global uchar4 *corners;
    own_t own;
#ifdef HALO
    halo_t halo;
#endif
} output_t;

#ifdef HALO
/* Test the ball around vertex v of the cell of one lane, of generator i at x. */
inline void check_corner_ball(const cells_t *cells, const walk_t *walk, int v, int lane, int i, const double *x,
                              const output_t *out)
{
    const uchar4 corner = walk->lanes[lane].corner_faces[v];
    const int faces[3] = {corner.s0, corner.s1, corner.s2};
    double4 ways[3];
    int labels[3];
    for (int k = 0; k < 3; ++k) {
        const int place = LANE(cells->places, faces[k], lane);
        labels[k] = place < 0 ? place : out->items[place];
        ways[k] = PLANE_LANE(cells->planes, faces[k], 3, lane) *
                  (double4)(PLANE_LANE(cells->planes, faces[k], 0, lane), PLANE_LANE(cells->planes, faces[k], 1, lane),
                            PLANE_LANE(cells->planes, faces[k], 2, lane), 0);
    }
    check_vertex_ball(x, 0, i, corner_at(walk, v, lane), ways, labels, &out->halo);
}

/* Test the balls around the vertices of the cells of some lanes, for generators in the box. */
inline void check_walked_balls(const cells_t *cells, const walk_t *walk, long8 some, const int *places,
                               global const double *binned, const output_t *out)
{
    const halo_t *halo = &out->halo;
    double x[LANES][3];
    long own[LANES];
    int most = 0;
    vstore8(some, 0, own);
    for (int lane = 0; lane < LANES; ++lane) {
        own[lane] = own[lane] && out->items[places[lane]] < halo->own ? -1 : 0;
        most = own[lane] ? max(most, cells->corners[lane]) : most;
        /* Lanes without a cell have no item. */
        for (int a = 0; a < 3; ++a)
            x[lane][a] = own[lane] ? binned[3 * places[lane] + a] : 0;
    }
#define ACROSS_LANES(a) (double8)(x[0][a], x[1][a], x[2][a], x[3][a], x[4][a], x[5][a], x[6][a], x[7][a])
    const double8 low_x = halo->limits[0] + ACROSS_LANES(0), low_y = halo->limits[2] + ACROSS_LANES(1);
    const double8 low_z = halo->limits[4] + ACROSS_LANES(2);
    const double8 high_x = halo->limits[1] + halo->period.s0 - ACROSS_LANES(0);
    const double8 high_y = halo->limits[3] + halo->period.s1 - ACROSS_LANES(1);
    const double8 high_z = halo->limits[5] + halo->period.s2 - ACROSS_LANES(2);
    const double widest = widest_ball(halo);
    const long8 mine = vload8(0, own), counts = convert_long8(vload8(0, cells->corners));
    for (int v = 0; v < most; ++v) {
        const planes_t *at = &walk->corners[v];
        const double8 wide = widest * sqrt(fma(at->x, at->x, fma(at->y, at->y, at->z * at->z)));
        const long8 inside = (wide - at->x <= low_x) & (wide + at->x <= high_x) & (wide - at->y <= low_y) &
                             (wide + at->y <= high_y) & (wide - at->z <= low_z) & (wide + at->z <= high_z);
        const long8 beyond = ~inside & mine & (v < counts);
        if (!any(beyond))
            continue;
        long lanes[LANES];
        vstore8(beyond, 0, lanes);
        for (int lane = 0; lane < LANES; ++lane)
            if (lanes[lane])
                check_corner_ball(cells, walk, v, lane, out->items[places[lane]], x[lane], out);
    }
}
#endif

/* Measure and write the cell of a lane, of generator i. False if round-off may decide about its faces, or if they are
   many: then it is not written. */
inline bool write_cell(const cells_t *cells, const walk_t *walk, int lane, int i, const output_t *out)
{
    corners_t cell;
    sums_t sums;
    cell.faces = cells->faces[lane];
    cell.corners = cells->corners[lane];
    if (cell.faces > MOST_FACES)
        return false;
    for (int f = 0; f < cell.faces; ++f) {
        const int other = LANE(cells->places, f, lane);
        cell.labels[f] = other < 0 ? other : out->items[other];
        cell.planes[f] = (double4)(PLANE_LANE(cells->planes, f, 0, lane), PLANE_LANE(cells->planes, f, 1, lane),
                                   PLANE_LANE(cells->planes, f, 2, lane), PLANE_LANE(cells->planes, f, 3, lane));
    }
    pad_planes(&cell);
    for (int v = 0; v < cell.corners; ++v)
        cell.at[v] = walk->lanes[lane].corner_faces[v];
    if (!place_corners(&cell, &sums, true) || !fits_corners(&cell))
        return false;
    const int place = take_places(out->report, cell.faces);
    out->row_places[i] = place;
    if (place + cell.faces > out->room) {
        out->row_counts[i] = cell.faces | CERTAIN; /* all is repeated */
        return true;
    }
    if (!write_measures(&cell, &sums, i, place, &out->measures))
        return false;
    out->row_counts[i] = cell.faces | CERTAIN;
    if (out->with_corners)
        write_triples(&cell, out->corners + 2 * place, NEW_CORNERS);
    return true;
}

/* Write the cells of some lanes, of items `places`, those that are certain; return their number. `reach` is twice the
   distance of the farthest vertex. */
inline int write_cells(const cells_t *cells, const walk_t *walk, long8 done, const int *places, double8 reach,
                       global const double *binned, const output_t *out)
{
    long lanes[LANES];
    double reaches[LANES];
    vstore8(done, 0, lanes);
    vstore8(reach, 0, reaches);
    int made = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        if (!lanes[lane])
            continue;
        const int i = out->items[places[lane]];
        if (knows_walls(i, reaches[lane] * reaches[lane] / 4, &out->own) && write_cell(cells, walk, lane, i, out)) {
            out->reach[places[lane]] = (float)reaches[lane];
            ++made;
        } else {
            lanes[lane] = 0;
        }
    }
#ifdef HALO
    if (made > 0)
        check_walked_balls(cells, walk, vload8(0, lanes) != 0, places, binned, out);
#endif
    return made;
}
