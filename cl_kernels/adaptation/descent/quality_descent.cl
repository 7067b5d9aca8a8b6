/* Gradient of the cell quality and of an energy against short edges with respect to the generators, in 2D. From the
   paper's (4.1), up to a constant per number of faces, and from Sieger, Alliez, Botsch (2010), who penalize short
   edges,

     E = sum_c omega_c (2 log P_c - log A_c) + stiffness / 2 sum_f max(0, short_edge - l_f / h_f)^2
         + close_stiffness / 2 sum_f max(0, close - d_f / h_f)^2,
     dE/dx_i = sum over the vertices and faces of cell i,

   with omega >= quality_weight larger for bad cells. A cell pulls its vertices along its faces with the tension
   2 omega / P, and pushes its faces outwards with the pressure omega / A. A short edge pushes its vertices apart. An
   edge f is a face, with h_f the mean of its two cells, or a cell's part of the boundary between two corners of more
   than 30 degrees. The last sum is over faces only: d_f is the distance of the two generators. Neither shapes nor sizes
   of cells keep generators apart, because the face between two that nearly coincide may lie in any direction. */
#include "geometry/domain.h"
#include "tessellation/clipped/outline.h"

/* forces[i] = (2 omega / P, omega / A, h, length of the shortest face), omega = quality_weight (1 - bad_cell_weight log
   Q). One work-item per four generators, because four logarithms cost as much as one on a CPU. */
kernel void compute_cell_forces(const int size, global const int *starts, global const FACE *face_measures,
                                global const REAL *volumes, global const REAL *quality, global const REAL *h,
                                const REAL quality_weight, const REAL bad_cell_weight, global REAL4 *forces)
{
    LONG_ITEM(quad);
    const int begin = 4 * quad, count = min(4, size - begin);
    REAL q[4] = {1, 1, 1, 1};
    for (int c = 0; c < count; ++c)
        q[c] = fmax(quality[begin + c], R(1e-6));
    const REAL4 omegas = quality_weight * (1 - bad_cell_weight * log((REAL4)(q[0], q[1], q[2], q[3])));
    const REAL omega[4] = {omegas.s0, omegas.s1, omegas.s2, omegas.s3};
    for (int c = 0; c < count; ++c) {
        const int i = begin + c;
        REAL perimeter = 0, shortest = REAL_MAX;
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            perimeter += face_measures[k];
            shortest = fmin(shortest, (REAL)face_measures[k]);
        }
        forces[i] = (REAL4)(2 * omega[c] / perimeter, omega[c] / volumes[i], h[i], shortest);
    }
}

/* The faces of all cells. */
typedef struct {
    global const int *starts, *neighbors;
    global const FACE *lengths, *centroids;
} rows_t;

/* An energy against short edges, or against generators that are too close to each other. */
typedef struct {
    REAL length, stiffness;
} repulsion_t;

/* A face of the cell of the generator at x. */
typedef struct {
    int label, place;
    REAL2 away;    /* to the neighbor; 0 for a wall */
    REAL2 tangent; /* unit vector along the face, counter-clockwise */
    REAL inverse;  /* 1 / distance of the neighbor */
    REAL4 forces;  /* of the neighbor */
} Face;

inline REAL2 wall_tangent(int label OUTLINE_ARGS)
{
#ifdef POLYGON
    return BOUNDARY_TANGENT(label);
#else
    const int wall = -1 - label;
    const REAL sign = wall % 2 ? 1 : -1;
    return wall < 2 ? (REAL2)(0, sign) : (REAL2)(-sign, 0);
#endif
}

inline Face read_face(int k, const REAL *x, const rows_t *rows, global const REAL *points,
                      global const REAL4 *forces OUTLINE_ARGS PERIOD_ARGS)
{
    Face f;
    const int label = f.label = rows->neighbors[k];
    f.place = k;
    f.away = 0;
    f.inverse = 0;
    f.forces = 0;
    if (label >= 0) {
        f.away = VECTOR_TO(x, label, points);
        f.inverse = 1 / sqrt(dot(f.away, f.away));
        f.tangent = f.inverse * (REAL2)(-f.away.s1, f.away.s0);
        f.forces = forces[label];
    } else
        f.tangent = wall_tangent(label OUTLINE);
    return f;
}

