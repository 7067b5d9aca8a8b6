#include "geometry/domain.h"
#if DIM == 2
#include "tessellation/corner.h"
#endif
#include "tessellation/periodic/halo.h"

/* Periodic boxes. The generators x in [0, P) are extended by their images x + c P, c in {-1, 0, 1}^d, that lie within a
   margin beyond the seams; the diagram of them all in a box around is made by kernels that know of no period, and its
   rows of the generators themselves are folded: images become their owners, with the code of c.

   Every seam is divided into blocks, each with a margin of its own, so that a large cell at one place of a seam does
   not ask for images of all the small ones at others. Whoever cuts a cell lies nearer to one of its vertices than its
   generator does. So a cell is right if each block has a margin as deep as the balls around its vertices go there that
   its generator lies on: they are empty then, and where sizes grow steeply the ball of a large cell passes the small
   ones by, which a ball around the whole cell would not. A margin of P is deep enough for any ball: a cell is no longer
   than P, as it is cut by the images of its own generator, and so of every generator the nearest image to one of its
   points lies within [-P, 2 P]. */

#ifndef PERIODIC
#error "build with -DPERIODIC"
#endif
#define CODES (DIM == 2 ? 9 : 27) /* sum over the axes of (c + 1) 3^a */
#define CENTER (CODES / 2)

/* Bits of report[1]. */
#define FLAG_DROPPED 1   /* a face that only one of its cells sees, of no size, is to be dropped */
#define FLAG_FAR 2       /* a neighbor is not the nearest image; report[2] is the smallest index of one who has it */
#define FLAG_COLLAPSED 4 /* a face that only one of its cells sees is no rounding; report[2] likewise */

inline int step_of(int code, int a)
{
    return (a == 0 ? code : a == 1 ? code / 3 : code / 9) % 3 - 1;
}

/* The codes, as bits, whose step along axis a is -1; those of the next step are shifted by the weight of the axis. */
#define WEIGHT(a) ((a) == 0 ? 1 : (a) == 1 ? 3 : 9)
#define BACK(a) ((a) == 0 ? 0x1249249 : (a) == 1 ? 0x1c0e07 : 0x1ff)

/* The codes, as bits, of those images of x that are within the largest margin along each axis: none, as a rule. */
inline int codes_near(const REAL *x, global const int *extremes PERIOD_ARGS)
{
    int codes = (1 << CODES) - 1;
    EACH_AXIS(a)
    {
        const REAL period = PERIOD(a), wide = as_float(extremes[a]);
        const bool back = period > 0 && period - x[a] <= wide, ahead = period > 0 && x[a] <= wide;
        codes &= (back ? BACK(a) : 0) | BACK(a) << WEIGHT(a) | (ahead ? BACK(a) << 2 * WEIGHT(a) : 0);
    }
    return codes & ~(1 << CENTER);
}

/* Take the first one out of the codes. */
inline int take_code(int *codes)
{
    const int code = 31 - (int)clz(*codes & -*codes);
    *codes &= *codes - 1;
    return code;
}

/* The image y of x that has the code; is it within the margins? */
inline bool make_image(const REAL *x, int code, global const float *margins, const blocks_t *blocks,
                       REAL *y PERIOD_ARGS)
{
    EACH_AXIS(a)
    y[a] = x[a] + step_of(code, a) * PERIOD(a);
    EACH_AXIS(a)
    {
        const int step = step_of(code, a);
        if (step == 0)
            continue;
        const int first = block_of(y[FIRST_ALONG(a)], FIRST_ALONG(a), blocks);
        const int second = DIM == 2 ? 0 : block_of(y[DIM == 2 ? 0 : SECOND_ALONG(a)], SECOND_ALONG(a), blocks);
        const REAL depth = step < 0 ? -y[a] : y[a] - PERIOD(a);
        if (!(depth <= margins[block_place(a, step > 0, first, second)]))
            return false;
    }
    return true;
}

/* How far the middles of block k, and of block j of `was` ones, are apart along an axis; less what one of them is
   longer, so that they are together where one lies in the other. */
inline float block_spacing(int k, int j, int count, int was, REAL length)
{
    const float one = (float)length, other = one * (float)count / (float)was;
    return fmax(fabs(one * ((float)k + 0.5f) - other * ((float)j + 0.5f)) - fabs(one - other) / 2, 0.0f);
}

/* Per block: the margin that images are taken from next, `factor` times what was needed there or, with `spread`, where
   cells or blocks are others than then (`was` along each axis), within its own depth around. With `grow` it is no less
   than it was; then cells that lacked images may have told of more than they need, and it becomes wide in steps.
   extremes are collected (tessellation/periodic/halo.h). Wishes begin anew. */
