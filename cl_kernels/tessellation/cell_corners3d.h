/* A cell in 3D as the vertices of its planes: a vertex is a triple of faces, counter-clockwise seen from outside. All
   positions are relative to the generator. The plane of a neighbor at d is y.p = 1/2 with p = d / d^2. */
#include "opencl/real.h"
#include "tessellation/row_counts.h"
#include "tessellation/wide_vectors.h"

#define MOST_CORNERS (2 * MOST_FACES)
#define NO_CORNER 255

/* Largest product y.p - 1/2 of a vertex that lies in its cell up to round-off; least squared volume spanned by the
   directions of its three faces; least squared area spanned by those of two, as measures have errors of eps over their
   angle; least squared distance of a neighbor, as a share of that of the farthest vertex; least area of a face, as a
   share of the squared distance of its farthest vertex. */
#if IS_DOUBLE
#define BEYOND_NOISE R(1e-12)
#define LEAST_SINE2 R(1e-10)
#define LEAST_ANGLE2 R(1e-12)
#define LEAST_NEAREST2 R(1e-7)
#define LEAST_AREA R(1e-12)
#else
#define BEYOND_NOISE R(1e-5)
#define LEAST_SINE2 R(1e-6)
#define LEAST_ANGLE2 R(1e-4)
#define LEAST_NEAREST2 R(1e-3)
#define LEAST_AREA R(1e-6)
#endif
/* Areas below this share of the squared distance of the farthest vertex are computed again in a more accurate way: sums
   over points far from a face lose digits. */
#define FLAT_AREA R(3e-3)

typedef struct {
    int faces, corners;
    int labels[MOST_FACES];
    REAL4 planes[MOST_FACES];                                                       /* p and d^2 */
    uchar4 at[MOST_CORNERS];                                                        /* faces of a vertex */
    WIDE x[MOST_CORNERS / WIDTH], y[MOST_CORNERS / WIDTH], z[MOST_CORNERS / WIDTH]; /* its position */
    WIDE beyond[MOST_CORNERS / WIDTH];                                              /* its largest y.p - 1/2 */
    REAL reach2;
} corners_t;

/* Where two faces are consecutive at a vertex: its number, [a][b]. */
typedef struct {
    uchar at[MOST_FACES * MOST_FACES];
} links_t;

inline REAL4 face_plane(const corners_t *cell, int f)
{
    const REAL4 plane = cell->planes[f];
    return (REAL4)(plane.s0, plane.s1, plane.s2, 0);
}

inline REAL4 corner_place(const corners_t *cell, int v)
{
    return (REAL4)(((const REAL *)cell->x)[v], ((const REAL *)cell->y)[v], ((const REAL *)cell->z)[v], 0);
}

/* Pad the planes to whole vectors by those of no neighbor, p = 0. */
inline void pad_planes(corners_t *cell)
{
    const int end = (cell->faces + WIDTH - 1) / WIDTH * WIDTH;
    for (int f = cell->faces; f < end; ++f)
        cell->planes[f] = 0;
}

/* Sums over the vertices: of each face (area, first moments), and second moments of the cell; see `add_corner` in
   simd/walk_state.h. */
typedef struct {
    REAL4 faces[MOST_FACES];
    WIDE xx[HALVES], yy[HALVES], zz[HALVES], yz[HALVES], zx[HALVES], xy[HALVES];
} sums_t;

/* Contributions of a vertex at the end of the common edge of faces p and q; see `share_edge` in simd/walk_state.h. */
typedef struct {
    WIDE g, part_p, part_q, both;
} part_t;

inline void part_of_edge(part_t *part, WIDE g, const places_t *p, const places_t *q, WIDE p2, WIDE q2, WIDE inverses)
{
    const WIDE pq = product_of(p, q);
    part->g = g;
    part->part_p = g * (p2 - pq);
    part->part_q = g * (q2 - pq);
    part->both = g * fma(-pq, inverses, (WIDE)2);
}

/* The first moments of the parts of a face at its edges `in` and `out` of a vertex. */
inline void first_moments(places_t *first, WIDE part_in, const places_t *in, WIDE part_out, const places_t *out)
{
    first->x = fma(part_out, out->x, part_in * in->x);
    first->y = fma(part_out, out->y, part_in * in->y);
    first->z = fma(part_out, out->z, part_in * in->z);
}

/* Find the vertices and sum them up. False if faces at a vertex are nearly parallel or not counter-clockwise, or a
   neighbor is very near. `reach2` and `beyond` are set. The sums are incomplete if a vertex lies beyond another face,
   or without `measured`. */
