#include "common/domain.h"

/* Periodic boxes. The generators x in [0, P) are extended by their images x + c P, c in {-1, 0, 1}^d, that lie within a
   margin beyond the seams; the diagram of them all in a box around is made by kernels that know of no period, and its
   rows of the generators themselves are folded: images become their owners, with the code of c.

   Every seam is divided into blocks, each with a margin of its own, so that a large cell at one place of a seam does
   not ask for images of all the small ones at others. A cell is right if each block has a margin as deep as the ball of
   twice its reach around its generator goes there: nobody outside of the ball can cut. A margin of P is deep enough for
   any ball: a cell is no longer than P, as it is cut by the images of its own generator, and so of every generator the
   nearest image to one of its points lies within [-P, 2 P]. */

#ifndef PERIODIC
#error "build with -DPERIODIC -DPERIOD_0=... -DPERIOD_1=... -DPERIOD_2=..."
#endif
#ifndef BLOCKS
#error "build with -DBLOCKS=number per axis along a seam"
#endif

#define CODES (DIM == 2 ? 9 : 27) /* sum over the axes of (c + 1) 3^a */
#define CENTRE (CODES / 2)
#define WHOLE 4.0f /* more than any depth: positions lie in the unit box */

/* Bits of report[1]. */
#define FLAG_DROPPED 1   /* a face that only one of its cells sees, of no size, is to be dropped */
#define FLAG_FAR 2       /* a neighbour is not the nearest image; report[2] is the smallest index of one who has it */
#define FLAG_COLLAPSED 4 /* a face that only one of its cells sees is no rounding; report[2] likewise */

inline int step_of(int code, int a)
{
    return (a == 0 ? code : a == 1 ? code / 3 : code / 9) % 3 - 1;
}

/* The axes along which seams across axis a are divided; the second one in space only. */
#define FIRST_ALONG(a) ((a) == 0 ? 1 : 0)
#define SECOND_ALONG(a) ((a) == 2 ? 1 : 2)

/* Block of coordinate y along an axis: the outermost ones go on for ever. */
inline int block_of(REAL y, int a, REAL4 lower, REAL4 edge)
{
    const REAL from[4] = {lower.s0, lower.s1, lower.s2, lower.s3}, length[4] = {edge.s0, edge.s1, edge.s2, edge.s3};
    return (int)clamp(floor((y - from[a]) / length[a]), R(0), R(BLOCKS - 1));
}

/* Place of a block of the seam at the lower (side 0) or upper end (1) of axis a. */
inline int block_place(int a, int side, int first, int second)
{
    const int along = DIM == 2 ? first : first * BLOCKS + second;
    return (2 * a + side) * (DIM == 2 ? BLOCKS : BLOCKS * BLOCKS) + along;
}

/* The image y of x that has the code; is it within the margins? widest are the largest along each axis, as bits. */
inline bool make_image(const REAL *x, int code, global const float *margins, global const int *widest, REAL4 lower,
                       REAL4 edge, REAL *y)
{
    EACH_AXIS(a)
    {
        const int step = step_of(code, a);
        y[a] = x[a] + step * PERIOD(a);
        if (step != 0 && !(PERIOD(a) > 0 && (step < 0 ? -y[a] : y[a] - PERIOD(a)) <= as_float(widest[a])))
            return false; /* as most are */
    }
    EACH_AXIS(a)
    {
        const int step = step_of(code, a);
        if (step == 0)
            continue;
        const int first = block_of(y[FIRST_ALONG(a)], FIRST_ALONG(a), lower, edge);
        const int second = DIM == 2 ? 0 : block_of(y[DIM == 2 ? 0 : SECOND_ALONG(a)], SECOND_ALONG(a), lower, edge);
        const REAL depth = step < 0 ? -y[a] : y[a] - PERIOD(a);
        if (!(depth <= margins[block_place(a, step > 0, first, second)]))
            return false;
    }
    return true;
}

