/* The halo of a periodic box. Each periodic boundary is divided into blocks with a depth each, within which ghost
   images are taken; ghost_images.cl explains why the balls around vertices determine these depths. HALO_ARGS come last
   in a kernel's signature and are empty for domains that are not periodic. MAKE_HALO declares `halo` from them. */
#include "geometry/weights.h"

#ifdef HALO
#ifndef BLOCKS
#error "build with -DBLOCKS=most blocks per axis along a periodic boundary"
#endif

#define WHOLE_PERIOD 4.0f /* exceeds any depth: positions lie in the unit box */

/* Bound of the round-off of a vertex, as a share of its distance from the generator. */
#define BALL_NOISE (IS_DOUBLE ? R(1e-5) : R(1e-4))

/* The axes along which boundaries across axis a are divided. The second exists in 3D only. */
#define FIRST_ALONG(a) ((a) == 0 ? 1 : 0)
#define SECOND_ALONG(a) ((a) == 2 ? 1 : 2)

/* Origin, length and number of blocks along each axis. */
typedef struct {
    REAL4 from, length;
    int4 count;
} blocks_t;

#define BLOCK_ARGS const REAL4 block_from, const REAL4 block_length, const int4 block_count
#define MAKE_BLOCKS const blocks_t blocks = {block_from, block_length, block_count}

/* The halo that balls are tested against. */
typedef struct {
    int own;      /* number of generators; images follow them */
    REAL4 period; /* 0 along axes with walls */
    blocks_t blocks;
    REAL sideways, outwards;            /* room for motion: see `check_ball` */
    float kept;                         /* least share of its depth that a block keeps */
    REAL most;                          /* largest weight, in a power diagram */
    REAL limits[2 * DIM];               /* balls less deep than this pass, at either end of each axis */
    global const float *depths;         /* per block */
    global int *requests, *too_shallow; /* output: per block, bits of floats; is the halo too shallow? */
} halo_t;

#ifdef WEIGHTED
#define MOST_WEIGHT weight_of_key(halo_most[0])
#else
#define MOST_WEIGHT 0
#endif

#define HALO_ARGS                                                                                                      \
    , const int halo_own, const REAL4 halo_period, BLOCK_ARGS, const REAL halo_sideways, const REAL halo_outwards,     \
        const float halo_kept, global const float *halo_depths, global const int *halo_extremes,                       \
        global int *halo_requests, global int *halo_too_shallow, global const int *halo_most
#define HALOS                                                                                                          \
    , halo_own, halo_period, block_from, block_length, block_count, halo_sideways, halo_outwards, halo_kept,           \
        halo_depths, halo_extremes, halo_requests, halo_too_shallow, halo_most
#define MAKE_HALO                                                                                                      \
    MAKE_BLOCKS;                                                                                                       \
    halo_t halo = {halo_own,    halo_period, blocks,      halo_sideways, halo_outwards,   halo_kept,                   \
                   MOST_WEIGHT, {0},         halo_depths, halo_requests, halo_too_shallow};                            \
    find_limits(&halo, halo_extremes)

/* Layout of `extremes`, as bits of floats, whose order is that of floats >= 0: the largest depth along each axis, and
   from EXTREMES_LEAST on WHOLE_PERIOD's bits minus those of the least depth at either end. All are found by atomic_max.
 */
#define EXTREMES_LEAST 4

inline void find_limits(halo_t *in, global const int *extremes)
{
    const REAL periods[3] = {in->period.s0, in->period.s1, in->period.s2};
    for (int side = 0; side < 2 * DIM; ++side) {
        const REAL period = periods[side / 2];
        const float least = as_float(as_int(WHOLE_PERIOD) - extremes[EXTREMES_LEAST + side]);
        in->limits[side] = period > 0 ? (REAL)(in->kept * fmin(least, (float)period)) : REAL_MAX;
    }
}

inline int count_along(const blocks_t *blocks, int a)
{
    const int counts[4] = {blocks->count.s0, blocks->count.s1, blocks->count.s2, blocks->count.s3};
    return counts[a];
}

