#include "common/domain.h"

/* Periodic boxes. The generators x in [0, P) are extended by their images x + c P, c in {-1, 0, 1}^d, that lie within a
   margin M of the box; the diagram of them all in the box [-M, P + M] is made by kernels that know of no period, and its
   rows of the generators themselves are folded: images become their owners, with the code of c.

   A cell is right if the ball of twice its reach around its generator lies in the extended box: nobody outside of it can
   cut. With M = P along an axis it is right in any case: a cell is no longer than P, as it is cut by the images of its own
   generator, and so of every generator the nearest image to one of its points lies within [-P, 2 P]. */

#ifndef PERIODIC
#error "build with -DPERIODIC -DPERIOD_0=... -DPERIOD_1=... -DPERIOD_2=..."
#endif

#define CODES (DIM == 2 ? 9 : 27) /* sum over the axes of (c + 1) 3^a */
#define CENTRE (CODES / 2)

/* Bits of report[1]. */
#define FLAG_DROPPED 1   /* a face that only one of its cells sees, of no size, is to be dropped */
#define FLAG_FAR 2       /* a neighbour is not the nearest image; report[2] is the smallest index of one who has it */
#define FLAG_COLLAPSED 4 /* a face that only one of its cells sees is no rounding; report[2] likewise */

inline int step_of(int code, int a)
{
    return (a == 0 ? code : a == 1 ? code / 3 : code / 9) % 3 - 1;
}

/* The image y of x that has the code; does it lie in the extended box? */
inline bool make_image(const REAL *x, int code, REAL4 margins, REAL *y)
{
    const REAL margin[4] = {margins.s0, margins.s1, margins.s2, margins.s3};
    bool inside = true;
    EACH_AXIS(a) {
        const int step = step_of(code, a);
        const REAL period = PERIOD(a);
        y[a] = x[a] + step * period;
        inside = inside && (step == 0 || (period > 0 && y[a] >= -margin[a] && y[a] <= period + margin[a]));
    }
    return inside;
}

/* Per generator i: how many images it has. */
kernel void count_images(const int size, global const REAL *points, const REAL4 margins, global int *counts)
{
    WORK_ITEM(i);
    REAL x[DIM], y[DIM];
    EACH_AXIS(a)
        x[a] = points[DIM * i + a];
    int count = 0;
    for (int code = 0; code < CODES; ++code)
        count += code != CENTRE && make_image(x, code, margins, y);
    counts[i] = count;
}

/* Per generator i: its row of `extended`, and those of its images behind row n, in the order of owners and codes, whatever
   the margin; firsts are the prefix sums of the counts. */
kernel void place_images(const int size, global const REAL *points, const REAL4 margins, global const int *firsts,
                         global REAL *extended, global int *owners, global int *codes)
{
    WORK_ITEM(i);
    REAL x[DIM], y[DIM];
    EACH_AXIS(a)
        extended[DIM * i + a] = x[a] = points[DIM * i + a];
    int g = firsts[i];
    for (int code = 0; code < CODES; ++code)
        if (code != CENTRE && make_image(x, code, margins, y)) {
            EACH_AXIS(a)
                extended[DIM * (size + g) + a] = y[a];
            owners[g] = i;
            codes[g++] = code;
        }
}

/* Per place p in bin order: the margin that the cell of generator items[p] needs, reach[p] being twice its reach. report[0]
   collects the largest, as bits of a float, which are in the order of floats >= 0. */
kernel void measure_margin(const int size, global const int *items, global const float *reach,
                           global const REAL *points, const int n, const REAL4 margins, global int *report)
{
    WORK_ITEM(p);
    const int i = items[p];
    if (i >= n)
        return;
    const REAL margin[4] = {margins.s0, margins.s1, margins.s2, margins.s3};
    float need = 0;
    EACH_AXIS(a)
        if (margin[a] < PERIOD(a)) {
            const REAL x = points[DIM * i + a];
            need = fmax(need, (float)(reach[p] - fmin(x, PERIOD(a) - x)));
        }
    if (need > 0)
        atomic_max(report, as_int(need * 1.000001f));
}