kernel void next_margins(const int size, global const float *needed, const int4 was, const float factor,
                         const int spread, const int grow, BLOCK_ARGS, global float *margins, global int *extremes,
                         global int *wishes PERIOD_ARGS)
{
    WORK_ITEM(k);
    BLOCKS_GIVEN;
    const int per_seam = DIM == 2 ? BLOCKS : BLOCKS * BLOCKS;
    const int a = k / (2 * per_seam), seam = k / per_seam, along = k % per_seam;
    const int first = DIM == 2 ? along : along / BLOCKS, second = DIM == 2 ? 0 : along % BLOCKS;
    const int b = FIRST_ALONG(a), c = DIM == 2 ? b : SECOND_ALONG(a), earlier[4] = {was.s0, was.s1, was.s2, was.s3};
    const int count_b = count_along(&blocks, b), count_c = count_along(&blocks, c);
    const REAL period = PERIOD(a);
    wishes[k] = 0;
    if ((first >= count_b) | (second >= count_c) | !(period > 0)) {
        margins[k] = 0;
        return;
    }
    float margin = spread ? 0 : needed[k];
    for (int i = 0; spread && i < earlier[b]; ++i) {
        const float s = block_spacing(first, i, count_b, earlier[b], length_along(&blocks, b));
        for (int j = 0; j < (DIM == 2 ? 1 : earlier[c]); ++j) {
            const float other = needed[block_place(a, seam % 2, i, j)];
            if (!(other > margin)) /* one as deep changes nothing */
                continue;
            const float t = DIM == 2 ? 0.0f : block_spacing(second, j, count_c, earlier[c], length_along(&blocks, c));
            if (s * s + t * t < factor * factor * other * other)
                margin = other;
        }
    }
    margin *= factor;
    if (grow)
        margin = fmax(margins[k], fmin(margin, fmax(2 * margins[k], margin / 4)));
    if (margin > 0.99f * (float)period)
        margin = WHOLE_PERIOD; /* at least as deep as any image, whatever rounds */
    margins[k] = margin;
    atomic_max(extremes + a, as_int(margin));
    atomic_max(extremes + EXTREMES_LEAST + seam, as_int(WHOLE_PERIOD) - as_int(margin));
}

/* Per generator i: how many images it has. */
kernel void count_images(const int size, global const REAL *points, global const float *margins,
                         global const int *extremes, BLOCK_ARGS, global int *counts PERIOD_ARGS)
{
    WORK_ITEM(i);
    BLOCKS_GIVEN;
    REAL x[DIM], y[DIM];
    EACH_AXIS(a)
    x[a] = points[DIM * i + a];
    int count = 0;
    for (int codes = codes_near(x, extremes PERIODS); codes != 0;)
        count += make_image(x, take_code(&codes), margins, &blocks, y PERIODS);
    counts[i] = count;
}

/* Per generator i: its row of `extended`, and those of its images behind row n, in the order of owners and codes,
   whatever the margins; firsts are the prefix sums of the counts. */
kernel void place_images(const int size, global const REAL *points, global const float *margins,
                         global const int *extremes, BLOCK_ARGS, global const int *firsts, global REAL *extended,
                         global int *owners, global int *codes PERIOD_ARGS)
{
    WORK_ITEM(i);
    BLOCKS_GIVEN;
    REAL x[DIM], y[DIM];
    EACH_AXIS(a)
    extended[DIM * i + a] = x[a] = points[DIM * i + a];
    int g = firsts[i];
    for (int near = codes_near(x, extremes PERIODS); near != 0;) {
        const int code = take_code(&near);
        if (!make_image(x, code, margins, &blocks, y PERIODS))
            continue;
        EACH_AXIS(a)
        extended[DIM * (size + g) + a] = y[a];
        owners[g] = i;
        codes[g++] = code;
    }
}

#if DIM == 2
/* Per place p in bin order: the balls around the vertices of the cell of generator i = items[p]; reach[p] is twice the
   reach of the cell. `sideways` and `outwards` are shares of the shortest way between generators about a vertex. In 3D
   cells are looked at where they are made. */
