/* Numbers of faces of cells in 3D, while a diagram is made. */
#include "tessellation/report.h"

#define UNFINISHED INT_MIN /* a cell that must be clipped, or clipped again with more room */
#define CERTAIN (1 << 30)  /* added if no face is near round-off: other certain cells have the same faces */
#define COUNT_OF(n) ((n) & (CERTAIN - 1))

/* The output of kernels that make cells in 3D.

   row_places, row_counts (n,)   first entry of a cell in the arrays of faces, and number of its faces; the cells are in
                                 any order, later kernels sort them
   labels, measures, centroids   of the faces
   volumes (n,), offsets (n, 3), covariances (n, 6)  see measure_cells of cells.cl
   report                        see report.h
   corners                       if `with_corners`: the vertices of a cell from twice its first entry on, as triples of
                                 its faces, counter-clockwise seen from outside. The fourth number of the first one is
                                 one of those below, the last one only if `with_corners` is UNSURE_CORNERS */
#define CELL_OUTPUT_ARGS                                                                                               \
    global int *row_places, global int *row_counts, global int *labels, global REAL *measures, global REAL *centroids, \
        global REAL *volumes, global REAL *offsets, global REAL *covariances, global int *report,                      \
        const int with_corners, global uchar4 *corners
#define CELL_OUTPUT                                                                                                    \
    row_places, row_counts, labels, measures, centroids, volumes, offsets, covariances, report, with_corners, corners

#define NO_CORNERS 0     /* the vertices are not known */
#define NEW_CORNERS 1    /* they are those of a new cell */
#define KNOWN_CORNERS 2  /* they agree with those of the neighbors, and have keys; see polyhedra_update.cl */
#define UNSURE_CORNERS 3 /* they are those of a new cell with faces near round-off */
#ifndef MOST_FACES
#define MOST_FACES 32 /* most faces of a cell that is updated: one bit each */
#endif
#define MOST_NUMBERED 256 /* most faces of a cell with triples, numbers of eight bits */

/* Reserve a range in the arrays of faces. Its position depends on the order of work-items, its content does not. */
inline int take_places(global int *report, int count)
{
    return atomic_add(report + REPORT_FACES, count);
}

/* Whether all cells are known, and right. */
inline bool are_complete(global const int *report)
{
    const int errors = FLAG_FULL | FLAG_COINCIDE | FLAG_COLLAPSED | FLAG_UNKNOWN;
    return (report[REPORT_FLAGS] & errors) == 0 && report[REPORT_UNFINISHED] == 0 && report[REPORT_MARKED] == 0;
}
