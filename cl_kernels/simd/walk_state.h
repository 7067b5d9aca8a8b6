/* State and measures of cells in 3D that are traced along their edges (edge_walk.h), one per vector lane. */
#include "simd/plane_lists.h"

#define HULL_CAPACITY 48                    /* most faces of a cell */
#define CORNER_CAPACITY (2 * HULL_CAPACITY) /* most vertices */
/* Areas below this share of the squared distance of the farthest vertex are computed again in a more accurate way: sums
   over points far from a face lose digits. */
#define SMALL_AREA 3e-3

typedef struct {
    double8 x, y, z;
} vectors_t;

inline double8 dot8(vectors_t a, vectors_t b)
{
    return fma(a.x, b.x, fma(a.y, b.y, a.z * b.z));
}

inline vectors_t cross_in_space(vectors_t a, vectors_t b)
{
    const vectors_t c = {fma(a.y, b.z, -a.z * b.y), fma(a.z, b.x, -a.x * b.z), fma(a.x, b.y, -a.y * b.x)};
    return c;
}

/* a + s b */
inline vectors_t along8(vectors_t a, double8 s, vectors_t b)
{
    const vectors_t c = {fma(s, b.x, a.x), fma(s, b.y, a.y), fma(s, b.z, a.z)};
    return c;
}

/* Lane 0 to 7 of four vectors. */
#define ACROSS(a, b, c, d, lane) ((double4)((a).s##lane, (b).s##lane, (c).s##lane, (d).s##lane))

/* The cells: bisectors of their faces, in the order of discovery, and sums (see `add_corner`). */
typedef struct {
    planes_t planes[HULL_CAPACITY + 1];
    double4 sums[(HULL_CAPACITY + 1) * LANES];
    int places[(HULL_CAPACITY + 1) * LANES];
    int faces[LANES], corners[LANES];
    long doubt[LANES], lost[LANES]; /* whether a decision is uncertain; whether the cell is open */
    double8 reach2;                 /* largest squared distance of a vertex */
    double8 square_x, square_y, square_z, mixed_x, mixed_y, mixed_z; /* xx, yy, zz; yz, zx, xy */
} cells_t;

/* The topology that one lane has found. */
typedef struct {
    ulong sides[HULL_CAPACITY];           /* bit b of [a]: a and b are consecutive at some vertex */
    uchar4 corner_faces[CORNER_CAPACITY]; /* counter-clockwise */
    uchar4 edges[CORNER_CAPACITY + 4];    /* to be traced: two consecutive faces at a corner, and the corner */
    int open;                             /* number of edges */
    uchar face_of[LIST_CAPACITY];         /* face of each entry of the list, or NO_FACE */
} lane_walk_t;

/* Progress of the walk. */
typedef struct {
    planes_t corners[CORNER_CAPACITY];
    lane_walk_t lanes[LANES];
    long a[LANES], b[LANES], from[LANES]; /* the faces of the current edge, and its first corner */
    long active[LANES];
} walk_t;

inline vectors_t planes_at(const planes_t *planes, const long *at)
{
    const vectors_t p = {PLANE_LANES(planes, at, 0), PLANE_LANES(planes, at, 1), PLANE_LANES(planes, at, 2)};
    return p;
}

/* Contributions of a vertex at the end of the common edge of faces p and q, along w = p x q: the foot of x on the edge
   is at -g w from the vertex; parts of the areas, and of the second moments weighted by volume. */
typedef struct {
    double8 g, part_p, part_q, both;
} share_t;

inline share_t share_edge(double8 g, vectors_t p, vectors_t q, double8 p2, double8 q2, double8 inverses)
{
    const double8 pq = dot8(p, q);
    const share_t share = {g, g * (p2 - pq), g * (q2 - pq), g * fma(-pq, inverses, 2)};
    return share;
}

/* Add the contributions of vertex y to its faces a, b, c (counter-clockwise), numbers at_*, for some lanes; for the
   others these are HULL_CAPACITY.

   x, the foot of x on a face, the foot f of x on an edge of the face, and a vertex v of the edge form a tetrahedron,
   with a negative volume if a foot lies outside: six at every vertex. For a face at p, the triangle of the feet and the
   vertex has the area g (p^2 - p.q) / (4 |p|), and the tetrahedron the volume g (p^2 - p.q) / (24 p^2). First moments
   follow from f + v. Second moments: here the terms without the foot on the face, v v + f f + (v + f) (v + f). */
