/* A vertex of a cell in 3D, where the planes of three faces meet, and its shares of areas, volumes and moments. One
   vertex per lane of a vector.

   All positions are relative to the generator. The plane of a neighbor at d is y.p = 1/2 with p = d / d^2. */
#include "opencl/real.h"
#include "tessellation/row_counts.h"
#include "tessellation/wide_vectors.h"

#define MOST_CORNERS (2 * MOST_FACES)

/* Largest product y.p - 1/2 of a vertex that lies in its cell up to round-off; least squared volume spanned by the
   directions of its three faces; least squared area spanned by those of two, as measures have errors of eps over their
   angle; least squared distance of a neighbor, as a share of that of the farthest vertex; least area of a face, as a
   share of the distance of its farthest vertex times its width, or that distance (see `measure_flat`). */
#if IS_DOUBLE
#define BEYOND_NOISE R(1e-12)
#define LEAST_SINE2 R(1e-10)
#define LEAST_ANGLE2 R(1e-12)
#define LEAST_NEAREST2 R(1e-7)
#else
#define BEYOND_NOISE R(1e-5)
#define LEAST_SINE2 R(1e-6)
#define LEAST_ANGLE2 R(1e-4)
#define LEAST_NEAREST2 R(1e-3)
#endif
#ifndef LEAST_AREA
#define LEAST_AREA (IS_DOUBLE ? R(1e-12) : R(1e-6))
#endif
/* Areas below this share of the squared distance of the farthest vertex are computed again in a more accurate way: sums
   over points far from a face lose digits. */
#define FLAT_AREA R(3e-3)

/* Where the planes a, b, c meet. */
typedef struct {
    places_t y, ab, bc, ca;             /* its position; cross products */
    WIDE a2, b2, c2, ab2, bc2, ca2, y2; /* squared lengths */
    WIDE good;                          /* 1, or 0 if the planes are not counter-clockwise, or nearly parallel */
} corner_t;

inline void find_corner(corner_t *at, const places_t *a, const places_t *b, const places_t *c)
{
    cross_of(&at->ab, a, b);
    cross_of(&at->bc, b, c);
    cross_of(&at->ca, c, a);
    const places_t ab = at->ab, bc = at->bc, ca = at->ca;
    const WIDE a2 = product_of(a, a), b2 = product_of(b, b), c2 = product_of(c, c);
    const WIDE det = product_of(a, &bc), over = 1 / det;
    places_t y = {(ab.x + bc.x + ca.x) * over / 2, (ab.y + bc.y + ca.y) * over / 2, (ab.z + bc.z + ca.z) * over / 2};
    const WIDE off_a = (R(0.5) - product_of(a, &y)) * over, off_b = (R(0.5) - product_of(b, &y)) * over;
    const WIDE off_c = (R(0.5) - product_of(c, &y)) * over;
    add_along(&y, off_a, &bc);
    add_along(&y, off_b, &ca);
    add_along(&y, off_c, &ab);
    const WIDE sine2 = det * det - LEAST_SINE2 * a2 * b2 * c2;
    const WIDE ab2 = product_of(&ab, &ab), bc2 = product_of(&bc, &bc), ca2 = product_of(&ca, &ca);
    /* Not good with a NaN. */
    at->good = ((det > 0) & (sine2 > 0) & (ab2 > LEAST_ANGLE2 * a2 * b2) & (bc2 > LEAST_ANGLE2 * b2 * c2) &
                (ca2 > LEAST_ANGLE2 * c2 * a2))
                   ? (WIDE)1
                   : (WIDE)0;
    at->y = y;
    at->y2 = product_of(&y, &y);
    at->a2 = a2;
    at->b2 = b2;
    at->c2 = c2;
    at->ab2 = ab2;
    at->bc2 = bc2;
    at->ca2 = ca2;
}

/* Contributions of a vertex at the end of the common edge of faces p and q, along w = p x q: the foot of x on the edge
   is at -g w from the vertex; parts of the areas, and of the second moments weighted by volume. */
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

/* The shares of a vertex: of the areas and first moments of its faces, and of the second moments of the cell.

   x, the foot of x on a face, the foot f of x on an edge of the face, and a vertex v of the edge form a tetrahedron,
   with a negative volume if a foot lies outside: six at every vertex. For a face at p, the triangle of the feet and the
   vertex has the area g (p^2 - p.q) / (4 |p|), and the tetrahedron the volume g (p^2 - p.q) / (24 p^2). First moments
   follow from f + v. Second moments: here the terms without the foot on the face, v v + f f + (v + f) (v + f). With
   u = g w their sum is 6 y y - 3 (y u + u y) + 2 u u. */
