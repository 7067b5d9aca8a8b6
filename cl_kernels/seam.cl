#include "common/domain.h"
#if DIM == 2
#include "common/corner.h"
#else
#include "common/clip.h"
#endif

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
#define FLAG_FULL 8      /* a cell has more faces than there is room for */

/* Share of a vertex's distance from the generator by which it rounds at most, and no cell grows that matters. */
#define BALL_NOISE (IS_DOUBLE ? R(1e-5) : R(1e-4))

inline int step_of(int code, int a)
{
    return (a == 0 ? code : a == 1 ? code / 3 : code / 9) % 3 - 1;
}

/* The axes along which seams across axis a are divided; the second one in space only. */
#define PERIOD_ALONG(a) ((a) == 0 ? PERIOD(0) : (a) == 1 ? PERIOD(1) : PERIOD(2))
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

/* How far the middles of blocks k and j of a seam are apart along an axis. */
inline float block_spacing(int k, int j, REAL length)
{
    return (float)length * (float)abs(k - j);
}

/* Per block: the margin that images are taken from next, `factor` times what was needed there or, with `spread`, where
   cells are others than then, within its own depth around. With `grow` it is no less than it was; then cells that
   lacked images may have told of more than they need, and it becomes wide in steps. widest[a] collects the largest
   along axis a, as bits of a float, which are in the order of floats >= 0. */