inline void add_corner(cells_t *cells, long8 some, const long *at_a, const long *at_b, const long *at_c, vectors_t y,
                       vectors_t a, vectors_t b, vectors_t c, vectors_t ab, vectors_t bc, vectors_t ca, double8 a2,
                       double8 b2, double8 c2)
{
    const double8 ia = PLANE_LANES(cells->planes, at_a, 3), ib = PLANE_LANES(cells->planes, at_b, 3);
    const double8 ic = PLANE_LANES(cells->planes, at_c, 3);
    const double8 ab2 = dot8(ab, ab), bc2 = dot8(bc, bc), ca2 = dot8(ca, ca), inverse = 1 / (ab2 * bc2 * ca2);
    const share_t of_ab = share_edge(dot8(y, ab) * bc2 * ca2 * inverse, a, b, a2, b2, ia + ib);
    const share_t of_bc = share_edge(dot8(y, bc) * ca2 * ab2 * inverse, b, c, b2, c2, ib + ic);
    const share_t of_ca = share_edge(dot8(y, ca) * ab2 * bc2 * inverse, c, a, c2, a2, ic + ia);
    const vectors_t twice = {2 * y.x, 2 * y.y, 2 * y.z}, none = {0, 0, 0};
    const vectors_t to_ab = along8(twice, -of_ab.g, ab), to_bc = along8(twice, -of_bc.g, bc);
    const vectors_t to_ca = along8(twice, -of_ca.g, ca);
    const vectors_t first_a = along8(along8(none, of_ab.part_p, to_ab), of_ca.part_q, to_ca);
    const vectors_t first_b = along8(along8(none, of_bc.part_p, to_bc), of_ab.part_q, to_ab);
    const vectors_t first_c = along8(along8(none, of_ca.part_p, to_ca), of_bc.part_q, to_bc);
    const double8 area_a = of_ab.part_p + of_ca.part_q, area_b = of_bc.part_p + of_ab.part_q;
    const double8 area_c = of_ca.part_p + of_bc.part_q;
#define ADD_TO_FACES(lane)                                                                                             \
    LANE(cells->sums, at_a[lane], lane) += ACROSS(area_a, first_a.x, first_a.y, first_a.z, lane);                      \
    LANE(cells->sums, at_b[lane], lane) += ACROSS(area_b, first_b.x, first_b.y, first_b.z, lane);                      \
    LANE(cells->sums, at_c[lane], lane) += ACROSS(area_c, first_c.x, first_c.y, first_c.z, lane)
    ADD_TO_FACES(0);
    ADD_TO_FACES(1);
    ADD_TO_FACES(2);
    ADD_TO_FACES(3);
    ADD_TO_FACES(4);
    ADD_TO_FACES(5);
    ADD_TO_FACES(6);
    ADD_TO_FACES(7);
    /* With u = g w the sum is 6 y y - 3 (y u + u y) + 2 u u. */
    const double8 t_ab = of_ab.both, t_bc = of_bc.both, t_ca = of_ca.both, t = t_ab + t_bc + t_ca;
    const double8 u_ab = t_ab * of_ab.g, u_bc = t_bc * of_bc.g, u_ca = t_ca * of_ca.g;
    const double8 uu_ab = 2 * u_ab * of_ab.g, uu_bc = 2 * u_bc * of_bc.g, uu_ca = 2 * u_ca * of_ca.g;
    const double8 zx = 3 * (t * y.x - fma(u_ab, ab.x, fma(u_bc, bc.x, u_ca * ca.x)));
    const double8 zy = 3 * (t * y.y - fma(u_ab, ab.y, fma(u_bc, bc.y, u_ca * ca.y)));
    const double8 zz = 3 * (t * y.z - fma(u_ab, ab.z, fma(u_bc, bc.z, u_ca * ca.z)));
    cells->square_x +=
        some ? fma(2 * zx, y.x, fma(uu_ab, ab.x * ab.x, fma(uu_bc, bc.x * bc.x, uu_ca * ca.x * ca.x))) : 0;
    cells->square_y +=
        some ? fma(2 * zy, y.y, fma(uu_ab, ab.y * ab.y, fma(uu_bc, bc.y * bc.y, uu_ca * ca.y * ca.y))) : 0;
    cells->square_z +=
        some ? fma(2 * zz, y.z, fma(uu_ab, ab.z * ab.z, fma(uu_bc, bc.z * bc.z, uu_ca * ca.z * ca.z))) : 0;
    cells->mixed_x +=
        some ? fma(zy, y.z, zz * y.y) + fma(uu_ab, ab.y * ab.z, fma(uu_bc, bc.y * bc.z, uu_ca * ca.y * ca.z)) : 0;
    cells->mixed_y +=
        some ? fma(zz, y.x, zx * y.z) + fma(uu_ab, ab.z * ab.x, fma(uu_bc, bc.z * bc.x, uu_ca * ca.z * ca.x)) : 0;
    cells->mixed_z +=
        some ? fma(zx, y.y, zy * y.x) + fma(uu_ab, ab.x * ab.y, fma(uu_bc, bc.x * bc.y, uu_ca * ca.x * ca.y)) : 0;
}