inline REAL length_along(const blocks_t *blocks, int a)
{
    const REAL lengths[4] = {blocks->length.s0, blocks->length.s1, blocks->length.s2, blocks->length.s3};
    return lengths[a];
}

/* Block of coordinate y along an axis. The outermost blocks are unbounded. */
inline int block_of(REAL y, int a, const blocks_t *blocks)
{
    const REAL starts[4] = {blocks->from.s0, blocks->from.s1, blocks->from.s2, blocks->from.s3};
    return (int)clamp(floor((y - starts[a]) / length_along(blocks, a)), R(0), (REAL)(count_along(blocks, a) - 1));
}

/* Index of a block of the boundary at the lower (side 0) or upper end (1) of axis a. */
inline int block_place(int a, int side, int first, int second)
{
    const int along = DIM == 2 ? first : first * BLOCKS + second;
    return (2 * a + side) * (DIM == 2 ? BLOCKS : BLOCKS * BLOCKS) + along;
}

/* Squared distance of x from a block along an axis, reduced by the round-off with which positions are sorted into
 * blocks. */
inline REAL block_distance2(REAL x, int a, int block, const blocks_t *blocks)
{
    const REAL starts[4] = {blocks->from.s0, blocks->from.s1, blocks->from.s2, blocks->from.s3};
    const REAL length = length_along(blocks, a);
    const REAL below = block > 0 ? starts[a] + block * length - x : R(0);
    const REAL above = block < count_along(blocks, a) - 1 ? x - (starts[a] + (block + 1) * length) : R(0);
    const REAL away = fmax(fmax(below, above) - 16 * REAL_EPS, R(0));
    return away * away;
}

/* Radius of the ball around a vertex of a cell that is empty of generators. It has the squared distance r2 from the
   cell's generator, which has the weight w. In a power diagram it is less by the weight of the other generator: here it
   is that for the largest weight. */
inline REAL ball_radius(REAL r2, REAL w, const halo_t *in)
{
#ifdef WEIGHTED
    return sqrt(r2 + fmax(in->most - w, R(0)));
#else
    return sqrt(r2);
#endif
}

/* Test a ball around x that a generator in the box lies on. Sets too_shallow[0] if it leaves the halo. Requests depths
   with room for its motion: by up to `sideways` along the boundary, by as much outwards until that generator is on the
   boundary, and by `outwards` beyond. Returns whether it requires more than the next halo has anyway. Requests are
   written only if `record`. */
inline bool check_ball(const REAL *x, REAL radius, REAL sideways, REAL outwards, bool record, const halo_t *in)
{
    const blocks_t *blocks = &in->blocks;
    const REAL periods[4] = {in->period.s0, in->period.s1, in->period.s2, 0};
    if (!(radius < WHOLE_PERIOD)) /* also if it is NaN: vertices of a complete cell lie in the extended box */
        radius = WHOLE_PERIOD;
    radius *= 1 + BALL_NOISE;
    const REAL wide = radius + sideways;
    bool more = false;
    for (int side = 0; side < 2 * DIM; ++side) {
        const int a = side / 2, b = FIRST_ALONG(a), c = DIM == 2 ? b : SECOND_ALONG(a);
        const REAL period = periods[a];
        const REAL to_boundary = side % 2 ? period - x[a] : x[a];
        const REAL out = outwards + clamp(radius + to_boundary, R(0), sideways);
        if (!(period > 0 && to_boundary < radius + out))
            continue;
        /* Most balls are less deep than all blocks of the boundary. */
        const REAL most = radius - to_boundary + out;
        if (most <= in->limits[side])
            continue;
        const int first_b = block_of(x[b] - wide, b, blocks);
        const int last_b = block_of(x[b] + wide, b, blocks);
        const int first_c = DIM == 2 ? 0 : block_of(x[c] - wide, c, blocks);
        const int last_c = DIM == 2 ? 0 : block_of(x[c] + wide, c, blocks);
        /* Skip blocks that are deep enough for the deepest point of the ball. */
        const float enough = most <= in->kept * period ? 1.00001f * (float)(most / in->kept) : INFINITY;
        for (int j = first_b; j <= last_b; ++j)
            for (int k = first_c; k <= last_c; ++k) {
                const int block = block_place(a, side % 2, j, k);
                const float depth = in->depths[block];
                if (depth >= enough)
                    continue;
                const REAL aside2 =
                    block_distance2(x[b], b, j, blocks) + (DIM == 2 ? R(0) : block_distance2(x[c], c, k, blocks));
                /* A request must exceed this depth, measured from the ball's center. */
                const REAL known = fmax(in->kept * fmin(depth, (float)period) + to_boundary - out, R(0));
                const REAL nearer = sideways > 0 ? fmax(sqrt(aside2) - sideways, R(0)) : sqrt(aside2);
                const REAL deep2 = radius * radius - nearer * nearer;
                if (!(deep2 > known * known))
                    continue;
                more = true;
                if (!record)
                    return true;
                const float request = 1.00001f * (float)(sqrt(deep2) - to_boundary + out + 4 * REAL_EPS);
                if (request > 0)
                    atomic_max(in->requests + block, as_int(request));
                const REAL deep = sqrt(fmax(radius * radius - aside2, R(0))) - to_boundary;
                if (radius * radius > aside2 && depth < WHOLE_PERIOD && 1.00001f * (float)(deep + 4 * REAL_EPS) > depth)
                    atomic_or(in->too_shallow, 1);
            }
    }
    return more;
}