/* Where face k begins (side = -1) or ends (side = 1), relative to its generator. */
inline REAL2 end_of_face(int k, int side, REAL2 tangent, const REAL *x, const rows_t *rows)
{
    return VECTOR_OF(x, rows->centroids, k) + side * rows->lengths[k] / 2 * tangent;
}

inline bool is_same_vertex(REAL2 p, REAL2 q)
{
    return !(dot(p - q, p - q) > R(1e-6) * dot(q, q));
}

/* dE/dl of an edge. */
inline REAL edge_tension(REAL length, REAL unit, const repulsion_t *s)
{
    return -s->stiffness / unit * fmax(0, s->length - length / unit);
}

/* Length of the face between cells b and f, REAL_MAX if there is none. */
inline REAL face_between(int b, int f, const rows_t *rows)
{
    for (int k = rows->starts[b]; k < rows->starts[b + 1]; ++k)
        if (rows->neighbors[k] == f)
            return rows->lengths[k];
    return REAL_MAX;
}

/* Length of the boundary of cell i from face k on, forwards (side = 1) or backwards (side = -1), up to a face between
   cells or to a convex corner. REAL_MAX if it ends in a re-entrant corner, which faces are meant to meet, or goes on
   elsewhere in the row. */
inline REAL boundary_length(int i, int k, int side, const rows_t *rows OUTLINE_ARGS)
{
    const REAL x[SITE_SIZE] = {0}; /* its faces are relative to it */
    const int begin = rows->starts[i], end = rows->starts[i + 1];
    REAL2 tangent = wall_tangent(rows->neighbors[k] OUTLINE);
    REAL length = rows->lengths[k];
    for (int count = begin + 1; count < end; ++count) {
        const REAL2 here = end_of_face(k, side, tangent, x, rows);
        k += side;
        k = k == end ? begin : (k < begin ? end - 1 : k);
        if (rows->neighbors[k] >= 0)
            return length;
        const REAL2 next = wall_tangent(rows->neighbors[k] OUTLINE);
        if (!is_same_vertex(end_of_face(k, -side, next, x, rows), here))
            return REAL_MAX;
        if (dot(tangent, next) < R(0.866))
            return side * (tangent.s0 * next.s1 - tangent.s1 * next.s0) > 0 ? length : REAL_MAX;
        length += rows->lengths[k];
        tangent = next;
    }
    return REAL_MAX;
}

/* dE/dl of the boundary of cell i beside its face with cell j, after it (side = 1) or before it (side = -1). */
inline REAL boundary_tension(int i, int j, int side, REAL4 force, const rows_t *rows, const repulsion_t *s OUTLINE_ARGS)
{
    const int begin = rows->starts[i], end = rows->starts[i + 1];
    if (force.s3 < s->length * force.s2)
        for (int k = begin; k < end; ++k) {
            const int wall = k + side == end ? begin : (k + side < begin ? end - 1 : k + side);
            if (rows->neighbors[k] == j && rows->neighbors[wall] < 0)
                return edge_tension(boundary_length(i, wall, side, rows OUTLINE), force.s2, s);
        }
    return 0;
}

/* lloyd = -rate h^2 dE/dx_i, at most max_displacement h. One work-item per generator. E is as stiff as the weight of
   the worst cell at i is large, so the rate is smaller in proportion where the largest omega h^2 / A of cell i and its
   neighbors exceeds `full_rate`.

   The vertex v between the faces to j and q moves by (x_j - x_i).dv = (x_q - x_i).dv = (v - x_i).dx_i; on a wall it
   moves along the wall. Each cell at a face pulls its two vertices along the face, with its tension. The force on v is
   the sum over its faces and their two cells. */
