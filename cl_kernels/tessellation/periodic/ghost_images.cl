#include "geometry/domain.h"
#if DIM == 2
#include "tessellation/corner.h"
#else
#include "tessellation/row_counts.h"
#endif
#include "tessellation/periodic/halo.h"

/* Periodic boxes. Generators x in [0, P) are extended by their ghost images x + c P, c in {-1, 0, 1}^d, that lie in a
   halo around the box. The kernels that make the diagram of generators and images know of no period. The rows of the
   generators are then folded: each image is replaced by its owner and the code of c.

   Each periodic boundary is divided into blocks, and the halo has a depth per block, so that one large cell does not
   require images of small cells elsewhere. The balls around the vertices of a cell through its generator contain no
   other generator. The cell is therefore correct if the halo is as deep, in each block, as these balls reach there.
   They are far smaller than the ball around the whole cell where sizes grow steeply. A depth of P is always enough: the
   images of a cell's own generator cut it to a length of P, so that for every generator the image nearest to a point of
   the cell lies within [-P, 2 P]. */

#ifndef PERIODIC
#error "build with -DPERIODIC"
#endif
#define CODES (DIM == 2 ? 9 : 27) /* of images: sum over the axes a of (c + 1) 3^a */
#define CENTER (CODES / 2)

/* Bits of report[1]. */
#define FLAG_DROPPED 1 /* a face below round-off that only one of its cells has; it is to be dropped */
#define FLAG_FAR 2     /* a neighbor is not the nearest image; report[2] is the least generator with such a neighbor */
#define FLAG_UNMATCHED 4 /* a face that only one of its cells has is larger than round-off; report[2] likewise */

inline int step_of(int code, int a)
{
    return (a == 0 ? code : a == 1 ? code / 3 : code / 9) % 3 - 1;
}

/* Place value of the step along axis a in a code, and the bits of the codes with step -1 along axis a. Those with step
   0 and 1 are shifted by once and twice the place value. */
#define PLACE_VALUE(a) ((a) == 0 ? 1 : (a) == 1 ? 3 : 9)
#define BACK(a) ((a) == 0 ? 0x1249249 : (a) == 1 ? 0x1c0e07 : 0x1ff)

/* Bits of the codes whose images of x lie within the largest depth along each axis. Most generators have none. */
inline int codes_near(const REAL *x, global const int *extremes PERIOD_ARGS)
{
    int codes = (1 << CODES) - 1;
    EACH_AXIS (a) {
        const REAL period = PERIOD(a), wide = as_float(extremes[a]);
        const bool back = period > 0 && period - x[a] <= wide, ahead = period > 0 && x[a] <= wide;
        codes &= (back ? BACK(a) : 0) | BACK(a) << PLACE_VALUE(a) | (ahead ? BACK(a) << 2 * PLACE_VALUE(a) : 0);
    }
    return codes & ~(1 << CENTER);
}

/* Remove the lowest code from the set and return it. */
inline int take_code(int *codes)
{
    const int code = 31 - (int)clz(*codes & -*codes);
    *codes &= *codes - 1;
    return code;
}

/* Compute the image y of x with this code. Returns whether it lies in the halo. */
inline bool make_image(const REAL *x, int code, global const float *depths, const blocks_t *blocks, REAL *y PERIOD_ARGS)
{
    EACH_AXIS (a)
        y[a] = x[a] + step_of(code, a) * PERIOD(a);
    EACH_AXIS (a) {
        const int step = step_of(code, a);
        if (step == 0)
            continue;
        const int first = block_of(y[FIRST_ALONG(a)], FIRST_ALONG(a), blocks);
        const int second = DIM == 2 ? 0 : block_of(y[DIM == 2 ? 0 : SECOND_ALONG(a)], SECOND_ALONG(a), blocks);
        const REAL depth = step < 0 ? -y[a] : y[a] - PERIOD(a);
        if (!(depth <= depths[block_place(a, step > 0, first, second)]))
            return false;
    }
    return true;
}

/* Distance along an axis between the centers of block k of `count` and block j of `was` blocks, less half the
   difference of their lengths: 0 if one lies in the other. */