kernel void next_margins(const int size, global const float *needed, const float factor, const int spread,
                         const int grow, const REAL4 edge, global float *margins, global int *widest)
{
    WORK_ITEM(k);
    const int per_seam = DIM == 2 ? BLOCKS : BLOCKS * BLOCKS;
    const int a = k / (2 * per_seam), seam = k / per_seam, along = k % per_seam;
    const int first = DIM == 2 ? along : along / BLOCKS, second = DIM == 2 ? 0 : along % BLOCKS;
    const REAL length[4] = {edge.s0, edge.s1, edge.s2, edge.s3};
    const REAL period = PERIOD_ALONG(a);
    float margin = needed[k];
    for (int place = 0; spread && place < per_seam; ++place) {
        const float other = needed[seam * per_seam + place];
        const int i = DIM == 2 ? place : place / BLOCKS, j = DIM == 2 ? 0 : place % BLOCKS;
        const float s = block_spacing(first, i, length[FIRST_ALONG(a)]);
        const float t = DIM == 2 ? 0 : block_spacing(second, j, length[SECOND_ALONG(a)]);
        if (s * s + t * t < factor * factor * other * other)
            margin = fmax(margin, other);
    }
    margin *= factor;
    if (grow)
        margin = fmax(margins[k], fmin(margin, fmax(2 * margins[k], margin / 4)));
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

/* Blocks: where they begin and how long they are, their margins, and the wishes that are collected of each: bits of
   floats. */
typedef struct {
    REAL4 from, length;
    global const float *margins;
    float kept; /* share of a margin that it has next, whatever is wished */
    global int *wishes, *report;
} blocks_t;

/* Look at a ball around x of this radius that a generator in the box lies on. report[0] is set where it leaves the
   margins. The next ones have room for it where it may lie then: up to `sideways` along the seam and, until that
   generator is at the seam, as much outwards; after that by `outwards` more. Does it take any more than there will be
   anyway? Wishes are only told if `tell`. */
inline bool look_at_ball(const REAL *x, REAL radius, REAL sideways, REAL outwards, bool tell, const blocks_t *in)
{
    const REAL starts[4] = {in->from.s0, in->from.s1, in->from.s2, 0};
    const REAL lengths[4] = {in->length.s0, in->length.s1, in->length.s2, 1};
    if (!(radius < WHOLE)) /* a NaN, too: vertices of a whole cell lie within the box around */
        radius = WHOLE;
    radius *= 1 + BALL_NOISE;
    const REAL wide = radius + sideways;
    bool more = false;
    for (int seam = 0; seam < 2 * DIM; ++seam) {
        const int a = seam / 2, b = FIRST_ALONG(a), c = DIM == 2 ? b : SECOND_ALONG(a);
        const REAL period = PERIOD_ALONG(a);
        const REAL to_seam = seam % 2 ? period - x[a] : x[a];
        const REAL out = outwards + clamp(radius + to_seam, R(0), sideways);
        if (!(period > 0 && to_seam < radius + out))
            continue;
        const int last_b = block_of(x[b] + wide, b, in->from, in->length);
        const int first_c = DIM == 2 ? 0 : block_of(x[c] - wide, c, in->from, in->length);
        const int last_c = DIM == 2 ? 0 : block_of(x[c] + wide, c, in->from, in->length);
        for (int j = block_of(x[b] - wide, b, in->from, in->length); j <= last_b; ++j)
            for (int k = first_c; k <= last_c; ++k) {
                const int block = block_place(a, seam % 2, j, k);
                const float margin = in->margins[block];
                const REAL s = block_distance(x[b], starts[b], lengths[b], j);
                const REAL t = DIM == 2 ? R(0) : block_distance(x[c], starts[c], lengths[c], k);
                const REAL aside2 = s * s + t * t;
                /* What the wish has to be more than, as seen from the ball's middle. */
                const REAL known = fmax(in->kept * fmin(margin, (float)period) + to_seam - out, R(0));
                const REAL nearer = sideways > 0 ? fmax(sqrt(aside2) - sideways, R(0)) : sqrt(aside2);
                const REAL deep2 = radius * radius - nearer * nearer;
                if (!(deep2 > known * known))
                    continue;
                more = true;
                if (!tell)
                    return true;
                const float wish = 1.00001f * (float)(sqrt(deep2) - to_seam + out + 4 * REAL_EPS);
                if (wish > 0)
                    atomic_max(in->wishes + block, as_int(wish));
                const REAL deep = sqrt(fmax(radius * radius - aside2, R(0))) - to_seam;
                if (radius * radius > aside2 && margin < WHOLE && 1.00001f * (float)(deep + 4 * REAL_EPS) > margin)
                    atomic_or(in->report, 1);
            }
    }
    return more;
}

#if DIM == 3
inline REAL4 vertex_at(const cell_t *cell, int v)
{
    return (REAL4)(X(cell)[v], Y(cell)[v], Z(cell)[v], 0);
}

inline REAL square_of(REAL4 a)
{
    return a.s0 * a.s0 + a.s1 * a.s1 + a.s2 * a.s2;
}
#endif

/* Per place p in bin order: the balls around the vertices of the cell of generator i = items[p]; reach[p] is twice the
   reach of the cell. `sideways` and `outwards` are shares of the shortest way between generators about a vertex. In 3D
   the cell is clipped once more, by its neighbours alone, if it may not have been when there was room for `tried`
   faces. report[1] has FLAG_FULL where it has too many; when it is the `last` time, the ball that holds all others
   stands for them. */
kernel void measure_margins(const int size, global const int *items, global const float *reach,
                            global const REAL *points, const int n, global const int *starts,
                            global const int *neighbours, const REAL4 box_lower, const REAL4 box_upper,
                            const REAL4 lower, const REAL4 edge, const REAL sideways, const REAL outwards,
                            const float kept, const int tried, const int last, global const float *margins,
                            global int *wishes, global int *report)
{
    WORK_ITEM(p);
    const int i = items[p];
    if (i >= n)
        return;
    const int begin = starts[i], end = starts[i + 1];
    const REAL radius = reach[p] * (1 + BALL_NOISE);
    REAL x[DIM];
    bool near = false;
    EACH_AXIS(a)
    {
        x[a] = points[DIM * i + a];
        near = near || (PERIOD(a) > 0 && fmin(x[a], PERIOD(a) - x[a]) < (1 + sideways + outwards) * radius);
    }
    if (!near || (tried > 0 && end - begin + 2 * DIM <= tried))
        return;
    const blocks_t blocks = {lower, edge, margins, kept, wishes, report};
    /* The ball that holds all others: in 2D, where diagrams are few and far between, with as much as any of them may
       move, and else with as much as they do in a step. */
    const REAL moved = DIM == 2 ? radius : R(0);
    if (!look_at_ball(x, radius + (DIM == 2 ? R(0) : radius / 8), sideways * moved, outwards * moved, false, &blocks))
        return;
#if DIM == 2
    BOX_CORNERS(low, high);
    int before = neighbours[end - 1];
    for (int k = begin; k < end; ++k) {
        const int after = neighbours[k];
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
        look_at_ball(y, sqrt(dot(v, v)), sideways * way, outwards * way, true, &blocks);
        before = after;
    }
#else
    const REAL4 place = (REAL4)(x[0], x[1], x[2], 0);
    cell_t cell;
    start_cell(&cell, place, box_lower, box_upper);
    const int what = clip_by_row(&cell, i, place, starts, neighbours, points);
    if (what == CLIP_FULL && !last) {
        atomic_or(report + 1, FLAG_FULL);
        return;
    }
    if (what != CLIP_CUT) {
        look_at_ball(x, radius, sideways * radius, outwards * radius, true, &blocks);
        return;
    }
    for (int v = 0; v < cell.n; ++v) {
        const REAL4 at = vertex_at(&cell, v);
        const REAL r2 = square_of(at);
        const INDEX4 f = cell.faces[v];
        const int faces[3] = {f.s0, f.s1, f.s2};
        REAL least2 = 4 * r2;
        for (int k = 0; k < 3; ++k) {
            const int one = faces[k], other = faces[k == 2 ? 0 : k + 1];
            if (cell.labels[one] < 0)
                continue;
            const REAL4 d = cell.planes[one];
            least2 = fmin(least2, square_of(d));
            if (cell.labels[other] >= 0)
                least2 = fmin(least2, square_of(d - cell.planes[other]));
        }
        const REAL y[3] = {x[0] + at.s0, x[1] + at.s1, x[2] + at.s2}, way = sqrt(least2);
        look_at_ball(y, sqrt(r2), sideways * way, outwards * way, true, &blocks);
    }
#endif
}

/* Per block: what is needed, as is wished, or else the share `kept` of its margin: cells that move to and fro do not
   make it too narrow in turn. Wishes begin anew. */
kernel void note_margins(const int size, global const float *margins, const float kept, global int *wishes,
                         global float *needed)
{
    WORK_ITEM(k);
    const int a = k / (2 * (DIM == 2 ? BLOCKS : BLOCKS * BLOCKS));
    needed[k] = fmax(as_float(wishes[k]), kept * fmin(margins[k], (float)PERIOD_ALONG(a)));
    wishes[k] = 0;
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