#if DIM == 3
/* Largest possible shortest distance of four points on a unit sphere: sqrt(8 / 3). */
#define WIDEST_WAY R(1.633)

/* Does a ball of radius `wide` around y reach deeper than the limits? */
inline bool reaches_beyond(const REAL *y, REAL wide, const halo_t *in)
{
    const REAL periods[3] = {in->period.s0, in->period.s1, in->period.s2};
    bool beyond = false;
    EACH_AXIS (a)
        beyond = beyond || !(wide - y[a] <= in->limits[2 * a] && wide + y[a] - periods[a] <= in->limits[2 * a + 1]);
    return beyond;
}

/* Radius that contains a ball of radius 1 with its room for motion. */
inline REAL widest_ball(const halo_t *in)
{
    return 1 + BALL_NOISE + (in->sideways + in->outwards) * WIDEST_WAY;
}

/* Test the ball around a vertex, at `at` from generator i at x with the weight w, where the faces with three others
   meet. Generator k of these is at ways[k] from x, unless labels[k] is a wall. All cells at the vertex test whether the
   halo is deep enough. Only the one with the least generator adds room for motion, as all compute the same. `sideways`
   and `outwards` are shares of the shortest distance between two of the generators. */
inline void check_vertex_ball(const REAL *x, REAL w, int i, REAL4 at, const REAL4 *ways, const int *labels,
                              const halo_t *in)
{
    const REAL radius = ball_radius(at.s0 * at.s0 + at.s1 * at.s1 + at.s2 * at.s2, w, in);
    REAL way = 0;
    if ((labels[0] > i || labels[0] < 0) && (labels[1] > i || labels[1] < 0) && (labels[2] > i || labels[2] < 0)) {
        REAL least2 = WIDEST_WAY * WIDEST_WAY * radius * radius;
        for (int k = 0; k < 3; ++k) {
            const int other = k == 2 ? 0 : k + 1;
            const REAL4 d = ways[k], e = d - ways[other];
            if (labels[k] >= 0)
                least2 = fmin(least2, d.s0 * d.s0 + d.s1 * d.s1 + d.s2 * d.s2);
            if (labels[k] >= 0 && labels[other] >= 0)
                least2 = fmin(least2, e.s0 * e.s0 + e.s1 * e.s1 + e.s2 * e.s2);
        }
        way = sqrt(least2);
    }
    const REAL y[3] = {x[0] + at.s0, x[1] + at.s1, x[2] + at.s2};
    if (reaches_beyond(y, radius * (1 + BALL_NOISE) + (in->sideways + in->outwards) * way, in))
        check_ball(y, radius, in->sideways * way, in->outwards * way, true, in);
}
#endif

#else
#define HALO_ARGS
#define HALOS
#endif