/* Does x lie so far from all seams that none of its images is within the margins? As most do. */
inline bool is_inside(const REAL *x, global const int *widest)
{
    bool inside = true;
    EACH_AXIS(a)
    inside = inside && (PERIOD(a) == 0 || fmin(x[a], PERIOD(a) - x[a]) > as_float(widest[a]));
    return inside;
}

/* Per block: the margin that images are taken from next. needed is what cells needed, there and in the blocks around
   it, as cells move; it is to be `factor` times as wide and, with `grow`, no less than it was. widest[a]
   collects the largest along axis a, as bits of a float, which are in the order of floats >= 0. */
kernel void next_margins(const int size, global const float *needed, const float factor, const int grow,
                         global float *margins, global int *widest)
{
    WORK_ITEM(k);
    const int per_seam = DIM == 2 ? BLOCKS : BLOCKS * BLOCKS;
    const int a = k / (2 * per_seam), seam = k / per_seam, along = k % per_seam;
    const int first = DIM == 2 ? along : along / BLOCKS, second = DIM == 2 ? 0 : along % BLOCKS;
    const REAL period = a == 0 ? PERIOD(0) : a == 1 ? PERIOD(1) : PERIOD(2);
    float margin = 0;
    for (int i = max(first - 1, 0); i <= min(first + 1, BLOCKS - 1); ++i)
        for (int j = max(second - 1, 0); j <= min(second + 1, DIM == 2 ? 0 : BLOCKS - 1); ++j)
            margin = fmax(margin, factor * needed[block_place(seam / 2, seam % 2, i, j)]);
    if (grow)
        margin = fmax(margin, margins[k]);
    if (margin > 0.99f * (float)period)
        margin = WHOLE; /* at least as deep as any image, whatever rounds */
    margins[k] = margin;
    if (margin > 0 && period > 0)
        atomic_max(widest + a, as_int(margin));
}

/* Per generator i: how many images it has. */
kernel void count_images(const int size, global const REAL *points, global const float *margins,
                         global const int *widest, const REAL4 lower, const REAL4 edge, global int *counts)
{
    WORK_ITEM(i);
    REAL x[DIM], y[DIM];
    EACH_AXIS(a)
    x[a] = points[DIM * i + a];
    int count = 0;
    for (int code = is_inside(x, widest) ? CODES : 0; code < CODES; ++code)
        count += code != CENTRE && make_image(x, code, margins, widest, lower, edge, y);
    counts[i] = count;
}

/* Per generator i: its row of `extended`, and those of its images behind row n, in the order of owners and codes,
   whatever the margins; firsts are the prefix sums of the counts. */
kernel void place_images(const int size, global const REAL *points, global const float *margins,
                         global const int *widest, const REAL4 lower, const REAL4 edge, global const int *firsts,
                         global REAL *extended, global int *owners, global int *codes)
{
    WORK_ITEM(i);
    REAL x[DIM], y[DIM];
    EACH_AXIS(a)
    extended[DIM * i + a] = x[a] = points[DIM * i + a];
    int g = firsts[i];
    for (int code = is_inside(x, widest) ? CODES : 0; code < CODES; ++code)
        if (code != CENTRE && make_image(x, code, margins, widest, lower, edge, y)) {
            EACH_AXIS(a)
            extended[DIM * (size + g) + a] = y[a];
            owners[g] = i;
            codes[g++] = code;
        }
}

/* How far x lies from a block along an axis; a little less, as positions are put into blocks with rounding. */
inline REAL block_distance(REAL x, REAL from, REAL length, int block)
{
    const REAL below = block > 0 ? from + block * length - x : R(0);
    const REAL above = block < BLOCKS - 1 ? x - (from + (block + 1) * length) : R(0);
    return fmax(fmax(below, above) - 16 * REAL_EPS, R(0));
}

/* Per place p in bin order: how deep the ball goes beyond each block of the seams whose radius reach[p] is twice the
   reach of the cell of generator items[p]. needs collects the largest, as bits of floats. */