inline float block_spacing(int k, int j, int count, int was, REAL length)
{
    const float one = (float)length, other = one * (float)count / (float)was;
    return fmax(fabs(one * ((float)k + 0.5f) - other * ((float)j + 0.5f)) - fabs(one - other) / 2, 0.0f);
}

/* Per block: the depth of the next halo, `factor` times the required depth. With `spread`, where cells or blocks have
   changed (`was` blocks along each axis before), take the largest required depth among blocks no farther away than that
   depth. With `grow` the depth does not decrease, and increases stepwise, since cells that lacked images may have
   required too much. Collects `extremes` (tessellation/periodic/halo.h) and clears the requests. */
kernel void predict_halo_depths(const int size, global const float *required, const int4 was, const float factor,
                                const int spread, const int grow, BLOCK_ARGS, global float *depths,
                                global int *extremes, global int *requests PERIOD_ARGS)
{
    WORK_ITEM(k);
    MAKE_BLOCKS;
    const int per_side = DIM == 2 ? BLOCKS : BLOCKS * BLOCKS;
    const int a = k / (2 * per_side), side = k / per_side, along = k % per_side;
    const int first = DIM == 2 ? along : along / BLOCKS, second = DIM == 2 ? 0 : along % BLOCKS;
    const int b = FIRST_ALONG(a), c = DIM == 2 ? b : SECOND_ALONG(a), earlier[4] = {was.s0, was.s1, was.s2, was.s3};
    const int count_b = count_along(&blocks, b), count_c = count_along(&blocks, c);
    const REAL period = PERIOD(a);
    requests[k] = 0;
    if ((first >= count_b) | (second >= count_c) | !(period > 0)) {
        depths[k] = 0;
        return;
    }
    float depth = spread ? 0 : required[k];
    for (int i = 0; spread && i < earlier[b]; ++i) {
        const float s = block_spacing(first, i, count_b, earlier[b], length_along(&blocks, b));
        for (int j = 0; j < (DIM == 2 ? 1 : earlier[c]); ++j) {
            const float other = required[block_place(a, side % 2, i, j)];
            if (!(other > depth)) /* cannot change the maximum */
                continue;
            const float t = DIM == 2 ? 0.0f : block_spacing(second, j, count_c, earlier[c], length_along(&blocks, c));
            if (s * s + t * t < factor * factor * other * other)
                depth = other;
        }
    }
    depth *= factor;
    if (grow)
        depth = fmax(depths[k], fmin(depth, fmax(2 * depths[k], depth / 4)));
    if (depth > 0.99f * (float)period)
        depth = WHOLE_PERIOD; /* includes every image, whatever the round-off */
    depths[k] = depth;
    atomic_max(extremes + a, as_int(depth));
    atomic_max(extremes + EXTREMES_LEAST + side, as_int(WHOLE_PERIOD) - as_int(depth));
}

/* Per generator i: counts[i] = number of its images. */
kernel void count_images(const int size, global const REAL *points, global const float *depths,
                         global const int *extremes, BLOCK_ARGS, global int *counts PERIOD_ARGS)
{
    WORK_ITEM(i);
    MAKE_BLOCKS;
    REAL x[DIM], y[DIM];
    EACH_AXIS (a)
        x[a] = points[STRIDE * i + a];
    int count = 0;
    for (int codes = codes_near(x, extremes PERIODS); codes != 0;)
        count += make_image(x, take_code(&codes), depths, &blocks, y PERIODS);
    counts[i] = count;
}

inline void put_site(global REAL *points, int i, const REAL *x, REAL weight)
{
    EACH_AXIS (a)
        points[STRIDE * i + a] = x[a];
#ifdef WEIGHTED
    WEIGHT(points, i) = weight;
#endif
}

/* Per generator i: copy it to row i of `extended`, and write its images behind row n. Their order, by owner and code,
   does not depend on the depths. firsts are the prefix sums of the counts. */