typedef struct {
    WIDE a, b, c;
    places_t first_a, first_b, first_c;
    WIDE xx, yy, zz, yz, zx, xy;
} shares_t;

/* The shares of the vertex where planes a, b, c meet; the squared distances of their neighbors
   are da2, db2, dc2. `once`: 1, or 0 in
   lanes that add nothing to the cell. */
inline void share_corner(shares_t *share, const corner_t *at, const places_t *a, const places_t *b, const places_t *c,
                         WIDE da2, WIDE db2, WIDE dc2, WIDE once)
{
    const places_t y = at->y, ab = at->ab, bc = at->bc, ca = at->ca;
    const WIDE ab2 = at->ab2, bc2 = at->bc2, ca2 = at->ca2, inverse = 1 / (ab2 * bc2 * ca2);
    part_t of_ab, of_bc, of_ca;
    part_of_edge(&of_ab, product_of(&y, &ab) * bc2 * ca2 * inverse, a, b, at->a2, at->b2, da2 + db2);
    part_of_edge(&of_bc, product_of(&y, &bc) * ca2 * ab2 * inverse, b, c, at->b2, at->c2, db2 + dc2);
    part_of_edge(&of_ca, product_of(&y, &ca) * ab2 * bc2 * inverse, c, a, at->c2, at->a2, dc2 + da2);
    const places_t twice = {2 * y.x, 2 * y.y, 2 * y.z};
    places_t to_ab = twice, to_bc = twice, to_ca = twice;
    add_along(&to_ab, -of_ab.g, &ab);
    add_along(&to_bc, -of_bc.g, &bc);
    add_along(&to_ca, -of_ca.g, &ca);
    first_moments(&share->first_a, of_ab.part_p, &to_ab, of_ca.part_q, &to_ca);
    first_moments(&share->first_b, of_bc.part_p, &to_bc, of_ab.part_q, &to_ab);
    first_moments(&share->first_c, of_ca.part_p, &to_ca, of_bc.part_q, &to_bc);
    share->a = of_ab.part_p + of_ca.part_q;
    share->b = of_bc.part_p + of_ab.part_q;
    share->c = of_ca.part_p + of_bc.part_q;
    const WIDE t_ab = once * of_ab.both, t_bc = once * of_bc.both, t_ca = once * of_ca.both;
    const WIDE t = t_ab + t_bc + t_ca;
    const WIDE u_ab = t_ab * of_ab.g, u_bc = t_bc * of_bc.g, u_ca = t_ca * of_ca.g;
    const WIDE uu_ab = 2 * u_ab * of_ab.g, uu_bc = 2 * u_bc * of_bc.g, uu_ca = 2 * u_ca * of_ca.g;
    const WIDE zx = 3 * (t * y.x - fma(u_ab, ab.x, fma(u_bc, bc.x, u_ca * ca.x)));
    const WIDE zy = 3 * (t * y.y - fma(u_ab, ab.y, fma(u_bc, bc.y, u_ca * ca.y)));
    const WIDE zz = 3 * (t * y.z - fma(u_ab, ab.z, fma(u_bc, bc.z, u_ca * ca.z)));
    share->xx = fma(2 * zx, y.x, fma(uu_ab, ab.x * ab.x, fma(uu_bc, bc.x * bc.x, uu_ca * ca.x * ca.x)));
    share->yy = fma(2 * zy, y.y, fma(uu_ab, ab.y * ab.y, fma(uu_bc, bc.y * bc.y, uu_ca * ca.y * ca.y)));
    share->zz = fma(2 * zz, y.z, fma(uu_ab, ab.z * ab.z, fma(uu_bc, bc.z * bc.z, uu_ca * ca.z * ca.z)));
    share->yz = fma(zy, y.z, zz * y.y) + fma(uu_ab, ab.y * ab.z, fma(uu_bc, bc.y * bc.z, uu_ca * ca.y * ca.z));
    share->zx = fma(zz, y.x, zx * y.z) + fma(uu_ab, ab.z * ab.x, fma(uu_bc, bc.z * bc.x, uu_ca * ca.z * ca.x));
    share->xy = fma(zx, y.y, zy * y.x) + fma(uu_ab, ab.x * ab.y, fma(uu_bc, bc.x * bc.y, uu_ca * ca.x * ca.y));
}