kernel void measure_margins(const int size, global const int *items, global const float *reach,
                            global const REAL *points, const int n, const REAL4 lower, const REAL4 edge,
                            global int *needs)
{
    WORK_ITEM(p);
    const int i = items[p];
    if (i >= n)
        return;
    const REAL from[4] = {lower.s0, lower.s1, lower.s2, lower.s3}, length[4] = {edge.s0, edge.s1, edge.s2, edge.s3};
    const REAL radius = reach[p] * R(1.000001); /* it was rounded to a float */
    REAL x[DIM];
    EACH_AXIS(a)
    x[a] = points[DIM * i + a];
    for (int seam = 0; seam < 2 * DIM; ++seam) {
        const int a = seam / 2, b = FIRST_ALONG(a), c = DIM == 2 ? b : SECOND_ALONG(a);
        const REAL period = a == 0 ? PERIOD(0) : a == 1 ? PERIOD(1) : PERIOD(2);
        const REAL to_seam = seam % 2 ? period - x[a] : x[a];
        if (!(period > 0 && to_seam < radius))
            continue;
        const int last_b = block_of(x[b] + radius, b, lower, edge);
        const int last_c = DIM == 2 ? 0 : block_of(x[c] + radius, c, lower, edge);
        for (int j = block_of(x[b] - radius, b, lower, edge); j <= last_b; ++j)
            for (int k = DIM == 2 ? 0 : block_of(x[c] - radius, c, lower, edge); k <= last_c; ++k) {
                const REAL s = block_distance(x[b], from[b], length[b], j);
                const REAL t = DIM == 2 ? R(0) : block_distance(x[c], from[c], length[c], k);
                const REAL deep = sqrt(fmax(radius * radius - s * s - t * t, R(0))) - to_seam;
                const float need = 1.00001f * (float)(deep + 4 * REAL_EPS);
                if (need > 0)
                    atomic_max(needs + block_place(a, seam % 2, j, k), as_int(need));
            }
    }
}

/* Per block: is its margin as deep as was needed? needed takes what was, and needs begins anew. report[0] is set where
   one is not. */
kernel void compare_margins(const int size, global const float *margins, global int *needs, global float *needed,
                            global int *report)
{
    WORK_ITEM(k);
    const float need = as_float(needs[k]);
    needs[k] = 0;
    needed[k] = need;
    if (!(need <= margins[k]) && margins[k] < WHOLE)
        atomic_or(report, 1);
}

/* Per generator i: its row of the extended diagram with the owners of images, and each face's code. kept[k]: does the
   neighbour see the face, too? Cells in the box and beyond it are made of the same differences, but cut in another
   order: rounding may let one see a face of no size that the other does not see. Such a face is to go, so that the
   graph is symmetric; counts are those of the others. */
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
            EACH_AXIS(a)
            {
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

/* Per generator i: its row in an earlier folded graph as one of the extended graph: images in the place of their
   owners, where they are nearest now, -1 for whom there is no image. Where to begin with the cells: nobody is relied
   on. */
kernel void unfold_rows(const int size, global const int *starts, global const int *neighbours,
                        global const REAL *points, global const float *margins, global const int *widest,
                        const REAL4 lower, const REAL4 edge, global const int *firsts, global int *unfolded)
{
    WORK_ITEM(i);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbours[k];
        int label = -1;
        if (j >= 0) {
            REAL x[DIM], y[DIM];
            int wanted = 0;
            EACH_AXIS(a)
            {
                const REAL period = PERIOD(a);
                x[a] = points[DIM * j + a];
                const int step = period > 0 ? -convert_int_rte((x[a] - points[DIM * i + a]) / period) : 0;
                wanted += (step + 1) * (a == 0 ? 1 : a == 1 ? 3 : 9);
            }
            if (wanted == CENTRE) {
                label = j;
            } else if (make_image(x, wanted, margins, widest, lower, edge, y)) {
                label = size + firsts[j];
                for (int code = 0; code < wanted; ++code)
                    label += code != CENTRE && make_image(x, code, margins, widest, lower, edge, y);
            }
        }
        unfolded[k] = label;
    }
}