kernel void descend_quality(const int size, global const int *starts, global const int *neighbors,
                            global const FACE *face_measures, global const FACE *face_centroids,
                            global const REAL *points, global const REAL4 *forces, const REAL rate,
                            const REAL max_displacement, const REAL short_edge, const REAL stiffness, const REAL close,
                            const REAL close_stiffness, const REAL full_rate,
                            global REAL *lloyd OUTLINE_ARGS PERIOD_ARGS)
{
    LONG_ITEM(i);
    const rows_t rows = {starts, neighbors, face_measures, face_centroids};
    const repulsion_t edges = {short_edge, stiffness}, pairs = {close, close_stiffness};
    SITE(x, i, points);
    const int begin = starts[i], end = starts[i + 1];
    const REAL4 own = forces[i];
    const REAL h = own.s2;
    REAL2 g = 0;
    REAL pressure = own.s1;
    Face before = read_face(end - 1, x, &rows, points, forces OUTLINE PERIODS);
    for (int k = begin; k < end; ++k) {
        const Face face = read_face(k, x, &rows, points, forces OUTLINE PERIODS);
        const REAL2 m = VECTOR_OF(x, face_centroids, k);
        const REAL2 r = end_of_face(k, -1, face.tangent, x, &rows); /* corner k */
        REAL s = 0;
        bool apart = false;
#ifdef POLYGON
        /* A cell may have several loops. The first face of a loop follows its last one. Where no face ends, the cell
           continues in a piece that was added to it. */
        apart = !is_same_vertex(end_of_face(before.place, 1, before.tangent, x, &rows), r);
        for (int other = begin; other < end && apart; ++other) {
            const Face ending = read_face(other, x, &rows, points, forces OUTLINE PERIODS);
            if (is_same_vertex(end_of_face(other, 1, ending.tangent, x, &rows), r)) {
                before = ending;
                apart = false;
            }
        }
#endif
        /* Tensions of the faces before and after the vertex. */
        REAL tension_before = own.s0 + before.forces.s0, tension_after = own.s0 + face.forces.s0;
        if (before.label >= 0)
            tension_before += edge_tension(face_measures[before.place], (h + before.forces.s2) / 2, &edges);
        if (face.label >= 0)
            tension_after += edge_tension(face_measures[k], (h + face.forces.s2) / 2, &edges);
        if (apart) {
        } else if (before.label >= 0 && face.label >= 0) {
            const REAL2 a = before.away, b = face.away, c = b - a;
            const REAL det = a.s0 * b.s1 - a.s1 * b.s0;
            const REAL2 between = (REAL2)(-c.s1, c.s0) / sqrt(dot(c, c)); /* against the face between the two */
            REAL tension = before.forces.s0 + face.forces.s0;
            const REAL unit = (before.forces.s2 + face.forces.s2) / 2;
            if (fmax(before.forces.s3, face.forces.s3) < short_edge * unit)
                tension += edge_tension(face_between(before.label, face.label, &rows), unit, &edges);
            const REAL2 pull = tension_before * before.tangent - tension_after * face.tangent + tension * between;
            if (det > 0)
                s = (c.s1 * pull.s0 - c.s0 * pull.s1) / det;
        } else if (before.label >= 0 || face.label >= 0) {
            const bool first = before.label >= 0;
            const int side = first ? 1 : -1;
            const Face other = first ? before : face;
            const REAL2 d = other.away, wall = first ? face.tangent : before.tangent;
            const REAL here = own.s0 + boundary_tension(i, other.label, side, own, &rows, &edges OUTLINE);
            const REAL there =
                other.forces.s0 + boundary_tension(other.label, i, -side, other.forces, &rows, &edges OUTLINE);
            const REAL2 pull = (first ? tension_before * before.tangent : -tension_after * face.tangent) -
                               side * (here - there) * wall;
            const REAL slope = dot(d, wall);
            if (slope * slope > R(1e-12) * dot(d, d))
                s = dot(wall, pull) / slope;
        }
        g += s * r;
        if (face.label >= 0) {
            pressure = fmax(pressure, face.forces.s1);
            g += face_measures[k] * face.inverse * (face.forces.s1 - own.s1) * m;
            g -= edge_tension(1 / face.inverse, (h + face.forces.s2) / 2, &pairs) * face.inverse * face.away;
        }
        before = face;
    }
    REAL2 u = -rate * fmin(h * h, full_rate / pressure) * g;
    const REAL length = sqrt(dot(u, u));
    if (length > max_displacement * h)
        u *= max_displacement * h / length;
    /* A degenerate vertex has no gradient. */
    if (!(length < REAL_MAX))
        u = 0;
    put_vector(x, u, i, lloyd);
}