inline bool place_corners(corners_t *cell, sums_t *sums, bool measured)
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
        places_t a, b, c, ab, bc, ca;
        WIDE ia, ib, ic;
        gather_lanes(&a, &ia, cell->planes, at_a);
        gather_lanes(&b, &ib, cell->planes, at_b);
        gather_lanes(&c, &ic, cell->planes, at_c);
        cross_of(&ab, &a, &b);
        cross_of(&bc, &b, &c);
        cross_of(&ca, &c, &a);
        const WIDE a2 = product_of(&a, &a), b2 = product_of(&b, &b), c2 = product_of(&c, &c);
        const WIDE det = product_of(&a, &bc);
        const WIDE over = 1 / det;
        places_t y = {(ab.x + bc.x + ca.x) * over / 2, (ab.y + bc.y + ca.y) * over / 2,
                      (ab.z + bc.z + ca.z) * over / 2};
        const WIDE off_a = (R(0.5) - product_of(&a, &y)) * over, off_b = (R(0.5) - product_of(&b, &y)) * over;
        const WIDE off_c = (R(0.5) - product_of(&c, &y)) * over;
        add_along(&y, off_a, &bc);
        add_along(&y, off_b, &ca);
        add_along(&y, off_c, &ab);
        cell->x[block] = y.x;
        cell->y[block] = y.y;
        cell->z[block] = y.z;
        const WIDE y2 = product_of(&y, &y), sine2 = det * det - LEAST_SINE2 * a2 * b2 * c2;
        far2 = y2 > far2 ? y2 : far2;
        const WIDE ab2 = product_of(&ab, &ab), bc2 = product_of(&bc, &bc), ca2 = product_of(&ca, &ca);
        good = ((det > 0) & (sine2 > 0) & (ab2 > LEAST_ANGLE2 * a2 * b2) & (bc2 > LEAST_ANGLE2 * b2 * c2) &
                (ca2 > LEAST_ANGLE2 * c2 * a2))
                   ? good
                   : 0;
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

        const WIDE inverse = 1 / (ab2 * bc2 * ca2);
        part_t of_ab, of_bc, of_ca;
        part_of_edge(&of_ab, product_of(&y, &ab) * bc2 * ca2 * inverse, &a, &b, a2, b2, ia + ib);
        part_of_edge(&of_bc, product_of(&y, &bc) * ca2 * ab2 * inverse, &b, &c, b2, c2, ib + ic);
        part_of_edge(&of_ca, product_of(&y, &ca) * ab2 * bc2 * inverse, &c, &a, c2, a2, ic + ia);
        const places_t twice = {2 * y.x, 2 * y.y, 2 * y.z};
        places_t to_ab = twice, to_bc = twice, to_ca = twice, first_a, first_b, first_c;
        add_along(&to_ab, -of_ab.g, &ab);
        add_along(&to_bc, -of_bc.g, &bc);
        add_along(&to_ca, -of_ca.g, &ca);
        first_moments(&first_a, of_ab.part_p, &to_ab, of_ca.part_q, &to_ca);
        first_moments(&first_b, of_bc.part_p, &to_bc, of_ab.part_q, &to_ab);
        first_moments(&first_c, of_ca.part_p, &to_ca, of_bc.part_q, &to_bc);
        REAL4 of_a[WIDTH], of_b[WIDTH], of_c[WIDTH];
        rows_of_lanes(of_a, of_ab.part_p + of_ca.part_q, &first_a);
        rows_of_lanes(of_b, of_bc.part_p + of_ab.part_q, &first_b);
        rows_of_lanes(of_c, of_ca.part_p + of_bc.part_q, &first_c);
        const int turn = HALF_OF(block), lanes = min(WIDTH, cell->corners - WIDTH * block);
        for (int lane = 0; lane < lanes; ++lane) {
            sums->faces[at_a[lane]] += of_a[lane];
            sums->faces[at_b[lane]] += of_b[lane];
            sums->faces[at_c[lane]] += of_c[lane];
        }
        /* Lanes behind the last vertex count nothing. */
        REAL here[WIDTH];
        for (int lane = 0; lane < WIDTH; ++lane)
            here[lane] = lane < lanes;
        const WIDE once = LOAD_WIDE(0, here);
        const WIDE t_ab = once * of_ab.both, t_bc = once * of_bc.both, t_ca = once * of_ca.both;
        const WIDE t = t_ab + t_bc + t_ca;
        const WIDE u_ab = t_ab * of_ab.g, u_bc = t_bc * of_bc.g, u_ca = t_ca * of_ca.g;
        const WIDE uu_ab = 2 * u_ab * of_ab.g, uu_bc = 2 * u_bc * of_bc.g, uu_ca = 2 * u_ca * of_ca.g;
        const WIDE zx = 3 * (t * y.x - fma(u_ab, ab.x, fma(u_bc, bc.x, u_ca * ca.x)));
        const WIDE zy = 3 * (t * y.y - fma(u_ab, ab.y, fma(u_bc, bc.y, u_ca * ca.y)));
        const WIDE zz = 3 * (t * y.z - fma(u_ab, ab.z, fma(u_bc, bc.z, u_ca * ca.z)));
        sums->xx[turn] += fma(2 * zx, y.x, fma(uu_ab, ab.x * ab.x, fma(uu_bc, bc.x * bc.x, uu_ca * ca.x * ca.x)));
        sums->yy[turn] += fma(2 * zy, y.y, fma(uu_ab, ab.y * ab.y, fma(uu_bc, bc.y * bc.y, uu_ca * ca.y * ca.y)));
        sums->zz[turn] += fma(2 * zz, y.z, fma(uu_ab, ab.z * ab.z, fma(uu_bc, bc.z * bc.z, uu_ca * ca.z * ca.z)));
        sums->yz[turn] +=
            fma(zy, y.z, zz * y.y) + fma(uu_ab, ab.y * ab.z, fma(uu_bc, bc.y * bc.z, uu_ca * ca.y * ca.z));
        sums->zx[turn] +=
            fma(zz, y.x, zx * y.z) + fma(uu_ab, ab.z * ab.x, fma(uu_bc, bc.z * bc.x, uu_ca * ca.z * ca.x));
        sums->xy[turn] +=
            fma(zx, y.y, zy * y.x) + fma(uu_ab, ab.x * ab.y, fma(uu_bc, bc.x * bc.y, uu_ca * ca.x * ca.y));
    }
    cell->reach2 = largest_lane(far2);
    REAL nearest2 = INFINITY;
    for (int f = 0; f < cell->faces; ++f)
        nearest2 = fmin(nearest2, cell->planes[f].s3);
    return largest_lane(-good) < 0 && nearest2 > LEAST_NEAREST2 * cell->reach2; /* a NaN is not good */
}
