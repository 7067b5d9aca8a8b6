/* Seams of periodic boxes are divided into blocks, each with a margin of its own within which images are taken; what
   cells need of them is found by the balls around their vertices (see seam.cl). SEAM_ARGS come last in a kernel's
   signature and are empty in boxes that have no seams; SEAMS_GIVEN makes `seams` of them. */
#include "opencl/real.h"

#ifdef SEAMS
#ifndef BLOCKS
#error "build with -DBLOCKS=most blocks per axis along a seam"
#endif

#define WHOLE_PERIOD 4.0f /* more than any depth: positions lie in the unit box */

/* Share of a vertex's distance from the generator by which it rounds at most, and no cell grows that matters. */
#define BALL_NOISE (IS_DOUBLE ? R(1e-5) : R(1e-4))

/* The axes along which seams across axis a are divided; the second one in space only. */
#define FIRST_ALONG(a) ((a) == 0 ? 1 : 0)
#define SECOND_ALONG(a) ((a) == 2 ? 1 : 2)

/* The blocks: where they begin along each axis, how long they are, and how many. */
typedef struct {
    REAL4 from, length;
    int4 count;
} blocks_t;

#define BLOCK_ARGS const REAL4 block_from, const REAL4 block_length, const int4 block_count
#define BLOCKS_GIVEN const blocks_t blocks = {block_from, block_length, block_count}

/* What balls are held against. */
typedef struct {
    int own;      /* generators in the box; they come first, then the images */
    REAL4 period; /* 0 across walls */
    blocks_t blocks;
    REAL sideways, outwards;      /* shares of the ways between generators: see `look_at_ball` */
    float kept;                   /* share of a margin that it has next, whatever is wished */
    REAL limits[2 * DIM];         /* depths that no ball need be looked at for, at either end of each axis */
    global const float *margins;  /* of blocks */
    global int *wishes, *lacking; /* collected: of blocks, bits of floats; is a margin too narrow? */
} seams_t;

#define SEAM_ARGS                                                                                                      \
    , const int seam_own, const REAL4 seam_period, BLOCK_ARGS, const REAL seam_sideways, const REAL seam_outwards,     \
        const float seam_kept, global const float *seam_margins, global const int *seam_extremes,                      \
        global int *seam_wishes, global int *seam_lacking
#define SEAMS_GIVEN                                                                                                    \
    BLOCKS_GIVEN;                                                                                                      \
    seams_t seams = {seam_own,  seam_period, blocks,       seam_sideways, seam_outwards,                               \
                     seam_kept, {0},         seam_margins, seam_wishes,   seam_lacking};                               \
    find_limits(&seams, seam_extremes)

/* Of margins, as bits of floats, which are in the order of floats >= 0: the largest along each axis, and from
   EXTREMES_LEAST on WHOLE_PERIOD's less those of the least at either end. All are sought by atomic_max. */
#define EXTREMES_LEAST 4