kernel void place_images(const int size, global const REAL *points, global const float *depths,
                         global const int *extremes, BLOCK_ARGS, global const int *firsts, global REAL *extended,
                         global int *owners, global int *codes PERIOD_ARGS)
{
    WORK_ITEM(i);
    MAKE_BLOCKS;
    REAL x[DIM], y[DIM];
    EACH_AXIS (a)
        x[a] = points[STRIDE * i + a];
    put_site(extended, i, x, WEIGHT(points, i));
    int g = firsts[i];
    for (int near = codes_near(x, extremes PERIODS); near != 0;) {
        const int code = take_code(&near);
        if (!make_image(x, code, depths, &blocks, y PERIODS))
            continue;
        put_site(extended, size + g, y, WEIGHT(points, i));
        owners[g] = i;
        codes[g++] = code;
    }
}

#if DIM == 2
/* Per place p in bin order: test the balls around the vertices of the cell of generator i = items[p]. reach[p] is twice
   the distance of the farthest vertex. `sideways` and `outwards` are shares of the shortest distance between generators
   about a vertex. In 3D the kernels that clip cells do this. */
kernel void measure_required_depths(const int size, global const int *items, global const float *reach,
                                    global const REAL *points, global const int *starts, global const int *neighbors,
                                    const REAL4 box_lower, const REAL4 box_upper HALO_ARGS)
{
    WORK_ITEM(p);
    MAKE_HALO;
    const REAL4 periods = halo.period;
    const int i = items[p];
    if (i >= halo.own)
        return;
    const int begin = starts[i], end = starts[i + 1];
    if (begin == end)
        return;
    SITE(x, i, points);
    const REAL far = (REAL)reach[p] / 2, sideways = halo.sideways, outwards = halo.outwards;
    const REAL radius = (far + ball_radius(far * far, SITE_WEIGHT(x), &halo)) * (1 + BALL_NOISE);
    bool near = false;
    EACH_AXIS (a) {
        near = near || (PERIOD(a) > 0 && fmin(x[a], PERIOD(a) - x[a]) < (1 + sideways + outwards) * radius);
    }
    /* One ball that contains all others and their room for motion. */
    if (!near || !check_ball(x, radius, sideways * radius, outwards * radius, false, &halo))
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
        check_ball(y, ball_radius(dot(v, v), SITE_WEIGHT(x), &halo), sideways * way, outwards * way, true, &halo);
        before = after;
    }
}
#endif

/* Per block: the required depth is the request, or the share `kept` of the depth if that is more, so that cells that
   oscillate do not make the halo too shallow in every other step. */
kernel void store_required_depths(const int size, global const float *depths, const float kept,
                                  global const int *requests, global float *required PERIOD_ARGS)
{
    WORK_ITEM(k);
    const int a = k / (2 * (DIM == 2 ? BLOCKS : BLOCKS * BLOCKS));
    required[k] = fmax(as_float(requests[k]), kept * fmin(depths[k], (float)PERIOD(a)));
}

/* Row in the extended diagram of generator j's image with this code; -1 if there is none. */
inline int find_image(int j, int code, int size, global const int *firsts, global const int *codes)
{
    for (int g = firsts[j]; g < firsts[j + 1]; ++g)
        if (codes[g] == code)
            return size + g;
    return -1;
}

/* Per generator i: its row of the extended diagram with images replaced by their owners, and the code of each face.
   kept[k] tells whether the neighbor has the face as well. Cells on both sides of a periodic boundary are computed from
   the same differences, but cut in another order: due to round-off one cell may have a face below round-off that the
   other lacks. Such faces are dropped, so that the graph is symmetric. counts[i] is the number of faces kept. */
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
            EACH_AXIS (a) {
                const REAL d = points[STRIDE * label + a] - points[STRIDE * i + a];
                far = far || DIFFERENCE(a, points[STRIDE * i + a], points[STRIDE * j + a]) != d;
                d2 += d * d;
            }
            const REAL measure = face_measures[k], way = sqrt(d2), cone = measure * way / (2 * DIM);
            /* In cells as narrow as round-off the corners have large errors. */
            const REAL rounding = DIM == 2 ? 2 * REAL_EPS * way : R(0);
            REAL least = share * fmin(volumes[i], volumes[j]);