kernel void measure_margins(const int size, global const int *items, global const float *reach,
                            global const REAL *points, global const int *starts, global const int *neighbors,
                            const REAL4 box_lower, const REAL4 box_upper SEAM_ARGS)
{
    WORK_ITEM(p);
    SEAMS_GIVEN;
    const REAL4 periods = seams.period;
    const int i = items[p];
    if (i >= seams.own)
        return;
    const int begin = starts[i], end = starts[i + 1];
    const REAL radius = reach[p] * (1 + BALL_NOISE), sideways = seams.sideways, outwards = seams.outwards;
    REAL x[DIM];
    bool near = false;
    EACH_AXIS(a)
    {
        x[a] = points[DIM * i + a];
        near = near || (PERIOD(a) > 0 && fmin(x[a], PERIOD(a) - x[a]) < (1 + sideways + outwards) * radius);
    }
    /* The ball that holds all others, with as much as any of them may move. */
    if (!near || !look_at_ball(x, radius, sideways * radius, outwards * radius, false, &seams))
        return;
    BOX_CORNERS(low, high);
    int before = neighbors[end - 1];
    for (int k = begin; k < end; ++k) {
        const int after = neighbors[k];
        const REAL2 v = corner(i, x, before, after, points, low, high);
        REAL2 u[2] = {2 * v, 2 * v};
        if (before >= 0)
            u[0] = direction_of(x, before, points);
        if (after >= 0)
            u[1] = direction_of(x, after, points);
        REAL least2 = fmin(dot(u[0], u[0]), dot(u[1], u[1]));
        if (before >= 0 && after >= 0)
            least2 = fmin(least2, dot(u[1] - u[0], u[1] - u[0]));
        const REAL y[2] = {x[0] + v.s0, x[1] + v.s1}, way = sqrt(least2);
        look_at_ball(y, sqrt(dot(v, v)), sideways * way, outwards * way, true, &seams);
        before = after;
    }
}
#endif

/* Per block: what is needed, as is wished, or else the share `kept` of its margin: cells that move to and fro do not
   make it too narrow in turn. */
kernel void note_margins(const int size, global const float *margins, const float kept, global const int *wishes,
                         global float *needed PERIOD_ARGS)
{
    WORK_ITEM(k);
    const int a = k / (2 * (DIM == 2 ? BLOCKS : BLOCKS * BLOCKS));
    needed[k] = fmax(as_float(wishes[k]), kept * fmin(margins[k], (float)PERIOD(a)));
}

/* The row of generator j's image with this code among those of `size` generators and their images, or -1. */
inline int find_image(int j, int code, int size, global const int *firsts, global const int *codes)
{
    for (int g = firsts[j]; g < firsts[j + 1]; ++g)
        if (codes[g] == code)
            return size + g;
    return -1;
}

/* Per generator i: its row of the extended diagram with the owners of images, and each face's code. kept[k]: does the
   neighbor see the face, too? Cells in the box and beyond it are made of the same differences, but cut in another
   order: rounding may let one see a face of no size that the other does not see. Such a face is to go, so that the
   graph is symmetric; counts are those of the others. */
kernel void fold_rows(const int size, global const int *starts, global const int *neighbors,
                      global const FACE *face_measures, global const REAL *volumes, global const REAL *points,
                      global const int *firsts, global const int *owners, global const int *codes, const REAL share,
                      const int nearest, global int *folded, global int *face_codes, global uchar *kept,
                      global int *counts, global int *report PERIOD_ARGS)
{
    WORK_ITEM(i);
    int count = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int label = neighbors[k];
        int j = label, code = CENTER;
        bool mutual = true;
        if (label >= size) {
            j = owners[label - size];
            code = codes[label - size];
            mutual = false;
            const int seen = find_image(i, CODES - 1 - code, size, firsts, codes);
            int times = 0;
            for (int q = starts[j]; q < starts[j + 1] && seen >= 0; ++q)
                times += neighbors[q] == seen;
            mutual = times > 0;
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
            const REAL measure = face_measures[k], way = sqrt(d2), cone = measure * way / (2 * DIM);
            /* Of cells as narrow as a rounding what their corners round by is much. */
            const REAL rounding = DIM == 2 ? 2 * REAL_EPS * way : R(0);
            const bool tiny = measure <= rounding || (measure < 2048 * REAL_EPS * (DIM == 2 ? R(1) : way) &&
                                                      cone <= share * volumes[i] && cone <= share * volumes[j]);
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
kernel void unfold_rows(const int size, global const int *starts, global const int *neighbors,
                        global const REAL *points, global const int *firsts, global const int *codes,
                        global int *unfolded PERIOD_ARGS)
{
    WORK_ITEM(i);
    REAL x[DIM];
    EACH_AXIS(a)
    x[a] = points[DIM * i + a];
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbors[k];
        int label = j < 0 ? -1 : j, wanted = CENTER, weight = 1;
        for (int a = 0; a < DIM && j >= 0; ++a, weight *= 3) {
            const REAL d = points[DIM * j + a] - x[a], half_period = PERIOD(a) / 2;
            if (half_period > 0 && fabs(d) > half_period)
                wanted += d < 0 ? weight : -weight;
        }
        unfolded[k] = wanted == CENTER ? label : find_image(j, wanted, size, firsts, codes);
    }
}