/* Measures of the cells, up to factors: volumes, first and second moments; the least area of a face relative to the
   squared distance of its farthest vertex, if that is small. */
typedef struct {
    double8 volume, x, y, z, xx, yy, zz, yz, zx, xy, least;
} moments_t;

inline double4 corner_at(const walk_t *walk, int v, int lane)
{
    return (double4)(PLANE_LANE(walk->corners, v, 0, lane), PLANE_LANE(walk->corners, v, 1, lane),
                     PLANE_LANE(walk->corners, v, 2, lane), 0);
}

/* Area and centroid of a face of a lane from triangles around its first vertex: as accurate as the vertices, also for
   small faces. `normal` has length 1; `far2` becomes the squared distance of the farthest vertex. */
inline double4 measure_small(const cells_t *cells, const walk_t *walk, int f, int lane, double4 normal, double *far2)
{
    /* For each vertex of the face, the faces before and after it. */
    uchar ins[HULL_CAPACITY], outs[HULL_CAPACITY], at[HULL_CAPACITY];
    int n = 0;
    for (int v = 0; v < cells->corners[lane] && n < HULL_CAPACITY; ++v) {
        const uchar4 faces = walk->lanes[lane].corner_faces[v];
        ins[n] = faces.s0 == f ? faces.s1 : (faces.s1 == f ? faces.s2 : faces.s0);
        outs[n] = faces.s0 == f ? faces.s2 : (faces.s1 == f ? faces.s0 : faces.s1);
        at[n] = v;
        n += faces.s0 == f || faces.s1 == f || faces.s2 == f;
    }
    const double4 first = corner_at(walk, at[0], lane);
    double4 before = 0, sum = 0;
    double twice = 0;
    *far2 = dot(first, first);
    for (int k = 0, steps = 1; steps < n; ++steps) {
        int next = 0;
        while (next < n - 1 && ins[next] != outs[k])
            ++next;
        const double4 y = corner_at(walk, at[next], lane), after = y - first;
        *far2 = fmax(*far2, dot(y, y));
        const double weight = dot(normal, cross(before, after));
        twice += weight;
        sum += weight * (before + after);
        before = after;
        k = next;
    }
    const double4 centroid = first + sum / (3 * twice);
    return (double4)(twice / 2, centroid.s0, centroid.s1, centroid.s2);
}