/* Distance of a generator from the middle of the opposite side over half that side, after it has moved: 1 is a right
   angle (Thales). */
#define OPENED R(1.01)
/* Longest of these moves over the distance of the nearest neighbor. Where sizes jump, triangles are so obtuse that
   longer moves would put generators on each other. */
#define LARGEST_OPENING R(0.25)

/* By how much the height of a triangle is missing, for an angle below a right one between the vectors u and v to two of
   its corners: f = OPENED |u - v| / 2 - |u + v| / 2 where the angle is obtuse, else 0. Also the unit vectors along
   u + v and u - v. */
inline REAL missing_height(const REAL *u, const REAL *v, REAL *up, REAL *across)
{
    REAL up2 = 0, across2 = 0;
    EACH_AXIS (a) {
        up[a] = u[a] + v[a];
        across[a] = u[a] - v[a];
        up2 += up[a] * up[a];
        across2 += across[a] * across[a];
    }
    if (up2 >= across2)
        return 0;
    const REAL height = sqrt(up2), width = sqrt(across2);
    EACH_AXIS (a) {
        up[a] = height > 0 ? up[a] / height : 0;
        across[a] /= width;
    }
    return (OPENED * width - height) / 2;
}

/* Per generator i: displacement[i], which opens the obtuse Delaunay triangles at i; counts[i] is the number of those
   whose obtuse angle is at i. Two neighbors in a row and i are a triangle.

   The gradient of the height |u + v| / 2 less the half width |u - v| / 2 of a triangle is -up at its obtuse corner, and
   (up - across) / 2 at the end of u, (up + across) / 2 at that of v. Its square is 2, so the shortest displacement that
   gives the missing height f is f / 2 times the gradient. */
kernel void open_obtuse_triangles(const int size, global const int *starts, global const int *neighbors,
                                  global const REAL *points, global REAL *displacement, global int *counts PERIOD_ARGS)
{
    WORK_ITEM(i);
    const int begin = starts[i], end = starts[i + 1];
    REAL way[DIM] = {0}, nearest2 = REAL_MAX, way2 = 0;
    int count = 0;
    for (int k = begin; k < end; ++k) {
        const int j = neighbors[k], l = neighbors[k + 1 < end ? k + 1 : begin];
        if (j < 0 || l < 0)
            continue;
        REAL u[DIM], v[DIM], w[DIM], from_j[DIM], from_l[DIM], back[DIM], up[DIM], across[DIM], gap2 = 0;
        EACH_AXIS (a) {
            u[a] = DIFFERENCE(a, points[DIM * i + a], points[DIM * j + a]);
            v[a] = DIFFERENCE(a, points[DIM * i + a], points[DIM * l + a]);
            w[a] = v[a] - u[a];
            back[a] = -w[a];
            from_j[a] = -u[a];
            from_l[a] = -v[a];
            gap2 += u[a] * u[a];
        }
        nearest2 = fmin(nearest2, gap2);
        const REAL own = missing_height(u, v, up, across);
        EACH_AXIS (a)
            way[a] -= own / 2 * up[a];
        count += own > 0;
        const REAL at_j = missing_height(from_j, w, up, across);
        EACH_AXIS (a)
            way[a] += at_j / 4 * (up[a] - across[a]);
        const REAL at_l = missing_height(from_l, back, up, across);
        EACH_AXIS (a)
            way[a] += at_l / 4 * (up[a] - across[a]);
    }
    EACH_AXIS (a)
        way2 += way[a] * way[a];
    const REAL most2 = LARGEST_OPENING * LARGEST_OPENING * nearest2, scale = way2 > most2 ? sqrt(most2 / way2) : 1;
    EACH_AXIS (a)
        displacement[DIM * i + a] = scale * way[a];
    counts[i] = count;
}
