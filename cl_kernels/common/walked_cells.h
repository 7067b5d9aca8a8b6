/* Which cells of a walk are certain, and where they are written. */
#include "common/row_counts.h"
#include "common/walk.h"

/* What is certain: least ratio of squares of the distances of the nearest generator and of the farthest vertex; least
   ratio of a face's area and the square of the distance of its own farthest vertex, as far as which vertices round:
   that distance is the same from both sides of the face. */
#define CERTAIN_NEAREST2 1e-7
#define CERTAIN_AREA 1e-8

/* Where cells are written to, in the layout of `clip_cells` (polyhedra.cl). */
typedef struct {
    int room;
    global const int *items;
    global float *reach;
    global int *row_places, *row_counts, *labels, *report;
    global double *measures, *centroids, *volumes, *offsets, *covariances;
} output_t;

/* Write the cells of some lanes, of generators at `places`, and return how many. `reach` is twice the distance of the
   farthest vertex. */
inline int write_cells(const cells_t *cells, const moments_t *m, long8 done, const int *places, double8 reach,
                       const output_t *out)
{
    long lanes[LANES];
    double reaches[LANES];
    vstore8(done, 0, lanes);
    vstore8(reach, 0, reaches);
    int total = 0, made = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        total += lanes[lane] ? cells->faces[lane] : 0;
        made += lanes[lane] != 0;
    }
    if (made == 0)
        return 0;
    int place = atomic_add(out->report + 2, total);
    const bool fits = place + total <= out->room;
    for (int lane = 0; lane < LANES; ++lane) {
        if (!lanes[lane])
            continue;
        const int i = out->items[places[lane]], count = cells->faces[lane];
        out->reach[places[lane]] = (float)reaches[lane];
        out->row_places[i] = place;
        out->row_counts[i] = count | CERTAIN;
        for (int f = 0; f < count && fits; ++f, ++place) {
            const int other = LANE(cells->places, f, lane);
            out->labels[place] = other < 0 ? other : out->items[other];
            const double4 face = LANE(cells->sums, f, lane);
            out->measures[place] = face.s0;
            out->centroids[3 * place] = face.s1;
            out->centroids[3 * place + 1] = face.s2;
            out->centroids[3 * place + 2] = face.s3;
        }
        out->volumes[i] = LANE((const double *)&m->volume, 0, lane);
        out->offsets[3 * i] = LANE((const double *)&m->x, 0, lane);
        out->offsets[3 * i + 1] = LANE((const double *)&m->y, 0, lane);
        out->offsets[3 * i + 2] = LANE((const double *)&m->z, 0, lane);
        out->covariances[6 * i] = LANE((const double *)&m->xx, 0, lane);
        out->covariances[6 * i + 1] = LANE((const double *)&m->xy, 0, lane);
        out->covariances[6 * i + 2] = LANE((const double *)&m->zx, 0, lane);
        out->covariances[6 * i + 3] = LANE((const double *)&m->yy, 0, lane);
        out->covariances[6 * i + 4] = LANE((const double *)&m->yz, 0, lane);
        out->covariances[6 * i + 5] = LANE((const double *)&m->zz, 0, lane);
    }
    return made;
}

/* Lanes in which the cell, walked among all that is nearer than `reach`, is certain. */
inline long8 certain_cells(const cells_t *cells, const moments_t *m, const list_t *list)
{
    return (list->nearest2 > CERTAIN_NEAREST2 * cells->reach2) & (m->least > CERTAIN_AREA);
}