/* Replace the sums of the faces by areas and centroids, and add up the contributions of faces to cells. */
inline moments_t finish_cells(cells_t *cells, const walk_t *walk, long8 closed)
{
    int most = 0;
    for (int lane = 0; lane < LANES; ++lane)
        most = max(most, cells->faces[lane]);
    const long8 counts = convert_long8(vload8(0, cells->faces));
    moments_t m = {0,
                   0,
                   0,
                   0,
                   cells->square_x,
                   cells->square_y,
                   cells->square_z,
                   cells->mixed_x,
                   cells->mixed_y,
                   cells->mixed_z,
                   INFINITY};
    for (int f = 0; f < most; ++f) {
        const long8 there = f < counts;
        const double8 d2 = there ? cells->planes[f].d2 : 1, middle = d2 / 2;
        const double8 foot_x = there ? cells->planes[f].x * middle : 0,
                      foot_y = there ? cells->planes[f].y * middle : 0;
        const double8 foot_z = there ? cells->planes[f].z * middle : 0;
        double8 sums[4];
        for (int lane = 0; lane < LANES; ++lane) {
            const double4 own = LANE(cells->sums, f, lane);
            LANE((double *)sums, 0, lane) = own.s0;
            LANE((double *)sums, 1, lane) = own.s1;
            LANE((double *)sums, 2, lane) = own.s2;
            LANE((double *)sums, 3, lane) = own.s3;
        }
        const double8 sum = there ? sums[0] : 0, sum_x = there ? sums[1] : 0;
        const double8 sum_y = there ? sums[2] : 0, sum_z = there ? sums[3] : 0;
        const double8 length = sqrt(d2), area = sum * length / 4, inverse = 1 / sum;
        /* The centroid, projected to the plane. */
        double8 cx = fma(sum_x, inverse, foot_x) / 3, cy = fma(sum_y, inverse, foot_y) / 3;
        double8 cz = fma(sum_z, inverse, foot_z) / 3;
        const planes_t *p = &cells->planes[f];
        const double8 off = 1 - 2 * fma(cx, p->x, fma(cy, p->y, cz * p->z));
        cx = fma(off, foot_x, cx);
        cy = fma(off, foot_y, cy);
        cz = fma(off, foot_z, cz);
        double shares[LANES];
        long small[LANES];
        vstore8((double8)1, 0, shares);
        vstore8(closed & there & ~(area > SMALL_AREA * cells->reach2), 0, small);
#define PUT_FACE(lane) LANE(cells->sums, f, lane) = ACROSS(area, cx, cy, cz, lane)
        PUT_FACE(0);
        PUT_FACE(1);
        PUT_FACE(2);
        PUT_FACE(3);
        PUT_FACE(4);
        PUT_FACE(5);
        PUT_FACE(6);
        PUT_FACE(7);
        for (int lane = 0; lane < LANES; ++lane)
            if (small[lane]) {
                const double scale = LANE((const double *)&length, 0, lane);
                const double4 normal = scale * (double4)(PLANE_LANE(p, 0, 0, lane), PLANE_LANE(p, 0, 1, lane),
                                                         PLANE_LANE(p, 0, 2, lane), 0);
                double far2;
                const double4 face = measure_small(cells, walk, f, lane, normal, &far2);
                LANE(cells->sums, f, lane) = face;
                shares[lane] = face.s0 / far2;
            }
        m.least = there ? fmin(m.least, vload8(0, shares)) : m.least;
        const double8 x = d2 * fma(sum, foot_x, sum_x), y = d2 * fma(sum, foot_y, sum_y);
        const double8 z = d2 * fma(sum, foot_z, sum_z);
        m.volume += d2 * sum;
        m.x += x;
        m.y += y;
        m.z += z;
        /* The terms that add_corner omits: twice the square of the foot, and its products with f and v. */
        m.xx = fma(2 * foot_x, x, m.xx);
        m.yy = fma(2 * foot_y, y, m.yy);
        m.zz = fma(2 * foot_z, z, m.zz);
        m.yz += fma(foot_y, z, foot_z * y);
        m.zx += fma(foot_z, x, foot_x * z);
        m.xy += fma(foot_x, y, foot_y * x);
    }
    const double8 inverse = 1 / m.volume;
    m.volume /= 24;
    m.x *= inverse / 4;
    m.y *= inverse / 4;
    m.z *= inverse / 4;
    m.xx = m.xx * inverse / 20 - m.x * m.x;
    m.yy = m.yy * inverse / 20 - m.y * m.y;
    m.zz = m.zz * inverse / 20 - m.z * m.z;
    m.yz = m.yz * inverse / 20 - m.y * m.z;
    m.zx = m.zx * inverse / 20 - m.z * m.x;
    m.xy = m.xy * inverse / 20 - m.x * m.y;
    return m;
}