inline void find_limits(seams_t *in, global const int *extremes)
{
    const REAL periods[3] = {in->period.s0, in->period.s1, in->period.s2};
    for (int seam = 0; seam < 2 * DIM; ++seam) {
        const REAL period = periods[seam / 2];
        const float least = as_float(as_int(WHOLE_PERIOD) - extremes[EXTREMES_LEAST + seam]);
        in->limits[seam] = period > 0 ? (REAL)(in->kept * fmin(least, (float)period)) : REAL_MAX;
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

/* Block of coordinate y along an axis: the outermost ones go on for ever. */
inline int block_of(REAL y, int a, const blocks_t *blocks)
{
    const REAL starts[4] = {blocks->from.s0, blocks->from.s1, blocks->from.s2, blocks->from.s3};
    return (int)clamp(floor((y - starts[a]) / length_along(blocks, a)), R(0), (REAL)(count_along(blocks, a) - 1));
}

/* Place of a block of the seam at the lower (side 0) or upper end (1) of axis a. */
inline int block_place(int a, int side, int first, int second)
{
    const int along = DIM == 2 ? first : first * BLOCKS + second;
    return (2 * a + side) * (DIM == 2 ? BLOCKS : BLOCKS * BLOCKS) + along;
}

/* Square of how far x lies from a block along an axis; a little less, as positions are put into blocks with
   rounding. */
inline REAL block_distance2(REAL x, int a, int block, const blocks_t *blocks)
{
    const REAL starts[4] = {blocks->from.s0, blocks->from.s1, blocks->from.s2, blocks->from.s3};
    const REAL length = length_along(blocks, a);
    const REAL below = block > 0 ? starts[a] + block * length - x : R(0);
    const REAL above = block < count_along(blocks, a) - 1 ? x - (starts[a] + (block + 1) * length) : R(0);
    const REAL away = fmax(fmax(below, above) - 16 * REAL_EPS, R(0));
    return away * away;
}

/* Look at a ball around x of this radius that a generator in the box lies on. lacking[0] is set where it leaves the
   margins. The next ones have room for it where it may lie then: up to `sideways` along the seam and, until that
   generator is at the seam, as much outwards; after that by `outwards` more. Does it take any more than there will be
   anyway? Wishes are only told if `tell`. */
inline bool look_at_ball(const REAL *x, REAL radius, REAL sideways, REAL outwards, bool tell, const seams_t *in)
{
    const blocks_t *blocks = &in->blocks;
    const REAL periods[4] = {in->period.s0, in->period.s1, in->period.s2, 0};
    if (!(radius < WHOLE_PERIOD)) /* a NaN, too: vertices of a whole cell lie within the box around */
        radius = WHOLE_PERIOD;
    radius *= 1 + BALL_NOISE;
    const REAL wide = radius + sideways;
    bool more = false;
    for (int seam = 0; seam < 2 * DIM; ++seam) {
        const int a = seam / 2, b = FIRST_ALONG(a), c = DIM == 2 ? b : SECOND_ALONG(a);
        const REAL period = periods[a];
        const REAL to_seam = seam % 2 ? period - x[a] : x[a];
        const REAL out = outwards + clamp(radius + to_seam, R(0), sideways);
        if (!(period > 0 && to_seam < radius + out))
            continue;
        /* Most balls go less deep than all margins of the seam. */
        const REAL most = radius - to_seam + out;
        if (most <= in->limits[seam])
            continue;
        const int first_b = block_of(x[b] - wide, b, blocks);
        const int last_b = block_of(x[b] + wide, b, blocks);
        const int first_c = DIM == 2 ? 0 : block_of(x[c] - wide, c, blocks);
        const int last_c = DIM == 2 ? 0 : block_of(x[c] + wide, c, blocks);
        /* Nor need it be looked at where they are deep enough for the middle of the ball. */
        const float enough = most <= in->kept * period ? 1.00001f * (float)(most / in->kept) : INFINITY;
        for (int j = first_b; j <= last_b; ++j)
            for (int k = first_c; k <= last_c; ++k) {
                const int block = block_place(a, seam % 2, j, k);
                const float margin = in->margins[block];
                if (margin >= enough)
                    continue;
                const REAL aside2 =
                    block_distance2(x[b], b, j, blocks) + (DIM == 2 ? R(0) : block_distance2(x[c], c, k, blocks));
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
                if (radius * radius > aside2 && margin < WHOLE_PERIOD &&
                    1.00001f * (float)(deep + 4 * REAL_EPS) > margin)
                    atomic_or(in->lacking, 1);
            }
    }
    return more;
}

#if DIM == 3
/* No four points on a ball are all farther from each other than this, in its radii: sqrt(8 / 3). */
#define WIDEST_WAY R(1.633)

/* Does what is `wide` around y reach deeper beyond a seam than no ball need be looked at for? */
inline bool reaches_beyond(const REAL *y, REAL wide, const seams_t *in)
{
    const REAL periods[3] = {in->period.s0, in->period.s1, in->period.s2};
    bool beyond = false;
    EACH_AXIS(a)
    beyond = beyond || !(wide - y[a] <= in->limits[2 * a] && wide + y[a] - periods[a] <= in->limits[2 * a + 1]);
    return beyond;
}

/* How wide a ball of radius 1 may be, with all that it may move. */
inline REAL widest_of(const seams_t *in)
{
    return 1 + BALL_NOISE + (in->sideways + in->outwards) * WIDEST_WAY;
}

/* Look at the ball around a vertex, at `at` from generator i at x, where the faces with three others meet: these are
   at ways[k] from it, if labels[k] is no wall. Whether margins are wide enough all cells say; for what may move the
   first of the generators on the ball that are in the box speaks, as all see the same. `sideways` and `outwards` are
   shares of the shortest way between two of them. */
inline void look_at_vertex(const REAL *x, int i, REAL4 at, const REAL4 *ways, const int *labels, const seams_t *in)
{
    const REAL radius = sqrt(at.s0 * at.s0 + at.s1 * at.s1 + at.s2 * at.s2);
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
        look_at_ball(y, radius, in->sideways * way, in->outwards * way, true, in);
}
#endif

#else
#define SEAM_ARGS
#endif
