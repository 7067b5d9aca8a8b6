/* A cell in 3D that one work-item places and measures. */
#include "tessellation/cell_corners3d.h"

/* Pad the planes to whole vectors by those of no neighbor, p = 0. */
inline void pad_planes(CORNERS *cell)
{
    const int end = (cell->faces + WIDTH - 1) / WIDTH * WIDTH;
    for (int f = cell->faces; f < end; ++f)
        cell->planes[f] = 0;
}

/* Sums of the shares of the vertices: of each face (area, first moments), and second moments of the cell. */
typedef struct {
    REAL4 faces[MOST_FACES];
    WIDE xx[HALVES], yy[HALVES], zz[HALVES], yz[HALVES], zx[HALVES], xy[HALVES];
} sums_t;
#define SUMS LANE_SPACE sums_t

/* Find the vertices and sum them up. False if faces at a vertex are nearly parallel or not counter-clockwise, or a
   neighbor is very near. `reach2` and `beyond` are set. The sums are incomplete if a vertex lies beyond another face,
   or without `measured`. */
inline bool place_corners(CORNERS *cell, SUMS *sums, bool measured)
{
    const int blocks = (cell->corners + WIDTH - 1) / WIDTH;
    for (int v = cell->corners; v < WIDTH * blocks; ++v)
        cell->at[v] = cell->at[0];
    for (int f = 0; f < cell->faces; ++f)
        sums->faces[f] = 0;
    for (int turn = 0; turn < HALVES; ++turn)
        sums->xx[turn] = sums->yy[turn] = sums->zz[turn] = sums->yz[turn] = sums->zx[turn] = sums->xy[turn] = 0;
    WIDE far2 = 0, good = 1;
    bool fits = measured;
    for (int block = 0; block < blocks; ++block) {
        int at_a[WIDTH], at_b[WIDTH], at_c[WIDTH];
        for (int lane = 0; lane < WIDTH; ++lane) {
            const uchar4 at = cell->at[WIDTH * block + lane];
            at_a[lane] = at.s0;
            at_b[lane] = at.s1;
            at_c[lane] = at.s2;
        }
        places_t a, b, c;
        WIDE ia, ib, ic;
        gather_lanes(&a, &ia, cell->planes, at_a);
        gather_lanes(&b, &ib, cell->planes, at_b);
        gather_lanes(&c, &ic, cell->planes, at_c);
        corner_t corner;
        find_corner(&corner, &a, &b, &c);
        const places_t y = corner.y;
        cell->x[block] = y.x;
        cell->y[block] = y.y;
        cell->z[block] = y.z;
        far2 = corner.y2 > far2 ? corner.y2 : far2;
        good *= corner.good;
        /* Two independent chains of comparisons, which the processor overlaps. */
        WIDE beyond = -1, others = -1;
        for (int f = 0; f < cell->faces; f += 2) {
            const REAL4 p = cell->planes[f], q = cell->planes[min(f + 1, cell->faces - 1)];
            const WIDE s = fma(p.s0, y.x, fma(p.s1, y.y, p.s2 * y.z));
            const WIDE t = fma(q.s0, y.x, fma(q.s1, y.y, q.s2 * y.z));
            beyond = s > beyond ? s : beyond;
            others = t > others ? t : others;
        }
        beyond = others > beyond ? others : beyond;
        cell->beyond[block] = beyond - R(0.5);
        fits = fits && !(largest_lane(beyond) > R(0.5) + BEYOND_NOISE);
        if (!fits)
            continue;

        const int turn = HALF_OF(block), lanes = min(WIDTH, cell->corners - WIDTH * block);
        /* Lanes behind the last vertex count nothing. */
        REAL here[WIDTH];
        for (int lane = 0; lane < WIDTH; ++lane)
            here[lane] = lane < lanes;
        const WIDE once = LOAD_WIDE(0, here);
        shares_t share;
        share_corner(&share, &corner, &a, &b, &c, ia, ib, ic, once);
        REAL4 of_a[WIDTH], of_b[WIDTH], of_c[WIDTH];
        rows_of_lanes(of_a, share.a, &share.first_a);
        rows_of_lanes(of_b, share.b, &share.first_b);
        rows_of_lanes(of_c, share.c, &share.first_c);
        for (int lane = 0; lane < lanes; ++lane) {
            sums->faces[at_a[lane]] += of_a[lane];
            sums->faces[at_b[lane]] += of_b[lane];
            sums->faces[at_c[lane]] += of_c[lane];
        }
        sums->xx[turn] += share.xx;
        sums->yy[turn] += share.yy;
        sums->zz[turn] += share.zz;
        sums->yz[turn] += share.yz;
        sums->zx[turn] += share.zx;
        sums->xy[turn] += share.xy;
    }
    cell->reach2 = largest_lane(far2);
    REAL nearest2 = INFINITY;
    for (int f = 0; f < cell->faces; ++f)
        nearest2 = fmin(nearest2, cell->planes[f].s3);
    return largest_lane(-good) < 0 && nearest2 > LEAST_NEAREST2 * cell->reach2; /* a NaN is not good */
}

/* Whether all vertices lie in the cell up to round-off. */
inline bool fits_corners(const CORNERS *cell)
{
    WIDE beyond = cell->beyond[0];
    for (int block = 1; WIDTH * block < cell->corners; ++block)
        beyond = cell->beyond[block] > beyond ? cell->beyond[block] : beyond;
    return !(largest_lane(beyond) > BEYOND_NOISE);
}

/* Write the vertices as triples, with their state. */
inline void write_triples(const CORNERS *cell, global uchar4 *corners, uchar state)
{
    for (int v = 0; v < cell->corners; ++v)
        corners[v] = cell->at[v];
    corners[0].s3 = state;
}

/* Write the faces from `place` on, and the moments of the cell of generator i, from its sums. False if a face has no
   more area than round-off. */
inline bool write_measures(const CORNERS *cell, const SUMS *sums, int i, int place, const measured_t *out)
{
    REAL4 first = 0;
    REAL volume = 0;
    REAL seconds[SECONDS] = {sum_of_lanes(sums->xx), sum_of_lanes(sums->yy), sum_of_lanes(sums->zz),
                             sum_of_lanes(sums->yz), sum_of_lanes(sums->zx), sum_of_lanes(sums->xy)};
    bool wide = true;
    for (int f = 0; f < cell->faces; ++f) {
        face_t face;
        measure_face(&face, cell, f, cell->planes[f], sums->faces[f], cell->reach2);
        put_face(place + f, cell->labels[f], &face, out);
        wide &= face.wide;
        volume += face.volume;
        first += face.first;
        for (int k = 0; k < SECONDS; ++k)
            seconds[k] += face.seconds[k];
    }
    put_moments(i, volume, first, seconds, out);
    return wide && volume > 0;
}