/* Per generator i: its row of the extended diagram with the owners of images, and each face's code. kept[k]: does the
   neighbour see the face, too? Cells in the box and beyond it are made of the same differences, but cut in another order:
   rounding may let one see a face of no size that the other does not see. Such a face is to go, so that the graph is
   symmetric; counts are those of the others. */
kernel void fold_rows(const int size, global const int *starts, global const int *neighbours,
                      global const FACE *face_measures, global const REAL *volumes, global const REAL *points,
                      global const int *owners, global const int *codes, const REAL share, const int nearest,
                      global int *folded, global int *face_codes, global uchar *kept, global int *counts,
                      global int *report)
{
    WORK_ITEM(i);
    int count = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int label = neighbours[k];
        int j = label, code = CENTRE;
        bool mutual = true;
        if (label >= size) {
            j = owners[label - size];
            code = codes[label - size];
            mutual = false;
            for (int q = starts[j]; q < starts[j + 1] && !mutual; ++q) {
                const int other = neighbours[q] - size;
                mutual = other >= 0 && owners[other] == i && codes[other] == CODES - 1 - code;
            }
        }
        if (label >= 0 && (!mutual || nearest)) {
            REAL d2 = 0;
            bool far = false;
            EACH_AXIS(a) {
                const REAL d = points[DIM * label + a] - points[DIM * i + a];
                far = far || DIFFERENCE(a, points[DIM * i + a], points[DIM * j + a]) != d;
                d2 += d * d;
            }
            const REAL cone = face_measures[k] * sqrt(d2) / (2 * DIM);
            const bool tiny = face_measures[k] < 2048 * REAL_EPS * (DIM == 2 ? R(1) : sqrt(d2)) &&
                              cone <= share * volumes[i] && cone <= share * volumes[j];
            const int flag = mutual ? 0 : (tiny ? FLAG_DROPPED : FLAG_COLLAPSED);
            if (flag || (nearest && far)) {
                atomic_or(report + 1, flag | (nearest && far ? FLAG_FAR : 0));
                atomic_min(report + 2, i);
            }
        }
        folded[k] = j;
        face_codes[k] = code;
        kept[k] = mutual;
        count += mutual;
    }
    counts[i] = count;
}

/* Per generator i: its row without the faces that were not kept. places[k] is where a face was before. */
kernel void close_rows(const int size, global const int *starts, global const uchar *kept, global const int *new_starts,
                       global const int *folded, global const int *face_codes, global const FACE *face_measures,
                       global const FACE *face_centroids, global int *new_folded, global int *new_codes,
                       global FACE *new_measures, global FACE *new_centroids, global int *places)
{
    WORK_ITEM(i);
    int to = new_starts[i];
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        if (!kept[k])
            continue;
        new_folded[to] = folded[k];
        new_codes[to] = face_codes[k];
        new_measures[to] = face_measures[k];
        EACH_AXIS(a)
            new_centroids[DIM * to + a] = face_centroids[DIM * k + a];
        places[to++] = k;
    }
}

/* Per generator i: its row in an earlier folded graph as one of the extended graph: images in the place of their owners,
   where they are nearest now, -1 for whom there is no image. Where to begin with the cells: nobody is relied on. */
kernel void unfold_rows(const int size, global const int *starts, global const int *neighbours,
                        global const REAL *points, const REAL4 margins, global const int *firsts,
                        global int *unfolded)
{
    WORK_ITEM(i);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbours[k];
        int label = -1;
        if (j >= 0) {
            REAL x[DIM], y[DIM];
            int wanted = 0;
            EACH_AXIS(a) {
                const REAL period = PERIOD(a);
                x[a] = points[DIM * j + a];
                const int step = period > 0 ? -convert_int_rte((x[a] - points[DIM * i + a]) / period) : 0;
                wanted += (step + 1) * (a == 0 ? 1 : a == 1 ? 3 : 9);
            }
            if (wanted == CENTRE) {
                label = j;
            } else if (make_image(x, wanted, margins, y)) {
                label = size + firsts[j];
                for (int code = 0; code < wanted; ++code)
                    label += code != CENTRE && make_image(x, code, margins, y);
            }
        }
        unfolded[k] = label;
    }
}