#ifdef WEIGHTED
            /* Cells may be so small that they are uncertain, as long as that is round-off of the other. */
            least = fmax(least, 64 * REAL_EPS * fmax(volumes[i], volumes[j]));
#endif
            const bool tiny =
                measure <= rounding || (measure < 2048 * REAL_EPS * (DIM == 2 ? R(1) : way) && cone <= least);
            const int flag = mutual ? 0 : (tiny ? FLAG_DROPPED : FLAG_UNMATCHED);
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

/* Per generator i: copy its row without the dropped faces. places[k] is the former index of face k. */
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
        EACH_AXIS (a)
            new_centroids[DIM * to + a] = face_centroids[DIM * k + a];
        places[to++] = k;
    }
}

/* Per generator i: the measures of its faces, times the ratio of two distances: to the nearest image of the neighbor,
   and to the image across the face. Over the former, as the Poisson matrix divides them, they are those over the
   latter. */
kernel void scale_far_measures(const int size, global const int *starts, global const int *folded,
                               global const int *face_codes, global const FACE *face_measures,
                               global const REAL *points, global FACE *scaled PERIOD_ARGS)
{
    WORK_ITEM(i);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = folded[k];
        REAL near2 = 0, across2 = 0;
        for (int a = 0; a < DIM && j >= 0; ++a) {
            const REAL from = points[STRIDE * i + a], to = points[STRIDE * j + a];
            const REAL near = DIFFERENCE(a, from, to), across = to + step_of(face_codes[k], a) * PERIOD(a) - from;
            near2 += near * near;
            across2 += across * across;
        }
        scaled[k] = across2 > near2 ? face_measures[k] * sqrt(near2 / across2) : face_measures[k];
    }
}

/* Per generator i: its row of an earlier folded graph as a row of the extended graph. Owners are replaced by the image
   nearest now, or by -1 if it is not in the halo. Cells only start from these rows; they need not be complete. */
kernel void unfold_rows(const int size, global const int *starts, global const int *neighbors,
                        global const REAL *points, global const int *firsts, global const int *codes,
                        global int *unfolded PERIOD_ARGS)
{
    WORK_ITEM(i);
    REAL x[DIM];
    EACH_AXIS (a)
        x[a] = points[STRIDE * i + a];
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbors[k];
        int label = j < 0 ? -1 : j, wanted = CENTER, weight = 1;
        for (int a = 0; a < DIM && j >= 0; ++a, weight *= 3) {
            const REAL d = points[STRIDE * j + a] - x[a], half_period = PERIOD(a) / 2;
            if (half_period > 0 && fabs(d) > half_period)
                wanted += d < 0 ? weight : -weight;
        }
        unfolded[k] = wanted == CENTER ? label : find_image(j, wanted, size, firsts, codes);
    }
}

#if DIM == 3
/* Per generator i whose cell was clipped while a folded diagram is updated: replace images by their owners. These cells
   begin from place `used` on, and there is room for `room` faces. FLAG_FULL: the halo is too shallow, or a neighbor is
   so far away that those about a vertex need not be nearest images of each other (polyhedra_update.cl). */
kernel void fold_clipped_cells(const int size, const int used, const int room, global const int *row_places,
                               global const int *row_counts, global const REAL *points, global const int *owners,
                               global const int *halo_report, global int *labels, global int *report PERIOD_ARGS)
{
    WORK_ITEM(i);
    if (halo_report[0])
        atomic_or(report + REPORT_FLAGS, FLAG_FULL);
    if (row_counts[i] == UNFINISHED || row_places[i] < used || report[REPORT_FACES] > room)
        return;
    const int begin = row_places[i], end = begin + COUNT_OF(row_counts[i]);
    for (int k = begin; k < end; ++k) {
        const int label = labels[k];
        EACH_AXIS (a)
            if (label >= 0 && PERIOD(a) > 0 && fabs(points[3 * label + a] - points[3 * i + a]) >= PERIOD(a) / 4)
                atomic_or(report + REPORT_FLAGS, FLAG_FULL);
        if (label >= size)
            labels[k] = owners[label - size];
    }
}
#endif
